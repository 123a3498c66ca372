"""Cells that stick together: what a pair does, whom it holds, and that nothing else changes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import (
    array,
    check_always,
    check_same_bits_alone,
    crowd,
    growth,
    mechanics,
    pair_gaps,
    run,
    seeded,
    step,
)

import torchfilm as tf
from torchfilm.tools.checks import InputError, SimulationError
from torchfilm.tools.tangents import forward_mode

BACKENDS = pytest.mark.parametrize("backend", ["compiled", "torch"])
ENDS = {2: ((1.0, 0.0), (1.0, 0.0)), 3: ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))}


def pair(gap: float, dim: int = 2, extra: dict | None = None, **given) -> tf.Cells:
    """Two cells, the second's side or end at this gap from the first one's end; 3 µm long in all,
    and 1 µm wide."""
    across = 1.0 if dim == 2 else 0.0
    first = np.zeros(dim)
    second = np.eye(dim)[0] * (2.0 + across + gap)
    return tf.Cells([first, second], ENDS[dim], 2.0, extra=extra or {}, **given)


def gap_of(state: tf.State) -> float:
    return float(pair_gaps(state, np.array([[0, 1]]))[0])


def stuck(cells: tf.Cells, *kinds: tf.Adhesion, dt: float = 0.02, **given) -> tf.Scene:
    return tf.Scene(
        tf.Mechanics(dim=len(cells.position[0]), adhesion=kinds, tolerance=1e-6, **given),
        founders=cells,
        dt=dt,
    )


@BACKENDS
@pytest.mark.parametrize("dim", [2, 3])
def test_a_pair_closes_as_the_implicit_step_says(backend, dim):
    """Two cells of drag μL = 3 and a bond of stiffness 500: the gap falls by 1 + 2·500·Δt/3 a step.
    Nothing turns: each pull passes through both centres."""
    scene = stuck(pair(0.08, dim), tf.Adhesion(50.0), backend=backend)
    state = scene.bind(dtype=torch.float64).start()
    gap = gap_of(state)
    for _ in range(4):
        state, gap = step(scene, state, 0.02), gap / (1 + 2 * 500 * 0.02 / 3)
        assert gap_of(state) == pytest.approx(gap, rel=1e-5)
    assert float((state.axis - torch.tensor(ENDS[dim]).double()).abs().max()) < 1e-9


@pytest.mark.parametrize("dt", [0.02, 0.002])
def test_its_law_does_not_follow_the_step(dt):
    """exp(−2kt/μL) within the error of implicit Euler, (k Δt/μL)² · 2n."""
    scene = stuck(pair(0.08), tf.Adhesion(5.0), dt=dt)
    state = scene.bind(dtype=torch.float64).start()
    steps = round(0.04 / dt)
    for _ in range(steps):
        state = step(scene, state, dt)
    rate = 2 * 50.0 / 3
    error = gap_of(state) / (0.08 * math.exp(-rate * 0.04)) - 1
    assert abs(error) <= 0.5 * (rate * dt) ** 2 * steps * 1.05


@BACKENDS
def test_beyond_its_reach_a_pair_is_free(backend):
    for gap, moves in ((0.0999, True), (0.1001, False)):
        scene = stuck(pair(gap), tf.Adhesion(50.0), backend=backend)
        start = scene.bind(dtype=torch.float64).start()
        state = step(scene, start, 0.02)
        assert (gap_of(state) < gap - 1e-3) == moves
        assert moves or bool((state.position == start.position).all())


@BACKENDS
def test_a_long_reach_holds_across_a_wide_gap(backend):
    """Rows are made for pairs nearer than 0.3 µm, and for those within the reach."""
    scene = stuck(pair(0.9), tf.Adhesion(50.0, reach=1.0), backend=backend)
    state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
    assert gap_of(state) == pytest.approx(0.9 / (1 + 2 * 50 * 0.02 / 3), rel=1e-5)


def strength_of(first: dict, kind: tf.Adhesion) -> float:
    """The strength of a pair, found from how far its gap closes in a step."""
    extra = {name: list(values) for name, values in first.items() if name != "cell_type"}
    cells = pair(0.05, extra=extra, cell_type=first.get("cell_type", [0, 0]))
    scene = stuck(cells, kind)
    state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
    return (0.05 / gap_of(state) - 1) * 3 / (2 * 0.02) * kind.reach


@pytest.mark.parametrize(
    "first, kind, wanted",
    [
        ({"cell_type": [0, 1]}, tf.Adhesion({0: 40.0, 1: 10.0}), 20.0),
        ({"cell_type": [1, 1]}, tf.Adhesion({0: 40.0, 1: 10.0}), 10.0),
        ({"cell_type": [0, 1]}, tf.Adhesion({0: 40.0, 1: 0.0}), 0.0),
        ({"a": [2.0, 3.0]}, tf.Adhesion(5.0, adhesin="a"), 30.0),
        ({"a": [2.0, 0.0]}, tf.Adhesion(5.0, adhesin="a"), 0.0),
        ({"a": [2.0, 0.5], "b": [4.0, 3.0]}, tf.Adhesion(5.0, adhesin="a", partner="b"), 40.0),
        ({"a": [2.0, 2.0], "b": [0.0, 0.0]}, tf.Adhesion(5.0, adhesin="a", partner="b"), 0.0),
    ],
)
def test_what_both_cells_have_decides(first, kind, wanted):
    assert strength_of(first, kind) == pytest.approx(wanted, rel=1e-4, abs=1e-9)


THREE = [40.0, 10.0, 20.0]


@pytest.mark.parametrize(
    "strength",
    [
        {0: 40.0, 1: 10.0}, THREE, {0: THREE, 1: 5.0}, tf.PerColony(THREE), torch.tensor(10.0),
        tf.Uniform(10.0, 40.0), {0: tf.Uniform(10.0, 40.0), 1: 5.0},
    ],
)  # fmt: skip
def test_every_kind_of_value_runs_and_is_explained(strength):
    scene = stuck(pair(0.05, cell_type=[0, 1]), tf.Adhesion(strength))
    *_, state = tf.simulate(scene, until=0.04, colonies=3)
    assert bool((pair_gaps(state, np.array([[0, 1], [2, 3], [4, 5]])) < 0.04).all())
    assert "adhesion: a pull of" in str(tf.explain(scene, colonies=3))
    by_type = strength.values() if isinstance(strength, dict) else ()
    listed = isinstance(strength, list | tf.PerColony) or THREE in by_type
    assert any("adhesion" in path for path, _ in scene.per_colony()) == listed


@BACKENDS
@pytest.mark.parametrize("angle, half", [(2, 0.5), (5, 1.5), (10, 1.5), (10, 3.0), (30, 1.5)])
@pytest.mark.parametrize("gap", [0.0, 0.05])
def test_a_pair_at_an_angle_pulls_at_most_with_its_strength(backend, angle, half, gap):
    """Nearly parallel cells hold on to each other at two places, each with half of the strength,
    where these are within the reach."""
    turn, r = math.radians(angle), 0.5
    along = np.array([math.cos(turn), math.sin(turn)])
    cells = tf.Cells(
        [[0.0, 0.0], np.array([-half, 2 * r + gap]) + half * along], [[1.0, 0.0], along], 2 * half
    )
    scene = stuck(cells, tf.Adhesion(100.0), dt=1e-6, backend=backend)
    start = scene.bind(dtype=torch.float64).start()
    state = step(scene, start, 1e-6)
    force = float((state.position - start.position)[1].norm()) / 1e-6 * (2 * half + 1)
    assert force <= 100.0 * 1.001
    assert gap == 0.0 or force >= (24.9 if 2 < angle < 25 else 49.9)


def test_two_kinds_add_up():
    kinds = tf.Adhesion(30.0), tf.Adhesion(5.0, reach=0.2, adhesin="a")
    for gap, stiffness in ((0.05, 300 + 25 * 4), (0.15, 25 * 4)):
        scene = stuck(pair(gap, extra={"a": [2.0, 2.0]}), *kinds)
        state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
        assert gap_of(state) == pytest.approx(gap / (1 + 2 * stiffness * 0.02 / 3), rel=1e-5)


@BACKENDS
@pytest.mark.parametrize("dim", [2, 3])
def test_without_strength_cells_move_as_without_adhesion(backend, dim):
    """Two kinds: one of strength 0, the other of cells without adhesin. To the tolerance of the
    solves: contacts are looked for farther, which adds rows that do not push."""
    cells = crowd(np.random.default_rng(3), 40, dim)
    cells = tf.Cells(
        cells.position, cells.axis, cells.length, cells.radius, extra={"a": [0.0] * 40}
    )
    kinds = [tf.Adhesion(0.0), tf.Adhesion(50.0, adhesin="a")]
    ends = []
    for adhesion in ([], kinds):
        scene = tf.Scene(
            growth(),
            tf.Mechanics(dim=dim, adhesion=adhesion, backend=backend, tolerance=1e-9),
            founders=cells,
        )
        ends.append(run(scene, scene.bind(dtype=torch.float64).start(), 5, 0.02))
    assert float((ends[0].position - ends[1].position).abs().max()) <= 1e-6


@BACKENDS
@pytest.mark.parametrize("dim", [2, 3])
def test_it_moves_no_centre_of_mass_and_turns_no_colony(backend, dim):
    """As of contacts: Σ μL Δc = 0 and Σ (μL c × Δc + μL³/12 Δθ) = 0 after one solve."""
    given = {"dim": dim, "contacts": "one-sided", "passes": 1, "tolerance": 1e-11}
    scene = tf.Scene(mechanics(**given, backend=backend, adhesion=[tf.Adhesion(50.0, reach=0.2)]))
    start = seeded(scene, crowd(np.random.default_rng(5), 60, dim), "cpu", torch.float64)
    free = tf.Scene(mechanics(**given, backend=backend))
    state, other = step(scene, start, 0.01), step(free, start, 0.01)
    assert float((state.position - other.position).abs().max()) > 0.01
    assert not (state.reports["mechanics"].clipped > 0).any()
    move, whole = array(state.displacement), array(start.length) + 1.0
    force, c = whole[:, None] * move[:, :dim], array(start.position)
    turning = whole[:, None] ** 3 / 12
    arm = (c[:, :1] * force[:, 1:] - c[:, 1:] * force[:, :1]) if dim == 2 else np.cross(c, force)
    assert np.abs(force.sum(0)).max() <= 1e-9
    assert np.abs((arm + turning * move[:, dim:-1]).sum(0)).max() <= 1e-8


@pytest.mark.parametrize("dim, parts", [(2, 1), (3, 1), (2, 3), (3, 3)])
def test_compiled_and_torch_agree(dim, parts):
    """A growing, motile crowd in float64, to the tolerance of the solves, before decisions by last
    bits; also in three sub-steps."""
    ends = []
    for backend in ("compiled", "torch"):
        scene = tf.Scene(
            growth(),
            tf.Motility(5.0, reversals=1.0, turning=0.05),
            mechanics(
                dim=dim, contacts="one-sided", tolerance=1e-8, backend=backend,
                adhesion=[tf.Adhesion(100.0, reach=0.2)],
                max_elongation=0.25 if parts == 1 else 0.01,
            ),
        )  # fmt: skip
        start = seeded(scene, crowd(np.random.default_rng(8), 50, dim), "cpu", torch.float64)
        ends.append(run(scene, start, 3, 0.01))
    assert int(ends[0].reports["mechanics"].substeps.max()) == parts
    assert array((ends[0].position - ends[1].position).abs()).max() <= 1e-9


@BACKENDS
def test_same_bits_alone_and_in_a_batch(backend):
    scene = tf.Scene(
        growth(),
        tf.Mechanics(dim=2, backend=backend, adhesion=[tf.Adhesion(100.0, reach=0.2)]),
        tf.Division(length=3.0),
        founders=crowd(np.random.default_rng(8), 12, 2),
        dt=0.02,
    )
    check_same_bits_alone(scene, until=0.4, seed=4)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dt", [0.1, 0.025])
def test_strong_bonds_hold_in_growth(dt, dim):
    """At the usual strengths, and at the most that is allowed, a colony grows as without adhesion,
    and its contacts are clean: bonds pull only cells that are apart. From 2 to 64 cells and more.
    """
    grown = []
    for strength in (0.0, 100.0, 2.5e4 * 0.1 / dt):
        scene = tf.Scene(
            tf.Growth(1.0),
            tf.Mechanics(dim=dim, adhesion=[tf.Adhesion(strength)] if strength else []),
            tf.Division(length=tf.Uniform(3.0, 4.0)),
            founders=tf.Cells(np.eye(dim)[1] * [[0.0], [1.05]], [np.eye(dim)[0]] * 2, 2.0),
            dt=dt,
        )
        overlaps = []
        for state in tf.simulate(scene, until=4.0, seed=2):
            check_always(state)
            overlaps.append(float(tf.measure.overlaps(state).mean.max()))
        grown.append(float(state.volume.sum()))
        assert np.mean(overlaps) <= 0.01 and state.cells >= 64
    assert grown[1] == pytest.approx(grown[0], rel=0.02)
    assert grown[2] == pytest.approx(grown[0], rel=0.02)


def test_gradients_pass_through_strength_and_levels():
    """Against central differences, in float64."""

    def loss(strength: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
        cells = tf.Cells(
            [[0.0, 0.0], [3.05, 0.1], [0.3, 1.06]], [[1, 0], [1, 0], [1, 0]], 2.0,
            extra={"a": [1.0, 2.0, 1.5]},
        )  # fmt: skip
        scene = stuck(cells, tf.Adhesion(strength, reach=0.2, adhesin="a"), backend="torch")
        state = scene.bind(dtype=torch.float64).start()
        state = state.with_fields(a=state.a * level)
        for _ in range(2):
            state = step(scene, state, 0.02)
        return (state.position * torch.tensor([[1.0, 2.0], [-3.0, 1.0], [0.5, -1.0]])).sum()

    given = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (8.0, 1.0)]
    found = torch.autograd.grad(loss(*given), given)
    for k, (x, slope) in enumerate(zip(given, found, strict=True)):
        h = 1e-4 * float(x.detach())
        sides = []
        for sign in (1, -1):
            moved = [y.detach() + sign * h * (j == k) for j, y in enumerate(given)]
            sides.append(float(loss(*moved)))
        assert float(slope) == pytest.approx((sides[0] - sides[1]) / (2 * h), rel=1e-3)
        assert abs(float(slope)) > 1e-4


def test_a_level_that_is_no_number_fails_its_colony():
    cells = pair(0.05, extra={"a": [1.0, 1.0]})
    scene = tf.Scene(
        tf.Rules(_spoil), tf.Mechanics(dim=2, adhesion=[tf.Adhesion(10.0, adhesin="a")]),
        founders=cells, dt=0.02,
    )  # fmt: skip
    with pytest.raises(SimulationError, match="colony 1"):
        list(tf.simulate(scene, until=0.1, colonies=2, seed=0))


def _spoil(cells):
    # no rule may write such a number; a difference of infinities may still come of one
    cells.a = torch.where(cells.colony == 1, cells.a * 1e300 * 1e300, cells.a)


@pytest.mark.parametrize(
    "made, words",
    [
        (lambda: tf.Adhesion(-1.0), r"Adhesion.strength = -1"),
        (
            lambda: list(tf.simulate(stuck(pair(0.1), tf.Adhesion(1e7)), until=0.1)),
            r"strength = 10000000.0 is not allowed: it must be at most 1.25e\+05",
        ),
        (lambda: tf.Adhesion(1.0, reach=0.0), r"Adhesion.reach = 0"),
        (lambda: tf.Adhesion(1.0, reach=math.inf), r"Adhesion.reach = inf"),
        (lambda: tf.Adhesion(1.0, partner="b"), r"Adhesion.partner = 'b'"),
        (lambda: tf.Adhesion(1.0, adhesin="b", partner="b"), r"Adhesion.partner = 'b'"),
        (lambda: tf.Adhesion(1.0, adhesin="2b"), r"Adhesion.adhesin = '2b'"),
        (lambda: tf.Mechanics(adhesion=tf.Adhesion(1.0)), r"Write adhesion=\[Adhesion"),
        (lambda: tf.Mechanics(adhesion=[1.0]), r"a list of tf.Adhesion"),
        (lambda: tf.Mechanics(adhesion=1.0), r"Mechanics.adhesion = 1.0 .* a list of tf.Adhesion"),
        (lambda: tf.Mechanics(walls=None), r"Mechanics.walls = None .* a list of Plane"),
        (
            lambda: tf.Mechanics(adhesion=[tf.Adhesion(1.0)], contacts="bilateral"),
            r"left out with bilateral contacts",
        ),
        (
            lambda: stuck(pair(0.1), tf.Adhesion(1.0, adhesin="ag43")).bind(),
            r"needs the field 'ag43'",
        ),
        (
            lambda: stuck(pair(0.1, extra={"a": [1, -1]}), tf.Adhesion(1.0, adhesin="a")).bind(),
            r"a of a first cell is below 0",
        ),
    ],
)
def test_bad_input(made, words):
    with pytest.raises(InputError, match=words):
        made()


@BACKENDS
def test_infinity_times_nothing_fails_too(backend):
    scene = stuck(
        pair(0.05, extra={"a": [1.0, 0.0]}), tf.Adhesion(10.0, adhesin="a"), backend=backend
    )
    state = scene.bind(dtype=torch.float64).start()
    state = step(scene, state.with_fields(a=torch.tensor([math.inf, 0.0]).double()), 0.02)
    assert ["not finite" in failure.reason for failure in tf.failures(state)] == [True]


@BACKENDS
def test_levels_count_for_the_limit_of_strength(backend):
    """1.1 times what is allowed fails the colony in its first step, and 0.9 times does not."""
    for share, fails in ((0.9, False), (1.1, True)):
        level = math.sqrt(share * 2.5e4 * 0.1 / 0.02 / 100.0)
        cells = pair(0.05, extra={"a": [level, level]})
        scene = stuck(cells, tf.Adhesion(100.0, adhesin="a"), backend=backend)
        state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
        found = tf.failures(state)
        assert bool(found) == fails
        assert not fails or "stick together more strongly" in found[0].reason


def test_the_limit_of_strength_holds_in_steps():
    most = 2.5e4 * 0.1 / 0.02
    model = stuck(pair(0.05), tf.Adhesion(1.1 * most)).bind()
    for _ in range(2):
        with pytest.raises(InputError, match=r"Adhesion.strength.*in steps of 0.02 h: solves"):
            model.step(model.start())
    assert model.step(model.start(), 0.01).step == 1
    assert model.step(model.start(), 0.0).step == 1


def test_the_limit_of_strength_follows_a_drawn_viscosity():
    """It is that of the least that may be drawn, here e^(−0.4) · 1000."""
    most = 2.5e4 * 0.1 / 0.02 * 1000.0 * math.exp(-0.4)
    for share, allowed in ((0.9, True), (1.1, False)):
        scene = stuck(pair(0.05), tf.Adhesion(share * most), viscosity=tf.LogNormal(1e3, 0.1))
        if allowed:
            assert not tf.failures(list(tf.simulate(scene, until=0.02))[-1])
            continue
        with pytest.raises(InputError, match=r"Adhesion\.strength"):
            list(tf.simulate(scene, until=0.02))


@BACKENDS
def test_what_two_cells_or_a_cell_and_a_wall_share_counts_for_the_limit(backend):
    """Kinds add up where they hold the same cell; of a partner what some cell has; 0.9 times the
    limit runs, and 1.1 times fails."""
    most = 2.5e4 * 0.1 / 0.02
    for share, fails in ((0.9, False), (1.1, True)):
        half = 0.5 * share * most
        level = math.sqrt(2.0 * half / 100.0)
        pairs = {"a": [level, 0.0], "p": [0.0, level]}
        hetero = tf.Adhesion(100.0, adhesin="a", partner="p")
        floor, side = tf.Plane(y=-9.0, facing="+y"), tf.Plane(x=-9.0, facing="+x")
        to_each = [tf.Adhesion(2 * half, to=k) for k in (0, 1)]
        for cells, kinds, counts in (
            (pair(0.05), [tf.Adhesion(half), tf.Adhesion(half, 0.05 + 0.05)], True),
            (pair(0.05, extra=pairs), [hetero], True),
            (pair(0.05, cell_type=[0, 1]),
             [tf.Adhesion({0: 2 * half if k == 0 else 0.0, 1: 2 * half if k else 0.0})
              for k in (0, 1)], None),
            (pair(0.05), to_each, None),
            (pair(0.05), [tf.Adhesion(half, to="walls"), tf.Adhesion(half, to=0)], True),
        ):  # fmt: skip
            scene = stuck(cells, *kinds, backend=backend, walls=[floor, side])
            if counts is None and fails:
                continue  # a strength above the limit is refused by itself
            state = step(scene, scene.bind(dtype=torch.float64).start(), 0.02)
            assert bool(tf.failures(state)) == (fails and bool(counts))


def test_forward_mode_is_refused():
    scene = stuck(pair(0.05, extra={"a": [1.0, 1.0]}), tf.Adhesion(10.0, adhesin="a"))
    state = scene.bind(dtype=torch.float64).start()
    with forward_mode():
        dual = torch.autograd.forward_ad.make_dual(state.a, torch.ones_like(state.a))
        with pytest.raises(InputError, match="no forward mode"):
            step(scene, state.with_fields(a=dual), 0.02)


def test_it_is_explained():
    scene = stuck(pair(0.1, extra={"a": [1.0, 1.0]}), tf.Adhesion(80.0, adhesin="a"))
    text = str(tf.explain(scene))
    assert "adhesion: a pull of up to 80 μ·µm²/h at a gap of 0.1 µm, in proportion to a" in text


@pytest.mark.parametrize("backend", ("compiled", "torch"))
@pytest.mark.parametrize(("dim", "along"), [(2, "y"), (3, "y"), (3, "z")])
def test_cells_stick_together_across_the_faces_of_every_axis(backend, dim, along):
    """Two cells, one at either face, 0.1 µm apart, are held as two in the middle are."""
    glue, found, k = tf.Adhesion(strength=300.0, reach=0.3), [], "xyz".index(along)
    for shift in (0.0, 10.0):
        position = np.full((2, dim), 5.0)
        position[:, k] = np.array([19.45 + shift, 0.55 + shift]) % 20.0
        cells = tf.Cells(position=position, axis=[np.eye(dim)[0]] * 2, length=2.0)
        scene = tf.Scene(
            tf.Mechanics(dim=dim, adhesion=[glue], periodic={along: (0, 20)}, backend=backend),
            dt=0.02,
        )
        model = scene.bind(cells=cells, dtype=torch.float64)
        state = model.start()
        for _ in range(5):
            state = model.step(state)
        found.append(float(tf.measure.neighbours(state, 0.3)[2]))
    assert found[0] == pytest.approx(found[1], abs=1e-9) and 0.98 < found[0] < 1.05
