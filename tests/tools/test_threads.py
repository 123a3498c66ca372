"""Torch in one thread, where kernels compute."""

import threading
from dataclasses import dataclass

import pytest
import torch

import torchfilm as tf
from torchfilm.effects.bound_mechanics import BoundMechanics
from torchfilm.physics import adjoint
from torchfilm.tools import ragged, threads


@pytest.fixture(autouse=True)
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_torch_has_one_thread_inside_and_its_own_again_after():
    with tf.one_torch_thread():
        assert torch.get_num_threads() == 1 and threads.available() == 3
        with tf.one_torch_thread():
            assert torch.get_num_threads() == 1 and threads.available() == 3
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == threads.available() == 3


def test_threads_come_back_after_an_error():
    with pytest.raises(ValueError, match="here"), tf.one_torch_thread():
        raise ValueError("here")
    assert torch.get_num_threads() == 3
    with (
        tf.one_torch_thread(),
        pytest.raises(ValueError, match="there"),
        threads.given_torch_threads(),
    ):
        raise ValueError("there")
    assert torch.get_num_threads() == threads.available() == 3


def ranges_of(count: int, shared: threads.Shared) -> list[tuple[int, int]]:
    """How it divides the work on so many things."""
    found = []
    with tf.one_torch_thread():
        shared(count, lambda first, last: found.append((first, last)))
    return sorted(found)


def test_work_is_shared_among_as_many_threads_as_torch_was_given(monkeypatch):
    monkeypatch.setattr(threads, "WORTH_WAKING", 0.0)
    assert ranges_of(30, threads.Shared()) == [(0, 10), (10, 20), (20, 30)]
    assert ranges_of(2, threads.Shared()) == [(0, 1), (1, 2)]
    assert ranges_of(0, threads.Shared()) == [(0, 0)]


def test_a_thread_is_woken_where_the_last_call_was_long_enough():
    """A call tells how long one thing takes, and the next one goes by it."""
    shared = threads.Shared()
    assert ranges_of(30, shared) == [(0, 30)]
    for seconds, parts in (
        (0.9, 1),
        (1.9, 1),
        (2.1, 2),
        (3.1, 3),
        (1e6, 3),
    ):  # of all, in those that are worth a thread
        shared.seconds = seconds * threads.WORTH_WAKING / 30
        assert len(ranges_of(30, shared)) == parts


def test_the_time_of_one_thing_is_taken_in_this_thread(monkeypatch):
    clock = iter((5.0, 7.0, 10.0, 13.0))
    monkeypatch.setattr(threads.time, "perf_counter", lambda: next(clock))
    shared = threads.Shared()
    ranges_of(20, shared)
    assert shared.seconds == 2.0 / 20
    assert ranges_of(30, shared)[0] == (0, 10)
    assert shared.seconds == 3.0 / 10


def test_an_error_in_another_thread_is_raised_here(monkeypatch):
    monkeypatch.setattr(threads, "WORTH_WAKING", 0.0)

    def work(first, last):
        if first:
            raise ValueError("there")

    with pytest.raises(ValueError, match="there"), tf.one_torch_thread():
        threads.Shared()(30, work)


def test_a_rule_has_the_threads_of_torch_and_kernels_leave_it_one(monkeypatch):
    """In each step: a user's function may do much in torch, kernels' own effects do little."""
    seen = {}

    def rule(cells):
        seen["rule"] = torch.get_num_threads()
        cells.growth_rate = cells.growth_rate * 1.0

    parted = BoundMechanics.parted

    def spied(self, *given):
        seen["mechanics"] = torch.get_num_threads()
        return parted(self, *given)

    monkeypatch.setattr(BoundMechanics, "parted", spied)
    scene = tf.Scene(tf.Rules(rule), tf.Growth(rate=1.0), tf.Mechanics())
    model = scene.bind()
    for inside in (False, True):
        seen.clear()
        if inside:
            with tf.one_torch_thread():
                model.step(model.start())
        else:
            model.step(model.start())
        assert seen == {"rule": 3, "mechanics": 1}
        assert torch.get_num_threads() == 3


def test_an_effect_of_users_has_the_threads_of_torch():
    found = []

    @dataclass(frozen=True)
    class Mine(tf.Effect):
        stage, title = 35, "mine"

        def step(self, state, dt, values):
            found.append(torch.get_num_threads())
            return state

    model = tf.Scene(Mine()).bind()
    model.step(model.start())
    assert found == [3]


def test_work_in_few_parts_or_many_wakes_the_same_threads(monkeypatch):
    monkeypatch.setattr(threads, "WORTH_WAKING", 0.0)
    used = set()
    for count in (2, 3, 2, 3):
        threads.Shared()(count, lambda *_: used.add(threading.current_thread().name))
    assert len(used) <= 1 + 3 and len({name.rpartition("_")[0] for name in used}) == 2


def test_the_way_back_through_contacts_and_sums_has_one_thread(monkeypatch):
    """Of many small operations: torch's other threads would wait in a loop between them."""
    seen: dict[str, set[int]] = {"contacts": set(), "sums": set()}
    solve, add = adjoint.conjugate_gradients, ragged.Groups.sum

    def solving(*given):
        seen["contacts"].add(torch.get_num_threads())
        return solve(*given)

    def adding(self, value):
        seen["sums"].add(torch.get_num_threads())
        return add(self, value)

    rate = torch.tensor(1.0, requires_grad=True)
    cells = tf.Cells([[0.0, 0.0], [1.0, 0.9]], [[1.0, 0.0]] * 2, 2.0)
    tight = tf.Mechanics(dim=2, tolerance=1e-5, backend="torch")
    model = tf.Scene(tf.Growth(rate=rate), tight, founders=cells).bind()
    state = model.step(model.step(model.start()))
    monkeypatch.setattr(adjoint, "conjugate_gradients", solving)
    monkeypatch.setattr(ragged.Groups, "sum", adding)
    state.length.sum().backward()
    assert seen == {"contacts": {1}, "sums": {1}} and torch.get_num_threads() == 3
    assert rate.grad is not None and torch.isfinite(rate.grad)
