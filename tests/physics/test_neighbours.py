"""The broad phase: no pair that could touch is missing or repeated, in any batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import segment_distance, unit
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfilm.physics.neighbours import Neighbourhood

# Any sizes and densities: all cells at one position, or none near another.
SCATTERS = {
    "seed": st.integers(0, 2**32 - 1),
    "counts": st.lists(st.integers(0, 25), min_size=1, max_size=4),
    "dim": st.sampled_from([2, 3]),
    "side": st.sampled_from([0.0, 0.5, 3.0, 20.0]),
    "lengths": st.lists(st.sampled_from([0.0, 0.1, 2.0, 9.0, 60.0]), min_size=1, max_size=3),
    "dtype": st.sampled_from([torch.float32, torch.float64]),
}
DIMS = pytest.mark.parametrize("dim", [2, 3])


class Scatter:
    """Cells at random in several colonies, as arrays.

    position, axis (N, d), length, radius, colony (N,).
    """

    def __init__(
        self,
        rng: np.random.Generator,
        counts: list[int],
        dim: int,
        side: float,
        lengths: list[float],
    ):
        count = sum(counts)
        self.colony, self.colonies = np.repeat(np.arange(len(counts)), counts), len(counts)
        self.position = rng.uniform(-side, side, (count, dim))
        self.axis = unit(rng, count, dim) if count else np.zeros((0, dim))
        self.length = rng.choice(lengths, count) * rng.uniform(0.7, 1.3, count)
        self.radius = rng.uniform(0.3, 0.6, count)

    def pairs(self, dtype, margin: float = 0.0, device="cpu") -> tuple[np.ndarray, np.ndarray]:
        i, j = self.asked(dtype, margin, device).pairs()
        return i.cpu().numpy(), j.cpu().numpy()

    def asked(self, dtype, margin: float = 0.0, device="cpu") -> Neighbourhood:
        t = lambda x: torch.as_tensor(x, dtype=dtype, device=device)
        colony = torch.as_tensor(self.colony, device=device)
        return Neighbourhood(
            t(self.position),
            t(self.axis),
            t(self.length),
            t(self.radius),
            colony,
            self.colonies,
            margin,
        )

    def near(self, margin: float) -> set[tuple[int, int]]:
        """Brute force: every pair of one colony whose surfaces are within `margin`."""
        i, j = np.triu_indices(len(self.colony), 1)
        same = self.colony[i] == self.colony[j]
        i, j = i[same], j[same]
        if not len(i):
            return set()
        half = 0.5 * self.length
        gap = (
            segment_distance(
                self.position[i], self.axis[i], half[i], self.position[j], self.axis[j], half[j]
            )
            - self.radius[i]
            - self.radius[j]
        )
        return set(zip(i[gap < margin].tolist(), j[gap < margin].tolist(), strict=True))


def check(cells: Scatter, dtype, margin: float, device="cpu") -> int:
    """All laws of the pair list; returns the number of pairs that are near."""
    i, j = cells.pairs(dtype, margin, device)
    found = list(zip(np.minimum(i, j).tolist(), np.maximum(i, j).tolist(), strict=True))
    assert (i != j).all()
    assert len(set(found)) == len(found), "a pair stands twice"
    assert (cells.colony[i] == cells.colony[j]).all()
    # a gap of 1e-5 below the margin is certain even in float32 at 20 µm
    near = cells.near(margin - 1e-5)
    assert near <= set(found), f"missing {sorted(near - set(found))[:5]}"
    return len(near)


@DIMS
@pytest.mark.parametrize("margin", [0.0, 0.1, 1.0])
def test_pairs_against_brute_force(device, dtype, dim, margin):
    """Spheres, rods and filaments of 40 µm in six colonies: two are empty and one has a single
    cell.
    """
    cells = Scatter(
        np.random.default_rng(1),
        [60, 0, 1, 150, 0, 90],
        dim,
        12.0 if dim == 2 else 6.0,
        [0.0, 2.0, 2.0, 2.0, 40.0],
    )
    assert check(cells, dtype, margin, device) > 100


@settings(deadline=None, derandomize=True, max_examples=60)
@given(**SCATTERS, margin=st.sampled_from([0.0, 0.2]))
def test_pairs_of_any_scatter(seed, counts, dim, side, lengths, dtype, margin):
    """The same for any sizes and densities: all cells at one position, or none near another."""
    check(Scatter(np.random.default_rng(seed), counts, dim, side, lengths), dtype, margin)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(**SCATTERS, share=st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_pairs_of_some_cells_are_those_of_all_that_hold_one(
    seed, counts, dim, side, lengths, share, dtype
):
    """Each pair once, with the selected cell first, for cells of any class; none without selected
    cells.
    """
    rng = np.random.default_rng(seed)
    cells = Scatter(rng, counts, dim, side, lengths)
    asked = np.flatnonzero(rng.random(len(cells.colony)) < share)
    near = cells.asked(dtype, 0.1)
    i, j = (x.numpy() for x in near.pairs_of(torch.as_tensor(asked)))
    every = {(min(p), max(p)) for p in zip(*(x.tolist() for x in near.pairs()), strict=True)}
    found = [(min(p), max(p)) for p in zip(i.tolist(), j.tolist(), strict=True)]
    assert len(set(found)) == len(found) and np.isin(i, asked).all()
    assert set(found) == {p for p in every if np.isin(p, asked).any()}


@DIMS
def test_list_is_not_much_longer_than_it_must_be(device, dtype, dim):
    """The bounding spheres and boxes keep a small multiple of the near pairs, for rods as dense as
    in a colony.
    """
    rng = np.random.default_rng(2)
    cells = Scatter(rng, [400], dim, 14.0 if dim == 2 else 6.6, [2.5])
    i, _ = cells.pairs(dtype, 0.0, device)
    assert len(i) <= 6 * len(cells.near(0.0))


@DIMS
def test_one_filament_costs_the_rods_nothing(dtype, dim):
    """A cell of 200 µm among rods adds at most one pair per rod, and no pairs between rods."""
    rng = np.random.default_rng(3)
    cells = Scatter(rng, [800], dim, 40.0, [2.0])
    without, _ = cells.pairs(dtype)
    cells.length[0] = 200.0
    i, j = cells.pairs(dtype)
    assert ((i != 0) & (j != 0)).sum() <= len(without)


@DIMS
def test_a_colony_has_the_same_list_in_any_batch(device, dtype, dim):
    """The same pairs in the same order, alone and between colonies of other position and size."""
    rng = np.random.default_rng(4)
    batch = Scatter(rng, [30, 70, 0, 20], dim, 6.0, [0.0, 2.0, 12.0])
    batch.position[batch.colony == 0] += 500.0
    i, j = batch.pairs(dtype, 0.05, device)
    alone = Scatter(rng, [70], dim, 1.0, [1.0])
    for name in ("position", "axis", "length", "radius"):
        setattr(alone, name, getattr(batch, name)[batch.colony == 1])
    k, m = alone.pairs(dtype, 0.05, device)
    own = batch.colony[i] == 1
    assert (i[own] - 30 == k).all() and (j[own] - 30 == m).all()
    assert len(k) > 50


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_cells_to_have_a_pair(device, dtype, count):
    i, j = Scatter(np.random.default_rng(5), [count, 0], 3, 1.0, [2.0]).pairs(dtype, 0.0, device)
    assert len(i) == len(j) == 0


def test_cells_that_just_touch_are_a_pair(device, dtype):
    """Spheres whose surfaces touch exactly, and slightly within the margin."""
    cells = Scatter(np.random.default_rng(6), [2], 3, 1.0, [0.0])
    cells.radius[:] = 0.5
    cells.position[:] = [[0, 0, 0], [1, 0, 0]]
    assert len(cells.pairs(dtype, 0.0, device)[0]) == 1
    cells.position[1, 0] = 1.0999
    assert len(cells.pairs(dtype, 0.1, device)[0]) == 1
    cells.position[1, 0] = 1.2
    assert len(cells.pairs(dtype, 0.1, device)[0]) == 0
