"""Results files that were made or changed on purpose: links out of them, attributes and numbers
that make no sense."""

from __future__ import annotations

import shutil

import h5py
import numpy as np
import pytest

import torchfilm as tf
from design.data_file import reading


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
