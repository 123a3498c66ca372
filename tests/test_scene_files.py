"""Scenes by what a user types: names, Python files and saved designs; what is none of them is
refused in words."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import torchfilm as tf
from torchfilm.cli.scene_files import design, load_scene, parse_setting

OWN = """
import torchfilm as tf

def lamp(rate=1.0, longest=4.0):
    division = tf.Division(length=tf.Uniform(3.0, longest))
    return tf.Scene(tf.Growth(rate=rate), division, tf.Mechanics(dim=2), dt=0.05)

def scene(rate=1.0):
    return lamp(rate)

ready = tf.scenes.microcolony(rate=0.5)
number = 3
"""

READY = {
    "scene": "microcolony",
    "parameters": {"rate": 0.5, "dim": 2},
    "seed": 3,
    "dt": 0.05,
    "cells": 4,
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "mine.py").write_text(OWN)
    return tmp_path


def saved(folder, told) -> str:
    path = folder / "best.json"
    path.write_text(told if isinstance(told, str) else json.dumps(told))
    return str(path)


def test_a_design_of_a_ready_scene_is_that_scene(folder):
    made = load_scene(saved(folder, READY), {})
    assert made.listing() == tf.scenes.microcolony(rate=0.5, dim=2).listing()
    assert made.recipe == tf.scenes.microcolony(rate=0.5, dim=2).recipe and made.dt == 0.05


def test_a_design_of_a_file_is_its_function(folder):
    made = load_scene(
        saved(
            folder,
            {
                "scene": "lamp",
                "file": str(folder / "mine.py"),
                "function": "lamp",
                "parameters": {"rate": 0.7, "longest": 3.5},
            },
        ),
        {},
        folder / "mine.py",
    )
    assert made.listing()[:2] == ["Growth(rate=0.7)", "Division(length=Uniform(low=3.0, high=3.5))"]
    assert (made.name, made.dt, made.settings) == (
        "mine",
        0.05,
        {"rate": 0.7, "longest": 3.5},
    ) and made.recipe is None


def test_settings_come_before_those_saved(folder):
    made = load_scene(saved(folder, READY), {"rate": 2.0})
    assert made.recipe[1]["rate"] == 2.0 and made.recipe[1]["dim"] == 2


def test_only_a_json_file_is_a_design(folder):
    assert design("microcolony") == {} and design("mine.py") == {}
    assert design(saved(folder, READY)) == READY


def test_a_design_of_one_colony_starts_as_the_ready_scene_does(folder):
    one, other = (
        load_scene(saved(folder, READY), {}).bind(2, seed=3).start(),
        tf.scenes.microcolony(rate=0.5).bind(2, seed=3).start(),
    )
    assert (
        one.position.tolist() == other.position.tolist()
        and one.division_threshold.tolist() == other.division_threshold.tolist()
    )


@pytest.mark.parametrize(
    "told, words",
    [
        ("", "cannot be read as JSON"),
        ('{"scene": "microcolony", "param', "cannot be read as JSON"),
        ("[1, 2]", "is no saved design: it must have a `scene` and its `parameters`"),
        ({"a": 1}, "is no saved design"),
        ({"scene": "microcolony"}, "is no saved design"),
        ({"parameters": {}}, "is no saved design"),
        ({"scene": "microcolony", "parameters": [1]}, "is no saved design"),
        ({"scene": 5, "parameters": {}}, "is no saved design"),
        ({**READY, "scene": "microcolonie"}, "scene = 'microcolonie'.*one of microcolony"),
        ({**READY, "scene": "none.py"}, "scene in .* = 'none.py'.*the name of a ready scene"),
        ({**READY, "file": "mine.py"}, "a function in 'mine.py'.*runs no code.*--code FILE.py"),
        ({**READY, "file": "../up.py"}, "a function in '../up.py'.*runs no code.*--code FILE.py"),
        ({**READY, "species": 5}, "species in .*best.json = 5.*a list of names"),
        ("[" * 100_000, "cannot be read as JSON"),
        (
            {**READY, "scene": "best.json"},
            "scene in .*best.json = 'best.json'.*the name of a ready scene",
        ),
        (
            {**READY, "parameters": {"rates": 1.0}},
            "microcolony has no parameter 'rates'. Did you mean rate",
        ),
        ({**READY, "parameters": {"rate": "fast"}}, "rate = 'fast'.*a number"),
        ({**READY, "dt": 0}, "dt in .*best.json = 0.*above 0"),
        ({**READY, "dt": "0.1"}, "dt in .*best.json = '0.1'.*a number"),
    ],
)
def test_a_bad_design_is_refused_in_words(folder, told, words):
    path = saved(folder, told)
    with pytest.raises(tf.InputError, match=words):
        load_scene(path, {})


OWN_DESIGN = {"scene": "lamp", "file": "mine.py", "function": "lamp", "parameters": {}}


@pytest.mark.parametrize(
    "told, words",
    [
        (
            {"scene": "<lambda>", "file": "mine.py", "function": "<lambda>", "parameters": {}},
            "mine.py does not define `<lambda>`",
        ),
        (
            {"scene": "lamp", "file": "mine.py", "function": "lamp", "parameters": {"speed": 1}},
            r"lamp\(…\) in mine.py: .*'speed'.*Its parameters are \(rate",
        ),
        (
            {"scene": "number", "file": "mine.py", "function": "number", "parameters": {}},
            "number in mine.py = 3.*a function that .*mine.py defines itself",
        ),
        ({**OWN_DESIGN, "function": "rmtree"}, "rmtree in mine.py = <function.*defines itself"),
        ({**OWN_DESIGN, "function": "Path"}, "Path in mine.py = <class.*defines itself"),
        ({**OWN_DESIGN, "function": None}, "mine.py does not define `None`"),
    ],
)
def test_a_bad_design_of_a_function_is_refused_in_words(folder, told, words):
    """Also one that names what the user's file has imported: nothing of it is called."""
    with open(folder / "mine.py", "a") as file:
        file.write("\nfrom shutil import rmtree\nfrom pathlib import Path\n")
    told = {**told, "parameters": {**told["parameters"]}}
    if told["function"] == "rmtree":
        (folder / "kept").mkdir()
        told["parameters"] = {"path": "kept"}
    with pytest.raises(tf.InputError, match=words):
        load_scene(saved(folder, told), {}, Path("mine.py"))
    assert told["function"] != "rmtree" or (folder / "kept").is_dir()


def test_code_is_asked_for_where_a_design_needs_it_alone(folder, command):
    path = saved(folder, {**OWN_DESIGN, "cells": 2})
    with pytest.raises(SystemExit, match=r"runs no code by itself.*--code FILE"):
        command("info", path)
    command("info", path, "--code", "mine.py")
    command("run", path, "--code", "mine.py", "--out", "own.h5", "--no-picture")
    command("resume", "own.h5", "--scene", path, "--code", "mine.py", "--cells", 3, "--no-picture")
    for what, code, words in (
        (OWN_DESIGN, "none.py", "--code = 'none.py'.*the path of a Python file"),
        (READY, "mine.py", "left out: .*best.json is of a ready scene"),
        ("microcolony", "mine.py", "it is for a saved design"),
    ):
        with pytest.raises(SystemExit, match=words):
            command("info", what if isinstance(what, str) else saved(folder, what), "--code", code)


@pytest.mark.parametrize(
    "what, words",
    [
        ("none.json", "the path of a saved design. No such file"),
        ("colony", "scene = 'colony'.*one of microcolony"),
        ("none.py", "No such file"),
        ("mine.txt", "No such file"),
        (".", "scene = '.'.*folder"),
        (
            "toggle.cellml",
            r"scene = 'toggle.cellml'.*\.py.*\.xml.*reads no \.cellml files.*Scene.*Circuit",
        ),
        ("toggle.xml", r"toggle\.xml, line \d: this is no valid SBML"),
        ("none.xml", "No such file.$"),
        ("run.h5", "No such file.*results file.*torchfilm resume"),
        ("cells.csv", "No such file.*table of cells.*--start"),
    ],
)
def test_what_is_no_scene_is_refused_in_words(folder, what, words):
    (folder / "toggle.xml").write_text("<sbml/>")
    (folder / "toggle.cellml").write_text("<model/>")
    with pytest.raises(tf.InputError, match=words):
        load_scene(what, {})


def test_bytes_that_are_no_text_are_no_design(folder):
    (folder / "best.json").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(tf.InputError, match="cannot be read as JSON"):
        load_scene(str(folder / "best.json"), {})


@pytest.mark.parametrize(
    "told, words",
    [
        ({"cells": "many"}, "cells in .*best.json = 'many'.*a whole number"),
        ({"cells": 4.5}, "cells in .*best.json = 4.5.*a whole number"),
        ({"cells": 0}, "cells = 0.*a whole number from 1"),
        ({"seed": "x"}, "seed in .*best.json = 'x'.*a whole number"),
        ({"seed": -1}, "seed = -1.*from 0"),
        ({"until": [1]}, r"until in .*best.json = \[1\].*a number"),
        ({"until": 0.33}, "until = 0.33.*an integer number of steps"),
    ],
)
def test_what_a_design_says_of_its_run_is_checked(folder, command, told, words):
    told = {**{n: v for n, v in READY.items() if n != "cells"}, **told}
    with pytest.raises(SystemExit, match=words):
        command("run", saved(folder, told), "--no-picture", "--out", "a.h5")


@pytest.mark.parametrize(
    "text, found",
    [
        ("dim=3", ("dim", 3)),
        ("rate=[0.5, 1]", ("rate", [0.5, 1])),
        ("law=length", ("law", "length")),
        ("name=", ("name", "")),
    ],
)
def test_settings_are_literals_or_text(text, found):
    assert parse_setting(text) == found


@pytest.mark.parametrize("text", ["rate", "3=rate", "=3", "a b=1"])
def test_settings_without_a_name_are_refused(text):
    with pytest.raises(tf.InputError, match=r"--set = .*NAME=VALUE"):
        parse_setting(text)


@pytest.mark.parametrize("future", ["", "from __future__ import annotations\n"])
def test_a_scene_file_may_define_dataclasses(tmp_path, future):
    """Found in use: the file took this module's way with annotations, and its own module was not to
    be found."""
    path = tmp_path / "own.py"
    path.write_text(
        f"{future}from dataclasses import dataclass\nimport torchfilm as tf\n\n@dataclass\nclass"
        " P:\n    rate: float = 0.7\n\nscene = tf.Scene(tf.Growth(rate=P().rate))\n"
    )
    assert load_scene(str(path), {}).effects[0].rate == 0.7


def test_an_error_in_a_scene_file_says_where(tmp_path):
    path = tmp_path / "own.py"
    path.write_text("import torchfilm as tf\n\nscene = tf.Scene(tf.Growth(rate=float([])))\n")
    with pytest.raises(
        tf.InputError, match=r"own\.py cannot be run: TypeError: .*float.* \(line 3\)"
    ):
        load_scene(str(path), {})


@pytest.mark.parametrize(
    "growth, words",
    [
        ("rates=1.0", "Growth has no parameter 'rates'. Did you mean rate"),
        ("rate=-1.0", r"Growth\.rate = -1"),
    ],
)
def test_bad_input_in_a_scene_file_says_where(tmp_path, growth, words):
    path = tmp_path / "own.py"
    path.write_text(f"import torchfilm as tf\n\nscene = tf.Scene(tf.Growth({growth}))\n")
    with pytest.raises(tf.InputError, match=rf"own\.py \(line 3\): {words}"):
        load_scene(str(path), {})


@pytest.mark.parametrize(
    ("value", "own"),
    [("0.25,0.5", "list(share)"), ("[0.25,0.5]", "share"), ("PerColony([0.25,0.5])", "share")],
)
def test_arithmetic_of_a_file_takes_one_number(folder, command, value, own):
    """Several values are one per colony. What the message says to write instead, works."""
    head = "import torchfilm as tf\ndef scene(rate=1.0, share=0.5):\n    "
    tail = ", dim=2, dt=0.1)\n"
    alone = "cells = tf.inoculum(int(8 * (1 - share)), radius=9.0)\n"
    made = "    return tf.Scene(tf.Growth(rate=rate), founders="
    (folder / "alone.py").write_text(head + alone + made + "cells" + tail)
    with pytest.raises(SystemExit) as caught:
        command("run", "alone.py", "--set", "rate=[1,2]", f"share={value}", "--until", 0.1)
    said = str(caught.value.code)
    fix = f"tf.Founders(function, share={own})"
    assert "alone.py: share = " in said and "one number" in said and "(line 3): unsuppo" in said
    assert "0.25, 0.5" in said and "one per colony" in said and f"founders={fix}" in said
    function = "def function(seed, share):\n        return tf.inoculum(int(8 * (1 - share)), 9.0)\n"
    (folder / "apart.py").write_text(head + function + made + fix + tail)
    command("run", "apart.py", "--set", "rate=[1,2]", f"share={value}", "--until", 0.1)
    with tf.Results("apart.h5") as results:
        assert results.counts[0].tolist() == [6, 4]


def test_other_errors_of_a_file_stay_as_they_are(folder):
    (folder / "mine.py").write_text("def scene(rate):\n    return len(3)\n")
    with pytest.raises(TypeError, match="object of type 'int' has no len"):
        load_scene("mine.py", {"rate": (1.0, 2.0)})


def test_a_scene_file_may_be_called_as_a_module_is(tmp_path):
    path = tmp_path / "math.py"
    path.write_text(
        "import torchfilm as tf\nfrom math import pi\n\nscene = tf.Scene(tf.Growth(rate=1.0))\n"
    )
    assert load_scene(str(path), {}).name == "math"
    import math

    assert math.pi > 3 and not hasattr(math, "scene")


def test_scene_files_do_not_come_upon_one_another(tmp_path):
    """What a file is called is no reason for another to import it: `common` is the one beside the
    file that asks for it. Nor does a broken one stay."""
    for folder, rate in (("a", 0.5), ("b", 1.5)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "common.py").write_text(
            f"import torchfilm as tf\nRATE = {rate}\nscene = tf.Scene(tf.Growth(rate=RATE))\n"
        )
    (tmp_path / "b" / "main.py").write_text(
        "import torchfilm as tf\nfrom common import RATE\nscene = tf.Scene(tf.Growth(rate=RATE))\n"
    )
    assert load_scene(str(tmp_path / "a" / "common.py"), {}).effects[0].rate == 0.5
    try:
        assert load_scene(str(tmp_path / "b" / "main.py"), {}).effects[0].rate == 1.5
    finally:
        sys.modules.pop("common", None)
    (tmp_path / "bad_one.py").write_text("x = 1 / 0\n")
    with pytest.raises(tf.InputError, match=r"ZeroDivisionError: division by zero \(line 1\)"):
        load_scene(str(tmp_path / "bad_one.py"), {})
    assert "bad_one" not in sys.modules


TOGGLE = """
model toggle
  species red, green
  red' = strength/(1 + green^2) - red
  green' = strength/(1 + red^2) - green
  red = 2; green = 1; strength = 4; unread = 1
end
"""


@pytest.mark.parametrize("suffix", [".xml", ".sbml", ".ant"])
def test_a_model_is_a_colony_with_its_circuit(folder, suffix):
    path = folder / f"toggle{suffix}"
    if suffix == ".ant":
        path.write_text(TOGGLE)
    else:
        tf.Circuit.from_antimony(TOGGLE).to_sbml(path)
    made = load_scene(str(path), {"strength": 8.0, "red": 0.5, "rtol": 1e-3})
    circuit = next(e for e in made.effects if isinstance(e, tf.Circuit))
    assert made.name == "toggle"
    assert [type(e).__name__ for e in made.effects] == [
        "Growth",
        "Division",
        "Mechanics",
        "Circuit",
    ]
    assert circuit.parameters == {"strength": 8.0} and circuit.rtol == 1e-3
    assert circuit.initial == {"red": 0.5, "green": 1.0}


@pytest.mark.parametrize(
    "given, words",
    [
        ({"strengt": 1.0}, "no constant 'strengt'.*'strength'"),
        ({"unread": 1.0}, "'unread' is no constant that an equation reads"),
        ({"signals": "red"}, "signals.*needs a medium"),
        ({"initial": {"red": 1.0}}, "--set NAME=VALUE"),
    ],
)
def test_parameters_that_a_model_does_not_have_are_refused(folder, given, words):
    (folder / "toggle.ant").write_text(TOGGLE)
    with pytest.raises(tf.InputError, match=words):
        load_scene("toggle.ant", given)


LACKING = "species A, B; A' = -k*A; B' = k*A - B; A = 2*k"


def test_what_a_model_lacks_is_given_on_the_command_line(folder):
    """No value is asked for that the settings give, and messages tell how to give one."""
    (folder / "lacking.ant").write_text(LACKING)
    made = load_scene("lacking.ant", {"k": 0.5, "B": 3.0})
    circuit = next(e for e in made.effects if isinstance(e, tf.Circuit))
    assert circuit.initial == {"A": 1.0, "B": 3.0} and circuit.parameters == {"k": 0.5}
    with pytest.raises(tf.InputError, match=r"^lacking\.ant: .*'k' has no value: give --set k=…"):
        load_scene("lacking.ant", {"B": 3.0})
    with pytest.raises(tf.InputError, match=r"'B' has no first value: give --set B=…"):
        load_scene("lacking.ant", {"k": 0.5})
    with pytest.raises(tf.InputError, match=r"'k', so it must be one number .* by --set NAME=…"):
        load_scene("lacking.ant", {"k": [0.5, 1.0], "B": 3.0})
    assert load_scene("lacking.ant", {"k": [0.5, 1.0], "A": 1.0, "B": 3.0}).name == "lacking"


def test_a_unit_of_time_is_given_on_the_command_line(folder):
    (folder / "unit.ant").write_text("unit time_unit = metre; species A; A' = -A; A = 1")
    with pytest.raises(tf.InputError, match=r"'metre' is no .*, as --set time_unit=s "):
        load_scene("unit.ant", {})
    assert load_scene("unit.ant", {"time_unit": "min"}).name == "unit"


def test_a_model_with_signals_needs_a_medium(folder):
    sensing = tf.Circuit.from_antimony(
        "compartment c = 1, o = 1; species s in o, A in c; A = 1; s = 0; J: A -> s; c*A",
        signals={"s": "ahl"},
    )
    sensing.to_sbml(folder / "sensing.xml")
    words = r"sensing\.xml has signals \('ahl'\).*from_sbml\('sensing\.xml'\) and tf\.Medium\(ahl="
    with pytest.raises(tf.InputError, match=words):
        load_scene("sensing.xml", {})
