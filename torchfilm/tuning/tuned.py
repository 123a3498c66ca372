"""The result of `tune`: the chosen settings, the evidence for them, and the printed tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torchfilm.scene import Scene
from torchfilm.tuning.observables import Error
from torchfilm.tuning.settings import Settings


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
        return max(e.upper_bound for e in self.errors.values())


@dataclass(frozen=True)
class Tuned:
    """Settings that keep the error within a limit, and the evidence for this.

    scene: the scene with the settings. error: the limit that the user gave. chosen: the chosen
    trial; its errors are those of the larger probe, if only that could resolve them. own: the
    scene's own settings, for comparison. confirmed: errors in the other colonies. parts: by knob,
    its part of each observable's error. unsure: by observable, the difference of two references.
    left_out: observables whose error the probe cannot resolve, with the reason. tries: the scene's
    own settings, then every candidate, in order. runs: number of settings that ran in the first
    probe. window: its length, h. cells: number of cells at its start. least: cells in the smallest
    colony that has cells. finest: steps of the reference. Errors are relative, each with its
    standard error (`Error.value`, `.noise`).
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
    """The tables, in lines."""
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
            str(tuned.confirmed.get(n, "not measured")),
            str(own.errors[n]),
            str(tuned.unsure[n]),
        )
        for n, e in best.errors.items()
    ]
    lines += _aligned(rows)
    lines += [
        "  (± standard error; the first column must pass with its 95 % upper bound; the parts may"
        " cancel each other)"
    ]
    lines += [
        f"NOT CHECKED: {name}, since {why}. Its error may exceed the limit: name it (of) to"
        " check it"
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
    penalty = "" if s.penalty is None else f"penalty {s.penalty:g}, "
    passes = "" if s.passes is None else f"passes {s.passes}, "
    return f"{penalty}{passes}tolerance {s.tolerance:g}"


def settings_text(settings: Settings) -> str:
    return (
        ", ".join(f"{name} {value:g}" for name, value in settings.given.items())
        or "the scene's own"
    )


def percent(error: float) -> str:
    return "failed" if math.isinf(error) else f"{100 * error:.2g} %"
