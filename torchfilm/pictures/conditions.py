"""Conditions: colonies that have the same parameters, replicates of each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchfilm.io.parameters import column_names
from torchfilm.io.results import Results
from torchfilm.tools import checks

MOST_NAMED = 2  # parameters that differ, up to which they name colonies


def names_by_parameters(parameters: Mapping[str, np.ndarray]) -> list[str] | None:
    """Colonies named by the parameters that differ between them, such as "half = 0.1"; None where
    none differs, or more than MOST_NAMED do."""
    found = {path: x for path, x in parameters.items() if (x != x[:1]).any()}
    if not 0 < len(found) <= MOST_NAMED:
        return None
    names = column_names([*found], set())
    return _joined({names[path]: x for path, x in found.items()})


def _joined(columns: Mapping[str, np.ndarray]) -> list[str]:
    """A name for each row of columns, such as "iptg = 0.1, rate = 2"."""
    words = ([f"{name} = {word}" for word in _words(x)] for name, x in columns.items())
    return [", ".join(row) for row in zip(*words, strict=True)]


def _words(values: np.ndarray) -> list[str]:
    """Numbers as text, with as many digits as it takes to tell them apart; texts as they are."""
    if values.dtype.kind == "U":
        return list(values.tolist())
    for digits in range(4, 18):
        words = [f"{value:.{digits}g}" for value in values.tolist()]
        if len(set(words)) == len(np.unique(values)):
            break
    return words


def condition_names(
    results: Results, conditions: str | Sequence[str] | Mapping[int, str] | None, run: str = ""
) -> dict[int, str]:
    """The condition of each colony that has one, by its place in the file: see `time_course`. By
    default the parameters that differ at the end of the run, or if none does at its beginning; and
    else the colony's id. run: the name of one of several runs, with which those of its conditions
    begin; without such parameters the colonies of a run are replicates."""
    if run:
        differ = any((x != x[:1]).any() for k in (0, -1) for x in results.parameters(k).values())
        if conditions is None and not differ:
            return dict.fromkeys(range(len(results.colony_id)), run)
        return {k: f"{run}, {name}" for k, name in condition_names(results, conditions).items()}
    ids = results.colony_id.tolist()
    if isinstance(conditions, Mapping):
        return _own_names(conditions, ids)
    if conditions is None:
        return dict(enumerate(_by_parameters(results) or [f"colony {k}" for k in ids]))
    last = results.parameters(-1)
    wanted = [conditions] if isinstance(conditions, str) else conditions
    rule = "a parameter that has one value per colony, several of them, or {0: 'control', …}"
    if not isinstance(wanted, Sequence) or not wanted:
        raise checks.input_error("conditions", conditions, rule)
    names = column_names([*last], set())
    known = {**{path: path for path in last}, **{name: path for path, name in names.items()}}
    columns = {}
    for name in wanted:
        if name not in known:
            have = f"one of {', '.join(names.values())}" if names else f"{rule}; this file has none"
            hint = checks.suggestion(name, names.values())
            raise checks.input_error("conditions", name, have, hint)
        columns[names[known[name]]] = last[known[name]]
    return dict(enumerate(_joined(columns)))


def _by_parameters(results: Results) -> list[str] | None:
    """Colonies named by the parameters that differ at the end of the run, or at its beginning."""
    found = names_by_parameters(results.parameters(-1))
    return found or names_by_parameters(results.parameters(0))


def _own_names(given: Mapping[Any, Any], ids: Sequence[int]) -> dict[int, str]:
    """The user's names for colonies, by place."""
    found = {}
    for key, name in given.items():
        if key not in ids:
            rule = f"ids of colonies: {', '.join(map(str, ids[:12]))}" + ", …" * (len(ids) > 12)
            raise checks.input_error("conditions", key, rule)
        if not isinstance(name, str) or not name:
            raise checks.input_error(f"conditions[{key}]", name, "a name, as text")
        found[ids.index(key)] = name
    if not found:
        raise checks.input_error("conditions", given, "a name for at least one colony")
    return dict(sorted(found.items()))
