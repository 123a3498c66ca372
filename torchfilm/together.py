"""Circuits and transport of the signals that they exchange, solved together.

Over a step a cell finds a concentration that goes evenly to what will be there at the end, with the
mean that will have been there. Its circuit then says what it gives and takes, and with that given
transport is linear (`signals.joint`). The equation says that the field is what the cells found, at
the end and in the mean: it is of second order in the step, and where exchange or transport are
fast, both follow. Anderson's mixing solves it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.effects.bound_circuit import BoundCircuit
from torchfilm.effects.bound_medium import BoundMedium
from torchfilm.effects.circuit_kernels import PreparedStep
from torchfilm.effects.circuit_report import Failures
from torchfilm.medium_exchange import MediumExchange, Ramped
from torchfilm.signals.joint import JointMove, JointTransport
from torchfilm.state import CELL, GRID, OUTSIDE, State
from torchfilm.tools import checks
from torchfilm.tools.fixed_point import DEPTH, FixedPoint, fixed_point, with_derivative
from torchfilm.tools.tangents import both, in_forward_mode, no_derivatives, scaled, tangent, tracked
from torchfilm.tools.threads import Shared
from torchfilm.tools.timing import Timings

# Iterations end where concentrations change by PART of the circuits' tolerance, or by FINE of it
# where derivatives are wanted, as do those for the derivatives; they have failed if they do by
# LOST of it. MOST: iterations; a few are usual.
PART, FINE, LOST = 0.3, 1e-3, 10.0
FINEST_FINE = 1e-9  # roundings of float32 in species do not let a solve come much closer
MOST = 50
# Parts of a step into which a colony may divide it.
FINEST = 16
# In each half it is solved for concentrations so many times as small: where a signal has run out,
# what cells take of it by a law that saturates at little depends on them. Less than a share of the
# finest is nothing: it may be taken though it is not there.
SHARPER, NOTHING = 1e-8, 1e-20
ROUNDED = 1e-6  # see `profile`
GREEDY = (
    "cells take more of a signal than there is. Let the rate at which they take it be 0 where the"
    " signal is, as D1·s.ahl or a saturating k·s.ahl/(K + s.ahl) are"
)
_mixed = Shared()


def joins(circuit: BoundCircuit, circuits: Sequence[BoundCircuit]) -> bool:
    """Whether a circuit is solved with these: it exchanges signals, or reads what they do."""
    given = {n for c in circuits for n in c.exchanges()}
    return bool(given.intersection(circuit.signals)) and not circuit.why_turns


@dataclass(frozen=True, eq=False)
class Outcome:
    """What circuits and transport make of guesses: state, with the species of all circuits; what
    cells released, (N,) by signal; the signals; and what failed in each circuit."""

    state: State
    released: dict[str, Tensor]
    moved: dict[str, JointMove]
    reports: list[Failures]

    def tracked(self, before: State) -> bool:
        """Whether derivatives by any of it are wanted."""
        fields = self.state.fields
        changed = [x for n, x in fields.items() if x is not before.fields.get(n)]
        return tracked(self.found(), *self.released.values(), *changed)

    def found(self) -> Tensor:
        """Of each signal what each cell finds at the end, and in the mean, (N, E, 2)."""
        each = [torch.stack([x.at_end, x.mean], 1) for x in self.moved.values()]
        return torch.stack(each, 1)


class Together:
    """Circuits and transport of what they exchange, in one equation for each step of the medium."""

    def __init__(self, circuits: Sequence[BoundCircuit], medium: BoundMedium):
        self.circuits, self.medium = circuits, medium
        self.place, self.title = medium.place, circuits[0].title
        self.names = tuple(dict.fromkeys(n for c in circuits for n in c.exchanges()))
        self.read = tuple(dict.fromkeys(n for c in circuits for n in c.signals))
        self.rtol = min(c.effect.rtol for c in circuits)
        self.finest = min(c.effect.atol / c.effect.rtol for c in circuits)

    def run_step(self, state: State, dt: float, timings: Timings | None = None) -> State:
        """The state after a step."""
        checks.number("dt", dt, above=0.0)
        number, medium, first = self.medium.effect.steps, self.medium, self.circuits[0]
        with medium.transport.one_step():
            for done in range(number):
                with first.timed(state, timings), first.threads(state):
                    state = self._part(state, dt / number, done, number)
                if done < number - 1 and medium.sub_steps is not None:
                    with medium.timed(state, timings), medium.threads(state):
                        state = medium.between(state, dt)
        with medium.timed(state, timings), medium.threads(state):
            return medium.step(state, dt)

    def _part(self, state: State, dt: float, done: int, number: int) -> State:
        """The state after dt hours, one of a `number` of parts of a step, of which so many are
        `done`. Colonies whose equation cannot be solved take two parts of half the length, and
        in the shortest ones turns."""
        medium = MediumExchange(state, self.read)
        medium.find()
        step, outcome, fixed = _solved(lambda: _Step(self, state, medium, dt, done, number))
        made, again, greedy = self._finished(state, step, outcome, fixed)
        if number < FINEST * self.medium.effect.steps:
            for name, moved in outcome.moved.items():
                again = again | step.transport[name].coarse(moved, outcome.released[name])
        if not bool(again.any()):
            return made
        if number >= FINEST * self.medium.effect.steps:
            again = again & ~greedy
            taken = self._in_turns(state, dt, done, number) if bool(again.any()) else made
            return self._chosen(made, taken, again)
        for k in (2 * done, 2 * done + 1):
            state = self._part(state, dt / 2, k, 2 * number)
        return self._chosen(made, state, again)

    def _in_turns(self, state: State, dt: float, done: int, number: int) -> State:
        """The same part in turns: circuits with pools, and then transport."""
        for circuit in self.circuits:
            state = circuit.turn(state, dt, done, number)
        state = self.medium.transport.carried(state, dt, dt, names=frozenset(self.names))
        every = torch.ones(state.colonies, dtype=torch.int64, device=state.device)
        reports: dict[str, Any] = dict(state.reports)
        for circuit in self.circuits:
            report = reports[circuit.title]
            reports[circuit.title] = replace(report, unsolved=report.unsolved + every)
        return state.replace(reports=reports)

    def _chosen(self, made: State, halved: State, again: Tensor) -> State:
        """The one state, or in these colonies (B,) the other."""
        assert made.layout is not None
        owner = {CELL: made.colony, GRID: made.layout.grid.owner}
        changed = {}
        for name, x in made.fields.items():
            other, scope = halved.fields[name], made.declared[name].scope
            if other is not x:
                there = again.index_select(0, owner[scope]) if scope in owner else again
                changed[name] = torch.where(there, other, x)
        reports = dict(made.reports)
        for circuit in self.circuits:
            own, of_halves = made.reports[circuit.title], halved.reports[circuit.title]
            reports[circuit.title] = own.or_else(of_halves, again, made.colony)
        return made.with_fields(**changed).replace(reports=reports)

    def _finished(
        self, state: State, step: _Step, outcome: Outcome, fixed: FixedPoint
    ) -> tuple[State, Tensor, Tensor]:
        """The state of an outcome; the colonies where it does not solve the equation, (B,); and
        those where it does, but cells take what is not there."""
        changed = {}
        overdrawn = torch.zeros_like(fixed.failed, dtype=torch.float64)
        wanted, unequal = torch.zeros_like(overdrawn), torch.zeros_like(fixed.failed)
        total = lambda amount: state.groups.sum(amount)
        for name, moved in outcome.moved.items():
            old, released = state.fields[OUTSIDE + name], outcome.released[name].double()
            end, beyond, apart = step.transport[name].settled(moved, released)
            pool, given = step.transport[name].pool.detach(), released.detach()
            held = given.abs() + pool * moved.mean.detach()
            taken = given.clamp(max=0.0).neg()
            # of each cell: in the sum of a colony those that take little would excuse the others
            off = apart.detach().abs() > LOST * self.rtol * held + self.finest * pool
            unequal |= state.groups.any(off)
            pool, taken = total(torch.stack([pool, taken], 1)).unbind(1)
            changed[OUTSIDE + name] = end.to(old.dtype)
            overdrawn = overdrawn + beyond.detach()
            wanted = wanted + taken + NOTHING * self.finest * pool
            if f"{name}_reservoir" in state.fields:
                away = total(torch.where(step.fed, 0.0, released))
                changed[f"{name}_reservoir"] = state.fields[f"{name}_reservoir"] + away
        made = outcome.state.with_fields(**changed)
        greedy = (overdrawn > LOST * self.rtol * wanted) & ~fixed.failed
        for circuit, report in zip(self.circuits, outcome.reports, strict=True):
            well = report.status == 0
            report.note_colonies(greedy & well, GREEDY)
            none = torch.zeros_like(fixed.iterations)
            noted = {"iterations": fixed.iterations, "overdrawn": overdrawn, "unsolved": none}
            made = circuit.reported(made, report, None, step.done, noted)
        return made, fixed.failed | unequal | greedy, greedy


class _Step:
    """The function from guesses (N, E, 2), of what each cell finds of each signal at the end and in
    the mean, to the outcome. found: (N,) by signal, at the start, and `first` in float64."""

    def __init__(
        self, together: Together, state: State, medium: MediumExchange, dt: float, done: int,
        number: int,
    ):  # fmt: skip
        self.together, self.state, self.dt = together, state, dt
        self.done, self.number = done, number
        halved = math.log2(number / together.medium.effect.steps)
        self.finest = together.finest * SHARPER**halved
        self.found = medium.found
        self.first = {n: self.found[n].double() for n in together.names}
        outside, layout = medium.in_reservoir, state.layout
        assert layout is not None
        self.fed = torch.ones_like(state.colony, dtype=torch.bool) if outside is None else ~outside
        transport = together.medium.transport
        self.transport = {
            n: JointTransport(
                layout.grid, transport.with_uptake(n, state), medium.stencil,
                medium.pool.double(), state.groups, state.fields[OUTSIDE + n], self.first[n],
                self.fed, self.finest, dt,
            )
            for n in together.names
        }  # fmt: skip

    def start(self) -> Tensor:
        """The first guess: nothing changes."""
        first = torch.stack([self.first[n] for n in self.together.names], 1)
        return both(first)[0].unsqueeze(2).repeat(1, 1, 2)

    def ramped(self, x: Tensor) -> Ramped:
        """What circuits find by these guesses."""
        # networks know all signals of the medium, also those that none of them exchanges
        half, none = dict(self.found), torch.zeros(1, device=x.device, dtype=self.state.dtype)
        ramp = {n: (s, none.expand(len(x))) for n, s in half.items()}
        for k, name in enumerate(self.together.names):
            begin, half[name], rate = profile(x[:, k], self.dt, self.state.dtype)
            ramp[name] = begin, rate
        return Ramped(half, ramp)

    def __call__(self, x: Tensor) -> Outcome:
        state, names = self.state, self.together.names
        released: dict[str, Tensor] = {}
        reports = []
        for circuit in self.together.circuits:
            reports.append(self.report(circuit))
            if state.cells:
                around = self.ramped(x)
                changed = circuit.changed(
                    state, self.dt, self.done, self.number, around, reports[-1]
                )
                state = state.with_fields(**changed)
                given = around.released
                released |= {n: released[n] + y if n in released else y for n, y in given.items()}
        released = {n: released.get(n, torch.zeros_like(self.first[n])) for n in names}
        moved = {n: self.transport[n].moved(released[n], x[:, k, 1]) for k, n in enumerate(names)}
        return Outcome(state, released, moved, reports)

    def report(self, circuit: BoundCircuit) -> Failures:
        return Failures(self.state, circuit.effect.method, self.dt)

    def turned(self) -> Tensor:
        """Colonies whose equation has changed since this was asked, (B,) bool."""
        found = torch.zeros(self.state.colonies, dtype=torch.bool, device=self.state.device)
        for one in self.transport.values():
            found |= one.turned
            one.turned.zero_()
        return found

    @property
    def wanted(self) -> bool:
        """Whether gradients by a constant of the circuits, or by what there was, are wanted."""
        constants = any(c.values.requires_grad for c in self.together.circuits)
        return torch.is_grad_enabled() and (constants or tracked(*self.state.fields.values()))

    @property
    def close(self) -> float:
        """Where the iteration ends."""
        return PART * self.together.rtol

    @property
    def fine(self) -> float:
        """Where it ends, and those for derivatives do, where these are wanted."""
        return max(FINE * self.together.rtol, FINEST_FINE)


def profile(x: Tensor, dt: float, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """What cells find over a step of dt hours, that ends where x (N, 2) says and has its mean: the
    begin of a line, its middle, and its slope, (N,) each. Where the mean is below half the end, the
    line begins at 0. By its rounding it does not go below 0."""
    end, mean = x.unbind(1)
    begin = (mean + mean - end).clamp(min=0.0).to(dtype)
    least = scaled(begin.double(), ROUNDED - 1)
    change = end - begin
    change = torch.where(change < least, least, change)
    return begin, (begin + scaled(change, 0.5)).to(dtype), scaled(change, 1 / dt).to(dtype)


def _solved(make: Callable[[], _Step]) -> tuple[_Step, Outcome, FixedPoint]:
    """The step that `make` gives, its outcome, with derivatives where they are wanted, and the
    solution."""
    step = make()
    if (found := _by_kernels(step, step.close)) is not None:
        return step, *found
    if not in_forward_mode() and not step.wanted:  # what rates refer to may be tracked, as networks
        outcome = step(step.start())
        if not outcome.tracked(step.state):
            return step, *_by_torch(step, step.close, outcome)
    with no_derivatives():
        bare = make()
        _, fixed = _by_kernels(bare, step.fine) or _by_torch(bare, step.fine)
    last: list[Outcome] = []

    def tried(x: Tensor) -> Tensor:
        last[:] = [step(x)]
        return last[0].found()

    x = with_derivative(tried, fixed.x, step.state.groups, step.fine, MOST, "exchange of signals")
    # tangents end where they were last tried, unless they have failed
    turned = tangent(x) if in_forward_mode() else None
    known = turned is not None and bool(turned.isfinite().all())
    return step, last[0] if known else step(x), fixed


def _by_torch(
    step: _Step, close: float, known: Outcome | None = None
) -> tuple[Outcome, FixedPoint]:
    """The outcome and the solution. known: the outcome of the first guess."""
    start, groups, finest = step.start(), step.state.groups, step.finest
    if step.state.cells and all(x.operators for x in step.transport.values()):
        # as `_by_kernels` mixes: a colony's bits must not depend on the circuits of others
        iteration, outcome = _Iteration(step, start.numpy(), close), known or step(start)
        while iteration.goes_on(outcome.found()):
            outcome = step(iteration.x)
        return outcome, iteration.fixed()
    last = [known or step(start)]

    def found(x: Tensor) -> Tensor:
        if x is not start:  # that is known
            last[0] = step(x)
        return last[0].found()

    fixed = fixed_point(
        found, start, lambda x, new: torch.maximum(x, new) + finest, groups, close, MOST,
        positive=True,
        lost=LOST * step.together.rtol, turned=step.turned,
    )  # fmt: skip
    return last[0], fixed


def _by_kernels(step: _Step, close: float) -> tuple[Outcome, FixedPoint] | None:
    """The same by kernels, one circuit again and again with what changes written in place; None
    where torch is to do it."""
    together, state, names = step.together, step.state, step.together.names
    circuit = together.circuits[0]
    alone = len(together.circuits) == 1 and state.cells
    if not alone or not all(x.by_kernels for x in step.transport.values()):
        return None
    start, report = step.start(), step.report(circuit)
    around = step.ramped(start)
    made = circuit.prepared(state, step.dt, step.done, step.number, around, report)
    if made is None:
        return None
    iteration = _Iteration(step, start.numpy(), close)
    while True:
        made.run(circuit.kernels.again)
        moved = iteration.moved(made)
        if not iteration.goes_on():
            break
        for k, name in enumerate(names):
            columns = around.ramp[name][0], around.found[name], around.ramp[name][1]
            for column, new in zip(
                columns, profile(iteration.x[:, k], step.dt, state.dtype), strict=True
            ):
                column.copy_(new)  # of which kernels know the address
    changed = made.finished() | {circuit.effect.volume_field: made.start.half.end}
    released = {n: around.released.get(n, torch.zeros_like(step.first[n])) for n in names}
    return Outcome(state.with_fields(**changed), released, moved, [report]), iteration.fixed()


class _Iteration:
    """Anderson's mixing by a kernel. x: (N, E, 2), the guesses. iterations, going, far: (B,)."""

    def __init__(self, step: _Step, start: np.ndarray, close: float):
        self.limits = close, LOST * step.together.rtol
        self.step, self.count, colonies = step, 0, step.state.colonies
        self.x = torch.from_numpy(np.ascontiguousarray(start))
        self.new = torch.empty_like(self.x)
        numbers = self.x.numel()
        control = np.tile([0.0, np.inf, 1.0], (colonies, 1))
        self._earlier = np.zeros((4, numbers)), np.empty((DEPTH, 2, numbers)), control
        self._scale = np.full(numbers, step.finest), np.ones(numbers, bool)
        self.iterations = torch.zeros(colonies, dtype=torch.int64)
        self.going = torch.ones(colonies, dtype=torch.bool)
        self.far = torch.zeros(colonies, dtype=torch.bool)

    def moved(self, made: PreparedStep) -> dict[str, JointMove]:
        """The signals, for what cells have just released."""
        out, given = {}, dict(zip(made.names, made.released, strict=True))
        none = np.zeros(len(self.x))
        for k, (name, transport) in enumerate(self.step.transport.items()):
            released = torch.from_numpy(given.get(name, none))
            out[name] = transport.moved(released, self.x[:, k, 1])
            self.new[:, k, 0], self.new[:, k, 1] = out[name].at_end, out[name].mean
        return out

    def fixed(self) -> FixedPoint:
        """What it has come to."""
        return FixedPoint(self.x, self.iterations, self.far)

    def goes_on(self, found: Tensor | None = None) -> bool:
        """Make the next guess; whether it is to be tried. found: what came of the last, if it is
        not in `new`."""
        from torchfilm.kernels.joint import mix

        if found is not None:
            self.new.copy_(found)
        given = (
            self.step.state.groups.ends, self.x[0].numel(), self.x.numpy().reshape(-1),
            self.new.numpy().reshape(-1), *self._earlier, *self._scale, self.limits,
            self.step.turned().numpy(), self.iterations.numpy(), self.going.numpy(),
            self.far.numpy(),
        )  # fmt: skip
        _mixed(len(self.going), lambda begin, end: mix(begin, end, *given))
        self.count += 1
        return bool(self.going.any()) and self.count < MOST
