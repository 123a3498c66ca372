"""The command line: show and info, and which pictures may be replaced."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from commands import ENVIRONMENT, OWN, drawn

import torchfilm as tf

# --- show and info --------------------------------------------------------------------------------------------------------


def test_show(command, capsys):
    command("run", "microcolony", "--set", "dim=3", "--colonies", 2, "--until", 3, "--out", "a.h5", "--no-picture")
    capsys.readouterr()
    command("show", "a.h5")
    assert capsys.readouterr().out.strip() == "a.png"
    assert drawn("a.png") > 0.02
    command("show", "a.h5", "--frame", 0, "--colour", "length", "--view", "xz", "--out", "side.png")
    assert drawn("side.png") > 0.02
    assert Path("side.png").read_bytes() != Path("a.png").read_bytes()


@pytest.mark.parametrize("name", ["microcolony", "programmed_growth", "channel"])
def test_info_of_a_ready_scene_says_who_drives_whom(command, capsys, name):
    command("info", name)
    out = capsys.readouterr().out
    assert out.startswith(f"{name}: 2-D") and "growth -> mechanics: length, elongation" in out
    if name == "programmed_growth":
        assert "rules -> growth: growth_rate" in out and "mechanics -> rules: position" in out


def test_info_of_a_scene_with_settings_and_of_a_file(command, capsys):
    command("info", "microcolony", "--set", "dim=3", "rate=[0.5, 1.0]")
    assert "3-D" in (out := capsys.readouterr().out) and "2 values" in out
    Path("mine.py").write_text(OWN)
    command("info", "mine.py")
    assert capsys.readouterr().out.startswith("mine: 2-D")


@pytest.mark.parametrize("name", ["a.h5", "results.dat"])
def test_info_of_a_results_file(command, capsys, name):
    command("run", "microcolony", "--colonies", 2, "--until", 0.5, "--seed", 3, "--out", name, "--no-picture")
    capsys.readouterr()
    command("info", name)
    out = capsys.readouterr().out
    for part in (name, "3 frames", "t = 0 to 0.5 h", "2 colonies", "seed 3", tf.__version__, str(torch.__version__), "microcolony: 2-D", "growth_rate"):
        assert part in out, part


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["info", "microcolony"], ["--help"]], ids=["info", "help"])
def test_a_reader_that_has_read_enough_is_no_error(tmp_path, arguments):
    """`torchfilm info microcolony | head -1`: the reader is gone before all is written. No traceback, no complaint at the interpreter's end."""
    command = [sys.executable, "-m", "torchfilm.cli", *arguments]
    with subprocess.Popen(command, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        child.stdout.close()  # long before the command has something to say
        said = child.stderr.read()
        assert child.wait(timeout=60) == 1 and said == ""


# --- pictures that are there already ---------------------------------------------------------------------------------------


@pytest.fixture
def run_once(command, capsys):
    """A run with its picture, and a picture of somebody's own."""
    command("run", "microcolony", "--until", 0.5, "--out", "a.h5")
    Path("mine.png").write_text("my holidays")
    capsys.readouterr()
    return Path("a.png").read_bytes()


def test_show_replaces_no_picture_unasked(command, run_once):
    with pytest.raises(SystemExit, match=r"--out = 'mine\.png'.*no file yet.*--overwrite"):
        command("show", "a.h5", "--out", "mine.png")
    assert Path("mine.png").read_text() == "my holidays"
    command("show", "a.h5", "--out", "mine.png", "--overwrite")
    assert drawn("mine.png") > 0.02


def test_the_runs_own_picture_is_drawn_anew_by_show_and_resume(command, run_once):
    command("show", "a.h5", "--colour", "length")
    assert Path("a.png").read_bytes() != run_once
    command("resume", "a.h5", "--until", 2)
    assert drawn("a.png") > 0.02 and Path("a.png").read_bytes() != run_once


def test_run_replaces_no_picture_unasked(command, run_once):
    """Told before anything runs, and nothing is written."""
    with pytest.raises(SystemExit, match=r"picture = 'mine\.png'.*no file yet.*--overwrite.*--no-picture"):
        command("run", "microcolony", "--until", 0.5, "--out", "mine.h5")
    assert Path("mine.png").read_text() == "my holidays" and not Path("mine.h5").exists()
    command("run", "microcolony", "--until", 0.5, "--out", "mine.h5", "--no-picture")
    assert Path("mine.png").read_text() == "my holidays"
    command("run", "microcolony", "--until", 0.5, "--out", "mine.h5", "--overwrite")
    assert drawn("mine.png") > 0.02


def test_a_picture_never_replaces_the_results_themselves(command):
    with pytest.raises(SystemExit, match=r"picture = 'a\.png'.*another file than the results"):
        command("run", "microcolony", "--until", 0.5, "--out", "a.png")
    assert not Path("a.png").exists()
    command("run", "microcolony", "--until", 0.5, "--out", "a.png", "--no-picture")
    data = Path("a.png").read_bytes()
    for line in ("show a.png", "show a.png --out a.png --overwrite", "resume a.png --until 1"):
        with pytest.raises(SystemExit, match="another file than the results"):
            command(*line.split())
        assert Path("a.png").read_bytes() == data
    command("show", "a.png", "--out", "b.png")
    assert drawn("b.png") > 0.02
