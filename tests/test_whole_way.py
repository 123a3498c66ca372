"""experiments/whole_way.py goes from masks to files of other programs, at a tiny size."""

from __future__ import annotations

import json
import sys
from importlib import util
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import tifffile

SCRIPT = Path(__file__).parents[1] / "experiments" / "whole_way.py"


@pytest.fixture
def whole_way(monkeypatch):
    """The script's `main`, as it runs with arguments."""
    spec = util.spec_from_file_location("whole_way", SCRIPT)
    module = util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "whole_way", module)
    spec.loader.exec_module(module)

    def run(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["whole_way.py", *arguments])
        module.main()

    return run


def test_masks_of_one_frame_are_refused_in_words(tmp_path, whole_way):
    labels = np.zeros((60, 60), dtype=np.uint16)
    labels[20:32, 10:50] = 1
    tifffile.imwrite(tmp_path / "single.tif", labels)
    given = ["--masks", str(tmp_path / "single.tif"), "--out", str(tmp_path / "out")]
    with pytest.raises(
        SystemExit, match=r"frame = 5 .*single\.tif has 1 frame.* --frames FIRST LAST"
    ):
        whole_way(*given)
    with pytest.raises(SystemExit, match=r"none\.tif cannot be read: No such file.*--masks"):
        whole_way("--masks", str(tmp_path / "none.tif"), "--out", str(tmp_path / "out"))


def test_the_options_of_the_whole_way(whole_way, capsys):
    with pytest.raises(SystemExit):
        whole_way("--help")
    said = " ".join(capsys.readouterr().out.split())
    for words in (
        "(default: made here)",
        "(default: 0.065)",
        "(default: (5, 9))",
        "(default: 480)",
    ):
        assert words in said
    with pytest.raises(SystemExit):
        whole_way("--frames", "9", "5")
    assert "the earlier frame first" in capsys.readouterr().err


@pytest.mark.slow
def test_masks_become_a_fit_a_design_and_files(tmp_path, whole_way, capsys):
    whole_way("--frames", "3", "5", "--colonies", "16", "--out", str(tmp_path))

    said = capsys.readouterr().out
    rate = json.loads((tmp_path / "fit.json").read_text())["parameters"]["rate"]
    assert f"growth rate {rate:.3f} /h (hidden: 1.15)" in said
    masks = tifffile.imread(tmp_path / "masks.tif")
    assert len(masks) == 6  # a frame each half hour, to the last one of the fit
    table = pd.read_csv(tmp_path / "cells.csv")
    first = table[table["frame"] == 0]
    assert len(first) == len(set(masks[3].flat) - {0})  # the design starts from these cells
    assert {"gfp", "out.morphogen", "growth_rate"} <= set(table)
    with h5py.File(tmp_path / "cells.vtkhdf") as file:
        assert file["VTKHDF/Steps"].attrs["NSteps"] == table["frame"].nunique()
    with tifffile.TiffFile(tmp_path / "fluorescence.ome.tif") as image:
        assert len(image.pages) == table["frame"].nunique()
        assert 'Name="gfp"' in image.ome_metadata
    for name in ("cells_signals.vtkhdf", "stripe.json", "masks.png", "whole_way.png"):
        assert str(tmp_path / name) in said and (tmp_path / name).stat().st_size > 0
