"""The lineage of results: births and ends in hours, the tree, and its exchange formats."""

from __future__ import annotations

import re

import h5py
import numpy as np
import pytest
import torch
from helpers import step
from recorded import DT, make_scene, record

import torchfilm as tf


def keys_of(tree) -> list[tuple[int, int]]:
    return list(zip(tree.colony.tolist(), tree.cell.tolist(), strict=True))


def test_lineage_is_consistent(whole):
    path, states = whole
    with tf.Results(path) as results:
        found = results.lineage()
    keys = keys_of(found)
    assert len(set(keys)) == len(keys) == len(found)
    row = {key: k for k, key in enumerate(keys)}
    for k, (colony, _) in enumerate(keys):
        parent = int(found.parent[k])
        if parent == -1:
            assert found.born[k] == 0
            continue
        p = row[(colony, parent)]
        assert found.fate[p] == "divided" and found.ended[p] == found.born[k], (
            "a daughter is born when its parent ends"
        )
        assert found.born[p] < found.born[k]
    ended = ~np.isnan(found.ended)
    assert (found.ended[ended] >= found.born[ended]).all()
    assert ((found.fate == "alive") == ~ended).all()
    assert set(found.fate) == {"alive", "divided", "removed"}
    daughters = np.bincount(
        [row[(c, int(p))] for (c, _), p in zip(keys, found.parent, strict=True) if p >= 0],
        minlength=len(keys),
    )
    assert (daughters == np.where(found.fate == "divided", 2, 0)).all()
    for state in states:  # who is alive at each step is who has been born and has not ended
        now = state.time + DT / 2
        alive = (found.born <= now) & ~(found.ended <= now)
        assert sorted(np.array(keys)[alive].tolist()) == sorted(
            [list(k) for k in zip(state.colony.tolist(), state.uid.tolist(), strict=True)]
        )


def test_each_cell_has_its_length_at_birth_and_at_its_end(whole):
    """Daughters have their parent's length less two caps; a cell that left had what its last state
    says, and one that lives has no end."""
    path, states = whole
    with tf.Results(path) as results:
        tree = results.lineage()
    row = {key: k for k, key in enumerate(keys_of(tree))}
    daughters = {}
    for k, (colony, parent) in enumerate(zip(tree.colony, tree.parent, strict=True)):
        if parent >= 0:
            daughters.setdefault(row[colony, parent], []).append(tree.birth_length[k])
    assert len(daughters) > 20
    for k, lengths in daughters.items():
        assert sum(lengths) == pytest.approx(tree.end_length[k] - 1.0, rel=1e-6)
        assert tree.end_length[k] > tree.birth_length[k] > 0
    assert (np.isnan(tree.end_length) == (tree.fate == "alive")).all()
    first, last = {}, {}
    for state in states:
        names = zip(state.colony.tolist(), state.uid.tolist(), strict=True)
        for name, length in zip(names, state.length.tolist(), strict=True):
            first.setdefault(name, length)
            last[name] = length
    assert [first[name] for name in row] == tree.birth_length.tolist()
    removed = [name for name, k in row.items() if tree.fate[k] == "removed"]
    assert removed and all(last[name] == tree.end_length[row[name]] for name in removed)
    table = tree.to_pandas()
    assert list(table.columns[-2:]) == ["end_length", "cell_type"] and len(table) == len(tree)


def test_a_file_of_an_earlier_version_has_no_lengths_and_goes_on(tmp_path):
    path, scene = tmp_path / "old.h5", make_scene()
    record(scene, scene.bind(2, seed=3).start(), path, until=1.0)
    with h5py.File(path, "r+") as file:
        del file["lineage/births/length"], file["lineage/ends/length"]
        del file["lineage/ends/cell_type"]
        file.attrs["version"] = 2
    with tf.Results(path) as results:
        state = results.state(scene)
    recorder = tf.Recorder(path, scene, append=True)
    *_, state = tf.simulate(scene, state, until=2.0, record=recorder)
    with tf.Results(path) as results:
        tree = results.lineage()
    assert len(tree) > state.cells and np.isnan(tree.birth_length[tree.parent >= 0]).all()
    assert np.isnan(tree.end_length).all()


def test_each_cell_has_its_type_also_where_no_frame_has_it(tmp_path):
    """Cells of type 1 become type 2 from 0.5 h on, and burst; most live between frames."""

    def ages(cells):
        if cells.time >= 0.5:
            cells.cell_type = torch.where(cells.cell_type == 1, 2, cells.cell_type)

    founders = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, cell_type=[0, 1])
    scene = tf.Scene(
        tf.Rules(ages),
        tf.Growth(rate=1.5), tf.Division(length=3.0),
        tf.Lysis(rate={0: 0.0, 1: 0.0, 2: 20.0}), founders=founders, dt=0.05,
    )  # fmt: skip
    path = tmp_path / "types.h5"
    seen: dict[int, int] = {}
    for state in tf.simulate(scene, until=1.0, record=tf.Recorder(path, scene, every=100)):
        seen |= dict(zip(state.uid.tolist(), state.cell_type.tolist(), strict=True))
    with tf.Results(path) as results:
        tree = results.lineage()
        in_frames = np.concatenate([results.frame(k)["uid"] for k in range(len(results.times))])
    lysed = tree.fate == "lysed"
    assert lysed.any() and (tree.cell_type[lysed] == 2).all()
    assert not np.isin(tree.cell[lysed], in_frames).all()
    assert (tree.cell_type >= 0).all() and set(tree.cell_type) == {0, 1, 2}
    others = ~lysed  # a cell may change its type in the step in which it ends
    assert tree.cell_type[others].tolist() == [seen[c] for c in tree.cell[others].tolist()]
    assert tree.to_pandas().cell_type.tolist() == tree.cell_type.tolist()
    plain = tmp_path / "plain.h5"
    for _ in tf.simulate(tf.Scene(tf.Growth(rate=1.0), dim=2), until=0.1, record=plain):
        pass
    with tf.Results(plain) as results:
        assert results.lineage().cell_type.tolist() == [-1]


@pytest.mark.parametrize("fraction, warns", [(0.5, False), (0.4, True)])
def test_an_earlier_file_of_uneven_divisions_is_warned_of(tmp_path, recwarn, fraction, warns):
    """Fractions were those of the length less two radii."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0, fraction=fraction), dim=2)
    path = tmp_path / "old.h5"
    for _ in tf.simulate(scene, until=0.2, record=path):
        pass
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 2
    with tf.Results(path) as results:
        results.state(scene)
    assert any("Division.fraction was" in str(w.message) for w in recwarn) == warns


def test_ancestors_and_descendants(whole):
    with tf.Results(whole[0]) as results:
        tree = results.lineage()
        last = results.frame()
    cell = int(last["uid"][last["colony"] == 1].max())
    line = tree.ancestors(cell, colony=1)
    assert len(line) > 2 and line[-1] == 0 and tree.ancestors(0, colony=1) == []
    mothers = {c: p for k, c, p in zip(tree.colony, tree.cell, tree.parent, strict=True) if k == 1}
    assert [mothers[c] for c in [cell, *line]] == [*line, -1]
    below = tree.descendants(0, colony=1)
    assert sorted([0, *below]) == sorted(tree.cell[tree.colony == 1].tolist())
    assert all(cell in tree.descendants(c, colony=1) for c in line)
    assert tree.descendants(cell, colony=1) == []


def test_the_course_of_a_cell_has_one_row_per_frame(whole):
    path, _ = whole
    with tf.Results(path) as results:
        tree, table, times = results.lineage(), results.table(), results.times
        mine = (table["colony"] == 2) & (table["frame"] == len(times) - 1)
        cell = int(table["cell"][mine].max())
        course = tree.course(cell, colony=2)
    assert list(course) == list(table)
    assert course["time"].tolist() == times.tolist() and course["cell"][-1] == cell
    assert set(course["cell"]) <= {cell, *tree.ancestors(cell, colony=2)}
    for k in range(len(times)):
        row = (table["frame"] == k) & (table["colony"] == 2) & (table["cell"] == course["cell"][k])
        assert table["x"][row].tolist() == [course["x"][k]]


def test_newick_is_the_tree(whole):
    with tf.Results(whole[0]) as results:
        tree = results.lineage()
    text = tree.to_newick(1)
    assert text.count("\n") == 1 and text.endswith(";\n") and text.count("(") == text.count(")")
    found = dict(re.findall(r"colony1\.cell(\d+):([-\d.e]+)", text))
    own = tree.colony == 1
    assert sorted(map(int, found)) == sorted(tree.cell[own].tolist())
    for cell, born, ended in zip(tree.cell[own], tree.born[own], tree.ended[own], strict=True):
        lived = (tree.now if np.isnan(ended) else ended) - born
        assert float(found[str(cell)]) == pytest.approx(lived, abs=1e-5)
    assert tree.to_newick().count(";") == 3, "a line for each founder"
    # the length from root to tip is the time of the tip's end
    alive = int(tree.cell[own & (tree.fate == "alive")][0])
    line = [alive, *tree.ancestors(alive, colony=1)]
    assert sum(float(found[str(c)]) for c in line) == pytest.approx(tree.now, abs=1e-4)


def test_newick_of_a_lineage_that_is_very_deep(tmp_path):
    """A mother that loses one daughter at each division: thousands of generations."""

    def update(cells):
        cells.divide_flag = cells.uid == cells.uid
        cells.remove_flag = (cells.uid > 0) & (cells.uid % 2 == 0)

    growth = tf.Growth(law="linear", rate=300.0)
    scene = tf.Scene(tf.Rules(update), growth, tf.Division(), dim=3, dt=0.01)
    recorder = tf.Recorder(tmp_path / "run.h5", scene, every=500)
    for _ in tf.simulate(scene, until=15.0, record=recorder):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        tree = results.lineage()
        deepest = len(tree.ancestors(int(tree.cell.max())))
        text = tree.to_newick()
    assert deepest > 1400 and text.count("cell") == len(tree)


def test_networkx(whole):
    networkx = pytest.importorskip("networkx", reason="the extra tables")
    with tf.Results(whole[0]) as results:
        tree = results.lineage()
    graph = tree.to_networkx()
    assert set(graph) == set(keys_of(tree)) and networkx.is_branching(graph)
    assert networkx.number_weakly_connected_components(graph) == 3
    one = tree.to_networkx(colony=0)
    assert set(networkx.descendants(one, (0, 1))) == {(0, c) for c in tree.descendants(1, colony=0)}
    row = keys_of(tree).index((0, 0))
    about = one.nodes[0, 0]
    known = {"colony": 0, "cell": 0, "born": 0.0, "ended": tree.ended[row], "fate": "divided"}
    assert about.items() >= known.items() and list(about) == list(tree.to_pandas().columns)
    assert all(type(x) in (int, float, str) for x in about.values())  # for GraphML


def test_a_cell_of_several_colonies_needs_its_colony(whole):
    with tf.Results(whole[0]) as results:
        tree = results.lineage()
        with pytest.raises(tf.InputError, match=r"has the colonies 0, 1, 2: say which"):
            tree.ancestors(3)
        with pytest.raises(tf.InputError, match=r"cell = 9999.*a cell of colony 1: 0 to"):
            tree.course(9999, colony=1)
        with pytest.raises(tf.InputError, match=r"colony = 7"):
            tree.to_newick(7)
        with pytest.raises(tf.InputError, match=r"colony = True"):
            tree.ancestors(0, colony=True)
        with pytest.raises(tf.InputError, match=r"cell = 1\.5"):
            tree.descendants(1.5, colony=0)


def test_lineage_of_a_run_that_starts_in_the_middle_of_another(tmp_path):
    """The state of a run's last step still carries that step's births; a new file must not count
    them again. When its first cells were born, the file does not know."""
    scene = make_scene()
    state = scene.bind(2, seed=1).start()
    while not state.births:
        state = step(scene, state, DT)
    record(scene, state, tmp_path / "run.h5", until=state.time + 1.0)
    with tf.Results(tmp_path / "run.h5") as results:
        found, first, last = results.lineage(), results.frame(0), results.frame()
        newick = found.to_newick()
    keys = keys_of(found)
    assert len(set(keys)) == len(keys), "a cell is listed twice"
    begun = set(zip(first["colony"].tolist(), first["uid"].tolist(), strict=True))
    for key, parent, born in zip(keys, found.parent.tolist(), found.born, strict=True):
        assert key in begun or (key[0], parent) in keys
        assert np.isnan(born) if key in begun else born > state.time
    assert np.isnan(found.birth_length).tolist() == np.isnan(found.born).tolist()
    assert found.last_seen == pytest.approx(np.where(np.isnan(found.ended), found.now, found.ended))
    assert (
        found.first_seen.tolist()
        == np.where(np.isnan(found.born), found.begin, found.born).tolist()
    )
    alive = [k for k, fate in zip(keys, found.fate, strict=True) if fate == "alive"]
    assert sorted(alive) == sorted(zip(last["colony"].tolist(), last["uid"].tolist(), strict=True))
    assert "nan" not in newick and newick.count(";") == len(begun)


def test_founders_and_clones(tmp_path):
    def cull(cells):
        cells.remove_flag = (cells.uid == 2) | (cells.chance(0.02) & (cells.time > 0.5))

    scene = tf.Scene(
        tf.Rules(cull), tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.0, 4.0)), dim=2,
        founders=tf.inoculum(4, radius=10.0, colonies=2),
    )  # fmt: skip
    path = tmp_path / "clones.h5"
    *_, state = tf.simulate(scene, until=3.0, dt=0.05, record=path)
    with tf.Results(path) as results:
        tree = results.lineage()
    for colony in (0, 1):
        mine = state.uid[state.colony == colony].tolist()
        roots = [([c, *tree.ancestors(c, colony)])[-1] for c in mine]
        sizes = tree.clone_sizes(colony)
        assert sizes == {f: roots.count(f) for f in range(4)} and sizes[2] == 0
        assert sum(sizes.values()) == len(mine) > 10
        one, other = mine[0], mine[-1]
        lines = [[c, *tree.ancestors(c, colony)] for c in (one, other)]
        shared = [c for c in lines[0] if c in lines[1]]
        assert tree.common_ancestor([one, other], colony) == (shared[0] if shared else None)
        assert tree.common_ancestor([one], colony) == one
        daughters = [c for c in mine if tree.ancestors(c, colony)[:1] == lines[0][1:2]]
        assert tree.common_ancestor(daughters, colony) in (one, lines[0][1])
        text = tree.to_newick(colony, alive=True)
        found = set(map(int, re.findall(rf"colony{colony}\.cell(\d+):", text)))
        assert found == set(mine).union(*(tree.ancestors(c, colony) for c in mine))
        assert text.count(";") == len(set(roots))
        assert len(tree.to_newick(colony)) > len(text)
        # as the frames have them; at a birth there are daughters, and no mother
        with tf.Results(path) as results:
            for frame in (0, len(results) // 2, len(results) - 1):
                table = results.table(frame)
                there = table["cell"][table["colony"] == colony].tolist()
                roots = [([c, *tree.ancestors(c, colony)])[-1] for c in there]
                at = tree.clone_sizes(colony, time=results.times[frame])
                assert at == {f: roots.count(f) for f in range(4)}
        for row in np.flatnonzero(tree.colony == colony):
            cell = int(tree.cell[row])
            below = {cell, *tree.descendants(cell, colony)}
            assert tree.living_descendants[row] == len(below & set(mine))
    for time in (-1.0, 99.0):
        with pytest.raises(tf.InputError, match=r"clone_sizes\(time\) = "):
            tree.clone_sizes(0, time=time)
    assert tree.to_pandas()["founder"].tolist() == tree.founder.tolist()
    with pytest.raises(tf.InputError, match="one cell or more"):
        tree.common_ancestor([], 0)
    assert tree.common_ancestor([0, 1], 0) is None


def test_types_of_living_cells_are_those_of_their_own_colony(tmp_path):
    """Also where ids of colonies are not their places."""
    cells = tf.Cells([[0.0, 0.0]] * 2, [[1.0, 0.0]] * 2, cell_type=[5, 3], colony=[0, 1])
    scene = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=2, dt=0.1)
    start = scene.bind().start().select([1, 0])
    tf.simulate(scene, start, until=0.1, record=tmp_path / "run.h5").last()
    with tf.Results(tmp_path / "run.h5") as results:
        tree = results.lineage()
    assert dict(zip(tree.colony.tolist(), tree.cell_type.tolist(), strict=True)) == {0: 5, 1: 3}
