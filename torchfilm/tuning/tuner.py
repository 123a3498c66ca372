"""The cheapest settings that hold an error: `tune(scene, error=0.01)`.

A few colonies of the scene are grown by its own settings; from that same state a window of some
steps is run again and again: once by far tighter settings, the reference, and then by other
settings, each step by knobs from loose to tight. What a user would read off at the end is compared,
observable by observable: the table is in `torchfilm.tuning.observables`. Each error, with what of
it may be chance, must be within what was asked; of the settings that are, the one that took the
least time is chosen, confirmed in other colonies that are smaller by a third, and measured once
more with each of its knobs tightened, which tells the knobs' parts in the error. Cheaper ones whose
error is within it but for chance are looked at among more colonies, and chosen if it is there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from torchfilm.scene import Scene
from torchfilm.tools import checks
from torchfilm.tuning.candidates import LARGER, MORE, UNSURE
from torchfilm.tuning.observables import SIGNAL, AccuracyProbe, begin, observables, species
from torchfilm.tuning.settings import Settings
from torchfilm.tuning.settings_search import SettingsSearch
from torchfilm.tuning.tuned import Tuned


def tune(
    scene: Scene,
    error: float = 0.01,
    *,
    cells: int = 100,
    colonies: int = 24,
    of: Sequence[str] | None = None,
    seed: int = 0,
    device: str | torch.device = "cpu",
    watch: Callable[[str], None] | None = None,
) -> Tuned:
    """The cheapest settings with which a scene's observables are within `error` (relative, 0.01 for
    1 %) of what far tighter settings give; some minutes.

    cells: in each of `colonies` colonies (or as many as the scene's parameters are for) what will
    be run: settings hold in a probe that begins there and in one that begins with half as many
    again; a scene that stays smaller is taken as it is where it grows no more. Where chance would
    hide the error, twice or four times as many colonies are grown, and three times those again
    where it hides whether cheaper settings hold it. of: names of the observables that matter, by
    default all: "cells", "volume", "radius", "overlap", species, "signal NAME". Circuits that run
    molecule by molecule are probed by their smooth mean, since noise is no error. watch: is told in
    words what is being done. Raises InputError where nothing holds the error, or where the probe
    cannot tell it; SimulationError where the scene fails on the way to where the probe begins.
    """
    if not isinstance(scene, Scene):
        raise checks.input_error("scene", scene, "a Scene, such as tf.scenes.microcolony()")
    checks.number("error", error, above=0.0, most=0.5)
    for name, given, least, why in (
        ("cells", cells, 1, ""),
        ("colonies", colonies, 2, "By how they differ it tells what of an error may be chance."),
    ):
        if isinstance(given, bool) or not isinstance(given, int) or given < least:
            raise checks.input_error(name, given, f"a whole number from {least}", why)
    of = of or None
    if isinstance(of, str):
        raise checks.input_error("of", of, f"a list of names, such as {[of]}")
    many, watch = math.ceil(LARGER * cells), watch or (lambda words: None)
    watch(f"growing {colonies} colonies to {many} cells")
    probe = begin(scene, many, colonies, of, seed, device)
    if of is not None:
        known = list(
            dict.fromkeys(
                [
                    *observables(probe.start),
                    *species(probe.start),
                    *(SIGNAL + n for n in probe.start.signals),
                ]
            )
        )
        for name in of:
            if name not in known:
                raise checks.input_error("of", name, "among " + ", ".join(known))
    for more in (2, 4) if scene.fixed_colonies == 1 else ():
        if _chance(probe) <= UNSURE * error:
            break
        watch(f"growing {more * colonies} colonies to {many} cells")
        probe = begin(scene, many, more * colonies, of, seed, device)
    watch(f"growing {colonies} others to {cells} cells")
    other = begin(scene, cells, colonies, of, seed + 1, device)
    finer = lambda: begin(scene, many, MORE * probe.start.colonies, of, seed + 2, device)
    return SettingsSearch(
        probe, other, error, watch, finer if scene.fixed_colonies == 1 else None
    ).run()


@torch.no_grad()
def _chance(probe: AccuracyProbe) -> float:
    """How much of the error in what must be told, the volume or what was named, may be chance: as
    runs by the scene's own step and by half of it differ."""
    one, other = (probe.observed(Settings(dt=dt)).found for dt in (None, probe.dt / 2))
    return max(
        (e.ci95 for n, e in probe.errors(one, other, apart=True).items() if n in probe.needed),
        default=0.0,
    )
