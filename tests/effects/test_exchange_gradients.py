"""Gradients of circuits that are solved together with transport: how often the circuit is computed
for them, and that checkpoints change nothing."""

from __future__ import annotations

import pytest
import torch
from torch.utils.checkpoint import checkpoint

import torchfilm as tf
from torchfilm import together

F64 = torch.float64
STEPS = 4


def scene(making, rates=None) -> tf.Scene:
    def lux(u, s, p, cell):
        leak = p.D * (s.ahl - u.ahl) * cell.area / cell.volume
        made = p.making * u.ahl**2 / (1 + u.ahl**2)
        return {"ahl": 0.5 + made - u.ahl + leak}, {"ahl": -leak * cell.volume}

    medium = tf.Medium(
        ahl=tf.Signal(diffusion=100.0, decay=1.0), spacing=4.0, box=((-8, -8), (8, 8))
    )
    return tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=2.3),
        tf.Circuit(rates or lux, species="ahl", D=5.0, making=making, initial={"ahl": 1.0}),
        medium, dim=2, dt=0.05,
    )  # fmt: skip


def leaky_network() -> tuple[torch.Tensor, object]:
    """Rates that refer to a weight of their own, which no option names."""
    weight = torch.tensor(2.0, dtype=F64, requires_grad=True)

    def rates(u, s, p, cell):
        leak = p.D * (s.ahl - u.ahl) * cell.area / cell.volume
        return {"ahl": p.making * torch.tanh(weight * u.ahl) + leak}, {"ahl": -leak * cell.volume}

    return weight, rates


def ends(given: tf.Scene) -> torch.Tensor:
    *_, last = tf.simulate(given, given.bind(dtype=F64).start(), until=STEPS * 0.05)
    return (last.ahl * last.volume).sum()


@pytest.fixture
def computed(monkeypatch) -> list[int]:
    """How often the circuit has been computed by torch, together with transport."""
    calls, before = [], together._Step.__call__

    def counted(self, x):
        calls.append(1)
        return before(self, x)

    monkeypatch.setattr(together._Step, "__call__", counted)
    return calls


def test_a_step_computes_the_circuit_twice_and_the_way_back_does_not(computed):
    """Once for the equation that it solves, which the way back differentiates by what cells find,
    and once with that. It had been three times, and once on the way back."""
    making = torch.tensor(5.0, dtype=F64, requires_grad=True)
    end = ends(scene(making))
    assert len(computed) == 2 * STEPS
    end.backward()
    assert len(computed) == 2 * STEPS
    with torch.no_grad():
        h = 1e-4
        slope = float(ends(scene(making + h)) - ends(scene(making - h))) / (2 * h)
    assert float(making.grad) == pytest.approx(slope, rel=1e-5)


def test_gradients_by_what_no_option_names():
    """The first step finds out; in later ones species say so."""
    weight, rates = leaky_network()
    ends(scene(3.0, rates)).backward()
    found = float(weight.grad)
    with torch.no_grad():
        h = 1e-4
        weight += h
        high = ends(scene(3.0, rates))
        weight -= 2 * h
        slope = float(high - ends(scene(3.0, rates))) / (2 * h)
    assert found == pytest.approx(slope, rel=1e-5)


def test_checkpoints_give_the_same_gradient():
    """Of `rollout`, and of one's own: in them the circuit is computed again for the adjoint."""
    making = torch.tensor(5.0, dtype=F64, requires_grad=True)
    (plain,) = torch.autograd.grad(ends(scene(making)), making)
    end = tf.rollout(scene(making), scene(making).bind(dtype=F64).start(), until=0.2, segment=2)
    (kept,) = torch.autograd.grad((end.ahl * end.volume).sum(), making)
    assert float(kept) == pytest.approx(float(plain), rel=1e-12)
    model = scene(making).bind(dtype=F64)
    state = model.start()
    for _ in range(STEPS):
        state = checkpoint(model.step, state, 0.05, use_reentrant=False)
    (own,) = torch.autograd.grad((state.ahl * state.volume).sum(), making)
    assert float(own) == pytest.approx(float(plain), rel=1e-12)


def test_a_graph_that_is_kept_gives_the_gradient_again():
    making = torch.tensor(5.0, dtype=F64, requires_grad=True)
    end = ends(scene(making))
    first, second = (
        float(torch.autograd.grad(end, making, retain_graph=keep)[0]) for keep in (True, False)
    )
    assert first == second


def test_a_network_reads_what_a_compiled_circuit_takes():
    """Kernels take the first pass of transport, and torch those with gradients."""
    net = torch.nn.Linear(1, 1).double()
    with torch.no_grad():
        net.weight.fill_(0.5)
        net.bias.fill_(0.1)

    def eats(u, s, p, cell):
        return {"g": s.food}, {"food": -s.food * cell.volume}

    def reads(u, s, p, cell):
        return {"n": torch.nn.functional.softplus(net(s.food[:, None]))[:, 0] - u.n}

    medium = tf.Medium(
        food=tf.Signal(diffusion=100.0, initial=1.0), box=((-16, -16), (16, 16)), spacing=4.0,
        depth=1.0,
    )  # fmt: skip
    given = tf.Scene(
        tf.Growth(rate=1.0), tf.Circuit(eats, species="g"),
        tf.Circuit(reads, species="n", name="net"), medium, dim=2, dt=0.05,
    )  # fmt: skip
    loss = lambda: [*tf.simulate(given, given.bind(dtype=F64).start(), until=0.2)][-1].net_n.sum()
    found = torch.autograd.grad(loss(), net.weight)[0]
    ends = []
    for change in (1e-5, -1e-5):
        with torch.no_grad():
            net.weight.fill_(0.5 + change)
            ends.append(float(loss()))
    assert float(found) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)
