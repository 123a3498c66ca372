"""Which gate of a library takes which place of a wiring: each repressor once, and levels that
fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from design.library.devices import Gate, Reporter, SensorDevice
from design.library.logic import Netlist

Levels = dict[str, list[float]]


@dataclass(frozen=True)
class SteadyLevels:
    """Levels at steady state in each state of the inputs, RPU: inputs, the sum of the promoters in
    front of each gene, by gate; outputs, the activity of each promoter, and the reporter's level by
    its name."""

    inputs: Levels
    outputs: Levels


@dataclass(frozen=True)
class Assigner:
    """Assigns gates to the places of a wiring.

    gates: of the library; sensors: by input; contrast: the least ratio of levels that are on to
    levels that are off, behind each gate and at the output.
    """

    netlist: Netlist
    gates: tuple[Gate, ...]
    sensors: Mapping[str, SensorDevice]
    reporter: Reporter
    contrast: float

    def assign(self, wishes: Mapping[str, Gate]) -> dict[str, Gate]:
        """A gate for each place. Where the wished one has a repressor that an earlier place uses,
        or levels that do not fit, the free gate with the most similar response that fits takes its
        place; where none fits, the free one with the highest contrast."""
        outputs = self._sensor_levels(self.netlist.rows)
        chosen: dict[str, Gate] = {}
        for place, promoters in self.netlist.genes.items():
            used = {gate.group for gate in chosen.values()}
            free = [gate for gate in self.gates if gate.group not in used]
            free.sort(key=lambda gate: _distance(gate, wishes[place]))
            x = _sums(outputs, promoters)
            contrasts = [self._contrast_behind(place, g, x, outputs) for g in free]
            fits = [k for k, found in enumerate(contrasts) if found >= self.contrast]
            at = fits[0] if fits else contrasts.index(max(contrasts))
            chosen[place] = free[at]
            outputs[place] = [free[at].response(v) for v in x]
        return chosen

    def levels(
        self, chosen: Mapping[str, Gate], rows: Sequence[tuple[bool, ...]] | None = None
    ) -> SteadyLevels:
        """The levels of all gates, in the states of the inputs that occur, or in others."""
        outputs = self._sensor_levels(self.netlist.rows if rows is None else rows)
        inputs: Levels = {}
        for place, promoters in self.netlist.genes.items():
            inputs[place] = _sums(outputs, promoters)
            outputs[place] = [chosen[place].response(x) for x in inputs[place]]
        name = self.netlist.output
        inputs[name] = _sums(outputs, self.netlist.drivers)
        outputs[name] = [self.reporter.scale * x for x in inputs[name]]
        return SteadyLevels(inputs, outputs)

    def output_contrast(self, levels: SteadyLevels) -> float:
        """The lowest level of the output where it is on, divided by the highest where it is off."""
        return self._contrast(self.netlist.output, levels.outputs[self.netlist.output])

    def _contrast_behind(
        self, place: str, gate: Gate, x: Sequence[float], outputs: Levels
    ) -> float:
        """The contrast of a gate at inputs x, or of the output where that is lower and this gate
        is the last that drives it. outputs: of the gates before."""
        levels = [gate.response(v) for v in x]
        found = self._contrast(place, levels)
        known = {**outputs, place: levels}
        drivers = self.netlist.drivers
        if place in drivers and all(name in known for name in drivers):
            found = min(found, self._contrast(self.netlist.output, _sums(known, drivers)))
        return found

    def _sensor_levels(self, rows: Sequence[tuple[bool, ...]]) -> Levels:
        return {
            name: [device.ymax if row[k] else device.ymin for row in rows]
            for k, (name, device) in enumerate(self.sensors.items())
        }

    def _contrast(self, name: str, levels: Sequence[float]) -> float:
        states = self.netlist.states[name]
        on = [level for level, state in zip(levels, states, strict=True) if state]
        off = [level for level, state in zip(levels, states, strict=True) if not state]
        return min(on) / max(off) if on and off else math.inf


def _sums(levels: Levels, names: Sequence[str]) -> list[float]:
    return [sum(each) for each in zip(*(levels[name] for name in names), strict=True)]


def _distance(a: Gate, b: Gate) -> float:
    """How much two responses differ: 0 for the same gate."""
    if a.name == b.name:
        return 0.0
    pairs = ((a.ymax, b.ymax), (a.ymin, b.ymin), (a.K, b.K), (a.n, b.n))
    return sum(math.log(x / y) ** 2 for x, y in pairs) + 1e-9  # after the gate itself
