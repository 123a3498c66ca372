"""What accuracy costs: the settings that no other beats in both error and time, as a table and as a
picture."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from torchfilm.pictures.picture import new_figure
from torchfilm.tuning.observables import percent
from torchfilm.tuning.settings import Settings, typed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchfilm.tuning.tuned import Trial, Tuned

# The table omits settings whose error is more than this share of that of others in it.
LESS = 0.8
# The picture has errors below this share of the limit at this share: its axes are logarithmic.
LEAST = 1e-3
CHOSEN, OWN = "chosen", "the scene's own"


def cost_front(tries: Iterable[Trial]) -> list[Trial]:
    """The trials that no other beats in both error and time, from fast to slow."""
    front: list[Trial] = []
    for tried in sorted(tries, key=lambda t: (t.seconds, t.worst)):
        if tried.worst < (front[-1].worst if front else math.inf):
            front.append(tried)
    return front


def front_rows(tuned: Tuned) -> list[tuple[str, ...]]:
    """The front in rows of text, from fast to slow, with the chosen and the scene's own settings:
    error, time, the parameters as the user types them, and which of the two it is."""
    marks = {Settings(): OWN, tuned.settings: CHOSEN}
    marked = [t for t in tuned.tries if t.settings in marks]
    front = tuned.front
    # a front point near the scene's own settings stays where it is faster than they are
    instead = [t for t in marked if t in front or t.settings == tuned.settings]
    shown = sorted([*_thinned(front, instead), *marked], key=lambda t: t.seconds)
    typed_each = [typed(t.settings.apply(tuned.given)) for t in shown]
    names = list(dict.fromkeys(name for values in typed_each for name in values))
    rows: list[tuple[str, ...]] = [("error", "time", *names, "")]
    for tried, values in zip(shown, typed_each, strict=True):
        rows.append(
            (
                f"{percent(tried.worst)} ({tried.worst_name})",
                f"{tried.seconds / tuned.own.seconds:.2g}",
                *(values.get(name, "") for name in names),
                marks.get(tried.settings, ""),
            )
        )
    return rows


def _thinned(front: list[Trial], marked: list[Trial]) -> list[Trial]:
    """The trials of a front whose errors are not near that of another one that is shown."""
    near = lambda a, b: LESS * max(a.worst, b.worst) < min(a.worst, b.worst)
    kept: list[Trial] = []
    for tried in front:
        if tried not in marked and not any(near(tried, other) for other in [*kept[-1:], *marked]):
            kept.append(tried)
    return kept


def draw_front(tuned: Tuned) -> Figure:
    """Error against time of everything that ran, with the front, the requested error, the chosen
    and the scene's own settings."""
    figure = new_figure(6.4, 4.4)
    ax = figure.add_subplot()
    ran = [t for t in tuned.tries if math.isfinite(t.worst)]
    time, error = _places(tuned, ran)
    ax.plot(time, error, ".", color="0.7", ms=5, label="every setting that ran")
    time, error = _places(tuned, tuned.front)
    # nothing that ran lies between two neighbours: a step, not a slope
    ax.step(time, error, where="post", color="C0", lw=1)
    ax.plot(time, error, "o", color="C0", ms=4, label="front: none is both faster and better")
    labelled = _thinned(tuned.front, [])
    for tried, x, y in zip(labelled, *_places(tuned, labelled), strict=True):
        step = f"{tried.settings.dt or tuned.given.dt:.3g} h"
        ax.annotate(step, (x, y), xytext=(4, 3), textcoords="offset points", fontsize=6)
    for settings, mark, size, colour, label in (
        (Settings(), "s", 7, "black", OWN),
        (tuned.settings, "*", 13, "C3", CHOSEN),
    ):
        time, error = _places(tuned, [t for t in ran if t.settings == settings])
        ax.plot(time, error, mark, color=colour, ms=size, ls="", label=label)
    ax.axhline(100 * tuned.error, color="C3", lw=0.8, ls=":", label="requested error")
    ax.set(xscale="log", yscale="log")
    ax.margins(x=0.1)  # room for the label of the last point
    for axis, name in (
        (ax.xaxis, "computing time, relative to the scene's own settings"),
        (ax.yaxis, "greatest error of an observable (95 % upper bound), %"),
    ):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
        axis.set_label_text(name)
    ax.tick_params(which="both", labelsize=7)
    ax.set_title(f"{tuned.given.name}: what accuracy costs (beside the front: dt)", fontsize=10)
    ax.legend(fontsize=7)
    return figure


def _places(tuned: Tuned, tries: list[Trial]) -> tuple[list[float], list[float]]:
    """Times relative to that of the scene's own settings, and errors in %."""
    time = [t.seconds / tuned.own.seconds for t in tries]
    return time, [100 * max(t.worst, LEAST * tuned.error) for t in tries]
