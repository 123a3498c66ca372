"""Work and precision of transport: methods and Δt on a fixed grid, the spacing, and the reading of
a cell at its own place.

The reference in time is the exponential of a matrix. This module assembles the matrix by finite
volumes, from the formula of the fluxes alone. The reference in space is a spreading Gaussian,
integrated over each voxel. Work is the number of multiplications. For each voxel, one application
of the operator has two for each of three axes and one for decay, a tridiagonal solve has six, and a
dense factor of n voxels has n. Vector operations of Krylov methods are not included.
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
from torchfilm.signals import transport_iterative
from torchfilm.signals.exchange import read, stencil, write
from torchfilm.signals.grid import Grid
from torchfilm.signals.transport import prepare
from torchfilm.signals.transport_exponential import aligned
from torchfilm.signals.transport_rates import build_operator

ERROR, BELOW, WORK = "relative error", "below zero", "multiplications"
APPLY = 7  # multiplications per voxel of one application of the operator
SOLVE = 6  # of a tridiagonal solve: forward sweep three, backward sweep three
STEPS = (0.2, 0.1, 0.05, 0.025, 0.0125, 0.00625)
DT = 0.025  # h, the default step of a scene
SETTLED = 0.05  # h; orders use steps up to this length
UNTIL = 0.4  # h
SPACING, DIFFUSION, DECAY = 4.0, 400.0, 0.2  # µm, µm²/h, 1/h
VOXELS = (32, 16)
RADIUS = 0.5  # µm, of the sphere that the reading of a cell is compared with
Velocity = Callable[[np.ndarray], np.ndarray]  # places (M, 2) µm to velocities (M, 2) µm/h


def bernoulli(x: np.ndarray) -> np.ndarray:
    """Returns x/(eˣ − 1)."""
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
    """Returns the matrix of ds/dt in a plane box centred on the origin, (nx ny, nx ny), 1/h.

    The flux between two voxels is (K/h)[B(−vh/K) s_left − B(vh/K) s_right]. The flux through a face
    of the box is 0, or what the flow carries out if `open_faces`. solid: (nx, ny) bool, voxels with
    closed faces.
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
    """A scene of transport alone.

    flow: the argument of `Medium`. velocity: the same flow as a function of places. solid: whether
    places (M, 2 or more) are in the obstacle.
    """

    name: str
    title: str
    flow: tuple[float, float] | Callable | None = None
    velocity: Velocity | None = None
    solid: Callable | None = None


def pillar(places):
    """Whether places are in the obstacle, a disc of radius 10 µm."""
    return (places[:, 0] - 6.0) ** 2 + places[:, 1] ** 2 < 100.0


def shear(places: torch.Tensor) -> torch.Tensor:
    """A flow along x that grows with the distance from y = 0.

    It has no divergence and is slow at the pillar.
    """
    return torch.stack([3.0 * places[:, 1].abs(), torch.zeros_like(places[:, 1])], 1)


CASES = (
    Case("signals_still", "Transport in time: diffusion"),
    Case(
        "signals_flow",
        "Transport in time: uniform flow",
        (80.0, 20.0),
        lambda x: np.broadcast_to([80.0, 20.0], x.shape),
    ),
    Case(
        "signals_obstacle",
        "Transport in time: an obstacle and a flow that varies",
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
    """The number of applications of the spatial operator within `count_applications`."""

    times: int = 0


@contextmanager
def count_applications() -> Iterator[Applied]:
    """Counts applications of the operator by Euler and Crank–Nicolson, which use it directly."""
    applied, original = Applied(), transport_iterative.apply

    def counting(*args, **options):
        applied.times += 1
        return original(*args, **options)

    transport_iterative.apply = counting
    try:
        yield applied
    finally:
        transport_iterative.apply = original


def point(
    case: Case,
    exact: np.ndarray,
    series: str,
    method: str | None,
    dt: float,
    dtype: torch.dtype = torch.float64,
    splitting: str = "strang",
) -> Point:
    """Runs, times and compares one setting of transport alone over UNTIL hours.

    method None is torchfilm's own choice. In float32 this setting is the default.
    """
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
    model, steps = scene.bind(dtype=dtype), round(UNTIL / dt)
    first = model.start()

    def run(worst: list[float]) -> tf.State:
        state = first
        for _ in range(steps):
            state = model.step(state, dt)
            if worst:
                worst.append(-float(state.signals["ahl"].min() / state.signals["ahl"].max()))
        return state

    below = [0.0]
    with count_applications() as applied:
        run(below)
    last, seconds = timed(lambda: run([]))
    chosen = method or ("exponential" if case.solid is None else "series")
    mean = 4 * DIFFUSION * dt / SPACING**2 / (1 if splitting == "lie" else 2)
    factors = {
        "exponential": sum(VOXELS),
        "series": APPLY * (mean + 6 * math.sqrt(mean) + 8),  # about its number of terms
        "implicit": 2 * SOLVE,
    }.get(chosen, 0)
    work = (
        VOXELS[0]
        * VOXELS[1]
        * (steps * (1 if splitting == "lie" else 2) * factors + APPLY * applied.times)
    )
    found = last.signals["ahl"].double().numpy()
    label = f"{chosen}, Δt {dt:g} h, {'float64' if dtype == torch.float64 else 'float32'}" + (
        ", lie" if splitting == "lie" else ""
    )
    errors = {
        ERROR: float(np.linalg.norm(found - exact) / np.linalg.norm(exact)),
        BELOW: max(below),
    }
    # Euler takes its own sub-steps, and rounding has no order in Δt
    ordered = chosen in ("implicit", "crank_nicolson") and dt <= SETTLED
    return Point(
        series,
        label,
        errors,
        seconds,
        work,
        method is None and dt == DT,
        step=dt if ordered else None,
    )


def in_time(case: Case, quick: bool) -> Study:
    """Returns the study of methods and Δt on one grid."""
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
        ("series", "implicit", "crank_nicolson", "euler")
        if case.solid is not None
        else ("exponential", "implicit", "crank_nicolson", "euler")
    ):
        points += [point(case, exact, f"Δt, {method}", method, dt) for dt in steps]
    points += [
        point(case, exact, "Δt, implicit, lie", "implicit", dt, splitting="lie") for dt in steps
    ]
    return Study(case.name, case.title, WORK, (ERROR,), points)


def spread(voxels: int, spacing: float, centre: float, deviation: float) -> np.ndarray:
    """Returns the mean of a Gaussian over each voxel of an axis centred on 0, (voxels,), 1/µm."""
    edges = (np.arange(voxels + 1) - 0.5 * voxels) * spacing
    return np.diff(special.ndtr((edges - centre) / deviation)) / spacing


# name, diffusion (µm²/h), flow (µm/h)
DRIFTS = (
    ("signals_space", 50.0, 0.0),
    ("signals_space_flow", 50.0, 10.0),
    ("signals_space_fast", 0.5, 40.0),
)


def in_space(name: str, diffusion: float, speed: float, quick: bool) -> Study:
    """Returns the study of the spacing: a Gaussian that spreads and drifts.

    The default step is exact in time, so only the spacing causes errors.
    """
    width, start, until = 128.0, 10.0, 1.0  # µm, µm, h
    end = math.sqrt(start**2 + 2 * diffusion * until)
    points = []
    for spacing in (8.0, 4.0, 2.0) if quick else (8.0, 4.0, 2.0, 1.0):
        n = round(width / spacing)
        first, exact = (
            np.outer(spread(n, spacing, x, s), spread(n, spacing, 0.0, s))
            for x, s in ((-0.5 * speed * until, start), (0.5 * speed * until, end))
        )
        transport = build_operator(
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
            stepper, steps = prepare(transport, dt, method), round(until / dt)
            found, seconds = timed(lambda s=stepper, k=steps, u=u: _repeated(s, u, k))
            error = float(np.linalg.norm(found - exact) / np.linalg.norm(exact))
            usual = (method, dt) == ("exponential", DT)
            work = 2 * (aligned(n) if method == "exponential" else SOLVE) * steps * n * n
            label = f"{spacing:g} µm, {method}, Δt {dt:g} h"
            points.append(
                Point(
                    "spacing" if usual else "several",
                    label,
                    {ERROR: error},
                    seconds,
                    work,
                    usual and spacing == 4.0,
                    step=spacing if usual else None,
                )
            )
    title = "Transport in space: the spacing" + (f", flow {speed:g} µm/h" if speed else "")
    return Study(name, title, WORK, (ERROR,), points)


def _repeated(stepper, u: torch.Tensor, times: int) -> np.ndarray:
    for _ in range(times):
        u = stepper.step(u)
    return u[0, :, :, 0].numpy()


def at_a_cell(quick: bool) -> Study:
    """Returns the study of the reading of a cell that releases a signal, by spacing.

    The readings are those at its own place and a few µm away, in the steady state.
    """
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
            source = write(
                torch.zeros(grid.nodes, dtype=torch.float64),
                torch.ones(1, dtype=torch.float64),
                cell,
            ).reshape(n, n, n)

            def steady(
                source: torch.Tensor = source, n: int = n, spacing: float = spacing
            ) -> torch.Tensor:
                transport = build_operator(
                    (n, n, n),
                    (spacing,) * 3,
                    diffusion=diffusion,
                    decay=decay,
                    source=source,
                    dtype=torch.float64,
                )
                return (
                    prepare(transport, 8.0)
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
    shown = ("off, 6 µm away", "own reading")
    return Study("signals_cell", "What a cell reads of its own signal", WORK, shown, points)


def studies(quick: bool) -> Iterator[Study]:
    """Runs all studies of transport, one after the other."""
    for case in CASES:
        if not quick or case.name != "signals_still":
            yield in_time(case, quick)
    for drift in DRIFTS:
        yield in_space(*drift, quick)
    yield at_a_cell(quick)
