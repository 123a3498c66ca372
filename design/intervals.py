"""How well data tell the constants of a best fit, from exact derivatives of what they compare."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from statistics import NormalDist

import numpy as np

import torchfilm as tf
from design.objective import Objective
from design.parameters import Parameter, Value
from design.targets.observed_conditions import data_of, standard_errors
from torchfilm import checks

UNTOLD = 1e-12  # of the greatest information along a direction; with less nothing is told of it
TOGETHER = 0.9  # a correlation from which tables say that two parameters are told together


@dataclass(frozen=True, eq=False, repr=False)
class Intervals:
    """Intervals around a best fit, as least squares have them: where the readings have independent
    normal errors with their spreads as standard deviations, and the fit is nearly linear within
    them (Seber and Wild, Nonlinear Regression, 1989, chapter 5). Of colonies that were observed,
    the spread is that of one, and the error of their mean less by the root of their number, of the
    fewest under any condition; the luck of the simulated ones is left aside.

    parameters: those without levels, at `values`; whole numbers and choices are held. covariance:
    (D, D) of these, of ln of those that are searched by logarithm; inf where the data tell nothing.
    readings: how many there are. loss: of the fit; about 1 − D/readings where the model is right.
    above: by how much it is above the minimum near it, as the derivatives have it.
    """

    parameters: tuple[Parameter, ...]
    values: tuple[float, ...]
    covariance: np.ndarray
    readings: int
    loss: float
    above: float = 0.0

    @property
    def correlation(self) -> np.ndarray:
        """(D, D); NaN where the data tell nothing of one of the two."""
        error = np.sqrt(np.diag(self.covariance))
        error[np.isinf(error)] = np.nan
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(error, error)

    def interval(self, level: float = 0.9) -> dict[str, tuple[float, float]]:
        """The central interval of each parameter; that of a logarithm ends at 0 and inf where the
        data tell nothing. It may go beyond the bounds of the search."""
        checks.number("level", level, above=0.0, most=0.999999)
        wide = NormalDist().inv_cdf(0.5 + 0.5 * level)
        found = {}
        for k, parameter in enumerate(self.parameters):
            half, value = wide * math.sqrt(self.covariance[k, k]), self.values[k]
            with np.errstate(over="ignore"):
                away = float(np.exp(half))
            ends = (value / away, value * away) if parameter.log else (value - half, value + half)
            found[parameter.name] = ends
        return found

    def table(self, level: float = 0.9) -> str:
        """Each parameter with its interval, what is told together, and whether the loss is that of
        a right model."""
        rows = [("parameter", "best", f"{100 * level:g} % interval")]
        for (name, (low, high)), parameter, value in zip(
            self.interval(level).items(), self.parameters, self.values, strict=True
        ):
            told = f"{low:.4g} to {high:.4g}"
            if low < parameter.low and high > parameter.high:
                told += ", beyond both bounds: these data do not tell it"
            rows.append((name, f"{value:.4g}", told))
        width = [max(len(row[k]) for row in rows) for k in range(2)]
        lines = [f"{a:<{width[0]}}  {b:>{width[1]}}  {c}" for a, b, c in rows]
        related = self.correlation
        pairs = combinations(enumerate(p.name for p in self.parameters), 2)
        lines += told_together({(one, other): related[i, j] for (i, one), (j, other) in pairs})
        expected = max(self.readings - len(self.parameters), 0) / self.readings
        freedom = max(self.readings - len(self.parameters), 1)
        far = self.loss > expected + 3 * math.sqrt(2 * freedom) / self.readings
        lines.append(
            f"loss {self.loss:.3g} with {self.readings} readings; of a right model with right"
            f" spreads about {expected:.2f}"
            + (": it is more, so that these intervals are too narrow" if far else "")
        )
        if self.readings * self.above > 1.0:  # by about a standard error of one parameter
            lines.append(
                f"the search has not come to the bottom: the loss is some {self.above:.2g} above"
                " the minimum near it. Search longer."
            )
        return tf.displays.Text("\n".join(lines))

    def __repr__(self) -> str:
        return f"Intervals({', '.join(p.name for p in self.parameters)}; {self.readings} readings)"

    def _repr_html_(self) -> str:
        return tf.displays.card("Intervals", tf.displays.text(self.table()))


def told_together(correlations: Mapping[tuple[str, str], float]) -> list[str]:
    """What to know of two parameters of which the data tell a combination."""
    return [
        f"{one} and {other} have a correlation of {r:.2f}: the data tell a combination of them"
        " better than each"
        for (one, other), r in correlations.items()
        if abs(r) >= TOGETHER
    ]


def intervals_of(
    objective: Objective, point: np.ndarray, values: Mapping[str, Value], loss: float
) -> Intervals:
    """See `Best.intervals`. point: (D,) coordinates of the best fit; values, loss: of it."""
    task, space = objective.task, objective.task.space
    data = data_of(task.target)
    readings = sum(len(part.values) for part in data)
    if not objective.least_squares:
        raise checks.InputError(
            "intervals are from exact derivatives by the parameters, and here there are none:"
            f" {objective.why_no_squares or 'all parameters are whole or choices'}. design.infer(…)"
            " needs none."
        )
    found = objective.evaluate(point[None], slopes=True).slopes
    assert found is not None
    curvature = found.curvature[0][np.ix_(space.moving, space.moving)]
    fewest = min(float((part.spread / standard_errors(part)).min()) for part in data) ** 2
    information = 0.5 * readings * fewest * curvature
    if not np.isfinite(information).all():
        raise checks.InputError("the best design has failed, and has no derivatives.")
    parameters = [space.parameters[k] for k in space.moving]
    known = tuple(p for p in parameters if isinstance(p, Parameter))
    # of a coordinate in [0, 1] to the number, or to its logarithm
    size = [math.log(p.high / p.low) if p.log else p.high - p.low for p in known]
    return Intervals(
        known, tuple(float(values[p.name]) for p in known),
        _inverse(information) * np.outer(size, size), readings, loss,
        _above(point[space.moving], found.gradient[0][space.moving], curvature),
    )  # fmt: skip


def _above(point: np.ndarray, gradient: np.ndarray, curvature: np.ndarray) -> float:
    """By how much the loss is above the minimum of its quadratic, ½ gᵀ H⁻¹ g, in the coordinates
    that no bound stops."""
    free = ~(((point <= 0) & (gradient > 0)) | ((point >= 1) & (gradient < 0)))
    told, directions = np.linalg.eigh(curvature[np.ix_(free, free)])
    along = directions.T @ gradient[free]
    known = told > UNTOLD * max(told.max(initial=0.0), 1e-300)
    return 0.5 * float((along[known] ** 2 / told[known]).sum())


def _inverse(information: np.ndarray) -> np.ndarray:
    """The covariance of coordinates; inf for those that take part in a direction of which nothing
    is known."""
    told, directions = np.linalg.eigh(information)
    known = told > UNTOLD * max(told.max(initial=0.0), 1e-300)
    found = (directions[:, known] / told[known]) @ directions[:, known].T
    lost = (np.abs(directions[:, ~known]) > 1e-6).any(1)
    found[lost, :] = found[:, lost] = 0.0
    found[lost, lost] = np.inf
    return found
