"""From the equations of a circuit to an SBML model, Level 3 Version 2."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from decimal import Decimal
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from torchfilm.circuits.expressions import NAME, NUMBER, Builder, Expression, walk
from torchfilm.circuits.formulas import bare
from torchfilm.circuits.graph import CircuitGraph
from torchfilm.circuits.sbml.document import check_xml
from torchfilm.circuits.sbml.own_marks import ARGUMENT, FUNCTIONS, NAMESPACE, PREFIX, definition
from torchfilm.circuits.sbml.reading import OPTIONS, TIME
from torchfilm.tools.checks import InputError
from torchfilm.tools.whole_files import write_whole

CORE = "http://www.sbml.org/sbml/level3/version2/core"
MATHML = "http://www.w3.org/1998/Math/MathML"
CSYMBOL_TIME = "http://www.sbml.org/sbml/symbols/time"
SID = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
MEDIUM_SIZE = 1000.0  # µm³; for other programs, since torchfilm has the medium's own

# Operations by the elements of MathML.
ELEMENTS = {
    "add": "plus", "sub": "minus", "mul": "times", "div": "divide", "neg": "minus", "pow": "power",
    "log": "ln", "log10": "log", "sqrt": "root", "atan": "arctan", "atanh": "arctanh",
    "minimum": "min", "maximum": "max", "ge": "geq", "le": "leq", "ne": "neq",
    **{n: n for n in ("abs", "exp", "floor", "sin", "cos", "tan", "sinh", "cosh", "tanh", "gt",
                      "lt", "eq", "and", "or", "not")},
}  # fmt: skip
FLAT = ("add", "mul")  # written with all operands at once, so that long sums are not nested


def usual_cell(radius: float = 0.5, length: float = 2.0) -> dict[str, float]:
    """A cell for other programs: what formulas of cells read."""
    return {
        "volume": math.pi * radius**2 * (length + 4 / 3 * radius),
        "area": 2 * math.pi * radius * (length + 2 * radius),
        "length": length,
        "radius": radius,
    }


class Ids:
    """Ids of a model, which are all different, for the names of a circuit. marks: the names that
    an id does not say."""

    def __init__(self) -> None:
        self.of: dict[str, str] = {}
        self.marks: dict[str, str] = {}

    def add(self, name: str, wanted: str) -> str:
        """An id for a name such as "p.k1". Raises InputError for letters that SBML lacks."""
        if not SID.fullmatch(wanted):
            raise InputError(
                f"{wanted!r} cannot be written: ids in SBML have the letters A to Z, digits and _"
            )
        made, k = wanted, 0
        while made in self.of.values():
            k += 1
            made = f"{wanted}_{k}"
        self.of[name] = made
        kind, _, own = name.partition(".")
        hidden = own in (*OPTIONS, TIME) or own.startswith("__")
        if kind in ("s", "cell") or made != own or hidden:
            self.marks[made] = name
        return made


def sbml_text(
    graph: CircuitGraph,
    label: str,
    initial: Mapping[str, float],
    constants: Mapping[str, float],
    undiluted: Iterable[str],
    cell: Mapping[str, float],
) -> str:
    """A circuit as the text of an SBML model. initial, constants, and what is read of a cell:
    numbers by name.

    Rates are rate rules; what a cell gives to a signal is a reaction whose product is that signal.
    Raises InputError for names and equations that SBML cannot hold.
    """
    ids = Ids()
    roots, leaves = [*graph.rates.values(), *graph.releases.values()], names_read(graph)
    ids.add("cell.volume", "cell")
    for name in graph.species:
        ids.add(f"u.{name}", name)
    for name in graph.parameters:
        ids.add(f"p.{name}", name)
    for name in graph.signals:
        ids.add(f"s.{name}", f"out_{name}")
    of_cell = read_of_cell(leaves)
    for name in of_cell:
        ids.add(f"cell.{name}", f"cell_{name}")
    top = Element("sbml", {"xmlns": CORE, "level": "3", "version": "2"})
    model = SubElement(top, "model", {
        "id": label if SID.fullmatch(label) else "circuit", "timeUnits": "hour",
        "volumeUnits": "um3", "lengthUnits": "um", "areaUnits": "um2",
    })  # fmt: skip
    _annotate(model, ids, undiluted, "cell.time" in leaves)
    _functions(model, roots)
    _units(model)
    _compartments(model, ids, graph, cell["volume"])
    _species(model, ids, graph, initial)
    parameters = [(ids.of[f"p.{n}"], constants[n]) for n in graph.parameters]
    parameters += [(ids.of[f"cell.{n}"], cell[n]) for n in of_cell]
    _list(model, "parameter", ({"id": i, "value": _attribute(x), "constant": "true"}
                               for i, x in parameters))  # fmt: skip
    rules = _list(model, "rule", ())
    for name, rate in graph.rates.items():
        rule = SubElement(rules, "rateRule", {"variable": ids.of[f"u.{name}"]})
        _math(rule, rate, ids)
    if not len(rules):
        model.remove(rules)
    _reactions(model, ids, graph)
    ElementTree.indent(top)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(top, "unicode") + "\n"


def names_read(graph: CircuitGraph) -> list[str]:
    """The names that all rates read, such as "cell.length"."""
    roots = [*graph.rates.values(), *graph.releases.values()]
    return list(dict.fromkeys(e.name for e in walk(roots) if e.op == NAME))


def read_of_cell(leaves: Iterable[str]) -> list[str]:
    """What of the names that rates read is of a cell, beside its volume and the time."""
    names = [n.removeprefix("cell.") for n in leaves if n.startswith("cell.")]
    return [n for n in names if n not in ("volume", "time")]


def write(path: str | Path, text: str) -> None:
    """Write a model that can be read again. Raises InputError where it cannot."""
    check_xml(text, str(path))
    write_whole(Path(path), text)


def _list(model: Element, what: str, each: Iterable[Mapping[str, str]]) -> Element:
    """A list of elements; none where it would be empty, except of rules."""
    plural = what if what == "species" else f"{what}s"
    made = SubElement(model, f"listOf{plural[0].upper()}{plural[1:]}")
    for attributes in each:
        SubElement(made, what, dict(attributes))
    if what != "rule" and not len(made):
        model.remove(made)
    return made


def _annotate(model: Element, ids: Ids, undiluted: Iterable[str], time: bool) -> None:
    own = SubElement(SubElement(model, "annotation"), "circuit", {"xmlns": NAMESPACE})
    for made, name in ids.marks.items():
        SubElement(own, "is", {"id": made, "name": name})
    for name in undiluted:
        SubElement(own, "undiluted", {"name": f"u.{name}"})
    if time:
        SubElement(own, "time", {"name": "cell.time"})


def _functions(model: Element, roots: Iterable[Expression]) -> None:
    """Definitions of the operations that MathML lacks, where they occur."""
    used = dict.fromkeys(e.op for e in walk(roots) if e.op in FUNCTIONS)
    if not used:
        return
    made = SubElement(model, "listOfFunctionDefinitions")
    for op in used:
        one = SubElement(made, "functionDefinition", {"id": PREFIX + op})
        body = SubElement(SubElement(one, "math", {"xmlns": MATHML}), "lambda")
        arguments, formula = definition(Builder(), op)
        ids = Ids()
        for name in arguments:
            SubElement(SubElement(body, "bvar"), "ci").text = ids.add(ARGUMENT + name, name)
        body.append(_formula(formula, ids))


def _units(model: Element) -> None:
    made = SubElement(model, "listOfUnitDefinitions")
    for name, kind, exponent, scale, factor in (
        ("hour", "second", 1, 0, 3600), ("um", "metre", 1, -6, 1), ("um2", "metre", 2, -6, 1),
        ("um3", "metre", 3, -6, 1),
    ):  # fmt: skip
        units = SubElement(SubElement(made, "unitDefinition", {"id": name}), "listOfUnits")
        SubElement(units, "unit", {"kind": kind, "exponent": str(exponent), "scale": str(scale),
                                   "multiplier": str(factor)})  # fmt: skip


def _compartments(model: Element, ids: Ids, graph: CircuitGraph, volume: float) -> None:
    sizes = {ids.of["cell.volume"]: volume}
    if graph.signals:
        sizes[ids.add("medium", "medium")] = MEDIUM_SIZE
    _list(model, "compartment", (
        {"id": n, "spatialDimensions": "3", "size": _attribute(x), "constant": "true"}
        for n, x in sizes.items()
    ))  # fmt: skip


def _species(model: Element, ids: Ids, graph: CircuitGraph, initial: Mapping[str, float]) -> None:
    each = [(f"u.{n}", "cell.volume", initial[n]) for n in graph.species]
    each += [(f"s.{n}", "medium", 0.0) for n in graph.signals]
    _list(model, "species", (
        {"id": ids.of[n], "compartment": ids.of[home], "initialConcentration": _attribute(x),
         "hasOnlySubstanceUnits": "false", "boundaryCondition": "false", "constant": "false"}
        for n, home, x in each
    ))  # fmt: skip


def _reactions(model: Element, ids: Ids, graph: CircuitGraph) -> None:
    if not graph.releases:
        return
    made = SubElement(model, "listOfReactions")
    for name, amount in graph.releases.items():
        own = ids.of[f"s.{name}"]
        one = SubElement(made, "reaction", {
            "id": ids.add(f"release of {name}", f"release_{name}"), "reversible": "false"
        })  # fmt: skip
        products = SubElement(one, "listOfProducts")
        SubElement(products, "speciesReference",
                   {"species": own, "stoichiometry": "1", "constant": "true"})  # fmt: skip
        reads = [ids.of[n] for n in amount.names() if n[:2] in ("u.", "s.") and ids.of[n] != own]
        if reads:
            modifiers = SubElement(one, "listOfModifiers")
            for other in reads:
                SubElement(modifiers, "modifierSpeciesReference", {"species": other})
        _math(SubElement(one, "kineticLaw"), amount, ids)


def _math(parent: Element, root: Expression, ids: Ids) -> None:
    SubElement(parent, "math", {"xmlns": MATHML}).append(_formula(root, ids))


def _formula(root: Expression, ids: Ids) -> Element:
    """A formula as MathML, without operations on the type of numbers."""
    made: dict[Expression, Element] = {}
    root = bare(root)
    for node in walk([root]):
        if bare(node) is node:
            made[node] = _element(node, [made[bare(a)] for a in node.args], ids)
    return made[root]


def _element(node: Expression, args: list[Element], ids: Ids) -> Element:
    if node.op == NUMBER:
        return _number(node.value)
    if node.op == NAME:
        if node.name == "cell.time":
            made = Element("csymbol", {"encoding": "text", "definitionURL": CSYMBOL_TIME})
            made.text = "time"
            return made
        made = Element("ci")
        made.text = ids.of[node.name]
        return made
    if node.op == "where":
        made = Element("piecewise")
        SubElement(made, "piece").extend([args[1], args[0]])
        SubElement(made, "otherwise").append(args[2])
        return made
    made = Element("apply")
    if node.op in FUNCTIONS:
        SubElement(made, "ci").text = PREFIX + node.op
        if node.op in ("activation", "repression") and len(args) == 2:  # the power 1, left out
            args = [*args, _number(1.0)]
    else:
        SubElement(made, ELEMENTS[node.op])
        first = args[0]
        if node.op in FLAT and first.tag == "apply" and first[0].tag == ELEMENTS[node.op]:
            args = [*first[1:], *args[1:]]
    made.extend(args)
    return made


def _number(x: float) -> Element:
    """A number with all its digits, as MathML has it: without an exponent."""
    if math.isnan(x):
        return Element("notanumber")
    if math.isinf(x):
        made = Element("infinity")
        if x > 0:
            return made
        minus = Element("apply")
        minus.extend([Element("minus"), made])
        return minus
    made = Element("cn")
    made.text = format(Decimal(repr(x)), "f")
    return made


def _attribute(x: float) -> str:
    special = {math.inf: "INF", -math.inf: "-INF"}
    return "NaN" if math.isnan(x) else special.get(x, repr(float(x)))
