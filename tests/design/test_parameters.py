"""Parameters and the space that they span: values and coordinates are inverse, and bad input is
refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import torchfilm as tf
from design import Choice, Parameter, Space

ROUNDING = 1e-12
number = st.floats(1e-6, 1e6)
unit = st.floats(0.0, 1.0)


@pytest.mark.parametrize("log", [False, True])
@given(a=number, b=number, u=unit)
def test_value_and_coordinate_are_inverse(log, a, b, u):
    low, high = sorted((a, b))
    if high < low * 1.001:  # so narrow that a coordinate has few digits left
        high = low * 1.001
    p = Parameter("k", low, high, log=log)
    value = p.value(u)
    assert low <= value <= high
    # a value is rounded to 2⁻⁵² of its size; the error of its coordinate is that over the range
    width = math.log(high / low) if log else (high - low) / high
    assert p.coordinate(value) == pytest.approx(
        u, abs=1e-14 * (1 + abs(math.log(low)) + abs(math.log(high))) / width
    )
    assert p.coordinate(low) == 0.0 and p.coordinate(high) == 1.0


@pytest.mark.parametrize("low, high", [(0.1, 10.0), (1e-3, 7.0), (0.1, 0.7), (3.0, 1e5)])
@pytest.mark.parametrize("log", [False, True])
def test_the_ends_are_the_bounds_and_come_back(low, high, log):
    p = Parameter("k", low, high, log=log)
    assert p.value(0.0) == pytest.approx(low, rel=ROUNDING) and p.value(1.0) == pytest.approx(
        high, rel=ROUNDING
    )
    assert p.coordinate(p.value(0.0)) == pytest.approx(0.0, abs=ROUNDING) and p.coordinate(
        p.value(1.0)
    ) == pytest.approx(1.0, abs=ROUNDING)


def test_a_log_parameter_is_even_in_its_logarithm():
    p = Parameter("k3", 0.1, 10.0, log=True)
    assert [p.value(u) for u in (0.25, 0.5, 0.75)] == pytest.approx(
        [10**-0.5, 1.0, 10**0.5], rel=ROUNDING
    )
    assert Parameter("k3", 0.0, 10.0).value(0.25) == 2.5


@pytest.mark.parametrize("low, high", [(1, 4), (-2, 2), (0, 1), (5, 105)])
def test_whole_numbers_have_equal_shares_and_come_back(low, high):
    p = Parameter("genes", low, high, whole=True)
    count = high - low + 1
    assert p.levels == count
    middles = (np.arange(97 * count) + 0.5) / (97 * count)
    found = [p.value(u) for u in middles]
    assert all(type(v) is int for v in found)
    assert np.bincount(np.array(found) - low).tolist() == [97] * count
    assert p.value(0.0) == low and p.value(1.0) == high
    assert [p.value(p.coordinate(v)) for v in range(low, high + 1)] == list(range(low, high + 1))


@pytest.mark.parametrize(
    "options", [("weak", "strong"), (1, 2.5, "x"), (True, False), [0.1, 0.2, 0.3]]
)
def test_options_have_equal_shares_and_come_back(options):
    c = Choice("promoter", options)
    assert c.levels == len(options)
    found = [c.value((k + 0.5) / (20 * len(options))) for k in range(20 * len(options))]
    assert [found.count(o) for o in options] == [20] * len(options)
    assert c.value(1.0) == options[-1]
    assert [c.value(c.coordinate(o)) for o in options] == list(options)


def test_a_space_has_one_dimension_for_each_parameter():
    space = Space(
        [
            Parameter("k3", 0.1, 10, log=True),
            Parameter("genes", 1, 3, whole=True),
            Choice("promoter", ("weak", "strong")),
        ]
    )
    assert (space.size, space.names, space.levels) == (3, ("k3", "genes", "promoter"), (None, 3, 2))
    values = space.values(np.array([0.5, 0.9, 0.1]))
    assert values == {"k3": pytest.approx(1.0), "genes": 3, "promoter": "weak"}
    again = space.values(space.point(values))
    assert again == {**values, "k3": pytest.approx(values["k3"], rel=ROUNDING)}
    assert space.describe() == [
        "k3: 0.1 to 10.0 log",
        "genes: 1.0 to 3.0 whole",
        "promoter: 'weak' or 'strong'",
    ]


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Parameter("k", 2, 1), r"Parameter\('k'\) = \(2.0, 1.0\).*low < high.*Swap"),
        (lambda: Parameter("k", 1, 1), "low < high.*fixed={"),
        (
            lambda: Parameter("k", 0, 1, log=True),
            r"Parameter\('k'\).low = 0.0.*above 0 with log=True.*leave log out",
        ),
        (lambda: Parameter("k", -1, 1, log=True), "above 0 with log=True"),
        (lambda: Parameter("k", 1, 2.5, whole=True), r"\(1.0, 2.5\).*whole numbers"),
        (lambda: Parameter("k", 1, 2, log=True, whole=True), "one of the two"),
        (lambda: Parameter("k", float("nan"), 1), "low = nan.*finite"),
        (lambda: Parameter("k", 0, float("inf")), "high = inf.*finite"),
        (lambda: Parameter("k", "a", 1), "low = 'a'.*a number"),
        (lambda: Parameter("k 3", 0, 1), "Parameter.name = 'k 3'.*name of an argument"),
        (lambda: Parameter(3, 0, 1), "Parameter.name = 3"),
        (lambda: Choice("c", ("a",)), r"Choice\('c'\).options = \('a',\).*at least two different"),
        (lambda: Choice("c", ("a", "a")), "at least two different"),
        (lambda: Choice("c", (1, True)), "at least two different"),
        (lambda: Choice("c", "ab"), "at least two different"),
        (lambda: Choice("c", None), "at least two different"),
        (
            lambda: Choice("c", ([1], [2])),
            r"one of Choice\('c'\).options = \[1\].*a text, a number",
        ),
        (lambda: Choice("", ("a", "b")), "Choice.name = ''"),
        (lambda: Space([]), r"parameters = \[\].*at least one"),
        (lambda: Space(Parameter("k", 0, 1)), "a list of Parameter"),
        (lambda: Space([("k", 0, 1)]), "a list of Parameter"),
        (
            lambda: Space([Parameter("k", 0, 1), Choice("k", ("a", "b"))]),
            "parameters = 'k'.*named once",
        ),
        (
            lambda: Space([Parameter("decai", 0, 1)]).check(["decay", "k3"], "lux"),
            "'decai'.*a parameter of lux: decay, k3. Did you mean 'decay'",
        ),
        (lambda: Space([Parameter("zzz", 0, 1)]).check(["k3"], "lux"), "a parameter of lux: k3.$"),
        (
            lambda: Space([Parameter("k", 0, 1)]).point({"q": 1}),
            "one for each of k. 'q' is missing or unknown",
        ),
        (
            lambda: Space([Parameter("k", 0, 1)]).point({}),
            "one for each of k. 'k' is missing or unknown",
        ),
        (lambda: Parameter("k", 0, 1).coordinate(1.5), "k = 1.5.*at most 1"),
        (lambda: Parameter("k", 0, 3, whole=True).coordinate(1.5), "k = 1.5.*a whole number"),
        (lambda: Choice("c", ("a", "b")).coordinate("d"), "c = 'd'.*one of 'a', 'b'"),
    ],
)
def test_bad_input_is_refused(make, words):
    with pytest.raises(tf.InputError, match=words):
        make()


def test_options_of_numpy_are_numbers():
    for numbers in (np.array([1, 2]), (np.int64(1), np.int64(2))):
        options = Choice("a", numbers).options
        assert options == (1, 2) and all(type(x) is int for x in options)


def test_a_point_beyond_the_space_has_no_values():
    space = Space([Parameter("a", 1, 3, whole=True), Parameter("b", 0.1, 1.0)])
    assert space.values(np.array([1.0, 1.0 + 1e-12])) == {"a": 3, "b": 1.0}
    for point in ([-1.0, 0.5], [0.5, 2.0], [0.5, math.nan]):
        with pytest.raises(tf.InputError, match=r"point = .* 2 coordinates in \[0, 1\]"):
            space.values(np.array(point))
