"""Circuits and transport in several turns within a step: `Medium(steps=…)`."""

from __future__ import annotations

import pytest
import torch
from exchanging_cells import BOX, F64, advance, exchanging, resting, totals

import torchfilm as tf
from torchfilm.tools.timing import Timings

DT = 0.05
FOUR = tf.Cells([[0.0, 0.0], [3.0, 1.0], [-2.0, 4.0], [1.0, -5.0]], [[1.0, 0.0]] * 4, 2.0)


def medium(steps: int = 1, diffusion: float = 30.0, **options) -> tf.Medium:
    given = {"box": BOX, "spacing": 4.0, "steps": steps, **options}
    return tf.Medium(ahl=tf.Signal(diffusion, decay=0.5), **given)


def made(u, s, p, cell):
    """Made inside, and exchanged."""
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    return {"ahl": 1.0 + 0.2 * cell.x + into / cell.volume}, {"ahl": -into}


@pytest.mark.parametrize("splitting", ["strang", "lie"])
@pytest.mark.parametrize(
    "circuit", [{}, {"backend": "torch"}, {"method": "rk4"}, {"method": "euler", "steps": 3}]
)
def test_turns_of_cells_that_rest_are_steps_of_the_scene(circuit, splitting):
    """Where nothing grows or moves, n turns in a step are n steps: T(h/2) twice is T(h)."""
    rates = tf.Circuit(made, species="ahl", D1=2.0, **circuit)
    often = resting(medium(4, splitting=splitting), rates, FOUR)
    short = resting(medium(1, splitting=splitting), rates, FOUR)
    once = advance(often, often.bind(dtype=F64).start(), 3, DT)
    each = advance(short, short.bind(dtype=F64).start(), 12, DT / 4)
    for name in ("ahl", "out.ahl"):
        torch.testing.assert_close(once.fields[name], each.fields[name], rtol=1e-12, atol=1e-14)


def test_turns_take_the_error_of_exchange_away():
    """Cells that exchange within seconds, as their medium is carried: the error falls at least as
    the number of turns grows."""
    found = {}
    for steps in (1, 4, 16, 256):
        scene = resting(medium(steps, 300.0), tf.Circuit(made, species="ahl", D1=200.0), FOUR)
        found[steps] = advance(scene, scene.bind(dtype=F64).start(), 20, DT).ahl
    off = {n: float((found[n] / found[256] - 1.0).abs().max()) for n in (1, 4, 16)}
    assert off[1] > 0.2 and off[4] < off[1] / 4 and off[16] < off[4] / 4


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_growth_dilutes_evenly_over_the_turns(steps):
    """m' = k − g m is of second order in dt in any number n of turns: the error is (g·dt)² times
    1/12, since within a step the volume is taken to grow by equal parts, less 1/(8 n²)."""

    def both(u, s, p, cell):
        into = p.D1 * (s.ahl - u.ahl) * cell.area
        return {"m": p.k - 0.0 * u.m, "ahl": into / cell.volume}, {"ahl": -into}

    circuit = tf.Circuit(both, species=("m", "ahl"), k=3.0, D1=1.0)
    one = tf.Cells.single(2)
    scene = tf.Scene(tf.Growth(rate=1.0), circuit, medium(steps), founders=one, dim=2)
    last = advance(scene, scene.bind(dtype=F64).start(), 20, DT)
    off = float(last.m[0]) / (3.0 * (1.0 - torch.e**-1.0)) - 1.0
    assert off == pytest.approx(DT**2 * (1 / 12 - 1 / (8 * steps**2)), rel=0.01)


@pytest.mark.parametrize("backend", [None, "torch"])
def test_nothing_is_lost_and_nothing_is_below_0(backend):
    still = tf.Medium(ahl=tf.Signal(3000.0), box=BOX, spacing=4.0, steps=5)
    scene = resting(still, exchanging(7.0, D1=1e4, backend=backend), FOUR)
    first = scene.bind(dtype=F64).start()
    last = advance(scene, first, 10, DT)
    assert torch.allclose(totals(last), totals(first), rtol=1e-12)
    assert bool((last.signals["ahl"] >= 0).all()) and bool((last.ahl >= 0).all())
    assert float(last.ahl.max() / first.ahl.max()) < 0.1  # and much has been given


@pytest.mark.parametrize("backend", [None, "torch"])
def test_a_cell_that_fails_in_a_turn_before_the_last_is_reported(backend):
    """It runs away within the second of four turns, and what came of it says nothing later."""

    def bursting(u, s, p, cell):
        into = p.D1 * (s.ahl - u.ahl) * cell.area
        return {"m": p.k * u.m * u.m, "ahl": into / cell.volume}, {"ahl": -into}

    k = torch.tensor([1.0 / 0.018, 1.0], dtype=F64)
    circuit = tf.Circuit(
        bursting, species=("m", "ahl"), initial={"m": 1.0}, k=k, D1=1.0, backend=backend
    )
    scene = resting(medium(4), circuit)
    model = scene.bind(2, dtype=F64)
    report = model.step(model.start(), DT).reports["circuit"]
    assert report.status.tolist() == [1, 0]
    # of the second turn, from 1/(1 − 0.0125/0.018)
    assert "'m' runs away, from 3.27273 at a rate of" in report.reason(0)


@pytest.mark.parametrize("method", ["direct", "tau_leap"])
def test_each_turn_draws_numbers_of_its_own(method):
    """Births are a Poisson number, whose variance is its mean, in four turns as in one: with the
    same numbers in each turn it would be four times as much. 2,000 cells: the quotient is known to
    √(2/2000), 3 %, and may be off by five times that."""
    births = tf.Circuit(
        [tf.parts.constitutive("m", "make"), tf.parts.exchange("ahl", "D1")],
        species=("m", "ahl"),
        method=method,
        make=80.0,
        D1=1.0,
    )
    scene = resting(medium(4), births, tf.Cells.single(2))
    model = scene.bind(2000, dtype=F64)
    state = model.step(model.start(), DT)
    born = state.m * state.volume
    assert float(born.mean()) > 5.0
    assert float(born.var() / born.mean()) == pytest.approx(1.0, abs=0.16)


def growing(steps: int = 3) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(made, species="ahl", D1=5.0),
        medium(steps),
        founders=FOUR,
    )


def stepped(model: tf.Model, state: tf.State, steps: int) -> tf.State:
    for _ in range(steps):
        state = model.step(state)
    return state


def test_a_colony_has_the_same_bits_alone_and_after_a_restart(tmp_path):
    scene = growing()
    path = tmp_path / "three.h5"
    *_, three = tf.simulate(scene, until=1.0, colonies=3, record=path)
    alone = scene.bind(streams=[2])
    one = stepped(alone, alone.start(), 40)
    middle = tf.Results(path).state(scene, 2)
    assert middle.step == 20
    again = stepped(scene.bind(state=middle), middle, 20)
    third = three.select([2])
    assert one.cells == third.cells > 4
    for name in ("ahl", "out.ahl"):
        assert torch.equal(one.fields[name], third.fields[name]), name
        assert torch.equal(again.fields[name], three.fields[name]), name
    assert torch.equal(one.position, third.position)


def test_a_replay_of_growth_takes_the_same_turns():
    scene = growing()
    recording = tf.GrowthRecording(scene, streams=(0, 1))
    replay = tf.Replay(scene.bind(2), recording)
    found, model = replay.start(), scene.bind(2)
    full = model.start()
    for _ in range(20):
        found, full = replay.step(found), model.step(full)
    assert torch.equal(found.ahl, full.ahl) and torch.equal(
        found.signals["ahl"], full.signals["ahl"]
    )


def test_time_is_that_of_each_effect():
    """Circuits and transport, under their own titles."""
    model, spent = growing().bind(), Timings()
    model.step(model.start(), timings=spent)
    assert {"circuit", "transport", "mechanics"} <= set(spent.seconds)


def test_what_is_said_before_a_run():
    said = tf.explain(growing(4), seconds=0)
    assert "4 turns of circuits and transport in a step, for ahl" in said
    assert "first order in dt/4" in said
    assert "turns of circuits" not in tf.explain(growing(1), seconds=0)
    fast = resting(medium(2, 1000.0), exchanging(), FOUR)
    assert "below 1 % with Medium(steps=8)" in " ".join(tf.explain(fast, seconds=0).split())
