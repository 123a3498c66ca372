"""Grids: the order of values, batches by shape, and growth with a colony."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfilm.signals.grid import Grid
from torchfilm.tools.checks import InputError

SPACING = (2.0, 1.0, 0.5)


def grid(shapes, device="cpu", spacing=SPACING) -> Grid:
    shape = torch.tensor(shapes, device=device)
    origin = (
        torch.arange(3.0 * len(shapes), dtype=torch.float64, device=device).reshape(-1, 3) - 4.0
    )
    return Grid(origin, shape, spacing)


def field(grid: Grid, dtype=torch.float64):
    """A value for each voxel that identifies its colony and its indices."""
    x, y, z = grid.centres().unbind(1)
    return (1000.0 * grid.owner + 7 * x + 3 * y + z).to(dtype)


def test_what_a_grid_says_of_itself(device):
    g = grid([(3, 2, 4), (1, 1, 1), (2, 5, 1)], device)
    assert (g.colonies, g.nodes, g.voxel_volume) == (3, 35, 1.0)
    assert g.counts.tolist() == [24, 1, 10]
    assert g.offsets.tolist() == [0, 24, 25, 35]
    assert g.high.tolist() == [[2.0, -1.0, 0.0], [1.0, 1.0, 1.5], [6.0, 8.0, 4.5]]
    # x slowest, z fastest: voxel (2, 1, 3) of the first colony is its last
    assert g.ijk[23].tolist() == [2, 1, 3] and g.owner[23] == 0
    assert g.centres()[23].tolist() == [1.0, -1.5, -0.25]


def test_grids_are_alike_where_all_their_voxels_are():
    one = grid([(3, 2, 4), (1, 1, 1)])
    assert one.alike(grid([(3, 2, 4), (1, 1, 1)]))
    assert not one.alike(grid([(3, 2, 4), (1, 2, 1)]))
    assert not one.alike(grid([(3, 2, 4), (1, 1, 1)], spacing=(2.0, 1.0, 1.0)))
    assert not one.alike(Grid(one.origin + 1.0, one.shape, SPACING))


def test_grids_of_one_shape_are_a_plain_view(device):
    g = grid([(3, 2, 4)] * 3, device)
    values = field(g)
    (batch,) = g.batches
    view = batch.of(values)
    assert view.shape == (3, 3, 2, 4) and view.data_ptr() == values.data_ptr()
    assert g.join([view]).data_ptr() == values.data_ptr()


def test_grids_of_many_shapes_are_gathered_and_put_back(device):
    shapes = [(3, 2, 4), (1, 1, 1), (3, 2, 4), (2, 5, 1), (2, 5, 1), (3, 2, 4)]
    g = grid(shapes, device)
    values = field(g)
    seen = []
    for batch in g.batches:
        part = batch.of(values)
        assert part.shape == (len(batch.colonies), *batch.shape)
        for k, place in enumerate(batch.colonies.tolist()):
            assert shapes[place] == batch.shape
            own = values[g.offsets[place] : g.offsets[place + 1]]
            assert torch.equal(part[k].reshape(-1), own)
            seen.append(place)
    assert sorted(seen) == list(range(6))
    assert torch.equal(g.join([batch.of(values) for batch in g.batches]), values)


def test_gradients_pass_through_gathering():
    g = grid([(3, 2, 1), (1, 1, 1), (3, 2, 1)])
    values = field(g).requires_grad_()
    weight = torch.arange(1.0, g.nodes + 1, dtype=torch.float64)
    (g.join([2 * batch.of(values) for batch in g.batches]) * weight).sum().backward()
    assert torch.equal(values.grad, 2 * weight)


def test_growing_keeps_every_value_in_its_place(device, dtype):
    g = grid([(3, 2, 4), (2, 2, 1)], device)
    values = field(g, dtype)
    low, high = g.origin.clone(), g.high.clone()
    low[0, 0] -= 0.1  # one block of 4 voxels of 2 µm
    high[0, 2] += 2.1  # two blocks of 4 voxels of 0.5 µm
    larger, (new, other) = g.extended(
        [values, values], low, high, block=4, fill=[-1.0, torch.tensor([5.0, 6.0], device=device)]
    )
    assert larger.shapes == ((7, 2, 12), (2, 2, 1))
    assert larger.origin.tolist() == [[-12.0, -3.0, -2.0], [-1.0, 0.0, 1.0]]
    # every centre that was there has its value, every other is filled
    old = {
        (int(c), *p): float(v)
        for c, p, v in zip(
            g.owner, np.round(g.centres().cpu().numpy(), 6).tolist(), values, strict=True
        )
        for p in [tuple(p)]
    }
    for c, p, v, w in zip(
        larger.owner.tolist(),
        np.round(larger.centres().cpu().numpy(), 6).tolist(),
        new.tolist(),
        other.tolist(),
        strict=True,
    ):
        assert v == old.get((c, *p), -1.0)
        assert w == old.get((c, *p), 5.0 + c)
    assert new.dtype == dtype


def test_nothing_to_do_costs_nothing(device):
    g = grid([(3, 2, 4), (2, 2, 1)], device)
    values = field(g)
    inf = torch.full_like(g.origin, torch.inf)
    for low, high in ((g.origin, g.high), (inf, -inf)):
        same, (still,) = g.extended([values], low, high, block=4)
        assert same is g and still is values


reach = st.floats(-12, 12)


@settings(max_examples=40, deadline=None)
@given(
    low=st.tuples(reach, reach, reach),
    size=st.tuples(*[st.floats(0, 8)] * 3),
    block=st.integers(1, 9),
)
def test_growing_covers_what_is_asked_and_is_a_colonys_own(low, size, block):
    """The box is covered to the rounding of positions of 100 µm, 1e-13, in whole blocks, none of
    them idle.

    The bits are the same alone and in a batch.
    """
    g = grid([(3, 2, 4)])
    lows = torch.tensor([low], dtype=torch.float64)
    highs = lows + torch.tensor([size], dtype=torch.float64)
    values = field(g)
    larger, (new,) = g.extended([values], lows, highs, block=block)
    assert bool((larger.origin <= lows + 1e-13).all() and (larger.high >= highs - 1e-13).all())
    added = larger.shape - g.shape
    assert bool((added % block == 0).all())
    step = g.step * block
    assert bool(
        (larger.origin + step > torch.minimum(lows, g.origin) - 1e-13).all()
        and (larger.high - step < torch.maximum(highs, g.high) + 1e-13).all()
    )
    assert float(new.sum()) == pytest.approx(float(values.sum()), abs=1e-9)
    # together with another colony that grows differently
    both = Grid(torch.cat([g.origin + 50, g.origin]), torch.cat([g.shape + 1, g.shape]), SPACING)
    more, (beside,) = both.extended(
        [torch.cat([torch.ones(int((g.shape + 1).prod()), dtype=torch.float64), values])],
        torch.cat([lows + 40, lows]),
        torch.cat([highs + 55, highs]),
        block=block,
    )
    assert torch.equal(more.origin[1], larger.origin[0]) and more.shapes[1] == larger.shapes[0]
    assert torch.equal(beside[more.offsets[1] :], new)


def test_what_makes_no_grid_is_refused():
    origin, shape = torch.zeros(2, 3, dtype=torch.float64), torch.ones(2, 3, dtype=torch.int64)
    for o, s, h, name in [
        (origin.float(), shape, SPACING, "origin"),
        (origin[:, :2], shape, SPACING, "origin"),
        (origin, shape.int(), SPACING, "shape"),
        (origin, shape[:1], SPACING, "shape"),
        (origin, shape - 1, SPACING, "at least one voxel"),
        (origin, shape, (1.0, 0.0, 1.0), "spacing"),
        (origin, shape, (1.0, 1.0), "spacing"),
    ]:
        with pytest.raises(InputError, match=name):
            Grid(o, s, h)
    g = Grid(origin, shape, SPACING)
    for low, high in (
        (origin[:1], origin),
        (origin * torch.nan, origin),
        (origin - torch.inf, origin),
    ):
        with pytest.raises(InputError, match="low, high"):
            g.extended([], low, high, block=4)
