"""Growth and contacts joined in one step: the same bits as one effect after the other, and the same
reports and gradients."""

from __future__ import annotations

import pytest
import torch
from recorded import assert_same_state
from torch.autograd import forward_ad

import torchfilm as tf
from torchfilm.effects.bound_mechanics import BoundMechanics
from torchfilm.joined_step import JoinedStep
from torchfilm.tools.tangents import forward_mode

pytest.importorskip("numba")

FILM = [tf.Plane(z=-0.5, facing="+z", stiffness=16.0), tf.Plane(z=0.5, facing="-z")]
CONTACTS = {
    "usual": {},
    "bilateral": {"contacts": "bilateral"},
    "drag by colony": {"length_drag": [10.0, 1e5, 100.0]},
    "alpha": {"alpha": 0.01},
    "soft": {"stiffness": 100.0},
}


def scene_of(dim: int, law: str, contacts: dict, rate: object = 1.0) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=rate, law=law),
        tf.Division(length=tf.Uniform(3.5, 4.0)),
        tf.Mechanics(FILM if dim == 3 else [], dim=dim, **contacts),
        dim=dim,
        dt=0.05,
    )


def one_by_one(model: tf.Model, state: tf.State, dt: float) -> tf.State:
    """A step without anything joined."""
    state = model.opened(state, dt)
    for effect in model.effects:
        state = effect.run_step(state, dt)
    return tf.model.advanced(state, dt)


@pytest.mark.parametrize("contacts", CONTACTS)
@pytest.mark.parametrize("law", ["volume", "length", "linear"])
@pytest.mark.parametrize("dim", [2, 3])
def test_joined_steps_have_the_bits_of_single_ones(dim, law, contacts, dtype):
    """Rates that are drawn at birth, so that cells differ, for long enough to have contacts."""
    rate = tf.LogNormal(3.0 if law == "linear" else 1.0, 0.1)  # µm/h, 1/h
    scene = scene_of(dim, law, CONTACTS[contacts], rate)
    model = scene.bind(3, seed=1, dtype=dtype)
    assert any(isinstance(part, JoinedStep) for part in model._joined_parts)
    joined = single = model.start()
    for _ in range(70):
        joined, single = model.step(joined), one_by_one(model, single, model.dt)
    assert joined.cells > 12
    assert_same_state(joined, single)
    for name in ("status", "iterations", "passes", "residual", "substeps"):
        reports = (s.reports["mechanics"] for s in (joined, single))
        assert torch.equal(*(getattr(r, name) for r in reports))


@pytest.mark.parametrize("part", ["length", "position", "growth_rate", "displacement"])
def test_a_derivative_passes_through_single_steps(part):
    """A state of which a gradient is wanted takes no joined step, which would lose it."""
    model = scene_of(2, "length", {"tolerance": 1e-6}).bind(dtype=torch.float64)
    state = model.start()
    wanted = getattr(state, part).clone().requires_grad_()
    change = {part: wanted}
    built_in = part in ("length", "position")
    state = state.replace(**change) if built_in else state.with_fields(**change)
    after = model.step(state)
    found = after.position if part == "position" else after.length
    if part == "displacement":  # from which a solve starts: nothing depends on it
        assert torch.equal(after.length, one_by_one(model, state, model.dt).length)
        return
    (slope,) = torch.autograd.grad(found.sum(), wanted)
    assert bool((slope != 0).any())


def test_a_wall_whose_place_is_sought_takes_single_steps():
    height = torch.tensor(0.49, dtype=torch.float64, requires_grad=True)
    walls = [tf.Plane(z=height, facing="-z")]
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(walls, tolerance=1e-6), dt=0.05)
    model = scene.bind(dtype=torch.float64)
    after = model.step(model.step(model.start()))
    (slope,) = torch.autograd.grad(after.position[:, 2].sum(), height)
    assert float(slope) != 0


def test_growth_past_all_numbers_is_reported_as_by_single_steps():
    model = scene_of(2, "volume", {}, rate=[1.0, 5000.0]).bind(2)
    after = model.step(model.start())
    assert after.reports["growth"].status.tolist() == [0, 1]
    assert_same_state(after, one_by_one(model, model.start(), model.dt))


def test_rates_by_type_and_effects_in_between_are_not_joined():
    by_type = tf.Growth(rate={0: 0.6, 1: 1.2})
    model = tf.Scene(by_type, tf.Mechanics(dim=2)).bind()
    assert not any(isinstance(part, JoinedStep) for part in model._joined_parts)
    by_torch = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, backend="torch")).bind()
    assert not any(isinstance(part, JoinedStep) for part in by_torch._joined_parts)


def test_time_is_told_of_each_effect():
    timings, model = tf.Timings(), scene_of(2, "length", {}).bind()
    model.step(model.start(), timings=timings)
    assert set(timings.seconds) == {"growth", "mechanics", "division"}


def test_a_tangent_of_a_rate_is_refused_and_not_lost():
    model = scene_of(2, "length", {}).bind(dtype=torch.float64)
    state = model.start()
    with forward_mode():
        rate = forward_ad.make_dual(state.growth_rate, torch.ones_like(state.growth_rate))
        with pytest.raises(tf.InputError, match="no forward mode"):
            model.step(state.with_fields(growth_rate=rate))


def test_a_gradient_by_a_drag_that_was_drawn_is_not_lost():
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics(dim=2, viscosity=tf.LogNormal(1.0, 0.2), tolerance=1e-6),
        founders=tf.Cells([[0.0, 0.0], [2.5, 0.1]], [[1.0, 0.0]] * 2, length=2.0),
    )
    model = scene.bind(dtype=torch.float64)
    state = model.start()
    drag = state.mechanics_viscosity.clone().requires_grad_()
    after = model.step(state.with_fields(mechanics_viscosity=drag), 0.05)
    (slope,) = torch.autograd.grad(after.position[0, 0], drag)
    assert bool((slope != 0).any())


def test_a_step_of_ones_own_contacts_is_taken():
    class Still(BoundMechanics):
        def step(self, state, dt):
            return state.replace(position=state.position + 1.0)

    class Own(tf.Mechanics):
        def bind(self, binding):
            return (Still(self, binding),)

    model = tf.Scene(tf.Growth(rate=1.0), Own(dim=2)).bind()
    assert not any(isinstance(part, JoinedStep) for part in model._joined_parts)
    state = model.start()
    assert torch.equal(model.step(state).position, state.position + 1.0)
