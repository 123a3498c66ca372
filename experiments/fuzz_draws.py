"""The random scenes of experiments/fuzz.py as data: what a draw has, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st
from hypothesis.internal.conjecture.engine import ConjectureRunner

import torchfilm as tf

FLOATS = {"float32": torch.float32, "float64": torch.float64}
WALLS = (
    "plane",
    "tilted plane",
    "box",
    "half a box",
    "a box for each colony",
    "channel",
    "closed channel",
    "inside a sphere",
    "outside a sphere",
    "a post in a box",
)


@dataclass(frozen=True)
class Capsules:
    """Cells at the start.

    counts: in each colony. within: half the side of the cube that contains the centres, µm.
    lengths, radii: lower and upper bound, µm. place: seed of the positions.
    """

    counts: tuple[int, ...]
    within: float
    lengths: tuple[float, float]
    radii: tuple[float, float]
    dim: int
    place: int


@dataclass(frozen=True)
class Contacts:
    """Mechanics.

    give: α, or minus the stiffness, or None for the default. passes: None for the default. wall:
    kind of wall. margin: distance of the wall from the cube of centres, µm. wall_give: stiffness of
    the wall, or minus its weight, or None for a hard wall. uneven: each cell has its own viscosity,
    length drag and softness. elongation: µm in a sub-step, one-sided contacts only. tolerance: None
    for the default. drags: length drag and viscosity of each colony, in place of those of all; none
    if empty. sticks: strength of adhesion over viscosity · reach / Δt, µm; one-sided contacts only.
    periodic: the axes along which space is periodic; without walls and a medium only.
    """

    give: float | None
    length_drag: float
    viscosity: float
    contacts: str
    passes: int | None
    wall: str | None
    margin: float
    wall_give: float | None
    uneven: bool = False
    elongation: float = 0.25
    tolerance: float | None = None
    drags: tuple[tuple[float, float], ...] = ()
    sticks: float = 0.0
    periodic: str = ""


@dataclass(frozen=True)
class Growing:
    """Growth and division.

    rate: 1/h. varied: draw the rate of each cell between a third of `rate` and `rate`. criterion:
    quantity that triggers division. multiple: its threshold over the smallest allowed one.
    """

    rate: float
    law: str
    varied: bool
    criterion: str | None
    multiple: float
    fraction: float


@dataclass(frozen=True)
class Outside:
    """A medium with one signal.

    shape: voxels per axis. boundary: condition of the faces of each axis. flow: µm/h along x.
    outside: policy for cells outside. obstacle: whether a corner is solid.
    """

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    diffusion: float
    decay: float
    start: float
    boundary: tuple[str, ...]
    flow: float
    outside: str
    method: str | None
    obstacle: bool
    splitting: str


@dataclass(frozen=True)
class Beside:
    """Other effects.

    eating: cells grow on the signal, if there is one and growth is by volume. rule: action of a
    user rule. leaving: remove cells outside the cube in which they start. bursting: cells burst at
    random, and what a circuit makes in them goes to the signal, if there are both. moving: speed of
    cells that move by themselves, µm/h, or None.
    """

    eating: bool
    rule: str | None
    leaving: bool
    bursting: bool = False
    moving: float | None = None


@dataclass(frozen=True)
class Inside:
    """A circuit.

    kind: "hill" (one species represses another, both decay), "exchange" (a species and the signal
    through the membrane only) or "reactions". fast: rate of the fastest process, 1/h. power: Hill
    coefficient n. half: K. daughters, method: as in tf.Circuit.
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

    capsules: Capsules
    contacts: Contacts | None
    growing: Growing | None
    outside: Outside | None
    inside: Inside | None
    beside: Beside
    dt: float
    steps: int
    dtype: str
    seed: int


def for_each(
    draws: st.SearchStrategy[Any],
    count: int,
    seed: int,
    check: Callable[[Any], object],
    phases: Sequence[Phase] = tuple(Phase),
) -> None:
    """Calls check(draw) for `count` draws, each by itself, and reduces the first that it raises
    for, if that is among the phases."""
    given_draws = given(draws)(lambda draw: check(draw))
    every = settings(
        max_examples=count,
        phases=phases,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        print_blob=False,
    )(given_draws)
    # Hypothesis would follow each draw by five of its parts: five in six scenes would be near
    # copies of others
    with patch.object(ConjectureRunner, "generate_mutations_from", lambda self, data: None):
        seeded(seed)(every)()


def powers(low: int, high: int) -> st.SearchStrategy[float]:
    """Powers of ten, from 10^low to 10^high."""
    return st.integers(low, high).map(lambda k: 10.0**k)


CAPSULES = st.builds(
    Capsules,
    counts=st.lists(st.sampled_from([1, 2, 0, 3, 7, 12, 40]), min_size=1, max_size=3).map(tuple),
    within=st.sampled_from([5.0, 20.0, 2.0, 1.0, 1e4]),
    lengths=st.sampled_from([(2.0, 3.0), (0.0, 0.0), (0.0, 4.0), (1.0, 12.0)]),
    radii=st.sampled_from(
        [(0.5, 0.5), (0.2, 1.0), (0.05, 0.05), (2.0, 2.0), (0.4, 0.6), (0.05, 2.0)]
    ),
    dim=st.sampled_from([2, 3]),
    place=st.integers(0, 99),
)
CONTACTS = st.builds(
    Contacts,
    give=st.sampled_from([None, 0.1, 1e-6, 10.0, -1.0, -1e6]),
    length_drag=powers(-3, 7),
    viscosity=powers(-3, 3),
    contacts=st.sampled_from(("one-sided", "one-sided", "bilateral")),
    passes=st.sampled_from([None, 1, 4]),
    wall=st.sampled_from([None, *WALLS]),
    margin=st.sampled_from([1.0, 0.3, 1e-3, 10.0]),
    wall_give=st.sampled_from([None, 1.0, 1e4, -0.1, -1.0]),
    uneven=st.booleans(),
    elongation=st.sampled_from([0.25, 0.04, 2.0]),
    tolerance=st.sampled_from([None, 1e-6]),
    # as many as a draw may have colonies
    drags=st.just(()) | st.tuples(*[st.tuples(powers(0, 6), powers(-2, 2))] * 3),
    sticks=st.sampled_from([0.0, 0.0, 1.0, 1e2, 1e4]),
)
GROWING = st.builds(
    Growing,
    rate=st.sampled_from([1.0, 0.0, 1e-6, 20.0, 1e3]),
    law=st.sampled_from(["volume", "length", "linear"]),
    varied=st.booleans(),
    criterion=st.sampled_from([None, "length", "volume", "added"]),
    multiple=st.sampled_from([1.5, 1.0001, 10.0]),
    fraction=st.sampled_from([0.5, 0.2, 0.75]),
)
BOUNDARIES = {
    "closed": tf.NoFlux(),
    "periodic": tf.Periodic(),
    "open": tf.Open(0.5),
    "fixed": tf.Dirichlet(2.0),
    "layer": tf.Robin(2.0, 30.0),
    "fed": tf.Flux(5.0),
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
    bursting=st.sampled_from([False, False, True]),
    moving=st.sampled_from([None, None, None, 0.1, 10.0]),
)
NO_OTHERS = Beside(eating=False, rule=None, leaving=False)
TIMES = {
    "dt": st.sampled_from([0.01, 1e-4, 0.1, 1.0, 10.0]),
    "steps": st.integers(1, 4),
    "seed": st.integers(0, 2**40),
}
SCENES = st.builds(
    Draw,
    capsules=CAPSULES,
    contacts=st.none() | CONTACTS,
    growing=st.none() | GROWING,
    outside=st.none() | OUTSIDE,
    inside=st.none() | INSIDE,
    beside=BESIDE,
    dtype=st.sampled_from(list(FLOATS)),
    **TIMES,
).filter(lambda d: any(x is not None for x in (d.contacts, d.growing, d.outside, d.inside)))
# mechanics alone, mostly in the precision in which both paths must agree
PUSHING = st.builds(
    Draw,
    capsules=CAPSULES,
    contacts=st.builds(
        lambda c, axes: replace(
            c, contacts="one-sided", wall=None if axes else c.wall, periodic=axes
        ),
        CONTACTS,
        st.sampled_from(["", "", "", "x", "xy"]),
    ),
    growing=st.none() | GROWING,
    outside=st.none(),
    inside=st.none(),
    beside=st.builds(replace, st.just(NO_OTHERS), moving=st.sampled_from([None, None, 1.0])),
    dtype=st.sampled_from(["float64", "float64", "float32"]),
    **TIMES,
)
DRAWS = st.sampled_from([SCENES, SCENES, PUSHING]).flatmap(lambda drawn: drawn)
