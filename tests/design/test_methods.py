"""What all search methods promise of their points, and of a search that is resumed."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from asking import SPACES, Room, begun, ellipsoid, failing, follow

from design.methods import CMAES, METHODS, Batch, Bayesian, Racing, Sobol, method_of
from torchfilm.tools.checks import InputError

MAKE: dict[str, Callable] = {
    "sobol": lambda: Sobol(batch=7),
    "cmaes": CMAES,
    "cmaes, one cloud": lambda: CMAES(restarts=False, noisy=False, population=5),
    "racing": Racing,
    "racing, three sizes": lambda: Racing(sizes=(0.1, 0.3, 1.0), keep=0.5, small=2),
    "racing sobol": lambda: Racing(inner=Sobol(batch=5)),
}
if find_spec("botorch"):
    MAKE["bayesian"] = lambda: Bayesian(batch=2, first=4)
    MAKE["racing bayesian"] = lambda: Racing(inner=Bayesian(batch=2), keep=0.5, first=3)
made = pytest.mark.parametrize("make", MAKE.values(), ids=MAKE)
# a batch of Bayesian takes a second, so only two spaces test it
CASES = [(m, s) for m in MAKE for s in SPACES if "bayesian" not in m or s in ("line", "mixed")]
everywhere = pytest.mark.parametrize(
    ("make", "space"), [(MAKE[m], SPACES[s]) for m, s in CASES], ids=[f"{m} {s}" for m, s in CASES]
)


# What every method promises


@everywhere
def test_points_lie_within_bounds_and_levels_in_the_middle_of_their_level(make, space):
    for batch, _ in follow(begun(make(), space), failing, 6):
        assert batch.points.shape[1] == space.size
        assert ((batch.points >= 0) & (batch.points <= 1)).all()
        for axis, count in enumerate(space.levels):
            if count is not None:
                level = np.minimum((batch.points[:, axis] * count).astype(int), count - 1)
                assert (batch.points[:, axis] == (level + 0.5) / count).all()


@everywhere
def test_after_a_stop_the_next_batches_have_the_same_bits(make, space):
    whole = follow(begun(make(), space, seed=5), failing, 7)
    for stop in (1, 2, 3, 6):
        again = begun(make(), space, seed=5)
        for batch, loss in whole[:stop]:
            again.tell(
                Batch(batch.points.copy(), size=batch.size, replicates=batch.replicates),
                loss.copy(),
            )
        for batch, loss in whole[stop : stop + 2]:
            asked = again.ask()
            assert asked.points.tobytes() == batch.points.tobytes()
            assert (asked.size, asked.replicates) == (batch.size, batch.replicates)
            again.tell(asked, loss)


@made
def test_ask_returns_the_same_batch_until_tell(make):
    given = begun(make(), SPACES["mixed"])
    follow(given, ellipsoid, 3)
    assert given.ask() is given.ask()


@made
def test_start_resets_a_method(make):
    given = begun(make(), SPACES["mixed"], seed=2)
    first = follow(given, ellipsoid, 4)
    second = follow(begun(given, SPACES["mixed"], seed=2), ellipsoid, 4)
    assert all(
        a.points.tobytes() == b.points.tobytes()
        for (a, _), (b, _) in zip(first, second, strict=True)
    )


@made
@pytest.mark.parametrize("space", [SPACES["cube"], SPACES["mixed"]], ids=["cube", "mixed"])
def test_another_seed_gives_other_points(make, space):
    one, two = (begun(make(), space, seed=s).ask().points for s in (0, 1))
    assert (one != two).any()


@made
def test_global_random_numbers_are_neither_read_nor_changed(make):
    def run(seed: int) -> bytes:
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)
        before = (
            np.random.get_state()[1].tobytes(),  # noqa: NPY002
            np.random.get_state()[2],  # noqa: NPY002
            torch.get_rng_state(),
        )
        points = b"".join(
            batch.points.tobytes()
            for batch, _ in follow(begun(make(), SPACES["mixed"]), ellipsoid, 8)
        )
        after = (
            np.random.get_state()[1].tobytes(),  # noqa: NPY002
            np.random.get_state()[2],  # noqa: NPY002
            torch.get_rng_state(),
        )
        assert before[:2] == after[:2] and torch.equal(before[2], after[2])
        return points

    assert run(1) == run(2)


@everywhere
def test_batches_keep_their_size_where_every_design_fails(make, space):
    history = follow(begun(make(), space), lambda points: np.full(len(points), 1.5), 30)
    sizes = [len(batch.points) for batch, _ in history]
    assert max(sizes[15:]) <= max(sizes[:15])


@made
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_loss_that_is_not_finite_is_refused_with_its_row(make, bad):
    given = begun(make(), SPACES["cube"])
    batch = given.ask()
    loss = ellipsoid(batch.points)
    loss[2] = bad
    with pytest.raises(InputError, match=r"loss\[2\].*finite.*1 of"):
        given.tell(batch, loss)
    given.tell(batch, ellipsoid(batch.points))  # it has learnt nothing of it


@made
def test_a_batch_that_was_not_proposed_is_refused(make):
    given = begun(make(), SPACES["cube"])
    batch = given.ask()
    other = np.clip(batch.points + 0.01, 0, 1)
    with pytest.raises(InputError, match=r"points\[0\].*as proposed.*same settings"):
        given.tell(Batch(other, size=batch.size, replicates=batch.replicates), ellipsoid(other))
    with pytest.raises(InputError, match=r"\(points, dimensions, size, replicates\)"):
        given.tell(
            Batch(batch.points[1:], size=batch.size, replicates=batch.replicates),
            ellipsoid(batch.points[1:]),
        )
    with pytest.raises(InputError, match="loss of shape"):
        given.tell(batch, np.zeros(len(batch.points) + 1))
    # rounding on another machine
    given.tell(
        Batch(np.clip(batch.points + 1e-13, 0, 1), size=batch.size, replicates=batch.replicates),
        ellipsoid(batch.points),
    )


@made
def test_ask_before_start_names_the_remedy(make):
    with pytest.raises(InputError, match="call start"):
        make().ask()
    for seed, replicates in ((-1, 1), (0.5, 1), (0, 0), (True, 1)):
        with pytest.raises(InputError, match="whole number"):
            make().start(SPACES["cube"], seed, replicates)
    with pytest.raises(InputError, match="levels"):
        make().start(Room(()), 0, 1)


# The shared register


@pytest.mark.parametrize("name", ["sobol", "cmaes", "racing"])
def test_a_method_by_its_name(name):
    given = method_of(name)
    assert type(given) is METHODS[name]
    assert given.describe().startswith(name + "(")
    assert method_of(given) is given


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (Sobol(batch=9), "sobol(batch=9)"),
        (CMAES(), "cmaes(population=None, sigma=0.3, restarts=True, noisy=False)"),
        (
            Racing(inner=Sobol(batch=9)),
            "racing(inner=sobol(batch=9), sizes=(0.25, 1.0), keep=0.33, small=1, agree=0.1,"
            " first=5)",
        ),
    ],
)
def test_describe_gives_all_settings(given, said):
    assert given.describe() == said


@pytest.mark.parametrize("bad", ["annealing", 3, Sobol, None])
def test_other_objects_are_refused_as_methods(bad):
    with pytest.raises(InputError, match=r"method = .*'cmaes'"):
        method_of(bad)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Sobol(batch=0),
        lambda: CMAES(population=3),
        lambda: CMAES(sigma=0.0),
        lambda: CMAES(noisy=None),  # type: ignore[arg-type]
        lambda: Racing(sizes=(0.5,)),
        lambda: Racing(sizes=(0.5, 0.25, 1.0)),
        lambda: Racing(sizes=(0.25, 0.5)),
        lambda: Racing(keep=1.0),
        lambda: Racing(small=0),
        lambda: Racing(agree=2.0),
        lambda: Racing(first=1),
        lambda: Racing(inner=Racing()),  # type: ignore[arg-type]
        lambda: Racing(inner=CMAES),  # type: ignore[arg-type]
        lambda: Batch(np.zeros((0, 2))),
        lambda: Batch(np.full((2, 2), 1.1)),
        lambda: Batch(np.full((2, 2), np.nan)),
        lambda: Batch(np.zeros((2, 2)), size=0.0),
        lambda: Batch(np.zeros((2, 2)), replicates=0),
    ],
)
def test_bad_settings_are_refused(make):
    with pytest.raises(InputError, match="is not allowed"):
        make()
