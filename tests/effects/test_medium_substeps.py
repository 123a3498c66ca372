"""Reactions and transport that take turns within a step: as shorter steps would, and a pattern that
whole steps lose."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from exchanging_cells import totals
from test_medium_reactions import (
    BOX,
    F64,
    FOUR,
    assert_batch_changes_no_bit,
    in_the_middle,
    later,
    quiet,
)

import torchfilm as tf

TIGHT = {"rtol": 1e-10, "atol": 1e-12}
AUTOCATALYSIS = [tf.Reaction.of("2 a + b -> 3 a", rate=4.0)]


def two_signals(**options) -> tf.Medium:
    signals = {"a": tf.Signal(30.0, initial=in_the_middle), "b": tf.Signal(5.0, initial=0.5)}
    return tf.Medium(**signals, **BOX, **options)


def still(dt: float, circuit: bool, **options) -> tf.Scene:
    """Cells that do not grow, with a circuit that gives b or with none."""
    exchange = [tf.Circuit(quiet, species="maker", rtol=1e-8)] if circuit else []
    return tf.Scene(
        *exchange, tf.MediumReactions(AUTOCATALYSIS, **TIGHT), two_signals(**options),
        founders=FOUR, dim=2, dt=dt,
    )  # fmt: skip


@pytest.mark.parametrize("steps", [2, 3, 4])
@pytest.mark.parametrize(
    ("circuit", "options"),
    [
        (False, {}),
        (False, {"splitting": "lie"}),
        (False, {"method": "implicit"}),
        (False, {"method": "euler", "splitting": "lie"}),
        (True, {"exchange": "together"}),
        (True, {"exchange": "turns"}),
        (True, {"splitting": "lie"}),
    ],
)
def test_sub_steps_are_shorter_steps(steps, circuit, options):
    """Where cells neither grow nor move, nothing else is in a step."""
    divided = later(still(0.2, circuit, steps=steps, **options), 1.0)
    shorter = later(still(0.2 / steps, circuit, **options), 1.0)
    for name in "ab":
        one, other = divided.signals[name], shorter.signals[name]
        assert float((one - other).abs().max()) < 1e-6 * float(other.max())
    whole = later(still(0.2, circuit, **options), 1.0).signals["a"]
    assert float((whole - shorter.signals["a"]).abs().max()) > 1e-4


@pytest.mark.parametrize("circuit", [False, True])
def test_reactions_and_what_cells_give_keep_their_sums(circuit):
    state = later(still(0.2, circuit, steps=3), 2.0, colonies=2)
    area = 40.0 * 40.0
    given = float(later(still(0.2, False), 0.2).volume.sum()) * 0.1 * 2.0 if circuit else 0.0
    first = float(in_the_middle(later(still(0.2, False), 0.2).layout.grid.centres()).sum()) * 16.0
    sums = totals(state, "a", inside=False) + totals(state, "b", inside=False)
    assert sums.tolist() == pytest.approx([first + 0.5 * area + given] * 2, rel=1e-8)


def pattern(steps: int, first: float = 0.3) -> tf.Scene:
    """Schnakenberg's, one and a half wavelengths between walls."""

    def rates(s, p):
        eaten = s.u**2 * s.v
        return {"u": p.g * (p.a - s.u + eaten), "v": p.g * (p.b - eaten)}

    wave = lambda x: 1.0 + first * torch.cos(2 * math.pi * x[:, 0] / 8.6)
    return tf.Scene(
        tf.MediumReactions(rates, parameters={"a": 0.1, "b": 0.9, "g": 20.0}),
        tf.Medium(
            u=tf.Signal(10.0, initial=wave), v=tf.Signal(400.0, initial=0.9),
            box=[[0.0, 0.0], [12.9, 0.86]], spacing=0.86, depth=1.0, steps=steps,
        ),
        dim=2, dt=0.1,
    )  # fmt: skip


def test_a_pattern_that_whole_steps_lose_stays():
    """At 20/h and dt 0.1 h one concentration is left; steps of 0.1/128 h have 2.32 at the peak."""
    assert float(later(pattern(1), 3.0).signals["u"].max()) == pytest.approx(1.0, abs=1e-3)
    fine = float(later(pattern(128), 1.5).signals["u"].max())
    assert float(later(pattern(20), 3.0).signals["u"].max()) == pytest.approx(fine, rel=0.06)
    assert fine > 2.0


def test_explain_names_the_steps_that_are_enough_and_those_that_are_taken():
    said = " ".join(str(tf.explain(pattern(1, first=0.0))).split())
    assert "20/h, 2 in a step" in said and "0.1 or less: Medium(steps=20)" in said
    said = " ".join(str(tf.explain(pattern(20, first=0.0))).split())
    assert "20 sub-steps of 0.005 h, in turns with transport" in said
    assert "20/h, 0.1 in a sub-step" in said and "Medium(steps" not in said


def test_a_colony_does_not_depend_on_its_batch():
    scene = tf.Scene(
        tf.MediumReactions(AUTOCATALYSIS), tf.Growth(rate=1.0), tf.Mechanics(dim=2),
        tf.Division(length=4.0), two_signals(steps=3),
    )  # fmt: skip
    assert_batch_changes_no_bit(scene, "b")


def test_what_fails_in_any_sub_step_fails_the_colony():
    """It decays to less than a thousandth of what it was before the last one."""
    scene = tf.Scene(
        tf.MediumReactions(lambda s, p: {"a": p.k * s.a**2}, parameters={"k": [0.1, 50.0]}),
        tf.Medium(a=tf.Signal(0.0, initial=1.0, decay=100.0), **BOX, steps=3), dim=2,
    )  # fmt: skip
    with pytest.raises(tf.SimulationError, match=r"colony 1 .*in the medium, at \(.*'a' runs"):
        later(scene, 0.3, colonies=2, dt=0.3)


def test_a_nutrient_that_reacts_is_eaten_once_a_part():
    """Nutrition moves the nutrient; what it becomes is moved in sub-steps with the reactions."""
    scene = tf.Scene(
        tf.Growth(), tf.Division(length=4.0, conserves="volume"), tf.Mechanics(dim=2),
        tf.Monod("food", rate=1.0, half=0.1, growth_yield=1.0),
        tf.MediumReactions([tf.Reaction.of("food -> waste", rate=0.3)]),
        tf.Medium(food=tf.Signal(50.0, initial=1.0), waste=tf.Signal(5.0), **BOX, steps=4),
        founders=FOUR,
    )  # fmt: skip
    state = later(scene, 2.0)
    left = sum(float(totals(state, n, inside=False)) for n in ("food", "waste"))
    grown = float(state.volume.sum()) - float(scene.bind(dtype=F64).start().volume.sum())
    assert left + grown == pytest.approx(40.0 * 40.0, rel=1e-3)
    assert float(totals(state, "waste", inside=False)) > 500.0


@pytest.mark.parametrize("circuit", [False, True])
def test_gradients_pass_through_sub_steps(circuit):
    def amount(k):
        exchange = [tf.Circuit(quiet, species="maker")] if circuit else []
        scene = tf.Scene(
            *exchange,
            tf.MediumReactions(
                lambda s, p: {"a": -p.k * s.a * s.b}, parameters={"k": k}, rtol=1e-9, atol=1e-12
            ),
            two_signals(steps=3), founders=FOUR, dim=2, dt=0.1,
        )  # fmt: skip
        model = scene.bind(1, dtype=F64)
        return model.step(model.start()).signals["a"].sum()

    k = torch.tensor(2.0, dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(amount(k), k)
    near = 1e-4
    with torch.no_grad():
        expected = (amount(k + near) - amount(k - near)) / (2 * near)
    assert float(slope) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("circuit", [False, True])
def test_recorded_growth_has_the_same_bits(circuit):
    """Replayed beside growth that was recorded once."""
    exchange = [tf.Circuit(quiet, species="maker")] if circuit else []
    scene = tf.Scene(
        *exchange, tf.MediumReactions(AUTOCATALYSIS), tf.Growth(rate=1.0), tf.Mechanics(dim=2),
        tf.Division(length=4.0), two_signals(steps=3),
    )  # fmt: skip
    model = scene.bind(2, seed=1)
    replay = tf.Replay(model, tf.GrowthRecording(scene, streams=[0, 1], seed=1))
    here = there = model.start()
    for _ in range(30):
        here, there = model.step(here), replay.step(there)
    assert torch.equal(here.signals["a"], there.signals["a"])
    assert torch.equal(here.signals["b"], there.signals["b"])


@pytest.mark.parametrize("options", [{}, {"splitting": "lie"}])
def test_where_nutrition_moves_what_reacts_reactions_take_whole_steps(options):
    """Beside circuits, or after the cells, it would have most of the reactions on one side."""

    def run(steps):
        exchange = [] if options else [tf.Circuit(quiet, species="maker")]
        scene = tf.Scene(
            tf.Growth(), *exchange, tf.Monod("food", rate=1.0, half=0.1, growth_yield=1.0),
            tf.MediumReactions([tf.Reaction.of("food -> b", rate=9.0)]),
            tf.Medium(food=tf.Signal(50.0, initial=1.0), b=tf.Signal(5.0), **BOX, **options,
                      steps=steps),
            founders=FOUR, dim=2, dt=0.1,
        )  # fmt: skip
        said = " ".join(str(tf.explain(scene)).split())
        assert "food: others move or find it once a step, whatever Medium.steps" in said
        assert "half of the step before transport" in said and "or less: Medium" not in said
        return later(scene, 1.0)

    whole, divided = run(1), run(4)
    exact = 1e-3 * float(whole.volume.sum())
    assert float((whole.volume - divided.volume).abs().max()) < exact


def test_explain_asks_for_no_step_more_than_rounding():
    said = " ".join(str(tf.explain(pattern(20, first=1e-9))).split())
    assert "or less: Medium(steps" not in said


@dataclasses.dataclass(frozen=True, eq=False)
class Sensing(tf.Effect):
    """Finds a signal before cells grow."""

    stage, title = 25, "sensing"

    def reads(self):
        return ("out.b", "position")

    def step(self, state, dt, values):
        return state


@pytest.mark.parametrize("exchange", ["together", "turns"])
def test_what_finds_a_signal_before_growth_finds_it_half_way(exchange):
    scene = still(0.2, True, steps=3, exchange=exchange)
    with_it = scene.replace(Sensing(), *scene.effects)
    assert "3 sub-steps" in str(tf.explain(scene))
    said = str(tf.explain(with_it))
    assert "b: others move or find it once a step" in said and "3 sub-steps" not in said


def test_explain_asks_for_steps_where_only_some_are_moved_once():
    reactions = [tf.Reaction.of("food -> b", rate=9.0), tf.Reaction.of("b -> c", rate=9.0)]
    signals = {"food": tf.Signal(50.0, initial=1.0), "b": tf.Signal(5.0), "c": tf.Signal(5.0)}
    scene = tf.Scene(
        tf.Growth(), tf.Monod("food", rate=1.0, half=0.1), tf.MediumReactions(reactions),
        tf.Medium(**signals, **BOX), founders=FOUR, dim=2, dt=0.1,
    )  # fmt: skip
    said = str(tf.explain(scene))
    assert "food: others move or find it once" in said and "or less: Medium(steps=9)" in said
