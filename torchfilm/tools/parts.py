"""Nested parts of a description: mappings, lists and dataclasses, changed leaf by leaf."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any

from torchfilm.tools import checks


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


def parts_of(part: Any, wanted: Callable[[Any], bool]) -> list[Any]:
    """Everything in a part, itself included, for which `wanted` is true, in order."""
    found: list[Any] = []

    def seen(path: str, x: Any) -> Any:
        found.extend([x] if wanted(x) else [])
        return x

    mapped(part, seen)
    return found


def keywords(
    owner: str, given: Mapping[str, Any], name: str, options: Collection[str]
) -> dict[str, Any]:
    """Keywords that a description keeps as one mapping; under the `name` of this,
    `dataclasses.replace` gives those that it has. options: its other parameters. Raises InputError
    for what is no mapping of names that keywords could have."""
    if name not in given:
        return {**given}
    kept = given[name]
    if not isinstance(kept, Mapping):
        rule = f"a mapping by name; what stands in it has another name than {name!r}"
        raise checks.input_error(f"{owner}.{name}", kept, rule)
    for n in kept:
        if not isinstance(n, str) or not n.isidentifier() or n in options:
            rule = "an identifier that is no parameter of its own"
            raise checks.input_error(f"name in {owner}.{name}", n, rule)
    return {**kept, **{n: x for n, x in given.items() if n != name}}
