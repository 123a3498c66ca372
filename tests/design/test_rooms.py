"""The modules of design/ import each other in one direction only, and each name has one meaning.

The tests read the source; they do not run it.
"""

from __future__ import annotations

import ast
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import design

ROOT = Path(__file__).parents[2]


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def sources(package: str) -> dict[str, ast.Module]:
    """The syntax tree of each module of a package."""
    paths = sorted((ROOT / package).rglob("*.py"))
    return {name_of(path): ast.parse(path.read_text()) for path in paths}


DESIGN = sources("design")


def imported(tree: ast.Module, modules) -> set[str]:
    """The modules of `modules` that a source imports: at the top, in a function or under
    TYPE_CHECKING."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "design/ uses absolute imports"
            base = node.module or ""
            # `from design import memory` imports a module, `from design.task import Task` a name
            names = (f"{base}.{alias.name}" for alias in node.names)
            found |= {name if name in modules else base for name in names}
    return found & set(modules)


def circle(trees: dict[str, ast.Module]) -> list[str]:
    """One circle of imports, or nothing."""
    try:
        TopologicalSorter({name: imported(tree, trees) for name, tree in trees.items()}).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_imports_form_a_circle():
    assert circle(DESIGN) == []


@pytest.mark.parametrize(
    "low",
    [
        "from design.high import f",
        "from design import high",
        "import design.high",
        "def f():\n    from design.high import f",
        "if TYPE_CHECKING:\n    from design.high import f",
    ],
)
def test_circles_are_noticed(low):
    trees = {"design": "", "design.high": "from design.low import g", "design.low": low}
    found = circle({name: ast.parse(source) for name, source in trees.items()})
    assert set(found) == {"design.high", "design.low"}


def test_no_function_has_the_name_of_its_module():
    named = [
        f"{name}.{node.name}"
        for name, tree in DESIGN.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name == name.rpartition(".")[2]
    ]
    assert named == []


def test_no_public_name_hides_a_module():
    assert [name for name in design.__all__ if f"design.{name}" in DESIGN] == []


def classes(trees: dict[str, ast.Module]) -> list[str]:
    return [
        node.name
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    ]


def test_class_names_are_unique():
    own, others = Counter(classes(DESIGN)), set(classes(sources("torchfilm")))
    assert [name for name, count in own.items() if count > 1] == []
    assert set(own) & others == set()


def called(tree: ast.Module) -> set[str]:
    """The names of called functions and of methods, with what they are called on: "tf.Replay"."""
    return {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}


@pytest.mark.parametrize("name", [name for name in DESIGN if name != "design.colonies"])
def test_only_colonies_uses_the_running_interface_of_torchfilm(name):
    running = ("tf.GrowthRecording", "tf.Replay", "tf.failures", "tf.simulate", "tf.rollout")
    running += ("scene.bind", "model.start", "model.step", "model.check", "replay.st")
    assert [call for call in called(DESIGN[name]) if call.startswith(running)] == []


@pytest.mark.parametrize("name", DESIGN)
def test_files_and_functions_are_short(name):
    tree = DESIGN[name]
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    lines = {f.name: (f.end_lineno or 0) - f.lineno + 1 for f in functions}
    assert [f"{f}: {count} lines" for f, count in lines.items() if count > 70] == []
    path = ROOT / (name.replace(".", "/") + ".py")
    assert not path.is_file() or len(path.read_text().splitlines()) <= 420
