"""Choices that are made for each colony, so that all designs share a batch; choices that exclude
each other; and designs that a scene function finds unfit."""

from __future__ import annotations

from types import FunctionType

import numpy as np
import pytest
import torch
from searching import DT, Level, filling, objective_of

import torchfilm as tf
from design import Choice, Parameter, Search, Sobol, Space, Target, UnfitDesign

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
    assert found.losses[1].tolist() == [Target.failed] * 2
    assert found.reasons == {(1, k): "middle decays too slowly." for k in range(2)}
    assert np.isfinite(found.loss).all() and (found.loss[[0, 2, 3, 4]] < Target.failed).all()
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


def few_twins(design):
    """As `no_twins`, but for twins that no trial of a task has."""
    return no_twins(design) if design["a"] != "x" else {}


def placed(a="x", b="y", decay=1.0) -> tf.Scene:
    strength = {"x": 1.0, "y": 2.0, "z": 4.0}
    make = strength[a] + 10.0 * strength[b]
    circuit = tf.Circuit(filling, species=("gfp",), make=make, decay=decay)
    return tf.Scene(tf.Growth(rate=2.0), tf.Division(length=tf.Uniform(3, 4)), circuit, dt=DT)


def search_of_places(resolve, low=1.0, start=None) -> Search:
    options = ("x", "y", "z")
    parameters = [Choice(name, options, resolve=resolve) for name in "ab"]
    return Search(
        placed, [*parameters, Parameter("decay", low, 2.0)], Level(wanted=20.0), cells=3,
        replicates=1, method=Sobol(batch=4), finals=None, start=start,
    )  # fmt: skip


def test_a_study_of_choices_that_are_resolved_otherwise_is_refused(tmp_path):
    """Points stand for other designs there. The same function, made anew, is the same."""
    search_of_places(no_twins).run(4, study=tmp_path / "s.h5", progress=False)
    with pytest.raises(tf.InputError, match=r"Different: code of resolve\. Give another path"):
        search_of_places(few_twins).run(8, study=tmp_path / "s.h5", progress=False)
    with pytest.raises(tf.InputError, match=r"Different: .*, code of resolve\."):
        search_of_places(None).run(8, study=tmp_path / "s.h5", progress=False)
    same = FunctionType(no_twins.__code__, globals(), "another_name")
    again = search_of_places(same)
    again.run(8, study=tmp_path / "s.h5", progress=False)
    assert len(again.study.entries) == 2


def test_losses_of_choices_that_are_resolved_otherwise_do_not_hold(tmp_path):
    old = search_of_places(no_twins)
    old.run(4, study=tmp_path / "s.h5", progress=False)
    kept = search_of_places(no_twins, low=0.5, start=tmp_path / "s.h5")
    assert kept._known.why == "" and kept.study.entries[0].copies == 0
    made = search_of_places(few_twins, low=0.5, start=tmp_path / "s.h5")
    assert made._known.why == "another code of resolve" and not made.study.entries


def test_what_resolves_choices_counts_for_their_space():
    options = ("x", "y", "z")
    space = lambda resolve, names="ab": Space(
        [Choice(n, options, resolve=resolve if n in names else None) for n in "ab"]
    )
    words = [space(no_twins).digest, space(few_twins).digest, space(no_twins, "a").digest]
    assert len(set(words)) == 3 and space(None).digest is None
    assert space(no_twins).digest == words[0]


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
