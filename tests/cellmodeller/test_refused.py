"""What scripts may not do is refused by name and line."""

from __future__ import annotations

import sys
import warnings

import pytest
from cell_scripts import DIVIDE, GROWS, HEAD, INIT, SETUP, UPDATE, signalling, written

import torchfilm as tf
from torchfilm.cellmodeller import is_script

SLOW = "ignore:.*runs cell by cell:UserWarning"


def refused(folder, text: str) -> str:
    with pytest.raises(tf.InputError) as found:
        tf.from_cellmodeller(written(folder, text))
    return str(found.value)


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("import math", "import nowhere", "imports nowhere, which is not installed"),
        (
            "from CellModeller.GUI import Renderers",
            "from CellModeller.Signalling.NeighbourDiffusion import NeighbourDiffusion",
            "CellModeller.Signalling.NeighbourDiffusion is not supported",
        ),
        ("gamma=50", "alternate_divisions=True", "alternate_divisions=True) is not supported"),
        ("gamma=50", "speed=9", "CLBacterium(speed=…) is not supported; known are muA, gamma"),
        ("sim.addRenderer(", "sim.loadFromPickle(", "a pickle can execute code"),
        ("sim.addRenderer(", "sim.getOpenCL(", "sim.getOpenCL is not supported"),
        ("sim.addRenderer(", "print('x', file=1/0) or (", "ZeroDivisionError"),
        ("cell.growthRate = 1.0", "cell.name = 'x'", "cell.name = 'x' is not supported"),
        ("cell.plasmids = 6", "exit()", "ends the program"),
        ("d1.plasmids = sum(copies)", "d1.plasmids = d1.unknown", "has no 'unknown'"),
    ],
)  # fmt: skip
def test_by_name_and_line(tmp_path, old, new, words):
    text = GROWS.replace(old, new, 1)
    assert text != GROWS
    said = refused(tmp_path, text)
    assert words in said and said.startswith("model.py")
    assert f"line {line_of(text, new)}:" in said


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("pos=(-4, 0, 0)", "pos=(-4, 0)", "addCell(pos=…) = (-4, 0) is not allowed"),
        ("length=2.5", "length=None", "addCell(length=…) = None is not allowed"),
        ("cellType=0", "cellType=0.5", "a whole number from 0"),
        ("gamma=50", "gamma='a'", "CLBacterium(gamma=…) = 'a' is not allowed"),
        ("sim.addRenderer", "sim.dt = 0; sim.addRenderer", "sim.dt = 0 is not allowed"),
        (
            "sim.addRenderer",
            "body.addPlane((0, 0, 0), (0, 0, 0), 1.0); sim.addRenderer",
            "addPlane: normal = (0, 0, 0) is not allowed",
        ),
        ("cell.growthRate = 1.0", "cell.growthRate = -1.0", "cell.growthRate = -1: it must be"),
        ("cell.plasmids = 6", "cell.plasmids = 6; cell.x = [[1, 2], [3]]", "is not supported"),
        ("cell.color = [cell", "cell.color = [0.1]; [cell", "cell.color has 1 numbers and 3"),
    ],
)
def test_values_that_are_not_allowed(tmp_path, old, new, words):
    said = refused(tmp_path, GROWS.replace(old, new, 1))
    assert words in said and said.startswith("model.py")


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("gridSize=(4, 4, 4)", "gridSize=(4, 4)", "GridDiffusion: size = (4, 4) is not allowed"),
        ("D=[6.0]", "D=[6.0, 1.0]", "has 1 signals and 2 values of D"),
        ("'reflect'", "'odd'", "boundcond = 'odd' is not allowed"),
        ("sim, 1, 2, 1000", "sim, 1, 0, 1000", "nSpecies = 0 is not allowed"),
        ("return '''rates", "return 3; '''rates", "sigRateCL() returned int"),
        ("[4.0, 0]", "[4.0, 0, 3]", "could not broadcast"),
    ],
)
def test_chemistry_that_is_not_allowed(tmp_path, old, new, words):
    assert words in refused(tmp_path, signalling().replace(old, new, 1))


@pytest.mark.filterwarnings(SLOW)
@pytest.mark.parametrize("loop", ["columns", "cells"])
def test_a_growth_rate_below_0_ends_the_run(tmp_path, loop):
    text = GROWS.replace("fastest / max(1.0, cell.length - 2)", "8 * (2.9 - cell.length)")
    scene = tf.from_cellmodeller(written(tmp_path, text), loop=loop)
    with pytest.raises(tf.SimulationError, match=r"model\.py.*cell\.growthRate = -.*at least 0"):
        list(tf.simulate(scene, until=1.0))


def test_python_2(tmp_path):
    text = GROWS.replace("    random.shuffle(copies)", "    print 'shuffled'")
    assert f"line {line_of(text, 'print ')}: the script is written in Python 2" in refused(
        tmp_path, text
    )


def test_no_cell_and_no_init(tmp_path):
    assert "adds no cell" in refused(tmp_path, GROWS.replace("sim.addCell", "dict"))
    assert "does not call sim.init" in refused(
        tmp_path, GROWS.replace("sim.init", "id(0); [].append").replace("(body, ", "((body, ")
        .replace("None, None)", "None, None))").replace("sim.addCell", "dict")
    )  # fmt: skip


@pytest.mark.parametrize("where", ["body = CLB", "cell.plasmids = 6", "import math"])
def test_a_loop_for_ever_is_stopped(tmp_path, where):
    at = "" if where == "import math" else "\n    "
    text = GROWS.replace(where, f"while True: pass{at or chr(10)}{where}")
    path = written(tmp_path, text)
    line = line_of(text, "while True")
    words = rf"^model\.py, line {line}: .* was stopped here after 0\.2 s\. .*--set seconds=1\.2"
    with pytest.raises(tf.InputError, match=words):
        tf.from_cellmodeller(path, seconds=0.2)


def test_a_slow_script_may_take_longer(tmp_path):
    text = GROWS.replace("import math", "import math, time; time.sleep(0.3)")
    path = written(tmp_path, text)
    with pytest.raises(tf.InputError, match=r"line 2: loading was stopped here after 0\.1 s"):
        tf.from_cellmodeller(path, seconds=0.1)
    assert tf.from_cellmodeller(path, seconds=60.0).name == "model"
    with pytest.raises(tf.InputError, match="seconds = 0 is not allowed"):
        tf.from_cellmodeller(path, seconds=0)


def test_nothing_of_a_refused_script_stays(tmp_path):
    path, modules = list(sys.path), set(sys.modules)
    refused(tmp_path, GROWS.replace("gamma=50", "speed=9"))
    assert sys.path == path
    assert not {n for n in set(sys.modules) - modules if n.startswith(("CellModeller", "model"))}


def test_each_script_has_the_modules_of_its_folder(tmp_path):
    """Two folders, each with a file helper.py; it is found inside of a function in a run, too."""
    inner = "    from helper import FASTEST as fastest\n    fastest = float(fastest)"
    text = GROWS.replace("import math", "import math, helper").replace("    fastest = 1.2", inner)
    for name, rate in (("one", 1.5), ("other", 0.5)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "helper.py").write_text(f"FASTEST = {rate}\n")
        with pytest.warns(UserWarning, match="cell by cell"):
            scene = tf.from_cellmodeller(written(folder, text))
        assert "helper" not in sys.modules
        *_, end = tf.simulate(scene, until=0.05)
        assert set(end.growth_rate.tolist()) == {1.0, rate}


@pytest.mark.filterwarnings(SLOW)
def test_update_of_another_name(tmp_path):
    """The function is what counts, not the first text of its name."""
    text = GROWS + (
        "\ndef other(cells):\n    for (id, cell) in cells.items():\n        cell.plasmids = 8\n"
        "update = other\n"
    )
    *_, end = tf.simulate(tf.from_cellmodeller(written(tmp_path, text)), until=0.1)
    assert end.plasmids.tolist() == [8, 8]


@pytest.mark.filterwarnings(SLOW)
def test_a_late_variable_is_refused_with_its_line(tmp_path):
    text = GROWS.replace(
        "if cell.volume", "if cell.cellAge > 2: cell.late = 1\n        if cell.volume"
    )
    scene = tf.from_cellmodeller(written(tmp_path, text))
    with pytest.raises(tf.SimulationError, match=f"line {line_of(text, 'cell.late')}: cell.late"):
        list(tf.simulate(scene, until=0.5))


def test_what_is_a_script(tmp_path):
    assert is_script(written(tmp_path, GROWS))
    assert not is_script(written(tmp_path, GROWS.replace("def init", "def begin"), "b.py"))
    assert not is_script(tmp_path / "none.py")


# --- while it runs -------------------------------------------------------------------------------


@pytest.mark.filterwarnings(SLOW)
@pytest.mark.parametrize(
    "line, words",
    [
        ("if cell.cellAge > 5: cell.late = 1", "cell.late is set for the first time"),
        ("if cell.cellAge > 5: cell.plasmids = [1, 2]", "cell.plasmids was one number, and is"),
        ("if cell.cellAge > 5: cell.plasmids = None", "cell.plasmids = None is not supported"),
        ("if cell.cellAge > 5: 1 / 0", "ZeroDivisionError"),
        ("if cell.cellAge > 5: exit()", "ends the program"),
    ],
)
def test_faults_in_a_run_name_the_script(tmp_path, line, words):
    text = GROWS.replace("if cell.volume", f"{line}\n        if cell.volume")
    text = text.replace("targetVol = 3 +", "targetVol = 9 +")
    scene = tf.from_cellmodeller(written(tmp_path, text))
    with pytest.raises(tf.SimulationError) as found:
        list(tf.simulate(scene, until=1.0))
    assert words in str(found.value) and str(found.value).startswith("model.py")


@pytest.mark.filterwarnings(SLOW)
def test_global_variables_that_change(tmp_path):
    update = "count = 0\ndef update(cells):\n    global count\n    count += 1\n"
    scene = tf.from_cellmodeller(written(tmp_path, HEAD + SETUP + INIT + update + DIVIDE))
    with pytest.warns(UserWarning, match="changes the global variable count") as said:
        *_, state = tf.simulate(scene, until=0.2)
    assert state.cells == 2 and len(said) == 1
    with pytest.raises(tf.SimulationError, match="count, which all colonies share"):
        list(tf.simulate(scene, until=0.2, colonies=2))


@pytest.mark.filterwarnings(SLOW)
@pytest.mark.parametrize(
    "made, change, name",
    [
        ("class Box: pass\nbox = Box()\nbox.n = 5", "box.n += 1; here = box.n", "box.n"),
        ("class Box: n = 5", "Box.n += 1; here = Box.n", "Box.n"),
        ("", "memory.append(0); here = 5 + len(memory)", "update.__defaults__"),
    ],
)
def test_what_is_kept_in_objects_counts_as_global(tmp_path, made, change, name):
    """And is as at the start after the rehearsal."""
    update = f"{made}\ndef update(cells, memory=[]):\n    {change}\n"
    update += "    for cell in cells.values(): cell.plasmids = here\n"
    scene = tf.from_cellmodeller(written(tmp_path, HEAD + SETUP + INIT + update + DIVIDE))
    with pytest.warns(UserWarning, match=f"changes the global variable {name}"):
        *_, state = tf.simulate(scene, until=0.1)
    assert state.plasmids.tolist() == [7, 7]  # two steps
    with pytest.raises(tf.SimulationError, match=f"{name}, which all colonies share"):
        list(tf.simulate(scene, until=0.2, colonies=2))


def test_what_is_ignored_is_said(tmp_path):
    with pytest.warns(UserWarning, match=r"addCell\(color=…\): CellModeller ignores"):
        tf.from_cellmodeller(
            written(tmp_path, GROWS.replace("cellType=0,", "cellType=0, color=(1, 0, 0),"))
        )
    with pytest.warns(UserWarning, match=r"addCell\(cellAdh=…\): CellModeller ignores"):
        tf.from_cellmodeller(written(tmp_path, GROWS.replace("cellType=0,", "cellAdh=1,")))
    update = UPDATE + "        cell.radius = 2\n"
    with pytest.warns(UserWarning, match="cell by cell"):
        scene = tf.from_cellmodeller(written(tmp_path, HEAD + SETUP + INIT + update + DIVIDE))
    with pytest.warns(UserWarning, match=r"sets cell\.radius, which changes nothing"):
        *_, state = tf.simulate(scene, until=0.1)
    assert set(state.radius.tolist()) == {0.5}


# --- columns -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "line, words",
    [
        ("cell.spare = random.random()", "uses random.random"),
        ("for other in cells.values(): pass", "a statement that is not plain"),
        ("total = total + 1", "total passes from cell to cell"),
        ("cell.spare = len(cell.pos)", "calls len"),
        ("if cell.length > 0: late = 1\n        cell.spare = late", "late has no value"),
        ("cell.spare = math.exp(cell.length)", "calls math.exp"),
        ("cell.spare = cell.length ** 2", "the operation Pow"),
        ("cell.spare = max([cell.length, 2.0])", "max of a list"),
    ],
)
def test_loops_that_are_not_plain_run_cell_by_cell(tmp_path, line, words):
    text = GROWS.replace("fastest = 1.2", "fastest = 1.2\n    total = 0")
    text = text.replace("if cell.volume", f"{line}\n        if cell.volume")
    path = written(tmp_path, text)
    with pytest.raises(tf.InputError, match=f"line {line_of(text, line)}.*{words}|{words}"):
        tf.from_cellmodeller(path, loop="columns")
    with pytest.warns(UserWarning, match=words):
        assert tf.from_cellmodeller(path).bind().start().cells == 2


@pytest.mark.parametrize(
    "line",
    [
        "cell.targetVol = {0: 3.2, 1: 3.4}[cell.cellType] if cell.pos[0] > 0 else 3.3",
        "x = min(cell.length, 3.0); cell.growthRate = abs(x - 1.5) * math.sqrt(x)",
        "cell.plasmids = -cell.plasmids + 2 * cell.plasmids",
        "cell.divideFlag = not (cell.length < cell.targetVol or cell.id == 99) and True",
        "cell.growthRate = 0.5 / cell.cellType if cell.cellType > 0 else 1.5",
        "cell.growthRate = numpy.clip(cell.length / 3.0, 0.8, 1.1)",
        "rich = cell.length > 2.8 < 99\n        if rich: cell.growthRate = 0.5\n"
        "        elif cell.dir[1] > 0.5: cell.growthRate *= 0.99",
        "cell.targetVol = 11.3 / cell.length",
        "if cell.cellAge == 0 or 1.0 / cell.cellAge < 0.3: cell.targetVol = 3.3",
    ],
)
def test_columns_are_the_loop(tmp_path, line):
    text = GROWS.replace("if cell.volume", f"{line}\n        if cell.volume")
    ends = []
    for loop in ("columns", "cells"):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*cell by cell")
            scene = tf.from_cellmodeller(written(tmp_path, text), loop=loop)
        *_, end = tf.simulate(scene, until=2.0)
        ends.append(end)
    one, other = ends
    assert one.cells > 3
    for name in ("growth_rate", "targetVol", "color", "plasmids", "uid", "length"):
        assert getattr(one, name).tolist() == getattr(other, name).tolist(), name


@pytest.mark.filterwarnings(SLOW)
@pytest.mark.parametrize("loop", ["columns", "cells"])
def test_a_truth_value_may_become_a_number(tmp_path, loop):
    """It is one in the rehearsal, which takes one way through the branches."""
    line = (
        "if cell.cellAge == 0: cell.spare = False\n"
        "        elif cell.cellAge == 3: cell.spare = 3\n"
        "        elif cell.cellAge == 4: cell.plasmids = 10 * cell.spare"
    )
    text = GROWS.replace("if cell.volume", f"{line}\n        if cell.length < 0 and cell.volume")
    *_, end = tf.simulate(tf.from_cellmodeller(written(tmp_path, text), loop=loop), until=0.4)
    assert end.plasmids.tolist() == [30, 30]


# --- the text of rates ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "rates, words",
    [
        ("for (int i=0; i<2; i++) rates[i] = 0;", "'for' is not supported"),
        ("#define K 2", "'#define K 2' is not supported"),
        ("rates[2] = 0;", "'rates[2]' is not supported: it has 2, counted from 0"),
        ("rates[0] = k9;", "'k9' is not supported: this name is not declared"),
        ("rates[0] = lgamma(2.0f);", "'lgamma(…)' is not supported: known are exp"),
        ("rates[0] = pow(2.0f);", "it takes 2 values"),
        ("rates[0] = 1.0f", "'rates' is not supported: ';' is expected"),
        ("rates[0] = 1 @ 2;", "'@' is not supported"),
        ("float x[3];", "arrays cannot be declared"),
        ("species[0] = 1;", "'species[…] = …' is not supported"),
        ("if (species[0] > 1) { rates[0] = 1;", "'}' is expected"),
        ("rates[0] = cellType / 2;", "write floats"),
        ("y = 2;", "a variable declared before"),
    ],
)
def test_rates_by_line(tmp_path, rates, words):
    text = signalling().replace("rates[0] = 0;", rates)
    with pytest.raises(tf.InputError) as found:
        tf.from_cellmodeller(written(tmp_path, text)).bind()
    said = str(found.value)
    assert words in said
    after = "}" in words or ";" in words  # what is missing is noticed on a line below
    line = line_of(text, rates) + after
    assert said.startswith(f"model.py, line {line}: specRateCL(): ")


def test_rates_that_the_file_does_not_hold_are_named_by_their_own_line(tmp_path):
    together = 3 * "'" + " + 'wh' + 'ile (1) rates[1] = 0;' + " + 3 * "'"
    text = signalling().replace("rates[0] = 0;", together).replace(" % 2.0", "").replace("%g", "2")
    with pytest.raises(tf.InputError, match=r"^model\.py: specRateCL\(\), line 3 of its text: 'wh"):
        tf.from_cellmodeller(written(tmp_path, text))


def test_rates_that_stand_in_the_file_as_they_are_have_its_line(tmp_path):
    """Also where a line stands there twice."""
    whole = signalling().replace(" % 2.0", "").replace("%g", "2.0") + "# while (1)\n"
    text = whole.replace("rates[0] = 0;", "rates[0] = 0;\n    while (1)")
    said = refused(tmp_path, text)
    assert said.startswith(f"model.py, line {line_of(text, 'while (1)')}: specRateCL(): 'while'")


@pytest.mark.parametrize("name", ["specRateCL", "sigRateCL"])
def test_rates_without_a_text_are_refused(tmp_path, name):
    text = signalling().replace(f"def {name}():", f"def {name}():\n    return\n")
    assert f"{name}() returned NoneType" in refused(tmp_path, text)


def test_two_numbers_of_signals(tmp_path):
    said = refused(tmp_path, signalling().replace("sim, 1, 2, 1000", "sim, 3, 2, 1000"))
    assert "has 3 signals and GridDiffusion 1" in said
