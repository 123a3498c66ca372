"""The text of the derivative of the stiff method for a circuit of a given size.

Forward mode by hand, line by line beside `stiff_text.STEP`: t is the tangent of u, and so on. A
linear solve M x = r has the tangent M tx = tr + tJ x, since M = 2/h − J. The sizes of the steps
are held fixed, and so are the bounds below which no variable may fall, as in `rosenbrock`.
"""

from __future__ import annotations

from functools import partial

from torchfilm.circuits.stiff_text import ADVANCE, each, substituted, tuple_of

STEP = '''@kernel
def rate_moved(y, ty, low, j, tj, c, leaf, turn):
    """The tangent of `rate`."""
    {y} = y
    {ty} = ty
    {low} = low
    if not ({any_below}):
        return rates_moved(y, leaf, ty, turn)
    {inside_of}
    {f} = rates_moved({inside}, leaf, {ty_inside}, turn)
    {g} = times_slopes(tj, {y_less_inside})
    {r} = times_slopes(j, {ty_less_inside})
    return {f_plus_g_plus_r}


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
    m, _ = factored(j, 2.0 * p)
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
    if not ({new_below}):
        return {tn}
    return corrected_moved(u, t, a, ta, {new}, {tn}, low, {noise}, m, j, tj, c, leaf, turn)


@kernel(entry=True)
def run_moved(first, last, at, moving, columns, turning, numbers, turned, dt, rtol, atol, eps,
              largest, most_steps, accepted, rejected, status):
    """As `run`, and the tangents `moving` (M, V) of the variables in place, for the tangents
    `turning` (Q, M) of columns and `turned` (R,) of numbers."""
    for n in range(first, last):
        leaf = {leaves}
        turn = {turns}
        c = prepared(leaf)
        u = {start}
        t = {tstart}
        {advance}
        {store}
        {tstore}
'''


# The tangents of the vectors of `stiff_text`; t is that of u, tm of the middle, tn of the new ones.
NAMES = ("t", "ta", "tb", "td", "te", "tf", "tm", "tn", "tr", "ts", "ty")


def tangent_method(size: int, leaves: str, turns: str) -> str:
    """The step with its tangent, and the loop over cells, for so many variables. leaves, turns:
    the text of a cell's values and of their tangents."""
    lines, many = partial(each, size=size), partial(tuple_of, size=size)
    return substituted(
        STEP,
        size,
        leaves=leaves,
        turns=turns,
        advance=ADVANCE.format(taken="t, u = step_moved(u, t, c, leaf, turn, h, eps), new"),
        **{x: many(f"{x}#") for x in NAMES},
        ty_inside=many("(0.0 if y# < low# else ty#)"),
        ty_less_inside=many("(ty# if y# < low# else 0.0)"),
        f_plus_g_plus_r=many("f# + g# + r#"),
        tm_of=lines("tm# = t# + ta#"),
        ts_of=lines("ts# = 0.0 if s# < low# and s# >= low# - noise# else tm# + ts#"),
        tshare_of=lines(
            "if new# < low# and (s# - low#) / (s# - new#) < share:\n"
            "        share = (s# - low#) / (s# - new#)\n"
            "        tshare = (ts# - share * (ts# - tn#)) / (s# - new#)"
        ),
        tmoved=many(
            "(ts# + share * (tn# - ts#) + tshare * (new# - s#)"
            " if s# + share * (new# - s#) > low# else 0.0)"
        ),
        tsecond=many("tf# + 4.0 * p * ta#"),
        ty_of=lines("ty# = t# + 2.0 * ta#"),
        tthird=many("tr# + p * (ta# - tb#)"),
        ty_more=lines("ty# = ty# + td#"),
        tfourth=many("tr# + p * (ta# - tb# - (8.0 / 3.0) * td#)"),
        tn_of=lines("tn# = ty# + te#"),
        tn_noisy=lines("tn# = 0.0 if new# < low# and new# >= low# - noise# else tn#"),
        tstart=many("moving[n, #]"),
        tstore=many("moving[n, #]") + " = t",
    )
