"""Values that a rule gives during a run and that no effect can use: they fail their colony, and the
others go on as if they were alone."""

from __future__ import annotations

import math
import random
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import step
from ruled import pair_of_cells, run, same

import torchfilm as tf
from torchfilm.loop import failures

BAD = 1  # the colony whose rule goes wrong, in its second step


def gone_wrong(name, value):
    """A rule that gives the first cell of one colony a wrong value from 0.05 h on."""

    def update(cells):
        here = (cells.colony == BAD) & (cells.uid == 0) & (cells.time > 0.05)
        old = getattr(cells, name)
        setattr(cells, name, torch.where(here, torch.full_like(old, value), old))
        cells.remove_flag = here

    return update


def made(u, s, p, cell):
    return {"m": 1.0 - u.m}


TYPED = tf.Growth(rate={0: 1.0, 1: 0.5})
CASES = {
    "a negative rate": ("growth_rate", -1.0, tf.Growth(), r"set to -1: it must be at least 0"),
    "a rate that is NaN": ("growth_rate", math.nan, tf.Growth(), r"set to nan: .*at least 0"),
    "no drag": ("drag", 0.0, tf.Mechanics(dim=2), r"set to 0: it must be above 0"),
    "a drag that is NaN": ("drag", math.nan, tf.Mechanics(dim=2), "set to nan: .*above 0"),
    "a concentration that is NaN": (
        "m",
        math.nan,
        tf.Circuit(made, species=("m",)),
        "set to nan: it must be a number",
    ),
    "a threshold that is NaN": (
        "division_threshold",
        math.nan,
        tf.Division(length=4.0),
        "set to nan: it must be a number",
    ),
    "a type without a rate": (
        "cell_type",
        2,
        TYPED,
        r"set to 2, but Growth\.rate has values for the cell types 0, 1\. Add 2: … to it",
    ),
    "a type below 0": ("cell_type", -1, TYPED, "set to -1: it must be a whole number from 0"),
    "a type without a drawn constant": (
        "cell_type",
        2,
        tf.Circuit(lambda u, s, p, cell: {"m": p.k}, species=("m",), k={0: tf.Uniform(1.0, 2.0)}),
        r"set to 2, but Circuit\.k has values for the cell types 0\. Add 2",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_value_that_nothing_can_use_fails_its_colony_only(case):
    name, value, effect, words = CASES[case]
    founders = pair_of_cells()
    founders = tf.Cells(founders.position, founders.axis, cell_type=[0, 0])
    scene = tf.Scene(tf.Rules(gone_wrong(name, value)), effect, dim=2, founders=founders)
    if name == "drag":
        scene = scene.replace(*scene.effects, tf.Growth(rate=0.5))
    with pytest.raises(
        tf.SimulationError,
        match=rf"failed in 1 of 3 colonies:\s+colony {BAD} \(2 cells\): cells\.{name} of cell 0 was"
        rf" {words}",
    ) as failed:
        list(tf.simulate(scene, colonies=3, until=0.3, dt=0.1))
    assert failed.value.colonies == (BAD,)
    *_, dropped = tf.simulate(scene, colonies=3, until=0.3, dt=0.1, on_failure="drop")
    assert dropped.counts.tolist() == [2, 0, 2]
    alone = run(scene, scene.bind(3).start().select([0, 2]), 3)
    assert same(dropped.select([0, 2]), alone.select([0, 1]))


def test_in_a_colony_that_failed_the_rule_changes_nothing():
    """Not even what it was allowed to change, and it removes no cell there."""

    def update(cells):
        cells.growth_rate = torch.where(cells.colony == BAD, -1.0, 2.0)
        cells.remove_flag = cells.uid == 0

    scene = tf.Scene(tf.Rules(update), tf.Growth(), founders=pair_of_cells())
    state = step(scene, scene.bind(2).start(), 0.1)
    assert state.counts.tolist() == [1, 2] and state.growth_rate.tolist() == [2.0, 0.0, 0.0]
    (failure,) = failures(state)
    assert failure.place == BAD and "and 1 more cell(s)" in failure.reason


def test_values_of_daughters_fail_their_colony_only():
    def divide(parent, daughter1, daughter2):
        daughter1.growth_rate = torch.where(daughter1.colony == BAD, -2.0, 3.0)
        daughter2.growth_rate = torch.where(daughter2.colony == 2, math.nan, 4.0)

    scene = tf.Scene(
        tf.Rules(divide=divide), tf.Growth(rate=1.0), tf.Division(), founders=pair_of_cells()
    )
    state = scene.bind(4).start()
    state = step(scene, state.with_fields(divide_flag=torch.ones(8, dtype=torch.bool)), 0.0)
    assert state.growth_rate.reshape(4, 4).tolist() == [
        [3.0, 4.0, 3.0, 4.0],
        [1.0] * 4,
        [1.0] * 4,
        [3.0, 4.0, 3.0, 4.0],
    ]
    found = {f.colony_id: f.reason for f in failures(state)}
    assert set(found) == {1, 2} and "set to -2" in found[1] and "set to nan" in found[2]


def test_several_rules_may_fail_in_one_step():
    def rule(colony):
        def update(cells):
            bad = (cells.colony == colony) & (cells.time > 0.05)
            cells.growth_rate = torch.where(bad, -1.0 - colony, cells.growth_rate)

        return tf.Rules(update)

    scene = tf.Scene(rule(0), rule(2), tf.Growth(rate=1.0), founders=pair_of_cells())
    state = run(scene, scene.bind(3).start(), 2)
    assert {f.colony_id for f in failures(state)} == {0, 2}


def test_a_nan_in_a_variable_of_the_users_own_is_allowed():
    """Only the user knows what it means there, such as "not yet"."""

    def update(cells):
        cells.since = math.nan if cells.time > 0.05 else 0.0

    scene = tf.Scene(tf.Rules(update, variables={"since": 0.0}), founders=pair_of_cells())
    state = run(scene, scene.bind().start(), 2)
    assert bool(state.since.isnan().all()) and not failures(state)


def test_what_a_rule_has_only_read_is_not_its_fault():
    def update(cells):
        cells.seen = cells.growth_rate * 2.0

    scene = tf.Scene(
        tf.Rules(update, variables={"seen": 0.0}), tf.Growth(), founders=pair_of_cells()
    )
    state = scene.bind().start()
    state = step(scene, state.with_fields(growth_rate=torch.tensor([math.nan, 1.0])), 0.1)
    assert [f.reason.split()[0] for f in failures(state)] == ["cell"]  # growth's own report


def test_a_wrong_shape_in_mid_run_is_an_error_of_the_step():
    def update(cells):
        cells.growth_rate = torch.ones(1 if cells.time < 0.05 else 3)

    scene = tf.Scene(tf.Rules(update), tf.Growth(), founders=pair_of_cells())
    with pytest.raises(tf.InputError, match=r"cells\.growth_rate was set to a tensor of shape"):
        list(tf.simulate(scene, colonies=2, until=0.3, dt=0.1, on_failure="drop"))


@pytest.mark.parametrize("circuit", [{0: made}, {0: made, 1: made}])
def test_a_type_in_which_no_circuit_runs_is_no_fault(circuit):
    """Constants by type are for the cells in which the circuit runs."""
    rates = {k: (lambda u, s, p, cell: {"m": p.k}) for k in circuit}
    effect = tf.Circuit(rates, species=("m",), k={k: 1.0 + k for k in circuit})
    founders = pair_of_cells()
    scene = tf.Scene(
        tf.Rules(lambda cells: setattr(cells, "cell_type", 7)),
        effect,
        founders=tf.Cells(founders.position, founders.axis, cell_type=[0, 0]),
    )
    state = run(scene, scene.bind().start(), 2)
    assert state.cell_type.tolist() == [7, 7] and not failures(state)


def growing(*effects, **options) -> tf.Scene:
    return tf.Scene(*effects, tf.Mechanics(dim=2), founders=tf.Cells.single(2), **options)


@pytest.mark.parametrize(
    "name, effect, others",
    [
        ("growth_rate", "tf.Growth()", [tf.Division(length=4.0)]),
        ("divide_flag", "tf.Division()", [tf.Growth(rate=1.0)]),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_a_field_that_only_an_effect_acts_on_is_no_variable(name, effect, others):
    rule = lambda cells: setattr(cells, name, 1.0)
    with pytest.raises(tf.InputError, match=rf"cells\.{name} acts only with {re.escape(effect)}"):
        growing(*others, tf.Rules(rule)).bind()
    with pytest.raises(tf.InputError, match=rf"Rules\.variables: {name}.*{re.escape(effect)}"):
        tf.Rules(rule, variables={name: 0.0})


def make(u, s, p, cell):
    return {"gfp": 1.0 - u.gfp}


def test_a_negative_concentration_from_a_rule_is_named():
    def spoil(cells):
        cells.gfp = torch.where(cells.length > 2.5, -1.0, cells.gfp)

    scene = growing(tf.Growth(rate=1.0), tf.Rules(spoil), tf.Circuit(make, species="gfp"))
    with pytest.raises(tf.SimulationError, match=r"cells\.gfp of cell 0 was set to -1.*at least 0"):
        *_, _ = tf.simulate(scene, until=1.0)


@pytest.mark.parametrize(
    "draw",
    [
        lambda n: torch.rand(n),
        lambda n: float(np.random.rand()),  # noqa: NPY002
        lambda n: random.random(),
    ],
)
def test_random_numbers_that_no_seed_sets_are_warned_of(draw):
    def wild(cells):
        cells.growth_rate = draw(len(cells.length))

    def keyed(cells):
        cells.growth_rate = cells.random()

    with pytest.warns(UserWarning, match=r"draws random numbers.*Use cells\.random\(\)"):
        growing(tf.Growth(), tf.Rules(wild)).bind()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        growing(tf.Growth(), tf.Rules(keyed)).bind()


def test_an_error_in_a_rule_has_its_line():
    def pulse(cells):
        cells.growth_rate = torch.where(cells.time > 1, 0.0, 1.0)

    def wrong(cells):
        cells.growth_rate = torch.exp("much")

    here = rf"{re.escape(Path(__file__).name)}, line \d+ \(cells\.growth_rate = torch"
    for rule, words in (
        (pulse, here + r"\.where.*\): torch\.where wants a column.*if cells\.time > 1 else"),
        (wrong, here + r"\.exp.*\): TypeError: "),
        (lambda: None, r"rule .*<lambda>: TypeError: .*takes 0 positional arguments"),
    ):
        with pytest.raises(tf.InputError, match=words):
            growing(tf.Growth(), tf.Rules(rule)).bind()


class Stop(tf.SimulationError):
    pass


@pytest.mark.parametrize("error", [Stop("enough"), RuntimeError("")])
def test_an_error_that_a_rule_raises_on_purpose_stays_what_it_is(error):
    def stops(cells):
        raise error

    with pytest.raises(type(error)) as caught:
        growing(tf.Growth(rate=1.0), tf.Rules(stops)).bind()
    assert caught.value is error


def test_errors_without_words_and_in_what_a_rule_calls():
    def silent(cells):
        raise ValueError

    def wrong(cells):
        cells.growth_rate = cells.colony_max(torch.zeros(3, 4, 5))

    with pytest.raises(tf.InputError, match=r"line \d+ \(raise ValueError\): ValueError$"):
        growing(tf.Growth(), tf.Rules(silent)).bind()
    with pytest.raises((tf.InputError, RuntimeError)) as caught:
        growing(tf.Growth(), tf.Rules(wrong)).bind()
    assert "ragged.py" not in str(caught.value)


@pytest.mark.parametrize("number", [0.02, -1.0, math.nan, 2])
@pytest.mark.parametrize("flag", ["remove_flag", "divide_flag"])
def test_a_flag_is_true_or_false_and_no_probability(flag, number):
    """Any number but 0 would count as True, for all cells."""

    def update(cells):
        setattr(cells, flag, number)

    def one_by_one(cells):
        for cell in cells:
            setattr(cell, flag, number)

    for rule in (update, one_by_one):
        scene = growing(tf.Rules(rule), tf.Division(length=4.0))
        with pytest.raises(
            tf.InputError, match=rf"{flag} is True or False.*cells\.chance\(0\.02\)"
        ):
            scene.bind().start()


@pytest.mark.parametrize(
    ("name", "hint"),
    [("remove", r"Did you mean 'remove_flag'\? Give"), ("take", "itself. Give a variable of your")],
)
def test_a_name_of_the_state_is_no_variable(name, hint):
    def one_by_one(cells):
        for cell in cells:
            setattr(cell, name, True)

    for rule in (lambda cells: setattr(cells, name, cells.length > 3), one_by_one):
        with pytest.raises(tf.InputError, match=rf"cells\.{name} cannot be set: the state.*{hint}"):
            growing(tf.Rules(rule)).bind().start()


def test_a_colony_counts_the_cells_of_a_condition():
    seen = {}

    def update(cells):
        seen["lit"] = cells.colony_sum(cells.cell_type == 1)
        seen["types"] = cells.colony_sum(cells.cell_type)
        seen["all"] = cells.colony_sum(1)
        seen["any"] = cells.colony_max(cells.cell_type == 1)

    cells = tf.Cells(
        [[0.0, 0.0], [5.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 3, cell_type=[1, 1, 0],
        colony=[0, 0, 1],
    )  # fmt: skip
    scene = tf.Scene(tf.Rules(update), founders=cells)
    step(scene, scene.bind().start(), 0.1)
    assert {n: x.tolist() for n, x in seen.items()} == {
        "lit": [2, 2, 0], "types": [2, 2, 0], "all": [2, 2, 1], "any": [1, 1, 0],
    }  # fmt: skip
    wrong = tf.Scene(tf.Rules(lambda cells: cells.colony_sum(cells.position)), founders=cells)
    with pytest.raises(tf.InputError, match=r"colony_sum was given a tensor of shape .*\(\d+,\)"):
        wrong.bind().start()


@pytest.mark.parametrize("ask", ["max", "mean", "sum"])
def test_a_rule_that_mixes_colonies_is_told_of(ask):
    """A colony would grow otherwise beside others. Of one colony nothing is mixed."""

    def all_cells(cells):
        cells.growth_rate = 0.1 * cells.length / getattr(cells.length, ask)()

    scene = tf.Scene(tf.Rules(all_cells), tf.Growth(), dim=2)
    with pytest.warns(UserWarning, match=r"all_cells: what it sets, growth_rate, depends on the"):
        scene.bind(2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene.bind(1)


def test_rules_for_each_colony_mix_nothing():
    """Also with random numbers, flags, and a number that counts the calls."""
    calls = []

    def own(cells):
        calls.append(1)
        share = cells.length / cells.colony_max(cells.length)
        cells.growth_rate = share * (cells.random() < 0.5)
        cells.remove_flag = cells.colony_sum(cells.length) > 1000.0
        cells.called = cells.length * 0 + len(calls)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tf.Scene(tf.Rules(own), tf.Growth(), dim=2).bind(3)


def test_a_cell_of_a_loop_draws_numbers_of_its_own_whatever_the_batch():
    def update(cells):
        for cell in cells:
            cell.drawn = cell.random()
            if cell.chance(0.3):
                cell.hits += 1
            cell.kept = cell.binomial(5, 0.5)
            assert cell.dt == cells.dt

    variables = {"drawn": 0.0, "hits": 0, "kept": 0}
    scene = growing(tf.Rules(update, variables=variables), tf.Growth(rate=1.0))
    *_, many = tf.simulate(scene, until=1.0, dt=0.02, colonies=30, seed=4)
    *_, one = tf.simulate(scene, until=1.0, dt=0.02, colonies=1, seed=4)
    for name in variables:
        assert torch.equal(one.fields[name], many.fields[name][many.colony == 0])
    assert many.drawn.unique().numel() == many.cells
    # 50 steps of probability 0.3, and means of 5 halves: each within four standard errors
    assert (many.hits.double().mean() - 15).abs() < 4 * math.sqrt(50 * 0.21 / many.cells)
    assert (many.kept.double().mean() - 2.5).abs() < 4 * math.sqrt(1.25 / many.cells)


def test_what_is_of_all_cells_is_not_asked_of_one():
    def update(cells):
        for cell in cells:
            cell.contact_count()

    with pytest.raises(tf.InputError, match=r"cells\.contact_count\(…\) outside the loop"):
        growing(tf.Rules(update)).bind().start()


def test_numbers_that_a_rule_sets_have_the_precision_of_the_state():
    """In float64 they were those of float32: a rate of 1.1 was 1.1 + 2.4e-8."""

    def update(cells):
        cells.growth_rate = 1.1
        cells.level = cells.length * 0.0 + 0.1
        cells.since = cells.time
        cells.divide_flag = cells.length > 2.05

    def divide(parent, d1, d2):
        d1.level, d2.level = 0.1, 0.7

    rules = tf.Rules(update, divide, variables={"level": 0.0, "since": 0.0})
    scene = tf.Scene(tf.Growth(), tf.Division(), rules, dim=2, dt=0.1)
    state = tf.simulate(scene, until=0.3, dtype=torch.float64).last()
    assert set(state.growth_rate.tolist()) == {1.1} and state.cells == 2
    assert state.since.tolist() == pytest.approx([0.2, 0.2], abs=1e-12)
    assert set(state.level.tolist()) <= {0.1, 0.7}


def test_numbers_among_columns_have_the_type_of_the_state():
    """A sum of 1 over the cells of a colony is in float32 where they are."""

    def update(cells):
        cells.level = cells.colony_sum(1.0)
        seen.append(cells.colony_sum(1.0).dtype)

    seen: list[torch.dtype] = []
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Rules(update, variables={"level": 0.0}), dim=2, dt=0.1)
    for dtype in (torch.float32, torch.float64):
        tf.simulate(scene, until=0.1, dtype=dtype).last()
    assert seen[0] == torch.float32 and seen[-1] == torch.float64
