"""From a file to a checked SBML model: what is no SBML, and what torchfilm does not simulate, is
refused with its line or its id."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.parsers import expat

from torchfilm.tools.checks import InputError, install

# Deeper than any model, and less deep than what would overflow the stack of a parser.
MAX_DEPTH = 250
OWN_PACKAGES = ("l3v2extendedmath",)  # functions of Level 3 Version 2, which libsbml calls one
DRAWINGS = ("layout", "render")  # packages that change no number
UNNAMED_EVENT = r"_E\d+"  # what Antimony calls an event without a name
PACKED = (b"\x1f\x8b", b"PK", b"BZh")  # how files begin that are compressed
ENCODINGS = ("utf-8", "ascii", "us-ascii")  # SBML is UTF-8, of which ASCII is a part
# Errors of libsbml in names of units, which convert nothing; those of time are read by `units`.
UNITS = (10313, *range(20217, 20222))


def needed(module: str, package: str) -> Any:
    """A module of the extra `sbml`. Raises InputError, naming the extra, where it is missing."""
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(f"this needs {package}: {install('sbml')}.") from error


def shortened(text: str, most: int = 60) -> str:
    """A text of the user's on one line, for messages."""
    line = " ".join(text.split())
    return line if len(line) <= most else line[: most - 1] + "…"


def read_bytes(path: str | Path) -> bytes:
    """The content of a file. Raises InputError where it cannot be read."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def decoded(content: bytes, where: str) -> str:
    """The content of a file as text. Raises InputError where it is no UTF-8, or empty."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        todo = "unpack it" if content.startswith(PACKED) else "save it in that encoding"
        raise InputError(
            f"{where} is not UTF-8 (line {line}, byte {error.start}): {todo}."
        ) from error
    if not text.strip():
        raise InputError(f"{where} is empty.")
    return text


def check_xml(text: str, where: str) -> None:
    """Raise InputError, with the line, for text that is no XML, no SBML, or not safe to read.

    Before libsbml sees it: libsbml expands entities, overflows its stack on elements that are
    nested too deeply, and reads a number that is none as 0.
    """
    parser = expat.ParserCreate()
    depth, number = 0, None

    def refuse(what: str) -> None:
        raise InputError(f"{where}, line {parser.CurrentLineNumber}: {what}.")

    def declared(version: str, encoding: str | None, standalone: int) -> None:
        if encoding is not None and encoding.lower() not in ENCODINGS:
            refuse(f"the encoding is {encoding}; SBML is UTF-8")

    def doctype(*_: object) -> None:
        refuse("a document type or entity is declared, which SBML has no use for: remove it")

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, number
        own = name.rpartition(":")[2]
        if depth == 0 and own != "sbml":
            refuse(f"this is no SBML: the outermost element is {name}, and must be sbml")
        depth += 1
        if depth > MAX_DEPTH:
            refuse(f"elements are nested more than {MAX_DEPTH} deep")
        if own == "cn":
            number = ""
        elif own == "sep" and number is not None:
            number += " "

    def characters(data: str) -> None:
        nonlocal number
        if number is not None:
            number += data

    def end(name: str) -> None:
        nonlocal depth, number
        depth -= 1
        if name.rpartition(":")[2] == "cn":
            for part in (number or "").split() or [""]:
                try:
                    float(part)
                except ValueError:
                    refuse(f"{part!r} is no number")
            number = None

    parser.XmlDeclHandler, parser.StartDoctypeDeclHandler = declared, doctype
    parser.EntityDeclHandler = doctype
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler = characters
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        why = expat.ErrorString(error.code)
        raise InputError(
            f"{where}, line {error.lineno}: this is no XML: {why}. Is the file complete?"
        ) from error


def open_model(text: str, where: str) -> Any:
    """The model of an SBML text, as libsbml reads it. Its document is `model.getSBMLDocument()`,
    which must be kept while the model is used.

    Raises InputError for what is no valid SBML, and for what torchfilm does not simulate.
    """
    check_xml(text, where)
    libsbml = needed("libsbml", "python-libsbml")
    document = libsbml.readSBMLFromString(text)
    _raise_first_error(document, where, libsbml)
    model = document.getModel()
    if model is None:
        raise InputError(f"{where} has no model.")
    refused = next(_unsupported(document, model), None)
    if refused:
        raise InputError(f"{where}: {refused}.")
    for kind in range(libsbml.LIBSBML_CAT_SBML, libsbml.LIBSBML_CAT_STRICT_UNITS_CONSISTENCY + 1):
        document.setConsistencyChecks(kind, False)
    for kind in (libsbml.LIBSBML_CAT_IDENTIFIER_CONSISTENCY, libsbml.LIBSBML_CAT_MATHML_CONSISTENCY,
                 libsbml.LIBSBML_CAT_GENERAL_CONSISTENCY):  # fmt: skip
        document.setConsistencyChecks(kind, True)
    document.checkConsistency()
    _raise_first_error(document, where, libsbml)
    return document


def _raise_first_error(document: Any, where: str, libsbml: Any) -> None:
    for k in range(document.getNumErrors()):
        error = document.getError(k)
        harmless = error.getErrorId() in UNITS or error.getPackage() in DRAWINGS
        if error.getSeverity() >= libsbml.LIBSBML_SEV_ERROR and not harmless:
            lines = [x for x in error.getMessage().splitlines() if x and x[:9] != "Reference"]
            said = " ".join(lines[-1].split())  # what is wrong here, after the rule
            raise InputError(f"{where}, line {error.getLine()}: this is no valid SBML. {said}")


def name_of(thing: Any, place: int = 0) -> str:
    """An element by its id, or where it has none by its place in its list, from 1."""
    own = thing.getIdAttribute() or thing.getMetaId() or thing.getName()
    return repr(own) if own else f"number {place + 1}"


def _event(event: Any) -> str:
    """An event by its id, or by its trigger where the user gave it no name."""
    own = event.getIdAttribute()
    if own and not re.fullmatch(UNNAMED_EVENT, own):
        return f"the event {own!r}"
    trigger = event.getTrigger()
    if trigger is None or not trigger.isSetMath():
        return "an event without a name"
    formula = needed("libsbml", "python-libsbml").formulaToL3String(trigger.getMath())
    return f"an event without a name, at ({shortened(formula)}),"


def _unsupported(document: Any, model: Any) -> Iterator[str]:
    """What the model has that torchfilm does not simulate, each named with its id."""
    packages = document.getNumPlugins() if document.getLevel() > 2 else 0
    for k in range(packages):
        plugin = document.getPlugin(k)
        name = plugin.getPackageName()
        if name not in (*OWN_PACKAGES, *DRAWINGS) and document.getPackageRequired(name):
            yield f"it needs the package {name}, which torchfilm does not read"
    for k in range(document.getNumUnknownPackages()):
        prefix = document.getUnknownPackagePrefix(k)
        if document.getPackageRequired(prefix):
            yield f"it needs the package {prefix}, which torchfilm does not read"
    for event in model.getListOfEvents():
        late = " with a delay" if event.isSetDelay() else ""
        yield (
            f"{_event(event)}{late} is not supported: torchfilm has no events. What happens at a"
            " time can be a piecewise rate of the time, and what cells do once in a step, tf.Rules"
        )
    for k, rule in enumerate(model.getListOfRules()):
        if rule.isAlgebraic():
            yield (
                f"the algebraic rule {name_of(rule, k)} is not supported: solve it for a variable,"
                " and make it an assignment rule"
            )
    for k, one in enumerate(model.getListOfConstraints()):
        yield f"the constraint {name_of(one, k)} is not supported: remove it"
    for k, one in enumerate(model.getListOfReactions()):
        if one.isSetFast() and one.getFast():
            yield f"the fast reaction {name_of(one, k)} is not supported: give it a finite rate"
