"""Random numbers for rules: keyed by seed, colony, cell and step, so that the same seed gives the
same bits whatever the batch."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits.draws import poisson
from torchfilm.circuits.molecules import nearest
from torchfilm.circuits.partition import binomial
from torchfilm.rule_values import RuleError, as_tensor
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.random import MASK, fine_uniform, uniform
from torchfilm.tools.row_checks import check_rows, out_of_range


class Draws:
    """What cells and divisions that rules see can draw. Each call gives new numbers."""

    _state: State
    _rows: Tensor | None
    _draws: int
    _purpose: str
    # in a trial: what was given to chance, event, poisson and binomial, by the words for it
    _asked: dict[str, Tensor] | None = None

    def random(self) -> Tensor:
        """A draw from (0, 1) for each cell, (N,), or each division, (M,), keyed by seed, colony,
        cell and step. It does not depend on the batch."""
        return self._state.uniform(*self._next())

    def normal(self) -> Tensor:
        """A standard normal draw for each cell, (N,), or each division, (M,), of mean 0 and
        standard deviation 1. A rate that daughters inherit with a change of about a tenth, say:
        daughter1.rate = parent.rate * torch.exp(0.1 * daughter1.normal())."""
        return self._state.normal(*self._next())[:, 0]

    def _next(self) -> tuple[Tensor, str]:
        """The rows that draw, and the purpose of the next draw."""
        self.__dict__["_draws"] += 1
        every = torch.arange(self._state.cells, device=self._state.device)
        return every if self._rows is None else self._rows, f"{self._purpose} {self._draws}"

    def chance(self, probability: float | Tensor) -> Tensor:
        """Whether something of this probability happens to each cell, (N,), or at each division,
        (M,), bool. Of what happens at a rate, `cells.event(rate)` knows whether it does."""
        fine = self._fine()
        return fine < self._noted("chance", _probability("chance", probability, fine))

    def poisson(self, mean: float | Tensor) -> Tensor:
        """How many independent events happen of which this `mean` is expected: one draw for each
        cell, (N,), or each division, (M,). New mutations, say, at a rate of 0.003 per hour:
        cells.mutations = cells.mutations + cells.poisson(0.003 * cells.dt)."""
        fine = self._fine()
        each = self._noted("poisson", _at_least_zero("poisson", "mean", mean, fine))
        return poisson(each, fine).to(self._state.dtype)

    def _noted(self, draw: str, given: Tensor) -> Tensor:
        if self._asked is not None:
            self._asked[f"what it gives to {draw}, draw {len(self._asked) + 1}"] = given
        return given

    def _fine(self) -> Tensor:
        return fine_uniform(self.random(), self.random())

    def binomial(self, number: float | Tensor, probability: float | Tensor) -> Tensor:
        """How many of a `number` come out right, each with this probability: one draw for each
        cell, (N,), or each division, (M,). Plasmids, say, that go to the first daughter:
        k = parent.binomial(parent.plasmids, 0.5)."""
        drawn = self._fine()
        given = _column("binomial", number, drawn)
        # of molecules: a concentration times a volume
        count, off = nearest(given, self._state.dtype)
        wrong = given[~((count >= 0) & ~off & count.isfinite())]
        if wrong.numel():
            raise RuleError(
                f"binomial was given the number {float(wrong[0])}: it must be whole, 0 or more"
            )
        each = self._noted("binomial", _probability("binomial", probability, drawn))
        return binomial(self._noted("binomial", count), each, drawn).to(self._state.dtype)


class StepDraws(Draws):
    """What cells draw in a step."""

    _dt: float

    def every(self, hours: float) -> bool:
        """Whether a multiple of so many hours lies in this step, from its beginning on, and before
        its end. Raises InputError for less than a step."""
        if self._asked is not None:  # a trial, whose step is none of the scene's
            return checks.number("cells.every(hours)", hours, above=0.0) > 0.0
        hours = checks.number("cells.every(hours)", hours, least=self._dt * (1.0 - 1e-6))
        begin = self._state.time - 1e-6 * self._dt  # times are rounded
        return math.ceil(begin / hours) * hours < begin + self._dt

    def event(self, rate: float | Tensor) -> Tensor:
        """Whether what happens at this rate, 1/h, does so in this step, to each cell, (N,) bool: of
        the probability 1 − exp(−rate · dt)."""
        fine = self._fine()
        each = self._noted("event", _at_least_zero("event", "rate", rate, fine))
        return fine < -torch.expm1(-each * self._dt)

    def contact_random(self, i: Tensor, j: Tensor) -> Tensor:
        """A draw from (0, 1) for each pair of cells, (P,) float64, keyed by both of them in this
        order, beside seed, colony and step: `cells.contact_random(i, j) < probability`. The draws
        of `random` and its like are one for each cell, so that all pairs of a cell share them."""
        state = self._state
        for name, rows in ("contact_random(i)", i), ("contact_random(j)", j):
            check_rows(name, rows, state.cells)
        if i.dim() != 1 or i.shape != j.shape:
            raise RuleError(
                f"contact_random was given places of the shapes {tuple(i.shape)} and"
                f" {tuple(j.shape)}: it takes pairs, (P,) each"
            )
        _, purpose = self._next()
        try:
            one, other = (state.uid.index_select(0, rows) & MASK for rows in (i, j))
        except (IndexError, RuntimeError) as error:
            raise out_of_range("contact_random(i, j)", torch.stack([i, j]), state.cells) from error
        uid = one | (other << 32)
        stream = state.stream.index_select(0, state.colony.index_select(0, i))
        key = state.seed, stream, uid, state.step
        coarse, fine = (uniform(*key, f"{purpose} pair {k}", torch.float64) for k in (0, 1))
        return fine_uniform(coarse, fine)


class OneCell(StepDraws):
    """What a loop over cells draws for one of them: its numbers do not depend on the others."""

    def __init__(self, cells: StepDraws, index: int):
        self._state, self._draws, self._purpose = cells._state, 0, f"{cells._purpose} one by one"
        self._dt = cells._dt
        self._rows = torch.tensor([index], device=cells._state.device)


def _column(what: str, value: Any, like: Tensor) -> Tensor:
    given = as_tensor(what, value, like.device).detach().to(like.dtype)
    if given.shape not in ((), like.shape):
        raise RuleError(
            f"{what} was given a tensor of shape {tuple(given.shape)}: it must be one value, or"
            f" {tuple(like.shape)}."
        )
    return given.expand(like.shape)


def _at_least_zero(what: str, noun: str, value: Any, like: Tensor) -> Tensor:
    given = _column(what, value, like)
    wrong = ~((given >= 0) & given.isfinite())
    if bool(wrong.any()):
        raise RuleError(
            f"{what} was given the {noun} {given[wrong][0]:g}: it must be finite, and 0 or more"
        )
    return given


def _probability(what: str, value: Any, like: Tensor) -> Tensor:
    given = _column(what, value, like)
    wrong = ~((given >= 0) & (given <= 1))
    if bool(wrong.any()):
        raise RuleError(
            f"{what} was given the probability {given[wrong][0]:g}: it must be between 0 and 1"
        )
    return given
