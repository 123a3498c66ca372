"""Inputs that change in time: when rules and circuits see them, and changes between steps."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

import torchfilm as tf
from torchfilm.tools.times import later

F64 = torch.float64


def lit(at: float, **options) -> tf.Scene:
    """One still cell that adds up a light that is on from a time, seen by the circuit, `a`, and by
    a rule, `b`."""

    def light(cells):
        cells.light = 1.0 if cells.time >= at else 0.0

    def rates(u, s, p, cell):
        return {"a": torch.where(cell.time >= at, 1.0, 0.0), "b": 1.0 * cell.light}

    rule = tf.Rules(light, variables={"light": 0.0})
    return tf.Scene(rule, tf.Circuit(rates, species=("a", "b"), **options), dim=2)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("parts", [12, 40, 60])
def test_a_light_that_goes_on_at_a_step_is_on_from_that_step(parts, dtype):
    """Also where the time of the step, as a sum, is less than the number by a rounding."""
    for k in (1, 5, 7, parts - 1):
        scene = lit(k / parts).replace(dt=1 / parts)
        *_, end = tf.simulate(scene, until=1.0, dtype=dtype)
        for species in (end.a, end.b):
            assert float(species) == pytest.approx(1 - k / parts, abs=1e-6)


@pytest.mark.parametrize("parts", [7, 12, 40, 60, 3600])
def test_times_are_the_fractions_that_a_person_would_write(parts):
    time = 0.0
    for k in range(5 * parts):
        assert time == k / parts
        time = later(time, k, 1 / parts)


def test_times_go_on_as_fractions_where_the_step_changes():
    time = 1.0  # after ten steps of 0.1
    for k in range(40):
        time = later(time, 10 + k, 0.025)
    assert time == 2.0
    odd = math.pi / 100
    assert later(3 * odd, 3, odd) == 4 * odd and later(1.0, 10, odd) == 1.0 + odd


@pytest.mark.parametrize("circuit", [{"rtol": 1e-8}, {"method": "rk4"}, {"backend": "torch"}])
def test_inputs_that_change_are_of_second_order(circuit):
    """A rate that depends on the time, against the solution."""

    def rates(u, s, p, cell):
        return {"a": torch.sin(cell.time + 0.0 * u.a) - u.a}

    exact = (math.sin(2.0) - math.cos(2.0) + math.exp(-2.0)) / 2
    errors = []
    for dt in (0.2, 0.1, 0.05):
        scene = tf.Scene(tf.Circuit(rates, species="a", **circuit), dim=2, dt=dt)
        *_, end = tf.simulate(scene, until=2.0, dtype=F64)
        errors.append(abs(float(end.a) - exact))
    assert errors[0] < 1e-3 and errors[2] < errors[1] / 3.5 < errors[0] / 12


def growing(rate, length=4.0, **options) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=rate), tf.Division(length=length), tf.Mechanics(dim=2), dt=0.1, **options
    )


@pytest.mark.parametrize(
    "other, name, values",
    [
        (growing(0.2), "growth_rate", "0.2; those of the state keep 1,"),
        (growing(torch.tensor([0.2, 0.3])), "growth_rate", "0.2, 0.3; those of the state keep 1,"),
        (growing(1.0, length=8.0), "division_threshold", "8; those of the state keep 4,"),
    ],
)
def test_values_that_cells_keep_are_warned_of(other, name, values):
    """A scene that goes on from a state with another rate, which cells of the state do not take."""
    *_, state = tf.simulate(growing(1.0), until=0.5, colonies=2)
    with pytest.warns(UserWarning, match=f"gives its first cells {name} = {values}"):
        other.bind(state=state)


def test_values_that_do_act_are_not_warned_of():
    *_, state = tf.simulate(growing(1.0), until=0.5)
    drawn = growing(tf.Normal(0.2, 0.01), tf.Uniform(3.0, 4.0))
    ruled = growing(0.2).replace(*growing(0.2).effects, tf.Rules(lambda cells: None))
    two = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, 2.0)
    many = growing(0.2, founders=two).bind().start()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scene, start in ((growing(1.0), state), (drawn, state), (ruled, state)):
            scene.bind(state=start)
        growing(0.2).bind(state=many.with_fields(growth_rate=torch.tensor([0.1, 0.3])))


def test_a_recorder_that_has_written_a_run_says_so(tmp_path):
    scene = growing(1.0)
    recorder = tf.Recorder(tmp_path / "a.h5", scene, every=1, overwrite=True)
    *_, state = tf.simulate(scene, until=0.2, record=recorder)
    with pytest.raises(tf.InputError, match="A Recorder writes one run"):
        next(iter(tf.simulate(scene, state, until=0.4, record=recorder)))
    assert len(tf.Results(tmp_path / "a.h5")) == 3
