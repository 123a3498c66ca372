"""Growth: the three laws against their closed forms, rates per colony and per cell, gradients."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass

import pytest
import torch
from helpers import seeded, step

import torchfilm as tf
from torchfilm.physics import capsule


def one_cell(length: float = 2.0, radius: float = 0.5) -> tf.Cells:
    return tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], length, radius)


def grown(scene: tf.Scene, state: tf.State, steps: int, dt: float) -> tf.State:
    for _ in range(steps):
        state = step(scene, state, dt)
    return state


def rounding(dtype: torch.dtype, steps: int) -> float:
    """Relative error of `steps` steps: each rounds rate·dt, its exponential, a product and a sum,
    half an ulp each."""
    return 2 * steps * torch.finfo(dtype).eps


def scene_of(rate, law: str, founder: tf.Cells | None = None, *more: tf.Effect) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=rate, law=law),
        *more,
        founders=founder if founder is not None else one_cell(),
    )


# --- closed forms ---------------------------------------------------------------------------------


def test_length_law_is_exponential(device, dtype):
    scene = scene_of(1.3, "length")
    state = grown(scene, seeded(scene, one_cell(), device, dtype), 40, 0.025)
    assert float(state.length) == pytest.approx(2.0 * math.exp(1.3), rel=rounding(dtype, 40))


def test_volume_doubles_in_ln2_over_rate_whatever_the_shape(device, dtype):
    cells = tf.Cells(
        [[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]], [[1.0, 0.0]] * 3, [0.0, 1.0, 4.0], [0.5, 0.25, 1.0]
    )
    scene = scene_of(0.7, "volume", cells)
    first = seeded(scene, cells, device, dtype)
    last = grown(scene, first, 50, math.log(2) / 0.7 / 50)
    assert torch.allclose(
        last.volume / first.volume,
        torch.full_like(first.volume, 2.0),
        rtol=rounding(dtype, 50),
        atol=0,
    )


def test_linear_law_adds_rate_times_time(device, dtype):
    scene = scene_of(0.8, "linear")
    state = grown(scene, seeded(scene, one_cell(), device, dtype), 40, 0.025)
    assert float(state.length) == pytest.approx(2.8, rel=rounding(dtype, 40))


@pytest.mark.parametrize("law", ["volume", "length", "linear"])
def test_a_hundred_steps_equal_one(law, device, dtype):
    scene = scene_of(1.0, law)
    first = seeded(scene, one_cell(), device, dtype)
    many, one = grown(scene, first, 100, 0.01), grown(scene, first, 1, 1.0)
    assert float(many.length) == pytest.approx(float(one.length), rel=rounding(dtype, 100))


def test_volume_law_and_length_law_differ_by_the_caps():
    """With l = 2, r = ½ the volume law lengthens by e^g(l + 4r/3) − 4r/3: more than e^g·l."""
    by_volume = grown(
        scene := scene_of(1.0, "volume"), scene.bind(dtype=torch.float64).start(), 1, 1.0
    )
    by_length = grown(
        scene := scene_of(1.0, "length"), scene.bind(dtype=torch.float64).start(), 1, 1.0
    )
    assert float(by_volume.length) == pytest.approx(math.e * (2 + 2 / 3) - 2 / 3, rel=1e-14)
    assert float(by_length.length) == pytest.approx(math.e * 2, rel=1e-14)


@pytest.mark.parametrize("law", ["volume", "length", "linear"])
@pytest.mark.parametrize("contacts", ["bilateral", "one-sided"])
def test_an_isolated_cell_grows_the_same_with_mechanics(law, contacts, dtype):
    """Nothing touches it, so the solve must leave it alone; base + elongation may round once more a
    step."""
    free, held = (
        scene_of(1.0, law),
        scene_of(1.0, law, one_cell(), tf.Mechanics(dim=2, contacts=contacts)),
    )
    a, b = (grown(s, s.bind(dtype=dtype).start(), 40, 0.025) for s in (free, held))
    assert float(b.length) == pytest.approx(float(a.length), rel=rounding(dtype, 40))
    assert torch.equal(a.position, b.position) and torch.equal(a.axis, b.axis)


def test_elongation_is_what_was_added():
    scene = scene_of(1.0, "volume")
    first = scene.bind(dtype=torch.float64).start()
    second = step(scene, first, 0.1)
    assert torch.equal(second.length, first.length + second.elongation)
    assert float(second.elongation) > 0


# --- rates ----------------------------------------------------------------------------------------


def test_a_rate_for_each_colony(device, dtype):
    rates = [0.5, 1.0, 2.0]
    scene = scene_of(rates, "length")
    state = grown(scene, scene.bind(3, device=device, dtype=dtype).start(), 20, 0.05)
    wanted = torch.tensor([2 * math.exp(g) for g in rates], dtype=dtype, device=device)
    assert torch.allclose(state.length, wanted, rtol=rounding(dtype, 20), atol=0)


def test_rates_follow_their_colony_through_a_selection():
    scene = scene_of(torch.tensor([0.5, 1.0, 2.0]), "length")
    whole = scene.bind(3).start()
    part = grown(scene, whole.select([2, 0]), 4, 0.25)
    whole = grown(scene, whole, 4, 0.25)
    assert torch.equal(part.length, whole.length[[2, 0]])


def test_without_a_rate_cells_rest_until_told():
    scene = scene_of(None, "volume")
    state = scene.bind().start()
    assert torch.equal(step(scene, state, 1.0).length, state.length)
    told = step(scene, state.with_fields(growth_rate=torch.ones(1)), 1.0)
    assert float(told.length) > float(state.length)


def test_rates_of_single_cells_may_come_with_the_cells():
    cells = tf.Cells(
        [[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, 2.0, extra={"growth_rate": [0.0, 1.0]}
    )
    scene = tf.Scene(tf.Growth(law="length"), founders=cells)
    state = step(scene, scene.bind(dtype=torch.float64).start(), 1.0)
    assert state.length.tolist() == pytest.approx([2.0, 2 * math.e], rel=1e-14)


def test_drawn_rates_cover_their_range_and_belong_to_cells():
    scene = scene_of(tf.Uniform(0.5, 1.5), "volume")
    rate = scene.bind(2000, dtype=torch.float64).start().growth_rate
    assert ((rate > 0.5) & (rate < 1.5)).all()
    # mean 1, sd 1/√12: four standard errors of 2000 draws
    assert float(rate.mean()) == pytest.approx(1.0, abs=4 / math.sqrt(12 * 2000))
    assert float(rate.std()) == pytest.approx(1 / math.sqrt(12), rel=0.06)
    assert torch.equal(scene.bind(3, dtype=torch.float64).start().growth_rate, rate[:3]), (
        "a draw depends on the batch"
    )
    assert not torch.equal(
        scene.bind(3, seed=1, dtype=torch.float64).start().growth_rate, rate[:3]
    ), "a draw ignores the seed"


def flagged(scene: tf.Scene, colonies: int) -> tf.State:
    state = scene.bind(colonies, dtype=torch.float64).start()
    return state.with_fields(divide_flag=torch.ones(state.cells, dtype=torch.bool))


def test_drawn_rates_are_drawn_anew_at_birth():
    scene = scene_of(tf.Uniform(0.5, 1.5), "volume", one_cell(), tf.Division())
    state = flagged(scene, 200)
    parents = state.growth_rate
    first, second = step(scene, state, 0.01).growth_rate.reshape(200, 2).T
    assert (first != parents).all() and (second != parents).all() and (first != second).all()
    # independent of one another: |correlation| of 200 pairs is below 0.3 but for one chance in 10⁴
    for a, b in ((first, second), (parents, first)):
        assert abs(float(torch.corrcoef(torch.stack([a, b]))[0, 1])) < 0.3


def test_a_given_rate_is_inherited():
    scene = scene_of([0.5, 2.0], "volume", one_cell(), tf.Division())
    assert step(scene, flagged(scene, 2), 0.01).growth_rate.tolist() == [0.5, 0.5, 2.0, 2.0]


@pytest.mark.parametrize("distribution", [tf.Normal(1.0, 0.1), tf.LogNormal(1.0, 0.1)])
def test_other_distributions(distribution):
    """Both have mean ≈ 1 and sd ≈ 0.1 (the log-normal's are 1.005 and 0.1008)."""
    rate = scene_of(distribution, "volume").bind(2000, dtype=torch.float64).start().growth_rate
    assert float(rate.mean()) == pytest.approx(1.0025, abs=0.0025 + 4 * 0.1 / math.sqrt(2000))
    assert float(rate.std()) == pytest.approx(0.1, rel=4 / math.sqrt(2 * 2000) + 0.01)
    assert (
        float(rate.min()) >= distribution.least() and float(rate.max()) <= distribution.greatest()
    )


# --- gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["volume", "length", "linear"])
def test_gradient_of_length_with_respect_to_rate(law):
    """dl/dg = t·l by length, t·(l + 4r/3) by volume, t by the linear law."""
    rate = torch.tensor(0.9, dtype=torch.float64, requires_grad=True)
    scene = scene_of(rate, law)
    state = grown(scene, scene.bind(dtype=torch.float64).start(), 40, 0.025)
    (slope,) = torch.autograd.grad(state.length.sum(), rate)
    length = float(state.length.detach())
    wanted = {"length": length, "volume": length + 2 / 3, "linear": 1.0}[law]
    assert float(slope) == pytest.approx(wanted, rel=1e-12)


def test_gradient_of_each_colony_is_its_own():
    rate = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64, requires_grad=True)
    scene = scene_of(rate, "length")
    state = grown(scene, scene.bind(3, dtype=torch.float64).start(), 4, 0.25)
    (slope,) = torch.autograd.grad(state.length[1], rate)
    assert slope.tolist() == pytest.approx([0.0, float(state.length[1].detach()), 0.0], rel=1e-12)


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "rate",
    [
        -1.0,
        math.nan,
        math.inf,
        "fast",
        True,
        [[1.0]],
        [1.0, math.nan],
        [1.0, -1.0],
        tf.Uniform(-0.5, 1.0),
    ],
)
def test_bad_rates_are_refused(rate):
    with pytest.raises(tf.InputError, match=r"Growth\.rate"):
        tf.Growth(rate=rate)


@pytest.mark.parametrize(
    ("rate", "name"),
    [
        (60.0, "Growth.rate"),
        ([0.5, 60.0], "Growth.rate"),
        ({0: 0.5, 1: 60.0}, "Growth.rate of cell type 1"),
        ({0: 0.5, 1: tf.Uniform(60.0, 70.0)}, "Growth.rate of cell type 1"),
    ],
)
def test_a_step_in_which_the_fastest_cell_more_than_doubles_is_refused(rate, name):
    cells = tf.Cells([[0.0, 0.0], [0.0, 3.0]], [1.0, 0.0], cell_type=[0, 1])
    founders = cells if isinstance(rate, dict) else one_cell()
    scene = scene_of(rate, "volume", founders, tf.Division(length=3.0))
    for run in (tf.simulate, tf.rollout):
        with pytest.raises(tf.InputError, match=rf"too long for {name} = 60/h"):
            run(scene, until=0.05)


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        ([0.5, 60.0, 1.0], r"Growth\.rate = 60/h in colony 1: a cell"),
        (
            [60.0, 1.0, 70.0],
            r"Growth\.rate = 70/h in colony 2 \(too fast in 2 of 3 colonies: 0, 2\): a cell",
        ),
        ({0: 0.5, 1: [1.0, 60.0, 2.0]}, r"Growth\.rate of cell type 1 = 60/h in colony 1: a cell"),
        (tf.PerColony([60.0, 1.0, 1.0]), r"Growth\.rate = 60/h in colony 0: a cell"),
        (60.0, r"Growth\.rate = 60/h: a cell"),
    ],
)
def test_a_step_that_is_too_long_names_the_colonies(rate, words):
    scene = scene_of(rate, "volume", one_cell(), tf.Division(length=3.0))
    with pytest.raises(tf.InputError, match=words):
        tf.simulate(scene, until=0.05)


def test_the_tail_of_a_distribution_may_be_too_fast_for_the_step():
    scene = scene_of(tf.Uniform(1.0, 60.0), "volume", one_cell(), tf.Division(length=3.0))
    scene.bind().check_step(scene.dt)


def test_a_rate_is_warned_of_only_where_a_doubling_takes_half_a_day():
    with pytest.warns(UserWarning, match=r"0\.04 per hour: a doubling takes 17 h.*\(2\.4\)"):
        next(tf.simulate(scene_of(0.04, "volume"), until=0.1))
    for rate, law in ((0.06, "volume"), (0.0, "volume"), (0.04, "linear")):
        next(tf.simulate(scene_of(rate, law), until=0.1))


def test_linear_growth_is_not_refused_as_too_fast_a_doubling():
    scene_of(60.0, "linear", one_cell(), tf.Division(length=3.0)).bind().check_step(0.05)


def test_growth_that_fails_in_one_colony_goes_on_in_others():
    scene = scene_of([1.0, 5000.0], "volume")
    state = scene.bind(2).start()
    after = step(scene, state, 0.5)
    assert after.reports["growth"].status.tolist() == [0, 1]
    assert float(after.length[0]) > float(state.length[0])
    assert after.length[1] == state.length[1] and after.elongation[1] == 0.0


def test_a_rule_may_not_set_the_rate_where_it_goes_by_type():
    def update(cells):
        cells.growth_rate = 2.1

    cells = tf.Cells([[0.0, 0.0], [0.0, 3.0]], [1.0, 0.0], cell_type=[0, 1])
    scene = scene_of({0: 1.0, 1: 0.5}, "volume", cells, tf.Rules(update))
    with pytest.raises(tf.InputError, match=r"sets growth_rate, but Growth\.rate = .*cell_type"):
        scene.bind()
    one_rate = scene_of(1.0, "volume", cells, tf.Rules(update))
    with pytest.warns(UserWarning, match=r"Growth\.rate and rules each set growth_rate"):
        model = one_rate.bind()
    state = step(one_rate, model.start(), 0.1)
    assert state.growth_rate.tolist() == pytest.approx([2.1, 2.1])


@dataclass(frozen=True)
class Slowing(tf.Effect):
    """Sets the growth rate; `reads_it`: from what it was."""

    reads_it: bool = False
    stage, title = 15, "slowing"

    def reads(self):
        return ("growth_rate",) if self.reads_it else ()

    def writes(self):
        return ("growth_rate",)

    def step(self, state, dt, values):
        return state.with_fields(growth_rate=0.5 * state.growth_rate)


def setting(cells):
    cells.growth_rate = 2.1


def halving(cells):
    cells.growth_rate = 0.5 * cells.growth_rate


@pytest.mark.parametrize(
    "rate, other, words",
    [
        (1.0, Slowing(), r"Growth\.rate and slowing.*such as Growth\(\) without a rate.*reads\(\)"),
        (tf.Uniform(0.5, 1.0), tf.Rules(setting), r"Growth\.rate and rules each set growth_rate"),
        (None, Slowing(), ""),
        (None, tf.Rules(setting), ""),
        (0.0, tf.Rules(setting), ""),
        (1.0, Slowing(reads_it=True), ""),
        (1.0, tf.Rules(halving), ""),
    ],
)
def test_a_rate_that_another_effect_overrides_is_warned_of(rate, other, words):
    scene = scene_of(rate, "volume", None, other)
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        scene.bind()
    said = [str(w.message) for w in given]
    assert len(said) == (1 if words else 0) and all(re.search(words, text) for text in said), said


def test_two_effects_that_set_the_rate_are_warned_of():
    scene = scene_of(None, "volume", None, tf.Rules(setting), Slowing())
    with pytest.warns(UserWarning, match="^rules and slowing each set growth_rate"):
        scene.bind()


def test_unknown_law_is_refused():
    with pytest.raises(tf.InputError, match=r"Growth\.law.*'volume'"):
        tf.Growth(rate=1.0, law="logistic")


def test_volume_helper_agrees_with_the_model():
    """V = π r² (l + 4r/3) for l = 2, r = ½."""
    assert float(capsule.volume(torch.tensor(2.0), torch.tensor(0.5))) == pytest.approx(
        math.pi * 0.25 * (2 + 2 / 3), rel=1e-6
    )


def test_a_wide_normal_is_refused_with_what_to_do():
    with pytest.raises(
        tf.InputError, match=r"smallest value of Growth\.rate.* mean − 4 sd.*LogNor"
    ):
        tf.Growth(rate=tf.Normal(1.0, 0.6))


@pytest.mark.parametrize(
    "rate, warned",
    [(2.0, True), (None, False), (tf.LogNormal(1.0, 0.1), False), (tf.PerColony([1.0, 2.0]), True)],
)
def test_a_rate_that_the_first_cells_override_is_warned_of(rate, warned):
    """Theirs is copied to daughters, but drawn anew where each cell draws one."""
    cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, extra={"growth_rate": [0.5]})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tf.Scene(tf.Growth(rate=rate), founders=cells, dim=2)
    assert any("has no effect: the first cells have" in str(w.message) for w in caught) == warned


# --- a factor -------------------------------------------------------------------------------------


def slowed(cells):
    cells.vigour = torch.where(cells.cell_type == 1, 0.5, 1.0)


VIGOUR = tf.Rules(slowed, variables={"vigour": 1.0})


def pair(*effects: tf.Effect) -> tf.Scene:
    cells = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, cell_type=[0, 1])
    return tf.Scene(*effects, founders=cells)


@pytest.mark.parametrize("rate", [1.2, {0: 1.2, 1: 0.8}, tf.Uniform(1.1, 1.3)])
@pytest.mark.parametrize("contacts", [True, False])
def test_a_factor_multiplies_the_rate(rate, contacts):
    more = [tf.Mechanics(dim=2)] if contacts else []
    rules = tf.Rules(slowed, variables={"vigour": 1.0})
    model = pair(tf.Growth(rate=rate, factor="vigour"), rules, *more).bind(dtype=torch.float64)
    first = state = model.start()
    for _ in range(40):
        state = model.step(state)
    kept = model.step(model.start()).growth_rate  # a rate by type is there from the first step on
    expected = (kept * torch.tensor([1.0, 0.5])).exp()
    assert torch.allclose(state.volume / first.volume, expected, rtol=1e-9)
    assert torch.equal(state.growth_rate, kept)


def test_a_circuit_stops_growth():
    """Of cells that have a toxin: exp(−t) of the rate is left after t hours, so ln V grows by
    1 − exp(−t)."""
    rates = lambda u, s, p, cell: {"left": -u.left}
    circuit = tf.Circuit(rates, species="left", initial={"left": 1.0}, dilution=False)
    scene = tf.Scene(tf.Growth(rate=1.0, factor="left"), circuit, founders=one_cell(), dt=0.01)
    *_, end = tf.simulate(scene, until=2.0)
    first = scene.bind().start()
    gained = math.log(float(end.volume) / float(first.volume))
    assert gained == pytest.approx(1 - math.exp(-2.0), rel=0.01)


def eaten() -> list[tf.Effect]:
    food = tf.Signal(diffusion=1e3, initial=1.0)
    return [tf.Monod("food"), tf.Medium(food=food, box=((-16, -16), (16, 16)), spacing=4.0)]


def still() -> tf.Scene:
    cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], extra={"v": [0.0]})
    return tf.Scene(tf.Growth(rate=1.0, factor="v"), tf.Division(length=4.0), founders=cells)


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (
            lambda: pair(tf.Growth(factor="vigour"), VIGOUR, *eaten()).bind(),
            r"Growth.factor = 'vigour' would let them grow by less.*tf.Monod\(…, factor='vigour'\)",
        ),
        (lambda: next(iter(tf.simulate(still(), cells=4))), r"waits for 'v', .*a factor above 0"),
        (lambda: tf.Growth(rate=1.0, factor=2.0), r"Growth.factor = 2.0 .*name of a variable"),
        (
            lambda: tf.Growth(species="a", factor="b"),
            r"Growth.factor = 'b' .*left out with species",
        ),
        (
            lambda: pair(tf.Growth(rate=1.0, factor="vigor")).bind().start(),
            r"growth needs the field 'vigor', which nothing in this scene provides",
        ),
        (
            lambda: (
                pair(
                    tf.Growth(rate=1.0, factor="vigour"),
                    tf.Rules(slowed, variables={"vigour": -1.0}),
                )
                .bind()
                .start()
            ),
            r"Growth.factor: vigour of a first cell is below 0",
        ),
    ],
)
def test_a_factor_that_is_refused(build, said):
    with pytest.raises(tf.InputError, match=said):
        build()
