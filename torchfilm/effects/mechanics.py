"""Contact mechanics: growing cells push each other, and walls, apart in a viscous medium (the paper's equations 1–4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.effect import MECHANICS, Effect, per_cell
from torchfilm.physics import capsule
from torchfilm.physics.contacts import Bodies, Contacts, find_contacts
from torchfilm.physics.neighbours import find_pairs
from torchfilm.physics.rows import ContactRows
from torchfilm.physics.solve import CONVERGED, NOT_FINITE, STATUS, TOO_FAST, ContactProblem, SolveReport, solve
from torchfilm.physics.walls import Surface, Wall, WallContacts, find_wall_contacts
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.ragged import offsets

# No cell turns by more than this in one solve, rad: beyond it the linearised contacts mean nothing. Where one would, the
# whole colony's move is shortened, since other cells counted on that turn, but not below LEAST_SHARE of it: one bad cell must
# not hold the rest for long. What still turns too far is cut, and counted.
MAX_TURN = 0.5
LEAST_SHARE = 0.5
# In a large colony in space some cell would always turn too far, and two shortened moves leave a quarter of every step's way
# to go: as overlap that turns more cells. While more than MOST_LEFT of a move is left, up to twice as many passes are taken.
MOST_LEFT = 0.2
# Tolerance of the solve at the default penalty α γ. Overlaps hardly feel it, growth under pressure does: at 0.2 a tenth of what a colony grows is wrong, at
# 0.05 a hundredth. The harder contacts are, the farther from rest is what moves with none of them at the same residual: a tolerance that falls as (α γ)^¼ is
# enough from 0.1 down to 1e-6 (0.02 is needed at 0.01), and one that falls faster is out of reach of float32.
PENALTY, TOLERANCE = 0.1, 0.05
MOST_SUBSTEPS = 1000
COARSE_PASSES, COARSE_OVERLAP = 6, 0.02


@dataclass(frozen=True)
class MechanicsReport:
    """What the last step's contact solves did, per colony (B,). `status` of the worst solve, `iterations` of CG in all, `residual` the
    worst true one; `passes` and `substeps` taken; `limited`: cells that the last pass kept from turning further, `share`: how much of the
    last pass's move was carried out (see MAX_TURN)."""

    status: Tensor
    iterations: Tensor
    residual: Tensor
    passes: Tensor
    substeps: Tensor
    limited: Tensor
    share: Tensor
    mend = "A smaller dt, a larger alpha or more max_iterations may help"

    def reason(self, place: int) -> str:
        """What went wrong in the colony at `place`."""
        status = int(self.status[place])
        if status == TOO_FAST:
            return f"a cell would take more than {MOST_SUBSTEPS} sub-steps to grow as it wants to in one step (rates are per hour, and dt is in hours)"
        return f"the mechanics solve {STATUS[status]} after {int(self.iterations[place])} iterations, residual {float(self.residual[place]):.2g}"


@dataclass(frozen=True)
class Mechanics(Effect):
    """Cells are capsules that push each other apart; their length is a degree of freedom, so pressure holds growth back.

    walls: what confines them. dim: 3, or 2 for strict 2-D (four degrees of freedom; nothing can leave the plane).
    viscosity: μ. length_drag: γ, resistance to a change of length, in units of μ·µm. A state field `drag` multiplies μ cell by cell.
    alpha: how far contacts give way to drag, the penalty's accuracy knob: α → 0 is the hard limit. Default 0.1/γ, the knee between
    overlap and cost; 1/γ is the paper's. Or stiffness: μ·µm/h, physical softness of cells: α = 1/(stiffness·Δt), so that a smaller Δt
    converges to the motion of soft cells, where with α fixed it stiffens the contact. Each may be one number or one per colony.
    unilateral: contacts only push. False (default, the paper's least squares) also holds an overlapping pair that wants to part, until
    the next pass: measured, the overlap is the same or less, at half the CG iterations or fewer.
    passes: at most this many times a step contacts are found and solved: again in colonies where the move made new contacts, or left an
    overlap deeper than `overlap` (µm), or was cut short. Default 1 in the plane; 2 in space, where cells that are squeezed can slip past each other,
    and up to 4 while the moves, cut short, leave more than a fifth of the way to go; twice as many for unilateral contacts, since a push at one
    end may drive in the other; 6, down to 0.02 µm, for colonies that take sub-steps.
    tolerance: of the solve, worst residual relative to the worst at rest; default 0.05, and where α γ is below 0.1, 0.05 · (α γ/0.1)^¼.
    max_iterations: CG iterations a solve.
    max_elongation: µm; a colony whose cells want to grow more in a step takes sub-steps.
    """

    walls: Sequence[Wall] = ()
    dim: int = 3
    viscosity: float | Tensor = 1.0
    length_drag: float | Tensor = 10.0
    alpha: float | Tensor | None = None
    stiffness: float | Tensor | None = None
    unilateral: bool = False
    passes: int | None = None
    overlap: float | None = None
    tolerance: float | None = None
    max_iterations: int = 2000
    max_elongation: float = 0.25

    stage = MECHANICS
    title = "mechanics"

    def __post_init__(self) -> None:
        checks.choice("Mechanics.dim", self.dim, (2, 3))
        for name in ("viscosity", "length_drag"):
            object.__setattr__(self, name, checks.value(f"Mechanics.{name}", getattr(self, name), above=0.0))
        if self.alpha is not None and self.stiffness is not None:
            raise checks.InputError("Mechanics got alpha and stiffness: α = 1/(stiffness·Δt), so give one of the two.")
        for name in ("alpha", "stiffness"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, checks.value(f"Mechanics.{name}", getattr(self, name), above=0.0))
        if isinstance(self.walls, Wall):
            raise checks.refuse("Mechanics.walls", self.walls, "a list of walls", f"Write walls=[{type(self.walls).__name__}(…)].")
        for wall in self.walls:
            if not isinstance(wall, Wall):
                raise checks.refuse("Mechanics.walls", wall, "a list of Plane, Sphere, Box or Channel")
        for name in ("passes", "max_iterations"):
            given = getattr(self, name)
            if (name, given) == ("passes", None):
                continue
            if not isinstance(given, int) or given < 1:
                raise checks.refuse(f"Mechanics.{name}", given, "a whole number from 1")
        if self.tolerance is not None:
            checks.number("Mechanics.tolerance", self.tolerance, above=0.0, most=0.5)
        checks.number("Mechanics.max_elongation", self.max_elongation, above=0.0)
        if self.overlap is not None:
            checks.number("Mechanics.overlap", self.overlap, above=0.0)
        object.__setattr__(self, "walls", tuple(self.walls))
        self.surfaces()  # raises for a wall that does not fit the dimension

    def surfaces(self) -> list[Surface]:
        """What the walls are made of; asked for anew each step, so that a gradient to a wall's place is too."""
        return [s for wall in self.walls for s in wall.surfaces(self.dim)]

    @property
    def degrees(self) -> int:
        """Degrees of freedom of a cell: 4 in strict 2-D, 7 in 3-D."""
        return 4 if self.dim == 2 else 7

    @property
    def most_passes(self) -> int:
        """`passes`, or its default for the dimension and the kind of contact."""
        return self.passes if self.passes is not None else self.usual_passes

    @property
    def usual_passes(self) -> int:
        """The default of `passes`."""
        return (self.dim - 1) * (2 if self.unilateral else 1)

    def declares(self, dim: int) -> tuple[Field, ...]:
        return (
            Field(
                "displacement", "move of the last first solve of a step or sub-step (Δc, Δθ, Δl), from which the next starts", "µm, rad, µm",
                shape=(self.degrees,),
            ),
        )  # fmt: skip

    def reads(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "radius", "elongation", "drag", "displacement")

    def writes(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "elongation", "displacement")

    def check(self, state: State) -> None:
        if state.dim != self.dim:
            raise checks.refuse("Mechanics.dim", self.dim, f"{state.dim}, like the cells")
        for surface in self.surfaces():
            distance, _ = surface.gap_of_points(state.position, state.own_colony_id)
            beyond = torch.nonzero(distance < 0).squeeze(1)
            if beyond.numel():
                k = int(beyond[0])
                raise checks.InputError(
                    f"{type(surface.wall).__name__}: cell {int(state.uid[k])} of colony {int(state.own_colony_id[k])} starts at "
                    f"{[round(x, 3) for x in state.position[k].tolist()]}, {-float(distance[k]):.3g} µm behind it (cells behind it: {beyond.numel()}). "
                    "Is the wall inside out? Turn it (facing, normal, inside), or move the cells."
                )

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        elongation = state.fields.get("elongation", torch.zeros_like(state.length))
        steps, status = self._plan(state, elongation)
        run = _Run(self, state, dt, steps, status)
        base = state.length - elongation
        share = elongation / steps.index_select(0, state.colony)
        for k in range(int(steps.max())):
            run.substep(base, share, (k < steps) & (status == CONVERGED))
            base = run.length
        fields = {"displacement": run.first_move}
        if "elongation" in state.fields:
            fields["elongation"] = run.length - (state.length - elongation)
        state = state.replace(position=run.position, axis=run.axis, length=run.length)
        return state.with_fields(**fields).replace(reports={**state.reports, "mechanics": run.report})

    @torch.no_grad()
    def _plan(self, state: State, elongation: Tensor) -> tuple[Tensor, Tensor]:
        """How many sub-steps each colony takes, (B,), so that no cell grows by more than `max_elongation` in one; and which colonies cannot be stepped."""
        every = torch.cat([state.position, state.axis, state.length.unsqueeze(1), elongation.unsqueeze(1)], 1)
        broken = state.groups.any(~torch.isfinite(every).all(1))
        steps = torch.ceil(state.groups.max(elongation) / self.max_elongation * (1 - 1e-6))
        status = torch.where(steps > MOST_SUBSTEPS, TOO_FAST, CONVERGED)
        status = torch.where(broken, NOT_FINITE, status)
        return torch.where(status == CONVERGED, steps.clamp(min=1), 1).long(), status


class _Run:
    """The moving parts of one step: geometry, and what is reported of each colony."""

    def __init__(self, settings: Mechanics, state: State, dt: float, substeps: Tensor, status: Tensor):
        self.settings, self.state, self.surfaces = settings, state, settings.surfaces()
        self.position, self.axis, self.length = state.position, state.axis, state.length
        self.first_move = state.displacement
        count = state.colonies
        zero = torch.zeros(count, dtype=torch.int64, device=state.device)
        self.limited = zero
        self.share = self.left = torch.ones(count, dtype=state.dtype, device=state.device)
        self.report = MechanicsReport(status, zero, torch.zeros(count, dtype=state.dtype, device=state.device), zero, substeps, zero, self.share)
        start = offsets(state.counts)[:-1].clamp(max=state.cells - 1)
        self.reference = state.position.detach().index_select(0, start).index_select(0, state.colony)
        drag_factor = state.fields.get("drag")
        self.viscosity = per_cell(settings.viscosity, state) * (1.0 if drag_factor is None else drag_factor)
        self.length_drag = per_cell(settings.length_drag, state)
        self.colony_ids = state.own_colony_id
        # dt of each cell's own sub-step, h
        self.dt = dt / substeps.index_select(0, state.colony).to(state.dtype)
        # a step that needs sub-steps is a coarse one: unless told otherwise, it is looked at more closely
        coarse = substeps > 1
        self.passes = torch.where(coarse & (settings.passes is None), COARSE_PASSES, settings.most_passes)
        self.most_passes = torch.where(~coarse & (settings.passes is None) & (state.dim == 3), 2 * self.passes, self.passes)
        limit = torch.full_like(self.report.residual, torch.inf if settings.overlap is None else settings.overlap)
        self.overlap = torch.where(coarse & (settings.overlap is None), COARSE_OVERLAP, limit).index_select(0, state.colony)
        if settings.stiffness is not None:
            self.alpha = 1.0 / (per_cell(settings.stiffness, state) * self.dt)
        elif settings.alpha is not None:
            self.alpha = per_cell(settings.alpha, state).expand(state.cells)
        else:
            self.alpha = (PENALTY / self.length_drag).expand(state.cells)

    def substep(self, base: Tensor, growth: Tensor, active: Tensor) -> None:
        """Grow by `growth` (N,) from `base` (N,), and pass over contacts, in the colonies that are active (B,) bool."""
        moving = active.index_select(0, self.state.colony)
        self.length = torch.where(moving, base + growth, base)
        seen: Tensor | None = None
        self.left = torch.ones_like(self.share)
        for number in range(int(self.most_passes.max())):
            active = active & ((number < self.passes) | (number < self.most_passes) & (self.left > MOST_LEFT))
            if not bool(active.any()):
                return
            contacts, walls = self._detect(active)
            if seen is not None:
                active = active & self._again(contacts, walls, seen)
                if not bool(active.any()):
                    return
            moving = active.index_select(0, self.state.colony)
            contacts, walls = _only(contacts, walls, moving)
            move, report = self._solve(contacts, walls, base, moving, number)
            self._move(move, base, moving, report, active)
            seen = self._keys(contacts) if number + 1 < int(self.most_passes.max()) else None
            self.report = self._noted(report, active)
            if number == 0:
                self.first_move = torch.where(moving.unsqueeze(1), move.detach(), self.first_move)

    def _detect(self, active: Tensor) -> tuple[Contacts, WallContacts]:
        """All contacts of the present geometry; those of colonies that cannot be stepped are of no use to anyone and are left out."""
        state = self.state
        local = (self.position - self.reference).to(state.dtype)
        with torch.no_grad():
            axis, length, radius, colony = self.axis, self.length, state.radius, state.colony
            if bool(active.all()):
                first, second = find_pairs(local, axis, length, radius, colony, state.colonies)
            else:
                rows = torch.nonzero(active.index_select(0, colony)).squeeze(1)
                pick = lambda x: x.index_select(0, rows)  # noqa: E731
                found = find_pairs(pick(local), pick(axis), pick(length), pick(radius), pick(colony), state.colonies)
                first, second = rows.index_select(0, found[0]), rows.index_select(0, found[1])
        bodies = Bodies(local.T.contiguous(), self.axis.T.contiguous(), 0.5 * self.length, state.radius)
        contacts = find_contacts(bodies, first, second, whole_lines=self.settings.unilateral)
        walls = find_wall_contacts(self.surfaces, self.position, self.axis, self.length, state.radius, self.colony_ids)
        return contacts, walls

    def _keys(self, contacts: Contacts) -> Tensor:
        low, high = torch.minimum(contacts.first, contacts.second), torch.maximum(contacts.first, contacts.second)
        return (low * self.state.cells + high) * 9 + contacts.where

    def _again(self, contacts: Contacts, walls: WallContacts, seen: Tensor) -> Tensor:
        """Which colonies need another pass, (B,): a new contact that overlaps, an overlap over the limit, or a move cut short."""
        groups, colony = self.state.groups, self.state.colony
        if bool((self.share < 1).all()):
            return self.share < 1
        new = ~torch.isin(self._keys(contacts), seen) & (contacts.gap < 0)
        again = torch.zeros_like(colony, dtype=torch.bool)
        again[contacts.first[new]] = True
        again[contacts.first[contacts.gap < -self.overlap.index_select(0, contacts.first)]] = True
        again[walls.cell[walls.gap < -self.overlap.index_select(0, walls.cell)]] = True
        return groups.any(again) | (self.share < 1)

    def _solve(self, contacts: Contacts, walls: WallContacts, base: Tensor, moving: Tensor, number: int):
        state, settings = self.state, self.settings
        across, turning, _ = capsule.drag(self.length, state.radius, self.viscosity)
        d, turns = state.dim, settings.degrees - state.dim - 1
        drag = [across] * d + [turning] * turns + [self.length_drag.expand(state.cells)]
        scale = torch.stack(drag, 1).rsqrt()
        root = contacts.weight.sqrt().unsqueeze(1)
        wall_root, wall_soft = self._wall_weights(walls)
        rows = ContactRows(
            contacts.first, contacts.second,
            contacts.row_first * scale.index_select(0, contacts.first) * root,
            contacts.row_second * scale.index_select(0, contacts.second) * root,
            walls.cell, walls.row * scale.index_select(0, walls.cell) * wall_root.unsqueeze(1), state.cells,
        )  # fmt: skip
        gap = torch.cat([contacts.gap * root.squeeze(1), walls.gap * wall_root])
        # a soft row's force acts once a step: later passes only correct it (hard rows are numerics, each pass a closer limit)
        soft = torch.cat([torch.full_like(contacts.first, settings.stiffness is not None, dtype=torch.bool), wall_soft])
        held = torch.zeros_like(gap) if number == 0 else torch.where(soft, gap.clamp(max=0), 0.0)
        lower = (base - self.length) / scale[:, -1]
        problem = ContactProblem(rows, gap, held, self.alpha.unsqueeze(1), lower, scale, state.groups, settings.unilateral)
        start = state.displacement if number == 0 else None
        return solve(problem, start, self._tolerance(), settings.max_iterations)

    def _tolerance(self) -> Tensor:
        """Of the solve in each colony, (B,)."""
        if self.settings.tolerance is not None:
            return torch.full_like(self.share, self.settings.tolerance)
        with torch.no_grad():
            hardest = -self.state.groups.max(-self.alpha * self.length_drag, empty=-PENALTY)
            return TOLERANCE * (hardest / PENALTY).clamp(max=1.0).sqrt().sqrt()

    def _turn(self, move: Tensor) -> Tensor:
        """How far each cell turns, (N,) rad."""
        turns = move[:, self.state.dim : -1].detach()
        return (turns * turns).sum(1).sqrt()

    def _wall_weights(self, walls: WallContacts) -> tuple[Tensor, Tensor]:
        """D of each wall row (W,), and whether the wall is soft, (W,) bool."""
        root = torch.ones_like(walls.gap)
        soft = torch.zeros_like(walls.cell, dtype=torch.bool)
        for number, surface in enumerate(self.surfaces):
            here = walls.surface == number
            if surface.wall.stiffness is not None:
                stiffness = per_cell(surface.wall.stiffness, self.state) * self.alpha * self.dt
                root = torch.where(here, stiffness.index_select(0, walls.cell).sqrt(), root)
                soft = soft | here
            elif surface.wall.weight is not None:
                weight = per_cell(surface.wall.weight, self.state).expand(self.state.cells)
                root = torch.where(here, weight.index_select(0, walls.cell), root)
        return root, soft

    def _move(self, move: Tensor, base: Tensor, moving: Tensor, report: SolveReport, active: Tensor) -> None:
        """Carry the solve's move out in the colonies that are moving, shortened where a cell would turn too far."""
        state, d = self.state, self.state.dim
        sound = (moving & (report.status != NOT_FINITE).index_select(0, state.colony)).unsqueeze(1)
        move = torch.where(sound, move, 0.0)
        share = (MAX_TURN / state.groups.max(self._turn(move))).clamp(min=LEAST_SHARE, max=1.0)
        move = move * share.index_select(0, state.colony).unsqueeze(1)
        turn = self._turn(move).unsqueeze(1)
        too_far = turn > MAX_TURN * (1 + 1e-5)
        cut = torch.where(too_far, MAX_TURN / turn, 1.0)
        self.share = torch.where(active, share, self.share)
        self.left = torch.where(active, self.left * (1 - share), self.left)
        self.limited = torch.where(active, state.groups.sum(too_far.to(state.dtype)).squeeze(1).long(), self.limited)
        self.position = self.position + move[:, :d].to(self.position.dtype)
        self.axis = torch.where(sound, capsule.rotate(self.axis, move[:, d:-1] * cut), self.axis)
        length = self.length + move[:, -1]
        self.length = torch.where(length >= base, length, base)  # unlike a maximum, whole gradient at a tie

    def _noted(self, new: SolveReport, active: Tensor) -> MechanicsReport:
        old = self.report
        return MechanicsReport(
            torch.where(active, torch.maximum(old.status, new.status), old.status),
            old.iterations + torch.where(active, new.iterations, 0),
            torch.where(active, torch.maximum(old.residual, new.residual), old.residual),
            old.passes + active, old.substeps, self.limited, self.share,
        )  # fmt: skip


def _only(contacts: Contacts, walls: WallContacts, cells: Tensor) -> tuple[Contacts, WallContacts]:
    """The rows whose cells are marked, (N,) bool."""
    if bool(cells.all()):
        return contacts, walls
    keep = torch.nonzero(cells.index_select(0, contacts.first)).squeeze(1)
    keep_wall = torch.nonzero(cells.index_select(0, walls.cell)).squeeze(1)
    return contacts.take(keep), walls.take(keep_wall)
