"""Founders at random places: an inoculum of one strain, or of several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from torchfilm.distributions import Uniform
from torchfilm.initial_cells import Cells
from torchfilm.physics.nearby import gaps_nearby
from torchfilm.tools import checks
from torchfilm.values import Distribution

ROUNDS = 2000  # in which cells that overlap others are placed again


@checks.known_keywords
def inoculum(
    count: int,
    radius: float,
    *,
    types: Mapping[int, float] | None = None,
    colonies: int = 1,
    dim: int = 2,
    length: float | Uniform | Sequence[float] | np.ndarray | Tensor = 2.0,
    cell_radius: float = 0.5,
    floor: float | None = None,
    seed: int = 0,
) -> Cells:
    """Founders at random places and in random directions, `count` in each of some colonies.

        founders = tf.inoculum(30, radius=15.0, types={0: 0.9, 1: 0.1}, colonies=8)

    radius: of the disc, in 3-D the ball, that contains their centres, µm. types: the share of each
    cell type, which together are 1; each colony has these shares, as near as whole numbers of cells
    come to them, and who is of which type is drawn. dim: 2 or 3. length: of the centreline, µm: one
    number; tf.Uniform(2, 4) to draw each, since cells of one length divide all at once; or one for
    each of `count` cells, the same in all colonies. cell_radius: µm. floor: in 3-D, µm: cells lie
    flat on a floor at this z, in a disc around the z axis, instead of in a ball. No two cells
    overlap. Colony k is the same whatever their number.
    Raises InputError for shares that do not sum to 1, and where the cells do not find room: rods
    placed one after the other at random fill at most about 45 % of an area, 30 % of a volume.
    """
    checks.integer("count", count, least=1)
    checks.number("radius", radius, least=0.0)
    checks.integer("colonies", colonies, least=1)
    checks.choice("dim", dim, (2, 3))
    lengths = _lengths(length, count, colonies, seed)
    checks.number("cell_radius", cell_radius, above=0.0)
    checks.integer("seed", seed, least=0)
    if floor is not None:
        checks.number("floor", floor)
        if dim == 2:
            raise checks.input_error("floor", floor, "left out with dim=2", "Take dim=3.")
    shares, placed_in = _shares(types), 2 if floor is not None else dim
    made = [
        _colony(np.random.default_rng([seed, k]), radius, placed_in, lengths[k], cell_radius)
        for k in range(colonies)
    ]
    if floor is not None:
        made = [_lying(*placed, floor + cell_radius) for placed in made]
    kinds = [_types(np.random.default_rng([seed, k, 1]), count, shares) for k in range(colonies)]
    return Cells(
        np.concatenate([position for position, _ in made]),
        np.concatenate([axis for _, axis in made]),
        lengths.reshape(-1),
        cell_radius,
        cell_type=None if shares is None else np.concatenate(kinds),
        colony=None if colonies == 1 else np.repeat(np.arange(colonies), count),
    )


def _lengths(given: object, count: int, colonies: int, seed: int) -> np.ndarray:
    """The length of each cell, (colonies, count), checked."""
    if isinstance(given, Uniform):
        low = checks.number("length.low", given.low, least=0.0)
        high = checks.number("length.high", given.high, least=0.0)
        draws = (np.random.default_rng([seed, k, 2]).random(count) for k in range(colonies))
        return low + (high - low) * np.stack(list(draws))
    rule = f"a number, tf.Uniform(2, 4), or one length for each of the {count} cells"
    if isinstance(given, Distribution | Mapping | str):
        raise checks.input_error("length", given, rule)
    if isinstance(given, Tensor):
        given = given.detach().cpu().numpy()
    try:
        each = np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise checks.input_error("length", given, rule) from error
    if each.ndim == 0:
        return np.full((colonies, count), checks.number("length", float(each), least=0.0))
    if each.shape != (count,) or not (each >= 0).all() or not np.isfinite(each).all():
        raise checks.input_error("length", given, f"{rule}, each finite and at least 0")
    return np.tile(each, (colonies, 1))


def _shares(types: object) -> dict[int, float] | None:
    """The share of each type, checked."""
    if types is None:
        return None
    if not isinstance(types, Mapping) or not types:
        raise checks.input_error("types", types, "a share for each cell type, {0: 0.9, 1: 0.1}")
    for kind, share in types.items():
        checks.integer("types", kind, least=0)
        checks.number(f"types[{kind}]", share, least=0.0, most=1.0)
    total = float(sum(types.values()))
    if abs(total - 1.0) > 1e-6:
        raise checks.input_error(
            "types", dict(types), "shares that sum to 1", f"Their sum is {total:g}."
        )
    return {int(k): float(v) for k, v in sorted(types.items())}


def _types(rng: np.random.Generator, count: int, shares: dict[int, float] | None) -> np.ndarray:
    """The type of each cell, (count,): whole numbers by the largest remainders, in random order."""
    if shares is None:
        return np.zeros(count, np.int64)
    wanted = count * np.array(list(shares.values()))
    numbers = np.floor(wanted + 1e-9).astype(int)
    left = np.argsort(numbers - wanted, kind="stable")[: count - numbers.sum()]
    numbers[left] += 1
    return rng.permutation(np.repeat(list(shares), numbers))


def _colony(
    rng: np.random.Generator, radius: float, dim: int, length: np.ndarray, cell_radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and axes of the cells of a colony, (count, dim) each; length: (count,)."""
    count = len(length)
    position, axis = np.empty((count, dim)), np.empty((count, dim))
    again = np.arange(count)
    for _ in range(ROUNDS):
        way = rng.normal(size=(2, len(again), dim))
        way /= np.linalg.norm(way, axis=2, keepdims=True)
        position[again] = radius * rng.random((len(again), 1)) ** (1 / dim) * way[0]
        axis[again] = way[1]
        again = _overlapping(position, axis, length, cell_radius, again)
        if not again.size:
            return position, axis
    mean = length.mean()
    raise checks.input_error(
        "radius", radius, "wide enough for the cells",
        f"{count} cells of length {mean:g} and radius {cell_radius:g} µm would fill"
        f" {_filled(count, radius, dim, mean, cell_radius):.0%} of it, and did not find room in"
        f" {ROUNDS} rounds: give a greater radius, or fewer cells.",
    )  # fmt: skip


def _filled(count: int, radius: float, dim: int, length: float, cell_radius: float) -> float:
    """The share of the disc, or the ball, that cells fill; those at its rim stick out of it."""
    across, around = 2.0 * length * cell_radius, np.pi * cell_radius**2
    if dim == 2:
        return count * (across + around) / (np.pi * (radius + cell_radius) ** 2)
    volume = around * (length + 4.0 / 3.0 * cell_radius)
    return count * volume / (4.0 / 3.0 * np.pi * (radius + cell_radius) ** 3)


def _lying(position: np.ndarray, axis: np.ndarray, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells of the plane in space, at this height."""
    column = np.full((len(position), 1), z)
    return np.hstack([position, column]), np.hstack([axis, 0.0 * column])


def _overlapping(
    position: np.ndarray, axis: np.ndarray, length: np.ndarray, radius: float, new: np.ndarray
) -> np.ndarray:
    """Which of the `new` cells overlap one that was there, or a new one before them."""
    count = len(position)
    wide = torch.full((count,), radius, dtype=torch.float64)
    one = torch.zeros(count, dtype=torch.int64)
    first, second, gap = gaps_nearby(
        torch.from_numpy(position), torch.from_numpy(axis), torch.from_numpy(length), wide, one, 1
    )
    is_new = torch.zeros(count, dtype=torch.bool)
    is_new[new] = True
    later = torch.where(is_new[second], second, first)
    return later[gap < 0].unique().numpy()
