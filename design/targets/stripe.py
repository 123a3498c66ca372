"""A stripe at the border of two populations or at a given place, and measures of the stripe that a
colony has."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import contrast, ratio, species_name, total, valid_levels, weights
from design.targets.borders import border, from_border, on_axis
from design.targets.geometry import (
    COLOURS,
    between,
    check_profile,
    draw_region,
    half,
    lines,
    offset,
    periodic_along,
)
from design.targets.profiles import ProfileTarget
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STRIP = 1.0  # µm: width of the strips of the profile along the stripe's axis, that of a cell
ACROSS = 4.0  # µm: width of the strips across, in which the middle of the stripe is located
FEWEST = 3  # cells: the least number for the mean of a strip


@dataclass(frozen=True)
class Stripe(ProfileTarget):
    """A stripe across the colony: the species should be lit within `width` µm, and dark beyond.

    at: "border", the border between the two populations (cell types) of the colony, or a place, µm.
    straight: False, the stripe follows the border wherever it winds. The distance of a cell from it
    is that to the nearest cell of the other type, from centre to centre, less a cell's diameter, 0
    where cells overlap. True, the border is one straight line, at the place along the axis with the
    fewest cells on the wrong side. along: "x" or "y", the axis that the stripe lies across.
    cell_type: only cells of this type count. place: of the middle of the stripe from `at`, µm along
    the axis; from the border into the cells of `cell_type`, on either side of the others, or
    without one into the type that lies higher on the axis. The default is 0; with "border" and a
    cell_type, the stripe adjoins the border on the side of that type. floor: the level from which
    a cell counts as lit. edge_width: µm, as for `Bands`. A colony that has lost one of its two
    types, or `cell_type`, has failed.
    """

    species: str
    _: KW_ONLY
    at: str | float = "border"
    width: float
    place: float | None = None
    along: str = "x"
    cell_type: int | None = None
    floor: float = 0.0
    edge_width: float = 1.0
    straight: bool = False

    def __post_init__(self) -> None:
        species_name("Stripe.species", self.species)
        if isinstance(self.at, str):
            checks.choice("Stripe.at", self.at, ("border",))
        else:
            checks.number("Stripe.at", self.at, hint='Give a place in µm, or "border".')
        checks.number("Stripe.width", self.width, above=0.0)
        if self.place is not None:
            checks.number("Stripe.place", self.place)
        checks.choice("Stripe.along", self.along, ("x", "y"))
        if self.cell_type is not None:
            object.__setattr__(
                self,
                "cell_type",
                checks.integer(
                    "Stripe.cell_type", self.cell_type, least=0, hint="Or None: all cells."
                ),
            )
        checks.choice("Stripe.straight", self.straight, (True, False))
        check_profile("Stripe", self.floor, self.edge_width)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

    def check(self, state: tf.State) -> None:
        super().check(state)
        if self.at != "border" and self.cell_type is None:
            return
        if self.at == "border" and periodic_along(state, self.along):
            hint = "Give at= a place in µm."
            rule = f"a place, as space is periodic along {self.along}: borders come in pairs"
            raise checks.input_error("Stripe.at", self.at, rule, hint)
        if "cell_type" not in state.fields:
            raise tf.InputError(
                "Stripe: the cells have no types. Give types to the founders:"
                " founders=tf.Cells(…, cell_type=[0, 1])."
            )
        for k, there in enumerate(_types(state)):
            if self.at == "border" and len(there) != 2:
                hint = "Give the founders two types, or give at= a place in µm."
                raise tf.InputError(
                    'Stripe(at="border"): a border needs exactly two types of cells, and colony'
                    f" {k} has {there}. {hint}"
                )
            if self.cell_type is not None and self.cell_type not in there:
                raise checks.input_error(
                    "Stripe.cell_type",
                    self.cell_type,
                    f"a type in every colony; colony {k} has {there}",
                )

    def counted(self, state: tf.State) -> Tensor:
        return (
            super().counted(state) if self.cell_type is None else state.cell_type == self.cell_type
        )

    def unfit(self, state: tf.State) -> list[str]:
        if self.at != "border" and self.cell_type is None:
            return [""] * state.colonies
        out = []
        for there in _types(state):
            if self.at == "border" and len(there) != 2:
                out.append(f"it has no border: only cells of type {there} are left")
            elif self.cell_type is not None and self.cell_type not in there:
                out.append(f"it has no cells of type {self.cell_type}, only of {there}")
            else:
                out.append("")
        return out

    @property
    def least(self) -> float:
        return half(self.width, self.edge_width)

    @property
    def winds(self) -> bool:
        """Whether the stripe follows the border."""
        return self.at == "border" and not self.straight

    def reference(self, state: tf.State) -> tuple[Tensor, Tensor, Tensor]:
        """The place of `at` along the axis and the middle of the stripe relative to it, (B,)
        float64 µm each, and the distance of each cell from `at`, (N,) µm, positive along the axis.
        NaN where a colony has no border."""
        place = 0.0 if self.place is None else self.place
        if not isinstance(self.at, str):
            at = torch.full(
                (state.colonies,), float(self.at), dtype=torch.float64, device=state.device
            )
            away = offset(state, (float(self.at),) * 2)[:, "xy".index(self.along)]
            return at, torch.full_like(at, place), away
        at, low_type = border(state, self.along)
        if self.place is None and self.cell_type is not None:
            place = 0.5 * self.width
        middle = torch.full_like(at, place)
        if self.cell_type is not None:  # into the cells of this type
            middle = torch.where(low_type == self.cell_type, -middle, middle)
        return (
            at,
            middle,
            (
                from_border(state, low_type)
                if self.winds
                else on_axis(state, self.along) - at.index_select(0, state.colony)
            ),
        )

    def target_profile(self, state: tf.State) -> Tensor:
        _, middle, distance = self.reference(state)
        x = distance - middle.index_select(0, state.colony)
        low, high = -0.5 * self.width, 0.5 * self.width
        if self.winds and self.place is None and self.cell_type is not None:
            # on the side of the border the border itself is the edge
            low, x = -math.inf, torch.where(middle.index_select(0, state.colony) < 0, -x, x)
        return torch.nan_to_num(between(x, low, high, self.edge_width)).unsqueeze(1)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """Of the cells that count, each (B,):

        place_um: mean distance from `at` of the light above the level of far cells, those farther
        than 2·width from the target's middle; width_um: full width at half maximum of the profile
        in strips of 1 µm, with lines between their middles; peak: the greatest mean of a strip;
        contrast: mean level inside the target stripe over that of the far cells; straightness_um:
        root mean square distance from a straight line of the middle of the bright cells, over
        strips of 4 µm across. Bright cells have at least half the peak.
        """
        y, (_, middle, x) = valid_levels(state, self.names)[0][:, 0], self.reference(state)
        # a colony without a border has no place: its cells are left out, and its measures are NaN
        w = torch.where(self.counted(state) & torch.isfinite(x), weights(state), 0.0)
        x = torch.nan_to_num(x)
        away = (x - middle.index_select(0, state.colony)).abs()
        inside, far = w * (away <= 0.5 * self.width), w * (away > 2 * self.width)
        bright, dark = (
            ratio(total(state, part * y), total(state, part), math.nan) for part in (inside, far)
        )
        light = w * (y - torch.nan_to_num(dark).index_select(0, state.colony)).clamp(min=0.0)
        found = {"place_um": ratio(total(state, light * x), total(state, light), math.nan)}
        kept = (w > 0).cpu().numpy()
        place = on_axis(state, self.along)
        if not isinstance(self.at, str):  # of the nearest image
            place = self.at + x
        columns = (state.colony, x, place, on_axis(state, "y" if self.along == "x" else "x"), y, w)
        owner, away_from, along, across, level, weight = (v.cpu().numpy()[kept] for v in columns)
        peak, width = profile(owner, away_from, level, weight, state.colonies)
        straight = straightness(owner, along, across, level, weight, peak)
        found |= {
            name: torch.as_tensor(v, device=state.device)
            for name, v in (("width_um", width), ("peak", peak), ("straightness_um", straight))
        }
        return found | {"contrast": contrast(bright, dark)}

    @property
    def mark(self) -> str:
        if self.winds:
            return "red outline: cells that should be lit"
        return "red lines" + (", dotted: the border" if self.at == "border" else "")

    def why_undefined(self, measure: str) -> str:
        if measure == "contrast":
            return (
                f"no cells that count are farther than {2 * self.width:g} µm from the middle of the"
                " stripe (grow larger colonies, or give a narrower stripe), or nothing is lit"
            )
        if measure in ("place_um", "width_um", "peak", "straightness_um"):
            return "nothing is lit, or fewer than three cells that count lie in each strip of 1 µm"
        return ""

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        """Draw the edges of the stripe and the border as lines or, where it winds, an outline of
        the cells that should be lit."""
        if self.winds:
            level = torch.where(self.counted(state), self.target_profile(state)[:, 0], 0.0)
            draw_region(ax, state, place, level, COLOURS[0])
            return
        at, middle = (float(v[place]) for v in self.reference(state)[:2])
        lines(
            ax,
            self.along,
            (0.0, 0.0),
            (at + middle - 0.5 * self.width, at + middle + 0.5 * self.width),
            COLOURS[0],
        )
        if self.at == "border":
            lines(ax, self.along, (0.0, 0.0), (at,), "black", ":")

    def describe(self) -> str:
        at = (
            f"the {'straight ' if self.straight else ''}border"
            if self.at == "border"
            else f"{self.along} = {self.at:g} µm"
        )
        place = "" if self.place is None else f", {self.place:+g} µm from it"
        whose = "" if self.cell_type is None else f", cells of type {self.cell_type}"
        return f"{self.species} in a stripe {self.width:g} µm wide at {at}{place}{whose}"


def _types(state: tf.State) -> list[list[int]]:
    """The types of cells that are in each colony, ascending."""
    pairs = torch.unique(torch.stack([state.colony, state.cell_type], 1), dim=0)
    found: list[list[int]] = [[] for _ in range(state.colonies)]
    for colony, kind in pairs.tolist():
        found[colony].append(kind)
    return found


def profile(
    owner: np.ndarray, x: np.ndarray, level: np.ndarray, weight: np.ndarray, colonies: int
) -> tuple[np.ndarray, np.ndarray]:
    """The greatest mean level of a strip and the full width at half of it, µm, of each colony, (B,)
    each; NaN where nothing is lit.

    owner, x, level, weight: (N,), colony by colony. Strips with fewer than three cells are ignored.
    """
    colony, centre, strip = strips(owner, x, STRIP)
    mean = np.bincount(strip, weights=weight * level) / np.bincount(strip, weights=weight)
    many = np.bincount(strip) >= FEWEST
    colony, centre, mean = colony[many], centre[many], mean[many]
    peak, width = np.full(colonies, np.nan), np.full(colonies, np.nan)
    np.fmax.at(peak, colony, mean)
    peak[~(peak > 0)] = np.nan
    high = mean >= 0.5 * peak[colony]
    # runs of adjacent strips that are all high or all low; the run with the peak is the stripe
    run = np.cumsum((np.diff(colony, prepend=-1) != 0) | np.diff(high, prepend=False))
    top = np.flatnonzero(mean == peak[colony])
    there, first = np.unique(colony[top], return_index=True)
    chosen = np.full(colonies, -1)
    chosen[there] = run[top[first]]
    for k in there:
        first, last = np.flatnonzero(run == chosen[k])[[0, -1]]
        low, far = (
            _half_place(colony, centre, mean, inner, side, 0.5 * peak[k])
            for inner, side in ((first, -1), (last, 1))
        )
        width[k] = far - low
    return peak, width


def _half_place(
    colony: np.ndarray, centre: np.ndarray, mean: np.ndarray, inner: int, side: int, half: float
) -> float:
    """Where the profile falls to half the peak, on the line from the outermost bright strip to the
    next on that side, µm; the edge of that strip where the colony ends there."""
    outer = inner + side
    if not 0 <= outer < len(colony) or colony[outer] != colony[inner]:
        return float(centre[inner] + side * 0.5 * STRIP)
    share = (mean[inner] - half) / (mean[inner] - mean[outer])
    return float(centre[inner] + share * (centre[outer] - centre[inner]))


def straightness(
    owner: np.ndarray,
    x: np.ndarray,
    across: np.ndarray,
    level: np.ndarray,
    weight: np.ndarray,
    peak: np.ndarray,
) -> np.ndarray:
    """The root mean square distance, along x, of the middles of a stripe from the straight line
    that fits them best, (B,) µm; NaN for fewer than three middles.

    A middle is the mean x, in one strip across, of the cells with at least half the peak (B,) of
    their colony.
    """
    lit = level >= 0.5 * peak[owner]
    owner, x, light = owner[lit], x[lit], (weight * level)[lit]
    colony, at, strip = strips(owner, across[lit], ACROSS)
    middle = np.bincount(strip, weights=light * x) / np.bincount(strip, weights=light)
    add = lambda v: np.bincount(colony, weights=v, minlength=len(peak))
    count = add(np.ones(len(colony)))
    enough = count >= 3
    some = np.where(enough, count, 1)
    t, c = at - (add(at) / some)[colony], middle - (add(middle) / some)[colony]
    slope = add(t * c) / np.where(enough, add(t * t), 1)
    return np.where(enough, np.sqrt(add((c - slope[colony] * t) ** 2) / some), np.nan)


def strips(
    owner: np.ndarray, x: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The strips, `size` µm wide, that contain cells: the colony and centre of each, colony by
    colony and in order, and the strip of each cell."""
    number = np.floor(x / size).astype(np.int64)
    low, span = (int(number.min()), int(np.ptp(number)) + 1) if len(number) else (0, 1)
    key, strip = np.unique(owner * span + number - low, return_inverse=True)
    return key // span, (key % span + low + 0.5) * size, strip
