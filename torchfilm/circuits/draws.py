"""Random numbers for reactions: keyed uniforms, and Poisson numbers from one uniform each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache

import torch
from torch import Tensor

from torchfilm.tools.random import MASK, philox, purpose_code

# draw(rows, event, what, count): uniforms in (0, 1), (count, M) float64, for the cells `rows` (M,)
Draw = Callable[[Tensor, int, str, int], Tensor]
# The limit on steps of one from the first guess. One or two are usual where the mean is large, up
# to 60 or so where it is small.
MAX_CORRECTIONS = 400
# Below SMALL the search starts at 0; above LARGE the guess is the answer.
SMALL, LARGE = 4.0, 1e6


@dataclass(frozen=True, eq=False)
class KeyedDraws:
    """Draws that depend only on (seed, stream, uid, step, name, event, what, k).

    stream, uid: (N,) int64. step: of the simulation. `stream` belongs to the colony and does not
    depend on the batch. name: of the circuit, so that those of one scene differ. Each pair of
    uniforms takes one block of the generator, with 53 bits each.
    """

    seed: int
    stream: Tensor
    uid: Tensor
    step: int
    name: str = ""

    def of(self, rows: Tensor, name: str) -> KeyedDraws:
        """The draws of the cells `rows` (M,), for the circuit of this name."""
        stream, uid = self.stream.index_select(0, rows), self.uid.index_select(0, rows)
        return KeyedDraws(self.seed, stream, uid, self.step, name)

    def codes(self, what: str, pairs: int) -> tuple[int, ...]:
        """What stands for the purpose and the place of each pair of draws, words of 32 bits."""
        return _codes(f"{self.name} {what}" if self.name else what, pairs)

    def __call__(self, rows: Tensor, event: int, what: str, count: int) -> Tensor:
        own, cell = self.stream.index_select(0, rows), self.uid.index_select(0, rows)
        pairs = (count + 1) // 2
        codes = _codes_on(rows.device, self.codes(what, pairs))
        # The event number shares a word with the upper half of the uid. They stay apart for uids
        # below 2⁴⁸. Beyond 65,535 events the code takes the rest of the event number.
        codes = (codes ^ (((event + 1) >> 16) * 0x9E3779B9)) & MASK
        upper = ((cell >> 32) ^ ((event + 1) << 16)) & MASK
        counter = (cell & MASK, upper, own & MASK, torch.full_like(cell, self.step & MASK))
        lower, higher = self.seed & MASK, (self.seed >> 32) & MASK
        words = philox(counter, (torch.full_like(codes, lower), (higher ^ codes) & MASK))
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


@cache
def _codes(what: str, pairs: int) -> tuple[int, ...]:
    return tuple(purpose_code(f"{what} {k}") for k in range(pairs))


@lru_cache(maxsize=1000)
def _codes_on(device: torch.device, codes: tuple[int, ...]) -> Tensor:
    """The codes as a column there, copied to a GPU once."""
    return torch.tensor(codes, device=device).unsqueeze(1)


def poisson(mean: Tensor, uniform: Tensor) -> Tensor:
    """The least integer k with P(X ≤ k) ≥ uniform, for a Poisson variable X.

    mean ≥ 0 and uniform in (0, 1), float64, any shape. Up to a mean of LARGE the result is exact
    except for the rounding of the sum of probabilities. The first guess is the normal law with its
    corrections. The incomplete gamma function gives its probability (by torch with a relative error
    of 1e-9), and the search then goes up or down by single terms. Beyond LARGE the guess is off by
    at most one, once in 10⁴ times.
    """
    safe = mean.clamp(min=1e-300)
    z = torch.special.ndtri(uniform)
    root = safe.sqrt()
    # Cornish–Fisher expansion: the law's skewness and excess are 1/√λ and 1/λ; half a molecule
    # corrects for the discrete steps
    guess = safe + root * z + (z * z - 1) / 6 + (z - z * z * z) / (72 * root) + 0.5
    k = torch.where(safe > SMALL, guess.floor(), 0.0).clamp(min=0.0)
    searched = safe <= LARGE
    log_term = k * torch.log(safe) - safe - torch.lgamma(k + 1.0)
    term = torch.exp(log_term)
    total = torch.where(k > 0, torch.special.gammaincc(k + 1.0, safe), term)
    for _ in range(MAX_CORRECTIONS):
        # the search upwards ends where a term no longer changes the sum: the uniform is in the last
        # bits
        up = searched & (total < uniform) & (total + term > total)
        down = searched & (total >= uniform) & (total - term >= uniform) & (k > 0)
        if not bool((up | down).any()):
            break
        following = term * (safe / (k + 1.0))
        total = torch.where(up, total + following, torch.where(down, total - term, total))
        term = torch.where(up, following, torch.where(down, term * (k / safe), term))
        k = k + up.to(k.dtype) - down.to(k.dtype)
    return k
