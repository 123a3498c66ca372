"""A colony's bits under a user's rules and effects: whatever the colonies beside it, and whether
the file of a rule is run or imported."""

from __future__ import annotations

import runpy
import types
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch

import torchfilm as tf
from torchfilm.cli.scene_files import load_scene
from torchfilm.effects.bound_rules import label_of
from torchfilm.tools.hashing import module_of

WRITTEN = {
    "a power": lambda x: 1.5 / (1 + (x / 4) ** 1.7),
    "sigmoid": lambda x: 2 * torch.sigmoid(3 - x),
    "a sum of columns": lambda x: torch.stack([x, -x, x * x, 3 - x, 0.1 * x], 1).sum(1).abs() / 5,
}


@dataclass(frozen=True, eq=False)
class Slows(tf.Effect):
    """A user's effect that sets growth rates."""

    law: Callable

    title = "slows"
    stage = 15

    def reads(self):
        return ["length"]

    def writes(self):
        return ["growth_rate"]

    def step(self, state, dt, values):
        return state.with_fields(growth_rate=self.law(state.length))


def of(state: tf.State, name: str) -> torch.Tensor:
    return state.fields[name] if name in state.fields else getattr(state, name)


@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.parametrize("by", ["a rule", "an effect"])
def test_a_colony_alone_has_the_same_bits(name, by):
    law = WRITTEN[name]

    def rule(cells):
        cells.growth_rate = law(cells.length)

    effect = tf.Rules(rule) if by == "a rule" else Slows(law)
    scene = tf.Scene(effect, tf.Growth(), tf.Division(length=tf.Uniform(3.0, 4.0)), dim=2, dt=0.05)
    first = scene.bind(colonies=5, seed=1, dtype=torch.float32).start()
    ends = []
    for start in (first, first.select([3]), first.select([3, 0])):
        *_, last = tf.simulate(scene, start, until=4.0)
        ends.append(last)
    assert int(ends[0].counts[3]) > 20
    among = ends[0].select([3])
    for alone in (ends[1], ends[2].select([0])):
        for field in ("length", "growth_rate", "position"):
            assert torch.equal(of(among, field), of(alone, field)), field


SCRIPT = """
import torchfilm as tf

def update(cells):
    cells.noise = cells.normal()

scene = tf.Scene(
    tf.Rules(update, variables={"noise": 0.0}), tf.Growth(rate=1.0), tf.Division(length=4.0),
    dim=2, dt=0.05,
)
"""


def test_a_script_that_runs_draws_as_where_it_is_imported(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(SCRIPT, encoding="utf-8")
    scenes = [runpy.run_path(str(file), run_name=n)["scene"] for n in ("__main__", "mine")]
    scenes.append(load_scene(str(file), {}))
    noise = []
    for scene in scenes:
        *_, last = tf.simulate(scene, until=0.5)
        noise.append(last.fields["noise"])
    assert float(noise[0].abs().max()) > 0
    assert torch.equal(noise[0], noise[1])
    assert torch.equal(noise[0], noise[2])


class Counts:
    """A rule that is an object."""

    def __call__(self, cells):
        cells.noise = cells.normal()


def of_script(file: str, thing):
    """As if it were defined in this file, run as a script."""
    names = {"__name__": "__main__"}
    exec(compile(thing, file, "exec"), names)
    return names["made"]


@pytest.mark.parametrize(
    "text",
    ["def made(cells): pass", "class Kind:\n    def __call__(self, cells): pass\nmade = Kind()"],
)
def test_the_module_of_a_script(text):
    made = of_script("/somewhere/mine.py", text)
    assert made.__module__ == "__main__"
    assert module_of(made) == "mine"
    made_elsewhere = of_script("<stdin>", text)
    assert module_of(made_elsewhere) == "__main__"  # it has no other name
    assert module_of(label_of) == "torchfilm.effects.bound_rules"
    assert module_of(Counts()) == __name__


def test_a_rule_of_a_notebook_has_no_file():
    """Its file is named by the text of its cell, which may change where the rule does not."""
    made = of_script("/tmp/ipykernel_4711/2381196255.py", "def made(cells): pass")
    assert module_of(made) == "__main__"


def test_a_decorated_rule_is_that_of_its_own_file():
    text = "import functools\ndef inner(cells): pass\nmade = functools.wraps(inner)(other)"
    names = {"__name__": "__main__", "other": lambda cells: None}
    exec(compile(text, "/somewhere/mine.py", "exec"), names)
    assert module_of(names["made"]) == "mine"


def test_an_object_whose_class_inherits_its_call():
    made = of_script(
        "/somewhere/mine.py",
        "class Base:\n    def __call__(self, cells): pass\nclass Kind(Base): pass\nmade = Kind()",
    )
    assert module_of(made) == "mine"


def test_in_a_process_that_a_script_starts(monkeypatch):
    made = of_script("/somewhere/mine.py", "def made(cells): pass")
    monkeypatch.setattr(made, "__module__", "__mp_main__")
    assert label_of(made) == "rule mine made"


def test_a_module_that_is_run_keeps_its_whole_name(monkeypatch):
    """`python -m package.mine`."""
    made = of_script("/somewhere/package/mine.py", "def made(cells): pass")
    main = types.ModuleType("__main__")
    main.__file__ = "/somewhere/package/mine.py"
    main.__spec__ = types.SimpleNamespace(name="package.mine", origin=main.__file__)
    monkeypatch.setitem(__import__("sys").modules, "__main__", main)
    assert module_of(made) == "package.mine"
