"""Targets for the size of domains of two kinds of cells, and for the share of cells that are on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import (
    FAILED,
    Target,
    ratio,
    require,
    species_name,
    species_names,
    total,
    valid_levels,
    weights,
)
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GAP = 0.5  # µm: cells with a smaller gap are neighbours
FEWEST = 1e-12  # a smaller share of unlike neighbours counts as none
BRIGHTEST = 1e6  # levels, in thresholds, from which a cell is fully on in float64
TARGET = "#c2185b"


@dataclass(frozen=True)
class DomainSize(Target):
    """Domains of cells in one of two states, `size` µm wide: the mean length that a straight line
    runs in one domain.

    The state of a cell is z = (a − b)/(a + b), from −1 to 1, of the levels of two species (0 where
    both are 0). Neighbours are cells with a gap under 0.5 µm. Over the pairs of neighbours, q is
    the mean (zᵢ² + zⱼ²)/2: 1 where all cells are decided. The share p = mean (zᵢ − zⱼ)²/4 / q of
    the pairs is unlike; with their mean centre distance d, the domains are d/p wide. Loss: 1 −
    q·exp(−ln²(d/p / size)); 1 where no pair is unlike or no cell has a neighbour. So a colony of
    one kind has no domains, however weakly its cells are decided.

    Derivation: the borders of the domains have length A per area. A short segment of length d, at a
    random place and angle, crosses them 2dA/π times on average (Buffon). So does each length d of a
    straight line, whose mean run in one domain is therefore ℓ = π/(2A) (Crofton), and p = d/ℓ. In
    space, with A per volume, dA/2 and ℓ = 2/A give the same. A segment that crosses twice looks
    like one that does not cross: the estimate is valid for ℓ well above d, and is 2d for cells
    whose states are random.
    """

    differentiable = True
    failed = FAILED
    species: tuple[str, str]
    size: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "species", species_names("DomainSize.species", self.species, 2))
        checks.number("DomainSize.size", self.size, above=0.0)

    @property
    def names(self) -> tuple[str, ...]:
        return self.species

    def check(self, state: tf.State) -> None:
        require(state, self.species)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        _, sound = valid_levels(state, self.species)
        unlike, decided, distance, _ = self._pairs(state)
        # with the clamp the logarithm is finite, and the loss is exactly 1 with zero gradient
        log = torch.log(
            torch.where(distance > 0, distance, 1.0) / (unlike.clamp(min=FEWEST) * self.size)
        )
        # exactly 0 at the target size of decided cells
        loss = torch.where(distance > 0, 1.0 - decided * torch.exp(-log * log), 1.0)
        return torch.where(sound, loss, self.failed)

    def _pairs(self, state: tf.State) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The share of unlike neighbours, how decided they are, their mean centre distance (µm, 0
        without neighbours) and the number of pairs of each colony, (B,) float64 each."""
        a, b = valid_levels(state, self.species)[0].unbind(1)
        z = ratio(a - b, a + b, 0.0)
        i, j, apart = tf.measure.neighbours(state, GAP)
        colony = state.colony.index_select(0, i)
        one, other = z.index_select(0, i), z.index_select(0, j)
        parts = (
            0.25 * (one - other) ** 2,
            0.5 * (one**2 + other**2),
            apart,
            torch.ones_like(apart),
        )
        sums = tf.Groups(colony, state.colonies).sum(torch.stack(parts, 1))
        unlike, decided, distance, count = sums.unbind(1)
        share = ratio(unlike, decided, 0.0)
        return share, ratio(decided, count, 0.0), ratio(distance, count, 0.0), count

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """domain_size_um; unlike_share, of the pairs of neighbours; decided, from 0 to 1; pairs,
        their number; (B,) each."""
        unlike, decided, distance, count = self._pairs(state)
        return {
            "domain_size_um": ratio(distance, unlike, math.nan),
            "unlike_share": torch.where(count > 0, unlike, math.nan),
            "decided": torch.where(count > 0, decided, math.nan),
            "pairs": count,
        }

    def why_undefined(self, measure: str) -> str:
        alone = f"no cell has a neighbour with a gap under {GAP:g} µm (grow larger colonies)"
        one, other = self.species
        why = {
            "domain_size_um": f"no two neighbours differ in {one} and {other}, or {alone}",
            "unlike_share": alone,
            "decided": alone,
        }
        return why.get(measure, "")

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        """Draw a bar of the target size."""
        window = ax.get_xlim(), ax.get_ylim()
        (left, right), (bottom, top) = window
        x, y = left + 0.05 * (right - left), bottom + 0.05 * (top - bottom)
        ax.plot(
            [x, x + math.copysign(self.size, right - left)],
            [y, y],
            color=TARGET,
            linewidth=3.0,
            solid_capstyle="butt",
            zorder=3,
        )
        ax.annotate(
            f"target {self.size:g} µm",
            (x, y),
            xytext=(0, 3),
            textcoords="offset points",
            color=TARGET,
            fontsize=7.0,
            zorder=3,
        )
        ax.set(xlim=window[0], ylim=window[1])

    def describe(self) -> str:
        return f"domains of {self.species[0]} and {self.species[1]} {self.size:g} µm wide"


@dataclass(frozen=True)
class OnFraction(Target):
    """A share of the cells is on and the rest is off, wherever they are.

    fraction: target share of the volume, above 0 and below 1. A cell is on above `level`; for the
    loss, smoothly: s = y⁴/(y⁴ + level⁴). Loss: 1 − (1 − d²)(1 − g). d = (mean s −
    fraction)/max(fraction, 1 − fraction); |d| is 1 where the share is as wrong as possible. g is
    the mean of 4 s (1 − s): 1 where all cells are at the level itself, 0 where each cell is clearly
    on or off.
    """

    differentiable = True
    failed = FAILED
    anywhere = True
    species: str
    fraction: float
    level: float

    def __post_init__(self) -> None:
        species_name("OnFraction.species", self.species)
        checks.number("OnFraction.fraction", self.fraction, above=0.0)
        if self.fraction >= 1:
            raise checks.input_error(
                "OnFraction.fraction",
                self.fraction,
                "above 0 and below 1",
                "For all cells on, use Bands with one wide band.",
            )
        checks.number("OnFraction.level", self.level, above=0.0)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

    @property
    def lit_from(self) -> dict[str, float]:
        return {self.species: self.level}

    def check(self, state: tf.State) -> None:
        require(state, (self.species,))

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        y, sound = valid_levels(state, (self.species,))
        square = (y[:, 0] / self.level).clamp(max=BRIGHTEST) ** 2
        on = square * square / (1.0 + square * square)
        w = weights(state)
        share, grey = (
            ratio(total(state, w * part), total(state, w), 0.0)
            for part in (on, 4.0 * on * (1.0 - on))
        )
        wrong = ((share - self.fraction) / max(self.fraction, 1 - self.fraction)) ** 2
        return torch.where(sound, 1.0 - (1.0 - wrong) * (1.0 - grey), self.failed)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """on_share: share of the volume above the level; on_level and off_level: mean level of the
        cells above it and of the others; (B,) each."""
        y, w = valid_levels(state, (self.species,))[0][:, 0], weights(state)
        on = (y > self.level).double()
        parts = total(
            state, torch.stack([w, w * on, w * on * y, w * (1 - on), w * (1 - on) * y], 1)
        ).unbind(1)
        shares = ((parts[1], parts[0]), (parts[2], parts[1]), (parts[4], parts[3]))
        return {
            name: ratio(a, b, math.nan)
            for name, (a, b) in zip(("on_share", "on_level", "off_level"), shares, strict=True)
        }

    def why_undefined(self, measure: str) -> str:
        why = {
            "on_share": "the colony has no cells",
            "on_level": f"no cell has {self.species} above {self.level:g}",
            "off_level": f"all cells have {self.species} above {self.level:g}",
        }
        return why.get(measure, "")

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        """Write the share found and the target share below the colony, where they hide nothing."""
        found = float(self.measures(state)["on_share"][place])
        ax.annotate(
            f"{self.species} on: {found:.3g}, target {self.fraction:.3g}", (1, 0),
            xycoords="axes fraction", xytext=(0, -8), textcoords="offset points", ha="right",
            va="top", color=TARGET, fontsize=7.0, annotation_clip=False,
        )  # fmt: skip

    def describe(self) -> str:
        return f"{self.species} above {self.level:g} in {self.fraction:.3g} of the cells"
