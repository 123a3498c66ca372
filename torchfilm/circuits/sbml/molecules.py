"""The reactions of an SBML model, to run molecule by molecule."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from torchfilm.circuits.equations import Equations, Term
from torchfilm.circuits.expressions import NAME, Builder, Expression
from torchfilm.circuits.names import Names
from torchfilm.circuits.reactions import OUTSIDE, Reaction
from torchfilm.circuits.sbml.algebra import over
from torchfilm.circuits.sbml.mathml import calculate
from torchfilm.circuits.sbml.quantities import Quantities
from torchfilm.tools.checks import InputError

BACKWARDS = " backwards"
RATE = "rate"


@dataclass(frozen=True, repr=False)
class Law:
    """The rate of a reaction, conc/h relative to the cell's volume, as `Reaction` takes it.

    reads: the species, and "out." and signals, that it depends on.
    """

    equations: Equations
    reads: tuple[str, ...]

    def __call__(self, u: Names, s: Names, p: Names, cell: Names) -> Any:
        return self.equations(u, s, p, cell)[0][RATE]

    def __repr__(self) -> str:
        return f"<law {self.equations.label}>"


def reactions(
    quantities: Quantities, species: Sequence[str]
) -> tuple[list[Reaction], list[Expression]]:
    """The reactions of a model, and their rates. species: names in the circuit.

    A law counts as it is written: what it makes of concentrations, times the molecules of a unit,
    is the expected number of events. One that is the difference of what goes forwards and what goes
    back becomes two reactions. Raises InputError for all that does not come in whole molecules.
    """
    _check(quantities)
    found = [x for name in quantities.reactions for x in _of(quantities, name, species)]
    if not found:
        raise InputError("no reaction of the model changes a species of the cells")
    return [x for x, _ in found], [rate for _, rate in found]


def _check(quantities: Quantities) -> None:
    """Raise InputError for what changes without reactions."""
    for name in quantities.driven:
        raise InputError(
            f"{name!r} has a rate rule: molecule by molecule only reactions change anything. Write"
            " it as a reaction, or choose a method that solves rates"
        )
    for name in quantities.variables():
        if quantities.size_changes(quantities.things[name][1]):
            raise InputError(f"the compartment of {name!r} changes its size: fix it to run single"
                             " molecules")  # fmt: skip
        if quantities.conversion(name) is not None:
            raise InputError(f"{name!r} has a conversion factor, but molecules are counted as"
                             " such: leave it out")  # fmt: skip


def _of(
    quantities: Quantities, name: str, species: Sequence[str]
) -> Iterator[tuple[Reaction, Expression]]:
    """A reaction of the model as one of the circuit, or two; none if it changes nothing there."""
    reaction = quantities.reactions[name]
    taken, made = (
        _counts(quantities, side, name)
        for side in (reaction.getListOfReactants(), reaction.getListOfProducts())
    )
    if taken == made:
        return
    b = quantities.builder
    law = over(b, quantities.value(name), _size(quantities, name))
    if quantities.clock:
        raise InputError(
            f"the reaction {name!r} depends on the time, which single molecules do not know: choose"
            " a method that solves rates"
        )
    forwards, backwards = _both_ways(b, law, taken, made)
    for rate, sides, title in ((forwards, (taken, made), name),
                               (backwards, (made, taken), name + BACKWARDS)):  # fmt: skip
        if not isinstance(rate, Expression) and rate == 0:
            continue
        whole = calculate(b, "mul", quantities.choices.per_hour, rate)
        whole = whole if isinstance(whole, Expression) else b.number(float(whole))
        equations = Equations.of(title, tuple(species), {RATE: whole}, {})
        yield Reaction(*sides, Law(equations, _reads(whole)), title), whole


def _counts(quantities: Quantities, side: Any, reaction: str) -> dict[str, int]:
    """How many molecules of what the circuit knows are on a side of a reaction."""
    found: dict[str, int] = {}
    for reference in side:
        name = reference.getSpecies()
        if name not in quantities.changes:  # at the boundary, or constant
            continue
        count = quantities.stoichiometry(reference)
        if isinstance(count, Expression) or count != int(count) or count < 0:
            raise InputError(
                f"the reaction {reaction!r} makes or takes {name!r} in a number that is not whole:"
                " single molecules need whole ones"
            )
        signal = quantities.choices.signals.get(name)
        own = quantities.column(name) if signal is None else OUTSIDE + signal
        if count:
            found[own] = found.get(own, 0) + int(count)
    return found


def _size(quantities: Quantities, reaction: str) -> Term:
    """The size over which a reaction changes concentrations; all that it changes share it."""
    one = quantities.reactions[reaction]
    sizes: dict[Term, str] = {}
    for reference in (*one.getListOfReactants(), *one.getListOfProducts()):
        name = reference.getSpecies()
        if name in quantities.choices.signals or name not in quantities.changes:
            continue
        thing = quantities.things[name][1]
        sizes[1.0 if thing.getHasOnlySubstanceUnits() else quantities.size(thing)] = name
    if len(sizes) > 1:
        raise InputError(
            f"the reaction {reaction!r} changes {' and '.join(map(repr, sizes.values()))}, which"
            " are in compartments of their own, or one of them is an amount: a cell has one volume,"
            " so put all into one compartment"
        )
    if not sizes:
        raise InputError(
            f"the reaction {reaction!r} happens outside of cells: leave it out,"
            f" without=({reaction!r},), and describe it in the medium"
        )
    return next(iter(sizes))


def _both_ways(
    b: Builder, law: Term, taken: dict[str, int], made: dict[str, int]
) -> tuple[Term, Term]:
    """The rate forwards and the rate back, 0 where the law is no difference of both.

    1 − x/(K + x) is a difference, but no reaction goes back: what goes back depends on what the
    reaction makes, and what goes forwards on what it takes. Where it makes or takes nothing, the
    law itself must be the difference, as in kin − kout·a.
    """
    plus, minus = _parts(b, law)
    if not isinstance(minus, Expression) or not isinstance(law, Expression):
        return law, 0.0
    plain = law.op == "sub"
    goes = plain if not taken else bool(set(_reads_of(plus)) & set(taken))
    returns = plain if not made else bool(set(_reads_of(minus)) & set(made))
    return (plus, minus) if goes and returns else (law, 0.0)


def _parts(b: Builder, x: Term) -> tuple[Term, Term]:
    """x as a difference of terms, 0 where one is missing; only sums, products and quotients by
    terms without a difference are taken apart."""
    if not isinstance(x, Expression):
        return (x, 0.0) if x >= 0 else (0.0, -x)
    join = lambda op, *given: _joined(b, op, *given)
    if x.op == "neg":
        plus, minus = _parts(b, x.args[0])
        return minus, plus
    if x.op in ("add", "sub"):
        (p, m), (q, n) = (_parts(b, a) for a in x.args)
        q, n = (q, n) if x.op == "add" else (n, q)
        return join("add", p, q), join("add", m, n)
    if x.op in ("mul", "div"):
        (p, m), (q, n) = (_parts(b, a) for a in x.args)
        if _none(n):
            return (x, 0.0) if _none(m) else (join(x.op, p, q), join(x.op, m, q))
        if _none(m) and x.op == "mul":
            return join("mul", p, q), join("mul", p, n)
    return x, 0.0


def _joined(b: Builder, op: str, x: Term, y: Term) -> Term:
    """The operation, without terms that are 0."""
    if _none(x) or _none(y):
        return 0.0 if op != "add" else y if _none(x) else x
    return calculate(b, op, x, y)


def _none(x: Term) -> bool:
    return not isinstance(x, Expression) and x == 0


def _reads_of(x: Term) -> tuple[str, ...]:
    return _reads(x) if isinstance(x, Expression) else ()


def _reads(x: Expression) -> tuple[str, ...]:
    """The species, and "out." and signals, in an expression."""
    found: dict[str, None] = {}
    for node in x.walk():
        if node.op == NAME:
            kind, _, name = node.name.partition(".")
            found |= {name if kind == "u" else OUTSIDE + name: None} if kind in ("u", "s") else {}
    return tuple(found)
