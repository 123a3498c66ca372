"""`torchfilm tune`, `run --settings` and `run --preset`: what is printed, written, recorded and
gone on with."""

from __future__ import annotations

import json

import pytest

import torchfilm as tf

SCENE = """
import torchfilm as tf

def made(u, s, p, cell):
    return {"m": 1.0 - u.m}

circuit = tf.Circuit(made, species=("m",))
scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), circuit, dt=0.05, dim=3)
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mine.py").write_text(SCENE)
    return tmp_path


@pytest.fixture
def done(command, capsys):
    """What a command that must work prints."""

    def call(*arguments) -> str:
        command(*arguments)
        return capsys.readouterr().out

    return call


def test_tune_prints_what_it_chose_and_writes_it_for_a_run(folder, done):
    out = done(
        "tune",
        "mine.py",
        "--error",
        "5%",
        "--cells",
        "4",
        "--colonies",
        "2",
        "--out",
        "s.json",
        "--plot",
        "cost.png",
    )
    assert "mine: 5 % in cells, volume" in out and "settings  s.json" in out
    assert "picture   cost.png" in out and (folder / "cost.png").stat().st_size > 0
    saved = tf.Settings.load(folder / "s.json")
    assert f"dt={saved.dt:g}" in out and f"rtol={saved.rtol:g}" in out
    done("run", "mine.py", "--settings", "s.json", "--cells", "4", "--out", "a.h5", "--no-picture")
    with tf.Results(folder / "a.h5") as results:
        assert results.accuracy == saved.given and results.attributes["dt"] == saved.dt
    done("resume", "a.h5", "--scene", "mine.py", "--cells", "8", "--no-picture")
    with tf.Results(folder / "a.h5") as results:
        assert results.counts[-1].min() >= 8


def test_a_run_by_a_preset_says_so_in_its_results(folder, done):
    done("run", "mine.py", "--preset", "draft", "--cells", "2", "--out", "a.h5", "--no-picture")
    with tf.Results(folder / "a.h5") as results:
        assert results.attributes["dt"] == pytest.approx(0.08) and results.accuracy["rtol"] == 0.01


def test_explain_says_what_a_preset_would_do(folder, done):
    words = [
        done("explain", "mine.py", "--seconds", "0", *more) for more in ((), ("--preset", "draft"))
    ]
    assert "0.05 h" in words[0] and "0.08 h" in words[1]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("tune", "mine.py", "--error", "much"), "--error = 'much'"),
        (("tune", "mine.py", "--error", "60%"), "error = 0.6"),
        (("tune", "mine.py", "--error", "3"), "did you mean 3%?"),
        (("tune", "mine.py", "--error", "200%"), "a share below the whole"),
        (
            ("run", "mine.py", "--preset", "drafty", "--cells", "2"),
            "'drafty' is not allowed: it must be one of 'draft', 'standard', 'reference'",
        ),
        (
            ("explain", "mine.py", "--preset", "draft", "--settings", "s.json"),
            "give one of the two",
        ),
        (("tune", "mine.py", "--out", "mine.py"), "no file yet"),
        (("tune", "mine.py", "--plot", "mine.py"), "ends in .png, .pdf or .svg"),
        (("tune", "mine.py", "--plot", "nowhere/cost.png"), "in a folder that exists"),
        (("tune", "mine.py", "--plot", "old.png"), "--plot = 'old.png'"),
        (
            ("run", "mine.py", "--preset", "draft", "--settings", "s.json", "--cells", "2"),
            "give one of the two",
        ),
        (("run", "mine.py", "--settings", "none.json", "--cells", "2"), "cannot be read"),
        (("run", "mine.py", "--settings", "empty.json", "--cells", "2"), "no settings of accuracy"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_runs(folder, command, arguments, words):
    (folder / "empty.json").write_text(json.dumps({}))
    (folder / "old.png").write_text("")
    with pytest.raises(SystemExit) as caught:  # no traceback
        command(*arguments)
    assert isinstance(caught.value.code, str) and words in caught.value.code
    assert not list(folder.glob("*.h5"))
