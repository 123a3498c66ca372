"""The scripts in experiments/ import what there is: all of them are too slow to run here."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent.parent / "experiments"
FOLDERS = (HERE, HERE / "accuracy", HERE / "benchmarks")
SCRIPTS = sorted(path for folder in FOLDERS for path in folder.glob("*.py"))


def imported(path: Path) -> list[tuple[str, str | None]]:
    """Modules, each with a name that is taken from it, or None."""
    found: list[tuple[str, str | None]] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [(node.module or "", alias.name) for alias in node.names]
    return found


def top_names(path: Path) -> set[str]:
    """What a script has at its top, without running it."""
    found: set[str] = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {alias.asname or alias.name for alias in node.names}
        else:
            found |= {x.id for x in ast.walk(node) if isinstance(x, ast.Name)}
    return found


def is_there(script: Path, module: str, name: str | None) -> bool:
    """Whether a module that a script imports is there, and has a name."""
    beside = [path for path in SCRIPTS if path.stem == module]
    for path in sorted(beside, key=lambda path: path.parent != script.parent):
        return name is None or name in top_names(path)
    if module.partition(".")[0] not in ("torchfilm", "design"):
        known = module in sys.stdlib_module_names or importlib.util.find_spec(module.split(".")[0])
        return bool(known)
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError:
        return False
    if name is None or hasattr(found, name):
        return True
    return hasattr(found, "__path__") and bool(importlib.util.find_spec(f"{module}.{name}"))


def test_there_are_scripts():
    assert len(SCRIPTS) > 40


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_what_a_script_imports_is_there(path):
    missing = [f"{m}: {n}" for m, n in imported(path) if not is_there(path, m, n)]
    assert not missing


@pytest.mark.parametrize(
    "line",
    ["from torchfilm.signals.transport import nothing", "import torchfilm.nothing_like_it",
     "from record import nothing", "import no_such_module_anywhere"],
)  # fmt: skip
def test_what_is_not_there_is_found(line, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(line + "\n")
    ((module, name),) = imported(script)
    assert not is_there(script, module, name)
