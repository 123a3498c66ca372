"""A scene goes on with a state of another scene."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace

import h5py
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


def test_a_variable_of_rules_may_become_a_species():
    with_rule = scene(tf.Rules(ageing, variables={"age": 0.25, "gfp": 1.5}))
    state = tf.simulate(with_rule, until=0.2).last()
    later = tf.simulate(
        GREEN, state.declare(GREEN.bind().first_fields["circuit_volume"]), until=0.3
    )
    # made at 2, lost and diluted at 1 per hour each, for 0.1 h
    assert later.last().gfp.item() == pytest.approx(1.0 + 0.5 * math.exp(-0.2), rel=0.01)


def test_a_species_may_become_a_variable_of_rules():
    state = tf.simulate(GREEN, until=0.2).last()
    ruled = scene(tf.Rules(ageing, variables={"age": 0.25, "gfp": 0.0}))
    state = state.declare(tf.Field("age", "of mine", initial=7.0))
    last = tf.simulate(ruled, state, until=0.4).last()
    assert torch.equal(last.gfp, state.gfp) and last.age.item() == pytest.approx(7.2)


@pytest.mark.parametrize("change", [{"scope": "colony"}, {"shape": (2,)}])
def test_a_variable_of_another_scope_or_shape_is_refused(change):
    state = scene().bind(2).start().declare(tf.Field("age", "of mine", **change))
    ruled = scene(tf.Rules(ageing, variables={"age": 0.25}))
    with pytest.raises(tf.InputError, match=r"'age' of this state means of mine.*take_over"):
        ruled.bind(state=state)
    assert ruled.take_over(state).age.tolist() == [0.25, 0.25]


def test_words_of_earlier_versions_are_the_same_quantity(tmp_path):
    with_age, path = scene(), tmp_path / "run.h5"
    tf.simulate(with_age, until=0.2, record=tf.Recorder(path, with_age)).last()
    with h5py.File(path, "a") as file:
        declared = json.loads(file.attrs["declared"])
        declared["growth_rate"][0] = "relative growth rate"
        file.attrs["declared"] = json.dumps(declared)
    with tf.Results(path) as results:
        state = results.state(with_age, changed=True)
    assert tf.simulate(with_age, state, until=0.4).last().time == pytest.approx(0.4)


def test_a_threshold_of_another_kind_is_refused_where_a_file_goes_on(tmp_path):
    by_length, by_volume = scene(), scene(division=tf.Division(volume=4.0))
    tf.simulate(by_length, until=0.2, record=tf.Recorder(tmp_path / "run.h5", by_length)).last()
    with tf.Results(tmp_path / "run.h5") as results:
        state = results.state(by_volume, changed=True)
        with pytest.raises(tf.InputError, match=r"'division_threshold' of this state means length"):
            tf.simulate(by_volume, state, until=0.4)
        again = results.state(by_length, changed=True)
    assert tf.simulate(by_length, again, until=0.4).last().time == pytest.approx(0.4)
    taken = by_volume.take_over(state)
    assert tf.simulate(by_volume, taken, until=0.4).last().division_threshold.tolist() == [4.0]


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
    narrow = plain.replace(*plain.effects[:2], tf.Mechanics(dim=2, periodic={"x": (1.0, 41.0)}))
    with pytest.raises(tf.InputError, match=r"cell 1 of colony 0 starts at .*, beyond the faces"):
        narrow.take_over(state)


def test_cells_behind_a_hard_wall_are_named():
    plain = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), dt=DT)
    wall = tf.Plane(x=-5.0, facing="-x")
    walled = plain.replace(plain.effects[0], tf.Mechanics([wall], dim=2))
    with pytest.warns(UserWarning, match=r"cell 0 of colony 0 starts at .* behind it"):
        walled.take_over(plain.bind().start())


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


def test_draws_go_by_seed_stream_and_id():
    drawn = scene(division=tf.Division(added=tf.Normal(2.0, 0.4)))
    state = tf.simulate(scene(), colonies=3, until=1.0, seed=7).last()
    own = state.replace(stream=torch.tensor([4, 4, 9]))
    made = drawn.take_over(own)
    assert made.stream.tolist() == [4, 4, 9]
    one, two, _ = (made.select([k]).division_threshold for k in range(3))
    assert torch.equal(one, two)
    some = drawn.take_over(own.select([2, 0]))
    assert torch.equal(some.division_threshold, made.select([2, 0]).division_threshold)
    other = drawn.take_over(own.replace(seed=8))
    assert not torch.equal(other.division_threshold, made.division_threshold)


def test_values_of_more_colonies_than_a_state_has():
    wide = scene().replace(tf.Growth(rate=torch.tensor([1.0, 2.0, 3.0])), *scene().effects[1:])
    few = tf.simulate(scene(), colonies=2, until=0.3).last()
    made = wide.take_over(few)
    assert made.colonies == 2 and tf.simulate(wide, made, until=0.4).last().colonies == 2
    some = tf.simulate(scene(), colonies=3, until=0.3).last().select([1, 0])
    assert wide.take_over(some).own_colony_id.tolist() == [1, 0]
    by_colony = scene(division=tf.Division(added=[1.0, 2.0]))
    second = scene().bind(2).start().select([1])
    assert by_colony.take_over(second).division_threshold.tolist() == [2.0]


def test_no_state_within_a_step_and_no_events_of_the_last_one():
    state, model = scene().bind().start(), scene().bind()
    with pytest.raises(tf.InputError, match="between two steps"):
        scene().take_over(state.replace(span=(0.0, DT)))
    while not state.births:
        state = model.step(state)
    made = scene().take_over(state)
    assert made.births == made.ended == () and not made.reports


def test_a_medium_with_fewer_signals_is_another():
    two = scene(tf.Medium(food=tf.Signal(10.0), ahl=tf.Signal(5.0), **BOX)).bind().start()
    with pytest.raises(tf.InputError, match=r"a medium of ahl, food.*of the scene, of food"):
        scene(MEDIUM).take_over(two)


def test_cells_beyond_a_medium_that_others_grew_without_are_refused():
    small = scene(tf.Medium(food=tf.Signal(10.0, initial=1.0), box=((-6, -6), (6, 6)), spacing=2.0))
    begun = tf.simulate(small, until=1.0).last()
    beyond = tf.simulate(scene(), scene().take_over(begun), until=5.0).last()
    with pytest.raises(tf.InputError, match=r"Medium\.box, from .* is too small for colony 0"):
        small.take_over(beyond)


@pytest.mark.parametrize("begun", [False, True], ids=["new medium", "medium of the state"])
def test_a_growing_medium_reaches_the_cells(begun):
    box = {"box": ((-2.0, -2.0), (2.0, 2.0)), "spacing": 1.0, "outside": "grow"}
    growing = scene(tf.Medium(food=tf.Signal(10.0, initial=1.0), **box))
    state = tf.simulate(growing, until=0.1).last() if begun else None
    state = state if state is None else scene().take_over(state)
    later = tf.simulate(scene(), state, until=4.0).last()
    made = growing.take_over(later)
    low = torch.as_tensor(made.layout.grid.origin)[0, :2]
    high = low + torch.as_tensor(made.layout.grid.shape)[0, :2]
    assert (made.layout.grid.shape[0, :2] > 4).all()
    assert (later.position > low).all() and (later.position < high).all()
    assert tf.simulate(growing, made, until=4.2).last().time == pytest.approx(4.2)


def test_a_state_without_cells():
    none = scene().bind().start().take(torch.arange(0))
    made = OTHER.take_over(none)
    assert made.cells == 0 and made.age.numel() == made.rfp.numel() == 0


@pytest.mark.parametrize("change", [{"unit": "nm"}, {"dtype": torch.int64}, {"shape": (2,)}])
def test_what_differs_by_unit_type_or_shape_begins_anew(change):
    new = scene(tf.Rules(lambda cells: None, variables={"mark": 0.5}))
    field = replace(new.bind().start().declared["mark"], initial=1, **change)
    made = new.take_over(scene().bind().start().declare(field))
    assert made.mark.dtype == torch.float32 and made.mark.tolist() == [0.5]


@dataclass(frozen=True, eq=False)
class Refusing(tf.Effect):
    title, stage = "refusing", 5.0

    def declares(self, dim):
        return (tf.Field("dose", "a dose"),)

    def reads(self):
        return ("dose",)

    def step(self, state, dt, values):
        return state

    def check(self, state, values):
        raise tf.InputError("no such first state")


def test_an_effect_that_is_new_looks_at_the_state():
    with pytest.raises(tf.InputError, match="no such first state"):
        scene(Refusing()).take_over(scene().bind().start())
