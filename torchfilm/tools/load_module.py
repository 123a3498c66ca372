"""Running a Python file of the user's."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any


def run_file(path: Path) -> dict[str, Any]:
    """The names that a Python file defines, as a module called as the file is; raises whatever the
    file does.

    While it runs it is listed among the modules, where a dataclass looks up the types of its
    fields, unless another is called so: nothing that is imported later, by this file or another,
    comes upon it by mistake.
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
