"""The picture of a front."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

import torchfilm as tf
from design import report_plot
from design.growing import FinishedColonies
from design.targets.base import Target

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_front(
    target: Target,
    titles: tuple[str, ...],
    every: np.ndarray,
    front: np.ndarray,
    errors: np.ndarray,
    colonies: dict[int, list[FinishedColonies]],
    course: tuple[np.ndarray, np.ndarray],
    fresh: int,
) -> Figure:
    """Draw the first two goals of all designs (n, G) and of the front (F, G) with their standard
    errors, a colony of some of its designs, by row, and the hypervolume against colonies simulated.
    fresh: the number of seeds on which those of the front were measured again, 0 where they are
    those of the search."""
    columns = max(2, len(colonies))
    figure = tf.pictures.new_figure(2.6 * columns, 6.4)
    grid = figure.add_gridspec(2, columns, height_ratios=[1.0, 0.8])
    ax = figure.add_subplot(grid[0, : max(1, (2 * columns) // 3)])
    ax.plot(every[:, 0], every[:, 1], ".", color="0.75", ms=3,
            label="every design" + ", on the seeds of the search" * bool(fresh))  # fmt: skip
    if front.shape[1] == 2:  # no design lies between two neighbours: a step, not a slope
        ax.step(front[:, 0], front[:, 1], where="post", color="C3", lw=0.8, zorder=1)
    across, up = (np.nan_to_num(errors[:, axis]) for axis in (0, 1))  # a bar of 0 where unknown
    ax.errorbar(front[:, 0], front[:, 1], up, across, "D", color="C3", ms=4, elinewidth=0.8,
                label="front" + f", on {fresh} fresh seeds" * bool(fresh))  # fmt: skip
    for row in colonies:
        ax.annotate(
            str(row),
            (front[row, 0], front[row, 1]),
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=9,
        )
    # designs that are far worse than the front would press it into a corner
    for axis, set_limits in ((0, ax.set_xlim), (1, ax.set_ylim)):
        low, high = front[:, axis].min(), front[:, axis].max()
        room = 0.6 * (high - low) or 0.1 * abs(high) or 0.1
        set_limits(low - 0.15 * room, high + room)
    ax.set(xlabel=titles[0], ylabel=titles[1])
    more = f"; not shown: {', '.join(titles[2:])}" if len(titles) > 2 else ""
    ax.set_title(f"goals: lower is better{more}", fontsize=9)
    ax.legend(fontsize=7)
    right = figure.add_subplot(grid[0, max(1, (2 * columns) // 3) :])
    right.plot(*course, ".-", color="C3")
    right.set(xlabel="colonies simulated", ylabel="hypervolume", ylim=(0, 1.05 * course[1].max()))
    report_plot.draw_colonies(
        [figure.add_subplot(grid[1, k]) for k in range(len(colonies))],
        target,
        list(colonies.values()),
        [f"design {row}" for row in colonies],
    )
    return figure
