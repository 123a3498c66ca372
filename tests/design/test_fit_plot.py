"""Pictures of fits: measured numbers beside those of simulated colonies."""

import math

import numpy as np
import pytest
import torch

import torchfilm as tf
from design import (
    Conditions,
    Measured,
    Observed,
    ObservedCourse,
    OnFraction,
    Parameter,
    Prediction,
    Search,
)
from design.fit_plot import _places, spread_over
from design.targets.observed_conditions import checked_data
from design.targets.readings import readings_of

ONE = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
SPACE = [Parameter("make", 0.1, 10.0, log=True)]


def lit(make=1.0, dose=1.0) -> tf.Scene:
    rates = lambda u, s, p, cell: {"gfp": p.make * p.dose / (1.0 + p.dose) - u.gfp}
    circuit = tf.Circuit(rates, species="gfp", make=make, dose=dose)
    return tf.Scene(circuit, dim=2, dt=0.1, founders=ONE)


def gfp(state: tf.State) -> torch.Tensor:
    return state.groups.sum(state.gfp) / state.counts


def double(state: tf.State) -> torch.Tensor:
    return 2.0 * gfp(state)


def course(values=(0.5, 1.0, math.nan), times=(0.5, 1.0, 2.0)) -> ObservedCourse:
    return ObservedCourse.of_measures(
        {"gfp": gfp, "double": double}, times=times,
        values={"gfp": values, "double": [2 * v for v in values]},
        spread={"gfp": 0.1, "double": 0.2}, smooth=True,
    )  # fmt: skip


def picture(target, replicates=1):
    search = Search(lit, SPACE, target, replicates=replicates, dtype=torch.float64)
    best = search.run(colonies=24 * replicates, progress=False)
    return best, best.plot().figure


def drawn(ax) -> list[tuple[float, float]]:
    """The measured points."""
    return sorted(tuple(float(v[0]) for v in c.lines[0].get_data()) for c in ax.containers)


def test_courses_under_conditions_are_panels_of_lines():
    early, late = course(), course((0.2, 0.4, 0.6))
    both = Conditions([({"dose": 1.0}, early), ({"dose": 5.0}, late)])
    best, figure = picture(both)
    one, other, *_ = figure.axes
    assert (one.get_ylabel(), other.get_ylabel()) == ("gfp", "double")
    assert one.get_xlabel() == "time, h" and "fit of 10 readings" in figure.get_suptitle()
    assert drawn(one) == [(0.5, 0.2), (0.5, 0.5), (1.0, 0.4), (1.0, 1.0), (2.0, 0.6)]
    words = [t.get_text() for t in one.get_legend().get_texts()]
    assert words == ["dose = 1", "dose = 5", "best", "first guess", "measured"]
    solid = [
        line for line in one.lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 1
    ]
    make = best.values["make"]
    expected = make * 0.5 * (1 - np.exp(-np.array([0.5, 1.0])))
    assert solid[0].get_ydata() == pytest.approx(expected, rel=0.02)


def test_doses_of_one_time_are_an_axis_of_logarithms_with_a_place_for_none():
    at = lambda dose: Measured({"gfp": gfp}, {"gfp": 0.1}, {"gfp": 0.1}, time=1.0, smooth=True)
    doses = Conditions([({"dose": d}, at(d)) for d in (0.0, 0.01, 1.0, 100.0)])
    _, figure = picture(doses)
    ax = figure.axes[0]
    assert ax.get_xlabel().startswith("log10 dose; 0 at 0.00")
    places = [x for x, _ in drawn(ax)]
    assert places[1:] == pytest.approx([-2.0, 0.0, 2.0]) and -3.0 < places[0] < -2.4
    few = Conditions([({"dose": d}, at(d)) for d in (1.0, 2.0)])
    assert picture(few)[1].axes[0].get_xlabel() == "dose"


def test_ranges_are_bars_and_replicates_bands():
    frames = [
        Measured({"gfp": gfp}, {"gfp": wanted}, {"gfp": 0.1}, time=time, smooth=True)
        for time, wanted in ((0.5, (0.1, 0.4)), (1.0, (-math.inf, 0.9)), (2.0, 0.7))
    ]
    _, figure = picture(ObservedCourse(frames))
    ax = figure.axes[0]
    assert drawn(ax) == [(2.0, 0.7)]
    assert "v" in [line.get_marker() for line in ax.lines]
    assert [t.get_text() for t in ax.get_legend().get_texts()][-1] == "measured or wanted"


def test_other_targets_are_drawn_as_colonies():
    assert readings_of(OnFraction("gfp", 0.5, level=1.0)) == []
    state = lit().bind(1).start()
    seen = Observed.from_state(state.replace(step=1, time=0.5), species=["gfp"])
    assert readings_of(Conditions([({"dose": 1.0}, course()), ({"dose": 2.0}, seen)])) == []
    nothing = Prediction(seen, np.zeros((2, 1)), np.zeros((2, len(seen.values))))
    (ax,) = nothing.plot().figure.axes  # a row for each statistic, in place of curves
    assert len(ax.get_yticklabels()) == len(seen.values)


def test_a_prediction_is_a_band():
    data = checked_data(Conditions([({"dose": 1.0}, course()), ({"dose": 5.0}, course())]))
    values = np.array(data.values)
    shown = Prediction(data, np.zeros((3, 1)), np.stack([values - 0.1, values, values + 0.1]))
    figure = shown.plot().figure
    assert len(figure.axes) == 2 and len(figure.axes[0].collections) >= 2
    assert "of a right model" not in shown.table()
    far = Prediction(data, np.zeros((3, 1)), np.stack([values - 1, values, values + 1]))
    assert "give infer rounds=2 or more simulations" in far.table()


def test_lone_readings_and_several_inducers_are_seen():
    """A line of one point was none, and all doses stood at one place."""
    at = lambda dose: Measured(
        {"gfp": gfp}, {"gfp": 0.1 * dose}, {"gfp": 0.1}, time=1.0, smooth=True
    )
    few = Conditions([({"dose": 1.0}, course()), ({"dose": 5.0}, at(5.0))])
    assert readings_of(few)[-1].full == "gfp (dose = 5)"
    _, figure = picture(few)
    marks = [x.get_marker() for x in figure.axes[0].lines if len(x.get_xdata()) == 1]
    assert marks.count("_") == 2
    two = Conditions([({"dose": d, "make": m}, at(d)) for d in (1.0, 2.0) for m in (0.5, 1.0)])
    readings = readings_of(two)
    place, words, doses = _places(readings)
    assert words == "condition" and not doses and [place(r) for r in readings] == [0, 1, 2, 3]


def test_a_condition_without_the_first_measure_is_in_the_legend():
    one = ObservedCourse.of_measures(
        {"gfp": gfp}, times=(1.0, 0.5)[::-1], values={"gfp": (0.1, 0.2)}, spread={"gfp": 0.1}
    )
    other = ObservedCourse.of_measures(
        {"double": double}, times=(0.5, 1.0), values={"double": (0.1, 0.2)}, spread={"double": 0.1}
    )
    _, figure = picture(Conditions([({"dose": 1.0}, one), ({"dose": 5.0}, other)]))
    words = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert {"dose = 1", "dose = 5"} <= set(words)


def test_what_is_no_number_is_left_out():
    found = spread_over({"a": [1.0, math.nan, 3.0], "b": [math.nan]})
    assert found == {"a": (2.0, 1.0, 3.0)}


def test_a_number_alone_and_the_ranges_of_a_gate_are_drawn_as_colonies():
    alone = Measured({"gfp": gfp}, {"gfp": 0.5}, {"gfp": 0.1}, time=1.0, smooth=True)
    gate = Conditions([
        ({"dose": d}, Measured({"gfp": gfp}, {"gfp": wanted}, {"gfp": 0.1}, time=1.0))
        for d, wanted in ((0.0, (0.0, 0.1)), (5.0, (0.5, 1.0)))
    ])  # fmt: skip
    for target in (alone, gate):
        _, figure = picture(target)
        titles = [ax.get_title() for ax in figure.axes]
        assert any(t.startswith("first guess") for t in titles)
