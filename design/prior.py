"""What is known of parameters before the data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from design.parameters import Choice, Parameter, Space
from torchfilm import checks

LEAST = 1e-3  # share of a distribution within the bounds
NUMBERS = "a frozen distribution of scipy.stats, such as scipy.stats.lognorm(0.3, scale=5)"
OPTIONS = "the share of each option, such as {'weak': 0.7, 'strong': 0.3}"


class Prior:
    """How likely the values of parameters are before the data.

    given: by the names of parameters, for a number a frozen distribution of scipy.stats, of which
    the part within the bounds counts (for a whole number a discrete one), for a choice the share of
    each option. All values of the others are equally likely, on the logarithmic scale with
    log=True. Raises InputError for names that the space lacks, other distributions, and those that
    hold less than a thousandth within the bounds.
    """

    def __init__(self, space: Space, given: Mapping[str, Any] | None = None):
        if not (given is None or isinstance(given, Mapping)):
            raise checks.input_error("prior", given, "a dictionary from parameters to " + NUMBERS)
        self.given = dict(given or {})
        for name in self.given:
            if name not in space.names:
                raise checks.input_error(
                    "prior", name, "a parameter: " + ", ".join(space.names),
                    checks.suggestion(str(name), space.names),
                )  # fmt: skip
        self._space = space
        self._shares = {
            p.name: _shares(p, self.given[p.name]) if isinstance(p, Choice)
            else _within(p, self.given[p.name])
            for p in space.parameters if p.name in self.given
        }  # fmt: skip

    def points(self, units: np.ndarray) -> np.ndarray:
        """The coordinates of designs, (n, D), from even draws in [0, 1] of the same shape."""
        out = units.copy()
        for k, p in enumerate(self._space.parameters):
            if p.name not in self.given:
                continue
            if isinstance(p, Choice):
                out[:, k] = _coordinates(np.cumsum(self._shares[p.name]), units[:, k])
                continue
            known, (low, high) = self.given[p.name], self._shares[p.name]
            if p.whole:
                values = np.arange(p.low, p.high + 1)
                out[:, k] = _coordinates((known.cdf(values) - low) / (high - low), units[:, k])
                continue
            values = np.clip(known.ppf(low + (high - low) * units[:, k]), p.low, p.high)
            out[:, k] = [p.coordinate(v) for v in values]
        return out

    def units(self, points: np.ndarray) -> np.ndarray:
        """The inverse of `points` for parameters without levels; the coordinates of others."""
        out = points.copy()
        for k, p in enumerate(self._space.parameters):
            if p.name in self.given and isinstance(p, Parameter) and not p.whole:
                low, high = self._shares[p.name]
                values = [float(p.value(x)) for x in points[:, k]]
                out[:, k] = (self.given[p.name].cdf(values) - low) / (high - low)
        return out

    def words(self, name: str) -> str:
        """What was given of a parameter, as text."""
        known = self.given[name]
        if isinstance(known, Mapping):
            return ", ".join(f"{share:g} {option!r}" for option, share in known.items())
        settings = [f"{_shown(x)}" for x in known.args]
        settings += [f"{k}={_shown(v)}" for k, v in known.kwds.items()]
        return f"{known.dist.name or 'distribution'}({', '.join(settings)})"

    def describe(self) -> dict[str, str]:
        """As plain data: of a distribution some quantiles, whatever it is called."""
        return {
            name: self.words(name) if isinstance(known, Mapping)
            else " ".join(f"{x:.10g}" for x in known.ppf(np.linspace(0.025, 0.975, 20)))
            for name, known in self.given.items()
        }  # fmt: skip


def _shown(value: Any) -> str:
    return f"{value:g}" if np.ndim(value) == 0 else "…"


def _coordinates(ends: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Of even draws the coordinates of levels that end at these shares, evenly in each level."""
    level = np.minimum(np.searchsorted(ends, units, side="right"), len(ends) - 1)
    begins = np.concatenate([[0.0], ends[:-1]])
    within = (units - begins[level]) / np.maximum(ends[level] - begins[level], 1e-300)
    return (level + within.clip(0.0, 1.0 - 1e-9)) / len(ends)


def _shares(choice: Choice, given: Any) -> np.ndarray:
    """The share of each option."""
    name = f"prior[{choice.name!r}]"
    if not isinstance(given, Mapping) or set(given) != set(choice.options):
        raise checks.input_error(name, given, OPTIONS)
    found = np.array([checks.number(name, given[o], least=0.0) for o in choice.options])
    if abs(found.sum() - 1.0) > 1e-6:
        raise checks.input_error(name, dict(given), "shares that add up to 1")
    return found


def _within(parameter: Parameter, given: Any) -> tuple[float, float]:
    """Of a distribution, the shares below the bounds of a parameter."""
    name = f"prior[{parameter.name!r}]"
    if not all(hasattr(given, x) for x in ("dist", "args", "kwds", "ppf", "cdf")):
        raise checks.input_error(name, given, NUMBERS)
    discrete = hasattr(given.dist, "pmf")
    if discrete != parameter.whole:
        kind = "a discrete distribution, since it is a whole number" if parameter.whole else NUMBERS
        raise checks.input_error(name, given.dist.name, kind)
    below = parameter.low - 1 if discrete else parameter.low
    if np.ndim(given.cdf(below)):
        raise checks.input_error(name, given.dist.name, "one distribution, not several")
    low, high = float(given.cdf(below)), float(given.cdf(parameter.high))
    if not high - low >= LEAST:
        raise checks.input_error(
            name,
            given.dist.name,
            f"a distribution of which at least {LEAST:g} lies within the bounds",
            f"Of this one, {high - low:.3g} lies between {parameter.low:g} and"
            f" {parameter.high:g}: look at its arguments, or widen the bounds.",
        )
    return low, high
