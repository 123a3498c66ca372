"""Reactions, parts and networks: their texts, their errors, and their rates against formulas."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from helpers import array

import torchfilm as tf
from torchfilm.circuits.draws import KeyedDraws
from torchfilm.circuits.names import Names
from torchfilm.circuits.network import build_network
from torchfilm.circuits.parts import (
    activated,
    constitutive,
    conversion,
    degradation,
    exchange,
    repressed,
)
from torchfilm.circuits.reactions import Reaction
from torchfilm.circuits.rosenbrock import rodas3
from torchfilm.circuits.stochastic import DONE, direct

SPECIES, SIGNALS = ("luxi", "ahl", "yfp"), ("ahl",)


def parts():
    return [
        constitutive("luxi", 0.3),
        activated("yfp", by="ahl", rate="k3", half=0.2, power=2),
        repressed("yfp", by="luxi", rate=0.5, half="K", power=1.5),
        degradation("luxi", torch.tensor([0.1, 0.4], dtype=torch.float64)),
        conversion("ahl", enzyme="luxi", rate=2.0, half=0.7),
        exchange("ahl", "D1"),
        Reaction.of("2 ahl + luxi -> yfp", 0.6),
    ]


def world(n=7, dtype=torch.float64, device="cpu"):
    g = torch.Generator().manual_seed(3)
    draw = lambda *shape: (torch.rand(*shape, generator=g, dtype=torch.float64) + 0.1).to(
        device=device, dtype=dtype
    )
    u = Names(SPECIES, draw(n, 3), "u")
    s = Names(SIGNALS, draw(n, 1), "s")
    p = Names(("k3", "K", "D1"), [0.9, draw(n), draw(n)], "p")
    cell = Names(
        ("volume", "area", "colony"), [draw(n), draw(n), torch.arange(n, device=device) % 2], "cell"
    )
    return u, s, p, cell


def test_rates_are_the_formulas(device, dtype):
    """Against NumPy: a few roundings."""
    u, s, p, cell = world(dtype=dtype, device=device)
    net = build_network(parts(), SPECIES, SIGNALS)
    found = net.concentration_rates(u, s, p, cell)
    luxi, ahl = array(u.luxi), array(u.ahl)
    per_volume = array(p.D1) * array(cell.area) / array(cell.volume)
    expected = [
        0.3 + 0 * ahl,
        0.9 * ahl**2 / (0.2**2 + ahl**2),
        0.5 / (1 + (luxi / array(p.K)) ** 1.5),
        np.array([0.1, 0.4])[array(cell.colony)] * luxi,
        2 * luxi * ahl / (0.7 + ahl),
        per_volume * ahl,
        per_volume * array(s.ahl),
        0.6 * ahl**2 * luxi,
    ]
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == dtype and a.shape == (7,)
        assert array(a) == pytest.approx(b, rel=20 * torch.finfo(dtype).eps)
    change = net.changes(found)
    product = np.stack([array(f) for f in found], 1) @ array(net.stoichiometry)
    for k in range(4):
        assert array(change[k]) == pytest.approx(
            product[:, k], rel=1e-5 if dtype == torch.float32 else 1e-12
        )
    # an amount that leaves the cell enters the medium: both are multiplied by the volume
    assert array(change[3]) == pytest.approx(array(found[5] - found[6]), rel=1e-6)


def test_stoichiometry():
    net = build_network(parts(), SPECIES, SIGNALS)
    assert net.names == ("luxi", "ahl", "yfp", "out.ahl")
    assert net.stoichiometry.tolist() == [
        [1, 0, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 1, 0],
        [-1, 0, 0, 0],
        [0, -1, 0, 0],
        [0, -1, 0, 1],
        [0, 1, 0, -1],
        [-1, -2, 1, 0],
    ]
    assert net.parameters == ("k3", "K", "D1")
    # luxi: a power of 1.5 in a repression, rounded up; ahl: squared; nothing reads yfp; the
    # membrane reads out.ahl as it is
    assert net.orders.tolist() == [2, 2, 0, 1]


@pytest.mark.parametrize("power, order", [(0.5, 1), (1.0, 1), (1.5, 2), (2, 2), (2.1, 3), ("n", 4)])
def test_the_order_of_a_promoter_is_its_power_rounded_up(power, order):
    for part in (activated, repressed):
        assert part("a", "b", 1.0, 1.0, power=power)[0].order == order


def test_equations_are_read():
    r = Reaction.of("2 a + b -> c + out.x + a", rate="k")
    assert dict(r.consumes) == {"a": 2, "b": 1} and dict(r.produces) == {"c": 1, "out.x": 1, "a": 1}
    assert r.change() == {"a": -1, "b": -1, "c": 1, "out.x": 1}
    assert str(r) == "2 a + b -> c + out.x + a"
    assert dict(Reaction.of(" -> a", 1.0).consumes) == {} and dict(
        Reaction.of("3a -> 0", 1.0).consumes
    ) == {"a": 3}
    assert dict(Reaction.of("a + a -> b", 1.0).consumes) == {"a": 2}
    copy = pickle.loads(pickle.dumps(r))
    assert str(copy) == str(r) and copy.rate == "k"
    with pytest.raises(TypeError):
        r.consumes["a"] = 5
    assert pickle.loads(pickle.dumps(activated("a", "b", 1.0, 0.5)[0])).name == "a activated by b"


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Reaction({"a": 1}, {"a": 1}, 1.0), "changes something"),
        (lambda: Reaction({}, {}, 1.0), "changes something"),
        (lambda: Reaction({"a": 0}, {"b": 1}, 1.0), "whole number from 1"),
        (lambda: Reaction({"a": 1.5}, {"b": 1}, 1.0), "whole number from 1"),
        (lambda: Reaction({"a b": 1}, {}, 1.0), "name of a species"),
        (lambda: Reaction(["a"], {}, 1.0), "mapping"),
        (lambda: Reaction({"a": 1}, {}, -1.0), "at least 0"),
        (lambda: Reaction({"a": 1}, {}, float("nan")), "finite"),
        (lambda: Reaction({"a": 1}, {}, torch.tensor([1.0, -1.0])), r"rate\[1\]"),
        (lambda: Reaction({"a": 1}, {}, "no name"), "parameter's name"),
        (lambda: Reaction({"a": 1}, {}, None), "rate"),
        (lambda: Reaction({"a": 1}, {}, 1.0, order=0), "whole number from 1"),
        (lambda: Reaction.of("a = b", 1.0), "arrow"),
        (lambda: Reaction.of("a -> b -> c", 1.0), "arrow"),
        (lambda: Reaction.of("a + -> b", 1.0), "terms"),
        (lambda: Reaction.of("2.5 a -> b", 1.0), "terms"),
        (lambda: activated("a", "b", 1.0, 0.0), "above 0"),
        (lambda: repressed("a", "b", -1.0, 1.0), "at least 0"),
        (lambda: conversion("a", enzyme="e", rate=1.0, half=0.0), "above 0"),
        (lambda: build_network([], ["a"]), "at least one"),
        (
            lambda: build_network([degradation("lux1", 1.0)], ["luxi"]),
            "unknown name 'lux1'; known are luxi. Did you mean 'luxi'",
        ),
        (
            lambda: build_network([activated("a", "bee", 1.0, 1.0)], ["a", "be"]),
            "Did you mean 'be'",
        ),
        (lambda: build_network([exchange("a", 1.0)], ["a"], ["b"]), "unknown name 'out.a'"),
        (
            lambda: build_network([degradation("a", 1.0), degradation("a", 2.0)], ["a"]),
            "used only once",
        ),
        (lambda: build_network([degradation("a", 1.0)], ["a", "a"]), "different names"),
        (lambda: build_network([degradation("a", 1.0)], "a"), "sequence of names"),
    ],
)
def test_what_makes_no_sense_is_refused(make, words):
    with pytest.raises(tf.InputError, match=words):
        make()


def test_missing_parameters_are_named():
    u, s, p, cell = world()
    with pytest.raises(tf.InputError, match=r"p has no 'k4'; known are k3, K, D1"):
        build_network([constitutive("luxi", "k4")], SPECIES).concentration_rates(u, s, p, cell)


def test_gradient_of_rates():
    u, s, p, cell = world(3)
    net = build_network(parts(), SPECIES, SIGNALS)

    def rates(x, outside, k3):
        return torch.stack(
            net.concentration_rates(
                Names(SPECIES, x),
                Names(SIGNALS, outside),
                Names(("k3", "K", "D1"), [k3, p.K, p.D1]),
                cell,
            )
        )

    x = torch.stack([u.luxi, u.ahl, u.yfp], 1).requires_grad_()
    assert torch.autograd.gradcheck(
        rates,
        (
            x,
            s.ahl.unsqueeze(1).requires_grad_(),
            torch.tensor(0.9, dtype=torch.float64, requires_grad=True),
        ),
    )


def test_propensities_count_combinations(device, dtype):
    """k Ω n(n − 1)/Ω² for 2 a; rate times Ω for functions; whole molecules only; a signal by its
    pool.
    """
    net = build_network(
        [
            Reaction.of("2 a -> b", 0.5),
            Reaction.of("-> a", 3.0),
            Reaction.of("out.x -> a", "k"),
            conversion("a", enzyme="b", rate=2.0, half=0.7),
        ],
        ["a", "b"],
        ["x"],
    )
    counts = torch.tensor(
        [[5.0, 2.0, 3.75], [1.0, 0.0, 0.75], [0.0, 1.0, 0.0]], device=device, dtype=dtype
    )
    volume, pool = (
        torch.tensor([2.0, 3.0, 1.0], device=device, dtype=dtype),
        torch.tensor([10.0, 20.0, 30.0], device=device, dtype=dtype),
    )
    cell = Names(("volume",), [volume], "cell")
    p = Names(("k",), [0.4], "p")
    a = array(net.propensities(counts, p, cell, molecules_per_unit=10.0, pool=pool))
    assert a.shape == (3, 4)
    assert a[:, 0] == pytest.approx([0.5 * 5 * 4 / 20, 0, 0], rel=1e-6)
    assert a[:, 1] == pytest.approx([60, 90, 30], rel=1e-6)
    assert a[:, 2] == pytest.approx([0.4 * 20 * 3 / 100, 0, 0], rel=1e-6)
    assert a[:, 3] == pytest.approx([2 * 2 * 0.25 / (0.7 + 0.25), 0, 0], rel=1e-6)
    assert torch.equal(
        net.propensities(counts, p, cell, molecules_per_unit=10.0, pool=pool.unsqueeze(1)),
        net.propensities(counts, p, cell, molecules_per_unit=10.0, pool=pool),
    )
    with pytest.raises(tf.InputError, match="pool"):
        net.propensities(counts, p, cell)


def test_both_ways_of_running_agree():
    """With many molecules, the mean of the stochastic run is the deterministic solution.

    For dimerisation among 1,000 molecules, fluctuations shift the mean by a few molecules; 1 % is
    10 of them. The sample's standard error is 1.
    """
    net = build_network(
        [
            constitutive("a", 5.0),
            Reaction.of("2 a -> b", 0.3),
            degradation("a", 1.0),
            degradation("b", 0.5),
        ],
        ["a", "b"],
    )
    none, cells, molecules_per_unit = Names((), ()), 300, 300.0
    cell = lambda n: Names(("volume",), [torch.full((n,), 1.0, dtype=torch.float64)])

    def smooth(u, rows):
        return torch.stack(
            net.changes(net.concentration_rates(Names(("a", "b"), u), none, none, cell(len(rows)))),
            1,
        )

    u, _ = rodas3(smooth, torch.tensor([[0.0, 0.0]], dtype=torch.float64), 1.0, rtol=1e-6)
    rows = torch.arange(cells)
    draw = KeyedDraws(1, torch.zeros_like(rows), rows, 0)
    counts, report = direct(
        torch.zeros(cells, 2, dtype=torch.float64),
        lambda n, rows: net.propensities(
            n, none, cell(len(rows)), molecules_per_unit=molecules_per_unit
        ),
        net.stoichiometry,
        1.0,
        draw,
    )
    assert (report.status == DONE).all()
    # a mass action rate k c² takes two molecules an event: d[a]/dt = −2 k [a]²
    assert array(counts.mean(0)) / molecules_per_unit == pytest.approx(array(u)[0], rel=0.01)


@pytest.mark.parametrize("method", ["rosenbrock", "direct"])
@pytest.mark.parametrize(
    "rate", [lambda u, s, p, cell: p.k, lambda *_: 2.0, lambda *_: np.float32(2)]
)
def test_the_function_of_a_reaction_may_give_one_number(rate, method):
    circuit = tf.Circuit([tf.Reaction({}, {"a": 1}, rate)], species="a", method=method, k=2.0)
    column = torch.ones(3, dtype=torch.float64)
    found = circuit.graph.evaluate({"a": column, "k": 2.0})
    assert (torch.zeros(3) + found["a"]).tolist() == [2.0] * 3


@pytest.mark.parametrize("rate", [lambda u, s, p, cell: {"a": u.a}, lambda u, s, p, cell: None])
def test_the_function_of_a_reaction_gives_no_rates_by_name(rate):
    circuit = tf.Circuit([tf.Reaction({}, {"a": 1}, rate)], species="a")
    with pytest.raises(tf.InputError, match=r"reaction 0 -> a.*returned.*one rate for each cell"):
        tf.Scene(circuit).bind().start()


def test_a_constant_of_mass_action_is_not_negative():
    """Also where it is a parameter, in a part; in a function it may be."""
    part = [[tf.Reaction.of("a -> b", "k")]]
    with pytest.raises(tf.InputError, match=r"Circuit\.k = -1\.0.*at least 0"):
        tf.Circuit(part, species=("a", "b"), k=-1.0)
    tf.Circuit(lambda u, s, p, cell: {"a": p.k * u.a}, species="a", k=-1.0)
