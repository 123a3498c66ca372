"""What differs between two listings of effects, in words."""

from __future__ import annotations

import difflib
import re


def differences(was: list[str], now: list[str]) -> str:
    """What differs between two listings of effects. Of an effect that both have in different forms
    only the parts that differ: a circuit has a long text."""
    gone, new = [e for e in was if e not in now], [e for e in now if e not in was]
    changed = []
    for old in tuple(gone):
        kind = old.partition("(")[0]
        other = next((e for e in new if e.partition("(")[0] == kind), None)
        if other is not None:
            gone.remove(old)
            new.remove(other)
            changed += [f"{kind}: {a} there, {b} in this scene" for a, b in _changed(old, other)]
    whole = list_kinds({"recorded with": gone, "this scene has": new})
    return "; ".join([*changed, *([whole] if whole else [])])


# The name of an argument, or of an entry.
NAMED = re.compile(r"=|[A-Za-z_]: ")


def _changed(old: str, new: str) -> list[tuple[str, str]]:
    """The arguments in which two texts of one effect differ, "nothing" where one lacks them."""
    was, now = (re.split(r"(, |[()\[\]{}])", text) for text in (old, new))
    shown = lambda parts: repr(text) if (text := "".join(parts).strip(", ")) else "nothing"
    found = []
    for kind, i, j, k, m in difflib.SequenceMatcher(None, was, now, False).get_opcodes():
        if kind == "equal":
            continue
        back = 0  # from the name of the argument on, where a part of its value differs
        while i > back and j > i and m > k and not NAMED.search("".join(was[i - back : j])):
            back += 1
        found.append((shown(was[i - back : j]), shown(now[k - back : m])))
    return found


def list_kinds(kinds: dict[str, list[str]]) -> str:
    return "; ".join(
        f"{kind} {', '.join(map(repr, names))}" for kind, names in kinds.items() if names
    )
