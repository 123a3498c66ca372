"""Steps of transport: each method against dense linear algebra, its order in time, and which method
suits. (`test_transport_laws` has bounds, gradients and bits.)"""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from test_operator import BOUNDARIES, FLOWS, SHAPES, SPACING, every, make

from torchfilm.signals.boundary_conditions import BoundaryConditions, Dirichlet
from torchfilm.signals.transport import choose, prepare
from torchfilm.signals.transport_iterative import prepare_backward_euler, prepare_crank_nicolson
from torchfilm.signals.transport_operator import apply
from torchfilm.signals.transport_rates import build_operator
from torchfilm.signals.transport_series import MOST
from torchfilm.tools.checks import InputError

MASKED = pytest.mark.parametrize("masked", [False, True], ids=["", "obstacles"])


def start(shape, mask=1.0, seed=1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=shape) * mask


def stepped(op, dt, method, u: np.ndarray, steps: int = 1) -> np.ndarray:
    """u (nx, ny, nz) after some steps."""
    stepper, v = prepare(op, dt, method), torch.as_tensor(u, dtype=op.dtype, device=op.device)[None]
    for _ in range(steps):
        v = stepper.step(v)
    assert v.dtype == op.dtype
    return v[0].cpu().double().numpy()


def exact(matrix: np.ndarray, gain: np.ndarray, dt: float, u: np.ndarray) -> np.ndarray:
    """exp of the matrix with the gain as a last column."""
    size = len(gain)
    larger = np.zeros((size + 1,) * 2)
    larger[:size, :size], larger[:size, size] = dt * matrix, dt * gain
    power = scipy.linalg.expm(larger)
    return (power[:size, :size] @ u.reshape(-1) + power[:size, size]).reshape(u.shape)


@pytest.mark.parametrize("dt", [1e-3, 0.7, 40.0])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("faces", BOUNDARIES)
@pytest.mark.parametrize("kind", FLOWS[:2])
def test_exponential_is_exact(device, dtype, shape, faces, kind, dt):
    """Against scipy's expm, accurate to some 1e-12 of the values, which reach 10 as the box fills.

    float32: 100 roundings.
    """
    op, matrix, gain, _ = make(shape, faces, kind, dtype=dtype, device=device)
    u = start(shape)
    expected = exact(matrix, gain, dt, u)
    tolerance = (1e-12 if dtype == torch.float64 else 1e-5) * max(1.0, np.abs(expected).max())
    assert np.abs(stepped(op, dt, "exponential", u) - expected).max() <= tolerance


@pytest.mark.parametrize("dt", [1e-3, 0.7, 4.0])
@every
@MASKED
def test_series_is_exact(dtype, shape, faces, kind, masked, dt):
    """As above, for any operator; up to 200 terms, each with a few roundings in float64."""
    op, matrix, gain, mask = make(shape, faces, kind, masked, dtype=dtype)
    u = start(shape, mask)
    expected = exact(matrix, gain, dt, u)
    tolerance = (1e-12 if dtype == torch.float64 else 1e-6) * max(1.0, np.abs(expected).max())
    assert np.abs(stepped(op, dt, "series", u) - expected).max() <= tolerance


def test_beyond_its_last_term_the_series_is_one_solve():
    """In its own colony only; the other has the bits that it has alone."""
    of = lambda diffusion: build_operator(
        (6, 5, 1), SPACING, diffusion=torch.tensor(diffusion), source=0.3, colonies=len(diffusion)
    )
    u = torch.as_tensor(start((2, 6, 5, 1)), dtype=torch.float32)
    slow, fast = 1.0, MOST / 2.5  # 2 K (1/h_x² + 1/h_y²) Δt is the mean number of exchanges
    both = prepare(of([slow, 1.1 * fast]), 1.0, "series")
    assert both.far.tolist() == [False, True]
    alone = prepare(of([slow]), 1.0, "series").step(u[:1])
    solved = prepare_backward_euler(of([1.1 * fast]), 1.0).step(u[1:])
    assert torch.equal(both.step(u), torch.cat([alone, solved]))
    assert prepare(of([0.9 * fast]), 1.0, "series").far is None


def around(kind: str):
    """The audit's box, 33 × 33 voxels of 4 µm with a source in the middle, and a reason for which
    "exponential" cannot carry it; an amount for each voxel and hour comes in at the source."""
    n, shape = 33, (33, 33, 1)
    source, mask = torch.zeros(shape, dtype=torch.float64), None
    source[n // 2, n // 2] = 1.0
    decay, velocity = torch.ones(shape, dtype=torch.float64), None
    if kind == "obstacle":
        mask = torch.ones(shape, dtype=torch.bool)
        mask[18:25, 10:20] = False
    if kind == "shear":
        across = torch.linspace(-60.0, 60.0, n, dtype=torch.float64).reshape(1, n, 1)
        still = torch.zeros(n, n + 1, 1).double(), torch.zeros(n, n, 2).double()
        velocity = (across.expand(n + 1, n, 1), *still)
    return build_operator(
        shape,
        (4.0, 4.0, 4.0),
        diffusion=100.0,
        decay=decay,
        velocity=velocity,
        mask=mask,
        source=source,
        dtype=torch.float64,
    )


@pytest.mark.parametrize("kind", ["decay", "obstacle", "shear"])
@pytest.mark.parametrize("dt", [0.0125, 0.025, 0.1, 1.0, 10.0, 100.0, 4e3])
def test_a_steady_state_does_not_depend_on_the_step(kind, dt):
    """The default, with λΔt from 0.3 to 10⁵, against one dense solve of T u + q = 0, which is at
    rest under a step: u is the fixed point of a map that shrinks differences by 1/(1 + Δt) or more,
    so that its distance from it is at most what the step changes, over 1 − 1/(1 + Δt)."""
    op = around(kind)
    number = math.prod(op.shape)
    units = torch.eye(number, dtype=torch.float64).view(number, *op.shape)
    columns = torch.cat([apply(op, unit[None], gain=False).reshape(1, -1) for unit in units])
    gain = op.gain.reshape(-1)
    inside = torch.ones(number, dtype=torch.bool) if op.mask is None else op.mask.reshape(-1)
    steady = torch.zeros(number, dtype=torch.float64)
    steady[inside] = torch.linalg.solve(-columns.T[inside][:, inside], gain[inside])
    at_rest = steady.view(1, *op.shape)
    assert choose(op) == "series"
    stepper = prepare(op, dt)
    assert (stepper.far is not None) == (dt >= 100)
    change = float((stepper.step(at_rest) - at_rest).abs().sum())
    assert change * (1 + dt) / dt <= 1e-9 * float(steady.max())
    if dt == 0.025:  # the solve for one axis after the other is 5.7 % off at the source
        change = (prepare(op, dt, "implicit").step(at_rest) - at_rest).abs().sum()
        assert float(change) / -math.expm1(-dt) > 0.01 * float(steady.max())


@pytest.mark.parametrize("dt", [1e-3, 0.7, 1e4])
@every
@MASKED
def test_implicit_is_one_solve_an_axis(dtype, shape, faces, kind, masked, dt):
    """Against three dense solves, each with the matrix of one axis.

    Rounding: dense solves lose digits as Δt·T grows.
    """
    op, _, _, mask = make(shape, faces, kind, masked, dtype=dtype)
    u = start(shape, mask)
    expected = u.reshape(-1) + dt * 0.3 * mask.reshape(-1)
    long = [k for k in range(3) if shape[k] > 1] or [0]
    for axis in range(3):
        matrix, gain = one_axis(op, axis, 0.2 / len(long) if axis in long else 0.0, mask)
        expected = np.linalg.solve(np.eye(u.size) - dt * matrix, expected + dt * gain)
    scale = max(1.0, np.abs(expected).max())
    tolerance = (1e-12 * max(1.0, dt) if dtype == torch.float64 else 2e-5) * scale
    assert np.abs(stepped(op, dt, "implicit", u).reshape(-1) - expected).max() <= tolerance


def one_axis(op, axis: int, decay: float, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T and gain of one axis, (V, V) and (V,), voxel by voxel from its rates."""
    e, shape = op.axes[axis], op.shape
    number = np.arange(math.prod(shape)).reshape(shape)
    wide = tuple(n + (k == axis) for k, n in enumerate(shape))
    up, down = (x.expand(1, *wide)[0].numpy() for x in (e.up, e.down))
    low, high = (0.0 if x is None else float(x) for x in (e.low, e.high))
    matrix, gain = np.zeros((number.size,) * 2), np.zeros(number.size)
    for place in np.ndindex(*shape):
        i, n, above = (
            number[place],
            shape[axis],
            tuple(p + (k == axis) for k, p in enumerate(place)),
        )
        matrix[i, i] -= decay * mask[place] + down[place] + up[above]
        for rate, other, outside in (
            (up[place], place[axis] - 1, low),
            (down[above], place[axis] + 1, high),
        ):
            if 0 <= other < n or e.periodic:
                neighbour = tuple(other % n if k == axis else p for k, p in enumerate(place))
                matrix[i, number[neighbour]] += rate
            else:
                gain[i] += rate * outside
    return matrix, gain


@pytest.mark.parametrize("dt", [0.7, 1e3])
@every
@MASKED
def test_backward_euler_solves_its_equation(dtype, shape, faces, kind, masked, dt):
    """Against a dense solve; the error is 1e-10 of the right-hand side, which grows as Δt."""
    op, matrix, gain, mask = make(shape, faces, kind, masked, dtype=dtype)
    u = start(shape, mask)
    expected = np.linalg.solve(np.eye(u.size) - dt * matrix, u.reshape(-1) + dt * gain)
    found = prepare_backward_euler(op, dt).step(torch.as_tensor(u, dtype=dtype)[None])
    error = np.abs(found.double().numpy().reshape(-1) - expected).max()
    assert error <= (1e-8 if dtype == torch.float64 else 1e-6) * max(1.0, dt)


def test_backward_euler_conserves_and_stays_above_zero():
    """λΔt up to 10⁷, from one full voxel: to rounding of as many exchanges, and exactly."""
    for diffusion in (1e2, 1e4, 1e6):
        op = build_operator((31, 30, 1), (1.0, 1.0, 1.0), diffusion=diffusion, dtype=torch.float64)
        u = torch.zeros(1, 31, 30, 1, dtype=torch.float64)
        u[0, 4, 5] = 1.0
        for _ in range(3):
            u = prepare_backward_euler(op, 2.0).step(u)
        assert float(u.min()) >= 0
        assert abs(float(u.sum()) - 1) <= 1e-15 * 8 * diffusion + 1e-12


@every
@MASKED
def test_crank_nicolson_solves_its_equation(dtype, shape, faces, kind, masked):
    """Against a dense solve; the iteration has an error of 1e-10 of the right-hand side, which is
    of order 10.
    """
    op, matrix, gain, mask = make(shape, faces, kind, masked, dtype=dtype)
    u, dt = start(shape, mask), 0.7
    one = np.eye(u.size)
    expected = np.linalg.solve(
        one - dt / 2 * matrix, (one + dt / 2 * matrix) @ u.reshape(-1) + dt * gain
    ).reshape(shape)
    assert np.abs(stepped(op, dt, "crank_nicolson", u) - expected).max() <= (
        1e-8 if dtype == torch.float64 else 1e-6
    )


@every
@MASKED
def test_euler_is_its_power(dtype, shape, faces, kind, masked):
    """Against the dense (I + δT)^m, with the least m for which δ·(greatest loss) ≤ 1."""
    op, matrix, gain, mask = make(shape, faces, kind, masked, dtype=dtype)
    u, dt = start(shape, mask), 1.7
    count = max(1, math.ceil(dt * -np.diag(matrix).min()))
    expected = u.reshape(-1)
    for _ in range(count):
        expected = expected + dt / count * (matrix @ expected + gain)
    assert int(prepare(op, dt, "euler").substeps) == count
    assert np.abs(stepped(op, dt, "euler", u).reshape(-1) - expected).max() <= (
        1e-12 if dtype == torch.float64 else 2e-5
    ) * max(1.0, expected.max())


@pytest.mark.parametrize("method, order", [("implicit", 1), ("crank_nicolson", 2), ("euler", 1)])
@MASKED
def test_order_in_time(method, order, masked):
    """Half the step gives 2^−order of the error, within 0.15, in float64.

    Measured between Δt = 1/64 and 1/128 of a time over which the field changes much.
    """
    op, matrix, gain, mask = make((5, 4, 3), "mixed", "varying", masked)
    u = start((5, 4, 3), mask)
    expected = exact(matrix, gain, 1.0, u)
    error = [np.abs(stepped(op, 1.0 / n, method, u, n) - expected).max() for n in (64, 128)]
    assert math.log2(error[0] / error[1]) == pytest.approx(order, abs=0.15)


def test_implicit_at_rest_is_at_rest():
    """A uniform field between faces fixed at its value stays, for any step: each axis has its own
    faces.

    Some roundings of 5.
    """
    op = build_operator(
        (6, 5, 4),
        SPACING,
        diffusion=1.0,
        boundary=BoundaryConditions(*[(Dirichlet(5.0), Dirichlet(5.0))] * 3),
        dtype=torch.float64,
    )
    for dt in (1e-3, 1.0, 1e6):
        assert np.abs(stepped(op, dt, "implicit", np.full((6, 5, 4), 5.0), 3) - 5.0).max() <= 1e-13


def test_the_method_that_suits():
    assert choose(make((3, 2, 2))[0]) == "exponential"
    assert choose(make((3, 2, 2), kind="varying")[0]) == "series"
    assert choose(make((3, 2, 2), masked=True)[0]) == "series"
    with pytest.raises(InputError, match=r"exponential.*velocity is not uniform.*series"):
        prepare(make((3, 2, 2), kind="varying")[0], 0.1, "exponential")
    with pytest.raises(InputError, match=r"exponential.*obstacle.*series"):
        prepare(make((3, 2, 2), masked=True)[0], 0.1, "exponential")
    with pytest.raises(InputError, match="method"):
        prepare(make((3, 2, 2))[0], 0.1, "leapfrog")
    for dt in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="dt"):
            prepare(make((3, 2, 2))[0], dt)


def test_a_failed_solve_is_its_own_colonys():
    """A colony with a NaN is reported, and is NaN; the other continues as if alone."""
    op = build_operator(
        (4, 3, 2), SPACING, diffusion=1.0, velocity=(1.0, 0.0, 0.0), colonies=2, dtype=torch.float64
    )
    u = torch.as_tensor(start((2, 4, 3, 2)))
    well = prepare_crank_nicolson(op, 0.5).step(u)
    u[1, 0, 0, 0] = torch.nan
    out = prepare_crank_nicolson(op, 0.5).step(u)
    assert torch.equal(out[0], well[0]) and bool(out[1].isnan().all())
