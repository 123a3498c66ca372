"""What pictures call colonies, quantities and units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn import frame

import torchfilm as tf
from torchfilm import pictures
from torchfilm.pictures.colours import PlotStyle
from torchfilm.pictures.figures import choose_colonies
from torchfilm.pictures.frames import RecordedFrames
from torchfilm.pictures.page import plan_layout
from torchfilm.state import OUTSIDE

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure
from matplotlib.text import Text


@pytest.fixture(scope="module")
def selected(tmp_path_factory):
    """Colonies 2 and 1, in this order, which are in the places 0 and 1; a signal has the name of a
    species, whose unit is another one."""
    path = tmp_path_factory.mktemp("named") / "run.h5"
    scene = tf.Scene(
        tf.Growth(rate=2.0), tf.Division(length=3.0),
        tf.Medium(ahl=tf.Signal(0.0, initial=1.0), box=((-9, -9), (9, 9)), spacing=3.0),
        dim=2, dt=0.1, founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.5, cell_type=[1]),
    )  # fmt: skip
    start = scene.bind(3).start().select([2, 1])
    tf.simulate(scene, start, until=1.0, record=tf.Recorder(path, scene, every=1)).last()
    return path


def legend(figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].get_legend().texts]


def test_colonies_go_by_their_ids_in_titles(selected):
    note = choose_colonies(np.array([True, False]), np.array([4, 7]), None, 9)[1]
    assert note == " (colony 7 has no cells)"
    one = pictures.strip(selected, colonies=[2], count=2).figure
    assert "colony 2" in one.get_suptitle()
    narrow = pictures.strip(selected, count=11, whole=True).figure.axes
    assert [narrow[k].get_title() for k in (0, 11)] == ["2: 0 h", "1: 0 h"]
    lines = pictures.time_course(selected, by="cell_type").figure
    assert [text.split(",")[0] for text in legend(lines)] == ["colony 2", "colony 1"]


def test_narrow_panels_of_a_sheet_have_the_ids_alone():
    what = frame([[0, 0], [0, 60]] * 36, colony=np.repeat(np.arange(36), 2))
    drawn = tf.show(replace(what, colony_id=100 + np.arange(36)), dpi=50).figure
    assert [ax.get_title() for ax in drawn.axes[:36]] == [str(100 + k) for k in range(36)]


def test_hours_of_birth_are_of_the_colonies_own_cells(selected):
    with tf.Results(selected) as results:
        frames = RecordedFrames(results, [-1], asked=("born", "age"))
        table = results.table(-1)
        assert np.array_equal(frames[0].cells["born"], table["born"])
        assert np.array_equal(frames[0].cells["age"], table["age"])


def test_units_of_signals_are_their_own(selected):
    image = pictures.kymograph(selected, "out.ahl").figure
    assert image.axes[1].get_ylabel() == "mean of out.ahl (conc)"
    lines = pictures.time_course(selected, "out.ahl", "volume").figure
    assert [ax.get_ylabel() for ax in lines.axes[1:]] == [
        "mean of out.ahl (conc)",
        "mean of volume (µm³)",
    ]
    with tf.Results(selected) as results:
        frames = RecordedFrames(results, [-1], "ahl")
        frames.units = {**frames.units, "ahl": "molecules"}
        behind = plan_layout(frames, [0], PlotStyle(background="ahl")).behind
    assert behind.name == OUTSIDE + "ahl" and behind.title == "ahl outside (conc)"


@pytest.mark.parametrize("medium", [False, True])
def test_colonies_are_named_by_what_their_parameter_was_then(tmp_path, medium):
    more = [tf.Medium(m=tf.Signal(0.0), box=((-9, -9), (9, 9)), spacing=3.0)] if medium else []
    path = tmp_path / "run.h5"
    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
    made = lambda rate: tf.Scene(tf.Lysis(rate=rate), *more, founders=founders, dim=2, dt=0.1)
    tf.simulate(made([1e-9, 2e-9]), until=0.2, record=path).last()
    scene = made([3e-9, 4e-9])
    with tf.Results(path) as results:
        state = results.state(scene, changed=True)
    recorder = tf.Recorder(path, scene, append=True, changed=True)
    tf.simulate(scene, state, until=0.4, record=recorder).last()
    with tf.Results(path) as results:
        first, last = RecordedFrames(results, [0, -1])
        assert [first.name(k) for k in (0, 1)] == ["rate = 1e-09", "rate = 2e-09"]
        assert [last.name(k) for k in (0, 1)] == ["rate = 3e-09", "rate = 4e-09"]


def test_parameters_that_hardly_differ_have_names_of_their_own(tmp_path):
    """Colonies of one name are replicates, whose mean a time course draws."""
    scene = tf.Scene(tf.Growth(rate=[0.50001, 0.50002, 2.0]), dim=2, dt=0.1)
    tf.simulate(scene, until=0.5, record=tmp_path / "run.h5").last()
    course = pictures.time_course(tmp_path / "run.h5", "length")
    shown = [text.get_text() for text in course.figure.axes[0].get_legend().texts]
    assert shown == ["rate = 0.50001", "rate = 0.50002", "rate = 2"]


@pytest.mark.parametrize("width", [1000 / 3, 1e3 / 0.3, 10 / 0.3 * (1 - 1e-16), 7.0])
def test_a_scale_bar_is_at_most_three_tenths_of_the_width(width):
    """The logarithm of 99.99999999999999 is 2."""
    ax = Figure().add_subplot()
    ax.set_xlim(0, width)
    size = pictures.scale_bar(ax)
    assert 0.1 * width < size <= 0.3 * width


def test_values_of_ones_own_have_no_unit():
    state = tf.Scene(tf.Growth(rate=1.0), dim=2).bind().start()
    drawn = tf.show(state, values={"age": [7.0]})
    shown = {text.get_text() for text in drawn.figure.findobj(Text)}
    assert "age" in shown and "age (h)" not in shown
