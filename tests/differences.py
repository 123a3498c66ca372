"""Shared by the tests of gradients: comparison with central differences, and cells that grow
through contacts. tests/test_gradients.py gives the reason for the tolerance."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from helpers import step
from torch import Tensor

import torchfilm as tf
from torchfilm.tools.checks import SimulationError

RELATIVE = 1e-5
H = 1e-5
F64 = torch.float64


def scattered(dim: int, count: int = 5) -> tf.Cells:
    """Rods at generic angles, near enough to push each other, none of them in a special
    position."""
    generator = torch.Generator().manual_seed(5)
    position = torch.zeros(count, dim, dtype=F64)
    position[:, 1] = 0.93 * torch.arange(count)
    position += 0.15 * torch.randn(count, dim, dtype=F64, generator=generator)
    axis = 0.35 * torch.randn(count, dim, dtype=F64, generator=generator)
    axis[:, 0] += 1.0
    length = 1.8 + 0.3 * torch.rand(count, dtype=F64, generator=generator)
    return tf.Cells(position, axis, length)


def mechanics(dim: int, **options) -> tf.Mechanics:
    return tf.Mechanics(**{"dim": dim, "tolerance": 1e-10, "alpha": 0.1, **options})


def weights(like: Tensor) -> Tensor:
    """Fixed and generic, so that no symmetry hides an error; the first ones of a fixed sequence."""
    return torch.sin(1.0 + 1.7 * torch.arange(like.numel(), dtype=F64)).reshape(like.shape)


def outcome(state: tf.State) -> Tensor:
    """One number that depends on everything mechanical: places, axes and lengths."""
    return sum((x * weights(x)).sum() for x in (state.position, state.axis, state.length))


def run(scene: tf.Scene, state: tf.State, steps: int = 8, dt: float = 0.05) -> tf.State:
    for _ in range(steps):
        state = step(scene, state, dt)
        report = state.reports.get("mechanics")
        if report is not None and bool((report.status != 0).any()):
            raise SimulationError(str(report))
    return state


Experiment = Callable[[Tensor], tf.State]


def compare(
    outcome: Callable[[tf.State], Tensor],
    experiment: Experiment,
    at: list[float] | float,
    *,
    divides: bool = False,
) -> Tensor:
    """Compare d outcome / d parameters with central differences, one parameter at a time; returns
    the gradient."""
    value = torch.tensor(at, dtype=F64, requires_grad=True)
    last = experiment(value)
    assert (last.parent >= 0).any() == divides, (
        "the run should have divided" if divides else "the run should not have divided"
    )
    (gradient,) = torch.autograd.grad(outcome(last), value)
    assert torch.isfinite(gradient).all()
    flat, found = value.detach().reshape(-1), []
    with torch.no_grad():
        for k in range(flat.numel()):
            ends = []
            for h in (H, -H):
                moved = flat.clone()
                moved[k] += h
                state = experiment(moved.reshape(value.shape))
                assert torch.equal(state.uid, last.uid), "the difference straddles a division"
                ends.append(float(outcome(state)))
            found.append((ends[0] - ends[1]) / (2 * H))
    difference = torch.tensor(found, dtype=F64).reshape(value.shape)
    size = float(difference.abs().max())
    assert size > 1e-3, "nothing depends on it: the comparison would prove nothing"
    assert float((gradient - difference).abs().max()) <= RELATIVE * size, (
        gradient.tolist(),
        difference.tolist(),
    )
    return gradient


check = partial(compare, outcome)


def growing(dim: int, rate: Tensor, *more: tf.Effect, law: str = "volume", **options) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=rate, law=law), *more, mechanics(dim, **options), founders=scattered(dim)
    )


def seeded(scene: tf.Scene, **options) -> tf.State:
    return scene.bind(dtype=F64, **options).start()


def between_walls(dim: int, **soft) -> list[tf.Plane]:
    """Two walls that press on the row of cells; in space two more across."""
    walls = [tf.Plane(y=-0.75, facing="+y", **soft), tf.Plane(y=4.4, facing="-y")]
    return (
        walls
        if dim == 2
        else [*walls, tf.Plane(z=-0.8, facing="+z", **soft), tf.Plane(z=0.8, facing="-z")]
    )
