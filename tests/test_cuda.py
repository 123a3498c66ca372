"""A GPU, where there is one: the same bits again, alone, in a batch, after a restart and after a
file; moves of states between devices; gradients."""

from __future__ import annotations

import pytest
import torch
from test_cpu_parts import check_bits_of_the_cpu
from test_devices import KINDS, SMALL, STEPS, by_torch, check_as_on_the_cpu, columns

import torchfilm as tf

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.fixture(autouse=True)
def deterministic(monkeypatch):
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(before)


def check_same_bits(one: tf.State, other: tf.State) -> None:
    assert one.cells == other.cells
    for (name, x), y in zip(columns(one).items(), columns(other).values(), strict=True):
        assert x.device == y.device and torch.equal(x, y), name


def grown(scene: tf.Scene, steps: int, colonies: int) -> tf.State:
    model = scene.bind(colonies, seed=3, device="cuda")
    return after(scene, model.start(), steps)


def after(scene: tf.Scene, state: tf.State, steps: int) -> tf.State:
    *_, state = tf.simulate(scene, state, until=state.time + steps * scene.dt)
    return state


@pytest.mark.parametrize("name", STEPS)
@torch.no_grad()
def test_a_scene_comes_to_what_it_does_on_the_cpu(name):
    check_as_on_the_cpu(name)


@pytest.mark.parametrize("name", STEPS)
def test_kernels_have_the_bits_of_the_cpu(name):
    check_bits_of_the_cpu(name)


@pytest.mark.parametrize("kinds", [(), KINDS], ids=["kernels", "torch"])
@pytest.mark.parametrize("name", STEPS)
@torch.no_grad()
def test_the_same_bits_again_alone_and_after_a_restart(name, kinds, tmp_path):
    scene, steps = by_torch(tf.scenes.build(name, SMALL.get(name)), *kinds), STEPS[name]
    whole = grown(scene, steps, 3)
    check_same_bits(whole, grown(scene, steps, 3))
    half, rest = steps // 2, steps - steps // 2
    path = tmp_path / "half.h5"
    state = scene.bind(3, seed=3, device="cuda").start()
    *_, state = tf.simulate(scene, state, until=half * scene.dt, record=path)
    check_same_bits(whole.select([1]), after(scene, state.select([1]), rest))
    with tf.Results(path) as results:
        again = results.state(scene, device="cuda")
    check_same_bits(whole, after(scene, again, rest))


@torch.no_grad()
def test_a_state_moves_between_devices():
    scene = tf.scenes.build("quorum_sensing")
    there = grown(scene, 5, 2)
    here = there.to("cpu")
    assert here.device.type == "cpu" and here.groups.counts.device.type == "cpu"
    check_same_bits(there, here.to("cuda"))
    a, b = after(scene, here, 3), after(scene, there, 3)
    assert torch.allclose(a.position, b.position.cpu(), atol=1e-3)


def test_gradients_are_those_of_the_cpu():
    def slope(device: str) -> torch.Tensor:
        rate = torch.tensor([1.0, 1.2], dtype=torch.float64, device=device, requires_grad=True)
        scene = tf.Scene(
            tf.Growth(rate=rate), tf.Division(length=3.5),
            tf.Mechanics(dim=2, tolerance=1e-8, backend="torch"),
            tf.Circuit(lambda u, s, p, cell: ({"m": 1.0 + s.a - u.m}, {"a": -s.a * cell.volume}),
                       species="m"),
            tf.Medium(a=tf.Signal(50.0, initial=1.0), box=[[-20.0, -20.0], [20.0, 20.0]],
                      spacing=4.0, depth=1.0),
            dt=0.05,
        )  # fmt: skip
        state = scene.bind(2, device=device, dtype=torch.float64).start()
        state = after(scene, state, 30)
        loss = state.position.square().sum() + state.m.sum() + state.length.sum()
        (found,) = torch.autograd.grad(loss, rate)
        return found.cpu()

    assert torch.allclose(slope("cuda"), slope("cpu"), rtol=1e-4)
