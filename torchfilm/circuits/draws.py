"""Random numbers for reactions: keyed uniforms, and whole numbers of Poisson's law made from one
uniform each."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchfilm.tools.random import MASK, philox, purpose_code

# uniforms in (0, 1), (count, M) float64, for the cells `rows` (M,): draw(rows, event, what, count)
Draw = Callable[[Tensor, int, str, int], Tensor]
# steps of one from the first guess; one or two where the mean is large, up to 60 or so where it is
# small
MOST_CORRECTIONS = 400
# means below which one counts up from 0, and above which the guess is the answer
SMALL, LARGE = 4.0, 1e6


def keyed_draws(seed: int, stream: Tensor, uid: Tensor, step: int) -> Draw:
    """Draws that are a function of (seed, stream, uid, step, event, what, k) only: stream, uid (N,)
    int64, step of the simulation.

    `stream` is the colony's, which does not depend on the batch. Each pair of uniforms takes one
    block of the generator, 53 bits each.
    """

    def draw(rows: Tensor, event: int, what: str, count: int) -> Tensor:
        own, cell = stream.index_select(0, rows), uid.index_select(0, rows)
        pairs = (count + 1) // 2
        codes = torch.tensor(
            [purpose_code(f"{what} {k}") for k in range(pairs)], device=rows.device
        ).unsqueeze(1)
        # events share the word of the uid's upper half, apart for cells with uids below 2⁴⁸, and
        # beyond 65,535 of them the codes
        codes = (codes ^ (((event + 1) >> 16) * 0x9E3779B9)) & MASK
        upper = ((cell >> 32) ^ ((event + 1) << 16)) & MASK
        counter = (cell & MASK, upper, own & MASK, torch.full_like(cell, step & MASK))
        words = philox(
            counter, (torch.full_like(codes, seed & MASK), (((seed >> 32) & MASK) ^ codes) & MASK)
        )
        # 53 bits and half a unit: between 2⁻⁵⁴ and 1 − 2⁻⁵³, never 0 or 1
        both = [
            ((a >> 5) << 26 | (b >> 6))
            .to(torch.float64)
            .add(0.5)
            .mul(2.0**-53)
            .clamp(max=1 - 2.0**-53)
            for a, b in (words[:2], words[2:])
        ]
        return torch.stack(both, 1).reshape(2 * pairs, -1)[:count]

    return draw


def poisson(mean: Tensor, uniform: Tensor) -> Tensor:
    """The least whole k with P(X ≤ k) ≥ uniform for X of Poisson's law; mean ≥ 0 and uniform in (0,
    1), float64, any shape.

    Exact but for the rounding of the sum of probabilities up to a mean of LARGE: from a first guess
    by the normal law with its corrections, whose probability is found by the incomplete gamma
    function, one goes up or down by single terms. Beyond, the guess is off by at most one, once in
    10⁴ times.
    """
    safe = mean.clamp(min=1e-300)
    z = torch.special.ndtri(uniform)
    root = safe.sqrt()
    # Cornish and Fisher: the law's skewness and excess are 1/√λ and 1/λ; half a molecule for the
    # law's steps
    guess = safe + root * z + (z * z - 1) / 6 + (z - z * z * z) / (72 * root) + 0.5
    k = torch.where(safe > SMALL, guess.floor(), 0.0).clamp(min=0.0)
    searched = safe <= LARGE
    log_term = k * torch.log(safe) - safe - torch.lgamma(k + 1.0)
    term = torch.exp(log_term)
    total = torch.where(k > 0, torch.special.gammaincc(k + 1.0, safe), term)
    for _ in range(MOST_CORRECTIONS):
        # a term that no longer changes the sum ends the way up: the uniform is in the last bits
        up = searched & (total < uniform) & (total + term > total)
        down = searched & (total >= uniform) & (total - term >= uniform) & (k > 0)
        if not bool((up | down).any()):
            break
        following = term * (safe / (k + 1.0))
        total = torch.where(up, total + following, torch.where(down, total - term, total))
        term = torch.where(up, following, torch.where(down, term * (k / safe), term))
        k = k + up.to(k.dtype) - down.to(k.dtype)
    return k
