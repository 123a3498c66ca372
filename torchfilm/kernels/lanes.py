"""Whole rows of the contact problem at once, as vectors of the processor.

Arrays have `len(dof)` columns: 4 in the plane; 8 in space, of which the last stays 0. They are
contiguous, of one type, and their indices are not checked. A loop over so few columns would be
compiled to single operations, three times slower.
"""

from __future__ import annotations

from typing import Any

import numba.extending
from llvmlite import ir
from numba import types
from numba.core import cgutils

intrinsic: Any = numba.extending.intrinsic  # calls leave out its first argument
INDEX = ir.IntType(32)


class _Rows:
    """Loads and stores of rows of one array while a function is being emitted."""

    def __init__(self, context, builder, kind, array, width):
        self.builder, self.width, self.context = builder, width, context
        self.data = context.make_array(kind)(context, builder, array).data
        self.vector = ir.VectorType(context.get_data_type(kind.dtype), width)
        self.bytes = kind.dtype.bitwidth // 8

    def _at(self, i):
        builder = self.builder
        first = builder.gep(self.data, [builder.mul(i, ir.Constant(i.type, self.width))])
        return builder.bitcast(first, self.vector.as_pointer())

    def load(self, i):
        return self.builder.load(self._at(i), align=self.bytes)

    def store(self, i, value):
        self.builder.store(value, self._at(i), align=self.bytes)


def _lane(k):
    return ir.Constant(INDEX, k)


def _spread(builder, vector, k):
    """A vector that has lane k everywhere."""
    places = ir.Constant(ir.VectorType(INDEX, vector.type.count), [k] * vector.type.count)
    return builder.shuffle_vector(vector, vector, places)


def filled(builder, vector_type, value):
    """A vector of this type that has a value in all lanes."""
    empty = ir.Constant(vector_type, ir.Undefined)
    return _spread(builder, builder.insert_element(empty, value, _lane(0)), 0)


def _multiply_add(builder, a, b, c):
    return builder.fadd(builder.fmul(a, b, flags=("contract",)), c, flags=("contract",))


def _sum(builder, vector):
    parts = [builder.extract_element(vector, _lane(k)) for k in range(vector.type.count)]
    while len(parts) > 1:
        half = len(parts) // 2
        parts = [builder.fadd(parts[k], parts[k + half]) for k in range(half)]
    return parts[0]


def _check(*arrays):
    """Raise where arrays are not of one type, contiguous."""
    if any(a.layout != "C" or a.dtype != arrays[0].dtype for a in arrays):
        raise TypeError(f"rows of {arrays} are not contiguous, or not of one type")


def long_of(context, builder, signature, arguments, k):
    return context.cast(builder, arguments[k], signature.args[k], types.int64)


@intrinsic
def dot(typing, a, i, b, j, dof):
    """a[i] · b[j]."""
    _check(a, b)

    def emit(context, builder, signature, given):
        kinds = signature.args
        left = _Rows(context, builder, kinds[0], given[0], len(dof))
        right = _Rows(context, builder, kinds[2], given[2], len(dof))
        x = left.load(long_of(context, builder, signature, given, 1))
        y = right.load(long_of(context, builder, signature, given, 3))
        return _sum(builder, builder.fmul(x, y))

    return a.dtype(a, i, b, j, dof), emit


@intrinsic
def add_scaled(typing, a, i, t, b, j, dof):
    """a[i] += t · b[j], with t rounded to the type of a."""
    _check(a, b)

    def emit(context, builder, signature, given):
        kinds = signature.args
        left = _Rows(context, builder, kinds[0], given[0], len(dof))
        right = _Rows(context, builder, kinds[3], given[3], len(dof))
        place = long_of(context, builder, signature, given, 1)
        factor = context.cast(builder, given[2], kinds[2], kinds[0].dtype)
        x = right.load(long_of(context, builder, signature, given, 4))
        many = filled(builder, left.vector, factor)
        left.store(place, _multiply_add(builder, x, many, left.load(place)))
        return context.get_dummy_value()

    return types.void(a, i, t, b, j, dof), emit


@intrinsic
def copy_row(typing, a, i, b, j, dof):
    """a[i] = b[j]."""
    _check(a, b)

    def emit(context, builder, signature, given):
        kinds = signature.args
        left = _Rows(context, builder, kinds[0], given[0], len(dof))
        right = _Rows(context, builder, kinds[2], given[2], len(dof))
        row = right.load(long_of(context, builder, signature, given, 3))
        left.store(long_of(context, builder, signature, given, 1), row)
        return context.get_dummy_value()

    return types.void(a, i, b, j, dof), emit


def _joined(builder, low, high):
    """One vector of two."""
    count = low.type.count
    places = ir.Constant(ir.VectorType(INDEX, 2 * count), list(range(2 * count)))
    return builder.shuffle_vector(low, high, places)


def _parted(builder, vector):
    """The two vectors of one."""
    half = vector.type.count // 2
    at = lambda first: ir.Constant(ir.VectorType(INDEX, half), list(range(first, first + half)))
    return [builder.shuffle_vector(vector, vector, at(first)) for first in (0, half)]


@intrinsic
def dot_row(typing, H, r, p, i, j, dof):
    """H[2 r] · p[i] + H[2 r + 1] · p[j]."""
    _check(H, p)

    def emit(context, builder, signature, given):
        kinds, width = signature.args, len(dof)
        both = _Rows(context, builder, kinds[0], given[0], 2 * width)
        each = _Rows(context, builder, kinds[2], given[2], width)
        x = [each.load(long_of(context, builder, signature, given, k)) for k in (3, 4)]
        row = both.load(long_of(context, builder, signature, given, 1))
        product = builder.fmul(row, _joined(builder, *x))
        return _sum(builder, builder.fadd(*_parted(builder, product)))

    return H.dtype(H, r, p, i, j, dof), emit


@intrinsic
def keep_greatest(typing, most, z, i, dof):
    """most[0] = the greater of it and |z[i]|, lane by lane; what is no number is the greatest."""
    _check(most, z)

    def emit(context, builder, signature, given):
        out = _Rows(context, builder, signature.args[0], given[0], len(dof))
        rows = _Rows(context, builder, signature.args[1], given[1], len(dof))
        # without their sign, numbers are in the order of their bits, and NaN comes after infinity
        bits = ir.VectorType(ir.IntType(8 * out.bytes), len(dof))
        sizes = ir.Constant(bits, [2 ** (8 * out.bytes - 1) - 1] * len(dof))
        x = builder.bitcast(rows.load(long_of(context, builder, signature, given, 2)), bits)
        first = ir.Constant(ir.IntType(64), 0)
        old, new = builder.bitcast(out.load(first), bits), builder.and_(x, sizes)
        greater = builder.select(builder.icmp_signed(">", new, old), new, old)
        out.store(first, builder.bitcast(greater, out.vector))
        return context.get_dummy_value()

    return types.void(most, z, i, dof), emit


@intrinsic
def boxes_meet(typing, boxes, i, j, dof):
    """Whether two boxes have a point in common. A row has the low ends of a box along each axis,
    then the high ones times −1; of 8 columns, the last of each four stay 0."""
    _check(boxes)

    def emit(context, builder, signature, given):
        width = len(dof)
        rows = _Rows(context, builder, signature.args[0], given[0], width)
        one = rows.load(long_of(context, builder, signature, given, 1))
        other = rows.load(long_of(context, builder, signature, given, 2))
        # low ends of each against high ends of the other
        places = [*range(width // 2, width), *range(width // 2)]
        swapped = builder.shuffle_vector(
            other, other, ir.Constant(ir.VectorType(INDEX, width), places)
        )
        sums = builder.fadd(one, swapped)
        below = builder.fcmp_ordered("<=", sums, ir.Constant(sums.type, [0.0] * width))
        bits = builder.bitcast(below, ir.IntType(width))
        return builder.icmp_unsigned("==", bits, ir.Constant(bits.type, 2**width - 1))

    return types.boolean(boxes, i, j, dof), emit


@intrinsic
def put_product(typing, z, i, blocks, g, dof):
    """z[i] = blocks[i] @ g[i], for symmetric blocks (n, len(dof), len(dof)). z may be g."""
    _check(z, blocks, g)

    def emit(context, builder, signature, given):
        kinds, width = signature.args, len(dof)
        out = _Rows(context, builder, kinds[0], given[0], width)
        rows = _Rows(context, builder, kinds[2], given[2], width)
        place = long_of(context, builder, signature, given, 1)
        first = builder.mul(place, ir.Constant(place.type, width))
        x = _Rows(context, builder, kinds[3], given[3], width).load(place)
        total = builder.fmul(rows.load(first), _spread(builder, x, 0))
        for k in range(1, width):
            row = rows.load(builder.add(first, ir.Constant(place.type, k)))
            total = _multiply_add(builder, row, _spread(builder, x, k), total)
        out.store(place, total)
        return context.get_dummy_value()

    return types.void(z, i, blocks, g, dof), emit


def _squares(context, builder, kinds, given, ends, width):
    """The rows of the sum of H[h] H[h]ᵀ over halves whose rows act, in float64: see
    `put_inverse`."""
    rows = _Rows(context, builder, kinds[0], given[0], width)
    which, acts = (context.make_array(kinds[k])(context, builder, given[k]) for k in (1, 2))
    one = ir.Constant(ends[0].type, 1)
    nothing = ir.Constant(ir.VectorType(ir.DoubleType(), width), [0.0] * width)
    sums = [cgutils.alloca_once_value(builder, nothing) for _ in range(width)]
    with cgutils.for_range_slice(builder, ends[0], ends[1], one) as (q, _):
        h = builder.zext(builder.load(builder.gep(which.data, [q])), ends[0].type)
        on = builder.load(builder.gep(acts.data, [builder.lshr(h, one)]))
        x = rows.load(h)
        x = x if x.type == nothing.type else builder.fpext(x, nothing.type)
        # without a branch: its outcome is not foreseen
        x = builder.select(builder.icmp_unsigned("!=", on, ir.Constant(on.type, 0)), x, nothing)
        for k, total in enumerate(sums):
            new = _multiply_add(builder, _spread(builder, x, k), x, builder.load(total))
            builder.store(new, total)
    return [builder.load(total) for total in sums]


def _inverted(builder, B, degrees):
    """The inverse of rows B, symmetric and positive in their degrees of freedom: Gauss and Jordan's
    elimination, which needs no pivots there. A row and column of padding stay as they are."""
    one, nothing = (ir.Constant(B[0].type.element, x) for x in (1.0, 0.0))
    for k in range(degrees):
        pivot = builder.fdiv(one, builder.extract_element(B[k], _lane(k)))
        row = builder.insert_element(B[k], one, _lane(k))
        B[k] = builder.fmul(row, filled(builder, row.type, pivot))
        for m in range(degrees):
            if m != k:
                factor = _spread(builder, builder.fneg(B[m]), k)
                rest = builder.insert_element(B[m], nothing, _lane(k))
                B[m] = _multiply_add(builder, factor, B[k], rest)
    return B


@intrinsic
def put_inverse(typing, inverse, i, H, halves, act, first, last, alpha, floor, held, dof):
    """inverse[i] = (S + floor · diag(S) + α)⁻¹, worked out in float64, for S the sum of H[h] H[h]ᵀ
    over the halves[first … last − 1] whose rows act. Where `held`, without the last degree of
    freedom: its row and column are 0. Returns the entry of that degree before it is inverted."""
    for array in (inverse, H, halves, act):
        _check(array)

    def emit(context, builder, signature, given):
        # all in registers: what was stored in parts and is loaded as a whole has to be waited for
        kinds, width = signature.args, len(dof)
        end = 3 if width == 4 else 6
        ends = [long_of(context, builder, signature, given, k) for k in (5, 6)]
        B = _squares(context, builder, kinds[2:5], given[2:5], ends, width)
        number = lambda k: context.cast(builder, given[k], kinds[k], types.float64)
        one, nothing = (ir.Constant(B[0].type.element, x) for x in (1.0, 0.0))
        share, drag, hold = builder.fadd(one, number(8)), number(7), given[9]
        for k in range(end + 1):
            entry = builder.fmul(builder.extract_element(B[k], _lane(k)), share)
            B[k] = builder.insert_element(B[k], builder.fadd(entry, drag), _lane(k))
        own = builder.extract_element(B[end], _lane(end))
        alone = ir.Constant(B[0].type, [float(k == end) for k in range(width)])
        for k in range(end):
            B[k] = builder.select(hold, builder.insert_element(B[k], nothing, _lane(end)), B[k])
        B[end] = builder.select(hold, alone, B[end])
        B = _inverted(builder, B, end + 1)
        B[end] = builder.select(hold, ir.Constant(alone.type, [0.0] * width), B[end])
        out = _Rows(context, builder, kinds[0], given[0], width)
        place = long_of(context, builder, signature, given, 1)
        top = builder.mul(place, ir.Constant(place.type, width))
        for k in range(width):
            row = B[k] if out.vector == B[k].type else builder.fptrunc(B[k], out.vector)
            out.store(builder.add(top, ir.Constant(place.type, k)), row)
        return own

    given = inverse, i, H, halves, act, first, last, alpha, floor, held, dof
    return types.float64(*given), emit


def _turned(builder, columns):
    """Rows of 4 or 8 vectors of 8 numbers each, as `vectors.WIDTH`: row k has lane k of all of
    them. As vectors of 8 numbers: whole rows, or two rows of 4."""
    assert columns[0].type.count == 8

    def mixed(a, b, *places):
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INDEX, 8), places))

    quads = []
    for a, b, c, d in zip(*(columns[k::4] for k in range(4)), strict=True):
        halves = []
        for k in (0, 4):  # lanes k … k + 3
            spread = (k, k + 8, k + 1, k + 9, k + 2, k + 10, k + 3, k + 11)
            ab, cd = mixed(a, b, *spread), mixed(c, d, *spread)
            for m in (0, 4):
                halves.append(mixed(ab, cd, m, m + 1, m + 8, m + 9, m + 2, m + 3, m + 10, m + 11))
        quads.append(halves)
    if len(quads) == 1:
        return quads[0]
    low, high = (0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15)
    return [mixed(a, b, *half) for a, b in zip(*quads, strict=True) for half in (low, high)]


@intrinsic
def put_turned(typing, rows, first, columns, dof):
    """Of 8 pairs: puts `columns`, a tuple of vectors with a number of each pair, one pair after the
    other into rows, which are contiguous, from this number on. The last columns of `len(dof)` are
    0 where there are fewer."""
    _check(rows)

    def emit(context, builder, signature, given):
        many = cgutils.unpack_tuple(builder, given[2])
        out = _Rows(context, builder, signature.args[0], given[0], 8)
        many += [ir.Constant(many[0].type, [0.0] * 8)] * (len(dof) - len(many))
        at = builder.gep(out.data, [long_of(context, builder, signature, given, 1)])
        at = builder.bitcast(at, out.vector.as_pointer())
        for k, row in enumerate(_turned(builder, many)):
            place = builder.gep(at, [ir.Constant(INDEX, k)])
            builder.store(row, place, align=out.bytes)
        return context.get_dummy_value()

    return types.void(rows, first, columns, dof), emit


@intrinsic
def put_scaled_row(typing, H, h, rows, first, scale, i, dof):
    """H[h] = `len(dof)` numbers of rows, from this one on, times scale[i], rounded to the type of
    H."""
    _check(H)
    _check(rows, scale)

    def emit(context, builder, signature, given):
        kinds, width = signature.args, len(dof)
        out = _Rows(context, builder, kinds[0], given[0], width)
        numbers = _Rows(context, builder, kinds[2], given[2], width)
        scales = _Rows(context, builder, kinds[4], given[4], width)
        at = builder.gep(numbers.data, [long_of(context, builder, signature, given, 3)])
        at = builder.bitcast(at, numbers.vector.as_pointer())
        row = builder.load(at, align=numbers.bytes)
        row = builder.fmul(row, scales.load(long_of(context, builder, signature, given, 5)))
        row = row if out.vector == row.type else builder.fptrunc(row, out.vector)
        out.store(long_of(context, builder, signature, given, 1), row)
        return context.get_dummy_value()

    return types.void(H, h, rows, first, scale, i, dof), emit
