"""Observed cells from label images, one for each colony, and the fluorescence beside them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

import torchfilm as tf
from torchfilm import checks


def masks_table(
    masks: Any, fluorescence: Any, length_with_caps: bool, amounts: bool, **options: Any
) -> dict[str, np.ndarray]:
    """The cells of several label images as columns (N,) for `Observed.from_table`.

    masks: one, or a list of them, each a colony. fluorescence: by field an image, or a list of as
    many. amounts: levels are those of whole cells, mean × area. options: of `Cells.from_masks`.
    """
    several = _listed("masks", masks)
    colonies = masks if several else [masks]
    if not len(colonies):
        raise checks.input_error("Observed.from_masks(masks)", masks, "at least one mask")
    given = {} if fluorescence is None else fluorescence
    if not isinstance(given, Mapping):
        rule = 'images by field, {"gfp": ["one_gfp.tif", "other_gfp.tif"]}'
        raise checks.input_error("Observed.from_masks(fluorescence)", fluorescence, rule)
    images = {name: _images(name, of, len(colonies), several) for name, of in given.items()}
    parts = []
    for k, mask in enumerate(colonies):
        beside = {name: of[k] for name, of in images.items()}
        try:
            cells = tf.Cells.from_masks(mask, fluorescence=beside, **options)
        except tf.InputError as error:
            if not several:
                raise
            raise tf.InputError(f"masks[{k}]: {error}") from error
        part = cells.table()
        if amounts:
            length, radius = part["length_um"], part["radius_um"]
            area = 2.0 * radius * length + np.pi * radius**2
            part |= {name: part[name] * area for name in images}
        if length_with_caps:
            part["length_um"] = part["length_um"] + 2.0 * part["radius_um"]
        parts.append({**part, "colony": np.full(cells.count, k)})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _images(name: str, given: Any, count: int, several: bool) -> list[Any]:
    """An image for each colony."""
    what = f"fluorescence[{name!r}]"
    if not _listed(what, given):
        if several:
            rule = f"a list of {count} images, one for each mask"
            raise checks.input_error(f"Observed.from_masks({what})", given, rule)
        return [given]
    if len(given) != count:
        rule = f"{count} images, one for each mask" if several else "one image, as there is a mask"
        raise checks.input_error(f"Observed.from_masks({what})", f"{len(given)} images", rule)
    return list(given)


def _listed(what: str, given: Any) -> bool:
    """Whether several images are given. Raises InputError for what has no order of its own."""
    if isinstance(given, (Iterator, set, frozenset)):
        raise checks.input_error(
            f"Observed.from_masks({what})", given, "a list", 'Such as sorted(folder.glob("*.tif")).'
        )
    return isinstance(given, (list, tuple))
