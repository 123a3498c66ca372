"""A vector of the processor as a number: one of a few cells in each of its lanes.

What is written for one cell with the functions here runs for WIDTH cells at once: arithmetic,
comparisons, `abs` and numpy's functions of one number take vectors; `where` stands for `if`, and
`&`, `|`, `negated` for `and`, `or`, `not`. A lane has the bits that the cell would have alone.
Numbers are float64 or float32; a comparison gives a mask. Python takes numbers, for a WIDTH of 1.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numba.extending
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel.models import PrimitiveModel
from numba.core.typing.templates import AbstractTemplate, infer, infer_global, signature

from torchfilm.kernels.lanes import INDEX, filled

# One of the widest vectors that processors have; where they are shorter, two or four.
WIDTH = 8

extending: Any = numba.extending
# Rules for this processor are asked before those for all, of which Numba has dozens an operator:
# asking these took a third of the time to compile a circuit.
ASKED_FIRST = {"target": "cpu"}
IN_LLVM = {
    types.float64: ir.DoubleType(),
    types.float32: ir.FloatType(),
    types.boolean: ir.IntType(1),
}


class Vector(types.Type):
    """The type of a vector of such numbers."""

    def __init__(self, dtype):
        self.dtype = dtype
        super().__init__(name=f"Vector({dtype})")


@extending.register_model(Vector)
class VectorModel(PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(IN_LLVM[kind.dtype], WIDTH))


DOUBLES, FLOATS, MASK = Vector(types.float64), Vector(types.float32), Vector(types.boolean)


# --- what Python does, where a vector is one number -----------------------------------------------


def where(condition, yes, no):
    """`yes` where the condition holds, else `no`."""
    return yes if condition else no


def any_of(condition):
    """Whether the condition holds in any lane."""
    return condition


def negated(condition):
    return not condition


def wide(x):
    """x in float64."""
    return np.float64(x)


def narrow(x):
    """x in float32."""
    return np.float32(x)


def like(x, y):
    """The number x as what y is, a vector or a number."""
    return x


def load(rows, k):
    """The row k of contiguous rows (K, WIDTH) float64."""
    return rows[k, 0]


def store(rows, k, x):
    """Put x into the row k."""
    rows[k, 0] = x


def near_inverse_cube_root(x):
    """x^(−1/3) within a tenth, of a vector of normal numbers above 0."""
    return x ** (-1 / 3)


# --- and what it is compiled to -------------------------------------------------------------------


def _converted(context, builder, value, kind, wanted):
    """A value of this kind as a vector of the wanted kind."""
    if not isinstance(kind, Vector):
        number = context.cast(builder, value, kind, wanted.dtype)
        return filled(builder, ir.VectorType(number.type, WIDTH), number)
    if kind == wanted:
        return value
    vector = ir.VectorType(IN_LLVM[wanted.dtype], WIDTH)
    if kind == MASK:
        one, zero = (ir.Constant(vector, [x] * WIDTH) for x in (1.0, 0.0))
        return builder.select(value, one, zero)
    convert = builder.fpext if wanted == DOUBLES else builder.fptrunc
    return convert(value, vector)


def _common(*kinds):
    """The type of vectors in which numbers of these kinds meet, of which one is a vector."""
    if all(getattr(k, "dtype", k) == types.boolean for k in kinds):
        return MASK
    floats = {getattr(k, "dtype", k) for k in kinds} - {types.boolean}
    return FLOATS if floats == {types.float32} else DOUBLES


Emit = Callable[..., Any]  # (context, builder, kinds, wanted, values) -> value


def _compiled(function: Any, result: Callable[..., Any], emit: Emit, *forms: tuple) -> None:
    """Compile calls of a function, of these forms, to what `emit` gives. result(typing, *kinds):
    the type of what the function returns, or None."""

    class Rule(AbstractTemplate):
        key = function
        metadata = ASKED_FIRST

        def generic(self, kinds, named):
            found = None if named else result(self.context, *kinds)
            return found and signature(found, *kinds)

    infer(Rule)
    infer_global(function, types.Function(Rule))

    def lower(context, builder, signature, values):
        return emit(context, builder, signature.args, signature.return_type, values)

    for form in forms or [(types.VarArg(types.Any),)]:
        extending.lower_builtin(function, *form)(lower)


ONE = ((Vector,),)
TWO = (
    (Vector, Vector), (Vector, types.Number), (types.Number, Vector), (Vector, types.Boolean),
    (types.Boolean, Vector),
)  # fmt: skip


def _also_of_vectors(function: Any, result: Callable[..., Any], emit: Emit, *forms: tuple) -> None:
    """The same for a function that Numba has for numbers."""
    some = lambda kinds: any(isinstance(k, Vector) for k in kinds)
    rule = lambda typing, *kinds: result(*kinds) if some(kinds) else None
    _compiled(function, rule, emit, *forms)


def _all_converted(context, builder, kinds, wanted, values):
    return [_converted(context, builder, x, k, wanted) for x, k in zip(values, kinds, strict=True)]


def _arithmetic(instruction: str) -> Emit:
    def compute(context, builder, kinds, wanted, values):
        each = _all_converted(context, builder, kinds, wanted, values)
        return getattr(builder, instruction)(*each)

    return compute


def _comparison(sign: str) -> Emit:
    def compare(context, builder, kinds, wanted, values):
        each = _all_converted(context, builder, kinds, _common(*kinds), values)
        # as for numbers: what is no number is unequal to all, and in no order
        ordered = builder.fcmp_unordered if sign == "!=" else builder.fcmp_ordered
        return ordered(sign, *each)

    return compare


def _instruction(name: str) -> Emit:
    """A function that processors have."""

    def call(context, builder, kinds, wanted, values):
        kind = ir.FunctionType(values[0].type, [values[0].type])
        bits = 64 if wanted == DOUBLES else 32
        function = f"llvm.{name}.v{WIDTH}f{bits}"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, function), values)

    return call


def _lane_by_lane(function: Callable[..., Any]) -> Emit:
    """A function of numbers, called for one lane after the other."""

    def call(context, builder, kinds, wanted, values):
        each = _all_converted(context, builder, kinds, wanted, values)
        of_number = wanted.dtype(*(wanted.dtype for _ in each))
        out = ir.Constant(each[0].type, ir.Undefined)
        for k in range(WIDTH):
            numbers = [builder.extract_element(x, INDEX(k)) for x in each]
            found = context.compile_internal(builder, function, of_number, numbers)
            out = builder.insert_element(out, found, INDEX(k))
        return out

    return call


def _of_one(function: Any) -> Callable[..., Any]:
    return lambda x: function(x)


def _operators() -> None:
    mask, same = lambda *kinds: MASK, lambda kind: kind
    for name, what in {"add": "fadd", "sub": "fsub", "mul": "fmul", "truediv": "fdiv"}.items():
        for function in (getattr(operator, name), getattr(operator, f"i{name}")):
            _also_of_vectors(function, _common, _arithmetic(what), *TWO)
    for name, sign in {
        "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!=",
    }.items():  # fmt: skip
        _also_of_vectors(getattr(operator, name), mask, _comparison(sign), *TWO)
    for name in ("and", "or"):
        for function in (getattr(operator, f"{name}_"), getattr(operator, f"i{name}")):
            _also_of_vectors(function, mask, _arithmetic(f"{name}_"), *TWO)
    minus = lambda context, builder, kinds, wanted, values: builder.fneg(values[0])
    _also_of_vectors(operator.neg, same, minus, *ONE)
    _also_of_vectors(abs, same, _instruction("fabs"), *ONE)
    _also_of_vectors(np.sqrt, same, _instruction("sqrt"), *ONE)
    _also_of_vectors(np.floor, same, _instruction("floor"), *ONE)
    for function in (
        np.exp, np.expm1, np.log, np.log1p, np.log2, np.log10, np.sin, np.cos, np.tan, np.tanh,
        np.arctan,
    ):  # fmt: skip
        _also_of_vectors(function, same, _lane_by_lane(_of_one(function)), *ONE)
    _also_of_vectors(np.remainder, _common, _lane_by_lane(lambda x, y: np.remainder(x, y)), *TWO)


_operators()


def _where_type(typing, condition, yes, no):
    if isinstance(condition, Vector) or isinstance(yes, Vector) or isinstance(no, Vector):
        return _common(yes, no)
    return typing.unify_types(yes, no)


def _where(context, builder, kinds, wanted, values):
    if isinstance(wanted, Vector):
        sides = _all_converted(context, builder, kinds[1:], wanted, values[1:])
        condition = _converted(context, builder, values[0], kinds[0], MASK)
        return builder.select(condition, *sides)
    pairs = zip(values[1:], kinds[1:], strict=True)
    return builder.select(values[0], *(context.cast(builder, x, k, wanted) for x, k in pairs))


def _any_of(context, builder, kinds, wanted, values):
    if kinds[0] != MASK:
        return values[0]
    bits = builder.bitcast(values[0], ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


def _negated(context, builder, kinds, wanted, values):
    return builder.not_(values[0])


def _of_type(number, vector):
    """How to compile a conversion to this type of numbers."""

    def convert(context, builder, kinds, wanted, values):
        if isinstance(wanted, Vector):
            return _converted(context, builder, values[0], kinds[0], wanted)
        return context.cast(builder, values[0], kinds[0], wanted)

    return lambda typing, kind: vector if isinstance(kind, Vector) else number, convert


def _like(context, builder, kinds, wanted, values):
    if isinstance(wanted, Vector):
        return _converted(context, builder, values[0], kinds[0], wanted)
    return values[0]


def _row(context, builder, kinds, values):
    """The address of a row of an array."""
    data = context.make_array(kinds[0])(context, builder, values[0]).data
    k = context.cast(builder, values[1], kinds[1], types.intp)
    first = builder.gep(data, [builder.mul(k, k.type(WIDTH))])
    return builder.bitcast(first, ir.VectorType(ir.DoubleType(), WIDTH).as_pointer())


def _load(context, builder, kinds, wanted, values):
    return builder.load(_row(context, builder, kinds, values), align=8)


def _store(context, builder, kinds, wanted, values):
    x = _converted(context, builder, values[2], kinds[2], DOUBLES)
    builder.store(x, _row(context, builder, kinds, values), align=8)
    return context.get_dummy_value()


def _near_inverse_cube_root(context, builder, kinds, wanted, values):
    # by the exponent, which stands in the upper half together with the first digits
    long, short = (ir.VectorType(ir.IntType(k), WIDTH) for k in (64, 32))
    bits = builder.bitcast(values[0], long)
    upper = builder.trunc(builder.lshr(bits, long(WIDTH * [32])), short)
    # 4/3 of the exponent's own 0, less what makes the errors above and below alike
    found = builder.sub(short(WIDTH * [0x553EF0FF]), builder.udiv(upper, short(WIDTH * [3])))
    bits = builder.shl(builder.zext(found, long), long(WIDTH * [32]))
    return builder.bitcast(bits, values[0].type)


_compiled(where, _where_type, _where)
_compiled(any_of, lambda typing, condition: types.boolean, _any_of)
_compiled(negated, lambda typing, condition: condition, _negated)
_compiled(wide, *_of_type(types.float64, DOUBLES))
_compiled(narrow, *_of_type(types.float32, FLOATS))
_compiled(like, lambda typing, x, y: y if isinstance(y, Vector) else x, _like)
_compiled(load, lambda typing, rows, k: DOUBLES, _load)
_compiled(near_inverse_cube_root, lambda typing, x: x, _near_inverse_cube_root)
_compiled(store, lambda typing, rows, k, x: types.void, _store)
