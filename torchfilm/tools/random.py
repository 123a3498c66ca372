"""Counter-based random numbers for cells: Philox4x32-10 (Salmon et al. 2011).

A draw is a pure function of (seed, stream of the colony, cell uid, step, purpose). So it does not
depend on the batch, the order of colonies or a restart. The 32-bit arithmetic uses int64, where
products wrap without harm.
"""

from __future__ import annotations

import math
import zlib
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchfilm.tools.numba_calls import as_array, kernels_loaded

MASK = 0xFFFFFFFF
MULTIPLIER = (0xD2511F53, 0xCD9E8D57)
WEYL = (0x9E3779B9, 0xBB67AE85)


def philox(
    counter: tuple[Tensor, Tensor, Tensor, Tensor], key: tuple[Tensor | int, Tensor | int]
) -> tuple[Tensor, ...]:
    """Ten rounds of Philox4x32, elementwise: four words in [0, 2³²), as int64, to four words."""
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(10):
        p0, p1 = c0 * MULTIPLIER[0], c2 * MULTIPLIER[1]
        c0, c1, c2, c3 = (
            ((p1 >> 32) & MASK) ^ c1 ^ k0,
            p1 & MASK,
            ((p0 >> 32) & MASK) ^ c3 ^ k1,
            p0 & MASK,
        )
        k0, k1 = (k0 + WEYL[0]) & MASK, (k1 + WEYL[1]) & MASK
    return c0, c1, c2, c3


def purpose_code(purpose: str) -> int:
    """A stable 32-bit code of a purpose's name."""
    return zlib.crc32(purpose.encode())


def words(seed: int, stream: Tensor, uid: Tensor, step: int, purpose: str) -> Tensor:
    """Four independent 32-bit words for each cell: stream, uid (M,) int64 -> (4, M) int64."""
    if kernels_loaded(uid):
        from torchfilm.kernels.random import philox_words

        return torch.from_numpy(philox_words(*_arrays(seed, stream, uid, step, purpose)))
    key = _key(seed, purpose)
    of_cells = (uid & MASK, (uid >> 32) & MASK, stream & MASK)
    return torch.stack(philox((*of_cells, torch.full_like(uid, step & MASK)), key))


@lru_cache(maxsize=1000)
def _key(seed: int, purpose: str) -> tuple[int, int]:
    mixed = (seed ^ (purpose_code(purpose) << 32)) & (2**64 - 1)
    return mixed & MASK, (mixed >> 32) & MASK


def _arrays(seed: int, stream: Tensor, uid: Tensor, step: int, purpose: str) -> list:
    """The arguments of the kernels."""
    if stream.shape != uid.shape:
        stream = stream.expand(uid.shape)
    given = [as_array(x, torch.int64) for x in (uid, stream)]
    return [*given, *map(np.uint64, (step & MASK, *_key(seed, purpose)))]


def uniform(
    seed: int, stream: Tensor, uid: Tensor, step: int, purpose: str, dtype: torch.dtype
) -> Tensor:
    """One draw per cell from the open interval (0, 1)."""
    if kernels_loaded(uid):
        from torchfilm.kernels.random import uniforms

        return torch.from_numpy(uniforms(*_arrays(seed, stream, uid, step, purpose))).to(dtype)
    w = words(seed, stream, uid, step, purpose)
    # 23 bits and half a unit: the most bits for which a float32 does not round a draw to 1
    return ((w[0] >> 9).to(torch.float64) + 0.5).mul(2.0**-23).to(dtype)


def normal(
    seed: int, stream: Tensor, uid: Tensor, step: int, purpose: str, dtype: torch.dtype
) -> Tensor:
    """Four standard normal draws per cell, (M, 4), by the Box–Muller method from four words."""
    # two pairs of uniform numbers, the first of each less 1, which is exact
    if kernels_loaded(uid):
        from torchfilm.kernels.random import box_muller_pairs

        pairs = box_muller_pairs(*_arrays(seed, stream, uid, step, purpose))
        less_one, angle = (torch.from_numpy(x) for x in pairs)
    else:
        w = (words(seed, stream, uid, step, purpose).T.to(torch.float64) + 0.5) * 2.0**-32
        less_one, angle = w[:, ::2] - 1.0, 2 * math.pi * w[:, 1::2]
    # Not log, sqrt, cos and sin: on the CPU torch wakes all threads for these, for a few numbers,
    # too, and on a busy machine it waits milliseconds for them.
    square = -2.0 * torch.log1p(less_one)
    drawn = torch.polar(square * torch.rsqrt(square), angle)
    return torch.view_as_real(drawn).reshape(-1, 4).to(dtype)
