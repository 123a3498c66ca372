"""Networks that were learnt before, so that they are not learnt again from the same numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import nn

import torchfilm as tf
from design.data_file import reading, replacing, stamp
from torchfilm import checks

FORMAT, VERSION = "torchfilm networks", 1
GROUP = "networks"
Weights = dict[str, np.ndarray]


@dataclass(eq=False)
class LearntNetworks:
    """The weights of networks, each by a word for what it was learnt from. path: of the file that
    keeps them, or None. new: words of those that it does not hold yet."""

    path: Path | None = None
    known: dict[str, Weights] = field(default_factory=dict)
    new: set[str] = field(default_factory=set)

    @staticmethod
    def beside(path: Path | None) -> LearntNetworks:
        """Those that are kept beside a file of simulations, as RUN.networks.h5 beside RUN.h5."""
        own = None if path is None else path.with_name(f"{path.stem}.networks.h5")
        return LearntNetworks(own, _read(own))

    def network(
        self, about: object, build: Callable[[], nn.Module], learn: Callable[[], nn.Module]
    ) -> nn.Module:
        """The network learnt from what `about` tells, all of it: as it was kept, in what `build`
        makes, or learnt now."""
        word = tf.digest(about, str(torch.__version__))
        if word in self.known:
            network = build()
            weights = {name: torch.from_numpy(x) for name, x in self.known[word].items()}
            try:
                network.load_state_dict(weights)
                return network.eval()
            except RuntimeError:
                checks.warn(f"a network in {self.path} is damaged, and is learnt again.")
        network = learn()
        self.known[word] = {n: x.numpy(force=True) for n, x in network.state_dict().items()}
        self.new.add(word)
        return network

    def write(self) -> None:
        """Add the new ones to the file. They can be learnt again, so that it warns where there is
        no room, or where another process writes the file."""
        if self.path is None or not self.new:
            return
        try:
            before = stamp(self.path)
            kept = _read(self.path) | self.known
            with replacing(self.path, FORMAT, VERSION, {}, "earlier networks", before) as file:
                for word, weights in kept.items():
                    group = file.create_group(f"{GROUP}/{word}")
                    for name, value in weights.items():
                        group.create_dataset(name, data=value)
        except (tf.SimulationError, tf.InputError) as error:
            checks.warn(f"what was learnt is not kept: {error}")
            return
        self.new.clear()


def _read(path: Path | None) -> dict[str, Weights]:
    """The networks of a file, by their words; none where there is none. Raises InputError for a
    file of another kind."""
    if path is None or not path.exists():
        return {}
    try:
        with reading(path, FORMAT, VERSION, "file of networks") as file:
            groups = file.get(GROUP, {}).items()
            return {word: {name: x[...] for name, x in group.items()} for word, group in groups}
    except tf.InputError as error:
        hint = "It keeps what can be learnt again: move it away, or delete it."
        raise tf.InputError(f"{error} {hint}") from error
