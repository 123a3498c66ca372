"""Philox4x32-10 for many cells: the numbers of `tools.random`, to the bit."""

from __future__ import annotations

import math

import numpy as np

from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.series import COSINE, LOG, LOG_TWO, SINE, SMALL, TURN


@kernel(inline=True)
def philox_block(a, b, c, d, p, q):
    """Four words from a counter of four and a key of two: uint64 words in [0, 2³²), ten rounds."""
    mask, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    for _ in range(10):
        u, v = a * np.uint64(0xD2511F53), c * np.uint64(0xCD9E8D57)
        a, b, c, d = (v >> half) ^ b ^ p, v & mask, (u >> half) ^ d ^ q, u & mask
        p, q = (p + np.uint64(0x9E3779B9)) & mask, (q + np.uint64(0xBB67AE85)) & mask
    return a, b, c, d


@kernel
def words_of(uid, stream, step, k0, k1):
    """The four words of a cell."""
    mask, own = np.uint64(0xFFFFFFFF), np.uint64(uid)
    return philox_block(own & mask, own >> np.uint64(32), np.uint64(stream) & mask, step, k0, k1)


@kernel(entry=True)
def philox_words(uid, stream, step, k0, k1):
    """uid, stream: (M,) int64; step and the key k0, k1: uint64 words in [0, 2³²). Returns (4, M)
    int64."""
    out = np.empty((4, uid.shape[0]), np.int64)
    for i in range(uid.shape[0]):
        out[0, i], out[1, i], out[2, i], out[3, i] = words_of(uid[i], stream[i], step, k0, k1)
    return out


@kernel(entry=True)
def uniforms(uid, stream, step, k0, k1):
    """A number in (0, 1) for each cell, (M,), of the 23 upper bits of its first word."""
    out = np.empty(uid.shape[0])
    for i in range(uid.shape[0]):
        out[i] = uniform_of(words_of(uid[i], stream[i], step, k0, k1)[0])
    return out


@kernel(inline=True)
def uniform_of(word):
    return (np.float64(word >> np.uint64(9)) + 0.5) * 2.0**-23


@kernel(entry=True)
def normals(uid, stream, step, k0, k1):
    """Four standard normal numbers for each cell, (M, 4)."""
    out = np.empty((uid.shape[0], 4))
    for i in range(uid.shape[0]):
        own = words_of(uid[i], stream[i], step, k0, k1)
        out[i, 0], out[i, 1] = box_muller(own[0], own[1])
        out[i, 2], out[i, 3] = box_muller(own[2], own[3])
    return out


@kernel
def _polynomial(coefficients, z):
    found = coefficients[0]
    for k in range(1, len(coefficients)):
        found = found * z + coefficients[k]
    return found


@kernel
def box_muller(first, second):
    """As `tools.random.box_muller`, of one pair of words."""
    u, turn = (np.float64(first) + 0.5) * 2.0**-32, (np.float64(second) + 0.5) * 2.0**-32
    mantissa, exponent = math.frexp(u)
    if mantissa < SMALL:
        mantissa, exponent = mantissa + mantissa, exponent - 1
    s = (mantissa - 1.0) / (mantissa + 1.0)
    log = exponent * LOG_TWO + (s + s) * _polynomial(LOG, s * s)
    root = np.sqrt(-2.0 * log)
    quarter = math.floor(4.0 * turn + 0.5)
    x = (turn - 0.25 * quarter) * TURN
    sine, cosine = x * _polynomial(SINE, x * x), _polynomial(COSINE, x * x)
    odd, back = quarter == 1 or quarter == 3, quarter == 2 or quarter == 3
    along, across = (sine, cosine) if odd else (cosine, sine)
    return root * (-along if odd != back else along), root * (-across if back else across)


@kernel(inline=True)
def two_uniforms(own, event, code):
    """As `circuits.draws` draws a pair: in (0, 1) with 53 bits each, of the event of a cell.

    own: words of the cell, (uid, stream, step, lower and upper half of the seed), uint64. code:
    uint64, of what is drawn.
    """
    uid, stream, step, lower, upper = own
    mask, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    count = np.uint64(event + 1)
    mixed = (code ^ ((count >> np.uint64(16)) * np.uint64(0x9E3779B9))) & mask
    second = ((uid >> half) ^ (count << np.uint64(16))) & mask
    a, b, c, d = philox_block(
        uid & mask, second, stream & mask, step & mask, lower & mask, (upper ^ mixed) & mask
    )
    return _uniform(a, b), _uniform(c, d)


@kernel(inline=True)
def _uniform(a, b):
    bits = (a >> np.uint64(5)) << np.uint64(26) | (b >> np.uint64(6))
    return min((np.float64(bits) + 0.5) * 2.0**-53, 1 - 2.0**-53)
