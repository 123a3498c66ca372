"""Colours: the quantities that a picture shows, their ranges and their colour maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchfilm.pictures.categories import KINDS, MOST_TYPES, colours_of_kinds
from torchfilm.pictures.frames import FOUNDER, OF_FILES, Frame, unit_of
from torchfilm.pictures.scales import Beyond, Scale, ValueRange, wide_enough
from torchfilm.pictures.shapes import VIEWS
from torchfilm.state import OUTSIDE
from torchfilm.tools import checks
from torchfilm.tools.units import is_concentration

ANGLE = "angle"
VECTORS = ("position", "axis")  # three values of a cell that are no colour
CELLS, MEAN = "cells", "mean"
# The darkest cell colour is not black, so that cells are visible on black. Missing values are grey.
FLOOR, NO_VALUE = 0.14, (0.55, 0.55, 0.55, 1.0)
TYPES = "cell_type"
# Angles of 0, 15, … 165°. In CIELAB L = 58 + 22 sin t, a = 25 sin t and b = −35 cos t, t twice the
# angle: lightness and blue–yellow tell directions apart without red and green, where a circle of
# hues has pairs that look alike.
WHEEL = (
    "#5d8ec8", "#a2a3df", "#d8b2df", "#f4b6c7", "#f0af9f", "#d09f72", "#9f8a4d", "#6c743b",
    "#40643e", "#145f54", "#006677", "#0078a2",
)  # fmt: skip

# The least range of colours of a concentration, relative to its largest value.
NARROWEST = 0.01
# The least of the range of logarithmic colours that is not given, relative to the largest value.
FAINTEST = 1e-4

Limits = Mapping[str, tuple[float, float]]
# Colours that no state has.
NOT_OF_STATES = "It is a colour of a results file: a state does not know the lines of descent."


@dataclass(frozen=True)
class PlotStyle:
    """The options of a picture, checked; they are those of `torchfilm.pictures.show`.

    Raises InputError if options are invalid or contradict each other.
    """

    colour: str | None = None
    channels: Mapping[str, str] | None = None
    background: str | None = None
    limits: Limits | None = None
    view: str = "xy"
    section: float | str = CELLS
    whole: bool = False
    log: bool | str | Sequence[str] = False

    @property
    def shows_box(self) -> bool:
        """Whether the box of a medium is seen, also where there is no cell."""
        return self.background is not None or self.whole

    def __post_init__(self) -> None:
        from matplotlib.colors import is_color_like

        checks.choice("view", self.view, tuple(VIEWS))
        checks.choice("whole", self.whole, (True, False))
        for name in ("colour", "background"):
            given = getattr(self, name)
            if given is not None and not isinstance(given, str):
                raise checks.input_error(name, given, "the name of one quantity, as text")
        if self.channels is not None:
            if self.colour is not None:
                raise checks.InputError(
                    "colour and channels both set the colours of cells: give one of them."
                )
            if not isinstance(self.channels, Mapping) or not self.channels:
                raise checks.input_error(
                    "channels",
                    self.channels,
                    'colours by name of quantity, such as {"cfp": "cyan", "yfp": "yellow"}',
                )
            for name, colour in self.channels.items():
                if not is_color_like(colour):
                    raise checks.input_error(
                        f"channels[{name!r}]", colour, 'a colour, such as "cyan" or "#00ffff"'
                    )
        if self.section not in (CELLS, MEAN):
            if isinstance(self.section, str):
                raise checks.input_error(
                    "section", self.section, '"cells", "mean", or a coordinate in µm'
                )
            checks.number("section", self.section)
        if self.section != CELLS and self.background is None:
            raise checks.input_error(
                "section",
                self.section,
                "omitted without a background: it sets where to cut the signal",
            )
        if self.limits is not None and not isinstance(self.limits, Mapping):
            name = next((n for n in (*self.quantities, self.background) if n and n != ANGLE), "yfp")
            rule = f'ranges by name of a drawn quantity, such as {{"{name}": (0, 2)}}'
            raise checks.input_error("limits", self.limits, rule)
        self._check_log()
        for name, pair in (self.limits or {}).items():
            checked_range(f"limits[{name!r}]", pair)
            self._check_drawn("limits", name)
        for drawn in filter(self.is_log, (*self.quantities, *filter(None, [self.signal]))):
            given = self.given_limits(drawn)
            if given is not None and given[0] <= 0:
                rule = "a range above 0, where its colours are logarithmic"
                raise checks.input_error(f"limits[{drawn!r}]", given, rule)

    def _check_log(self) -> None:
        """Raise InputError unless quantities with a range are drawn by their logarithms."""
        if isinstance(self.log, (bool, np.bool_)):
            if self.log and self.colour in (ANGLE, TYPES) and self.background is None:
                rule = f"left out: {self.colour} has no range of values"
                raise checks.input_error("log", True, rule)
            return
        if not isinstance(self.log, Sequence) or not all(isinstance(n, str) for n in self.log):
            rule = 'True, or the names of drawn quantities, such as ["yfp"]'
            raise checks.input_error("log", self.log, rule)
        for name in self._logarithmic:
            self._check_drawn("log", name)

    def _check_drawn(self, option: str, name: str) -> None:
        """Raise InputError unless `name` is a drawn quantity with a range, as far as is known: what
        colours cells by default is known from the first frame alone."""
        if name == ANGLE:
            raise checks.input_error(option, name, "left out: its range is 0 to 180°")
        if self.colour is None and self.channels is None:
            return
        if name not in (*self.quantities, self.background, self.signal):
            known = (n for n in (*self.quantities, self.background) if n not in (None, ANGLE))
            drawn = ", ".join(map(repr, known)) or "nothing that has a range"
            raise checks.input_error(option, name, f"the name of a drawn quantity: {drawn}")

    @property
    def _logarithmic(self) -> tuple[str, ...]:
        """The quantities whose colours are logarithmic, where these are named."""
        if isinstance(self.log, (bool, np.bool_)):
            return ()
        return (self.log,) if isinstance(self.log, str) else tuple(self.log)

    def is_log(self, name: str) -> bool:
        """Whether the colours of a quantity are logarithmic. A name without "out." means the cells'
        quantity of that name, where one is drawn."""
        if isinstance(self.log, (bool, np.bool_)):
            return bool(self.log) and name not in (ANGLE, TYPES)
        if name == self.signal and self.background not in self.quantities:
            return name in self._logarithmic or self.background in self._logarithmic
        return name in self._logarithmic

    @property
    def quantities(self) -> tuple[str, ...]:
        """The quantities that colour the cells."""
        return tuple(self.channels) if self.channels is not None else (self.colour or ANGLE,)

    @property
    def signal(self) -> str | None:
        """The background signal as "out.NAME", unlike a quantity of the cells; or None."""
        return None if self.background is None else OUTSIDE + self.background

    def given_limits(self, name: str) -> tuple[float, float] | None:
        """The user's limits for a quantity, or None.

        A name without "out." that is both a signal and a drawn quantity of the cells means the
        cells'.
        """
        limits = self.limits or {}
        found = limits.get(name)
        if found is None and name == self.signal and self.background not in self.quantities:
            found = limits.get(str(self.background))
        return None if found is None else (float(found[0]), float(found[1]))

    def check(self, frame: Frame) -> None:
        """Raises InputError if the frame lacks a quantity, a signal or an axis."""
        if max(VIEWS[self.view]) >= frame.dim:
            raise checks.input_error("view", self.view, '"xy" for 2-D cells')
        if self.whole and frame.origin is None:
            raise checks.input_error(
                "whole", True, "omitted for a scene without a medium, which has no box"
            )
        if self.background is not None and self.background not in frame.signals:
            raise checks.input_error(
                "background",
                self.background,
                "a signal of the medium: " + (", ".join(frame.signals) or "there is none"),
            )
        for name in self.quantities if self.channels is None else ():
            alone = self.background is None and self.is_log(name)
            if is_rgb(frame.cells, name) and (alone or name in self._logarithmic):
                raise checks.input_error("log", self.log, f"left out: {name} is a colour itself")
        known = [n for n, v in frame.cells.items() if v.ndim == 1]
        rgb = self.channels is None
        known += [n for n in frame.cells if rgb and is_rgb(frame.cells, n)]
        known += [n for n in frame.if_asked if n not in known and (rgb or n != FOUNDER)]
        for name in self.quantities:
            if name not in known and not (name == ANGLE and self.channels is None):
                what = "colour" if self.channels is None else "channels"
                listed = [n for n in known if n not in frame.internal]
                rule = ("'angle' or " if self.channels is None else "") + "one of "
                of_files = name in OF_FILES and name not in frame.if_asked
                hint = NOT_OF_STATES if of_files else checks.suggestion(name, [ANGLE, *listed])
                if name.startswith(OUTSIDE):
                    signal = name.removeprefix(OUTSIDE)
                    hint = f"What is outside of cells is drawn by background={signal!r}."
                raise checks.input_error(what, name, rule + ", ".join(listed), hint)


def checked_range(name: str, pair: object) -> tuple[float, float]:
    """The ends of a range of colours. Raises InputError for what is none."""
    low, high = checks.vector(name, pair, 2)
    if low >= high:
        raise checks.input_error(name, (low, high), "two numbers, the first below the second")
    return low, high


def default_colour(frame: Frame) -> str:
    """What shows most of a scene: the types of cells, where there are several; else the first
    species of its circuits; else the angle."""
    types = frame.cells.get(TYPES)
    if types is not None and len(np.unique(types)) > 1:
        return TYPES
    species = (n for n, unit in frame.units.items() if is_concentration(unit) and n in frame.cells)
    return next(species, ANGLE)


def is_rgb(cells: Mapping[str, np.ndarray], name: str) -> bool:
    """Whether a quantity of the cells is a colour: three values, red, green and blue."""
    found = cells.get(name)
    return found is not None and found.shape[1:] == (3,) and name not in VECTORS


def values_of(cells: Mapping[str, np.ndarray], name: str, view: str) -> np.ndarray:
    """A quantity of each cell, (N,).

    "angle" is the angle of the cell's axis in the view, 0 … 180°.
    """
    if name != ANGLE:
        return cells[name].astype(float)
    u, v = VIEWS[view]
    return np.degrees(
        np.mod(np.arctan2(cells["axis"][:, v], cells["axis"][:, u]).astype(float), math.pi)
    )


def scale_of(
    name: str, seen: ValueRange, style: PlotStyle, units: Mapping[str, str], note: str = ""
) -> Scale:
    """The scale of a quantity with these values."""
    from matplotlib.colors import ListedColormap

    given, unit = style.given_limits(name), unit_of(name, units)
    label = name if name != style.signal else f"{style.background} outside{note}"
    if name == ANGLE:
        return Scale(name, "angle of the axis", "°", _wheel(), (0.0, 180.0))
    log = style.is_log(name)
    by_kind = given is None and style.channels is None and not log
    if by_kind and seen.kinds and name != style.signal:
        return Scale(
            name,
            label,
            unit,
            ListedColormap(colours_of_kinds(sorted(seen.kinds), name == TYPES)),
            (0.0, 1.0),
            kinds=tuple(sorted(seen.kinds)),
        )
    low, high = (seen.low, seen.high) if seen.low <= seen.high else (0.0, 1.0)
    low = 0.0 if low == high == 1.0 and not unit else low  # a switch that is on in all cells
    if log:
        high, least = (seen.high, seen.least) if seen.high > 0 else (1.0, 0.0)
        low = max(least, FAINTEST * high)
    elif style.channels is not None and name != style.signal:
        low = min(0.0, low)  # a dark channel means a value of 0
    limits = given or wide_enough(low, high, NARROWEST if is_concentration(unit) else 0.0)
    under, over = seen.low < limits[0], seen.high > limits[1]
    beyond: Beyond = "both" if under and over else "min" if under else "max" if over else "neither"
    return Scale(name, label, unit, _colour_map(name, style), limits, beyond, log=log)


def range_of(name: str) -> ValueRange:
    """The range of a quantity of which nothing is known yet."""
    return ValueRange(MOST_TYPES if name == TYPES else len(KINDS))


def _colour_map(name: str, style: PlotStyle) -> Any:
    """The colour map of a signal, a channel or a quantity."""
    from matplotlib import colormaps
    from matplotlib.colors import LinearSegmentedColormap

    if name == style.signal:
        made: Any = LinearSegmentedColormap.from_list("signal", ["white", "black"])
    elif style.channels is not None:
        made = LinearSegmentedColormap.from_list(
            name, [lit(np.zeros(3)), lit(light(style.channels[name]))]
        )
    else:
        made = colormaps["viridis"]
    return made.with_extremes(bad=NO_VALUE)


def _wheel() -> Any:
    """A cyclic colour map. One through white or black would hide cells of one direction."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list(ANGLE, [*WHEEL, WHEEL[0]])


def light(colour: str) -> np.ndarray:
    """Red, green and blue of a named colour, (3,)."""
    from matplotlib.colors import to_rgb

    return np.array(to_rgb(colour))


def lit(rgb: np.ndarray) -> np.ndarray:
    """The colour of cells that emit this light, (…, 3)."""
    return FLOOR + (1.0 - FLOOR) * np.clip(rgb, 0.0, 1.0)


def paint_cells(
    cells: Mapping[str, np.ndarray], scales: Sequence[Scale], style: PlotStyle
) -> np.ndarray:
    """The colour of each cell, (N, 4).

    It shows one quantity, or the sum of the light of its channels, as in fluorescence microscopy. A
    quantity that is a colour itself has no scale.
    """
    name = style.quantities[0]
    if style.channels is None and is_rgb(cells, name):
        own = np.column_stack([np.clip(cells[name], 0.0, 1.0), np.ones(len(cells[name]))])
        own[np.isnan(own).any(1)] = NO_VALUE
        return own
    if style.channels is None:
        (scale,) = scales
        return scale.paint(values_of(cells, scale.name, style.view))
    levels = np.stack([s.level(cells[s.name]) for s in scales], 1)
    lights = np.stack([light(style.channels[s.name]) for s in scales])
    colours = np.concatenate([lit(np.nan_to_num(levels) @ lights), np.ones((len(levels), 1))], 1)
    colours[np.isnan(levels).any(1)] = NO_VALUE
    return colours
