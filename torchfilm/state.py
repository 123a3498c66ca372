"""The state: one flat batch of cells over many colonies."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchfilm import state_colonies
from torchfilm.physics import capsule
from torchfilm.physics.space import PeriodicSpace
from torchfilm.signals.layout import Contact, Layout, Signals
from torchfilm.state_colonies import CELL, COLONY, GRID, PER_COLONY, Arrived, Ended, note_of
from torchfilm.tools import checks, displays, random, row_checks, tangents
from torchfilm.tools.ragged import Groups
from torchfilm.tools.read_only import read_only
from torchfilm.tools.units import is_concentration

# why cells leave a state
FATES = ("divided", "removed", "left", "failed", "lysed", "eroded", "sloughed")
# Signals stand among the fields under "out.NAME", beside what cells hold under the same name.
OUTSIDE = "out."


@dataclass(frozen=True)
class Field(metaclass=checks.KnownKeywords):
    """A named quantity that an effect declares. What no effect declares does not exist.

    scope: "cell" (one row a cell), "colony" (one row a colony) or "grid" (one row a voxel of the
    state's layout; the name begins with "out."). shape: of one row. dtype: by default the state's.
    unit and meaning: for people. initial: a number, or a function that returns a tensor (M, *shape)
    for the new rows (M,): at the start and, where at_division = "reset", for daughters, when
    `state.births[-1]` tells of their parents. It is called with (state, rows, values) where an
    effect declares the field, its values resolved; else, as by `state.declare`, with (state, rows).
    at_division: "copy" or "reset". internal: it serves the numerics; tables hide it by default.
    """

    name: str
    meaning: str
    unit: str = ""
    scope: str = CELL
    shape: tuple[int, ...] = ()
    dtype: torch.dtype | None = None
    initial: float | Callable[..., Tensor] = 0.0
    at_division: str = "copy"
    internal: bool = False

    def __post_init__(self) -> None:
        row_checks.check_declaration(self.name, self.shape, self.initial)
        checks.choice(f"Field({self.name!r}).scope", self.scope, (CELL, COLONY, GRID))
        checks.choice(f"Field({self.name!r}).at_division", self.at_division, ("copy", "reset"))
        plain = self.name.removeprefix(OUTSIDE) if self.scope == GRID else self.name
        if not plain.isidentifier() or self.name in RESERVED:
            rule = "an identifier that the state does not use itself"
            raise checks.input_error("Field.name", self.name, rule)

    @property
    def is_species(self) -> bool:
        """Whether it is a concentration in each cell."""
        return self.scope == CELL and is_concentration(self.unit)

    def start(self, state: State, rows: Tensor) -> Tensor:
        """Initial values for the given rows (M,) of the state: (M, *shape)."""
        dtype, shape = self.dtype or state.dtype, (rows.numel(), *self.shape)
        if not callable(self.initial):
            return torch.full(shape, self.initial, dtype=dtype, device=state.device)
        found = row_checks.first_values(self.name, self.initial(state, rows), shape)
        return found.to(dtype)


@dataclass(frozen=True)
class Births:
    """Divisions of one step: rows (M,) of both daughters in the state right after, uids and lengths
    (2M,) of first, then second ones, and the state before, with the rows (M,) of the parents."""

    first: Tensor
    second: Tensor
    uid: Tensor
    length: Tensor
    before: State
    rows: Tensor

    @cached_property
    def parents(self) -> State:
        """The parents, M cells, as they were."""
        return self.before.take(self.rows)


MAPPINGS = ("fields", "declared", "reports")  # parts that are kept as views that cannot change


@dataclass(frozen=True, eq=False)
class State:
    """Cells of B colonies, N in all, those of one colony side by side. A step returns a new one.

    colony (N,) int64, place of its colony in this batch · uid, parent (N,) int64, unique within a
    colony, founders have parent −1 · position (N, d) µm, always float64, so that a colony far from
    the origin keeps its resolution · axis (N, d) unit · length (N,) µm, of the centreline · radius
    (N,) µm · fields, by name. colony_id (B,): which colony of the scene each is; parameters per
    colony go by it. stream (B,): which course of random numbers each follows, by default its
    colony_id; colonies of one stream and alike in their parameters are alike in all. next_uid (B,).
    A field is also an attribute: `state.growth_rate`. layout: of the voxels of a medium, where
    `state.signals["ahl"]` (nodes,) is. space: if it is periodic. dt: h, of the step that led here.
    span: during a step, the times, h, over which inputs that change in time are averaged.
    """

    colony: Tensor
    uid: Tensor
    parent: Tensor
    position: Tensor
    axis: Tensor
    length: Tensor
    radius: Tensor
    colony_id: Tensor
    stream: Tensor
    next_uid: Tensor
    seed: int
    step: int = 0
    time: float = 0.0
    dt: float = 0.0
    span: tuple[float, float] | None = None
    fields: Mapping[str, Tensor] = field(default_factory=dict)
    declared: Mapping[str, Field] = field(default_factory=dict)
    layout: Layout | None = None
    space: PeriodicSpace | None = None
    births: tuple[Births, ...] = ()
    ended: tuple[Ended, ...] = ()
    arrived: tuple[Arrived, ...] = ()
    reports: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in MAPPINGS:
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __getattr__(self, name: str) -> Tensor:
        fields = self.__dict__.get("fields", {})
        if name in fields:
            return fields[name]
        known = (*PER_CELL, *PER_COLONY, "volume", "area", *fields)
        raise row_checks.no_such_part(name, PER_CELL, self._own_fields(), known)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *(n for n in self._own_fields() if n.isidentifier())]

    @property
    def cells(self) -> int:
        """Number of cells in all colonies."""
        return self.colony.numel()

    @property
    def colonies(self) -> int:
        return self.colony_id.numel()

    @property
    def dim(self) -> int:
        return self.position.shape[1]

    @property
    def dtype(self) -> torch.dtype:
        return self.length.dtype

    @property
    def device(self) -> torch.device:
        return self.length.device

    @cached_property
    def groups(self) -> Groups:
        """The cells of each colony, for sums and maxima over colonies."""
        return Groups(self.colony, self.colonies, ordered=True)

    @cached_property
    def counts(self) -> Tensor:
        """Cells in each colony, (B,) int64."""
        return self.groups.counts

    @property
    def volume(self) -> Tensor:
        """(N,) µm³."""
        return self._of_shape("volume", capsule.volume)

    @property
    def area(self) -> Tensor:
        """(N,) µm²."""
        return self._of_shape("area", capsule.area)

    def _of_shape(self, name: str, law: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Worked out once; but each time where a gradient may pass, which `no_grad` would stop."""
        if self.length.requires_grad or self.radius.requires_grad:
            return law(self.length, self.radius)
        if name not in self.__dict__:
            self.__dict__[name] = law(self.length, self.radius)
        return self.__dict__[name]

    @property
    def signals(self) -> dict[str, Tensor]:
        """Values of each signal by name, (nodes,), laid out as `layout.grid` says."""
        names = [n for n in self.fields if n.startswith(OUTSIDE)]
        return Signals({n.removeprefix(OUTSIDE): self.fields[n] for n in names})

    @property
    def position_3d(self) -> Tensor:
        """Positions in the three dimensions of the medium, (N, 3) float64, µm."""
        if self.layout is None:
            raise checks.InputError("the state has no medium: list a Medium in the scene.")
        if self.position.requires_grad:
            return self.layout.position_3d(self.position)
        if "position_3d" not in self.__dict__:
            self.__dict__["position_3d"] = self.layout.position_3d(self.position)
        return self.__dict__["position_3d"]

    def contact(self, names: Iterable[str] | None = None) -> Contact | None:
        """Where cells meet the medium and what they find there of each signal, or of these; None in
        a scene without a medium."""
        if self.layout is None:
            return None
        values = self.signals if names is None else {n: self.fields[OUTSIDE + n] for n in names}
        return self.layout.contact(
            self.position_3d, self.colony, self.colony_id, values, self.dtype
        )

    @property
    def own_colony_id(self) -> Tensor:
        """The id of each cell's colony, (N,)."""
        return self.colony_id.index_select(0, self.colony)

    @property
    def own_stream(self) -> Tensor:
        """The stream of each cell's colony, (N,)."""
        return self.stream.index_select(0, self.colony)

    def replace(self, **changes: Any) -> State:
        """A state with some of its parts replaced."""
        if unknown := changes.keys() - PARTS:
            raise checks.unknown_keyword("State.replace", min(unknown), sorted(PARTS))
        # as dataclasses.replace, which takes twenty times as long; a step makes ten states
        made, parts = object.__new__(type(self)), dict(self.__dict__)
        for name, of in DERIVED.items():
            if name in parts and not changes.keys().isdisjoint(of):
                del parts[name]
        for name, value in changes.items():
            parts[name] = read_only(value) if name in MAPPINGS else value
        made.__dict__.update(parts)
        return made

    def with_length(self, length: Tensor, volume: Tensor, area: Tensor) -> State:
        """A state whose cells have other lengths (N,), which mean these volumes and areas."""
        made = self.replace(length=length)
        made.__dict__.update(volume=volume, area=area)
        return made

    def with_fields(self, **values: Tensor) -> State:
        """A state with some of its fields replaced; each must have been declared, and keeps its
        type: whole numbers become floats, and float64 becomes float32 where the field is that."""
        if unknown := sorted(values.keys() - self.declared.keys()):
            own = [name for name, field in self.declared.items() if not field.internal]
            rule = f"declared: {', '.join(own) or 'none'}; parts have replace(position=…)"
            hint = checks.suggestion(unknown[0], own)
            raise checks.input_error("field", unknown[0], rule, hint)
        given = row_checks.checked_tensors(values, self.fields, self.device, self._shape_of)
        return self.replace(fields={**self.fields, **given})

    @property
    def _rows(self) -> dict[str, int]:
        """How many rows a field of each scope has."""
        nodes = 0 if self.layout is None else self.layout.grid.nodes
        return {CELL: self.cells, COLONY: self.colonies, GRID: nodes}

    def _shape_of(self, name: str) -> tuple[int, ...]:
        return (self._rows[self.declared[name].scope], *self.declared[name].shape)

    def check_fields(self) -> None:
        """Raise InputError for a field of another number of rows."""
        scopes = {n: self.declared[n].scope for n in self.fields}
        row_checks.check_fields(self.fields, scopes, self._rows)

    def declare(self, field: Field) -> State:
        """A state with one more field, at its first value; in no_grad views keep no dead graph."""
        if not isinstance(field, Field):
            raise checks.input_error("field", field, "a tf.Field(…)")
        declared = self.replace(declared={**self.declared, field.name: field})
        if field.scope == GRID and self.layout is None:
            raise checks.InputError(
                f"the field {field.name!r} needs a grid, and this state has none: list a Medium in"
                " the scene."
            )
        rows = self._rows[field.scope]
        start = field.start(declared, torch.arange(rows, device=self.device))
        start = start.detach() if tangents.graph_is_dead(start) else start
        return declared.with_fields(**{field.name: start})

    def cell_columns(self) -> dict[str, Tensor]:
        """All that cells have, by name: for what copies a state as a whole, whatever it holds."""
        own = {name: getattr(self, name) for name in PER_CELL}
        return own | {n: x for n, x in self.fields.items() if self.declared[n].scope == CELL}

    def take(self, index: Tensor, **known: Tensor) -> State:
        """The cells at `index` (M,), which keeps colonies side by side; colonies stay, if need be
        empty. known: parts that these cells have already, such as `length`."""
        row_checks.check_rows("index", index, self.cells)
        columns = {n: x for n, x in self.cell_columns().items() if n not in known}
        try:
            new = {name: x.index_select(0, index) for name, x in columns.items()}
        except IndexError as error:
            raise row_checks.out_of_range("index", index, self.cells) from error
        part = {name: new.pop(name) for name in PER_CELL if name in new}
        return self.replace(**part, **known, fields={**self.fields, **new})

    def reset_at_division(self, daughters: Tensor, names: Iterable[str]) -> State:
        """The state right after divisions (`births[-1]` tells of them) in which those of the named
        fields that a division resets start again in the cells `daughters` (M,), first daughters
        first; the others they have from their parents."""
        changed = {}
        for name in names:
            declared = self.declared[name]
            if declared.scope != CELL or declared.at_division != "reset":
                continue
            value, first = self.fields[name], declared.initial
            if callable(first):
                changed[name] = value.index_copy(0, daughters, declared.start(self, daughters))
            else:
                changed[name] = value.index_fill(0, daughters, first)
        return self.with_fields(**changed)

    def remove(self, gone: Tensor, fate: str = "removed") -> State:
        """The state without the cells where `gone` (N,) is true, whose end is noted. fate: one of
        `FATES`; of cells that go between two steps of a run, a recording knows that they went, and
        calls them removed."""
        row_checks.check_mask("gone", gone, self.cells)
        checks.choice("fate", fate, FATES)
        if not bool(gone.any()):
            return self
        lost, kept = torch.nonzero(gone).squeeze(1), torch.nonzero(~gone).squeeze(1)
        return self.take(kept).replace(ended=(*self.ended, self.noted_end(lost, fate)))

    def noted_end(self, rows: Tensor, fate: str) -> Ended:
        """What the lineage keeps of the cells `rows` (M,), which leave."""
        return note_of(self, rows, fate)

    def select(self, colonies: row_checks.Rows) -> State:
        """Some colonies of the batch, by their places, in the order given. Each goes on as it would
        have in the whole."""
        places = row_checks.checked_places("colonies", colonies, self.colonies, self.device)
        return state_colonies.selected(self, places)

    def put(
        self, colonies: row_checks.Rows, other: State, taken: row_checks.Rows | None = None
    ) -> State:
        """The state with others in place of some colonies: new ones, as after an episode, or
        copies, as in a particle filter.

        colonies: which, by their places. other: a state of the same scene, such as `model.start()`
        or this one. taken: which of its colonies, by place, one for each of `colonies`; one may be
        taken often. Default: all, in order. The place keeps its colony_id, and with it parameters
        per colony; its stream of random numbers; and the batch its seed, step and time. Raises
        InputError for a state of another scene.
        """
        return state_colonies.put(self, colonies, other, taken)

    def detach(self) -> State:
        """The same state without the derivatives that it carries, as where a backward pass is cut
        off: also without those of columns such as growth_rate, by which derivatives by Growth.rate
        go on; and without births, ends and reports of its step."""
        cut = self.moved(lambda part: part.detach() if isinstance(part, Tensor) else part)
        return cut.replace(births=(), ended=(), reports={})

    def to(self, device: str | torch.device) -> State:
        """The same state on another device."""
        device = checks.device(device)
        return self.moved(lambda part: part.to(device)).replace(births=(), ended=(), reports={})

    def moved(self, move: Callable[[Any], Any]) -> State:
        """The state with each tensor, and its layout, as a function returns it."""
        return self.replace(
            **{name: move(getattr(self, name)) for name in (*PER_CELL, *PER_COLONY)},
            fields={n: move(v) for n, v in self.fields.items()},
            layout=None if self.layout is None else move(self.layout),
            arrived=tuple(a.moved(move) for a in self.arrived),
        )

    def uniform(self, rows: Tensor, purpose: str) -> Tensor:
        """A draw from (0, 1) for each of the given cells (M,), the same whatever the batch: keyed
        by seed, stream, uid, step, purpose. Of 23 bits: nothing rarer than 1e-6 goes by one."""
        return state_colonies.drawn(self, random.uniform, rows, purpose)

    def normal(self, rows: Tensor, purpose: str) -> Tensor:
        """Four standard normal draws for each of the given cells, (M, 4), keyed as `uniform`."""
        return state_colonies.drawn(self, random.normal, rows, purpose)

    def sample_cells(self, count: int, purpose: str = "sample") -> Tensor:
        """`count` cells of each colony at random, none twice, or all of a colony that has no more:
        (N,) bool. Keyed as `uniform`; draws of one step differ by their purposes."""
        return state_colonies.sampled(self, count, purpose)

    def _own_fields(self) -> list[str]:
        """The fields but those that serve the numerics."""
        # not as attributes: a state that is being copied has none yet
        fields, declared = (self.__dict__.get(n, {}) for n in ("fields", "declared"))
        return [n for n in fields if not (n in declared and declared[n].internal)]

    def __repr__(self) -> str:
        colonies = displays.counted(self.colonies, "colony", "colonies")
        failed = sum(bool(report.status.any()) for report in self.reports.values())
        return (
            f"State({colonies}, {displays.counted(self.cells, 'cell')}, {self.dim}-D,"
            f" t = {self.time:g} h, step {self.step}, {str(self.dtype)[6:]} on {self.device}"
            f"{', FAILED: see tf.failures(state)' * bool(failed)}"
            f", fields: {', '.join(self._own_fields()) or 'none'})"
        )

    def _repr_html_(self) -> str:
        sizes = {"cells of a colony": ("", self.counts), "length": ("µm", self.length)}
        own = {n: (self.declared[n].unit, self.fields[n]) for n in self._own_fields()}
        return displays.card(
            repr(self).partition(", fields")[0] + ")", displays.ranges(sizes | own)
        )


PER_CELL = ("colony", "uid", "parent", "position", "axis", "length", "radius")
# What is worked out once for a state, and from which of its parts.
DERIVED = {
    "groups": ("colony", "colony_id"),
    "counts": ("colony", "colony_id"),
    "volume": ("length", "radius"),
    "area": ("length", "radius"),
    "position_3d": ("position", "layout"),
}
PARTS = frozenset(part.name for part in dataclasses.fields(State))
RESERVED = PARTS | {n for n in vars(State) if not n.startswith("__")}
# A field that first cells may bring and rules may set.
CELL_TYPE = Field(
    "cell_type", "kind of cell, a whole number that rules and circuits go by", dtype=torch.int64
)
