"""The text of the derivative of the stiff method for a circuit of a given size.

Forward mode by hand, line by line beside `stiff_text.STEP`: t is the tangent of u, and so on. A
linear solve M x = r has the tangent M tx = tr + tJ x, since M = 2/h − J. The sizes of the steps
are held fixed, and so are the bounds below which no variable may fall, as in `rosenbrock`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from torchfilm.circuits.stiff_text import each, loop, substituted, tuple_of

STEP = '''@kernel
def rate_moved(y, ty, low, j, tj, c, leaf, turn):
    """The tangent of `rate`."""
    {y} = y
    {ty} = ty
    {low} = low
    {below_of}
    {f} = rates_moved(y, leaf, ty, turn)
    below = {any_below}
    if not any_of(below):
        return {f_as_y}
    {inside_of}
    {s} = rates_moved({inside}, leaf, {ty_inside}, turn)
    {g} = times_slopes(tj, {y_less_inside})
    {r} = times_slopes(j, {ty_less_inside})
    return {s_plus_g_plus_r_or_f}


@kernel
def solved_moved(m, tr, tj, x):
    """The tangent of x = solved(m, r)."""
    {f} = tr
    {g} = times_slopes(tj, x)
    return solved(m, {f_plus_g})


@kernel
def corrected_moved(u, t, a, ta, new, tn, low, noise, m, j, tj, c, leaf, turn):
    """The tangent of `corrected`."""
    {u} = u
    {t} = t
    {a} = a
    {ta} = ta
    {new} = new
    {tn} = tn
    {low} = low
    {noise} = noise
    {middle_of}
    {tm_of}
    k = solved(m, rate({middle}, low, j, c))
    {s} = k
    {ts} = solved_moved(m, rate_moved({middle}, {tm}, low, j, tj, c, leaf, turn), tj, k)
    {s_of}
    {ts_of}
    {safe_of}
    share, tshare = 1.0, 0.0
    {tshare_of}
    return {tmoved}


@kernel
def step_moved(u, t, c, leaf, turn, h, eps):
    """The tangent of the result of `step`."""
    {u} = u
    {t} = t
    f, j = linearised(u, c)
    tj = linearised_moved(u, leaf, t, turn)
    tf = rates_moved(u, leaf, t, turn)
    p = 1.0 / h
    m, _, _ = factored(j, 2.0 * p)
    {f} = f
    {tf} = tf
    {low_of}
    low = {low}
    a = solved(m, f)
    ta = solved_moved(m, tf, tj, a)
    {a} = a
    {ta} = ta
    b = solved(m, {second})
    {b} = b
    {tb} = solved_moved(m, {tsecond}, tj, b)
    {y_of}
    {ty_of}
    {r} = rate({y}, low, j, c)
    {tr} = rate_moved({y}, {ty}, low, j, tj, c, leaf, turn)
    d = solved(m, {third})
    {d} = d
    {td} = solved_moved(m, {tthird}, tj, d)
    {y_more}
    {ty_more}
    {r} = rate({y}, low, j, c)
    {tr} = rate_moved({y}, {ty}, low, j, tj, c, leaf, turn)
    e = solved(m, {fourth})
    {e} = e
    {te} = solved_moved(m, {tfourth}, tj, e)
    {new_of}
    {tn_of}
    {noise_of}
    {tn_noisy}
    {noisy}
    {new_below_of}
    below = {any_below}
    if not any_of(below):
        return {tn}
    {ts} = corrected_moved(u, t, a, ta, {new}, {tn}, low, {noise}, m, j, tj, c, leaf, turn)
    return {ts_or_tn}


'''


# The tangents of the vectors of `stiff_text`; t is that of u, tm of the middle, tn of the new ones.
NAMES = ("t", "ta", "tb", "td", "te", "tf", "tm", "tn", "tr", "ts", "ty")


def tangent_method(size: int, free: int, fixed: Mapping[str, int], leaves: str, turns: str) -> str:
    """The step with its tangent, and the loop over cells, for so many variables. fixed: how many
    numbers are prepared (c), of the leaves, and turn. leaves, turns: the text of a cell's values
    and of their tangents."""
    carried = {"u": ("at", "new"), "t": ("moving", "step_moved(u, t, c, leaf, turn, h, eps)")}
    given = "at, moving, columns, turning, numbers, turned"
    what = (
        "Also the\n    tangents `moving` (M, V) of the variables, for the tangents `turning` (Q, M)"
        " of columns\n    (K, M) and `turned` (R,) of numbers (L,)."
    )
    begin = {"leaf": leaves, "turn": turns}
    return tangent_step(size, free) + loop(size, carried, fixed, begin, given, what, "_moved")


def tangent_step(size: int, free: int) -> str:
    """The text of the step's derivative."""
    lines, many = partial(each, size=size), partial(tuple_of, size=size)
    return substituted(
        STEP,
        size,
        free,
        **{x: many(f"{x}#") for x in NAMES},
        ty_inside=many("where(below#, 0.0, ty#)"),
        ty_less_inside=many("where(below#, ty#, 0.0)"),
        s_plus_g_plus_r_or_f=many("where(below, s# + g# + r#, like(f#, y#))"),
        f_plus_g=many("f# + g#"),
        tm_of=lines("tm# = t# + ta#"),
        ts_of=lines("ts# = where((s# < low#) & (s# >= low# - noise#), 0.0, tm# + ts#)"),
        tshare_of=lines(
            "nearer = (s# - low#) / (s# - new#)\n"
            "    moves = (new# < low#) & (nearer < share)\n"
            "    share = where(moves, nearer, share)\n"
            "    tshare = where(moves, (ts# - share * (ts# - tn#)) / (s# - new#), tshare)"
        ),
        tmoved=many(
            "where(s# + share * (new# - s#) > low#,"
            " ts# + share * (tn# - ts#) + tshare * (new# - s#), 0.0)"
        ),
        tsecond=many("tf# + 4.0 * p * ta#"),
        ty_of=lines("ty# = t# + 2.0 * ta#"),
        tthird=many("tr# + p * (ta# - tb#)"),
        ty_more=lines("ty# = ty# + td#"),
        tfourth=many("tr# + p * (ta# - tb# - (8.0 / 3.0) * td#)"),
        tn_of=lines("tn# = ty# + te#"),
        tn_noisy=lines("tn# = where((new# < low#) & (new# >= low# - noise#), 0.0, tn#)"),
        ts_or_tn=many("where(below, ts#, tn#)"),
    )
