"""Contact mechanics of a batch: its walls on the device, its settings, and who computes."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfilm.effect import Binding, BoundEffect
from torchfilm.effects.mechanics_report import MechanicsReport
from torchfilm.physics import capsule, compiled, torch_step
from torchfilm.physics.adhesion import Bonds, holds_of, levels_of, most_of_limits
from torchfilm.physics.contacts import Capsules
from torchfilm.physics.one_sided_records import OneSidedSettings
from torchfilm.physics.problem import TOO_LONG, TOO_STICKY
from torchfilm.physics.space import PeriodicSpace
from torchfilm.physics.step_records import MechanicsInput
from torchfilm.physics.surfaces import Surface
from torchfilm.resolver import Resolved, snapshot
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.numba_calls import as_array
from torchfilm.tools.tangents import has_tangent, in_forward_mode
from torchfilm.tools.warn_once import warn
from torchfilm.values import is_drawn, numbers

if TYPE_CHECKING:
    from torchfilm.effects.mechanics import Mechanics

# The least tolerance of contact forces, in units of rounding. Below one unit solves in float32 were
# seen to report convergence while cells came to lie in one another.
FINEST = 8
# The most that strength · Δt / (viscosity · reach) of adhesion may be, µm; a reach above USUAL does
# not count. In growth to 128 cells solves failed from 1e6 on, and in motile colonies from 1e5 on;
# at a reach of 5 µm cells were pressed through others from 2e5 on.
STIFFEST, USUAL = 2.5e4, 0.1
# What a step reads, as far as derivatives may pass through it.
PARTS = ("position", "axis", "length", "radius")
FIELDS = ("elongation", "displacement", "contact_alpha", "compression", "drag")


class BoundMechanics(BoundEffect):
    """Mechanics with its walls on the batch's device and its settings resolved."""

    effect: Mechanics

    def __init__(self, effect: Mechanics, binding: Binding):
        super().__init__(effect, binding)
        self.compiled = effect.backend_on(binding.batch.device) == "compiled"
        self.settings = effect.settings
        if isinstance(self.settings, OneSidedSettings):
            self.settings = replace(self.settings, compiled=self.compiled)
        self._check_precision()
        # A surface is made in each step, so that a gradient to a wall's place passes through each
        # of several backward passes.
        self.walls = snapshot(effect.walls, "Mechanics.walls", binding.batch)
        self.kinds = [
            "stiffness" if w.stiffness is not None else "weight" if w.weight is not None else "hard"
            for w in self.walls
        ]
        surfaces = [s for wall in self.walls for s in wall.surfaces(effect.dim)]
        self.holds = holds_of(effect.adhesion, self.walls, effect.dim)
        entries = [tensor for surface in surfaces for tensor in _tensors(surface)]
        self.needs_gradient = self.values.requires_grad or any(x.requires_grad for x in entries)
        drawn = (v.field for v in vars(self.values).values() if v is not None)
        self.fields = (*FIELDS, *effect.needs(), *(name for name in drawn if name is not None))
        dtype, values = binding.batch.dtype, self.values
        self.drags = [_same(values[n], dtype) for n in ("viscosity", "length_drag")]
        follows = self.compiled and effect.alpha is None and effect.stiffness is None
        self.alphas = compiled.alpha_arrays(None, None, dtype) if follows else None
        self.space = effect.periodic_space
        self.drifts = False
        self.checked_dt: float | None = None  # h, of the last step whose adhesion was checked

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        self.drifts = any("drift" in effect.writes() for effect in effects)

    def check_given(self, state: State, free: Container[str]) -> None:
        # soft walls give way; a step in which cells grow manifold may leave one behind a hard one
        hard = (s for s in self.effect.surfaces() if s.wall.stiffness is None)
        if wrong := self.effect.behind(state, hard):
            warn(f"{wrong} Contacts push it back, and others aside.")

    def _check_precision(self) -> None:
        """Raise InputError for forces that are wanted more exactly than the states' numbers are."""
        wanted, dtype = self.settings.tolerance, self.binding.batch.dtype
        if not isinstance(self.settings, OneSidedSettings) or wanted is None:
            return
        if wanted < FINEST * torch.finfo(dtype).eps:
            raise checks.input_error(
                "Mechanics.tolerance",
                wanted,
                f"at least {FINEST * torch.finfo(dtype).eps:.1g} with {str(dtype)[6:]}, whose"
                " rounding is greater than such an error",
                "Leave it out, or take dtype=torch.float64.",
            )

    def check_step(self, dt: float, divides: bool) -> None:
        """Also raise InputError where contacts are so hard that drag, which selects among moves
        that part cells alike, is lost in rounding."""
        super().check_step(dt, divides)
        self._check_adhesion(dt)
        effect, dtype = self.effect, self.binding.batch.dtype
        name = "alpha" if effect.stiffness is None else "stiffness"
        given = getattr(effect, name)
        if given is None or is_drawn(given):
            return
        hardest = numbers(given)
        alpha = hardest.min() if name == "alpha" else 1.0 / (hardest.max() * dt)
        viscosity = 1.0 if is_drawn(effect.viscosity) else numbers(effect.viscosity).min()
        least = torch.finfo(dtype).eps / float(viscosity)
        if float(alpha) < least:
            most = 1.0 / (least * dt)
            bound = f"at least {least:.1g}" if name == "alpha" else f"at most {most:.1g}"
            raise checks.input_error(
                f"Mechanics.{name}",
                float(hardest.min() if name == "alpha" else hardest.max()),
                f"{bound} in steps of {dt:g} h with {str(dtype)[6:]}: drag would be lost in the"
                " rounding of such hard contacts",
                "Leave it out: by default contacts are as hard as they need be.",
            )

    def _strongest(self, dt: float) -> list[float]:
        """The strengths of the kinds of adhesion beyond which solves would not converge."""
        least = float(numbers(self.effect.viscosity).min())
        least = least if least > 0 else 1.0  # a distribution that goes down to 0
        most = STIFFEST * least / dt if dt > 0 else math.inf
        return [most * min(kind.reach, USUAL) for kind in self.effect.adhesion]

    def _check_adhesion(self, dt: float) -> None:
        """Raise InputError for bonds so stiff that solves would not converge."""
        if self.checked_dt == dt:
            return
        for kind, most in zip(self.effect.adhesion, self._strongest(dt), strict=True):
            strongest = float(numbers(kind.strength).max())
            if most < strongest < math.inf:
                raise checks.input_error(
                    "Adhesion.strength", strongest,
                    f"at most {most:.3g} μ·µm²/h with this reach, in steps of {dt:g} h: solves for"
                    " the contacts would not converge",
                    "No cell pulls so hard; a tenth of it holds as well.",
                )  # fmt: skip
        self.checked_dt = dt

    def _stuck(
        self, report: MechanicsReport, state: State, levels: Tensor, dt: float
    ) -> MechanicsReport:
        """The report, in which colonies fail whose cells stick together too strongly: by their
        levels, by strengths that were drawn, or by several kinds together. levels: of the step."""
        kinds = self.effect.adhesion
        if len(kinds) < 2 and not any(kind.levels or is_drawn(kind.strength) for kind in kinds):
            return report
        limits = [x / kind.reach for x, kind in zip(self._strongest(dt), kinds, strict=True)]
        share = most_of_limits(levels.detach(), self.holds, limits, state.groups)
        too_strong = ((share > 1.0) & (share < math.inf)).to(report.status.device)
        status = torch.where(too_strong, TOO_STICKY, report.status)
        return replace(report, status=status)

    def _fitting(
        self, report: MechanicsReport, state: State, length: Tensor, space: PeriodicSpace
    ) -> MechanicsReport:
        """The report, in which colonies fail that have a cell too long for their space. length:
        (N,) after growth."""
        radius = state.radius.detach().double()
        reach = self.effect.contact_reach(state)
        too_long = space.too_long(length.to(radius.device), radius, reach)
        failed = state.groups.any(too_long).to(report.status.device)
        return replace(report, status=torch.where(failed, TOO_LONG, report.status))

    @property
    def by_kernels(self) -> bool:
        return self.compiled

    def try_walls(self, state: State) -> None:
        """Raises what kernels would of walls of the user's own."""
        if self.compiled:
            compiled.wall_arrays(*self._surfaces(state), state.colony_id, state.cells)

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        self._check_adhesion(dt)
        if not self.derivatives_wanted(state) and self.compiled:
            length, growth = state.length, state.fields.get("elongation")
            growth = torch.zeros_like(length) if growth is None else growth
            dtype = state.radius.dtype
            return self.parted(state, dt, *(as_array(x, dtype) for x in (growth, length)))
        given = self._given(state, dt)
        found = torch_step.step(given)
        fields = {"displacement": found.move, "collapsed_steps": found.collapsed}
        if "elongation" in state.fields:
            fields["elongation"] = found.elongation
        if found.contact_alpha is not None and found.compression is not None:
            fields |= {"contact_alpha": found.contact_alpha, "compression": found.compression}
        position = found.position
        if self.space is not None:
            position = self.space.inside(position)
        left = state.with_fields(**fields).replace(
            position=position, axis=found.axis, length=found.length
        )
        report = MechanicsReport(**vars(found.report), substeps=found.substeps, dt=dt, left=left)
        if given.bonds is not None:
            report = self._stuck(report, state, given.bonds.levels, dt)
        if self.space is not None:
            report = self._fitting(report, state, state.length.detach(), self.space)
        return left.replace(reports={**state.reports, "mechanics": report})

    @torch.no_grad()
    def parted(self, state: State, dt: float, growth: np.ndarray, length: np.ndarray) -> State:
        """The state after a step by kernels, of at least one cell. length: (N,) µm after growth,
        and growth: (N,) µm in this step, of the type of its radii; its own do not count."""
        fields, one_sided, dtype = state.fields, self.effect.one_sided, state.radius.dtype
        axis, radius, move = (
            as_array(x, dtype) for x in (state.axis, state.radius, fields["displacement"])
        )
        alpha, compression = (
            compiled.array_or_none(fields[n] if one_sided else None, dtype)
            for n in ("contact_alpha", "compression")
        )
        cells = (
            as_array(state.position, torch.float64), axis, length, growth, radius, move,
            as_array(fields["collapsed_steps"], torch.int64), alpha, compression,
        )  # fmt: skip
        walls = compiled.wall_arrays(*self._surfaces(state), state.colony_id, state.cells)
        bonds = self._bond_arrays(state, length, growth)
        made, report, substeps = compiled.step(
            self.settings, state.groups, dt, self.effect.max_elongation, cells, self._drags(state),
            self._alphas(state), walls, bonds,
        )  # fmt: skip
        x, axes, lengths, moves, growths, fallen, *of_contacts = map(torch.from_numpy, made)
        new = {"displacement": moves, "collapsed_steps": fallen}
        if "elongation" in fields:
            new["elongation"] = growths
        if one_sided:
            found, new["compression"] = of_contacts
            given = self._given_alpha(state, dt, substeps)
            new["contact_alpha"] = found if given is None else given
        x = x if self.space is None else self.space.inside(x)
        left = state.with_fields(**new).replace(position=x, axis=axes, length=lengths)
        of_step = MechanicsReport(**vars(report), substeps=substeps, dt=dt, left=left)
        if self.effect.adhesion:
            assert bonds is not None
            of_step = self._stuck(of_step, state, torch.from_numpy(bonds[0]), dt)
        if self.space is not None:
            of_step = self._fitting(of_step, state, torch.from_numpy(length), self.space)
        return left.replace(reports={**state.reports, "mechanics": of_step})

    def derivatives_wanted(self, state: State) -> bool:
        """Whether gradients are required through the step. Raises InputError for forward mode."""
        if in_forward_mode():
            self._refuse_tangents(state)
        if not torch.is_grad_enabled():
            return False
        fields = state.fields
        return (
            self.needs_gradient
            or any(getattr(state, n).requires_grad for n in PARTS)
            or any(fields[n].requires_grad for n in self.fields if n in fields)
        )

    def _refuse_tangents(self, state: State) -> None:
        surfaces, walls = self._surfaces(state)
        given = [value for value in vars(self._given(state, 0.0)).values()]
        given += [value for _, value in walls] + [x for s in surfaces for x in _tensors(s)]
        bonds = self._bonds(state, state.length)
        given += [] if bonds is None else [bonds.levels]
        if has_tangent(*(x for x in given if isinstance(x, Tensor))):
            raise checks.InputError(
                "Mechanics: contacts have a backward pass and no forward mode. Use backward(), or"
                " recorded growth, which does not depend on what is differentiated."
            )

    def _drags(self, state: State) -> tuple[np.ndarray, ...]:
        """Viscosity and length drag, (N,) or (1,), and their factor (N,) or (0,)."""
        dtype = state.radius.dtype
        own = (
            compiled.array_or_none(self.values[n].of_cells(state), dtype) if x is None else x
            for n, x in zip(("viscosity", "length_drag"), self.drags, strict=True)
        )
        return *own, compiled.array_or_none(state.fields.get("drag"), dtype)

    def _alphas(self, state: State) -> tuple[int, np.ndarray]:
        if self.alphas is not None:
            return self.alphas
        alpha, stiffness = (
            None if value is None else value.of_cells(state)
            for value in (self.values.alpha, self.values.stiffness)
        )
        return compiled.alpha_arrays(alpha, stiffness, state.radius.dtype)

    def _given_alpha(self, state: State, dt: float, substeps: Tensor) -> Tensor | None:
        """The α of a step where it, or a stiffness, is given, (N,)."""
        alpha, stiffness = self.values.alpha, self.values.stiffness
        if stiffness is not None:
            own = dt / state.groups.spread(substeps.clamp(min=1)).to(state.radius.dtype)
            return 1.0 / (stiffness.of_cells(state) * own)
        return None if alpha is None else alpha.of_cells(state).expand(state.cells).clone()

    def _given(self, state: State, dt: float) -> MechanicsInput:
        fields, values = state.fields, self.values
        elongation = fields.get("elongation")
        elongation = torch.zeros_like(state.length) if elongation is None else elongation
        of_cells = lambda value: None if value is None else value.of_cells(state)
        surfaces, walls = self._surfaces(state)
        return MechanicsInput(
            self.settings, dt, self.effect.max_elongation, state.groups, state.position, state.axis,
            state.length, elongation, state.radius,
            fields["displacement"], fields["collapsed_steps"],
            fields["contact_alpha"] if self.effect.one_sided else None,
            fields["compression"] if self.effect.one_sided else None,
            values.viscosity.of_cells(state), values.length_drag.of_cells(state),
            fields.get("drag"), of_cells(values.alpha), of_cells(values.stiffness),
            state.colony_id, surfaces, walls,
            self._bonds(state, (state.length - elongation).detach()), self._drift(state),
        )  # fmt: skip

    def _bonds(self, state: State, base: Tensor) -> Bonds | None:
        """What holds cells together. base: (N,) µm, lengths before growth."""
        kinds = self.effect.adhesion
        if not kinds:
            return None
        strengths = [self.values[f"adhesion[{k}].strength"] for k in range(len(kinds))]
        levels = levels_of(kinds, [x.of_cells(state) for x in strengths], state.fields, state.cells)
        begin = _begin(state, base, self._drift(state))
        return Bonds(levels, tuple(kind.reach for kind in kinds), begin, self.holds)

    def _drift(self, state: State) -> Tensor | None:
        """How far cells have moved and turned by themselves in this step, (N, d + turns)."""
        return state.fields["drift"] if self.drifts else None

    def _bond_arrays(
        self, state: State, length: np.ndarray, growth: np.ndarray
    ) -> tuple[np.ndarray, ...] | None:
        """As `kernels.bonds` takes what is given."""
        if not (self.effect.adhesion or self.drifts):
            return None
        bonds, drift = self._bonds(state, torch.from_numpy(length - growth)), self._drift(state)
        levels, reaches, own, holds = compiled.NOTHING
        if bonds is not None:
            levels, reaches = as_array(bonds.levels, torch.float64), np.array(bonds.reaches)
            holds = np.array(bonds.holds)
        if drift is not None:
            own = as_array(drift, torch.float64)
        return levels, reaches, own, holds

    def _surfaces(self, state: State) -> tuple[list[Surface], list[tuple[str, Tensor | None]]]:
        """The surfaces of all walls; the kind of each, and its stiffness or weight, 0-dim or
        (N,)."""
        surfaces: list[Surface] = []
        walls: list[tuple[str, Tensor | None]] = []
        for k, (wall, kind) in enumerate(zip(self.walls, self.kinds, strict=True)):
            value = None if kind == "hard" else self.values[f"walls[{k}].{kind}"].of_cells(state)
            made = wall.surfaces(self.effect.dim)
            surfaces += made
            walls += [(kind, value)] * len(made)
        return surfaces, walls


@torch.no_grad()
def _begin(state: State, base: Tensor, drift: Tensor | None) -> Capsules:
    """The cells before they grew in this step and moved by themselves. base: (N,) µm, lengths
    before growth."""
    position, axis = state.position, state.axis
    if drift is not None:
        position = position - drift[:, : state.dim].to(position.dtype)
        axis = capsule.rotate(axis, -drift[:, state.dim :])
    half, radius = 0.5 * base.double(), state.radius.double()
    return Capsules(position.T, axis.double().T, half, radius, state.space)


def _tensors(surface: Surface) -> list[Tensor]:
    """The tensors that say where a surface is."""
    parts = (x if isinstance(x, tuple) else (x,) for x in vars(surface).values())
    return [x for part in parts for x in part if isinstance(x, Tensor)]


def _same(value: Resolved, dtype: torch.dtype) -> np.ndarray | None:
    """The one value that all cells have, (1,), or None."""
    same = value.value
    return None if same is None or same.dim() else compiled.array_or_none(same, dtype)
