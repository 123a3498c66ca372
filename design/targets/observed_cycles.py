"""Tracked cells as data: the statistics of their cell cycles."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.cycles import COLUMNS, FEWEST, CellCycles, CycleStatistics, division_note
from design.targets.observed import Observed
from design.targets.observed_values import spread_of, warn_of_width
from torchfilm import checks

SHORTER = 0.95  # of the time of another movie, that is not as long
OTHER = 1.05  # times the interval of another movie, that is another one
VARIED = 0.002  # the least spread of a coefficient of variation
RELATED = 10  # complete cycles of a colony with complete mothers, to compare the two


@dataclass(frozen=True, init=False)
class ObservedCycles(Observed):
    """Cell cycles like those of tracked cells: `ObservedCycles(tf.Lineage.from_table("c.csv"))`.

    A target of a search, and data of `infer`. Each colony of the lineage, such as a movie or a
    channel of a mother machine, is a replicate; several lineages are taken as a list.

    A cycle is complete where the movie shows the division that made the cell, and its own. Of
    these the statistics are the means and coefficients of variation of generation times (h), of
    lengths at birth and at division and of added lengths (µm), and of growth rates,
    ln(volume at division / volume at birth) / generation time (1/h); the slope of the added length
    by the length at birth (0: adders, −1: sizers, above 0: timers); and the correlations of
    generation times between sisters, and of generation times, lengths at birth and growth rates
    between mothers and daughters, where each colony has 10 pairs. What does not vary has the slope
    and the correlation 0. Lengths are those of centrelines; where they are not known, the
    statistics are those of generation times.

    A simulated colony grows for as long as the movie lasts, so that long cycles are missed in both
    alike, and is seen in frames as far apart: between them cells are born and divide half an
    interval before the next one, on average, and lengths at birth and division are carried to
    there by the cell's own growth, which makes them vary more. It should begin as the movie does:
    give the scene such founders, whose own cycles do not count. The loss, and spreads, are those
    of `Observed`: cycles are drawn again with replacement, as if they were independent.

    lineages: of movies with the same interval and length, or of runs. radius: of the cells, µm, for
    their volumes. time: h, how long the movies last, by default from their first frame to the
    last. like: another `ObservedCycles`, whose statistics are taken. Raises InputError for a colony
    with fewer than 3 complete cycles. A simulated one has failed.
    """

    ragged = True
    plan: CycleStatistics  # type: ignore[assignment]
    cycles: int = field(default=0, repr=False, compare=False)

    def __init__(
        self,
        lineages: tf.Lineage | Sequence[tf.Lineage],
        *,
        radius: float = 0.5,
        time: float | None = None,
        like: ObservedCycles | None = None,
    ):
        given = _checked(lineages)
        if not isinstance(like, ObservedCycles | None):
            raise checks.input_error("ObservedCycles(like)", like, "an ObservedCycles, or None")
        checks.number("ObservedCycles(radius)", radius, above=0.0)
        each = [own for lineage in given for own in _tables(lineage, radius)]
        interval = _interval(given)
        plan = _plan(each, interval) if like is None else replace(like.plan, interval=interval)
        values = np.array([plan.of_rows(own) for own in each])
        _check_known(plan, values)
        drawn = np.array([plan.resampled_spread(own) for own in each])
        root = torch.tensor(np.sqrt((drawn * drawn).mean(0)))
        found = {
            "plan": plan,
            "values": tuple(values.mean(0).tolist()),
            "spread": tuple(
                spread_of(torch.tensor(values), root, plan.kinds, varied=VARIED).tolist()
            ),
            "colonies": len(each),
            "cells": sum(int((of.fate == "alive").sum()) for of in given),
            "time": _length(given) if time is None else checks.number("time", time, above=0.0),
            "width": 2.0 * radius,
            "cycles": sum(map(len, each)),
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)

    @staticmethod
    def from_table(*given: Any, **options: Any) -> ObservedCycles:
        """Raises InputError: cell cycles are those of a `tf.Lineage`."""
        raise tf.InputError(
            "ObservedCycles are made of a lineage: ObservedCycles(tf.Lineage.from_table(…)), or"
            " ObservedCycles(results.lineage())."
        )

    from_masks = from_state = from_results = from_table

    def without(self, *groups: str) -> ObservedCycles:
        """The same data without some groups of statistics, such as "sisters"; `table()` lists
        them."""
        for group in groups:
            checks.choice("ObservedCycles.without", group, tuple(self.plan.groups))
        plan = replace(self.plan, omitted=(*self.plan.omitted, *groups))
        if not plan.names:
            raise checks.input_error("ObservedCycles.without", groups, "not all of the groups")
        kept = [self.plan.names.index(name) for name in plan.names]
        made = copy(self)
        object.__setattr__(made, "plan", plan)
        for name in ("values", "spread"):
            values = getattr(self, name)
            object.__setattr__(made, name, tuple(values[k] for k in kept))
        return made

    def check(self, state: tf.State) -> None:
        warn_of_width(self.width, state)

    def why_rough(self, state: tf.State) -> str:
        return "cell cycles have no derivatives by what cells contain"

    def note(self, state: tf.State) -> Tensor:
        """The time and the divisions of the last step, (B, 1 + 7M)."""
        return division_note(state)

    def statistics(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """The statistics of each colony, (B, K) float64; NaN of one with fewer than 3 complete
        cycles. history: the notes of all steps."""
        if history is None:
            raise tf.InputError(
                "cell cycles need the notes of all steps: stack target.note(state) after each of"
                " them."
            )
        found = self.plan.of(CellCycles.of_notes(history, self.plan.interval), state.colonies)
        return torch.tensor(found, device=state.device)

    def why_undefined(self, measure: str) -> str:
        few = f"the colony had fewer than {FEWEST} complete cell cycles, or pairs of relatives"
        return few if measure in self.plan.names else ""

    def describe(self) -> str:
        many = f"{self.colonies} colon" + ("ies" if self.colonies > 1 else "y")
        groups = ", ".join(self.plan.groups)
        return f"like {self.cycles} cell cycles of {many} within {self.time:g} h: {groups}"


def _checked(lineages: object) -> list[tf.Lineage]:
    given = [lineages] if isinstance(lineages, tf.Lineage) else lineages
    rule = "a tf.Lineage, such as tf.Lineage.from_table(…), or a list of them"
    if not isinstance(given, (list, tuple)) or not given:
        raise checks.input_error("ObservedCycles.lineages", lineages, rule)
    for k, of in enumerate(given):
        if not isinstance(of, tf.Lineage):
            raise checks.input_error(f"ObservedCycles.lineages[{k}]", of, rule)
    return list(given)


def _length(lineages: Sequence[tf.Lineage]) -> float:
    """How long their movies last, h."""
    spans = {}
    for k, of in enumerate(lineages):
        for colony in np.unique(of.colony).tolist():
            mine = of.colony == colony
            spans[k, colony] = float(of.last_seen[mine].max() - of.first_seen[mine].min())
    longest = max(spans.values())
    short = [(k, c) for (k, c), span in spans.items() if span < SHORTER * longest]
    if short:
        place = "" if len(lineages) == 1 else f" of lineages[{short[0][0]}]"
        raise checks.input_error(
            "ObservedCycles.lineages",
            f"colony {short[0][1]}{place}, seen for {spans[short[0]]:.3g} h",
            f"of colonies that were seen for as long as each other, and the longest is"
            f" {longest:.3g} h: long cycles are missed in short movies",
            "Cut the longer ones, leave the shorter out, or say by time=… how long all were"
            " watched, as where cells were lost.",
        )
    return round(longest, 9)


def _interval(lineages: Sequence[tf.Lineage]) -> float:
    """The time between their frames, h."""
    each = [of.interval for of in lineages]
    if max(each) > OTHER * min(each):
        rule = "of movies with the same interval between frames"
        raise checks.input_error("ObservedCycles.lineages", [f"{x:.3g} h" for x in each], rule)
    return each[0]


def _tables(lineage: tf.Lineage, radius: float) -> list[np.ndarray]:
    """The complete cycles of each colony, (M, 8)."""
    ids = np.unique(lineage.colony)
    each = CellCycles.of_lineage(lineage, radius).tables(len(ids))
    for colony, own in zip(ids.tolist(), each, strict=True):
        if len(own) < FEWEST:
            raise checks.input_error(
                f"the number of complete cell cycles of colony {colony}",
                len(own),
                f"at least {FEWEST}",
                "Leave such colonies out, or follow them for longer. Short channels whose cells"
                " are alike may be one colony.",
            )
    return each


def _plan(each: Sequence[np.ndarray], interval: float) -> CycleStatistics:
    """The statistics that all colonies have. Warns of relatives that only some have."""
    known = [dict(zip(COLUMNS, np.isfinite(own).sum(0).tolist(), strict=True)) for own in each]
    has = lambda column, least: all(colony[column] >= least for colony in known)
    for column, who in (("sister time", "sisters"), ("mother time", "mothers and daughters")):
        found = [colony[column] for colony in known]
        if min(found) < RELATED <= max(found):
            checks.warn(
                f"{who} are not compared: of the {len(found)} colonies, one has {min(found)} with"
                f" complete cycles, and {RELATED} are needed. Leave such colonies out, if that"
                " matters."
            )
    return CycleStatistics(
        lengths=has("growth", FEWEST),
        sisters=has("sister time", RELATED),
        mothers=has("mother time", RELATED),
        mothers_lengths=has("mother growth", RELATED),
        interval=interval,
    )


def _check_known(plan: CycleStatistics, values: np.ndarray) -> None:
    missing = ~np.isfinite(values).all(0)
    if missing.any():
        name = plan.names[int(np.flatnonzero(missing)[0])]
        raise checks.input_error(
            "ObservedCycles(like)",
            list(plan.groups),
            "of statistics that these data have",
            f"They have too few cells for {name!r}, or no lengths.",
        )
