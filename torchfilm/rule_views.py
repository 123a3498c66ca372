"""Views of cells for the user's rules: Table 1's names, each a tensor over all cells, to read, and
to write where the model allows."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits.names import Names
from torchfilm.rule_draws import Draws, OneCell, StepDraws
from torchfilm.rule_surroundings import SurroundingsView
from torchfilm.rule_values import (
    REMOVED_LATER,
    RuleError,
    as_tensor,
    broadcast_copy,
    check_integers,
    near_name,
)
from torchfilm.state import CELL, CELL_TYPE, COLONY, OUTSIDE, RESERVED, Field, State
from torchfilm.tools.hot_reload import unchanged

# The paper's names (Table 1) and ours.
PAPER_NAMES = {
    "pos": "position",
    "dir": "axis",
    "cellType": "cell_type",
    "growthRate": "growth_rate",
    "divideFlag": "divide_flag",
}
GEOMETRY = ("position", "axis", "length", "radius", "volume", "area")
# The fields of other effects that a read of a name depends on.
MEANS = {
    "volume": ("length", "radius"),
    "area": ("length", "radius"),
    "uid": ("cells",),
    "parent": ("cells",),
    "colony": ("cells", "colony"),
}
IDENTITY = ("uid", "parent", "colony")
# fields that only an effect acts on
OF_EFFECTS = {"growth_rate": "tf.Growth()", "divide_flag": "tf.Division()"}
SECRETES = "a circuit says what cells give to a signal and take from it"
ONE_BY_ONE = ("random", "normal", "chance", "event", "binomial", "poisson")
# How a view finds the constants that rules were given, its `p`; None: they were given none.
Constants = Callable[[], Names] | None
KNOWN_FIELDS = {
    "cell_type": CELL_TYPE,
    "drag": Field("drag", "factor on the viscosity that this cell feels", initial=1.0),
}


def _quantity(state: State, name: str) -> Tensor:
    """A quantity by its name in rules.

    A colony is given by its id, which does not depend on the batch.
    """
    if name in state.declared and state.declared[name].scope == COLONY:
        return state.fields[name].index_select(0, state.colony)
    return state.own_colony_id if name == "colony" else getattr(state, name)


def _known_names(state: State) -> list[str]:
    """What rules can read of the cells, but what serves the numerics."""
    fields = [
        n
        for n, f in state.declared.items()
        if n.isidentifier() and (n in OF_EFFECTS or not f.internal)
    ]
    return [*GEOMETRY, *IDENTITY, *fields]


class CellsView(StepDraws, SurroundingsView):
    """The cells as a rule sees them: every name is a tensor over all cells, (N,) or (N, d).

    `for cell in cells` gives them one by one (slow). A rule may read position (pos; x, y, z), axis
    (dir), length, radius, volume, area, uid, parent, colony, signals, the constants p that its
    rules were given, and every field of the scene. It may write fields, `divide_flag`,
    `remove_flag`, and new names, which become variables of the cell. A tensor that was read may be
    changed in place.
    """

    _state: State
    _dt: float
    _work: dict[str, Tensor]
    _read: set[str]
    _shown: dict[str, Tensor]
    _given: dict[str, Tensor]  # the signals of what is shown
    _around: Names | None
    _written: set[str]
    _declaring: bool
    _draws: int
    _draws_of: dict[int, OneCell]
    _pairs: dict[float, tuple[Tensor, Tensor]]
    _constants: Constants

    def __init__(
        self,
        state: State,
        dt: float,
        label: str,
        declaring: bool = False,
        constants: Constants = None,
    ):
        # bypasses __setattr__, which is for rules
        self.__dict__.update(
            _state=state, _rows=None, _purpose=label, _dt=dt, _work={}, _read=set(), _shown={},
            _given={}, _around=None, _written=set(), _declaring=declaring, _draws=0, _draws_of={},
            _asked={} if declaring else None,
            _pairs={}, _constants=constants,
        )  # fmt: skip

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

    def __getattr__(self, name: str) -> Any:
        name = PAPER_NAMES.get(name, name)
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._work:
            return self._work[name]
        if name == "signals":
            return self._signals()
        if name == "p" and self._constants is not None:
            return self._constants()
        state = self._state
        if name in GEOMETRY or name in IDENTITY:
            self._read.update(MEANS.get(name, (name,)))
            if name not in self._shown:
                # a copy: a write into it is detected, and the state stays unchanged
                self._shown[name] = _quantity(state, name).clone()
            return self._shown[name]
        if name == "remove_flag":
            self._work[name] = torch.zeros(state.cells, dtype=torch.bool, device=state.device)
        elif name in state.fields and state.declared[name].scope == COLONY:
            self._read.add(name)
            # each cell gets the value of its colony; writes into it are detected as for geometry
            if name not in self._shown:
                self._shown[name] = _quantity(state, name)
            return self._shown[name]
        elif name in state.fields:
            self._read.add(name)
            # a copy, so that a rule may write into it: states are frozen
            self._work[name] = state.fields[name].clone()
        elif name in tuple("xyz"[: state.dim]):
            return self.position[:, "xyz".index(name)]
        elif self._declaring and name in KNOWN_FIELDS:
            self._work[name] = KNOWN_FIELDS[name].start(
                state, torch.arange(state.cells, device=state.device)
            )
        else:
            if OUTSIDE + name in state.fields:
                raise RuleError(
                    f"cells have no {name!r}; it is a signal: read cells.signals.{name}."
                )
            known = _known_names(state)
            near = near_name(name, [*known, *self._more_names()])
            raise RuleError(
                f"cells have no {name!r}; they have {', '.join(known)}.{near} A variable of your"
                f" own needs a first value: give Rules(…, variables={{{name!r}: 0.0}})."
            )
        return self._work[name]

    def _more_names(self) -> list[str]:
        """What else stands after `cells.`: flags, methods, and names of the paper."""
        methods = [n for n in dir(type(self)) if not n.startswith("_")]
        return [*PAPER_NAMES, *"xyz"[: self._state.dim], "remove_flag", *methods]

    def _signals(self) -> Names:
        """The concentration of each signal at each cell, (N,) by name: `cells.signals.ahl`."""
        state = self._state
        if state.layout is None:
            raise RuleError("cells have no signals: this scene has no Medium.")
        if self._around is None:
            self._read.update(("position", *(n for n in state.fields if n.startswith(OUTSIDE))))
            contact = state.contact()
            assert contact is not None
            shown = [x.clone() for x in contact.found.values()]
            for (n, x), own in zip(contact.found.items(), shown, strict=True):
                self._given[f"signals.{n}"], self._shown[f"signals.{n}"] = x, own
            made = Names(tuple(contact.found), shown, "cells.signals", SECRETES)
            self.__dict__["_around"] = made
        assert self._around is not None
        return self._around

    def __setattr__(self, name: str, value: Any) -> None:
        name = PAPER_NAMES.get(name, name)
        state = self._state
        of_colony = name in state.declared and state.declared[name].scope == COLONY
        if (
            of_colony
            or name in (*GEOMETRY, *IDENTITY, "signals")
            or (name in tuple("xyz"[: state.dim]) and name not in state.fields)
            or isinstance(getattr(type(self), name, None), property)
        ):
            raise RuleError(
                f"cells.{name} can only be read (Table 1 of the paper): rules change fields, flags"
                " and variables."
            )
        declared = (
            KNOWN_FIELDS.get(name, state.declared.get(name)) if name != "remove_flag" else None
        )
        dtype = (
            torch.bool
            if name == "remove_flag"
            else (declared.dtype or state.dtype)
            if declared is not None
            else None
        )
        tensor = as_tensor(f"cells.{name}", value, state.device)
        if dtype is None:
            # a Python number makes a variable of floating-point type
            plain = tensor.is_floating_point() or (
                not isinstance(value, (bool, Tensor)) and tensor.dtype != torch.bool
            )
            dtype = state.dtype if plain else tensor.dtype
        if self._declaring and name not in (*state.fields, *KNOWN_FIELDS, "remove_flag"):
            self._check_new(name)
        self._written.add(name)
        own = declared.shape if name in state.fields and declared else tuple(tensor.shape[1:])
        shape = (state.cells, *own)
        self._work[name] = broadcast_copy(f"cells.{name}", tensor.to(state.device), dtype, shape)

    def _check_new(self, name: str) -> None:
        """Raises RuleError for a new name that no variable may have, or that is a slip."""
        if name in OF_EFFECTS:
            raise RuleError(f"cells.{name} acts only with {OF_EFFECTS[name]} in the scene.")
        known = [*self._state.fields, *KNOWN_FIELDS, "remove_flag", *PAPER_NAMES]
        if name in RESERVED:
            raise RuleError(
                f"cells.{name} cannot be set: the state uses this name itself."
                f"{near_name(name, known)} Give a variable of your own another name."
            )
        near = difflib.get_close_matches(name, known, 1, cutoff=0.82)
        near = near or [n for n in known if len(n) > 2 and sorted(n) == sorted(name)]  # gpf for gfp
        if near:
            raise RuleError(
                f"cells.{name} is new: did you mean {near[0]!r}? If it is a variable of your"
                f" own, give Rules(…, variables={{{name!r}: 0.0}})."
            )

    def __iter__(self):
        return (CellView(self, k) for k in range(self._state.cells))

    def check_unharmed(self) -> None:
        """Raises RuleError if a rule wrote into a read-only name."""
        for name, shown in self._shown.items():
            given = self._given.get(name)
            if not unchanged(shown, _quantity(self._state, name) if given is None else given):
                raise RuleError(
                    f"the rule changed cells.{name} in place, which can only be read: rules change"
                    " fields, flags and variables."
                )


class CellView:
    """One cell of a CellsView: the same names, one value each.

    It serves loops as in the paper; whole tensors are a thousand times faster.
    """

    _cells: CellsView
    _index: int

    def __init__(self, cells: CellsView, index: int):
        self.__dict__.update(_cells=cells, _index=index)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        found = getattr(self._cells, name)
        if isinstance(found, Names):
            one = [found[n][self._index] for n in found]
            return Names(tuple(found), one, f"cell.{name}", found._why)
        if name in ONE_BY_ONE:
            drawn = self._cells._draws_of.setdefault(self._index, OneCell(self._cells, self._index))
            return lambda *given: getattr(drawn, name)(*given)[0]
        if callable(found):
            raise RuleError(f"{name} is of all cells: call cells.{name}(…) outside the loop.")
        return found[self._index] if isinstance(found, Tensor) else found

    def __setattr__(self, name: str, value: Any) -> None:
        name = PAPER_NAMES.get(name, name)
        cells = self._cells
        if (
            name in cells._state.fields
            or name in ("remove_flag", *KNOWN_FIELDS)
            or name in cells._work
        ):
            column = getattr(cells, name)
            check_integers(f"cell.{name}", torch.as_tensor(value), column.dtype)
            column[self._index] = value
            cells._written.add(name)
        elif cells._declaring:
            setattr(cells, name, False if isinstance(value, bool) else 0.0)
            getattr(cells, name)[self._index] = value
        else:
            setattr(cells, name, value)  # raises RuleError with the reason


class DivisionView(Draws):
    """The parents or the daughters of one step's divisions, M of each.

    The names are those of CellsView. Fields of daughters may be written, or changed in place.
    """

    _state: State
    _rows: Tensor | None
    _name: str
    _purpose: str
    _set: set[str]
    _work: dict[str, Tensor]
    _draws: int
    _constants: Constants

    def __init__(
        self, state: State, rows: Tensor | None, called: str, purpose: str, constants: Constants
    ):
        self.__dict__.update(
            _state=state, _rows=rows, _name=called, _purpose=purpose, _set=set(), _work={},
            _draws=0, _constants=constants,
        )  # fmt: skip

    def __getattr__(self, name: str) -> Any:
        name = PAPER_NAMES.get(name, name)
        if name.startswith("_"):
            raise AttributeError(name)
        if name == "p" and self._constants is not None:
            return self._constants()
        if name not in self._work:
            if name in tuple("xyz"[: self._state.dim]) and name not in self._state.fields:
                return self.position[:, "xyz".index(name)]
            if not (name in GEOMETRY or name in IDENTITY or name in self._state.fields):
                known = _known_names(self._state)
                if hasattr(CellsView, name):
                    raise RuleError(
                        f"{self._name} has no {name!r}: a division sees its own cells. Let update"
                        " set a variable of them, which divide reads."
                    )
                raise RuleError(
                    f"cells have no {name!r}; they have {', '.join(known)}.{near_name(name, known)}"
                )
            self._work[name] = self._copy(name)
        return self._work[name]

    def _copy(self, name: str) -> Tensor:
        """A copy of the quantity, one row per division.

        For a field of the colony each division gets its colony's value.
        """
        value = _quantity(self._state, name)
        return value.clone() if self._rows is None else value.index_select(0, self._rows)

    def _writable(self, name: str) -> bool:
        """Whether rules may write the name: a field per cell, of a daughter."""
        return (
            self._rows is not None
            and name in self._state.fields
            and self._state.declared[name].scope == CELL
        )

    def changed_in_place(self) -> set[str]:
        """Fields that a rule wrote into and did not set."""
        return {
            name
            for name, shown in self._work.items()
            if name not in self._set
            and self._writable(name)
            and not unchanged(shown, self._copy(name))
        }

    def check_unharmed(self) -> None:
        """Raises RuleError if a rule wrote into a read-only name."""
        for name, shown in self._work.items():
            if not self._writable(name) and not unchanged(shown, self._copy(name)):
                raise RuleError(
                    f"the rule changed {self._name}.{name} in place, which can only be read:"
                    " rules set daughters' fields."
                )

    def __setattr__(self, name: str, value: Any) -> None:
        name = PAPER_NAMES.get(name, name)
        if name == "remove_flag":
            raise RuleError(REMOVED_LATER)
        if self._rows is None:
            raise RuleError(
                f"parent.{name} can only be read, since the parent no longer exists. Set"
                f" daughter1.{name} and daughter2.{name}."
            )
        if name in GEOMETRY or name in IDENTITY:
            raise RuleError(
                f"{self._name}.{name} can only be read: Division places the daughters (its"
                " `fraction` divides the length); rules set fields."
            )
        if not self._writable(name):
            own = ", ".join(filter(self._writable, _known_names(self._state)))
            first = (
                "give the first cells a type: founders=tf.Cells(…, cell_type=[0])"
                if name == "cell_type"
                else f"a variable needs a first value: give Rules(…, variables={{{name!r}: 0.0}})"
            )
            raise RuleError(
                f"daughters have no field {name!r} to write (a colony's can only be read); they"
                f" have {own}. If it is new, {first}."
            )
        like = getattr(self, name)
        tensor = as_tensor(f"{self._name}.{name}", value, like.device)
        self._work[name] = broadcast_copy(f"{self._name}.{name}", tensor, like.dtype, like.shape)
        self._set.add(name)
