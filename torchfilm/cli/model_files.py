"""Scenes of models in SBML or Antimony: a colony that grows freely, with the model in its cells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchfilm import scenes
from torchfilm.circuits import sbml
from torchfilm.effects.circuit import Circuit
from torchfilm.scene import Scene
from torchfilm.scenes.recipes import to_plain
from torchfilm.tools import checks

SBML, ANTIMONY = (".xml", ".sbml"), (".ant", ".antimony")


def is_model(path: Path) -> bool:
    """Whether a file is a model, by its suffix."""
    return path.suffix.lower() in (*SBML, *ANTIMONY)


def scene_of_model(path: Path, parameters: dict[str, Any]) -> Scene:
    """A colony of `microcolony` with the circuit of a model. parameters: values for its constants,
    first values of its variables, and options of `Circuit.from_sbml`. Raises InputError for a
    model that cannot be read, or that has signals."""
    if "signals" in parameters:
        raise checks.input_error(
            "--set",
            "signals=…",
            "left out",
            "A signal needs a medium: write a Python file with tf.Circuit.from_sbml and tf.Medium.",
        )
    variables = _circuit(path, {}).species
    initial = {n: x for n, x in parameters.items() if n in variables}
    others = {n: x for n, x in parameters.items() if n not in variables}
    circuit = _circuit(path, {**others, "initial": initial})
    colony = scenes.microcolony()
    made = Scene(*colony.effects, circuit, dt=colony.dt)
    return made.replace(name=path.stem, settings=to_plain(parameters))


def _circuit(path: Path, options: dict[str, Any]) -> Circuit:
    if path.suffix.lower() in SBML:
        return Circuit.from_sbml(path, **options)
    return Circuit.from_antimony(sbml.decoded(sbml.read_bytes(path), str(path)), **options)
