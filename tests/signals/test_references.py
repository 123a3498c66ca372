"""Transport against closed-form solutions, and the convergence of each method and of the grid."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import ive

from torchfilm.signals.boundary_conditions import (
    BoundaryConditions,
    Dirichlet,
    Face,
    NoFlux,
    Open,
    Periodic,
)
from torchfilm.signals.transport import prepare
from torchfilm.signals.transport_operator import apply
from torchfilm.signals.transport_rates import build_operator

D = torch.float64


def lattice_point_source(n: int, tau: float) -> np.ndarray:
    """h³ u, (n, n, n), of a unit amount released in the middle voxel at τ = K t/h² ago: Π e^{−2τ}
    I_k(2τ).
    """
    one = ive(np.abs(np.arange(n) - n // 2), 2 * tau)
    return one[:, None, None] * one[None, :, None] * one[None, None, :]


def point_source(n: int, h: float, dtype=D, device="cpu") -> torch.Tensor:
    u = torch.zeros(1, n, n, n, dtype=dtype, device=device)
    u[0, n // 2, n // 2, n // 2] = h**-3
    return u


def run(op, dt, method, u, steps):
    stepper = prepare(op, dt, method)
    for _ in range(steps):
        u = stepper.step(u)
    return u


def test_the_lattice_point_source_itself():
    """The guide's value at the centre after τ = 1, and the total amount: the reference is right."""
    u = lattice_point_source(33, 1.0)
    assert u[16, 16, 16] == pytest.approx(0.0293630, abs=5e-8)
    assert u.sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("steps", [1, 5])
def test_exponential_gives_the_lattice_point_source(device, dtype, steps):
    """h = 1.5, K = 2: exact except for the amount at the walls, 16 voxels away, e^−2 I_16(2) =
    3e-15.

    Rounding is that of a value of 0.03/h³ at most.
    """
    n, h, k = 33, 1.5, 2.0
    op = build_operator((n, n, n), (h, h, h), diffusion=k, dtype=dtype, device=device)
    found = (
        run(op, h * h / k / steps, "exponential", point_source(n, h, dtype, device), steps)[0]
        .cpu()
        .double()
        .numpy()
        * h**3
    )
    assert np.abs(found - lattice_point_source(n, 1.0)).max() <= (1e-14 if dtype == D else 3e-8)


@pytest.mark.parametrize("method, order", [("implicit", 1), ("crank_nicolson", 2), ("euler", 1)])
def test_order_in_time_for_the_lattice_point_source(method, order):
    """Error at the centre with 24 and 48 steps to τ = 1: 2^−order within 0.15.

    Steps are short enough that Crank–Nicolson does not oscillate, r = 1/24.
    """
    n, error = 17, []
    for steps in (24, 48):
        op = build_operator((n, n, n), (1.0, 1.0, 1.0), diffusion=1.0, dtype=D)
        found = run(op, 1.0 / steps, method, point_source(n, 1.0), steps)
        error.append(abs(float(found[0, 8, 8, 8]) - 0.0293630))
    assert math.log2(error[0] / error[1]) == pytest.approx(order, abs=0.15)
    assert error[0] <= {"implicit": 3e-3, "crank_nicolson": 1e-4, "euler": 3e-3}[method]


def test_order_in_space():
    """A cosine in a closed box decays as e^{−K(π/L)²t}.

    The method is exact in time, so the error is the grid's, of second order within 0.02.
    """
    length, error = 10.0, []
    for n in (16, 32):
        h = length / n
        x = (torch.arange(n, dtype=D) + 0.5) * h
        u = torch.cos(math.pi * x / length).reshape(1, n, 1, 1)
        op = build_operator((n, 1, 1), (h, 1.0, 1.0), diffusion=2.0, dtype=D)
        found = prepare(op, 3.0, "exponential").step(u)
        error.append(
            float((found - u * math.exp(-2.0 * (math.pi / length) ** 2 * 3.0)).abs().max())
        )
    assert math.log2(error[0] / error[1]) == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize("peclet", [0.0, 1e-6, 1.0, -3.0, 40.0, 400.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_steady_profile_between_fixed_walls(dtype, device, peclet, axis):
    """(e^{Pe·x} − 1)/(e^{Pe} − 1) is exact at every centre, with any number of voxels.

    One long step reaches it; the remaining error is 1/Δt.
    """
    n, length, k = 10, 5.0, 0.7
    shape, spacing = [1, 1, 1], [1.0, 1.0, 1.0]
    shape[axis], spacing[axis] = n, length / n
    velocity = [0.0, 0.0, 0.0]
    velocity[axis] = peclet * k / length
    faces: list[Face | tuple[Face, Face]] = [NoFlux(), NoFlux(), NoFlux()]
    faces[axis] = (Dirichlet(0.0), Dirichlet(1.0))
    op = build_operator(
        tuple(shape),
        tuple(spacing),
        diffusion=k,
        velocity=tuple(velocity),
        boundary=BoundaryConditions(*faces),
        dtype=dtype,
        device=device,
    )
    x = (np.arange(n) + 0.5) / n
    expected = x if peclet == 0 else np.expm1(peclet * x) / np.expm1(peclet)
    # relative to 1; the remaining error after 1e13 h with rates of 1/h is below it
    tolerance = 2e-12 if dtype == D else 1e-6
    for method in ("exponential", "implicit"):
        found = prepare(op, 1e13 if method == "implicit" else 1e4, method).step(
            torch.zeros(1, *shape, dtype=dtype, device=device)
        )
        assert np.abs(found.cpu().double().numpy().reshape(-1) - expected).max() <= tolerance


def test_a_sink_everywhere_has_its_decay_length():
    """Between neighbouring voxels a steady field falls by q = 1 + κ/2 − √(κ + κ²/4), κ = k h²/K,
    exactly.

    To second order in h this is e^{−h√(k/K)}.
    """
    k, decay, error = 3.0, 0.5, []
    for h in (1.0, 0.5):
        n = round(200 / h)
        op = build_operator(
            (n, 1, 1),
            (h, 1.0, 1.0),
            diffusion=k,
            decay=decay,
            boundary=BoundaryConditions(x=(Dirichlet(1.0), NoFlux())),
            dtype=D,
        )
        kappa = decay * h**2 / k
        q = 1 + kappa / 2 - math.sqrt(kappa + kappa**2 / 4)
        for method in ("exponential", "implicit"):
            u = (
                prepare(op, 1e13 if method == "implicit" else 1e4, method)
                .step(torch.zeros(1, n, 1, 1, dtype=D))
                .reshape(-1)
            )
            # down to 1e-7 of the wall's value, with 1e-12 of rounding
            ratio = (u[1:] / u[:-1])[: round(40 / h)]
            assert float((ratio - q).abs().max()) <= 1e-9
        error.append(abs(-math.log(q) / h - math.sqrt(decay / k)))
    assert math.log2(error[0] / error[1]) == pytest.approx(2.0, abs=0.05)


def test_a_steady_point_source():
    """Q/(4πKr), as the difference between two distances, with second order in h/r.

    The walls of a cubic box hardly change it: their images add r⁴ terms only. At 12 and 24 µm, with
    voxels of 4 and then 4/3 µm, the error falls about ninefold, to under 1 %.
    """
    rate, k, error, side = 5.0, 2.0, [], 132.0
    for h in (4.0, 4.0 / 3.0):  # odd numbers of voxels, so that one is in the middle
        n = round(side / h)
        m = n // 2
        source = torch.zeros(n, n, n, dtype=D)
        source[m, m, m] = rate / h**3
        op = build_operator(
            (n, n, n),
            (h, h, h),
            diffusion=k,
            source=source,
            boundary=BoundaryConditions(*[Dirichlet(0.0)] * 3),
            dtype=D,
        )
        u = prepare(op, 3e4, "exponential").step(torch.zeros(1, n, n, n, dtype=D))[0]
        near, far = (float(u[m + round(r / h), m, m]) for r in (12.0, 24.0))
        exact = rate / (4 * math.pi * k) * (1 / 12.0 - 1 / 24.0)
        error.append(abs((near - far) / exact - 1))
    assert error[1] <= 0.01 and 5 <= error[0] / error[1] <= 13  # about 3²


@pytest.mark.parametrize("method", ["exponential", "implicit"])
def test_an_open_box_is_washed_out(method, dtype, device):
    """Flow from −x through open ends, without diffusion: `outside` replaces the content of the box.

    n voxels fill one after another.
    """
    n, v = 12, 3.0
    op = build_operator(
        (n, 1, 1),
        (1.0, 1.0, 1.0),
        diffusion=0.0,
        velocity=(v, 0.0, 0.0),
        boundary=BoundaryConditions(x=Open(2.0)),
        dtype=dtype,
        device=device,
    )
    u = torch.full((1, n, 1, 1), 5.0, dtype=dtype, device=device)
    later = prepare(op, 40.0, method).step(u)
    if method == "exponential":
        # Erlang: the part of the first voxels' old content that remains after vt = 120 is e^−120 Σ
        # 120^k/k! = 1e-36
        assert float((later - 2.0).abs().max()) <= 2e-6
    assert bool((later[0, :-1] - later[0, 1:] <= 1e-6).all()) and float(later.min()) >= 2.0 - 1e-6
    assert float(later.max()) <= 5.0


def test_a_wave_on_a_ring_is_carried_around():
    """Periodic: the mean position of the amount moves by v t; its variance grows by 2 K t and by
    upwinding.

    float64, far from all ends.
    """
    n, h, v, k, t = 200, 0.5, 2.0, 1.0, 4.0
    x = (torch.arange(n, dtype=D) + 0.5) * h
    u = torch.exp(-((x - 40.0) ** 2) / 4).reshape(1, n, 1, 1)
    op = build_operator(
        (n, 1, 1),
        (h, 1.0, 1.0),
        diffusion=k,
        velocity=(v, 0.0, 0.0),
        boundary=BoundaryConditions(x=Periodic()),
        dtype=D,
    )
    later = prepare(op, t, "exponential").step(u).reshape(-1)
    mass, u = later.sum(), u.reshape(-1)
    mean = float((later * x).sum() / mass)
    assert mean == pytest.approx(40.0 + v * t, abs=1e-9)
    spread = lambda w, m: float((w * (x - m) ** 2).sum() / w.sum())
    # fitted rates diffuse as K·(Pe/2)coth(Pe/2), Pe = v h/K = 1
    assert spread(later, mean) - spread(u, 40.0) == pytest.approx(
        2 * k * t * 0.5 / math.tanh(0.5), abs=1e-8
    )


def test_a_field_at_rest_has_no_rate():
    """At the steady profile du/dt is rounding, with rates of 4/h² = 16 and values of 1."""
    op = build_operator(
        (10, 1, 1),
        (0.5, 1.0, 1.0),
        diffusion=1.0,
        velocity=(2.0, 0.0, 0.0),
        boundary=BoundaryConditions(x=(Dirichlet(0.0), Dirichlet(1.0))),
        dtype=D,
    )
    x = (torch.arange(10, dtype=D) + 0.5) / 10
    u = (torch.expm1(10 * x) / math.expm1(10.0)).reshape(1, 10, 1, 1)
    assert float(apply(op, u).abs().max()) <= 1e-13
