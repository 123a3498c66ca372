"""Whether the means of a design's colonies are those that were observed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import norm

from design.targets.base import Target
from design.targets.measured import has_mean_with_error
from design.targets.statistics import LOG_CELLS

FEW = 3  # colonies, fewer of which do not tell how much they differ
CHANCE = 0.05  # of a remark on a design that is right, whatever the number of measures


def means_off(target: Target, found: Mapping[str, Sequence[float]]) -> str:
    """What to know where the mean of a measure is off that of the data by more than their errors;
    "" for other targets. found: of each colony, by name.

    The errors of both means are taken for normal, and the limit is Bonferroni's for as many
    measures."""
    observed, evidence = getattr(target, "colonies", 1), target.evidence
    if observed < FEW or has_mean_with_error(target):
        return ""
    known = {n: np.asarray(x)[np.isfinite(x)] for n, x in found.items() if n in evidence}
    known = {name: x for name, x in known.items() if len(x) >= FEW}
    limit = float(norm.isf(CHANCE / 2 / max(len(known), 1)))
    # the data hold the mean logarithm of numbers of cells
    names = getattr(getattr(target, "plan", None), "names", ())
    off = {}
    for name, x in known.items():
        wanted, spread = evidence[name]
        if f"{LOG_CELLS}{name.removeprefix('cells')}" in names:
            x, wanted, spread = np.log(x), math.log(wanted), spread / wanted
        error = math.hypot(spread / math.sqrt(observed), x.std(ddof=1) / math.sqrt(len(x)))
        off[name] = abs(float(x.mean()) - wanted) / error
    if not off or max(off.values()) <= limit:
        return ""
    name = max(off, key=lambda n: off[n])
    mean, count = float(known[name].mean()), len(known[name])
    return (
        f"the mean over {count} colonies of {name} is {mean:.4g}, where {evidence[name][0]:.4g} was"
        f" observed: {off[name]:.1f} standard errors apart. The loss is that of single colonies,"
        " which favours designs whose colonies differ little; infer(…) compares means."
    )
