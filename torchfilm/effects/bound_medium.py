"""A medium bound to a batch: its parts of a step, up to three."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Container, Sequence
from typing import TYPE_CHECKING

from torchfilm.effect import BEFORE_CELLS, CIRCUIT, LYSIS, Binding, BoundEffect, ExchangePlan
from torchfilm.effects.medium_coverage import MediumPart
from torchfilm.effects.medium_substeps import Reacting, SubSteps
from torchfilm.effects.medium_transport import Transport
from torchfilm.state import GRID, OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.row_checks import check_signals

if TYPE_CHECKING:
    from torchfilm.effects.medium import Medium


class FirstHalf(MediumPart):
    """Transports signals over the first half of a step, before exchange with the cells."""

    def __init__(self, effect: Medium, binding: Binding, transport: Transport):
        super().__init__(effect, binding, transport)
        self.stage = BEFORE_CELLS

    def step(self, state: State, dt: float) -> State:
        state = self.transport.carried(state, dt / 2, dt / 2 / self.effect.steps)
        apart = self.transport.apart
        return apart.before(state, dt) if apart else state

    def numerics(self, dt: float, state: State) -> list[str]:
        often = self.transport.in_turns
        coupled = self.transport.coupled
        if coupled.keys() >= {*self.effect.signals}:
            movers = list(dict.fromkeys(coupled.values()))
            verb = "moves" if len(movers) == 1 else "move"
            return [f"nothing: {' and '.join(movers)} {verb} all signals"]
        whole = len(often | coupled.keys()) < len(self.effect.signals)
        first = dt / 2 / self.effect.steps if often else dt / 2
        hours = f"{first:g} h" + (f" or {dt / 2:g} h" if whole and first < dt / 2 else "")
        return [f"over {hours}, by the methods that the main part of transport lists"]

    def summary(self) -> str:
        if self.transport.coupled.keys() >= {*self.effect.signals}:
            return "rests: all signals are moved together with what cells do to them"
        return "moves signals before cells exchange them: Strang's first half"


class BoundMedium(MediumPart):
    """Transports signals after exchange with the cells: over the second half of a step, or all.
    solves_together: whether circuits and transport of what they exchange are one equation. found:
    the signals that cells may find; None: not known yet."""

    solves_together = False
    sub_steps: SubSteps | None = None  # of reactions, transport and circuits
    found: frozenset[str] | None = None

    def declares(self) -> list[Field]:
        first = self.transport.first
        fields = self.effect.declares(self.binding.dim)
        return [
            (
                dataclasses.replace(f, initial=first(f.name.removeprefix(OUTSIDE)))
                if f.scope == GRID
                else f
            )
            for f in fields
        ]

    def check(self, state: State) -> None:
        medium = self.effect
        flat = len(medium.box[0]) == 2 and medium.depth is None
        if state.dim == 3 and flat and medium.outside == "error":
            hint = (
                "Give both corners a z; or give depth=…, if all cells stay in one layer; or let the"
                " box grow, outside='grow'."
            )
            raise checks.input_error(
                "Medium.box", medium.box, "of three dimensions in a 3-D scene", hint
            )
        for name in medium.signals:
            self.transport.check(name, state)

    def check_given(self, state: State, free: Container[str]) -> None:
        if self.effect.method not in ("crank_nicolson", "euler"):  # these may go below 0
            check_signals(state.fields)

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        others = [e for e in effects if e.place != self.place and e.stage > BEFORE_CELLS]
        circuits = [e for e in others if e.stage == CIRCUIT]
        exchanged = lambda by: dict.fromkeys(n for e in by for n in e.exchanges())
        eaters = [e for e in others if e.moves_signals]
        eaten = exchanged(eaters)
        given = exchanged(circuits)
        # what bursts gives, and finds nothing
        given_by_burst = {n for e in others if e.stage == LYSIS for n in e.writes()}
        for e in others:
            if e.effect.writes_anything:
                given_by_burst.clear()
            if e.stage != LYSIS:
                given_by_burst -= {*e.reads(), *e.writes()}
        self.found = frozenset(n for n in self.effect.signals if OUTSIDE + n not in given_by_burst)
        every = {OUTSIDE + n for n in self.effect.signals}
        among = [e for e in effects if e.place != self.place]
        with_signals = [e for e in among if every & {*e.reads(), *e.writes()}]
        no_cells = with_signals and all(e.works_on_grid for e in with_signals)
        if no_cells and not any(e.effect.writes_anything for e in among):
            self.found = frozenset()
        why = next((why for e in circuits if e.exchanges() and (why := e.why_turns)), "")
        if both := [n for n in given if n in eaten]:
            why = f"Nutrition moves {both[0]}, and a circuit exchanges it, too."
        if self.effect.carries_in_turns:
            why = why or "Its method and splitting are of turns: leave them out."
        if why and self.effect.exchange == "together":
            raise checks.input_error("Medium.exchange", "together", '"turns"', why)
        joint = bool(given) and not why and self.effect.exchange != "turns"
        self.solves_together = joint
        self.transport.coupled = dict.fromkeys(eaten, "nutrition")
        self.transport.in_turns = frozenset()
        for effect in eaters:
            effect.plan = ExchangePlan(self.transport)
        times = Counter(n for c in circuits for n in c.exchanges())
        several = frozenset(n for n, count in times.items() if count > 1)
        for effect in circuits:
            together = self.transport if joint and effect.exchanges() else None
            turns = self.effect.steps if given and not joint else 1
            effect.plan = ExchangePlan(together, turns, frozenset(both), several)
        # what acts once in a step finds its signals half way, but for a nutrient
        once = [e for e in others if e.stage < CIRCUIT]
        known = {n for e in once for n in (*e.reads(), *e.writes())}
        free = frozenset(n for n in self.effect.signals if OUTSIDE + n not in known)
        if joint:
            self.transport.coupled |= dict.fromkeys(given, "circuits")
        elif given:
            self.transport.in_turns = free - self.transport.coupled.keys()
        self._divide([e for e in effects if isinstance(e, Reacting)], bool(given), free)

    def _divide(
        self, reactions: Sequence[Reacting], with_cells: bool, free: Collection[str]
    ) -> None:
        """Let reactions and transport take turns in the medium's steps. with_cells: whether
        circuits do, too, with those signals that are free to."""
        transport, steps = self.transport, self.effect.steps
        self.sub_steps = transport.apart = None
        names = {n for e in reactions for n in e.species}
        eaten = {n for n in names if transport.coupled.get(n) == "nutrition"}
        moved = names - transport.coupled.keys()
        # what acts on these once in a step would have most of the reactions on one side
        once = sorted(eaten | (names.difference(free) if with_cells else set()))
        lopsided = bool(once) and (with_cells or not self.effect.halves)
        whole = lopsided or not (moved or with_cells)
        for effect in reactions:
            effect.sub_steps = 1 if whole else steps
            effect.once, effect.whole = tuple(once), whole
        if steps == 1 or not reactions or whole:
            return
        if with_cells:
            transport.in_turns |= moved
            self.sub_steps = SubSteps(reactions[0], transport, transport.in_turns)
        else:
            transport.apart = SubSteps(reactions[0], transport, frozenset(moved))

    def step(self, state: State, dt: float) -> State:
        """Transport to the end of the step."""
        part = (0.5 if self.effect.halves else 1.0) * dt
        apart = self.transport.apart
        state = apart.after(state, dt) if apart else state
        return self.transport.carried(state, part, part / self.effect.steps)

    def between(self, state: State, dt: float) -> State:
        """The state after what comes between two turns of circuits in a step."""
        if self.sub_steps is not None:
            return self.sub_steps.between(state, dt)
        part, names = dt / self.effect.steps, self.transport.in_turns
        return self.transport.carried(state, dt, part, 2 if self.effect.halves else 1, names)

    def numerics(self, dt: float, state: State) -> list[str]:
        moved = self.transport.in_turns, self.transport.coupled
        lines = self.effect.numerics(dt, state, *moved, found=self.found)
        finest, radius = min(self.effect.spacing), float(state.radius.max()) if state.cells else 0.0
        if radius > finest and self.found != frozenset():
            lines.append(
                f"voxels of {finest:g} µm are finer than cells, of radii up to {radius:g} µm: each"
                " exchanges with those about its centre alone, so that it finds too little of what"
                " it takes, the less the finer they are"
            )
        return lines
