"""The values that rules write: numbers and columns, checked before they reach the state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchfilm.state import State
from torchfilm.tools import checks


class RuleError(checks.InputError, AttributeError):
    """A rule read an unknown name, or wrote an invalid value."""


def check_integers(name: str, tensor: Tensor, dtype: torch.dtype) -> None:
    """Raises RuleError if a field of integers or flags would get other numbers."""
    if tensor.dtype == torch.bool or dtype.is_floating_point:
        return
    if dtype == torch.bool:
        odd = tensor[(tensor != 0) & (tensor != 1)]
        if odd.numel():
            raise RuleError(
                f"{name} is True or False for each cell; got {float(odd.reshape(-1)[0]):g}. For a"
                " probability write cells.random() < 0.02."
            )
    elif tensor.is_floating_point() and not bool((tensor == tensor.round()).all()):
        raise RuleError(
            f"{name} is an integer field; got non-integers. Give it a first value such as 0.0 if it"
            " should take any number."
        )


def real_column(what: str, value: Any, state: State) -> Tensor:
    """A column of real numbers (N,): conditions and integers count as numbers, integers in float64,
    and one number is that of all cells."""
    column = as_tensor(what, value, state.device)
    if not column.is_floating_point():
        column = column.to(state.dtype if column.dtype == torch.bool else torch.float64)
    if column.shape not in ((), (state.cells,)):
        raise RuleError(
            f"{what} was given a tensor of shape {tuple(column.shape)}: it must be one value for"
            f" each cell, ({state.cells},)."
        )
    return column.expand(state.cells)


def as_tensor(name: str, value: Any, device: torch.device) -> Tensor:
    """The value as a tensor, or RuleError."""
    try:
        return value if isinstance(value, Tensor) else torch.as_tensor(value, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise RuleError(f"{name} was set to {value!r}: it must be a number or a tensor.") from error


def broadcast_copy(name: str, tensor: Tensor, dtype: torch.dtype, shape: Sequence[int]) -> Tensor:
    """A copy with the given type and shape. Raises RuleError if it does not fit."""
    check_integers(name, tensor, dtype)
    try:
        return tensor.to(dtype).broadcast_to(shape).clone()
    except RuntimeError as error:
        raise RuleError(
            f"{name} was set to a tensor of shape {tuple(tensor.shape)}: it must be one value or"
            f" {tuple(shape)}."
        ) from error
