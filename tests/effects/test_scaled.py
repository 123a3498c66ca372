"""Functions of positions times a number for each colony: flows, sources, decays, first values."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch

import torchfilm as tf
from design import Measured, Objective, Parameter, Task
from torchfilm.tools.checks import InputError

SPEEDS, AMOUNTS = (0.0, 50.0, 200.0), (1.0, 2.0, 0.5)


def profile(positions):
    """Of a flow between plates, along x."""
    speed = torch.zeros_like(positions)
    speed[:, 0] = 1.0 - (positions[:, 1] / 16.0) ** 2
    return speed


def left(positions):
    return (positions[:, 0] < -16.0).double()


def medium(**given):
    signal = tf.Signal(diffusion=50.0, **{"decay": 0.5, **given})
    return tf.Medium(ahl=signal, box=((-32, -16), (32, 16)), spacing=4.0)


def scene(**given):
    return tf.Scene(tf.Growth(rate=1.0), medium(**given), dim=2, dt=0.1)


def levels(made, colonies=1, steps=4, dtype=torch.float64):
    model = made.bind(colonies, dtype=dtype)
    state = model.start()
    for _ in range(steps):
        state = model.step(state)
    return state.signals["ahl"].reshape(colonies, -1)


@pytest.mark.parametrize("name", ["flow", "source", "decay", "initial"])
def test_each_colony_is_as_alone_with_its_own_function(name):
    function, factors = (profile, SPEEDS) if name == "flow" else (left, AMOUNTS)
    other = {} if name in ("source", "initial") else {"source": left}
    together = levels(scene(**{name: tf.Scaled(function, factors)}, **other), 3)
    for k, factor in enumerate(factors):
        own = lambda positions, factor=factor: factor * function(positions)
        alone = levels(scene(**{name: own}, **other))
        torch.testing.assert_close(together[k], alone[0], rtol=1e-12, atol=1e-14)
    assert not torch.allclose(together[0], together[1])


def test_parts_of_a_batch_keep_their_own_factors():
    model = scene(flow=tf.Scaled(profile, SPEEDS), source=tf.Scaled(left, AMOUNTS)).bind(3)
    state = model.step(model.start())
    whole = model.step(state).signals["ahl"].reshape(3, -1)
    part = model.step(state.select([2, 0])).signals["ahl"].reshape(2, -1)
    assert torch.equal(part, whole[[2, 0]])


def test_derivatives_by_factors_are_those_of_differences():
    def found(speed, amount):
        made = scene(flow=tf.Scaled(profile, speed), source=tf.Scaled(left, amount))
        ahl = levels(made)[0]
        return (ahl * torch.linspace(0.0, 1.0, len(ahl), dtype=torch.float64)).sum()

    given = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (80.0, 1.5)]
    slopes = torch.autograd.grad(found(*given), given)
    with torch.no_grad():
        for k, slope in enumerate(slopes):
            up, down = ([x + s * 1e-3 * (j == k) for j, x in enumerate(given)] for s in (1, -1))
            assert float(slope) == pytest.approx(float(found(*up) - found(*down)) / 2e-3, rel=1e-6)


def test_a_schedule_takes_turns_of_scaled_functions():
    feeding = tf.Schedule({0: tf.Scaled(left, AMOUNTS), 0.2: 0.0})
    found = levels(scene(source=feeding), 3).amax(1)
    first = levels(scene(source=tf.Scaled(left, AMOUNTS)), 3, steps=2).amax(1)
    torch.testing.assert_close(found / found[0], torch.tensor(AMOUNTS, dtype=torch.float64))
    assert (found < first).all()


def test_designs_that_differ_in_strength_are_one_batch():
    """A search gives one factor to each design."""

    def fed(amount=1.0):
        return scene(source=tf.Scaled(left, amount))

    highest = lambda state: state.signals["ahl"].reshape(state.colonies, -1).amax(1)
    most = Measured({"most": highest}, wanted={"most": 1.0}, spread={"most": 0.1})
    task = Task(fed, [Parameter("amount", 0.5, 2.0)], most, until=0.4, replicates=1)
    found = Objective(task).evaluate(np.array([[0.0], [0.5], [1.0]]))
    alone = [Objective(task).evaluate(np.array([[x]])).loss[0] for x in (0.0, 0.5, 1.0)]
    assert found.loss.tolist() == alone and len(set(alone)) == 3


def test_what_is_refused():
    for wrong in (3.0, tf.Scaled(left, 1.0), tf.Schedule({0: left})):
        with pytest.raises(InputError, match=r"Scaled\.function .* a function from positions"):
            tf.Scaled(wrong, 2.0)
    for factor in ("strong", {0: 1.0}, tf.Uniform(0.0, 1.0), float("nan")):
        with pytest.raises(InputError, match=r"Scaled\.factor"):
            tf.Scaled(left, factor)
    with pytest.raises(InputError, match=r"source\(positions\) .* at least 0 everywhere"):
        scene(source=tf.Scaled(left, -1.0)).bind()
    with pytest.raises(InputError, match=r"source\.factor has 2 values, but the batch has 3"):
        scene(source=tf.Scaled(left, [1.0, 2.0])).bind(3)


def test_it_is_known_by_its_numbers():
    one, other = tf.Scaled(left, [1.0, 2.0]), tf.Scaled(left, [1.0, 3.0])
    assert tf.digest(one) != tf.digest(other)
    assert tf.digest(pickle.loads(pickle.dumps(one))) == tf.digest(one)
