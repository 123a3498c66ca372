"""The text of the stochastic methods for a network of a given form: `stochastic.tau_leap` and
`stochastic.direct`, for a few cells side by side.

Loops over these lanes have no branches and call no library, so that they become vectors of the
processor. A cell that has reached the end gives its lane to the next one. The order of operations
is that of `stochastic`, and so are its constants.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from torchfilm.circuits import stochastic
from torchfilm.circuits.emission import Functions, as_tuple
from torchfilm.circuits.network import Network

# Cells side by side: two vectors of the widest processors, so that one works while one waits.
LANES = 16

CONSTANTS = {
    name: getattr(stochastic, name)
    for name in (
        "DONE", "TOO_MANY_EVENTS", "BAD_PROPENSITY", "FEW_EVENTS", "MAX_LEAP_HALVINGS", "EPSILON",
        "CRITICAL",
    )
} | {"SHORT": 0.999 * stochastic.FEW_EVENTS, "LANES": LANES}  # fmt: skip

IMPORTS = """from torchfilm.kernels.functions import natural_log
from torchfilm.kernels.poisson import poisson
from torchfilm.kernels.random import two_uniforms

# What a lane does next: one event, a leap, or nothing more since a propensity is invalid.
EVENT, LEAP, INVALID = 0, 1, 2
# Rows of whole numbers in each lane; those of other numbers follow.
CELL, UID, STREAM, PASSED, DOES, WRONG, ENDS = range(0, 7 * LANES, LANES)
"""

RUN = '''@kernel
def waited(lanes, w, i, words, code):
    """The time until the next event, and the part of all propensities at which it is found."""
    for l in range(lanes):
        own = (np.uint64(i[UID + l]), np.uint64(i[STREAM + l]), words[0], words[1], words[2])
        u, v = two_uniforms(own, i[PASSED + l], code)
        total = w[TOTAL + l]
        w[WAIT + l] = -natural_log(u) / total
        w[AIM + l] = v * total


@kernel
def leap(x, often, seldom, longest, left, own, event, codes, events, after):
    """As `stochastic._Leap.leap`; the time that passed."""
    until, which, total = np.inf, 0, seldom[0]
    for j in range(1, {reactions}):
        total += seldom[j]
    if total > 0:
        u, v = two_uniforms(own, event, codes[1])
        until = -natural_log(u) / total
        aim, bound = v * total, seldom[0]
        while bound <= aim and which < {reactions} - 1:
            which += 1
            bound += seldom[which]
    far = _least(longest, left)
    for trial in range(MAX_LEAP_HALVINGS):
        time = min(far, until)
        for pair in range({pairs}):
            j = 2 * pair
            two = j + 1 < {reactions}
            events[j] = events[j + 1] = 0.0
            if often[j] > 0 or (two and often[j + 1] > 0):
                u, v = two_uniforms(own, event, codes[2 + {pairs} * trial + pair])
                events[j] = poisson(often[j] * time, u)
                if two:
                    events[j + 1] = poisson(often[j + 1] * time, v)
        fire(x, events, after)
        if until < far:
            for k in range({size}):
                after[k] += GAIN[which, k]
        if np.min(after) >= 0:
            x[:] = after
            return time
        far *= 0.5
    return 0.0


@kernel
def leaped(l, w, i, words, codes, x, often, seldom, events, after):
    """A leap in a lane if it would have more than a few events; whether it would."""
    for k in range({size}):
        x[k] = w[X + k * LANES + l]
    longest, left = split(x, w, l, often, seldom), w[LEFT + l]
    if not _least(longest, left) * w[TOTAL + l] >= FEW_EVENTS:
        return False
    own = (np.uint64(i[UID + l]), np.uint64(i[STREAM + l]), words[0], words[1], words[2])
    time = leap(x, often, seldom, longest, left, own, i[PASSED + l], codes, events, after)
    for k in range({size}):
        w[X + k * LANES + l] = x[k]
    w[LEFT + l] = left - time
    return True


@kernel
def moved(w, i, l, other):
    """What is in a lane, into another one."""
    for k in range(0, w.size, LANES):
        w[k + other] = w[k + l]
    for k in range(0, i.size, LANES):
        i[k + other] = i[k + l]


@kernel(entry=True)
def run(first, last, at, columns, numbers, uid, stream, words, codes, dt, most_steps, leaps, steps,
        status, wrong):
    """Cells first … last − 1 over dt hours; at (M, V) in place. columns (K, M), numbers (L,)."""
    w, i = np.empty(ROWS * LANES), np.empty(7 * LANES, np.int64)
    often, seldom, events = np.empty({reactions}), np.empty({reactions}), np.empty(2 * {pairs})
    x, after = np.empty({size}), np.empty({size})
    lanes, waiting = 0, first
    while lanes < LANES and waiting < last:
        begun(lanes, waiting, at, columns, numbers, uid, stream, dt, w, i)
        lanes, waiting = lanes + 1, waiting + 1
    while lanes > 0:
        propensities(lanes, w, i)
        alone = lanes
        if leaps and may_leap(lanes, w, i) > 0:
            for l in range(lanes):
                if i[DOES + l] == LEAP:
                    if leaped(l, w, i, words, codes, x, often, seldom, events, after):
                        alone -= 1
                    else:
                        i[DOES + l] = EVENT
        if alone > 0:
            waited(lanes, w, i, words, codes[0])
        if fired(lanes, w, i, most_steps) == 0:
            continue
        l = 0
        while l < lanes:
            if i[ENDS + l] == 0:
                l += 1
                continue
            n = i[CELL + l]
            for k in range({size}):
                at[n, k] = w[X + k * LANES + l]
            steps[n] = i[PASSED + l]
            if i[DOES + l] == INVALID:
                status[n], wrong[n] = BAD_PROPENSITY, i[WRONG + l]
            else:
                status[n] = DONE if w[LEFT + l] <= 0 else TOO_MANY_EVENTS
            if waiting < last:
                begun(l, waiting, at, columns, numbers, uid, stream, dt, w, i)
                waiting, l = waiting + 1, l + 1
            else:
                lanes -= 1
                moved(w, i, lanes, l)
'''


def method(network: Network, made: Functions, leaves: str) -> str:
    """The steps and the loop over cells, for these reactions. made: of their propensities. leaves:
    the text of a cell's."""
    gain = network.stoichiometry.tolist()
    orders = network.orders.tolist()
    reactions, size = len(gain), len(orders)
    taken = [{k: -g for k, g in enumerate(row) if g < 0} for row in gain]
    kept = len(made.hoisted)
    places = {"X": size, "C": max(kept, 1), "A": reactions} | dict.fromkeys(
        ("TOTAL", "LEFT", "WAIT", "AIM"), 1
    )
    text, row = "", 0
    for name, rows in places.items():
        text += f"{name} = {row} * LANES\n"
        row += rows
    text += f"ROWS = {row}\nGAIN = np.array({gain!r})\n\n\n"
    text += _begun(size, kept, leaves) + _propensities(made, taken) + _fired(gain)
    text += _leaps(gain, taken, orders) + _fire(gain)
    return text + RUN.format(reactions=reactions, size=size, pairs=(reactions + 1) // 2)


def _written(head: str, lines: Iterable[str]) -> str:
    return f"@kernel\ndef {head}:\n" + "".join(f"    {line}\n" for line in lines) + "\n\n"


def _in_lanes(lines: Iterable[str]) -> list[str]:
    return ["for l in range(lanes):", *(f"    {line}" for line in lines)]


def _at(name: str, k: int = 0) -> str:
    """The k-th of the numbers of this name in the lane l."""
    return f"w[{name} + {k} * LANES + l]"


def _begun(size: int, kept: int, leaves: str) -> str:
    """The cell n begins in the lane l."""
    head = "begun(l, n, at, columns, numbers, uid, stream, dt, w, i)"
    lines = [f"c = prepared({leaves})"]
    lines += [f"{_at('C', k)} = c[{k}]" for k in range(kept)]
    lines += [f"{_at('X', k)} = at[n, {k}]" for k in range(size)]
    lines += [
        "w[LEFT + l] = dt", "i[CELL + l], i[UID + l], i[STREAM + l] = n, uid[n], stream[n]",
        "i[PASSED + l] = 0",
    ]  # fmt: skip
    return _written(head, lines)


def _propensities(made: Functions, taken: Sequence[dict[int, float]]) -> str:
    """0 where an event needs more molecules than there are; the sum of all, in order; the first
    that is invalid."""
    size, count = len(made.equations.variables), len(taken)
    lines = [f"u = {as_tuple([_at('X', k) for k in range(size)])}"]
    lines.append(f"c = {as_tuple([_at('C', k) for k in range(len(made.hoisted))])}")
    lines += made.lines(made.equations.rates)
    lines.append(f"{as_tuple([f'a{j}' for j in range(count)])} = {made.rates_as_tuple()}")
    lines.append("bad = -1")
    for j in reversed(range(count)):
        lines.append(f"bad = bad if (a{j} >= 0.0) & (a{j} < np.inf) else {j}")
        enough = " & ".join(f"(u{k} >= {t!r})" for k, t in taken[j].items())
        lines += [f"a{j} = a{j} if {enough} else 0.0"] if enough else []
        lines.append(f"{_at('A', j)} = a{j}")
    lines += ["total = a0", *(f"total += a{j}" for j in range(1, count))]
    lines += [
        "w[TOTAL + l] = total", "i[WRONG + l] = bad", "i[DOES + l] = EVENT if bad < 0 else INVALID"
    ]  # fmt: skip
    return _written("propensities(lanes, w, i)", _in_lanes(lines))


def _fired(gain: Sequence[Sequence[float]]) -> str:
    """The event found, if it comes before the end; how many lanes have ended. The reaction is the
    first up to which propensities add up to more than the aim."""
    # comparisons of one number with many would become a switch, which is no vector
    lines = ["left, wait = w[LEFT + l], w[WAIT + l]", "does = i[DOES + l]"]
    lines += ["alone = does == EVENT", "happens = alone & (wait < left)"]
    lines += ["aim = w[AIM + l] if happens else np.inf", "bound, before = 0.0, 1.0"]
    for j in range(len(gain)):
        lines += [f"bound += {_at('A', j)}", "after = 1.0 if bound <= aim else 0.0"]
        lines += [f"which{j} = before - after", "before = after"]
    for k in range(len(gain[0])):
        terms = "".join(f" + {row[k]!r} * which{j}" for j, row in enumerate(gain) if row[k])
        lines += [f"{_at('X', k)} += {terms[3:]}"] if terms else []
    lines += [
        "passed = wait if happens else left", "left = left - passed if alone else left",
        "steps = i[PASSED + l] + (does != INVALID)",
        "ends = 1 if (left <= 0) | (steps >= most_steps) | (does == INVALID) else 0",
        "w[LEFT + l], i[PASSED + l], i[ENDS + l] = left, steps, ends", "ended += ends",
    ]  # fmt: skip
    lines = ["ended = 0", *_in_lanes(lines), "return ended"]
    return _written("fired(lanes, w, i, most_steps)", lines)


def _leaps(
    gain: Sequence[Sequence[float]], taken: Sequence[dict[int, float]], orders: Sequence[float]
) -> str:
    """`may_leap`: lanes whose leap has more than a few events as far as can be found out without
    divisions; most have not. `split`: reactions that may leap and those that are critical; returns
    the longest leap."""
    count, size = len(gain), len(orders)
    read = [f"x{k} = {_at('X', k)}" for k in range(size)]
    read += [f"a{j} = {_at('A', j)}" for j in range(count)]
    for j, uses in enumerate(taken):
        rare = " | ".join(f"(x{k} < CRITICAL * {t!r})" for k, t in uses.items())
        read += [f"a{j} = 0.0 if {rare} else a{j}"] if rare else []
    tests, times = ["total, short = w[TOTAL + l], False"], ["longest = np.inf"]
    for k, given in enumerate(orders):
        changes = [(j, row[k]) for j, row in enumerate(gain) if row[k]]
        if given <= 0 or not changes:
            continue
        order = max(given, 1.0)
        losses = [f"{-g!r} * a{j}" for j, g in changes if g < 0]
        read += [
            f"drift{k} = abs(" + " + ".join(f"{g!r} * a{j}" for j, g in changes) + ")",
            *([f"drift{k} = _most(drift{k}, {' + '.join(losses)})"] if losses else []),
            f"spread{k} = " + " + ".join(f"{g * g!r} * a{j}" for j, g in changes),
        ]
        tests += [
            f"most = _most(EPSILON / {order!r} * x{k}, 1.0)",
            f"short |= most * total < SHORT * drift{k}",
            f"short |= most * most * total < SHORT * spread{k}",
        ]
        more = f" + {order - 1!r} / _most(x{k} - 1.0, 1.0)" if order > 1 else ""
        times += [
            f"change = _most(EPSILON * x{k} / ({order!r}{more}), 1.0)",
            f"if spread{k} > 0:",
            f"    time = _least(change / drift{k}, change * change / spread{k})",
            "    longest = _least(longest, time)",
        ]
    tests += [
        "leaps = (not short) & (w[LEFT + l] * total >= FEW_EVENTS) & (i[DOES + l] == EVENT)",
        "i[DOES + l] = LEAP if leaps else i[DOES + l]", "found += leaps",
    ]  # fmt: skip
    apart = [f"often[{j}], seldom[{j}] = a{j}, {_at('A', j)} - a{j}" for j in range(count)]
    lines = ["found = 0", *_in_lanes([*read, *tests]), "return found"]
    return _written("may_leap(lanes, w, i)", lines) + _written(
        "split(x, w, l, often, seldom)", [*read, *times, *apart, "return longest"]
    )


def _fire(gain: Sequence[Sequence[float]]) -> str:
    """Molecule numbers after so many events of each reaction."""
    lines = []
    for k in range(len(gain[0])):
        terms = "".join(f" + {row[k]!r} * events[{j}]" for j, row in enumerate(gain) if row[k])
        lines.append(f"after[{k}] = x[{k}]{terms}")
    return _written("fire(x, events, after)", lines)
