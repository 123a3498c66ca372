"""Bayesian optimisation: a smooth model of the loss and of its uncertainty chooses the points."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import torch

from design.methods.base import AskTell, Batch, numpy_kept, snap, sobol_points
from design.quiet import alone_and_quiet
from torchfilm import checks, one_torch_thread

# The optimisation of the acquisition starts from the best few of many samples, and takes so many
# steps: more made no difference to the searches, and took twice the time.
RESTARTS, SAMPLES, STEPS = 2, 64, 20
# Sobol points of a draw beyond its own, in place of points that were drawn before.
MORE = 64


@dataclass(kw_only=True, eq=False)
class Bayesian(AskTell):
    """A Gaussian process of the loss, and the noisy expected improvement over all points tried
    (Ament et al., NeurIPS 2023), by botorch.

    For some hundreds of designs: the choice of a batch takes seconds, and more with every known
    point. batch: points in a batch. first: Sobol points in the first batch, before there is a
    model; None is 2 (D + 1), at least `batch`. `Racing(inner=Bayesian())` grows three times as many
    as small colonies, and the model learns from the best of them.

    The loss is standardised; its noise is inferred. A loss that exceeds the median by more than
    twice the distance from the median to the best counts as that limit, so that failed designs do
    not flatten the model. Levels are rounded during the choice of points. A point drawn before is
    replaced by a Sobol point that is new, if one of many is. While all losses are equal, the method
    proposes Sobol points. The same bits need the same machine and versions.
    """

    batch: int = 8
    first: int | None = None

    def __post_init__(self) -> None:
        self.batch = checks.integer("Bayesian.batch", self.batch, least=1)
        if self.first is not None:
            self.first = checks.integer("Bayesian.first", self.first, least=2)
        if find_spec("botorch") is None:
            raise checks.InputError(
                f"Bayesian needs the package botorch: {checks.install('bayes')}."
            )

    def opening(self, size: int) -> int:
        """The points of the first batch in so many dimensions."""
        return self.first or max(self.batch, 2 * (size + 1))

    def _begin(self) -> None:
        size = self._started().size
        self._points = self._drawn = np.empty((0, size))
        self._loss = np.empty(0)
        self._open = self.opening(size)
        self._draws = 0  # points drawn so far
        self._tried: set[bytes] = set()
        self._recalled: np.ndarray | None = None

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """The model begins with them."""
        self._points, self._loss = points.copy(), loss.copy()
        self._draws = len(points)  # they may be the first Sobol points
        self._tried.update(row.tobytes() for row in self._points)

    @property
    def wanted(self) -> int:
        return self.batch if len(self._loss) else self._open

    @property
    def fresh(self) -> bool:
        return not len(self._loss)

    def recall(self, points: np.ndarray | None) -> None:
        """The points of the next draw, where the model would choose them: to do so takes seconds.
        None: they are not known."""
        self._recalled = points

    def draw(self, count: int) -> np.ndarray:
        space, loss = self._started(), tamed(self._loss)
        spare = sobol_points(space, self._seed, self._draws, count + MORE)
        recalled, self._recalled = self._recalled, None
        if not len(loss) or loss.min() == loss.max():
            self._drawn = spare[:count]
        elif recalled is not None and recalled.shape == (count, space.size):
            self._drawn = recalled.copy()
        else:
            self._drawn = self._untried(self._modelled(loss, count), spare)
        self._draws += count
        self._tried.update(row.tobytes() for row in self._drawn)
        return self._drawn

    def _untried(self, points: np.ndarray, spare: np.ndarray) -> np.ndarray:
        """The points, with spare ones for those that were drawn before or are twice among them."""
        taken, left = set(self._tried), iter(spare)
        for place in range(len(points)):
            while points[place].tobytes() in taken and (new := next(left, None)) is not None:
                points[place] = new
            taken.add(points[place].tobytes())
        return points

    def take(self, rows: np.ndarray, loss: np.ndarray) -> None:
        self._points = np.concatenate([self._points, self._drawn[rows]])
        self._loss = np.concatenate([self._loss, loss])

    def _next(self) -> Batch:
        return Batch(self.draw(self.wanted))

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        self.take(np.arange(len(loss)), loss)

    def _modelled(self, loss: np.ndarray, count: int) -> np.ndarray:
        """The points of a model of these losses, (count, D), which leave no trace in the global
        generators."""
        key = [self._seed, len(loss)]
        with (
            alone_and_quiet(),
            one_torch_thread(),  # matrices are small: another one would only wait
            torch.random.fork_rng(devices=[]),
            numpy_kept(key),
        ):
            # only this generator: torch.manual_seed would change those of the devices too
            torch.default_generator.manual_seed(
                int(np.random.SeedSequence(key).generate_state(1)[0])
            )
            return self._choose(loss, count)

    def _choose(self, loss: np.ndarray, count: int) -> np.ndarray:
        """The points with the greatest expected improvement, (count, D), chosen in turn, each given
        those before it."""
        from botorch.acquisition.logei import qLogNoisyExpectedImprovement
        from botorch.fit import fit_gpytorch_mll
        from botorch.models import SingleTaskGP
        from botorch.optim import optimize_acqf
        from botorch.sampling import SobolQMCNormalSampler
        from gpytorch.mlls import ExactMarginalLogLikelihood

        levels = self._started().levels
        known = torch.from_numpy(self._points.copy())
        model = SingleTaskGP(
            known,
            -torch.from_numpy((loss - loss.mean()) / loss.std()).unsqueeze(1),
            outcome_transform=None,
        )
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
        sampler = SobolQMCNormalSampler(torch.Size([128]), seed=len(loss))
        acquisition = qLogNoisyExpectedImprovement(
            model, known, sampler=sampler, prune_baseline=True
        )
        found, _ = optimize_acqf(
            acquisition,
            torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, known.shape[1]),
            q=count,
            num_restarts=RESTARTS,
            raw_samples=SAMPLES,
            options={"maxiter": STEPS},
            sequential=True,
            post_processing_func=lambda x: torch.from_numpy(
                snap(x.reshape(-1, x.shape[-1]).numpy(), levels)
            ).reshape(x.shape),
        )
        return snap(found.numpy(), levels)


def tamed(loss: np.ndarray) -> np.ndarray:
    """Losses, limited to the median plus twice the distance from the median to the best; unchanged
    where the median is the best, or where there are none."""
    if not len(loss):
        return loss
    middle = float(np.median(loss))
    room = middle - float(loss.min())
    return np.minimum(loss, middle + 2.0 * room) if room > 0 else loss
