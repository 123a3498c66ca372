"""Torch in one thread, where kernels compute."""

from dataclasses import dataclass

import pytest
import torch

import torchfilm as tf
from torchfilm.tools import threads


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


def test_work_is_shared_among_as_many_threads_as_torch_was_given():
    ranges = []
    with tf.one_torch_thread():
        threads.shares_of(30, 10, lambda first, last: ranges.append((first, last)))
    assert sorted(ranges) == [(0, 10), (10, 20), (20, 30)]


def test_a_rule_has_the_threads_of_torch_and_kernels_leave_it_one(monkeypatch):
    """In each step: a user's function may do much in torch, kernels' own effects do little."""
    seen = {}

    def rule(cells):
        seen["rule"] = torch.get_num_threads()
        return {"growth_rate": cells.growth_rate}

    step = tf.Growth.step

    def spied(self, *given):
        seen["growth"] = torch.get_num_threads()
        return step(self, *given)

    monkeypatch.setattr(tf.Growth, "step", spied)
    scene = tf.Scene(tf.Rules(rule), tf.Growth(rate=1.0), tf.Mechanics())
    model = scene.bind()
    for inside in (False, True):
        seen.clear()
        if inside:
            with tf.one_torch_thread():
                model.step(model.start())
        else:
            model.step(model.start())
        assert seen == {"rule": 3, "growth": 1}
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
