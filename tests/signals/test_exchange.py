"""Reading and writing: interpolation, its adjoint, limits of uptake, and conservation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mock_cuda import pretended_cuda  # noqa: F401
from torch.autograd import forward_ad

import torchfilm as tf
from torchfilm.signals import compiled, exchange
from torchfilm.signals.exchange import Stencil, pool_volume, read, stencil, write
from torchfilm.signals.grid import Grid
from torchfilm.tools.checks import InputError
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import forward_mode, tangent
from torchfilm.tools.threads import Shared

SPACING = (2.0, 1.0, 0.5)
SHAPES = {"3-D": (5, 4, 6), "2-D": (5, 4, 1), "1-D": (7, 1, 1), "0-D": (1, 1, 1)}
ALL = pytest.mark.parametrize("shape", list(SHAPES.values()), ids=list(SHAPES))


def grid(shapes, device="cpu") -> Grid:
    origin = torch.tensor([[-1.0, 2.0, 0.5]], dtype=torch.float64, device=device)
    return Grid(origin.repeat(len(shapes), 1), torch.tensor(shapes, device=device), SPACING)


def scattered(g: Grid, each: int, seed: int = 0, beyond: float = 0.0):
    """`each` cells per colony at random positions in its box, or `beyond` it by that part of its
    size.

    The positions have no order.
    """
    rng = np.random.default_rng(seed)
    colony = torch.arange(g.colonies, device=g.origin.device).repeat_interleave(each)
    part = torch.as_tensor(
        rng.uniform(-beyond, 1 + beyond, (len(colony), 3)), device=g.origin.device
    )
    return g.origin[colony] + part * (g.high - g.origin)[colony], colony


def random_values(g: Grid, dtype, seed: int = 1):
    return torch.as_tensor(
        np.random.default_rng(seed).uniform(0, 2, g.nodes), dtype=dtype, device=g.origin.device
    )


def interpolated(
    g: Grid, values: np.ndarray, position: np.ndarray, periodic=(False,) * 3
) -> np.ndarray:
    """Trilinear interpolation of one colony's values, cell by cell and corner by corner."""
    n, out = np.array(g.shapes[0]), []
    values = values.reshape(n)
    for p in position:
        at = (p - g.origin[0].cpu().numpy()) / np.array(SPACING) - 0.5
        total = 0.0
        for corner in np.ndindex(2, 2, 2):
            weight, place = 1.0, []
            for k in range(3):
                a = at[k] if periodic[k] else min(max(at[k], 0.0), n[k] - 1.0)
                base = int(np.floor(a))
                weight *= (a - base) if corner[k] else 1 - (a - base)
                place.append(
                    (base + corner[k]) % n[k] if periodic[k] else min(base + corner[k], n[k] - 1)
                )
            total += weight * values[tuple(place)]
        out.append(total)
    return np.array(out)


@ALL
@pytest.mark.parametrize("periodic", [(False,) * 3, (True,) * 3])
def test_reading_is_trilinear_interpolation(device, dtype, shape, periodic):
    g = grid([shape], device)
    position, colony = scattered(g, 200, beyond=0.6)
    values = random_values(g, dtype)
    found = stencil(g, position, colony, periodic=periodic, dtype=dtype)
    assert found.node.shape == (200, 2 ** sum(n > 1 for n in shape))
    expected = interpolated(g, values.cpu().double().numpy(), position.cpu().numpy(), periodic)
    # values up to 2, eight weights: a dozen roundings
    assert (
        np.abs(read(values, found).cpu().double().numpy() - expected).max()
        <= 24 * torch.finfo(dtype).eps
    )


@ALL
def test_weights_add_up_to_one(device, dtype, shape):
    g = grid([shape], device)
    found = stencil(g, *scattered(g, 500), dtype=dtype)
    assert bool((found.weight >= 0).all())
    # the greatest weight is 1 minus the others: one rounding
    assert float((found.weight.double().sum(1) - 1).abs().max()) <= torch.finfo(dtype).eps
    assert bool((found.weight[:, 0] >= 1 / found.weight.shape[1] - 1e-6).all())


@ALL
def test_writing_is_the_adjoint_of_reading(device, shape):
    """⟨write(a), v⟩ · voxel volume = ⟨a, read(v)⟩ for secretion; float64."""
    g = grid([shape, shape], device)
    found = stencil(g, *scattered(g, 100))
    values, amount = (
        random_values(g, torch.float64),
        torch.rand(200, dtype=torch.float64, device=device),
    )
    zero = torch.zeros_like(values)
    left = (write(zero, amount, found) * values).sum() * g.voxel_volume
    right = (amount * read(values, found)).sum()
    # a sum of 200 terms of order 1
    assert float(left - right) == pytest.approx(0.0, abs=1e-12 * float(right))
    # and in a uniform field for uptake too
    flat = torch.full_like(values, 3.0)
    small = -1e-3 * amount
    assert torch.allclose(
        write(flat, small, found) - flat, write(zero, -small, found).neg(), rtol=1e-9, atol=1e-14
    )


def test_a_cell_alone_may_empty_its_voxel_and_a_crowd_shares(device, dtype):
    """W cells at one centre each get 1/W of the voxel; a single cell gets all of its voxel.

    Between centres a cell reads and shares more than one voxel, and may take what the nearest voxel
    has.
    """
    g = grid([(5, 4, 6)], device)
    centre = g.centres()[37].expand(7, 3)
    found = stencil(g, centre, torch.zeros(7, dtype=torch.int64, device=device), dtype=dtype)
    assert torch.allclose(
        pool_volume(found),
        torch.full((7,), g.voxel_volume / 7, dtype=dtype, device=device),
        rtol=1e-6,
    )
    alone = stencil(
        g, centre[:1] + 0.1, torch.zeros(1, dtype=torch.int64, device=device), dtype=dtype
    )
    assert float(pool_volume(alone)) == pytest.approx(
        g.voxel_volume / float(alone.weight.max()), rel=1e-6
    )
    emptied = write(torch.ones(g.nodes, dtype=dtype, device=device), -pool_volume(alone), alone)
    assert float(emptied.min()) == pytest.approx(0.0, abs=1e-6) and float(emptied.min()) >= 0.0


@pytest.mark.parametrize("by_torch", [False, True])
def test_a_crowd_beside_it_does_not_share_with_a_cell_at_a_face(by_torch, monkeypatch):
    """Within half a voxel of the faces the outermost voxel alone counts, though the stencil has the
    next ones, too, with weights of 0."""
    if by_torch:
        monkeypatch.setattr(compiled, "may_run", lambda *_: False)
    g = grid([(5, 4, 6)])
    place = torch.cat([g.centres()[:1] - 0.1, g.centres()[24:25].expand(9, 3)])  # next along x
    pool = pool_volume(stencil(g, place, torch.zeros(10, dtype=torch.int64)))
    assert pool.tolist() == pytest.approx([g.voxel_volume] + [g.voxel_volume / 9] * 9)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    cells=st.integers(1, 60),
    shape=st.sampled_from(list(SHAPES.values())),
    single=st.booleans(),
    spots=st.integers(1, 5),
)
def test_however_crowded_nothing_goes_below_zero_and_nothing_is_lost(
    seed, cells, shape, single, spots
):
    """Every cell takes up as much as it may, or secretes: values are ≥ 0 exactly.

    The gain of the grid equals the amounts of the cells. Tolerance: each of at most cells × 8
    entries is rounded a few times, relative to all that is moved or present.
    """
    dtype = torch.float32 if single else torch.float64
    rng, g = np.random.default_rng(seed), grid([shape])
    places, _ = scattered(g, spots, seed)
    position = places[torch.as_tensor(rng.integers(0, spots, cells))]
    values = random_values(g, dtype, seed) * torch.as_tensor(
        rng.uniform(size=g.nodes) < 0.6, dtype=dtype
    )
    found = stencil(g, position, torch.zeros(cells, dtype=torch.int64), dtype=dtype)
    most = read(values, found) * pool_volume(found)
    amount = torch.where(
        torch.as_tensor(rng.uniform(size=cells) < 0.8),
        -most,
        torch.as_tensor(rng.uniform(size=cells), dtype=dtype),
    )
    after = write(values, amount, found)
    assert bool((after >= 0).all())
    moved = float(amount.abs().double().sum() + values.double().sum() * g.voxel_volume)
    gained = float((after.double() - values.double()).sum() * g.voxel_volume)
    assert gained == pytest.approx(
        float(amount.double().sum()), abs=16 * torch.finfo(dtype).eps * moved
    )


@pytest.mark.parametrize("by_torch", [False, True])
def test_taking_more_than_is_there_shows(by_torch, device, dtype, monkeypatch):
    """Too large an uptake is not silent: a value below zero, or NaN where there was nothing."""
    if by_torch:
        monkeypatch.setattr(compiled, "may_run", lambda *_: False)
    g = grid([(3, 3, 1)], device)
    found = stencil(
        g, g.centres()[4:5], torch.zeros(1, dtype=torch.int64, device=device), dtype=dtype
    )
    full = torch.ones(9, dtype=dtype, device=device)
    assert (
        write(
            full, torch.full((1,), -1.5 * g.voxel_volume, dtype=dtype, device=device), found
        ).min()
        < 0
    )
    assert write(0 * full, torch.full((1,), -1.0, dtype=dtype, device=device), found).isnan().any()
    assert torch.equal(write(0 * full, torch.zeros(1, dtype=dtype, device=device), found), 0 * full)


def test_obstacles_take_no_part(device, dtype):
    g = grid([(5, 4, 6)], device)
    rng = np.random.default_rng(5)
    mask = torch.as_tensor(rng.uniform(size=g.nodes) < 0.5, device=device)
    position, colony = scattered(g, 400)
    found = stencil(g, position, colony, mask=mask, dtype=dtype)
    inside = ~found.gather(mask.to(dtype)).bool()
    assert bool((found.weight[inside] == 0).all())
    total = found.weight.double().sum(1)
    assert bool((total[found.outside] == 0).all()) and 0 < int(found.outside.sum()) < 400
    assert float((total[~found.outside] - 1).abs().max()) <= torch.finfo(dtype).eps
    # wholly inside: all corners of the stencil without a mask are in obstacles
    plain = stencil(g, position, colony, dtype=dtype)
    free = (plain.gather(mask.to(dtype)) * plain.weight).sum(1) > 0
    assert torch.equal(found.outside, ~free)
    # a flat field is read as it is, an obstacle as nothing
    read_flat = read(torch.where(mask, 3.0, 99.0).to(dtype), found)
    assert torch.equal(read_flat, torch.where(found.outside, 0.0, 3.0).to(dtype))


def test_the_slope_of_a_reading(device):
    """d read / d position and d read / d values against central differences in float64.

    h = 1e-6 of values of order 1, so 1e-9.
    """
    g = grid([(5, 4, 6)], device)
    position, colony = scattered(g, 40, seed=3)
    position = position.requires_grad_()
    values = random_values(g, torch.float64).requires_grad_()
    weight = torch.linspace(0.5, 1.5, 40, dtype=torch.float64, device=device)
    of = lambda p, v: (read(v, stencil(g, p, colony)) * weight).sum()
    of(position, values).backward()
    h = 1e-6
    with torch.no_grad():
        for cell, axis in [(0, 0), (7, 1), (20, 2), (39, 0)]:
            up, down = position.clone(), position.clone()
            up[cell, axis] += h
            down[cell, axis] -= h
            assert float(position.grad[cell, axis]) == pytest.approx(
                float(of(up, values) - of(down, values)) / (2 * h), abs=1e-8
            )
        node = int(stencil(g, position, colony).node[0, 0])
        up = values.clone()
        up[node] += 1.0
        assert float(values.grad[node]) == pytest.approx(
            float(of(position, up) - of(position, values)), abs=1e-12
        )


def test_the_slope_of_writing():
    """Secretion and uptake together, by amount, values and position: gradcheck in float64 with
    differences of 1e-6.
    """
    g = grid([(3, 2, 2)])
    position, colony = scattered(g, 6, seed=4)
    values = (random_values(g, torch.float64) + 0.5).requires_grad_()
    amount = (
        0.05 * torch.tensor([1.0, -1.0, 2.0, -2.0, -1.0, 1.0], dtype=torch.float64)
    ).requires_grad_()
    position = position.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v, a, p: write(v, a, stencil(g, p, colony)),
        (values, amount, position),
        eps=1e-6,
        atol=1e-6,
    )


@pytest.mark.parametrize("masked", [False, True])
def test_a_colony_does_not_see_the_others(device, dtype, masked, deterministic):
    """The same bits alone and in a batch of grids of other shapes, including flat ones."""
    shapes = [(5, 4, 6), (7, 3, 1), (1, 1, 1), (4, 4, 4)]
    g = grid(shapes, device)
    position, colony = scattered(g, 40, seed=6)
    values = random_values(g, dtype)
    mask = (
        torch.as_tensor(np.random.default_rng(7).uniform(size=g.nodes) < 0.8, device=device)
        if masked
        else None
    )

    def run(grid, position, colony, values, mask):
        found = stencil(grid, position, colony, mask=mask, dtype=dtype)
        seen, pool = read(values, found), pool_volume(found)
        sign = torch.where(torch.arange(len(colony), device=device) % 2 == 0, -1.0, 0.1).to(dtype)
        return seen, pool, write(values, sign * seen * pool, found), found.outside

    together = run(g, position, colony, values, mask)
    for k in range(len(shapes)):
        own, here = slice(40 * k, 40 * k + 40), slice(int(g.offsets[k]), int(g.offsets[k + 1]))
        alone = run(
            Grid(g.origin[k : k + 1], g.shape[k : k + 1], SPACING),
            position[own],
            colony[own] - k,
            values[here],
            None if mask is None else mask[here],
        )
        for a, b, part in zip(alone, together, (own, own, here, own), strict=True):
            assert torch.equal(a, b[part])


def test_what_does_not_fit_is_refused():
    g = grid([(3, 3, 1)])
    colony = torch.zeros(2, dtype=torch.int64)
    with pytest.raises(InputError, match="position"):
        stencil(g, torch.zeros(2, 2, dtype=torch.float64), colony)
    with pytest.raises(InputError, match="mask"):
        stencil(
            g, torch.zeros(2, 3, dtype=torch.float64), colony, mask=torch.ones(4, dtype=torch.bool)
        )


def test_no_cells_at_all(device, dtype):
    g = grid([(3, 3, 1)], device)
    found = stencil(
        g,
        torch.zeros(0, 3, dtype=torch.float64, device=device),
        torch.zeros(0, dtype=torch.int64, device=device),
        dtype=dtype,
    )
    values = random_values(g, dtype)
    assert (
        isinstance(found, Stencil)
        and read(values, found).shape == (0,)
        and pool_volume(found).shape == (0,)
    )
    assert torch.equal(write(values, values[:0], found), values)


@pytest.mark.parametrize("periodic", [(False, False, False), (True, False, False)])
def test_kernels_see_the_cells_that_torch_sees(periodic, monkeypatch):
    """The corners that cells need, and those outside: cells at faces, a colony without cells, and
    coordinates that are no numbers."""
    generator = torch.Generator().manual_seed(4)
    position = torch.empty(60, 3, dtype=torch.float64).uniform_(-1, 9, generator=generator)
    position[3], position[20, 1], position[40, 2] = 0.0, torch.nan, torch.inf
    owner = torch.arange(6).repeat_interleave(10)
    owner[owner >= 2] += 1  # colony 2 has no cells
    grid = Grid(
        torch.zeros(7, 3, dtype=torch.float64), torch.full((7, 3), 4), spacing=(2.0, 2.0, 2.0)
    )
    groups = Groups(owner, 7, ordered=True)
    found = lambda: (*exchange.spans(position, groups), *exchange.beyond(
        grid, position, groups, periodic
    ))  # fmt: skip
    by_kernels = found()
    monkeypatch.setattr("torchfilm.signals.compiled.may_run", lambda *given: False)
    by_torch = found()
    assert 0 < int(by_torch[2].max()) < 10 and int(by_torch[3][2]) == 60
    assert bool(by_torch[0].isnan().any())
    for one, other in zip(by_torch, by_kernels, strict=True):
        assert torch.equal(one.nan_to_num(nan=-7.0), other.nan_to_num(nan=-7.0))


def eating(u, s, p, cell):
    eaten = 2.0 * s.food / (0.5 + s.food) * cell.area
    return {"a": eaten / cell.volume}, {"food": -eaten}


@pytest.mark.parametrize(
    "cells",
    [(tf.Monod("food", rate=2.0, half=0.5), tf.Growth()), (tf.Circuit(eating, species="a"),)],
)
def test_threads_take_whole_colonies_and_no_bit_changes(monkeypatch, cells):
    """Four colonies, one of them empty, crowded into few voxels: their parts share none."""
    box = {"box": ((-8.0, -8.0), (8.0, 8.0)), "spacing": 4.0}
    medium = tf.Medium(food=tf.Signal(diffusion=5.0, initial=1.0), **box)
    place = torch.rand(90, 2, generator=torch.Generator().manual_seed(1)) * 12 - 6
    founders = tf.Cells(place, [[1.0, 0.0]] * 90, length=1.0)
    model = tf.Scene(*cells, medium, founders=founders).bind(4, dtype=torch.float64)
    first = model.start()
    first = first.remove((first.colony == 2) | (first.uid > 20 * first.colony + 20), "removed")
    ranges, found = [], []
    share = Shared.__call__

    def spied(shared, count, work, ends=None):
        noted = lambda a, b: (ranges.append((a, b)) if ends is not None else None, work(a, b))
        share(shared, count, noted, ends)

    monkeypatch.setattr(Shared, "__call__", spied)
    for threads, worth in ((1, 1.0), (3, 0.0)):
        monkeypatch.setattr("torchfilm.tools.threads.WORTH_WAKING", worth)
        monkeypatch.setattr("torchfilm.tools.threads.available", lambda threads=threads: threads)
        ranges.clear()
        found.append(model.step(first, 0.05))
    ends = np.cumsum([0, *first.counts.tolist()])
    assert len(set(ranges)) > 1 and {a for pair in ranges for a in pair} <= set(ends.tolist())
    for name, value in found[0].fields.items():
        assert torch.equal(value, found[1].fields[name])


def steady_value(diffusion: float, decay: float, spacing: float, count: int) -> float:
    """The concentration in the middle of count × count voxels, of which the one there gets 1
    amount an hour and µm³: a dense solve."""
    line = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    line[0, 0] = line[-1, -1] = 1
    one = np.eye(count)
    loss = diffusion / spacing**2 * (np.kron(line, one) + np.kron(one, line))
    source = np.zeros(count * count)
    source[count * count // 2] = 1.0
    return np.linalg.solve(loss + decay * np.eye(count * count), source)[count * count // 2]


@pytest.mark.parametrize("splitting", ["strang", "lie"])
@pytest.mark.parametrize("diffusion", [40.0, 400.0, 4000.0])
def test_the_error_of_taking_turns_is_that_of_a_run(diffusion, splitting):
    """A cell in the middle that only gives, until its signal rests: the value at the end of a
    step."""
    count, spacing, decay, dt = 9, 4.0, 5.0, 0.05
    half = 0.5 * count * spacing
    scene = tf.Scene(
        tf.Circuit(lambda u, s, p, cell: ({"m": -u.m}, {"ahl": p.q}), species="m", q=spacing**3),
        tf.Medium(
            exchange="turns",
            ahl=tf.Signal(diffusion=diffusion, decay=decay), box=((-half, -half), (half, half)),
            spacing=spacing, splitting=splitting,
        ),
        founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]]), dt=dt,
    )  # fmt: skip
    *_, last = tf.simulate(scene, until=6.0, dtype=torch.float64)
    found = float(last.signals["ahl"][count * count // 2])
    error = exchange.turns_error(diffusion, decay, last.layout.grid, dt, splitting == "strang")
    true = steady_value(diffusion, decay, spacing, count)
    assert found / true - 1 == pytest.approx(error, rel=1e-6, abs=1e-9)
    assert error < -0.004


def test_without_diffusion_and_decay_nothing_takes_turns():
    assert exchange.turns_error(0.0, 0.0, grid([(5, 4, 1)]), 0.1) == 0.0


def test_sums_of_a_gpu_do_not_see_the_others(pretended_cuda, dtype):  # noqa: F811
    """They are trees: entries of weight 0, of grids of more axes, must not change their order."""
    for masked in (False, True):
        test_a_colony_does_not_see_the_others("cuda", dtype, masked, None)


@pytest.mark.parametrize("by_torch", [False, True])
def test_uptake_of_almost_nothing_leaves_nothing_negative(by_torch, device, dtype, monkeypatch):
    """Below the least normal number rounding is no part of the content."""
    if by_torch:
        monkeypatch.setattr(compiled, "may_run", lambda *_: False)
    g, kind = grid([(5, 4, 3)], device), torch.finfo(dtype)
    for steps in (16, 4000):
        position, colony = scattered(g, 2000, seed=3)
        found = stencil(g, position, colony, dtype=dtype)
        values = random_values(g, dtype) * (steps * kind.tiny * kind.eps)
        for _ in range(3):
            before = values
            values = write(values, -read(values, found) * pool_volume(found), found)
            assert float(values.min()) >= 0.0 and float(values.sum()) <= float(before.sum())


def test_tangents_where_a_voxel_is_emptied(dtype, monkeypatch):
    """By kernels as by torch: a share that only rounding makes more than 1 has no tangent."""
    g = grid([(3, 2, 2)])
    position, colony = scattered(g, 200, seed=5)
    found = stencil(g, position, colony, dtype=dtype)
    values = random_values(g, dtype)
    there, pool = read(values, found), pool_volume(found)
    pool = pool * (1 + 20 * torch.finfo(dtype).eps)
    share = found.sum(found.weight * (pool / found.voxel_volume).unsqueeze(1))
    assert bool((share > 1).any())

    def moved():
        with forward_mode():
            dual = forward_ad.make_dual(-there * pool, torch.ones_like(pool))
            return tangent(write(values, dual, found, there))

    by_kernels = moved()
    for name in ("may_run", "may_run_forward"):
        monkeypatch.setattr(compiled, name, lambda *_: False)
    assert torch.allclose(by_kernels, moved(), rtol=1e-4, atol=1e-5)
