"""The loop: what it does when a solve fails, who is called, restarts and batches bit for bit."""

from __future__ import annotations

import gc
import math
import warnings
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from running import alone, scene_of

import torchfilm as tf
from torchfilm.physics.problem import CONVERGED
from torchfilm.reports import Concern
from torchfilm.state import PER_CELL


def assert_same(a: tf.State, b: tf.State) -> None:
    for name in (*PER_CELL, "colony_id", "next_uid"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    for name, value in a.fields.items():
        assert torch.equal(value, b.fields[name]), name
    assert (a.step, a.time) == (b.step, b.time)


# --- failures -------------------------------------------------------------------------------------


def lonely_and_crowded() -> tf.Cells:
    """Colonies 0 and 2: one cell, at rest. Colony 1: a heap that no solve settles in one
    iteration."""
    heap = [[0.3 * k, 0.45 * (k % 3)] for k in range(8)]
    position = [[0.0, 0.0], *heap, [0.0, 0.0]]
    axis = [[1.0, 0.0], *([math.cos(k), math.sin(k)] for k in range(8)), [1.0, 0.0]]
    return tf.Cells(position, axis, 2.0, colony=[0] + [1] * 8 + [2])


def failing() -> tuple[tf.Scene, tf.State]:
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Mechanics(dim=2, max_iterations=1, tolerance=1e-6), dt=0.1
    )
    return scene, scene.bind(cells=lonely_and_crowded()).start()


def test_a_failed_solve_is_raised_and_names_the_colony():
    scene, state = failing()
    with pytest.raises(
        tf.SimulationError, match=r"1 of 3 colonies.*\n.*colony 1 \(8 cells\).*iteration limit"
    ) as caught:
        list(tf.simulate(scene, state, until=1.0))
    assert caught.value.colonies == (1,)
    assert "colony 0" not in str(caught.value)


def test_a_selected_colony_is_named_by_its_own_id():
    scene, state = failing()
    with pytest.raises(tf.SimulationError) as caught:
        list(tf.simulate(scene, state.select([2, 1]), until=1.0))
    assert caught.value.colonies == (1,)


def test_all_failed_colonies_are_named_at_once():
    scene, _ = failing()
    heap = lonely_and_crowded()
    three = scene.bind(3, cells=tf.Cells(heap.position[1:9], heap.axis[1:9], 2.0)).start()
    with pytest.raises(tf.SimulationError, match="3 of 3") as caught:
        list(tf.simulate(scene, three, until=1.0))
    assert caught.value.colonies == (0, 1, 2)


def test_dropping_a_failed_colony_goes_on_with_the_others(tmp_path):
    scene, state = failing()
    states = list(
        tf.simulate(scene, state, until=1.0, on_failure="drop", record=tmp_path / "run.h5")
    )
    assert (
        len(states) == 10
        and states[0].counts.tolist() == [1, 0, 1]
        and states[-1].counts.tolist() == [1, 0, 1]
    )
    (note,) = states[0].ended
    assert (
        note.fate == "failed"
        and note.colony_id.tolist() == [1] * 8
        and note.uid.tolist() == list(range(8))
    )
    others = list(tf.simulate(scene, state.select([0, 2]), until=1.0))[-1]
    assert torch.equal(states[-1].length, others.length), (
        "the others go on as if it had not been there"
    )
    with tf.Results(tmp_path / "run.h5") as results:
        found = results.lineage()
    assert found.fate.tolist() == ["alive"] + ["failed"] * 8 + ["alive"]
    assert np.array_equal(np.isnan(found.ended), found.fate == "alive")
    assert np.allclose(found.ended[1:-1], states[0].time)


def with_nan(state: tf.State, colony: int) -> tf.State:
    position = state.position.clone()
    position[int(torch.nonzero(state.colony == colony)[0]), 0] = math.nan
    return state.replace(position=position)


@pytest.mark.parametrize("contacts", ["bilateral", "one-sided"])
def test_a_colony_that_is_not_finite_fails_alone(contacts, dtype):
    """NaN in one of three colonies: it is named, and dropped the other two go on to the same bits
    as without it."""
    scene = scene_of(contacts=contacts)
    good = list(tf.simulate(scene, scene.bind(3, dtype=dtype).start(), until=2.0))[-1]
    assert (good.counts >= 4).all()
    with pytest.raises(tf.SimulationError, match=r"colony 1 .*not finite") as caught:
        list(tf.simulate(scene, with_nan(good, 1), until=2.5))
    assert caught.value.colonies == (1,)
    said = r"colony 1 .* failed in step .* and the run goes on without its cells: .*not finite"
    with pytest.warns(RuntimeWarning, match=said):
        dropped = list(tf.simulate(scene, with_nan(good, 1), until=2.5, on_failure="drop"))[-1]
    assert dropped.counts[1] == 0
    alone = list(tf.simulate(scene, good.select([0, 2]), until=2.5))[-1]
    assert_same(dropped.select([0, 2]), alone.select([0, 1]))
    assert torch.isfinite(dropped.position).all()


def too_short(*others: tf.Effect) -> tuple[tf.Scene, tf.State]:
    """Three colonies of a long cell and a short one, all told to divide; only in colony 1 is the
    short one too short. A cell of colony 0 has 2 µm."""
    cells = tf.Cells(
        [[0.0, 0.0], [9.0, 0.0]] * 3,
        [0.0, 1.0],
        [3.0, 2.0, 3.0, 0.6, 3.0, 1.5],
        colony=[0, 0, 1, 1, 2, 2],
    )
    scene = tf.Scene(tf.Division(), *others, founders=cells, dt=0.1)
    state = scene.bind().start()
    return scene, state.with_fields(divide_flag=torch.ones_like(state.divide_flag))


def test_a_cell_too_short_to_divide_is_raised_and_names_the_colony():
    scene, state = too_short(tf.Growth(rate=0.1))
    with pytest.raises(
        tf.SimulationError,
        match=(
            r"1 of 3 colonies.*\n.*colony 1 \(2 cells\): cell 1.*0\.6 µm.*1 µm.*\n.*[Ll]onger"
            r" cells.*on_failure"
        ),
    ) as caught:
        list(tf.simulate(scene, state, until=1.0))
    assert caught.value.colonies == (1,)
    with pytest.raises(tf.SimulationError, match="cell 1 is due") as caught:
        list(tf.simulate(scene, state.select([2, 1]), until=1.0))
    assert caught.value.colonies == (1,)


@pytest.mark.parametrize(
    "others",
    [(tf.Growth(rate=0.1),), (tf.Growth(rate=0.1), tf.Mechanics(dim=2))],
    ids=["alone", "with contacts"],
)
def test_dropping_a_colony_that_cannot_divide_goes_on_with_the_others(tmp_path, others):
    scene, state = too_short(*others)
    states = list(
        tf.simulate(scene, state, until=1.0, on_failure="drop", record=tmp_path / "run.h5")
    )
    assert (
        len(states) == 10
        and states[0].counts.tolist() == [4, 0, 4]
        and states[-1].counts.tolist() == [4, 0, 4]
    )
    divided, failed = states[0].ended
    assert divided.fate == "divided" and divided.colony_id.tolist() == [0, 0, 2, 2]
    assert (
        failed.fate == "failed"
        and failed.colony_id.tolist() == [1, 1]
        and failed.uid.tolist() == [0, 1]
    ), "nobody divides where one cannot"
    without = list(tf.simulate(scene, state.select([0, 2]), until=1.0))[-1]
    assert_same(states[-1].select([0, 2]), without.select([0, 1]))
    with tf.Results(tmp_path / "run.h5") as results:
        found = results.lineage()
    assert found.fate[:6].tolist() == [
        "divided",
        "divided",
        "failed",
        "failed",
        "divided",
        "divided",
    ]


def test_failures_of_two_kinds_are_raised_together():
    """Colony 0 cannot divide, colony 1 cannot be solved, colony 2 neither."""
    heap = lonely_and_crowded()
    cells = tf.Cells(
        [[-9.0, 0.0], *heap.position[1:9], [-9.0, 0.0], *heap.position[1:9]],
        [[1.0, 0.0], *heap.axis[1:9], [1.0, 0.0], *heap.axis[1:9]],
        [0.6] + [2.0] * 8 + [0.6] + [2.0] * 8,
        colony=[0] + [1] * 8 + [2] * 9,
    )
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(),
        tf.Mechanics(dim=2, max_iterations=1, tolerance=1e-6),
        founders=cells,
        dt=0.1,
    )
    state = scene.bind().start()
    state = state.with_fields(divide_flag=state.length < 1)
    with pytest.raises(tf.SimulationError, match=r"3 of 3 colonies") as caught:
        list(tf.simulate(scene, state, until=1.0))
    assert caught.value.colonies == (0, 1, 2)
    said = str(caught.value)
    assert (
        said.count("caps of its daughters") == 2
        and said.count("iteration limit") == 2
        and "smaller dt" in said
        and "longer cells" in said
    )


def test_a_failed_step_says_what_may_help():
    scene, state = failing()
    with pytest.raises(tf.SimulationError, match=r"smaller dt.*on_failure"):
        list(tf.simulate(scene, state, until=1.0))


def test_a_healthy_run_reports_every_colony_converged():
    scene = scene_of()
    for state in tf.simulate(scene, scene.bind(4).start(), until=2.0):
        report = state.reports["mechanics"]
        assert (report.status == CONVERGED).all() and report.status.shape == (4,)


# --- observers and timings ------------------------------------------------------------------------


def test_observers_see_the_first_state_and_every_step_in_order():
    scene, seen = alone(), []
    first = scene.bind().start()
    yielded = list(
        tf.simulate(
            scene,
            first,
            until=0.3,
            observers=[lambda s: seen.append(("a", s)), lambda s: seen.append(("b", s))],
        )
    )
    assert [name for name, _ in seen] == ["a", "b"] * 4
    assert [s for name, s in seen if name == "a"] == [first, *yielded]


def test_an_observers_error_closes_the_file(tmp_path):
    def fail(state):
        if state.step == 2:
            raise RuntimeError("no luck")

    scene = alone()
    with pytest.raises(RuntimeError, match="no luck"):
        list(
            tf.simulate(
                scene, scene.bind().start(), until=1.0, record=tmp_path / "run.h5", observers=[fail]
            )
        )
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.steps.tolist() == [0, 2], "what was done until then is kept"


def test_timings_are_filled(tmp_path):
    timings, scene = tf.Timings(), scene_of()
    assert repr(timings) == "Timings()"
    list(
        tf.simulate(
            scene, scene.bind().start(), until=0.5, timings=timings, record=tmp_path / "run.h5"
        )
    )
    assert set(timings.seconds) == {"division", "growth", "mechanics", "recording"}
    assert all(0 < s < 60 for s in timings.seconds.values())
    assert "recording: " in repr(timings) and " s)" in repr(timings)


def test_nothing_runs_before_the_first_state_is_asked_for(tmp_path):
    scene = alone()
    run = tf.simulate(scene, scene.bind().start(), until=1.0, record=tmp_path / "run.h5")
    assert not (tmp_path / "run.h5").exists()
    next(run)
    assert (tmp_path / "run.h5").exists()


# --- restarts and batches -------------------------------------------------------------------------


def every_step(scene: tf.Scene, state: tf.State, until: float) -> list[tf.State]:
    return [state, *tf.simulate(scene, state, until=until)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{}, {"contacts": "one-sided"}, {"dim": 3}], ids=["default", "one-sided", "3-D"]
)
def test_going_on_from_any_state_is_bit_for_bit_the_same(options):
    """From some steps, those right after a division included; through a fresh scene, as after a
    restart."""
    scene = scene_of(**options)
    states = every_step(scene, scene.bind(2, seed=5).start(), 3.0)
    assert states[-1].cells > 12
    born = [s.step for s in states[:-1] if s.births]
    assert len(born) > 4
    for start in sorted({10, 25, 40, 55, *born})[:8]:
        again = list(tf.simulate(scene_of(**options), states[start], until=3.0))[-1]
        assert_same(again, states[-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{}, {"contacts": "one-sided"}, {"dim": 3}], ids=["default", "one-sided", "3-D"]
)
def test_one_by_one_equals_the_batch_bit_for_bit(options, dtype):
    scene = scene_of(**options)
    first = scene.bind(4, seed=2, dtype=dtype).start()
    batch = list(tf.simulate(scene, first, until=2.5))[-1]
    assert (batch.counts > 4).all()
    for k in range(4):
        alone = list(tf.simulate(scene, first.select([k]), until=2.5))[-1]
        assert_same(alone, batch.select([k]))
        for name in ("iterations", "residual", "passes", "substeps"):
            assert torch.equal(
                getattr(alone.reports["mechanics"], name)[0],
                getattr(batch.reports["mechanics"], name)[k],
            ), name


def test_the_order_of_colonies_does_not_matter():
    scene = scene_of()
    first = scene.bind(4, seed=2).start()
    batch = list(tf.simulate(scene, first, until=2.0))[-1]
    shuffled = list(tf.simulate(scene, first.select([2, 0, 3, 1]), until=2.0))[-1]
    assert_same(shuffled.select([1, 3, 0, 2]), batch.select([0, 1, 2, 3]))


def test_a_smaller_batch_is_the_beginning_of_a_larger_one():
    """Colony 0 … 2 of a batch of 5 are those of a batch of 3 with the same seed."""
    scene = scene_of()
    few, many = (
        list(tf.simulate(scene, scene.bind(n, seed=3).start(), until=2.0))[-1] for n in (3, 5)
    )
    assert_same(many.select([0, 1, 2]), few.select([0, 1, 2]))


def test_the_same_seed_twice_and_another_seed():
    scene = scene_of()
    a, b, c = (
        list(tf.simulate(scene, scene.bind(2, seed=s).start(), until=2.0))[-1] for s in (1, 1, 2)
    )
    assert_same(a, b)
    assert not torch.equal(a.length[:2], c.length[:2])


def test_colonies_of_one_batch_differ():
    scene = scene_of()
    state = list(tf.simulate(scene, scene.bind(2).start(), until=2.0))[-1]
    assert not torch.equal(state.length[state.colony == 0][:2], state.length[state.colony == 1][:2])


def test_a_run_that_may_never_end_is_reported():
    """Found in use: a design whose cells stop growing below the number at which the run ends; the
    other colony would grow without end."""
    rate = torch.tensor([1e-4, 1.0])
    scene = tf.Scene(tf.Growth(rate=rate), tf.Division(length=100.0), dt=0.001)
    run = tf.simulate(scene, scene.bind(2).start(), cells=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for _ in range(1050):
            next(run)
    with pytest.warns(
        RuntimeWarning,
        match=r"colony 0: larger by less than a hundredth than 1000 .* fewer than the 2 cells",
    ) as told:
        for _ in range(100):
            next(run)
    assert [w.filename for w in told] == [__file__]


@dataclass(frozen=True)
class Worried:
    """A report that all is well, but for colony 1."""

    status: torch.Tensor

    def concerns(self):
        text = lambda ids, where: f"colony {ids[where].tolist()} looks odd"
        return [Concern("odd", torch.tensor([False, True, False]), 3, text)]


@dataclass(frozen=True)
class Worry(tf.Effect):
    stage, title = 15, "worry"

    def step(self, state, dt, values):
        return state.replace(reports={"worry": Worried(torch.zeros_like(state.counts))})


def test_what_a_report_is_concerned_about_is_warned_of_once_at_the_users_line():
    with pytest.warns(RuntimeWarning) as told:
        for _ in tf.simulate(tf.Scene(Worry(), dt=0.1), until=1.0, colonies=3):
            pass
    (one,) = (w for w in told if w.category is RuntimeWarning)
    assert str(one.message) == "step 3 (t = 0.3 h): colony [1] looks odd"
    assert one.filename == __file__


def test_a_run_of_which_no_state_is_taken_is_warned_of(tmp_path):
    scene = tf.scenes.microcolony()
    with pytest.warns(RuntimeWarning, match=r"has simulated nothing.*for state in tf\.simulate"):
        states = tf.simulate(scene, until=0.1, record=tmp_path / "run.h5")
        assert "not begun" in repr(states)
        del states
        gc.collect()
    for taken in (next, list, lambda states: states.close()):
        taken(tf.simulate(scene, until=0.1))  # any warning is an error here
