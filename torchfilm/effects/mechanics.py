"""Contact mechanics: growing cells push each other, and walls, apart in a viscous medium (the
paper's equations 1–4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import MECHANICS, Binding, BoundEffect, Concern, Effect, number_range
from torchfilm.physics.contact_records import (
    CLOSE,
    DEEP,
    PENALTY,
    TOLERANCE,
    CellProperties,
    ContactReport,
    ContactSettings,
    Moved,
)
from torchfilm.physics.contact_step import contact_step
from torchfilm.physics.initial_overlaps import check_apart
from torchfilm.physics.problem import CONVERGED, NOT_FINITE, STATUS, TOO_FAST
from torchfilm.physics.surfaces import Surface
from torchfilm.physics.walls import Wall
from torchfilm.resolver import Values, snapshot
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.ragged import offsets
from torchfilm.values import Rule, Value, checked, numbers, physical, quotient, smallest

MOST_SUBSTEPS = 1000
# A colony whose contacts do not hold has more than this share of its cells (of MANY, if it has
# fewer) deep in others for LONG steps. Cells that start in a heap part within a few steps.
BURIED, MANY, LONG = 0.1, 50, 20


@dataclass(frozen=True)
class MechanicsReport(ContactReport):
    """As `ContactReport`, with the `substeps` taken in each colony, (B,)."""

    substeps: Tensor
    counts: Tensor
    hint = "A smaller dt, a larger alpha or more max_iterations may help"

    def reason(self, place: int) -> str:
        """What went wrong in the colony at `place`."""
        status = int(self.status[place])
        if status == TOO_FAST:
            return (
                f"a cell would take more than {MOST_SUBSTEPS} sub-steps to grow as it should in one"
                " step (rates are per hour, and dt is in hours)"
            )
        return (
            f"the mechanics solve {STATUS[status]} after {int(self.iterations[place])} iterations,"
            f" residual {float(self.residual[place]):.2g}"
        )

    def concerns(self) -> tuple[Concern, ...]:
        """Colonies whose contacts do not hold cells apart, although each solve converges."""
        deep = self.deeply_overlapping > BURIED * self.counts.clamp(min=MANY)
        return (Concern("overlap", deep, LONG, partial(_collapsed, self)),)


def _collapsed(report: MechanicsReport, ids: Tensor, fallen: Tensor) -> str:
    each = zip(ids[fallen].tolist()[:5], report.deeply_overlapping[fallen].tolist(), strict=False)
    names = ", ".join(f"{colony} ({cells} cells)" for colony, cells in each)
    return (
        f"cells have been lying deeper in one another than a radius for {LONG} steps in colony"
        f" {names}. Contacts are too hard for this step (take a smaller dt or a larger alpha), or"
        " give way too much (take a smaller alpha)."
    )


@dataclass(frozen=True, eq=False)
class Mechanics(Effect):
    """Cells are capsules that push each other apart; their length is a degree of freedom, so
    pressure holds growth back.

    walls: what confines them. dim: 3, or 2 for strict 2-D (four degrees of freedom; nothing can
    leave the plane). viscosity: μ. length_drag: γ, resistance to a change of length, in units of
    μ·µm. A state field `drag` multiplies μ cell by cell. alpha: how far contacts give way to drag,
    the penalty's accuracy knob: α → 0 is the hard limit. Default 0.1/γ, the knee between overlap
    and cost; 1/γ is the paper's. Or stiffness: μ·µm/h, physical softness of cells: α =
    1/(stiffness·Δt), so that a smaller Δt converges to the motion of soft cells, where with α fixed
    it stiffens the contact. unilateral: contacts only push. False (default, the paper's least
    squares) also holds an overlapping pair that would part, until the next pass: measured, the
    overlap is the same or less, at half the CG iterations or fewer. passes: at most this many times
    a step contacts are found and solved. The first pass solves for every cell, each later one for
    the cells that the move left deeper than `overlap` or would have turned too far, among the
    others at rest. Default 1 in the plane; 2 in space, where cells that are squeezed can slip past
    each other; twice as many for unilateral contacts, since a push at one end may drive in the
    other; at least 6 for colonies that take sub-steps. overlap: µm; default a fifth of a cell's
    radius, or 0.02 for colonies that take sub-steps; where α γ is below 0.1 as much less.
    tolerance: of the solve, worst residual relative to the worst at rest; default 0.05, and where α
    γ is below 0.1, 0.05 · (α γ/0.1)^¼. max_iterations: CG iterations a solve. max_elongation: µm; a
    colony whose cells would grow more in a step takes sub-steps.
    """

    walls: Sequence[Wall] = ()
    dim: int = 3
    viscosity: Value = physical(1.0, unit="μ", above=0.0)
    length_drag: Value = physical(10.0, unit="μ·µm", above=0.0)
    alpha: Value | None = physical(None, above=0.0)
    stiffness: Value | None = physical(None, unit="μ·µm/h", above=0.0)
    unilateral: bool = False
    passes: int | None = None
    overlap: float | None = None
    tolerance: float | None = None
    max_iterations: int = 2000
    max_elongation: float = 0.25

    stage = MECHANICS
    title = "mechanics"
    may_repeat = False

    def __post_init__(self) -> None:
        checks.choice("Mechanics.dim", self.dim, (2, 3))
        super().__post_init__()
        if self.alpha is not None and self.stiffness is not None:
            raise checks.InputError(
                "Mechanics got alpha and stiffness: α = 1/(stiffness·Δt), so give one of the two."
            )
        if isinstance(self.walls, Wall):
            hint = f"Write walls=[{type(self.walls).__name__}(…)]."
            raise checks.input_error("Mechanics.walls", self.walls, "a list of walls", hint)
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
                raise checks.input_error(f"Mechanics.{name}", given, "an integer from 1")
        if self.tolerance is not None:
            checks.number("Mechanics.tolerance", self.tolerance, above=0.0, most=0.5)
        checks.number("Mechanics.max_elongation", self.max_elongation, above=0.0)
        if self.overlap is not None:
            checks.number("Mechanics.overlap", self.overlap, above=0.0)
        object.__setattr__(self, "walls", tuple(self.walls))
        self.surfaces()  # raises for a wall that does not fit the dimension
        self.physical_values()  # raises for a wall value that is not allowed

    def surfaces(self) -> list[Surface]:
        """What the walls are made of."""
        return [s for wall in self.walls for s in wall.surfaces(self.dim)]

    @property
    def soft_contacts(self) -> bool:
        return self.stiffness is not None

    def wall_surfaces(self) -> list[Surface]:
        return self.surfaces()

    @property
    def settings(self) -> ContactSettings:
        """How contacts are solved, defaults filled in."""
        return ContactSettings.resolve(
            self.dim,
            unilateral=self.unilateral,
            soft=self.stiffness is not None,
            passes=self.passes,
            overlap=self.overlap,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        found = self.physical_fields()
        for k, wall in enumerate(self.walls):
            for name, rule in (
                ("stiffness", Rule("μ·µm/h", above=0.0)),
                ("weight", Rule(above=0.0, most=1.0)),
            ):
                if getattr(wall, name) is not None:
                    label = f"{type(wall).__name__}.{name}"
                    found[f"walls[{k}].{name}"] = (checked(label, getattr(wall, name), rule), rule)
        return found

    def declares(self, dim: int) -> tuple[Field, ...]:
        meaning = (
            "move of the last first solve of a step or sub-step (Δc, Δθ, Δl), from which the next"
            " starts"
        )
        return (Field("displacement", meaning, "µm, rad, µm", shape=(self.settings.degrees,)),)

    def reads(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "radius", "elongation", "drag", "displacement")

    def writes(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "elongation", "displacement")

    def check(self, state: State, values: Values) -> None:
        if state.dim != self.dim:
            raise checks.input_error("Mechanics.dim", self.dim, f"{state.dim}, like the cells")
        for surface in self.surfaces():
            distance, _ = surface.gap_of_points(state.position, state.own_colony_id)
            behind = torch.nonzero(distance < 0).squeeze(1)
            if behind.numel():
                k = int(behind[0])
                raise checks.InputError(
                    f"{type(surface.wall).__name__}: cell {int(state.uid[k])} of colony"
                    f" {int(state.own_colony_id[k])} starts at"
                    f" {[round(x, 3) for x in state.position[k].tolist()]},"
                    f" {-float(distance[k]):.3g} µm behind it (cells behind it: {behind.numel()})."
                    " Is the wall inside out? Turn it (facing, normal, inside), or move the cells."
                )
        check_apart(
            state.position,
            state.axis,
            state.length,
            state.radius,
            state.colony,
            state.colony_id,
            state.uid,
        )

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        return (_BoundMechanics(self, binding),)

    # --- what explaining and tuning need -------------------------------------------------

    def numerics(self, dt: float, state: State) -> list[str]:
        settings, text = self.settings, number_range
        if self.stiffness is not None:
            alpha = 1.0 / (numbers(self.stiffness) * dt)
            kind = (
                f"soft, stiffness {text(numbers(self.stiffness))} μ·µm/h: α = 1/(stiffness·Δt) ="
                f" {text(alpha)}"
            )
        elif self.alpha is not None:
            kind = f"hard by a penalty, α = {text(numbers(self.alpha))}"
        else:
            kind = (
                f"hard by a penalty, α = {PENALTY:g}/γ ="
                f" {text(PENALTY / numbers(self.length_drag))} (default)"
            )
        holds = "bilateral, an overlapping pair is held until the next pass"
        mode = "unilateral, they only push" if self.unilateral else holds
        over = (
            ""
            if self.overlap is None
            else f", more than one only for new contacts and overlaps over {self.overlap:g} µm"
        )
        lines = [
            f"contacts: {mode}; {kind}",
            (
                f"passes: at most {settings.passes} a step{over}; a colony with a cell that grows"
                f" more than {self.max_elongation:g} µm takes sub-steps of up to"
                f" {settings.coarse_passes} passes"
            ),
            (
                "solver: conjugate gradients, each colony to a worst residual of"
                f" {self._tolerance()}, at most {self.max_iterations} iterations"
            ),
        ]
        soft = [
            wall for wall in self.walls if wall.stiffness is not None or wall.weight is not None
        ]
        if self.walls:
            lines.append(
                f"walls: {len(self.walls) - len(soft)} hard, {len(soft)} with a stiffness or weight"
            )
        return lines

    def _tolerance(self) -> str:
        if self.tolerance is not None:
            return f"{self.tolerance:g}"
        default = self.alpha is None and self.stiffness is None
        return (
            f"{TOLERANCE:g} (default"
            + ("" if default else f"; less where α·γ is below {PENALTY:g}")
            + ")"
        )

    def accuracy_knobs(self) -> Mapping[str, float]:
        usual = replace(self, passes=None).settings.passes
        penalty = {"penalty": PENALTY} if self.stiffness is None else {}
        return {"passes": usual, "tolerance": TOLERANCE, **penalty}

    def with_settings(self, settings: Any) -> Mechanics:
        changed: dict[str, Any] = {}
        if settings.tolerance is not None:
            changed["tolerance"] = settings.tolerance
        if settings.passes is not None:
            # who sets passes wants overlaps gone, and not only the deep ones; harder contacts leave
            # less of them
            close = CLOSE * min(1.0, self._penalty(settings) / PENALTY)
            changed |= {
                "passes": settings.passes,
                "overlap": close if self.overlap is None else self.overlap,
            }
        if settings.penalty is not None and self.stiffness is None:
            changed["alpha"] = quotient(settings.penalty, "Mechanics.length_drag", self.length_drag)
        return replace(self, **changed) if changed else self

    def _penalty(self, settings: Any) -> float:
        """α γ by these settings, the smallest of several; the usual one of soft cells."""
        if self.stiffness is not None:
            return PENALTY
        if settings.penalty is not None:
            return settings.penalty
        return PENALTY if self.alpha is None else smallest(self.alpha) * smallest(self.length_drag)


class _BoundMechanics(BoundEffect):
    """Mechanics with its walls on the batch's device and its settings resolved."""

    effect: Mechanics

    def __init__(self, effect: Mechanics, binding: Binding):
        super().__init__(effect, binding)
        self.settings = effect.settings
        walls = snapshot(effect.walls, "Mechanics.walls", binding.batch)
        # which of the walls each surface belongs to; a surface is made anew in each step, so that a
        # gradient to a wall's place passes through each of several backward passes
        self.walls = walls
        self.kinds = [
            (
                k,
                (
                    "stiffness"
                    if w.stiffness is not None
                    else "weight"
                    if w.weight is not None
                    else "hard"
                ),
            )
            for k, w in enumerate(walls)
        ]

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        elongation = state.fields.get("elongation", torch.zeros_like(state.length))
        steps, status = self._substeps(state, elongation)
        cells = self._properties(state, dt, steps)
        passes = torch.where(steps > 1, self.settings.coarse_passes, self.settings.passes)
        none = torch.zeros_like(state.counts)
        report = ContactReport(
            status, none, torch.zeros_like(none, dtype=state.dtype), none, none, none
        )
        clipped, reach = (
            torch.zeros_like(state.colony, dtype=torch.bool),
            torch.zeros_like(state.radius),
        )
        base = state.length - elongation
        at = Moved(state.position, state.axis, base, clipped, reach, state.displacement)
        share = elongation / steps.index_select(0, state.colony)
        for k in range(int(steps.max())):
            at, report = contact_step(
                cells, at, report, share, (k < steps) & (status == CONVERGED), passes
            )
        fields = {"displacement": at.first_move}
        if "elongation" in state.fields:
            fields["elongation"] = at.length - base
        made = MechanicsReport(**vars(report), substeps=steps, counts=state.counts)
        state = state.replace(position=at.position, axis=at.axis, length=at.length)
        return state.with_fields(**fields).replace(reports={**state.reports, "mechanics": made})

    @torch.no_grad()
    def _substeps(self, state: State, elongation: Tensor) -> tuple[Tensor, Tensor]:
        """How many sub-steps each colony takes, (B,), so that no cell grows by more than
        `max_elongation` in one; and the status (B,) of colonies that cannot be stepped."""
        every = torch.cat(
            [state.position, state.axis, state.length.unsqueeze(1), elongation.unsqueeze(1)], 1
        )
        broken = state.groups.any(~torch.isfinite(every).all(1))
        steps = torch.ceil(state.groups.max(elongation) / self.effect.max_elongation * (1 - 1e-6))
        status = torch.where(steps > MOST_SUBSTEPS, TOO_FAST, CONVERGED)
        status = torch.where(broken, NOT_FINITE, status)
        return torch.where(status == CONVERGED, steps.clamp(min=1), 1).long(), status

    def _properties(self, state: State, dt: float, steps: Tensor) -> CellProperties:
        """What the contact step needs of the cells."""
        values, cells = self.values, state.cells
        drag = state.fields.get("drag")
        viscosity = values.viscosity.of_cells(state) * (1.0 if drag is None else drag)
        length_drag = values.length_drag.of_cells(state)
        own_dt = dt / steps.index_select(0, state.colony).to(state.dtype)
        if values.stiffness is not None:
            alpha = 1.0 / (values.stiffness.of_cells(state) * own_dt)
        elif values.alpha is not None:
            alpha = values.alpha.of_cells(state).expand(cells)
        else:
            alpha = (PENALTY / length_drag).expand(cells)
        first = offsets(state.counts)[:-1].clamp(max=cells - 1)
        reference = state.position.detach().index_select(0, first).index_select(0, state.colony)
        surfaces, walls = [], []
        for wall, (k, kind) in zip(self.walls, self.kinds, strict=True):
            made = wall.surfaces(self.effect.dim)
            surfaces += made
            walls += [(kind, self._wall_value(state, k, kind, alpha, own_dt))] * len(made)
        return CellProperties(
            self.settings,
            state.radius,
            viscosity,
            length_drag,
            alpha,
            self._overlap(state, alpha, length_drag, steps),
            state.own_colony_id,
            reference,
            state.displacement,
            state.groups,
            surfaces,
            walls,
        )

    def _wall_value(
        self, state: State, k: int, kind: str, alpha: Tensor, own_dt: Tensor
    ) -> Tensor | None:
        """A wall's stiffness · α · Δt, or its weight, for each cell, (N,)."""
        if kind == "hard":
            return None
        value = self.values[f"walls[{k}].{kind}"].of_cells(state)
        return value * alpha * own_dt if kind == "stiffness" else value.expand(state.cells)

    @torch.no_grad()
    def _overlap(self, state: State, alpha: Tensor, length_drag: Tensor, steps: Tensor) -> Tensor:
        """How deep a contact of each cell may be left, (N,) µm."""
        if self.settings.overlap is not None:
            return torch.full_like(state.radius, self.settings.overlap)
        coarse = (steps > 1).index_select(0, state.colony)
        usual = torch.where(coarse, CLOSE, DEEP * state.radius)
        return usual * (alpha * length_drag / PENALTY).clamp(max=1.0)
