"""Reactions of signals with one another, in every voxel of the medium."""

from __future__ import annotations

import dataclasses
import math
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
from torchfilm.effect import FIRST_REACTIONS, LAST_REACTIONS, Binding, BoundEffect, Effect
from torchfilm.resolver import snapshot
from torchfilm.signals.schedule import warn_of_means
from torchfilm.state import OUTSIDE, State
from torchfilm.tools import checks
from torchfilm.tools.backends import check_backend, why_torch
from torchfilm.tools.read_only import read_only
from torchfilm.tools.tangents import outside_checkpoints
from torchfilm.values import COLONY, Rule, checked_constants

CONSTANT = Rule(scope=COLONY, scheduled=True)
TRIED = 16  # voxels, of a trial
ONCE = "others move or find it once a step, whatever Medium.steps"
SMALL = 0.1  # see `numerics`: changes by reactions in a sub-step that keep what transport balances

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

    A stiff solver takes half of each step before transport and exchange and half after (Strang), or
    takes turns with them as often as `Medium.steps` says; reactions make nothing negative.
    Obstacles hold no signal, and nothing reacts there. The rates of reactions in a list are
    numbers, one per colony, or names of parameters. Where a voxel cannot be stepped its colony
    fails; in a colony without cells it keeps its concentrations.
    """

    rates: Rates | Sequence[Reaction]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    rtol: float = 1e-4
    atol: float = 1e-9
    backend: str | None = None

    stage = LAST_REACTIONS
    title = "medium reactions"
    may_repeat = False
    instead_of_two = "Let one function, or one list, have all reactions."
    works_on_grid = True

    def __post_init__(self) -> None:
        if not callable(self.rates):
            object.__setattr__(self, "rates", _checked_list(self.rates))
        checks.number("MediumReactions.rtol", self.rtol, above=0.0, most=0.1)
        checks.number("MediumReactions.atol", self.atol, above=0.0)
        check_backend("MediumReactions", self.backend)
        values = checked_constants("MediumReactions", self.parameters, CONSTANT)
        object.__setattr__(self, "parameters", read_only(values))

    def only_takes(self) -> tuple[str, ...]:
        """Of reactions in a list, the signals that none makes."""
        if callable(self.rates):
            return ()
        changes = [r.change() for r in self.rates]
        names = dict.fromkeys(n for change in changes for n in change)
        return tuple(OUTSIDE + n for n in names if all(c.get(n, 0) <= 0 for c in changes))

    def accuracy_knobs(self) -> Mapping[str, float]:
        return {"rtol": self.rtol}

    def accuracy_parameters(self) -> Mapping[str, str]:
        return {"rtol": f"{self.rtol:g}"}

    def with_settings(self, settings: Any) -> MediumReactions:
        return self if settings.rtol is None else dataclasses.replace(self, rtol=settings.rtol)

    def physical_values(self) -> dict[str, tuple[Any, Rule]]:
        return {n: (v, CONSTANT) for n, v in self.parameters.items()}

    def check_step(self, dt: float, divides: bool) -> None:
        warn_of_means("MediumReactions", self.parameters, dt)

    def bind(self, binding: Binding) -> tuple[BoundEffect, ...]:
        before, after = BoundReactions(self, binding), BoundReactions(self, binding)
        before.stage, before.title = FIRST_REACTIONS, "medium reactions, first half"
        after.first = before
        return before, after


def _checked_list(given: object) -> tuple[Reaction, ...]:
    """The reactions of a list, or of lists of them."""
    found: list[Reaction] = []
    for entry in given if isinstance(given, list | tuple) else ():
        if isinstance(entry, list | tuple):
            found += _checked_list(entry)
            continue
        if not isinstance(entry, Reaction):
            raise checks.input_error("MediumReactions.rates", entry, "a list of tf.Reaction")
        if callable(entry.rate):
            raise checks.input_error(
                f"MediumReactions.rates: the rate of {str(entry)!r}", entry.rate,
                "a number or the name of a parameter", "Other laws stand in a function f(s, p).",
            )  # fmt: skip
        found.append(entry)
    if not found:
        raise checks.input_error(
            "MediumReactions.rates", given, "a function f(s, p), or a list of reactions"
        )
    return tuple(found)


class BoundReactions(BoundEffect):
    """Half a step of reactions in the medium, bound to a batch."""

    effect: MediumReactions
    first: BoundReactions | None = None  # the other half, which was traced before
    acts_without_cells = False  # whether the medium changes from the start
    sub_steps, once, whole = 1, (), False  # see `medium_substeps.Reacting`

    def __init__(self, effect: MediumReactions, binding: Binding):
        super().__init__(effect, binding)
        self.label = label_of(effect.rates)
        self.read: tuple[str, ...] = ()  # signals
        self.written: tuple[str, ...] = ()
        self.part: Any = None
        self.compiled: CompiledStiff | None = None
        self.by_torch = why_torch("MediumReactions", effect.backend, binding.batch.device)
        self.rates = snapshot(effect.rates, "MediumReactions.rates", binding.batch)

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
        if self.first is not None:
            for name in ("read", "written", "part", "compiled", "by_torch"):
                setattr(self, name, getattr(self.first, name))
            return state
        if state.layout is None:
            raise checks.InputError(
                "MediumReactions are of the signals of a medium, and this scene has none: list"
                " tf.Medium(…, box=…, spacing=…)."
            )
        signals = tuple(state.signals)
        if callable(self.rates):
            self._try(self.rates, signals, state)
        else:
            self._listed(self.rates, signals)
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
        self.acts_without_cells = self._acts(state)
        return state

    @torch.no_grad()
    def _acts(self, state: State) -> bool:
        """Whether a signal changes at its first concentrations, in some voxels of all colonies."""
        rows = self._some_voxels(state)
        first = torch.stack(
            [state.fields[OUTSIDE + n].index_select(0, rows) for n in self.species], 1
        )
        changes, _ = self._voxels(state, None).changes(first, rows)
        return any(bool((rate != 0).any()) for rate in changes.values())

    def _some_voxels(self, state: State) -> Tensor:
        """A few voxels of all colonies, in none of which is an obstacle, (M,) int64."""
        assert state.layout is not None
        mask = state.layout.mask
        every = torch.arange(self._nodes(state), device=state.device)
        inside = every if mask is None else torch.nonzero(mask).squeeze(1)
        return inside[:: max(1, len(inside) // TRIED)][:TRIED]

    def _listed(self, reactions: Sequence[Reaction], signals: Sequence[str]) -> None:
        used = {n for r in reactions for n in (*r.consumes, *r.produces)}
        for name in sorted(used - {*signals}):
            what = f"a reaction in the medium has {name!r}, which is no signal"
            raise checks.InputError(unknown(what, name, list(signals)))
        self.read = tuple(n for n in signals if n in used)
        changed = {n for r in reactions for n, change in r.change().items() if change}
        self.written = tuple(n for n in signals if n in changed)
        self.part = network = build_network(reactions, self.read)
        self._known = set(network.parameters)
        network.check_parameters("MediumReactions", self.effect.parameters)

    def _try(self, rates: Rates, signals: Sequence[str], state: State) -> None:
        """Call the function on some voxels of the medium: with the concentrations at first, with
        others, and with those of one voxel alone."""
        rows = self._some_voxels(state)
        read: set[str] = set()
        seen: set[str] = set()
        first = {n: state.fields[OUTSIDE + n].index_select(0, rows) for n in signals}
        more = 10.0 ** torch.linspace(-1.0, 1.0, rows.numel(), dtype=state.dtype).to(rows.device)
        others = {n: (k + 1.0) * more + x for k, (n, x) in enumerate(first.items())}

        def called(columns: Mapping[str, Tensor], rows: Tensor) -> Mapping[str, Tensor]:
            among = torch.arange(rows.numel(), device=rows.device)
            s = Columns(columns, among, "s", read)
            p = Columns(self._constants(state), rows, "p (MediumReactions.parameters)", seen)
            return self._called(rates, s, p, rows)

        found = called(first, rows), called(others, rows)
        for name, value in found[0].items():
            if name not in signals:
                wrong = f"{self.label} returned a rate for {name!r}, which is no signal"
                raise checks.InputError(unknown(wrong, str(name), list(signals)))
            if not bool(torch.isfinite(value.detach()).all()):
                raise checks.InputError(
                    f"{self.label} gives a rate of {name!r} that is not a finite number, at the"
                    " first concentrations."
                )
        alone = called({n: x[-1:] for n, x in others.items()}, rows[-1:])
        if not alone.keys() == found[0].keys() == found[1].keys():
            raise checks.InputError(
                f"{self.label} returns rates of {', '.join(found[0])} at first, and of others at"
                " other concentrations: always return the same ones, 0 where nothing changes."
            )
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
        out, none = {}, torch.empty(0, dtype=torch.float64, device=rows.device)
        for name, value in found.items():
            made = column(value, rows.numel(), none)
            if made is None:
                shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise checks.InputError(
                    f"{self.label} returned a rate of shape {shape} for {name!r}: it must be one"
                    f" number a voxel, ({rows.numel()},)."
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
        grid = state.layout.grid
        # what reactions in a list ask of their cell
        cell = {
            "volume": state.length.new_full((), grid.voxel_volume),
            "colony": state.colony_id.index_select(0, grid.owner),
        }
        return run.CircuitCells(
            self.part, self.species, (), rows, cell, self._constants(state), {},
            label=self.label, compiled=self.compiled, by_torch=bool(self.by_torch),
        )  # fmt: skip

    def numerics(self, dt: float, state: State) -> list[str]:
        if self.stage != LAST_REACTIONS:
            half = dt / 2 / self.sub_steps
            return [f"over {half:g} h, by the method that the second half lists"]
        e, rate, sub_steps = self.effect, self._fastest(state), self.sub_steps
        changed = rate * dt / sub_steps
        # rounding of differences asks for no step more
        enough = math.ceil(0.999 * sub_steps * changed / SMALL) if changed < math.inf else 1
        hint = f": Medium(steps={enough})" if enough > sub_steps and not self.whole else ""
        what, over = ("sub-step", dt / sub_steps) if sub_steps > 1 else ("step", dt)
        return [
            f"{sub_steps} sub-steps of {over:g} h, in turns with transport, timed with it (Strang)"
            if sub_steps > 1
            else "half of the step before transport and exchange, half after (Strang)",
            *([f"{', '.join(self.once)}: {ONCE}"] if self.once else []),
            f"fastest rate at these concentrations {rate:.2g}/h, {changed:.2g} in a {what}: what"
            f" transport balances, as in patterns and profiles, needs {SMALL:g} or less{hint}",
            f"stiff solver (Rodas3), each voxel in steps of its own: error at most {e.atol:g} +"
            f" {e.rtol:g}·|s| in each; nothing below 0",
            f"computed by torch: {self.by_torch}"
            if self.by_torch
            else "computed by compiled functions of its equations",
        ]

    @torch.no_grad()
    def _fastest(self, state: State) -> float:
        """The largest rate of relaxation or growth by reactions alone, 1/h, in a few voxels: of the
        eigenvalues of their linearised rates, the largest in size."""
        rows = self._some_voxels(state)
        columns = [state.fields[OUTSIDE + n].index_select(0, rows) for n in self.species]
        u, voxels = torch.stack(columns, 1).double(), self._voxels(state, rows)
        every = torch.arange(len(rows), device=rows.device)
        # by differences: derivatives of the columns' powers are 0 at a base of 0
        near, begin = 1e-6 * (u + u.amax(0) + self.effect.atol), voxels.rates(u, every)
        change = torch.diag_embed(near).unbind(1)
        slopes = torch.stack(
            [(voxels.rates(u + d, every) - begin) / near[:, k, None] for k, d in enumerate(change)],
            2,
        )
        if not bool(torch.isfinite(slopes).all()):  # as at the end of a root's range
            return math.inf
        return float(torch.linalg.eigvals(slopes).abs().max())

    def step(self, state: State, dt: float) -> State:
        """The state after half of a sub-step of reactions."""
        return self.react(state, 0.5 * dt / self.sub_steps)

    def react(self, state: State, hours: float) -> State:
        """The state after reactions alone."""
        layout = state.layout
        assert layout is not None
        if not self.written:
            return state
        rows = None if layout.mask is None else torch.nonzero(layout.mask).squeeze(1)
        voxels = self._voxels(state, rows)
        before = torch.stack([state.fields[OUTSIDE + n] for n in self.species], 1)
        before = before if rows is None else before.index_select(0, rows)
        settings = run.IntegrationSettings("rosenbrock", 1, self.effect.rtol, self.effect.atol, 1.0)
        made = run.step(voxels, before, hours, settings)
        changed = {}
        for k, name in enumerate(self.species):
            if name in self.written:
                old = state.fields[OUTSIDE + name]
                value = torch.where(made.failed, before[:, k], made.concentrations[:, k])
                value = value.to(old.dtype).contiguous()
                changed[OUTSIDE + name] = value if rows is None else old.index_copy(0, rows, value)
        report = self._report(state, voxels, made, before, hours)
        reports = {**state.reports, self.effect.title: report}
        return state.with_fields(**changed).replace(reports=reports)

    def _report(
        self, state: State, voxels: run.CircuitCells, made: run.CircuitOutcome, before: Tensor,
        dt: float,
    ) -> MediumReactionsReport:  # fmt: skip
        assert state.layout is not None
        words: dict[int, str] = {}
        status = torch.zeros_like(state.counts)
        earlier = state.reports.get(self.effect.title)  # of the same step
        if isinstance(earlier, MediumReactionsReport):
            words, status = dict(earlier.words), earlier.status.clone()
        if bool(made.failed.any()):
            at = torch.nonzero(made.failed).squeeze(1)
            owner = state.layout.grid.owner.index_select(0, voxels.rows.index_select(0, at))
            alive = (state.counts > 0).tolist()
            for k, place in zip(at.tolist(), owner.tolist(), strict=True):
                if place not in words and alive[place]:
                    said = failures.words(voxels, int(made.code[k]), before, k, "rosenbrock", dt)
                    where = state.layout.grid.centres()[int(voxels.rows[k])].tolist()
                    at_place = ", ".join(f"{x:.4g}" for x in where)
                    words[place] = f"{self.label} in the medium, at ({at_place}) µm: {said}"
                    status[place] = 1
        return MediumReactionsReport(status, words)
