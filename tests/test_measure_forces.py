"""Forces at contacts, against the drag that they overcome: in a slow fluid they are the same."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

import torchfilm as tf

BACKENDS = [{}, {"backend": "torch"}]


def two(**options) -> tf.Scene:
    """Two cells end to end, which grow and push each other away."""
    founders = tf.Cells([[-1.75, 0.0], [1.75, 0.0]], [[1.0, 0.0]] * 2, length=2.5)
    mechanics = tf.Mechanics(dim=2, **options)
    return tf.Scene(tf.Growth(rate=1.0), mechanics, founders=founders, dt=0.025)


def force_between(state: tf.State, scene: tf.Scene) -> float:
    """The force at the contact of two cells end to end, μ·µm²/h, from their pressure."""
    whole = state.length.double() + 2 * state.radius.double()
    from_above = 2 * state.radius.double() * (state.length.double() + math.pi / 4)
    return float((tf.measure.pressure(state, scene) * 2 * from_above / (whole / 2))[0])


def drag_of(state: tf.State, before: tf.State, dt: float) -> torch.Tensor:
    """The drag on each cell along x in this step, μ (l + 2r) v, (N,)."""
    speed = (state.position - before.position)[:, 0] / dt
    return (state.length.double() + 2 * state.radius.double()) * speed


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
def test_cells_that_part_push_with_their_drag(options):
    """α of a colony follows its forces from step to step. What a step's overlaps mean is that of
    the step itself: with the α of the step after, forces were up to 6 % too large."""
    scene, seen = two(**options), []
    before = scene.bind().start()
    for state in tf.simulate(scene, until=0.5):
        seen.append(force_between(state, scene) / float(drag_of(state, before, 0.025)[1]))
        before = state
    assert seen[4:] == pytest.approx([1.0] * len(seen[4:]), abs=2e-3)


def test_the_closed_end_of_a_channel_carries_the_drag_of_the_whole_row():
    """Steps in which one pass parts the cells, and none divides: the end carries what all of them
    push along the channel. Solves are tight: one at the default may leave some of it out."""
    channel = tf.Channel(1.0, low_end=0.0)
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5), axis_noise=0.0),
        tf.Mechanics(dim=2, walls=[channel], tolerance=1e-3),
        founders=tf.Cells([[1.5, 0.0]], [1.0, 0.0]), dt=0.025,
    )  # fmt: skip
    before, seen = scene.bind().start(), []
    for state in tf.simulate(scene, cells=30, seed=1):
        report = state.reports["mechanics"]
        plain = int(report.passes) == 1 and int(report.clipped) == 0
        if plain and state.cells == before.cells > 6:
            forces = tf.measure.wall_forces(state, scene)
            (end,) = [k for k, face in enumerate(forces.facing) if float(face[0]) > 0.5]
            seen.append(float(forces.force[0, end] / drag_of(state, before, 0.025).sum()))
        before = state
    assert len(seen) >= 10
    assert float(np.median(seen)) == pytest.approx(1.0, abs=5e-3)
    assert seen == pytest.approx([1.0] * len(seen), abs=0.02)


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
def test_the_report_has_the_alpha_of_its_step(options):
    """Where the force has not grown much, it is the one that the state before held."""
    scene = two(**options)
    states = list(tf.simulate(scene, until=0.5))
    for before, state in itertools.pairwise(states[4:]):
        assert state.reports["mechanics"].alpha.dtype == torch.float64
        alpha = float(state.reports["mechanics"].alpha)
        assert alpha == pytest.approx(float(before.contact_alpha[0]), rel=1e-6)
        assert alpha != pytest.approx(float(state.contact_alpha[0]), rel=1e-3)


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
def test_a_first_pass_that_is_solved_again_has_the_alpha_of_its_last_solve(options):
    """Ten cells in a row, each 0.06 µm deep in the next: their forces are far above those for which
    the first α of a run is made. By the virial theorem Σ p · 2A is Σ x · drag."""
    places = [[3.44 * (k - 4.5), 0.0] for k in range(10)]
    founders = tf.Cells(places, [[1.0, 0.0]] * 10, length=2.5)
    scene = tf.Scene(tf.Mechanics(dim=2, tolerance=1e-3, **options), founders=founders, dt=0.025)
    begin = scene.bind().start()
    (state,) = tf.simulate(scene, until=0.025)
    report = state.reports["mechanics"]
    (apart,) = tf.simulate(two(**options), until=0.025)
    assert int(report.passes) == 1
    assert float(report.alpha) < 0.5 * float(apart.reports["mechanics"].alpha)
    from_above = 2 * state.radius.double() * (state.length.double() + math.pi / 4)
    virial = float((tf.measure.pressure(state, scene) * 2 * from_above).sum())
    work = float((drag_of(state, begin, 0.025) * state.position[:, 0]).sum())
    assert virial == pytest.approx(work, rel=1e-2)


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
@pytest.mark.parametrize("given", [{"alpha": 1e-4}, {"stiffness": 400.0}])
def test_where_alpha_is_given_forces_are_of_it(given, options):
    scene = two(**given, **options)
    before = scene.bind().start()
    for state in tf.simulate(scene, until=0.3):
        assert state.reports["mechanics"].alpha.tolist() == [0.0]
        last, before = before, state
    force, drag = force_between(state, scene), float(drag_of(state, last, 0.025)[1])
    assert force == pytest.approx(drag, rel=1e-2)


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
def test_bilateral_contacts_report_no_alpha(options):
    (state,) = tf.simulate(two(contacts="bilateral", **options), until=0.025, colonies=2)
    assert state.reports["mechanics"].alpha.tolist() == [0.0, 0.0]


def all_of_the_second(cells):
    cells.remove_flag = cells.colony == 1


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
def test_a_colony_without_cells_has_no_alpha(options):
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Mechanics(dim=2, **options), tf.Rules(all_of_the_second), dim=2
    )
    *_, state = tf.simulate(scene, until=0.1, colonies=3)
    alpha = state.reports["mechanics"].alpha
    assert state.counts.tolist() == [1, 0, 1]
    assert float(alpha[1]) == 0.0 and bool((alpha[[0, 2]] > 0).all())


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
@pytest.mark.parametrize("stiffness", [10.0, 50.0])
def test_soft_cells_meet_in_the_middle_of_their_overlap(stiffness, options):
    """By the virial theorem Σ p · 2A is the force times the distance of the centres, which is
    shorter than two half cells by the overlap, some tenths of a µm here."""
    scene = two(stiffness=stiffness, **options)
    before = scene.bind().start()
    for state in tf.simulate(scene, until=0.3):
        last, before = before, state
    assert float(tf.measure.overlaps(state).worst) > 0.1
    from_above = 2 * state.radius.double() * (state.length.double() + math.pi / 4)
    virial = float((tf.measure.pressure(state, scene) * 2 * from_above).sum())
    apart = float(state.position[1, 0] - state.position[0, 0])
    assert virial / apart == pytest.approx(float(drag_of(state, last, 0.025)[1]), rel=1e-4)


@pytest.mark.parametrize("weight", [0.3, 0.5, 1.0, {0: 0.5}])
@pytest.mark.parametrize("given", [{}, {"alpha": 1e-2}], ids=["default", "alpha"])
def test_a_wall_with_a_weight_pushes_with_the_drag(weight, given):
    """A cell that lies 0.1 µm deep in it; the less the weight, the less it is pushed out."""
    wall = tf.Plane(y=-0.4, facing="+y", weight=weight)
    mechanics = tf.Mechanics(dim=2, walls=[wall], tolerance=1e-3, **given)
    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, cell_type=[0])
    scene = tf.Scene(mechanics, founders=founders, dt=0.025)
    (state,) = tf.simulate(scene, until=0.025, dtype=torch.float64)
    drag = (2.0 + 2 * 0.5) * float(state.position[0, 1]) / 0.025
    assert float(tf.measure.wall_forces(state, [wall]).force) == pytest.approx(drag, rel=1e-6)


# --- cells that divide, burst or leave at the end of the step -------------------------------------


def in_a_slit(*more, **options) -> tf.Scene:
    """A cell that lies flat between two soft walls, 0.05 µm deep in each."""
    walls = [tf.Plane(y=s * 0.45, facing=f"{'-' if s > 0 else '+'}y", stiffness=100.0)
             for s in (-1, 1)]  # fmt: skip
    mechanics = tf.Mechanics(dim=2, walls=walls, **options)
    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], length=2.6)
    return tf.Scene(tf.Growth(rate=1.0), *more, mechanics, founders=founders, dt=0.025)


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
def test_forces_of_a_step_are_those_on_the_cells_before_they_divide(options):
    """Two daughters had each the mother's force on a wall, 20 in all, and half of her pressure."""
    whole, divides = in_a_slit(**options), in_a_slit(tf.Division(length=3.0), **options)
    pairs = zip(*(tf.simulate(s, until=0.2, dtype=torch.float64) for s in (whole, divides)),
                strict=True)  # fmt: skip
    counts = set()
    for one, two in pairs:
        if two.cells == 2 and two.births:
            (mother,) = tf.measure.pressure(one, whole).tolist()
            assert tf.measure.pressure(two, divides).tolist() == [mother, mother]
        forces = tf.measure.wall_forces(two, divides).force.flatten().tolist()
        pressing = 2 if two.cells == 2 and not two.births else 1
        assert forces == pytest.approx([10.0 * pressing] * 2, rel=1e-6)
        counts.add((two.cells, bool(two.births)))
    assert {(1, False), (2, True), (2, False)} <= counts


@pytest.mark.parametrize("options", BACKENDS, ids=["compiled", "torch"])
def test_forces_of_a_step_are_those_on_the_cells_before_some_burst(options):
    box = tf.Box((-5.0, -5.0), (5.0, 5.0))
    contacts = tf.Mechanics(dim=2, walls=[box], **options)
    parts = tf.Growth(rate=1.0), tf.Division(length=4.0), contacts
    grows, bursts = tf.Scene(*parts, dt=0.025), tf.Scene(*parts, tf.Lysis(rate=8.0), dt=0.025)
    state = tf.simulate(grows, until=4.0, seed=2).last()
    one, two = (scene.bind(state=state).step(state, 0.025) for scene in (grows, bursts))
    assert 0 < two.cells < one.cells
    forces = [tf.measure.wall_forces(s, scene).force for s, scene in ((one, grows), (two, bursts))]
    assert torch.equal(*forces) and float(forces[0].sum()) > 0
    every = dict(zip(one.uid.tolist(), tf.measure.pressure(one, grows).tolist(), strict=True))
    left = tf.measure.pressure(two, bursts).tolist()
    alike = [every[u] == p for u, p in zip(two.uid.tolist(), left, strict=True) if u in every]
    assert len(alike) > 10 and all(alike)


def test_a_cell_that_was_added_since_has_no_pressure():
    scene = in_a_slit()
    state = tf.simulate(scene, until=0.1).last()
    there = tf.measure.pressure(state, scene)
    other = state.replace(uid=state.uid + 7)
    assert bool(there.isfinite().all()) and bool(tf.measure.pressure(other, scene).isnan().all())


def test_levels_that_hold_cells_together_are_those_of_the_solve():
    """A circuit's step comes after contacts. Its levels, at the end of the step, hold the cells in
    the next one."""
    rising = tf.Circuit(lambda u, s, p, cell: {"glue": p.rate + 0.0 * u.glue}, species="glue",
                        initial={"glue": 1.0}, rate=[0.0, 40.0])  # fmt: skip
    founders = tf.Cells([[-1.8, 0.0], [1.8, 0.0]], [[1.0, 0.0]] * 2, length=2.5)
    sticky = tf.Mechanics(dim=2, adhesion=[tf.Adhesion(strength=20.0, reach=0.5, adhesin="glue")])
    scene = tf.Scene(tf.Growth(rate=0.0), rising, sticky, founders=founders, dt=0.025)
    model = scene.bind(2, dtype=torch.float64)
    state = model.step(model.start(), 0.025)
    assert float(state.glue.max()) == pytest.approx(2.0)
    pulls = tf.measure.pressure(state, scene)
    assert torch.equal(pulls[:2], pulls[2:]) and float(pulls[0]) < 0
