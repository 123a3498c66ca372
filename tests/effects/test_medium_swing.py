"""How far exchange moves the medium at cells in one step: what reports say of it, and when a run
warns."""

from __future__ import annotations

import functools
import warnings

import pytest
import torch
from exchanging_cells import F64, advance

import torchfilm as tf

DT = 0.025


def giving(u, s, p, cell):
    out = p.D1 * (u.a - s.a) * cell.area
    return {"a": 10.0 - out / cell.volume}, {"a": out}


def still(u, s, p, cell):
    return {"a": 0.0 * u.a}


def crowd(count: int, per_step: float = 0.1, givers: int = 1, **options) -> tf.Scene:
    """Some cells that give a signal away, among others that do not, all in one voxel; in a step one
    alone would exchange `per_step` of the voxel."""
    kinds = [0] * givers + [1] * (count - givers)
    places = [[0.01 * k / count, 0.0] for k in range(count)]
    cells = tf.Cells(places, [[1.0, 0.0]] * count, 2.0, cell_type=kinds)
    area = float(tf.Scene(tf.Growth(rate=0.0), founders=cells, dim=2).bind().start().area[0])
    medium = tf.Medium(
        a=tf.Signal(0.0, decay=1.0), box=((-2, -2), (2, 2)), spacing=4.0, exchange="turns"
    )
    rates = {0: giving, 1: still} if givers < count else {0: giving}
    circuit = tf.Circuit(rates, species="a", D1=per_step * 64.0 / (DT * area), **options)
    return tf.Scene(circuit, medium, founders=cells, dim=2, dt=DT)


@pytest.mark.parametrize("backend", [None, "torch"])
@pytest.mark.parametrize("count, swing, off", [(1, 0.040, 0.004), (5, 0.187, 0.088)])
def test_the_swing_is_about_the_error(count, swing, off, backend):
    """The table in docs/exchange.md, whose third row takes longer."""
    scene = crowd(count, backend=backend)
    state = advance(scene, scene.bind(dtype=F64).start(), 40, DT)
    assert state.reports["circuit"].swing.item() == pytest.approx(swing, abs=0.001)
    assert state.a[0] / nearly_exact(count) - 1.0 == pytest.approx(off, abs=0.0015)


@functools.cache
def nearly_exact(count: int) -> torch.Tensor:
    """What the first cell of a crowd comes to in 5120 steps of the same hour."""
    scene = crowd(count)
    return advance(scene, scene.bind(dtype=F64).start(), 5120, 1.0 / 5120).a[0]


def test_the_swing_is_nothing_without_exchange():
    scene = tf.Scene(tf.Circuit(still, species="a"), dim=2)
    state = advance(scene, scene.bind(colonies=2).start(), 1, DT)
    assert state.reports["circuit"].swing.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    "count, givers, warned", [(120, 1, True), (120, 120, False), (50, 1, False)]
)
def test_a_large_swing_that_lasts_is_warned_of(count, givers, warned):
    """Alike cells have alike pools, and small colonies are left out."""
    scene = crowd(count, 0.1 if givers == 1 else 0.1 / count, givers)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in tf.simulate(scene, until=60 * DT, dtype=F64):
            pass
    said = [str(w.message) for w in caught if "exchange moves the medium" in str(w.message)]
    assert len(said) == warned
    assert not said or "With 15 times as many Medium(steps=…)" in said[0]
