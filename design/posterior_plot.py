"""Pictures of posteriors and of their calibration."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import torchfilm as tf
from design.parameters import Space

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS, INTERVAL = 40, (0.05, 0.95)
MOST = 0.998  # share of the samples that are drawn
RANK_BINS = 10
LIKELY = 0.99  # share of right posteriors whose bars lie within the band


def draw_corner(
    space: Space, points: np.ndarray, truth: np.ndarray | None, before: np.ndarray | None = None
) -> Figure:
    """Draw samples (S, D) in [0, 1]: histograms with the 90 % interval, and pairs, where the
    samples are. Axes are drawn in coordinates and labelled with values. truth: (D,) to mark, or
    None. before: samples of the prior, to draw as a line, or None."""
    count = space.size
    figure = tf.pictures.new_figure(1.0 + 1.8 * count, 1.0 + 1.8 * count, dpi=130)
    legend = "histograms: samples; shaded: 90 % interval; blue: pairs of samples"
    legend = legend if count > 1 else legend.rpartition(";")[0]
    legend += "" if truth is None else "; red: truth"
    legend += "" if before is None else "; line: before the data"
    figure.suptitle(textwrap.fill(legend, 14 + 30 * count), fontsize=8)
    edges = [_edges(p, points[:, k], truth, k) for k, p in enumerate(space.parameters)]
    grid: Any = figure.subplots(count, count, squeeze=False)
    for row, column in np.ndindex(count, count):
        ax = grid[row, column]
        if column > row:
            ax.set_axis_off()
            continue
        x, y = points[:, column], points[:, row]
        if row == column:
            ax.hist(x, edges[column], color="C0")
            if before is not None:
                shares = np.full(len(before), len(x) / len(before))
                drawn = dict(histtype="step", color="0.3", lw=1.0)
                ax.hist(before[:, column], edges[column], weights=shares, **drawn)
            if not hasattr(space.parameters[row], "options"):  # options have no order
                ax.axvspan(*np.quantile(x, INTERVAL), color="C0", alpha=0.15, lw=0)
        else:
            ax.hist2d(x, y, (edges[column], edges[row]), cmap="Blues")
        if truth is not None:
            _mark(ax, float(truth[column]), None if row == column else float(truth[row]))
        ax.set_xlim(edges[column][0], edges[column][-1])
        at, labels = _ticks(space.parameters[column], edges[column])
        ax.set_xticks(at, labels if row == count - 1 else [""] * len(at), fontsize=7)
        at, labels = ([], []) if row == column else _ticks(space.parameters[row], edges[row])
        ax.set_yticks(at, [""] * len(at) if column else labels, fontsize=7)
        if row == column:
            ax.set_ylabel("samples", fontsize=7)
            ax.yaxis.set_label_position("right")
        if row == count - 1:
            ax.set_xlabel(
                f"{space.names[column]}\n({_bounds(space.parameters[column])})", fontsize=9
            )
        if row and not column:
            ax.set_ylabel(space.names[row], fontsize=9)
    return figure


def _bounds(parameter: Any) -> str:
    """What the prior allows."""
    if parameter.levels is not None and hasattr(parameter, "options"):
        return f"{len(parameter.options)} options"
    return f"from {parameter.low:g} to {parameter.high:g}"


def _edges(parameter: Any, unit: np.ndarray, truth: np.ndarray | None, k: int) -> np.ndarray:
    """The edges of bins: one for each value of a choice or a whole number, else around the samples
    and the truth."""
    if parameter.levels is not None:
        return np.linspace(0.0, 1.0, parameter.levels + 1)
    low, high = np.quantile(unit, [0.5 - 0.5 * MOST, 0.5 + 0.5 * MOST])
    if truth is not None:
        low, high = min(low, truth[k]), max(high, truth[k])
    room = 0.2 * max(high - low, 1e-6)
    return np.linspace(max(0.0, low - room), min(1.0, high + room), BINS + 1)


def _ticks(parameter: Any, edges: np.ndarray) -> tuple[list[float], list[str]]:
    """Coordinates of ticks, and the values that stand there."""
    from matplotlib.ticker import MaxNLocator

    if parameter.levels is not None:
        at = 0.5 * (edges[1:] + edges[:-1])
        return at.tolist(), [str(parameter.value(float(u))) for u in at]
    low, high = (float(parameter.value(float(u))) for u in (edges[0], edges[-1]))
    if parameter.log and high > 5 * low:
        values = [m * 10.0**k for k in range(-30, 31) for m in (1, 2, 5)]
        inside = [v for v in values if low <= v <= high]
        values = inside[:: 1 + len(inside) // 6]
    else:
        values = [v for v in MaxNLocator(4).tick_values(low, high) if low <= v <= high]
    return [parameter.coordinate(float(v)) for v in values], [f"{v:.4g}" for v in values]


def _mark(ax: Axes, x: float, y: float | None) -> None:
    if y is None:
        ax.axvline(x, color="C3", lw=1.2)
    else:
        ax.plot(x, y, "+", color="C3", ms=9)


def draw_ranks(names: Sequence[str], ranks: np.ndarray, samples: int) -> Figure:
    """Draw histograms of ranks (T, P) from 0 to `samples`, each with the band in which the bars
    of right posteriors lie with a probability of 99 %."""
    from scipy.stats import binom

    truths, count = ranks.shape
    figure = tf.pictures.new_figure(2.4 * count, 2.4)
    edges = np.linspace(0, samples + 1, RANK_BINS + 1)
    low, high = binom.ppf([0.5 - 0.5 * LIKELY, 0.5 + 0.5 * LIKELY], truths, 1.0 / RANK_BINS)
    for k, ax in enumerate(figure.subplots(1, count, sharey=True, squeeze=False)[0]):
        ax.axhspan(low, high, color="0.88")
        ax.axhline(truths / RANK_BINS, color="0.5", lw=0.8)
        ax.hist(ranks[:, k], edges, color="C0", rwidth=0.9)
        ax.set(xlabel="rank of the truth", xlim=(0, samples + 1))
        ax.set_title(names[k], fontsize=9)
        ax.tick_params(labelsize=7)
    figure.axes[0].set_ylabel(f"truths of {truths}")
    return figure
