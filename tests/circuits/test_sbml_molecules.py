"""Models of SBML and Antimony that run molecule by molecule: their reactions, moments against
theory, and what has no whole molecules."""

from __future__ import annotations

import math

import pytest
import torch
from modelled import QUORUM

import torchfilm as tf

BIRTH = "species a; make: -> a; k; lose: a -> ; d*a; k = 0.4; d = 0.05; a = 2;"
CELL = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], length=[3.0])
read = tf.Circuit.from_antimony


def reactions_of(text, **given):
    circuit = read(text, method="direct", **given)
    return next(iter(circuit.rates.values()))


def sides(text, **given):
    return {x.name: (dict(x.consumes), dict(x.produces)) for x in reactions_of(text, **given)}


def grown(text, hours, colonies=400, **given):
    """Molecules of each species in one cell that does not grow, and its volume."""
    circuit = read(text, molecules_per_unit=1.0, **given)
    scene = tf.Scene(circuit, founders=CELL, dim=2, dt=0.05)
    *_, state = tf.simulate(scene, until=hours, colonies=colonies, seed=1)
    counts = {n: (state.fields[n] * state.volume).double() for n in circuit.species}
    return counts, float(state.volume[0])


@pytest.mark.parametrize("method", ["direct", "tau_leap"])
@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_birth_and_death_are_as_poisson_has_them(method, backend):
    """In a model in minutes, at rest: mean and variance k V/d."""
    counts, volume = grown(BIRTH, 2.0, method=method, backend=backend, time_unit="min")
    a = counts["a"]
    assert torch.allclose(a, a.round(), atol=1e-3)
    mean = 0.4 / 0.05 * volume  # 23 molecules; founders begin with 2 V, of which exp(−6) is left
    error = math.sqrt(mean / len(a))
    assert abs(float(a.mean()) - mean) < 4 * error
    # the variance of a variance of n Poisson draws is (2 mean² + mean)/n
    assert abs(float(a.var()) - mean) < 4 * math.sqrt((2 * mean**2 + mean) / len(a))


def test_a_law_that_is_a_difference_goes_both_ways():
    """Molecules that change between two forms are divided by chance: binomially."""
    text = """
      species a, b;
      turn: a -> b; f*a - r*b
      f = 3; r = 1; a = 10; b = 0;
    """
    assert sides(text) == {
        "turn": ({"a": 1}, {"b": 1}), "turn backwards": ({"b": 1}, {"a": 1}),
    }  # fmt: skip
    counts, volume = grown(text, 3.0, method="direct")
    a, b = counts["a"], counts["b"]
    number = round(10 * volume)
    assert torch.allclose(a + b, torch.full_like(a, number), atol=1)
    share = 0.25
    assert abs(float(a.mean()) - share * number) < 4 * math.sqrt(number * 0.1875 / len(a))
    assert float(a.var()) == pytest.approx(number * share * (1 - share), rel=0.3)


ONE_WAY = r"the law of the reaction 'turn' can be below 0, where nothing happens"


def test_what_is_left_of_a_total_goes_one_way():
    """A form that the model does not count is the rest of a total: as two reactions, one would take
    what is not there, and the other make noise. Binomial again."""
    text = """
      species a, b;
      lose: a -> b; f*a
      turn: b -> a; r*(total - a)
      f = 1; r = 1; a = 10; b = 0; total = 10;
    """
    with pytest.warns(UserWarning, match=ONE_WAY):
        assert sides(text) == {"lose": ({"a": 1}, {"b": 1}), "turn": ({"b": 1}, {"a": 1})}
    with pytest.warns(UserWarning, match=ONE_WAY):
        counts, volume = grown(text, 4.0, method="direct")
    number, a = round(10 * volume), counts["a"]
    assert abs(float(a.mean()) - number / 2) < 4 * math.sqrt(number / 4 / len(a)) + 0.5
    assert float(a.var()) == pytest.approx(number / 4, rel=0.3)


def test_pairs_of_few_molecules():
    """Two molecules meet n(n − 1) ways, n/V of which a law writes as a less a single molecule's
    concentration; the mean time until one of 2 is left is as in the chain of states."""
    text = "species a, b; turn: 2 a -> b; k*a*(a - one); k = 1; a = 0; b = 0; one = 1;"
    volume = float(tf.Scene(tf.Growth(rate=1.0), founders=CELL, dim=2).bind().start().volume[0])
    with pytest.warns(UserWarning, match=ONE_WAY):
        counts, _ = grown(text, 0.4, method="direct", one=1 / volume, initial={"a": 4 / volume})
    fast, slow = 12 / volume, 2 / volume  # k n(n − 1)/V from 4 and from 2 molecules
    left = {  # the probabilities of 4, 2 and 0 after 0.4 h
        4: math.exp(-0.4 * fast),
        2: fast / (fast - slow) * (math.exp(-0.4 * slow) - math.exp(-0.4 * fast)),
    }
    found = counts["a"].round()
    for number, chance in left.items():
        error = math.sqrt(chance * (1 - chance) / len(found))
        assert abs(float((found == number).double().mean()) - chance) < 4 * error


@pytest.mark.parametrize(
    ("text", "ways"),
    [
        ("turn: -> a; kin - kout*a; kin = 1; kout = 1;", 2),
        ("turn: a -> ; kout*a - kin; kin = 1; kout = 1;", 2),
        ("turn: -> a; D*(out - a); D = 3; out = 2;", 2),
        ("turn: a -> ; -(kin - kout*a); kin = 1; kout = 1;", 2),
        ("turn: -> a; kin + (-kout*a) + more; kin = 1; kout = 1; more = 2;", 2),
        ("turn: -> a; k*a*(1 - a/K); k = 1; K = 5;", 2),
        # never below 0: what is made falls with what is there
        ("turn: -> a; k*(1 - b/(1 + b)); k = 1; species b; b = 0.3;", 1),
        ("turn: -> a; k*(1 - a/(1 + a)); k = 1;", 1),
        ("turn: a -> b; k*a*(1 - b/(K + b)); k = 1; K = 2; species b; b = 0;", 1),
        ("turn: a -> b; v*(a - b/q)/(1 + a + b); v = 1; q = 2; species b; b = 0;", 2),
        ("turn: a -> b; -(r*b - f*a)*v; v = 1; f = 2; r = 1; species b; b = 0;", 2),
        ("turn: a -> b; f*a; f = 1; species b; b = 0;", 1),
        ("turn: a -> b; (f - r*b)*a; f = 5; r = 1; species b; b = 0;", 2),
        ("compartment c = 2; species d in c; turn: -> d; c*m - c*n*d; m = 1; n = 1; d = 0;", 2),
    ],
)
def test_only_what_goes_back_is_a_reaction_back(text, ways):
    text = f"species a; a = 1; {text}"
    found = reactions_of(text)
    assert [x.name for x in found] == ["turn", "turn backwards"][:ways]
    # together they are the law
    one, other = read(text), read(text, method="direct")
    values = {"a": 0.7, "b": 0.4, "d": 0.3, **one.parameters}
    wanted, made = (
        c.graph.evaluate({n: x for n, x in values.items() if n in (*c.species, *c.parameters)})
        for c in (one, other)
    )
    assert all(float(made[n]) == pytest.approx(float(x), rel=1e-12) for n, x in wanted.items())


def test_what_reactions_make_together_are_the_rates():
    """The stiff solver, on the reactions and on the equations of one model."""
    text = """
      species a, b, c;
      make: -> 2 a; k/(1 + c^2)
      pair: 2 a -> b; q*a^2 - r*b
      turn: b -> c; v*b/(K + b)
      lose: c -> ; d*c
      k = 4; q = 2; r = 1; v = 3; K = 0.5; d = 0.7; a = 0.5; b = 0.2; c = 0.1;
    """
    ends = []
    for circuit in (read(text), tf.Circuit(
        reactions_of(text), species=("a", "b", "c"),
        initial={"a": 0.5, "b": 0.2, "c": 0.1}, k=4, q=2, r=1, v=3, K=0.5, d=0.7,
    )):  # fmt: skip
        scene = tf.Scene(circuit, founders=CELL, dim=2, dt=0.05)
        *_, state = tf.simulate(scene, until=1.0, dtype=torch.float64)
        ends.append(torch.stack([state.fields[n] for n in "abc"]))
    assert torch.allclose(*ends, rtol=1e-9)


def test_signals_take_whole_molecules_and_none_is_lost():
    circuit = read(
        QUORUM, signals={"ahl_out": "ahl"}, without=("make", "lose", "synthesis"), method="direct",
        molecules_per_unit=20.0, initial={"ahl": 4.0},
    )  # fmt: skip
    found = {x.name: (dict(x.consumes), dict(x.produces)) for x in circuit.rates["every cell"]}
    out = ({"ahl": 1}, {"out.ahl": 1})
    assert found == {"leave": out, "leave backwards": out[::-1]}
    medium = tf.Medium(ahl=tf.Signal(diffusion=50.0), box=((-8, -8), (8, 8)), spacing=4.0)
    model = tf.Scene(circuit, medium, founders=CELL, dim=2).bind()
    first = state = model.start()
    for _ in range(4):
        state = model.step(state, 0.05)
    inside = lambda s: 20 * float((s.ahl * s.volume).sum())
    outside = lambda s: 20 * float(s.signals["ahl"].sum()) * s.layout.grid.voxel_volume
    assert 0 < inside(state) < inside(first)
    assert inside(state) == pytest.approx(round(inside(state)), abs=1e-3)
    assert inside(state) + outside(state) == pytest.approx(round(inside(first)), abs=1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("species a; a' = 1 - a; a = 0;", "'a' has a rate rule"),
        ("species a; make: -> a; k*time; k = 1; a = 0;", "'make' depends on the time"),
        ("species a; make: -> 1.5 a; k; k = 1; a = 0;", "a number that is not whole"),
        (
            "compartment c = 1, n = 2; species a in c, b in n; go: a -> b; k*a; k = 1; a = 1",
            "'a' and 'b', which are in compartments of their own",
        ),
        (
            "species a, $b; go: $b -> ; k*b; k = 1; a = 1; b = 1;",
            "no reaction of the model changes",
        ),
    ],
)
def test_what_has_no_whole_molecules_is_refused(text, words):
    with pytest.raises(tf.InputError, match=words):
        read(text, method="tau_leap")


def test_an_inhibited_law_stays_one_way_beside_one_that_goes_back():
    law = "k*a/(1 + b)*(1 - b/(2 + b)) - r*b"
    first, back = reactions_of(f"species a, b; turn: a -> b; {law}; k = 1; r = 2; a = 1; b = 0;")
    assert (first.rate.reads, back.rate.reads) == (("a", "b"), ("b",))


@pytest.mark.parametrize(
    ("text", "sides_wanted"),
    [
        ("species a, A; J: -> A; k*a; k = 2; a = 1; A = 0;", ({}, {"out.A": 1})),
        ("species a, A; J: A -> ; k*a*A; k = 2; a = 1; A = 0;", ({"out.A": 1}, {})),
    ],
)
def test_a_species_that_makes_or_takes_a_signal(text, sides_wanted):
    text += "keep: -> a; l; l = 1;"
    assert sides(text, signals={"A": "A"})["J"] == sides_wanted
    with pytest.raises(tf.InputError, match="'J' happens outside of cells"):
        read("species a, A; J: -> A; k; keep: -> a; l; k = 2; l = 1; a = 1; A = 0;",
             signals={"A": "A"}, method="direct")  # fmt: skip
