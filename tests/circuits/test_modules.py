"""Rates by a `torch.nn.Module`."""

from __future__ import annotations

import pytest
import torch

import torchfilm as tf


class Controller(torch.nn.Module):
    """Rates of a reporter, and what the cell gives to a signal, by a small network."""

    def __init__(self, dtype=torch.float32):
        super().__init__()
        torch.manual_seed(0)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(2, 6), torch.nn.Tanh(), torch.nn.Linear(6, 2)
        ).to(dtype)

    def forward(self, u, s, p, cell):
        made = torch.sigmoid(self.net(torch.stack([u.gfp, torch.log(0.1 + s.ahl)], 1)))
        return {"gfp": 5 * made[:, 0] - u.gfp}, {"ahl": 10 * made[:, 1] * cell.volume}


def scene_of(controller, **circuit) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(controller, species="gfp", **circuit),
        tf.Medium(
            ahl=tf.Signal(diffusion=50.0, decay=5.0), box=((-16, -16), (16, 16)), spacing=4.0
        ),
        dt=0.1,
    )


@pytest.mark.parametrize("method", ["rosenbrock", "heun2"])
@pytest.mark.parametrize("precision", [torch.float32, torch.float64])
def test_modules_of_either_precision_run_by_every_smooth_method(method, precision, dtype):
    """The stiff solver computes in float64, whatever the dtype of cells and weights."""
    scene = scene_of(Controller(precision), method=method)
    start = scene.bind(colonies=1, dtype=dtype).start()
    *_, state = tf.simulate(scene, start, until=0.5)
    assert state.gfp.dtype == dtype and bool((state.gfp > 0).all())


@pytest.mark.parametrize("method", ["rosenbrock", "heun2"])
def test_a_colony_has_the_same_bits_in_any_batch(method):
    scene = scene_of(Controller().requires_grad_(False), method=method)
    *_, many = tf.simulate(scene, until=2.5, colonies=5)
    *_, one = tf.simulate(scene, until=2.5, streams=[3], colonies=1)
    assert one.cells > 4
    assert torch.equal(one.gfp, many.gfp[many.colony == 3])


def test_messages_call_a_module_by_its_class():
    scene = scene_of(Controller())
    assert "computed by torch: Controller: it uses stack" in tf.explain(scene)
    with pytest.raises(tf.InputError, match="Circuit: Controller cannot be written as equations"):
        _ = scene.effects[3].graph
