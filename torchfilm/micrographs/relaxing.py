"""Overlapping cells, pushed apart by the contacts of the simulation."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from torchfilm.tools import checks

if TYPE_CHECKING:
    from torchfilm.initial_cells import Cells

STEPS, STEP = 200, 0.025  # how many steps at most; h, as long as a step of growth


def relax(cells: Cells, depth: float) -> Cells:
    """`Cells.relaxed` documents it. A scene without growth has contacts only, which push."""
    from torchfilm.effects.mechanics import Mechanics
    from torchfilm.scene import Scene

    checks.number("depth", depth, above=0.0, hint="µm.")
    found = cells.overlaps(depth)
    if not found:
        return cells
    plain = replace(cells, cell_type=None, extra={}, micrograph=None)
    with warnings.catch_warnings():
        # that cells start in one another is why they are relaxed
        warnings.filterwarnings("ignore", category=RuntimeWarning, message="cells .* start")
        model = Scene(Mechanics(dim=cells.dim), founders=plain).bind()
        state = model.start()
    of = np.arange(cells.count) if cells.colony is None else np.argsort(cells.colony, kind="stable")
    for _ in range(STEPS):
        state = model.step(state, STEP)
        position, axis = np.empty_like(cells.position), np.empty_like(cells.axis)
        position[of], axis[of] = state.position.cpu().numpy(), state.axis.cpu().numpy()
        now = replace(cells, position=position, axis=axis)
        found = now.overlaps(depth)
        if not found:
            break
    else:
        i, j, deep = found[0]
        raise checks.SimulationError(
            f"the cells still overlap after {STEPS} steps: {len(found)} pairs, the worst cells {i}"
            f" and {j} by {deep:.3g} µm. Allow more by depth=…, or check the lengths and radii."
        )
    if cells.micrograph is None:
        return now
    moved = np.sqrt(((position - cells.position) ** 2).sum(1))
    return replace(now, micrograph=replace(cells.micrograph, moved=moved))
