"""The text of the stiff method for a circuit of a given size: `rosenbrock.rodas3`, for a few cells
side by side, each in steps of its own.

The cells are the lanes of vectors (`kernels.vectors`). A cell that has reached the end gives its
lane to the next one. The order of operations is that of `rosenbrock`, and so are its constants.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from torchfilm.circuits import linear, rosenbrock
from torchfilm.circuits.emission import as_tuple

CONSTANTS = {
    **{
        name: getattr(rosenbrock, name)
        for name in (
            "DONE", "TOO_MANY_STEPS", "NOT_FINITE", "BELOW_ZERO", "SAFETY", "SHRINK", "GROW",
            "LEAP", "LEAST_STEP", "MAX_NONFINITE_STEPS",
        )
    },
    "LEAST_PIVOT": linear.LEAST_PIVOT,
    "GOES_ON": -1,
}  # fmt: skip

HEAD = '''"""{what}, written by torchfilm."""

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.functions import _finite, _least, _most, _sign, inverse_cube_root
from torchfilm.kernels.vectors import (
    WIDTH, any_of, like, load, narrow, negated, store, where, wide,
)

{constants}


'''

STEP = '''@kernel
def rate(y, low, j, c):
    {y} = y
    {low} = low
    {below_of}
    {f} = rates(y, c)
    below = {any_below}
    if not any_of(below):
        return {f_as_y}
    {inside_of}
    {r} = rates({inside}, c)
    {g} = times_slopes(j, {y_less_inside})
    return {r_plus_g_or_f}


@kernel
def corrected(u, a, new, low, noise, m, j, c):
    """Moved towards two steps of backward Euler; whether these are valid."""
    {u} = u
    {a} = a
    {new} = new
    {low} = low
    {noise} = noise
    {middle_of}
    {s} = solved(m, rate({middle}, low, j, c))
    {s_of}
    {safe_of}
    share, valid = 1.0, True
    {share_of}
    return {moved}, valid


@kernel
def step(u, c, h, rtol, atol, eps, largest):
    {u} = u
    f, j = linearised(u, c)
    p = 1.0 / h
    m, sound, leaps = factored(j, 2.0 * p)
    {f} = f
    {low_of}
    low = {low}
    a = solved(m, f)
    {a} = a
    {b} = solved(m, {second})
    {y_of}
    {r} = rate({y}, low, j, c)
    {d} = solved(m, {third})
    {y_more}
    {r} = rate({y}, low, j, c)
    {e} = solved(m, {fourth})
    {new_of}
    error, size = 0.0, 0.0
    {error_of}
    error = where(leaps & (error < LEAP), LEAP, error)
    error = where(sound & (size < largest), error, np.nan)
    {noise_of}
    {noisy}
    {new_below_of}
    below = {any_below}
    if not any_of(below):
        return {new}, error, below
    {s}, valid = corrected(u, a, {new}, low, {noise}, m, j, c)
    moved = 0.0
    {moved_of}
    return {s_or_new}, error, below & negated(valid & (moved <= 1.0))


@kernel
def controlled(error, broken, left, h, dt):
    """After an attempt of length h: whether it is good, the last one, and no shorter one is left;
    the time that is left, and the length of the next attempt."""
    good = (error <= 1.0) & negated(broken)
    ends = good & (h >= left)
    left = where(good, left - h, left)
    factor = SAFETY * inverse_cube_root(_most(_least(error, 1e3), 1e-3))
    factor = np.floor(_most(_least(factor, GROW), SHRINK) * 1024.0 + 0.5) / 1024.0
    factor = where(abs(error) < np.inf, where(error > 0.0, factor, GROW), 0.25)
    factor = where(broken, _least(factor, 0.5), factor)
    h = _least(h * factor, left)
    h = where(left - h < 1e-10 * left, left, h)
    return good, ends, negated(good) & (h < LEAST_STEP * dt), left, h


@kernel
def verdict(error, broken, ends, lost):
    """The code of a cell that is done or has failed, or GOES_ON."""
    failed = where(broken, BELOW_ZERO, TOO_MANY_STEPS)
    failed = where(abs(error) < np.inf, failed, NOT_FINITE)
    return where(ends, DONE, where(lost, failed, GOES_ON))


'''

# The loop over cells, in lanes.
LOOP = '''@kernel
def begun{kind}(n, l, dt, {given}, w, at_work):
    """The cell n begins in the lane l."""
    {begin}
    c = prepared(leaf)
    {fill}
    w[{left}, l], w[{next}, l], at_work[l] = dt, dt, n
    w[{bad}, l] = w[{good}, l] = w[{tried}, l] = 0.0


@kernel(entry=True)
def run{kind}(first, last, {given}, dt, rtol, atol, eps, largest, most_steps, accepted, rejected,
        status):
    """Cells first … last − 1 over dt hours; at (M, V) in place. {what}"""
    if first >= last:
        return
    w, at_work = np.empty(({rows}, WIDTH)), np.empty(WIDTH, np.int64)
    for l in range(WIDTH):  # lanes without a cell of their own hold the last one
        begun{kind}(min(first + l, last - 1), l, dt, {given}, w, at_work)
        if first + l >= last:
            at_work[l], w[{next}, l] = -1, 0.0
    going, waiting = min(last - first, WIDTH), first + WIDTH
    while going > 0:
        {load}
        h = load(w, {next})
        awake = h > 0.0  # a lane that has no cell any more takes steps of no length, into nothing
        new, error, broken = step(u, c, h, rtol, atol, eps, largest)
        good, ends, lost, left, next_h = controlled(error, broken, load(w, {left}), h, dt)
        if any_of(good):
            {taken}
        known = error == error
        if any_of(awake & negated(known)):  # a cell is lost at once where its rates are no numbers
            {f} = rates(u, c)
            bad = load(w, {bad}) + where(known, 0.0, 1.0)
            store(w, {bad}, bad)
            sound = {all_finite}
            lost = lost | (negated(known) & (negated(sound) | (bad > MAX_NONFINITE_STEPS)))
        tried = load(w, {tried}) + 1.0
        code = verdict(error, broken, ends, lost)
        code = where((code == GOES_ON) & (tried >= most_steps), TOO_MANY_STEPS, code)
        store(w, {tried}, tried)
        store(w, {good}, load(w, {good}) + where(good, 1.0, 0.0))
        store(w, {left}, left)
        store(w, {next}, next_h)
        if not any_of(awake & (code != GOES_ON)):
            continue
        store(w, {code}, code)
        for l in range(WIDTH):
            n = at_work[l]
            if n < 0 or w[{code}, l] == GOES_ON:
                continue
            status[n], accepted[n] = w[{code}, l], w[{good}, l]
            rejected[n] = w[{tried}, l] - w[{good}, l]
            {keep}
            if waiting < last:
                begun{kind}(waiting, l, dt, {given}, w, at_work)
                waiting += 1
            else:
                at_work[l], w[{left}, l], w[{next}, l] = -1, 0.0, 0.0
                going -= 1
'''


# The vectors of the text: a, b, d, e are k₁ … k₄ of the method.
NAMES = (
    "u", "a", "b", "d", "e", "f", "g", "r", "s", "y", "low", "new", "inside", "noise", "middle",
)  # fmt: skip


def each(form: str, size: int, between: str = "\n    ") -> str:
    """The form for each variable, with its number in place of #."""
    return between.join(form.replace("#", str(i)) for i in range(size))


def tuple_of(form: str, size: int) -> str:
    return f"({each(form, size, ', ')}{',' * (size == 1)})"


def method(size: int, free: int, prepared: int, leaves: str) -> str:
    """The step and the loop over cells, for so many variables, of which the last may be `free`, and
    numbers that are prepared. leaves: the text of a cell's."""
    given, what = "at, columns, numbers", "columns (K, M), numbers (L,)."
    carried, fixed = {"u": ("at", "new")}, {"c": prepared}
    return step(size, free) + loop(size, carried, fixed, {"leaf": leaves}, given, what)


def step(size: int, free: int) -> str:
    """The text of an attempt and of its control."""
    return substituted(STEP, size, free)


def loop(
    size: int, carried: Mapping[str, tuple[str, str]], fixed: Mapping[str, int],
    begin: Mapping[str, str], given: str, what: str, kind: str = "",
) -> str:  # fmt: skip
    """The loop over cells. carried: tuples of V numbers, by name: the array (M, V) where they begin
    and end, and the text of what a good step makes of them. fixed: the lengths of further tuples in
    each lane, of which `begin` assigns all but c. given: what `run` takes besides, and `what` it
    is. kind: the end of the names."""
    rows, fill, taken, keep, load = 0, [], [], [], []
    for name, length in {**dict.fromkeys(carried, size), **fixed}.items():
        at = range(rows, rows + max(length, 1))
        rows = at.stop
        load.append(f"{name} = {as_tuple([f'load(w, {k})' for k in at])}")
        array, after = carried.get(name, ("", ""))
        for k, row in enumerate(at):
            fill.append(f"w[{row}, l] = " + (f"{array}[n, {k}]" if array else f"{name}[{k}]"))
        if array:
            taken.append(f"{name}_new = {after}")
            keep += [f"{array}[n, {k}] = w[{row}, l]" for k, row in enumerate(at)]
    for first, name in enumerate(carried):
        taken += [
            f"store(w, {first * size + k}, where(good, {name}_new[{k}], {name}[{k}]))"
            for k in range(size)
        ]
    own = ("left", "next", "bad", "good", "tried", "code")
    return LOOP.format(
        kind=kind, given=given, what=what, rows=rows + len(own),
        **{name: rows + k for k, name in enumerate(own)},
        begin="\n    ".join(f"{n} = {x}" for n, x in begin.items()), fill="\n    ".join(fill),
        load="\n        ".join(load), taken="\n            ".join(taken),
        keep="\n            ".join(keep), f=tuple_of("f#", size),
        all_finite=each("(abs(like(f#, h)) < np.inf)", size, " & "),
    )  # fmt: skip


def substituted(form: str, size: int, free: int, **more: str) -> str:
    """The text of a form for so many variables, of which the last ones, `free`, may be below 0;
    more: parts of its own."""
    lines, many = partial(each, size=size), partial(tuple_of, size=size)
    round_up = "{x}# = where(({x}# < low#) & ({x}# >= low# - noise#), low#, {x}#)"
    return form.format(
        **more,
        **{x: many(f"{x}#") for x in NAMES},
        below_of=lines("below# = y# < low#"),
        any_below=lines("below#", between=" | "),
        f_as_y=many("like(f#, y#)"),
        inside_of=lines("inside# = where(below#, low#, y#)"),
        y_less_inside=many("y# - inside#"),
        r_plus_g_or_f=many("where(below, r# + g#, like(f#, y#))"),
        middle_of=lines("middle# = u# + a#"),
        s_of=lines("s# = middle# + s#"),
        safe_of=lines(round_up.format(x="s")),
        share_of=lines(
            "valid = valid & (s# >= low#)\n    nearer = _least(share, (s# - low#) / (s# - new#))\n"
            "    share = where(new# < low#, nearer, share)"
        ),
        moved=many("_most(s# + share * (new# - s#), low#)"),
        low_of=each("low# = where(0.0 < u#, 0.0, u#)", size - free)
        + "".join(f"\n    low{k} = like(-np.inf, u{k})" for k in range(size - free, size)),
        second=many("f# + 4.0 * p * a#"),
        y_of=lines("y# = u# + 2.0 * a#"),
        third=many("r# + p * (a# - b#)"),
        y_more=lines("y# = y# + d#"),
        fourth=many("r# + p * (a# - b# - (8.0 / 3.0) * d#)"),
        new_of=lines("new# = y# + e#"),
        error_of=lines(
            "allowed# = atol + rtol * _most(abs(u#), abs(new#))\n"
            "    error = _most(error, abs(e#) / allowed#)\n"
            "    size = _most(size, abs(new#))"
        ),
        noise_of=lines("noise# = 8 * eps * (abs(u#) + 2 * abs(a#) + abs(d#) + abs(e#))"),
        noisy=lines(round_up.format(x="new")),
        new_below_of=lines("below# = new# < low#"),
        moved_of=lines("moved = _most(moved, abs(s# - new#) / allowed#)"),
        s_or_new=many("where(below, s#, new#)"),
    )
