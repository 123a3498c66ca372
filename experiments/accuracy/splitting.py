"""Work and precision of exchange between cells and medium.

The studies compare turns by Lie and by Strang splitting, and the solve of both together, Δt and the
tolerance of the circuits with the whole coupled system. A further study compares the statistics of
a colony that grows for hours.

The coupled system is one ordinary differential equation of all cells and all voxels, solved by
SciPy to 1e-10. `signals` assembles its transport. Cells read and release by the weights of the
stencil. It has neither splitting nor pools.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import torch
from circuits import LENGTH, RADIUS, Counted, advance, geometry, off
from scipy import sparse, stats
from scipy.integrate import solve_ivp
from signals import assembled
from study import Point, Study, timed

import torchfilm as tf
from design import Stripe

SPECIES, SIGNAL, WORK = "species", "signal", "applications"
DT = 0.025  # h, the default step of a scene
SPACING, VOXELS, DIFFUSION, DECAY = 4.0, (16, 16), 50.0, 0.2  # µm, –, µm²/h, 1/h
UNTIL = 1.0  # h
COLONIES = 32  # in a batch that is timed
MEMBRANE = SimpleNamespace(D1=5.0)  # µm/h


def lux(u, s, p, cell):
    """A circuit like Lux: AHL crosses the membrane at 20/h and fills a voxel at 1/h."""
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    induced = u.ahl * u.ahl
    return {
        "luxi": 0.05 + 2.0 * induced / (0.01 + induced) - 1.0 * u.luxi,
        "ahl": 5.0 * u.luxi / (1 + u.luxi) - 0.3 * u.ahl + into / cell.volume,
    }, {"ahl": -into}


@dataclass(frozen=True)
class Case:
    """Cells at `places`, (N, 2) µm, that neither move nor touch. growth: 1/h, of their volumes."""

    name: str
    title: str
    places: np.ndarray
    growth: float = 0.0


def cases() -> list[Case]:
    """Returns the three arrangements of cells."""
    anywhere = np.random.default_rng(3).uniform(-16.0, 16.0, (24, 2))
    middle = (np.arange(-2, 3, 2) + 0.5) * SPACING
    apart = np.stack(np.meshgrid(middle, middle, indexing="ij"), -1).reshape(-1, 2)
    return [
        Case("splitting_fixed", "Splitting: cells anywhere", anywhere),
        Case("splitting_alone", "Splitting: each cell in the middle of a voxel of its own", apart),
        Case("splitting_growing", "Splitting: cells that grow", apart + np.array([0.7, -1.1]), 1.0),
    ]


def drop(places: torch.Tensor) -> torch.Tensor:
    """The initial signal. With a uniform one Lie and Strang would differ only in the signal."""
    return 0.1 * torch.exp(-((places[:, 0] + 8.0) ** 2 + places[:, 1] ** 2) / 128.0)


def way_of(way: str) -> dict[str, str]:
    """Returns the options of `Medium` for "together", or for turns by "lie" or "strang"."""
    return (
        {"exchange": "together"} if way == "together" else {"exchange": "turns", "splitting": way}
    )


def scene_of(case: Case, way: str, rtol: float, rates: Callable = lux) -> tf.Scene:
    """Returns the scene of a case."""
    half = 0.5 * VOXELS[0] * SPACING
    count = len(case.places)
    grows = [tf.Growth(rate=case.growth)] if case.growth else []
    return tf.Scene(
        *grows,
        tf.Circuit(rates, species=("luxi", "ahl"), rtol=rtol, D1=MEMBRANE.D1),
        tf.Medium(
            ahl=tf.Signal(diffusion=DIFFUSION, decay=DECAY, initial=drop),
            box=((-half, -half), (half, half)),
            spacing=SPACING,
            **way_of(way),
        ),
        founders=tf.Cells(case.places, [[1.0, 0.0]] * count, length=LENGTH, radius=RADIUS),
    )


def reference(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Returns the final species (2, N) and signal (voxels,) of the coupled system."""
    state = scene_of(case, "strang", 1e-4).bind(dtype=torch.float64).start()
    where = state.layout.stencil(state.position, state.colony, torch.float64)
    count, voxels = len(case.places), where.nodes
    rows = np.repeat(np.arange(count), where.node.shape[1])
    weights = sparse.csr_matrix(
        (where.weight.numpy().ravel(), (rows, where.node.numpy().ravel())), shape=(count, voxels)
    )
    back, transport = weights.T.tocsr(), assembled(VOXELS, SPACING, DIFFUSION, DECAY)

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        luxi, inside, outside = y[:count], y[count : 2 * count], y[2 * count :]
        there, cell = weights @ outside, geometry(case.growth, t)
        rates, released = lux(
            SimpleNamespace(luxi=luxi, ahl=inside), SimpleNamespace(ahl=there), MEMBRANE, cell
        )
        amount = released["ahl"]
        # release by the weights; uptake from each voxel in proportion to its content
        uptake = np.maximum(-amount, 0.0) / np.where(there > 0, there, 1.0)
        change = (
            transport @ outside
            + (back @ np.maximum(amount, 0.0) - outside * (back @ uptake)) / SPACING**3
        )
        return np.concatenate(
            [rates["luxi"] - case.growth * luxi, rates["ahl"] - case.growth * inside, change]
        )

    start = np.concatenate([np.zeros(2 * count), state.signals["ahl"].numpy()])
    solution = solve_ivp(slope, (0.0, UNTIL), start, method="DOP853", rtol=1e-10, atol=1e-13)
    assert solution.success, solution.message
    end = solution.y[:, -1]
    return end[: 2 * count].reshape(2, count), end[2 * count :]


def iterations(model: tf.Model, dt: float, steps: int) -> int:
    """Returns how often a run applies transport where it is solved together with circuits."""
    state, total = model.start(), 0
    for _ in range(steps):
        state = model.step(state, dt)
        total += int(state.reports["circuit"].iterations.sum())
    return total


def point(
    case: Case,
    exact: tuple[np.ndarray, np.ndarray],
    series: str,
    way: str = "together",
    dt: float = DT,
    rtol: float = 1e-4,
    wide: bool = False,
) -> Point:
    """Runs, times and compares one setting; wide: float64.

    Work is the number of applications of the rates to all cells plus those of a transport to all
    voxels, counted in a run by torch. The time is that of a batch of COLONIES equal colonies by
    compiled functions.
    """
    counted, steps = Counted(lux, "luxi"), round(UNTIL / dt)
    given = {"dtype": torch.float64 if wide else torch.float32}
    by_torch = scene_of(case, way, rtol, counted).bind(**given)
    counted.rows = 0  # binding tries the rates
    transports = steps * (1 if way == "lie" else 2)
    if way == "together":
        transports = iterations(by_torch, dt, steps)
    else:
        advance(by_torch, by_torch.start(), dt, steps)
    count = len(case.places)
    work = counted.rows / count + transports
    model = scene_of(case, way, rtol).bind(COLONIES, **given)
    first = model.start()
    last, seconds = timed(lambda: advance(model, first, dt, steps))
    assert last is not None
    species = np.stack([last.fields[n][:count].double().numpy() for n in ("luxi", "ahl")])
    signal = last.signals["ahl"][: len(exact[1])].double().numpy()
    errors = {
        SPECIES: off(species, exact[0]),
        SIGNAL: float(np.linalg.norm(signal - exact[1]) / np.linalg.norm(exact[1])),
    }
    label = f"{way}, Δt {dt:g} h, rtol {rtol:g}, float{64 if wide else 32}"
    default = (way, dt, rtol, wide) == ("together", DT, 1e-4, False)
    return Point(
        series, label, errors, seconds, work, default, step=dt if series != "several" else None
    )


def split_steps(case: Case, quick: bool) -> Study:
    """Returns the study of Δt, tolerance and splitting for one case."""
    exact = reference(case)
    steps, tight = ((0.1, 0.05, DT), 1e-5) if quick else ((0.2, 0.1, 0.05, DT, 0.0125), 1e-7)
    points = [
        point(case, exact, f"Δt, {s}, rtol {tight:g}, float64", s, dt, tight, True)
        for s in ("lie", "strang", "together")
        for dt in steps
    ]
    few = (DT,) if quick else (*steps, 0.00625)
    points += [point(case, exact, f"Δt, {s}", s, dt) for s in ("strang", "together") for dt in few]
    points += [
        point(case, exact, "rtol", rtol=r)
        for r in ((1e-2,) if quick else (1e-1, 1e-2, 1e-3, 1e-5, 1e-6))
    ]
    if not quick:
        points += [
            point(case, exact, "several", s, dt, r)
            for s in ("lie", "strang", "together")
            for dt in (0.2, 0.1, 0.05, 0.0125)
            for r in (1e-1, 1e-2)
        ]
    return Study(case.name, case.title, WORK, (SPECIES, SIGNAL), points)


# --- statistics of a colony -----------------------------------------------------------------------


# the constants that experiments/boundary_stripe.py found
STRIPE = {
    "d1": 0.535,
    "k1": 66.5,
    "D1": 30.9,
    "d3": 2.73,
    "k5": 5.92,
    "k3": 87.5,
    "k4": 1.48e-6,
    "dr": 4.29,
}
TARGET = Stripe("yfp", at="border", width=4.0, cell_type=1, floor=0.2)
MEASURES = ("band width", "band peak", "cells", "mean yfp", "mean ahl", "peak ahl outside")


def detector(way: str, rtol: float) -> tf.Scene:
    """Returns the boundary detector in a channel 16 µm wide, with exchange by a way."""
    ready = tf.scenes.boundary_detector(width=16.0, rtol=rtol, **STRIPE)
    effects: list[tf.Effect] = []
    for effect in ready.effects:
        if isinstance(effect, tf.Medium):
            box, spacing = effect.box, effect.spacing
            effect = tf.Medium(
                **effect.signals,
                box=box,
                spacing=spacing,
                outside=effect.outside,
                grows=effect.grows,
                **way_of(way),
            )
        effects.append(effect)
    return ready.replace(*effects)


def ensemble(
    way: str, rtol: float, dt: float, until: float, streams: range
) -> tuple[dict[str, np.ndarray], float, float]:
    """Returns each measure of each colony, (streams,); the circuit steps of all cells; seconds."""
    scene = detector(way, rtol)
    model = scene.bind(colonies=len(streams), streams=list(streams))
    first = model.start()

    def run() -> tuple[tf.State, float]:
        state, steps = first, 0.0
        for _ in range(round(until / dt)):
            state = model.step(state, dt)
            assert not tf.failures(state)
            steps += float(state.reports["circuit"].steps.sum())
        return state, steps

    (state, steps), seconds = timed(run, 1)
    found = TARGET.measures(state)
    mean = lambda x: state.groups.sum(x.double().unsqueeze(1)).squeeze(1) / state.counts
    sinks = (state.cell_type == 1).double()
    grid = state.layout.grid
    highest = torch.zeros(grid.colonies).scatter_reduce(0, grid.owner, state.signals["ahl"], "amax")
    values = (
        found["width_um"],
        found["peak"],
        state.counts,
        mean(state.yfp * sinks) / mean(sinks),
        mean(state.ahl),
        highest,
    )
    return {n: v.double().numpy() for n, v in zip(MEASURES, values, strict=True)}, steps, seconds


def distance(found: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Returns the distance of two means and the half-width of Welch's 95 % confidence band.

    Both are relative to the second mean. Colonies without the measure are left out.
    """
    found, reference = (x[np.isfinite(x)] for x in (found, reference))
    parts = [x.var(ddof=1) / x.size for x in (found, reference)]
    freedom = sum(parts) ** 2 / max(
        sum(v**2 / (x.size - 1) for v, x in zip(parts, (found, reference), strict=True)), 1e-300
    )
    band = stats.t.ppf(0.975, freedom) * math.sqrt(sum(parts)) if sum(parts) > 0 else 0.0
    scale = float(reference.mean())
    return abs(float(found.mean()) - scale) / scale, float(band) / scale


def boundary(quick: bool) -> Study:
    """Returns the study of the stripe of the boundary detector."""
    until, streams, tight = (0.5, range(2), 1) if quick else (4.0, range(12), 8)
    others = range(1000, 1000 + 2 * len(streams))
    expected, _, _ = ensemble("together", 1e-4 if quick else 1e-6, DT / tight, until, others)
    settings = [
        ("Δt", "Δt 0.05 h", "together", 1e-4, 2 * DT),
        ("Δt", "default", "together", 1e-4, DT),
        ("rtol", "rtol 0.01", "together", 1e-2, DT),
    ]
    if not quick:
        settings = [
            ("Δt", "Δt 0.1 h", "together", 1e-4, 4 * DT),
            *settings[:2],
            ("Δt", "Δt 0.0125 h", "together", 1e-4, DT / 2),
            *settings[2:],
            ("exchange", "turns", "strang", 1e-4, DT),
            ("several", "rtol 0.01, Δt 0.05 h", "together", 1e-2, 2 * DT),
            ("several", "rtol 0.1, Δt 0.1 h, turns", "strang", 1e-1, 4 * DT),
        ]
    points = []
    for series, label, way, rtol, dt in settings:
        found, steps, seconds = ensemble(way, rtol, dt, until, streams)
        distances = {
            n: distance(found[n], expected[n])
            for n in MEASURES
            if np.isfinite(expected[n]).sum() > 1 and np.isfinite(found[n]).sum() > 1
        }
        errors, band = ({n: d[k] for n, d in distances.items()} for k in (0, 1))
        points.append(Point(series, label, errors, seconds, steps, label == "default", band))
    shown = ("mean yfp", "mean ahl") if quick else ("band width", "mean yfp", "peak ahl outside")
    work = "circuit steps, all cells"
    return Study("splitting_boundary", "Statistics: the boundary detector", work, shown, points)


def studies(quick: bool) -> Iterator[Study]:
    """Runs all studies of the splitting: small systems at rest and a growing colony."""
    for case in cases():
        if not quick or case.name != "splitting_fixed":
            yield split_steps(case, quick)
    yield boundary(quick)
