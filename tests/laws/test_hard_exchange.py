"""Hard case 48: cells that live on what diffusion brings, while their demand is far higher."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import torchfilm as tf

SIDES = tf.BoundaryConditions(x=tf.Dirichlet(1.0), y=tf.Dirichlet(1.0))
DEMAND, DIFFUSION = 2e5, 1e6  # conc/h in a cell, and µm²/h, as of oxygen


def eating(u, s, p, cell):
    return {"dm": 0.0 * u.dm}, {"o2": -p.q * cell.volume * s.o2 / (p.K + s.o2)}


def brought(eaters: tuple, dtype: torch.dtype) -> tuple[float, torch.Tensor]:
    """What comes through the sides per hour after two steps, and the signal."""
    medium = tf.Medium(
        o2=tf.Signal(DIFFUSION, initial=1.0, boundary=SIDES), box=((-60, -60), (60, 60)),
        spacing=4.0, depth=1.0,
    )  # fmt: skip
    scene = tf.Scene(*eaters, medium, founders=tf.inoculum(60, radius=20.0), dim=2)
    *_, state = tf.simulate(scene, until=0.05, dt=0.025, dtype=dtype)
    u = state.signals["o2"].double().reshape(30, 30)
    missing = sum(float((1 - side).sum()) for side in (u[0], u[-1], u[:, 0], u[:, -1]))
    return 2 * DIFFUSION * missing, u


def by_circuit(K: float) -> tuple:
    return tf.Growth(rate=1e-3), tf.Circuit(eating, species="dm", q=DEMAND, K=K)


def by_monod(K: float) -> tuple:
    return tf.Growth(), tf.Monod("o2", rate=1e-3, half=K, growth_yield=1e-3 / DEMAND)


@pytest.mark.parametrize("K", [1e-2, 1e-3, 1e-4])
def test_case_48_living_on_what_arrives(dtype, measured, K):
    """Sixty cells that would eat ten thousand times what is about them in a step, half-saturated at
    1e-2, 1e-3 and 1e-4 of what the sides hold, by a circuit and by Monod: u ≥ 0, both eat alike."""
    (one, u), (other, v) = brought(by_circuit(K), dtype), brought(by_monod(K), dtype)
    lowest = min(float(u.min()), float(v.min()))
    assert measured("lowest concentration", lowest, "≥ 0") >= 0.0
    assert other > 1e6  # diffusion limits what they get: they ask for six times as much
    difference = abs(one / other - 1)
    assert measured("eaten by the circuit over Monod's, off 1", difference, "≤ 0.02") <= 0.02
    assert np.isfinite(u.numpy()).all()


def test_cells_that_eat_to_the_last_molecule_are_solved_or_warned_of(dtype):
    """At a millionth of what the sides hold, the uptake of a circuit is all but a step: by seed and
    processor it is solved with transport or not. Then the run says so, and nothing is below 0."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        one, u = brought(by_circuit(1e-6), dtype)
    unsolved = any("could not be solved together" in str(w.message) for w in told)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        other, v = brought(by_monod(1e-6), dtype)
    assert float(u.min()) >= 0.0 and float(v.min()) >= 0.0 and other > 1e6
    assert bool(u.isfinite().all())
    assert unsolved or abs(one / other - 1) <= 0.02
