"""The size of a pixel that an image file states."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from torchfilm.micrographs.mask_files import EXTRA
from torchfilm.tools import checks
from torchfilm.tools.warn_once import warn

# µm of a unit, as OME-TIFF and ImageJ spell it; other units, such as "pixel", say nothing
MICRONS = {
    "nm": 1e-3, "um": 1.0, "micron": 1.0, "microns": 1.0, "micrometer": 1.0, "mm": 1e3, "cm": 1e4,
}  # fmt: skip
ALIKE = 0.02  # sizes that differ by less count as the same


def pixel_size_of(image: Any, given: float | None) -> float:
    """The size of a pixel, µm: as `given`, or None for that which the file states.

    Raises InputError where neither is there, and warns where both are and differ.
    """
    if given is not None:
        checks.number("pixel_size", given, above=0.0, hint="µm a pixel.")
    stated = _stated(Path(image)) if isinstance(image, (str, Path)) else None
    if stated is None:
        if given is None:
            raise checks.InputError(
                "the image does not state the size of its pixels (an OME-TIFF does, and a TIFF of"
                " ImageJ with its scale set): give pixel_size=…, in µm, such as 0.065."
            )
        return given
    across, down = stated
    if given is None:
        if abs(across / down - 1) > ALIKE:
            raise checks.InputError(
                f"{image} states pixels of {across:g} × {down:g} µm. Cells are read from square"
                " pixels: resample the image."
            )
        return across
    if max(abs(across / given - 1), abs(down / given - 1)) > ALIKE:
        size = f"{across:g}" if abs(across / down - 1) <= ALIKE else f"{across:g} × {down:g}"
        warn(
            f"pixel_size = {given:g} µm, but {image} states {size} µm a pixel. Was the image"
            " scaled after it was taken?"
        )
    return given


def _stated(path: Path) -> tuple[float, float] | None:
    """What a TIFF file states of its pixels along columns and rows, µm, if it does."""
    if path.suffix.lower() not in (".tif", ".tiff"):
        return None
    try:
        import tifffile
    except ImportError as error:
        raise checks.InputError(EXTRA) from error
    try:
        with tifffile.TiffFile(path) as file:
            if file.is_ome:
                sizes = _of_ome(file.ome_metadata or "")
            elif file.is_imagej:
                sizes = _of_imagej(file)
            else:
                return None
    except Exception:  # no TIFF, whatever the library says: `read_image` tells of it
        return None
    good = sizes is not None and min(sizes) > 0 and max(sizes) < float("inf")
    return sizes if good else None


def _of_ome(xml: str) -> tuple[float, float] | None:
    """Of the first image of an OME-TIFF."""
    found = []
    for axis in "XY":
        size = re.search(rf'\bPhysicalSize{axis}="([^"]*)"', xml)
        unit = re.search(rf'\bPhysicalSize{axis}Unit="([^"]*)"', xml)
        micron = MICRONS.get(_letters(unit[1]) if unit else "um")
        if size is None or micron is None:
            return None
        found.append(float(size[1]) * micron)
    return found[0], found[1]


def _of_imagej(file: Any) -> tuple[float, float] | None:
    """Of a TIFF of ImageJ, which states pixels a unit."""
    micron = MICRONS.get(_letters(str((file.imagej_metadata or {}).get("unit", ""))))
    tags = file.pages[0].tags
    if micron is None or "XResolution" not in tags or "YResolution" not in tags:
        return None
    across, down = (tags[name].value for name in ("XResolution", "YResolution"))
    return micron * across[1] / across[0], micron * down[1] / down[0]


def _letters(unit: str) -> str:
    """A unit with u for µ: of the two that Unicode has, and of what ImageJ and XML write for it."""
    for sign in ("\u00b5", "\u03bc", r"\u00B5", "&#181;", "&#xB5;"):
        unit = unit.replace(sign, "u")
    return unit.strip()
