"""Variables that a script keeps in its cells, such as `cell.targetVol`, as fields of the state.

Which there are, and of what shape, a rehearsal finds: `init` on the first cells, then `update`,
then `divide`, on copies. A variable is a number, a truth value, or a list of numbers of one length.
NaN marks a cell that does not have the variable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.cellmodeller.cell import UNSET
from torchfilm.state import RESERVED, Field
from torchfilm.tools.checks import InputError

# What CellModeller itself keeps of each cell, where a script names it.
COLOR, GREY = "color", 0.5  # the colour of a cell that the script gives none
HISTORY = ("cellAge", "strainRate", "effGrowth", "oldLen", "startVol")
# Attributes that are fields of other effects.
FIELDS = {"growthRate": "growth_rate", "divideFlag": "divide_flag", "cellType": "cell_type"}
TAKEN = (*RESERVED, *FIELDS.values(), "elongation", "displacement", "drag", "remove_flag")
CONTAINERS = {list: "list", tuple: "tuple", np.ndarray: "array"}


@dataclass(frozen=True)
class Variable:
    """A variable of the cells. shape: () for a number. kind: "float", "int" or "bool", of its
    numbers. container: "number", "list", "tuple" or "array"."""

    name: str
    shape: tuple[int, ...]
    kind: str
    container: str

    @property
    def field(self) -> str:
        """The name of its field."""
        return self.name + "_" if self.name in TAKEN else self.name

    def declared(self) -> Field:
        return Field(
            self.field,
            f"cell.{self.name} of the script",
            shape=self.shape,
            dtype=torch.float64,
            initial=GREY if self.name == COLOR else float("nan"),
        )

    def shown(self, values: Tensor) -> list[Any]:
        """The values (M, …) as the script sees them, UNSET where a cell has none."""
        array = values.detach().cpu().numpy()
        flat = array.reshape(len(array), math.prod(self.shape))
        unset = np.isnan(flat).all(1) & bool(flat.size)
        made: list[Any]
        if self.container == "array":
            made = [row.copy() for row in array]
        else:
            made = self._numbers(array)
            made = [tuple(x) for x in made] if self.container == "tuple" else made
        return [UNSET if lacks else x for x, lacks in zip(made, unset, strict=True)]

    def _numbers(self, array: np.ndarray) -> list[Any]:
        """Numbers as Python's; those of a whole kind as int while they are whole."""
        if self.kind == "float" or not (array == np.round(array)).all():
            return array.tolist()
        return array.astype(bool if self.is_truth(array) else np.int64).tolist()

    def is_truth(self, values: Any) -> bool:
        """Whether values, an array or a tensor, are shown as truth values: a script may keep other
        numbers in a variable that had a truth value in the rehearsal."""
        return self.kind == "bool" and bool(((values == 0) | (values == 1)).all())

    def column(self, values: Sequence[Any]) -> np.ndarray:
        """Values as the script set them, (M, …). Raises InputError for others than numbers."""
        made = [numbers(self.name, x) for x in values]
        for new in made:
            if new.shape != self.shape:
                raise InputError(
                    f"cell.{self.name} was {_words(self.shape)}, and is set to"
                    f" {_words(new.shape)}: a variable keeps its length."
                )
        return np.stack(made)


def _words(shape: tuple[int, ...]) -> str:
    return f"{' by '.join(map(str, shape))} numbers" if shape else "one number"


def numbers(name: str, value: Any) -> np.ndarray:
    """A value as an array. Raises InputError for others than numbers and lists of them."""
    try:
        if value is None or isinstance(value, (str, bytes, dict, set)):
            raise TypeError
        made = np.asarray(value)
        if made.dtype.kind not in "biuf":
            raise TypeError
        return made.astype(np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"cell.{name} = {value!r} is not supported: torchfilm keeps numbers, and lists of"
            " numbers of one length, in cells."
        ) from None


def variable(name: str, values: Sequence[Any]) -> Variable:
    """The variable that holds these values of a rehearsal."""
    arrays = [numbers(name, x) for x in values]
    shapes = {x.shape for x in arrays}
    if len(shapes) > 1:
        raise InputError(
            f"cell.{name} has {' and '.join(sorted(map(_words, shapes)))}: a variable keeps its"
            " length."
        )
    kinds = {np.asarray(x).dtype.kind for x in values}
    kind = "bool" if kinds == {"b"} else "int" if kinds <= {"b", "i", "u"} else "float"
    kind = "float" if name == COLOR else kind
    containers = {CONTAINERS.get(type(x), "number") for x in values}
    container = containers.pop() if len(containers) == 1 else "list"
    return Variable(name, arrays[0].shape, kind, container if arrays[0].ndim else "number")


def own_colour(declared: Mapping[str, Field]) -> str | None:
    """The field of the colour that a script gives its cells, or None."""
    found = declared.get(COLOR)
    return COLOR if found is not None and found.shape == (3,) else None
