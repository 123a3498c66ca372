"""The contact solve against dense and general-purpose solvers, and its report per colony."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from helpers import array, crowd, growth, mechanics, pair_gaps, seeded, step
from scipy.optimize import minimize

import torchfilm as tf
from torchfilm.physics.jacobian import ContactJacobian
from torchfilm.physics.problem import CONVERGED, ITERATION_LIMIT, NOT_FINITE, ContactProblem
from torchfilm.physics.solve import solve_contacts
from torchfilm.tools.ragged import Groups

MODES = pytest.mark.parametrize("unilateral", [False, True], ids=["bilateral", "unilateral"])
WIDE = -1e9  # a bound that is never reached
X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Problem:
    """A random contact problem with J as dense arrays: several colonies, each with pairs and
    walls.
    """

    first: np.ndarray
    second: np.ndarray
    at_wall: np.ndarray
    half_rows: np.ndarray  # (pairs, 2, D)
    wall_rows: np.ndarray  # (walls, D)
    gap: np.ndarray
    alpha: np.ndarray
    lower: np.ndarray
    scale: np.ndarray
    colony: np.ndarray
    colonies: int

    @staticmethod
    def random(seed: int, counts: list[int], degrees: int, lower: float = WIDE) -> Problem:
        rng = np.random.default_rng(seed)
        first, second = [], []
        start = np.cumsum(counts) - counts
        for begin, count in zip(start, counts, strict=True):
            a, b = np.triu_indices(count, 1)
            pick = rng.permutation(len(a))[: 3 * count]
            first.append(begin + a[pick])
            second.append(begin + b[pick])
        first, second = np.concatenate(first).astype(int), np.concatenate(second).astype(int)
        cells = sum(counts)
        at_wall = rng.integers(0, cells, cells // 3)
        gap = -rng.uniform(0.0, 0.3, len(first) + len(at_wall))
        bounds = np.full(cells, WIDE) if lower == WIDE else -rng.uniform(0, -lower, cells)
        return Problem(
            first,
            second,
            at_wall,
            rng.normal(size=(len(first), 2, degrees)),
            rng.normal(size=(len(at_wall), degrees)),
            gap,
            rng.uniform(0.05, 0.2, cells),
            bounds,
            rng.uniform(0.3, 1.5, (cells, degrees)),
            np.repeat(np.arange(len(counts)), counts),
            len(counts),
        )

    @property
    def dense(self) -> np.ndarray:
        """J, (R, N D)."""
        cells, degrees = self.scale.shape
        out = np.zeros((len(self.gap), cells, degrees))
        pairs = np.arange(len(self.first))
        np.add.at(out, (pairs, self.first), self.half_rows[:, 0])
        np.add.at(out, (pairs, self.second), self.half_rows[:, 1])
        np.add.at(out, (len(pairs) + np.arange(len(self.at_wall)), self.at_wall), self.wall_rows)
        return out.reshape(len(self.gap), -1)

    def problem(
        self, unilateral: bool, dtype=torch.float64, device="cpu", applied_force=None, **other
    ) -> ContactProblem:
        t = lambda x: torch.as_tensor(x, dtype=dtype, device=device)
        i = lambda x: torch.as_tensor(x, dtype=torch.int64, device=device)
        rows = ContactJacobian(
            i(self.first),
            i(self.second),
            t(self.half_rows[:, 0]).contiguous(),
            t(self.half_rows[:, 1]).contiguous(),
            i(self.at_wall),
            t(self.wall_rows),
            len(self.scale),
        )
        gap = t(other.get("gap", self.gap))
        applied_force = torch.zeros_like(gap) if applied_force is None else t(applied_force)
        colonies = Groups(i(self.colony), self.colonies)
        rigid = torch.as_tensor(other.get("rigid", np.zeros(len(self.scale), bool)), device=device)
        return ContactProblem(
            rows,
            gap,
            applied_force,
            t(self.weight).reshape(self.scale.shape),
            t(self.lower),
            t(self.scale),
            rigid,
            colonies,
            unilateral,
        )

    def solved(self, unilateral: bool, tolerance: float | torch.Tensor = 1e-12, **options):
        """The solve's y = x / M^(−½), (N, D), and its report."""
        x, report = solve_contacts(self.problem(unilateral, **options), None, tolerance, 5000)
        return array(x) / self.scale, report

    @property
    def weight(self) -> np.ndarray:
        return np.repeat(self.alpha, self.scale.shape[1])


@pytest.mark.parametrize("degrees", [4, 7])
@pytest.mark.parametrize("seed", range(3))
def test_bilateral_solve_against_dense(seed, degrees):
    """(JᵀJ + α) y = Jᵀ g by a dense factorisation.

    At a tolerance of 1e-12 the two agree to 1e-12 times the condition of the system, which is below
    1e3.
    """
    p = Problem.random(seed, [12, 1, 7, 0, 20], degrees)
    y, report = p.solved(False)
    j = p.dense
    expected = np.linalg.solve(j.T @ j + np.diag(p.weight), j.T @ p.gap).reshape(y.shape)
    assert (report.status == CONVERGED).all()
    assert np.abs(y - expected).max() <= 1e-9
    assert np.abs(expected).max() > 0.01


@MODES
def test_a_tolerance_for_each_colony(unilateral):
    """Each colony is solved to its own tolerance, with the bits of a solve at that tolerance for
    all.
    """
    p, wanted = Problem.random(4, [12, 7, 20], 7), [0.2, 1e-10, 1e-3]
    found, report = p.solved(unilateral, torch.tensor(wanted, dtype=torch.float64))
    assert (report.residual <= torch.tensor(wanted, dtype=torch.float64)).all()
    assert int(report.iterations[0]) < int(report.iterations[2]) < int(report.iterations[1])
    for colony, tolerance in enumerate(wanted):
        alike, _ = p.solved(unilateral, tolerance)
        assert np.array_equal(found[p.colony == colony], alike[p.colony == colony])


@pytest.mark.parametrize("seed", range(5))
def test_bilateral_solve_within_bounds(seed):
    """Some lengths are at their bound.

    The problem is convex, so y is the minimum if and only if the slope is 0 where y is free and not
    negative where y is at its bound (Karush, Kuhn and Tucker). This holds to 1e-9, with a tolerance
    of 1e-12 and forces of about 1.
    """
    p = Problem.random(seed, [12, 20], 7, lower=-0.05)
    y, report = p.solved(False)
    j = p.dense
    slope = (p.weight * y.ravel() - j.T @ (p.gap - j @ y.ravel())).reshape(y.shape)
    bound = np.zeros(y.shape, dtype=bool)
    bound[:, -1] = y[:, -1] <= p.lower + 1e-15  # except for the division by M^(−½) here
    assert (report.status == CONVERGED).all()
    assert (y[:, -1] >= p.lower - 1e-15).all()
    assert np.abs(slope[~bound]).max() <= 1e-9
    assert slope[bound].min() >= -1e-9
    assert 3 <= bound.sum() < len(y) and slope[bound].max() > 1e-3


def pushing_energy(p: Problem, applied_force: np.ndarray | None = None):
    """½ ‖min(0, g − Jy)‖² + ½ α ‖y‖² + f · Jy and its gradient, with the applied force f: what a
    unilateral solve minimises, written out."""
    j, spent = p.dense, np.zeros(len(p.gap)) if applied_force is None else applied_force

    def energy(y):
        left = np.minimum(0.0, p.gap - j @ y)
        return 0.5 * left @ left + 0.5 * p.weight @ y**2 + spent @ (j @ y), p.weight * y - j.T @ (
            left - spent
        )

    return energy


@pytest.mark.parametrize("lower", [WIDE, -0.05])
@pytest.mark.parametrize("seed", range(3))
def test_unilateral_solve_against_a_general_minimiser(seed, lower):
    """Against L-BFGS-B on the exact convex function.

    L-BFGS-B stops at a gradient of 1e-10. The curvature is at least α = 0.05, so y is within 2e-9 ·
    √N.
    """
    p = Problem.random(seed, [12, 1, 20], 7, lower=lower)
    # some rows apart at first
    gap = p.gap + 0.15 * (np.random.default_rng(seed).uniform(size=len(p.gap)) < 0.5)
    p = Problem(**{**vars(p), "gap": gap})
    y, report = p.solved(True)
    bounds = [(p.lower[k // 7] if k % 7 == 6 else None, None) for k in range(y.size)]
    options = {"maxiter": 20_000, "maxfun": 40_000, "ftol": 1e-30, "gtol": 1e-10, "maxcor": 50}
    found = minimize(
        pushing_energy(p),
        np.zeros(y.size),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options=options,
    )
    assert (report.status == CONVERGED).all()
    left = p.gap - p.dense @ y.ravel()
    assert 0 < (left < 0).sum() < len(left), "some rows must push and some not"
    assert np.abs(y.ravel() - found.x).max() <= 1e-7
    assert pushing_energy(p)(y.ravel())[0] <= found.fun + 1e-12


@pytest.mark.parametrize("lower", [WIDE, -0.05])
@pytest.mark.parametrize("degrees", [4, 7])
@pytest.mark.parametrize("seed", range(4))
def test_contacts_that_just_touch_do_not_take_turns(seed, degrees, lower, dtype, device):
    """Nearly hard contacts of which many just touch converge within the usual number of iterations.

    The solution of one set of contacts drives the other set into overlap, and the reverse. The
    solve to 0.3 % converges nevertheless. Relative to its value at rest, the minimised function is
    then within 1e-3 of its minimum: a hundred times (0.3 %)², since residuals are the moves of
    single cells, and contacts a thousand times as stiff as drag couple the cells.
    """
    p = Problem.random(seed, [30, 12], degrees, lower=lower)
    touching = np.random.default_rng(seed).uniform(size=len(p.gap)) < 0.6
    p = Problem(**{**vars(p), "gap": np.where(touching, 0.0, p.gap), "alpha": np.full(42, 1e-3)})
    y, report = p.solved(True, tolerance=0.003, dtype=dtype, device=device)
    assert (report.status == CONVERGED).all(), (report.iterations, report.residual)
    exact, best = p.solved(True, tolerance=1e-6)
    assert (best.status == CONVERGED).all()
    at_rest, left, least = (pushing_energy(p)(at.ravel())[0] for at in (0 * y, y, exact))
    assert left - least <= 1e-3 * at_rest
    assert least < 0.01 * at_rest, "contacts must be hard enough to be cleared"


@MODES
def test_force_already_spent_is_not_spent_again(unilateral):
    """Rows whose `applied_force` acted in an earlier pass: the minimum is that of the function with
    their work added.
    """
    p = Problem.random(5, [15], 7)
    applied_force = np.where(np.arange(len(p.gap)) % 3 == 0, 0.5 * p.gap, 0.0)
    y, report = p.solved(unilateral, applied_force=applied_force)
    assert (report.status == CONVERGED).all()
    if unilateral:
        slope = pushing_energy(p, applied_force)(y.ravel())[1]
    else:
        j = p.dense
        slope = p.weight * y.ravel() - j.T @ (p.gap - j @ y.ravel() - applied_force)
    assert np.abs(slope).max() <= 1e-9


@MODES
def test_reported_residual_is_the_true_one(unilateral, dtype, device):
    """Computed here independently: the worst residual of each colony relative to the worst at rest.

    It is preconditioned by the rows that act, over the free degrees of freedom. float32 sums of
    twenty terms have an error of 1e-5 of the start.
    """
    p = Problem.random(6, [15, 10], 7)
    y, report = p.solved(unilateral, tolerance=1e-3, dtype=dtype, device=device)
    j = p.dense
    left = p.gap - j @ y.ravel()
    active = left < 0 if unilateral else np.ones(len(left), dtype=bool)
    start = p.gap < 0 if unilateral else np.ones(len(left), dtype=bool)

    def preconditioned(slope, acting):
        blocks = (j * acting[:, None]).reshape(len(j), len(p.scale), 7)
        return np.stack(
            [
                np.linalg.solve(b.T @ b + a * np.eye(7), s)
                for b, a, s in zip(blocks.transpose(1, 0, 2), p.alpha, slope, strict=True)
            ]
        )

    worst = np.abs(
        preconditioned((p.weight * y.ravel() - j.T @ (left * active)).reshape(y.shape), active)
    ).max(1)
    rest = np.abs(preconditioned((-j.T @ np.minimum(p.gap, 0)).reshape(y.shape), start)).max(1)
    for colony in range(2):
        expected = worst[p.colony == colony].max() / rest[p.colony == colony].max()
        assert float(report.residual[colony]) == pytest.approx(
            expected, rel=1e-3, abs={torch.float32: 1e-5, torch.float64: 1e-12}[dtype]
        )
        assert expected <= 1e-3 * 1.01
    assert (report.status == CONVERGED).all()


@MODES
def test_each_colony_converges_by_itself(unilateral, dtype, device):
    """Colonies of very different stiffness have the same solution and iterations in a batch and
    alone.

    The comparison is bitwise.
    """
    p = Problem.random(7, [10, 25, 4], 7)
    alpha = p.alpha * np.array([1.0, 1e-3, 10.0])[p.colony]
    p = Problem(**{**vars(p), "alpha": alpha})
    y, report = p.solved(unilateral, tolerance=1e-5, dtype=dtype, device=device)
    assert len(set(report.iterations.tolist())) > 1
    for colony in range(3):
        mine, own = p.colony == colony, np.flatnonzero(p.colony == colony)
        pairs, walls = mine[p.first], mine[p.at_wall]
        alone = Problem(
            p.first[pairs] - own[0],
            p.second[pairs] - own[0],
            p.at_wall[walls] - own[0],
            p.half_rows[pairs],
            p.wall_rows[walls],
            p.gap[np.concatenate([pairs, walls])],
            p.alpha[mine],
            p.lower[mine],
            p.scale[mine],
            np.zeros(len(own), dtype=int),
            1,
        )
        found, its = alone.solved(unilateral, tolerance=1e-5, dtype=dtype, device=device)
        assert (found == y[mine]).all()
        assert int(its.iterations[0]) == int(report.iterations[colony])


@MODES
def test_a_solve_cut_short_says_so(unilateral):
    p = Problem.random(8, [30, 2], 7)
    x, report = solve_contacts(p.problem(unilateral), None, 1e-12, 3)
    assert int(report.status[0]) == ITERATION_LIMIT and float(report.residual[0]) > 1e-12
    assert bool(torch.isfinite(x).all())


@MODES
def test_a_start_from_the_answer_costs_nothing(unilateral):
    p = Problem.random(9, [20], 7)
    problem = p.problem(unilateral)
    x, report = solve_contacts(problem, None, 1e-8, 5000)
    again, second = solve_contacts(problem, x, 1e-6, 5000)
    assert int(report.iterations[0]) > 5 and int(second.iterations[0]) == 0
    # x is stored scaled, so the answer returns except for a multiplication and a division
    assert float((again - x).abs().max()) <= 1e-15


@MODES
@pytest.mark.parametrize("alpha", [0.1, 0.01])
def test_two_capsules_side_by_side(unilateral, dtype, device, alpha):
    """Two side-by-side capsules, one solve: residual overlap fraction m/(2 + m), m = α μ L. 1e-4 is
    the solve's tolerance."""
    scene = tf.Scene(mechanics(alpha=alpha, passes=1, unilateral=unilateral))
    start = seeded(scene, tf.Cells([[0, 0, 0], [0, 0.9, 0]], [X, X], 2.0), device, dtype)
    pair = np.array([[0, 1]])
    m = alpha * 3.0
    left = pair_gaps(step(scene, start, 0.01), pair)[0] / pair_gaps(start, pair)[0]
    assert left == pytest.approx(m / (2 + m), abs=1e-4)


@MODES
@pytest.mark.parametrize("dim", [2, 3])
def test_no_cell_ends_shorter_than_before_it_grew(unilateral, dtype, device, dim):
    """Mechanics may prevent all growth, but never shortens a cell: ten steps in a closed, full box.

    The prevented growth is length + e − e, which in float32 is exact to one unit in the last place,
    2.4e-7 at 2 to 4 µm.
    """
    walls = [tf.Box(low=(-0.6, -0.6, -0.6)[:dim], high=(17.0, 5.5, 5.5)[:dim])]
    scene = tf.Scene(
        growth(), mechanics(dim=dim, unilateral=unilateral, walls=walls, tolerance=1e-3)
    )
    state = seeded(
        scene, crowd(np.random.default_rng(2), 36 if dim == 2 else 125, dim), device, dtype
    )
    held = 0
    for _ in range(10):
        before = state.length
        state = step(scene, state, 0.02)
        assert (
            float((before - state.length).max())
            <= {torch.float32: 2.4e-7, torch.float64: 4.5e-16}[dtype]
        )
        held += int((state.length - before < 1e-3 * before).sum())
        assert (
            float((state.length - before - state.elongation).abs().max())
            <= {torch.float32: 5e-7, torch.float64: 1e-15}[dtype]
        )
    assert held > 0


@MODES
@pytest.mark.parametrize(
    "name, bad",
    [("position", "nan"), ("position", "inf"), ("axis", "nan"), ("axis", "inf"), ("length", "nan")],
)
def test_a_broken_colony_is_reported_and_harms_no_other(unilateral, dtype, device, name, bad):
    """A colony with non-finite coordinates has the status NOT_FINITE.

    The other colonies converge and have the same bits as without it.
    """
    rng = np.random.default_rng(3)
    parts = [crowd(rng, n, 3) for n in (12, 9, 15)]
    join = lambda what: np.concatenate([getattr(p, what) for p in parts])
    scene = tf.Scene(growth(), mechanics(unilateral=unilateral))
    cells = tf.Cells(
        join("position"),
        join("axis"),
        join("length"),
        0.5,
        colony=np.repeat([0, 1, 2], [12, 9, 15]),
    )
    start = seeded(scene, cells, device, dtype)
    broken = getattr(start, name).clone()
    broken[15] = float(bad)
    state = step(scene, start.replace(**{name: broken}), 0.01)
    assert state.reports["mechanics"].status.tolist() == [CONVERGED, NOT_FINITE, CONVERGED]
    sound = step(scene, start.select([0, 2]), 0.01)
    assert torch.equal(
        sound.reports["mechanics"].iterations, state.reports["mechanics"].iterations[[0, 2]]
    )
    for what in ("position", "axis", "length", "displacement"):
        assert torch.equal(getattr(sound, what), getattr(state.select([0, 2]), what)), what


def test_the_driver_names_the_broken_colony(dtype, device):
    scene = tf.Scene(growth(), mechanics())
    start = seeded(
        scene, tf.Cells(np.zeros((3, 3)), [X, Y, Z], 2.0, colony=[0, 1, 2]), device, dtype
    )
    broken = start.position.clone()
    broken[1] = torch.nan
    start = start.replace(position=broken)
    with pytest.raises(tf.SimulationError, match="colony 1") as caught:
        list(tf.simulate(scene, start, until=0.01, dt=0.01))
    assert caught.value.colonies == (1,)
    state = list(tf.simulate(scene, start, until=0.02, dt=0.01, on_failure="drop"))[-1]
    assert state.counts.tolist() == [1, 0, 1]
    assert bool(torch.isfinite(state.position).all())


@MODES
def test_gradient_through_the_solve(unilateral):
    """Two overlapping cells and a wall: the gradient of the end positions by the adjoint.

    It is compared with differences of the whole step, in float64, solved to 1e-12; differences with
    h = 1e-5 are accurate to 1e-9.
    """
    scene = tf.Scene(
        mechanics(
            unilateral=unilateral, passes=1, tolerance=1e-12, walls=[tf.Plane(y=-0.45, facing="+y")]
        )
    )
    start = seeded(
        scene,
        tf.Cells([[0, 0, 0], [0.4, 0.8, 0.1]], [X, X + 0.3 * Y + 0.1 * Z], [2.0, 2.2]),
        torch.device("cpu"),
        torch.float64,
    )
    goal = torch.tensor(np.random.default_rng(4).normal(size=(2, 3)))

    def outcome(position, length):
        return (
            step(scene, start.replace(position=position, length=length), 0.01).position * goal
        ).sum()

    place, length = start.position.clone().requires_grad_(), start.length.clone().requires_grad_()
    by_place, by_length = torch.autograd.grad(outcome(place, length), (place, length))
    with torch.no_grad():
        for found, name in ((by_place, "position"), (by_length, "length")):
            for k in range(found.numel()):
                ends = []
                for h in (1e-5, -1e-5):
                    given = {"position": start.position.clone(), "length": start.length.clone()}
                    given[name].view(-1)[k] += h
                    ends.append(float(outcome(**given)))
                assert float(found.view(-1)[k]) == pytest.approx(
                    (ends[0] - ends[1]) / 2e-5, abs=1e-7
                ), (name, k)
