"""The interface of search methods: `ask` returns a batch of points, `tell` gives their losses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from scipy.stats import qmc
from torch import Tensor

from design.slopes import Slopes
from torchfilm import checks

SAME_ORDER = (
    "Tell all batches, in order, to a method with the same settings, space, seed and replicates."
)


class Dimensions(Protocol):
    """What a method needs of a space: the number of dimensions, and the levels of each (None:
    continuous)."""

    @property
    def size(self) -> int: ...

    @property
    def levels(self) -> tuple[int | None, ...]: ...


@dataclass(frozen=True, eq=False)
class Batch:
    """The points that a method proposes.

    points: (n, D), each coordinate in [0, 1]. size: the share of the full colony size to grow,
    above 0, at most 1. replicates: how many replicates of each point to grow; None is all. slopes:
    whether `tell` needs derivatives too; residuals: whether it needs those of data. Raises
    InputError for values that are not allowed.
    """

    points: np.ndarray
    size: float = 1.0
    replicates: int | None = None
    slopes: bool = False
    residuals: bool = False

    def __post_init__(self) -> None:
        given = self.points
        points = np.array(
            given.detach().cpu().numpy() if isinstance(given, Tensor) else given, dtype=np.float64
        )
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
            object.__setattr__(
                self, "replicates", checks.integer("Batch.replicates", self.replicates, least=1)
            )


class Method(Protocol):
    """How a search chooses points. Any object with these three functions can be the method of a
    search. `tell` gets a third argument, `Slopes`, where the batch asked for them, and `residuals=`
    where it asked for these: numbers (n, K) whose squares add up to the loss but for the scatter
    between replicates, NaN for a design that failed; None where all did.

    The result of `ask` must depend only on the arguments of `start`, the method's settings, and all
    calls of `tell`: a new method resumes a stopped search from the batches and losses of its study.
    A method with `describe() -> str` is recognised when a search is resumed. One with a property
    `remark` has it printed at the end of a run, unless it is "". One with a property `over` ends
    the search where it is true, and what is left of the budget goes to the finals. One with
    `know(points, loss)` learns before its first batch of the designs from which a search starts;
    `loss` is as for `tell`. One with `recall(points)` is told, where a search is resumed, what its
    next `ask` gave then (None: not known), and need not work it out again.
    """

    def start(self, space: Dimensions, seed: int, replicates: int) -> None: ...

    def ask(self) -> Batch: ...

    def tell(self, batch: Batch, loss: np.ndarray) -> None: ...


class Source(Method, Protocol):
    """A method that can draw more points than it needs and learn from some of them, as `Racing`
    requires."""

    @property
    def wanted(self) -> int:
        """How many losses it needs next."""

    @property
    def fresh(self) -> bool:
        """Whether it is about to start from a new place, not from what it has learnt."""

    def draw(self, count: int) -> np.ndarray:
        """(count, D) points of its current distribution."""

    def take(self, rows: np.ndarray, loss: np.ndarray) -> None:
        """Learn from `wanted` of the points that were drawn last, or from fewer where it is
        `fresh`: their rows and losses."""


class AskTell(metaclass=checks.KnownKeywords):
    """The base class of the ready methods. `ask` returns the same batch until `tell`.

    A method proposes in `_next` and learns in `_take`; `start` calls `_begin`.
    """

    _batch: Batch | None = None
    _space: Dimensions | None = None
    _seed: int = 0
    _replicates: int = 1

    def start(self, space: Dimensions, seed: int, replicates: int) -> None:
        """Begin, or begin again. seed: a whole number from 0; replicates: how many the search grows
        of each design."""
        if len(space.levels) != space.size or space.size < 1:
            raise checks.input_error(
                "space.levels", space.levels, "one entry for each of at least one dimension"
            )
        self._space = space
        self._seed, self._replicates = (
            checks.integer("seed", seed, least=0),
            checks.integer("replicates", replicates, least=1),
        )
        self._batch = None
        self._begin()

    def ask(self) -> Batch:
        """The next batch; the same until `tell`."""
        self._started()
        if self._batch is None:
            self._batch = self._next()
        return self._batch

    def tell(
        self,
        batch: Batch,
        loss: np.ndarray,
        slopes: Slopes | None = None,
        residuals: np.ndarray | None = None,
    ) -> None:
        """Learn the losses of a batch: (n,), lower is better, finite (a design that failed has a
        bad but finite loss); slopes, residuals: where the batch asked for them.

        Batches are given in the order of `ask`. Raises InputError for a batch that `ask` did not
        return.
        """
        self._started()
        self._meet(batch)
        if batch.residuals:
            self._compare(batch, scores(batch, loss), residuals)
        elif not batch.slopes:
            self._take(batch, scores(batch, loss))
        elif slopes is None:
            raise checks.input_error("slopes", None, "given, since the batch asked for them")
        else:
            self._descend(scores(batch, loss), slopes)
        self._batch = None

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """Learn designs that were known before the first batch, (n, D), and their losses (n,)."""

    @property
    def remark(self) -> str:
        """What a user should know of a run that has ended here, or ""."""
        return ""

    def describe(self) -> str:
        """The method and its settings, on one line."""
        given = (f for f in fields(self) if f.init)  # type: ignore[arg-type]
        settings = (f"{f.name}={_shown(getattr(self, f.name))}" for f in given)
        return f"{type(self).__name__.lower()}({', '.join(settings)})"

    def _started(self) -> Dimensions:
        if self._space is None:
            raise checks.InputError(
                f"{type(self).__name__} has no space yet: call start(space, seed, replicates)"
                " first."
            )
        return self._space

    def _meet(self, batch: Batch) -> None:
        """Raise InputError for a batch that this method would not propose."""
        check_same(self.ask(), batch, type(self).__name__)

    def _begin(self) -> None:
        raise NotImplementedError

    def _next(self) -> Batch:
        raise NotImplementedError

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        raise NotImplementedError

    def _descend(self, loss: np.ndarray, slopes: Slopes) -> None:
        """Learn from a batch with slopes."""
        raise NotImplementedError

    def _compare(self, batch: Batch, loss: np.ndarray, residuals: np.ndarray | None) -> None:
        """Learn from a batch with residuals."""
        raise NotImplementedError


def check_kind(proposed: tuple[int, int, float, int | None], batch: Batch, name: str) -> None:
    """Raise InputError for a batch of another kind than proposed: (points, dimensions, size,
    replicates)."""
    given = (*batch.points.shape, batch.size, batch.replicates)
    if given != proposed:
        raise checks.input_error(
            f"{name}.tell: (points, dimensions, size, replicates)",
            given,
            f"{proposed}, as proposed",
            SAME_ORDER,
        )


def check_same(proposed: Batch, batch: Batch, name: str) -> None:
    """Raise InputError for a batch that is not the proposed one. Another machine may round in
    another way, so the points may differ by 1e-6."""
    check_kind((*proposed.points.shape, proposed.size, proposed.replicates), batch, name)
    far = (np.abs(proposed.points - batch.points) > 1e-6).any(1)
    if far.any():
        row = int(far.argmax())
        raise checks.input_error(
            f"{name}.tell: points[{row}]",
            batch.points[row].tolist(),
            f"{proposed.points[row].tolist()}, as proposed",
            SAME_ORDER,
        )


def scores(batch: Batch, loss: Any) -> np.ndarray:
    """The losses of a batch, (n,) float64. Raises InputError for another shape or for a number that
    is not finite."""
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
            f"{int(bad.sum())} of {len(out)} are not. Give a failed design a bad finite loss, such"
            " as 1.5.",
        )
    return out


def snap(points: np.ndarray, levels: Sequence[int | None]) -> np.ndarray:
    """Points whose coordinates with levels are in the middle of their level, (level + ½) / k.
    Other coordinates are clipped to [0, 1]."""
    out = np.clip(points, 0.0, 1.0)
    for axis, count in enumerate(levels):
        if count is not None:
            out[:, axis] = (np.minimum(np.floor(out[:, axis] * count), count - 1) + 0.5) / count
    return out


def sobol_points(space: Dimensions, seed: int, at: int, count: int) -> np.ndarray:
    """`count` points of the scrambled Sobol sequence of a seed, from number `at`, (count, D)."""
    engine = qmc.Sobol(space.size, scramble=True, rng=np.random.default_rng(seed))
    # scipy warns where the first draw is not a power of two; one is, and the sequence continues
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


@contextmanager
def numpy_kept(seed: Sequence[int]) -> Iterator[None]:
    """Inside, numpy's global generator starts from `seed`; afterwards it has its earlier state. For
    libraries that draw from it."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(np.random.SeedSequence(list(seed)).generate_state(4))  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002


def _shown(value: object) -> str:
    return value.describe() if isinstance(value, AskTell) else repr(value)
