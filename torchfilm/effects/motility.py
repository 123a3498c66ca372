"""Motility: cells move by themselves, along their axis, reverse and turn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfilm.effect import MOTILITY, Binding, BoundEffect, Effect
from torchfilm.physics import capsule
from torchfilm.resolver import Values
from torchfilm.signals.schedule import each_value, warn_of_means
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.random import fine_uniform
from torchfilm.tools.row_checks import check_names, check_variables
from torchfilm.tools.vectors import safe_sqrt
from torchfilm.tools.warn_once import warn
from torchfilm.values import ScheduledValue, numbers, physical

# How far, in radii, a cell beside others may move in a step, and its ends by a usual turn, of one
# standard deviation. Two that meet then lie no deeper in each other than contacts can part; to pass
# through each other they would have to turn by seven standard deviations.
FARTHEST = 0.3
# rad: the widest usual turn in a step, of short cells and of cells without contacts.
WIDEST_TURN = 0.2
# Reversals in a step beyond which cells are said to spread too far: by 2 % there.
OFTEN = 0.25
ROUNDING = 1e-5


@dataclass(frozen=True)
class MotilityReport:
    """Made only where a cell would move too far to meet others, or by no number: `status` (B,), 1
    for its colony, in which no cell moved. Of the first such cell: `uid` (B,), `move` (B,) µm, or
    that of its ends by a usual turn, and that `turn` (B,) rad."""

    status: Tensor
    uid: Tensor
    move: Tensor
    turn: Tensor
    hint = (
        "A smaller dt, speed or turning may help (they are per hour, and dt is in hours): the same"
        " turn moves the ends of longer cells farther"
    )

    def reason(self, place: int) -> str:
        """What went wrong in the colony at this place of the batch."""
        return (
            f"cell {int(self.uid[place])} would move {float(self.move[place]):.3g} µm in one step,"
            f" by its speed or by a turn of {float(self.turn[place]):.2g} rad; beside others it may"
            f" move {FARTHEST:g} of its radius, and turn by {WIDEST_TURN:g} rad"
        )


@dataclass(frozen=True, eq=False)
class Motility(Effect):
    """Cells move by themselves, along their axis; contacts then part those that meet.

    speed: µm/h, of a cell that nothing holds back. reversals: 1/h, the rate at which a cell
    reverses, to move the other way along its axis. turning: rad²/h, rotational diffusion: in the
    plane the mean squared angle after the time t is 2 · turning · t. Each is a number, one per
    colony, one per cell type, a distribution drawn at birth, or a Schedule.

    factor, reversal_factor: names of a species of a circuit, or of a variable of rules, that
    multiply the speed and the rate of reversals: cells that stop, or that seek a signal.

    The field `heading` is 1 where a cell moves along its axis and −1 where it moves against it; it
    is drawn for the first cells, and daughters keep their mother's. A cell that pushes others has
    the force viscosity · (l + 2r) · speed, μ·µm²/h.

    With Mechanics, a cell may move by 0.3 of its radius in a step, and so may its ends by a turn of
    one standard deviation, (2 · turning · dt)^½ · l/2; in any scene such a turn may be 0.2 rad.
    Raises InputError for a dt with which the first cells would move farther; a colony that comes to
    it later fails.
    """

    speed: ScheduledValue = physical(unit="µm/h", least=0.0, scheduled=True)
    reversals: ScheduledValue | None = physical(None, unit="1/h", least=0.0, scheduled=True)
    turning: ScheduledValue | None = physical(None, unit="rad²/h", least=0.0, scheduled=True)
    factor: str | None = None
    reversal_factor: str | None = None

    stage = MOTILITY
    title = "motility"
    by_kernels = True
    may_repeat = False

    def __post_init__(self) -> None:
        check_names("Motility", factor=self.factor, reversal_factor=self.reversal_factor)
        if self.reversal_factor is not None and self.reversals is None:
            raise checks.input_error(
                "Motility.reversal_factor", self.reversal_factor,
                "given with reversals, the rate that it multiplies",
            )  # fmt: skip

    def declares(self, dim: int) -> tuple[Field, ...]:
        meaning = "1 where a cell moves along its axis, −1 where against it"
        drift = Field(
            "drift", "how far a cell has moved and turned by itself in this step (Δc, Δθ)",
            "µm, rad", shape=(3 if dim == 2 else 6,), internal=True,
        )  # fmt: skip
        return Field("heading", meaning, initial=_first_heading), drift

    def needs(self) -> tuple[str, ...]:
        return tuple(n for n in (self.factor, self.reversal_factor) if n is not None)

    def at_least_zero(self) -> tuple[str, ...]:
        return self.needs()

    def reads(self) -> tuple[str, ...]:
        return ("position", "axis", "length", "radius", "heading")

    def writes(self) -> tuple[str, ...]:
        turns = ("axis",) if self.turning is not None else ()
        return ("position", "drift", *turns, *(("heading",) if self.reversals is not None else ()))

    def check(self, state: State, values: Values) -> None:
        if bool((state.heading.abs() != 1).any()):
            raise checks.InputError("Motility: heading of a first cell is neither 1 nor −1.")
        named = {"factor": self.factor, "reversal_factor": self.reversal_factor}
        check_variables("Motility", state, **named)

    def check_step(self, dt: float, divides: bool) -> None:
        given = {name: value for name, (value, _) in self.physical_values().items()}
        warn_of_means("Motility", given, dt)
        if self.reversals is None or self.reversal_factor is not None:
            return
        most = max(float(numbers(x).max()) for x in each_value(self.reversals))
        if OFTEN < most * dt < math.inf:
            x = most * dt
            warn(
                f"Motility.reversals = {most:g} in steps of {dt:g} h: a cell reverses up to {x:.3g}"
                f" times in a step, but moves one way in it, so that its mean squared displacement"
                f" is {x / math.tanh(x):.3g} times what it should be. Take a dt of at most"
                f" {_rounded_down(OFTEN / most)} h.",
                of="Motility.reversals",
            )

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        return (BoundMotility(self, binding),)

    def without_noise(self) -> Motility:
        return replace(self, reversals=None, reversal_factor=None, turning=None)

    def numerics(self, dt: float, state: State) -> list[str]:
        lines = ["before contacts, which part those that meet"]
        if self.reversals is not None:
            lines.append(
                "reversals: by a draw of (1 − exp(−2·rate·dt))/2 at the start of a step"
                + "; of first order in dt where their factor goes by the way a cell moves"
                * (self.reversal_factor is not None)
            )
        if self.turning is not None:
            lines.append("turning: by a normal draw of the angle, of variance 2·turning·dt")
        return lines


class BoundMotility(BoundEffect):
    """Motility bound to a batch."""

    effect: Motility
    meets = False  # whether contacts part cells

    # of the first cells: speed, 1/h, and usual turn, 1/h^½, of the ends, both in radii; rad/h^½
    fastest = widest_end = widest = 0.0

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        self.meets = any(e.title == "mechanics" for e in effects)

    def check(self, state: State) -> None:
        super().check(state)
        if state.cells:
            turn = self._turn(state).detach()
            self.fastest = float((self._speed(state).detach() / state.radius).max())
            self.widest_end = float((0.5 * turn * state.length / state.radius).max())
            self.widest = float(turn.max())

    def check_step(self, dt: float, divides: bool) -> None:
        """Also raise InputError where the first cells would move too far in a step."""
        super().check_step(dt, divides)
        root, limits = math.sqrt(dt), []
        if self.meets:
            limits.append(("speed", 1, self.fastest * dt, FARTHEST, "move by {} radii"))
            limits.append(
                ("turning", 2, self.widest_end * root, FARTHEST, "move its ends by {} radii")
            )
        limits.append(("turning", 2, self.widest * root, WIDEST_TURN, "turn by {} rad"))
        for name, power, found, most, what in limits:
            if found > most * (1.0 + ROUNDING):
                longest = dt * (most / found) ** power
                why = "let contacts find whom it meets" if self.meets else "follow its way"
                raise checks.InputError(
                    f"Motility.{name}: in a step of {dt:g} h a first cell would"
                    f" {what.format(f'{found:.3g}')}; at most {most:g} {why}. Take a dt of at most"
                    f" {_rounded_down(longest)} h."
                )

    def _speed(self, state: State) -> Tensor:
        """Of each cell, µm/h, (N,)."""
        speed = self.values.speed.of_cells(state).expand(state.cells)
        factor = self.effect.factor
        return speed if factor is None else speed * state.fields[factor]

    def _turn(self, state: State) -> Tensor:
        """The standard deviation of each cell's turn over the root of the time, rad/h^½, (N,)."""
        if self.effect.turning is None:
            return torch.zeros_like(state.length)
        return safe_sqrt(2.0 * self.values.turning.of_cells(state)).expand(state.cells)

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        effect = self.effect
        rows = torch.arange(state.cells, device=state.device)
        heading, axis = state.heading.sign(), state.axis  # whatever a rule has made of it
        turn = axis.new_zeros(state.cells, 1 if state.dim == 2 else 3)
        if effect.reversals is not None:
            heading = torch.where(self._reverses(state, rows, dt), -heading, heading)
        if effect.turning is not None:
            turn = state.normal(rows, "Motility turning")[:, : turn.shape[1]]
            turn = turn * (self._turn(state) * math.sqrt(dt)).unsqueeze(1)
            if state.dim == 3:  # without the part about the axis itself
                turn = turn - (turn * axis).sum(1, keepdim=True) * axis
        state, move, turn = self._checked(state, self._speed(state) * dt, turn, dt)
        turned = capsule.rotate(axis, turn) if effect.turning is not None else axis
        way = (move * heading).unsqueeze(1) * turned
        made = {"heading": heading} if effect.reversals is not None else {}
        return state.with_fields(**made, drift=torch.cat([way, turn], 1)).replace(
            position=state.position + way.to(state.position.dtype), axis=turned
        )

    def _reverses(self, state: State, rows: Tensor, dt: float) -> Tensor:
        """Which cells move the other way at the end of this step, (N,) bool."""
        rate = self.values.reversals.of_cells(state).double().expand(state.cells)
        if self.effect.reversal_factor is not None:
            rate = rate * state.fields[self.effect.reversal_factor].double()
        chance = -0.5 * torch.expm1(-2.0 * rate * dt)
        coarse, fine = (state.uniform(rows, f"Motility reversals {k}") for k in range(2))
        return fine_uniform(coarse, fine) < chance

    def _checked(
        self, state: State, move: Tensor, turn: Tensor, dt: float
    ) -> tuple[State, Tensor, Tensor]:
        """The moves (N,) and turns, 0 in colonies in which one is too far, and the state that says
        so."""
        wide = (self._turn(state) * math.sqrt(dt)).detach()
        size = torch.maximum(move.detach().abs(), 0.5 * state.length.detach() * wide)
        most = (1.0 + ROUNDING) * FARTHEST * state.radius.detach()
        good = size <= most if self.meets else size < torch.inf
        good = good & (wide <= (1.0 + ROUNDING) * WIDEST_TURN)
        if bool(good.all()):
            return state, move, turn
        at, bad = state.groups.first(~good)
        report = MotilityReport(bad.long(), state.uid[at], size[at], wide[at])
        state = state.replace(reports={**state.reports, self.title: report})
        still = state.groups.spread(bad)
        return state, torch.where(still, 0.0, move), torch.where(still.unsqueeze(1), 0.0, turn)


def _first_heading(state: State, rows: Tensor, values: Values) -> Tensor:
    return torch.where(state.uniform(rows, "Motility heading") < 0.5, -1.0, 1.0)


def _rounded_down(number: float) -> str:
    """To two digits."""
    digits = 10.0 ** (1 - math.floor(math.log10(number)))
    return f"{math.floor(number * digits * (1.0 + ROUNDING)) / digits:g}"
