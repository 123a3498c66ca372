"""A target whose level falls along a coordinate: linearly between two places, or as an
exponential."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import ratio, species_name, total, valid_levels, weights
from design.targets.geometry import (
    ALONG,
    COLOURS,
    Centre,
    check_along,
    check_profile,
    checked_centre,
    coordinate,
    draw_edges,
    in_words,
)
from design.targets.profiles import ProfileTarget
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EQUAL = 1e-20  # a variance, relative to the mean square, that roundings of many cells' mean make


@dataclass(frozen=True)
class Gradient(ProfileTarget):
    """A gradient: the target level falls from 1 at `low`, µm from `centre` along one of the
    coordinates of `Bands`. It is 1 before that.

    high: where it has fallen linearly to 0, µm; it is 0 beyond. With low > high it rises.
    decay_length: in place of `high`, µm; it falls as exp(−(x − low)/decay_length), as what diffuses
    and decays does, with √(diffusion/decay). Below 0 it falls the other way. centre, floor: as for
    `Bands`.
    """

    species: str
    along: str
    low: float
    high: float | None = None
    _: KW_ONLY
    decay_length: float | None = None
    centre: Centre = (0.0, 0.0)
    floor: float = 0.0

    def __post_init__(self) -> None:
        species_name("Gradient.species", self.species)
        checks.choice("Gradient.along", self.along, ALONG)
        least = 0.0 if self.along == "radius" else -math.inf
        checks.number("Gradient.low", self.low, least=least)
        if (self.high is None) == (self.decay_length is None):
            given = (self.high, self.decay_length)
            raise checks.input_error("Gradient.high, Gradient.decay_length", given, "one of them")
        if self.high is not None:
            checks.number("Gradient.high", self.high, least=least)
            if self.low == self.high:
                rule = "two different places"
                raise checks.input_error("Gradient.low, Gradient.high", (self.low, self.high), rule)
        elif checks.number("Gradient.decay_length", self.decay_length) == 0:
            raise checks.input_error("Gradient.decay_length", self.decay_length, "other than 0")
        object.__setattr__(self, "centre", checked_centre("Gradient.centre", self.centre))
        check_profile("Gradient", self.floor)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

    def check(self, state: tf.State) -> None:
        super().check(state)
        check_along("Gradient", self.along, self.centre, state)

    def target_profile(self, state: tf.State) -> Tensor:
        x = coordinate(state, self.along, self.centre)
        if self.decay_length is not None:
            return torch.exp(-((x - self.low) / self.decay_length).clamp(min=0.0)).unsqueeze(1)
        assert self.high is not None
        return ((self.high - x) / (self.high - self.low)).clamp(0.0, 1.0).unsqueeze(1)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """Those of every profile, and `correlation`, (B,), of level and target level, from −1 to
        1."""
        y, w = valid_levels(state, self.names)[0][:, 0], weights(state)
        m = self.target_profile(state)[:, 0]
        means = total(state, torch.stack([w, w * y, w * m], 1))
        mean = (means[:, 1:] / means[:, :1]).index_select(0, state.colony)
        dy, dm = y - mean[:, 0], m - mean[:, 1]
        parts = [w * dy * dm, w * dy * dy, w * dm * dm, w * y * y, w * m * m]
        both, of_y, of_m, y_square, m_square = total(state, torch.stack(parts, 1)).unbind(1)
        varied = (of_y > EQUAL * y_square) & (of_m > EQUAL * m_square)
        found = ratio(both, (of_y * of_m).sqrt(), math.nan)
        return {"correlation": torch.where(varied, found, math.nan), **super().measures(state)}

    def why_undefined(self, measure: str) -> str:
        if measure == "correlation":
            return (
                f"all cells have one level, or all lie where the gradient {self._form} is flat"
                " (grow larger colonies, or move the gradient)"
            )
        return super().why_undefined(measure)

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        """Draw a line where it begins to fall, and a dotted one where it has fallen to 0, or to
        1/e."""
        end = self.low + self.decay_length if self.decay_length is not None else self.high
        assert end is not None
        for edge, style in ((self.low, "-"), (end, ":")):
            draw_edges(ax, state, place, self.along, self.centre, (edge,), COLOURS[0], style)

    @property
    def _form(self) -> str:
        if self.decay_length is not None:
            return f"from 1 at {self.low:g} µm by a factor of e in {self.decay_length:g} µm"
        return f"from 1 at {self.low:g} µm to 0 at {self.high:g} µm"

    def describe(self) -> str:
        return f"{self.species} in a gradient {in_words(self.along)} {self._form}"
