"""What an effect is: a step of the model that declares the fields it reads and writes.

An effect is a frozen dataclass with a `stage`, the fields it `declares`, what it `reads` and
`writes`, and a `step(state, dt) -> state`. Effects never import each other; they meet only through
named fields.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchfilm.state import Field, State
from torchfilm.tools import checks

# The paper's stages, in its order; an effect says where it belongs.
(
    RULES,
    DIVISION,
    BEFORE_CELLS,
    NUTRITION,
    GROWTH,
    MECHANICS,
    GRID_COVERAGE,
    CIRCUIT,
    TRANSPORT,
    REMOVAL,
) = (10, 20, 22, 25, 30, 40, 45, 50, 60, 90)

GEOMETRY = ("position", "axis", "length", "radius")
# Names that every state has and an effect may read or write beside declared fields.
BUILT_IN = (*GEOMETRY, "cells")


class Effect:
    """Base of all effects. Override `step`, and the rest where there is something to say."""

    stage: ClassVar[int]
    title: ClassVar[str]
    writes_anything: ClassVar[bool] = False  # what it writes is not known before it runs

    def parts(self) -> Sequence[Effect]:
        """The effects that really run; one for most."""
        return (self,)

    def declares(self, dim: int) -> Sequence[Field]:
        """The fields that this effect brings into the state of a scene in `dim` dimensions."""
        return ()

    def reads(self) -> Sequence[str]:
        """Names of what `step` looks at: "position", "axis", "length", "radius", "cells" (how many,
        which) or fields."""
        return ()

    def needs(self) -> Sequence[str]:
        """Those names among what it reads without which it cannot run; the others it does
        without."""
        return ()

    def writes(self) -> Sequence[str]:
        """Names of what `step` changes."""
        return ()

    def waits_for(self) -> Sequence[str]:
        """Fields that must not be 0 everywhere in a colony if it is to have more cells: another
        effect, a rule or the first cells set them where this does not."""
        return ()

    def begin(self, state: State) -> State:
        """The first cells made ready for this effect's fields, before any field is declared."""
        return state

    def prepare(self, state: State) -> State:
        """The seeded state made ready for this effect, once, after all fields are declared."""
        return state

    def check(self, state: State) -> None:
        """Raise InputError if this effect cannot start from this seeded state; a state in mid-run
        is not asked again."""

    def step(self, state: State, dt: float) -> State:
        """The state after this effect has acted for dt hours."""
        raise NotImplementedError


def per_colony(value: float | Tensor, state: State) -> Tensor:
    """A parameter as (B,) or 0-dim tensor of the state's dtype, looked up by colony id where it is
    given per colony."""
    if not isinstance(value, Tensor):
        return torch.tensor(value, dtype=state.dtype, device=state.device)
    value = value.to(dtype=state.dtype, device=state.device)
    if value.dim() == 0:
        return value
    return value.index_select(0, state.colony_id)


def per_cell(value: float | Tensor, state: State) -> Tensor:
    """As `per_colony`, but (N,) or 0-dim: one value for each cell."""
    found = per_colony(value, state)
    return found if found.dim() == 0 else found.index_select(0, state.colony)


@dataclass(frozen=True)
class Distribution:
    """A random parameter, drawn once for each cell at its birth. Subclasses: Uniform, Normal,
    LogNormal."""

    def draw(self, state: State, rows: Tensor, purpose: str) -> Tensor:
        """One value for each of the cells `rows` (M,) -> (M,)."""
        raise NotImplementedError

    def least(self) -> float:
        """The smallest value that can be drawn."""
        raise NotImplementedError

    def greatest(self) -> float:
        """The greatest value that can be drawn."""
        raise NotImplementedError


@dataclass(frozen=True)
class Uniform(Distribution):
    """Evenly between low and high; each one number or one per colony."""

    low: float | Tensor
    high: float | Tensor

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            object.__setattr__(self, name, checks.value(f"Uniform.{name}", getattr(self, name)))
        if bool((torch.as_tensor(self.low) > torch.as_tensor(self.high)).any()):
            raise checks.input_error(
                "Uniform", (self.low, self.high), "low ≤ high", "Swap the two."
            )

    def draw(self, state: State, rows: Tensor, purpose: str) -> Tensor:
        low, high = draw("low", self.low, state, rows), draw("high", self.high, state, rows)
        return low + (high - low) * state.uniform(rows, purpose)

    def least(self) -> float:
        return float(torch.as_tensor(self.low).min())

    def greatest(self) -> float:
        return float(torch.as_tensor(self.high).max())


@dataclass(frozen=True)
class Normal(Distribution):
    """Gaussian of mean and sd, its tails beyond 4 sd (one draw in 16,000) folded back inside; each
    one number or one per colony."""

    mean: float | Tensor
    sd: float | Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", checks.value("Normal.mean", self.mean))
        object.__setattr__(self, "sd", checks.value("Normal.sd", self.sd, least=0.0))

    def draw(self, state: State, rows: Tensor, purpose: str) -> Tensor:
        z = state.normal(rows, purpose)[:, 0]
        z = torch.where(z.abs() > 4, z.sign() * (8 - z.abs()).clamp(min=0), z)
        return draw("mean", self.mean, state, rows) + draw("sd", self.sd, state, rows) * z

    def least(self) -> float:
        return float((torch.as_tensor(self.mean) - 4 * torch.as_tensor(self.sd)).min())

    def greatest(self) -> float:
        return float((torch.as_tensor(self.mean) + 4 * torch.as_tensor(self.sd)).max())


@dataclass(frozen=True)
class LogNormal(Distribution):
    """The exponential of a Gaussian: its median, and sigma of the logarithm; each one number or one
    per colony."""

    median: float | Tensor
    sigma: float | Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "median", checks.value("LogNormal.median", self.median, above=0.0))
        object.__setattr__(self, "sigma", checks.value("LogNormal.sigma", self.sigma, least=0.0))

    def draw(self, state: State, rows: Tensor, purpose: str) -> Tensor:
        z = Normal(0.0, 1.0).draw(state, rows, purpose)
        return draw("median", self.median, state, rows) * torch.exp(
            draw("sigma", self.sigma, state, rows) * z
        )

    def least(self) -> float:
        return float(
            (torch.as_tensor(self.median) * torch.exp(-4 * torch.as_tensor(self.sigma))).min()
        )

    def greatest(self) -> float:
        return float(
            (torch.as_tensor(self.median) * torch.exp(4 * torch.as_tensor(self.sigma))).max()
        )


def parameter(
    name: str,
    value: object,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
) -> float | Tensor | Distribution:
    """Check a parameter that may be one number, one per colony, or a distribution over cells."""
    if isinstance(value, Distribution):
        checks.number(f"least value of {name}", value.least(), above=above, least=least, most=most)
        checks.number(
            f"greatest value of {name}", value.greatest(), above=above, least=least, most=most
        )
        return value
    return checks.value(name, value, above=above, least=least, most=most)


def draw(name: str, value: float | Tensor | Distribution, state: State, rows: Tensor) -> Tensor:
    """A parameter's value for the cells `rows` (M,): drawn where it is a distribution."""
    if isinstance(value, Distribution):
        return value.draw(state, rows, name)
    found = per_cell(value, state)
    return found.expand(rows.numel()) if found.dim() == 0 else found.index_select(0, rows)
