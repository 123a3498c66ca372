"""What inference has learnt is kept with its simulations."""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from torch import nn

import torchfilm as tf
from design import Choice, Measured, Parameter, data_file, infer, neural_posterior, options
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
def test_other_networks_are_added(tmp_path):
    path, beside = tmp_path / "kept.h5", tmp_path / "kept.networks.h5"
    found(path=path, simulations=120)
    with h5py.File(beside) as file:
        words = set(file["networks"])
    assert len(words) == 2 * 2  # a classifier and a flow, twice
    found(path=path)
    with h5py.File(beside) as file:
        assert set(file["networks"]) > words and len(file["networks"]) == 8
    with h5py.File(path) as file:
        assert len(file["points"]) == 120


@needs_sbi
def test_a_full_disk_costs_no_posterior(tmp_path, monkeypatch):
    path = tmp_path / "kept.h5"
    found(path=path)
    monkeypatch.setattr(data_file.shutil, "disk_usage", lambda path: SimpleNamespace(free=0))
    with pytest.warns(UserWarning, match=r"what was learnt is not kept: no room to write"):
        assert len(found(path=path, epochs=5).points) == 300


def test_a_network_is_kept_by_what_it_was_learnt_from(tmp_path):
    def learn() -> nn.Module:
        return nn.Linear(2, 3)

    def kept() -> LearntNetworks:
        return LearntNetworks.beside(tmp_path / "a.h5")

    numbers, first = np.arange(3.0), kept()
    made = first.network((numbers, 4), learn, learn)
    first.write()
    again = kept()
    same = again.network((numbers, 4), learn, never)
    assert torch.equal(same.weight, made.weight) and not again.new and not first.new
    other = again.network((numbers, 5), learn, learn)
    assert not torch.equal(other.weight, made.weight) and len(again.new) == 1
    # as if another process had written in between
    third = kept()
    third.network((numbers, 6), learn, learn)
    third.write()
    again.write()
    assert len(kept().known) == 3
    with pytest.warns(UserWarning, match="is damaged, and is learnt again"):
        changed = again.network((numbers, 4), lambda: nn.Linear(2, 4), lambda: nn.Linear(2, 4))
    assert changed.weight.shape == (4, 2)


def test_a_file_of_another_kind_may_be_deleted(tmp_path):
    (tmp_path / "a.networks.h5").write_bytes(b"no HDF5")
    with pytest.raises(tf.InputError, match=r"learnt again: move it away, or delete it"):
        LearntNetworks.beside(tmp_path / "a.h5")
    learnt = LearntNetworks(tmp_path / "a.networks.h5")
    learnt.network(1, lambda: nn.Linear(1, 1), lambda: nn.Linear(1, 1))
    with pytest.warns(UserWarning, match="what was learnt is not kept"):
        learnt.write()


def test_networks_without_a_file_are_kept_for_now():
    learnt = LearntNetworks.beside(None)
    learnt.network(1, lambda: nn.Linear(1, 1), lambda: nn.Linear(1, 1))
    learnt.write()
    assert learnt.network(1, lambda: nn.Linear(1, 1), never).weight.shape == (1, 1)
