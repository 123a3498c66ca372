"""The panels of a robustness picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

import torchfilm as tf

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LETTERS = 24  # that are shown of a parameter


def draw_losses(
    ax: Axes, columns: Sequence[tuple[str, np.ndarray]], threshold: float | None
) -> None:
    """The loss of each seed (dots) and their median (line), in named columns; the first column
    holds the searched seeds."""
    for k, (_, losses) in enumerate(columns):
        across = k + 0.25 * np.linspace(-1, 1, len(losses)) if len(losses) > 1 else np.array([k])
        ax.plot(across, losses, ".", color="C3" if k else "0.5", ms=4)
        ax.hlines(np.median(losses), k - 0.35, k + 0.35, color="black", lw=1)
    if threshold is not None:
        ax.axhline(threshold, color="0.6", lw=0.8, ls=":")
    ax.set(
        xticks=range(len(columns)),
        xticklabels=[tf.displays.shortened(name, LETTERS) for name, _ in columns],
        ylabel="loss",
        ylim=(0, None),
    )
    if len(columns) > 3:
        ax.tick_params(axis="x", labelrotation=25, labelsize=8)
    ax.set_title("each seed, and the median", fontsize=9)


def draw_changes(ax: Axes, rows: Sequence[tuple[str, float, float]]) -> None:
    """The change of the loss by each changed parameter: label, difference, standard error."""
    places = np.arange(len(rows))[::-1]
    ax.barh(
        places,
        [difference for _, difference, _ in rows],
        xerr=np.nan_to_num([error for *_, error in rows]),
        color="C0",
        ecolor="0.3",
    )
    ax.axvline(0, color="black", lw=0.8)
    ax.set(
        yticks=places,
        yticklabels=[tf.displays.shortened(label, LETTERS) for label, *_ in rows],
        xlabel="change of the loss",
    )
    ax.set_title("one parameter changed", fontsize=9)


def draw_indices(
    ax: Axes,
    names: Sequence[str],
    first: tuple[np.ndarray, np.ndarray],
    total: tuple[np.ndarray, np.ndarray],
) -> None:
    """First and total Sobol' indices of each parameter, each with its standard errors."""
    places = np.arange(len(names))[::-1]
    for shift, (index, error), label in ((0.2, first, "alone"), (-0.2, total, "with others")):
        ax.barh(places + shift, index, 0.38, xerr=error, label=label, ecolor="0.3")
    short = [tf.displays.shortened(name, LETTERS) for name in names]
    ax.set(yticks=places, yticklabels=short, xlabel="share of the loss's variance")
    ax.axvline(0, color="black", lw=0.8)
    ax.legend(fontsize=7, frameon=False)
    ax.set_title("which parameters matter", fontsize=9)
