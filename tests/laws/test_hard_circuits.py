"""Hard cases 24 and 26 to 30: stiff, bistable and oscillating circuits with answers known
in advance.

The method is `rosenbrock`. Tolerances of the cases are given; those of ours follow from rtol:
errors of single steps of rtol |u| add up along a stable orbit to a few of them, and float32 rates,
good to 6e-8, allow an rtol of 1e-5.
"""

from __future__ import annotations

import math

import pytest
import torch
from helpers import array

from torchfilm.circuits import kinetics
from torchfilm.circuits.rosenbrock import DONE, rodas3


def rtol_of(dtype) -> float:
    return 1e-5 if dtype == torch.float32 else 1e-7


def solved(rates, u, t, **options):
    out, report = rodas3(rates, u, t, **options)
    assert (report.status == DONE).all()
    assert torch.isfinite(out).all()
    return out


def test_case_24_a_fast_variable_in_a_bistable_loop(device, dtype, measured):
    """x' = 0.1 + 2z − x, z' = 1e8 (h(x) − z), h = x⁸/(1+x⁸): from (1, 0), x(10) = 2.0945004; from
    (0.9, 0), 0.100049.

    The answers have 8 and 6 digits. The first approaches a fixed point, the second passes near the
    threshold, which magnifies errors: with rtol 1e-7 5e-7 are left, with 1e-5 in float32 1e-5 and
    the threshold's share.
    """

    def rates(u, rows):
        x, z = u.unbind(1)
        return torch.stack([0.1 + 2 * z - x, 1e8 * (kinetics.activation(x, 1.0, 8) - z)], 1)

    u = solved(
        rates,
        torch.tensor([[1.0, 0.0], [0.9, 0.0]], dtype=dtype, device=device),
        10.0,
        rtol=rtol_of(dtype),
    )
    bound = 3e-5 if dtype == torch.float32 else 1e-6
    assert array(u)[:, 0] == pytest.approx([2.0945004, 0.100049], abs=bound)
    measured(
        "error of x(10)",
        abs(array(u)[:, 0] - [2.0945004, 0.100049]).max(),
        "≤ 3e-5 (float64: 1e-6)",
    )
    assert float(u.min()) >= 0


def test_case_26_fast_exchange(device, dtype, measured):
    """A ⇌ B with rates 1e8 and 1, Δt = 1: equilibrium to 1e-6 (given): A/(A + B) = 1/(1 + 1e8). The
    sum is kept to rounding, in float32 too, because the linear algebra is done in float64: cond(W)
    · 1e-16 = 1e-8 there, one unit of 6e-8 here. One step does it.
    """

    def rates(u, rows):
        a, b = u.unbind(1)
        flow = 1e8 * a - b
        return torch.stack([-flow, flow], 1)

    start = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.25, 0.75]], dtype=dtype, device=device)
    u, report = rodas3(rates, start, 1.0)
    assert (report.status == DONE).all() and (report.accepted <= 2).all()
    assert array(u)[:, 0] == pytest.approx(1e-8, abs=1e-6) and array(u)[:, 1] == pytest.approx(
        1.0, abs=1e-6
    )
    measured("error of the equilibrium", abs(array(u)[:, 0] - 1e-8).max(), "≤ 1e-6")
    assert (
        measured("change of the sum", float((u.double().sum(1) - 1).abs().max()), "≤ 1.2e-7")
        <= 1.2e-7
    )
    assert float(u.min()) >= 0


@pytest.mark.parametrize("power", [1.5, 8])
def test_case_27_hill_at_zero(device, dtype, measured, power):
    """All zeros with Hill n = 1.5 and 8: Jacobian finite, x ≥ 0; also by autograd a second time, as
    gradients through a step need it."""

    def rates(u, rows):
        return kinetics.activation(u.flip(1), 0.5, power) - u

    zero = torch.zeros(3, 2, dtype=dtype, device=device, requires_grad=True)
    first = torch.autograd.grad(rates(zero, None).sum(), zero, create_graph=True)[0]
    second = torch.autograd.grad(first.sum(), zero)[0]
    assert torch.isfinite(first).all() and torch.isfinite(second).all()
    u, _ = rodas3(rates, zero, 1.0)
    assert (u == 0).all()
    assert torch.isfinite(torch.autograd.grad(u.sum(), zero)[0]).all()
    # from within reach of zero, each to its own side: 0.5 is a fixed point only of one of the two
    small = torch.tensor([[1e-20, 0.0], [0.0, 1e-3], [0.4, 1e-6]], dtype=dtype, device=device)
    assert measured("lowest concentration", float(solved(rates, small, 3.0).min()), "≥ 0") >= 0


def test_case_28_hopf(device, dtype, measured):
    """Hopf normal form, μ = 0.01, ω = 1: amplitude 0.1, period 2π, within 1 % (given), from inside
    and outside.

    From 0.09 and 0.11 the distance falls as e^−2μt: 5 % of 10 % is left at t = 150. The steps' own
    damping, about rtol an hour, shifts the amplitude by rtol/2μ of it, so rtol is 1e-5; values
    change sign, so `nonnegative` is off.
    """

    def rates(u, rows):
        x, y = u.unbind(1)
        grows = 0.01 - (x * x + y * y)
        return torch.stack([grows * x - y, x + grows * y], 1)

    options = {"rtol": 1e-5, "atol": 1e-7, "nonnegative": False}
    start = torch.tensor([[0.09, 0.0], [0.11, 0.0]], dtype=dtype, device=device)
    there = solved(rates, start, 150.0, **options)
    assert array(there.norm(dim=1)) == pytest.approx(0.1, rel=0.01)
    measured(
        "error of the amplitude, relative", abs(array(there.norm(dim=1)) / 0.1 - 1).max(), "≤ 0.01"
    )
    later = solved(rates, there, 2 * math.pi, **options)
    # a turn later it is back: 1 % of the period is an angle of 0.06
    turned = torch.atan2(
        there[:, 0] * later[:, 1] - there[:, 1] * later[:, 0], (there * later).sum(1)
    )
    assert float(turned.abs().max()) <= 0.01 * 2 * math.pi
    measured("error of the period, relative", float(turned.abs().max()) / (2 * math.pi), "≤ 0.01")


@pytest.mark.slow
def test_case_29_repressilator(device, dtype, measured):
    """α = 216, α₀ = 0.216, n = 2: period 43.447 (β = 0.2), 8.6893 (β = 5).

    The answers are given to 5 digits, 1.2e-5. Seven periods leave 4e-6 of the way to the cycle
    (three leave 1e-4, six 1e-5), and rtol from 1e-4 to 3e-6 moves the period by 1e-5 in all: 3e-5
    covers the three. After a period a cell is back where it was, but for f δt. Time runs in
    periods, both circuits side by side.
    """
    periods = [43.447, 8.6893]
    beta = torch.tensor([0.2, 5.0], dtype=dtype, device=device)
    hours = torch.tensor(periods, dtype=dtype, device=device)

    def rates(u, rows):
        m, p = u[:, :3], u[:, 3:]
        change = torch.cat(
            [
                0.216 + 216 * kinetics.repression(p.roll(1, 1), 1.0, 2) - m,
                beta[rows].unsqueeze(1) * (m - p),
            ],
            1,
        )
        return hours[rows].unsqueeze(1) * change

    start = torch.tensor([[10.0, 1.0, 1.0, 20.0, 5.0, 1.0]], dtype=dtype, device=device).repeat(
        2, 1
    )
    settled = solved(rates, start, 7.0, rtol=1e-4, atol=1e-6)
    away = solved(rates, settled, 1.0, rtol=1e-5, atol=1e-6).double() - settled.double()
    speed = rates(settled, torch.arange(2, device=device)).double()
    late = (away * speed).sum(1) / (speed * speed).sum(1)
    # it has moved, and come back to the same place of the cycle
    half_way = solved(rates, settled, 0.5) - settled
    assert (half_way.abs().amax(1) > 10).all()
    assert (
        (away - late.unsqueeze(1) * speed).norm(dim=1) <= 1e-3 * half_way.double().norm(dim=1)
    ).all()
    assert array(late) == pytest.approx([0.0, 0.0], abs=3e-5)
    measured("error of the period, relative", abs(array(late)).max(), "≤ 3e-5")


def test_case_30_toggle_switch(device, dtype, measured):
    """a = 10, n = 2: stable at 5 ± √24, saddle at (2, 2); from (2, 2) ± 1e-3 each goes to its own
    side; on the diagonal it stays at the saddle."""

    def rates(u, rows):
        return 10 * kinetics.repression(u.flip(1), 1.0, 2) - u

    start = torch.tensor([[2.001, 1.999], [1.999, 2.001], [2.0, 2.0]], dtype=dtype, device=device)
    u = array(solved(rates, start, 60.0, rtol=rtol_of(dtype)))
    high, low = 5 + math.sqrt(24), 5 - math.sqrt(24)
    assert u[0] == pytest.approx([high, low], rel=1e-5)
    assert u[1] == pytest.approx([low, high], rel=1e-5)
    measured(
        "error of the stable states, relative",
        abs(u[:2] / [[high, low], [low, high]] - 1).max(),
        "≤ 1e-5",
    )
    # both species of the third are computed alike, so nothing parts them
    assert u[2] == pytest.approx([2.0, 2.0], rel=1e-5)
