"""Systems of transport solved by kernels: against dense matrices, for each colony alone."""

from __future__ import annotations

import pytest
import torch
from test_operator import BOUNDARIES, FLOWS, operator_of

from torchfilm.signals.compiled_systems import Systems, may_solve
from torchfilm.signals.transport_iterative import (
    MAX_ITERATIONS,
    ROUNDING,
    TOLERANCE,
    prepare_backward_euler,
)
from torchfilm.signals.transport_operator import apply
from torchfilm.signals.transport_rates import build_operator

F64 = torch.float64
LIMITS = TOLERANCE, ROUNDING, MAX_ITERATIONS
SHAPE = (6, 5, 2)


def matrix_of(operator, part) -> torch.Tensor:
    """I − part · T of one colony, from columns."""
    size = torch.Size(operator.shape).numel()
    columns = torch.eye(size, dtype=F64).view(size, 1, *operator.shape)
    made = [x - part * apply(operator, x, gain=False) for x in columns]
    return torch.stack([x.flatten() for x in made], 1)


def drawn(*size, seed=2):
    return torch.randn(*size, dtype=F64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("faces", BOUNDARIES)
@pytest.mark.parametrize("kind", FLOWS)
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("transposed", [False, True])
def test_the_solution_is_that_of_the_matrix(faces, kind, masked, transposed):
    op, *_ = operator_of(SHAPE, faces, kind, masked)
    matrix = matrix_of(op, 30.0)
    matrix = matrix.T if transposed else matrix
    b, start = drawn(2, 1, *SHAPE)
    for weight in (None, 1 / (1 + 30.0 * op.loss)):
        found, good = Systems.of(op, 30.0, transposed).solved(b, start, weight, LIMITS)
        expected = torch.linalg.solve(matrix, b.flatten()).view(b.shape)
        assert bool(good.all()) and float(expected.min()) < 0  # of whatever sign
        assert torch.allclose(found, expected, rtol=1e-8, atol=1e-8)


def test_a_voxel_that_loses_a_million_times_as_much_is_solved_for_by_its_weight():
    loss = torch.full((1, *SHAPE), 0.1, dtype=F64)
    loss[0, 2, 2, 1] = 1e9
    op = build_operator(SHAPE, (1.0, 1.0, 1.0), diffusion=1.0, decay=loss, dtype=F64)
    b = drawn(1, *SHAPE)
    b[0, 2, 2, 1] = 1e11  # a share of the gradient that only this voxel gives
    weight = 1 / (1 + 50.0 * op.loss)
    start = torch.zeros_like(b)
    found, good = Systems.of(op, 50.0, False).solved(b, start, weight, LIMITS)
    expected = torch.linalg.solve(matrix_of(op, 50.0), b.flatten()).view(b.shape)
    assert bool(good.all()) and torch.allclose(found, expected, rtol=1e-7, atol=1e-12)
    coarse, _ = Systems.of(op, 50.0, False).solved(b, start, None, LIMITS)
    assert float((coarse - expected).abs().max()) > 1e-4  # without it others are left unsolved


def test_each_colony_is_solved_for_by_its_own_weights():
    """Another voxel of each loses a million times as much."""
    loss, b = torch.full((3, *SHAPE), 0.1, dtype=F64), drawn(3, *SHAPE)
    for k in range(3):
        loss[k, k, 2, 1], b[k, k, 2, 1] = 1e9, 1e11
    made = lambda of, count: build_operator(
        SHAPE, (1.0, 1.0, 1.0), diffusion=1.0, decay=of, colonies=count, dtype=F64
    )
    op = made(loss, 3)
    weight = 1 / (1 + 50.0 * op.loss)
    found, good = Systems.of(op, 50.0, False).solved(b, torch.zeros_like(b), weight, LIMITS)
    for k in range(3):
        matrix = matrix_of(made(loss[k], 1), 50.0)
        expected = torch.linalg.solve(matrix, b[k].flatten()).view(SHAPE)
        assert bool(good[k]) and torch.allclose(found[k], expected, rtol=1e-7, atol=1e-12)


def test_a_colony_has_the_same_bits_in_any_company():
    diffusion = torch.tensor([0.4, 30.0, 3.0], dtype=F64)
    made = lambda d: build_operator(
        SHAPE, (1.0, 1.0, 1.0), diffusion=d, velocity=(1.0, 0.5, 0.0), decay=0.1,
        colonies=d.numel(), dtype=F64,
    )  # fmt: skip
    b, start = drawn(2, 3, *SHAPE)
    b[1, 0, 0, 0] = torch.nan
    many, good = Systems.of(made(diffusion), 9.0, True).solved(b, start, None, LIMITS)
    assert good.tolist() == [True, False, True]
    for k in (0, 2):
        given = made(diffusion[k : k + 1])
        own = slice(k, k + 1)
        one, _ = Systems.of(given, 9.0, True).solved(b[own], start[own], None, LIMITS)
        assert torch.equal(one, many[own])


@pytest.mark.parametrize("kind", FLOWS)
def test_steps_and_their_gradients_are_those_of_torch(kind):
    made = []
    for compiled in (True, False):
        number = torch.tensor(1.3, dtype=F64, requires_grad=True)
        op, *_ = operator_of(SHAPE, "mixed", kind, diffusion=number)
        u = drawn(1, *SHAPE).abs().requires_grad_()
        stepper = prepare_backward_euler(op, 40.0, compiled=compiled)
        assert stepper.by_kernels == compiled == (compiled and may_solve(op))
        end, mean = stepper.step_and_mean(u)
        loss = (end * drawn(1, *SHAPE, seed=5)).sum() + mean.square().sum()
        made.append((end.detach(), *torch.autograd.grad(loss, (u, number))))
    for ours, theirs in zip(*made, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-7, atol=1e-9)
        assert float(ours.abs().max()) > 1e-6
