"""A target that is an image."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

import torchfilm as tf
from design.targets.base import species_name
from design.targets.geometry import (
    COLOURS,
    Centre,
    centre_at,
    check_along,
    check_profile,
    checked_centre,
    offset,
)
from design.targets.profiles import ProfileTarget
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Image(ProfileTarget):
    """An image: the target level of a cell is the brightness of the image at its place, and 0
    outside the image.

    mask: rows of numbers from 0 to 1, the first row at the top. Each is the level in the middle of
    its pixel; levels between the middles are bilinear. size: width and height of the image, µm.
    centre: of the image, (x, y) µm, or "colony" for the centre of the colony. floor: as for
    `Bands`.
    """

    species: str
    mask: tuple[tuple[float, ...], ...]
    size: tuple[float, float]
    _: KW_ONLY
    centre: Centre = (0.0, 0.0)
    floor: float = 0.0

    def __post_init__(self) -> None:
        species_name("Image.species", self.species)
        rule = "rows of numbers from 0 to 1, all equally long, not all 0"
        try:
            pixels = np.array(self.mask, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise checks.input_error("Image.mask", self.mask, rule) from error
        if (
            pixels.ndim != 2
            or not pixels.size
            or not ((pixels >= 0) & (pixels <= 1)).all()
            or not pixels.any()
        ):
            raise checks.input_error(
                "Image.mask", pixels.tolist(), rule, "Divide a picture of bytes by 255."
            )
        object.__setattr__(self, "mask", tuple(map(tuple, pixels.tolist())))
        size = checks.vector("Image.size", self.size, 2)
        for side, length in zip("01", size, strict=True):
            checks.number(f"Image.size[{side}]", length, above=0.0)
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "centre", checked_centre("Image.centre", self.centre))
        check_profile("Image", self.floor)

    @staticmethod
    def load(
        path: str | Path,
        species: str,
        size: tuple[float, float],
        *,
        centre: Centre = (0.0, 0.0),
        floor: float = 0.0,
    ) -> Image:
        """The image in a CSV file, in which each line is a row of pixels, numbers from 0 to 1; or
        in a picture, PNG or JPEG: its brightness from black, 0, to white, 1; what shows through is
        0 (needs matplotlib). Raises `tf.InputError` if the file cannot be read."""
        try:
            picture = Path(path).suffix.lower() in PICTURES
            pixels = _brightness(path) if picture else np.loadtxt(path, delimiter=",", ndmin=2)
        except (OSError, ValueError, SyntaxError) as error:
            raise checks.input_error(
                "Image.load(path)",
                str(path),
                "a CSV file with one row of numbers a line, or a picture as PNG or JPEG",
                str(error),
            ) from error
        return Image(species, pixels, size, centre=centre, floor=floor)  # type: ignore[arg-type]

    @property
    def names(self) -> tuple[str, ...]:
        return (self.species,)

    def check(self, state: tf.State) -> None:
        super().check(state)
        check_along("Image", "radius", self.centre, state)

    @cached_property
    def pixels(self) -> np.ndarray:
        """(rows, columns), the first row at the bottom."""
        return np.array(self.mask)[::-1].copy()

    @cached_property
    def _field(self) -> tf.ImageField:
        """Relative to its centre."""
        return tf.ImageField(np.array(self.mask), self.size)

    def target_profile(self, state: tf.State) -> Tensor:
        return self._field(offset(state, self.centre)).unsqueeze(1)

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        # a frame of dark pixels closes the outline where the rim is lit
        padded = np.pad(self.pixels, 1)
        x, y = (
            middle + ((np.arange(count) - 0.5) / (count - 2) - 0.5) * side
            for middle, count, side in zip(
                centre_at(state, self.centre, place), padded.shape[::-1], self.size, strict=True
            )
        )
        window = ax.get_xlim(), ax.get_ylim()
        ax.contour(x, y, padded, levels=[0.5 * padded.max()], colors=COLOURS[0], linewidths=1.0)
        ax.set(xlim=window[0], ylim=window[1])

    def describe(self) -> str:
        return (
            f"{self.species} as in an image of {len(self.mask[0])} × {len(self.mask)} pixels,"
            f" {self.size[0]:g} × {self.size[1]:g} µm"
        )


def _brightness(path: str | Path) -> np.ndarray:
    """The brightness of a picture's pixels, (rows, columns), from 0 to 1: the mean of its colours,
    times how opaque a pixel is."""
    try:
        from matplotlib.image import imread
    except ModuleNotFoundError as error:
        raise tf.InputError(
            f"Image.load reads {path} by matplotlib, which is not installed:"
            f" {checks.install('app')}. Or give a CSV file."
        ) from error
    pixels = imread(path)
    levels = pixels / 255.0 if pixels.dtype.kind == "u" else pixels.astype(np.float64)
    if levels.ndim == 2:
        return levels
    opaque = levels[..., -1] if levels.shape[2] in (2, 4) else 1.0
    return levels[..., : 3 if levels.shape[2] > 2 else 1].mean(2) * opaque
