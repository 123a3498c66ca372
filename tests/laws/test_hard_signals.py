"""Hard cases 31 to 40: signals on a grid, r = K Δt/h². The methods that a scene may choose; beside
them what Crank–Nicolson does.

Sums are taken in float64 of what was computed in either precision.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchfilm.signals.boundary_conditions import BoundaryConditions, Dirichlet, Periodic
from torchfilm.signals.exchange import pool_volume, read, stencil, write
from torchfilm.signals.grid import Grid
from torchfilm.signals.transport import METHODS, prepare
from torchfilm.signals.transport_rates import build_operator

CHOSEN = pytest.mark.parametrize("method", ["exponential", "series", "implicit"])


def cube(n: int, r: float, dtype, device, **options):
    """n³ voxels of 1 µm, and K so that a step of 1 h has the r given."""
    return build_operator(
        (n, n, n), (1.0, 1.0, 1.0), diffusion=r, dtype=dtype, device=device, **options
    )


def delta(n: int, dtype, device) -> torch.Tensor:
    u = torch.zeros(1, n, n, n, dtype=dtype, device=device)
    u[0, n // 2, n // 2, n // 2] = 1.0
    return u


def mass(u: torch.Tensor) -> float:
    return float(u.double().sum())


@CHOSEN
def test_case_31_delta_and_a_long_step(device, dtype, measured, method):
    """Delta, r = 1e3, 32³: u ≥ −1e-9, mass to 1e-6. Here u ≥ 0 exactly; in each of ten steps, as
    the field flattens."""
    stepper, u = prepare(cube(32, 1e3, dtype, device), 1.0, method), delta(32, dtype, device)
    for _ in range(10):
        before, u = mass(u), stepper.step(u)
        assert measured("lowest concentration", float(u.min()), "≥ −1e-9") >= 0.0
        assert mass(u) == pytest.approx(before, abs=1e-6)
        measured("change of mass", abs(mass(u) - before), "≤ 1e-6")


def test_case_31_crank_nicolson_rings(device, dtype):
    """The guide's prototype: minimum −0.999, and still 0.99 at the peak after 10 steps. To the
    digits given."""
    stepper, u = (
        prepare(cube(32, 1e3, dtype, device), 1.0, "crank_nicolson"),
        delta(32, dtype, device),
    )
    u = stepper.step(u)
    assert float(u.min()) == pytest.approx(-0.999, abs=1e-3)
    for _ in range(9):
        u = stepper.step(u)
    assert float(u.abs().max()) == pytest.approx(0.99, abs=0.01)


@CHOSEN
def test_case_32_delta_and_a_short_step(device, dtype, measured, method):
    """Delta, r = 0.5: u ≥ −1e-7. Here u ≥ 0 exactly."""
    u = prepare(cube(32, 0.5, dtype, device), 1.0, method).step(delta(32, dtype, device))
    assert measured("lowest concentration", float(u.min()), "≥ −1e-7") >= 0.0 and mass(
        u
    ) == pytest.approx(1.0, abs=1e-6)


def test_case_32_crank_nicolson_goes_below_zero(device, dtype):
    """−0.14 by the guide's prototype, to the digits given."""
    u = prepare(cube(32, 0.5, dtype, device), 1.0, "crank_nicolson").step(delta(32, dtype, device))
    assert float(u.min()) == pytest.approx(-0.14, abs=0.005)


@CHOSEN
@pytest.mark.parametrize(
    "faces",
    [BoundaryConditions(), BoundaryConditions(Periodic(), Periodic(), Periodic())],
    ids=["closed", "periodic"],
)
def test_case_33_strong_flow(device, dtype, measured, method, faces):
    """Cell Péclet 100, Courant 10, 48³: u ≥ 0, mass to 1e-6; in each of five steps."""
    op = cube(48, 1.0, dtype, device, velocity=(100.0, 0.0, 0.0), boundary=faces)
    stepper, u = prepare(op, 0.1, method), delta(48, dtype, device)
    for _ in range(5):
        before, u = mass(u), stepper.step(u)
        assert measured("lowest concentration", float(u.min()), "≥ 0") >= 0.0
        assert mass(u) == pytest.approx(before, abs=1e-6)
        measured("change of mass", abs(mass(u) - before), "≤ 1e-6")


@CHOSEN
@pytest.mark.parametrize("r", [1e-3, 0.5, 10.0, 1e3, 1e6])
def test_case_35_step_wall(device, dtype, measured, method, r):
    """Step wall 1 | 0: 0 ≤ u ≤ 1 always. Above 1 only what rounding of a few hundred products can
    add (1e-5 in float32, 1e-13)."""
    most = 1.0 + (1e-5 if dtype == torch.float32 else 1e-13)
    wall = torch.zeros(1, 32, 16, 8, dtype=dtype, device=device)
    wall[:, :16] = 1.0
    for faces in (
        BoundaryConditions(),
        BoundaryConditions(x=(Dirichlet(1.0), Dirichlet(0.0))),
        BoundaryConditions(x=Periodic(), y=(Dirichlet(1.0), Dirichlet(0.0))),
    ):
        op = build_operator(
            (32, 16, 8), (1.0, 1.0, 1.0), diffusion=r, boundary=faces, dtype=dtype, device=device
        )
        stepper, u = prepare(op, 1.0, method), wall
        for _ in range(20):
            u = stepper.step(u)
            assert measured("lowest concentration", float(u.min()), "≥ 0") >= 0.0
            assert float(u.max()) <= most
            measured("highest less 1", float(u.max()) - 1, "≤ 0, but for rounding")


@CHOSEN
def test_case_36_spacing_of_its_own_along_each_axis(device, dtype, measured, method):
    """Spacing (1, 2, 5): variance grows 2 K t along each axis, 1e-3. Both kernels have that
    variance exactly; the box is 12 widths wide."""
    shape, spacing, k, t, steps = (65, 33, 15), (1.0, 2.0, 5.0), 1.0, 8.0, 8
    op = build_operator(shape, spacing, diffusion=k, dtype=dtype, device=device)
    u = torch.zeros(1, *shape, dtype=dtype, device=device)
    u[0, 32, 16, 7] = 1.0
    stepper = prepare(op, t / steps, method)
    for _ in range(steps):
        u = stepper.step(u)
    for axis in range(3):
        x = (
            torch.arange(shape[axis], dtype=torch.float64, device=device) - shape[axis] // 2
        ) * spacing[axis]
        along = u[0].double().sum(tuple(a for a in range(3) if a != axis))
        variance = float((along * x**2).sum())
        assert variance == pytest.approx(2 * k * t, rel=1e-3)
        measured("variance over 2 K t, less 1", abs(variance / (2 * k * t) - 1), "≤ 1e-3")


def cells_on_nodes(grid: Grid):
    """Cells exactly on centres, on faces and edges between voxels, and on the faces, edges and
    corners of the box."""
    # half voxels: corners of voxels, and centres
    ticks = [np.arange(2 * n + 1) / 2 for n in grid.shapes[0]]
    places = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, 3)
    position = grid.origin[0] + torch.as_tensor(places, device=grid.origin.device) * grid.step
    return position, torch.zeros(len(places), dtype=torch.int64, device=grid.origin.device)


@pytest.mark.parametrize("shape", [(6, 5, 4), (6, 5, 1)], ids=["3-D", "2-D"])
@pytest.mark.parametrize("periodic", [False, True])
def test_case_37_cells_on_nodes_faces_and_corners(device, dtype, measured, shape, periodic):
    """Amount deposited to 1e-6; a constant field is sampled exactly. No cell on a face counts as
    outside."""
    grid = Grid(
        torch.tensor([[0.1, -7.3, 2.9]], dtype=torch.float64, device=device),
        torch.tensor([shape], device=device),
        (1.1, 0.7, 0.3),
    )
    position, colony = cells_on_nodes(grid)
    found = stencil(grid, position, colony, periodic=(periodic,) * 3, dtype=dtype)
    assert not bool(found.outside.any())
    constant = torch.full((grid.nodes,), 0.7, dtype=dtype, device=device)
    assert bool((read(constant, found) == constant[0]).all())
    measured("error of a constant field", (read(constant, found) - constant[0]).abs().max(), "= 0")
    amount = torch.linspace(0.1, 1.0, len(position), dtype=dtype, device=device)
    after = write(torch.zeros_like(constant), amount, found)
    assert mass(after) * grid.voxel_volume == pytest.approx(mass(amount), rel=1e-6)
    measured(
        "amount lost, relative", abs(mass(after) * grid.voxel_volume / mass(amount) - 1), "≤ 1e-6"
    )
    assert float(after.min()) >= 0.0


@pytest.mark.parametrize("by", [1e-3, 10.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_case_38_a_cell_outside_the_grid(device, dtype, measured, by, axis, side):
    """Outside by 1e-3 h and by 10 h: the report names the cell, and nothing is lost: it writes to
    and reads from the nearest voxels.

    A periodic axis has no outside.
    """
    grid = Grid(
        torch.tensor([[0.1, -7.3, 2.9]], dtype=torch.float64, device=device),
        torch.tensor([[6, 5, 4]], device=device),
        (1.1, 0.7, 0.3),
    )
    middle = 0.5 * (grid.origin + grid.high)
    position = middle.repeat(3, 1)
    edge = (grid.high if side > 0 else grid.origin)[0, axis]
    position[1, axis] = edge + side * by * grid.spacing[axis]
    position[2, axis] = edge
    colony = torch.zeros(3, dtype=torch.int64, device=device)
    found = stencil(grid, position, colony, dtype=dtype)
    assert found.outside.tolist() == [False, True, False]
    values = torch.rand(grid.nodes, dtype=dtype, device=device)
    seen = read(values, found)
    assert seen[1] == seen[2]
    after = write(values, torch.ones(3, dtype=dtype, device=device), found)
    assert (mass(after) - mass(values)) * grid.voxel_volume == pytest.approx(3.0, rel=2e-6)
    measured(
        "amount lost, relative",
        abs((mass(after) - mass(values)) * grid.voxel_volume / 3 - 1),
        "≤ 2e-6",
    )
    wrapped = stencil(
        grid, position, colony, periodic=(axis == 0, axis == 1, axis == 2), dtype=dtype
    )
    assert not bool(wrapped.outside.any())


def test_case_38_a_place_that_is_no_number(device, dtype):
    """Not a number, or infinite: outside, and no index out of range."""
    grid = Grid(
        torch.zeros(1, 3, dtype=torch.float64, device=device),
        torch.tensor([[4, 4, 4]], device=device),
        (1.0, 1.0, 1.0),
    )
    position = torch.tensor(
        [[2.0, math.nan, 2.0], [math.inf, 2.0, 2.0], [2.0, 2.0, -math.inf], [2.0, 2.0, 2.0]],
        dtype=torch.float64,
        device=device,
    )
    for periodic in (False, True):
        found = stencil(
            grid,
            position,
            torch.zeros(4, dtype=torch.int64, device=device),
            periodic=(periodic,) * 3,
            dtype=dtype,
        )
        assert found.outside.tolist() == [True, True, True, False]
        assert bool(torch.isfinite(found.weight).all())


@pytest.mark.parametrize("cells", [1, 40, 2000])
def test_case_39_taking_up_everything(device, dtype, measured, cells):
    """Uptake k·Δt = 1e3, so that each cell takes all it may: u ≥ 0, what cells gain is what the
    grid loses, 1e-6. Ten times over, from a field with holes."""
    grid = Grid(
        torch.zeros(1, 3, dtype=torch.float64, device=device),
        torch.tensor([[5, 4, 3]], device=device),
        (1.0, 1.0, 1.0),
    )
    rng = np.random.default_rng(39)
    position = torch.as_tensor(rng.uniform(0, 1, (cells, 3)), device=device) * grid.high
    position[0] = grid.centres()[30]
    found = stencil(
        grid, position, torch.zeros(cells, dtype=torch.int64, device=device), dtype=dtype
    )
    values = torch.as_tensor(
        rng.uniform(size=grid.nodes) * (rng.uniform(size=grid.nodes) < 0.7),
        dtype=dtype,
        device=device,
    )
    start, gained = mass(values), 0.0
    for _ in range(10):
        part = -math.expm1(-1e3)
        uptake = part * read(values, found) * pool_volume(found)
        values = write(values, -uptake, found)
        gained += mass(uptake)
        assert measured("lowest concentration", float(values.min()), "≥ 0") >= 0.0
    assert gained == pytest.approx(start - mass(values), abs=1e-6 * start)
    measured("gain less loss, relative", abs(gained - start + mass(values)) / start, "≤ 1e-6")
    assert gained > 0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", [(64, 1, 1), (64, 64, 1), (1, 64, 1), (1, 1, 64)], ids=str)
def test_case_40_flat_grids(device, dtype, measured, method, shape):
    """64×1×1 and 64×64×1: a cosine along the long axis decays as on a long axis alone; an all-zero
    field stays zero."""
    op = build_operator(
        shape, (1.0, 1.0, 0.5), diffusion=2.0, velocity=(0.0, 0.0, 0.0), dtype=dtype, device=device
    )
    axis = shape.index(64)
    h = (1.0, 1.0, 0.5)[axis]
    stepper = prepare(op, 1.0, method)
    zero = torch.zeros(1, *shape, dtype=dtype, device=device)
    assert torch.equal(stepper.step(zero), zero)
    measured("largest value of an all-zero field", stepper.step(zero).abs().max(), "= 0")
    wave = torch.cos(
        math.pi * 3 * (torch.arange(64, dtype=torch.float64, device=device) + 0.5) / 64
    )
    line = [1, 1, 1, 1]
    line[axis + 1] = 64
    u = (1 + wave).reshape(line).expand(1, *shape).to(dtype)
    # the lattice's own rate for this wave, 4K/h² sin²(3π/128), and what each method makes of it
    x = -8.0 / h**2 * math.sin(3 * math.pi / 128) ** 2
    steps = int(stepper.substeps) if method == "euler" else 1
    left = {
        "exponential": math.exp(x),
        "series": math.exp(x),
        "implicit": 1 / (1 - x),
        "crank_nicolson": (1 + x / 2) / (1 - x / 2),
        "euler": (1 + x / steps) ** steps,
    }[method]
    expected = (1 + left * wave).reshape(line)
    error = float((stepper.step(u).double() - expected).abs().max())
    assert measured("error of a wave", error, "≤ 2e-6 (float64: 1e-9)") <= (
        1e-9 if dtype == torch.float64 else 2e-6
    )
