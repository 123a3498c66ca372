"""What binding makes of physical values: tensors of the batch, looked up by colony, type or cell.

`Resolved` holds tensors of the batch's dtype on its device, copied, so that a tensor that is
changed later in place does not change a bound model.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchfilm.bound_draw import BoundDraw, missing_type, of_parents
from torchfilm.signals.schedule import Schedule
from torchfilm.state import Field, State
from torchfilm.tools import checks, displays
from torchfilm.tools.parts import mapped
from torchfilm.tools.tangents import has_tangent
from torchfilm.values import (
    ByType,
    Distribution,
    PerColony,
    check_inherited,
    is_drawn,
    is_inherited,
)


@dataclass(frozen=True)
class BoundBatch:
    """What a scene is bound to: `colonies` colonies, the cell `types` of their founders, dtype and
    device.

    per_colony: lists and tensors are one value per colony, also where their length could mean cell
    types.
    """

    colonies: int
    dtype: torch.dtype
    device: torch.device
    types: tuple[int, ...] = ()
    per_colony: bool = False


@dataclass(frozen=True, eq=False)
class Resolved:
    """A value of one batch. `value`: 0-dim, or (B,) by colony id, or for cell types (T,) or (T, B);
    None where it is drawn at birth and kept in the field `field`. types: (T,) int64, ascending.
    draw: how it is drawn. kept: the field in which cells keep it, whoever puts it there.
    """

    name: str
    value: Tensor | None = None
    types: Tensor | None = None
    draw: BoundDraw | None = None
    field: str | None = None
    kept: str | None = None

    @property
    def known_types(self) -> tuple[int, ...]:
        """The cell types that cells must be of to have a value; none where all cells have one."""
        if self.types is not None:
            return tuple(self.types.tolist())
        return () if self.draw is None or self.draw.others is not None else self.draw.types

    def of_colonies(self, state: State) -> Tensor:
        """0-dim, or (B,) for the colonies of a state."""
        assert self.value is not None and self.types is None
        return self.value if self.value.dim() == 0 else self.value.index_select(0, state.colony_id)

    def of_cells(self, state: State, kind: int | None = None) -> Tensor:
        """0-dim, or (N,) for the cells of a state. kind: as if all cells were of this type."""
        if self.field is not None:
            if kind is not None and self.draw is not None:
                self.draw.check_kind(kind)
            return state.fields[self.field]
        if self.types is not None:
            own = state.fields["cell_type"]
            return self._by_type(state, own if kind is None else torch.full_like(own, kind), None)
        found = self.of_colonies(state)
        return found if found.dim() == 0 else state.groups.spread(found)

    def constant(self, kind: int | None = None) -> Tensor | None:
        """What it is in every state, 0-dim or (B,) by colony id, for cells of this type; None where
        it may differ from cell to cell."""
        if self.value is None or self.types is None:
            return self.value
        known = self.types.tolist()
        return self.value[known.index(kind)] if kind in known else None

    def of_rows(self, state: State, rows: Tensor, purpose: str | None = None) -> Tensor:
        """(M,) for the cells `rows` (M,); drawn now, by the key `purpose`, where the value is a
        distribution and no field keeps it."""
        if self.draw is not None and self.field is None:
            return self.drawn(state, rows, purpose)
        if self.types is not None:
            return self._by_type(state, state.fields["cell_type"].index_select(0, rows), rows)
        found = self.of_cells(state)
        return found.expand(rows.numel()) if found.dim() == 0 else found.index_select(0, rows)

    def drawn(self, state: State, rows: Tensor, purpose: str | None = None) -> Tensor:
        """(M,) for the cells `rows` (M,), drawn now by the key `purpose`, or else by its name."""
        assert self.draw is not None
        parents = None
        if self.draw.takes_after and self.kept is not None:
            parents = of_parents(state, rows, self.kept)
        return self.draw(state, rows, purpose or self.name, parents)

    def needed_by(self, kinds: Collection[int]) -> Resolved:
        """The same value where only cells of these types need it. If it is drawn, and for just one
        of them, cells of types without a value draw that one's too: they may become of that
        type."""
        given = [] if self.draw is None else [n for n, _ in self.draw.parts if n in kinds]
        if self.draw is None or self.field is None or len(given) != 1:
            return self
        return dataclasses.replace(self, draw=dataclasses.replace(self.draw, others=given[0]))

    def _by_type(self, state: State, kind: Tensor, rows: Tensor | None) -> Tensor:
        assert self.types is not None and self.value is not None
        place = torch.searchsorted(self.types, kind).clamp(max=self.types.numel() - 1)
        wrong = self.types.index_select(0, place) != kind
        if bool(wrong.any()):
            raise missing_type(self.name, int(kind[wrong][0]), self.types.tolist())
        if self.value.dim() == 1:
            return self.value.index_select(0, place)
        ids = state.own_colony_id if rows is None else state.own_colony_id.index_select(0, rows)
        return self.value[place, ids]

    @property
    def requires_grad(self) -> bool:
        if self.draw is not None:
            return self.draw.requires_grad
        return self.value is not None and self.value.requires_grad

    @cached_property
    def is_zero(self) -> bool:
        """Whether it is the plain number 0."""
        value = self.value
        return (
            value is not None
            and value.dim() == 0
            and not (self.requires_grad or has_tangent(value))
            and float(value) == 0
        )


@dataclass(frozen=True, eq=False)
class Scheduled(Resolved):
    """A value that changes in time. each: of the values of the schedule, in their order; all alike
    in what they depend on."""

    schedule: Schedule = field(kw_only=True)
    each: tuple[Resolved, ...] = field(kw_only=True)

    def now(self, state: State) -> Resolved:
        """What holds at the time of a state; during a step, the mean over its time."""
        if state.span is None:
            return self.each[self.schedule.place(state.time)]
        shares = self.schedule.shares(*state.span)
        if len(shares) == 1:
            return self.each[shares[0][0]]
        parts = [share * held for k, share in shares if (held := self.each[k].value) is not None]
        return dataclasses.replace(self.each[shares[0][0]], value=sum(parts[1:], parts[0]))

    def of_colonies(self, state: State) -> Tensor:
        return self.now(state).of_colonies(state)

    def of_cells(self, state: State, kind: int | None = None) -> Tensor:
        return self.now(state).of_cells(state, kind)

    def of_rows(self, state: State, rows: Tensor, purpose: str | None = None) -> Tensor:
        return self.now(state).of_rows(state, rows, purpose)

    def constant(self, kind: int | None = None) -> None:
        return None

    @property
    def requires_grad(self) -> bool:
        return any(x.requires_grad for x in self.each)

    @cached_property
    def is_zero(self) -> bool:
        return all(x.is_zero for x in self.each)


class Values:
    """The resolved values of one effect by name: `values.rate.of_cells(state)`. A value that was
    not given is None."""

    def __init__(self, found: Mapping[str, Resolved | None]):
        self.__dict__.update(found)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"the effect has no physical value {name!r}: it has {', '.join(self)}")

    def __getitem__(self, name: str) -> Resolved:
        return self.__dict__[name]

    def __iter__(self):
        return iter(self.__dict__)

    @property
    def requires_grad(self) -> bool:
        return any(v is not None and v.requires_grad for v in self.__dict__.values())


def resolve(
    name: str,
    value: Any,
    batch: BoundBatch,
    *,
    field: str | None = None,
    kept: str | None = None,
    typed: bool = True,
) -> Resolved | None:
    """A checked value, made ready for a batch. field: where a value drawn at birth is kept; None:
    the caller draws, and keeps it in `kept`, if anywhere. typed: whether the value may also be one
    per cell type, so that a list of as many numbers can be meant as either."""
    if value is None:
        return None
    if isinstance(value, Schedule):
        return _scheduled(name, value, batch, typed)
    if is_drawn(value):
        check_inherited(name, value, kept is not None)
        return Resolved(name, draw=_bound_draw(name, value, batch), field=field, kept=kept)
    if isinstance(value, ByType):
        kinds = sorted(value.values)
        each = [_per_colony(f"{name}[{k}]", value.values[k], batch, listed=False) for k in kinds]
        if any(v.dim() for v in each):
            each = [v.expand(batch.colonies) for v in each]
        return Resolved(name, torch.stack(each), types=torch.tensor(kinds, device=batch.device))
    return Resolved(name, _per_colony(name, value, batch, listed=typed))


def _scheduled(name: str, value: Schedule, batch: BoundBatch, typed: bool) -> Scheduled:
    each = [
        resolve(f"{name}, from {t:g} h", x, batch, typed=typed) for t, x in value.values.items()
    ]
    found = [x for x in each if x is not None and x.value is not None]
    kinds = [x.types for x in found]
    first = kinds[0]
    for time, types in zip(value.times, kinds, strict=True):
        same = types is first or (first is not None and types is not None and types.equal(first))
        if not same:
            raise checks.input_error(
                f"{name}, from {time:g} h", value.values[time],
                "given for the same cell types as the value from 0 h",
            )  # fmt: skip
    # kernels are made for one number, or for one per colony
    shape = max((x.value.shape for x in found if x.value is not None), key=len)
    alike = [dataclasses.replace(x, value=_spread(x, shape)) for x in found]
    return Scheduled(name, types=first, schedule=value, each=tuple(alike))


def _spread(one: Resolved, shape: torch.Size) -> Tensor:
    assert one.value is not None
    own = one.value
    if one.types is not None and own.dim() == 1 and len(shape) == 2:
        own = own.unsqueeze(1)
    return own.expand(shape).contiguous() if own.shape != shape else own


def _bound_draw(name: str, value: Any, batch: BoundBatch) -> BoundDraw:
    if isinstance(value, Distribution):
        return BoundDraw(name, ((None, _distribution(name, value, batch)),))
    parts = [
        (
            kind,
            (
                _distribution(f"{name}[{kind}]", v, batch)
                if isinstance(v, Distribution)
                else resolve(f"{name}[{kind}]", v, batch, typed=False)
            ),
        )
        for kind, v in sorted(value.values.items())
    ]
    return BoundDraw(name, tuple(parts))


def _distribution(name: str, value: Distribution, batch: BoundBatch) -> tuple[Distribution, Values]:
    shared = () if isinstance(value.inherited, bool) else ("inherited",)
    return value, Values({
        p: resolve(f"{name}.{p}", getattr(value, p), batch, typed=False)
        for p in (*value.parameters, *shared)
    })  # fmt: skip


def _per_colony(name: str, value: Any, batch: BoundBatch, listed: bool = True) -> Tensor:
    """One number, or one per colony, as a tensor of the batch."""
    stated = isinstance(value, PerColony)
    given = value.values if stated else value
    if not isinstance(given, Tensor):
        return torch.tensor(given, dtype=batch.dtype, device=batch.device)
    if given.dim():
        check_length(name, given, batch)
        ambiguous = (
            listed
            and not stated
            and not batch.per_colony
            and len(batch.types) == batch.colonies > 1
        )
        if ambiguous:
            pairs = ", ".join(
                f"{k}: {float(v):g}" for k, v in zip(batch.types, given.detach(), strict=True)
            )
            short = name.partition(",")[0].split(".")[-1]  # without the time in a schedule
            raise checks.InputError(
                f"{name} has {given.numel()} values, and the batch has {batch.colonies} colonies"
                f" and as many cell types. Write {short}={{{pairs}}} for one value"
                " per cell type, or tf.PerColony([…]) for one per colony."
            )
    return given.to(dtype=batch.dtype, device=batch.device, copy=True)


def check_length(name: str, given: Tensor, batch: BoundBatch) -> None:
    """Raise InputError where a tensor has not one value for each colony of the batch."""
    if given.dim() and given.shape[0] != batch.colonies:
        raise checks.InputError(
            f"{name} has {given.shape[0]} values, but the batch has"
            f" {displays.counted(batch.colonies, 'colony', 'colonies')}: give one number, or one"
            " for each colony (scene.bind(colonies=…), tf.simulate(…, colonies=…), run"
            " --colonies)."
        )


def snapshot(part: Any, path: str, batch: BoundBatch) -> Any:
    """A wall, signal or other part of an effect with its tensors copied to the batch's device,
    their lengths checked."""

    def copied(path: str, x: Any) -> Any:
        if not isinstance(x, Tensor):
            return x
        check_length(path, x, batch)
        return x.to(device=batch.device, copy=True)

    return mapped(part, copied, path)


def drawn_field(title: str, name: str, value: Any) -> Field:
    """The field that keeps a value drawn at birth."""
    plain = (
        f"{title}_{name}".replace(" ", "_").replace("[", "_").replace("].", "_").replace("]", "")
    )
    rule = "copy" if is_inherited(value) else "reset"
    return Field(plain, f"{name} of the {title}, drawn for the cell", at_division=rule)


@dataclass(frozen=True, eq=False)
class FirstValue:
    """A field's first value, with the effect's resolved values."""

    initial: Any
    values: Values

    def __call__(self, state: State, rows: Tensor) -> Tensor:
        return self.initial(state, rows, self.values)


@dataclass(frozen=True, eq=False)
class DrawnValue:
    """The first value of a field that keeps what is drawn for a cell."""

    value: Resolved

    def __call__(self, state: State, rows: Tensor) -> Tensor:
        return self.value.drawn(state, rows)
