"""Nested parts of a description: mappings, lists and dataclasses, changed leaf by leaf."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any


def mapped(part: Any, change: Callable[[str, Any], Any], path: str = "") -> Any:
    """A part with what `change` makes of what is in it, from (path, value); what it returns as it
    was is looked into. Where nothing changes, the part itself."""
    found = change(path, part)
    if found is not part:
        return found
    if isinstance(part, (tuple, list)):
        made = [mapped(item, change, f"{path}[{k}]") for k, item in enumerate(part)]
        same = all(a is b for a, b in zip(made, part, strict=True))
        if same:
            return part
        return type(part)(*made) if hasattr(part, "_fields") else type(part)(made)
    if isinstance(part, Mapping):
        each = {name: mapped(item, change, f"{path}[{name!r}]") for name, item in part.items()}
        return part if all(each[name] is part[name] for name in each) else each
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        changed = {
            f.name: mapped(getattr(part, f.name), change, f"{path}.{f.name}")
            for f in dataclasses.fields(part)
        }
        if all(changed[n] is getattr(part, n) for n in changed):
            return part
        copy = object.__new__(type(part))
        copy.__dict__.update({**vars(part), **changed})  # past __init__: they have been checked
        return copy
    return part


def keywords(given: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Keywords that a description keeps as one mapping; under the `name` of this,
    `dataclasses.replace` gives those that it has."""
    kept = given.get(name)
    if not isinstance(kept, Mapping):
        return {**given}
    return {**kept, **{n: x for n, x in given.items() if n != name}}
