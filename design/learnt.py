"""Networks that were learnt before, so that they are not learnt again from the same numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import h5py
import numpy as np
import torch
from torch import nn

import torchfilm as tf

Weights = dict[str, np.ndarray]
GROUP = "networks"


@dataclass(eq=False)
class LearntNetworks:
    """The weights of networks, each by a word for what it was learnt from; `new` counts those that
    were added."""

    known: dict[str, Weights] = field(default_factory=dict)
    new: int = 0

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
            except RuntimeError as error:
                raise tf.InputError(
                    f"the kept network {word} is not of this form: its file is damaged, or of"
                    " another version of sbi. Delete the file, or give another path."
                ) from error
            return network.eval()
        network = learn()
        self.known[word] = {n: x.numpy(force=True) for n, x in network.state_dict().items()}
        self.new += 1
        return network

    def write(self, file: h5py.File) -> None:
        for word, weights in self.known.items():
            group = file.create_group(f"{GROUP}/{word}")
            for name, value in weights.items():
                group.create_dataset(name, data=value)

    @staticmethod
    def read(file: h5py.File) -> LearntNetworks:
        """Those of a file; none where it holds none, as one of an earlier version."""
        groups = file.get(GROUP, {})
        return LearntNetworks(
            {word: {name: x[...] for name, x in group.items()} for word, group in groups.items()}
        )
