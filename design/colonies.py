"""Torchfilm's running interface, as the search layer uses it.

Only this module seeds, steps, records, replays, or asks which colonies failed. When that interface
changes, only this module changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

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
    tiled = torch.tensor(tuple(streams))
    why = why_regrown(scene, settings.replay)
    if not why:
        replay = tf.Replay(scene, _recording(scene, tuple(dict.fromkeys(streams)), settings))
        return PreparedColonies(replay.seed(tiled.numel(), streams=tiled), replay.step, "")
    first = scene.seed(
        tiled.numel(),
        seed=settings.seed,
        streams=tiled,
        dtype=settings.dtype,
        device=settings.device,
    )
    return PreparedColonies(first, lambda state: scene.step(state, settings.dt), why)


def _recording(
    scene: tf.Scene, streams: tuple[int, ...], settings: RunSettings
) -> tf.GrowthRecording:
    # one recording serves all replicates, also where a first look grows fewer
    usual = tuple(range(settings.replicates))
    recorded = usual if set(streams) <= set(usual) else streams
    key = (
        tf.GrowthRecording.made_of(scene),
        settings.seed,
        settings.dt,
        settings.dtype,
        settings.device,
    )
    return growth_cache.find_or_record(
        key,
        recorded,
        settings.cells,
        lambda: tf.GrowthRecording(
            scene,
            streams=recorded,
            seed=settings.seed,
            dt=settings.dt,
            dtype=settings.dtype,
            device=settings.device,
            cells=settings.cells,
        ),
    )


def why_regrown(scene: tf.Scene, replay: bool) -> str:
    """The reason why colonies of a scene cannot follow recorded growth, or ""."""
    return tf.GrowthRecording.obstacle(scene) if replay else REPLAY_IS_OFF


def first_state(
    scene: tf.Scene, colonies: int, *, seed: int, dtype: torch.dtype, device: str
) -> tf.State:
    """The first state of a batch of colonies."""
    return scene.seed(colonies, seed=seed, dtype=dtype, device=device)


def why_endless(scene: tf.Scene, first: tf.State, cells: int) -> str:
    """The reason why no run of a scene can reach this number of cells, or ""."""
    try:
        scene.check_moves(first, cells)
    except tf.InputError as error:
        return str(error)
    return ""


def grid_nodes(scene: tf.Scene, dtype: torch.dtype) -> int:
    """The number of grid nodes of one colony; 0 without a medium."""
    layout = scene.seed(1, dtype=dtype, device="cpu").layout
    return 0 if layout is None else layout.grid.nodes


def failures(state: tf.State) -> dict[int, tuple[int, str]]:
    """The colonies that failed in the last step, in order of their place in the batch: place to
    (colony id, first reason)."""
    first = {f.place: (f.colony_id, f.reason) for f in reversed(tf.failures(state))}
    return {place: first[place] for place in sorted(first)}
