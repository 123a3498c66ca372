"""The objective: the loss of a colony does not depend on its batch."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scored import KINDS, alike, objective
from searching import (
    DT,
    Count,
    Level,
    Spread,
    alone,
    built,
    lit,
    objective_of,
    paced,
    spots,
    uneven,
)

import torchfilm as tf
from design import Choice, Parameter, Stripe, Target, Task, growth_cache
from design.scoring import cut_work_items

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
        objective_of(uneven, parameter, Level(), cells=10, replicates=2, seed=10, replay=r)
        for r in (True, False)
    )
    growth_cache._kept.clear()
    found, points = kept.evaluate(np.array([[0.0], [0.5]])), np.array([[0.0], [0.5]])
    alike(found, regrown.evaluate(points))
    (recording,) = growth_cache._kept.values()
    # one replicate takes more than three times as long as the other, which would have thousands of
    # cells by then without an end of its own
    assert len(recording.steps) == 37 and int(recording.state.counts.max()) < 2 * 10
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
        ({"reduce": "best"}, "reduce = 'best'.*\"survivors\" or a quantile"),
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
