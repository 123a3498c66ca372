"""Running a scene: `simulate` yields its states, `rollout` gives the last one with a gradient
through the run."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint, set_checkpoint_early_stop

from torchfilm.loop import (
    EndlessRunWarning,
    LastingConcerns,
    Monitor,
    States,
    advance,
    handle_failures,
)
from torchfilm.model import Model
from torchfilm.replay import Replay
from torchfilm.scene import Scene
from torchfilm.state import PER_CELL, PER_COLONY, State
from torchfilm.tools import checks, displays
from torchfilm.tools.hashing import trained
from torchfilm.tools.progress import RunBar, wanted
from torchfilm.tools.segments import Segment
from torchfilm.tools.threads import after_fork
from torchfilm.tools.timing import Timings

if TYPE_CHECKING:
    from torchfilm.io.recorder import Recorder

Observer = Callable[[State], Any]


@checks.known_keywords
def simulate(
    scene: Scene | Model,
    state: State | None = None,
    *,
    until: float | None = None,
    cells: int | None = None,
    dt: float | None = None,
    colonies: int | None = None,
    seed: int | None = None,
    streams: Sequence[int] | Tensor | None = None,
    device: str | torch.device | None = None,
    dtype: torch.dtype | None = None,
    record: str | Path | Recorder | None = None,
    observers: Sequence[Observer] = (),
    on_failure: str = "raise",
    timings: Timings | None = None,
    progress: bool | None = False,
) -> States:
    """Run a scene, yielding the state after each step. Nothing is simulated before the states are
    taken: `for state in simulate(…)`, or `simulate(…).last()` for the last alone.

    scene: a scene, which is bound here to `colonies` colonies, or a model. seed, streams, device,
    dtype: as in `Scene.bind`, by default 0, stream k for colony k, "cpu" and torch.float32. Where a
    model or a state is given, these and `colonies` are its own and must be left out. state: start
    from this one instead. until: time to stop at, h. cells: stop once every colony has this many
    cells, or none at all. At least one of the two; the first reached ends the run. dt: step, h; by
    default the scene's. record: path of a new results file (every tenth step and the last), or a
    Recorder. observers: called with the first state and after every step; one that has `close()`,
    such as a `LivePlot`, is closed at the end. progress: True shows a bar with hours or doublings,
    cells and speed (it needs tqdm, the `app` extra); None shows it in a notebook and on a terminal
    only. timings: a `tf.Timings`, to which the seconds of each effect are added. on_failure:
    "raise" a SimulationError that names the colonies that failed (a solve that did not converge, a
    cell too short to divide), or "drop" their cells, note it, and continue.
    """
    after_fork()
    _check_kinds("simulate", scene, state)
    dt = scene.dt if dt is None else checks.number("dt", dt, above=0.0)
    observers = (observers,) if callable(observers) else tuple(observers)
    _check_options(record, observers, until, cells, on_failure)
    given = dict(colonies=colonies, seed=seed, streams=streams, device=device, dtype=dtype)
    batch = {name: value for name, value in given.items() if value is not None}
    _check_batch(scene, state, batch)
    if state is not None and until is not None:
        _last_step(state, checks.number("until", until), dt)
    model = _bound(scene, state, batch)
    state = model.start() if state is None else state
    last = math.inf if until is None else _last_step(state, checks.number("until", until), dt)
    model.check(state)
    model.check_step(dt)
    model.check_end(state, cells if until is None else None, until if cells is None else None)
    recorder = _attached(record, model, dt, _ended(last, cells, state))
    monitors = _monitors(recorder, observers, cells if until is None else None, on_failure, timings)
    bar = _run_bar(model, state, cells, until) if wanted(progress) else None
    first = (*((recorder,) if recorder else ()), *observers)
    step = partial(model.step, dt=dt, timings=timings)
    states = _run(
        step,
        state,
        partial(_ended, last, cells),
        first,
        (*monitors, *((bar,) if bar else ())),
        (*((recorder,) if recorder else ()), *observers, *((bar,) if bar else ())),
    )
    return States(states, state)


def _run_bar(model: Model, state: State, cells: int | None, until: float | None) -> RunBar:
    what = displays.counted(state.colonies, "colony", "colonies")
    return RunBar(f"{model.scene.name}: {what}", state, cells, until)


def _attached(
    record: str | Path | Recorder | None, model: Model, dt: float, ended: bool
) -> Recorder | None:
    """What records a run. ended: the run has no step."""
    if isinstance(record, (str, Path)):
        from torchfilm.io.recorder import Recorder  # loads h5py, which most scripts do without

        record = Recorder(record, model.scene)
    if record is not None:
        _check_overwrite(record, ended)
        record.attach(model, dt)
    return record


def _check_overwrite(recorder: Recorder, ended: bool) -> None:
    """Raise InputError where a run without a step would put one frame in the place of a file, as
    where a cell of a notebook is run again."""
    if ended and getattr(recorder, "overwrite", False) and recorder.path.exists():
        rule = "of a run with a step: the state from which it starts is at its end"
        hint = "Nothing would be recorded but that state. Give a later until, or an earlier state."
        raise checks.input_error("Recorder(…, overwrite=True)", str(recorder.path), rule, hint)


def _check_options(
    record: object, observers: Sequence[object], until: object, cells: object, on_failure: str
) -> None:
    """Raise InputError for options that mean nothing."""
    if not (record is None or isinstance(record, (str, Path)) or hasattr(record, "attach")):
        raise checks.input_error("record", record, "the path of a new results file, or a Recorder")
    rule = "a list of functions that are called with a state"
    if not all(callable(o) for o in observers):
        raise checks.input_error("observers", observers, rule)
    for observer in observers:
        if isinstance(observer, type):  # to call it with a state would make another, or fail
            hint = f"Write {observer.__name__}() with its brackets."
            raise checks.input_error("observers", observer, rule, hint)
    if until is None and cells is None:
        raise checks.InputError(
            "simulate needs an end: give until=… (hours) or cells=… (per colony)."
        )
    checks.choice("on_failure", on_failure, ("raise", "drop"))
    if cells is not None:
        checks.integer("cells", cells, least=1)


def _check_batch(scene: Scene | Model, state: State | None, batch: dict[str, Any]) -> None:
    """Raise InputError where a batch is described twice."""
    if not batch or (state is None and isinstance(scene, Scene)):
        return
    name, given = next(iter(batch.items()))
    what = "model" if state is None else "state"
    raise checks.input_error(
        name,
        given,
        f"left out where a {what} is given",
        f"The {what} has its own, from scene.bind({name}=…).",
    )


def _monitors(
    recorder: Recorder | None,
    observers: Sequence[Observer],
    cells: int | None,
    on_failure: str,
    timings: Timings | None,
) -> list[Monitor]:
    """What looks at each state, in order. cells: of a run that has no other end."""
    monitors: list[Monitor] = [partial(handle_failures, on_failure=on_failure), LastingConcerns()]
    if recorder is not None:
        monitors.append(partial(_record, recorder, timings))
    monitors += [partial(_observe, observe) for observe in observers]
    if cells is not None:
        monitors.append(EndlessRunWarning(cells))
    return monitors


def _record(recorder: Recorder, timings: Timings | None, state: State) -> None:
    with timings.of("recording", state.device) if timings else nullcontext():
        recorder(state)


def _observe(observe: Observer, state: State) -> None:
    observe(state)


def _ended(last: float, cells: int | None, state: State) -> bool:
    if state.step >= last:
        return True
    if cells is None or 0 < state.cells < cells:  # known without a count for each colony
        return False
    counts = state.counts.cpu().numpy()
    return bool(((counts >= cells) | (counts == 0)).all())


def _run(step, state, stop, first, monitors, seen) -> Generator[State, State | None, None]:
    """seen: who may have something to close at the end, each of them also after an error."""
    with ExitStack() as end:
        for observe in reversed(seen):
            if callable(close := getattr(observe, "close", None)):
                end.callback(close)
        for observe in first:
            observe(state)
        yield from advance(step, state, stop=stop, monitors=monitors)


@checks.known_keywords
def rollout(
    scene: Scene | Model | Replay,
    state: State | None = None,
    *,
    until: float,
    dt: float | None = None,
    segment: int | None = 10,
) -> State:
    """The state at `until` (h), for gradients through a long run: only every `segment`-th state is
    kept, and the steps between are computed again on the way back (torch.utils.checkpoint), so that
    memory grows with the number of segments and not of steps; None keeps all, and saves the time.
    So nothing that the scene reads may change before the gradient is taken: call `backward` before
    the step of an optimiser. On the CPU, and where torch is deterministic, steps that do not repeat
    then are an error.

    scene: or a model, or a `Replay`, whose steps are as long as its recording's. state: from which
    to start; by default the first. dt: h, by default the scene's. Failures are raised as in
    `simulate`.
    """
    _check_kinds("rollout", scene, state, Replay)
    dt = scene.dt if dt is None else checks.number("dt", dt, above=0.0)
    if segment is not None and (type(segment) is not int or segment < 1):
        raise checks.input_error("segment", segment, "an integer number of steps from 1, or None")
    if isinstance(scene, Replay):
        if dt != scene.dt:
            raise checks.input_error("dt", dt, f"{scene.dt:g} h, as in the recording")
        model, step = scene.model, scene.step
        state = scene.start() if state is None else state
    else:
        model = _bound(scene, state, {})
        state, step = model.start() if state is None else state, partial(model.step, dt=dt)
    last = _last_step(state, checks.number("until", until), dt)
    model.check(state)
    model.check_step(dt)
    monitors = [partial(handle_failures, on_failure="raise")]

    def steps_from(begin: State, steps: int, *more: Monitor) -> State:
        last_step, end = begin.step + steps, begin
        stop = lambda s: s.step >= last_step
        for later in advance(step, begin, stop=stop, monitors=[*monitors, *more]):
            end = later
        return end

    if segment is None or not torch.is_grad_enabled():
        return steps_from(state, last - state.step)
    weights = trained(model.scene.effects)
    versions = [w._version for w in weights]

    def segment_of(kept: Segment, begin: State, steps: int) -> State:
        with kept.steps() as again:
            if again and versions != [w._version for w in weights]:
                raise checks.InputError(
                    "a tensor that the scene uses, such as a weight of a network, changed since"
                    " rollout began, and the gradient does its steps again: call backward before"
                    " the step of an optimiser, or give rollout segment=None."
                )
            return steps_from(begin, steps, partial(_check_repeats, kept))

    while state.step < last:
        count = min(segment, last - state.step)
        with set_checkpoint_early_stop(False):  # so that the last step is compared, too
            state = checkpoint(segment_of, Segment(), state, count, use_reentrant=False)
    return state


def _check_repeats(kept: Segment, state: State) -> None:
    """Raise InputError where a step that is done again ends otherwise."""
    if state.device.type != "cpu" and not torch.are_deterministic_algorithms_enabled():
        return  # sums may differ in their last bits
    columns = (getattr(state, name) for name in (*PER_CELL, *PER_COLONY))
    if not kept.repeats([*columns, *state.fields.values()]):
        raise checks.InputError(
            f"the gradient of rollout does its steps again, and the step to {state.time:g} h ended"
            " otherwise than before. So something that the scene reads has changed since, such as"
            " a global of a rule or a controller's memory. Take the gradient before it changes,"
            " keep a memory in variables of the cells, or give rollout segment=None."
        )


def _bound(scene: Scene | Model, state: State | None, batch: dict[str, Any]) -> Model:
    if isinstance(scene, Model):
        return scene
    return scene.bind(**batch) if state is None else scene.bind(state=state)


def _check_kinds(name: str, scene: object, state: object, *more: type) -> None:
    if not isinstance(scene, (Scene, Model, *more)) or not (
        state is None or isinstance(state, State)
    ):
        given = f"{name}({type(scene).__name__}, {type(state).__name__}, …)"
        raise checks.InputError(
            f"{given} is not allowed: first comes a Scene or a Model, then, if any, a State, such"
            f" as tf.{name}(scene, colonies=8, until=2.0)."
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
            f"an integer number of steps of dt = {dt:g} h from {state.time:g} h",
            f"Nearest: {near} h.",
        )
    return state.step + round(steps)
