"""Steps take the mean of a schedule over their time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf

F64 = {"dtype": torch.float64}


def summed(u, s, p, cell):
    return {"dye": p.light + 0.0 * u.dye}


@pytest.mark.parametrize(("begin", "end"), [(1.02, 1.38), (1.1, 1.4), (1.05, 2.0), (0.0, 0.96)])
@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_pulses_that_end_within_steps_give_their_dose(begin, end, backend):
    """To circuits, to rules and to reactions in the medium; in parts that begin anywhere, too."""
    light = tf.Schedule({0: 0.0, begin: 1.0, end: 0.0} if begin else {0: 1.0, end: 0.0})

    def see(cells):
        cells.seen = cells.seen + cells.dt * cells.p.light

    box = {"box": ((-9, -9), (9, 9)), "spacing": 3.0, "depth": 1.0}
    scene = tf.Scene(
        tf.Circuit(summed, species="dye", light=light, dilution=False, backend=backend),
        tf.Rules(see, variables={"seen": 0.0}, parameters={"light": light}),
        tf.Medium(a=tf.Signal(diffusion=1.0), **box),
        tf.MediumReactions(lambda s, p: {"a": p.light + 0.0 * s.a}, parameters={"light": light}),
        dim=2,
    )  # fmt: skip
    *_, first = tf.simulate(scene.bind(**F64), until=0.05, dt=0.05)
    *_, last = tf.simulate(scene, first, until=2.25, dt=0.1)
    for found in (last.dye, last.seen, last.signals["a"][0]):
        assert float(found) == pytest.approx(end - begin, rel=1e-6)


def test_means_are_those_of_the_values_and_their_times():
    pulse = tf.Schedule({0: 0.0, 1: 2.0, 1.5: torch.tensor([4.0, 8.0])})
    assert pulse.mean(0.0, 1.0) == 0.0 and pulse.mean(1.0, 1.5) == 2.0
    assert pulse.mean(0.5, 1.5) == 1.0 and pulse.mean(1.25, 1.75).tolist() == [3.0, 5.0]
    assert pulse.mean(-1.0, 3.0).tolist() == pytest.approx([1.75, 3.25])
    again = tf.Schedule({0: 0.0, 0.25: 1.0}, period=1.0)
    for begin, end in ((0.0, 1.0), (0.5, 7.5), (3.75, 4.5), (0.1, 0.9), (-2.25, 0.75)):
        times = np.linspace(begin, end, 7001)[:-1] + (end - begin) / 14000
        assert again.mean(begin, end) == pytest.approx(again(times).mean(), abs=2e-3)
    assert again.shares(2.0 - 1e-12, 2.25) == [(0, 1.0)] == again.shares(2.0, 2.25 + 1e-12)
    assert tf.Schedule({0: [0.0, 4.0], 1: [2.0, 4.0]}).mean(0.5, 1.5).tolist() == [1.0, 4.0]
    with pytest.raises(tf.InputError, match=r"from 1 h = .*numbers, of which there is a mean"):
        tf.Schedule({0: 1.0, 1: {0: 1.0}}).mean(0.5, 1.5)
    with pytest.raises(tf.InputError, match=r"Schedule.mean\(end\) = 1.0"):
        again.mean(1.0, 1.0)


def test_a_restart_within_a_pulse_and_derivatives_by_it():
    """The mean passes derivatives to each value by its share."""
    strength = torch.tensor([1.0, 3.0], dtype=torch.float64, requires_grad=True)
    light = tf.Schedule({0: 0.0, 0.53: strength})
    circuit = tf.Circuit(summed, species="dye", light=light, dilution=False)
    model = tf.Scene(circuit, dim=2).bind(2, dtype=torch.float64)
    state = model.start()
    for _ in range(10):
        state = model.step(state, 0.1)
    assert state.span is None and state.dye.tolist() == pytest.approx([0.47, 1.41])
    (slope,) = torch.autograd.grad(state.dye.sum(), strength)
    assert slope.tolist() == pytest.approx([0.47, 0.47])
