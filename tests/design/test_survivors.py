"""Data of colonies that lived on, where others died out: reduce="survivors"."""

from __future__ import annotations

import math

import numpy as np
import pytest

import torchfilm as tf
from design import Measured, Observed, Parameter, Search, Sobol, Task, infer
from design.simulations import about, simulate_points
from design.targets.base import WORST

UNTIL = 1.5
GROUPS = ("extent", "density", "alignment")
KILL = [Parameter("kill", 0.1, 2.0)]


def culture(kill=0.9):
    return tf.Scene(
        tf.Growth(rate=1.3), tf.Division(length=tf.LogNormal(3.0, 0.1)), tf.Lysis(rate=kill),
        dim=2, dt=0.05,
    )  # fmt: skip


def cells(state):
    return state.counts.double()


@pytest.fixture(scope="module")
def living():
    """The state of colonies at the end, and the data of those that lived on."""
    state = tf.simulate(culture(), until=UNTIL, colonies=20, seed=4).last()
    alive = state.select(state.colony_id[state.counts > 0].tolist())
    assert 0 < alive.colonies < 20
    return state, Observed.from_state(alive).without(*GROUPS)


def test_the_loss_is_the_mean_of_those_that_did_not_fail(living):
    task = Task(culture, KILL, living[1], replicates=3, reduce="survivors")
    losses = np.array([[1.0, WORST, 3.0], [WORST] * 3, [2.0, 4.0, 6.0]])
    assert task.reduced(losses).tolist() == [2.0, WORST, 4.0]
    shares = task.shares(losses)
    assert shares.tolist() == [[0.5, 0.0, 0.5], [0.0] * 3, [1 / 3] * 3]
    two = Task(
        culture, KILL, targets=[Measured({"n": cells}, {"n": 4.0}, {"n": 1.0})] * 2,
        until=1.0, replicates=2, reduce="survivors",
    )  # fmt: skip
    goals = np.array([[[1.0, 2.0], [math.nan] * 2], [[math.nan] * 2] * 2])
    found = two.reduced_goals(goals)
    assert found[0].tolist() == [1.0, 2.0] and np.isnan(found[1]).all()
    with pytest.raises(tf.InputError, match=r"reduce = 'survivor'.*\"survivors\" or"):
        Task(culture, KILL, living[1], reduce="survivor")


def test_a_search_leaves_colonies_that_died_out_and_says_so(living):
    data = living[1]
    options = {"replicates": 20, "seed": 4, "method": Sobol(batch=4), "finals": None}
    found = Search(culture, KILL, data, reduce="survivors", **options)
    mean = Search(culture, KILL, data, **options)
    best, worse = found.run(colonies=160), mean.run(colonies=160)
    plain = mean.study.entries[0].losses
    assert (plain == WORST).any(1).all()
    for entry in found.study.entries:
        lived = entry.losses < WORST
        expected = [row[ok].mean() for row, ok in zip(entry.losses, lived, strict=True)]
        np.testing.assert_allclose(entry.loss, expected)
    assert best.loss < 10.0 and worse.loss > 1e6
    assert "left out: no cells remain" in str(best.table())
    assert 'reduce="survivors" leaves such out' in str(worse.table())
    assert 'reduce="survivors"' not in str(best.table())


def test_inference_averages_as_many_of_those_that_live_as_were_observed(living):
    data = living[1]
    task = Task(culture, KILL, data, replicates=20, reduce="survivors", seed=4, replay=False)
    found = simulate_points(task, np.array([[0.5]]), 0)
    again = culture(task.space.values(np.array([0.5]))["kill"])
    end = tf.simulate(again, again.bind(20, streams=list(range(20)), seed=4).start(), until=UNTIL)
    end = end.last()
    alive = np.flatnonzero((end.counts > 0).numpy())[: data.colonies]
    assert 0 < len(alive) < 20
    each = data.statistics(end.select(end.colony_id[alive].tolist())).numpy()
    np.testing.assert_allclose(found.statistics[0], each.mean(0), rtol=1e-6)
    assert found.cells[0] == pytest.approx(float(end.counts[end.counts > 0].double().mean()))
    assert not found.reasons
    pair = end.select(end.colony_id[alive[:2]].tolist())
    few = Observed.from_state(pair).without(*GROUPS)
    task = Task(culture, KILL, few, replicates=20, reduce="survivors", seed=4, replay=False)
    of_two = simulate_points(task, np.array([[0.5]]), 0).statistics[0]
    np.testing.assert_allclose(of_two, few.statistics(pair).numpy().mean(0), rtol=1e-6)


def test_a_design_of_which_none_lives_has_failed(living):
    task = Task(
        culture, [Parameter("kill", 0.1, 80.0)], living[1], replicates=5, reduce="survivors",
        replay=False,
    )  # fmt: skip
    found = simulate_points(task, np.array([[1.0], [0.0]]), 0)
    assert list(found.reasons) == [0] and found.reasons[0].startswith("no cells remain")
    assert np.isnan(found.statistics[0]).all() and np.isfinite(found.statistics[1]).all()


def test_a_colony_that_fails_otherwise_is_not_left_out(living):
    def broken(kill=0.9):
        def breaks(u, state, p, cell):
            return {"m": u.m * u.m}  # infinite after some 0.3 h

        circuit = tf.Circuit(breaks, species="m", initial={"m": 4.0}, method="rk4")
        return tf.Scene(*culture(kill).effects, circuit, dim=2, dt=0.05)

    task = Task(broken, KILL, living[1], replicates=5, reduce="survivors", replay=False)
    found = simulate_points(task, np.array([[0.0]]), 0)
    assert "m" in found.reasons[0] and "no cells" not in found.reasons[0]


def test_simulations_of_survivors_are_others(living):
    from design.prior import Prior

    one, other = (
        Task(culture, KILL, living[1], replicates=5, reduce=reduce, replay=False)
        for reduce in ("mean", "survivors")
    )
    ways = [about(task, Prior(task.space)) for task in (one, other)]
    assert "reduce" not in ways[0] and ways[1].pop("reduce") == "survivors"
    assert ways[0] == ways[1]


def test_what_inference_says_of_deaths(living):
    pytest.importorskip("sbi")
    data = living[1]
    with pytest.raises(tf.InputError, match=r"reduce = 'worst'.*'mean', 'survivors'"):
        infer(culture, KILL, data, reduce="worst")
    with pytest.raises(tf.InputError, match=r"no cells remain\. colonies.*reduce=\"survivors\""):
        infer(culture, KILL, data, simulations=50, progress=False)
    options = {"reduce": "survivors", "simulations": 60, "epochs": 5, "flows": 1, "replicates": 20}
    found = infer(culture, KILL, data, progress=False, **options)
    assert 0.1 < found.mean["kill"] < 2.0
    assert 'reduce="survivors"' not in str(found.table())
