"""The trial of a circuit at binding, which finds wrong return values before the run starts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from torchfilm.circuits.names import UnknownName
from torchfilm.circuits.network import Network
from torchfilm.circuits.run import CircuitCells
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import SMALL_SPECIES, warn

# Species are too small for `atol` where it is more than this part of them.
SMALL = 1e-3
ATOL = 1e-9  # the default; a larger one has been chosen
FALLEN = (0.1, 0.01, 0.0)  # parts of the signals at first, with which species are judged, too


def try_circuit(
    circuit: CircuitCells, concentrations: Tensor, unlike: CircuitCells,
    atol: float | None = None,
) -> tuple[str, ...]:  # fmt: skip
    """Calls the circuit once at concentrations (M, S), with derivatives if its method needs them.
    unlike: as many cells that differ from one another. atol: of a method that takes derivatives.

    Returns the names of the signals that it exchanges. Raises InputError for wrong return values.
    """
    try:
        inside, outside = circuit.changes(concentrations, circuit.rows)
        # amounts from small to large, different in every cell: among cells that are alike, or at
        # 0, a sum over cells, or a look at one of them, would go unnoticed
        count = len(concentrations)
        some = concentrations + 10.0 ** torch.linspace(
            -1.0, 1.0, count, dtype=concentrations.dtype, device=concentrations.device
        ).unsqueeze(1)
        crowd = unlike.changes(some, unlike.rows)
        alone = [unlike.changes(some[k : k + 1], unlike.rows[k : k + 1]) for k in (0, count - 1)]
        if atol is not None:
            with torch.enable_grad():
                circuit.changes(some.detach().clone().requires_grad_(), circuit.rows)
    except UnknownName as error:
        raise UnknownName(f"{circuit.label}: {error}") from error
    except InputError:
        raise
    except (TypeError, ValueError, RuntimeError, IndexError) as error:
        raise InputError(
            f"{circuit.label} failed on the columns of {len(concentrations)} cells: {error}. It is"
            " called with (u, s, p, cell), each name a column with one value a cell: use torch.exp"
            " and the like rather than math or numpy, torch.where rather than if, and change"
            " nothing in place."
        ) from error
    for k, own in zip((0, count - 1), alone, strict=True):
        for whole, one in zip(crowd, own, strict=True):
            _check_alone(circuit.label, k, whole, one)
    for what, found in (("species", inside), ("signal", outside)):
        for name, value in found.items():
            if not bool(torch.isfinite(value.detach()).all()):
                k = int(torch.nonzero(~torch.isfinite(value.detach()))[0])
                at = ", ".join(
                    f"{n} = {float(x):g}"
                    for n, x in zip(circuit.species, concentrations[k], strict=True)
                )
                raise checks.InputError(
                    f"{circuit.label} gives {float(value[k])} for the {what} {name!r} at the start"
                    f" ({at}): every rate must be a finite number."
                )
    if atol is not None:
        _check_size(circuit, concentrations, inside, outside, atol)
    if isinstance(circuit.part, Network):
        exchanged = {
            n.removeprefix("out.")
            for r in circuit.part.reactions
            for n in r.change()
            if n.startswith("out.")
        }
        return tuple(n for n in circuit.part.signals if n in exchanged)
    return tuple(n for n in circuit.signals if n in outside)


def _check_alone(
    label: str, row: int, whole: Mapping[str, Tensor], one: Mapping[str, Tensor]
) -> None:
    """Raise InputError where the rates of a cell, by name, are others among all (M,) than alone
    (1,)."""
    for name, value in one.items():
        among = whole[name].detach()[row : row + 1]
        if not torch.allclose(among, value.detach(), rtol=1e-4, atol=1e-30, equal_nan=True):
            raise InputError(
                f"{label}: the rate of {name!r} in one cell depends on what other cells there are"
                " or on earlier calls (a sum or a mean over them, a draw, a change in place?). A"
                " rate function may use only its own cell and the concentrations outside it."
            )


def _check_size(
    circuit: CircuitCells, concentrations: Tensor, inside: Mapping[str, Tensor],
    outside: Mapping[str, Tensor], atol: float,
) -> None:  # fmt: skip
    """Warn where species are so small, at first and by what an hour makes, that their errors count
    as nothing; or a signal at first that cells take."""
    size = _largest([concentrations, *inside.values()])
    # a signal may repress at first, and less where cells have taken it up
    for part in FALLEN if _is_small(size, atol) and circuit.signals else ():
        around = {name: part * value for name, value in circuit.signals.items()}
        fallen, _ = replace(circuit, signals=around).changes(concentrations, circuit.rows)
        size = max(size, _largest(fallen.values()))
    _warn_if_small(circuit.label, "species", size, atol)
    for name, given in outside.items():
        # a signal that cells give, or make inside, may rise from nothing
        given = given.detach()
        taken = bool((given < 0).any()) and not bool((given > 0).any())
        if taken and name in circuit.signals and name not in circuit.species:
            size = _largest([circuit.signals[name]])
            _warn_if_small(circuit.label, f"signal {name!r}", size, atol)


def _largest(found: Iterable[Tensor]) -> float:
    """The largest size of all numbers."""
    return max((float(x.detach().abs().max()) for x in found if x.numel()), default=0.0)


def _is_small(size: float, atol: float) -> bool:
    """Whether errors of concentrations of this size count as nothing, and nobody has wished so."""
    bound = atol * (1 + 1e-6) if atol == ATOL else atol  # 1e-6 itself, in any type of numbers
    return 0 < SMALL * size < bound and atol <= ATOL


def _warn_if_small(label: str, what: str, size: float, atol: float) -> None:
    """Warn where errors of such concentrations count as nothing."""
    if _is_small(size, atol):
        warn(
            f"{label}: its {what} {'are' if what == 'species' else 'is'} of about {size:.0e}, and"
            f" errors below Circuit.atol = {atol:.0e} count as none. Give"
            f" atol={1e-3 * SMALL * size:.0e}, or concentrations in a smaller unit, such as nM in"
            " place of M.",
            of=SMALL_SPECIES,
        )
