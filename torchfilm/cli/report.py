"""What the commands print about a run: the summary at its end, and notes on the cells that it
starts from."""

from __future__ import annotations

import sys

import torch

from torchfilm import measure
from torchfilm.initial_cells import Cells
from torchfilm.model import Model
from torchfilm.physics.surfaces import FlatSurface
from torchfilm.physics.walls import Wall
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools.timing import Timings


def summary_table(scene: Scene, state: State, timings: Timings, seconds: float) -> str:
    """The last state of a run in lines: cells, size, overlaps; and where the computing time
    went."""
    walls = _walls(scene)
    found = measure.overlaps(state, walls)
    pairs = found.count.sum().clamp(min=1)
    counts, (what, size) = state.counts, _size(scene, state)
    lines = [
        f"{'colonies':<28}{state.colonies}",
        f"{'cells':<28}{state.cells} ({int(counts.min())} to {int(counts.max())} a colony)",
        (
            f"{'time':<28}{state.time:g} h in {state.step} steps, {seconds:.1f} s on"
            f" {torch.get_num_threads()} thread{'' if torch.get_num_threads() == 1 else 's'}"
        ),
        f"{what:<28}{size}",
        (
            f"{'overlap':<28}mean {float((found.mean * found.count).sum() / pairs):.4f} µm, worst"
            f" {float(found.worst.max()):.3f} µm"
        ),
    ]
    if walls:
        lines.append(
            f"{'overlap with walls':<28}(soft ones yield) worst {float(found.walls.max()):.3f} µm"
        )
    total = sum(timings.seconds.values()) or 1.0
    lines += [
        f"{'time for ' + name:<27} {s:.2f} s ({100 * s / total:.0f} %)"
        for name, s in timings.seconds.items()
    ]
    if (kernels := sys.modules.get("torchfilm.kernels.compiling")) and kernels.seconds_spent():
        spent = f"{kernels.seconds_spent():.1f} s of these, {kernels.HOW_OFTEN}"
        lines.append(f"{'compiling':<28}{spent}")
    return "\n".join(lines)


def _size(scene: Scene, state: State) -> tuple[str, str]:
    """What says how large colonies are, and how large: their radius, or, on a floor along which
    space is periodic, the thickness of the film."""
    if not state.cells:
        return "colony radius", "-: no cell is left (the lineage says why)"
    ground, up = "xyz"[: state.dim - 1], [float(k == state.dim - 1) for k in range(state.dim)]
    floors = [
        s.offset
        for s in scene.wall_surfaces()
        if isinstance(s, FlatSurface) and list(s.normal) == up and isinstance(s.offset, float)
    ]
    faces = {} if state.space is None else state.space.faces
    if len(floors) == 1 and set(faces) == set(ground):
        film = measure.film(state, floor=floors[0])
        thick, rough = (float(x.nanmean()) for x in (film.thickness, film.roughness))
        return "film", f"{thick:.1f} µm thick, roughness {rough:.2f} (mean)"
    return "colony radius", f"{float(measure.colony_radius(state).nanmean()):.1f} µm (mean)"


def _walls(scene: Scene) -> list[Wall]:
    """The walls of all effects, each once. One wall may have several surfaces."""
    return list({id(surface.wall): surface.wall for surface in scene.wall_surfaces()}.values())


def overlaps_note(cells: Cells) -> str:
    """Which of the given cells overlap; empty if none does by over 0.01 µm."""
    found = cells.overlaps(0.01)
    if not found:
        return ""
    i, j, deep = found[0]
    return (
        f"{len(found)} pairs of the given cells overlap by over 0.01 µm, worst cells {i} and {j} by"
        f" {deep:.3g} µm; the first steps separate them."
    )


def extra_columns_note(path: str, cells: Cells, model: Model) -> str:
    """Which columns of the table become fields that no effect of the scene uses; empty if there is
    none."""
    used = {f.name for e in model.effects for f in e.declares()}
    used |= {name for e in model.effects for name in e.reads()}
    extra = [name for name in cells.extra if name not in used]
    if not extra:
        return ""
    hint = " Delete the columns that you do not need." if path.lower().endswith(".csv") else ""
    return (
        f"{path}: {', '.join(extra)} {'is' if len(extra) == 1 else 'are'} recorded as"
        f" {'a quantity' if len(extra) == 1 else 'quantities'} per cell, which no effect uses."
        f"{hint}"
    )
