"""Rules, the paper's way: `update(cells)` and `divide(parent, daughter1, daughter2)` with Table 1's names, on whole tensors.

    def update(cells):
        cells.growth_rate = 2.1
        cells.divide_flag = cells.volume > 3

Rules are the user's own Python. `update` is tried once on the first state, before anything runs: names that it sets and
that nothing declares become variables, and what it reads and writes is noted, so that the scene knows who drives whom.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import DIVISION, RULES, Effect
from torchfilm.physics.contacts import gaps_nearby
from torchfilm.state import CELL, CELL_TYPE, COLONY, Births, Field, State
from torchfilm.tools import checks
from torchfilm.tools.watched import Watched, load_functions, unchanged

# The paper's spellings (Table 1) beside ours.
PAPER_NAMES = {"pos": "position", "dir": "axis", "cellType": "cell_type", "growthRate": "growth_rate", "divideFlag": "divide_flag"}
GEOMETRY = ("position", "axis", "length", "radius", "volume", "area")
# What reading a name means in terms of what other effects write.
MEANS = {"volume": ("length", "radius"), "area": ("length", "radius"), "uid": ("cells",), "parent": ("cells",), "colony": ("cells",)}
IDENTITY = ("uid", "parent", "colony")
TRIAL_STEP = 0.025  # h, the step that a rule sees when it is tried
KNOWN_FIELDS = {"cell_type": CELL_TYPE, "drag": Field("drag", "factor on the viscosity that this cell feels", initial=1.0)}


def _quantity(state: State, name: str) -> Tensor:
    """A quantity by the name that rules use; a colony goes by its id, which does not depend on the batch."""
    return state.own_colony_id if name == "colony" else getattr(state, name)


def _check_whole(name: str, tensor: Tensor, dtype: torch.dtype) -> None:
    if tensor.is_floating_point() and not dtype.is_floating_point and dtype != torch.bool and not bool((tensor == tensor.round()).all()):
        raise RuleError(f"{name} holds whole numbers, and was set to broken ones. Give it a first value such as 0.0 if it is to hold any number.")


class RuleError(checks.InputError, AttributeError):
    """A rule asked for something that is not there, or set something to what it cannot be."""


class CellsView:
    """What a rule sees: every name a tensor over all cells, (N,) or (N, d); `for cell in cells` gives them one by one (slow).

    Read position (pos), axis (dir), length, radius, volume, area, uid, parent, colony, and every field of the scene; write fields, `divide_flag`,
    `remove_flag`, and new names, which become variables of the cell. A tensor that was read may be changed in place.
    """

    _state: State
    _label: str
    _dt: float
    _work: dict[str, Tensor]
    _read: set[str]
    _shown: dict[str, Tensor]
    _written: set[str]
    _declaring: bool
    _draws: int

    def __init__(self, state: State, dt: float, label: str, declaring: bool = False):
        # past __setattr__, which is the rule's
        self.__dict__.update(_state=state, _label=label, _dt=dt, _work={}, _read=set(), _shown={}, _written=set(), _declaring=declaring, _draws=0)

    @property
    def time(self) -> float:
        """h."""
        return self._state.time

    @property
    def dt(self) -> float:
        """Step, h."""
        return self._dt

    @property
    def count(self) -> int:
        """Cells in all colonies."""
        return self._state.cells

    def __len__(self) -> int:
        return self._state.cells

    def __getattr__(self, name: str) -> Tensor:
        name = PAPER_NAMES.get(name, name)
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._work:
            return self._work[name]
        state = self._state
        if name in GEOMETRY or name in IDENTITY:
            self._read.update(MEANS.get(name, (name,)))
            if name not in self._shown:
                # a copy, so that a rule that writes into it is found out and the state stays as it was
                self._shown[name] = _quantity(state, name).clone()
            return self._shown[name]
        if name == "remove_flag":
            self._work[name] = torch.zeros(state.cells, dtype=torch.bool, device=state.device)
        elif name in state.fields:
            self._read.add(name)
            # a copy, so that a rule may write into it: states are frozen
            self._work[name] = state.fields[name].clone()
        elif self._declaring and name in KNOWN_FIELDS:
            self._work[name] = KNOWN_FIELDS[name].start(state, torch.arange(state.cells, device=state.device))
        else:
            raise RuleError(
                f"cells have no {name!r}; they have {', '.join([*GEOMETRY, *IDENTITY, *state.fields])}. A variable of your own needs a first value: "
                f"give Rules(…, variables={{{name!r}: 0.0}})."
            )
        return self._work[name]

    def __setattr__(self, name: str, value: Any) -> None:
        name = PAPER_NAMES.get(name, name)
        state = self._state
        if name in GEOMETRY or name in IDENTITY or isinstance(getattr(type(self), name, None), property):
            raise RuleError(f"cells.{name} can only be read (Table 1 of the paper): rules change fields, flags and variables.")
        declared = KNOWN_FIELDS.get(name, state.declared.get(name)) if name != "remove_flag" else None
        dtype = torch.bool if name == "remove_flag" else (declared.dtype or state.dtype) if declared is not None else None
        tensor = _as_tensor(f"cells.{name}", value, state.device)
        if dtype is None:
            known = state.fields.get(name)
            # a plain number makes a variable that can hold any number
            plain = tensor.is_floating_point() or (not isinstance(value, (bool, Tensor)) and tensor.dtype != torch.bool)
            dtype = known.dtype if known is not None else state.dtype if plain else tensor.dtype
        if self._declaring and name not in (*state.fields, *KNOWN_FIELDS, "remove_flag"):
            near = difflib.get_close_matches(name, [*state.fields, *KNOWN_FIELDS, "remove_flag", *PAPER_NAMES], 1, cutoff=0.85)
            if near:
                raise RuleError(f"cells.{name} is new: did you mean {near[0]!r}? If it is a variable of your own, give Rules(…, variables={{{name!r}: 0.0}}).")
        self._written.add(name)
        shape = state.fields[name].shape if name in state.fields else (state.cells, *tensor.shape[1:])
        self._work[name] = _fitted(f"cells.{name}", tensor.to(state.device), dtype, shape)

    def __iter__(self):
        return (CellView(self, k) for k in range(self._state.cells))

    def random(self) -> Tensor:
        """A draw from (0, 1) for each cell, (N,), keyed by seed, colony, cell and step: the same whatever the batch. Each call draws anew."""
        self.__dict__["_draws"] += 1
        return self._state.uniform(torch.arange(self._state.cells, device=self._state.device), f"{self._label} {self._draws}")

    def colony_max(self, value: Tensor) -> Tensor:
        """The greatest value in each cell's own colony, (N,) -> (N,)."""
        return self._state.groups.max(value).index_select(0, self._state.colony)

    def colony_min(self, value: Tensor) -> Tensor:
        """The smallest value in each cell's own colony, (N,) -> (N,)."""
        return -self.colony_max(-value)

    def colony_sum(self, value: Tensor) -> Tensor:
        """The sum over each cell's own colony, (N,) -> (N,)."""
        return self._state.groups.sum(value.unsqueeze(1)).squeeze(1).index_select(0, self._state.colony)

    def contacts(self, within: float = 0.05) -> tuple[Tensor, Tensor]:
        """Pairs of cells whose surfaces are at most `within` µm apart: two (P,) index tensors, each pair once. Found only when asked for."""
        self._read.update(("position", "axis", "length", "radius"))
        s = self._state
        i, j, gap = gaps_nearby(s.position, s.axis, s.length, s.radius, s.colony, s.colonies, within)
        keep = torch.nonzero(gap <= within).squeeze(1)
        return i.index_select(0, keep), j.index_select(0, keep)

    def check_unharmed(self) -> None:
        """Raise if a rule wrote into something that can only be read."""
        for name, shown in self._shown.items():
            if not unchanged(shown, _quantity(self._state, name)):
                raise RuleError(f"the rule changed cells.{name} in place, which can only be read: rules change fields, flags and variables.")

    def contact_count(self, within: float = 0.05) -> Tensor:
        """How many cells each cell touches, (N,) int64."""
        i, j = self.contacts(within)
        return torch.bincount(torch.cat([i, j]), minlength=self._state.cells)


class CellView:
    """One cell of a CellsView: the same names, one value each. For loops as in the paper; whole tensors are a thousand times faster."""

    _cells: CellsView
    _index: int

    def __init__(self, cells: CellsView, index: int):
        self.__dict__.update(_cells=cells, _index=index)

    def __getattr__(self, name: str) -> Tensor:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._cells, name)[self._index]

    def __setattr__(self, name: str, value: Any) -> None:
        name = PAPER_NAMES.get(name, name)
        cells = self._cells
        if name in cells._state.fields or name in ("remove_flag", *KNOWN_FIELDS) or name in cells._work:
            column = getattr(cells, name)
            _check_whole(f"cell.{name}", torch.as_tensor(value), column.dtype)
            column[self._index] = value
            cells._written.add(name)
        elif cells._declaring:
            setattr(cells, name, False if isinstance(value, bool) else 0.0)
            getattr(cells, name)[self._index] = value
        else:
            setattr(cells, name, value)  # raises, with the reason


class DivisionView:
    """The parents or daughters of one step's divisions, M of each: names as in CellsView; daughters' fields may be written, or changed in place."""

    _state: State
    _rows: Tensor | None
    _called: str
    _purpose: str
    _set: set[str]
    _work: dict[str, Tensor]
    _draws: int

    def __init__(self, state: State, rows: Tensor | None, called: str, purpose: str):
        self.__dict__.update(_state=state, _rows=rows, _called=called, _purpose=purpose, _set=set(), _work={}, _draws=0)

    def __getattr__(self, name: str) -> Tensor:
        name = PAPER_NAMES.get(name, name)
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self._work:
            if not (name in GEOMETRY or name in IDENTITY or name in self._state.fields):
                raise RuleError(f"cells have no {name!r}; they have {', '.join([*GEOMETRY, *IDENTITY, *self._state.fields])}")
            self._work[name] = self._copy(name)
        return self._work[name]

    def _copy(self, name: str) -> Tensor:
        """The quantity as the state has it, a row for each division; of the colony's own, each division gets its colony's."""
        state, value = self._state, _quantity(self._state, name)
        if name in state.fields and state.declared[name].scope == COLONY:
            value = value.index_select(0, state.colony)
        return value.clone() if self._rows is None else value.index_select(0, self._rows)

    def _writable(self, name: str) -> bool:
        return self._rows is not None and name in self._state.fields and self._state.declared[name].scope == CELL

    def check_unharmed(self) -> None:
        """Raise if a rule wrote into something that can only be read."""
        for name, shown in self._work.items():
            if not self._writable(name) and not unchanged(shown, self._copy(name)):
                raise RuleError(f"the rule changed {self._called}.{name} in place, which can only be read: rules set daughters' fields.")

    def __setattr__(self, name: str, value: Any) -> None:
        name = PAPER_NAMES.get(name, name)
        if self._rows is None:
            raise RuleError(f"parent.{name} can only be read: the parent is gone; set daughter1.{name} and daughter2.{name}.")
        if name in GEOMETRY or name in IDENTITY:
            raise RuleError(f"{self._called}.{name} can only be read: Division places the daughters (its `fraction` shares the length); rules set fields.")
        if not self._writable(name):
            own = ", ".join(filter(self._writable, self._state.fields))
            raise RuleError(f"daughters have no field {name!r} to write (a colony's can only be read); they have {own}")
        like = getattr(self, name)
        tensor = _as_tensor(f"{self._called}.{name}", value, like.device)
        self._work[name] = _fitted(f"{self._called}.{name}", tensor, like.dtype, like.shape)
        self._set.add(name)

    def random(self) -> Tensor:
        """A draw from (0, 1) for each division, (M,), keyed by seed, colony, cell and step."""
        self.__dict__["_draws"] += 1
        rows = self._rows if self._rows is not None else torch.arange(self._state.cells, device=self._state.device)
        return self._state.uniform(rows, f"{self._purpose} {self._draws}")


def _as_tensor(name: str, value: Any, device: torch.device) -> Tensor:
    try:
        return value if isinstance(value, Tensor) else torch.as_tensor(value, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise RuleError(f"{name} was set to {value!r}: it must be a number or a tensor.") from error


def _fitted(name: str, tensor: Tensor, dtype: torch.dtype, shape: Sequence[int]) -> Tensor:
    """A copy of that type and shape."""
    _check_whole(name, tensor, dtype)
    try:
        return tensor.to(dtype).broadcast_to(shape).clone()
    except RuntimeError as error:
        raise RuleError(f"{name} was set to a tensor of shape {tuple(tensor.shape)}: it must be one value or {tuple(shape)}.") from error


@dataclass(frozen=True)
class Rules(Effect):
    """The user's rules: `update(cells)` at the start of each step, `divide(parent, daughter1, daughter2)` after divisions.

    update: a function, or the path of a Python file that defines `update` and, if wanted, `divide`. variables: first values
    of variables of the user's own, one number each.
    """

    update: Callable[[CellsView], None] | str | Path | None = None
    divide: Callable[[DivisionView, DivisionView, DivisionView], None] | None = None
    variables: Mapping[str, float] = field(default_factory=dict)
    source: Watched = field(init=False, repr=False, compare=False)
    noted: dict[str, tuple[str, ...]] = field(init=False, repr=False, compare=False)

    stage = RULES
    title = "rules"
    writes_anything = True

    def __post_init__(self) -> None:
        path = None
        functions: dict[str, Any] = {"update": self.update, "divide": self.divide}
        if isinstance(self.update, (str, Path)):
            # as given, or beside the scene file or wherever else Python looks for modules
            places = [Path(self.update), *(Path(p) / self.update for p in sys.path)]
            path = next((p for p in places if p.is_file()), places[0])
            if not path.is_file():
                raise checks.refuse("Rules.update", str(path), "a function or the path of a Python file", "No such file.")
            functions = load_functions(path, ("update", "divide"))
        for name, given in functions.items():
            if given is not None and not callable(given):
                raise checks.refuse(f"Rules.{name}", given, "a function")
        if not any(functions.values()):
            raise checks.InputError("Rules() has neither update nor divide: give at least one, such as tf.Rules(update).")
        for name, value in self.variables.items():
            checks.number(f"Rules.variables[{name!r}]", value)
        object.__setattr__(self, "source", Watched(path, functions))
        object.__setattr__(self, "noted", {"reads": (), "writes": (), "divide reads": (), "divide writes": ()})

    def parts(self) -> tuple[Effect, ...]:
        return (self, DivisionRule(self)) if self.source.functions["divide"] or self.source.path else (self,)

    def declares(self, dim: int) -> tuple[Field, ...]:
        return tuple(Field(name, "variable of the user's rules", initial=value) for name, value in self.variables.items())

    def reads(self) -> tuple[str, ...]:
        return self.noted["reads"]

    def writes(self) -> tuple[str, ...]:
        return self.noted["writes"]

    def prepare(self, state: State) -> State:
        """Try `update` once on the first state: new names become fields, and what is read and written is noted."""
        update = self.source.functions["update"]
        if update is not None:
            view = CellsView(state, TRIAL_STEP, _label(update), declaring=True)
            update(view)
            view.check_unharmed()
            for name, value in view._work.items():
                if name not in state.fields and name != "remove_flag":
                    new = KNOWN_FIELDS.get(name) or Field(name, "variable of the user's rules", dtype=value.dtype, shape=tuple(value.shape[1:]))
                    state = state.declare(new)
            changed = [n for n, v in view._work.items() if n != "remove_flag" and not torch.equal(v, state.fields[n])]
            writes = view._written | set(changed)
            self.noted["reads"] = tuple(sorted(view._read))
            self.noted["writes"] = tuple("cells" if n == "remove_flag" else n for n in sorted(writes))
        divide = self.source.functions["divide"]
        if divide is not None and state.cells:
            self._try_division(divide, state)
        return state

    def _try_division(self, divide: Callable[..., None], state: State) -> None:
        """Try `divide` on a first cell and two copies of it, and note what it reads and writes."""
        one = torch.zeros(1, dtype=torch.int64, device=state.device)
        twice = state.take(torch.cat([one, one]))
        births = Births(one, one + 1, torch.cat([one, one]), state.take(one))
        views = _after_divide(divide, twice, births)
        self.noted["divide reads"] = tuple(sorted({MEANS.get(n, (n,))[0] for view in views for n in view._work}))
        self.noted["divide writes"] = tuple(sorted(views[1]._set | views[2]._set))

    def step(self, state: State, dt: float) -> State:
        if state.cells == 0:
            return state
        self.source.refresh(state.time)
        return self.source.call("update", lambda update: _apply(update, state, dt), state)


def _label(rule: Callable[..., None]) -> str:
    """What keeps the random draws of one rule apart from another's."""
    return f"rule {getattr(rule, '__module__', '')} {getattr(rule, '__qualname__', type(rule).__name__)}"


def _apply(update: Callable[[CellsView], None], state: State, dt: float) -> State:
    view = CellsView(state, dt, _label(update))
    update(view)
    view.check_unharmed()
    work = dict(view._work)
    if "drag" in work and not bool((work["drag"] > 0).all()):
        raise RuleError(f"cells.drag was set to {float(work['drag'].min()):g}: it must be above 0.")
    if "growth_rate" in work and bool((work["growth_rate"] < 0).any()):
        raise RuleError(f"cells.growth_rate was set to {float(work['growth_rate'].min()):g}: it must be at least 0. To let cells vanish, set remove_flag.")
    gone = work.pop("remove_flag", None)
    for name in work:
        if name not in state.fields:
            if name not in KNOWN_FIELDS:
                raise checks.SimulationError(f"rules set the variable {name!r} for the first time in mid-run: give Rules(…, variables={{{name!r}: 0.0}}).")
            state = state.declare(KNOWN_FIELDS[name])
    state = state.with_fields(**work)
    return state if gone is None else state.remove(gone, "removed")


@dataclass(frozen=True)
class DivisionRule(Effect):
    """The part of Rules that acts after division: the user's `divide(parent, daughter1, daughter2)`."""

    rules: Rules

    stage = DIVISION + 1
    title = "rules at division"

    def reads(self) -> tuple[str, ...]:
        return ("cells", *self.rules.noted["divide reads"])

    def writes(self) -> tuple[str, ...]:
        return self.rules.noted["divide writes"]

    def step(self, state: State, dt: float) -> State:
        source = self.rules.source
        for births in state.births:
            state = source.call("divide", partial(_divide, state=state, births=births), state)
        return state


def _after_divide(act: Callable[..., None], state: State, births: Births) -> tuple[DivisionView, DivisionView, DivisionView]:
    """Parent, first and second daughter as the rule leaves them."""
    views = (
        DivisionView(births.parents, None, "parent", "divide parent"),
        DivisionView(state, births.first, "daughter1", "divide first"),
        DivisionView(state, births.second, "daughter2", "divide second"),
    )
    act(*views)
    for view in views:
        view.check_unharmed()
    return views


def _divide(act: Callable[..., None], state: State, births: Births) -> State:
    _, first, second = _after_divide(act, state, births)
    changed: dict[str, Tensor] = {}
    for daughter, rows in ((first, births.first), (second, births.second)):
        for name, value in daughter._work.items():
            if daughter._writable(name):
                changed[name] = changed.get(name, state.fields[name]).index_copy(0, rows, value)
    return state.with_fields(**changed)
