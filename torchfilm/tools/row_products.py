"""x Wᵀ + b for many rows x: a row's bits do not depend on the number of rows, or on its place among
them, as they do in a product of matrices."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfilm.tools.numba_calls import as_array, kernels_loaded
from torchfilm.tools.tangents import has_tangent
from torchfilm.tools.threads import Shared

# Smaller matrices are left to torch, whose few operations take no longer. The bits are the same.
LEAST = 16
_shared = Shared()


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """x Wᵀ + b with x (…, K), W (M, K), b (M,), K > 0, one column of x after the other.

    Precisions may differ, as in the four operations: a stiff solver calls in float64 what a module
    holds in float32.
    """
    if weight.numel() >= LEAST and _by_kernel(x, weight, bias):
        common = torch.result_type(x, weight)
        out = _Product.apply(x.to(common), weight.to(common))
    else:
        terms = zip(x.unsqueeze(-1).unbind(-2), weight.unbind(-1), strict=True)
        out = sum((column * row for column, row in terms), x.new_zeros(()))
    return out if bias is None else out + bias


def _by_kernel(*given: Tensor | None) -> bool:
    """Whether the kernel may take it: on the CPU, where nothing follows each operation."""
    values = [x for x in given if x is not None]
    torchs = torch._C._functorch
    wrapped = lambda x: torchs.is_functorch_wrapped_tensor(x) or torchs.is_legacy_batchedtensor(x)
    return (
        all(x.device.type == "cpu" and type(x) in (Tensor, torch.nn.Parameter) for x in values)
        and kernels_loaded(values[0])
        and not has_tangent(*values)
        and not any(wrapped(x) for x in values)
    )


class _Product(torch.autograd.Function):
    """x (…, K), W (M, K) -> x Wᵀ."""

    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor) -> Tensor:
        from torchfilm.kernels.products import add_product

        ctx.save_for_backward(x, weight)
        plain = lambda z: as_array(z.resolve_neg(), x.dtype)
        rows, columns = plain(x.reshape(-1, x.shape[-1])), plain(weight.t())
        out = torch.zeros(len(rows), len(weight), dtype=x.dtype)
        into = out.numpy()
        _shared(len(rows), lambda first, last: add_product(first, last, rows, columns, into))
        return out.reshape(*x.shape[:-1], len(weight))

    @staticmethod
    def backward(ctx, grad: Tensor):
        x, weight = ctx.saved_tensors
        by_x = linear(grad, weight.t()) if ctx.needs_input_grad[0] else None
        by_weight = None
        if ctx.needs_input_grad[1]:
            by_weight = grad.reshape(-1, grad.shape[-1]).t() @ x.reshape(-1, x.shape[-1])
        return by_x, by_weight
