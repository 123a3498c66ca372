"""What a user gets wrong is named: a keyword that is not known, and values of another type."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from searching import Level, lit, paced

import torchfilm as tf
from design import (
    Bands,
    Burden,
    Choice,
    Constrained,
    DomainSize,
    Duration,
    Finals,
    Gradient,
    Image,
    Lasting,
    Library,
    Objective,
    Observed,
    OnFraction,
    Oscillation,
    Parameter,
    Ring,
    Search,
    Sensor,
    SensorDevice,
    Sobol,
    Space,
    Spread,
    Stripe,
    Study,
    Task,
    Weighted,
    check_robustness,
    infer,
    load_weights,
    save_weights,
)

MAKE = [Parameter("make", 0.1, 10, log=True)]
RING = Ring("g", 5.0, 2.0)
RING_BEYOND = Ring("gfp", 60.0, 4.0)
TABLE = {"x_um": [0.0, 1.0, 2.0], "y_um": [0.0, 1.0, 2.0], "length_um": [2.0, 2.0, 3.0]}
OBSERVED = Observed.from_table(TABLE)


def search(**options):
    return Search(**{"scene": lit, "parameters": MAKE, "target": Level(), "cells": 3, **options})


@pytest.mark.parametrize(
    "of",
    [
        Parameter, Choice, Space, Search, Task, Objective, Finals, Sensor, SensorDevice, Stripe,
        Ring, Bands, Gradient, Image, Oscillation, DomainSize, OnFraction, Observed, Burden,
        Duration, Lasting, Spread, Weighted, Constrained, infer, check_robustness, save_weights,
        load_weights, Library.read, Observed.from_table, Observed.from_masks, Observed.from_state,
        Observed.from_results, search().run, search().objective.evaluate,
    ],
    ids=lambda of: of.__qualname__,
)  # fmt: skip
def test_an_unknown_keyword_is_named(of):
    with pytest.raises(tf.InputError, match=f"{of.__name__} has no parameter 'unheard_of'"):
        of(unheard_of=1)


def test_a_keyword_is_suggested_and_a_missing_argument_named():
    with pytest.raises(tf.InputError, match=r"Search has no parameter 'cell'\. Did you mean cells"):
        search(cell=3)
    with pytest.raises(tf.InputError, match=r"Stripe: missing .*'species'.*width"):
        Stripe()


WRONG = {
    "log": (lambda: Parameter("k", 1, 2, log="yes"), r"Parameter\('k'\)\.log = 'yes'.*True, False"),
    "whole": (lambda: Parameter("k", 1, 2, whole="yes"), r"Parameter\('k'\)\.whole = 'yes'"),
    "per_colony": (
        lambda: Choice("k", ("a", "b"), per_colony="yes"),
        r"Choice\('k'\)\.per_colony = 'yes'",
    ),
    "resolve": (lambda: Choice("k", ("a", "b"), resolve=3), r"resolve = 3.*a function"),
    "point": (lambda: Space(MAKE).values(np.zeros(3)), r"point = .*1 coordinates in \[0, 1\]"),
    "values": (lambda: Space(MAKE).point(3), r"values = 3.*a dictionary.*make"),
    "fixed": (lambda: search(fixed=3), r"fixed = 3.*by name"),
    "replay": (lambda: search(replay="no"), r"replay = 'no'.*True, False"),
    "device": (lambda: search(device="gpu"), r"device = 'gpu'.*\"cpu\" or \"cuda\""),
    "streams": (
        lambda: search().objective.evaluate(np.zeros((1, 1)), streams=[0.5]),
        r"streams = \[0\.5\].*whole numbers",
    ),
    "points": (lambda: search().objective.evaluate("a"), r"points = 'a'.*numbers"),
    "task": (lambda: Objective(3), r"task = 3.*a Task"),
    "work items": (lambda: search().run(8, work_items="a"), r"work_items = 'a'.*whole number from"),
    "study": (lambda: search().run(8, study=3), r"study = 3.*path of a file"),
    "no study": (lambda: Study.read(3), r"study = 3.*path of a file"),
    "design": (lambda: search().design("a"), r"point = 'a'.*1 coordinates"),
    "colonies": (lambda: search().colonies("a"), r"point = 'a'.*1 coordinates"),
    "best": (lambda: check_robustness(3), r"best = 3.*a Best"),
    "more": (lambda: Constrained(RING, 3, {"contrast": 2.0}), r"Constrained\.more = 3.*a list"),
    "at_least": (lambda: Constrained(RING, at_least=3), r"at_least = 3.*bounds by measure"),
    "like": (lambda: Observed.from_table(TABLE, like=3), r"Observed\(like\) = 3.*another Observed"),
    "like of masks": (
        lambda: Observed.from_masks(np.zeros((9, 9), int), pixel_size=0.1, like="a"),
        r"Observed\(like\) = 'a'",
    ),
    "species": (lambda: Observed.from_table(TABLE, species="gfp"), r"Observed\.species = 'gfp'"),
    "columns": (lambda: Observed.from_table(TABLE, columns=3), r"Observed\(columns\) = 3"),
    "state": (lambda: Observed.from_state(3), r"from_state\(state\) = 3.*tf\.State"),
    "fluorescence": (
        lambda: Observed.from_masks(np.zeros((9, 9), int), pixel_size=0.1, fluorescence=3),
        r"from_masks\(fluorescence\) = 3",
    ),
    "results": (lambda: Observed.from_results(3), r"path = 3.*path of a file"),
    "plan": (lambda: Observed((1.0,), (1.0,), "a"), r"Observed\.plan = 'a'"),
    "values of an Observed": (
        lambda: Observed(["a"], OBSERVED.spread, OBSERVED.plan),
        r"Observed\.values = \['a'\].*sequence of numbers",
    ),
    "module": (lambda: load_weights(3, "a.json"), r"module = 3.*torch\.nn\.Module"),
    "weights": (lambda: save_weights(torch.nn.Linear(1, 1), 3), r"path = 3.*path of a file"),
    "library": (lambda: Library.read(3), r"file = 3.*path of a file"),
    "sensor": (lambda: SensorDevice(3, 2.0, 1.0), r"SensorDevice\.name = 3"),
    "promoters": (lambda: SensorDevice("a", 2.0, 1.0, 3), r"promoters = 3.*a list of parts"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_value_of_another_type_is_named(case):
    call, message = WRONG[case]
    with pytest.raises(tf.InputError, match=message):
        call()


@pytest.mark.parametrize("method", ["sobol", "auto"])
def test_a_pattern_beyond_the_colonies_is_refused_after_the_first_batch(method):
    """Every design would have the same loss; the budget would be spent on nothing."""
    found = search(target=RING_BEYOND, cells=8, replicates=2, method=method)
    with pytest.raises(tf.InputError, match="do not reach the pattern"):
        found.run(colonies=200)
    assert 0 < found.study.colonies < 200


@pytest.mark.parametrize(
    "scene, parameters, target, options",
    [
        (
            paced,
            [Parameter("rate", 1.0, 2.2)],
            Ring("gfp", 12.0, 4.0, centre=(0.0, 0.0)),
            {"until": 2.0},
        ),
        (lit, MAKE, Ring("gfp", 5.0, 2.0, edge_width=1.5), {"cells": 8}),
    ],
    ids=["growth is searched", "the edge alone"],
)
def test_a_pattern_that_some_colony_may_reach_is_not_refused(scene, parameters, target, options):
    one = Sobol(batch=1)  # all losses of a batch are equal
    found = Search(scene, parameters, target, replicates=1, method=one, finals=None, **options)
    assert found.run(colonies=2).loss <= 2.0


@pytest.mark.parametrize(
    "given",
    [
        {"target": Weighted([(Ring("gfp", 2.0, 3.0), 1.0), (RING_BEYOND, 1.0)])},
        {"target": Constrained(Burden(), [RING_BEYOND], at_least={"contrast": 2.0})},
        {"target": None, "targets": [RING_BEYOND, Burden()]},
    ],
    ids=["a sum", "a constraint", "a front"],
)
def test_one_pattern_of_several_beyond_the_colonies_is_named(given):
    """The search would spend its budget on the others."""
    with pytest.raises(tf.InputError, match=r"the pattern .gfp in a ring of radius 60"):
        search(cells=8, replicates=2, **given).run(colonies=200, progress=False)


def test_a_stripe_beyond_the_colonies_is_refused_again_where_the_search_is_resumed(tmp_path):
    for _ in range(2):
        found = search(target=Stripe("gfp", at=200.0, width=4.0), cells=8, method=Sobol(batch=2))
        with pytest.raises(tf.InputError, match="do not reach the pattern"):
            found.run(colonies=40, study=tmp_path / "stripe.h5")
        assert len(found.study.entries) == 1, "nothing more is grown"


def test_what_is_no_executor_no_type_or_no_start_is_named():
    with pytest.raises(tf.InputError, match=r"executor = 4 .* ProcessPoolExecutor\(4\)"):
        search(cells=8, replicates=2).run(colonies=20, executor=4, progress=False)
    with pytest.raises(tf.InputError, match=r"^dtype = 'float64' .* torch.float64\.$"):
        search(cells=8, dtype="float64")
    with pytest.raises(tf.InputError, match=r"^start: make = 1000.0 .* Widen its bounds"):
        search(cells=8, start={"make": 1000.0, "decay": 1.0})


def test_warnings_of_a_scene_name_the_users_line():
    def unread(make=1.0, decay=1.0):
        circuit = tf.Circuit(lambda u, s, p, cell: {"gfp": p.make}, species="gfp", make=make,
                             decay=decay)  # fmt: skip
        return tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), circuit, dim=2)

    with pytest.warns(UserWarning, match="a constant that no rate reads") as found:
        Task(unread, [Parameter("make", 0.5, 2.0)], OnFraction("gfp", 0.5, 1.0), cells=4)
    assert {w.filename for w in found} == {__file__}


def test_founders_of_numbered_colonies_are_refused():
    """A batch of a search has other colonies than these: all but the first would have no cells."""

    def numbered(make):
        return lit(make).replace(founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], colony=[0]))

    with pytest.raises(tf.InputError, match=r"founders = .*cells of one colony.*leave colony out"):
        search(scene=numbered)
