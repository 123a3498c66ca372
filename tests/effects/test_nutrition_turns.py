"""Uptake and transport in several turns within a step, `Medium(steps=…)`, and what is said where
they are too few."""

from __future__ import annotations

import warnings

import pytest
import torch
from exchanging_cells import BOX, F64, advance
from helpers import step

import torchfilm as tf

DT = 0.05
FOUR = tf.Cells([[0.0, 0.0], [3.0, 1.0], [-2.0, 4.0], [1.0, -5.0]], [[1.0, 0.0]] * 4, 2.0)
FAST = {"diffusion": 1e4, "growth_yield": 1e-3, "size": 32.0}


def scene(steps: int, *more: tf.Effect, diffusion: float = 30.0, rate=1.0, **medium) -> tf.Scene:
    signals = {"food": tf.Signal(diffusion, initial=lambda at: 1.0 + 0.01 * at[:, 0])}
    signals |= {"ahl": tf.Signal(20.0)} if more else {}
    return tf.Scene(
        tf.Monod("food", rate=rate, half=0.3, growth_yield=0.2),
        tf.Growth(),
        *more,
        tf.Medium(**signals, box=BOX, spacing=4.0, steps=steps, **medium),
        founders=FOUR,
    )


def given(u, s, p, cell):
    return {"ahl": 1.0 - u.ahl}, {"ahl": 0.5 * u.ahl}


def reading(u, s, p, cell):
    return {"ahl": s.food - u.ahl}


@pytest.mark.parametrize("method", [None, "series", "implicit", "crank_nicolson"])
@pytest.mark.parametrize("splitting", ["strang", "lie"])
def test_turns_of_cells_that_grow_in_their_places_are_steps_of_the_scene(method, splitting):
    """Cells that nothing moves grow by what they take up: n turns in a step are n steps. Growth
    over a step is the product of that over its turns."""
    often = scene(4, splitting=splitting, method=method)
    short = scene(1, splitting=splitting, method=method)
    once = advance(often, often.bind(dtype=F64).start(), 3, DT)
    each = advance(short, short.bind(dtype=F64).start(), 12, DT / 4)
    for name in ("out.food", "food_eaten"):
        torch.testing.assert_close(once.fields[name], each.fields[name], rtol=1e-11, atol=1e-13)
    torch.testing.assert_close(once.volume, each.volume, rtol=1e-11, atol=0.0)
    both = [s.reports["nutrition"].uptake for s in (once, each)]
    assert float(both[0]) == pytest.approx(4 * float(both[1]), rel=0.02)


def test_what_grows_is_what_the_medium_loses():
    """Also over turns, beside circuits that take turns of their own."""
    made = scene(5, tf.Circuit(given, species="ahl"))
    start = made.bind(dtype=F64).start()
    end = advance(made, start, 6, DT)
    food = lambda s: float(s.fields["out.food"].double().sum()) * s.layout.grid.voxel_volume
    grown = float((end.volume.double() - start.volume.double()).sum())
    assert grown == pytest.approx(0.2 * (food(start) - food(end)), rel=1e-9) and grown > 1.0


def test_fast_diffusion_feeds_a_cell_at_the_law():
    """A cell in a medium that diffusion keeps at 1 grows at rate · 1/(1 + half) = 1/1.1. It would
    empty its pool, 64 µm³, x = V/(yield · 1.1 · 64) · dt = 7.4 times in a step: in one turn it is
    (1 − exp(−x))/x = 0.13 of this rate. In 100 turns, x = 0.074, it is at most 3.6 % less."""

    def rate(steps: int) -> float:
        food = tf.Signal(1e6, initial=1.0)
        face = tf.Dirichlet(1.0)
        made = tf.Scene(
            tf.Monod("food", rate=1.0, half=0.1, growth_yield=1e-4), tf.Growth(),
            tf.Medium(
                food=food, box=((-8.0, -8.0), (8.0, 8.0)), spacing=4.0, depth=1.0, steps=steps,
                boundary=tf.BoundaryConditions(x=(face, face), y=(face, face)),
            ),
        )  # fmt: skip
        state = made.bind(dtype=F64).start()
        return float(step(made, state, 0.025).growth_rate)

    law = 1.0 / 1.1
    assert rate(1) == pytest.approx(0.135 * law, rel=0.05)
    assert law * 0.963 < rate(100) < law


@pytest.mark.parametrize("circuit", [(), (tf.Circuit(given, species="ahl"),)])
def test_a_restart_and_a_batch_have_the_same_bits(circuit):
    made = scene(3, *circuit)
    alone = advance(made, made.bind(streams=[1]).start(), 6, DT)
    batch = made.bind(3)
    both = advance(made, batch.start(), 3, DT)
    both = advance(made, both, 3, DT)
    mine = both.colony == 1
    assert torch.equal(both.volume[mine], alone.volume)
    assert torch.equal(both.fields["out.food"].view(3, -1)[1], alone.fields["out.food"])


def test_a_gradient_through_turns():
    """dV/d rate agrees with central differences to 1e-4, as far as the stiff solver's steps do."""

    def volume(rate: torch.Tensor) -> torch.Tensor:
        made = scene(3, rate=rate)
        state = made.bind(1, dtype=F64).start()
        return step(made, step(made, state, DT), DT).volume.sum()

    rate = torch.tensor([1.0], dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(volume(rate), rate)
    h = 1e-4
    difference = (volume(torch.tensor([1.0 + h], dtype=F64))
                  - volume(torch.tensor([1.0 - h], dtype=F64))) / (2 * h)  # fmt: skip
    assert float(slope) == pytest.approx(float(difference), rel=1e-4)


def test_a_circuit_that_reads_the_nutrient_finds_it_half_way():
    """Then nutrition takes no turns, and says what that costs."""
    reads = scene(4, tf.Circuit(reading, species="ahl")).bind()
    assert [e.turns for e in reads.effects if e.title == "nutrition"] == [1]
    said = str(tf.explain(fast_reading()))
    assert "a dt" in said and "nutrition takes one turn" in said and "as many Medium" not in said
    apart = scene(4, tf.Circuit(given, species="ahl")).bind()
    assert [e.turns for e in apart.effects if e.title == "nutrition"] == [4]


def fast_reading() -> tf.Scene:
    fast = tf.scenes.nutrient_limited(**FAST)
    circuit = tf.Circuit(lambda u, s, p, cell: {"a": s.nutrient - u.a}, species="a")
    return tf.Scene(*fast.effects, circuit, dt=fast.dt)


def test_a_nutrient_that_is_used_up_is_no_concern():
    """Then cells would take all that comes, but they have grown already, and nothing comes."""
    food = tf.Signal(1e3, initial=0.1)
    made = tf.Scene(
        tf.Monod("food", rate=1.0, half=0.01, growth_yield=0.2), tf.Growth(),
        tf.Medium(food=food, box=BOX, spacing=4.0), founders=FOUR,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        *_, state = tf.simulate(made, until=6.0, dt=0.025)
    assert float(state.growth_rate.max()) < 0.05


def test_uptake_beyond_what_the_medium_holds_is_said():
    """Before a run, and where it lasts; not at the ready scene's own constants."""
    fast, usual = tf.scenes.nutrient_limited(**FAST), tf.scenes.nutrient_limited()
    words = "holds: where diffusion would refill it"
    assert words in str(tf.explain(fast)) and words not in str(tf.explain(usual))
    with pytest.warns(RuntimeWarning, match=r"colony 0: nutrition takes .* times as many Medium"):
        *_, state = tf.simulate(fast, until=1.5, seed=1)
    assert float(state.reports["nutrition"].turnover) > 0.65
    *_, state = tf.simulate(usual, until=1.5, seed=1)
    assert float(state.reports["nutrition"].turnover) < 0.05
