"""What went wrong in a cell whose circuit could not be stepped, in words."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.circuits import rosenbrock, stochastic
from torchfilm.circuits.network import Network
from torchfilm.circuits.run import MOLECULES, CircuitCells


def words(
    circuit: CircuitCells, code: int, concentrations: Tensor, k: int, method: str, dt: float
) -> str:
    """Describes the failure of the k-th of the M cells, in a step from concentrations (M, S)."""
    if method in ("tau_leap", "direct"):
        assert isinstance(circuit.part, Network)
        if code >= MOLECULES:
            reaction = circuit.part.reactions[code - MOLECULES]
            return (
                f"the reaction {reaction.name or str(reaction)!r} has"
                f" {stochastic.STATUS[stochastic.BAD_PROPENSITY]}"
            )
        return stochastic.STATUS[code]
    if code == rosenbrock.BELOW_ZERO:
        start, one = circuit.start(concentrations), torch.tensor([k], device=concentrations.device)
        slope = circuit.rates(start.index_select(0, one), one)[0]
        names = (*circuit.species, *(f"out.{n}" for n in circuit.exchanged))
        if not bool((slope[: len(names)] < 0).any()):
            away = _runaway(circuit, concentrations, k, dt)
            return f"a concentration grows without end{away}" if away else rosenbrock.STATUS[code]
        first = int(torch.where(slope < 0, start[k] / -slope, torch.inf)[: len(names)].argmin())
        hint = ". Take more steps, or method='rosenbrock'" if method != "rosenbrock" else ""
        return (
            f"{rosenbrock.STATUS[code]}, {names[first]!r} first, from {float(start[k, first]):g} at"
            f" a rate of {float(slope[first]):g}/h{hint}"
        )
    bad = _not_finite(circuit, concentrations, k, dt)
    if code != rosenbrock.NOT_FINITE and not bad:
        return rosenbrock.STATUS[code] + _runaway(circuit, concentrations, k, dt)
    at = ", ".join(
        f"{n} = {float(x):g}" for n, x in zip(circuit.species, concentrations[k], strict=True)
    )
    return (
        f"the rate of {' and '.join(bad) or 'a species, on the way,'} is not a finite number, at"
        f" {at}" + (" or soon after" if bad else "")
    )


@torch.no_grad()
def _runaway(circuit: CircuitCells, concentrations: Tensor, k: int, dt: float) -> str:
    """The species of the k-th cell that would more than double in a step, the fastest, if any."""
    one = torch.tensor([k], device=concentrations.device)
    start, now = circuit.start(concentrations), concentrations[k]
    slope = circuit.rates(start.index_select(0, one), one)[0]
    share = torch.where(now > 0, slope[: len(circuit.species)] / now, 0.0)
    most = int(share.argmax())
    if not float(share[most]) * dt > 1:
        return ""
    return (
        f": {circuit.species[most]!r} runs away, from {float(now[most]):g} at a rate of"
        f" {float(slope[most]):g}/h"
    )


@torch.no_grad()
def _not_finite(circuit: CircuitCells, concentrations: Tensor, k: int, dt: float) -> list[str]:
    """The species and signals whose rates in the k-th cell are not finite, at the start of the step
    or further along it: an adaptive method stops before it gets there."""
    one = torch.tensor([k], device=concentrations.device)
    start, rows = (
        circuit.start(concentrations).index_select(0, one),
        circuit.rows.index_select(0, one),
    )
    slope = torch.nan_to_num(circuit.rates(start, one))
    for share in (0.0, 0.01, 0.1, 0.5, 1.0):
        inside, outside = circuit.changes((start + share * dt * slope).clamp(min=0.0), rows)
        bad = [
            f"the {what} {n!r}"
            for what, found in (("species", inside), ("signal", outside))
            for n, x in found.items()
            if not bool(torch.isfinite(x).all())
        ]
        if bad:
            return bad
    return []
