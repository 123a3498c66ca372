"""Runs a user's Python file."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any


def run_file(path: Path) -> dict[str, Any]:
    """The names that a Python file defines, as a module with the file's name.

    Raises whatever the file raises. While the file runs, the module is in `sys.modules`, where a
    dataclass looks up the types of its fields, unless a module of that name is already there.
    Afterwards it is removed, so that no later import finds it by mistake.
    """
    module = ModuleType(path.stem)
    module.__file__ = str(path)
    new = path.stem not in sys.modules
    if new:
        sys.modules[path.stem] = module
    try:
        exec(compile(path.read_bytes(), str(path), "exec", dont_inherit=True), vars(module))
    finally:
        if new:
            sys.modules.pop(path.stem, None)
    return vars(module)
