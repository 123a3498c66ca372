"""The parts of the compiled kernels, each against the same in numpy or torch."""

from __future__ import annotations

import ast
import importlib
import itertools
from itertools import pairwise
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.kernels import (
    colonies,
    contacts,
    found,
    functions,
    lanes,
    moves,
    neighbours,
    wall_moves,
)
from torchfilm.kernels.compiling import for_python
from torchfilm.kernels.memory import no_memory
from torchfilm.physics import substeps
from torchfilm.physics.problem import BAD_DRAG, BAD_LENGTH, CONVERGED, NOT_FINITE, TOO_FAST
from torchfilm.tools.ragged import Groups

KERNELS = "torchfilm.kernels."
DOF = {2: (0,) * 4, 3: (0,) * 8}
NONE = np.zeros(3)  # no axis is periodic


def crowd(rng: np.random.Generator, count: int, dim: int, apart: float = 1.5):
    """Places, axes, half lengths and radii of cells of very different size."""
    size = apart * count ** (1 / dim)
    axis = rng.normal(size=(count, dim))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return (
        rng.random((count, dim)) * size,
        axis,
        rng.gamma(1.0, 1.0, count),
        rng.random(count) + 0.1,
    )


@numba.njit
def dots(a, b, dof):
    return np.array([lanes.dot(a, i, b, a.shape[0] - 1 - i, dof) for i in range(a.shape[0])])


@numba.njit
def sums(a, t, b, dof):
    for i in range(a.shape[0]):
        lanes.add_scaled(a, i, t[i], b, a.shape[0] - 1 - i, dof)


@numba.njit
def products(z, blocks, g, dof):
    for i in range(z.shape[0]):
        lanes.put_product(z, i, blocks, g, dof)


@numba.njit
def of_rows(H, p, one, two, dof):
    rows = range(H.shape[0] // 2)
    return np.array([lanes.dot_row(H, r, p, one[r], two[r], dof) for r in rows])


@numba.njit
def inverse_of_squares(H, halves, first, act, alpha, floor, held, dof):
    blocks = np.ones((2, len(dof), len(dof)), H.dtype)
    last = halves.shape[0]
    own = lanes.put_inverse(blocks, 1, H, halves, act, first, last, alpha, floor, held, dof)
    return own, blocks


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("kind", (np.float32, np.float64))
def test_whole_rows_as_vectors(dim, kind):
    """Sums of 4 or 8 terms, to a few units in the last place; padding stays 0."""
    rng, dof, near = np.random.default_rng(0), DOF[dim], 20 * np.finfo(kind).eps
    width, degrees = len(dof), 4 if dim == 2 else 7
    draw = lambda *shape: (rng.normal(size=shape) * (np.arange(width) < degrees)).astype(kind)
    a, b, t = draw(9, width), draw(9, width), rng.normal(size=9)
    np.testing.assert_allclose(dots(a, b, dof), (a * b[::-1]).sum(1), rtol=near, atol=near)
    wanted = a + t.astype(kind)[:, None] * b[::-1]
    sums(a, t, b, dof)
    np.testing.assert_allclose(a, wanted, rtol=near, atol=near)
    blocks = draw(9, width, width)
    blocks = blocks * blocks.swapaxes(1, 2)  # symmetric
    z = np.ones_like(b)
    products(z, blocks, b, dof)
    np.testing.assert_allclose(z, np.einsum("nij,nj->ni", blocks, b), rtol=near, atol=10 * near)
    assert not a[:, degrees:].any() and not z[:, degrees:].any()
    H = draw(40, width)
    one, two = rng.integers(0, 9, (2, 20))
    np.testing.assert_allclose(
        of_rows(H, b, one, two, dof), (H[::2] * b[one] + H[1::2] * b[two]).sum(1), rtol=near,
        atol=near,
    )  # fmt: skip
    halves, act = rng.permutation(40).astype(np.int32), (rng.random(20) < 0.7).astype(np.uint8)
    wide = H[halves[3:]][act[halves[3:] // 2] == 1].astype(float)
    square = (wide.T @ wide)[:degrees, :degrees]
    square += np.diag(0.01 * square.diagonal() + 0.1)
    for held in (False, True):
        own, (other, inverse) = inverse_of_squares(H, halves, 3, act, 0.1, 0.01, held, dof)
        np.testing.assert_allclose(own, square[-1, -1], rtol=1e-12)
        free = degrees - held
        wanted = np.zeros((width, width))
        wanted[:free, :free] = np.linalg.inv(square[:free, :free])
        np.testing.assert_allclose(inverse, wanted, rtol=near, atol=near * abs(wanted).max())
        assert (other == 1).all()


def test_rows_of_two_types_are_refused():
    a, b = np.zeros((2, 4)), np.zeros((2, 4), np.float32)
    with pytest.raises(TypeError, match="not of one type"):
        dots(a, b, DOF[2])
    with pytest.raises(TypeError, match="not contiguous"):
        dots(np.zeros((4, 2)).T, np.zeros((4, 2)).T, DOF[2])


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("count", (1, 2, 40, 300))
@pytest.mark.parametrize("apart", (0.0, 1e4, 1e6))
def test_near_pairs_are_those_whose_boxes_meet(dim, count, apart):
    """Against all pairs; lengths differ a hundredfold, and half of the cells are `apart` µm away.
    None is missed or found twice; others nearly meet, to the share of the colony's size by which
    boxes are enlarged."""
    rng = np.random.default_rng(count)
    x, axis, half, radius = crowd(rng, count, dim)
    x[::2] += apart
    first, second = for_python(neighbours.near_pairs)(
        no_memory(), x, axis, half, radius, NONE, 0.3, DOF[dim]
    )
    side = np.abs(axis) * half[:, None] + radius[:, None] + 0.15
    away = (np.abs(x[:, None] - x[None]) - side[:, None] - side[None]).max(2)
    found = set(zip(first.tolist(), second.tolist(), strict=True))
    assert (np.diff(first) >= 0).all() and (first < second).all() and len(found) == len(first)
    assert found >= set(map(tuple, np.argwhere(np.triu(away <= 0, 1)).tolist()))
    extent = np.ptp(x, axis=0).max() + 2 * side.max()
    # each of the two ends that are compared is moved by this share, and rounded by less
    assert away[first, second].max(initial=0.0) <= 3 * neighbours.ROUNDED * extent


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("count", (40, 300))
@pytest.mark.parametrize("share", (0.0, 0.02, 0.5, 1.0))
def test_near_pairs_of_some_cells_are_those_of_all_that_have_one(dim, count, share):
    rng = np.random.default_rng(count)
    cells = crowd(rng, count, dim)
    some = (rng.random(count) < share).astype(np.uint8)
    every = np.stack(for_python(neighbours.near_pairs)(no_memory(), *cells, NONE, 0.3, DOF[dim]), 1)
    found = np.stack(
        for_python(neighbours.near_pairs_of)(no_memory(), *cells, NONE, 0.3, some, DOF[dim]), 1
    )
    wanted = every[(some[every] > 0).any(1)]
    assert set(map(tuple, found.tolist())) == set(map(tuple, wanted.tolist()))
    assert len(found) == len(wanted) and (np.diff(found[:, 0]) >= 0).all()


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("spread", (0.0, 0.02))
@pytest.mark.parametrize("own", (0.0, 0.1, 0.4))
def test_no_cells_come_nearer_than_told(dim, spread, own):
    """Colonies that expand, while each cell moves, turns and changes its length: no gap that may
    matter shrinks by more than `approach`, and where all is still by nearly as much."""
    rng, dof = np.random.default_rng(1), DOF[dim]
    x, axis, half, radius = crowd(rng, 60, dim)
    y = np.zeros((60, len(dof)))
    turns = slice(dim, 3 if dim == 2 else 6)
    y[:, :dim] = spread * (x - x.mean(0)) * 3 + own * rng.uniform(-1, 1, (60, dim))
    y[:, turns] = 0.3 * own * rng.normal(size=y[:, turns].shape)
    y[:, turns.stop] = 0.1 * own * rng.uniform(-1, 1, 60)
    margin, every = 100.0, np.array(list(itertools.combinations(range(60), 2)), np.int32)
    first, second = every.T.copy()
    near_contacts = for_python(contacts.near_contacts)
    gaps = lambda: near_contacts(
        no_memory(), x, axis, half, radius, NONE, first, second, margin, dof
    )[2]
    before, length = gaps(), 2 * half
    scale, least = np.ones_like(y), np.zeros(60)
    about, none = np.zeros_like(y), np.zeros((0, 3))
    no_walls = none[:, 0], none, none[:, 0], none[:, 0] > 0, none
    for_python(wall_moves.move_cells)(
        x, axis, length, radius, y, scale, about, 1e9, least, no_walls, np.zeros((3, len(dof))), dof
    )
    half = 0.5 * length
    (all_, each), after = (
        for_python(moves.approach)(no_memory(), x, length, radius, NONE, y, dof),
        gaps(),
    )
    told = all_ + each[first] + each[second]
    near = before - all_ - 2 * each.max() < 0.3
    assert near.sum() > 50
    assert ((before - after)[near] <= told[near] + 1e-9).all()
    if spread == own == 0.0:
        assert (told == 0.0).all()


def test_substeps_by_kernels_and_by_torch():
    """Colonies that grow slowly, fast and too fast, with no number, without drag, of a length below
    0, and no cells."""
    counts = [3, 4, 2, 3, 3, 0, 3, 2, 3]
    owner = torch.repeat_interleave(torch.arange(9), torch.tensor(counts))
    count, generator = owner.numel(), torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.rand(*shape, generator=generator) + 0.5
    position, axis, move = draw(count, 2).double(), draw(count, 2), draw(count, 4)
    length, elongation, viscosity = draw(count), 0.1 * draw(count), draw(count)
    length_drag = torch.tensor(10.0).expand(count)
    at = lambda colony: counts[:colony] and sum(counts[:colony])
    elongation[at(1)], elongation[at(2)] = 2.0, 1e6
    position[at(3), 1], move[at(4), 3] = torch.nan, torch.inf
    viscosity[at(6)], length[at(7)], length[at(8) + 1] = 0.0, -torch.inf, -0.1
    viscosity[at(8) + 2] = 0.0
    given = (position, axis, move, length, elongation, viscosity, length_drag)
    found = substeps.substeps(Groups(owner, 9, ordered=True), *given, longest=0.5)
    arrays = [x.numpy() for x in (position, axis, length, elongation, length, move)]
    drags = viscosity.numpy(), np.array([10.0], np.float32), np.empty(0, np.float32)
    begin = np.cumsum([0, *counts])
    by_kernels = [
        for_python(colonies.substeps)(
            first, end, 0.5, (*arrays, owner.numpy(), length.numpy(), length.numpy()), drags
        )
        for first, end in pairwise(begin)
    ]
    assert list(zip(*(x.tolist() for x in found), strict=True)) == by_kernels
    assert found[0].tolist() == [1, 4, 1, 1, 1, 1, 1, 1, 1]
    wanted = [CONVERGED] * 2 + [TOO_FAST] + [NOT_FINITE] * 2 + [CONVERGED, BAD_DRAG, NOT_FINITE]
    assert found[1].tolist() == [*wanted, BAD_LENGTH]


def test_python_calls_only_kernels_that_have_a_form_for_it():
    """A call of any other is an error."""
    with pytest.raises(TypeError, match="natural_log has no form for Python: call for_python"):
        functions.natural_log(1.0)
    package, seen = Path(tf.__file__).parent, set()
    for file in sorted(package.rglob("*.py")):
        if file.parent.name == "kernels":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith(KERNELS):
                home = importlib.import_module(str(node.module))
                found = [getattr(home, alias.name, None) for alias in node.names]
                seen.update(x for x in found if hasattr(x, "py_func"))
    inner = [x.py_func.__name__ for x in seen if x.targetoptions["no_cpython_wrapper"]]
    assert not inner and len(seen) > 10


def test_sums_in_any_order_write_to_no_array():
    """Where one did, the order of its sum hung on how near its arrays lay to each other in memory:
    found as an error of a solve that differed in its last bit, once in thousands of steps."""
    found = []
    for file in sorted(Path(lanes.__file__).parent.glob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if not isinstance(node, ast.FunctionDef):
                continue
            if any("any_order=True" in ast.unparse(d) for d in node.decorator_list):
                found.append(node.name)
                stored = [
                    ast.unparse(x)
                    for x in ast.walk(node)
                    if isinstance(x, ast.Subscript) and isinstance(x.ctx, ast.Store)
                ]
                assert stored == [], node.name
    assert len(found) >= 2


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("turns", (True, False))
def test_a_move_through_a_wall_is_cut_whether_it_turns_or_not(dim, turns):
    """A rod of 6 µm just above a floor turns by 0.49 rad about its centre, or sinks by 1.4 µm: in
    both cases a point of it comes more than a radius, 0.5 µm, behind the floor. The share that is
    left is interpolated: that of a turn to the difference of an angle and its sine, 4 %."""
    x, axis = np.zeros((1, dim)), np.zeros((1, dim))
    x[0, 1], axis[0, 0] = 0.55, 1.0
    dof, radius, least = DOF[dim], np.full(1, 0.5), np.zeros(1)
    length, y = np.full(1, 6.0), np.zeros((1, len(dof)))
    y[0, 2 if dim == 2 else 5], y[0, 1] = (0.49, 0.0) if turns else (0.0, -1.4)
    none = np.zeros(1, bool)
    floor = np.zeros(1, np.int64), np.array([[0.0, 1.0, 0.0]]), np.zeros(1), none, np.ones((1, 1))
    given = np.ones_like(y), np.zeros_like(y), 1e9, least, floor, np.zeros((3, len(dof))), dof
    assert for_python(wall_moves.move_cells)(x, axis, length, radius, y, *given) == 1
    lowest = x[0, 1] - 3.0 * abs(axis[0, 1])
    assert -0.05 < lowest < 1e-12


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("count", (40, 300))
@pytest.mark.parametrize("both", (True, False))
def test_cells_that_a_move_brings_into_each_other_are_found(dim, count, both):
    """Balls 9 µm apart on a line, and two farther from each other than the margin, which was no
    contact: then one comes 0.55 µm nearer, or both half of that, and they lie 0.15 µm deep."""
    dof, margin, deep, board = DOF[dim], 0.3, 0.1, np.zeros(0, np.int64)
    x, axis = np.zeros((count, dim)), np.zeros((count, dim))
    x[:, 0], axis[:, 1] = 9.0 * np.arange(count), 1.0
    x[1, 0] = x[0, 0] + 1.4
    radius, length, y = np.full(count, 0.5), np.zeros(count), np.zeros((count, len(dof)))
    half, cells = 0.5 * length, (x, axis, 0.5 * length, radius, NONE)
    before = for_python(found.found_contacts)(no_memory(), board, *cells, margin, dof)
    assert before[2].size == 0
    y[:2, 0] = (0.275, -0.275) if both else (0.0, -0.55)
    x += y[:, :dim]
    arrays = length, length, half, length, length, length, y, y, y
    after, deeply = for_python(found.found_after)(
        no_memory(), board, x, axis, radius, NONE, margin, deep, before, arrays, dof
    )
    assert deeply and after[2].size == 1 and after[4][0] == pytest.approx(-0.15)
    assert (after[0][after[2][0]], after[1][after[2][0]]) == (0, 1)
