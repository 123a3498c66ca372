"""A search starts from designs that are known, and keeps the losses of a study of the same task."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from searching import Level, built, lit, paced

import torchfilm as tf
from design import CMAES, Bayesian, Choice, Local, Parameter, Racing, Search, Sobol, Study
from design.known_studies import read_parameter

NARROW = [Parameter("make", 0.5, 2.0, log=True)]
WIDE = [Parameter("make", 0.1, 10.0, log=True)]


def search(parameters=WIDE, scene=lit, **options):
    options = {
        "method": Sobol(batch=3), "cells": 3, "replicates": 2, "finals": None, **options
    }  # fmt: skip
    return Search(scene, parameters, Level(wanted=1.0), **options)


def test_designs_by_name_are_grown_first():
    made = search(start=[{"make": 3.0}, {"make": 0.2, "decay": 1.0}])
    made.run(10, progress=False)
    first = made.study.entries[0]
    assert [v["make"] for v in first.values] == pytest.approx([3.0, 0.2])
    assert first.colonies == 4 and made.study.colonies == 10
    alone = search()
    alone.run(6, progress=False)
    assert np.array_equal(made.study.entries[1].points, alone.study.entries[0].points)


def test_wider_bounds_keep_the_losses(tmp_path):
    old = search(NARROW)
    old.run(12, study=tmp_path / "old.h5", progress=False)
    made = search(start=tmp_path / "old.h5")
    known = made.study.entries[0]
    assert known.colonies == 0 and len(known.points) == 6
    for entry_values, loss in zip(known.values, known.loss, strict=True):
        found = made.objective.evaluate(made.objective.task.space.point(entry_values)[None])
        # the coordinate is rounded in another place
        assert found.loss[0] == pytest.approx(loss, rel=1e-6)
    assert made.best().loss == old.best().loss
    made.run(6, study=tmp_path / "new.h5", progress=False)
    assert made.study.colonies == 6 and len(made.study.entries) == 2
    again = search(start=Study.read(tmp_path / "old.h5"))
    again.run(12, study=tmp_path / "new.h5", progress=False)
    assert again.study.colonies == 12 and len(again.study.entries) == 3


def test_a_parameter_that_is_added_has_its_known_value():
    old = search(NARROW)
    old.run(12, progress=False)
    made = search([*WIDE, Parameter("decay", 0.5, 2.0)], start=old.study)
    known = made.study.entries[0]
    assert known.copies == 0 and {v["decay"] for v in known.values} == {1.0}
    fixed = search(NARROW, fixed={"decay": 1.5})
    fixed.run(12, progress=False)
    made = search([*WIDE, Parameter("decay", 0.5, 2.0)], start=fixed.study)
    known = made.study.entries[0]
    assert known.copies == 0 and {v["decay"] for v in known.values} == {1.5}


@pytest.mark.parametrize(
    "options, words",
    [({"seed": 3}, "seed"), ({"cells": 4}, "cells"), ({"fixed": {"decay": 2.0}}, "fixed")],
)
def test_the_best_designs_of_another_task_are_grown_again(options, words, capsys):
    old = search(NARROW)
    old.run(12, progress=False)
    made = search(start=old.study, **options)
    assert not made.study.entries and words in made._known.why
    made.run(12, progress=False)
    said = capsys.readouterr().err
    assert "its losses do not hold here (another " in said and words in said
    assert "so its 6 best designs are grown again" in said
    least = np.sort([x for e in old.study.entries for x in e.loss])
    assert made.study.entries[0].colonies == 12 and len(least) == 6
    assert [v["make"] for v in made.study.entries[0].values] == pytest.approx(
        [old.study.entries[k // 3].values[k % 3]["make"] for k in order_of(old)]
    )


def order_of(made):
    return np.argsort(np.concatenate([e.loss for e in made.study.entries]), kind="stable")


def test_narrower_bounds_leave_designs_out(capsys):
    old = search(WIDE)
    old.run(24, progress=False)
    made = search(NARROW, start=old.study)
    inside = [v for e in old.study.entries for v in e.values if 0.5 <= v["make"] <= 2.0]
    assert 0 < len(inside) < 12 and len(made.study.entries[0].points) == len(inside)
    made.run(2, progress=False)
    beyond = f"start: {12 - len(inside)} of its 12 designs lie beyond the bounds."
    assert capsys.readouterr().err == beyond + "\n"


def test_a_saved_design_and_a_best_are_starts(tmp_path):
    old = search(NARROW)
    best = old.run(12, progress=False)
    for start in (best, best.save(tmp_path / "best.json"), [best, {"make": 1.0}]):
        made = search(start=start)
        assert made._known.points[0] == pytest.approx(made.objective.task.space.point(best.values))


@pytest.mark.parametrize(
    "method",
    [
        CMAES(population=4),
        Racing(inner=CMAES(population=4), sizes=(0.5, 1.0)),
        Local(starts=1),
        Bayesian(batch=2),
    ],
    ids=lambda m: type(m).__name__,
)
def test_methods_learn_what_is_known(method):
    start = [{"make": 1.1}, {"make": 8.0}, {"make": 0.2}]
    made = search(method=method, start=start, cells=4)
    made.run(20, progress=False)
    space = made.objective.task.space
    first, next_one = made.study.entries[:2]
    assert len(first.points) == 3
    near = np.abs(next_one.points - space.point({"make": 1.1})).max(1)
    if isinstance(method, Bayesian):
        assert len(next_one.points) == 2  # no first batch of Sobol points
    elif isinstance(method, Local):
        assert near[0] == pytest.approx(0.0, abs=1e-12)
    else:
        assert np.median(near) < 0.3


@pytest.mark.parametrize(
    "start, words",
    [
        ([], "start.*at least one design"),
        ({"mke": 1.0}, "start = 'mke'.*a parameter of lit: make, decay"),
        ({"make": 99.0}, "make = 99.0"),
        (3, "start = 3.*values by name"),
        ("no.json", "start = 'no.json'.*a file that exists"),
        ("no.h5", "start = 'no.h5'.*a file that exists"),
    ],
)
def test_bad_starts_are_refused(start, words):
    with pytest.raises(tf.InputError, match=words):
        search(start=start)


def test_a_study_without_a_design_within_the_bounds_is_refused():
    old = search(WIDE)
    old.run(12, progress=False)
    with pytest.raises(tf.InputError, match=r"a study of 6 designs.*within the bounds"):
        search([Parameter("make", 9.99, 10.0)], start=old.study)


def test_a_study_of_another_start_is_refused(tmp_path):
    search(start={"make": 1.0}).run(6, study=tmp_path / "s.h5", progress=False)
    with pytest.raises(tf.InputError, match="Different: start"):
        search(start={"make": 2.0}).run(6, study=tmp_path / "s.h5", progress=False)
    with pytest.raises(tf.InputError, match="Different: start"):
        search().run(6, study=tmp_path / "s.h5", progress=False)


def test_a_start_without_a_value_that_the_scene_needs_is_refused():
    def bare(make):
        return lit(make)

    with pytest.raises(tf.InputError, match=r"start has no value for 'make'.*start={'make': …}"):
        search([Parameter("make", 0.1, 10)], bare, start={})


@pytest.mark.parametrize(
    "parameter",
    [
        Parameter("a", 0.1, 10, log=True),
        Parameter("a", -1.5, 2),
        Parameter("a", 1, 5, whole=True),
        Choice("a", ("weak", "strong")),
        Choice("a", (2, 2.5, "x or y")),
    ],
    ids=str,
)
def test_a_stated_parameter_is_read_again(parameter):
    assert read_parameter(parameter.describe()) == parameter


def test_choices_and_paces_are_compared():
    kinds = [Choice("promoter", ("weak", "strong")), Parameter("make", 1.0, 2.0)]
    old = Search(built, kinds, Level("g0"), cells=3, replicates=1, finals=None, method="sobol")
    old.run(4, progress=False)
    wide = [kinds[0], Parameter("make", 0.5, 2.5)]
    made = Search(built, wide, Level("g0"), cells=3, replicates=1, start=old.study)
    assert made.study.entries[0].copies == 0
    paced_search = search([Parameter("rate", 1.2, 2.0)], paced)
    paced_search.run(6, progress=False)
    wider = search([Parameter("rate", 1.0, 2.4)], paced, start=paced_search.study)
    assert wider.study.entries[0].copies == 0


def lit_together(kind=("a",), decay=1.0):
    """The choice is a list, with one option for each colony."""
    assert isinstance(kind, list)
    return lit(torch.tensor([{"a": 1.0, "b": 3.0}[k] for k in kind]), decay)


def test_choices_per_colony_keep_the_losses():
    kinds = Choice("kind", ("a", "b"), per_colony=True)
    old = search([kinds, Parameter("decay", 0.8, 1.2)], lit_together)
    old.run(12, progress=False)
    made = search([kinds, Parameter("decay", 0.5, 2.0)], lit_together, start=old.study)
    assert made.study.entries[0].copies == 0 and made._known.why == ""
