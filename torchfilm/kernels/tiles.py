"""Products of small matrices, tile by tile, with the sums of a tile in the processor's registers.

Arrays are contiguous, of one type, and their indices are not checked. An entry of a product is the
sum of its terms one after the other, whatever the tile that it is in.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils

from torchfilm.kernels.lanes import intrinsic


def _check(*arrays):
    if any(a.layout != "C" or a.ndim != 2 or a.dtype != arrays[0].dtype for a in arrays):
        raise TypeError(f"matrices of {arrays} are not contiguous, or not of one type")


@intrinsic
def put_tile(typing, out, above, i, k, a, b, over, left, first, last, rows, lanes):
    """out[above + i + r, k + c] = the sum over j, first ≤ j < last, of a[i + r, j] · b[over + j,
    left + c], for r < len(rows) and c < len(lanes)."""
    _check(out, a, b)

    def emit(context, builder, signature, given):
        kinds = signature.args
        integer = lambda n: context.cast(builder, given[n], kinds[n], types.int64)
        matrices = [context.make_array(kinds[n])(context, builder, given[n]) for n in (0, 4, 5)]
        widths = [cgutils.unpack_tuple(builder, m.shape)[1] for m in matrices]
        at = lambda n, row, column: builder.gep(
            matrices[n].data, [builder.add(builder.mul(row, widths[n]), column)]
        )
        number = context.get_data_type(kinds[0].dtype)
        vector, size = ir.VectorType(number, len(lanes)), kinds[0].dtype.bitwidth // 8
        above, i, k, over, left, first, last = (integer(n) for n in (1, 2, 3, 6, 7, 8, 9))
        here = [builder.add(i, ir.Constant(i.type, r)) for r in range(len(rows))]
        nothing = ir.Constant(vector, [0.0] * len(lanes))
        sums = [cgutils.alloca_once_value(builder, nothing) for _ in here]
        places = ir.VectorType(ir.IntType(32), len(lanes))
        empty = ir.Constant(ir.VectorType(number, 1), ir.Undefined)
        with cgutils.for_range_slice(builder, first, last, ir.Constant(first.type, 1)) as (j, _):
            terms = builder.bitcast(at(2, builder.add(over, j), left), vector.as_pointer())
            terms = builder.load(terms, align=size)
            for row, total in zip(here, sums, strict=True):
                factor = builder.load(at(1, row, j))
                one = builder.insert_element(empty, factor, ir.Constant(ir.IntType(32), 0))
                many = builder.shuffle_vector(one, one, ir.Constant(places, [0] * len(lanes)))
                product = builder.fmul(many, terms, flags=("contract",))
                builder.store(
                    builder.fadd(builder.load(total), product, flags=("contract",)), total
                )
        for row, total in zip(here, sums, strict=True):
            target = builder.bitcast(at(0, builder.add(above, row), k), vector.as_pointer())
            builder.store(builder.load(total), target, align=size)
        return context.get_dummy_value()

    return types.void(out, above, i, k, a, b, over, left, first, last, rows, lanes), emit
