"""What a step of an effect that the user has written may do to a state."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from torch import Tensor

from torchfilm.cell_types import with_values_of_new_types
from torchfilm.state import PER_CELL, PER_COLONY, State
from torchfilm.tools import checks
from torchfilm.tools.deterministic_math import deterministic_functions
from torchfilm.tools.hot_reload import unchanged

COLUMNS = (*PER_CELL, *PER_COLONY)


def taken(
    name: str,
    step: Callable[[], object],
    state: State,
    writes: Collection[str],
    by_type: Collection[str],
) -> State:
    """The state that an effect of this name makes of a state by `step()`, in which a colony's bits
    do not depend on others where `deterministic_functions` covers what it calls. Cells that it
    gives another type have that type's values of the fields `by_type`. Raises as `check_step`."""
    before = seen(state)
    with deterministic_functions():
        made = step()
    after = check_step(name, before, made, writes)
    return with_values_of_new_types(state, after, by_type) if by_type else after


def seen(state: State) -> dict[str, tuple[Tensor, int]]:
    """What an effect may change, by name, each with how often it was changed in place."""
    parts = {n: getattr(state, n) for n in COLUMNS} | dict(state.fields)
    return {n: (x, _version(x)) for n, x in parts.items()}


def _version(x: Tensor) -> int:
    """How often a tensor was changed in place, where torch counts it."""
    return 0 if x.is_inference() else x._version


def check_step(
    name: str, before: Mapping[str, tuple[Tensor, int]], after: object, writes: Collection[str]
) -> State:
    """The state that an effect's step has made. Raises TypeError where it is none; InputError where
    it has columns of another type, changed what `writes()` does not name, or changed a tensor in
    place."""
    if not isinstance(after, State):
        raise TypeError(f"{name}.step must return the state; it returned {_shown(after)}")
    for what, (old, version) in before.items():
        if _version(old) != version:
            raise checks.InputError(
                f"{name}.step changed {what!r} in place: earlier states share this tensor. Write"
                f" state.with_fields({what}=…) or state.replace({what}=…) with a new one."
            )
        if what not in COLUMNS and what not in after.fields:
            raise checks.InputError(
                f"{name}.step left the field {what!r} out: keep the state's fields, by"
                " state.with_fields(…)."
            )
        new = getattr(after, what) if what in COLUMNS else after.fields[what]
        if not isinstance(new, Tensor):
            raise checks.InputError(f"{name}.step gave {what!r} as {_shown(new)}, not a tensor.")
        if what in COLUMNS:
            _check_shape(name, what, new, old, after)
        if new is old:
            continue
        if new.dtype != old.dtype:
            raise checks.InputError(
                f"{name}.step gave {what!r} as {_type(new)}; it is {_type(old)}: write"
                f" x.to(state.{what}.dtype)."
            )
        if what in writes or "cells" in writes:
            continue
        if new.shape != old.shape or not unchanged(new, old):
            raise checks.InputError(
                f"{name}.step changed {what!r}, which its writes() does not name: a scene is"
                " ordered, and growth recorded, by what effects say that they change."
            )
    after.check_fields()
    return after


def _check_shape(name: str, what: str, new: Tensor, old: Tensor, after: State) -> None:
    """Kernels trust that columns have a row for each cell or colony."""
    rows = after.colonies if what in PER_COLONY else after.cells
    if new.shape != (rows, *old.shape[1:]):
        each = "colony" if what in PER_COLONY else "cell"
        raise checks.InputError(
            f"{name}.step gave {what!r} of shape {tuple(new.shape)}: it must be"
            f" {(rows, *old.shape[1:])}, one value for each {each}."
        )


def _shown(given: object) -> str:
    return "None" if given is None else f"a {type(given).__name__}"


def _type(x: Tensor) -> str:
    return str(x.dtype).removeprefix("torch.")
