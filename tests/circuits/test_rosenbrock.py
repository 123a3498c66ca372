"""The stiff integrator: order, references, positivity, conservation, failures, gradients,
independence of cells.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import array
from scipy.integrate import solve_ivp

import torchfilm as tf
from torchfilm.circuits import kinetics, linear
from torchfilm.circuits.rosenbrock import BELOW_ZERO, DONE, NOT_FINITE, TOO_MANY_STEPS, rodas3
from torchfilm.tools.deterministic_math import deterministic_functions

F64 = torch.float64


def columns(*parts):
    return torch.stack(torch.broadcast_tensors(*parts), 1)


def toggle(u, rows):
    x, y = u.unbind(1)
    return columns(4 * kinetics.repression(y, 1.0, 2) - x, 3 * kinetics.repression(x, 1.0, 2) - y)


def robertson(u, rows):
    a, b, c = u.unbind(1)
    one, two = 0.04 * a - 1e4 * b * c, 3e7 * b * b
    return columns(-one, one - two, two)


def chain(u, rows):
    """Two fast decays in a row and two slow species."""
    a, b, c, d = u.unbind(1)
    return columns(-1e8 * a, 1e8 * a - 3e7 * b, 3e7 * b - c, 0.5 - d)


def lux(u, rows):
    """The sink cells of the paper's figure 5 at a fixed signal, 2e-2."""
    aiia, ahl, yfp = u.unbind(1)
    return columns(
        1e-3 - 0.1 * aiia,
        -0.1 * aiia * kinetics.michaelis_menten(ahl, 1e-2) + 0.1 * (2e-2 - ahl) * 4.0,
        1e-5 + kinetics.activation(ahl, 5e-5**0.5, 2) - 0.1 * yfp,
    )


def ring(u, rows):
    """Six species, each activated by the one before, written as by a user, with a fractional
    power.
    """
    with deterministic_functions():
        x = u.unbind(1)
        return torch.stack(
            [0.1 + x[i - 1] ** 1.7 / (0.5 + x[i - 1] ** 1.7) - x[i] for i in range(len(x))], 1
        )


def exact(rates, start, t, **options) -> np.ndarray:
    def f(_, y):
        return array(rates(torch.tensor(y, dtype=F64).unsqueeze(0), torch.tensor([0])))[0]

    return solve_ivp(f, (0, t), start, method="LSODA", rtol=1e-11, atol=1e-14, **options).y[:, -1]


def test_order_three():
    """Equal steps (every error allowed) on a nonlinear circuit: halving the step divides the error
    by 2³.

    Measured over three halvings, within 10 %.
    """
    start = [0.3, 1.4]
    reference = exact(toggle, start, 2.0)
    errors = []
    for steps in (8, 16, 32, 64):
        u = torch.tensor([start], dtype=F64)
        for _ in range(steps):
            u, report = rodas3(toggle, u, 2.0 / steps, rtol=1e9)
            assert int(report.accepted) == 1
        errors.append(np.abs(array(u)[0] - reference).max())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (np.abs(orders - 3) <= 0.3).all(), orders


def test_error_estimate_is_of_order_two_results():
    """The chosen step shrinks with the cube root of rtol: the estimate is that of the embedded
    result, h³.
    """
    start, counts = torch.tensor([[0.3, 1.4]], dtype=F64), []
    for rtol in (1e-6, 1e-9):
        counts.append(int(rodas3(toggle, start, 2.0, rtol=rtol, atol=0.0)[1].accepted))
    assert counts[1] / counts[0] == pytest.approx(10, rel=0.15)


@pytest.mark.parametrize(
    "rates, start, t",
    [(toggle, [0.3, 1.4], 5.0), (lux, [0.0, 0.0, 0.0], 20.0), (robertson, [1.0, 0.0, 0.0], 40.0)],
)
def test_against_lsoda(device, dtype, rates, start, t):
    """Stable circuits: the error at the end is a few times the allowed error of a step, rtol.

    rtol is 1e-4 by default; the bound is ten times that.
    """
    u, report = rodas3(rates, torch.tensor([start], dtype=dtype, device=device), t, atol=1e-10)
    assert (report.status == DONE).all()
    assert u.dtype == dtype
    assert array(u)[0] == pytest.approx(exact(rates, start, t), rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("rtol", [1e-3, 1e-5, 1e-7])
def test_error_follows_the_tolerance(rtol):
    u, _ = rodas3(toggle, torch.tensor([[0.3, 1.4]], dtype=F64), 3.0, rtol=rtol)
    assert np.abs(array(u)[0] / exact(toggle, [0.3, 1.4], 3.0) - 1).max() <= 10 * rtol


def test_one_step_where_one_is_enough(device, dtype):
    """The first step is the whole dt. Near a fixed point it is enough, however fast the decay."""
    rates = lambda u, rows: 1e8 * (1.0 - u)
    u, report = rodas3(rates, torch.ones(4, 2, dtype=dtype, device=device), 1.0)
    assert (report.accepted == 1).all() and (report.rejected == 0).all()
    assert torch.equal(u, torch.ones_like(u))


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-6, 1e-12, 1e-25])
@pytest.mark.parametrize("t", [0.025, 1e-6, 3e-8])
def test_a_fast_decay_to_zero_does_not_stall(device, dtype, size, t):
    """Rates of 1e8 and 3e7 in a row with slow ones: nothing is below zero, and the slow ones are
    right.

    The number of steps follows from the accuracy of a decay over the decades down to atol (some 20
    each), not from t · 1e8.
    """
    u, report = rodas3(chain, torch.tensor([[size, 0.0, 1.0, 2.0]], dtype=dtype, device=device), t)
    assert int(report.status) == DONE
    assert int(report.accepted + report.rejected) <= 250
    assert float(u.min()) >= 0
    assert array(u)[0] == pytest.approx(exact(chain, [size, 0.0, 1.0, 2.0], t), rel=3e-4, abs=1e-8)


def test_rates_are_not_asked_below_zero(device, dtype):
    """x' = −1e6 x from below atol: stages of a long step lie at −x, where x^1.5 is NaN.

    The rates are continued linearly there, so one step is enough.
    """
    seen = []

    def rates(u, rows):
        seen.append(float(u.detach().min()))
        x, y = u.unbind(1)
        return columns(-1e6 * x, x * x.sqrt() - y)

    u, report = rodas3(rates, torch.tensor([[1e-13, 1e-3]], dtype=dtype, device=device), 0.025)
    assert int(report.status) == DONE and int(report.accepted + report.rejected) <= 3
    assert min(seen) >= 0
    assert float(u[0, 1]) == pytest.approx(1e-3 * np.exp(-0.025), rel=1e-4)
    # where values may be negative, the rates are evaluated there
    rodas3(
        rates,
        torch.tensor([[1e-13, 1e-3]], dtype=dtype, device=device),
        0.025,
        nonnegative=False,
        max_steps=3,
    )
    assert min(seen) < 0


@pytest.mark.parametrize("t", [0.4, 40.0, 4e9])
def test_what_the_rates_conserve_is_conserved(device, dtype, t):
    """Robertson's a + b + c = 1 is conserved to rounding.

    The error walks at random: 150 steps of about 3 units each, elimination included, make 36 units;
    50 are allowed, root mean square over 16 end times.
    """
    ends = t * (1 + 0.01 * torch.arange(16))
    error = []
    for end in ends.tolist():
        start = torch.tensor([[1.0, 0.0, 0.0]], dtype=dtype, device=device)
        u, report = rodas3(robertson, start, end, atol=1e-10)
        assert int(report.status) == DONE
        error.append(float(u.double().sum()) - 1)
        assert float(u.min()) >= 0
    assert math.sqrt(sum(e * e for e in error) / len(error)) <= 50 * torch.finfo(dtype).eps


def test_conserved_where_results_are_raised_to_zero():
    """a + b -> c has two conserved sums, which hold even where plain results would be below zero.

    The rounding of W's entries, up to 1e4 · 5, relative to 2/h, is 1e-16 · h · 5e4 of the converted
    amount, at most 5.
    """

    def rates(u, rows):
        a, b, _ = u.unbind(1)
        flow = 1e4 * a * b
        return columns(-flow, -flow, flow)

    start = torch.tensor(
        [[1.0, 1e-3, 0.0], [1.0, 1.0, 0.0], [1e-6, 5.0, 0.0], [1e-12, 1.0, 0.3]], dtype=F64
    )
    for t in (1e-4, 1e-3, 0.1, 10.0):
        u, report = rodas3(rates, start, t)
        assert (report.status == DONE).all() and float(u.min()) >= 0
        for k in (0, 1):
            assert torch.allclose(
                u[:, k] + u[:, 2],
                start[:, k] + start[:, 2],
                rtol=0,
                atol=1e-14 + 1e-16 * t * 5e4 * 5,
            )


@pytest.mark.parametrize("fastest", [4, 8])
def test_nonnegative_over_random_networks(device, dtype, fastest):
    """200 cells of random first- and second-order reactions: never below 0, and all are done.

    Constants are from 1e-3 to 10^fastest, starts are random, some at 0. The sum is conserved except
    for the rounding of the rates, which adds up to eps · rate · time of the converted amount: 0.025
    · 1e4 · 6e-8 = 1.5e-5 in float32, where 1e8 requires float64.
    """
    g = torch.Generator().manual_seed(7)
    pick = lambda *shape: 10 ** (torch.rand(*shape, generator=g, dtype=F64) * (fastest + 3) - 3)
    first = pick(200, 4, 4) * (torch.rand(200, 4, 4, generator=g) < 0.4)
    pair = pick(200)
    start = torch.rand(200, 4, generator=g, dtype=F64) * (torch.rand(200, 4, generator=g) < 0.6)
    first, pair, start = (x.to(device=device, dtype=dtype) for x in (first, pair, start))

    def rates(u, rows):
        flow = first[rows] * u.unsqueeze(2)  # i -> j
        meet = (pair[rows] * u[:, 0] * u[:, 1]).unsqueeze(1)
        return flow.sum(1) - flow.sum(2) + torch.cat([-meet, -meet, meet, meet], 1)

    u, report = rodas3(rates, start, 0.025)
    assert (report.status == DONE).all()
    assert float(u.min()) >= 0
    if dtype == F64 or fastest < 8:
        assert torch.allclose(
            u.sum(1), start.sum(1), rtol=0, atol=torch.finfo(dtype).eps * (0.025 * 10**fastest + 10)
        )


def test_negative_values_are_free_where_asked_for(device, dtype):
    u, report = rodas3(
        lambda u, rows: -torch.ones_like(u),
        torch.ones(1, 1, dtype=dtype, device=device),
        3.0,
        nonnegative=False,
    )
    assert int(report.status) == DONE and float(u) == pytest.approx(-2.0, rel=1e-6)


def test_failures_stay_with_their_cell(device, dtype):
    """Four failures: a NaN rate, a rate that becomes infinite, one that makes a concentration
    negative, and one that requires too many steps. The other cells continue.
    """

    def rates(u, rows):
        x = u[:, 0]
        out = torch.where(rows == 1, torch.full_like(x, torch.nan), -x)
        out = torch.where(rows == 2, x * x, out)
        out = torch.where(rows == 3, -torch.ones_like(x), out)
        return torch.where(rows == 4, -1e4 * x, out).unsqueeze(1)

    start = torch.ones(6, 1, dtype=dtype, device=device)
    # a decay over the nine decades down to atol takes some 20 steps each
    u, report = rodas3(rates, start, 2.0, max_steps=120)
    assert report.status.tolist()[:2] == [DONE, NOT_FINITE]
    assert int(report.status[2]) in (NOT_FINITE, TOO_MANY_STEPS)  # x' = x² is infinite at t = 1
    assert report.status.tolist()[3:] == [BELOW_ZERO, TOO_MANY_STEPS, DONE]
    assert torch.isfinite(u).all()
    assert float(u[1]) == 1.0 and int(report.rejected[1]) == 1  # fails at once
    assert float(u[0]) == pytest.approx(np.exp(-2), rel=1e-3) and float(u[5]) == float(u[0])


def test_nothing_to_do(device, dtype):
    empty, _ = rodas3(toggle, torch.empty(0, 2, dtype=dtype, device=device), 1.0)
    assert empty.shape == (0, 2)
    start = torch.rand(3, 2, dtype=dtype, device=device)
    same, report = rodas3(toggle, start, 0.0)
    assert torch.equal(same, start) and (report.status == DONE).all()
    # a constant rate has no Jacobian
    grown, _ = rodas3(
        lambda u, rows: torch.full_like(u, 2.0).detach(),
        torch.zeros(2, 1, dtype=dtype, device=device),
        0.5,
    )
    assert array(grown) == pytest.approx(1.0)


@pytest.mark.parametrize("count", [2, 33, 150])
def test_a_row_is_its_own(dtype, count):
    """Bitwise the same alone, in any batch and at any position, for easy and stiff rows.

    This covers results and step counts. With a gradient the Jacobian is computed in the other way,
    so results agree to rounding.
    """
    g = torch.Generator().manual_seed(count)
    speed = (10 ** (torch.rand(count, generator=g, dtype=F64) * 6 - 1)).to(dtype)
    start = (torch.rand(count, 6, generator=g, dtype=F64) ** 3).to(dtype)
    of = lambda k: lambda u, rows: speed[k][rows].unsqueeze(1) * ring(u, rows)
    whole, report = rodas3(of(torch.arange(count)), start, 0.5)
    for k in (
        torch.arange(1),
        torch.arange(count).flip(0),
        torch.randperm(count, generator=g)[: count // 2],
        torch.arange(count - 1, count),
    ):
        part, own = rodas3(of(k), start[k], 0.5)
        assert torch.equal(part, whole[k])
        assert torch.equal(own.accepted, report.accepted[k]) and torch.equal(
            own.rejected, report.rejected[k]
        )
    traced, _ = rodas3(of(torch.arange(count)), start.clone().requires_grad_(), 0.5)
    # of the Jacobian's last bits, which change a result by no more than that share of the error
    # that is allowed
    assert torch.allclose(
        traced.detach(), whole, rtol=1e-3 * 1e-4 + 4 * torch.finfo(dtype).eps, atol=1e-12
    )


def test_gradient_of_one_step():
    """The exact derivative of the step, through the Jacobian and both solves: gradcheck,
    float64.
    """
    u = torch.tensor([[0.3, 1.4], [2.0, 0.1]], dtype=F64, requires_grad=True)
    k = torch.tensor([4.0, 3.0], dtype=F64, requires_grad=True)

    def run(u, k):
        rates = lambda y, rows: columns(
            k[0] * kinetics.repression(y[:, 1], 1.0, 2) - y[:, 0],
            k[1] * kinetics.repression(y[:, 0], 1.0, 2) - y[:, 1],
        )
        return rodas3(rates, u, 0.4, rtol=1e9)[0]

    assert torch.autograd.gradcheck(run, (u, k))


def test_gradient_through_many_steps(dtype):
    """Robertson's rate constants over 4 h, by central differences of runs with rtol 1e-7 (float64).

    At that rtol the steps of these runs have no effect: 1e-3 relative has a truncation of 1e-6 and
    noise of 1e-4. The gradient's own error is that of its steps, some 10 rtol = 1e-3 of the result.
    """

    def run(k, rtol):
        def rates(u, rows):
            a, b, c = u.unbind(1)
            k1, k2, k3 = k.index_select(0, rows).unbind(1)
            one, two = k1 * a - k2 * b * c, k3 * b * b
            return columns(-one, one - two, two)

        start = torch.tensor([[1.0, 0.0, 0.0]], dtype=k.dtype).expand(k.shape[0], 3)
        return rodas3(rates, start, 4.0, rtol=rtol, atol=1e-10)[0][:, 0]

    k0 = torch.tensor([[0.04, 1e4, 3e7]], dtype=F64)
    k = k0.to(dtype).requires_grad_()
    grad = torch.autograd.grad(run(k, 1e-4).sum(), k)[0][0].double()
    up, down = run(k0 * (1 + 1e-3 * torch.eye(3)), 1e-7), run(k0 * (1 - 1e-3 * torch.eye(3)), 1e-7)
    slope = (up - down) / (2e-3 * k0[0])
    assert torch.allclose(grad, slope, rtol=2e-3, atol=0)


def test_gradient_where_results_are_raised_and_steps_rejected():
    """Rejected steps and steps moved to zero give no NaN, and conserved sums have their exact
    gradient.

    ∂(a + b + c + …)/∂start = 1.
    """

    def rates(u, rows):
        a, b, _ = u.unbind(1)
        return columns(-1e8 * a, 1e8 * a - 3e7 * b, 3e7 * b)

    u = torch.tensor(
        [[1.0, 0.0, 0.5], [1e-9, 1e-12, 1.0], [0.0, 0.0, 0.0]], dtype=F64, requires_grad=True
    )
    out, report = rodas3(rates, u, 1e-6)
    assert int(report.rejected.max()) > 0
    grad = torch.autograd.grad(out.sum(), u)[0]
    assert grad == pytest.approx(torch.ones(3, 3), abs=1e-6)


def test_gradient_where_a_rejected_step_is_not_finite():
    """x' = x − 1e-30 eˣ from 10 over 1.98 h, against central differences.

    The first trial step overflows (2/h − J is 0.01), the accepted steps do not.
    """
    rates = lambda u, rows: u - 1e-30 * torch.exp(u)
    x = torch.full((3, 1), 10.0, dtype=F64) + torch.tensor([[0.0], [1e-3], [-1e-3]], dtype=F64)
    x.requires_grad_()
    u, report = rodas3(rates, x, 1.98, rtol=1e-7)
    assert int(report.rejected.min()) > 0 and (report.status == DONE).all()
    grad = torch.autograd.grad(u[0].sum(), x)[0].reshape(-1)
    u = u.detach().reshape(-1)
    assert float(grad[0]) == pytest.approx(float(u[1] - u[2]) / 2e-3, rel=1e-3)
    assert grad[1:].tolist() == [0.0, 0.0]


def test_no_graph_without_need():
    out, _ = rodas3(toggle, torch.rand(3, 2), 1.0)
    assert not out.requires_grad
    with torch.no_grad():
        assert not rodas3(toggle, torch.rand(3, 2, requires_grad=True), 1.0)[0].requires_grad


@pytest.mark.parametrize("size", [1, 2, 5, 12])
def test_linear_systems(device, dtype, size):
    """Against torch.linalg in float64, with the transposed solve and the gradients.

    The matrices are diagonally dominant: errors are a few units of rounding.
    """
    g = torch.Generator().manual_seed(size)
    matrix = (
        torch.rand(size, size, 9, generator=g, dtype=F64)
        - 0.5
        + size * torch.eye(size, dtype=F64).unsqueeze(2)
    ).to(device=device, dtype=dtype)
    b = torch.rand(size, 9, generator=g, dtype=F64).to(device=device, dtype=dtype)
    lu, sound, _ = linear.factor(matrix, torch.full_like(b, float(size)))
    assert sound.all()
    whole = matrix.permute(2, 0, 1).double()
    for found, dense in (
        (linear.substitute(lu, b), whole),
        (linear.substitute_transposed(lu, b), whole.mT),
    ):
        assert torch.allclose(
            found.double(),
            torch.linalg.solve(dense, b.t().double()).t(),
            rtol=0,
            atol=10 * torch.finfo(dtype).eps,
        )
    assert torch.allclose(
        linear.multiply(matrix, b), torch.einsum("ikm,km->im", matrix, b), rtol=1e-5
    )
    if dtype == F64:
        run = lambda m, b: linear.solve(m, linear.factor(m.detach(), b.detach())[0], b)
        assert torch.autograd.gradcheck(
            run, (matrix[..., :2].clone().requires_grad_(), b[:, :2].clone().requires_grad_())
        )


def test_pivots_that_vanish_are_noticed():
    """J = 2/h makes W singular at its first pivot: this is reported, and the step is repeated with
    another size.
    """
    matrix = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=F64).unsqueeze(2)
    assert not bool(linear.factor(matrix, torch.ones(2, 1, dtype=F64))[1])
    u, report = rodas3(lambda u, rows: 2.0 * u, torch.ones(1, 1, dtype=F64), 1.0)
    assert int(report.status) == DONE and int(report.rejected) > 0
    assert float(u) == pytest.approx(np.exp(2), rel=1e-3)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
@pytest.mark.parametrize("grows", [False, True])
def test_what_runs_away_in_a_finite_time_fails_and_is_named(backend, grows):
    """u' = 10 u² from 0.7 reaches infinity at 0.143 h. An implicit step may leap over that, to
    numbers that look sound."""
    rates = lambda u, s, p, cell: {"b": 0.0 * u.b, "a": 10.0 * u.a**2}
    circuit = tf.Circuit(rates, species=("b", "a"), initial={"a": 0.7}, backend=backend)
    effects = [tf.Growth(rate=1.0)] if grows else []
    told = r"step [34] .*\n.*: 'a' runs away, from"
    with pytest.raises(tf.SimulationError, match=told):
        for _ in tf.simulate(tf.Scene(*effects, circuit), dt=0.05, until=1.0):
            pass


def test_growth_faster_than_a_step_is_followed():
    """u' = 100 u in steps of the scene that are five times too long for it: e⁵ in each."""
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"a": 100.0 * u.a}, species=("a",), initial={"a": 1e-6}
    )
    *_, state = tf.simulate(tf.Scene(circuit), dt=0.05, until=0.2)
    assert float(state.fields["a"]) == pytest.approx(1e-6 * math.exp(20.0), rel=2e-3)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_two_species_that_make_each_other_run_away_and_are_named(backend):
    """As one species that makes itself: a' = 10 b² and b' = 10 a², both from 0.7. No rate depends
    on its own species, so that the diagonal of J is 0; growth shows in elimination alone."""
    rates = lambda u, s, p, cell: {"a": 10.0 * u.b**2, "b": 10.0 * u.a**2}
    circuit = tf.Circuit(rates, species=("a", "b"), initial={"a": 0.7, "b": 0.7}, backend=backend)
    with pytest.raises(tf.SimulationError, match=r"step [34] .*\n.*: '[ab]' runs away, from"):
        for _ in tf.simulate(tf.Scene(circuit), dt=0.05, until=1.0):
            pass
