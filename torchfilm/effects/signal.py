"""A signal of a medium, as it is described: how it spreads, where it comes from, what holds at the
faces."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchfilm.parameters import number_range
from torchfilm.signals.boundary_conditions import BoundaryConditions
from torchfilm.signals.schedule import Schedule, checked_values
from torchfilm.signals.space import checked_flow
from torchfilm.tools import checks
from torchfilm.tools.units import CONCENTRATION, checked_unit
from torchfilm.values import Distribution, PerColony, Rule, checked

# A value on the grid: a number, one per colony, or a function from positions (M, 3) µm to (M,).
OnGrid = checks.Value | Callable[[Tensor], Tensor]
# A velocity: two or three numbers (or one per colony each), or a function from positions (M, 3) µm
# to velocities (M, 3).
Flow = Sequence[checks.Value] | Callable[[Tensor], Tensor] | None


SMEARED = 0.1  # of its own diffusion, that voxels add where it flows
RESOLVED = 2.0  # voxels in the reach of a signal, below which its profile is coarse


@dataclass(frozen=True, eq=False)
class Signal(metaclass=checks.KnownKeywords):
    """A substance outside the cells.

    diffusion: K, µm²/h, one number or one per colony. decay: 1/h. initial: concentration at the
    start. source: production, concentration/h. Each of these three is one number, one per colony,
    or a function from positions (M, 3) µm to (M,). initial may be a distribution, too, such as
    `tf.Normal(1.0, 0.1)`: each voxel draws its own, by the seed. boundary, flow: faces of the box,
    and velocity, µm/h, if they differ from the medium's. reservoir: the concentration outside an
    open box, one number or one per colony. concentration_unit: its name, such as "nM", for pictures
    and tables.

    source, flow and reservoir, and what the faces are given, may be a `Schedule`.
    """

    diffusion: checks.Value
    decay: OnGrid = 0.0
    initial: OnGrid | Distribution = 0.0
    source: OnGrid | Schedule = 0.0
    boundary: BoundaryConditions | None = None
    flow: Flow | Schedule = None
    reservoir: checks.Value | Schedule = 0.0
    # repr=False: a name alone, which does not count for a scene's digest
    concentration_unit: str = field(default=CONCENTRATION, repr=False)

    instead: ClassVar[Mapping[str, str]] = {
        "D": "Did you mean diffusion?",
        "K": "Did you mean diffusion?",
        "unit": "Did you mean concentration_unit?",
    }

    def __post_init__(self) -> None:
        check_boundary("Signal.boundary", self.boundary)
        given = {
            "diffusion": _number("Signal.diffusion", self.diffusion),
            "decay": _on_grid("Signal.decay", self.decay),
            "initial": _initial("Signal.initial", self.initial),
            "source": checked_values("Signal.source", self.source, _on_grid),
            "reservoir": checked_values("Signal.reservoir", self.reservoir, _number),
            "flow": velocity("Signal.flow", self.flow),
            "concentration_unit": checked_unit(
                "Signal.concentration_unit", self.concentration_unit
            ),
        }
        for name, value in given.items():
            object.__setattr__(self, name, value)


def reach_of(name: str, signal: Signal, spacing: float) -> list[str]:
    """How far a signal that decays reaches, √(K/k), beside the finest spacing, µm, as a line; none
    where its decay is not one number, or 0."""
    if callable(signal.decay):
        return []
    diffusion, decay = (torch.as_tensor(x).double() for x in (signal.diffusion, signal.decay))
    if bool((decay <= 0).any() | (diffusion <= 0).any()):
        return []
    reach = (diffusion / decay).sqrt()
    voxels = float(reach.detach().min()) / spacing
    few = "" if voxels >= RESOLVED else f": {voxels:.2g} voxels, too few to resolve it"
    return [f"{name} reaches √(K/k) = {number_range(reach)} µm{few}"]


def smear_of(name: str, signal: Signal, flow: Any, spacing: Sequence[float]) -> list[str]:
    """What the voxels add to the diffusion of a signal that flows, as a line: along the axis where
    it is most. None where it is little, and where the flow is not numbers.

    Between voxels the flux is that of a steady profile, as by K_h = (v h/2) coth(v h/2K).
    """
    if not isinstance(flow, tuple) or not any(bool((torch.as_tensor(v) != 0).any()) for v in flow):
        return []
    own, found = torch.as_tensor(signal.diffusion).double().reshape(-1), []
    for axis, v, h in zip("xyz", flow, spacing, strict=False):
        half = (torch.as_tensor(v).double().abs() * (h / 2)).reshape(-1)
        pairs = zip(*(x.tolist() for x in torch.broadcast_tensors(half, own)), strict=True)
        spread = lambda x, k: x / math.tanh(x / k) - k if k > 0 else x
        found += [(spread(x, k), k, x, axis) for x, k in pairs if x > 0]
    if not found:
        return []
    more, k, half_most, axis = max(
        found, key=lambda x: (x[0] / x[1] if x[1] > 0 else math.inf, x[0])
    )
    if more <= SMEARED * k:
        return []
    times = f", {more / k:.2g} times its own" if k > 0 else ""
    return [
        f"{name}: voxels add {more:.3g} µm²/h to its diffusion along {axis}{times}, since it flows"
        f" by v·h = {2 * half_most:.3g} µm²/h; in proportion to their size"
    ]


def _number(name: str, given: Any) -> Any:
    """One number, or one per colony, at least 0."""
    made = checked(name, given, Rule(scope="colony", least=0.0))
    return made.values if isinstance(made, PerColony) else made


def _initial(name: str, given: Any) -> OnGrid:
    """As `_on_grid`, or a distribution from which each voxel draws."""
    if not isinstance(given, Distribution):
        return _on_grid(name, given)
    if given.inherited:
        rule = "drawn for each voxel: leave inherited out"
        raise checks.input_error(name, given, rule)
    return checked(name, given, Rule(least=0.0))


def _on_grid(name: str, given: Any) -> OnGrid:
    # a schedule can be called, too, but not with positions
    if callable(given) and not isinstance(given, Schedule):
        return given
    rows = isinstance(given, (list, tuple)) and given and isinstance(given[0], (list, tuple))
    if rows or getattr(given, "ndim", 0) == 2:
        shown = f"{len(given)} rows of numbers"
        rule = "one number, one per colony, or a function of positions"
        hint = "An image is such a function: tf.ImageField(pixels, size=(64.0, 48.0)), size in µm."
        raise checks.input_error(name, shown, rule, hint)
    return _number(name, given)


def velocity(name: str, given: Any) -> Any:
    """A checked velocity, or a schedule of them."""
    if isinstance(given, (tuple, list)):
        for k, part in enumerate(given):
            if isinstance(part, Schedule):
                hint = "Such as flow=tf.Schedule({0: (0.0, 0.0), 2: (40.0, 0.0)})."
                rule = "a number: a schedule is one of whole velocities"
                raise checks.input_error(f"{name}[{k}]", part, rule, hint)
    return checked_values(name, given, lambda name, flow: checked_flow(name, _bare(flow)))


def _bare(flow: Any) -> Any:
    """A velocity whose components for each colony are plain numbers."""
    if not isinstance(flow, (tuple, list)):
        return flow
    return tuple(v.values if isinstance(v, PerColony) else v for v in flow)


def check_boundary(name: str, given: object) -> None:
    """Raise InputError for what are no boundary conditions."""
    if given is not None and not isinstance(given, BoundaryConditions):
        raise checks.input_error(
            name,
            given,
            "BoundaryConditions",
            "Write boundary=tf.BoundaryConditions(x=tf.Open(), y=tf.NoFlux()).",
        )
