"""How hard contacts are: α follows the force, but not where harder contacts would be in vain."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.kernels.compiling import for_python
from torchfilm.kernels.hardness import following, most_force
from torchfilm.kernels.rows import HARD
from torchfilm.kernels.scheme import MOST_FORCE
from torchfilm.physics import hardness

BACKENDS = pytest.mark.parametrize("backend", ["compiled", "torch"])
UNBOUNDED = np.inf


def rows(second):
    return None, None, None, second, np.full(len(second), HARD)


@pytest.mark.parametrize("worst, peaks", [(0.05, False), (0.1, False), (0.2, True), (1.0, True)])
def test_alpha_follows_the_mean_overlap_and_the_few_that_are_far_above_it(worst, peaks):
    """400 contacts, all but one with the overlap that is wanted: α stays as it is, or becomes so
    hard that the eighth root of the mean eighth power is what it may be at most."""
    target, most, alpha = 0.007, 0.05, 1e-4
    e = -np.full(400, target)
    e[7] = -worst
    limits = 1.0, 1e-9, most
    found = for_python(following)(
        e, rows(np.zeros(400, np.int64)), alpha, target, limits, UNBOUNDED
    )
    by_mean = alpha * target / np.mean(-e)
    by_peaks = alpha * most / np.mean(e**8) ** 0.125
    assert (by_peaks < by_mean) == peaks
    assert found == pytest.approx(min(by_mean, by_peaks, 2 * alpha), rel=1e-12)


@pytest.mark.parametrize("at_walls, by", [(0.001, 0.012), (0.012, 0.012), (0.024, 0.021)])
def test_alpha_follows_contacts_between_cells_where_those_with_walls_are_lighter(at_walls, by):
    """300 contacts with walls, 100 between cells: by the larger mean, of all or of the latter."""
    e = np.where(np.arange(400) < 100, -0.012, -at_walls)
    wall = np.where(np.arange(400) < 100, 5, -1)  # the second cell, or which wall
    found = for_python(following)(e, rows(wall), 1e-4, 0.007, (1.0, 1e-9, 1.0), UNBOUNDED)
    assert found == pytest.approx(1e-4 * 0.007 / by, rel=1e-12)


@pytest.mark.parametrize("alpha", [1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("held", [0.0, 10.0, 1e4])
def test_with_overlaps_as_they_are_no_force_is_beyond_its_bound(alpha, held):
    """Forty pairs overlap five times as much as is wanted. Unbounded, α would be a fifth. Now it is
    at least what gives the bound at this overlap, and at most that of the softest contacts."""
    overlap, target, softest, moved = 0.035, 0.007, 4e-3, 8.0
    e, pairs = np.full(40, -overlap), rows(np.zeros(40, np.int64))
    limits = softest, 1e-9, 1.0
    plain = for_python(following)(e, pairs, alpha, target, limits, UNBOUNDED)
    assert plain == pytest.approx(min(alpha / 5, softest))
    found = for_python(following)(e, pairs, alpha, target, limits, held + moved)
    bound = MOST_FORCE * (held + moved)
    wanted = min(max(alpha / 5, overlap / bound), softest, 2 * alpha)
    assert found == pytest.approx(wanted, rel=1e-12)
    nothing_pushes = for_python(following)(e, pairs, alpha, target, limits, 0.0)
    assert nothing_pushes == pytest.approx(min(softest, 2 * alpha))


def test_forces_are_bounded_by_growth_and_by_all_that_moves_need():
    """Of three cells, one cannot grow; two move by 1 and 2 µm, and one turns by 0.5 rad."""
    drag, turning = 3.0, 4.0
    scale = np.array([[drag**-0.5] * 2 + [turning**-0.5, 0.1]] * 3)
    moves = np.array([[1.0, 0.0, 0.0, 9.0], [0.0, 0.0, 0.5, 9.0], [1.2, -1.6, 0.0, 9.0]])
    radius, growth = np.full(3, 0.5), np.array([0.1, -1.0, 0.3])
    length_drag, dof, hard = np.array([10.0, 50.0, 20.0]), np.zeros(4), np.array([False])
    of = moves / scale, scale, radius, growth, (np.ones(3), length_drag)
    found = for_python(most_force)(*of, (0.0, 0.0), hard, dof)
    assert found == pytest.approx(20.0 * 0.3 + drag * (1.0 + 2.0) + turning * 0.5 / 0.5)
    for reach, soft in (((0.1, 0.0), hard), ((0.0, 0.1), hard), ((0.0, 0.0), ~hard)):
        assert for_python(most_force)(*of, reach, soft, dof) == np.inf


@BACKENDS
@pytest.mark.parametrize("drag", [1.0, 100.0])
def test_a_row_passes_on_all_that_pushes_it(backend, drag):
    """Ten cells at the end of a channel, pushed by two motile ones, and ten that lie behind: each
    contact of the row bears the forces of both, and overlaps as is wanted."""
    walls = box(200.0, 1.0)[:3]
    x = [1.5 + 3.0 * k for k in range(12)] + [40.0 + 3.5 * k for k in range(10)]
    kinds = [0] * 10 + [1] * 2 + [0] * 10
    cells = tf.Cells([[v, 0.5] for v in x], [[1.0, 0.0]] * 22, 2.0, cell_type=kinds,
                     extra={"drag": [drag if k else 1.0 for k in kinds]})  # fmt: skip
    scene = tf.Scene(tf.Mechanics(walls, dim=2, backend=backend),
                     tf.Motility(speed={0: 0.0, 1: 5.0}), founders=cells, dt=0.025)  # fmt: skip
    model = scene.bind(seed=0)
    state = model.start()
    state = state.with_fields(heading=-torch.ones_like(state.heading))
    for _ in range(60):
        state = model.step(state)
    force = tf.measure.wall_forces(state, walls).force[0, 2]
    assert float(force) == pytest.approx(2 * drag * 3.0 * 5.0, rel=0.02)
    assert 0.006 < float(tf.measure.overlaps(state, walls).mean[0]) < 0.008


def box(width, height=None):
    height = width if height is None else height
    return [
        tf.Plane(normal=(0, 1), point=(0, 0)),
        tf.Plane(normal=(0, -1), point=(0, height)),
        tf.Plane(normal=(1, 0), point=(0, 0)),
        tf.Plane(normal=(-1, 0), point=(width, 0)),
    ]


@BACKENDS
@pytest.mark.parametrize("length_drag", [10.0, 1e5])
def test_a_division_in_a_full_channel_makes_no_huge_forces(backend, length_drag):
    """Eight cells fill a channel one cell wide, and stall: each pushes with γ l̇. One divides, with
    the outer ends r/3 farther out than they were. Cells give back a part of their growth in a step,
    so that the excess stays for a while. Without a bound the force at the ends rose 34,000-fold
    with γ = 10, and 3,000-fold at a quarter of the step more. Softest contacts push as their
    overlap does: 40 times at γ = 10. Where growth pushes harder than that, it is eight times at
    most. In the end the force is as it was."""
    walls = box(40.0, 1.0)
    cells = tf.Cells([[2.5 + 5.0 * i, 0.5] for i in range(8)], [[1.0, 0.0]] * 8, 4.0)
    scene = tf.Scene(
        tf.Growth(1.0),
        tf.Division(conserves="volume", axis_noise=0.0),
        tf.Mechanics(walls, dim=2, length_drag=length_drag, backend=backend),
        founders=cells,
        dt=0.025,
    )
    model = scene.bind(seed=0)
    state, force, whole = model.start(), [], []
    for k in range(48):
        if k == 20:
            flag = torch.zeros(8, dtype=torch.bool)
            flag[3] = True
            state = state.with_fields(divide_flag=flag)
        state = model.step(state)
        force.append(float(tf.measure.wall_forces(state, walls).force[0, 3]))
        whole.append(float((state.length + 1.0).sum()))
    assert len(state.length) == 9
    stalled = length_drag * 4.0
    assert force[19] == pytest.approx(1.18 * stalled, rel=0.02)
    assert max(force[20:]) < (40 if length_drag == 10.0 else 8) * stalled
    assert force[-1] == pytest.approx(force[19], rel=0.03)
    assert whole[-1] == pytest.approx(whole[19], abs=0.01)  # the channel is as full as it was


def scene_of_box(backend, walls, **options):
    """Two cells that fill a box."""
    return tf.Scene(
        tf.Growth(1.0),
        tf.Division(length=tf.Uniform(3.6, 4.4)),
        tf.Mechanics(walls, dim=2, backend=backend, **options),
        founders=tf.Cells([[3.0, 3.0], [6.0, 6.0]], [[1.0, 0.0]] * 2, 2.0),
        dt=0.025,
    )


def filled(backend, walls, until, dtype=torch.float32, **options):
    """The states of a box, or of what `walls` are, after each step."""
    model = scene_of_box(backend, walls, **options).bind(seed=0, dtype=dtype)
    state = model.start()
    for _ in range(round(until / 0.025)):
        state = model.step(state)
        yield state


@pytest.mark.parametrize("size", [12.0, 16.0])
def test_a_box_that_fills_presses_its_walls_no_more_than_when_it_is_full(size):
    """Wherever cells jammed for a few steps, forces were up to nine times those of the full box."""
    walls = box(size)
    force = [
        float(tf.measure.wall_forces(state, walls).force.sum())
        for state in filled("compiled", walls=walls, until=8.0)
    ]
    assert max(force) < 2.5 * np.median(force[-40:])


CASES = {
    "free growth": ({"walls": []}, True),
    "open channel": ({"walls": box(7.0)[:2]}, True),
    "box": ({"walls": box(7.0)}, False),
    "box whose cells stick": ({"walls": box(7.0), "adhesion": [tf.Adhesion(10.0)]}, True),
    "soft box": (
        {"walls": [tf.Plane(normal=w.normal, point=w.point, stiffness=1e7) for w in box(7.0)]},
        True,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_it_bounds_neither_free_growth_nor_where_others_push(case, monkeypatch):
    """In a box it changes forces; else it changes nothing, to the last bit. Where cells stick or
    walls are soft, these push as well, so that growth and moves do not bound the force."""
    options, same = CASES[case]
    last = {}
    for bound in (MOST_FORCE, 1e30):
        monkeypatch.setattr(hardness, "MOST_FORCE", bound)
        *_, last[bound] = filled("torch", until=3.0 if same else 4.0, **options)
    one, other = last.values()
    equal = torch.equal(one.position, other.position)
    assert equal == same


def test_kernels_and_torch_bound_alike():
    """From the same states of a box that fills; over many steps roundings grow apart."""
    scene = scene_of_box("torch", walls=box(7.0))
    model = scene.bind(seed=0, dtype=torch.float64)
    states = list(filled("compiled", walls=box(7.0), until=4.0, dtype=torch.float64))
    for k in range(80, len(states) - 1, 4):
        other, one = model.step(states[k]), states[k + 1]
        torch.testing.assert_close(one.position, other.position, rtol=0, atol=1e-8)
        alphas = [x.reports["mechanics"].alpha for x in (one, other)]
        torch.testing.assert_close(*alphas, rtol=1e-5, atol=0)
