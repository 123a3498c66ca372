"""A few cells side by side: each lane has the bits that its cell would have alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from traced import one_step, plain_module, row_of

import torchfilm as tf
from torchfilm.circuits import compiled
from torchfilm.circuits.compiled_stiff import CompiledStiff
from torchfilm.circuits.rosenbrock import BELOW_ZERO, DONE, NOT_FINITE, TOO_MANY_STEPS
from torchfilm.kernels.compiling import kernel
from torchfilm.kernels.functions import _finite, _least, _most, _sign, inverse_cube_root
from torchfilm.kernels.vectors import (
    WIDTH,
    any_of,
    like,
    load,
    narrow,
    negated,
    store,
    where,
    wide,
)  # fmt: skip

ODD = [0.0, -0.0, 1.5, -2.5, np.inf, -np.inf, np.nan, 3.0]


@kernel
def _all(x, y):
    """One of each operation, of numbers or of vectors."""
    a, b = narrow(x), narrow(y)
    both, one = (x < y) & (y >= 0.0), (x == y) | negated(x != 1.5)
    return (
        x + y, x - 2.0, 3.0 * x, x / y, -x, abs(y), wide(a * b), wide(a / 3.0), wide(a + y),
        wide(x <= y), wide(x > y), where(both, x, y), where(one, x, 1.0), where(x > 0.0, 1.0, 0.0),
        like(2.5, x), _finite(y), _least(x, y), _most(x, y), _sign(x), np.sqrt(x), np.floor(x),
        np.exp(x), np.expm1(x), np.log(x), np.log1p(x), np.log2(x), np.log10(x), np.sin(x),
        np.cos(x), np.tan(x), np.tanh(x), np.arctan(x), np.remainder(x, y), np.remainder(x, 0.7),
        wide(np.exp(a)), wide(np.sqrt(a)), wide(both & True), wide(np.float64(1.0) < x),
    )  # fmt: skip


@kernel(entry=True)
def lanes(x, y, out):
    k = 0
    for value in _all(load(x, 0), load(y, 0)):
        store(out, k, value)
        k += 1  # noqa: SIM113 (tuples of several types know no enumerate)
    return any_of(load(x, 0) > 1e300)


@kernel(entry=True)
def one_by_one(x, y, out):
    for n in range(x.shape[1]):
        k = 0
        for value in _all(x[0, n], y[0, n]):
            out[k, n] = value
            k += 1  # noqa: SIM113


@pytest.mark.parametrize("turn", range(WIDTH))
def test_each_lane_has_the_bits_of_a_number(turn):
    x, y = np.array([ODD]), np.array([np.roll(ODD, turn)])
    found, alone = np.full((2, 38, WIDTH), -7.0)
    assert lanes(x, y, found)
    one_by_one(x, y, alone)
    for k, (row, wanted) in enumerate(zip(found, alone, strict=True)):
        assert row.tobytes() == wanted.tobytes() or np.array_equal(row, wanted, equal_nan=True), k
        signed = ~np.isnan(row)
        assert np.array_equal(np.signbit(row[signed]), np.signbit(wanted[signed])), k


@kernel(entry=True)
def roots(x, out):
    for k in range(x.shape[0]):
        store(out, k, inverse_cube_root(load(x, k)))


def test_inverse_cube_roots():
    x = np.geomspace(1e-300, 1e300, 40 * WIDTH).reshape(-1, WIDTH)
    out = np.empty_like(x)
    roots(x, out)
    assert out == pytest.approx(np.cbrt(1 / x), rel=2e-15)


def fates(u, s, p, cell):
    """Decay of a at a rate; or no number, an infinite one after some time, below zero, too many
    steps. b follows a, and takes from c where that is nearly empty."""
    out = torch.where(p.fate == 1, torch.nan, -p.rate * u.a)
    out = torch.where(p.fate == 2, u.a * u.a, out)
    out = torch.where(p.fate == 3, -1.0 + 0.0 * u.a, out)
    out = torch.where(p.fate == 4, -1e4 * u.a, out)
    taken = 50.0 * u.b / (0.01 + u.b) * (u.c > 1e-3)
    return {"a": out, "b": u.a - u.b, "c": 0.1 - taken * u.c}


def circuit() -> CompiledStiff:
    start = {"a": 1.0, "b": 0.5, "c": 0.01}
    found = tf.Circuit(
        fates, species=tuple(start), initial=start, fate=[0.0, 5.0], rate=[1.0, 2.0], dilution=False
    )
    cells, *_ = one_step(tf.Scene(found, founders=row_of(1), dt=0.1), colonies=2)
    return cells.compiled


def after(
    made: CompiledStiff, fate: np.ndarray, shares: list[tuple[int, int]], most_steps: int
) -> list:
    """What becomes of cells of these fates, in two hours, computed in these shares."""
    count = len(fate)
    at = np.tile([1.0, 0.5, 0.01], (count, 1))
    of = {"p.fate": fate, "p.rate": np.geomspace(0.1, 30.0, 200)[:count]}
    columns = np.array([of[n] for n in made.columns])
    numbers = np.array([made.literals[n] for n in made.numbers] or [0.0])
    report = np.zeros((3, count), np.int64)
    rest = (2.0, 1e-3, 1e-9, np.finfo(float).eps, np.finfo(float).max, most_steps)
    for first, last in shares:
        made.module.run(first, last, at, columns, numbers, *rest, *report)
    return [at, *report]


@pytest.mark.parametrize("most_steps", [2000, 80])
def test_cells_side_by_side_do_not_touch(most_steps, monkeypatch):
    """However many there are, in whatever shares, and whichever fail beside them. Compiled for
    real; and the same as the text run as Python, cell by cell."""
    made, count = circuit(), 5 * WIDTH + 3
    fate = np.random.default_rng(3).choice([0.0] * 4 + [1.0, 2.0, 3.0, 4.0], count)
    together = after(made, fate, [(0, count)], most_steps)
    alone = after(made, fate, [(n, n + 1) for n in range(count)], most_steps)
    parts = after(made, fate, [(17, count), (3, 17), (0, 3)], most_steps)
    for x, y, z in zip(together, alone, parts, strict=True):
        assert np.array_equal(x, y) and np.array_equal(x, z)
    at, accepted, rejected, status = together
    assert (status[fate == 0] == DONE).all() and (status[fate == 1] == NOT_FINITE).all()
    assert (status[fate == 2] == TOO_MANY_STEPS).all()  # a' = a² is infinite at 1 h
    assert (status[fate == 3] == (BELOW_ZERO if most_steps > 80 else TOO_MANY_STEPS)).all()
    assert (status[fate == 4] == (DONE if most_steps > 80 else TOO_MANY_STEPS)).all()
    assert (accepted + rejected)[fate == 2].max() <= most_steps
    assert len({tuple(x) for x in at[fate == 0]}) == (fate == 0).sum()  # no two alike
    monkeypatch.setattr(compiled, "_module", plain_module)
    by_python = after(dataclasses.replace(made), fate, [(0, count)], most_steps)
    assert np.allclose(at, by_python[0], rtol=1e-13, atol=0)
    for x, y in zip(together[1:], by_python[1:], strict=True):
        assert np.array_equal(x, y)
