"""Parts of a step that kernels compute on the CPU, for states on a GPU.

Kernels are for the CPU, and torch takes 10 to 100 times as long on a GPU for contacts and circuits
(docs/performance.md). So a scene that is bound to a GPU is bound to the CPU as well, but for rules,
effects of the user's own and functions that work on the GPU only. Where no derivative is wanted,
the kernels' parts of a step run there, on a copy of the state, to the bits of the CPU. All others
run on the GPU, and so does everything if no backend is by kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any
from weakref import ref

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from torchfilm.effect import BoundEffect
from torchfilm.effects.bound_mechanics import BoundMechanics
from torchfilm.effects.circuit import Circuit
from torchfilm.effects.lysis import Lysis
from torchfilm.effects.medium import Medium
from torchfilm.effects.medium_reactions import MediumReactions
from torchfilm.effects.nutrition import Monod
from torchfilm.effects.rules import Rules
from torchfilm.effects.scaled import held_tensors
from torchfilm.founders import FirstCells
from torchfilm.joined_step import JoinedStep, joined
from torchfilm.parameters import parameters
from torchfilm.state import PER_CELL, Births, Field, State
from torchfilm.tools import checks
from torchfilm.tools.numba_calls import unavailable
from torchfilm.tools.parts import mapped, parts_of
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import in_forward_mode
from torchfilm.tools.timing import Timings
from torchfilm.tools.warn_once import quietly
from torchfilm.turns import Part, in_turns
from torchfilm.values import Distribution

if TYPE_CHECKING:
    from torchfilm.model import Model

CPU = torch.device("cpu")
EXCHANGE = (Circuit, Medium, MediumReactions, Monod, Lysis)  # by the medium with one another


class Copies:
    """Tensors and layouts of a GPU and their copies on the CPU, each of which knows the other while
    both are in use; so what a step leaves as it is does not travel."""

    def __init__(self, device: torch.device):
        self.device = device
        self._here = WeakIdKeyDictionary()  # by what is there: its copy, and its version then
        self._there = WeakIdKeyDictionary()  # by a copy: what it is of

    def __reduce__(self) -> tuple[Any, ...]:
        return Copies, (self.device,)  # weak references cannot be pickled

    def here(self, part: Any) -> Any:
        """A tensor or layout on the CPU."""
        known, version = self._here.get(part, (None, None))
        found = None if known is None else known()
        if found is not None and version == _version(part):
            return found
        made = part.to(CPU)
        return made if made is part else self._noted(part, made)[1]

    def there(self, part: Any) -> Any:
        """A tensor or layout on the GPU."""
        known = self._there.get(part)
        found = None if known is None else known()
        if found is not None and self._here.get(found, (None, None))[1] == _version(found):
            return found
        made = part.to(self.device)
        return made if made is part else self._noted(made, part)[0]

    def send(self, parts: Iterable[Any]) -> list[Tensor]:
        """Makes the copies on the GPU of those tensors that have none, one way for each dtype: a
        way of its own takes longer than the numbers of a small colony. `there` knows them as long
        as what is returned is held."""
        sent: list[Tensor] = []
        if torch.is_inference_mode_enabled():
            return sent  # no versions: nothing would be known
        waiting: dict[torch.dtype, list[Tensor]] = {}
        for part in {id(part): part for part in parts}.values():
            if isinstance(part, Tensor) and part.device.type == "cpu" and part not in self._there:
                waiting.setdefault(part.dtype, []).append(part)
        for tensors in waiting.values():
            together = torch.cat([x.reshape(-1) for x in tensors]).to(self.device)
            pieces = together.split([x.numel() for x in tensors])
            for here, there in zip(tensors, pieces, strict=True):
                sent.append(self._noted(there.reshape(here.shape).clone(), here)[0])
        return sent

    def _noted(self, there: Any, here: Any) -> tuple[Any, Any]:
        if _version(there) is not None:
            self._here[there] = ref(here), _version(there)
            self._there[here] = ref(there)
        return there, here


def _version(part: Any) -> int | None:
    """How often a tensor has been changed in place; 0 of a layout, which never is; None where torch
    does not count."""
    if not isinstance(part, Tensor):
        return 0
    return None if part.is_inference() else part._version


class OnCpu:
    """A part of a step, or several, by kernels on the CPU where no derivative is wanted, and else
    by torch on the GPU."""

    def __init__(self, here: Sequence[Any], there: Sequence[Any], twins: CpuTwins):
        self.here, self.there, self.twins = here, there, twins
        self.place, self.title = there[0].place, there[0].title

    def run_step(self, state: State, dt: float, timings: Timings | None = None) -> State:
        """The state after these parts."""
        if self.twins.derivatives_wanted(state):
            for part in self.there:
                state = part.run_step(state, dt, timings)
            return state
        copies = self.twins.copies
        with torch.no_grad():
            here = made = _moved(state, copies.here, self.twins.declared_here(state.declared))
            for part in self.here:
                made = part.run_step(made, dt, timings)
            if made is here:
                return state
            # of the last state only: who keeps many on the GPU keeps no copies
            self.twins.last, kept = made, copies.send(_parts(made))
            made = _moved(made, copies.there, state.declared)
            del kept  # until here, so that none is sent again
            return made


def _moved(state: State, move: Callable[[Any], Any], declared: Mapping[str, Field]) -> State:
    """The state with what happened in its step, moved. declared: its fields, whose first values are
    drawn from parameters on the same device."""

    def change(path: str, part: Any) -> Any:
        if isinstance(part, State):
            return _moved(part, move, declared)
        if isinstance(part, Groups):  # without what it has worked out
            zero = None if part.zero is None else move(part.zero)
            return Groups(move(part.owner), part.size, part.ordered, zero)
        if isinstance(part, Births):  # made again, without the parents that it has looked up
            return Births(*(mapped(getattr(part, f.name), change) for f in fields(part)))
        return move(part) if isinstance(part, Tensor) else part

    happened = {n: mapped(getattr(state, n), change) for n in ("births", "ended", "reports")}
    return state.moved(move).replace(declared=declared, **happened)


def _parts(state: State) -> list[Any]:
    """All tensors, and the layout, that `_moved` moves."""
    found: list[Any] = []

    def noted(part: Any) -> Any:
        found.append(part)
        return part

    _moved(state, noted, state.declared)
    return found


class CpuTwins:
    """The effects of a model on a GPU, bound to the CPU as well.

    of: the twin of each effect that has one. kept: why others have none, by title, where one would
    expect it. parts: of a step, by twins or not; joined_parts: the same, in which those that follow
    on one another are joined. last: the copy of the state that was made last.
    """

    def __init__(self, model: Model, begin: FirstCells, state: State):
        """begin: its first cells. state: on which its effects were traced."""
        self.model, self.copies = model, Copies(state.device)
        self.last: State | None = None  # on the CPU, after a step
        self.kept: dict[str, str] = {}
        places = {e.place for e in model.effects if self._may_move(e)}
        batch = replace(model.batch, device=CPU)
        own = [e for e in model.effects if e.place in places]
        self._requires_grad = False
        self._held: list[Tensor] = []  # by functions of positions
        with quietly():  # binding to the GPU has said it
            here = type(model)(model.scene, batch, begin, places)
            bound = here.effects
            # effects of one place stand in the order of their stages in both
            self.of = dict(zip(sorted(own, key=_place), sorted(bound, key=_place), strict=True))
            self._trace(state.to(CPU))
            mixed = [self.of.get(e, e) for e in model.effects]
            for twin in self.of.values():
                twin.check_others(mixed)
        self._fields = here.first_fields
        tensors = [x for e in model.scene.effects for _, x in parameters(e)]
        self._requires_grad |= any(x.requires_grad for x in tensors) or any(
            e.values.requires_grad or getattr(e, "needs_gradient", False) for e in model.effects
        )
        self._lay_out(in_turns(mixed), in_turns(model.effects))

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "last": None}  # a model that is copied holds no state

    @staticmethod
    def of_model(model: Model, begin: FirstCells, state: State) -> CpuTwins | None:
        """The twins of a model, or None where kernels compute none of its effects."""
        if state.device.type == "cpu" or unavailable():
            return None
        twins = CpuTwins(model, begin, state)
        return twins if any(isinstance(part, OnCpu) for part in twins.parts) else None

    def derivatives_wanted(self, state: State) -> bool:
        """Whether a derivative may be wanted through a step of this state."""
        if in_forward_mode():
            return True
        if not torch.is_grad_enabled():
            return False
        given = (*(getattr(state, n) for n in PER_CELL), *state.fields.values(), *self._held)
        return self._requires_grad or any(x.requires_grad for x in given)

    def declared_here(self, declared: Mapping[str, Field]) -> dict[str, Field]:
        """Fields whose first values are found on the CPU: by twins, or by what is on the GPU."""
        return {
            n: self._fields[n] if n in self._fields else _first_there(field, self.copies)
            for n, field in declared.items()
        }

    def twin(self, effect: BoundEffect) -> BoundEffect | None:
        """The twin by which this effect is computed where no derivative is wanted, if any."""
        found = self.of.get(effect)
        return found if found in self._in_use else None

    def in_words(self) -> list[str]:
        """Who computes what, in lines."""
        device = self.copies.device
        titles = lambda effects: ", ".join(dict.fromkeys(e.title for e in effects))
        here = [e for e in self.model.effects if self.twin(e) is not None]
        left = [e for e in self.model.effects if e not in here]
        lines = [
            f"on the CPU: {titles(here)}; the state stays on {device}, and what has changed of it"
            " is copied there and back in each step"
        ]
        if left:
            why = "".join(f"; {title}: {reason}" for title, reason in self.kept.items())
            lines.append(f"on {device}, by torch: {titles(left)}{why}")
        return lines

    # --- binding -------------------------------------------------------------------------

    def _may_move(self, effect: BoundEffect) -> bool:
        """Whether nothing of an effect's description needs to be on the GPU, as far as is known
        without a trial."""
        described = effect.effect
        if not type(described).__module__.startswith("torchfilm.effects."):
            return False
        if isinstance(described, Rules):
            return False
        laws = [type(x) for x in parts_of(described, lambda x: isinstance(x, Distribution))]
        own = [law.__name__ for law in laws if not _is_ours(law)]
        if own:
            self.kept[effect.title] = f"{own[0]} is a distribution of your own"
        return not own

    def _trace(self, state: State) -> None:
        """Traces the twins; those that only work on the GPU are dropped, and with one that takes
        part in exchange all that do."""
        failed = []
        for effect, twin in self.of.items():
            try:
                if isinstance(twin.effect, Medium):
                    self._requires_grad |= self._try_functions(twin.effect, state)
                if isinstance(twin, BoundMechanics):
                    twin.try_walls(state)
                state = twin.trace(state)
            except Exception as error:  # whatever a function that worked on the GPU raises here
                failed.append(effect)
                self.kept[effect.title] = f"it fails on the CPU, {error.__cause__ or error}"
        strange = [e for e in self.model.effects if e not in self.of and _exchanges(e)]
        if strange or any(_exchanges(e) for e in failed):
            failed += [e for e in self.of if isinstance(e.effect, EXCHANGE)]
        for effect in failed:
            if getattr(effect.effect, "backend", None) == "compiled":
                name, why = type(effect.effect).__name__, self.kept.get(effect.title, "")
                raise checks.InputError(
                    f"{name}.backend = 'compiled', but kernels are for the CPU, and"
                    f" {why or 'it works together with an effect that is not'}. Leave backend out."
                )
            self.of.pop(effect, None)

    def _try_functions(self, medium: Medium, state: State) -> bool:
        """Whether a derivative may be wanted by what the functions of positions give. Raises what
        one raises on the CPU, at the voxels of a state, and RuntimeError for values elsewhere."""
        functions = parts_of(medium, _is_function)
        assert state.layout is not None
        at = state.layout.grid.centres() if functions else torch.zeros(0)
        with torch.enable_grad():
            found = [f(at) for f in functions]
        for value in found:
            if isinstance(value, Tensor) and value.device != CPU:
                raise RuntimeError(f"a function of positions gives values on {value.device}")
        self._held += [x for f in functions for x in held_tensors(f)]
        return any(isinstance(x, Tensor) and x.requires_grad for x in found)

    def _lay_out(self, here: list[Part], there: list[Part]) -> None:
        """Finds the parts of a step. here: with twins; there: without."""
        twins = set(self.of.values())
        compiled = [all(e in twins and e.by_kernels for e in _members(part)) for part in here]
        steps = list(zip(compiled, here, there, strict=True))
        self.parts: list[Part | OnCpu] = []
        self.joined_parts: list[Part | JoinedStep | OnCpu] = []
        self._in_use: set[BoundEffect] = set()
        for on_cpu, group in groupby(steps, key=lambda step: step[0]):
            _, ours, theirs = zip(*group, strict=True)
            members = [e for part in ours for e in _members(part)]
            # growth, divisions and the like go with what is worth the way
            if on_cpu and any(hasattr(e.effect, "backend") for e in members):
                self.parts += [OnCpu([a], [b], self) for a, b in zip(ours, theirs, strict=True)]
                self.joined_parts.append(OnCpu(joined(ours), theirs, self))
                self._in_use.update(members)
            else:
                self.parts += theirs
                self.joined_parts += theirs


def _first_there(field: Field, copies: Copies) -> Field:
    """A field whose first values a function finds on the GPU."""
    given = field.initial
    if not callable(given):
        return field

    def first(state: State, rows: Tensor) -> Tensor:
        there = _moved(state, copies.there, state.declared)
        return copies.here(given(there, copies.there(rows)))

    return replace(field, initial=first)


def _place(effect: BoundEffect) -> int:
    return effect.place


def _members(part: Part) -> list[BoundEffect]:
    return [part] if isinstance(part, BoundEffect) else [*part.circuits, part.medium]


def _exchanges(effect: BoundEffect) -> bool:
    own = isinstance(effect.effect, Medium | MediumReactions)
    return own or effect.moves_signals or bool(effect.exchanges())


def _is_ours(kind: type) -> bool:
    return kind.__module__.startswith("torchfilm.")


def _is_function(part: Any) -> bool:
    """Whether it is a function of the user's own; a Schedule can be called, too."""
    return callable(part) and not isinstance(part, (Tensor, type)) and not _is_ours(type(part))
