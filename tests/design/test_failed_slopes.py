"""Derivatives beside designs and replicates that fail, and searches in which all fail."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from searching import Level, banned, grown, lit, objective_of

import torchfilm as tf
from design import Conditions, Measured, Parameter, Search, Sobol, Target
from design.derivatives import along
from design.scoring import _unfit, cut_work_items

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]


def test_a_design_whose_neighbour_fails_has_not_failed():
    objective = objective_of(
        banned, [Parameter("low", 3.0, 3.9)], Level(), cells=4, replicates=1
    )  # fmt: skip
    points = np.array([[0.195 / 0.9], [0.5]])  # the scene refuses what is beyond 3.2
    found = objective.evaluate(points, slopes=True)
    assert not found.reasons and (found.losses < Target.failed).all()
    assert np.isnan(found.slopes.gradient).ravel().tolist() == [True, False]


def level(state):
    return state.groups.sum(state.gfp.double() * state.volume) / state.groups.sum(state.volume)


def undefined(state):
    return level(state) * torch.nan


def test_a_replicate_that_fails_under_one_condition_has_no_slope():
    make = lambda measure: Measured({"gfp": measure}, {"gfp": 3.0}, {"gfp": 0.5}, smooth=True)
    target = Conditions([({"decay": 1.0}, make(level)), ({"decay": 2.0}, make(undefined))])
    space = [Parameter("make", 0.1, 10, log=True)]
    objective = objective_of(lit, space, target, cells=4, replicates=2)
    assert not objective.why_differences
    found = objective.evaluate(np.array([[0.5]]), slopes=True)
    assert len(found.reasons) == 2 and (found.slopes.gradient == 0).all()
    assert np.isnan(found.slopes.curvature).all()


def test_copies_for_derivatives_fit_into_a_batch():
    task = objective_of(lit, LIT, Level(), cells=4, replicates=2, most=4).task
    points = np.full((3, 2), 0.5)
    values = [task.space.values(p) for p in points]
    tangents = [along(task.space, p) for p in points]
    assert [i.rows for i in cut_work_items(task, values, 2, 1.0, 1)] == [(0,), (1, 2)]
    cut = cut_work_items(task, values, 2, 1.0, 1, tangents)
    assert [i.rows for i in cut] == [(0,), (1,), (2,)]


@dataclasses.dataclass(frozen=True)
class Undefined(Target):
    """No colony has a loss."""

    def loss(self, state, history=None):
        return torch.full((state.colonies,), torch.nan, dtype=torch.float64)


@pytest.mark.parametrize("budget, ends", [(400, 112), (128, 64), (40, 40)])
def test_a_search_in_vain_ends_after_a_quarter_of_its_budget(budget, ends):
    """But after 64 colonies at least."""
    options = {"method": Sobol(batch=8), "cells": 2, "replicates": 2, "finals": None}
    made = Search(lit, LIT, Undefined(), **options)
    made.run(budget, progress=False)
    assert made.study.colonies == ends


def test_half_of_an_odd_number_of_cells_is_rounded_up():
    scene = grown(2.0)
    *_, state = tf.simulate(scene, scene.bind(1, seed=0).start(), cells=3)
    assert state.counts.tolist() == [3]
    unfit = lambda cells: _unfit(
        objective_of(lit, LIT, Level(), cells=cells, until=2.0, replicates=1).task, state, 1.0
    )  # fmt: skip
    assert unfit(6) == [""] and unfit(7)[0].startswith("it has 3 cells")
