"""Order in Δt of the contact mechanics: soft cells against their own equations of motion.

Soft cells obey an ordinary differential equation. This module writes it again in NumPy and solves
it by SciPy, independently of torchfilm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from contact_settings import (
    DIAMETER,
    DT,
    TOLERANCES,
    WORK,
    ContactSetting,
    followed,
    mechanics_of,
    with_passes,
)
from numpy import ndarray
from scipy.integrate import solve_ivp
from study import Point, Study

import torchfilm as tf

STIFFNESS = 50.0  # μ·µm/h: two overlapping cells separate at about 30/h
AGAROSE = 16.0
SLIDE = 0.4  # sine of the angle at which a contact line has shrunk to a point
# h; at longer steps the springs relax within one step and no order is visible
ASYMPTOTIC = 0.025
RATE, LENGTH_DRAG = 1.0, 10.0


@dataclass(frozen=True)
class Motion:
    """Soft capsules in a viscous medium: dx/dt = M⁻¹ Σ forces, dl/dt = max(0, free growth +
    squeeze/γ), where squeeze is the (negative) force along the axis.

    centre, axis: (N, 3), µm and unit vectors; length: (N,), µm. A contact pushes with STIFFNESS
    times the overlap at the closest points. Cells that lie side by side touch along a line, with
    half of the force at each end. walls: (z, +1 or −1 towards the cells, stiffness).
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
        """Returns the velocities of centres, axes and lengths, (7 N,)."""
        force, torque, squeeze = (np.zeros_like(x) for x in (self.centre, self.axis, self.length))
        i, j = np.triu_indices(self.length.size, 1)
        near = (
            np.linalg.norm(self.centre[i] - self.centre[j], axis=1)
            < 0.5 * (self.length[i] + self.length[j]) + DIAMETER
        )
        i, j = i[near], j[near]
        for s, t, end_i, end_j in self._contact_points(i, j):
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

    def _contact_points(
        self, i: ndarray, j: ndarray
    ) -> Iterator[tuple[ndarray, ndarray, ndarray, ndarray]]:
        """Yields two contact points of each pair, each with half the stiffness.

        Each is: the places on both centrelines, µm from the centre, and for both cells how close
        the point is to an end, −1 … 1.
        """
        u, v, half_i, half_j = (
            self.axis[i],
            self.axis[j],
            0.5 * self.length[i],
            0.5 * self.length[j],
        )
        dot = lambda a, b: (a * b).sum(-1)
        between, cosine = self.centre[j] - self.centre[i], dot(u, v)
        # closest points of the lines, then clipped to the segments one after the other
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
        # a weaker line: one that is short compared with the cells, or one through a crossing, whose
        # ends are farther apart than the cells
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
            # the line ends at the nearer of the two cells' ends on this side; the other end lies
            # farther along by this distance
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
    """Returns position, axis (N, d) and length (N,) of the cells `hours` later, by SciPy.

    Raises RuntimeError if SciPy fails.
    """
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


def differences(a: dict[str, ndarray], b: dict[str, ndarray]) -> dict[str, float]:
    """Returns the differences of two results, root mean squares over cells."""
    rms = lambda name: float(
        np.sqrt(((a[name] - b[name]) ** 2).reshape(len(a["length"]), -1).sum(1).mean())
    )
    return {
        "position, µm": rms("position"),
        "direction, rad": rms("axis"),
        "length, µm": rms("length"),
    }


def cluster(dim: int, quick: bool) -> tuple[tf.Scene, tuple[tuple[float, float, float], ...]]:
    """Returns a scene of touching cells on a lattice, in random orientations, and its walls.

    In space the cells lie between a softer plane below and a stiffer one above. Each wall is (z,
    +1 or −1 towards the cells, stiffness), as in `Motion`.
    """
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
            tf.Mechanics(dim=dim, stiffness=STIFFNESS, walls=planes, length_drag=LENGTH_DRAG),
            founders=cells,
        ),
        walls,
    )


def refinements(plain: tf.Mechanics, hours: float, quick: bool) -> list[ContactSetting]:
    """Returns the settings: steps Δt for several solves; in the plane also other knobs at one
    step."""
    tight = dataclasses.replace(plain, tolerance=1e-8)
    steps = [
        hours / n
        for n in (
            (8, 16, 32, 64) if quick else (4, 8, 16, 32, 64, 128, 256)[: 7 if plain.dim == 2 else 6]
        )
    ]
    several = [
        ("Δt", dataclasses.replace(tight, contacts="bilateral"), torch.float64),
        ("Δt, one-sided", dataclasses.replace(tight, contacts="one-sided"), torch.float64),
        ("Δt, default tolerance", plain, torch.float32),
    ]
    if plain.dim == 2 and not quick:
        several.insert(
            2, ("Δt, float32", dataclasses.replace(plain, tolerance=1e-4), torch.float32)
        )
    found = [
        ContactSetting(name, mechanics, dt, dtype, mechanics is plain and dt == DT)
        for name, mechanics, dtype in several
        for dt in steps
    ]
    if quick:
        return [c for c in found if c.default or c.mechanics is not plain]
    if plain.dim == 3:
        return found
    found += [
        ContactSetting("tolerance", dataclasses.replace(plain, tolerance=t), hours / 64)
        for t in TOLERANCES
    ]
    return found + [
        ContactSetting("passes", with_passes(tight, n), hours / 64, torch.float64)
        for n in (1, 2, 4)
    ]


def order(dim: int, quick: bool) -> Study:
    """Returns the study of Δt: soft cells that do not divide against their equations of motion."""
    hours = 0.2 if quick else 0.4
    like, walls = cluster(dim, quick)
    first = like.bind(dtype=torch.float64).start()
    # the lattice first relaxes its overlaps, which is not measured
    *_, first = tf.simulate(
        ContactSetting("", dataclasses.replace(mechanics_of(like), tolerance=1e-6)).scene(like),
        first,
        until=0.1,
        dt=0.005,
    )
    ends = motion(first, hours, walls)
    doubt = max(differences(motion(first, hours, walls, 1e-8), ends).values())
    points = []
    for choice in refinements(mechanics_of(like), hours, quick):
        state, seconds, work = followed(choice, like, first, hours)
        found = {name: getattr(state, name).double().numpy() for name in ends}
        step = choice.dt if choice.series.startswith("Δt") and choice.dt <= ASYMPTOTIC else None
        points.append(
            Point(
                choice.series,
                choice.label,
                differences(found, ends),
                seconds,
                work,
                choice.default,
                step=step,
            )
        )
    return Study(
        "mechanics_order" + ("_3d" if dim == 3 else ""),
        f"Mechanics: soft cells in {'the plane' if dim == 2 else 'space, between soft planes'}",
        WORK,
        ("position, µm", "length, µm"),
        points,
        {"cells": first.cells, "hours": hours, "doubt": doubt},
    )
