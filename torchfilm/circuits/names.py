"""Names for columns: the arguments u, s, p and cell of a user's rate function."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor

from torchfilm.tools import checks


class UnknownName(checks.InputError, AttributeError):
    """A rate function used an unknown name."""


class Names:
    """Read-only names for columns: `u.ahl`, or `u["ahl"]` for a name that is computed at run time.

    order: the names. columns: one for each name, as a tensor (M, K) or a sequence of tensors or
    numbers. label: the name of this object in messages; why: nothing may be written to it.
    """

    __slots__ = ("__dict__", "_label", "_why")
    _label: str
    _why: str

    def __init__(
        self,
        order: Sequence[str],
        columns: Tensor | Sequence[Any],
        label: str = "this",
        why: str = "a rate function returns rates and changes nothing",
    ):
        object.__setattr__(self, "_label", label)
        object.__setattr__(self, "_why", why)
        # the columns are the instance's own attributes, so access costs as much as for any
        # attribute
        self.__dict__.update(
            zip(order, columns.unbind(1) if isinstance(columns, Tensor) else columns, strict=True)
        )

    def __getattr__(self, name: str) -> Any:
        # called only for unknown names
        if name.startswith("__"):
            raise AttributeError(name)
        raise UnknownName(has_no(self._label, name, list(self.__dict__)))

    def __getitem__(self, name: str) -> Any:
        return getattr(self, name)

    def __setattr__(self, name: str, value: Any) -> None:
        raise UnknownName(f"{self._label}.{name} can only be read: {self._why}.")

    def __delattr__(self, name: str) -> None:
        raise UnknownName(f"{self._label}.{name} can only be read.")

    def __contains__(self, name: str) -> bool:
        return name in self.__dict__

    def __iter__(self) -> Iterator[str]:
        return iter(self.__dict__)

    def __len__(self) -> int:
        return len(self.__dict__)

    def __reduce__(self) -> tuple[Any, ...]:
        return Names, (tuple(self.__dict__), tuple(self.__dict__.values()), self._label)

    def __repr__(self) -> str:
        return f"Names({', '.join(self.__dict__) or 'none'})"


def without_medium(name: str) -> str:
    """What to do about a signal in a scene that has none."""
    return (
        f"the scene has no Medium: list tf.Medium({name}=tf.Signal(diffusion=…), box=…, spacing=…)."
    )


def label_of(part: object) -> str:
    """What messages call the rates of a circuit: a function by its name, a module by its class."""
    kind = type(part).__name__ if callable(part) else "the list of reactions"
    return getattr(part, "__name__", kind)


def has_no(label: str, name: str, known: Sequence[str]) -> str:
    """The message for a name that one of the arguments of a rate function does not have."""
    first = f"Rules(variables={{{name!r}: 0.0}})"
    hint = {
        "p": f" Give the circuit its value: Circuit(…, {name}=…).",
        "cell": f" What a rule sets only at times needs a first value: {first}.",
    }
    return unknown(f"{label} has no {name!r}", name, known) + hint.get(label, "")


def unknown(what: str, name: str, known: Sequence[str]) -> str:
    """The message for an unknown name: the known names, and the closest one."""
    near = difflib.get_close_matches(name, known, 1, cutoff=0.6)
    return f"{what}; known are {', '.join(known) or 'none'}." + (
        f" Did you mean {near[0]!r}?" if near else ""
    )
