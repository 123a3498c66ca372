"""The capsule's volume, area and drag, and the rotation of axes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import array, unit
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from torchfilm.physics import capsule

# float32 keeps 6e-8 of each number, and each formula has fewer than ten operations
ROUNDING = {torch.float32: 1e-6, torch.float64: 1e-14}
SIZES = [(0.0, 0.5), (2.0, 0.5), (3.75, 0.4), (40.0, 1.3)]


def profile(x: float, length: float, radius: float) -> float:
    """Radius of the capsule's cross-section at position x along its axis."""
    beyond = max(0.0, abs(x) - 0.5 * length)
    return math.sqrt(max(0.0, radius**2 - beyond**2))


@pytest.mark.parametrize("length, radius", SIZES)
def test_volume_is_the_integral_of_the_cross_section(device, dtype, length, radius):
    half = 0.5 * length
    inside = quad(
        lambda x: math.pi * profile(x, length, radius) ** 2,
        -half - radius,
        half + radius,
        points=[-half, half],
        epsabs=1e-12,
    )[0]
    found = capsule.volume(
        torch.tensor(length, dtype=dtype, device=device),
        torch.tensor(radius, dtype=dtype, device=device),
    )
    assert float(found) == pytest.approx(inside, rel=max(ROUNDING[dtype], 1e-11))


@pytest.mark.parametrize("length, radius", SIZES)
def test_area_is_how_volume_grows_with_radius(device, dtype, length, radius):
    """dV/dr at a fixed centreline is the surface.

    Central differences with h = 1e-5 have an error of h²/6 V‴ = h² 4π/3.
    """
    v = lambda r: math.pi * r * r * (length + 4 * r / 3)
    slope = (v(radius + 1e-5) - v(radius - 1e-5)) / 2e-5
    found = capsule.area(
        torch.tensor(length, dtype=dtype, device=device),
        torch.tensor(radius, dtype=dtype, device=device),
    )
    assert float(found) == pytest.approx(slope, rel=max(ROUNDING[dtype], 1e-8))


def test_drag_follows_the_model():
    """μL, μL³/12 and μLr²/2 for L = l + 2r = 3, μ = 2, r = ½: 6, 4.5 and 0.75, all exact in
    binary."""
    found = capsule.drag(torch.tensor([2.0]), torch.tensor([0.5]), 2.0)
    assert [float(x) for x in found] == [6.0, 4.5, 0.75]


def test_drag_of_a_sphere_is_positive(dtype):
    assert all(
        float(x) > 0
        for x in capsule.drag(torch.zeros(1, dtype=dtype), torch.full((1,), 0.5, dtype=dtype), 1.0)
    )


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-3, 0.1, 0.5, 1.0])
def test_rotate_is_the_exact_rotation_in_3d(device, dtype, size):
    """Against SciPy. The docstring promises 1e-16 for angles up to 1; float32 has 1e-7 per
    operation.
    """
    rng = np.random.default_rng(1)
    axis, turn = unit(rng, 50, 3), size * unit(rng, 50, 3)
    t = lambda x: torch.as_tensor(x, dtype=dtype, device=device)
    axis, turn = t(axis), t(turn)
    expected = Rotation.from_rotvec(array(turn)).apply(array(axis))
    assert (
        np.abs(array(capsule.rotate(axis, turn)) - expected).max()
        <= {torch.float32: 3e-7, torch.float64: 1e-15}[dtype]
    )


@pytest.mark.parametrize("angle", [0.0, 1e-8, -0.3, 1.0])
def test_rotate_turns_to_the_left_in_2d(device, dtype, angle):
    start = torch.tensor([[math.cos(0.4), math.sin(0.4)]], dtype=dtype, device=device)
    found = array(capsule.rotate(start, torch.tensor([[angle]], dtype=dtype, device=device)))[0]
    expected = [math.cos(0.4 + angle), math.sin(0.4 + angle)]
    assert np.abs(found - expected).max() <= {torch.float32: 2e-7, torch.float64: 1e-15}[dtype]


@pytest.mark.parametrize("dim", [2, 3])
def test_axis_stays_a_unit_vector_over_many_turns(device, dtype, dim):
    rng = np.random.default_rng(2)
    axis = torch.as_tensor(unit(rng, 20, dim), dtype=dtype, device=device)
    for _ in range(200):
        axis = capsule.rotate(
            axis,
            torch.as_tensor(
                0.5 * rng.normal(size=(20, 1 if dim == 2 else 3)), dtype=dtype, device=device
            ),
        )
    # renormalised each time: off by a rounding or two, 1.2e-7 in float32
    assert (
        float((axis.double().norm(dim=1) - 1).abs().max())
        <= {torch.float32: 2e-7, torch.float64: 1e-15}[dtype]
    )


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("size", [0.0, 0.3])
def test_gradient_of_rotate(dim, size):
    """The gradient is not singular at an angle of zero."""
    rng = np.random.default_rng(3)
    axis = torch.tensor(unit(rng, 4, dim), requires_grad=True)
    turn = torch.tensor(size * rng.normal(size=(4, 1 if dim == 2 else 3)), requires_grad=True)
    assert torch.autograd.gradcheck(capsule.rotate, (axis, turn))
