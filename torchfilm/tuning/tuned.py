"""What `tune` returns: the settings that hold an error, how that is known, and its tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torchfilm.scene import Scene
from torchfilm.tuning.observables import Error
from torchfilm.tuning.settings import Settings


@dataclass(frozen=True)
class Trial:
    """One setting that was run: its errors by observable, and what its window took, s, in all (on
    the CPU of the thread that ran it) and by effect."""

    settings: Settings
    errors: dict[str, Error]
    seconds: float
    spent: dict[str, float]

    @property
    def worst(self) -> float:
        """The greatest error, with what of it may be chance."""
        return max(e.upper_bound for e in self.errors.values())


@dataclass(frozen=True)
class Tuned:
    """Settings that hold an error, and how that is known.

    scene: with the settings. error: what was asked. chosen: the try that was taken, its errors as
    of more colonies where only these could tell; own: the scene's own settings, for comparison.
    parts: by knob, how much of each observable's error comes from it. confirmed: errors in the
    other colonies. unsure: by observable, how far two references differ; left_out: observables that
    cannot be told so finely, with why. tries: the scene's own and all that might have been chosen,
    in order; runs: how many settings the first probe was run by. window: hours, cells: at its
    start, least: in the smallest colony that has any, finest: steps of the reference. Errors are
    relative, each with its standard error (`Error.value`, `.noise`).
    """

    scene: Scene
    settings: Settings
    error: float
    chosen: Trial
    own: Trial
    confirmed: dict[str, Error]
    parts: dict[str, dict[str, Error]]
    unsure: dict[str, Error]
    left_out: dict[str, str]
    tries: list[Trial]
    runs: int
    window: float
    cells: int
    least: int
    finest: int

    def __str__(self) -> str:
        return "\n".join(describe(self))


def describe(tuned: Tuned) -> list[str]:
    """The tables."""
    best, own = tuned.chosen, tuned.own
    head = (
        f"{tuned.scene.name}: {percent(tuned.error)} in {', '.join(best.errors)}, over"
        f" {tuned.window:g} h from {tuned.cells} cells in all"
    )
    head += f", {tuned.least} in the smallest colony"
    rows: list[tuple[str, ...]] = [("", "chosen", "part of the error", "of the time")]
    total = sum(best.spent.values()) or 1.0
    for knob, errors in tuned.parts.items():
        name = max(errors, key=lambda n: errors[n].value)
        share = {
            "contacts": best.spent.get("mechanics"),
            "circuits": best.spent.get("circuit"),
        }.get(knob)
        rows.append(
            (
                knob,
                _knob_text(knob, tuned.settings),
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
            str(tuned.confirmed.get(n, "not seen there")),
            str(own.errors[n]),
            str(tuned.unsure[n]),
        )
        for n, e in best.errors.items()
    ]
    lines += _aligned(rows)
    lines += [
        "  (± standard error by chance, which is allowed for in the first column; the parts may set"
        " each other off)"
    ]
    lines += [
        f"NOT CHECKED: {name}, since {why}. It may be off by more: name it (of) to have it told"
        for name, why in tuned.left_out.items()
    ]
    ratio = best.seconds / own.seconds
    return [
        *lines,
        "",
        (
            f"{best.seconds:.2g} s for the window, {ratio:.2g} times what the scene's own settings"
            f" take; {tuned.runs} settings were run"
        ),
    ]


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    wide = [max(len(r[k]) for r in rows) for k in range(len(rows[0]))]
    return [
        "  " + "  ".join(x.ljust(w) for x, w in zip(r, wide, strict=True)).rstrip() for r in rows
    ]


def _knob_text(knob: str, s: Settings) -> str:
    if knob == "step":
        return f"dt {s.dt:g} h"
    if knob == "circuits":
        return f"rtol {s.rtol:g}"
    penalty = "" if s.penalty is None else f"penalty α·γ {s.penalty:g}, "
    passes = "" if s.passes is None else f"passes {s.passes}, "
    return f"{penalty}{passes}tolerance {s.tolerance:g}"


def settings_text(settings: Settings) -> str:
    return (
        ", ".join(f"{name} {value:g}" for name, value in settings.given.items())
        or "the scene's own"
    )


def percent(error: float) -> str:
    return "failed" if math.isinf(error) else f"{100 * error:.2g} %"
