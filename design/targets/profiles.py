"""Targets that say how bright each cell should be: bands, a ring, a gradient, an image. (The stripe
at a border has its own file.)"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import (
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

Centre = Literal["colony"] | tuple[float, float]
ALONG = ("x", "y", "radius")
# of what is wanted, one a species
COLOURS = ("#c2185b", "#1976d2", "#388e3c", "#f57c00", "#7b1fa2", "#5d4037")
LEAST = 1e-3  # a cell that is wanted less bright than this is wanted dark
WITHIN = 0.5  # what is wanted of a cell that lies within an edge


class ProfileTarget(Target):
    """Targets that give a wanted profile m, one number from 0 to 1 for each cell and species.

    With volumes w of the cells that count, levels y ≥ 0 and the level `floor` from which a cell
    counts as lit, the loss of a species is

        L = 1 − (Σ w m y)² / (Σ w m² · (Σ w y² + floor² Σ w m²))

    and that of several their mean. By Cauchy–Schwarz 0 ≤ (Σ w m y)² ≤ Σ w m² · Σ w y², so L is in
    [0, 1]. Where y = c·m for all cells, L = floor²/(c² + floor²): 0 for floor = 0, at any
    brightness, and 1/2 where the brightest are just at the floor. Evenly lit cells have 1 − (Σ w
    m)²/(Σ w Σ w m²): what share of the colony is wanted dark. A colony in which no cell lies where
    it is wanted lit (m above `least`), or none is lit, has 1, with a finite gradient. Seen from
    above in 3-D.
    """

    floor: float

    @property
    def names(self) -> tuple[str, ...]:
        """The species that the target looks at."""
        raise NotImplementedError(f"{type(self).__name__}.names")

    @property
    def least(self) -> float:
        """A colony without a cell whose m is above this has not the place where the pattern should
        be."""
        return 0.0

    def target_profile(self, state: tf.State) -> Tensor:
        """The wanted profile of each species, (N, k) float64."""
        raise NotImplementedError(f"{type(self).__name__}.target_profile")

    def counted(self, state: tf.State) -> Tensor:
        """Which cells count, (N,) bool: all, if a target does not say otherwise."""
        return torch.ones_like(state.colony, dtype=torch.bool)

    def check(self, state: tf.State) -> None:
        require(state, self.names)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        y, sound = valid_levels(state, self.names)
        w = torch.where(self.counted(state), weights(state), 0.0).unsqueeze(1)
        m = self.target_profile(state)
        m = torch.where(m < LEAST, 0.0, m)
        both, lit, light = (total(state, part) for part in (w * m * y, w * m * m, w * y * y))
        each = 1.0 - ratio(both * both, lit * (light + self.floor**2 * lit), 0.0)
        # the soft tail of an edge that the colony does not reach is no pattern
        each = torch.where(total(state, w * (m > self.least)) > 0, each, 1.0)
        # rounding may take a perfect colony below 0; one after the other, for a sum along a tensor
        # may depend on the batch
        mean = sum(each.clamp(min=0.0).unbind(1), torch.zeros_like(each[:, 0])) / each.shape[1]
        return torch.where(sound, mean, self.failed)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """Of each species: mean level `inside`, where more than half is wanted, and `outside`, and
        `contrast`, the one over the other."""
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
            found[f"{before}contrast"] = ratio(inside[:, k], outside[:, k], math.nan)
        return found


@dataclass(frozen=True)
class Bands(ProfileTarget):
    """Bands side by side, or rings about each other, as in a French flag: the k-th species is
    wanted between edges[k] and edges[k + 1].

    edges: ascending, µm from `centre`, one more than species; the first may be −inf and the last
    inf. along: "x", "y" or "radius". centre: (x, y) µm, or "colony" for the colony's own. floor:
    level from which a cell counts as lit. edge_width: µm, how soft the edges are: logistic, from 0.27 to
    0.73 within one to either side.
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
        edges = self.edges
        rule = f"{len(self.species) + 1} ascending places in µm, one more than species"
        if (
            isinstance(edges, str)
            or not isinstance(edges, Sequence)
            or len(edges) != len(self.species) + 1
        ):
            raise checks.input_error("Bands.edges", edges, rule)
        if not all(isinstance(e, (int, float)) and not math.isnan(e) for e in edges) or any(
            a >= b for a, b in itertools.pairwise(edges)
        ):
            raise checks.input_error("Bands.edges", edges, rule)
        if self.along == "radius" and edges[0] < 0:
            raise checks.input_error("Bands.edges[0]", edges[0], "at least 0 along the radius")
        object.__setattr__(self, "edges", tuple(map(float, edges)))
        object.__setattr__(self, "centre", centre_of("Bands.centre", self.centre))
        common("Bands", self.floor, self.edge_width)

    @property
    def names(self) -> tuple[str, ...]:
        return self.species

    @property
    def least(self) -> float:
        return half(min(b - a for a, b in itertools.pairwise(self.edges)), self.edge_width)

    def target_profile(self, state: tf.State) -> Tensor:
        x = coordinate(state, self.along, self.centre)
        # there is nothing on the other side of the centre
        edges = (
            (-math.inf, *self.edges[1:])
            if self.along == "radius" and self.edges[0] == 0
            else self.edges
        )
        return torch.stack(
            [between(x, a, b, self.edge_width) for a, b in itertools.pairwise(edges)], 1
        )

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        middle = centre_at(state, self.centre, place)
        for k in range(len(self.species)):
            lines(ax, self.along, middle, self.edges[k : k + 2], COLOURS[k % len(COLOURS)])

    def describe(self) -> str:
        parts = [
            f"{s} from {a:g} to {b:g}"
            for s, a, b in zip(self.species, self.edges, self.edges[1:], strict=False)
        ]
        return f"bands along {self.along}, µm: " + ", ".join(parts)


@dataclass(frozen=True)
class Ring(ProfileTarget):
    """A ring: the species is wanted between radius − width/2 and radius + width/2, µm from
    `centre`, "colony" for the colony's own or (x, y) µm.

    A ring as wide as twice its radius is a disc. floor,  edge_width: as of `Bands`.
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
        object.__setattr__(self, "centre", centre_of("Ring.centre", self.centre))
        common("Ring", self.floor, self.edge_width)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

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
        """Those of every mask, and `radius_um`, the mean distance from the centre of what is
        brighter than the mean of the cells outside the ring."""
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

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        lines(ax, "radius", centre_at(state, self.centre, place), self.edges, COLOURS[0])

    def describe(self) -> str:
        return f"{self.species} in a ring of radius {self.radius:g} µm, {self.width:g} µm wide"


@dataclass(frozen=True)
class Gradient(ProfileTarget):
    """A gradient: the wanted level falls in a straight line from 1 at `low` to 0 at `high`, µm from
    `centre` along "x", "y" or "radius", and stays so beyond.

    With low > high it rises. centre, floor: as of `Bands`.
    """

    species: str
    along: str
    low: float
    high: float
    _: KW_ONLY
    centre: Centre = (0.0, 0.0)
    floor: float = 0.0

    def __post_init__(self) -> None:
        species_name("Gradient.species", self.species)
        checks.choice("Gradient.along", self.along, ALONG)
        least = 0.0 if self.along == "radius" else -math.inf
        checks.number("Gradient.low", self.low, least=least)
        checks.number("Gradient.high", self.high, least=least)
        if self.low == self.high:
            raise checks.input_error(
                "Gradient.low, Gradient.high", (self.low, self.high), "two different places"
            )
        object.__setattr__(self, "centre", centre_of("Gradient.centre", self.centre))
        common("Gradient", self.floor)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

    def target_profile(self, state: tf.State) -> Tensor:
        x = coordinate(state, self.along, self.centre)
        return ((self.high - x) / (self.high - self.low)).clamp(0.0, 1.0).unsqueeze(1)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """Those of every mask, and `correlation`, between what is there and what is wanted, −1 …
        1."""
        y, m, w = (
            valid_levels(state, self.names)[0][:, 0],
            self.target_profile(state)[:, 0],
            weights(state),
        )
        means = total(state, torch.stack([w, w * y, w * m], 1))
        mean = (means[:, 1:] / means[:, :1]).index_select(0, state.colony)
        dy, dm = y - mean[:, 0], m - mean[:, 1]
        squares = total(state, torch.stack([w * dy * dm, w * dy * dy, w * dm * dm], 1))
        return {
            "correlation": ratio(squares[:, 0], (squares[:, 1] * squares[:, 2]).sqrt(), math.nan),
            **super().measures(state),
        }

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        middle = centre_at(state, self.centre, place)
        lines(ax, self.along, middle, (self.low,), COLOURS[0], "-")
        lines(ax, self.along, middle, (self.high,), COLOURS[0], ":")

    def describe(self) -> str:
        return (
            f"{self.species} in a gradient along {self.along} from 1 at {self.low:g} µm to 0 at"
            f" {self.high:g} µm"
        )


@dataclass(frozen=True)
class Image(ProfileTarget):
    """An image: the species is wanted as bright as the picture where the cell is, and dark beside
    it.

    mask: rows of numbers from 0 to 1, the first row at the top, each the level in the middle of its
    pixel; between the middles it is bilinear. size: width and height of the whole on the plane, µm,
    with its middle at `centre`, (x, y) µm or "colony" for the colony's own. floor: as of `Bands`.
    """

    species: str
    mask: tuple[tuple[float, ...], ...]
    size: tuple[float, float]
    _: KW_ONLY
    centre: Centre = (0.0, 0.0)
    floor: float = 0.0

    def __post_init__(self) -> None:
        species_name("Image.species", self.species)
        rule = "rows of numbers from 0 to 1, all equally long, not all 0"
        try:
            pixels = np.array(self.mask, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise checks.input_error("Image.mask", self.mask, rule) from error
        if (
            pixels.ndim != 2
            or not pixels.size
            or not ((pixels >= 0) & (pixels <= 1)).all()
            or not pixels.any()
        ):
            raise checks.input_error(
                "Image.mask", pixels.tolist(), rule, "Divide a picture of bytes by 255."
            )
        object.__setattr__(self, "mask", tuple(map(tuple, pixels.tolist())))
        size = checks.vector("Image.size", self.size, 2)
        for side, length in zip("01", size, strict=True):
            checks.number(f"Image.size[{side}]", length, above=0.0)
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "centre", centre_of("Image.centre", self.centre))
        common("Image", self.floor)

    @staticmethod
    def load(
        path: str | Path,
        species: str,
        size: tuple[float, float],
        *,
        centre: Centre = (0.0, 0.0),
        floor: float = 0.0,
    ) -> Image:
        """The image in a CSV file: one row of pixels a line, numbers from 0 to 1 with commas
        between them. Raises `tf.InputError` if it cannot be read."""
        try:
            pixels = np.loadtxt(path, delimiter=",", ndmin=2)
        except (OSError, ValueError) as error:
            raise checks.input_error(
                "Image.load(path)",
                str(path),
                "a CSV file with one row of numbers a line",
                str(error),
            ) from error
        return Image(species, pixels, size, centre=centre, floor=floor)  # type: ignore[arg-type]

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

    @cached_property
    def pixels(self) -> np.ndarray:
        """(rows, columns), the first row at the bottom."""
        return np.array(self.mask)[::-1].copy()

    def target_profile(self, state: tf.State) -> Tensor:
        at = offset(state, self.centre)
        pixels = torch.as_tensor(self.pixels, device=state.device)
        inside = torch.ones_like(state.colony, dtype=torch.bool)
        before, after, share = [], [], []
        for k, count in enumerate(pixels.shape[::-1]):
            inside &= at[:, k].abs() <= 0.5 * self.size[k]
            # in pixels from the middle of the first; out to the rim the outermost goes on
            x = ((at[:, k] / self.size[k] + 0.5) * count - 0.5).clamp(0.0, count - 1.0)
            low = x.floor().long().clamp(max=max(count - 2, 0))
            before.append(low)
            after.append((low + 1).clamp(max=count - 1))
            share.append(x - low)
        (i0, j0), (i1, j1), (u, v) = before, after, share
        below = (1 - u) * pixels[j0, i0] + u * pixels[j0, i1]
        above = (1 - u) * pixels[j1, i0] + u * pixels[j1, i1]
        return torch.where(inside, (1 - v) * below + v * above, 0.0).unsqueeze(1)

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        # a frame of dark pixels closes the outline of what is lit up to the rim
        padded = np.pad(self.pixels, 1)
        x, y = (
            middle + ((np.arange(count) - 0.5) / (count - 2) - 0.5) * side
            for middle, count, side in zip(
                centre_at(state, self.centre, place), padded.shape[::-1], self.size, strict=True
            )
        )
        window = ax.get_xlim(), ax.get_ylim()
        ax.contour(x, y, padded, levels=[0.5 * padded.max()], colors=COLOURS[0], linewidths=1.0)
        ax.set(xlim=window[0], ylim=window[1])

    def describe(self) -> str:
        return (
            f"{self.species} as in an image of {len(self.mask[0])} × {len(self.mask)} pixels,"
            f" {self.size[0]:g} × {self.size[1]:g} µm"
        )


def common(kind: str, floor: object, edge_width: object = 1.0) -> None:
    """The checks of what most masks have."""
    checks.number(f"{kind}.floor", floor, least=0.0)
    checks.number(f"{kind}.edge_width", edge_width, above=0.0, hint="For a sharp edge give 0.01.")


def centre_of(name: str, given: object) -> Centre:
    """A checked centre."""
    if isinstance(given, str):
        checks.choice(name, given, ("colony",))
        return "colony"
    x, y = checks.vector(name, given, 2)
    return x, y


def between(x: Tensor, low: float, high: float, edge_width: float) -> Tensor:
    """1 between the edges and 0 beyond, each edge a logistic of `soft` µm: σ((x − low)/soft) − σ((x
    − high)/soft), so that neighbours add up to 1."""
    # by tanh, whose last bit does not depend on where in a tensor it is taken, as that of torch's
    # sigmoid does
    return 0.5 * (
        torch.tanh((x - low) / (2 * edge_width)) - torch.tanh((x - high) / (2 * edge_width))
    )


def half(width: float, edge_width: float) -> float:
    """Half of the greatest value of `between` with edges this far apart."""
    return 0.5 * math.tanh(width / (4 * edge_width))


def offset(state: tf.State, centre: Centre) -> Tensor:
    """Where cells are from the centre, (N, 2) float64 µm, without gradient."""
    place = state.position.detach()[:, :2]
    if centre == "colony":
        return place - tf.measure.colony_centre(state)[:, :2].index_select(0, state.colony)
    return place - place.new_tensor(centre)


def coordinate(state: tf.State, along: str, centre: Centre) -> Tensor:
    """Along "x", "y" or "radius" from the centre, (N,) float64 µm."""
    x, y = offset(state, centre).unbind(1)
    return x if along == "x" else y if along == "y" else (x * x + y * y).sqrt()


def centre_at(state: tf.State, centre: Centre, place: int) -> tuple[float, float]:
    """The centre of the colony at `place` of the batch, µm."""
    if centre == "colony":
        x, y = tf.measure.colony_centre(state)[place, :2].tolist()
        return x, y
    return centre  # type: ignore[return-value]


def lines(
    ax: Axes,
    along: str,
    centre: tuple[float, float],
    edges: Sequence[float],
    colour: str,
    style: str = "--",
) -> None:
    """Lines, or circles, at the edges, µm from the centre; what the axes show stays as it is."""
    from matplotlib.patches import Circle

    window = ax.get_xlim(), ax.get_ylim()
    for edge in (e for e in edges if math.isfinite(e)):
        if along == "radius":
            ax.add_patch(
                Circle(
                    centre, edge, fill=False, color=colour, linestyle=style, linewidth=1.0, zorder=3
                )
            )
        elif along == "x":
            ax.axvline(centre[0] + edge, color=colour, linestyle=style, linewidth=1.0, zorder=3)
        else:
            ax.axhline(centre[1] + edge, color=colour, linestyle=style, linewidth=1.0, zorder=3)
    ax.set(xlim=window[0], ylim=window[1])
