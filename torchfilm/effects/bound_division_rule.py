"""The part of rules that acts at division: the user's `divide`, bound to a batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm.effect import Binding
from torchfilm.effects.bound_rules import BoundRule, act, label_of, own_draws, reported, where
from torchfilm.rule_views import MEANS, DivisionView
from torchfilm.state import Births, Field, State
from torchfilm.tools.hot_reload import HotReload

if TYPE_CHECKING:
    from torchfilm.effects.rules import Rules


class DivisionRule(BoundRule):
    """The part of Rules after division: the user's `divide(parent, daughter1, daughter2)`."""

    def __init__(self, effect: Rules, binding: Binding, source: HotReload):
        super().__init__(effect, binding, source)
        self.stage, self.title = binding.division_stage + 1, "rules at division"

    def declares(self) -> list[Field]:
        return []

    def reads(self) -> tuple[str, ...]:
        return ("cells", *self.traced_reads)

    def trace(self, state: State) -> State:
        """Calls `divide` on a first cell and two copies of it, and notes its reads and writes."""
        divide = self.source.functions["divide"]
        if divide is None or not state.cells:
            return state
        one = torch.zeros(1, dtype=torch.int64, device=state.device)
        twice = state.take(torch.cat([one, one]))
        births = Births(one, one + 1, torch.cat([one, one]), twice.length, state, one)
        with own_draws(label_of(divide)):
            views = _after_divide(divide, self, twice, births)
        self.traced_reads = tuple(sorted(_read(views)))
        self.traced_writes = tuple(sorted(_written_in_daughters(views, in_place=True)))
        return state

    def step(self, state: State, dt: float) -> State:
        for births in state.births:
            made = partial(self._divide, state=state, births=births)
            state = self.source.call("divide", made, state)
        return state

    def _divide(self, divide: Callable[..., None], state: State, births: Births) -> State:
        views = _after_divide(divide, self, state, births)
        daughters = views[1:]
        # as in `_apply`, what is changed in place is compared only after an edit
        written = _written_in_daughters(views, in_place=not self.source.proven)
        self._check_written(_read(views), written)
        old, seen = state.fields, state
        changed: dict[str, Tensor] = {}
        for daughter, rows in zip(daughters, (births.first, births.second), strict=True):
            given = {n: v for n, v in daughter._work.items() if daughter._writable(n)}
            seen = self._with_report(seen, rows, given)
            for name, value in given.items():
                changed[name] = changed.get(name, old[name]).index_copy(0, rows, value)
        if seen is not state:
            kept = reported(seen)
            changed = {n: where(kept, old[n], v) for n, v in changed.items()}
        return self.given(seen, changed)

    def numerics(self, dt: float, state: State) -> list[str]:
        return ["your own Python, once for all divisions of a step"]


def _written_in_daughters(views: Sequence[DivisionView], in_place: bool) -> set[str]:
    """What a rule wrote in the daughters, by setting it or, if asked, in place."""
    written: set[str] = set()
    for daughter in views[1:]:
        written |= daughter._set | (daughter.changed_in_place() if in_place else set())
    return written


def _read(views: Sequence[DivisionView]) -> set[str]:
    """The fields that a rule at division has read of parents and daughters."""
    return {m for view in views for n in view._work for m in MEANS.get(n, (n,))}


def _after_divide(
    divide: Callable[..., None], rule: DivisionRule, state: State, births: Births
) -> tuple[DivisionView, DivisionView, DivisionView]:
    """The views of parent, first and second daughter, after the rule."""
    label = rule.label(divide, "divide")

    def view(state: State, rows: Tensor | None, called: str, which: str) -> DivisionView:
        purpose = f"{label} divide {which}"
        return DivisionView(state, rows, called, purpose, rule.constants(state, rows))

    views = (
        view(births.parents, None, "parent", "parent"),
        view(state, births.first, "daughter1", "first"),
        view(state, births.second, "daughter2", "second"),
    )
    act(divide, *views)
    return views
