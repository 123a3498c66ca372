"""What each search method finds, and at what cost."""

from __future__ import annotations

import math
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
import pytest
from asking import SPACES, Room, begun, ellipsoid, evaluate, follow, sphere

from design.methods import CMAES, Bayesian, Exhaustive, Racing, Sobol
from design.methods.base import sobol_points
from design.methods.bayesian import tamed
from torchfilm.tools.checks import InputError

# Sobol


def test_sobol_points_are_even_in_every_dimension():
    points = begun(Sobol(batch=64), Room((None,) * 6), seed=3).ask().points
    for axis in range(6):
        assert sorted((points[:, axis] * 64).astype(int)) == list(range(64))


@pytest.mark.parametrize("batch", [1, 3, 16, 50])
def test_batches_of_any_size_cut_one_sequence(batch):
    whole = begun(Sobol(batch=100), SPACES["cube"], seed=1).ask().points
    parts = np.concatenate(
        [
            b.points
            for b, _ in follow(
                begun(Sobol(batch=batch), SPACES["cube"], seed=1), sphere, -(-100 // batch)
            )
        ]
    )
    assert (parts[:100] == whole).all()


# CMA-ES


@pytest.mark.parametrize("seed", range(4))
def test_cmaes_beats_sobol_on_an_ellipsoid_by_orders_of_magnitude(seed):
    space = Room((None,) * 5)
    plain = evaluate(begun(Sobol(), space, seed), ellipsoid, 800).min()
    assert evaluate(begun(CMAES(), space, seed), ellipsoid, 800).min() < 1e-2 * plain
    assert evaluate(begun(CMAES(noisy=False), space, seed), ellipsoid, 800).min() < 1e-6 * plain


@pytest.mark.parametrize("seed", range(3))
def test_cmaes_in_one_dimension(seed):
    assert evaluate(begun(CMAES(), Room((None,)), seed), sphere, 400).min() < 1e-10


@pytest.mark.parametrize("seed", range(3))
def test_cmaes_finds_the_best_of_levels_among_hills(seed):
    space = Room((11, 9, 2, None))

    def hills(points: np.ndarray) -> np.ndarray:
        """Rastrigin's over the levels 7, 2 and 1, and a bowl: 0 there, 0.02 or more with a wrong
        level."""
        away = (np.floor(points[:, :3] * (11, 9, 2)) - (7, 2, 1)) / (2, 2, 1)
        return (0.1 * away**2 + 0.05 * (1 - np.cos(2 * np.pi * away))).sum(1) + (
            points[:, 3] - 0.8
        ) ** 2

    assert evaluate(begun(CMAES(), space, seed), hills, 1200).min() < 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_noise_does_not_make_the_cloud_collapse(seed):
    """Noise of 0.1 on losses of up to 1: were the width to shrink as without noise, it were 1e-3
    after 100 batches."""
    noise = np.random.default_rng(seed)
    given = begun(CMAES(restarts=False, noisy=True), Room((None,) * 5), seed)
    history = follow(
        given, lambda points: ellipsoid(points) + 0.1 * noise.standard_normal(len(points)), 100
    )
    late = np.concatenate([batch.points for batch, _ in history[-10:]])
    assert late.std(0).mean() > 0.02
    assert ellipsoid(late.mean(0, keepdims=True))[0] < 0.05  # half the noise of a single loss


def test_a_converged_cloud_is_followed_by_one_of_twice_the_population_up_to_sixteen_times():
    given = begun(CMAES(population=4, noisy=False), SPACES["line"])
    sizes, began = [], []
    for _ in range(240):
        began.append(given.fresh)
        sizes.append(len(follow(given, sphere, 1)[0][0].points))
    assert list(dict.fromkeys(sizes)) == [4, 8, 16, 32, 64] and sizes == sorted(sizes)
    # another cloud, but no larger
    assert sum(b and n == 64 for b, n in zip(began, sizes, strict=True)) >= 2
    lone = follow(
        begun(CMAES(population=4, noisy=False, restarts=False), SPACES["line"]), sphere, 240
    )
    assert {len(batch.points) for batch, _ in lone} == {4}


def test_a_cloud_in_which_all_fails_ends_without_doubling():
    given = begun(CMAES(population=8), SPACES["cube"])
    began = []
    for _ in range(60):
        batch = given.ask()
        assert len(batch.points) == 8
        began.append(given.fresh)
        given.tell(batch, sphere(batch.points) if given.fresh else np.full(8, 1.5))
    assert sum(began) >= 5


def test_the_cloud_begins_at_the_best_of_the_first_points():
    given = begun(CMAES(population=400, sigma=0.01), SPACES["cube"])
    (first, loss), (second, _) = follow(given, ellipsoid, 2)
    assert np.abs(second.points.mean(0) - first.points[loss.argmin()]).max() < 5 * 0.01 / math.sqrt(
        400
    )


# Racing


def test_a_race_grows_all_small_and_the_best_in_full():
    given = begun(
        Racing(inner=CMAES(population=9), sizes=(0.1, 0.5, 1.0), keep=1 / 3, small=2),
        SPACES["cube"],
        replicates=5,
    )
    history = follow(given, sphere, 7)[4:]  # after the first race, from which the cloud begins
    assert [(len(b.points), b.size, b.replicates) for b, _ in history] == [
        (81, 0.1, 2),
        (27, 0.5, 2),
        (9, 1.0, None),
    ]
    for (before, loss), (after, _) in pairwise(history):
        best = np.sort(loss)[: len(after.points)]
        assert (np.sort(sphere(after.points)) == best).all()
        assert {row.tobytes() for row in after.points} <= {row.tobytes() for row in before.points}


@pytest.mark.parametrize(
    ("settings", "race"),
    [
        ({"first": 4}, [(36, 0.25, 1), (12, 1.0, 1), (4, 1.0, None)]),
        ({"first": 2, "small": 3}, [(18, 0.25, 3), (6, 1.0, None)]),
        # no more than the cloud needs
        ({"first": 4, "small": 3}, [(27, 0.25, 3), (9, 1.0, None)]),
        ({"first": 9}, [(27, 0.25, 1), (9, 1.0, None)]),
    ],
)
def test_where_a_cloud_begins_few_are_grown_with_all_replicates(settings, race):
    inner = CMAES(population=9, sigma=0.01)
    given = begun(Racing(inner=inner, keep=1 / 3, **settings), SPACES["cube"], replicates=3)
    history = follow(given, sphere, len(race))
    assert [(len(b.points), b.size, b.replicates) for b, _ in history] == race
    best, loss = history[-1]
    after = given.ask()
    assert len(after.points) == 27
    assert np.abs(after.points.mean(0) - best.points[loss.argmin()]).max() < 0.02


def test_the_inner_method_learns_only_from_full_colonies(monkeypatch):
    inner, heard = CMAES(population=6), []
    take = inner.take
    monkeypatch.setattr(
        inner, "take", lambda rows, loss: [heard.append(loss.copy()), take(rows, loss)]
    )
    given = begun(Racing(inner=inner), SPACES["cube"])
    for _ in range(21):
        batch = given.ask()
        small = batch.size < 1 or batch.replicates is not None
        given.tell(batch, ellipsoid(batch.points) + (100 if small else 0))
    assert [len(loss) for loss in heard] == [5] + [6] * 9
    assert max(loss.max() for loss in heard) < 100


def test_no_more_replicates_than_there_are():
    assert begun(Racing(small=3), SPACES["cube"], replicates=2).ask().replicates == 2


def race(given, seed: int, *, shift: float, target: float, budget: float) -> float:
    """Cost in full designs until a design within `target` is among those grown in full. Small
    colonies are best `shift` away, replicates differ by 0.02."""
    begun(given, Room((None,) * 8), seed)
    noise, used = np.random.default_rng(seed), 0.0
    while used < budget:
        batch = given.ask()
        copies = batch.replicates or 4
        used += len(batch.points) * batch.size * copies / 4
        loss = ellipsoid(batch.points, 0.3 if batch.size == 1 else 0.3 + shift) + 0.02 / math.sqrt(
            copies
        ) * noise.standard_normal(len(batch.points))
        given.tell(batch, loss)
        if batch.size == 1 and ellipsoid(batch.points).min() <= target:
            return used
    return budget


def test_racing_costs_half_where_small_colonies_are_informative():
    plain = [
        race(CMAES(noisy=True), seed, shift=0.05, target=0.04, budget=400) for seed in range(6)
    ]
    raced = [
        race(Racing(inner=CMAES(noisy=True)), seed, shift=0.05, target=0.04, budget=400)
        for seed in range(6)
    ]
    assert sum(raced) < 0.5 * sum(plain)


@pytest.mark.parametrize(("agree", "races"), [(0.1, False), (-1.0, True)])
def test_races_stop_where_small_colonies_mislead(agree, races):
    """Small colonies say the opposite: Kendall's tau is -1, and 1 · 0.8ⁿ - (1 - 0.8ⁿ) falls below
    0.1 after three races."""
    given = begun(Racing(inner=Sobol(batch=6), agree=agree), SPACES["cube"])
    sizes = []
    for _ in range(12):
        batch = given.ask()
        sizes.append(batch.size)
        given.tell(batch, sphere(batch.points) * (1 if batch.size == 1 else -1))
    assert sizes == [0.25, 1.0] * 6 if races else sizes == [0.25, 1.0] * 3 + [1.0] * 6


def test_no_race_follows_one_in_which_all_small_colonies_were_alike():
    """As where the pattern does not fit into them."""
    given = begun(Racing(inner=Sobol(batch=6)), SPACES["cube"])
    sizes = []
    for _ in range(5):
        batch = given.ask()
        sizes.append(batch.size)
        loss = sphere(batch.points)
        given.tell(batch, loss if batch.size == 1 else np.ones_like(loss))
    assert sizes == [0.25, 1.0, 1.0, 1.0, 1.0]


def test_a_new_cloud_trusts_small_colonies_again():
    inner = CMAES(population=6, noisy=False)
    given = begun(Racing(inner=inner), SPACES["line"])
    drawn, new = [], True
    for _ in range(400):
        fresh = inner.fresh
        batch = given.ask()
        if new:
            drawn.append((fresh, batch.size))
        new = batch.size == 1.0 and batch.replicates is None
        given.tell(batch, sphere(batch.points) * (1 if new else -1))
    plain = drawn.index((False, 1.0))
    assert (True, 0.25) in drawn[plain:] and (True, 1.0) not in drawn


# Bayesian


def test_losses_far_above_the_median_are_limited():
    assert tamed(np.array([0.0, 1.0, 100.0])).tolist() == [0.0, 1.0, 3.0]


def test_without_botorch_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr("design.methods.bayesian.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'pip install -e "\.\[bayes\]"'):
        Bayesian()


def test_without_cma_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr("design.methods.cmaes.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'pip install -e "\.\[design\]"'):
        CMAES()


if find_spec("botorch"):

    @pytest.mark.parametrize("seed", range(2))
    def test_bayesian_finds_a_smooth_bowl_in_few_points(seed):
        space = Room((None,) * 4)
        plain = evaluate(begun(Sobol(), space, seed), ellipsoid, 42).min()
        assert evaluate(begun(Bayesian(), space, seed), ellipsoid, 42).min() < 0.1 * plain

    def test_after_known_designs_the_spare_points_are_others():
        given = begun(Bayesian(batch=6), SPACES["cube"], seed=3)
        known = sobol_points(SPACES["cube"], 3, 0, 8)
        given.know(known, np.full(8, 1.1))  # all equal: there is no model
        assert not {p.tobytes() for p in given.ask().points} & {p.tobytes() for p in known}

    def test_a_race_with_a_model_needs_fewer_designs_than_one_with_a_cloud():
        """In eight dimensions, where small colonies are best somewhere else."""
        made = Bayesian(batch=6), CMAES(population=24, sigma=0.5)
        model, cloud = (race(Racing(inner=m), 0, shift=0.05, target=0.04, budget=150) for m in made)
        assert model < 0.75 * cloud

    def test_bayesian_tries_no_design_twice_while_others_are_left():
        """Of 12 designs it tries all before it tries one again, but for what its first batch of
        Sobol points repeats."""
        given = begun(Bayesian(batch=2, first=4), SPACES["levels"])
        first, *others = [batch.points for batch, _ in follow(given, ellipsoid, 5)]
        distinct = {row.tobytes() for row in np.concatenate([first, *others])}
        assert len(distinct) == 8 + len({row.tobytes() for row in first})


def test_a_cloud_about_a_known_design_is_narrow():
    method = CMAES(population=200, sigma=0.5)
    method.start(Room((None, None)), 0, 1)
    method.know(np.array([[0.4, 0.6], [0.9, 0.1]]), np.array([0.1, 0.2]))
    points = method.ask().points
    assert points.mean(0) == pytest.approx([0.4, 0.6], abs=0.05) and points.std(0).max() < 0.15


def test_the_order_of_all_designs_follows_the_seed():
    orders = []
    for seed in (0, 1, 1):
        method = Exhaustive()
        method.start(Room((5, 6)), seed, 1)
        orders.append(method.ask().points.tolist())
    assert orders[0] != orders[1] == orders[2]
