"""The closest points of two capsules, and the line along which nearly parallel ones touch: of
numbers, or of `vectors` of them."""

from __future__ import annotations

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.vectors import where


@kernel(inline=True)
def clamp(x, half):
    """x, limited to −half … half."""
    x = where(x < -half, -half, x)
    return where(x > half, half, x)


@kernel(inline=True)
def dot_of(ax, ay, az, bx, by, bz, dof):
    """a · b; in the plane without the third components."""
    if len(dof) == 4:
        return ax * bx + ay * by
    return ax * bx + ay * by + az * bz


@kernel(inline=True)
def squared_distance(bx, by, bz, ax, ay, az, cx, cy, cz, s, t, dof):
    """Of the points s and t of two centrelines. b: from centre to centre; a, c: the axes."""
    dx = bx + t * cx - s * ax
    dy = by + t * cy - s * ay
    dz = bz + t * cz - s * az
    return dot_of(dx, dy, dz, dx, dy, dz, dof)


@kernel(inline=True)
def squared_sine(ax, ay, az, cx, cy, cz, dof):
    """Of the angle between two axes."""
    nz = ax * cy - ay * cx
    if len(dof) == 4:
        return nz * nz
    nx, ny = ay * cz - az * cy, az * cx - ax * cz
    return nx * nx + ny * ny + nz * nz


@kernel(inline=True)
def closest_points(bx, by, bz, ax, ay, az, cx, cy, cz, half_a, half_b, dof):
    """Arc lengths s and t of the closest points, and their squared distance.

    The nearest of five candidates, as in `physics.contacts.closest_points`.
    """
    cosine = dot_of(ax, ay, az, cx, cy, cz, dof)
    on_a = dot_of(bx, by, bz, ax, ay, az, dof)
    on_b = dot_of(bx, by, bz, cx, cy, cz, dof)
    sine2 = squared_sine(ax, ay, az, cx, cy, cz, dof)
    s = where(sine2 >= 1e-12, (on_a - cosine * on_b) / sine2, 0.0)
    s = clamp(s, half_a)
    t = clamp(cosine * s - on_b, half_b)
    s = clamp(cosine * t + on_a, half_a)
    best = squared_distance(bx, by, bz, ax, ay, az, cx, cy, cz, s, t, dof)
    for k in range(4):
        if k < 2:
            s1 = half_a if k == 0 else -half_a
            t1 = clamp(cosine * s1 - on_b, half_b)
        else:
            t1 = half_b if k == 2 else -half_b
            s1 = clamp(cosine * t1 + on_a, half_a)
        d2 = squared_distance(bx, by, bz, ax, ay, az, cx, cy, cz, s1, t1, dof)
        nearer = d2 < best
        best, s, t = where(nearer, d2, best), where(nearer, s1, s), where(nearer, t1, t)
    return s, t, best


@kernel(inline=True)
def end_of(s, half):
    """+1 or −1 at an end of the centreline, else 0."""
    slack = 1e-6 * half + 1e-9
    return where(s >= half - slack, 1.0, 0.0) - where(s <= slack - half, 1.0, 0.0)


@kernel(inline=True)
def end_while_sliding(s, free, half, radius, slide):
    """`end_of` for a contact that may be a line, as in `physics.contacts`."""
    missing = (abs(free) - half) / (slide * radius + 1e-9)
    missing = where(missing < 0.0, 0.0, missing)
    sign = where(free > 0, 1.0, where(free < 0, -1.0, 0.0))
    return where(slide > 0, sign * where(missing > 1.0, 1.0, missing), end_of(s, half))
