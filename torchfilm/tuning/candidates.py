"""The settings that `tune` tries, from loose to tight, and how they are compared."""

from __future__ import annotations

from torchfilm.scene import Scene
from torchfilm.tuning.observables import AccuracyProbe, Error
from torchfilm.tuning.settings import Settings

# Into how many steps the window is divided: all even, so that its middle is a step too.
STEPS = (6, 8, 12, 16, 18, 20, 24, 30, 40, 48, 60, 76, 96, 120, 150)
FINEST = 240  # the reference, or twice as many
# Knobs from loose to tight: (penalty, passes beyond the least, tolerance) of contacts, and rtol of
# circuits. A larger penalty saves no time, and its overlap grows with the colony beyond what a
# probe of a small one shows. In the order of what they cost.
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
# circuits, of the error asked for: a ten-thousandth of what they may take of it would not be seen
TIGHT = 1e-3
# The larger colonies are, the more pressure they are under, and the greater are most errors: two to
# four times in a full channel, for colonies larger by half. So settings are sought in colonies
# LARGER times as large as was asked for, and confirmed in others of just that size.
LARGER = 1.5
# Of many settings the cheapest that holds the error is also the luckiest, so that some are refuted;
# where so many are, nothing will be confirmed.
MOST_REFUTED = 20
# What holds the error but for chance is looked at among MORE times as many colonies, if it takes
# less than a WORTH-th of the time; the cheapest so many.
MORE, WORTH, MOST_UNSURE = 3, 1.2, 8
# What of an error may be chance is to be this part of what was asked, at most, or more colonies are
# grown.
UNSURE = 1 / 3
# A long step lets a colony grow too much and a loose solve too little. So looser settings are not
# given up where tighter ones are over what was asked, but where they are OFF times over; at once
# where cells overlap too much, which nothing sets off. Circuits may take a SMALL part of it.
OFF, SMALL = 2.0, 0.3


def knobs_of(scene: Scene) -> dict[str, float]:
    """The accuracy settings that a scene's effects take, with their usual values."""
    return {
        name: value for effect in scene.effects for name, value in effect.accuracy_knobs().items()
    }


def smallest_colony(probe: AccuracyProbe) -> int:
    """Cells in the smallest colony that has any."""
    counts = probe.start.counts
    return int(counts[counts > 0].min()) if probe.start.cells else 0


def largest_error(errors: dict[str, Error]) -> float:
    """As measured."""
    return max((e.value for e in errors.values()), default=0.0)


def is_looser(one: Settings, other: Settings) -> bool:
    """Is every knob but the step at least as loose as the other's, of the same knobs?"""
    fewer = (one.passes or 0) <= (other.passes or 0)
    return fewer and all(
        (getattr(one, n) or 0.0) >= (getattr(other, n) or 0.0)
        for n in ("penalty", "tolerance", "rtol")
    )
