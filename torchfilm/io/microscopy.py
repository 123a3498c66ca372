"""Results as microscope images: label masks, and synthetic fluorescence, as OME-TIFF."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchfilm.io.new_file import check_frames, check_new_file
from torchfilm.io.raster import Raster, Rods, label_image, thickness_image
from torchfilm.io.table import Tables, needed
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError
from torchfilm.tools.whole_files import written_whole

if TYPE_CHECKING:
    from torchfilm.io.results import Results

SUFFIXES = (".tif", ".tiff")
CUT = 4.0  # σ of the optics, beyond which no light arrives
MARGIN = 2.0  # µm around the cells, where no window is given
MOST_PIXELS = 2**28  # of one page
PROFILES = ("thickness", "flat")
DYE = 300.0  # counts per µm of cell, where no channels are given
Window = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, eq=False)
class View:
    """What is imaged: one colony of a run, some frames, a raster, and, in space, the height of the
    section, µm, or None for the projection along z. faces: of a periodic space, (low, high) µm by
    axis, beyond which images of cells are seen; none where they are not."""

    results: Results
    colony: int
    frames: list[int]
    raster: Raster
    z: float | None
    tables: Tables
    faces: Mapping[str, tuple[float, float]]

    def cells(self, k: int) -> tuple[dict[str, np.ndarray], Rods]:
        """The columns of the colony's cells in a frame, and their shapes."""
        own = lambda ids, _: ids == self.colony
        columns = self.tables([k], own)
        centre = np.stack([columns["x"], columns["y"], columns.get("z", 0.0 * columns["x"])], 1)
        axis = np.stack([columns[f"axis_{n}"] for n in "xyz" if f"axis_{n}" in columns], 1)
        axis = np.pad(axis.astype(np.float64), ((0, 0), (0, 3 - axis.shape[1])))
        length, radius = (columns[n].astype(np.float64) for n in ("length", "radius"))
        return columns, Rods(centre, axis, length / 2, radius)

    def seen(self, rods: Rods, raster: Raster) -> tuple[Rods, np.ndarray]:
        """The cells, and those images of them that reach into the raster, and in space into the
        section; and which cell each is."""
        return rods.seen(self.faces, raster, self.z)


def view_of(
    results: Results,
    pixel_size: float,
    colony: int | None,
    frames: Sequence[int] | None,
    window: Window | None,
    z: float | None,
    section: bool,
    images: bool = True,
) -> View:
    """The view that is asked for. section: in space a height `z` is needed. images: of cells beyond
    the faces of a periodic space are seen."""
    pixel = checks.number("pixel_size", pixel_size, above=0.0, hint="In µm.")
    chosen = check_frames(len(results), frames, results.path)
    lineage = results.lineage()
    own = lineage.colony_of_run(colony)
    space = int(results.attributes["dim"]) == 3
    if z is not None:
        checks.number("z", z)
        if not (space and section):
            raise checks.input_error("z", z, "left out: only label masks of runs in space need it")
    elif space and section:
        raise checks.input_error("z", None, "the height of the section, µm: this run is in space")
    tables = Tables(results, lineage, internals=True)
    faces = results.periodic if images else {}
    empty = View(results, own, chosen, Raster(pixel, 0.0, 0.0, (0, 0)), z, tables, faces)
    corners = _corners(empty) if window is None else checked_window(window)
    if z is not None:
        _check_height(empty, z)
    return View(results, own, chosen, raster_of(pixel, corners), z, tables, faces)


def raster_of(pixel: float, corners: tuple[Sequence[float], Sequence[float]]) -> Raster:
    """The pixels, so wide in µm, between the lower left and the upper right corner. Raises
    InputError for too many."""
    (left, bottom), (right, top) = corners
    rows, columns = (top - bottom) / pixel, (right - left) / pixel
    if rows * columns > MOST_PIXELS:
        rule = (
            f"so large that a page has at most {MOST_PIXELS} pixels, not {rows:.0f} × {columns:.0f}"
        )
        raise checks.input_error("pixel_size", pixel, rule, "Or give a smaller window.")
    return Raster(pixel, left, top, (max(1, round(rows)), max(1, round(columns))))


def _check_height(view: View, z: float) -> None:
    """Raise InputError for a section that meets no cell in any frame, or is beyond the faces."""
    if "z" in view.faces:
        lowest, highest = view.faces["z"]
        if not lowest <= z <= highest:
            rule = f"from {lowest:g} to {highest:g} µm, between the faces"
            raise checks.input_error("z", z, rule)
        return
    low, high = np.inf, -np.inf
    for k in view.frames:
        rods = view.cells(k)[1]
        reach = np.abs(rods.axis[:, 2]) * rods.half + rods.radius
        low = min(low, float((rods.centre[:, 2] - reach).min(initial=np.inf)))
        high = max(high, float((rods.centre[:, 2] + reach).max(initial=-np.inf)))
    if low <= high and not low <= z <= high:
        rule = f"from {low:.3g} to {high:.3g} µm, where the colony's cells are"
        raise checks.input_error("z", z, rule)


def checked_window(window: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The lower left and the upper right corner of a window, µm. Raises InputError for others."""
    if not isinstance(window, (tuple, list)) or len(window) != 2:
        raise checks.input_error(
            "window", window, "two corners, µm, such as ((-20, -20), (20, 20))"
        )
    low, high = (checks.vector(f"window[{k}]", window[k], 2) for k in (0, 1))
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise checks.input_error("window", window, "its lower left corner first")
    return low, high


def _corners(view: View) -> tuple[list[float], list[float]]:
    """The box, µm, around the colony in all frames, with a margin; from face to face where space is
    periodic."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k in view.frames:
        rods = view.cells(k)[1]
        if len(rods.half):
            low = np.minimum(low, (rods.centre[:, :2] - rods.reach).min(0))
            high = np.maximum(high, (rods.centre[:, :2] + rods.reach).max(0))
    if not (low < high).all():
        raise InputError(
            f"colony {view.colony} has no cell in these frames of {view.results.path}: give the"
            " window, µm, of the empty images."
        )
    low, high = low - MARGIN, high + MARGIN
    for axis, faces in view.faces.items():
        if axis in "xy":
            low["xy".index(axis)], high["xy".index(axis)] = faces
    return low.tolist(), high.tolist()


# --- masks ----------------------------------------------------------------------------------------


def write_labels(view: View, path: str | Path, overwrite: bool) -> Path:
    """As `Results.to_labels`."""
    target = check_new_file(path, SUFFIXES, overwrite, view.results.path)
    lineage = view.tables.lineage
    most = 1 + int(lineage.cell[lineage.colony == view.colony].max(initial=-1))
    if most > np.iinfo(np.uint32).max:
        raise InputError(f"cell {most - 1} has a number too great for a mask of 32 bits.")
    dtype = np.dtype(np.uint16 if most <= np.iinfo(np.uint16).max else np.uint32)

    def pages() -> Iterator[np.ndarray]:
        for k in view.frames:
            columns, rods = view.cells(k)
            labels = (columns["cell"] + 1).astype(dtype)
            rods, which = view.seen(rods, view.raster)
            yield label_image(rods, labels[which], view.raster, 0.0 if view.z is None else view.z)

    return _write(view, target, pages(), dtype, ["labels"])


# --- fluorescence ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
    """How light becomes counts. Each count is one photon that was detected, and `offset` is added.

    blur: σ of the optics, µm. background: light beside the cells, counts. noise: σ of the noise of
    reading a pixel, counts, in addition to the photons' own, which is Poisson's; None: no noise of
    either kind. seed: of both.
    """

    blur: float
    background: float
    offset: float
    noise: float | None
    seed: int

    def __post_init__(self) -> None:
        for name in ("blur", "background", "offset"):
            checks.number(name, getattr(self, name), least=0.0)
        if self.noise is not None:
            checks.number("noise", self.noise, least=0.0)
        checks.integer("seed", self.seed, least=0)

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(np.float32 if self.noise is None else np.uint16)

    def margin(self, pixel: float) -> int:
        """How many pixels beyond an image the optics blur into it."""
        return math.ceil(CUT * self.blur / pixel)

    def image(self, light: np.ndarray, pixel: float, key: tuple[int, ...], name: str) -> np.ndarray:
        """Counts (rows, columns) of the light that cells send out, there and in the margin around
        it. key: of the noise."""
        from scipy.ndimage import gaussian_filter

        margin = self.margin(pixel)
        seen = gaussian_filter(light, self.blur / pixel, mode="constant", radius=margin)
        inside = slice(margin, None if margin == 0 else -margin)
        seen = seen[inside, inside] + self.background
        if self.noise is None:
            return (seen + self.offset).astype(np.float32)
        check_counts(name, float(seen.max()) + self.offset)
        draw = np.random.default_rng([self.seed, *key, *name.encode()])
        counts = draw.poisson(seen) + draw.normal(self.offset, self.noise, seen.shape)
        check_counts(name, float(counts.max()))
        # a camera shows no count below 0
        return np.maximum(np.round(counts), 0).astype(np.uint16)


def check_counts(name: str, most: float) -> None:
    """Raise InputError where the brightest pixel of a channel does not fit into 16 bits."""
    if round(most) > np.iinfo(np.uint16).max:
        raise InputError(
            f"channel {name!r}: a pixel has {most:.0f} counts, and the camera counts to 65535."
            " Lower the gain of the channel, or the background."
        )


def write_fluorescence(
    view: View,
    path: str | Path,
    channels: Mapping[str, float],
    profile: str,
    camera: Camera,
    overwrite: bool,
) -> Path:
    """As `Results.to_ome_tiff`."""
    target = check_new_file(path, SUFFIXES, overwrite, view.results.path)
    checks.choice("profile", profile, PROFILES)
    gains = check_channels(view, channels)
    pages = light_images(view, gains, profile, camera)
    return _write(view, target, pages, camera.dtype, list(gains))


def light_images(
    view: View, gains: Mapping[str, float] | None, profile: str, camera: Camera
) -> Iterator[np.ndarray]:
    """Counts (rows, columns) of each frame, and in it of each channel of `gains`; without them, of
    one dye that all cells hold alike, `DYE` counts per µm of cell."""
    raster, steps = view.raster.wider(camera.margin(view.raster.pixel)), view.results.steps
    names = list(gains or ["dye"])
    for k in view.frames:
        columns, rods = view.cells(k)
        weights = np.full((1, len(rods.half)), DYE)
        if gains is not None:
            weights = np.stack([g * columns[n].astype(float) for n, g in gains.items()])
        bad = ~(weights >= 0).all(1)
        if bad.any():
            rule = "a quantity that is known and at least 0 in all cells"
            raise checks.input_error("channels", names[int(bad.argmax())], rule)
        rods, which = view.seen(rods, raster)
        light = thickness_image(rods, weights[:, which], raster, profile == "flat")
        for name, image in zip(names, light, strict=True):
            yield camera.image(image, raster.pixel, (view.colony, int(steps[k])), name)


def check_channels(view: View, channels: Any) -> dict[str, float]:
    """The gains by the names of their columns. Raises InputError for what is no such dict."""
    if not isinstance(channels, Mapping) or not channels:
        rule = "a dict of quantities per cell with their gains, such as {'gfp': 100.0}"
        raise checks.input_error("channels", channels, rule)
    known = Tables(view.results, view.tables.lineage, internals=False)([view.frames[0]])
    for name in channels:
        if name not in known:
            near = checks.nearest(str(name), known)
            hint = f"Did you mean {near}? " if near else ""
            raise checks.input_error(
                "channels", name, "columns of the table", f"{hint}It has: {', '.join(known)}."
            )
    unit = "Counts per µm of cell and unit of the quantity."
    return {
        name: checks.number(f"channels[{name!r}]", gain, above=0.0, hint=unit)
        for name, gain in channels.items()
    }


# --- the file -------------------------------------------------------------------------------------


def _write(
    view: View, path: Path, pages: Iterator[np.ndarray], dtype: np.dtype, channels: list[str]
) -> Path:
    """Write the pages one after the other: frames, and the channels of each."""
    tifffile = needed("tifffile", "images")
    raster, times = view.raster, view.results.times[view.frames]
    shape = (len(view.frames), len(channels), *raster.shape)
    per_cm = 1e4 / raster.pixel
    with (
        written_whole(path) as beside,
        tifffile.TiffWriter(
            beside, ome=True, bigtiff=math.prod(shape) * dtype.itemsize > 2**31
        ) as out,
    ):
        out.write(
            pages,
            shape=shape,
            dtype=dtype,
            photometric="minisblack",
            compression="zlib",
            resolution=(per_cm, per_cm),
            resolutionunit="CENTIMETER",
            metadata=_ome(view, times, channels),
        )
    return path


def _ome(view: View, times: np.ndarray, channels: list[str]) -> dict[str, Any]:
    """What OME-XML says of the image: axes, pixel size, times, places, channels."""
    raster, results = view.raster, view.results
    planes = len(times) * len(channels)
    hours = np.repeat(times, len(channels)).tolist()
    about = {
        "axes": "TCYX",
        "Name": f"{results.path.stem}, colony {view.colony}",
        "PhysicalSizeX": raster.pixel,
        "PhysicalSizeXUnit": "µm",
        "PhysicalSizeY": raster.pixel,
        "PhysicalSizeYUnit": "µm",
        "Channel": {"Name": channels},
        "Plane": {
            "DeltaT": hours,
            "DeltaTUnit": ["h"] * planes,
            # of the centre of the first pixel; rows run towards lower y
            "PositionX": [raster.left + raster.pixel / 2] * planes,
            "PositionXUnit": ["µm"] * planes,
            "PositionY": [raster.top - raster.pixel / 2] * planes,
            "PositionYUnit": ["µm"] * planes,
        },
    }
    apart = np.diff(times)
    if len(apart) and np.allclose(apart, apart[0], rtol=1e-6, atol=0):
        about |= {"TimeIncrement": float(apart[0]), "TimeIncrementUnit": "h"}
    return about
