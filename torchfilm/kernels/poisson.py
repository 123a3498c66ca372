"""Poisson numbers from one uniform each: those of `circuits.draws.poisson`."""

from __future__ import annotations

import math

from torchfilm.kernels.compiling import kernel

# Up to FEW the probabilities are summed from 0. Above LARGE the guess of `circuits.draws` is the
# answer, which is off by at most one.
FEW, LARGE = 10.0, 1e6
# Below this e^{−λ} and the terms from 0 are still cheap to sum.
SUMMED = 100.0


@kernel
def _ratio(x, over, under):
    """Of two polynomials, by Horner's scheme; the lower one begins with 1."""
    a, b = over[0], 1.0
    for k in range(1, len(over)):
        a = a * x + over[k]
    for k in range(len(under)):
        b = b * x + under[k]
    return a / b


# The coefficients of Cephes (S. Moshier), as torch has them.
MIDDLE = (
    (-5.99633501014107895267e1, 9.80010754185999661536e1, -5.66762857469070293439e1,
     1.39312609387279679503e1, -1.23916583867381258016e0),
    (1.95448858338141759834e0, 4.67627912898881538453e0, 8.63602421390890590575e1,
     -2.25462687854119370527e2, 2.00260212380060660359e2, -8.20372256168333339912e1,
     1.59056225126211695515e1, -1.18331621121330003142e0),
)  # fmt: skip
TAIL = (
    (4.05544892305962419923e0, 3.15251094599893866154e1, 5.71628192246421288162e1,
     4.40805073893200834700e1, 1.46849561928858024014e1, 2.18663306850790267539e0,
     -1.40256079171354495875e-1, -3.50424626827848203418e-2, -8.57456785154685413611e-4),
    (1.57799883256466749731e1, 4.53907635128879210584e1, 4.13172038254672030440e1,
     1.50425385692907503408e1, 2.50464946208309415979e0, -1.42182922854787788574e-1,
     -3.80806407691578277194e-2, -9.33259480895457427372e-4),
)  # fmt: skip
FAR = (
    (3.23774891776946035970e0, 6.91522889068984211695e0, 3.93881025292474443415e0,
     1.33303460815807542389e0, 2.01485389549179081538e-1, 1.23716634817820021358e-2,
     3.01581553508235416007e-4, 2.65806974686737550832e-6, 6.23974539184983293730e-9),
    (6.02427039364742014255e0, 3.67983563856160859403e0, 1.37702099489081330271e0,
     2.16236993594496635890e-1, 1.34204006088543189037e-2, 3.28014464682127739104e-4,
     2.89247864745380683936e-6, 6.79019408009981274425e-9),
)  # fmt: skip


@kernel
def normal_quantile(u):
    """The z below which a standard normal number lies with probability u, in (0, 1)."""
    lower = u <= 1.0 - 0.13533528323661269189
    y = u if lower else 1.0 - u
    if y > 0.13533528323661269189:
        y -= 0.5
        y2 = y * y
        x = y + y * (y2 * _ratio(y2, *MIDDLE))
        return x * 2.50662827463100050242
    x = math.sqrt(-2.0 * math.log(y))
    x0 = x - math.log(x) / x
    z = 1.0 / x
    x1 = z * (_ratio(z, *TAIL) if x < 8.0 else _ratio(z, *FAR))
    return x1 - x0 if lower else x0 - x1


@kernel
def _from_zero(mean, uniform):
    """The probabilities summed from 0, until they no longer change the sum."""
    k, term = 0.0, math.exp(-mean)
    total = term
    while total < uniform and total + term > total:
        k += 1.0
        term *= mean / k
        total += term
    return k


@kernel
def _term(k, mean):
    """The probability of k ≥ 10 by Loader's saddle point: exact to rounding for any mean."""
    inverse = 1.0 / (k * k)
    stirling = (1 / 12 - inverse * (1 / 360 - inverse * (1 / 1260 - inverse / 1680))) / k
    off = mean - k
    deviance = off - k * math.log1p(off / k)
    return math.exp(-deviance - stirling) / math.sqrt(2 * math.pi * k)


@kernel
def _around(guess, mean, uniform):
    """The probabilities summed downwards from a guess, then single terms either way."""
    k = guess
    term = _term(k, mean)
    total, part, at = term, term, k
    while part > 1e-18 * total:
        part *= at / mean
        at -= 1.0
        total += part
    while total < uniform and total + term > total:
        k += 1.0
        term *= mean / k
        total += term
    while total - term >= uniform and k > 0:
        total -= term
        term *= k / mean
        k -= 1.0
    return k


@kernel
def poisson(mean, uniform):
    """The least integer k with P(X ≤ k) ≥ uniform, for a Poisson variable X; mean ≥ 0."""
    if mean <= FEW:
        return _from_zero(mean, uniform)
    z = normal_quantile(uniform)
    root = math.sqrt(mean)
    z2 = z * z
    if mean > LARGE:
        return math.floor(mean + root * z + (z2 - 1) / 6 + (z - z * z2) / (72 * root) + 0.5)
    # Temme's expansion of the x with Q(x, mean) = uniform, whose whole part is k (M. B. Giles, ACM
    # TOMS 42, 7, 2016). `doubt` is four times the largest error found for |z| ≤ 3.
    x = mean + root * z + (1 / 3 + z2 / 6) - z * (1 / 36 + z2 / 72) / root
    x += (z2 * (7 / 810 + z2 / 270) - 8 / 405) / mean
    doubt = (0.1 + 0.03 * z2 * z2) / (mean * root) + 1e-14 * mean
    k = math.floor(x)
    if abs(z) <= 3.0 and doubt < x - k < 1.0 - doubt:
        return k
    return _from_zero(mean, uniform) if mean < SUMMED else _around(k, mean, uniform)
