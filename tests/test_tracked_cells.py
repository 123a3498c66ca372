"""Lineages of movies: tables of tracked cells, and the files of the Cell Tracking Challenge."""

from __future__ import annotations

import numpy as np
import pytest

import torchfilm as tf
from torchfilm.tools.checks import InputError

# cell 1 divides into 2 and 3 after 20 min; 2 into 4 and 5 at 40; 3 leaves after 30 min
ROWS = [
    (1, 0, 0, 2.0), (1, 0, 10, 3.0), (2, 1, 20, 1.6), (3, 1, 20, 1.4), (2, 1, 30, 2.4),
    (3, 1, 30, 2.0), (4, 2, 40, 1.2), (5, 2, 40, 1.1), (4, 2, 50, 1.5), (5, 2, 50, 1.4),
]  # fmt: skip


def table(rows=ROWS, **more):
    names = ("cell", "parent", "time_min", "length_um")
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)) | more


def test_births_divisions_and_losses_are_found():
    tree = tf.Lineage.from_table(table())
    assert tree.cell.tolist() == [1, 2, 3, 4, 5] and tree.parent.tolist() == [-1, 1, 1, 2, 2]
    hours = lambda *minutes: pytest.approx(np.array(minutes) / 60, nan_ok=True)
    assert tree.born == hours(np.nan, 20, 20, 40, 40)  # of the first nobody knows
    assert tree.ended == hours(20, 40, 30, np.nan, np.nan)
    assert tree.fate.tolist() == ["divided", "divided", "lost", "alive", "alive"]
    assert tree.birth_length == pytest.approx([np.nan, 1.6, 1.4, 1.2, 1.1], nan_ok=True)
    assert tree.end_length == pytest.approx([3.0, 2.4, 2.0, np.nan, np.nan], nan_ok=True)
    assert tree.begin == 0.0 and tree.now == pytest.approx(5 / 6)


def test_it_is_a_tree_as_that_of_a_run():
    tree = tf.Lineage.from_table(table())
    assert tree.descendants(1) == [2, 3, 4, 5] and tree.ancestors(5) == [2, 1]
    assert tree.sister.tolist() == [-1, 3, 2, 5, 4] and tree.founder.tolist() == [1] * 5
    assert tree.generation.tolist() == [0, 1, 1, 2, 2] and tree.common_ancestor([4, 3]) == 1
    assert tree.pairs("mother").tolist() == [[0, 1], [0, 2], [1, 3], [1, 4]]
    assert tree.clone_sizes() == {1: 2} and tree.living_descendants.tolist() == [2, 2, 0, 1, 1]
    wanted = "((colony0.cell4:0.166667,colony0.cell5:0.166667)colony0.cell2:0.333333,"
    assert tree.to_newick().startswith(wanted)
    cells = tree.to_pandas()
    assert cells.pole_age.tolist() == [-1] * 5  # a movie does not tell poles
    assert cells.fate.tolist() == tree.fate.tolist()
    with pytest.raises(InputError, match=r"no results file: .* cells \[4, 2, 1\]"):
        tree.course(4)


@pytest.mark.parametrize("parents", [[-1] * 2, ["", ""], [None, None], [float("nan")] * 2, [0, 0]])
def test_what_says_that_there_is_no_parent(parents):
    given = table()
    given["parent"] = [*parents, *given["parent"][2:]]
    assert tf.Lineage.from_table(given).parent[0] == -1


def test_a_parent_may_stand_in_the_first_row_alone_and_0_may_be_a_cell():
    rows = [(0, -1, 0, 2.0), (0, -1, 10, 3.0), (1, 0, 20, 1.5), (2, 0, 20, 1.5), (1, -1, 30, 2.0),
            (2, -1, 30, 2.0)]  # fmt: skip
    tree = tf.Lineage.from_table(table(rows))
    assert tree.parent.tolist() == [-1, 0, 0] and tree.fate[0] == "divided"


def test_movies_are_apart_and_each_has_its_end():
    rows = [*ROWS, *((c, p, t, x) for c, p, t, x in ROWS if t <= 30)]
    with pytest.warns(UserWarning, match=r"colony 2 ends before others"):
        tree = tf.Lineage.from_table(table(rows, colony=[7] * 10 + [2] * 6))
    second = tree.colony == 2
    assert tree.fate[second].tolist() == ["divided", "alive", "alive"]
    assert tree.descendants(1, colony=7) == [2, 3, 4, 5] and tree.descendants(1, colony=2) == [2, 3]
    with pytest.raises(InputError, match=r"has the colonies 2, 7: say which"):
        tree.ancestors(2)


def test_a_lineage_knows_when_its_frames_are():
    late = [(1, 0, 300, 2.0), (1, 0, 600, 2.0)]
    first = [(2, 0, 0, 2.0), (2, 0, 60, 2.0)]
    tree = tf.Lineage.from_table(table(late + first, colony=[0, 0, 1, 1]))
    assert (tree.begin, tree.now, tree.interval) == (0.0, 10.0, 3.0)
    early = [*first, (2, 0, 120, 2.0), (3, 0, 60, 2.0), (3, 0, 70, 2.0)]  # ends before the first
    tree = tf.Lineage.from_table(table(early, colony=[0] * 3 + [1] * 2))
    assert tree.now == 2.0 and tree.last_seen.tolist() == pytest.approx([2.0, 7 / 6])


def test_units_names_and_widths():
    given = {"ID": [r[0] for r in ROWS], "mother": [r[1] for r in ROWS],
             "when": [r[2] for r in ROWS], "major": [(r[3] + 1.0) / 0.1 for r in ROWS]}  # fmt: skip
    names = {"cell": "ID", "parent": "mother", "time": "when", "length": "major"}
    tree = tf.Lineage.from_table(given, columns=names, time_unit="min", pixel_size=0.1, width=1.0)
    plain = tf.Lineage.from_table(table())
    assert tree.end_length == pytest.approx(plain.end_length, nan_ok=True)
    assert tree.born == pytest.approx(plain.born, nan_ok=True)
    bare = table()
    del bare["length_um"]
    assert np.isnan(tf.Lineage.from_table(bare).end_length).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time_min": None}, "lacks the column 'time_h'"),
        ({"parent": None}, "lacks the column 'parent'.*−1 of those of none"),
        ({"parent": [9] * 10}, "cell 1 has the parent 9, which is no cell of its colony"),
        ({"parent": ["x"] * 10}, "'x' must be a whole number, or empty"),
        ({"cell": [1.5] * 10}, "1.5 must be a whole number from 0"),
        ({"cell": [1] * 10, "parent": [0] * 10}, "cell 1 of colony 0 has two rows at"),
        ({"parent": [0, 0, 1, 1, 1, 1, 2, 2, 3, 2]}, "cell 4 of colony 0 has two parents, "),
        ({"time_min": [20] + [r[2] for r in ROWS[1:]], "cell": [1, 6] + [r[0] for r in ROWS[2:]]},
         "cell 2 begins at 0.333333 h, no later than its parent 1"),
        ({"cell": [2**40] + [r[0] for r in ROWS[1:]]}, r"from 0, below 2\*\*40"),
        ({"colony": ["a"] * 10}, "'a' is a name, and a number is needed.*factorize"),
        ({"time_min": [0, 20] + [r[2] for r in ROWS[2:]]},
         "cell 1 is there at 0.333333 h, and its daughter 2 from 0.333333 h on.*column colony"),
        ({"length_um": [-1.0] * 10}, "-1 µm is no length of a centreline"),
        ({"width": 2.5}, "-0.5 µm is no length of a centreline"),
        ({"width": 0.0}, r"width\) = 0"),
        ({"time_unit": "min"}, "time_unit = 'min'.*left out"),
        ({"columns": {"size": "x"}}, r"columns\) = 'size'"),
    ],
)  # fmt: skip
def test_wrong_tables(change, words):
    options = {k: v for k, v in change.items() if k in ("width", "time_unit", "columns")}
    given = {k: v for k, v in (table() | change).items() if v is not None and k not in options}
    with pytest.raises(InputError, match=words):
        tf.Lineage.from_table(given, **options)


def test_a_length_that_is_missing_leaves_the_cell_there():
    given = table()
    given["length_um"] = [2.0, None, *given["length_um"][2:]]
    tree, whole = tf.Lineage.from_table(given), tf.Lineage.from_table(table())
    assert np.isnan(tree.end_length[0]) and tree.ended == pytest.approx(whole.ended, nan_ok=True)
    assert tree.end_length[1:3] == pytest.approx(whole.end_length[1:3])


def test_a_gap_between_a_mother_and_her_daughters_is_told():
    rows = [r for r in ROWS if r[0] != 1 or r[2] == 0]
    with pytest.warns(UserWarning, match="2 cells begin later than a frame after their parent's"):
        tf.Lineage.from_table(table(rows))


def test_small_gaps_and_shrinkage_are_not_told():
    later = lambda t: [(c, p, x if c == 1 else x + t, y) for c, p, x, y in ROWS]
    tf.Lineage.from_table(table(later(4)))  # 14 min after their mother's last frame, of 10 apart
    with pytest.warns(UserWarning, match="2 cells begin later than a frame"):
        tf.Lineage.from_table(table(later(6)))
    shrinking = lambda last: [(1, 0, 0, 2.0), (1, 0, 10, 2.0), (1, 0, 20, last)]
    tf.Lineage.from_table(table(shrinking(1.6)))
    with pytest.warns(UserWarning, match="1 cells get shorter"):
        tf.Lineage.from_table(table(shrinking(1.4)))


def test_three_daughters_are_told():
    with pytest.warns(UserWarning, match=r"1 cells have more than two \(such as 1\)"):
        tf.Lineage.from_table(table([*ROWS, (6, 1, 20, 1.0)]))


def test_founders_and_late_movies_have_clones_and_branches_of_their_own():
    rows = [(1, 0, 0, 2.0), (1, 0, 60, 2.0), (2, 0, 0, 2.0), (2, 0, 60, 2.0)]
    tree = tf.Lineage.from_table(table(rows))
    assert tree.clone_sizes() == {1: 1, 2: 1} == tree.clone_sizes(time=0.0)
    lost = tf.Lineage.from_table(table([*rows, (2, 0, 120, 2.0), (2, 0, 180, 2.0)]))
    assert lost.clone_sizes(time=1.0) == {1: 1, 2: 1} and lost.clone_sizes(time=1.5) == {1: 0, 2: 1}
    late = [(1, 0, 0, 2.0), (1, 0, 60, 2.0), (1, 0, 300, 2.0), (1, 0, 600, 2.0)]
    both = tf.Lineage.from_table(table(late, colony=[0, 0, 1, 1]))
    assert both.to_newick(0) == "colony0.cell1:1;\n" and both.to_newick(1) == "colony1.cell1:5;\n"


def test_cells_with_one_daughter_are_told():
    rows = [r for r in ROWS if r[0] != 5]
    with pytest.warns(UserWarning, match=r"1 cells have one daughter \(such as 2\)"):
        tree = tf.Lineage.from_table(table(rows))
    assert tree.fate[1] == "divided" and tree.sister.tolist() == [-1, 3, 2, -1]


def test_a_cell_and_its_only_daughter_are_one_where_joined():
    # 2 is lost at 40 min, found as 8 at 50, and divides into 9 and 10; 3 goes on as 6, then as 7
    rows = [
        (1, 0, 0, 2.0), (1, 0, 10, 3.0), (2, 1, 20, 1.6), (2, 1, 30, 2.0), (8, 2, 50, 3.0),
        (9, 8, 60, 1.6), (10, 8, 60, 1.7), (3, 1, 20, 1.4), (6, 3, 30, 1.8), (7, 6, 40, 2.2),
        (7, 6, 50, 2.6),
    ]  # fmt: skip
    tree = tf.Lineage.from_table(table(rows), join=True)  # without a warning
    assert tree.cell.tolist() == [1, 2, 3, 9, 10] and tree.parent.tolist() == [-1, 1, 1, 2, 2]
    assert tree.fate.tolist() == ["divided", "divided", "lost", "alive", "alive"]
    assert tree.ended[:3] * 60 == pytest.approx([20, 60, 50])
    assert tree.end_length[:3] == pytest.approx([3.0, 3.0, 2.6])
    assert tree.sister.tolist() == [-1, 3, 2, 10, 9]
    one = pytest.warns(UserWarning, match=r"3 cells have one daughter.*join=True takes a cell and")
    with one, pytest.warns(UserWarning, match="1 cells begin later"):
        cut = tf.Lineage.from_table(table(rows))
    assert len(cut) == 8
    with pytest.raises(InputError, match="join"):
        tf.Lineage.from_table(table(rows), join="all")


def test_a_cell_that_has_divided_is_not_joined_with_its_only_daughter():
    rows = [(1, 0, 0, 2.0), (1, 0, 10, 3.0), (2, 1, 20, 1.4), (3, 2, 30, 1.6), (3, 2, 40, 2.0)]
    with pytest.warns(UserWarning, match=r"1 cells have one daughter \(such as 1\)") as found:
        tree = tf.Lineage.from_table(table(rows), join=True)
    assert tree.cell.tolist() == [1, 2] and tree.end_length.tolist()[0] == 3.0
    assert "join=True" not in str(found[0].message)


def test_tracks_that_go_on_through_divisions_are_told():
    rows = [(1, 0, 10 * k, 2.0 + k % 3) for k in range(9)]
    with pytest.warns(
        UserWarning, match=r"1 cells get shorter .* \(such as 1\): have they divided"
    ):
        tf.Lineage.from_table(table(rows))


def test_movies_of_other_intervals_are_told():
    rows = [(1, 0, 10 * k, 2.0) for k in range(5)] + [(1, 0, 2 * k, 2.0) for k in range(5)]
    with pytest.warns(UserWarning, match=r"colony 1 are 0\.0333 h apart, those of colony 0 0\.167"):
        tf.Lineage.from_table(table(rows, colony=[0] * 5 + [1] * 5))


def test_seconds_are_read():
    rows = table()
    rows["time_s"] = [60.0 * t for t in rows.pop("time_min")]
    assert tf.Lineage.from_table(rows).now == pytest.approx(5 / 6)


def test_a_file_of_tracks(tmp_path):
    path = tmp_path / "man_track.txt"
    path.write_text("1 0 1 0\n2 2 3 1\n3 2 3 1\n4 4 5 2\n5 4 5 2\n", encoding="utf-8")
    tree, other = tf.Lineage.from_ctc(path, interval=1 / 6), tf.Lineage.from_table(table())
    for name in ("cell", "parent", "fate"):
        assert getattr(tree, name).tolist() == getattr(other, name).tolist()
    for name in ("born", "ended"):
        assert getattr(tree, name) == pytest.approx(getattr(other, name), nan_ok=True)
    assert tree.now == pytest.approx(5 / 6) and np.isnan(tree.birth_length).all()


def test_a_track_of_one_frame_is_a_cell(tmp_path):
    path = tmp_path / "man_track.txt"
    path.write_text("1 0 1 0\n2 2 2 1\n3 2 3 1\n", encoding="utf-8")
    assert tf.Lineage.from_ctc(path, interval=0.5).fate.tolist() == ["divided", "lost", "alive"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 0 1\n", "four whole numbers"),
        ("1 0 a 0\n", "four whole numbers"),
        ("1 0 1 0\n1 0 2 0\n", "each label must be there once"),
        ("1 3 1 0\n", "end after it begins"),
        ("", "four whole numbers"),
    ],
)
def test_wrong_files_of_tracks(tmp_path, text, words):
    path = tmp_path / "t.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=words):
        tf.Lineage.from_ctc(path, interval=0.1)
    with pytest.raises(InputError, match=r"interval\) = 0"):
        tf.Lineage.from_ctc(path, interval=0.0)
    with pytest.raises(InputError, match="the file of tracks"):
        tf.Lineage.from_ctc(tmp_path / "none.txt", interval=0.1)


def test_the_lineage_of_a_run_is_that_of_its_tracks(tmp_path):
    """A frame after every step: the tracks of the frames have all that the file's lineage has."""
    scene = tf.Scene(tf.Growth(rate=1.5), tf.Division(length=tf.Uniform(3.0, 4.0)), dim=2, dt=0.1)
    record = tf.Recorder(tmp_path / "run.h5", scene, every=1)
    list(tf.simulate(scene, until=2.0, colonies=2, seed=3, record=record))
    with tf.Results(tmp_path / "run.h5") as results:
        whole, rows = results.lineage(), results.to_pandas()
    # the table of a run has the parent's number in `parent`
    named = {"cell": rows.cell, "parent": rows.parent, "time_h": rows.time,
             "length_um": rows.length, "colony": rows.colony}  # fmt: skip
    tree = tf.Lineage.from_table(named)
    assert len(tree) == len(whole)
    order = [np.lexsort((t.cell, t.colony)) for t in (tree, whole)]
    for name in ("colony", "cell", "parent", "fate", "generation"):
        one, other = (getattr(t, name)[k] for t, k in zip((tree, whole), order, strict=True))
        assert one.tolist() == other.tolist(), name
    born, theirs = (t.born[k] for t, k in zip((tree, whole), order, strict=True))
    later = whole.parent[order[1]] >= 0
    assert born[later] == pytest.approx(theirs[later])
    ended, theirs = (t.ended[k] for t, k in zip((tree, whole), order, strict=True))
    assert ended == pytest.approx(theirs, nan_ok=True)


def test_numbers_that_are_no_labels_are_refused(tmp_path):
    for parent in (float("inf"), 1e300):
        with pytest.raises(InputError, match=r"row 2, column 'parent'.*must be a whole number"):
            tf.Lineage.from_table({"cell": [1, 2], "parent": [-1, parent], "time_h": [0.0, 1.0]})
    path = tmp_path / "man_track.txt"
    for text in ("99999999999999999999 0 1 0", "-1 0 5 0\n2 6 9 -1", "0 0 5 0", f"{2**40} 0 1 0"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="whole numbers"):
            tf.Lineage.from_ctc(path, interval=0.1)
