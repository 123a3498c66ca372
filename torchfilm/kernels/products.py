"""Products with a small matrix, whose bits for a row do not depend on the other rows."""

from __future__ import annotations

from torchfilm.kernels.compiling import kernel


@kernel(entry=True)
def add_product(first, last, x, columns, out):
    """Rows first … last − 1 of out (N, M) + x (N, K) columns (K, M), in place: one term after the
    other, each rounded."""
    for n in range(first, last):
        for k in range(columns.shape[0]):
            factor = x[n, k]
            for m in range(columns.shape[1]):
                out[n, m] += factor * columns[k, m]
