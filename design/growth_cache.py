"""Recorded growths, kept for as long as the process lives, so that every batch of a search uses the
same."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torchfilm as tf

if TYPE_CHECKING:
    from design.objective import Objective

MOST_BYTES = 2**30  # of recorded steps; beyond, those used longest ago are let go
_kept: dict[Any, tf.GrowthRecording] = {}


def recording_for(
    objective: Objective, scene: tf.Scene, streams: tuple[int, ...]
) -> tf.GrowthRecording:
    """The growth of this scene for these streams, recorded before or begun now."""
    key = (
        tf.GrowthRecording.made_of(scene),
        objective.seed,
        objective.dt,
        objective.dtype,
        objective.device,
    )
    for known, course in _kept.items():
        # colonies leave a course by themselves, so one that goes further serves as well
        far_enough = course.cells is None or (
            objective.cells is not None and course.cells >= objective.cells
        )
        if known[:-2] == key and set(streams) <= set(course.streams) and far_enough:
            _kept[known] = _kept.pop(known)  # the last used stands last
            return course
    course = tf.GrowthRecording(
        scene,
        streams=streams,
        seed=objective.seed,
        dt=objective.dt,
        dtype=objective.dtype,
        device=objective.device,
        cells=objective.cells,
    )
    while _kept and sum(c.nbytes for c in _kept.values()) > MOST_BYTES:
        _kept.pop(next(iter(_kept)))
    _kept[(*key, streams, objective.cells)] = course
    return course
