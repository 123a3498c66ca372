"""Statistics of colonies by hand: empty rings, outliers, copies of a cell, levels that are all
alike, and founders."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from design import Observed
from design.targets.statistics import _neighbours


def on_a_line(x, gfp) -> Observed:
    x = np.asarray(x, dtype=float)
    return Observed.from_table({"x_um": x, "y_um": 0.0 * x, "gfp": gfp}, species=["gfp"])


def values(target: Observed) -> dict[str, float]:
    return dict(zip(target.plan.names, target.values, strict=True))


def test_a_ring_without_cells_has_the_mean_of_the_colony():
    """The rings end at 2.5, 5, 7.5 and 10 µm."""
    found = values(on_a_line([-10.0, -1.0, 1.0, 10.0], [3.0, 1.0, 1.0, 3.0]))
    assert [found[f"gfp_ring_{k}"] for k in (1, 2, 3, 4)] == pytest.approx([1.0, 2.0, 2.0, 3.0])


def test_a_cell_far_from_its_colony_does_not_widen_the_rings():
    x = np.append(np.linspace(-5.0, 5.0, 99), 500.0)
    edges = on_a_line(x, np.ones(100)).plan.edges
    assert edges[-1] == pytest.approx(np.quantile(np.abs(x - x.mean()), 0.95))


def test_a_cell_that_was_drawn_twice_is_no_neighbour_of_itself():
    position = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.5, 0.0]], dtype=torch.float64)
    pairs = _neighbours(position, torch.zeros(3, dtype=torch.int64), 1.0)
    assert pairs.T.tolist() == [[0, 2], [1, 2]]


def test_levels_that_differ_by_rounding_are_alike():
    found = values(on_a_line(range(6), [0.1, np.nextafter(0.1, 1.0)] * 3))
    assert found["gfp_cv"] == 0.0 and found["gfp_neighbours"] == 0.0


def test_a_founder_that_has_not_divided_is_as_old_as_its_colony():
    target = Observed.from_table({"age_h": [0.0]})
    states = list(tf.simulate(tf.Scene(tf.Growth(rate=0.1), dim=2, dt=0.25), until=1.0))
    found = target.statistics(states[-1], torch.stack([target.note(s) for s in states]))
    assert states[-1].time == 1.0 and found[0, target.plan.names.index("age_50_h")] == 1.0
