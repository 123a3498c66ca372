"""The time loop: step a state, let monitors look at it, yield it. Running, recording growth,
replaying and probing all drive this one loop, and share its monitors."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.reports import Concern, Report
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.checks import SimulationError
from torchfilm.tools.reads import numbers
from torchfilm.tools.warn_once import warn

Step = Callable[[State], State]
# looks at a state after each step; what it returns, if anything, takes the state's place
Monitor = Callable[[State], State | None]

# How often, in steps, a run that ends at a number of cells is checked for colonies that no longer
# grow, and how long they may stand still.
LOOK, STILL = 100, 1000


def advance(
    step: Step,
    state: State,
    *,
    stop: Callable[[State], bool] | None = None,
    monitors: Sequence[Monitor] = (),
) -> Generator[State, State | None, None]:
    """The states after each step, until `stop(state)` is true; without `stop`, for ever.

    A caller that drops colonies on the way continues with `send(state)`: the next step starts from
    the state that it sends.
    """
    while stop is None or not stop(state):
        try:
            state = step(state)
            for monitor in monitors:
                seen = monitor(state)
                state = state if seen is None else seen
        except SystemError as error:  # so does an interrupt within a compiled function arrive
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise error.__cause__ from None
            raise
        sent = yield state
        state = state if sent is None else sent


class States(Generator[State, State | None, None]):
    """The states of a run, one after each step. A run of which nobody takes a state has not begun,
    and is warned of."""

    def __init__(self, states: Generator[State, State | None, None], first: State):
        self._states, self._begun, self._now = states, False, first
        self._failed = ""  # by what it ended early

    def last(self) -> State:
        """The state at the end of the run: the one from which it starts where no step is left. The
        others are not kept. Raises SimulationError for a run that an error has ended before."""
        if self._failed:
            raise SimulationError(f"this run has ended early: {self._failed}")
        for _ in self:
            pass
        return self._now

    def __next__(self) -> State:
        return self.send(None)

    def send(self, value: State | None) -> State:
        if value is not None and not isinstance(value, State):
            raise checks.input_error("send(state)", value, "a tf.State")
        if value is not None and not self._begun:
            raise checks.InputError(
                "send(state) before the first state of the run: take that first, by next(run), or"
                " begin with yours, tf.simulate(scene, state)."
            )
        self._now = self._now if value is None else value
        return self._taken(self._states.send, value)

    def throw(self, *error: Any) -> State:
        return self._taken(self._states.throw, *error)

    def _taken(self, take: Callable[..., State], *given: Any) -> State:
        self._begun = True
        try:
            self._now = take(*given)
        except (StopIteration, GeneratorExit):
            raise
        except BaseException as error:  # an interrupt, too
            self._failed = f"{type(error).__name__}: {error}"
            raise
        return self._now

    def close(self) -> None:
        self._begun = True
        self._states.close()

    def __repr__(self) -> str:
        begun = "begun" if self._begun else "not begun: take its states by `for`, or .last()"
        return f"<states of a run that has {begun}>"

    def __del__(self) -> None:
        if not getattr(self, "_begun", True):  # a copy that failed has nothing
            warn(
                "simulate(…) has simulated nothing, since none of its states was taken. Write"
                " `for state in tf.simulate(…): …`, or tf.simulate(…).last() where only the last"
                " state, or the file of results, is wanted.",
                category=RuntimeWarning,
            )


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
    cell too short to divide, a circuit whose rates are not finite. The reports are those of
    `torchfilm.reports.Report`."""
    found = []
    reports: list[Report] = list(state.reports.values())
    # a report of an effect of a user's may be on another device
    failed = numbers(*(report.status.any().to(state.device) for report in reports))
    for report, some in zip(reports, failed, strict=True):
        if not some:
            continue
        for place in torch.nonzero(report.status).squeeze(1).tolist():
            id_, cells = int(state.colony_id[place]), int(state.counts[place])
            found.append(Failure(place, id_, cells, report.reason(place), report.hint))
    return found


def handle_failures(state: State, on_failure: str) -> State:
    """Raise SimulationError for the colonies whose last step failed, all at once, or drop their
    cells."""
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
            + '; on_failure="drop" continues without them.',
            [int(state.colony_id[p]) for p in places],
        )
    for f in found:
        warn(
            f"colony {f.colony_id} ({f.cells} cells) failed in step {state.step} (t ="
            f" {state.time:g} h), and the run goes on without its cells: {f.reason}",
            category=RuntimeWarning,
        )
    return state.remove(
        torch.isin(state.colony, torch.tensor(places, device=state.device)), "failed"
    )


class Standstill:
    """Which colonies have fewer than `cells` cells and come no nearer: for `steps` steps none has
    become larger by a hundredth than it ever was."""

    def __init__(self, cells: int, steps: int):
        self.cells, self.steps = cells, steps
        self.ids: list[int] = []  # of the colonies that are looked at
        self.largest = self.since = torch.zeros(0)  # (B,) µm³, and at which step that was

    @torch.no_grad()
    def __call__(self, state: State) -> Tensor:
        """(B,) bool, of those that have cells."""
        size = state.groups.sum(state.volume)
        ids = state.colony_id.tolist()
        if ids != self.ids:
            self._follow(ids, size, state.step)
        grown = size > 1.01 * self.largest
        self.largest = torch.where(grown, size, self.largest)
        self.since = torch.where(grown, state.step, self.since)
        return (
            (state.step - self.since >= self.steps)
            & (state.counts > 0)
            & (state.counts < self.cells)
        )

    def _follow(self, ids: list[int], size: Tensor, step: int) -> None:
        """Look at these colonies from now on, of `size` (B,) µm³; what is known of some stays."""
        since = torch.full(size.shape, step, device=size.device)
        size = size.clone()
        for place, colony in enumerate(ids):
            if colony in self.ids:
                before = self.ids.index(colony)
                size[place], since[place] = self.largest[before], self.since[before]
        self.ids, self.largest, self.since = ids, size, since


class EndlessRunWarning:
    """Warns, once, of colonies that come no nearer to the number of cells at which a run ends: it
    might continue for ever."""

    def __init__(self, cells: int):
        self.standstill, self.warned = Standstill(cells, STILL), False

    def __call__(self, state: State) -> None:
        if self.warned or state.step % LOOK:
            return
        still = self.standstill(state)
        self.warned = bool(still.any())
        if self.warned:
            names = ", ".join(map(str, state.colony_id[still].tolist()[:5]))
            warn(
                f"colony {names}: larger by less than a hundredth than {STILL} steps ago, with"
                f" fewer than the {self.standstill.cells} cells at which this run ends. It may"
                " continue for ever: give a time to stop at as well (until=…, --until).",
                category=RuntimeWarning,
            )


class LastingConcerns:
    """Warns, once each, of what the reports of effects are concerned about, when it has held for as
    many steps as they say."""

    def __init__(self) -> None:
        self.steps: dict[tuple[str, str], dict[int, int]] = {}  # by colony id
        self.warned: set[tuple[str, str]] = set()

    def __call__(self, state: State) -> None:
        asked = {
            (title, concern.name): concern
            for title, report in state.reports.items()
            for concern in (report.concerns() if hasattr(report, "concerns") else ())
            if (title, concern.name) not in self.warned
        }
        held = numbers(*(concern.where.any().to(state.device) for concern in asked.values()))
        for (key, concern), some in zip(asked.items(), held, strict=True):
            self._look(state, key, concern, bool(some))

    def _look(self, state: State, key: tuple[str, str], concern: Concern, some: bool) -> None:
        """some: whether it holds in any colony."""
        before, ids = self.steps.get(key, {}), state.colony_id
        here = ids[concern.where].tolist() if some else []
        now = self.steps[key] = {k: before.get(k, 0) + 1 for k in here}
        long = [k for k, steps in now.items() if steps >= concern.steps]
        if not long:
            return
        self.warned.add(key)
        text = concern.text(ids, torch.isin(ids, torch.tensor(long, device=ids.device)))
        warn(f"step {state.step} (t = {state.time:g} h): {text}", category=RuntimeWarning)
