"""The objective: the loss of a colony does not depend on its batch, and failures are data."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from searching import (
    DT,
    Count,
    Level,
    Spread,
    alone,
    banned,
    built,
    fragile,
    grown,
    lit,
    objective_of,
    paced,
    short,
    spots,
    uneven,
)

import torchfilm as tf
from design import Choice, Parameter, Stripe, Target, Task, growth_cache, rollout, scoring
from design.rollout import FinishedColonies
from design.scoring import cut_work_items

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]
PACED = [Parameter("rate", 1.2, 2.4), Parameter("make", 1, 2)]
KINDS = {"on recorded growth": (lit, LIT), "each grown again": (paced, PACED)}


def objective(kind="on recorded growth", target=None, **options):
    scene, parameters = KINDS[kind]
    options = {"cells": 8, "replicates": 3, **options}
    return objective_of(scene, parameters, target or Level(), **options)


def alike(one, other):
    assert (
        np.array_equal(one.losses, other.losses)
        and np.array_equal(one.loss, other.loss)
        and np.array_equal(one.cells, other.cells)
    )
    assert one.reasons == other.reasons


# --- every colony is scored alone -----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "end", [{"cells": 5}, {"cells": None, "until": 1.2}, {"cells": 4, "until": 1.2}], ids=str
)
def test_a_loss_is_that_of_the_colony_run_alone(kind, end):
    made = objective(kind, replicates=2, **end)
    points = spots(2, 2)
    found = made.evaluate(points)
    for row, point in enumerate(points):
        for stream in (1, 0)[row:]:
            loss, state = alone(
                made.task.family.function(**made.task.space.values(point)),
                made.task.target,
                stream,
                **end,
            )
            assert found.losses[row, stream] == loss and found.cells[row, stream] == state.cells
    assert not found.reasons and found.loss == pytest.approx(found.losses.mean(1))
    assert bool(found.why_regrown) == (kind != "on recorded growth")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_losses_do_not_depend_on_how_designs_are_batched(kind):
    points, order, options = spots(3, 2), [2, 0, 1], {"cells": 5, "replicates": 2}
    whole = objective(kind, **options).evaluate(points)
    alike(objective(kind, most=1, **options).evaluate(points), whole)
    alike(objective(kind, most=5, **options).evaluate(points), whole)
    with ThreadPoolExecutor(2) as pool:
        alike(objective(kind, **options).evaluate(points, work_items=3, executor=pool), whole)
    turned = objective(kind, **options).evaluate(points[order])
    assert np.array_equal(turned.losses, whole.losses[order]) and np.array_equal(
        turned.loss, whole.loss[order]
    )


def test_recorded_growth_changes_no_bit():
    points = spots(4, 2)
    kept, regrown = objective().evaluate(points), objective(replay=False).evaluate(points)
    alike(kept, regrown)
    assert (kept.why_regrown, regrown.why_regrown) == ("", "replay=False")


@pytest.mark.parametrize(
    "rows, least, most, sizes",
    [
        (7, 3, 100, [2, 2, 3]),
        (4, 3, 100, [1, 1, 2]),
        (2, 5, 100, [1, 1]),
        (6, 1, 6, [2, 2, 2]),
        (5, 1, 1, [1] * 5),
    ],
)
def test_work_items_are_even_and_as_many_as_requested(rows, least, most, sizes):
    made = objective(most=most, replicates=3)
    values = [made.task.space.values(p) for p in spots(rows, 2)]
    items = cut_work_items(made.task, values, 3, 1.0, least)
    assert [len(item.rows) for item in items] == sizes
    assert [row for item in items for row in item.rows] == list(range(rows))


@pytest.mark.slow
def test_a_colony_is_measured_at_its_own_first_step_of_that_size():
    """A design of half the pace in the same batch changes nothing, and each count is the first that
    is large enough."""
    made = objective("each grown again", Count(), replicates=2, cells=5)
    points = np.array([[0.0, 0.5], [1.0, 0.5]])
    found = made.evaluate(points)
    for row, point in enumerate(points):
        assert np.array_equal(made.evaluate(points[[row]]).losses[0], found.losses[row])
        for stream in range(2):
            scene = made.task.family.function(**made.task.space.values(point))
            *_, before, last = tf.simulate(scene, scene.bind(1, streams=[stream]).start(), cells=5)
            assert before.cells < 5 <= last.cells == found.cells[row, stream]


@pytest.mark.slow
def test_fast_replicates_stop_while_slow_ones_grow():
    parameter = [Parameter("make", 0.5, 1)]
    kept, regrown = (
        objective_of(uneven, parameter, Level(), cells=10, replicates=2, seed=2, replay=r)
        for r in (True, False)
    )
    growth_cache._kept.clear()
    found, points = kept.evaluate(np.array([[0.0], [0.5]])), np.array([[0.0], [0.5]])
    alike(found, regrown.evaluate(points))
    (recording,) = growth_cache._kept.values()
    # one replicate takes more than twice as long as the other, which would have 128 cells by then
    # without an end of its own
    assert len(recording.steps) == 24 and int(recording.state.counts.max()) < 2 * 10
    alike(kept.evaluate(points), found)


# --- random numbers, sizes, structure, reduction --------------------------------------------------


def test_replicates_share_random_numbers_and_streams_differ():
    made = objective()
    found = made.evaluate(spots(1, 2).repeat(2, 0))
    assert np.array_equal(found.losses[0], found.losses[1]) and len(set(found.losses[0])) == 3
    other = made.evaluate(spots(1, 2), streams=[2, 40, 0])
    assert (
        other.losses[0, [0, 2]].tolist() == found.losses[0, [2, 0]].tolist()
        and other.losses[0, 1] not in found.losses
    )
    loss, _ = alone(lit(**made.task.space.values(spots(1, 2)[0])), made.task.target, 40, cells=8)
    assert other.losses[0, 1] == loss


def test_another_seed_is_another_growth():
    point = spots(1, 2)
    assert not set(objective(seed=1).evaluate(point).losses[0]) & set(
        objective().evaluate(point).losses[0]
    )


def test_a_share_of_the_size_is_fewer_cells_and_less_time():
    made = objective(cells=16)
    found = made.evaluate(spots(2, 2), size=0.25)
    assert found.size == 0.25 and (found.cells >= 4).all() and (found.cells < 8).all()
    assert np.array_equal(found.losses, objective(cells=4).evaluate(spots(2, 2)).losses)
    assert made.task.end(0.01) == (2, None)
    timed = objective(cells=None, until=1.2)
    assert np.array_equal(
        timed.evaluate(spots(2, 2), size=0.5).losses,
        objective(cells=None, until=0.6).evaluate(spots(2, 2)).losses,
    )
    assert timed.task.end(0.001) == (None, DT)


@pytest.mark.slow
def test_whole_numbers_and_choices_build_scenes_of_their_own():
    parameters = [
        Parameter("genes", 1, 3, whole=True),
        Choice("promoter", ("weak", "strong")),
        Parameter("make", 1, 2),
    ]
    made = objective_of(built, parameters, Level("g0"), cells=3, replicates=2)
    points = np.array(
        [
            made.task.space.point({"genes": g, "promoter": p, "make": m})
            for g in (1, 3)
            for p in ("strong", "weak")
            for m in (1.0, 1.75)
        ]
    )
    found = made.evaluate(points)
    for row, point in enumerate(points):
        values = made.task.space.values(point)
        assert found.losses[row, 1] == alone(built(**values), Level("g0"), 1, cells=3)[0]
    # the levels are linear in their rates of production, and the first species is independent of
    # the number of species
    strong, weak = found.losses[[0, 1, 4, 5]], found.losses[[2, 3, 6, 7]]
    assert strong == pytest.approx(3 * weak, rel=1e-3)
    assert found.losses[:4] == pytest.approx(found.losses[4:], rel=1e-3)


@pytest.mark.parametrize(
    "reduce, expected",
    [
        ("mean", lambda x: x.mean(1)),
        ("worst", lambda x: x.max(1)),
        (0.5, lambda x: np.median(x, 1)),
        (1.0, lambda x: x.max(1)),
    ],
)
def test_replicates_become_one_loss(reduce, expected):
    found = objective(reduce=reduce).evaluate(spots(3, 2))
    assert np.array_equal(found.loss, expected(found.losses))


def test_fixed_arguments_reach_the_scene():
    made = objective_of(
        lit, [Parameter("decay", 0.5, 2)], Level(), fixed={"make": 3.0}, cells=6, replicates=1
    )
    assert (
        made.evaluate(np.array([[0.0]])).losses[0, 0]
        == alone(lit(3.0, 0.5), Level(), 0, cells=6)[0]
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ready_scenes_by_name_are_the_functions(dtype):
    parameter, options = (
        [Parameter("strength", 2, 8)],
        {"cells": 2, "dt": 0.1, "replicates": 2, "dtype": dtype},
    )
    named, given = (
        objective_of(s, parameter, Level("red"), **options)
        for s in ("toggle_switch", tf.scenes.toggle_switch)
    )
    assert np.array_equal(
        named.evaluate(np.array([[0.5]])).losses, given.evaluate(np.array([[0.5]])).losses
    )
    assert named.task.tried.recipe[0] == "toggle_switch"


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
    assert (found.losses[[0, 2]] == 1.5).all() and (found.cells[[0, 2]] == 0).all()
    assert set(found.reasons) == {(0, 0), (0, 1), (2, 0), (2, 1)}
    assert all("low ≤ high" in words for words in found.reasons.values())
    assert (
        np.array_equal(found.losses[[1, 3]], made.evaluate(points[[1, 3]]).losses)
        and (found.losses[[1, 3]] != 1.5).all()
    )
    assert made.colonies(points[0]) == []


@pytest.mark.slow
@pytest.mark.parametrize("replay", [True, False])
def test_rates_that_are_not_finite_fail_with_time_and_cell(replay):
    made = objective_of(
        fragile, [Parameter("make", 1, 10)], Level(), cells=8, replicates=2, replay=replay
    )
    points = np.array([[0.1], [0.9], [0.3]])
    found = made.evaluate(points)
    assert found.losses[1].tolist() == [1.5, 1.5] and set(found.reasons) == {(1, 0), (1, 1)}
    for words in found.reasons.values():
        assert words.startswith("at 0.2 h: circuit of cell 0: ") and "gfp" in words
    assert (
        np.array_equal(found.losses[[0, 2]], made.evaluate(points[[0, 2]]).losses)
        and (found.losses[[0, 2]] != 1.5).all()
    )
    assert (
        len(made.colonies(points[1])) == 0
        and sum(d.state.colonies for d in made.colonies(points[0])) == 2
    )


def test_a_division_too_short_fails_with_time_and_cell():
    made = objective_of(short, [Parameter("added", 0.2, 3)], Spread(), cells=6, replicates=1)
    found = made.evaluate(np.array([[0.0], [0.7]]))
    assert found.losses[0, 0] == 1.5 and found.cells[0, 0] == 0 and found.cells[1, 0] >= 6
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
    monkeypatch.setattr(rollout, "PATIENCE", 6.0)
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
    assert not any(bool(rollout._stuck(state.replace(time=t), most, since).any()) for t in steps)
    assert bool(rollout._stuck(state.replace(time=100.1), most, since).all())


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
    assert found.losses.tolist() == [[1.5]] and found.reasons[0, 0].startswith(
        "no cells remain at "
    )


# --- history --------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Diary(Target):
    """Notes time and number of cells after every step, and reads them back: the loss is the age of
    the colony."""

    def note(self, state):
        return torch.stack(
            [state.counts.double(), torch.full_like(state.counts, state.time, dtype=torch.float64)],
            1,
        )

    def loss(self, state, history=None):
        steps, count, k = history.shape
        assert (steps, count, k) == (state.step, state.colonies, 2)
        assert (
            torch.equal(history[-1, :, 0], state.counts.double())
            and (history[:-1, :, 0] <= history[1:, :, 0]).all()
        )
        assert torch.allclose(
            history[:, :, 1],
            (DT * torch.arange(1, steps + 1, dtype=torch.float64)).unsqueeze(1).expand(-1, count),
        )
        return history[-1, :, 1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_notes_belong_to_their_colony_though_others_end_at_other_times(kind):
    made = objective(kind, Diary(), cells=6, replicates=2)
    found = made.evaluate(spots(3, 2))
    assert len(set(found.losses.ravel())) > 1 and not found.reasons
    for stream in range(2):
        scene = made.task.family.function(**made.task.space.values(spots(3, 2)[1]))
        *_, state = tf.simulate(scene, scene.bind(1, streams=[stream]).start(), cells=6)
        assert found.losses[1, stream] == pytest.approx(state.time, abs=1e-9)


# --- bad input ------------------------------------------------------------------------------------


def plain(rate=1.0, longest=4.0):
    return tf.Scene(
        tf.Growth(rate=float(rate)),
        tf.Division(length=tf.Uniform(3.0, longest)),
        tf.Mechanics(dim=2),
        dt=DT,
    )


def ungrown(make=1.0):
    return tf.Scene(tf.Growth(), tf.Division(length=4.0), dt=DT)


@pytest.mark.parametrize(
    "given, words",
    [
        (
            {"parameters": [Parameter("made", 1, 2)]},
            "'made'.*a parameter of lit: make, decay.*Did you mean 'make'",
        ),
        ({"fixed": {"made": 1}}, "fixed = 'made'.*a parameter of lit"),
        ({"fixed": {"make": 1}}, "fixed = 'make'.*not searched as well"),
        ({"parameters": []}, "at least one"),
        ({"target": Level("yfp")}, "species = 'yfp'.*gfp"),
        ({"target": Stripe("gfp", at="border", width=4.0)}, "Stripe: the cells have no types"),
        ({"target": "stripe"}, "target = 'stripe'.*a Target"),
        ({"cells": None}, "needs an end: give cells=… or until="),
        ({"cells": 1}, "cells = 1.*whole number from 2"),
        ({"cells": 8.0}, "cells = 8.0.*whole number"),
        ({"until": 0.0}, "until = 0.0.*above 0"),
        ({"until": 1.02}, r"until = 1.02.*a whole number of steps of dt = 0.1 h"),
        ({"until": 0.01}, "until = 0.01.*a whole number of steps"),
        ({"dt": -1.0}, "dt = -1.0.*above 0"),
        ({"replicates": 0}, "replicates = 0.*whole number from 1"),
        ({"most": 0}, "most = 0.*whole number from 1"),
        ({"seed": -1}, "^seed = -1.*whole number from 0"),
        ({"reduce": "best"}, "reduce = 'best'.*\"worst\" or a quantile"),
        ({"reduce": 0.0}, "reduce = 0.0.*above 0"),
        ({"scene": lit()}, "a function from parameters to a tf.Scene.*def scene"),
        ({"scene": "colony"}, "scene = 'colony'.*one of microcolony"),
        ({"scene": lambda make: 3}, "scene = 3.*a function that returns a tf.Scene"),
        ({"scene": lambda make, other: lit()}, "'other'.*cannot be built"),
        (
            {"scene": paced, "parameters": [Parameter("rate", -1, 1)]},
            r"at least 0.*cannot be built with \{'rate': -1.0\}.*Narrow the bounds",
        ),
        (
            {"scene": plain, "parameters": [Parameter("rate", 0.5, 1)], "target": Spread()},
            "takes a plain number or a name there, use whole=True or a Choice",
        ),
        (
            {"scene": plain, "parameters": [Parameter("longest", 2.0, 4.0)], "target": Spread()},
            r"cannot be built with \{'longest': 2.0\}",
        ),
        (
            {"scene": ungrown, "parameters": [Parameter("make", 1, 2)], "target": Spread()},
            "growth waits for 'growth_rate'.*until=",
        ),
    ],
)
def test_bad_input_is_refused(given, words):
    options = {
        "scene": lit,
        "parameters": [Parameter("make", 1, 2)],
        "target": Level(),
        "cells": 8,
        **given,
    }
    with pytest.raises(tf.InputError, match=words):
        Task(**options)


@pytest.mark.parametrize(
    "given, words",
    [
        ({"points": np.zeros((2, 3))}, r"points = \(2, 3\).*\(n, 2\) coordinates in \[0, 1\]"),
        ({"points": np.zeros((0, 2))}, r"\(n, 2\) coordinates"),
        ({"points": np.array([[0.5, 1.1]])}, r"\[0, 1\]"),
        ({"points": np.array([[0.5, np.nan]])}, r"\[0, 1\]"),
        ({"size": 0.0}, "size = 0.0.*above 0"),
        ({"streams": [0, 0]}, "streams = .*different whole numbers"),
        ({"streams": [-1]}, "streams = .*from 0"),
        ({"streams": []}, "streams = .*at least one"),
    ],
)
def test_bad_points_are_refused(given, words):
    with pytest.raises(tf.InputError, match=words):
        objective().evaluate(**{"points": spots(1, 2), **given})


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
    monkeypatch.setattr("design.rollout.PATIENCE", 1.0)
    found = objective_of(
        resting, [Parameter("make", 0.5, 2.0)], Level(), until=5.0, replicates=1
    ).evaluate(np.array([[0.5]]))
    assert not found.reasons and found.loss[0] < 1.5


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
