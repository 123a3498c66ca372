"""Contact problems that torch has assembled, solved by compiled kernels: where gradients are wanted
on the CPU."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import torch
from torch import Tensor

from torchfilm.physics.compiled import DEGREES, share_among_threads
from torchfilm.physics.one_sided_solve import Minimum
from torchfilm.physics.problem import ContactProblem
from torchfilm.tools.cg import CGResult
from torchfilm.tools.numba_calls import as_array, in_numpy

# which kernels this process has called: name, columns of rows, type of numbers
_called: set[tuple[str, int, np.dtype]] = set()


class _Arrays:
    """A problem as kernels take it: see `kernels.problems`."""

    def __init__(self, problem: ContactProblem):
        rows, owner = problem.rows, problem.colonies.owner
        self.kind = in_numpy(problem.gap.dtype)
        self.begin, count = problem.colonies.ends, problem.colonies.size
        self.degrees = problem.scale.shape[1]
        self.dof = DEGREES[2 if self.degrees == 4 else 3]
        first, second, at_wall = (x.numpy() for x in (rows.first, rows.second, rows.at_wall))
        one = np.concatenate([first, at_wall])
        colony = owner.numpy()[one]
        # pairs and walls of a colony stand together; of one colony they do already
        self.order = np.argsort(colony, kind="stable") if count > 1 else slice(None)
        self.at = np.searchsorted(colony[self.order], np.arange(count + 1))
        two = np.full(one.size, -1)
        two[: rows.pairs] = second - self.begin[colony[: rows.pairs]]
        halves: np.ndarray = np.zeros((one.size, 2, len(self.dof)), self.kind)
        of_walls = halves[rows.pairs :, 0]
        halves[: rows.pairs, 0, : self.degrees] = rows.row_first.detach().numpy()
        halves[: rows.pairs, 1, : self.degrees] = rows.row_second.detach().numpy()
        of_walls[:, : self.degrees] = rows.row_wall.detach().numpy()
        self.rows = (
            halves[self.order].reshape(-1, len(self.dof)),
            (one - self.begin[colony])[self.order].astype(np.int32),
            two[self.order].astype(np.int32),
        )
        self.alpha = np.ascontiguousarray(problem.alpha[:, 0].detach().numpy())
        self.counts = problem.colonies.counts.numpy()

    def of_cells(self, value: Tensor) -> np.ndarray:
        """(N, D) in as many columns as rows have."""
        wide: np.ndarray = np.zeros((value.shape[0], len(self.dof)), self.kind)
        wide[:, : self.degrees] = value.detach().numpy()
        return wide

    def of_rows(self, value: Tensor) -> np.ndarray:
        """(R,) in the order of the kernels."""
        return np.ascontiguousarray(value.detach().numpy()[self.order])

    def call(self, name: str, *given: object) -> None:
        """Call this kernel for all colonies."""
        from torchfilm.kernels import problems
        from torchfilm.kernels.compiling import first_call

        key = name, len(self.dof), np.dtype(self.kind)
        what = f"{2 if self.degrees == 4 else 3}-D, {np.dtype(self.kind).name}, {name}"
        arguments = self.begin, self.at, self.rows, *given, self.dof
        said = f"contacts ({what}), a few seconds"
        with nullcontext() if key in _called else first_call(what, said):
            kernel = getattr(problems, f"{name}_colonies")
            share_among_threads(kernel, np.arange(self.counts.size), self.counts, arguments)
        _called.add(key)


def minimise(
    problem: ContactProblem, y: Tensor, tolerance: float, cap: Tensor, limit: int
) -> Minimum:
    """As `one_sided_solve.minimise`, of a problem on the CPU without gradients."""
    arrays = _Arrays(problem)
    cells, count = arrays.of_cells(y), arrays.counts.size
    pushed = -problem.applied_force if bool(problem.applied_force.any()) else torch.zeros(0)
    spent = arrays.of_rows(pushed) if pushed.numel() else np.empty(0, arrays.kind)
    gaps = arrays.of_rows(problem.gap)
    after, errors, iterations = np.empty_like(gaps), np.zeros(count), np.zeros(count, np.int64)
    low = as_array(problem.lower, problem.gap.dtype)
    arrays.call(
        "minimise", gaps, spent, arrays.alpha, low, cells, tolerance, cap.numpy(), limit,
        after, errors, iterations, np.zeros(0, np.int64),
    )  # fmt: skip
    end = torch.from_numpy(np.ascontiguousarray(cells[:, : arrays.degrees]))
    left = torch.empty_like(problem.gap)
    left.numpy()[arrays.order] = after
    active = (left < 0).to(left.dtype)
    gradient = problem.gradient(end, left * active)[:, -1]
    free = torch.ones_like(end)
    held = (end[:, -1] <= problem.lower) & (gradient >= 0)
    free[:, -1] = (~held & ~problem.rigid).to(end.dtype)
    return Minimum(end, left, active, free, torch.from_numpy(errors), torch.from_numpy(iterations))


def solve_again(
    problem: ContactProblem, active: Tensor, free: Tensor, b: Tensor, tolerance: Tensor, limit: int
) -> CGResult:
    """As `adjoint.solve_again`, of a problem on the CPU."""
    arrays = _Arrays(problem)
    g = -arrays.of_cells(b)
    x, count = np.empty_like(g), arrays.counts.size
    left, iterations = np.zeros(count), np.zeros(count, np.int64)
    act, held = arrays.of_rows(active != 0).view(np.uint8), (free[:, -1] == 0).numpy()
    arrays.call(
        "solve", act, arrays.alpha, held.view(np.uint8), g, x, tolerance.double().numpy(), limit,
        left, iterations,
    )  # fmt: skip
    found = torch.from_numpy(np.ascontiguousarray(x[:, : arrays.degrees]))
    return CGResult(found, torch.from_numpy(iterations), torch.from_numpy(left))
