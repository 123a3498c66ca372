"""Capsules on a raster of pixels: which cell a pixel belongs to, and how thick cells are there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from torchfilm.tools.images import images_seen

AT_ONCE = 500_000  # pixels of boxes around cells that are looked at in one go


@dataclass(frozen=True)
class Raster:
    """Square pixels of `pixel` µm. left, top: the corner of the image, µm; the first row lies at
    the top, at the greatest y. shape: (rows, columns). A pixel is looked at in its centre."""

    pixel: float
    left: float
    top: float
    shape: tuple[int, int]

    @property
    def span(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """From where to where it reaches along x and along y, µm."""
        rows, columns = self.shape
        right, bottom = self.left + columns * self.pixel, self.top - rows * self.pixel
        return (self.left, right), (bottom, self.top)

    def wider(self, margin: int) -> Raster:
        """With a margin of pixels on all sides."""
        apart = margin * self.pixel
        rows, columns = (n + 2 * margin for n in self.shape)
        return Raster(self.pixel, self.left - apart, self.top + apart, (rows, columns))


@dataclass(frozen=True, eq=False)
class Rods:
    """Cells of one colony: centre and axis (N, 3), half the centreline and radius (N,), µm."""

    centre: np.ndarray
    axis: np.ndarray
    half: np.ndarray
    radius: np.ndarray

    @property
    def reach(self) -> np.ndarray:
        """(N, 2) how far each cell reaches from its centre along x and y, µm."""
        return np.abs(self.axis[:, :2]) * self.half[:, None] + self.radius[:, None]

    def seen(
        self, faces: Mapping[str, tuple[float, float]], raster: Raster, z: float | None
    ) -> tuple[Rods, np.ndarray]:
        """The cells, and those images of them beyond the faces of a periodic space that reach into
        the raster, and into the section at the height z where it has one; and which cell each
        is."""
        rods, which = self, np.arange(len(self.half))
        spans = dict(zip("xy", raster.span, strict=True))
        if z is not None:
            spans["z"] = z, z
        for axis in sorted(spans.keys() & faces.keys()):
            low, high = faces[axis]
            rods, more = rods.repeated("xyz".index(axis), high - low, spans[axis])
            which = which[more]
        return rods, which

    def repeated(self, k: int, period: float, span: tuple[float, float]) -> tuple[Rods, np.ndarray]:
        """The cells, and their images every `period` µm along axis k that reach into a span; and
        which cell each is."""
        reach = np.abs(self.axis[:, k]) * self.half + self.radius
        more, away = images_seen(self.centre[:, k], reach, period, *span)
        which = np.concatenate([np.arange(len(reach)), more])
        centre = self.centre[which]
        centre[len(reach) :, k] += away
        return Rods(centre, self.axis[which], self.half[which], self.radius[which]), which


def label_image(rods: Rods, labels: np.ndarray, raster: Raster, z: float) -> np.ndarray:
    """The label (N,) of the cell at each pixel of the plane at height z, 0 where there is none.
    Where two cells overlap, the pixel is the one's in which it lies deeper below the surface; of
    cells of one radius, the one's whose centreline is nearer. Ties go to the lower label."""
    out = np.zeros(raster.shape, labels.dtype)
    deepest = np.zeros(out.size)
    for cell, at, x, y in _pixels(rods, raster):
        away = np.stack([x, y, np.full(len(x), z)], 1) - rods.centre[cell]
        along = (away * rods.axis[cell]).sum(1)
        away -= np.clip(along, -rods.half[cell], rods.half[cell])[:, None] * rods.axis[cell]
        depth = rods.radius[cell] - np.sqrt((away * away).sum(1))
        inside = np.flatnonzero((depth >= 0) & (depth >= deepest[at]))
        # the deepest comes last, and stays
        order = inside[np.lexsort((-labels[cell[inside]].astype(np.int64), depth[inside]))]
        taken = order[(depth[order] > deepest[at[order]]) | (out.reshape(-1)[at[order]] == 0)]
        deepest[at[taken]] = depth[taken]
        out.reshape(-1)[at[taken]] = labels[cell[taken]]
    return out


def thickness_image(rods: Rods, weights: np.ndarray, raster: Raster, flat: bool) -> np.ndarray:
    """Σ over cells of weights (M, N) times how long the vertical line through the centre of each
    pixel runs inside the cell, µm: (M, rows, columns). flat: 1 instead of that length."""
    out = np.zeros((len(weights), raster.shape[0] * raster.shape[1]))
    for cell, at, chord in thickness_at_pixels(rods, raster, flat):
        for image, weight in zip(out, weights, strict=True):
            np.add.at(image, at, chord * weight[cell])
    return out.reshape(len(weights), *raster.shape)


def thickness_at_pixels(
    rods: Rods, raster: Raster, flat: bool
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The terms of a `thickness_image` of ones, some cells at a time: the cell, the place of the
    pixel in the flat image, and the length, µm, (K,) each."""
    for cell, at, x, y in _pixels(rods, raster):
        chord = _chord(rods, cell, x, y)
        (seen,) = np.nonzero(chord > 0)
        yield cell[seen], at[seen], np.ones(len(seen)) if flat else chord[seen]


def _pixels(
    rods: Rods, raster: Raster
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """The pixels in the boxes around the cells, some cells at a time: the cell and the place of the
    pixel in the flat image, (K,), and its centre, (K,) each, µm."""
    reach, (rows, columns) = rods.reach, raster.shape
    x = (rods.centre[:, 0] - raster.left) / raster.pixel - 0.5
    y = (raster.top - rods.centre[:, 1]) / raster.pixel - 0.5
    low = np.ceil(np.stack([y - reach[:, 1] / raster.pixel, x - reach[:, 0] / raster.pixel], 1))
    high = np.floor(np.stack([y + reach[:, 1] / raster.pixel, x + reach[:, 0] / raster.pixel], 1))
    low = np.clip(low, 0, (rows, columns)).astype(np.int64)
    high = np.clip(high + 1, low, (rows, columns)).astype(np.int64)
    size = high - low
    count = size[:, 0] * size[:, 1]
    ends = np.searchsorted(np.cumsum(count), np.arange(AT_ONCE, count.sum() + AT_ONCE, AT_ONCE))
    start = 0
    for end in np.unique(np.minimum(ends + 1, len(count))):
        part = np.arange(start, end)
        start = int(end)
        cell = np.repeat(part, count[part])
        first = np.cumsum(count[part]) - count[part]
        within = np.arange(len(cell)) - np.repeat(first, count[part])
        row = low[cell, 0] + within // np.maximum(size[cell, 1], 1)
        column = low[cell, 1] + within % np.maximum(size[cell, 1], 1)
        yield (
            cell,
            row * columns + column,
            raster.left + (column + 0.5) * raster.pixel,
            raster.top - (row + 0.5) * raster.pixel,
        )


def _chord(rods: Rods, cell: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The length, (K,) µm, inside the capsule `cell` (K,) of the vertical line through (x, y). A
    capsule is convex: the line enters and leaves it once, at a cap or at the cylinder."""
    radius, half, axis = rods.radius[cell], rods.half[cell], rods.axis[cell]
    px, py = x - rods.centre[cell, 0], y - rods.centre[cell, 1]
    low, high = np.full(len(x), np.inf), np.full(len(x), -np.inf)
    for end in (-half, half):
        apart = radius**2 - (px - end * axis[:, 0]) ** 2 - (py - end * axis[:, 1]) ** 2
        hit = apart >= 0
        reach = np.sqrt(np.where(hit, apart, 0.0))
        low = np.where(hit, np.minimum(low, end * axis[:, 2] - reach), low)
        high = np.where(hit, np.maximum(high, end * axis[:, 2] + reach), high)
    # the infinite cylinder: a z² − 2 b z + c = 0, and the slab between its ends
    level = axis[:, 0] * px + axis[:, 1] * py
    a = 1 - axis[:, 2] ** 2
    b = level * axis[:, 2]
    c = px**2 + py**2 - level**2 - radius**2
    upright = a < 1e-12
    root = b * b - a * c
    inside = np.where(upright, c <= 0, root >= 0)
    a = np.where(upright, 1.0, a)
    reach = np.where(upright, np.inf, np.sqrt(np.where(root > 0, root, 0.0)) / a)
    enter, leave = b / a - reach, b / a + reach
    steep = np.where(np.abs(axis[:, 2]) < 1e-12, 1e-12, axis[:, 2])
    slab = np.sort(np.stack([(-half - level) / steep, (half - level) / steep]), axis=0)
    enter, leave = np.maximum(enter, slab[0]), np.minimum(leave, slab[1])
    hit = inside & (enter < leave)
    low = np.where(hit, np.minimum(low, enter), low)
    high = np.where(hit, np.maximum(high, leave), high)
    return np.where(high > low, high - low, 0.0)
