"""What rules see around a cell: its colony, its neighbours, its film; and hints at their names."""

from __future__ import annotations

import pytest
import torch

import torchfilm as tf
from torchfilm.rule_views import CellsView
from torchfilm.tools.checks import InputError


@pytest.fixture(scope="module")
def state():
    """Two colonies of touching cells, and an empty one between them."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2), dt=0.05)
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
