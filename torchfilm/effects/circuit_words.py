"""How a circuit is computed, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torchfilm.circuits.compiled_gradients import MOST_DIRECTIONS
from torchfilm.parameters import number_range
from torchfilm.signals.compiled_uptake import EVENTS
from torchfilm.signals.joint import COARSE, LATE
from torchfilm.values import numbers

if TYPE_CHECKING:
    from torchfilm.effect import ExchangePlan
    from torchfilm.effects.circuit import Circuit
    from torchfilm.state import State


def methods_of(
    circuit: Circuit, dt: float, turns: int, why_torch: Sequence[str], exchanged: Sequence[str],
    own_derivative: str,
) -> list[str]:  # fmt: skip
    """Lines on the method, on who computes it, and on the signals that take turns with it.
    own_derivative: why the derivatives of the rates are not those of their operations, or ""."""
    molecules = (
        f"{number_range(numbers(circuit.molecules_per_unit))} molecules in a unit of concentration"
        " × µm³; no gradient"
    )
    said = {
        "rosenbrock": (
            "stiff solver (Rodas3), each cell in steps of its own: error at most"
            f" {circuit.atol:g} + {circuit.rtol:g}·|u| in each; nothing below 0"
        ),
        "tau_leap": f"molecule by molecule, tau-leaping (ε = 0.03), {molecules}",
        "direct": f"molecule by molecule, one event after the other, {molecules}",
    }
    count = circuit.steps * turns
    explicit = (
        f"{circuit.method}, {count} equal step(s) of {dt / count:g} h; nothing controls its error"
    )
    lines = [said.get(circuit.method, explicit)]
    why = [f"computed by torch: {x}" for x in why_torch]
    gradients = "; where gradients are required by torch, with derivatives from them"
    if circuit.method == "rosenbrock" and own_derivative:
        gradients = f"; gradients by torch, since {own_derivative}"
    elif circuit.method == "rosenbrock":
        gradients = f", gradients by up to {MOST_DIRECTIONS} numbers too"
    lines += why or [f"computed by compiled functions of its equations{gradients}"]
    if exchanged:
        lines.append(
            f"exchanges {', '.join(exchanged)} with each cell's own pool: amounts kept to rounding;"
            f" first order in dt{f'/{turns}' if turns > 1 else ''}"
        )
    return lines


def together_lines(names: Sequence[str], plan: ExchangePlan, dt: float, state: State) -> list[str]:
    """Lines on signals whose transport is solved together with the circuit in a step of dt h."""
    hours, pace = dt / plan.transport.medium.steps, plan.transport.exchanges_per_hour
    exchanges = {name: pace(name, state) * hours for name in names}  # of voxels in a step
    lines = [
        f"exchange and transport of {', '.join(exchanges)} in one equation over the step; amounts"
        " kept to rounding"
    ]
    for name, times in exchanges.items():
        lines.append(
            f"{name}: transport by backward Euler, order 1: voxels exchange {times:.3g} times a"
            f" step, over {EVENTS:g}; in parts of a step while cells take over {100 * COARSE:g} %"
            f" of it in one, or {100 * LATE:g} % leave and its content changes by as much"
            if times > EVENTS
            else f"{name}: transport by a series, order 2 in dt"
        )
        if name in plan.several:
            lines[-1] += "; several circuits exchange it one after the other: order 1 between them"
    return lines
