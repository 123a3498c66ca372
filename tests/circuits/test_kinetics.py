"""Rate laws: values, and accuracy of values and derivatives at the extremes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import array

from torchfilm.circuits.kinetics import activation, michaelis_menten, repression

F64 = torch.float64
POWERS = [1.0, 1.5, 2.0, 2.5, 4.0, 8.0]


def test_plain_numbers_have_values():
    assert float(activation(2.0, 1.0, 2)) == pytest.approx(0.8, rel=1e-15)
    assert float(repression(-2, 1)) == 1.0 and float(michaelis_menten(3, 1.0)) == 0.75


@pytest.mark.parametrize("power", POWERS)
@pytest.mark.parametrize("tensor", [False, True], ids=["number", "tensor"])
def test_values(device, dtype, power, tensor):
    """Against NumPy in float64 over nine decades around K = 0.3; both laws are relatively accurate.

    A power of n costs n |log x/K| roundings, 8 · 12 at most.
    """
    x = torch.logspace(-5, 4, 200, dtype=F64).to(device=device, dtype=dtype)
    half, n = (torch.tensor(v, dtype=dtype, device=device) if tensor else v for v in (0.3, power))
    r = array(x) / float(half)
    for law, expected in (
        (activation, r**power / (1 + r**power)),
        (repression, 1 / (1 + r**power)),
    ):
        found = law(x, half, n)
        assert found.dtype == dtype
        # below 1e-37 float32 numbers are subnormal
        normal = expected > 1e-36
        assert np.abs(array(found) / expected - 1)[normal].max() <= 100 * torch.finfo(dtype).eps


@pytest.mark.parametrize("power", POWERS)
@pytest.mark.parametrize("law, low, high", [(activation, 0.0, 1.0), (repression, 1.0, 0.0)])
@pytest.mark.parametrize("tensor", [False, True], ids=["number", "tensor"])
def test_the_ends(device, dtype, power, law, low, high, tensor):
    """x/K from −1e30 to 1e30: the limits, no overflow, and two finite derivatives.

    The derivatives by half and power are finite too.
    """
    x = torch.tensor(
        [-1e30, -1.0, 0.0, 1e-30, 1e-10, 1.0, 1e10, 1e30],
        dtype=dtype,
        device=device,
        requires_grad=True,
    )
    half = torch.full_like(x, 1.0, requires_grad=True)
    n = torch.full_like(x, power, requires_grad=True) if tensor else power
    inputs = [x, half, n] if tensor else [x, half]
    y = law(x, half, n)
    first = torch.autograd.grad(y.sum(), inputs, create_graph=True)
    second = torch.autograd.grad(sum(f.sum() for f in first), inputs)
    assert all(torch.isfinite(v).all() for v in (y, *first, *second))
    assert y[:3].tolist() == [low] * 3 and float(y[-1].detach()) == pytest.approx(high, abs=1e-7)
    assert float(y[5].detach()) == 0.5
    assert (first[0][:2] == 0).all()


def test_slope_at_zero(dtype):
    """1/K for n = 1, also where the power is a tensor; 0 for n > 1; the curvature of n = 2 is
    2/K²."""
    x = torch.zeros(3, dtype=dtype, requires_grad=True)
    for n in ([1.0, 2.0, 1.5], None):
        powers = torch.tensor(n, dtype=dtype) if n else 1.0
        first = torch.autograd.grad(activation(x, 0.5, powers).sum(), x, create_graph=True)[0]
        assert first.tolist() == ([2.0, 0.0, 0.0] if n else [2.0] * 3)
        if n:
            assert torch.autograd.grad(first.sum(), x)[0].tolist() == [-8.0, 8.0, 0.0]
    assert torch.autograd.grad(michaelis_menten(x, 0.5).sum(), x)[0].tolist() == [2.0] * 3


@pytest.mark.parametrize("law", [activation, repression])
def test_derivatives_by_finite_differences(law):
    x = torch.tensor([0.1, 0.4, 0.9, 3.0], dtype=F64, requires_grad=True)
    half, n = (
        torch.tensor([0.5, 0.3, 1.2, 1.0], dtype=F64, requires_grad=True),
        torch.tensor([1.0, 1.5, 2.0, 8.0], dtype=F64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(law, (x, half, n))
    assert torch.autograd.gradgradcheck(law, (x, half, n))
    assert torch.autograd.gradcheck(lambda x, k: law(x, k, 2.5), (x, half))


def test_bits_do_not_depend_on_company(dtype):
    x = torch.rand(500, generator=torch.Generator().manual_seed(3), dtype=F64).to(dtype) * 3
    for n in (1.0, 1.5, 2.0, 8.0, torch.tensor(2.7, dtype=dtype)):
        for law in (activation, repression):
            whole = law(x, 0.7, n)
            assert torch.equal(
                torch.cat([law(x[k : k + 1], 0.7, n) for k in range(60)]), whole[:60]
            )
            assert all(
                torch.equal(law(x[3 : 3 + k], 0.7, n), whole[3 : 3 + k]) for k in range(2, 60)
            )
