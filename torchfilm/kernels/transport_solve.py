"""Transport of signals by backward Euler over the grids of all colonies: one solve of all axes a
colony, (I − Δt T) u' = u + Δt gain, as `signals.transport_iterative` makes it.

With P = I + T/λ the matrix is I + λΔt (I − P), so that it needs what the series needs.
"""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.transport import exchanged, padding_of

# Rows that a solve works in.
SPARE = 7
# Squares of numbers below SMALL may be below all numbers: they are solved for so many times as
# large, which changes no digit.
SMALL, LARGER = 1e-100, 2.0**600


@kernel(any_order=True)
def dot(a, b):
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@kernel
def square(r, weight):
    """|r|², of each voxel with its weight where there are some."""
    if weight.size == 0:
        return dot(r, r)
    total = 0.0
    for i in range(r.size):
        total += (weight[i] * r[i]) ** 2
    return total


@kernel
def product(v, out, pad, grid, many):
    """out = (I + many (I − P)) v for one grid; v: with padding, out without. grid: strides, stay,
    ups, downs, wrap_to, wrap_from, wraps as `transport.mix` takes them, of one colony."""
    strides, stay, ups, downs, wrap_to, wrap_from, wraps, mixed = grid
    exchanged(v, mixed, pad, strides, stay, ups, downs)
    for w in range(wrap_to.size):
        mixed[pad + wrap_to[w]] += wraps[w] * v[pad + wrap_from[w]]
    for i in range(out.size):
        out[i] = v[pad + i] + many * (v[pad + i] - mixed[pad + i])


@kernel
def _ratio(a, b):
    return a / b if b != 0 else 0.0


@kernel
def conjugate_gradients(x, r, pad, grid, many, inverse, target, most, spare, weight):
    """As `transport_iterative._conjugate_gradients`: x and r in place; x, spare: with padding;
    inverse: of the diagonal."""
    size = r.size
    p, q = spare[0], spare[1, pad : pad + size]
    for i in range(size):
        p[pad + i] = inverse[i] * r[i]
    product_of = dot(p[pad : pad + size], r)
    for _ in range(most):
        product(p, q, pad, grid, many)
        alpha = _ratio(product_of, dot(p[pad : pad + size], q))
        for i in range(size):
            x[pad + i] += alpha * p[pad + i]
            r[i] -= alpha * q[i]
        if not square(r, weight) > target:
            return
        for i in range(size):
            q[i] = inverse[i] * r[i]
        new = dot(q, r)
        beta, product_of = _ratio(new, product_of), new
        for i in range(size):
            p[pad + i] = q[i] + beta * p[pad + i]


@kernel
def bicgstab(x, r, pad, grid, many, inverse, target, most, spare, weight):
    """As `transport_iterative._bicgstab`: x and r in place; x, spare: with padding; inverse: of the
    diagonal."""
    size = r.size
    inner = slice(pad, pad + size)  # what lies beside it stays 0
    p, s, scaled = spare[0, inner], spare[1, inner], spare[5]
    v, t, shadow = spare[2, inner], spare[3, inner], spare[4, inner]
    for i in range(size):
        p[i] = shadow[i] = r[i]
    rho = dot(r, r)
    for _ in range(most):
        for i in range(size):
            scaled[pad + i] = inverse[i] * p[i]
        product(scaled, v, pad, grid, many)
        alpha = _ratio(rho, dot(shadow, v))
        for i in range(size):
            x[pad + i] += alpha * scaled[pad + i]
            s[i] = r[i] - alpha * v[i]
            scaled[pad + i] = inverse[i] * s[i]
        product(scaled, t, pad, grid, many)
        omega = _ratio(dot(t, s), dot(t, t))
        for i in range(size):
            x[pad + i] += omega * scaled[pad + i]
            r[i] = s[i] - omega * t[i]
        if not square(r, weight) > target:
            return
        new = dot(shadow, r)
        # a breakdown of the method: it restarts from the true residual
        if alpha == 0 or omega == 0 or new == 0:
            return
        beta, rho = _ratio(new, rho) * _ratio(alpha, omega), new
        for i in range(size):
            p[i] = r[i] + beta * (p[i] - omega * v[i])


@kernel
def _is_small(b, x):
    most = 0.0
    for i in range(b.size):
        most = max(most, abs(b[i]), abs(x[i]))
    return 0.0 < most < SMALL


@kernel
def _times(factor, b, x, r):
    for i in range(b.size):
        b[i] *= factor
        x[i] *= factor
        r[i] *= factor


@kernel
def backward_euler(
    x, b, r, pad, grid, many, tolerance, rounding, symmetric, most, spare, weight
):  # fmt: skip
    """Solve (I + many (I − P)) x = b for one grid, from x, and leave the residual in r. Whether it
    converged. tolerance: of the residual over b. rounding: of the residual over x, times the
    diagonal, whose inverse is left in spare[6]. spare: `SPARE` rows, 0 in their padding. weight: of
    each voxel in these norms; empty: 1."""
    inverse, stay, inner = spare[6, pad : pad + b.size], grid[1], x[pad : pad + b.size]
    small = _is_small(b, inner)
    if small:
        _times(LARGER, b, inner, r)
    for i in range(b.size):
        inverse[i] = 1 / (1 + many * (1 - stay[i]))
    for trial in range(4):
        product(x, r, pad, grid, many)
        for i in range(b.size):
            r[i] = b[i] - r[i]
        # a product is a difference of numbers that are so many times as large; voxels from which
        # cells take at a high rate hold little
        least = 0.0
        for i in range(b.size):
            scale = weight[i] if weight.size > 0 else 1.0
            least += (scale * inner[i] / inverse[i]) ** 2
        target = max(tolerance**2 * square(b, weight), rounding**2 * least)
        if trial == 3 or not square(r, weight) > target:
            break
        if symmetric:
            conjugate_gradients(x, r, pad, grid, many, inverse, target, most, spare, weight)
        else:
            bicgstab(x, r, pad, grid, many, inverse, target, most, spare, weight)
    good = square(r, weight) <= 100 * target
    if small:
        _times(1 / LARGER, b, inner, r)
    return good


@kernel(entry=True)
def solve(
    begin, end, starts, strides, stay, ups, downs, wrap_to, wrap_from, wraps, many, gained,
    tolerance, rounding, symmetric, most, values, out,
):  # fmt: skip
    """The grids begin … end of one shape after a step of backward Euler, from values to out,
    (voxels,) of all colonies; NaN where the solve did not converge.

    strides … wraps: as `transport.mix` takes them. many: λΔt, (b or 1,), 0 where another method
    carries a colony. tolerance, rounding: as of `backward_euler`. gained: Δt × the gain, (b or 1 or
    0, voxels). most: iterations before a restart.
    """
    size, pad = stay.shape[1], padding_of(strides)
    wide = size + 2 * pad
    mixed, x, spare = np.zeros(wide), np.zeros(wide), np.zeros((SPARE, wide))
    b, r = np.empty(size), np.empty(size)
    for c in range(begin, end):
        own = c if stay.shape[0] > 1 else 0
        if many[own] == 0:
            continue
        grid = strides, stay[own], ups[own], downs[own], wrap_to, wrap_from, wraps[own], mixed
        for i in range(size):
            x[pad + i] = b[i] = values[starts[c] + i]
        if gained.shape[0] > 0:
            more = gained[c if gained.shape[0] > 1 else 0]
            for i in range(size):
                b[i] += more[i]
        good = backward_euler(
            x, b, r, pad, grid, many[own], tolerance, rounding, symmetric, most, spare, b[:0]
        )
        for i in range(size):
            # with its residual the change is what T makes of x: amount is conserved, but for the
            # rounding of λΔt exchanges
            out[starts[c] + i] = max(x[pad + i] + r[i], 0.0) if good else np.nan


@kernel(entry=True)
def solve_systems(
    begin, end, strides, stay, ups, downs, wrap_to, wrap_from, wraps, many, weight, tolerance,
    rounding, symmetric, most, right, x_of, good,
):  # fmt: skip
    """The solutions of the systems begin … end, whatever their signs: from x_of (b, voxels), in
    place, and whether each converged, good (b,). right: (b, voxels). weight: (b or 1 or 0, voxels).
    The others as of `solve`."""
    size, pad = stay.shape[1], padding_of(strides)
    wide = size + 2 * pad
    mixed, x, spare = np.zeros(wide), np.zeros(wide), np.zeros((SPARE, wide))
    b, r = np.empty(size), np.empty(size)
    for c in range(begin, end):
        own = c if stay.shape[0] > 1 else 0
        grid = strides, stay[own], ups[own], downs[own], wrap_to, wrap_from, wraps[own], mixed
        each = weight[c if weight.shape[0] > 1 else 0] if weight.shape[0] > 0 else b[:0]
        for i in range(size):
            x[pad + i], b[i] = x_of[c, i], right[c, i]
        good[c] = backward_euler(
            x, b, r, pad, grid, many[own], tolerance, rounding, symmetric, most, spare, each
        )
        for i in range(size):
            x_of[c, i] = x[pad + i]
