"""Proteins that mature in stages: the delay of a chain."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from modelled import course
from scipy import stats

import torchfilm as tf
from torchfilm import parts

TIGHT = {"rtol": 1e-8, "atol": 1e-10}
HOURS = [0.0, 0.1, 0.2, 0.4, 0.8]


@pytest.mark.parametrize("stages", [1, 2, 5])
@pytest.mark.parametrize("time", [0.25, "delay"])
def test_what_has_matured_follows_the_sum_of_equal_stages(stages, time):
    """The time from end to end is Erlang's."""
    names = ("raw", *(f"raw_{k}" for k in range(2, stages + 1)), "gfp")
    chain = parts.maturation("raw", "gfp", time=time, stages=stages)
    known = {"delay": 0.25} if time == "delay" else {}
    circuit = tf.Circuit(chain, species=names, initial={"raw": 3.0}, **known, **TIGHT)
    found = course(circuit, HOURS)
    expected = 3.0 * stats.gamma.cdf(HOURS, stages, scale=0.25 / stages)
    np.testing.assert_allclose(found["gfp"], expected, rtol=1e-5, atol=1e-7)
    total = sum(found[n] for n in names)
    np.testing.assert_allclose(total, 3.0, rtol=1e-6)


def test_molecules_mature_one_by_one():
    chain = parts.maturation("raw", "gfp", time=0.5, stages=3)
    circuit = tf.Circuit(
        chain, species=("raw", "raw_2", "raw_3", "gfp"), initial={"raw": 50.0}, method="direct"
    )
    cells = tf.Cells([[3.0 * k, 0.0] for k in range(40)], [[1.0, 0.0]] * 40)
    model = tf.Scene(circuit, founders=cells, dim=2).bind()
    state = model.step(model.start(), 0.4)
    molecules = state.fields["gfp"] * state.volume
    share = float(molecules.sum() / (50.0 * state.volume).sum())
    expected = float(stats.gamma.cdf(0.4, 3, scale=0.5 / 3))
    count = float((50.0 * state.volume).sum())
    assert share == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / count))
    whole = sum(state.fields[n] for n in circuit.species) * state.volume
    torch.testing.assert_close(whole, whole.round(), rtol=1e-5, atol=1e-3)
    assert (whole - 50.0 * state.volume).abs().max() < 1.0  # at the start, rounded up or down


def test_times_and_stages_are_checked():
    for wrong in ({"time": 0.0}, {"time": -1.0}, {"time": "a b"}):
        with pytest.raises(tf.InputError, match=r"maturation\.time"):
            parts.maturation("raw", "gfp", **wrong)
    for stages in (0, 1.5):
        with pytest.raises(tf.InputError, match=r"maturation\.stages"):
            parts.maturation("raw", "gfp", time=0.1, stages=stages)
