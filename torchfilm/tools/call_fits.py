"""Whether a call fits, at a glance: what binding does in full takes ten times as long."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any


class CallFits:
    """The parameters of a function or class. `fits(args, given)` is True where a call with these
    arguments certainly has all that it needs, and nothing else; where it is False,
    `signature.bind` decides, which says what is wrong."""

    def __init__(self, signature: inspect.Signature):
        self.signature = signature
        parameters = signature.parameters.values()
        by_both, by_name = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
        self.plain = all(p.kind in (by_both, by_name) for p in parameters)
        self.places = tuple(p.name for p in parameters if p.kind is by_both)
        self.names = frozenset(p.name for p in parameters)
        self.required = frozenset(p.name for p in parameters if p.default is p.empty)

    def fits(self, args: Sequence[Any], given: Mapping[str, Any]) -> bool:
        placed = self.places[: len(args)]
        return (
            self.plain
            and len(args) == len(placed)
            and self.names.issuperset(given)
            and given.keys().isdisjoint(placed)
            and self.required.issubset((*placed, *given))
        )
