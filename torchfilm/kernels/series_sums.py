"""Sums of a series of mixings and their derivatives, as `signals.series_sums` makes them: of the
grids of all colonies, where gradients are wanted."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.transport import exchanged, padding_of


@kernel
def put_next(v, new, pad, grid, more):
    """new = P v + more of one grid; v, new: with padding. more: (voxels,) or empty."""
    strides, stay, ups, downs, wrap_to, wrap_from, wraps = grid
    exchanged(v, new, pad, strides, stay, ups, downs)
    for w in range(wrap_to.size):
        new[pad + wrap_to[w]] += wraps[w] * v[pad + wrap_from[w]]
    inner = new[pad : pad + stay.size]
    for i in range(more.size):
        inner[i] += more[i]


@kernel
def grid_of(c, strides, mixing):
    """P of one of the grids of a shape; they may share it."""
    stay, ups, downs, wrap_to, wrap_from, wraps = mixing
    own = c if stay.shape[0] > 1 else 0
    return strides, stay[own], ups[own], downs[own], wrap_to, wrap_from, wraps[own]


@kernel
def gained_by(c, gain, like):
    return gain[c if gain.shape[0] > 1 else 0] if gain.shape[0] > 0 else like[:0]


@kernel(entry=True)
def add_up(begin, end, strides, mixing, gain, rows, u, out):
    """The sums of the grids begin … end of one shape, out (sums, b, voxels), from u (b, voxels).

    strides, mixing: as `transport.mix` takes P. gain: (b or 1 or 0, voxels). rows: (sums, terms, b
    or 1)."""
    size, pad = u.shape[1], padding_of(strides)
    buffers = np.zeros((2, size + 2 * pad))
    for c in range(begin, end):
        grid, more, own = grid_of(c, strides, mixing), gained_by(c, gain, u[c]), 0
        own = c if rows.shape[2] > 1 else 0
        v, new = buffers[0], buffers[1]
        for i in range(size):
            v[pad + i] = u[c, i]
        out[:, c, :] = 0.0
        for k in range(rows.shape[1]):
            if k > 0:
                put_next(v, new, pad, grid, more)
                v, new = new, v
            inner = v[pad : pad + size]
            for r in range(rows.shape[0]):
                part = rows[r, k, own]
                total = out[r, c]
                for i in range(size):
                    total[i] += part * inner[i]


@kernel
def put_pulled(back, rows, k, c, of_sums):
    """Add to a gradient (voxels,) what the term k of each sum gives."""
    own = c if rows.shape[2] > 1 else 0
    for r in range(rows.shape[0]):
        part, given = rows[r, k, own], of_sums[r, c]
        for i in range(back.size):
            back[i] += part * given[i]


@kernel
def add_sides(of_sides, back, term, strides, lengths):
    """Add the gradients by what each voxel gets from the one below and the one above, along each
    axis, (2 axes, voxels). lengths: voxels along the axes."""
    for a in range(strides.size):
        stride, length = strides[a], lengths[a]
        below, above = of_sides[2 * a], of_sides[2 * a + 1]
        around = (length - 1) * stride
        for i in range(back.size):
            at = (i // stride) % length
            below[i] += back[i] * term[i - stride if at > 0 else i + around]
            above[i] += back[i] * term[i + stride if at < length - 1 else i - around]


@kernel
def put_firsts(firsts, terms, pad, grid, more, u):
    """The first term of each block of as many as `terms` has rows; the terms of the last block are
    left to `put_block`."""
    held = terms.shape[0]
    for i in range(u.size):
        firsts[0, pad + i] = u[i]
    for block in range(1, firsts.shape[0]):
        put_block(firsts, terms, pad, grid, more, block - 1, held)
        put_next(terms[held - 1], firsts[block], pad, grid, more)


@kernel
def put_block(firsts, terms, pad, grid, more, block, many):
    """The first `many` terms of a block."""
    terms[0, :] = firsts[block]
    for k in range(1, many):
        put_next(terms[k - 1], terms[k], pad, grid, more)


@kernel(entry=True)
def pull(
    begin, end, strides, lengths, mixing, turned, gain, rows, u, of_sums, held, of_u, of_gain,
    of_stay, of_sides,
):  # fmt: skip
    """The gradients of `add_up` by u, by the gain and by the entries of P, for those of the sums,
    of_sums (sums, b, voxels).

    turned: Pᵀ, as mixing. held: terms that are held at once, beside one of so many. of_u: (b,
    voxels). of_gain, of_stay: (b or 0, voxels), of_sides: (b or 0, 2 axes, voxels), with no rows
    where they are not wanted.
    """
    size, pad, last = u.shape[1], padding_of(strides), rows.shape[1] - 1
    wants_sides = of_sides.shape[0] > 0
    wants_terms = last > 0 and (of_stay.shape[0] > 0 or wants_sides)
    blocks = (last + held - 1) // held if wants_terms else 1
    firsts, buffers = np.zeros((blocks, size + 2 * pad)), np.zeros((2, size + 2 * pad))
    terms = np.zeros((held if wants_terms else 1, size + 2 * pad))
    for c in range(begin, end):
        grid, back_grid = grid_of(c, strides, mixing), grid_of(c, strides, turned)
        more, none = gained_by(c, gain, u[c]), u[c, :0]
        if wants_terms:
            put_firsts(firsts, terms, pad, grid, more, u[c])
        back, new = buffers[0], buffers[1]
        back[:] = 0.0
        put_pulled(back[pad : pad + size], rows, last, c, of_sums)
        for k in range(last - 1, -1, -1):
            block, place = k // held, k % held
            if wants_terms and (k == last - 1 or place == held - 1):
                put_block(firsts, terms, pad, grid, more, block, place + 1)
            inner = back[pad : pad + size]
            term = terms[place if wants_terms else 0, pad : pad + size]
            if of_gain.shape[0] > 0:
                for i in range(size):
                    of_gain[c, i] += inner[i]
            if of_stay.shape[0] > 0:
                for i in range(size):
                    of_stay[c, i] += inner[i] * term[i]
            if wants_sides:
                add_sides(of_sides[c], inner, term, strides, lengths)
            put_next(back, new, pad, back_grid, none)
            back, new = new, back
            put_pulled(back[pad : pad + size], rows, k, c, of_sums)
        for i in range(size):
            of_u[c, i] = back[pad + i]
