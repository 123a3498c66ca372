"""The command line: show and info, and which pictures may be replaced."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from commands import ENVIRONMENT, OWN, drawn

import torchfilm as tf

# --- show and info --------------------------------------------------------------------------------


def test_show(command, capsys):
    command(
        "run",
        "microcolony",
        "--set",
        "dim=3",
        "--colonies",
        2,
        "--until",
        3,
        "--out",
        "a.h5",
        "--no-picture",
    )
    capsys.readouterr()
    command("show", "a.h5")
    assert capsys.readouterr().out.strip() == "a.png"
    assert drawn("a.png") > 0.02
    command("show", "a.h5", "--frame", 0, "--colour", "length", "--view", "xz", "--out", "side.png")
    assert drawn("side.png") > 0.02
    assert Path("side.png").read_bytes() != Path("a.png").read_bytes()


SIGNAL = """
import torchfilm as tf

def shine(cells):
    cells.yfp = 0 * cells.yfp + cells.time

scene = tf.Scene(
    tf.Rules(shine, variables={"yfp": 0.0, "cfp": 1.0}), tf.Growth(rate=1.0), tf.Mechanics(dim=2),
    tf.Medium(
        ahl=tf.Signal(diffusion=1.0, initial=1.0), box=((-16, -8, -4), (16, 8, 4)), spacing=4.0
    ),
    dt=0.1,
)
"""


@pytest.fixture
def shining(command, capsys):
    """Two colonies with something to show: three frames of yfp, cfp and ahl."""
    Path("mine.py").write_text(SIGNAL)
    command(
        "run",
        "mine.py",
        "--colonies",
        2,
        "--until",
        0.6,
        "--every",
        3,
        "--out",
        "a.h5",
        "--no-picture",
    )
    capsys.readouterr()


def asked(monkeypatch, name: str) -> list[dict]:
    """What the command asks of a function of `torchfilm.pictures`, in place of drawing it."""
    seen: list[dict] = []

    def note(path, out=None, **options):
        seen.append({"out": out, **options})
        return out

    monkeypatch.setattr(tf.pictures, name, note)
    return seen


def test_show_passes_on_what_is_asked(command, shining, monkeypatch):
    seen = asked(monkeypatch, "show")
    command(
        "show",
        "a.h5",
        "--channels",
        "cfp=cyan",
        "yfp=#ffff00",
        "--background",
        "ahl",
        "--limits",
        "yfp=0:2",
        "out.ahl=1e-3:0.5",
        "--log",
        "out.ahl",
        "--section",
        "-2.5",
        "--whole",
        "--colonies",
        1,
        "--frame",
        1,
    )
    assert seen == [
        {
            "out": Path("a.png"),
            "frame": 1,
            "colour": None,
            "channels": {"cfp": "cyan", "yfp": "#ffff00"},
            "background": "ahl",
            "limits": {"yfp": (0.0, 2.0), "out.ahl": (1e-3, 0.5)},
            "log": ["out.ahl"],
            "view": "xy",
            "section": -2.5,
            "whole": True,
            "colonies": [1],
        }
    ]
    command("show", "a.h5", "--log")
    assert seen.pop()["log"] is True
    command("show", "a.h5")
    assert seen[1] == {
        "out": Path("a.png"),
        "frame": -1,
        "colour": None,
        "channels": None,
        "background": None,
        "limits": {},
        "log": False,
        "view": "xy",
        "section": "cells",
        "whole": False,
        "colonies": None,
    }


def test_strips_and_films_pass_on_what_is_asked(command, shining, monkeypatch):
    strips, films = asked(monkeypatch, "strip"), asked(monkeypatch, "movie")
    look = [
        "--colour",
        "yfp",
        "--background",
        "ahl",
        "--limits",
        "yfp=0:2",
        "--section",
        "mean",
        "--colonies",
        0,
        1,
    ]
    wanted = {
        "colour": "yfp",
        "channels": None,
        "background": "ahl",
        "limits": {"yfp": (0.0, 2.0)},
        "log": False,
        "view": "xy",
        "section": "mean",
        "whole": False,
        "colonies": [0, 1],
    }
    command("show", "a.h5", "--strip", 3, *look)
    command("show", "a.h5", "--times", 0.1, 0.5, "--out", "b.png", *look)
    command("show", "a.h5", "--movie", "b.gif", "--fps", 4, *look)
    assert strips == [
        {"out": Path("a_strip.png"), "count": 3, "times": None, **wanted},
        {"out": Path("b.png"), "count": None, "times": [0.1, 0.5], **wanted},
    ]
    assert films == [{"out": Path("b.gif"), "fps": 4.0, **wanted}]


def test_pictures_strips_and_films_are_drawn(command, shining, capsys):
    command("show", "a.h5", "--channels", "cfp=blue", "yfp=red", "--background", "ahl")
    command("show", "a.h5", "--colour", "yfp", "--strip", 2)
    command("show", "a.h5", "--colour", "yfp", "--movie", "a.gif")
    assert capsys.readouterr().out.split() == ["a.png", "a_strip.png", "a.gif"]
    assert (
        drawn("a.png") > 0.01
        and drawn("a_strip.png") > 0.005
        and Path("a.gif").read_bytes().startswith(b"GIF89a")
    )


@pytest.mark.parametrize(
    "line, message",
    [
        ("--limits yfp=2", r"--limits = 'yfp=2'.*LOW:HIGH"),
        ("--limits yfp=0:1:2", r"--limits.*LOW:HIGH"),
        ("--limits yfp", r"--limits = 'yfp'"),
        ("--channels cfp", r"--channels = 'cfp'.*NAME=COLOUR"),
        ("--channels cfp=cian", r"'cian'"),
        ("--colour yfp --channels cfp=cyan", r"colour and channels"),
        ("--background food", r"background = 'food'.*ahl"),
        ("--section middle --background ahl", r"section = 'middle'"),
        ("--strip 2 --movie b.gif", r"--strip or --times, --movie: give one of them"),
        ("--strip 2 --frame 0", r"--frame, --strip or --times: give one of them"),
        ("--strip 2 --times 0.1", r"--strip, --times: give one of them"),
        ("--movie b.gif --out b.png", r"--movie, --out: give one of them"),
        ("--movie b.avi", r"\.mp4 or \.gif"),
        ("--times 9", r"times = 9\.0.*0 to 0\.6 h"),
        ("--colonies 5", r"colonies = \[5\]"),
    ],
)
def test_show_tells_what_it_cannot_draw(command, shining, line, message):
    with pytest.raises(SystemExit, match=message):
        command("show", "a.h5", *line.split())
    assert {p.name for p in Path().iterdir()} <= {"a.h5", "mine.py", "__pycache__"}


@pytest.mark.parametrize(
    "line, name",
    [("--strip 2", "a_strip.png"), ("--strip 2 --out b.png", "b.png"), ("--movie b.gif", "b.gif")],
)
def test_strips_and_films_replace_nothing_unasked(command, shining, line, name):
    Path(name).write_text("my holidays")
    with pytest.raises(SystemExit, match=rf"{name}.*no file yet.*--overwrite"):
        command("show", "a.h5", *line.split())
    assert Path(name).read_text() == "my holidays"
    command("show", "a.h5", *line.split(), "--overwrite")
    assert Path(name).read_bytes()[:4] in (b"\x89PNG", b"GIF8")


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
    Path("decay.ant").write_text("species A; A' = -k*A; A = 1; k = 1")
    command("info", "decay.ant", "--set", "k=2.5")
    out = capsys.readouterr().out
    assert out.startswith("decay: 2-D") and "2.5" in out and "mechanics -> circuit" in out


@pytest.mark.parametrize("name", ["a.h5", "results.dat"])
def test_info_of_a_results_file(command, capsys, name):
    command(
        "run",
        "microcolony",
        "--colonies",
        2,
        "--until",
        0.5,
        "--seed",
        3,
        "--out",
        name,
        "--no-picture",
    )
    capsys.readouterr()
    command("info", name)
    out = capsys.readouterr().out
    for part in (
        name,
        "3 frames",
        "t = 0 to 0.5 h",
        "2 colonies",
        "seed 3",
        tf.__version__,
        str(torch.__version__),
        "microcolony: 2-D",
        "growth_rate",
    ):
        assert part in out, part


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["info", "microcolony"], ["--help"]], ids=["info", "help"])
def test_a_reader_that_has_read_enough_is_no_error(tmp_path, arguments):
    """`torchfilm info microcolony | head -1`: the reader is gone before all is written. No
    traceback, no complaint at the interpreter's end."""
    command = [sys.executable, "-m", "torchfilm.cli.main", *arguments]
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        child.stdout.close()  # long before the command has something to say
        said = child.stderr.read()
        assert child.wait(timeout=600) == 1 and said == ""


# --- pictures that are there already --------------------------------------------------------------


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
    with pytest.raises(
        SystemExit, match=r"picture = 'mine\.png'.*no file yet.*--overwrite.*--no-picture"
    ):
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
