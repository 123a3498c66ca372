"""The report of a search as a table; `design.report_plot` draws it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from design.data_means import means_off
from design.finals import FreshLosses
from design.growing import FinishedColonies
from design.loss_bands import seeds_of_an_end
from design.parameters import Choice, Parameter, Space, Value, show_value
from design.study import Study
from design.targets.base import Target
from design.targets.goals import MANY, Constrained, Goals, constrained
from design.targets.lasting import Lasting
from design.targets.measured import extinct_words, has_mean_with_error
from design.task import SURVIVORS, Task
from design.trivial import EVERY_SECOND, trivial_losses
from torchfilm import displays

WORST = 3  # statistics that a poor fit names
LARGE = 1e5  # a loss of which decimals say nothing
LUCKY = 0.8  # of the band on fresh seeds: a search that saw less than this was misled
SUCCESS = 0.25  # of the loss of the best trivial answer: as in the comparison of methods
SPREADS = 1.7  # standard errors between a mean and its band of 90 %
MISSES = "misses constraints"  # in place of a loss that says nothing else
# Designs of which not all have the same loss by chance: it differs by less than this share of it.
# (A solver takes other steps where another species changes.)
ALIKE, DIFFERENT = 8, 1e-3
FITS = 2.0  # a greater loss is not that of colonies like the observed ones, which is about 1
NEAR = 0.005  # of a bound, as a share of the range (of its logarithm)


@dataclass(frozen=True, eq=False)
class ReportedDesign:
    """A design that a report shows: its values by name, its point (D,), its loss in the search and
    the losses (R,) of its replicates there, its colonies at their ends, and its losses on fresh
    seeds, where it was tested."""

    title: str
    values: dict[str, Value]
    point: np.ndarray
    loss: float
    losses: np.ndarray
    colonies: list[FinishedColonies]
    fresh: FreshLosses | None = None


@dataclass(frozen=True, eq=False)
class SearchReport:
    """What a report of a search shows. why_regrown: the reason why colonies did not follow recorded
    growth, or ""; why_chosen: the method, if the search chose it, and why."""

    task: Task
    study: Study
    why_regrown: str
    first: ReportedDesign
    best: ReportedDesign
    why_chosen: str = ""


def table(report: SearchReport) -> str:
    """Parameters with bounds, first guess and best value; then losses and measures."""
    first, best, study = report.first, report.best, report.study
    target = report.task.target
    rows: list[tuple[str, ...]] = [("parameter", "bounds", first.title, best.title, "")]
    rows += parameter_rows(report.task.space, first.values, best.values)
    words = lambda loss: MISSES if misses_constraints(target, loss) else show_loss(loss)
    rows.append((_loss_title(report), "", words(first.loss), words(best.loss), ""))
    rows += _goals(report)
    if best.fresh is not None:
        title, loss = f"{_loss_title(report)} on fresh seeds", words(best.fresh.loss)
        rows.append((title, "", "", loss, _seeds(report.task, best.fresh)))
    rows.append(("cells", "", *(cells_in(design.colonies) for design in (first, best)), ""))
    old, new = (each_measured(target, design.colonies) for design in (first, best))
    seen = {name: f"{value:.4g} ± {by:.2g}" for name, (value, by) in target.evidence.items()}
    if seen:
        rows = [(*row, "") for row in rows]
        rows[0] = (*rows[0][:5], "observed")
    for name in new:
        means = (show_value(_mean(values)) for values in (old.get(name, []), new[name]))
        row = (name, target.bounds.get(name, ""), *means, _spread(new[name]))
        rows.append((*row, seen.get(name, "")) if seen else row)
    lines = displays.aligned(rows, left=(0, 1, 4, 5))
    lines += _undefined(target, new)
    lines += filter(None, [means_off(target, new)])
    lines += _warnings(report)
    lines += failure_words(study, target)
    how = (
        f"grown again for each design: {report.why_regrown}"
        if report.why_regrown
        else "circuits ran on one recorded growth"
    )
    if report.why_chosen:
        lines.append(report.why_chosen)
    lines.append(f"{cost_words(study)}; {how}")
    return "\n".join(lines)


def failure_words(study: Study, target: Target) -> list[str]:
    """The most frequent failure of a search, if there is one; or what it left out."""
    each = study.failures()
    if each and study.about.get("reduce") == SURVIVORS:
        return [f"left out: {reason} ({times} colonies)" for reason, times in each[:3]]
    lines = [f"most frequent failure: {reason} ({times} colonies)" for reason, times in each[:1]]
    return lines + extinct_words(target, [reason for reason, _ in each])


def cost_words(study: Study) -> str:
    """What a search took, and how many colonies failed."""
    failed = f", {study.failed} failed" if study.failed else ""
    return f"{study.colonies:.0f} colonies in {study.time}{failed}"


def parameter_rows(
    space: Space, first: Mapping[str, Value], best: Mapping[str, Value]
) -> list[tuple[str, ...]]:
    """For each parameter its name, its bounds, its first and its best value, and whether that lies
    at a bound."""
    return [
        (
            p.name,
            _bounds(p),
            show_value(first[p.name]),
            show_value(best[p.name]),
            at_bound(p, best[p.name]),
        )
        for p in space.parameters
    ]


def fresh_words(task: Task, fresh: FreshLosses) -> str:
    """The loss on fresh seeds, with its band."""
    return f"{show_loss(fresh.loss)} ({_seeds(task, fresh)})"


def show_loss(loss: float) -> str:
    """Four decimals, but of what is as large as the loss of a failed colony."""
    if math.isinf(loss):
        return "∞" if loss > 0 else "−∞"
    # without the sign of what rounds to 0
    return f"{round(loss, 4) + 0.0:.4f}" if abs(loss) < LARGE else f"{loss:.4g}"


def _seeds(task: Task, fresh: FreshLosses) -> str:
    seeds = len(fresh.losses)
    if task.worst:  # no band tells what lies beyond the worst of some seeds; their order does
        return f"the worst of {seeds} seeds; 1 new seed in {seeds + 1} is worse"
    failed = fresh.losses >= task.target.failed
    if failed.any() and fresh.loss >= LARGE:  # a mean with failures says nothing of the others
        others = show_loss(float(fresh.losses[~failed].mean())) if not failed.all() else "none"
        return f"{failed.sum()} of {seeds} seeds failed; the mean of the others: {others}"
    if (missed := misses_constraints(task.target, fresh.losses)).any():
        return f"on {missed.sum()} of {seeds} seeds"
    low, high = fresh.band
    by = ", which chose it" if fresh.chosen else ""
    if failed.any():
        each = f"each counts {show_loss(task.target.failed)}"
        each = "left out" if task.reduce == SURVIVORS else each
        by += f"; {failed.sum()} of them failed, {each}"
    if math.isinf(high):
        by += f"; an upper end takes {seeds_of_an_end(task)}"
    return f"{show_loss(low)} … {show_loss(high)}, {seeds} seeds{by}"


def _loss_title(report: SearchReport) -> str:
    return "sum of goals" if report.task.goals else "loss"


def _goals(report: SearchReport) -> list[tuple[str, ...]]:
    """A row for each of several goals: its mean over the replicates."""
    target = report.task.target
    if not isinstance(target, Goals):
        return []
    each = [
        torch.cat([target.losses(part.state, part.history) for part in design.colonies]).mean(0)
        for design in (report.first, report.best)
        if design.colonies
    ]
    return [
        (title, "", *(f"{float(found[k]):.4f}" for found in each), "")
        for k, title in enumerate(target.titles)
        if len(each) == 2
    ]


def _warnings(report: SearchReport) -> list[str]:
    """The losses of trivial answers, and what they and the bounds say of the best design."""
    best, space, target = report.best, report.task.space, report.task.target
    answers, lines = trivial_answers(report), []
    if missed := _missed(report):
        lines, answers = [missed], {}
    elif same := _same_losses(report):
        return [same]
    if answers:
        shown = lambda x: shown_loss(target, x).removeprefix("loss ")
        each = ", ".join(f"{n} {shown(x)}" for n, x in answers.items())
        lines = [f"without a pattern: {each}"]
    least = best_trivial(target, answers)
    loss = best.loss if best.fresh is None else best.fresh.loss  # that of the search is luck, too
    if least and loss >= answers[least]:
        lines.append(f"the best design is no better than {least!r}: it has found no pattern.")
    elif least and loss > SUCCESS * answers[least]:
        lines.append(
            f"the pattern is weak: the best design has {loss / answers[least]:.2f} of the loss"
            f" of {least!r}, and a good one {SUCCESS:g} or less. Simulate more colonies, free more"
            " parameters, or grow larger colonies."
        )
    if best.loss > FITS and (words := _misses(target, best)):
        lines.append(words)
    if not report.task.goals and report.first.loss < best.loss:
        lines.append(
            "the first guess has a smaller loss on the seeds of the search. If the search did not"
            " grow it to full size, begin another one with it: start=."
        )
    if lucky := _lucky(report) or _untested(report):
        lines.append(lucky)
    bound = [p.name for p in space.parameters if at_bound(p, best.values[p.name])]
    if bound:
        lines.append(f"at a bound: {', '.join(bound)}; better values may lie beyond it.")
    return lines


def _same_losses(report: SearchReport) -> str:
    """That no parameter made a difference; else ""."""
    each = [e.losses.reshape(len(e.losses), -1) for e in report.study.entries if e.size == 1]
    seeds = max((x.shape[1] for x in each), default=0)  # some designs may have fewer
    by_seed = [np.concatenate([x[:, k] for x in each if x.shape[1] > k]) for k in range(seeds)]
    every = by_seed[0] if by_seed else np.zeros(0)
    failed = report.task.target.failed
    if report.task.goals or len(every) < ALIKE or max(x.max() for x in by_seed) >= failed:
        return ""
    if any(np.ptp(x) > DIFFERENT * np.abs(x).max() for x in by_seed):
        return ""
    names = " or ".join(report.task.space.names)
    return (
        f"all {len(every)} designs have the same loss, {show_loss(report.best.loss)}: nothing that"
        f" the target reads ({', '.join(report.task.target.names) or 'cells'}) depends on {names}."
    )


def _lucky(report: SearchReport) -> str:
    """That the seeds of the search gave a smaller loss than others would; else "". Means are
    compared: the worst of many colonies is worse than that of a few."""
    best, fresh = report.best, report.best.fresh
    if fresh is None:
        return ""
    here, there, low = best.loss, fresh.loss, fresh.band[0]
    if report.task.reduce not in ("mean", SURVIVORS):
        here, there = float(np.mean(best.losses)), float(np.mean(fresh.losses))
        low = there - SPREADS * float(np.std(fresh.losses)) / math.sqrt(len(fresh.losses))
    if not here < low - (1 - LUCKY) * abs(low):
        return ""
    return (
        f"the {report.task.replicates} seeds of the search were lucky: {here:.4f} there,"
        f" {there:.4f} on fresh ones. Such losses mislead a search; give it more replicates."
    )


def _untested(report: SearchReport) -> str:
    """That the loss is the lowest of several that may differ by chance; else ""."""
    best, found, failed = report.best, report.study.best(), report.task.target.failed
    if best.fresh is not None or report.task.goals or found is None:
        return ""
    if not best.loss <= min(found[1], failed * (1 - 1e-9)):
        return ""
    full = report.study.full()
    several = sum(len(e.losses) for e in full) > 1
    chance = any(
        e.replicates == 1 or (np.ptp(e.losses, axis=1) > DIFFERENT * np.abs(e.losses).max()).any()
        for e in full
    )
    if not (several and chance):
        return ""
    return (
        "not tested on fresh seeds: where seeds matter, the lowest of several losses is low partly"
        " by luck."
    )


def best_trivial(target: Target, answers: Mapping[str, float]) -> str:
    """The trivial answer with the lowest loss; "" where there is none. Where it does not matter
    which cells are lit, every second one lit is not trivial."""
    rivals = [n for n in answers if not (target.anywhere and n == EVERY_SECOND)]
    return min(rivals, key=lambda n: answers[n], default="")


def _missed(report: SearchReport) -> str:
    """Which constraints colonies of the best design break."""
    target, best = report.task.target, report.best
    losses = best.losses if best.fresh is None else best.fresh.losses
    if (
        not constrained(target)
        or not best.colonies
        or not misses_constraints(target, np.max(losses))
    ):
        return ""
    found = each_measured(target, best.colonies)
    broken = {n: b for n, b in target.bounds.items() if _breaks(b, found[n])} or target.bounds
    each = ", ".join(f"{n} {b}: it has {show_value(_mean(found[n]))}" for n, b in broken.items())
    return (
        f"the best design misses constraints ({each} in the mean). Simulate more colonies, free"
        " more parameters, or loosen the constraints."
    )


def _breaks(bound: str, found: Sequence[float]) -> bool:
    """Whether a colony's measure is beyond a bound, such as "≥ 10", or undefined."""
    known = re.findall(r"([≥≤]) (\S+?)(?:,|$)", bound)
    held = {"≥": lambda x, most: x >= most, "≤": lambda x, most: x <= most}
    return not all(held[sign](x, float(number)) for sign, number in known for x in found)


def misses_constraints(target: Target, loss: np.ndarray | float) -> np.ndarray:
    """Whether losses are those of designs that miss constraints, in some colonies at least."""
    return np.logical_and(constrained(target), np.asarray(loss) >= Constrained.BROKEN / MANY)


def shown_loss(target: Target, loss: float) -> str:
    """A loss as a report shows it."""
    return MISSES if misses_constraints(target, loss) else f"loss {loss:.3f}"


def trivial_answers(report: SearchReport) -> dict[str, float]:
    """The losses of trivial answers in the colonies of the best design. A sum of goals compares
    nothing; data, and a target without species, have none. Of targets with constraints the goal
    counts: losses of the others do not."""
    target, colonies = report.task.target, report.best.colonies
    goal = target
    while isinstance(goal, (Constrained, Lasting)):
        goal = goal.target
    compared = goal.names and goal.pattern and not report.task.goals and colonies
    return trivial_losses(target, colonies, report.task.reduced) if compared else {}


def _undefined(target: Target, found: Mapping[str, list[float]]) -> list[str]:
    """Why measures are undefined in some colonies."""
    reasons = {n: target.why_undefined(n) for n, v in found.items() if np.isnan(v).any()}
    return [f"{name} is undefined: {why}." for name, why in reasons.items() if why]


def _misses(target: Target, best: ReportedDesign) -> str:
    """What a design that is unlike the data, or what was wanted, misses most; "" where the target
    has no spreads."""
    apart = target.misses(measured(target, best.colonies))
    worst = sorted((n for n in apart if apart[n] > 1), key=lambda n: -apart[n])[:WORST]
    if not worst:
        return ""
    words = ", ".join(f"{n} by {apart[n]:.1f} spreads" for n in worst)
    like = (
        "a colony is farther from a mean over several than the error of that mean, so that losses"
        " are above 1 also where the mean fits; give the numbers of each colony"
        " (Measured.of_colonies, or values by time and colony). "
        if has_mean_with_error(target)
        else "colonies that grew as the observed ones did have a loss of about 1 where many were"
        " observed (of n some (1 + 1/n)(n − 1)/(n − 3): 2.4 of five, 4 or more of one or two, which"
        " do not tell how much colonies differ). "
    )
    return (
        f"{like if target.evidence else ''}The best design is off most in {words}. Search longer,"
        " free more parameters, or change the model."
    )


def at_bound(parameter: Parameter | Choice, value: Value) -> str:
    """Where a number lies on a bound of its own: within NEAR of its range."""
    if isinstance(parameter, Choice) or parameter.whole:
        return ""
    place = parameter.coordinate(value)
    return (
        "at its lower bound" if place < NEAR else "at its upper bound" if place > 1 - NEAR else ""
    )


def cells_in(finished: list[FinishedColonies]) -> str:
    """The numbers of cells of some colonies."""
    counts = [n for part in finished for n in part.state.counts.tolist()]
    if not counts:
        return "none"
    return f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)}–{max(counts)}"


def _mean(values: list[float]) -> float:
    """Of the colonies that have a measure; NaN where none has."""
    return float(np.nanmean(values)) if not np.isnan(values).all() else float("nan")


def _spread(values: list[float]) -> str:
    """The standard deviation of a measure between colonies, and how many have it."""
    some = np.array([x for x in values if np.isfinite(x)])
    spread = f"sd {float(some.std(ddof=1)):.2g}" if len(some) > 1 else ""
    missing = sum(np.isnan(x) for x in values)
    return spread + (f" (undefined in {missing} of {len(values)})" if missing else "")


def _bounds(parameter: Parameter | Choice) -> str:
    if isinstance(parameter, Parameter):
        return f"{parameter.low:g} … {parameter.high:g}"
    return " | ".join(map(str, parameter.options))


def each_measured(target: Target, finished: Iterable[FinishedColonies]) -> dict[str, list[float]]:
    """The measures of a target, of each colony."""
    found: dict[str, list[float]] = {}
    for part in finished:
        for name, value in target.measures(part.state, part.history).items():
            mine = target.concerns(name, part.state)
            found.setdefault(name, []).extend(value.double()[mine].tolist())
    return found


def measured(target: Target, finished: Iterable[FinishedColonies]) -> dict[str, float]:
    """The mean of each measure of a target over the colonies that have it; NaN where none has."""
    return {name: _mean(v) for name, v in each_measured(target, finished).items()}
