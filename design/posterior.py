"""The posterior of parameters, as samples."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import torchfilm as tf
from design.calibration import Calibration
from design.intervals import told_together
from design.neural_posterior import NeuralPosterior
from design.parameters import Parameter, Value, show_value
from design.posterior_plot import draw_corner
from design.prediction import Prediction
from design.prior import Prior
from design.simulations import Simulations, random_points, shown_values, simulate_points
from design.targets.conditions import Conditions
from design.targets.measured import Measured, extinct_words
from design.targets.observed import Observed
from design.targets.observed_conditions import averaged, cells_each, checked_data, standard_errors
from design.targets.statistics import LOG_CELLS
from design.task import SURVIVORS, Task
from torchfilm import checks

LEVEL = 0.9  # of intervals, unless a caller gives one
BEYOND = 0.002  # share of simulations beyond a statistic for which the model is questioned
STREAM = 2  # of the truths of a calibration
PREDICTED = 3  # of predictions
DRAWN, PRIOR_DRAWN = 4, 20_000  # of points of the prior in a picture, and how many
ALIKE = 1.5  # numbers of cells that differ by less than this factor make about the same intervals


@dataclass(frozen=True, eq=False, repr=False)
class Posterior:
    """Parameters that could have grown the observed colonies.

    task: scene, parameters and end of the colonies; prior: what was known of the parameters before;
    simulations: what the posterior was learnt
    from; estimator: the density of parameters for any statistics; observed: the data. points: the
    samples, (S, D) coordinates in [0, 1].
    """

    task: Task
    prior: Prior
    simulations: Simulations
    estimator: NeuralPosterior
    observed: Observed
    points: np.ndarray

    @staticmethod
    def of(
        task: Task,
        prior: Prior,
        simulations: Simulations,
        estimator: NeuralPosterior,
        observed: Observed,
        samples: int,
    ) -> Posterior:
        """Draw the samples for some data."""
        row = np.array([observed.values])
        points = estimator.sample(row, samples, seed=task.seed)[0]
        return Posterior(task, prior, simulations, estimator, observed, points)

    def given(self, observed: Observed | Measured | Conditions) -> Posterior:
        """The posterior for other data of the same statistics (`Observed.from_table(…, like=…)`)
        and as many colonies, without further simulations."""
        data = checked_data(observed)
        colonies = [averaged(of, of.colonies) for of in (data, self.observed)]
        if data.plan != self.observed.plan or colonies[0] != colonies[1]:
            raise checks.input_error(
                "observed",
                data.describe(),
                f"data of the same statistics, each from as many colonies as before"
                f" ({', '.join(map(str, dict.fromkeys(colonies[1])))})",
                "Make it with like=…; of Measured, with the same functions and spreads.",
            )
        if len(self.simulations.regions) > 1:
            raise checks.input_error(
                "observed", data.describe(), "left to infer(…), since this posterior was learnt in"
                " rounds, for its own data alone", "With rounds=1, it holds for others.",
            )  # fmt: skip
        when = self.observed.time if self.task.until is None else self.task.until
        now = data.time
        if when is not None and now is not None and abs(now - when) > 1e-6 * when:
            raise checks.input_error(
                "observed",
                data.describe(),
                f"data of {when:g} h, since the posterior was learnt from colonies of that age",
                "Call infer(…) for data of another time.",
            )
        known = self.task, self.prior, self.simulations, self.estimator
        return self.of(*known, data, len(self.points))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return self.task.space.names

    @property
    def samples(self) -> dict[str, np.ndarray]:
        """Samples of each parameter by name, (S,) each; sample k of all of them belongs
        together."""
        return {n: _column(v) for n, v in shown_values(self.task, self.points).items()}

    @property
    def mean(self) -> dict[str, Value]:
        """The mean of each parameter, with log=True the geometric one; of a choice or a whole
        number the most frequent value."""
        return {
            p.name: p.value(float(self.points[:, k].mean()))
            if isinstance(p, Parameter) and p.levels is None
            else _most_frequent(self.samples[p.name])
            for k, p in enumerate(self.task.space.parameters)
        }

    def interval(self, level: float = LEVEL) -> dict[str, tuple[float, float]]:
        """The central interval of each number, which holds it with a probability of `level`.
        Choices have none."""
        checks.number("level", level, above=0.0, most=1.0)
        ends = [0.5 - 0.5 * level, 0.5 + 0.5 * level]
        found = {}
        for k, p in enumerate(self.task.space.parameters):
            if isinstance(p, Parameter):
                low, high = np.quantile(self.points[:, k], ends)
                found[p.name] = (float(p.value(float(low))), float(p.value(float(high))))
        return found

    @property
    def surprises(self) -> list[str]:
        """Statistics of the data that hardly any simulation reaches. Where there are some, no
        parameters within the bounds grow such colonies, and the samples mean little."""
        statistics = self.simulations.statistics[self.simulations.sound]
        errors = standard_errors(self.observed)
        out = []
        for k, name in enumerate(self.observed.plan.names):
            value, column = self.observed.values[k], statistics[:, k]
            slack = 0.5 * errors[k]  # as far as a standard error counts as reached
            share = min((column <= value + slack).mean(), (column >= value - slack).mean())
            if share < BEYOND:
                out.append(
                    f"{name} is {value:.4g}; of the simulations {column.min():.4g} to"
                    f" {column.max():.4g}"
                )
        return out

    @property
    def other_sizes(self) -> str:
        """Whether simulated colonies have far more or fewer cells than those that were observed,
        where the number of cells is not compared; else ""."""
        names, cells = self.observed.plan.names, self.simulations.cells[self.simulations.sound]
        compared = any(name.startswith(LOG_CELLS) for name in names)
        seen, counts = cells_each(self.observed), cells[np.isfinite(cells)]
        if compared or not seen or not len(counts):
            return ""
        found = float(np.median(counts))
        if 1 / ALIKE <= found / seen <= ALIKE:
            return ""
        return (
            f"{found:.0f} cells of each simulated colony were seen, and {seen:.0f} of each observed"
            " one: the intervals are those of data of as many cells as were simulated, too"
            f" {'narrow' if found > seen else 'wide'}. Simulate as many as were observed (founders,"
            " until), or observe as many."
        )

    def table(self, level: float = LEVEL) -> str:
        """The parameters with their means and intervals, failures, and what no simulation
        reaches."""
        intervals, means = self.interval(level), self.mean
        width = max(len(name) for name in (*self.names, "parameter"))
        lines = [f"{'parameter':<{width}} {'mean':>10}  {100 * level:g} % interval, bounds"]
        for p in self.task.space.parameters:
            line = f"{p.name:<{width}} {show_value(means[p.name]):>10}"
            if isinstance(p, Parameter):
                low, high = (f"{v:.4g}" for v in intervals[p.name])
                line += f"  {low} to {high}, of {p.low:g} to {p.high:g}"
                line += " log" if p.log else ""
                line += f", {self.prior.words(p.name)}" if p.name in self.prior.given else ""
            else:
                share = np.mean(self.samples[p.name] == means[p.name])
                line += f"  {100 * share:.0f} % of the samples"
            lines.append(line)
        lines.append(f"from {len(self.simulations)} simulations; {self.observed.describe()}")
        lines += self._region_words()
        failures = self.simulations.failures()
        lines += [f"{n} simulations failed: {why}" for why, n in failures[:3]]
        if len(failures) > 3:
            lines.append(f"{sum(n for _, n in failures[3:])} simulations failed for other reasons")
        if self.task.reduce != SURVIVORS:
            lines += extinct_words(self.observed, [why for why, _ in failures])
        lines += told_together(self.correlations)
        if self.other_sizes:
            lines.append(self.other_sizes)
        if self.surprises:
            lines.append("The model does not reach the data within these bounds:")
            lines += [f"  {words}" for words in self.surprises]
        return tf.displays.Text("\n".join(lines))

    def _region_words(self) -> list[str]:
        """Where the simulations of the last of several rounds lie."""
        region, rounds = self.estimator.region, len(self.simulations.regions)
        if rounds < 2:
            return []
        parts = []
        for k in self.task.space.moving:
            p = self.task.space.parameters[k]
            low, high = (float(p.value(float(x[k]))) for x in (region.low, region.high))
            parts.append(f"{p.name} {low:.4g} to {high:.4g}")
        return [f"in {rounds} rounds; the last within {', '.join(parts) or 'the bounds'}"]

    def __repr__(self) -> str:
        return f"Posterior(mean={self.mean}, {len(self.points)} samples)"

    def _repr_html_(self) -> str:
        return tf.displays.card("Posterior", tf.displays.text(self.table()))

    def plot(
        self, out: str | Path | None = None, truth: dict[str, Value] | None = None
    ) -> tf.pictures.Picture:
        """Draw the samples: of each parameter, and of each two of them; and the prior, where
        something was known. truth: values to mark.
        out: as for `Best.plot`. Needs matplotlib (the `app` extra)."""
        marked = None if truth is None else self.task.space.point(truth)
        before = None
        if self.prior.given:
            before = random_points(self.task, self.prior, PRIOR_DRAWN, stream=DRAWN)
        return tf.pictures.Picture(draw_corner(self.task.space, self.points, marked, before), out)

    def check(self, truths: int = 200, *, samples: int = 999) -> Calibration:
        """Simulation-based calibration (Talts et al., arXiv 1804.06788): grow colonies of hidden,
        random parameters, and see how often the posteriors of their statistics cover these. It
        costs `truths` simulations and no learning. Of a posterior that was learnt in rounds, the
        parameters lie within the region of the last. Raises InputError where all truths fail."""
        checks.integer("truths", truths, least=2)
        checks.integer("samples", samples, least=9)
        within = self.estimator.region
        points = random_points(self.task, self.prior, truths, stream=STREAM, region=within)
        found = simulate_points(self.task, points, _first(self.task, STREAM))
        _check_some(found)
        hidden, seen = points[found.sound], found.statistics[found.sound]
        drawn = self.estimator.sample(seen, samples, seed=self.task.seed + 1)
        here = self.estimator.log_density(hidden[:, None], seen)
        there = self.estimator.log_density(drawn, seen)
        return Calibration(
            names=self.names,
            ranks=(drawn < hidden[:, None]).sum(1),
            density_ranks=(there > here).sum(1),
            samples=samples,
            failed=truths - len(hidden),
        )

    def predict(self, count: int = 100) -> Prediction:
        """Grow colonies by `count` samples of the parameters, to compare with the observed ones:
        whether the model can grow such colonies, and whether the posterior is as narrow as the data
        allow. It costs `count` simulations. Raises InputError where all fail."""
        checks.integer("count", count, least=2)
        rows = np.random.default_rng([self.task.seed, PREDICTED]).integers(
            len(self.points), size=count
        )
        found = simulate_points(self.task, self.points[rows], _first(self.task, PREDICTED))
        _check_some(found)
        sound = found.sound
        failed, replicates = int((~sound).sum()), self.task.replicates
        kept = found.points[sound], found.statistics[sound]
        return Prediction(self.observed, *kept, failed, replicates)

    @property
    def correlations(self) -> dict[tuple[str, str], float]:
        """Of each two parameters, between the samples, on the scale of their bounds. Near 1 or −1
        the data tell little of each, but much of one combination of both."""
        numbers = [k for k, p in enumerate(self.task.space.parameters) if isinstance(p, Parameter)]
        varied = [k for k in numbers if self.points[:, k].std() > 0]
        found = {}
        for place, k in enumerate(varied):
            for other in varied[place + 1 :]:
                r = np.corrcoef(self.points[:, k], self.points[:, other])[0, 1]
                found[self.names[k], self.names[other]] = float(r)
        return found


def _first(task: Task, stream: int) -> int:
    """The number of the first simulation of a stream, whose random numbers no simulation that is
    learnt from, and none of another stream, has used."""
    room = 2**32 // (task.replicates * task.conditions)  # each colony has a number below 2**32
    part = min(2**20, room // 32)
    return (16 + stream) * part


def _check_some(found: Simulations) -> None:
    """Raise InputError where all simulations failed."""
    if not found.sound.any():
        why = found.failures()[0][0]
        raise tf.InputError(f"all {len(found)} simulations failed: {why}")


def _most_frequent(values: np.ndarray) -> Value:
    found: Value = Counter(values.tolist()).most_common(1)[0][0]
    return found


def _column(values: list[Value]) -> np.ndarray:
    """(S,); options of several kinds, such as "auto" and 3, stay what they are."""
    kinds = {type(value) for value in values}
    several = len(kinds) > 1 and not kinds <= {int, float}
    return np.array(values, dtype=object if several else None)
