"""The scenes that a function builds from the values of the searched parameters, and a trial of them
before a search begins."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

import torchfilm as tf
from design import colonies
from design.parameters import Choice, Parameter, Space, Value
from design.targets.base import Target
from torchfilm import checks

# Structures whose options are tried together before the first derivatives.
MOST_TOGETHER = 64


class UnfitDesign(tf.InputError):
    """A scene function raises it for a design that cannot work, with the reason. The design is
    scored as failed and not grown. The trial before a search passes over it, as long as other
    designs can be built."""


@dataclass(frozen=True, eq=False)
class SceneFamily:
    """All scenes of a task.

    function: from parameters to a `tf.Scene`; fixed: its further arguments; device: of the values
    that it receives. conditions: further arguments; each replicate has a colony under each.
    """

    function: Callable[..., tf.Scene]
    space: Space
    fixed: Mapping[str, Any]
    device: str
    conditions: Sequence[Mapping[str, float]] = ({},)

    @property
    def name(self) -> str:
        return getattr(self.function, "__name__", "the scene")

    def scene(
        self,
        values: Sequence[Mapping[str, Value]],
        repeat: int = 1,
        tangents: Sequence[Mapping[str, float]] | None = None,
    ) -> tf.Scene:
        """One scene for several designs whose structure is the same. A number, or a choice that is
        made per colony, becomes one value per colony; each design has `repeat` colonies under each
        condition, those of all conditions side by side. tangents: for each design, the derivatives
        that its values carry, by name; those that are not named carry 0."""
        arguments, replicates = dict(self.fixed), len(values) * repeat
        repeat *= len(self.conditions)
        for name in self.conditions[0]:
            given = [condition[name] for condition in self.conditions]
            arguments[name] = self._column(given * replicates, 1)
        for parameter in self.space.parameters:
            name = parameter.name
            if parameter.structural:
                arguments[name] = values[0][name]
                continue
            if isinstance(parameter, Choice):
                arguments[name] = [design[name] for design in values for _ in range(repeat)]
                continue
            arguments[name] = self._column([design[name] for design in values], repeat)
            if tangents is not None:
                column = self._column([tangent.get(name, 0.0) for tangent in tangents], repeat)
                arguments[name] = tf.tangents.with_tangent(arguments[name], column)
        made = self.function(**arguments)
        if not isinstance(made, tf.Scene):
            raise checks.input_error("scene", made, "a function that returns a tf.Scene")
        return made

    def _column(self, numbers: Sequence[float], repeat: int) -> torch.Tensor:
        column = torch.tensor(numbers, dtype=torch.float64, device=self.device)
        return column.repeat_interleave(repeat)

    def check_names(self) -> None:
        """Raises InputError for a parameter or fixed argument that the function does not have."""
        allowed = inspect.signature(self.function).parameters
        if not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in allowed.values()):
            self.space.check(list(allowed), self.name)
            for what, names in (("fixed", self.fixed), ("Conditions", self.conditions[0])):
                for given in names:
                    if given not in allowed:
                        rule = f"a parameter of {self.name}: {', '.join(allowed)}"
                        hint = checks.suggestion(given, allowed)
                        raise checks.input_error(what, given, rule, hint)
        named = (*self.space.names, *self.fixed)
        if twice := [name for name in self.conditions[0] if name in named]:
            raise checks.input_error(
                "Conditions", twice[0], "a parameter that is neither searched nor fixed"
            )
        both = [name for name in self.fixed if name in self.space.names]
        if both:
            raise checks.input_error("fixed", both[0], "a parameter that is not searched as well")


def scene_function(scene: Callable[..., tf.Scene] | str) -> Callable[..., tf.Scene]:
    """The function of a scene that is given as a function or as the name of a ready scene."""
    if isinstance(scene, str):
        if scene not in tf.scenes.READY:
            raise checks.input_error(
                "scene",
                scene,
                "one of "
                + ", ".join(tf.scenes.READY)
                + ", or a function from parameters to a tf.Scene",
            )
        return tf.scenes.READY[scene]
    if isinstance(scene, tf.Scene) or not callable(scene):
        raise checks.input_error(
            "scene",
            scene,
            "a function from parameters to a tf.Scene",
            "Give the function itself, not the scene that it returns: def scene(k3=1.0): …",
        )
    return scene


@dataclass(frozen=True)
class TriedScenes:
    """What the trial of a family's scenes found.

    founders: cells at the start of a colony. dt (h): of the scene. growth (1/h): of the slowest of
    the designs, 0 where something may hold a colony down. recipe: name and arguments of a
    ready scene, or None. listing: its effects as text. digest: of what a listing does not show, the
    founders and the code of functions. why_regrown: the reason why colonies cannot follow recorded
    growth, or "". why_rough: the reason why losses have no exact derivatives, with one option of a
    choice at least, or "". stochastic: whether circuits count molecules one by one. idle:
    parameters on which nothing in the scene depends. by_id: the title of an effect that reads the
    ids of colonies, or "".
    """

    founders: int
    dt: float
    growth: float
    recipe: tuple[str, Any] | None
    listing: list[str]
    digest: str
    why_regrown: str
    why_rough: str
    stochastic: bool
    idle: tuple[str, ...]
    by_id: str


def try_scenes(
    family: SceneFamily,
    target: Target,
    *,
    cells: int | None,
    seed: int,
    dtype: torch.dtype,
    replay: bool,
) -> TriedScenes:
    """Build the scene in the middle of the space, at both bounds of every number and with every
    option; check the target on each first state.

    cells: the number that must be reachable, or None. Raises InputError where a scene cannot be
    built, where the target does not suit it, where no scene can reach `cells` cells, and where all
    these designs are unfit.
    """
    trials = _trial_values(family.space)
    made_of: dict[int, Any] = {}  # by the number of the trial
    endless, unfit, rough, growth, by_id = [], [], [], [], ""
    example: tf.Scene | None = None
    stochastic = False
    run: dict[str, Any] = {"seed": seed, "dtype": dtype, "replay": replay}
    for k, values in enumerate(trials):
        try:
            # two colonies: a tensor with one number would pass for a plain number
            scene = family.scene([values], repeat=2)
            if scene.founders.colony is not None:
                raise checks.input_error(
                    "founders",
                    "cells with colony numbers",
                    "cells of one colony",
                    "Each colony of a search starts from them: leave colony out.",
                )
            tried = _tried(family, scene, 2, cells, **run)
        except UnfitDesign as error:
            unfit.append(str(error))
            continue
        except Exception as error:
            raise _cannot_be_built(error, values, trials[0]) from error
        target.check(tried.first)
        example = example or family.scene([values])
        made_of[k] = scene.effects, scene.drawn_from
        stochastic |= _is_stochastic(scene)
        endless.append(tried.why_endless)
        by_id = by_id or tried.by_id
        growth.append(_free_growth(scene, tried.first))
        rough.append(why_rough(scene, tried.why_regrown) or target.why_rough(tried.first))
    # one design that does not grow is scored as such; a search in which none grows is a mistake
    if example is None or all(endless):
        raise tf.InputError(unfit[0] if example is None else endless[0])
    scene = example
    why_regrown = _tried(family, scene, 1, None, **run).why_regrown
    # a function that calls a ready scene has parameters of its own, so it is not that scene
    ready = scene.recipe and family.function is tf.scenes.READY.get(scene.recipe[0])
    return TriedScenes(
        founders=int(scene.founders.count),
        dt=scene.dt,
        growth=min(growth),
        recipe=scene.recipe if ready else None,
        listing=scene.listing(),
        digest=tf.digest(list(made_of.values())),
        idle=_idle(family.space, made_of),
        why_regrown=why_regrown,
        why_rough=next(filter(None, rough), ""),
        stochastic=stochastic,
        by_id=by_id,
    )


def _tried(
    family: SceneFamily, scene: tf.Scene, replicates: int, cells: int | None, **run: Any
) -> colonies.TriedScene:
    """What a trial of a scene for one design finds, with so many replicates."""
    count = replicates * len(family.conditions)
    return colonies.try_scene(scene, count, device=family.device, cells=cells, **run)


def _idle(space: Space, made_of: Mapping[int, Any]) -> tuple[str, ...]:
    """The parameters that change nothing in the scene, with the others in the middle. Where there
    are choices, a parameter may belong to another option: then none is named. made_of: what the
    scenes of `_trial_values` are made of, by their numbers."""
    if any(isinstance(p, Choice) for p in space.parameters) or len(made_of) <= 2 * space.size:
        return ()
    middle, *ends = (tf.digest(made_of[k]) for k in range(len(made_of)))
    alike = [low == high == middle for low, high in zip(ends[::2], ends[1::2], strict=True)]
    return tuple(name for name, same in zip(space.names, alike, strict=True) if same)


def _cannot_be_built(
    error: Exception, values: dict[str, Value], middle: dict[str, Value]
) -> tf.InputError:
    """What to do depends on whether the scene fails in the middle of the space too, and on whether
    torchfilm has refused a value, or Python or torch a tensor."""
    changed = {n: v for n, v in values.items() if v != middle[n]}
    kind = "" if isinstance(error, tf.InputError) else f"{type(error).__name__}: "
    hints = " Narrow the bounds." if changed else ""
    if kind or "tensor(" in str(error):
        hints += (
            " If the scene takes a plain number or a name there, use whole=True or a Choice: a"
            " Parameter, and a number of Conditions, arrive as a tensor with one value per colony,"
            " of which founders are made by tf.Founders(function, name=value)."
        )
    return tf.InputError(
        f"{kind}{str(error).rstrip('.')}. So the scene cannot be built with {changed or values}."
        + hints
    )


def why_rough(scene: tf.Scene, why_regrown: str) -> str:
    """Why the losses of a scene have no exact derivatives, or "". Options of a choice differ."""
    if why_regrown:
        return f"growth depends on the design ({why_regrown})"
    return "molecules are counted one by one" if _is_stochastic(scene) else ""


def _free_growth(scene: tf.Scene, first: tf.State) -> float:
    """At which rate, 1/h, a colony grows on and on; 0 where something may hold it down."""
    holding = tf.Removal, tf.Lysis, tf.Erosion, tf.Sloughing, tf.Rules, tf.Monod
    for effect in scene.effects:
        own = tf.effect.is_own(effect) or isinstance(effect, holding)
        slowed = isinstance(effect, tf.Growth) and (effect.factor or effect.law == "linear")
        walled = isinstance(effect, tf.Mechanics) and effect.walls
        if own or slowed or walled:
            return 0.0
    divides = any(isinstance(e, tf.Division) for e in scene.effects)
    return float(first.growth_rate.max()) if divides and "growth_rate" in first.fields else 0.0


def _is_stochastic(scene: tf.Scene) -> bool:
    """Whether a circuit counts molecules one by one."""
    return any(isinstance(e, tf.Circuit) and e.is_stochastic for e in scene.effects)


def why_rough_together(family: SceneFamily, *, seed: int, dtype: torch.dtype, replay: bool) -> str:
    """Why some scene has no exact derivatives, with options of several choices or whole numbers
    together, or "". The first `MOST_TOGETHER` structures that `try_scenes` leaves out are tried.
    Those that cannot be built are passed over: such designs fail."""
    for values in itertools.islice(_structures(family.space), MOST_TOGETHER):
        try:
            scene = family.scene([values], repeat=2)
            tried = _tried(family, scene, 2, None, seed=seed, dtype=dtype, replay=replay)
        except Exception:
            continue
        if why := why_rough(scene, tried.why_regrown):
            return why
    return ""


def _structures(space: Space) -> Iterator[dict[str, Value]]:
    """A design of each structure among the first 1,024 of the space, each once (choices that
    exclude each other make some alike), without those of `_trial_values`."""
    each = [
        [(k + 0.5) / (p.levels or 1) for k in range(p.levels or 1)] if p.structural else [0.5]
        for p in space.parameters
    ]
    seen = _trial_values(space)
    for point in itertools.islice(itertools.product(*each), 1024):
        values = space.values(np.array(point))
        if values not in seen:
            seen.append(values)
            yield values


def _trial_values(space: Space) -> list[dict[str, Value]]:
    """The middle of the space, then both bounds of every number and every option, one at a time."""
    middle = space.values(np.full(space.size, 0.5))
    trials = [middle]
    for p in space.parameters:
        ends = (p.low, p.high) if isinstance(p, Parameter) else p.options
        whole = isinstance(p, Parameter) and p.whole
        trials += [space.resolved({**middle, p.name: int(v) if whole else v}) for v in ends]
    return trials
