"""Work and precision of the contact mechanics: the order in Δt, what every knob does to a colony
over a short time, and to the statistics of whole runs.

Soft cells have a motion of their own, an ordinary differential equation, which is written here
again in NumPy and solved by SciPy. Hard cells have none: there the reference is another kind of
contact, settled tightly. Work is how many contact rows products with J and its transpose read;
finding contacts is not in it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from growth import RowCounter
from numpy import ndarray
from scipy import stats
from scipy.integrate import solve_ivp
from study import Point, Study, timed
from torch import Tensor

import torchfilm as tf
from torchfilm.effects.mechanics import TOLERANCE
from torchfilm.physics.contacts import gaps_nearby

WORK = "contact rows read"
DT = 0.025  # h, of a scene that says nothing else
DIAMETER = 1.0  # µm, of every cell here
SEED = 1
SHORT = 0.1  # s; what takes longer is run once
TOLERANCES = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 1e-3)
KNOBS = ("stiffness", "alpha", "passes", "tolerance", "overlap", "unilateral")


@dataclass(frozen=True)
class Choice:
    """How mechanics are solved, under the knob that is turned."""

    series: str
    mechanics: tf.Mechanics
    dt: float = DT
    dtype: torch.dtype = torch.float32
    default: bool = False
    preset: str = ""

    @classmethod
    def of_preset(cls, name: str, scene: tf.Scene) -> Choice:
        """What `tf.preset(name, scene)` makes of a scene's mechanics."""
        made = tf.preset(name, scene).apply(scene)
        return cls("preset", mechanics_of(made), made.dt, preset=name)

    @property
    def words(self) -> str:
        """As a user would give it; of `Mechanics` what is not its default."""
        plain = tf.Mechanics(dim=self.mechanics.dim)
        turned = [
            f"{n}={value if isinstance(value, bool) else f'{value:g}'}"
            for n in KNOBS
            if (value := getattr(self.mechanics, n)) != getattr(plain, n)
        ]
        told = ", ".join(
            [f"dt={self.dt:g}", *turned, *(["float64"] if self.dtype == torch.float64 else [])]
        )
        return f"preset {self.preset}: {told}" if self.preset else told

    def scene(self, like: tf.Scene) -> tf.Scene:
        """The scene with these mechanics."""
        return tf.Scene(
            *(self.mechanics if isinstance(e, tf.Mechanics) else e for e in like.listed),
            dt=self.dt,
            founders=like.founders,
        )

    def start(self, state: tf.State) -> tf.State:
        """The state in this precision."""
        cast = lambda x: x.to(self.dtype) if x.is_floating_point() else x
        fields = {name: cast(value) for name, value in state.fields.items()}
        return state.replace(
            axis=cast(state.axis),
            length=cast(state.length),
            radius=cast(state.radius),
            fields=fields,
        )

    def rows(self, counter: RowCounter) -> float:
        """Rows that were read; one of a wall has half the numbers of one between cells, and counts
        half."""
        return counter.bytes / (2 * self.mechanics.degrees * torch.finfo(self.dtype).bits // 8)


# --- the order in Δt ------------------------------------------------------------------------------


STIFFNESS = 50.0  # μ·µm/h: two cells that overlap part at some 30/h
AGAROSE = 16.0
SLIDE = 0.4  # sine of the angle at which a line of contact has become a point
# above this step springs relax within one, and an order is not yet to be seen, h
ASYMPTOTIC = 0.025
RATE, LENGTH_DRAG = 1.0, 10.0


@dataclass(frozen=True)
class Motion:
    """Soft capsules in a viscous medium, dx/dt = M⁻¹ Σ forces, with dl/dt = max(0, what a cell
    wants + what pressure leaves of it).

    centre, axis (N, 3), length (N,). Contacts push with STIFFNESS times overlap at the closest
    points, or half of it at either end of the line along which cells lie side by side. walls: (z,
    +1 or −1 towards the cells, stiffness).
    """

    centre: ndarray
    axis: ndarray
    length: ndarray
    walls: Sequence[tuple[float, float, float]]

    @classmethod
    def of(cls, y: ndarray, walls: Sequence[tuple[float, float, float]]) -> Motion:
        n = y.size // 7
        return cls(y[: 3 * n].reshape(n, 3), y[3 * n : 6 * n].reshape(n, 3), y[6 * n :], walls)

    def velocity(self) -> ndarray:
        """Of centres, axes and lengths, (7 N,)."""
        force, torque, squeeze = (np.zeros_like(x) for x in (self.centre, self.axis, self.length))
        i, j = np.triu_indices(self.length.size, 1)
        near = (
            np.linalg.norm(self.centre[i] - self.centre[j], axis=1)
            < 0.5 * (self.length[i] + self.length[j]) + DIAMETER
        )
        i, j = i[near], j[near]
        for s, t, end_i, end_j in self._touching(i, j):
            arm_i, arm_j = s[:, None] * self.axis[i], t[:, None] * self.axis[j]
            between = self.centre[j] + arm_j - self.centre[i] - arm_i
            apart = np.linalg.norm(between, axis=1)
            push = (0.5 * STIFFNESS * np.maximum(0.0, DIAMETER - apart) / apart)[:, None] * between
            for cell, arm, end, on in ((i, arm_i, end_i, -push), (j, arm_j, end_j, push)):
                np.add.at(force, cell, on)
                np.add.at(torque, cell, np.cross(arm, on))
                np.add.at(squeeze, cell, 0.5 * end * (on * self.axis[cell]).sum(1))
        for z, up, stiffness in self.walls:
            for end in (0.5, -0.5):
                arm = end * self.length[:, None] * self.axis
                on = np.zeros_like(force)
                on[:, 2] = (
                    up
                    * stiffness
                    * np.maximum(0.0, 0.5 * DIAMETER - up * (self.centre[:, 2] + arm[:, 2] - z))
                )
                force, torque, squeeze = (
                    force + on,
                    torque + np.cross(arm, on),
                    squeeze + end * (on * self.axis).sum(1),
                )
        whole = (self.length + DIAMETER)[:, None]
        turning = np.cross(torque / (whole**3 / 12), self.axis)
        growth = np.maximum(0.0, RATE * (self.length + 2 / 3 * DIAMETER) + squeeze / LENGTH_DRAG)
        return np.concatenate([(force / whole).ravel(), turning.ravel(), growth])

    def _touching(
        self, i: ndarray, j: ndarray
    ) -> Iterator[tuple[ndarray, ndarray, ndarray, ndarray]]:
        """Two points of each pair, each with half the stiffness: where on either centreline, µm
        from its centre, and how far each is an end, −1 … 1."""
        u, v, half_i, half_j = (
            self.axis[i],
            self.axis[j],
            0.5 * self.length[i],
            0.5 * self.length[j],
        )
        dot = lambda a, b: (a * b).sum(-1)
        between, cosine = self.centre[j] - self.centre[i], dot(u, v)
        # on the first line, then cut to the segments one after the other
        sine2 = dot(np.cross(u, v), np.cross(u, v))
        s = np.clip(
            (dot(u, between) - cosine * dot(v, between)) / np.maximum(sine2, 1e-14), -half_i, half_i
        )
        free = cosine * s - dot(v, between)
        t = np.clip(free, -half_j, half_j)
        s = np.where(t == free, s, np.clip(cosine * t + dot(u, between), -half_i, half_i))
        way = np.where(cosine < 0, -1.0, 1.0)
        mean = u + way[:, None] * v
        mean /= np.linalg.norm(mean, axis=1)[:, None]
        lean, off = dot(u, mean), dot(between, mean)
        low, high = (
            np.maximum(-half_i * lean, off - half_j * lean),
            np.minimum(half_i * lean, off + half_j * lean),
        )
        # less of a line: short against the cells, or through a crossing, where its ends lie farther
        # off than the cells do
        apart = np.linalg.norm(between + t[:, None] * v - s[:, None] * u, axis=1)
        swing = np.maximum(0.5 * (high - low) * np.sqrt(sine2), 1e-30)
        slide = (
            np.maximum(0.0, 1 - sine2 / SLIDE**2) ** 2
            * np.clip((high - low) / (0.5 * DIAMETER), 0.0, 1.0)
            * np.minimum(1.0, apart / swing)
        )
        missing = [
            np.abs(x) - half
            for x, half in (
                (cosine * t + dot(between, u), half_i),
                (cosine * s - dot(between, v), half_j),
            )
        ]
        met_i, met_j = (
            np.sign(x) * np.clip(m / (0.5 * DIAMETER * slide + 1e-9), 0.0, 1.0)
            for x, m in zip((s, t), missing, strict=True)
        )
        for at, side in ((low, -1.0), (high, 1.0)):
            s1, t1 = (
                np.clip(at / lean, -half_i, half_i),
                np.clip(way * (at - off) / lean, -half_j, half_j),
            )
            # of the two cells' ends on this side the line stops at the nearer one; the other lies
            # farther along by so much
            goes_i, goes_j = half_i * lean - side * at, half_j * lean - side * (at - off)
            near_i, near_j = (
                side * np.maximum(0.0, 1 - goes / (0.5 * DIAMETER)) for goes in (goes_i, goes_j)
            )
            yield (
                s + slide * (s1 - s),
                t + slide * (t1 - t),
                met_i + slide * (near_i - met_i),
                met_j + slide * (way * near_j - met_j),
            )


def motion(
    state: tf.State, hours: float, walls: Sequence[tuple[float, float, float]], rtol: float = 1e-10
) -> dict[str, ndarray]:
    """Where the cells of a state are after some hours, by SciPy: position, axis (N, d), length
    (N,)."""
    flat = [
        np.pad(x.double().numpy(), ((0, 0), (0, 3 - state.dim))).ravel()
        for x in (state.position, state.axis)
    ]
    start = np.concatenate([*flat, state.length.double().numpy()])
    found = solve_ivp(
        lambda _, y: Motion.of(y, walls).velocity(),
        (0.0, hours),
        start,
        method="DOP853",
        rtol=rtol,
        atol=1e-2 * rtol,
    )
    if found.status != 0:
        raise RuntimeError(found.message)
    end = Motion.of(found.y[:, -1], walls)
    return {
        "position": end.centre[:, : state.dim],
        "axis": end.axis[:, : state.dim],
        "length": end.length,
    }


def apart(a: dict[str, ndarray], b: dict[str, ndarray]) -> dict[str, float]:
    """Root mean squares over cells."""
    rms = lambda name: float(
        np.sqrt(((a[name] - b[name]) ** 2).reshape(len(a["length"]), -1).sum(1).mean())
    )
    return {
        "position, µm": rms("position"),
        "direction, rad": rms("axis"),
        "length, µm": rms("length"),
    }


def cluster(dim: int, quick: bool) -> tuple[tf.Scene, tuple[tuple[float, float, float], ...]]:
    """Cells on a lattice, any way round, that touch and grow into each other; in space between a
    softer plane below and one above. And its walls in numbers."""
    across = ((3, 3) if quick else (4, 4)) if dim == 2 else ((2, 2, 2) if quick else (3, 3, 2))
    places = np.stack(
        np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in across), indexing="ij"), -1
    ).reshape(-1, dim)
    axes = np.random.default_rng(4).normal(size=places.shape)
    walls = () if dim == 2 else ((-1.3, 1.0, AGAROSE), (1.3, -1.0, STIFFNESS))
    planes = [
        tf.Plane(z=z, facing="+z" if up > 0 else "-z", stiffness=stiffness)
        for z, up, stiffness in walls
    ]
    cells = tf.Cells(1.5 * places, axes, 1.2)
    return (
        tf.Scene(
            tf.Growth(rate=RATE),
            tf.Mechanics(dim=dim, stiffness=STIFFNESS, walls=planes),
            founders=cells,
        ),
        walls,
    )


def refinements(plain: tf.Mechanics, hours: float, quick: bool) -> list[Choice]:
    """Steps, under several ways to solve them; in the plane, which is quick, other knobs at one
    step too."""
    tight = dataclasses.replace(plain, tolerance=1e-8)
    steps = [
        hours / n
        for n in (
            (8, 16, 32, 64) if quick else (4, 8, 16, 32, 64, 128, 256)[: 7 if plain.dim == 2 else 6]
        )
    ]
    several = [
        ("Δt", tight, torch.float64),
        ("Δt, unilateral", dataclasses.replace(tight, unilateral=True), torch.float64),
        ("Δt, default tolerance", plain, torch.float32),
    ]
    if plain.dim == 2 and not quick:
        several.insert(
            2, ("Δt, float32", dataclasses.replace(plain, tolerance=1e-4), torch.float32)
        )
    found = [
        Choice(name, mechanics, dt, dtype, mechanics is plain and dt == DT)
        for name, mechanics, dtype in several
        for dt in steps
    ]
    if quick:
        return [c for c in found if c.default or c.mechanics is not plain]
    if plain.dim == 3:
        return found
    found += [
        Choice("tolerance", dataclasses.replace(plain, tolerance=t), hours / 64) for t in TOLERANCES
    ]
    return found + [
        Choice("passes", dataclasses.replace(tight, passes=n), hours / 64, torch.float64)
        for n in (1, 2, 4)
    ]


def order(dim: int, quick: bool) -> Study:
    """Soft cells that stay the same cells: steps of Δt against their motion."""
    hours = 0.2 if quick else 0.4
    like, walls = cluster(dim, quick)
    first = like.seed(dtype=torch.float64)
    # the lattice lets go of its overlaps first: that takes no part in what is measured
    *_, first = tf.simulate(
        Choice("", dataclasses.replace(mechanics_of(like), tolerance=1e-6)).scene(like),
        first,
        until=0.1,
        dt=0.005,
    )
    ends = motion(first, hours, walls)
    doubt = max(apart(motion(first, hours, walls, 1e-8), ends).values())
    points = []
    for choice in refinements(mechanics_of(like), hours, quick):
        state, seconds, work = followed(choice, like, first, hours)
        found = {name: getattr(state, name).double().numpy() for name in ends}
        step = choice.dt if choice.series.startswith("Δt") and choice.dt <= ASYMPTOTIC else None
        points.append(
            Point(
                choice.series,
                choice.words,
                apart(found, ends),
                seconds,
                work,
                choice.default,
                step=step,
            )
        )
    return Study(
        "mechanics_order" + ("_3d" if dim == 3 else ""),
        f"Mechanics: soft cells in {'the plane' if dim == 2 else 'space, between soft planes'}",
        f"{first.cells} cells of stiffness {STIFFNESS:g} μ·µm/h, touching, grow for {hours:g} h and"
        " do not divide. Solved by SciPy to 1e-8 instead of 1e-10, the reference itself differs by"
        f" {doubt:.1g}. Orders are over steps up to {ASYMPTOTIC:g} h.",
        "root mean squares over cells, against the ordinary differential equation of the same"
        " cells, solved by SciPy (DOP853, rtol 1e-10)",
        WORK,
        ("position, µm", "length, µm"),
        points,
    )


def mechanics_of(scene: tf.Scene) -> tf.Mechanics:
    return next(e for e in scene.listed if isinstance(e, tf.Mechanics))


def followed(
    choice: Choice, like: tf.Scene, first: tf.State, hours: float
) -> tuple[tf.State, float, float]:
    """The state some hours later, and what it took: seconds (the median of several if short) and
    rows."""
    scene, start = choice.scene(like), choice.start(first)

    def run() -> tf.State:
        *_, state = tf.simulate(scene, start, until=start.time + hours)
        return state

    with RowCounter() as counter:
        state, seconds = timed(run, 1)
    if seconds < SHORT:
        _, seconds = timed(run)
    return state, seconds, choice.rows(counter)


# --- a window -------------------------------------------------------------------------------------


HOURS, LOOK = 0.4, 0.1  # the window, and how often it is looked at, h


def colonies(dim: int, quick: bool) -> tuple[tf.Scene, tf.State]:
    """Colonies of some 60 to 100 cells, grown with all defaults."""
    scene = tf.scenes.microcolony(dim=dim)
    *_, state = tf.simulate(
        scene, scene.seed(2 if quick else 8, seed=SEED), cells=8 if quick else 64
    )
    return scene, state


def tight(plain: tf.Mechanics, quick: bool) -> tuple[Choice, Choice]:
    """The reference and, to see what it is worth, a looser one; both of contacts that only push,
    another kind than the default."""
    base = dataclasses.replace(plain, unilateral=True, alpha=0.003, passes=4)
    dt, tolerance = (
        (0.0125, 1e-2) if quick else (0.005, 1e-3) if plain.dim == 2 else (0.00625, 1e-2)
    )
    fine, loose = (
        dataclasses.replace(base, tolerance=t, overlap=t) for t in (tolerance, 3 * tolerance)
    )
    return Choice("reference", fine, dt, torch.float64), Choice(
        "reference", loose, 2 * dt, torch.float64
    )


def one_by_one(plain: tf.Mechanics, quick: bool) -> list[Choice]:
    """Each knob alone; series of steps, α, passes and tolerances go through the default."""
    steps = (0.05, 0.025, 0.0125) if quick else (0.1, 0.05, 0.025, 0.0125, 0.00625)
    found = [Choice("Δt", plain, dt, default=dt == DT) for dt in steps]
    for series, knob, usual, values in (
        (
            "α",
            "alpha",
            0.1 / LENGTH_DRAG,
            (0.1, 0.01, 0.001) if quick else (0.1, 0.03, 0.01, 0.003, 0.001),
        ),
        ("passes", "passes", plain.most_passes, (1, 2) if quick else (1, 2, 4)),
        ("tolerance", "tolerance", TOLERANCE, (0.2, 0.05, 0.02) if quick else TOLERANCES),
    ):
        found += [
            Choice(
                series,
                plain if v == usual else dataclasses.replace(plain, **{knob: v}),
                default=v == usual,
            )
            for v in values
        ]
    found += [
        Choice("unilateral", dataclasses.replace(plain, unilateral=True, passes=n))
        for n in (None, 1)
    ]
    return [*found, Choice("float64", plain, dtype=torch.float64)]


def together(plain: tf.Mechanics, quick: bool) -> list[Choice]:
    """Several knobs at once."""
    if quick:
        return [
            Choice(
                "several", dataclasses.replace(plain, alpha=0.003, tolerance=0.02, passes=2), 0.0125
            )
        ]
    return [
        Choice(
            "several",
            dataclasses.replace(plain, alpha=alpha, passes=passes, tolerance=tolerance),
            dt,
        )
        for dt in (0.05, 0.025, 0.0125)
        for alpha in (0.1, 0.01, 0.001)
        for passes in (plain.most_passes, 2 * plain.most_passes)
        for tolerance in (0.2, 0.02)
    ]


def watched(
    choice: Choice, like: tf.Scene, first: tf.State
) -> tuple[dict[str, Tensor], float, float]:
    """What is measured of each colony over the window, (B,) each; seconds and rows."""
    scene, start, walls = choice.scene(like), choice.start(first), choice.mechanics.walls

    def run() -> list[tf.State]:
        every = round(LOOK / choice.dt)
        return [
            s
            for s in tf.simulate(scene, start, until=start.time + HOURS)
            if (s.step - start.step) % every == 0
        ]

    with RowCounter() as counter:
        states, seconds = timed(run, 1)
    if seconds < SHORT:
        _, seconds = timed(run)
    overlaps = [tf.measure.overlaps(s, walls) for s in states]
    found = {
        "overlap": torch.stack([o.mean for o in overlaps]).mean(0),
        "worst overlap": torch.stack([o.worst for o in overlaps]).max(0).values,
    }
    return found | shape(states[-1]), seconds, choice.rows(counter)


def shape(state: tf.State) -> dict[str, Tensor]:
    """Volume, radius, cells and, in space, depth of each colony, (B,) float64."""
    volume = state.groups.sum(state.volume.double().unsqueeze(1)).squeeze(1)
    found = {
        "volume": volume,
        "radius": tf.measure.colony_radius(state),
        "cells": state.counts.double(),
    }
    return found | ({"depth": tf.measure.depth(state).double()} if state.dim == 3 else {})


def wrong(
    found: dict[str, Tensor], reference: dict[str, Tensor], before: dict[str, Tensor]
) -> dict[str, float]:
    """Errors, means over colonies: overlaps over a diameter, what should not be there at all; of
    volume by its growth; others relative."""
    errors = {n: float(found[n].mean()) / DIAMETER for n in ("overlap", "worst overlap")}
    for name in before:
        scale = reference[name] - before[name] if name == "volume" else reference[name]
        errors[name] = float(((found[name] - reference[name]) / scale).abs().mean())
    return errors


def window(dim: int, quick: bool) -> Study:
    """Every setting goes on from one and the same state."""
    like, first = colonies(dim, quick)
    plain, before = mechanics_of(like), shape(first)
    fine, loose = tight(plain, quick)
    reference, fine_seconds, _ = watched(fine, like, first)
    doubt = wrong(watched(loose, like, first)[0], reference, before)
    points, seen = [], {}
    for choice in [
        *one_by_one(plain, quick),
        *together(plain, quick),
        Choice.of_preset("draft", like),
    ]:
        if choice.words not in seen:
            seen[choice.words] = watched(choice, like, first)
        found, seconds, work = seen[choice.words]
        points.append(
            Point(
                choice.series,
                choice.words,
                wrong(found, reference, before),
                seconds,
                work,
                choice.default,
            )
        )
    told = ", ".join(f"{name} {doubt[name]:.1g}" for name in before)
    return Study(
        "mechanics" + ("_3d" if dim == 3 else ""),
        "Mechanics: colonies in"
        f" {'the plane' if dim == 2 else 'space, between agarose and coverslip'}",
        f"{first.colonies} colonies of {int(first.counts.min())} to {int(first.counts.max())}"
        f" cells, grown with all defaults from one cell, go on for {HOURS:g} h with each setting."
        f" The reference ({fine.words}) took {fine_seconds:.0f} s; a looser one ({loose.words})"
        f" differs from it by: {told}.",
        "means over colonies: of overlapping pairs the mean overlap, and the worst, over a cell's"
        " diameter (hard cells have none); of volume over its growth in the window, of the others"
        " relative, against the reference",
        WORK,
        ("overlap", "volume", "radius"),
        points,
    )


# --- whole runs -----------------------------------------------------------------------------------


def local_order(state: tf.State) -> Tensor:
    """How well neighbours, less than half a radius apart, agree in direction, (B,): mean of cos 2Δθ
    in the plane, of P₂ in space; 0 at random, 1 parallel."""
    i, j, _ = tf.measure.neighbours(state, gap=0.25 * DIAMETER)
    cosine2 = (state.axis[i].double() * state.axis[j].double()).sum(1) ** 2
    agreed = (state.dim * cosine2 - 1) / (state.dim - 1)
    return torch.stack([agreed[state.colony[i] == b].mean() for b in range(state.colonies)])


def statistics(state: tf.State) -> dict[str, Tensor]:
    """Of each colony, (B,) float64: quantiles of the overlap among pairs that overlap are over a
    diameter."""
    i, _, gap = gaps_nearby(
        state.position, state.axis, state.length, state.radius, state.colony, state.colonies
    )
    depths = [-gap[(gap < 0) & (state.colony[i] == b)] / DIAMETER for b in range(state.colonies)]
    found = {name: value for name, value in shape(state).items() if name != "volume"}
    found |= {f"overlap, {q:.0%}": torch.stack([d.quantile(q) for d in depths]) for q in (0.5, 0.9)}
    return found | {"local order": local_order(state), "order": tf.measure.nematic_order(state)}


def difference(a: Tensor, b: Tensor) -> tuple[float, float]:
    """Of two means, and the half-width of its 95 % confidence band by Welch."""
    shares = [float(x.var()) / x.numel() for x in (a, b)]
    if not sum(shares):
        return float(a.mean() - b.mean()), 0.0
    freedom = sum(shares) ** 2 / sum(
        v * v / (x.numel() - 1) for v, x in zip(shares, (a, b), strict=True)
    )
    return float(a.mean() - b.mean()), float(stats.t.ppf(0.975, freedom)) * math.sqrt(sum(shares))


def ways(like: tf.Scene, quick: bool) -> list[Choice]:
    """Settings that whole runs are worth."""
    plain, draft = mechanics_of(like), Choice.of_preset("draft", like)
    change = lambda **knobs: dataclasses.replace(plain, **knobs)
    found = [Choice("Δt", plain, default=True), draft, Choice("α", change(alpha=0.1))]
    if quick:
        return found
    return [
        *found,
        Choice("Δt", plain, DT / 2),
        *(Choice("tolerance", change(tolerance=t)) for t in (0.2, 0.02)),
        Choice("unilateral", change(unilateral=True)),
        Choice("float64", plain, dtype=torch.float64),
        Choice("several", change(tolerance=0.2, alpha=0.1), draft.dt),
    ]


def whole(
    choice: Choice, hours: float, streams: Sequence[int]
) -> tuple[dict[str, Tensor], float, float]:
    """Statistics of colonies from one cell, a stream each, seconds and rows."""
    scene = choice.scene(tf.scenes.microcolony(dim=choice.mechanics.dim))
    start = scene.seed(len(streams), seed=SEED, streams=streams, dtype=choice.dtype)
    state, seconds, work = followed(choice, scene, start, hours)
    return statistics(state), seconds, work


def long(dim: int, quick: bool) -> Study:
    """Whole runs are chaotic, so what is compared is statistics over seeds, and the reference has
    seeds of its own."""
    like = tf.scenes.microcolony(dim=dim)
    # whole steps of all settings
    hours, count = (3.0, 3) if quick else (8.4 if dim == 2 else 7.4, 12)
    fine = Choice(
        "reference",
        dataclasses.replace(
            mechanics_of(like), alpha=0.003, passes=4, tolerance=0.005, overlap=0.02
        ),
        DT / 2,
    )
    reference, fine_seconds, _ = whole(fine, hours, range(100, 100 + count))
    points, seen = [], []
    for choice in ways(like, quick):
        found, seconds, work = whole(choice, hours, range(count))
        errors, band = {}, {}
        for name in reference:
            scale = 1.0 if name.startswith("overlap") else float(reference[name].mean())
            far, half = (x / scale for x in difference(found[name], reference[name]))
            errors[name], band[name] = abs(far), half
        points.append(
            Point(choice.series, choice.words, errors, seconds, work, choice.default, band=band)
        )
        other = [name for name in errors if errors[name] > band[name]]
        seen.append(f"{choice.words}: {', '.join(other) or 'none'}")
    cells = reference["cells"]
    return Study(
        "mechanics_long" + ("_3d" if dim == 3 else ""),
        f"Mechanics: whole runs in {'the plane' if dim == 2 else 'space'}, statistics over seeds",
        f"{count} colonies from one cell each, {hours:g} h. The reference ({fine.words};"
        f" {cells.mean():.0f} ± {cells.std():.0f} cells, {fine_seconds:.0f} s) has other seeds."
        f" Statistics that differ by more than their band, of {len(reference)} (by chance one in"
        f" twenty would): {'; '.join(seen)}.",
        "differences of means over colonies, ± Welch's 95 % confidence, relative; quantiles of"
        " overlap over a cell's diameter",
        WORK,
        ("radius", "overlap, 90%", "local order"),
        points,
    )


def studies(quick: bool) -> list[Study]:
    """The order in Δt, knobs over a short time, and statistics of whole runs, each in the plane and
    in space."""
    return [study(dim, quick) for study in (order, window, long) for dim in (2, 3)]
