"""Keyed uniforms and Poisson numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import array
from scipy import stats

from torchfilm.circuits.draws import KeyedDraws, poisson

F64 = torch.float64


def cells(count: int, device="cpu"):
    n = torch.arange(count, device=device)
    return n // 1000, n % 1000


def test_uniforms_are_uniform_and_strangers(device):
    """Kolmogorov–Smirnov of 100,000 draws, and correlations of lanes, events, purposes and cells.

    The draws never change, so p below 1e-3 would be a defect. Correlations are within 4.5/√n.
    """
    colony, uid = cells(20_000, device)
    draw = KeyedDraws(3, colony, uid, 7)
    rows = torch.arange(20_000, device=device)
    u = array(draw(rows, 0, "leap", 5))
    assert u.shape == (5, 20_000) and u.min() > 0 and u.max() < 1
    assert stats.kstest(u.reshape(-1), "uniform").pvalue > 1e-3
    others = [
        u[1],
        u[2],
        array(draw(rows, 1, "leap", 1))[0],
        array(draw(rows, 0, "rare", 1))[0],
        np.roll(u[0], 1),
        np.roll(u[0], 1000),
    ]
    others += [
        array(KeyedDraws(seed, colony, uid, step)(rows, 0, "leap", 1))[0]
        for seed, step in ((4, 7), (3, 8), (3 + 2**40, 7))
    ]
    for other in others:
        assert abs(np.corrcoef(u[0], other)[0, 1]) < 4.5 / np.sqrt(20_000)


def test_a_draw_is_its_own(device):
    """The same for a cell alone or in a batch, and for one number or many."""
    colony, uid = cells(3000, device)
    draw = KeyedDraws(1, colony, uid, 2)
    whole = draw(torch.arange(3000, device=device), 5, "x", 4)
    rows = torch.tensor([2999, 0, 1500], device=device)
    assert torch.equal(draw(rows, 5, "x", 4), whole[:, rows])
    assert torch.equal(draw(rows, 5, "x", 1), whole[:1, rows])
    assert torch.equal(
        KeyedDraws(1, colony[rows], uid[rows], 2)(
            torch.tensor([0, 1, 2], device=device), 5, "x", 3
        ),
        whole[:3, rows],
    )


@pytest.mark.parametrize("mean", [1e-9, 0.01, 0.5, 3.9, 4.1, 12.0, 80.0, 3e3, 1e6, 1e9])
def test_poisson_inverts_the_distribution(device, mean):
    """Against scipy's ppf at 3,000 uniforms and at both extremes.

    The numbers are equal, except where a uniform lies within rounding of a step.
    """
    g = torch.Generator().manual_seed(1)
    u = torch.cat(
        [
            torch.rand(3000, generator=g, dtype=F64),
            torch.tensor([2.0**-54, 1e-12, 1e-3, 0.999, 1 - 1e-12], dtype=F64),
        ]
    ).clamp(2.0**-54, 1 - 2.0**-53)
    found = array(poisson(torch.full_like(u, mean).to(device), u.to(device)))
    expected = stats.poisson.ppf(array(u), mean)
    different = found != expected
    assert np.abs(found - expected).max() <= 1 and different.mean() <= 2e-3
    # where they differ, the uniform is at the step itself: within 1e-12 by the sum's rounding, or
    # within the law's next correction, 1e-2 of a step
    at = np.minimum(found, expected)[different]
    off = np.abs(stats.poisson.cdf(at, mean) - array(u)[different])
    assert off.max(initial=0.0) <= (
        1e-12 if mean <= 1e6 else 1e-2 * stats.poisson.pmf(int(mean), mean)
    )


def test_poisson_at_the_ends(device):
    u = torch.tensor([2.0**-54, 0.5, 1 - 2.0**-53], dtype=F64, device=device)
    assert poisson(torch.zeros_like(u), u).tolist() == [0, 0, 0]
    for mean in (1e-300, 1e-3, 5.0, 100.0, 1e7):
        k = poisson(torch.full_like(u, mean), u)
        assert torch.isfinite(k).all() and (k == k.round()).all() and (k >= 0).all()
        # 8.3 standard deviations, and the tail of a small mean: P(X > 60) < 1e-40 for a mean of 5
        assert float(k[2]) <= mean + 9 * mean**0.5 + 20


def test_poisson_moments():
    """Mean and variance of 200,000 stratified uniforms.

    The sums are integrals of the inverse, accurate to 1e-3 of the standard deviation.
    """
    u = (torch.arange(200_000, dtype=F64) + 0.5) / 200_000
    for mean in (0.3, 4.0, 37.0, 1e4):
        k = array(poisson(torch.full_like(u, mean), u))
        assert abs(k.mean() - mean) <= 1e-3 * mean**0.5
        assert k.var() == pytest.approx(mean, rel=2e-3)


def test_poisson_bits_do_not_depend_on_company():
    g = torch.Generator().manual_seed(5)
    mean, u = (
        10 ** (torch.rand(400, generator=g, dtype=F64) * 8 - 2),
        torch.rand(400, generator=g, dtype=F64),
    )
    whole = poisson(mean, u)
    assert torch.equal(
        torch.cat([poisson(mean[k : k + 1], u[k : k + 1]) for k in range(400)]), whole
    )
    assert torch.equal(poisson(mean.reshape(4, 100), u.reshape(4, 100)).reshape(-1), whole)


def test_codes_are_copied_to_a_device_once(monkeypatch):
    """A copy to a GPU for each draw would wait in its queue."""
    rows = torch.arange(3)
    draw = KeyedDraws(1, rows, rows, 0, "codes")
    first = draw(rows, 0, "once", 3)
    monkeypatch.setattr(torch, "tensor", None)
    assert torch.equal(draw(rows, 0, "once", 3), first)
