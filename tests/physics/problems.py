"""Shared by the tests of the contact solves: random contact problems with J as dense arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from helpers import array
from scipy.optimize import minimize

from torchfilm.kernels import bilateral_solve
from torchfilm.kernels.compiling import for_python
from torchfilm.kernels.memory import no_memory
from torchfilm.physics import compiled_solve, one_sided_solve
from torchfilm.physics.jacobian import ContactJacobian
from torchfilm.physics.one_sided_solve import Minimum
from torchfilm.physics.problem import ContactProblem, SolveReport
from torchfilm.physics.solve import solve_contacts
from torchfilm.tools.ragged import Groups

WIDE = -1e9  # a bound that is never reached


@dataclass(frozen=True)
class Problem:
    """A random contact problem: several colonies, each with pairs and walls."""

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

    def alone(self, colony: int) -> Problem:
        """The problem of one of its colonies."""
        mine, before = self.colony == colony, int((self.colony < colony).sum())
        pairs, walls = mine[self.first], mine[self.at_wall]
        return Problem(
            self.first[pairs] - before,
            self.second[pairs] - before,
            self.at_wall[walls] - before,
            self.half_rows[pairs],
            self.wall_rows[walls],
            self.gap[np.concatenate([pairs, walls])],
            self.alpha[mine],
            self.lower[mine],
            self.scale[mine],
            np.zeros(mine.sum(), dtype=int),
            1,
        )

    def problem(self, dtype=torch.float64, device="cpu", applied_force=None) -> ContactProblem:
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
        gap = t(self.gap)
        applied_force = torch.zeros_like(gap) if applied_force is None else t(applied_force)
        colonies = Groups(i(self.colony), self.colonies)
        return ContactProblem(
            rows,
            gap,
            applied_force,
            t(self.weight).reshape(self.scale.shape),
            t(self.lower),
            t(self.scale),
            torch.zeros(len(self.scale), dtype=torch.bool, device=device),
            colonies,
        )

    def solved(self, tolerance: float | torch.Tensor = 1e-12, limit: int = 5000, **options):
        """The y = x / M^(−½), (N, D), of bilateral contacts, and the report of the solve."""
        x, report = solve_contacts(self.problem(**options), None, tolerance, limit)
        return array(x) / self.scale, report

    def pushed(self, tolerance: float = 1e-12, limit: int = 5000, **options) -> Minimum:
        """The minimum of one-sided contacts, in torch, solved to an error of their forces."""
        problem = self.problem(**options)
        cap = torch.full(
            (self.colonies,), torch.inf, dtype=torch.float64, device=problem.gap.device
        )
        return one_sided_solve.minimise(
            problem, torch.zeros_like(problem.scale), tolerance, cap, limit
        )

    def pushed_by_kernels(
        self, tolerance: float = 1e-12, limit: int = 5000, dtype=np.float64, **options
    ):
        """As `pushed` by compiled kernels: y (N, D), errors and iterations, (B,)."""
        in_torch = torch.float64 if dtype == np.float64 else torch.float32
        problem = self.problem(in_torch, **options)
        cap = torch.full((self.colonies,), torch.inf, dtype=torch.float64)
        found = compiled_solve.minimise(
            problem, torch.zeros_like(problem.scale), tolerance, cap, limit
        )
        return array(found.y), array(found.error), array(found.iterations)

    def solved_by_kernels(
        self, tolerance: float = 1e-12, limit: int = 5000, dtype=np.float64, applied_force=None
    ):
        """As `solved` by compiled kernels: y (N, D), and the report of the solve."""
        y, found = np.zeros(self.scale.shape), []
        for mine, rows, (alpha, low), cells, dof in self.of_kernels(dtype, applied_force):
            rigid = np.zeros(len(cells), dtype=bool)
            found.append(
                for_python(bilateral_solve.minimise)(
                    no_memory(), *rows, alpha, low, rigid, cells, tolerance, limit, dof
                )
            )
            y[mine] = cells[:, : y.shape[1]]
        iterations, residual, status = (torch.tensor(np.array(x)) for x in zip(*found, strict=True))
        return y, SolveReport(status, iterations, residual)

    def of_kernels(self, dtype, applied_force=None):
        """For each colony its cells, (N,) bool, and what kernels take: the rows, α and least scaled
        Δl, y = 0 and its width."""
        for colony in range(self.colonies):
            mine, its = self.colony == colony, self.alone(colony)
            rows = np.concatenate([mine[self.first], mine[self.at_wall]])
            degrees, lanes = its.scale.shape[1], 4 if its.scale.shape[1] == 4 else 8
            pairs, cells = len(its.first), np.zeros((len(its.scale), lanes), dtype)
            halves = np.zeros((2 * len(its.gap), lanes), dtype)
            ours = halves[:, :degrees]
            ours[: 2 * pairs : 2], ours[1 : 2 * pairs : 2] = its.half_rows.swapaxes(0, 1)
            ours[2 * pairs :: 2] = its.wall_rows
            spent = np.zeros(len(rows)) if applied_force is None else -applied_force
            of_rows = (
                halves,
                np.concatenate([its.first, its.at_wall]).astype(np.int32),
                np.concatenate([its.second, np.full(len(its.at_wall), -1)]).astype(np.int32),
                len(its.gap),
                its.gap.astype(dtype),
                spent[rows].astype(dtype),
            )
            of_cells = its.alpha.astype(dtype), its.lower.astype(dtype)
            yield mine, of_rows, of_cells, cells, (0,) * lanes

    @property
    def weight(self) -> np.ndarray:
        return np.repeat(self.alpha, self.scale.shape[1])


def pushing_energy(p: Problem, applied_force: np.ndarray | None = None):
    """½ ‖min(0, g − Jy)‖² + ½ α ‖y‖² + f · Jy and its gradient, with the applied force f: what a
    one-sided solve minimises, written out."""
    j, spent = p.dense, np.zeros(len(p.gap)) if applied_force is None else applied_force

    def energy(y):
        left = np.minimum(0.0, p.gap - j @ y)
        return 0.5 * left @ left + 0.5 * p.weight @ y**2 + spent @ (j @ y), p.weight * y - j.T @ (
            left - spent
        )

    return energy


def least_energy(p: Problem) -> tuple[np.ndarray, float]:
    """Where `pushing_energy` is least within the bounds of the lengths, by L-BFGS-B, and its value
    there."""
    degrees = p.scale.shape[1]
    last = [k % degrees == degrees - 1 for k in range(p.scale.size)]
    found = minimize(
        pushing_energy(p),
        np.zeros(p.scale.size),
        jac=True,
        method="L-BFGS-B",
        bounds=[(p.lower[k // degrees] if last[k] else None, None) for k in range(p.scale.size)],
        options={"maxiter": 20_000, "maxfun": 40_000, "ftol": 1e-30, "gtol": 1e-10, "maxcor": 50},
    )
    return found.x, found.fun
