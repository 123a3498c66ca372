"""Work and precision of the circuits.

Cells neither touch nor exchange molecules. Each cell is compared with its own equation, which SciPy
solves to twelve digits. The equations are written once, in arithmetic that torch and NumPy share:
torchfilm integrates them in torch, SciPy's Radau or DOP853 in NumPy. The volume of a cell is known
in closed form. Work is the number of rate evaluations per cell; a Jacobian of S species counts as
S evaluations. Compiled functions count nothing, so the rates are counted in a run by torch, which
takes the same steps. The time is that of compiled functions, in many copies of the cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from study import Point, Study, timed

import torchfilm as tf
from torchfilm.effects.circuit_checks import EXPLICIT

Columns = dict[str, Any]
ERROR, WORK = "relative error", "rate evaluations per cell"
LENGTH, RADIUS = 2.0, 0.5  # µm, of every cell at the start
DT = 0.025  # h, the default step of a scene
COARSE = 0.2  # h, the step of the scene, which explicit methods divide
CELLS = 8
COPIES = 128  # of these cells, in the run that is timed
SETTLED = 16  # orders use at least this many steps in COARSE


@dataclass(frozen=True)
class Problem:
    """A circuit in CELLS cells for `until` h.

    rates: (u, s, p, cell) → dict. starts: initial concentrations by species, (CELLS,) each.
    solver: SciPy's method for the reference.
    """

    name: str
    title: str
    rates: Callable[[Any, Any, Any, Any], Columns]
    starts: Mapping[str, np.ndarray]
    until: float
    parameters: Mapping[str, float] = field(default_factory=dict)
    solver: str = "DOP853"
    growth: float = 0.0  # 1/h, of the volume


class Counted:
    """A rate function that counts the rows that it evaluates."""

    def __init__(self, rates: Callable[[Any, Any, Any, Any], Columns], first: str):
        self.rates, self.first, self.rows = rates, first, 0

    def __call__(self, u: Any, s: Any, p: Any, cell: Any) -> Columns:
        self.rows += getattr(u, self.first).numel()
        return self.rates(u, s, p, cell)


def ring_of_three(u, s, p, cell):
    """The equations of tf.scenes.repressilator: one mRNA and one protein per gene."""
    transcription = lambda by: p.speed * (p.alpha / (1 + by**2) + p.basal)
    return {
        "m_laci": transcription(u.ci) - p.speed * u.m_laci,
        "m_tetr": transcription(u.laci) - p.speed * u.m_tetr,
        "m_ci": transcription(u.tetr) - p.speed * u.m_ci,
        "laci": p.turnover * (u.m_laci - u.laci),
        "tetr": p.turnover * (u.m_tetr - u.tetr),
        "ci": p.turnover * (u.m_ci - u.ci),
    }


def toggle(u, s, p, cell):
    """Two genes that repress each other."""
    return {"red": 10.0 / (1 + u.green**2) - u.red, "green": 10.0 / (1 + u.red**2) - u.green}


def fast_loop(u, s, p, cell):
    """A bistable loop in which one variable follows the other within 1e-8 h: the hard case 24."""
    power = u.slow**8
    return {"slow": 0.1 + 2 * u.fast - u.slow, "fast": 1e8 * (power / (1 + power) - u.fast)}


def lux(u, s, p, cell):
    """The paper's Lux circuit with a constant concentration of AHL outside."""
    into = p.D1 * (p.outside - u.ahl) * cell.area
    induced = u.ahl * u.ahl
    return {
        "luxi": 1e-3 + induced / (1e-4 + induced) - 0.1 * u.luxi,
        "ahl": 100.0 * u.luxi / (1 + u.luxi) + into / cell.volume,
    }


def problems() -> list[Problem]:
    """Returns the four problems without growth."""
    draw = np.random.default_rng(1)
    some = lambda low, high: draw.uniform(low, high, CELLS)
    genes = ("laci", "tetr", "ci")
    speed = 2.0
    return [
        Problem(
            "circuits_repressilator",
            "Circuits: the repressilator",
            ring_of_three,
            {n: some(0.0, 40.0) for n in (*genes, *("m_" + n for n in genes))},
            4.0,
            {"alpha": 216.0, "basal": 0.216, "speed": speed, "turnover": 5.0 * speed},
        ),
        Problem(
            "circuits_toggle",
            "Circuits: the toggle switch",
            toggle,
            {"red": some(0.5, 4.0), "green": some(0.5, 4.0)},
            6.0,
        ),
        Problem(
            "circuits_stiff",
            "Circuits: a stiff, bistable loop",
            fast_loop,
            {"slow": np.linspace(0.85, 1.2, CELLS), "fast": np.zeros(CELLS)},
            3.0,
            solver="Radau",
        ),
        Problem(
            "circuits_lux",
            "Circuits: Lux quorum sensing",
            lux,
            {"luxi": some(0.0, 0.2), "ahl": some(0.0, 0.05)},
            4.0,
            {"D1": 100.0, "outside": 0.005},
        ),
    ]


def geometry(growth: float, t: float) -> SimpleNamespace:
    """Returns the exact volume and area of a capsule that has grown by V' = g V for t hours."""
    volume = math.pi * RADIUS**2 * (LENGTH + 4 * RADIUS / 3) * math.exp(growth * t)
    length = volume / (math.pi * RADIUS**2) - 4 * RADIUS / 3
    return SimpleNamespace(volume=volume, area=2 * math.pi * RADIUS * (length + 2 * RADIUS))


def reference(problem: Problem) -> np.ndarray:
    """Returns the final concentrations, (species, CELLS): c' = f(c) − g c by SciPy, to 1e-12."""
    names, p, growth = tuple(problem.starts), SimpleNamespace(**problem.parameters), problem.growth

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        found = problem.rates(
            SimpleNamespace(**dict(zip(names, y, strict=True))), None, p, geometry(growth, t)
        )
        return np.array([found[n] for n in names]) - growth * y

    ends = []
    for start in np.stack([problem.starts[n] for n in names], 1):
        solution = solve_ivp(
            slope, (0.0, problem.until), start, method=problem.solver, rtol=1e-12, atol=1e-14
        )
        assert solution.success, solution.message
        ends.append(solution.y[:, -1])
    return np.stack(ends, 1)


@dataclass(frozen=True)
class Setting:
    """How the circuits are integrated; the defaults are those of torchfilm."""

    method: str = "rosenbrock"
    steps: int = 1
    rtol: float = 1e-4
    dt: float = DT
    dtype: torch.dtype = torch.float32

    @property
    def label(self) -> str:
        kind = "float64" if self.dtype == torch.float64 else "float32"
        how = (
            f"{self.method}, rtol {self.rtol:g}"
            if self.method == "rosenbrock"
            else f"{self.method}, {self.steps} step{'s' * (self.steps > 1)}"
        )
        return f"{how}, Δt {self.dt:g} h, {kind}"

    @property
    def is_default(self) -> bool:
        return self == Setting()


def advance(model: tf.Model, state: tf.State, dt: float, steps: int) -> tf.State | None:
    """Returns the state `steps` steps later, or None if a circuit fails."""
    for _ in range(steps):
        state = model.step(state, dt)
        if bool(state.reports["circuit"].status.any()):
            return None
    return state


def point(
    problem: Problem, exact: np.ndarray, series: str, setting: Setting, step: float | None = None
) -> Point:
    """Runs, times and compares one setting of a problem."""
    counted = Counted(problem.rates, next(iter(problem.starts)))
    steps = round(problem.until / setting.dt)
    run = lambda m, first: advance(m, first, problem.until / steps, steps)
    by_torch = model_of(problem, setting, counted, 1)
    counted.rows = 0  # binding tries the rates
    run(by_torch, by_torch.start())
    work = counted.rows / CELLS
    model = model_of(problem, setting, problem.rates, COPIES)
    first = model.start()
    last, seconds = timed(lambda: run(model, first))
    label = setting.label + (" (fails)" if last is None else "")
    error = math.nan
    if last is not None:
        each = [last.fields[n][:CELLS].double().numpy() for n in problem.starts]
        error = off(np.stack(each), exact)
    return Point(series, label, {ERROR: error}, seconds, work, setting.is_default, step=step)


def model_of(
    problem: Problem, setting: Setting, rates: Callable[[Any, Any, Any, Any], Columns], copies: int
) -> tf.Model:
    """Returns the bound model of so many copies of the cells, far apart and without mechanics: only
    the circuit and growth act."""
    circuit = tf.Circuit(
        rates,
        species=tuple(problem.starts),
        method=setting.method,
        steps=setting.steps,
        rtol=setting.rtol,
        **problem.parameters,
    )
    count = CELLS * copies
    cells = tf.Cells(
        [[0.0, 5.0 * k] for k in range(count)],
        [[1.0, 0.0]] * count,
        length=LENGTH,
        radius=RADIUS,
        extra={n: np.tile(x, copies) for n, x in problem.starts.items()},
    )
    grows = [tf.Growth(rate=problem.growth)] if problem.growth else []
    return tf.Scene(*grows, circuit, founders=cells).bind(dtype=setting.dtype)


def off(found: np.ndarray, exact: np.ndarray) -> float:
    """Returns the relative error of concentrations, (species, cells).

    It is the root mean square over species of each species' relative error. That is the root mean
    square of the error over cells, relative to the root mean square of the species.
    """
    return float(np.sqrt((((found - exact) ** 2).mean(1) / (exact**2).mean(1)).mean()))


def sweep(problem: Problem, quick: bool) -> Study:
    """Returns the study of all settings of a problem, in cells that do not grow."""
    exact = reference(problem)
    tolerances = (1e-2, 1e-4, 1e-6) if quick else tuple(10.0**-k for k in range(1, 9))
    wide, whole = torch.float64, problem.until
    points = [
        point(problem, exact, "Δt", Setting(dt=dt))
        for dt in ((0.2, DT) if quick else (1.0, 0.5, 0.2, 0.1, 0.05, DT, 0.0125))
    ]
    points += [
        point(problem, exact, "rtol at Δt 0.025 h", Setting(rtol=r, dtype=wide))
        for r in tolerances
        if r >= 1e-6
    ]
    points += [
        point(problem, exact, "rtol, all in one step", Setting(rtol=r, dt=whole, dtype=wide))
        for r in tolerances
    ]
    points += [
        point(problem, exact, "rtol, all in one step, float32", Setting(rtol=r, dt=whole))
        for r in tolerances
        if not quick
    ]
    stiff = problem.name == "circuits_stiff"
    for method in ("euler", "rk4") if stiff or quick else EXPLICIT:
        for steps in (64,) if stiff else (16, 32, 64) if quick else (1, 2, 4, 8, 16, 32, 64):
            setting = Setting(method, steps, dt=COARSE, dtype=wide)
            points.append(
                point(
                    problem,
                    exact,
                    f"steps of {method}",
                    setting,
                    COARSE / steps if steps >= SETTLED else None,
                )
            )
    return Study(problem.name, problem.title, WORK, (ERROR,), points)


def growing(quick: bool) -> Study:
    """Returns the study of the splitting of dilution and rates, in cells that grow."""
    problem = Problem(
        "circuits_growth",
        "Circuits in cells that grow",
        lux,
        {"luxi": np.linspace(0.0, 0.2, CELLS), "ahl": np.linspace(0.0, 0.05, CELLS)},
        1.0,
        {"D1": 2.0, "outside": 0.005},
        growth=1.0,
    )
    exact, wide = reference(problem), torch.float64
    steps = (0.2, 0.1, DT) if quick else (0.5, 0.25, 0.125, 0.1, 0.05, DT, 0.0125, 0.00625)
    tight = 1e-5 if quick else 1e-7
    points = [
        point(
            problem,
            exact,
            f"Δt at rtol {tight:g}, float64",
            Setting(rtol=tight, dt=dt, dtype=wide),
            dt,
        )
        for dt in steps
    ]
    points += [point(problem, exact, "Δt", Setting(dt=dt), dt) for dt in steps]
    points += [
        point(problem, exact, "rtol", Setting(rtol=r))
        for r in ((1e-2,) if quick else (1e-1, 1e-2, 1e-3, 1e-5, 1e-6, 1e-7))
    ]
    if not quick:
        points += [
            point(problem, exact, "several", Setting(rtol=r, dt=dt))
            for r in (1e-1, 1e-2)
            for dt in (0.25, 0.1, 0.05)
        ]
        points += [
            point(problem, exact, "several", Setting("rk4", n, dt=dt), None)
            for n in (1, 4)
            for dt in (0.1, DT)
        ]
    return Study(problem.name, problem.title, WORK, (ERROR,), points)


def studies(quick: bool) -> Iterator[Study]:
    """Runs all studies of the circuits: one per problem without growth, and one with growth."""
    for p in problems():
        if not quick:
            yield sweep(p, quick)
        elif p.name in ("circuits_toggle", "circuits_lux"):
            yield sweep(replace(p, until=2.0), quick)
    yield growing(quick)
