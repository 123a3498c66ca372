"""Bayesian optimisation: a smooth model of the loss and of its uncertainty chooses the points."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import torch

from design.methods.base import Batch, Turns, check_kind, numpy_kept, snap, sobol_points, whole
from torchfilm import checks, one_torch_thread

# The optimisation of the acquisition starts from the best few of many samples, and takes so many
# steps: more made no difference to the searches, and took twice the time.
RESTARTS, SAMPLES, STEPS = 2, 64, 20


@dataclass(kw_only=True, eq=False)
class Bayesian(Turns):
    """A Gaussian process of the loss, and the noisy expected improvement over all points tried
    (Ament et al., NeurIPS 2023), by botorch.

    For some hundreds of designs: the choice of a batch takes seconds, and more with every known
    point. batch: points in a batch. first: Sobol points in the first batch, before there is a
    model; None is 2 (D + 1), at least `batch`. `Racing(inner=Bayesian())` grows three times as many
    as small colonies, and the model learns from the best of them.

    The loss is standardised; its noise is inferred. A loss that exceeds the median by more than
    twice the distance from the median to the best counts as that limit, so that failed designs do
    not flatten the model. Levels are rounded during the choice of points. A point already tried is
    replaced by a Sobol point. While all losses are equal, the method proposes Sobol points. The
    same bits need the same machine and versions.
    """

    batch: int = 8
    first: int | None = None

    def __post_init__(self) -> None:
        whole("Bayesian.batch", self.batch, least=1)
        if self.first is not None:
            whole("Bayesian.first", self.first, least=2)
        if find_spec("botorch") is None:
            raise checks.InputError(
                f"Bayesian needs the package botorch: {checks.install('bayes')}."
            )

    def _begin(self) -> None:
        size = self._started().size
        self._points = self._drawn = np.empty((0, size))
        self._loss = np.empty(0)
        self._open = self.first or max(self.batch, 2 * (size + 1))
        self._draws = 0  # points drawn so far

    def know(self, points: np.ndarray, loss: np.ndarray) -> None:
        """The model begins with them."""
        self._points, self._loss = points.copy(), loss.copy()

    @property
    def wanted(self) -> int:
        return self.batch if len(self._loss) else self._open

    @property
    def fresh(self) -> bool:
        return not len(self._loss)

    def recall(self, points: np.ndarray) -> None:
        """Take points that it drew in a search that is resumed: to draw them again would take
        seconds."""
        self._drawn, self._draws = points, self._draws + len(points)

    def take(self, rows: np.ndarray, loss: np.ndarray) -> None:
        self._points = np.concatenate([self._points, self._drawn[rows]])
        self._loss = np.concatenate([self._loss, loss])

    def _meet(self, batch: Batch) -> None:
        """Check only the shape of a batch of a resumed search."""
        if self._batch is None and not self.fresh:
            check_kind((self.batch, self._started().size, 1.0, None), batch, "Bayesian")
            self.recall(batch.points)
        else:
            super()._meet(batch)

    def draw(self, count: int) -> np.ndarray:
        spare = sobol_points(self._started(), self._seed, self._draws, count)
        loss, known = tamed(self._loss), len(self._loss)
        self.recall(spare)
        if not known or loss.std() == 0:
            return self._drawn
        with (
            warnings.catch_warnings(),
            one_torch_thread(),  # matrices are small: another one would only wait
            torch.random.fork_rng(devices=[]),
            numpy_kept([self._seed, known]),
        ):
            warnings.simplefilter("ignore")
            # only this generator: torch.manual_seed would change those of the devices too
            torch.default_generator.manual_seed(
                int(np.random.SeedSequence([self._seed, known]).generate_state(1)[0])
            )
            points = self._choose(loss, count)
        tried = {row.tobytes() for row in self._points}
        for place, row in enumerate(points):
            if row.tobytes() in tried:
                points[place] = spare[place]
            tried.add(points[place].tobytes())
        self._drawn = points
        return points

    def _next(self) -> Batch:
        return Batch(self.draw(self.wanted))

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

    def _take(self, batch: Batch, loss: np.ndarray) -> None:
        self.take(np.arange(len(loss)), loss)


def tamed(loss: np.ndarray) -> np.ndarray:
    """Losses, limited to the median plus twice the distance from the median to the best; unchanged
    where the median is the best, or where there are none."""
    if not len(loss):
        return loss
    middle = float(np.median(loss))
    room = middle - float(loss.min())
    return np.minimum(loss, middle + 2.0 * room) if room > 0 else loss
