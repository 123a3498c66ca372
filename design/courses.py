"""Recorded growths, kept for as long as the process lives, so that every batch of a search uses the same."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torchfilm as tf

if TYPE_CHECKING:
    from design.objective import Objective

MOST_BYTES = 2**30  # of recorded steps; beyond, those used longest ago are let go
_kept: dict[Any, tf.Course] = {}


def of(objective: Objective, scene: tf.Scene, streams: tuple[int, ...]) -> tf.Course:
    """The growth of this scene for these streams, recorded before or begun now."""
    grown = tf.Course.scene_of(scene)
    founders = scene.founders
    columns = (founders.position, founders.axis, founders.length, founders.radius, founders.cell_type, *founders.extra.values())
    who = (objective.make.__module__, getattr(objective.make, "__qualname__", repr(objective.make)), repr(sorted(objective.fixed.items())))
    start = tuple(None if c is None else c.tobytes() for c in columns)
    key = (*who, tuple(grown.listing()), start, objective.seed, objective.dt, objective.dtype, objective.device, objective.cells)
    for known, course in _kept.items():
        if known[:-1] == key and set(streams) <= set(course.streams):
            _kept[known] = _kept.pop(known)  # the last used stands last
            return course
    course = tf.Course(
        scene, streams=streams, seed=objective.seed, dt=objective.dt, dtype=objective.dtype, device=objective.device, cells=objective.cells
    )  # fmt: skip
    while _kept and sum(c.nbytes for c in _kept.values()) > MOST_BYTES:
        _kept.pop(next(iter(_kept)))
    _kept[(*key, streams)] = course
    return course
