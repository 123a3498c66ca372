"""Whether colonies of a posterior look like the observed ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import torchfilm as tf
from design.fit_plot import Curve, draw_pulls, draw_readings, measures_of
from design.targets.observed import Observed
from design.targets.observed_conditions import standard_errors
from design.targets.readings import readings_of
from torchfilm import checks

ENDS = (0.05, 0.5, 0.95)  # quantiles that a picture shows
ROW = 0.17  # inches of a row in a picture
LIKELY = 3.0  # a loss of simulations above that of a right model and a posterior as it should be
WIDE = (
    ", of a right model and a narrow posterior about 2: give infer rounds=2 or more simulations, or"
    " change the model. Where a search has exact derivatives, its best.intervals() needs no"
    " simulations."
)


@dataclass(frozen=True, eq=False, repr=False)
class Prediction:
    """Statistics of colonies grown by parameters from a posterior, beside those that were observed:
    a posterior predictive check (Gelman et al., Statistica Sinica 6, 733, 1996).

    observed: the data. points: the parameters, (n, D) coordinates in [0, 1]. statistics: (n, K) by
    `observed.plan.names`, means over the replicates of the inference. failed: simulations that
    failed, and are not among the n. replicates: of each; None is as many as were observed.
    """

    observed: Observed
    points: np.ndarray
    statistics: np.ndarray
    failed: int = 0
    replicates: int | None = None

    @property
    def losses(self) -> np.ndarray:
        """Of each simulation the mean of ((statistic − value)/error)², (n,), with the standard
        errors of means over colonies: their spreads, by the root of the number of colonies. Where
        the model is right and the posterior narrow, it is about 2, since data and simulation both
        scatter; it is more where fewer than three colonies were observed, whose spread is
        underrated."""
        apart = self.statistics - np.array(self.observed.values)
        return np.square(apart / standard_errors(self.observed, self.replicates)).mean(1)

    @property
    def places(self) -> dict[str, float]:
        """The share of simulations with less than was observed, by statistic; of those with as
        much, half. Near 0 or 1 the model does not grow such colonies."""
        value = np.array(self.observed.values)
        below, same = self.statistics < value, self.statistics == value
        share = (below + 0.5 * same).mean(0)
        return dict(zip(self.observed.plan.names, share.tolist(), strict=True))

    def interval(self, level: float = 0.9) -> dict[str, tuple[float, float]]:
        """The central interval of each statistic among the simulations."""
        checks.number("level", level, above=0.0, most=1.0)
        ends = np.quantile(self.statistics, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
        names = self.observed.plan.names
        return {n: (float(a), float(b)) for n, a, b in zip(names, *ends, strict=True)}

    def table(self, level: float = 0.9) -> str:
        """Each statistic as observed and as predicted, those outside marked."""
        width = max(26, *(len(n) for n in self.observed.plan.names))
        share = f"{100 * level:g} % of {len(self.statistics)} predicted"
        lines = [f"{'':<{width}} {'observed ± sd':>19}  {share}"]
        outside = 0
        rows = zip(
            self.interval(level).items(), self.observed.values, self.observed.spread, strict=True
        )
        for (name, (low, high)), value, spread in rows:
            out = not low <= value <= high
            outside += out
            line = f"{name:<{width}} {value:>10.4g} ± {spread:<6.2g}  {low:.4g} to {high:.4g}"
            lines.append(line + ("  outside" if out else ""))
        expected = (1 - level) * len(self.observed.values)
        lines.append(f"{outside} outside; {expected:.1f} are to be expected")
        loss = float(np.median(self.losses))
        lines.append(f"loss of a simulation, median: {loss:.3g}" + (WIDE if loss > LIKELY else ""))
        if self.failed:
            lines.append(f"{self.failed} simulations failed and are left out")
        return tf.displays.Text("\n".join(lines))

    def plot(self, out: str | Path | None = None) -> tf.pictures.Picture:
        """Draw what was observed, and the middle 90 % of what is predicted: measured numbers over
        time or dose; of cells a row for each statistic, by how many standard errors of the data it
        is predicted to be off. out: as for `Best.plot`. Needs matplotlib (the `app` extra)."""
        readings = readings_of(getattr(self.observed, "conditions", self.observed))
        names, ends = self.observed.plan.names, np.quantile(self.statistics, ENDS, axis=0).T
        if not readings:
            error = standard_errors(self.observed)[:, None]
            apart = (ends - np.array(self.observed.values)[:, None]) / error
            figure = tf.pictures.new_figure(6.4, 1.2 + ROW * len(names))
            draw_pulls(figure.subplots(), dict(zip(names, apart.tolist(), strict=True)))
            return tf.pictures.Picture(figure, out)
        values = {n: (b, a, c) for n, (a, b, c) in zip(names, ends.tolist(), strict=True)}
        panels = len(measures_of(readings))
        figure = tf.pictures.new_figure(3.8 * panels, 3.6)
        axes: Any = figure.subplots(1, panels, squeeze=False)[0]
        draw_readings(axes, readings, [Curve("predicted, 90 %", "-", values)])
        return tf.pictures.Picture(figure, out)

    def __repr__(self) -> str:
        return f"Prediction({len(self.statistics)} simulations of {len(self.places)} statistics)"

    def _repr_html_(self) -> str:
        return tf.displays.card("Prediction", tf.displays.text(self.table()))
