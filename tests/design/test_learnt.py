"""What inference has learnt is kept with its simulations."""

from __future__ import annotations

from importlib.util import find_spec

import h5py
import numpy as np
import pytest
import torch
from torch import nn

import torchfilm as tf
from design import Choice, Measured, Parameter, infer, neural_posterior, options
from design.learnt import LearntNetworks

needs_sbi = pytest.mark.skipif(find_spec("sbi") is None, reason='needs pip install -e ".[infer]"')
ONE = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
SPACE = [Parameter("loss", 0.01, 10.0, log=True), Choice("dose", (0.5, 1.0), per_colony=True)]


def washout(loss=0.5, dose=1.0) -> tf.Scene:
    """One cell, whose gfp is exp(−loss · dose · t)."""
    rates = lambda u, s, p, cell: {"gfp": -p.loss * p.dose * u.gfp}
    circuit = tf.Circuit(rates, species="gfp", initial={"gfp": 1.0}, loss=loss, dose=dose)
    return tf.Scene(circuit, dim=2, dt=0.25, founders=ONE)


def seen(wanted=0.5) -> Measured:
    level = lambda state: state.groups.sum(state.gfp)
    return Measured({"gfp": level}, wanted={"gfp": wanted}, spread={"gfp": 0.01}, time=1.0)


def found(observed=None, **more):
    given = {"simulations": 100, "flows": 2, "epochs": 4, "samples": 300, "progress": False}
    return infer(washout, SPACE, observed or seen(), **given | more)


def never(*given):
    raise AssertionError("it learnt again")


@needs_sbi
@pytest.mark.parametrize("rounds", [1, 2])
def test_nothing_is_learnt_twice(tmp_path, monkeypatch, rounds):
    path = tmp_path / "kept.h5"
    first = found(path=path, rounds=rounds)
    monkeypatch.setattr(neural_posterior, "_learn_flow", never)
    monkeypatch.setattr(options, "_learn", never)
    again = found(path=path, rounds=rounds)
    assert np.array_equal(again.points, first.points)
    rows = np.array([[0.4], [0.6]])
    density = lambda of: of.estimator.log_density(of.points[None, :50].repeat(2, 0), rows)
    assert np.array_equal(density(again), density(first))
    if rounds == 1:  # the density is one for all data
        assert np.array_equal(found(seen(0.6), path=path).points, first.given(seen(0.6)).points)
    for other in ({"epochs": 5}, {"simulations": 110}, {"path": None}):
        with pytest.raises(AssertionError, match="learnt again"):
            found(**{"path": path, "rounds": rounds} | other if rounds == 1 else {"epochs": 5})


@needs_sbi
def test_more_simulations_and_what_was_learnt_stay(tmp_path):
    path = tmp_path / "kept.h5"
    found(path=path, simulations=120)
    with h5py.File(path) as file:
        points, words = file["points"][...], set(file["networks"])
    assert len(points) == 120 and len(words) == 2 * 2  # a classifier and a flow, twice
    found(path=path)
    with h5py.File(path) as file:
        assert np.array_equal(file["points"][...], points)
        assert set(file["networks"]) > words and len(file["networks"]) == 8


def test_a_network_is_kept_by_what_it_was_learnt_from(tmp_path):
    def learn() -> nn.Module:
        return nn.Linear(2, 3)

    numbers, kept = np.arange(3.0), LearntNetworks()
    made = kept.network((numbers, 4), learn, learn)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        kept.write(file)
    with h5py.File(tmp_path / "a.h5") as file:
        again = LearntNetworks.read(file)
    same = again.network((numbers, 4), learn, never)
    assert torch.equal(same.weight, made.weight) and again.new == 0 and kept.new == 1
    assert not torch.equal(again.network((numbers, 5), learn, learn).weight, made.weight)
    assert again.new == 1
    with pytest.raises(tf.InputError, match=r"is not of this form.*another path"):
        again.network((numbers, 4), lambda: nn.Linear(2, 4), never)
