"""Circuit: what is refused, when, in what words; and what a failure in mid-run says and leaves
alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import step

import torchfilm as tf
from torchfilm.tools.checks import InputError, SimulationError

F64 = torch.float64


def idle(u, s, p, cell):
    return {}


def made(u, s, p, cell):
    return {"m": p.k - p.g * u.m}


def resting(circuit: tf.Circuit, count: int = 1, *more: tf.Effect, **founders) -> tf.Scene:
    """Cells that neither grow nor move, 3 µm apart."""
    cells = tf.Cells([[0.0, 3.0 * k] for k in range(count)], [[1.0, 0.0]] * count, **founders)
    return tf.Scene(circuit, *more, founders=cells)


# --- bad input ------------------------------------------------------------------------------------


def bad(rates, species=("m",), **options):
    return lambda: tf.Circuit(rates, species=species, **options)


AT_ONCE = {
    "no species": (bad(idle, ()), r"Circuit\.species.*at least one"),
    "a species twice": (bad(idle, ("m", "m")), r"Circuit\.species.*different names"),
    "a species that is no name": (bad(idle, ("m w",)), r"Circuit\.species.*'m w' is none: it may"),
    "first levels as species": (
        bad(idle, {"m": 5.0}),
        r"Write species=\('m',\)\. First levels go into initial=\{'m': 5",
    ),
    "species without an order": (bad(idle, {"m"}), r"a tuple of different.*species=\('m',\)\."),
    "species in one string": (
        bad(idle, "a, b"),
        r"Circuit\.species = 'a, b'.*Pass a tuple of names: species=\('a', 'b'\)\.",
    ),
    "initial of no species": (
        bad(idle, ("luxi",), initial={"lux": 1.0}),
        r"initial names 'lux', which is no species; known are luxi\. Did you mean 'luxi'\?",
    ),
    "negative initial": (bad(idle, initial={"m": -1.0}), r"Circuit\.initial\['m'\].*at least 0"),
    "initial that may be negative": (
        bad(idle, initial={"m": tf.Normal(1.0, 1.0)}),
        r"smallest value of Circuit\.initial\['m'\]",
    ),
    "daughters": (
        bad(idle, daughters="copy"),
        r"Circuit\.daughters = 'copy'.*'concentration', 'amount'",
    ),
    "method": (bad(idle, method="rk5"), r"Circuit\.method = 'rk5'.*'rosenbrock'"),
    "gillespie": (bad(idle, method="Gillespie"), r"'Gillespie'.*Write 'direct', which serves"),
    "lsoda": (bad(idle, method="lsoda"), r"'lsoda'.*Write 'rosenbrock', which serves"),
    "steps": (bad(idle, method="rk4", steps=0), r"Circuit\.steps = 0"),
    "rtol": (bad(idle, rtol=0.0), r"Circuit\.rtol"),
    "atol": (bad(idle, atol=-1.0), r"Circuit\.atol"),
    "molecules_per_unit": (bad(idle, molecules_per_unit=0.0), r"Circuit\.molecules_per_unit"),
    "a misspelt option": (bad(idle, metod="rk4"), r"Circuit\.metod = 'rk4'"),
    "a misspelt option that takes a dict": (
        bad(idle, inital={"m": 1.0}),
        r"Circuit\.inital = \{'m': 1\.0\}.*Did you mean initial\?",
    ),
    "a parameter that is no number": (bad(made, k="fast", g=1.0), r"Circuit\.k = 'fast'"),
    "a parameter that is not finite": (
        bad(made, k=[1.0, math.nan], g=1.0),
        r"Circuit\.k\[1\] = nan",
    ),
    "neither function nor reactions": (
        bad(3.0),
        r"Circuit\.rates.*a function \(u, s, p, cell\), a list of reactions, or a dict",
    ),
    "no reactions": (bad([]), r"Circuit\.rates"),
    "types that are names": (bad({"source": idle}), r"Circuit\.rates = 'source'.*integers"),
    "molecules of a rate function": (
        bad(made, method="tau_leap", k=1.0, g=1.0),
        r"Circuit\.method = 'tau_leap'.*for reactions; made gives rates.*list",
    ),
}


@pytest.mark.parametrize("case", AT_ONCE)
def test_bad_input_is_refused_at_construction(case):
    make, said = AT_ONCE[case]
    with pytest.raises(InputError, match="(?s)" + said):
        make()


AT_SEED = {
    "unknown species returned": (
        lambda u, s, p, cell: {"w": u.m},
        r"returned a rate for 'w', which is no species; known are m",
    ),
    "unknown species read": (lambda u, s, p, cell: {"m": u.lux}, r"u has no 'lux'; known are m"),
    "unknown parameter": (lambda u, s, p, cell: {"m": p.kk}, r"p has no 'kk'; known are k\."),
    "unknown column": (
        lambda u, s, p, cell: {"m": cell.volum},
        r"cell has no 'volum'.*Did you mean 'volume'\?",
    ),
    "a signal without a medium": (
        lambda u, s, p, cell: {"m": s.ahl},
        r"s has no 'ahl', since the scene has no Medium: list tf\.Medium\(ahl=tf\.Signal\(dif",
    ),
    "a signal given without a medium": (
        lambda u, s, p, cell: ({"m": u.m}, {"ahl": u.m}),
        r"'ahl', which is no signal: the scene has no Medium: list tf\.Medium\(ahl=",
    ),
    "a wrong shape": (
        lambda u, s, p, cell: {"m": u.m.unsqueeze(1)},
        r"a rate of shape \(4, 1\) for the species 'm': it must be one number a cell, \(4,\)",
    ),
    "too few": (
        lambda u, s, p, cell: {"m": u.m[:1].repeat(3)},
        r"shape \(3,\) for the species 'm'",
    ),
    "for one cell only": (
        lambda u, s, p, cell: {"m": 1.0 if u.m < 1 else 0.0},
        r"torch\.where rather than if",
    ),
    "a sum over cells": (
        lambda u, s, p, cell: {"m": -u.m.sum()},
        r"depends on what other cells there are",
    ),
    "the greatest of all cells": (
        lambda u, s, p, cell: {"m": 1.0 + cell.x.max() - u.m},
        r"depends on what other cells there are",
    ),
    "the last cell": (lambda u, s, p, cell: {"m": u.m[-1] - u.m}, r"what other cells there are"),
    "the first cell": (
        lambda u, s, p, cell: {"m": torch.where(cell.length > cell.length[0], 1.0, 0.0)},
        r"depends on what other cells there are",
    ),
    "a sum above a level": (
        lambda u, s, p, cell: {"m": torch.relu(u.m - 2.0).sum()},
        r"depends on what other cells there are",
    ),
    "no number": (lambda u, s, p, cell: {"m": "fast"}, r"shape str for the species 'm'"),
    "no dict": (lambda u, s, p, cell: u.m, r"returned Tensor: it must return a dict"),
    "NaN at the start": (
        lambda u, s, p, cell: {"m": u.m / u.m},
        r"gives nan for the species 'm' at the start \(m = 0\)",
    ),
    "writing to u": (lambda u, s, p, cell: setattr(u, "m", 1.0), r"u\.m can only be read"),
}


def test_a_misspelt_option_is_not_taken_for_a_parameter(
    spelt=lambda u, s, p, cell: {"m": p.k + 0.0 * u.m},
):
    """One that the rates do read is a parameter, whatever it looks like."""
    for name, option in (("rtoll", "rtol"), ("step", "steps"), ("daughter", "daughters")):
        with pytest.raises(
            InputError,
            match=(
                rf"Circuit\.{name} is a constant that no rate reads. Did you mean the option"
                rf" {option}\?"
            ),
        ):
            resting(tf.Circuit(spelt, species=("m",), k=1.0, **{name: 1.0}), 2).bind().start()
    resting(
        tf.Circuit(lambda u, s, p, cell: {"m": p.rate}, species=("m",), rate=1.0), 2
    ).bind().start()
    with pytest.warns(UserWarning, match=r"Circuit\.spare is a constant that no rate reads"):
        resting(tf.Circuit(spelt, species=("m",), k=1.0, spare=1.0), 2).bind().start()
    resting(
        tf.Circuit([tf.parts.constitutive("m", "rate")], species=("m",), rate=1.0), 2
    ).bind().start()


@pytest.mark.parametrize("case", AT_SEED)
def test_a_rate_function_is_tried_before_anything_runs(case):
    rates, said = AT_SEED[case]
    with pytest.raises(InputError, match="(?s)" + said):
        resting(tf.Circuit(rates, species=("m",), k=1.0), 2).bind().start()
    with pytest.raises(InputError, match="(?s)" + said) as refused:
        resting(tf.Circuit({1: rates}, species=("m",), k=1.0), 2, cell_type=[1, 1]).bind().start()
    assert "(cell type 1)" in str(refused.value) or "can only be read" in said


def test_the_type_is_named_where_the_trial_fails():
    with pytest.raises(InputError, match=r"made \(cell type 1\): u has no 'm'; known are w"):
        resting(
            tf.Circuit({0: idle, 1: made}, species=("w",), k=1.0, g=1.0), 2, cell_type=[0, 0]
        ).bind().start()


def test_a_signal_is_named_when_its_amount_is_wrong():
    medium = tf.Medium(ahl=tf.Signal(diffusion=1.0), box=((-8, -8), (8, 8)), spacing=4.0)
    for amount, said in (
        (lambda u: u.m.unsqueeze(1), r"signal 'ahl'"),
        (lambda u: 1 / u.m, r"gives inf for the signal 'ahl'"),
    ):
        with pytest.raises(InputError, match=said):
            resting(
                tf.Circuit(lambda u, s, p, cell, a=amount: ({}, {"ahl": a(u)}), species=("m",)),
                2,
                medium,
            ).bind().start()
    with pytest.raises(InputError, match=r"s has no 'ahi'; known are ahl\. Did you mean 'ahl'"):
        resting(
            tf.Circuit(lambda u, s, p, cell: {"m": s.ahi}, species=("m",)), 2, medium
        ).bind().start()


REACTIONS = {
    "missing parameter": (
        [tf.parts.constitutive("m", "kk")],
        r"needs the parameter 'kk', which Circuit was not given; known are k",
    ),
    "unknown species": ([tf.parts.constitutive("w", "k")], r"'w made' has the unknown name 'w'"),
    "signal without a medium": (
        [tf.parts.exchange("m", "k", "ahl")],
        r"needs the signal 'ahl': the scene has no Medium: list tf\.Medium",
    ),
}


@pytest.mark.parametrize("case", REACTIONS)
def test_reactions_are_checked_before_anything_runs(case):
    reactions, said = REACTIONS[case]
    with pytest.raises(InputError, match=said):
        resting(tf.Circuit(reactions, species=("m",), k=1.0)).bind().start()


@pytest.mark.parametrize(
    "option",
    [{"k": [1.0, 2.0]}, {"initial": {"m": [1.0, 2.0]}}, {"molecules_per_unit": [1.0, 2.0]}],
    ids=["parameter", "initial", "molecules_per_unit"],
)
def test_a_value_per_colony_must_have_one_for_each(option):
    scene = resting(tf.Circuit(made, species=("m",), **{"k": 1.0, "g": 1.0, **option}))
    with pytest.raises(
        InputError, match=f"{next(iter(option))}.* has 2 values, but the batch has 3 colonies"
    ):
        scene.bind(3).start()
    assert scene.bind(2).start().colonies == 2


def test_two_circuits_are_one_too_many():
    with pytest.raises(InputError, match="circuit 2 times"):
        tf.Scene(tf.Circuit(idle, species=("m",)), tf.Circuit(idle, species=("w",)))


def test_a_species_may_not_be_called_as_something_else():
    with pytest.raises(InputError, match="growth_rate"):
        tf.Scene(tf.Growth(rate=1.0), tf.Circuit(idle, species=("growth_rate",))).bind().start()
    with pytest.raises(InputError, match="length"):
        tf.Scene(tf.Circuit(idle, species=("length",))).bind().start()


# --- failure in mid-run ---------------------------------------------------------------------------


def breaks(u, s, p, cell):
    """Sound at the start; NaN once x has passed 1, which colonies 1 and 3 do."""
    return {"m": p.k * torch.where(u.m > 1.0, torch.nan, 1.0), "w": -u.w}


def stops(u, s, p, cell):
    """The same by the clock, so that it is NaN from the first moment of a step."""
    return {"m": p.k * torch.where((p.k > 1) & (cell.time > 0.25), torch.nan, 1.0), "w": -u.w}


@pytest.mark.parametrize(("method", "rates"), [("rosenbrock", stops), ("rk4", breaks)])
def test_a_rate_that_becomes_nan_names_species_type_step_and_colonies(method, rates):
    circuit = tf.Circuit(
        {2: rates}, species=("m", "w"), k=torch.tensor([0.1, 3.0, 0.0, 3.0]), method=method
    )
    scene = resting(circuit, 2, cell_type=[2, 0])
    state = scene.bind(4, dtype=F64).start()
    with pytest.raises(
        SimulationError,
        match=(
            r"(?s)^step 4 \(t = 0\.4 h\) failed in 2 of 4.*colony 1 \(2 cells\): circuit of cell 0"
            r" \(type 2\).*'m'.*colony 3"
        ),
    ) as failed:
        list(tf.simulate(scene, state, until=1.0, dt=0.1))
    assert failed.value.colonies == (1, 3) and "colony 2" not in str(failed.value)
    assert "m = 0.9" in str(failed.value)


def test_drop_goes_on_without_the_colonies_that_failed():
    circuit = tf.Circuit(breaks, species=("m", "w"), k=torch.tensor([0.1, 3.0, 0.0]), method="rk4")
    scene = resting(circuit, 2)
    last = list(
        tf.simulate(scene, scene.bind(3, dtype=F64).start(), until=1.0, dt=0.1, on_failure="drop")
    )[-1]
    assert last.counts.tolist() == [2, 0, 2] and last.m.tolist() == pytest.approx(
        [0.1, 0.1, 0.0, 0.0]
    )


def test_a_rate_that_pushes_below_zero_is_a_failure():
    """x' = −1 whatever x is: no concentration can do that for long."""
    scene = resting(
        tf.Circuit(
            lambda u, s, p, cell: {"m": -torch.ones_like(u.m)}, species=("m",), initial={"m": 0.25}
        )
    )
    with pytest.raises(SimulationError, match=r"(?s)step 3.*colony 0.*below zero"):
        list(tf.simulate(scene, scene.bind(dtype=F64).start(), until=1.0, dt=0.1))


def test_a_rate_that_numbers_alone_can_follow_is_refused_on_its_trial():
    """Found in use: numpy takes a tensor of numbers, and not one whose derivative is asked for, as
    the stiff solver does in the first step."""
    scene = lambda **how: tf.Scene(
        tf.Growth(rate=1.0),
        tf.Circuit(
            lambda u, s, p, cell: {"m": torch.from_numpy(np.exp(-u.m.numpy()))},
            species=("m",),
            **how,
        ),
    )
    with pytest.raises(
        tf.InputError, match=r"use torch\.exp and the like rather than math or numpy"
    ):
        scene().bind(1).start()
    plain = scene(method="rk4")  # which asks for none
    assert float(step(plain, plain.bind(1).start(), 0.1).m) > 0.05
