"""The frames of a course: from label images, states, files and measured numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import torchfilm as tf
from design.targets.measured import Measured
from design.targets.observed import Observed
from torchfilm import checks


def mask_frames(
    masks: Any, times: Any, fluorescence: Any, options: Mapping[str, Any]
) -> list[Observed]:
    """An `Observed` of each time, from its masks and its images by reporter."""
    call = "ObservedCourse.from_masks"
    if "time" in options:
        raise checks.input_error(f"{call}: time", options["time"], "left out, as times are given")
    moments = checks.vector(f"{call}: times", times)
    _check_count(f"{call}: masks", masks, len(moments))
    given = {} if fluorescence is None else fluorescence
    if not isinstance(given, Mapping):
        rule = 'images of each time by field, {"gfp": ["at_1_h.tif", "at_2_h.tif"]}'
        raise checks.input_error(f"{call}: fluorescence", fluorescence, rule)
    for name, images in given.items():
        _check_count(f"{call}: fluorescence[{name!r}]", images, len(moments))
    frames = []
    for k, time in enumerate(moments):
        beside = {name: images[k] for name, images in given.items()} or None
        try:
            frames.append(Observed.from_masks(masks[k], time=time, fluorescence=beside, **options))
        except tf.InputError as error:
            raise tf.InputError(f"at {time:g} h: {error}") from error
    return frames


def state_frames(states: Any, options: Mapping[str, Any]) -> list[Observed]:
    """An `Observed` of each state."""
    if isinstance(states, tf.State) or not isinstance(states, Sequence):
        rule = "a list of states, one for each time"
        hint = "Observed.from_state takes one."
        raise checks.input_error("ObservedCourse.from_state: states", states, rule, hint)
    return [Observed.from_state(state, **options) for state in states]


def results_frames(path: Any, frames: Any, options: Mapping[str, Any]) -> list[Observed]:
    """An `Observed` of each frame of a file; None: of all after the start."""
    if frames is None:
        with tf.Results(path) as results:
            frames = np.flatnonzero(np.asarray(results.times) > 0.0).tolist()
    if not isinstance(frames, Sequence):
        rule = "a list of frames, or None"
        raise checks.input_error("ObservedCourse.from_results: frames", frames, rule)
    return [Observed.from_results(path, frame, **options) for frame in frames]


def _check_count(what: str, given: Any, count: int) -> None:
    """Raise InputError unless there is one for each time."""
    if not isinstance(given, (list, tuple, np.ndarray)) or len(given) != count:
        found = f"{len(given)} of them" if hasattr(given, "__len__") else given
        raise checks.input_error(what, found, f"a list of {count}, one for each time")


def measured_frames(
    functions: Any, times: Any, values: Any, spread: Any, extinct: bool, smooth: bool, colonies: int
) -> list[Measured]:
    """The measures at each time, of those that are known there."""
    call = "ObservedCourse.of_measures"
    rule = "a dict of functions by name, such as {'od': total_volume}"
    if not isinstance(functions, Mapping) or not functions:
        raise checks.input_error(f"{call}: functions", functions, rule)
    moments = checks.vector(f"{call}: times", times)
    if min(moments, default=1.0) <= 0.0:
        hint = "Leave such readings out: a scene's founders and `initial=` say how colonies begin."
        raise checks.input_error(f"{call}: times", list(moments), "above 0 h", hint)
    columns = {}
    for option, given in (("values", values), ("spread", spread)):
        if not hasattr(given, "keys") or set(given.keys()) != set(functions):
            rule = f"numbers by the names {', '.join(map(repr, functions))}"
            raise checks.input_error(f"{call}: {option}", given, rule)
        for name in functions:
            label = f"{call}: {option}[{name!r}]"
            columns[option, name] = _column(label, given[name], len(moments), option == "spread")
    frames = []
    for k, time in enumerate(moments):
        there = [name for name in functions if not math.isnan(columns["values", name][k])]
        parts = [
            {name: columns[option, name][k] for name in there} for option in ("values", "spread")
        ]
        known = {name: functions[name] for name in there}
        if known:
            how: Any = {"extinct": extinct, "smooth": smooth, "colonies": colonies}
            frames.append(Measured(known, *parts, **how, time=time))
    if len(frames) < 2:
        given = f"{len(moments)} times, of which {len(frames)} have a value"
        hint = "Of one time, give Measured(…, time=…)."
        raise checks.input_error(f"{call}: values", given, "of two times at least", hint)
    return frames


def _column(label: str, given: Any, count: int, one_will_do: bool) -> list[float]:
    """A number for each time, NaN where one is missing."""
    try:
        if one_will_do and np.ndim(given) == 0:
            return [float(given)] * count
        found = [float(x) for x in given]
    except (TypeError, ValueError):
        found = []
    if len(found) != count:
        rule = f"{count} numbers, one for each time, NaN where it is missing"
        raise checks.input_error(label, given, "a number, or " * one_will_do + rule)
    return found
