"""Parts: the usual reactions of genetic circuits by name, each a list of reactions.

Every constant is a number, one per colony, or a parameter's name.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from torch import Tensor

from torchfilm.circuits import kinetics
from torchfilm.circuits.names import Names
from torchfilm.circuits.reactions import (
    OUTSIDE,
    Constant,
    Reaction,
    concentration,
    constant,
    per_cell,
)
from torchfilm.tools import checks


@dataclass(frozen=True, eq=False)
class _Regulated:
    """rate × activation or repression of a promoter by the concentration of `by`."""

    by: str
    rate: Constant
    half: Constant
    power: Constant
    repressed: bool

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.by,)

    def __call__(self, u: Names, s: Names, p: Names, cell: Names) -> Tensor:
        x = concentration(self.by, u, s)
        law = kinetics.repression if self.repressed else kinetics.activation
        rate, half, power = (per_cell(c, p, cell, x) for c in (self.rate, self.half, self.power))
        return rate * law(x, half, power)


@dataclass(frozen=True, eq=False)
class _Enzyme:
    """Michaelis–Menten: rate × E × S/(half + S)."""

    substrate: str
    enzyme: str
    rate: Constant
    half: Constant

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.substrate, self.enzyme)

    def __call__(self, u: Names, s: Names, p: Names, cell: Names) -> Tensor:
        x = concentration(self.substrate, u, s)
        rate, half = (per_cell(c, p, cell, x) for c in (self.rate, self.half))
        return rate * concentration(self.enzyme, u, s) * kinetics.michaelis_menten(x, half)


@dataclass(frozen=True, eq=False)
class _Stage:
    """One of `stages` equal steps that take `time` in all: stages/time × concentration."""

    source: str
    time: Constant
    stages: int

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.source,)

    def __call__(self, u: Names, s: Names, p: Names, cell: Names) -> Tensor:
        x = concentration(self.source, u, s)
        return self.stages / per_cell(self.time, p, cell, x) * x


@dataclass(frozen=True, eq=False)
class _Membrane:
    """Flux through the membrane: rate × A/V × the concentration on the side that it leaves."""

    source: str
    rate: Constant

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.source,)

    def __call__(self, u: Names, s: Names, p: Names, cell: Names) -> Tensor:
        x = concentration(self.source, u, s)
        return per_cell(self.rate, p, cell, x) * (cell.area / cell.volume) * x


def _steepness(power: Constant) -> int:
    """The order of a promoter's response: the power, rounded up; 4 if it is not a number."""
    return max(1, -int(-power // 1)) if isinstance(power, (int, float)) else 4


def _regulated(
    species: str, by: str, rate: Constant, half: Constant, power: Constant, repressed: bool
) -> list[Reaction]:
    what = "repressed" if repressed else "activated"
    law = _Regulated(
        by,
        constant(f"{what}.rate", rate),
        constant(f"{what}.half", half, positive=True),
        constant(f"{what}.power", power),
        repressed,
    )
    return [Reaction({}, {species: 1}, law, f"{species} {what} by {by}", order=_steepness(power))]


@checks.known_keywords
def constitutive(species: str, rate: Constant) -> list[Reaction]:
    """∅ → species at `rate`, conc/h."""
    return [Reaction({}, {species: 1}, rate, f"{species} made")]


@checks.known_keywords
def activated(
    species: str, by: str, rate: Constant, half: Constant, power: Constant = 1.0
) -> list[Reaction]:
    """∅ → species at rate × xⁿ/(Kⁿ + xⁿ), x the concentration of `by`, K = half, n = power."""
    return _regulated(species, by, rate, half, power, False)


@checks.known_keywords
def repressed(
    species: str, by: str, rate: Constant, half: Constant, power: Constant = 1.0
) -> list[Reaction]:
    """∅ → species at rate × Kⁿ/(Kⁿ + xⁿ), x the concentration of `by`, K = half, n = power."""
    return _regulated(species, by, rate, half, power, True)


@checks.known_keywords
def degradation(species: str, rate: Constant) -> list[Reaction]:
    """species → ∅ at rate × concentration; rate 1/h."""
    return [Reaction({species: 1}, {}, rate, f"{species} lost")]


@checks.known_keywords
def conversion(
    substrate: str, product: str | None = None, *, enzyme: str, rate: Constant, half: Constant
) -> list[Reaction]:
    """substrate → product (or nothing) by an enzyme E at rate × E × S/(half + S); rate 1/h."""
    law = _Enzyme(
        substrate,
        enzyme,
        constant("conversion.rate", rate),
        constant("conversion.half", half, positive=True),
    )
    return [
        Reaction(
            {substrate: 1},
            {product: 1} if product else {},
            law,
            f"{substrate} converted by {enzyme}",
        )
    ]


@checks.known_keywords
def maturation(immature: str, mature: str, *, time: Constant, stages: int = 1) -> list[Reaction]:
    """immature → mature after `time`, h, on average: such as a fluorescent protein, or the delay of
    a model in one equation. With more than one of `stages`, the steps between are the species
    IMMATURE_2, IMMATURE_3, …; each takes as long, so that the time varies by 1/√stages (the linear
    chain of MacDonald, Time Lags in Biological Models, 1978). Growth dilutes all stages."""
    checks.integer("maturation.stages", stages, least=1)
    time = constant("maturation.time", time, positive=True)
    names = [immature, *(f"{immature}_{k}" for k in range(2, stages + 1)), mature]
    return [
        Reaction({one: 1}, {other: 1}, _Stage(one, time, stages), f"{one} to {other}", order=1)
        for one, other in itertools.pairwise(names)
    ]


@checks.known_keywords
def exchange(species: str, rate: Constant, signal: str | None = None) -> list[Reaction]:
    """Exchange through the membrane, both ways: D₁ A/V × concentration, rate = D₁ in µm/h.

    signal: the name outside; default the same as inside. What leaves the cell enters the medium,
    and the reverse. Each direction is a reaction of its own, so that single molecules can cross
    too.
    """
    outside = OUTSIDE + (signal or species)
    rate = constant("exchange.rate", rate)
    return [
        Reaction({species: 1}, {outside: 1}, _Membrane(species, rate), f"{species} out", order=1),
        Reaction({outside: 1}, {species: 1}, _Membrane(outside, rate), f"{species} in", order=1),
    ]
