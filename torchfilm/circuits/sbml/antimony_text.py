"""Antimony, SBML as text for people, to SBML."""

from __future__ import annotations

import re

from torchfilm.circuits.sbml.document import needed
from torchfilm.tools.checks import InputError

COMMENTS = re.compile(r"/\*.*?\*/|//[^\n]*|#[^\n]*", re.DOTALL)
IMPORT = re.compile(r"(?:^|[\n;])\s*import\b")
ERROR = re.compile(r"Error in model string, line (\d+):\s*", re.DOTALL)


def to_sbml(text: str, where: str) -> str:
    """A model in Antimony, with all its modules, as SBML.

    Raises InputError, with the line, for text that is no Antimony, and for what reads other files.
    """
    if not isinstance(text, str):
        raise InputError(f"{where} must be text, and is {type(text).__name__}.")
    if not text.strip():
        raise InputError(f"{where} is empty.")
    if "\0" in text:
        raise InputError(f"{where} is no text: it has a zero byte.")
    # a name of a file is a statement, too: a model without anything in it
    if not re.search(r"[\s;=>]", text.strip()):
        raise InputError(
            f"{where} is {text.strip()!r}, which looks like the name of a file: give the text that"
            " is in it."
        )
    plain = COMMENTS.sub(lambda found: "\n" * found[0].count("\n"), text)
    found = IMPORT.search(plain)
    if found:
        line = plain.count("\n", 0, found.end()) + 1
        raise InputError(f"{where}, line {line}: import reads another file: write the model here.")
    antimony = needed("antimony", "antimony")
    antimony.clearPreviousLoads()
    try:
        if antimony.loadAntimonyString(text) < 0:
            said = " ".join(antimony.getLastError().split())
            line_of = ERROR.match(said)
            at = f", line {line_of[1]}" if line_of else ""
            raise InputError(f"{where}{at}: {ERROR.sub('', said)}")
        return str(antimony.getSBMLString(antimony.getMainModuleName()))
    finally:
        antimony.clearPreviousLoads()
        antimony.freeAll()
