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
UNBOUNDED = np.inf, 0.0


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
    found = for_python(following)(e, pairs, alpha, target, limits, (held, moved))
    bound = MOST_FORCE * (held + moved / 40)
    wanted = min(max(alpha / 5, overlap / bound), softest, 2 * alpha)
    assert found == pytest.approx(wanted, rel=1e-12)
    nothing_pushes = for_python(following)(e, pairs, alpha, target, limits, (0.0, 0.0))
    assert nothing_pushes == pytest.approx(min(softest, 2 * alpha))


def test_moves_need_no_more_force_than_the_virial():
    """A row of five rods, each but the middle one carried outwards: the contacts of a row transmit
    what moves those beyond, and their mean is no more than the bound, of which it is the half, as
    centres are two widths apart."""
    outwards = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    x = np.stack([2.0 * outwards, np.zeros(5)], 1)
    radius, drag = np.full(5, 0.5), 3.0
    y = np.zeros((5, 4))
    y[:, 0] = outwards * np.sqrt(drag)  # the moves, 1 and 2 µm, scaled
    scale = np.full((5, 4), drag**-0.5)
    of = (np.ones(5), np.full(5, 10.0)), (0.0, 0.0)
    dof, growth = np.zeros(4), np.array([0.1, 0.2, -1.0, 0.3, 0.1])
    held, moved = for_python(most_force)(
        x, y, scale, radius, growth, of[0], of[1], np.zeros(0, bool), dof
    )
    transmitted = drag * (2.0 * 2.0 + 2.0 * 3.0)  # the outer contacts, and the inner ones
    assert held == pytest.approx(3.0)
    assert moved == pytest.approx(drag * (2.0 * 1.0 * (2.0 + 1) + 2.0 * 2.0 * (4.0 + 1)))
    assert transmitted <= moved
    for sticks, soft in (((0.1, 0.0), [False]), ((0.0, 0.1), [False]), ((0.0, 0.0), [True])):
        held, _ = for_python(most_force)(
            x, y, scale, radius, growth, of[0], sticks, np.array(soft), dof
        )
        assert held == np.inf


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


def filled(backend, *effects, walls, until=7.0, dtype=torch.float32, **options):
    """A box while two cells fill it: the states after each step."""
    scene = tf.Scene(
        tf.Growth(1.0),
        tf.Division(length=tf.Uniform(3.6, 4.4)),
        tf.Mechanics(walls, dim=2, backend=backend, **options),
        *effects,
        founders=tf.Cells([[3.0, 3.0], [6.0, 6.0]], [[1.0, 0.0]] * 2, 2.0),
        dt=0.025,
    )
    model = scene.bind(seed=0, dtype=dtype)
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
def test_the_bound_counts_in_full_boxes_alone(case, monkeypatch):
    """To the last bit, nothing else changes. Where cells stick or walls are soft, these push as
    well, so that growth and moves do not bound the force."""
    options, same = CASES[case]
    last = {}
    for bound in (MOST_FORCE, 1e30):
        monkeypatch.setattr(hardness, "MOST_FORCE", bound)
        *_, last[bound] = filled("torch", until=4.0, **options)
    one, other = last.values()
    equal = torch.equal(one.position, other.position)
    assert equal == same


def test_kernels_and_torch_bound_alike():
    pairs = zip(
        filled("compiled", walls=box(7.0), until=4.0, dtype=torch.float64),
        filled("torch", walls=box(7.0), until=4.0, dtype=torch.float64),
        strict=True,
    )
    for one, other in pairs:
        torch.testing.assert_close(one.position, other.position, rtol=0, atol=1e-7)
        alphas = (x.reports["mechanics"].alpha for x in (one, other))
        torch.testing.assert_close(*alphas, rtol=1e-4, atol=0)
