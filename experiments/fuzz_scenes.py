"""Builds the scene of a random draw of experiments/fuzz.py."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from fuzz_draws import BOUNDARIES, FLOATS, Capsules, Contacts, Draw, Inside, Outside

import torchfilm as tf
from torchfilm.physics.walls import Wall

# cells grow by a factor of e^1.5 = 4.5 at most: the number of sub-steps costs time, not the rate
GROWN = 1.5


def cells(draw: Capsules, within: float) -> tf.Cells:
    """Returns random cells in a cube with sides of 2 · `within` µm."""
    rng, count = np.random.default_rng(draw.place), sum(draw.counts)
    position = rng.uniform(-within, within, (count, draw.dim))
    axis, colony = (
        rng.normal(size=(count, draw.dim)),
        np.repeat(np.arange(len(draw.counts)), draw.counts),
    )
    length, (thin, wide) = rng.uniform(*draw.lengths, count), draw.radii
    radius = thin * (wide / thin) ** rng.uniform(size=count)
    return tf.Cells(position, axis, length, radius, colony=colony)


def walls(draw: Contacts, capsules: Capsules) -> list[Wall]:
    """Returns the walls of a draw, all `margin` from the cube of centres."""
    dim, side = capsules.dim, capsules.within + draw.margin
    give: dict[str, Any] = {}
    if draw.wall_give is not None and draw.wall_give < 0:
        give = {"weight": -draw.wall_give}
    elif draw.wall_give is not None:
        give = {"stiffness": each(draw, draw.wall_give)}
    low, high = (-side,) * dim, (side,) * dim
    sides = side * (1 + 0.5 * torch.arange(len(capsules.counts), dtype=torch.float64))
    ends: dict[str, Any] = {"low_end": -side, "high_end": side}
    if dim == 3:
        ends["height"] = 2 * side
    post = (-side - 3.0, *(0.0,) * (dim - 1))
    made: dict[str | None, list[Wall]] = {
        None: [],
        "plane": [tf.Plane(x=-side, facing="+x", **give)],
        "tilted plane": [tf.Plane(point=low, normal=(1.0, 0.3, 0.2)[:dim], **give)],
        "box": [tf.Box(low, high, **give)],
        "half a box": [tf.Box(low, (math.inf, *high[1:]), **give)],
        "a box for each colony": [tf.Box((-sides,) * dim, (sides,) * dim, **give)],
        "channel": [tf.Channel(2 * side, low_end=-side, **give)],
        "closed channel": [tf.Channel(2 * side, **ends, **give)],
        "inside a sphere": [tf.Sphere((0.0,) * dim, math.sqrt(dim) * side, inside=True, **give)],
        "outside a sphere": [tf.Sphere(post, 3.0, inside=False, **give)],
        # the box is hard
        "a post in a box": [tf.Box(low, high), tf.Sphere(low, draw.margin, inside=False, **give)],
    }
    return made[draw.wall]


def each(draw: Contacts, value: float | torch.Tensor) -> Any:
    """Returns the value of all cells, or a value for each around it; `value` may be (B,)."""
    return tf.LogNormal(value, 1.0) if draw.uneven else value


def mechanics(draw: Contacts, capsules: Capsules, dt: float) -> tf.Mechanics:
    """Returns the contact mechanics of a draw."""
    given: dict[str, Any] = {}
    if draw.give is not None:
        given["alpha" if draw.give > 0 else "stiffness"] = abs(draw.give)
    if draw.contacts == "one-sided":
        given |= {"passes": draw.passes, "max_elongation": draw.elongation}
        least = min([draw.viscosity, *(viscosity for _, viscosity in draw.drags)])
        if draw.sticks:
            # the greatest of a drawn strength, e⁴ times its median, must be allowed in the least of
            # a drawn viscosity
            strength = draw.sticks * least * 0.2 / dt / (math.exp(8.0) if draw.uneven else 1.0)
            to = ("cells", "walls") if draw.wall else ("cells",)
            given["adhesion"] = [tf.Adhesion(each(draw, strength), 0.2, to=x) for x in to]
    length_drag, viscosity = draw.length_drag, draw.viscosity
    if draw.drags:
        columns = zip(*draw.drags[: len(capsules.counts)], strict=True)
        length_drag, viscosity = (torch.tensor(x, dtype=torch.float64) for x in columns)
    # far enough apart for the first cells; those that outgrow half of the way fail their colony
    side = max(capsules.within + draw.margin, 2.5 * (capsules.lengths[1] + 3 * capsules.radii[1]))
    made = tf.Mechanics(
        walls=walls(draw, capsules),
        periodic={axis: (-side, side) for axis in draw.periodic},
        dim=capsules.dim,
        viscosity=each(draw, viscosity),
        length_drag=length_drag if draw.contacts == "bilateral" else each(draw, length_drag),
        contacts=draw.contacts,
        max_iterations=300,
        tolerance=draw.tolerance,
        **given,
    )
    if draw.contacts == "one-sided":
        return made
    # with the overlap that goes with a number of passes
    return made.with_settings(tf.Settings(passes=draw.passes))


def growing(draw: Draw) -> list[tf.Effect]:
    """Returns growth and division of a draw."""
    assert draw.growing is not None
    g, r = draw.growing, draw.capsules.radii[1]
    # any rate is allowed; the bound limits the number of cells
    rate = min(g.rate, GROWN / (draw.dt * draw.steps))
    if eats(draw):
        out: list[tf.Effect] = [tf.Growth(), tf.Monod("ahl", rate=rate, half=0.1, growth_yield=0.5)]
    else:
        out = [tf.Growth(rate=tf.Uniform(rate / 3, rate) if g.varied and rate else rate, law=g.law)]
    if g.criterion is None:
        return out
    needed = 2 * r * (1 / min(g.fraction, 1 - g.fraction) - 1)  # for daughters of no length
    longest = max(needed, draw.capsules.lengths[1])
    least = {
        "length": longest,
        "volume": math.pi * r * r * (longest + 4 / 3 * r),
        "added": max(3 * r, needed),
    }[g.criterion]
    return [
        *out,
        tf.Division(
            **{g.criterion: tf.Uniform(least * g.multiple, 1.3 * least * g.multiple)},
            fraction=g.fraction,
        ),
    ]


def eats(draw: Draw) -> bool:
    """Whether cells grow on the signal."""
    return (
        draw.beside.eating
        and draw.outside is not None
        and draw.growing is not None
        and draw.growing.law == "volume"
    )


def rules(draw: Draw) -> list[tf.Effect]:
    """Returns a user rule that acts on some of the cells."""
    kind = draw.beside.rule

    def update(cells):
        some = cells.uid % 3 == 1
        if kind == "grow" and draw.growing is not None and not eats(draw):
            cells.growth_rate = torch.where(some, 0.5 * cells.growth_rate, cells.growth_rate)
        elif kind == "divide" and draw.growing is not None:
            cells.divide_flag = some & (cells.length > 4 * cells.radius)
        elif kind == "remove":
            cells.remove_flag = some & (cells.length > 2.5)
        elif kind == "read":
            cells.mark = cells.colony_sum(cells.volume) + cells.contact_count() + cells.random()

    return (
        []
        if kind is None
        else [tf.Rules(update, variables={"mark": 0.0} if kind == "read" else {})]
    )


def medium(draw: Outside, dim: int) -> tf.Medium:
    """Returns the medium of a draw."""
    size = [n * h for n, h in zip(draw.shape, draw.spacing, strict=True)]
    # off centre, so that no two faces coincide; the plane of the cells lies in the voxel layer
    low = [-0.47 * s for s in size]
    high = [a + s for a, s in zip(low, size, strict=True)]
    corner = torch.tensor([*high, 0.1][:3], dtype=torch.float64)
    still = {"open": tf.Open()} if not draw.flow else {}  # nothing outside is carried in
    faces = [{**BOUNDARIES, **still}[name] for name in draw.boundary]
    return tf.Medium(
        ahl=tf.Signal(
            diffusion=draw.diffusion,
            decay=draw.decay,
            initial=draw.start,
            reservoir=0.3 if draw.outside == "reservoir" else 0.0,
        ),
        box=(low, high),
        spacing=draw.spacing,
        boundary=tf.BoundaryConditions(*faces),
        flow=(draw.flow, 0.0) if draw.flow else None,
        outside=draw.outside,
        method=draw.method,
        splitting=draw.splitting,
        obstacles=(lambda x: (x > 0.5 * corner).all(1)) if draw.obstacle else None,
    )


def circuit(draw: Inside, outside: Outside | None) -> tf.Circuit:
    """Returns the circuit of a draw, which exchanges the signal if there is a medium."""
    signals = outside is not None
    options = {"daughters": draw.daughters, "initial": {"a": tf.Uniform(0.0, 2.0)}}

    def hill(u, s, p, cell):
        into = 50.0 * (s.ahl - u.a) * cell.area if signals else 0.0 * u.a
        rates = {
            "a": (
                1.0
                + draw.fast * tf.kinetics.activation(u.b, draw.half, draw.power)
                - draw.fast * u.a
                + into / cell.volume
            ),
            "b": 10.0 * tf.kinetics.repression(u.a, draw.half, draw.power) - u.b,
        }
        return (rates, {"ahl": -into}) if signals else rates

    def exchange(u, s, p, cell):
        into = draw.fast * (s.ahl - u.a) * cell.area if signals else 0.0 * u.a
        back = draw.fast * (u.b - 2.0 * u.a)
        return {"a": into / cell.volume + back, "b": -back}, ({"ahl": -into} if signals else {})

    if draw.kind == "reactions":
        # stochastic methods simulate single events: the bounds limit their number
        smooth, outer = (
            draw.method == "rosenbrock",
            (1.0 if outside is None else max(1.0, outside.start)),
        )
        fast = draw.fast if smooth else min(draw.fast, 10.0)
        pairing, inwards = (
            0.1 if smooth else 0.1 / outer,
            (0.1 / outer if draw.method == "direct" else 0.1),
        )
        passing = (
            [
                tf.Reaction.of("a -> out.ahl", rate=fast),
                tf.Reaction.of("out.ahl -> a", rate=inwards),
            ]
            if signals
            else []
        )
        parts = [
            tf.Reaction.of("a -> b", rate=fast),
            tf.Reaction.of("2 b -> a", rate=pairing),
            *passing,
        ]
        return tf.Circuit(parts, species=("a", "b"), method=draw.method, **options)
    return tf.Circuit(hill if draw.kind == "hill" else exchange, species=("a", "b"), **options)


def scene_of(draw: Draw) -> tuple[tf.Scene, tf.State]:
    """Returns the scene and its first state. Raises tf.InputError for an invalid draw."""
    effects: list[tf.Effect] = [] if draw.growing is None else growing(draw)
    effects += [] if draw.contacts is None else [mechanics(draw.contacts, draw.capsules, draw.dt)]
    effects += [] if draw.outside is None else [medium(draw.outside, draw.capsules.dim)]
    effects += [] if draw.inside is None else [circuit(draw.inside, draw.outside)]
    effects += rules(draw)
    if draw.beside.moving is not None:
        effects.append(
            tf.Motility(draw.beside.moving, reversals=0.1 / draw.dt, turning=1e-4 / draw.dt)
        )
    if draw.beside.bursting:
        both = draw.inside is not None and draw.outside is not None
        effects.append(tf.Lysis(rate=2.0, releases={"ahl": ("a", "b")} if both else None))
    if draw.beside.leaving:
        side = draw.capsules.within
        effects.append(tf.Removal((-side,) * draw.capsules.dim, (side,) * draw.capsules.dim))
    scene = tf.Scene(*effects, founders=tf.Cells.single(draw.capsules.dim))
    # growing grids of scattered cells need much memory; tests/test_fuzz.py tests this
    within = (
        min(draw.capsules.within, 20.0)
        if draw.outside is not None and draw.outside.outside == "grow"
        else draw.capsules.within
    )
    model = scene.bind(
        colonies=len(draw.capsules.counts),
        cells=cells(draw.capsules, within),
        seed=draw.seed,
        dtype=FLOATS[draw.dtype],
    )
    return scene, model.start()
