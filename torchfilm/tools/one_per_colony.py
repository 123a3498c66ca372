"""What users may give as one number, or as one per colony: its types, and their tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class OnePerColony(Protocol):
    """What states one value per colony, such as `tf.PerColony([0.6, 1.2])`."""

    @property
    def one_per_colony(self) -> Tensor | Sequence[float]: ...


Value = float | Tensor | Sequence[float] | NDArray[Any] | OnePerColony
Kept = float | Tensor  # what a description keeps of it, once checked


def by_position(given: Any) -> Any:
    """A column of a data frame as an array: torch would read it by the labels of its rows. Anything
    else stays."""
    column = hasattr(given, "__array__") and not isinstance(given, (Tensor, np.ndarray))
    return np.array(given) if column else given  # a copy, since columns may be read-only


def _dtype(given: Any) -> torch.dtype | None:
    return given.dtype if isinstance(given, Tensor) else None


def as_tensor(given: Any) -> Any:
    """A list, an array or a column of a data frame as a tensor of its own; anything else stays.
    Raises TypeError, ValueError or RuntimeError for what holds no numbers."""
    if isinstance(given, (list, tuple)):
        if any(isinstance(x, (bool, np.bool_)) or _dtype(x) == torch.bool for x in given):
            raise TypeError("True and False are no numbers")
        devices = [x.device for x in given if isinstance(x, Tensor)]
        if not devices:
            return torch.tensor(given, dtype=torch.float64)
        # on a GPU where one of them is
        device = next((d for d in devices if d.type != "cpu"), devices[0])
        return torch.stack([torch.as_tensor(x).to(device, torch.float64) for x in given])
    if hasattr(given, "__array__") and not isinstance(given, Tensor):
        copied = np.array(given)  # the caller may change its own
        return torch.from_numpy(copied.astype(np.float64) if copied.dtype.kind in "iu" else copied)
    return given
