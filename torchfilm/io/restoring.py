"""From a recorded frame back to a state that `simulate` can continue, or to cells that another
scene starts from."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.binding import bind
from torchfilm.binding_checks import another_quantity
from torchfilm.initial_cells import Cells
from torchfilm.io.identity import check_fields, check_same_scene, declared_fields
from torchfilm.io.schema import check_frame
from torchfilm.physics.space import PeriodicSpace
from torchfilm.scene import Scene
from torchfilm.signals.grid import Grid
from torchfilm.signals.layout import Layout
from torchfilm.state import OUTSIDE, PER_CELL, Field, State
from torchfilm.tools import checks
from torchfilm.tools.warn_once import quietly, warn

if TYPE_CHECKING:
    from torchfilm.io.results import Results

# Fields that a scene sets for its own cells, and that would overrule those of another scene.
SET_BY_EFFECTS = ("growth_rate", "division_threshold", "birth_length")


def cells_of(results: Results, frame: int, fields: Sequence[str] | None) -> Cells:
    """The cells of a frame; see `Results.cells`."""
    found = results.frame(frame)
    own = ("position", "axis", "length", "radius", "colony", "cell_type")
    serving = {*results.internal_fields, "uid", "parent", *own}
    known = {n: v for n, v in found.items() if n not in serving and v.ndim == 1}
    for name in known if fields is None else fields:
        checks.choice("fields", name, tuple(known))
    usual = [n for n in known if n not in SET_BY_EFFECTS and not n.endswith("_eaten")]
    extra = {n: known[n] for n in (usual if fields is None else fields)}
    columns: dict[str, Any] = {n: found.get(n) for n in own}
    _warn_of_places(results.colony_id.tolist(), found["colony"])
    return Cells(**columns, extra=extra)


def _warn_of_places(ids: list[int], colony: np.ndarray) -> None:
    """Warn where first cells have other colonies than those of the run: places in its batch, up to
    the last that has cells."""
    if ids != list(range(len(ids))):
        some = ", ".join(map(str, ids[:8])) + ", …" * (len(ids) > 8)
        warn(
            f"the run's colonies have the ids {some}; its cells become those of the"
            f" colonies 0 to {len(ids) - 1}, in this order, of the scene that begins with them."
            " Give values per colony in this order, too."
        )
    count = int(colony.max()) + 1 if len(colony) else 0
    if 0 < count < len(ids):
        warn(
            f"the last {len(ids) - count} of the run's {len(ids)} colonies have no cells in this"
            f" frame: bind(colonies={len(ids)}, cells=…) keeps their places."
        )


def restore_state(
    results: Results, scene: Scene | None, frame: int, device: str | torch.device | None,
    changed: bool,
) -> State:  # fmt: skip
    """The state at a frame; see `Results.state`."""
    device = torch.device(device if device is not None else "cpu")
    template = (
        _bare(results, frame, device)
        if scene is None
        else _template(results, scene, device, changed)
    )

    def tensor(value: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(value)).to(device)

    recorded = results.frame(frame)
    check_frame(results, frame, recorded)
    layout = template.layout
    if layout is not None:
        origin, shape, spacing = results.grid(frame)
        x, y, z = map(float, spacing)
        layout = layout.on(Grid(tensor(origin), tensor(shape), (x, y, z)))
        recorded |= {
            OUTSIDE + n: np.concatenate([x.reshape(-1) for x in results.signal(n, frame)])
            for n in results.signal_names
        }
    recorded |= results.colony_fields(frame)
    declared, hidden = dict(template.declared), results.internal_fields
    effects = () if scene is None else scene.effects
    kept = [name for effect in effects for name in effect.keeps().values()]
    for name, about in declared_fields(results.attributes).items():
        there, known = partial(_field, name, about, recorded, hidden), declared.get(name)
        # what is another quantity to a changed scene is refused where that goes on
        if known is None or (changed and another_quantity(there(), known, kept)):
            declared[name] = there()
    return template.replace(
        **{n: tensor(recorded[n]) for n in PER_CELL},
        colony_id=tensor(results.colony_id),
        stream=tensor(results.stream),
        next_uid=tensor(results.next_uid(frame)),
        step=int(results.steps[frame]),
        time=float(results.times[frame]),
        fields={n: tensor(recorded[n]) for n in declared},
        declared=declared,
        layout=layout,
    )


def _template(results: Results, scene: Scene, device: torch.device, changed: bool) -> State:
    """A first state of the scene, for its declared fields and layout. Raises InputError if the file
    is of another scene."""
    about = results.attributes
    with quietly():
        model = bind(
            scene,
            max(scene.fixed_colonies, int(results.colony_id.max()) + 1),
            seed=int(about["seed"]),
            dtype=getattr(torch, str(about["dtype"])),
            device=device,
            per_colony=True,
            check_first=False,
        )
    template = model.start()
    if template.dim != int(about["dim"]):
        raise checks.input_error(
            "scene", f"{template.dim}-D", f"{about['dim']}-D, as {results.path} is"
        )
    check_fields(results.file, results.path, template)
    if not changed:
        check_same_scene(about, results.path, scene)
    return template


def _bare(results: Results, frame: int, device: torch.device) -> State:
    """A state without cells in the space of a frame, as far as the file knows it."""
    periodic, dim = results.periodic, int(results.attributes["dim"])
    layout, none = None, torch.empty(0, device=device)
    if results.signal_names:
        origin, shape, spacing = results.grid(frame)
        x, y, z = map(float, spacing)
        low, counts = (torch.from_numpy(a).to(device) for a in (origin, shape))
        grid = Grid(low, counts, (x, y, z))
        # cells in two dimensions lie in the middle of a single layer
        flat = dim == 2 and bool((shape[:, 2] == 1).all())
        height = float(origin[0, 2]) + z / 2 if flat else 0.0
        layout = Layout(grid, ("x" in periodic, "y" in periodic, "z" in periodic), height)
    return State(
        colony=none, uid=none, parent=none, position=none, axis=none, length=none, radius=none,
        colony_id=none, stream=none, next_uid=none, seed=int(results.attributes["seed"]),
        layout=layout, space=PeriodicSpace.of("periodic", periodic or None, dim),
    )  # fmt: skip


def _field(
    name: str, about: list, recorded: Mapping[str, np.ndarray], hidden: Container[str]
) -> Field:
    """A field that the file holds and the scene does not declare, such as a column of the initial
    cells."""
    meaning, unit, scope, shape, at_division = about
    dtype = torch.from_numpy(np.atleast_1d(recorded[name])).dtype
    return Field(
        name, meaning, unit, scope, tuple(shape), dtype, at_division=at_division,
        internal=name in hidden,
    )  # fmt: skip
