"""Motility: cells move by themselves, along their axis, reverse and turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfilm.effect import MOTILITY, Binding, BoundEffect, Effect
from torchfilm.physics import capsule
from torchfilm.resolver import Values
from torchfilm.signals.schedule import each_value, warn_of_steps
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.random import fine_uniform
from torchfilm.tools.row_checks import check_variable
from torchfilm.values import Value, numbers, physical

# The farthest, in radii, that a cell may move in a step beside others: two of them come no closer,
# or farther apart, than the margin in which contacts are looked for.
FARTHEST = 0.3
# rad: the standard deviation of a turn in a step.
WIDEST_TURN = 0.1


@dataclass(frozen=True)
class MotilityReport:
    """Made only where a cell would move too far to meet others, or by no number: `status` (B,), 1
    for its colony, in which no cell moved, and the `uid` (B,) and `move` (B,) µm of the first such
    cell."""

    status: Tensor
    uid: Tensor
    move: Tensor
    hint = "A smaller dt or speed may help (speeds are per hour, and dt is in hours)"

    def reason(self, place: int) -> str:
        """What went wrong in the colony at this place of the batch."""
        return (
            f"cell {int(self.uid[place])} would move {float(self.move[place]):.3g} µm in one step;"
            f" at most {FARTHEST:g} of its radius lets it meet others"
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

    A colony fails where a cell beside others would move farther than half its radius in a step.
    """

    speed: Value = physical(unit="µm/h", least=0.0, scheduled=True)
    reversals: Value | None = physical(None, unit="1/h", least=0.0, scheduled=True)
    turning: Value | None = physical(None, unit="rad²/h", least=0.0, scheduled=True)
    factor: str | None = None
    reversal_factor: str | None = None

    stage = MOTILITY
    title = "motility"
    by_kernels = True
    may_repeat = False

    def __post_init__(self) -> None:
        for name in ("factor", "reversal_factor"):
            of = getattr(self, name)
            if of is not None and not (isinstance(of, str) and of.isidentifier()):
                rule = "the name of a species or a variable of the cells"
                raise checks.input_error(f"Motility.{name}", of, rule)
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
        return ("position", "axis", "radius", "heading")

    def writes(self) -> tuple[str, ...]:
        turns = ("axis",) if self.turning is not None else ()
        return ("position", "drift", *turns, *(("heading",) if self.reversals is not None else ()))

    def check(self, state: State, values: Values) -> None:
        for option in ("factor", "reversal_factor"):
            if (name := getattr(self, option)) is not None:
                check_variable(f"Motility.{option}", name, state, at_least_zero=True)

    def check_step(self, dt: float, divides: bool) -> None:
        given = {name: value for name, (value, _) in self.physical_values().items()}
        warn_of_steps("Motility", given, dt)
        most = WIDEST_TURN**2 / (2.0 * dt)
        times = each_value(self.turning) if self.turning is not None else ()
        widest = max((float(numbers(x).max()) for x in times), default=0.0)
        if widest > most:
            raise checks.input_error(
                "Motility.turning", widest,
                f"at most {most:.3g} rad²/h in steps of {dt:g} h: cells would turn too far in one",
                "Take a smaller dt.",
            )  # fmt: skip

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        return (BoundMotility(self, binding),)

    def without_noise(self) -> Motility:
        return replace(self, reversals=None, reversal_factor=None, turning=None)

    def numerics(self, dt: float, state: State) -> list[str]:
        lines = ["before contacts, which part those that meet"]
        if self.reversals is not None:
            lines.append("reversals: by a draw of (1 − exp(−2·rate·dt))/2, exact at any dt")
        if self.turning is not None:
            lines.append("turning: by a normal draw of the angle, of variance 2·turning·dt")
        return lines


class BoundMotility(BoundEffect):
    """Motility bound to a batch."""

    effect: Motility
    meets = False  # whether contacts part cells

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        self.meets = any(e.title == "mechanics" for e in effects)

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        effect, values = self.effect, self.values
        rows = torch.arange(state.cells, device=state.device)
        heading, axis = state.heading, state.axis
        turn = axis.new_zeros(state.cells, 1 if state.dim == 2 else 3)
        if effect.reversals is not None:
            heading = torch.where(self._reverses(state, rows, dt), -heading, heading)
        if effect.turning is not None:
            width = (2.0 * dt * values.turning.of_cells(state)).sqrt()
            turn = state.normal(rows, "Motility turning")[:, : turn.shape[1]]
            turn = turn * width.expand(state.cells).unsqueeze(1)
            if state.dim == 3:  # without the part about the axis itself
                turn = turn - (turn * axis).sum(1, keepdim=True) * axis
        move = (values.speed.of_cells(state) * dt).expand(state.cells)
        if effect.factor is not None:
            move = move * state.fields[effect.factor]
        state, move, turn = self._checked(state, move, turn)
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

    def _checked(self, state: State, move: Tensor, turn: Tensor) -> tuple[State, Tensor, Tensor]:
        """The moves (N,) and turns, 0 in colonies in which a move is too far, and the state that
        says so."""
        size = move.detach().abs()
        good = size <= FARTHEST * state.radius.detach() if self.meets else size < torch.inf
        if bool(good.all()):
            return state, move, turn
        at, bad = state.groups.first(~good)
        report = MotilityReport(bad.long(), state.uid[at], size[at])
        state = state.replace(reports={**state.reports, self.title: report})
        still = state.groups.spread(bad)
        return state, torch.where(still, 0.0, move), torch.where(still.unsqueeze(1), 0.0, turn)


def _first_heading(state: State, rows: Tensor, values: Values) -> Tensor:
    return torch.where(state.uniform(rows, "Motility heading") < 0.5, -1.0, 1.0)
