"""The medium: signals that diffuse, flow and decay on a grid about each colony (the paper's
equations 6 and 7)."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.effect import DIVISION, TRANSPORT, Binding, BoundEffect, Effect
from torchfilm.effects.bound_medium import BoundMedium, FirstHalf
from torchfilm.effects.medium_coverage import BLOCK, DaughtersCoverage, GridCoverage
from torchfilm.effects.medium_transport import EXACT, Transport
from torchfilm.effects.medium_values import warn_of_faces
from torchfilm.effects.signal import Flow, Signal, check_boundary, reach_of, smear_of, velocity
from torchfilm.parameters import number_range
from torchfilm.signals.boundary_conditions import BoundaryConditions
from torchfilm.signals.exchange import turns_error
from torchfilm.signals.schedule import Schedule, each_value
from torchfilm.signals.space import (
    check_growing,
    check_margin,
    check_same_faces,
    check_used,
    checked_box,
)
from torchfilm.signals.transport import COMPILED, METHODS
from torchfilm.signals.transport_series import MOST
from torchfilm.state import COLONY, GRID, OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.backends import check_backend, why_torch
from torchfilm.tools.parts import keywords
from torchfilm.tools.units import AMOUNT

OUTSIDE_CELLS = ("error", "grow", "reservoir")
EXCHANGES = ("turns", "together")
SPLITTINGS = ("lie", "strang")


@dataclass(frozen=True, init=False, eq=False)
class Medium(Effect):
    """Signals around the cells, on one grid per colony: `Medium(ahl=Signal(diffusion=10.0),
    box=((-64, -64), (64, 64)), spacing=4.0)`.

    box: lower and upper corner, µm, in 2 or 3 dimensions. A flat box is one layer, `depth` µm thick
    (by default the width of a voxel). In a 3-D scene with outside="error", a flat box requires the
    depth. Cells of a 2-D scene in a 3-D box lie in the plane z = `height`. spacing: of voxels, µm,
    one number or one per axis.

    boundary: the faces of the box. Default: no flux; if the medium flows, open faces. flow:
    velocity of the medium, µm/h: two or three numbers (or one per colony each), or a function from
    positions (M, 3) µm to velocities (M, 3). obstacles: a function from positions (M, 3) µm to (M,)
    bool, true where there is no medium.

    outside: the meaning of cells outside the box. "error": the colony fails. "grow": the box grows
    with its colony, along the axes in `grows`; with "xy+z" the lower face of z stays, such as at a
    wall on which cells grow. "reservoir": around the box each signal has its `reservoir`
    concentration; the fields NAME_reservoir sum what cells give to it, less what they take. margin:
    how far beyond the centres of its cells a box that grows reaches, µm; it then grows voxel by
    voxel, so that its face follows a film. Default: two voxels or more, and it grows by eight.

    exchange: how circuits and the medium exchange signals. "together": circuits and transport of
    these signals are one equation over the step, of second order, whatever crosses a membrane or a
    voxel in seconds. "turns": circuits with a pool for each cell, then transport; of first order,
    and two to three times as fast. Default: together, but in turns where circuits count molecules,
    a nutrient is exchanged as well, or a `method` or `splitting="lie"` is given.
    steps: into which exchange, transport and MediumReactions divide a step of the scene; growth and
    contacts do not.

    method: of transport in turns, and of signals that no cell exchanges: "exponential" (exact if
    there are no obstacles and flow and decay are uniform), "series" (exact), "implicit" (one solve
    an axis), "crank_nicolson" (the paper's) or "euler". Default: "exponential" where possible, else
    "series". splitting: of these, "strang", half of transport before the cells and half after, or
    "lie", cells and then transport. Strang makes the error of the signal many times smaller, for
    one more transport per step.
    backend: "compiled" kernels, on the CPU, or "torch" for transport. Default: compiled where Numba
    is there; gradients by a signal's own numbers by torch where transport is exponential.
    """

    signals: Mapping[str, Signal]
    box: tuple[tuple[float, ...], tuple[float, ...]]
    spacing: tuple[float, ...]
    depth: float | None = None
    height: float = 0.0
    boundary: BoundaryConditions | None = None
    flow: Flow | Schedule = None
    obstacles: Callable[[Tensor], Tensor] | None = None
    outside: str = "error"
    grows: str = "xyz"
    margin: float | None = None
    method: str | None = None
    steps: int = 1
    splitting: str = "strang"
    exchange: str | None = None
    backend: str | None = None

    stage = TRANSPORT
    title = "transport"
    may_repeat = False
    works_on_grid = True
    unnamed = "Name each signal: Medium(ahl=tf.Signal(…), box=…, spacing=…)."

    def __init__(
        self,
        *,
        box: Sequence[Sequence[float]] | np.ndarray,
        spacing: float | Sequence[float],
        depth: float | None = None,
        height: float = 0.0,
        boundary: BoundaryConditions | None = None,
        flow: Flow | Schedule = None,
        obstacles: Callable[[Tensor], Tensor] | None = None,
        outside: str = "error",
        grows: str = "xyz",
        margin: float | None = None,
        method: str | None = None,
        steps: int = 1,
        splitting: str = "strang",
        exchange: str | None = None,
        backend: str | None = None,
        **signals: Signal,
    ):
        options = [f.name for f in fields(self)]
        signals = _named(keywords("Medium", signals, "signals", options))
        low, high, voxel = checked_box(box, spacing, depth, height)
        _check_medium(boundary, outside, grows, margin, method, steps, splitting, obstacles)
        warn_of_faces(boundary, outside, signals)
        if exchange is not None:
            checks.choice("Medium.exchange", exchange, EXCHANGES)
        check_backend("Medium", backend)
        given = {
            "signals": dict(signals),
            "box": (low, high),
            "spacing": voxel,
            "depth": depth,
            "height": float(height),
            "boundary": boundary,
            "flow": velocity("Medium.flow", flow),
            "obstacles": obstacles,
            "outside": outside,
            "grows": grows,
            "margin": margin,
            "method": method,
            "steps": int(steps),
            "splitting": splitting,
            "exchange": exchange,
            "backend": backend,
        }
        for name, value in given.items():
            object.__setattr__(self, name, value)
        if all(self.flow_of(name) is None for name in signals):  # no face is open by default
            still = {name: replace(s, boundary=_still(s.boundary)) for name, s in signals.items()}
            object.__setattr__(self, "boundary", _still(self.boundary))
            object.__setattr__(self, "signals", still)
        self._check_periodic()
        if margin is not None:
            check_margin(margin, grows, (low, high), voxel)
        check_used(self)

    def _check_periodic(self) -> None:
        found = {self.boundary_of(name).periodic for name in self.signals}
        if len(found) > 1:
            raise checks.InputError(
                "Medium: a face is periodic for one signal and not for another. Make it periodic"
                " for all signals or for none."
            )
        check_growing(next(iter(found)), self.outside, self.grows)

    def check_scene(self, effects: Sequence[Effect], founders: Any) -> None:
        """Raise InputError where cells live in a periodic space and signals do not."""
        spaces = [e.periodic_space for e in effects if e.periodic_space is not None]
        if spaces:
            periodic = self.boundary_of(next(iter(self.signals))).periodic
            check_same_faces(spaces[0].faces, periodic, self.box)

    def boundary_of(self, name: str) -> BoundaryConditions:
        """The boundary conditions of a signal."""
        given = self.signals[name].boundary or self.boundary or BoundaryConditions()
        return given if self.flow_of(name) is None else given.in_flow()

    def flow_of(self, name: str) -> Flow | Schedule:
        """The velocity that carries a signal, or None."""
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

    @property
    def voxels(self) -> tuple[int, ...]:
        """How many there are along the three axes."""
        return tuple(round((b - a) / h) for a, b, h in zip(*self.corners, strict=True))

    @property
    def carries_in_turns(self) -> bool:
        """Whether it is given what only transport in turns has: a method, or a splitting."""
        return self.method is not None or self.splitting != "strang"

    @property
    def halves(self) -> bool:
        """Whether transport takes half a step before exchange with the cells, and half after."""
        return self.splitting == "strang"

    def declares(self, dim: int) -> tuple[Field, ...]:
        unit = {n: signal.concentration_unit for n, signal in self.signals.items()}
        fields = [
            Field(OUTSIDE + n, "signal in the medium", unit[n], scope=GRID) for n in self.signals
        ]
        if self.outside == "reservoir":
            # float64: after thousands of steps, a float32 sum would round away what a step adds
            meaning = "amount given to the reservoir outside the box, less what was taken"
            fields += [
                Field(f"{n}_reservoir", meaning, x + AMOUNT, scope=COLONY, dtype=torch.float64)
                for n, x in unit.items()
            ]
        return tuple(fields)

    def reads(self) -> tuple[str, ...]:
        return tuple(OUTSIDE + name for name in self.signals)

    def writes(self) -> tuple[str, ...]:
        return tuple(OUTSIDE + name for name in self.signals)

    def idle_without(self, state: State) -> Mapping[str, str]:
        return {OUTSIDE + n: _stays_0(n) for n in self.signals if not self._is_supplied(n)}

    def _is_supplied(self, name: str) -> bool:
        """Whether a signal may be above 0 though no effect gives it. A value that is not a plain
        number may be."""
        signal = self.signals[name]
        faces = [face for pair in self.boundary_of(name).pairs for face in pair]
        values = [signal.initial, signal.source, *(face.outside_value() for face in faces)]
        values += [signal.reservoir] if self.outside == "reservoir" else []
        return any(not isinstance(x, (int, float)) or x != 0 for x in values)

    def check_step(self, dt: float, divides: bool) -> None:
        for what, schedule in self._scheduled().items():
            schedule.warn_of_mean(f"the Schedule of the {what}", dt)

    def _scheduled(self) -> dict[str, Schedule]:
        """The schedules, by what they are of."""
        given: dict[str, Any] = {}
        for name, signal in self.signals.items():
            given |= {f"source of {name}": signal.source, f"flow of {name}": self.flow_of(name)}
            given[f"reservoir of {name}"] = signal.reservoir
            for axis, pair in zip("xyz", self.boundary_of(name).pairs, strict=True):
                for end, face in zip(("low", "high"), pair, strict=True):
                    given[f"{end} face along {axis} of {name}"] = face.outside_value()
        return {what: x for what, x in given.items() if isinstance(x, Schedule)}

    def bind(self, binding: Binding) -> Sequence[BoundEffect]:
        transport = Transport(self, binding)
        main = BoundMedium(self, binding, transport)
        before = [FirstHalf(self, binding, transport)] if self.halves else []
        # a grid that grows does so before cells exchange signals in the next step
        late = binding.division_stage == DIVISION and self.outside != "grow"
        after = [DaughtersCoverage(self, binding, transport)] if late else []
        return (*before, GridCoverage(self, binding, transport), main, *after)

    def backend_on(self, device: torch.device) -> str:
        """Who computes transport on a device: "compiled" or "torch"."""
        return "torch" if why_torch("Medium", self.backend, device) else "compiled"

    def numerics(
        self,
        dt: float,
        state: State,
        exchanged: Collection[str] = frozenset(),
        coupled: Mapping[str, str] | None = None,
        found: Collection[str] | None = None,
    ) -> list[str]:
        """exchanged: the signals that cells and transport move in turns, `steps` of them. coupled:
        those that others move, by whom; these describe it themselves. found: those that cells may
        find; by default all."""
        coupled = coupled or {}
        assert state.layout is not None
        shape, spacing = state.layout.grid.shape[0].tolist(), state.layout.grid.spacing
        wide = " × ".join(f"{h:g}" for h in spacing)
        voxels = f"{' × '.join(map(str, shape))} voxels of {wide} µm"
        flat = shape[2] == 1 and self.depth is None and len(self.box[0]) == 2
        lines = [f"grid: {voxels} a colony" + (", as deep as a voxel is wide" if flat else "")]
        widths = [h * (n > 1) for n, h in zip(shape, spacing, strict=True)]
        finest = min(filter(None, widths), default=spacing[0])
        if len(coupled) < len(self.signals):
            strang = "half of transport before the cells, half after (Strang)"
            lines.append(strang if self.halves else "cells, then transport (Lie)")
        if exchanged and self.steps > 1:
            names = ", ".join(sorted(exchanged))
            lines.append(f"{self.steps} turns of cells and transport in a step, for {names}")
        lines += [f"{what} {x.told}" for what, x in self._scheduled().items()]
        lines += [f"{n}: moved together with {coupled[n]}, see there" for n in sorted(coupled)]
        for name, signal in self.signals.items():
            lines += reach_of(name, signal, finest)
            lines += smear_of(name, signal, self.flow_of(name), widths)
            if name in coupled:
                continue
            whole = not self.halves or (name in exchanged and self.steps > 1)
            part = dt / self.steps / (1 if whole else 2)
            method, why = self.method_of(name)
            by = 2 if method == "crank_nicolson" else 1
            order = "exact over a step" if method in EXACT else f"order {by} in steps of {part:g} h"
            if method == "series":
                order += (
                    f" (but where voxels exchange over {MOST:g} times in it, backward Euler, all"
                    " axes in one solve of some hundred iterations, with the same steady states)"
                )
            ratio = number_range(torch.as_tensor(signal.diffusion) * (dt / finest**2))
            who = self.backend_on(state.device) if method in COMPILED else "torch"
            if who == "compiled" and method == "exponential":
                who += "; by torch where gradients by its numbers are required"
            lines.append(f"{name}: {method}, {order} ({why}), {who}; dt·K/h² = {ratio}")
            if found is None or name in found:
                lines += self._cost_of_turns(name, dt, state, name in exchanged)
        return lines

    def _cost_of_turns(self, name: str, dt: float, state: State, often: bool) -> list[str]:
        """What it costs a signal that cells and transport take turns, where that is over 1 %: of
        the colony that it concerns most. A line, or none. often: in each of the medium's steps."""
        signal, strang = self.signals[name], self.halves
        if callable(signal.decay) or state.layout is None:
            return []
        grid = state.layout.grid
        given = (torch.as_tensor(x).detach() for x in (signal.diffusion, signal.decay))
        each = torch.stack(torch.broadcast_tensors(*given), -1).view(-1, 2).unique(dim=0).tolist()
        error = lambda turns: min(turns_error(k, d, grid, dt / turns, strang) for k, d in each)
        now = enough = self.steps if often else 1
        if error(now) > -0.01:
            return []
        while error(enough) < -0.01:
            enough *= 2
        remedy = f"with Medium(steps={enough})" if often else f"in steps of {dt / enough:.2g} h"
        return [
            f"{name}: cells and transport take turns, so a cell finds its own steady signal up to"
            f" {-100 * error(now):.2g} % too low; below 1 % {remedy}"
        ]

    def method_of(self, name: str) -> tuple[str, str]:
        """The transport method of a signal, and the reason for it: the same choice as
        `signals.transport.choose` makes."""
        if self.method is not None:
            return self.method, "as given"
        found = {
            "obstacles": self.obstacles is not None,
            "a flow that differs from place to place": any(
                map(callable, each_value(self.flow_of(name)))
            ),
            "a decay that differs from place to place": callable(self.signals[name].decay),
        }
        against = [words for words, there in found.items() if there]
        if against:
            return "series", "because of " + " and ".join(against)
        return "exponential", "no obstacle, and flow and decay the same everywhere"

    @property
    def coverage(self) -> str:
        """The treatment of cells outside the box, as text."""
        how = f"{BLOCK} voxels at a time"
        if self.margin is not None:
            how = f"voxel by voxel, to {self.margin:g} µm beyond the centres of its cells"
        return {
            "error": "a colony fails if a cell is outside the box",
            "grow": f"the box grows with its colony along {self.grows}, {how}",
            "reservoir": "cells outside the box meet a reservoir of constant concentration",
        }[self.outside]


def _stays_0(name: str) -> str:
    """The warning of a signal that nothing supplies."""
    return (
        f"the signal {name!r} of the Medium is 0 and stays 0: no effect gives it, and it has no"
        " source, no first value, and no face or reservoir that supplies it. Let cells give it (the"
        f" second dict of a circuit, {{{name!r}: …}}, or tf.Lysis(releases=…)), write"
        f" {name}=tf.Signal(…, source=…) or initial=…, or leave it out."
    )


def _named(signals: dict[str, Any]) -> dict[str, Any]:
    """The signals by name, checked."""
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
    return signals


def _still(boundary: BoundaryConditions | None) -> BoundaryConditions | None:
    """The faces of a medium that does not flow, all of them said."""
    return None if boundary is None else BoundaryConditions(*boundary.pairs)


def _check_medium(
    boundary: object,
    outside: str,
    grows: object,
    margin: object,
    method: str | None,
    steps: object,
    splitting: str,
    obstacles: object,
) -> None:
    check_boundary("Medium.boundary", boundary)
    checks.choice("Medium.outside", outside, OUTSIDE_CELLS)
    if not isinstance(grows, str) or not re.fullmatch("([+-]?[xyz])+", grows):
        raise checks.input_error(
            "Medium.grows",
            grows,
            'some of the letters x, y and z, with a sign for one face alone, such as "xy+z"',
        )
    if margin is not None:
        checks.number("Medium.margin", margin, above=0.0)
        if outside != "grow":
            raise checks.input_error("Medium.margin", margin, "left out but with outside='grow'")
    if method is not None:
        checks.choice("Medium.method", method, tuple(METHODS))
    checks.integer("Medium.steps", steps, least=1)
    checks.choice("Medium.splitting", splitting, SPLITTINGS)
    if obstacles is not None and not callable(obstacles):
        raise checks.input_error("Medium.obstacles", obstacles, "a function of positions")
