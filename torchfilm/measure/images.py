"""Images of colonies, as a camera above them would see them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchfilm.io.microscopy import PROFILES, checked_window, raster_of
from torchfilm.io.raster import Raster, Rods, label_image, thickness_image
from torchfilm.measure.of_a_state import of_a_state
from torchfilm.spatial import quantity
from torchfilm.state import State
from torchfilm.tools import checks

Window = tuple[Sequence[float], Sequence[float]]  # two corners, µm


@of_a_state
@torch.no_grad()
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
    right corner, µm, of all colonies alike; the first row lies at the greatest y. profile: "flat"
    for the quantity itself, however thick the cell. A pixel is looked at in its centre. In a
    periodic space images of cells beyond the faces are seen. `Results.to_ome_tiff` adds optics and
    noise. Raises InputError for what is no quantity, and for more than 2²⁸ pixels.
    """
    checks.choice("image(profile)", profile, PROFILES)
    given = [names] if isinstance(names, str | Tensor) else list(names or ())
    if not given:
        raise checks.input_error("image(names)", names, "one or more quantities, such as 'gfp'")
    values = torch.stack([quantity("image", state, name) for name in given]).cpu().numpy()
    raster = _raster("image", pixel_size, window)
    pages = [
        thickness_image(seen, values[:, rows], raster, profile == "flat")
        for seen, rows in _colonies(state, raster, None)
    ]
    return torch.from_numpy(np.stack(pages)).to(state.device)


@of_a_state
@torch.no_grad()
def labels(state: State, *, pixel_size: float, window: Window, z: float | None = None) -> Tensor:
    """Label masks of each colony from above, (B, rows, columns) int64: a cell's uid plus 1 where it
    covers the centre of a pixel, 0 where none does; where two overlap, the one in which it lies
    deeper. pixel_size, window: as for `image`. z: in space, the height of the section, µm."""
    if (z is None) != (state.dim == 2):
        rule = "left out in the plane" if state.dim == 2 else "the height of the section, µm"
        raise checks.input_error("labels(z)", z, rule)
    height = 0.0 if z is None else checks.number("labels(z)", z)
    raster, uid = _raster("labels", pixel_size, window), state.uid.cpu().numpy() + 1
    pages = [
        label_image(seen, uid[rows], raster, height) for seen, rows in _colonies(state, raster, z)
    ]
    return torch.from_numpy(np.stack(pages)).to(state.device)


def _raster(measure: str, pixel_size: float, window: Window) -> Raster:
    pixel = checks.number(f"{measure}(pixel_size)", pixel_size, above=0.0, hint="In µm.")
    return raster_of(pixel, checked_window(window))


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
