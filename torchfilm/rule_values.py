"""The values that rules write: numbers and columns, checked before they reach the state."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchfilm.state import CELL, State
from torchfilm.tools import checks
from torchfilm.tools.one_per_colony import by_position
from torchfilm.tools.warn_once import warn


def near_name(name: str, known: Sequence[str]) -> str:
    """A hint at the known name that is like this one, or ""."""
    near = difflib.get_close_matches(name, known, 1, cutoff=0.75)
    near = near or [n for n in known if n.startswith(f"{name}_")]
    return f" Did you mean {near[0]!r}?" if near else ""


class RuleError(checks.InputError, AttributeError):
    """A rule read an unknown name, or wrote an invalid value."""


# `remove_flag` is no field, so daughters have none.
REMOVED_LATER = (
    "daughters have no remove_flag: rules remove cells in update(cells). Give Rules(…,"
    " variables={'doomed': 0.0}), set daughter1.doomed = 1.0 in divide, and cells.remove_flag ="
    " cells.doomed > 0 in update: the cell vanishes at the start of the next step."
)


def check_integers(name: str, tensor: Tensor, dtype: torch.dtype) -> None:
    """Raises RuleError if a field of integers or flags would get other numbers."""
    if tensor.dtype == torch.bool or dtype.is_floating_point:
        return
    if dtype == torch.bool:
        odd = tensor[(tensor != 0) & (tensor != 1)]
        if odd.numel():
            raise RuleError(
                f"{name} is True or False for each cell; got {float(odd.reshape(-1)[0]):g}. For a"
                " probability write cells.chance(0.02)."
            )
    elif tensor.is_floating_point() and not bool((tensor == tensor.round()).all()):
        raise RuleError(
            f"{name} takes whole numbers, and got {float(tensor[tensor != tensor.round()][0]):g}."
            + (
                ""
                if name.endswith("cell_type")
                else " Give it a first value such as 0.0 if it should take any number."
            )
        )


def real_column(what: str, value: Any, state: State) -> Tensor:
    """A column of real numbers (N,): conditions and integers count as numbers, integers in float64,
    and one number is that of all cells."""
    column = as_tensor(what, value, state.device, state.dtype)
    if not column.is_floating_point():
        column = column.to(state.dtype if column.dtype == torch.bool else torch.float64)
    if column.shape not in ((), (state.cells,)):
        raise RuleError(
            f"{what} was given a tensor of shape {tuple(column.shape)}: it must be one value for"
            f" each cell, ({state.cells},)."
        )
    return column.expand(state.cells)


def as_tensor(
    name: str, value: Any, device: torch.device, numbers: torch.dtype = torch.float64
) -> Tensor:
    """The value as a tensor, or RuleError. numbers: the type of Python's real numbers, of which
    torch's default would keep half of the digits."""
    try:
        value = by_position(value)
        if isinstance(value, Tensor):
            return value
        made = torch.as_tensor(value, device=device)
        if made.is_floating_point() and not hasattr(value, "dtype"):
            made = torch.as_tensor(value, dtype=numbers, device=device)
        return made
    except (TypeError, ValueError, RuntimeError) as error:
        raise RuleError(
            f"{name} = {value!r} is not allowed: it must be a number or a tensor."
        ) from error


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


def warn_of_mixing(rule: str, act: Callable[[State], Mapping[str, Tensor]], state: State) -> None:
    """Warn where what a rule does in one colony depends on another of the batch. act: the columns
    that it sets, or draws by, by the words for them."""
    if state.colonies < 2 or not bool((state.counts[:2] > 0).all()):
        return
    if names := _mixed(act, state):
        warn(
            f"{rule}: {names[0]}, depends on the other colonies of the batch: alone a colony would"
            " have another value. x.max(), x.mean(), len(cells) and cells.count are over all cells"
            " of all colonies; cells.colony_max(x), cells.colony_sum(x) and, for the number of"
            " cells, cells.colony_sum(1.0) are over each cell's own."
        )


@torch.no_grad()
def _mixed(act: Callable[[State], Mapping[str, Tensor]], state: State) -> list[str]:
    """The words for columns that have other numbers in a colony alone than beside another one,
    whose numbers are changed. Nothing where it fails, or where numbers differ between calls."""
    one, two = state.select([0]), state.select([0, 1])
    mine, cells = two.colony == 0, two.fields
    other = {
        n: torch.where(mine.reshape(-1, *[1] * (x.dim() - 1)), x, 0.9 * x)
        for n, x in cells.items()
        if x.is_floating_point() and len(x) == two.cells and two.declared[n].scope == CELL
    }
    length = torch.where(mine, two.length, 1.3 * two.length)
    try:
        alone, again = act(one), act(one)
        beside = act(two.with_fields(**other).replace(length=length))
    except Exception:  # numbers that the rule does not expect
        return []
    alike = lambda a, b: torch.allclose(a.double(), b.double(), 1e-5, equal_nan=True)
    if not all(n in again and alike(x, again[n]) for n, x in alone.items()):
        return []
    return [n for n, x in alone.items() if n in beside and not alike(x, beside[n][mine])]
