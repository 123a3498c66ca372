"""Results files that were made or changed on purpose: links out of them, attributes and numbers
that make no sense."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

import torchfilm as tf
from design.data_file import reading
from torchfilm.tools.whole_files import write_whole


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("hostile") / "run.h5"
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2))
    list(tf.simulate(scene, until=3.0, dt=0.1, record=path))
    return path


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copy(whole, tmp_path / "copy.h5")


def elsewhere(tmp_path):
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["s"] = np.arange(100.0)
    return tmp_path / "secret.h5"


@pytest.mark.parametrize("kind", ["external", "soft", "virtual", "raw"])
def test_data_in_other_places_are_not_read(copy, tmp_path, kind):
    secret = elsewhere(tmp_path)
    with h5py.File(copy, "a") as file:
        if kind == "external":
            file["cells/stolen"] = h5py.ExternalLink(str(secret), "/s")
        elif kind == "soft":
            file["cells/stolen"] = h5py.SoftLink("/cells/length")
        elif kind == "virtual":
            layout = h5py.VirtualLayout((100,), "f8")
            layout[:] = h5py.VirtualSource(str(secret), "s", (100,))
            file.create_virtual_dataset("cells/stolen", layout)
        else:
            size = secret.stat().st_size // 8
            file.create_dataset("cells/stolen", (size,), "f8", external=str(secret))
    with pytest.raises(tf.InputError, match="'/cells/stolen' lies in another place"):
        tf.Results(copy)
    with (
        pytest.raises(tf.InputError, match="'/cells/stolen' lies in another place"),
        reading(copy, "torchfilm results", 10**6, "file"),
    ):
        pass


def test_what_others_have_added_does_no_harm(copy):
    with h5py.File(copy, "a") as file:
        file["mine"] = np.dtype("f8")  # a named type
        for k in range(1200):
            file.create_group(f"notes/{k}")
        file["notes/again"] = file["notes"]  # a circle
        file["frames/note"] = ["a", "b"]
    with tf.Results(copy) as results:
        assert len(results.frame(-1)["uid"]) > 1


@pytest.mark.parametrize("name", ["recipe", "settings", "walls", "accuracy", "internal"])
@pytest.mark.parametrize("value", ["{", 3.5, [1, 2]])
def test_attributes_that_make_no_sense_are_reported(copy, name, value):
    with h5py.File(copy, "a") as file:
        file.attrs[name] = value
    with pytest.raises(tf.InputError, match=f"damaged: its '{name}'"):
        tf.Results(copy)


def test_a_version_that_is_no_number_is_reported(copy):
    with h5py.File(copy, "a") as file:
        file.attrs["version"] = "new"
    with pytest.raises(tf.InputError, match="damaged: its 'version'"):
        tf.Results(copy)


@pytest.mark.parametrize("count", [-1, 2**40])
def test_numbers_of_cells_that_cannot_be_are_reported(copy, count):
    with h5py.File(copy, "a") as file:
        file["frames/counts"][1] = count
    with tf.Results(copy) as results, pytest.raises(tf.InputError, match="damaged: frame 1"):
        results.frame(1)


def test_a_cell_that_is_its_own_ancestor_is_reported(copy):
    with h5py.File(copy, "a") as file:
        file["lineage/births/parent"][...] = file["lineage/births/uid"][...]
    with tf.Results(copy) as results:
        lineage = results.lineage()
        for question in (lineage.ancestors, lineage.descendants):
            with pytest.raises(tf.InputError, match="descends from a later one"):
                question(int(lineage.cell[-1]))


@pytest.mark.parametrize("name", ["x" * 300 + ".h5", "a\0b.h5"])
def test_a_name_that_no_file_can_have_is_refused(name):
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2)
    with pytest.raises(tf.InputError, match=r"record = .* is no path that a file can have"):
        tf.simulate(scene, until=0.1, record=name)
    with pytest.raises(tf.InputError, match="is no path that a file can have"):
        tf.Results(name)


def less(file, name, rows=1):
    """The dataset without its last rows."""
    values = file[name][:-rows]
    del file[name]
    file[name] = values


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda f: f.__delitem__("cells/axis"), "its 'cells/axis' is missing"),
        (lambda f: f.__delitem__("lineage/births/step"), "its 'lineage/births/step' is missing"),
        (lambda f: less(f, "cells/axis", 600), r"its 'cells/axis' has \d+ rows, and should have"),
        (lambda f: less(f, "lineage/births/step"), "its 'lineage/births/step' has"),
        (lambda f: less(f, "frames/time"), "its 'frames/time' has"),
        (lambda f: f.attrs.__setitem__("periodic", '{"x": 3}'), "its 'periodic' is not what"),
        (lambda f: f.attrs.__setitem__("declared", '{"a": [1]}'), "its 'declared' is not what"),
        (lambda f: f.attrs.__setitem__("effects", "7"), "its 'effects' is not what torchfilm wri"),
        (lambda f: f.attrs.__setitem__("recipe", "[" * 5000), "its 'recipe' is not what"),
        (lambda f: f.attrs.__setitem__("dtype", "load"), "its 'dtype' is 'load'"),
        (lambda f: f.attrs.__setitem__("dt", np.nan), "its 'dt' is nan"),
        (lambda f: f.attrs.__delitem__("declared"), "its 'declared' is missing"),
        (lambda f: (f.__delitem__("lineage/ends"), f.__setitem__("lineage/ends", 3)), "no group"),
        (lambda f: f.attrs.__setitem__("version", 0), "its 'version' cannot be read"),
        (lambda f: f.attrs.__setitem__("version", 2.9), "its 'version' cannot be read"),
    ],
)
def test_parts_that_are_missing_or_of_another_kind_are_reported(copy, spoil, words):
    with h5py.File(copy, "a") as file:
        spoil(file)
    with pytest.raises(tf.InputError, match=f"copy.h5 is damaged: .*{words}"):
        tf.Results(copy)


@pytest.mark.parametrize("name", ["cells/length", "frames/counts", "lineage/ends/uid"])
def test_parts_of_another_type_or_shape_are_reported(copy, name):
    with h5py.File(copy, "a") as file:
        count = len(file[name])
        del file[name]
        file[name] = np.full(count, b"text")
    with pytest.raises(tf.InputError, match=f"its '{name}' does not hold"):
        tf.Results(copy)


def test_a_dataset_that_says_it_is_huge_is_reported(copy):
    with h5py.File(copy, "a") as file:
        del file["frames/step"]
        file.create_dataset("frames/step", (2**40,), "i8", chunks=(1024,))
    with pytest.raises(tf.InputError, match="damaged"):
        tf.Results(copy)


def last_rows(file):
    first, count = (int(file[f"frames/{n}"][-1].sum()) for n in ("first_row", "counts"))
    return slice(first, first + count)


def change(name, value):
    def spoil(file):
        rows = last_rows(file) if name.startswith("cells/") else -1
        column = file[name][...]
        column[rows] = value
        file[name][...] = column

    return spoil


def the_last_number_is_free(file):
    change("frames/next_uid", file["cells/uid"][last_rows(file)].max())(file)


@pytest.mark.parametrize(
    "spoil, words",
    [
        (change("frames/next_uid", 0), "the numbers of new cells would be those of cells"),
        (the_last_number_is_free, "the numbers of new cells would be those of cells"),
        (change("cells/uid", 3), "two cells of a colony have one number"),
        (change("cells/colony", 1), "its cells are not those that its colonies count"),
        (change("cells/position", np.inf), "is not finite"),
        (change("cells/axis", np.nan), "is not finite"),
        (change("cells/radius", 0.0), "is below 0"),
        (change("cells/division_threshold", np.nan), "division threshold is no number"),
        (change("frames/time", np.nan), "its time or step is none"),
    ],
)
def test_no_run_goes_on_from_a_frame_that_makes_no_sense(copy, spoil, words):
    """Nor does the file grow: a lineage would have had cells twice."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2))
    with h5py.File(copy, "a") as file:
        spoil(file)
    with tf.Results(copy) as results, pytest.raises(tf.InputError, match=f"in frame .*{words}"):
        results.state(scene)


def test_a_run_goes_on_from_cells_without_a_cylinder(copy):
    with h5py.File(copy, "a") as file:
        change("cells/length", 0.0)(file)
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2))
    with tf.Results(copy) as results:
        assert results.state(scene).length.max() == 0.0


READER = """
import sys, torchfilm as tf
kept, seen = tf.Results(sys.argv[1]), 0
last = len(kept) + 20
while len(kept) < last:
    with tf.Results(sys.argv[1]) as fresh:
        frame = fresh.frame(-1)
        assert len({len(x) for x in frame.values()}) == 1
        fresh.table(-1)
        fresh.lineage()
    kept.refresh()
    table, lineage = kept.table(-1), kept.lineage()
    seen += len(table["cell"]) > 0 and len(lineage) >= len(table["cell"])
print("seen", seen)
"""


@pytest.mark.slow
def test_another_process_reads_what_grows(tmp_path):
    """Each frame is of one moment, with its lineage: HDF5 keeps the lengths that a process has
    seen, so that the same process would not tell."""
    path, reader = tmp_path / "grows.h5", None
    scene = tf.Scene(tf.Growth(rate=0.1), tf.Division(length=4.0), tf.Mechanics(dim=2))
    record = tf.Recorder(path, scene, every=1)
    for state in tf.simulate(scene, until=120.0, dt=0.1, record=record):
        if reader is None and path.exists():
            command = [sys.executable, "-c", READER, str(path)]
            reader = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        time.sleep(0.05 if state.step > 5 else 0.0)
        if reader is not None and reader.poll() is not None:
            break
    assert reader is not None
    said, _ = reader.communicate(timeout=60)
    assert reader.returncode == 0 and int(said.split()[1]) > 0


def test_cells_and_masks_in_other_places_are_not_read(tmp_path):
    secret = elsewhere(tmp_path)
    with h5py.File(tmp_path / "cells.h5", "w") as file:
        for name in ("y_um", "angle_rad", "length_um"):
            file[name] = np.array([3.0, 5.0])
        file["x_um"] = h5py.ExternalLink(str(secret), "/s")
    with pytest.raises(tf.InputError, match="'/x_um' lies in another place"):
        tf.Cells.from_hdf5(tmp_path / "cells.h5")
    with h5py.File(tmp_path / "delta.nc", "w") as file:
        file["roi00"] = h5py.ExternalLink(str(secret), "/")
    with pytest.raises(tf.InputError, match="'/roi00' lies in another place"):
        tf.Cells.from_masks(tmp_path / "delta.nc", pixel_size=0.1)


def test_exports_write_through_no_link_and_leave_the_files_of_others(whole, tmp_path, command):
    """The name of the file that becomes the export cannot be known before."""
    victim = tmp_path / "victim.txt"
    victim.write_text("mine")
    (tmp_path / ".cells.new.csv").symlink_to(victim)
    (tmp_path / ".tree.new.nwk").write_text("mine, too")
    for name in ("cells.csv", "tree.nwk"):
        command("export", whole, tmp_path / name)
        assert (tmp_path / name).is_file() and not (tmp_path / name).is_symlink()
    assert victim.read_text() == "mine"
    assert (tmp_path / ".tree.new.nwk").read_text() == "mine, too"
    assert len(list(tmp_path.iterdir())) == 5


def test_a_file_of_the_users_beside_the_results_stays(tmp_path):
    scene, notes = tf.Scene(tf.Growth(rate=1.0), dim=2), tmp_path / "run.h5.new"
    notes.write_text("my notes")
    with pytest.raises(tf.InputError, match=r"run\.h5\.new is no results file: move"):
        list(tf.simulate(scene, until=0.1, record=tmp_path / "run.h5"))
    assert notes.read_text() == "my notes"
    notes.unlink()
    notes.symlink_to(tmp_path / "nowhere")
    with pytest.raises(tf.InputError, match=r"Remove .*run\.h5\.new: it is a link"):
        list(tf.simulate(scene, until=0.1, record=tmp_path / "run.h5"))


def test_a_full_disk_leaves_the_older_file(tmp_path, monkeypatch):
    """Texts and pictures are written beside the file that they replace."""
    path = tmp_path / "kept.json"
    write_whole(path, "old")
    path.chmod(0o640)

    def full(*given, **named):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(type(path), "write_text", full)
        with pytest.raises(
            tf.SimulationError, match=r"kept\.json.*No space left.*Is the disk full"
        ):
            write_whole(path, "new")
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1
    write_whole(path, "new")
    assert path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(tf.InputError, match=r"in a folder that exists. Make .*none first"):
        write_whole(tmp_path / "none" / "a.json", "new")
    (tmp_path / "folder").mkdir()
    with pytest.raises(tf.SimulationError, match=r"There is a folder of this name\.$"):
        write_whole(tmp_path / "folder", "new")


def test_links_stay_and_lead_to_what_is_written(tmp_path):
    (tmp_path / "store").mkdir()
    kept, link = tmp_path / "store" / "kept.json", tmp_path / "link.json"
    kept.write_text("old")
    link.symlink_to(kept)
    write_whole(link, "new")
    assert link.is_symlink() and kept.read_text() == "new"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.json", "store"]
    write_whole(Path("/dev/null"), "gone")
    assert Path("/dev/null").is_char_device()


def test_permissions_are_those_of_new_files(tmp_path):
    """As for any file that the process makes; nothing of the process is changed for that."""
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "a.txt", "new")
    finally:
        os.umask(before)
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o640


def test_a_file_of_the_first_version_has_no_settings(copy):
    with h5py.File(copy, "a") as file:
        file.attrs["version"] = 1
        del file.attrs["settings"]
    with tf.Results(copy) as results:
        assert results.settings == {} and len(results.table(-1)["cell"])
