"""Growth by which a cell would more than double in a step, where cells divide: a factor, a rule or
a species may make it so, which no check of `rate` sees."""

from __future__ import annotations

import math

import pytest
import torch

import torchfilm as tf

CONTACTS = pytest.mark.parametrize(
    "contacts", [[], [tf.Mechanics(dim=2)]], ids=["free", "contacts"]
)


def by_factor(grown: float):
    def update(cells):
        cells.boost = math.log(grown) / 0.05

    return tf.Rules(update, variables={"boost": 1.0}), tf.Growth(rate=1.0, factor="boost")


def by_rule(grown: float):
    def update(cells):
        cells.growth_rate = math.log(grown) / 0.05

    return tf.Rules(update), tf.Growth()


def by_species(grown: float):
    making = lambda u, s, p, cell: {"g": (grown - 1.0) / 0.05 + 0 * u.g}
    return tf.Circuit(making, species="g", initial={"g": grown - 1.0}), tf.Growth(species="g")


@CONTACTS
@pytest.mark.parametrize("made", [by_factor, by_rule, by_species])
def test_it_fails_the_colony(made, contacts):
    """Cells that grow 1.9-fold in a step, and 2.2-fold."""
    division = tf.Division(length=4.0, conserves="volume")
    scene = tf.Scene(*made(1.9), division, *contacts, dim=2, dt=0.05)
    *_, state = tf.simulate(scene, until=0.2)
    assert state.cells > 1
    scene = tf.Scene(*made(2.2), division, *contacts, dim=2, dt=0.05)
    with pytest.raises(tf.SimulationError, match=r"cell \d+ would become 2\.\d* times as large"):
        for _ in tf.simulate(scene, until=0.2):
            pass


@CONTACTS
def test_only_the_colony_in_which_it_happens(contacts):
    def update(cells):
        cells.growth_rate = torch.where((cells.colony == 1) & (cells.time > 0.2), 20.0, 1.0)

    division = tf.Division(length=4.0)
    scene = tf.Scene(tf.Rules(update), tf.Growth(), division, *contacts, dim=2, dt=0.05)
    *_, state = tf.simulate(scene, until=0.5, colonies=3, on_failure="drop")
    assert (state.counts > 0).tolist() == [True, False, True]


@CONTACTS
def test_linear_growth_too(contacts):
    """Of 2 µm with caps of 2/3 µm in volume: 2.75 µm in a step are 1.03 times as much, 2.9 are
    1.09 times."""
    division = tf.Division(length=4.0)
    law = lambda more: tf.Growth(rate=more / 0.05, law="linear")
    model = tf.Scene(law(2.75), division, *contacts, dim=2, dt=0.05).bind()
    assert not tf.failures(model.step(model.start()))
    model = tf.Scene(law(2.9), division, *contacts, dim=2, dt=0.05).bind()
    assert "2.09 times as large" in str(tf.failures(model.step(model.start())))


def test_where_no_cell_divides_it_may_be():
    scene = tf.Scene(*by_rule(3.0), dim=2, dt=0.05)
    *_, state = tf.simulate(scene, until=0.1)
    assert float(state.volume[0]) == pytest.approx(9 * math.pi * 0.25 * (2 + 2 / 3), rel=1e-5)


def test_linear_growth_may_be_where_a_rule_decides_who_divides():
    """2 µm become 6 µm in a step, and the rule may let such cells divide in each step."""

    def update(cells):
        cells.divide_flag = cells.length > 4.0

    growth = tf.Growth(rate=4.0 / 0.05, law="linear")
    scene = tf.Scene(tf.Rules(update), growth, tf.Division(), dim=2, dt=0.05)
    model = scene.bind()
    state = model.step(model.start())
    assert not tf.failures(state) and float(state.length[0]) == pytest.approx(6.0)
