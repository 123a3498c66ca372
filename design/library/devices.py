"""What a library holds: gates, input sensors and output devices, each with its response function
and its DNA parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from design.library.ucf import Record, Records, same_equation
from torchfilm import checks

HILL = "ymin + (ymax - ymin) / (1.0 + (x / K)^n)"
SWITCH = "$STATE * (ymax - ymin) + ymin"
LINEAR = "c * x"
SUM = "x1 + x2"
NOT_MODELLED = {
    "t1 * x2 + x1": "interference of promoters in tandem",
    "a/x^b": "a response that has no upper level",
}
# parameters of a gate that no response function here reads: interference in tandem, kinetics
OTHERS = ("a", "b", "alpha", "beta", "tau_on", "tau_off")
GATE_TYPES = ("NOR", "NOT")


@dataclass(frozen=True)
class Part:
    """A DNA part. kind: such as "promoter" or "cds"; sequence: its bases, or ""."""

    kind: str
    name: str
    sequence: str = ""


# Parts of one transcription unit in order; a number k stands for the promoter of input k.
Unit = tuple[Part | int, ...]


@dataclass(frozen=True)
class Gate:
    """A NOR gate: a repressor and the promoter that it represses.

    The promoter's activity at an input x is ymin + (ymax − ymin)/(1 + (x/K)ⁿ); activities, x and K
    in RPU (relative promoter units), n ≥ 1. group: gates of one repressor, such as variants with
    another RBS; a circuit has one of them at most. units: the transcription units that make the
    repressor. promoters: those that it represses, equal in activity; copies of a promoter take
    them in turn.
    """

    name: str
    group: str
    ymax: float
    ymin: float
    K: float
    n: float
    units: tuple[Unit, ...] = ()
    promoters: tuple[Part, ...] = ()

    def response(self, x: float) -> float:
        """The activity of the promoter at an input x, RPU."""
        # powers of numbers up to 1 do not overflow
        share = min(x / self.K, self.K / x) ** self.n if x > 0 else 0.0
        free = 1.0 / (1.0 + share) if x < self.K else share / (1.0 + share)
        return self.ymin + (self.ymax - self.ymin) * free


@dataclass(frozen=True)
class SensorDevice(metaclass=checks.KnownKeywords):
    """A promoter that something outside the circuit switches. ymax, ymin: its activity on and off,
    RPU, ymax > ymin > 0. promoters: equal ones, whose copies take turns. Raises InputError."""

    name: str
    ymax: float
    ymin: float
    promoters: tuple[Part, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise checks.input_error("SensorDevice.name", self.name, "a text")
        parts = self.promoters
        if not isinstance(parts, (list, tuple)) or not all(isinstance(p, Part) for p in parts):
            raise checks.input_error("SensorDevice.promoters", parts, "a list of parts")
        _check_levels(f"SensorDevice({self.name!r})", self.ymax, self.ymin)


@dataclass(frozen=True)
class Reporter:
    """A gene for what is seen. scale: its level for one RPU of promoter activity."""

    name: str
    scale: float = 1.0
    units: tuple[Unit, ...] = ()


def read_gate(records: Records, gate: Record) -> Gate:
    """One gate, in version 1 or 2 of the format."""
    kind = gate.data.get("gate_type", "NOR")
    if kind not in GATE_TYPES:
        raise checks.input_error(
            f"{gate.where}, gate_type", kind, "one of " + ", ".join(GATE_TYPES)
        )
    if "model" in gate.data:
        name, group = gate.text("name"), gate.text("group")
        model = records.find("models", gate.text("model"), gate)
        _check_sum(records, model)
        numbers = _function_numbers(records, model, HILL, ("ymax", "ymin", "K", "n"))
        structure = records.find("structures", gate.text("structure"), gate)
        units = _structure_units(records, structure)
        promoters = structure.texts("outputs")
    else:
        name, group = gate.text("gate_name"), gate.text("group_name")
        response = records.find("response_functions", name, gate)
        _check_equation(response, HILL)
        numbers = _pick(response, response.numbers("parameters"), ("ymax", "ymin", "K", "n"))
        structure = records.find("gate_parts", name, gate)
        cassettes = structure.inner("expression_cassettes")
        if len(cassettes) != 1:
            raise structure.error(f"a NOR gate has one expression cassette, not {len(cassettes)}.")
        parts = cassettes[0].texts("cassette_parts")
        units = ((0, 1, *(_part(records, part, structure) for part in parts)),)
        promoters = [structure.text("promoter")]
    _check_response(gate, numbers)
    out = tuple(_part(records, part, structure) for part in promoters)
    return Gate(name, group, **numbers, units=units, promoters=out)


def read_sensor(records: Records, sensor: Record) -> SensorDevice:
    """One input sensor (version 2)."""
    model = records.find("models", sensor.text("model"), sensor)
    numbers = _function_numbers(records, model, SWITCH, ("ymax", "ymin"))
    _check_levels(sensor.where, **numbers)
    structure = records.find("structures", sensor.text("structure"), sensor)
    promoters = tuple(_part(records, p, structure) for p in structure.texts("outputs"))
    return SensorDevice(sensor.text("name"), **numbers, promoters=promoters)


def read_reporter(records: Records, device: Record) -> Reporter:
    """One output device (version 2)."""
    model = records.find("models", device.text("model"), device)
    _check_sum(records, model)
    scale = _function_numbers(records, model, LINEAR, ("c",))["c"]
    checks.number(f"{device.where}, unit_conversion", scale, above=0.0)
    structure = records.find("structures", device.text("structure"), device)
    return Reporter(device.text("name"), scale, _structure_units(records, structure))


def _check_response(gate: Record, numbers: dict[str, float]) -> None:
    """Raises InputError for a response that is not positive or does not fall with its input."""
    _check_levels(gate.where, numbers["ymax"], numbers["ymin"])
    checks.number(f"{gate.where}, K", numbers["K"], above=0.0)
    hint = "The response must fall with the input, without a jump at 0."
    checks.number(f"{gate.where}, n", numbers["n"], least=1.0, hint=hint)


def _check_levels(where: str, ymax: float, ymin: float) -> None:
    checks.number(f"{where}, ymin", ymin, above=0.0)
    checks.number(f"{where}, ymax", ymax, above=ymin, hint=f"ymin is {ymin:g}.")


def _check_equation(record: Record, known: str) -> None:
    equation = record.text("equation")
    if same_equation(equation, [known]):
        return
    odd = same_equation(equation, NOT_MODELLED)
    hint = f"It states {NOT_MODELLED[odd]}, which is not modelled." if odd else ""
    raise checks.input_error(f"{record.where}, equation", equation, known, hint)


def _check_sum(records: Records, model: Record) -> None:
    """Raises InputError where the promoters in front of a gene do not add up."""
    name = model.table("functions").get("input_composition")
    if name is not None:
        _check_equation(records.find("functions", str(name), model), SUM)


def _function_numbers(
    records: Records, model: Record, equation: str, names: Sequence[str]
) -> dict[str, float]:
    """The parameters of a model's response function, by their names in its equation."""
    functions = Record(model.table("functions"), f"{model.where}, functions")
    function = records.find("functions", functions.text("response_function"), model)
    _check_equation(function, equation)
    # a function says by which name the model has each of its parameters
    maps = {p.text("name"): p.text("map").split("/")[-1] for p in function.inner("parameters")}
    called = {name: maps.get(name, name) for name in names}
    found = _pick(model, model.numbers("parameters"), list(called.values()))
    return {name: found[theirs] for name, theirs in called.items()}


def _pick(record: Record, numbers: dict[str, float], names: Sequence[str]) -> dict[str, float]:
    """The named parameters. Raises InputError where one is missing or unknown."""
    known = (*names, *OTHERS)
    for name in (*names, *numbers):
        if name not in numbers or name not in known:
            among = numbers if name not in numbers else known
            near = checks.nearest(name, [k for k in among if k not in names or k not in numbers])
            state = "is missing" if name not in numbers else "is unknown"
            hint = f" Is it {near!r}?" if near else ""
            raise record.error(
                f"the parameter {name!r} {state}.{hint} It takes {', '.join(names)}; it has"
                f" {', '.join(numbers)}."
            )
    return {name: numbers[name] for name in names}


def _part(records: Records, name: str, of: Record) -> Part:
    part = records.find("parts", name, of)
    return Part(part.text("type"), part.text("name"), str(part.data.get("dnasequence", "")))


def _structure_units(records: Records, structure: Record) -> tuple[Unit, ...]:
    """The transcription units of a structure: devices that no other device contains."""
    inputs = [f"#{entry.text('name')}" for entry in structure.inner("inputs")]
    devices = {d.text("name"): d.texts("components") for d in structure.inner("devices")}
    # a part may have the name of the device that it is in
    inside = {part for name, parts in devices.items() for part in parts if part != name}

    def expand(names: Sequence[str], within: tuple[str, ...]) -> list[Part | int]:
        out: list[Part | int] = []
        for name in names:
            if name in within and name not in records.all("parts"):
                raise structure.error(f"the device {name!r} contains itself.")
            if name in inputs:
                out.append(inputs.index(name))
            elif name.startswith("#"):
                raise structure.error(f"{name!r} is none of its inputs: {', '.join(inputs)}.")
            elif name in devices and name not in within:
                out += expand(devices[name], (*within, name))
            else:
                out.append(_part(records, name, structure))
        return out

    units = tuple(tuple(expand([name], ())) for name in devices if name not in inside)
    if not units:
        raise structure.error("every device contains itself.")
    return units
