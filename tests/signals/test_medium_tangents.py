"""Tangents through the medium: what kernels carry is what torch's forward mode finds."""

from __future__ import annotations

import pytest
import torch
from test_compiled_transport import grid_of
from test_exchange import ALL, grid, random_values, scattered
from test_operator import BOUNDARIES, make

from torchfilm.signals import compiled, transport
from torchfilm.signals.exchange import pool_volume, read, stencil, write
from torchfilm.signals.transport import Carrier, carry, prepare
from torchfilm.tools import tangents

F64 = torch.float64


def close(one, other) -> bool:
    """Sums of a few hundred terms of both signs, in another order: 1e-12 of the largest."""
    return float((one - other).abs().max()) <= 1e-12 * float(other.abs().max())


def both_ways(monkeypatch, function):
    """(value, tangent) by kernels, and by torch."""
    with tangents.forward_mode():
        by_kernels = tangents.both(function())
        for module in (compiled, transport):
            monkeypatch.setattr(module, "may_run_forward", lambda *given: False)
        by_torch = tangents.both(function())
    monkeypatch.undo()
    return by_kernels, by_torch


def moved(value, seed):
    """The value, with a tangent of either sign."""
    turned = torch.randn(value.shape, dtype=F64, generator=torch.Generator().manual_seed(seed))
    return tangents.with_tangent(value, turned)


@pytest.mark.parametrize("method", ["exponential", "series"])
@pytest.mark.parametrize("faces", BOUNDARIES)
def test_a_step_of_transport(monkeypatch, method, faces):
    """Also with sources and faces that hold a value, which have no tangent."""
    op, *_ = make((6, 5, 4), faces, "still" if method == "exponential" else "varying", dtype=F64)
    carrier = Carrier(prepare(op, 0.3, method), (6, 5, 4))
    assert carrier.linear is not None
    grids = grid_of((6, 5, 4), (6, 5, 4))
    values = torch.rand(240, dtype=F64, generator=torch.Generator().manual_seed(0))
    run = lambda: carry(grids, [carrier], moved(values, 1))
    kernels, torch_ = both_ways(monkeypatch, run)
    assert close(kernels[0], torch_[0]) and close(kernels[1], torch_[1])
    # the value has the bits of a step without tangents
    assert torch.equal(kernels[0], carry(grids, [carrier], values))


@ALL
def test_reading_and_writing(monkeypatch, shape):
    """Cells that secrete, that take up, that take all there is, and of an empty voxel."""
    g = grid([shape, shape])
    position, colony = scattered(g, 6)
    s = stencil(g, position, colony)
    values = random_values(g, F64)
    values[: g.nodes // 2 : 3] = 0.0
    found = read(values, s)
    amount = torch.where(torch.arange(12) % 3 == 0, 0.7, -0.3 * found) * pool_volume(s)
    amount[4] = -found[4] * pool_volume(s)[4]
    amount[5] = 0.0

    kernels, torch_ = both_ways(monkeypatch, lambda: read(moved(values, 2), s))
    assert torch.equal(kernels[0], read(values, s)) and close(kernels[1], torch_[1])
    for v, a in ((True, True), (True, False), (False, True)):
        run = lambda v=v, a=a: write(
            moved(values, 2) if v else values, moved(amount, 3) if a else amount, s
        )
        kernels, torch_ = both_ways(monkeypatch, run)
        assert torch.equal(kernels[0], write(values, amount, s))
        assert close(kernels[1], torch_[1])


def test_torch_carries_tangents_where_transport_depends_on_the_parameter():
    """A decay with a tangent: no kernel, and the derivative of exp(−k t)."""
    from torchfilm.signals.boundary_conditions import BoundaryConditions
    from torchfilm.signals.transport_rates import build_operator

    with tangents.forward_mode():
        decay = tangents.with_tangent(torch.tensor([0.5], dtype=F64), torch.ones(1, dtype=F64))
        op = build_operator(
            (4, 1, 1), (1.0, 1.0, 1.0), diffusion=1.0, decay=decay, colonies=1,
            boundary=BoundaryConditions(), dtype=F64,
        )  # fmt: skip
        carrier = Carrier(prepare(op, 0.2), (4, 1, 1), may_compile=False)
        value, turned = tangents.both(
            carry(grid_of((4, 1, 1)), [carrier], torch.ones(4, dtype=F64))
        )
    wanted = torch.exp(torch.tensor(-0.1, dtype=F64))
    assert value == pytest.approx(wanted.expand(4)) and turned == pytest.approx(
        -0.2 * wanted.expand(4)
    )
