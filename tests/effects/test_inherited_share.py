"""Values of which daughters inherit a share: the correlation between mothers and daughters."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.tools.checks import InputError

EACH = {
    "normal": lambda share, sd=0.1: tf.Normal(1.0, sd, inherited=share),
    "lognormal": lambda share, sd=0.1: tf.LogNormal(1.0, sd, inherited=share),
}


def scene(rate, **division):
    division = division or {"length": 3.5}
    founders = tf.Cells([[9.0 * k, 0.0] for k in range(60)], [[1.0, 0.0]] * 60, 2.0)
    return tf.Scene(tf.Growth(rate=rate), tf.Division(**division), founders=founders, dt=0.1)


def pairs(made, until=3.0, colonies=1, seed=4):
    """Rates of mothers and of their two daughters, (P, 3), of all divisions."""
    found = []
    for state in tf.simulate(made, until=until, colonies=colonies, seed=seed):
        for births in state.births:
            mother = births.before.growth_rate[births.rows]
            own = state.growth_rate[births.first], state.growth_rate[births.second]
            found.append(torch.stack([mother, *own], 1).double().numpy())
    return np.concatenate(found), state


@pytest.mark.parametrize("kind", EACH)
@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_mothers_and_daughters_correlate_by_the_share(kind, share):
    found, _ = pairs(scene(EACH[kind](share)))
    logs = np.log(found) if kind == "lognormal" else found
    count, rest = len(found), 1 - share**2
    assert count > 400
    slope = np.polyfit(logs[:, 0], logs[:, 1:].mean(1), 1)[0]
    # what is drawn beside the share has the spread 0.1 · √(1 − share²)
    assert slope == pytest.approx(share, abs=4 * (rest / count) ** 0.5 + 1e-5)
    apart = logs[:, 1] - logs[:, 2]
    assert apart.std() == pytest.approx(
        0.1 * (2 * rest) ** 0.5, rel=4 / (2 * count) ** 0.5, abs=1e-5
    )


@pytest.mark.parametrize("kind", EACH)
def test_a_share_of_nothing_is_drawn_as_before_and_all_of_it_is_kept(kind):
    alone, drawn = (pairs(scene(EACH[kind](share)))[1] for share in (False, 0.0))
    assert torch.equal(alone.growth_rate, drawn.growth_rate)
    kept = pairs(scene(EACH[kind](1.0)))[0]
    np.testing.assert_allclose(kept[:, 1:], kept[:, [0, 0]], rtol=1e-5)


@pytest.mark.parametrize("kind", EACH)
def test_the_distribution_stays_what_it_is(kind):
    """Over generations that are all followed, which divide at the same time: no one is selected."""
    division = tf.Division()
    flag = tf.Rules(lambda cells: setattr(cells, "divide_flag", cells.length > -1))
    founders = tf.Cells([[9.0 * k, 0.0] for k in range(40)], [[1.0, 0.0]] * 40, 60.0)
    made = tf.Scene(flag, division, tf.Growth(rate=EACH[kind](0.8)), founders=founders, dt=0.01)
    model = made.bind()
    state = model.start()
    for _ in range(5):
        state = model.step(state, 1e-6)
    rate = state.growth_rate.double()
    rate = rate.log() if kind == "lognormal" else rate - 1.0
    # 40 lines of which 32 cells share 0.8 per division: the mean of lines varies most
    assert state.cells == 1280
    assert float(rate.std()) == pytest.approx(0.1, rel=0.12)
    assert float(rate.mean()) == pytest.approx(0.0, abs=4 * 0.1 / 40**0.5)


def test_tails_stay_within_four_standard_deviations():
    """Also where a rule has moved a mother far beyond."""

    def far(cells):
        cells.growth_rate = torch.where(cells.length > 2.5, 2.0, cells.growth_rate)

    for kind, most in (("normal", 1.4), ("lognormal", float(np.exp(0.4)))):
        rules = tf.Rules(far)
        base = scene(EACH[kind](0.9))
        made = tf.Scene(rules, *base.effects, founders=base.founders, dt=0.1)
        found, _ = pairs(made, until=1.5)
        assert (found[:, 0] == 2.0).all()
        assert found[:, 1:].max() <= most * 1.0001 and found[:, 1:].mean() > 1.15


def test_each_type_and_each_colony_has_its_own_share():
    founders = tf.Cells(
        [[9.0 * k, 0.0] for k in range(60)], [[1.0, 0.0]] * 60, 2.0, cell_type=[0] * 30 + [1] * 30
    )
    rate = {0: tf.Normal(1.0, 0.1, inherited=1.0), 1: tf.Normal(1.0, 0.1, inherited=0.0)}
    made = tf.Scene(tf.Growth(rate=rate), tf.Division(length=3.5), founders=founders, dt=0.1)
    *_, state = tf.simulate(made, until=2.5, seed=3)
    lines = [state.growth_rate[state.cell_type == k].unique().numel() for k in (0, 1)]
    assert lines[0] <= 45 < lines[1]  # but for rounding, 30 lines and as many as cells
    together = scene(tf.Normal(1.0, 0.1, inherited=[1.0, 0.0]))
    _, both = pairs(together, until=2.5, colonies=2)
    for k, share in enumerate((1.0, 0.0)):
        own = scene(tf.Normal(1.0, 0.1, inherited=share)).bind(2, seed=4)
        alone = own.start()
        while alone.time < 2.5 - 1e-9:
            alone = own.step(alone)
        assert torch.equal(both.select([k]).growth_rate, alone.select([k]).growth_rate)


def test_thresholds_and_values_of_circuits_are_inherited_in_part():
    division = scene(1.0, added=tf.LogNormal(1.5, 0.1, inherited=0.7))
    logs = []
    for state in tf.simulate(division, until=4.0, seed=2):
        for births in state.births:
            mother = births.before.division_threshold[births.rows].log()
            logs.append(torch.stack([mother, state.division_threshold[births.first].log()], 1))
    mother, daughter = torch.cat(logs).T.numpy()
    assert np.polyfit(mother, daughter, 1)[0] == pytest.approx(
        0.7, abs=4 * (0.51 / len(mother)) ** 0.5
    )
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"gfp": p.make - u.gfp},
        species="gfp",
        make=tf.Normal(1.0, 0.1, inherited=1.0),
    )
    base = scene(1.0)
    made = tf.Scene(circuit, *base.effects, founders=base.founders, dt=0.1)
    *_, state = tf.simulate(made, until=2.5)
    makes = next(state.fields[n] for n in state.fields if "make" in n)
    assert makes.round(decimals=4).unique().numel() <= 60 < state.cells


def test_restarts_and_replays_have_the_same_bits(tmp_path):
    made = scene(tf.LogNormal(1.0, 0.1, inherited=0.5))
    *_, whole = tf.simulate(made, until=2.0, seed=5)
    list(tf.simulate(made, until=1.0, seed=5, record=tmp_path / "run.h5"))
    with tf.Results(tmp_path / "run.h5") as results:
        *_, rest = tf.simulate(made, results.state(made), until=2.0)
    assert torch.equal(whole.growth_rate, rest.growth_rate)
    *_, both = tf.simulate(made, until=2.0, seed=5, colonies=2)
    assert torch.equal(both.select([0]).growth_rate, whole.growth_rate)


def test_what_is_refused():
    for share in (-0.1, 1.5, "half", float("nan"), {0: 0.5}):
        with pytest.raises(InputError, match=r"Normal\.inherited"):
            tf.Normal(1.0, 0.1, inherited=share)
    with pytest.raises(InputError, match=r"Uniform\.inherited = 0\.5 .* A Normal or a LogNormal"):
        tf.Uniform(1.0, 2.0, inherited=0.5)
    with pytest.raises(InputError, match=r"Division\.fraction\.inherited .* no cell keeps"):
        scene(1.0, length=3.5, fraction=tf.Normal(0.5, 0.02, inherited=0.5)).bind()
    with pytest.raises(InputError, match="inherited for all cell types"):
        tf.Growth(rate={0: tf.Normal(1.0, 0.1, inherited=True), 1: tf.Normal(1.0, 0.1)})
