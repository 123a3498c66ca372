"""Cells that divide, for tests."""

from __future__ import annotations

import torch

import torchfilm as tf


def row_of_cells(
    count: int, length: float | list[float] = 2.0, dim: int = 2, radius: float = 0.5
) -> tf.Cells:
    """Cells far apart, at varied angles."""
    position = torch.zeros(count, dim, dtype=torch.float64)
    position[:, 0] = 10.0 * torch.arange(count)
    angle = torch.arange(count, dtype=torch.float64)
    axis = torch.zeros_like(position)
    axis[:, 0], axis[:, 1] = torch.cos(angle), torch.sin(angle)
    if dim == 3:
        axis[:, 2] = torch.sin(2 * angle)
    return tf.Cells(position, axis, length, radius)


def flagged(scene: tf.Scene, colonies: int = 1, which=None, **options) -> tf.State:
    """A first state in which the cells `which` (all of them by default) are told to divide."""
    state = scene.bind(colonies, **{"dtype": torch.float64, **options}).start()
    flag = torch.zeros(state.cells, dtype=torch.bool, device=state.device)
    flag[slice(None) if which is None else which] = True
    return state.with_fields(divide_flag=flag)
