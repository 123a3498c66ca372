"""Reactions of signals with one another, in every voxel of the medium."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchfilm.circuits import failures, run
from torchfilm.circuits.columns import Columns, Lookup, column
from torchfilm.circuits.compiled_stiff import CompiledStiff, compiled_stiff
from torchfilm.circuits.graph import check_returned
from torchfilm.circuits.names import Names, UnknownName, label_of, unknown
from torchfilm.circuits.network import build_network
from torchfilm.circuits.reactions import Reaction
from torchfilm.circuits.tracing import Untraceable
from torchfilm.effect import AFTER_CELLS, BEFORE_NUTRITION, Binding, BoundEffect, Effect
from torchfilm.signals.schedule import warn_of_steps
from torchfilm.state import OUTSIDE, State
from torchfilm.tools import checks
from torchfilm.tools.tangents import outside_checkpoints
from torchfilm.values import COLONY, Rule, checked

CONSTANT = Rule(scope=COLONY, scheduled=True)
TRIED = 16  # voxels, of a trial

# Rates of signals, conc/h by name, from their concentrations s and constants p.
Rates = Callable[[Names, Names], Mapping[str, Tensor]]


@dataclass(frozen=True)
class MediumReactionsReport:
    """`status` (B,): 1 where the reactions of a voxel could not be stepped. `words`: why, by the
    place of the colony."""

    status: Tensor
    words: Mapping[int, str]
    hint = "Check the rates where concentrations are 0 or large"

    def reason(self, place: int) -> str:
        return self.words[place]


@dataclass(frozen=True, eq=False)
class MediumReactions(Effect):
    """Signals react with one another in every voxel of the medium.

    rates: f(s, p) returns ds/dt of the signals that change, conc/h, by name; each `s.NAME` is a
    column with one concentration for each voxel, each `p.NAME` a constant. Or a list of reactions
    between signals, such as [tf.Reaction.of("enzyme + drug -> enzyme", rate=2.0)].

    parameters: constants by name, one number, one per colony, or a Schedule. rtol, atol: the error
    of a step is at most atol + rtol·|s| in each voxel. backend: as in Circuit.

    A stiff solver takes half of each step before cells exchange signals and half after (Strang);
    nothing goes below 0. Obstacles hold no signal, and nothing reacts there.
    """

    rates: Rates | Sequence[Reaction]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    rtol: float = 1e-4
    atol: float = 1e-9
    backend: str | None = None

    stage = AFTER_CELLS
    title = "medium reactions"
    may_repeat = False
    instead_of_two = "Let one function, or one list, have all reactions."
    works_on_grid = True

    def __post_init__(self) -> None:
        listed = isinstance(self.rates, Sequence) and not isinstance(self.rates, str)
        if not (callable(self.rates) or (listed and self.rates)):
            raise checks.input_error(
                "MediumReactions.rates", self.rates, "a function f(s, p), or a list of reactions"
            )
        if not isinstance(self.parameters, Mapping):
            raise checks.input_error(
                "MediumReactions.parameters", self.parameters, 'a dict, {"k": 2.0}'
            )
        for name in self.parameters:
            if not (isinstance(name, str) and name.isidentifier()):
                raise checks.input_error("MediumReactions.parameters", name, "a name, such as 'k'")
        checks.number("MediumReactions.rtol", self.rtol, above=0.0, most=0.1)
        checks.number("MediumReactions.atol", self.atol, above=0.0)
        if self.backend not in (None, "compiled", "torch"):
            raise checks.input_error(
                "MediumReactions.backend", self.backend, 'None, "compiled" or "torch"'
            )
        values = {n: checked(self._path(n), v, CONSTANT) for n, v in self.parameters.items()}
        object.__setattr__(self, "parameters", values)

    @staticmethod
    def _path(name: str) -> str:
        return f"MediumReactions.parameters[{name!r}]"

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        return {n: (v, CONSTANT) for n, v in self.parameters.items()}

    def check_step(self, dt: float, divides: bool) -> None:
        warn_of_steps("MediumReactions", self.parameters, dt)

    def bind(self, binding: Binding) -> tuple[BoundEffect, ...]:
        before = BoundReactions(self, binding)
        before.stage, before.title = BEFORE_NUTRITION, "medium reactions, first half"
        return before, BoundReactions(self, binding)


class BoundReactions(BoundEffect):
    """Half a step of reactions in the medium, bound to a batch."""

    effect: MediumReactions

    def __init__(self, effect: MediumReactions, binding: Binding):
        super().__init__(effect, binding)
        self.label = label_of(effect.rates)
        self.read: tuple[str, ...] = ()  # signals
        self.written: tuple[str, ...] = ()
        self.part: Any = None
        self.compiled: CompiledStiff | None = None
        self.by_torch = "" if effect.backend != "torch" else 'it was given backend="torch"'

    def reads(self) -> tuple[str, ...]:
        return tuple(OUTSIDE + n for n in self.species)

    def writes(self) -> tuple[str, ...]:
        return tuple(OUTSIDE + n for n in self.written)

    @property
    def species(self) -> tuple[str, ...]:
        """The signals that react."""
        return tuple(dict.fromkeys((*self.read, *self.written)))

    @property
    def by_kernels(self) -> bool:
        return not self.by_torch

    def trace(self, state: State) -> State:
        """Find out which signals react, by a trial, and make kernels of the rates."""
        if state.layout is None:
            raise checks.InputError(
                "MediumReactions are of the signals of a medium, and this scene has none: list"
                " tf.Medium(…, box=…, spacing=…)."
            )
        signals = tuple(state.signals)
        if callable(self.effect.rates):
            self._try(self.effect.rates, signals, state)
        else:
            self._listed(self.effect.rates, signals)
        if unread := [n for n in self.effect.parameters if n not in self._known]:
            raise checks.InputError(
                f"{self.label} does not read {', '.join(unread)} of MediumReactions.parameters:"
                " leave it out, or read it as p.NAME."
            )
        if not self.by_torch:
            try:
                with outside_checkpoints():
                    self.compiled = compiled_stiff(self._voxels(state, None))
            except Untraceable as why:
                self.by_torch = f"{self.label}: {why}"
                if self.effect.backend == "compiled":
                    raise checks.InputError(
                        f"MediumReactions.backend = 'compiled', but {self.by_torch}. Leave backend"
                        " out."
                    ) from why
        return state

    def _listed(self, reactions: Any, signals: Sequence[str]) -> None:
        network = build_network(reactions, signals)
        used = {
            n
            for r in network.reactions
            for n in (*r.consumes, *r.produces, *getattr(r.rate, "reads", ()))
        }
        self.read = tuple(n for n in signals if n in used)
        network = build_network(reactions, self.read)
        moved = network.stoichiometry.any(0).tolist()
        self.written = tuple(n for n, moves in zip(self.read, moved, strict=True) if moves)
        self.part, self._known = network, set(network.parameters)
        for name in network.parameters:
            if name not in self.effect.parameters:
                what = (
                    f"a reaction needs the parameter {name!r}, which MediumReactions was not given"
                )
                raise checks.InputError(unknown(what, name, list(self.effect.parameters)))

    def _try(self, rates: Rates, signals: Sequence[str], state: State) -> None:
        """Call the function on some voxels: with the concentrations at first, with others, and with
        those of one voxel alone."""
        rows = torch.arange(min(TRIED, self._nodes(state)), device=state.device)
        read: set[str] = set()
        seen: set[str] = set()
        first = {n: state.fields[OUTSIDE + n].index_select(0, rows) for n in signals}
        more = 10.0 ** torch.linspace(-1.0, 1.0, rows.numel(), dtype=state.dtype).to(rows.device)
        others = {n: (k + 1.0) * more + x for k, (n, x) in enumerate(first.items())}

        def called(columns: Mapping[str, Tensor], rows: Tensor) -> Mapping[str, Tensor]:
            every = torch.arange(rows.numel(), device=rows.device)
            s = Columns(columns, every, "s", read)
            return self._called(rates, s, Columns(self._constants(state), rows, "p", seen), rows)

        found = called(first, rows), called(others, rows)
        for name in found[0]:
            if name not in signals:
                wrong = f"{self.label} returned a rate for {name!r}, which is no signal"
                raise checks.InputError(unknown(wrong, str(name), list(signals)))
        alone = called({n: x[-1:] for n, x in others.items()}, rows[-1:])
        for name, value in alone.items():
            if not torch.allclose(found[1][name][-1:], value, rtol=1e-4, equal_nan=True):
                raise checks.InputError(
                    f"{self.label}: the rate of {name!r} in one voxel depends on what other voxels"
                    " there are (a sum or a mean over them, or a draw?)."
                )
        if not alone:
            raise checks.InputError(f"{self.label} returned no rate: it changes no signal.")
        self.read = tuple(n for n in signals if n in read)
        self.written = tuple(n for n in signals if n in found[0])
        self._known = seen
        self.part = lambda u, s, p, cell: rates(u, p)

    def _called(self, rates: Rates, s: Columns, p: Columns, rows: Tensor) -> dict[str, Tensor]:
        """The rates in some voxels, (M,) each."""
        try:
            found = rates(s, p)
        except UnknownName as error:
            raise UnknownName(f"{self.label}: {error}") from error
        except (TypeError, ValueError, RuntimeError, IndexError) as error:
            raise checks.InputError(
                f"{self.label} failed on the columns of {rows.numel()} voxels: {error}. It is"
                " called with (s, p), each name a column with one value a voxel: use torch.exp and"
                " the like rather than math or numpy, torch.where rather than if."
            ) from error
        check_returned(found, self.label)
        out = {}
        for name, value in found.items():
            made = column(value, rows.numel(), torch.empty(0, device=rows.device).double())
            if made is None:
                shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise checks.InputError(
                    f"{self.label} returned a rate of shape {shape} for {name!r}: it must be one"
                    f" number a voxel, ({rows.numel()},)."
                )
            if not bool(torch.isfinite(made.detach()).all()):
                raise checks.InputError(
                    f"{self.label} gives a rate of {name!r} that is not a finite number, at the"
                    " first concentrations or up to some tens above them."
                )
            out[name] = made
        return out

    def _nodes(self, state: State) -> int:
        assert state.layout is not None
        return state.layout.grid.nodes

    def _constants(self, state: State) -> Lookup:
        """The constants, one number each or one for each voxel."""
        assert state.layout is not None
        owner = state.layout.grid.owner

        def find(name: str) -> Tensor:
            value = self.values[name].of_colonies(state)
            return value.index_select(0, owner) if value.dim() else value

        return Lookup(lambda: tuple(self.effect.parameters), find)

    def _voxels(self, state: State, rows: Tensor | None) -> run.CircuitCells:
        """The reactions in these voxels, (M,); None: in all."""
        if rows is None:
            rows = torch.arange(self._nodes(state), device=state.device)
        assert state.layout is not None
        volume = state.length.new_full((), state.layout.grid.voxel_volume)  # reactions may ask
        return run.CircuitCells(
            self.part, self.species, (), rows, {"volume": volume}, self._constants(state), {},
            label=self.label, compiled=self.compiled, by_torch=bool(self.by_torch),
        )  # fmt: skip

    def numerics(self, dt: float, state: State) -> list[str]:
        if self.stage != AFTER_CELLS:
            return [f"over {dt / 2:g} h, by the method that the second half lists"]
        e = self.effect
        return [
            "half of the step before cells exchange signals, half after (Strang)",
            f"stiff solver (Rodas3), each voxel in steps of its own: error at most {e.atol:g} +"
            f" {e.rtol:g}·|s| in each; nothing below 0",
            f"computed by torch: {self.by_torch}"
            if self.by_torch
            else "computed by compiled functions of its equations",
        ]

    def step(self, state: State, dt: float) -> State:
        """The state after half of dt hours of reactions."""
        layout = state.layout
        assert layout is not None
        if not self.written:
            return state
        rows = None if layout.mask is None else torch.nonzero(layout.mask).squeeze(1)
        voxels = self._voxels(state, rows)
        names = [OUTSIDE + n for n in self.species]
        before = torch.stack([state.fields[n] for n in names], 1).index_select(0, voxels.rows)
        settings = run.IntegrationSettings("rosenbrock", 1, self.effect.rtol, self.effect.atol, 1.0)
        made = run.step(voxels, before, 0.5 * dt, settings)
        changed = {}
        for k, name in enumerate(self.species):
            if name in self.written:
                old = state.fields[OUTSIDE + name]
                value = made.concentrations[:, k].to(old.dtype)
                changed[OUTSIDE + name] = value if rows is None else old.index_copy(0, rows, value)
        report = self._report(state, voxels, made, before, 0.5 * dt)
        reports = {**state.reports, self.effect.title: report}
        return state.with_fields(**changed).replace(reports=reports)

    def _report(
        self, state: State, voxels: run.CircuitCells, made: run.CircuitOutcome, before: Tensor,
        dt: float,
    ) -> MediumReactionsReport:  # fmt: skip
        assert state.layout is not None
        words: dict[int, str] = {}
        status = torch.zeros_like(state.counts)
        earlier = state.reports.get(self.effect.title)
        if self.stage == AFTER_CELLS and isinstance(earlier, MediumReactionsReport):
            words, status = dict(earlier.words), earlier.status.clone()
        if bool(made.failed.any()):
            at = torch.nonzero(made.failed).squeeze(1)
            owner = state.layout.grid.owner.index_select(0, voxels.rows.index_select(0, at))
            for k, place in zip(at.tolist(), owner.tolist(), strict=True):
                if place not in words:
                    said = failures.words(voxels, int(made.code[k]), before, k, "rosenbrock", dt)
                    words[place] = f"{self.label} in the medium: {said}"
                    status[place] = 1
        return MediumReactionsReport(status, words)
