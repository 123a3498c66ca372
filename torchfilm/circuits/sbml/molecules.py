"""The reactions of an SBML model, to run molecule by molecule."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.circuits.equations import Equations, Term
from torchfilm.circuits.expressions import NAME, Builder, Expression
from torchfilm.circuits.graph import evaluated
from torchfilm.circuits.names import Names
from torchfilm.circuits.reactions import OUTSIDE, Reaction
from torchfilm.circuits.sbml.algebra import over
from torchfilm.circuits.sbml.mathml import calculate
from torchfilm.circuits.sbml.quantities import Quantities
from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import warn

BACKWARDS = " backwards"
TRIALS = 4096  # states at which the sign of a law is tried
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
    quantities: Quantities, species: Sequence[str], reference: Callable[[], Term]
) -> tuple[list[Reaction], list[Expression]]:
    """The reactions of a model, and their rates. species: names in the circuit. reference: gives
    the size of the compartment that is the cell.

    A law counts as it is written: what it makes of concentrations, times the molecules of a unit,
    is the expected number of events. One that can be below 0 is the difference of what goes
    forwards and what goes back, and becomes two reactions. Raises InputError for all that does not
    come in whole molecules.
    """
    _check(quantities)
    found = [x for name in quantities.reactions for x in _of(quantities, name, species, reference)]
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
    quantities: Quantities, name: str, species: Sequence[str], reference: Callable[[], Term]
) -> Iterator[tuple[Reaction, Expression]]:
    """A reaction of the model as one of the circuit, or two; none if it changes nothing there."""
    reaction = quantities.reactions[name]
    taken, made = (
        _counts(quantities, side, name)
        for side in (reaction.getListOfReactants(), reaction.getListOfProducts())
    )
    if taken == made:
        return
    size = _size(quantities, name, reference)
    law = over(quantities.builder, quantities.value(name), size)
    if quantities.clock:
        raise InputError(
            f"the reaction {name!r} depends on the time, which single molecules do not know: choose"
            " a method that solves rates"
        )
    forwards, backwards = _both_ways(quantities, name, law, taken, made)
    for rate, sides, title in ((forwards, (taken, made), name),
                               (backwards, (made, taken), name + BACKWARDS)):  # fmt: skip
        if _none(rate):
            continue
        whole = quantities.per_hour(rate)
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


def _size(quantities: Quantities, reaction: str, cell: Callable[[], Term]) -> Term:
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
    return next(iter(sizes)) if sizes else cell()


def _both_ways(
    quantities: Quantities, reaction: str, law: Term, taken: Collection[str], made: Collection[str]
) -> tuple[Term, Term]:
    """The rate forwards and the rate back, 0 where the law is never below 0, as 1 − x/(K + x).

    Each way must need what it takes. Else the law goes one way, 0 where it is below 0, as
    k·(total − a), where a conserved sum keeps it above.
    """
    if not isinstance(law, Expression) or not _can_be_negative(quantities, law):
        return law, 0.0
    plus, minus = _parts(quantities, law)
    if _none(minus) or any(
        isinstance(x, Expression) and _can_be_negative(quantities, x) for x in (plus, minus)
    ):
        raise InputError(
            f"the law of the reaction {reaction!r} can be below 0, and is no difference of two that"
            " cannot: write it as two reactions, forwards and back"
        )
    if _needs(quantities, plus, taken) and _needs(quantities, minus, made):
        return plus, minus
    warn(
        f"the law of the reaction {reaction!r} can be below 0, where nothing happens: it is no"
        " difference of a rate that needs what the reaction takes and one that needs what it makes"
    )
    return calculate(quantities.builder, "maximum", law, 0.0), 0.0


def _needs(quantities: Quantities, rate: Term, names: Collection[str]) -> bool:
    """Whether a rate is 0 where any of these species, or "out." and signals, is."""
    if not isinstance(rate, Expression):
        return not names
    leaves = {n: f"s.{n.removeprefix(OUTSIDE)}" if n.startswith(OUTSIDE) else f"u.{n}"
              for n in names}  # fmt: skip
    return all(bool((_tried(quantities, rate, absent=x) == 0).all()) for x in leaves.values())


def _can_be_negative(quantities: Quantities, law: Expression) -> bool:
    """Whether a law is below 0 somewhere, tried at random positive species and signals, over eight
    orders of magnitude about 1 and about the constants, which have the model's values."""
    values = _tried(quantities, law)
    scale = values.abs()[values.isfinite()].max() if bool(values.isfinite().any()) else 0.0
    return bool((values < -1e-12 * scale).any())


def _tried(quantities: Quantities, law: Expression, absent: str = "") -> Tensor:
    """A law at the states of `_can_be_negative`, (TRIALS,), with a leaf that is 0 in all."""
    constants = {f"p.{quantities.column(n)}": x for n, x in quantities.constants.items()}
    random = np.random.default_rng(0)
    about = [1.0, *(abs(x) for x in constants.values() if x)]

    def leaf(node: Expression) -> Tensor:
        if node.name == absent:
            return torch.zeros(TRIALS, dtype=torch.float64)
        if constants.get(node.name):  # one that was given for each colony, or is drawn, is 0 there
            return torch.full((TRIALS,), float(constants[node.name]), dtype=torch.float64)
        drawn = random.choice(about, TRIALS) * 10.0 ** random.uniform(-4.0, 4.0, TRIALS)
        return torch.from_numpy(drawn)

    return evaluated([law], leaf)[0]


def _parts(quantities: Quantities, x: Term) -> tuple[Term, Term]:
    """x as a difference of terms, 0 where one is missing; what is never below 0 stays whole."""
    b = quantities.builder
    if not isinstance(x, Expression):
        return (x, 0.0) if x >= 0 else (0.0, -x)
    if not _can_be_negative(quantities, x):
        return x, 0.0
    if x.op == "neg":
        plus, minus = _parts(quantities, x.args[0])
        return minus, plus
    if x.op in ("add", "sub"):
        (p, m), (q, n) = (_parts(quantities, a) for a in x.args)
        q, n = (q, n) if x.op == "add" else (n, q)
        return _joined(b, "add", p, q), _joined(b, "add", m, n)
    if x.op in ("mul", "div"):
        (p, m), (q, n) = (_parts(quantities, a) for a in x.args)
        if _none(n):
            return _joined(b, x.op, p, q), _joined(b, x.op, m, q)
        if _none(m) and x.op == "mul":
            return _joined(b, "mul", p, q), _joined(b, "mul", p, n)
    return x, 0.0


def _joined(b: Builder, op: str, x: Term, y: Term) -> Term:
    """The operation, without terms that are 0."""
    if _none(x) or _none(y):
        return 0.0 if op != "add" else y if _none(x) else x
    return calculate(b, op, x, y)


def _none(x: Term) -> bool:
    return not isinstance(x, Expression) and x == 0


def _reads(x: Expression) -> tuple[str, ...]:
    """The species, and "out." and signals, in an expression."""
    found: dict[str, None] = {}
    for node in x.walk():
        if node.op == NAME:
            kind, _, name = node.name.partition(".")
            found |= {name if kind == "u" else OUTSIDE + name: None} if kind in ("u", "s") else {}
    return tuple(found)
