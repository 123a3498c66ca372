"""How likely the options of choices are, given statistics: a classifier, learnt from
simulations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from design.learnt import LearntNetworks

MOST = 12  # combinations of options that a classifier tells apart
WIDTH, RATE, DECAY = 32, 5e-3, 1e-4  # of its hidden layers; of learning; of weights
BATCH, HELD = 200, 0.1  # simulations of a step, and the share that is held back
PATIENCE = 20  # passes after the loss on these has ceased to fall


@dataclass(frozen=True)
class Options:
    """The combinations of options of some choices, or of whole numbers, as classes.

    places: their dimensions; counts: the options of each.
    """

    places: tuple[int, ...] = ()
    counts: tuple[int, ...] = ()

    @staticmethod
    def of(levels: Sequence[int | None]) -> Options:
        """By the options of each dimension (None: it has none); nothing where they are too many."""
        found = [(k, count) for k, count in enumerate(levels) if count is not None]
        if not found or math.prod(count for _, count in found) > MOST:
            return Options()
        return Options(*(tuple(x) for x in zip(*found, strict=True)))

    @property
    def classes(self) -> int:
        """How many combinations there are."""
        return math.prod(self.counts)

    def rest(self, size: int) -> list[int]:
        """The other dimensions of `size`."""
        return [k for k in range(size) if k not in self.places]

    def of_points(self, points: np.ndarray) -> np.ndarray:
        """The class of designs (…, D), (…) int64."""
        found = np.zeros(points.shape[:-1], np.int64)
        for k, count in zip(self.places, self.counts, strict=True):
            found = found * count + np.minimum((points[..., k] * count).astype(np.int64), count - 1)
        return found

    def coordinates(self, classes: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """Of classes (…) the coordinates of the choices, (…, choices), which lie at `shares`, of
        the same shape, of their levels."""
        left, out = classes, np.empty((*classes.shape, len(self.places)))
        for k in reversed(range(len(self.places))):
            left, level = np.divmod(left, self.counts[k])
            out[..., k] = (level + shares[..., k]) / self.counts[k]
        return out


@dataclass(frozen=True, eq=False)
class Classifier:
    """The shares of classes, given statistics: the mean of some small networks."""

    networks: tuple[nn.Module, ...]

    @staticmethod
    def learn(
        x: Tensor, classes: Tensor, count: int, *, seed: int, networks: int, epochs: int,
        kept: LearntNetworks,
    ) -> Classifier:  # fmt: skip
        """From statistics (n, K) and the class of each, of `count`; those that are `kept` are not
        learnt again. The state of torch's random numbers is not kept."""
        found, build = [], lambda: _network(x.shape[1], count)
        for k in range(networks):
            given = x.float(), classes, count, seed + k, epochs
            learn = partial(_learn, *given)
            found.append(kept.network(("classifier", *given), build, learn).requires_grad_(False))
        return Classifier(tuple(found))

    def log_shares(self, x: Tensor) -> Tensor:
        """The logarithm of the share of each class for statistics (m, K), (m, classes)."""
        each = [network(x.float()).double().log_softmax(1) for network in self.networks]
        return torch.logsumexp(torch.stack(each), 0) - math.log(len(each))


def _network(statistics: int, classes: int) -> nn.Module:
    return nn.Sequential(
        nn.Linear(statistics, WIDTH), nn.Tanh(), nn.Linear(WIDTH, WIDTH), nn.Tanh(),
        nn.Linear(WIDTH, classes),
    )  # fmt: skip


@torch.enable_grad()
def _learn(x: Tensor, classes: Tensor, count: int, seed: int, epochs: int) -> nn.Module:
    """A network with the lowest loss on the simulations that are held back."""
    torch.manual_seed(seed)
    network = _network(x.shape[1], count)
    order = torch.randperm(len(x))
    held, rest = order.split([max(1, int(HELD * len(x))), len(x) - max(1, int(HELD * len(x)))])
    optimiser = torch.optim.Adam(network.parameters(), RATE, weight_decay=DECAY)
    best, kept, since = math.inf, network.state_dict(), 0
    for _ in range(epochs):
        for rows in rest[torch.randperm(len(rest))].split(BATCH):
            optimiser.zero_grad()
            nn.functional.cross_entropy(network(x[rows]), classes[rows]).backward()
            optimiser.step()
        with torch.no_grad():
            loss = float(nn.functional.cross_entropy(network(x[held]), classes[held]))
        since += 1
        if loss < best:
            best, since = loss, 0
            kept = {name: value.clone() for name, value in network.state_dict().items()}
        if since > PATIENCE:
            break
    network.load_state_dict(kept)
    return network.eval()
