"""Stochastic reactions: Gillespie's direct method, and tau-leaping with a safe step for each cell.

Tau-leaping follows Cao, Gillespie and Petzold, J. Chem. Phys. 124, 044109 (2006). A step changes no
propensity by more than about ε of it. A reaction that could use up a reactant within few events is
critical, and fires at most once per step. Where steps would have few events, the direct method is
used. Cells that have reached the end leave the batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfilm.circuits.draws import Draw, poisson

# propensities(counts, rows): events per hour (M, R) of the cells `rows` (M,) with molecule numbers
# counts (M, S)
Propensities = Callable[[Tensor, Tensor], Tensor]

DONE, TOO_MANY_EVENTS, BAD_PROPENSITY = 0, 1, 2
STATUS = {
    DONE: "done",
    TOO_MANY_EVENTS: "too many events",
    BAD_PROPENSITY: "a propensity that is negative or not a finite number",
}
FEW_EVENTS = 10.0  # a leap with fewer events costs more than single events
MAX_LEAP_HALVINGS = 60
# A leap changes no propensity by more than about EPSILON of it. A reaction that could fire fewer
# than CRITICAL times fires alone.
EPSILON, CRITICAL = 0.03, 10
MOST_LEAPS, MOST_EVENTS = 100_000, 1_000_000


@dataclass(frozen=True)
class StochasticReport:
    """What the method did for each cell; every field is (N,) int64.

    steps: leaps and single events. status: one of STATUS. reaction: the index of the reaction that
    failed, −1 for none.
    """

    steps: Tensor
    status: Tensor
    reaction: Tensor


def tau_leap(
    counts: Tensor,
    propensities: Propensities,
    stoichiometry: Tensor,
    dt: float,
    draw: Draw,
    *,
    epsilon: float = EPSILON,
    critical: int = CRITICAL,
    orders: Tensor | None = None,
    max_steps: int = MOST_LEAPS,
) -> tuple[Tensor, StochasticReport]:
    """Molecule numbers (N, S) after dt hours by tau-leaping, or single events if they cost less.

    A reaction must be limited by a species that it consumes. So a gene that switches from "off" to
    "on" is two species, on and off; otherwise a leap could switch it on twice.

    stoichiometry: (R, S), molecules gained by each event. draw: see `draws.KeyedDraws`. epsilon:
    the relative change of a propensity that a leap may cause. critical: a reaction that could fire
    fewer times than this fires alone. orders: (S,), the highest order in which a propensity depends
    on each species, 0 for none; default 2. Numbers stay integer (a fractional part in the input
    stays) and never negative. Not differentiable. Raises nothing; failures are in the report.
    """
    run = _Simulator(propensities, stoichiometry, draw, counts)
    leap = _Leap(run, epsilon, critical, orders)
    return run.advance(counts, dt, leap.step, max_steps)


def direct(
    counts: Tensor,
    propensities: Propensities,
    stoichiometry: Tensor,
    dt: float,
    draw: Draw,
    *,
    max_steps: int = MOST_EVENTS,
) -> tuple[Tensor, StochasticReport]:
    """Molecule numbers (N, S) after dt hours, event by event: exact, for all cells in parallel.

    The arguments are those of `tau_leap`.
    """
    run = _Simulator(propensities, stoichiometry, draw, counts)
    return run.advance(counts, dt, run.single, max_steps)


def _total(parts: Tensor) -> Tensor:
    """Sum over the first axis in its order, (R, M) -> (M,).

    The fixed order makes the bits independent of M.
    """
    out = parts[0].clone()
    for k in range(1, parts.shape[0]):
        out += parts[k]
    return out


def _choose(parts: Tensor, u: Tensor) -> Tensor:
    """The index of one of R, chosen in proportion to parts (R, M) ≥ 0: (M,) int64.

    A part of 0 is never chosen unless all are 0.
    """
    bounds = parts.clone()
    for k in range(1, parts.shape[0]):
        bounds[k] += bounds[k - 1]
    aim = (u * bounds[-1]).unsqueeze(0)
    # u ≤ 1 − 2⁻⁵³, so that u times a sum above 0 is rounded to less than the sum
    return (bounds <= aim).sum(0).clamp(max=parts.shape[0] - 1)


class _Simulator:
    """The parts that both methods share.

    Its arrays are float64 with cells last: counts (S, M), propensities (R, M).
    """

    def __init__(
        self, propensities: Propensities, stoichiometry: Tensor, draw: Draw, counts: Tensor
    ):
        self.propensities, self.draw, self.dtype = propensities, draw, counts.dtype
        self.gain = stoichiometry.to(device=counts.device, dtype=torch.float64)
        self.taken = (-self.gain).clamp(min=0.0)
        self.takers = torch.nonzero((self.taken > 0).any(1)).squeeze(1).tolist()

    def rates(self, x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Propensities (R, M), 0 where an event needs more molecules than there are.

        Also the first invalid propensity of each cell, or −1.
        """
        a = self.propensities(x.to(self.dtype).t(), rows).t().to(torch.float64).contiguous()
        good = (a >= 0) & (a < torch.inf)
        bad = torch.where(good.all(0), -1, good.to(torch.uint8).argmin(0))
        a = torch.where(good, a, 0.0)
        whole = x.floor()
        for j in self.takers:
            enough = (whole >= self.taken[j].unsqueeze(1)).all(0)
            a[j] = torch.where(enough, a[j], 0.0)
        return a, bad

    def fire(self, x: Tensor, events: Tensor) -> Tensor:
        """Molecule numbers after `events` (R, M) of each reaction."""
        for j in range(events.shape[0]):
            x = torch.addcmul(x, self.gain[j].unsqueeze(1), events[j].unsqueeze(0))
        return x

    def after_one(self, x: Tensor, which: Tensor) -> Tensor:
        """Molecule numbers after one event of the reaction `which` (M,)."""
        return x + self.gain.index_select(0, which).t()

    def single(
        self, x: Tensor, a: Tensor, left: Tensor, rows: Tensor, event: int
    ) -> tuple[Tensor, Tensor]:
        """One event, or the end if the event would come after it.

        Returns molecule numbers and the time that passed.
        """
        u = self.draw(rows, event, "single", 2)
        wait = -torch.log(u[0]) / _total(a)  # infinite where no reaction can fire
        happens = wait < left
        return torch.where(happens, self.after_one(x, _choose(a, u[1])), x), torch.where(
            happens, wait, left
        )

    @torch.no_grad()
    def advance(
        self, counts: Tensor, dt: float, step: Callable[..., tuple[Tensor, Tensor]], most: int
    ) -> tuple[Tensor, StochasticReport]:
        """All cells to the end, each with its own steps.

        step: returns a cell's molecule numbers and the time that passed. most: the limit on steps.
        """
        cells = counts.shape[0]
        rows = torch.arange(cells, device=counts.device)
        steps, status, wrong = (
            torch.zeros_like(rows),
            torch.full_like(rows, TOO_MANY_EVENTS),
            torch.full_like(rows, -1),
        )
        x, left = (
            counts.t().to(torch.float64).contiguous(),
            torch.full((cells,), float(dt), dtype=torch.float64, device=counts.device),
        )
        out = counts.clone()
        for event in range(most):
            if rows.numel() == 0:
                break
            a, bad = self.rates(x, rows)
            faulty = bad >= 0
            after, passed = step(x, a, left, rows, event)
            x = torch.where(faulty, x, after)
            steps.index_add_(0, rows, (~faulty).long())
            left = left - passed
            ends = faulty | (left <= 0)
            if not bool(ends.any()):
                continue
            gone, stay = torch.nonzero(ends).squeeze(1), torch.nonzero(~ends).squeeze(1)
            who = rows.index_select(0, gone)
            out.index_copy_(0, who, x.index_select(1, gone).t().to(self.dtype))
            status.index_copy_(
                0, who, torch.where(faulty, BAD_PROPENSITY, DONE).index_select(0, gone)
            )
            wrong.index_copy_(0, who, bad.index_select(0, gone))
            rows, x, left = (
                rows.index_select(0, stay),
                x.index_select(1, stay),
                left.index_select(0, stay),
            )
        out.index_copy_(0, rows, x.t().to(self.dtype))
        return out, StochasticReport(steps, status, wrong)


class _Leap:
    """The leaps of `tau_leap`."""

    def __init__(self, run: _Simulator, epsilon: float, critical: int, orders: Tensor | None):
        self.run, self.epsilon, self.critical = run, epsilon, critical
        order = torch.full_like(run.gain[0], 2.0) if orders is None else orders.to(run.gain)
        self.read, self.order = (order > 0).unsqueeze(1), order.clamp(min=1.0).unsqueeze(1)

    def rare(self, x: Tensor, a: Tensor) -> Tensor:
        """The critical reactions, (R, M).

        They can fire, but fewer than `critical` times before a reactant is used up.
        """
        out = torch.zeros_like(a, dtype=torch.bool)
        whole = x.floor()
        for j in self.run.takers:
            taken = self.run.taken[j].unsqueeze(1)
            out[j] = ((taken > 0) & (whole < self.critical * taken)).any(0)
        return out & (a > 0)

    def longest(self, x: Tensor, a: Tensor) -> Tensor:
        """The time in which no propensity is expected to change by more than ε of it, and no
        species loses more than ε of its molecules, (M,).

        a: (R, M), the propensities of the reactions that may leap. At rest gain and loss cancel in
        the mean. Leaps that only their noise limits would grow with the molecule numbers, over
        times in which molecules are replaced: an explicit leap of τ with the loss d spreads a
        species at rest by 1/(1 − dτ/2).
        """
        mean, spread, lost = (torch.zeros_like(x) for _ in range(3))
        for j in range(a.shape[0]):
            gain = self.run.gain[j].unsqueeze(1)
            mean = torch.addcmul(mean, gain, a[j].unsqueeze(0))
            lost = torch.addcmul(lost, -gain.clamp(max=0.0), a[j].unsqueeze(0))
            spread = torch.addcmul(spread, gain * gain, a[j].unsqueeze(0))
        # the paper's g is the order, plus a term where few molecules of one kind react with each
        # other: 2 + 1/(x − 1) for a pair
        steep = self.order + torch.where(
            self.order > 1, (self.order - 1) / (x - 1).clamp(min=1.0), 0.0
        )
        change = (self.epsilon * x / steep).clamp(min=1.0)
        drift = torch.maximum(mean.abs(), lost)
        time = torch.minimum(change / drift, change * change / spread)
        return torch.where(self.read & (spread > 0), time, torch.inf).amin(0)

    def step(
        self, x: Tensor, a: Tensor, left: Tensor, rows: Tensor, event: int
    ) -> tuple[Tensor, Tensor]:
        """One leap or one event; returns molecule numbers and the time that passed."""
        rare = self.rare(x, a)
        frequent, critical = torch.where(rare, 0.0, a), torch.where(rare, a, 0.0)
        longest = self.longest(x, frequent)
        total = _total(a)
        leaps = torch.minimum(longest, left) * total >= FEW_EVENTS
        after, passed = x, left
        if not bool(leaps.all()):
            after, passed = self.run.single(x, a, left, rows, event)
        at = torch.nonzero(leaps).squeeze(1)
        if at.numel() == 0:
            return after, passed
        pick = lambda v: v.index_select(-1, at)
        jumped, took = self.leap(
            pick(x),
            pick(frequent),
            pick(critical),
            pick(longest),
            pick(left),
            rows.index_select(0, at),
            event,
        )
        return after.index_copy(1, at, jumped), passed.index_copy(0, at, took)

    def leap(
        self,
        x: Tensor,
        frequent: Tensor,
        critical: Tensor,
        longest: Tensor,
        left: Tensor,
        rows: Tensor,
        event: int,
    ) -> tuple[Tensor, Tensor]:
        """Poisson numbers of the frequent reactions, and at most one event of the critical ones.

        The leap is halved where molecule numbers would become negative.
        """
        size = frequent.shape[0]
        u = self.run.draw(rows, event, "rare", 2)
        until_rare = -torch.log(u[0]) / _total(critical)
        which = _choose(critical, u[1])
        after, took = x, left
        open_ = torch.arange(rows.numel(), device=rows.device)
        for trial in range(MAX_LEAP_HALVINGS):
            pick = lambda v: v.index_select(-1, open_)  # noqa: B023
            far = torch.minimum(pick(longest), pick(left)) * 0.5**trial
            wait = pick(until_rare)
            fires = wait < far
            time = torch.minimum(far, wait)
            uniform = self.run.draw(rows.index_select(0, open_), event, f"leap {trial}", size)
            ahead = self.run.fire(pick(x), poisson(pick(frequent) * time, uniform))
            ahead = torch.where(fires, self.run.after_one(ahead, pick(which)), ahead)
            good = (ahead >= 0).all(0)
            done = torch.nonzero(good).squeeze(1)
            to = open_.index_select(0, done)
            after = after.index_copy(1, to, ahead.index_select(1, done))
            took = took.index_copy(0, to, time.index_select(0, done))
            open_ = open_.index_select(0, torch.nonzero(~good).squeeze(1))
            if open_.numel() == 0:
                break
        # never observed: after 60 halvings almost no event remains
        return after, took.index_fill(0, open_, 0.0)
