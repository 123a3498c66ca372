"""The effect that runs a script's `init`, `update` and `divide`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchfilm.cellmodeller.bound_script import BoundScript, ScriptDivision
from torchfilm.cellmodeller.columns import ColumnRule
from torchfilm.cellmodeller.loading import Script
from torchfilm.cellmodeller.sheets import CellLayout
from torchfilm.effect import RULES, Binding, BoundEffect, Effect
from torchfilm.state import CELL_TYPE, Field, State


@dataclass(frozen=True, eq=False)
class ScriptRules(Effect):
    """A CellModeller script's own functions: `init(cell)` of the first cells, `update(cells)` at
    the start of each step, `divide(parent, d1, d2)` after each division.

    name: of the script's file. content: a digest of its source. loop: "columns", `update` acts on
    whole columns, or "cells", on one cell after the other; reason: why.
    """

    name: str
    content: str
    loop: str
    reason: str = field(repr=False)
    script: Script = field(repr=False)
    layout: CellLayout = field(repr=False)
    rule: ColumnRule | None = field(repr=False)

    stage = RULES
    title = "script"
    may_repeat = False
    writes_anything = True

    def __reduce__(self) -> tuple[Any, ...]:
        return (_again, (str(self.script.path), self.loop, self.script.seconds))

    def declares(self, dim: int) -> tuple[Field, ...]:
        return (CELL_TYPE, *(v.declared() for v in self.layout.variables.values()))

    def numerics(self, dt: float, state: State) -> list[str]:
        if self.rule is not None:
            return [f"update(cells) of {self.name}, on whole columns"]
        return [f"update(cells) of {self.name}, cell by cell (slow): {self.reason}"]

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        return (BoundScript(self, binding), ScriptDivision(self, binding))


def _again(path: str, loop: str, seconds: float) -> ScriptRules:
    """The effect of a script that is loaded again, for another process."""
    from torchfilm.cellmodeller.build import script_rules
    from torchfilm.cellmodeller.loading import load

    return script_rules(load(Path(path), seconds), loop)
