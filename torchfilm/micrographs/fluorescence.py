"""Fluorescence of segmented cells: the mean pixel value within each region of a label image."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchfilm.micrographs.mask_files import read_image
from torchfilm.state import CELL_TYPE, RESERVED
from torchfilm.tools import checks

DELTA = ".nc"
MEDIAN = "median"  # the background that is measured beside the cells


def check_fluorescence(images: Any, background: Any) -> dict[str, Any]:
    """The images by field. Raises InputError for names that no field can have and for a background
    that is neither "median" nor a number."""
    given = {} if images is None else images
    if not isinstance(given, Mapping):
        raise checks.input_error("fluorescence", images, 'images by field, {"gfp": "gfp.tif"}')
    for name in given:
        taken = (CELL_TYPE.name, "colony", *RESERVED)
        if not isinstance(name, str) or not name.isidentifier() or name in taken:
            raise checks.input_error(
                "fluorescence",
                name,
                "a name that a field of cells can have, such as 'gfp'",
                "Letters, digits and _, and no name that the state uses itself.",
            )
    if background != MEDIAN:
        hint = "Of the pixels outside of all regions, or counts; 0 subtracts nothing."
        if isinstance(background, str):
            raise checks.input_error("background", background, '"median" or a number', hint)
        checks.number("background", background, hint=hint)
    return dict(given)


def mean_fluorescence(
    image: Any,
    name: str,
    frame: int | None,
    mask: np.ndarray,
    mask_source: str,
    frames: int,
    background: Any,
) -> tuple[np.ndarray, float]:
    """The mean pixel value of each region less the background, and the background.

    image, frame: as of the mask, which is one of so many `frames`. mask: (rows, columns), numbered
    from 0, the background, to K. Returns (K + 1,), of which the first is that of the background.
    Raises InputError for an image of another shape, of several colours, with pixels that are no
    numbers, or of another number of frames.
    """
    what = f"fluorescence[{name!r}]"
    if isinstance(image, (str, Path)) and Path(image).suffix.lower() == DELTA:
        raise checks.input_error(what, str(image), "an image; from this file labels are read")
    if Path(mask_source).suffix.lower() == DELTA:
        values, source = _beside_delta(image, what, mask.shape)
    else:
        values, source, count = read_image(image, frame, what)
        if count != frames:
            raise checks.InputError(
                f"{source} is one of {count} frame(s), and {mask_source} one of {frames}: their"
                " numbers do not stand for the same times. Give the two images themselves."
            )
    if values.ndim == 3:
        raise checks.InputError(
            f"{source} has {values.shape[-1]} colours a pixel. Give one of them, (rows, columns)."
        )
    if values.shape != mask.shape:
        raise checks.InputError(
            f"{source} has {values.shape[0]} × {values.shape[1]} pixels, and {mask_source} has"
            f" {mask.shape[0]} × {mask.shape[1]} (rows × columns). Give the image that was"
            " segmented, at the same scale and cut in the same way."
        )
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        raise checks.InputError(
            f"{source} has {len(bad)} pixels that are not finite, the first at row {bad[0][0]},"
            f" column {bad[0][1]}."
        )
    exact = values.astype(np.float64)
    dark = float(np.median(exact[mask == 0])) if background == MEDIAN else float(background)
    area = np.bincount(mask.ravel())
    return np.bincount(mask.ravel(), exact.ravel()) / area - dark, dark


def _beside_delta(image: Any, what: str, shape: tuple[int, ...]) -> tuple[np.ndarray, str]:
    """An image of the frame of a file of DeLTA, whose numbers of frames are its own, and whose
    labels end where its last region of interest does."""
    try:
        values, source, _ = read_image(image, None, what)
    except checks.InputError as error:
        raise checks.InputError(
            f"{error} Beside a file of DeLTA, give the image of its frame alone."
        ) from error
    return values[: shape[0], : shape[1]], source
