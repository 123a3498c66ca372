"""Many frames that are read at once have the cells, the fields and the values of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import torchfilm as tf
from torchfilm.io import blocks
from torchfilm.pictures.place_and_time import known_quantities


@dataclass(frozen=True, eq=False)
class Dose(tf.Effect):
    """A number of each colony that changes in every step."""

    title, stage = "dose", 5.0

    def declares(self, dim):
        return (tf.Field("dose", "a dose of each colony", scope="colony"),)

    def reads(self):
        return ("dose",)

    def writes(self):
        return ("dose",)

    def step(self, state, dt, values):
        return state.with_fields(dose=state.dose + 1.0 + state.colony_id)


SCENE = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), Dose(), dim=2, dt=0.05)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run.h5"
    tf.simulate(SCENE, colonies=3, until=1.5, record=tf.Recorder(path, SCENE, every=2)).last()
    return path


@pytest.mark.parametrize("most", [1, 600, 1100, 1 << 18])
def test_blocks_are_no_larger_than_they_may_be_and_lose_nothing(run, monkeypatch, most):
    monkeypatch.setattr(blocks, "MOST_ROWS", most)
    with tf.Results(run) as results:
        for frames in (range(len(results)), [5, 2, 9, 2, 0], range(4, 9)):
            parts = [*blocks.blocks(results, frames)]
            assert np.concatenate([p.frames for p in parts]).tolist() == [*frames]
            assert most > 1 or len(parts) == len(frames)
            for part in parts:
                check(part, results, most)


def check(part, results, most):
    assert len(part.frames) == 1 or part._high - part._low <= most
    found = part.cells()
    dose = part.colony_fields(found["colony"])["dose"]
    for k, frame in enumerate(part.frames.tolist()):
        mine, own = part.which == k, results.frame(frame)
        assert np.array_equal(found["uid"][mine], own["uid"])
        of_colonies = results.colony_fields(frame)["dose"]
        assert np.array_equal(dose[mine], of_colonies[own["colony"]])


def test_fields_of_colonies_are_columns_of_tables(run):
    with tf.Results(run) as results:
        last, state = results.table(-1), results.state(SCENE)
    assert np.array_equal(last["dose"], 30.0 * (1 + last["colony"]))
    some = state.select([2, 0])
    made = tf.cell_table(some)
    assert np.array_equal(made["colony"], some.own_colony_id.numpy())
    assert np.array_equal(made["dose"], some.dose[some.colony].numpy())
    assert set(made["dose"]) == {90.0, 30.0}


def test_ages_in_pictures_are_those_at_the_hours_of_their_frames(run, monkeypatch):
    monkeypatch.setattr(blocks, "MOST_ROWS", 600)
    with tf.Results(run) as results:
        seen = [known for _, known in known_quantities(results, "age", "born")]
        table = results.table()
    for name in ("age", "born"):
        assert np.array_equal(np.concatenate([known[name] for known in seen]), table[name])
