"""Tracing: a rate function is called once with columns that note what is done with them.

A traced column is a tensor without numbers: torch hands every operation on it to
`Column.__torch_function__`. What is noted keeps the order of operations and the type of numbers, so
that arithmetic gives the same bits.
"""

from __future__ import annotations

import operator
import traceback
from collections.abc import Callable, Mapping, Sequence
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
            name = getattr(func, "__name__", str(func))
            raise Untraceable(f"it uses {WORDS.get(name, name)}{_place()}")
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
WORDS = {
    "__bool__": "the value of a column in `if`, `and`, `or`, `not`, `min` or `max`",
    "__len__": "the number of cells",
    "__iter__": "the cells one by one",
    "__getitem__": "some of the cells",
    "__setitem__": "a change in place",
    "__get__": "the shape or another property of a column",
    "item": "the value of a column",
    "__float__": "the value of a column",
    "tolist": "the values of a column",
}


def _place() -> str:
    """Where in the user's code, for a message."""
    inside = ("torchfilm", "torch")
    for frame in reversed(traceback.extract_stack()[:-2]):
        parts = frame.filename.replace("\\", "/").split("/")
        if not any(f"{name}" in parts for name in inside):
            return f" (line {frame.lineno} of {parts[-1]}: {frame.line})"
    return ""


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


# Functions made of others, by name: as rate laws, and as circuits evaluate powers and their like.
LAWS: dict[str, Callable[..., Tensor]] = {
    "pow": steady.power,
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
        raise Untraceable(f"it uses a tensor from outside{_place()}")
    parts = [a.expression if type(a) is Column else first.builder.number(float(a)) for a in args]
    kinds = [(a.dtype, a.dim()) if type(a) is Column else None for a in args]
    whole = not any(a.is_floating_point() for a in columns)
    if whole and op not in (*LOGICAL, "where", "cast32", "cast64", "detach"):
        raise Untraceable(f"it reckons with whole numbers ({op}){_place()}")
    return Column.of(first.builder.make(op, *parts), first.builder, *kind_of(op, kinds))


# The type of a column, and 1, or 0 where it is one number for all cells; None for a plain number.
Kind = tuple[torch.dtype, int]


def kind_of(op: str, kinds: Sequence[Kind | None]) -> Kind:
    """The kind of an operation's result. As torch promotes: the type is that of the columns; of
    numbers for all cells, where there is no column; at least a float in both."""
    dim = max((k[1] for k in kinds if k is not None), default=0)
    if op in LOGICAL:
        return torch.bool, dim
    if op in ("cast32", "cast64"):
        return (torch.float32 if op == "cast32" else torch.float64), dim
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

    def rule(x: Column, *, dtype: Any = None) -> Column:
        made = x.builder.number(value)
        return Column.of(made, x.builder, x.dtype if dtype is None else dtype, x.dim())

    return rule


def _to(x: Column, *given: Any, dtype: Any = None, device: Any = None) -> Column:
    wanted = [g for g in given if isinstance(g, torch.dtype)] + [dtype] * (dtype is not None)
    wanted += [g.dtype for g in given if isinstance(g, Tensor)]
    if not wanted or wanted[0] == x.dtype:
        return x
    names = {torch.float32: "cast32", torch.float64: "cast64"}
    if wanted[0] not in names:
        raise TypeError(str(wanted[0]))
    return apply(names[wanted[0]], x)


def _two(op: str) -> Callable[..., Column]:
    """min and max of two columns, as torch.min(x, y)."""
    return lambda x, y: apply(op, x, y)


RULES: dict[Any, Callable[..., Any]] = {}


def _note(rule: Callable[..., Any], *names: str) -> None:
    for name in names:
        for home in (torch, Tensor, torch.special, torch.nn.functional):
            found = getattr(home, name, None)
            if callable(found):
                RULES[found] = rule


for _op, _names in {
    "add": "add __add__ __radd__", "sub": "sub subtract __sub__",
    "mul": "mul multiply __mul__ __rmul__", "div": "div divide true_divide __truediv__",
    "pow": "pow __pow__", "minimum": "minimum", "maximum": "maximum",
    "gt": "gt greater __gt__", "ge": "ge greater_equal __ge__", "lt": "lt less __lt__",
    "le": "le less_equal __le__", "eq": "eq __eq__", "ne": "ne not_equal __ne__",
    "and": "logical_and __and__", "or": "logical_or __or__", "logaddexp": "logaddexp",
    "hypot": "hypot",
}.items():  # fmt: skip
    _note(_binary(_op), *_names.split())
for _op, _names in {
    "neg": "neg negative __neg__", "abs": "abs absolute __abs__", "exp": "exp", "expm1": "expm1",
    "log": "log", "log1p": "log1p", "log2": "log2", "log10": "log10", "sqrt": "sqrt", "sin": "sin",
    "cos": "cos", "tan": "tan", "tanh": "tanh", "atan": "atan arctan", "floor": "floor",
    "sign": "sign sgn", "not": "logical_not __invert__", "detach": "detach",
    "sigmoid": "sigmoid expit", "exp2": "exp2", "sinh": "sinh", "cosh": "cosh",
    "atanh": "atanh arctanh", "softplus": "softplus", "silu": "silu", "elu": "elu",
}.items():  # fmt: skip
    _note(_unary(_op), *_names.split())
_note(_swapped("sub"), "rsub", "__rsub__")
_note(_swapped("div"), "__rtruediv__", "__rdiv__")
_note(_swapped("pow"), "__rpow__")
_note(_two("minimum"), "min")
_note(_two("maximum"), "max")
_note(lambda x, y: apply("remainder", x, y), "remainder", "__mod__")
_note(lambda c, x, y: apply("where", c, x, y), "where")
RULES[Tensor.where] = lambda x, c, y: apply("where", c, x, y)
_note(_clamp, "clamp", "clip")
_note(lambda x, min: _clamp(x, min=min), "clamp_min")
_note(lambda x, max: _clamp(x, max=max), "clamp_max")
_note(lambda x: _clamp(x, min=0.0), "relu")
_note(lambda x: apply("div", 1.0, x), "reciprocal")
_note(lambda x: apply("div", 1.0, apply("sqrt", x)), "rsqrt")
_note(lambda x: apply("mul", x, x), "square")
_note(_like(0.0), "zeros_like")
_note(_like(1.0), "ones_like")
_note(lambda x, value: _like(value)(x), "full_like")
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
        else:
            args = [made[a] for a in node.args]
            made[node] = _evaluated(node.op, args)
    like = next(iter(leaves.values()))
    return [
        made[r] if type(made[r]) is Column else _like(made[r])(like)  # a rate that is a number
        for r in roots
    ]


def _evaluated(op: str, args: list[Any]) -> Any:
    """An operation on columns, or on numbers alone."""
    if any(type(a) is Column for a in args):
        return LAWS[op](*args) if op in LAWS else apply(op, *args)
    numbers = {"add": operator.add, "sub": operator.sub, "mul": operator.mul}
    if op in numbers:
        return numbers[op](*args)
    return float(getattr(torch, op)(*(torch.tensor(a, dtype=torch.float64) for a in args)))
