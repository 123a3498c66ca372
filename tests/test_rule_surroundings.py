"""What rules see around a cell: its colony, its neighbours, its film; and hints at their names."""

from __future__ import annotations

import functools

import pytest
import torch

import torchfilm as tf
from torchfilm.rule_views import CellsView
from torchfilm.tools.checks import InputError


@pytest.fixture(scope="module")
def state():
    """Two colonies of touching cells, one larger than the other, and an empty one between them."""
    scene = tf.Scene(
        tf.Growth(rate=[1.0, 1.0, 0.8]), tf.Division(length=3.5), tf.Mechanics(dim=2), dt=0.05
    )
    *_, grown = tf.simulate(scene, until=4.0, colonies=3, seed=3)
    return grown.remove(grown.colony == 1, "removed")


def seen(state):
    return CellsView(state, 0.05, "rule")


def test_sums_over_touching_cells_are_those_of_all_pairs(state):
    value = torch.rand(state.cells, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    cells = seen(state)
    found = cells.contact_sum(value, within=0.1)
    expected = torch.zeros_like(value)
    for i, j in zip(*cells.contacts(0.1), strict=True):
        expected[i] += value[j]
        expected[j] += value[i]
    torch.testing.assert_close(found, expected)
    some = value > 0.5
    counted = cells.contact_sum(some, 0.1)
    assert counted.max() >= 2 and not torch.equal(counted, cells.contact_count(0.1).to(counted))
    both = counted + cells.contact_sum(~some, 0.1)
    assert torch.equal(both, cells.contact_count(0.1).to(both))


def test_derivatives_pass_through_what_neighbours_give(state):
    value = torch.ones(state.cells, dtype=torch.float64, requires_grad=True)
    cells = seen(state)
    (cells.contact_sum(value) * torch.arange(state.cells)).sum().backward()
    assert torch.equal(value.grad, cells.contact_sum(torch.arange(state.cells)))


def test_means_are_of_the_own_colony(state):
    cells = seen(state)
    found = cells.colony_mean(cells.length)
    for colony in (0, 2):
        mine = state.colony == colony
        assert found[mine].unique().numel() == 1
        torch.testing.assert_close(found[mine][0], state.length[mine].mean())
    share = cells.colony_mean(cells.y > 0)
    assert share.min() > 0.2 and share.max() < 0.8


def test_places_and_depth_are_those_of_measures(state):
    cells = seen(state)
    assert torch.equal(cells.x, state.position[:, 0]) and torch.equal(cells.y, state.position[:, 1])
    across = {"x": (-20.0, 20.0)}
    below = tf.measure.below_top(state, 0.5, floor=-3.0, across=across)
    found = cells.below_top(0.5, floor=-3.0, across=across)
    assert found.dtype == state.dtype
    torch.testing.assert_close(found, below.to(found))
    below = cells.below_edge()
    assert below.dtype == state.dtype
    torch.testing.assert_close(below, tf.measure.below_edge(state).to(below))
    one = next(iter(cells))
    assert one.x == state.position[0, 0]


def scene(update, divide=None, **parameters):
    rules = tf.Rules(update, divide, parameters=parameters, variables={"seen": 0.0})
    return tf.Scene(rules, tf.Growth(rate=1.0), tf.Division(length=3.5), dim=2, dt=0.05)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("colony_men", "Did you mean 'colony_mean'"),
        ("remove", "Did you mean 'remove_flag'"),
        ("contact_sums", "Did you mean 'contact_sum'"),
        ("counts", "Did you mean 'count'"),
    ],
)
def test_hints_know_methods_and_flags(name, hint):
    with pytest.raises(InputError, match=hint):
        scene(lambda cells: getattr(cells, name)).bind()


def test_a_plane_has_no_third_coordinate():
    with pytest.raises(InputError, match="cells have no 'z'"):
        scene(lambda cells: cells.z).bind()


def helped(cells):
    return cells.p.kill


def test_constants_that_no_rule_reads_are_warned_of():
    def update(cells):
        cells.seen = cells.p.fast + cells.x.to(cells.length.dtype)

    with pytest.warns(
        UserWarning, match=r"'kill' of parameters is read by no rule.*cells\.p\.kill"
    ):
        scene(update, fast=1.0, kill=3.0).bind()


def test_constants_are_read_in_branches_helpers_and_by_their_texts():
    def late(cells):
        if cells.time > 2:  # not in the trial
            cells.seen = cells.p.kill * cells.length

    def by_text(cells):
        cells.seen = cells.p["kill"] + 0.0 * cells.length

    def through_another(cells):
        cells.seen = helped(cells) + 0.0 * cells.length

    def divide(parent, one, other):
        one.seen = parent.p.kill

    class Callable:
        def __call__(self, cells):
            cells.seen = getattr(cells.p, "ki" + "ll")

    for update, at_division in (
        (late, None), (by_text, None), (through_another, None), (None, divide), (Callable(), None)
    ):  # fmt: skip
        scene(update, at_division, kill=3.0).bind()  # without a warning


class Reader:
    """Reads constants where no code tells it."""

    def kill(self, cells):
        return cells.p.kill


READER, NAMES = Reader(), ("kill",)


def test_no_alarm_where_nobody_can_tell():
    def by_method(cells):
        cells.seen = READER.kill(cells) + 0.0 * cells.length

    def by_names(cells):
        for name in NAMES:
            cells.seen = cells.p[name] + 0.0 * cells.length

    def by_getattr(cells):
        cells.seen = getattr(cells.p, f"k{'ill'}") + 0.0 * cells.length

    def as_one(cells):
        constants = cells.p
        cells.seen = constants["ki" + "ll"[:2]] + 0.0 * cells.length

    def over_all(cells):
        cells.seen = sum(cells.p[n] for n in cells.p) + 0.0 * cells.length

    def nested(cells):
        def inner():
            return cells.p.kill

        cells.seen = inner() + 0.0 * cells.length

    inside = lambda cells: cells.p.kill

    def closed_over(cells):
        cells.seen = inside(cells) + 0.0 * cells.length

    def by_default(cells, read=helped):
        cells.seen = read(cells) + 0.0 * cells.length

    for update in (by_method, by_names, by_getattr, as_one, over_all, nested, closed_over,
                   by_default, functools.partial(by_method)):  # fmt: skip
        scene(update, kill=3.0).bind()  # without a warning


def test_places_can_only_be_read():
    def push(cells):
        cells.x = cells.x + 1.0

    def push_one(cells):
        for cell in cells:
            cell.y = 1.0

    for update in (push, push_one):
        with pytest.raises(InputError, match=r"cells\.[xy] can only be read"):
            scene(update).bind()
    own = tf.Rules(push, variables={"x": 2.0})  # a variable of one's own
    base = scene(None, lambda parent, one, other: setattr(one, "seen", parent.x))
    state = tf.Scene(own, tf.Growth(rate=1.0), dim=2, dt=0.05).bind().start()
    assert float(state.x[0]) == 2.0
    *_, state = tf.simulate(base, until=1.5)
    assert state.cells > 1


def test_what_rules_ask_of_neighbours_is_read():
    """So that rules that move or resize cells come before."""

    def count(cells):
        cells.seen = cells.contact_sum(cells.colony > -1)

    def deep(cells):
        cells.seen = cells.below_top(across={"x": (-9.0, 9.0)})

    for update in (count, deep):
        model = scene(update).bind()
        (rules,) = (e for e in model.effects if e.title == "rules")
        assert {"position", "axis", "length", "radius"} <= set(rules.reads())


def test_distances_are_finite(state):
    for within in (-1.0, float("inf"), float("nan"), "near"):
        with pytest.raises(InputError, match=r"contacts\(within\)"):
            seen(state).contacts(within)


# --- draws of pairs -------------------------------------------------------------------------------


def test_draws_of_contacts_are_keyed_by_both_cells(state):
    one, other = seen(state), seen(state)
    i, j = one.contacts(0.1)
    found = one.contact_random(i, j)
    assert found.dtype == torch.float64 and len(i) > 50
    assert ((found > 0) & (found < 1)).all() and len(found.unique()) == len(found)
    assert abs(float(found.mean()) - 0.5) < 4 / (12 * len(i)) ** 0.5
    flipped = torch.arange(len(i)).flip(0)
    assert torch.equal(other.contact_random(i[flipped], j[flipped]), found[flipped])
    assert not (one.contact_random(i, j) == found).any()  # each call gives new ones
    assert not (seen(state).contact_random(j, i) == found).any()


def test_draws_of_contacts_do_not_depend_on_the_batch(state):
    every, alone = seen(state), seen(state.select([2]))
    i, j = every.contacts(0.1)
    last = state.colony[i] == 2
    first = int((state.colony < 2).sum())
    k, m = alone.contacts(0.1)
    assert torch.equal(torch.stack([k, m]), torch.stack([i, j])[:, last] - first)
    assert torch.equal(every.contact_random(i, j)[last], alone.contact_random(k, m))


def test_contacts_of_one_cell_draw_for_themselves():
    """Of a donor between two recipients, in 1,000 colonies: one draw for each cell would give to
    both or to none."""
    cells = tf.Cells([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0]], [[1.0, 0.0]] * 3, 3.0)
    many = seen(tf.Scene(tf.Growth(), founders=cells, dim=2).bind(1000).start())
    i, j = many.contacts(0.05)
    assert len(i) == 2000
    colony = many._state.colony[i[many.contact_random(i, j) < 0.5]]
    both = torch.bincount(torch.bincount(colony, minlength=1000))
    assert (both - torch.tensor([250, 500, 250])).abs().max() < 60  # 4 standard deviations


def test_pairs_that_draw_are_places_of_cells(state):
    cells = seen(state)
    i, j = cells.contacts(0.1)
    with pytest.raises(tf.InputError, match=r"contact_random\(j\)"):
        cells.contact_random(i, j.double())
    for one, other in ((i, j[:3]), (i[0], j[0])):
        with pytest.raises(InputError, match=r"it takes pairs, \(P,\) each"):
            cells.contact_random(one, other)
    for place in (-1, state.cells):
        with pytest.raises(tf.InputError, match=r"contact_random\(i, j\)"):
            cells.contact_random(i, torch.full_like(j, place))


def test_draws_of_contacts_have_46_bits_of_their_own(state):
    """The fine part is no copy of the coarse one, nor what `random` gives."""
    cells = seen(state)
    i, j = cells.contacts(0.1)
    found = cells.contact_random(i, j)
    coarse = (found * 2**23).floor() / 2**23
    fine = (found - coarse) * 2**23
    assert len(fine.unique()) == len(fine)
    assert abs(float(torch.corrcoef(torch.stack([coarse, fine]))[0, 1])) < 4 / len(i) ** 0.5
    other = seen(state).random().double()
    assert not torch.isin((coarse * 2**23).long(), (other * 2**23).long()).any()


def test_contacts_are_looked_for_once_and_a_rule_may_change_its_own(state, monkeypatch):
    from torchfilm import rule_surroundings

    looked, search = [], rule_surroundings.pairs_within
    monkeypatch.setattr(
        rule_surroundings, "pairs_within", lambda *a: (looked.append(a[-2]), search(*a))[1]
    )
    cells = seen(state)
    i, j = cells.contacts(0.1)
    i.zero_(), j.zero_()
    counted = cells.contact_count(0.1)
    assert looked == [0.1] and counted.sum() == 2 * len(i)
    cells.contact_sum(state.length, 0.1), cells.contact_count(0.2)
    assert looked == [0.1, 0.2]


# --- events ---------------------------------------------------------------------------------------


def test_events_happen_at_their_rate(state):
    many = seen(tf.Scene(tf.Growth(), founders=tf.Cells.single(2), dim=2).bind(20000).start())
    found = many.event(torch.tensor([0.0, 4.0]).repeat(10000))
    assert found.dtype == torch.bool and not found[::2].any()
    share = 1 - 2.718281828 ** (-4.0 * 0.05)
    assert abs(float(found[1::2].double().mean()) - share) < 4 * (share / 10000) ** 0.5
    assert not many.event(0.0).any() and many.event(1e6).all()


def test_rare_events_keep_their_rate(monkeypatch):
    """1 − exp(−x) of single precision is 0 below 3e-8, and twice too large just above."""
    from torchfilm import rule_draws

    cells = seen(tf.Scene(tf.Growth(), founders=tf.Cells.single(2), dim=2).bind().start())
    for rate in (2e-7, 1e-6):
        for share, expected in ((0.99, True), (1.01, False)):
            drawn = torch.tensor([share * rate * 0.05], dtype=torch.float64)
            monkeypatch.setattr(rule_draws, "fine_uniform", lambda *_, drawn=drawn: drawn)
            assert bool(cells.event(torch.tensor([rate]))) is expected


@pytest.mark.parametrize("rate", [-1.0, float("inf"), float("nan")])
def test_rates_of_events_are_finite_and_not_below_zero(state, rate):
    with pytest.raises(InputError, match=r"event was given the rate .* finite, and 0 or more"):
        seen(state).event(rate)


def test_events_of_one_cell_do_not_depend_on_the_others(state):
    whole, part = seen(state), seen(state.select([2]))
    first = int((state.colony < 2).sum())
    of = lambda cells, k: [bool(list(cells)[k].event(10.0)) for _ in range(8)]
    found = [of(whole, first + k) for k in range(6)]
    assert found == [of(part, k) for k in range(6)]
    assert 0 < sum(map(sum, found)) < 48


@pytest.mark.parametrize("name", ["xy", "yx", "z"])
def test_only_single_coordinates_have_names(name):
    with pytest.raises(InputError, match=f"no '{name}'"):
        scene(lambda cells: getattr(cells, name)).bind()

    def declare(cells):
        setattr(cells, name, cells.x + cells.y)

    declare.__name__ = "declare"
    own = tf.Rules(declare, variables={name: 0.0})
    cells = tf.Cells([[1.0, 2.0]], [[1.0, 0.0]])
    model = tf.Scene(own, tf.Growth(rate=1.0), dim=2, founders=cells, dt=0.05).bind()
    state = model.step(model.start())
    assert float(state.fields[name][0]) == 3.0
