"""Physical values: a number, one per colony, one per cell type, or a distribution drawn at birth,
for every parameter of every effect in the same words."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import pytest
import torch

import torchfilm as tf

TYPES = tf.Cells([[0, 0], [4, 0]], [[1, 0], [1, 0]], 2.0, cell_type=[0, 1])


def decay(u, s, p, cell):
    return {"m": -p.k * u.m}


def grown(scene: tf.Scene, steps: int = 60, **options) -> tf.State:
    model = scene.bind(**options)
    state = model.start()
    for _ in range(steps):
        state = model.step(state, 0.025)
    return state


def of_type(state: tf.State, values: torch.Tensor, kind: int) -> torch.Tensor:
    return values[state.cell_type == kind]


def test_a_growth_rate_for_each_type_follows_the_type():
    """Volumes grow by exp(rate·t); a rule that changes a cell's type changes its rate at once."""

    def switch(cells):
        cells.cell_type = torch.where(torch.full_like(cells.length, cells.time) > 0.49, 1, 0)

    rates = {0: 0.5, 1: 1.5}
    fixed = tf.Scene(tf.Growth(rate=rates), founders=TYPES)
    state = grown(fixed, 20, dtype=torch.float64)
    first = fixed.bind(dtype=torch.float64).start()
    for kind, rate in rates.items():
        ratio = of_type(state, state.volume, kind) / of_type(first, first.volume, kind)
        assert ratio.tolist() == pytest.approx([math.exp(rate * 0.5)], rel=1e-12)
    ruled = tf.Scene(tf.Rules(switch), tf.Growth(rate=rates), founders=TYPES)
    state = grown(ruled, 40, dtype=torch.float64)
    ratio = state.volume / first.volume
    assert ratio.tolist() == pytest.approx([math.exp(0.5 * 0.5 + 1.5 * 0.5)] * 2, rel=1e-12)


def test_a_tuple_that_reads_like_a_range_is_warned_of():
    words = (
        r"Division\.length = \(3\.5, 4\.5\) is one value .*two colonies.*tf\.Uniform\(3\.5, 4\.5\)"
    )
    with pytest.warns(UserWarning, match=words):
        tf.Division(length=(3.5, 4.5))
    for given in ([3.5, 4.5], (4.5, 3.5), (3.5, 4.0, 4.5)):  # as an error would tell
        tf.Division(length=given)


def test_one_value_per_colony_as_list_array_or_tensor_is_one():
    given = [0.5, 1.0, 1.5]
    states = [
        grown(tf.Scene(tf.Growth(rate=rate), tf.Mechanics(dim=2)), 10)
        for rate in (given, torch.tensor(given), torch.tensor(given).numpy(), tf.PerColony(given))
    ]
    assert states[0].colonies == 3
    assert all(torch.equal(s.length, states[0].length) for s in states)


@pytest.mark.parametrize("inherited", [False, True])
def test_a_circuit_constant_may_be_drawn_for_each_cell(inherited):
    """Extrinsic noise: cells of one colony have constants of their own, by the seed alone. They are
    drawn again at each birth, or kept by the daughters."""
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=3.5),
        tf.Mechanics(dim=2),
        tf.Circuit(
            decay, species=("m",), initial={"m": 1.0}, k=tf.LogNormal(0.5, 0.3, inherited=inherited)
        ),
    )
    state, again = (grown(scene, 90, colonies=40, seed=3) for _ in range(2))
    drawn = state.fields["circuit_k"]
    assert torch.equal(drawn, again.fields["circuit_k"]) and state.cells > 120
    first = scene.bind(40, seed=3).start().fields["circuit_k"]
    assert first.log().mean() == pytest.approx(math.log(0.5), abs=3 * 0.3 / 40**0.5)
    kept = drawn == first.index_select(0, state.colony)
    assert bool(kept.all()) if inherited else not bool(kept.any())
    # dm/dt = −k m: what a founder's line has lost shows the constant
    assert float((state.m.log() / state.time).std()) > 0.02


def test_the_draw_has_the_distribution_that_is_given():
    scene = tf.Scene(tf.Growth(rate=tf.LogNormal(1.0, 0.2)), dim=2)
    rates = scene.bind(4000, seed=1).start().growth_rate.double().log()
    # standard errors of mean and standard deviation of 4,000 draws
    assert float(rates.mean()) == pytest.approx(0.0, abs=4 * 0.2 / 4000**0.5)
    assert float(rates.std()) == pytest.approx(0.2, abs=4 * 0.2 / 8000**0.5)


def test_types_may_mix_numbers_and_distributions():
    scene = tf.Scene(
        tf.Growth(rate={0: 0.6, 1: tf.LogNormal(1.2, 0.1)}),
        tf.Division(length={0: 3.0, 1: tf.Uniform(3.5, 4.5)}),
        tf.Mechanics(dim=2),
        founders=TYPES,
    )
    state = grown(scene, 80, colonies=5, seed=2)
    assert set(of_type(state, state.growth_rate, 0).tolist()) == {float(torch.tensor(0.6))}
    assert len(set(of_type(state, state.growth_rate, 1).tolist())) > 5
    assert set(of_type(state, state.division_threshold, 0).tolist()) == {3.0}
    second = of_type(state, state.division_threshold, 1)
    assert 3.5 <= float(second.min()) < float(second.max()) <= 4.5


def test_wall_stiffness_and_viscosity_go_by_type():
    """A cell of a type to which the wall is softer is pressed deeper into it."""
    walls = [
        tf.Plane(y=-0.5, facing="+y", stiffness={0: 4.0, 1: 40.0}),
        tf.Plane(y=0.5, facing="-y"),
    ]
    cells = tf.Cells([[0, 0.1], [9, 0.1]], [[0, 1], [0, 1]], 0.4, cell_type=[0, 1])
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics(dim=2, walls=walls, viscosity={0: 1.0, 1: 1.0}),
        founders=cells,
    )
    state = grown(scene, 10)
    assert float(state.position[0, 1]) < float(state.position[1, 1]) - 0.01


EFFECTS = {
    "Growth.rate": lambda v: [tf.Growth(rate=v)],
    "Division.length": lambda v: [tf.Growth(rate=1.0), tf.Division(length=v)],
    "Mechanics.viscosity": lambda v: [tf.Mechanics(dim=2, viscosity=v)],
    "Circuit.k": lambda v: [tf.Circuit(decay, species=("m",), k=v)],
    "Monod.half": lambda v: [
        tf.Monod("food", half=v),
        tf.Growth(),
        tf.Medium(food=tf.Signal(diffusion=1.0), box=((-8, -8), (8, 8)), spacing=2.0),
    ],
}


@pytest.mark.parametrize("given", [-1.0, "1/h", ["1/h"]])
def test_a_bad_value_is_refused_with_all_the_forms_that_are_allowed(given):
    forms = r"one number, a list .*per colony, a dict by cell type .*, or a distribution"
    with pytest.raises(tf.InputError, match=rf"^Growth\.rate = .*{forms}"):
        tf.Growth(rate=given)
    with pytest.raises(tf.InputError, match=r"^Growth\.rate\[0\] = (?!.*a dict).*distribution"):
        tf.Growth(rate={0: given})


@pytest.mark.parametrize("name", EFFECTS)
def test_the_same_words_for_every_effect(name):
    make = lambda value: tf.Scene(*EFFECTS[name](value), founders=TYPES)
    pattern = re.escape(name)
    with pytest.raises(
        tf.InputError, match=rf"{pattern} has 3 values, but the batch has 4 colonies"
    ):
        make([3.0, 3.1, 3.2]).bind(4)
    # two values for two colonies of two types: either could be meant
    message = (
        rf"{pattern} has 2 values.* 2 colonies and as many cell types.*\{{0: 3, 1: 3\.1\}}.*PerCol"
    )
    with pytest.raises(tf.InputError, match=message):
        make([3.0, 3.1]).bind(2)
    make(tf.PerColony([3.0, 3.1])).bind(2)
    make([3.0, 3.1]).bind(2, per_colony=True)
    make({0: 3.0, 1: 3.1}).bind(2)
    make(tf.LogNormal(3.0, 0.01)).bind(2)
    with pytest.raises(
        tf.InputError, match=rf"{pattern} has values for the cell types 0, 5, but a cell"
    ):
        grown(make({0: 3.0, 5: 3.1}), 2, colonies=2)
    with pytest.raises(tf.InputError, match=rf"{pattern}, cell type = 'a' is not allowed"):
        make({"a": 1.0})
    with pytest.raises(tf.InputError, match=rf"{pattern}\[1\]\[0\] = nan|{pattern}\[1\] = nan"):
        make({0: 3.0, 1: math.nan})


def test_what_belongs_to_a_colony_has_no_type_and_no_distribution():
    with pytest.raises(
        tf.InputError, match=r"Signal\.diffusion.*one value per cell type has no mean"
    ):
        tf.Signal(diffusion={0: 1.0, 1: 2.0})
    with pytest.raises(
        tf.InputError, match=r"molecules_per_unit.*a distribution over cells has no"
    ):
        tf.Circuit(decay, species=("m",), molecules_per_unit=tf.LogNormal(1.0, 0.1), k=1.0)


def test_a_bound_model_keeps_its_values():
    """A tensor that is changed in place after binding changes the next binding, not this one."""
    rate = torch.tensor([1.0, 2.0])
    scene = tf.Scene(tf.Growth(rate=rate), dim=2)
    model = scene.bind()
    before = model.step(model.start()).length
    rate.mul_(3.0)
    assert torch.equal(model.step(model.start()).length, before)
    again = scene.bind()
    assert bool((again.step(again.start()).length > before).all())


@dataclass(frozen=True, eq=False)
class Ageing(tf.Effect):
    """Notes the rates of the cells, looked up by rows."""

    rate: tf.Value = tf.physical(1.0)
    title: str = "age"  # type: ignore[misc]
    stage = 35

    def step(self, state, dt, values):
        rows = torch.arange(state.cells, device=state.device)
        assert torch.equal(values.rate.of_rows(state, rows), values.rate.of_cells(state))
        return state


def test_a_kept_value_is_looked_up_by_rows_too():
    grown(tf.Scene(Ageing(tf.LogNormal(1.0, 0.3)), founders=TYPES), 2)


def test_effects_of_one_class_draw_apart_and_keep_apart():
    """Effects of one title would share one field; with titles of their own they share nothing."""
    one, two = tf.Uniform(1.0, 2.0), tf.Uniform(11.0, 12.0)
    with pytest.raises(tf.InputError, match=r"age is listed twice.*'age_rate'.*title of its own"):
        tf.Scene(Ageing(one), Ageing(two), founders=TYPES)
    state = tf.Scene(Ageing(one), Ageing(two, "second"), founders=TYPES).bind(20).start()
    first, second = state.fields["age_rate"], state.fields["second_rate"] - 10.0
    assert float(second.min()) >= 1.0 and float(second.max()) <= 2.0
    assert float((first - second).abs().min()) > 1e-4
    named = tf.Circuit(decay, species=("m",), name="a", k=one)
    other = tf.Circuit(decay, species=("m",), k=1.0, a_k=two)
    with pytest.raises(tf.InputError, match=r"a_k of circuit.*'circuit_a_k', which circuit a has"):
        tf.Scene(named, other, founders=TYPES)


def test_types_inherit_alike_and_in_any_order():
    drawn, kept = tf.LogNormal(1.0, 0.3), tf.LogNormal(1.0, 0.3, inherited=True)
    with pytest.raises(tf.InputError, match=r"Growth\.rate = \{0: .* must be inherited for all"):
        tf.Growth(rate={0: kept, 1: drawn})
    assert tf.Growth(rate={0: kept, 1: kept, 2: 1.0}).rate.is_drawn
    assert tf.Growth(rate={1: 0.5, 0: 1.0}) == tf.Growth(rate={0: 1.0, 1: 0.5})
    assert tf.Growth(rate={np.int64(0): 1.0}) == tf.Growth(rate={0: 1.0})
    rates = {np.int64(1): decay}
    assert tf.Circuit(rates, species=("m",), k=1.0) == tf.Circuit({1: decay}, species=("m",), k=1.0)


def test_a_drawn_value_has_the_gradient_of_its_distribution():
    low = torch.tensor(1.0, requires_grad=True)
    for given in (tf.Uniform(low, 2.0), {0: tf.Uniform(low, 2.0), 1: 1.0}):
        values = tf.Scene(Ageing(given), founders=TYPES).bind().effects[0].values
        assert values.rate.requires_grad and values.requires_grad
    values = tf.Scene(Ageing(tf.Uniform(1.0, 2.0)), founders=TYPES).bind().effects[0].values
    assert not values.requires_grad


def test_constants_are_needed_where_the_circuit_runs():
    """Cells of a type without reactions need no constants."""

    def made(u, s, p, cell):
        return {"m": p.k}

    scene = tf.Scene(tf.Circuit({1: made}, species=("m",), k={1: 1.0}), founders=TYPES)
    state = grown(scene, 4)
    assert state.m.tolist() == pytest.approx([0.0, 0.1])


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.vmap])
def test_values_in_a_transform_of_torch_func_are_refused(transform):
    """Whatever they are for; torch's own words do not say why."""
    for make in (
        lambda x: tf.Growth(rate=x),
        lambda x: tf.Mechanics(dim=2, viscosity=x),
        lambda x: tf.Circuit(lambda u, s, p, cell: {"m": p.k - u.m}, species=("m",), k=x),
        lambda x: tf.Signal(diffusion=x),
        lambda x: tf.Growth(rate={0: 1.0, 1: x}),
        lambda x: tf.Division(length=tf.Uniform(x, 4.0)),
    ):
        with pytest.raises(tf.InputError, match=r"in a transform of torch.func.*tf.tangents"):
            transform(make)(torch.tensor([2.0, 3.0]))


@pytest.mark.parametrize("bad", [0.5, "no", 1, None])
def test_inherited_is_true_or_false(bad):
    with pytest.raises(tf.InputError, match=r"Uniform\.inherited = .* True or False"):
        tf.Uniform(1.0, 1.1, inherited=bad)
    if isinstance(bad, (int, float)):
        return  # the share of a Normal
    with pytest.raises(tf.InputError, match=r"Normal\.inherited"):
        tf.Normal(1.0, 0.1, inherited=bad)
