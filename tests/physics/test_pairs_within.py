"""Pairs of cells whose surfaces are near each other: by the kernel and by torch."""

from __future__ import annotations

import pytest
import torch

from torchfilm.physics import nearby
from torchfilm.tools.ragged import Groups


def heap(dim, counts, seed, spread):
    """Cells at random, of any length and width, colony by colony."""
    draws = torch.Generator().manual_seed(seed)
    count = sum(counts)
    position = spread * torch.rand(count, dim, dtype=torch.float64, generator=draws)
    axis = torch.randn(count, dim, dtype=torch.float64, generator=draws)
    axis = axis / axis.norm(dim=1, keepdim=True)
    length = 4.0 * torch.rand(count, dtype=torch.float64, generator=draws) ** 3
    radius = 0.2 + 0.6 * torch.rand(count, dtype=torch.float64, generator=draws)
    owner = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    return (position, axis, length, radius), Groups(owner, len(counts), ordered=True)


def as_set(pairs):
    return {(min(i, j), max(i, j)) for i, j in zip(*(p.tolist() for p in pairs), strict=True)}


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("within", [0.0, 0.3, 5.0])
def test_the_kernel_finds_the_pairs_of_torch(dim, within, monkeypatch):
    """In colonies of many cells and of few, of one and of none, dense enough for more pairs than
    there is room for at first."""
    cells, groups = heap(dim, [300, 0, 1, 40, 2], 3, 26.0 if dim == 2 else 9.0)
    found = nearby.pairs_within(*cells, groups, within)
    monkeypatch.setattr(nearby, "unavailable", lambda: "not here")
    expected = nearby.pairs_within(*cells, groups, within)
    assert as_set(found) == as_set(expected)
    assert len(found[0]) == len(expected[0]) > 100  # each pair once
    assert (within < 5.0) == (len(found[0]) < nearby.PAIRS_EACH * len(cells[2]))


def test_pairs_do_not_depend_on_the_batch():
    cells, groups = heap(2, [200, 150], 1, 20.0)
    both = nearby.pairs_within(*cells, groups, 0.2)
    alone = nearby.pairs_within(
        *(x[200:] for x in cells), Groups(groups.owner[200:] - 1, 1, ordered=True), 0.2
    )
    mine = both[0] >= 200
    assert all(torch.equal(b[mine] - 200, a) for b, a in zip(both, alone, strict=True))


def test_a_colony_that_is_not_finite_has_no_pairs():
    cells, groups = heap(2, [60, 80], 2, 8.0)
    whole = as_set(nearby.pairs_within(*cells, groups, 0.2))
    cells[0][3, 1] = torch.nan
    rest = as_set(nearby.pairs_within(*cells, groups, 0.2))
    assert rest == {pair for pair in whole if pair[0] >= 60} and len(rest) > 50


def test_cells_that_just_touch_are_a_pair():
    position = torch.tensor([[0.0, 0.0], [0.0, 1.5]], dtype=torch.float64)
    axis = torch.tensor([[1.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    shape = position, axis, torch.ones(2), torch.full((2,), 0.5)
    groups = Groups(torch.zeros(2, dtype=torch.int64), 1, ordered=True)
    assert len(nearby.pairs_within(*shape, groups, 0.5)[0]) == 1
    assert len(nearby.pairs_within(*shape, groups, 0.4999)[0]) == 0
