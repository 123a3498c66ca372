"""The command line: run and resume, own scene files, edits taken up while running, and progress."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from commands import ENVIRONMENT, OWN, assert_same, drawn, frames, shell

import torchfilm as tf
from torchfilm.pictures import figures

# --- run ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_run_as_a_newcomer_types_it(tmp_path):
    done = shell("run", "microcolony", "--colonies", 3, "--cells", 6, "--seed", 1, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    with tf.Results(tmp_path / "microcolony.h5") as results:
        assert (
            results.counts.shape[1] == 3
            and (results.counts[-1] >= 6).all()
            and not (results.counts[-2] >= 6).all()
        )
        total = int(results.counts[-1].sum())
    assert drawn(tmp_path / "microcolony.png") > 0.02
    for part in (
        "microcolony.h5",
        "microcolony.png",
        f"{total} (",
        "colony radius",
        "overlap",
        "time for mechanics",
        "time for recording",
    ):
        assert part in done.stdout, part


@pytest.mark.slow
def test_a_run_whose_end_nobody_gave_ends_where_a_channel_is_full(tmp_path):
    done = shell("run", "channel", "--no-picture", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    said = done.stdout + done.stderr
    assert "no colony grows on to 500 cells. For another end give --cells" in said
    assert "may continue for ever" not in said
    with tf.Results(tmp_path / "channel.h5") as results:
        assert int(results.counts[-1].sum()) < 500


def test_the_command_is_installed():
    script = Path(sys.executable).with_name("torchfilm")
    assert script.exists()
    assert "torchfilm.cli.main" in script.read_text()


def test_run_with_settings(command):
    command(
        "run",
        "microcolony",
        "--set",
        "dim=3",
        "rate=0.5",
        "law=length",
        "--until",
        0.5,
        "--out",
        "a.h5",
        "--every",
        4,
        "--double",
    )
    with tf.Results("a.h5") as results:
        assert results.recipe == (
            "microcolony",
            {**results.recipe[1], "dim": 3, "rate": 0.5, "law": "length"},
        )
        assert results.attributes["dtype"] == "float64" and results.attributes["dim"] == 3
        assert results.steps.tolist() == [0, 4, 8, 12, 16, 20]
        # one free cell by the law of length
        assert float(results.frame()["length"][0]) == pytest.approx(2 * np.exp(0.25), rel=1e-9)


@pytest.mark.parametrize(
    "given",
    [
        "--set width=16 --set length=80",
        "--set=width=16 --every 2 --set=length=80",
        "--set width=16 length=80",
    ],
)
def test_options_given_again_add_to_what_was_given(command, given):
    """Found in use: of `--set a --set b` the parser kept the last alone, and said nothing."""
    command("run", "channel", *given.split(), "--until", 0, "--out", "a.h5", "--no-picture")
    with tf.Results("a.h5") as results:
        assert results.recipe[1]["width"] == 16 and results.recipe[1]["length"] == 80


def test_a_setting_for_each_colony(command):
    command(
        "run",
        "microcolony",
        "--set",
        "rate=[0.5, 1.0]",
        "--colonies",
        2,
        "--until",
        0.5,
        "--out",
        "a.h5",
        "--no-picture",
    )
    with tf.Results("a.h5") as results:
        assert results.frame()["growth_rate"].tolist() == [0.5, 1.0]
    assert not list(Path().glob("*.png"))


def test_the_same_as_the_library(command):
    command("run", "microcolony", "--colonies", 2, "--until", 3, "--seed", 5, "--out", "a.h5")
    scene = tf.scenes.microcolony()
    state = list(tf.simulate(scene, scene.bind(2, seed=5).start(), until=3.0))[-1]
    found = frames("a.h5")
    assert np.array_equal(found["position"], state.position.numpy()) and np.array_equal(
        found["uid"], state.uid.numpy()
    )


def test_a_scene_file_of_ones_own(command):
    Path("mine.py").write_text(OWN)
    command("run", "mine.py", "--set", "rate=0.5", "--until", 0.5)
    with tf.Results("mine.h5") as results:
        assert results.steps[-1] == 10 and results.frame()["growth_rate"].tolist() == [0.5]
        assert results.recipe is None and results.attributes["scene"].startswith("mine:")


def test_the_picture_of_a_model_shows_its_first_species(command, monkeypatch):
    Path("decay.ant").write_text("species A, B; A' = -A; B' = A; A = 1; B = 0")
    drawn = []
    plan = figures.plan_layout

    def watched(*arguments):
        made = plan(*arguments)
        drawn.append(made.scales[0].name)
        return made

    monkeypatch.setattr(figures, "plan_layout", watched)
    command("run", "decay.ant", "--until", 0.3)
    command("resume", "decay.h5", "--scene", "decay.ant", "--until", 0.5)
    command("run", "microcolony", "--until", 0.3)
    assert drawn == ["A", "A", "angle"]


def test_a_scene_file_may_hold_the_scene_itself_and_import_its_neighbours(command):
    Path("parts.py").write_text("RATE = 0.25\n")
    Path("mine.py").write_text(
        "import torchfilm as tf\nfrom parts import RATE\nscene = tf.Scene(tf.Growth(rate=RATE),"
        " dt=0.1)\n"
    )
    command("run", "mine.py", "--until", 0.5)
    assert frames("mine.h5")["growth_rate"].tolist() == [0.25]


def test_rules_beside_the_scene_file_are_found_from_anywhere(command, tmp_path):
    """`Rules("rules.py")` in a scene file means the file beside it, wherever the command is
    typed."""
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "rules.py").write_text(
        "def update(cells):\n    cells.growth_rate = 0.5\n"
    )
    (tmp_path / "model" / "mine.py").write_text(
        'import torchfilm as tf\nscene = tf.Scene(tf.Rules("rules.py"), tf.Growth(), dt=0.1)\n'
    )
    command("run", "model/mine.py", "--until", 0.5, "--out", "a.h5")
    assert frames("a.h5")["growth_rate"].tolist() == [0.5]


@pytest.mark.parametrize(
    "header, options",
    [
        ("x_um,y_um,angle_deg,length_um", ()),
        ("x,y,angle,length", ("--length-unit", "um", "--angle-unit", "degrees")),
        ("x,y,angle_deg,length", ("--pixel-size", 1.0)),
    ],
)
def test_the_units_of_a_table_are_options(command, header, options):
    Path("cells.csv").write_text(f"{header}\n0,0,90,2\n")
    run = ("run", "microcolony", "--until", 0.05, "--out", "a.h5", "--no-picture")
    command(*run, "--start", "cells.csv", *options)
    with tf.Results("a.h5") as results:
        first = results.frame(0)
    assert first["length"].tolist() == [2.0]
    assert first["axis"][0].tolist() == pytest.approx([0.0, 1.0], abs=1e-6)


@pytest.mark.parametrize("kind", ["csv", "h5"])
def test_start_from_a_file_of_cells(command, capsys, kind):
    columns = {
        "x_um": [0.0, 0.0],
        "y_um": [0.0, 0.8],
        "angle_rad": [0.0, 0.0],
        "length_um": [2.0, 2.2],
    }
    if kind == "csv":
        Path("cells.csv").write_text("x_um,y_um,angle_rad,length_um\n0,0,0,2\n0,0.8,0,2.2\n")
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


# --- resume ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [[], ["--dt", 0.05], ["--double", "--set", "rate=0.8", "shortest=3.0"]],
    ids=["plain", "own step", "own scene"],
)
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
    """Settings of a scene file are not data of the file's cells only: a resumed run must not fall
    back to the defaults."""
    Path("mine.py").write_text(OWN)
    command("run", "mine.py", "--set", "longest=3.2", "--until", 4, "--out", "whole.h5")
    command("run", "mine.py", "--set", "longest=3.2", "--until", 1, "--out", "parts.h5")
    command("resume", "parts.h5", "--scene", "mine.py", "--until", 4)
    assert_same(frames("whole.h5"), frames("parts.h5"))


def test_resume_a_run_from_given_cells(command):
    Path("cells.csv").write_text("x_um,y_um,angle_rad,length_um,gfp\n0,0,0,2,1\n0,1.2,0,2.2,2\n")
    for name, until in (("whole.h5", 3), ("parts.h5", 1)):
        command("run", "microcolony", "--start", "cells.csv", "--until", until, "--out", name)
    command("resume", "parts.h5", "--until", 3)
    assert_same(frames("whole.h5"), frames("parts.h5"))


def test_resume_of_a_run_that_is_at_its_end_is_no_error(command):
    command("run", "microcolony", "--until", 0.5, "--out", "a.h5", "--no-picture")
    before = frames("a.h5")
    command("resume", "a.h5", "--until", 0.5, "--no-picture")
    assert_same(before, frames("a.h5"))


def test_resume_to_fewer_cells_than_there_are_says_so(command, capsys):
    command("run", "microcolony", "--cells", 4, "--out", "a.h5", "--no-picture")
    inode = Path("a.h5").stat().st_ino
    for end, why in (
        (("--cells", 3), "every colony has 4 cells or more already"),
        (("--until", 0.1), "the run is at 1."),
    ):
        command("resume", "a.h5", *end, "--no-picture")
        said = capsys.readouterr().out
        assert f"note: {why}" in said and "nothing to do" in said
    assert Path("a.h5").stat().st_ino == inode  # not written again


def test_as_many_colonies_as_a_parameter_has_values(command):
    command("run", "boundary_detector", "--set", "k1=1,2,3", "--until", 0.1, "--no-picture")
    with tf.Results("boundary_detector.h5") as results:
        assert results.counts.shape[1] == 3


def wait_for(path: Path) -> bool:
    """Whether the file comes into being within 100 s; returns as soon as it does."""
    for _ in range(5000):
        time.sleep(0.02)
        if path.exists():
            return True
    return False


def started(folder: Path, results: str, *arguments: str) -> subprocess.Popen:
    """The command in a process of its own, from when its results file is there."""
    child = subprocess.Popen(
        [sys.executable, "-m", "torchfilm.cli.main", "run", *arguments],
        cwd=folder,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    if wait_for(folder / results):
        return child
    child.kill()
    raise AssertionError(f"no {results}: {child.communicate()}")


@pytest.mark.slow
@pytest.mark.parametrize(("number", "attempt"), [("SIGINT", 0), ("SIGINT", 1), ("SIGTERM", 2)])
def test_interrupted(tmp_path, number, attempt):
    """Ctrl-C or a scheduler's SIGTERM at whatever moment: it stops, with a word instead of a
    traceback, leaves a whole file, and resume goes on.

    Several times, because an interrupt that falls into a callback of the interpreter is easily
    swallowed there.
    """
    command = "microcolony --colonies 2 --until 11 --every 1"
    child = started(tmp_path, "microcolony.h5", *command.split())
    time.sleep(0.3 + 0.1 * attempt)
    child.send_signal(signal.Signals[number])
    _, errors = child.communicate(timeout=600)
    assert child.returncode == 128 + signal.Signals[number], errors[-300:]
    assert "Traceback" not in errors and "resume" in errors, errors
    with tf.Results(tmp_path / "microcolony.h5") as results:
        last = int(results.steps[-1])
        assert results.steps.tolist() == list(range(last + 1))
    done = shell(
        "resume", "microcolony.h5", "--until", (last + 4) * 0.025, "--no-picture", folder=tmp_path
    )
    assert done.returncode == 0, done.stderr
    with tf.Results(tmp_path / "microcolony.h5") as results:
        assert results.steps[-1] == last + 4


# --- watch and progress ---------------------------------------------------------------------------


RULES = """
import time
from pathlib import Path

def update(cells):
    cells.growth_rate = 0.25
    if cells.time > 0.0:
        Path("ran").touch()
        time.sleep(0.02)
"""

BROKEN_RULES = """
from pathlib import Path

Path("read").touch()
raise RuntimeError("half done")
"""


@pytest.mark.slow
def test_watch_takes_up_an_edit_while_running(tmp_path):
    (tmp_path / "rules.py").write_text(RULES)
    (tmp_path / "mine.py").write_text(
        'import torchfilm as tf\nscene = tf.Scene(tf.Rules("rules.py"), tf.Growth(), dt=0.01)\n'
    )
    child = started(
        tmp_path, "mine.h5", "mine.py", "--until", "10", "--watch", "--every", "1", "--no-picture"
    )
    assert wait_for(tmp_path / "ran")
    (tmp_path / "rules.py").write_text(BROKEN_RULES)
    assert wait_for(tmp_path / "read")
    (tmp_path / "rules.py").write_text("def update(cells):\n    cells.growth_rate = 0.5\n")
    out, errors = child.communicate(timeout=600)
    assert child.returncode == 0, errors
    said = out + errors
    assert said.index("rules.py is broken") < said.index("rules.py reloaded")
    times = [float(t) for t in re.findall(r"t = (\S+) h: rules\.py", said)]
    assert len(times) == 2 and 0 < times[0] < times[1] < 10, "the simulated time of each edit"
    with tf.Results(tmp_path / "mine.h5") as results:
        rates = [float(results.frame(k)["growth_rate"][0]) for k in range(1, len(results))]
        assert results.steps[-1] == 1000
    assert rates == sorted(rates) and set(rates) == {0.25, 0.5}


@pytest.mark.slow
@pytest.mark.parametrize("end", [["--cells", "40"], ["--until", "4"]], ids=["cells", "until"])
def test_progress_shows_cells_time_rate_and_the_estimated_end(tmp_path, end):
    """On a terminal; a pseudo-terminal plays its part."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 160, 0, 0))
    child = subprocess.Popen(
        [sys.executable, "-m", "torchfilm.cli.main", "run", "microcolony", *end, "--no-picture"],
        cwd=tmp_path,
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=follower,
    )
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
    assert child.wait(timeout=600) == 0
    text = seen.decode()
    assert re.search(r"\d+ cells, t = \d+\.\d\d h, \d+ steps/s", text), text[-500:]
    assert re.search(r"\d\d:\d\d<\d\d:\d\d", text), "no estimated end"
    assert "100%" in text


@pytest.mark.parametrize(
    "cores, given, colonies, threads",
    [(5, None, 3, 3), (2, None, 3, 2), (1, None, 3, 1), (2, 3, 1, 3)],
)
def test_a_command_takes_a_thread_for_each_core_and_no_more_than_colonies(
    command, monkeypatch, capsys, cores, given, colonies, threads
):
    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    options = [] if given is None else ["--threads", given]
    end = ["--until", 0.05, "--no-picture"]
    command("run", "microcolony", "--colonies", colonies, *end, *options)
    assert torch.get_num_threads() == threads
    assert f" s on {threads} thread{'s' if threads > 1 else ''}\n" in capsys.readouterr().out
    torch.set_num_threads(4)
    command("resume", "microcolony.h5", "--until", 0.1, "--no-picture", *options)
    assert torch.get_num_threads() == threads
    torch.set_num_threads(4)
    scene = ["microcolony", "--colonies", colonies, "--cells", 8, "--seconds", 0.05]
    command("explain", *scene, *options)
    assert f" {threads} thread(s) of this machine" in capsys.readouterr().out


def test_a_command_takes_the_number_of_threads_of_the_environment(command, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(5)), raising=False)
    command("run", "microcolony", "--colonies", 3, "--until", 0.05, "--no-picture")
    assert torch.get_num_threads() == 1  # as torch read it from there
    with pytest.raises(SystemExit, match="--threads = 0 is not allowed"):
        command("run", "microcolony", "--until", 0.05, "--overwrite", "--threads", 0)


LIBRARY = """
import torch
torch.set_num_threads(3)
import torchfilm as tf
import design
scene = tf.scenes.toggle_switch()
for state in tf.simulate(scene, until=0.05, colonies=2):
    pass
tf.explain(scene, cells=4, seconds=0.05)
search = design.Search(
    tf.scenes.boundary_detector,
    parameters=[design.Parameter("k3", 0.1, 100, log=True)],
    target=design.Stripe("yfp", at="border", width=4.0, cell_type=1, floor=0.2),
    fixed={"k1": 50.0, "D1": 50.0, "width": 16.0},
    cells=4, dt=0.05, replicates=1, seed=0,
)
search.run(colonies=4)
assert torch.get_num_threads() == 3, torch.get_num_threads()
"""


@pytest.mark.slow
def test_the_library_leaves_the_number_of_threads_as_it_is():
    """It is the user's: on import, in a run, an estimate and a search."""
    done = subprocess.run(
        [sys.executable, "-c", LIBRARY], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
