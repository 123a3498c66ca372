"""Steps of one-sided contacts in tensors: the reference, for gradients and for CUDA."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchfilm.kernels.scheme import (
    DEEP_AFTER_MANY,
    HOPS,
    LAG,
    LONG_MOVES,
    MANY_SUBSTEPS,
    MARGIN,
    MAX_TURN,
    MOST_HOPS,
    MOST_SOFTER,
    SHORTER,
    SHRINK,
    SLOWER,
    SLOWEST,
    SOFTER,
)
from torchfilm.physics import capsule, compiled_solve
from torchfilm.physics.adhesion import roots_of, wall_roots_of, with_bonds, with_wall_bonds
from torchfilm.physics.adjoint import attach_gradient
from torchfilm.physics.contacts import CandidateContacts, Capsules
from torchfilm.physics.hardness import Following, Limits
from torchfilm.physics.jacobian import ContactJacobian
from torchfilm.physics.near_rows import near_rows
from torchfilm.physics.one_sided_solve import Minimum, Solved, minimise
from torchfilm.physics.problem import CONVERGED, ITERATION_LIMIT, NOT_FINITE, ContactProblem
from torchfilm.physics.solve import warn_if_loose
from torchfilm.physics.space import near_pairs
from torchfilm.physics.step_records import StepInput, StepResult
from torchfilm.physics.wall_contacts import (
    WallContacts,
    find_wall_contacts,
    poses_along,
    reach_of,
    share_to_wall,
)
from torchfilm.tools.ragged import marked
from torchfilm.tools.reads import numbers, rows_where
from torchfilm.tools.vectors import nearest_to, safe_norm


def contact_steps(given: StepInput) -> StepResult:
    """Grow by given.growth and part what overlaps, in given.steps (B,) sub-steps."""
    steps = given.steps
    none = torch.zeros_like(steps)
    at = StepResult(
        given.position, given.axis, given.length, given.start, given.hardness,
        none, none, torch.zeros_like(given.hardness), none, none, none,
        torch.zeros_like(given.hardness),
    )  # fmt: skip
    growth = given.growth / steps.clamp(min=1).index_select(0, given.groups.owner)
    share = 1.0 / steps.double()
    if given.drift is not None:  # what cells have moved by themselves, in sub-steps as well
        at = _drifted(at, given, torch.where(steps > 1, -1.0, 0.0))
    for k in range(int(steps.max()) if steps.numel() else 0):
        if given.drift is not None:
            at = _drifted(at, given, torch.where((steps > 1) & (k < steps), share, 0.0))
        active = (k < steps) & (at.status != NOT_FINITE)
        last_of_many = (k + 1 == steps) & (steps >= MANY_SUBSTEPS)
        deep = torch.where(last_of_many, DEEP_AFTER_MANY, 1.0) * given.settings.too_deep
        at = _OneStep(given, at.length, growth, deep, active).taken(at)
    return at


def _drifted(at: StepResult, given: StepInput, share: Tensor) -> StepResult:
    """After this share (B,) of what the cells have moved and turned by themselves."""
    assert given.drift is not None
    own, dim = share.index_select(0, given.groups.owner).unsqueeze(1), given.settings.dim
    some = own != 0
    move = own * given.drift[:, :dim].to(at.position.dtype)
    turned = capsule.rotate(at.axis, own.to(at.axis.dtype) * given.drift[:, dim:])
    return replace(
        at,
        position=torch.where(some, at.position + move, at.position),
        axis=torch.where(some, turned, at.axis),
    )


class _OneStep:
    """One sub-step of the active colonies, (B,) bool, from cells of this length (N,); deep (B,)."""

    def __init__(
        self, given: StepInput, length: Tensor, growth: Tensor, deep: Tensor, active: Tensor
    ):
        self.given, self.groups, self.dim = given, given.groups, given.settings.dim
        self.growth, self.active = growth, active
        self.limits = Limits(given, length + growth, growth, deep)
        self.of_cells = lambda x: self.groups.spread(x).to(given.radius.dtype)

    def taken(self, at: StepResult) -> StepResult:
        """The result after this step."""
        given, active = self.given, self.active
        moving = active.index_select(0, self.groups.owner)
        (cells,) = rows_where(moving)
        if not cells.numel():
            return at
        rows, base = cells, at.length
        least = torch.maximum(base - SHRINK * self.growth.clamp(min=0.0), given.shortest)
        at = replace(at, length=torch.where(moving, base + self.growth, base))
        hardness = torch.where(at.hardness > 0, at.hardness, self.limits.softest)
        at = replace(at, hardness=hardness, alpha=torch.where(active, 0.0, at.alpha))
        for number in range(1 if given.settings.soft else int(given.settings.passes)):
            pairs, walls = self._contacts(at, rows, number == 0)
            gap = pairs.gap.detach()
            if number == 0 and not given.settings.soft:
                at = replace(at, deeply_overlapping=self._deeply(pairs, gap, active, at))
            if number > 0:
                moving = self._deep_cells(pairs, gap, walls, min(HOPS * number, MOST_HOPS))
                active = active & self.groups.any(moving)
                of_active = active.index_select(0, self.groups.owner)
                moving = moving & of_active
                cells, rows = rows_where(moving, of_active)
                if not cells.numel():
                    break
            at = self._pass(at, pairs, walls, moving, cells, active, least, number)
            active = active & (at.status != NOT_FINITE)
        return at

    # --- find ----------------------------------------------------------------------------------

    def _contacts(
        self, at: StepResult, rows: Tensor, first_pass: bool
    ) -> tuple[CandidateContacts, WallContacts]:
        """Pairs of the cells `rows` nearer than the margin, in float64, and which of them are
        nearer to walls than that and their last move."""
        given, owner = self.given, self.groups.owner
        first = self.groups.begin[:-1].clamp(max=owner.numel() - 1)
        start = given.position.detach().index_select(0, first)  # only for the size of numbers
        local, axis = at.position - start.index_select(0, owner), at.axis.double()
        length, radius = at.length.double(), given.radius.double()
        margin = MARGIN * self.limits.wide.index_select(0, owner)
        apart = at_walls = margin
        if given.bonds is not None:
            held = given.bonds.apart(given.drift, self.groups)
            apart, at_walls = (margin + x.index_select(0, owner) for x in held)
        pick = lambda x: x.detach().index_select(0, rows)
        space = given.settings.space
        near = near_pairs(
            pick(local), pick(axis), pick(length), pick(radius),
            pick(owner), self.groups.size, pick(apart), space,
        )  # fmt: skip
        first, second = (rows.index_select(0, side) for side in near)
        first, second = torch.minimum(first, second), torch.maximum(first, second)
        capsules = Capsules(local.T.contiguous(), axis.T.contiguous(), 0.5 * length, radius, space)
        found = CandidateContacts.all_of(capsules, first, second)
        last = at.move.detach()[:, : self.dim].double().square().sum(1).sqrt()
        reach = at_walls + last if first_pass else at_walls
        position, axis, length, radius, ids, reach = (
            x.index_select(0, rows)
            for x in (at.position, axis, length, radius, given.colony_ids, reach)
        )
        walls = find_wall_contacts(given.surfaces, position, axis, length, radius, ids, reach=reach)
        walls = replace(walls, cell=rows.index_select(0, walls.cell))
        return found.nearer_than(apart.index_select(0, first)), walls

    def _deeply(self, pairs, gap: Tensor, active: Tensor, at: StepResult) -> Tensor:
        """How many cells of each colony lie deeper in another than a radius, (B,)."""
        deep = gap < -0.5 * (pairs.a.radius + pairs.b.radius)
        both = torch.cat([pairs.first, pairs.second])
        mark = marked(self.given.radius.numel(), both, deep.repeat(2))
        found = self.groups.sum(mark.to(gap.dtype)).long()
        return torch.where(active, found, at.deeply_overlapping)

    def _deep_cells(self, pairs, gap: Tensor, walls: WallContacts, hops: int) -> Tensor:
        """The cells deep in others or in a hard wall, and those up to `hops` contacts from the
        former, (N,) bool."""
        count, owner = self.given.radius.numel(), self.groups.owner
        one = torch.cat([pairs.first, pairs.second])
        other = torch.cat([pairs.second, pairs.first])
        gap, deep = gap.repeat(2), self.limits.deep.index_select(0, owner.index_select(0, one))
        mark, near = marked(count, one, gap < -deep), gap < 0.1 * deep
        for _ in range(hops):
            mark = mark | marked(count, one, near & mark.index_select(0, other))
        root, soft = self._wall_roots(walls, torch.ones_like(self.given.radius))
        hard = ~soft & (root >= 1)  # a lighter wall is meant to give way
        limit = self.limits.deep.index_select(0, owner.index_select(0, walls.cell))
        return mark | marked(count, walls.cell, hard & (walls.gap.detach() < -limit))

    def _wall_roots(self, walls: WallContacts, alpha: Tensor) -> tuple[Tensor, Tensor]:
        """D of each wall row (W,), and whether the wall is soft, (W,) bool."""
        root = torch.ones_like(walls.gap)
        soft = torch.zeros_like(walls.cell, dtype=torch.bool)
        for number, (kind, value) in enumerate(self.given.walls):
            if value is None:
                continue
            here = walls.surface == number
            own = value.index_select(0, walls.cell)
            if kind == "stiffness":
                own = (own * alpha.index_select(0, walls.cell)).sqrt()
                soft = soft | here
            root = torch.where(here, own, root)
        return wall_roots_of(walls, root, soft, alpha)

    # --- solve and move ------------------------------------------------------------------------

    def _pass(self, at, pairs, walls, moving, cells, active, least, number: int) -> StepResult:
        """One solve of the moving cells, (N,) bool and their places, among the others at rest, and
        their moves."""
        given, settings, first_pass = self.given, self.given.settings, number == 0
        owner = self.groups.owner.index_select(0, pairs.first)
        margin = MARGIN * self.limits.wide.index_select(0, owner)
        contacts = near_rows(pairs, None if settings.soft else margin)
        if given.bonds is not None:
            half, begin = 0.5 * at.length.double(), given.bonds.begin.half
            half = torch.where(self.growth > 0, half, begin)  # the others are rigid
            now = Capsules(at.position.T, at.axis.double().T, half, given.radius)
            contacts = with_bonds(contacts, given.bonds, now)
            walls = with_wall_bonds(walls, given.bonds, now)
        follows = first_pass and given.alpha is None
        following = self._following(contacts, walls, cells) if follows else None
        solved = self._solved(at, contacts, walls, moving, cells, active, least, number, following)
        part, end = solved.problem, solved.end
        y = self._with_gradient(part, end)
        move = torch.zeros_like(at.move).index_copy(0, cells, y * part.scale)
        sound = (end.error < torch.inf) & active
        status = torch.where(end.error <= settings.tolerance, CONVERGED, ITERATION_LIMIT)
        status = torch.where(end.error < torch.inf, status, NOT_FINITE)
        if following is not None:
            after = part.gap_after(y) if y.requires_grad else end.after
            followed = following.alpha(solved.hardness, part, y, after)
            followed = torch.where(solved.fell, solved.hardness, followed)
            good = sound & (end.error <= settings.tolerance)
            some = good & (self.groups.counts > 0)
            used = torch.where(some, solved.hardness.detach(), at.alpha)
            at = replace(at, hardness=torch.where(good, followed, at.hardness), alpha=used)
        at = replace(
            at,
            status=torch.where(active, torch.maximum(at.status, status), at.status),
            iterations=at.iterations + torch.where(active, solved.spent, 0),
            error=torch.where(active, torch.maximum(at.error, end.error), at.error),
            passes=at.passes + active,
        )
        about = torch.zeros_like(move[:, : self.dim])
        if first_pass:  # without a push nothing moves
            pushes = part.of_rows.any(part.gap.detach() < 0).index_select(0, self.groups.owner)
            about = nearest_to(move[:, : self.dim].T, at.move[:, : self.dim].T).T
            about = torch.where(pushes.unsqueeze(1), about, 0.0)
        moving = moving & self.of_cells(sound).bool()
        return self._moved(at, move, about, moving, least, number)

    def _following(self, contacts, walls, cells) -> Following:
        """What α follows in a first pass, which moves all cells."""
        root, soft = self._wall_roots(walls, torch.ones_like(self.given.radius))
        hard = torch.cat([~contacts.beside, ~soft & (root >= 1)])
        radius = self.given.radius.double().index_select(0, cells)
        return Following(self.limits, hard, len(contacts.gap), radius, self.dim)

    def _solved(
        self, at, contacts, walls, moving, cells, active, least, number, following
    ) -> Solved:
        """Solve for the moving cells: with softer contacts where a solve does not converge, then
        harder again; and in a first pass again where the force has grown much."""
        given, settings, first_pass = self.given, self.given.settings, number == 0
        hardness, softer = at.hardness, torch.ones_like(at.hardness)
        spent, fell = torch.zeros_like(at.iterations), torch.zeros_like(active)
        again, rising, kept_alpha, goes_on = active, torch.ones_like(active), hardness, 1
        end: Minimum | None = None
        kept: Minimum | None = None
        while True:
            part = self._problem(at, contacts, walls, hardness * softer, softer, least, number)
            part = part if cells.numel() == moving.numel() else part.among(moving, cells)
            if end is not None and not goes_on:
                return Solved(part, end, hardness * softer, spent, fell)
            start = torch.zeros_like(part.scale)
            if first_pass:
                scale = part.scale.detach()
                last = at.move.detach().index_select(0, cells)
                start = torch.where(scale > 0, last / scale, 0.0)
            if end is not None:  # colonies whose contacts grow harder go on
                going_on = (~rising).index_select(0, part.colonies.owner).unsqueeze(1)
                start = torch.where(going_on, end.y, start)
            with torch.no_grad():
                solve = compiled_solve.minimise if settings.compiled else minimise
                limits = settings.tolerance, 2 * self.limits.target, settings.max_iterations
                found = solve(part.detached(), start, *limits)
                end = found if end is None else found.where(again, end, part)
                spent = spent + torch.where(again, end.iterations, 0)
                failed = again & (end.error > settings.tolerance) & (end.error < torch.inf)
                up = failed & rising & (softer < MOST_SOFTER)
                down = again & ~failed & (softer > 1)
                falls = failed & ~rising & (given.alpha is None)
                fell = fell | falls
                lags = again & ~failed & ~down & (end.error < torch.inf)
                if following is None:
                    lags = torch.zeros_like(lags)
                else:
                    wanted = following.alpha(hardness, part, end.y, end.after)
                    lags = lags & (wanted < LAG * hardness)
                end = end if kept is None else kept.where(falls, end, part)
                kept = end if kept is None else end.where(down | lags, kept, part)
            was, used = kept_alpha, hardness * softer
            kept_alpha = torch.where(down | lags, used, kept_alpha)
            again = up | down | lags
            goes_on, some_lag, falls_back = numbers(again.any(), lags.any(), falls.any())
            if not (goes_on or falls_back):
                return Solved(part, end, used, spent, fell)
            if following is not None and some_lag:
                y = self._with_gradient(part, end)
                after = part.gap_after(y) if y.requires_grad else end.after
                wanted = following.alpha(hardness, part, y, after)
                hardness = torch.where(lags, wanted, hardness)
            hardness = torch.where(falls, was, hardness)
            factor = torch.where(up, SOFTER, torch.where(down, 1.0 / SOFTER, 1.0))
            softer = torch.where(falls, 1.0, softer * factor)
            rising = rising & ~(down | lags)

    def _with_gradient(self, part: ContactProblem, end: Minimum) -> Tensor:
        """The minimum, as a function of what a gradient is required of."""
        if not (torch.is_grad_enabled() and part.tracked):
            return end.y
        settings, ids = self.given.settings, self.given.ids
        warn_if_loose(settings.tolerance)
        tolerance = torch.full_like(end.error, settings.tolerance).to(end.y.dtype)
        return attach_gradient(
            part, end, tolerance, settings.max_iterations, ids, settings.compiled
        )

    def _problem(self, at, contacts, walls, hardness, softer, least, number) -> ContactProblem:
        """The linear problem of one pass: α by colony, or the given one times `softer`, (B,)."""
        given, settings = self.given, self.given.settings
        alpha = self.of_cells(hardness)
        if given.alpha is not None:
            alpha = given.alpha * self.of_cells(softer)
        dtype = given.radius.dtype
        rigid = self.growth.detach() <= 0
        across, turning, _ = capsule.drag(at.length, given.radius, given.viscosity)
        turns = settings.degrees - settings.dim - 1
        length_drag = torch.where(rigid, torch.inf, given.length_drag)
        if number > LONG_MOVES:
            most = (SLOWEST * self.limits.softest / at.hardness).clamp(min=1.0)
            slower = self.of_cells(most.clamp(max=SLOWER ** (number - LONG_MOVES)))
            across, turning = slower * across, slower * turning
        drag = [across] * settings.dim + [turning] * turns + [length_drag]
        scale = torch.stack(drag, 1).rsqrt()
        root, pulls = roots_of(contacts, alpha)
        wall_root, soft = self._wall_roots(walls, alpha)
        half = lambda row, cell: (row * scale.double().index_select(0, cell)).to(dtype)
        rows = ContactJacobian(
            contacts.first,
            contacts.second,
            half(contacts.row_first * root, contacts.first),
            half(contacts.row_second * root, contacts.second),
            walls.cell,
            half(walls.row * wall_root.double().unsqueeze(1), walls.cell),
            at.length.shape[0],
        )
        gap = torch.cat([contacts.gap * root.squeeze(1), walls.gap * wall_root]).to(dtype)
        soft = torch.cat([pulls, soft])
        applied = torch.where(soft, gap.clamp(max=0), 0.0) if number > 0 else torch.zeros_like(gap)
        low = torch.where(
            rigid, 0.0, (least - at.length) * length_drag.sqrt().nan_to_num(posinf=0.0)
        ).clamp(max=0.0)
        alphas = alpha.unsqueeze(1).expand_as(scale).to(dtype).contiguous()
        return ContactProblem(rows, gap, applied, alphas, low, scale, rigid, self.groups)

    def _moved(self, at, move, about, moving, least, number: int) -> StepResult:
        """Carry out the moves (N, D) of the moving cells: the translation at most MARGIN radii from
        `about` (N, d), or less after many passes, the rotation as far at the ends; and a cell comes
        no deeper than its radius behind a hard wall."""
        shorter = SHORTER if number > LONG_MOVES else 1.0
        dim, bound = self.dim, self.of_cells(shorter * MARGIN * self.limits.wide)
        beyond = move[:, :dim] - about
        way, angle = safe_norm(beyond.T), safe_norm(move[:, dim:-1].T)
        most = (2.0 * bound / at.length.clamp(min=1e-9)).clamp(max=MAX_TURN)
        part, turn = (
            torch.where(x > limit, limit / torch.where(x > limit, x, 1.0), 1.0)
            for x, limit in ((way, bound), (angle, most))
        )
        step = about + part.unsqueeze(1) * beyond
        made = torch.cat([step, turn.unsqueeze(1) * move[:, dim:-1], move[:, -1:]], 1)
        share = self._share_to_hard_walls(at, made)
        clipped = moving & ((part < 1) | (turn < 1) | (share < 1))
        made = torch.where(moving.unsqueeze(1), share.unsqueeze(1) * made, 0.0)
        axis = torch.where(moving.unsqueeze(1), capsule.rotate(at.axis, made[:, dim:-1]), at.axis)
        length = at.length + made[:, -1]
        length = torch.where(length >= least, length, least)
        count = self.groups.sum(clipped.to(move.dtype)).long()
        some = self.groups.any(moving)
        return replace(
            at,
            position=at.position + made[:, :dim].to(at.position.dtype),
            axis=axis,
            length=torch.where(moving, length, at.length),
            move=torch.where(moving.unsqueeze(1), made, at.move) if number == 0 else at.move,
            clipped=torch.where(some, count, at.clipped),
        )

    def _share_to_hard_walls(self, at, made: Tensor) -> Tensor:
        """The share of each move (N, D) that no hard wall cuts off, (N,)."""
        given, share = self.given, torch.ones_like(self.given.radius)
        if not given.surfaces:
            return share
        reach = reach_of(at.length.detach(), made.detach())
        placed = poses_along(at.position, at.axis, at.length, made)
        for surface, (kind, weight) in zip(given.surfaces, given.walls, strict=True):
            if kind == "stiffness":
                continue
            cut = share_to_wall(surface, placed, given.radius, given.colony_ids, reach)
            cut = cut if weight is None else torch.where(weight >= 1, cut, 1.0)
            share = torch.minimum(share, cut)
        return share
