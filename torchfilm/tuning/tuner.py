"""The cheapest settings that keep the error within a limit: `tune(scene, error=0.01)`.

1. `tune` grows a few colonies with the scene's own settings. From that state it runs a window of
   some steps repeatedly: once with far tighter settings, the reference, then with other settings.
   For each step length it tries the knobs from loose to tight.
2. It compares every observable with the reference. `torchfilm.tuning.observables` lists them. The
   upper bound of each error (95 %) must be at most the given error.
3. Of the settings that pass, it takes those that need the least time, and confirms them in other
   colonies, which are smaller by a third.
4. It tests cheaper settings again in more colonies, if their error passes but its upper bound does
   not.
5. It runs the chosen settings again with each knob tightened in turn. This gives each knob's part
   of the error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.warn_once import once
from torchfilm.tuning.candidates import LARGER, MORE, UNSURE
from torchfilm.tuning.observables import SIGNAL, AccuracyProbe, begin, observables, species
from torchfilm.tuning.settings import Settings
from torchfilm.tuning.settings_search import SettingsSearch
from torchfilm.tuning.tuned import Tuned


@checks.known_keywords
@once()  # it binds the scene many times
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
    """Finds the cheapest settings that keep a scene's observables within `error` (relative: 0.01
    for 1 %) of what far tighter settings give. It takes some minutes.

    cells: the number of cells per colony in the run that you plan. The error stays within the limit
    in a probe that starts with this many cells, and in one that starts with half as many again. A
    scene that stays smaller is probed where it stops growing.

    colonies: the number of colonies in each probe, unless the scene's parameters give it. If the
    random error is too large, `tune` grows twice or four times as many, and then three times those
    to test cheaper settings.

    of: names of the observables that matter; by default all: "cells", "volume", "radius",
    "overlap", species, "signal NAME". seed, device: of the probes. watch: a function that receives
    a line of text for each stage of the work.

    Circuits that run molecule by molecule are probed by their smooth mean, since noise is not an
    error. Raises InputError if no settings keep the error within the limit, or if the probe cannot
    resolve it; SimulationError if the scene fails before the probe starts.
    """
    if not isinstance(scene, Scene):
        raise checks.input_error("scene", scene, "a Scene, such as tf.scenes.microcolony()")
    checks.number("error", error, above=0.0, most=0.5)
    for name, given, least, why in (
        ("cells", cells, 1, ""),
        (
            "colonies",
            colonies,
            2,
            "The spread between colonies gives the standard error of each error.",
        ),
    ):
        checks.integer(name, given, least=least, hint=why)
    of = of or None
    if isinstance(of, str):
        raise checks.input_error("of", of, f"a list of names, such as {[of]}")
    many, watch = math.ceil(LARGER * cells), watch or (lambda words: None)
    watch(f"growing {colonies} colonies to {many} cells")
    probe = begin(scene, many, colonies, of, seed, device)
    _check_names(of, probe.start)
    for more in (2, 4) if scene.fixed_colonies == 1 else ():
        if _uncertainty(probe) <= UNSURE * error:
            break
        watch(f"growing {more * colonies} colonies to {many} cells")
        probe = begin(scene, many, more * colonies, of, seed, device)
    watch(f"growing {colonies} others to {cells} cells")
    other = begin(scene, cells, colonies, of, seed + 1, device)
    finer = lambda: begin(scene, many, MORE * probe.start.colonies, of, seed + 2, device)
    return SettingsSearch(
        probe, other, error, watch, finer if scene.fixed_colonies == 1 else None
    ).run()


def _check_names(of: Sequence[str] | None, state: State) -> None:
    """Raise InputError for an observable that the scene has not."""
    signals = [SIGNAL + name for name in state.signals]
    known = list(dict.fromkeys([*observables(state), *species(state), *signals]))
    for name in of or ():
        if name not in known:
            raise checks.input_error("of", name, "among " + ", ".join(known))


@torch.no_grad()
def _uncertainty(probe: AccuracyProbe) -> float:
    """The greatest uncertainty of the errors that must be resolved, from two runs: with the scene's
    own step, and with half of it."""
    one, other = (probe.observed(Settings(dt=dt)).found for dt in (None, probe.dt / 2))
    return max(
        (e.ci95 for n, e in probe.errors(one, other, apart=True).items() if n in probe.needed),
        default=0.0,
    )
