"""The lineage of results: sisters, cousins, generations and the ages of poles, against what the
states of the run show; and hours where steps change."""

from __future__ import annotations

import itertools

import h5py
import numpy as np
import pytest
import torch
from recorded import make_scene, record

import torchfilm as tf


def rows_of(tree) -> dict[tuple[int, int], int]:
    return {
        pair: k for k, pair in enumerate(zip(tree.colony.tolist(), tree.cell.tolist(), strict=True))
    }


def poles_followed(states) -> dict[tuple[int, int], list[int]]:
    """By cell, how many divisions ago its ends against and along its axis were formed: by where
    daughters lie, and how they point."""
    ages: dict[tuple[int, int], list[int]] = {}
    before: dict[tuple[int, int], torch.Tensor] = {}
    for state in states:
        ids = zip(state.own_colony_id.tolist(), state.uid.tolist(), strict=True)
        now = {
            key: (state.position[k].double(), state.axis[k].double()) for k, key in enumerate(ids)
        }
        mothers = dict(
            zip(
                now,
                zip(state.own_colony_id.tolist(), state.parent.tolist(), strict=True),
                strict=True,
            )
        )
        for key, (place, axis) in now.items():
            mother = mothers[key]
            if key in before:
                assert float(axis @ before[key]) > 0.5, "a step turned a cell around"
            elif mother[1] < 0:
                ages[key] = [0, 0]
            else:
                (other,) = [k for k, m in mothers.items() if m == mother and k != key]
                along = float((place - now[other][0]) @ before[mother]) > 0
                same = float(axis @ before[mother]) > 0
                kept = ages[mother][int(along)] + 1
                ages[key] = [0, kept] if along == same else [kept, 0]
        before = {key: axis for key, (_, axis) in now.items()}
    return ages


def test_the_ages_of_poles_are_those_of_the_states(whole):
    path, states = whole
    with tf.Results(path) as results:
        tree = results.lineage()
    row, found = rows_of(tree), poles_followed(states)
    assert len(found) == len(tree) and int(tree.pole_age.max()) >= 3
    assert {key: max(ages) for key, ages in found.items()} == {
        key: int(tree.pole_age[k]) for key, k in row.items()
    }


def test_generations_and_sisters(whole):
    with tf.Results(whole[0]) as results:
        tree = results.lineage()
    row = rows_of(tree)
    for (colony, cell), k in row.items():
        assert tree.generation[k] == len(tree.ancestors(cell, colony))
        assert tree.pole_age[k] <= tree.generation[k]
        if tree.parent[k] < 0:
            assert tree.sister[k] == -1
        else:
            s = row[colony, int(tree.sister[k])]
            assert s != k and tree.parent[s] == tree.parent[k] and tree.sister[s] == cell
    table = pytest.importorskip("pandas") and tree.to_pandas()
    assert (table.generation == tree.generation).all() and (table.sister == tree.sister).all()


def test_pairs(whole):
    with tf.Results(whole[0]) as results:
        tree = results.lineage()
    mother = {k: rows_of(tree).get((int(c), int(p)), -1)
              for k, (c, p) in enumerate(zip(tree.colony, tree.parent, strict=True))}  # fmt: skip
    by_hand = {
        "mother": {(m, k) for k, m in mother.items() if m >= 0},
        "sister": set(),
        "cousin": set(),
    }
    for a, b in itertools.combinations(range(len(tree)), 2):
        if mother[a] < 0 or mother[b] < 0:
            continue
        if mother[a] == mother[b]:
            by_hand["sister"].add((a, b))
        elif (above := mother[mother[a]]) >= 0 and above == mother[mother[b]]:
            by_hand["cousin"].add((a, b))
    for relation, expected in by_hand.items():
        found = tree.pairs(relation)
        assert found.shape == (len(expected), 2) and len(expected) > 5
        as_pairs = {tuple(pair) for pair in found.tolist()}
        assert (
            as_pairs if relation == "mother" else {tuple(sorted(p)) for p in as_pairs}
        ) == expected
    with pytest.raises(tf.InputError, match=r"relation = 'aunt'.*mother.*sister.*cousin"):
        tree.pairs("aunt")


def test_a_lineage_without_divisions(tmp_path):
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2)
    path = tmp_path / "run.h5"
    for _ in tf.simulate(scene, until=0.1, record=path):
        pass
    with tf.Results(path) as results:
        tree = results.lineage()
    assert tree.generation.tolist() == tree.pole_age.tolist() == [0] and tree.sister.tolist() == [
        -1
    ]
    assert all(tree.pairs(relation).shape == (0, 2) for relation in ("mother", "sister", "cousin"))


def test_sisters_in_a_file_that_begins_in_the_middle(tmp_path):
    """Their mother is in no frame, and yet they are sisters."""
    scene = make_scene()
    *_, middle = tf.simulate(scene, scene.bind(2, seed=3).start(), until=2.0)
    record(scene, middle, tmp_path / "run.h5", until=2.5)
    with tf.Results(tmp_path / "run.h5") as results:
        tree = results.lineage()
    first = int(middle.cells)
    assert (tree.generation[:first] == 0).all() and (tree.sister[:first] >= 0).sum() >= 2
    pairs = tree.pairs("sister")
    assert (tree.parent[pairs[:, 0]] == tree.parent[pairs[:, 1]]).all()


def changing_steps(path) -> tuple[list[float], tf.Scene]:
    """Hours of divisions in a run whose steps become shorter between two frames."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), dim=2, dt=0.02)
    model = scene.bind(seed=0)
    state = model.start()
    recorder = tf.Recorder(path, scene, every=100)
    recorder.attach(model, 0.02)
    recorder(state)
    hours = []
    for k in range(150):
        state = model.step(state, 0.02 if k < 60 else 0.005)
        recorder(state)
        hours += [state.time] * sum(len(b.parents.uid) for b in state.births)
    recorder.close()
    return hours, scene


def test_hours_are_those_of_the_steps_also_where_these_change(tmp_path):
    hours, _ = changing_steps(tmp_path / "run.h5")
    with tf.Results(tmp_path / "run.h5") as results:
        tree = results.lineage()
    divided = tree.fate == "divided"
    assert len(hours) == 3 and sorted(tree.ended[divided].tolist()) == hours
    assert sorted(tree.born[tree.parent >= 0].tolist()) == sorted(2 * hours)


def test_files_without_hours_have_those_between_frames(tmp_path):
    """Files of earlier versions have the number of the step only."""
    path, scene = tmp_path / "old.h5", make_scene()
    record(scene, scene.bind(2, seed=3).start(), path, until=1.0)
    with tf.Results(path) as results:
        tree = results.lineage()
    with h5py.File(path, "r+") as file:
        del file["lineage/births/time"], file["lineage/ends/time"]
    with tf.Results(path) as results:
        old, state = results.lineage(), results.state(scene)
    assert np.allclose(old.born, tree.born) and np.allclose(old.ended, tree.ended, equal_nan=True)
    recorder = tf.Recorder(path, scene, append=True)
    *_, state = tf.simulate(scene, state, until=1.5, record=recorder)
    with tf.Results(path) as results:
        longer = results.lineage()
    assert len(longer) > len(old)
    assert not np.isnan(longer.born).any()
