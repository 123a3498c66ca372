"""Contact mechanics: growing cells push each other, and walls, apart in a viscous medium (the
paper's equations 1–4)."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchfilm.effect import MECHANICS, Binding, BoundEffect, Effect
from torchfilm.effects.bound_mechanics import BoundMechanics
from torchfilm.effects.mechanics_words import numerics_in_words
from torchfilm.kernels.bilateral_scheme import CLOSE, PENALTY, TOLERANCE
from torchfilm.kernels.scheme import MARGIN, OVERLAP, PASSES
from torchfilm.kernels.scheme import TOLERANCE as FORCE_TOLERANCE
from torchfilm.parameters import number_range
from torchfilm.physics.adhesion import Adhesion, check_walls_of
from torchfilm.physics.contact_records import ContactSettings
from torchfilm.physics.initial_overlaps import (
    check_apart,
    check_between_planes,
    check_fits,
    check_turned,
)
from torchfilm.physics.one_sided_records import OneSidedSettings
from torchfilm.physics.space import PeriodicSpace, check_first_cells, check_walls_in
from torchfilm.physics.surfaces import Surface
from torchfilm.physics.walls import Wall
from torchfilm.resolver import Values
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.backends import check_backend, why_torch
from torchfilm.tools.row_checks import check_variables
from torchfilm.values import (
    ByType,
    Distribution,
    Rule,
    Value,
    checked,
    numbers,
    physical,
    quotient,
    smallest,
)

# The default length drag: free growth, but for bilateral contacts, which do not hold in it.
LENGTH_DRAG = {"one-sided": 1e5, "bilateral": 10.0}
# From this length drag on, pressure hardly slows growth, and the time of a step grows as the number
# of cells to the power 1.65 (docs/performance.md); below, about in proportion to it.
FREE, CROWDING = 1000.0, 0.65
CONTACTS = ("one-sided", "bilateral")
# Accuracy settings state a worst residual; one-sided solves, whose tolerance is the error of
# forces, are about as accurate at so many times that.
OF_FORCES = 1.4
OF_WALLS = {"stiffness": Rule("μ·µm/h", above=0.0), "weight": Rule(above=0.0, most=1.0)}
OF_ADHESION = {"strength": Rule("μ·µm²/h", least=0.0)}


@dataclass(frozen=True, eq=False)
class Mechanics(Effect):
    """Cells are capsules that push each other apart; their length is a degree of freedom, so
    pressure may hold growth back.

    walls: what confines them. periodic: the faces of axes along which space is periodic, µm, such
    as {"x": (0, 40)}: what is pushed out at one face comes in at the other, and cells push each
    other across. Cells with their caps, and with what contacts reach, must stay shorter than half
    of the way; only one-sided contacts have it.
    dim: 3, or 2 for strict 2-D (four degrees of freedom; nothing can leave the plane).

    viscosity: μ. length_drag: γ, resistance to a change of length, in the unit of μ × µm; it does
    not follow `viscosity`. A state field `drag` multiplies μ cell by cell. With the default, 1e5,
    colonies grow at their free rate up to ten thousand cells; with 10, the paper's and the default
    of bilateral contacts, pressure slows them from a hundred cells on.

    contacts: "one-sided" (default), which only push, or "bilateral", the paper's least squares,
    which also hold an overlapping pair that would part. One-sided contacts hold at any drag;
    bilateral ones at a length drag of about 10, where they take fewer iterations.

    alpha: how far contacts give way to drag. Default: one-sided contacts follow their force, so
    that the mean overlap (of all, and of those between cells) is contact_overlap (0.014 radii);
    bilateral ones take 0.1/γ; 1/γ is the paper's. Or stiffness: μ·µm/h, physical softness of cells:
    α = 1/(stiffness·Δt), so that a smaller Δt converges to the motion of soft cells. Both are one
    number, or one per colony.

    passes: at most this many a step; later ones move only the cells deeper than `overlap`, µm, and,
    if contacts are one-sided, those near them (default 0.2 radii, or up to a radius ten times
    contact_overlap, 24 passes, 1 for soft cells; bilateral: 0.2 radii or less, 1 pass in the plane
    and 2 in space, 6 with sub-steps). A smaller `overlap` takes off growth under pressure; a
    smaller `contact_overlap` does not. tolerance: of a solve. One-sided: relative error of the
    contact forces, default 0.07. Bilateral: worst residual relative to that at rest, default 0.005;
    where α γ is below 0.1, times (α γ/0.1)^¼. max_iterations: CG iterations a solve.
    max_elongation: µm; a colony whose cells would grow more in a step takes sub-steps. adhesion:
    cells stick together, see `tf.Adhesion`; several kinds add up. Only one-sided contacts have it.
    backend: "compiled" kernels, on the CPU, or "torch". Default: compiled; where gradients are
    required torch, whose one-sided contacts kernels solve.
    """

    walls: Sequence[Wall] = ()
    dim: int = 3
    viscosity: Value = physical(1.0, unit="μ", above=0.0)
    length_drag: Value | None = physical(None, unit="μ·µm", above=0.0)
    alpha: Value | None = physical(None, above=0.0)
    stiffness: Value | None = physical(None, unit="μ·µm/h", above=0.0)
    contacts: str = "one-sided"
    passes: int | None = None
    overlap: float | None = None
    contact_overlap: float | None = None
    tolerance: float | None = None
    max_iterations: int = 2000
    max_elongation: float = 0.25
    adhesion: Sequence[Adhesion] = ()
    periodic: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    backend: str | None = None

    stage = MECHANICS
    title = "mechanics"
    may_repeat = False
    instead: ClassVar[Mapping[str, str]] = {
        "unilateral": (
            'Contacts that only push are contacts="one-sided", the default; unilateral=False is'
            ' contacts="bilateral" now.'
        ),
        "gamma": "Did you mean length_drag? (γ)",
        "mu": "Did you mean viscosity? (μ)",
    }

    def __post_init__(self) -> None:
        checks.choice("Mechanics.dim", self.dim, (2, 3))
        checks.choice("Mechanics.contacts", self.contacts, CONTACTS)
        check_backend("Mechanics", self.backend)
        if self.length_drag is None:
            object.__setattr__(self, "length_drag", LENGTH_DRAG[self.contacts])
        if isinstance(self.length_drag, Real) and self.length_drag >= FREE:
            object.__setattr__(self, "crowding", CROWDING)
        if self.alpha is not None and self.stiffness is not None:
            raise checks.InputError(
                "Mechanics got alpha and stiffness: α = 1/(stiffness·Δt), so give one of the two."
            )
        for name in ("alpha", "stiffness"):
            if isinstance(given := getattr(self, name), (ByType, Distribution)):
                rule = "one number, or a list of one per colony: the same for all cells of a colony"
                hint = "Cells of which each gives way by its own would push each other unequally."
                raise checks.input_error(f"Mechanics.{name}", given, rule, hint)
        if not self.one_sided and isinstance(self.length_drag, (ByType, Distribution)):
            rule = (
                "one number, or a list of one per colony, where contacts are bilateral: α is 0.1/γ"
            )
            hint = 'Cells of a γ of their own push each other alike by contacts="one-sided".'
            raise checks.input_error("Mechanics.length_drag", self.length_drag, rule, hint)
        self._check_parts("walls", Wall, "Plane, Sphere, Box or Channel")
        self._check_parts("adhesion", Adhesion, "tf.Adhesion(…)")
        if self.adhesion and not self.one_sided:
            hint = 'Take contacts="one-sided", the default.'
            raise checks.input_error(
                "Mechanics.adhesion", self.adhesion, "left out with bilateral contacts", hint
            )
        check_walls_of(self.adhesion, len(self.walls))
        for name in ("passes", "max_iterations"):
            if (given := getattr(self, name)) is not None:
                object.__setattr__(self, name, checks.integer(f"Mechanics.{name}", given, least=1))
        for name in ("tolerance", "max_elongation", "overlap", "contact_overlap"):
            most = 0.5 if name == "tolerance" else math.inf
            if (given := getattr(self, name)) is not None:
                found = checks.number(f"Mechanics.{name}", given, above=0.0, most=most)
                object.__setattr__(self, name, found)
        if self.contact_overlap is not None and (
            self.contacts == "bilateral" or self.alpha is not None or self.stiffness is not None
        ):
            raise checks.InputError(
                "Mechanics.contact_overlap is for one-sided contacts that follow their force: leave"
                " it out, or leave out alpha, stiffness and contacts='bilateral'."
            )
        self._check_space()

    def _check_space(self) -> None:
        space = PeriodicSpace.of("Mechanics.periodic", self.periodic, self.dim)
        object.__setattr__(self, "periodic", {} if space is None else space.faces)
        if space is not None and not self.one_sided:
            hint = 'Take contacts="one-sided", the default.'
            raise checks.input_error(
                "Mechanics.periodic", self.periodic, "left out with bilateral contacts", hint
            )
        surfaces = self.surfaces()  # raises for a wall that does not fit the dimension
        if space is not None:
            check_walls_in(space, surfaces)

    def _check_parts(self, name: str, kind: type, rule: str) -> None:
        given = getattr(self, name)
        if isinstance(given, kind):
            hint = f"Write {name}=[{type(given).__name__}(…)]."
            raise checks.input_error(f"Mechanics.{name}", given, f"a list of {rule}", hint)
        parts = tuple(given) if isinstance(given, Iterable) else (given,)
        if not all(isinstance(part, kind) for part in parts):
            raise checks.input_error(f"Mechanics.{name}", given, f"a list of {rule}")
        object.__setattr__(self, name, tuple(map(_checked, parts)))

    def surfaces(self) -> list[Surface]:
        """What the walls are made of."""
        return [s for wall in self.walls for s in wall.surfaces(self.dim)]

    @property
    def periodic_space(self) -> PeriodicSpace | None:
        return PeriodicSpace.of("Mechanics.periodic", self.periodic, self.dim)

    @property
    def soft_contacts(self) -> bool:
        return self.stiffness is not None

    @property
    def holds_back(self) -> bool:
        return bool(self.walls) or smallest(self.length_drag) < FREE

    def wall_surfaces(self) -> list[Surface]:
        return self.surfaces()

    @property
    def one_sided(self) -> bool:
        return self.contacts == "one-sided"

    @property
    def settings(self) -> OneSidedSettings | ContactSettings:
        """How contacts are solved, defaults filled in."""
        if self.one_sided:
            return OneSidedSettings(
                self.dim,
                self.stiffness is not None,
                PASSES if self.passes is None else self.passes,
                self.overlap,
                OVERLAP if self.contact_overlap is None else self.contact_overlap,
                FORCE_TOLERANCE if self.tolerance is None else self.tolerance,
                self.max_iterations,
                self.periodic_space,
            )
        return ContactSettings.resolve(
            self.dim,
            soft=self.stiffness is not None,
            passes=self.passes,
            overlap=self.overlap,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )

    def backend_on(self, device: torch.device) -> str:
        """Who computes the contacts on a device: "compiled" or "torch"."""
        return "torch" if why_torch("Mechanics", self.backend, device) else "compiled"

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        found = self.physical_fields()
        parts: dict[str, Wall | Adhesion] = {
            f"walls[{k}]": wall for k, wall in enumerate(self.walls)
        }
        parts |= {f"adhesion[{k}]": kind for k, kind in enumerate(self.adhesion)}
        for place, part in parts.items():
            for name, rule in _rules(part).items():
                if (value := getattr(part, name)) is not None:
                    found[f"{place}.{name}"] = value, rule
        return found

    def declares(self, dim: int) -> tuple[Field, ...]:
        return _fields(self.settings.degrees, self.one_sided)

    @property
    def _own_fields(self) -> tuple[str, ...]:
        return tuple(field.name for field in self.declares(self.dim))

    def needs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for kind in self.adhesion for name in kind.levels))

    def at_least_zero(self) -> tuple[str, ...]:
        return self.needs()

    def reads(self) -> tuple[str, ...]:
        cells = ("position", "axis", "length", "radius", "elongation", "drag")
        return (*cells, "drift", *self._own_fields)

    def writes(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "elongation", *self._own_fields)

    def contact_reach(self, state: State) -> Tensor:
        """How near others are that a cell meets in a step, by contacts and bonds, (N,) µm."""
        mean = state.groups.sum(state.radius.detach().double()) / state.counts.clamp(min=1)
        bonds = (kind.reach for kind in self.adhesion if kind.to == "cells")
        return MARGIN * mean.index_select(0, state.colony) + max(bonds, default=0.0)

    def check(self, state: State, values: Values) -> None:
        if state.dim != self.dim:
            raise checks.input_error("Mechanics.dim", self.dim, f"{state.dim}, like the cells")
        if (space := self.periodic_space) is not None:
            check_first_cells(
                space, state.position, state.length, state.radius, self.contact_reach(state),
                state.own_colony_id, state.uid,
            )  # fmt: skip
        for kind in self.adhesion:
            check_variables("Adhesion", state, adhesin=kind.adhesin, partner=kind.partner)
        if wrong := self.behind(state, self.surfaces()):
            raise checks.InputError(wrong)
        cells, ids = (state.position, state.axis, state.length, state.radius), state.own_colony_id
        check_between_planes(self.surfaces(), state.position, state.radius, ids)
        if check_fits(self.surfaces(), state.position, *cells[2:], ids, state.uid):
            check_turned(self.surfaces(), *cells, ids, state.uid)
        check_apart(*cells, state.colony, state.colony_id, state.uid, space)

    @staticmethod
    def behind(state: State, surfaces: Iterable[Surface]) -> str:
        """The words for a cell whose centre lies behind a wall; "" where there is none."""
        for surface in surfaces:
            distance, _ = surface.gap_of_points(state.position, state.own_colony_id)
            behind = torch.nonzero(distance < 0).squeeze(1)
            if behind.numel():
                k = int(behind[0])
                return (
                    f"{type(surface.wall).__name__}: cell {int(state.uid[k])} of colony"
                    f" {int(state.own_colony_id[k])} starts at"
                    f" {[round(x, 3) for x in state.position[k].tolist()]},"
                    f" {-float(distance[k]):.3g} µm behind it (cells behind it: {behind.numel()})."
                    f" {surface.wall.turn_hint}"
                )
        return ""

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        return (BoundMechanics(self, binding),)

    # --- what explaining and tuning need -------------------------------------------------

    def numerics(self, dt: float, state: State) -> list[str]:
        return numerics_in_words(self, dt, state.device)

    def accuracy_knobs(self) -> Mapping[str, float]:
        penalty = {"penalty": PENALTY} if self.stiffness is None else {}
        if self.one_sided:
            return {"tolerance": FORCE_TOLERANCE / OF_FORCES, **penalty}
        usual = replace(self, passes=None).settings.passes
        return {"passes": usual, "tolerance": TOLERANCE, **penalty}

    def accuracy_parameters(self) -> Mapping[str, str]:
        settings, found = self.settings, {}
        if self.alpha is not None:
            found["alpha"] = number_range(numbers(self.alpha))
        elif self.stiffness is None and isinstance(settings, OneSidedSettings):
            found["contact_overlap"] = f"{settings.contact_overlap:g}"
        elif self.stiffness is None:
            found["alpha"] = number_range(PENALTY / numbers(self.length_drag))
        if isinstance(settings, ContactSettings):
            found["passes"] = f"{settings.passes}"
            if self.overlap is not None:
                found["overlap"] = f"{self.overlap:g}"
        tolerance = settings.tolerance
        found["tolerance"] = "default" if tolerance is None else f"{tolerance:g}"
        return found

    def with_settings(self, settings: Any) -> Mechanics:
        if self.one_sided:
            return self._one_sided_with(settings)
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
            changed["alpha"] = quotient(settings.penalty, self.length_drag)
        return replace(self, **changed) if changed else self

    def _one_sided_with(self, settings: Any) -> Mechanics:
        """One-sided contacts give way in proportion to the penalty; they repeat passes where cells
        lie deep, whatever the settings."""
        changed: dict[str, Any] = {}
        if settings.tolerance is not None:
            changed["tolerance"] = min(settings.tolerance * OF_FORCES, 0.5)
        if settings.penalty is not None and self.stiffness is None:
            changed |= {"alpha": None, "contact_overlap": settings.penalty / PENALTY * OVERLAP}
        return replace(self, **changed) if changed else self

    def _penalty(self, settings: Any) -> float:
        """α γ by these settings, the smallest of several; the usual one of soft cells."""
        if self.stiffness is not None:
            return PENALTY
        if settings.penalty is not None:
            return settings.penalty
        return PENALTY if self.alpha is None else smallest(self.alpha) * smallest(self.length_drag)


def _rules(part: Wall | Adhesion) -> Mapping[str, Rule]:
    return OF_ADHESION if isinstance(part, Adhesion) else OF_WALLS


def _checked(part: Any) -> Any:
    """A wall or a kind of adhesion with its values as an effect keeps them."""
    own = copy.copy(part)
    for name, rule in _rules(part).items():
        if (given := getattr(part, name)) is not None:
            label = f"{type(part).__name__}.{name}"
            object.__setattr__(own, name, checked(label, given, rule))
    return own


@functools.cache
def _fields(degrees: int, one_sided: bool) -> tuple[Field, ...]:
    """What mechanics keep of the cells from step to step."""
    # files and states keep meanings: with other words, `take_over` would begin the field anew
    meaning = (
        "move of the last first solve of a step or sub-step (Δc, Δθ, Δl), from which the next"
        " starts"
    )
    move = Field("displacement", meaning, "µm, rad, µm", shape=(degrees,), internal=True)
    # what a colony has, its cells have, so that growth can be recorded for other designs
    meaning = "steps in a row in which contacts have not held the colony's cells apart"
    collapsed = Field("collapsed_steps", meaning, dtype=torch.int64, internal=True)
    if not one_sided:
        return move, collapsed
    meaning = "α with which the next step of the colony's contacts begins, 0 before the first"
    alpha = Field("contact_alpha", meaning, "1/μ/µm", internal=True)
    meaning = "how much shorter pressure has made a cell than it once was"
    compression = Field("compression", meaning, "µm", at_division="reset", internal=True)
    return move, collapsed, alpha, compression
