"""Cells that a rule gives another type have the values of that type; and what rules draw."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

import torchfilm as tf
from torchfilm.rule_draws import Draws

ONE = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], cell_type=[0])
EIGHT = tf.Cells(
    [[6.0 * k, 0.0] for k in range(8)], [[1.0, 0.0]] * 8, length=3.9, cell_type=[0] * 8
)


def to_one(parent, daughter1, daughter2):
    """The first daughters become of type 1."""
    daughter1.cell_type = torch.ones_like(parent.cell_type)


def divided(*effects: tf.Effect, founders: tf.Cells = EIGHT) -> tf.State:
    scene = tf.Scene(*effects, tf.Mechanics(dim=2), founders=founders)
    model = scene.bind()
    return model.step(model.start(), 0.1)


@pytest.mark.parametrize("inherited", [False, True])
def test_drawn_growth_follows_a_type_given_at_birth(inherited):
    law = lambda mean: tf.Uniform(mean, mean + 0.1, inherited=inherited)
    state = divided(
        tf.Rules(None, to_one), tf.Growth(rate={0: law(1.0), 1: law(2.0)}), tf.Division(length=4.0)
    )
    mutant = state.cell_type == 1
    assert state.cells == 16 and int(mutant.sum()) == 8
    rate = state.growth_rate
    assert bool(((rate[mutant] >= 2.0) & (rate[mutant] <= 2.1)).all())
    assert bool(((rate[~mutant] >= 1.0) & (rate[~mutant] <= 1.1)).all())
    assert len(rate[mutant].unique()) == 8, "each mutant draws its own"


@pytest.mark.parametrize("criterion", ["length", "added"])
def test_a_threshold_by_type_follows_a_type_given_at_birth(criterion):
    limits = {0: 4.0, 1: 6.0} if criterion == "length" else {0: 0.1, 1: 2.0}
    state = divided(tf.Rules(None, to_one), tf.Growth(rate=1.0), tf.Division(**{criterion: limits}))
    wanted = torch.tensor([limits[int(k)] for k in state.cell_type])
    assert state.cells == 16 and torch.equal(state.division_threshold, wanted)


def test_values_by_type_follow_a_type_given_in_a_step():
    def older(cells):
        cells.cell_type = 1 if cells.time >= 0.05 else cells.cell_type

    def made(u, s, p, cell):
        return {"gfp": p.make + 0.0 * u.gfp}

    circuit = tf.Circuit(made, species="gfp", make={0: tf.Uniform(1.0, 2.0), 1: 5.0})
    scene = tf.Scene(
        tf.Rules(older), tf.Growth(rate=0.1), circuit, tf.Division(length={0: 4.0, 1: 6.0}),
        tf.Mechanics(dim=2), founders=ONE,
    )  # fmt: skip
    model = scene.bind(3)
    first = model.step(model.start(), 0.1)
    assert first.division_threshold.tolist() == [4.0] * 3
    assert bool((first.circuit_make < 2.0).all()) and len(first.circuit_make.unique()) == 3
    second = model.step(first, 0.1)
    assert second.cell_type.tolist() == [1] * 3
    assert second.division_threshold.tolist() == [6.0] * 3
    assert second.circuit_make.tolist() == [5.0] * 3
    kept = second.with_fields(division_threshold=torch.full((3,), 7.0))
    assert model.step(kept, 0.1).division_threshold.tolist() == [7.0] * 3, "no other change"


def test_what_the_same_rule_sets_stands():
    def mutate(parent, daughter1, daughter2):
        daughter1.cell_type = torch.ones_like(parent.cell_type)
        daughter1.growth_rate = torch.full_like(parent.growth_rate, 0.25)

    state = divided(
        tf.Rules(None, mutate),
        tf.Growth(rate={0: tf.Uniform(1.0, 1.1), 1: tf.Uniform(2.0, 2.1)}),
        tf.Division(length=4.0),
    )
    assert state.growth_rate[state.cell_type == 1].tolist() == [0.25] * 8


def test_what_a_rule_only_reads_is_not_set_by_it():
    def mutate(cells):
        cells.cell_type = torch.where(cells.growth_rate < 1.5, 1, cells.cell_type)
        cells.seen = cells.growth_rate + cells.division_threshold

    def one_by_one(cells):
        for cell in cells:
            if cell.growth_rate < 1.5 and cell.division_threshold < 5.0:
                cell.cell_type = 1

    for rule in (mutate, one_by_one):
        scene = tf.Scene(
            tf.Rules(rule, variables={"seen": 0.0}),
            tf.Growth(rate={0: tf.Uniform(1.0, 1.1), 1: tf.Uniform(2.0, 2.1)}),
            tf.Division(length={0: 4.0, 1: 8.0}), dim=2, founders=ONE,
        )  # fmt: skip
        model = scene.bind()
        state = model.step(model.start(), 0.1)
        assert state.cell_type.tolist() == [1] and state.division_threshold.tolist() == [8.0]
        assert 2.0 <= float(state.growth_rate) <= 2.1


def test_what_a_rule_sets_in_one_daughter_does_not_count_for_the_other():
    def mutate(parent, daughter1, daughter2):
        daughter1.growth_rate = torch.full_like(parent.growth_rate, 0.25)
        daughter2.cell_type = torch.ones_like(parent.cell_type)

    state = divided(
        tf.Rules(None, mutate),
        tf.Growth(rate={0: tf.Uniform(1.0, 1.1), 1: tf.Uniform(2.0, 2.1)}),
        tf.Division(length=4.0),
    )
    mutant = state.cell_type == 1
    assert state.growth_rate[~mutant].tolist() == [0.25] * 8
    assert bool((state.growth_rate[mutant] >= 2.0).all())


# --- draws -------------------------------------------------------------------------------


def test_chance_and_binomial_follow_their_laws():
    seen = []

    def draw(cells):
        seen.append((cells.chance(0.3), cells.binomial(20, 0.25), cells.chance(0.3)))
        cells.mark = seen[-1][1]

    many = tf.Cells([[9.0 * k, 0.0] for k in range(4000)], [[0.0, 1.0]] * 4000)
    model = tf.Scene(tf.Rules(draw, variables={"mark": 0.0}), dim=2, founders=many).bind()
    seen.clear()
    model.step(model.start(), 0.1)
    chance, count, other = seen[-1]
    assert chance.dtype == torch.bool and not torch.equal(chance, other)
    # five standard errors
    assert float(chance.double().mean()) == pytest.approx(0.3, abs=5 * (0.21 / 4000) ** 0.5)
    assert float(count.mean()) == pytest.approx(5.0, abs=5 * (3.75 / 4000) ** 0.5)
    assert float(count.var()) == pytest.approx(3.75, rel=0.2)
    assert torch.equal(count, count.round()) and float(count.max()) <= 20


@pytest.mark.parametrize("last, expected", [(2.0**-24, 1.0), (0.5, 0.0)])
def test_rare_events_of_a_binomial_occur(monkeypatch, last, expected):
    """One of 2·10⁷: 23 random bits end before it."""
    draws = itertools.cycle([1 - 2.0**-24, 1 - last])  # the first bits of a number, and the last
    each = lambda self: torch.full((self._state.cells,), next(draws), dtype=torch.float64)
    monkeypatch.setattr(Draws, "random", each)

    cells_seen = []

    def draw(cells):
        cells.mark = found = cells.binomial(1, 5e-8)
        cells_seen.append(found.dtype)

    rules = tf.Rules(draw, variables={"mark": 0.0})
    model = tf.Scene(rules, dim=2, founders=tf.Cells.single(2)).bind()
    assert model.step(model.start(), 0.1).mark.tolist() == [expected]
    assert cells_seen[-1] == torch.float32


def test_normal_and_poisson_follow_their_laws():
    seen = {}

    def draw(cells):
        seen["normal"], seen["few"] = cells.normal(), cells.poisson(0.2)
        seen["many"], seen["again"] = cells.poisson(torch.full((4000,), 90.0)), cells.normal()
        cells.mark = seen["few"]

    many = tf.Cells([[9.0 * k, 0.0] for k in range(4000)], [[0.0, 1.0]] * 4000)
    model = tf.Scene(tf.Rules(draw, variables={"mark": 0.0}), dim=2, founders=many).bind()
    model.step(model.start(), 0.1)
    expected = {  # mean, variance, fourth central moment
        "normal": (0.0, 1.0, 3.0),
        "again": (0.0, 1.0, 3.0),
        "few": (0.2, 0.2, 0.2 + 3 * 0.04),
        "many": (90.0, 90.0, 90.0 + 3 * 8100.0),
    }
    for name, (mean, variance, fourth) in expected.items():
        x = seen[name].double()
        assert x.shape == (4000,)
        # five standard errors, of the mean and of the variance
        assert float(x.mean()) == pytest.approx(mean, abs=5 * (variance / 4000) ** 0.5)
        error = ((fourth - variance**2) / 4000) ** 0.5
        assert float(x.var()) == pytest.approx(variance, abs=5 * error)
    both = torch.stack([seen["normal"], seen["again"]]).double()
    assert abs(float(torch.corrcoef(both)[0, 1])) < 5 / 4000**0.5
    assert torch.equal(seen["many"], seen["many"].round())


def test_an_inherited_trait_spreads_as_a_random_walk():
    def inherit(parent, daughter1, daughter2):
        for daughter in (daughter1, daughter2):
            daughter.trait = parent.trait + 0.1 * daughter.normal()

    scene = tf.Scene(
        tf.Rules(None, inherit, variables={"trait": 0.0}),
        tf.Growth(rate=math.log(2.0)), tf.Division(length=4.0), dim=2,
    )  # fmt: skip
    *_, last = tf.simulate(scene, colonies=40, until=6.0, dt=0.1, seed=3)
    *_, alone = tf.simulate(scene, streams=[7], until=6.0, dt=0.1, seed=3)
    assert torch.equal(last.trait[last.colony == 7], alone.trait)
    generations = round(math.log2(last.cells / 40))
    assert last.cells == 40 * 2**generations and generations >= 5
    # cells of one colony share ancestors: the variance is over one cell of each, by the χ² law
    one = torch.stack([last.trait[last.colony == c][0] for c in range(40)]).double()
    ratio = float(one.square().mean()) / (generations * 0.01)
    assert abs(ratio - 1) < 5 * (2 / 40) ** 0.5
    assert len(last.trait.unique()) == last.cells


def test_rates_that_are_inherited_in_part():
    """The recipe of docs/rules.md: mother and daughter correlate by c, sisters by c²."""
    c, pairs = 0.6, []

    def inherit(parent, daughter1, daughter2):
        for daughter in (daughter1, daughter2):
            pull = c * (parent.growth_rate - 1.0)
            noise = 0.1 * (1 - c**2) ** 0.5 * daughter.normal()
            daughter.growth_rate = 1.0 + pull + noise
        pairs.append([parent.growth_rate, daughter1.growth_rate, daughter2.growth_rate])

    many = tf.Cells([[9.0 * k, 0.0] for k in range(3000)], [[0.0, 1.0]] * 3000, length=3.9)
    scene = tf.Scene(
        tf.Rules(None, inherit), tf.Growth(rate=tf.Normal(1.0, 0.1)), tf.Division(length=4.0),
        dim=2, founders=many,
    )  # fmt: skip
    *_, last = tf.simulate(scene, until=0.1)
    assert last.cells == 6000
    mother, one, two = (torch.cat(x).double() for x in zip(*pairs[1:], strict=True))
    error = 5 / 3000**0.5
    assert float(torch.corrcoef(torch.stack([mother, one]))[0, 1]) == pytest.approx(c, abs=error)
    assert float(torch.corrcoef(torch.stack([one, two]))[0, 1]) == pytest.approx(c * c, abs=error)
    for x in (mother, one, two):
        assert float(x.std()) == pytest.approx(0.1, rel=error)


def test_plasmids_go_to_one_daughter_or_the_other():
    def part(parent, daughter1, daughter2):
        k = parent.binomial(parent.plasmids, 0.5)
        daughter1.plasmids, daughter2.plasmids = k, parent.plasmids - k

    scene = tf.Scene(
        tf.Rules(None, part, variables={"plasmids": 20.0}), tf.Growth(rate=1.0),
        tf.Division(length=4.0), tf.Mechanics(dim=2),
    )  # fmt: skip
    *_, state = tf.simulate(scene, cells=16, colonies=3, seed=4)
    *_, alone = tf.simulate(scene, cells=16, streams=[1], seed=4)
    assert [float(state.plasmids[state.colony == c].sum()) for c in range(3)] == [20.0] * 3
    assert len(state.plasmids.unique()) > 2
    assert torch.equal(state.plasmids[state.colony == 1], alone.plasmids)


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        (lambda c: c.chance(1.5), "the probability 1.5: it must be between 0 and 1"),
        (lambda c: c.chance(float("nan")), "the probability nan"),
        (
            lambda c: c.poisson(-1.0),
            "poisson was given the mean -1: it must be finite, and 0 or more",
        ),
        (lambda c: c.poisson(float("inf")), "poisson was given the mean inf"),
        (lambda c: c.binomial(2.5, 0.5), "the number 2.5: it must be whole, 0 or more"),
        (lambda c: c.binomial(3, torch.ones(7)), r"shape \(7,\): it must be one value, or \(1,\)"),
        (lambda c: c.contacts(-1.0), r"contacts\(within\) = -1.0 is not allowed"),
        (lambda c: c.lenght, "Did you mean 'length'?"),
        (lambda c: setattr(c, "cell_type", 0.5), "cell_type takes whole numbers, and got 0.5.$"),
    ],
)
def test_what_rules_ask_for_wrongly(rule, words):
    with pytest.raises(tf.InputError, match=words):
        tf.Scene(tf.Rules(rule), tf.Growth(rate=1.0), dim=2, founders=ONE).bind()


def test_draws_of_torch_at_division_are_warned_of():
    def part(parent, daughter1, daughter2):
        daughter1.mark = torch.rand(len(parent.mark))

    with pytest.warns(UserWarning, match="another run with the same seed has other numbers"):
        tf.Scene(
            tf.Rules(None, part, variables={"mark": 0.0}), tf.Growth(rate=1.0),
            tf.Division(length=4.0), dim=2,
        ).bind()  # fmt: skip


def test_new_names_at_division_say_where_they_begin():
    def named(name):
        return lambda parent, one, two: setattr(one, name, 1)

    for name, words in (
        ("mark", r"give Rules\(…, variables=\{'mark': 0.0\}\)"),
        ("cell_type", r"founders=tf.Cells\(…, cell_type=\[0\]\)"),
    ):
        with pytest.raises(tf.InputError, match=words):
            tf.Scene(
                tf.Rules(None, named(name)), tf.Growth(rate=1.0), tf.Division(length=4.0), dim=2
            ).bind()


def test_colonies_without_first_cells_are_warned_of():
    two = tf.Cells([[0.0, 0.0]] * 2, [[1.0, 0.0]] * 2, colony=[0, 1])
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2, founders=two)
    with pytest.warns(UserWarning, match="colonies 2, 3 of 4 stay empty"):
        scene.bind(4)


def test_rare_events_happen():
    """One in ten million cells: a uniform draw of 23 bits alone is never below 6e-8."""
    from torchfilm.rule_draws import Draws
    from torchfilm.tools.random import BITS

    class Least(Draws):
        """The first draw is the least one, the second one in the middle."""

        def __init__(self, second):
            self.given = iter([torch.tensor([0.5 * 2.0**-BITS]), torch.tensor([second])])

        def random(self):
            return next(self.given)

    assert bool(Least(0.1).chance(5e-8)) and not bool(Least(0.9).chance(5e-8))


def test_two_rules_draw_numbers_of_their_own():
    def one(parent, daughter1, daughter2):
        daughter1.x = daughter1.random()

    def other(parent, daughter1, daughter2):
        daughter1.y = daughter1.random()

    state = divided(
        tf.Rules(None, one, variables={"x": 0.0}), tf.Rules(None, other, variables={"y": 0.0}),
        tf.Growth(rate=1.0), tf.Division(length=4.0),
    )  # fmt: skip
    drawn = state.x > 0
    assert int(drawn.sum()) == 8 and not bool((state.x == state.y)[drawn].any())


def test_rules_of_one_name_draw_numbers_of_their_own():
    """As functions made by one function do, in `update` and in `divide`."""

    def made(name):
        def rule(cells, *daughters):
            for cell in daughters or (cells,):
                setattr(cell, name, cell.random())

        return rule

    many = tf.Cells([[9.0 * k, 0.0] for k in range(50)], [[0.0, 1.0]] * 50, length=3.9)
    for rules in (
        [tf.Rules(made(n), variables={n: 0.0}) for n in "xyz"],
        [tf.Rules(None, made(n), variables={n: 0.0}) for n in "xyz"],
    ):
        scene = tf.Scene(*rules, tf.Growth(rate=1.0), tf.Division(length=4.0), dim=2, founders=many)
        *_, state = tf.simulate(scene, until=0.1)
        drawn = torch.stack([state.x, state.y, state.z])[:, state.parent >= 0]
        assert drawn.shape[1] == 100 and len(drawn.unique()) == 300


def test_signals_can_only_be_read():
    def eats(cells):
        cells.mark = cells.signals.food * 1.0
        cells.signals.food.mul_(0.0)

    medium = tf.Medium(
        food=tf.Signal(diffusion=1.0, initial=1.0), box=[[-9, -9], [9, 9]], spacing=3.0, depth=1.0
    )
    with pytest.raises(tf.InputError, match=r"changed cells\.signals\.food in place"):
        tf.Scene(tf.Rules(eats, variables={"mark": 0.0}), medium, dim=2).bind()


def test_a_type_below_0_fails_its_colony():
    def mutate(cells):
        cells.cell_type = torch.where((cells.colony == 1) & (cells.length > 3.0), -2, 0)

    one = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, cell_type=[0])
    scene = tf.Scene(tf.Rules(mutate), tf.Growth(rate=1.0), tf.Division(), founders=one, dim=2)
    with pytest.raises(tf.SimulationError, match=r"colony 1.*set to -2: .* a whole number from 0"):
        for _ in tf.simulate(scene, until=1.0, colonies=2):
            pass
