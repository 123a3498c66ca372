"""A task: which scene, which parameters, which target, and how a design is grown and scored."""

from __future__ import annotations

import copy
import dataclasses
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch

import torchfilm as tf
from design.colonies import RunSettings
from design.parameters import Choice, Parameter, Space
from design.scene_family import (
    SceneFamily,
    TriedScenes,
    scene_function,
    try_scenes,
    why_rough_together,
)
from design.targets.base import Target, inner_targets
from design.targets.goals import Goals, of_seeds
from design.targets.measured import Measured
from design.targets.observed import Observed
from design.targets.several import observed_at
from torchfilm import checks

NONE = cast(Target, None)  # the target where `targets` are given
COUNTS = {"cells": 2, "replicates": 1, "most": 1, "seed": 0}  # and the least of each
SURVIVORS = "survivors"  # the mean of the replicates that did not fail, as by dying out
REDUCE = ("mean", "worst", SURVIVORS)
TOO_MANY, NEVER = 1e8, 1e30  # cells of a colony: of which is warned, and which none can have
SHORTEST = 1000  # parts of the first time among which a step is looked for
# what studies say of the course of a step: losses of another one do not compare
ORDER = "division at the end"
# and of the losses of data, likewise
OF_DATA = "Huber's beyond 100 spreads; all readings alike"


@dataclass(frozen=True, eq=False)
class TaskOptions(metaclass=checks.KnownKeywords):
    """The arguments that describe a task; `Task` and `Search` take the same ones.

    scene: a function from parameters to a `tf.Scene`, or the name of a ready scene. parameters:
    those that are searched. target: the pattern that is scored. targets: several goals instead, for
    a front of designs. fixed: further arguments of the scene function. cells, until: a colony ends
    at `cells` cells or at `until` h, whichever comes first; one that has fewer than half of `cells`
    then, or than its target needs (10 for patterns), has failed. Of data with a time both may be
    left out. replicates: colonies of each design.
    Replicate k of every design follows stream k of random numbers, so that designs are compared on
    equal terms. reduce: how the losses of the replicates become one loss: "mean", "worst", a
    quantile such as 0.75, or "survivors", the mean of those that did not fail, as by dying out;
    where all did, the design has failed. seed, dt (h, by default the scene's), dtype, device: as
    for `tf.simulate`. replay: run circuits on recorded growth where the scene allows it. most: the
    greatest number of colonies in one batch; by default as many as fit into memory.
    """

    scene: Callable[..., tf.Scene] | str
    parameters: Sequence[Parameter | Choice]
    target: Target = NONE
    _: KW_ONLY
    targets: Sequence[Target] | None = None
    cells: int | None = None
    until: float | None = None
    replicates: int = 4
    reduce: str | float = "mean"
    fixed: Mapping[str, Any] | None = None
    seed: int = 0
    dt: float | None = None
    dtype: torch.dtype = torch.float32
    device: str = "cpu"
    replay: bool = True
    most: int | None = None


@dataclass(frozen=True, eq=False)
class Task(TaskOptions):
    """A checked task. The arguments are those of `TaskOptions`.

    family: the scenes of the task; tried: what a trial of them found. `dt` is the step that is
    used. Raises InputError for an argument that is not allowed, for a parameter that the scene does
    not have, for bounds at which the scene cannot be built, and for a target that does not suit the
    first state of the scene.
    """

    family: SceneFamily = field(init=False, repr=False)
    tried: TriedScenes = field(init=False, repr=False)

    @classmethod
    def of(cls, options: TaskOptions) -> Task:
        """The task that some options describe."""
        names = (f.name for f in dataclasses.fields(TaskOptions))
        return cls(**{name: getattr(options, name) for name in names})

    def __post_init__(self) -> None:
        self._set(target=_one_target(self.target, self.targets), targets=None)
        checks.device(self.device)
        own = observed_at(self.target)
        if self.until is None and self.cells is None:
            self._set(until=own)
        until = _check_options(self)
        # numbers of NumPy would be written so in a study, which is read as plain text
        plain = lambda x: x.item() if isinstance(x, np.generic) else x
        self._set(**{n: plain(getattr(self, n)) for n in (*COUNTS, "reduce")})
        function = scene_function(self.scene)
        fixed = {name: plain(value) for name, value in (self.fixed or {}).items()}
        space, conditions = Space(self.parameters), self.target.arguments
        family = SceneFamily(function, space, fixed, self.device, conditions)
        if of_seeds(self.target) and self.replicates < 2:
            raise checks.input_error(
                "replicates", self.replicates, "2 or more with Spread", "It compares seeds."
            )
        checks.float_type("dtype", self.dtype)
        family.check_names()
        tried = try_scenes(
            family,
            self.target,
            cells=self.cells if until is None else None,
            seed=self.seed,
            dtype=self.dtype,
            replay=self.replay,
        )
        if self.cells is not None and self.cells <= tried.founders:
            raise checks.input_error(
                "cells", self.cells, f"above the {tried.founders} that a colony starts from"
            )
        dt = tried.dt if self.dt is None else checks.number("dt", self.dt, above=0.0)
        if until is not None and not _is_step(until, dt):
            hint = "" if own is None else _fitting_words((*self.target.times, until), dt)
            rule = f"a whole number of steps of dt = {dt:g} h"
            raise checks.input_error("until", until, rule, hint)
        seen = max(self.target.times, default=None) if own is None else own
        if seen is not None and until is not None and until < seen * (1 - 1e-9):
            raise checks.input_error(
                "until", until, f"at least {seen:g} h, when the target was observed"
            )
        if own is not None and until is not None and until > own * (1 + 1e-6):
            rule = f"{own:g} h, when the target was observed, or left out"
            raise checks.input_error("until", until, rule)
        for time in self.target.times:
            if not _is_step(time, dt):
                rule = f"such that {time:g} h, when the target was observed, is a step"
                hint = _fitting_words(self.target.times, dt)
                raise checks.input_error("dt", dt, rule, hint)
        self._set(fixed=fixed, until=until, dt=dt, family=family, tried=tried)
        if tried.by_id:
            checks.warn(
                f"the scene's {tried.by_id} reads the ids of colonies. In a search these are places"
                " in a batch, so that what depends on them depends on which designs are grown"
                " together. Let what differs between colonies be a parameter of the scene"
                ' function, such as Choice("mask", (0, 1), per_colony=True), read as p.mask.'
            )
        if until is not None and self.cells is None and tried.growth * until > math.log(TOO_MANY):
            power = tried.growth * until / math.log(10.0)
            words = f"at {tried.growth:.3g}/h, volumes grow 10^{power:.0f}-fold by then"
            hint = "Are times in hours, and rates in 1/h?"
            if tried.growth * until > math.log(NEVER):
                raise tf.InputError(f"until = {until:g} h is not allowed: {words}. {hint}")
            checks.warn(f"until = {until:g} h: {words}. {hint}")

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def space(self) -> Space:
        """The searched parameters and the unit cube that they span."""
        return self.family.space

    @cached_property
    def why_rough(self) -> str:
        """Why the losses of some designs have no exact derivatives, or ""."""
        return self.tried.why_rough or why_rough_together(
            self.family, seed=self.seed, dtype=self.dtype, replay=self.replay
        )

    @property
    def settings(self) -> RunSettings:
        """How the colonies are run."""
        dt = cast(float, self.dt)
        return RunSettings(
            self.seed, dt, self.dtype, self.device, self.replicates, self.cells, self.replay
        )

    def end(self, size: float) -> tuple[int | None, float | None]:
        """Cells and hours at which colonies of a share of the full size end."""
        cells, until, dt = self.cells, self.until, cast(float, self.dt)
        if cells is not None:
            cells = max(self.tried.founders + 1, round(cells * size))
        if until is not None:
            # a smaller colony must reach the first time at which the target sees it
            first = self.target.first_time
            until = max(max(1, round(until * size / dt)) * dt, first if first <= until else 0.0)
        return cells, until

    def resized(self, factor: float) -> Task:
        """The same task with colonies `factor` times as large, or `factor` times as many hours; the
        factor may exceed 1."""
        cells, until = self.end(checks.number("factor", factor, above=0.0))
        other = copy.copy(self)
        other._set(cells=cells, until=until)
        return other

    def streams(self, given: Sequence[int] | None) -> tuple[int, ...]:
        """Checked streams of random numbers; by default those of the replicates."""
        found = tuple(range(self.replicates) if given is None else _whole_numbers(given))
        if not found or len(set(found)) != len(found) or not all(0 <= s < 2**32 for s in found):
            raise checks.input_error(
                "streams", given, "different whole numbers from 0 to 2³² − 1, at least one"
            )
        return found

    def reduced(self, losses: np.ndarray, target: Target | None = None) -> np.ndarray:
        """One loss for each design, (n,), from the losses of its replicates (n, R). target: of
        which they are; by default that of the task."""
        own = (target or self.target).reduced(losses)
        if own is not None:
            return own
        if self.reduce == "mean":
            return losses.mean(1)
        if self.reduce == "worst":
            return losses.max(1)
        if self.reduce == SURVIVORS:
            failed = (target or self.target).failed
            mean = (np.nan_to_num(losses, nan=0.0) * _share_of_living(losses, failed)).sum(1)
            return np.where((losses < failed).any(1), mean, failed)
        return np.quantile(losses, float(self.reduce), axis=1)

    @property
    def worst(self) -> bool:
        """Whether the loss of a design is that of its worst colony."""
        by_target = self.target.reduced(np.zeros((1, self.replicates))) is not None
        return not by_target and self.reduce in ("worst", 1)

    @property
    def conditions(self) -> int:
        """How many colonies make one replicate: one under each condition."""
        return len(self.family.conditions)

    @property
    def colonies_each(self) -> int:
        """How many colonies a design takes."""
        return self.replicates * self.conditions

    @property
    def goals(self) -> int:
        """How many goals stand side by side; 0 where there is one target."""
        return len(self.target.parts) if isinstance(self.target, Goals) else 0

    def reduced_goals(self, losses: np.ndarray) -> np.ndarray | None:
        """The losses of each goal, (n, G), from those of the replicates (n, R, G); None where there
        is one target. NaN where a replicate failed."""
        if not isinstance(self.target, Goals):
            return None
        each = [self.reduced(losses[:, :, k], part) for k, part in enumerate(self.target.parts)]
        failed = np.isnan(losses).any(2)
        none = failed.all(1) if self.reduce == SURVIVORS else failed.any(1)
        return np.where(none[:, None], np.nan, np.stack(each, 1))

    def shares(self, losses: np.ndarray) -> np.ndarray:
        """The derivative of `reduced` by the losses, (n, R)."""
        count = losses.shape[1]
        if self.reduce == "mean":
            return np.full(losses.shape, 1.0 / count)
        if self.reduce == SURVIVORS:
            return _share_of_living(losses, self.target.failed)
        quantile = 1.0 if self.reduce == "worst" else float(self.reduce)
        order, place = np.argsort(losses, 1, kind="stable"), quantile * (count - 1)
        below, above = math.floor(place), math.ceil(place)
        out, row = np.zeros(losses.shape), np.arange(len(losses))
        out[row, order[:, below]] += 1.0 - (place - below)
        out[row, order[:, above]] += place - below
        return out

    def describe(self) -> dict[str, Any]:
        """Everything that the losses depend on, as plain data. A study can be resumed only by a
        task with the same description."""
        recipe = self.tried.recipe
        of_data = {"losses": OF_DATA} if _has_spreads(self.target) else {}
        return {
            "order of a step": ORDER,
            **of_data,
            "scene": recipe[0] if recipe else getattr(self.family.function, "__name__", "scene"),
            "fixed": {n: _without_addresses(v) for n, v in self.family.fixed.items()},
            "effects": self.tried.listing,
            "founders and functions": self.tried.digest,
            "parameters": self.space.describe(),
            "code of resolve": self.space.digest,
            "code of the target": tf.digest(self.target),
            "target": describe_target(self.target),
            "cells": self.cells,
            "until": self.until,
            "replicates": self.replicates,
            "reduce": self.reduce,
            "seed": self.seed,
            "dt": self.dt,
            "dtype": str(self.dtype)[6:],
        }


def describe_target(target: Target) -> str:
    """A target with all its settings, the same in every process."""
    if dataclasses.is_dataclass(target):
        return _without_addresses(target)
    return target.describe()


def _without_addresses(value: Any) -> str:
    """The text of a value, without its address in the memory of this process, and with numbers of
    NumPy as those of Python."""
    plain = re.sub(r"np\.(?:float64|u?int\d+)\(([^()]*)\)", r"\1", repr(value))
    return re.sub(r" at 0x[0-9a-f]+", "", plain)


def _one_target(target: Any, targets: Any) -> Target:
    """The target of a task: the one that is given, or several side by side."""
    if (target is None) == (targets is None):
        raise checks.input_error(
            "target", target, "a Target, such as Stripe(…), or targets=[…], and one of the two"
        )
    if targets is not None:
        return Goals(targets)
    if not isinstance(target, Target):
        raise checks.input_error("target", target, "a Target, such as Stripe(…)")
    return target


def _check_options(options: TaskOptions) -> float | None:
    """Check what needs no scene; returns `until` as a float."""
    if options.cells is None and options.until is None:
        raise checks.InputError("a colony needs an end: give cells=… or until=… (hours).")
    for name, least in COUNTS.items():
        value = getattr(options, name)
        if value is not None or name in ("replicates", "seed"):
            checks.integer(name, value, least=least)
    if not isinstance(options.fixed, Mapping | None):
        raise checks.input_error(
            "fixed", options.fixed, 'arguments of the scene function by name, such as {"dim": 3}'
        )
    checks.choice("replay", options.replay, (True, False))
    reduce = options.reduce
    if reduce not in REDUCE and (
        isinstance(reduce, bool) or not isinstance(reduce, (int, float)) or not 0 < reduce <= 1
    ):
        raise checks.input_error(
            "reduce", reduce, '"mean", "worst", "survivors" or a quantile above 0 and at most 1'
        )
    return None if options.until is None else checks.number("until", options.until, above=0.0)


def _share_of_living(losses: np.ndarray, failed: float) -> np.ndarray:
    """The share of each replicate in the mean of those that did not fail, (n, R)."""
    living = losses < failed
    return living / np.maximum(living.sum(1, keepdims=True), 1)


def _whole_numbers(given: Any) -> list[int]:
    """Whole numbers of a list, or nothing where there are others."""
    try:
        found = [operator.index(number) for number in given]
    except TypeError:
        return []
    return found


def _is_step(time: float, dt: float) -> bool:
    """Whether a time, h, is one step of dt hours or a whole number of them."""
    steps = time / dt
    return round(steps) >= 1 and abs(steps - round(steps)) <= 1e-6 * steps


def _has_spreads(target: Target) -> bool:
    """Whether a target, or one in it, compares by spreads."""
    return isinstance(target, Observed | Measured) or any(map(_has_spreads, inner_targets(target)))


def _fitting_words(times: Sequence[float], dt: float) -> str:
    """The longest step below `dt` of which all times, h, are multiples."""
    for k in range(1, SHORTEST + 1):
        step = min(times) / (math.ceil(min(times) / dt) + k - 1)
        if all(_is_step(time, step) for time in times):
            return f"dt = {step:.9g} would do."
    return "No step does that all these times are multiples of: round them, such as to 0.05 h."
