"""Who may import whom. The imports are read, not run, and the test fails where a lower room imports
a higher one."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

import torchfilm

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torchfilm"


@dataclass(frozen=True)
class Room:
    """A room of the package: its level, and the modules in it (a package stands for all its
    modules)."""

    level: int
    modules: tuple[str, ...]
    # modules of a higher room that this one may use all the same
    besides: tuple[str, ...] = ()
    # may its modules import each other?
    talk: bool = True


# To add a room, or a module to one, write it here. A module that is not listed belongs to the last.
ROOMS = {
    "tools": Room(0, ("torchfilm.tools", "torchfilm.version")),
    # compiled loops over arrays: they know neither torch nor the rest
    "kernels": Room(0, ("torchfilm.kernels",)),
    "tensors": Room(1, ("torchfilm.physics", "torchfilm.signals", "torchfilm.circuits")),
    "state": Room(2, ("torchfilm.state", "torchfilm.state_colonies")),
    # what an effect is, how values are given, resolved and printed, what rules see
    "protocol": Room(
        3,
        (
            "torchfilm.values",
            "torchfilm.bound_draw",
            "torchfilm.resolver",
            "torchfilm.distributions",
            "torchfilm.parameters",
            "torchfilm.effect",
            "torchfilm.own_step",
            "torchfilm.reports",
            "torchfilm.cell_types",
            "torchfilm.medium_exchange",
            "torchfilm.film_shape",
            "torchfilm.colony_edge",
            "torchfilm.spatial",
            "torchfilm.rule_values",
            "torchfilm.rule_draws",
            "torchfilm.rule_surroundings",
            "torchfilm.rule_views",
        ),
    ),
    "effects": Room(4, ("torchfilm.effects",), talk=False),
    "scene": Room(
        5,
        (
            "torchfilm.scene",
            "torchfilm.model",
            "torchfilm.binding",
            "torchfilm.joined_step",
            "torchfilm.cpu_parts",
            "torchfilm.turns",
            "torchfilm.together",
            "torchfilm.binding_checks",
            "torchfilm.arrivals",
            "torchfilm.founders",
            "torchfilm.initial_cells",
            "torchfilm.inocula",
            "torchfilm.micrographs",
        ),
    ),
    "loop": Room(6, ("torchfilm.loop", "torchfilm.replay")),
    "results": Room(7, ("torchfilm.io",)),
    # simulate takes a path to record to, so results lie below it
    "simulate": Room(8, ("torchfilm.simulation",)),
    "the rest": Room(9, ("torchfilm",)),
    "command line": Room(10, ("torchfilm.cli", "torchfilm.__main__")),
}
# Modules of one effect, which may import each other: the description and what binding makes of it.
ONE_EFFECT = [
    {f"torchfilm.effects.{name}" for name in names.split()}
    for names in (
        "circuit bound_circuit circuit_cells circuit_checks circuit_kernels circuit_report"
        " circuit_sbml circuit_words circuit_daughters",
        "division compiled_division division_lengths",
        "medium bound_medium medium_coverage medium_substeps medium_transport medium_values scaled"
        " signal",
        "rules bound_rules bound_division_rule",
        "mechanics bound_mechanics mechanics_report mechanics_words",
    )
]
# These take tensors: they never see a state, nor what is built on one.
TENSORS_ONLY = "tensors"
NOT_FOR_TENSORS = ("torchfilm.state", "torchfilm.effect")


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def within(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def room_of(module: str) -> str:
    """The room with the longest name that fits."""
    fits = [(len(m), room) for room, r in ROOMS.items() for m in r.modules if within(module, m)]
    return max(fits)[1]


def imports(source: str, module: str, is_package: bool = False) -> set[str]:
    """Every module of the package that the source imports, at the top, in a function or under
    TYPE_CHECKING."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = module.split(".") if is_package else module.split(".")[:-1]
                above = above[: len(above) - (node.level - 1)]
                base = ".".join([*above, *([base] if base else [])])
            # `from torchfilm.tools import checks` imports a module, `from torchfilm.state import
            # State` a name
            found |= {
                f"{base}.{alias.name}" if f"{base}.{alias.name}" in MODULES else base
                for alias in node.names
            }
    return {name for name in found if within(name, "torchfilm")}


def crossings(module: str, imported: set[str]) -> list[str]:
    """What is wrong with what a module imports."""
    name, wrong = room_of(module), []
    room = ROOMS[name]
    for other in sorted(imported - {module}):
        there = room_of(other)
        if ROOMS[there].level > room.level and other not in room.besides:
            wrong.append(
                f"{module} ({name}, level {room.level}) imports {other} ({there}, level"
                f" {ROOMS[there].level})"
            )
        elif (
            there == name
            and not room.talk
            and module not in room.modules
            and not any({module, other} <= each for each in ONE_EFFECT)
        ):
            wrong.append(f"{module} imports {other}: {name} never import each other")
        elif name == TENSORS_ONLY and any(within(other, m) for m in NOT_FOR_TENSORS):
            wrong.append(f"{module} imports {other}: these take tensors, never a state")
    return wrong


@pytest.mark.parametrize("module", MODULES)
def test_no_room_imports_a_higher_one(module):
    path = MODULES[module]
    assert crossings(module, imports(path.read_text(), module, path.name == "__init__.py")) == []


def test_the_page_for_contributors_has_the_same_rooms():
    page = (ROOT / "CONTRIBUTING.md").read_text()
    rows = re.findall(r"^\| (\d+) \|.*\| ([^|]*) \|$", page, flags=re.MULTILINE)
    told = {}
    for level, modules in rows:
        told.setdefault(int(level), set()).update(re.findall("`(.*?)`", modules))
    listed = {}
    for room in ROOMS.values():
        names = {m.removeprefix("torchfilm.") for m in room.modules}
        listed.setdefault(room.level, set()).update(names)
    rest = next(r.level for r in ROOMS.values() if r.modules == ("torchfilm",))
    assert {MODULES[f"torchfilm.{name}"] for name in told.pop(rest)}  # examples: they exist
    assert told == {level: names for level, names in listed.items() if level != rest}


@pytest.mark.parametrize(
    "module, source",
    [
        ("torchfilm.tools.checks", "from torchfilm.state import State"),
        ("torchfilm.state", "from torchfilm import scene"),
        ("torchfilm.state", "from torchfilm.values import Rule"),
        ("torchfilm.physics.walls", "from torchfilm.state import State"),
        ("torchfilm.physics.walls", "def f():\n    import torchfilm.effect"),
        ("torchfilm.effects.growth", "from torchfilm.effects.division import Division"),
        ("torchfilm.effects.growth", "from .division import Division"),
        ("torchfilm.effects.growth", "from torchfilm.effects import division"),
        ("torchfilm.effects.growth", "import torchfilm"),
        ("torchfilm.scene", "if TYPE_CHECKING:\n    from torchfilm.simulation import simulate"),
        ("torchfilm.simulation", "from torchfilm import cli"),
    ],
)
def test_crossings_are_noticed(module, source):
    assert len(crossings(module, imports(source, module))) == 1


@pytest.mark.parametrize(
    "module, source",
    [
        (
            "torchfilm.state",
            "from torchfilm.physics import capsule\nfrom torchfilm.tools import checks, random",
        ),
        (
            "torchfilm.effects.growth",
            (
                "import torch\nfrom torchfilm.effect import Effect\nfrom torchfilm.physics import"
                " capsule"
            ),
        ),
        (
            "torchfilm.physics.solve",
            (
                "from torchfilm.physics.jacobian import ContactJacobian\nfrom torchfilm.tools.cg"
                " import worst_of"
            ),
        ),
        (
            "torchfilm.cli.main",
            "from torchfilm import scenes, measure\nfrom torchfilm.simulation import simulate",
        ),
    ],
)
def test_what_is_allowed_passes(module, source):
    assert crossings(module, imports(source, module)) == []


def test_design_uses_public_names_only():
    """design/ is written as its users would write: `import torchfilm as tf`, or names that the
    package lists as its own."""
    wrong = []
    for path in sorted((ROOT / "design").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [a.name for a in node.names if a.name.startswith("torchfilm.")]
            elif (
                isinstance(node, ast.ImportFrom)
                and (node.module or "").split(".")[0] == "torchfilm"
            ):
                names = [
                    a.name
                    for a in node.names
                    if node.module != "torchfilm" or a.name not in torchfilm.__all__
                ]
            else:
                continue
            wrong += [f"{path.relative_to(ROOT)}: {name}" for name in names]
    assert wrong == []


NO_TEXT = ("os", "Image", "Study")  # whose `open` opens no text


def _opens_without_encoding(node: ast.AST) -> bool:
    """Whether this is a call that reads or writes text as the locale has it."""
    if not isinstance(node, ast.Call) or any(k.arg == "encoding" for k in node.keywords):
        return False
    called, words = (
        node.func,
        [ast.unparse(x) for x in (*node.args, *(k.value for k in node.keywords))],
    )
    if isinstance(called, ast.Attribute):
        if called.attr in ("read_text", "write_text"):
            return True
        opens = called.attr == "open" and ast.unparse(called.value) not in NO_TEXT
    else:
        opens = isinstance(called, ast.Name) and called.id == "open"
    return opens and not any(re.fullmatch(r"'[rwax+]*b[rwax+]*'", word) for word in words)


def test_text_is_utf8_in_every_locale():
    """Files of torchfilm have letters beyond ASCII; on Windows, and in the C locale, Python opens
    text in another encoding."""
    files = [f for room in ("torchfilm", "design") for f in sorted((ROOT / room).rglob("*.py"))]
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in files
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if _opens_without_encoding(node)
    ]
    assert found == []


def test_no_two_test_files_have_one_name():
    """pytest imports a test file by its name alone, and refuses the second of a name."""
    names = [path.name for path in sorted((ROOT / "tests").rglob("*.py"))]
    assert [n for n in set(names) - {"conftest.py"} if names.count(n) > 1] == []


def test_public_names_exist():
    assert [name for name in torchfilm.__all__ if not hasattr(torchfilm, name)] == []
    assert len(set(torchfilm.__all__)) == len(torchfilm.__all__)


@pytest.mark.parametrize("module", MODULES)
def test_files_are_small_enough_to_read(module):
    """Files up to about 400 lines, functions up to about 60: a tenth more is not a tenth too
    many."""
    source = MODULES[module].read_text()
    assert len(source.splitlines()) <= 440
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            assert node.end_lineno - node.lineno + 1 <= 66, f"{module}.{node.name}"
