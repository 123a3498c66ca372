"""Neural posterior estimation: a density of parameters for any statistics, learnt from
simulations."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.quiet import ALONE, alone_and_quiet

EDGE = 1e-6  # coordinates this close to a bound count as so close
FARTHEST = 10.0  # standard deviations: statistics farther off count as so far
CONSTANT = 1e-9  # a standard deviation, relative to the mean, from which a statistic varies
SAMPLES_AT_ONCE = 2**16
# A flow that gives the truths of all simulations this much less density, in the logarithm, than
# another one or than a straight line through them, has ended in a poor optimum. It is learnt again
# so often.
POOR, AGAIN = 1.0, 2
ENOUGH = 5  # simulations for each statistic; a line through fewer fits them better than others


@dataclass(frozen=True, eq=False)
class NeuralPosterior:
    """The density of parameters, given statistics, as the mean of some normalising flows.

    flows: conditional densities of ln(u/(1 − u)), where u in [0, 1] are the coordinates of
    parameters. centre, scale: (K',) of the statistics in use; used: which they are, (K,) bool.
    """

    flows: tuple[Any, ...]
    centre: Tensor
    scale: Tensor
    used: np.ndarray

    @staticmethod
    @tf.one_torch_thread()  # flows are so small that threads take longer to meet than to compute
    def learn(
        points: np.ndarray,
        statistics: np.ndarray,
        *,
        seed: int,
        flows: int,
        epochs: int,
        begun: Callable[[int], None] = lambda _: None,
    ) -> NeuralPosterior:
        """Learn from simulations: points (n, D) in [0, 1], statistics (n, K), all finite.

        The method is that of Papamakarios and Murray (NeurIPS 2016) with masked autoregressive
        flows, by the package sbi; the mean of several flows is less sure of itself than each
        (Hermans et al., TMLR 2022). epochs: passes through the data at most; learning ends before,
        20 passes after the loss on a tenth of the data has ceased to fall. One flow in ten ends in
        a poor optimum, as wide as the bounds; it is learnt again, and left out if it stays so. It
        warns where all are poor. begun: called with the number of each flow, from 0, before it is
        learnt. Needs sbi (the `infer` extra). The state of torch's random numbers is kept.
        """
        require_sbi()
        spread, level = statistics.std(0), np.abs(statistics).max(0)
        used = spread > CONSTANT * np.maximum(level, CONSTANT)
        if not used.any():
            raise tf.InputError(
                "all simulations have the same statistics: the parameters do not change what was"
                " observed. Widen their bounds, or observe something else."
            )
        centre, scale = (torch.tensor(v[used]) for v in (statistics.mean(0), spread))
        learner = NeuralPosterior((), centre, scale, used)
        theta, x = _logit(torch.as_tensor(points)).float(), learner._inputs(statistics)
        with ALONE, torch.random.fork_rng(devices=[]):
            return NeuralPosterior(
                _learn_flows(theta, x, seed, flows, epochs, begun), centre, scale, used
            )

    def _inputs(self, statistics: np.ndarray) -> Tensor:
        found = (torch.as_tensor(statistics[:, self.used]) - self.centre) / self.scale
        return found.clamp(-FARTHEST, FARTHEST).float()

    @torch.no_grad()
    @tf.one_torch_thread()
    def sample(self, statistics: np.ndarray, count: int, *, seed: int) -> np.ndarray:
        """Samples of the parameters for each row of statistics (m, K): (m, count, D) coordinates
        in [0, 1]. Every flow gives an equal share of them."""
        x = self._inputs(statistics)
        rows = max(1, SAMPLES_AT_ONCE // count)
        shares = [count * (k + 1) // len(self.flows) - count * k // len(self.flows)
                  for k in range(len(self.flows))]  # fmt: skip
        with ALONE, torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            parts = [
                torch.cat([flow.sample((share,), condition=some)
                           for flow, share in zip(self.flows, shares, strict=True) if share])
                for some in x.split(rows)
            ]  # fmt: skip
        return torch.sigmoid(torch.cat(parts, 1).double()).transpose(0, 1).contiguous().numpy()

    @torch.no_grad()
    @tf.one_torch_thread()
    def log_density(self, points: np.ndarray, statistics: np.ndarray) -> np.ndarray:
        """The logarithm of the density of coordinates, (m, n), for points (m, n, D) and one row of
        statistics each, (m, K)."""
        x = self._inputs(statistics)
        u = torch.as_tensor(points).transpose(0, 1).clamp(EDGE, 1.0 - EDGE)
        z = _logit(u).float()
        each = [flow.log_prob(z, condition=x).double() for flow in self.flows]
        mixed = torch.logsumexp(torch.stack(each), 0) - math.log(len(each))
        # from ln(u/(1 − u)) to u
        return (mixed - (u * (1.0 - u)).log().sum(-1)).transpose(0, 1).numpy()


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


def _learn_flow(theta: Tensor, x: Tensor, seed: int, epochs: int) -> Any:
    """One flow, from its own start and division of the data."""
    # sbi warns of its own imports, and prints when it has converged
    with alone_and_quiet(), redirect_stdout(io.StringIO()):
        from sbi.inference import NPE

        torch.manual_seed(seed)
        learner = NPE(density_estimator="maf", show_progress_bars=False, tracker=_NoTracker())
        learner.append_simulations(theta, x)
        batch = min(200, max(2, len(theta) // 10))
        return learner.train(training_batch_size=batch, max_num_epochs=epochs).eval()


def _learn_flows(
    theta: Tensor, x: Tensor, seed: int, flows: int, epochs: int, begun: Callable[[int], None]
) -> tuple[Any, ...]:
    """As many flows, without those in poor optima; at least one."""
    line = _line_fit(theta, x) if len(x) >= ENOUGH * x.shape[1] else -math.inf
    found: list[tuple[float, Any]] = [(-math.inf, None)] * flows
    for attempt in range(AGAIN + 1):
        poor = max(line, *(fit for fit, _ in found)) - POOR
        for k in range(flows):
            if found[k][1] is not None and found[k][0] >= poor:
                continue
            begun(k)
            made = _learn_flow(theta, x, seed + attempt * flows + k, epochs)
            with torch.no_grad():
                fit = float(made.log_prob(theta.unsqueeze(0), condition=x).double().mean())
            if found[k][1] is None or fit > found[k][0]:
                found[k] = fit if math.isfinite(fit) else -math.inf, made
    best = max(fit for fit, _ in found)
    if best < line - POOR:
        warnings.warn(
            "The estimator has learnt less from the simulations than a straight line would, so that"
            " the posterior is too wide. Give more simulations or epochs, or leave out statistics"
            " (observed.without(…)).",
            stacklevel=2,
        )
    return tuple(made for fit, made in found if fit >= best - POOR)


def _line_fit(theta: Tensor, x: Tensor) -> float:
    """The mean logarithm of the density of theta (n, D) by a linear regression on x (n, K)."""
    given, wanted = torch.cat([torch.ones_like(x[:, :1]), x], 1).double(), theta.double()
    left = wanted - given @ torch.linalg.lstsq(given, wanted, driver="gelsd").solution
    spread = left.T @ left / len(left) + CONSTANT * torch.eye(left.shape[1], dtype=left.dtype)
    return -0.5 * float(torch.logdet(2 * math.pi * math.e * spread))


def _logit(u: Tensor) -> Tensor:
    u = u.double().clamp(EDGE, 1.0 - EDGE)
    return torch.log(u) - torch.log1p(-u)
