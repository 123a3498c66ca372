"""Images of colonies, as a camera above them would see them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.io.microscopy import PROFILES, checked_window, raster_of
from torchfilm.io.raster import Raster, Rods, label_image, thickness_at_pixels
from torchfilm.measure.of_a_state import of_a_state
from torchfilm.spatial import quantity
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.tangents import tracked

Window = tuple[Sequence[float], Sequence[float]]  # two corners, µm


@of_a_state
def image(
    state: State,
    names: str | Tensor | Sequence[str | Tensor],
    *,
    pixel_size: float,
    window: Window,
    profile: str = "thickness",
) -> Tensor:
    """Images of each colony from above, (B, M, rows, columns) float64: of each of M quantities, its
    sum over the cells at a pixel, times how thick each is there, µm.

    names: as for `profile`, one or several. pixel_size: µm. window: the lower left and the upper
    right corner, µm, of all colonies alike; the first row lies at the greatest y, and pixels are
    counted from the upper left corner, the nearest whole number of them. profile: "flat"
    for the quantity itself, however thick the cell. A pixel is looked at in its centre. In a
    periodic space images of cells beyond the faces are seen. It has derivatives by the quantities;
    a backward pass to where cells are raises InputError. `Results.to_ome_tiff` adds optics and
    noise. Raises InputError for what is no quantity, and for more than 2²⁸ pixels.
    """
    checks.choice("image(profile)", profile, PROFILES)
    given = [names] if isinstance(names, str | Tensor) else names
    if not isinstance(given, Sequence) or not given:
        raise checks.input_error("image(names)", names, "one or more quantities, such as 'gfp'")
    values = [quantity("image", state, name).cpu() for name in given]
    raster = _raster("image", pixel_size, window)
    size = math.prod(raster.shape)
    pages = [x.new_zeros(state.colonies * size) for x in values]
    for colony, (seen, rows) in enumerate(_colonies(state, raster, None)):
        for cell, at, thick in thickness_at_pixels(seen, raster, profile == "flat"):
            pixel, own, length = map(torch.from_numpy, (at + colony * size, rows[cell], thick))
            for page, value in zip(pages, values, strict=True):
                page.index_add_(0, pixel, length * value.index_select(0, own))
    found = torch.stack([x.reshape(state.colonies, *raster.shape) for x in pages], 1)
    shapes = state.position, state.axis, state.length, state.radius
    if tracked(*shapes):
        found = found + _FixedPlaces.apply(*shapes).cpu()
    return found.to(state.device)


class _FixedPlaces(torch.autograd.Function):
    """0, whose derivative by where cells are raises: that of an image would be wrong without a
    word, since a pixel is within a cell or not."""

    @staticmethod
    def forward(ctx: Any, *shapes: Tensor) -> Tensor:
        return shapes[0].new_zeros((), dtype=torch.float64)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        raise _no_derivative()

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise _no_derivative()


def _no_derivative() -> checks.InputError:
    return checks.InputError(
        "measure.image has derivatives by quantities of cells and by nothing else, and a derivative"
        " is wanted that passes places, lengths or radii, too. Let it see fixed ones, as by"
        " image(state.detach(), [state.gfp], …), or take another measure, such as measure.profile."
    )


@of_a_state
@torch.no_grad()
def labels(state: State, *, pixel_size: float, window: Window, z: float | None = None) -> Tensor:
    """Label masks of each colony from above, (B, rows, columns) int64: a cell's uid plus 1 where it
    covers the centre of a pixel, 0 where none does; where two overlap, the one in which it lies
    deeper. pixel_size, window: as for `image`. z: in space, the height of the section, µm."""
    height = _height("labels", state, z)
    raster, uid = _raster("labels", pixel_size, window), state.uid.cpu().numpy() + 1
    pages = [
        label_image(seen, uid[rows], raster, height) for seen, rows in _colonies(state, raster, z)
    ]
    return torch.from_numpy(np.stack(pages)).to(state.device)


@of_a_state
def medium(
    state: State,
    names: str | Sequence[str],
    *,
    pixel_size: float,
    window: Window,
    z: float | None = None,
) -> Tensor:
    """Images of signals in the medium of each colony, (B, M, rows, columns) in the state's dtype:
    the concentration that a cell would find at the centre of each pixel; NaN beyond the box and in
    obstacles. With a reservoir, that beyond the box.

    names: of signals, one or several. pixel_size, window: as for `image`. z: in space, the height,
    µm. It has derivatives by the signals. Raises InputError for a state without them.
    """
    height = _height("medium", state, z)
    given = [names] if isinstance(names, str) else names
    known, layout = state.signals, state.layout
    if layout is None or not isinstance(given, Sequence) or not given or {*given} - {*known}:
        rule = "one or more of the signals " + ", ".join(map(repr, known))
        raise checks.input_error("medium(names)", names, rule if known else "of a scene's Medium")
    raster = _raster("medium", pixel_size, window)
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in raster.shape)
    y, x = raster.top - (rows + 0.5) * raster.pixel, raster.left + (columns + 0.5) * raster.pixel
    at = torch.stack(torch.meshgrid(y, x, indexing="ij"), -1).flip(-1).reshape(-1, 2)
    if state.dim == 3:
        at = torch.cat([at, at.new_full((len(at), 1), height)], 1)
    place = at.to(state.device).repeat(state.colonies, 1)
    colony = torch.arange(state.colonies, device=state.device).repeat_interleave(len(at))
    signals = {name: known[name] for name in given}
    seen = layout.contact(place, colony, state.colony_id, signals, state.dtype)
    lost = seen.stencil.blocked if layout.reservoir is not None else seen.stencil.outside
    found = torch.stack([seen.found[name] for name in given])
    if lost is not None:
        found = torch.where(lost, torch.nan, found)
    shape = len(given), state.colonies, *raster.shape
    return found.reshape(shape).transpose(0, 1).contiguous()


def _height(measure: str, state: State, z: float | None) -> float:
    if (z is None) != (state.dim == 2):
        rule = "left out in the plane" if state.dim == 2 else "the height of the section, µm"
        raise checks.input_error(f"{measure}(z)", z, rule)
    return 0.0 if z is None else checks.number(f"{measure}(z)", z)


def _raster(measure: str, pixel_size: float, window: Window) -> Raster:
    pixel = checks.number(f"{measure}(pixel_size)", pixel_size, above=0.0, hint="In µm.")
    return raster_of(pixel, checked_window(window))


@torch.no_grad()
def _colonies(state: State, raster: Raster, z: float | None) -> list[tuple[Rods, np.ndarray]]:
    """The shapes that are seen of each colony, and which rows of the state they are."""
    flat = lambda x: np.pad(x.double().cpu().numpy(), ((0, 0), (0, 3 - state.dim)))
    place, axis = flat(state.position), flat(state.axis)
    half, radius = (x.double().cpu().numpy() for x in (0.5 * state.length, state.radius))
    faces = {} if state.space is None else state.space.faces
    found, ends = [], np.cumsum(state.counts.cpu().numpy())
    for first, last in zip([0, *ends[:-1]], ends, strict=True):
        own = slice(int(first), int(last))
        rods = Rods(place[own], axis[own], half[own], radius[own])
        seen, which = rods.seen(faces, raster, z)
        found.append((seen, int(first) + which))
    return found
