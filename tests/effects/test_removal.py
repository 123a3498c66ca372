"""Removal: cells that leave a region are gone, and the lineage remembers them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from helpers import step

import torchfilm as tf
from torchfilm.effect import Effect


@dataclass(frozen=True)
class Drift(Effect):
    """Everything moves along x at `speed` µm/h: so that cells leave without any mechanics."""

    speed: float = 1.0
    stage = 45
    title = "drift"

    def writes(self):
        return ("position",)

    def step(self, state, dt, values):
        move = torch.zeros_like(state.position)
        move[:, 0] = self.speed * dt
        return state.replace(position=state.position + move)


def at(*x: float, dim: int = 2) -> tf.Cells:
    position = torch.zeros(len(x), dim, dtype=torch.float64)
    position[:, 0] = torch.tensor(x, dtype=torch.float64)
    axis = torch.zeros_like(position)
    axis[:, 1] = 1.0
    return tf.Cells(position, axis)


def test_cells_whose_centre_leaves_are_gone(device, dtype):
    scene = tf.Scene(Drift(), tf.Removal((-10.0, -10.0), (10.0, 10.0)), founders=at(0.0, 5.0, 9.5))
    state = step(scene, scene.bind(2, device=device, dtype=dtype).start(), 1.0)
    assert state.counts.tolist() == [2, 2]
    assert state.uid.tolist() == [0, 1, 0, 1]
    (note,) = state.ended
    assert note.fate == "left" and note.uid.tolist() == [2, 2] and note.colony_id.tolist() == [0, 1]
    assert not step(scene, state, 1.0).ended


def test_a_cell_on_the_edge_stays():
    scene = tf.Scene(Drift(), tf.Removal((-10.0, -10.0), (10.0, 10.0)), founders=at(9.0))
    state = step(scene, scene.bind().start(), 1.0)
    assert state.cells == 1 and float(state.position[0, 0]) == 10.0


@pytest.mark.parametrize("dim", [2, 3])
def test_an_open_side_loses_none(dim):
    low, high = [-math.inf] * dim, [math.inf] * dim
    high[1] = 1.0
    scene = tf.Scene(Drift(speed=1e6), tf.Removal(low, high), founders=at(0.0, dim=dim))
    assert step(scene, scene.bind().start(), 1.0).cells == 1


def test_a_colony_may_lose_all_its_cells_and_the_others_go_on():
    cells = tf.Cells([[9.5, 0.0], [0.0, 0.0]], [[0.0, 1.0]] * 2, colony=[0, 1])
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=3.0),
        tf.Mechanics(dim=2),
        Drift(),
        tf.Removal((-10, -10), (10, 10)),
        founders=cells,
    )
    state = scene.bind().start()
    for _ in range(16):
        state = step(scene, state, 0.0625)
    assert state.counts.tolist() == [0, 2] and state.colonies == 2
    assert torch.isfinite(state.position).all()


def test_a_region_of_several_pieces_is_all_of_them():
    """Two removals: a cell must be inside both."""
    scene = tf.Scene(
        tf.Removal((-10, -10), (10, 10)),
        Drift(),
        tf.Removal((-5, -5), (5, 5)),
        founders=at(0.0, 4.5),
    )
    assert step(scene, scene.bind().start(), 1.0).uid.tolist() == [0]


def test_the_results_file_remembers_who_left_and_who_was_removed(tmp_path):
    def update(cells):
        cells.remove_flag = (cells.uid == 1) & (cells.time >= 2.0)

    scene = tf.Scene(
        tf.Rules(update),
        Drift(),
        tf.Removal((-10.0, -10.0), (10.0, 10.0)),
        founders=at(0.0, 1.0, 8.5),
    )
    for _ in tf.simulate(
        scene, scene.bind(2).start(), until=4.0, dt=1.0, record=tmp_path / "run.h5"
    ):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        found = results.lineage()
        assert results.counts[-1].tolist() == [1, 1]
    assert found.colony.tolist() == [0, 0, 0, 1, 1, 1]
    assert found.cell.tolist() == [0, 1, 2] * 2
    assert found.fate.tolist() == ["alive", "removed", "left"] * 2
    # the rule sees t = 2 in the third step; 8.5 + 2 passes 10 in the second
    assert np.allclose(found.ended, [np.nan, 3, 2] * 2, equal_nan=True)


def test_removed_and_divided_in_one_step_are_both_noted(tmp_path):
    def update(cells):
        cells.divide_flag = cells.uid == 0
        cells.remove_flag = cells.uid == 1

    scene = tf.Scene(tf.Rules(update), tf.Division(), founders=at(0.0, 5.0))
    state = step(scene, scene.bind().start(), 0.1)
    assert {n.fate: n.uid.tolist() for n in state.ended} == {"removed": [1], "divided": [0]}
    assert state.uid.tolist() == [2, 3]


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((1.0, 0.0), (0.0, 1.0)),
        ((0.0, 0.0), (0.0, 1.0)),
        ((0.0,), (1.0, 1.0)),
        ((math.nan, 0.0), (1.0, 1.0)),
        (0.0, 1.0),
        ("ab", "cd"),
    ],
    ids=["inside out", "flat", "unequal", "nan", "no corner", "text"],
)
def test_bad_regions_are_refused(low, high):
    with pytest.raises(tf.InputError, match=r"Removal\.low"):
        tf.Removal(low, high)


def test_a_corner_that_is_left_out_is_no_limit():
    assert tf.Removal(high=(5.0, math.inf)).low == (-math.inf, -math.inf)
    assert tf.Removal(low=[0, 0, [1.0, 2.0]]).high == (math.inf,) * 3
    scene = tf.Scene(Drift(), tf.Removal(high=(10.0, math.inf)), founders=at(0.0, 9.5))
    *_, state = tf.simulate(scene, until=1.0)
    assert state.uid.tolist() == [0]
    with pytest.raises(tf.InputError, match="no limits: give low, high, or both"):
        tf.Removal()


def test_wrong_dimension_is_refused():
    with pytest.raises(tf.InputError, match=r"Removal\.low.*3 numbers"):
        tf.Scene(tf.Removal((-1, -1), (1, 1)), founders=at(0.0, dim=3)).bind().start()


def test_a_cell_outside_from_the_start_is_refused():
    with pytest.raises(tf.InputError, match=r"cell 1 of colony 0.*20"):
        tf.Scene(tf.Removal((-10, -10), (10, 10)), founders=at(0.0, 20.0)).bind().start()
