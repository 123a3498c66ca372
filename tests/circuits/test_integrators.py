"""Explicit integrators: their orders, and the independence of cells."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import array

import torchfilm as tf
from torchfilm.circuits.integrators import euler, runge_kutta

F64 = torch.float64
METHODS = {
    "euler": (1, euler),
    "midpoint": (2, lambda *a, **k: runge_kutta(*a, method="midpoint", **k)),
    "heun2": (2, lambda *a, **k: runge_kutta(*a, method="heun2", **k)),
    "heun3": (3, lambda *a, **k: runge_kutta(*a, method="heun3", **k)),
    "rk4": (4, runge_kutta),
}


def logistic(u, rows):
    return u * (1 - u)


@pytest.mark.parametrize("method", METHODS)
def test_order(method):
    """u' = u (1 − u): halving the step divides the error by 2^order.

    This holds over two halvings, within 10 % of the order.
    """
    order, step = METHODS[method]
    exact = 1 / (1 + math.exp(-2) * 9)
    errors = [
        abs(float(step(logistic, torch.tensor([[0.1]], dtype=F64), 2.0, steps=n)) - exact)
        for n in (16, 32, 64)
    ]
    found = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (np.abs(found - order) <= 0.1 * order).all(), found


@pytest.mark.parametrize("method", METHODS)
def test_a_row_is_its_own(device, dtype, method):
    start = torch.rand(37, 3, generator=torch.Generator().manual_seed(1)).to(
        device=device, dtype=dtype
    )
    speed = torch.linspace(0.1, 3, 37, device=device, dtype=dtype)
    run = lambda k: METHODS[method][1](
        lambda u, rows: speed[k][rows].unsqueeze(1) * logistic(u, rows), start[k], 0.7, steps=3
    )
    whole = run(torch.arange(37, device=device))
    assert whole.dtype == dtype and whole.device.type == device.type
    for k in ([0], [36], list(range(36, -1, -1)), [5, 11, 3, 20, 7]):
        k = torch.tensor(k, device=device)
        assert torch.equal(run(k), whole[k])


@pytest.mark.parametrize("method", METHODS)
def test_gradient(method):
    step = METHODS[method][1]
    u, k = (
        torch.tensor([[0.1], [0.6]], dtype=F64, requires_grad=True),
        torch.tensor(1.3, dtype=F64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(
        lambda u, k: step(lambda y, rows: k * logistic(y, rows), u, 1.0, steps=3), (u, k)
    )


def test_equal_steps_in_float32():
    """A step size that float32 cannot represent: as many calls as steps, and no tiny step at the
    end.
    """
    calls = []

    def rates(u, rows):
        calls.append(1)
        return -u

    u = runge_kutta(rates, torch.ones(2, 1), 0.7, steps=7)
    assert len(calls) == 7 * 4
    assert array(u) == pytest.approx(math.exp(-0.7), rel=1e-6)


def test_what_makes_no_sense_is_refused():
    for steps in (0, -1, 1.5, True):
        with pytest.raises(tf.InputError, match="steps"):
            euler(logistic, torch.ones(1, 1), 1.0, steps=steps)
    with pytest.raises(tf.InputError, match="dopri5"):
        runge_kutta(logistic, torch.ones(1, 1), 1.0, method="dopri5")
    assert runge_kutta(logistic, torch.empty(0, 2), 1.0).shape == (0, 2)
