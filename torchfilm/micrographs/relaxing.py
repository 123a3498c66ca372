"""Overlapping cells, pushed apart by the contacts of the simulation."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchfilm.physics.space import Faces
from torchfilm.physics.walls import Wall, depth_in_walls
from torchfilm.tools import checks

if TYPE_CHECKING:
    from torchfilm.initial_cells import Cells
    from torchfilm.state import State

STEPS, STEP = 200, 0.025  # how many steps at most; h, as long as a step of growth


def relax(cells: Cells, depth: float, walls: Sequence[Wall], periodic: Faces | None) -> Cells:
    """`Cells.relaxed` documents it. A scene without growth has contacts only, which push."""
    from torchfilm.effects.mechanics import Mechanics
    from torchfilm.scene import Scene

    checks.number("depth", depth, above=0.0, hint="µm.")
    # a soft wall would push for ever less
    mechanics = Mechanics(dim=cells.dim, walls=walls, periodic={} if periodic is None else periodic)
    hard = [replace(w, stiffness=None, weight=None) for w in mechanics.walls]
    plain = replace(cells, cell_type=None, extra={}, micrograph=None)
    with warnings.catch_warnings():
        # that cells start in one another is why they are relaxed
        warnings.filterwarnings("ignore", category=RuntimeWarning, message="cells .* start")
        model = Scene(replace(mechanics, walls=hard), founders=plain).bind()
        state = model.start()
    of = np.arange(cells.count) if cells.colony is None else np.argsort(cells.colony, kind="stable")
    now = cells
    for _ in range(STEPS + 1):
        found, deepest = now.overlaps(depth, periodic=periodic), _deepest(state, hard)
        if not found and deepest <= depth:
            break
        state = model.step(state, STEP)
        position, axis = np.empty_like(cells.position), np.empty_like(cells.axis)
        position[of], axis[of] = state.position.cpu().numpy(), state.axis.cpu().numpy()
        now = replace(cells, position=position, axis=axis)
    else:
        worst = f", a cell and a wall by {deepest:.3g} µm" if deepest > depth else ""
        if found:
            i, j, deep = found[0]
            worst = f": {len(found)} pairs, the worst cells {i} and {j} by {deep:.3g} µm{worst}"
        raise checks.SimulationError(
            f"the cells still overlap after {STEPS} steps{worst}. Allow more by depth=…, or check"
            " the lengths and radii."
        )
    if cells.micrograph is None or now is cells:
        return now
    way = torch.from_numpy(now.position - cells.position).T
    if mechanics.periodic_space is not None:
        way = way + mechanics.periodic_space.shift(way)
    moved = way.norm(dim=0).numpy()
    return replace(now, micrograph=replace(cells.micrograph, moved=moved))


def _deepest(state: State, walls: Sequence[Wall]) -> float:
    """How deep a cell lies in a wall, µm."""
    where = state.position, state.axis, state.length, state.radius, state.own_colony_id
    return float(depth_in_walls(walls, *where).max())
