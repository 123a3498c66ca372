"""What a search shows: a bar while it runs, a table, and a picture of first guess, best design and
target."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import torchfilm as tf
from design.parameters import Parameter, Value
from design.rollout import FinishedColonies

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from tqdm import tqdm

    from design.search import Best
    from design.targets import Target

SHOWN = 3  # replicates side by side


def bar(total: float, progress: bool) -> AbstractContextManager[tqdm | None]:
    """A bar of colonies simulated, or nothing. Needs tqdm (the `app` extra) where it is to be
    seen."""
    if not progress:
        return nullcontext()
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise tf.InputError(
            'a progress bar needs tqdm: pip install "torchfilm[app]", or give progress=False.'
        ) from error
    form = "{desc} |{bar}| {n:.0f}/{total:.0f} colonies {elapsed}<{remaining}{postfix}"
    return tqdm(total=total, bar_format=form, desc="search", disable=None, mininterval=0.3)


def table(best: Best) -> str:
    """Parameters with bounds, first guess and best value, then losses and measures."""
    search = best.search
    first = search.first()
    rows = [("parameter", "bounds", "first guess", "best")]
    for p in search.objective.space.parameters:
        bounds = (
            f"{p.low:g} … {p.high:g}"
            if isinstance(p, Parameter)
            else " | ".join(map(str, p.options))
        )
        rows.append((p.name, bounds, shown(first.values[p.name]), shown(best.values[p.name])))
    rows.append(("loss", "", f"{first.loss:.4f}", f"{best.loss:.4f}"))
    before, after = (measured(search.objective.target, b.colonies()) for b in (first, best))
    for name in after:
        rows.append((name, "", shown(before.get(name, float("nan"))), shown(after[name])))
    wide = [max(len(r[k]) for r in rows) for k in range(4)]
    lines = [
        "  ".join(
            x.ljust(w) if k < 2 else x.rjust(w)
            for k, (x, w) in enumerate(zip(r, wide, strict=True))
        )
        for r in rows
    ]
    study = search.study
    failed = sum(len(e.reasons) for e in study.entries)
    end = f"{study.colonies:.0f} colonies in {study.seconds:.0f} s" + (
        f", {failed} failed" if failed else ""
    )
    lines += [f"most failures: {words} ({times} colonies)" for words, times in study.failures()[:1]]
    return "\n".join(
        [
            *lines,
            end
            + (
                f"; grown anew for each design: {search.regrown}"
                if search.regrown
                else "; circuits ran on one recorded growth"
            ),
        ]
    )


def shown(value: Value) -> str:
    """A parameter's value in a table."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def measured(target: Target, done: Iterable[FinishedColonies]) -> dict[str, float]:
    """What a target measures, its mean over all these colonies that have the number; NaN where none
    has."""
    found: dict[str, list[float]] = {}
    for part in done:
        for name, value in target.measures(part.state, part.history).items():
            found.setdefault(name, []).extend(value.double().tolist())
    return {
        name: float(np.nanmean(v)) if np.isfinite(v).any() else float("nan")
        for name, v in found.items()
    }


def draw(best: Best, path: Path) -> Path:
    """First guess above, best design below, the target drawn over each colony, and beside them how
    the search got there."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise tf.InputError('pictures need matplotlib: pip install "torchfilm[app]".') from error
    search = best.search
    first = search.first()
    grown = [_places(one.colonies())[:SHOWN] for one in (first, best)]
    columns = max(1, *(len(g) for g in grown))
    figure = Figure(figsize=(2.6 * columns + 4.2, 6.4), layout="constrained")
    grid = figure.add_gridspec(
        4, columns + 1, width_ratios=[1.0] * columns + [1.5], height_ratios=[1.0, 0.05, 1.0, 0.05]
    )
    size = max(
        (_extent(tf.pictures.frame_of(d.state).colony(k)) for g in grown for d, k in g), default=1.0
    )
    for row, (title, one) in enumerate((("first guess", first), ("best", best))):
        axes = [figure.add_subplot(grid[2 * row, k]) for k in range(columns)]
        bars = [figure.add_subplot(grid[2 * row + 1, k]) for k in range(columns)]
        _draw_row(
            axes, bars, grown[row], search.objective.target, size, f"{title}, loss {one.loss:.3f}"
        )
    _draw_convergence(figure.add_subplot(grid[0, columns]), search)
    _draw_parameters(figure.add_subplot(grid[2:, columns]), best)
    figure.savefig(path, dpi=160)
    return path


def _places(done: list[FinishedColonies]) -> list[tuple[FinishedColonies, int]]:
    """The colonies one by one, by their ids."""
    return sorted(
        ((d, k) for d in done for k in range(d.state.colonies)),
        key=lambda x: int(x[0].state.colony_id[x[1]]),
    )


def _extent(cells: dict[str, np.ndarray]) -> float:
    """Half the side of a square that holds a colony, µm."""
    place = cells["position"][:, :2]
    return (
        float((place.max(0) - place.min(0)).max()) / 2
        + float((cells["length"] / 2 + cells["radius"]).max())
        + 0.5
    )


def _light(name: str, place: int) -> str:
    """The colour of a species: what its name says, or one of a few."""
    known = {
        "cfp": "cyan",
        "gfp": "lime",
        "yfp": "yellow",
        "rfp": "red",
        "blue": "dodgerblue",
        "white": "white",
        "red": "red",
        "green": "lime",
    }
    return known.get(name.lower(), ("yellow", "cyan", "magenta", "red", "lime", "white")[place % 6])


def _draw_row(
    axes: list[Axes],
    bars: list[Axes],
    grown: list[tuple[FinishedColonies, int]],
    target: Target,
    size: float,
    title: str,
) -> None:
    """Colonies of one design to one scale, coloured over one range by what the target looks at."""
    names = [n for n in target.names if not n.startswith("out.")]
    frames = [tf.pictures.frame_of(d.state).colony(k) for d, k in grown]
    limits = {n: (0.0, max((float(f[n].max()) for f in frames), default=1.0) or 1.0) for n in names}
    colour = names[0] if len(names) == 1 else None
    channels = {n: _light(n, k) for k, n in enumerate(names)} if len(names) > 1 else None
    scales: list[Any] = []
    for ax, (done, k), cells in zip(axes, grown, frames, strict=False):
        x, y = (cells["position"][:, :2].max(0) + cells["position"][:, :2].min(0)) / 2
        window = (x - size, x + size, y - size, y + size)
        if channels:
            ax.set_facecolor("black")
        scales = tf.pictures.draw_cells(
            ax, cells, colour=colour, channels=channels, limits=limits, window=window
        )
        target.draw(ax, done.state, k, done.history)
        tf.pictures.scale_bar(ax)
        ax.set_title(
            title if ax is axes[0] else f"replicate {int(done.state.colony_id[k])}", fontsize=9
        )
    for ax in axes[len(grown) :]:
        ax.set_visible(False)
    for ax, scale in zip(bars, scales if names else [], strict=False):
        tf.pictures.colour_bar(ax, scale)
    for ax in bars[len(scales) if names else 0 :]:
        ax.set_visible(False)


def _draw_convergence(ax: Axes, search: Any) -> None:
    colonies, _, best = search.study.convergence()
    spent = np.concatenate([[0.0], colonies])
    for entry, begin, end in zip(search.study.entries, spent[:-1], spent[1:], strict=True):
        if search.study.is_full(entry):
            ax.plot(
                np.linspace(begin, end, len(entry.loss) + 1)[1:],
                entry.loss,
                ".",
                color="0.75",
                ms=2,
                zorder=0,
            )
    ax.step(colonies, best, where="post", color="C3")
    ax.set(xlabel="colonies simulated", ylabel="loss", ylim=(0, None))
    ax.set_title("every design (grey), the best yet (red)", fontsize=9)


def _draw_parameters(ax: Axes, best: Best) -> None:
    """Where the best design and the first guess lie between the bounds."""
    space, first = best.search.objective.space, best.search.first()
    rows = np.arange(space.size)[::-1]
    ax.hlines(rows, 0, 1, color="0.85", lw=4, zorder=0)
    ax.plot(first.point, rows, "o", color="0.55", label="first guess")
    ax.plot(best.point, rows, "D", color="C3", label="best")
    for y, p in zip(rows, space.parameters, strict=True):
        low, high = (
            (f"{p.low:g}", f"{p.high:g}")
            if isinstance(p, Parameter)
            else (str(p.options[0]), str(p.options[-1]))
        )
        for x, words, side in ((0, low, "right"), (1, high, "left")):
            ax.annotate(
                words,
                (x, y),
                xytext=(-4 if side == "right" else 4, 0),
                textcoords="offset points",
                ha=side,
                va="center",
                fontsize=7,
                color="0.4",
            )
    ax.set(
        yticks=rows,
        yticklabels=[f"{p.name} = {shown(best.values[p.name])}" for p in space.parameters],
        xticks=[],
        xlim=(-0.28, 1.28),
    )
    ax.set_ylim(-0.7, space.size - 0.3)
    ax.tick_params(left=False)
    for side in ("left", "right", "top", "bottom"):
        ax.spines[side].set_visible(False)
    ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False)
