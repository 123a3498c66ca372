"""Circuits and transport in several turns within a step: `Medium(exchange="turns", steps=…)`."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from exchanging_cells import BOX, F64, advance, exchanging, resting, totals

import torchfilm as tf
from torchfilm.tools.timing import Timings

DT = 0.05
FOUR = tf.Cells([[0.0, 0.0], [3.0, 1.0], [-2.0, 4.0], [1.0, -5.0]], [[1.0, 0.0]] * 4, 2.0)


def medium(steps: int = 1, diffusion: float = 30.0, decay: float = 0.5, **options) -> tf.Medium:
    given = {"box": BOX, "spacing": 4.0, "steps": steps, "exchange": "turns", **options}
    return tf.Medium(ahl=tf.Signal(diffusion, decay=decay), **given)


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


def lost(u, s, p, cell):
    return {"seen": s.ahl + s.food + cell.time, "ahl": -p.d * u.ahl}


@pytest.mark.parametrize("method", [None, "series", "implicit", "crank_nicolson", "euler"])
@pytest.mark.parametrize("splitting", ["strang", "lie"])
def test_all_circuits_and_signals_take_the_turns(method, splitting):
    """Also a circuit that exchanges nothing, but reads what others exchange, a signal that nobody
    exchanges and the time, and takes from a species of the other circuit."""

    def scene(steps: int) -> tf.Scene:
        return tf.Scene(
            tf.Circuit(made, species="ahl", D1=20.0, name="A"),
            tf.Circuit(lost, species="seen", shared={"ahl": "A_ahl"}, d=5.0, name="B"),
            tf.Medium(
                ahl=tf.Signal(30.0),
                food=tf.Signal(10.0, initial=lambda at: 1.0 + at[:, 0] ** 2),
                box=BOX, spacing=4.0, steps=steps, splitting=splitting, method=method,
                exchange="turns",
            ),
            founders=FOUR,
        )  # fmt: skip

    once = advance(scene(4), scene(4).bind(dtype=F64).start(), 3, DT)
    each = advance(scene(1), scene(1).bind(dtype=F64).start(), 12, DT / 4)
    for name in ("A_ahl", "B_seen", "out.ahl", "out.food"):
        torch.testing.assert_close(once.fields[name], each.fields[name], rtol=1e-11, atol=1e-13)


@dataclass(frozen=True)
class Copies(tf.Effect):
    """After circuits, before transport: keeps what it finds in the cells."""

    stage, title = 55, "copies"

    def declares(self, dim: int):
        return (tf.Field("kept", "what was found", "conc"),)

    def writes(self):
        return ("kept",)

    def reads(self):
        return ("ahl",)

    def step(self, state, dt, values):
        return state.with_fields(kept=state.ahl)


@pytest.mark.parametrize("steps", [1, 3])
def test_what_comes_after_circuits_still_does(steps):
    scene = tf.Scene(
        tf.Circuit(made, species="ahl", D1=2.0), medium(steps), Copies(), founders=FOUR
    )
    last = advance(scene, scene.bind(dtype=F64).start(), 1, DT)
    assert torch.equal(last.fields["kept"], last.ahl) and float(last.ahl.max()) > 0.0


def test_nutrition_finds_its_signal_half_way_whatever_the_turns():
    """Cells feed once a step. A circuit that exchanges a little of the nutrient does not move that
    to the start of the step: in one turn and in eight they eat the same to 0.1 %."""

    def leak(u, s, p, cell):
        into = p.D1 * (s.food - u.food) * cell.area
        return {"food": into / cell.volume}, {"food": -into}

    eaten = []
    for steps in (1, 8):
        scene = tf.Scene(
            tf.Monod("food", rate=1.0, half=0.5, growth_yield=0.2),
            tf.Growth(),
            tf.Circuit(leak, species="food", D1=1e-3),
            tf.Medium(food=tf.Signal(100.0, initial=1.0), box=BOX, spacing=4.0, steps=steps),
            founders=FOUR,
        )
        last = advance(scene, scene.bind(dtype=F64).start(), 10, DT)
        eaten.append(last.fields["food_eaten"])
    torch.testing.assert_close(*eaten, rtol=1e-3, atol=0.0)


def test_the_report_has_what_was_exchanged_in_all_turns():
    scene = resting(medium(5, decay=0.0), exchanging(7.0, D1=5.0), FOUR)
    first = scene.bind(dtype=F64).start()
    last = advance(scene, first, 1, DT)
    given = last.reports["circuit"].exchanged.given["ahl"].sum()
    gained = (last.signals["ahl"] - first.signals["ahl"]).sum() * 64.0
    assert float(given / gained) == pytest.approx(1.0, rel=1e-12)
    assert float(given) > 1.0


@pytest.mark.parametrize("steps", [1, 4])
def test_the_gradient_by_a_growth_rate_of_0(steps):
    """Where a cell does not grow its length is taken as it is; not so its derivative. Differences
    of second order, over 1e-5."""

    def outcome(rate: torch.Tensor) -> torch.Tensor:
        circuit = tf.Circuit(made, species="ahl", D1=5.0)
        scene = tf.Scene(tf.Growth(rate=rate), circuit, medium(steps), founders=FOUR, dim=2)
        return advance(scene, scene.bind(dtype=F64).start(), 2, DT).ahl.sum()

    rate = torch.tensor(0.0, dtype=F64, requires_grad=True)
    (found,) = torch.autograd.grad(outcome(rate), rate)
    at = [float(outcome(torch.tensor(k * 1e-5, dtype=F64))) for k in (0, 1, 2)]
    assert float(found) == pytest.approx((4 * at[1] - 3 * at[0] - at[2]) / 2e-5, rel=1e-5)


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
    scene = resting(medium(5, 3000.0, decay=0.0), exchanging(7.0, D1=1e4, backend=backend), FOUR)
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
    assert "4 turns of cells and transport in a step, for ahl" in said
    assert "first order in dt/4" in said
    assert "turns of circuits" not in tf.explain(growing(1), seconds=0)
    fast = resting(medium(2, 1000.0), exchanging(), FOUR)
    assert "below 1 % with Medium(steps=8)" in " ".join(tf.explain(fast, seconds=0).split())
