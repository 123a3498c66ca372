"""What a step of an effect tells of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch

from torchfilm.state import State


class Report(Protocol):
    """What a step of an effect tells of itself. A driver raises, or drops colonies, where `status`
    is not 0. A report may also have `concerns() -> list[Concern]`."""

    @property
    def status(self) -> torch.Tensor:
        """(B,) int: 0 where all is well."""

    @property
    def hint(self) -> str:
        """What may help where it is not."""

    def reason(self, place: int) -> str:
        """What went wrong in the colony at this place of the batch."""


@dataclass(frozen=True)
class CellsLost:
    """Cells that left in a step: `cells` (B,), their number, and `volume` (B,), float64 µm³."""

    cells: torch.Tensor
    volume: torch.Tensor
    hint = ""

    @staticmethod
    def of(state: State, gone: torch.Tensor) -> CellsLost:
        """Of those where `gone` (N,) is true."""
        volume = torch.where(gone, state.volume.detach().double(), 0.0)
        lost = torch.bincount(state.colony[gone], minlength=state.colonies)
        return CellsLost(lost, state.groups.sum(volume))

    @property
    def status(self) -> torch.Tensor:
        """All is well."""
        return torch.zeros_like(self.cells)

    def reason(self, place: int) -> str:
        """Nothing has gone wrong."""
        return ""


@dataclass(frozen=True)
class Concern:
    """What a report warns of, once it has held for `steps` steps: in which colonies, `where` (B,)
    bool, and `text(colony ids (B,), where (B,))`, what is wrong and what to do. name:
    distinguishes concerns.
    """

    name: str
    where: torch.Tensor
    steps: int
    text: Callable[[torch.Tensor, torch.Tensor], str]
