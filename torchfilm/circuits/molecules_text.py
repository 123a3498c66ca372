"""The text of the stochastic methods for a network of a given form: `stochastic.tau_leap` and
`stochastic.direct`, cell by cell.

The order of operations is that of `stochastic`, and so are its constants.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchfilm.circuits import stochastic
from torchfilm.circuits.network import Network

CONSTANTS = {
    name: getattr(stochastic, name)
    for name in (
        "DONE", "TOO_MANY_EVENTS", "BAD_PROPENSITY", "FEW_EVENTS", "MAX_LEAP_HALVINGS", "EPSILON",
        "CRITICAL",
    )
} | {"SHORT": 0.999 * stochastic.FEW_EVENTS}  # fmt: skip

IMPORTS = """from torchfilm.kernels.poisson import poisson
from torchfilm.kernels.random import two_uniforms

"""

RUN = '''@kernel
def chosen(parts, aim):
    """The first up to which the parts add up to more than `aim`; the last above 0 if there is
    none, and the last of all where all are 0."""
    bound, last = 0.0, {last}
    for j in range({reactions}):
        bound += parts[j]
        if bound > aim:
            return j
        if parts[j] > 0:
            last = j
    return last


@kernel
def happened(x, which, after):
    for k in range({size}):
        after[k] = x[k] + GAIN[which, k]


@kernel
def single(x, a, total, left, own, event, code):
    """One event, or the end if the event would come after it; the time that passed."""
    u, v = two_uniforms(own, event, code)
    wait = -math.log(u) / total
    if wait < left:
        happened(x, chosen(a, v * total), x)
        return wait
    return left


@kernel
def leap(x, often, seldom, longest, left, own, event, codes, events, after):
    """As `stochastic._Leap.leap`; the time that passed."""
    until, which, total = np.inf, 0, added(seldom)
    if total > 0:
        u, v = two_uniforms(own, event, codes[1])
        until = -math.log(u) / total
        which = chosen(seldom, v * total)
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
            happened(after, which, after)
        if np.min(after) >= 0:
            x[:] = after
            return time
        far *= 0.5
    return 0.0


@kernel
def run(first, last, at, columns, numbers, uid, stream, words, codes, dt, most_steps, leaps, steps,
        status, wrong):
    """Cells first … last − 1 over dt hours; at (M, V) in place. columns (K, M), numbers (L,)."""
    a, often, seldom = np.empty({reactions}), np.empty({reactions}), np.empty({reactions})
    x, after, events = np.empty({size}), np.empty({size}), np.empty(2 * {pairs})
    for n in range(first, last):
        c = prepared({leaves})
        own = (np.uint64(uid[n]), np.uint64(stream[n]), words[0], words[1], words[2])
        x[:] = at[n]
        left, code = dt, TOO_MANY_EVENTS
        for event in range(most_steps):
            bad = propensities(x, a, c)
            if bad >= 0:
                wrong[n] = bad
                code = BAD_PROPENSITY
                break
            total, longest = added(a), 0.0
            if leaps:
                longest = split(x, a, often, seldom, total)
            if _least(longest, left) * total >= FEW_EVENTS:
                passed = leap(x, often, seldom, longest, left, own, event, codes, events, after)
            else:
                passed = single(x, a, total, left, own, event, codes[0])
            left -= passed
            steps[n] += 1
            if left <= 0:
                code = DONE
                break
        at[n] = x
        status[n] = code
'''


def method(network: Network, leaves: str) -> str:
    """The steps and the loop over cells, for these reactions. leaves: the text of a cell's."""
    gain = network.stoichiometry.tolist()
    orders = network.orders.tolist()
    reactions, size = len(gain), len(orders)
    taken = [{k: -g for k, g in enumerate(row) if g < 0} for row in gain]
    text = f"GAIN = np.array({gain!r})\n\n\n"
    text += _propensities(size, taken) + _added(reactions) + _split(gain, taken, orders)
    text += _fire(gain)
    return text + RUN.format(
        reactions=reactions, last=reactions - 1, size=size, pairs=(reactions + 1) // 2,
        leaves=leaves,
    )  # fmt: skip


def _written(head: str, lines: Sequence[str]) -> str:
    return f"@kernel\ndef {head}:\n" + "".join(f"    {line}\n" for line in lines) + "\n\n"


def _many(form: str, count: int) -> str:
    return "(" + ", ".join(form.replace("#", str(k)) for k in range(count)) + ",)"


def _propensities(size: int, taken: Sequence[dict[int, float]]) -> str:
    """0 where an event needs more molecules than there are; returns the first that is invalid."""
    count = len(taken)
    lines = [f"{_many('a#', count)} = rates({_many('x[#]', size)}, c)", "bad = -1"]
    for j in reversed(range(count)):
        lines += [f"if not (0.0 <= a{j} < np.inf):", f"    bad = {j}"]
        enough = " and ".join(f"x[{k}] >= {t!r}" for k, t in taken[j].items())
        lines.append(f"a[{j}] = a{j}" + (f" if {enough} else 0.0" if enough else ""))
    return _written("propensities(x, a, c)", [*lines, "return bad"])


def _added(count: int) -> str:
    """The sum of all, in order."""
    lines = ["total = a[0]", *(f"total += a[{j}]" for j in range(1, count)), "return total"]
    return _written("added(a)", lines)


def _split(
    gain: Sequence[Sequence[float]], taken: Sequence[dict[int, float]], orders: Sequence[float]
) -> str:
    """Reactions that may leap and those that are critical; returns the longest leap, or 0 where it
    would have few events, as most have: found out without divisions, and without branches, which
    would be as good as random."""
    count, size = len(gain), len(orders)
    # everything is read first: what is read on a condition becomes a branch
    lines = [f"{_many('x#', size)} = {_many('x[#]', size)}", "short = False"]
    lines.append(f"{_many('a#', count)} = {_many('a[#]', count)}")
    for j, uses in enumerate(taken):
        rare = " or ".join(f"x{k} < CRITICAL * {t!r}" for k, t in uses.items())
        lines += [f"a{j} = 0.0 if {rare} else a{j}"] if rare else []
    times = ["if short:", "    return 0.0", "longest = np.inf"]
    for k, given in enumerate(orders):
        changes = [(j, row[k]) for j, row in enumerate(gain) if row[k]]
        if given <= 0 or not changes:
            continue
        order = max(given, 1.0)
        lines += [
            f"mean{k} = abs(" + " + ".join(f"{g!r} * a{j}" for j, g in changes) + ")",
            f"spread{k} = " + " + ".join(f"{g * g!r} * a{j}" for j, g in changes),
            f"most = _most(EPSILON / {order!r} * x{k}, 1.0)",
            f"short |= most * total < SHORT * mean{k}",
            f"short |= most * most * total < SHORT * spread{k}",
        ]
        more = f" + {order - 1!r} / _most(x{k} - 1.0, 1.0)" if order > 1 else ""
        times += [
            f"change = _most(EPSILON * x{k} / ({order!r}{more}), 1.0)",
            f"if spread{k} > 0:",
            f"    time = _least(change / mean{k}, change * change / spread{k})",
            "    longest = _least(longest, time)",
        ]
    apart = [f"often[{j}] = a{j}" for j in range(count)]
    apart += [f"seldom[{j}] = a[{j}] - a{j}" for j in range(count)]
    return _written("split(x, a, often, seldom, total)", [*lines, *times, *apart, "return longest"])


def _fire(gain: Sequence[Sequence[float]]) -> str:
    """Molecule numbers after so many events of each reaction."""
    lines = []
    for k in range(len(gain[0])):
        terms = "".join(f" + {row[k]!r} * events[{j}]" for j, row in enumerate(gain) if row[k])
        lines.append(f"after[{k}] = x[{k}]{terms}")
    return _written("fire(x, events, after)", lines)
