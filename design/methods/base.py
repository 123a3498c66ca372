"""What a search method is: it is asked what to try, and told how good that was."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from scipy.stats import qmc

from torchfilm import checks

AGAIN = (
    "Tell all batches, in order, to a method with the same settings, space, seed and replicates."
)


class Dimensions(Protocol):
    """What a method knows of a space: how many dimensions, and the levels of each (None:
    continuous)."""

    @property
    def size(self) -> int: ...

    @property
    def levels(self) -> tuple[int | None, ...]: ...


@dataclass(frozen=True, eq=False)
class Batch:
    """What a method wants tried.

    points: (n, D), each coordinate in [0, 1]. size: share of the full colony size to grow, above 0,
    at most 1. replicates: how many of the replicates to grow of each point; None is all.
    """

    points: np.ndarray
    size: float = 1.0
    replicates: int | None = None

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64)
        if points.ndim != 2 or not len(points):
            raise checks.input_error(
                "Batch.points", points.shape, "of shape (n, D) with n at least 1"
            )
        bad = ~((points >= 0) & (points <= 1)).all(1)
        if bad.any():
            row = int(bad.argmax())
            raise checks.input_error(
                f"Batch.points[{row}]", points[row].tolist(), "within [0, 1] in every dimension"
            )
        points.setflags(write=False)
        object.__setattr__(self, "points", points)
        checks.number("Batch.size", self.size, above=0.0, most=1.0)
        if self.replicates is not None:
            whole("Batch.replicates", self.replicates, least=1)


class Method(Protocol):
    """How a search chooses what to try next. Any object with these three can be given to a search
    as its method.

    What `ask` returns must depend on nothing but what `start` was given, the method's settings, and
    all that was told: a search that was stopped is continued by a new method that is told what is
    known. A method with `describe() -> str` is recognised when a search is continued.
    """

    def start(self, space: Dimensions, seed: int, replicates: int) -> None: ...

    def ask(self) -> Batch: ...

    def tell(self, batch: Batch, loss: np.ndarray) -> None: ...


class Source(Method, Protocol):
    """A method whose points may be sieved before it hears of them, as `Racing` does: it draws as
    many as are wanted and takes the losses of some."""

    @property
    def wanted(self) -> int:
        """How many losses it wants next."""

    @property
    def fresh(self) -> bool:
        """Whether it is about to draw from a new place, not from what it has learnt."""

    def draw(self, count: int) -> np.ndarray:
        """(count, D) points of the distribution that it samples now."""

    def take(self, rows: np.ndarray, loss: np.ndarray) -> None:
        """Learn from `wanted` of the points that were drawn last: which, and their losses."""


class Turns:
    """Asks and tells in turns: what the ready methods share. Asked again before it was told, a
    method answers the same.

    A method says what comes next in `_next` and learns in `_take`; `_begin` is called by `start`.
    """

    _batch: Batch | None = None
    _space: Dimensions | None = None
    _seed: int = 0
    _replicates: int = 1

    def start(self, space: Dimensions, seed: int, replicates: int) -> None:
        """Begin, or begin anew. seed: a whole number from 0; replicates: how many the search grows
        of each design."""
        if len(space.levels) != space.size or space.size < 1:
            raise checks.input_error(
                "space.levels", space.levels, "one entry for each of at least one dimension"
            )
        self._space = space
        self._seed, self._replicates = (
            whole("seed", seed, least=0),
            whole("replicates", replicates, least=1),
        )
        self._batch = None
        self._begin()

    def ask(self) -> Batch:
        """What to try next; the same until `tell`."""
        self._started()
        if self._batch is None:
            self._batch = self._next()
        return self._batch

    def tell(self, batch: Batch, loss: np.ndarray) -> None:
        """How good the points of a batch are: (n,), lower is better, finite (a design that failed
        has a bad but finite loss).

        Batches are told in the order in which they were asked. InputError for another batch than
        was asked.
        """
        self._started()
        self._meet(batch)
        self._take(batch, scores(batch, loss))
        self._batch = None

    def describe(self) -> str:
        """The method and its settings, on one line."""
        said = (f"{f.name}={_shown(getattr(self, f.name))}" for f in fields(self) if f.init)  # type: ignore[arg-type]
        return f"{type(self).__name__.lower()}({', '.join(said)})"

    def _started(self) -> Dimensions:
        if self._space is None:
            raise checks.InputError(
                f"{type(self).__name__} has no space yet: call start(space, seed, replicates)"
                " first."
            )
        return self._space

    def _meet(self, batch: Batch) -> None:
        """Refuse a batch that this method would not have asked."""
        same(self.ask(), batch, type(self).__name__)

    def _begin(self) -> None:
        raise NotImplementedError

    def _next(self) -> Batch:
        raise NotImplementedError

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        raise NotImplementedError


def alike(asked: tuple[int, int, float, int | None], told: Batch, name: str) -> None:
    """Refuse a batch of another kind than was asked: (points, dimensions, size, replicates)."""
    given = (*told.points.shape, told.size, told.replicates)
    if given != asked:
        raise checks.input_error(
            f"{name}.tell: (points, dimensions, size, replicates)",
            given,
            f"{asked}, as asked",
            AGAIN,
        )


def same(asked: Batch, told: Batch, name: str) -> None:
    """Refuse a batch that is not the one asked. Another machine may round another way, so the
    points may differ by 1e-6."""
    alike((*asked.points.shape, asked.size, asked.replicates), told, name)
    far = (np.abs(asked.points - told.points) > 1e-6).any(1)
    if far.any():
        row = int(far.argmax())
        raise checks.input_error(
            f"{name}.tell: points[{row}]",
            told.points[row].tolist(),
            f"{asked.points[row].tolist()}, as asked",
            AGAIN,
        )


def scores(batch: Batch, loss: Any) -> np.ndarray:
    """The losses of a batch, (n,) float64, finite."""
    out = np.array(loss, dtype=np.float64)
    if out.shape != (len(batch.points),):
        raise checks.input_error(
            "loss of shape", out.shape, f"({len(batch.points)},), one number for each point"
        )
    bad = ~np.isfinite(out)
    if bad.any():
        row = int(bad.argmax())
        raise checks.input_error(
            f"loss[{row}]",
            float(out[row]),
            "finite",
            f"{int(bad.sum())} of {len(out)} are not; give a design that failed a bad finite loss,"
            " such as 1.5.",
        )
    return out


def snap(points: np.ndarray, levels: Sequence[int | None]) -> np.ndarray:
    """Points with the coordinates of levels in the middle of their level, (level + ½) / k; others
    clipped to [0, 1]."""
    out = np.clip(points, 0.0, 1.0)
    for axis, count in enumerate(levels):
        if count is not None:
            out[:, axis] = (np.minimum(np.floor(out[:, axis] * count), count - 1) + 0.5) / count
    return out


def sobol(space: Dimensions, seed: int, at: int, count: int) -> np.ndarray:
    """Points number `at` … `at + count` of the scrambled Sobol sequence of a seed, (count, D)."""
    engine = qmc.Sobol(space.size, scramble=True, rng=np.random.default_rng(seed))
    # scipy warns where the first draw is no power of two; one is, and the sequence goes on from
    # there
    if not at:
        return snap(
            (
                np.concatenate([engine.random(1), engine.random(count - 1)])
                if count > 1
                else engine.random(1)
            ),
            space.levels,
        )
    return snap(engine.fast_forward(at).random(count), space.levels)


def whole(name: str, value: object, *, least: int) -> int:
    """A whole number from `least`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise checks.input_error(name, value, f"a whole number from {least}")
    return int(value)


@contextmanager
def numpy_kept(seed: Sequence[int]) -> Iterator[None]:
    """Inside, numpy's global generator starts from `seed`; outside it is as if nobody had drawn
    from it. For libraries that do."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(np.random.SeedSequence(list(seed)).generate_state(4))  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002


def _shown(value: object) -> str:
    return value.describe() if isinstance(value, Turns) else repr(value)
