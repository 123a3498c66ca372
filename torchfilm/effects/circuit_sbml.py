"""Circuits from models in SBML and Antimony, and back. Imported where a model is read or written:
a program that does neither starts sooner."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchfilm.circuits import sbml
from torchfilm.circuits.names import label_of, unknown
from torchfilm.effects.circuit_checks import DIRECT, GEOMETRY, LEAP, READ_BY_OTHERS
from torchfilm.parameters import shorten
from torchfilm.state import RESERVED
from torchfilm.tools import checks
from torchfilm.values import ByType

if TYPE_CHECKING:
    from torchfilm.effects.circuit import Circuit

SHAPE = ("length", "radius")


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
    if not isinstance(dilution, (bool, str)) and not (
        isinstance(dilution, (list, tuple)) and all(isinstance(n, str) for n in dilution)
    ):
        hint = "A rate of dilution is an option of to_sbml alone; here growth sets it."
        raise checks.input_error("dilution", dilution, "True, False, or names of species", hint)
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
        molecules=keywords.get("method") in (DIRECT, LEAP),
        options=options,
        fields=(*RESERVED, *GEOMETRY, *READ_BY_OTHERS),
    )


def written_numbers(
    circuit: Circuit,
    cell_type: int | None,
    initial: Mapping[str, float],
    values: Mapping[str, float],
) -> tuple[dict[str, float], dict[str, float]]:
    """First values and constants for a model to write, by name: those given in place of the
    circuit's own. Raises InputError that names all of which there is not one number."""
    found: list[dict[str, float]] = []
    lacking: list[dict[str, str]] = []
    for what, own, given, names, least in (
        ("initial", circuit.initial, initial, circuit.species, 0.0),
        ("constant", circuit.parameters, values, tuple(circuit.parameters), -math.inf),
    ):
        for name, value in given.items():
            if name not in names:
                wrong = f"{what} {name!r} is not in the circuit"
                raise checks.InputError(unknown(wrong, name, names))
            checks.number(f"{what} {name!r}", _number_of(value, cell_type), least=least)
        each = {n: _number_of(given.get(n, own.get(n, 0.0)), cell_type) for n in names}
        numbers = {n: x for n, x in each.items() if isinstance(x, (int, float))}
        found.append({n: float(x) for n, x in numbers.items() if not isinstance(x, bool)})
        lacking.append({n: shorten(x) for n, x in each.items() if n not in found[-1]})
    if any(lacking):
        first, constants = lacking
        shown = [f"initial {n!r} = {x}" for n, x in first.items()]
        shown += [f"constant {n!r} = {x}" for n, x in constants.items()]
        give = [f"initial={{{', '.join(f'{n!r}: …' for n in first)}}}"] if first else []
        raise checks.InputError(
            f"{', '.join(shown)} cannot be written: a model has one number for each. Give"
            f" {', '.join([*give, *(f'{n}=…' for n in constants)])}."
        )
    return found[0], found[1]


def _number_of(value: Any, cell_type: int | None) -> Any:
    """The number that a value is for the cells of a type; or the value, if it is none."""
    if isinstance(value, ByType) and cell_type is not None:
        value = value.values.get(cell_type, value)
    return value.item() if isinstance(value, Tensor) and value.numel() == 1 else value


def write_file(
    path: str | Path,
    circuit: Circuit,
    cell_type: int | None,
    initial: Mapping[str, float],
    dilution: float | None,
    cell: Mapping[str, float],
    values: Mapping[str, float],
) -> None:
    """Write a circuit's equations as an SBML model; see `Circuit.to_sbml`."""
    kinds = [kind for kind in circuit.rates if isinstance(kind, int)]
    if kinds:
        if cell_type is None:
            raise checks.InputError(
                f"{circuit.value_owner()} has rates by cell type: say whose a model is to have,"
                f" with cell_type={' or '.join(map(str, kinds))}."
            )
        checks.choice("cell_type", cell_type, tuple(circuit.rates))
        graph, part = circuit.graphs[cell_type], circuit.rates[cell_type]
    else:  # rates that all cells have
        if cell_type is not None:
            _check_type(cell_type, circuit)
        graph, part = circuit.graph, next(iter(circuit.rates.values()))
    if circuit.shared:
        raise checks.InputError(
            f"{circuit.value_owner()} shares species of another circuit, so it is no whole model:"
            " write a circuit that has them all."
        )
    diluted = [n for n in circuit.species if circuit.variables[n] in circuit.diluted_fields]
    if dilution is not None:
        graph = graph.diluted(diluted, checks.number("dilution", dilution, least=0.0))
        diluted = []
    text = sbml.sbml_text(
        graph,
        circuit.name or label_of(part),
        *written_numbers(circuit, cell_type, initial, values),
        [n for n in circuit.species if n not in diluted],
        _numbers_of_cell(sbml.read_of_cell(sbml.names_read(graph)), cell),
    )
    sbml.write(path, text)


def _check_type(cell_type: int, circuit: Circuit) -> None:
    """Raise InputError for a type by which no number of a circuit goes."""
    values = (*circuit.parameters.values(), *circuit.initial.values())
    known = sorted({kind for x in values if isinstance(x, ByType) for kind in x.values})
    if not known:
        rule = "left out: nothing in the circuit goes by the type of cells"
        raise checks.input_error("cell_type", cell_type, rule)
    checks.choice("cell_type", cell_type, tuple(known))


def _numbers_of_cell(names: Sequence[str], given: Mapping[str, float]) -> dict[str, float]:
    """What rates read of a cell, by name: numbers that are given, or those of a usual cell. Raises
    InputError for names that are not read, and where a number is missing."""
    if not isinstance(given, Mapping):
        raise checks.input_error("cell", given, 'numbers by name, such as {"growth_rate": 1.0}')
    for name, value in given.items():
        if name in ("volume", "area"):
            raise checks.input_error("cell", name, "left out: it follows from length and radius")
        if name not in (*names, *SHAPE):
            known = [*names, *SHAPE]
            raise checks.InputError(unknown(f"cell.{name} is not read by the rates", name, known))
        checks.number(f"cell[{name!r}]", value)
    shape = {n: given[n] for n in SHAPE if n in given}
    found = {**sbml.usual_cell(**shape), **given}
    if lacking := [n for n in names if n not in found]:
        give = ", ".join(f"{n!r}: …" for n in lacking)
        raise checks.InputError(
            f"the rates read {', '.join(f'cell.{n}' for n in lacking)}, and a model has one number"
            f" for each: give cell={{{give}}}."
        )
    return {n: float(found[n]) for n in (*names, "volume")}
