"""Tracing: a rate function is called once with columns that note what is done with them.

A traced column is a tensor without numbers: torch hands every operation on it to
`Column.__torch_function__`. What is noted keeps the order of operations and the type of numbers, so
that arithmetic gives the same bits.
"""

from __future__ import annotations

import math
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits.expressions import LOGICAL, NUMBER, Builder, Expression, walk
from torchfilm.tools import deterministic_math as steady

WIDTH = 2  # cells of a traced column, for its shape only


class Untraceable(Exception):
    """A rate function does what an expression cannot say. The text tells what, and where."""


class Column(Tensor):
    """A column over cells, or with no dimension one number for all, of which only an expression is
    known."""

    expression: Expression
    builder: Builder

    @staticmethod
    def of(expression: Expression, builder: Builder, dtype: torch.dtype, dim: int = 1) -> Column:
        made = torch.empty((WIDTH,) * dim, dtype=dtype).as_subclass(Column)
        made.expression, made.builder = expression, builder
        return made

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        with torch._C.DisableTorchFunctionSubclass():
            if func in SHAPE:
                return func(*args, **(kwargs or {}))
            if func is Tensor.__repr__:
                return f"Column({args[0].expression.op})"
        rule = RULES.get(func)
        if rule is None:
            raise Untraceable(f"it uses {_said(getattr(func, '__name__', str(func)))}{_place()}")
        try:
            return rule(*args, **(kwargs or {}))
        except TypeError as error:
            name = getattr(func, "__name__", str(func))
            raise Untraceable(f"it uses {name} in a way not known here{_place()}") from error


# What may be asked of a column without looking at its numbers.
SHAPE = {
    getattr(Tensor, n).__get__ for n in ("dtype", "device", "requires_grad", "is_sparse", "layout")
} | {Tensor.is_floating_point, torch.is_floating_point, Tensor.is_complex, Tensor.dim}
# What a user meant by calling these.
_ONE, _ALL = "a column as one number", "a sum or the like over all cells"
_COUNT, _APART, _CHANCE = "the number of cells", "the cells one by one", "random numbers"
WORDS = {
    "__bool__": (
        "the value of a column in `if`, `and`, `or`, `not`, `min` or `max`: write torch.where,"
        " torch.minimum or torch.maximum"
    ),
    **dict.fromkeys(
        ("__float__", "__int__", "__complex__", "__index__", "item"),
        f"{_ONE} (float, .item() or a function of math): write torch.exp and the like",
    ),
    **dict.fromkeys(("__array__", "numpy"), "numpy: write torch.exp and the like"),
    **dict.fromkeys(("__len__", "size", "numel"), _COUNT),
    **dict.fromkeys(("__iter__", "unbind", "tolist"), _APART),
    **dict.fromkeys(("__getitem__", "masked_select", "take", "gather"), "some of the cells"),
    "index_select": (
        "some of the cells, or a constant per colony inside a reaction: name the constant, and give"
        " it to Circuit"
    ),
    "__setitem__": "a change in place",
    "__get__": "the shape or another property of a column",
    **{n: f"{_ALL} ({n})" for n in ("sum", "mean", "prod", "cumsum", "std", "var", "any", "all")},
    **{n: f"{_ALL} ({n})" for n in ("amax", "amin", "argmax", "argmin", "max", "min", "median")},
    **{n: f"{n}, which puts columns together" for n in ("stack", "cat", "hstack", "vstack")},
    **{n: f"{n}, which mixes columns or cells" for n in ("linear", "matmul", "__matmul__", "dot")},
    **{n: f"{_CHANCE} ({n})" for n in ("rand_like", "randn_like", "bernoulli", "poisson")},
}


def _said(name: str) -> str:
    """What a function does, for a message."""
    in_place = name.endswith("_") and not name.endswith("__")
    return WORDS.get(name, f"a change in place ({name})" if in_place else name)


# Where the user's own code is not: here, where powers are replaced, and in torch.
_HERE = Path(__file__).resolve().parent
_INSIDE = tuple(str(p) for p in (_HERE, _HERE.parent / "tools", Path(torch.__file__).parent))


def _place() -> str:
    """Where in the user's code, for a message."""
    for frame in reversed(traceback.extract_stack()[:-2]):
        if frame.name == TRACING:
            break
        if not str(Path(frame.filename).resolve()).startswith(_INSIDE):
            line = (frame.line or "").strip()
            at = f" (line {frame.lineno} of {Path(frame.filename).name}"
            return f"{at}: {line})" if line else f"{at})"
    return ""


TRACING = "traced_rates"  # the function that calls the user's


def named(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Let a rate law appear in expressions by its name."""

    def law(*args: Any, **kwargs: Any) -> Tensor:
        if kwargs or not any(type(a) is Column for a in args):
            return function(*args, **kwargs)
        return apply(function.__name__, *args)

    law.__name__, law.__doc__, law.__wrapped__ = (  # type: ignore
        function.__name__, function.__doc__, function,
    )  # fmt: skip
    LAWS[function.__name__] = function
    return law


def _power(x: Any, n: Any) -> Tensor:
    """xⁿ as circuits evaluate it; x or n may be a number."""
    if not isinstance(x, Tensor):
        return steady.exp_base(x, n) if x > 0 else steady.power(torch.full_like(n, x), n)
    if type(x) is not Column or isinstance(n, Tensor):
        return steady.power(x, n)
    if n < 0:
        return _power(x, -n).reciprocal()
    if n > steady.MAX_SQUARED or not math.isfinite(n):
        n = _constant(x, n, 0)  # where `steady.power` makes a tensor of it
    return steady.power(x, n)


_TRACING: ContextVar[bool] = ContextVar("tracing", default=False)
_OF_A_FUNCTION = torch.autograd.Function.apply.__func__.__code__  # type: ignore[attr-defined]


@contextmanager
def users_code() -> Iterator[None]:
    """Within it a user's function is traced: also what it does to derivatives is noted."""
    before = _TRACING.set(True)
    try:
        with torch.enable_grad():
            yield
    finally:
        _TRACING.reset(before)


def _note_derivatives(builder: Builder) -> None:
    """Note in the builder where the user's code gives an operation another derivative than its
    own."""
    if not _TRACING.get():
        return
    if not torch.is_grad_enabled():
        builder.own_derivative = "gradients are off in parts of it"
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and frame.f_code.co_name != TRACING:
        if frame.f_code is _OF_A_FUNCTION:
            name = getattr(frame.f_locals.get("cls"), "__name__", "a function")
            builder.own_derivative = f"{name} has a derivative of its own"
        frame = frame.f_back


# Functions made of others, by name: as rate laws, and as circuits evaluate powers and their like.
LAWS: dict[str, Callable[..., Tensor]] = {
    "pow": _power,
    "exp2": lambda x: steady.exp_base(2.0, x),
    **{
        name: getattr(steady, name)
        for name in (
            "sigmoid", "softplus", "silu", "elu", "sinh", "cosh", "atanh", "logaddexp", "hypot",
        )
    },
}  # fmt: skip


def apply(op: str, *args: Any) -> Column:
    """A column that is an operation on others and on numbers."""
    columns = [a for a in args if type(a) is Column]
    first = columns[0]
    if not all(type(a) is Column or isinstance(a, (int, float)) for a in args):
        raise Untraceable(
            "it uses a tensor or an array that is no column: a draw, or one from outside, to be"
            f" given to Circuit as a constant and read as p.name{_place()}"
        )
    parts = [a.expression if type(a) is Column else first.builder.number(float(a)) for a in args]
    kinds = [(a.dtype, a.dim()) if type(a) is Column else None for a in args]
    counted = columns[:0] if op in (*LOGICAL, *CASTS, "detach") else columns
    if op == "where":
        counted = [a for a in args[1:] if type(a) is Column]
    if counted and not any(a.is_floating_point() for a in counted):
        raise Untraceable(
            f"it calculates with whole numbers or truth values ({op}): write torch.where, or"
            f" .to(u.name.dtype){_place()}"
        )
    _note_derivatives(first.builder)
    return Column.of(first.builder.make(op, *parts), first.builder, *kind_of(op, kinds))


# Numbers as a type; "full": as a column of that type, one value for each cell.
CASTS = {f"{n}{k}": getattr(torch, f"float{k}") for n in ("cast", "full") for k in (32, 64)}
FULL = ("full32", "full64")

# The type of a column, and 1, or 0 where it is one number for all cells; None for a plain number.
Kind = tuple[torch.dtype, int]


def kind_of(op: str, kinds: Sequence[Kind | None]) -> Kind:
    """The kind of an operation's result. As torch promotes: the type is that of the columns; of
    numbers for all cells, where there is no column; at least a float in both."""
    dim = max((k[1] for k in kinds if k is not None), default=0)
    if op in LOGICAL:
        return torch.bool, dim
    if op in CASTS:
        return CASTS[op], 1 if op in FULL else dim
    return common_type(kinds[1:] if op == "where" else kinds), dim


def common_type(kinds: Sequence[Kind | None]) -> torch.dtype:
    """The type in which torch computes with operands of these kinds."""
    for dim in (1, 0):
        floats = [k[0] for k in kinds if k is not None and k[1] == dim and k[0].is_floating_point]
        if floats:
            return torch.float64 if torch.float64 in floats else floats[0]
    return torch.get_default_dtype()


# --- what torch's functions become ---------------------------------------------------------------


def _binary(op: str) -> Callable[..., Column]:
    def rule(x: Any, y: Any, *, alpha: float = 1, rounding_mode: Any = None) -> Column:
        if rounding_mode is not None:
            raise TypeError("rounding")
        return apply(op, x, y if alpha == 1 else apply("mul", y, alpha))

    return rule


def _unary(op: str) -> Callable[..., Column]:
    return lambda x: apply(op, x)


def _swapped(op: str) -> Callable[..., Column]:
    return lambda x, y: apply(op, y, x)


def _clamp(x: Any, min: Any = None, max: Any = None) -> Column:
    x = x if min is None else apply("maximum", x, min)
    return x if max is None else apply("minimum", x, max)


def _like(value: float) -> Callable[..., Column]:
    """A column of one number, of the type of another."""

    return lambda x, *, dtype=None: _constant(x, value, x.dim(), dtype)


def _constant(x: Column, value: Any, dim: int, dtype: Any = None) -> Column:
    """One number as a column like x, or with dim 0 as one of all cells."""
    dtype = x.dtype if dtype is None else dtype
    names = {t: n for n, t in CASTS.items() if (n in FULL) == bool(dim)}
    if not isinstance(value, (int, float)) or dtype not in names:
        raise TypeError(str(value))
    made = x.builder.make(names[dtype], x.builder.number(value))
    return Column.of(made, x.builder, dtype, dim)


def _to(x: Column, *given: Any, dtype: Any = None, device: Any = None) -> Column:
    wanted = [g for g in given if isinstance(g, torch.dtype)] + [dtype] * (dtype is not None)
    wanted += [g.dtype for g in given if isinstance(g, Tensor)]
    if not wanted or wanted[0] == x.dtype:
        return x
    names = {torch.float32: "cast32", torch.float64: "cast64"}
    if wanted[0] not in names:
        raise TypeError(str(wanted[0]))
    return apply(names[wanted[0]], x)


def _logical(op: str) -> Callable[..., Column]:
    """Of truth values; other numbers are true where they are not 0."""
    truth = lambda x: apply("ne", x, 0.0) if type(x) is Column and x.dtype != torch.bool else x
    return lambda *args: apply(op, *map(truth, args))


def _of_bits(op: str) -> Callable[..., Column]:
    """&, | and ~: of truth values only, since they mean bits elsewhere."""

    def rule(*args: Any) -> Column:
        if not all(type(a) is Column and a.dtype == torch.bool for a in args):
            raise Untraceable(f"it uses &, | or ~ with other than truth values{_place()}")
        return apply(op, *args)

    return rule


def _two(op: str) -> Callable[..., Column]:
    """min and max of two columns, as torch.min(x, y); of one they are over all cells."""

    def rule(x: Any, *y: Any) -> Column:
        if len(y) != 1 or type(y[0]) is not Column:
            raise Untraceable(f"it uses {WORDS[op[:3]]}{_place()}")
        return apply(op, x, y[0])

    return rule


def _as_module(rule: Callable[[Any], Column], **defaults: Any) -> Callable[..., Column]:
    """A function with options that a torch.nn module passes along: their defaults only."""

    def plain(x: Any, **options: Any) -> Column:
        if any(options[n] != defaults.get(n, False) for n in options):
            raise TypeError(str(options))
        return rule(x)

    return plain


RULES: dict[Any, Callable[..., Any]] = {}


def _note(rule: Callable[..., Any], *names: str) -> None:
    for name in names:
        own = name.startswith("__")  # modules have methods of these names, too
        for home in (Tensor,) if own else (torch, Tensor, torch.special, torch.nn.functional):
            found = getattr(home, name, None)
            if callable(found):
                RULES[found] = rule


for _op, _names in {
    "add": "add __add__ __radd__", "sub": "sub subtract __sub__",
    "mul": "mul multiply __mul__ __rmul__", "div": "div divide true_divide __truediv__",
    "pow": "pow __pow__", "minimum": "minimum", "maximum": "maximum",
    "gt": "gt greater __gt__", "ge": "ge greater_equal __ge__", "lt": "lt less __lt__",
    "le": "le less_equal __le__", "eq": "eq __eq__", "ne": "ne not_equal __ne__",
    "logaddexp": "logaddexp", "hypot": "hypot",
}.items():  # fmt: skip
    _note(_binary(_op), *_names.split())
for _op, _names in {
    "neg": "neg negative __neg__", "abs": "abs absolute __abs__", "exp": "exp", "expm1": "expm1",
    "log": "log", "log1p": "log1p", "log2": "log2", "log10": "log10", "sqrt": "sqrt", "sin": "sin",
    "cos": "cos", "tan": "tan", "tanh": "tanh", "atan": "atan arctan", "floor": "floor",
    "sign": "sign sgn", "detach": "detach", "sigmoid": "sigmoid expit", "exp2": "exp2",
    "sinh": "sinh", "cosh": "cosh", "atanh": "atanh arctanh",
}.items():  # fmt: skip
    _note(_unary(_op), *_names.split())
for _op, _sign in {"and": "__and__", "or": "__or__", "not": "__invert__"}.items():
    _note(_logical(_op), f"logical_{_op}")
    _note(_of_bits(_op), _sign)
_note(_as_module(_unary("softplus"), beta=1, threshold=20), "softplus")
_note(_as_module(_unary("elu"), alpha=1), "elu")
_note(_as_module(_unary("silu")), "silu")
_note(_swapped("sub"), "rsub", "__rsub__")
_note(lambda x, y: apply("mul", apply("div", 1.0, x), y), "__rtruediv__", "__rdiv__")
_note(_swapped("pow"), "__rpow__")
_note(_two("minimum"), "min")
_note(_two("maximum"), "max")
_note(lambda x, y: apply("remainder", x, y), "remainder", "__mod__")
_note(lambda c, x, y: apply("where", c, x, y), "where")
RULES[Tensor.where] = lambda x, c, y: apply("where", c, x, y)
_note(_clamp, "clamp", "clip")
_note(lambda x, min: _clamp(x, min=min), "clamp_min")
_note(lambda x, max: _clamp(x, max=max), "clamp_max")
_note(_as_module(lambda x: _clamp(x, min=0.0)), "relu")
_note(lambda x: apply("div", 1.0, x), "reciprocal")
_note(lambda x: apply("div", 1.0, apply("sqrt", x)), "rsqrt")
_note(lambda x: apply("mul", x, x), "square")
_note(_like(0.0), "zeros_like")
_note(_like(1.0), "ones_like")
_note(lambda x, fill_value, **dtype: _like(fill_value)(x, **dtype), "full_like")
_note(lambda x: x, "clone", "contiguous", "positive", "__pos__")
_note(_to, "to")
_note(lambda x: _to(x, torch.float64), "double")
_note(lambda x: _to(x, torch.float32), "float")
_note(lambda x, *_: x, "expand_as")

# --- lowering ------------------------------------------------------------------------------------


def lowered(
    roots: list[Expression], leaves: Mapping[Expression, Column], builder: Builder
) -> list[Column]:
    """The same expressions as columns of simple operations: laws, powers and their like as they are
    evaluated. leaves: the column of each name."""
    made: dict[Expression, Any] = {}
    for node in walk(roots):
        if node in leaves:
            made[node] = leaves[node]
        elif node.op == NUMBER:
            made[node] = node.value
        elif node.op in CASTS and node.args[0].op == NUMBER:
            again = builder.make(node.op, builder.number(node.args[0].value))
            made[node] = Column.of(again, builder, *kind_of(node.op, [None]))
        else:
            args = [made[a] for a in node.args]
            made[node] = LAWS[node.op](*args) if node.op in LAWS else apply(node.op, *args)
    return [made[r] for r in roots]
