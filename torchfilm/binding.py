"""Binding a scene to a batch of colonies, or to the state of one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfilm import binding_checks
from torchfilm.effects.bound_circuit import BoundCircuit
from torchfilm.effects.bound_rules import BoundRules
from torchfilm.effects.circuit import Circuit
from torchfilm.effects.medium import Medium
from torchfilm.founders import FirstCells, checked_streams
from torchfilm.initial_cells import Cells
from torchfilm.model import Model
from torchfilm.resolver import BoundBatch
from torchfilm.state import Field, State
from torchfilm.tools import checks, units
from torchfilm.tools.threads import after_fork, one_torch_thread

if TYPE_CHECKING:
    from torchfilm.scene import Scene


@one_torch_thread()
def bind(
    scene: Scene,
    colonies: int | None = None,
    *,
    seed: int = 0,
    streams: Sequence[int] | Tensor | None = None,
    cells: Cells | None = None,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
    state: State | None = None,
    per_colony: bool = False,
    only: Collection[int] | None = None,
    check_first: bool = True,
) -> Model:
    """As `Scene.bind`. only: bind only the effects at these places of the scene. check_first:
    check whether the first cells may be where they are; not needed where a file replaces them."""
    after_fork()
    if state is not None:
        return _bind_to_state(scene, state, only)
    if cells is not None and not isinstance(cells, Cells):
        hint = "A state goes on by bind(state=…)." if isinstance(cells, State) else ""
        raise checks.input_error("cells", cells, "a tf.Cells", hint)
    founders = cells if cells is not None else scene.founders
    count = _count(scene, colonies, founders, only)
    seed = checks.integer("seed", seed, least=0, most=2**63 - 1)
    checks.float_type("dtype", dtype)
    if founders.dim != scene.dim:
        raise checks.input_error("cells", f"{founders.dim}-D", f"{scene.dim}-D, as the scene is")
    start = FirstCells(count, seed, checked_streams(streams, count), scene, cells)
    batch = BoundBatch(count, dtype, checks.device(device), _types(start.cells), per_colony)
    model = Model(scene, batch, start, only)
    first = model.trace(None)
    if only is None:  # a part of a scene lacks what the rest of it declares
        binding_checks.check_names(model.effects, scene.declared_by, first)
    model.check_form(first)
    if check_first:
        for effect in model.effects:
            effect.check(first)
        model.check_values(first)
    if check_first and only is None:
        binding_checks.warn_of_idle(model.effects, first)
        binding_checks.warn_of_other_names(first, founders.extra)
    binding_checks.warn_of_births(model.effects)
    return model


def _bind_to_state(scene: Scene, state: State, only: Collection[int] | None) -> Model:
    model = _for_batch_of(scene, state, only)
    model.check(state)
    # what it can be tried on: cells that there are, or else the founders
    tried = model.trace(model.opened(state, 0.0) if state.cells else None)
    if only is None:
        there = (*scene.declared_by, *state.fields)
        binding_checks.check_names(model.effects, there, tried)
        binding_checks.warn_of_kept(model.effects, state, scene.founders.extra)
    return model


def _for_batch_of(scene: Scene, state: State, only: Collection[int] | None) -> Model:
    """A model for the colonies of a state."""
    if not isinstance(state, State):
        raise checks.input_error("state", state, "a State, such as scene.bind(colonies=8).start()")
    count = max(scene.fixed_colonies if only is None else 1, int(state.colony_id.max()) + 1)
    # what lists of numbers mean was settled when the state was made
    batch = BoundBatch(count, state.dtype, state.device, _types(scene.founders), per_colony=True)
    # by colony id: the places may be others
    streams = torch.arange(count, device=state.device).index_copy(0, state.colony_id, state.stream)
    return Model(scene, batch, FirstCells(count, state.seed, streams, scene, None), only)


@one_torch_thread()
def taken_over(scene: Scene, state: State) -> State:
    """See `Scene.take_over`."""
    after_fork()
    model = _for_batch_of(scene, state, None)
    if state.dim != model.dim:
        raise checks.input_error("state", f"{state.dim}-D", f"{model.dim}-D, as the scene is")
    if state.span is not None:
        raise checks.InputError("take_over takes a state between two steps, not within one.")
    media = [e for e in model.effects if isinstance(e.effect, Medium)]
    signals = {n for e in scene.effects if isinstance(e, Medium) for n in e.signals}
    if media and state.layout is not None and signals != state.signals.keys():
        raise checks.input_error(
            "take_over(state)", f"a state with a medium of {', '.join(sorted(state.signals))}",
            f"one without a medium, or with that of the scene, of {', '.join(sorted(signals))}",
            "Name all signals in the Medium of both scenes.",
        )  # fmt: skip
    made = state.replace(births=(), ended=(), reports={}, space=model.space)
    new = set()
    for medium in media if state.layout is None else ():
        made = medium.lay(made)
    for name, field in model.first_fields.items():
        if not _means_the_same(field, made):
            new.add(name)
            made = _declared_anew(made, field)
    for circuit in (e.effect for e in model.effects if isinstance(e.effect, Circuit)):
        # no circuit may have kept them as cells grew
        made = _declared_anew(made, model.first_fields[circuit.volume_field])
    # names that rules are the first to set
    model.trace(model.opened(made, 0.0) if made.cells else None)
    own = lambda e: {f.name for f in e.declares()}
    # cells may be beyond a medium, or the faces of a space, that others have grown without
    placed = [e for e in model.effects if state.space != model.space and e.effect.periodic_space]
    placed += media
    strange = [e for e in model.effects if e in placed or not new.isdisjoint(own(e))]
    for effect in model.effects:
        follows = isinstance(effect, BoundRules | BoundCircuit) or effect.moves_signals
        if effect in strange or follows:
            made = effect.ready(made)
    model.check(made)
    for effect in strange:
        effect.check(made)
    return made


def _declared_anew(state: State, field: Field) -> State:
    """A state in which a field has its first value, whatever it had."""
    others = {name: x for name, x in state.fields.items() if name != field.name}
    return state.replace(fields=others).declare(field)


def _means_the_same(wanted: Field, state: State) -> bool:
    """Whether a field of a state is what a scene means by it: a length at which cells divide is no
    added length."""
    about = lambda field: (field.meaning, field.scope, field.shape)
    there = state.declared.get(wanted.name)
    if there is None or about(wanted) != about(there) or units.differ(wanted.unit, there.unit):
        return False
    return state.fields[wanted.name].dtype == (wanted.dtype or state.dtype)


def _count(
    scene: Scene, colonies: int | None, founders: Cells, only: Collection[int] | None
) -> int:
    fixed = 1 if only is not None else scene.fixed_colonies
    if colonies is None:
        return max(fixed, founders.colonies)
    return founders.batch_size(checks.integer("colonies", colonies, least=1))


def _types(founders: Cells) -> tuple[int, ...]:
    return () if founders.cell_type is None else tuple(sorted({int(k) for k in founders.cell_type}))
