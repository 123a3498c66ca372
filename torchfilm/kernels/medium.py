"""Cells and the grids around them, cell by cell: the same as `signals.exchange`, to the bit."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import index, kernel


@kernel(inline=True)
def _along(at, size, periodic, slack, used):
    """Along an axis, from a place in voxels: the nearest voxel, the next one, the weight of that,
    and whether the place is beyond the box."""
    finite = abs(at) < np.inf
    away = not finite if periodic else not (at >= -slack and at <= size + slack)
    if not used:
        return np.int64(0), np.int64(0), 0.0, away
    at = at - 0.5 if finite else 0.0
    at = np.remainder(at, float(size)) if periodic else max(min(at, size - 1.0), 0.0)
    near = np.rint(at)
    side = 1.0 if at >= near else -1.0
    nearest, other = np.int64(near), np.int64(near + side)
    if periodic:
        return nearest % size, other % size, (at - near) * side, away
    return nearest, max(min(other, size - 1), 0), (at - near) * side, away


@kernel(entry=True)
def put_stencil(position, colony, origin, step, shape, first, used, periodic, slack, mask, node,
                weight, outside, blocked):  # fmt: skip
    """Puts the voxels of each cell, the nearest first, and their weights into node and weight,
    (N, K). used: (3,) bool, the axes with more than one voxel. mask: (nodes,), or empty."""
    number = weight.dtype.type
    corners, zero, one = node.shape[1], number(0), number(1)
    ux, uy, uz = used[0], used[1], used[2]
    for i in range(position.shape[0]):
        b = index(colony[i])
        nx, ny, nz = shape[b, 0], shape[b, 1], shape[b, 2]
        x = (position[i, 0] - origin[b, 0]) / step[0]
        y = (position[i, 1] - origin[b, 1]) / step[1]
        z = (position[i, 2] - origin[b, 2]) / step[2]
        x0, x1, tx, away_x = _along(x, nx, periodic[0], slack, ux)
        y0, y1, ty, away_y = _along(y, ny, periodic[1], slack, uy)
        z0, z1, tz, away_z = _along(z, nz, periodic[2], slack, uz)
        wx1, wy1, wz1 = number(tx), number(ty), number(tz)
        wx0, wy0, wz0 = one - wx1, one - wy1, one - wz1
        c, start = 0, first[b]
        for kx in range(2 if ux else 1):
            n = start + (x1 if kx else x0) * (ny * nz)
            w = wx1 if kx else wx0
            for ky in range(2 if uy else 1):
                m = n + (y1 if ky else y0) * nz
                v = w * (wy1 if ky else wy0)
                for kz in range(2 if uz else 1):
                    node[i, c] = m + (z1 if kz else z0)
                    weight[i, c] = v * (wz1 if kz else wz0)
                    c += 1
        outside[i] = away_x or away_y or away_z
        if mask.shape[0]:
            _mask(i, node, weight, mask, outside, blocked)
        if corners > 1:
            rest = weight[i, 1]
            for c in range(2, corners):
                rest += weight[i, c]
            weight[i, 0] = one - rest if weight[i, 0] > 0 else zero


@kernel
def _mask(i, node, weight, mask, outside, blocked):
    """Weights of a cell without those in an obstacle, the greatest first."""
    corners, best = node.shape[1], 0
    total = weight.dtype.type(0)
    for c in range(corners):
        if not mask[index(node[i, c])]:
            weight[i, c] = 0
        total += weight[i, c]
    blocked[i] = total <= 0
    outside[i] |= blocked[i]
    for c in range(corners):
        if total > 0:
            weight[i, c] /= total
        if weight[i, c] > weight[i, best]:
            best = c
    first, heavy = node[i, 0], weight[i, 0]
    node[i, 0], weight[i, 0] = node[i, best], weight[i, best]
    node[i, best], weight[i, best] = first, heavy


@kernel(entry=True)
def read(values, node, weight, out):
    """The concentration at each cell."""
    for i in range(node.shape[0]):
        nearest = values[index(node[i, 0])] if weight[i, 0] > 0 else values.dtype.type(0)
        found = nearest
        for c in range(1, node.shape[1]):
            found += weight[i, c] * (values[index(node[i, c])] - nearest)
        out[i] = found


@kernel(entry=True)
def pools(node, weight, volume, sums, out):
    """The voxel's volume over the greatest sum of weights at each cell's voxels. sums: as `write`
    has them."""
    for i in range(node.shape[0]):
        for c in range(node.shape[1]):
            sums[index(node[i, c]), 0] += weight[i, c]
    for i in range(node.shape[0]):
        worst = weight.dtype.type(0)
        for c in range(node.shape[1]):
            if weight[i, c] > 0:
                worst = max(worst, sums[index(node[i, c]), 0])
        out[i] = volume / (worst if worst > 0 else weight.dtype.type(1))
    for i in range(node.shape[0]):
        for c in range(node.shape[1]):
            sums[index(node[i, c]), 0] = 0


@kernel(inline=True)
def _emptied(content, share, one, slack, least):
    """Whether only rounding makes a share of a voxel's content more than the whole."""
    size = abs(content)
    return share > one and (share - one) * size < slack * size + least


@kernel(entry=True)
def write(out, amount, there, node, weight, volume, slack, least, sums, seen):
    """Values after secretion and uptake, in place; there: what each cell reads. sums: (nodes, 2) of
    0, and so again in the end, for the part taken and what is given. seen: (N K,), for the voxels
    where cells are: nothing is done elsewhere."""
    zero, one, count = out.dtype.type(0), out.dtype.type(1), index(0)
    for i in range(node.shape[0]):
        wanted, more = max(-amount[i], zero), max(amount[i], zero) / volume
        part = wanted / ((there[i] if there[i] > 0 else one) * volume)
        if wanted > 0 and there[i] <= 0:
            part = out.dtype.type(np.inf)
        for c in range(node.shape[1]):
            k = index(node[i, c])
            seen[count] = node[i, c]  # noted without a branch, which would be hard to foresee
            count += index((sums[k, 0] == 0) & (sums[k, 1] == 0))
            sums[k, 0] += weight[i, c] * part
            sums[k, 1] += weight[i, c] * more
    for n in range(count):
        k = index(seen[n])
        share, more = sums[k, 0], sums[k, 1]
        if share == 0 and more == 0:
            continue  # nothing is done, or it is done already
        if _emptied(out[k], share, one, slack, least):
            share = one
        out[k] = out[k] - out[k] * share + more
        sums[k, 0], sums[k, 1] = zero, zero


@kernel(entry=True)
def write_moved(
    values, out, amount, turned, there, shift, node, weight, volume, slack, least, sums
):
    """The tangent of `write`, in place; of amount and there it is turned and shift. sums: (nodes,
    3) of 0, and so again in the end, for the parts taken, their tangents and those of what is
    given."""
    half, one = values.dtype.type(0.5), values.dtype.type(1)
    for i in range(node.shape[0]):
        a, sign = amount[i], np.sign(amount[i])
        # halves of |amount| ± amount: at 0 the derivatives of both then add up to 1
        wanted, less = half * (abs(a) - a), half * (sign * turned[i] - turned[i])
        more = half * (sign * turned[i] + turned[i]) / volume
        if a == 0 and not there[i] > 0:  # where there is nothing to take all of it is given
            less, more = a, turned[i] / volume
        if there[i] > 0:
            content = there[i] * volume
            part = wanted / content
            less -= part * volume * shift[i]
        else:
            content = volume
            part = values.dtype.type(np.inf) if wanted > 0 else wanted / content
        less /= content
        for c in range(node.shape[1]):
            k, w = index(node[i, c]), weight[i, c]
            sums[k, 0] += w * part
            sums[k, 1] += w * less
            sums[k, 2] += w * more
    for i in range(node.shape[0]):
        for c in range(node.shape[1]):
            k = index(node[i, c])
            share, less, more = sums[k, 0], sums[k, 1], sums[k, 2]
            if share == 0 and less == 0 and more == 0:
                continue
            if _emptied(values[k], share, one, slack, least):
                share, less = one, one - one
            out[k] = out[k] * (one - share) - values[k] * less + more
            sums[k, 0], sums[k, 1], sums[k, 2] = 0, 0, 0


@kernel(entry=True)
def spans(position, colony, low, high):
    """Put the least and the greatest coordinates of each colony's cells into low and high (B, 3),
    which hold inf and −inf; NaN where a coordinate is NaN."""
    for i in range(position.shape[0]):
        b = colony[i]
        for k in range(3):
            x = position[i, k]
            if x < low[b, k] or x != x:
                low[b, k] = x
            if x > high[b, k] or x != x:
                high[b, k] = x


@kernel(entry=True)
def beyond(position, colony, origin, step, shape, periodic, slack, left, first):
    """Cells outside the box: their number and the first of them, into left and first (B,)."""
    for i in range(position.shape[0]):
        b, outside = colony[i], False
        for k in range(3):
            at = (position[i, k] - origin[b, k]) / step[k]
            if periodic[k]:
                outside |= not abs(at) < np.inf
            else:
                outside |= not (at >= -slack and at <= shape[b, k] + slack)
        if outside:
            if left[b] == 0:
                first[b] = i
            left[b] += 1
