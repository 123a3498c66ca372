"""Exhaustive search: every design of a space of choices and whole numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from asking import Room
from searching import Level, lit

import torchfilm as tf
from design import Choice, Exhaustive, Finals, Parameter, Search
from design.finals import CHECK_STREAM
from design.methods import designs_of

FEW = [Parameter("make", 1, 3, whole=True), Choice("decay", (0.5, 1.0))]


def search(parameters=FEW, **options):
    options = {"cells": 4, "replicates": 2, **options}
    return Search(lit, parameters, Level(wanted=1.0), **options)


def test_every_design_comes_once():
    method, room = Exhaustive(batch=7), Room((3, 2, 1, 4))
    method.start(room, 5, 1)
    seen = []
    while not method.over:
        batch = method.ask()
        seen.append(batch.points)
        method.tell(batch, np.zeros(len(batch.points)))
    points = np.concatenate(seen)
    assert [len(x) for x in seen] == [7, 7, 7, 3]
    levels = np.floor(points * np.array(room.levels))
    assert len({tuple(x) for x in levels}) == 24 == len(points)
    assert np.allclose(points, (levels + 0.5) / np.array(room.levels))


def test_a_budget_that_grows_every_design_grows_each_once():
    made = search()
    best = made.run(100, progress=False)
    assert "exhaustive(batch=64) (6 different designs" in best.table()
    assert sum(len(e.points) for e in made.study.entries) == 6 and made.study.searched == 12
    # all that is left tests the best of them
    assert 90 <= made.study.colonies <= 100
    assert best.fresh is not None and len(best.losses) >= 20
    assert any(e.streams[0] >= CHECK_STREAM for e in made.study.finals)
    whole = search().objective.evaluate(np.concatenate([e.points for e in made.study.entries]))
    assert best.searched_loss <= np.sort(whole.loss)[1]


def test_all_options_of_a_long_choice_may_come_to_the_finals():
    options = tuple(0.3 + 0.01 * k for k in range(100))
    made = search([Choice("make", options, per_colony=True)], replicates=1, cells=3)
    made.run(400, progress=False)
    entries = made.study.entries
    order = np.argsort(np.concatenate([e.loss for e in entries]), kind="stable")
    points = np.concatenate([e.points for e in entries])
    first = next(e for e in made.study.finals)
    assert sorted(first.points.ravel()) == sorted(points[order[:8]].ravel())


def test_a_budget_whose_finals_leave_too_little_searches_as_elsewhere():
    assert "exhaustive" not in search(finals=Finals(share=0.6)).run(22, progress=False).table()
    assert "exhaustive" in search(finals=Finals(share=0.5)).run(24, progress=False).table()


def test_many_dimensions_have_no_end_of_designs():
    assert designs_of(Room((10,) * 400)) == math.inf


def test_a_smaller_budget_searches_as_elsewhere():
    best = search().run(11, progress=False)  # six designs of two take one more
    assert "exhaustive" not in best.table()
    more = [*FEW[:1], Parameter("decay", 0.5, 1.0)]
    assert "exhaustive" not in search(more).run(60, progress=False).table()


def test_without_finals_a_search_ends_where_all_is_known():
    made = search(finals=None, method="exhaustive")
    made.run(1000, progress=False)
    assert made.study.colonies == 12
    again = search(finals=Finals(share=0.5), method=Exhaustive(batch=4))
    again.run(9, progress=False)  # a part of them
    assert again.study.colonies <= 9


def test_it_goes_on_where_it_stopped(tmp_path):
    whole = search(method=Exhaustive(batch=4))
    expected = whole.run(40, progress=False)
    part = search(method=Exhaustive(batch=4))
    part.run(8, study=tmp_path / "s.h5", progress=False)
    best = search(method=Exhaustive(batch=4)).run(40, study=tmp_path / "s.h5", progress=False)
    assert best.values == expected.values


def test_parameters_without_levels_have_no_grid():
    with pytest.raises(tf.InputError, match="choices and whole numbers alone"):
        search([Parameter("make", 0.1, 1.0)], method="exhaustive").run(20, progress=False)
    with pytest.raises(tf.InputError, match="at most 100,000 designs"):
        search([Parameter("make", 1, 10**6, whole=True)], method="exhaustive").run(
            20, progress=False
        )
