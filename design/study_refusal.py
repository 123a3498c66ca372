"""Why a study file cannot be resumed by a search: what differs, in a few words."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

DIGESTS = ("founders and functions", "code of the target", "code of resolve")
# These differ with the parameters: the effects listed are those in the middle of the bounds.
OF_PARAMETERS = ("names", "effects", "founders and functions")
LONGEST, SHORT = 300, 48  # characters of a refusal, and of one value in it


def refusal(path: Path, names: list[str], there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The message for the study of another search: what differs, then as many values as fit."""
    names = sorted(names, key=lambda name: (name in DIGESTS, name == "effects"))
    if "parameters" in names:
        names = [name for name in names if name not in OF_PARAMETERS]
    out = f"{path.name} is the study of another search. Different: {', '.join(names)}."
    close = " Give another path (start= takes what this study knows), or restore the search."
    for name in names:
        if name in DIGESTS:  # their values say nothing to a reader
            continue
        old, new = _differing(there.get(name), here.get(name))
        detail = f" {name}: {_cut(old)} there, {_cut(new)} here."
        if len(out) + len(detail) + len(close) <= LONGEST:
            out += detail
    return out + close


def _differing(old: Any, new: Any) -> tuple[str, str]:
    """The parts of two values that differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        names = [n for n in {**old, **new} if old.get(n) != new.get(n)]
        return _differing(
            [f"{n}={old[n]}" for n in names if n in old],
            [f"{n}={new[n]}" for n in names if n in new],
        )
    if isinstance(old, list) and isinstance(new, list):
        one, other = [x for x in old if x not in new], [x for x in new if x not in old]
        if len(one) == len(other) == 1:
            return _differing(one[0], other[0])
        if not one and not other:  # in another order
            one, other = old, new
        return ", ".join(map(str, one)) or "none", ", ".join(map(str, other)) or "none"
    before, after = str(old), str(new)
    shortest = min(len(before), len(after))
    same = next((k for k in range(shortest) if before[k] != after[k]), shortest)
    # keep the whole argument that differs
    begin = max((m.end() for m in re.finditer(r"[(,]\s*", before[:same])), default=0)
    if shortest > SHORT:
        before, after = before[begin:], after[begin:]
    return before, after


def _cut(text: str) -> str:
    return text if len(text) <= SHORT else text[: SHORT - 1] + "…"
