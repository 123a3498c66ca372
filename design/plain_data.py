"""Targets and parameters as plain data, for JSON: reading them back executes nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from design import targets
from design.parameters import Choice, Parameter
from design.targets.statistics import ColonyStatistics
from torchfilm import checks

# the classes that a file may name; those of users are code, and no data
READY: tuple[type[Any], ...] = tuple(getattr(targets, name) for name in targets.__all__)
KINDS = {kind.__name__: kind for kind in (Parameter, Choice, ColonyStatistics, *READY)}
KIND, PAIRS = "kind", "pairs"


class NotPlain(TypeError):
    """A value that plain data cannot hold, such as a function or an object of a user's class."""


def to_data(value: Any) -> Any:
    """A ready target, a parameter, or a list of these, as lists, dictionaries, numbers and texts.
    Raises NotPlain for anything else."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, (list, tuple)):
        return [to_data(entry) for entry in value]
    if isinstance(value, Mapping):
        if all(isinstance(name, str) for name in value):
            return {name: to_data(entry) for name, entry in value.items()}
        # JSON has texts for names, and these are numbers, such as cell types
        pairs = [[to_data(name), to_data(entry)] for name, entry in value.items()]
        return {KIND: PAIRS, PAIRS: pairs}
    if KINDS.get(type(value).__name__) is not type(value) or not dataclasses.is_dataclass(value):
        raise NotPlain(type(value).__name__)
    own = {f.name: to_data(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
    return {KIND: type(value).__name__, **own}


def from_data(data: Any) -> Any:
    """What `to_data` was given, with tuples for lists. Raises InputError for data of another
    form."""
    if isinstance(data, list):
        return tuple(from_data(entry) for entry in data)
    if not isinstance(data, Mapping):
        return data
    found = {name: from_data(entry) for name, entry in data.items()}
    if KIND not in found:
        return found
    kind = found.pop(KIND)
    if kind == PAIRS:
        return _of_pairs(found)
    checks.choice(KIND, kind, tuple(KINDS))
    try:
        return KINDS[kind](**found)
    except TypeError as error:
        raise checks.InputError(f"no {kind} can be made of {found} ({error}).") from error


def _of_pairs(found: Mapping[str, Any]) -> dict[Any, Any]:
    """A dictionary with other names than texts."""
    try:
        return dict(found[PAIRS])
    except (KeyError, TypeError, ValueError) as error:
        raise checks.InputError(f"no pairs of a name and a value: {dict(found)}.") from error
