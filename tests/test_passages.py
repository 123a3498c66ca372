"""Serial passage: samples of cells, copies, other types, and rules that count cells or hours."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

import torchfilm as tf


def plain(**options) -> tf.Scene:
    return tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), dim=2, dt=0.05, **options)


def far_apart(count: int, **columns) -> tf.Cells:
    places = [[6.0 * k, 0.0] for k in range(count)]
    return tf.Cells(places, [1.0, 0.0], **columns)


@pytest.fixture(scope="module")
def grown() -> tf.State:
    return tf.simulate(plain(), until=4.0, colonies=3, seed=2).last()


def test_a_sample_has_as_many_cells_of_each_colony(grown):
    mask = grown.sample_cells(10)
    assert mask.dtype == torch.bool and grown.groups.sum(mask.float()).tolist() == [10.0] * 3
    kept = grown.remove(~mask)
    assert kept.counts.tolist() == [10] * 3 and kept.ended[-1].fate == "removed"
    assert grown.sample_cells(10**6).all() and not grown.sample_cells(0).any()
    few = grown.remove((grown.colony == 1) & (grown.uid > grown.uid.min() + 20))
    assert few.groups.sum(few.sample_cells(12).float())[0] == 12
    for wrong in (-1, 0.5, "a"):
        with pytest.raises(tf.InputError, match=r"sample_cells\(count\)"):
            grown.sample_cells(wrong)


def test_a_sample_does_not_depend_on_the_batch_and_does_on_step_and_purpose(grown):
    mask = grown.sample_cells(10)
    assert torch.equal(grown.sample_cells(10), mask)
    alone = grown.select([2])
    assert torch.equal(alone.sample_cells(10), mask[grown.colony == 2])
    later = grown.replace(step=grown.step + 1)
    assert not torch.equal(later.sample_cells(10), mask)
    assert not torch.equal(grown.sample_cells(10, "again"), mask)


def test_every_cell_is_as_likely_in_a_sample():
    state = plain(founders=far_apart(6)).bind(4000, seed=1).start()
    shares = state.sample_cells(2).float().reshape(4000, 6)
    expected, error = 1 / 3, (2 / 9 / 4000) ** 0.5
    assert (shares.mean(0) - expected).abs().max() < 4 * error
    both = (shares[:, 0] * shares[:, 5]).mean()  # a pair: 1/15
    assert float(both) == pytest.approx(1 / 15, abs=4 * (1 / 15 / 4000) ** 0.5)


def test_copies_with_one_number_are_refused(grown):
    """They had drawn the same, unsaid."""
    twice = grown.take(torch.tensor([0, 1, 1, 2]))
    with pytest.raises(tf.InputError, match=r"cells 1 and 2 have one uid, .*state\.take"):
        plain().bind(state=twice)
    with pytest.raises(tf.InputError, match="have one uid"):
        tf.simulate(plain(), twice, until=5.0)
    own = twice.replace(uid=torch.arange(4), next_uid=torch.tensor([4, 4, 4]))
    assert tf.simulate(plain(), own, until=4.1).last().cells >= 4


RATE = {0: tf.Normal(1.0, 0.05, inherited=True), 1: tf.Normal(3.0, 0.05, inherited=True)}


@dataclass(frozen=True, eq=False)
class Changing(tf.Effect):
    """Cells of even numbers get type 1 after half an hour."""

    title, stage = "changing", 85
    removing: bool = False

    def reads(self):
        return ("cell_type", "cells")

    def writes(self):
        return ("cell_type", *(["cells"] if self.removing else []))

    def step(self, state, dt, values):
        kind = torch.where((state.uid % 2 == 0) & (state.time > 0.5), 1, state.cell_type)
        made = state.with_fields(cell_type=kind)
        gone = (state.uid < 5) & (state.time > 0.5)
        return made.remove(gone) if self.removing else made


@pytest.mark.parametrize("removing", [False, True])
def test_cells_to_which_an_effect_of_ones_own_gives_a_type_have_its_values(removing):
    """As by rules; they had kept what was drawn for their old type."""
    cells = far_apart(20, cell_type=[0] * 20)
    scene = tf.Scene(Changing(removing), tf.Growth(rate=RATE), dim=2, dt=0.05, founders=cells)
    first = scene.bind(seed=3).start()
    last = tf.simulate(scene, first, until=1.0).last()
    changed, gone = last.cell_type == 1, 5 if removing else 0
    assert int(changed.sum()) == (7 if removing else 10) and last.cells == 20 - gone
    assert (last.growth_rate[changed] - 3.0).abs().max() < 0.3
    assert torch.equal(last.growth_rate[~changed], first.growth_rate[gone:][~changed])
    again = tf.simulate(scene, last, until=1.5).last()
    assert torch.equal(again.growth_rate, last.growth_rate)  # drawn once


def test_rates_of_first_cells_that_those_of_types_replace_are_remarked_on():
    cells = far_apart(2, cell_type=[0, 1], extra={"growth_rate": [0.5, 0.6]})
    with pytest.warns(UserWarning, match=r"growth_rate of their own, which Growth\.rate = .*types"):
        tf.Scene(tf.Growth(rate={0: 1.0, 1: 1.1}), tf.Division(length=4.0), founders=cells)


def dies_by_len(cells):
    cells.remove_flag = cells.event(0.01 * len(cells))


def counts_by_len(cells):
    cells.hits = cells.hits + cells.poisson(0.01 * cells.count)


def halves_by_len(cells):
    cells.hits = cells.binomial(10.0, 1.0 / (1.0 + len(cells)))


def chance_by_len(cells):
    cells.hits = cells.chance(min(1.0, 0.001 * len(cells))).float()


@pytest.mark.parametrize("rule", [dies_by_len, counts_by_len, halves_by_len, chance_by_len])
def test_a_draw_by_the_cells_of_all_colonies_is_remarked_on(rule):
    """What is drawn may be alike in a trial, by chance."""
    scene = plain().replace(tf.Rules(rule, variables={"hits": 0.0}), *plain().effects)
    with pytest.warns(UserWarning, match=r"what it (gives to \w+|sets), .*depends on the other"):
        scene.bind(2)


def test_a_draw_by_the_cells_of_the_own_colony_is_fine():
    def dies(cells):
        cells.remove_flag = cells.event(0.01 * cells.colony_sum(1.0))

    plain().replace(tf.Rules(dies), *plain().effects).bind(2)  # a warning fails a test


@pytest.mark.parametrize("dt", [0.1, 0.025, 1 / 12, 0.05, 0.3])
def test_every_half_hour_is_once_in_each(dt):
    def feeds(cells):
        if cells.every(0.5):
            cells.fed = cells.fed + 1.0

    scene = tf.Scene(tf.Rules(feeds, variables={"fed": 0.0}), tf.Growth(rate=0.0), dim=2, dt=dt)
    steps = round(9.9 / dt)
    state = tf.simulate(scene, until=steps * dt).last()
    assert state.fed.tolist() == [20.0]  # at 0, 0.5, …, 9.5 h


def test_more_often_than_steps_is_refused():
    def feeds(cells):
        cells.fed = float(cells.every(0.01))

    scene = plain().replace(tf.Rules(feeds), *plain().effects)
    with pytest.raises(tf.InputError, match=r"cells\.every\(hours\) = 0\.01.*at least 0\.05"):
        tf.simulate(scene, until=1.0).last()
    fine = tf.Scene(*scene.effects, dim=2, dt=0.01)
    assert tf.simulate(fine, until=0.05).last().fed.tolist() == [1.0]


def test_the_table_of_a_state_makes_first_cells(grown):
    table = tf.cell_table(grown)
    cells = tf.Cells.from_table(table, length_unit="um", angle_unit="radians")
    assert cells.count == grown.cells and not {"time", "cell", "volume"} & cells.extra.keys()
    state = plain().bind(cells=cells).start()
    assert torch.allclose(state.position, grown.position) and torch.equal(
        state.length, grown.length
    )
    assert torch.allclose(state.axis, grown.axis, atol=1e-6)


def passages(path, numbers, state=None):
    """As the page of states does it; a protocol that goes on begins with what its file has."""
    scene = plain()
    state = scene.bind(3, seed=4).start() if state is None else state
    for number in numbers:
        kept = state.remove(~state.sample_cells(5))
        recorder = tf.Recorder(path, scene, append=number > 0)
        state = tf.simulate(scene, kept, until=2.0 * (number + 1), record=recorder).last()
    return state


def test_a_protocol_goes_on_from_its_file_as_if_it_had_not_stopped(tmp_path):
    whole = passages(tmp_path / "whole.h5", range(4))
    passages(tmp_path / "parts.h5", range(2))
    with tf.Results(tmp_path / "parts.h5") as results:
        state = results.state(plain())
    assert state.counts.min() > 5
    parts = passages(tmp_path / "parts.h5", range(2, 4), state)
    assert torch.equal(parts.uid, whole.uid) and torch.equal(parts.length, whole.length)
    with tf.Results(tmp_path / "whole.h5") as one, tf.Results(tmp_path / "parts.h5") as other:
        assert one.lineage().clone_sizes(1) == other.lineage().clone_sizes(1)
        removed = other.lineage().fate == "removed"
        assert set(other.lineage().ended[removed]) <= {2.0, 4.0, 6.0}


def test_variables_with_the_names_of_columns_come_back_from_a_table():
    ages = tf.Rules(lambda cells: None, variables={"age": 1.5, "born": 2.5})
    state = plain().replace(ages, *plain().effects).bind().start()
    cells = tf.Cells.from_table(tf.cell_table(state), length_unit="um", angle_unit="radians")
    assert cells.extra["age"].tolist() == [1.5] and cells.extra["born"].tolist() == [2.5]
