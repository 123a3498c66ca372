"""An image as a function of place: the light of a projector, a printed pattern."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchfilm.tools import checks
from torchfilm.tools.hashing import digest
from torchfilm.tools.one_per_colony import by_position


class ImageField(metaclass=checks.KnownKeywords):
    """An image as numbers by place, the same at all heights:

        mask = tf.ImageField(pixels, size=(64.0, 48.0))
        cells.light = mask(cells.position)                       # in a rule
        tf.Signal(diffusion=100.0, source=mask)                  # or of a medium

    image: rows of numbers, (rows, columns), the first row at the top; or several images, (M, rows,
    columns), of which `which` picks one for each place. Derivatives pass to the pixels. size: width
    and height, µm. centre: of the image, (x, y) µm. outside: the number beyond its rim. smooth:
    True, each number is that in the middle of its pixel, and bilinear between the middles; False,
    that of the whole pixel. Raises InputError for what is no image.
    """

    def __init__(
        self,
        image: Any,
        size: Sequence[float],
        *,
        centre: Sequence[float] = (0.0, 0.0),
        outside: float = 0.0,
        smooth: bool = True,
    ):
        rule = "rows of finite numbers, all equally long, or several such images"
        try:
            pixels = torch.as_tensor(image).to(torch.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise checks.input_error("ImageField.image", image, rule) from error
        if pixels.dim() not in (2, 3) or not pixels.numel() or not bool(pixels.isfinite().all()):
            raise checks.input_error("ImageField.image", image, rule)
        self.image, self.size = pixels, checks.vector("ImageField.size", size, 2)
        for side, length in zip("01", self.size, strict=True):
            checks.number(f"ImageField.size[{side}]", length, above=0.0)
        checks.choice("ImageField.smooth", smooth, (True, False))
        self.centre = checks.vector("ImageField.centre", centre, 2)
        self.outside, self.smooth = checks.number("ImageField.outside", outside), smooth

    def __repr__(self) -> str:
        pixels = " × ".join(map(str, self.image.shape))
        # by the numbers, since a scene is known by what its parts show
        word = digest(self.image, self.size, self.centre, self.outside, self.smooth)
        return f"ImageField({pixels} pixels, {self.size[0]:g} × {self.size[1]:g} µm, {word})"

    def __call__(self, position: Tensor, which: Tensor | None = None) -> Tensor:
        """The number at each place, (N,) float64. position: (N, d) µm, of which x and y count.
        which: (N,), the number of the image of each place, from 0."""
        pixels = self.image.to(position.device)
        pixels = pixels.reshape(-1, *pixels.shape[-2:]).flip(1)  # the first row at the bottom
        image = self._chosen(position, which)
        at = [position[:, k].double() - self.centre[k] for k in (0, 1)]
        inside = (at[0].abs() <= 0.5 * self.size[0]) & (at[1].abs() <= 0.5 * self.size[1])
        # a place that is not finite is outside, and has no pixel
        at = [torch.where(inside, a, 0.0) for a in at]
        # in pixels, from the middle of the first; the outermost number goes on to the rim
        counts = pixels.shape[2], pixels.shape[1]
        x, y = (
            ((a / side + 0.5) * count - 0.5).clamp(0.0, count - 1.0)
            for a, side, count in zip(at, self.size, counts, strict=True)
        )
        if not self.smooth:
            x, y = (x + 0.5).floor(), (y + 0.5).floor()
        (i, u), (j, v) = _parted(x, counts[0]), _parted(y, counts[1])
        after, above = (i + 1).clamp(max=counts[0] - 1), (j + 1).clamp(max=counts[1] - 1)
        lower = (1 - u) * pixels[image, j, i] + u * pixels[image, j, after]
        upper = (1 - u) * pixels[image, above, i] + u * pixels[image, above, after]
        return torch.where(inside, (1 - v) * lower + v * upper, self.outside)

    def _chosen(self, position: Tensor, which: Tensor | None) -> Tensor | int:
        """The number of the image of each place. Raises InputError for one that is not there."""
        count = 1 if self.image.dim() == 2 else len(self.image)
        if which is None:
            if count > 1:
                rule = f"the number of one of {count} images for each place"
                raise checks.input_error("which", which, rule, "Such as mask(position, p.mask).")
            return 0
        given = torch.as_tensor(by_position(which), device=position.device).detach()
        whole = given.expand(len(position)).long()
        if not bool((whole == given).all()) or not bool(((whole >= 0) & (whole < count)).all()):
            raise checks.input_error("which", which, f"whole numbers from 0 to {count - 1}")
        return whole


def _parted(place: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The pixel before a place in pixels, and how far behind it is, from 0 to 1."""
    low = place.detach().floor().long().clamp(max=max(count - 2, 0))
    return low, place - low
