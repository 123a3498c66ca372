"""Philox4x32-10 for many cells: the words of `tools.random.philox`, to the bit."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel


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
def philox_words(uid, stream, step, k0, k1):
    """uid, stream: (M,) int64; step and the key k0, k1: uint64 words in [0, 2³²). Returns (4, M)
    int64."""
    out, mask = np.empty((4, uid.shape[0]), np.int64), np.uint64(0xFFFFFFFF)
    for i in range(uid.shape[0]):
        own, of_colony = np.uint64(uid[i]), np.uint64(stream[i]) & mask
        a, b = own & mask, own >> np.uint64(32)
        out[0, i], out[1, i], out[2, i], out[3, i] = philox_block(a, b, of_colony, step, k0, k1)
    return out


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
