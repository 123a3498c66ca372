"""Sums and maxima over ragged groups, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import array
from hypothesis import given, settings
from hypothesis import strategies as st
from mock_cuda import pretended_cuda  # noqa: F401

from torchfilm.tools.ragged import Blocks, Groups, WeightedRows, expand_ranges, marked, offsets


def loop(owner: np.ndarray, size: int, value: np.ndarray, what, empty: float = 0.0) -> np.ndarray:
    out = np.full((size, *value.shape[1:]), empty)
    for k in range(size):
        if (owner == k).any():
            out[k] = what(value[owner == k], 0)
    return out


@settings(deadline=None, derandomize=True, max_examples=100)
@given(
    owner=st.lists(st.integers(0, 6), max_size=40),
    more=st.integers(0, 3),
    width=st.sampled_from([(), (1,), (3,), (2, 2)]),
    in_order=st.booleans(),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_sums_and_maxima_against_loops(owner, more, width, in_order, dtype):
    """With empty groups at the front, between others and at the end. float32: forty terms of
    1e-7.
    """
    owner = np.array(sorted(owner) if in_order else owner, dtype=np.int64)
    value = np.random.default_rng(len(owner)).normal(size=(len(owner), *width))
    groups = Groups(torch.as_tensor(owner), 7 + more)
    given_value = torch.as_tensor(value, dtype=dtype)
    close = {torch.float32: 1e-5, torch.float64: 1e-13}[dtype]
    found = groups.sum(given_value)
    assert found.shape == (7 + more, *width) and found.dtype == dtype
    assert np.abs(array(found) - loop(owner, 7 + more, value, np.sum)).max(initial=0) <= close
    assert array(groups.counts).tolist() == np.bincount(owner, minlength=7 + more).tolist()
    if width == ():
        rounded = array(given_value)
        assert (array(groups.max(given_value)) == loop(owner, 7 + more, rounded, np.max)).all()
        assert (
            array(groups.max(given_value, empty=-5.0))
            == loop(owner, 7 + more, rounded, np.max, -5.0)
        ).all()
        assert (
            groups.any(given_value > 1).numpy()
            == loop(owner, 7 + more, rounded > 1, np.max).astype(bool)
        ).all()


def test_no_rows_and_no_groups(device, dtype):
    none = torch.zeros(0, dtype=torch.int64, device=device)
    empty = torch.zeros(0, 3, dtype=dtype, device=device)
    assert torch.equal(Groups(none, 4).sum(empty), torch.zeros(4, 3, dtype=dtype, device=device))
    assert Groups(none, 0).sum(empty).shape == (0, 3)
    assert torch.equal(
        Groups(none, 2).max(empty[:, 0], empty=7.0),
        torch.full((2,), 7.0, dtype=dtype, device=device),
    )
    assert not Groups(none, 3).any(none > 0).any()


def test_maxima_of_negative_numbers_and_infinities(device, dtype):
    """Zero has no effect unless it is a value; NaN gives NaN."""
    groups = Groups(torch.tensor([0, 0, 1, 2, 2], device=device), 4)
    found = groups.max(
        torch.tensor([-3.0, -1.0, -torch.inf, 1.0, torch.nan], dtype=dtype, device=device)
    )
    assert found[:2].tolist() == [-1.0, -torch.inf]
    assert bool(found[2].isnan()) and float(found[3]) == 0.0


@settings(deadline=None, derandomize=True, max_examples=60)
@given(
    owner=st.lists(st.integers(0, 6), max_size=40),
    width=st.sampled_from([1, 4, 7]),
    in_order=st.booleans(),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_weighted_sums_against_loops(owner, width, in_order, dtype):
    """The same rows with one set of weights and then another."""
    owner = np.array(sorted(owner) if in_order else owner, dtype=np.int64)
    rng = np.random.default_rng(len(owner))
    value = rng.normal(size=(len(owner), width))
    rows = WeightedRows(torch.as_tensor(value, dtype=dtype), Groups(torch.as_tensor(owner), 8))
    for weight in rng.normal(size=(2, len(owner))):
        found = rows.sum(rows.sorted(torch.as_tensor(weight, dtype=dtype)))
        assert found.shape == (8, width) and found.dtype == dtype
        wanted = loop(owner, 8, weight[:, None] * value, np.sum)
        assert (
            np.abs(array(found) - wanted).max()
            <= {torch.float32: 1e-5, torch.float64: 1e-13}[dtype]
        )


@pytest.mark.parametrize("width", [1, 4, 7])
def test_a_group_has_the_same_weighted_sum_in_any_company(device, dtype, width, deterministic):
    """Bitwise: alone, and first, last or in the middle of many groups."""
    rng = np.random.default_rng(1)
    t = lambda x: torch.as_tensor(x, dtype=dtype, device=device)
    value, weight = rng.normal(size=(90, width)), rng.normal(size=90)
    alone = WeightedRows(t(value), Groups(torch.zeros(90, dtype=torch.int64, device=device), 1))
    wanted = alone.sum(alone.sorted(t(weight)))[0]
    for others in (3, 2000, 70_000):
        for own in (0, others // 2, others - 1):
            owner = np.concatenate([rng.integers(0, others, 2 * others), np.full(90, own)])
            owner[:-90][owner[:-90] == own] = (own + 1) % others
            # where the group's rows stand among the rest
            order = np.sort(rng.permutation(len(owner))[:90])
            place = np.concatenate([np.setdiff1d(np.arange(len(owner)), order), order])
            every = {
                k: np.empty((len(owner), *v.shape[1:]))
                for k, v in (("value", value), ("weight", weight))
            }
            every["value"][place] = np.concatenate([rng.normal(size=(2 * others, width)), value])
            every["weight"][place] = np.concatenate([rng.normal(size=2 * others), weight])
            owners = np.empty(len(owner), dtype=np.int64)
            owners[place] = owner
            among = WeightedRows(
                t(every["value"]), Groups(torch.as_tensor(owners, device=device), others)
            )
            assert torch.equal(among.sum(among.sorted(t(every["weight"])))[own], wanted), (
                others,
                own,
            )


@pytest.mark.parametrize("width", [(), (1,), (3,)])
def test_gradients_of_a_sum_and_of_its_reverse(width):
    owner = torch.tensor([2, 0, 2, 1, 2, 4])
    value = torch.randn(
        6,
        *width,
        dtype=torch.float64,
        generator=torch.Generator().manual_seed(1),
        requires_grad=True,
    )
    assert torch.autograd.gradcheck(lambda v: Groups(owner, 5).sum(v), (value,))
    assert torch.autograd.gradcheck(lambda v: Groups(owner, 6).spread(v), (value,))


@pytest.mark.parametrize("width", [1, 3, 7, 28])
@pytest.mark.parametrize("count", [1, 5, 63, 1000])
def test_a_group_has_the_same_sum_in_any_company(device, dtype, width, count, deterministic):
    """Bitwise: alone, behind others, in front of others, and with its rows scattered among theirs.

    The numbers have very different sizes, so the order of the sum has an effect.
    """
    rng = np.random.default_rng(count + width)

    def rows(n):
        sized = rng.normal(size=(n, width)) * 10.0 ** rng.uniform(-6, 6, (n, 1))
        return torch.as_tensor(sized, dtype=dtype, device=device)

    def summed(owner, values, size, group):
        return Groups(torch.as_tensor(np.array(owner), device=device), size).sum(values)[group]

    mine = rows(count)
    alone = summed(np.zeros(count, dtype=np.int64), mine, 1, 0)
    for others in (1, 40, 5000):
        strange = rows(others)
        before = summed(
            np.r_[np.zeros(others, np.int64), np.ones(count, np.int64)],
            torch.cat([strange, mine]),
            2,
            1,
        )
        after = summed(
            np.r_[np.zeros(count, np.int64), 3 * np.ones(others, np.int64)],
            torch.cat([mine, strange]),
            9,
            0,
        )
        assert torch.equal(before, alone) and torch.equal(after, alone)
        place = np.sort(rng.permutation(count + others)[:count])
        owner, mixed = (
            np.ones(count + others, np.int64),
            torch.empty(count + others, width, dtype=dtype, device=device),
        )
        owner[place] = 0
        (
            mixed[torch.as_tensor(owner == 0, device=device)],
            mixed[torch.as_tensor(owner == 1, device=device)],
        ) = (mine, strange)
        assert torch.equal(summed(owner, mixed, 2, 0), alone)


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("count", [1, 32, 33, 1025, 5000])
def test_sums_and_maxima_as_on_cuda(pretended_cuda, dtype, count, ordered):  # noqa: F811
    """Trees of sums, against loops; bitwise the same alone, before and after others, and among
    empty groups."""
    rng = np.random.default_rng(count)
    mine = rng.normal(size=(count, 4)) * 10.0 ** rng.uniform(-6, 6, (count, 1))
    results = []
    for before, after in ((0, 0), (7, 0), (0, 40_000), (3000, 5)):
        value = np.concatenate([rng.normal(size=(before, 4)), mine, rng.normal(size=(after, 4))])
        owner = np.repeat([1, 3, 4], [before, count, after])
        place = np.arange(len(owner))
        if not ordered:
            place = np.argsort(np.arange(len(owner)) + 0.5 * len(owner) * (owner != 3))
        there = lambda x, place=place: torch.as_tensor(x[place], device="cuda")
        groups = Groups(there(owner), 7, ordered)
        rows = there(value).to(dtype)
        sums, most = groups.sum(rows).cpu(), groups.max(rows[:, 0], empty=-9.0).cpu()
        close = {torch.float32: 1e-4, torch.float64: 1e-12}[dtype]
        size = np.abs(mine).sum(0)
        assert (np.abs(array(sums[3]) - mine.sum(0)) <= close * size).all()
        assert not array(sums)[[0, 2, 5, 6]].any()
        assert float(most[3]) == float(torch.as_tensor(mine[:, 0]).to(dtype).max())
        assert most[[0, 2, 5, 6]].tolist() == [-9.0] * 4
        assert groups.counts.tolist() == [0, before, 0, count, after, 0, 0]
        whole = groups.max((1e4 * rows[:, 0]).clamp(-1e9, 1e9).long(), empty=-3).cpu()
        assert whole.dtype == torch.int64 and int(whole[6]) == -3
        results.append(sums[3])
    assert all(torch.equal(results[0], other) for other in results[1:])


def test_marked_places():
    index, flag = torch.tensor([3, 1, 3, 0]), torch.tensor([False, True, True, False])
    assert marked(5, index, flag).tolist() == [False, True, False, True, False]
    assert marked(2, index[:0], flag[:0]).tolist() == [False, False]


@pytest.mark.parametrize("width", [1, 4, 7])
@pytest.mark.parametrize("count", [1, 5, 1000])
def test_blocks_against_products_and_in_any_company(device, dtype, width, count):
    """Each block times its row, bitwise the same after any other blocks; a NaN stays in its own
    row.
    """
    rng = np.random.default_rng(count + width)
    value = rng.normal(size=(count, width, width))
    value, r = value + value.swapaxes(1, 2), rng.normal(size=(count, width))
    t = lambda x: torch.as_tensor(x, dtype=dtype, device=device)
    found = Blocks(t(value)).times(t(r))
    close = {torch.float32: 1e-5, torch.float64: 1e-13}[dtype]
    assert np.abs(array(found) - np.einsum("nij,nj->ni", value, r)).max() <= close
    strange = np.full((37, width, width), np.nan)
    among = Blocks(t(np.concatenate([strange, value]))).times(
        t(np.concatenate([rng.normal(size=(37, width)), r]))
    )
    assert torch.equal(among[37:], found) and bool(among[:37].isnan().all())


def test_not_a_number_stays_in_its_group(device, dtype):
    value = torch.tensor([[1.0], [torch.nan], [2.0], [torch.inf]], dtype=dtype, device=device)
    found = Groups(torch.tensor([0, 1, 0, 2], device=device), 4).sum(value).squeeze(1)
    assert (
        float(found[0]) == 3.0
        and bool(found[1].isnan())
        and bool(found[2].isinf())
        and float(found[3]) == 0.0
    )


def test_offsets(device):
    counts = torch.tensor([2, 0, 3], device=device)
    assert offsets(counts).tolist() == [0, 2, 2, 5]
    assert offsets(counts[:0]).tolist() == [0]


@settings(deadline=None, derandomize=True, max_examples=50)
@given(ranges=st.lists(st.tuples(st.integers(0, 20), st.integers(0, 6)), max_size=10))
def test_expand_ranges(ranges):
    start, count = (torch.tensor([r[k] for r in ranges], dtype=torch.int64) for k in range(2))
    owner, value = expand_ranges(start, count)
    expected = [(k, v) for k, (s, c) in enumerate(ranges) for v in range(s, s + c)]
    assert list(zip(owner.tolist(), value.tolist(), strict=True)) == expected


def test_a_sum_of_many_rows_is_exact_to_its_last_figures(device):
    """A million numbers of float32, one after the other, would be 1e-5 off and more."""
    many = torch.rand(1_000_000, generator=torch.Generator().manual_seed(1))
    groups = Groups(torch.zeros(len(many), dtype=torch.int64, device=device), 1)
    found = float(groups.sum(many.to(device)))
    assert found == pytest.approx(float(many.double().sum()), rel=2e-7)
