"""Choices that are made for each colony, so that all designs share a batch; choices that exclude
each other; and designs that a scene function finds unfit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from searching import DT, Level, filling, objective_of

import torchfilm as tf
from design import Choice, Parameter, Search, Sobol, Space, UnfitDesign

STRENGTH = {"weak": 1.0, "middle": 2.0, "strong": 4.0}
CALLS: list[int] = []


def promoted(promoter="weak", decay=1.0) -> tf.Scene:
    """One strength for each colony. "middle" is unfit where decay is at most 1."""
    names = [promoter] if isinstance(promoter, str) else promoter
    CALLS.append(len(names))
    slow = (torch.as_tensor(decay) <= 1.0).reshape(-1).tolist()
    slow = slow * len(names) if len(slow) == 1 else slow
    names = names * len(slow) if len(names) == 1 else names
    if any(name == "middle" and low for name, low in zip(names, slow, strict=True)):
        raise UnfitDesign("middle decays too slowly.")
    make = torch.tensor([STRENGTH[name] for name in names], dtype=torch.float64)
    make = float(make[0]) if len(make) == 1 else make
    circuit = tf.Circuit(filling, species=("gfp",), make=make, decay=decay)
    return tf.Scene(tf.Growth(rate=2.0), tf.Division(length=tf.Uniform(3, 4)), circuit, dt=DT)


def choice(**options) -> Choice:
    return Choice("promoter", tuple(STRENGTH), **options)


def test_all_options_share_a_batch_and_score_as_each_does_alone():
    decay = Parameter("decay", 1.5, 3.0)
    target = Level(wanted=1.0)
    together = objective_of(
        promoted, [choice(per_colony=True), decay], target, cells=4, replicates=2
    )
    apart = objective_of(promoted, [choice(), decay], target, cells=4, replicates=2)
    points = np.array([[(k + 0.5) / 3, 0.3 * k] for k in range(3)])
    CALLS.clear()
    found = together.evaluate(points)
    assert 6 in CALLS
    assert found.losses.tolist() == apart.evaluate(points).losses.tolist()
    assert len({tuple(row) for row in found.losses.tolist()}) == 3


def test_an_unfit_design_fails_with_its_reason_and_does_not_cut_the_batch():
    parameters = [choice(per_colony=True), Parameter("decay", 0.5, 3.0)]
    objective = objective_of(promoted, parameters, Level(), cells=4, replicates=2)
    points = np.array([[0.1, 0.0], [0.5, 0.0], [0.9, 0.0], [0.5, 1.0], [0.2, 1.0]])
    CALLS.clear()
    found = objective.evaluate(points)
    assert found.losses[1].tolist() == [1.5, 1.5]
    assert found.reasons == {(1, k): "middle decays too slowly." for k in range(2)}
    assert np.isfinite(found.loss).all() and (found.loss[[0, 2, 3, 4]] < 1.5).all()
    assert 8 in CALLS  # four fit designs with two replicates each


def test_a_search_whose_trial_designs_are_all_unfit_is_refused():
    with pytest.raises(tf.InputError, match="middle decays too slowly"):
        Search(
            promoted, [Parameter("decay", 0.1, 0.9)], Level(), fixed={"promoter": "middle"}, cells=4
        )


def no_twins(design):
    """The second place takes the next option where the first has its own."""
    first, second = design["a"], design["b"]
    options = ("x", "y", "z")
    return {"b": second if second != first else options[(options.index(second) + 1) % 3]}


def test_choices_that_exclude_each_other_are_resolved_in_the_values():
    options = ("x", "y", "z")
    space = Space([Choice(name, options, resolve=no_twins) for name in "ab"])
    assert space.values(np.array([0.1, 0.5])) == {"a": "x", "b": "y"}
    assert space.values(np.array([0.1, 0.1])) == {"a": "x", "b": "y"}
    for first in options:
        for second in options:
            if first != second:
                values = {"a": first, "b": second}
                assert space.values(space.point(values)) == values


def test_a_search_over_choices_of_each_colony_finds_the_best():
    search = Search(
        promoted,
        [choice(per_colony=True)],
        Level(wanted=0.0),
        fixed={"decay": 2.0},
        cells=4,
        replicates=1,
        method=Sobol(batch=4),
    )
    best = search.run(8, progress=False)
    assert best.values == {"promoter": "weak"}
    assert "weak" in best.table() and best.scene().effects
