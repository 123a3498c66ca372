"""Gradients through maxima over colonies and through measures."""

from __future__ import annotations

import math

import pytest
import torch

import torchfilm as tf
from torchfilm import measure, parts
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import forward_mode, tangent, with_tangent

F64 = torch.float64
TWO = tf.Cells([[0.0, 0.0], [9.0, 1.0]], [[1.0, 0.0], [0.6, 0.8]], length=[2.0, 2.6])
FOUR = tf.Cells(
    [[0.0, 0.0], [4.0, 1.0], [-4.0, 1.0], [0.0, 5.0]],
    [[1.0, 0.0], [0.6, 0.8], [0.8, -0.6], [0.0, 1.0]],
)


def slopes(loss, at: float, h: float = 1e-5) -> tuple[float, float]:
    """By the backward pass, and by differences."""
    x = torch.tensor(at, dtype=F64, requires_grad=True)
    (found,) = torch.autograd.grad(loss(x), x)
    with torch.no_grad():
        return float(found), float(loss(x + h) - loss(x - h)) / (2 * h)


@pytest.mark.parametrize("top", ["colony_max", "colony_min"])
def test_rules_pass_gradients_through_the_greatest_of_a_colony(top):
    """Levels relative to the greatest had the gradient of the levels: 0.76 in place of 0.012."""

    def loss(k):
        def relative(cells):
            cells.rel = cells.g / getattr(cells, top)(cells.g)

        circuit = tf.Circuit(
            lambda u, s, p, cell: {"g": p.k - u.g * cell.length}, species="g", k=k,
            initial={"g": 0.5}, rtol=1e-8,
        )  # fmt: skip
        scene = tf.Scene(
            tf.Rules(relative, variables={"rel": 1.0}), tf.Growth(rate=1.0), circuit,
            founders=TWO, dim=2, dt=0.05,
        )  # fmt: skip
        *_, last = tf.simulate(scene, scene.bind(dtype=F64).start(), until=0.5)
        return last.rel.sum()

    found, expected = slopes(loss, 2.0)
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("size", [1, 3])
def test_the_greatest_of_a_group_has_derivatives(size):
    """Both ways; a group without rows has none, and of equal rows the first has it."""
    owner = torch.tensor([0, 0, 0] if size == 1 else [2, 0, 2])
    groups, x = Groups(owner, size), torch.tensor([1.0, 3.0, 1.0 if size == 3 else 3.0], dtype=F64)
    back = x.clone().requires_grad_()
    found = groups.max(back, empty=-7.0)
    assert torch.equal(found.detach(), groups.max(x, empty=-7.0))
    (found * torch.arange(1.0, size + 1, dtype=F64)).sum().backward()
    assert back.grad.tolist() == ([0.0, 1.0, 0.0] if size == 1 else [3.0, 1.0, 0.0])
    with forward_mode():
        turned = tangent(groups.max(with_tangent(x, torch.tensor([1.0, 2.0, 4.0], dtype=F64))))
        assert turned.tolist() == ([2.0] if size == 1 else [2.0, 0.0, 1.0])
    nothing = Groups(torch.zeros(0, dtype=torch.int64), 2).max(torch.zeros(0, requires_grad=True))
    assert nothing.tolist() == [0.0, 0.0]


MEASURES = {
    "colony_radius": lambda first, last: measure.colony_radius(last),
    "nematic_order": lambda first, last: measure.nematic_order(last),
    "depth": lambda first, last: measure.depth(last),
    "profile": lambda first, last: measure.profile(last, "g", [0.0, 9.0], along="radius"),
    "growth_rates": lambda first, last: measure.growth_rates(last, first),
    "displacement": lambda first, last: measure.displacement(last, first) ** 2,
}


@pytest.mark.parametrize("name", list(MEASURES))
def test_measures_pass_gradients(name):
    """Beside another term of a loss, those that passed none made it wrong in silence."""

    def loss(rate):
        scene = tf.Scene(
            tf.Growth(rate=rate), tf.Mechanics(dim=2, tolerance=1e-9),
            tf.Circuit(lambda u, s, p, cell: {"g": 0.2 - u.g * cell.length}, species="g"),
            founders=FOUR, dt=0.05,
        )  # fmt: skip
        first = scene.bind(dtype=F64).start()
        *_, last = tf.simulate(scene, first, until=0.5)
        return MEASURES[name](first, last).sum() + 1e-3 * last.length.sum()

    found, expected = slopes(loss, 1.0, 1e-4)
    assert found == pytest.approx(expected, rel=1e-5)


def test_tilt_and_depth_in_space_pass_gradients():
    """By the direction of axes, also of a cell that stands upright; and by the cell that reaches
    highest."""
    axes = torch.tensor([[0.8, 0.0, 0.6], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=F64)
    cells = tf.Cells([[0.0, 0, 0], [5.0, 0, 0.5], [9.0, 0, 0]], axes, length=[2.0, 2.0, 0.1])
    state = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=3).bind(dtype=F64).start()
    axis = state.axis.clone().requires_grad_()
    moved = state.replace(axis=axis)
    tilt = torch.autograd.grad(measure.tilt(moved).sum(), axis)[0]
    assert tilt[0].tolist() == pytest.approx([-0.6, 0.0, 0.8])  # per radian along the circle
    assert tilt[2].tolist() == [0.0, 0.0, 0.0]
    assert measure.tilt(state).tolist() == pytest.approx([math.asin(0.6), 0.0, math.pi / 2])
    # the first cell's ends are ± 0.6 + r, others' centres at 0.5 and 0: both ends are the first's
    depth = torch.autograd.grad(measure.depth(moved).sum(), axis)[0]
    assert depth[:, 2].tolist() == pytest.approx([2.0, 0.0, 0.0])


def test_a_colony_without_cells_has_no_radius():
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2)
    state = scene.bind(2).start()
    one = state.take(torch.tensor([1]))
    assert one.counts.tolist() == [0, 1]
    radius = measure.colony_radius(one)
    assert bool(radius[0].isnan()) and float(radius[1]) == 0.0


def test_one_cell_has_a_radius_of_0_and_a_finite_gradient():
    """It was NaN, in all that shares a parameter."""
    rate = torch.tensor([1.0, 1.0], dtype=F64, requires_grad=True)
    scene = tf.Scene(tf.Growth(rate=rate), tf.Division(length=3.0), dim=2, dt=0.05)
    *_, last = tf.simulate(scene, scene.bind(2, dtype=F64).start(), until=0.2)
    radius = measure.colony_radius(last)
    assert radius.tolist() == [0.0, 0.0]
    (radius + last.groups.sum(last.length)).sum().backward()
    assert bool(rate.grad.isfinite().all()) and bool((rate.grad > 0.1).all())


def test_a_rate_of_a_counted_reaction_that_requires_a_gradient_is_warned_of():
    rate = torch.tensor(10.0, dtype=F64, requires_grad=True)
    circuit = tf.Circuit([parts.constitutive("m", rate)], species="m", method="tau_leap")
    scene = tf.Scene(tf.Growth(rate=1.0), circuit, dim=2, dt=0.1)
    with pytest.warns(UserWarning, match="passes no gradient on"):
        scene.bind(dtype=F64)
