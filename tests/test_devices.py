"""device="cuda" on a machine without one: all that is made is made there, and comes to what the
CPU's own ways come to."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import step
from mock_cuda import pretended_cuda  # noqa: F401

import torchfilm as tf

# of each ready scene: long enough for cells to divide where they touch each other or walls
STEPS = {
    "microcolony": 40,
    "channel": 40,
    "programmed_growth": 20,
    "quorum_sensing": 5,
    "boundary_detector": 5,
    "synchronized_lysis": 5,
    "strain_sorting": 5,
    "random_partition": 8,
    "nutrient_limited": 5,
    "biofilm": 4,
}
KINDS = (tf.Mechanics, tf.Circuit, tf.Medium)  # whose backend may be chosen
SMALL = {
    "strain_sorting": {"cells": 40, "chamber": 10.0},
    "biofilm": {"width": 16.0, "height": 20.0, "first": 3},
}


def by_torch(scene: tf.Scene, *kinds: type) -> tf.Scene:
    """The scene, with its effects of these kinds by torch."""
    change = lambda e: replace(e, backend="torch") if isinstance(e, kinds) else e
    return scene.replace(*(change(e) for e in scene.effects))


def grown(name: str, device: str) -> tf.State:
    """By torch on CUDA, and contacts also on the CPU: after many steps, the 1e-10 by which kernels
    differ (tests/physics/test_compiled.py) would hide what a device changes."""
    scene = tf.scenes.build(name, SMALL.get(name))
    scene = by_torch(scene, *([tf.Mechanics] if device == "cpu" else KINDS))
    state = scene.bind(2, device=device, dtype=torch.float64).start()
    for _ in range(STEPS[name]):
        state = step(scene, state, scene.dt)
    assert not tf.failures(state)
    return state


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
@torch.no_grad()
def test_a_scene_runs_where_it_was_asked_to(pretended_cuda, name):  # noqa: F811
    check_as_on_the_cpu(name)


def columns(state: tf.State) -> dict[str, torch.Tensor]:
    """All that a state holds of its cells, and its signals."""
    names = ("position", "axis", "length", "uid", "parent", "colony")
    found = {n: getattr(state, n) for n in names} | dict(state.fields)
    return found | {f"signal {n}": x for n, x in state.signals.items()}


def check_as_on_the_cpu(name: str) -> None:
    """All of a ready scene is on CUDA, and what it is on the CPU."""
    there, here = grown(name, "cuda"), grown(name, "cpu")
    assert there.position.device.type == "cuda" and here.position.device.type == "cpu"
    made = columns(there)
    for n, right in columns(here).items():
        found = made[n]
        assert found.device.type == "cuda", n
        assert torch.allclose(found.cpu().double(), right.double(), rtol=1e-6, atol=1e-9), n


@pytest.mark.parametrize("kinds", [(), (*KINDS, tf.MediumReactions)], ids=["kernels", "torch"])
@torch.no_grad()
def test_cells_burst_and_signals_react_where_they_are(pretended_cuda, kinds):  # noqa: F811
    def draw(cells):
        cells.mutations = cells.mutations + cells.poisson(0.5) + cells.normal().abs()
        cells.near = cells.signals.b * 1.0

    def run(device):
        scene = tf.Scene(
            tf.Rules(draw, variables={"mutations": 0.0, "near": 0.0}), tf.Growth(rate=1.0),
            tf.Division(length=3.0), tf.Mechanics(dim=2, backend="torch", tolerance=1e-8),
            tf.Circuit(lambda u, s, p, cell: {"m": 1.0 - u.m}, species="m"),
            tf.Lysis(rate=3.0, releases={"a": ("m", "volume"), "b": 2.0}),
            tf.MediumReactions(lambda s, p: {"b": -p.k * s.a * s.b}, parameters={"k": [1.0, 2.0]}),
            tf.Medium(a=tf.Signal(50.0), b=tf.Signal(5.0, initial=0.1),
                      box=[[-20.0, -20.0], [20.0, 20.0]], spacing=4.0, depth=1.0),
            founders=tf.Cells([[1.5 * k - 9, 0.0] for k in range(12)], [[0.0, 1.0]] * 12),
        )  # fmt: skip
        scene = by_torch(scene, *(kinds if device == "cuda" else ()))
        state = scene.bind(2, device=device, dtype=torch.float64).start()
        for _ in range(6):
            state = step(scene, state, 0.05)
        assert not tf.failures(state) and state.cells < 40
        return state, tf.measure.pressure(state, scene), tf.cell_table(state)

    (there, press, table), (here, right, own) = run("cuda"), run("cpu")
    assert press.device.type == "cuda" and there.reports["lysis"].burst.device.type == "cuda"
    assert torch.allclose(press.cpu(), right, rtol=1e-4, atol=1e-6 * float(right.max()))
    assert torch.equal(there.uid.cpu(), here.uid)
    for name in own:
        assert table[name] == pytest.approx(own[name], rel=1e-5, abs=1e-6), name
    for name in here.signals:
        assert torch.allclose(there.signals[name].cpu(), here.signals[name], rtol=1e-6), name


def test_a_model_of_another_gpu_refuses_a_state(pretended_cuda):  # noqa: F811
    """All that is pretended to be on some GPU is on the first."""
    with pytest.raises(tf.InputError, match=r"on cuda:0' .*on cuda:1, as the model is"):
        tf.scenes.build("microcolony").bind(1, device="cuda:1")
    tf.scenes.build("microcolony").bind(1, device="cuda")


def test_a_field_on_another_device_is_refused_at_once(pretended_cuda):  # noqa: F811
    state = tf.scenes.build("microcolony").bind(1, device="cuda").start()
    with pytest.raises(tf.InputError, match=r"'growth_rate' = 'cpu'.* cuda:0, as the state is"):
        state.with_fields(growth_rate=torch.ones(1))
    state.with_fields(growth_rate=torch.ones(1, device="cuda"))


def test_a_list_may_mix_tensors_there_and_numbers(pretended_cuda):  # noqa: F811
    one = torch.tensor(2.0).to("cuda")
    found = tf.checks.value("rate", [1.0, one, torch.tensor(3.0)])
    assert found.device.type == "cuda" and found.tolist() == [1.0, 2.0, 3.0]


def test_values_for_a_device_may_meet_numbers(pretended_cuda):  # noqa: F811
    column = torch.tensor([1.0, 2.0]).to("cuda")
    drawn = tf.LogNormal(column, 0.2)
    assert 0 < drawn.least() < 1 and drawn.greatest() > 2
    assert tf.Uniform(0.5, column).greatest() == 2 and tf.Normal(column, 0.1).greatest() == 2.4
    assert "rate" in repr(tf.Growth(rate={0: column, 1: 0.5}))
    tf.Growth(rate={0: drawn, 1: 0.5})


def test_pretended_tensors_refuse_others(pretended_cuda):  # noqa: F811
    one = torch.zeros(3, device="cuda")
    assert (
        (one + 1).device.type == "cuda" and one.cpu().device.type == "cpu" and float(one.sum()) == 0
    )
    with pytest.raises(RuntimeError, match=r"on cuda .* and on cpu"):
        one + torch.zeros(3)
    with pytest.raises(RuntimeError, match="numpy"):
        one.numpy()
