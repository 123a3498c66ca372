"""Results as ground truth for programs that segment and track cells: a folder in the format of the
Cell Tracking Challenge, https://celltrackingchallenge.net."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.io.microscopy import (
    PROFILES,
    Camera,
    View,
    check_channels,
    check_counts,
    light_images,
)
from torchfilm.io.new_file import check_new_folder, folder_written_whole
from torchfilm.io.raster import Raster, Rods, label_image
from torchfilm.io.table import needed
from torchfilm.tools import checks, displays
from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import warn

if TYPE_CHECKING:
    from torchfilm.io.lineage import Lineage

IMAGES, TRUTH, CELLS = "01", "01_GT", "cells.csv"
FILES = (
    r"01/t\d+\.tif|01_GT/(SEG/man_seg|TRA/man_track)\d+\.tif|01_GT/TRA/man_track\.txt|cells\.csv"
)
MOST_LABELS = np.iinfo(np.uint16).max
DIGITS = 3  # of a frame's number in the names of files; more where there are more frames
PLAIN = Camera(blur=0.0, background=0.0, offset=100.0, noise=None, seed=0)


@dataclass
class Track:
    """One unbroken run of frames in which a cell has pixels. first, last: of them, by their places
    among the frames that are written. parent: the label of the track that it continues, 0: of
    none."""

    label: int
    cell: int
    first: int
    last: int
    parent: int


class LabelTracks:
    """The tracks of a colony, made frame after frame.

    A label is the number of the cell plus 1. A cell that has had no pixel for a while goes on under
    a label above those of all cells, whose parent is its earlier one. Where the run has more cells
    than labels, these are 1, 2, … in the order of their first frames. A parent is the nearest
    ancestor with pixels in an earlier frame.
    """

    def __init__(self, lineage: Lineage, colony: int):
        own = lineage.colony == colony
        _ = lineage.founder  # raises InputError where the tree is damaged, and has no end
        self.found: list[Track] = []
        self._mothers = dict(
            zip(lineage.cell[own].tolist(), lineage.parent[own].tolist(), strict=True)
        )
        self._latest: dict[int, Track] = {}
        self._colony = colony
        most = 1 + int(lineage.cell[own].max(initial=-1))
        self._by_cell = most <= MOST_LABELS
        self._free = most + 1 if self._by_cell else 1

    def labels(self, cells: np.ndarray, frame: int) -> list[int]:
        """The labels of the cells, (M,) in ascending order, that have pixels in this frame, the
        next one. Raises InputError where 16 bits do not suffice."""
        return [self._track(int(cell), frame).label for cell in cells]

    def _track(self, cell: int, frame: int) -> Track:
        track = self._latest.get(cell)
        if track is None or track.last < frame - 1:
            parent = self._parent(cell)
            track = Track(self._new_label(cell, frame), cell, frame, frame, parent)
            self.found.append(track)
            self._latest[cell] = track
        track.last = frame
        return track

    def _new_label(self, cell: int, frame: int) -> int:
        if self._by_cell and cell not in self._latest:
            return cell + 1
        if self._free > MOST_LABELS:
            raise InputError(
                f"colony {self._colony} needs more than {MOST_LABELS} labels by frame {frame} of"
                " those to be written, and masks of tracks have 16 bits. Write fewer frames"
                " (frames=…, --frames), or a smaller window."
            )
        self._free += 1
        return self._free - 1

    def _parent(self, cell: int) -> int:
        """The label that a new track of a cell continues; 0, none."""
        while cell >= 0:
            if cell in self._latest:
                return self._latest[cell].label
            cell = self._mothers.get(cell, -1)
        return 0


def write_ctc(
    view: View,
    path: str | Path,
    channels: Mapping[str, float] | None,
    profile: str,
    camera: Camera,
    overwrite: bool,
) -> Path:
    """As `Results.to_ctc`."""
    target = check_new_folder(path, (IMAGES, TRUTH, CELLS), FILES, overwrite)
    checks.choice("profile", profile, PROFILES)
    images = _images(view, channels, profile, camera)
    tracks, number = LabelTracks(view.tables.lineage, view.colony), _numbers(len(view.frames))
    with folder_written_whole(target) as folder:
        tra, seg = folder / TRUTH / "TRA", folder / TRUTH / "SEG"
        for part in (tra, seg, *([] if images is None else [folder / IMAGES])):
            part.mkdir(parents=True)
        for k, mask in enumerate(_masks(view, tracks)):
            _write_page(tra / f"man_track{number[k]}.tif", mask, view.raster)
            _write_page(seg / f"man_seg{number[k]}.tif", mask, view.raster)
        for k, image in enumerate(images or ()):
            _write_page(folder / IMAGES / f"t{number[k]}.tif", image, view.raster)
        found = sorted(tracks.found, key=lambda t: t.label)
        lines = [f"{t.label} {t.first} {t.last} {t.parent}\n" for t in found]
        (tra / "man_track.txt").write_text("".join(lines), encoding="utf-8")
        cells = ["label,cell\n", *(f"{t.label},{t.cell}\n" for t in found)]
        (folder / CELLS).write_text("".join(cells), encoding="utf-8")
    return target


def _numbers(count: int) -> list[str]:
    """How the names of files number the frames: from 0, all with as many digits."""
    digits = max(DIGITS, len(str(count - 1)))
    return [f"{k:0{digits}}" for k in range(count)]


def _masks(view: View, tracks: LabelTracks) -> Iterator[np.ndarray]:
    """The mask (rows, columns) of each frame. Warns at the end of cells without pixels and of
    frames without cells. Raises InputError where there is no cell at all."""
    hidden: list[tuple[int, int]] = []
    empty: list[int] = []
    for at, k in enumerate(view.frames):
        columns, rods = view.cells(k)
        order = np.argsort(columns["cell"])  # pixels as far from two cells are the lower number's
        place = np.empty(len(order), np.uint32)
        place[order] = np.arange(1, len(order) + 1)
        image = label_image(rods, place, view.raster, view.z or 0.0)
        seen = np.unique(image)
        seen = seen[seen > 0]
        cells = columns["cell"][order]
        label = np.zeros(len(order) + 1, np.uint16)
        label[seen] = tracks.labels(cells[seen - 1], at)
        covered = _has_centre(rods, view)[order]
        covered[seen - 1] = False
        hidden += [(int(cell), k) for cell in cells[covered]]
        empty += [] if len(seen) else [k]
        yield label[image]
    if not tracks.found:
        raise InputError(
            f"colony {view.colony} of {view.results.path} has no cell in these images: there is"
            " nothing to track. Choose another window, other frames, or smaller pixels"
            f" (pixel_size = {view.raster.pixel:g} µm)."
        )
    _warn_of(hidden, empty)


def _has_centre(rods: Rods, view: View) -> np.ndarray:
    """(N,) whether the image is to show the cell: whether its centre, moved up or down to the
    section, is inside the cell and the image."""
    raster, (rows, columns) = view.raster, view.raster.shape
    x, y, z = rods.centre.T
    column, row = (x - raster.left) / raster.pixel, (raster.top - y) / raster.pixel
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return inside & (np.abs(z - (view.z or 0.0)) < rods.radius)


def _warn_of(hidden: list[tuple[int, int]], empty: list[int]) -> None:
    if hidden:
        cell, frame = hidden[0]
        count = displays.counted(len({cell for cell, _ in hidden}), "cell")
        warn(
            f"{count} inside the image without a pixel in some frame, the first of them cell {cell}"
            f" in frame {frame}: other cells cover it, or a pixel is larger than a cell. Its track"
            " ends before that frame, and goes on after it under a new label."
        )
    if empty:
        warn(
            f"{displays.counted(len(empty), 'frame')} without a cell, the first of them frame"
            f" {empty[0]}. Some programs refuse such frames: choose others (frames=…, --frames), or"
            " another window."
        )


def _images(view: View, channels: Any, profile: str, camera: Camera) -> Iterator[np.ndarray] | None:
    """The image of each frame, 16 bits; None for a section, to which no image belongs. Raises
    InputError for several channels, and for what images need where there are none."""
    if view.z is not None:
        if channels is not None or (camera, profile) != (PLAIN, PROFILES[0]):
            raise InputError(
                "light (channels, blur, noise, background, offset, profile, seed) is not for a run"
                " in space: its masks are a section, and images show the cells of all heights."
                " Leave it out; only masks are written."
            )
        return None
    gains = None if channels is None else check_channels(view, channels)
    if gains is not None and len(gains) > 1:
        raise checks.input_error("channels", list(gains), "one quantity: these images have one")
    name = "dye" if gains is None else next(iter(gains))
    return (_whole(image, name) for image in light_images(view, gains, profile, camera))


def _whole(image: np.ndarray, name: str) -> np.ndarray:
    """Counts of a channel as whole numbers of 16 bits. Raises InputError where they do not
    suffice."""
    check_counts(name, float(image.max(initial=0.0)))
    return np.round(image).astype(np.uint16)


def _write_page(path: Path, page: np.ndarray, raster: Raster) -> None:
    per_cm = 1e4 / raster.pixel
    needed("tifffile", "images").imwrite(
        path,
        page,
        photometric="minisblack",
        compression="zlib",
        resolution=(per_cm, per_cm),
        resolutionunit="CENTIMETER",
        metadata=None,
    )
