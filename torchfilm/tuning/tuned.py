"""The result of `tune`: the chosen settings, the evidence for them, and the printed tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torchfilm.pictures.picture import Picture
from torchfilm.scene import Scene
from torchfilm.tools import displays
from torchfilm.tuning.front import cost_front, draw_front, front_rows
from torchfilm.tuning.observables import Error, percent
from torchfilm.tuning.settings import Settings, typed, typed_text

# The knob of a parameter by name; the others are of contacts.
KNOB = {"dt": "step", "rtol": "circuits"}


@dataclass(frozen=True)
class Trial:
    """Settings that were run, with their errors by observable.

    seconds: computing time of the window (on the CPU: of the thread that ran it). spent: seconds by
    effect.
    """

    settings: Settings
    errors: dict[str, Error]
    seconds: float
    spent: dict[str, float]

    @property
    def worst(self) -> float:
        """The greatest upper bound of the errors."""
        return self.errors[self.worst_name].upper_bound

    @property
    def worst_name(self) -> str:
        """The observable whose error has the greatest upper bound."""
        return max(self.errors, key=lambda name: self.errors[name].upper_bound)


@dataclass(frozen=True)
class Tuned:
    """Settings that keep the error within a limit, and the evidence for this.

    scene: the scene with the settings. given: the scene as it was. error: the limit that the user
    gave. chosen: the chosen trial; its errors are those of the larger probe, if only that could
    resolve them. own: the scene's own settings, for comparison. confirmed: errors in the other
    colonies. parts: by knob, its part of each observable's error. unsure: by observable, the
    difference of two references. left_out: observables whose error the probe cannot resolve, with
    the reason. tries: the scene's own settings, then all others that ran in the first probe, in
    order; errors in more or other colonies, where they ran there, count too. window: its length, h.
    cells: number of cells at its start. least: cells in the smallest colony that has cells. finest:
    steps of the reference. Errors are relative, each with its standard error (`Error.value`,
    `.noise`).
    """

    scene: Scene
    given: Scene
    settings: Settings
    error: float
    chosen: Trial
    own: Trial
    confirmed: dict[str, Error]
    parts: dict[str, dict[str, Error]]
    unsure: dict[str, Error]
    left_out: dict[str, str]
    tries: list[Trial]
    window: float
    cells: int
    least: int
    finest: int

    @property
    def front(self) -> list[Trial]:
        """What accuracy costs: the trials that no other beats in both error (`worst`) and time
        (`seconds`), from fast to slow."""
        return cost_front(self.tries)

    def plot(self, out: str | Path | None = None) -> Picture:
        """Draw error against computing time, with the front, the chosen and the scene's own
        settings. A notebook displays the picture; with `out` it is saved there, in place of an
        older one. Needs matplotlib (the `app` extra)."""
        return Picture(draw_front(self), out)

    def __repr__(self) -> str:
        given = ", ".join(f"{name}={value:.3g}" for name, value in self.settings.given.items())
        own = "the scene's own settings"
        return f"Tuned({self.scene.name}, {percent(self.error)}: {given or own})"

    def _repr_html_(self) -> str:
        return displays.card(repr(self), displays.text(str(self)))

    def __str__(self) -> str:
        return "\n".join(describe(self))


def describe(tuned: Tuned) -> list[str]:
    """The tables, in lines."""
    best, own = tuned.chosen, tuned.own
    head = (
        f"{tuned.scene.name}: {percent(tuned.error)} in {', '.join(best.errors)}, over"
        f" {tuned.window:g} h from {tuned.cells} cells in all"
    )
    head += f", {tuned.least} in the smallest colony"
    rows: list[tuple[str, ...]] = [("", "chosen", "part of the error", "of the time")]
    total = sum(best.spent.values()) or 1.0
    values = typed(tuned.scene)
    for knob, errors in tuned.parts.items():
        name = max(errors, key=lambda n: errors[n].value)
        share = {
            "contacts": best.spent.get("mechanics"),
            "circuits": best.spent.get("circuit"),
        }.get(knob)
        rows.append(
            (
                knob,
                typed_text({n: v for n, v in values.items() if KNOB.get(n, "contacts") == knob}),
                f"{percent(errors[name].value)} ({name})",
                "" if share is None else f"{100 * share / total:.0f} %",
            )
        )
    lines = [head, "", *_aligned(rows), ""]
    rows = [
        ("", "error", "in other colonies", "with the scene's own settings", "the reference's own")
    ]
    rows += [
        (
            n,
            str(e),
            str(tuned.confirmed.get(n, "not measured")),
            str(own.errors[n]),
            str(tuned.unsure[n]),
        )
        for n, e in best.errors.items()
    ]
    lines += _aligned(rows)
    lines += [
        "  (± standard error; the first column must pass with its 95 % upper bound; the parts may"
        " cancel each other)",
        f"  Compared over {tuned.window:g} h. What builds up for longer, such as a steady signal,"
        " may be off by more: run once with half of dt to see.",
    ]
    lines += [
        f"NOT CHECKED: {name}, since {why}. Its error may exceed the limit: name it (of) to"
        " check it"
        for name, why in tuned.left_out.items()
    ]
    return [*lines, "", *_front_lines(tuned)]


def _front_lines(tuned: Tuned) -> list[str]:
    """What accuracy costs here, in lines."""
    rows = front_rows(tuned)
    lines = [
        f"What accuracy costs: of {len(tuned.tries)} settings, those that no other beats in both"
        " error and time",
        *_aligned(rows),
        "  (error: the greatest of an observable, 95 % upper bound; time: relative to the scene's"
        f" own settings, {tuned.own.seconds:.2g} s for the window, and varies somewhat;",
    ]
    radii = ", contact_overlap in radii of cells" if "contact_overlap" in rows[0] else ""
    return [*lines, f"  dt in h{radii}; of settings with much the same error one is shown)"]


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    return [f"  {line}" for line in displays.aligned(rows, left=range(len(rows[0])))]
