"""Cells from label images: the capsule with the area and the second moment of each region."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchfilm.micrographs.capsule_fit import capsule_of_area
from torchfilm.micrographs.fluorescence import check_fluorescence, mean_fluorescence
from torchfilm.micrographs.mask_files import EXTRA, read_image
from torchfilm.micrographs.pixel_sizes import pixel_size_of
from torchfilm.micrographs.record import Micrograph, listed
from torchfilm.tools import checks
from torchfilm.tools.warn_once import warn

# what may be wrong with a region: the words for messages, and whether a capsule can still be fitted
PROBLEMS = {
    "tiny": ("smaller than {least_area} pixels, or one pixel wide", False),
    "pieces": ("in several pieces", False),
    "border": ("at the border of the image, which may cut them off", True),
    "misfit": ("not shaped like a straight capsule (curved, or several cells in one)", True),
}
MISFIT = 0.15  # share of the area that the capsule and the region do not share
MOST = 2**53  # whole numbers above this are not exact as floats


def mask_cells(
    image: Any,
    *,
    pixel_size: float | None,
    fluorescence: Mapping[str, Any] | None,
    background: str | float,
    frame: int | None,
    drop: str | Sequence[str],
    least_area: int,
    centre: bool,
) -> dict[str, Any]:
    """The arguments of `Cells` for the regions of a label image; `Cells.from_masks` documents it.

    A region's capsule has its centre, its axis, its area and its second central moment along the
    axis. The pixels are taken as points, which leaves no bias: the sum over pixel centres in a
    shape is, on average over its place, the integral over the shape.
    """
    pixel_size = pixel_size_of(image, pixel_size)
    checks.number("least_area", least_area, least=4, hint="Pixels.")
    checks.choice("centre", centre, (True, False))
    channels = check_fluorescence(fluorescence, background)
    drop = (drop,) if isinstance(drop, str) else drop
    if not isinstance(drop, Sequence):
        raise checks.input_error("drop", drop, "kinds of regions, such as ('border', 'tiny')")
    for name in drop:
        checks.choice("drop", name, tuple(PROBLEMS))
    values, source, frames = read_image(image, frame, "mask")
    # numbered on, since the measures take memory by the greatest label
    labels, flat = np.unique(_labels(values, source), return_inverse=True)
    mask: np.ndarray = flat.reshape(values.shape)
    regions = _regions(mask)
    problems, left_out = _problems(mask, regions, least_area), {}
    kept = np.ones(len(regions["label"]), dtype=bool)
    for name in drop:
        if problems[name].any():
            left_out[name] = [str(labels[k]) for k in regions["label"][problems[name]]]
        kept &= ~problems[name]
    regions = {name: column[kept] for name, column in regions.items()}
    _report({n: p[kept] for n, p in problems.items()}, labels[regions["label"]], source, least_area)
    if not kept.any():
        raise checks.InputError(
            f"{source}: no cell is left: drop={list(drop)} leaves out all {len(kept)} regions."
        )
    light = {
        name: mean_fluorescence(given, name, frame, mask, source, frames, background)
        for name, given in channels.items()
    }
    length, radius = capsule_of_area(regions["area"], regions["along"])
    place = pixel_size * np.stack([regions["column"], -regions["row"]], 1)
    shift = np.broadcast_to(-place.mean(0) if centre else np.zeros(2), place.shape)
    return {
        "position": place + shift,
        "axis": regions["axis"] * (1.0, -1.0),
        "length": pixel_size * length,
        "radius": pixel_size * radius,
        "extra": {name: mean[regions["label"]] for name, (mean, _) in light.items()},
        "micrograph": Micrograph(
            source,
            pixel_size,
            np.array(shift),
            label=np.array([str(labels[k]) for k in regions["label"]]),
            image=(mask.shape[0], mask.shape[1]),
            left_out=left_out,
            background={name: dark for name, (_, dark) in light.items()},
        ),
    }


def _labels(values: np.ndarray, source: str) -> np.ndarray:
    """The labels (rows, columns) int64 of an image. Raises InputError if it is no label image."""
    if values.ndim == 3:
        raise checks.InputError(
            f"{source} has {values.shape[-1]} colours a pixel. A mask has one number a pixel, the"
            " label of its cell and 0 for the background: save the labels, not a picture of them."
        )
    bad = ~np.isfinite(values) | (values != np.round(values))
    if bad.any():
        raise checks.InputError(
            f"{source} has {values[bad][0]:g} as a label. A mask has whole numbers from 0: a label"
            " for each cell. Is this the micrograph, or a probability?"
        )
    low, high = float(values.min()), float(values.max())
    if low < 0 or high > MOST:
        raise checks.InputError(
            f"{source} has labels from {low:g} to {high:g}: they must be whole numbers from 0."
        )
    mask: np.ndarray = values.astype(np.int64)
    if high == 0:
        raise checks.InputError(f"{source} has no cell: all its pixels are 0, the background.")
    if low > 0:
        raise checks.InputError(
            f"{source} has no background: no pixel is 0"
            + (f", all are {high:g}." if low == high else f" (labels {low:g} to {high:g}).")
            + " A mask has 0 between the cells. Is this the micrograph?"
        )
    return mask


def _regions(mask: np.ndarray) -> dict[str, np.ndarray]:
    """Measures of each region, in pixels: label, area, row, column, axis (column, row), the second
    moments along it and across it, the number of pieces, whether it is at the border."""
    try:
        from skimage.measure import label, regionprops_table
    except ImportError as error:
        raise checks.InputError(EXTRA) from error
    found = regionprops_table(
        mask,
        properties=("label", "area", "centroid", "bbox", "orientation", "inertia_tensor_eigvals"),
    )
    pieces = label(mask, connectivity=2)
    _, first = np.unique(pieces, return_index=True)
    owners, counts = np.unique(mask.ravel()[first], return_counts=True)
    at_border = (
        (np.minimum(found["bbox-0"], found["bbox-1"]) == 0)
        | (found["bbox-2"] == mask.shape[0])
        | (found["bbox-3"] == mask.shape[1])
    )
    angle = found["orientation"]  # from the rows' axis to the major axis
    return {
        "label": found["label"],
        "area": found["area"],
        "row": found["centroid-0"],
        "column": found["centroid-1"],
        "axis": np.stack([np.sin(angle), np.cos(angle)], 1),
        "along": found["inertia_tensor_eigvals-0"],
        "across": found["inertia_tensor_eigvals-1"],
        "pieces": counts[owners > 0],
        "border": at_border,
    }


def _problems(
    mask: np.ndarray, regions: Mapping[str, np.ndarray], least_area: int
) -> dict[str, np.ndarray]:
    """Which regions have each of `PROBLEMS`, (N,) each."""
    flat = regions["across"] < 1.0 / 12.0  # a line of pixels has no width
    tiny = (regions["area"] < least_area) | flat
    pieces, border = regions["pieces"] > 1, regions["border"]
    misfit = _misfit(mask, regions) & ~tiny & ~pieces & ~border
    return {"tiny": tiny, "pieces": pieces, "border": border, "misfit": misfit}


def _misfit(mask: np.ndarray, regions: Mapping[str, np.ndarray]) -> np.ndarray:
    """(N,) whether a region and its capsule differ by over a share `MISFIT` of the area."""
    length, radius = capsule_of_area(regions["area"], np.maximum(regions["along"], 1.0 / 12.0))
    rows, columns = np.nonzero(mask)
    at = np.searchsorted(regions["label"], mask[rows, columns])
    away = np.stack([columns - regions["column"][at], rows - regions["row"][at]], 1)
    axis, half = regions["axis"][at], 0.5 * length[at]
    along = np.clip((away * axis).sum(1), -half, half)
    outside = np.hypot(*(away - along[:, None] * axis).T) > radius[at]
    share = np.bincount(at, outside, len(length)) / regions["area"]
    # both have one area, so as much of the capsule is outside of the region
    return np.asarray(2.0 * share > MISFIT)


def _report(
    problems: Mapping[str, np.ndarray], label: np.ndarray, source: str, least_area: int
) -> None:
    """Raise InputError for regions that no capsule fits, and warn of those that may mislead."""
    for name, (words, fits) in PROBLEMS.items():
        found = [str(k) for k in label[problems[name]]]
        if not found:
            continue
        said = f"{source}: {len(found)} of {len(label)} regions are"
        said += f" {words.format(least_area=least_area)}: label {listed(found)}."
        if fits:
            warn(
                f'{said} Look at tf.pictures.overlay(cells, image, "check.png"), or leave them out'
                f" by drop={name!r}.",
                category=RuntimeWarning,
            )
            continue
        if name == "pieces":
            said += (
                " Do all cells have one value? Then number them: skimage.measure.label(mask)."
                if len(label) == 1
                else " Does the image colour cells with few numbers? Save their labels instead."
                if len(found) == len(label)
                else ""
            )
        raise checks.InputError(f"{said} Leave them out by drop={name!r}.")
