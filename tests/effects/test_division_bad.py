"""Division: what is refused, and what a run says of cells too short to divide."""

from __future__ import annotations

import math

import pytest
import torch
from dividing import flagged, row_of_cells
from helpers import step

import torchfilm as tf
from torchfilm.effects.division_lengths import CAPS, least_length
from torchfilm.physics import capsule


@pytest.mark.parametrize(
    "given",
    [{"length": 3.0, "volume": 3.0}, {"length": 3.0, "added": 1.0}, {"volume": 3.0, "added": 1.0}],
)
def test_two_criteria_are_refused(given):
    with pytest.raises(tf.InputError, match="one criterion"):
        tf.Division(**given)


@pytest.mark.parametrize("criterion", ["length", "volume", "added"])
@pytest.mark.parametrize(
    "bad", [0.0, -1.0, math.nan, math.inf, "long", [3.0, -3.0], tf.Uniform(-1.0, 2.0)]
)
def test_bad_thresholds_are_refused(criterion, bad):
    with pytest.raises(tf.InputError, match=rf"Division\.{criterion}"):
        tf.Division(**{criterion: bad})


@pytest.mark.parametrize(
    "bad", [0.0, 1.0, -0.1, 1.5, math.nan, tf.Uniform(0.5, 1.0), tf.Uniform(0.0, 0.5), [0.5, 1.0]]
)
def test_bad_fractions_are_refused(bad):
    with pytest.raises(tf.InputError, match=r"Division\.fraction"):
        tf.Division(fraction=bad)


@pytest.mark.parametrize("bad", [-0.1, math.nan, 3.0])
def test_bad_axis_noise_is_refused(bad):
    with pytest.raises(tf.InputError, match=r"Division\.axis_noise"):
        tf.Division(axis_noise=bad)


@pytest.mark.parametrize("threshold", [1.5, 2.0, tf.Uniform(1.2, 1.9)])
def test_threshold_below_the_founders_length_is_refused(threshold):
    with pytest.raises(tf.InputError, match=r"Division\.length.*cell 0 in colony 0"):
        tf.Scene(tf.Division(length=threshold), founders=row_of_cells(1)).bind().start()


def test_volume_threshold_below_the_founders_volume_is_refused():
    with pytest.raises(tf.InputError, match=r"Division\.volume"):
        tf.Scene(tf.Division(volume=2.0), founders=row_of_cells(1)).bind().start()


def test_one_colonys_bad_threshold_is_named():
    with pytest.raises(tf.InputError, match="colony 1"):
        tf.Scene(tf.Division(length=[3.0, 1.9, 3.0]), founders=row_of_cells(1)).bind(3).start()


@pytest.mark.parametrize("threshold", [0.8, tf.Uniform(0.9, 3.0)])
def test_length_threshold_that_leaves_no_room_for_caps_is_refused(threshold):
    with pytest.raises(tf.InputError, match=r"Division\.length.*at least 1 "):
        tf.Scene(tf.Division(length=threshold), founders=row_of_cells(1, 0.2)).bind().start()


@pytest.mark.parametrize(
    "threshold, fraction, words",
    [
        # f (l + 1) ≥ 1 µm, what the caps of a daughter take
        ({"length": 3.9}, 0.2, r"length can be 3\.9: it must be at least 4 .*fraction of 0\.2"),
        ({"length": 3.9}, tf.Uniform(0.3, 0.8), "fraction of 0.2.*nearer to 0.5"),
        ({"length": 4.1}, 0.2, None),
        # f (l + 2/3) ≥ 2/3
        ({"length": 2.6, "conserves": "volume"}, 0.2, r"at least 2\.66667 "),
        ({"length": 2.7, "conserves": "volume"}, 0.2, None),
        ({"volume": 3.6}, 0.2, r"volume can be 3\.6: it must be at least 3\.66519 "),
    ],
)
def test_a_threshold_too_low_for_the_shorter_daughter_is_refused(threshold, fraction, words):
    division = tf.Division(fraction=fraction, **threshold)
    scene = tf.Scene(division, founders=row_of_cells(1))
    if words is None:
        scene.bind().start()
    else:
        with pytest.raises(tf.InputError, match=words):
            scene.bind().start()


@pytest.mark.parametrize(
    "length, fraction",
    [
        (tf.PerColony([6.0, 2.5]), tf.PerColony([0.2, 0.5])),
        ({0: 6.0, 1: 2.5}, {0: 0.2, 1: 0.5}),
        ({0: 6.0, 1: 2.5}, {0: tf.Uniform(0.2, 0.3), 1: 0.5}),
        (tf.PerColony([9.0, 2.5]), tf.Normal([0.3, 0.5], [0.04, 0.001])),
        (3.0, tf.Uniform(0.45, 0.5)),
    ],
)
def test_each_cell_is_judged_by_its_own_fraction(length, fraction):
    cells = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, 2.0, 0.5, cell_type=[0, 1])
    tf.Scene(tf.Division(length=length, fraction=fraction), founders=cells).bind(2).start()


@pytest.mark.parametrize("fraction", [1e-300, tf.Uniform(1e-320, 0.5), 1e-17])
def test_tiny_fractions_are_refused_in_words(fraction):
    scene = tf.Scene(tf.Division(length=3.0, fraction=fraction), founders=row_of_cells(1))
    with pytest.raises(tf.InputError, match=r"nearer to 0\.5"):
        scene.bind().start()


@pytest.mark.parametrize("by_torch", [False, True])
def test_who_is_too_short_does_not_depend_on_the_others(by_torch, monkeypatch):
    """A cell of exactly the length that it needs, in float32, beside one that is far too short."""
    pytest.importorskip("numba")  # kernels divide where it has been loaded
    if by_torch:
        monkeypatch.setattr("torchfilm.effects.division.knows_due", lambda *_: False)
    fraction, radius = 0.935, torch.tensor(0.37)
    cell = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 12.0, 0.37)
    scene = tf.Scene(tf.Division(fraction=fraction), founders=cell)
    state = flagged(scene, 2, dtype=torch.float32)
    just = least_length(fraction, CAPS["length"]) * radius
    for other in (20.0, 0.1):
        after = step(scene, state.replace(length=torch.stack([just, torch.tensor(other)])), 0.1)
        assert after.counts.tolist() == [2, 2 if other > 1 else 1]


@pytest.mark.parametrize("by_torch", [False, True])
@pytest.mark.parametrize("fraction", [0.2, [0.2, 0.5, 0.4], tf.Uniform(0.2, 0.2001)])
def test_a_cell_too_short_for_its_shorter_daughter_fails_its_colony(
    fraction, by_torch, monkeypatch
):
    """Of cells of 3.9 and 4.1 µm: with a share of a fifth the former would have a daughter of
    −0.02 µm."""
    pytest.importorskip("numba")  # kernels divide where it has been loaded
    if by_torch:
        monkeypatch.setattr("torchfilm.effects.division.knows_due", lambda *_: False)
    scene = tf.Scene(tf.Division(fraction=fraction), founders=row_of_cells(1, 3.9))
    state = flagged(scene, 3)
    state = state.replace(length=torch.tensor([3.9, 4.1, 3.9], dtype=state.dtype))
    after = step(scene, state, 0.1)
    report = after.reports["division"]
    third = fraction == [0.2, 0.5, 0.4]
    assert report.status.tolist() == [1, 0, 0 if third else 1]
    assert after.counts.tolist() == [1, 2, 2 if third else 1]
    assert float(report.needs[0]) == pytest.approx(4.0, abs=2e-3)
    assert report.reason(0).startswith("cell 0 is due to divide at length 3.9 µm, but needs at")


@pytest.mark.parametrize(
    "length, radius, threshold, words",
    [
        # the largest number of any type is not what a cell of type 0 may reach
        (5.0, 0.5, {0: 4.0, 1: tf.Uniform(8.0, 10.0)}, r"cell 0 .* a length of 5, .* is 4 at most"),
        (9.0, 0.5, {0: tf.Uniform(4.0, 8.0), 1: 10.0}, r"cell 0 .* a length of 9, .* at most"),
        # nor the smallest what it may divide at
        (2.0, 1.5, {0: 4.0, 1: tf.Uniform(2.2, 2.5)}, None),
        (2.0, 1.5, {0: tf.Uniform(3.5, 4.0), 1: 2.5}, None),
        (2.0, 1.5, {0: tf.Uniform(2.5, 4.0), 1: 5.0}, r"can be 2\.5: it must be at least 3 "),
        (2.0, 1.5, {0: 2.5, 1: tf.Uniform(3.5, 4.0)}, r"can be 2\.5: it must be at least 3 "),
    ],
)
def test_a_cell_is_compared_with_the_thresholds_of_its_own_type(length, radius, threshold, words):
    """Numbers for some types, distributions for others. Cell 0 is of type 0; cell 1, of type 1, is
    small enough for any of these."""
    cells = tf.Cells(
        [[0.0, 0.0], [20.0, 0.0]], [[1.0, 0.0]] * 2, [length, 1.2], [radius, 0.5], cell_type=[0, 1]
    )
    scene = tf.Scene(tf.Division(length=threshold), founders=cells)
    if words is None:
        assert scene.bind(2).start().cells == 4
    else:
        with pytest.raises(tf.InputError, match=words):
            scene.bind(2)


def test_volume_threshold_that_leaves_no_room_for_caps_is_refused():
    short = float(capsule.volume(torch.tensor(0.9), torch.tensor(0.5)))
    with pytest.raises(tf.InputError, match=r"Division\.volume"):
        tf.Scene(tf.Division(volume=short), founders=row_of_cells(1, 0.2)).bind().start()


def test_flagged_cell_too_short_to_divide_stops_the_run_and_names_it():
    scene = tf.Scene(tf.Division(), founders=row_of_cells(2, 0.6))
    state = flagged(scene, 3, which=[5])
    with pytest.raises(tf.SimulationError, match=r"colony 2 .*cell 1 .*0\.6") as caught:
        list(tf.simulate(scene, state, until=0.1, dt=0.1))
    assert caught.value.colonies == (2,)


def test_a_cell_too_short_to_divide_keeps_its_whole_colony_from_dividing():
    """By the step itself a failure is no exception but a report for each colony, as a failed solve
    is."""
    scene = tf.Scene(tf.Division(), founders=row_of_cells(2, [3.0, 0.6]))
    after = step(scene, flagged(scene, 3, which=[0, 2, 3, 4]), 0.1)
    assert (
        after.counts.tolist() == [3, 2, 3]
        and after.divide_flag.tolist() == [False] * 3 + [True] * 2 + [False] * 3
    )
    assert after.reports["division"].status.tolist() == [0, 1, 0]
    assert not step(scene, flagged(scene, 3, which=[3]), 0.1).births, (
        "no division of no cell for a rule to see"
    )
    assert "division" not in step(scene, flagged(scene, 3, which=[0]), 0.1).reports


@pytest.mark.parametrize("by_torch", [False, True])
def test_a_wide_cell_needs_the_length_of_its_own_caps(by_torch, monkeypatch):
    """Radii are seldom 1 µm: a cell of 3 µm divides with a radius of 0.5 µm, not with one of 2."""
    pytest.importorskip("numba")  # kernels divide where it has been loaded
    if by_torch:
        monkeypatch.setattr("torchfilm.effects.division.knows_due", lambda *_: False)
    scene = tf.Scene(tf.Division(), founders=row_of_cells(1, 3.0))
    state = flagged(scene, 2)
    after = step(scene, state.replace(radius=state.radius * torch.tensor([1.0, 4.0])), 0.1)
    assert after.counts.tolist() == [2, 1]
    report = after.reports["division"]
    assert report.status.tolist() == [0, 1] and float(report.needs[1]) == 4.0


def test_exactly_two_radii_may_divide():
    """l = 2r leaves two spheres: the limit, and allowed."""
    scene = tf.Scene(tf.Division(), founders=row_of_cells(1, 1.0))
    assert step(scene, flagged(scene), 0.1).length.tolist() == [0.0, 0.0]


def test_beside_a_colony_that_cannot_divide_each_keeps_its_own_fraction():
    """The first colony fails; cells of the others get their own shares, also drawn ones."""
    for fraction in ([0.4, 0.25, 0.3], tf.Uniform([0.4, 0.25, 0.3], [0.41, 0.26, 0.31])):
        scene = tf.Scene(
            tf.Division(fraction=fraction, axis_noise=0.0), founders=row_of_cells(1, 3.0)
        )
        state = flagged(scene, 3)
        state = state.replace(length=state.length.clone().index_fill(0, torch.tensor([0]), 0.6))
        after = step(scene, state, 0.1)
        assert after.reports["division"].status.tolist() == [1, 0, 0]
        share = (after.length[1::2] + 1.0) / 4.0  # of the length with caps, 4 µm
        assert share.tolist() == pytest.approx([0.25, 0.3], abs=0.01)
