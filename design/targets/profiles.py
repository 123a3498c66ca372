"""Targets that give a level for each cell: bands, a ring. (`gradient`, `stripe` and `image` have
files of their own.)"""

from __future__ import annotations

import itertools
import math
import numbers
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import (
    FAILED,
    Target,
    contrast,
    ratio,
    require,
    rows_of_colonies,
    species_name,
    species_names,
    total,
    valid_levels,
    weights,
)
from design.targets.geometry import (
    ALONG,
    COLOURS,
    Centre,
    between,
    centre_at,
    check_along,
    check_profile,
    checked_centre,
    coordinate,
    draw_edges,
    half,
    in_words,
    lines,
)
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEAST = 1e-3  # a cell whose target level is below this should be dark
WITHIN = 0.5  # cells with a target level above this are inside the pattern
# why the measures of a profile are NaN
UNDEFINED = {
    "inside": (
        "no cell lies where the pattern should be lit (grow larger colonies, or move or widen the"
        " pattern)"
    ),
    "outside": (
        "no cell lies where the pattern should be dark (grow larger colonies, or narrow the"
        " pattern)"
    ),
    "contrast": (
        "no cell lies where the pattern should be lit, or none where it should be dark (grow larger"
        " colonies, or change the size of the pattern), or nothing is lit"
    ),
}


class ProfileTarget(Target):
    """Targets with a target profile m, a number from 0 to 1 for each cell and species.

    w is the volume of each cell that counts, y ≥ 0 its level, and `floor` the level from which a
    cell counts as lit; m below `LEAST` counts as 0. The loss of a species is

        L = 1 − (Σ w m y)² / (Σ w m² · (Σ w y² + floor² Σ w m²))

    The loss of several species is their mean. By Cauchy–Schwarz 0 ≤ (Σ w m y)² ≤ Σ w m² · Σ w y²,
    so L is in [0, 1]. Where y = c·m for all cells, L = floor²/(c² + floor²): 0 for floor = 0, at
    any brightness, and 1/2 where the brightest cells are just at the floor. Evenly lit cells have
    L = 1 − (Σ w m)²/(Σ w Σ w m²), the share of the colony that should be dark. L is 1, with a
    finite gradient, where no cell lies in the pattern (m above `least`) or no cell is lit. In 3-D
    the colony is seen from above.
    """

    differentiable = True
    floor: float
    failed = FAILED
    fewest = 10

    @property
    def names(self) -> tuple[str, ...]:
        """The species that the target reads."""
        raise NotImplementedError(f"{type(self).__name__}.names")

    @property
    def lit_from(self) -> dict[str, float]:
        return dict.fromkeys(self.names, self.floor) if self.floor else {}

    @property
    def least(self) -> float:
        """A colony in which no cell has m above this does not reach the place of the pattern."""
        return 0.0

    def target_profile(self, state: tf.State) -> Tensor:
        """The target profile m of each species, (N, k) float64."""
        raise NotImplementedError(f"{type(self).__name__}.target_profile")

    def counted(self, state: tf.State) -> Tensor:
        """Which cells count, (N,) bool; by default all."""
        return torch.ones_like(state.colony, dtype=torch.bool)

    def check(self, state: tf.State) -> None:
        require(state, self.names)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        y, sound = valid_levels(state, self.names)
        w, m = self._weights_and_profile(state)
        both, lit, light = (total(state, part) for part in (w * m * y, w * m * m, w * y * y))
        each = 1.0 - ratio(both * both, lit * (light + self.floor**2 * lit), 0.0)
        each = torch.where(self._reached(state, w, m), each, 1.0)
        # rounding may take a perfect colony below 0. The species are added one by one, because a
        # sum along a tensor may depend on the batch
        mean = sum(each.clamp(min=0.0).unbind(1), torch.zeros_like(each[:, 0])) / each.shape[1]
        return torch.where(sound, mean, self.failed)

    def _weights_and_profile(self, state: tf.State) -> tuple[Tensor, Tensor]:
        """w (N, 1) and m (N, k)."""
        w = torch.where(self.counted(state), weights(state), 0.0).unsqueeze(1)
        m = self.target_profile(state)
        return w, torch.where(m < LEAST, 0.0, m)

    def _reached(self, state: tf.State, w: Tensor, m: Tensor) -> Tensor:
        """Whether a colony reaches the pattern, (B, k): the soft tail of an edge does not count
        where the colony does not reach the edge."""
        return total(state, w * (m > self.least)) > 0

    @torch.no_grad()
    def reaches(self, state: tf.State) -> Tensor:
        return self._reached(state, *self._weights_and_profile(state)).any(1)

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """√w (m/|m| − cos φ · y/|y|) of each cell, and cos φ · floor |m|/|y|, where cos φ =
        Σ w m y/(|m| |y|), |m|² = Σ w m² and |y|² = Σ w y² + floor² |m|²: the part of m that is at
        right angles to y, whose square is the loss."""
        y, sound = valid_levels(state, self.names)
        w, m = self._weights_and_profile(state)
        both, lit, light = (total(state, part) for part in (w * m * y, w * m * m, w * y * y))
        reached = self._reached(state, w, m) & sound.unsqueeze(1)
        light = light + self.floor**2 * lit
        of_cells = lambda x: x.index_select(0, state.colony)
        root = lambda x: torch.where(x > 0, x, 1.0).sqrt()
        there = m / of_cells(root(lit)) - of_cells(ratio(both, lit.sqrt() * light, 0.0)) * y
        each = torch.where(of_cells(reached), w.sqrt() * there, 0.0)
        beyond = torch.where(reached, ratio(self.floor * both, light, 0.0), 1.0)
        found = torch.cat([rows_of_colonies(state, each), beyond], 1) / len(self.names) ** 0.5
        failed = torch.zeros_like(found)
        failed[:, 0] = self.failed**0.5
        return torch.where(sound.unsqueeze(1), found, failed)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """Of each species, (B,): `inside` and `outside`, the mean levels of the cells with a
        target level above 0.5 and of the others, and `contrast`, their ratio."""
        y, _ = valid_levels(state, self.names)
        w = torch.where(self.counted(state), weights(state), 0.0).unsqueeze(1)
        within = (self.target_profile(state) > WITHIN).double()
        inside = ratio(total(state, w * within * y), total(state, w * within), math.nan)
        outside = ratio(
            total(state, w * (1 - within) * y), total(state, w * (1 - within)), math.nan
        )
        found: dict[str, Tensor] = {}
        for k, name in enumerate(self.names):
            before = f"{name}_" if len(self.names) > 1 else ""
            found |= {f"{before}inside": inside[:, k], f"{before}outside": outside[:, k]}
            found[f"{before}contrast"] = contrast(inside[:, k], outside[:, k])
        return found

    def why_undefined(self, measure: str) -> str:
        several = len(self.names) > 1
        own = {f"{n}_{what}" if several else what: what for n in self.names for what in UNDEFINED}
        return UNDEFINED.get(own.get(measure, ""), "")


@dataclass(frozen=True)
class Bands(ProfileTarget):
    """Bands side by side, or concentric rings, as in a French flag: species k should be lit between
    edges[k] and edges[k + 1].

    edges: ascending, µm from `centre`, one more than species; the first may be −inf and the last
    inf. along: "x", "y", "radius"; "z", the height in space; "edge", the distance below the
    colony's own edge, an ellipse that moves outwards as it grows; or "top", the distance below the
    top of a film that grows from a floor at 0 (`tf.measure.below_top`). centre: (x, y) µm, or
    "colony" for the centre of the colony. floor: the level from which a cell counts as lit.
    edge_width: µm; an edge is a logistic that rises from 0.27 to 0.73 between one width before it
    and one width behind it.
    """

    species: tuple[str, ...]
    edges: tuple[float, ...]
    _: KW_ONLY
    along: str = "x"
    centre: Centre = (0.0, 0.0)
    floor: float = 0.0
    edge_width: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "species", species_names("Bands.species", self.species))
        checks.choice("Bands.along", self.along, ALONG)
        edges = self.edges.tolist() if isinstance(self.edges, np.ndarray) else self.edges
        rule = f"{len(self.species) + 1} ascending places in µm, one more than species"
        if (
            isinstance(edges, str)
            or not isinstance(edges, Sequence)
            or len(edges) != len(self.species) + 1
        ):
            raise checks.input_error("Bands.edges", edges, rule)
        if not all(isinstance(e, numbers.Real) and not math.isnan(e) for e in edges) or any(
            a >= b for a, b in itertools.pairwise(edges)
        ):
            raise checks.input_error("Bands.edges", edges, rule)
        if self.along == "radius" and edges[0] < 0:
            raise checks.input_error("Bands.edges[0]", edges[0], "at least 0 along the radius")
        object.__setattr__(self, "edges", tuple(map(float, edges)))
        object.__setattr__(self, "centre", checked_centre("Bands.centre", self.centre))
        check_profile("Bands", self.floor, self.edge_width)

    @property
    def names(self) -> tuple[str, ...]:
        return self.species

    def check(self, state: tf.State) -> None:
        super().check(state)
        check_along("Bands", self.along, self.centre, state)

    @property
    def least(self) -> float:
        return half(min(b - a for a, b in itertools.pairwise(self.edges)), self.edge_width)

    def target_profile(self, state: tf.State) -> Tensor:
        x = coordinate(state, self.along, self.centre)
        # a radius is never negative, so the centre is no edge
        edges = (
            (-math.inf, *self.edges[1:])
            if self.along == "radius" and self.edges[0] == 0
            else self.edges
        )
        return torch.stack(
            [between(x, a, b, self.edge_width) for a, b in itertools.pairwise(edges)], 1
        )

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        for k in range(len(self.species)):
            edges, colour = self.edges[k : k + 2], COLOURS[k % len(COLOURS)]
            draw_edges(ax, state, place, self.along, self.centre, edges, colour)

    def describe(self) -> str:
        parts = [
            f"{s} from {a:g} to {b:g}"
            for s, a, b in zip(self.species, self.edges, self.edges[1:], strict=False)
        ]
        return f"bands {in_words(self.along)}, µm: " + ", ".join(parts)


@dataclass(frozen=True)
class Ring(ProfileTarget):
    """A ring: the species should be lit between radius − width/2 and radius + width/2, µm from
    `centre`.

    centre: (x, y) µm, or "colony" for the centre of the colony. A ring as wide as twice its radius
    is a disc. floor, edge_width: as for `Bands`.
    """

    species: str
    radius: float
    width: float
    _: KW_ONLY
    centre: Centre = "colony"
    floor: float = 0.0
    edge_width: float = 1.0

    def __post_init__(self) -> None:
        species_name("Ring.species", self.species)
        checks.number("Ring.radius", self.radius, above=0.0)
        checks.number("Ring.width", self.width, above=0.0)
        if self.width > 2 * self.radius:
            raise checks.input_error(
                "Ring.width",
                self.width,
                f"at most {2 * self.radius:g}, twice the radius",
                "A disc is a ring with width = 2·radius.",
            )
        object.__setattr__(self, "centre", checked_centre("Ring.centre", self.centre))
        check_profile("Ring", self.floor, self.edge_width)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

    def check(self, state: tf.State) -> None:
        super().check(state)
        check_along("Ring", "radius", self.centre, state)

    @property
    def edges(self) -> tuple[float, float]:
        """Inner and outer radius, µm."""
        return self.radius - 0.5 * self.width, self.radius + 0.5 * self.width

    @property
    def least(self) -> float:
        return half(self.width, self.edge_width)

    def target_profile(self, state: tf.State) -> Tensor:
        low, high = self.edges
        return between(
            coordinate(state, "radius", self.centre),
            low if low > 0 else -math.inf,
            high,
            self.edge_width,
        ).unsqueeze(1)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """Those of every profile, and `radius_um`, (B,): the mean distance from the centre of the
        light above the mean level of the cells outside the ring."""
        found = super().measures(state)
        y, _ = valid_levels(state, self.names)
        dark = torch.nan_to_num(found["outside"]).index_select(0, state.colony)
        light = weights(state) * (y[:, 0] - dark).clamp(min=0.0)
        return {
            "radius_um": ratio(
                total(state, light * coordinate(state, "radius", self.centre)),
                total(state, light),
                math.nan,
            ),
            **found,
        }

    def why_undefined(self, measure: str) -> str:
        if measure == "radius_um":
            return "no cell is brighter than the mean of the cells outside the ring"
        return super().why_undefined(measure)

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        lines(ax, "radius", centre_at(state, self.centre, place), self.edges, COLOURS[0])

    def describe(self) -> str:
        return f"{self.species} in a ring of radius {self.radius:g} µm, {self.width:g} µm wide"
