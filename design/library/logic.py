"""Wirings of NOR gates: from a truth table, or as the user lists them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from graphlib import CycleError, TopologicalSorter

import torchfilm as tf
from torchfilm import checks

MOST_GATES = 7  # of wirings that are looked for; eight gates of three inputs take minutes
MOST_INPUTS = 3
MOST_PROMOTERS = 2  # in front of one gene, as in published libraries

Pair = tuple[int, int]


@dataclass(frozen=True)
class Netlist:
    """Which promoters stand in front of which gene.

    inputs: names of input promoters. genes: by each gate the one or two promoters in front of its
    repressor, gates after those that they read: a gate's promoter is on where none of them is.
    output: the reporter gene; drivers: the promoters in front of it, on where one of them is. rows:
    the states of the inputs that occur, each one bool per input.
    """

    inputs: tuple[str, ...]
    genes: Mapping[str, tuple[str, ...]]
    output: str
    drivers: tuple[str, ...]
    rows: tuple[tuple[bool, ...], ...]

    @cached_property
    def states(self) -> dict[str, tuple[bool, ...]]:
        """Whether each promoter, and the output, is on in each row."""
        found = {name: tuple(row[k] for row in self.rows) for k, name in enumerate(self.inputs)}
        read = lambda names: [any(on) for on in zip(*(found[n] for n in names), strict=True)]
        for gate, promoters in self.genes.items():
            found[gate] = tuple(not on for on in read(promoters))
        return found | {self.output: tuple(read(self.drivers))}

    @property
    def promoters(self) -> dict[str, tuple[str, ...]]:
        """The promoters in front of each gene, the output's last."""
        return {**self.genes, self.output: self.drivers}

    def words(self, gene: str) -> str:
        """The logic of a gate's promoter, or of the output."""
        names = self.promoters[gene]
        if gene == self.output:
            return " or ".join(names)
        return f"{'NOT' if len(names) == 1 else 'NOR'}({', '.join(names)})"

    def describe(self) -> str:
        """The wiring in one line."""
        return "; ".join(f"{gene} = {self.words(gene)}" for gene in self.promoters)


def netlist(
    logic: str | Mapping[str, Sequence[str]], inputs: Sequence[str], output: str
) -> Netlist:
    """The wiring of a truth table ("0110": the output for inputs 00, 01, 10, 11; "-" for a state
    that never occurs), with as few gates as possible; or a checked wiring as the user lists it, the
    promoters in front of each gene, the output's included. Raises InputError."""
    if isinstance(logic, str):
        return _from_table(logic, tuple(inputs), output)
    if not isinstance(logic, Mapping):
        rule = 'a truth table such as "0110", or the promoters in front of each gene, {"g1": ["a"]}'
        raise checks.input_error("logic", logic, rule)
    return _from_list(logic, tuple(inputs), output)


def _from_list(logic: Mapping[str, Sequence[str]], inputs: tuple[str, ...], output: str) -> Netlist:
    genes = {gene: _promoters(gene, names) for gene, names in logic.items()}
    if output not in genes:
        hint = f"Add {output!r}: the promoters in front of the reporter gene."
        raise checks.input_error("logic", list(genes), f"with the output {output!r}", hint)
    known = [*inputs, *(gene for gene in genes if gene != output)]
    for gene, names in genes.items():
        if gene in inputs:
            raise checks.input_error("logic", gene, "a name that no input has")
        for promoter in names:
            if promoter not in known:
                near = checks.nearest(promoter, known)
                hint = f"Did you mean {near!r}?" if near else ""
                rule = "an input or a gate: " + ", ".join(known)
                raise checks.input_error(f"logic[{gene!r}]", promoter, rule, hint)
    read = {promoter for names in genes.values() for promoter in names}
    if unread := [promoter for promoter in known if promoter not in read]:
        raise checks.input_error("logic", unread[0], "in front of a gene", "Nothing reads it.")
    try:
        order = tuple(TopologicalSorter(genes).static_order())
    except CycleError as error:
        loop = " → ".join(error.args[1])
        hint = "A loop has no truth table. Write it as a Circuit of your own."
        raise checks.input_error("logic", loop, "without loops", hint) from error
    gates = {name: genes[name] for name in order if name in genes and name != output}
    rows = tuple(itertools.product((False, True), repeat=len(inputs)))
    return Netlist(inputs, gates, output, genes[output], rows)


def _promoters(gene: str, names: object) -> tuple[str, ...]:
    found: tuple[object, ...] = ()
    if isinstance(names, Sequence) and not isinstance(names, str):
        found = tuple(names)
    good = 1 <= len(found) <= MOST_PROMOTERS and len(set(found)) == len(found)
    if not good:
        raise checks.input_error(f"logic[{gene!r}]", names, 'a list of one or two, such as ["a"]')
    return tuple(str(promoter) for promoter in found)


def _from_table(table: str, inputs: tuple[str, ...], output: str) -> Netlist:
    rows = tuple(itertools.product((False, True), repeat=len(inputs)))
    if len(inputs) > MOST_INPUTS:
        hint = "List the genes and the promoters in front of them."
        raise checks.input_error("inputs", inputs, f"{MOST_INPUTS} at most with a table", hint)
    if len(table) != len(rows) or set(table) - set("01-"):
        rule = f"{len(rows)} of 0, 1 and -, one for each state of {', '.join(inputs)}"
        raise checks.input_error("logic", table, rule)
    bits = lambda marks: sum(1 << k for k, mark in enumerate(table) if mark in marks)
    care, wanted = bits("01"), bits("1")
    if wanted in (0, care):
        raise checks.input_error("logic", table, "a table with 0 and 1")
    columns = [sum(1 << k for k, row in enumerate(rows) if row[i]) for i in range(len(inputs))]
    for count in range(MOST_GATES + 1):
        for pairs, drivers in _wirings(columns, count, wanted, care, (1 << len(rows)) - 1):
            if not count:
                hint = "The output follows the inputs themselves."
                raise checks.input_error("logic", table, "a table that needs a gate", hint)
            names = [*inputs, *(f"g{k + 1}" for k in range(count))]
            genes = {
                names[len(inputs) + k]: tuple(dict.fromkeys((names[a], names[b])))
                for k, (a, b) in enumerate(pairs)
            }
            drivers_by_name = tuple(names[k] for k in drivers)
            known = tuple(row for row, mark in zip(rows, table, strict=True) if mark != "-")
            _check_all_read(table, inputs, genes, drivers_by_name)
            return Netlist(inputs, genes, output, drivers_by_name, known)
    raise tf.InputError(
        f"logic = {table!r} needs more than {MOST_GATES} gates. Give the wiring: the promoters in"
        " front of each gene."
    )


def _check_all_read(
    table: str,
    inputs: tuple[str, ...],
    genes: Mapping[str, tuple[str, ...]],
    drivers: tuple[str, ...],
) -> None:
    read = {name for names in (*genes.values(), drivers) for name in names}
    for given in inputs:
        if given not in read:
            hint = f"Leave {given!r} out."
            raise checks.input_error("logic", table, "a table that depends on every input", hint)


def _wirings(
    columns: list[int], count: int, wanted: int, care: int, every: int
) -> Iterator[tuple[list[Pair], tuple[int, ...]]]:
    """Wirings with `count` more gates, as pairs of columns, and the columns that drive the output.

    columns: the states of promoters so far, one bit per row. Wirings with one driver come first.
    """
    for drivers in (1, MOST_PROMOTERS):
        yield from _extend(columns, [], count, (wanted, care, every, drivers))


def _extend(
    columns: list[int], pairs: list[Pair], count: int, task: tuple[int, int, int, int]
) -> Iterator[tuple[list[Pair], tuple[int, ...]]]:
    wanted, care, every, drivers = task
    if not count:
        for chosen in itertools.combinations(range(len(columns)), drivers):
            state = 0
            for k in chosen:
                state |= columns[k]
            if state & care == wanted:
                yield pairs, chosen
        return
    last = len(columns) - 1
    for pair in itertools.combinations_with_replacement(range(len(columns)), 2):
        state = every & ~(columns[pair[0]] | columns[pair[1]])
        # gates that do not read the last one are placed in one order only
        in_order = not pairs or last in pair or pair > pairs[-1]
        if in_order and state not in columns:
            yield from _extend([*columns, state], [*pairs, pair], count - 1, task)
