"""Torchfilm's running interface, as the search layer uses it.

Only this module seeds, steps, records, replays, or asks which colonies failed. When that interface
changes, only this module changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch

import torchfilm as tf
from design import growth_cache

REPLAY_IS_OFF = "replay=False"


@dataclass(frozen=True)
class RunSettings:
    """How the colonies of a task are run.

    seed, dt (h), dtype, device: as for `tf.simulate`. replicates: of each design; the recorded
    streams are 0 … replicates − 1. cells: a recorded colony stops there; None: it does not stop.
    replay: whether circuits may run on recorded growth.
    """

    seed: int
    dt: float
    dtype: torch.dtype
    device: str
    replicates: int
    cells: int | None
    replay: bool


@dataclass(frozen=True, eq=False)
class PreparedColonies:
    """A batch of colonies that is ready to run.

    first: the first state. step: returns the state one time step later. why_regrown: the reason
    why the colonies do not follow recorded growth, or "".
    """

    first: tf.State
    step: Callable[[tf.State], tf.State]
    why_regrown: str


def prepare(scene: tf.Scene, streams: Sequence[int], settings: RunSettings) -> PreparedColonies:
    """Prepare a batch: colony k follows stream streams[k] of random numbers.

    The colonies follow recorded growth where the scene allows it.
    """
    model = _bind(scene, len(streams), settings.seed, settings.dtype, settings.device, streams)
    why = model.why_not_replayable if settings.replay else REPLAY_IS_OFF
    if not why:
        replay = tf.Replay(model, _recording(model, tuple(dict.fromkeys(streams)), settings))
        return PreparedColonies(replay.start(), replay.step, "")
    return PreparedColonies(model.start(), partial(model.step, dt=settings.dt), why)


def _bind(
    scene: tf.Scene,
    colonies: int,
    seed: int,
    dtype: torch.dtype,
    device: str,
    streams: Sequence[int] | None = None,
) -> tf.Model:
    # every list of numbers is one value per design, also where there are as many cell types
    return scene.bind(
        colonies, seed=seed, streams=streams, dtype=dtype, device=device, per_colony=True
    )


def _recording(
    model: tf.Model, streams: tuple[int, ...], settings: RunSettings
) -> tf.GrowthRecording:
    # one recording serves all replicates, also where a first look grows fewer
    usual = tuple(range(settings.replicates))
    recorded = usual if set(streams) <= set(usual) else streams
    key = (model.growth_fingerprint, settings.seed, settings.dt, settings.dtype, settings.device)
    return growth_cache.find_or_record(
        key,
        recorded,
        settings.cells,
        lambda: tf.GrowthRecording(
            model.scene,
            streams=recorded,
            seed=settings.seed,
            dt=settings.dt,
            dtype=settings.dtype,
            device=settings.device,
            cells=settings.cells,
        ),
    )


@dataclass(frozen=True)
class TriedScene:
    """What binding a scene once has found. first: its first state. why_regrown: the reason why
    colonies cannot follow recorded growth, or "". why_endless: the reason why no run can reach
    `cells` cells, or "". by_id: the title of the first effect that reads the ids of colonies, or
    ""."""

    first: tf.State
    why_regrown: str
    why_endless: str
    by_id: str


def try_scene(
    scene: tf.Scene,
    colonies: int,
    *,
    seed: int,
    dtype: torch.dtype,
    device: str,
    replay: bool,
    cells: int | None,
) -> TriedScene:
    """Bind a scene, and find out whether it can be replayed, and whether it can reach `cells`."""
    model = _bind(scene, colonies, seed, dtype, device)
    first = model.start()
    why = model.why_not_replayable if replay else REPLAY_IS_OFF
    endless = "" if cells is None else _why_endless(model, first, cells)
    by_id = next((effect.title for effect in model.effects if "colony" in effect.reads()), "")
    return TriedScene(first, why, endless, by_id)


def _why_endless(model: tf.Model, first: tf.State, cells: int) -> str:
    try:
        model.check_end(first, cells)
    except tf.InputError as error:
        return str(error)
    return ""


def first_state(scene: tf.Scene, dtype: torch.dtype, count: int = 1) -> tf.State:
    """The first state of so many colonies, on the CPU."""
    return scene.bind(count, dtype=dtype, device="cpu", per_colony=True).start()


def grid_nodes(first: tf.State) -> int:
    """The number of grid nodes of one colony; 0 without a medium."""
    return 0 if first.layout is None else first.layout.grid.nodes // first.colonies


def failures(state: tf.State) -> dict[int, tuple[int, str]]:
    """The colonies that failed in the last step, in order of their place in the batch: place to
    (colony id, first reason)."""
    first = {f.place: (f.colony_id, f.reason) for f in reversed(tf.failures(state))}
    return {place: first[place] for place in sorted(first)}
