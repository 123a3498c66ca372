"""The contact solves against dense and general-purpose solvers, and their report per colony."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import array
from problems import WIDE, Problem, least_energy, pushing_energy

from torchfilm.kernels.scheme import TOLERANCE
from torchfilm.physics.problem import CONVERGED, ITERATION_LIMIT, NOT_FINITE
from torchfilm.physics.solve import solve_contacts

PATHS = pytest.mark.parametrize("path", ["torch", "compiled"])


def pushed(p: Problem, path: str, tolerance: float = 1e-12, limit: int = 5000, **options):
    """The minimum of one-sided contacts: y (N, D), its errors and iterations, (B,)."""
    if path == "compiled":
        return p.pushed_by_kernels(tolerance, limit, **options)
    found = p.pushed(tolerance, limit, **options)
    return array(found.y), array(found.error), array(found.iterations)


def solved(p: Problem, path: str, **options):
    """The solution of bilateral contacts: y (N, D), and the report of the solve."""
    return p.solved_by_kernels(**options) if path == "compiled" else p.solved(**options)


@PATHS
@pytest.mark.parametrize("degrees", [4, 7])
@pytest.mark.parametrize("seed", range(3))
def test_bilateral_solve_against_dense(seed, degrees, path):
    """(JᵀJ + α) y = Jᵀ g by a dense factorisation.

    At a tolerance of 1e-12 the two agree to 1e-12 times the condition of the system, which is below
    1e3.
    """
    p = Problem.random(seed, [12, 1, 7, 0, 20], degrees)
    y, report = solved(p, path)
    j = p.dense
    expected = np.linalg.solve(j.T @ j + np.diag(p.weight), j.T @ p.gap).reshape(y.shape)
    assert (report.status == CONVERGED).all()
    assert np.abs(y - expected).max() <= 1e-9
    assert np.abs(expected).max() > 0.01


def test_a_tolerance_for_each_colony():
    """Each colony is solved to its own tolerance, with the bits of a solve at that tolerance for
    all.
    """
    p, wanted = Problem.random(4, [12, 7, 20], 7), [0.2, 1e-10, 1e-3]
    found, report = p.solved(torch.tensor(wanted, dtype=torch.float64))
    assert (report.residual <= torch.tensor(wanted, dtype=torch.float64)).all()
    assert int(report.iterations[0]) < int(report.iterations[2]) < int(report.iterations[1])
    for colony, tolerance in enumerate(wanted):
        alike, _ = p.solved(tolerance)
        assert np.array_equal(found[p.colony == colony], alike[p.colony == colony])


@PATHS
@pytest.mark.parametrize("seed", range(5))
def test_bilateral_solve_within_bounds(seed, path):
    """Some lengths are at their bound.

    The problem is convex, so y is the minimum if and only if the slope is 0 where y is free and not
    negative where y is at its bound (Karush, Kuhn and Tucker). This holds to 1e-9, with a tolerance
    of 1e-12 and forces of about 1.
    """
    p = Problem.random(seed, [12, 20], 7, lower=-0.05)
    y, report = solved(p, path)
    j = p.dense
    slope = (p.weight * y.ravel() - j.T @ (p.gap - j @ y.ravel())).reshape(y.shape)
    bound = np.zeros(y.shape, dtype=bool)
    bound[:, -1] = y[:, -1] <= p.lower + 1e-15  # except for the division by M^(−½) here
    assert (report.status == CONVERGED).all()
    assert (y[:, -1] >= p.lower - 1e-15).all()
    assert np.abs(slope[~bound]).max() <= 1e-9
    assert slope[bound].min() >= -1e-9
    assert 3 <= bound.sum() < len(y) and slope[bound].max() > 1e-3


@PATHS
@pytest.mark.parametrize("lower", [WIDE, -0.05])
@pytest.mark.parametrize("seed", range(3))
def test_one_sided_solve_against_a_general_minimiser(seed, lower, path):
    """Against L-BFGS-B on the exact convex function.

    L-BFGS-B stops at a gradient of 1e-10. The curvature is at least α = 0.05, so y is within 2e-9 ·
    √N.
    """
    p = Problem.random(seed, [12, 1, 20], 7, lower=lower)
    # some rows apart at first
    gap = p.gap + 0.15 * (np.random.default_rng(seed).uniform(size=len(p.gap)) < 0.5)
    p = Problem(**{**vars(p), "gap": gap})
    y, error, _ = pushed(p, path)
    found, least = least_energy(p)
    assert (error <= 1e-12).all()
    left = p.gap - p.dense @ y.ravel()
    assert 0 < (left < 0).sum() < len(left), "some rows must push and some not"
    assert (y[:, -1] >= p.lower).all()
    assert np.abs(y.ravel() - found).max() <= 1e-7
    assert pushing_energy(p)(y.ravel())[0] <= least + 1e-12


@PATHS
def test_where_nothing_overlaps_nothing_moves(path):
    """One of two colonies has rows, but no overlap; the other is solved as it is alone."""
    p = Problem.random(1, [12, 20], 7)
    own = p.colony[np.concatenate([p.first, p.at_wall])]
    p = Problem(**{**vars(p), "gap": np.where(own == 0, -p.gap, p.gap)})
    y, error, iterations = pushed(p, path)
    alone, _, _ = pushed(p.alone(1), path)
    assert (y[p.colony == 0] == 0).all() and error[0] == 0 and iterations[0] == 0
    assert (y[p.colony == 1] == alone).all() and (alone != 0).any()


@PATHS
@pytest.mark.parametrize("lower", [WIDE, -0.05])
@pytest.mark.parametrize("degrees", [4, 7])
@pytest.mark.parametrize("seed", range(2))
def test_contacts_that_just_touch_are_cleared(seed, degrees, lower, path):
    """Nearly hard contacts of which many just touch: the solution of one set of contacts drives the
    other set into overlap, and the reverse.

    Relative to its value at rest, the minimised function ends within 1e-3 of its minimum. The error
    that the solve reports is relative to the overlap that is left, which is hardly any here, so it
    may stay above the tolerance.
    """
    p = Problem.random(seed, [30, 12], degrees, lower=lower)
    touching = np.random.default_rng(seed).uniform(size=len(p.gap)) < 0.6
    p = Problem(**{**vars(p), "gap": np.where(touching, 0.0, p.gap), "alpha": np.full(42, 1e-3)})
    y, _, iterations = pushed(p, path, TOLERANCE)
    energy, (_, least) = pushing_energy(p), least_energy(p)
    at_rest, left = energy(0 * y.ravel())[0], energy(y.ravel())[0]
    assert (iterations < 5000).all()
    assert left - least <= 1e-3 * at_rest
    assert least < 0.01 * at_rest, "contacts must be hard enough to be cleared"


@PATHS
@pytest.mark.parametrize("contacts", ["bilateral", "one-sided"])
def test_force_already_spent_is_not_spent_again(path, contacts):
    """Rows whose `applied_force` acted in an earlier pass: the minimum is that of the function with
    their work added.
    """
    p = Problem.random(5, [15], 7)
    spent = np.where(np.arange(len(p.gap)) % 3 == 0, 0.5 * p.gap, 0.0)
    if contacts == "bilateral":
        y, report = solved(p, path, applied_force=spent)
        assert (report.status == CONVERGED).all()
        j = p.dense
        slope = p.weight * y.ravel() - j.T @ (p.gap - j @ y.ravel() - spent)
    else:
        y, error, _ = pushed(p, path, applied_force=spent)
        assert (error <= 1e-12).all()
        slope = pushing_energy(p, spent)(y.ravel())[1]
    assert np.abs(slope).max() <= 1e-9


def preconditioned(p: Problem, slope: np.ndarray, active: np.ndarray) -> np.ndarray:
    """A slope (N, D) by the inverse of each cell's own block of JᵀAJ + α."""
    blocks = (p.dense * active[:, None]).reshape(len(p.gap), len(p.scale), -1)
    return np.stack(
        [
            np.linalg.solve(b.T @ b + a * np.eye(b.shape[1]), s)
            for b, a, s in zip(blocks.transpose(1, 0, 2), p.alpha, slope, strict=True)
        ]
    )


def test_reported_residual_is_the_true_one(dtype, device):
    """float32 sums of twenty terms have an error of 1e-5 of the start."""
    p = Problem.random(6, [15, 10], 7)
    y, report = p.solved(tolerance=1e-3, dtype=dtype, device=device)
    check_residual(p, y, report, {torch.float32: 1e-5, torch.float64: 1e-12}[dtype])


@pytest.mark.parametrize("dtype, near", [(np.float32, 1e-5), (np.float64, 1e-12)])
def test_kernels_report_the_true_residual(dtype, near):
    p = Problem.random(6, [15, 10], 7)
    check_residual(p, *p.solved_by_kernels(tolerance=1e-3, dtype=dtype), near)


def check_residual(p: Problem, y: np.ndarray, report, near: float) -> None:
    """Computed here independently: the worst preconditioned residual of each colony relative to the
    worst at rest."""
    j, every = p.dense, np.ones(len(p.gap), dtype=bool)
    slope = (p.weight * y.ravel() - j.T @ (p.gap - j @ y.ravel())).reshape(y.shape)
    worst = np.abs(preconditioned(p, slope, every)).max(1)
    rest = np.abs(preconditioned(p, (-j.T @ p.gap).reshape(y.shape), every)).max(1)
    for colony in range(2):
        expected = worst[p.colony == colony].max() / rest[p.colony == colony].max()
        assert float(report.residual[colony]) == pytest.approx(expected, rel=1e-3, abs=near)
        assert expected <= 1e-3 * 1.01
    assert (report.status == CONVERGED).all()


def test_what_is_no_number_is_reported_by_kernels_of_its_colony():
    """Bilateral contacts; a colony with a gap that is no number, and a sound one."""
    p = Problem.random(6, [15, 10], 7)
    p.gap[0] = np.nan
    y, report = p.solved_by_kernels()
    assert report.status.tolist() == [NOT_FINITE, CONVERGED]
    assert bool(report.residual[0].isnan()) and np.isfinite(y[p.colony == 1]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("others", [False, True])
def test_a_row_that_is_no_number_fails_its_colony_by_kernels(others, bad):
    """One-sided contacts: the row overlaps, alone or among others; the other colony is sound."""
    p = Problem.random(6, [15, 10], 7)
    if not others:
        p.gap[p.colony[np.concatenate([p.first, p.at_wall])] == 0] = 1.0
    p.gap[0], p.half_rows[0, 0, 1] = -0.1, bad
    y, error, _ = p.pushed_by_kernels()
    assert error[0] == np.inf and error[1] <= 1e-12
    assert np.isfinite(y[p.colony == 1]).all()


@PATHS
def test_reported_error_is_never_below_the_true_residual(path):
    """The residual of one-sided contacts, computed here independently and relative to the overlap,
    as root mean squares. The reported error also counts what the last round still changed."""
    p = Problem.random(6, [15, 10], 7)
    y, error, _ = pushed(p, path, 1e-3)
    left = np.minimum(p.gap - p.dense @ y.ravel(), 0.0)
    slope = (p.weight * y.ravel() - p.dense.T @ left).reshape(y.shape)
    squares = (slope * preconditioned(p, slope, left < 0)).sum(1)
    of_rows = p.colony[np.concatenate([p.first, p.at_wall])]
    for colony in range(2):
        overlap = (left[of_rows == colony] ** 2).sum()
        residual = np.sqrt(squares[p.colony == colony].sum() / overlap)
        assert 1e-12 < residual <= error[colony] * (1 + 1e-6) and error[colony] <= 1e-3


@pytest.mark.parametrize("contacts", ["bilateral", "one-sided"])
def test_each_colony_converges_by_itself(contacts, dtype, device):
    """Colonies of very different stiffness have the same solution and iterations in a batch and
    alone.

    The comparison is bitwise.
    """
    p = Problem.random(7, [10, 25, 4], 7)
    alpha = p.alpha * np.array([1.0, 1e-3, 10.0])[p.colony]
    p = Problem(**{**vars(p), "alpha": alpha})

    def found(problem: Problem):
        options = {"tolerance": 1e-5, "dtype": dtype, "device": device}
        if contacts == "one-sided":
            y, _, iterations = pushed(problem, "torch", **options)
            return y, iterations.tolist()
        y, report = problem.solved(**options)
        return y, report.iterations.tolist()

    y, iterations = found(p)
    assert len(set(iterations)) > 1
    for colony in range(3):
        alone, its = found(p.alone(colony))
        assert (alone == y[p.colony == colony]).all()
        assert its == [iterations[colony]]


def test_a_solve_cut_short_says_so():
    p = Problem.random(8, [30, 2], 7)
    x, report = solve_contacts(p.problem(), None, 1e-12, 3)
    assert int(report.status[0]) == ITERATION_LIMIT and float(report.residual[0]) > 1e-12
    assert bool(torch.isfinite(x).all())


@PATHS
@pytest.mark.parametrize("scale", [1e-15, 1e-18, 1e-20, 1e-22, 1e-30, 1e-42])
def test_forces_too_small_for_float32_end_a_solve(scale, path):
    """Their squares, and with them curvatures, round to 0."""
    p = Problem.random(3, [12, 2], 4)
    p = replace(p, gap=scale * p.gap)
    kind = np.float32 if path == "compiled" else torch.float32
    y, error, iterations = pushed(p, path, 1e-4, 500, dtype=kind)
    assert np.isfinite(y).all() and np.isfinite(error).all() and np.abs(y).max() <= 10 * scale
    assert (iterations <= 500).all()


@PATHS
def test_a_one_sided_solve_cut_short_says_so(path):
    y, error, iterations = pushed(Problem.random(8, [30, 2], 7), path, limit=3)
    assert error[0] > 1e-12 and iterations[0] == 3
    assert np.isfinite(y).all()


def test_a_start_from_the_answer_costs_nothing():
    p = Problem.random(9, [20], 7)
    problem = p.problem()
    x, report = solve_contacts(problem, None, 1e-8, 5000)
    again, second = solve_contacts(problem, x, 1e-6, 5000)
    assert int(report.iterations[0]) > 5 and int(second.iterations[0]) == 0
    # x is stored scaled, so the answer returns except for a multiplication and a division
    assert float((again - x).abs().max()) <= 1e-15
