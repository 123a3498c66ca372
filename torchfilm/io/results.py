"""Reading results: one HDF5 file of frames of varying size. It is readable while a run writes it,
and a run resumes from it bit for bit. `torchfilm.io.layout` describes the file."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchfilm.initial_cells import Cells
from torchfilm.io.blocks import spans
from torchfilm.io.card import card
from torchfilm.io.colony_table import colony_table
from torchfilm.io.identity import check_same_scene
from torchfilm.io.layout import AT_CELLS
from torchfilm.io.lineage import Lineage
from torchfilm.io.new_file import check_frames
from torchfilm.io.parameters import parameters_at
from torchfilm.io.reading import frame_count, inode_of_open, open_results, refresh
from torchfilm.io.restoring import cells_of, restore_state
from torchfilm.io.results_file import ResultsFile
from torchfilm.io.table import Tables, data_frame
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools import checks, displays
from torchfilm.tools.checks import InputError

BY_NUMBER = {
    "time": "Frames go by number: int(abs(results.times - t).argmin()) is the one nearest to t h."
}


class Results(ResultsFile):
    """A results file to read: `len(results)` frames; `results.frame(k)`, `results.table(k)`,
    `results.lineage()`, `results.state(scene, k)`. Raises InputError if the file is not a readable
    results file."""

    def __len__(self) -> int:
        return frame_count(self.file)

    def __repr__(self) -> str:
        if not self._open:
            return f"Results({str(self.path)!r}, closed)"
        when = f", {self.times[0]:g} to {self.times[-1]:g} h" if len(self) else ""
        colonies = displays.counted(len(self.colony_id), "colony", "colonies")
        frames = displays.counted(len(self), "frame")
        return f"Results({str(self.path)!r}, {colonies}, {frames}{when})"

    def _repr_html_(self) -> str:
        return card(self, self._names("cells")) if self._open else displays.card(repr(self))

    @property
    def times(self) -> np.ndarray:
        """(F,) h."""
        return self._read("frames/time", slice(len(self)))

    @property
    def steps(self) -> np.ndarray:
        """(F,) the number of steps before each frame."""
        return self._read("frames/step", slice(len(self)))

    @property
    def counts(self) -> np.ndarray:
        """(F, B) cells in each colony."""
        return self._read("frames/counts", slice(len(self)))

    @property
    def colony_id(self) -> np.ndarray:
        """(B,) the id of each colony."""
        return self._read("colony_id")

    @property
    def stream(self) -> np.ndarray:
        """(B,) the stream of random numbers that each colony uses."""
        return self._read("stream" if "stream" in self.file else "colony_id")

    def refresh(self) -> None:
        """Read what a run has written since. If another file has replaced this one (a resumed run,
        or a new run with `overwrite`), open that one. Raises InputError if the path has no readable
        results file; the old file stays open then."""
        inode = self._place.stat().st_ino if self._place.exists() else None
        if inode != inode_of_open(self.file):
            old, self._open = self.file, open_results(self._place)
            old.close()
        refresh(self.file)

    def _index(self, frame: Any) -> int:
        try:
            frame = operator.index(frame)
        except TypeError as error:
            raise checks.input_error("frame", frame, "a whole number") from error
        if not -len(self) <= frame < len(self):
            rule = f"from {-len(self)} to {len(self) - 1}: {self.path} has {len(self)} frames"
            raise checks.input_error("frame", frame, rule)
        return frame % len(self)

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def frame(self, frame: int = -1) -> dict[str, np.ndarray]:
        """Arrays of one frame by name: colony (place in the batch), uid, parent, position, axis,
        length, radius and the fields per cell."""
        rows = self._rows(self._index(frame))
        return {name: self._read(f"cells/{name}", rows) for name in self._names("cells")}

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def cells(self, frame: int = -1, *, fields: Sequence[str] | None = None) -> Cells:
        """The cells of one frame, to start another scene from; `state` goes on with the same one.
        Colonies are numbered by their places in the batch; warns if their ids differ. fields: which
        recorded fields the cells have; by default species and variables, and neither what growth
        and division set for each cell themselves, such as `growth_rate`, nor what serves the
        numerics. Raises InputError for other names."""
        return cells_of(self, frame, fields)

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def colony_fields(self, frame: int = -1) -> dict[str, np.ndarray]:
        """The fields per colony of one frame by name, each (B, …)."""
        k = self._index(frame)
        return {n: self._read(f"frames/colony/{n}", k) for n in self._names("frames/colony")}

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def parameters(self, frame: int = -1) -> dict[str, np.ndarray]:
        """Every parameter with one value per colony, (B,), by its path in the scene, such as
        "Circuit.parameters['k1']". A resume with `changed` may change them: NaN at frames where a
        parameter had no value per colony. Empty for a file of an earlier version."""
        return parameters_at(self.file, int(self._read("frames/step", self._index(frame))))

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def signals_at_cells(self, frame: int = -1) -> dict[str, np.ndarray]:
        """The concentration of each signal at the cells of one frame, (N,); NaN in frames of an
        earlier version, which did not record it."""
        rows = self._rows(self._index(frame))
        return {n: self._read(f"{AT_CELLS}/{n}", rows) for n in self._names(AT_CELLS)}

    def _rows(self, k: int) -> slice:
        """The rows of a frame's cells."""
        first, sizes = spans(self, [k])
        return slice(int(first[0]), int(first[0] + sizes[0]))

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def next_uid(self, frame: int = -1) -> np.ndarray:
        """(B,) the uid that the next cell born in each colony gets."""
        return self._read("frames/next_uid", self._index(frame))

    @property
    def signal_names(self) -> tuple[str, ...]:
        """The signals of the medium; empty if the scene has no medium."""
        return self._names("signals")

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def grid(self, frame: int = -1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The grids of a frame: lower corners (B, 3) µm, numbers of voxels (B, 3), and the spacing
        (3,) µm. Raises InputError if the scene has no medium."""
        if not self.signal_names:
            raise InputError(f"{self.path} has no medium, so no grid.")
        k = self._index(frame)
        origin, shape = (self._read(f"frames/grid/{name}", k) for name in ("origin", "shape"))
        return origin, shape, np.asarray(self.file.attrs["spacing"])

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def signal(self, name: str, frame: int = -1) -> list[np.ndarray]:
        """Concentrations of a signal at a frame, one array (nx, ny, nz) per colony."""
        if name not in self.signal_names:
            known = ", ".join(self.signal_names) or "none: the scene has no medium"
            raise checks.input_error("signal", name, f"one of {known}")
        k = self._index(frame)
        _, shapes, _ = self.grid(k)
        first = int(self._read("frames/grid/first_voxel", k))
        ends = first + np.concatenate([[0], np.cumsum(shapes.prod(1))])
        return [
            self._read(f"signals/{name}", slice(a, b)).reshape(tuple(shape))
            for a, b, shape in zip(ends[:-1], ends[1:], shapes, strict=True)
        ]

    def check_alike(self, scene: Scene) -> None:
        """Raise InputError unless this is the recorded scene: the same effects with the same
        parameters, and functions with the same code."""
        check_same_scene(self.file.attrs, self.path, scene)

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def table(
        self,
        frame: int | Sequence[int] | None = None,
        *,
        each: str = "cell",
        internals: bool = False,
    ) -> dict[str, np.ndarray]:
        """One row per cell, one column per quantity: of one frame, of several, or of all.

        frame · time, h · colony, its id · cell, unique within the colony · parent, or −1
        · x, y, z, µm · angle, rad, of the axis in the plane, and in space tilt, rad, above it ·
        length, of the centreline, and radius, µm · volume, µm³ · age and born, h, as in `Lineage` ·
        the fields of cells and colonies, such as species · out.NAME, each signal at the cell · the
        parameters with one value per colony, by the shortest name that is free. A field whose name
        is one of those above is called field.NAME. internals: with the axis, and with the fields
        that serve the numerics.

        each="colony": one row per colony, also where it has no cells: frame · time · colony · cells
        · biovolume, µm³, of all its cells · cells.NAME, cells of each type · how many of its cells
        had divided, lysed, … until then, of each fate that occurs · mean.NAME, over its cells, NaN
        without any · the fields of colonies · the parameters.
        """
        checks.choice("each", each, ("cell", "colony"))
        several = frame is None or isinstance(frame, (list, tuple, range, np.ndarray))
        whole = lambda: check_frames(len(self), frame, self.path, "frame")
        frames = whole() if several else [self._index(frame)]
        if each == "colony":
            return colony_table(self, frames, internals)
        return Tables(self, self.lineage(), internals)(frames)

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def to_pandas(
        self,
        frame: int | Sequence[int] | None = None,
        *,
        each: str = "cell",
        internals: bool = False,
    ) -> Any:
        """`table` as a pandas.DataFrame. Requires the extra `tables`."""
        return data_frame(self.table(frame, each=each, internals=internals))

    def lineage(self) -> Lineage:
        """Every cell that ever lived, as arrays and as a tree."""
        return Lineage.of_results(self)

    @checks.known_keywords
    def to_vtkhdf(
        self,
        path: str | Path,
        *,
        colonies: Sequence[int] | None = None,
        frames: Sequence[int] | None = None,
        rods: str = "capsules",
        overwrite: bool = False,
    ) -> list[Path]:
        """Write the run for ParaView and pyvista: cells to `path`, NAME.vtkhdf, and signals, if
        there are any, to NAME_signals.vtkhdf. Returns the paths.

        Colonies, all or those with these ids, are laid side by side; the first keeps its
        coordinates. frames: all, or these. rods: "capsules", surfaces of 60 polygons each, or
        "lines", for a tube filter. Cells have the columns of `table`, signals one lattice that
        covers the grids of all frames, NaN where there is none. Raises InputError for a path, a
        colony or a frame that does not fit.
        """
        from torchfilm.io.vtkhdf import write_vtkhdf

        return write_vtkhdf(self, path, colonies, frames, rods, overwrite)

    @checks.known_keywords
    def to_labels(
        self,
        path: str | Path,
        *,
        pixel_size: float,
        colony: int | None = None,
        frames: Sequence[int] | None = None,
        window: tuple[tuple[float, float], tuple[float, float]] | None = None,
        z: float | None = None,
        overwrite: bool = False,
    ) -> Path:
        """Write label masks of one colony, a page per frame, as TIFF with OME-XML. Requires the
        extra `images`.

        A cell is its number plus 1 in all its frames, 0 is no cell: label − 1 is `cell` of the
        table. 16 bits, or 32 where numbers need them. A pixel belongs to the cell that covers its
        centre; where two overlap, to the one in which it lies deeper. pixel_size: µm. colony:
        its id; needed in a run of several. window: two corners, µm, by default the box around the
        colony in all frames and 2 µm more. The first row lies at the greatest y. z: in space, the
        height of the section, µm. Raises InputError for what does not fit.
        """
        from torchfilm.io.microscopy import view_of, write_labels

        view = view_of(self, pixel_size, colony, frames, window, z, section=True)
        return write_labels(view, path, overwrite)

    @checks.known_keywords
    def to_ome_tiff(
        self,
        path: str | Path,
        *,
        pixel_size: float,
        channels: Mapping[str, float],
        blur: float = 0.0,
        noise: float | None = None,
        background: float = 0.0,
        offset: float = 100.0,
        profile: str = "thickness",
        colony: int | None = None,
        frames: Sequence[int] | None = None,
        window: tuple[tuple[float, float], tuple[float, float]] | None = None,
        seed: int = 0,
        overwrite: bool = False,
    ) -> Path:
        """Write synthetic fluorescence images of one colony, a page per frame and channel, as
        OME-TIFF. Requires the extra `images`.

        channels: columns of `table` with their gains, {"gfp": 100.0}: counts per µm of cell along
        z and per unit of the quantity. profile: "flat" for counts that do not depend on how thick
        the cell is there. blur: σ of a Gaussian, µm. background: light beside the cells, counts.
        offset: counts that the camera adds. noise: σ of reading a pixel, counts; the photons'
        Poisson noise comes with it. Without it there is no noise, and values are expected counts,
        float32; with it they are uint16. seed: of the noise; a frame and a channel have the same
        noise whatever else is written. Else as `to_labels`; in space the light of all heights adds
        up. Raises InputError for what does not fit, and where 65535 counts do not suffice.
        """
        from torchfilm.io.microscopy import Camera, view_of, write_fluorescence

        camera = Camera(blur, background, offset, noise, seed)
        view = view_of(self, pixel_size, colony, frames, window, None, section=False)
        return write_fluorescence(view, path, channels, profile, camera, overwrite)

    @checks.known_keywords
    def to_ctc(
        self,
        path: str | Path,
        *,
        pixel_size: float,
        channels: Mapping[str, float] | None = None,
        blur: float = 0.0,
        noise: float | None = None,
        background: float = 0.0,
        offset: float = 100.0,
        profile: str = "thickness",
        colony: int | None = None,
        frames: Sequence[int] | None = None,
        window: tuple[tuple[float, float], tuple[float, float]] | None = None,
        z: float | None = None,
        seed: int = 0,
        overwrite: bool = False,
    ) -> Path:
        """Write one colony as ground truth for segmentation and tracking: a folder in the format of
        the Cell Tracking Challenge. Requires the extra `images`.

        01: images as of `to_ome_tiff`, rounded; channels: one, by default a dye of which all cells
        hold the same concentration, 300 counts per µm. 01_GT/TRA and 01_GT/SEG: masks as of
        `to_labels`, and man_track.txt. cells.csv: the cell of each label, which is its number plus
        1 where possible. A cell without pixels has no label in that frame; later it goes on under a
        new one. In space there are no images. Raises InputError for what does not fit, and for more
        than 65535 labels.
        """
        from torchfilm.io.cell_tracking import write_ctc
        from torchfilm.io.microscopy import Camera, view_of

        camera = Camera(blur, background, offset, noise, seed)
        view = view_of(self, pixel_size, colony, frames, window, z, section=True, images=False)
        return write_ctc(view, path, channels, profile, camera, overwrite)

    @partial(checks.known_keywords, instead=BY_NUMBER)
    def state(
        self,
        scene: Scene | None = None,
        frame: int = -1,
        *,
        device: str | torch.device | None = None,
        changed: bool = False,
    ) -> State:
        """The state at a frame. `simulate` continues from it as if the run had not stopped.

        scene: the recorded one; with `changed`, any with the same fields; None: to measure, without
        obstacles. device: "cpu" by default. Raises InputError for a scene that differs, says how.
        """
        if scene is not None and not isinstance(scene, Scene):
            hint = "Write results.state(scene, frame), or results.state(frame=…) to measure it."
            raise checks.input_error("scene", scene, "the Scene that was recorded", hint)
        return restore_state(self, scene, self._index(frame), device, changed)
