"""Cells that move by themselves: how far, which way, and against what they push and pull."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import check_always, pair_gaps, step

import torchfilm as tf
from torchfilm.tools.checks import InputError, SimulationError

X = (1.0, 0.0)


def far_apart(count: int, dim: int = 2, **given) -> tf.Cells:
    axes = np.repeat(np.eye(dim)[:1], count, 0)
    return tf.Cells(100.0 * np.arange(count)[:, None] * np.eye(dim)[1], axes, 2.0, **given)


def last(scene: tf.Scene, until: float, **given) -> tf.State:
    for state in tf.simulate(scene, until=until, **given):
        check_always(state)
    return state


def test_a_free_cell_moves_along_its_axis():
    """Either way: half of the cells begin against it, and without reversals they go on."""
    scene = tf.Scene(tf.Motility(12.0), founders=far_apart(400), dt=0.05)
    state = last(scene, 0.5, seed=3, dtype=torch.float64)
    assert torch.allclose(state.position[:, 0], 6.0 * state.heading.double(), atol=1e-12)
    assert set(state.heading.tolist()) == {-1.0, 1.0}
    assert 160 <= int((state.heading > 0).sum()) <= 240


@pytest.mark.parametrize("dt", [0.5, 0.02])
def test_reversals_follow_their_rate_at_any_step(dt):
    """Headings an hour apart agree in the mean by exp(−2·k·t), k = 0.6/h; 12,000 cells."""
    scene = tf.Scene(tf.Motility(1.0, reversals=0.6), founders=far_apart(3000), dt=dt)
    first = scene.bind(colonies=4, seed=5).start()
    state = first
    for _ in range(round(1.0 / dt)):
        state = step(scene, state, dt)
    kept = (state.heading * first.heading).double()
    assert float(kept.mean()) == pytest.approx(math.exp(-1.2), abs=4 / math.sqrt(12000))


def test_reversals_too_often_for_the_step_are_told():
    with pytest.warns(UserWarning, match=r"reverses up to 1 times in a step.* 1.31 times.*0.005 h"):
        last(tf.Scene(tf.Motility(1.0, reversals=50.0), founders=far_apart(2), dt=0.02), 0.04)


def test_more_than_a_quarter_of_a_reversal_in_a_step_is_told_unless_a_factor_multiplies_it():
    """The factor may be small, so that a rate of 0.5 in a step says nothing."""
    often = tf.Motility(1.0, reversals=15.0)
    with pytest.warns(UserWarning, match=r"reverses up to 0\.3 times in a step"):
        last(tf.Scene(often, founders=far_apart(2), dt=0.02), 0.04)
    seldom = tf.Motility(1.0, reversals=12.0)
    last(tf.Scene(seldom, founders=far_apart(2), dt=0.02), 0.04)
    by_factor = tf.Motility(1.0, reversals=25.0, reversal_factor="turns")
    cells = far_apart(2, extra={"turns": [0.1, 0.1]})
    last(tf.Scene(by_factor, founders=cells, dt=0.02), 0.04)


def test_cells_that_reverse_spread_as_a_persistent_walk():
    """⟨x²⟩ = v²/k · (t − (1 − exp(−2kt))/(2k)), within four standard errors."""
    scene = tf.Scene(tf.Motility(20.0, reversals=3.0), founders=far_apart(1000), dt=0.02)
    state = last(scene, 2.0, colonies=6, seed=7)
    square = state.position[:, 0].square()
    wanted = 400 / 3 * (2.0 - (1 - math.exp(-12.0)) / 6)
    assert abs(float(square.mean()) - wanted) <= 4 * float(square.std()) / math.sqrt(6000)


@pytest.mark.parametrize("dim", [2, 3])
def test_turning_is_rotational_diffusion(dim):
    """⟨cos⟩ of the angle from the first axis is exp(−(d − 1)·D·t), within four standard errors;
    in the plane the angle's variance is 2Dt."""
    scene = tf.Scene(tf.Motility(0.0, turning=0.2), founders=far_apart(1500, dim), dt=0.02)
    state = last(scene, 1.0, colonies=4, seed=7, dtype=torch.float64)
    cosine = state.axis[:, 0]
    error = 4 * float(cosine.std()) / math.sqrt(6000)
    assert float(cosine.mean()) == pytest.approx(math.exp(-(dim - 1) * 0.2), abs=error)
    if dim == 2:
        angle = torch.atan2(state.axis[:, 1], cosine)
        assert float(angle.var()) == pytest.approx(0.4, rel=4 * math.sqrt(2 / 6000))


def test_factors_multiply_speed_and_reversals():
    cells = far_apart(4, extra={"run": [1.0, 0.0, 0.5, 2.0], "turns": [0.0, 0.0, 0.0, 0.0]})
    scene = tf.Scene(
        tf.Motility(10.0, factor="run", reversals=2.0, reversal_factor="turns"),
        founders=cells, dt=0.1,
    )  # fmt: skip
    state = last(scene, 0.5, seed=1)
    assert state.position[:, 0].abs().tolist() == pytest.approx([5.0, 0.0, 2.5, 10.0])


def test_a_schedule_stops_them():
    scene = tf.Scene(tf.Motility(tf.Schedule({0.0: 10.0, 0.2: 0.0})), founders=far_apart(3), dt=0.1)
    state = last(scene, 1.0)
    assert state.position[:, 0].abs().tolist() == pytest.approx([2.0] * 3, rel=1e-6)


def in_a_row(speeds: list[float], gap: float, **given) -> tf.Scene:
    """Cells end to end, 3 µm long, which move towards +x at these speeds."""
    count = len(speeds)
    place = np.arange(count)[:, None] * np.array([[3.0 + gap, 0.0]])
    cells = tf.Cells(place, [X] * count, 2.0, extra={"speed": speeds, "heading": [1.0] * count})
    return tf.Scene(
        tf.Motility(1.0, factor="speed"),
        tf.Mechanics(dim=2, tolerance=1e-6, **given),
        founders=cells,
        dt=0.01,
    )


BACKENDS = pytest.mark.parametrize("backend", ["compiled", "torch"])


@BACKENDS
def test_a_cell_pushes_another_at_half_its_speed(backend):
    scene = in_a_row([10.0, 0.0], 0.0, backend=backend)
    states = list(tf.simulate(scene, until=0.5, dtype=torch.float64))
    way = states[-1].position[1, 0] - states[-11].position[1, 0]
    assert float(way) == pytest.approx(0.1 * 5.0, rel=1e-3)
    assert abs(float(pair_gaps(states[-1], np.array([[0, 1]]))[0])) < 0.03


@BACKENDS
def test_a_cell_at_a_wall_pushes_with_its_drag(backend):
    """μ (l + 2r) v = 3 · 10 on the wall, in which it lies no deeper than contacts yield."""
    wall = tf.Plane(x=2.0, facing="-x")
    scene = in_a_row([10.0], 0.0, backend=backend, walls=[wall])
    state = last(scene, 0.5, dtype=torch.float64)
    assert float(tf.measure.wall_forces(state, [wall]).force[0, 0]) == pytest.approx(30.0, rel=1e-3)
    assert 0.48 <= float(state.position[0, 0]) <= 0.52


@BACKENDS
def test_a_bond_holds_up_to_its_strength(backend):
    """A cell of drag 3 pulls another one with 3·10/2 = 15 at the speed 5: a bond of strength 20
    stretches to ¾ of its reach; one of strength 10 breaks, and the other cell is left behind."""
    for strength, holds in ((20.0, True), (10.0, False)):
        scene = in_a_row(
            [0.0, 10.0], 0.0, backend=backend, adhesion=[tf.Adhesion(strength, reach=0.2)]
        )
        states = list(tf.simulate(scene, until=1.0, dtype=torch.float64))
        gap = float(pair_gaps(states[-1], np.array([[0, 1]]))[0])
        if holds:
            assert gap == pytest.approx(0.15, rel=1e-3)
            way = states[-1].position[0, 0] - states[-11].position[0, 0]
            assert float(way) == pytest.approx(0.1 * 5.0, rel=1e-3)
            # −15 at the end of a cell, over twice its area from above
            pressure = -15.0 * (1.5 + 0.075) / (2 * (2.0 + math.pi / 4))
            found = tf.measure.pressure(states[-1], scene)
            assert found.tolist() == pytest.approx([pressure] * 2, rel=1e-3)
        else:
            assert gap > 5.0


def test_a_bond_holds_a_cell_that_would_pass_its_reach_in_a_step():
    """0.1 µm a step, and a reach of 0.05: which pairs hold is decided before cells move."""
    scene = in_a_row([0.0, 10.0], 0.0, adhesion=[tf.Adhesion(100.0, reach=0.05)])
    state = last(scene, 1.0, dtype=torch.float64)
    assert float(pair_gaps(state, np.array([[0, 1]]))[0]) == pytest.approx(0.0075, rel=1e-3)


def test_strains_of_different_adhesins_sort():
    """Two strains, well mixed: contacts within a strain become nearly all, by adhesion alone."""
    found = {}
    for strength in (0.0, 300.0):
        state = last(_mixed(strength), 4.0, seed=1)
        first, second, _ = tf.measure.neighbours(state, 0.2)
        alike = state.cell_type[first] == state.cell_type[second]
        found[strength] = float(alike.double().mean())
        assert float(tf.measure.overlaps(state).worst.max()) <= 0.2
    assert found[0.0] < 0.65 and found[300.0] > 0.85


def _mixed(strength: float) -> tf.Scene:
    rng, side = np.random.default_rng(0), 12
    place = 2.25 * (np.stack(np.meshgrid(*2 * [np.arange(side) + 0.5]), -1).reshape(-1, 2))
    angle, kind = rng.uniform(0, 2 * math.pi, side**2), rng.integers(0, 2, side**2)
    cells = tf.Cells(
        place, np.stack([np.cos(angle), np.sin(angle)], 1), 0.6, cell_type=kind,
        extra={"a": (kind == 0) * 1.0, "b": (kind == 1) * 1.0},
    )  # fmt: skip
    adhesion = [tf.Adhesion(strength, reach=0.2, adhesin=name) for name in "ab"]
    return tf.Scene(
        tf.Motility(14.0, reversals=4.0, turning=0.4),
        tf.Mechanics(dim=2, walls=[tf.Box(low=(0, 0), high=(27, 27))], adhesion=adhesion),
        founders=cells,
        dt=0.01,
    )


def test_daughters_go_their_mothers_way():
    scene = tf.Scene(
        tf.Motility(1.0), tf.Growth(1.0), tf.Mechanics(dim=2), tf.Division(length=4.0),
        founders=far_apart(20), dt=0.02,
    )  # fmt: skip
    model = scene.bind(seed=2)
    state = model.start()
    mothers = dict(zip(state.uid.tolist(), state.heading.tolist(), strict=True))
    while state.cells == 20:
        state = model.step(state)
    daughters = [k for k in range(state.cells) if int(state.uid[k]) not in mothers]
    assert len(daughters) >= 2
    for k in daughters:
        assert float(state.heading[k]) == mothers[int(state.parent[k])]


def test_what_becomes_too_fast_to_meet_others_fails_its_colony():
    def faster(cells):
        cells.run = cells.run * torch.where(cells.colony == 1, 2.0, 1.0)

    scene = tf.Scene(
        tf.Rules(faster, variables={"run": 1.0}), tf.Motility(10.0, factor="run"),
        tf.Mechanics(dim=2), founders=far_apart(3), dt=0.01,
    )  # fmt: skip
    with pytest.raises(SimulationError, match=r"colony 1.*cell 0 would move 0.2 µm in one step"):
        list(tf.simulate(scene, until=0.1, colonies=2))
    with pytest.warns(RuntimeWarning, match="colony 1"):
        state = [s for s in tf.simulate(scene, until=0.1, colonies=2, on_failure="drop")][-1]
    assert state.counts.tolist() == [3, 0]


def test_what_comes_to_turn_too_far_fails_too():
    scene = tf.Scene(
        tf.Motility(1.0, turning=tf.Schedule({0.0: 0.1, 0.02: 50.0})),
        founders=far_apart(2),
        dt=0.01,
    )
    with pytest.raises(SimulationError, match=r"by a turn of 1 rad.* turn by 0.2 rad"):
        list(tf.simulate(scene, until=0.05))


def test_the_most_that_is_allowed_runs_in_both_precisions():
    for dtype in (torch.float32, torch.float64):
        for speed, dt in ((3.0, 0.05), (6.0, 0.025)):
            scene = tf.Scene(tf.Motility(speed), tf.Mechanics(dim=2), founders=far_apart(2), dt=dt)
            assert last(scene, 2 * dt, dtype=dtype).cells == 2


@BACKENDS
@pytest.mark.parametrize("parts", [1, 2, 4])
def test_sub_steps_change_no_force(parts, backend):
    """Of a cell that pushes a wall with 3 · 10, while another one far away grows by 0.1 µm a step,
    which takes sub-steps."""
    wall = tf.Plane(x=2.0, facing="-x")
    cells = tf.Cells(
        [[0.0, 0.0], [-50.0, 0.0]], [X] * 2, 2.0,
        extra={"speed": [10.0, 0.0], "heading": [1.0] * 2, "growth_rate": [0.0, 10.0]},
    )  # fmt: skip
    scene = tf.Scene(
        tf.Motility(1.0, factor="speed"), tf.Growth(law="linear"),
        tf.Mechanics(dim=2, walls=[wall], tolerance=1e-6, max_elongation=0.101 / parts,
                     backend=backend),
        founders=cells, dt=0.01,
    )  # fmt: skip
    state = last(scene, 0.5, dtype=torch.float64)
    assert int(state.reports["mechanics"].substeps[0]) == parts
    force = tf.measure.wall_forces(state, [wall]).force
    assert float(force[0, 0]) == pytest.approx(30.0, rel=0.01)


def test_sub_steps_change_no_bond():
    """As above, of a pair that is pulled with 15: ¾ of its reach at a strength of 20."""
    cells = tf.Cells(
        [[0.0, 0.0], [3.0, 0.0], [0.0, 50.0]], [X] * 3, 2.0,
        extra={"speed": [0.0, 10.0, 0.0], "heading": [1.0] * 3, "growth_rate": [0.0, 0.0, 10.0]},
    )  # fmt: skip
    gaps = []
    for elongation in (0.25, 0.03):
        scene = tf.Scene(
            tf.Motility(1.0, factor="speed"), tf.Growth(law="linear"),
            tf.Mechanics(dim=2, tolerance=1e-6, max_elongation=elongation,
                         adhesion=[tf.Adhesion(20.0, reach=0.2)]),
            founders=cells, dt=0.01,
        )  # fmt: skip
        state = last(scene, 0.5, dtype=torch.float64)
        gaps.append(float(pair_gaps(state, np.array([[0, 1]]))[0]))
    assert int(state.reports["mechanics"].substeps[0]) == 4
    assert gaps == pytest.approx([0.15, 0.15], rel=1e-2)


def test_a_state_that_goes_on_without_motility_forgets_it():
    """The last move of a pair that has just parted must not hold it."""
    scene = in_a_row([0.0, 10.0], 0.05, adhesion=[tf.Adhesion(1e-3, reach=0.1)])
    model = scene.bind(dtype=torch.float64)
    state = model.step(model.start())
    assert float(pair_gaps(state, np.array([[0, 1]]))[0]) > 0.1
    still = tf.Scene(tf.Mechanics(dim=2, adhesion=[tf.Adhesion(100.0, reach=0.1)]), dt=0.01)
    after = [s for s in tf.simulate(still, state, until=0.1)][-1]
    assert torch.equal(after.position, state.position)


def test_without_others_any_speed_will_do():
    state = last(tf.Scene(tf.Motility(1e6), founders=far_apart(2), dt=0.1), 0.2)
    assert state.position[:, 0].abs().tolist() == pytest.approx([2e5] * 2)


def test_gradients_pass_through_speed():
    speed = torch.tensor(5.0, dtype=torch.float64, requires_grad=True)
    cells = tf.Cells([[0, 0], [3.02, 0.3]], [X, X], 2.0, extra={"heading": [1.0, 1.0]})
    scene = tf.Scene(
        tf.Motility(speed),
        tf.Mechanics(dim=2, tolerance=1e-7, walls=[tf.Plane(x=4.6, facing="-x")]),
        founders=cells, dt=0.02,
    )  # fmt: skip
    state = scene.bind(dtype=torch.float64).start()
    for _ in range(3):
        state = step(scene, state, 0.02)
    (slope,) = torch.autograd.grad(state.position[0, 0], speed)
    assert 0.0 < float(slope) < 0.06


@pytest.mark.parametrize(
    "made, words",
    [
        (lambda: tf.Motility(-1.0), "Motility.speed = -1"),
        (lambda: tf.Motility(1.0, reversals=-1.0), "Motility.reversals = -1"),
        (lambda: tf.Motility(1.0, factor="2x"), "Motility.factor = '2x'"),
        (lambda: tf.Motility(1.0, reversal_factor="x"), "given with reversals"),
        (
            lambda: list(
                tf.simulate(
                    tf.Scene(tf.Motility(1.0, turning=10.0), founders=far_apart(2), dt=0.01),
                    until=0.1,
                )
            ),
            r"Motility.turning: in a step of 0.01 h .* turn by 0.447 rad.*at most 0.002 h",
        ),
        (
            lambda: list(
                tf.simulate(
                    tf.Scene(
                        tf.Motility(1.0, turning=1.0),
                        tf.Mechanics(dim=2),
                        founders=far_apart(2),
                        dt=0.015,
                    ),
                    until=0.15,
                )
            ),
            r"Motility.turning: .* move its ends by 0.346 radii.*at most 0.011 h",
        ),
        (
            lambda: list(tf.simulate(in_a_row([20.0], 0.0), until=0.1)),
            r"Motility.speed: in a step of 0.01 h a first cell would move by 0.4 radii.*0.0075 h",
        ),
        (
            lambda: tf.Scene(
                tf.Motility(1.0), founders=far_apart(2, extra={"heading": [1.0, 0.5]})
            ).bind(),
            "heading of a first cell is neither 1 nor −1",
        ),
        (
            lambda: tf.Scene(tf.Motility(1.0, factor="run"), founders=far_apart(2)),
            "motility needs the field 'run'",
        ),
        (
            lambda: tf.Scene(
                tf.Motility(1.0, factor="x"), founders=far_apart(2, extra={"x": [-1.0, 0.0]})
            ).bind(),
            "x of a first cell is below 0",
        ),
    ],
)
def test_bad_input(made, words):
    with pytest.raises(InputError, match=words):
        made()
