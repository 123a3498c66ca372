"""Divisions as they are noted in each step, and the statistics of cell cycles."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from design.targets.cycles import COLUMNS, CycleStatistics, division_note

EVERY = CycleStatistics(lengths=True, sisters=True, mothers=True, mothers_lengths=True)


def test_notes_go_by_the_ids_of_colonies_and_hold_all_divisions_of_a_step():
    founders = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, [4.45, 4.4])
    division = tf.Division(length=4.5, fraction=0.3)
    scene = tf.Scene(tf.Growth(rate=1.0), division, founders=founders, dt=0.1)
    model = scene.bind(4)
    state = model.step(model.start().select([3, 1]))
    (births,) = state.births
    notes = division_note(state)
    assert notes.shape == (2, 15) and len(births.rows) == 4
    for place, events in enumerate(notes[:, 1:].reshape(2, 2, 7)):
        mine = births.before.colony[births.rows] == place
        assert events[:, 0].tolist() == (births.before.uid[births.rows][mine] + 1).tolist()
        assert (events[:, 3:5].T.flatten().long() == births.uid[mine.repeat(2)]).all()
        # of the shares 0.3 and 0.7
        lengths = 0.3 * (events[:, 1] + 1.0) - 1.0, 0.7 * (events[:, 1] + 1.0) - 1.0
        torch.testing.assert_close(events[:, 5], lengths[0], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(events[:, 6], lengths[1], rtol=1e-5, atol=1e-6)
    one = division_note(state.select([1]).replace(births=state.births))
    torch.testing.assert_close(one[0], notes[1])
    twice = division_note(state.replace(births=(births, births)))
    assert twice.shape == (2, 29) and torch.equal(twice[:, 1:15:7], twice[:, 15::7])


@pytest.mark.parametrize(
    ("name", "x", "y"),
    [
        ("generation_time_sisters", "time", "sister time"),
        ("generation_time_mothers", "time", "mother time"),
        ("birth_length_mothers", "birth", "mother birth"),
        ("growth_mothers", "growth", "mother growth"),
    ],
)
def test_each_correlation_is_of_its_own_columns(name, x, y):
    rows = np.random.default_rng(1).uniform(1.0, 2.0, (30, len(COLUMNS)))
    found = dict(zip(EVERY.names, EVERY.of_rows(rows), strict=True))[name]
    one, other = rows[:, COLUMNS.index(x)], rows[:, COLUMNS.index(y)]
    assert found == pytest.approx(np.corrcoef(one, other)[0, 1])
