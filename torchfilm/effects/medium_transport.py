"""What the parts of a medium share: the values of its signals, and the steps that carry them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchfilm.effect import Binding
from torchfilm.effects.medium_values import Corner, later, on_grid, velocity_of, without_cells
from torchfilm.effects.scaled import held_tensors
from torchfilm.resolver import snapshot
from torchfilm.signals.boundary_conditions import BoundaryConditions
from torchfilm.signals.grid import Grid, GridBatch
from torchfilm.signals.layout import Layout
from torchfilm.signals.schedule import (
    Schedule,
    at_time,
    each_value,
    held_together,
    mean_of,
    schedules,
)
from torchfilm.signals.transport import Carrier, carry, check_method, choose, prepare
from torchfilm.signals.transport_operator import Operator, mean
from torchfilm.signals.transport_rates import build_operator
from torchfilm.signals.transport_series import FARTHEST, Series
from torchfilm.signals.transport_uptake import UptakeTransport
from torchfilm.state import OUTSIDE, State
from torchfilm.tools import checks
from torchfilm.tools.backends import why_torch
from torchfilm.tools.tangents import tracked
from torchfilm.values import Distribution, numbers

if TYPE_CHECKING:
    from torchfilm.effects.medium import Medium
    from torchfilm.effects.medium_substeps import SubSteps
from torchfilm.effects.signal import Flow, OnGrid, Signal

# Methods that are exact over a step, whatever its length.
EXACT = ("exponential", "series")
MOST_KEPT = 128  # prepared steps of a grid
# Which values of some schedules hold, by their places: each with a share of a step, and a time, h.
Held = dict[tuple[int, ...], tuple[float, float]]


def _keep(known: dict[Any, Any], key: Any, made: Any) -> None:
    """Keep a prepared step, and no more than MOST_KEPT: schedules may have thousands of values."""
    while len(known) >= MOST_KEPT:
        known.pop(next(iter(known)))
    known[key] = made


def _held(schedules: Sequence[Schedule], state: State) -> Held:
    """What holds during a step; before one, at the time of a state."""
    if not schedules:
        return {(): (1.0, 0.0)}
    if state.span is None:
        return {tuple(x.place(state.time) for x in schedules): (1.0, state.time)}
    return held_together(schedules, *state.span)


def _key(held: Held) -> tuple[Any, ...]:
    """By which a prepared step is known: the same values for the same shares of it."""
    return tuple((places, share) for places, (share, _) in held.items())


@dataclass(frozen=True, eq=False)
class Constants:
    """What a medium is given, by the name of a signal, on the batch's device, while no schedule
    goes on."""

    signals: dict[str, Signal]
    flows: dict[str, Flow]
    boundary: dict[str, BoundaryConditions]

    def numbers(self, name: str) -> list[Any]:
        """The values that a signal's transport depends on; some are tensors."""
        signal, flow = self.signals[name], self.flows[name]
        faces = [x for pair in self.boundary[name].pairs for face in pair for x in face.numbers()]
        moving = [] if callable(flow) else list(flow or ())
        return [signal.diffusion, signal.decay, signal.source, *faces, *moving]


class Transport:
    """The signals, with their values on the batch's device, and the steps of the grids in use."""

    def __init__(self, medium: Medium, binding: Binding):
        self.medium, batch = medium, binding.batch
        self.by_torch = why_torch("Medium", medium.backend, batch.device)
        self.compiled = not self.by_torch
        signals = snapshot(medium.signals, "Medium.signals", batch)
        flows = {
            n: snapshot(medium.flow_of(n), f"flow of the signal {n!r}", batch) for n in signals
        }
        boundary = {
            n: snapshot(medium.boundary_of(n), f"boundary of the signal {n!r}", batch)
            for n in signals
        }
        self._given = signals, flows, boundary
        self.schedules = schedules(self._given)
        # those that transport of each signal depends on; a reservoir is none of it
        self._moving = {n: schedules((x.source, flows[n], boundary[n])) for n, x in signals.items()}
        self.corner = medium.corners[0]
        self._reservoirs = schedules([x.reservoir for x in signals.values()])
        self._known: dict[tuple[int, ...], Constants] = {}
        self._spaces: dict[Any, dict[str, Any]] = {}
        self._latest: dict[str, tuple[Any, Held]] = {}  # and when
        # signals that take turns with circuits, in the medium's steps; that others move, by whom
        self.in_turns: frozenset[str] = frozenset()
        self.coupled: dict[str, str] = {}
        self.covered: Callable[[State], State] = lambda state: (
            state
        )  # on grids that reach all cells
        self.apart: SubSteps | None = None  # of reactions and transport, about what cells do
        self._of_step: dict[Any, Carrier] | None = None
        # weak keys: a grid no longer in use releases its steps
        self.carriers: WeakKeyDictionary[Grid, dict[Any, Carrier]] = WeakKeyDictionary()
        self._eaten: WeakKeyDictionary[Grid, dict[Any, list[UptakeTransport]]] = WeakKeyDictionary()

    def lay(self, state: State) -> State:
        """The state with one grid per colony, as `box` and `spacing` give it."""
        low, _, step = self.medium.corners
        size = (state.colonies, 3)
        grid = Grid(
            torch.tensor(low, dtype=torch.float64, device=state.device).expand(size).clone(),
            torch.tensor(self.medium.voxels, device=state.device).expand(size).clone(),
            step,
        )
        return state.replace(layout=Layout(grid, **self._space(state)))

    def at(self, time: float) -> Constants:
        """What holds at a time, h."""
        place = tuple(x.place(time) for x in self.schedules)
        if place not in self._known:
            parts = at_time(self._given, time) if place else self._given
            self._known[place] = Constants(*parts)
        return self._known[place]

    def _space(self, state: State) -> dict[str, Any]:
        """What of a layout the scene decides, whatever grid a state has."""
        held = _held(self._reservoirs, state)
        key = (_key(held), torch.is_grad_enabled())
        if (known := self._spaces.get(key)) is not None:
            return known
        signals, medium = self._given[0], self.medium
        reservoir = mean_of({n: x.reservoir for n, x in signals.items()}, list(held.values()))
        made = {
            "periodic": self._given[2][next(iter(signals))].periodic,
            "height": medium.height,
            "obstacle": medium.obstacles,
            "reservoir": reservoir if medium.outside == "reservoir" else None,
        }
        # a mean that carries a gradient serves one backward pass
        numbers = [x for x in reservoir.values() if isinstance(x, Tensor)]
        if len(held) == 1 or not tracked(*numbers):
            _keep(self._spaces, key, made)
        return made

    def opened(self, state: State) -> State:
        """The state in the space of this medium, also where another model laid its grid."""
        layout = state.layout
        # the same layout where nothing differs: it keeps what it has found out about its grid
        space = self._space(state)
        if layout is None or all(getattr(layout, n) is v for n, v in space.items()):
            return state
        return state.replace(layout=dataclasses.replace(layout, **space))

    def first(self, name: str) -> Callable[[State, Tensor], Tensor]:
        """The first values of a signal, as a field's `initial`."""
        return partial(_first_values, self.at(0.0).signals[name].initial, name, self.corner)

    def values(self, now: Constants, name: str, what: str, state: State) -> Tensor:
        """The initial, source or decay of a signal on every voxel, (nodes,); 0 in obstacles."""
        return on_grid(getattr(now.signals[name], what), name, what, state, self.corner)

    def without_cells(self, name: str, state: State, dt: float) -> Tensor:
        """What a signal has become on every voxel as cells are about to find it in a step of dt
        hours, (nodes,), where neither cells nor transport acted on it; 0 in obstacles."""
        mover = self.coupled.get(name)  # nutrition has moved it over the step, circuits will
        turns = self.medium.steps if name in self.in_turns else 1
        half = 0.5 * dt / turns if self.medium.halves else 0.0
        hours = {"nutrition": dt, "circuits": 0.0, None: half}[mover]
        signal = self._given[0][name]
        value = without_cells(signal, name, state, self.corner, state.time)
        held = _held(schedules(signal.source), state).values()
        # transport has had the mean source of the step so far
        sources = [
            share * self.values(self.at(time), name, "source", state) for share, time in held
        ]
        return later(
            value, sum(sources[1:], sources[0]), signal.decay, name, state, self.corner, hours
        )

    def carried(
        self,
        state: State,
        hours: float,
        turn: float,
        pieces: int = 1,
        names: frozenset[str] | None = None,
    ) -> State:
        """The state after transport, in which cells do not change: of the signals that take turns
        with cells for `turn` hours, in so many pieces where the method is not exact; of the others
        for so many `hours`, in the medium's steps. names: of the signals to move; None: all but
        those that sub-steps move."""
        steps = self.medium.steps
        changed: dict[str, Tensor] = {}
        if names is None:
            apart = self.apart.names if self.apart else ()
            names = frozenset(self.medium.signals).difference(self.coupled, apart)
        for name in sorted(names):
            often = name in self.in_turns
            whole, count = (turn, pieces) if often else (hours, steps)
            count = 1 if often and self.medium.method_of(name)[0] in EXACT else count
            changed |= self.moved(name, state, whole, count)
        return state.with_fields(**changed)

    def moved(self, name: str, state: State, hours: float, pieces: int) -> dict[str, Tensor]:
        """A signal after transport in so many pieces, by the name of its field."""
        assert state.layout is not None
        grid, values = state.layout.grid, state.fields[OUTSIDE + name]
        carriers = [self.carrier(name, state, batch, hours / pieces) for batch in grid.batches]
        for _ in range(pieces):
            values = carry(grid, carriers, values)
        return {OUTSIDE + name: values}

    def with_uptake(self, name: str, state: State) -> list[UptakeTransport]:
        """Transport of a signal that cells take up, on the grids of each shape; it is reused while
        they stay."""
        assert state.layout is not None
        grid = state.layout.grid
        key = (name, _key(self._held(name, state)), state.dtype, torch.is_grad_enabled())
        known = self._eaten.setdefault(grid, {})
        if key in known and not self._tracked(name, state):
            return known[key]
        made = [
            UptakeTransport(self._operator(name, state, b), b.shape, self.compiled)
            for b in grid.batches
        ]
        # as of `carrier`: one that a gradient passes through serves one backward pass
        if not tracked(*(x for one in made for x in one.numbers())):
            _keep(known, key, made)
        return made

    def exchanges_per_hour(self, name: str, state: State) -> float:
        """The greatest rate at which a voxel loses a signal that cells take up, 1/h, but for
        them."""
        return max(float(x.operator.loss.detach().amax()) for x in self.with_uptake(name, state))

    def _tracked(self, name: str, state: State) -> bool:
        """Whether derivatives by what a signal's transport depends on are wanted."""
        each = [self.at(time) for _, time in self._held(name, state).values()]
        numbers = [x for now in each for x in now.numbers(name) if isinstance(x, Tensor)]
        given = [(now.signals[name], now.flows[name]) for now in each]
        functions = [f for s, flow in given for f in (s.decay, s.source, flow) if callable(f)]
        return tracked(*numbers, *(x for f in functions for x in held_tensors(f)))

    def carrier(self, name: str, state: State, batch: GridBatch, dt: float) -> Carrier:
        """The step of a signal on grids of one shape; it is reused while the grids stay."""
        assert state.layout is not None
        place = _key(self._held(name, state))
        if self._tracked(name, state):
            kept = {} if self._of_step is None else self._of_step
            own = (name, place, batch.shape, dt)
            if own not in kept:
                kept[own] = self._prepare(name, state, batch, dt)[0]
            return kept[own]
        known = self.carriers.setdefault(state.layout.grid, {})
        key = (name, place, batch.shape, dt, state.dtype, torch.is_grad_enabled())
        found = known.get(key)
        if found is None:
            found, differentiable = self._prepare(name, state, batch, dt)
            # a function may use a tensor that requires a gradient; such a step serves one
            # backward pass only, so it is not kept
            if not differentiable:
                _keep(known, key, found)
        return found

    def _held(self, name: str, state: State) -> Held:
        """Which values of the schedules by which a signal moves hold in a step."""
        when = state.time if state.span is None else state.span
        if (known := self._latest.get(name)) is None or known[0] != when:
            known = self._latest[name] = when, _held(self._moving[name], state)
        return known[1]

    @contextmanager
    def one_step(self) -> Iterator[None]:
        """Within it, what would be made anew for each backward pass is made once."""
        self._of_step = {}
        try:
            yield
        finally:
            self._of_step = None

    def check(self, name: str, state: State) -> None:
        """Raise InputError for a signal whose rates or method cannot be."""
        assert state.layout is not None
        self._check_range(name, state.dtype)
        self._check_fixed(name, state)
        for time in sorted({state.time, *(t for x in self.schedules for t in x.times)}):
            then, first = state.replace(time=time), state.layout.grid.batches[0]
            check_method(self._operator(name, then, first), self.medium.method)

    def _check_range(self, name: str, dtype: torch.dtype) -> None:
        """Raise InputError for a number that would be infinite in the states' type."""
        signal, most = self._given[0][name], torch.finfo(dtype).max
        names = ("initial", "source", "decay", "reservoir")
        given = [(n, value) for n in names for value in each_value(getattr(signal, n))]
        for what, value in given:
            if callable(value):
                continue
            greatest = float(numbers(value).max())
            if greatest > most:
                raise checks.input_error(
                    f"{what} of the signal {name!r}",
                    greatest,
                    f"at most {most:.2g} with {str(dtype)[6:]}",
                    "Choose another unit of concentration, or dtype=torch.float64.",
                )

    def _check_fixed(self, name: str, state: State) -> None:
        """Raise InputError for a function of positions that draws random numbers."""
        for what in ("initial", "source", "decay"):
            now = self.at(state.time)
            if not callable(getattr(now.signals[name], what)):
                continue
            one, again = (self.values(now, name, what, state).detach() for _ in range(2))
            # on a GPU, sums may differ by rounding from one call to the next
            near = 0.0 if state.device.type == "cpu" else 1e-5
            if not torch.allclose(one, again, rtol=near, atol=0.0):
                hint = (
                    "Give a distribution, such as tf.Normal(1.0, 0.1): each voxel draws by the"
                    " seed of the run."
                    if what == "initial"
                    else "Draw once, outside the function."
                )
                raise checks.InputError(
                    f"{what}(positions) of the signal {name!r} gives other values each time it is"
                    f" called. A run must not depend on random numbers that its seed does not set."
                    f" {hint}"
                )

    def _prepare(
        self, name: str, state: State, batch: GridBatch, dt: float
    ) -> tuple[Carrier, bool]:
        """The step, and whether derivatives by its coefficients are wanted."""
        made = self._operator(name, state, batch)
        coefficients = (
            made.decay,
            made.source,
            *(x for axis in made.axes for x in (axis.up, axis.down, axis.low, axis.high)),
        )
        wanted = tracked(*coefficients)
        method = self.medium.method or choose(made)
        stepper = prepare(made, dt, method, compiled=self.compiled)
        most = float(stepper.exchanges.max()) if isinstance(stepper, Series) else 0.0
        if not most <= FARTHEST:
            raise checks.input_error(
                f"transport of the signal {name!r}",
                f"{most:.2g} exchanges of a voxel in a step of {dt:g} h",
                f"at most {FARTHEST:g}, beyond which rounding decides",
                "Are diffusion in µm²/h and decay in 1/h? Slower ones, a shorter step or a coarser"
                " spacing will do.",
            )
        return Carrier(stepper, batch.shape, self.compiled and not wanted), wanted

    def _operator(self, name: str, state: State, batch: GridBatch) -> Operator:
        """The operator of a signal; in a step in which schedules change, the mean one."""
        apart: dict[tuple[int, ...], list[tuple[float, float]]] = {}
        for places, piece in self._held(name, state).items():
            key = tuple(k for k, x in zip(places, self._moving[name], strict=True) if not x.linear)
            apart.setdefault(key, []).append(piece)
        given = [{name: x[name]} for x in self._given]
        return mean(
            [
                (
                    sum(share for share, _ in held),
                    self._operator_at(Constants(*mean_of(given, held)), name, state, batch),
                )
                for held in apart.values()
            ]
        )

    def _operator_at(self, now: Constants, name: str, state: State, batch: GridBatch) -> Operator:
        signal, layout = now.signals[name], state.layout
        assert layout is not None
        ids = state.colony_id.index_select(0, batch.colonies)
        own = lambda x: (
            x.to(state.device).index_select(0, ids) if isinstance(x, Tensor) and x.dim() == 1 else x
        )
        spread = lambda x: (
            batch.of(self.values(now, name, x, state))
            if callable(getattr(signal, x))
            else own(getattr(signal, x))
        )
        return build_operator(
            batch.shape,
            layout.grid.spacing,
            diffusion=own(signal.diffusion),
            decay=spread("decay"),
            velocity=velocity_of(now.flows[name], layout, batch, own),
            boundary=now.boundary[name].take(ids),
            mask=None if layout.mask is None else batch.of(layout.mask),
            source=(
                None
                if not callable(signal.source)
                and not isinstance(signal.source, Tensor)
                and signal.source == 0
                else spread("source")
            ),
            colonies=batch.colonies.numel(),
            dtype=state.dtype,
            device=state.device,
        )


def _first_values(
    given: OnGrid | Distribution, name: str, corner: Corner, state: State, rows: Tensor
) -> Tensor:
    return on_grid(given, name, "initial", state, corner).index_select(0, rows)
