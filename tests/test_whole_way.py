"""experiments/whole_way.py goes from masks to files of other programs, at a tiny size."""

from __future__ import annotations

import json
import sys
from importlib import util
from pathlib import Path

import h5py
import pandas as pd
import pytest
import tifffile

SCRIPT = Path(__file__).parents[1] / "experiments" / "whole_way.py"


@pytest.mark.slow
def test_masks_become_a_fit_a_design_and_files(tmp_path, monkeypatch, capsys):
    spec = util.spec_from_file_location("whole_way", SCRIPT)
    whole_way = util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "whole_way", whole_way)
    spec.loader.exec_module(whole_way)
    arguments = ["--frames", "3", "5", "--colonies", "16", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["whole_way.py", *arguments])
    whole_way.main()

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
