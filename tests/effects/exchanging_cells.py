"""Shared by the tests of media: cells that exchange a signal, amounts, steps."""

from __future__ import annotations

import numpy as np
import torch
from helpers import step
from torch import Tensor

import torchfilm as tf

F64 = torch.float64
BOX = ((-16.0, -16.0), (16.0, 16.0))


def membrane(u, s, p, cell):
    """Exchange and nothing else: what one side loses the other gains."""
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    return {"ahl": into / cell.volume}, {"ahl": -into}


def exchanging(start: float = 3.0, *, D1: float = 1.0, **options) -> tf.Circuit:
    return tf.Circuit(membrane, species=("ahl",), initial={"ahl": start}, D1=D1, **options)


def resting(
    medium: tf.Medium,
    circuit: tf.Circuit | None = None,
    founders: tf.Cells | None = None,
    **options,
) -> tf.Scene:
    """Cells that neither grow nor move."""
    return tf.Scene(
        circuit or exchanging(), medium, founders=founders or tf.Cells.single(2), **options
    )


def totals(state: tf.State, name: str = "ahl", inside: bool = True) -> Tensor:
    """Amount of a substance in cells, medium and beyond, conc·µm³, per colony (B,) float64."""
    grid = state.layout.grid
    out = torch.zeros(state.colonies, dtype=F64, device=state.device).index_add(
        0, grid.owner, state.signals[name].double() * grid.voxel_volume
    )
    if inside:
        out = out.index_add(0, state.colony, state.fields[name].double() * state.volume.double())
    return (
        out + state.fields[f"{name}_reservoir"].double()
        if f"{name}_reservoir" in state.fields
        else out
    )


def advance(scene: tf.Scene, state: tf.State, steps: int, dt: float) -> tf.State:
    for _ in range(steps):
        state = step(scene, state, dt)
        assert all(bool((r.status == 0).all()) for r in state.reports.values())
    return state


def diffused(field: np.ndarray, rate: float) -> np.ndarray:
    """How fast a field (nx, ny, nz) changes by diffusion, (voxels,), in a box whose faces let
    nothing pass. rate: K/h², 1/h."""
    change = np.zeros_like(field)
    for axis in range(3):
        flux = np.diff(field, axis=axis) * rate
        pad = [(1, 1) if k == axis else (0, 0) for k in range(3)]
        change += np.diff(np.pad(flux, pad), axis=axis)
    return change.reshape(-1)
