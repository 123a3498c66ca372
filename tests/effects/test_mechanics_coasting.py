"""Cells stop where nothing pushes them any more, and contacts of crossed rods and of any wanted
overlap push as they should."""

from __future__ import annotations

import math

import pytest
import torch

import torchfilm as tf


def channel(**given):
    """A full channel that is open at one end, out of which cells are pushed."""
    return tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2, walls=[tf.Channel(10.0, low_end=0.0)], **given),
        tf.Removal(high=(60.0, math.inf)),
        founders=tf.Cells([[5.0, 0.0]], [[1.0, 0.0]], length=2.0), dt=0.05,
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore:This scene gives its first cells growth_rate")
def test_cells_of_a_full_channel_stop_with_their_growth():
    """Those at its mouth move over 2 µm a step. Where that could fall by 0.3 µm a step at most,
    one cell in fifteen was pushed out by none."""
    scene = channel()
    full = tf.simulate(scene, until=8.0, seed=3).last()
    fast = full.displacement[:, 0].max()
    assert full.cells > 120 and fast > 2.0
    stopped = full.with_fields(growth_rate=0.0 * full.growth_rate)
    after = tf.simulate(scene, stopped, until=full.time + 0.2).last()
    at_rest = stopped.with_fields(displacement=0.0 * full.displacement)
    still = tf.simulate(scene, at_rest, until=full.time + 0.2).last()
    assert abs(after.cells - still.cells) <= 0.015 * full.cells
    assert after.displacement.abs().max() < 0.3


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_first_pass_is_bounded_about_what_a_cell_has_of_its_last_move(backend):
    """Two cells, one upon the other, that moved 3 µm along x in the step before: they part, and
    neither goes on along x nor moves by more than 0.3 µm."""
    cells = tf.Cells([[0.0, 0.0], [0.0, 0.9]], [[1.0, 0.0]] * 2, length=2.0)
    scene = tf.Scene(tf.Mechanics(dim=2, backend=backend), founders=cells, dt=0.05)
    first = scene.bind().start()
    last = torch.zeros_like(first.displacement)
    last[:, 0] = 3.0
    after = scene.bind().step(first.with_fields(displacement=last))
    assert after.position[:, 0].abs().max() < 0.01
    assert float(after.position[1, 1] - after.position[0, 1]) > 0.97


@pytest.mark.parametrize(
    ("length", "sine", "apart"),
    [(24.0, 0.085, 0.85), (12.0, 0.12, 0.85), (8.0, 0.2, 0.85), (24.0, 0.085, 0.5)],
)
@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_long_rods_that_cross_at_a_small_angle_part(length, sine, apart, backend):
    """The line along which they touch had its ends as far aside as they were apart, where cells
    did not overlap: nothing parted them."""
    cells = tf.Cells(
        [[0.0, 0.0, 0.0], [0.0, 0.0, apart]],
        [[1.0, 0.0, 0.0], [math.sqrt(1 - sine**2), sine, 0.0]], length=length,
    )  # fmt: skip
    scene = tf.Scene(tf.Mechanics(dim=3, backend=backend), founders=cells, dt=0.025)
    state = tf.simulate(scene, until=0.25).last()
    assert float(tf.measure.overlaps(state).worst) < 0.02
    assert state.reports["mechanics"].passes.tolist() == [1]


@pytest.mark.parametrize("overlap", [0.0042, 0.05, 0.14])
def test_growth_under_pressure_does_not_depend_on_the_overlap_that_is_wanted(overlap):
    """Where passes parted what the first one left as wanted, a tenth of the volume was lost."""
    volume = lambda **given: float(
        tf.simulate(
            tf.Scene(
                tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)),
                tf.Mechanics(dim=2, length_drag=1e3, **given), dt=0.05,
            ),
            until=7.5, colonies=4, seed=1,
        ).last().volume.sum()
    )  # fmt: skip
    assert volume(contact_overlap=overlap) == pytest.approx(volume(), rel=0.02)


@pytest.mark.parametrize("name", ["alpha", "stiffness"])
@pytest.mark.parametrize("value", [{0: 100.0, 1: 1000.0}, tf.Uniform(1.0, 2.0)])
def test_contacts_that_differ_between_the_cells_of_a_colony_are_refused(name, value):
    """Each cell would yield by its own, so that a colony of two types drove itself along."""
    with pytest.raises(tf.InputError, match=rf"Mechanics\.{name} .* the same for all cells"):
        tf.Mechanics(dim=2, **{name: value})
    tf.Mechanics(dim=2, **{name: [1.0, 2.0]})


def test_length_drags_by_type_are_of_one_sided_contacts():
    """Bilateral ones take α from γ: each cell would yield by its own."""
    given = {"length_drag": {0: 10.0, 1: 1e4}}
    with pytest.raises(tf.InputError, match=r"Mechanics\.length_drag .*contacts are bilateral"):
        tf.Mechanics(dim=2, contacts="bilateral", **given)
    tf.Mechanics(dim=2, **given)
    tf.Mechanics(dim=2, contacts="bilateral", length_drag=[10.0, 100.0])
