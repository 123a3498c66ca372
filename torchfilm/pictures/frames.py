"""The data of pictures: cells and signals at one time, from a state or a results file."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from torchfilm.io.identity import walls_of
from torchfilm.io.layout import OBSTACLES
from torchfilm.io.lineage import Lineage
from torchfilm.io.results import Results
from torchfilm.io.table import volumes
from torchfilm.pictures.categories import colours_by_number
from torchfilm.pictures.conditions import names_by_parameters
from torchfilm.scene import Scene
from torchfilm.state import CELL, PER_CELL, State
from torchfilm.tools import checks

UNITS = {"length": "µm", "radius": "µm", "volume": "µm³", "age": "h", "born": "h"}
FOUNDER = "founder"  # a colour for each line of descent
# What is worked out of cells only where it is asked for; ages and founders, a file alone knows.
VOLUME, AGES = "volume", ("age", "born")
OF_FILES = (*AGES, FOUNDER)


@dataclass(frozen=True, eq=False)
class Frame:
    """Cells and signals of B colonies at one time.

    cells: arrays by name as `Results.frame` gives them, the cells of one colony contiguous. time:
    h. colony_id: (B,). units: by name, signals under "out.NAME". signals: by name, one array (nx,
    ny, nz) per colony, on grids with lower corners `origin` (B, 3) and `spacing` (3,), µm. height:
    z of the plane of 2-D cells, µm, if known. walls: as in `Results.walls`. faces: of a periodic
    space, (low, high) µm by axis. internal: the quantities that serve the numerics, which messages
    do not list. names: of the colonies, (B,), for titles; by default their ids. solid: where the
    obstacles of a medium are, one array (nx, ny, nz) bool per colony; empty without them.
    if_asked: what colours cells besides their quantities, and is worked out only where it is asked
    for: of a state `volume`. type_names: of the cells' types 0, 1, …, as far as they have some.
    """

    cells: Mapping[str, np.ndarray]
    time: float
    colony_id: np.ndarray
    units: Mapping[str, str] = field(default_factory=dict)
    signals: Mapping[str, list[np.ndarray]] = field(default_factory=dict)
    origin: np.ndarray | None = None
    shape: np.ndarray | None = None
    spacing: np.ndarray | None = None
    height: float | None = None
    walls: Sequence[Mapping[str, Any]] = ()
    faces: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    internal: Collection[str] = ()
    names: Sequence[str] | None = None
    solid: Sequence[np.ndarray] = ()
    if_asked: Collection[str] = (VOLUME,)
    type_names: Sequence[str] = ()

    def asked(self, names: Collection[str]) -> Frame:
        """The frame, with the volumes of its cells where they are among `names`."""
        if VOLUME not in names or VOLUME in self.cells:
            return self
        volume = volumes(self.cells["length"], self.cells["radius"])
        return replace(self, cells={**self.cells, VOLUME: volume})

    def name(self, place: int) -> str:
        """What a title calls the colony at this index of the batch."""
        return f"colony {self.colony_id[place]}" if self.names is None else self.names[place]

    @property
    def dim(self) -> int:
        return self.cells["position"].shape[1]

    @cached_property
    def _ends(self) -> np.ndarray:
        return np.searchsorted(self.cells["colony"], np.arange(len(self.colony_id) + 1))

    @property
    def counts(self) -> np.ndarray:
        """Cells in each colony, (B,)."""
        return np.diff(self._ends)

    def colony(self, place: int) -> dict[str, np.ndarray]:
        """The cells of one colony, by its index in the batch."""
        part = slice(self._ends[place], self._ends[place + 1])
        return {name: value[part] for name, value in self.cells.items()}


def of_lineage(
    lineage: Lineage,
    ids: np.ndarray,
    cells: Mapping[str, np.ndarray],
    times: float | np.ndarray,
    names: Collection[str],
) -> dict[str, np.ndarray]:
    """Those of "age", "born" (N,), h, and "founder" (N, 3), a colour, that are among `names`. ids:
    of the colonies, (B,). times: at which cells are seen, h, one or (N,)."""
    rows = lineage.rows(ids[cells["colony"]], cells["uid"])
    born, found = lineage.born[rows], {}
    if "age" in names:
        found["age"] = times - born
    if "born" in names:
        found["born"] = born
    if FOUNDER in names:
        found[FOUNDER] = colours_by_number(lineage.founder[rows])
    return found


def frame_of(state: State, scene: Scene | None = None) -> Frame:
    """A state as a frame, with cells as `Results.frame` gives them, and the walls of its scene."""
    columns = {n: getattr(state, n) for n in PER_CELL} | {
        n: v for n, v in state.fields.items() if state.declared[n].scope == CELL
    }
    cells = {n: v.detach().cpu().numpy() for n, v in columns.items()}
    units = {f.name: f.unit for f in state.declared.values()}
    ids = state.colony_id.cpu().numpy()
    walls = [] if scene is None else walls_of(scene)
    faces = {} if state.space is None else state.space.faces
    internal = [f.name for f in state.declared.values() if f.internal]
    names = () if scene is None else scene.type_names
    bare = Frame(
        cells, state.time, ids, units, walls=walls, faces=faces, internal=internal,
        type_names=names,
    )  # fmt: skip
    if state.layout is None:
        return bare
    grid = state.layout.grid
    shapes, mask = grid.shape.cpu().numpy(), state.layout.mask
    signals = {n: _parted(v.detach().cpu().numpy(), shapes) for n, v in state.signals.items()}
    return replace(
        bare,
        signals=signals,
        origin=grid.origin.cpu().numpy(),
        shape=shapes,
        spacing=np.asarray(grid.spacing),
        height=state.layout.height,
        solid=() if mask is None else _parted(~mask.cpu().numpy(), shapes),
    )


def _parted(values: np.ndarray, shapes: np.ndarray) -> list[np.ndarray]:
    """(voxels,) as one array for each colony."""
    cuts = np.cumsum(shapes.prod(1))[:-1]
    return [x.reshape(s) for x, s in zip(np.split(values, cuts), shapes, strict=True)]


class RecordedFrames(Sequence[Frame]):
    """Some frames of a results file, each read on access, with one signal or none. asked: names of
    quantities, of which cells also have those that are worked out only then: "volume", "age",
    "born", and "founder", a colour for each line of descent."""

    def __init__(
        self,
        results: Results,
        places: Sequence[int],
        signal: str | None = None,
        asked: Collection[str] = (),
    ):
        self.results, self.signal, self.asked = results, signal, asked
        self.places = [results._index(k) for k in places]
        declared = json.loads(results.attributes["declared"])
        self.units, self.walls = {name: entry[1] for name, entry in declared.items()}, results.walls
        self.faces = results.periodic
        if signal is not None and signal not in results.signal_names:
            raise checks.input_error(
                "background",
                signal,
                "a signal of the medium: "
                + (", ".join(results.signal_names) or "this run has none"),
            )

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, k):
        if isinstance(k, slice):
            return RecordedFrames(self.results, self.places[k], self.signal, self.asked)
        results, place = self.results, self.places[k]
        cells, ids, time = results.frame(place), results.colony_id, float(results.times[place])
        if wanted := [n for n in OF_FILES if n in self.asked and n not in cells]:
            cells = {**cells, **of_lineage(self._lineage, ids, cells, time, wanted)}
        frame = Frame(
            cells,
            time,
            ids,
            self.units,
            walls=self.walls,
            faces=self.faces,
            internal=results.internal_fields,
            names=names_by_parameters(results.parameters(place)),
            if_asked=(VOLUME, *OF_FILES),
            type_names=results.type_names,
        ).asked(self.asked)
        if not results.signal_names:
            return frame
        origin, shape, spacing = results.grid(place)
        height = results.attributes.get("height")
        return replace(
            frame,
            signals=(
                {} if self.signal is None else {self.signal: results.signal(self.signal, place)}
            ),
            origin=origin,
            shape=shape,
            spacing=spacing,
            height=None if height is None else float(height),
            solid=_solid(self._obstacles, shape),
        )

    @cached_property
    def _lineage(self) -> Lineage:
        return self.results.lineage()

    @cached_property
    def _obstacles(self) -> np.ndarray | None:
        """Where obstacles were in the first frame of the file, (voxels,); None where it does not
        say."""
        kept = self.results.file.get(OBSTACLES)
        return None if kept is None else kept[...].astype(bool)

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def shown(self, box: bool) -> np.ndarray:
        """(B,) which colonies have something to draw: a cell in any of the frames, or the box of a
        medium, where it is seen."""
        boxed = box and bool(self.results.signal_names)
        return np.asarray(boxed | (self.results.counts[self.places].sum(0) > 0))

    @property
    def times(self) -> np.ndarray:
        """(F,) h."""
        return self.results.times[self.places]

    @property
    def title(self) -> str:
        """The name of the scene."""
        return str(self.results.attributes["scene"]).splitlines()[0].split(":")[0]


def _solid(kept: np.ndarray | None, shape: np.ndarray) -> Sequence[np.ndarray]:
    """Where obstacles are in grids of these shapes (B, 3), of what a file keeps; nothing where it
    does not say, as of a box that has grown."""
    if kept is None or kept.shape != (shape.prod(1).sum(),):
        return ()
    return _parted(kept, shape)


def unit_of(name: str, units: Mapping[str, str]) -> str:
    """The unit of a quantity per cell, or of a signal under "out.NAME"; empty if it has none."""
    return units.get(name, UNITS.get(name, ""))
