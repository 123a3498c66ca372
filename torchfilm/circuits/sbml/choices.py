"""What a user says of an SBML model that is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchfilm.circuits.equations import Term


@dataclass(frozen=True)
class Choices:
    """What the user says of a model. signals: names of signals by id of species. cell: properties
    of a cell by id. values, first: numbers in place of the model's, by id. without: reactions that
    are left out. per_hour: the model's units of time in an hour. rename:
    names in the circuit by id. cell_time: whether the time is that of the step's beginning."""

    signals: Mapping[str, str]
    cell: Mapping[str, Term]
    values: Mapping[str, Any]
    first: Mapping[str, Any]
    without: frozenset[str]
    per_hour: float
    rename: Mapping[str, str]
    cell_time: bool = False


def plain(given: Any) -> bool:
    """Whether a value is one number."""
    return isinstance(given, (int, float)) and not isinstance(given, bool)
