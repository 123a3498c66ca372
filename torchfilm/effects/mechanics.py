"""Contact mechanics: growing cells push each other, and walls, apart in a viscous medium (the
paper's equations 1–4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfilm.effect import MECHANICS, Effect, per_cell
from torchfilm.physics import capsule
from torchfilm.physics.contacts import (
    NEAR,
    CandidateContacts,
    Capsules,
    Contacts,
    contact_gaps,
    contacts_of,
)
from torchfilm.physics.jacobian import ContactJacobian
from torchfilm.physics.neighbours import Neighbourhood
from torchfilm.physics.problem import (
    CONVERGED,
    NOT_FINITE,
    STATUS,
    TOO_FAST,
    ContactProblem,
    SolveReport,
)
from torchfilm.physics.solve import solve_contacts
from torchfilm.physics.surfaces import Surface
from torchfilm.physics.wall_contacts import WallContacts, find_wall_contacts, share_to_walls
from torchfilm.physics.walls import Wall
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.ragged import offsets

# No cell turns by more than this in one solve, rad: beyond it the linearised contacts mean nothing.
# One that would is moved by a part of its move, and takes part in the next pass.
MAX_TURN = 0.5
# What a pass leaves overlapping by more than DEEP radii is solved again in the next one, among all
# the others at rest. It is a few cells in a hundred, which slip or turn; the others are as well off
# after one solve as contacts that give way let them be, and to solve for them again takes twice the
# time.
DEEP = 0.2
# Where a step is coarse, or passes are asked for by their number, it is looked at more closely: µm.
CLOSE = 0.02
# Tolerance of the solve at the default penalty α γ. Overlaps hardly feel it, growth under pressure
# does: at 0.2 a twentieth of what a colony grows is wrong, at 0.05 less than a hundredth. The
# harder contacts are, the farther from rest is what moves with none of them at the same residual: a
# tolerance that falls as (α γ)^¼ is enough from 0.1 down to 1e-6 (0.02 is needed at 0.01), and one
# that falls faster is out of reach of float32.
PENALTY, TOLERANCE = 0.1, 0.05
MOST_SUBSTEPS = 1000
COARSE_PASSES = 6


@dataclass(frozen=True)
class MechanicsReport:
    """What the last step's contact solves did, per colony (B,). `status` of the worst solve,
    `iterations` of CG in all, `residual` the worst true one; `passes` and `substeps` taken;
    `limited`: cells whose last move was cut, since it turned them further than MAX_TURN or took
    them through a wall; `buried`: cells that were deeper in another than a radius when the step, or
    its last sub-step, began (0 of soft cells, which may be)."""

    status: Tensor
    iterations: Tensor
    residual: Tensor
    passes: Tensor
    substeps: Tensor
    limited: Tensor
    buried: Tensor
    hint = "A smaller dt, a larger alpha or more max_iterations may help"

    def reason(self, place: int) -> str:
        """What went wrong in the colony at `place`."""
        status = int(self.status[place])
        if status == TOO_FAST:
            return (
                f"a cell would take more than {MOST_SUBSTEPS} sub-steps to grow as it wants to in"
                " one step (rates are per hour, and dt is in hours)"
            )
        return (
            f"the mechanics solve {STATUS[status]} after {int(self.iterations[place])} iterations,"
            f" residual {float(self.residual[place]):.2g}"
        )


@dataclass(frozen=True)
class Mechanics(Effect):
    """Cells are capsules that push each other apart; their length is a degree of freedom, so
    pressure holds growth back.

    walls: what confines them. dim: 3, or 2 for strict 2-D (four degrees of freedom; nothing can
    leave the plane). viscosity: μ. length_drag: γ, resistance to a change of length, in units of
    μ·µm. A state field `drag` multiplies μ cell by cell. alpha: how far contacts give way to drag,
    the penalty's accuracy knob: α → 0 is the hard limit. Default 0.1/γ, the knee between overlap
    and cost; 1/γ is the paper's. Or stiffness: μ·µm/h, physical softness of cells: α =
    1/(stiffness·Δt), so that a smaller Δt converges to the motion of soft cells, where with α fixed
    it stiffens the contact. Each may be one number or one per colony. unilateral: contacts only
    push. False (default, the paper's least squares) also holds an overlapping pair that wants to
    part, until the next pass: measured, the overlap is the same or less, at half the CG iterations
    or fewer. passes: at most this many times a step contacts are found and solved. The first solves
    for every cell, each later one for the cells that the move left deeper than `overlap` or would
    have turned too far, among the others at rest. Default 1 in the plane; 2 in space, where cells
    that are squeezed can slip past each other; twice as many for unilateral contacts, since a push
    at one end may drive in the other; 6 for colonies that take sub-steps. overlap: µm; default a
    fifth of a cell's radius, or 0.02 where `passes` is given and for colonies that take sub-steps;
    where α γ is below 0.1 as much less. tolerance: of the solve, worst residual relative to the
    worst at rest; default 0.05, and where α γ is below 0.1, 0.05 · (α γ/0.1)^¼. max_iterations: CG
    iterations a solve. max_elongation: µm; a colony whose cells want to grow more in a step takes
    sub-steps.
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
            object.__setattr__(
                self, name, checks.value(f"Mechanics.{name}", getattr(self, name), above=0.0)
            )
        if self.alpha is not None and self.stiffness is not None:
            raise checks.InputError(
                "Mechanics got alpha and stiffness: α = 1/(stiffness·Δt), so give one of the two."
            )
        for name in ("alpha", "stiffness"):
            if getattr(self, name) is not None:
                object.__setattr__(
                    self, name, checks.value(f"Mechanics.{name}", getattr(self, name), above=0.0)
                )
        if isinstance(self.walls, Wall):
            raise checks.input_error(
                "Mechanics.walls",
                self.walls,
                "a list of walls",
                f"Write walls=[{type(self.walls).__name__}(…)].",
            )
        for wall in self.walls:
            if not isinstance(wall, Wall):
                raise checks.input_error(
                    "Mechanics.walls", wall, "a list of Plane, Sphere, Box or Channel"
                )
        for name in ("passes", "max_iterations"):
            given = getattr(self, name)
            if (name, given) == ("passes", None):
                continue
            if not isinstance(given, int) or given < 1:
                raise checks.input_error(f"Mechanics.{name}", given, "a whole number from 1")
        if self.tolerance is not None:
            checks.number("Mechanics.tolerance", self.tolerance, above=0.0, most=0.5)
        checks.number("Mechanics.max_elongation", self.max_elongation, above=0.0)
        if self.overlap is not None:
            checks.number("Mechanics.overlap", self.overlap, above=0.0)
        object.__setattr__(self, "walls", tuple(self.walls))
        self.surfaces()  # raises for a wall that does not fit the dimension

    def surfaces(self) -> list[Surface]:
        """What the walls are made of; asked for anew each step, so that a gradient to a wall's
        place is too."""
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
                "displacement",
                "move of the last first solve of a step or sub-step (Δc, Δθ, Δl), from which the"
                " next starts",
                "µm, rad, µm",
                shape=(self.degrees,),
            ),
        )

    def reads(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "radius", "elongation", "drag", "displacement")

    def writes(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "elongation", "displacement")

    def check(self, state: State) -> None:
        if state.dim != self.dim:
            raise checks.input_error("Mechanics.dim", self.dim, f"{state.dim}, like the cells")
        for surface in self.surfaces():
            distance, _ = surface.gap_of_points(state.position, state.own_colony_id)
            beyond = torch.nonzero(distance < 0).squeeze(1)
            if beyond.numel():
                k = int(beyond[0])
                raise checks.InputError(
                    f"{type(surface.wall).__name__}: cell {int(state.uid[k])} of colony"
                    f" {int(state.own_colony_id[k])} starts at"
                    f" {[round(x, 3) for x in state.position[k].tolist()]},"
                    f" {-float(distance[k]):.3g} µm behind it (cells behind it: {beyond.numel()})."
                    " Is the wall inside out? Turn it (facing, normal, inside), or move the cells."
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
        return state.with_fields(**fields).replace(
            reports={**state.reports, "mechanics": run.report}
        )

    @torch.no_grad()
    def _plan(self, state: State, elongation: Tensor) -> tuple[Tensor, Tensor]:
        """How many sub-steps each colony takes, (B,), so that no cell grows by more than
        `max_elongation` in one; and which colonies cannot be stepped."""
        every = torch.cat(
            [state.position, state.axis, state.length.unsqueeze(1), elongation.unsqueeze(1)], 1
        )
        broken = state.groups.any(~torch.isfinite(every).all(1))
        steps = torch.ceil(state.groups.max(elongation) / self.max_elongation * (1 - 1e-6))
        status = torch.where(steps > MOST_SUBSTEPS, TOO_FAST, CONVERGED)
        status = torch.where(broken, NOT_FINITE, status)
        return torch.where(status == CONVERGED, steps.clamp(min=1), 1).long(), status


class _Run:
    """The moving parts of one step: geometry, and what is reported of each colony."""

    def __init__(
        self, settings: Mechanics, state: State, dt: float, substeps: Tensor, status: Tensor
    ):
        self.settings, self.state, self.surfaces = settings, state, settings.surfaces()
        self.position, self.axis, self.length = state.position, state.axis, state.length
        self.first_move = state.displacement
        count = state.colonies
        zero = torch.zeros(count, dtype=torch.int64, device=state.device)
        self.limited = zero
        # of the last move: which cells it was cut short for, (N,), and how far the surface of each
        # has come at the most, (N,) µm
        self.cut, self.moved = (
            torch.zeros_like(state.colony, dtype=torch.bool),
            torch.zeros_like(state.radius),
        )
        self.report = MechanicsReport(
            status,
            zero,
            torch.zeros(count, dtype=state.dtype, device=state.device),
            zero,
            substeps,
            zero,
            zero,
        )
        start = offsets(state.counts)[:-1].clamp(max=state.cells - 1)
        self.reference = (
            state.position.detach().index_select(0, start).index_select(0, state.colony)
        )
        drag_factor = state.fields.get("drag")
        self.viscosity = per_cell(settings.viscosity, state) * (
            1.0 if drag_factor is None else drag_factor
        )
        self.length_drag = per_cell(settings.length_drag, state)
        self.colony_ids = state.own_colony_id
        # dt of each cell's own sub-step, h
        self.dt = dt / substeps.index_select(0, state.colony).to(state.dtype)
        # a step that needs sub-steps is a coarse one: unless told otherwise, it is looked at more
        # closely
        coarse = substeps > 1
        self.passes = torch.where(
            coarse & (settings.passes is None), COARSE_PASSES, settings.most_passes
        )
        if settings.stiffness is not None:
            self.alpha = 1.0 / (per_cell(settings.stiffness, state) * self.dt)
        elif settings.alpha is not None:
            self.alpha = per_cell(settings.alpha, state).expand(state.cells)
        else:
            self.alpha = (PENALTY / self.length_drag).expand(state.cells)
        self.overlap = self._overlap(coarse.index_select(0, state.colony))
        # does a first pass, and does a later one, see what nearly touches? Rows that hold would
        # glue what growth takes apart, and soft cells
        self.sees_near = (
            settings.unilateral and settings.stiffness is None,
            settings.stiffness is None,
        )

    @torch.no_grad()
    def _overlap(self, coarse: Tensor) -> Tensor:
        """How deep a contact of each cell may be left, (N,) µm; coarse: (N,) bool, of a colony that
        takes sub-steps."""
        if self.settings.overlap is not None:
            return torch.full_like(self.state.radius, self.settings.overlap)
        usual = torch.where(
            coarse | (self.settings.passes is not None), CLOSE, DEEP * self.state.radius
        )
        return usual * (self.alpha * self.length_drag / PENALTY).clamp(max=1.0)

    def substep(self, base: Tensor, growth: Tensor, active: Tensor) -> None:
        """Grow by `growth` (N,) from `base` (N,), and pass over contacts, in the colonies that are
        active (B,) bool."""
        moving = active.index_select(0, self.state.colony)
        self.length, self.rigid = torch.where(moving, base + growth, base), growth.detach() <= 0
        for number in range(int(self.passes.max())):
            active = active & (number < self.passes)
            if not bool(active.any()):
                return
            if number == 0:
                pairs, walls = self._all_that_touches(active, self.sees_near[0])
                self._note_buried(pairs, active)
            else:
                pairs, walls, moving = self._left_deep(active, pairs)
                active = self.state.groups.any(moving)
                if not bool(active.any()):
                    return
            contacts = contacts_of(pairs, self.settings.unilateral, self.sees_near[number > 0])
            move, report = self._solve(contacts, walls, base, moving, number)
            self._move(move, base, moving, report, active)
            self.report = self._noted(report, active)
            if number == 0:
                self.first_move = torch.where(moving.unsqueeze(1), move.detach(), self.first_move)

    @torch.no_grad()
    def _note_buried(self, pairs: CandidateContacts, active: Tensor) -> None:
        if self.settings.stiffness is None:
            deep = torch.nonzero(pairs.gap < -0.5 * (pairs.a.radius + pairs.b.radius)).squeeze(1)
            cells = torch.zeros_like(self.state.radius)
            cells[
                torch.cat([pairs.first.index_select(0, deep), pairs.second.index_select(0, deep)])
            ] = 1.0
            found = self.state.groups.sum(cells.unsqueeze(1)).squeeze(1).long()
            self.report = replace(
                self.report, buried=torch.where(active, found, self.report.buried)
            )

    def _all_that_touches(
        self, active: Tensor, sees_near: bool
    ) -> tuple[CandidateContacts, WallContacts]:
        """In the colonies that are active, (B,) bool."""
        near, rows, bodies = self._neighbourhood(active, sees_near)
        first, second = (rows.index_select(0, side) for side in near.pairs())
        walls = self._at_walls(active.index_select(0, self.state.colony), sees_near)
        return CandidateContacts.among(bodies, first, second, sees_near), walls

    def _left_deep(
        self, active: Tensor, pairs: CandidateContacts
    ) -> tuple[CandidateContacts, WallContacts, Tensor]:
        """After a move, in the colonies that are active: the cells that take part in another pass,
        (N,) bool, those whose move was cut short, or left them too deep; and all that touches them.
        pairs: what touched before the move.

        Only there is it looked for: of two cells that did not touch, one must have moved by half of
        what may be left, and two that did must have come nearer by what was missing to it.
        """
        state, sees_near = self.state, self.sees_near[1]
        near, rows, bodies = self._neighbourhood(active, sees_near)
        of_active = active.index_select(0, state.colony)
        walls = self._at_walls(of_active, sees_near)
        with torch.no_grad():
            number = torch.full_like(state.colony, -1).index_copy(
                0, rows, torch.arange(rows.numel(), device=rows.device)
            )
            pairs_of = lambda cells: [
                rows.index_select(0, side) for side in near.pairs_of(number[cells])
            ]
            sum_of = lambda x, one, other: x.index_select(0, one) + x.index_select(0, other)
            far = (2 * self.moved > self.overlap) & of_active
            come = sum_of(self.moved, pairs.first, pairs.second) - pairs.gap > 0.5 * sum_of(
                self.overlap, pairs.first, pairs.second
            )
            come = torch.nonzero(come & of_active.index_select(0, pairs.first)).squeeze(1)
            first, second = pairs_of(far)
            left = self.cut & of_active
            # soft cells, and cells at a soft wall or one of little weight, are pressed as deep as
            # these let them
            if self.settings.stiffness is None:
                for one, other in (
                    (pairs.first.index_select(0, come), pairs.second.index_select(0, come)),
                    (first, second),
                ):
                    deep = torch.nonzero(
                        contact_gaps(bodies, one, other) < -0.5 * sum_of(self.overlap, one, other)
                    ).squeeze(1)
                    left[torch.cat([one.index_select(0, deep), other.index_select(0, deep)])] = True
            root, soft = self._wall_weights(walls)
            left[
                walls.cell[
                    ~soft & (root * root * walls.gap < -self.overlap.index_select(0, walls.cell))
                ]
            ] = True
            more = pairs_of(left & ~far)
            # the others are known by now
            new = torch.nonzero(~far.index_select(0, more[1])).squeeze(1)
            first, second = (
                torch.cat([a, b.index_select(0, new)])
                for a, b in zip((first, second), more, strict=True)
            )
            theirs = torch.nonzero(
                left.index_select(0, first) | left.index_select(0, second)
            ).squeeze(1)
        pairs = CandidateContacts.among(
            bodies, first.index_select(0, theirs), second.index_select(0, theirs), sees_near
        )
        return pairs, walls.take(torch.nonzero(left.index_select(0, walls.cell)).squeeze(1)), left

    def _neighbourhood(
        self, active: Tensor, sees_near: bool
    ) -> tuple[Neighbourhood, Tensor, Capsules]:
        """The cells of the colonies that are active (others cannot be stepped perhaps), which those
        are (M,), and every cell's body."""
        state = self.state
        local = (self.position - self.reference).to(state.dtype)
        bodies = Capsules(
            local.T.contiguous(), self.axis.T.contiguous(), 0.5 * self.length, state.radius
        )
        rows = torch.nonzero(active.index_select(0, state.colony)).squeeze(1)
        pick = lambda x: (
            x.detach() if rows.numel() == state.cells else x.detach().index_select(0, rows)
        )
        radius = pick(state.radius)
        margin = NEAR * radius if sees_near else 0.0
        near = Neighbourhood(
            pick(local),
            pick(self.axis),
            pick(self.length),
            radius,
            pick(state.colony),
            state.colonies,
            margin,
        )
        return near, rows, bodies

    def _at_walls(self, which: Tensor, sees_near: bool) -> WallContacts:
        """What touches walls among the cells that are marked, (N,) bool."""
        position, axis, length, radius, ids = (
            self.position,
            self.axis,
            self.length,
            self.state.radius,
            self.colony_ids,
        )
        if bool(which.all()):
            return find_wall_contacts(
                self.surfaces,
                position,
                axis,
                length,
                radius,
                ids,
                self.settings.unilateral,
                sees_near,
            )
        rows = torch.nonzero(which).squeeze(1)
        position, axis, length, radius, ids = (
            x.index_select(0, rows) for x in (position, axis, length, radius, ids)
        )
        found = find_wall_contacts(
            self.surfaces, position, axis, length, radius, ids, self.settings.unilateral, sees_near
        )
        return replace(found, cell=rows.index_select(0, found.cell))

    def _solve(
        self, contacts: Contacts, walls: WallContacts, base: Tensor, moving: Tensor, number: int
    ):
        """The move of the cells that are moving, (N, D), while the others stay where they are."""
        state, settings = self.state, self.settings
        across, turning, _ = capsule.drag(self.length, state.radius, self.viscosity)
        d, turns = state.dim, settings.degrees - state.dim - 1
        drag = [across] * d + [turning] * turns + [self.length_drag.expand(state.cells)]
        scale = torch.stack(drag, 1).rsqrt()
        root = contacts.weight.sqrt().unsqueeze(1)
        wall_root, wall_soft = self._wall_weights(walls)
        rows = ContactJacobian(
            contacts.first,
            contacts.second,
            contacts.row_first * scale.index_select(0, contacts.first) * root,
            contacts.row_second * scale.index_select(0, contacts.second) * root,
            walls.cell,
            walls.row * scale.index_select(0, walls.cell) * wall_root.unsqueeze(1),
            state.cells,
        )
        gap = torch.cat([contacts.gap * root.squeeze(1), walls.gap * wall_root])
        # a soft row's force acts once a step: later passes only correct it (hard rows are numerics,
        # each pass a closer limit)
        soft = torch.cat(
            [
                torch.full_like(contacts.first, settings.stiffness is not None, dtype=torch.bool),
                wall_soft,
            ]
        )
        held = torch.zeros_like(gap) if number == 0 else torch.where(soft, gap.clamp(max=0), 0.0)
        lower = (base - self.length) / scale[:, -1]
        problem = ContactProblem(
            rows,
            gap,
            held,
            self.alpha.unsqueeze(1).expand_as(scale).contiguous(),
            lower,
            scale,
            self.rigid,
            state.groups,
            settings.unilateral,
        )
        start = state.displacement if number == 0 else None
        if bool(moving.all()):
            return solve_contacts(problem, start, self._tolerance(), settings.max_iterations)
        move, report = solve_contacts(
            problem.among(moving),
            None if start is None else start[moving],
            self._tolerance(),
            settings.max_iterations,
        )
        return torch.zeros_like(scale).index_copy(0, torch.nonzero(moving).squeeze(1), move), report

    def _tolerance(self) -> Tensor:
        """Of the solve in each colony, (B,)."""
        if self.settings.tolerance is not None:
            return torch.full_like(self.report.residual, self.settings.tolerance)
        with torch.no_grad():
            hardest = -self.state.groups.max(-self.alpha * self.length_drag, empty=-PENALTY)
            return TOLERANCE * (hardest / PENALTY).clamp(max=1.0).sqrt().sqrt()

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

    def _move(
        self, move: Tensor, base: Tensor, moving: Tensor, report: SolveReport, active: Tensor
    ) -> None:
        """Carry the solve's move out for the cells that are moving, in part where a cell would turn
        too far, or go through a wall."""
        state, d = self.state, self.state.dim
        sound = (moving & (report.status != NOT_FINITE).index_select(0, state.colony)).unsqueeze(1)
        move = torch.where(sound, move, 0.0)
        reach, share = self._share(move.detach())
        self.cut, self.moved = share < 1, share * reach
        move = move * share.unsqueeze(1)
        limited = state.groups.sum(self.cut.to(state.dtype).unsqueeze(1)).squeeze(1).long()
        self.limited = torch.where(active, limited, self.limited)
        self.position = self.position + move[:, :d].to(self.position.dtype)
        self.axis = torch.where(sound, capsule.rotate(self.axis, move[:, d:-1]), self.axis)
        length = self.length + move[:, -1]
        # unlike a maximum, whole gradient at a tie
        self.length = torch.where(length >= base, length, base)

    @torch.no_grad()
    def _share(self, move: Tensor) -> tuple[Tensor, Tensor]:
        """How far the surface of each cell would come with the whole of its move, (N,) µm, and how
        much of it the cell makes, (N,): see MAX_TURN, and no farther than its radius behind a wall
        that it may not have touched before."""
        d, radius = self.state.dim, self.state.radius
        turn, way = (x.square().sum(1).sqrt() for x in (move[:, d:-1], move[:, :d]))
        share = (MAX_TURN / turn).clamp(max=1.0)
        reach = way + 0.5 * turn * self.length + 0.5 * move[:, -1].clamp(min=0.0)
        far = torch.nonzero(share * reach > radius).squeeze(1)
        if far.numel() and self.surfaces:
            pick = lambda x: x.index_select(0, far)
            position, axis, length, part = (
                pick(self.position),
                pick(self.axis),
                pick(self.length),
                pick(move) * pick(share).unsqueeze(1),
            )
            at = lambda s: (
                position + s * part[:, :d].to(position.dtype),
                capsule.rotate(axis, s * part[:, d:-1]),
                0.5 * (length + s * part[:, -1]),
            )
            share[far] *= share_to_walls(self.surfaces, at, pick(radius), pick(self.colony_ids))
        return reach, share

    def _noted(self, new: SolveReport, active: Tensor) -> MechanicsReport:
        old = self.report
        return MechanicsReport(
            torch.where(active, torch.maximum(old.status, new.status), old.status),
            old.iterations + torch.where(active, new.iterations, 0),
            torch.where(active, torch.maximum(old.residual, new.residual), old.residual),
            old.passes + active,
            old.substeps,
            self.limited,
            old.buried,
        )
