"""Courses from label images, states and files, and data of two kinds at one time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from searching import grown, paced

import torchfilm as tf
from design import Measured, Observed, ObservedCourse, Parameter, Search
from torchfilm.tools.checks import InputError

RATE = [Parameter("rate", 0.5, 2.0, log=True)]


def masks(count):
    """A label image of as many cells, 0.9 µm by 2 µm at 0.1 µm a pixel."""
    image = np.zeros((40, 30 * count), np.int64)
    for k in range(count):
        image[10:19, 30 * k + 5 : 30 * k + 25] = k + 1
    return image


def varied(rate=1.0, make=1.0):
    return grown(tf.LogNormal(rate, 0.2), make)


def states(times, colonies=2):
    runs = tf.simulate(varied(1.2, 2.0), until=max(times), dt=0.1, colonies=colonies, seed=4)
    return [s for s in runs if any(abs(s.time - t) < 1e-6 for t in times)]


def test_frames_of_a_movie_are_a_course_and_no_replicates():
    movie = [masks(1), masks(2), masks(4)]
    course = ObservedCourse.from_masks(movie, times=(1.0, 2.0, 3.0), pixel_size=0.1)
    assert isinstance(course, ObservedCourse) and course.times == (1.0, 2.0, 3.0)
    each = [Observed.from_masks(m, time=t, pixel_size=0.1) for m, t in
            zip(movie, course.times, strict=True)]  # fmt: skip
    assert course == ObservedCourse(each)
    assert course.evidence["cells at 3 h"][0] == pytest.approx(4)


def test_several_colonies_at_each_time_and_their_fluorescence():
    bright = lambda image: 100 + 50 * image
    movie = [[masks(1), masks(2)], [masks(3), masks(4)]]
    course = ObservedCourse.from_masks(
        movie, times=(1.0, 2.0), pixel_size=0.1,
        fluorescence={"gfp": [[bright(m) for m in frame] for frame in movie]},
    )  # fmt: skip
    assert course.colonies == 2 and "gfp_mean at 2 h" in course.evidence
    assert [frame.cells for frame in course.frames] == [3, 7]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"times": (1.0,)}, "masks = '2 of them' .* list of 1, one for each time"),
        ({"masks": masks(2)}, "masks = '40 of them'"),
        ({"fluorescence": masks(2)}, "images of each time by field"),
        ({"fluorescence": {"gfp": [masks(2)]}}, r"fluorescence\['gfp'\] = '1 of them'"),
        ({"masks": [masks(1), masks(1) * 0]}, "at 2 h: .*no cell"),
        ({"times": (2.0, 1.0)}, "above that of the frame before"),
        ({"time": 3.0}, "time = 3.0 .* left out, as times are given"),
    ],
)
def test_wrong_movies(wrong, words):
    given = {"masks": [masks(1), masks(2)], "times": (1.0, 2.0), "pixel_size": 0.1} | wrong
    with pytest.raises((InputError, TypeError), match=words):
        ObservedCourse.from_masks(given.pop("masks"), **given)


def test_states_and_files_of_several_times(tmp_path):
    seen = states((1.0, 2.0))
    course = ObservedCourse.from_state(seen, species=("gfp",))
    assert course == ObservedCourse([Observed.from_state(s, species=("gfp",)) for s in seen])
    with pytest.raises(InputError, match=r"a list of states, one for each time\. Observed"):
        ObservedCourse.from_state(seen[0])
    recorder, scene = tf.Recorder(tmp_path / "run.h5", paced(1.2, 2.0), every=5), paced(1.2, 2.0)
    list(tf.simulate(scene, until=2.0, colonies=2, seed=4, record=recorder))
    of_file = ObservedCourse.from_results(tmp_path / "run.h5", species=("gfp",))
    assert of_file.times == (0.5, 1.0, 1.5, 2.0)  # the founders are no frame
    two = ObservedCourse.from_results(tmp_path / "run.h5", [2, -1], species=("gfp",))
    assert two.times == (1.0, 2.0) and two.frames[1] == of_file.frames[3]
    with pytest.raises(InputError, match="a list of frames, or None"):
        ObservedCourse.from_results(tmp_path / "run.h5", 2)


def volume(state):
    return state.groups.sum(state.volume)


def test_cells_and_a_measure_of_one_time_are_one_course():
    (state,) = states((2.0,), 4)
    cells = Observed.from_state(state, species=("gfp",)).without("alignment", "density")
    total = float(volume(state).mean())
    whole = Measured({"volume": volume}, {"volume": total}, {"volume": 1.0}, time=2.0)
    both = ObservedCourse([cells, whole])
    assert both.times == (2.0, 2.0) and both.time == 2.0
    assert "measured" in both.describe() or "at 2 h" in both.describe()
    assert both.evidence["volume at 2 h"] == (pytest.approx(total), 1.0)
    search = Search(varied, RATE, both, fixed={"make": 2.0}, until=2.0, replicates=2)
    best = search.run(colonies=80, progress=False)
    assert best.values["rate"] == pytest.approx(1.2, rel=0.1)
    # its loss is over the readings of both
    count, finished = len(cells.values), best.colonies()[0]
    apart = [float(x.loss(finished.state)[0]) for x in (cells, whole)]
    own = float(both.loss(finished.state, finished.history)[0])
    assert own == pytest.approx((count * apart[0] + apart[1]) / (count + 1))


def test_one_time_has_one_frame_of_each_kind():
    (state,) = states((2.0,))
    cells = Observed.from_state(state)
    number = Measured({"volume": volume}, {"volume": 9.0}, {"volume": 1.0}, time=2.0)
    for frames in ([cells, cells], [number, number], [cells, number, cells]):
        with pytest.raises(InputError, match="above that of the frame before, 2 h"):
            ObservedCourse(frames)


@pytest.mark.parametrize("name", ["cells", "length_50_um"])
def test_two_of_one_time_have_no_name_twice(name):
    (state,) = states((2.0,))
    number = Measured({name: volume}, {name: 9.0}, {name: 1.0}, time=2.0)
    with pytest.raises(InputError, match=rf"\['{name}'\] .* other names than the Observed of 2 h"):
        ObservedCourse([Observed.from_state(state), number])


def test_a_measure_that_is_no_number_at_the_end_is_named():
    (state,) = states((2.0,))
    number = Measured({"none": lambda s: volume(s) * math.nan}, {"none": 9.0}, {"none": 1.0},
                      time=2.0)  # fmt: skip
    why = ObservedCourse([Observed.from_state(state), number]).unfit(state)
    assert len(why) == 2 and all("none" in words for words in why)


def test_a_measure_is_of_as_many_colonies_as_it_says():
    one, many = (
        Measured({"volume": volume}, {"volume": 9.0}, {"volume": 1.0}, time=t, colonies=n)
        for t, n in ((1.0, 1), (2.0, 6))
    )
    course = ObservedCourse([one, many])
    assert [frame.colonies for frame in course.frames] == [1, 6] and course.colonies == 6
    with pytest.raises(InputError, match=r"Measured\.colonies = 0"):
        Measured({"volume": volume}, {"volume": 9.0}, {"volume": 1.0}, colonies=0)
