"""A function of positions times a number, which may be one for each colony."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchfilm.signals.schedule import Schedule
from torchfilm.tools import checks
from torchfilm.values import PerColony, Rule, checked


@dataclass(frozen=True, eq=False)
class Scaled(metaclass=checks.KnownKeywords):
    """What a function of positions gives, times a factor: `flow=tf.Scaled(profile, 200.0)`.

    The colonies of a batch, such as the designs of a search, then differ in how strong it is:
    `tf.Scaled(profile, [0.0, 100.0, 1000.0])`, of which a function alone knows nothing. Derivatives
    by the factor are exact.

    function: from positions (M, 3), µm, as it could stand alone: for a medium's flow, and the
    decay, initial or source of a signal. factor: one number, or one per colony.
    """

    function: Callable[[Tensor], Tensor]
    factor: checks.Value

    def __post_init__(self) -> None:
        if not callable(self.function) or isinstance(self.function, (Schedule, Scaled)):
            rule = "a function from positions (M, 3) µm"
            raise checks.input_error("Scaled.function", self.function, rule)
        made = checked("Scaled.factor", self.factor, Rule(scope="colony"))
        object.__setattr__(self, "factor", made.values if isinstance(made, PerColony) else made)

    def __call__(self, positions: Tensor) -> Tensor:
        """What the function gives, before it is scaled."""
        return self.function(positions)


def scaled(given: Any, found: Tensor, factor: Callable[[checks.Value], Any]) -> Tensor:
    """What a function of positions gave, `found`, times the factor if it is `Scaled`. factor: from
    one number, or one per colony, to numbers that stand beside those found."""
    return found * factor(given.factor) if isinstance(given, Scaled) else found


def held_tensors(function: Callable[..., Any]) -> list[Tensor]:
    """Tensors in the closure of a function, and by which it is scaled."""
    if isinstance(function, Scaled):
        factor = [function.factor] if isinstance(function.factor, Tensor) else []
        return [*factor, *held_tensors(function.function)]
    cells = getattr(function, "__closure__", None) or ()
    return [cell.cell_contents for cell in cells if isinstance(cell.cell_contents, Tensor)]
