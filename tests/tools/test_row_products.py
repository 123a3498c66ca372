"""x Wᵀ for many rows: by a kernel with the bits of the loop in torch, whatever the rows."""

from __future__ import annotations

import pytest
import torch

from torchfilm.kernels import products as products  # loads the compiler
from torchfilm.tools import row_products
from torchfilm.tools.deterministic_math import deterministic_functions
from torchfilm.tools.row_products import linear
from torchfilm.tools.tangents import forward_mode, tangent, with_tangent


def given(rows, dtype, columns=9, out=5):
    draw = torch.Generator().manual_seed(0)
    made = [torch.randn(*s, generator=draw, dtype=torch.float64)
            for s in ((*rows, columns), (out, columns), (out,))]  # fmt: skip
    return [x.to(dtype) for x in made]


@pytest.fixture
def taken(monkeypatch) -> list[int]:
    """How often the kernel has run."""
    calls, before = [], products.add_product
    monkeypatch.setattr(products, "add_product", lambda *a: calls.append(1) or before(*a))
    return calls


def by_loop(*args):
    least, row_products.LEAST = row_products.LEAST, 10**9
    try:
        return linear(*args)
    finally:
        row_products.LEAST = least


@pytest.mark.parametrize("rows", [(1,), (7,), (1000,), (3, 4), (0,), ()])
def test_the_kernel_has_the_bits_of_the_loop(dtype, rows, taken):
    x, weight, bias = given(rows, dtype)
    ours, theirs = linear(x, weight, bias), by_loop(x, weight, bias)
    assert taken and ours.shape == (*rows, 5) and torch.equal(ours, theirs)
    torch.testing.assert_close(ours, torch.nn.functional.linear(x, weight, bias))
    mixed = linear(x.double(), weight.float())
    assert mixed.dtype == torch.float64
    assert torch.equal(mixed, by_loop(x.double(), weight.float()))


def test_a_row_has_the_same_bits_alone(dtype):
    x, weight, bias = given((300,), dtype, columns=70, out=33)
    together = linear(x, weight, bias)
    assert all(torch.equal(together[k], linear(x[k : k + 1], weight, bias)[0]) for k in (0, 5, 299))
    assert torch.equal(together[::3], linear(x[::3], weight, bias))  # rows that lie apart


def test_gradients_are_torchs(taken):
    x, weight, bias = (z.requires_grad_() for z in given((6,), torch.float64))
    assert torch.autograd.gradcheck(linear, (x, weight, bias))
    assert torch.autograd.gradgradcheck(linear, (x, weight, bias))
    assert taken
    only = torch.autograd.grad(linear(x.detach(), weight, bias).sum(), weight)[0]
    assert torch.allclose(only, x.detach().sum(0).expand(5, 9))


def test_many_directions_at_once():
    x, weight, _ = (z.requires_grad_() for z in given((7,), torch.float64))
    out = linear(x, weight)
    directions = torch.randn(3, *out.shape, dtype=torch.float64)
    many = torch.autograd.grad(out, (x, weight), directions, is_grads_batched=True)
    assert torch.allclose(many[0], directions @ weight)
    assert torch.allclose(many[1], directions.transpose(1, 2) @ x)


def test_what_a_kernel_cannot_follow_is_left_to_torch(taken):
    x, weight, _ = given((6,), torch.float64)
    with forward_mode():
        slope = tangent(linear(with_tangent(x, torch.ones_like(x)), weight))
    assert torch.allclose(slope, weight.sum(1).expand(6, 5))
    each = torch.vmap(lambda z: linear(z, weight))(x)
    grown = torch.func.grad(lambda z: linear(z, weight).sum())(x)
    assert not taken
    assert torch.allclose(each, x @ weight.t())
    assert torch.allclose(grown, weight.sum(0).expand(6, 9))


def test_products_in_rules_take_it(taken):
    x, weight, _ = given((6,), torch.float32)
    turned, expected = weight.t(), linear(x, weight)
    with deterministic_functions():
        assert torch.equal(x @ turned, expected)
        assert torch.equal(torch.matmul(x, other=turned), expected)
        assert torch.equal(torch.mm(x, mat2=turned), expected)
        assert torch.equal(torch.nn.functional.linear(input=x, weight=weight), expected)
        assert len(taken) == 5
        assert torch.equal(x @ weight[0], linear(x, weight[:1])[:, 0])
        assert torch.equal(torch.mv(x, vec=weight[0]), x @ weight[0])
        assert torch.equal(x[0] @ weight[0], torch.dot(x[0], weight[0]))  # left to torch
        with pytest.raises(RuntimeError):
            torch.mm(x[0], weight[0])
        assert (torch.ones(4, 0) @ torch.ones(0, 3)).shape == (4, 3)
        torch.testing.assert_close(torch.mm(x, turned.to_sparse()), expected)
