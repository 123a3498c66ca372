"""Stochastic reactions against exact results; bounds are 5 standard errors at a fixed seed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import array
from scipy import stats
from scipy.linalg import expm

from torchfilm.circuits.draws import KeyedDraws
from torchfilm.circuits.stochastic import BAD_PROPENSITY, DONE, TOO_MANY_EVENTS, direct, tau_leap

METHODS = {"direct": direct, "tau": tau_leap}
both = pytest.mark.parametrize("method", METHODS)


def columns(*parts):
    return torch.stack(torch.broadcast_tensors(*parts), 1)


def run(
    method,
    start,
    propensities,
    stoichiometry,
    t,
    *,
    cells=4000,
    seed=1,
    dtype=torch.float32,
    device="cpu",
    **options,
):
    rows = torch.arange(cells, device=device)
    draw = KeyedDraws(seed, torch.zeros_like(rows), rows, 0)
    counts = torch.tensor(start, dtype=dtype, device=device).repeat(cells, 1)
    out, report = METHODS[method](
        counts, propensities, torch.tensor(stoichiometry), t, draw, **options
    )
    assert (report.status == DONE).all() and (report.reaction == -1).all()
    assert out.dtype == dtype and (out >= 0).all() and torch.equal(out, out.round())
    return array(out), report


def check_moments(
    sample: np.ndarray, mean: float, variance: float, fourth: float | None = None, bias: float = 0.0
) -> None:
    """Mean and variance within 5 standard errors, √(σ²/n) and √((μ₄ − σ⁴)/n), plus a relative
    `bias`.

    The default μ₄ is that of a normal law.
    """
    n = len(sample)
    assert abs(sample.mean() - mean) <= 5 * np.sqrt(variance / n) + bias * mean
    spread = np.sqrt(((3 * variance**2 if fourth is None else fourth) - variance**2) / n)
    assert abs(sample.var() - variance) <= 5 * spread + bias * variance


BIRTH_DEATH = [[1.0], [-1.0]]


def birth_death(rate):
    return lambda n, rows: columns(torch.full_like(n[:, 0], rate), n[:, 0])


@pytest.mark.parametrize(
    "method, mean", [("direct", 3.0), ("direct", 20.0), ("tau", 3.0), ("tau", 400.0), ("tau", 1e4)]
)
def test_birth_and_death(device, method, mean):
    """∅ → a at λ, a → ∅ at 1/h from 0: Poisson of mean λ (1 − e⁻ᵗ) at any time.

    Tau-leaping adds a bias of at most ε/2 to the variance.
    """
    t = 2.0
    sample, report = run(method, [0.0], birth_death(mean), BIRTH_DEATH, t, device=device)
    expected = mean * (1 - np.exp(-t))
    check_moments(
        sample[:, 0],
        expected,
        expected,
        3 * expected**2 + expected,
        0.0 if method == "direct" else 0.015,
    )
    if mean >= 400:
        # it leaps: event by event it would take 2 λt of them, less those that are still there
        # a leap at rest holds 2 ε λ events, or 24 and 600; from 0 on it holds few
        share = 0.6 if mean == 400 else 0.04
        assert float(report.steps.double().mean()) < share * (2 * mean * t - expected)


def dimers(n, rows):
    """∅ → a at 8, 2 a → ∅ at 0.05 n (n − 1), a → ∅ at 0.1 n."""
    x = n[:, 0]
    return columns(torch.full_like(x, 8.0), 0.05 * x * (x - 1), 0.1 * x)


DIMERS = [[1.0], [-2.0], [-1.0]]


def master_equation(size, rates, changes, start, t):
    """Probabilities of 0 … size − 1 molecules of one species at t, from the generator itself."""
    q = np.zeros((size, size))
    for n in range(size):
        for a, k in zip(rates(n), changes, strict=True):
            if 0 <= n + k < size:
                q[n, n] -= a
                q[n + k, n] += a
    p = np.zeros(size)
    p[start] = 1.0
    return expm(q * t) @ p


@both
def test_dimerisation(device, method):
    """Against the master equation of 0 … 120 molecules: moments, and the whole distribution by χ².

    p > 1e-3 at the fixed seed.
    """
    p = master_equation(120, lambda n: (8.0, 0.05 * n * (n - 1), 0.1 * n), (1, -2, -1), 30, 1.5)
    n = np.arange(120)
    mean = (p * n).sum()
    variance, fourth = (p * (n - mean) ** 2).sum(), (p * (n - mean) ** 4).sum()
    sample, _ = run(method, [30.0], dimers, DIMERS, 1.5, device=device)
    # a leap would change x by 2 molecules at most here, which is ε x/g and more: single events
    # almost always, so no bias to speak of
    check_moments(sample[:, 0], mean, variance, fourth)


def gene(n, rows):
    """A gene that switches on at 1 and off at 3 makes protein at 40 when on; protein decays at 1
    (all 1/h).
    """
    off, on, protein = n.unbind(1)
    return columns(1.0 * off, 3.0 * on, 40.0 * on, protein)


GENE = [[-1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]


@both
def test_two_state_gene(device, method):
    """Stationary mean m = 40 · ¼ and variance m + m² (k_off/k_on) γ/(γ + k_on + k_off) = 10 + 100 ·
    3/5 = 70.

    The gene is on a quarter of the time. After 8 lifetimes e⁻⁸ = 3e-4 of the start remains. μ₄ is
    less than 4 σ⁴ for this (beta-mixed) law.
    """
    sample, _ = run(method, [1.0, 0.0, 0.0], gene, GENE, 8.0, device=device)
    assert (sample[:, 0] + sample[:, 1] == 1).all()
    check_moments(sample[:, 1], 0.25, 0.1875, 0.25 * 0.75 * (0.75**3 + 0.25**3))
    check_moments(sample[:, 2], 10.0, 70.0, 4 * 70.0**2, 0.0 if method == "direct" else 0.01)


def test_tau_leap_is_direct_in_law():
    """a + b ⇌ c, 3,000 each, half way: leaps and single events have the same means and variances.

    They agree within 5 standard errors of their difference, and ε/2.
    """

    def propensities(n, rows):
        a, b, c = n.unbind(1)
        return columns(0.0004 * a * b, 0.5 * c)

    change, start = [[-1.0, -1.0, 1.0], [1.0, 1.0, -1.0]], [3000.0, 3000.0, 0.0]
    slow, slow_report = run("direct", start, propensities, change, 0.5, cells=2000)
    fast, fast_report = run(
        "tau",
        start,
        propensities,
        change,
        0.5,
        cells=2000,
        seed=2,
        orders=torch.tensor([2.0, 2.0, 1.0]),
    )
    # the first molecules of c need single events, since a leap may change c by 3 %
    assert float(fast_report.steps.double().mean()) < 0.4 * float(slow_report.steps.double().mean())
    assert np.abs(fast[:, 0] + fast[:, 2] - 3000).max() == 0
    variance = slow[:, 2].var()
    assert (
        abs(slow[:, 2].mean() - fast[:, 2].mean())
        <= 5 * np.sqrt(2 * variance / 2000) + 0.015 * slow[:, 2].mean()
    )
    assert abs(fast[:, 2].var() / variance - 1) <= 5 * np.sqrt(4 / 2000) + 0.03


@pytest.mark.parametrize("molecules", [300.0, 2000.0])
def test_leaps_do_not_spread_molecules_at_rest(molecules):
    """Birth and death have the Poisson law at rest, a ⇌ b half its variance.

    Gain and loss cancel in the mean. A leap that only the noise limits is ε² x/2 lifetimes long,
    and spreads x by 1/(1 − ε² x/4): 1.07 for 300 and 1.82 for 2,000 molecules. A loss of at most ε
    of the molecules in a leap leaves 1/(1 − ε/2), for a ⇌ b 1/(1 − ε), which both a and b lose.
    After 3 lifetimes e⁻⁶ = 0.25 % of the variance is missing.
    """
    one = torch.tensor([1.0])
    sample, report = run(
        "tau", [molecules],
        lambda n, rows: columns(molecules + 0.0 * n[:, 0], n[:, 0]), BIRTH_DEATH, 3.0, orders=one,
    )  # fmt: skip
    check_moments(sample[:, 0], molecules, molecules, bias=0.02)
    assert float(report.steps.double().mean()) < 0.5 * 6.0 * molecules
    half = molecules / 2
    sample, _ = run(
        "tau", [half, half],
        lambda n, rows: columns(n[:, 0], n[:, 1]), [[-1.0, 1.0], [1.0, -1.0]], 1.5,
        orders=torch.ones(2),
    )  # fmt: skip
    check_moments(sample[:, 0], half, half / 2, bias=0.035)


@both
def test_no_number_goes_negative(device, method):
    """Few molecules, fast two-body loss and stoichiometries of 3, which is hard for leaps.

    The conserved sum a + 3 c is exact.
    """

    def propensities(n, rows):
        a, _ = n.unbind(1)
        return columns(2.0 * a * (a - 1).clamp(min=0) * (a - 2).clamp(min=0) / 6, 50.0 * n[:, 1])

    sample, _ = run(
        method,
        [400.0, 0.0],
        propensities,
        [[-3.0, 1.0], [3.0, -1.0]],
        0.05,
        cells=500,
        device=device,
    )
    assert (sample[:, 0] + 3 * sample[:, 1] == 400).all()


def test_what_runs_out_fires_alone():
    """a → ∅ at a constant 12/h, from 9 and from 12 molecules: a leap does not see the end.

    From 9 the reaction is critical, so it is exact: (9 − Poisson(12))⁺ remains after an hour. From
    12 leaps may go too far; they are repeated at half the length.
    """
    steady = lambda n, rows: torch.full_like(n, 12.0)
    left, _ = run("tau", [9.0], steady, [[-1.0]], 1.0, orders=torch.tensor([0.0]))
    n = np.arange(60)
    rest, p = np.maximum(9 - n, 0), stats.poisson.pmf(n, 12)
    mean = (rest * p).sum()
    check_moments(left[:, 0], mean, (p * (rest - mean) ** 2).sum(), (p * (rest - mean) ** 4).sum())
    _, report = run(
        "tau",
        [12.0],
        lambda n, rows: torch.full_like(n, 30.0),
        [[-1.0]],
        1.0,
        orders=torch.tensor([0.0]),
    )
    assert int(report.steps.max()) <= 20


@both
def test_what_is_less_than_a_molecule_stays(device, method):
    """Fractional parts in the input (0.75 of a molecule of a signal outside) are kept and never
    react.
    """
    rows = torch.arange(300, device=device)
    draw = KeyedDraws(1, torch.zeros_like(rows), rows, 0)
    start = torch.tensor([[0.0, 4.75]], device=device).repeat(300, 1)
    out, report = METHODS[method](
        start, lambda n, rows: columns(100 * n[:, 1]), torch.tensor([[1.0, -1.0]]), 10.0, draw
    )
    assert (report.status == DONE).all()
    assert out[:, 1].tolist() == [0.75] * 300 and out[:, 0].tolist() == [4.0] * 300


@both
def test_failures_stay_with_their_cell(device, dtype, method):
    def propensities(n, rows):
        x = n[:, 0]
        bad = torch.where(
            rows == 2,
            torch.full_like(x, -1.0),
            torch.where(rows == 3, torch.full_like(x, torch.nan), x),
        )
        return columns(
            torch.where(rows == 4, torch.full_like(x, 1e9), torch.full_like(x, 5.0)), bad
        )

    rows = torch.arange(6, device=device)
    draw = KeyedDraws(1, torch.zeros_like(rows), rows, 0)
    start = torch.full((6, 1), 10.0, dtype=dtype, device=device)
    out, report = METHODS[method](
        start, propensities, torch.tensor([[1.0], [-1.0]]), 1.0, draw, max_steps=100
    )
    leaps = method == "tau"
    assert report.status.tolist() == [
        DONE,
        DONE,
        BAD_PROPENSITY,
        BAD_PROPENSITY,
        report.status.tolist()[4],
        DONE,
    ]
    assert leaps or int(report.status[4]) == TOO_MANY_EVENTS
    assert report.reaction.tolist() == [-1, -1, 1, 1, -1, -1]
    assert out[2:4, 0].tolist() == [10.0, 10.0]
    assert torch.isfinite(out).all()


@both
@pytest.mark.parametrize("name", ["gene", "birth"])
def test_a_row_is_its_own(method, name):
    """Bitwise the same alone, in any batch, at any position, with its own rates and random
    stream.
    """
    rate = torch.linspace(1, 3000, 60, dtype=torch.float64)
    cell = torch.arange(60)

    def result(k):
        if name == "gene":
            propensities, change, start = (
                (lambda n, rows: gene(n, rows) * (1 + cell[k][rows] / 60).unsqueeze(1)),
                GENE,
                [[1.0, 0.0, 5.0]],
            )
        else:
            propensities, change, start = (
                (lambda n, rows: columns(rate[k][rows], n[:, 0])),
                BIRTH_DEATH,
                [[50.0]],
            )
        draw = KeyedDraws(9, torch.zeros_like(k), cell[k], 3)
        return METHODS[method](
            torch.tensor(start, dtype=torch.float64).repeat(len(k), 1),
            propensities,
            torch.tensor(change),
            0.2,
            draw,
        )

    whole, report = result(cell)
    for k in (
        torch.tensor([0]),
        torch.tensor([59]),
        cell.flip(0),
        torch.tensor([40, 3, 17, 58, 22, 9, 31]),
    ):
        part, own = result(k)
        assert torch.equal(part, whole[k]) and torch.equal(own.steps, report.steps[k])


@both
def test_nothing_to_do(device, dtype, method):
    rows = torch.arange(3, device=device)
    draw = KeyedDraws(1, torch.zeros_like(rows), rows, 0)
    start = torch.tensor([[0.0], [5.0], [7.0]], dtype=dtype, device=device)
    nothing = lambda n, rows: torch.zeros_like(n)
    out, report = METHODS[method](start, nothing, torch.tensor([[-1.0]]), 1.0, draw)
    assert torch.equal(out, start) and (report.status == DONE).all()
    out, _ = METHODS[method](
        start[:0], nothing, torch.tensor([[-1.0]]), 1.0, KeyedDraws(1, rows[:0], rows[:0], 0)
    )
    assert out.shape == (0, 1)
    # the input is unchanged
    moved, _ = METHODS[method](start, lambda n, rows: n, torch.tensor([[-1.0]]), 5.0, draw)
    assert not torch.equal(moved, start) and start.tolist() == [[0.0], [5.0], [7.0]]
