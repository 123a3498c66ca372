"""The candidate settings that `tune` tries, from loose to tight, and the limits of its search."""

from __future__ import annotations

from torchfilm.scene import Scene
from torchfilm.tuning.observables import AccuracyProbe, Error
from torchfilm.tuning.settings import Settings

# Numbers of steps in the window. All are even, so that the middle of the window is a step too.
STEPS = (6, 8, 12, 16, 18, 20, 24, 30, 40, 48, 60, 76, 96, 120, 150)
FINEST = 240  # steps of the reference, which may be doubled
# Knobs from loose to tight, in the order of their cost: (penalty, passes beyond the default,
# tolerance) of contacts, and rtol of circuits. A penalty above 0.1 saves no time, and its overlap
# grows with the colony, so that a small probe underestimates it.
CONTACTS = (
    (0.1, 0, 0.2),
    (0.1, 0, 0.1),
    (0.03, 0, 0.2),
    (0.1, 0, 0.05),
    (0.03, 0, 0.1),
    (0.1, 0, 0.02),
    (0.03, 0, 0.05),
    (0.03, 0, 0.02),
    (0.01, 0, 0.05),
    (0.1, 0, 0.01),
    (0.03, 0, 0.01),
    (0.01, 0, 0.02),
    (0.01, 0, 0.01),
    (0.03, 1, 0.005),
)
CIRCUITS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
TIGHT_CONTACTS = (0.03, 3, 1e-3)
# rtol of circuits in the reference, as a share of the allowed error. Their own error is then too
# small to see.
TIGHT = 1e-3
# Larger colonies are under more pressure, and most errors are greater there: two to four times in
# a full channel, for colonies larger by half. So `tune` searches in colonies LARGER times as large
# as given, and confirms the settings in other colonies of the given size.
LARGER = 1.5
# The cheapest of many settings may be within the error by luck, and the other colonies then refute
# it. The search ends after this many refuted settings.
MOST_REFUTED = 20
# Settings whose error is within the limit, but whose upper bound is not, are tested again in MORE
# times as many colonies, if they would be WORTH times as fast as confirmed ones. At most
# MOST_UNSURE settings are tested so, the cheapest first.
MORE, WORTH, MOST_UNSURE = 3, 1.2, 8
# Greatest uncertainty of an error, as a share of the allowed error. Above it, `tune` grows more
# colonies.
UNSURE = 1 / 3
# A long step makes a colony grow too much, and a loose solve too little, so the two errors may
# cancel. Therefore `tune` skips looser settings only where tighter ones have OFF times the allowed
# error. Overlap cannot cancel: there the factor is 1. Circuits may take a SMALL share of the error.
OFF, SMALL = 2.0, 0.3


def knobs_of(scene: Scene) -> dict[str, float]:
    """The accuracy knobs of a scene's effects, with their usual values."""
    return {
        name: value for effect in scene.effects for name, value in effect.accuracy_knobs().items()
    }


def smallest_colony(probe: AccuracyProbe) -> int:
    """Number of cells in the smallest colony that has cells."""
    counts = probe.start.counts
    return int(counts[counts > 0].min()) if probe.start.cells else 0


def largest_error(errors: dict[str, Error]) -> float:
    """The greatest measured error, without its uncertainty; 0 if there is none."""
    return max((e.value for e in errors.values()), default=0.0)


def greater(errors: dict[str, Error], others: dict[str, Error]) -> dict[str, Error]:
    """The errors, each replaced by the other one of its name if that has the greater upper
    bound."""
    larger = lambda name, e: max(e, others.get(name, e), key=lambda x: x.upper_bound)
    return {name: larger(name, e) for name, e in errors.items()}


def is_looser(one: Settings, other: Settings) -> bool:
    """Whether every knob except the step is at least as loose as in `other`. Both must set the
    same knobs."""
    fewer = (one.passes or 0) <= (other.passes or 0)
    return fewer and all(
        (getattr(one, n) or 0.0) >= (getattr(other, n) or 0.0)
        for n in ("penalty", "tolerance", "rtol")
    )
