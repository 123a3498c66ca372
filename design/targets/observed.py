"""A target that is made from data: statistics of observed colonies, each with its spread."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import Target, beyond, ended_elsewhere, huber, require
from design.targets.measured import in_words
from design.targets.observed_like import counted, named, shared_plan, with_caps
from design.targets.observed_masks import masks_table
from design.targets.observed_table import read_table, warn_of_empty
from design.targets.observed_values import check_relative, values_of, warn_of_width
from design.targets.statistics import (
    LOG_CELLS,
    ColonyStatistics,
    SeenCells,
    birth_note,
    known_statistics,
    seen_cells,
)
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Observed(Target):
    """A colony like those that were observed: `Observed.from_table("cells.csv", pixel_size=0.065)`.

    values: the statistics (K,), means over the observed colonies; spread: of each, above 0; plan:
    which they are. colonies: how many were observed; cells: how many in all. time: h, when they
    were observed, or None; width: µm, the mean of the observed cells, where it is known: of a scene
    with cells of another width there is a warning. Make one by `from_table`, `from_masks`,
    `from_state` or `from_results`.

    The statistics are ln of the number of cells; the quantiles 10, 25, 50, 75 and 90 % of lengths
    and ages; the radius of gyration; cells per µm² in rings around the centre; the alignment of
    neighbours, mean cos 2φ; and for each reporter its mean, its means in the rings, Moran's I (the
    correlation between neighbours), its coefficient of variation between cells, and with
    quantiles=True its quantiles. Neighbours are cells with centres closer than `reach`. All are
    seen from above, in the x–y plane.

    Loss: the mean over the statistics of ((statistic − value)/spread)². It is about 1 for a colony
    that grew as the observed ones did, where many were observed, and some (1 + 1/n)(n − 1)/(n − 3)
    of n. Beyond 100 spreads a square grows linearly (Huber), so that data which are far off still
    tell a search where to go.

    spread is bootstrapped: the cells of each colony are drawn 200 times with replacement; the
    number of cells has 1/√N, as if divisions were independent. This leaves out what all cells of a
    colony share. With 3 colonies or more, it is the standard deviation between them where that is
    greater, and for the number of cells in any case. Spreads are at least 1 % of the greatest
    statistic of their kind; that of the number of cells is at least 2 %, and half a cell. Of one or
    two colonies the loss of a right model is 4 or more.
    """

    differentiable = True
    pattern = False
    comparable = True
    values: tuple[float, ...]
    spread: tuple[float, ...]
    plan: ColonyStatistics
    _: KW_ONLY
    colonies: int = 1
    cells: int = 0
    time: float | None = None
    # without effect on losses: studies do not depend on it
    width: float | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.plan, ColonyStatistics):
            rule = "the plan of another Observed; make one by from_table"
            raise checks.input_error("Observed.plan", self.plan, rule)
        names = self.plan.names
        for name in ("values", "spread"):
            found = checks.vector(f"Observed.{name}", getattr(self, name), len(names))
            above = 0.0 if name == "spread" else -math.inf
            for n, v in zip(names, found, strict=True):
                checks.number(f"Observed.{name}[{n!r}]", v, above=above)
            object.__setattr__(self, name, found)
        if self.time is not None:
            checks.number("Observed.time", self.time, above=0.0)

    @staticmethod
    @checks.known_keywords
    def from_table(
        table: str | Path | Mapping[str, Any],
        *,
        species: Sequence[str] = (),
        pixel_size: float | None = None,
        length_unit: str | None = None,
        angle_unit: str | None = None,
        time_unit: str | None = None,
        columns: Mapping[str, str] | None = None,
        length_with_caps: bool = False,
        relative: bool = False,
        amounts: bool = False,
        quantiles: bool = False,
        rings: int = 4,
        reach: float = 3.0,
        time: float | None = None,
        like: Observed | None = None,
    ) -> Observed:
        """The target of a table with one row for each cell: a CSV file with a header, or columns
        by name (a dictionary, or a pandas.DataFrame).

        Columns, of which any may be missing: x and y, the centre; length; angle; age; colony,
        which tells replicates apart; and those that `species` names: others are not compared.
        columns: their names in the table where they differ, such as {"x": "centroid_x"}. Units
        stand in the names of columns (x_um or x_px, angle_deg or angle_rad, age_h, age_min or
        age_s) or in arguments: pixel_size, µm a pixel; length_unit "um"; angle_unit "degrees" or
        "radians"; time_unit "h", "min" or "s". A column `radius` tells of cells of another width.

        length_with_caps: lengths include the caps, as masks measure them. relative: levels count
        relative to their mean in the colony, for a reporter in arbitrary units. amounts: levels are
        those of whole cells, concentration × volume, as a flow cytometer measures them. quantiles:
        those of each reporter are compared, too, as where cells are in two states. rings: how many,
        out to where 95 % of the cells are. reach: µm; cells with closer centres are neighbours.
        time: h, when the colonies were observed, where no column time_h or time_min says so. like:
        another `Observed`, whose rings and options are taken, so that both compare the same
        statistics; and its species, where none are given.

        Levels may be negative: less their background, those of dark cells are.

        Raises InputError for a table without units or with several frames, a column that is
        missing or not numbers, negative lengths and ages, and arguments that nothing uses.
        """
        names = named(species, like)
        units = tf.tables.Units(pixel_size, length_unit, angle_unit, time_unit)
        cells, time = read_table(table, names, units, columns or {}, length_with_caps, time)
        plan = known_statistics(
            cells, names, rings, reach, length_with_caps, relative, quantiles,
            counted(amounts, like),
        )  # fmt: skip
        return _observed(cells, plan if like is None else shared_plan(plan, like), time)

    @staticmethod
    @checks.known_keywords
    def from_masks(
        masks: Any,
        *,
        pixel_size: float | None = None,
        fluorescence: Mapping[str, Any] | None = None,
        background: str | float = "median",
        species: Sequence[str] | None = None,
        frame: int | None = None,
        drop: str | Sequence[str] = (),
        least_area: int = 30,
        relative: bool = False,
        amounts: bool = False,
        quantiles: bool = False,
        rings: int = 4,
        reach: float = 3.0,
        time: float | None = None,
        like: Observed | None = None,
    ) -> Observed:
        """The target of label images, each of which shows one colony (a replicate).

        masks: one label image or a list of them; an image is a file or an array (rows, columns).
        fluorescence: by reporter the image beside the mask, or a list of as many, in the order of
        the masks: {"gfp": ["one_gfp.tif", "other_gfp.tif"]}. species: those to compare; by default
        those of `like`, or all. pixel_size, background, frame, drop, least_area: as in
        `Cells.from_masks`, which reads each of them. Lengths are those of the centreline. Else as
        `from_table`. Raises InputError for what these two refuse, and for lists of other lengths.
        """
        caps, amounts = with_caps(False, like), counted(amounts, like)
        table = masks_table(
            masks, fluorescence, caps, amounts, pixel_size=pixel_size, background=background,
            frame=frame, drop=drop, least_area=least_area,
        )  # fmt: skip
        if species is None:
            species = tuple(fluorescence or ()) if like is None else like.plan.species
        return Observed.from_table(
            table, species=species, length_with_caps=caps, relative=relative, amounts=amounts,
            quantiles=quantiles, rings=rings, reach=reach, time=time, like=like,
        )  # fmt: skip

    @staticmethod
    @checks.known_keywords
    def from_state(
        state: tf.State,
        *,
        species: Sequence[str] = (),
        history: Tensor | None = None,
        length_with_caps: bool = False,
        relative: bool = False,
        amounts: bool = False,
        quantiles: bool = False,
        rings: int = 4,
        reach: float = 3.0,
        like: Observed | None = None,
    ) -> Observed:
        """The target of the colonies of a state, each a replicate. history: the notes of
        `Observed.note` after every step, for ages. Else as `from_table`."""
        names = named(species, like)
        if not isinstance(state, tf.State):
            raise checks.input_error("Observed.from_state(state)", state, "a tf.State")
        require(state, names)
        if bool((state.counts == 0).any()):
            place = int(state.counts.argmin())
            raise tf.InputError(
                f"Observed.from_state: colony {int(state.colony_id[place])} has no cells, and shows"
                " nothing to compare. Observe those that have: state.select([…])."
            )
        if not isinstance(history, Tensor | None):
            rule = "the notes of Observed.note after every step, stacked, or None"
            raise checks.input_error("Observed.from_state(history)", history, rule)
        length_with_caps, amounts = with_caps(length_with_caps, like), counted(amounts, like)
        whole = ColonyStatistics(
            True, history is not None, True, True, names, (0.0, 1.0), 1.0, length_with_caps,
            relative, amounts=amounts,
        )  # fmt: skip
        cells = seen_cells(state, whole, history)
        plan = known_statistics(
            cells, names, rings, reach, length_with_caps, relative, quantiles, amounts
        )
        plan = plan if like is None else shared_plan(plan, like)
        return _observed(cells, plan, state.time or None)

    @staticmethod
    @checks.known_keywords
    def from_results(
        path: str | Path,
        frame: int = -1,
        *,
        species: Sequence[str] = (),
        length_with_caps: bool = False,
        relative: bool = False,
        amounts: bool = False,
        quantiles: bool = False,
        rings: int = 4,
        reach: float = 3.0,
        like: Observed | None = None,
    ) -> Observed:
        """The target of a frame of a results file, with the ages of its cells. Else as
        `from_table`."""
        length_with_caps, amounts = with_caps(length_with_caps, like), counted(amounts, like)
        with tf.Results(path) as results:
            table, now = results.table(frame), float(results.times[frame])
            warn_of_empty(results, table)
        size = table["volume"] if amounts else 1.0
        columns = {
            "colony": table["colony"],
            "radius_um": table["radius"],
            "x_um": table["x"],
            "y_um": table["y"],
            "length_um": table["length"] + (2.0 * table["radius"] if length_with_caps else 0.0),
            "angle_rad": table["angle"],
            "age_h": table["age"],
            **{n: table[n] * size for n in named(species, like) if n in table},
        }
        return Observed.from_table(
            columns, species=species, length_with_caps=length_with_caps, relative=relative,
            amounts=amounts, quantiles=quantiles, rings=rings, reach=reach, time=now or None,
            like=like,
        )  # fmt: skip

    @property
    def names(self) -> tuple[str, ...]:
        return self.plan.species

    def without(self, *groups: str) -> Observed:
        """The same data without some groups of statistics, such as "age" or "gfp neighbours"; those
        that no model of yours could show. `table()` lists them."""
        for group in groups:
            checks.choice("Observed.without", group, tuple(self.plan.groups))
        plan = self.plan
        plan = replace(
            plan,
            omitted=(*plan.omitted, *groups),
            lengths=plan.lengths and "length" not in groups,
            ages=plan.ages and "age" not in groups,
            alignment=plan.alignment and "alignment" not in groups,
        )
        if not plan.names:
            raise checks.input_error("Observed.without", groups, "not all of the groups")
        kept = [self.plan.names.index(name) for name in plan.names]
        of = lambda values: tuple(values[k] for k in kept)
        return replace(self, values=of(self.values), spread=of(self.spread), plan=plan)

    def check(self, state: tf.State) -> None:
        self.plan.check(state)
        warn_of_width(self.width, state)

    def unfit(self, state: tf.State) -> list[str]:
        return [ended_elsewhere(state, self.time)] * state.colonies

    def note(self, state: tf.State) -> Tensor | None:
        """Time and next uid of each colony, (B, 2), which tell when cells were born; None where
        ages are not compared."""
        return birth_note(state) if self.plan.ages else None

    def statistics(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """The statistics of each colony, (B, K) float64, with gradients by the levels."""
        return self.plan.of(seen_cells(state, self.plan, history))

    @property
    def wanted(self) -> tuple[tuple[float, float], ...]:
        """From where to where each statistic is as observed, (K,): of data one number."""
        return tuple((v, v) for v in self.values)

    @property
    def bounds(self) -> dict[str, str]:
        each = zip(self.plan.names, self.wanted, strict=True)
        return {n: in_words(low, high) for n, (low, high) in each if low != high}

    def misses(self, found: Mapping[str, float]) -> dict[str, float]:
        ranges = zip(self.plan.names, self.wanted, self.spread, strict=True)
        return super().misses(found) | {
            n: max(found[n] - high, low - found[n], 0.0) / spread
            for n, (low, high), spread in ranges
            if low != high and n in found
        }

    def apart(self, found: Tensor) -> Tensor:
        """By how many spreads statistics (B, K) are off."""
        return beyond(found, self.wanted) / found.new_tensor(self.spread)

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        apart = self.apart(self.statistics(state, history))
        return huber(apart) / math.sqrt(len(self.values))

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        apart = self.residuals(state, history)
        # column by column: a sum over many columns may depend on the number of rows
        loss = sum((a * a for a in apart.unbind(1)), apart.new_zeros(len(apart)))
        return torch.where(state.counts >= self.fewest, loss, self.failed)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """The number of cells, and the other statistics by name, (B,) each."""
        found = dict(zip(self.plan.names, self.statistics(state, history).unbind(1), strict=True))
        found.pop(LOG_CELLS, None)
        return {"cells": state.counts.double(), **found}

    def why_undefined(self, measure: str) -> str:
        return "the colony has no cells" if measure in self.plan.names else ""

    def __str__(self) -> str:
        return self.table()

    def _repr_html_(self) -> str:  # the repr names all numbers: studies tell targets apart by it
        return tf.displays.card("Observed", tf.displays.text(self.table()))

    @property
    def mark(self) -> str:
        return "lines: rings" if self.plan.positions else ""

    @property
    def evidence(self) -> dict[str, tuple[float, float]]:
        found = dict(zip(self.plan.names, zip(self.values, self.spread, strict=True), strict=True))
        ranges = self.bounds
        found = {n: seen for n, seen in found.items() if n not in ranges}
        if LOG_CELLS not in found:
            return found
        log, spread = found.pop(LOG_CELLS)
        return {"cells": (math.exp(log), math.exp(log) * spread), **found}

    def table(self) -> str:
        """The statistics with their spreads, a line each."""
        lines = [f"{self.describe()}:"]
        for group, names in self.plan.groups.items():
            lines.append(group)
            for name in names:
                k = self.plan.names.index(name)
                lines.append(f"  {name:<24} {self.values[k]:>10.4g} ± {self.spread[k]:.2g}")
        return tf.displays.Text("\n".join(lines))

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        """Draw the rings around the colony's centre."""
        if not self.plan.positions:
            return
        mine = state.position[state.colony == place][:, :2]
        x, y = mine.mean(0).tolist()
        turn = np.linspace(0.0, 2.0 * np.pi, 100)
        window = ax.get_xlim(), ax.get_ylim()
        for edge in self.plan.edges[1:]:
            ax.plot(x + edge * np.cos(turn), y + edge * np.sin(turn), color="#c2185b", lw=0.6)
        ax.set(xlim=window[0], ylim=window[1])

    def describe(self) -> str:
        many = f"{self.colonies} observed colon" + ("ies" if self.colonies > 1 else "y")
        when = "" if self.time is None else f" at {self.time:g} h"
        return f"like {many}{when}, {self.cells} cells: {', '.join(self.plan.groups)}"


def _observed(cells: SeenCells, plan: ColonyStatistics, time: float | None) -> Observed:
    """The target of some cells."""
    check_relative(cells, plan)
    values, spread = values_of(cells, plan)
    count, total = len(cells.counts), int(cells.counts.sum())
    width = None if cells.radius is None else 2.0 * float(cells.radius.double().mean())
    return Observed(values, spread, plan, colonies=count, cells=total, time=time, width=width)
