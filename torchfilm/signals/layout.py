"""The layout of a medium: the grid of a scene's signals, obstacles and reservoir.

It is the part of a medium that a state contains.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from torchfilm.signals import compiled
from torchfilm.signals.exchange import Stencil, beyond, counted, pool_volume, read, stencil
from torchfilm.signals.grid import Grid, GridBatch
from torchfilm.tools import checks
from torchfilm.tools.ragged import Groups, expand_ranges


class UnknownSignal(checks.InputError, KeyError):
    """A state was asked for a signal that it does not have."""

    __str__ = Exception.__str__  # a KeyError shows its message in quotes


class Signals(dict[str, Tensor]):
    """Values of signals by name."""

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise checks.InputError(
            "the signals of a state cannot be set: it stays as it is. Make another: state ="
            " state.with_fields(**{'out.NAME': …})."
        )

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self),)

    def __missing__(self, name: str) -> Tensor:
        raise UnknownSignal(
            f"the state has no signal {name!r}; its signals are"
            f" {', '.join(self) or 'none: list a Medium in the scene'}"
        )


@dataclass(frozen=True, eq=False)
class Contact:
    """Where cells meet the medium.

    found: the concentration of each signal at the cells, (N,) by name. in_reservoir: (N,) bool,
    cells in the reservoir beyond the box, or None if there are none. in_voxels: as found, but also
    for these what the voxels have.
    """

    stencil: Stencil
    found: dict[str, Tensor]
    in_reservoir: Tensor | None
    in_voxels: dict[str, Tensor]

    @cached_property
    def pool(self) -> Tensor:
        """The volume whose whole content each cell may take up, (N,) µm³."""
        return pool_volume(self.stencil)


@dataclass(frozen=True, eq=False)
class Layout:
    """The space of a medium.

    grid: one per colony. periodic: the axes along which space is periodic. height: z of the plane
    of 2-D cells, µm. obstacle: a function from positions (nodes, 3) µm to (nodes,) bool, true where
    no signal can be, or None. reservoir: None, or the concentration of each signal by name for
    cells beyond the box, one number or one per colony of the scene.
    """

    grid: Grid
    periodic: tuple[bool, bool, bool] = (False, False, False)
    height: float = 0.0
    obstacle: Callable[[Tensor], Tensor] | None = None
    reservoir: Mapping[str, float | Tensor] | None = None

    @cached_property
    def mask(self) -> Tensor | None:
        """(nodes,) bool, true in the medium; None without obstacles."""
        if self.obstacle is None:
            return None
        solid = self.obstacle(self.grid.centres())
        if (
            not isinstance(solid, Tensor)
            or solid.shape != (self.grid.nodes,)
            or solid.dtype != torch.bool
        ):
            shown = (tuple(solid.shape), solid.dtype) if isinstance(solid, Tensor) else solid
            raise checks.input_error(
                "obstacles(positions)",
                shown,
                f"a bool tensor of shape ({self.grid.nodes},), one value per position",
            )
        if not bool((~solid).any()):
            raise checks.InputError(
                "obstacles(positions) is true everywhere, so no medium remains. Return False where"
                " signals can be."
            )
        return ~solid

    def position_3d(self, position: Tensor) -> Tensor:
        """The positions of cells at (N, d) in the grid's three dimensions, (N, 3) float64, µm."""
        if position.shape[1] == 3:
            return position.double()
        return torch.cat(
            [
                position.double(),
                position.new_full((position.shape[0], 1), self.height, dtype=torch.float64),
            ],
            1,
        )

    def stencil(self, position: Tensor, colony: Tensor, dtype: torch.dtype) -> Stencil:
        """The stencil of cells at (N, d) µm of colonies (N,)."""
        return stencil(
            self.grid,
            self.position_3d(position),
            colony,
            periodic=self.periodic,
            mask=self.mask,
            dtype=dtype,
        )

    def outside_medium(self, position: Tensor, groups: Groups) -> tuple[Tensor, Tensor]:
        """How many cells at (N, d) µm of each colony are outside the medium, (B,), and the first of
        them; N where there is none. groups: the cells of each colony.

        They are in an obstacle, or beyond a box without a reservoir.
        """
        if self.obstacle is None:
            return beyond(self.grid, self.position_3d(position), groups, self.periodic)
        where = self.stencil(position, groups.owner, torch.float64)
        assert where.blocked is not None
        return counted(where.outside if self.reservoir is None else where.blocked, groups)

    def contact(
        self,
        position: Tensor,
        colony: Tensor,
        ids: Tensor,
        signals: Mapping[str, Tensor],
        dtype: torch.dtype,
    ) -> Contact:
        """The concentration of each signal (nodes,) at cells at (N, d) µm of colonies (N,), those
        of one colony side by side.

        ids: (B,), those of the colonies.
        """
        where = self.stencil(position, colony, dtype)
        if colony.device.type == "cpu" and len(ids) > 1:  # for threads
            ends = np.searchsorted(colony.numpy(), np.arange(len(ids) + 1))
            where = replace(where, ends=ends)
        found = {name: read(value, where) for name, value in signals.items()}
        if self.reservoir is None:
            return Contact(where, found, None, found)
        in_reservoir = where.outside if where.blocked is None else where.outside & ~where.blocked
        if not bool(in_reservoir.any()):
            return Contact(where, found, None, found)
        in_voxels, own = dict(found), ids.index_select(0, colony)
        for name, value in in_voxels.items():
            given = torch.as_tensor(self.reservoir[name], dtype=value.dtype, device=value.device)
            found[name] = torch.where(
                in_reservoir, given.index_select(0, own) if given.dim() else given, value
            )
        return Contact(where, found, in_reservoir, in_voxels)

    def meeting(
        self,
        position: Tensor,
        colony: Tensor,
        ends: np.ndarray,
        signals: Mapping[str, Tensor],
        dtype: torch.dtype,
    ) -> compiled.Meeting | None:
        """What `contact` finds, by loops of kernels; None where torch must find it, or where it
        depends on it what is to be done.

        position: (N, 3). ends: where the cells of each colony begin, and N."""
        alike = all(x.dtype == dtype for x in signals.values())
        if self.reservoir is not None or not alike:
            return None
        if not compiled.may_run(position, *signals.values()):
            return None
        space = self.periodic, self.mask
        return compiled.Meeting(self.grid, position, colony, ends, *space, signals, dtype)

    def on_faces(
        self, flow: Callable[[Tensor], Tensor], batch: GridBatch
    ) -> tuple[Tensor, Tensor, Tensor]:
        """A velocity field on the voxel faces of some colonies.

        flow: a function from positions (M, 3) µm to velocities (M, 2 or 3). Returns (b, nx + 1, ny,
        nz) along x, and so on.
        """
        out = []
        step, origin = self.grid.step, self.grid.origin.index_select(0, batch.colonies)
        for axis in range(3):
            counts = [n + (k == axis) for k, n in enumerate(batch.shape)]
            lines = [
                (torch.arange(n, device=origin.device) + (0.0 if k == axis else 0.5)) * step[k]
                for k, n in enumerate(counts)
            ]
            faces = torch.stack(torch.meshgrid(*lines, indexing="ij"), -1) + origin.reshape(
                -1, 1, 1, 1, 3
            )
            found = flow(faces.reshape(-1, 3))
            size = faces[..., 0].numel()
            if not isinstance(found, Tensor) or found.shape not in ((size, 2), (size, 3)):
                raise checks.input_error(
                    "flow(positions)",
                    tuple(getattr(found, "shape", ())),
                    f"velocities of shape ({size}, 3)",
                )
            part = found[:, axis] if axis < found.shape[1] else torch.zeros_like(found[:, 0])
            out.append(part.reshape(faces.shape[:-1]))
        return out[0], out[1], out[2]

    def on(self, grid: Grid) -> Layout:
        """The same medium on another grid."""
        return self if grid is self.grid else replace(self, grid=grid)

    def joined(self, other: Layout) -> Layout:
        """The grids of both, one after the other, in the space of this one."""
        origin = torch.cat([self.grid.origin, other.grid.origin])
        shape = torch.cat([self.grid.shape, other.grid.shape])
        return self.on(Grid(origin, shape, self.grid.spacing))

    def take(self, colonies: Tensor) -> tuple[Layout, Tensor]:
        """The layout of some colonies (b,), and the indices (nodes,) of their voxels here."""
        grid = Grid(
            self.grid.origin.index_select(0, colonies),
            self.grid.shape.index_select(0, colonies),
            self.grid.spacing,
        )
        _, rows = expand_ranges(
            self.grid.offsets.index_select(0, colonies), self.grid.counts.index_select(0, colonies)
        )
        return self.on(grid), rows

    def to(self, device: str | torch.device) -> Layout:
        """The same layout on another device."""
        return self.on(
            Grid(self.grid.origin.to(device), self.grid.shape.to(device), self.grid.spacing)
        )
