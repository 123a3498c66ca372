"""The medium: signals that diffuse, flow and decay on a grid about each colony (the paper's
equations 6 and 7)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import BEFORE_CELLS, GRID_COVERAGE, TRANSPORT, Effect, per_colony
from torchfilm.signals.assembly import build_operator
from torchfilm.signals.boundary_conditions import BoundaryConditions, Open
from torchfilm.signals.grid import Grid, GridBatch
from torchfilm.signals.layout import Layout
from torchfilm.signals.space import MOST_VOXELS, checked_box, checked_flow
from torchfilm.signals.transport import METHODS, Stepper, choose, prepare
from torchfilm.state import COLONY, GRID, OUTSIDE, Field, State
from torchfilm.tools import checks

# A value on the grid: a number, one per colony, or a function from places (M, 3) µm to (M,).
OnGrid = float | Tensor | Callable[[Tensor], Tensor]
# A velocity: two or three numbers (or one per colony each), or a function from places (M, 3) µm to
# velocities (M, 3).
Flow = Sequence[float | Tensor] | Callable[[Tensor], Tensor] | None
OUTSIDE_CELLS = ("error", "grow", "reservoir")
SPLITTINGS = ("lie", "strang")
# A grid that grows with its colony does so by this many voxels at a time, and keeps this many
# between the cells and its faces.
BLOCK, MARGIN = 8, 2


@dataclass(frozen=True, eq=False)
class Signal:
    """A substance outside the cells.

    diffusion: K, µm²/h; decay: 1/h; each one number or one per colony; decay may also be a function
    from places (M, 3) µm to (M,), a sink. initial: concentration at the start, and source:
    concentration/h made everywhere, each a number, one per colony, or such a function. boundary: what
    happens at the faces of the box, and flow: what carries it, µm/h, if not as the medium says.
    reservoir: the concentration that cells beyond an open box find there.
    """

    diffusion: float | Tensor
    decay: OnGrid = 0.0
    initial: OnGrid = 0.0
    source: OnGrid = 0.0
    boundary: BoundaryConditions | None = None
    flow: Flow = None
    reservoir: float | Tensor = 0.0

    def __post_init__(self) -> None:
        for name in ("diffusion", "reservoir"):
            object.__setattr__(
                self, name, checks.value(f"Signal.{name}", getattr(self, name), least=0.0)
            )
        for name in ("decay", "initial", "source"):
            if not callable(getattr(self, name)):
                object.__setattr__(
                    self, name, checks.value(f"Signal.{name}", getattr(self, name), least=0.0)
                )
        object.__setattr__(self, "flow", checked_flow("Signal.flow", self.flow))


@dataclass(frozen=True)
class MediumReport:
    """`status` (B,): 1 where cells of a colony are beyond the box. `left` (B,) how many, `first`
    (B, 3) where one of them is, µm."""

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


@dataclass(frozen=True, init=False, eq=False)
class Medium(Effect):
    """Signals about the cells, on one grid per colony: `Medium(ahl=Signal(diffusion=10.0),
    box=((-64, -64), (64, 64)), spacing=4.0)`.

    box: lower and upper corner, µm, in 2 or 3 dimensions; a flat box is one layer `depth` µm thick
    (by default as thick as a voxel is wide; in a 3-D scene that no cell may leave, outside="error",
    the depth is to be given). Cells of a 2-D scene may lie in a box with three: in the plane z =
    `height`. spacing: of voxels, µm, one number or one an axis. boundary: of the box; without, nothing
    passes them, or where the medium flows, what it carries. flow: velocity of the medium, µm/h: two
    or three numbers (or one per colony each), or a function from places (M, 3) µm to velocities (M,
    3). obstacles: a function from places (M, 3) to (M,) bool, true where there is none of the
    medium. outside: what cells outside the box mean: "error"; "grow": the box grows with its colony,
    along the axes that `grows` names; "reservoir": the box stands in a reservoir in which each signal is
    at its `reservoir`, and what cells give to it and take from it is kept count of in the fields
    NAME_reservoir. method: "exponential" (exact, where the box is all medium and the flow uniform),
    "implicit" (positive at any step; elsewhere), "crank_nicolson" (the paper's) or "euler"; by
    default the first of them that the scene allows. steps: of transport within one of the scene's,
    for accuracy. splitting: how transport and what cells exchange take turns in a step: "strang",
    half of transport before the cells and half after, which leaves the signal an error many times
    smaller for one more transport a step, or "lie", cells and then transport.
    """

    signals: Mapping[str, Signal]
    box: tuple[tuple[float, ...], tuple[float, ...]]
    spacing: tuple[float, ...]
    depth: float | None = None
    height: float = 0.0
    boundary: BoundaryConditions | None = None
    flow: Flow = None
    obstacles: Callable[[Tensor], Tensor] | None = None
    outside: str = "error"
    grows: str = "xyz"
    method: str | None = None
    steps: int = 1
    splitting: str = "strang"

    stage = TRANSPORT
    title = "transport"

    def __init__(
        self,
        *,
        box: tuple[Sequence[float], Sequence[float]],
        spacing: float | Sequence[float],
        depth: float | None = None,
        height: float = 0.0,
        boundary: BoundaryConditions | None = None,
        flow: Flow = None,
        obstacles: Callable[[Tensor], Tensor] | None = None,
        outside: str = "error",
        grows: str = "xyz",
        method: str | None = None,
        steps: int = 1,
        splitting: str = "strang",
        **signals: Signal,
    ):
        if not signals:
            raise checks.InputError(
                "Medium() has no signal: name at least one, such as ahl=tf.Signal(diffusion=10.0)."
            )
        for name, signal in signals.items():
            if not isinstance(signal, Signal):
                raise checks.input_error(
                    f"Medium.{name}",
                    signal,
                    "a Signal",
                    f"Write {name}=tf.Signal(diffusion=…), or check the spelling of an option.",
                )
        low, high, voxel = checked_box(box, spacing, depth, height)
        if boundary is not None and not isinstance(boundary, BoundaryConditions):
            raise checks.input_error(
                "Medium.boundary",
                boundary,
                "BoundaryConditions",
                "Write boundary=tf.BoundaryConditions(x=tf.Open(), y=tf.NoFlux()).",
            )
        checks.choice("Medium.outside", outside, OUTSIDE_CELLS)
        if not isinstance(grows, str) or not grows or set(grows) - set("xyz"):
            raise checks.input_error(
                "Medium.grows", grows, 'some of the letters x, y and z, such as "x"'
            )
        if method is not None:
            checks.choice("Medium.method", method, tuple(METHODS))
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
            raise checks.input_error("Medium.steps", steps, "a whole number from 1")
        checks.choice("Medium.splitting", splitting, SPLITTINGS)
        if obstacles is not None and not callable(obstacles):
            raise checks.input_error("Medium.obstacles", obstacles, "a function of places")
        given = {
            "signals": dict(signals),
            "box": (low, high),
            "spacing": voxel,
            "depth": depth,
            "height": float(height),
            "boundary": boundary,
            "flow": checked_flow("Medium.flow", flow),
            "obstacles": obstacles,
            "outside": outside,
            "grows": grows,
            "method": method,
            "steps": steps,
            "splitting": splitting,
        }
        for name, value in given.items():
            object.__setattr__(self, name, value)
        periodic = {self.boundary_of(name).periodic for name in signals}
        if len(periodic) > 1:
            raise checks.InputError(
                "Medium: a face is periodic for one signal and not for another; space closes on"
                " itself for all or for none."
            )
        if True in next(iter(periodic)) and outside == "grow":
            raise checks.input_error(
                "Medium.outside",
                outside,
                '"error" or "reservoir" with periodic faces',
                "A box that closes on itself cannot grow.",
            )

    def boundary_of(self, name: str) -> BoundaryConditions:
        """The faces that a signal meets."""
        signal = self.signals[name]
        if signal.boundary is not None or self.boundary is not None:
            return signal.boundary or self.boundary or BoundaryConditions()
        return (
            BoundaryConditions()
            if self.flow_of(name) is None
            else BoundaryConditions(Open(), Open(), Open())
        )

    def flow_of(self, name: str) -> Flow:
        """What carries a signal."""
        own = self.signals[name].flow
        return self.flow if own is None else own

    @property
    def corners(self) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, float, float]]:
        """Lower and upper corner and spacing in three dimensions, µm."""
        low, high = self.box
        x, y = self.spacing[:2]
        if len(low) == 3:
            return low, high, (x, y, self.spacing[2])
        depth = x if self.depth is None else self.depth
        return (*low, self.height - depth / 2), (*high, self.height + depth / 2), (x, y, depth)

    def parts(self) -> tuple[Effect, ...]:
        return (
            (GridCoverage(self), self)
            if self.splitting == "lie"
            else (FirstHalf(self), GridCoverage(self), self)
        )

    def declares(self, dim: int) -> tuple[Field, ...]:
        fields = [
            Field(
                OUTSIDE + name,
                "signal in the medium",
                "conc",
                scope=GRID,
                initial=self._first(name),
            )
            for name in self.signals
        ]
        if self.outside == "reservoir":
            # counted in float64: over thousands of steps a float32 sum would no longer notice what
            # a step adds
            fields += [
                Field(
                    f"{name}_reservoir",
                    "amount given to the reservoir beyond the box, less what was taken",
                    "conc·µm³",
                    scope=COLONY,
                    dtype=torch.float64,
                )
                for name in self.signals
            ]
        return tuple(fields)

    def _first(self, name: str) -> Callable[[State, Tensor], Tensor]:
        return lambda state, rows: self._values(name, "initial", state).index_select(0, rows)

    def lay(self, state: State) -> State:
        """The state with its grids, all as the box says."""
        low, high, step = self.corners
        count = [round((b - a) / h) for a, b, h in zip(low, high, step, strict=True)]
        places = (state.colonies, 3)
        grid = Grid(
            torch.tensor(low, dtype=torch.float64, device=state.device).expand(places).clone(),
            torch.tensor(count, device=state.device).expand(places).clone(),
            step,
        )
        reservoir = (
            {name: s.reservoir for name, s in self.signals.items()}
            if self.outside == "reservoir"
            else None
        )
        return state.replace(
            layout=Layout(
                grid,
                self.boundary_of(next(iter(self.signals))).periodic,
                self.height,
                self.obstacles,
                reservoir,
            )
        )

    def _values(self, name: str, what: str, state: State) -> Tensor:
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
                per_colony(given, state).expand(state.colonies).index_select(0, layout.grid.owner)
            )
        return value if layout.mask is None else value * layout.mask

    def reads(self) -> tuple[str, ...]:
        return tuple(OUTSIDE + name for name in self.signals)

    def writes(self) -> tuple[str, ...]:
        return tuple(OUTSIDE + name for name in self.signals)

    def check(self, state: State) -> None:
        if (
            state.dim == 3
            and len(self.box[0]) == 2
            and self.depth is None
            and self.outside == "error"
        ):
            hint = (
                "Give both corners a z; or a depth=…, if all cells stay in one layer; or let the"
                " box grow, outside='grow'."
            )
            raise checks.input_error(
                "Medium.box", self.box, "of three dimensions in a 3-D scene", hint
            )
        for name in self.signals:
            self._stepper(name, state, state.layout.grid.batches[0], 1.0)  # type: ignore[union-attr]

    def step(self, state: State, dt: float) -> State:
        return self.carried(state, dt if self.splitting == "lie" else dt / 2)

    def carried(self, state: State, dt: float) -> State:
        """The state in which the signals alone have moved on by dt hours."""
        assert state.layout is not None
        grid = state.layout.grid
        changed = {}
        for name in self.signals:
            values = state.fields[OUTSIDE + name]
            parts = [batch.of(values) for batch in grid.batches]
            for k, batch in enumerate(grid.batches):
                stepper = self._stepper(name, state, batch, dt / self.steps)
                for _ in range(self.steps):
                    parts[k] = stepper.step(parts[k])
            changed[OUTSIDE + name] = grid.join(parts)
        return state.with_fields(**changed)

    def _stepper(self, name: str, state: State, batch: GridBatch, dt: float) -> Stepper:
        """The step of a signal on the grids of one shape, made once for as long as they stay."""
        assert state.layout is not None
        numbers = [p for p in self._numbers(name) if isinstance(p, Tensor)] + _held(
            self.signals[name], self.flow_of(name)
        )
        if torch.is_grad_enabled() and any(p.requires_grad for p in numbers):
            return self._prepare(name, state, batch, dt)[0]
        # a number that was changed in place, as an optimiser does, asks for a new one
        key = (
            self,
            name,
            batch.shape,
            dt,
            state.dtype,
            torch.is_grad_enabled(),
            *(0 if p.is_inference() else p._version for p in numbers),
        )
        found = state.layout.work.get(key)
        if found is None:
            found, tracked = self._prepare(name, state, batch, dt)
            # a function may hold what wants a gradient; its graph is good for one way back
            if not tracked:
                state.layout.work[key] = found
        return found

    def _numbers(self, name: str) -> list[Any]:
        """What a signal's transport depends on, tensors among it."""
        signal, flow = self.signals[name], self.flow_of(name)
        faces = [face.outside_value() for pair in self.boundary_of(name).pairs for face in pair]
        moving = [] if callable(flow) else list(flow or ())
        return [signal.diffusion, signal.decay, signal.source, *faces, *moving]

    def _prepare(
        self, name: str, state: State, batch: GridBatch, dt: float
    ) -> tuple[Stepper, bool]:
        """The step, and whether a gradient passes through what it was made of."""
        signal, layout = self.signals[name], state.layout
        assert layout is not None
        ids = state.colony_id.index_select(0, batch.places)
        own = lambda x: (
            x.to(state.device).index_select(0, ids) if isinstance(x, Tensor) and x.dim() == 1 else x
        )
        spread = lambda x: (
            batch.of(self._values(name, x, state))
            if callable(getattr(signal, x))
            else own(getattr(signal, x))
        )
        made = build_operator(
            batch.shape,
            layout.grid.spacing,
            diffusion=own(signal.diffusion),
            decay=spread("decay"),
            velocity=_velocity(self.flow_of(name), layout, batch, own),
            boundary=self.boundary_of(name).take(ids),
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
        held = (
            made.decay,
            made.source,
            *(x for axis in made.axes for x in (axis.up, axis.down, axis.low, axis.high)),
        )
        return prepare(made, dt, self.method or choose(made)), any(
            x is not None and x.requires_grad for x in held
        )


def _velocity(flow: Flow, layout: Layout, batch: GridBatch, own: Callable[[Any], Any]) -> Any:
    """The velocity as the operator wants it: none, uniform (b, 3), or on the faces of the voxels,
    three tensors."""
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


def _held(signal: Signal, flow: Flow) -> list[Tensor]:
    """Tensors that functions of places hold on to."""
    functions = [f for f in (signal.decay, signal.source, flow) if callable(f)]
    cells = [
        cell.cell_contents for f in functions for cell in getattr(f, "__closure__", None) or ()
    ]
    return [x for x in cells if isinstance(x, Tensor)]


@dataclass(frozen=True, eq=False)
class FirstHalf(Effect):
    """The part of Medium that carries signals through the first half of a step, before the cells
    exchange any."""

    medium: Medium = field(repr=False)

    stage = BEFORE_CELLS
    title = "transport"

    def reads(self) -> tuple[str, ...]:
        return self.medium.reads()

    def writes(self) -> tuple[str, ...]:
        return self.medium.writes()

    def step(self, state: State, dt: float) -> State:
        return self.medium.carried(state, dt / 2)


@dataclass(frozen=True, eq=False)
class GridCoverage(Effect):
    """The part of Medium that sees to it that every cell is on the grid, before anything is
    exchanged."""

    medium: Medium = field(repr=False)

    stage = GRID_COVERAGE
    title = "cover"

    def reads(self) -> tuple[str, ...]:
        return ("position",)

    def writes(self) -> tuple[str, ...]:
        return (
            tuple(OUTSIDE + name for name in self.medium.signals)
            if self.medium.outside == "grow"
            else ()
        )

    def begin(self, state: State) -> State:
        return self.medium.lay(state)

    def prepare(self, state: State) -> State:
        return self._grown(state) if self.medium.outside == "grow" else state

    def check(self, state: State) -> None:
        report = self._look(state)
        if report is not None and bool(report.status.any()):
            place = int(torch.nonzero(report.status)[0])
            colony = int(state.colony_id[place])
            low, high, _ = self.medium.corners
            raise checks.InputError(
                f"Medium.box, from {low} to {high} µm, is too small for colony {colony}:"
                f" {report.reason(place)}. {report.hint}."
            )

    def step(self, state: State, dt: float) -> State:
        if self.medium.outside == "grow":
            state = self._grown(state)
        report = self._look(state)
        return (
            state if report is None else state.replace(reports={**state.reports, "medium": report})
        )

    @torch.no_grad()
    def _look(self, state: State) -> MediumReport | None:
        """Which cells are where no medium is; None where that is no failure."""
        layout = state.layout
        if layout is None or (layout.reservoir is not None and layout.obstacle is None):
            return None
        away = layout.outside_medium(state.position, state.colony)
        left = torch.bincount(state.colony[away], minlength=state.colonies)
        first = torch.zeros(state.colonies, 3, dtype=torch.float64, device=state.device)
        first[state.colony[away]] = layout.places(state.position)[away]
        return MediumReport((left > 0).long(), left, first)

    @torch.no_grad()
    def _span(self, state: State) -> tuple[Tensor, Tensor]:
        """The box that cells need, (B, 3) twice."""
        assert state.layout is not None
        places, groups, step = (
            state.layout.places(state.position),
            state.groups,
            state.layout.grid.step,
        )
        high = torch.stack([groups.max(x, empty=-torch.inf) for x in places.unbind(1)], 1)
        low = -torch.stack([groups.max(-x, empty=-torch.inf) for x in places.unbind(1)], 1)
        corner, end, size = self.medium.corners
        # a layer, as the box was given, stays one
        flat = torch.tensor(
            [round((b - a) / h) == 1 for a, b, h in zip(corner, end, size, strict=True)],
            device=state.device,
        )
        margin = torch.where(flat, 0.0, MARGIN * step)
        held = torch.tensor(
            [letter not in self.medium.grows for letter in "xyz"], device=state.device
        )
        return torch.where(held, torch.inf, low - margin), torch.where(
            held, -torch.inf, high + margin
        )

    def _grown(self, state: State) -> State:
        layout = state.layout
        assert layout is not None
        low, high = self._span(state)
        # a colony that would need more, or whose cells are nowhere, keeps its grid; its cells are
        # then beyond it, which is reported
        size = (
            (torch.maximum(high, layout.grid.high) - torch.minimum(low, layout.grid.origin))
            / layout.grid.step
        ).prod(1, keepdim=True)
        fits = size <= MOST_VOXELS
        low, high = torch.where(fits, low, torch.inf), torch.where(fits, high, -torch.inf)
        names = [OUTSIDE + name for name in self.medium.signals]
        here = [state.fields[n] for n in names]
        grid, values = layout.grid.extended(
            [*here, torch.ones_like(here[0])], low, high, block=BLOCK
        )
        if grid is layout.grid:
            return state
        state = state.replace(layout=layout.on(grid))
        old = values.pop() > 0
        first = [self.medium._values(name, "initial", state) for name in self.medium.signals]
        return state.with_fields(
            **{
                n: torch.where(old, v, start)
                for n, v, start in zip(names, values, first, strict=True)
            }
        )
