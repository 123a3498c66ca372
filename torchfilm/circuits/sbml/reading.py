"""From an SBML model to what a circuit is made of."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from torchfilm.circuits.equations import Equations, Term
from torchfilm.circuits.expressions import Builder, Expression
from torchfilm.circuits.names import unknown
from torchfilm.circuits.reactions import Reaction
from torchfilm.circuits.sbml import molecules, own_marks, units
from torchfilm.circuits.sbml.choices import Choices
from torchfilm.circuits.sbml.document import open_model
from torchfilm.circuits.sbml.mathml import Formulas, Function, calculate
from torchfilm.circuits.sbml.quantities import CLOCK, PARAMETER, SPECIES, Quantities
from torchfilm.tools.checks import InputError, input_error

# Properties of a cell that an id of a model may stand for, with the power of µm that they are.
PROPERTIES = {"volume": 3, "area": 2, "length": 1, "radius": 1, "x": 1, "y": 1, "z": 1}
RATE = "growth_rate"  # 1/h
TIME = CLOCK.removeprefix("u.")
# Words of `from_sbml` and `to_sbml`, which no id can be.
OPTIONS = (
    "self", "cls", "path", "text", "signals", "properties", "without", "time_unit", "species",
    "rates", "initial", "dilution", "cell_type", "values",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Given:
    """What the user says of a model; see `Circuit.from_sbml`. values: of constants. molecules:
    whether it is to run molecule by molecule. options: names that no id can have in the circuit.
    fields: names that no variable can have."""

    signals: Mapping[str, str]
    properties: Mapping[str, str]
    without: Sequence[str]
    time_unit: str | None
    values: Mapping[str, Any]
    initial: Mapping[str, Any]
    molecules: bool = False
    options: Collection[str] = ()
    fields: Collection[str] = ()


@dataclass(frozen=True, eq=False)
class Description:
    """A model as a circuit: its rates or reactions, variables, their first values and constants by
    name, and the variables that growth dilutes. quantities: what its ids stand for."""

    rates: Equations | list[Reaction]
    species: tuple[str, ...]
    initial: Mapping[str, Any]
    parameters: Mapping[str, Any]
    diluted: tuple[str, ...]
    quantities: Quantities
    document: Any  # libsbml's, of which `quantities` reads parts


def describe(text: str, where: str, given: Given) -> Description:
    """A model, as SBML text, as a circuit. where: the file, for messages.

    Raises InputError, naming the file and the element, for what cannot be read or simulated.
    """
    with _named(where):
        document, quantities, marks = _opened(text, where, given)
        return _describe(document, quantities, marks, given)


def variable_names(text: str, where: str, given: Given) -> list[str]:
    """The names of a model's variables, as its circuit will have them, without any value of the
    model. Errors as of `describe`."""
    with _named(where):
        quantities = _opened(text, where, given)[1]
        return [quantities.column(n) for n in quantities.variables()]


@contextmanager
def _named(where: str) -> Iterator[None]:
    """Errors of a model begin with the name of its file."""
    try:
        yield
    except RecursionError as error:
        raise InputError(f"{where}: a formula is nested too deeply, or calls itself.") from error
    except InputError as error:
        said = str(error)
        if said.startswith(where):
            raise
        raise InputError(f"{where}: {said.rstrip('.')}.") from error


def _opened(text: str, where: str, given: Given) -> tuple[Any, Quantities, own_marks.Marks]:
    """libsbml's document, which must be kept, and the quantities of its model."""
    document = open_model(text, where)
    model = document.getModel()
    units.check_laws(model)
    builder = Builder()
    marks = own_marks.of(model)
    rename = {**_renamed(model, given), **marks.names}
    by_id = _by_id(rename)
    per_hour = units.hours(model, given.time_unit)
    choices = Choices(
        signals=_signals(model, {**marks.signals, **given.signals}),
        cell=_cell(model, builder, marks, given.properties, per_hour),
        values=by_id(given.values),
        first=by_id(given.initial),
        without=frozenset(_known_reactions(model, given.without)),
        per_hour=per_hour,
        rename=rename,
        cell_time=marks.cell_time,
    )
    formulas = Formulas(builder, _functions(model, builder))
    return document, Quantities(model, builder, formulas, choices), marks


def _by_id(rename: Mapping[str, str]) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
    """A function from values by name in the circuit to values by id in the model."""
    back = {new: old for old, new in rename.items()}
    return lambda found: {back.get(n, n): x for n, x in found.items()}


def _describe(
    document: Any, quantities: Quantities, marks: own_marks.Marks, given: Given
) -> Description:
    variables = _ordered(quantities)
    names = {n: quantities.column(n) for n in variables}
    rates: Equations | list[Reaction]
    if given.molecules:
        for reaction in quantities.reactions if not marks else ():
            if any(reaction in (c[0] for c in x) for x in quantities.changes.values()):
                _check_place(quantities, reaction)
        size = lambda: _reference(quantities, variables)
        rates, read = molecules.reactions(quantities, tuple(names.values()), size)
    else:
        rates, read = _equations(quantities, names, bool(marks))
    initial = {new: _first(quantities, old, given.initial) for old, new in names.items()}
    if quantities.clock:
        names[TIME], initial[TIME] = TIME, 0.0
    if not names:
        raise InputError("nothing in the model changes: it has no reaction and no rate rule")
    _check_given(quantities, given)
    things = quantities.things
    diluted = {new: old for old, new in names.items()
               if old in things and things[old][0] == SPECIES}  # fmt: skip
    for old in diluted.values() if not marks else ():
        _check_amount(quantities, old)
    return Description(
        rates,
        tuple(names.values()),
        initial,
        _constants(quantities, read, bool(marks)),
        tuple(n for n in diluted if n not in marks.undiluted),
        quantities,
        document,
    )


def _equations(
    quantities: Quantities, names: Mapping[str, str], ours: bool
) -> tuple[Equations, list[Expression]]:
    """The rates of the variables, by their names in the circuit, and of signals, and all of them as
    expressions."""
    rates = {n: quantities.per_hour(quantities.rate(n)) for n in names}
    releases = dict(_releases(quantities, tuple(names), ours))
    species = dict(names)
    if quantities.clock:
        rates[TIME], species[TIME] = quantities.builder.number(quantities.choices.per_hour), TIME
    made = {species[n]: e for n, e in rates.items() if not e.is_number(0)}
    equations = Equations.of(_title(quantities.model), tuple(species.values()), made, releases)
    return equations, [*made.values(), *releases.values()]


def _title(model: Any) -> str:
    """What a circuit's messages call the model; Antimony calls one without a name __main."""
    own = model.getIdAttribute()
    return own if own and own != "__main" else "model"


def _renamed(model: Any, given: Given) -> dict[str, str]:
    """New names for ids that torchfilm uses itself, or that Python hides: with underscores."""
    parts = (model.getListOfCompartments(), model.getListOfSpecies(),
             model.getListOfParameters(), model.getListOfReactions())  # fmt: skip
    ids = [x.getIdAttribute() for part in parts for x in part]
    variables = {x.getId() for x in model.getListOfSpecies()}
    variables |= {r.getVariable() for r in model.getListOfRules() if r.isRate()}
    found: dict[str, str] = {}
    for name in ids:
        taken = {TIME, *OPTIONS, *given.options, *(given.fields if name in variables else ())}
        new = f"id{name}" if name.startswith("__") else name
        while new in taken or (new != name and new in ids):
            new += "_"
        if new != name:
            found[name] = new
    return found


def _functions(model: Any, builder: Builder) -> dict[str, Function]:
    found: dict[str, Function] = {}
    formulas = Formulas(builder, found)
    for definition in model.getListOfFunctionDefinitions():
        if not definition.isSetMath() or definition.getBody() is None:
            continue
        count = definition.getNumArguments()
        names = tuple(definition.getArgument(k).getName() for k in range(count))
        own = own_marks.operation(definition, formulas)
        found[definition.getId()] = Function(names, definition.getBody(), own)
    return found


def _signals(model: Any, signals: Mapping[str, str]) -> dict[str, str]:
    """Names of signals by id of species, checked."""
    known = [x.getId() for x in model.getListOfSpecies()]
    rules = {r.getVariable() for r in model.getListOfRules()}
    for name, signal in signals.items():
        if name not in known:
            raise InputError(unknown(f"signals names {name!r}, which is no species", name, known))
        if not (isinstance(signal, str) and signal.isidentifier()):
            raise input_error(f"signals[{name!r}]", signal, "the name of a signal")
        if name in rules:
            raise InputError(
                f"the signal {name!r} has a rule: the medium decides what a signal outside does"
            )
    return dict(signals)


def _cell(
    model: Any, builder: Builder, marks: own_marks.Marks, cell: Mapping[str, str], per_hour: float
) -> dict[str, Term]:
    """Terms by the ids that stand for properties of a cell."""
    found: dict[str, Term] = {n: builder.name(f"cell.{own}") for n, own in marks.cell.items()}
    for name, own in cell.items():
        compartment, parameter = model.getCompartment(name), model.getParameter(name)
        if compartment is None and parameter is None:
            raise input_error(
                f"properties[{name!r}]", own, "for a compartment or parameter of the model"
            )
        if own == RATE:
            found[name] = calculate(builder, "div", builder.name(f"cell.{own}"), per_hour)
            continue
        if own not in PROPERTIES:
            raise input_error(
                f"properties[{name!r}]", own, f"one of {', '.join((*PROPERTIES, RATE))}"
            )
        unit = (parameter if compartment is None else compartment).getUnits()
        if not unit and compartment is not None and model.getLevel() > 2:
            unit = model.getVolumeUnits()
        factor = units.micrometres(model, unit, PROPERTIES[own], repr(name))
        column = builder.name(f"cell.{own}")
        found[name] = column if factor == 1 else calculate(builder, "mul", factor, column)
    return found


def _known_reactions(model: Any, names: Sequence[str]) -> Sequence[str]:
    known = [x.getId() for x in model.getListOfReactions()]
    for name in names:
        if name not in known:
            raise InputError(unknown(f"without names {name!r}, which is no reaction", name, known))
    return names


def _ordered(quantities: Quantities) -> list[str]:
    """The variables, species first."""
    found = quantities.variables()
    return sorted(found, key=lambda n: quantities.things[n][0] != SPECIES)


def _releases(
    quantities: Quantities, variables: Sequence[str], ours: bool
) -> Iterator[tuple[str, Expression]]:
    """What a cell gives to each signal, conc·µm³/h.

    A reaction changes the concentration in the reference cell of the model by its rate over the
    size of that cell. So this is what a cell gives, times its own volume.
    """
    b = quantities.builder
    changed = [n for n in quantities.choices.signals if n in quantities.changes]
    if not changed:
        return
    for name in changed if not ours else ():
        for reaction, _, _ in quantities.changes[name]:
            _check_place(quantities, reaction)
    size, volume = _reference(quantities, variables), b.name("cell.volume")
    follows = isinstance(size, Expression) and volume in set(size.walk())
    for name in changed:
        if follows:  # the model's volume is the cell's, up to a unit
            assert isinstance(size, Expression)
            total = quantities.gained(name, 1.0)
            if size is not volume:
                total = calculate(b, "div", total, size.args[0])
        else:
            total = calculate(b, "mul", quantities.gained(name, size), volume)
        assert isinstance(total, (float, int, Expression))
        yield quantities.choices.signals[name], quantities.per_hour(total)


def _check_place(quantities: Quantities, reaction: str) -> None:
    """Refuse a reaction of signals alone: it happens in the medium, not in each cell."""
    one, signals = quantities.reactions[reaction], quantities.choices.signals
    sides = (one.getListOfReactants(), one.getListOfProducts(), one.getListOfModifiers())
    others = [x.getSpecies() for side in sides for x in side if x.getSpecies() not in signals]
    if not others:
        raise InputError(
            f"the reaction {reaction!r} happens outside of cells: leave it out,"
            f" without=({reaction!r},), and describe it in the medium, by tf.Signal(decay=…) or"
            " tf.MediumReactions(…)"
        )


def _reference(quantities: Quantities, variables: Sequence[str]) -> Term:
    """The size of the compartment that is the cell."""
    model, kinds = quantities.model, quantities.things
    mapped = [c.getId() for c in model.getListOfCompartments()
              if c.getId() in quantities.choices.cell]  # fmt: skip
    homes = mapped or list(
        dict.fromkeys(kinds[n][1].getCompartment() for n in variables if kinds[n][0] == SPECIES)
    )
    if len(homes) != 1:
        raise InputError(
            f"the model has the compartments {', '.join(homes) or 'of signals only'}: say which is"
            ' the cell, such as properties={"cytosol": "volume"}'
        )
    return quantities.value(homes[0])


def _check_amount(quantities: Quantities, name: str) -> None:
    """Refuse an amount in a compartment that is a property of the cell: growth dilutes the numbers
    of species, which would have to be concentrations."""
    species = quantities.things[name][1]
    home = species.getCompartment()
    if species.getHasOnlySubstanceUnits() and home in quantities.choices.cell:
        raise InputError(
            f"{name!r} is an amount (substanceOnly), and its compartment {home!r} a property of the"
            " cell: make it a concentration, or leave the property out"
        )


def _first(quantities: Quantities, name: str, initial: Mapping[str, Any]) -> Any:
    """A first value: the user's, or a number of the model."""
    column = quantities.column(name)
    if column in initial:
        return initial[column]
    found = quantities.first(name)
    if not found >= 0:
        raise InputError(
            f"{name!r} is {found:g} at the start: concentrations in torchfilm are never below 0"
        )
    return found


def _constants(quantities: Quantities, rates: Sequence[Expression], ours: bool) -> dict[str, Any]:
    """The constants that the rates read, in the model's order; all, where torchfilm wrote it."""
    kinds, choices = quantities.things, quantities.choices
    listed = [n for n, (kind, _) in kinds.items() if kind == PARAMETER and n not in choices.cell]
    for name in listed if ours else ():
        quantities.value(name)
    read = {n for e in rates for n in e.names("p")}
    order = [n for n in kinds if n in quantities.constants]
    order += [n for n in quantities.constants if n not in kinds]
    both = {n: choices.values.get(n, quantities.constants[n]) for n in order}
    columns = {quantities.column(n): x for n, x in both.items()}
    return {n: x for n, x in columns.items() if ours or n in read}


def _check_given(quantities: Quantities, given: Given) -> None:
    """Raise InputError for a value that nothing reads."""
    names = {quantities.column(n): n for n in quantities.things}
    constants = [quantities.column(n) for n in quantities.constants]
    for name in given.values:
        own = names.get(name, name)
        if own in quantities.things and quantities.is_variable(own):
            first = f"initial={{{quantities.column(own)!r}: …}}"
            raise InputError(f"{name!r} is a variable: give its first value, {first}")
        if name in constants or own in quantities.used:
            continue
        if own in quantities.things:
            raise InputError(f"{name!r} is no constant that an equation reads: leave it out")
        raise InputError(unknown(f"the model has no constant {name!r}", name, constants))
    variables = [quantities.column(n) for n in quantities.variables()]
    for name in given.initial:
        if name not in variables:
            what = f"initial names {name!r}, which is no variable of the model"
            raise InputError(unknown(what, name, variables))
