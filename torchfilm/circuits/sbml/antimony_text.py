"""Antimony, SBML as text for people, to SBML."""

from __future__ import annotations

import re

from torchfilm.circuits import ANTIMONY_FILES, SBML_FILES
from torchfilm.circuits.sbml.document import needed, shortened
from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import warn

# What a line of a model has: a reaction, a rate rule, or the beginning of a model.
STATEMENT = re.compile(r"->|=>|^\s*\w+\s*'\s*=|^\s*\*?(model|module|species)\b", re.MULTILINE)
COMMENTS = re.compile(r"/\*.*?\*/|//[^\n]*|#[^\n]*", re.DOTALL)
IMPORT = re.compile(r"(?:^|[\n;])\s*import\b")
ERROR = re.compile(r"Error in model string, line (\d+):\s*", re.DOTALL)


def looks_like_antimony(text: str) -> bool:
    """Whether a text that is no XML is probably a model in Antimony."""
    return not text.lstrip().startswith("<") and STATEMENT.search(text) is not None


def to_sbml(text: str, where: str) -> str:
    """A model in Antimony, with all its modules, as SBML.

    Raises InputError, with the line, for text that is no Antimony, and for what reads other files.
    """
    if not text.strip():
        raise InputError(f"{where} is empty.")
    if "\0" in text:
        raise InputError(f"{where} is no text: it has a zero byte.")
    if text.lstrip().startswith("<"):
        raise InputError(
            f"{where} looks like SBML (it begins {shortened(text, 40)!r}): read the file with"
            " Circuit.from_sbml(path)."
        )
    # a name of a file is a statement, too: a model without anything in it
    name = text.strip()
    is_name = not re.search(r"[\s;=>]", name)
    may_be = not re.search(r"[\n;=>']", name)  # with spaces in it
    if is_name or (may_be and name.lower().endswith((*ANTIMONY_FILES, *SBML_FILES))):
        reader = "from_sbml" if name.lower().endswith(SBML_FILES) else "from_antimony"
        raise InputError(
            f"{where} is {shortened(name)!r}, which looks like the name of a file: read it with"
            f" Circuit.{reader}(Path({shortened(name)!r})), or give the text that is in it."
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
        main = str(antimony.getMainModuleName())
        names = [str(antimony.getNthModuleName(k)) for k in range(antimony.getNumModules())]
        # another model may be a part of this one: "part: other();"
        used = [n for n in names if re.search(rf":\s*{re.escape(n)}\s*\(", plain)]
        left = [n for n in names if n not in (main, "__main", *used)]
        if left:
            warn(f"{where} has several models: {main} is read, and not {', '.join(left)}.")
        return str(antimony.getSBMLString(main))
    except UnicodeDecodeError as error:  # of a message that quotes half a letter
        raise InputError(
            f"{where}: ids are of the letters a to z, digits and _; others may stand in comments."
        ) from error
    finally:
        antimony.clearPreviousLoads()
        antimony.freeAll()
