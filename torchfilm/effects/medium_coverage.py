"""Checks that cells are on the grid of their medium, which may grow with its colony."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from weakref import ref

import torch
from torch import Tensor

from torchfilm.effect import DIVISION, GRID_COVERAGE, Binding, BoundEffect
from torchfilm.effects.medium_transport import Transport
from torchfilm.signals.exchange import spans
from torchfilm.signals.grid import Grid
from torchfilm.signals.space import MOST_VOXELS
from torchfilm.state import OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.reads import reads_are_free
from torchfilm.tools.warn_once import warn

if TYPE_CHECKING:
    from torchfilm.effects.medium import Medium

# Unless a margin is given, a growing grid grows by BLOCK voxels at a time, and keeps MARGIN voxels
# between the cells and its faces.
BLOCK, MARGIN = 8, 2


@dataclass(frozen=True)
class MediumReport:
    """Cells outside the medium, per colony. `status` (B,): 1 if there are any. `left` (B,): how
    many. `first` (B, 3): the position of one of them, µm."""

    status: Tensor
    left: Tensor
    first: Tensor
    hint = (
        "Make the box of the Medium larger (one that is flat is a single layer), let it grow with"
        " the colony, Medium(…, outside='grow'), remove cells that come within 2 µm of its end,"
        " tf.Removal(low, high) (in one step a cell may go further than its end), or move the"
        " obstacle. A box has at most"
        f" {MOST_VOXELS / 1e6:.0f} million voxels; a larger spacing needs fewer"
    )

    def reason(self, place: int) -> str:
        where = ", ".join(f"{x:.4g}" for x in self.first[place].tolist())
        return (
            f"{int(self.left[place])} cell(s) are beyond the box of the medium or inside an"
            f" obstacle, one at ({where}) µm"
        )


class MediumPart(BoundEffect):
    """A part of a bound medium."""

    effect: Medium

    def __init__(self, effect: Medium, binding: Binding, transport: Transport):
        super().__init__(effect, binding)
        self.transport = transport

    @property
    def by_kernels(self) -> bool:
        return self.transport.compiled

    def declares(self) -> list[Field]:
        return []

    def check(self, state: State) -> None:
        pass

    @torch.no_grad()
    def _look(self, state: State) -> MediumReport | None:
        """The report on cells outside the medium; None if such cells are allowed."""
        layout = state.layout
        if layout is None or (layout.reservoir is not None and layout.obstacle is None):
            return None
        left, first = layout.outside_medium(state.position_3d, state.groups)
        if reads_are_free(state.device) and not bool(left.any()):
            return MediumReport(left, left, state.position_3d.new_zeros(state.colonies, 3))
        place = torch.nn.functional.pad(state.position_3d, (0, 0, 0, 1))  # none: 0
        return MediumReport((left > 0).long(), left, place.index_select(0, first))

    def _looked(self, state: State) -> State:
        """The state with the report on cells outside the medium."""
        report = self._look(state)
        if report is None:
            return state
        return state.replace(reports={**state.reports, "medium": report})


class GridCoverage(MediumPart):
    """Checks before exchange that every cell is on its grid, and extends grids that may grow."""

    def __init__(self, effect: Medium, binding: Binding, transport: Transport):
        super().__init__(effect, binding, transport)
        self.stage, self.title = GRID_COVERAGE, "grid coverage"
        flat = [count == 1 for count in effect.voxels]  # a box of one layer stays one layer
        self.flat = torch.tensor(flat, device=binding.batch.device)
        self.fixed = torch.tensor(fixed_faces(effect.grows), device=binding.batch.device)
        self._seen: ref[Grid] | None = None  # the grid that was checked last
        transport.covered = self.ready

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        """Warn where the box would grow through a wall, or into a medium that is not known."""
        if self.effect.outside != "grow":
            return
        if any(getattr(e, "acts_without_cells", False) for e in effects):
            warn(
                "Medium(outside='grow'): new voxels have their first concentrations, though"
                " MediumReactions change those from the start also where no cell is. Begin with"
                " concentrations at which nothing reacts, or give a box that has room for the"
                " colony, with outside='error'."
            )
        surfaces = [s for e in effects for s in e.effect.wall_surfaces()]
        walls: dict[str, float] = {}
        low, high = (~self.fixed & ~self.flat).tolist()
        for sign, moves, face in zip("-+", (low, high), self.effect.box, strict=True):
            found = walls_at(surfaces, 1.0 if sign == "-" else -1.0, face, self.effect.spacing)
            walls |= {sign + "xyz"[k]: x for k, x in found if moves[k]}
        if walls:
            self._warn_of(walls, *(~self.fixed).tolist())

    def _warn_of(self, walls: Mapping[str, float], low: list[bool], high: list[bool]) -> None:
        """walls: where they are, by the faces of the box. low, high: which faces may move."""
        left = {
            a: "".join(s for s, moves in (("-", lo), ("+", hi)) if moves and s + a not in walls)
            for a, lo, hi in zip("xyz", low, high, strict=True)
        }
        grows = "".join("" if not s else a if s == "-+" else s + a for a, s in left.items())
        at = ", ".join(f"{face[1]} = {x:g} µm" for face, x in walls.items())
        hint = f"grows={grows!r}" if grows else "outside='error'"
        warn(
            f"Medium(outside='grow'): the box grows through the wall at {at}, with new medium"
            f" behind it, at its first concentration. Let the box end at the wall, with {hint}.",
            of="Medium.grows",
        )

    def reads(self) -> tuple[str, ...]:
        return ("position", *self.writes())

    def writes(self) -> tuple[str, ...]:
        return tuple(self.effect.writes()) if self.effect.outside == "grow" else ()

    def lay(self, state: State) -> State:
        return self.transport.lay(state)

    def ready(self, state: State) -> State:
        return self._grown(state, 0.0) if self.effect.outside == "grow" else state

    def opened(self, state: State) -> State:
        layout = state.layout
        if layout is not None and (self._seen is None or self._seen() is not layout.grid):
            self._check_grid(layout.grid)
            self._seen = ref(layout.grid)
        return self.transport.opened(state)

    def check(self, state: State) -> None:
        report = self._look(state)
        if report is not None and bool(report.status.any()):
            place = int(torch.nonzero(report.status)[0])
            colony = int(state.colony_id[place])
            low, high, _ = self.effect.corners
            raise checks.InputError(
                f"Medium.box, from {low} to {high} µm, is too small for colony {colony}:"
                f" {report.reason(place)}. {report.hint}."
            )

    def _check_grid(self, grid: Grid) -> None:
        """Raise InputError for the grid of a state that is not this medium's."""
        low, high, step = self.effect.corners
        same = tuple(grid.spacing) == tuple(step)
        if same and self.effect.outside != "grow":
            same = all(shape == self.effect.voxels for shape in grid.shapes)
            same = same and all(corner == list(low) for corner in grid.origin.tolist())
        if not same:
            begin = grid.origin[0].tolist()
            sides = zip(begin, grid.shapes[0], grid.spacing, strict=True)
            end = [x + count * side for x, count, side in sides]
            raise checks.InputError(
                f"Medium has voxels of {' × '.join(f'{h:g}' for h in step)} µm in the box {low} to"
                f" {high}, but the signals of this state are on another grid, of"
                f" {' × '.join(f'{h:g}' for h in grid.spacing)} µm in the box {begin} to {end}:"
                " give the box, spacing and depth that it was begun with."
            )

    def step(self, state: State, dt: float) -> State:
        if self.effect.outside == "grow":
            state = self._grown(state, dt)
        return self._looked(state)

    def numerics(self, dt: float, state: State) -> list[str]:
        return [self.effect.coverage]

    def summary(self) -> str:
        return "checks that every cell is on the grid of its colony"

    @torch.no_grad()
    def _span(self, state: State) -> tuple[Tensor, Tensor]:
        """The lower and upper corner of the box that the cells need, (B, 3) µm each."""
        layout = state.layout
        assert layout is not None
        low, high = spans(state.position_3d, state.groups)
        given, step = self.effect.margin, layout.grid.step
        margin = MARGIN * step if given is None else torch.full_like(step, given)
        margin = margin.masked_fill(self.flat, 0.0)
        low, high = low - margin, high + margin
        fixed_low, fixed_high = self.fixed
        return low.masked_fill(fixed_low, torch.inf), high.masked_fill(fixed_high, -torch.inf)

    def _grown(self, state: State, dt: float) -> State:
        layout = state.layout
        assert layout is not None
        low, high = self._span(state)
        if bool(((low >= layout.grid.origin) & (high <= layout.grid.high)).all()):
            return state
        # a colony that needs more voxels than allowed, or whose positions are not finite, keeps its
        # grid; cells that come to be outside are reported
        size = (
            (torch.maximum(high, layout.grid.high) - torch.minimum(low, layout.grid.origin))
            / layout.grid.step
        ).prod(1, keepdim=True)
        fits = size <= MOST_VOXELS
        low, high = torch.where(fits, low, torch.inf), torch.where(fits, high, -torch.inf)
        names = [OUTSIDE + name for name in self.effect.signals]
        here = [state.fields[n] for n in names]
        block = BLOCK if self.effect.margin is None else 1
        here_and_ones = [*here, torch.ones_like(here[0])]
        grid, values = layout.grid.extended(here_and_ones, low, high, block=block)
        if grid is layout.grid:
            return state
        state = state.replace(layout=layout.on(grid))
        old = values.pop() > 0
        first = [self.transport.without_cells(name, state, dt) for name in self.effect.signals]
        return state.with_fields(
            **{
                n: torch.where(old, v, start)
                for n, v, start in zip(names, values, first, strict=True)
            }
        )


def walls_at(
    surfaces: Sequence[Any], facing: float, corner: Sequence[float], spacing: Sequence[float]
) -> list[tuple[int, float]]:
    """The axes along which a box may grow through a flat wall from this corner, with the cells on
    the side `facing`, 1 or −1, and where the wall is, µm: up to a voxel inside, or a block outside.
    """
    found = []
    for surface in surfaces:
        normal = getattr(surface, "normal", None)
        if normal is None or isinstance(surface.offset, Tensor):
            continue
        for k, (x, voxel) in enumerate(zip(corner, spacing, strict=False)):
            # a vector of unit length
            if k < len(normal) and not isinstance(normal[k], Tensor) and normal[k] == facing:
                place = facing * surface.offset
                beyond = facing * (x - place) / voxel
                found += [(k, place)] if -1.0 <= beyond < BLOCK else []
    return found


def fixed_faces(grows: str) -> list[list[bool]]:
    """Of x, y and z whether the lower, and whether the higher face of a box stays: (2, 3)."""
    faces = re.findall("[+-]?[xyz]", grows)
    return [[not {axis, sign + axis} & {*faces} for axis in "xyz"] for sign in "-+"]


class DaughtersCoverage(MediumPart):
    """Checks that daughters are on their grid: their centres lie beside that of their parent."""

    def __init__(self, effect: Medium, binding: Binding, transport: Transport):
        super().__init__(effect, binding, transport)
        self.stage, self.title = DIVISION + 5, "coverage of daughters"

    def reads(self) -> tuple[str, ...]:
        return ("position",)

    def writes(self) -> tuple[str, ...]:
        return ()

    def step(self, state: State, dt: float) -> State:
        return self._looked(state) if state.births else state

    def numerics(self, dt: float, state: State) -> list[str]:
        return ["where cells have divided in the step"]

    def summary(self) -> str:
        return "checks that daughters are on the grid of their colony"
