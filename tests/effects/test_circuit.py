"""Circuit, smooth: dilution, inheritance, and the order of its coupling to the medium."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import pytest
import torch
from helpers import step
from reacting import F64, advance, idle, made, resting

import torchfilm as tf


def dividing(circuit: tf.Circuit, *more: tf.Effect) -> tf.Scene:
    return tf.Scene(
        *more,
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.0, 3.4)),
        tf.Mechanics(dim=2),
        circuit,
    )


# --- dilution and daughters -----------------------------------------------------------------------


def test_growth_dilutes(dtype, device):
    """c·V stays: one product and one quotient a step, each rounded by eps/2, in 12 steps."""
    scene = tf.Scene(
        tf.Growth(rate=tf.Uniform(0.5, 1.5)),
        tf.Circuit(idle, species=("m", "w"), initial={"m": 3.0, "w": 7.0}),
    )
    state = scene.bind(5, dtype=dtype, device=device).start()
    last = advance(scene, state, 12)
    assert float((last.volume / state.volume).min()) > 1.5
    bound = 24 * torch.finfo(dtype).eps
    for name in ("m", "w"):
        kept = last.fields[name] * last.volume / (state.fields[name] * state.volume)
        assert float((kept - 1).abs().max()) <= bound
    assert torch.equal(last.circuit_volume, last.volume)


def test_a_volume_that_mechanics_held_back_is_the_one_that_dilutes(dtype):
    """A cell between two walls wants to grow and cannot: what it holds is diluted by the volume
    that it has, not by what it wanted."""
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics([tf.Channel(1.2, low_end=-1.6, high_end=1.6)], dim=2),
        tf.Circuit(idle, species=("m",), initial={"m": 1.0}),
    )
    state = scene.bind(dtype=dtype).start()
    last = advance(scene, state, 40, 0.05)
    assert float(last.volume / state.volume) < 1.5  # e² without walls
    assert float(last.m * last.volume) == pytest.approx(
        float(state.volume), rel=80 * torch.finfo(dtype).eps
    )


@pytest.mark.parametrize("daughters", ["concentration", "amount"])
def test_daughters_have_the_concentration_or_the_amount_of_their_parent(daughters, dtype, device):
    scene = dividing(tf.Circuit(idle, species=("m",), initial={"m": 2.0}, daughters=daughters))
    state = scene.bind(2, dtype=dtype, device=device).start()
    divided = 0
    for _ in range(25):
        before, state = state, step(scene, state, 0.1)
        for births in state.births:
            divided += births.first.numel()
            # what growth after the division did to each daughter is undone with the volumes
            amount = [
                state.m.index_select(0, r) * state.volume.index_select(0, r)
                for r in (births.first, births.second)
            ]
            parents = births.parents
            if daughters == "amount":
                total = parents.m * parents.volume
                assert (
                    float(((amount[0] + amount[1]) / total - 1).abs().max())
                    <= 10 * torch.finfo(dtype).eps
                )
    total = torch.zeros(2, dtype=F64, device=device).index_add(
        0, state.colony, (state.m * state.volume).double()
    )
    assert divided >= 4 and before is not state
    if daughters == "amount":
        assert total.tolist() == pytest.approx(
            [2 * math.pi * 0.25 * (2 + 2 / 3)] * 2, rel=25 * 4 * torch.finfo(dtype).eps
        )
    else:
        # each division loses what the two new caps take up
        assert float(total.max()) < 2 * math.pi * 0.25 * (2 + 2 / 3) * 0.95


def test_daughters_have_exactly_the_concentration_of_their_parent():
    """Without growth after it, to the last bit."""
    cells = tf.Cells([[0.0, 0.0], [0.0, 3.0]], [[1.0, 0.0]] * 2, length=4.0)
    scene = tf.Scene(
        tf.Division(),
        tf.Circuit(idle, species=("m",), initial={"m": tf.Uniform(0.1, 1.0)}),
        founders=cells,
    )
    state = scene.bind(dtype=torch.float32).start()
    after = step(scene, state.with_fields(divide_flag=torch.tensor([True, True])), 0.1)
    assert after.cells == 4
    for k in range(4):
        assert float(after.m[k]) in state.m.tolist()
    assert torch.equal(after.circuit_volume, after.volume)


def test_daughters_share_the_amount_by_volume(dtype):
    """Two unequal daughters have one concentration, and together what their parent had: three
    products and two quotients each."""
    circuit = tf.Circuit(idle, species=("m",), initial={"m": 2.0}, daughters="amount")
    scene = tf.Scene(tf.Division(fraction=0.3), circuit, founders=tf.Cells.single(2, length=4.0))
    state = scene.bind(dtype=dtype).start()
    after = step(scene, state.with_fields(divide_flag=torch.tensor([True])), 0.1)
    bound = 5 * torch.finfo(dtype).eps
    assert float(after.volume[0] / after.volume[1]) < 0.7
    assert (
        float(after.m[0]) == pytest.approx(float(after.m[1]), rel=bound) and float(after.m[0]) > 2.0
    )
    assert float((after.m * after.volume).sum()) == pytest.approx(
        float(2.0 * state.volume), rel=bound
    )


def test_what_a_rule_shares_out_is_diluted_from_the_daughters_on():
    """A `divide` rule that gives one daughter all: growth in the same step must not count the
    division as growth."""

    def divide(parent, daughter1, daughter2):
        daughter1.m = parent.m * parent.volume / daughter1.volume
        daughter2.m = 0.0 * parent.m

    scene = dividing(tf.Circuit(idle, species=("m",), initial={"m": 2.0}), tf.Rules(divide=divide))
    state = scene.bind(dtype=F64).start()
    last = advance(scene, state, 25)
    assert last.cells >= 4
    amount = last.m * last.volume
    assert (
        float(amount.max()) == pytest.approx(float(2.0 * state.volume), rel=1e-12)
        and int((amount > 0).sum()) == 1
    )


@dataclass(frozen=True)
class Stretch(tf.Effect):
    """A user's own effect that makes cells 1 µm longer, once, before they divide."""

    stage, title = tf.effect.RULES, "stretch"

    def writes(self):
        return ("length",)

    def step(self, state, dt, values):
        return state.replace(length=state.length + 1.0) if state.step == 0 else state


@pytest.mark.parametrize("threshold", [2.5, 9.0])
def test_amounts_refer_to_the_volume_for_which_they_were_worked_out(threshold):
    """Whoever changes a length, and whether or not the cell then divides in the same step."""
    scene = tf.Scene(
        Stretch(),
        tf.Division(length=threshold, fraction=0.4),
        tf.Circuit(idle, species=("m",), initial={"m": 2.0}, daughters="amount"),
    )
    state = scene.bind(dtype=F64).start()
    after = step(scene, state, 0.1)
    assert after.cells == (2 if threshold == 2.5 else 1)
    assert float((after.m * after.volume).sum()) == pytest.approx(
        2.0 * float(state.volume), rel=1e-14
    )


# --- coupling to the medium -----------------------------------------------------------------------


def lux(u, s, p, cell):
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    return {"luxi": 0.5 + u.ahl / (1 + u.ahl) - u.luxi, "ahl": 3.0 * u.luxi + into / cell.volume}, {
        "ahl": -into
    }


def test_halving_the_step():
    """Cells and transport take turns. What cells that meet no others hold is of second order, and
    so is the signal with half of transport before them; where all of it comes last ("lie") the
    signal is of first. Fixed cells, against a step of a sixteenth of the smallest.
    """
    cells, signal = {}, {}
    for splitting in ("lie", "strang"):
        ends = {}
        for steps in (8, 16, 32, 512):
            circuit = tf.Circuit(
                lux, species=("luxi", "ahl"), initial={"luxi": 1.0}, D1=1.0, method="rk4", steps=2
            )
            medium = tf.Medium(
                ahl=tf.Signal(diffusion=10.0, decay=0.5),
                box=((-8.0, -8.0), (8.0, 8.0)),
                spacing=2.0,
                exchange="turns",
                splitting=splitting,
            )
            scene = resting(circuit, 3, medium)
            state = advance(scene, scene.bind(dtype=F64).start(), steps, 1.0 / steps)
            ends[steps] = torch.cat([state.luxi, state.ahl]), state.signals["ahl"]
        cells[splitting], signal[splitting] = (
            [float((ends[n][k] - ends[512][k]).abs().max()) for n in (8, 16, 32)] for k in (0, 1)
        )
    # the reference is off by 1/16 of the smallest error or less: ratios of 2 come out as up to
    # 2.15, and all as less where the next order still shows
    assert all(1.7 <= a / b <= 2.3 for a, b in itertools.pairwise(signal["lie"])), signal
    for errors in (*cells.values(), signal["strang"]):
        assert all(3.0 <= a / b <= 4.6 for a, b in itertools.pairwise(errors)), errors
    assert all(5 * s < e for s, e in zip(signal["strang"], signal["lie"], strict=True)), signal


def test_reactions_and_a_function_with_the_same_rates_do_the_same():
    """The membrane by `parts.exchange` and by hand."""

    def by_hand(u, s, p, cell):
        into = p.D1 * (s.ahl - u.ahl) * cell.area
        return {"ahl": 2.0 - 0.5 * u.ahl + into / cell.volume}, {"ahl": -into}

    listed = [
        tf.parts.constitutive("ahl", 2.0),
        tf.parts.degradation("ahl", 0.5),
        tf.parts.exchange("ahl", "D1"),
    ]
    ends = []
    for rates in (by_hand, listed):
        scene = resting(
            tf.Circuit(rates, species=("ahl",), D1=1.5, method="rk4"),
            2,
            tf.Medium(ahl=tf.Signal(diffusion=10.0), box=((-8.0, -8.0), (8.0, 8.0)), spacing=2.0),
        )
        ends.append(advance(scene, scene.bind(dtype=F64).start(), 10))
    for name in ("ahl", "out.ahl"):
        assert torch.allclose(ends[0].fields[name], ends[1].fields[name], rtol=1e-13), name


def test_two_types_share_a_crowded_voxel():
    """One type gives, the other takes far faster than the step: what is taken comes out of what was
    there, and the sum stays."""

    def gives(u, s, p, cell):
        return {"m": -5.0 * u.m}, {"a": 5.0 * u.m * cell.volume}

    def takes(u, s, p, cell):
        return {"m": 1e5 * s.a}, {"a": -1e5 * s.a * cell.volume}

    cells = tf.Cells(
        [[0.1 * k, 1.1 * k - 2.0] for k in range(5)], [[1.0, 0.0]] * 5, cell_type=[0, 1, 0, 1, 1]
    )
    scene = tf.Scene(
        tf.Circuit({0: gives, 1: takes}, species=("m",), initial={"m": 1.0}),
        tf.Medium(
            a=tf.Signal(diffusion=1.0, initial=0.5), box=((-8.0, -8.0), (8.0, 8.0)), spacing=8.0
        ),
        founders=cells,
    )
    state = scene.bind(dtype=F64).start()
    total = lambda s: float((s.m * s.volume).sum() + s.signals["a"].sum() * 512.0)
    first = total(state)
    for _ in range(4):
        state = advance(scene, state, 1)
        assert float(state.signals["a"].min()) >= 0 and float(state.m.min()) >= 0
        # what the solve magnifies: rate × step 1e4 of rounding 1e-16, of what is exchanged
        assert total(state) == pytest.approx(first, rel=1e-11)


def test_an_empty_batch_goes_on():
    scene = dividing(tf.Circuit(made, species=("m",), k=1.0, g=1.0))
    state = scene.bind(2).start()
    gone = state.remove(torch.ones(2, dtype=torch.bool), "removed")
    assert advance(scene, gone, 3).cells == 0
