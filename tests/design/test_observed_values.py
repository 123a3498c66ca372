"""What data take from cells besides their statistics: times, widths, and what cannot be divided."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from searching import grown, paced

import torchfilm as tf
from design import Observed, ObservedCourse, Parameter, Search, Task
from torchfilm.tools.checks import InputError

TABLE = {"x_um": [0.0, 3.0, 6.0], "y_um": [0.0, 1.0, 2.0], "length_um": [2.0, 3.0, 2.5]}


def flat(rate=1.0):
    return grown(rate, 1.0, 1.0, tf.Mechanics(dim=2))


RATE = [Parameter("rate", 0.5, 2.0)]


@pytest.mark.parametrize(
    ("column", "options"),
    [
        ({"time_h": [1.5] * 3}, {}),
        ({"time_min": [90.0] * 3}, {}),
        ({"time_min": [90.0] * 3}, {"time": 1.5}),
        ({"time_min": [90.02] * 3}, {"time": 1.5}),  # rounded
    ],
)
def test_a_column_of_times_says_when_cells_were_observed(column, options):
    seen = Observed.from_table(TABLE | column, **options)
    assert seen.time == pytest.approx(1.5)
    with pytest.raises(InputError, match=r"until = 3\.0 .* 1\.5 h, when the target"):
        Search(paced, RATE, seen, until=3.0).run(colonies=20, progress=False)


def test_a_time_is_not_contradicted():
    with pytest.raises(InputError, match=r"Observed\(time\) = 3.* 1.5 h, as the column 'time_min'"):
        Observed.from_table(TABLE | {"time_min": [90] * 3}, time=3.0)
    with pytest.raises(InputError, match=r"0 h is not above 0.*founders"):
        Observed.from_table(TABLE | {"time_h": [0.0] * 3})


@pytest.mark.parametrize("column", [{"time": [4.0] * 3}, {"t": [4.0] * 3}, {"frame": [4] * 3}])
def test_what_may_be_the_number_of_a_frame_is_no_time(column):
    assert Observed.from_table(TABLE | column).time is None
    assert Observed.from_table(TABLE | column, time=2.0).time == 2.0
    aged = TABLE | column | {"age": [30.0] * 3}  # the unit is that of ages
    assert Observed.from_table(aged, time_unit="min").time is None


def test_a_unit_that_no_column_needs_is_still_refused():
    with pytest.raises(InputError, match="time_unit = 'min'"):
        Observed.from_table(TABLE | {"time_h": [1.5] * 3}, time_unit="min")


def test_cells_of_another_width_are_warned_of():
    seen = Observed.from_table(TABLE | {"radius_um": [0.35, 0.34, 0.36]})
    assert seen.width == pytest.approx(0.7)
    with pytest.warns(UserWarning, match=r"0\.70 µm wide, and those of the scene 1\.00 µm.*=0\.35"):
        Task(flat, RATE, seen, until=1.0)
    near = Observed.from_table(TABLE | {"radius_um": [0.45, 0.46, 0.44]})
    unknown = Observed.from_table(TABLE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for data in (near, unknown):
            Task(flat, RATE, data, until=1.0)
    assert unknown.width is None and seen.without("length").width == seen.width


def test_the_width_is_that_of_all_readers(tmp_path):
    *_, state = tf.simulate(paced(), until=0.5, dt=0.1)
    assert Observed.from_state(state).width == pytest.approx(1.0)
    recorder = tf.Recorder(tmp_path / "run.h5", paced())
    list(tf.simulate(paced(), until=0.5, dt=0.1, record=recorder))
    assert Observed.from_results(tmp_path / "run.h5").width == pytest.approx(1.0)
    image = np.zeros((40, 60), np.int64)
    image[10:17, 5:30] = 1
    image[22:29, 5:30] = 2
    assert Observed.from_masks(image, pixel_size=0.1).width == pytest.approx(0.7, abs=0.08)


@pytest.mark.parametrize(
    "column",
    [{"radius": [0.3] * 3}, {"radius_um": [0.3, -0.3, 0.3]}, {"radius_um": [0.3, None, 0.3]},
     {"radius_px": [3.0] * 3}],
)  # fmt: skip
def test_a_radius_that_says_nothing_is_left_aside(column):
    """The width serves a warning, and nothing else."""
    assert Observed.from_table(TABLE | column).width is None


def test_the_width_of_a_course_is_told_once():
    each = [Observed.from_table(TABLE | {"radius_um": [r] * 3}, time=t) for t, r in
            ((0.5, 0.33), (1.0, 0.35))]  # fmt: skip
    course = ObservedCourse(each)
    assert course.width == pytest.approx(0.68)
    with pytest.warns(UserWarning, match=r"0\.68 µm wide") as told:
        Task(flat, RATE, course)
    assert len({str(w.message) for w in told}) == 1


def test_a_width_is_nothing_that_losses_depend_on():
    """Older studies go on."""
    one, other = (Observed.from_table(TABLE | {"radius_um": [r] * 3}) for r in (0.45, 0.5))
    assert repr(one) == repr(other) and tf.digest(one) == tf.digest(other) and one == other


@pytest.mark.parametrize(
    ("levels", "sound"),
    [
        ([0.0, 0.0, 6.0], True),  # two cells are off: no level is below 0
        ([90.0, 110.0, 100.0], True),
        ([-1.0, 40.0, 41.0], False),  # 26.7 ± 13.8
        ([-1.0, 60.0, 50.0, 40.0, 50.0, 60.0], True),
        ([-1.0, -2.0, 1.0], False),
        ([0.0, 0.0, 0.0], False),
    ],
)
def test_a_mean_that_is_not_above_0_divides_nothing(levels, sound):
    count = len(levels)
    table = {"x_um": 3.0 * np.arange(count), "y_um": np.zeros(count), "gfp": levels}
    if sound:
        seen = Observed.from_table(table, species=("gfp",), relative=True)
        assert np.isfinite(seen.values).all()
        return
    with pytest.raises(InputError, match=r"the mean of gfp in colony 0 .* relative=True divides"):
        Observed.from_table(table, species=("gfp",), relative=True)
    assert Observed.from_table(table, species=("gfp",)).plan.species == ("gfp",)
