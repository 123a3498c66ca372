"""Powers and other functions whose bits do not depend on an element's place in a tensor.

On the CPU torch works through a tensor in blocks of a vector register, and finishes the remainder
one by one with another library. For some functions the two differ in the last bit, so an element's
value depends on its place and on the tensor's size.

Functions found to differ, on torch 2.13 (AVX-512, both precisions): pow with any exponent other
than the plain numbers 0, 1, 2, 3, ±½, −1, −2 (also a tensor with value 2), a number to the power of
a tensor, exp2, sinh, cosh, atanh, sigmoid, softplus, silu, elu, selu, celu, gelu, mish, logit
(strided), logaddexp, hypot, atan2, gammainc, and sums of more than four columns. rsqrt is that of
one library, whose last bit depends on the processor; compiled circuits have 1/√x, and so has torch
here.

Functions found deterministic, with their derivatives: exp, expm1, log, log2, log10, log1p, sqrt,
sin, cos, tan, asin, acos, atan, tanh, asinh, acosh, erf, erfc, erfinv, lgamma, gammaincc,
log_sigmoid and the four operations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from torchfilm.tools.row_products import linear

# Larger integer exponents use exp and log, whose error is then smaller.
MAX_SQUARED = 64
# More numbers than so many along an axis are thought to be cells, and left to torch.
MOST_COLUMNS, MOST_TERMS = 64, 4096  # of a sum, and of a product
# |x| at or below this counts as 0 where a logarithm is taken: the second derivative, ~ 1/x², must
# not overflow the dtype.
FLOOR = {torch.float32: 1e-18, torch.float64: 1e-150}


def power(x: Tensor, n: float | Tensor) -> Tensor:
    """xⁿ by deterministic functions; n is a number or a tensor that broadcasts with x.

    The error is a few units in the last place times n log x. Integer exponents take any x. For
    other exponents a negative x gives NaN, and |x| at or below FLOOR counts as 0. With n ≥ 1 the
    value and two derivatives at x = 0 are right where they are finite. Infinite ones (of √x, the
    second of x^1.5) are returned as 0.
    """
    if isinstance(n, Tensor):
        return _tensor_power(x, n)
    if n < 0:
        return power(x, -n).reciprocal()
    whole = math.floor(n) if math.isfinite(n) else 0
    if whole > MAX_SQUARED or not math.isfinite(n):
        return _tensor_power(x, torch.tensor(n, dtype=x.dtype, device=x.device))
    if n == whole:
        return _integer_power(x, whole)
    root = _fractional_power(x, n - whole)
    return _integer_power(x, whole) * root if whole else root


def _integer_power(x: Tensor, n: int) -> Tensor:
    """xⁿ for n = 0, 1, 2, … by squaring."""
    if n <= 1:
        return x.clone() if n else torch.ones_like(x)
    out, square = None, x
    while n:
        if n & 1:
            out = square if out is None else out * square
        n >>= 1
        if n:
            square = square * square
    assert out is not None
    return out


def _fractional_power(x: Tensor, n: float) -> Tensor:
    """xⁿ for 0 < n < 1; 0 with zero derivative at x = 0, NaN below."""
    positive = x > _floor(x)
    safe = torch.where(positive, x, 1.0)
    out = safe.sqrt() if n == 0.5 else torch.exp(n * torch.log(safe))
    return torch.where(positive, out, torch.where(x < 0, torch.nan, 0.0).to(out.dtype))


def _tensor_power(x: Tensor, n: Tensor) -> Tensor:
    """xⁿ = xᵐ · |x|ⁿ⁻ᵐ with m = 0, 1 or 2.

    So the value and two derivatives by x are right at x = 0 for integer exponents.
    """
    m = n.detach().floor().clamp(0, 2)
    rest = n - m
    zero = x.abs() <= _floor(x)
    out = torch.exp(rest * torch.log(torch.where(zero, 1.0, x.abs())))
    fixed = rest.detach()
    out = torch.where(
        zero, torch.where(fixed > 0, 0.0, torch.where(fixed < 0, torch.inf, 1.0)).to(out.dtype), out
    )
    odd = torch.remainder(fixed, 2.0)
    below = x < 0
    out = torch.where(below & (odd == 1), -out, out)
    # a constant NaN: a product with NaN would pass NaN gradients to elements that never used it
    out = torch.where(below & (odd != 0) & (odd != 1), torch.nan, out)
    return torch.where(m == 0, out, torch.where(m == 1, x, x * x) * out)


def _floor(x: Tensor) -> float:
    return FLOOR.get(x.dtype, float(torch.finfo(x.dtype).tiny))


def exp_base(base: float, x: Tensor) -> Tensor:
    """baseˣ for a number base > 0."""
    return torch.exp(x * math.log(base))


def sigmoid(x: Tensor) -> Tensor:
    """1/(1 + e⁻ˣ), without overflow on either side."""
    positive = x >= 0
    e = torch.exp(torch.where(positive, -x, x))
    r = 1.0 / (1.0 + e)
    return torch.where(positive, r, e * r)


def softplus(x: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Tensor:
    """log(1 + e^{βx})/β, exact beyond `threshold` too, which exists for torch's signature."""
    y = x * beta
    positive = y >= 0
    tail = torch.log1p(torch.exp(torch.where(positive, -y, y)))
    return torch.where(positive, y + tail, tail) / beta


def silu(x: Tensor, inplace: bool = False) -> Tensor:
    """x/(1 + e⁻ˣ)."""
    return x * sigmoid(x)


def elu(x: Tensor, alpha: float = 1.0, inplace: bool = False) -> Tensor:
    """x above 0, α (eˣ − 1) below."""
    return torch.where(x > 0, x, alpha * torch.expm1(torch.where(x > 0, 0.0, x)))


def selu(x: Tensor, inplace: bool = False) -> Tensor:
    """β x above 0, β α (eˣ − 1) below, with torch's α and β."""
    return 1.0507009873554804934193349852946 * elu(x, 1.6732632423543772848170429916717)


def celu(x: Tensor, alpha: float = 1.0, inplace: bool = False) -> Tensor:
    """x above 0, α (e^{x/α} − 1) below."""
    return torch.where(x > 0, x, alpha * torch.expm1(torch.where(x > 0, 0.0, x) / alpha))


def mish(x: Tensor, inplace: bool = False) -> Tensor:
    """x tanh(log(1 + eˣ))."""
    return x * torch.tanh(softplus(x))


def gelu(x: Tensor, approximate: str = "none") -> Tensor:
    """x times the share of a normal law below x; "tanh" has torch's approximation of it."""
    if approximate == "tanh":
        inner = math.sqrt(2 / math.pi) * (x + 0.044715 * x * x * x)
        return 0.5 * x * (1 + torch.tanh(inner))
    return 0.5 * x * (1 + torch.erf(x * math.sqrt(0.5)))


def logit(x: Tensor, eps: float | None = None) -> Tensor:
    """log(x/(1 − x)), of x between eps and 1 − eps if that is given."""
    x = x if eps is None else x.clamp(eps, 1 - eps)
    return torch.log(x / (1 - x))


def atan2(y: Tensor, other: Tensor) -> Tensor:
    """The angle of (x, y), from −π to π; x: `other`, as torch calls it."""
    infinite = torch.isinf(y) & torch.isinf(other)
    y, x = (torch.where(infinite, torch.sign(z), z) for z in (y, other))
    steep = y.abs() > x.abs()
    over, under = torch.where(steep, x, y), torch.where(steep, y, x)
    none = under == 0  # both are
    angle = torch.atan(over / torch.where(none, 1.0, under))
    half = torch.copysign(torch.full_like(angle, math.pi / 2), y)
    back = torch.where(torch.signbit(x), 2 * half, 0.0)
    return torch.where(steep, half - angle, torch.where(none, back, angle + back))


def sinh(x: Tensor) -> Tensor:
    """(eˣ − e⁻ˣ)/2."""
    return 0.5 * (torch.expm1(x) - torch.expm1(-x))


def cosh(x: Tensor) -> Tensor:
    """(eˣ + e⁻ˣ)/2."""
    return 0.5 * (torch.exp(x) + torch.exp(-x))


def atanh(x: Tensor) -> Tensor:
    """½ log((1 + x)/(1 − x))."""
    return 0.5 * (torch.log1p(x) - torch.log1p(-x))


def logaddexp(x: Tensor, other: Tensor) -> Tensor:
    """log(eˣ + eʸ)."""
    first = x >= other
    high, low = torch.where(first, x, other), torch.where(first, other, x)
    gap = torch.where(
        torch.isfinite(high), low - high, 0.0
    )  # the difference of infinities is undefined
    return high + torch.log1p(torch.exp(gap))


def rsqrt(x: Tensor) -> Tensor:
    """1/√x."""
    return 1.0 / torch.sqrt(x)


def hypot(x: Tensor, other: Tensor) -> Tensor:
    """√(x² + y²)."""
    return torch.sqrt(x * x + other * other)


def _linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor | None:
    if not _is_plain(x) or not _is_plain(weight):
        return None
    fits = x.dim() > 0 and weight.dim() == 2 and 0 < x.shape[-1] == weight.shape[1] <= MOST_TERMS
    return linear(x, weight, bias) if fits else None


def _matmul(x: Tensor, y: Tensor) -> Tensor | None:
    if not _is_plain(x) or not _is_plain(y) or x.dim() == 0:
        return None
    if y.dim() == 1 and x.dim() > 1:
        found = _linear(x, y.unsqueeze(0))
        return None if found is None else found.squeeze(-1)
    return _linear(x, y.t()) if y.dim() == 2 else None


def _of_matrix(x: Tensor, y: Tensor, dim: int) -> Tensor | None:
    """The product of a matrix with one of `dim` axes; torch refuses others."""
    fits = isinstance(x, Tensor) and isinstance(y, Tensor) and (x.dim(), y.dim()) == (2, dim)
    return _matmul(x, y) if fits and x.dtype == y.dtype else None


def _is_plain(x: object) -> bool:
    """Whether it is a tensor of real numbers that lie in rows, as those of cells do."""
    return isinstance(x, Tensor) and x.layout is torch.strided and x.dtype in FLOOR


def _pow(x: Tensor | float, n: float | Tensor) -> Tensor | None:
    if isinstance(x, Tensor):
        if not _is_plain(x) or isinstance(n, bool) or not isinstance(n, (int, float, Tensor)):
            return None
        if isinstance(n, Tensor):
            whole = not n.is_floating_point()
            if n.layout is not torch.strided or n.is_complex() or (whole and n.dim() == 0):
                return None
            return power(x, n.to(x.dtype) if whole else n)
        return power(x, n)
    return _rpow(n, x) if isinstance(n, Tensor) else None


def _rpow(n: Tensor, x: float | Tensor) -> Tensor | None:
    if isinstance(x, Tensor):
        return _pow(x, n)
    return (
        exp_base(x, n) if n.is_floating_point() and isinstance(x, (int, float)) and x > 0 else None
    )


def _ipow(x: Tensor, n: float | Tensor) -> Tensor | None:
    out = _pow(x, n)
    return None if out is None else x.copy_(out)


def _sum(x: Tensor, dim: Any = None, keepdim: Any = False, **other: Any) -> Tensor | None:
    """The sum over one axis of a few numbers, in their order."""
    dim = other.pop("axis", dim)  # NumPy's name of it
    dim = dim[0] if isinstance(dim, (tuple, list)) and len(dim) == 1 else dim
    one_axis = type(dim) is int and type(keepdim) is bool and not other
    if not one_axis or x.dim() < 2 or not 1 < x.shape[dim] <= MOST_COLUMNS:
        return None
    first, *others = x.unbind(dim)
    for column in others:
        first = first + column
    return first.unsqueeze(dim) if keepdim else first


def _mean(x: Tensor, dim: Any = None, keepdim: Any = False, **other: Any) -> Tensor | None:
    found = _sum(x, dim, keepdim, **other)
    if found is None or not found.numel():
        return found
    return found / (x.numel() // found.numel())


def _floating(function: Callable[..., Tensor | None]) -> Callable[..., Tensor | None]:
    def replaced(input: Tensor, *args: Any, **kwargs: Any) -> Tensor | None:
        return function(input, *args, **kwargs) if _is_plain(input) else None

    return replaced


# Replacements of torch's functions. A replacement that returns None leaves the call to torch.
REPLACEMENTS: dict[Callable[..., Any], Callable[..., Tensor | None]] = {
    **dict.fromkeys((torch.pow, Tensor.pow, Tensor.__pow__), _pow),
    **dict.fromkeys((Tensor.__rpow__,), _rpow),
    **dict.fromkeys((Tensor.pow_, Tensor.__ipow__), _ipow),
    **dict.fromkeys(
        (torch.sigmoid, Tensor.sigmoid, torch.special.expit, torch.nn.functional.sigmoid),
        _floating(sigmoid),
    ),
    **dict.fromkeys(
        (torch.exp2, Tensor.exp2, torch.special.exp2), _floating(lambda x: exp_base(2.0, x))
    ),
    **dict.fromkeys((torch.sinh, Tensor.sinh), _floating(sinh)),
    **dict.fromkeys((torch.cosh, Tensor.cosh), _floating(cosh)),
    **dict.fromkeys((torch.atanh, Tensor.atanh, torch.arctanh, Tensor.arctanh), _floating(atanh)),
    **dict.fromkeys((torch.logaddexp, Tensor.logaddexp), _floating(logaddexp)),
    **dict.fromkeys((torch.hypot, Tensor.hypot), _floating(hypot)),
    **dict.fromkeys((torch.rsqrt, Tensor.rsqrt), _floating(rsqrt)),
    **dict.fromkeys((torch.atan2, Tensor.atan2, torch.arctan2, Tensor.arctan2), _floating(atan2)),
    **dict.fromkeys((torch.logit, Tensor.logit, torch.special.logit), _floating(logit)),
    **dict.fromkeys((torch.sum, Tensor.sum), _floating(_sum)),
    **dict.fromkeys((torch.mean, Tensor.mean), _floating(_mean)),
    Tensor.sigmoid_: _floating(lambda x: x.copy_(sigmoid(x))),
    torch.nn.functional.selu: _floating(selu),
    torch.nn.functional.celu: _floating(celu),
    torch.nn.functional.mish: _floating(mish),
    torch.nn.functional.gelu: _floating(gelu),
    torch.selu: _floating(selu),
    torch.celu: _floating(celu),
    torch.nn.functional.softplus: _floating(softplus),
    torch.nn.functional.silu: _floating(silu),
    torch.nn.functional.elu: _floating(elu),
    torch.nn.functional.linear: _linear,
    **dict.fromkeys((torch.matmul, Tensor.matmul, Tensor.__matmul__), _matmul),
    **dict.fromkeys((torch.mv, Tensor.mv), lambda x, y: _of_matrix(x, y, 1)),
    **dict.fromkeys((torch.mm, Tensor.mm), lambda x, y: _of_matrix(x, y, 2)),
}
# Where each of these is told to write into its argument, among what it is given.
IN_PLACE = {
    torch.nn.functional.silu: 1, torch.nn.functional.mish: 1, torch.nn.functional.selu: 1,
    torch.nn.functional.elu: 2, torch.nn.functional.celu: 2,
}  # fmt: skip
# Torch's names of first and second arguments.
FIRST, SECOND = ("input", "self"), ("exponent", "other", "mat2", "vec", "weight")


class _DeterministicMode(TorchFunctionMode):
    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        replacement = REPLACEMENTS.get(func)
        if replacement is not None and "out" not in kwargs:
            given, named = (args, kwargs) if not kwargs else _in_order(args, kwargs)
            found = replacement(*given, **named)
            if found is not None:
                at = IN_PLACE.get(func, len(given))
                inside = named.get("inplace") or (at < len(given) and given[at])
                return given[0].copy_(found) if inside else found
        return func(*args, **kwargs)


def _in_order(
    args: Sequence[Any], kwargs: Mapping[str, Any]
) -> tuple[Sequence[Any], dict[str, Any]]:
    """The arguments with the first two by their place, if these were given by name."""
    args, rest = list(args), dict(kwargs)
    for place, names in enumerate((FIRST, SECOND)):
        for name in names:
            if len(args) == place and name in rest:
                args.append(rest.pop(name))
    return args, rest


def deterministic_functions() -> TorchFunctionMode:
    """Within `with deterministic_functions():` this module's functions replace torch's.

    It covers pow and **, rsqrt, sigmoid, exp2, sinh, cosh, atanh, softplus, silu, elu, selu, celu,
    mish, gelu, logit, logaddexp, hypot, atan2, linear layers, products with a matrix (K, M), and
    sums and means over an axis of up to MOST_COLUMNS, in the forward and reverse modes of autograd.
    It does not cover gammainc, einsum, products with batches of matrices, and other forms in place.
    The cost is about a microsecond per torch call.
    """
    return _DeterministicMode()
