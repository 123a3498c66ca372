"""When cells divide: in which step, and before or after they grow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from helpers import step

import torchfilm as tf
from torchfilm.effects import compiled_division


def one_cell(length: float = 2.0) -> tf.Cells:
    return tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], length)


def division_times(division: tf.Division, steps: int) -> list[int]:
    """Steps in which the number of cells changed; growth is linear, ¼ µm a step, so that every
    length is exact in binary."""
    scene = tf.Scene(tf.Growth(rate=1.0, law="linear"), division, founders=one_cell())
    state, found = scene.bind().start(), []
    for _ in range(steps):
        new = step(scene, state, 0.25)
        if new.cells > state.cells:
            found.append(new.step)
        state = new
    return found


def test_by_length():
    """2 + ¼k reaches 3 in step 4. Daughters start at (3 − 1)/2 = 1: eight steps more."""
    assert division_times(tf.Division(length=3.0), 14) == [4, 12]


def test_by_volume():
    """The volume of l = 3, less a billionth so that rounding cannot put it off by a step: the same
    times."""
    at = math.pi * 0.25 * (3.0 + 2 / 3) * (1 - 1e-6)
    assert division_times(tf.Division(volume=at), 14) == [4, 12]


def test_by_added_length():
    """2 → 3 (four steps), daughters born at 1, each again 1 µm: four steps between births."""
    assert division_times(tf.Division(added=1.0), 14) == [4, 8, 12]


def test_without_a_threshold_nothing_divides_by_itself():
    assert division_times(tf.Division(), 14) == []


def test_the_first_division_is_seen_less_than_a_step_after_its_moment():
    """A lone cell of length 2, radius ½ at 1/h reaches length 4 when its volume has grown by the
    factor (4 + ⅔)/(2 + ⅔)."""
    moment = math.log((4 + 2 / 3) / (2 + 2 / 3))
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0))
    for dt in (0.1, 0.03, 0.011):
        seen = next(s.time for s in tf.simulate(scene, cells=2, dt=dt) if s.cells == 2)
        assert 0 <= seen - moment + 1e-9 < dt


def test_no_state_of_a_run_has_a_cell_that_is_due():
    division = tf.Division(added=tf.Uniform(1.5, 2.5))
    scene = tf.Scene(tf.Growth(rate=1.0), division, tf.Mechanics(dim=2), dt=0.1)
    states = list(tf.simulate(scene, colonies=3, cells=20))
    assert sum(len(b.first) for s in states for b in s.births) > 50
    assert not any(bool(division.due(s).any()) for s in states)


def test_cells_divide_at_a_threshold_when_they_have_grown_and_by_a_flag_before():
    """Daughters of 3 µm are 1 µm long; these of a cell that a rule flags grow by ¼ µm at once."""

    def update(cells):
        cells.divide_flag = cells.length >= 2.75

    grow = tf.Growth(rate=1.0, law="linear")
    for division, longest in ((tf.Division(length=3.0), 1.0), (tf.Division(), 1.25)):
        rules = () if division.criterion else (tf.Rules(update),)
        founders = one_cell(2.75 if division.criterion else 3.0)
        scene = tf.Scene(*rules, grow, division, founders=founders)
        state = step(scene, scene.bind().start(), 0.25)
        assert state.length.tolist() == [longest] * 2
        order = [e.title for e in scene.bind().effects]
        assert order == (["growth", "division"] if not rules else ["rules", "division", "growth"])


def test_a_rule_at_division_acts_right_after_divisions_of_both_kinds():
    def divide(parent, first, second):
        first.born = first.length
        second.born = second.length

    rules = lambda: tf.Rules(divide=divide, variables={"born": 0.0})
    for division in (tf.Division(length=3.0), tf.Division()):
        scene = tf.Scene(rules(), tf.Growth(rate=1.0), division, founders=one_cell(2.9))
        start = scene.bind().start()
        state = step(scene, start.with_fields(divide_flag=torch.tensor([True])), 0.05)
        grown = state.length if division.criterion else 0.95  # (2.9 − 1)/2, before it grows
        assert state.cells == 2 and torch.allclose(
            state.born, torch.as_tensor(grown, dtype=state.dtype)
        )


def test_a_variable_of_a_rule_may_be_called_like_the_threshold():
    """It makes no threshold: rules flag cells, and `divide` is called where these divide."""

    def update(cells):
        cells.divide_flag = cells.length > cells.division_threshold

    def divide(parent, first, second):
        first.mark = second.mark = 1.0

    rules = tf.Rules(update, divide, variables={"division_threshold": 3.75, "mark": 0.0})
    scene = tf.Scene(rules, tf.Growth(rate=1.0), tf.Division(), dim=2, dt=0.1)
    titles = [e.title for e in scene.bind().effects]
    assert titles == ["rules", "division", "rules at division", "growth"]
    *_, state = tf.simulate(scene, cells=4)
    assert (state.mark == 1).all()


def test_a_daughter_that_is_born_beyond_its_threshold_divides_in_the_next_step():
    division = tf.Division(length=tf.Uniform(4.2, 12.0), fraction=0.8)
    scene = tf.Scene(tf.Growth(rate=1.0), division, dim=2, dt=0.05)
    waited = 0
    state = scene.bind(4).start()
    for _ in range(80):
        due = state.uid[division.due(state)] + 1000 * state.own_colony_id[division.due(state)]
        state = step(scene, state, 0.05)
        here = state.uid + 1000 * state.own_colony_id
        assert not torch.isin(due, here).any()
        waited += len(due)
    assert waited > 5


def test_daughters_are_checked_for_places_outside_the_medium():
    """A run that ends by a division does not hand out cells that have no signal."""
    medium = tf.Medium(a=tf.Signal(diffusion=10.0, source=1.0), box=((-1, -1), (1, 1)), spacing=0.5)
    division = tf.Division(length=4.0, axis_noise=0.0)
    scene = tf.Scene(tf.Growth(rate=1.0), division, tf.Mechanics(dim=2), medium, dt=0.05)
    with pytest.raises(tf.SimulationError, match="beyond the box of the medium"):
        list(tf.simulate(scene, cells=2))


def test_daughters_outside_a_region_are_removed_in_the_step_of_their_birth():
    region = tf.Removal(low=(-1, -1), high=(1, 1))
    division = tf.Division(length=4.0, axis_noise=0.0)
    scene = tf.Scene(tf.Growth(rate=1.0), division, region, dim=2, dt=0.05)
    last = list(tf.simulate(scene, until=1.0))[-1]
    assert last.cells == 0


def test_a_first_value_may_go_by_the_threshold():
    @dataclass(frozen=True, eq=False)
    class Resting(tf.Effect):
        stage, title = 35, "resting"

        def declares(self, dim):
            first = lambda state, rows, values: 0.5 * state.division_threshold[rows]
            return [tf.Field("rest", "of the threshold", "µm", initial=first)]

        def step(self, state, dt, values):
            return state

    state = tf.Scene(Resting(), tf.Division(length=4.0), dim=2).bind().start()
    assert state.rest.tolist() == [2.0]


class SlowDivision(tf.Division):
    """A user's kind of division, by another title."""

    title = "slow division"


def test_division_by_another_title_divides_as_early():
    assert division_times(SlowDivision(length=3.0), 14) == [4, 12]
    stages = [e.stage for e in tf.Scene(tf.Growth(), SlowDivision(length=3.0)).bind().effects]
    assert stages == [tf.effect.GROWTH, tf.effect.DIVISION]


def test_thresholds_by_cell_type_are_inherited():
    """Where types have numbers or inherited draws, each line keeps that of its founder."""
    inherited = tf.Uniform(3.0, 4.5, inherited=True)
    for threshold in (inherited, {0: inherited}, {0: inherited, 1: 3.5}):
        founders = tf.Cells([[0.0, 0.0], [50.0, 0.0]], [[1.0, 0.0]] * 2, 2.0, cell_type=[0, 0])
        division = tf.Division(length=threshold)
        scene = tf.Scene(tf.Growth(rate=1.0), division, founders=founders, dt=0.05)
        *_, state = tf.simulate(scene, until=3.0, seed=1)
        assert state.cells >= 16 and state.division_threshold.unique().numel() == 2


@pytest.mark.parametrize("by_torch", [False, True])
def test_thresholds_are_drawn_as_for_the_type_of_each_cell(by_torch, monkeypatch):
    """By kernels, too, which draw evenly between two numbers that are the same for all cells."""
    pytest.importorskip("numba")
    if by_torch:
        monkeypatch.setattr(compiled_division, "kernels_loaded", lambda value: False)
    laws = {0: tf.Uniform(3.0, 3.5), 1: tf.Uniform(6.0, 6.5)}
    founders = tf.Cells([[0.0, 0.0], [50.0, 0.0]], [[1.0, 0.0]] * 2, 2.0, cell_type=[0, 1])
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=laws), founders=founders, dt=0.05)
    *_, state = tf.simulate(scene, until=2.5)
    assert torch.bincount(state.cell_type).min() >= 4
    over = state.division_threshold - torch.where(state.cell_type == 0, 3.0, 6.0)
    assert over.unique().numel() == state.cells and 0.0 <= over.min() <= over.max() <= 0.5


@pytest.mark.parametrize("conserves", ["length", "volume"])
def test_what_grows_after_a_threshold_counts_as_added_by_the_daughters(conserves):
    """They begin to count at the length that they would have had, had the step ended in time."""
    division = tf.Division(added=1.0, fraction=0.375, conserves=conserves)
    growth = tf.Growth(rate=1.0, law="linear")
    founders = tf.Cells.single(2, length=2.0)
    scene = tf.Scene(growth, division, founders=founders, dt=0.3)
    model = scene.bind(dtype=torch.float64)
    state = model.start()
    for _ in range(4):
        state = model.step(state)
    caps = 1.0 if conserves == "length" else 2.0 / 3.0
    born = lambda length: [share * (length + caps) - caps for share in (0.375, 0.625)]
    assert state.length.tolist() == pytest.approx(born(3.2))
    assert state.birth_length.tolist() == pytest.approx(born(3.0))


def test_no_more_counts_than_the_step_has_grown():
    """As where a rule gives a cell a type whose threshold it has passed long ago."""

    def rise(cells):
        cells.cell_type = torch.where(cells.length > 4.0, 1, 0)

    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, cell_type=[0])
    scene = tf.Scene(
        tf.Rules(rise), tf.Growth(rate=1.0, law="linear"), tf.Division(added={0: 9.0, 1: 0.5}),
        founders=founders, dt=0.3,
    )  # fmt: skip
    *_, state = tf.simulate(scene, until=2.4)
    assert state.cells == 2  # 4.1 µm, and one step later 4.4, of which 0.3 count
    assert state.length.tolist() == pytest.approx([1.7] * 2, rel=1e-5)
    assert state.birth_length.tolist() == pytest.approx([1.7 - 0.15] * 2, rel=1e-5)
