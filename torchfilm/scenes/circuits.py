"""Circuits without signals: random partition, an oscillator and a switch, molecule by molecule."""

from __future__ import annotations

from torch import Tensor

from torchfilm.circuits import parts
from torchfilm.circuits.reactions import Reaction
from torchfilm.distributions import Uniform
from torchfilm.effects.circuit import Circuit
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.rules import Rules
from torchfilm.rule_views import DivisionView
from torchfilm.scene import Scene

Value = float | Tensor


def _no_reactions(u, s, p, cell):
    return {}


def _divide_plasmids(
    parent: DivisionView, daughter1: DivisionView, daughter2: DivisionView
) -> None:
    """The paper's `divide`: random shares of the parent's amount, which is conserved."""
    amount, share = parent.plasmid * parent.volume, parent.random()
    daughter1.plasmid = amount * share / daughter1.volume
    daughter2.plasmid = amount * (1 - share) / daughter2.volume


def random_partition(rate: float = 1.0, start: float = 1.0, length_drag: float = 1e5) -> Scene:
    """A species without production or decay, divided between daughters in random parts.

    It is the paper's `divide` example. The total amount is conserved, and cells differ more and
    more. start: the founder's concentration. The colony grows at `rate`, 1/h, and freely
    (length_drag 1e5), so all cells divide at the same rate.
    """
    return Scene(
        Rules(divide=_divide_plasmids),
        Growth(rate=rate),
        Division(length=Uniform(3.5, 4.5)),
        Mechanics(dim=2, length_drag=length_drag),
        Circuit(_no_reactions, species=("plasmid",), initial={"plasmid": start}),
    )


def repressilator(
    alpha: Value = 216.0,
    basal: Value = 0.216,
    beta: Value = 5.0,
    power: float = 2.0,
    speed: Value = 2.0,
    molecules_per_unit: float = 0.5,
    noise: bool = True,
    rate: float = 0.7,
    length_drag: float = 1e5,
) -> Scene:
    """Three genes that repress each other in a ring (Elowitz and Leibler 2000), as cells grow.

    The oscillations of related cells lose their phase relation. alpha, basal, beta, power: of the
    dimensionless model, mᵢ' = −mᵢ + α/(1 + pⱼⁿ) + α₀, pᵢ' = β (mᵢ − pᵢ). speed: the unit of time is
    1/speed h, the mRNA's lifetime. noise: simulate molecule by molecule (tau-leaping), with
    `molecules_per_unit` molecules in a unit of concentration × µm³; otherwise deterministically.
    The colony grows at `rate`, 1/h, and freely (length_drag 1e5), so dilution is alike in all
    cells.
    """
    names = ("laci", "tetr", "ci")
    reactions = []
    for name, by in zip(names, ("ci", "laci", "tetr"), strict=True):
        message = f"m_{name}"
        reactions += [
            parts.repressed(message, by, rate="production", half=1.0, power=power),
            parts.constitutive(message, rate="leak"),
            parts.degradation(message, rate="speed"),
            [Reaction({message: 1}, {message: 1, name: 1}, "turnover", f"{name} translated")],
            parts.degradation(name, rate="turnover"),
        ]
    return Scene(
        Growth(rate=rate),
        Division(length=Uniform(3.5, 4.5)),
        Mechanics(dim=2, length_drag=length_drag),
        Circuit(
            reactions,
            species=(*names, *(f"m_{n}" for n in names)),
            method="tau_leap" if noise else "rosenbrock",
            daughters="amount",  # as molecules are shared
            molecules_per_unit=molecules_per_unit,
            initial={"laci": 20.0, "m_laci": 20.0},
            production=alpha * speed,
            leak=basal * speed,
            speed=speed,
            turnover=beta * speed,
        ),
    )


def toggle_switch(
    strength: Value = 10.0,
    power: float = 2.0,
    speed: Value = 1.0,
    start: float = 1.65,
    molecules_per_unit: float = 50.0,
    noise: bool = True,
    rate: float = 0.7,
    length_drag: float = 1e5,
) -> Scene:
    """Two genes that repress each other (Gardner et al. 2000), in a growing colony.

    Cells near the tipping point switch to one side or the other. Their descendants stay there, so
    the colony forms sectors. x' = speed (a/(1 + yⁿ) − x) and the same for y, with a = `strength`,
    n = `power` and `speed` in 1/h.
    Founders start at x = y = `start`; by default decay, dilution and repression balance there.
    noise: simulate molecule by molecule, with `molecules_per_unit` molecules in a unit of
    concentration × µm³. Growth, at `rate`, 1/h, dilutes in addition to decay; the colony grows
    freely (length_drag 1e5), so the balance is the same in all cells.
    """
    reactions = []
    for name, by in (("red", "green"), ("green", "red")):
        reactions += [
            parts.repressed(name, by, rate="production", half=1.0, power=power),
            parts.degradation(name, rate="speed"),
        ]
    return Scene(
        Growth(rate=rate),
        Division(length=Uniform(3.5, 4.5)),
        Mechanics(dim=2, length_drag=length_drag),
        Circuit(
            reactions,
            species=("red", "green"),
            method="tau_leap" if noise else "rosenbrock",
            daughters="amount",  # as molecules are shared
            molecules_per_unit=molecules_per_unit,
            initial={"red": start, "green": start},
            production=strength * speed,
            speed=speed,
        ),
    )
