"""Checks of the columns of a state, and of what picks rows of them: indices, masks and places of
colonies."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.tools import checks
from torchfilm.tools.one_per_colony import by_position
from torchfilm.tools.ragged import order_within
from torchfilm.tools.warn_once import warn

# What a user may give where whole numbers, or numbers, are wanted in a row.
Rows = Tensor | np.ndarray | Sequence[int]
Numbers = Tensor | np.ndarray | Sequence[float]
WHOLE = (torch.int64, torch.int32)  # of which torch takes rows


def check_rows(name: str, rows: Any, count: int) -> None:
    """Raises InputError for what is no 1-D tensor of whole numbers. Their range is left to
    `out_of_range`: to look at it would wait for a GPU."""
    if not isinstance(rows, Tensor) or rows.dtype not in WHOLE or rows.dim() > 1:
        raise checks.input_error(name, rows, _rule(count))


def out_of_range(name: str, rows: Tensor, count: int) -> checks.InputError:
    """The error for rows that are not there; raise what this returns."""
    return checks.input_error(name, rows.tolist(), _rule(count))


def no_such_part(
    name: str, per_cell: Collection[str], fields: Collection[str], known: Collection[str]
) -> AttributeError:
    """The error for a name that a state does not have; raise what this returns. fields: those to
    list. known: what may have been meant."""
    near = checks.suggestion(name, known)
    if name in ("x", "y", "z"):
        near = f"It is position[:, {'xyz'.index(name)}]."
    return AttributeError(
        f"the state has no {name!r}. {near + ' ' if near else ''}Beside {', '.join(per_cell)} it"
        f" has the fields {', '.join(fields) or 'none'}. An effect names what it reads in reads()."
    )


def check_mask(name: str, mask: Any, count: int) -> None:
    """Raises InputError for what is no tensor of `count` truth values."""
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.shape != (count,):
        rule = f"a tensor of shape ({count},) and dtype torch.bool"
        raise checks.input_error(name, mask, rule, "Such as state.length > 5.0.")


def checked_places(
    name: str, given: Any, count: int, device: torch.device, *, distinct: bool = True,
    least: int = 1,
) -> Tensor:  # fmt: skip
    """Places from 0 to count − 1, at least so many, (M,) int64. distinct: none comes twice."""
    try:
        places = torch.as_tensor(by_position(given), device=device).reshape(-1)
    except (TypeError, ValueError, RuntimeError) as error:
        raise checks.input_error(name, given, "whole numbers, such as [0, 2]") from error
    mask = places.dtype == torch.bool
    if places.numel() and (mask or places.is_floating_point() or places.is_complex()):
        hint = "torch.nonzero(mask)[:, 0] has those of a mask." if mask else ""
        raise checks.input_error(name, given, "whole numbers, such as [0, 2]", hint)
    places = places.to(torch.int64)
    if places.numel() < least or bool((places < 0).any()) or bool((places >= count).any()):
        rule = f"places from 0 to {count - 1}" + (", at least one" if least else "")
        raise checks.input_error(name, places.tolist(), rule)
    if distinct and torch.unique(places).numel() != places.numel():
        raise checks.input_error(name, places.tolist(), "different places")
    return places


def check_declaration(name: Any, shape: Any, initial: Any) -> None:
    """Raises InputError for a field whose name, shape or first value is of another type."""
    if not isinstance(name, str):
        raise checks.input_error("Field.name", name, "a text")
    whole = lambda size: isinstance(size, (int, np.integer))
    if not isinstance(shape, (tuple, list)) or not all(map(whole, shape)):
        rule = "a tuple of whole numbers, such as (3,)"
        raise checks.input_error(f"Field({name!r}).shape", shape, rule)
    plain = isinstance(initial, (int, float, np.number, np.bool_))
    plain = plain or (isinstance(initial, Tensor) and not initial.dim())
    if not plain and not callable(initial):
        rule = "a number, or a function of a state and rows"
        raise checks.input_error(f"Field({name!r}).initial", initial, rule)


def first_values(name: str, found: Any, shape: tuple[int, ...]) -> Tensor:
    """What the function `initial` of a field has returned. Raises InputError for another shape."""
    if not isinstance(found, Tensor) or found.shape != shape:
        given = tuple(found.shape) if isinstance(found, Tensor) else found
        rule = f"a tensor of shape {shape}"
        raise checks.input_error(f"Field({name!r}).initial(state, rows)", given, rule)
    return found


def check_declared(fields: Collection[str], declared: Collection[str]) -> None:
    """Raises InputError for a field that nothing declares."""
    for name in fields:
        if name not in declared:
            hint = "state.declare(tf.Field(…)) adds a field."
            raise checks.input_error("field", name, "declared", hint)


def is_whole(columns: Mapping[str, Any]) -> bool:
    """Whether the columns of cells, by name, are tensors of one number of rows."""
    if not all(isinstance(x, Tensor) for x in columns.values()):
        return False
    place = columns["position"].shape
    return len(place) == 2 and all(
        x.shape == (place if n in ("position", "axis") else place[:1]) for n, x in columns.items()
    )


def check_geometry(columns: Mapping[str, Any], colonies: int, dim: int, dtype: Any) -> None:
    """Raises InputError where columns of cells, by name, are no tensors, have not a row for each
    cell or another dtype, colonies do not stand side by side, or a cell has an impossible size."""
    for name, value in columns.items():
        if not isinstance(value, Tensor):
            raise checks.input_error(f"state.{name}", value, "a tensor with a row for each cell")
    count = columns["colony"].numel()
    shapes = {"position": (count, dim), "axis": (count, dim)}
    dtypes = dict.fromkeys(("axis", "length", "radius"), dtype) | {"position": torch.float64}
    for name, value in columns.items():
        wanted, kind = shapes.get(name, (count,)), dtypes.get(name, torch.int64)
        if value.shape != wanted or value.dtype != kind:
            given = f"{tuple(value.shape)}, {value.dtype}"
            raise checks.input_error(f"state.{name}", given, f"of shape {wanted} and {kind}")
    colony = columns["colony"]
    bad = {
        "colony": (
            (colony < 0) | (colony >= colonies) | (colony.diff(prepend=colony[:1]) < 0),
            f"a place from 0 to {colonies - 1}, with the cells of a colony side by side",
        ),
        # a colony with what is no number fails in its first step, and harms no other
        "length": (columns["length"] < 0, "at least 0 µm"),
        "radius": (columns["radius"] <= 0, "above 0 µm"),
    }
    for name, (wrong, rule) in bad.items():
        if bool(wrong.any()):
            k = int(torch.nonzero(wrong)[0])
            raise checks.input_error(f"state.{name}[{k}]", columns[name][k].item(), rule)
    _check_numbers(colony, columns["uid"])


def checked_tensors(
    values: Mapping[str, Any],
    present: Mapping[str, Tensor],
    device: torch.device,
    shape: Callable[[str], Sequence[int]],
) -> Mapping[str, Tensor]:
    """A field's new values, of the kind of those that are present. Raises InputError for what is no
    tensor, not on the state's device, of another shape, or of a kind that loses something. shape:
    that a field should have; it is asked where it has changed."""
    found = values
    for name, value in values.items():
        if not isinstance(value, Tensor):
            rule = "a tensor with a row for each cell, colony or voxel"
            now = present.get(name)
            hint = "" if now is None else (
                f"One number for all: torch.full_like(state.{name}, …); from a list or an array:"
                f" torch.as_tensor(…, dtype={now.dtype}, device=state.device)."
            )  # fmt: skip
            raise checks.input_error(f"the field {name!r}", value, rule, hint)
        if value.device != device:
            what, hint = f"device of the field {name!r}", "Make it with device=state.device."
            raise checks.input_error(what, str(value.device), f"{device}, as the state is", hint)
        now = present.get(name)
        if now is None or (value.shape == now.shape and value.dtype == now.dtype):
            continue
        if value.shape != now.shape and tuple(value.shape) != (wanted := tuple(shape(name))):
            rule = f"{wanted}, one value for each cell, colony or voxel first"
            hint = "Numbers of colonies come to their cells by x[state.colony]."
            hint = hint if len(wanted) == value.dim() == 1 else ""
            shown = tuple(value.shape)
            raise checks.input_error(f"shape of the field {name!r}", shown, rule, hint)
        if name.startswith("out.") and value.dtype != now.dtype:
            hint = f"Convert it: value.to({now.dtype})."
            raise checks.input_error(
                f"type of the field {name!r}", value.dtype, f"{now.dtype}, as the signals are", hint
            )
        if value.dtype != now.dtype:
            found = {**found, name: _of_kind(name, value, now.dtype)}
    return found


def _of_kind(name: str, value: Tensor, dtype: torch.dtype) -> Tensor:
    """The values of a field, as numbers of its type. Raises InputError where a fraction would be
    lost, or a number be read as a truth."""
    truth, whole = dtype == torch.bool, not dtype.is_floating_point
    fraction = value.is_floating_point() or value.is_complex()
    if (whole and fraction) or value.is_complex() or truth != (value.dtype == torch.bool):
        wanted = "true or false, torch.bool" if truth else f"numbers of {dtype}"
        hint = "Convert it: value > 0." if truth else f"Convert it: value.to({dtype})."
        raise checks.input_error(f"type of the field {name!r}", value.dtype, wanted, hint)
    made = value.to(dtype)
    # on a GPU a look at the numbers would wait for it, as often as an effect gives such a field
    unseen = fraction and value.device.type != "cpu"
    if truth or unseen or torch._C._functorch.is_functorch_wrapped_tensor(value):
        return made
    lost = made.isinf() & value.isfinite() if fraction else made.to(value.dtype) != value
    if bool(lost.any()):
        first = value[lost][0].item()
        raise checks.input_error(f"the field {name!r}", first, f"a number that {dtype} can hold")
    return made


def _check_numbers(colony: Tensor, uid: Tensor) -> None:
    """Raises InputError for two cells of a colony with one number, by which they draw."""
    order = order_within(colony, uid)
    twice = (uid[order].diff() == 0) & (colony[order].diff() == 0)
    if bool(twice.any()):
        k = int(torch.nonzero(twice)[0])
        one, other = sorted(order[k : k + 2].tolist())
        raise checks.InputError(
            f"cells {one} and {other} have one uid, {int(uid[one])}, in one colony, as after"
            " state.take with an index twice: all their random numbers would be the same. Give"
            " copies numbers of their own: state.replace(uid=…, next_uid=…), next_uid above all of"
            " them."
        )


def warn_of_rounding(name: str, values: np.ndarray, dtype: torch.dtype) -> None:
    """Warn of whole numbers, such as those of tracks, of which a type of float makes one."""
    whole = np.unique(values[(values == np.round(values)) & np.isfinite(values)])
    kept = torch.as_tensor(whole.copy()).to(dtype).to(torch.float64).numpy()
    alike = np.flatnonzero(kept[1:] == kept[:-1])
    if alike.size:
        k = int(alike[0])
        warn(
            f"{name} has whole numbers that {str(dtype).removeprefix('torch.')} cannot tell apart,"
            f" such as {whole[k]:.0f} and {whole[k + 1]:.0f}: where they name cells, number these"
            " from 0, or bind with dtype=torch.float64."
        )


def check_fields(
    fields: Mapping[str, Tensor], scopes: Mapping[str, str], rows: Mapping[str, int]
) -> None:
    """Raises InputError for a field that has not as many rows as its scope."""
    for name, value in fields.items():
        scope = scopes[name]
        if not value.dim() or value.size(0) != rows[scope]:
            raise checks.input_error(
                f"shape of the field {name!r}",
                tuple(value.shape),
                f"one value for each {'voxel' if scope == 'grid' else scope} first; the state has"
                f" {rows['cell']} cells in {rows['colony']} colonies",
            )


def check_signals(fields: Mapping[str, Tensor]) -> None:
    """Raises InputError for a signal that is below 0, or no number, in some voxel."""
    for name, value in fields.items():
        if name.startswith("out.") and bool((wrong := ~(value >= 0)).any()):
            bad = float(value[wrong][0])
            raise checks.input_error(f"the field {name!r}, a signal,", bad, "0 or more everywhere")


def check_field(
    fields: Mapping[str, Tensor], name: str, wrong: Callable[[Tensor], Tensor], rule: str
) -> None:
    """Raise InputError where a field of a state that is given has a value that is wrong."""
    if name in fields and bool((found := wrong(fields[name])).any()):
        k = int(found.nonzero()[0])
        raise checks.input_error(f"state.{name}[{k}]", float(fields[name][k]), rule)


def check_none_taken(owner: str, state: Any, taken: Any, why: str) -> None:
    """Raise InputError where an effect would take a cell of a first state: where `taken` (N,) is
    true. why: after where it starts; and what to do."""
    if bool(taken.any()):
        k = int(taken.nonzero()[0])
        raise checks.InputError(
            f"{owner} would take cell {int(state.uid[k])} of colony {int(state.own_colony_id[k])}"
            f" before the first step: it starts at {state.position[k].tolist()}, {why}"
        )


def is_name(given: object) -> bool:
    """Whether it may name a species or a variable."""
    return isinstance(given, str) and given.isidentifier()


def check_names(owner: str, **given: Any) -> None:
    """Raise InputError unless each is None or a name that a species or a variable may have."""
    for option, name in given.items():
        if name is not None and not is_name(name):
            rule = "the name of a species or a variable of the cells"
            raise checks.input_error(f"{owner}.{option}", name, rule)


def check_variables(owner: str, state: Any, **given: str | None) -> None:
    """As `check_variable`, not below 0, of those options that name one."""
    for option, name in given.items():
        if name is not None:
            check_variable(f"{owner}.{option}", name, state, at_least_zero=True)


def check_variable(label: str, name: str, state: Any, at_least_zero: bool = False) -> None:
    """Raise InputError unless `name` is a number of each cell of a first state; and is not below 0
    there, where so asked. label: the option by which it was named."""
    declared = state.declared.get(name)
    if declared is None or declared.scope != "cell" or declared.shape:
        cells = {n: f for n, f in state.declared.items() if f.scope == "cell" and not f.shape}
        there = [n for n, f in cells.items() if not f.internal]
        rule = "a species of a circuit, or a variable with one number for each cell"
        raise checks.input_error(label, name, rule, f"There are: {', '.join(there)}.")
    if at_least_zero and bool((~(state.fields[name] >= 0)).any()):
        raise checks.InputError(
            f"{label}: {name} of a first cell is below 0; it must be 0 or more."
        )


def _rule(count: int) -> str:
    return f"a 1-D tensor of whole numbers from 0 to {count - 1}, the rows of cells"


def without_gradient(name: str, given: Any) -> Any:
    """What is given for founders, tensors on the CPU; warns where a gradient is lost."""
    if isinstance(given, list | tuple):
        return [without_gradient(name, x) for x in given]
    if not isinstance(given, Tensor):
        return given
    if given.requires_grad:
        warn(
            f"{name} requires a gradient, which founders do not keep. Put it into the first state:"
            " state.replace(position=…) or state.with_fields(…), before the first step; or into the"
            " state that model.add returns."
        )
    return given.detach().cpu()
