"""Circuits from models in SBML and Antimony, and back. Imported where a model is read or written:
a program that does neither starts sooner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchfilm.circuits import sbml
from torchfilm.circuits.names import label_of, unknown
from torchfilm.effects.circuit_checks import GEOMETRY
from torchfilm.state import RESERVED
from torchfilm.tools import checks

if TYPE_CHECKING:
    from torchfilm.effects.circuit import Circuit


def read_file(path: str | Path) -> tuple[str, str]:
    """The text of an SBML file and what to call it in messages. Raises InputError for what is no
    path, and for a file in Antimony."""
    if not isinstance(path, (str, Path)):
        raise checks.input_error("path", path, "the path of an SBML file")
    if isinstance(path, str) and ("\n" in path or path.lstrip().startswith("<")):
        of_text = "Circuit.from_antimony(text) reads text"
        hint = of_text if sbml.looks_like_antimony(path) else "save the text in a file"
        raise checks.InputError(
            f"Circuit.from_sbml takes the path of a file, and not its text, which begins"
            f" {sbml.shortened(path, 40)!r}: {hint}."
        )
    text = sbml.decoded(sbml.read_bytes(path), str(path))
    if sbml.looks_like_antimony(text):
        raise checks.InputError(
            f"{path} is no SBML: it looks like Antimony, which"
            f" Circuit.from_antimony(Path({str(path)!r})) reads."
        )
    return text, str(path)


def read_antimony(text: str | Path) -> tuple[str, str]:
    """A model in Antimony, as text or a file, in SBML, and what to call it in messages."""
    if not isinstance(text, (str, Path)):
        raise checks.input_error("text", text, "a model in Antimony, or the Path of its file")
    where = str(text) if isinstance(text, Path) else "the Antimony text"
    if isinstance(text, Path):
        text = sbml.decoded(sbml.read_bytes(text), where)
    return sbml.antimony_to_sbml(text, where), where


def keywords(
    text: str, where: str, choices: sbml.Given, dilution: bool | Sequence[str], options: Mapping
) -> dict[str, Any]:
    """A circuit's keywords for a model in SBML. options: those of a circuit, among others."""
    found = sbml.describe(text, where, choices)
    return {
        "rates": found.rates,
        "species": found.species,
        "initial": found.initial,
        "dilution": found.diluted if dilution is True else dilution,
        **{n: x for n, x in options.items() if n in choices.options},
        **found.parameters,
    }


def model_choices(
    signals: Sequence[str] | Mapping[str, str],
    properties: Mapping[str, str] | None,
    without: Sequence[str],
    time_unit: str | None,
    initial: Mapping[str, Any] | None,
    keywords: Mapping[str, Any],
    options: Sequence[str],
) -> sbml.Given:
    """What a user says of a model to read; `options` are keywords of a circuit."""
    if not isinstance(signals, Mapping):
        signals = {n: n for n in ((signals,) if isinstance(signals, str) else signals)}
    for name in ("species", "rates"):
        if name in keywords:
            raise checks.input_error(f"Circuit.{name}", keywords[name], "left to the model")
    for name, given in (("properties", properties), ("initial", initial)):
        if given is not None and not isinstance(given, Mapping):
            raise checks.input_error(name, given, "a dict by ids of the model")
    return sbml.Given(
        signals=signals,
        properties=properties or {},
        without=(without,) if isinstance(without, str) else tuple(without),
        time_unit=time_unit,
        values={n: x for n, x in keywords.items() if n not in options},
        initial=initial or {},
        options=options,
        fields=(*RESERVED, *GEOMETRY),
    )


def written_numbers(
    what: str, values: Mapping[str, Any], given: Mapping[str, float], names: Sequence[str]
) -> dict[str, float]:
    """Numbers by name for a model to write: those given in place of the circuit's own."""
    for name in given:
        if name not in names:
            raise checks.InputError(unknown(f"{what} {name!r} is not in the circuit", name, names))
    found = {}
    for name in names:
        value = given.get(name, values.get(name, 0.0))
        if isinstance(value, Tensor) and value.numel() == 1:
            value = value.item()
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            hint = f"initial={{{name!r}: …}}" if what == "initial" else f"{name}=…"
            raise checks.input_error(
                f"{what} {name!r}", value, "one number to be written", f"Give it: {hint}."
            )
        found[name] = float(value)
    return found


def write_file(
    path: str | Path,
    circuit: Circuit,
    cell_type: int | None,
    initial: Mapping[str, float],
    values: Mapping[str, float],
) -> None:
    """Write a circuit's equations as an SBML model; see `Circuit.to_sbml`."""
    if cell_type is None:
        graph, part = circuit.graph, next(iter(circuit.rates.values()))
    else:
        checks.choice("cell_type", cell_type, tuple(circuit.rates))
        graph, part = circuit.graphs[cell_type], circuit.rates[cell_type]
    if circuit.shared:
        raise checks.InputError(
            f"{circuit.value_owner()} shares species of another circuit, so it is no whole model:"
            " write a circuit that has them all."
        )
    text = sbml.sbml_text(
        graph,
        circuit.name or label_of(part),
        written_numbers("initial", circuit.initial, initial, circuit.species),
        written_numbers("constant", circuit.parameters, values, tuple(circuit.parameters)),
        [n for n in circuit.species if circuit.variables[n] not in circuit.diluted_fields],
    )
    sbml.write(path, text)
