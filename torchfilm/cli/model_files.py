"""Scenes of models in SBML or Antimony: a colony that grows freely, with the model in its cells."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchfilm import scenes
from torchfilm.circuits import ANTIMONY_FILES, SBML_FILES
from torchfilm.effects.circuit import OPTION_NAMES, Circuit
from torchfilm.scene import Scene
from torchfilm.scenes.recipes import to_plain
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError

# What messages of `Circuit.from_sbml` tell to give, and the same on the command line.
IN_A_SHELL = (
    (re.compile(r"initial=\{'(\w+)': …\}"), r"--set \1=…"),
    (re.compile(r"initial=\{…\}"), "--set NAME=…"),
    (re.compile(r"(?<=give )(\w+=…)"), r"--set \1"),
    (re.compile(r"(?<=as )time_unit='(\w+)' or .*'"), r"--set time_unit=\1 (or min, h, day)"),
    (re.compile(r"(?<=such as )(properties=\{.*\})"), r"--set '\1'"),
)


def is_model(path: Path) -> bool:
    """Whether a file is a model, by its suffix."""
    return path.suffix.lower() in (*SBML_FILES, *ANTIMONY_FILES)


def scene_of_model(path: Path, parameters: dict[str, Any]) -> Scene:
    """A colony of `microcolony` with the circuit of a model. parameters: values for its constants,
    first values of its variables, and options of `Circuit.from_sbml`. Raises InputError for a
    model that cannot be read, or that has signals."""
    if "signals" in parameters:
        raise checks.input_error("--set", "signals=…", "left out", _needs_a_medium(path))
    if "initial" in parameters:
        hint = "Give each first value by its name: --set NAME=VALUE."
        raise checks.input_error("--set", "initial=…", "left out", hint)
    with _words_of_the_shell():
        circuit = _circuit(path, parameters)
    signals = circuit.graph.signals
    if signals:
        names = ", ".join(map(repr, signals))
        raise InputError(f"{path} has signals ({names}). {_needs_a_medium(path, signals)}")
    colony = scenes.microcolony()
    made = Scene(*colony.effects, circuit, dt=colony.dt)
    return made.replace(name=path.stem, settings=to_plain(parameters))


def _circuit(path: Path, parameters: dict[str, Any]) -> Circuit:
    from torchfilm.circuits import sbml
    from torchfilm.effects import circuit_sbml

    of_sbml = path.suffix.lower() in SBML_FILES
    model = circuit_sbml.read_file(path) if of_sbml else circuit_sbml.read_antimony(path)
    choices = circuit_sbml.model_choices(
        (),
        parameters.get("properties"),
        parameters.get("without", ()),
        parameters.get("time_unit"),
        None,
        {},
        OPTION_NAMES,
    )
    variables = sbml.variable_names(*model, choices)
    initial = {n: x for n, x in parameters.items() if n in variables}
    others = {n: x for n, x in parameters.items() if n not in variables}
    read = Circuit.from_sbml if of_sbml else Circuit.from_antimony
    return read(path, initial=initial, **others)


def _needs_a_medium(path: Path, signals: Collection[str] = ()) -> str:
    """What to do with a model that has signals; by its own annotation, if they are given."""
    given = repr(str(path))
    of_sbml = path.suffix.lower() in SBML_FILES
    reader = f"from_sbml({given}" if of_sbml else f"from_antimony(Path({given})"
    media = ", ".join(f"{n}=tf.Signal(…)" for n in signals or ("NAME",))
    return (
        f"A signal needs a medium: write a Python file with tf.Circuit.{reader}"
        f"{')' if signals else ', signals=…)'} and tf.Medium({media})."
    )


@contextmanager
def _words_of_the_shell() -> Iterator[None]:
    """What a message tells to give becomes an option of the command line."""
    try:
        yield
    except InputError as error:
        said = str(error)
        for pattern, words in IN_A_SHELL:
            said = pattern.sub(words, said)
        raise InputError(said) from error
