"""The command line: run, resume, show, info; own scene files; progress; and errors of one line."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import shutil
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import h5py
import matplotlib.image
import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm import cli

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200"}


def shell(*arguments: object, folder: Path, **options) -> subprocess.CompletedProcess:
    """The command as a user types it."""
    command = [sys.executable, "-m", "torchfilm.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, env=ENVIRONMENT, check=False, **options)


@pytest.fixture
def command(tmp_path, monkeypatch):
    """The same without a new process: `command("run", "microcolony", …)` in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)

    def call(*arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", ["torchfilm", *map(str, arguments)])
        cli.main()

    yield call
    sys.path[:] = path


OWN = """
import torchfilm as tf

def scene(rate=1.0, longest=4.0):
    return tf.Scene(tf.Growth(rate=rate), tf.Division(length=tf.Uniform(3.0, longest)), tf.Mechanics(dim=2), dt=0.05)
"""


def frames(path) -> dict:
    """The last frame and what led there."""
    with tf.Results(path) as results:
        return {"steps": results.steps.tolist(), "times": results.times.tolist(), **results.frame()}


def assert_same(a: dict, b: dict) -> None:
    for name in a:
        assert np.array_equal(a[name], b[name]), name


def drawn(path) -> float:
    """The share of a picture's pixels that are coloured: cells, not paper, letters or lines."""
    image = matplotlib.image.imread(path)[..., :3]
    return float(((image.max(2) - image.min(2)) > 0.15).mean())


# --- run ------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_run_as_a_newcomer_types_it(tmp_path):
    done = shell("run", "microcolony", "--colonies", 3, "--cells", 6, "--seed", 1, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    with tf.Results(tmp_path / "microcolony.h5") as results:
        assert results.counts.shape[1] == 3 and (results.counts[-1] >= 6).all() and not (results.counts[-2] >= 6).all()
        total = int(results.counts[-1].sum())
    assert drawn(tmp_path / "microcolony.png") > 0.02
    for part in ("microcolony.h5", "microcolony.png", f"{total} (", "colony radius", "overlap", "time for mechanics", "time for recording"):
        assert part in done.stdout, part


def test_the_command_is_installed():
    script = Path(sys.executable).with_name("torchfilm")
    assert script.exists()
    assert "torchfilm.cli" in script.read_text()


def test_run_with_settings(command):
    command("run", "microcolony", "--set", "dim=3", "rate=0.5", "law=length", "--until", 0.5, "--out", "a.h5", "--every", 4, "--double")
    with tf.Results("a.h5") as results:
        assert results.recipe == ("microcolony", {**results.recipe[1], "dim": 3, "rate": 0.5, "law": "length"})
        assert results.attributes["dtype"] == "float64" and results.attributes["dim"] == 3
        assert results.steps.tolist() == [0, 4, 8, 12, 16, 20]
        # one free cell by the law of length
        assert float(results.frame()["length"][0]) == pytest.approx(2 * np.exp(0.25), rel=1e-9)


def test_a_setting_for_each_colony(command):
    command("run", "microcolony", "--set", "rate=[0.5, 1.0]", "--colonies", 2, "--until", 0.5, "--out", "a.h5", "--no-picture")
    with tf.Results("a.h5") as results:
        assert results.frame()["growth_rate"].tolist() == [0.5, 1.0]
    assert not list(Path().glob("*.png"))


def test_the_same_as_the_library(command):
    command("run", "microcolony", "--colonies", 2, "--until", 3, "--seed", 5, "--out", "a.h5")
    scene = tf.scenes.microcolony()
    state = list(tf.simulate(scene, scene.seed(2, seed=5), until=3.0))[-1]
    found = frames("a.h5")
    assert np.array_equal(found["position"], state.position.numpy()) and np.array_equal(found["uid"], state.uid.numpy())


def test_a_scene_file_of_ones_own(command):
    Path("mine.py").write_text(OWN)
    command("run", "mine.py", "--set", "rate=0.5", "--until", 0.5)
    with tf.Results("mine.h5") as results:
        assert results.steps[-1] == 10 and results.frame()["growth_rate"].tolist() == [0.5]
        assert results.recipe is None and results.attributes["scene"].startswith("mine:")


def test_a_scene_file_may_hold_the_scene_itself_and_import_its_neighbours(command):
    Path("parts.py").write_text("RATE = 0.25\n")
    Path("mine.py").write_text("import torchfilm as tf\nfrom parts import RATE\nscene = tf.Scene(tf.Growth(rate=RATE), dt=0.1)\n")
    command("run", "mine.py", "--until", 0.5)
    assert frames("mine.h5")["growth_rate"].tolist() == [0.25]


def test_rules_beside_the_scene_file_are_found_from_anywhere(command, tmp_path):
    """`Rules("rules.py")` in a scene file means the file beside it, wherever the command is typed."""
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "rules.py").write_text("def update(cells):\n    cells.growth_rate = 0.5\n")
    (tmp_path / "model" / "mine.py").write_text('import torchfilm as tf\nscene = tf.Scene(tf.Rules("rules.py"), tf.Growth(), dt=0.1)\n')
    command("run", "model/mine.py", "--until", 0.5, "--out", "a.h5")
    assert frames("a.h5")["growth_rate"].tolist() == [0.5]


@pytest.mark.parametrize("kind", ["csv", "h5"])
def test_start_from_a_file_of_cells(command, capsys, kind):
    columns = {"x": [0.0, 0.0], "y": [0.0, 0.8], "angle": [0.0, 0.0], "length": [2.0, 2.2]}
    if kind == "csv":
        Path("cells.csv").write_text("x,y,angle,length\n0,0,0,2\n0,0.8,0,2.2\n")
    else:
        with h5py.File("cells.h5", "w") as file:
            for name, values in columns.items():
                file[name] = values
    command("run", "microcolony", "--start", f"cells.{kind}", "--until", 0.25, "--out", "a.h5")
    with tf.Results("a.h5") as results:
        assert results.frame(0)["length"].tolist() == [pytest.approx(2.0), pytest.approx(2.2)]
    assert re.search(r"1 pairs? .*overlap.*0\.2 µm", capsys.readouterr().out)


def test_programmed_growth_and_channel_run(command):
    for name in ("programmed_growth", "channel"):
        command("run", name, "--cells", 4)
        assert frames(f"{name}.h5")["uid"].size >= 4
        assert drawn(f"{name}.png") > 0.02


# --- resume ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [[], ["--dt", 0.05], ["--double", "--set", "rate=0.8", "shortest=3.0"]], ids=["plain", "own step", "own scene"])
def test_resume_bit_for_bit(command, options):
    """Also with a step of its own: what was given to `run` holds for `resume`."""
    command("run", "microcolony", "--colonies", 2, "--until", 3, "--out", "whole.h5", *options)
    command("run", "microcolony", "--colonies", 2, "--until", 1.5, "--out", "parts.h5", *options)
    command("resume", "parts.h5", "--until", 3)
    whole, parts = frames("whole.h5"), frames("parts.h5")
    assert whole.pop("steps")[-1] == parts.pop("steps")[-1]
    assert whole.pop("times")[-1] == parts.pop("times")[-1]
    assert_same(whole, parts)


def test_resume_of_ones_own_scene(command):
    Path("mine.py").write_text(OWN)
    command("run", "mine.py", "--until", 2, "--out", "whole.h5")
    command("run", "mine.py", "--until", 1, "--out", "parts.h5")
    command("resume", "parts.h5", "--scene", "mine.py", "--until", 2)
    assert_same(frames("whole.h5"), frames("parts.h5"))


def test_resume_of_ones_own_scene_with_its_settings(command):
    """Settings of a scene file are not data of the file's cells only: a resumed run must not fall back to the defaults."""
    Path("mine.py").write_text(OWN)
    command("run", "mine.py", "--set", "longest=3.2", "--until", 4, "--out", "whole.h5")
    command("run", "mine.py", "--set", "longest=3.2", "--until", 1, "--out", "parts.h5")
    command("resume", "parts.h5", "--scene", "mine.py", "--until", 4)
    assert_same(frames("whole.h5"), frames("parts.h5"))


def test_resume_a_run_from_given_cells(command):
    Path("cells.csv").write_text("x,y,angle,length,gfp\n0,0,0,2,1\n0,1.2,0,2.2,2\n")
    for name, until in (("whole.h5", 3), ("parts.h5", 1)):
        command("run", "microcolony", "--start", "cells.csv", "--until", until, "--out", name)
    command("resume", "parts.h5", "--until", 3)
    assert_same(frames("whole.h5"), frames("parts.h5"))


def test_resume_of_a_run_that_is_at_its_end_is_no_error(command):
    command("run", "microcolony", "--until", 0.5, "--out", "a.h5", "--no-picture")
    before = frames("a.h5")
    command("resume", "a.h5", "--until", 0.5, "--no-picture")
    assert_same(before, frames("a.h5"))


@pytest.mark.slow
@pytest.mark.parametrize("attempt", range(3))
def test_interrupted_from_the_keyboard(tmp_path, attempt):
    """Ctrl-C at whatever moment: it stops, with a word instead of a traceback, leaves a whole file, and resume goes on.

    Several times, because an interrupt that falls into a callback of the interpreter is easily swallowed there.
    """
    child = subprocess.Popen(
        [sys.executable, "-m", "torchfilm.cli", "run", "microcolony", "--colonies", "2", "--until", "8", "--every", "1"],
        cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    for _ in range(500):
        time.sleep(0.02)
        if (tmp_path / "microcolony.h5").exists():
            break
    time.sleep(0.3 + 0.1 * attempt)
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=60)
    assert child.returncode not in (0, -signal.SIGINT), f"the run went on to its end, or died of the signal: {errors[-300:]}"
    assert "Traceback" not in errors and "resume" in errors, errors
    with tf.Results(tmp_path / "microcolony.h5") as results:
        last = int(results.steps[-1])
        assert results.steps.tolist() == list(range(last + 1))
    done = shell("resume", "microcolony.h5", "--until", (last + 4) * 0.025, "--no-picture", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    with tf.Results(tmp_path / "microcolony.h5") as results:
        assert results.steps[-1] == last + 4


# --- watch and progress ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_watch_takes_up_an_edit_while_running(tmp_path):
    (tmp_path / "rules.py").write_text("import time\ndef update(cells):\n    time.sleep(0.02)\n    cells.growth_rate = 0.5\n")
    (tmp_path / "mine.py").write_text('import torchfilm as tf\nscene = tf.Scene(tf.Rules("rules.py"), tf.Growth(), dt=0.01)\n')
    child = subprocess.Popen(
        [sys.executable, "-m", "torchfilm.cli", "run", "mine.py", "--until", "1.5", "--watch", "--every", "1", "--no-picture"],
        cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    for _ in range(500):
        time.sleep(0.02)
        if (tmp_path / "mine.h5").exists():
            break
    time.sleep(0.4)
    (tmp_path / "rules.py").write_text("def update(cells)\n")
    time.sleep(0.4)
    (tmp_path / "rules.py").write_text("def update(cells):\n    cells.growth_rate = 2.0\n")
    out, errors = child.communicate(timeout=60)
    assert child.returncode == 0, errors
    said = out + errors
    assert said.index("rules.py is broken") < said.index("rules.py taken up")
    with tf.Results(tmp_path / "mine.h5") as results:
        rates = [float(results.frame(k)["growth_rate"][0]) for k in range(1, len(results))]
        assert results.steps[-1] == 150
    assert rates == sorted(rates) and set(rates) == {0.5, 2.0}


@pytest.mark.slow
@pytest.mark.parametrize("end", [["--cells", "40"], ["--until", "4"]], ids=["cells", "until"])
def test_progress_shows_cells_time_rate_and_the_estimated_end(tmp_path, end):
    """On a terminal; a pseudo-terminal plays its part."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 160, 0, 0))
    child = subprocess.Popen(
        [sys.executable, "-m", "torchfilm.cli", "run", "microcolony", *end, "--no-picture"],
        cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=follower,
    )  # fmt: skip
    os.close(follower)
    seen = b""
    while True:
        try:
            piece = os.read(leader, 65536)
        except OSError:  # the other end is closed
            break
        if not piece:
            break
        seen += piece
    os.close(leader)
    assert child.wait(timeout=60) == 0
    text = seen.decode()
    assert re.search(r"\d+ cells, t = \d+\.\d\d h, \d+ steps/s", text), text[-500:]
    assert re.search(r"\d\d:\d\d<\d\d:\d\d", text), "no estimated end"
    assert "100%" in text


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


# --- errors ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory) -> Path:
    """A folder with files of every unwelcome kind, and one good results file."""
    folder = tmp_path_factory.mktemp("spoilt")
    (folder / "text.h5").write_text("no numbers here\n" * 100)
    (folder / "text.csv").write_text("x,y,angle,length\n0,zero,0,2\n")
    (folder / "negative.csv").write_text("x,y,angle,length\n0,0,0,-2\n")
    with h5py.File(folder / "foreign.h5", "w") as file:
        file["x"] = [1.0]
    (folder / "mine.py").write_text(OWN)
    (folder / "fixed.py").write_text("import torchfilm as tf\nscene = tf.Scene(tf.Growth(rate=1.0))\n")
    (folder / "empty.py").write_text("")
    (folder / "number.py").write_text("scene = 3\n")
    (folder / "syntax.py").write_text("scene = = 3\n")
    (folder / "raises.py").write_text("import torchfilm as tf\nscene = tf.Scene(tf.Growth(rate=-1.0))\n")
    (folder / "rule.py").write_text(
        "import torchfilm as tf\ndef update(cells):\n    cells.growth_rate = cells.volumee\nscene = tf.Scene(tf.Rules(update), tf.Growth())\n"
    )
    (folder / "imports.py").write_text("import no_such_module\n")
    scene = tf.scenes.microcolony()
    for _ in tf.simulate(scene, scene.seed(), until=0.5, record=folder / "good.h5"):
        pass
    own = tf.Scene(tf.Growth(rate=1.0))
    for _ in tf.simulate(own, own.seed(), until=0.5, record=folder / "own.h5"):
        pass
    return folder


ERRORS = {
    "run unknown": ("nothing_like_it", "microcolony, programmed_growth, channel"),
    "run no_such_file.py": (r"no_such_file\.py", "No such file"),
    "run empty.py": (r"empty\.py", "scene"),
    "run number.py": (r"number\.py", "Scene"),
    "run syntax.py --until 1": (r"syntax\.py", "line 1"),
    "run imports.py --until 1": (r"imports\.py", "no_such_module"),
    "run rule.py --until 1": ("volumee", "volume"),
    "run raises.py --until 1": (r"Growth\.rate", "-1"),
    "run fixed.py --set rate=2": ("--set", r"fixed\.py"),
    "run mine.py --set speed=2": ("speed", r"rate|mine\.py"),
    "run microcolony --set speed=2": ("speed", "rate"),
    "run microcolony --set rate": ("--set", "NAME=VALUE"),
    "run microcolony --set rate=-1": (r"Growth\.rate", "-1"),
    "run microcolony --set rate=fast": (r"Growth\.rate", "fast"),
    "run microcolony --set dim=two": (r"dim", "two"),
    "run microcolony --set dim=4": (r"dim", "4"),
    "run microcolony --set shortest=5": ("Uniform", "low"),
    "run microcolony --set shortest=0.8": (r"Division\.length", r"0\.8"),
    "run microcolony --set rate=[1.0,2.0] --colonies 3": (r"Growth\.rate|rate", "2 values"),
    "run microcolony --colonies 0": ("colonies", "0"),
    "run microcolony --cells 0": ("cells", "0"),
    "run microcolony --until 0.33": ("until", r"0\.025"),
    "run microcolony --until -1": ("until", "-1"),
    "run microcolony --until 1 --dt 0": ("dt", "0"),
    "run microcolony --every 0": ("every", "0"),
    "run microcolony --seed -1": ("seed", "-1"),
    "run microcolony --device banana": ("device", "banana"),
    "run microcolony --start missing.csv": (r"missing\.csv", ""),
    "run microcolony --start missing.h5": (r"missing\.h5", ""),
    "run microcolony --start text.csv": (r"text\.csv, line 2, column 'y'", "zero"),
    "run microcolony --start negative.csv": (r"length\[0\]", "-2"),
    "run microcolony --start text.h5": (r"text\.h5", ""),
    "run microcolony --start foreign.h5": (r"foreign\.h5", "'y'"),
    "run microcolony --out good.h5": (r"good\.h5", "overwrite"),
    "run microcolony --out text.csv/a.h5 --until 1": (r"text\.csv", ""),
    "resume good.h5": ("--cells", "--until"),
    "resume good.h5 --until 0.1": ("until", r"0\.1"),
    "resume missing.h5 --until 1": (r"missing\.h5", "No such file"),
    "resume text.h5 --until 1": (r"text\.h5", "not a results file"),
    "resume foreign.h5 --until 1": (r"foreign\.h5", "not a torchfilm results file"),
    "resume own.h5 --until 1": (r"own\.h5", "--scene"),
    "resume own.h5 --until 1 --scene mine.py": (r"own\.h5|2-D", ""),
    "show missing.h5": (r"missing\.h5", "No such file"),
    "show text.h5": (r"text\.h5", "not a results file"),
    "show foreign.h5": (r"foreign\.h5", "not a torchfilm results file"),
    "show good.h5 --frame 99": ("frame", "99"),
    "show good.h5 --colour nonsense": ("colour", "nonsense"),
    "show good.h5 --colour position": ("colour", "position"),
    "show good.h5 --view up": ("view", "up"),
    "show good.h5 --view xz": ("view", "2-D"),
    "show good.h5 --out nowhere/a.png": ("nowhere", ""),
    "show good.h5 --out a.nonsense": ("nonsense", ""),
    "info unknown": ("unknown", "microcolony"),
    "info missing.h5": (r"missing\.h5", "No such file"),
    "info text.h5": (r"text\.h5", "not a results file"),
    "info no_such_file.py": (r"no_such_file\.py", "No such file"),
}


@pytest.mark.parametrize("line", list(ERRORS))
def test_errors_are_one_line_that_names_the_cause(command, tmp_path, spoilt, line):
    """No traceback: anything but SystemExit escaping from `main` would be one. And nothing new is left in the folder."""
    shutil.copytree(spoilt, tmp_path, dirs_exist_ok=True)
    before = {p: p.read_bytes() for p in tmp_path.iterdir()}
    with pytest.raises(SystemExit) as caught:
        command(*line.replace("run unknown", "run nothing_like_it").split())
    said = caught.value.code
    assert isinstance(said, str), f"left with {said!r} and no word"
    assert said.startswith("torchfilm: ") and "\n" not in said, said
    for word in ERRORS[line]:
        assert re.search(word, said), (word, said)
    after = {p: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()}
    assert {p for p in after if p not in before} == set(), "something was left lying about"
    assert all(after[p] == data for p, data in before.items()), "a file was changed"


@pytest.mark.parametrize("arguments", [["run"], ["run", "microcolony", "--colonies", "two"], ["fly"], []])
def test_words_that_cannot_be_parsed_are_refused(command, arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        command(*arguments)
    assert caught.value.code not in (0, None)


@pytest.mark.slow
def test_an_error_in_the_shell(tmp_path):
    """What the shell sees: status 1, one line on standard error, none on standard output."""
    done = shell("run", "microcolony", "--set", "rate=-1", folder=tmp_path)
    assert done.returncode == 1 and done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1 and done.stderr.startswith("torchfilm: Growth.rate")


def test_a_failed_solve_in_the_command_line(command):
    """The colonies that failed are named; the file holds what was there before."""
    Path("mine.py").write_text(
        "import torchfilm as tf\n"
        "cells = tf.Cells([[0.3 * k, 0.45 * (k % 3)] for k in range(8)], [[1.0, 0.1 * k] for k in range(8)])\n"
        "scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, max_iterations=1, tolerance=1e-6), founders=cells, dt=0.1)\n"
    )
    with pytest.raises(SystemExit) as caught:
        command("run", "mine.py", "--until", 1)
    assert "colony 0" in caught.value.code and "iteration limit" in caught.value.code
    with tf.Results("mine.h5") as results:
        assert results.steps.tolist() == [0]
