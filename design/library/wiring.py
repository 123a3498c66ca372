"""A wiring of gates whose repressors a search chooses: its parameters, its circuit, its parts."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import torch

import torchfilm as tf
from design.library.assignment import Assigner
from design.library.devices import Gate, Part, Reporter, SensorDevice, Unit
from design.parameters import Choice
from design.scene_family import UnfitDesign
from torchfilm import checks

OUTSIDE = "out."
RESPONSE = ("ymax", "ymin", "K", "n")
# The gates of a design, one name for each place of the wiring; or one list per place, with a name
# for each colony.
Gates = Mapping[str, str | Sequence[str]]


@dataclass(frozen=True)
class Sensor(metaclass=checks.KnownKeywords):
    """An input of a wiring: a promoter that follows a signal or a species s, with the activity
    ymin + (ymax − ymin) · sʰ/(halfʰ + sʰ) RPU, h = power.

    reads: "out.NAME" is the signal NAME just outside the cell; a plain name is the field of a
    species of another circuit of the scene, such as "lux_ahl" of `Circuit(…, name="lux")`.
    device: the sensor, by its name in the library, or a `SensorDevice` with ymin and ymax. half:
    the concentration of s at which it is half on. Raises InputError for values that are not
    allowed.
    """

    reads: str
    device: str | SensorDevice
    _: KW_ONLY
    half: float
    power: float = 2.0

    def __post_init__(self) -> None:
        if not isinstance(self.reads, str) or not self.reads.removeprefix(OUTSIDE).isidentifier():
            rule = 'a signal such as "out.ahl", or a species of another circuit'
            raise checks.input_error("Sensor.reads", self.reads, rule)
        if not isinstance(self.device, (str, SensorDevice)):
            rule = "a sensor's name in the library, or a SensorDevice"
            raise checks.input_error("Sensor.device", self.device, rule)
        checks.number("Sensor.half", self.half, above=0.0)
        checks.number("Sensor.power", self.power, least=1.0)


@dataclass(frozen=True)
class PartsList:
    """The DNA parts of a design in order. units: for each gene its name in the wiring, what it is,
    and its transcription units. Prints as text."""

    units: tuple[tuple[str, str, tuple[tuple[Part, ...], ...]], ...]

    def __str__(self) -> str:
        lines = []
        for place, what, units in self.units:
            lines.append(f"{place} = {what}")
            for unit in units:
                lines += [f"  {part.kind:<12}{part.name}" for part in unit]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False, repr=False)
class Wiring:
    """A wiring of NOR gates, to be filled with gates of a library. `Library.wiring` makes it.

    sensors: by input; growth, loss (1/h): see `circuit`. A design is a mapping with the name of a
    gate for each place; `gates` says which gates it stands for.
    """

    assigner: Assigner
    sensors: Mapping[str, Sensor]
    growth: float
    loss: float

    def __repr__(self) -> str:
        of = ", ".join(f"{place} = {self.assigner.netlist.words(place)}" for place in self.places)
        return f"Wiring({len(self.places)} gates: {of}; {len(self.assigner.gates)} to choose from)"

    @property
    def places(self) -> tuple[str, ...]:
        """The gates of the wiring that a design fills, in order."""
        return tuple(self.assigner.netlist.genes)

    @property
    def parameters(self) -> list[Choice]:
        """For a `Search`: at each place, one of the gates of the library."""
        options = [gate.name for gate in self.assigner.gates]
        return [
            Choice(place, options, per_colony=True, resolve=self.resolve) for place in self.places
        ]

    def resolve(self, design: Mapping[str, Any]) -> dict[str, str]:
        """The names of the gates that a design stands for. It may hold other values, too."""
        return {place: gate.name for place, gate in self.gates(design).items()}

    def gates(self, design: Mapping[str, str]) -> dict[str, Gate]:
        """The gate at each place. Each repressor is used once, and levels fit: the wished gate, or
        the most similar one that is free and fits (`Assigner.assign`)."""
        return self.assigner.assign(self._wishes(design))

    def levels(self, design: Mapping[str, str]) -> str:
        """A table of the levels at steady state in each state of the inputs, RPU: the activity of
        each promoter, and the level of the output."""
        netlist, chosen = self.assigner.netlist, self.gates(design)
        self._warn_of_others(design, chosen)
        found = self.assigner.levels(chosen)
        names = [*netlist.inputs, *self.places, netlist.output]
        titles = [*names[: len(netlist.inputs)], *(chosen[p].name for p in self.places), names[-1]]
        width = max(9, *(len(t) + 1 for t in titles))
        lines = ["".join(f"{t:>{width}}" for t in titles)]
        for k in range(len(netlist.rows)):
            lines.append("".join(f"{found.outputs[n][k]:>{width}.3g}" for n in names))
        return "\n".join([*lines, f"contrast {self.assigner.output_contrast(found):.3g}"])

    def parts(self, design: Mapping[str, str]) -> PartsList:
        """The DNA parts of a design: for each gene the promoters in front of it, then what the
        library lists, such as ribozyme, RBS, coding sequence and terminator."""
        netlist, chosen = self.assigner.netlist, self.gates(design)
        self._warn_of_others(design, chosen)
        promoters: dict[str, tuple[Part, ...]] = {
            name: device.promoters or (Part("promoter", device.name),)
            for name, device in self.assigner.sensors.items()
        } | {place: gate.promoters for place, gate in chosen.items()}
        uses = dict.fromkeys(promoters, 0)
        out = []
        for place, read in netlist.promoters.items():
            front = []
            for name in read:
                copies = promoters[name]
                front.append(copies[uses[name] % len(copies)])
                uses[name] += 1
            gene: Gate | Reporter = chosen.get(place) or self.assigner.reporter
            words = f"{gene.name}: {netlist.words(place)}"
            out.append((place, words, _filled(gene.units, front)))
        return PartsList(tuple(out))

    def circuit(self, gates: Gates, *, rtol: float = 1e-4) -> tf.Circuit:
        """The circuit of a design, or of one design for each colony.

        The species of a place is its repressor r, as the promoter activity that maintains it, RPU:
        the promoter that it represses has the activity ymin + (ymax − ymin)/(1 + (r/K)ⁿ) at once.
        With x the sum of the promoters in front of the gene, dr/dt = (growth + loss) · x − loss ·
        r, and growth dilutes r besides (`tf.Circuit`). So in cells that grow at the rate `growth`
        r settles at x, as the response functions of the library assume, with the time constant
        1/(growth + loss). The output behaves alike. First levels are those without input. Raises
        `UnfitDesign` where the output's levels cannot be told apart.
        """
        designs, each = self._designs(gates)
        chosen = [self.gates(design) for design in designs]
        for wished, design in zip(designs, chosen, strict=True):
            self._check_fit(design)
            self._warn_of_others(wished, design)
        column = lambda numbers: (
            numbers[0]
            if each is None
            else torch.tensor([numbers[k] for k in each], dtype=torch.float64)
        )
        constants: dict[str, Any] = {"growth": self.growth, "loss": self.loss}
        for place in self.places:
            for name in RESPONSE:
                numbers = [getattr(design[place], name) for design in chosen]
                constants[f"{name}_{place}"] = column(numbers)
        for name, sensor in self.sensors.items():
            device = self.assigner.sensors[name]
            of_input = (device.ymax, device.ymin, sensor.half, sensor.power)
            constants |= {f"{r}_{name}": x for r, x in zip(RESPONSE, of_input, strict=True)}
        netlist, off = self.assigner.netlist, [(False,) * len(self.sensors)]
        first = [self.assigner.levels(design, off) for design in chosen]
        initial = {place: column([f.inputs[place][0] for f in first]) for place in self.places}
        initial[netlist.output] = column([f.outputs[netlist.output][0] for f in first])
        reads = dict.fromkeys(s.reads for s in self.sensors.values())
        shared = tuple(name for name in reads if not name.startswith(OUTSIDE))
        return tf.Circuit(
            self._rates(),
            species=(*self.places, netlist.output),
            initial=initial,
            shared=shared,
            rtol=rtol,
            **constants,
        )

    def _warn_of_others(self, design: Mapping[str, str], chosen: Mapping[str, Gate]) -> None:
        """Warn of gates that others stand in for."""
        other = [f"{n} = {chosen[n].name}" for n in self.places if chosen[n].name != design[n]]
        if other:
            checks.warn(
                f"the gates {', '.join(design[n] for n in self.places)} would use a repressor"
                f" twice, or their levels would not fit: {', '.join(other)}"
                f" stand{'s' if len(other) == 1 else ''} in. resolve(design) gives those in use."
            )

    def _rates(self) -> Callable[..., dict[str, Any]]:
        netlist, scale = self.assigner.netlist, self.assigner.reporter.scale
        sensors = self.sensors

        def rates(u, s, p, cell):
            activity: dict[str, Any] = {}
            for name, sensor in sensors.items():
                outside = sensor.reads.startswith(OUTSIDE)
                read = s[sensor.reads.removeprefix(OUTSIDE)] if outside else u[sensor.reads]
                on = tf.kinetics.activation(read, p[f"K_{name}"], p[f"n_{name}"])
                activity[name] = p[f"ymin_{name}"] + (p[f"ymax_{name}"] - p[f"ymin_{name}"]) * on
            for place in netlist.genes:
                ymin, ymax = p[f"ymin_{place}"], p[f"ymax_{place}"]
                free = tf.kinetics.repression(u[place], p[f"K_{place}"], p[f"n_{place}"])
                activity[place] = ymin + (ymax - ymin) * free
            out = {}
            for gene, promoters in netlist.promoters.items():
                total = functools.reduce(operator.add, (activity[name] for name in promoters))
                made = (p.growth + p.loss) * total
                made = made * scale if gene == netlist.output and scale != 1.0 else made
                out[gene] = made - p.loss * u[gene]
            return out

        return rates

    def _designs(self, gates: Gates) -> tuple[list[dict[str, str]], list[int] | None]:
        """The different designs, and the number of each colony's; None: one design for all."""
        self._check_places(gates)
        if odd := [name for name in gates if name not in self.places]:
            raise checks.input_error("gates", odd[0], "one of " + ", ".join(self.places))
        if all(isinstance(name, str) for name in gates.values()):
            return [{place: str(gates[place]) for place in self.places}], None
        lengths = {len(names) for names in gates.values() if not isinstance(names, str)}
        if len(lengths) > 1 or 0 in lengths:
            raise checks.input_error("gates", gates, "lists with one name for each colony")
        (count,) = lengths
        rows = [
            tuple(names if isinstance(names, str) else names[k] for names in self._ordered(gates))
            for k in range(count)
        ]
        different = list(dict.fromkeys(rows))
        number = {row: k for k, row in enumerate(different)}
        designs = [dict(zip(self.places, row, strict=True)) for row in different]
        return designs, [number[row] for row in rows]

    def _ordered(self, gates: Gates) -> list[str | Sequence[str]]:
        return [gates[place] for place in self.places]

    def _check_places(self, design: Mapping[str, Any]) -> None:
        for place in self.places:
            if place not in design:
                rule = "a gate for each of " + ", ".join(self.places)
                raise checks.input_error("gates", dict(design), rule, f"{place!r} is missing.")

    def _wishes(self, design: Mapping[str, str]) -> dict[str, Gate]:
        self._check_places(design)
        by_name = {gate.name: gate for gate in self.assigner.gates}
        for place in self.places:
            name = design[place]
            if name not in by_name:
                near = checks.nearest(str(name), by_name)
                hint = f"Did you mean {near!r}?" if near else ""
                rule = "a gate of the library: " + ", ".join(by_name)
                raise checks.input_error(f"gates[{place!r}]", name, rule, hint)
        return {place: by_name[design[place]] for place in self.places}

    def _check_fit(self, chosen: Mapping[str, Gate]) -> None:
        found = self.assigner.output_contrast(self.assigner.levels(chosen))
        if found < self.assigner.contrast:
            names = ", ".join(f"{place} = {gate.name}" for place, gate in chosen.items())
            raise UnfitDesign(
                f"with {names} the levels of {self.assigner.netlist.output} cannot be told apart:"
                f" on is {found:.3g} times off, and contrast = {self.assigner.contrast:g} is the"
                " least. Choose other gates, or lower contrast."
            )


def _filled(units: Sequence[Unit], front: Sequence[Part]) -> tuple[tuple[Part, ...], ...]:
    """Transcription units with the promoters in front of them. A gene with one promoter lacks the
    second place, and a unit that has only that place."""
    out = []
    for unit in units:
        wanted = [part for part in unit if isinstance(part, int)]
        if wanted and not any(k < len(front) for k in wanted):
            continue
        parts = [
            front[p] if isinstance(p, int) else p
            for p in unit
            if not isinstance(p, int) or p < len(front)
        ]
        out.append(tuple(parts))
    return tuple(out)
