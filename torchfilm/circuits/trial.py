"""The trial of a circuit at binding, which finds wrong return values before the run starts."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.circuits.names import UnknownName
from torchfilm.circuits.network import Network
from torchfilm.circuits.run import CircuitCells
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError


def try_circuit(
    circuit: CircuitCells, concentrations: Tensor, derivatives: bool = False
) -> tuple[str, ...]:
    """Calls the circuit once at concentrations (M, S), with derivatives if its method needs them.

    Returns the names of the signals that it exchanges. Raises InputError for wrong return values.
    """
    try:
        inside, outside = circuit.changes(concentrations, circuit.rows)
        # small amounts, different in every cell: at 0, a sum over cells would go unnoticed
        some = concentrations + 0.1 * torch.arange(
            1, len(concentrations) + 1, device=concentrations.device
        ).unsqueeze(1)
        crowd, alone = (
            circuit.changes(some, circuit.rows),
            circuit.changes(some[:1], circuit.rows[:1]),
        )
        if derivatives:
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
    for whole, one in zip(crowd, alone, strict=True):
        for name, value in one.items():
            if not torch.allclose(
                whole[name].detach()[:1], value.detach(), rtol=1e-4, atol=1e-30, equal_nan=True
            ):
                raise InputError(
                    f"{circuit.label}: the rate of {name!r} in one cell depends on what other cells"
                    " there are (a sum or a mean over them, or a draw?). A rate function may use"
                    " only its own cell and the concentrations outside it."
                )
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
    if isinstance(circuit.part, Network):
        exchanged = {
            n.removeprefix("out.")
            for r in circuit.part.reactions
            for n in r.change()
            if n.startswith("out.")
        }
        return tuple(n for n in circuit.part.signals if n in exchanged)
    return tuple(n for n in circuit.signals if n in outside)
