"""The command `torchfilm export`: a format for each suffix, and clear words for what does not
fit."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from commands import shell
from exported import polydata, recorded, signalling

import torchfilm as tf
from torchfilm.cli.export import Export
from torchfilm.cli.inspect import Info

networkx = pytest.importorskip("networkx", reason="the extra tables")
tifffile = pytest.importorskip("tifffile", reason="the extra images")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "run.h5"
    recorded(signalling(), path, 2.0)
    return path


def test_the_command_in_a_shell(run, tmp_path):
    done = shell("export", run, "cells.csv", "--frames", 0, -1, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["cells.csv"]
    with open(tmp_path / "cells.csv") as file:
        rows = list(csv.DictReader(file))
    with tf.Results(run) as results:
        table = {
            n: np.concatenate([results.table(k)[n] for k in (0, -1)]) for n in results.table(0)
        }
    assert list(rows[0]) == list(table) and len(rows) == len(table["cell"])
    for name in ("cell", "x", "gfp", "k", "age"):
        assert np.allclose([float(r[name]) for r in rows], table[name], rtol=1e-5), name
    again = shell("export", run, "cells.csv", folder=tmp_path)
    assert again.returncode != 0 and "--overwrite" in again.stderr
    assert "Traceback" not in again.stderr


def test_every_format(run, tmp_path, capsys):
    def export(name, **options):
        Export(run, tmp_path / name, **options)()
        lines = capsys.readouterr().out.splitlines()
        return [line.rpartition("/")[2] for line in lines if not line.startswith("label masks")]

    with tf.Results(run) as results:
        tree, table, frames = results.lineage(), results.table(-1), len(results)
        count = len(table["cell"])
        assert export("a.vtkhdf", frames=["-1"]) == ["a.vtkhdf", "a_signals.vtkhdf"]
        assert len(polydata(tmp_path / "a.vtkhdf", 0)["Polygons"]) == 60 * count
        assert export("a.nwk", colonies=[1]) == ["a.nwk"]
        assert (tmp_path / "a.nwk").read_text() == tree.to_newick(1)
        assert export("a.lineage.csv") == ["a.lineage.csv"]
        header, *rows = (tmp_path / "a.lineage.csv").read_text().splitlines()
        assert header.endswith("fate,birth_length,end_length,cell_type") and len(rows) == len(tree)
        assert export("a.graphml") == ["a.graphml"]
        graph = networkx.read_graphml(tmp_path / "a.graphml")
        assert len(graph) == len(tree)
        keys = sorted((node["colony"], node["cell"]) for _, node in graph.nodes(data=True))
        assert keys == sorted(zip(tree.colony.tolist(), tree.cell.tolist(), strict=True))
    assert export("a.tif", colonies=[1], pixel_size=0.1) == ["a.tif"]
    masks = tifffile.imread(tmp_path / "a.tif")
    assert masks.shape[0] == frames
    assert len(np.unique(masks[-1])) == 1 + (table["colony"] == 1).sum()
    assert export(
        "a.ome.tif", colonies=[1], pixel_size=0.1, channels=["gfp=10"], noise=0.0, frames=["-1"],
        window=[-10.0, -10.0, 10.0, 10.0],
    ) == ["a.ome.tif"]  # fmt: skip
    image = tifffile.imread(tmp_path / "a.ome.tif")
    assert image.shape == (200, 200) and image.dtype == np.uint16
    with pytest.raises(tf.InputError, match="no file yet"):
        export("a.csv") and export("a.csv")
    assert export("a.csv", overwrite=True, internals=True) == ["a.csv"]
    assert "displacement_0" in (tmp_path / "a.csv").read_text().splitlines()[0]


@pytest.mark.parametrize("name", ["a.tif", "a.ome.tif"])
def test_images_say_what_they_are(run, tmp_path, name, capsys):
    given = {"colonies": [1], "pixel_size": 0.2, "frames": ["0"]}
    Export(run, tmp_path / name, **given)()
    said = capsys.readouterr().out.splitlines()
    assert said[0].endswith(name) and len(said) == 2
    assert said[1].startswith("label masks") and "--channels" in said[1]
    Export(run, tmp_path / name, **given, channels=["gfp=10"], overwrite=True)()
    assert len(capsys.readouterr().out.splitlines()) == 1


@pytest.mark.parametrize(
    "given, places",
    [
        (["1:3"], slice(1, 3)),
        ([":2", "-1"], [0, 1, -1]),
        (["::2"], slice(None, None, 2)),
        (["-2:"], slice(-2, None)),
        (["1:999"], slice(1, None)),
    ],
)
def test_frames_are_numbers_and_ranges(run, tmp_path, given, places):
    Export(run, tmp_path / "a.csv", frames=given)()
    with open(tmp_path / "a.csv") as file:
        found = list(dict.fromkeys(int(row["frame"]) for row in csv.DictReader(file)))
    with tf.Results(run) as results:
        assert found == np.arange(len(results))[places].tolist()


def test_a_range_of_frames_in_a_shell(run, tmp_path):
    done = shell("export", run, "a.csv", "--frames=-2:", folder=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.csv", {"frames": ["2:x"]}, r"--frames = '2:x'.*START:STOP"),
        ("a.csv", {"frames": ["1:2:3:4"]}, r"--frames = '1:2:3:4'.*START:STOP"),
        ("a.csv", {"frames": ["1:5:0"]}, r"--frames = '1:5:0'.*START:STOP"),
        ("a.csv", {"frames": ["800:"]}, r"--frames = '800:'.*at least one of the frames 0 to"),
        ("a.csv", {"frames": ["900"]}, r"frames = \[900\].*each from"),
        ("a.csv", {"frames": ["::-1"]}, r"in the order of time"),
        ("a.png", {}, r"OUT = .*\.csv, \.nwk, \.graphml, \.vtkhdf, \.tif, \.tiff"),
        ("a.csv", {"noise": 0.0}, r"--noise: not for a\.csv, which holds the table"),
        ("a.nwk", {"frames": ["0"]}, r"--frames: not for a\.nwk, which holds the lineage"),
        ("a.nwk", {"colonies": [0, 1]}, r"--colonies = \[0, 1\].*one colony"),
        ("a.tif", {}, "an image needs --pixel-size"),
        ("a.tif", {"pixel_size": 0.1}, "has the colonies 0, 1: say which"),
        ("a.tif", {"pixel_size": 0.1, "blur": 0.2}, r"--blur: not for a\.tif.*needs --channels"),
        ("a.tif", {"pixel_size": 0.1, "window": [0.0]}, "--window.*LEFT BOTTOM RIGHT TOP"),
        ("a.tif", {"pixel_size": 0.1, "channels": ["gfp"]}, "--channels = 'gfp'.*gfp=100"),
        ("a.vtkhdf", {"pixel_size": 0.1}, "--pixel-size: not for"),
        ("no/a.csv", {}, "a folder that exists"),
    ],
)
def test_what_does_not_fit_is_named(run, tmp_path, name, options, message):
    with pytest.raises(tf.InputError, match=message):
        Export(run, tmp_path / name, **options)()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("suffix", [".csv", ".vtkhdf", ".nwk", ".graphml", ".tif", ".ome.tif", ""])
def test_damaged_results_are_named(run, tmp_path, share, suffix):
    data = run.read_bytes()
    (tmp_path / "cut.h5").write_bytes(data[: int(share * len(data))])
    out = tmp_path / f"a{suffix}"
    image = {"pixel_size": 0.1, "colonies": [0]} if suffix in ("", ".tif", ".ome.tif") else {}
    light = {"channels": ["gfp=1"]} if suffix == ".ome.tif" else {}
    with pytest.raises(tf.InputError, match=r"cut\.h5"):
        Export(tmp_path / "cut.h5", out, **image, **light)()
    assert not out.exists()


def test_the_results_themselves_are_never_replaced(run, tmp_path):
    copy = tmp_path / "run.csv"
    copy.write_bytes(run.read_bytes())
    with pytest.raises(tf.InputError, match="another file than the results"):
        Export(copy, copy, overwrite=True)()
    assert copy.read_bytes() == run.read_bytes()


def test_info_names_columns_and_values_of_colonies(run, capsys):
    Info(str(run))()
    text = capsys.readouterr().out
    columns = next(x for x in text.splitlines() if x.startswith("columns of the table"))
    assert "gfp, growth_rate, out.ahl" in columns and "displacement" not in columns
    assert "Circuit.parameters['k'] = 1, 2" in text and "Growth.rate = 0.8, 1.4" in text
