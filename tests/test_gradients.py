"""Gradients of whole runs against finite differences in float64: through growth, contacts, bounds
and division.

A run is a function of its parameters with jumps where a contact or a division comes or goes;
between them it is smooth, and that is where its gradient is asked. Each run here is checked to have
the same cells and the same contacts at both ends of the difference, so that the two can be
compared. The central difference at h = 1e-5 is off by its truncation, h² ≈ 1e-10 relative, and by
the rounding of the solves: they stop at 1e-10 of displacements of about 0.1 µm, over 2h that is at
most 1e-10 · 0.1/2e-5 ≈ 5e-7 a step. So the relative bound is 1e-5 of the gradient's size for a
dozen steps.
"""

from __future__ import annotations

import warnings

import pytest
import torch
from differences import (
    F64,
    between_walls,
    check,
    growing,
    mechanics,
    outcome,
    run,
    scattered,
    seeded,
)
from torch.autograd import forward_ad

import torchfilm as tf
from torchfilm.kernels.scheme import SHRINK
from torchfilm.tools.tangents import forward_mode, tangent

MODES = [pytest.param({"contacts": c}, id=c) for c in ("bilateral", "one-sided")]


# --- growth through contacts ----------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("mode", MODES)
def test_growth_rate_through_contacts(dim, mode):
    def experiment(rate):
        scene = growing(dim, rate, **mode)
        return run(scene, seeded(scene))

    check(experiment, 0.8)


@pytest.mark.parametrize("length_drag", [10.0, 1e5])
@pytest.mark.parametrize("dim", [2, 3])
def test_contacts_that_follow_their_force(dim, length_drag):
    """α depends on what the contacts bore before, also where the force more than doubles in a step
    and the pass is solved again."""

    def experiment(rate):
        scene = growing(dim, rate, alpha=None, length_drag=length_drag)
        return run(scene, seeded(scene))

    check(experiment, 0.8)


@pytest.mark.parametrize("mode", MODES)
def test_one_pass_a_step(mode):
    def experiment(rate):
        scene = growing(2, rate, passes=1, **mode)
        return run(scene, seeded(scene))

    check(experiment, 0.8)


@pytest.mark.parametrize("law", ["length", "linear"])
def test_other_laws_of_growth(law):
    def experiment(rate):
        scene = growing(2, rate, law=law)
        return run(scene, seeded(scene))

    check(experiment, 0.8)


def test_growth_in_sub_steps():
    """A rate at which cells want over 0.25 µm in a step: each step is taken in several."""

    def experiment(rate):
        scene = growing(2, rate)
        state = run(scene, seeded(scene), steps=3, dt=0.1)
        assert (state.reports["mechanics"].substeps > 1).all()
        return state

    check(experiment, 1.9)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dim", [2, 3])
def test_growth_rate_across_divisions(dim, mode):
    """The threshold is fixed and passed in the midst of a step, so that ±h divides the same cells
    at the same steps."""

    def experiment(rate):
        scene = growing(dim, rate, tf.Division(length=2.4, axis_noise=0.05), **mode)
        return run(scene, seeded(scene), steps=10)

    check(experiment, 0.8, divides=True)


def test_a_rate_for_each_colony_across_divisions():
    def experiment(rates):
        scene = growing(2, rates, tf.Division(length=2.4, fraction=0.4))
        return run(scene, seeded(scene, colonies=3), steps=10)

    check(experiment, [0.6, 0.8, 1.0], divides=True)


def test_a_fraction_of_division():
    def experiment(fraction):
        scene = growing(2, torch.tensor(0.8, dtype=F64), tf.Division(length=2.4, fraction=fraction))
        return run(scene, seeded(scene), steps=10)

    check(experiment, 0.45, divides=True)


def test_the_bounds_of_a_drawn_rate():
    """Reparametrised: low + (high − low)·u, with u fixed for each cell."""

    def experiment(bounds):
        scene = growing(2, tf.Uniform(bounds[0], bounds[1]), tf.Division(length=2.4))
        return run(scene, seeded(scene), steps=10)

    check(experiment, [0.6, 1.1], divides=True)


# --- the solve's own parameters -------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_alpha(mode):
    def experiment(alpha):
        scene = growing(2, torch.tensor(0.8, dtype=F64), alpha=alpha, **mode)
        return run(scene, seeded(scene))

    check(experiment, 0.3)


def test_alpha_of_each_colony():
    def experiment(alpha):
        scene = growing(2, torch.tensor(0.8, dtype=F64), alpha=alpha)
        return run(scene, seeded(scene, colonies=2))

    check(experiment, [0.2, 0.4])


@pytest.mark.parametrize("name", ["stiffness", "viscosity", "length_drag"])
def test_stiffness_and_drag(name):
    """γ beside μ = 1 and α fixed; stiffness with α = 1/(stiffness·Δt)."""

    def experiment(value):
        options = {"length_drag": 10.0, **({"alpha": None} if name == "stiffness" else {})}
        scene = growing(2, torch.tensor(0.8, dtype=F64), **{**options, name: value})
        return run(scene, seeded(scene))

    check(experiment, {"stiffness": 5.0, "viscosity": 1.3, "length_drag": 0.3}[name])


# --- bounds of the length -------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dim", [2, 3])
def test_cells_held_at_their_length_bound(dim, mode):
    """A row of cells, head on, between two hard walls that leave no room: their length cannot grow,
    and must not shrink.

    With little drag on the length, growth is what gives way first, so that the bound Δl ≥ −growth
    is met.
    """
    cells = scattered(dim, 3)
    position = torch.zeros(3, dim, dtype=F64)
    position[:, 0] = torch.tensor([-2.9, 0.05, 2.85], dtype=F64)
    position[:, 1] = torch.tensor([0.02, -0.03, 0.01], dtype=F64)
    axis = torch.zeros(3, dim, dtype=F64)
    axis[:, 0], axis[:, 1] = 1.0, torch.tensor([0.05, -0.04, 0.03], dtype=F64)
    cells = tf.Cells(position, axis, [2.0, 2.1, 1.95])
    walls = [tf.Plane(x=-4.3, facing="+x"), tf.Plane(x=4.25, facing="-x")]
    held = []

    def experiment(rate):
        # stiffer, so solved further
        effect = mechanics(
            dim, walls=walls, length_drag=0.2, alpha=0.02, passes=1, tolerance=1e-12, **mode
        )
        scene = tf.Scene(tf.Growth(rate=rate), effect, founders=cells)
        state = run(scene, seeded(scene), steps=2)
        # one-sided contacts may take a twentieth of the growth of a step, 0.05 h long
        bound = 0.0 if mode["contacts"] == "bilateral" else -SHRINK * 0.05 * float(rate.detach())
        share = state.elongation / (state.length - state.elongation)
        held.append(int((share <= bound * (1 - 1e-3) + 1e-9).sum()))
        return run(scene, state, steps=2)  # some cells leave their bound again

    check(experiment, 0.8)
    assert min(held) > 0, "no cell was held at its bound: the comparison would prove nothing"


# --- geometry -------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", ["position", "axis", "length", "radius"])
def test_first_geometry(dim, name):
    """Where the cells start, how they lie, how long and how thick they are: contact geometry passes
    gradients."""
    scene = growing(dim, torch.tensor(0.5, dtype=F64))
    first = seeded(scene)

    def experiment(value):
        state = first.replace(**{name: value})
        if name == "axis":
            state = first.replace(axis=value / (value * value).sum(1, keepdim=True).sqrt())
        return run(scene, state, steps=4)

    check(experiment, getattr(first, name).tolist())


def test_side_by_side_where_one_row_becomes_two():
    """Cells almost parallel, in the range in which the contact slides from a line to a point."""
    cells = tf.Cells([[0.0, 0.0], [0.4, 0.94]], [[1.0, 0.0], [1.0, 0.06]], [2.0, 2.2])

    def experiment(rate):
        scene = tf.Scene(tf.Growth(rate=rate), mechanics(2), founders=cells)
        return run(scene, seeded(scene))

    check(experiment, 0.8)


# --- rules ----------------------------------------------------------------------------------------


def test_a_parameter_of_a_rule():
    def experiment(gain):
        def update(cells):
            cells.growth_rate = gain * (1 + 0.3 * torch.sin(cells.position[:, 1].to(F64)))

        scene = tf.Scene(
            tf.Rules(update),
            tf.Growth(),
            tf.Division(length=2.4),
            mechanics(2),
            founders=scattered(2),
        )
        return run(scene, seeded(scene), steps=10)

    check(experiment, 0.8, divides=True)


def test_a_parameter_of_a_divide_rule():
    """What the rule gives the daughters decides how they grow."""

    def experiment(gain):
        def divide(parent, daughter1, daughter2):
            daughter1.growth_rate = parent.growth_rate * gain
            daughter2.growth_rate = parent.growth_rate * (2 - gain)

        scene = tf.Scene(
            tf.Rules(divide=divide),
            tf.Growth(rate=0.8),
            tf.Division(length=2.4),
            mechanics(2),
            founders=scattered(2),
        )
        return run(scene, seeded(scene), steps=10)

    check(experiment, 0.7, divides=True)


# --- using it -------------------------------------------------------------------------------------


def test_one_scene_serves_many_backward_passes():
    """A search goes on with the same scene: a second run and backward pass give the same gradient
    as the first."""
    y = torch.tensor(-0.55, dtype=F64, requires_grad=True)
    rate = torch.tensor(0.5, dtype=F64, requires_grad=True)
    scene = growing(2, rate, walls=[tf.Plane(y=y, facing="+y")])
    first, second = (
        torch.autograd.grad(outcome(run(scene, seeded(scene))), (rate, y)) for _ in range(2)
    )
    assert [float(g) for g in first] == [float(g) for g in second]


def test_a_parameter_changed_in_place_changes_the_run():
    """An optimiser moves its parameters in place; a scene that holds them must follow, walls
    included."""
    for name in ("rate", "y"):
        given = {"rate": torch.tensor(0.5, dtype=F64), "y": torch.tensor(-0.55, dtype=F64)}
        scene = growing(2, given["rate"], walls=[tf.Plane(y=given["y"], facing="+y")])
        given[name] += 0.05
        fresh = growing(2, given["rate"], walls=[tf.Plane(y=given["y"], facing="+y")])
        assert torch.equal(
            run(scene, seeded(scene)).position, run(fresh, seeded(fresh)).position
        ), name


def test_simulate_passes_gradients():
    rate = torch.tensor(0.8, dtype=F64, requires_grad=True)
    scene = growing(2, rate, tf.Division(length=2.4))
    state = list(tf.simulate(scene, seeded(scene), until=0.4, dt=0.05))[-1]
    (gradient,) = torch.autograd.grad(outcome(state), rate)
    (by_hand,) = torch.autograd.grad(outcome(run(scene, seeded(scene))), rate)
    assert float(gradient) == pytest.approx(float(by_hand), rel=1e-12)


def test_gradients_in_float32():
    """To what single precision allows: the solve at 1e-4, over 8 steps."""
    found = []
    for dtype, tolerance in ((torch.float32, 1e-5), (F64, 1e-10)):
        rate = torch.tensor(0.8, dtype=dtype, requires_grad=True)
        scene = growing(2, rate, tolerance=tolerance)
        state = run(scene, scene.bind(dtype=dtype).start())
        found.append(float(torch.autograd.grad(outcome(state), rate)[0]))
    assert found[0] == pytest.approx(found[1], rel=1e-2)


@pytest.mark.parametrize("mode", MODES)
def test_no_graph_is_built_when_nothing_asks_for_one(mode):
    scene = growing(
        2, torch.tensor(0.8, dtype=F64), tf.Division(length=2.4), walls=between_walls(2), **mode
    )
    state = run(scene, seeded(scene), steps=10)
    assert state.cells > 5
    for name in ("position", "axis", "length", "radius", *state.fields):
        value = getattr(state, name)
        assert not value.requires_grad and value.grad_fn is None, name


def test_no_graph_is_built_under_no_grad():
    rate = torch.tensor(0.8, dtype=F64, requires_grad=True)
    scene = growing(2, rate, tf.Division(length=2.4))
    with torch.no_grad():
        state = run(scene, seeded(scene), steps=10)
    assert not state.position.requires_grad and not state.length.requires_grad


def test_asking_for_gradients_does_not_change_the_run():
    """The same cells and the same contacts; only the last bits may differ, the sums being taken by
    other operators."""
    plain, asked = torch.tensor(0.8, dtype=F64), torch.tensor(0.8, dtype=F64, requires_grad=True)
    states = [
        run(scene := growing(2, rate, tf.Division(length=2.4)), seeded(scene), steps=10)
        for rate in (plain, asked)
    ]
    assert torch.equal(states[0].uid, states[1].uid)
    # solved to 1e-10 of moves of 0.1 µm, ten times
    assert torch.allclose(states[0].position, states[1].position.detach(), rtol=0, atol=1e-9)


def test_a_gradient_through_a_loose_solve_is_not_taken_in_silence():
    """The warning comes above the tolerance that it names. Without a gradient there is nothing to
    say."""

    def grown(rate, **given):
        scene = tf.Scene(
            tf.Growth(rate=rate), tf.Division(length=2.5), tf.Mechanics(dim=2, **given), dt=0.05
        )
        *_, end = tf.simulate(scene, scene.bind().start(), cells=4)
        return end

    rate = torch.tensor(1.0, requires_grad=True)
    grown(1.0)
    with torch.no_grad():
        grown(rate)
    for contacts, most in (("one-sided", 1e-5), ("bilateral", 1e-6)):
        given = {"contacts": contacts, "length_drag": 10.0}
        assert grown(rate, tolerance=most, **given).position.requires_grad
        for loose in (1.1 * most, 0.02):
            words = rf"solved to {loose:g} only.*wrong sign.*tolerance of {most:g} or less"
            with pytest.warns(RuntimeWarning, match=words):
                grown(rate, tolerance=loose, **given)


@pytest.mark.parametrize("contacts", ["one-sided", "bilateral"])
def test_the_warning_of_a_loose_solve_comes_once_and_points_at_the_users_line(contacts):
    """Even where Python is asked for every warning: in a run, in a rollout, whose steps are
    computed again on the way back, and where the user steps by hand."""
    rate = torch.tensor(1.0, requires_grad=True)
    cells = tf.Cells([[0.0, 0.0], [2.9, 0.1]], [[1.0, 0.0]] * 2)
    scene = tf.Scene(
        tf.Growth(rate=rate),
        tf.Mechanics(dim=2, contacts=contacts, length_drag=10.0),
        founders=cells,
        dt=0.05,
    )

    def simulated():
        *_, end = tf.simulate(scene, until=0.2)
        return end

    def stepped():
        model = scene.bind()
        state = model.start()
        for _ in range(4):
            state = model.step(state)
        return state

    for grown in (simulated, stepped, lambda: tf.rollout(scene, until=0.2, segment=2)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            grown().length.sum().backward()
        assert [(w.category, w.filename) for w in caught] == [(RuntimeWarning, __file__)]
        assert "solved to" in str(caught[0].message)


def one_gene(u, s, p, cell):
    return {"r": p.k / (1 + u.r**2) - u.r}


@pytest.mark.parametrize(
    "effects, words",
    [
        (lambda x: [tf.Growth(rate=x), tf.Mechanics(dim=2, tolerance=1e-8)], "contacts"),
        (lambda x: [tf.Circuit(one_gene, species="r", k=x)], "the stiff method of circuits"),
    ],
)
def test_second_derivatives_are_refused_where_they_would_be_wrong(effects, words):
    x = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    cells = tf.Cells([[0.0, 0.0], [3.1, 0.0]], [[1.0, 0.0]] * 2, 2.0)
    scene = tf.Scene(*effects(x), founders=cells, dim=2)
    end = tf.rollout(scene, scene.bind(dtype=torch.float64).start(), until=0.1)
    loss = (
        end.length.sum() + end.position.square().sum() + sum(v.sum() for v in end.fields.values())
    )
    with pytest.raises(RuntimeError, match=f"no second derivatives through {words}"):
        torch.autograd.grad(loss, x, create_graph=True)


def test_second_derivatives_through_equal_steps_are_right():
    def slope(k, again=False):
        k = torch.tensor(k, dtype=torch.float64, requires_grad=True)
        scene = tf.Scene(tf.Circuit(one_gene, species="r", k=k, method="heun2"), dim=2)
        end = tf.rollout(scene, scene.bind(dtype=torch.float64).start(), until=0.2)
        return k, torch.autograd.grad(end.r.square().sum(), k, create_graph=again)[0]

    k, first = slope(2.0, again=True)
    second = torch.autograd.grad(first, k)[0]
    differences = (slope(2.0 + 1e-4)[1] - slope(2.0 - 1e-4)[1]) / 2e-4
    assert float(second) == pytest.approx(float(differences), rel=1e-6)
    assert abs(float(second)) > 1e-3


def test_a_rate_laid_without_gradients_carries_none():
    """A view that is made in no_grad would say that it requires one, and hold a dead graph."""
    rate = torch.tensor(1.0, dtype=F64, requires_grad=True)
    model = tf.Scene(tf.Growth(rate=rate), dim=2, dt=0.05).bind(dtype=F64)
    with torch.no_grad():
        state = model.start()
    assert not model.step(state).length.requires_grad
    (slope,) = torch.autograd.grad(model.step(model.start()).length.sum(), rate)
    assert slope > 0
    with torch.no_grad(), forward_mode():
        dual = forward_ad.make_dual(rate, torch.ones_like(rate))
        model = tf.Scene(tf.Growth(rate=dual), dim=2, dt=0.05).bind(dtype=F64)
        assert float(tangent(model.step(model.start()).length).sum()) == pytest.approx(float(slope))


def tracked(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=F64, requires_grad=True)


def test_numbers_that_require_gradients_are_described_without_a_warning():
    """Of torch, which warns where such a number becomes one of Python's, once in a process."""
    box = {"box": ((-8, -8), (8, 8)), "spacing": 4.0}
    a = tf.Signal(diffusion=tracked(10.0), decay=tracked(1.0), source=tracked(1.0))
    food = tf.Signal(diffusion=tracked(10.0), initial=tracked(1.0))
    inside = tf.Removal(low=(tracked(-torch.inf), -10.0), high=(tracked(10.0), 10.0))
    scenes = (
        lambda: tf.Scene(tf.Growth(rate=tracked(1.0)), tf.Medium(a=a, **box), inside, dim=2),
        lambda: tf.Scene(tf.Growth(), tf.Monod("food"), tf.Medium(food=food, **box), dim=2),
    )
    always = torch.is_warn_always_enabled()
    torch.set_warn_always(True)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="Converting a tensor with requires_grad")
            for scene in scenes:
                assert "diffusion" in tf.explain(scene())
                assert scene().bind(dtype=F64).start().cells == 1
    finally:
        torch.set_warn_always(always)
