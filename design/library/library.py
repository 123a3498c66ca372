"""A library of gates, from files in the UCF format of Cello."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torchfilm as tf
from design.library.assignment import Assigner
from design.library.devices import (
    Gate,
    Part,
    Reporter,
    SensorDevice,
    read_gate,
    read_reporter,
    read_sensor,
)
from design.library.logic import Netlist, netlist
from design.library.ucf import Record, Records
from design.library.wiring import Sensor, Wiring
from torchfilm import checks, displays


def _read_gate(records: Records, gate: Record) -> Gate:
    try:
        return read_gate(records, gate)
    except tf.InputError as error:
        where = "" if str(error).startswith(gate.where) else f"{gate.where}: "
        raise tf.InputError(
            f"{where}{error} Library.read(file, gates=(…)) reads the gates that are named,"
            " without the others."
        ) from error


@dataclass(frozen=True, repr=False)
class Library:
    """Gates with their parts, input sensors and reporters, by name.

    library = Library.read("Eco1C1G1T1.UCF.json")
    wiring = library.wiring("0110", inputs={"a": Sensor(…), "b": Sensor(…)}, output="yfp")
    """

    gates: Mapping[str, Gate]
    sensors: Mapping[str, SensorDevice]
    reporters: Mapping[str, Reporter]

    def __repr__(self) -> str:
        groups = len({gate.group for gate in self.gates.values()})
        return (
            f"Library({len(self.gates)} gates of {groups} repressors, {len(self.sensors)} input"
            f" sensors, {len(self.reporters)} output devices)"
        )

    def _repr_html_(self) -> str:
        rows = [(g.name, g.group, g.ymin, g.ymax, g.K, g.n) for g in self.gates.values()]
        head = ("gate", "repressor", "ymin, RPU", "ymax, RPU", "K, RPU", "n")
        levels = [(s.name, s.ymin, s.ymax) for s in self.sensors.values()]
        return displays.card(
            repr(self),
            displays.table(rows, head),
            displays.table(levels, ("input sensor", "ymin, RPU", "ymax, RPU")) if levels else "",
            displays.lines(
                "output devices: " + ", ".join(self.reporters) if self.reporters else ""
            ),
        )

    @classmethod
    @checks.known_keywords
    def read(cls, *files: str | Path, gates: Sequence[str] | None = None) -> Library:
        """Read a library from its files: version 1, or version 2 with its files for inputs and
        outputs. gates: the names of those to read, all by default.

        Raises InputError for a file that is missing, truncated or no library, for a field or
        parameter that is missing or unknown (with the gate's name), and for a response that is not
        modelled, not positive, or does not fall with its input.
        """
        if not files:
            raise checks.input_error("file", files, "one file or more")
        records = Records([checks.file_path("file", file) for file in files])
        there = records.all("gates")
        if not there:
            hint = "A UCF has the collection 'gates'; files of inputs and outputs come with it."
            raise checks.input_error("file", records.files, "a library with gates", hint)
        if isinstance(gates, str):
            raise checks.input_error("gates", gates, "a tuple of names", f"gates=({gates!r},).")
        for name in gates or ():
            if name not in there:
                near = checks.nearest(str(name), there)
                hint = f"Did you mean {near!r}?" if near else ""
                rule = f"a gate of {records.files}: {', '.join(there)}"
                raise checks.input_error("gates", name, rule, hint)
        chosen = there if gates is None else {name: there[name] for name in gates}
        read = lambda make, found: {name: make(records, r) for name, r in found.items()}
        return cls(
            {name: _read_gate(records, record) for name, record in chosen.items()},
            read(read_sensor, records.all("input_sensors")),
            read(read_reporter, records.all("output_devices")),
        )

    @checks.known_keywords
    def wiring(
        self,
        logic: str | Mapping[str, Sequence[str]],
        *,
        inputs: Mapping[str, Sensor],
        output: str,
        reporter: str | None = None,
        contrast: float = 5.0,
        growth: float = 1.0,
        loss: float = 0.0,
    ) -> Wiring:
        """A wiring of NOR gates, to be filled by a search.

        logic: a truth table, the output for each state of the inputs in the order of counting, the
        first input being the highest digit: "0110" is their XOR, and "-" stands for a state that
        never occurs; or the promoters in front of each gene: {"g1": ["a"], "g2": ["b", "g1"],
        "yfp": ["g2"]}. Promoters are inputs or gates; a gate is on where no promoter in front of it
        is, the output where one is. inputs: by name. output: the species that is seen. reporter:
        the output device of the library; by default its only one, or else a gene named `output`.
        contrast: the least ratio of levels that are on to levels that are off, at steady state,
        behind each gate and at the output. growth: the cells' growth rate (1/h) at which levels
        settle as the library says; loss: degradation of all proteins (1/h), which makes the circuit
        faster: its time constant is 1/(growth + loss). Raises InputError for a wiring that is not
        allowed, unknown inputs, and too few repressors.
        """
        if not isinstance(output, str) or not output.isidentifier():
            raise checks.input_error("output", output, 'the name of a species, such as "yfp"')
        if not isinstance(inputs, Mapping) or not inputs:
            raise checks.input_error("inputs", inputs, 'sensors by name, {"a": Sensor(…)}')
        devices = {name: self._sensor(name, sensor) for name, sensor in inputs.items()}
        wired = netlist(logic, tuple(inputs), output)
        self._check_number(wired)
        assigner = Assigner(
            wired,
            tuple(self.gates.values()),
            devices,
            self._reporter(output, reporter),
            checks.number("contrast", contrast, least=1.0),
        )
        return Wiring(
            assigner,
            dict(inputs),
            checks.number("growth", growth, above=0.0),
            checks.number("loss", loss, least=0.0),
        )

    def _sensor(self, name: str, sensor: object) -> SensorDevice:
        if not isinstance(sensor, Sensor):
            rule = 'a Sensor, such as Sensor("out.ahl", "LuxR_sensor", half=0.1)'
            raise checks.input_error(f"inputs[{name!r}]", sensor, rule)
        if isinstance(sensor.device, SensorDevice):
            return sensor.device
        if sensor.device not in self.sensors:
            near = checks.nearest(sensor.device, self.sensors)
            hint = f"Did you mean {near!r}? " if near else ""
            there = ", ".join(self.sensors) or "it has none"
            raise checks.input_error(
                f"inputs[{name!r}].device",
                sensor.device,
                f"an input sensor of the library: {there}",
                hint + "Read the library's file of inputs too, or give a SensorDevice.",
            )
        return self.sensors[sensor.device]

    def _reporter(self, output: str, name: str | None) -> Reporter:
        if name is None:
            own = Reporter(output, 1.0, ((0, 1, Part("cds", output)),))
            return next(iter(self.reporters.values())) if len(self.reporters) == 1 else own
        if name not in self.reporters:
            rule = "an output device of the library: " + (", ".join(self.reporters) or "none")
            raise checks.input_error("reporter", name, rule)
        return self.reporters[name]

    def _check_number(self, wired: Netlist) -> None:
        groups = dict.fromkeys(gate.group for gate in self.gates.values())
        if len(groups) < len(wired.genes):
            raise checks.input_error(
                "logic",
                wired.describe(),
                f"a wiring of at most {len(groups)} gates",
                f"It needs {len(wired.genes)} repressors, and the library has {len(groups)}:"
                f" {', '.join(groups)}.",
            )
