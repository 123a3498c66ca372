"""Weights of modules as data."""

from __future__ import annotations

import json

import pytest
import torch

import torchfilm as tf
from design import load_weights, save_weights


def net(hidden: int = 4, dtype=torch.float32) -> torch.nn.Module:
    return torch.nn.Sequential(
        torch.nn.Linear(2, hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, 1)
    ).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_come_back_to_the_bit(tmp_path, dtype):
    torch.manual_seed(3)
    first, second = net(dtype=dtype), net(dtype=dtype)
    assert save_weights(first, tmp_path / "net.json") == tmp_path / "net.json"
    load_weights(second, tmp_path / "net.json")
    for name, value in first.state_dict().items():
        found = second.state_dict()[name]
        assert found.dtype == dtype and torch.equal(found, value), name
    assert all(p.requires_grad for p in second.parameters())


def test_a_file_is_plain_json(tmp_path):
    stored = json.loads(save_weights(net(), tmp_path / "net.json").read_text())
    assert stored["weights"]["0.weight"]["shape"] == [4, 2]
    assert stored["weights"]["2.bias"]["dtype"] == "float32"


def test_weights_of_another_module_change_nothing(tmp_path):
    path = save_weights(net(5), tmp_path / "net.json")
    module = net(4)
    before = {n: v.clone() for n, v in module.state_dict().items()}
    with pytest.raises(tf.InputError, match=r"'0.bias' of shape \(5,\).*of shape \(4,\), as in"):
        load_weights(module, path)
    assert all(torch.equal(v, before[n]) for n, v in module.state_dict().items())
    with pytest.raises(tf.InputError, match=r"'0\.bias' of shape"):
        load_weights(torch.nn.Linear(2, 1), path)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"format": "other"}', '{"format": "torchfilm weights 1"}']
)
def test_a_file_without_weights_is_refused(tmp_path, text):
    (tmp_path / "net.json").write_text(text)
    with pytest.raises(tf.InputError, match="holds no weights that save_weights wrote"):
        load_weights(net(), tmp_path / "net.json")


def test_weights_that_json_cannot_hold_are_refused(tmp_path):
    module = net()
    with torch.no_grad():
        module[0].bias[0] = torch.nan
    with pytest.raises(tf.InputError, match=r"weights\['0.bias'\].*finite real numbers"):
        save_weights(module, tmp_path / "net.json")
    assert not (tmp_path / "net.json").exists()


def test_whole_numbers_that_a_module_counts_come_back(tmp_path):
    first, second = (torch.nn.BatchNorm1d(2) for _ in range(2))
    first(torch.rand(5, 2))
    load_weights(second, save_weights(first, tmp_path / "net.json"))
    assert int(second.num_batches_tracked) == 1
    assert torch.equal(first.running_mean, second.running_mean)
