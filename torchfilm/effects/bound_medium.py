"""A medium bound to a batch: its grids, its transport steppers (built once), and its parts of a
step, up to three."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchfilm.effect import BEFORE_CELLS, GRID_COVERAGE, Binding, BoundEffect
from torchfilm.resolver import snapshot
from torchfilm.signals.boundary_conditions import BoundaryConditions
from torchfilm.signals.grid import Grid, GridBatch
from torchfilm.signals.layout import Layout
from torchfilm.signals.space import MOST_VOXELS
from torchfilm.signals.transport import Stepper, choose, prepare
from torchfilm.signals.transport_rates import build_operator
from torchfilm.state import GRID, OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.tangents import tracked

if TYPE_CHECKING:
    from torchfilm.effects.medium import Flow, Medium, OnGrid, Signal

# A growing grid grows by BLOCK voxels at a time, and keeps MARGIN voxels between the cells and its
# faces.
BLOCK, MARGIN = 8, 2


@dataclass(frozen=True)
class MediumReport:
    """Cells outside the medium, per colony. `status` (B,): 1 if there are any. `left` (B,): how
    many. `first` (B, 3): the position of one of them, µm."""

    status: Tensor
    left: Tensor
    first: Tensor
    hint = (
        "Make the box of the Medium larger (one that is flat is a single layer), let it grow with"
        f" the colony, Medium(…, outside='grow'), with a spacing that needs at most {MOST_VOXELS:,}"
        " voxels a colony, or move the obstacle"
    )

    def reason(self, place: int) -> str:
        where = ", ".join(f"{x:.4g}" for x in self.first[place].tolist())
        return (
            f"{int(self.left[place])} cell(s) are beyond the box of the medium or inside an"
            f" obstacle, one at ({where}) µm"
        )


class Transport:
    """What the parts of a medium share: the signals, with their values on the batch's device, and
    the steppers of the grids in use."""

    def __init__(self, medium: Medium, binding: Binding):
        self.medium, batch = medium, binding.batch
        self.signals: dict[str, Signal] = snapshot(medium.signals, "Medium.signals", batch)
        self.flows: dict[str, Flow] = {
            n: snapshot(medium.flow_of(n), f"flow of the signal {n!r}", batch)
            for n in medium.signals
        }
        self.boundary: dict[str, BoundaryConditions] = {
            n: snapshot(medium.boundary_of(n), f"boundary of the signal {n!r}", batch)
            for n in medium.signals
        }
        # what of a layout the scene decides, whatever grid a state has
        self.space: dict[str, Any] = {
            "periodic": self.boundary[next(iter(self.signals))].periodic,
            "height": medium.height,
            "obstacle": medium.obstacles,
            "reservoir": (
                {name: s.reservoir for name, s in self.signals.items()}
                if medium.outside == "reservoir"
                else None
            ),
        }
        # weak keys: a grid no longer in use releases its steppers
        self.steppers: WeakKeyDictionary[Grid, dict[Any, Stepper]] = WeakKeyDictionary()

    def lay(self, state: State) -> State:
        """The state with one grid per colony, as `box` and `spacing` give it."""
        low, high, step = self.medium.corners
        count = [round((b - a) / h) for a, b, h in zip(low, high, step, strict=True)]
        places = (state.colonies, 3)
        grid = Grid(
            torch.tensor(low, dtype=torch.float64, device=state.device).expand(places).clone(),
            torch.tensor(count, device=state.device).expand(places).clone(),
            step,
        )
        return state.replace(layout=Layout(grid, **self.space))

    def opened(self, state: State) -> State:
        """The state in the space of this medium, also where another model laid its grid."""
        layout = state.layout
        # the same layout where nothing differs: it keeps what it has found out about its grid
        if layout is None or all(getattr(layout, n) is v for n, v in self.space.items()):
            return state
        return state.replace(layout=dataclasses.replace(layout, **self.space))

    def first(self, name: str) -> Callable[[State, Tensor], Tensor]:
        """The first values of a signal, as a field's `initial`."""
        return lambda state, rows: self.values(name, "initial", state).index_select(0, rows)

    def values(self, name: str, what: str, state: State) -> Tensor:
        """The initial, source or decay of a signal on every voxel, (nodes,); 0 in obstacles."""
        given: OnGrid = getattr(self.signals[name], what)
        layout = state.layout
        assert layout is not None
        if callable(given):
            found = given(layout.grid.centres())
            label = f"{what}(places) of the signal {name!r}"
            if not isinstance(found, Tensor) or found.shape != (layout.grid.nodes,):
                shown = tuple(found.shape) if isinstance(found, Tensor) else found
                raise checks.input_error(
                    label,
                    shown,
                    f"a tensor of shape ({layout.grid.nodes},), one number for each place",
                )
            bad = torch.nonzero(~((found >= 0) & (found < torch.inf))).squeeze(1)
            if bad.numel():
                where = [round(x, 3) for x in layout.grid.centres()[bad[0]].tolist()]
                raise checks.input_error(
                    label,
                    float(found[bad[0]]),
                    "finite and at least 0 everywhere",
                    f"It is not at {where} µm and {bad.numel() - 1} more places.",
                )
            value = found.to(dtype=state.dtype, device=state.device)
        else:
            value = (
                _of_colonies(given, state).expand(state.colonies).index_select(0, layout.grid.owner)
            )
        return value if layout.mask is None else value * layout.mask

    def carried(self, state: State, dt: float) -> State:
        """The state after transport of the signals for dt hours; cells do not change."""
        assert state.layout is not None
        grid = state.layout.grid
        changed = {}
        for name in self.signals:
            values = state.fields[OUTSIDE + name]
            parts = [batch.of(values) for batch in grid.batches]
            for k, batch in enumerate(grid.batches):
                stepper = self.stepper(name, state, batch, dt / self.medium.steps)
                for _ in range(self.medium.steps):
                    parts[k] = stepper.step(parts[k])
            changed[OUTSIDE + name] = grid.join(parts)
        return state.with_fields(**changed)

    def stepper(self, name: str, state: State, batch: GridBatch, dt: float) -> Stepper:
        """The stepper of a signal on grids of one shape; it is reused while the grids stay."""
        assert state.layout is not None
        numbers = [x for x in self._numbers(name) if isinstance(x, Tensor)]
        numbers += _closure_tensors(self.signals[name], self.flows[name])
        if tracked(*numbers):
            return self._prepare(name, state, batch, dt)[0]
        known = self.steppers.setdefault(state.layout.grid, {})
        key = (name, batch.shape, dt, state.dtype, torch.is_grad_enabled())
        found = known.get(key)
        if found is None:
            found, own = self._prepare(name, state, batch, dt)
            # a function may use a tensor that requires a gradient; such a stepper serves one
            # backward pass only, so it is not kept
            if not own:
                known[key] = found
        return found

    def _numbers(self, name: str) -> list[Any]:
        """The values that a signal's transport depends on; some are tensors."""
        signal, flow = self.signals[name], self.flows[name]
        faces = [face.outside_value() for pair in self.boundary[name].pairs for face in pair]
        moving = [] if callable(flow) else list(flow or ())
        return [signal.diffusion, signal.decay, signal.source, *faces, *moving]

    def _prepare(
        self, name: str, state: State, batch: GridBatch, dt: float
    ) -> tuple[Stepper, bool]:
        """The stepper, and whether derivatives by its coefficients are wanted."""
        signal, layout = self.signals[name], state.layout
        assert layout is not None
        ids = state.colony_id.index_select(0, batch.places)
        own = lambda x: (
            x.to(state.device).index_select(0, ids) if isinstance(x, Tensor) and x.dim() == 1 else x
        )
        spread = lambda x: (
            batch.of(self.values(name, x, state))
            if callable(getattr(signal, x))
            else own(getattr(signal, x))
        )
        made = build_operator(
            batch.shape,
            layout.grid.spacing,
            diffusion=own(signal.diffusion),
            decay=spread("decay"),
            velocity=_velocity(self.flows[name], layout, batch, own),
            boundary=self.boundary[name].take(ids),
            mask=None if layout.mask is None else batch.of(layout.mask),
            source=(
                None
                if not callable(signal.source)
                and not isinstance(signal.source, Tensor)
                and signal.source == 0
                else spread("source")
            ),
            colonies=batch.places.numel(),
            dtype=state.dtype,
            device=state.device,
        )
        coefficients = (
            made.decay,
            made.source,
            *(x for axis in made.axes for x in (axis.up, axis.down, axis.low, axis.high)),
        )
        return prepare(made, dt, self.medium.method or choose(made)), tracked(*coefficients)


class _MediumPart(BoundEffect):
    """A part of a bound medium."""

    effect: Medium

    def __init__(self, effect: Medium, binding: Binding, transport: Transport):
        super().__init__(effect, binding)
        self.transport = transport

    def declares(self) -> list[Field]:
        return []

    def check(self, state: State) -> None:
        pass


class FirstHalf(_MediumPart):
    """Transports signals over the first half of a step, before exchange with the cells."""

    def __init__(self, effect: Medium, binding: Binding, transport: Transport):
        super().__init__(effect, binding, transport)
        self.stage = BEFORE_CELLS

    def step(self, state: State, dt: float) -> State:
        return self.transport.carried(state, dt / 2)

    def numerics(self, dt: float, state: State) -> list[str]:
        return [f"over {dt / 2:g} h, by the methods that the main part of transport lists"]

    def summary(self) -> str:
        return "moves signals over the first half of the step, before cells exchange them"


class BoundMedium(_MediumPart):
    """Transports signals after exchange with the cells: over the second half of a step, or all."""

    def declares(self) -> list[Field]:
        first = self.transport.first
        fields = self.effect.declares(self.binding.dim)
        return [
            (
                dataclasses.replace(f, initial=first(f.name.removeprefix(OUTSIDE)))
                if f.scope == GRID
                else f
            )
            for f in fields
        ]

    def check(self, state: State) -> None:
        medium = self.effect
        flat = len(medium.box[0]) == 2 and medium.depth is None
        if state.dim == 3 and flat and medium.outside == "error":
            hint = (
                "Give both corners a z; or give depth=…, if all cells stay in one layer; or let the"
                " box grow, outside='grow'."
            )
            raise checks.input_error(
                "Medium.box", medium.box, "of three dimensions in a 3-D scene", hint
            )
        assert state.layout is not None
        for name in medium.signals:
            self.transport.stepper(name, state, state.layout.grid.batches[0], 1.0)

    def step(self, state: State, dt: float) -> State:
        return self.transport.carried(state, dt / 2 if self.effect.halves else dt)

    def numerics(self, dt: float, state: State) -> list[str]:
        return self.effect.numerics(dt, state)


class GridCoverage(_MediumPart):
    """Checks before exchange that every cell is on its grid, and extends grids that may grow."""

    def __init__(self, effect: Medium, binding: Binding, transport: Transport):
        super().__init__(effect, binding, transport)
        self.stage, self.title = GRID_COVERAGE, "grid coverage"

    def reads(self) -> tuple[str, ...]:
        return ("position", *self.writes())

    def writes(self) -> tuple[str, ...]:
        return tuple(self.effect.writes()) if self.effect.outside == "grow" else ()

    def lay(self, state: State) -> State:
        return self.transport.lay(state)

    def ready(self, state: State) -> State:
        return self._grown(state) if self.effect.outside == "grow" else state

    def opened(self, state: State) -> State:
        return self.transport.opened(state)

    def check(self, state: State) -> None:
        report = self._look(state)
        if report is not None and bool(report.status.any()):
            place = int(torch.nonzero(report.status)[0])
            colony = int(state.colony_id[place])
            low, high, _ = self.effect.corners
            raise checks.InputError(
                f"Medium.box, from {low} to {high} µm, is too small for colony {colony}:"
                f" {report.reason(place)}. {report.hint}."
            )

    def step(self, state: State, dt: float) -> State:
        if self.effect.outside == "grow":
            state = self._grown(state)
        report = self._look(state)
        return (
            state if report is None else state.replace(reports={**state.reports, "medium": report})
        )

    def numerics(self, dt: float, state: State) -> list[str]:
        return [self.effect.coverage]

    def summary(self) -> str:
        return "checks that every cell is on the grid of its colony"

    @torch.no_grad()
    def _look(self, state: State) -> MediumReport | None:
        """The report on cells outside the medium; None if such cells are allowed."""
        layout = state.layout
        if layout is None or (layout.reservoir is not None and layout.obstacle is None):
            return None
        away = layout.outside_medium(state.position, state.colony)
        left = state.groups.sum(away.double()).long()
        number = torch.arange(state.cells, 0, -1, device=state.device)
        first = state.cells - state.groups.max(torch.where(away, number, 0))
        place = torch.nn.functional.pad(layout.places(state.position), (0, 0, 0, 1))  # none: 0
        return MediumReport((left > 0).long(), left, place.index_select(0, first))

    @torch.no_grad()
    def _span(self, state: State) -> tuple[Tensor, Tensor]:
        """The lower and upper corner of the box that the cells need, (B, 3) µm each."""
        assert state.layout is not None
        places, groups, step = (
            state.layout.places(state.position),
            state.groups,
            state.layout.grid.step,
        )
        high = torch.stack([groups.max(x, empty=-torch.inf) for x in places.unbind(1)], 1)
        low = -torch.stack([groups.max(-x, empty=-torch.inf) for x in places.unbind(1)], 1)
        corner, end, size = self.effect.corners
        # a box of one layer stays one layer
        flat = torch.tensor(
            [round((b - a) / h) == 1 for a, b, h in zip(corner, end, size, strict=True)],
            device=state.device,
        )
        margin = torch.where(flat, 0.0, MARGIN * step)
        fixed = torch.tensor(
            [letter not in self.effect.grows for letter in "xyz"], device=state.device
        )
        return torch.where(fixed, torch.inf, low - margin), torch.where(
            fixed, -torch.inf, high + margin
        )

    def _grown(self, state: State) -> State:
        layout = state.layout
        assert layout is not None
        low, high = self._span(state)
        # a colony that needs more voxels than allowed, or whose positions are not finite, keeps its
        # grid; its cells are then outside the grid, which is reported
        size = (
            (torch.maximum(high, layout.grid.high) - torch.minimum(low, layout.grid.origin))
            / layout.grid.step
        ).prod(1, keepdim=True)
        fits = size <= MOST_VOXELS
        low, high = torch.where(fits, low, torch.inf), torch.where(fits, high, -torch.inf)
        names = [OUTSIDE + name for name in self.effect.signals]
        here = [state.fields[n] for n in names]
        grid, values = layout.grid.extended(
            [*here, torch.ones_like(here[0])], low, high, block=BLOCK
        )
        if grid is layout.grid:
            return state
        state = state.replace(layout=layout.on(grid))
        old = values.pop() > 0
        first = [self.transport.values(name, "initial", state) for name in self.effect.signals]
        return state.with_fields(
            **{
                n: torch.where(old, v, start)
                for n, v, start in zip(names, values, first, strict=True)
            }
        )


def _velocity(flow: Flow, layout: Layout, batch: GridBatch, own: Callable[[Any], Any]) -> Any:
    """The velocity for the operator: None, uniform (b, 3), or on the faces of the voxels, three
    tensors."""
    if flow is None:
        return None
    if not callable(flow):
        parts = [
            torch.as_tensor(own(v), dtype=torch.float64, device=layout.grid.origin.device)
            .reshape(-1)
            .expand(batch.places.numel())
            for v in (*flow, 0.0)[:3]
        ]
        return torch.stack(parts, 1)
    return layout.on_faces(flow, batch)


def _closure_tensors(signal: Signal, flow: Flow) -> list[Tensor]:
    """Tensors in the closures of functions of places."""
    functions = [f for f in (signal.decay, signal.source, flow) if callable(f)]
    cells = [
        cell.cell_contents for f in functions for cell in getattr(f, "__closure__", None) or ()
    ]
    return [x for x in cells if isinstance(x, Tensor)]


def _of_colonies(given: float | Tensor, state: State) -> Tensor:
    """A value as a (B,) or 0-dim tensor of the state's dtype; one value per colony is taken by
    colony id."""
    if not isinstance(given, Tensor):
        return torch.tensor(given, dtype=state.dtype, device=state.device)
    value = given.to(dtype=state.dtype, device=state.device)
    return value if value.dim() == 0 else value.index_select(0, state.colony_id)
