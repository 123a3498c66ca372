"""A scene goes on with a state of another scene."""

from __future__ import annotations

import math

import pytest
import torch

import torchfilm as tf

DT = 0.05
BOX = {"box": ((-24.0, -24.0), (24.0, 24.0)), "spacing": 4.0}


def green(u, s, p, cell):
    return {"gfp": p.k - u.gfp}


def red(u, s, p, cell):
    return {"rfp": s.food - u.rfp}, {"food": -0.1 * u.rfp}


def ageing(cells):
    cells.age = cells.age + DT


def scene(*effects, division=None, dim=2) -> tf.Scene:
    division = division or tf.Division(length=4.0)
    return tf.Scene(tf.Growth(rate=1.0), division, tf.Mechanics(dim=dim), *effects, dt=DT)


GREEN = scene(tf.Circuit(green, species="gfp", k=2.0))
MEDIUM = tf.Medium(food=tf.Signal(10.0, initial=1.0), **BOX)
OTHER = scene(
    tf.Circuit(red, species="rfp", initial={"rfp": 0.5}),
    MEDIUM,
    tf.Rules(ageing, variables={"age": 0.25}),
)


@pytest.fixture(scope="module")
def grown() -> tf.State:
    return tf.simulate(GREEN, until=2.5, colonies=2).last()


def test_what_is_lacking_has_first_values_and_all_else_stays(grown):
    made = OTHER.take_over(grown)
    assert made.rfp.eq(0.5).all() and made.age.eq(0.25).all()
    assert made.signals["food"].eq(1.0).all() and made.layout.grid.nodes == 2 * 12 * 12
    for name, value in grown.cell_columns().items():
        assert torch.equal(made.cell_columns()[name], value)
    assert (made.time, made.step, made.seed) == (grown.time, grown.step, grown.seed)
    assert "rfp" not in grown.fields and grown.layout is None


def test_a_run_goes_on_and_back(grown, tmp_path):
    record = tf.Recorder(tmp_path / "other.h5", OTHER, every=2)
    there = tf.simulate(OTHER, OTHER.take_over(grown), until=3.5, record=record).last()
    assert there.age.max().item() == pytest.approx(0.25 + 1.0, rel=1e-5)
    assert 0.4 < there.rfp.mean().item() < 0.95 and there.signals["food"].mean() < 1.0
    with tf.Results(tmp_path / "other.h5") as results:
        again = results.state(OTHER)
    assert torch.equal(again.rfp, there.rfp) and torch.equal(again.position, there.position)
    back = tf.simulate(GREEN, GREEN.take_over(there), until=4.0).last()
    assert 0.9 < back.gfp.mean().item() < 1.1 and torch.equal(back.groups.counts, back.counts)


def test_the_same_scene_changes_nothing(grown):
    """Also in a run that goes on: to the bit."""
    same = GREEN.take_over(grown)
    assert {n: x.tolist() for n, x in same.fields.items()} == {
        n: x.tolist() for n, x in grown.fields.items()
    }
    plain, taken = (tf.simulate(GREEN, s, until=3.0).last() for s in (grown, same))
    assert torch.equal(plain.position, taken.position) and torch.equal(plain.gfp, taken.gfp)


def test_a_threshold_of_another_kind_has_first_values(grown):
    """A length at which cells divide is no length to add."""
    adder = scene(division=tf.Division(added=1.5))
    made = adder.take_over(grown)
    assert made.division_threshold.eq(1.5).all() and torch.equal(made.birth_length, grown.length)
    last = tf.simulate(adder, made, until=3.5).last()
    assert last.cells > grown.cells


@pytest.mark.parametrize("kinds", [("length", "volume"), ("added", "length"), ("volume", "length")])
def test_a_threshold_of_another_kind_is_refused_without(kinds):
    """It had been compared with what it is no threshold of."""
    first, other = (tf.Scene(tf.Growth(rate=1.0), tf.Division(**{k: 5.0}), dt=0.1) for k in kinds)
    state = tf.simulate(first, until=0.5).last()
    words = rf"'division_threshold' of this state means {kinds[0]}.*division.*means {kinds[1]}"
    for go_on in (lambda: other.bind(state=state), lambda: tf.simulate(other, state, until=1.0)):
        with pytest.raises(tf.InputError, match=words + r".*: scene\.take_over\(state\)"):
            go_on()
    assert tf.simulate(first, state, until=1.0).last().time == pytest.approx(1.0)
    assert tf.simulate(other, other.take_over(state), until=1.0).last().time == pytest.approx(1.0)


def test_columns_of_the_first_cells_may_have_the_name_of_a_field():
    cells = tf.Cells.single(2, length=2.0)
    cells = tf.Cells(cells.position, cells.axis, length=2.0, extra={"division_threshold": [2.5]})
    made = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), founders=cells, dt=0.1)
    state = tf.simulate(made, until=0.3).last()
    assert tf.simulate(made, state, until=0.6).last().cells > 1


def test_molecules_are_whole_where_they_are_counted(grown):
    counted = scene(
        tf.Circuit(
            [tf.Reaction({}, {"gfp": 1}, 2.0), tf.Reaction({"gfp": 1}, {}, 1.0)], species="gfp",
            method="tau_leap", molecules_per_unit=20.0,
        )
    )  # fmt: skip
    amounts = (lambda x: x.gfp * x.volume * 20.0)(counted.take_over(grown))
    assert amounts.round().sub(amounts).abs().max() < 1e-3
    assert (grown.gfp * grown.volume * 20.0 - amounts).abs().max() <= 1.0


@pytest.mark.parametrize("outside", ["error", "grow", "reservoir"])
def test_the_same_medium_and_counted_molecules_stay_to_the_bit(outside):
    counted = tf.Circuit(
        [tf.Reaction({}, {"gfp": 1}, 2.0), tf.Reaction({"gfp": 1}, {}, 1.0)], species="gfp",
        method="tau_leap", molecules_per_unit=20.0,
    )  # fmt: skip
    box = {"box": ((-6.0, -6.0), (6.0, 6.0)), "spacing": 2.0}
    medium = tf.Medium(food=tf.Signal(10.0, initial=1.0), outside=outside, **box)
    made = scene(counted, medium)
    for hours in (0.6, 1.2, 1.8):
        state = tf.simulate(made, until=hours).last()
        taken = made.take_over(state)
        for name, value in state.fields.items():
            assert torch.equal(taken.fields[name], value), name
        assert taken.layout is state.layout


def test_concentrations_are_those_of_the_cells_as_they_are(grown):
    """Though no circuit has followed their volumes for a while."""
    bare = scene()
    later = tf.simulate(bare, grown, until=3.0).last()
    idle = tf.Circuit(lambda u, s, p, cell: {}, species="rfp", initial={"rfp": 1.0})
    slow = scene(idle)
    step = tf.simulate(slow, slow.take_over(later), until=3.0 + DT).last()
    # diluted by the growth of one step, not of half an hour
    assert step.rfp.mean().item() == pytest.approx(math.exp(-DT), abs=0.02)


def test_space_is_that_of_the_scene():
    plain = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2), dt=DT)
    periodic = plain.replace(*plain.effects[:2], tf.Mechanics(dim=2, periodic={"x": (-20.0, 20.0)}))
    state = tf.simulate(plain, until=1.0).last()
    assert periodic.take_over(state).space == periodic.bind().start().space is not None


def test_names_that_rules_are_the_first_to_set(grown):
    def marks(cells):
        cells.long = cells.length > 1.0

    made = scene(tf.Rules(marks))
    taken = made.take_over(grown)
    assert not taken.long.any() and tf.simulate(made, taken, until=2.6).last().long.all()


def test_states_that_do_not_fit_are_refused(grown):
    with pytest.raises(tf.InputError, match=r"state = '2-D'.*3-D, as the scene is"):
        scene(dim=3).take_over(grown)
    with pytest.raises(tf.InputError, match="a State"):
        GREEN.take_over(3)
    there = OTHER.take_over(grown)
    fine = scene(
        tf.Circuit(red, species="rfp"), tf.Medium(food=tf.Signal(10.0), box=BOX["box"], spacing=2.0)
    )
    with pytest.raises(tf.InputError, match="on another grid, of 4 × 4"):
        fine.take_over(there)
    more = tf.Medium(food=tf.Signal(10.0), ahl=tf.Signal(20.0), **BOX)
    with pytest.raises(tf.InputError, match=r"a medium of food.*that of the scene, of ahl, food"):
        scene(more).take_over(there)
    small = tf.Medium(food=tf.Signal(10.0), box=((-2.0, -2.0), (2.0, 2.0)), spacing=1.0)
    with pytest.raises(tf.InputError, match=r"Medium\.box.*too small for colony 0"):
        scene(small).take_over(grown)
    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], extra={"vigour": [0.5]})
    slowed = tf.Scene(tf.Growth(rate=1.0, factor="vigour"), founders=founders, dt=DT)
    with pytest.raises(tf.InputError, match=r"needs the field 'vigour'.*scene\.bind\(…\)\.start"):
        slowed.take_over(grown)
    with pytest.raises(
        tf.InputError, match=r"rules needs the field 'age'.*scene\.take_over\(state\)"
    ):
        tf.simulate(scene(tf.Rules(ageing, variables={"age": 0.0})), grown, until=3.0)
