"""What data take from observed cells: values of statistics, their spreads, and the width."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.measured import ENOUGH, FINEST
from design.targets.statistics import LOG_CELLS, ColonyStatistics, SeenCells, resampled_spread
from torchfilm import checks

# The least spread of the logarithm of a number of cells; and of the number itself, which is whole.
COUNT, PART = 0.02, 0.5
VARIED = 0.01  # the least spread of a coefficient of variation
OTHER_WIDTH = 0.15  # share by which cells of a scene are wider or narrower, from which it is said
SURE = 2.0  # standard errors by which the mean of a reporter is above 0, to divide by it


@torch.no_grad()
def values_of(
    cells: SeenCells, plan: ColonyStatistics
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The mean of each statistic over the colonies, (K,), and its spread."""
    each = plan.of(cells)
    resampled = [resampled_spread(cells, plan, k) for k in range(len(cells.counts))]
    drawn = torch.stack(resampled).square().mean(0).sqrt()
    spread = spread_of(each, drawn, plan.groups, float(cells.counts.double().mean()))
    return tuple(each.mean(0).tolist()), tuple(spread.tolist())


def spread_of(
    each: Tensor,
    drawn: Tensor,
    groups: Mapping[str, tuple[str, ...]],
    size: float = 1.0,
    varied: float = VARIED,
) -> Tensor:
    """The spread of each statistic, (K,) above 0. each: those of the colonies, (C, K); drawn: the
    spread within a colony, (K,); groups: the names of statistics that are of one kind; size: how
    many cells a colony has; varied: the least spread of a coefficient of variation."""
    names = [name for kind in groups.values() for name in kind]
    spread = drawn
    if len(each) >= ENOUGH:
        between = each.std(0)
        # of few colonies it is small by chance, and it contains that of drawing cells; but
        # divisions in step make numbers of cells more alike than independent ones would
        spread = torch.maximum(spread, between)
        if LOG_CELLS in names:
            at = names.index(LOG_CELLS)
            spread[at] = between[at]
    least = torch.cat([
        each[:, [names.index(n) for n in kind]].abs().max().mul(FINEST).expand(len(kind))
        for kind in groups.values()
    ])  # fmt: skip
    if names[0] == LOG_CELLS:
        least[0] = max(COUNT, PART / size)
    alike = torch.tensor([varied if n.endswith("_cv") else 0.0 for n in names])
    least = torch.maximum(least, alike.to(least))
    spread = torch.maximum(spread, least)
    # a reporter that is dark in all cells
    return torch.where(spread > 0, spread, 1.0)


def check_relative(cells: SeenCells, plan: ColonyStatistics) -> None:
    """Raise InputError for levels that count relative to a mean which is not above 0; where some
    are below, as those of dark cells less their background, by more than its error."""
    if not plan.relative or cells.levels is None:
        return
    for k, name in enumerate(plan.species):
        for colony, level in enumerate(cells.levels[:, k].double().split(cells.counts.tolist())):
            mean, count = float(level.mean()), len(level)
            error = float(level.std()) / count**0.5 if count > 1 else 0.0
            if mean <= (SURE * error if bool((level < 0).any()) else 0.0):
                raise checks.input_error(
                    f"the mean of {name} in colony {colony} (counted from 0)",
                    f"{mean:.3g} ± {error:.2g}",
                    "above 0, by two standard errors where levels are below it, as relative=True"
                    " divides by it",
                    "Subtract less of a background, leave the reporter out, or compare it in units"
                    " with relative=False.",
                )


def warn_of_width(width: float | None, state: tf.State) -> None:
    """Warn of a first state whose cells are wider or narrower than the observed ones."""
    if width is None or not state.cells:
        return
    here = 2.0 * float(state.radius.double().mean())
    if abs(here / width - 1.0) > OTHER_WIDTH:
        checks.warn(
            f"the observed cells are {width:.2f} µm wide, and those of the scene {here:.2f} µm:"
            " they have other volumes, and pack otherwise. Give the scene founders of that width:"
            f" tf.Cells.single(…, radius={width / 2:.2f})."
        )
