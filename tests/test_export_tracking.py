"""Results in the format of the Cell Tracking Challenge: folders that are read again by the words of
the format alone, and compared with the masks and the lineage of the same run."""

from __future__ import annotations

import csv
import math
import os
import re
from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import shell
from exported import recorded, signalling
from recorded import record

import torchfilm as tf
from torchfilm.cli.export import Export
from torchfilm.io import cell_tracking, new_file
from torchfilm.io.cell_tracking import LabelTracks, _warn_of

tifffile = pytest.importorskip("tifffile", reason="the extra images")
PIXEL = 0.1
COMMON = {"pixel_size": PIXEL, "colony": 1}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Frames so near that each cell is seen in one at least."""
    return recorded(signalling(), tmp_path_factory.mktemp("ctc") / "run.h5", 2.0, every=2)


def stack(folder, name: str) -> list[np.ndarray]:
    """The pages `name`000.tif, …: no other file is there, and all have 16 bits and one size."""
    files = sorted(folder.glob("*.tif"))
    assert [p.name for p in files] == [f"{name}{k:03}.tif" for k in range(len(files))]
    pages = [tifffile.imread(p) for p in files]
    assert {p.dtype for p in pages} == {np.dtype(np.uint16)}
    assert len({p.shape for p in pages}) == 1
    return pages


def read(folder):
    """The tracks {label: (begin, end, parent)}, the masks, and the cell of each label. Raises
    AssertionError for what a program that follows the format would refuse."""
    lines = (folder / "01_GT/TRA/man_track.txt").read_text().splitlines()
    assert all(re.fullmatch(r"[1-9]\d* \d+ \d+ \d+", line) for line in lines)
    rows = [tuple(map(int, line.split(" "))) for line in lines]
    tracks = {label: rest for label, *rest in rows}
    assert [*tracks] == sorted(tracks)
    assert len(tracks) == len(rows) > 0 and max(tracks) <= 65535
    masks = stack(folder / "01_GT/TRA", "man_track")
    for k, mask in enumerate(masks):
        assert {*np.unique(mask).tolist()} - {0} == {
            label for label, (begin, end, _) in tracks.items() if begin <= k <= end
        }
    for begin, end, parent in tracks.values():
        assert 0 <= begin <= end < len(masks)
        assert parent == 0 or tracks[parent][1] < begin
    segments = stack(folder / "01_GT/SEG", "man_seg")
    assert len(segments) == len(masks)
    assert all(np.array_equal(a, b) for a, b in zip(segments, masks, strict=True))
    with open(folder / "cells.csv") as file:
        cells = {int(row["label"]): int(row["cell"]) for row in csv.DictReader(file)}
    assert cells.keys() == tracks.keys()
    return tracks, masks, cells


def as_cells(masks, cells) -> list[np.ndarray]:
    """The masks with the number of the cell plus 1, as `to_labels` has them."""
    table = np.zeros(65536, np.int64)
    for label, cell in cells.items():
        table[label] = cell + 1
    return [table[mask] for mask in masks]


def seen_ancestor(tree, cell: int, seen) -> int | None:
    """The nearest ancestor of a cell among those seen."""
    return next((c for c in tree.ancestors(cell, 1) if c in seen), None)


def assert_true(results, folder, **view) -> None:
    """Masks are those of `to_labels`, and the tree is the lineage without the cells not seen."""
    tracks, masks, cells = read(folder)
    path = results.to_labels(folder.parent / "labels.tif", **view, overwrite=True)
    pages = tifffile.imread(path).reshape(len(masks), *masks[0].shape)
    assert np.array_equal(np.stack(as_cells(masks, cells)), pages)
    tree, pieces = results.lineage(), {}
    for label, cell in cells.items():
        pieces.setdefault(cell, []).append((tracks[label][0], label))
    for cell, own in pieces.items():
        own.sort()
        for (_, before), (_, after) in pairwise(own):
            assert tracks[after][2] == before and tracks[before][1] + 1 < tracks[after][0]
        above = seen_ancestor(tree, cell, pieces)
        parent = tracks[own[0][1]][2]
        assert parent == (0 if above is None else max(pieces[above])[1])


def test_the_folder_is_the_colony_in_masks_and_tree(run, tmp_path):
    folder = run.to_ctc(tmp_path / "ctc", **COMMON)
    assert_true(run, folder, **COMMON)
    tracks, masks, cells = read(folder)
    tree = run.lineage()
    own = tree.colony == 1
    assert len(masks) == len(run) and len(stack(folder / "01", "t")) == len(run)
    # every cell has one track, and a label that is its number plus 1
    assert sorted(cells.values()) == sorted(tree.cell[own].tolist())
    assert all(label == cell + 1 for label, cell in cells.items())
    for cell, parent, fate in zip(tree.cell[own], tree.parent[own], tree.fate[own], strict=True):
        begin, end, above = tracks[cell + 1]
        assert above == parent + 1
        if parent >= 0:
            assert tracks[above][1] == begin - 1
        assert (end == len(run) - 1) == (fate == "alive")
    daughters = [above for _, _, above in tracks.values() if above]
    assert all(daughters.count(above) == 2 for above in set(daughters)) and len(daughters) > 10


def test_frames_far_apart_name_the_nearest_ancestor_seen(run, tmp_path):
    view = {**COMMON, "frames": [0, len(run) // 2, len(run) - 1]}
    folder = run.to_ctc(tmp_path / "ctc", **view)
    assert_true(run, folder, **view)
    tracks, _, cells = read(folder)
    parents = {cells[label]: cells.get(above) for label, (_, _, above) in tracks.items()}
    tree = run.lineage()
    mothers = {c: tree.ancestors(c, 1)[0] for c, above in parents.items() if above is not None}
    assert any(parents[c] != mother for c, mother in mothers.items()), "choose other frames"


@dataclass(frozen=True)
class Passing(tf.Effect):
    """All cells but cell 0 move to the right by 0.8 µm a step."""

    title = "passing"
    stage = 35

    def reads(self):
        return ["position", "cells"]

    def writes(self):
        return ["position"]

    def step(self, state, dt, values):
        moved = torch.zeros_like(state.position)
        moved[:, 0] = 0.8 * (state.uid > 0)
        return state.replace(position=state.position + moved)


def test_a_cell_that_another_one_covers_goes_on_under_a_new_label(tmp_path):
    """A short cell passes over a long one, of which it is a part in frame 5."""
    cells = tf.Cells([[0.0, 0.0], [-4.0, 0.0]], [1.0, 0.0], length=[2.0, 1.0])
    scene = tf.Scene(Passing(), founders=cells, dim=2, dt=0.1)
    record(scene, scene.bind(2).start(), tmp_path / "run.h5", until=1.0, every=1)
    with tf.Results(tmp_path / "run.h5") as results:
        said = r"1 cell inside the image without a pixel.*cell 1 in frame 5: other cells cover it"
        with pytest.warns(UserWarning, match=said):
            folder = results.to_ctc(tmp_path / "ctc", **COMMON)
        assert_true(results, folder, **COMMON)
    tracks, _, cells = read(folder)
    assert tracks == {1: [0, 10, 0], 2: [0, 4, 0], 3: [6, 10, 2]} and cells == {1: 0, 2: 1, 3: 1}


def test_a_cell_that_is_hidden_in_several_frames_counts_once():
    with pytest.warns(UserWarning, match="^1 cell inside .* first of them cell 4 in frame 5:"):
        _warn_of([(4, 5), (4, 6)], [])


def test_pixels_as_large_as_cells_keep_the_format(run, tmp_path):
    """Which cells have a pixel changes from frame to frame."""
    view = {**COMMON, "pixel_size": 2.0}
    with pytest.warns(UserWarning, match=r"inside the image without a pixel.*larger than a cell"):
        folder = run.to_ctc(tmp_path / "ctc", **view)
    assert_true(run, folder, **view)


def test_a_cell_beyond_the_window_has_no_label(run, tmp_path):
    view = {**COMMON, "window": ((-2.0, -2.0), (2.0, 2.0))}
    folder = run.to_ctc(tmp_path / "ctc", **view)
    assert_true(run, folder, **view)
    _, masks, cells = read(folder)
    assert masks[0].shape == (40, 40) and len(set(cells.values())) < len(run.lineage().cell)


def test_cells_that_a_rule_removes_end_without_daughters(tmp_path):
    def update(cells):
        cells.remove_flag = (cells.time > 1.5) & (cells.time < 1.6) & (cells.uid % 2 == 0)

    growth, division = tf.Growth(rate=1.2), tf.Division(length=tf.Uniform(3.0, 4.0))
    scene = tf.Scene(tf.Rules(update), growth, division, tf.Mechanics(dim=2), dt=0.05)
    record(scene, scene.bind(2, seed=1).start(), tmp_path / "run.h5", every=2)
    with tf.Results(tmp_path / "run.h5") as results:
        folder = results.to_ctc(tmp_path / "ctc", **COMMON)
        assert_true(results, folder, **COMMON)
        tree = results.lineage()
        gone = tree.cell[(tree.colony == 1) & (tree.fate == "removed")]
        frames = len(results)
    tracks, _, _ = read(folder)
    assert len(gone) and all(tracks[c + 1][1] < frames - 1 for c in gone.tolist())
    assert not {above for _, _, above in tracks.values()} & {c + 1 for c in gone.tolist()}


def test_numbers_above_16_bits_give_labels_in_order(tmp_path):
    growth, division = tf.Growth(rate=1.2), tf.Division(length=tf.Uniform(3.0, 4.0))
    scene = tf.Scene(growth, division, tf.Mechanics(dim=2), dt=0.05)
    state = scene.bind(2).start()
    record(scene, state.replace(next_uid=state.next_uid + 70001), tmp_path / "run.h5", every=2)
    with tf.Results(tmp_path / "run.h5") as results:
        folder = results.to_ctc(tmp_path / "ctc", **COMMON)
        assert_true(results, folder, **COMMON)
    tracks, _, cells = read(folder)
    assert sorted(tracks) == [*range(1, len(tracks) + 1)] and max(cells.values()) > 70000
    begins = [tracks[label][0] for label in sorted(tracks)]
    assert begins == sorted(begins)


def family(count: int) -> SimpleNamespace:
    """A lineage of cells 0, 1, …, all founders."""
    return SimpleNamespace(
        cell=np.arange(count), colony=np.zeros(count, int), parent=np.full(count, -1),
        founder=np.arange(count),
    )  # fmt: skip


def test_16_bits_hold_65535_labels():
    full = LabelTracks(family(65535), 0)
    assert full.labels(np.arange(65535), 0) == [*range(1, 65536)]
    full.labels(np.arange(1, 65535), 1)
    with pytest.raises(tf.InputError, match=r"colony 0 needs more than 65535 labels by frame 2"):
        full.labels(np.arange(65535), 2)  # cell 0 has come back
    assert LabelTracks(family(65535), 0).labels(np.array([65534]), 0) == [65535]
    many = LabelTracks(family(65536), 0)
    assert many.labels(np.arange(1, 65536), 0) == [*range(1, 65536)]  # all that there are
    many = LabelTracks(family(65536), 0)
    with pytest.raises(tf.InputError, match=r"16 bits.*fewer frames.*smaller window"):
        many.labels(np.arange(65536), 0)


def test_images_are_those_of_the_fluorescence(run, tmp_path):
    given = {**COMMON, "channels": {"gfp": 50.0}, "blur": 0.2, "noise": 3.0, "background": 20.0}
    folder = run.to_ctc(tmp_path / "ctc", **given)
    light = tifffile.imread(run.to_ome_tiff(tmp_path / "l.tif", **given))
    assert np.array_equal(np.stack(stack(folder / "01", "t")), light.squeeze())
    with tifffile.TiffFile(folder / "01" / "t000.tif") as file:
        per_cm = file.pages[0].tags["XResolution"].value
    assert per_cm[0] / per_cm[1] == pytest.approx(1e4 / PIXEL)


def test_without_channels_all_cells_hold_one_dye(run, tmp_path):
    folder = run.to_ctc(tmp_path / "ctc", **COMMON, offset=0.0)
    for k, image in enumerate(stack(folder / "01", "t")):
        table = run.table(k)
        volume = table["volume"][table["colony"] == 1].sum()
        assert image.sum() * PIXEL**2 == pytest.approx(300 * volume, rel=0.02)


def test_a_species_called_dye_is_that_species(tmp_path):
    def circuit(u, s, p, cell):
        return {"dye": 5.0 - u.dye}

    circuit = tf.Circuit(circuit, species=("dye",))
    results = recorded(tf.Scene(tf.Growth(), circuit, tf.Mechanics(dim=2)), tmp_path / "run.h5", 1)
    folder = results.to_ctc(tmp_path / "ctc", **COMMON, channels={"dye": 1e3}, offset=0.0)
    table = results.table(-1)
    amount = (table["dye"] * table["volume"])[table["colony"] == 1].sum()
    last = stack(folder / "01", "t")[-1]
    assert last.sum() * PIXEL**2 == pytest.approx(1e3 * amount, rel=0.02)


def test_runs_in_space_give_the_masks_of_a_section(tmp_path):
    results = recorded(signalling(3), tmp_path / "run.h5", 1.0)
    with pytest.raises(tf.InputError, match=r"z = None.*height of the section"):
        results.to_ctc(tmp_path / "ctc", **COMMON)
    for light in ({"channels": {"gfp": 1.0}}, {"blur": 0.1}, {"noise": 0.0}, {"profile": "flat"}):
        with pytest.raises(tf.InputError, match=r"not for a run in space.*all heights"):
            results.to_ctc(tmp_path / "ctc", **COMMON, z=0.0, **light)
    folder = results.to_ctc(tmp_path / "ctc", **COMMON, z=0.0)
    assert_true(results, folder, **COMMON, z=0.0)
    assert sorted(p.name for p in folder.iterdir()) == ["01_GT", "cells.csv"]


def test_more_than_1000_frames_have_four_digits():
    assert cell_tracking._numbers(1000)[::999] == ["000", "999"]
    assert cell_tracking._numbers(1001)[::1000] == ["0000", "1000"]


def test_frames_without_cells_are_warned_of(run, tmp_path):
    last = run.table(-1)
    mine = last["colony"] == 1
    x, y = (last[n][mine] for n in "xy")
    far = np.hypot(x, y).argmax()
    window = tuple((float(x[far] + d), float(y[far] + d)) for d in (-0.3, 0.3))
    with pytest.warns(UserWarning, match=r"frames without a cell, the first of them frame 0"):
        folder = run.to_ctc(tmp_path / "ctc", **COMMON, window=window)
    read(folder)
    with pytest.raises(tf.InputError, match="has no cell in these images: there is nothing"):
        run.to_ctc(tmp_path / "none", **COMMON, window=((90.0, 90.0), (95.0, 95.0)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ctc"]


def test_bad_input_is_named(run, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("")
    for options, message in (
        ({"path": tmp_path / "no" / "ctc"}, "path = .*in a folder that exists.*Make"),
        ({"path": tmp_path / "file"}, "path = .*a folder, not a file"),
        ({"path": tmp_path / "full"}, "path = .*nothing yet, or an empty folder.*overwrite"),
        ({"path": tmp_path / "full", "overwrite": True}, "01, 01_GT, cells.csv and nothing else"),
        ({"path": "."}, "path = '.'.*name of a folder"),
        ({"pixel_size": 0.0}, "pixel_size = 0.0.*above 0"),
        ({"colony": None}, "has the colonies 0, 1: say which"),
        ({"z": 1.0}, "z = 1.0.*left out"),
        ({"channels": {"gfp": 1.0, "growth_rate": 1.0}}, "channels = .*one quantity"),
        ({"channels": {"gpf": 1.0}}, "channels = 'gpf'.*Did you mean gfp"),
        ({"channels": {"cell": 1e9}}, "channel 'cell'.*65535.*Lower the gain"),
        ({"profile": "round"}, "profile = 'round'"),
        ({"noise": math.nan}, "noise = nan"),
        ({"pixelsize": 0.1}, "pixelsize.*pixel_size"),
    ):
        with pytest.raises(tf.InputError, match=message):
            run.to_ctc(**{"path": tmp_path / "ctc", **COMMON, **options})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "full"], "nothing is left"
    assert (tmp_path / "full" / "thesis.tex").exists()


def test_a_folder_is_replaced_whole_or_not_at_all(run, tmp_path, monkeypatch):
    (tmp_path / "ctc").mkdir()  # an empty folder may be there
    few = {**COMMON, "frames": [0, 1]}
    folder = run.to_ctc(tmp_path / "ctc", **COMMON)
    with pytest.raises(tf.InputError, match="overwrite"):
        run.to_ctc(folder, **few)
    notes = folder / "01" / "notes.txt"
    notes.write_text("mine")
    with pytest.raises(tf.InputError, match=r"and nothing else.*It holds 01/notes\.txt"):
        run.to_ctc(folder, **few, overwrite=True)
    notes.unlink()
    write = cell_tracking._write_page

    def fail(path, *rest):
        if path.name == "t001.tif":
            raise OSError(28, "No space left on device")
        write(path, *rest)

    monkeypatch.setattr(cell_tracking, "_write_page", fail)
    with pytest.raises(tf.SimulationError, match=r"could not write .*ctc.*No space left"):
        run.to_ctc(folder, **few, overwrite=True)
    monkeypatch.undo()
    assert len(read(folder)[1]) == len(run)
    replace = os.replace

    def fail_at_the_end(source, target):
        if str(source).endswith(".new"):
            raise PermissionError("another program holds it")
        replace(source, target)

    monkeypatch.setattr(new_file.os, "replace", fail_at_the_end)
    with pytest.raises(tf.SimulationError, match="another program holds it"):
        run.to_ctc(folder, **few, overwrite=True)
    monkeypatch.undo()
    assert len(read(folder)[1]) == len(run)
    assert len(read(run.to_ctc(folder, **few, overwrite=True))[1]) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["ctc"]


def test_the_command(run, tmp_path):
    words = ("export", run.path, "ctc/", "--pixel-size", PIXEL, "--colonies", 1)
    done = shell(*words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert said[0] == "ctc" and said[1].startswith("images, label masks and tracks")
    assert_true(run, tmp_path / "ctc", **COMMON)
    again = shell(*words, folder=tmp_path)
    assert again.returncode != 0 and "--overwrite" in again.stderr
    more = ("--overwrite", "--frames", "0:3", "--channels", "gfp=50", "--noise", 2)
    done = shell(*words, *more, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(stack(tmp_path / "ctc" / "01", "t")) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"ctc has no suffix.*Cell\s+Tracking Challenge.*--pixel-size.*\.csv"),
        ({"pixel_size": 0.1}, "has the colonies 0, 1: say which"),
        ({"pixel_size": 0.1, "colonies": [0, 1]}, r"--colonies = \[0, 1\].*one colony"),
        ({"pixel_size": 0.1, "rods": "lines"}, "--rods: not for ctc, which holds images, label"),
        ({"pixel_size": 0.1, "window": [0.0]}, "--window.*LEFT BOTTOM RIGHT TOP"),
    ],
)
def test_what_does_not_fit_is_named(run, tmp_path, options, message):
    with pytest.raises(tf.InputError, match=message):
        Export(run.path, tmp_path / "ctc", **options)()
    assert list(tmp_path.iterdir()) == []
