"""The quantities of an SBML model: what each id stands for, at the start and later."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from torchfilm.circuits.equations import Term, numeric, operate
from torchfilm.circuits.expressions import NUMBER, Builder, Expression, tangents
from torchfilm.circuits.sbml.algebra import less, over
from torchfilm.circuits.sbml.choices import Choices, plain
from torchfilm.circuits.sbml.document import name_of
from torchfilm.circuits.sbml.mathml import Formulas, calculate
from torchfilm.tools.checks import InputError

COMPARTMENT, SPECIES, PARAMETER, STOICHIOMETRY = "compartment", "species", "parameter", "reference"
CLOCK = "u.model_time"
IMPLIED = "default_compartment"  # of Antimony, where a model has none


class NotConstant(Exception):
    """A formula that was to be a constant has a variable."""


class Quantities:
    """The ids of a model and what they stand for.

    constants: numbers that the equations read, by id, filled as formulas are translated. clock:
    whether a formula reads the time.
    """

    def __init__(self, model: Any, builder: Builder, formulas: Formulas, choices: Choices):
        self.model, self.builder, self.formulas, self.choices = model, builder, formulas, choices
        self.constants: dict[str, float] = {}
        self.clock = False
        self.things: dict[str, tuple[str, Any]] = {}
        for kind, found in (
            (COMPARTMENT, model.getListOfCompartments()),
            (SPECIES, model.getListOfSpecies()),
            (PARAMETER, model.getListOfParameters()),
        ):
            self.things |= {x.getId(): (kind, x) for x in found}
        self.reactions = {
            r.getId(): r for r in model.getListOfReactions() if r.getId() not in choices.without
        }
        for reaction in self.reactions.values():
            for side in (reaction.getListOfReactants(), reaction.getListOfProducts()):
                named = [x for x in side if x.isSetId() and x.getId()]
                self.things |= {x.getId(): (STOICHIOMETRY, x) for x in named}
        rules = [r for r in model.getListOfRules() if r.isSetMath()]
        self.assigned = {r.getVariable(): r.getMath() for r in rules if r.isAssignment()}
        self.driven = {r.getVariable(): r.getMath() for r in rules if r.isRate()}
        self.initial = {
            x.getSymbol(): x.getMath() for x in model.getListOfInitialAssignments() if x.isSetMath()
        }
        self.changes = self._changes()
        self._known: dict[str, Term] = {}
        self._first: dict[str, float] = {}
        self.used: set[str] = set()  # ids whose values were needed
        self._open: list[str] = []  # being worked out, to find loops

    def _changes(self) -> dict[str, list[tuple[str, Any, int]]]:
        """By species: the reactions that change it, with the reference and its sign."""
        found: dict[str, list[tuple[str, Any, int]]] = {}
        for name, reaction in self.reactions.items():
            for side, sign in ((reaction.getListOfReactants(), -1),
                               (reaction.getListOfProducts(), 1)):  # fmt: skip
                for reference in side:
                    species = reference.getSpecies()
                    thing = self.things[species][1]
                    if not (thing.getBoundaryCondition() or thing.getConstant()):
                        found.setdefault(species, []).append((name, reference, sign))
        return found

    # --- what an id is ------------------------------------------------------------------

    def is_variable(self, name: str) -> bool:
        """Whether an id is a variable of the circuit: it has a rate of its own."""
        kind, thing = self.things[name]
        if name in self.assigned or name in self.choices.signals or name in self.choices.cell:
            return False
        if name in self.driven:
            return True
        if kind != SPECIES:
            return False
        free = not (thing.getBoundaryCondition() or thing.getConstant())
        return free or self.size_changes(thing)

    def size_changes(self, species: Any) -> bool:
        """Whether the compartment of a species that holds a concentration changes its size."""
        home = species.getCompartment()
        if species.getHasOnlySubstanceUnits() or home in self.choices.cell:
            return False
        return home in self.driven or home in self.assigned

    def variables(self) -> list[str]:
        return [n for n in self.things if self.is_variable(n)]

    def column(self, name: str) -> str:
        """The name of a quantity in the circuit."""
        return self.choices.rename.get(name, name)

    # --- values later -------------------------------------------------------------------

    def value(self, name: str) -> Term:
        """What an id stands for in a formula."""
        if name not in self._known:
            self._known[name] = self._guarded(repr(name), name, lambda: self._value(name))
        return self._known[name]

    def _guarded(self, what: str, name: str, work: Callable[[], Any]) -> Any:
        """What `work` returns. what: what it works out of the id `name`, in words, for messages."""
        if what in self._open:
            loop = [*self._open[self._open.index(what) :], what]
            raise InputError(f"these depend on each other: {' → '.join(loop)}")
        self._open.append(what)
        try:
            return work()
        except InputError as error:
            said = str(error)
            if said.startswith(("in ", "these ")) or repr(name) in said:  # it says where
                raise
            raise InputError(f"in {what}: {error}") from error
        finally:
            self._open.pop()

    def _value(self, name: str) -> Term:
        b = self.builder
        if name in self.choices.cell:
            return self.choices.cell[name]
        if name in self.reactions:
            return self.law(name)
        if name not in self.things:
            raise InputError(f"the formula reads {name!r}, which the model does not define")
        kind, thing = self.things[name]
        if name in self.choices.signals:
            outside = b.name(f"s.{self.choices.signals[name]}")
            amount = thing.getHasOnlySubstanceUnits()
            return calculate(b, "mul", outside, self.size(thing)) if amount else outside
        if name in self.assigned:
            return self.formulas.of(self.assigned[name], self)
        if self.is_variable(name):
            return b.name(f"u.{self.column(name)}")
        if name in self.initial and name not in self.choices.values and kind != SPECIES:
            try:  # a constant that depends on other constants follows them
                follows = self.formulas.of(self.initial[name], _Constants(self))
                if isinstance(follows, Expression):  # and not a number, such as ln(2)/10
                    return follows
            except NotConstant:
                pass
        if name == IMPLIED and name not in self.choices.values and self.first(name) == 1:
            return 1.0
        one = plain(self.choices.values.get(name, 0.0))
        self.constants[name] = self.first(name) if one else 0.0
        return b.name(f"p.{self.column(name)}")

    def time(self) -> Term:
        if self.choices.cell_time:
            return self.builder.name("cell.time")
        self.clock = True
        return self.builder.name(CLOCK)

    def size(self, species: Any) -> Term:
        """The size of the compartment of a species; 1 where it has neither dimensions nor size."""
        home = self.home(species)
        return 1.0 if home is None else self.value(home)

    def home(self, species: Any) -> str | None:
        """The compartment of a species, if it has a size."""
        home = self.model.getCompartment(species.getCompartment())
        point = home.getSpatialDimensionsAsDouble() == 0 and not home.isSetSize()
        return None if point else home.getId()

    def stoichiometry(self, reference: Any) -> Term:
        """The number of molecules that an event makes or takes."""
        name = reference.getId() if reference.isSetId() else ""
        if name and (name in self.assigned or name in self.driven or name in self.initial):
            return self.value(name)
        if reference.isSetStoichiometryMath() and reference.getStoichiometryMath().isSetMath():
            return self.formulas.of(reference.getStoichiometryMath().getMath(), self)
        return self.given_stoichiometry(reference)

    @staticmethod
    def given_stoichiometry(reference: Any) -> float:
        level = reference.getLevel()
        if level > 2 and not reference.isSetStoichiometry():
            what = f"the stoichiometry of {reference.getSpecies()!r}"
            raise InputError(f"{what} is not given: give a number")
        found = float(reference.getStoichiometry()) / (reference.getDenominator() or 1)
        if not 0 <= found < float("inf"):
            said = f"the stoichiometry of {reference.getSpecies()!r} is {found:g}"
            raise InputError(f"{said}: it must be a number of at least 0")
        return found

    def law(self, name: str) -> float | Expression:
        """The rate of a reaction, in amounts per unit of the model's time."""
        own: dict[str, Term] = {}
        for id_, key, given in self.own_parameters(name):
            self.constants[key] = float(given) if plain(given) else 0.0
            own[id_] = self.builder.name(f"p.{self.column(key)}")
        return self.formulas.of(self.kinetic_law(name).getMath(), self, own)

    def kinetic_law(self, reaction: str) -> Any:
        law = self.reactions[reaction].getKineticLaw()
        if law is None or not law.isSetMath():
            raise InputError(f"the reaction {reaction!r} has no kinetic law: give it one")
        return law

    def own_parameters(self, reaction: str) -> Iterator[tuple[str, str, Any]]:
        """Of a kinetic law: the id of each parameter there, that by which it is given, its value"""
        law = self.kinetic_law(reaction)
        both = (law.getListOfParameters(), law.getListOfLocalParameters())
        for parameter in (x for part in both for x in part):
            key = self.local(reaction, parameter.getId())
            if key not in self.choices.values and not parameter.isSetValue():
                raise InputError(f"the parameter {parameter.getId()!r} has no value: give {key}=…")
            yield parameter.getId(), key, self.choices.values.get(key, parameter.getValue())

    def local(self, reaction: str, parameter: str) -> str:
        """The id under which a parameter of one kinetic law is known: unlike all others."""
        key = f"{reaction}_{parameter}"
        while key in self.things or key in self.reactions:
            key += "_"
        return key

    # --- rates --------------------------------------------------------------------------

    def slope(self, name: str) -> Term:
        """dx/dt of a quantity, in the model's time."""
        if name in self.things and self.is_variable(name):
            return self.rate(name)
        return self.change(self.value(name))

    def change(self, x: Term) -> Term:
        """dx/dt of an expression, by those of the variables in it."""
        if not isinstance(x, Expression):
            return 0.0
        b, columns = self.builder, {f"u.{self.column(n)}": n for n in self.variables()}
        slopes: dict[Expression, Expression] = {}
        for leaf in x.names():
            rate = 1.0 if leaf == CLOCK else self.rate(columns[leaf]) if leaf in columns else 0.0
            if isinstance(rate, Expression) or rate != 0:
                slopes[b.name(leaf)] = rate if isinstance(rate, Expression) else b.number(rate)
        found = tangents(b, [x], slopes).get(x, 0.0)
        plain = isinstance(found, Expression) and found.op == NUMBER
        return found.value if plain else found  # type: ignore[union-attr]

    def rate(self, name: str) -> float | Expression:
        """The rate of a variable, in the model's time."""
        key = f"the rate of {name!r}"
        if key not in self._known:
            self._known[key] = self._guarded(key, name, lambda: self._rate(name))
        return numeric(self.builder, self._known[key])

    def per_hour(self, rate: Term) -> Expression:
        """A rate in the model's time as one per hour."""
        b, factor = self.builder, self.choices.per_hour
        made = rate if factor == 1 else calculate(b, "mul", factor, rate)
        return made if isinstance(made, Expression) else b.number(float(made))

    def _rate(self, name: str) -> Term:
        b = self.builder
        if name in self.driven:
            return self.formulas.of(self.driven[name], self)
        thing = self.things[name][1]
        amounts = thing.getHasOnlySubstanceUnits()
        total = self.gained(name, 1.0 if amounts else self.size(thing))
        if not amounts and self.size_changes(thing):
            size = self.size(thing)
            own = calculate(b, "mul", self.value(name), over(b, self.change(size), size))
            total = less(b, total, own)
        return total

    def gained(self, name: str, size: Term) -> Term:
        """What all reactions change of a species, over a size."""
        total: Term | None = None
        for reaction, reference, sign in self.changes.get(name, ()):
            b, part = self.builder, over(self.builder, self.value(reaction), size)
            count = self.stoichiometry(reference)
            factor = self.conversion(name)
            count = count if factor is None else calculate(b, "mul", count, factor)
            if not isinstance(count, (int, float)) or count != 1:
                part = calculate(b, "mul", count, part)
            if total is None:
                total = part if sign > 0 else calculate(b, "neg", part)
            else:
                total = calculate(b, "add" if sign > 0 else "sub", total, part)
        return 0.0 if total is None else total

    def conversion(self, species: str) -> Term | None:
        """The factor from the extent of reactions to the substance of a species."""
        thing = self.things[species][1]
        own = thing.getConversionFactor() if self.model.getLevel() > 2 else ""
        both = own or (self.model.getConversionFactor() if self.model.getLevel() > 2 else "")
        return self.value(both) if both else None

    # --- values at the start ------------------------------------------------------------

    def first(self, name: str) -> float:
        """The value of a quantity at the start, as a number."""
        if name not in self._first:
            what = f"the first value of {name!r}"
            self._first[name] = self._guarded(what, name, lambda: self._first_value(name))
        return self._first[name]

    def _first_value(self, name: str) -> float:
        chosen = self.choices.first if self.is_variable(name) else self.choices.values
        self.used.add(name)
        if name in chosen:
            return _one_number(name, chosen[name])
        at_start = _Start(self)
        for formula in (self.initial.get(name), self.assigned.get(name)):
            if formula is not None:
                return float(self.formulas.of(formula, at_start))  # type: ignore[arg-type]
        kind, thing = self.things[name]
        if kind == SPECIES:
            return self._first_of_species(name, thing)
        if kind == STOICHIOMETRY:
            return self.given_stoichiometry(thing)
        found = thing.getSize() if kind == COMPARTMENT else thing.getValue()
        is_set = thing.isSetSize() if kind == COMPARTMENT else thing.isSetValue()
        if kind == COMPARTMENT and self.model.getLevel() == 1:
            is_set = True  # 1 is the default there
        if not is_set:
            raise InputError(f"the {kind} {name_of(thing)} has no value: give {name}=…")
        if kind == COMPARTMENT and found == 0:
            raise InputError(f"the compartment {name!r} has a size of 0: give {name}=…")
        return float(found)

    def _first_of_species(self, name: str, species: Any) -> float:
        amounts = species.getHasOnlySubstanceUnits()
        if species.isSetInitialAmount():
            found, is_amount = species.getInitialAmount(), True
        elif species.isSetInitialConcentration():
            found, is_amount = species.getInitialConcentration(), False
        else:
            what = f"the species {name!r} has no first value"
            raise InputError(f"{what}: give initial={{{name!r}: …}}")
        if is_amount == amounts:
            return float(found)
        size = float(_Start(self).size(species))
        return found * size if amounts else found / size


def _one_number(name: str, value: Any) -> float:
    if not plain(value):
        what = f"the model computes first values from {name!r}, so it must be one number"
        raise InputError(f"{what} here: give what depends on it by initial={{…}}")
    return float(value)


class _Start:
    """What names stand for at the start: numbers."""

    def __init__(self, quantities: Quantities):
        self.quantities = quantities

    def value(self, name: str) -> Term:
        quantities = self.quantities
        if name in quantities.choices.cell:
            raise InputError(
                f"a first value depends on {name!r}, which differs between cells: give it by"
                " initial={…}"
            )
        if name in quantities.reactions:
            each = quantities.own_parameters(name)
            own: dict[str, Term] = {id_: _one_number(key, value) for id_, key, value in each}
            return quantities.formulas.of(quantities.kinetic_law(name).getMath(), self, own)
        if name not in quantities.things:
            raise InputError(f"the formula reads {name!r}, which the model does not define")
        return quantities.first(name)

    def size(self, species: Any) -> float:
        home = self.quantities.home(species)
        return 1.0 if home is None else float(self.value(home))  # type: ignore[arg-type]

    def time(self) -> Term:
        return 0.0

    def slope(self, name: str) -> Term:
        """A rate at the start, of what it depends on there."""
        rate = self.quantities.slope(name)
        return rate if not isinstance(rate, Expression) else self._evaluated(rate)

    def _evaluated(self, root: Expression) -> float:
        quantities = self.quantities
        made: dict[Expression, Term] = {}
        columns = {quantities.column(n): n for n in quantities.things}
        for node in root.walk():
            if node.op == "number":
                made[node] = node.value
            elif node.op == "name":
                own = node.name.partition(".")[2]
                at_zero = node.name == CLOCK
                made[node] = (
                    0.0 if at_zero
                    else quantities.constants[own] if own in quantities.constants
                    else self.value(columns[own])
                )  # fmt: skip
            else:
                given = [made[a] for a in node.args]
                made[node] = operate(quantities.builder, node.op, *given)
        return float(made[root])  # type: ignore[arg-type]


class _Constants:
    """What names stand for in a constant. Raises NotConstant for what changes."""

    def __init__(self, quantities: Quantities):
        self.quantities = quantities

    def value(self, name: str) -> Term:
        found = self.quantities.value(name) if name in self.quantities.things else None
        if found is None:
            raise NotConstant
        changes = isinstance(found, Expression) and any(
            not leaf.startswith("p.") for leaf in found.names()
        )
        if changes:
            raise NotConstant
        return found

    def time(self) -> Term:
        raise NotConstant

    def slope(self, name: str) -> Term:
        raise NotConstant
