"""The target for measures of one's own."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import (
    WORST,
    Target,
    beyond,
    ended_elsewhere,
    huber,
    inner_targets,
    requiring_gradients,
)
from torchfilm import checks

Measure = Callable[[tf.State], Tensor]
# colonies from which on their numbers say how much they differ, and the least spread then, relative
# to the greatest number
ENOUGH, FINEST = 3, 0.01
TRIED = 4  # random levels, to see whether a measure depends on them
NO_CELLS = "no cells remain"  # why a colony without cells has failed


@dataclass(frozen=True)
class Measured(Target):
    """Measures of your own have the wanted values:

        Measured({"order": tf.measure.nematic_order}, {"order": (0.5, 0.8)}, {"order": 0.1})

    functions: by name, functions of a state that return one number for each colony, (B,), from the
    cells of that colony alone. wanted: of each, a number, or the range (low, high) within which any
    will do; ±inf for an open end. spread: of each, above 0, by how much off counts as 1.

    Loss: the mean over the measures of ((measure − wanted)/spread)², 0 within a range. Beyond 100
    spreads a square grows linearly (Huber). A colony in which a measure is not a number has failed,
    and so has one in which no cell is left; with extinct=True that one is measured, too, as where a
    drug is to kill all; among several goals, if all of them can be so. For several processes,
    functions stand at the top level of a file.

    smooth: say True where the functions have derivatives by all that the parameters change, as
    means of levels have, and counts of cells do not: then least squares search with exact
    derivatives, where the scene has them. A measure that gives no gradient at all is found out,
    unless it does not depend on levels, as the volume of a colony does not.

    time: h, when the values were measured, at which colonies then end. Measures of several times
    make a course: `ObservedCourse([Measured(…, time=1.0), Measured(…, time=2.0)])`. Of several
    colonies each with its number, `Measured.of_colonies` makes the target.

    For `infer`: colonies: over how many the values are means; it averages over as many simulated
    ones. error: by name, the standard error of measurement of the values, which simulations do not
    have, 0 for exact counts; spread is then how much single colonies differ. By default the spread
    is that error, beyond what differs between colonies.
    """

    failed = WORST
    pattern = False
    comparable = True
    functions: Mapping[str, Measure]
    wanted: Mapping[str, float | tuple[float, float]]
    spread: Mapping[str, float]
    _: KW_ONLY
    extinct: bool = False
    smooth: bool = False
    time: float | None = None
    # without effect on losses: studies do not depend on it
    colonies: int = field(default=1, repr=False)
    error: Mapping[str, float] | None = field(default=None, repr=False)
    _warned: bool = field(default=False, init=False, repr=False, compare=False)

    @property
    def fewest(self) -> int:  # type: ignore[override]
        return 0 if self.extinct else 1

    def __post_init__(self) -> None:
        checks.choice("Measured.extinct", self.extinct, (True, False))
        checks.choice("Measured.smooth", self.smooth, (True, False))
        checks.integer("Measured.colonies", self.colonies, least=1)
        if self.time is not None:
            checks.number("Measured.time", self.time, above=0.0)
        if not isinstance(self.functions, Mapping) or not self.functions:
            rule = "a dict of functions by name, such as {'order': tf.measure.nematic_order}"
            raise checks.input_error("Measured.functions", self.functions, rule)
        for name, function in self.functions.items():
            if not isinstance(name, str) or not name.isidentifier():
                rule = "names of letters, digits and underscores, such as 'order'"
                raise checks.input_error("Measured.functions", name, rule)
            if not callable(function):
                raise checks.input_error(f"Measured.functions[{name!r}]", function, "a function")
        for option in ("wanted", "spread"):
            given = getattr(self, option)
            if not isinstance(given, Mapping) or given.keys() != self.functions.keys():
                rule = f"a dict with the names {', '.join(map(repr, self.functions))}"
                raise checks.input_error(f"Measured.{option}", given, rule)
        ranges = {name: _range(name, self.wanted[name]) for name in self.functions}
        object.__setattr__(self, "wanted", ranges)
        for name in self.functions:
            checks.number(f"Measured.spread[{name!r}]", self.spread[name], above=0.0)
        if self.error is not None:
            if not isinstance(self.error, Mapping) or self.error.keys() != self.functions.keys():
                rule = f"None, or a dict with the names {', '.join(map(repr, self.functions))}"
                raise checks.input_error("Measured.error", self.error, rule)
            for name, error in self.error.items():
                checks.number(f"Measured.error[{name!r}]", error, least=0.0)

    @staticmethod
    @checks.known_keywords
    def of_colonies(
        functions: Mapping[str, Measure],
        values: Mapping[str, Any],
        *,
        error: Mapping[str, float] | None = None,
        extinct: bool = False,
        smooth: bool = False,
        time: float | None = None,
    ) -> Measured:
        """Numbers of each of several observed colonies:

            Measured.of_colonies({"donors": count_of(0)}, {"donors": [31, 25, 40, 28]}, time=3.0)

        values: by name, as many numbers as colonies, three at least. Wanted is their mean, and the
        spread is their standard deviation, at least 1 % of the greatest number, and of whole
        numbers with extinct=True at least 1/√n, as if one colony had one more, so that a colony
        like them has a loss of about 1, of n some (1 + 1/n)(n − 1)/(n − 3): 2.4 of five. error: of
        measurement, of the mean; by default 0, as of counts. The rest is as of `Measured`. Raises
        InputError for other names and numbers.
        """
        rows = {}
        if not isinstance(functions, Mapping) or not functions:
            rule = "a dict of functions by name, such as {'donors': donors}"
            raise checks.input_error("Measured.of_colonies: functions", functions, rule)
        for name, numbers in checked_columns("Measured.of_colonies: values", values, functions):
            label = f"Measured.of_colonies: values[{name!r}]"
            rows[name] = np.asarray(checks.vector(label, numbers))[None]
        rule = "as many numbers of each, one for each colony"
        label = "Measured.of_colonies: values"
        means, spreads, colonies = means_and_spreads(label, rows, rule, extinct)
        wanted, spread = ({n: float(x[0]) for n, x in of.items()} for of in (means, spreads))
        return Measured(
            functions, wanted, spread, extinct=extinct, smooth=smooth, time=time,
            colonies=colonies,
            error=dict.fromkeys(functions, 0.0) if error is None else error,
        )  # fmt: skip

    def check(self, state: tf.State) -> None:
        try:
            self._found(state)
        except TypeError as error:
            raise tf.InputError(str(error)) from error
        if not self._warned and not self.extinct and self._is_reached_without_cells(state):
            object.__setattr__(self, "_warned", True)
            checks.warn(
                f"a colony without cells is as it is wanted ({self.describe()}), but counts as"
                " failed: Measured(…, extinct=True) measures it as any other."
            )

    def _is_reached_without_cells(self, state: tf.State) -> bool:
        """Whether every measure of a colony without cells is as wanted."""
        empty = state.remove(
            torch.ones(state.cells, dtype=torch.bool, device=state.device), "removed"
        )
        try:
            with torch.no_grad(), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = self._found(empty)
        except Exception:  # of a function that takes no state without cells
            return False
        missed = self.misses({n: float(x[0]) for n, x in zip(self.functions, found, strict=True)})
        return all(by == 0 for by in missed.values()) and not bool(torch.stack(found).isnan().any())

    def unfit(self, state: tf.State) -> list[str]:
        bad = [
            (name, found.isnan())
            for name, found in zip(self.functions, self._found(state), strict=True)
        ]
        late = ended_elsewhere(state, self.time)
        why = [", ".join(n for n, nan in bad if bool(nan[k])) for k in range(state.colonies)]
        return [f"{names} is not a number" if names else late for names in why]

    def why_rough(self, state: tf.State) -> str:
        if not self.smooth:
            return "measures of your own may pass no gradient (smooth=True)"
        with torch.enable_grad():
            moved = requiring_gradients(state, state.fields)
            lacking = [n for n, x in self.functions.items() if not _has_gradient(x, moved)]
        lacking = [n for n in lacking if _depends_on_levels(self.functions[n], state)]
        names = " and ".join(map(repr, lacking))
        return f"no gradient passes through {names} of Measured" if lacking else ""

    def found(self, state: tf.State) -> Tensor:
        """The measures of each colony, (B, K) float64, with their gradients."""
        return torch.stack(self._found(state), 1)

    def _found(self, state: tf.State) -> list[Tensor]:
        """Each measure of each colony, (B,) float64. Raises TypeError where a function gives what
        is none: it may do so for some states only, and is no fault of a design."""
        out = []
        for name, function in self.functions.items():
            found = function(state)
            if not isinstance(found, Tensor) or found.shape != (state.colonies,):
                got = (
                    f"a tensor of shape {tuple(found.shape)}"
                    if isinstance(found, Tensor)
                    else found
                )
                rule = f"a tensor of shape ({state.colonies},), one number for each colony"
                raise TypeError(f"Measured.functions[{name!r}] gave {got}: it must give {rule}.")
            out.append(found.double())
        return out

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        found = self.found(state)
        ends = [self.wanted[name] for name in self.functions]
        spread = found.new_tensor([self.spread[name] for name in self.functions])
        apart = beyond(found, ends) / spread  # type: ignore[arg-type]
        return huber(apart) / math.sqrt(len(ends))

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        apart = self.residuals(state)
        # one after the other: the bits of a sum along rows may depend on their number
        loss = sum((a * a for a in apart.unbind(1)), apart.new_zeros(len(apart)))
        scored = (state.counts >= self.fewest) & ~loss.isnan()
        return torch.where(scored, loss, self.failed)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """The measures by name, (B,) each."""
        return dict(zip(self.functions, self._found(state), strict=True))

    def why_undefined(self, measure: str) -> str:
        return "its function returned no number there" if measure in self.functions else ""

    @property
    def bounds(self) -> dict[str, str]:
        return {name: in_words(low, high) for name, (low, high) in self.wanted.items()}  # type: ignore[misc]

    def misses(self, found: Mapping[str, float]) -> dict[str, float]:
        ranges = ((n, *self.wanted[n]) for n in self.functions if n in found)  # type: ignore[misc]
        apart = {n: max(found[n] - high, low - found[n], 0.0) for n, low, high in ranges}
        return {n: by / self.spread[n] for n, by in apart.items()}

    def describe(self) -> str:
        return ", ".join(f"{name} {words}" for name, words in self.bounds.items())


def checked_columns(
    label: str, given: Any, functions: Mapping[str, Measure]
) -> list[tuple[str, Any]]:
    """What is given for each measure, by its name. Raises InputError for other names."""
    if not hasattr(given, "keys") or set(given.keys()) != set(functions):
        rule = f"numbers by the names {', '.join(map(repr, functions))}"
        raise checks.input_error(label, given, rule)
    return [(name, given[name]) for name in functions]


def means_and_spreads(
    label: str, rows: Mapping[str, np.ndarray], alike: str, extinct: bool
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], int]:
    """Means and spreads by name, (T,) each, of numbers by time and colony (T, C), and the number of
    colonies. alike: what the numbers must be, where they are not of as many colonies. extinct:
    whether colonies without cells are measured; else zeros at the end are warned of."""
    found = {name: _mean_and_spread(f"{label}[{name!r}]", x, extinct) for name, x in rows.items()}
    counts = {name: x.shape[1] for name, x in rows.items()}
    if len(set(counts.values())) > 1:
        raise checks.input_error(label, counts, alike)
    none = int(np.stack([x[-1] == 0 for x in rows.values()]).all(0).sum())
    if none and not extinct:
        checks.warn(
            f"{label}: {none} of {next(iter(counts.values()))} colonies are 0. If they died out,"
            " say extinct=True: else simulated colonies that die out fail, and a search finds fewer"
            " deaths than there were."
        )
    means, spreads = ({name: pair[k] for name, pair in found.items()} for k in (0, 1))
    return means, spreads, next(iter(counts.values()))


def _mean_and_spread(label: str, rows: np.ndarray, extinct: bool) -> tuple[np.ndarray, np.ndarray]:
    """The means of a measure over colonies, (T,), of its numbers at each time (T, C), and how much
    colonies differ, (T,). Of whole numbers of colonies that may die out that is as if one of them
    had one more, at least: of none that is left, too."""
    if rows.shape[1] < ENOUGH:
        rule = (
            f"numbers of {ENOUGH} colonies at least, since fewer do not tell how much they differ"
        )
        raise checks.input_error(label, rows.tolist(), rule, "Give Measured their mean and spread.")
    greatest = np.abs(rows).max(1)
    least = FINEST * np.where(greatest == 0, np.nanmax(greatest), greatest)
    if extinct and (np.isnan(rows) | (rows % 1 == 0)).all():
        least = np.maximum(least, 1.0 / math.sqrt(rows.shape[1]))
    if not np.nanmax(least) > 0:
        hint = "If all colonies died out, say extinct=True. Else give Measured the spread."
        raise checks.input_error(label, rows.tolist(), "numbers of which one is not 0", hint)
    return rows.mean(1), np.maximum(rows.std(1, ddof=1), least)


def _range(name: str, given: object) -> tuple[float, float]:
    label = f"Measured.wanted[{name!r}]"
    if not isinstance(given, tuple | list):
        value = checks.number(label, given)
        return value, value
    ends = [x if isinstance(x, float) and math.isinf(x) else checks.number(label, x) for x in given]
    if len(ends) != 2 or not ends[0] <= ends[1] or ends[0] == math.inf or ends[1] == -math.inf:
        raise checks.input_error(label, given, "a number, or a range (low, high)")
    return ends[0], ends[1]


def in_words(low: float, high: float) -> str:
    """A range, or a number."""
    if low == high:
        return f"= {low:g}"
    if math.isinf(low) or math.isinf(high):
        return f"≥ {low:g}" if math.isinf(high) else f"≤ {high:g}"
    return f"{low:g} to {high:g}"


def _has_gradient(measure: Measure, tracked: tf.State) -> bool:
    """Whether a measure of a state whose fields require a gradient requires one."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's, of float(x)
            return bool(measure(tracked).requires_grad)
    except (RuntimeError, TypeError, ValueError):  # as where it asks for NumPy's numbers
        return False


def _depends_on_levels(measure: Measure, state: tf.State) -> bool:
    """Whether a measure changes with the numbers of the cells and the signals. One of places and
    sizes alone, such as the volume of a colony, has a derivative of 0 by what circuits do."""
    draws = torch.Generator().manual_seed(0)
    fields = {n: x for n, x in state.fields.items() if x.is_floating_point()}
    random = lambda x: 10.0 ** (12.0 * torch.rand(x.shape, generator=draws) - 6.0)
    ways = [partial(torch.full_like, fill_value=level) for level in (1e-6, 1e6)] + [random] * TRIED
    found = []
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for way in ways:
                moved = {n: way(x).to(x) for n, x in fields.items()}
                found.append(measure(state.with_fields(**moved)))
            first, *others = found
            same = [(x == first) | (x.isnan() & first.isnan()) for x in others]
            return not all(bool(x.all()) for x in same)
    except Exception:  # of a function that takes no such levels
        return True


def has_mean_with_error(target: object) -> bool:
    """Whether the spread of a measure is the error of a mean over several colonies."""
    mean = isinstance(target, Measured) and target.colonies > 1 and target.error is None
    return mean or any(map(has_mean_with_error, inner_targets(target)))


def extinct_words(target: Target, reasons: Iterable[str]) -> list[str]:
    """What to know where colonies without cells have failed that a target could measure, or leave
    out. reasons: of failures."""
    if not any(reason.startswith(NO_CELLS) for reason in reasons):
        return []
    if _leaves_out_extinct(target):
        return ["colonies without cells have failed; extinct=True of the measures measures them"]
    if not target.evidence:
        return []
    words = 'if the observed ones are those that lived on, reduce="survivors" leaves such out'
    return [f"colonies without cells have failed; {words}"]


def _leaves_out_extinct(target: object) -> bool:
    inside = map(_leaves_out_extinct, inner_targets(target))
    return getattr(target, "extinct", True) is False or any(inside)
