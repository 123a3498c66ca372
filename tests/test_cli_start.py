"""Runs of the command line that start from the cells of a file, `--start`."""

from __future__ import annotations

import numpy as np
import pytest

import torchfilm as tf


def test_start_from_a_frame_of_results(command):
    """Another scene starts from the cells of a frame, at their places, with their levels."""
    command("run", "quorum_sensing", "--colonies", 2, "--until", 1, "--out", "a.h5", "--no-picture")
    run = ("run", "microcolony", "--until", 0.05, "--every", 1, "--no-picture")
    for frame, options in ((-1, ()), (1, ("--frame", 1))):
        command(*run, "--start", "a.h5", "--out", f"b{frame}.h5", *options)
        with tf.Results("a.h5") as old, tf.Results(f"b{frame}.h5") as new:
            then, now = old.frame(frame), new.frame(0)
        for name in ("colony", "position", "axis", "length", "ahl"):
            assert np.allclose(then[name], now[name], rtol=1e-6, atol=0), name
    for options, said in (
        (("--frame", 99), "frame = 99.*has 5 frames"),
        (("--pixel-size", 1), "--pixel-size.*left out: a.h5 is a results file"),
    ):
        with pytest.raises(SystemExit, match=said):
            command(*run, "--start", "a.h5", "--out", "c.h5", *options)


def test_start_from_a_label_image(command):
    mask = np.zeros((40, 60), np.uint16)
    mask[10:20, 5:35], mask[25:35, 20:50] = 1, 2
    np.save("masks.npy", np.stack([0 * mask + (mask == 1), mask]))
    run = ("run", "microcolony", "--until", 0.05, "--no-picture", "--start", "masks.npy")
    with pytest.raises(
        SystemExit, match=r"does not state the size of its pixels.*give --pixel-size"
    ):
        command(*run)
    with pytest.raises(SystemExit, match=r"2 frames.*--frame"):
        command(*run, "--pixel-size", 0.1)
    command(*run, "--pixel-size", 0.1, "--frame", 1, "--out", "a.h5")
    with tf.Results("a.h5") as results:
        first = results.frame(0)
    assert first["position"][:, 0].tolist() == pytest.approx([1.95, 3.45])
    assert (first["length"] + 2 * first["radius"]).tolist() == pytest.approx([3.0, 3.0], rel=0.15)


def test_columns_in_capitals_are_renamed(command, tmp_path):
    """The command line has no option for names of columns."""
    (tmp_path / "cells.csv").write_text("X,Y,angle_rad,length_um\n0,0,0,2\n")
    with pytest.raises(SystemExit, match=r"case count: rename X, Y to x, y\.$"):
        command("run", "microcolony", "--start", "cells.csv", "--until", 0.05)


def test_the_version(command, capsys):
    command("--version")
    assert capsys.readouterr().out == f"torchfilm {tf.__version__}\n"


def test_files_with_scenes_of_one_name_have_results_of_their_own(command, tmp_path):
    """Ready-made ones, too: the second had replaced the first."""
    ready = "import torchfilm as tf\ndef scene(): return tf.scenes.microcolony()\n"
    for name in ("one", "other"):
        (tmp_path / f"{name}.py").write_text(ready, encoding="utf-8")
        command("run", f"{name}.py", "--until", 0.05, "--no-picture")
    assert {x.name for x in tmp_path.glob("*.h5")} == {"one.h5", "other.h5"}
