"""The equations of a circuit as an object: derivatives, texts, what is conserved and what is
read."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from helpers import array
from matplotlib.mathtext import MathTextParser
from traced import again, traced

import torchfilm as tf
from torchfilm import parts
from torchfilm.circuits.expressions import DERIVATIVES, LOGICAL, derivatives
from torchfilm.circuits.formulas import latex
from torchfilm.circuits.graph import OPERATIONS, evaluated
from torchfilm.circuits.tracing import Column
from torchfilm.tools.deterministic_math import deterministic_functions

F64 = torch.float64
kinetics = tf.kinetics

# Expressions of two columns, between 0.1 and 0.9, that together use every operation with slopes.
SMOOTH = {
    "add sub mul div": lambda x, y: (x + y) / (x * y - 2.0) - 3.0 / x,
    "neg abs": lambda x, y: -x * (x - y).abs(),
    "exp expm1": lambda x, y: torch.exp(x * y) + torch.expm1(-y),
    "log log1p log2 log10": lambda x, y: (
        torch.log(x) + torch.log1p(y) + torch.log2(x + y) * torch.log10(y)
    ),
    "sqrt": lambda x, y: torch.sqrt(x * y) + torch.rsqrt(x),
    "sin cos tan": lambda x, y: torch.sin(x) * torch.cos(y) + torch.tan(x * y),
    "tanh atan atanh": lambda x, y: torch.tanh(x) + torch.atan(x / y) * torch.atanh(y),
    "sinh cosh": lambda x, y: torch.sinh(x) * torch.cosh(x * y),
    "pow": lambda x, y: x**2 + y**-1.5 + x**y + (x + y) ** 3 + 2.5**x + x**0.5 + y**1,
    "exp2 hypot logaddexp": lambda x, y: torch.exp2(x) + torch.hypot(x, y) * torch.logaddexp(x, y),
    "sigmoid softplus": lambda x, y: torch.sigmoid(x / y) + torch.nn.functional.softplus(y - x),
    "silu elu": lambda x, y: torch.nn.functional.silu(x - y) + torch.nn.functional.elu(y - x),
    "minimum maximum": lambda x, y: torch.minimum(x, y * y) * torch.maximum(x, 0.5 * y),
    "remainder floor sign": lambda x, y: (
        torch.remainder(5 * x, y) + torch.floor(4 * x) * y + torch.sign(x - y) * x
    ),
    "where": lambda x, y: torch.where(x > y, x * y, torch.where(y > 0.5, x / y, 1.0)),
    "detach": lambda x, y: x.detach() * y + (x * y).detach() * x,
    "cast64": lambda x, y: (x > y).to(torch.float64) * x * y,
    "activation": lambda x, y: (
        kinetics.activation(x, y, 2.5) + kinetics.activation(x, 0.5) + kinetics.activation(x, y, x)
    ),
    "repression": lambda x, y: (
        kinetics.repression(x, y, 2) * kinetics.repression(y, x)
        + kinetics.repression(x, 0.5, y + 1)
    ),
    "michaelis_menten": lambda x, y: (
        kinetics.michaelis_menten(x, y) * kinetics.michaelis_menten(y, 2.0)
    ),
}  # fmt: skip
FLAT = {*LOGICAL, "floor", "sign", "where", "detach", "full32", "full64"}


def slopes(rate, **columns) -> dict[str, torch.Tensor]:
    """∂/∂ of each column by the graph, at these numbers."""
    found = traced(rate, **columns)
    out = {}
    for name in columns:
        by = found.builder.name(name)
        slope = derivatives(found.builder, [found.expression], by).get(found.expression)
        number = found.builder.number(0.0) if slope is None else slope
        made = Column.of(number, found.builder, F64)
        out[name] = again(made, **columns) + torch.zeros_like(columns[name])
    return out


def by_autograd(rate, **columns) -> dict[str, torch.Tensor]:
    leaves = {n: x.clone().requires_grad_() for n, x in columns.items()}
    with deterministic_functions():
        grads = torch.autograd.grad(rate(**leaves).sum(), leaves.values(), allow_unused=True)
    zero = torch.zeros(1, dtype=F64)
    return {n: zero if g is None else g for n, g in zip(leaves, grads, strict=True)}


@pytest.mark.parametrize("kind", list(SMOOTH))
def test_derivatives_are_those_of_autograd(kind):
    """On random values: ten digits, of values up to some hundreds."""
    g = torch.Generator().manual_seed(1)
    x, y = (0.1 + 0.8 * torch.rand(200, generator=g, dtype=F64) for _ in range(2))
    found, expected = slopes(SMOOTH[kind], x=x, y=y), by_autograd(SMOOTH[kind], x=x, y=y)
    for name in found:
        want = array(expected[name] + torch.zeros_like(x))
        assert array(found[name]) == pytest.approx(want, rel=1e-10, abs=1e-12), name


def test_every_operation_has_a_derivative_that_is_tested():
    assert set(OPERATIONS) - set(DERIVATIVES) == FLAT
    assert set(DERIVATIVES) - {n for kind in SMOOTH for n in kind.split()} == {"cast32"}


@pytest.mark.parametrize("name", ["activation", "repression", "michaelis_menten"])
@pytest.mark.parametrize("power", [1, 1.5, 2, 4, "p"])
def test_laws_have_finite_derivatives_at_zero(name, power):
    x, half = torch.zeros(3, dtype=F64), torch.tensor([0.5, 1.0, 2.0], dtype=F64)
    n = torch.tensor([1.0, 2.0, 2.5], dtype=F64)
    law = getattr(kinetics, name)
    if name == "michaelis_menten":
        rate = lambda x, half, n: law(x, half)
    else:
        rate = lambda x, half, n: law(x, half, n if power == "p" else power)
    found, expected = (f(rate, x=x, half=half, n=n) for f in (slopes, by_autograd))
    for name in found:
        want = array(expected[name] + torch.zeros(3, dtype=F64))
        assert array(found[name]) == pytest.approx(want, abs=1e-14), name


def test_powers_at_zero():
    x, n = torch.zeros(2, dtype=F64), torch.tensor([1.0, 2.0], dtype=F64)
    for rate in (lambda x, n: x**n, lambda x, n: x**2 + x**1 + x**0 * n, lambda x, n: x**1.5):
        found, expected = slopes(rate, x=x, n=n), by_autograd(rate, x=x, n=n)
        for name in found:
            assert array(found[name]).tolist() == array(expected[name] + 0 * x).tolist()


def test_the_jacobian_by_species_and_by_parameters():
    circuit = enzyme()
    values = {"s": 0.7, "e": 0.3, "es": 0.2, "k1": 2.0, "k2": 0.5, "k3": 3.0, "unused": 1.0}
    graph = circuit.graph
    expected = {
        ("s", "s"): -2.0 * 0.3, ("s", "e"): -2.0 * 0.7, ("s", "es"): 0.5,
        ("e", "s"): -2.0 * 0.3, ("e", "e"): -2.0 * 0.7, ("e", "es"): 3.5,
        ("es", "s"): 2.0 * 0.3, ("es", "e"): 2.0 * 0.7, ("es", "es"): -3.5, ("pr", "es"): 3.0,
    }  # fmt: skip
    assert at(graph.jacobian(), values) == pytest.approx(expected)
    by = at(graph.jacobian(by="parameters"), values)
    assert by[("s", "k1")] == pytest.approx(-0.21) and by[("pr", "k3")] == 0.2
    assert ("pr", "k1") not in by and not any(n == "unused" for _, n in by)
    assert float(graph.evaluate(values)["pr"]) == pytest.approx(0.6)
    assert "('pr', 'es'): k3" in str(graph.jacobian())
    with pytest.raises(tf.InputError, match="by"):
        graph.jacobian(by="time")
    with pytest.raises(tf.InputError, match="values lack 'es'"):
        graph.evaluate({n: x for n, x in values.items() if n != "es"})


def at(entries, values) -> dict:
    """The numbers of some expressions."""
    leaf = lambda e: torch.tensor(values[str(e)], dtype=F64)
    found = evaluated(list(entries.values()), leaf)
    return {n: float(x) for n, x in zip(entries, found, strict=True)}


# --- texts ----------------------------------------------------------------------------------------

WRITTEN = {
    "a − (b − c)": lambda a, b, c: a - (b - c),
    "a − b − c": lambda a, b, c: a - b - c,
    "a + b − c": lambda a, b, c: a + (b - c),
    "a/(b·c)": lambda a, b, c: a / (b * c),
    "a/b·c": lambda a, b, c: a / b * c,
    "a·b/c": lambda a, b, c: a * (b / c),
    "a/(b/c)": lambda a, b, c: a / (b / c),
    "−(a + b)": lambda a, b, c: -(a + b),
    "a·2·b": lambda a, b, c: a * (b * 2.0),
    "−a·b": lambda a, b, c: -a * b,
    "a·(−b)": lambda a, b, c: a * -b,
    "a − (−b)": lambda a, b, c: a - -b,
    "a − b": lambda a, b, c: a + -b,
    "a + 2": lambda a, b, c: a - -2.0,
    "a·(b + 2)": lambda a, b, c: a * (b - -2.0),
    "−2·a − 1": lambda a, b, c: a * -2.0 + -1.0,
    "−(−a)": lambda a, b, c: (-a).neg(),
    "(a + b)^c": lambda a, b, c: (a + b) ** c,
    "a^(b + c)": lambda a, b, c: a ** (b + c),
    "(a^2)^c": lambda a, b, c: (a**2) ** c,
    "(−a)^2": lambda a, b, c: (-a) ** 2,
    "−a^2": lambda a, b, c: -(a**2),
    "(a/b)^2": lambda a, b, c: (a / b) ** 2,
    "2/(a + 1)": lambda a, b, c: 2.0 / (1.0 + a),
    "(a > b) + c": lambda a, b, c: (a > b) + c,
    "(a if a > b + c, else (b if c < 1, else 2))": lambda a, b, c: torch.where(
        a > b + c, a, torch.where(c < 1, b, 2.0)
    ),
    "(a if (a > b) and not(b > c), else 0)": lambda a, b, c: torch.where(
        (a > b) & ~(b > c), a, 0.0
    ),
    "(a + b)/(c + (a + b))": lambda a, b, c: kinetics.michaelis_menten(a + b, c),
    "a·c^2/(c^2 + b^2)": lambda a, b, c: a * kinetics.repression(b, c, 2),
    "exp(−a)·max(b, 0)": lambda a, b, c: torch.exp(-a) * b.clamp(min=0),
    "1e-05·a": lambda a, b, c: 1e-5 * a,
    "a": lambda a, b, c: torch.zeros_like(a) + a * torch.ones_like(b),
}  # fmt: skip


def as_parameters(rate):
    """The expression of a rate of three constants."""
    found = traced(rate_of_names(rate), **{f"p.{n}": torch.ones(1, dtype=F64) for n in "abc"})
    return found.expression


def rate_of_names(rate):
    return lambda **columns: rate(*columns.values())


@pytest.mark.parametrize("text", list(WRITTEN))
def test_equations_as_text(text):
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"a": WRITTEN[text](u.a, u.b, u.c)}, species=("a", "b", "c")
    )
    assert str(circuit.graph.rates["a"]) == text


@pytest.mark.parametrize("text", list(WRITTEN))
def test_texts_mean_what_is_computed(text):
    """The text read as Python gives the same number."""
    values = {"a": 1.7, "b": 0.6, "c": 2.3}
    found = traced(WRITTEN[text], **{n: torch.tensor([x], dtype=F64) for n, x in values.items()})
    expected = float(WRITTEN[text](**{n: torch.tensor([x], dtype=F64) for n, x in values.items()}))
    read = str(found.expression).replace("·", "*").replace("−", "-").replace("^", "**")
    read = read.replace(", else", " else") if "max" not in read else read
    assert eval(read, {"exp": np.exp, **values}) == pytest.approx(expected)


@pytest.mark.parametrize("text", list(WRITTEN))
def test_equations_as_latex(text):
    """Braces are balanced, and matplotlib draws what it knows (it has no cases)."""
    tex = latex(as_parameters(WRITTEN[text]))
    depth = list(itertools.accumulate((x == "{") - (x == "}") for x in tex))
    assert min(depth, default=0) >= 0 and not (depth and depth[-1])
    assert tex.count(r"\left(") == tex.count(r"\right)")
    if "cases" not in tex:
        MathTextParser("path").parse(f"${tex}$")


def test_latex_literally():
    tex = lambda rate: latex(as_parameters(rate))
    a, b, c = (rf"\mathrm{{{n}}}" for n in "abc")
    assert tex(lambda a, b, c: (a / b) ** 2 * c) == (
        rf"{{\left(\frac{{{a}}}{{{b}}}\right)}}^{{2}}\,{c}"
    )
    assert tex(lambda a, b, c: a * -b) == rf"{a}\,\left(-{b}\right)"
    assert tex(lambda a, b, c: 3e-5 * a) == rf"3 \cdot 10^{{-5}}\,{a}"
    circuit = tf.Circuit(lambda u, s, p, cell: {"x_1": s.ahl - p.k_1 * u.x_1},
                         species=("x_1", "still"), k_1=1.0)  # fmt: skip
    assert circuit.graph._repr_latex_() == (
        "$$\\begin{aligned}\n"
        r"\frac{d\,\mathrm{x\_1}}{dt} &= \mathrm{ahl}_{\mathrm{out}} -"
        r" \mathrm{k\_1}\,\mathrm{x\_1} \\" + "\n"
        r"\frac{d\,\mathrm{still}}{dt} &= 0 \\" + "\n"
        r"&\text{(before dilution by growth)}" + "\n\\end{aligned}$$"
    )


def test_a_circuit_printed():
    assert str(signalling().graph) == (
        "d ahl/dt   = k·luxi + D·(out.ahl − ahl)·cell.area/cell.volume\n"
        "to out.ahl = −D·(out.ahl − ahl)·cell.area\n"
        "d luxi/dt  = 0\n"
        "(before dilution by growth)"
    )
    assert repr(signalling().graph) == str(signalling().graph)
    whole = tf.Circuit(lambda u, s, p, cell: {"a": -u.a}, species="a", dilution=False).graph
    assert str(whole) == "d a/dt = −a" and "text" not in whole._repr_latex_()
    assert "dilution" not in str(signalling().graph.diluted(("ahl",), 1.0))


# --- what is conserved, and what is read ----------------------------------------------------------


def enzyme() -> tf.Circuit:
    """Michaelis and Menten's: substrate, enzyme, their complex, product."""
    made = [
        tf.Reaction.of("s + e -> es", "k1"),
        tf.Reaction.of("es -> s + e", "k2"),
        tf.Reaction.of("es -> pr + e", "k3"),
    ]
    return tf.Circuit(made, species=("s", "e", "es", "pr"), k1=1.0, k2=0.5, k3=2.0, unused=1.0)


def signalling() -> tf.Circuit:
    def rates(u, s, p, cell):
        into = p.D * (s.ahl - u.ahl) * cell.area
        return {"ahl": p.k * u.luxi + into / cell.volume}, {"ahl": -into}

    return tf.Circuit(rates, species=("luxi", "ahl"), k=1.0, D=2.0)


def robertson(u, s, p, cell):
    one, two = 0.04 * u.a - 1e4 * u.b * u.c, 3e7 * u.b * u.b
    return {"a": -one, "b": one - two, "c": two}


def beside(u, s, p, cell):
    """A slow species beside fast ones."""
    return {"a": -1e8 * u.a, "b": 1e8 * u.a, "slow": 1e-6 * u.slow}


def test_conserved_sums():
    same = lambda found, *sums: sorted(map(repr, found)) == sorted(map(repr, sums))
    assert enzyme().graph.conserved == [{"s": 1, "es": 1, "pr": 1}, {"e": 1, "es": 1}]
    assert same(tf.Circuit(robertson, species=["a", "b", "c"]).graph.conserved, dict(a=1, b=1, c=1))
    assert same(tf.Circuit(beside, species=["a", "b", "slow"]).graph.conserved, {"a": 1, "b": 1})
    # what leaves the cell enters the medium; here LuxI does not change, and makes AHL
    assert signalling().graph.conserved == [{"luxi": 1}]
    exchange = tf.Circuit([*parts.exchange("ahl", "D"), *parts.degradation("lacz", 1.0)],
                          species=("ahl", "lacz"), D=1.0)  # fmt: skip
    assert same(exchange.graph.conserved, {"ahl": 1, "out.ahl": 1})
    pair = tf.Circuit([tf.Reaction.of("2 a -> 3 b", 1.0)], species=("a", "b"))
    assert same(pair.graph.conserved, {"a": 3, "b": 2})
    # the signs are such that the numbers add up to more than 0, or the first is above 0
    for count, sums in ((2, {"a": -1, "b": 2}), (1, {"a": 1, "b": -1})):
        made = [tf.Reaction({}, {"a": count, "b": 1}, 1.0)]
        assert tf.Circuit(made, species=("a", "b")).graph.conserved == [sums]
    leaking = [*parts.degradation("a", "k"), tf.Reaction.of("a -> b", 1.0)]
    assert tf.Circuit(leaking, species=("a", "b"), k=1.0).graph.conserved == []


def test_what_is_read_and_what_is_not():
    graph = enzyme().graph
    assert graph.unused == ("unused",) and graph.signals == ()
    assert set(graph.reads["pr"]) == {"k3", "es"}
    lux = signalling().graph
    assert lux.signals == ("ahl",) and lux.unused == ()
    assert set(lux.reads["out.ahl"]) == {"D", "out.ahl", "ahl", "cell.area"}


def test_both_forms_of_a_circuit_have_the_same_rates():
    def switch(u, s, p, cell):
        return {
            "red": p.k * tf.kinetics.repression(u.green, 1.0, 2) - u.red,
            "green": p.k * tf.kinetics.repression(u.red, 1.0, 2) - u.green,
        }

    listed = [
        *parts.repressed("red", by="green", rate="k", half=1.0, power=2),
        *parts.repressed("green", by="red", rate="k", half=1.0, power=2),
        *parts.degradation("red", 1.0), *parts.degradation("green", 1.0),
    ]  # fmt: skip
    one, other = (tf.Circuit(x, species=("red", "green"), k=4.0).graph for x in (switch, listed))
    assert one.equations == (
        "d red/dt   = k/(1 + green^2) − red\nd green/dt = k/(1 + red^2) − green"
    )
    values = {"red": [0.3, 2.0], "green": [1.0, 0.0], "k": 4.0}
    for name, rate in one.evaluate(values).items():
        assert array(other.evaluate(values)[name]) == pytest.approx(array(rate), rel=1e-14)


def test_graphs_by_cell_type():
    two = tf.Circuit(
        {0: lambda u, s, p, cell: {"a": p.k * u.a}, 1: lambda u, s, p, cell: {"b": -u.b}},
        species=("a", "b"), k=1.0,
    )  # fmt: skip
    assert [g.equations for g in two.graphs.values()] == [
        "d a/dt = k·a\nd b/dt = 0", "d b/dt = −b\nd a/dt = 0"
    ]  # fmt: skip
    assert two.graphs[1].unused == ("k",)
    with pytest.raises(tf.InputError, match=r"by cell type \(0, 1\): ask graphs\[type\]"):
        _ = two.graph
