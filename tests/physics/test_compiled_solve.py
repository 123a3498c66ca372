"""Problems that torch assembles and kernels solve, where gradients are wanted."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from differences import growing, run
from problems import WIDE, Problem

import torchfilm as tf
from torchfilm.physics import adjoint, compiled_solve, one_sided_solve
from torchfilm.physics.one_sided_solve import Minimum

pytest.importorskip("numba")
SOLVES = pytest.mark.parametrize("solve", [adjoint.solve_again, compiled_solve.solve_again])


def minimum(problem, minimise, tolerance: float = 1e-12) -> Minimum:
    cap = torch.full((problem.colonies.size,), torch.inf, dtype=torch.float64)
    return minimise(problem, torch.zeros_like(problem.scale), tolerance, cap, 5000)


@pytest.mark.parametrize("degrees", [4, 7])
@pytest.mark.parametrize("lower", [WIDE, -0.05])
def test_the_minimum_is_that_of_torch(degrees, lower):
    """Solved to 1e-12, y is 1e-9 near where the curvature is at least 0.05; so are the gaps. Rows
    that push and lengths at their bounds are the same."""
    p = Problem.random(3, [12, 0, 1, 20], degrees, lower=lower)
    p.gap[::3] += 0.2
    one, other = (
        minimum(p.problem(), x) for x in (one_sided_solve.minimise, compiled_solve.minimise)
    )
    assert bool((other.error <= 1e-12).all())
    for name in ("y", "after"):
        assert torch.allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-8), name
    assert 0 < float(one.active.sum()) < len(p.gap)
    assert torch.equal(one.active, other.active) and torch.equal(one.free, other.free)
    if lower != WIDE:
        assert float(one.free.sum()) < one.free.numel()


@SOLVES
@pytest.mark.parametrize("degrees", [4, 7])
def test_the_adjoint_solve_against_a_dense_one(degrees, solve):
    """Some rows do not push, some lengths are held; a colony without rows has A = α."""
    p = Problem.random(5, [9, 1, 14], degrees)
    problem = p.problem()
    generator = torch.Generator().manual_seed(2)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    active = (draw(len(p.gap)) < 0.7).double()
    free = torch.ones_like(problem.scale)
    free[:, -1] = (draw(len(p.scale)) < 0.5).double()
    b = (draw(*problem.scale.shape) - 0.5) * free
    tolerance = torch.full((p.colonies,), 1e-12, dtype=torch.float64)
    found = solve(problem, active, free, b, tolerance, 5000)
    assert bool((found.worst <= 1.0).all()) and int(found.iterations.max()) > 3
    j = p.dense * active.numpy()[:, None]
    matrix, kept = j.T @ j + np.diag(p.weight), free.numpy().ravel() > 0
    wanted = np.zeros(kept.size)
    wanted[kept] = np.linalg.solve(matrix[np.ix_(kept, kept)], b.numpy().ravel()[kept])
    assert np.abs(found.x.numpy().ravel() - wanted).max() <= 1e-9


def test_a_colony_has_the_same_bits_in_any_company():
    p = Problem.random(4, [11, 3, 8], 7, lower=-0.05)
    together = minimum(p.problem(), compiled_solve.minimise, 1e-6)
    tolerance = torch.full((3,), 1e-6, dtype=torch.float64)
    again = lambda q, end, t: (
        compiled_solve.solve_again(q, end.active, end.free, end.y * end.free, t, 500).x
    )
    turned = again(p.problem(), together, tolerance)
    for colony in range(3):
        alone = p.alone(colony).problem()
        end, mine = minimum(alone, compiled_solve.minimise, 1e-6), p.colony == colony
        assert torch.equal(end.y, together.y[mine])
        assert torch.equal(again(alone, end, tolerance[:1]), turned[mine])


@SOLVES
def test_an_adjoint_solve_that_is_cut_short_or_no_number_says_so(solve):
    p = Problem.random(5, [9, 14], 4)
    problem, tolerance = p.problem(), torch.full((2,), 1e-12, dtype=torch.float64)
    active, free, b = torch.ones(len(p.gap)), torch.ones_like(problem.scale), problem.scale.clone()
    cut = solve(problem, active.double(), free, b, tolerance, 2)
    assert bool((cut.worst > 1.0).all()) and cut.iterations.tolist() == [2, 2]
    b[0, 0] = torch.nan
    bad = solve(problem, active.double(), free, b, tolerance, 5000)
    assert not bool(bad.worst[0] <= 1.0) and bool(bad.worst[1] <= 1.0)
    b[:9] = 0.0
    b[2, 1] = torch.nan  # alone among zeros
    bad = solve(problem, active.double(), free, b, tolerance, 5000)
    assert not bool(bad.worst[0] <= 1.0) and bool(bad.worst[1] <= 1.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_are_those_of_torch(dim, dtype):
    """Through growth, contacts and divisions, solved to 1e-10 (1e-5 in float32)."""
    found = []
    for backend in ("torch", None):
        rate = torch.tensor(0.8, dtype=dtype, requires_grad=True)
        scene = growing(
            dim, rate, tf.Division(length=2.4), backend=backend,
            tolerance=1e-10 if dtype == torch.float64 else 1e-5,
        )  # fmt: skip
        end = run(scene, scene.bind(dtype=dtype).start())
        (slope,) = torch.autograd.grad(end.position.square().sum() + end.length.sum(), rate)
        found.append((end, slope))
    (one, slope), (other, turned) = found
    near, rel = (1e-8, 1e-6) if dtype == torch.float64 else (1e-4, 1e-2)
    assert torch.allclose(one.position, other.position, rtol=0, atol=near)
    assert float(turned) == pytest.approx(float(slope), rel=rel) and abs(float(slope)) > 0.1


def test_who_solves_is_chosen_at_binding():
    for backend, compiled in ((None, True), ("torch", False)):
        scene = growing(2, 0.8, backend=backend)
        bound = next(
            e for e in scene.bind(dtype=torch.float64).effects if isinstance(e.effect, tf.Mechanics)
        )
        assert bound.settings.compiled == compiled
