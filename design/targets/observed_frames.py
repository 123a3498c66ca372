"""The frames of a course: from label images, states, files and measured numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import torchfilm as tf
from design.targets.measured import Measured, checked_columns, means_and_spreads
from design.targets.observed import Observed
from design.targets.observed_table import colonies_of
from torchfilm import checks, tables

MEASURES = "ObservedCourse.of_measures"


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


def table_frames(
    given: tables.Table, times: np.ndarray, columns: Mapping[str, str], options: Mapping[str, Any]
) -> list[Observed]:
    """The rows of each time of a table. times: of the rows, h. Warns of colonies that are gone
    later."""
    frames: list[Observed] = []
    for t in np.unique(times):
        part: Any = given.take(times == t)
        frames.append(Observed.from_table(part, columns=columns, time=float(t), **options))
    if (owner := colonies_of(given, columns)) is not None:
        _warn_of_gone(given.source, {k: float(times[owner == k].max()) for k in np.unique(owner)})
    return frames


def _warn_of_gone(source: str, last: Mapping[Any, float]) -> None:
    """Warn of colonies that are gone in later frames. last: h, when each was seen last."""
    end = max(last.values())
    gone = [str(k) for k, t in last.items() if t < end]
    if gone:
        shown = ", ".join(gone[:8]) + ", …" * (len(gone) > 8)
        checks.warn(
            f"{source}: {len(gone)} of {len(last)} colonies are not there any more at {end:g} h"
            f" ({shown}). If they died out, the frames are of those that live on, while simulated"
            " colonies that die out fail: a search then finds fewer deaths than there were."
            ' reduce="survivors" leaves those out; Measured(…, extinct=True) and'
            " ObservedCourse.of_measures(…, extinct=True) measure them, too."
        )


def _check_count(what: str, given: Any, count: int) -> None:
    """Raise InputError unless there is one for each time."""
    if not isinstance(given, (list, tuple, np.ndarray)) or len(given) != count:
        found = f"{len(given)} of them" if hasattr(given, "__len__") else given
        raise checks.input_error(what, found, f"a list of {count}, one for each time")


def measured_frames(
    functions: Any,
    times: Any,
    values: Any,
    spread: Any,
    error: Any,
    extinct: bool,
    smooth: bool,
    colonies: int,
) -> list[Measured]:
    """The measures at each time, of those that are known there."""
    rule = "a dict of functions by name, such as {'od': total_volume}"
    if not isinstance(functions, Mapping) or not functions:
        raise checks.input_error(f"{MEASURES}: functions", functions, rule)
    moments = checks.vector(f"{MEASURES}: times", times)
    if min(moments, default=1.0) <= 0.0:
        hint = "Leave such readings out: a scene's founders and `initial=` say how colonies begin."
        raise checks.input_error(f"{MEASURES}: times", list(moments), "above 0 h", hint)
    given = dict(checked_columns(f"{MEASURES}: values", values, functions))
    columns: dict[str, dict[str, Any]] = {}
    if any(map(_is_table, given.values())):
        columns["wanted"], columns["spread"], count = _of_colonies(given, moments, spread, extinct)
        if colonies not in (1, count):
            rule = f"left out, as the values are of {count} colonies"
            raise checks.input_error(f"{MEASURES}: colonies", colonies, rule)
        colonies = count
        error = dict.fromkeys(functions, 0.0) if error is None else error
    else:
        for option, numbers in ("wanted", given), ("spread", spread):
            columns[option] = _columns(option, numbers, functions, len(moments))
    if error is not None:
        columns["error"] = _columns("error", error, functions, len(moments))
    frames = []
    for k, time in enumerate(moments):
        known = {n: f for n, f in functions.items() if not math.isnan(columns["wanted"][n][k])}
        of: Any = {option: {n: of[n][k] for n in known} for option, of in columns.items()}
        how: Any = {"extinct": extinct, "smooth": smooth, "colonies": colonies}
        if known:
            frames.append(Measured(known, **of, **how, time=time))
    if len(frames) < 2:
        found = f"{len(moments)} times, of which {len(frames)} have a value"
        hint = "Of one time, give Measured(…, time=…)."
        raise checks.input_error(f"{MEASURES}: values", found, "of two times at least", hint)
    return frames


def _is_table(given: Any) -> bool:
    """Whether numbers are by time and colony."""
    try:
        return np.ndim(given) == 2
    except ValueError:  # lists of different lengths
        return False


def _of_colonies(
    values: Mapping[str, Any], moments: Sequence[float], spread: Any, extinct: bool
) -> tuple[dict[str, Any], dict[str, Any], int]:
    """Means and spreads by name, (T,) each, and the number of colonies, of numbers by time and
    colony."""
    if spread is not None:
        rule = "left out where values are given of each colony, which tell how much these differ"
        raise checks.input_error(f"{MEASURES}: spread", spread, rule)
    by_name = {}
    for name, given in values.items():
        label = f"{MEASURES}: values[{name!r}]"
        rule = (
            f"numbers by time and colony, {len(moments)} rows; NaN of all where a time is missing"
        )
        try:
            rows = np.asarray(given, dtype=float) if _is_table(given) else np.empty((0, 0))
        except (TypeError, ValueError):
            rows = np.empty((0, 0))
        missing = np.isnan(rows)
        if len(rows) != len(moments) or (missing.any(1) != missing.all(1)).any():
            raise checks.input_error(label, given, rule)
        by_name[name] = rows
    alike = "numbers of as many colonies each"
    return means_and_spreads(f"{MEASURES}: values", by_name, alike, extinct)


def _columns(option: str, given: Any, functions: Mapping[str, Any], count: int) -> dict[str, Any]:
    """Numbers of each time by name; of all but the wanted values, one will do."""
    name_of = {"wanted": "values"}.get(option, option)
    label = f"{MEASURES}: {name_of}"
    return {
        name: _column(f"{label}[{name!r}]", numbers, count, option != "wanted")
        for name, numbers in checked_columns(label, given, functions)
    }


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
