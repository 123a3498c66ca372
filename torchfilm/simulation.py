"""The loop: a step folds the state through the scene's effects, observers look on, failures are
raised once."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchfilm.io.recorder import Recorder
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.checks import SimulationError
from torchfilm.tools.timing import Timings

Observer = Callable[[State], None]


def simulate(
    scene: Scene,
    state: State,
    *,
    until: float | None = None,
    cells: int | None = None,
    dt: float | None = None,
    record: str | Path | Recorder | None = None,
    observers: Sequence[Observer] = (),
    on_failure: str = "raise",
    timings: Timings | None = None,
) -> Iterator[State]:
    """Run the scene from `state`, yielding the state after each step.

    until: time to stop at, h. cells: stop once every colony has this many cells, or none at all. At
    least one of the two; the first reached ends the run. dt: step, h; by default the scene's.
    record: path of a new results file (every tenth step and the last), or a Recorder. observers:
    called with the first state and after every step. on_failure: "raise" a SimulationError that
    names the colonies that failed (a solve that did not converge, a cell too short to divide), or
    "drop" their cells, note it, and go on.
    """
    _check_kinds("simulate", scene, state)
    dt = scene.dt if dt is None else checks.number("dt", dt, above=0.0)
    if record is not None and not isinstance(record, (str, Path, Recorder)):
        raise checks.input_error("record", record, "the path of a new results file, or a Recorder")
    observers = (observers,) if callable(observers) else tuple(observers)
    if not all(callable(o) for o in observers):
        raise checks.input_error(
            "observers", observers, "a list of functions that are called with a state"
        )
    if until is None and cells is None:
        raise checks.InputError(
            "simulate needs an end: give until=… (hours) or cells=… (per colony)."
        )
    checks.choice("on_failure", on_failure, ("raise", "drop"))
    if cells is not None and (isinstance(cells, bool) or not isinstance(cells, int) or cells < 1):
        raise checks.input_error("cells", cells, "a whole number from 1")
    last = math.inf if until is None else _last_step(state, checks.number("until", until), dt)
    scene.check(state)
    if until is None:
        assert cells is not None
        scene.check_moves(state, cells)
    recorder = Recorder(record, scene) if isinstance(record, (str, Path)) else record
    if recorder is not None:
        if recorder.scene is not scene:
            raise checks.InputError(
                "the Recorder was made for another scene than the one that runs: its file would"
                " tell of the wrong one."
            )
        recorder.dt = dt
    return _run(scene, state, last, cells, dt, recorder, observers, on_failure, timings)


def rollout(
    scene: Scene, state: State, *, until: float, dt: float | None = None, segment: int = 10
) -> State:
    """The state at `until` (h), for gradients through a long run: only every `segment`-th state is
    kept, and the steps between are taken again on the way back (torch.utils.checkpoint), so that
    memory grows with the number of segments and not of steps. Failures are raised as in `simulate`.
    """
    _check_kinds("rollout", scene, state)
    dt = scene.dt if dt is None else checks.number("dt", dt, above=0.0)
    if isinstance(segment, bool) or not isinstance(segment, int) or segment < 1:
        raise checks.input_error("segment", segment, "a whole number of steps from 1")
    last = _last_step(state, checks.number("until", until), dt)
    scene.check(state)

    def advance(begin: State, steps: int) -> State:
        for _ in range(steps):
            begin = handle_failures(scene.step(begin, dt), "raise")
        return begin

    while state.step < last:
        steps = min(segment, last - state.step)
        state = checkpoint(advance, state, steps, use_reentrant=False)
    return state


def _check_kinds(name: str, scene: object, state: object) -> None:
    if not isinstance(scene, Scene) or not isinstance(state, State):
        given = f"{name}({type(scene).__name__}, {type(state).__name__}, …)"
        raise checks.InputError(
            f"{given} is not allowed: first comes a Scene, then a State, such as tf.{name}(scene,"
            " scene.seed(colonies=8), …)."
        )


def _last_step(state: State, until: float, dt: float) -> int:
    steps = (until - state.time) / dt
    if steps < -1e-6:
        raise checks.input_error("until", until, f"at least the state's own time, {state.time:g} h")
    if abs(steps - round(steps)) > 1e-6 * max(1.0, steps):
        beside = [state.time + n * dt for n in (math.floor(steps), math.ceil(steps)) if n]
        near = " and ".join(f"{t:g}" for t in beside)
        raise checks.input_error(
            "until",
            until,
            f"a whole number of steps of dt = {dt:g} h from {state.time:g} h",
            f"Next to it: {near} h.",
        )
    return state.step + round(steps)


# How often, in steps, a run that ends at a number of cells is asked whether its colonies still
# grow, and how long they may stand still.
LOOK, STILL = 100, 1000
# A colony whose contacts do not hold has more than this share of its cells (of MANY, if it has
# fewer) in others for LONG steps. Cells thrown on a heap part in a few.
BURIED, MANY, LONG = 0.1, 50, 20


class Standstill:
    """Which colonies have fewer than `cells` cells and come no nearer: for `steps` steps none has
    become larger by a hundredth than it ever was."""

    def __init__(self, cells: int, steps: int):
        self.cells, self.steps = cells, steps
        self.largest: Tensor | None = None  # (B,) µm³, and at which step that was

    @torch.no_grad()
    def __call__(self, state: State) -> Tensor:
        """(B,) bool, of those that have cells."""
        size = state.groups.sum(state.volume)
        if self.largest is None:
            self.largest, self.since = size, torch.full_like(state.counts, state.step)
        grown = size > 1.01 * self.largest
        self.largest, self.since = (
            torch.where(grown, size, self.largest),
            torch.where(grown, state.step, self.since),
        )
        return (
            (state.step - self.since >= self.steps)
            & (state.counts > 0)
            & (state.counts < self.cells)
        )


class _Waiting:
    """Warns, once, of colonies that do not come nearer to the number of cells at which a run ends:
    it might go on for ever."""

    def __init__(self, cells: int):
        self.standstill, self.told = Standstill(cells, STILL), False

    def __call__(self, state: State) -> None:
        if self.told or state.step % LOOK:
            return
        still = self.standstill(state)
        self.told = bool(still.any())
        if self.told:
            names = ", ".join(map(str, state.colony_id[still].tolist()[:5]))
            warnings.warn(
                f"colony {names}: no larger than {STILL} steps ago, with fewer than the"
                f" {self.standstill.cells} cells at which this run ends. It may go on for ever:"
                " give a time to stop at as well (until=…, --until).",
                RuntimeWarning,
                stacklevel=3,
            )


class _Collapse:
    """Warns, once, of colonies in which cells keep lying in one another: their contacts do not hold
    them apart any more, and no solve says so."""

    def __init__(self) -> None:
        self.steps: Tensor | None = None
        self.told = False

    def __call__(self, state: State) -> None:
        report = state.reports.get("mechanics")
        if self.told or report is None:
            return
        before = torch.zeros_like(state.counts) if self.steps is None else self.steps
        self.steps = torch.where(
            report.buried > BURIED * state.counts.clamp(min=MANY), before + 1, 0
        )
        fallen = self.steps >= LONG
        self.told = bool(fallen.any())
        if self.told:
            each = zip(
                state.colony_id[fallen].tolist()[:5], report.buried[fallen].tolist(), strict=False
            )
            names = ", ".join(f"{colony} ({cells} cells)" for colony, cells in each)
            warnings.warn(
                f"step {state.step} (t = {state.time:g} h): cells have been lying deeper in one"
                f" another than a radius for {LONG} steps in colony {names}. Contacts are too hard"
                " for this step (take a smaller dt or a larger alpha), or give way too much (take"
                " a smaller alpha).",
                RuntimeWarning,
                stacklevel=3,
            )


def _run(scene, state, last, cells, dt, recorder, observers, on_failure, timings):
    waiting, collapse = _Waiting(cells) if math.isinf(last) else None, _Collapse()
    try:
        for observe in (*([recorder] if recorder else []), *observers):
            observe(state)
        while state.step < last and not (
            cells is not None and bool(((state.counts >= cells) | (state.counts == 0)).all())
        ):
            state = scene.step(state, dt, timings)
            state = handle_failures(state, on_failure)
            if recorder:
                with timings.of("recording", state.device) if timings else nullcontext():
                    recorder(state)
            for observe in observers:
                observe(state)
            if waiting:
                waiting(state)
            collapse(state)
            yield state
    finally:
        if recorder:
            recorder.close()


@dataclass(frozen=True)
class Failure:
    """A colony that failed in the last step: its place in the batch, its id and cells, why, and
    what may help."""

    place: int
    colony_id: int
    cells: int
    reason: str
    hint: str


def failures(state: State) -> list[Failure]:
    """The colonies whose last step failed, once for each reason: a solve that did not converge, a
    cell too short to divide, a circuit that left the numbers.

    Every report of the step has a `status` (B,), 0 where all is well, and says what went wrong,
    `reason(place)`, and what helps, `hint`.
    """
    found = []
    for report in state.reports.values():
        for place in torch.nonzero(report.status).squeeze(1).tolist():
            found.append(
                Failure(
                    place,
                    int(state.colony_id[place]),
                    int(state.counts[place]),
                    report.reason(place),
                    report.hint,
                )
            )
    return found


def handle_failures(state: State, on_failure: str) -> State:
    """Raise for the colonies whose last step failed, all at once, or drop their cells."""
    found = failures(state)
    if not found:
        return state
    places = sorted({f.place for f in found})
    if on_failure == "raise":
        raise SimulationError(
            f"step {state.step} (t = {state.time:g} h) failed in {len(places)} of {state.colonies}"
            " colonies:\n  "
            + "\n  ".join(f"colony {f.colony_id} ({f.cells} cells): {f.reason}" for f in found[:20])
            + "\n"
            + ". ".join(dict.fromkeys(f.hint for f in found))
            + '; on_failure="drop" goes on without them.',
            [int(state.colony_id[p]) for p in places],
        )
    return state.remove(
        torch.isin(state.colony, torch.tensor(places, device=state.device)), "failed"
    )
