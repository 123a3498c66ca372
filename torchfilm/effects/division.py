"""Division: every cell that is due becomes two daughters, end to end in its place."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import DIVISION, Binding, BoundEffect, Effect
from torchfilm.effects.compiled_division import (
    Drawn,
    can_divide,
    divided,
    due_rows,
    evenly_drawn,
    known_number,
    knows_due,
)
from torchfilm.effects.division_lengths import (
    CAPS,
    least_length,
    length_at_birth,
    smaller_shares,
    without_short,
)
from torchfilm.physics import capsule
from torchfilm.resolver import Resolved, Values
from torchfilm.state import CELL, Births, Field, State
from torchfilm.tools import checks
from torchfilm.tools.ragged import offsets, repeated
from torchfilm.tools.reads import numbers, rows_where
from torchfilm.tools.row_checks import check_field
from torchfilm.tools.vectors import nearest_root
from torchfilm.values import ByType, Value, is_drawn, is_inherited, largest, physical, smallest

CRITERIA = ("length", "volume", "added")
PIXELS = 10.0  # µm; for a longer first cell, messages say that lengths may be in pixels
THRESHOLD = "a threshold (such as length=tf.Uniform(3.5, 4.5))"  # what it needs without rules


@dataclass(frozen=True, eq=False)
class Division(Effect):
    """Cells divide at a threshold, or when a rule sets their `divide_flag`.

    Give at most one threshold. length: centreline length, µm. volume: µm³. added: centreline grown
    since birth, µm (the adder). Each is a number, one per colony, one per cell type, or a
    distribution drawn for each cell at birth. A cell that a rule gives another type gets the
    threshold of that type. Cells divide at the end of the step in which they get there, but in the
    next one where they are born beyond it; the flag also works beside a threshold. Without a
    threshold, only cells with `divide_flag` divide, right after the rules, before cells grow.

    conserves: "length", caps included, as the paper does and loses a little volume by it; or
    "volume": then daughters' outer ends are r/3 farther out than their parent's. fraction: share of
    that length, or volume, that the first daughter (at the −axis end) gets; a distribution is drawn
    at each division. axis_noise: standard deviation of the noise on each component of a daughter's
    axis.
    """

    length: Value | None = physical(None, unit="µm", above=0.0, drawn_by_effect=True)
    volume: Value | None = physical(None, unit="µm³", above=0.0, drawn_by_effect=True)
    added: Value | None = physical(None, unit="µm", above=0.0, drawn_by_effect=True)
    fraction: Value = physical(0.5, above=0.0, most=1.0, drawn_by_effect=True)
    axis_noise: Value = physical(0.001, least=0.0, most=0.5, drawn_by_effect=True)
    conserves: str = "length"

    stage = DIVISION
    title = "division"
    by_kernels = True
    may_repeat = False

    def __post_init__(self) -> None:
        checks.choice("Division.conserves", self.conserves, tuple(CAPS))
        given = [name for name in CRITERIA if getattr(self, name) is not None]
        if len(given) > 1:
            raise checks.InputError(
                f"Division got {' and '.join(given)}: give one criterion (length, volume or added),"
                " or none and a rule."
            )
        if largest(self.fraction) >= 1.0:
            raise checks.input_error(
                "Division.fraction", self.fraction, "between 0 and 1, both excluded"
            )

    @property
    def criterion(self) -> str | None:
        return next((name for name in CRITERIA if getattr(self, name) is not None), None)

    @property
    def divides_at_threshold(self) -> bool:
        return self.criterion is not None

    def declares(self, dim: int) -> tuple[Field, ...]:
        fields = [
            Field(
                "divide_flag",
                "divides at the next opportunity",
                dtype=torch.bool,
                at_division="reset",
                internal=True,
            )
        ]
        name = self.criterion
        if name is not None:
            threshold = getattr(self, name)
            # of numbers by type, those of a type that the division changes
            drawn, by_type = is_drawn(threshold), isinstance(threshold, ByType)
            reset = not is_inherited(threshold) if drawn else by_type
            fields.append(
                Field(
                    "division_threshold",
                    f"{name} at which the cell divides",
                    "µm³" if name == "volume" else "µm",
                    initial=_FIRST_THRESHOLD[name],
                    at_division="reset" if reset else "copy",
                )
            )
        if name == "added":
            fields.append(
                Field(
                    "birth_length",
                    "centreline length at birth",
                    "µm",
                    initial=length_at_birth,
                    at_division="reset",
                )
            )
        return tuple(fields)

    def keeps(self) -> Mapping[str, str]:
        return dict.fromkeys(CRITERIA, "division_threshold")

    def reads(self) -> tuple[str, ...]:
        threshold = ("division_threshold",) if self.criterion else ()
        at_birth = ("birth_length",) if self.criterion == "added" else ()
        return ("divide_flag", "length", "radius", "position", "axis", *threshold, *at_birth)

    def writes(self) -> tuple[str, ...]:
        return ("cells", "position", "axis", "length", "divide_flag")

    def waits_for(self) -> Mapping[str, str]:
        return {} if self.divides_at_threshold else {"divide_flag": THRESHOLD}

    def idle_without(self, state: State) -> Mapping[str, str]:
        if self.divides_at_threshold or bool(state.fields["divide_flag"].any()):
            return {}
        return {
            "divide_flag": "Division() has no threshold, and nothing here sets divide_flag: no cell"
            f" divides, unless you set it. Give {THRESHOLD}, or a rule that sets it."
        }

    def check(self, state: State, values: Values) -> None:
        if self.criterion is None or state.cells == 0:
            return
        # cells from a micrograph may exceed the threshold drawn for them, and divide in the first
        # step; no cell may exceed every threshold that can be drawn
        least, most = self._bounds(state)
        added = torch.zeros_like(state.length)
        start = {"length": state.length, "volume": state.volume, "added": added}[self.criterion]
        below = torch.nonzero(start >= most).squeeze(1)
        if below.numel():
            k = int(below[0])
            raise checks.InputError(
                f"Division.{self.criterion}: cell {int(state.uid[k])} in colony"
                f" {int(state.own_colony_id[k])} begins with a {self.criterion} of"
                f" {float(start[k]):g}, and its threshold is {float(most[k]):g} at most."
                + _pixels_hint(float(state.length[k]), float(state.radius[k]))
                + " Raise the threshold or start from smaller cells."
            )
        if self.criterion == "added":
            return
        # daughters keep the radius, so a cell's own threshold is compared with its own radius
        small = smaller_shares(self.fraction, values.fraction, state)
        needed = least_length(small, CAPS[self.conserves]) * state.radius
        if self.criterion == "volume":
            needed = capsule.volume(needed, state.radius)
        short = torch.nonzero(least < needed * (1 - 1e-6)).squeeze(1)
        if short.numel():
            k = int(short[0])
            share = float(small[k])
            raise checks.InputError(
                f"Division.{self.criterion} can be {float(least[k]):g}: it must be at least"
                f" {float(needed[k]):g} for radius {float(state.radius[k]):g} µm"
                + (f" and a fraction of {share:g}" if share < 0.5 else "")
                + ", or the daughters would have a negative length (each has two caps). Raise the"
                " threshold" + (", or take a fraction nearer to 0.5." if share < 0.5 else ".")
            )

    def _bounds(self, state: State) -> tuple[Tensor, Tensor]:
        """The smallest and the largest threshold that each cell, of its type, can have, (N,): its
        own one where none is drawn."""
        given = getattr(self, str(self.criterion))
        least = most = state.division_threshold
        every = torch.ones_like(least, dtype=torch.bool)
        parts = given.values.items() if isinstance(given, ByType) else [(None, given)]
        for kind, value in parts:
            if is_drawn(value):
                mine = every if kind is None else state.fields["cell_type"] == kind
                least = torch.where(mine, smallest(value), least)
                most = torch.where(mine, largest(value), most)
        return least, most

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        # a subclass may have rules of its own, which kernels do not know
        own = any(getattr(type(self), n) is not getattr(Division, n) for n in ("due", "step"))
        bound = BoundEffect(self, binding) if own else _BoundDivision(self, binding)
        bound.stage = binding.division_stage
        return (bound,)

    def numerics(self, dt: float, state: State) -> list[str]:
        if self.criterion is None:
            return ["cells that a rule has flagged, before they grow"]
        return [f"at the end of a step: up to {dt:g} h after a cell gets there"]

    def size(self, state: State) -> Tensor | None:
        """What is compared with the threshold of each cell, (N,); None where there is none."""
        if self.criterion == "added":
            return state.length - state.fields["birth_length"]
        return getattr(state, self.criterion) if self.criterion else None

    def due(self, state: State) -> Tensor:
        """Which cells divide now, (N,) bool."""
        size, flag = self.size(state), state.fields["divide_flag"]
        return flag if size is None else flag | (size >= state.fields["division_threshold"])

    def step(self, state: State, dt: float, values: Values) -> State:
        need = self.need(values)
        due = _due_by_torch(self, state, need)
        return _divided_where_due(state, *due, need, values, None, CAPS[self.conserves])

    def need(self, values: Values) -> Any:
        """The length that a cell needs to divide, radii: one number, or None where its daughters'
        shares are its own."""
        share = self.fraction if isinstance(self.fraction, float) else values.fraction.value
        alone = share is not None and not getattr(share, "ndim", 0)
        return least_length(share, CAPS[self.conserves]) if alone else None


class _BoundDivision(BoundEffect):
    """Division with what kernels need to know of its threshold."""

    effect: Division

    def __init__(self, effect: Division, binding: Binding):
        super().__init__(effect, binding)
        name = effect.criterion
        self.drawn = None if name is None else evenly_drawn(self.values[name])

    def check_given(self, state: State, free: Container[str]) -> None:
        name = "division_threshold"
        if name not in free:
            check_field(state.fields, name, torch.isnan, "a number, or inf: never")

    def step(self, state: State, dt: float) -> State:
        size = self.effect.size(state)
        known = knows_due(state, size)
        need = self.effect.need(self.values)
        if known:
            rows, some_short = due_rows(state, size, 0.0 if need is None else float(need))
        else:
            rows, some_short = _due_by_torch(self.effect, state, need)
        if rows is None:
            return state
        more = self._fresh(state), CAPS[self.effect.conserves]
        return _divided_where_due(state, rows, some_short, need, self.values, *more)

    def _fresh(self, state: State) -> dict[str, float | Drawn] | None:
        """With what daughters begin in the fields that a division resets, if all do so by numbers
        or by even draws that kernels know."""
        found: dict[str, float | Drawn] = {}
        columns = state.cell_columns()
        for name, field in state.declared.items():
            if field.scope != CELL or field.at_division != "reset":
                continue
            begin: float | Drawn | None = None
            if not callable(field.initial):
                begin = known_number(field.initial, columns[name].dtype)
            elif isinstance(getattr(field.initial, "initial", 0), _FirstThreshold):
                begin = self.drawn if columns[name].dtype == state.dtype else None
            if begin is None:
                return None
            found[name] = begin
        return found


def _due_by_torch(division: Division, state: State, need: Any) -> tuple[Tensor | None, int]:
    """The rows of the cells that divide, None for none; and whether some are too short, where need
    (radii) is one number."""
    with torch.no_grad():
        due = division.due(state)
        short = due & (state.length < (0.0 if need is None else need) * state.radius)
        some_due, some_short = numbers(due.any(), short.any())
        return (rows_where(due)[0] if some_due else None), some_short


def _divided_where_due(
    state: State,
    rows: Tensor | None,
    some_short: int,
    need: Any,
    values: Values,
    fresh: Mapping[str, float | Drawn] | None,
    caps: float,
) -> State:
    """The state in which the cells `rows` are divided, but those of colonies in which one is too
    short: if any is, or where each has a share of its own. need: as `Division.need` has it. fresh,
    caps: as `divide` has them."""
    if rows is None:
        return state
    share = _of_rows(values.fraction, state, rows, "Division.fraction")
    if some_short or share.dim():
        with torch.no_grad():
            need = least_length(share, caps) if need is None else need
            state, sound = without_short(state, rows, need)
        if sound is not None:
            rows, share = rows[sound], share[sound] if share.dim() else share
    return divide(state, rows, share, values.axis_noise, fresh, caps) if rows.numel() else state


def _pixels_hint(length: float, radius: float) -> str:
    """A hint for initial cells of tens of µm; "" for shorter ones."""
    if length < PIXELS:
        return ""
    return (
        f" Lengths of tens of µm look like pixels (this cell: length {length:g}, radius"
        f" {radius:g}): multiply x, y, z, length and radius by the size of a pixel in µm."
    )


def divide(
    state: State,
    rows: Tensor,
    share: Tensor,
    axis_noise: Resolved,
    fresh: Mapping[str, float | Drawn] | None,
    caps: float,
) -> State:
    """Divides the cells `rows` (M,), ascending. The daughters are neighbours in the batch; the
    first lies at the parent's −axis end. share: (M,) or (), of what is conserved, that it gets.
    fresh: with what daughters begin in all fields that a division resets, if that is known; kernels
    then see to it.

    With c = caps·r, daughters of shares f and 1 − f get f(l + c) − c and (1 − f)(l + c) − c. They
    touch, with their middle in that of the parent. Gradients pass through.
    """
    by_kernels = can_divide(state, share, axis_noise)
    if by_kernels:
        noise = _of_rows(axis_noise, state, rows)
        new, daughters = divided(state, rows, share, noise, fresh or {}, caps)
    else:
        new, daughters = _divided(state, rows, share, axis_noise, caps)
    first, second = daughters.chunk(2)
    uid, length = (x.index_select(0, daughters) for x in (new.uid, new.length))
    births = Births(first, second, uid, length, state, rows)
    note = state.noted_end(rows, "divided")
    at = new.position if new.space is None else new.space.inside(new.position)
    new = new.replace(births=(*new.births, births), ended=(*new.ended, note), position=at)
    if by_kernels and fresh is not None:
        return new
    return new.reset_at_division(daughters, new.declared)


def _of_rows(value: Resolved, state: State, rows: Tensor, purpose: str | None = None) -> Tensor:
    """(M,), or () where it is the same for all cells."""
    same = value.value
    return same if same is not None and not same.dim() else value.of_rows(state, rows, purpose)


def _divided(
    state: State, rows: Tensor, share: Tensor, axis_noise: Resolved, caps: float
) -> tuple[State, Tensor]:
    """As `compiled_division.divided`, by torch, with daughters whose fields are their parents'."""
    due = torch.zeros_like(state.colony).index_fill(0, rows, 1)
    whole = state.cells + rows.numel()
    every = torch.arange(state.cells, device=state.device)
    first = torch.cumsum(due + 1, 0).index_select(0, rows) - 2
    daughters = torch.cat([first, first + 1])
    new = state.take(repeated(every, due + 1, whole))
    uid, parent, next_uid = _new_ids(new, daughters, state.uid.index_select(0, rows))
    new = new.replace(uid=uid, parent=parent, next_uid=next_uid)
    length, radius, axis = (
        x.index_select(0, rows) for x in (state.length, state.radius, state.axis)
    )
    own = caps * radius
    rest, more = length - own, (2 * share - 1) * own  # exactly 0 for equal halves
    lengths = torch.cat([rest * share + more, rest * (1 - share) - more])
    lengths = lengths.clamp(min=0.0)  # where rounding takes one below
    shift = 0.5 * (lengths - torch.cat([length, length]))
    shift = shift - (1 - 0.5 * caps) * torch.cat([radius, radius])
    shift = torch.cat([shift[: rows.numel()], -shift[rows.numel() :]]).unsqueeze(1)
    axis = torch.cat([axis, axis])
    moved = (shift * axis).to(new.position.dtype)
    if not axis_noise.is_zero:
        sd = axis_noise.of_rows(new, daughters, "axis_noise").unsqueeze(1)
        turned = axis + sd * new.normal(daughters, "Division.axis_noise")[:, : new.dim]
        # not sum, whose order may vary
        first, *others = (turned * turned).split(1, dim=1)
        square = reduce(torch.add, others, first)
        axis = torch.where(sd > 0, turned * (1.0 / nearest_root(square)), axis)
    made = new.replace(
        length=new.length.index_copy(0, daughters, lengths),
        position=new.position.index_add(0, daughters, moved),
        axis=new.axis.index_copy(0, daughters, axis),
    )
    return made, daughters


def _new_ids(new: State, daughters: Tensor, parents: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """New uids, numbered on within each colony; the parents' uids (M,); and each colony's next
    uid."""
    is_new = torch.zeros(new.cells, dtype=torch.int64, device=new.device)
    is_new[daughters] = 1
    before = torch.cumsum(is_new, 0) - is_new
    # new cells in each colony; offsets gives those in the colonies before
    ends = torch.cat([before.new_zeros(1), before + is_new])
    per_colony = ends.index_select(0, new.groups.begin).diff()
    base = new.next_uid - offsets(per_colony)[:-1]
    uid = torch.where(is_new > 0, base.index_select(0, new.colony) + before, new.uid)
    parent = new.parent.clone()
    parent[daughters] = torch.cat([parents, parents])
    return uid, parent, new.next_uid + per_colony


@dataclass(frozen=True)
class _FirstThreshold:
    """The initial threshold of new cells for one criterion."""

    name: str

    def __call__(self, state: State, rows: Tensor, values: Values) -> Tensor:
        return values[self.name].of_rows(state, rows)


_FIRST_THRESHOLD = {name: _FirstThreshold(name) for name in CRITERIA}
