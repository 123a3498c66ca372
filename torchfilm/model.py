"""A scene bound to a batch of colonies: all that is decided once, and the step that decides
nothing.

    model = scene.bind(colonies=64, seed=0)     # values resolved, circuits and rules traced
    state = model.start()
    state = model.step(state, dt)               # each effect in turn

A model also says what depends on what: who drives whom, and which effects grow the colonies and can
be recorded once (`recorded`), while the others only follow (`following`).
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch

from torchfilm import binding_checks
from torchfilm.arrivals import with_arrivals
from torchfilm.cell_types import kept_by_type
from torchfilm.cpu_parts import CpuTwins, OnCpu
from torchfilm.effect import BUILT_IN, DIVISION, FLAGGED_DIVISION, Binding, BoundEffect, is_own
from torchfilm.founders import FirstCells
from torchfilm.initial_cells import Cells
from torchfilm.joined_step import JoinedStep, joined
from torchfilm.resolver import BoundBatch
from torchfilm.state import CELL, PER_CELL, Field, State
from torchfilm.tools import checks, displays
from torchfilm.tools.hashing import digest
from torchfilm.tools.row_checks import Rows, check_declared, check_geometry
from torchfilm.tools.threads import after_fork, one_torch_thread
from torchfilm.tools.times import later
from torchfilm.tools.timing import Timings
from torchfilm.tools.warn_once import once
from torchfilm.turns import Part, in_turns

if TYPE_CHECKING:
    from torchfilm.scene import Scene


class Model:
    """A scene bound to a batch. Made by `scene.bind(…)`.

    effects: what acts in a step, in order. fields: every field of its states by name. batch:
    colonies, dtype, device. seed: of its first state. dt: the scene's step, h. `start` gives the
    first state, `step` the next one. A model holds no state of a run: it may run many states, one
    after the other or in turn. Values are as they were when the scene was bound; bind again after
    an optimiser has changed a parameter.
    """

    def __init__(
        self, scene: Scene, batch: BoundBatch, start: FirstCells, only: Collection[int] | None
    ):
        self.scene, self.batch, self.dt, self.dim = scene, batch, scene.dt, scene.dim
        self.begin, self.seed = start, start.seed
        late = any(e.divides_at_threshold for e in scene.effects)
        stage = DIVISION if late else FLAGGED_DIVISION
        binding = Binding(batch, scene.dt, scene.dim, scene.declared_by, stage)
        bound: list[BoundEffect] = []
        # a model that was bound without gradients may be stepped with them
        with torch.inference_mode(False), torch.enable_grad():
            for place, effect in enumerate(scene.effects):
                if only is not None and place not in only:
                    continue
                for part in effect.bind(binding):
                    part.place = place
                    bound.append(part)
        self.effects: tuple[BoundEffect, ...] = tuple(sorted(bound, key=lambda e: e.stage))
        self._said: set[str] = set()  # what steps have warned of
        self.space = scene.space
        self.twins: CpuTwins | None = None  # of its effects, on a GPU

    # --- running -------------------------------------------------------------------------

    @one_torch_thread()
    def start(self, seed: int | None = None) -> State:
        """The first state: founders, all fields at their first values, grids laid. seed: of what is
        drawn; by default that of the model."""
        begin = self.begin
        if seed is not None:
            seed = checks.integer("seed", seed, least=0, most=2**63 - 1)
            begin = replace(begin, seed=seed)
        state = self._laid(begin)
        for effect in self.effects:
            state = effect.ready(state)
        # apart from the model's own numbers, so that an edit in place changes no other start
        return state.replace(fields={n: x.clone() for n, x in state.fields.items()})

    def step(self, state: State, dt: float | None = None, timings: Timings | None = None) -> State:
        """The state dt hours later (by default the scene's step): each effect in turn."""
        after_fork()
        if dt not in (None, self.dt):  # a check takes as long as a small effect
            checks.number("dt", dt, least=0.0)
        dt = self.dt if dt is None else dt
        state = self.opened(state, dt)
        # torch's threads are set once a step, not once an effect
        alone = one_torch_thread() if self._by_kernels else nullcontext()
        with alone, once(self._said) as self._said:
            for effect in self._joined_parts:
                state = effect.run_step(state, dt, timings)
        return advanced(state, dt)

    def add(self, state: State, cells: Cells, colonies: Rows | None = None) -> State:
        """The state with further cells, which come from outside, as settlers do.

        cells: as founders are given; to each of `colonies`, by their places, comes a copy of all
        (default: to every colony). Or they have colony numbers, the places of their own. They have
        new numbers, no parent, and first values as founders have. Contacts push apart what lies in
        one another. Raises InputError for cells that may not be where they are, lack a column that
        the founders brought, or bring one that the state lacks.
        """
        return with_arrivals(self, state, cells, colonies)

    def opened(self, state: State, dt: float) -> State:
        """The state as a step of dt hours of this model begins, also where another model made
        it."""
        binding_checks.check_fits(state, self, self.first_fields)
        declared = {**state.declared, **self.first_fields}
        new = {"declared": declared, "space": self.space, "span": (state.time, state.time + dt)}
        # what came since the last step, the next one is told of
        come = tuple(x for x in state.arrived if x.step == state.step)
        state = state.replace(births=(), ended=(), arrived=come, reports={}, **new)
        for effect in self._openers:
            state = effect.opened(state)
        return state

    @cached_property
    def step_parts(self) -> list[Part | OnCpu]:
        """The effects in the order of a step, some of them in turns."""
        if self.twins is not None:
            return self.twins.parts
        return [*in_turns(self.effects)]

    @cached_property
    def _joined_parts(self) -> list[Part | JoinedStep | OnCpu]:
        """What a step runs: these, some of them joined."""
        if self.twins is not None:
            return self.twins.joined_parts
        return [*joined(in_turns(self.effects))]

    @cached_property
    def _openers(self) -> list[BoundEffect]:
        """The effects that do something as a step begins."""
        return [e for e in self.effects if type(e).opened is not BoundEffect.opened]

    @cached_property
    def _by_kernels(self) -> bool:
        """Whether kernels compute some effect."""
        on_cpu = self.batch.device.type == "cpu"
        return self.twins is not None or (on_cpu and any(e.by_kernels for e in self.effects))

    def _laid(self, start: FirstCells) -> State:
        state = start.cells.state(start.colonies, start.seed, self.batch.device, self.batch.dtype)
        state = state.replace(space=self.space)
        if start.streams is not None:
            state = state.replace(stream=start.streams.to(self.batch.device))
        for effect in self.effects:
            state = effect.lay(state)
        for field in self.first_fields.values():
            state = (
                _with_given(state, field) if field.name in state.fields else state.declare(field)
            )
        return state

    @cached_property
    def first_fields(self) -> dict[str, Field]:
        """Fields that the effects declare, those declared alike once."""
        found: dict[str, Field] = {}
        # first values of others may go by thresholds of division, which comes late in a step
        for effect in sorted(self.effects, key=lambda e: e.stage != DIVISION):
            for field in effect.declares():
                found.setdefault(field.name, field)
        # first values of other fields may go by type
        return {n: found[n] for n in sorted(found, key=lambda n: n != "cell_type")}

    @torch.no_grad()
    def trace(self, state: State | None) -> State:
        """Let each effect find out, once, what can only be found by trying: names that rules and
        circuits read and write.

        state: of a run that is to be continued, or None for the first state. Returns the state
        tried on, made ready.
        """
        tried = self._laid(self.begin) if state is None else state
        for effect in self.effects:
            tried = effect.trace(tried)
        by_type = kept_by_type(self.effects)
        for effect in self.effects:  # now that it is known what rules write
            effect.check_others(self.effects)
            if not is_own(effect.effect) or {"cell_type", "cells"} & {*effect.writes()}:
                effect.by_type = by_type
        self.twins = CpuTwins.of_model(self, self.begin, tried)
        return tried

    # --- checks --------------------------------------------------------------------------

    def check(self, state: State) -> None:
        """Raise InputError if this is not a state of this model, or has values with which none can
        go on."""
        self.check_form(state)
        self.check_values(state)

    def check_form(self, state: State) -> None:
        """Raise InputError if this is not a state of this model, whatever its values."""
        if state.dim != self.dim:
            raise checks.input_error("state", f"{state.dim}-D", f"{self.dim}-D, as the scene is")
        there = checks.same_device(state.device, self.batch.device)
        if state.dtype != self.batch.dtype or not there:
            given, hint = f"{state.dtype} on {state.device}", "Bind the scene to the state:"
            raise checks.input_error(
                "state", given, f"{self.batch.dtype} on {self.batch.device}, as the model is",
                f"{hint} scene.bind(state=state).",
            )  # fmt: skip
        check_declared(state.fields, state.declared)
        columns = {name: getattr(state, name) for name in PER_CELL}
        check_geometry(columns, state.colonies, state.dim, state.dtype)
        state.check_fields()
        highest = int(state.colony_id.max())
        if highest >= self.batch.colonies and (several := self.scene.per_colony()):
            path, tensor = several[0]
            raise checks.InputError(
                f"{path} has {tensor.numel()} values, but the batch has a colony number {highest}:"
                " the state is not of this scene."
            )
        for effect in self.effects:
            if not is_own(effect.effect):
                _check_meanings(effect, state)
            for name in (*effect.effect.needs(), *(f.name for f in effect.declares())):
                if name not in state.fields and name not in BUILT_IN:
                    hint = "Make the state with this scene: scene.bind(…).start()."
                    if name in self.first_fields:
                        hint = "Give it first values: scene.take_over(state)."
                    raise checks.InputError(
                        f"{effect.title} needs the field {name!r}, which this state lacks. {hint}"
                    )

    def check_values(self, state: State) -> None:
        """Raise InputError for values with which no run can go on."""
        own = [e for e in self.effects if is_own(e.effect)]
        set_by = lambda e: state.fields if e.effect.writes_anything else e.writes()
        free = {name for e in own for name in set_by(e)}
        for effect in self.effects:
            effect.check_given(state, free)

    def check_step(self, dt: float) -> None:
        """Raise InputError for a step that no effect can follow."""
        divides = any("divide_flag" in e.writes() for e in self.effects)
        for effect in self.effects:
            effect.check_step(dt, divides)
        if divides:
            binding_checks.warn_of_lost_genes(self.effects)

    def check_end(self, state: State, cells: int | None, until: float | None = None) -> None:
        """Raise InputError, or warn, if no run from this state would come to `cells` cells; warn if
        a run to a time (None) has no growth that its division waits for, or would by `until`, h,
        have more cells than any run comes to."""
        if cells is None:
            binding_checks.warn_of_no_growth(self.effects)
            if until is not None:
                binding_checks.warn_of_too_many(self.effects, state, until)
        else:
            binding_checks.check_end(self.effects, state, cells)

    def numerics(self, effect: BoundEffect, state: State) -> list[str]:
        """By which methods an effect of this model is computed where no derivative is wanted, in
        lines."""
        twin = None if self.twins is None else self.twins.twin(effect)
        if twin is None:
            return effect.numerics(self.dt, state)
        return twin.numerics(self.dt, state.to("cpu"))

    # --- what depends on what ------------------------------------------------------------

    def couplings(self) -> list[tuple[str, str, str]]:
        """Who drives whom: (writer, name, reader) for every name that one effect writes and another
        reads."""
        return [
            (w.title, name, r.title)
            for w in self.effects
            for r in self.effects
            if w.title != r.title
            for name in w.writes()
            if name in r.reads()
        ]

    def drives(self) -> list[str]:
        """The couplings in words: "growth -> mechanics: length, elongation"; "nobody" where there
        are none."""
        drives: dict[tuple[str, str], list[str]] = {}
        for writer, name, reader in self.couplings():
            drives.setdefault((writer, reader), []).append(name)
        lines = [
            f"{w} -> {r}: {', '.join(dict.fromkeys(names))}" for (w, r), names in drives.items()
        ]
        return lines or ["nobody"]

    def describe(self) -> str:
        """What is simulated, in order, with what each effect reads, writes and declares, and who
        drives whom."""
        lines = [self.scene.headline]
        for effect in self.effects:
            lines.append(f"  {effect.title:<10} {effect.summary()}")
            lines.append(f"             reads  {', '.join(effect.reads()) or '-'}")
            lines.append(f"             writes {', '.join(effect.writes()) or '-'}")
            for f in effect.declares():
                about = f"({f.unit or '1'}, per {f.scope}; daughters: {f.at_division}): {f.meaning}"
                lines.append(f"             field  {f.name} {about}")
        lines += ["  who drives whom:", *(f"    {line}" for line in self.drives())]
        return "\n".join(lines)

    @cached_property
    def recorded(self) -> tuple[int, ...]:
        """Which effects, by their places in the scene, move, grow, divide or remove cells, or
        change or provide what those use."""
        everything = {e.place for e in self.effects}
        if any(e.effect.writes_anything for e in self.effects):
            return tuple(sorted(everything))
        reads, writes, declares = self._by_place()
        growth = {k for k in everything if writes[k] & set(BUILT_IN)}
        while True:
            fields = [f for k in growth for f in declares[k]]
            used = {f.name for f in fields}.union(*(reads[k] | writes[k] for k in growth))
            more = {k for k in everything if writes[k] & used} - growth
            # what is declared has a first value: who uses a field that it does not declare needs it
            lacked = {k: {f.name for f in declares[k] if f not in fields} for k in everything}
            more = more or {k for k in everything if lacked[k] & used} - growth
            if not more:
                return tuple(sorted(growth))
            growth |= more

    @property
    def following(self) -> tuple[int, ...]:
        """Which effects, by their places in the scene, act back on nothing of that."""
        return tuple(sorted({e.place for e in self.effects} - set(self.recorded)))

    def _by_place(self) -> tuple[dict[int, set[str]], dict[int, set[str]], dict[int, list[Field]]]:
        """What the effects at each place of the scene read, write and declare."""
        reads: dict[int, set[str]] = {e.place: set() for e in self.effects}
        writes: dict[int, set[str]] = {e.place: set() for e in self.effects}
        declares: dict[int, list[Field]] = {e.place: [] for e in self.effects}
        for e in self.effects:
            reads[e.place] |= set(e.reads())
            writes[e.place] |= set(e.writes())
            declares[e.place] += e.declares()
        return reads, writes, declares

    @cached_property
    def growth_fingerprint(self) -> str:
        """A word that is equal for models that grow alike, and for no others."""
        recorded = [self.scene.effects[k] for k in self.recorded]
        return digest(recorded, self.begin.given or self.scene.drawn_from, self.dim)

    @cached_property
    def why_not_replayable(self) -> str:
        """Why growth cannot be recorded once for all designs of this scene, or "" if it can."""
        return binding_checks.why_not_replayable(self)

    def __repr__(self) -> str:
        b = self.batch
        colonies = displays.counted(b.colonies, "colony", "colonies")
        return f"Model({self.scene.name!r}, {colonies}, {str(b.dtype)[6:]} on {b.device})"


def advanced(state: State, dt: float) -> State:
    """The state with its fields checked and its step counted; evenly, so that time gathers no
    rounding."""
    state.check_fields()
    time = later(state.time, state.step, dt)
    return state.replace(step=state.step + 1, time=time, dt=dt, span=None)


def _check_meanings(effect: BoundEffect, state: State) -> None:
    """Raise InputError for a field of a state that is another quantity to the effect: a length at
    which cells divide is no added length."""
    kept = [*effect.effect.keeps().values()]
    for field in effect.declares():
        there = state.declared.get(field.name)
        if there is not None and binding_checks.another_quantity(there, field, kept):
            about = lambda f: f"{f.meaning} ({f.unit or '1'}, per {f.scope})"
            raise checks.InputError(
                f"{field.name!r} of this state means {about(there)}; to {effect.title} of this"
                f" scene it means {about(field)}. Give it first values: scene.take_over(state)."
            )


def _with_given(state: State, wanted: Field) -> State:
    """A field that came with the first cells, under the effect's own declaration: its dtype and
    rule at division."""
    values = state.fields[wanted.name]
    shape = (state.cells, *wanted.shape)
    if wanted.scope != CELL or tuple(values.shape) != shape:
        shown, rule = f"values of shape {tuple(values.shape)}", f"left out, or of shape {shape}"
        raise checks.input_error(f"cells column {wanted.name}", shown, rule)
    declared = state.replace(declared={**state.declared, wanted.name: wanted})
    return declared.with_fields(**{wanted.name: values.to(wanted.dtype or state.dtype)})
