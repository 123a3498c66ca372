"""A description of a scene before it runs: effects, methods, what is not simulated, and an estimate
of the cost. `torchfilm info` prints the fields of the scene."""

from __future__ import annotations

import torch

from torchfilm.cost_estimate import PROBE_COLONIES, cost_lines
from torchfilm.effects import KNOWN
from torchfilm.model import Model
from torchfilm.scene import Scene
from torchfilm.tools import checks, displays
from torchfilm.tools.warn_once import once


@checks.known_keywords
@once()  # it binds the scene again to estimate its cost
def explain(
    scene: Scene,
    *,
    cells: int = 1000,
    colonies: int | None = None,
    device: str | torch.device = "cpu",
    seconds: float = 2.0,
) -> str:
    """Describes how a scene will be simulated: effects and their methods, which effect drives
    which, what is not simulated, whether a search grows colonies once for all designs, and an
    estimate of time and memory.

    cells, colonies: size of the run to estimate; cells are per colony. colonies: by default as many
    as the scene's parameters and founders have, else 1. seconds: about how long to measure, by
    running the scene's first steps on `device` in float32, rules included; 0 omits the estimate. A
    warm-up before, to the first division, takes at most as long again, and the time to compile.
    Raises InputError if the scene cannot be seeded.
    """
    if not isinstance(scene, Scene):
        raise checks.input_error("scene", scene, "a Scene, such as tf.scenes.microcolony()")
    for name, given in (("cells", cells), ("colonies", colonies)):
        if given is not None:
            checks.integer(name, given, least=1)
    checks.number("seconds", seconds, least=0.0)
    fixed = scene.fixed_colonies
    if fixed > 1 and colonies not in (None, fixed):
        raise checks.input_error(
            "colonies",
            colonies,
            f"{fixed}, as the scene's parameters or founders have",
            "Leave it out.",
        )
    count = fixed if fixed > 1 else colonies or PROBE_COLONIES
    model = scene.bind(count, device=device, per_colony=True)
    state = model.start()
    lines = [scene.headline]
    for effect in model.effects:
        lines.append(f"  {effect.title:<10} {effect.summary()}")
        lines += [f"             {words}" for words in model.numerics(effect, state)]
    lines += [f"  {words}" for words in ([] if model.twins is None else model.twins.in_words())]
    lines += ["  who drives whom:", *(f"    {line}" for line in model.drives())]
    lines.append(
        f"  not simulated: {', '.join(left_out(scene)) or 'nothing'}"
        + (" (no field, no operation)" if left_out(scene) else "")
    )
    lines.append(f"  in a search: {replayed(model)}")
    if seconds > 0:
        lines += [
            f"  {line}"
            for line in cost_lines(
                scene, state.colonies, cells, max(fixed, colonies or 1), device, seconds
            )
        ]
    return displays.Text("\n".join(lines))


def left_out(scene: Scene) -> list[str]:
    """Names of torchfilm's effects that the scene does not list, in the order of a step."""
    listed = tuple(type(effect) for effect in scene.effects)
    return [name for name, kind in KNOWN.items() if not any(issubclass(x, kind) for x in listed)]


def replayed(model: Model) -> str:
    """Whether a search grows colonies once for all designs, and why, as text."""
    if model.why_not_replayable:
        return f"each design grows colonies of its own, because {model.why_not_replayable}"
    effects = sorted((model.scene.effects[k] for k in model.following), key=lambda e: e.stage)
    follow = [effect.title for effect in effects]
    verb = "changes" if len(follow) == 1 else "change"
    return (
        "colonies are grown once for all designs, because"
        f" {' and '.join(follow)} {verb} neither growth nor motion (tf.GrowthRecording, tf.Replay)"
    )
