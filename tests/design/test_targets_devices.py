"""Targets on device="cuda", on a machine without one: nothing is summed in an order that is not
fixed there, and the losses are those of the CPU but for roundings."""

from __future__ import annotations

import math

import pytest
import torch
from mock_cuda import pretended_cuda  # noqa: F401
from patterned import crowded
from test_host_reads import Reads

from design import Observed
from design.targets import DomainSize, Oscillation, Stripe

TIMES = torch.arange(60, dtype=torch.float64) * 0.1


def waves(colonies: int) -> torch.Tensor:
    """Notes of an `Oscillation` of 2 h, (T, B, 3)."""
    mean = 2 + torch.sin(math.pi * TIMES.unsqueeze(1) + torch.arange(colonies))
    return torch.stack([TIMES.unsqueeze(1).expand_as(mean), mean, mean**2 + 0.1], 2)


@pytest.mark.parametrize("kind", [Oscillation, DomainSize, Observed])
def test_losses_are_those_of_the_cpu(pretended_cuda, kind):  # noqa: F811
    here, history = crowded(count=60), waves(4)
    target = {
        Oscillation: lambda: Oscillation("yfp", 2.0),
        DomainSize: lambda: DomainSize(("yfp", "cfp"), 3.0),
        Observed: lambda: Observed.from_state(here.select([0]), species=["yfp"]),
    }[kind]()
    there = here.to("cuda")
    found = target.loss(there, history.to("cuda"))
    assert found.device.type == "cuda"
    assert torch.allclose(found.cpu(), target.loss(here, history), rtol=1e-12, atol=1e-12)
    right = target.measures(here, history)
    for name, value in target.measures(there, history.to("cuda")).items():
        assert torch.allclose(value.cpu(), right[name], rtol=1e-12, equal_nan=True), name


@pytest.mark.parametrize("straight", [True, False])
def test_a_stripe_reads_as_often_for_many_colonies(pretended_cuda, monkeypatch, straight):  # noqa: F811
    """A read waits for the GPU: there is none for each colony."""
    target, counts = Stripe("yfp", width=4.0, straight=straight), []
    for colonies in (2, 6):
        there = crowded(colonies=colonies).to("cuda")
        with monkeypatch.context() as patch, Reads(patch) as reads:
            for look in (target.check, target.unfit, target.loss):
                look(there)
        counts.append(reads.count)
    assert 0 < counts[0] == counts[1]
