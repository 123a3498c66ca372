"""Domains and shares of cells, on colonies with known domains and shares."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from patterned import crowded, graded, placed

import torchfilm as tf
from design.targets import DomainSize, OnFraction

DOMAINS = DomainSize(("a", "b"), 5.0)


def lattice(kinds) -> tf.State:
    """Balls 1.2 µm apart, gaps 0.2, on a square lattice whose diagonal neighbours (gap 0.7) do not
    count: kinds (rows, columns), True makes a, False b."""
    kinds = np.asarray(kinds, dtype=bool)
    x, y = np.meshgrid(1.2 * np.arange(kinds.shape[1]), 1.2 * np.arange(kinds.shape[0]))
    return placed(
        np.stack([x.reshape(-1), y.reshape(-1)], 1), a=kinds.reshape(-1), b=~kinds.reshape(-1)
    )


@pytest.mark.parametrize("width", [1, 2, 5])
def test_domains_of_a_striped_lattice(width):
    """20 × 20: of 2 · 19 · 20 pairs, 20 are unlike at each of the borders between stripes."""
    state = lattice(np.broadcast_to(np.arange(20) // width % 2, (20, 20)))
    unlike = (20 // width - 1) / (2 * 19)
    found = DOMAINS.measures(state)
    assert float(found["pairs"]) == 2 * 19 * 20
    assert float(found["unlike_share"]) == pytest.approx(unlike, rel=1e-12)
    assert float(found["domain_size_um"]) == pytest.approx(1.2 / unlike, rel=1e-12)


def test_checkers_are_as_small_as_domains_can_be():
    """Every pair is unlike: a domain is as wide as the distance of neighbours."""
    found = DOMAINS.measures(lattice(np.indices((9, 9)).sum(0) % 2))
    assert float(found["domain_size_um"]) == pytest.approx(1.2, rel=1e-12)


@pytest.mark.parametrize("dim, length", [(2, math.pi / 2), (3, 2.0)])
def test_size_is_the_mean_run_of_a_straight_line(dim, length):
    """Buffon's law for layers W apart: lines of all directions run π/2·W in the plane and 2·W in
    space on average in one of them. No two neighbours are as far apart as two borders, so the law
    is exact but for the rim; over seeds 24,000 random balls vary by 2 %, and 8 % is four times
    that.
    """
    layer, side = 4.0, 240.0 if dim == 2 else 36.0
    rng = np.random.default_rng(0)
    place = rng.uniform(0, side, (24000, dim))
    kind = np.floor(place[:, 0] / layer + 0.5).astype(int) % 2
    found = DOMAINS.measures(placed(place, a=kind, b=1 - kind))
    # borders at 2, 6, … µm: one for each layer in the side
    assert float(found["domain_size_um"]) == pytest.approx(length * layer, rel=0.08)


def test_loss_depends_on_the_ratio_of_sizes():
    """0 at the target size, 1 − 1/e at a factor e above or below."""
    state = lattice(np.broadcast_to(np.arange(20) // 4 % 2, (20, 20)))
    size = float(DOMAINS.measures(state)["domain_size_um"])
    for target_size, loss in (
        (size, 0.0),
        (size * math.e, 1 - 1 / math.e),
        (size / math.e, 1 - 1 / math.e),
    ):
        found = DomainSize(("a", "b"), target_size).loss(state)
        assert float(found) == pytest.approx(loss, abs=1e-14) and found.dtype == torch.float64


@pytest.mark.parametrize(
    "a, b",
    [([1, 1, 1], [0, 0, 0]), ([0.0, 0.0, 0.0], [2, 2, 2])],  # all alike
)
def test_one_domain_has_loss_1_and_a_gradient(a, b):
    state = placed([(0, 0), (1, 0), (2, 0)], a=a, b=b)
    given = [state.fields[n].clone().requires_grad_() for n in "ab"]
    loss = DOMAINS.loss(state.with_fields(a=given[0], b=given[1]))
    assert loss.tolist() == [1.0]
    assert all(bool(torch.isfinite(g).all()) for g in torch.autograd.grad(loss.sum(), given))
    assert math.isnan(DOMAINS.measures(state)["domain_size_um"])


def test_cells_with_neither_species_are_in_no_domain():
    """z = 0: loss 1, and the gradient is finite."""
    state = placed([(0, 0), (1, 0)], a=0.0, b=0.0)
    given = state.a.clone().requires_grad_()
    loss = DomainSize(("a", "b"), 2.0).loss(state.with_fields(a=given))
    assert float(loss.detach()) == 1.0
    assert bool(torch.isfinite(torch.autograd.grad(loss.sum(), given)[0]).all())


@pytest.mark.parametrize("less", [0.0, 0.1, 0.3])
def test_weakly_decided_cells_of_one_kind_are_no_domains(less):
    """Found by a search: cells all of one kind at |z| = 0.8 counted as domains of five distances,
    since each pair was unlike by (1 − z²)/2."""
    state = lattice(np.ones((9, 9)))
    given = state.with_fields(b=less * state.a)
    for size in (1.2, 6.0, 12.0):
        assert float(DomainSize(("a", "b"), size).loss(given)) == 1.0


@pytest.mark.parametrize("less", [0.1, 0.3])
def test_weakly_decided_stripes_are_as_wide_as_decided_ones(less):
    """Their loss at the right size is what they lack of being decided: 1 − z²."""
    state = lattice(np.broadcast_to(np.arange(20) // 4 % 2, (20, 20)))
    weak = state.with_fields(a=state.a + less * state.b, b=state.b + less * state.a)
    size = float(DOMAINS.measures(state)["domain_size_um"])
    found, z = DOMAINS.measures(weak), (1 - less) / (1 + less)
    assert float(found["domain_size_um"]) == pytest.approx(size, rel=1e-6)
    assert float(found["decided"]) == pytest.approx(z * z, rel=1e-6)
    loss = float(DomainSize(("a", "b"), size).loss(weak))
    assert loss == pytest.approx(1 - z * z, rel=1e-6)


@pytest.mark.filterwarnings("ignore:.*empty. the cells are of")
def test_without_neighbours_there_is_no_domain():
    """Alone, far from all others, or next to a cell of another colony only."""
    state = placed(
        [(0, 0), (5, 0), (1, 0), (0, 0), (1, 0)],
        a=[1, 0, 1, 1, 0],
        b=[0, 1, 0, 0, 1],
        colony=[0, 0, 1, 2, 2],
        colonies=4,
    )
    assert (
        DOMAINS.loss(state).tolist()[:2] == [1.0, 1.0]
        and DOMAINS.loss(state)[2] < 1
        and float(DOMAINS.loss(state)[3]) == DOMAINS.failed
    )
    assert DOMAINS.measures(state)["domain_size_um"].isnan().tolist() == [True, True, False, True]


TARGETS = {"domains": DomainSize(("yfp", "cfp"), 3.0), "share": OnFraction("yfp", 0.3, 1.0)}


@pytest.mark.parametrize("name", TARGETS)
def test_gradient_with_respect_to_the_levels(name):
    assert graded(TARGETS[name], crowded(colonies=2, count=12, size=4.0))


@pytest.mark.parametrize("name", TARGETS)
def test_a_colony_scores_the_same_in_any_batch(name):
    target, state = TARGETS[name], crowded(seed=2, colonies=7, size=4.0)
    whole, measured = target.loss(state), target.measures(state)
    assert bool(((whole > 0) & (whole < 1)).all())
    for k in (0, 3, 6):
        alone = state.select([k])
        assert torch.equal(target.loss(alone)[0], whole[k])
        assert all(
            torch.equal(v[0], measured[what][k]) for what, v in target.measures(alone).items()
        )


@pytest.mark.parametrize("name", TARGETS)
def test_failed_colonies_do_not_affect_others(name):
    target, state = TARGETS[name], crowded(colonies=4, size=4.0)
    good = target.loss(state)
    state = state.remove(state.colony == 1, "removed")
    given = state.yfp.clone()
    given[state.colony == 2] = math.inf
    given.requires_grad_()
    loss = target.loss(state.with_fields(yfp=given))
    assert loss[[1, 2]].tolist() == [1.5, 1.5] and torch.equal(loss[[0, 3]], good[[0, 3]])
    (grad,) = torch.autograd.grad(loss.sum(), given)
    assert bool(torch.isfinite(grad).all()) and float(grad.abs().max()) > 0


@pytest.mark.parametrize(
    "levels, share",
    [
        ((1, 1, 1, 1), 0.5),  # all just at the level
        ((0, 0, 0, 0), 0.0),
        ((2, 0, 0, 0), 16 / 17 / 4),
        ((1e200, 1e5, 0, 0), 0.5),
    ],
)
def test_share_of_cells_that_are_on(levels, share):
    """s = y⁴/(y⁴ + level⁴); 1 − s = 1e-20 at 1e5. Cells between on and off cost as much as they
    are: 4 s (1 − s)."""
    fourth = np.minimum(np.array(levels, dtype=float), 1e9) ** 4
    s = fourth / (1 + fourth)
    state = placed([(0, 0), (2, 0), (4, 0), (6, 0)], yfp=3.0 * np.array(levels, dtype=float))
    given = state.yfp.clone().requires_grad_()
    loss = OnFraction("yfp", 0.2, 3.0).loss(state.with_fields(yfp=given))
    assert float(loss.detach()) == pytest.approx(
        1 - (1 - ((share - 0.2) / 0.8) ** 2) * (1 - np.mean(4 * s * (1 - s))), abs=1e-15
    )
    assert bool(torch.isfinite(torch.autograd.grad(loss.sum(), given)[0]).all())


@pytest.mark.parametrize("fraction", [0.1, 0.5, 0.8])
def test_the_worst_share_has_loss_1(fraction):
    target = OnFraction("yfp", fraction, 1e-6)
    none, all_on = (float(target.loss(placed([(0, 0), (2, 0)], yfp=y))) for y in (0.0, 1.0))
    assert max(none, all_on) == pytest.approx(1, abs=1e-15) and min(none, all_on) <= 1


def test_share_measured_is_that_of_the_volume_above_the_level():
    state = placed([(0, 0), (8, 0)], length=[0.0, 4.0], yfp=[1.5, 0.5])
    found = {name: float(v) for name, v in OnFraction("yfp", 0.5, 1.0).measures(state).items()}
    assert found == {
        "on_share": pytest.approx((1 / 6) / (1 / 6 + 1 / 6 + 1)),
        "on_level": 1.5,
        "off_level": 0.5,
    }


@pytest.mark.parametrize(
    "make, what",
    [
        (lambda: DomainSize("ab", 1.0), "DomainSize.species"),
        (lambda: DomainSize(("a",), 1.0), "DomainSize.species"),
        (lambda: DomainSize(("a", "a"), 1.0), "DomainSize.species"),
        (lambda: DomainSize(("a", "b"), 0.0), "DomainSize.size"),
        (lambda: OnFraction("a", 0.0, 1.0), "OnFraction.fraction"),
        (lambda: OnFraction("a", 1.0, 1.0), "OnFraction.fraction"),
        (lambda: OnFraction("a", 0.5, 0.0), "OnFraction.level"),
        (lambda: OnFraction(None, 0.5, 1.0), "OnFraction.species"),
    ],
)
def test_bad_settings_are_refused(make, what):
    with pytest.raises(tf.InputError, match=what):
        make()


@pytest.mark.parametrize("name", TARGETS)
def test_an_unknown_species_is_refused_with_the_known_ones(name):
    with pytest.raises(tf.InputError, match=r"'yfp'.*Did you mean 'yfq'\?"):
        TARGETS[name].check(crowded(names=("yfq", "cfp")))
    TARGETS[name].check(crowded())
    assert "yfp" in TARGETS[name].describe()


def test_a_species_that_is_not_there_is_named_with_those_that_are():
    """And with nothing that serves the numerics or divisions."""
    made = tf.Circuit(lambda u, s, p, cell: {"gfp": 1.0 - u.gfp}, species="gfp")
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)), tf.Mechanics(dim=2), made
    )
    with pytest.raises(tf.InputError, match=r"'yfp'.*one of 'growth_rate', 'gfp'\."):
        OnFraction("yfp", 0.2, 3.0).check(scene.bind().start())
