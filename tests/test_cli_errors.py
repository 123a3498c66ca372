"""The command line's errors: one line that names the cause, and nothing left lying about."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import h5py
import pytest
from commands import OWN, frames, shell

import torchfilm as tf
from torchfilm.cli.scene_files import parse_settings

# --- errors ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory) -> Path:
    """A folder with files of every unwelcome kind, and one good results file."""
    folder = tmp_path_factory.mktemp("spoilt")
    (folder / "text.h5").write_text("no numbers here\n" * 100)
    (folder / "text.csv").write_text("x_um,y_um,angle_rad,length_um\n0,zero,0,2\n")
    (folder / "header.csv").write_text("x_um,y_um,angle_rad,length_um\n")
    (folder / "semicolons.csv").write_text("x_um;y_um;angle_rad;length_um\n0;0;0;2\n")
    (folder / "plain.csv").write_text("x,y,angle,length\n0,0,0,2\n")
    (folder / "nothing.csv").write_text("")
    (folder / "negative.csv").write_text("x_um,y_um,angle_rad,length_um\n0,0,0,-2\n")
    with h5py.File(folder / "foreign.h5", "w") as file:
        file["x_um"] = [1.0]
    (folder / "mine.py").write_text(OWN)
    (folder / "fixed.py").write_text(
        "import torchfilm as tf\nscene = tf.Scene(tf.Growth(rate=1.0))\n"
    )
    (folder / "empty.py").write_text("")
    (folder / "number.py").write_text("scene = 3\n")
    (folder / "syntax.py").write_text("scene = = 3\n")
    (folder / "raises.py").write_text(
        "import torchfilm as tf\nscene = tf.Scene(tf.Growth(rate=-1.0))\n"
    )
    (folder / "rule.py").write_text(
        "import torchfilm as tf\ndef update(cells):\n    cells.growth_rate = cells.volumee\nscene ="
        " tf.Scene(tf.Rules(update), tf.Growth())\n"
    )
    (folder / "toggle.xml").write_text("<sbml/>\n")
    (folder / "toggle.cellml").write_text("<model/>\n")
    (folder / "imports.py").write_text("import no_such_module\n")
    scene = tf.scenes.microcolony()
    for _ in tf.simulate(scene, scene.bind().start(), until=0.5, record=folder / "good.h5"):
        pass
    own = tf.Scene(tf.Growth(rate=1.0))
    for _ in tf.simulate(own, own.bind().start(), until=0.5, record=folder / "own.h5"):
        pass
    return folder


ERRORS = {
    "run unknown": ("nothing_like_it", "microcolony, programmed_growth, channel"),
    "run no_such_file.py": (r"no_such_file\.py", "No such file"),
    "run toggle.xml --until 1": (r"toggle\.xml", r"line \d: this is no valid SBML"),
    "run toggle.cellml --until 1": (r"toggle\.cellml", r"reads no \.cellml files", "Circuit"),
    "run good.h5 --until 1": (r"good\.h5", "results file", "torchfilm resume"),
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
    "run microcolony --start text.csv": (r"text\.csv, line 2, column 'y_um'", "zero"),
    "run microcolony --start header.csv": (r"header\.csv", "no cell"),
    "run microcolony --start semicolons.csv": (r"semicolons\.csv, line 1", "commas"),
    "run microcolony --start nothing.csv": (r"nothing\.csv", "empty"),
    "run microcolony --start negative.csv": (r"length\[0\]", "-2"),
    "run microcolony --start plain.csv": (
        "'x' has no unit",
        "Give --pixel-size .* or --length-unit um, or call the column",
    ),
    "run microcolony --start plain.csv --length-unit um": (
        "'angle' has no unit",
        "Give --angle-unit degrees or radians, or call the column",
    ),
    "run microcolony --angle-unit degrees": ("--angle-unit = 'degrees'", "without --start"),
    "run microcolony --start text.h5": (r"text\.h5", ""),
    "run microcolony --start foreign.h5": (r"foreign\.h5", "'y'"),
    "run microcolony --out good.h5": (r"--out = 'good\.h5'", r"--overwrite.*resume good\.h5"),
    "run microcolony --out text.csv/a.h5 --until 1": (r"text\.csv", ""),
    "resume good.h5": ("--cells", "--until"),
    "resume good.h5 --until -1": ("until", r"-1"),
    "info missing.h5": (r"missing\.h5", "No such file"),
    "info microcolony --set rtol=1": ("rtol", "It has: dim", "accuracy setting"),
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
    "show .": ("folder",),
    "show good.h5 --out nameless": ("nameless", r"ends in \.png"),
    "info unknown": ("unknown", "microcolony"),
    "info text.h5": (r"text\.h5", "not a results file"),
    "info no_such_file.py": (r"no_such_file\.py", "No such file"),
}


@pytest.mark.parametrize("line", list(ERRORS))
def test_errors_are_one_line_that_names_the_cause(command, tmp_path, spoilt, line):
    """No traceback: anything but SystemExit escaping from `main` would be one. And nothing new is
    left in the folder."""
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


@pytest.mark.parametrize(
    "arguments",
    [
        ["run"], ["run", "microcolony", "--colonies", "two"], ["fly"], [],
        ["run", "microcolony", "--until"], ["run", "microcolony", "--unitl", "3"],
    ],
)  # fmt: skip
def test_words_that_cannot_be_parsed_are_refused(command, arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        command(*arguments)
    assert caught.value.code == 2


OPTIONS = {
    "run microcolony --cell 50": (
        "run has no parameter '--cell'",
        "Did you mean --cells?",
        "It has",
    ),
    "show good.h5 --color=length": ("show has no parameter '--color'", "Did you mean --colour?"),
    "run microcolony --until 1 --until 2": ("the option --until is given twice",),
}


@pytest.mark.parametrize("line", list(OPTIONS))
def test_options_that_cannot_be_read_are_named_in_one_line(command, tmp_path, line, capsys):
    """The exit code is that of all lines that cannot be read. And no file is made."""
    with pytest.raises(SystemExit) as caught:
        command(*line.split())
    out, said = capsys.readouterr()
    assert caught.value.code == 2 and out == "" and not list(tmp_path.iterdir())
    assert said.startswith("torchfilm: ") and said.count("\n") == 1 and said.endswith("\n")
    for word in OPTIONS[line]:
        assert re.search(word, said), (word, said)


@pytest.mark.slow
def test_an_error_in_the_shell(tmp_path):
    """What the shell sees: status 1, one line on standard error, none on standard output."""
    done = shell("run", "microcolony", "--set", "rate=-1", folder=tmp_path)
    assert done.returncode == 1 and done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1 and done.stderr.startswith(
        "torchfilm: Growth.rate"
    )


def test_a_failed_solve_in_the_command_line(command):
    """The colonies that failed are named; the file holds what was there before."""
    Path("mine.py").write_text(
        "import torchfilm as tf\ncells = tf.Cells([[0.3 * k, 0.45 * (k % 3)] for k in range(8)],"
        " [[1.0, 0.1 * k] for k in range(8)])\nscene = tf.Scene(tf.Growth(rate=1.0),"
        " tf.Mechanics(dim=2, max_iterations=1, tolerance=1e-6), founders=cells, dt=0.1)\n"
    )
    with pytest.raises(SystemExit) as caught:
        command("run", "mine.py", "--until", 1)
    assert "colony 0" in caught.value.code and "iteration limit" in caught.value.code
    with tf.Results("mine.h5") as results:
        assert results.steps.tolist() == [0]


def test_resume_with_an_edited_scene_says_which_fields_differ(command):
    """Not that it is another scene, which the user knows better."""
    rules = (
        "import torchfilm as tf\nscene = tf.Scene(tf.Rules(lambda cells: None, variables={}),"
        " tf.Growth(rate=1.0), dt=0.05)\n"
    )
    for name, variables in (
        ("mine.py", "{'age': 0.0, 'energy': 1.0}"),
        ("more.py", "{'age': 0.0, 'mass': 1.0, 'energie': 1.0}"),
    ):
        Path(name).write_text(rules.replace("{}", variables))
    command("run", "mine.py", "--until", 1)
    before = frames("mine.h5")
    with pytest.raises(SystemExit) as caught:
        command("resume", "mine.h5", "--scene", "more.py", "--until", 2)
    said = caught.value.code
    assert re.search(r"mine\.h5.*lacks 'mass', 'energie'; not in this scene: 'energy'", said), said
    assert "age" not in said and "another scene" not in said and "\n" not in said
    assert frames("mine.h5")["steps"] == before["steps"]
    command("resume", "mine.h5", "--scene", "mine.py", "--until", 2)


def test_resume_with_a_field_of_another_shape_is_reported(command):
    rules = (
        "import torchfilm as tf\ndef update(cells):\n    cells.mark = cells.{}\nscene ="
        " tf.Scene(tf.Rules(update), tf.Growth(rate=1.0), dt=0.05)\n"
    )
    Path("mine.py").write_text(rules.format("length * 2"))
    command("run", "mine.py", "--until", 1)
    Path("mine.py").write_text(rules.format("position * 2"))
    with pytest.raises(SystemExit, match=r"of another shape there: 'mark'"):
        command("resume", "mine.h5", "--scene", "mine.py", "--until", 2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--set", "rate=1", "rate=2"), r"--set = 'rate=2'.*the only value of 'rate'"),
        (("--set", "rate=1", "--set", "rate=2"), r"--set = 'rate=2'.*the only value of 'rate'"),
    ],
)
def test_what_is_given_twice_is_refused(command, arguments, said):
    with pytest.raises(SystemExit, match=said):
        command("run", "microcolony", *arguments)


@pytest.mark.parametrize(("text", "value"), [("false", False), ("TRUE", True), ("False", False)])
def test_conditions_may_be_written_in_any_case(text, value):
    assert parse_settings([f"open_ended={text}"]) == {"open_ended": value}


# --- notes on the cells to start from -------------------------------------------------------------

CELLS = "x_um,y_um,angle_rad,length_um,colony\n0,0,0,2,0\n5,0,0,2,0\n0,0,0,2,2\n"


@pytest.mark.parametrize(
    ("colonies", "empty"),
    [
        ([], ["colony 1 of 3 stays empty"]),
        (["--colonies", 5], ["colony 1 of 3 stays empty", "colonies 1, 3, 4 of 5 stay empty"]),
    ],
    ids=["gaps", "more than the file has"],
)
def test_colonies_without_a_cell_in_the_file_are_warned_of(command, colonies, empty):
    Path("cells.csv").write_text(CELLS)
    with pytest.warns(UserWarning, match="empty") as found:
        command("run", "microcolony", "--start", "cells.csv", "--cells", 4, *colonies)
    said = dict.fromkeys(str(w.message).partition(":")[0] for w in found)
    assert list(said) == empty
    with tf.Results("microcolony.h5") as results:
        assert [int(n) > 0 for n in results.counts[-1]] == [True, False, True, False, False][
            : results.counts.shape[1]
        ]


def test_fewer_colonies_than_the_file_has_are_refused(command):
    Path("cells.csv").write_text(CELLS + "9,0,0,2,1\n")
    with pytest.raises(SystemExit, match=r"colonies = 2.*at least 3.*colony 2"):
        command("run", "microcolony", "--start", "cells.csv", "--colonies", 2)


def test_a_file_whose_every_colony_has_cells_needs_no_note(command, capsys):
    Path("cells.csv").write_text(CELLS.replace(",2\n", ",1\n"))
    command("run", "microcolony", "--start", "cells.csv", "--until", 0.5)
    Path("copies.csv").write_text("x_um,y_um,angle_rad,length_um\n0,0,0,2\n")
    command(
        "run",
        "microcolony",
        "--start",
        "copies.csv",
        "--colonies",
        3,
        "--until",
        0.5,
        "--out",
        "copies.h5",
    )
    assert "note" not in capsys.readouterr().out


def test_columns_that_no_effect_uses_are_noted(command, capsys):
    Path("cells.csv").write_text("x_um,y_um,angle_rad,length_um,gfp,size\n0,0,0,2,0.5,3\n")
    command("run", "microcolony", "--start", "cells.csv", "--until", 0.5)
    assert (
        "note: cells.csv: gfp, size are recorded as quantities per cell, which no effect uses."
        " Delete the columns that you do not need." in capsys.readouterr().out.splitlines()
    )


def test_a_warning_in_the_shell_is_one_line_without_code(tmp_path):
    (tmp_path / "cells.csv").write_text("x_um,y_um,angle_rad,length_um\n0,0,45,2\n")
    arguments = ("run", "microcolony", "--start", "cells.csv", "--until", 0.5, "--no-picture")
    done = shell(*arguments, folder=tmp_path)
    lines = [line for line in done.stderr.splitlines() if "warning" in line.lower()]
    assert done.returncode == 0 and len(lines) == 1, done.stderr
    assert lines[0].startswith("warning: cells.csv: the column 'angle_rad' reaches 45")
    assert "warnings.warn" not in done.stderr
