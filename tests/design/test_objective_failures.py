"""The objective where designs fail, or do not fit into memory: failures are data."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
import torch
from scored import alike, objective
from searching import (
    DT,
    Level,
    Spread,
    banned,
    fragile,
    grown,
    lit,
    mean,
    objective_of,
    paced,
    short,
    spots,
)

import torchfilm as tf
from design import Burden, Lasting, Parameter, Ring, Target, UnfitDesign, Weighted, growing, scoring
from design.derivatives import along
from design.growing import FinishedColonies

# --- what fails -----------------------------------------------------------------------------------


@pytest.mark.parametrize("most", [None, 100, 1])
def test_a_design_that_the_scene_refuses_fails_alone(most):
    made = objective_of(
        banned,
        [Parameter("low", 3.0, 4.0), Parameter("make", 1, 2)],
        Level(),
        cells=4,
        replicates=2,
        most=most,
    )
    points = np.array([[0.3, 0.5], [0.1, 0.5], [0.25, 0.0], [0.9, 1.0]])
    found = made.evaluate(points)
    assert (found.losses[[0, 2]] == Target.failed).all() and (found.cells[[0, 2]] == 0).all()
    assert set(found.reasons) == {(0, 0), (0, 1), (2, 0), (2, 1)}
    assert all("low ≤ high" in words for words in found.reasons.values())
    assert (
        np.array_equal(found.losses[[1, 3]], made.evaluate(points[[1, 3]]).losses)
        and (found.losses[[1, 3]] != Target.failed).all()
    )
    assert made.colonies(points[0]) == []


def test_a_colony_with_less_than_half_of_its_cells_has_failed():
    """Its target would score a single cell."""
    made = objective_of(lit, [Parameter("make", 1, 2)], Level(), cells=20, until=1.0, replicates=1)
    found = made.evaluate(np.array([[0.5]]))
    assert found.loss[0] == Level.failed and 1 < found.cells[0, 0] < 10
    assert "and 10, half of 20, are needed" in found.reasons[0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("replay", [True, False])
def test_rates_that_are_not_finite_fail_with_time_and_cell(replay):
    made = objective_of(
        fragile, [Parameter("make", 1, 10)], Level(), cells=8, replicates=2, replay=replay
    )
    points = np.array([[0.1], [0.9], [0.3]])
    found = made.evaluate(points)
    assert found.losses[1].tolist() == [Target.failed] * 2 and set(found.reasons) == {
        (1, 0),
        (1, 1),
    }
    for words in found.reasons.values():
        assert words.startswith("at 0.2 h: circuit of cell 0: ") and "gfp" in words
    assert (
        np.array_equal(found.losses[[0, 2]], made.evaluate(points[[0, 2]]).losses)
        and (found.losses[[0, 2]] != Target.failed).all()
    )
    assert (
        len(made.colonies(points[1])) == 0
        and sum(d.state.colonies for d in made.colonies(points[0])) == 2
    )


def test_a_division_too_short_fails_with_time_and_cell():
    made = objective_of(short, [Parameter("added", 0.2, 3)], Spread(), cells=6, replicates=1)
    found = made.evaluate(np.array([[0.0], [0.7]]))
    assert found.losses[0, 0] == Target.failed and found.cells[0, 0] == 0 and found.cells[1, 0] >= 6
    assert found.reasons == {(0, 0): found.reasons[0, 0]}
    assert "h: cell 0 is due to divide at length 0.5" in found.reasons[0, 0]


@dataclasses.dataclass(frozen=True)
class Patchy(Target):
    """The loss of the colony of stream 1 is NaN."""

    failed = 7.0

    def loss(self, state, history=None):
        return torch.where(state.stream == 1, torch.nan, 0.25)


def test_a_loss_that_is_nan_is_a_failure():
    found = objective(target=Patchy()).evaluate(spots(2, 2))
    assert found.losses.tolist() == [[0.25, 7.0, 0.25]] * 2 and found.loss.tolist() == [2.5, 2.5]
    assert found.reasons == {(row, 1): "the target's loss was nan" for row in range(2)}


def test_a_loss_of_the_wrong_shape_is_an_error_of_the_target():
    @dataclasses.dataclass(frozen=True)
    class Single(Target):
        def loss(self, state, history=None):
            return torch.zeros(())

    with pytest.raises(TypeError, match=r"Single.loss must return a tensor of shape \(\d,\)"):
        objective(target=Single()).evaluate(spots(1, 2))


def test_a_colony_that_does_not_grow_fails_alone(monkeypatch):
    monkeypatch.setattr(growing, "PATIENCE", 6.0)
    made = objective_of(paced, [Parameter("rate", 0.0, 1.0)], Level(), cells=8, replicates=2)
    found = made.evaluate(np.array([[0.0], [1.0]]))
    assert found.reasons == {
        (0, k): "it has 1 of 8 cells at 6.2 h and gained none for 6 h" for k in range(2)
    }
    monkeypatch.undo()
    assert np.array_equal(found.losses[1], made.evaluate(np.array([[1.0]])).losses[0])


@pytest.mark.parametrize("rate", [0.02, 0.2])
def test_patience_is_longer_than_slow_cells_need(rate):
    """The law of volume takes ln(4.67/2.67)/rate from 2 µm to division at 4 µm: 28 h at 0.02/h. The
    counts are checked after every hour."""
    steps = np.arange(0, 90, 1.0)
    state = tf.Scene(tf.Growth(rate=rate)).bind(1).start()
    most, since = torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.float64)
    assert not any(bool(growing._stuck(state.replace(time=t), most, since).any()) for t in steps)
    assert bool(growing._stuck(state.replace(time=100.1), most, since).all())


def test_a_colony_without_cells_fails():
    def dying(rate=1.0):
        # the daughters of the first cell are outside the region
        edge = tf.Removal(low=(-0.5, -0.5), high=(0.5, 0.5))
        return tf.Scene(
            tf.Growth(rate=rate), tf.Division(length=4.0), tf.Mechanics(dim=2), edge, dt=DT
        )

    found = objective_of(
        dying, [Parameter("rate", 0.5, 1)], Spread(), cells=8, replicates=1
    ).evaluate(np.array([[1.0]]))
    assert found.losses.tolist() == [[Target.failed]] and found.reasons[0, 0].startswith(
        "no cells remain at "
    )


# --- memory ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("CUDA out of memory. Tried to …"),
        RuntimeError("DefaultCPUAllocator: not enough memory"),
    ],
    ids=str,
)
def test_a_batch_that_does_not_fit_is_halved(monkeypatch, error):
    points = spots(5, 2)
    whole = objective().evaluate(points)
    tried = []
    score = scoring._grow_and_score

    def small(task, item, streams, size):
        tried.append(len(item.rows))
        if len(item.rows) > 2:
            raise error
        return score(task, item, streams, size)

    monkeypatch.setattr(scoring, "_grow_and_score", small)
    alike(objective().evaluate(points), whole)
    assert tried == [5, 2, 3, 1, 2]


@pytest.mark.parametrize(
    "error", [RuntimeError("shapes differ"), ZeroDivisionError(), MemoryError()], ids=repr
)
def test_other_errors_and_one_design_that_does_not_fit_pass_through(monkeypatch, error):
    def broken(*_):
        raise error

    monkeypatch.setattr(scoring, "_grow_and_score", broken)
    with pytest.raises(type(error)) as caught:
        objective().evaluate(spots(1, 2))
    assert caught.value is error


RINGED = Ring("gfp", 3.0, 2.0)
LASTING = Lasting(RINGED, since=1.0)


@pytest.mark.parametrize("end", [{"cells": 64}, {"cells": None, "until": 4.0}], ids=str)
@pytest.mark.parametrize("target", [LASTING, Weighted([(RINGED, 1.0), (LASTING, 2.0)])], ids=str)
def test_residuals_that_are_kept_take_memory(monkeypatch, target, end):
    """One number a cell and one more after each of 40 to 60 steps, in batches with derivatives."""
    monkeypatch.setattr("design.memory.free_bytes", lambda device: 2**30)

    def batches(target, slopes):
        task = objective(target=target, **end).task
        points = spots(200, 2)
        turns = [along(task.space, point) for point in points] if slopes else None
        values = [task.space.values(point) for point in points]
        return len(scoring.cut_work_items(task, values, 3, 1.0, 1, turns))

    assert batches(target, False) == batches(RINGED, False)
    assert batches(target, True) > batches(RINGED, True) > 1


def test_colonies_at_their_ends_are_those_that_were_scored():
    made = objective()
    done = made.colonies(spots(1, 2)[0])
    assert all(isinstance(d, FinishedColonies) for d in done)
    found = {
        int(s): float(x)
        for d in done
        for s, x in zip(d.state.stream, made.task.target.loss(d.state), strict=True)
    }
    assert [found[k] for k in range(3)] == made.evaluate(spots(1, 2)).losses[0].tolist()


def resting(make=1.0):
    """Cells that do not grow."""
    return grown(0.0, make)


def test_cells_that_do_not_grow_reach_an_end_in_time(monkeypatch):
    monkeypatch.setattr("design.growing.PATIENCE", 1.0)
    found = objective_of(
        resting, [Parameter("make", 0.5, 2.0)], Level(), until=5.0, replicates=1
    ).evaluate(np.array([[0.5]]))
    assert not found.reasons and found.loss[0] < Target.failed


def test_the_end_must_exceed_the_founders():
    with pytest.raises(
        tf.InputError,
        match="cells = 2 is not allowed: it must be above the 2 that a colony starts from",
    ):
        objective_of("boundary_detector", [Parameter("k3", 0.1, 10)], Level("yfp"), cells=2)
    small = objective_of(
        "boundary_detector",
        [Parameter("k3", 0.1, 10)],
        Level("yfp"),
        cells=20,
        dt=0.05,
        replicates=1,
    )
    assert small.task.end(0.01)[0] == 3 and not small.evaluate(np.array([[0.5]]), size=0.01).reasons


@dataclasses.dataclass(frozen=True)
class Far(Target):
    """The square of how far the mean level is from 200, in units in which it is far."""

    names = ("gfp",)

    def loss(self, state, history=None):
        return (mean(state, "gfp").double() - 200.0) ** 2


class FarWithoutRoom(Far):
    failed = 1.5


@pytest.mark.parametrize("target", [Far(), FarWithoutRoom(), Burden()])
def test_a_colony_that_grew_never_looks_worse_than_one_that_failed(target):
    """The scene refuses the second design."""

    def frail(make):
        if bool((torch.as_tensor(make) > 3).any()):
            raise UnfitDesign("too much")
        return lit(1e5 * torch.as_tensor(make) if isinstance(target, Burden) else make)

    found = objective_of(frail, [Parameter("make", 0.1, 10.0)], target, cells=3).evaluate(
        np.array([[0.1], [0.9]])
    )
    assert "too much" in found.reasons[1, 0] and found.losses[1, 0] == target.failed
    if type(target) is FarWithoutRoom:
        words = r"loss was [\d.e+]+, above 1.5, that of a failed colony. Give your target a class"
        assert re.search(words, found.reasons[0, 0]) and found.loss[0] == found.loss[1]
    else:
        assert (0, 0) not in found.reasons and found.loss[0] < found.loss[1]
