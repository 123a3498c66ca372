"""Founders at random places: an inoculum of one strain, or of several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.distributions import Uniform
from torchfilm.initial_cells import Cells
from torchfilm.physics.nearby import gaps_nearby
from torchfilm.tools import checks
from torchfilm.tools.warn_once import warn
from torchfilm.values import Distribution

DIFFERENT = "For numbers that differ between colonies: tf.Founders(function, count=[…])."
ROUNDS = 2000  # in which cells that overlap others are placed again


@checks.known_keywords
def inoculum(
    count: int,
    radius: float | None = None,
    *,
    box: tuple[Sequence[float], Sequence[float]] | None = None,
    centre: Sequence[float] | None = None,
    types: Mapping[int, float] | None = None,
    extra: Mapping[str, Any] | None = None,
    colonies: int = 1,
    dim: int = 2,
    length: float | Uniform | Sequence[float] | np.ndarray | Tensor | Mapping[int, Any] = 2.0,
    cell_radius: float | Mapping[int, float] = 0.5,
    floor: float | None = None,
    seed: int = 0,
) -> Cells:
    """Founders at random places and in random directions, `count` in each of some colonies.

        founders = tf.inoculum(30, radius=15.0, types={0: 0.9, 1: 0.1}, colonies=8)

    radius: of the disc, in 3-D the ball, that contains their centres, µm. box: in its place the
    lower and upper corner of the rectangle, or block, that does: box=((0, 0), (100, 4)) for a
    front. centre: of the disc, µm, by default the origin. types: the share of each cell type, which
    together are 1; each colony has these shares, as near as whole numbers of cells come to them,
    and who is of which type is drawn; or their numbers, {0: 3, 1: 27}, which together are `count`.
    extra: variables of the cells by name, one number, or a dict by type: {"plasmids": {0: 4, 1:
    0}}. dim: 2 or 3. length: of the centreline, µm: one number; tf.Uniform(2, 4) to draw each,
    since cells of one length divide all at once; a dict of these by type, {0: 2.0, 1: tf.Uniform(0,
    1)}; or one for each of `count` cells, the same in all colonies. cell_radius: µm, one number, or
    a dict by type. floor: in 3-D, µm: cells lie flat on a floor at this z, in a disc or a
    rectangle, instead of in a ball or a block. No two cells overlap. seed: of all that is drawn;
    colony k is the same however many there are. Raises InputError for shares that do not sum to 1,
    and where the cells do not find room: rods placed one after the other at random fill at most
    about 45 % of an area, 30 % of a volume. Warns of a share of which no cell comes.
    """
    checks.integer("count", count, least=1, hint=DIFFERENT)
    checks.integer("colonies", colonies, least=1)
    checks.choice("dim", dim, (2, 3))
    checks.integer("seed", seed, least=0)
    shares = _shares(types, count)
    kinds = np.stack(
        [_types(np.random.default_rng([seed, k, 1]), count, shares) for k in range(colonies)]
    )
    lengths = _lengths(length, kinds, shares, seed)
    radii = _of_each("cell_radius", cell_radius, kinds, shares, above=0.0)
    more = _variables({} if extra is None else extra, kinds, shares)
    if floor is not None:
        checks.number("floor", floor)
        if dim == 2:
            raise checks.input_error("floor", floor, "left out with dim=2", "Take dim=3.")
    place = _place(radius, box, centre, 2 if floor is not None else dim)
    made = [
        _colony(np.random.default_rng([seed, k]), place, lengths[k], radii[k])
        for k in range(colonies)
    ]
    if floor is not None:
        made = [_lying(*placed, floor + own) for placed, own in zip(made, radii, strict=True)]
    return Cells(
        np.concatenate([position for position, _ in made]),
        np.concatenate([axis for _, axis in made]),
        lengths.reshape(-1),
        radii.reshape(-1),
        cell_type=None if shares is None else kinds.reshape(-1),
        colony=None if colonies == 1 else np.repeat(np.arange(colonies), count),
        extra={name: numbers.reshape(-1) for name, numbers in more.items()},
    )


def _by_type(name: str, given: Mapping[int, Any], shares: Mapping[int, float] | None) -> None:
    """Raises InputError unless the dict has a value for each type, and no others."""
    kinds = () if shares is None else tuple(shares)
    if {*given} != {*kinds}:
        rule = f"a value for each of the types {', '.join(map(str, kinds))}"
        hint = "Give their shares, such as types={0: 0.9, 1: 0.1}."
        rule = "one number where there are no types" if shares is None else rule
        raise checks.input_error(name, dict(given), rule, hint if shares is None else "")


def _variables(
    given: Any, kinds: np.ndarray, shares: Mapping[int, float] | None
) -> dict[str, np.ndarray]:
    """The variables of each cell by name, of the shape of their `kinds`, checked."""
    if not isinstance(given, Mapping):
        raise checks.input_error("extra", given, 'numbers by name, such as {"plasmids": 4}')
    for name in given:
        if not isinstance(name, str):
            raise checks.input_error("extra", name, 'names, such as "plasmids"')
    return {name: _of_each(f"extra[{name!r}]", x, kinds, shares) for name, x in given.items()}


def _of_each(
    name: str,
    given: Any,
    kinds: np.ndarray,
    shares: Mapping[int, float] | None,
    above: float = -math.inf,
) -> np.ndarray:
    """A number of each cell, of the shape of their `kinds`, of one or a dict by type, checked."""
    if not isinstance(given, Mapping):
        return np.full(kinds.shape, checks.number(name, given, above=above))
    _by_type(name, given, shares)
    found = np.empty(kinds.shape)
    for kind, value in given.items():
        found[kinds == kind] = checks.number(f"{name}[{kind}]", value, above=above)
    return found


def _lengths(
    given: object, kinds: np.ndarray, shares: Mapping[int, float] | None, seed: int
) -> np.ndarray:
    """The length of each cell, of the shape of their `kinds`, (colonies, count), checked."""
    colonies, count = kinds.shape
    if isinstance(given, Uniform):
        return _drawn("length", given, kinds, seed)
    rule = f"a number, tf.Uniform(2, 4), or one length for each of the {count} cells"
    if isinstance(given, Mapping):
        _by_type("length", given, shares)
        found = np.empty(kinds.shape)
        for kind, value in given.items():
            name, mine = f"length[{kind}]", kinds == kind
            found[mine] = (
                _drawn(name, value, kinds, seed)[mine]
                if isinstance(value, Uniform)
                else checks.number(name, value, least=0.0)
            )
        return found
    if isinstance(given, Distribution | str):
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


def _drawn(name: str, given: Uniform, kinds: np.ndarray, seed: int) -> np.ndarray:
    """A length for each cell, of the shape of their `kinds`."""
    low = checks.number(f"{name}.low", given.low, least=0.0)
    high = checks.number(f"{name}.high", given.high, least=0.0)
    colonies, count = kinds.shape
    draws = (np.random.default_rng([seed, k, 2]).random(count) for k in range(colonies))
    return low + (high - low) * np.stack(list(draws))


def _shares(types: object, count: int) -> dict[int, float] | None:
    """The share of each type, checked, from shares or numbers of `count` cells."""
    if types is None:
        return None
    if not isinstance(types, Mapping) or not types:
        raise checks.input_error("types", types, "a share for each cell type, {0: 0.9, 1: 0.1}")
    for kind in types:
        checks.integer("types", kind, least=0)
    whole = all(isinstance(n, int | np.integer) and type(n) is not bool for n in types.values())
    all_cells = sum(map(int, types.values())) if whole else -1
    if whole and (all_cells == count or set(types.values()) - {0, 1}):
        numbers = {k: checks.integer(f"types[{k}]", n, least=0) for k, n in types.items()}
        if all_cells != count:
            rule = f"numbers that sum to the count, {count}, or shares that sum to 1"
            raise checks.input_error("types", numbers, rule, f"Their sum is {all_cells}.")
        types = {kind: n / count for kind, n in numbers.items()}
    for kind, share in types.items():
        checks.number(f"types[{kind}]", share, least=0.0, most=1.0)
    total = float(sum(types.values()))
    if abs(total - 1.0) > 1e-6:
        raise checks.input_error(
            "types", dict(types), "shares that sum to 1", f"Their sum is {total:g}."
        )
    shares = {int(k): float(v) for k, v in sorted(types.items())}
    numbers = dict(zip(shares, _numbers(count, shares), strict=True))
    if none := [kind for kind, share in shares.items() if share > 0 and not numbers[kind]]:
        warn(
            # without the numbers, so that the colonies of a search warn once
            f"types[{none[0]}] is so small a share of the cells that none comes. Take more cells,"
            f" or give numbers, such as types={{{none[0]}: 1, …}}."
        )
    return shares


def _types(rng: np.random.Generator, count: int, shares: dict[int, float] | None) -> np.ndarray:
    """The type of each cell, (count,): whole numbers by the largest remainders, in random order."""
    if shares is None:
        return np.zeros(count, np.int64)
    return rng.permutation(np.repeat(list(shares), _numbers(count, shares)))


def _numbers(count: int, shares: Mapping[int, float]) -> np.ndarray:
    """How many cells are of each type."""
    wanted = count * np.array(list(shares.values()))
    numbers = np.floor(wanted + 1e-9).astype(int)
    left = np.argsort(numbers - wanted, kind="stable")[: count - numbers.sum()]
    numbers[left] += 1
    return numbers


@dataclass(frozen=True)
class _Disc:
    """A disc or a ball."""

    radius: float
    centre: np.ndarray
    name = "radius"

    @property
    def dim(self) -> int:
        return len(self.centre)

    def places(self, rng: np.random.Generator, way: np.ndarray) -> np.ndarray:
        """As many as there are ways, (n, dim): unit vectors at random."""
        n, dim = way.shape
        return self.centre + self.radius * rng.random((n, 1)) ** (1 / dim) * way

    def size(self, margin: float) -> float:
        """Area or volume, with a margin around."""
        whole = self.radius + margin
        return np.pi * whole**2 if self.dim == 2 else 4.0 / 3.0 * np.pi * whole**3

    def given(self) -> Any:
        return self.radius


@dataclass(frozen=True)
class _Block:
    """A rectangle or a block."""

    low: np.ndarray
    high: np.ndarray
    name = "box"

    @property
    def dim(self) -> int:
        return len(self.low)

    def places(self, rng: np.random.Generator, way: np.ndarray) -> np.ndarray:
        """As many as there are ways, (n, dim)."""
        return self.low + (self.high - self.low) * rng.random(way.shape)

    def size(self, margin: float) -> float:
        """Area or volume, with a margin around."""
        return float((self.high - self.low + 2.0 * margin).prod())

    def given(self) -> Any:
        return self.low.tolist(), self.high.tolist()


def _place(radius: Any, box: Any, centre: Any, dim: int) -> _Disc | _Block:
    """Where the centres of cells lie, checked."""
    if box is None:
        if radius is None:
            raise checks.input_error("radius", None, "given, or box=((x, y), (x, y)), µm")
        checks.number("radius", radius, least=0.0)
        at = (0.0,) * dim if centre is None else checks.vector("centre", centre, dim)
        return _Disc(float(radius), np.array(at))
    for name, value in (("radius", radius), ("centre", centre)):
        if value is not None:
            raise checks.input_error(name, value, "left out with a box")
    if not isinstance(box, (tuple, list)) or len(box) != 2:
        raise checks.input_error("box", box, "the lower and the upper corner, µm")
    low, high = (np.array(checks.vector(f"box[{k}]", corner, dim)) for k, corner in enumerate(box))
    if (high < low).any():
        raise checks.input_error("box", box, "the lower corner first, and then the upper one")
    return _Block(low, high)


def _colony(
    rng: np.random.Generator, place: _Disc | _Block, length: np.ndarray, cell_radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and axes of the cells of a colony, (count, dim) each; length, cell_radius:
    (count,)."""
    count, dim = len(length), place.dim
    position, axis = np.empty((count, dim)), np.empty((count, dim))
    again = np.arange(count)
    for _ in range(ROUNDS):
        way = rng.normal(size=(2, len(again), dim))
        way /= np.linalg.norm(way, axis=2, keepdims=True)
        position[again] = place.places(rng, way[0])
        axis[again] = way[1]
        again = _overlapping(position, axis, length, cell_radius, again)
        if not again.size:
            return position, axis
    wide = " or ".join(f"{r:g}" for r in np.unique(cell_radius))
    raise checks.input_error(
        place.name, place.given(), "wide enough for the cells",
        f"{count} cells of length {length.mean():g} and radius {wide} µm would fill"
        f" {_filled(place, length, cell_radius):.0%} of it, and did not find room in"
        f" {ROUNDS} rounds: give a greater {place.name}, or fewer cells.",
    )  # fmt: skip


def _filled(place: _Disc | _Block, length: np.ndarray, cell_radius: np.ndarray) -> float:
    """The share of the place that cells fill; those at its rim stick out of it."""
    across, around = 2.0 * length * cell_radius, np.pi * cell_radius**2
    each = across + around if place.dim == 2 else around * (length + 4.0 / 3.0 * cell_radius)
    return float(each.sum()) / place.size(float(cell_radius.max()))


def _lying(position: np.ndarray, axis: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells of the plane in space, at these heights (count,)."""
    column = z[:, None]
    return np.hstack([position, column]), np.hstack([axis, 0.0 * column])


def _overlapping(
    position: np.ndarray, axis: np.ndarray, length: np.ndarray, radius: np.ndarray, new: np.ndarray
) -> np.ndarray:
    """Which of the `new` cells overlap one that was there, or a new one before them."""
    count = len(position)
    wide = torch.from_numpy(radius)
    one = torch.zeros(count, dtype=torch.int64)
    first, second, gap = gaps_nearby(
        torch.from_numpy(position), torch.from_numpy(axis), torch.from_numpy(length), wide, one, 1
    )
    is_new = torch.zeros(count, dtype=torch.bool)
    is_new[new] = True
    later = torch.where(is_new[second], second, first)
    return later[gap < 0].unique().numpy()
