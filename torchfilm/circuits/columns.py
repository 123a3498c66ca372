"""Named columns of some cells, selected on first access."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from torch import Tensor

from torchfilm.circuits.names import Names, UnknownName, unknown


class Columns(Names):
    """Named columns over some of the cells.

    source: per name a tensor over all cells, a number, or a function that returns the tensor. rows:
    (M,) int64, the cells. seen: if given, it collects the names that were accessed.
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
            raise UnknownName(unknown(f"{self._label} has no {name!r}", name, list(self._source)))
        value = self._source[name]
        if callable(value) and not isinstance(value, Tensor):
            value = value()
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


class Lazy:
    """A column that is computed on first access."""

    def __init__(self, make: Callable[[], Tensor]):
        self.make = make
        self.value: Tensor | None = None

    def __call__(self) -> Tensor:
        if self.value is None:
            self.value = self.make()
        return self.value


def column(value: object, count: int, like: Tensor) -> Tensor | None:
    """A rate as (count,) with dtype and device of `like`, or None if its shape does not fit."""
    if not isinstance(value, Tensor):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        return like.new_full((count,), value)
    if value.dim() == 0:
        value = value.expand(count)
    return value.to(like.dtype) if value.shape == (count,) else None
