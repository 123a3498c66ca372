"""Work and precision of transport: methods and Δt on a fixed grid, the grid's spacing, and what a
point-like cell reads at its own place.

Time is judged by the exponential of a matrix that is assembled here, by finite volumes, from the
fluxes' formula alone; space by a spreading Gaussian, integrated over each voxel. Work is
multiplications: for each voxel an application of the operator has two for each of three axes and
one for decay, a tridiagonal solve six, a dense factor of n voxels n; what Krylov methods add up
beside their applications is not counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse, special
from scipy.sparse.linalg import expm_multiply
from study import Point, Study, timed

import torchfilm as tf
from torchfilm.signals import iterative
from torchfilm.signals.assembly import build_operator
from torchfilm.signals.exchange import read, stencil, write
from torchfilm.signals.exponential import aligned
from torchfilm.signals.grid import Grid
from torchfilm.signals.transport import prepare

ERROR, BELOW, WORK = "relative error", "below zero", "multiplications"
APPLY = 7  # multiplications of one application of the operator, a voxel
SOLVE = 6  # of a tridiagonal solve, a voxel: hand up, keep (two), hand down, settle (two)
STEPS = (0.2, 0.1, 0.05, 0.025, 0.0125, 0.00625)
DT = 0.025  # h, of a scene that says nothing else
SETTLED = 0.05  # h, up to which orders are measured
UNTIL = 0.4  # h
SPACING, DIFFUSION, DECAY = 4.0, 400.0, 0.2  # µm, µm²/h, 1/h
VOXELS = (32, 16)
RADIUS = 0.5  # µm, of the sphere that a cell's reading is compared with
Velocity = Callable[[np.ndarray], np.ndarray]  # places (M, 2) µm to velocities (M, 2) µm/h


def bernoulli(x: np.ndarray) -> np.ndarray:
    """x/(eˣ − 1)."""
    return np.where(x == 0, 1.0, x / np.where(x == 0, 1.0, np.expm1(x)))


def assembled(
    voxels: Sequence[int],
    spacing: float,
    diffusion: float,
    decay: float,
    velocity: Velocity | None = None,
    open_faces: bool = False,
    solid: np.ndarray | None = None,
) -> sparse.csr_matrix:
    """The matrix of ds/dt in a plane box centred on the origin, (nx ny, nx ny), 1/h, face by face.

    Between two voxels passes (K/h)[B(−vh/K) s_left − B(vh/K) s_right]; at faces of the box nothing,
    or, if open, what the flow carries out. solid: (nx, ny) bool, voxels whose faces are shut.
    """
    number = np.arange(voxels[0] * voxels[1]).reshape(voxels)
    corner = [-0.5 * n * spacing for n in voxels]
    rows, columns, values = [number.ravel()], [number.ravel()], [np.full(number.size, -decay)]
    if solid is not None:
        values[0] = np.where(solid.ravel(), 0.0, values[0])
    for axis in range(2):
        for k in range(voxels[axis] + 1):
            left, right = (
                None if not 0 <= i < voxels[axis] else np.take(number, i, axis) for i in (k - 1, k)
            )
            face = np.zeros((voxels[1 - axis], 2))
            face[:, axis], face[:, 1 - axis] = (
                corner[axis] + k * spacing,
                corner[1 - axis] + (np.arange(voxels[1 - axis]) + 0.5) * spacing,
            )
            v = np.zeros(len(face)) if velocity is None else velocity(face)[:, axis]
            if left is None or right is None:
                inner = left if right is None else right
                out = (
                    np.maximum(v if right is None else -v, 0.0) / spacing
                    if open_faces
                    else np.zeros(len(face))
                )
                free = np.ones(len(face)) if solid is None else ~solid.ravel()[inner]
                rows.append(inner), columns.append(inner), values.append(-out * free)
                continue
            up, down = (
                diffusion / spacing**2 * bernoulli(sign * v * spacing / diffusion)
                for sign in (-1.0, 1.0)
            )
            if solid is not None:
                passable = ~(solid.ravel()[left] | solid.ravel()[right])
                up, down = up * passable, down * passable
            rows += [left, right, right, left]
            columns += [left, left, right, right]
            values += [-up, up, -down, down]
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(sparse.coo_matrix(entries, shape=(number.size, number.size)))


@dataclass(frozen=True)
class Case:
    """Transport alone. flow: as `Medium` takes it, and as velocities of places; solid: where an
    obstacle is, of places (M, 2 or more)."""

    name: str
    title: str
    words: str
    flow: tuple[float, float] | Callable | None = None
    velocity: Velocity | None = None
    solid: Callable | None = None


def pillar(places):
    return (places[:, 0] - 6.0) ** 2 + places[:, 1] ** 2 < 100.0


def shear(places: torch.Tensor) -> torch.Tensor:
    """Along x, the faster the farther from y = 0: free of divergence, and slow where the pillar
    is."""
    return torch.stack([3.0 * places[:, 1].abs(), torch.zeros_like(places[:, 1])], 1)


CASES = (
    Case(
        "signals_still", "Transport in time: diffusion", "A drop in one voxel spreads and decays."
    ),
    Case(
        "signals_flow",
        "Transport in time: uniform flow",
        "The same in a uniform flow that carries it out of open faces.",
        (80.0, 20.0),
        lambda x: np.broadcast_to([80.0, 20.0], x.shape),
    ),
    Case(
        "signals_obstacle",
        "Transport in time: an obstacle and a flow that varies",
        "The same beside a pillar and in a shear flow, where no factor of one axis exists and the"
        " default is the implicit method.",
        shear,
        lambda x: np.stack([3.0 * np.abs(x[:, 1]), 0 * x[:, 1]], 1),
        pillar,
    ),
)


def drop(places: torch.Tensor) -> torch.Tensor:
    """1 in the voxel about (−26, 2) µm, 0 elsewhere."""
    return (
        ((places[:, :2] - places.new_tensor([-26.0, 2.0])).abs() < 0.5 * SPACING)
        .all(1)
        .to(places.dtype)
    )


@dataclass
class Applied:
    """How often the spatial operator was applied within `watched`."""

    times: int = 0


@contextmanager
def watched() -> Iterator[Applied]:
    """Counts what the methods that go by the operator itself, Euler and Crank–Nicolson, ask of
    it."""
    seen, usual = Applied(), iterative.apply

    def counting(*args, **options):
        seen.times += 1
        return usual(*args, **options)

    iterative.apply = counting
    try:
        yield seen
    finally:
        iterative.apply = usual


def point(
    case: Case,
    exact: np.ndarray,
    series: str,
    method: str | None,
    dt: float,
    dtype: torch.dtype = torch.float64,
    splitting: str = "strang",
) -> Point:
    """A scene of transport alone over UNTIL hours; method None is the library's choice, and in
    float32 its default."""
    half = [0.5 * n * SPACING for n in VOXELS]
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=DIFFUSION, decay=DECAY, initial=drop),
        box=((-half[0], -half[1]), (half[0], half[1])),
        spacing=SPACING,
        flow=case.flow,
        obstacles=case.solid,
        method=method,
        splitting=splitting,
    )
    scene = tf.Scene(medium, founders=tf.Cells([[-26.0, 2.0]], [[1.0, 0.0]]))
    first, steps = scene.seed(dtype=dtype), round(UNTIL / dt)

    def run(worst: list[float]) -> tf.State:
        state = first
        for _ in range(steps):
            state = scene.step(state, dt)
            if worst:
                worst.append(-float(state.signals["ahl"].min() / state.signals["ahl"].max()))
        return state

    below = [0.0]
    with watched() as seen:
        run(below)
    last, seconds = timed(lambda: run([]))
    chosen = method or ("exponential" if case.solid is None else "implicit")
    factors = {"exponential": sum(VOXELS), "implicit": 2 * SOLVE}.get(chosen, 0)
    work = (
        VOXELS[0]
        * VOXELS[1]
        * (steps * (1 if splitting == "lie" else 2) * factors + APPLY * seen.times)
    )
    found = last.signals["ahl"].double().numpy()
    words = f"{chosen}, Δt {dt:g} h, {'float64' if dtype == torch.float64 else 'float32'}" + (
        ", lie" if splitting == "lie" else ""
    )
    errors = {
        ERROR: float(np.linalg.norm(found - exact) / np.linalg.norm(exact)),
        BELOW: max(below),
    }
    # Euler's own sub-steps, and rounding, have no order in Δt
    ordered = chosen in ("implicit", "crank_nicolson") and dt <= SETTLED
    return Point(
        series,
        words,
        errors,
        seconds,
        work,
        method is None and dt == DT,
        step=dt if ordered else None,
    )


def in_time(case: Case, quick: bool) -> Study:
    """Methods and Δt on one grid."""
    half = [0.5 * n * SPACING for n in VOXELS]
    centres = [(np.arange(n) + 0.5) * SPACING - h for n, h in zip(VOXELS, half, strict=True)]
    places = torch.tensor(np.stack(np.meshgrid(*centres, indexing="ij"), -1).reshape(-1, 2))
    solid = None if case.solid is None else case.solid(places).numpy().reshape(VOXELS)
    matrix = assembled(
        VOXELS, SPACING, DIFFUSION, DECAY, case.velocity, case.velocity is not None, solid
    )
    exact = expm_multiply(matrix * UNTIL, drop(places).numpy())
    steps = (0.1, 0.05, DT) if quick else STEPS
    points = [
        point(case, exact, "Δt, default method, float32", None, dt, torch.float32) for dt in steps
    ]
    for method in (
        ("implicit", "crank_nicolson", "euler")
        if case.solid is not None
        else ("exponential", "implicit", "crank_nicolson", "euler")
    ):
        points += [point(case, exact, f"Δt, {method}", method, dt) for dt in steps]
    points += [
        point(case, exact, "Δt, implicit, lie", "implicit", dt, splitting="lie") for dt in steps
    ]
    return Study(
        case.name,
        case.title,
        f"{case.words} {VOXELS[0]} × {VOXELS[1]} voxels of {SPACING:g} µm, K = {DIFFUSION:g} µm²/h,"
        f" {UNTIL:g} h. Each step is two of Δt/2, but for those marked lie. Below zero: the most"
        " negative value of any step over the greatest then. Orders are of Δt up to"
        f" {SETTLED:g} h.",
        "relative, over voxels, against the exponential of a matrix assembled apart",
        WORK,
        (ERROR,),
        points,
    )


def spread(voxels: int, spacing: float, centre: float, deviation: float) -> np.ndarray:
    """A Gaussian's mean over each voxel of an axis centred on 0, (voxels,), 1/µm."""
    edges = (np.arange(voxels + 1) - 0.5 * voxels) * spacing
    return np.diff(special.ndtr((edges - centre) / deviation)) / spacing


# name, words, diffusion, µm²/h, and flow, µm/h
DRIFTS = (
    ("signals_space", "Nothing flows.", 50.0, 0.0),
    (
        "signals_space_flow",
        "It drifts by 10 µm, slowly beside diffusion across a voxel.",
        50.0,
        10.0,
    ),
    (
        "signals_space_fast",
        (
            "It drifts by 40 µm, and hardly diffuses: across a voxel of 4 µm flow is 320 times as"
            " fast as diffusion."
        ),
        0.5,
        40.0,
    ),
)


def in_space(name: str, words: str, diffusion: float, speed: float, quick: bool) -> Study:
    """A Gaussian that spreads and drifts, on ever finer grids; the step is exact in time, so that
    spacing alone matters."""
    width, start, until = 128.0, 10.0, 1.0  # µm, µm, h
    end = math.sqrt(start**2 + 2 * diffusion * until)
    points = []
    for spacing in (8.0, 4.0, 2.0) if quick else (8.0, 4.0, 2.0, 1.0):
        n = round(width / spacing)
        first, exact = (
            np.outer(spread(n, spacing, x, s), spread(n, spacing, 0.0, s))
            for x, s in ((-0.5 * speed * until, start), (0.5 * speed * until, end))
        )
        made = build_operator(
            (n, n, 1),
            (spacing,) * 3,
            diffusion=diffusion,
            velocity=(speed, 0.0, 0.0) if speed else None,
            dtype=torch.float64,
            boundary=tf.BoundaryConditions(tf.Open(), tf.Open()) if speed else None,
        )
        u = torch.tensor(first).reshape(1, n, n, 1)
        for method, dt in (
            ("exponential", DT),
            *(() if quick else (("exponential", 1.0), ("implicit", DT), ("implicit", 0.1))),
        ):
            stepper, steps = prepare(made, dt, method), round(until / dt)
            found, seconds = timed(lambda s=stepper, k=steps, u=u: _repeated(s, u, k))
            error = float(np.linalg.norm(found - exact) / np.linalg.norm(exact))
            usual = (method, dt) == ("exponential", DT)
            work = 2 * (aligned(n) if method == "exponential" else SOLVE) * steps * n * n
            said = f"{spacing:g} µm, {method}, Δt {dt:g} h"
            points.append(
                Point(
                    "spacing" if usual else "several",
                    said,
                    {ERROR: error},
                    seconds,
                    work,
                    usual and spacing == 4.0,
                    step=spacing if usual else None,
                )
            )
    return Study(
        name,
        "Transport in space: the spacing" + (f", flow {speed:g} µm/h" if speed else ""),
        f"A Gaussian, 10 µm wide at first, spreads for 1 h in a box 128 µm wide. {words} The ready"
        " scenes' spacing, 4 µm, is marked.",
        "relative, over voxels, against the Gaussian integrated over each voxel",
        WORK,
        (ERROR,),
        points,
    )


def _repeated(stepper, u: torch.Tensor, times: int) -> np.ndarray:
    for _ in range(times):
        u = stepper.step(u)
    return u[0, :, :, 0].numpy()


def at_a_cell(quick: bool) -> Study:
    """What a cell that gives off a signal reads of it where it is and a few µm off, in the steady
    state, by spacing."""
    width, diffusion, decay, away = 32.0, 48.0, 3.0, 6.0  # µm, µm²/h, 1/h, µm
    reach, places = math.sqrt(diffusion / decay), 2 if quick else 8
    at = lambda r: math.exp(-r / reach) / (4 * math.pi * diffusion * r)
    points = []
    for spacing in (4.0, 2.0) if quick else (8.0, 4.0, 2.0, 1.0, 0.5):
        n = round(width / spacing)
        grid = Grid(
            torch.full((1, 3), -0.5 * width, dtype=torch.float64),
            torch.full((1, 3), n),
            (spacing,) * 3,
        )
        spent, own, far = [], [], []
        for place in np.random.default_rng(0).uniform(-4.0, 4.0, (places, 3)):
            here = torch.tensor(place).unsqueeze(0)
            cell, near = (
                stencil(grid, x, torch.zeros(1, dtype=torch.int64))
                for x in (here, here + torch.tensor([away, 0.0, 0.0], dtype=torch.float64))
            )
            given = write(
                torch.zeros(grid.nodes, dtype=torch.float64),
                torch.ones(1, dtype=torch.float64),
                cell,
            ).reshape(n, n, n)

            def steady(
                given: torch.Tensor = given, n: int = n, spacing: float = spacing
            ) -> torch.Tensor:
                made = build_operator(
                    (n, n, n),
                    (spacing,) * 3,
                    diffusion=diffusion,
                    decay=decay,
                    source=given,
                    dtype=torch.float64,
                )
                return (
                    prepare(made, 8.0)
                    .step(torch.zeros(1, n, n, n, dtype=torch.float64))
                    .reshape(-1)
                )

            found, seconds = timed(steady, 1)
            spent.append(seconds)
            own.append(float(read(found, cell)) / at(RADIUS))
            far.append(float(read(found, near)) / at(away))
        errors = {
            "off, 6 µm away": float(np.sqrt(np.mean((np.array(far) - 1) ** 2))),
            "own reading": float(np.mean(own)),
        }
        points.append(
            Point(
                "spacing",
                f"{spacing:g} µm",
                errors,
                sum(spent) / len(spent),
                3.0 * aligned(n) * n**3,
                spacing == 4.0,
                step=spacing,
            )
        )
    return Study(
        "signals_cell",
        "What a cell reads of its own signal",
        "A cell gives off a signal at its one point, in three dimensions, until nothing changes."
        " Own reading: at its own place, over what a sphere of 0.5 µm that gives off as much has at"
        " its surface: no error that falls to 0, since the reading has no limit. Off, 6 µm away:"
        " what another cell reads there.",
        "relative to exp(−r/λ)/(4πKr) with λ = √(K/k) = 4 µm; root mean square, and for the own"
        " reading mean, over places of the cell in its voxel",
        WORK,
        ("off, 6 µm away", "own reading"),
        points,
    )


def studies(quick: bool) -> list[Study]:
    """Work–precision of transport."""
    cases = [c for c in CASES if not quick or c.name != "signals_still"]
    return [
        *(in_time(c, quick) for c in cases),
        *(in_space(*drift, quick) for drift in DRIFTS),
        at_a_cell(quick),
    ]
