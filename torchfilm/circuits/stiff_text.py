"""The text of the stiff method for a circuit of a given size: `rosenbrock.rodas3`, cell by cell.

The order of operations is that of `rosenbrock`, and so are its constants.
"""

from __future__ import annotations

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
def run(first, last, at, columns, numbers, dt, rtol, atol, eps, largest, most_steps, accepted,
        rejected, status):
    """Cells first … last − 1 over dt hours; at (M, V) in place. columns (K, M), numbers (L,)."""
    for n in range(first, last):
        c = prepared({leaves})
        u = {start}
        left, h, bad, code = dt, dt, 0, TOO_MANY_STEPS
        for _ in range(most_steps):
            new, error, broken = step(u, c, h, rtol, atol, eps, largest)
            good = error <= 1.0 and not broken
            ends = good and h >= left
            if good:
                left -= h
                accepted[n] += 1
            else:
                rejected[n] += 1
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
            lost = not good and h < LEAST_STEP * dt
            if good:
                u = new
            if error != error:
                bad += 1
                lost = lost or bad > MAX_NONFINITE_STEPS
                {f} = rates(u, c)
                lost = lost or not ({all_finite})
            if ends:
                code = DONE
                break
            if lost:
                code = NOT_FINITE
                if abs(error) < np.inf:
                    code = BELOW_ZERO if broken else TOO_MANY_STEPS
                break
        {store}
        status[n] = code
'''


# The vectors of the text: a, b, d, e are k₁ … k₄ of the method.
NAMES = (
    "u", "a", "b", "d", "e", "f", "g", "r", "s", "y", "low", "new", "inside", "noise", "middle",
)  # fmt: skip


def method(size: int, leaves: str) -> str:
    """The step and the loop over cells, for so many variables. leaves: the text of a cell's."""

    def each(form: str, between: str = "\n    ") -> str:
        return between.join(form.replace("#", str(i)) for i in range(size))

    def many(form: str) -> str:
        return f"({each(form, ', ')}{',' * (size == 1)})"

    round_up = "{x}# = low# if {x}# < low# and {x}# >= low# - noise# else {x}#"
    return STEP.format(
        **{x: many(f"{x}#") for x in NAMES},
        any_below=each("y# < low#", " or "),
        inside_of=each("inside# = low# if y# < low# else y#"),
        y_less_inside=many("y# - inside#"),
        f_plus_g=many("f# + g#"),
        middle_of=each("middle# = u# + a#"),
        s_of=each("s# = middle# + s#"),
        safe_of=each(round_up.format(x="s")),
        share_of=each(
            "valid = valid and s# >= low#\n    if new# < low#:\n"
            "        share = _least(share, (s# - low#) / (s# - new#))"
        ),
        moved=many("_most(s# + share * (new# - s#), low#)"),
        low_of=each("low# = min(u#, 0.0)"),
        second=many("f# + 4.0 * p * a#"),
        y_of=each("y# = u# + 2.0 * a#"),
        third=many("r# + p * (a# - b#)"),
        y_more=each("y# = y# + d#"),
        fourth=many("r# + p * (a# - b# - (8.0 / 3.0) * d#)"),
        new_of=each("new# = y# + e#"),
        error_of=each(
            "allowed# = atol + rtol * _most(abs(u#), abs(new#))\n"
            "    error = _most(error, abs(e#) / allowed#)\n"
            "    size = _most(size, abs(new#))"
        ),
        noise_of=each("noise# = 8 * eps * (abs(u#) + 2 * abs(a#) + abs(d#) + abs(e#))"),
        noisy=each(round_up.format(x="new")),
        new_below=each("new# < low#", " or "),
        worse_of=each("worse# = new#"),
        new_pattern=each("new#", ", ") + "," * (size == 1),
        moved_of=each("moved = _most(moved, abs(new# - worse#) / allowed#)"),
        leaves=leaves,
        start=many("at[n, #]"),
        all_finite=each("abs(f#) < np.inf", " and "),
        store=many("at[n, #]") + " = u",
    )
