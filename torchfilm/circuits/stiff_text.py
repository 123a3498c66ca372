"""The text of the stiff method for a circuit of a given size: `rosenbrock.rodas3`, cell by cell.

The order of operations is that of `rosenbrock`, and so are its constants.
"""

from __future__ import annotations

from functools import partial

from torchfilm.circuits import linear, rosenbrock

CONSTANTS = {
    **{
        name: getattr(rosenbrock, name)
        for name in (
            "DONE", "TOO_MANY_STEPS", "NOT_FINITE", "BELOW_ZERO", "SAFETY", "SHRINK", "GROW",
            "LEAST_STEP", "MAX_NONFINITE_STEPS",
        )
    },
    "LEAST_PIVOT": linear.LEAST_PIVOT,
    "GOES_ON": -1,
}  # fmt: skip

HEAD = '''"""{what}, written by torchfilm."""

import math

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.functions import (
    _finite, _least, _log, _log1p, _log2, _log10, _most, _remainder, _sign, _sqrt,
)

{constants}


'''

STEP = '''@kernel
def rate(y, low, j, c):
    {y} = y
    {low} = low
    if not ({any_below}):
        return rates(y, c)
    {inside_of}
    {f} = rates({inside}, c)
    {g} = times_slopes(j, {y_less_inside})
    return {f_plus_g}


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
    m, sound = factored(j, 2.0 * p)
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
    if not (sound and size < largest):
        error = np.nan
    {noise_of}
    {noisy}
    if not ({new_below}):
        return {new}, error, False
    {worse_of}
    ({new_pattern}), valid = corrected(u, a, {new}, low, {noise}, m, j, c)
    moved = 0.0
    {moved_of}
    return {new}, error, not (valid and moved <= 1.0)


@kernel
def controlled(error, broken, left, h, dt):
    """After an attempt of length h: whether it is good, the last one, and no shorter one is left;
    the time that is left, and the length of the next attempt."""
    good = error <= 1.0 and not broken
    ends = good and h >= left
    if good:
        left -= h
    if ends:  # a logarithm and an exponential less for every cell
        return good, ends, False, left, h
    factor = 0.25
    if abs(error) < np.inf:
        factor = GROW
        if error > 0.0:
            factor = SAFETY * math.exp(math.log(error) / -3.0)
            factor = math.floor(min(max(factor, SHRINK), GROW) * 1024.0 + 0.5) / 1024.0
    if broken:
        factor = min(factor, 0.5)
    h = min(h * factor, left)
    if left - h < 1e-10 * left:
        h = left
    return good, ends, not good and h < LEAST_STEP * dt, left, h


@kernel
def verdict(u, c, error, broken, ends, lost, bad):
    """The code of a cell that is done or has failed, or GOES_ON; how many attempts had no number
    for a result."""
    if error != error:
        bad += 1
        {f} = rates(u, c)
        lost = lost or bad > MAX_NONFINITE_STEPS or not ({all_finite})
    if ends:
        return DONE, bad
    if not lost:
        return GOES_ON, bad
    if abs(error) < np.inf:
        return BELOW_ZERO if broken else TOO_MANY_STEPS, bad
    return NOT_FINITE, bad


@kernel(entry=True)
def run(first, last, at, columns, numbers, dt, rtol, atol, eps, largest, most_steps, accepted,
        rejected, status):
    """Cells first … last − 1 over dt hours; at (M, V) in place. columns (K, M), numbers (L,)."""
    for n in range(first, last):
        c = prepared({leaves})
        u = {start}
        {advance}
        {store}
'''

# A cell's steps, which also a loop that carries tangents takes; {taken}: a good one, of length h.
ADVANCE = """left, h, bad, code = dt, dt, 0, GOES_ON
        for _ in range(most_steps):
            new, error, broken = step(u, c, h, rtol, atol, eps, largest)
            good, ends, lost, left, next_h = controlled(error, broken, left, h, dt)
            if good:
                {taken}
                accepted[n] += 1
            else:
                rejected[n] += 1
            code, bad = verdict(u, c, error, broken, ends, lost, bad)
            if code != GOES_ON:
                break
            h = next_h
        status[n] = code if code != GOES_ON else TOO_MANY_STEPS"""


# The vectors of the text: a, b, d, e are k₁ … k₄ of the method.
NAMES = (
    "u", "a", "b", "d", "e", "f", "g", "r", "s", "y", "low", "new", "inside", "noise", "middle",
)  # fmt: skip


def each(form: str, size: int, between: str = "\n    ") -> str:
    """The form for each variable, with its number in place of #."""
    return between.join(form.replace("#", str(i)) for i in range(size))


def tuple_of(form: str, size: int) -> str:
    return f"({each(form, size, ', ')}{',' * (size == 1)})"


def method(size: int, leaves: str) -> str:
    """The step and the loop over cells, for so many variables. leaves: the text of a cell's."""
    return substituted(STEP, size, leaves=leaves, advance=ADVANCE.format(taken="u = new"))


def substituted(form: str, size: int, **more: str) -> str:
    """The text of a form for so many variables; more: parts of its own."""
    lines, many = partial(each, size=size), partial(tuple_of, size=size)
    round_up = "{x}# = low# if {x}# < low# and {x}# >= low# - noise# else {x}#"
    return form.format(
        **more,
        **{x: many(f"{x}#") for x in NAMES},
        any_below=lines("y# < low#", between=" or "),
        inside_of=lines("inside# = low# if y# < low# else y#"),
        y_less_inside=many("y# - inside#"),
        f_plus_g=many("f# + g#"),
        middle_of=lines("middle# = u# + a#"),
        s_of=lines("s# = middle# + s#"),
        safe_of=lines(round_up.format(x="s")),
        share_of=lines(
            "valid = valid and s# >= low#\n    if new# < low#:\n"
            "        share = _least(share, (s# - low#) / (s# - new#))"
        ),
        moved=many("_most(s# + share * (new# - s#), low#)"),
        low_of=lines("low# = min(u#, 0.0)"),
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
        new_below=lines("new# < low#", between=" or "),
        worse_of=lines("worse# = new#"),
        new_pattern=lines("new#", between=", ") + "," * (size == 1),
        moved_of=lines("moved = _most(moved, abs(new# - worse#) / allowed#)"),
        start=many("at[n, #]"),
        all_finite=lines("abs(f#) < np.inf", between=" and "),
        store=many("at[n, #]") + " = u",
    )
