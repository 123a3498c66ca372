"""The types of a value that users give as one number, or as one per colony."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from numpy.typing import NDArray
from torch import Tensor


class OnePerColony(Protocol):
    """What states one value per colony, such as `tf.PerColony([0.6, 1.2])`."""

    @property
    def one_per_colony(self) -> Tensor | Sequence[float]: ...


Value = float | Tensor | Sequence[float] | NDArray[Any] | OnePerColony
Kept = float | Tensor  # what a description keeps of it, once checked
