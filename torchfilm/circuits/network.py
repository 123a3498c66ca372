"""A network: a list of reactions, checked against species and signals, with its stoichiometry."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits.names import Names, unknown, without_medium
from torchfilm.circuits.reactions import OUTSIDE, Reaction, concentration, falling, per_cell
from torchfilm.tools import checks


@dataclass(frozen=True, eq=False)
class Network:
    """R reactions over S species and M signals.

    stoichiometry: (R, S + M) float64, molecules gained by each event, species before signals.
    orders: (S + M,) float64, the highest order in which a rate depends on each. parameters: the
    names that constants refer to.
    """

    reactions: tuple[Reaction, ...]
    species: tuple[str, ...]
    signals: tuple[str, ...]
    stoichiometry: Tensor
    orders: Tensor
    parameters: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Columns of the stoichiometry: species, then signals as "out.name"."""
        return (*self.species, *(OUTSIDE + s for s in self.signals))

    def check_parameters(self, owner: str, given: Collection[str]) -> None:
        """Raise InputError where the effect `owner` was not given a parameter of a reaction."""
        for name in self.parameters:
            if name not in given:
                what = f"a reaction needs the parameter {name!r}, which {owner} was not given"
                raise checks.InputError(unknown(what, name, list(given)))

    def concentration_rates(self, u: Names, s: Names, p: Names, cell: Names) -> list[Tensor]:
        """R rates, each (n,) conc/h in the cell's volume; differentiable.

        `cell` has volume, area and colony (the id that selects constants per colony).
        """
        out = []
        for reaction in self.reactions:
            if callable(reaction.rate):
                out.append(_rate(reaction, u, s, p, cell))
                continue
            constant = per_cell(reaction.rate, p, cell, cell.volume)
            rate = torch.zeros_like(cell.volume) + constant
            for name, order in reaction.consumes.items():
                x = concentration(name, u, s)
                for _ in range(order):
                    rate = rate * x
            out.append(rate)
        return out

    def changes(self, rates: Sequence[Tensor]) -> list[Tensor]:
        """The changes by R rates (n,): S + M tensors (n,), conc/h relative to the cell's volume.

        A signal's change times the volume is an amount per hour.
        """
        out = [torch.zeros_like(rates[0]) for _ in self.names]
        column = {n: k for k, n in enumerate(self.names)}
        for reaction, rate in zip(self.reactions, rates, strict=True):
            for name, count in reaction.change().items():
                k = column[name]
                out[k] = out[k] + (rate if count == 1 else -rate if count == -1 else count * rate)
        return out

    def propensities(
        self,
        counts: Tensor,
        p: Names,
        cell: Names,
        *,
        molecules_per_unit: float | Tensor = 1.0,
        pool: Tensor | None = None,
    ) -> Tensor:
        """Events per hour, (n, R), at molecule numbers `counts` (n, S + M).

        molecules_per_unit: molecules in a unit of concentration × µm³. pool: µm³ outside from which
        each cell may take signals, (n,) or (n, M); required where there are signals.

        Mass action counts combinations, k Ω n (n − 1)/Ω² for 2 a with Ω = volume ×
        molecules_per_unit. The rate of a function is multiplied by Ω only.
        """
        if self.signals and pool is None:
            raise checks.input_error(
                "pool",
                pool,
                "the volume outside each cell, for the signals " + ", ".join(self.signals),
            )
        each = [
            pool if pool is None or pool.dim() == 1 else pool[:, k]
            for k in range(len(self.signals))
        ]
        found = self.propensity_columns(
            counts.unbind(1), p, cell, molecules_per_unit=molecules_per_unit, pools=each
        )
        return torch.stack(found, 1)

    def propensity_columns(
        self,
        columns: Sequence[Tensor],
        p: Names,
        cell: Names,
        *,
        molecules_per_unit: float | Tensor,
        pools: Sequence[Any],
    ) -> list[Tensor]:
        """The same, R of (n,), for molecule numbers S + M of (n,) and a pool for each signal."""
        volumes = [cell.volume * molecules_per_unit] * len(self.species)
        volumes += [pool * molecules_per_unit for pool in pools]
        density = [n / v for n, v in zip(columns, volumes, strict=True)]
        u = Names(self.species, density[: len(self.species)], "u")
        s = Names(self.signals, density[len(self.species) :], "s")
        column = {n: k for k, n in enumerate(self.names)}
        size = cell.volume * molecules_per_unit
        out = []
        for reaction in self.reactions:
            if callable(reaction.rate):
                out.append(_rate(reaction, u, s, p, cell) * size)
                continue
            rate = per_cell(reaction.rate, p, cell, size) * size
            # first what molecules do not change: compiled functions work it out once a cell
            for name, order in reaction.consumes.items():
                for _ in range(order):
                    rate = rate / volumes[column[name]]
            for name, order in reaction.consumes.items():
                # less than one molecule cannot react
                rate = rate * falling(columns[column[name]].floor(), order)
            out.append(rate)
        return out


def _rate(reaction: Reaction, u: Names, s: Names, p: Names, cell: Names) -> Any:
    """What the function of a reaction gives: a column, also where it is one number for all cells.
    Raises InputError for what is no number."""
    assert callable(reaction.rate)
    rate = reaction.rate(u, s, p, cell)
    rate = float(rate) if isinstance(rate, Real) else rate  # of numpy, too
    one = isinstance(rate, float) or (isinstance(rate, Tensor) and rate.dim() == 0)
    if rate is None or isinstance(rate, (str, dict, list, tuple)):
        raise checks.InputError(
            f"the rate of the reaction {reaction} is a function that returned"
            f" {type(rate).__name__}: it must return one rate for each cell, such as p.k * u.a."
        )
    return torch.zeros_like(cell.volume) + rate if one else rate


def _flatten(entry: Sequence[Any]) -> list[Reaction]:
    """The reactions in a part, or in nested parts, in order."""
    return [
        r for inner in entry for r in ([inner] if isinstance(inner, Reaction) else _flatten(inner))
    ]


def build_network(
    reactions: Sequence[Reaction | Sequence[Reaction]],
    species: Sequence[str],
    signals: Sequence[str] = (),
) -> Network:
    """Check reactions, or parts (lists of reactions), and join them over species and signals.

    Raises InputError for unknown or repeated names.
    """
    flat: list[Reaction] = []
    for entry in reactions:
        flat += [entry] if isinstance(entry, Reaction) else _flatten(entry)
    if not flat:
        raise checks.input_error("reactions", list(reactions), "at least one reaction")
    names = [*species, *(OUTSIDE + s for s in signals)]
    _check_names(species, signals)
    seen: set[str] = set()
    stoichiometry, orders = (
        torch.zeros(len(flat), len(names), dtype=torch.float64),
        torch.zeros(len(names), dtype=torch.float64),
    )
    for row, reaction in enumerate(flat):
        if reaction.name and reaction.name in seen:
            raise checks.input_error(
                "reaction",
                reaction.name,
                "used only once",
                "Give each reaction its own name, or none.",
            )
        seen.add(reaction.name)
        for name in (*reaction.consumes, *reaction.produces, *getattr(reaction.rate, "reads", ())):
            if name not in names:
                if name.startswith(OUTSIDE) and not signals:
                    signal = name.removeprefix(OUTSIDE)
                    raise checks.InputError(
                        f"the reaction {reaction.name or str(reaction)!r} needs the signal"
                        f" {signal!r}: {without_medium(signal)}"
                    )
                what = (
                    f"the reaction {reaction.name or str(reaction)!r} has the unknown name {name!r}"
                )
                hint = f"List it in species=…, or write {OUTSIDE + name!r} for a signal."
                own = "" if name.startswith(OUTSIDE) else f" {hint}"
                raise checks.InputError(unknown(what, name, names) + own)
        for name, count in reaction.change().items():
            stoichiometry[row, names.index(name)] = count
        # the names that a user's function reads are unknown, so all names count
        steep = (
            dict.fromkeys(getattr(reaction.rate, "reads", names), reaction.order)
            if callable(reaction.rate)
            else reaction.consumes
        )
        for name, order in steep.items():
            k = names.index(name)
            orders[k] = max(float(orders[k]), order)
    parameters = _parameters(flat)
    return Network(tuple(flat), tuple(species), tuple(signals), stoichiometry, orders, parameters)


def _check_names(species: Sequence[str], signals: Sequence[str]) -> None:
    for what, given in (("species", species), ("signals", signals)):
        if isinstance(given, str) or not all(
            isinstance(n, str) and n.isidentifier() for n in given
        ):
            raise checks.input_error(what, given, "a sequence of names")
        if len(set(given)) != len(given):
            raise checks.input_error(what, list(given), "different names", "One name occurs twice.")


def _parameters(reactions: Sequence[Reaction]) -> tuple[str, ...]:
    """The parameters that constants refer to, in order.

    Parameters that a user's function reads are unknown here.
    """
    found: list[str] = []
    for reaction in reactions:
        given = (
            [getattr(reaction.rate, c, None) for c in ("rate", "half", "power")]
            if callable(reaction.rate)
            else [reaction.rate]
        )
        found += [c for c in given if isinstance(c, str) and c not in found]
    return tuple(found)
