"""The fresh seeds of finals: when they tell nothing, what they chose, and where all fail on one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from searching import Level, lit, mean

from design import NSGA2, Burden, Finals, Parameter, Search, Sobol, Study, Target
from design.entries import Entry
from design.finals import FIRST_STREAM, SOUND_STREAM, FreshLosses, is_certain
from design.report import fresh_words

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]


def batch(losses, first=0) -> Entry:
    """A design for each row of losses (n, R), on the seeds from `first` on."""
    losses = np.array(losses)
    n, r = losses.shape
    return Entry(
        points=np.linspace(0.1, 0.9, 2 * n).reshape(n, 2), loss=losses.mean(1), losses=losses,
        cells=np.ones((n, r), int), reasons={}, size=1.0, seconds=0.0, values=[{}] * n,
        streams=tuple(range(first, first + r)),
    )  # fmt: skip


@pytest.mark.parametrize(
    "searched, sounded, certain",
    [
        ([[0.3, 0.3]], [[0.1, 0.1], [0.2, 0.2]], True),
        ([[0.3, 0.3]], [[0.1, 0.1], [0.2, 0.3]], False),
        # two designs with one loss, as where both are within a range: that says nothing of seeds
        ([[0.3, 0.3]], [[0.0, 0.0], [0.0, 0.0]], False),
        # the best designs are alike on all seeds, and another one of the search is not
        ([[0.3, 0.3], [0.4, 0.5]], [[0.1, 0.1], [0.2, 0.2]], False),
        # a failure is no difference between seeds
        ([[0.3, 0.3], [0.4, Target.failed]], [[0.1, 0.1], [0.2, 0.2]], True),
    ],
)
def test_when_seeds_make_no_difference(searched, sounded, certain):
    task = Search(lit, LIT, Level(), cells=3, replicates=2).objective.task
    study = Study({}, task.space.names, (0, 1), entries=[batch(searched)])
    study.finals.append(batch(sounded, SOUND_STREAM))
    assert is_certain(task, study) == certain


def test_the_seeds_of_an_only_finalist_have_chosen_nothing():
    made = Search(
        lit, LIT, Level(), method=Sobol(batch=8), cells=3, replicates=2, finals=Finals(most=1)
    )
    best = made.run(60, progress=False)
    assert {e.streams[0] for e in made.study.finals} == {FIRST_STREAM}
    assert not best.fresh.chosen and "which chose it" not in best.table()


@dataclasses.dataclass(frozen=True)
class Uneven(Target):
    """The distance of the mean level from 1, and more on every second seed."""

    names = ("gfp",)
    failed = 1.5

    def loss(self, state, history=None):
        return (mean(state, "gfp") - 1.0).abs() + 0.1 * (state.stream % 2)


def test_a_loss_that_no_fresh_seed_has_tested_is_low_by_luck():
    method = Sobol(batch=4)
    words = "not tested on fresh seeds: where seeds matter"
    for replicates in (1, 2):
        made = uneven(method=method, finals=None, replicates=replicates)
        assert words in made.run(16, progress=False).table()
    # one design is no choice, and alike seeds are no luck
    assert words not in uneven(finals=None).run(2, progress=False).table()
    alike = Search(lit, LIT, Level(), method=method, cells=3, replicates=2, finals=None)
    assert words not in alike.run(16, progress=False).table()


def test_the_table_counts_fresh_seeds_that_failed():
    task = Search(lit, LIT, Uneven(), cells=3, replicates=2).objective.task
    losses = np.array([0.1, 0.2, Uneven.failed, 0.3])
    fresh = FreshLosses(losses, float(losses.mean()), (0.0, 1.0))
    assert "4 seeds; 1 of them failed, each counts 1.5000" in fresh_words(task, fresh)
    assert "failed" not in fresh_words(task, FreshLosses(losses[:2], 0.15, (0.0, 1.0)))


def uneven(**options) -> Search:
    options = {"method": Sobol(batch=8), "cells": 3, "replicates": 2} | options
    return Search(lit, LIT, Uneven(), **options)


def test_seeds_that_a_larger_budget_adds_have_chosen_nothing():
    made = uneven(finals=Finals(most=1))
    few = made.run(40, progress=False)
    more = made.run(60, progress=False)
    assert len(more.losses) > len(few.losses) and not few.fresh.chosen and not more.fresh.chosen


@pytest.mark.parametrize(
    ("colonies", "options", "seeds"),
    [
        (200, {"reduce": 0.99}, "299 fresh seeds, at 1 size"),
        (25, {}, "24 fresh seeds, at 1 size"),
        (60, {"finals": Finals(sizes=(1, 2))}, "24 fresh seeds, at 2 sizes"),
    ],
)
def test_a_budget_without_the_seeds_that_hold_a_loss_is_warned_of(colonies, options, seeds):
    made = uneven(**options)
    with pytest.warns(UserWarning, match=f"stop_at: .* holds a loss on {seeds}"):
        made.run(colonies, stop_at=1e3, progress=False)
    assert made.study.searched > 0.7 * colonies
    # of a mean 24 are enough, also beyond the share
    held = uneven().run(60, stop_at=1e3, progress=False)
    assert len(held.losses) == 24 and held.fresh.chosen


@dataclasses.dataclass(frozen=True)
class Chancy(Target):
    """The distance of the mean level from 1, undefined on one of the fresh seeds."""

    names = ("gfp",)

    def loss(self, state, history=None):
        return (mean(state, "gfp") - 1.0).abs().masked_fill(
            state.stream == FIRST_STREAM + 2, torch.nan
        )  # fmt: skip


def test_where_all_finalists_fail_on_a_fresh_seed_the_front_is_that_of_the_search():
    options = {"method": NSGA2(population=8), "cells": 3, "replicates": 2}
    search = Search(lit, LIT, targets=[Chancy(), Burden()], **options)
    with pytest.warns(UserWarning, match="fresh seeds failed there: the target's loss was nan"):
        front = search.run(400, progress=False)
    assert len(front) and front.seeds == 0
    assert len(front) == len(search.front(fresh=False))


def test_a_design_with_few_replicates_is_not_the_best():
    """As the first of a race at full size, and those of slopes at first."""
    whole, few = batch([[0.3, 0.5], [0.2, 0.4]]), batch([[0.1], [0.0]])
    study = Study({}, ("make", "decay"), (0, 1), entries=[few, whole])
    point, loss, losses = study.best()
    assert study.full() == [whole] and loss == pytest.approx(0.3)
    assert np.array_equal(point, whole.points[1]) and losses.tolist() == [0.2, 0.4]
