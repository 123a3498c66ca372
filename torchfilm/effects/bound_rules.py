"""Rules bound to a batch: tried once, then called in each step, and what they write checked.

A value that no effect can use, such as a negative growth rate, fails its colony only. What cannot
be right in any colony, such as a wrong shape or an unknown name, is an error of the whole step.
"""

from __future__ import annotations

import random
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchfilm.cell_types import with_values_of_new_types
from torchfilm.circuits.names import Names
from torchfilm.effect import Binding, BoundEffect
from torchfilm.rule_values import RuleError, warn_of_mixing
from torchfilm.rule_views import KNOWN_FIELDS, CellsView, Constants, DivisionView
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.deterministic_math import deterministic_functions
from torchfilm.tools.hashing import module_of
from torchfilm.tools.hot_reload import HotReload
from torchfilm.tools.warn_once import warn

if TYPE_CHECKING:
    from torchfilm.effects.rules import Rules

ONE_NUMBER = (
    "a rule sees all cells at once, so `if` or `float` has no single value to use. Write"
    " torch.where(condition, a, b) with &, | and ~, or go through them one by one (slow): for cell"
    " in cells."
)
# what to do, by a part of torch's words
HINTS = {
    "Boolean value of Tensor": ONE_NUMBER,
    "converted to Scalar": ONE_NUMBER,
    "only one element tensors": ONE_NUMBER,
    "where() received": (
        "torch.where wants a column of cells as its condition. cells.time and cells.dt are"
        " plain numbers: write `a if cells.time > 1 else b`."
    ),
}
PACKAGE = str(Path(checks.__file__).parents[1])
TRIAL_STEP = 0.025  # h, the step that a rule sees in its trial
MEANING = "variable of the user's rules"


@dataclass(frozen=True)
class RulesReport:
    """Made only where a rule gave a value that no effect can use: `status` (B,), 1 for its colony,
    in which the rule changed nothing, and `words`, by place in the batch, what it gave."""

    status: Tensor
    words: Mapping[int, str]
    hint = "Let the rule give values that are allowed in every colony"

    def reason(self, place: int) -> str:
        """What the rule gave in the colony at this place of the batch."""
        return self.words[place]


class BoundRule(BoundEffect):
    """A function of the user, which may be edited during a run: what it reads and writes, and what
    the other effects of the scene allow it to write."""

    effect: Rules

    def __init__(self, effect: Rules, binding: Binding, source: HotReload):
        super().__init__(effect, binding)
        self.source = source
        self.traced_reads: tuple[str, ...] = ()
        self.traced_writes: tuple[str, ...] = ()
        self.others: Sequence[BoundEffect] = ()
        # what a NaN means in the user's own variables, only the user knows
        self.shared = {n for n, title in binding.declared.items() if title != effect.title}
        self.types: dict[str, tuple[int, ...]] = {}
        self.least_zero: set[str] = set()

    def writes(self) -> tuple[str, ...]:
        return self.traced_writes

    def constants(self, state: State, rows: Tensor | None = None) -> Constants:
        """What rules find as `p` of all cells, or of the cells `rows` (M,)."""
        names = tuple(self.effect.parameters)
        if not names:
            return None

        def find() -> Names:
            count = state.cells if rows is None else rows.numel()
            each = [
                value.of_cells(state) if rows is None else value.of_rows(state, rows)
                for value in (self.values[n] for n in names)
            ]
            columns = [x.expand(count).clone() for x in each]  # a rule may change them in place
            return Names(names, columns, "cells.p", "constants stay as they are")

        return find

    def check_others(self, effects: Sequence[BoundEffect]) -> None:
        self.others = effects
        self.types = {n: t for e in effects for n, t in e.typed_values().items()}
        self.least_zero = {n for e in effects for n in e.effect.at_least_zero()}

    def label(self, rule: Callable[..., None], name: str) -> str:
        """A label that gives this rule, the "update" or "divide" of its effect, random numbers of
        its own; also where functions of several Rules of the scene have one name."""
        label, alike = label_of(rule), 0
        for other in self.others:
            if other is self:
                break
            own = other.source.functions[name] if type(other) is type(self) else None
            alike += own is not None and label_of(own) == label
        return f"{label} {alike}" if alike else label

    def _check_written(self, read: Collection[str], written: Collection[str]) -> None:
        """Raise InputError, or warn, as at binding, where the function writes what it did not write
        before: after an edit, or in a branch that its trial did not take."""
        before = self.traced_reads, self.traced_writes
        if set(written) <= set(self.traced_writes):
            return
        self.traced_reads = tuple(sorted({*self.traced_reads, *read}))
        self.traced_writes = tuple(sorted({*self.traced_writes, *written}))
        try:
            for other in self.others:
                other.check_others(self.others)
            for other in self.others:
                other.warn_of_others()
        except Exception:
            self.traced_reads, self.traced_writes = before  # of the function that stays in use
            raise

    def given(self, state: State, changed: Mapping[str, Tensor]) -> State:
        """The state with what the rule gives. A cell that gets another type gets the values of that
        type, but where the rule changes them itself."""
        after = state.with_fields(**changed)
        if "cell_type" not in changed or not self.by_type:
            return after
        return with_values_of_new_types(state, after, self.by_type)

    # --- values --------------------------------------------------------------------------

    def _with_report(self, state: State, rows: Tensor | None, given: Mapping[str, Tensor]) -> State:
        """The state with a report of those values that no effect can use, given to the cells `rows`
        (M,), or to all cells; the state itself where there is no such value."""
        each = {n: self._unusable(n, value.detach()) for n, value in given.items()}
        marks = {n: found for n, found in each.items() if found is not None}
        if not marks or not bool(torch.stack(list(marks.values())).any()):
            return state
        words: dict[int, str] = {}
        for name, found in marks.items():
            before = state.fields[name]
            before = before if rows is None else before.index_select(0, rows)
            # what the rule has not changed is not its fault
            cells = torch.nonzero(found & _differ(before, given[name])).squeeze(1)
            own = cells if rows is None else rows.index_select(0, cells)
            owner = state.colony.index_select(0, own).tolist()
            for place in sorted(set(owner) - set(words)):
                mine = [k for k, o in enumerate(owner) if o == place]
                said = self._words(name, given[name].detach()[cells[mine[0]]])
                more = f"; and {len(mine) - 1} more cell(s)" if len(mine) > 1 else ""
                words[place] = f"cells.{name} of cell {int(state.uid[own[mine[0]]])} {said}{more}"
        if not words:
            return state
        if self.source.can_go_back:
            raise RuleError(
                "; ".join(f"colony {int(state.colony_id[k])}: {said}" for k, said in words.items())
            )
        earlier = state.reports.get(self.title)  # of the other daughters, or of other Rules
        words |= {} if earlier is None else earlier.words
        status = torch.zeros(state.colonies, dtype=torch.int64, device=state.device)
        status[list(words)] = 1
        return state.replace(reports={**state.reports, self.title: RulesReport(status, words)})

    def _unusable(self, name: str, value: Tensor) -> Tensor | None:
        """Which of these values (M, …) no effect can use, (M,) bool; None: all may be used."""
        if name in self.least_zero:
            return ~(value >= 0)
        if name == "drag":
            return ~(value > 0)
        if name == "cell_type":
            unknown = [~torch.isin(value, value.new_tensor(t)) for t in self.types.values()]
            return torch.stack([value < 0, *unknown]).any(0)
        if not value.is_floating_point() or name not in self.shared:
            return None
        return _of_rows(value.isnan())

    def _words(self, name: str, value: Tensor) -> str:
        """What is wrong with a value of this name, and what to do."""
        if name == "cell_type" and value >= 0:
            kind = int(value)
            lacking, types = next((n, t) for n, t in self.types.items() if kind not in t)
            return (
                f"was set to {kind}, but {lacking} has values for the cell types"
                f" {', '.join(map(str, types))}. Add {kind}: … to it"
            )
        allowed = {
            "growth_rate": "at least 0. To let cells vanish, set remove_flag",
            "drag": "above 0",
            "cell_type": "a whole number from 0",
        }.get(name, "at least 0" if name in self.least_zero and value < 0 else "a number")
        shown = f"{float(value):g}" if value.dim() == 0 else value.tolist()
        return f"was set to {shown}: it must be {allowed}"


def _differ(one: Tensor, other: Tensor) -> Tensor:
    """In which rows (N, …) two tensors differ, (N,) bool; NaN is equal to NaN."""
    return _of_rows(~((one == other) | (one.isnan() & other.isnan())))


def _of_rows(found: Tensor) -> Tensor:
    """Which rows (N, …) have any that is true, (N,) bool."""
    return found if found.dim() == 1 else found.flatten(1).any(1)


def reported(state: State) -> Tensor:
    """Which cells are in a colony that a rule has failed in this step, (N,) bool."""
    reports = [r for r in state.reports.values() if isinstance(r, RulesReport)]
    failed = torch.stack([r.status for r in reports]).amax(0) > 0
    return failed.index_select(0, state.colony)


class BoundRules(BoundRule):
    """`update` after its trial: what it reads and writes, and the variables that it adds."""

    def __init__(self, effect: Rules, binding: Binding, source: HotReload):
        super().__init__(effect, binding, source)
        self.variables: tuple[Field, ...] = ()

    @property
    def hot_reload(self) -> HotReload:
        """The functions, which the user may edit during a run."""
        return self.source

    def reads(self) -> tuple[str, ...]:
        return self.traced_reads

    def ready(self, state: State) -> State:
        for new in self.variables:
            if new.name not in state.fields:
                state = state.declare(new)
        return state

    def trace(self, state: State) -> State:
        """Calls `update` once. New names become fields; reads and writes are noted."""
        update = self.source.functions["update"]
        if update is None:
            return state
        # two cells, since rules such as `if cells.length > 3` fail only with more than one; a cell
        # that cannot divide stays alone
        twice = state.cells == 1 and "divide_flag" in state.fields
        both = torch.zeros(2, dtype=torch.int64, device=state.device)
        tried = state.take(both) if twice else state
        view = CellsView(
            tried, TRIAL_STEP, label_of(update), declaring=True, constants=self.constants(tried)
        )
        try:
            with own_draws(label_of(update)):
                act(update, view)
        except RuleError as error:
            if not twice or "shape" not in str(error):
                raise
            raise RuleError(
                f"{error} The rule is tried on two copies of the first cell."
            ) from error
        new = [n for n in view._work if n not in state.fields and n != "remove_flag"]
        self.variables = tuple(_variable(name, view._work[name]) for name in new)
        for variable in self.variables:
            tried = tried.declare(variable)
        self.traced_reads = tuple(sorted(view._read))
        self.traced_writes = tuple(_written(view, tried))
        state = self.ready(state)
        warn_of_mixing(label_of(update), partial(self._columns, update), state)
        return state

    def _columns(self, update: Callable[[CellsView], None], state: State) -> dict[str, Tensor]:
        """What a rule writes in a trial, and gives to what it draws, by the words for it."""
        constants = self.constants(state)
        view = CellsView(state, TRIAL_STEP, label_of(update), declaring=True, constants=constants)
        act(update, view)
        return {f"what it sets, {n}": x for n, x in view._work.items()} | (view._asked or {})

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        self.source.refresh(state.time)
        return self.source.call("update", partial(self._apply, state, dt), state)

    def _apply(self, state: State, dt: float, update: Callable[[CellsView], None]) -> State:
        label = self.label(update, "update")
        view = CellsView(state, dt, label, constants=self.constants(state))
        act(update, view)
        work = dict(view._work)
        gone = work.pop("remove_flag", None)
        for name in work:
            if name not in state.fields:
                if name not in KNOWN_FIELDS:
                    raise checks.SimulationError(
                        f"rules set the variable {name!r} for the first time during a run: give"
                        f" Rules(…, variables={{{name!r}: 0.0}})."
                    )
                state = state.declare(KNOWN_FIELDS[name])
        # what a rule changes in place is compared only where it may have come with an edit
        written = _effects(view._written) if self.source.proven else _written(view, state)
        self._check_written(view._read, written)
        seen = self._with_report(state, None, work)
        if seen is not state:
            state, kept = seen, reported(seen)
            work = {n: where(kept, state.fields[n], v) for n, v in work.items()}
            gone = None if gone is None else gone & ~kept
        state = self.given(state, work)
        return state if gone is None else state.remove(gone, "removed")


def _written(view: CellsView, state: State) -> list[str]:
    """What a rule wrote, by setting it or in place. state: with the fields of all that it set."""
    changed = {
        n
        for n, v in view._work.items()
        if n != "remove_flag" and not torch.equal(v, state.fields[n])
    }
    return _effects(view._written | changed)


def _effects(written: Collection[str]) -> list[str]:
    """What a rule that writes these names changes: cells that it flags are removed."""
    return ["cells" if n == "remove_flag" else n for n in sorted(written)]


def where(mask: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """As torch.where, for rows (N, …) by a mask (N,)."""
    return torch.where(mask.reshape(-1, *[1] * (one.dim() - 1)), one, other)


def _variable(name: str, value: Tensor) -> Field:
    """The field of a variable that a rule has set."""
    known = KNOWN_FIELDS.get(name)
    return known or Field(name, MEANING, dtype=value.dtype, shape=tuple(value.shape[1:]))


def label_of(rule: Callable[..., object]) -> str:
    """A label that gives each rule its own random numbers: the same in a script, where the script
    is imported, and in the processes that it starts."""
    return f"rule {module_of(rule)} {getattr(rule, '__qualname__', type(rule).__name__)}"


@contextmanager
def own_draws(label: str) -> Iterator[None]:
    """Warn of a rule that draws from generators which no seed of a run sets."""
    states = lambda: (torch.get_rng_state().tolist(), str(np.random.get_state()), random.getstate())  # noqa: NPY002
    before = states()
    yield
    if states() != before:
        warn(
            f"{label} draws random numbers with torch, numpy or random: another run with the same"
            " seed has other numbers. Use cells.random(), normal(), chance(p), binomial(n, p)"
            " or poisson(mean), which are keyed by seed, colony, cell and step."
        )


def act(rule: Callable[..., object], *views: CellsView | DivisionView) -> None:
    """Calls a rule on its views. Raises RuleError, with the line, if it uses a tensor as one
    number, or calls a function with what that does not take, or if it returns values by name, which
    would be lost. Errors of other kinds are raised as they are."""
    try:
        with deterministic_functions():
            returned = rule(*views)
    except (RuntimeError, ValueError, TypeError) as error:
        hint = next((words for part, words in HINTS.items() if part in str(error)), "")
        own = isinstance(error, checks.InputError) or not isinstance(error, (ValueError, TypeError))
        if own and not hint:
            raise
        raise RuleError(f"{_line_of(error, rule)}: {hint or _first_line(error)}") from error
    if isinstance(returned, Mapping):
        raise RuleError(
            f"{label_of(rule)} returns values by name, {list(returned)}: write them to the cells"
            " instead, such as cells.growth_rate = …"
        )
    for view in views:
        view.check_unharmed()


def _line_of(error: Exception, rule: Callable[..., object]) -> str:
    """The innermost line of the user's that led to an error; the rule, where there is none."""
    found = [
        f
        for f in traceback.extract_tb(error.__traceback__)
        if not {"torch", "site-packages"} & set(Path(f.filename).parts)
        and not f.filename.startswith(PACKAGE)
    ]
    if not found:
        return label_of(rule)
    return f"{Path(found[-1].filename).name}, line {found[-1].lineno} ({found[-1].line})"


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}".rstrip(": ")
