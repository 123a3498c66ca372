"""Work and precision of the contact mechanics.

Three studies, each in the plane and in space: the order in Δt (soft_cells.py), every knob over a
short time, and the statistics of whole runs. Soft cells obey a differential equation, which gives
their reference. Hard cells have none; there the reference has much harder contacts, a given α and a
tight solve. Pressure slows growth (length drag 10): so growth shows errors of contacts, and
bilateral contacts can be compared.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import torch
from contact_settings import (
    DIAMETER,
    DT,
    WORK,
    ContactSetting,
    followed,
    mechanics_of,
    timed_and_counted,
    with_passes,
)
from scipy import stats
from soft_cells import LENGTH_DRAG, order
from study import Point, Study
from torch import Tensor

import torchfilm as tf
from torchfilm.kernels.scheme import OVERLAP, PASSES, TOLERANCE
from torchfilm.physics.nearby import gaps_nearby

SEED = 1

# --- a window -------------------------------------------------------------------------------------

HOURS, SAMPLING = 0.4, 0.1  # h, the window and the interval between its samples


def _colony(dim: int) -> tf.Scene:
    return tf.scenes.microcolony(dim=dim, length_drag=LENGTH_DRAG)


def colonies(dim: int, quick: bool) -> tuple[tf.Scene, tf.State]:
    """Returns the scene and colonies of about 60 to 100 cells, grown with the default contacts."""
    scene = _colony(dim)
    size = {"colonies": 2 if quick else 8, "cells": 8 if quick else 64}
    state = tf.simulate(scene, seed=SEED, **size).last()
    return scene, state


def tight(plain: tf.Mechanics, quick: bool) -> tuple[ContactSetting, ContactSetting]:
    """Returns the reference and a looser one, whose difference shows the reference's own error.

    Both have a given α, so their contacts do not follow the force, unlike the default.
    """
    base = dataclasses.replace(plain, alpha=0.0003)
    dt, tolerance = (
        (0.0125, 1e-2) if quick else (0.005, 1e-3) if plain.dim == 2 else (0.00625, 1e-2)
    )
    fine, loose = (
        dataclasses.replace(base, tolerance=t, overlap=t) for t in (tolerance, 3 * tolerance)
    )
    return ContactSetting("reference", fine, dt, torch.float64), ContactSetting(
        "reference", loose, 2 * dt, torch.float64
    )


def _changed(plain: tf.Mechanics, knob: str, value: float) -> tf.Mechanics:
    if knob == "passes":
        return with_passes(plain, int(value))
    return dataclasses.replace(plain, **{knob: value})


def one_by_one(plain: tf.Mechanics, quick: bool) -> list[ContactSetting]:
    """Returns settings with one knob changed.

    The series of steps, overlaps, passes and tolerances include the default.
    """
    steps = (0.05, 0.025, 0.0125) if quick else (0.1, 0.05, 0.025, 0.0125, 0.00625)
    found = [ContactSetting("Δt", plain, dt, default=dt == DT) for dt in steps]
    for series, knob, usual, multiples in (
        ("overlap", "contact_overlap", OVERLAP, (10, 1) if quick else (10, 3, 1, 1 / 3, 0.1)),
        ("passes", "passes", PASSES, (1 / PASSES, 1)),
        ("tolerance", "tolerance", TOLERANCE, (3, 1, 0.3) if quick else (6, 3, 1, 0.3, 0.1, 0.01)),
    ):
        found += [
            ContactSetting(
                series, plain if m == 1 else _changed(plain, knob, m * usual), default=m == 1
            )
            for m in multiples
        ]
    bilateral = dataclasses.replace(plain, contacts="bilateral")
    found += [ContactSetting("bilateral", bilateral)]
    found += [ContactSetting("bilateral", with_passes(bilateral, n)) for n in (2, 4)]
    return [*found, ContactSetting("float64", plain, dtype=torch.float64)]


def together(plain: tf.Mechanics, quick: bool) -> list[ContactSetting]:
    """Returns settings with several knobs changed."""
    if quick:
        return [
            ContactSetting(
                "several",
                dataclasses.replace(plain, contact_overlap=0.3 * OVERLAP, tolerance=0.02),
                0.0125,
            )
        ]
    return [
        ContactSetting(
            "several",
            dataclasses.replace(plain, contact_overlap=overlap * OVERLAP, tolerance=tolerance),
            dt,
        )
        for dt in (0.05, 0.025, 0.0125)
        for overlap in (10.0, 1.0, 0.1)
        for tolerance in (0.2, 0.02)
    ]


def measured(
    choice: ContactSetting, like: tf.Scene, first: tf.State
) -> tuple[dict[str, Tensor], float, float]:
    """Returns the observables of each colony over the window, (B,) each, seconds and rows."""
    start, walls = choice.start(first), choice.mechanics.walls

    def run(scene: tf.Scene) -> list[tf.State]:
        every = round(SAMPLING / choice.dt)
        return [
            s
            for s in tf.simulate(scene, start, until=start.time + HOURS)
            if (s.step - start.step) % every == 0
        ]

    states, seconds, work = timed_and_counted(choice, like, run)
    overlaps = [tf.measure.overlaps(s, walls) for s in states]
    found = {
        "overlap": torch.stack([o.mean for o in overlaps]).mean(0),
        "worst overlap": torch.stack([o.worst for o in overlaps]).max(0).values,
    }
    return found | shape(states[-1]), seconds, work


def shape(state: tf.State) -> dict[str, Tensor]:
    """Returns volume, radius, cells and, in space, depth of each colony, (B,) float64."""
    volume = state.groups.sum(state.volume.double().unsqueeze(1)).squeeze(1)
    found = {
        "volume": volume,
        "radius": tf.measure.colony_radius(state),
        "cells": state.counts.double(),
    }
    return found | ({"depth": tf.measure.depth(state).double()} if state.dim == 3 else {})


def window_errors(
    found: dict[str, Tensor], reference: dict[str, Tensor], before: dict[str, Tensor]
) -> dict[str, float]:
    """Returns the errors, means over colonies.

    Overlaps are relative to a diameter; their exact value is 0. The error in volume is relative to
    the growth of the volume. Other errors are relative to the reference.
    """
    errors = {n: float(found[n].mean()) / DIAMETER for n in ("overlap", "worst overlap")}
    for name in before:
        scale = reference[name] - before[name] if name == "volume" else reference[name]
        errors[name] = float(((found[name] - reference[name]) / scale).abs().mean())
    return errors


def window(dim: int, quick: bool) -> Study:
    """Returns the study of every knob over a short window, from one common state."""
    like, first = colonies(dim, quick)
    plain, before = mechanics_of(like), shape(first)
    fine, loose = tight(plain, quick)
    reference, fine_seconds, _ = measured(fine, like, first)
    doubt = window_errors(measured(loose, like, first)[0], reference, before)
    points, runs = [], {}
    for choice in [
        *one_by_one(plain, quick),
        *together(plain, quick),
        ContactSetting.of_preset("draft", like),
    ]:
        if choice.label not in runs:
            runs[choice.label] = measured(choice, like, first)
        found, seconds, work = runs[choice.label]
        points.append(
            Point(
                choice.series,
                choice.label,
                window_errors(found, reference, before),
                seconds,
                work,
                choice.default,
            )
        )
    return Study(
        "mechanics" + ("_3d" if dim == 3 else ""),
        "Mechanics: colonies in"
        f" {'the plane' if dim == 2 else 'space, between agarose and coverslip'}",
        WORK,
        ("overlap", "volume", "radius"),
        points,
        {
            "colonies": first.colonies,
            "fewest": int(first.counts.min()),
            "most": int(first.counts.max()),
            "hours": HOURS,
            "reference": fine.label,
            "seconds": fine_seconds,
            "looser": loose.label,
            "doubt": ", ".join(f"{name} {doubt[name]:.1g}" for name in before),
        },
    )


# --- whole runs -----------------------------------------------------------------------------------


def local_order(state: tf.State) -> Tensor:
    """Returns how well neighbours closer than half a radius agree in direction, (B,).

    It is the mean of cos 2Δθ in the plane and of P₂ in space: 0 for random directions, 1 for
    parallel cells.
    """
    i, j, _ = tf.measure.neighbours(state, gap=0.25 * DIAMETER)
    cosine2 = (state.axis[i].double() * state.axis[j].double()).sum(1) ** 2
    agreed = (state.dim * cosine2 - 1) / (state.dim - 1)
    return torch.stack([agreed[state.colony[i] == b].mean() for b in range(state.colonies)])


def statistics(state: tf.State) -> dict[str, Tensor]:
    """Returns the statistics of each colony, (B,) float64.

    The quantiles are those of the overlap of overlapping pairs, over a diameter.
    """
    i, _, gap = gaps_nearby(
        state.position, state.axis, state.length, state.radius, state.colony, state.colonies
    )
    depths = [-gap[(gap < 0) & (state.colony[i] == b)] / DIAMETER for b in range(state.colonies)]
    found = {name: value for name, value in shape(state).items() if name != "volume"}
    found |= {f"overlap, {q:.0%}": torch.stack([d.quantile(q) for d in depths]) for q in (0.5, 0.9)}
    return found | {"local order": local_order(state), "order": tf.measure.nematic_order(state)}


def difference(a: Tensor, b: Tensor) -> tuple[float, float]:
    """Returns the difference of two means and the half-width of Welch's 95 % confidence band."""
    shares = [float(x.var()) / x.numel() for x in (a, b)]
    if not sum(shares):
        return float(a.mean() - b.mean()), 0.0
    freedom = sum(shares) ** 2 / sum(
        v * v / (x.numel() - 1) for v, x in zip(shares, (a, b), strict=True)
    )
    return float(a.mean() - b.mean()), float(stats.t.ppf(0.975, freedom)) * math.sqrt(sum(shares))


def run_settings(like: tf.Scene, quick: bool) -> list[ContactSetting]:
    """Returns the settings that whole runs compare."""
    plain, draft = mechanics_of(like), ContactSetting.of_preset("draft", like)
    change = lambda **knobs: dataclasses.replace(plain, **knobs)
    found = [
        ContactSetting("Δt", plain, default=True),
        draft,
        ContactSetting("overlap", change(contact_overlap=10 * OVERLAP)),
    ]
    if quick:
        return found
    return [
        *found,
        ContactSetting("Δt", plain, DT / 2),
        *(ContactSetting("tolerance", change(tolerance=t)) for t in (0.2, 0.02)),
        ContactSetting("bilateral", change(contacts="bilateral")),
        ContactSetting("float64", plain, dtype=torch.float64),
        ContactSetting("several", change(tolerance=0.2, contact_overlap=10 * OVERLAP), draft.dt),
    ]


def whole(
    choice: ContactSetting, hours: float, streams: Sequence[int]
) -> tuple[dict[str, Tensor], float, float]:
    """Returns statistics of colonies from one cell, one stream each; seconds and rows."""
    scene = choice.scene(_colony(choice.mechanics.dim))
    model = scene.bind(colonies=len(streams), seed=SEED, streams=streams, dtype=choice.dtype)
    state, seconds, work = followed(choice, scene, model.start(), hours)
    return statistics(state), seconds, work


def long(dim: int, quick: bool) -> Study:
    """Returns the study of whole runs.

    Whole runs are chaotic, so the study compares statistics over seeds. The reference has other
    seeds.
    """
    like = _colony(dim)
    # multiples of the steps of all settings
    hours, count = (3.0, 3) if quick else (8.4 if dim == 2 else 7.4, 12)
    # with a given α, as in `tight`, a solve of so many cells would take thousands of iterations
    plain = mechanics_of(like)
    hard = dataclasses.replace(plain, contact_overlap=0.1 * OVERLAP, tolerance=0.02)
    fine = ContactSetting("reference", hard, DT / 2)
    reference, fine_seconds, _ = whole(fine, hours, range(100, 100 + count))
    points = []
    for choice in run_settings(like, quick):
        found, seconds, work = whole(choice, hours, range(count))
        errors, band = {}, {}
        for name in reference:
            scale = 1.0 if name.startswith("overlap") else float(reference[name].mean())
            far, half = (x / scale for x in difference(found[name], reference[name]))
            errors[name], band[name] = abs(far), half
        points.append(
            Point(choice.series, choice.label, errors, seconds, work, choice.default, band=band)
        )
    cells = reference["cells"]
    return Study(
        "mechanics_long" + ("_3d" if dim == 3 else ""),
        f"Mechanics: whole runs in {'the plane' if dim == 2 else 'space'}, statistics over seeds",
        WORK,
        ("radius", "overlap, 90%", "local order"),
        points,
        {
            "colonies": count,
            "hours": hours,
            "reference": fine.label,
            "cells": float(cells.mean()),
            "cells_sd": float(cells.std()),
            "seconds": fine_seconds,
        },
    )


def studies(quick: bool) -> Iterator[Study]:
    """Runs all studies of the mechanics, one after the other."""
    for study in (order, window, long):
        for dim in (2, 3):
            yield study(dim, quick)
