"""Named columns of some cells, selected on first access."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any

from torch import Tensor

from torchfilm.circuits.names import Names, UnknownName, has_no, without_medium


class Columns(Names):
    """Named columns over some of the cells.

    source: per name a tensor over all cells, or a number. rows: (M,) int64, the cells. seen: if
    given, it collects the names that were accessed.
    """

    __slots__ = ("_rows", "_seen", "_source")
    _source: Mapping[str, Any]
    _rows: Tensor
    _seen: set[str] | None

    def __init__(
        self, source: Mapping[str, Any], rows: Tensor, label: str, seen: set[str] | None = None
    ):
        super().__init__((), (), label)
        object.__setattr__(self, "_source", source)
        object.__setattr__(self, "_rows", rows)
        object.__setattr__(self, "_seen", seen)

    def __getattr__(self, name: str) -> Any:
        # called only on the first access of a name
        if name.startswith("__"):
            raise AttributeError(name)
        if name not in self._source:
            raise UnknownName(has_no(self._label, name, list(self._source)))
        value = self._source[name]
        if isinstance(value, Tensor) and value.dim():
            value = value.index_select(0, self._rows)
        if self._seen is not None:
            self._seen.add(name)
        self.__dict__[name] = value
        return value

    def __contains__(self, name: str) -> bool:
        return name in self._source

    def __iter__(self) -> Iterator[str]:
        return iter(self._source)

    def __len__(self) -> int:
        return len(self._source)

    def __repr__(self) -> str:
        return f"Columns({', '.join(self._source) or 'none'})"


class NoSignals(Names):
    """The signals of a scene without a medium."""

    __slots__ = ()

    def __init__(self) -> None:
        super().__init__((), (), "s")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise UnknownName(f"s has no {name!r}, since {without_medium(name)}")


class Lookup(Mapping[str, Any]):
    """Columns over all cells by name, each worked out once, when it is first read. names: known
    ones, found when somebody asks for them. find: the column of a name."""

    def __init__(self, names: Callable[[], Iterable[str]], find: Callable[[str], Tensor]):
        self._names, self._find = names, find
        self._known: dict[str, Tensor] = {}

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._known:
            self._known[name] = self._find(name)
        return self._known[name]

    @cached_property
    def _all(self) -> dict[str, None]:
        return dict.fromkeys(self._names())

    def __contains__(self, name: object) -> bool:
        return name in self._all

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)


def column(value: object, count: int, like: Tensor) -> Tensor | None:
    """A rate as (count,) with dtype and device of `like`, or None if its shape does not fit."""
    if not isinstance(value, Tensor):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        return like.new_full((count,), value)
    if value.dim() == 0:
        value = value.expand(count)
    return value.to(like.dtype) if value.shape == (count,) else None
