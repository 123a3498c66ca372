"""The values of a signal on the voxels of a state: given, drawn, and what they become where no cell
is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchfilm.effects.scaled import scaled
from torchfilm.signals.boundary_conditions import BoundaryConditions
from torchfilm.signals.grid import GridBatch
from torchfilm.signals.layout import Layout
from torchfilm.signals.schedule import ROUNDING, Schedule, each_value
from torchfilm.state import State
from torchfilm.tools import checks, random
from torchfilm.tools.warn_once import warn
from torchfilm.values import Distribution, PerColony, numbers

if TYPE_CHECKING:
    from torchfilm.effects.signal import Flow, OnGrid, Signal

Corner = Sequence[float]
BITS = 21  # of the number of a voxel along an axis, in its key


def warn_of_faces(
    boundary: BoundaryConditions | None, outside: str, signals: Mapping[str, Signal]
) -> None:
    """Warn where a face of the medium supplies several signals with one value, and where cells
    beyond a face that supplies a signal find none of it in the reservoir."""
    several = [name for name, signal in signals.items() if signal.boundary is None]
    for axis, face in _supplying(boundary) if len(several) > 1 else ():
        warn(
            f"{face} along {axis} in Medium.boundary has one value for {' and '.join(several)}:"
            " each has it there. Give faces to the signal that they supply,"
            f" {several[0]}=tf.Signal(…, boundary=…), or to each."
        )
    for name, signal in signals.items() if outside == "reservoir" else ():
        faces = _supplying(signal.boundary or boundary)
        if faces and not any(_supplies(x) for x in each_value(signal.reservoir)):
            axis, face = faces[0]
            warn(
                f"{face} along {axis} supplies {name}, and cells beyond the box find a reservoir"
                f" without it: write {name}=tf.Signal(…, reservoir=…), or make the box larger."
            )


def _supplying(boundary: BoundaryConditions | None) -> list[tuple[str, str]]:
    """The axes and kinds of the faces with a value other than 0."""
    each = () if boundary is None else zip("xyz", boundary.pairs, strict=True)
    faces = [(axis, face) for axis, pair in each for face in pair]
    found = (
        (axis, type(face).__name__)
        for axis, face in faces
        if any(_supplies(x) for x in each_value(face.outside_value()))
    )
    return [*dict.fromkeys(found)]


def _supplies(value: Any) -> bool:
    return bool((numbers(value) != 0).any())


def on_grid(
    given: OnGrid | Distribution, name: str, what: str, state: State, corner: Corner
) -> Tensor:
    """The initial, source or decay of a signal, as it is given, on every voxel, (nodes,); 0 in
    obstacles. name, what: of the signal and of the value. corner: of the medium's box, from which
    voxels are counted where their values are drawn."""
    layout = state.layout
    assert layout is not None
    if isinstance(given, Distribution):
        value = _drawn(given, name, what, state, corner)
    elif callable(given):
        label = f"{what}(positions) of the signal {name!r}"
        try:
            found = given(layout.grid.centres())
        except TypeError as error:
            raise checks.InputError(
                f"{label} cannot be called: {error}. It takes positions (nodes, 3), µm, alone. What"
                " changes in time is a tf.Schedule of functions."
            ) from error
        if not isinstance(found, Tensor) or found.shape != (layout.grid.nodes,):
            shown = tuple(found.shape) if isinstance(found, Tensor) else found
            raise checks.input_error(
                label,
                shown,
                f"a tensor of shape ({layout.grid.nodes},), one number for each position",
            )
        each = lambda x: _of_colonies(x, state).expand(state.colonies)[layout.grid.owner]
        found = scaled(given, found, each)
        bad = torch.nonzero(~((found >= 0) & (found < torch.inf))).squeeze(1)
        if bad.numel():
            where = [round(x, 3) for x in layout.grid.centres()[bad[0]].tolist()]
            raise checks.input_error(
                label,
                float(found[bad[0]]),
                "finite and at least 0 everywhere",
                f"It is not at {where} µm and {bad.numel() - 1} more positions.",
            )
        value = found.to(dtype=state.dtype, device=state.device)
        if not bool(torch.isfinite(value).all()):
            most = f"at most {torch.finfo(state.dtype).max:.2g} with {str(state.dtype)[6:]}"
            raise checks.input_error(label, float(found.max()), most)
    else:
        value = _of_colonies(given, state).expand(state.colonies).index_select(0, layout.grid.owner)
    return value if layout.mask is None else value * layout.mask


def _of_colonies(given: checks.Value, state: State) -> Tensor:
    """A value as a (B,) or 0-dim tensor of the state's dtype; one value per colony is taken by
    colony id."""
    if not isinstance(given, Tensor):
        return torch.tensor(given, dtype=state.dtype, device=state.device)
    value = given.to(dtype=state.dtype, device=state.device)
    return value if value.dim() == 0 else value.index_select(0, state.colony_id)


@dataclass(frozen=True, eq=False)
class _Voxels:
    """The voxels of a state in place of its cells, for a distribution that draws for them. Those of
    a grid that grows keep their draws: they are counted from a corner of the medium's box."""

    state: State
    corner: Corner

    def uniform(self, rows: Tensor, purpose: str) -> Tensor:
        """As `State.uniform`."""
        return self._law(random.uniform, rows, purpose)

    def normal(self, rows: Tensor, purpose: str) -> Tensor:
        """As `State.normal`."""
        return self._law(random.normal, rows, purpose)

    def _law(self, law: Any, rows: Tensor, purpose: str) -> Tensor:
        assert self.state.layout is not None
        grid = self.state.layout.grid
        first = grid.centres().new_tensor([*self.corner])
        place = torch.floor((grid.centres() - first) / grid.step).long() + (1 << (BITS - 1))
        key = (place[:, 0] << (2 * BITS)) | (place[:, 1] << BITS) | place[:, 2]
        stream = self.state.stream.index_select(0, grid.owner)
        chosen = (x.index_select(0, rows) for x in (stream, key))
        return law(self.state.seed, *chosen, 0, purpose, self.state.dtype)


@dataclass(frozen=True, eq=False)
class _OfVoxels:
    """A parameter of a distribution, a number or one per colony, as a distribution takes it."""

    given: float | Tensor

    def of_rows(self, voxels: _Voxels, rows: Tensor) -> Tensor:
        """(M,) for the voxels `rows`."""
        state = voxels.state
        assert state.layout is not None
        owner = state.layout.grid.owner.index_select(0, rows)
        return _of_colonies(self.given, state).expand(state.colonies).index_select(0, owner)


def _drawn(given: Distribution, name: str, what: str, state: State, corner: Corner) -> Tensor:
    """One draw for each voxel, (nodes,), the same whatever the batch."""
    assert state.layout is not None
    rows = torch.arange(state.layout.grid.nodes, device=state.device)
    plain: Any = lambda x: x.values if isinstance(x, PerColony) else x
    each = {n: _OfVoxels(plain(getattr(given, n))) for n in given.parameters}
    values: Any = SimpleNamespace(**each)
    voxels: Any = _Voxels(state, corner)
    return given.draw(voxels, rows, f"{what} of the signal {name}", values)


def without_cells(signal: Signal, name: str, state: State, corner: Corner, time: float) -> Tensor:
    """What a signal has become on every voxel at a time, h, (nodes,), where nothing moved it and no
    cell was near: the solution of dc/dt = source − decay · c from its first values. signal: with
    its schedule, if its source has one."""
    value = on_grid(signal.initial, name, "initial", state, corner)
    rate = on_grid(signal.decay, name, "decay", state, corner)
    source = signal.source
    given = source if isinstance(source, Schedule) else Schedule({0: source})
    each = [on_grid(x, name, "source", state, corner) for x in given.values.values()]
    over = lambda span: _over(given.times, each, rate, value, span)
    if given.period is None:
        kept, made = over(time)
        return value * kept + made
    period, n = given.period, int((time + ROUNDING * max(1.0, time)) / given.period)
    kept, made = over(period)
    rest_kept, rest_made = over(max(0.0, time - n * period))
    # n periods one after the other: c → aⁿ c + b (1 + a + … + aⁿ⁻¹), a = exp(−rate · period)
    some = torch.where(rate > 0, rate, 1.0)
    sums = torch.expm1(-some * period * n) / torch.expm1(-some * period)
    few = n - 0.5 * n * (n - 1) * period * rate  # where the rate is 0, with its derivative
    again = torch.where(rate > 0, sums, few)
    return (value * kept**n + made * again) * rest_kept + rest_made


def later(
    value: Tensor, source: Tensor, decay: Any, name: str, state: State, corner: Corner, hours: float
) -> Tensor:
    """What some values on every voxel, (nodes,), have become after some hours with one source,
    (nodes,), where nothing else acts on them."""
    rate = on_grid(decay, name, "decay", state, corner)
    kept, made = _over([0.0], [source], rate, value, hours)
    return value * kept + made


def _over(
    times: Sequence[float], sources: Sequence[Tensor], rate: Tensor, like: Tensor, span: float
) -> tuple[Tensor, Tensor]:
    """What is left of one, and what the sources have made, after `span` hours from the first of
    their times on."""
    kept, made = torch.ones_like(like), torch.zeros_like(like)
    some = torch.where(rate > 0, rate, 1.0)  # so that no derivative is NaN either
    for begin, end, source in zip(times, (*times[1:], span), sources, strict=True):
        hours = min(end, span) - begin
        if hours <= 0:
            continue
        part = torch.exp(-rate * hours)
        few = hours - 0.5 * rate * hours**2  # where the rate is 0, with its derivative
        lasted = torch.where(rate > 0, -torch.expm1(-some * hours) / some, few)
        kept, made = kept * part, made * part + source * lasted
    return kept, made


def velocity_of(flow: Flow, layout: Layout, batch: GridBatch, own: Callable[[Any], Any]) -> Any:
    """The velocity for the operator: None, uniform (b, 3), or on the faces of the voxels, three
    tensors."""
    if flow is None:
        return None
    if not callable(flow):
        parts = [
            torch.as_tensor(own(v), dtype=torch.float64, device=layout.grid.origin.device)
            .reshape(-1)
            .expand(batch.colonies.numel())
            for v in (*flow, 0.0)[:3]
        ]
        return torch.stack(parts, 1)
    factor = lambda x: torch.as_tensor(own(x), device=layout.grid.origin.device).reshape(
        -1, 1, 1, 1
    )
    return tuple(scaled(flow, found, factor) for found in layout.on_faces(flow, batch))
