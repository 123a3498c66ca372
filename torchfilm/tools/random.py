"""Counter-based random numbers for cells: Philox4x32-10 (Salmon et al. 2011).

A draw is a pure function of (seed, stream of the colony, cell uid, step, purpose). So it does not
depend on the batch, the order of colonies or a restart. The 32-bit arithmetic uses int64, where
products wrap without harm.
"""

from __future__ import annotations

import zlib
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchfilm.kernels.series import COSINE, LOG, LOG_TWO, SINE, SMALL, TURN
from torchfilm.tools.numba_calls import as_array, kernels_loaded
from torchfilm.tools.vectors import nearest_root

MASK = 0xFFFFFFFF
BITS = 23  # of a uniform draw: with half a unit, the most for which a float32 does not round to 1
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


def counters(seed: int, step: int, purpose: str) -> tuple[int, int, int]:
    """The words of a step's draws that are alike for all cells, as kernels take them."""
    return step & MASK, *_key(seed, purpose)


def _arrays(seed: int, stream: Tensor, uid: Tensor, step: int, purpose: str) -> list:
    """The arguments of the kernels."""
    if stream.shape != uid.shape:
        stream = stream.expand(uid.shape)
    given = [as_array(x, torch.int64) for x in (uid, stream)]
    return [*given, *map(np.uint64, counters(seed, step, purpose))]


def uniform(
    seed: int, stream: Tensor, uid: Tensor, step: int, purpose: str, dtype: torch.dtype
) -> Tensor:
    """One draw per cell from the open interval (0, 1)."""
    if kernels_loaded(uid):
        from torchfilm.kernels.random import uniforms

        return torch.from_numpy(uniforms(*_arrays(seed, stream, uid, step, purpose))).to(dtype)
    w = words(seed, stream, uid, step, purpose)
    return ((w[0] >> 32 - BITS).to(torch.float64) + 0.5).mul(2.0**-BITS).to(dtype)


def fine_uniform(coarse: Tensor, fine: Tensor) -> Tensor:
    """A draw from (0, 1) of 46 bits, float64, from two of `uniform`: with 23 alone the rarest
    events would never happen."""
    return ((coarse.double() * 2.0**BITS).floor() + fine.double()) * 2.0**-BITS


def normal(
    seed: int, stream: Tensor, uid: Tensor, step: int, purpose: str, dtype: torch.dtype
) -> Tensor:
    """Four standard normal draws per cell, (M, 4), by the Box–Muller method from four words."""
    if kernels_loaded(uid):
        from torchfilm.kernels.random import normals

        return torch.from_numpy(normals(*_arrays(seed, stream, uid, step, purpose))).to(dtype)
    drawn = box_muller(words(seed, stream, uid, step, purpose).T)
    return drawn.reshape(-1, 4).to(dtype)


def box_muller(w: Tensor) -> Tensor:
    """Two standard normal numbers for each of two pairs of words: (…, 4) int64 -> (…, 2, 2).

    By the four operations and square roots alone, which are rounded alike everywhere: the bits are
    those of the kernels, on every processor.
    """
    u = (w.to(torch.float64) + 0.5) * 2.0**-32
    mantissa, exponent = torch.frexp(u[..., ::2])
    small = mantissa < SMALL
    mantissa = torch.where(small, mantissa + mantissa, mantissa)
    exponent = (exponent - small.int()).to(torch.float64)
    s = (mantissa - 1.0) / (mantissa + 1.0)
    log = exponent * LOG_TWO + (s + s) * _polynomial(LOG, s * s)
    root = nearest_root(-2.0 * log)
    turn = u[..., 1::2]
    quarter = torch.floor(4.0 * turn + 0.5)
    x = (turn - 0.25 * quarter) * TURN
    sine, cosine = x * _polynomial(SINE, x * x), _polynomial(COSINE, x * x)
    odd, back = (quarter == 1) | (quarter == 3), (quarter == 2) | (quarter == 3)
    along, across = torch.where(odd, sine, cosine), torch.where(odd, cosine, sine)
    along = torch.where(odd ^ back, -along, along)
    across = torch.where(back, -across, across)
    return torch.stack([root * along, root * across], -1)


def _polynomial(coefficients: tuple[float, ...], z: Tensor) -> Tensor:
    found = torch.full_like(z, coefficients[0])
    for c in coefficients[1:]:
        found = found * z + c
    return found
