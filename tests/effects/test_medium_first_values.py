"""What voxels begin with: draws by the seed, and what a medium has become where a box grows."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

import torchfilm as tf
from torchfilm.effects.medium_values import without_cells

FAR = tf.Cells([[2.0, 2.0]], [[1.0, 0.0]])


def noisy(initial, box=((0, 0), (40, 40)), **medium) -> tf.Scene:
    signal = tf.Signal(diffusion=0.0, initial=initial)
    return tf.Scene(tf.Medium(m=signal, box=box, spacing=1.0, **medium), dim=2, founders=FAR)


def test_first_values_are_drawn_by_seed_and_colony():
    """1,600 draws a colony: mean and standard deviation to four standard errors; same bits again,
    in another batch and at another place of it."""
    model = noisy(tf.Normal(1.0, 0.1)).bind(3, seed=5)
    first = model.start().signals["m"].view(3, -1)
    assert torch.equal(model.start().signals["m"].view(3, -1), first)
    assert float((first.mean(1) - 1).abs().max()) < 4 * 0.1 / 40
    assert float((first.std(1) - 0.1).abs().max()) < 4 * 0.1 / math.sqrt(2 * 1600)
    assert not torch.equal(first[0], first[1])
    assert torch.equal(model.start().select([2, 0]).signals["m"].view(2, -1), first[[2, 0]])
    alone = noisy(tf.Normal(1.0, 0.1)).bind(streams=[2], seed=5).start().signals["m"]
    assert torch.equal(alone, first[2])
    other = noisy(tf.Normal(1.0, 0.1)).bind(3, seed=6).start().signals["m"].view(3, -1)
    assert not bool((other == first).any(1).all())
    per_colony = tf.Uniform([0.0, 2.0, 4.0], [1.0, 3.0, 5.0])
    spread = noisy(per_colony).bind(3).start().signals["m"].view(3, -1)
    for k, row in enumerate(spread):
        assert 2 * k <= float(row.min()) < float(row.max()) <= 2 * k + 1


def test_two_signals_draw_apart_and_gradients_pass():
    mean = torch.tensor(2.0, requires_grad=True)
    law = tf.LogNormal(mean, 0.3)
    medium = tf.Medium(
        a=tf.Signal(0.0, initial=law), b=tf.Signal(0.0, initial=law), box=((0, 0), (8, 8)),
        spacing=1.0,
    )  # fmt: skip
    state = tf.Scene(medium, dim=2, founders=FAR).bind(1, dtype=torch.float64).start()
    a, b = state.signals["a"], state.signals["b"]
    assert not bool((a == b).any())
    a.sum().backward()
    assert float(mean.grad) == pytest.approx(float(a.detach().sum()) / 2.0)


def test_the_draws_of_a_voxel_stay_where_a_box_grows():
    grows = noisy(tf.Uniform(1.0, 2.0), ((0, 0), (8, 8)), outside="grow", margin=1.0)
    wide = noisy(tf.Uniform(1.0, 2.0), ((0, 0), (8, 8)), outside="grow", margin=6.0)
    one, other = (scene.bind(seed=3).start() for scene in (grows, wide))
    low, shape = (int(v) for v in other.layout.grid.origin[0, :2]), other.layout.grid.shape[0]
    values = other.signals["m"].view(*shape.tolist())
    x, y = (-v for v in low)
    assert x > 0 and y > 0
    assert torch.equal(values[x : x + 8, y : y + 8, 0], one.signals["m"].view(8, 8))
    new = torch.cat([values[:x].flatten(), values[x:, :y].flatten()])
    assert len(new.unique()) > 0.9 * len(new) and 1 <= float(new.min()) < float(new.max()) <= 2


@pytest.mark.parametrize("what", ["initial", "source", "decay"])
def test_functions_that_draw_are_refused(what):
    given = {what: lambda places: torch.rand(len(places))}
    scene = tf.Scene(
        tf.Medium(m=tf.Signal(1.0, **given), box=((0, 0), (8, 8)), spacing=1.0), dim=2, founders=FAR
    )
    told = "tf.Normal" if what == "initial" else "Draw once, outside"
    with pytest.raises(tf.InputError, match=rf"{what}\(positions\) of the signal 'm'.*{told}"):
        scene.bind()


@pytest.mark.parametrize(
    ("initial", "words"),
    [
        (tf.Normal(1.0, 0.5), "smallest value of Signal.initial = -1.0 .*give a smaller sd"),
        (tf.Normal(1.0, 0.1, inherited=True), "leave inherited out"),
        (tf.Uniform(0.0, 1e39), "initial of the signal 'm' = 1e.39 .*at most 3.4e.38"),
    ],
)
def test_distributions_that_cannot_be(initial, words):
    with pytest.raises(tf.InputError, match=words):
        noisy(initial).bind()


GROWING = [tf.Growth(rate=3.0), tf.Division(length=4.0), tf.Mechanics(dim=2)]
PULSES = tf.Schedule({0: 0.0, 0.25: 2.0, 0.5: 0.0}, period=0.75)


@pytest.mark.parametrize("ways", [{}, {"splitting": "lie", "method": "series"}, {"steps": 2}])
@pytest.mark.parametrize(
    "signal",
    [
        {"initial": 1.0, "decay": 1.0},
        {"source": 1.0, "decay": 1.0},
        {"source": PULSES, "decay": 0.5},
        {"source": PULSES, "decay": 1e-7},
        {"source": PULSES},
        {"source": tf.Schedule({0: 1.0, 0.3: 0.0, 9.0: 5.0}), "decay": 0.5},
        {"source": 2.0, "initial": 0.5},
    ],
    ids=lambda given: " ".join(given),
)
def test_what_grows_onto_a_uniform_medium_is_alike(signal, ways):
    """A medium in which no cell acts stays the same everywhere; its box grows many times."""
    scene = tf.Scene(
        *GROWING,
        tf.Medium(
            m=tf.Signal(10.0, **signal), box=((-4, -4), (4, 4)), spacing=2.0, outside="grow",
            margin=2.0, **ways,
        ),
        dt=0.05,
    )  # fmt: skip
    first = scene.bind(dtype=torch.float64).start()
    *_, state = tf.simulate(scene, first, until=1.5)
    values = state.signals["m"]
    assert len(values) > 1.5 * len(first.signals["m"])
    assert float(values.max() - values.min()) < 1e-9 * float(values.max())


def test_derivatives_by_a_decay_that_is_0():
    """c = c₀ − (c₀ k + s k t/2) t + s t … at k = 0: exact in new voxels, too."""
    decay = torch.tensor([0.0, 0.5], dtype=torch.float64, requires_grad=True)
    signal = tf.Signal(10.0, decay=decay, initial=1.0, source=0.5)
    scene = tf.Scene(
        *GROWING, tf.Medium(m=signal, box=((-4, -4), (4, 4)), spacing=2.0, outside="grow"), dt=0.05,
    )  # fmt: skip
    state = scene.bind(2, dtype=torch.float64).start()
    for _ in range(20):
        state = scene.bind(state=state).step(state)
    nodes = state.layout.grid.owner
    assert (nodes == 0).sum() > 16
    (slope,) = torch.autograd.grad(state.signals["m"].sum(), decay)
    count = torch.bincount(nodes).double()
    by_hand = lambda k: -torch.exp(-k) + 0.5 * (k * torch.exp(-k) - 1 + torch.exp(-k)) / k**2
    assert float(slope[0] / count[0]) == pytest.approx(-1.0 - 0.25, rel=1e-6)
    half = torch.tensor(0.5, dtype=torch.float64)
    assert float(slope[1] / count[1]) == pytest.approx(float(by_hand(half)), rel=1e-6)


def test_derivatives_by_a_decay_that_is_0_over_several_periods():
    """Of what three periods have made and a part of the fourth, by differences to second order."""
    state = noisy(0.5, ((0, 0), (4, 4))).bind(dtype=torch.float64).start()

    def grown(decay):
        signal = tf.Signal(0.0, initial=0.5, decay=decay, source=PULSES)
        return without_cells(signal, "m", state, (0.0, 0.0, 0.0), 3 * 0.75 + 0.4)[0]

    decay = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(grown(decay), decay)
    none, one, two = (float(grown(k)) for k in (0.0, 1e-3, 2e-3))
    assert none == pytest.approx(0.5 + 3 * 0.5 + 2 * 0.15)
    # the differences are off by h²/3 of the third derivative, which is about −20
    assert float(slope) == pytest.approx((4 * one - two - 3 * none) / 2e-3, rel=1e-5)


def test_parameters_of_a_distribution_may_be_stated_as_one_per_colony():
    stated = tf.Normal(tf.PerColony([1.0, 2.0]), 0.1)
    first = noisy(stated).bind(2).start().signals["m"].view(2, -1)
    assert first.mean(1).tolist() == pytest.approx([1.0, 2.0], abs=0.02)


def gives(u, s, p, cell):
    return {"gfp": 0.0 * u.gfp}, {"m": 5.0 + 0.0 * s.m}


@pytest.mark.parametrize(("exchange", "steps"), [("together", 1), ("turns", 1), ("turns", 4)])
def test_voxels_beyond_what_cells_give_are_as_without_cells(exchange, steps):
    """Beside cells that give the signal, the corners of the box, far from all cells, decay; in as
    much of a step as the others had before the box grew, half of a turn."""
    scene = tf.Scene(
        *GROWING, tf.Circuit(gives, species="gfp"),
        tf.Medium(
            m=tf.Signal(0.01, initial=1.0, decay=1.0), box=((-4, -4), (4, 4)), spacing=2.0,
            outside="grow", margin=12.0, exchange=exchange, steps=steps,
        ),
        dt=0.05,
    )  # fmt: skip
    *_, state = tf.simulate(scene, scene.bind(dtype=torch.float64).start(), until=1.5)
    corners = state.signals["m"].view(*state.layout.grid.shape[0].tolist())[[0, -1], [0, -1], 0]
    assert corners.tolist() == pytest.approx([math.exp(-1.5)] * 2, rel=1e-6)


def test_uptake_moves_new_voxels_no_further_than_old_ones():
    scene = tf.Scene(
        tf.Monod("m", rate=3.0, half=1.0, growth_yield=1.0), tf.Growth(), *GROWING[1:],
        tf.Medium(
            m=tf.Signal(0.01, initial=1.0, decay=1.0), box=((-4, -4), (4, 4)), spacing=2.0,
            outside="grow", margin=12.0, depth=1.0,
        ),
        dt=0.05,
    )  # fmt: skip
    *_, state = tf.simulate(scene, scene.bind(dtype=torch.float64).start(), until=1.5)
    corners = state.signals["m"].view(*state.layout.grid.shape[0].tolist())[[0, -1], [0, -1], 0]
    assert corners.tolist() == pytest.approx([math.exp(-1.5)] * 2, rel=1e-6)


@pytest.mark.parametrize("initial, warns", [(0.0, False), (1.0, True)])
@pytest.mark.parametrize("rates", [lambda s, p: {"m": -s.m}, [tf.Reaction({"m": 1}, {}, 1.0)]])
def test_reactions_without_cells_are_told_where_a_box_grows(initial, warns, rates):
    medium = tf.Medium(
        m=tf.Signal(1.0, initial=initial), n=tf.Signal(1.0, source=1.0), box=((-4, -4), (4, 4)),
        spacing=2.0, outside="grow",
    )  # fmt: skip
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        tf.Scene(*GROWING, medium, tf.MediumReactions(rates)).bind()
    said = [w for w in told if "new voxels have their first concentrations" in str(w.message)]
    assert bool(said) == warns
