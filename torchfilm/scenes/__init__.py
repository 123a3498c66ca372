"""Ready-made scenes: functions from parameters to a Scene. `torchfilm info NAME` describes one."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

import torch

from torchfilm.scene import Scene
from torchfilm.scenes import channels, circuits, colonies, nutrients, signalling
from torchfilm.scenes.recipes import from_plain, to_plain
from torchfilm.tools import checks


def _is_list_of_numbers(given: Any) -> bool:
    """Whether the value is a list with one number per colony."""
    return (
        isinstance(given, (list, tuple))
        and bool(given)
        and all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in given)
    )


def _accuracy_settings() -> dict[str, str]:
    """What to write in place of each accuracy setting, given as a parameter of a scene."""
    from torchfilm.tuning.settings import Settings  # only where a message needs it

    instead = "It is an accuracy setting: use --settings FILE or tf.Settings(…)."
    return {f.name: instead for f in dataclasses.fields(Settings)}


def _ready(make: Callable[..., Scene]) -> Callable[..., Scene]:
    """Store the name and the parameters in the scene, so that a results file can rebuild it."""

    @functools.wraps(make)
    def build(*args: Any, **parameters: Any) -> Scene:
        signature = inspect.signature(make)
        knobs = {} if parameters.keys() <= signature.parameters.keys() else _accuracy_settings()
        checks.check_call(make.__name__, signature, args, parameters, knobs)
        bound = signature.bind(*args, **parameters)
        bound.apply_defaults()
        # a recipe has lists, and a list times a number is not a list of products
        scene = make(
            **{
                n: torch.tensor(v, dtype=torch.float64) if _is_list_of_numbers(v) else v
                for n, v in bound.arguments.items()
            }
        )
        recipe = (make.__name__, to_plain(bound.arguments))
        return scene.replace(name=make.__name__, recipe=recipe)

    # the module where pickle finds it by name, for another process
    build.__module__ = __name__
    return build


microcolony = _ready(colonies.microcolony)
programmed_growth = _ready(colonies.programmed_growth)
channel = _ready(channels.channel)
quorum_sensing = _ready(signalling.quorum_sensing)
boundary_detector = _ready(signalling.boundary_detector)
synchronized_lysis = _ready(signalling.synchronized_lysis)
strain_sorting = _ready(colonies.strain_sorting)
random_partition = _ready(circuits.random_partition)
repressilator = _ready(circuits.repressilator)
toggle_switch = _ready(circuits.toggle_switch)
nutrient_limited = _ready(nutrients.nutrient_limited)
biofilm = _ready(nutrients.biofilm)

READY: dict[str, Callable[..., Scene]] = {
    f.__name__: f
    for f in (
        microcolony,
        programmed_growth,
        channel,
        quorum_sensing,
        boundary_detector,
        synchronized_lysis,
        strain_sorting,
        random_partition,
        repressilator,
        toggle_switch,
        nutrient_limited,
        biofilm,
    )
}


def build(name: str, parameters: dict[str, Any] | None = None) -> Scene:
    """The ready-made scene `name`. Raises InputError for an unknown name or parameter."""
    if name not in READY:
        raise checks.input_error(
            "scene",
            name,
            "one of " + ", ".join(READY) + ", or the path of a Python file that defines `scene`",
            checks.suggestion(name, READY),
        )
    return READY[name](**from_plain(parameters or {}))
