"""Random draws of cells: the generator, its distributions, and its dependence on the key alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import array
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from torchfilm.tools import random

# Known answers of the generator's authors (Random123, kat_vectors, philox4x32 10): counter, key,
# output.
KNOWN = [
    (
        "00000000 00000000 00000000 00000000",
        "00000000 00000000",
        "6627e8d5 e169c58d bc57ac4c 9b00dbd8",
    ),
    (
        "ffffffff ffffffff ffffffff ffffffff",
        "ffffffff ffffffff",
        "408f276d 41c83b0e a20bc7c6 6d5451fd",
    ),
    (
        "243f6a88 85a308d3 13198a2e 03707344",
        "a4093822 299f31d0",
        "d16cfe09 94fdcceb 5001e420 24126ea1",
    ),
]


def numbers(text: str) -> list[int]:
    return [int(word, 16) for word in text.split()]


@pytest.mark.parametrize("counter, key, expected", KNOWN, ids=["zeros", "ones", "pi"])
def test_philox_known_answers(device, counter, key, expected):
    words = tuple(torch.tensor([c, c], device=device) for c in numbers(counter))
    found = random.philox(words, tuple(numbers(key)))
    assert [[int(x) for x in w] for w in found] == [[e, e] for e in numbers(expected)]
    # a key may also be given for each element
    keys = tuple(torch.tensor([k, k], device=device) for k in numbers(key))
    assert all(torch.equal(a, b) for a, b in zip(random.philox(words, keys), found, strict=True))


def philox_by_hand(counter: list[int], key: list[int]) -> list[int]:
    """The same ten rounds in Python's integers, which never overflow."""
    c, k = list(counter), list(key)
    for _ in range(10):
        p, q = c[0] * 0xD2511F53, c[2] * 0xCD9E8D57
        c = [(q >> 32) ^ c[1] ^ k[0], q & 0xFFFFFFFF, (p >> 32) ^ c[3] ^ k[1], p & 0xFFFFFFFF]
        k = [(k[0] + 0x9E3779B9) & 0xFFFFFFFF, (k[1] + 0xBB67AE85) & 0xFFFFFFFF]
    return c


WORD = st.integers(0, 2**32 - 1)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(counter=st.lists(WORD, min_size=4, max_size=4), key=st.lists(WORD, min_size=2, max_size=2))
def test_products_that_overflow_do_no_harm(counter, key):
    """int64 products of two 32-bit words wrap; the 64 bits in use must equal those of the true
    product.
    """
    found = random.philox(tuple(torch.tensor([c]) for c in counter), tuple(key))
    assert [int(w) for w in found] == philox_by_hand(counter, key)


def keys(count: int, device="cpu") -> tuple[torch.Tensor, torch.Tensor]:
    """Keys of typical cells: colonies of a thousand, with consecutive numbers."""
    n = torch.arange(count, device=device)
    return n // 1000, n % 1000


def test_uniform_is_uniform(device, dtype):
    """200,000 draws of successive cells: Kolmogorov–Smirnov and χ² over 1,000 bins.

    The draws never change, so the p-values do not either: below 1e-3 would be a defect, not chance.
    """
    colony, uid = keys(200_000, device)
    u = random.uniform(1, colony, uid, 3, "test", dtype)
    assert u.dtype == dtype
    assert float(u.min()) > 0 and float(u.max()) < 1
    u = array(u)
    assert stats.kstest(u, "uniform").pvalue > 1e-3
    assert stats.chisquare(np.histogram(u, 1000, (0, 1))[0]).pvalue > 1e-3
    # neighbours in uid, colony and step are independent: correlations within 4 of their standard
    # deviation 1/√n
    later = array(random.uniform(1, colony, uid, 4, "test", dtype))
    other = array(random.uniform(1, colony, uid, 3, "tests", dtype))
    reseeded = array(random.uniform(2, colony, uid, 3, "test", dtype))
    for a, b in ((u[1:], u[:-1]), (u[1000:], u[:-1000]), (u, later), (u, other), (u, reseeded)):
        assert abs(np.corrcoef(a, b)[0, 1]) < 4 / math.sqrt(len(a))


@pytest.mark.parametrize("word", [0, 2**32 - 1])
def test_no_draw_is_zero_or_one(dtype, word, monkeypatch):
    """The docstring promises the open interval (0, 1), also for the least and the greatest word, in
    both precisions.
    """
    monkeypatch.setattr(random, "words", lambda *key: torch.full((4, 1), word))
    none = torch.tensor([0])
    assert 0 < float(random.uniform(0, none, none, 0, "test", dtype)) < 1
    assert bool(torch.isfinite(random.normal(0, none, none, 0, "test", dtype)).all())


def test_normal_is_normal(device, dtype):
    """Four draws per cell, each standard normal by Kolmogorov–Smirnov; the four and their sizes are
    uncorrelated.
    """
    colony, uid = keys(50_000, device)
    z = random.normal(5, colony, uid, 0, "test", dtype)
    assert z.shape == (50_000, 4) and z.dtype == dtype
    assert bool(torch.isfinite(z).all())
    z = array(z)
    for k in range(4):
        assert stats.kstest(z[:, k], "norm").pvalue > 1e-3
    for values in (z, np.abs(z)):
        off = np.corrcoef(values.T)[np.triu_indices(4, 1)]
        assert np.abs(off).max() < 4.5 / math.sqrt(len(z))


@settings(deadline=None, derandomize=True, max_examples=50)
@given(
    seed=st.integers(0, 2**63 - 1),
    order=st.permutations(range(8)),
    step=st.integers(0, 2**31),
    shift=st.integers(0, 2**40),
)
def test_draws_do_not_depend_on_company(seed, order, step, shift):
    """A cell's draw is bitwise the same in any order, alone or in a batch."""
    colony, uid = torch.tensor([0, 0, 1, 1, 2, 5, 5, 7]), torch.arange(8) * 3 + shift
    place = torch.tensor(order)
    for draw in (random.uniform, random.normal):
        whole = draw(seed, colony, uid, step, "test", torch.float32)
        assert torch.equal(
            draw(seed, colony[place], uid[place], step, "test", torch.float32), whole[place]
        )
        assert torch.equal(
            draw(seed, colony[3:4], uid[3:4], step, "test", torch.float32), whole[3:4]
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kernels_draw_the_same_bits(dtype, monkeypatch):
    """Whether numba has been loaded must not matter, nor how many cells there are."""
    pytest.importorskip("numba")
    for count in (0, 1, 2, 7, 8, 33, 1000):
        uid = torch.arange(count) * 7919 + 2**33
        stream = torch.arange(count) % 5
        given = (2**40 + 3, stream, uid, 12, "test")
        found = [random.words(*given), *(d(*given, dtype) for d in (random.uniform, random.normal))]
        with monkeypatch.context() as patch:
            patch.setattr(random, "kernels_loaded", lambda uid: False)
            by_torch = [
                random.words(*given),
                *(d(*given, dtype) for d in (random.uniform, random.normal)),
            ]
        assert all(torch.equal(a, b) for a, b in zip(found, by_torch, strict=True))
        assert found[2].shape == (count, 4)


def test_every_part_of_the_key_counts():
    """A change of seed, colony, uid, step or purpose changes the words, also beyond 32 bits."""
    base = {"seed": 1, "colony": 2, "uid": 3, "step": 4, "purpose": "a"}
    others = [
        {},
        {"seed": 2},
        {"seed": 1 + 2**40},
        {"colony": 3},
        {"uid": 4},
        {"uid": 3 + 2**33},
        {"step": 5},
        {"purpose": "b"},
    ]
    seen = set()
    for change in others:
        key = {**base, **change}
        words = random.words(
            key["seed"],
            torch.tensor([key["colony"]]),
            torch.tensor([key["uid"]]),
            key["step"],
            key["purpose"],
        )
        seen.add(tuple(int(w) for w in words))
    assert len(seen) == len(others)


def test_purposes_have_stable_codes():
    """A saved run continues with the same draws in another session.

    So codes are a checksum of the name, not Python's hash.
    """
    assert random.purpose_code("abc") == 0x352441C2
