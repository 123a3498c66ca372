"""What an effect reads and writes is what it declares: every effect of every ready scene is stepped
behind a view of the state that records what is read. Replay rests on this."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from helpers import in_turns

import torchfilm as tf
from torchfilm.effect import GEOMETRY
from torchfilm.state import PER_CELL, Field, State


class Log:
    """Names that were read; nothing is noted while `quiet`."""

    def __init__(self) -> None:
        self.reads: set[str] = set()
        self.quiet = False

    def note(self, name: str) -> None:
        if not self.quiet:
            self.reads.add(name)


class RecordingFields(Mapping):
    """The fields of a state; reading a value is noted, asking for names is not."""

    def __init__(self, values: Mapping[str, torch.Tensor], log: Log):
        self._values, self._log = values, log

    def __getitem__(self, name: str) -> torch.Tensor:
        value = self._values[name]
        self._log.note(name)
        return value

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


class RecordingState(State):
    """A state that notes which of its geometry and fields are read. What copies a state as a whole
    (replace, take, division handing fields on) reads nothing."""

    @staticmethod
    def of(state: State, log: Log) -> RecordingState:
        view = object.__new__(RecordingState)
        view.__dict__.update({k: v for k, v in state.__dict__.items() if k != "log"})
        view.__dict__["log"] = log
        return view

    def plain(self) -> State:
        state = object.__new__(State)
        state.__dict__.update({k: v for k, v in self.__dict__.items() if k != "log"})
        return state

    def __getattribute__(self, name: str) -> Any:
        if name in ("dim", "dtype", "device"):  # of the tensors, not their values
            return getattr(self.plain(), name)
        if name in GEOMETRY:
            self.__dict__["log"].note(name)
        if name == "fields":
            return RecordingFields(self.__dict__["fields"], self.__dict__["log"])
        return super().__getattribute__(name)

    def __getattr__(self, name: str) -> Any:
        if name in self.__dict__.get("fields", {}):
            self.__dict__["log"].note(name)
        return super().__getattr__(name)

    def replace(self, **changes: Any) -> State:
        raw = dict(self.plain().__dict__)
        known = {k: v for k, v in raw.items() if k in State.__dataclass_fields__}
        return RecordingState.of(State(**{**known, **changes}), self.log)

    def with_fields(self, **values: torch.Tensor) -> State:
        return RecordingState.of(self.plain().with_fields(**values), self.log)

    def take(self, index: torch.Tensor, **known: torch.Tensor) -> State:
        return RecordingState.of(self.plain().take(index, **known), self.log)

    def cell_columns(self) -> dict[str, torch.Tensor]:
        return self.plain().cell_columns()

    def reset_at_division(self, daughters: torch.Tensor, names: Any) -> State:
        # the fields' own rules read here, not the effect that divides
        return self._quietly(super().reset_at_division, daughters, names)

    def remove(self, gone: torch.Tensor, fate: str) -> State:
        return self._quietly(super().remove, gone, fate)

    def noted_end(self, rows: torch.Tensor, fate: str) -> Any:
        # what the lineage keeps of the cells is not what the effect goes by
        return self._quietly(super().noted_end, rows, fate)

    def check_fields(self) -> None:
        self._quietly(super().check_fields)

    def _quietly(self, call: Any, *given: Any) -> Any:
        before, self.log.quiet = self.log.quiet, True
        found = call(*given)
        self.log.quiet = before
        return found


def written(before: State, after: State) -> set[str]:
    """Names of what is another tensor after than before; "cells" where cells came or went."""
    names = {n for n in GEOMETRY if after.__dict__[n] is not before.__dict__[n]}
    old, new = before.__dict__["fields"], after.__dict__["fields"]
    if after.__dict__["uid"] is not before.__dict__["uid"]:
        # all rows moved: what changed beside is told by the rows that are there before and after
        return {"cells"}
    return names | {n for n in new if new[n] is not old.get(n)}


def undeclared(model: tf.Model, state: State) -> tuple[list[str], State]:
    """What effects read and write in one step without having declared it, and the state after."""
    wrong = []
    state = state.replace(births=(), ended=(), reports={})
    for effect in model.effects:
        log = Log()
        after = effect.step(RecordingState.of(state, log), model.dt)
        after = after.plain() if isinstance(after, RecordingState) else after
        may_read = {*effect.reads(), *effect.effect.needs()}
        wrong += [f"{effect.title} reads {n}" for n in sorted(log.reads - may_read)]
        wrong += [
            f"{effect.title} writes {n}" for n in sorted(written(state, after) - {*effect.writes()})
        ]
        state = after
    return wrong, state.replace(step=state.step + 1, time=(state.step + 1) * model.dt)


def made(u, s, p, cell):
    return {"m": p.k * cell.volume - u.m}


def leaking(u, s, p, cell):
    out = p.k * cell.area * (u.m - s.food)
    return {"m": p.k - out / cell.volume}, {"food": out}


def body(rate=1.0, dim=2) -> list[tf.Effect]:
    return [tf.Growth(rate=rate), tf.Division(length=tf.Uniform(3.0, 3.6)), tf.Mechanics(dim=dim)]


def medium(**options) -> tf.Medium:
    around = {"reservoir": 3.0} if options.get("outside") == "reservoir" else {}
    food = tf.Signal(diffusion=5.0, initial=9.0, **around)
    return tf.Medium(food=food, box=((-6, -6), (6, 6)), spacing=2.0, **options)


TYPES = tf.Cells([[0, 0], [3, 0]], [[1, 0], [1, 0]], 2.0, cell_type=[0, 1])
MORE = {
    "reservoir": lambda: tf.Scene(
        *body(), tf.Circuit(leaking, species=("m",), k=1.0), medium(outside="reservoir")
    ),
    "nutrition in a reservoir": lambda: tf.Scene(
        *body(None), tf.Monod("food"), medium(outside="reservoir"), dim=2
    ),
    "a grid that grows": lambda: tf.Scene(
        *body(), tf.Circuit(leaking, species=("m",), k=1.0), medium(outside="grow")
    ),
    "a circuit beside a medium": lambda: tf.Scene(
        *body(), tf.Circuit(made, species=("m",), k=1.0), medium(outside="grow")
    ),
    "values by type and drawn": lambda: tf.Scene(
        tf.Growth(rate={0: 0.6, 1: 1.2}),
        tf.Division(length={0: tf.Uniform(3.0, 3.4), 1: 3.2}),
        tf.Mechanics(dim=2, viscosity={0: 1.0, 1: 2.0}, length_drag=tf.LogNormal(10.0, 0.1)),
        tf.Circuit(made, species=("m",), k=tf.LogNormal(1.0, 0.2)),
        founders=TYPES,
    ),
    "two circuits": lambda: tf.Scene(
        *body(),
        tf.Circuit(made, species=("m",), k=1.0),
        tf.Circuit(made, species=("n",), shared=("m",), name="second", k=1.0),
    ),
    "removal": lambda: tf.Scene(*body(), tf.Removal((-4, -4), (4, 4))),
    "space": lambda: tf.scenes.microcolony(dim=3),
}
SCENES = {**tf.scenes.READY, **MORE}


@pytest.mark.parametrize("name", SCENES)
def test_every_read_and_write_is_declared(name):
    scene = SCENES[name]()
    model = scene.bind(2, seed=3)
    state = model.start()
    divided = 0
    for k in range(90):
        if k < 60:
            state = model.step(state)
            continue
        wrong, state = undeclared(model, state)
        assert wrong == []
        divided += len(state.births)
    grows = any(isinstance(effect, tf.Growth) for effect in scene.effects)
    assert state.cells > 2 and (divided or not grows)


def test_the_view_gives_the_same_states():
    scene = tf.scenes.boundary_detector()
    # the view looks at each effect by itself, and so at circuits and transport in turns
    model = scene.replace(*(in_turns(e) for e in scene.effects)).bind(2, seed=3)
    state = other = model.start()
    for _ in range(40):
        state, other = model.step(state), undeclared(model, other)[1]
    for name in (*PER_CELL, *state.fields):
        assert torch.equal(getattr(state, name), getattr(other, name)), name


@dataclass(frozen=True, eq=False)
class Undeclared(tf.Effect):
    """Reads the radius and the length, and says so of neither."""

    title = "undeclared"
    stage = 35

    def declares(self, dim):
        return (Field("mark", "a mark"),)

    def writes(self):
        return ("mark",)

    def step(self, state, dt, values):
        return state.with_fields(mark=state.radius + state.length)


def test_what_is_read_and_not_declared_is_found(monkeypatch):
    """What is written and not declared is refused by the step itself, which looks at all there
    is."""
    monkeypatch.setattr("torchfilm.own_step.seen", lambda state: {})
    model = tf.Scene(*body(), Undeclared()).bind()
    wrong, _ = undeclared(model, model.start())
    parts = ("reads length", "reads radius")
    assert wrong == [f"undeclared {part}" for part in parts]


def test_what_mechanics_keep_has_the_meanings_that_files_have():
    """`take_over` goes by meanings: with other words it would begin these fields anew, in silence,
    where a run of an earlier version goes on."""
    found = {f.name: f.meaning for f in tf.Mechanics(dim=2).declares(2)}
    assert found == {
        "displacement": "move of the last first solve of a step or sub-step (Δc, Δθ, Δl), from"
        " which the next starts",
        "collapsed_steps": "steps in a row in which contacts have not held the colony's cells"
        " apart",
        "contact_alpha": "α with which the next step of the colony's contacts begins, 0 before the"
        " first",
        "compression": "how much shorter pressure has made a cell than it once was",
    }
