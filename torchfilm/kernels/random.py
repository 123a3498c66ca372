"""Philox4x32-10 for many cells: the words of `tools.random.philox`, to the bit."""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import kernel


@kernel
def philox_words(c0, c1, c2, c3, k0, k1):
    """Ten rounds. c0, c1, c2: (M,) int64 words in [0, 2³²); c3, k0, k1: uint64. Returns (4, M)
    int64."""
    out = np.empty((4, c0.shape[0]), np.int64)
    mask, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    for i in range(c0.shape[0]):
        a, b, c, d = np.uint64(c0[i]), np.uint64(c1[i]), np.uint64(c2[i]), c3
        p, q = k0, k1
        for _ in range(10):
            u, v = a * np.uint64(0xD2511F53), c * np.uint64(0xCD9E8D57)
            a, b, c, d = (v >> half) ^ b ^ p, v & mask, (u >> half) ^ d ^ q, u & mask
            p, q = (p + np.uint64(0x9E3779B9)) & mask, (q + np.uint64(0xBB67AE85)) & mask
        out[0, i], out[1, i], out[2, i], out[3, i] = a, b, c, d
    return out
