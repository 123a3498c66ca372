"""Neural posterior estimation: a density of parameters for any statistics, learnt from
simulations."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import torchfilm as tf
from design.learnt import LearntNetworks
from design.options import Classifier, Options
from design.quiet import ALONE, alone_and_quiet
from design.region import Region

FORM = "maf"  # of flows, as sbi calls it: masked autoregressive
EDGE = 1e-6  # coordinates this close to a bound count as so close
FARTHEST = 10.0  # standard deviations: statistics farther off count as so far
CONSTANT = 1e-9  # a standard deviation, relative to the mean, from which a statistic varies
SAMPLES_AT_ONCE = 2**16
# A flow that gives the truths of all simulations this much less density, in the logarithm, than
# another one or than the linear regression has ended in a poor optimum. It is learnt again so
# often.
POOR, AGAIN = 1.0, 2
WIDE = 30.0  # errors: statistics that vary by more between simulations are compressed
ENOUGH = 5  # simulations for each statistic; a regression on fewer fits them better than others


@dataclass(frozen=True, eq=False)
class Regression:
    """A linear regression of parameters on statistics.

    weights: (1 + K', D); root: (D, D), the Cholesky factor of the residuals' covariance.
    """

    weights: Tensor
    root: Tensor

    @staticmethod
    def of(theta: Tensor, x: Tensor) -> Regression:
        """Of theta (n, D) on x (n, K')."""
        given = _with_one(x)
        weights = torch.linalg.lstsq(given, theta, driver="gelsd").solution
        left = theta - given @ weights
        spread = left.T @ left / len(left) + CONSTANT * torch.eye(left.shape[1], dtype=left.dtype)
        return Regression(weights, torch.linalg.cholesky(spread))

    @staticmethod
    def none(theta: Tensor, x: Tensor) -> Regression:
        """What leaves theta as it is."""
        size = theta.shape[1]
        return Regression(theta.new_zeros(1 + x.shape[1], size), torch.eye(size, dtype=theta.dtype))

    @property
    def fit(self) -> float:
        """The mean logarithm of the density of theta."""
        return -0.5 * len(self.root) * (math.log(2 * math.pi) + 1.0) - self.log_scale

    @property
    def log_scale(self) -> float:
        """By how much the logarithm of the density of residuals is above that of theta."""
        return float(self.root.diagonal().log().sum())

    def residuals(self, theta: Tensor, x: Tensor) -> Tensor:
        """Of theta (…, n, D), for x (n, K'), without their covariance."""
        left = theta - _with_one(x) @ self.weights
        return torch.linalg.solve_triangular(self.root.T, left, upper=True, left=False)

    def theta(self, residuals: Tensor, x: Tensor) -> Tensor:
        """The inverse of `residuals`."""
        return _with_one(x) @ self.weights + residuals @ self.root.T


@dataclass(frozen=True, eq=False)
class Flow:
    """A conditional density of theta = ln(u/(1 − u)), given statistics x.

    density: a normalising flow, of the residuals of the regression.
    """

    density: Any
    regression: Regression

    def sample(self, classes: Tensor, x: Tensor, options: Options) -> Tensor:
        """A sample for each class (m, count) of the options, given each row of x (m, K'): (m,
        count, D)."""
        given = _with_options(x.repeat_interleave(classes.shape[1], 0), classes.flatten(), options)
        drawn = self.density.sample((1,), condition=given.float())[0].double()
        return self.regression.theta(drawn, given).unflatten(0, classes.shape)

    def log_density(self, theta: Tensor, classes: Tensor, x: Tensor, options: Options) -> Tensor:
        """Of theta (m, n, D) and classes (m, n), for each row of x (m, K'): (m, n)."""
        given = _with_options(x.repeat_interleave(classes.shape[1], 0), classes.flatten(), options)
        return self.of_rows(theta.flatten(0, 1), given).unflatten(0, classes.shape)

    def of_rows(self, theta: Tensor, given: Tensor) -> Tensor:
        """The logarithm of the density of theta (n, D), given statistics and options, (n,)."""
        left = self.regression.residuals(theta, given).float()
        found = self.density.log_prob(left[None], condition=given.float())[0].double()
        return found - self.regression.log_scale


def _with_options(x: Tensor, classes: Tensor, options: Options) -> Tensor:
    """Statistics (n, K') with a column for each class but the first."""
    if not options.places:
        return x
    hot = nn.functional.one_hot(classes, options.classes)[:, 1:]
    return torch.cat([x, hot.to(x)], 1)


def _with_one(x: Tensor) -> Tensor:
    return torch.cat([torch.ones_like(x[:, :1]), x], 1)


@dataclass(frozen=True, eq=False)
class NeuralPosterior:
    """The density of parameters, given statistics, as the mean of some normalising flows.

    options: of choices; classifier: how likely they are; flows are given the options, too.
    flows: of ln(u/(1 − u)), where u in [0, 1] are the coordinates of parameters as shares of
    `region`, within which all samples lie. Over the whole bounds the relation is far from linear,
    and they have no regression; in a part of them they have. unit: (K,) of the statistics that vary
    by far more than their errors, else infinite; of these, flows take arsinh(statistic/unit), in
    which data are as sharp where statistics are small as where they are large. centre, scale: (K',)
    of those in use; used: which they are, (K,) bool.
    """

    flows: tuple[Flow, ...]
    unit: np.ndarray
    centre: Tensor
    scale: Tensor
    used: np.ndarray
    region: Region
    options: Options
    classifier: Classifier | None

    @staticmethod
    @tf.one_torch_thread()  # flows are so small that threads take longer to meet than to compute
    def learn(
        points: np.ndarray,
        statistics: np.ndarray,
        *,
        unit: np.ndarray | float = 1.0,
        region: Region | None = None,
        levels: Sequence[int | None] = (),
        seed: int,
        flows: int,
        epochs: int,
        begun: Callable[[int], None] = lambda _: None,
        kept: LearntNetworks | None = None,
    ) -> NeuralPosterior:
        """Learn from simulations: points (n, D) within the region, by default all in [0, 1],
        statistics (n, K), all finite. unit: of each statistic, about its error. levels: the
        options of each dimension, None of one that has none.

        The method is that of Papamakarios and Murray (NeurIPS 2016) with masked autoregressive
        flows, by the package sbi; the mean of several flows is less sure of itself than each
        (Hermans et al., TMLR 2022). epochs: passes through the data at most; learning ends before,
        20 passes after the loss on a tenth of the data has ceased to fall. One flow in ten ends in
        a poor optimum, as wide as the bounds; it is learnt again, and left out if it stays so. It
        warns where all are poor. begun: called with the number of each flow, from 0, before it is
        learnt. kept: networks that need not be learnt again; those learnt now are added. Needs sbi
        (the `infer` extra). The state of torch's random numbers is kept.
        """
        require_sbi()
        unit = np.where(statistics.std(0) > WIDE * np.asarray(unit), unit, np.inf)
        seen = _compressed(statistics, unit)
        spread, level = seen.std(0), np.abs(seen).max(0)
        used = spread > CONSTANT * np.maximum(level, CONSTANT)
        if not used.any():
            of = "" if region is None or region.is_whole else " of a round"
            hint = "Widen their bounds, or observe something else." if not of else "Give rounds=1."
            raise tf.InputError(
                f"all simulations{of} have the same statistics: the parameters do not change what"
                f" was observed. {hint}"
            )
        centre, scale = (torch.tensor(v[used]) for v in (seen.mean(0), spread))
        region = region or Region.whole(points.shape[1])
        options = Options.of(levels)
        rest = options.rest(points.shape[1])
        x = _scaled(torch.as_tensor(seen[:, used]), centre, scale)
        classes = torch.as_tensor(options.of_points(points))
        theta = _logit(torch.as_tensor(region.widen(points)[:, rest]))
        kept = LearntNetworks() if kept is None else kept
        with ALONE, torch.random.fork_rng(devices=[]):
            classifier: Classifier | None = None
            learnt: tuple[Flow, ...] = ()
            if options.places:
                classifier = Classifier.learn(
                    x, classes, options.classes, seed=seed, networks=flows, epochs=epochs,
                    kept=kept,
                )  # fmt: skip
            if rest:
                given = _with_options(x, classes, options)
                line, least = Regression.none(theta, given), -math.inf
                if len(x) >= ENOUGH * given.shape[1]:
                    known = Regression.of(theta, given)
                    line, least = line if region.is_whole else known, known.fit
                learnt = _learn_flows(theta, given, line, least, seed, flows, epochs, begun, kept)
        return NeuralPosterior(learnt, unit, centre, scale, used, region, options, classifier)

    def _inputs(self, statistics: np.ndarray) -> Tensor:
        seen = torch.as_tensor(_compressed(statistics, self.unit)[:, self.used])
        return _scaled(seen, self.centre, self.scale)

    @torch.no_grad()
    @tf.one_torch_thread()
    def sample(self, statistics: np.ndarray, count: int, *, seed: int) -> np.ndarray:
        """Samples of the parameters for each row of statistics (m, K): (m, count, D) coordinates
        in [0, 1]. Every flow gives an equal share of them."""
        x = self._inputs(statistics)
        rows = max(1, SAMPLES_AT_ONCE // count)
        with ALONE, torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            parts = [self._draw(some, count) for some in x.split(rows)]
        return np.concatenate(parts)

    def _draw(self, x: Tensor, count: int) -> np.ndarray:
        """Coordinates (m, count, D) for inputs x (m, K')."""
        out = np.empty((len(x), count, len(self.region.low)))
        classes = torch.zeros(len(x), count, dtype=torch.int64)
        if self.classifier is not None:
            shares = self.classifier.log_shares(x).exp()
            classes = torch.multinomial(shares, count, replacement=True)
            within = torch.rand(*classes.shape, len(self.options.places), dtype=torch.float64)
            found = self.options.coordinates(classes.numpy(), within.numpy())
            out[..., list(self.options.places)] = found
        if self.flows:
            ends = [count * k // len(self.flows) for k in range(len(self.flows) + 1)]
            theta = torch.cat([
                flow.sample(classes[:, first:last], x, self.options)
                for flow, first, last in zip(self.flows, ends, ends[1:], strict=False)
                if last > first
            ], 1)  # fmt: skip
            whole = np.zeros_like(out)
            rest = self.options.rest(out.shape[-1])
            whole[..., rest] = torch.sigmoid(theta).numpy()
            out[..., rest] = self.region.narrow(whole)[..., rest]
        return out

    @torch.no_grad()
    @tf.one_torch_thread()
    def log_density(self, points: np.ndarray, statistics: np.ndarray) -> np.ndarray:
        """The logarithm of the density of coordinates, (m, n), for points (m, n, D) and one row of
        statistics each, (m, K)."""
        x = self._inputs(statistics)
        classes = torch.as_tensor(self.options.of_points(points))
        found = torch.zeros(points.shape[:-1], dtype=torch.float64)
        if self.classifier is not None:
            # evenly within each level
            found = self.classifier.log_shares(x).gather(1, classes) + math.log(
                self.options.classes
            )
        if self.flows:
            rest = self.options.rest(points.shape[-1])
            u = torch.as_tensor(self.region.widen(points)[..., rest]).clamp(EDGE, 1.0 - EDGE)
            each = [flow.log_density(_logit(u), classes, x, self.options) for flow in self.flows]
            found = found + torch.logsumexp(torch.stack(each), 0) - math.log(len(each))
            # from ln(u/(1 − u)) to u, and from this to coordinates
            found = found - (u * (1.0 - u)).log().sum(-1)
        width = float(np.log(self.region.high - self.region.low).sum())
        return np.where(self.region.holds(points), found.numpy() - width, -np.inf)


def _compressed(statistics: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """arsinh(statistic/unit), and the statistic itself where its unit is infinite."""
    finite = np.isfinite(unit)
    return np.where(finite, np.arcsinh(statistics / np.where(finite, unit, 1.0)), statistics)


def _scaled(seen: Tensor, centre: Tensor, scale: Tensor) -> Tensor:
    return ((seen - centre) / scale).clamp(-FARTHEST, FARTHEST)


def require_sbi() -> None:
    """Raises InputError where the package sbi is missing."""
    if find_spec("sbi") is None:
        raise tf.InputError(f"inference needs the package sbi: {tf.checks.install('infer')}.")


class _NoTracker:
    """sbi reports its progress to this instead of writing files."""

    log_dir = None

    def log_metric(self, name: str, value: float, step: int | None = None) -> None: ...

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None: ...

    def log_params(self, params: dict[str, Any]) -> None: ...

    def add_figure(self, name: str, figure: Any, step: int | None = None) -> None: ...

    def flush(self) -> None: ...


def _kept_flow(residuals: Tensor, x: Tensor, seed: int, epochs: int, kept: LearntNetworks) -> Any:
    """As `_learn_flow`, or as it was kept."""

    def build() -> Any:
        with alone_and_quiet():
            from sbi.neural_nets import posterior_nn

            return posterior_nn(model=FORM)(residuals, x)

    about = FORM, version("sbi"), residuals, x, seed, epochs
    return kept.network(about, build, lambda: _learn_flow(residuals, x, seed, epochs))


def _learn_flow(residuals: Tensor, x: Tensor, seed: int, epochs: int) -> Any:
    """One flow, from its own start and division of the data."""
    # sbi warns of its own imports, and prints when it has converged
    with alone_and_quiet(), redirect_stdout(io.StringIO()):
        from sbi.inference import NPE

        torch.manual_seed(seed)
        learner = NPE(density_estimator=FORM, show_progress_bars=False, tracker=_NoTracker())
        learner.append_simulations(residuals, x)
        batch = min(200, max(2, len(residuals) // 10))
        return learner.train(training_batch_size=batch, max_num_epochs=epochs).eval()


def _learn_flows(
    theta: Tensor,
    x: Tensor,
    line: Regression,
    least: float,
    seed: int,
    flows: int,
    epochs: int,
    begun: Callable[[int], None],
    kept: LearntNetworks,
) -> tuple[Flow, ...]:
    """As many flows, without those in poor optima; at least one. line: the regression below each;
    least: the fit of one alone."""
    left = line.residuals(theta, x).float()
    found: list[tuple[float, Flow | None]] = [(-math.inf, None)] * flows
    for attempt in range(AGAIN + 1):
        poor = max(least, *(fit for fit, _ in found)) - POOR
        for k in range(flows):
            if found[k][1] is not None and found[k][0] >= poor:
                continue
            begun(k)
            own = seed + attempt * flows + k
            made = Flow(_kept_flow(left, x.float(), own, epochs, kept), line)
            with torch.no_grad():
                fit = float(made.of_rows(theta, x).mean())
            if found[k][1] is None or fit > found[k][0]:
                found[k] = fit if math.isfinite(fit) else -math.inf, made
    best = max(fit for fit, _ in found)
    if best < least - POOR:
        tf.checks.warn(
            "The estimator has learnt less from the simulations than a linear regression would, so"
            " that the posterior is too wide. Give more simulations or epochs, or leave out"
            " statistics (observed.without(…))."
        )
    return tuple(made for fit, made in found if made is not None and fit >= best - POOR)


def _logit(u: Tensor) -> Tensor:
    u = u.double().clamp(EDGE, 1.0 - EDGE)
    return torch.log(u) - torch.log1p(-u)
