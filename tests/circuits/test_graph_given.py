"""The graph of a circuit: laws below zero, sums that only seem conserved, and bad input."""

from __future__ import annotations

import pytest
import torch

import torchfilm as tf
from torchfilm import kinetics
from torchfilm.circuits.formulas import text
from torchfilm.circuits.graph import evaluated

K, N = 0.8, 3.0
LAWS = {
    "activation": lambda u, s, p, cell: {"a": kinetics.activation(u.a - u.b, p.k, p.n)},
    "repression": lambda u, s, p, cell: {"a": kinetics.repression(u.a - u.b, p.k, p.n)},
    "michaelis_menten": lambda u, s, p, cell: {"a": kinetics.michaelis_menten(u.a - u.b, p.k)},
}


@pytest.mark.parametrize("a", [0.5, 1.7])
@pytest.mark.parametrize("law", LAWS)
def test_slopes_of_a_law_are_those_of_autograd_below_zero_too(law, a):
    given = {"k": K} if law == "michaelis_menten" else {"k": K, "n": N}
    graph = tf.Circuit(LAWS[law], species=("a", "b"), **given).graph
    at = {"a": a, "b": 1.2} | given
    values = {n: torch.tensor(x, dtype=torch.float64, requires_grad=True) for n, x in at.items()}
    rate = graph.evaluate(values)["a"]
    wanted = dict(zip(values, torch.autograd.grad(rate, list(values.values())), strict=True))
    for by in ("species", "parameters"):
        for (_, name), slope in graph.jacobian(by).items():
            (found,) = evaluated([slope], lambda leaf: values[text(leaf)].detach())
            assert float(found) == pytest.approx(float(wanted[name]), rel=1e-9, abs=1e-12), name


def test_a_law_is_printed_with_what_it_takes_below_zero():
    graph = tf.Circuit(LAWS["activation"], species=("a", "b"), k=K, n=N).graph
    assert str(graph).startswith("d a/dt = max(a − b, 0)^n/(k^n + max(a − b, 0)^n)\n")
    assert r"\operatorname{max}\left(\mathrm{a} - \mathrm{b}, 0\right)" in graph._repr_latex_()


@pytest.mark.parametrize(
    "lost",
    [
        lambda u, p, cell: torch.clamp(u.b - 5.0, min=0.0),
        lambda u, p, cell: torch.where(cell.time > 3.0, p.k, 0.0 * u.a),
        lambda u, p, cell: kinetics.activation(u.b, 1000.0, 8.0),
    ],
    ids=["above 5", "after 3 h", "by a high threshold"],
)
def test_a_sum_that_is_lost_far_away_is_not_conserved(lost):
    def rates(u, s, p, cell):
        return {"a": -p.k * u.a, "b": p.k * u.a - lost(u, p, cell)}

    assert tf.Circuit(rates, species=("a", "b"), k=0.3).graph.conserved == []
    kept = lambda u, s, p, cell: {"a": -p.k * u.a, "b": p.k * u.a}
    assert tf.Circuit(kept, species=("a", "b"), k=0.3).graph.conserved == [{"a": 1, "b": 1}]


def test_sums_with_large_numbers_and_of_rates_that_are_not_finite():
    many = [tf.Reaction({"a": 30}, {"b": 29}, lambda u, s, p, cell: u.a)]
    assert tf.Circuit(many, species=("a", "b")).graph.conserved == [{"a": 29, "b": 30}]
    some = lambda u, s, p, cell: {"a": torch.log(u.a - 5.0), "b": -torch.log(u.a - 5.0)}
    assert tf.Circuit(some, species=("a", "b")).graph.conserved == [{"a": 1, "b": 1}]
    never = lambda u, s, p, cell: {"a": torch.log(-u.a), "b": -torch.log(-u.a)}
    assert tf.Circuit(never, species=("a", "b")).graph.conserved == []


def decay(u, s, p, cell):
    return {"a": -p.k * u.a}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"a": "x", "k": 1.0}, r"values\['a'\] = 'x' is not allowed: it must be numbers"),
        ({"a": torch.ones(3), "k": torch.ones(2)}, r"a \(3,\), k \(2,\).* one shape"),
        ({"a": 1.0, "k": 1.0, "zz": 1.0}, "values have 'zz'; known are"),
        ({"a": 1.0}, "values lack 'k'"),
    ],
)
def test_bad_values_are_refused(values, words):
    with pytest.raises(tf.InputError, match=words):
        tf.Circuit(decay, species="a", k=1.0).graph.evaluate(values)


@pytest.mark.parametrize("rate", [None, "x"])
def test_a_rate_that_is_no_number_is_named(rate):
    with pytest.raises(tf.InputError, match=r"the rate of 'a' = .* a column or a number"):
        _ = tf.Circuit(lambda u, s, p, cell: {"a": rate}, species="a").graph


def test_a_constant_with_the_name_of_a_species_has_a_value_of_its_own():
    graph = tf.Circuit(lambda u, s, p, cell: {"k": p.k - 2 * u.k}, species="k", k=10.0).graph
    assert float(graph.evaluate({"k": 3.0, "p.k": 10.0})["k"]) == 4.0
    with pytest.raises(tf.InputError, match=r"values lack 'p\.k'"):
        graph.evaluate({"k": 3.0})
