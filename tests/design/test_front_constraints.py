"""Constraints among several goals, and what the table of a front and of a constrained search
say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from patterned import row
from searching import Level, lit, objective_of

import torchfilm as tf
from design import (
    NSGA2,
    Burden,
    Constrained,
    Lasting,
    OnFraction,
    Parameter,
    Search,
    Spread,
    Weighted,
)
from design.targets.goals import Goals

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]


def search(bound, targets=True, around=lambda target: target, **options):
    """For little burden at a level of at least `bound`."""
    parts = [around(Constrained(Level(wanted=1.0), at_least={"mean_level": bound})), Burden()]
    given = {"targets": parts, "method": NSGA2(population=8)} if targets else {}
    return Search(lit, LIT, cells=3, replicates=2, **{**given, **options})


AROUND = {"itself": lambda x: x, "lasting": lambda x: Lasting(x, since=0.3), "spread": Spread}


@pytest.mark.parametrize("around", AROUND.values(), ids=AROUND)
def test_designs_that_meet_the_constraints_exceed_all_others(around):
    """Of goals that disagree: what is dark has least burden, and breaks the constraint. It may be
    that of a goal which is to last, in some of the steps, or to be alike on all seeds."""
    made = search(0.5, around=around)
    front = made.run(colonies=80, progress=False)
    every = np.concatenate([goals for _, goals in made.study.full_goals()])
    broken = every.max(1) >= Constrained.BROKEN / 100
    assert broken.any() and not broken.all(), "both occur"
    assert (every[broken].min(1) >= Constrained.BROKEN / 100).all(), "in all goals"
    assert len(front) > (around is not Spread) and front.goals.max() < 100
    assert "meets the constraints" not in front.table()


def test_a_front_of_designs_that_meet_none_says_so(capsys):
    front = search(1e6).run(colonies=40, progress=False)
    assert "no design of the first batch meets the constraints (mean_level ≥ 1e+06)" in (
        capsys.readouterr().err
    )
    assert "no design meets the constraints (mean_level ≥ 1e+06)" in front.table()


def test_the_table_of_a_front_tells_bounds_cells_trivial_answers_and_cost():
    corners = [{"make": 0.1, "decay": 2.0}, {"make": 10.0, "decay": 0.5}]
    made = Search(
        lit, LIT, targets=[OnFraction("gfp", 0.5, level=1.0), Burden()], cells=3, replicates=2,
        method=NSGA2(population=8), start=corners, finals=None,
    )  # fmt: skip
    front = made.run(colonies=40, progress=False)
    said = front.table()
    at = [k for k, v in enumerate(front.values) if v["make"] < 0.1001]
    assert at, "the darkest design is on the front"
    (line,) = [line for line in said.splitlines() if line.startswith("make at a bound: design ")]
    assert str(at[0]) in line.removeprefix("make at a bound: design ").split(", ")
    assert "\ncells: " in said
    assert "onfraction without a pattern: all dark 1.000" in said
    assert "40 colonies in" in said and "nsga2(population=8)" in said


def test_the_report_names_the_constraints_that_the_best_design_misses():
    target = Constrained(Burden(), [Level(wanted=1.0)], at_least={"mean_level": 1e6})
    best = search(0, targets=False, target=target).run(colonies=24, progress=False)
    said = best.table()
    assert "the best design misses constraints (mean_level ≥ 1e+06: it has" in said
    assert "the pattern is weak" not in said and "found no pattern" not in said
    (row,) = [line for line in said.splitlines() if line.startswith("mean_level ")]
    assert "≥ 1e+06" in row


def test_constraints_stand_around_a_sum_and_not_in_it():
    part = Constrained(Level(), at_least={"mean_level": 1.0})
    for inside in (part, Lasting(part, since=0.3)):
        with pytest.raises(tf.InputError, match="Put them around the sum: Constrained"):
            Weighted([(inside, 1.0), (Burden(), 0.1)])


def test_every_second_cell_lit_is_no_trivial_answer_to_a_share_of_lit_cells():
    made = Search(lit, LIT, OnFraction("gfp", 0.5, level=1.0), cells=8, replicates=2)
    said = made.run(colonies=24, progress=False).table()
    assert "every second lit 0.0" in said and "'every second lit'" not in said


def test_seeds_that_all_break_a_constraint_are_not_alike_but_broken():
    """Their losses hardly differ, and a spread of 0 would be the best there is."""
    spread = Spread(Constrained(Level(), at_least={"mean_level": 1.0}))
    broken, held = [1e9 + 0.5, 1e9 + 0.5], [0.2, 0.4]
    found = spread.reduced(np.array([broken, held, [0.2, 1e9 + 0.1]]))
    assert (found[[0, 2]] >= Constrained.BROKEN).all() and found[1] < 1.0


def test_large_losses_that_meet_the_constraints_are_not_called_broken():
    target = Constrained(Burden(), at_most={"burden": 1e9})
    lots = lambda make: lit(make=1e9 * make, decay=0.5)
    made = Search(lots, [Parameter("make", 1.0, 2.0)], target, cells=3, replicates=2)
    best = made.run(colonies=60, progress=False)
    assert best.losses.sum() > Constrained.BROKEN > best.losses.max()
    assert "misses the constraints" not in best.table()


def test_a_constraint_beside_a_ready_target_is_no_failure():
    """Whose own losses end at 1: a colony that breaks the constraint has its loss in all goals."""
    goals = [
        Constrained(Level(wanted=1.0), at_least={"mean_level": 5.0}),
        OnFraction("gfp", 0.5, level=1.0),
    ]
    made = Search(lit, LIT, targets=goals, cells=3, replicates=2, method=NSGA2(population=8))
    made.run(40, progress=False)
    assert not made.study.failures()


def test_what_is_broken_in_some_steps_is_broken_in_all_goals():
    """The more, the larger the share of the steps; and a spread of such losses is no goal of 0."""
    lasting = Lasting(Constrained(Level(), at_least={"mean_level": 1.0}), since=0.0)
    for part in (lasting, Constrained(lasting, at_most={"mean_level": 9.0})):
        goals, found = Goals((part, Spread(Burden(("gfp",))), Burden(("gfp",)))), []
        for dark in (0, 1, 6):
            states = [row([0.0], gfp=0.0 if k < dark else 2.0) for k in range(10)]
            history = torch.stack([goals.note(state) for state in states])
            found.append(goals.losses(states[-1], history)[0])
        assert bool((found[0] < 10.0).all())
        assert all(bool((x >= Constrained.BROKEN).all()) for x in found[1:])
        assert bool((found[2] > found[1]).all())
        two = torch.stack([found[1], found[1]]).numpy()[None]
        assert float(goals.parts[1].reduced(two[:, :, 1])[0]) >= Constrained.BROKEN
    alone = np.array([[3e8, 3e8], [2.0, 4.0]])
    assert Spread(lasting).reduced(alone).tolist() == [3e8, pytest.approx(2.0**0.5)]


@dataclasses.dataclass(frozen=True)
class Above(Burden):
    """Measures how far the mean level is above 3."""

    def measures(self, state, history=None):
        return {"above": self.loss(state) - 3.0}


@pytest.mark.parametrize("bound", [-2.0, 0.0, 2.0])
@pytest.mark.parametrize("side, given", [(1.0, "at_least"), (-1.0, "at_most")])
def test_a_bound_may_have_any_sign(bound, side, given):
    """It is missed by the distance as a share of its size, and one of 0 by the distance itself."""
    target = Constrained(Burden(("gfp",)), [Above(("gfp",))], **{given: {"above": bound}})
    for off in (-0.5, 0.25):
        state = row([0.0], gfp=3.0 + bound + off)
        missed = max(0.0, -side * off) / (abs(bound) or 1.0)
        assert float(target.missed(state)) == pytest.approx(missed, abs=1e-12)
        assert (float(target.loss(state)) >= Constrained.BROKEN) == (missed > 0.0)


MIDDLES = np.array([[0.3, 0.6], [0.8, 0.2]])


@dataclasses.dataclass(frozen=True)
class Measured(Burden):
    """Measures the level once with its derivative, and once without, as profiles do."""

    names = ("gfp",)

    def measures(self, state, history=None):
        level = self.loss(state)
        return {"level": level, "shown": level.detach()}


def test_constraints_without_derivatives_have_differences():
    """Exact slopes of what is measured without tangents would be 0."""
    options = {"cells": 8, "replicates": 2, "dtype": torch.float64}
    target = Constrained(Burden(), [Measured()], at_least={"shown": 100.0})
    objective = objective_of(lit, LIT, target, **options)
    assert objective.why_differences == "constraints on shown have no derivatives"
    found = objective.evaluate(MIDDLES, slopes=True).slopes.gradient
    for k in range(2):
        step = np.eye(2)[k] * 0.01
        more, less = (objective.evaluate(MIDDLES + s).loss for s in (step, -step))
        assert np.abs(more - less).min() > 0
        assert found[:, k] == pytest.approx((more - less) / 0.02, rel=1e-6)
    other = Constrained(Burden(), [Measured()], at_least={"level": 100.0})
    assert objective_of(lit, LIT, other, **options).why_differences == ""
