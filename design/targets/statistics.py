"""Statistics of colonies that can be seen under a microscope, of simulated and of observed cells
alike."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

import torchfilm as tf
from design.targets.base import levels, ratio, require
from design.targets.geometry import periodic_along
from torchfilm import checks

LOG_CELLS = "log_cells"
QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
RESAMPLED = 200  # bootstrapped colonies
# the last words of the groups of statistics that distances between cells enter
OF_PLACES = ("extent", "density", "alignment", "profile", "neighbours")
INNER = 0.95  # share of the cells within the outermost ring
STEADY = 1e-12  # variance, in squares of the mean, that rounding can cause


@dataclass(frozen=True)
class SeenCells:
    """The cells of B colonies, those of one colony side by side, as statistics need them.

    colony (N,) int64; counts (B,); position (N, 2) µm, axis (N, 2) unit vectors, length (N,) µm,
    age (N,) h, levels (N, S) of S species, radius (N,) µm; None where it is not known.
    """

    colony: Tensor
    counts: Tensor
    position: Tensor | None = None
    axis: Tensor | None = None
    length: Tensor | None = None
    age: Tensor | None = None
    levels: Tensor | None = None
    radius: Tensor | None = None

    @cached_property
    def groups(self) -> tf.Groups:
        """The cells of each colony, for sums."""
        return tf.Groups(self.colony, len(self.counts), ordered=True)


@dataclass(frozen=True)
class ColonyStatistics:
    """Which statistics of a colony are compared.

    lengths, ages, positions, alignment: whether the lengths, ages, places and directions of cells
    are known. species: reporters. edges: of the rings around the centre of the colony, µm, the
    first 0. reach: cells whose centres are closer are neighbours, µm. length_with_caps: lengths
    include the caps. relative: levels count relative to the mean of their colony. omitted: groups
    that are left out. quantiles: whether those of levels are compared. amounts: levels are those
    of whole cells, concentration × volume.
    """

    lengths: bool
    ages: bool
    positions: bool
    alignment: bool
    species: tuple[str, ...]
    edges: tuple[float, ...]
    reach: float
    length_with_caps: bool
    relative: bool
    omitted: tuple[str, ...] = ()
    # not shown: files of simulations know their statistics by name, and older ones have none
    quantiles: bool = field(default=False, repr=False)
    amounts: bool = False

    def __repr__(self) -> str:
        """By which studies and files of simulations are told apart; those of earlier versions knew
        no amounts."""
        shown = [f.name for f in fields(self) if f.repr and (f.name != "amounts" or self.amounts)]
        return f"ColonyStatistics({', '.join(f'{n}={getattr(self, n)!r}' for n in shown)})"

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The names of the statistics, (K,) in all, by what they are about."""
        return {g: names for g, names in self._known_groups().items() if g not in self.omitted}

    def _known_groups(self) -> dict[str, tuple[str, ...]]:
        percent = [f"{100 * q:.0f}" for q in QUANTILES]
        rings = range(1, len(self.edges))
        found: dict[str, tuple[str, ...]] = {"cells": (LOG_CELLS,)}
        if self.lengths:
            found["length"] = tuple(f"length_{p}_um" for p in percent)
        if self.ages:
            found["age"] = tuple(f"age_{p}_h" for p in percent)
        if self.positions:
            found["extent"] = ("gyration_um",)
            found["density"] = tuple(f"density_{k}" for k in rings)
        if self.alignment:
            found["alignment"] = ("alignment",)
        for name in (f"{n}_amount" if self.amounts else n for n in self.species):
            if not self.relative:
                found[name] = (f"{name}_mean",)
            if self.positions:
                found[f"{name} profile"] = tuple(f"{name}_ring_{k}" for k in rings)
                found[f"{name} neighbours"] = (f"{name}_neighbours",)
            found[f"{name} variation"] = (f"{name}_cv",)
            if self.quantiles:
                found[f"{name} quantiles"] = tuple(f"{name}_{p}" for p in percent)
        return found

    def check(self, state: tf.State) -> None:
        """Raises `tf.InputError` where colonies like those of a state have no such statistics."""
        require(state, self.species)
        around = periodic_along(state, "xy")
        of_places = [g for g in self.groups if g.split()[-1] in OF_PLACES]
        if around and of_places:
            raise tf.InputError(
                f"Observed compares places ({', '.join(of_places)}), and in this scene space is"
                f" periodic along {around}. Leave them out:"
                f" .without({', '.join(map(repr, of_places))})."
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Of all statistics, (K,)."""
        return tuple(name for names in self.groups.values() for name in names)

    def of(self, cells: SeenCells) -> Tensor:
        """The statistics of each colony, (B, K) float64, with gradients by the levels. A colony
        without cells has NaN."""
        parts = [cells.counts.double().log().unsqueeze(1)]
        if self.lengths:
            parts.append(_quantiles(_known(cells.length), cells))
        if self.ages:
            parts.append(_quantiles(_known(cells.age), cells))
        radius, pairs = None, None
        if self.positions:
            radius = from_centre(_known(cells.position), cells)
            pairs = _neighbours(_known(cells.position), cells.colony, self.reach)
            parts += [_means(radius * radius, cells).sqrt(), self._density(radius, cells)]
        if self.alignment:
            assert pairs is not None
            parts.append(_alignment(_known(cells.axis), cells, pairs))
        for k in range(len(self.species)):
            parts.append(self._reporter(_known(cells.levels)[:, k], cells, radius, pairs))
        found = torch.cat(parts, 1)
        if self.omitted:
            every = [n for names in self._known_groups().values() for n in names]
            found = found[:, [every.index(name) for name in self.names]]
        return torch.where((cells.counts > 0).unsqueeze(1), found, math.nan)

    def _ring(self, radius: Tensor) -> Tensor:
        """The ring of each cell, from 0, (N,); beyond the last edge as many as there are rings."""
        outer = radius.new_tensor(self.edges[1:])
        return torch.bucketize(radius.squeeze(1), outer, right=True)

    def _density(self, radius: Tensor, cells: SeenCells) -> Tensor:
        """Cells per µm² in each ring, (B, rings)."""
        rings = len(self.edges) - 1
        ring = self._ring(radius)
        count = _sums(torch.nn.functional.one_hot(ring, rings + 1).double(), cells)[:, :rings]
        square = radius.new_tensor(self.edges).square()
        return count / (math.pi * square.diff())

    def _reporter(
        self, level: Tensor, cells: SeenCells, radius: Tensor | None, pairs: Tensor | None
    ) -> Tensor:
        """Mean, means in rings, correlation between neighbours, coefficient of variation and
        quantiles of one reporter, (B, …). An empty ring counts as one with the mean of the
        colony."""
        mean = _means(level.unsqueeze(1), cells)
        scale = torch.where(mean != 0, mean, 1.0) if self.relative else torch.ones_like(mean)
        parts = [] if self.relative else [mean]
        if radius is not None and pairs is not None:
            rings = len(self.edges) - 1
            # cells beyond the last edge belong to the last ring
            inside = torch.nn.functional.one_hot(self._ring(radius).clamp(max=rings - 1), rings)
            count = _sums(inside.double(), cells)
            amount = _sums(inside * level.unsqueeze(1), cells)
            filled = count > 0
            profile = torch.where(filled, amount / torch.where(filled, count, 1.0), mean)
            parts += [profile / scale, _correlation(level, mean, cells, pairs)]
        parts.append(_variation(level, mean, cells))
        if self.quantiles:
            parts.append(_quantiles(level, cells) / scale)
        return torch.cat(parts, 1)


def seen_cells(state: tf.State, plan: ColonyStatistics, history: Tensor | None) -> SeenCells:
    """The cells of a state as a microscope sees them from above. history: the notes of
    `birth_note`, which ages need."""
    flat = state.axis[:, :2].double()
    size = flat.square().sum(1, keepdim=True).sqrt()
    upright = torch.tensor([1.0, 0.0], dtype=torch.float64, device=flat.device)
    length = state.length.double() + (2.0 * state.radius.double() if plan.length_with_caps else 0.0)
    found = [levels(state, name).double() for name in plan.species]
    if plan.amounts:
        found = [x * state.volume.double() for x in found]
    return SeenCells(
        colony=state.colony,
        counts=state.counts,
        position=state.position[:, :2].detach(),
        axis=torch.where(size > 0, flat / torch.where(size > 0, size, 1.0), upright).detach(),
        length=length.detach(),
        age=_ages(state, history) if plan.ages else None,
        levels=torch.stack(found, 1) if found else None,
        radius=state.radius.detach(),
    )


def birth_note(state: tf.State) -> Tensor:
    """The time and the next uid of each colony, (B, 2) float64: uids grow with time, so that
    the notes of all steps tell when each cell was born."""
    return torch.stack([torch.full_like(state.next_uid, state.time, dtype=torch.float64),
                        state.next_uid.double()], 1)  # fmt: skip


def _ages(state: tf.State, history: Tensor | None) -> Tensor:
    """The age of each cell, (N,) h; that of founders is the time since the start, and of cells that
    an effect adds, which have no parent either, since the step that added them."""
    if history is None:
        raise tf.InputError(
            "ages need the notes of all steps: stack target.note(state) after each of them, or"
            " leave ages out."
        )
    times, uids = history[:, :, 0], history[:, :, 1]
    step = (uids.index_select(1, state.colony) <= state.uid).sum(0)
    born = times[step.clamp(max=len(times) - 1), state.colony]
    return state.time - torch.where((step == 0) & (state.parent < 0), 0.0, born)


def resampled_spread(cells: SeenCells, plan: ColonyStatistics, colony: int) -> Tensor:
    """The standard deviation of each statistic (K,) when the cells of one colony are drawn again
    with replacement; of the logarithm of their number, 1/√N."""
    rows = torch.nonzero(cells.colony == colony).squeeze(1).cpu()
    count = len(rows)
    drawn = np.random.default_rng(0).integers(count, size=(RESAMPLED, count))
    drawn_rows = rows[torch.from_numpy(drawn.ravel())].to(cells.colony.device)
    take = lambda value: None if value is None else value.index_select(0, drawn_rows)
    again = SeenCells(
        torch.arange(RESAMPLED, device=cells.colony.device).repeat_interleave(count),
        torch.full((RESAMPLED,), count, device=cells.colony.device),
        take(cells.position), take(cells.axis), take(cells.length), take(cells.age),
        take(cells.levels),
    )  # fmt: skip
    found = plan.of(again).std(0)
    if plan.names[0] == LOG_CELLS:
        found[0] = 1.0 / math.sqrt(count)
    return found


def _known(value: Tensor | None) -> Tensor:
    assert value is not None  # a plan speaks only of what its cells have
    return value


def _sums(value: Tensor, cells: SeenCells) -> Tensor:
    """The sums over colonies of (N, k): (B, k); cell by cell, whatever else is in the batch."""
    return cells.groups.sum(value.double())


def _means(value: Tensor, cells: SeenCells) -> Tensor:
    return _sums(value, cells) / cells.counts.clamp(min=1).unsqueeze(1)


def _quantiles(value: Tensor, cells: SeenCells) -> Tensor:
    """Of each colony, (B, 5), linear between two cells."""
    order = torch.argsort(value, stable=True)
    order = order[torch.argsort(cells.colony[order], stable=True)]
    sorted_values = torch.cat([value[order].double(), value.new_zeros(1, dtype=torch.float64)])
    first = torch.cumsum(cells.counts, 0) - cells.counts
    share = torch.tensor(QUANTILES, dtype=torch.float64, device=value.device)
    place = share * (cells.counts - 1).clamp(min=0).unsqueeze(1)
    below = place.floor()
    low = first.unsqueeze(1) + below.long()
    high = first.unsqueeze(1) + place.ceil().long()
    last = len(value)  # a colony without cells may stand at the end
    one, other = sorted_values[low.clamp(max=last)], sorted_values[high.clamp(max=last)]
    return one + (place - below) * (other - one)


def known_statistics(
    cells: SeenCells,
    species: tuple[str, ...],
    rings: int,
    reach: float,
    length_with_caps: bool,
    relative: bool,
    quantiles: bool,
    amounts: bool = False,
) -> ColonyStatistics:
    """The statistics of all that is known of some cells."""
    checks.integer("Observed(rings)", rings, least=1, most=50)
    checks.number("Observed(reach)", reach, above=0.0)
    checks.choice("Observed(length_with_caps)", length_with_caps, (True, False))
    checks.choice("Observed(relative)", relative, (True, False))
    checks.choice("Observed(quantiles)", quantiles, (True, False))
    of_species = {"relative": relative, "amounts": amounts, "quantiles": quantiles}
    for option in (name for name, given in of_species.items() if given and not species):
        raise checks.input_error(f"Observed({option})", True, "with species=(…), of which it is")
    edges: tuple[float, ...] = ()
    if cells.position is not None:
        outer = float(np.quantile(from_centre(cells.position, cells).cpu().numpy(), INNER))
        # a colony of one cell has no extent; its ring is a cell long
        edges = tuple(np.linspace(0.0, outer or reach, rings + 1).tolist())
    return ColonyStatistics(
        lengths=cells.length is not None,
        ages=cells.age is not None,
        positions=cells.position is not None,
        alignment=cells.position is not None and cells.axis is not None,
        species=species,
        edges=edges,
        reach=reach,
        length_with_caps=length_with_caps,
        relative=relative,
        quantiles=quantiles,
        amounts=amounts,
    )


def from_centre(position: Tensor, cells: SeenCells) -> Tensor:
    """The distance of each cell from the centre of its colony, (N, 1) µm."""
    apart = position - _means(position, cells).index_select(0, cells.colony)
    return apart.square().sum(1, keepdim=True).sqrt()


def _neighbours(position: Tensor, colony: Tensor, reach: float) -> Tensor:
    """Pairs of cells of one colony with centres closer than `reach`, (2, P), each pair once. A cell
    is no neighbour of a copy of itself (at the same place)."""
    # colonies are apart along an axis of their own
    places = torch.cat([position, 2.0 * reach * colony.double().unsqueeze(1)], 1).cpu().numpy()
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray")
    apart = np.square(places[pairs[:, 0]] - places[pairs[:, 1]]).sum(1)
    pairs = pairs[apart > 0]
    # in an order that does not depend on the batch
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return torch.from_numpy(np.ascontiguousarray(pairs.T).astype(np.int64)).to(position.device)


def _over_pairs(value: Tensor, cells: SeenCells, pairs: Tensor) -> Tensor:
    """The mean over the pairs of each colony, (B, 1); 0 without pairs."""
    colony = cells.colony.index_select(0, pairs[0])
    both = torch.stack([value, torch.ones_like(value)], 1)
    out = tf.Groups(colony, len(cells.counts), ordered=True).sum(both)
    return ratio(out[:, :1], out[:, 1:], 0.0)


def _scatter(level: Tensor, mean: Tensor, cells: SeenCells) -> tuple[Tensor, Tensor, Tensor]:
    """How far each cell is from the mean of its colony, (N,); the variance, (B, 1); and whether it
    is more than roundings make, (B, 1) bool."""
    apart = level - mean.squeeze(1).index_select(0, cells.colony)
    variance = _means(apart.square().unsqueeze(1), cells)
    return apart, variance, variance > STEADY * mean.square()


def _variation(level: Tensor, mean: Tensor, cells: SeenCells) -> Tensor:
    """The standard deviation between the cells of a colony (of all of them: divided by their
    number) over their mean, (B, 1); 0 where all cells are alike."""
    _, variance, varied = _scatter(level, mean, cells)
    square = torch.where(varied, variance / torch.where(varied, mean.square(), 1.0), 1.0)
    return torch.where(varied, square.sqrt(), 0.0)


def _correlation(level: Tensor, mean: Tensor, cells: SeenCells, pairs: Tensor) -> Tensor:
    """Moran's I (Biometrika 37, 17, 1950): the mean over pairs of neighbours of the product of
    their deviations from the mean, over the variance, (B, 1); 0 where all cells are alike."""
    apart, variance, varied = _scatter(level, mean, cells)
    together = apart.index_select(0, pairs[0]) * apart.index_select(0, pairs[1])
    return torch.where(
        varied, _over_pairs(together, cells, pairs) / torch.where(varied, variance, 1.0), 0.0
    )


def _alignment(axis: Tensor, cells: SeenCells, pairs: Tensor) -> Tensor:
    """The mean of cos 2φ over pairs of neighbours, φ the angle between them, (B, 1)."""
    cosine = (axis.index_select(0, pairs[0]) * axis.index_select(0, pairs[1])).sum(1)
    return _over_pairs(2.0 * cosine.square() - 1.0, cells, pairs)
