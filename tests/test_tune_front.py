"""What accuracy costs: the front of tuned settings, its table and its picture."""

from __future__ import annotations

import dataclasses
import math

import pytest
from tuned_scenes import dividing, made

import torchfilm as tf
from torchfilm.tuning.observables import Error
from torchfilm.tuning.tuned import Trial


def trial(seconds: float, error: float, **settings) -> Trial:
    return Trial(tf.Settings(**settings), {"m": Error(error, 0.0)}, seconds, {})


@pytest.fixture
def priced() -> tf.Tuned:
    """A result of known errors and times: the scene's own settings, one that failed, one that two
    others beat, and a front of four."""
    circuit = tf.Circuit(made, species="m", k=1.0)
    given = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), circuit)
    own, chosen = trial(2.0, 0.02), trial(3.0, 0.008, dt=0.02, penalty=0.03, tolerance=0.1)
    front = [trial(1.0, 0.04, dt=0.05, rtol=0.1), chosen, trial(3.5, 0.007, dt=0.015)]
    front.append(trial(9.0, 0.002, dt=0.005))
    tries = [own, trial(0.5, math.inf, dt=0.2), front[1], trial(4.0, 0.02, dt=0.01), *front[2:]]
    tries.append(front[0])
    tuned = tf.tune(dividing(), 0.05, cells=2, colonies=2, of=["m"])
    settings = chosen.settings
    changes = {"scene": settings.apply(given), "settings": settings, "error": 0.01, "parts": {}}
    return dataclasses.replace(tuned, given=given, chosen=chosen, own=own, tries=tries, **changes)


def test_the_front_is_what_nothing_beats_in_error_and_time(priced):
    assert [(t.seconds, t.worst) for t in priced.front] == [
        (1.0, 0.04),
        (2.0, 0.02),
        (3.0, 0.008),
        (3.5, 0.007),
        (9.0, 0.002),
    ]


def test_the_table_says_what_accuracy_costs_as_the_user_would_type_it(priced):
    """By name and in units of `Mechanics` and `Circuit`; what is hardly better than the chosen one
    is omitted."""
    lines = str(priced).splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("What accuracy costs: of 7 "))
    rows = [line.split() for line in lines[at + 1 : at + 6]]
    assert rows == [
        ["error", "time", "dt", "contact_overlap", "tolerance", "rtol"],
        ["4", "%", "(m)", "0.5", "0.05", "0.014", "0.07", "0.1"],
        ["2", "%", "(m)", "1", "0.025", "0.014", "0.07", "0.0001", "the", "scene's", "own"],
        ["0.8", "%", "(m)", "1.5", "0.02", "0.0042", "0.14", "0.0001", "chosen"],
        ["0.2", "%", "(m)", "4.5", "0.005", "0.014", "0.07", "0.0001"],
    ]
    assert "2 s for the window" in lines[at + 6]
    assert lines[at + 7] == (
        "  dt in h, contact_overlap in radii of cells; of settings with much the same error one is"
        " shown)"
    )


def test_the_picture_has_what_ran_the_front_and_both_settings(priced, tmp_path):
    picture = priced.plot(tmp_path / "cost.png")
    assert picture.path is not None and picture.path.stat().st_size > 0
    (ax,) = picture.figure.axes
    assert ax.get_xscale() == ax.get_yscale() == "log"
    places = {line.get_label(): line.get_xydata().tolist() for line in ax.lines}
    assert len(places["every setting that ran"]) == 6
    front = places["front: none is both faster and better"]
    assert [x for x, _ in front] == [0.5, 1.0, 1.5, 1.75, 4.5]
    assert places["the scene's own"] == [[1.0, pytest.approx(2.0)]]
    assert places["chosen"] == [[1.5, pytest.approx(0.8)]]
    assert {y for _, y in places["requested error"]} == {1.0}


def test_labels_of_the_front_end_in_the_picture(priced):
    figure = priced.plot().figure
    figure.draw_without_rendering()
    (ax,) = figure.axes
    assert ax.texts and all(
        text.get_window_extent().x1 < ax.get_window_extent().x1 for text in ax.texts
    )


def test_a_result_is_shown_as_its_tables(priced):
    """Shortly where a prompt names it."""
    assert repr(priced).startswith("Tuned(") and repr(priced).endswith(
        ", 1 %: dt=0.02, penalty=0.03, tolerance=0.1)"
    )
    assert "What accuracy costs" in priced._repr_html_()


def test_an_error_of_nothing_is_drawn_on_logarithmic_axes(priced):
    """Whole numbers of cells are often exact."""
    exact = dataclasses.replace(priced, tries=[priced.own, trial(9.0, 0.0, dt=0.005)])
    front = next(x for x in exact.plot().figure.axes[0].lines if "front" in x.get_label())
    assert min(front.get_ydata()) == pytest.approx(100 * 0.01 * 1e-3)
