"""Checks of what a circuit is given."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Container, Iterable, Mapping, Sequence, Set
from contextlib import suppress
from numbers import Integral, Real
from typing import Any

from torch import Tensor

from torchfilm.circuits import integrators
from torchfilm.circuits.dilution import written_dilution
from torchfilm.circuits.graph import graph_of
from torchfilm.circuits.names import label_of, unknown
from torchfilm.circuits.reactions import Reaction
from torchfilm.signals.schedule import Schedule
from torchfilm.state import OUTSIDE, PER_CELL, RESERVED, State
from torchfilm.tools import checks, units
from torchfilm.tools.row_checks import check_field, is_name
from torchfilm.tools.warn_once import warn
from torchfilm.values import COLONY, FORMS, Rule, checked, numbers

STIFF, LEAP, DIRECT = "rosenbrock", "tau_leap", "direct"
EXPLICIT = ("euler", *integrators.METHODS)
METHODS = (STIFF, *EXPLICIT, LEAP, DIRECT)
# what others call methods of the same use: Gillespie's algorithm, and one for stiff rates
OTHER_NAMES = dict.fromkeys(("gillespie", "ssa"), DIRECT)
OTHER_NAMES |= dict.fromkeys(("stiff", "bdf", "lsoda", "cvode"), STIFF)
GEOMETRY = ("volume", "area", "x", "y", "z")
# Fields that effects read where there are any, by what they are for.
READ_BY_OTHERS = {"drag": "mechanics takes 'drag' as how much a cell resists motion"}


def equations_of(circuit: Any) -> dict[str, str]:
    """The equations of a circuit as text, by title, or why they cannot be written."""
    note = left_out(circuit)
    where = f"{circuit.value_owner()}{note and ', ' + note}"
    try:
        graphs = circuit.graphs
    except checks.InputError as why:
        return {where: str(why)}
    of_type = lambda kind: f", in cells of type {kind}" if isinstance(kind, int) else ""
    return {where + of_type(kind): graph.equations for kind, graph in graphs.items()}


def left_out(circuit: Any) -> str:
    """What the equations of a circuit do not show, in words; "" where they show all."""
    return "before dilution by growth" if circuit.dilution else ""


def names_of(species: Sequence[str], what: str = "species") -> tuple[str, ...]:
    """Names of species, checked."""
    rule, given = "a tuple of different names, at least one", f"Circuit.{what}"
    if isinstance(species, Mapping | Set):
        hint = f"Write {what}={tuple(species)}."
        if isinstance(species, Mapping):
            hint += f" First levels go into initial={dict(species)}."
        raise checks.input_error(given, species, rule, hint)
    names = (species,) if isinstance(species, str) else tuple(species)
    wrong = [n for n in names if not is_name(n)]
    if wrong:
        apart = tuple(species.replace(",", " ").split()) if isinstance(species, str) else ()
        hint = f"{wrong[0]!r} is none: it may have letters, digits and _ only, as in u.NAME."
        if apart and all(map(is_name, apart)):
            hint = f"Pass a tuple of names: {what}={apart}."
        raise checks.input_error(given, species, rule, hint)
    if not names or len(set(names)) < len(names):
        raise checks.input_error(given, species, rule)
    return names


def check_species(names: tuple[str, ...], shared: Mapping[str, str]) -> None:
    taken = [n for n in (*names, *shared) if n in (*RESERVED, *GEOMETRY, *READ_BY_OTHERS)]
    if taken:
        raise checks.input_error(
            "Circuit.species",
            taken[0],
            "a name that cells do not have already",
            f"{_meaning(taken[0])}; call the species {taken[0]}_, or by another name.",
        )
    both = [n for n in names if n in shared]
    if both:
        raise checks.input_error("Circuit.shared", both[0], "no species of the circuit's own")


def _meaning(name: str) -> str:
    """What a name that is in use stands for, in words."""
    if name in READ_BY_OTHERS:
        return READ_BY_OTHERS[name]
    if name in ("x", "y", "z"):
        return f"{name!r} is the place of a cell"
    of_cells = name in (*PER_CELL, *GEOMETRY)
    return f"{name!r} is the {name} of a cell" if of_cells else f"the state uses {name!r} itself"


def mass_action_constants(part: object) -> set[str]:
    """The names of parameters that are constants of mass action, in a part of a circuit."""
    if isinstance(part, Reaction):
        return {part.rate} if isinstance(part.rate, str) else set()
    each = part if isinstance(part, (list, tuple)) else ()
    return set().union(*map(mass_action_constants, each))


def check_rates(by_type: Mapping[int | str, Any], typed: bool) -> None:
    for kind, part in by_type.items():
        if typed and (isinstance(kind, bool) or not isinstance(kind, Integral)):
            raise checks.input_error("Circuit.rates", kind, "by cell types that are integers")
        reactions = part if isinstance(part, (list, tuple)) else ()
        for one in reactions:
            if isinstance(one, Reaction) and isinstance(one.rate, Schedule):
                rule = "a number, a name of a constant, or a function (u, s, p, cell)"
                hint = "Name a constant, rate='light', and give it: Circuit(…, light=schedule)."
                raise checks.input_error(f"rate of Reaction {one}", one.rate, rule, hint)
        if not callable(part) and not (isinstance(part, (list, tuple)) and part):
            raise checks.input_error(
                "Circuit.rates",
                part,
                "a function (u, s, p, cell), a list of reactions, or a dict of either by cell type",
            )


def no_cells_of(owner: str, kinds: Sequence[int], there: Sequence[int]) -> str:
    """The warning of rates for types of cells of which there are none."""
    types = ", ".join(map(str, kinds))
    return (
        f"{owner} has rates for cells of type {types}, of which there are none, and nothing sets"
        f" cell_type: the first cells are of type {', '.join(map(str, there))}. Leave these rates"
        " out, or give founders=tf.Cells(…, cell_type=[…])."
    )


def check_initial(initial: object, names: tuple[str, ...]) -> None:
    if initial is not None and not isinstance(initial, Mapping):
        raise checks.input_error(
            "Circuit.initial", initial, f"a dict by species, such as {{{names[0]!r}: 1.0}}"
        )
    for name in initial or {}:
        if name not in names:
            raise checks.InputError(
                unknown(f"Circuit.initial names {name!r}, which is no species", name, names)
            )


def shared_fields(given: Sequence[str] | Mapping[str, str]) -> dict[str, str]:
    """Species of another circuit, by the name here, with their fields."""
    if isinstance(given, Mapping):
        return dict(given)
    return {n: n for n in names_of(given, "shared")} if given else {}


def check_constants(given: Mapping[str, Any], options: Sequence[str]) -> None:
    for name, value in given.items():
        near = checks.nearest(name, options) or ("concentration_unit" if name == "unit" else "")
        # a dict by names is meant for an option such as `initial`; a constant goes by cell types
        by_names = isinstance(value, Mapping) and any(isinstance(key, str) for key in value)
        function = callable(value) and not isinstance(value, Schedule)
        if isinstance(value, str) or function or (near and by_names):
            hint = f"Did you mean {near}?" if near else FORMS
            if function and not near:
                hint += " What changes in time is a Schedule, or in place a rate of cell.x."
            allowed = "a constant of the rates, as further keywords are"
            raise checks.input_error(f"Circuit.{name}", value, allowed, hint)


def check_method(method: str, steps: int, by_type: Mapping[int | str, Any]) -> None:
    if isinstance(method, str) and (ours := OTHER_NAMES.get(method.lower())):
        rule = f"one of {', '.join(map(repr, METHODS))}"
        raise checks.input_error(
            "Circuit.method", method, rule, f"Write {ours!r}, which serves the same use."
        )
    checks.choice("Circuit.method", method, METHODS)
    checks.integer("Circuit.steps", steps, least=1)
    functions = [part for part in by_type.values() if callable(part)]
    if method in (LEAP, DIRECT) and functions:
        raise checks.input_error(
            "Circuit.method",
            method,
            f"for reactions; {getattr(functions[0], '__name__', 'a function')} gives rates",
            "Write the circuit as a list of reactions.",
        )


def _some_names(option: str, given: Any) -> tuple[str, ...]:
    """Names of species, each once, as an option has them. Raises InputError for what is no name."""
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, (tuple, list)) or not all(isinstance(n, str) for n in names):
        rule = "names of species" + (", True or False" if option == "dilution" else "")
        raise checks.input_error(f"Circuit.{option}", given, rule)
    return tuple(dict.fromkeys(names))


def diluted_names(
    given: bool | Sequence[str], species: Sequence[str], method: str
) -> bool | tuple[str, ...]:
    """The option `dilution`: True, False, or the names of the species that growth dilutes."""
    if not isinstance(given, bool):
        given = _some_names("dilution", given)
        for name in given:
            if name not in species:
                what = f"Circuit.dilution names {name!r}, which is no species"
                raise checks.InputError(unknown(what, name, species))
        given = True if len(given) == len(species) else given or False
    if given is not True and method in (LEAP, DIRECT):
        raise checks.input_error(
            "Circuit.dilution", given, "True where molecules are counted", "Their number is kept."
        )
    return given


def check_replicated(
    given: Sequence[str], species: Sequence[str], diluted: bool | tuple[str, ...]
) -> tuple[str, ...]:
    """The option `replicated`: names of species of which each daughter has its parent's number."""
    names = _some_names("replicated", given)
    for name in names:
        if name not in species:
            what = f"Circuit.replicated names {name!r}, which is no species"
            raise checks.InputError(unknown(what, name, species))
        if diluted is not True and name not in (diluted or ()):
            rule = f"of species whose amounts stay as cells grow: {name!r} is not diluted"
            raise checks.input_error("Circuit.replicated", names, rule, "Add it to dilution.")
    return names


def _is_one(given: Any) -> bool:
    """Whether it is the number that circuits have which count no molecules."""
    return isinstance(given, Real) and given == 1


def molecules_in(unit: str, given: Any, method: str) -> Any:
    """The option `molecules_per_unit`, by default that of the unit of concentrations where
    molecules are counted, and 1 elsewhere, where nothing reads it."""
    counts = method in (LEAP, DIRECT)
    name, known = "Circuit.molecules_per_unit", units.MOLECULES.get(unit) if counts else None
    if counts and unit in units.MASSES and (given is None or _is_one(given)):
        raise checks.InputError(
            f"{name} is missing: how many molecules there are in 1 {unit} × µm³ depends on their"
            " mass."
        )
    if given is None:
        return known or 1.0
    made = checked(name, given, Rule(above=0.0, scope=COLONY))
    apart = 0.0 if known is None else float((numbers(made).detach() / known - 1.0).abs().max())
    if apart > units.CLOSE:
        rule = f"about {known:.4g} where concentration_unit = {unit!r}, which it is by default"
        hint = "Leave one of the two out; in a copy by dataclasses.replace give None."
        raise checks.input_error(name, given, rule, hint)
    return made


def _check_units(circuit: Any, exchanged: Mapping[Any, Iterable[str]], state: State) -> None:
    """Raise InputError where a circuit and a signal that it exchanges, or a species that it shares,
    have different units."""
    names = dict.fromkeys(OUTSIDE + n for each in exchanged.values() for n in each)
    for name in (*names, *circuit.shared.values()):
        there = state.declared[name].unit  # of a variable, no concentration, it may be none
        if units.is_concentration(there) and units.differ(circuit.concentration_unit, there):
            what = "exchanges the signal" if name in names else "shares the species"
            raise checks.InputError(
                f"{circuit.value_owner()} is in {circuit.concentration_unit}, and {what}"
                f" {name.removeprefix(OUTSIDE)!r}, which is in {there}: nothing converts one to the"
                " other, so that both need one unit."
            )


def warn_of_gradients(circuit: Any, networks: Iterable[Any], tracked: bool) -> None:
    """Warn where molecules are counted and a gradient is wanted: by values, `tracked`, or by rates
    of reactions."""
    rates = [x.rate for network in networks for x in network.reactions]
    tracked |= any(isinstance(x, Tensor) and x.requires_grad for x in rates)
    if circuit.is_stochastic and tracked:
        warn(
            f"Circuit.method = {circuit.method!r} passes no gradient on: numbers of molecules are"
            " whole. Its constants or first values require one; detach them, or take the default"
            " method."
        )


def check_levels(circuit: Any, fields: Mapping[str, Tensor], free: Container[str]) -> None:
    """Raise InputError where a state that is given has a level below 0, which is not `free`; by
    other methods one may come there."""
    for name in circuit.variables.values() if circuit.method in (STIFF, LEAP, DIRECT) else ():
        if name not in free:
            check_field(fields, name, lambda x: x < 0, "at least 0")


def check_read(
    circuit: Any, seen: Mapping[str, set[str]], state: State,
    exchanged: Mapping[Any, Iterable[str]],
) -> None:  # fmt: skip
    """Raise InputError for a constant of a circuit that looks like another name, and for signals
    exchanged, by cell type, in another unit; warn of a constant that no rate reads, and of
    dilution that is counted twice. seen: the names that rates read, of constants, "p", and of
    cells, "cell"."""
    _check_units(circuit, exchanged, state)
    given, read = circuit.parameters, seen["p"]
    growth = state.declared.get("growth_rate")
    if circuit.dilution and "growth_rate" in seen["cell"] and growth and "1/h" in growth.unit:
        _warn_of_dilution(circuit)
    own = {f.name for f in dataclasses.fields(circuit)}
    options = sorted(own - {"rates", "species", "parameters"})
    for name in given:
        if name in read:
            continue
        near = difflib.get_close_matches(name, options, 1, 0.75)
        if near:
            raise checks.InputError(
                f"Circuit.{name} is a constant that no rate reads. Did you mean the option"
                f" {near[0]}?"
            )
        known = [n for n in read if n not in given]
        like = difflib.get_close_matches(name, known, 1)
        hint = f". Did you mean {like[0]!r}?" if like else f": remove it, or use it as p.{name}."
        warn(f"Circuit.{name} is a constant that no rate reads{hint}")


def _warn_of_dilution(circuit: Any) -> None:
    """Warn where rates lose what growth dilutes besides. Rates that cannot be written as equations
    are not looked at."""
    diluted = circuit.species if circuit.dilution is True else circuit.dilution
    counts = circuit.method in (LEAP, DIRECT)  # all are diluted
    for name in dict.fromkeys(n for n in _written(circuit) if n in diluted):
        warn(
            f"{circuit.value_owner()}: the rate of {name!r} loses cell.growth_rate·{name}, and"
            " growth dilutes it besides. If that term is dilution, it counts twice: leave it out"
            f" of the rates{'' if counts else f', or {name!r} out of dilution=…'}."
        )


def _written(circuit: Any) -> list[str]:
    """The species whose rates lose cell.growth_rate times their level."""
    names, known, found = (tuple(circuit.variables), tuple(circuit.parameters)), {}, []
    for name, x in circuit.parameters.items():
        if isinstance(x, Real) or (isinstance(x, Tensor) and x.numel() == 1):
            known[f"p.{name}" if name in circuit.variables else name] = float(x)
    for part in circuit.rates.values():
        graph = None
        # a function may do with equations what it likes; `circuit.graphs` says what
        with suppress(Exception):
            graph = graph_of(part, *names, label_of(part))
        found += written_dilution(graph, known) if graph else []
    return found
