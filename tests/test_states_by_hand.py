"""States that a user edits between two runs, and what a scene and a state keep for themselves."""

from __future__ import annotations

import copy
import math
import pickle
import weakref
from dataclasses import dataclass

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.loop import advance


@dataclass(frozen=True, eq=False)
class Shrinking(tf.Effect):
    """An effect of a user's may set what none of torchfilm's would."""

    title, stage = "shrinking", 5.0

    def reads(self):
        return ("growth_rate", "gfp")

    def writes(self):
        return ("growth_rate", "gfp")

    def step(self, state, dt, values):
        less = torch.full_like(state.growth_rate, -0.2)
        return state.with_fields(growth_rate=less, gfp=state.gfp - 1.0)


BOX = {"box": ((-16.0, -16.0), (16.0, 16.0)), "spacing": 4.0}


def makes(u, s, p, cell):
    return {"gfp": p.k - u.gfp}


def scene(**circuit) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=4.0),
        tf.Circuit(makes, species=("gfp",), k=1.0, **circuit),
        tf.Medium(food=tf.Signal(10.0, initial=1.0), **BOX),
        dim=2,
        dt=0.05,
    )


def first(dtype=torch.float32, **circuit) -> tf.State:
    return scene(**circuit).bind(dtype=dtype).start()


@pytest.mark.parametrize(
    "given", [torch.int64, torch.int32, torch.uint8, torch.float16, torch.float64], ids=str
)
@pytest.mark.parametrize("own", [torch.float32, torch.float64], ids=str)
def test_numbers_become_those_of_the_field(own, given):
    state = first(own)
    made = state.with_fields(growth_rate=torch.tensor([2], dtype=given))
    assert made.growth_rate.dtype == own and float(made.growth_rate) == 2.0


def test_a_column_of_whole_numbers_is_recorded_and_resumed_as_it_is(tmp_path):
    """It had made a dataset of these, which cut off later fractions."""
    made, path = scene(), tmp_path / "run.h5"
    state = first().with_fields(growth_rate=torch.tensor([1]))
    run = tf.simulate(made, state, until=0.5, record=tf.Recorder(path, made, every=1))
    now = next(run)
    now = run.send(now.with_fields(growth_rate=torch.tensor([1.7])))
    last = run.last()
    with tf.Results(path) as results:
        again = results.state(made)
    assert float(last.growth_rate[0]) == pytest.approx(1.7, rel=1e-6)
    for name, value in last.fields.items():
        assert torch.equal(again.fields[name], value), name
    assert torch.equal(again.length, last.length)


def test_a_column_that_a_file_would_round_is_refused(tmp_path):
    """Or the run could not be resumed as it was."""
    made = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), dim=2, dt=0.05)
    path = tmp_path / "run.h5"
    run = tf.simulate(made, until=0.5, record=tf.Recorder(path, made, every=1))
    state = next(run)
    rate = torch.tensor([1.7], dtype=torch.float64)
    state = state.replace(fields={**state.fields, "growth_rate": rate})  # past with_fields
    words = r"^the field '\w+' is of float64 now, and of float32 in .*value\.to\(torch\.float32\)"
    with pytest.raises(tf.SimulationError, match=words):
        run.send(state)
    with tf.Results(path) as results:
        assert len(results) == 2  # what came before stays


def test_numbers_keep_their_gradient():
    rate = torch.tensor([2.0], dtype=torch.float64, requires_grad=True)
    first().with_fields(growth_rate=rate).growth_rate.sum().backward()
    assert rate.grad.tolist() == [1.0]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("divide_flag", torch.ones(1), r"true or false, torch\.bool\. Convert it: value > 0"),
        ("growth_rate", torch.ones(1, dtype=torch.bool), r"numbers of torch\.float32"),
        ("growth_rate", torch.ones(1, dtype=torch.complex64), r"numbers of torch\.float32"),
        ("growth_rate", 2.0, r"torch\.full_like\(state\.growth_rate, …\)"),
        ("growth_rate", [2.0], r"torch\.as_tensor\(…, dtype=torch\.float32"),
        ("growth_rate", np.ones(1), r"torch\.as_tensor\(…, dtype=torch\.float32"),
    ],
)
def test_values_of_another_kind_are_refused(name, value, words):
    with pytest.raises(tf.InputError, match=rf"the field '{name}'.*{words}"):
        first().with_fields(**{name: value})


def test_cell_types_are_whole():
    made = tf.Scene(
        tf.Growth(rate={0: 1.0, 1: 2.0}),
        founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], cell_type=[1]),
        dim=2,
    )
    state = made.bind().start()
    with pytest.raises(tf.InputError, match=r"'cell_type'.*numbers of torch\.int64"):
        state.with_fields(cell_type=torch.tensor([0.5]))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("growth_rate", -0.5, r"growth_rate\[0\] = -0\.5.*at least 0"),
        ("division_threshold", math.nan, r"division_threshold\[0\] = nan.*inf"),
        ("gfp", -1.0, r"gfp\[0\] = -1\.0.*at least 0"),
    ],
)
def test_values_that_no_cell_can_have_are_refused_before_a_run(name, value, words):
    state = first().with_fields(**{name: torch.tensor([value])})
    for begin in (tf.simulate, tf.rollout):
        with pytest.raises(tf.InputError, match=rf"state\.{words}"):
            begin(scene(), state, until=0.1)


def test_what_effects_of_a_user_set_is_theirs(tmp_path):
    """So that a run that they are in goes on from its file."""
    made, path = scene().replace(Shrinking(), *scene().effects), tmp_path / "run.h5"
    tf.simulate(made, until=0.2, record=tf.Recorder(path, made, every=1)).last()
    with tf.Results(path) as results:
        state = results.state(made)
    assert float(state.growth_rate[0]) < 0
    again = tf.Recorder(path, made, append=True)
    assert tf.simulate(made, state, until=0.3, record=again).last().step == 6


def test_levels_below_zero_are_those_of_explicit_methods():
    state = first(method="rk4").with_fields(gfp=torch.tensor([-1.0]))
    last = tf.simulate(scene(method="rk4"), state, until=1.0).last()
    assert float(last.gfp[0]) > -1.0


def test_cells_behind_a_wall_are_remarked_on_where_a_run_goes_on():
    wide = lambda width, **wall: tf.Scene(
        tf.Growth(rate=1.0), tf.Mechanics(dim=2, walls=[tf.Channel(width, **wall)]),
        founders=tf.Cells([[0.0, 0.0], [0.0, 3.0]], [[1.0, 0.0], [1.0, 0.0]], length=2.0), dt=0.05,
    )  # fmt: skip
    state = wide(12.0).bind().start()
    with pytest.warns(UserWarning, match=r"Channel: cell 1 of colony 0.*1 µm behind it"):
        hard = tf.simulate(wide(4.0), state, until=0.5).last()
    assert float(hard.position[1, 1]) <= 2.0 - 0.5 + 0.1
    soft = tf.simulate(wide(4.0, stiffness=10.0), state, until=0.1).last()
    assert float(soft.position[1, 1]) < 3.0  # it gives way, and pushes back


def test_a_run_goes_on_after_a_step_that_left_a_cell_behind_a_wall():
    """Cells that grow tenfold in a step may; found by the fuzzer."""
    made = tf.Scene(
        tf.Growth(rate=100.0), tf.Mechanics(dim=2, walls=[tf.Plane(y=0.0, facing="+y")]),
        founders=tf.Cells([[0.0, 0.6], [0.4, 2.0]], [[1.0, 0.0], [0.0, 1.0]], length=2.0), dt=0.01,
    )  # fmt: skip
    state = tf.simulate(made, until=0.01).last()
    behind = state.replace(position=state.position - torch.tensor([[0.0, 3.0]]))
    with pytest.warns(UserWarning, match=r"Plane: cell .* behind it"):
        last = tf.simulate(made, behind, until=0.02).last()
    assert not tf.failures(last)


def test_a_signal_cannot_be_set_in_place():
    state = first()
    found, words = state.signals, r"state\.with_fields\(\*\*\{'out\.NAME': …\}\)"
    with pytest.raises(tf.InputError, match=words):
        found["food"] = torch.zeros(64)
    with pytest.raises(tf.InputError, match=words):
        found |= {"food": torch.zeros(64)}
    for change in (found.update, found.setdefault, found.pop):
        with pytest.raises(tf.InputError, match=words):
            change("food")
    assert dict(found)["food"] is state.fields["out.food"]
    for same in (copy.copy(found), copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert type(same) is type(found) and torch.equal(same["food"], found["food"])


def test_a_state_after_a_failed_step_says_so():
    model = scene().bind()
    state = model.step(first().with_fields(gfp=torch.tensor([math.nan])))
    assert tf.failures(state) and "FAILED: see tf.failures(state)" in repr(state)
    assert "FAILED" in state._repr_html_() and "FAILED" not in repr(model.start())


def test_founders_and_values_are_copies():
    """What a user does to an array later changes no scene."""
    length, rates = np.array([2.0, 2.0]), np.array([1.0, 2.0])
    list_ = [1.0, 2.0]
    cells = tf.Cells([[0.0, 0.0], [5.0, 0.0]], [[1.0, 0.0]] * 2, length=length)
    made = [tf.Growth(rate=given) for given in (rates, list_)]
    model = tf.Scene(made[0], founders=cells, dim=2).bind(2)
    for given in (length, rates, list_):
        given[0] = 7.0
    assert model.start().length.tolist() == [2.0] * 4 and cells.length.tolist() == [2.0, 2.0]
    assert all(growth.rate.tolist() == [1.0, 2.0] for growth in made)


def test_a_scene_follows_a_tensor_that_an_optimiser_changes():
    """Also one that was frozen as the scene was made."""
    rate = torch.nn.Parameter(torch.tensor([1.0, 2.0]), requires_grad=False)
    made = tf.Scene(tf.Growth(rate=rate), dim=2, dt=0.1)
    with torch.no_grad():
        rate[0] = 3.0
    rate.requires_grad_()
    state = tf.rollout(made, made.bind(2).start(), until=0.1)
    state.length.sum().backward()
    assert made.effects[0].rate.tolist() == [3.0, 2.0] and bool((rate.grad > 0).all())


def test_the_last_state_of_a_run_keeps_no_others():
    run, kept = tf.simulate(scene(), until=0.5), []
    kept.append(weakref.ref(next(run)))
    last = run.last()
    assert last.step == 10 and run.last() is last and kept[0]() is None
    assert tf.simulate(scene(), last, until=last.time).last() is last  # no step is left


def test_a_run_that_failed_has_no_last_state():
    run = tf.simulate(scene(), until=0.5)
    state = next(run).with_fields(gfp=torch.tensor([math.nan]))
    for act in (lambda: run.send(state), run.last, run.last):
        with pytest.raises(tf.SimulationError, match="colony 0"):
            act()
    stopped = tf.simulate(scene(), until=0.5)
    next(stopped)
    with pytest.raises(KeyboardInterrupt):
        stopped.throw(KeyboardInterrupt())
    with pytest.raises(tf.SimulationError, match="this run has ended early: KeyboardInterrupt"):
        stopped.last()


def test_a_state_that_is_sent_takes_the_place_of_the_last():
    """So that no large one is kept while the next step is computed."""
    run = tf.simulate(scene(), until=0.5)
    seen = weakref.ref(next(run))
    kept = []

    def look(state):
        kept.append(seen())

    watched = tf.simulate(scene(), until=0.5, observers=[look])
    now = next(watched)
    seen = weakref.ref(now)
    now = now.replace(time=now.time)
    watched.send(now)
    assert kept[-1] is None


def test_an_interrupt_within_a_compiled_function_is_an_interrupt():
    """Numba reports what stops one of its functions as a SystemError with a cause."""

    def fails(cause):
        def step(state):
            raise SystemError("returned a result with an exception set") from cause

        return step

    for cause, kind in ((KeyboardInterrupt(), KeyboardInterrupt), (None, SystemError)):
        with pytest.raises(kind):
            next(advance(fails(cause), first()))
