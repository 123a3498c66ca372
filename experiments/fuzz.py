"""Random scenes that must behave: a fuzzer.

    python experiments/fuzz.py --examples 3000 --seed 1

Each example draws a scene (sizes, crowding, walls, α or stiffness, γ, growth, division, circuits
with Hill terms and stiff decay, signals on grids of odd shapes with faces, flow and obstacles,
steps from a second to hours) and runs it for a few steps under the laws of `run`. The first example
that breaks one is made smaller and printed as a `Draw`, which `run` takes again. docs/stability.md
lists what was found. tests/test_fuzz.py runs a hundred.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from dataclasses import dataclass

import numpy as np
import torch
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from torch import Tensor

import torchfilm as tf

FLOATS = {"float32": torch.float32, "float64": torch.float64}
# no scene wants its cells more than e^1.5 = 4.5 times as long: what costs is the number of
# sub-steps, not the rate
GROWN = 1.5


@dataclass(frozen=True)
class Capsules:
    """Cells at the start. counts: in each colony; within: half the side of the cube that holds
    their centres, µm; lengths: from, to, µm; radius µm."""

    counts: tuple[int, ...]
    within: float
    lengths: tuple[float, float]
    radius: float
    dim: int
    place: int


@dataclass(frozen=True)
class Contacts:
    """Mechanics. give: α, or minus the stiffness, or None; wall: a kind of wall, beyond µm from
    where centres are, with a stiffness or None."""

    give: float | None
    length_drag: float
    viscosity: float
    unilateral: bool
    passes: int | None
    wall: str | None
    beyond: float
    soft: float | None


@dataclass(frozen=True)
class Growing:
    """Growth and division. rate: 1/h, between a third of it and all of it, drawn at birth where
    `varied`; criterion and the threshold's multiple of the least that is allowed."""

    rate: float
    law: str
    varied: bool
    criterion: str | None
    multiple: float
    fraction: float


@dataclass(frozen=True)
class Outside:
    """A medium with one signal. shape: voxels an axis; faces an axis; flow: µm/h along x; outside:
    its policy; obstacle: whether a corner is solid."""

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    diffusion: float
    decay: float
    start: float
    faces: tuple[str, ...]
    flow: float
    outside: str
    method: str | None
    obstacle: bool
    splitting: str


@dataclass(frozen=True)
class Beside:
    """What else. eating: cells grow by the signal that they eat (where there is one to eat, and
    growth is by volume); rule: what a rule of the user's does; leaving: cells beyond 0.7 of where
    they start are removed."""

    eating: bool
    rule: str | None
    leaving: bool


@dataclass(frozen=True)
class Inside:
    """A circuit: "hill" (one species represses another, both decay), "exchange" (a species and the
    signal, through the membrane, nothing else), or "reactions". fast: 1/h of the fastest process;
    power: Hill's n; half: K; daughters and method as tf.Circuit's.
    """

    kind: str
    fast: float
    power: float
    half: float
    daughters: str
    method: str


@dataclass(frozen=True)
class Draw:
    """One example."""

    bodies: Capsules
    contacts: Contacts | None
    growing: Growing | None
    outside: Outside | None
    inside: Inside | None
    beside: Beside
    dt: float
    steps: int
    dtype: str
    seed: int


def powers(low: int, high: int) -> st.SearchStrategy[float]:
    """Powers of ten."""
    return st.integers(low, high).map(lambda k: 10.0**k)


BODIES = st.builds(
    Capsules,
    counts=st.lists(st.sampled_from([1, 2, 0, 3, 7, 12]), min_size=1, max_size=3).map(tuple),
    within=st.sampled_from([5.0, 20.0, 2.0, 1.0, 1e4]),
    lengths=st.sampled_from([(2.0, 3.0), (0.0, 0.0), (0.0, 4.0), (1.0, 12.0)]),
    radius=st.sampled_from([0.5, 0.05, 2.0]),
    dim=st.sampled_from([2, 3]),
    place=st.integers(0, 99),
)
CONTACTS = st.builds(
    Contacts,
    give=st.sampled_from([None, 0.1, 1e-6, 10.0, -1.0, -1e6]),
    length_drag=powers(-3, 5),
    viscosity=powers(-3, 3),
    unilateral=st.booleans(),
    passes=st.sampled_from([None, 1, 4]),
    wall=st.sampled_from([None, "plane", "box", "channel", "inside a sphere", "outside a sphere"]),
    beyond=st.sampled_from([1.0, 0.3, 1e-3, 10.0]),
    edge_width=st.sampled_from([None, 1.0, 1e4]),
)
GROWING = st.builds(
    Growing,
    rate=st.sampled_from([1.0, 0.0, 1e-6, 20.0, 1e3]),
    law=st.sampled_from(["volume", "length", "linear"]),
    varied=st.booleans(),
    criterion=st.sampled_from([None, "length", "volume", "added"]),
    multiple=st.sampled_from([1.5, 1.0001, 10.0]),
    fraction=st.sampled_from([0.5, 0.01, 0.999]),
)
BOUNDARIES = {
    "closed": tf.NoFlux(),
    "periodic": tf.Periodic(),
    "open": tf.Open(0.5),
    "fixed": tf.Dirichlet(2.0),
}
OUTSIDE = st.integers(2, 3).flatmap(
    lambda dim: st.builds(
        Outside,
        shape=st.tuples(*[st.sampled_from([4, 1, 2, 3, 7, 13])] * dim),
        spacing=st.tuples(*[st.sampled_from([2.0, 0.3, 9.0])] * dim),
        diffusion=st.sampled_from([0.0, 1.0, 1e-3, 1e3, 1e6]),
        decay=st.sampled_from([0.0, 1.0, 1e8]),
        start=st.sampled_from([0.0, 1.0, 1e-12, 1e6]),
        boundary=st.tuples(*[st.sampled_from(list(BOUNDARIES))] * 3),
        flow=st.sampled_from([0.0, 10.0, -1e4]),
        outside=st.sampled_from(["reservoir", "grow", "error"]),
        method=st.sampled_from([None, "implicit"]),
        obstacle=st.booleans(),
        splitting=st.sampled_from(["strang", "lie"]),
    )
)
INSIDE = st.builds(
    Inside,
    kind=st.sampled_from(["exchange", "hill", "reactions"]),
    fast=powers(-3, 8),
    power=st.sampled_from([1.0, 1.5, 8.0]),
    half=powers(-6, 3),
    daughters=st.sampled_from(["amount", "concentration"]),
    method=st.sampled_from(["rosenbrock", "tau_leap", "direct"]),
)
BESIDE = st.builds(
    Beside,
    eating=st.booleans(),
    rule=st.sampled_from([None, "grow", "divide", "remove", "read"]),
    leaving=st.sampled_from([False, False, True]),
)
DRAWS = st.builds(
    Draw,
    bodies=BODIES,
    contacts=st.none() | CONTACTS,
    growing=st.none() | GROWING,
    outside=st.none() | OUTSIDE,
    inside=st.none() | INSIDE,
    beside=BESIDE,
    dt=st.sampled_from([0.01, 1e-4, 0.1, 1.0, 10.0]),
    steps=st.integers(1, 4),
    dtype=st.sampled_from(list(FLOATS)),
    seed=st.integers(0, 2**40),
).filter(lambda d: any(x is not None for x in (d.contacts, d.growing, d.outside, d.inside)))


def cells(draw: Capsules, within: float) -> tf.Cells:
    """Cells in a cube of 2 · `within` µm."""
    rng, count = np.random.default_rng(draw.place), sum(draw.counts)
    position = rng.uniform(-within, within, (count, draw.dim))
    axis, colony = (
        rng.normal(size=(count, draw.dim)),
        np.repeat(np.arange(len(draw.counts)), draw.counts),
    )
    return tf.Cells(position, axis, rng.uniform(*draw.lengths, count), draw.radius, colony=colony)


def mechanics(draw: Contacts, bodies: Capsules) -> tf.Mechanics:
    dim, side = bodies.dim, bodies.within + draw.beyond
    walls: dict[str | None, list] = {
        None: [],
        "plane": [tf.Plane(x=-side, facing="+x", stiffness=draw.soft)],
        "box": [tf.Box((-side,) * dim, (side,) * dim, stiffness=draw.soft)],
        "channel": [tf.Channel(2 * side, low_end=-side, stiffness=draw.soft)],
        "inside a sphere": [
            tf.Sphere((0.0,) * dim, math.sqrt(dim) * side, inside=True, stiffness=draw.soft)
        ],
        "outside a sphere": [
            tf.Sphere((-side - 3.0,) + (0.0,) * (dim - 1), 3.0, inside=False, stiffness=draw.soft)
        ],
    }
    accuracy = (
        {}
        if draw.give is None
        else {"alpha": draw.give}
        if draw.give > 0
        else {"stiffness": -draw.give}
    )
    return tf.Mechanics(
        walls=walls[draw.wall],
        dim=dim,
        viscosity=draw.viscosity,
        length_drag=draw.length_drag,
        unilateral=draw.unilateral,
        passes=draw.passes,
        max_iterations=300,
        **accuracy,
    )


def growing(draw: Draw) -> list[tf.Effect]:
    assert draw.growing is not None
    g, r = draw.growing, draw.bodies.radius
    # what rates are allowed to be is no question here, only how many cells come of them
    rate = min(g.rate, GROWN / (draw.dt * draw.steps))
    if eats(draw):
        out: list[tf.Effect] = [tf.Growth(), tf.Monod("ahl", rate=rate, half=0.1, growth_yield=0.5)]
    else:
        out = [tf.Growth(rate=tf.Uniform(rate / 3, rate) if g.varied and rate else rate, law=g.law)]
    if g.criterion is None:
        return out
    longest = max(2 * r, draw.bodies.lengths[1])
    least = {"length": longest, "volume": math.pi * r * r * (longest + 4 / 3 * r), "added": 3 * r}[
        g.criterion
    ]
    return [
        *out,
        tf.Division(
            **{g.criterion: tf.Uniform(least * g.multiple, 1.3 * least * g.multiple)},
            fraction=g.fraction,
        ),
    ]


def eats(draw: Draw) -> bool:
    return (
        draw.beside.eating
        and draw.outside is not None
        and draw.growing is not None
        and draw.growing.law == "volume"
    )


def rules(draw: Draw) -> list[tf.Effect]:
    """A rule that does one of the things that rules do, to some of the cells."""
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
    size = [n * h for n, h in zip(draw.shape, draw.spacing, strict=True)]
    # off the middle, so that no face stands where another does; a signal's layer goes through the
    # cells' plane
    low = [-0.47 * s for s in size]
    high = [a + s for a, s in zip(low, size, strict=True)]
    corner = torch.tensor([*high, 0.1][:3], dtype=torch.float64)
    return tf.Medium(
        ahl=tf.Signal(
            diffusion=draw.diffusion, decay=draw.decay, initial=draw.start, reservoir=0.3
        ),
        box=(low, high),
        spacing=draw.spacing,
        boundary=tf.BoundaryConditions(*(BOUNDARIES[f] for f in draw.faces)),
        flow=(draw.flow, 0.0) if draw.flow else None,
        outside=draw.outside,
        method=draw.method,
        splitting=draw.splitting,
        obstacles=(lambda x: (x > 0.5 * corner).all(1)) if draw.obstacle else None,
    )


def circuit(draw: Inside, outside: Outside | None) -> tf.Circuit:
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
        # molecule by molecule a rate is a number of events: as many as one wants to wait for,
        # however many molecules come in
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
    """The scene and its first state; raises tf.InputError where the draw is no scene."""
    effects: list[tf.Effect] = [] if draw.growing is None else growing(draw)
    effects += [] if draw.contacts is None else [mechanics(draw.contacts, draw.bodies)]
    effects += [] if draw.outside is None else [medium(draw.outside, draw.bodies.dim)]
    effects += [] if draw.inside is None else [circuit(draw.inside, draw.outside)]
    effects += rules(draw)
    if draw.beside.leaving:
        side = 0.7 * draw.bodies.within
        effects.append(tf.Removal((-side,) * draw.bodies.dim, (side,) * draw.bodies.dim))
    scene = tf.Scene(*effects, founders=tf.Cells.single(draw.bodies.dim))
    # grids that follow scattered cells are a matter of memory, which tests/test_fuzz.py looks at
    within = (
        min(draw.bodies.within, 20.0)
        if draw.outside is not None and draw.outside.outside == "grow"
        else draw.bodies.within
    )
    return scene, scene.seed(
        len(draw.bodies.counts),
        cells=cells(draw.bodies, within),
        seed=draw.seed,
        dtype=FLOATS[draw.dtype],
    )


def run(draw: Draw) -> str:
    """Run an example under the laws; AssertionError, or an exception that is no InputError of the
    scene's making, is a find. Says how it ended: "refused" (at construction), "failed" (a colony
    was reported and dropped) or "ran"."""
    try:
        scene, state = scene_of(draw)
    except tf.InputError as error:
        assert len(str(error)) > 20, "an error should say what is not allowed"
        return "refused"
    ending = "ran"
    for _ in range(draw.steps):
        before, state = state, scene.step(state, draw.dt)
        counted(before, state)
        found = tf.failures(state)
        assert all(f.reason and f.hint for f in found)
        failed = sorted({f.place for f in found})
        if failed:
            ending = "failed"
        sound = [k for k in range(state.colonies) if k not in failed]
        finite(state, sound)
        if sound:
            walled(state.select(sound), draw)
            kept(before.select(sound), state.select(sound), draw)
            alone(scene, before, state, sound[-1], draw.dt)
        state = state.remove(
            torch.isin(state.colony, torch.tensor(failed, dtype=torch.int64)), "failed"
        )
    return ending


def counted(before: tf.State, after: tf.State) -> None:
    """Uids are unique in their colony and below its next; cells are those there were, less those
    that ended, and two for each that divided."""
    key = after.colony * 2**32 + after.uid
    assert torch.unique(key).numel() == after.cells, "uids are not unique"
    assert bool((after.uid < after.next_uid.index_select(0, after.colony)).all()), (
        "a uid is not below the next"
    )
    assert bool((after.colony.diff() >= 0).all()), "colonies are not side by side"
    births = sum(b.first.numel() for b in after.births)
    assert after.cells == before.cells + 2 * births - sum(e.uid.numel() for e in after.ended), (
        "cells do not add up"
    )
    assert torch.equal(after.counts, torch.bincount(after.colony, minlength=after.colonies)), (
        "counts are wrong"
    )
    assert bool((after.next_uid >= before.next_uid).all())


def finite(state: tf.State, sound: list[int]) -> None:
    """No number of any kind that is not one, in the colonies that did not fail; on grids nowhere,
    since they outlive a failure."""
    for name, value in state.signals.items():
        assert bool(torch.isfinite(value).all()), f"the signal {name} is not finite"
        assert bool((value >= 0).all()), f"the signal {name} is below 0: {float(value.min())}"
    if not sound:
        return
    part = state.select(sound)
    for name in ("position", "axis", "length", "radius", *part.fields):
        value = (
            getattr(part, name)
            if name in ("position", "axis", "length", "radius")
            else part.fields[name]
        )
        assert not value.is_floating_point() or bool(torch.isfinite(value).all()), (
            f"{name} is not finite"
        )
    assert bool(((part.axis.double().norm(dim=1) - 1).abs() <= 1e-6).all()), (
        "an axis is not of unit length"
    )
    assert bool((part.length >= 0).all()), "a length is below 0"
    for name in ("a", "b"):
        assert name not in part.fields or bool((part.fields[name] >= 0).all()), (
            f"the species {name} is below 0"
        )


def walled(state: tf.State, draw: Draw) -> None:
    """No cell's centre is behind a hard wall by more than its own reach (half its length and its
    radius), where α γ ≤ 1, the paper's choice or harder: as deep as cells of a crowd that starts on
    top of one another may be driven in one step, and no deeper.
    """
    c = draw.contacts
    if (
        c is None
        or c.wall is None
        or c.soft is not None
        or (c.give is not None and not 0 < c.give * c.length_drag <= 1)
    ):
        return
    reach = 0.5 * state.length.double() + state.radius.double()
    for surface in mechanics(c, draw.bodies).surfaces():
        distance, _ = surface.gap_of_points(state.position, state.own_colony_id)
        assert bool((distance >= -reach).all()), (
            f"a cell is {-float(distance.min()):g} µm behind the wall"
        )


def amounts(state: tf.State) -> Tensor:
    """What is conserved, molecules of `a`, of `b` and of the signal, conc·µm³ by colony, (B,)
    float64."""
    inside = sum(state.fields[n].double() for n in ("a", "b")) * state.circuit_volume.double()
    total = torch.zeros(state.colonies, dtype=torch.float64).index_add_(0, state.colony, inside)
    if state.layout is not None:
        grid = state.layout.grid
        total.index_add_(0, grid.owner, state.signals["ahl"].double() * grid.voxel_volume)
        if "ahl_reservoir" in state.fields:
            total += state.fields["ahl_reservoir"].double()
    return total


def kept(before: tf.State, after: tf.State, draw: Draw) -> None:
    """Amounts are what they were where nothing makes or takes them, to some roundings of the parts
    that they are the sum of, and to what the stiff solver's float64 can know: its matrix 2/h − J
    has a condition number of about 1 + h|J|."""
    i, o = draw.inside, draw.outside
    if (
        i is None
        or i.kind != "exchange"
        or i.daughters != "amount"
        or eats(draw)
        or draw.beside.leaving
        or draw.beside.rule == "remove"
    ):
        return
    if o is not None and (
        o.decay or o.flow or {"open", "fixed"} & set(o.faces) or (o.outside == "grow" and o.start)
    ):
        return
    then, now = amounts(before), amounts(after)
    around = float((after.area / after.volume).max()) if after.cells else 0.0
    stiff = 1.0 + draw.dt * i.fast * (3.0 + around)
    bound = 200 * torch.finfo(after.dtype).eps + 10 * torch.finfo(torch.float64).eps * stiff
    assert bool(((now - then).abs() <= bound * then + 1e-30).all()), (
        f"amounts changed by {float(((now - then) / then).abs().max()):g}"
    )


def alone(scene: tf.Scene, before: tf.State, after: tf.State, place: int, dt: float) -> None:
    """A colony by itself takes the same step, to the last bit."""
    one, same = scene.step(before.select([place]), dt), after.select([place])
    for name in ("uid", "parent", "position", "axis", "length", "radius", *same.fields):
        mine, its = (
            getattr(s, name) if name not in s.fields else s.fields[name] for s in (one, same)
        )
        assert torch.equal(mine, its), f"{name} of a colony alone is not what it is in the batch"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--examples", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    ended: dict[str, int] = {}
    slowest, number = (0.0, None), itertools.count(1)

    @seed(chosen.seed)
    @settings(
        max_examples=chosen.examples,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        print_blob=False,
    )
    @given(DRAWS)
    def every(draw: Draw) -> None:
        nonlocal slowest
        begun = time.perf_counter()
        how = run(draw)
        ended[how] = ended.get(how, 0) + 1
        slowest = max(slowest, (time.perf_counter() - begun, draw), key=lambda pair: pair[0])
        if next(number) % 500 == 0:
            print(ended, flush=True)

    every()
    print(
        f"{sum(ended.values())} examples, seed {chosen.seed}: {ended}; the slowest took"
        f" {slowest[0]:.1f} s: {slowest[1]}"
    )


if __name__ == "__main__":
    main()
