"""Tracing of rate functions: every operation against torch, the types of numbers, and what is
refused, with the line that is named."""

from __future__ import annotations

import math
import operator

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import array
from traced import again, emitted, traced

import torchfilm as tf
from torchfilm.circuits.tracing import RULES
from torchfilm.tools.deterministic_math import deterministic_functions

F32, F64 = torch.float32, torch.float64
X = torch.tensor([0.15, 0.4, 0.5, 0.85], dtype=F64)
Y = torch.tensor([0.4, 0.3, 0.5, 0.9], dtype=F64)

# Arguments of what does not take one column or two, given x and y.
SPECIAL = {
    "where": lambda f, x, y: f(x, x > y, y) if f is torch.Tensor.where else f(x > y, x, y),
    "clamp": lambda f, x, y: f(x, 0.3, 0.45),
    "clip": lambda f, x, y: f(x, min=y),
    "clamp_min": lambda f, x, y: f(x, 0.3),
    "clamp_max": lambda f, x, y: f(x, 0.3),
    "full_like": lambda f, x, y: f(x, 0.3) + y,
    "zeros_like": lambda f, x, y: f(x) + y,
    "ones_like": lambda f, x, y: f(x) * y,
    "to": lambda f, x, y: f(x, F32),
    "expand_as": lambda f, x, y: f(x, y),
    "__rpow__": lambda f, x, y: f(x, 2.5),
    **{
        n: lambda f, x, y: f(x > 0.3, y > 0.4)
        for n in ("logical_and", "logical_or", "__and__", "__or__")
    },
    **{n: lambda f, x, y: f(x > 0.3) for n in ("logical_not", "__invert__")},
}
BINARY = {
    f"{a}{n}{b}"
    for n in [
        "add",
        "sub",
        "mul",
        "truediv",
        "pow",
        "gt",
        "ge",
        "lt",
        "le",
        "eq",
        "ne",
        "rsub",
        "mod",
    ]
    for a, b in (("", ""), ("__", "__"))
} | set(
    [
        "subtract",
        "multiply",
        "div",
        "divide",
        "true_divide",
        "minimum",
        "maximum",
        "greater",
        "greater_equal",
        "less",
        "less_equal",
        "not_equal",
        "logaddexp",
        "hypot",
        "__radd__",
        "__rmul__",
        "__rsub__",
        "__rdiv__",
        "__rtruediv__",
        "rsub",
        "min",
        "max",
        "remainder",
        "float_power",
    ]
)


def call(function, x, y):
    name = function.__name__
    if name in SPECIAL:
        return SPECIAL[name](function, x, y)
    return function(x, y) if name in BINARY else function(x)


@pytest.mark.parametrize("function", list(RULES), ids=lambda f: getattr(f, "__qualname__", str(f)))
def test_every_operation_is_that_of_torch(function):
    """Traced and evaluated again, each gives the bits that circuits get of torch, and its type."""
    found = traced(lambda x, y: call(function, x, y), x=X, y=Y)
    with deterministic_functions():
        expected = call(function, X, Y)
    made = again(found, x=X, y=Y)
    assert (found.dtype, found.dim()) == (expected.dtype, expected.dim())
    assert torch.equal(made.to(expected.dtype).expand(4), expected)


TYPES = {
    "a column and a number for all": lambda x, a, t: x * t + a * 0.1,
    "two precisions": lambda x, a, t: (a * 0.1 + t) / x,
    "a number with a float32 column": lambda x, a, t: a / 3.0 + 0.1 * a,
    "numbers for all": lambda x, a, t: t * 0.1 + t / 3 + x,
    "comparison in float32": lambda x, a, t: torch.where(a > 0.4, x, 0.1),
    "comparison of two precisions": lambda x, a, t: torch.where(x >= a, 1.0, t) * x,
    "where of numbers is float32": lambda x, a, t: torch.where(x > 0.45, 0.1, 0.7) * x,
    "nested where": lambda x, a, t: torch.where(
        x > 0.45, torch.where(a > 0.6, 0.3, x), torch.where(a < 0.2, 0.1, a)
    ),
    "casts": lambda x, a, t: x.float() * 0.1 + a.to(x.dtype) * 0.1 + a.double() / 3,
    "truth values as numbers": lambda x, a, t: (x > 0.45) * x + (a > 0.3).to(a.dtype) * 0.1,
    "logical of numbers": lambda x, a, t: torch.logical_and(x, a - a).to(x.dtype) + x,
    "columns of one number": lambda x, a, t: torch.zeros_like(a) + 0.1 + x,
    "ones of float64 with float32": lambda x, a, t: torch.ones_like(x) * 0.1 * a,
    "one number of a type": lambda x, a, t: torch.full_like(t, 0.1) * x,
    "powers": lambda x, a, t: x**2 + x**0.5 + x**-1.5 + a**3 + x**100,
    "powers of and to columns": lambda x, a, t: x**a + 2.0**x + a ** (x + 1) + t**x,
    "laws": lambda x, a, t: tf.kinetics.activation(x, 0.5, 2) + tf.kinetics.repression(x, a, t),
    "rounding": lambda x, a, t: torch.floor(10 * x) + torch.sign(x - 0.4) + (x - 0.6) % 0.25,
}


@pytest.mark.parametrize("kind", list(TYPES))
@pytest.mark.parametrize("single", [False, True], ids=["float64", "float32"])
def test_numbers_have_the_types_that_torch_gives_them(kind, single):
    """A float32 column beside float64 ones, and one number of all cells: by tracing, and by the
    text of compiled functions; exp and log may differ by a unit in the last place."""
    given = {"x": X, "a": Y.to(F32 if single else F64), "t": torch.tensor(1.7, dtype=F32)}
    with deterministic_functions():
        expected = TYPES[kind](**given)
    found = traced(TYPES[kind], **given)
    assert (found.dtype, found.dim()) == (expected.dtype, expected.dim())
    made = again(found, **given)
    assert made.dtype == expected.dtype and torch.equal(made, expected)
    exact = not kind.startswith(("powers", "laws"))
    rel = 0 if exact else 4 * torch.finfo(F32 if single else F64).eps
    close = pytest.approx(array(expected), rel=rel, abs=0)
    assert emitted(TYPES[kind], **given) == close


def test_whole_numbers_are_compared_exactly():
    """2²⁴ and 2²⁴ + 1 are one float32 number."""
    k = torch.tensor([2**24, 2**24 + 1, 3, 4])
    rate = lambda x, k: torch.where(k == 2**24 + 1, x, torch.where(k > 3, 2.0, 0.0))
    assert emitted(rate, x=X, k=k).tolist() == [2.0, 0.4, 0.0, 2.0]


@pytest.mark.parametrize("law", ["activation", "repression", "michaelis_menten"])
def test_rate_laws_have_a_compiled_form(law):
    x = torch.tensor([0.0, 0.2, 3.0], dtype=torch.float64)
    rate = lambda x: getattr(tf.kinetics, law)(x, 0.5)
    assert emitted(rate, x=x).tolist() == rate(x).tolist()


def test_functions_where_there_is_no_number():
    """Roots and logarithms below zero and at zero, and their like, as torch has them."""
    x = torch.tensor([-2.0, -1.0, -0.0, 0.0, 0.5, math.inf, -math.inf, math.nan], dtype=F64)
    for name in [
        "sqrt",
        "log",
        "log1p",
        "log2",
        "log10",
        "exp",
        "expm1",
        "sign",
        "floor",
        "abs",
        "tanh",
        "atan",
        "neg",
    ]:
        rate = lambda x, name=name: getattr(torch, name)(x) * 1.0
        assert emitted(rate, x=x) == pytest.approx(array(rate(x)), rel=1e-15, nan_ok=True), name
    for name in ("minimum", "maximum"):
        rate = lambda x, name=name: getattr(torch, name)(x, x * 0 + 0.25)
        assert emitted(rate, x=x) == pytest.approx(array(rate(x)), nan_ok=True), name


# --- what is refused ------------------------------------------------------------------------------

K = torch.tensor(2.0)
NET = torch.nn.Linear(2, 1)
REFUSED = {
    "`if`.* torch.where": lambda u: u.a if u.a > 1 else u.b,
    "`min` or `max`": lambda u: max(u.a, 0),
    "math.* torch.exp": lambda u: math.exp(u.a),
    r"\.item\(\)": lambda u: u.a.item() * u.b,
    "numpy": lambda u: np.exp(u.a),
    r"over all cells \(sum\)": lambda u: u.a / u.a.sum(),
    r"over all cells \(mean\)": lambda u: torch.mean(u.a) * u.b,
    r"over all cells \(cumsum\)": lambda u: torch.cumsum(u.a, 0),
    r"over all cells \(max\)": lambda u: u.a / u.a.max(),
    "some of the cells": lambda u: u.a[0] * u.b,
    "the number of cells": lambda u: u.a / len(u.a),
    "one by one": lambda u: sum(u.a),
    "shape": lambda u: u.a * u.a.shape[0],
    "no column: a draw, or one from outside": lambda u: u.a * K,
    "a draw, or one": lambda u: u.a * torch.rand(2),
    r"random numbers \(rand_like\)": lambda u: torch.rand_like(u.a),
    "stack, which puts columns together": lambda u: NET(torch.stack([u.a, u.b], 1))[:, 0],
    "linear, which mixes": lambda u: NET(u.a),
    r"a change in place \(add_\)": lambda u: u.a.add_(1.0),
    r"in place \(mul_\)": lambda u: operator.imul(u.a, 2),
    "a change in place": lambda u: operator.setitem(u.a, 0, 1.0),
    "erf": lambda u: torch.erf(u.a),
    r"truth values \(mul\)": lambda u: (u.a > 1) * 2.0,
    "&, | or ~": lambda u: torch.where((u.a > 1) & 1, u.a, u.b),
    "softplus in a way not known": lambda u: F.softplus(u.a, beta=2.0),
}  # fmt: skip


@pytest.mark.parametrize("said", list(REFUSED))
def test_what_is_refused_names_the_line(said):
    def rates(u, s, p, cell):
        return {"a": REFUSED[said](u)}

    with pytest.raises(tf.InputError, match=said) as error:
        _ = tf.Circuit(rates, species=("a", "b")).graph
    line = REFUSED[said].__code__.co_firstlineno
    assert f"(line {line} of test_tracing.py: " in str(error.value)
    assert "rates cannot be written as equations: it uses" in str(error.value) or "calculates" in (
        str(error.value)
    )


def test_whole_numbers_are_refused():
    """cell_type and uid are whole numbers: torch's rules for them are its own."""
    scene = lambda f: tf.Scene(
        tf.Circuit(f, species="a"), founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], cell_type=[1])
    )

    def odd(u, s, p, cell):
        return {"a": (cell.uid % 2) * u.a}

    def typed(u, s, p, cell):
        return {"a": torch.where(cell.cell_type == 1, 1.0, 2.0) - u.a}

    said = lambda f: "\n".join(tf.explain(scene(f)).splitlines())
    assert "torch: odd: it calculates with whole numbers" in said(odd)
    assert "computed by compiled functions" in said(typed)


def test_constants_per_colony_inside_reactions_are_told_apart():
    decay = tf.Reaction({"a": 1}, {}, torch.tensor([1.0, 2.0]))
    with pytest.raises(tf.InputError, match="a constant per colony inside a reaction: name"):
        _ = tf.Circuit([decay], species="a").graph


@pytest.mark.parametrize(
    "rates, said",
    [
        (lambda u, s, p, cell: {"a": u.aa}, "u has no 'aa'.* Did you mean 'a'"),
        (lambda u, s, p, cell: {"a": p.strenght}, "p has no 'strenght'.*Did you mean 'strength'"),
        (lambda u, s, p, cell: {"aa": u.a}, "returned a rate for 'aa', which is no species"),
        (lambda u, s, p, cell: (u.a, u.a), "returned Column: it must return a dict"),
        (lambda u, s, p, cell: None, "returned NoneType: it must return a dict"),
    ],
)
def test_wrong_names_and_returns(rates, said):
    with pytest.raises(tf.InputError, match=said):
        _ = tf.Circuit(rates, species="a", strength=1.0).graph
