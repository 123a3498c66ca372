"""What a search says of itself as it runs, on stderr: what makes its outcome worth little."""

from __future__ import annotations

import sys

import numpy as np

from design.finals import Finals
from design.loss_bands import seeds_to_hold
from design.methods import Method
from design.saved_design import why_unsaved
from design.study import Study
from design.task import Task
from torchfilm import checks, displays


def all_failed(study: Study) -> bool:
    """Whether no colony has come to its end."""
    return bool(study.entries) and all(len(e.reasons) == e.losses.size for e in study.entries)


def remark_on_begin(task: Task) -> None:
    """Say what cannot be saved, and which parameters are searched in vain."""
    if task.tried.idle:
        print(
            f"nothing in the scene depends on {', '.join(task.tried.idle)}: the scene function does"
            " not use it. Leave it out of the parameters, or give it to an effect.",
            file=sys.stderr,
        )
    if why := why_unsaved(task.family.fixed):
        print(f"the best design can be run, but not saved: {why}", file=sys.stderr)


def remark_on_stop_at(task: Task, finals: Finals | None, budget: float) -> None:
    """Warn where no design can hold a wanted loss. budget: colonies under each condition."""
    if finals is not None and not finals.can_hold(task, budget):
        seeds = seeds_to_hold(task)[-1]
        checks.warn(
            f"stop_at: a design of reduce={task.reduce!r} holds a loss on {seeds} fresh seeds, at"
            f" {displays.counted(len(finals.sizes), 'size')}. The finals of a search of"
            f" {budget:g} colonies do not have them, so that it does not end early. Give more"
            " colonies, or Finals(share=…)."
        )


def remark_on_batch(task: Task, study: Study, size: float, loss: np.ndarray) -> None:
    """Say what the first batch of a search shows; and that small colonies tell nothing apart.

    size: of the batch's colonies. loss: (n,)."""
    if len(study.entries) == 1 and (remark := task.target.remark(loss)):
        print(remark, file=sys.stderr)
    if size < 1 and loss.ndim == 1 and len(loss) > 1 and np.ptp(loss) == 0:
        print(
            f"colonies of {size:g} of the size all have the loss {float(loss[0]):g}: chance decides"
            " which designs go on. The pattern may not fit into so few cells.",
            file=sys.stderr,
        )


def remark_on_stop(task: Task, study: Study, colonies: int, why: str = "") -> None:
    """Say where a run has stopped before its end, and how to go on. colonies: the budget."""
    found = "front" if task.goals else "best"
    kept = (
        f"{study.path} keeps them; run the search again to resume it"
        if study.path
        else f"search.{found}() returns the best of them"
    )
    at = f"{study.colonies:.0f} of {colonies} colonies"
    print(f"stopped at {at}{why}; {kept}.", file=sys.stderr)


def remark_on_end(task: Task, study: Study, method: Method, colonies: int, holds: bool) -> None:
    """Say what makes the outcome worth little. colonies: the budget. holds: whether the search
    found what was wanted."""
    if all_failed(study):
        reason = study.failures()[0][0]
        print(f"every colony failed; the most frequent reason: {reason}", file=sys.stderr)
    remark = getattr(method, "remark", "")
    if remark and not holds:
        print(remark, file=sys.stderr)
    each = task.colonies_each
    if sum(len(e.points) for e in study.entries) == 1 and colonies < 2 * each:
        counted = displays.counted
        print(
            "one design was tried, so it is the best: each takes"
            f" {counted(each, 'colony', 'colonies')}, and the search had"
            f" {counted(colonies, 'colony', 'colonies')}.",
            file=sys.stderr,
        )
