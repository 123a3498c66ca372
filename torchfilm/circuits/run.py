"""One circuit in the cells of one type, over one step. A user's function or reactions give the
rates. Each cell has a pool: the part of the medium from which it may take in this step.

The solver integrates exchange with the medium together with the reactions inside the cell. The
variables are the species and, for each exchanged signal, its concentration in the cell's pool. So
however fast the exchange, neither side falls below zero, and amounts are conserved. Where transport
is solved together with the cells there is no pool: concentrations outside change at given rates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits import integrators, rosenbrock, stochastic
from torchfilm.circuits.columns import Columns, NoSignals, column
from torchfilm.circuits.compiled import Compiled
from torchfilm.circuits.compiled_explicit import CompiledExplicit
from torchfilm.circuits.compiled_molecules import CompiledMolecules
from torchfilm.circuits.compiled_stiff import CompiledStiff
from torchfilm.circuits.draws import Draw, KeyedDraws
from torchfilm.circuits.graph import both_of, check_returned
from torchfilm.circuits.molecules import whole
from torchfilm.circuits.names import Names, unknown, without_medium
from torchfilm.circuits.network import Network
from torchfilm.tools.checks import InputError
from torchfilm.tools.deterministic_math import deterministic_functions
from torchfilm.tools.tangents import has_tangent, in_forward_mode, scaled

# From here on a code of `CircuitOutcome` is this plus the number of a reaction that failed.
MOLECULES = 100
# Returns the rates of species by name, conc/h, and the amounts per hour that the cell releases to
# signals by name, conc·µm³/h.
RateFunction = Callable[[Names, Names, Names, Names], Any]


@dataclass(frozen=True, eq=False)
class IntegrationSettings:
    """The numerical method of circuits: its `steps` or tolerances, and the molecules per unit of
    concentration × µm³, (N,) or one number."""

    method: str
    steps: int
    rtol: float
    atol: float
    molecules_per_unit: float | Tensor


@dataclass(frozen=True, eq=False)
class CircuitCells:
    """A circuit in M of N cells.

    part: a rate function, or a network of reactions. species: its variables. exchanged: the
    signals that it gives and takes. rows: the M cells, (M,) int64. cell, p: columns over the N
    cells by name. compiled: the same as equations, where it could be traced; by_torch: whether
    torch evaluates them. signals: the concentration outside each cell, (N,) by name. pool: (N,)
    µm³, each cell's part of the medium, if the circuit exchanges a signal. in_reservoir: (N,) bool,
    cells whose pool is a reservoir of constant concentration, or None. ramp: in place of a pool,
    what the exchanged signals are at first, and the rates at which they change, conc/h: (N,) each
    by name; `signals` is then half way. None with pools.
    """

    part: RateFunction | Network
    species: tuple[str, ...]
    exchanged: tuple[str, ...]
    rows: Tensor
    cell: Mapping[str, Any]
    p: Mapping[str, Any]
    signals: Mapping[str, Tensor]
    pool: Tensor | None = None
    in_reservoir: Tensor | None = None
    ramp: Mapping[str, tuple[Tensor, Tensor]] | None = None
    label: str = "circuit"
    compiled: Compiled | None = None
    by_torch: bool = False
    seen: dict[str, set[str]] = field(default_factory=dict)

    @property
    def sums_exchange(self) -> bool:
        """Whether it has variables of what it gives and takes."""
        return self.in_reservoir is not None or self.ramp is not None

    @property
    def bounded(self) -> int:
        """How many variables, the first, may not be below 0: concentrations."""
        return len(self.species) + len(self.exchanged)

    def names(self, u: Tensor, rows: Tensor) -> tuple[Names, Names, Names, Names]:
        """The arguments of a rate function, for variables u (m, ≥ S + E) of the cells `rows` (m,)
        among the N."""
        size = len(self.species)
        columns = u.unbind(1)
        signals: dict[str, Any] = dict(self.signals)
        s = Columns(signals, rows, "s", self.seen.get("s")) if signals else NoSignals()
        for name, value in zip(self.exchanged, columns[size:], strict=False):
            s.__dict__[name] = value
        return (
            Names(self.species, columns[:size], "u"),
            s,
            Columns(self.p, rows, "p", self.seen.get("p")),
            Columns(self.cell, rows, "cell", self.seen.get("cell")),
        )

    def changes(self, u: Tensor, rows: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Rates of species (m,), conc/h, and amounts released to signals (m,), conc·µm³/h, by name;
        u (m, …), rows (m,) among the N cells."""
        u_, s, p, cell = self.names(u, rows)
        with deterministic_functions():
            if isinstance(self.part, Network):
                found = self.part.changes(self.part.concentration_rates(u_, s, p, cell))
                split = len(self.species)
                inside = dict(zip(self.species, found[:split], strict=True))
                return inside, {
                    n: x * cell.volume
                    for n, x in zip(self.part.signals, found[split:], strict=True)
                }
            inside, outside = both_of(self.part(u_, s, p, cell))
        return self._checked(inside, self.species, "species", u, rows), self._checked(
            outside, tuple(self.signals), "signal", u, rows
        )

    def _checked(
        self, found: Any, known: Sequence[str], what: str, u: Tensor, rows: Tensor
    ) -> dict[str, Tensor]:
        check_returned(found, self.label)
        out = {}
        for name, value in found.items():
            if name not in known:
                wrong = f"{self.label} returned a rate for {name!r}, which is no {what}"
                if what == "signal" and not known:
                    raise InputError(f"{wrong}: {without_medium(str(name))}")
                raise InputError(unknown(wrong, str(name), list(known)))
            made = column(value, rows.numel(), u)
            if made is None:
                shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise InputError(
                    f"{self.label} returned a rate of shape {shape} for the {what} {name!r}: it"
                    f" must be one number a cell, ({rows.numel()},)."
                )
            out[name] = made
        return out

    def rates(self, u: Tensor, rows: Tensor) -> Tensor:
        """du/dt of all variables, (m, S + E), or (m, S + 2E) with a reservoir or ramps; rows (m,)
        among the M."""
        rows = self.rows.index_select(0, rows)
        inside, outside = self.changes(u, rows)
        none = torch.zeros_like(u[:, 0])
        # a rate that depends on nothing may be one number
        columns = [inside.get(n, none).expand_as(none) for n in self.species]
        if self.exchanged:
            new = [n for n in outside if n not in self.exchanged]
            if new:
                raise InputError(
                    f"{self.label} gave {new[0]!r} to the medium, and had not in its trial: always"
                    " return it, 0 where nothing passes."
                )
            flux = [outside.get(n, none).expand_as(none) for n in self.exchanged]
            if self.ramp is not None:
                columns += [
                    self.ramp[n][1].index_select(0, rows).to(u.dtype) for n in self.exchanged
                ]
                return torch.stack([*columns, *flux], 1)
            assert self.pool is not None
            pool = self.pool.index_select(0, rows)
            if self.in_reservoir is None:
                columns += [x / pool for x in flux]
            else:
                away = self.in_reservoir.index_select(0, rows)
                columns += [torch.where(away, 0.0, x / pool) for x in flux]
                columns += [torch.where(away, x, 0.0) for x in flux]
        return torch.stack(columns, 1)

    def per_unit(self, given: float | Tensor) -> Tensor:
        """Molecules per unit of concentration × µm³, of `IntegrationSettings`: (M,) float64, or one
        number ()."""
        if not isinstance(given, Tensor):
            return torch.tensor(given, dtype=torch.float64)
        return given.index_select(0, self.rows).double() if given.dim() else given

    def slopes(self, u: Tensor, rows: Tensor) -> Tensor:
        """∂ rates/∂u, (V, V, m), at u (V, m) of the cells `rows` (m,) among the M."""
        assert isinstance(self.compiled, CompiledStiff)
        return self.compiled.slopes_by_torch(self, u, self.rows.index_select(0, rows))

    def start(self, concentrations: Tensor) -> Tensor:
        """The variables at the start: concentrations (M, S), then pools, then the amounts released
        to a reservoir, or with ramps to the medium, less those taken from it."""
        first = self.signals if self.ramp is None else {n: x for n, (x, _) in self.ramp.items()}
        columns = [first[n].index_select(0, self.rows) for n in self.exchanged]
        if self.sums_exchange:
            columns += [torch.zeros_like(c) for c in columns]
        return (
            torch.cat([concentrations, *(c.unsqueeze(1) for c in columns)], 1)
            if columns
            else concentrations
        )


@dataclass(frozen=True, eq=False)
class CircuitOutcome:
    """The result of a step: concentrations (M, S); amounts released to the pools, and to a
    reservoir or with ramps to the medium, conc·µm³, (M,) by signal; whether a cell failed, (M,)
    bool, and why, (M,) codes for `failures.words`; number of steps, (M,) int64.
    """

    concentrations: Tensor
    pools: dict[str, Tensor]
    reservoir: dict[str, Tensor]
    failed: Tensor
    code: Tensor
    steps: Tensor


def step(
    circuit: CircuitCells,
    concentrations: Tensor,
    dt: float,
    settings: IntegrationSettings,
    draw: Draw | None = None,
) -> CircuitOutcome:
    """Integrates the circuit over `dt` hours from concentrations (M, S). Does not raise for a cell
    that fails, but marks it."""
    if settings.method in ("tau_leap", "direct"):
        assert draw is not None
        return _molecules(circuit, concentrations, dt, settings, draw)
    start = circuit.start(concentrations)
    count = start.shape[0]
    steps = torch.full((count,), settings.steps, dtype=torch.int64, device=start.device)
    if settings.method == "rosenbrock":
        compiled, rtol, atol = circuit.compiled, settings.rtol, settings.atol
        assert compiled is None or isinstance(compiled, CompiledStiff)
        found = None
        if compiled is not None and not circuit.by_torch:
            found = compiled.integrate(circuit, start, dt, rtol, atol)
        if found is None:
            slopes = None if compiled is None else circuit.slopes
            free = start.shape[1] - circuit.bounded
            found = rosenbrock.rodas3(
                circuit.rates, start, dt, rtol=rtol, atol=atol, free=free, slopes=slopes
            )
        end, report = found
        code, steps = report.status, report.accepted + report.rejected
    else:
        end = _equal_steps(circuit, start, dt, settings)
        # an exact solution stays above zero: the step is too long for an explicit method
        scale = start.abs() + end.abs()
        may_not = torch.arange(start.shape[1], device=start.device) < circuit.bounded
        may_not = may_not & (start >= 0)
        below = (end < -(settings.atol + settings.rtol * scale.nan_to_num())) & may_not
        code = torch.where(below.any(1), rosenbrock.BELOW_ZERO, rosenbrock.DONE)
        code = torch.where(torch.isfinite(end).all(1), code, rosenbrock.NOT_FINITE)
        # values below zero by less than the tolerance become 0; in other cells the step failed
        end = torch.where((end < 0) & may_not, 0.0, end)
    size, more = len(circuit.species), len(circuit.exchanged)
    pools, reservoir = {}, {}
    for k, name in enumerate(circuit.exchanged):
        if circuit.ramp is None:
            assert circuit.pool is not None
            pool = circuit.pool.index_select(0, circuit.rows)
            pools[name] = scaled(end[:, size + k] - start[:, size + k], pool)
        if circuit.sums_exchange:
            reservoir[name] = end[:, size + more + k]
    return CircuitOutcome(end[:, :size], pools, reservoir, code != 0, code, steps)


def _equal_steps(
    circuit: CircuitCells, start: Tensor, dt: float, settings: IntegrationSettings
) -> Tensor:
    """The variables after dt by an explicit method."""
    found = None
    if isinstance(circuit.compiled, CompiledExplicit):
        found = circuit.compiled.integrate(circuit, start, dt, settings.steps)
    if found is not None:
        return found
    if settings.method == "euler":
        return integrators.euler(circuit.rates, start, dt, settings.steps)
    return integrators.runge_kutta(circuit.rates, start, dt, settings.steps, settings.method)


def _molecules(
    circuit: CircuitCells,
    concentrations: Tensor,
    dt: float,
    settings: IntegrationSettings,
    draw: Draw,
) -> CircuitOutcome:
    """The same step, molecule by molecule. A reservoir is a pool so large that exchange does not
    change its concentration noticeably."""
    assert isinstance(circuit.part, Network)
    network, rows = circuit.part, circuit.rows
    volume = circuit.names(concentrations, rows)[3].volume.double()
    molecules_per_unit = circuit.per_unit(settings.molecules_per_unit)
    amounts = concentrations.double() * (volume * molecules_per_unit).unsqueeze(1)
    # others, as rules, may have written what is no whole number
    everyone = torch.arange(len(rows), device=rows.device)
    uniform = lambda: draw(everyone, 0, "whole molecules", amounts.shape[1]).T
    parts = [whole(amounts, uniform, concentrations.dtype)]
    pool = None
    if network.signals:
        assert circuit.pool is not None
        pool = circuit.pool.index_select(0, rows).double()
        if circuit.in_reservoir is not None:
            pool = torch.where(circuit.in_reservoir.index_select(0, rows), 1e9 * volume, pool)
        parts += [
            (
                circuit.signals[n].index_select(0, rows).double() * pool * molecules_per_unit
            ).unsqueeze(1)
            for n in network.signals
        ]
    start = torch.cat(parts, 1)
    own = {"molecules_per_unit": molecules_per_unit} | ({} if pool is None else {"pool": pool})
    leaps = settings.method == "tau_leap"
    if in_forward_mode():
        _refuse_tangent(circuit, own, start)
    if isinstance(circuit.compiled, CompiledMolecules):
        assert isinstance(draw, KeyedDraws)
        end, report = circuit.compiled.advance(circuit, start, own, dt, draw, leaps)
    else:
        propensities = partial(_propensities, circuit, own)
        gain = network.stoichiometry
        if leaps:
            orders = network.orders
            end, report = stochastic.tau_leap(start, propensities, gain, dt, draw, orders=orders)
        else:
            end, report = stochastic.direct(start, propensities, gain, dt, draw)
    size = len(circuit.species)
    amount = {
        n: (end[:, size + k] - start[:, size + k]) / molecules_per_unit
        for k, n in enumerate(network.signals)
    }
    pools, reservoir = _split(circuit, amount, concentrations.dtype)
    found = (end[:, :size] / (volume * molecules_per_unit).unsqueeze(1)).to(concentrations.dtype)
    # one code per failed reaction, distinct from the codes of the smooth methods
    code = torch.where(
        report.status == 0,
        0,
        torch.where(report.reaction >= 0, MOLECULES + report.reaction, report.status),
    )
    return CircuitOutcome(found, pools, reservoir, report.status != 0, code, report.steps)


def _refuse_tangent(circuit: CircuitCells, own: Mapping[str, Tensor], start: Tensor) -> None:
    every = torch.arange(len(start), device=start.device)
    if has_tangent(_propensities(circuit, own, start, every)):
        raise InputError(
            f"{circuit.label}: a derivative is wanted of a circuit that counts molecules, and"
            ' numbers of molecules have none. Use method="rosenbrock", or differences between'
            " runs."
        )


def _propensities(
    circuit: CircuitCells, own: Mapping[str, Tensor], counts: Tensor, rows: Tensor
) -> Tensor:
    """Events per hour at molecule numbers (m, S) of the cells `rows` (m,) among the M. own: (M,) or
    (), `molecules_per_unit` and `pool`."""
    assert isinstance(circuit.part, Network)
    _, _, p, cell = circuit.names(counts, circuit.rows.index_select(0, rows))
    given = {n: x.index_select(0, rows) if x.dim() else x for n, x in own.items()}
    with deterministic_functions():
        return circuit.part.propensities(counts, p, cell, **given)


def _split(
    circuit: CircuitCells, amount: Mapping[str, Tensor], dtype: torch.dtype
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Splits amounts released to signals, (M,) by name, into those to pools and those to a
    reservoir."""
    if circuit.in_reservoir is None:
        return {n: x.to(dtype) for n, x in amount.items()}, {}
    away = circuit.in_reservoir.index_select(0, circuit.rows)
    pools = {n: torch.where(away, 0.0, x).to(dtype) for n, x in amount.items()}
    return pools, {n: torch.where(away, x, 0.0).to(dtype) for n, x in amount.items()}
