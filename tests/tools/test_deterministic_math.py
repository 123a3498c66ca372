"""Powers and other functions whose bits do not depend on an element's place in a tensor."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from helpers import array

from torchfilm.tools import deterministic_math
from torchfilm.tools.deterministic_math import deterministic_functions, power

EXPONENTS = [0, 1, 2, 3, 4, 7, 8, 13, -1, -2, -3, 0.5, 1.5, 2.7, 0.3, -0.5, -1.5]


def layer(x):
    """Columns (M, 5) made of x, weights (2, 5) and a bias (2,)."""
    columns = torch.stack([x, 2 - x, x * x, x - 3, 1 / (1 + x)], 1)
    weight = torch.linspace(-1.3, 1.7, 10, dtype=x.dtype).reshape(2, 5)
    return columns, weight, weight[:, 0]


# functions that users may write, each found to vary on some build of torch; powers of 0, 1, 2, 3
# belong to the same family
WRITTEN = {
    **{f"x ** {n}": lambda x, n=n: x**n for n in EXPONENTS},
    "x ** tensor": lambda x: x ** torch.full_like(x, 1.5),
    "x ** 0-dim tensor": lambda x: x ** torch.tensor(2.0, dtype=x.dtype),
    "torch.pow": lambda x: torch.pow(x, 4),
    "x.pow": lambda x: x.pow(2.7),
    "1.7 ** x": lambda x: 1.7**x,
    "in place": lambda x: x.clone().pow_(1.5),
    "sigmoid": torch.sigmoid,
    "x.sigmoid": lambda x: x.sigmoid(),
    "exp2": torch.exp2,
    "sinh": torch.sinh,
    "cosh": torch.cosh,
    "atanh": lambda x: torch.atanh(x / 6),
    "softplus": torch.nn.functional.softplus,
    "silu": torch.nn.functional.silu,
    "elu": lambda x: torch.nn.functional.elu(x - 2),
    "selu": lambda x: torch.nn.functional.selu(x - 2),
    "torch.celu": lambda x: torch.celu(x - 2, 0.7),
    "mish": torch.nn.functional.mish,
    "gelu": torch.nn.functional.gelu,
    "gelu by tanh": lambda x: torch.nn.functional.gelu(x, approximate="tanh"),
    "logit": lambda x: torch.logit(x / 7, eps=1e-3),
    "sigmoid in place": lambda x: x.clone().sigmoid_(),
    "atan2": lambda x: torch.atan2(x - 2, 1 - x),
    "sum of columns": lambda x: layer(x)[0].sum(1),
    "sum of rows": lambda x: torch.stack([x, 2 - x, x * x, x - 3, 1 / (1 + x)]).sum(dim=0),
    "mean of columns": lambda x: torch.mean(layer(x)[0], -1, True)[:, 0],
    "rsqrt": torch.rsqrt,
    "logaddexp": lambda x: torch.logaddexp(x, 2 - x),
    "hypot": lambda x: torch.hypot(x, 2 - x),
    "linear": lambda x: torch.nn.functional.linear(*layer(x))[:, 1],
    "matrix product": lambda x: (layer(x)[0] @ layer(x)[1].t())[:, 0],
    # not replaced: found deterministic, and must stay so
    "exp": torch.exp,
    "expm1": torch.expm1,
    "log": torch.log,
    "log1p": torch.log1p,
    "sqrt": torch.sqrt,
    "tanh": torch.tanh,
    "erf": torch.erf,
    "atan": torch.atan,
    "addcmul": lambda x: torch.addcmul(x, x, 2 - x),
}


@pytest.fixture(scope="module", autouse=True)
def forward_mode():
    """Compile torch's forward derivatives, without torch's own deprecation warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.exp, (torch.ones(1),), (torch.ones(1),))


def tangent(f, x):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(f(forward_ad.make_dual(x, torch.ones_like(x)))).tangent


def backward(f, x):
    x = x.clone().requires_grad_()
    y = f(x)
    return torch.autograd.grad(y, x, torch.ones_like(y))[0] if y.requires_grad else None


@pytest.mark.parametrize("name", WRITTEN)
def test_bits_do_not_depend_on_place_or_company(dtype, name):
    """An element alone, at any offset of a slice of any length up to 70, in a strided column, in a
    long tensor: value and both derivatives.
    """
    x = (
        torch.rand(3000, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 4 + 1e-3
    ).to(dtype)
    f = WRITTEN[name]
    with deterministic_functions():
        for kind in (lambda y: f(y), lambda y: tangent(f, y), lambda y: backward(f, y)):
            whole = kind(x)
            if whole is None:
                continue
            assert torch.equal(torch.cat([kind(x[i : i + 1]) for i in range(200)]), whole[:200])
            for length in range(2, 71):
                start = length % 17
                assert torch.equal(
                    kind(x[start : start + length]), whole[start : start + length]
                ), length
            assert torch.equal(kind(x.reshape(-1, 6)[:, 1]), whole.reshape(-1, 6)[:, 1])


@pytest.mark.parametrize("name", ["x ** 1.5", "x ** 4", "sigmoid", "1.7 ** x"])
def test_bits_do_not_depend_on_threads(dtype, name):
    x = torch.rand(60_001, generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(
        dtype
    )
    with deterministic_functions():
        alone = WRITTEN[name](x)
        torch.set_num_threads(2)
        try:
            assert torch.equal(WRITTEN[name](x), alone)
        finally:
            torch.set_num_threads(1)


@pytest.mark.parametrize("n", EXPONENTS)
@pytest.mark.parametrize("tensor", [False, True], ids=["number", "tensor"])
def test_power_is_exact_to_a_few_units(dtype, device, n, tensor):
    """Against NumPy in float64.

    Squaring costs up to n roundings, exp(n log x) up to n |log x| and a few of exp and log
    themselves.
    """
    x = torch.logspace(-2.5, 2.5, 400, dtype=torch.float64).to(device=device, dtype=dtype)
    found = power(x, torch.full_like(x, n) if tensor else n)
    # 2.7 is another number in float32
    exponent = float(torch.tensor(n, dtype=dtype)) if tensor else n
    expected = array(x) ** exponent
    bound = torch.finfo(dtype).eps * (4 + abs(n) * (1 + np.abs(np.log(array(x)))))
    assert found.dtype == dtype
    assert (np.abs(array(found) / expected - 1) <= bound).all()


@pytest.mark.parametrize("tensor", [False, True], ids=["number", "tensor"])
def test_power_at_zero_and_below(dtype, device, tensor):
    """0ⁿ and its two derivatives by n; integer exponents of negative numbers; NaN for fractional
    ones, as in torch.
    """
    cases = [
        (1.0, 0, 1, 0),
        (2.0, 0, 0, 2),
        (3.0, 0, 0, 0),
        (8.0, 0, 0, 0),
        (1.5, 0, 0, 0),
        (2.5, 0, 0, 0),
        (0.5, 0, 0, 0),
        (0.0, 1, 0, 0),
    ]
    for n, *expected in cases:
        x = torch.zeros(1, dtype=dtype, device=device, requires_grad=True)
        y = power(x, torch.tensor([n], dtype=dtype, device=device) if tensor else n) + 0 * x * x
        first = torch.autograd.grad(y.sum(), x, create_graph=True)[0]
        second = torch.autograd.grad(first.sum(), x)[0]
        assert [float(z.detach()) for z in (y, first, second)] == expected, n
    x = torch.tensor([-1.5], dtype=dtype, device=device)
    as_given = lambda n: torch.tensor([n], dtype=dtype, device=device) if tensor else n
    for n in (0, 1, 2, 3, 4, 5, -1, -2):
        assert float(power(x, as_given(float(n)))) == pytest.approx((-1.5) ** n, rel=1e-5)
    assert math.isnan(float(power(x, as_given(1.5))))


@pytest.mark.parametrize("x", [1e-30, 1e-10, 1.0, 3.0, -2.0])
@pytest.mark.parametrize("n", [1.0, 1.5, 2.0, 2.5, 8.0])
def test_no_derivative_is_poisoned_by_a_branch_not_taken(dtype, x, n):
    """Two derivatives by x and the one by n of a tensor power are finite wherever the value is."""
    if x < 0 and n % 1:
        return
    base, exponent = (
        torch.tensor([x], dtype=dtype, requires_grad=True),
        torch.tensor([n], dtype=dtype, requires_grad=True),
    )
    y = power(base, exponent)
    first = torch.autograd.grad(y.sum(), [base, exponent], create_graph=True)
    second = torch.autograd.grad(first[0].sum(), base)[0]
    assert all(bool(torch.isfinite(z).all()) for z in (y, *first, second))


def test_derivatives_by_finite_differences():
    """First and second derivatives by base and exponent, float64, with gradcheck's bounds."""
    x = torch.tensor([0.2, 0.9, 1.7, 3.0], dtype=torch.float64, requires_grad=True)
    n = torch.tensor([0.7, 1.5, 2.0, 8.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(power, (x, n), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(power, (x, n))
    for k in (1.5, 2, 5, -1, -2.5, 0.5):
        assert torch.autograd.gradcheck(lambda x, k=k: power(x, k), (x,), check_forward_ad=True)
    for f in (
        deterministic_math.sigmoid,
        deterministic_math.softplus,
        deterministic_math.elu,
        deterministic_math.sinh,
        deterministic_math.cosh,
        deterministic_math.silu,
    ):
        assert torch.autograd.gradcheck(
            f,
            (
                torch.cat([x, -x, torch.zeros(1)])
                if f is not deterministic_math.elu
                else torch.cat([x, -x]),
            ),
            check_forward_ad=True,
        )


def test_linear_layers_promote_precisions_and_agree_with_torch():
    """Within the mode a float32 module takes float64 columns, as the stiff solver gives them."""
    x, (_, weight, bias) = torch.rand(7, 5), layer(torch.ones(1))
    plain = torch.nn.functional.linear(x, weight, bias)
    with deterministic_functions():
        found = torch.nn.functional.linear(x.double(), weight, bias)
        assert found.dtype == torch.float64
        torch.testing.assert_close(found.float(), plain)
        torch.testing.assert_close(x @ weight.t() + bias, plain)
        torch.testing.assert_close(x[0] @ weight.t(), (x @ weight.t())[0])
        torch.testing.assert_close(x @ weight[0], (x @ weight.t())[:, 0])
    inputs = [t.double().requires_grad_() for t in (x, weight, bias)]
    assert torch.autograd.gradcheck(deterministic_math.linear, inputs, check_forward_ad=True)


OTHERS = {
    deterministic_math.sigmoid: torch.sigmoid,
    deterministic_math.softplus: torch.nn.functional.softplus,
    deterministic_math.silu: torch.nn.functional.silu,
    deterministic_math.elu: torch.nn.functional.elu,
    deterministic_math.selu: torch.nn.functional.selu,
    deterministic_math.celu: torch.nn.functional.celu,
    deterministic_math.mish: torch.nn.functional.mish,
    deterministic_math.sinh: torch.sinh,
    deterministic_math.cosh: torch.cosh,
}


@pytest.mark.parametrize("mine", OTHERS)
def test_other_functions_are_torchs(dtype, mine):
    """Against torch in float64 over ±50, to a few units in the last place.

    For softplus torch uses the straight line beyond 20, with an error of 2e-9.
    """
    x = torch.linspace(-50, 50, 2001, dtype=torch.float64).to(dtype)
    expected = OTHERS[mine](x.double())
    assert torch.allclose(
        mine(x).double(),
        expected,
        rtol=8 * torch.finfo(dtype).eps,
        atol=2.2e-9 if mine is deterministic_math.softplus else 1e-30,
    )


def test_two_arguments_are_torchs(dtype):
    x, y = torch.tensor([[-3.0, 0.0, 2.0, 2.0, -80.0], [1.0, 0.0, 2.0, -2.0, 80.0]], dtype=dtype)
    assert torch.allclose(
        deterministic_math.logaddexp(x, y), torch.logaddexp(x, y), rtol=4 * torch.finfo(dtype).eps
    )
    assert torch.allclose(
        deterministic_math.hypot(x, y), torch.hypot(x, y), rtol=4 * torch.finfo(dtype).eps
    )


@pytest.mark.parametrize("approximate", ["none", "tanh"])
def test_gelu_is_torchs(dtype, approximate):
    """Where 1 + erf is nearly 0 it keeps few digits of a number that is then next to nothing."""
    x = torch.linspace(-9, 9, 2001, dtype=dtype)
    found = deterministic_math.gelu(x, approximate)
    expected = torch.nn.functional.gelu(x.double(), approximate=approximate)
    eps = torch.finfo(dtype).eps
    assert torch.allclose(found.double(), expected, rtol=16 * eps, atol=8 * eps)


def test_angles_are_torchs(dtype):
    """In every quadrant, on the axes, and for zeros of both signs."""
    at = torch.tensor([-2.0, -1.0, -0.0, 0.0, 1e-3, 1.0, 3.0, math.inf, -math.inf], dtype=dtype)
    y, x = (part.reshape(-1) for part in torch.meshgrid(at, at, indexing="ij"))
    found, expected = deterministic_math.atan2(y, x), torch.atan2(y, x)
    assert torch.allclose(found, expected, rtol=4 * torch.finfo(dtype).eps)
    inputs = [t.double().requires_grad_() for t in (torch.tensor([2.0, -1.0]), x.new([0.5, -3.0]))]
    assert torch.autograd.gradcheck(deterministic_math.atan2, inputs)


def test_logits_are_torchs(dtype):
    x = torch.tensor([0.0, 1e-3, 0.3, 0.5, 1.0], dtype=dtype)
    eps = torch.finfo(dtype).eps
    for least in (None, 0.01):
        found, expected = deterministic_math.logit(x, least), torch.logit(x, least)
        assert torch.allclose(found, expected, rtol=8 * eps, atol=eps)


def test_sums_over_an_axis_are_torchs(dtype):
    x = torch.rand(7, 6, 5, dtype=dtype)
    with deterministic_functions():
        for axis in (0, 1, -1):
            for keep in (False, True):
                assert torch.allclose(
                    x.sum(axis, keep), torch.sum(x.double(), axis, keep).to(dtype)
                )
                assert torch.allclose(
                    torch.mean(x, axis, keep), x.double().mean(axis, keep).to(dtype)
                )
        assert torch.equal(x.sum(axis=1), x.sum(1)) and torch.equal(x.mean((1,)), x.mean(1))
        assert float(x.sum()) > 0 and x.sum((0, 1)).shape == (5,)  # left to torch
        assert torch.sum(x, dim=1, dtype=torch.float64).dtype == torch.float64
        assert torch.ones(3, 4, dtype=torch.bool).sum(1).tolist() == [4, 4, 4]
        assert torch.zeros(0, 6, dtype=dtype).sum(1).shape == (0,)


def test_functions_may_write_into_their_argument():
    x = torch.tensor([-2.0, -0.5, 1.0])
    functions = torch.nn.functional
    for function in (functions.selu, functions.celu, functions.elu, functions.silu, functions.mish):
        inside, expected = x.clone(), function(x)
        with deterministic_functions():
            assert torch.equal(function(x), function(input=x)) and torch.equal(
                x[0], x.new_tensor(-2.0)
            )
            found = function(inside, inplace=True)
        assert found is inside
        torch.testing.assert_close(inside, expected)
    inside = x.clone()
    with deterministic_functions():
        functions.elu(inside, 1.0, True)
    torch.testing.assert_close(inside, functions.elu(x))


def test_forms_that_torch_allows():
    """Named exponents, and sparse tensors."""
    x = torch.tensor([0.5, 2.0])
    with deterministic_functions():
        assert torch.equal(x.pow(exponent=1.5), x**1.5)
        assert torch.equal(torch.pow(input=x, exponent=1.5), x**1.5)
        assert torch.allclose((x.to_sparse() ** 2).to_dense(), x * x)
        assert torch.allclose(torch.sinh(x.to_sparse()).to_dense(), torch.sinh(x))
        assert torch.celu(torch.tensor([-1.0]), 0.7).item() == pytest.approx(
            0.7 * math.expm1(-1 / 0.7)
        )


def test_arguments_may_be_named_as_in_torch():
    x, y = torch.tensor([0.5, 2.0]), torch.tensor([1.0, 3.0])
    with deterministic_functions():
        for function in (torch.rsqrt, torch.sigmoid, torch.exp2, torch.nn.functional.softplus):
            assert torch.equal(function(input=x), function(x))
        assert torch.equal(torch.sum(input=x.expand(3, 2), dim=0), 3 * x)
        for function in (torch.logaddexp, torch.hypot, torch.atan2):
            assert torch.equal(function(x, other=y), function(x, y))


def test_what_is_not_replaced_is_left_to_torch():
    """Integer and complex tensors, and negative bases of a number's power, are as in torch.

    Outside the context nothing is replaced.
    """
    whole, complexes = torch.tensor([2, 3]), torch.tensor([1 + 1j])
    with deterministic_functions():
        assert (whole**2).dtype == torch.int64 and (2**whole).dtype == torch.int64
        assert torch.equal(complexes**1.5, torch.pow(complexes, 1.5))
        assert math.isnan(float((-2.0) ** torch.tensor([1.5])))
        assert torch.equal(torch.tensor([2.0]) ** torch.tensor(3), torch.tensor([8.0]))
        assert torch.equal(torch.tensor([2.0, 3.0]) ** whole, torch.tensor([4.0, 27.0]))
    x = torch.rand(100, generator=torch.Generator().manual_seed(0))
    assert torch.equal(x**1.5, torch.pow(x, 1.5))


def test_works_under_the_function_transforms():
    x = torch.tensor([0.0, 0.5, 2.0], dtype=torch.float64)
    with deterministic_functions():
        value, slope = torch.func.jvp(lambda z: z**2.5 + 1.5**z, (x,), (torch.ones_like(x),))
        grown = torch.func.grad(lambda z: (z**2.5).sum())(x)
    assert torch.allclose(value, x**2.5 + 1.5**x, rtol=1e-14)
    assert torch.allclose(grown, 2.5 * x**1.5, rtol=1e-14)
    assert torch.allclose(slope, 2.5 * x**1.5 + math.log(1.5) * 1.5**x, rtol=1e-14)
