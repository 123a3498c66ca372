"""Designs scored with device="cuda", on a machine without one: colonies have the bits of the CPU,
as kernels compute them there, and losses differ by the roundings of a target at most."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from mock_cuda import pretended_cuda  # noqa: F401
from searching import lit

from design import Objective, Parameter, Task, memory
from design.targets import Ring


@pytest.mark.parametrize("replay", [True, False])
def test_losses_on_a_gpu_are_those_of_the_cpu(pretended_cuda, replay, monkeypatch):  # noqa: F811
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (2**30, 2**34))
    points = np.array([[0.2, 0.5], [0.9, 0.3], [0.5, 0.8]])
    found = {}
    for device in ("cpu", "cuda"):
        ranges = [Parameter("make", 0.1, 10.0), Parameter("decay", 0.1, 10.0)]
        task = Task(lit, ranges, Ring("gfp", 2.0, 3.0), cells=8, replicates=2, device=device,
                    replay=replay)  # fmt: skip
        found[device] = Objective(task).evaluate(points).losses
    assert len(np.unique(found["cpu"])) >= 3
    assert np.allclose(found["cuda"], found["cpu"], rtol=1e-6)


def test_a_batch_on_a_gpu_must_fit_into_the_memory_of_both(pretended_cuda, monkeypatch):  # noqa: F811
    for there, least in ((2**20, 2**20), (2**60, memory.free_bytes("cpu"))):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device, free=there: (free, 2**62))
        assert 0.8 * least <= memory.free_bytes("cuda") <= 1.2 * least
