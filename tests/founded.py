"""Shared by the tests of scenes: founders side by side, and in a crowd."""

from __future__ import annotations

import torch

import torchfilm as tf


def cells_in(dim: int, count: int = 2) -> tf.Cells:
    position = torch.zeros(count, dim)
    position[:, 0] = 3.0 * torch.arange(count)
    axis = torch.zeros(count, dim)
    axis[:, 1] = 1.0
    return tf.Cells(position, axis)


def crowd(dim: int = 2) -> tf.Cells:
    """Overlapping cells, so that every parameter of the mechanics matters."""
    position = torch.zeros(4, dim, dtype=torch.float64)
    position[:, 1] = torch.tensor([0.0, 0.8, 1.6, 2.4], dtype=torch.float64)
    position[:, 0] = torch.tensor([0.0, 0.4, 0.1, 0.3], dtype=torch.float64)
    axis = torch.zeros_like(position)
    axis[:, 0] = 1.0
    return tf.Cells(position, axis, [1.9, 2.0, 2.1, 2.2])
