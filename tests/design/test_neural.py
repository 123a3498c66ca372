"""Controllers: rates by a network, trained through a replay."""

from __future__ import annotations

import math

import pytest
import torch

import torchfilm as tf
from design import Bands
from torchfilm import together

F64 = torch.float64
TARGET = Bands(("gfp",), (1.0, math.inf), along="edge", floor=0.1)


class Controller(torch.nn.Module):
    """Makes a reporter and eats food, as a network of food and reporter says."""

    def __init__(self, seed: int = 0):
        super().__init__()
        torch.manual_seed(seed)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(2, 3), torch.nn.Tanh(), torch.nn.Linear(3, 2)
        ).to(F64)

    def forward(self, u, s, p, cell):
        seen = torch.stack([4.0 + 2.0 * torch.log(0.01 + s.food), u.gfp - 0.5], 1)
        made, share = torch.nn.functional.softplus(self.net(seen)).unbind(1)
        eaten = 10.0 * (1.0 + share) * s.food * cell.volume
        return {"gfp": 4.0 * (made - u.gfp)}, {"food": -eaten}


def replay_of(controller: Controller, streams=(0, 1), **circuit) -> tf.Replay:
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(controller, species="gfp", initial={"gfp": 0.5}, **circuit),
        tf.Medium(
            food=tf.Signal(diffusion=30.0, decay=0.2, source=0.2, initial=1.0),
            box=((-16, -16), (16, 16)), spacing=4.0,
        ),
        dt=0.1,
    )  # fmt: skip
    recording = tf.GrowthRecording(scene, streams=streams, dtype=F64)
    return tf.Replay(scene.bind(len(streams), streams=streams, dtype=F64), recording)


def loss_of(replay: tf.Replay, begin: tf.State, until: float) -> torch.Tensor:
    return TARGET.loss(tf.rollout(replay, begin, until=until, segment=2)).mean()


@pytest.mark.parametrize(
    "circuit",
    [{"method": "heun2"}, {"rtol": 0.1, "atol": 0.1}],  # one step of the stiff solver in each
    ids=["heun2", "rosenbrock"],
)
def test_the_gradient_of_a_replay_equals_differences(circuit, monkeypatch):
    """Central differences by weights, through circuit, exchange, transport and division, which is
    in the third of six steps.

    H = 1e-5: a relative error of 1e-10 by curvature, and of 1e-16/H = 1e-11 by rounding. A part in
    10⁶ of the greatest slope leaves room for a network that bends strongly.
    """
    # or differences would see where the solve of exchange and transport ends
    monkeypatch.setattr(together, "PART", 1e-8)
    monkeypatch.setattr(together, "FINE", 1e-8)
    controller = Controller()
    replay = replay_of(controller, **circuit)
    with torch.no_grad():
        begin = tf.rollout(replay, until=2.2)
    end = tf.rollout(replay, begin, until=2.8, segment=2)
    assert begin.cells < end.cells and int(end.reports["circuit"].steps.max()) == 1
    loss_of(replay, begin, 2.8).backward()
    greatest = max(float(p.grad.abs().max()) for p in controller.parameters())
    assert greatest > 1e-4
    with torch.no_grad():
        for parameter in controller.parameters():
            flat, slopes = parameter.view(-1), parameter.grad.view(-1)
            for k in range(0, len(flat), 5):
                value, sides = flat[k].clone(), []
                for h in (1e-5, -1e-5):
                    flat[k] = value + h
                    sides.append(float(loss_of(replay, begin, 2.8)))
                flat[k] = value
                assert abs((sides[0] - sides[1]) / 2e-5 - float(slopes[k])) < 1e-6 * greatest


def test_training_lowers_the_loss_on_colonies_never_seen():
    """Twelve steps of Adam on two colonies, looked at on two others. They take off over half of the
    loss; a fifth is asked for."""
    controller = Controller(seed=1)
    replay, fresh = (replay_of(controller, s, method="heun2") for s in ((0, 1), (7, 8)))
    with torch.no_grad():
        start, begin = (tf.rollout(r, until=3.2) for r in (replay, fresh))
        before = float(loss_of(fresh, begin, 4.2))
    optimiser = torch.optim.Adam(controller.parameters(), lr=0.1)
    losses = []
    for _ in range(12):
        optimiser.zero_grad()
        loss = loss_of(replay, start, 4.2)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    with torch.no_grad():
        after = float(loss_of(fresh, begin, 4.2))
    assert losses[-1] < 0.8 * losses[0], losses
    assert after < 0.8 * before, (before, after)
