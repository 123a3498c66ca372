"""Contact steps of whole scenes: what cells do that push each other, of both kinds of contacts."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import array, crowd, growth, mechanics, pair_gaps, seeded, step
from scipy.integrate import solve_ivp

import torchfilm as tf
from torchfilm.kernels.scheme import SHRINK
from torchfilm.physics.problem import CONVERGED, NOT_FINITE

CONTACTS = pytest.mark.parametrize("contacts", ["bilateral", "one-sided"])
X, Y, Z = np.eye(3)


@CONTACTS
@pytest.mark.parametrize(
    "apart, tilt",
    [(1.9, 0.02), (1.9, 0.05), (1.9, 0.2), (1.7, 0.02), (1.7, 0.2), (1.5, 0.02), (1.5, 0.05)],
)
def test_a_cell_squeezed_between_two_comes_to_rest(apart, tilt, contacts):
    """A cell between two almost fixed cells, which overlaps them at opposite ends at any angle.

    A bilateral solve with only these ends would turn it as far to the other side in each step.
    Instead the cell comes to rest between the two, except for the tilt that a tolerance of 0.01 per
    step leaves. Between one-sided contacts the angle stops changing, at 0.01 at most: there the
    overlaps of the ends, 0.7 µm from the centre, differ by the 0.007 µm that contacts leave.
    """
    cells = tf.Cells(
        [[0.0, -apart / 2], [0.1, 0.0], [0.0, apart / 2]],
        [[1.0, 0.0], [math.cos(tilt), math.sin(tilt)], [1.0, 0.0]],
        [4.0, 1.4, 4.0],
        [0.5] * 3,
        extra={"drag": [1e3, 1.0, 1e3]},
    )
    of_kind = {"length_drag": 10.0} if contacts == "bilateral" else {}
    scene = tf.Scene(
        tf.Mechanics(dim=2, tolerance=0.01, contacts=contacts, **of_kind), founders=cells
    )
    state, angles = scene.bind(dtype=torch.float64).start(), []
    for _ in range(30):
        state = step(scene, state, 0.025)
        angles.append(float(torch.atan2(state.axis[1, 1], state.axis[1, 0])))
    last = angles[-5:]
    if contacts == "bilateral":
        assert max(map(abs, angles)) < max(tilt, 0.1) + 0.02 and max(map(abs, last)) < 1e-3, angles
    else:
        assert max(last) - min(last) <= 1e-9 and max(map(abs, last)) <= 0.01, angles


@CONTACTS
@pytest.mark.parametrize("dim", [2, 3])
def test_a_colony_does_not_push_or_turn_itself(device, dim, contacts):
    """Without walls Σ μL Δc = 0 and Σ (μL c × Δc + μL³/12 Δθ) = 0 after one solve, in float64.

    The tolerance of 1e-11 allows an error for sixty moves of 0.1 µm, drags of 3 and arms of 20 µm.
    """
    scene = tf.Scene(growth(), mechanics(dim=dim, contacts=contacts, passes=1, tolerance=1e-11))
    start = seeded(scene, crowd(np.random.default_rng(5), 60, dim), device, torch.float64)
    state = step(scene, start, 0.01)
    assert not (state.reports["mechanics"].clipped > 0).any()
    move = array(state.displacement)
    whole = array(start.length) * math.exp(0.01) + 1.0  # L at the time of the solve
    across, turning = whole[:, None], whole[:, None] ** 3 / 12
    force, c = across * move[:, :dim], array(start.position)
    arm = (c[:, :1] * force[:, 1:] - c[:, 1:] * force[:, :1]) if dim == 2 else np.cross(c, force)
    assert np.abs(move[:, :dim]).max() > 0.01
    assert np.abs(force.sum(0)).max() <= 1e-9
    assert np.abs((arm + turning * move[:, dim:-1]).sum(0)).max() <= 1e-8


@CONTACTS
@pytest.mark.parametrize("alpha", [0.1, 0.01])
def test_two_capsules_side_by_side(contacts, dtype, device, alpha):
    """Two side-by-side capsules, one solve: residual overlap fraction m/(2 + m), m = α μ L. 1e-4 is
    the solve's tolerance."""
    scene = tf.Scene(mechanics(alpha=alpha, passes=1, contacts=contacts))
    start = seeded(scene, tf.Cells([[0, 0, 0], [0, 0.9, 0]], [X, X], 2.0), device, dtype)
    pair = np.array([[0, 1]])
    m = alpha * 3.0
    left = pair_gaps(step(scene, start, 0.01), pair)[0] / pair_gaps(start, pair)[0]
    assert left == pytest.approx(m / (2 + m), abs=1e-4)


@CONTACTS
@pytest.mark.parametrize("dim", [2, 3])
def test_no_cell_ends_shorter_than_before_it_grew(contacts, dtype, device, dim):
    """Mechanics may prevent all growth: ten steps in a closed, full box. Bilateral contacts never
    shorten a cell; one-sided ones by no more than SHRINK of its free growth in the step.

    The prevented growth is length + e − e, which in float32 is exact to one unit in the last place,
    2.4e-7 at 2 to 4 µm.
    """
    walls = [tf.Box(low=(-0.6, -0.6, -0.6)[:dim], high=(17.0, 5.5, 5.5)[:dim])]
    scene = tf.Scene(growth(), mechanics(dim=dim, contacts=contacts, walls=walls, tolerance=1e-3))
    state = seeded(
        scene, crowd(np.random.default_rng(2), 36 if dim == 2 else 125, dim), device, dtype
    )
    part, held = SHRINK if contacts == "one-sided" else 0.0, 0
    for _ in range(10):
        before = state.length
        state = step(scene, state, 0.02)
        lost = (before - state.length).double() - part * before.double() * math.expm1(0.02)
        assert float(lost.max()) <= {torch.float32: 2.4e-7, torch.float64: 4.5e-16}[dtype]
        held += int((state.length - before < 1e-3 * before).sum())
        assert (
            float((state.length - before - state.elongation).abs().max())
            <= {torch.float32: 5e-7, torch.float64: 1e-15}[dtype]
        )
    assert held > 0


@CONTACTS
@pytest.mark.parametrize(
    "name, bad",
    [("position", "nan"), ("position", "inf"), ("axis", "nan"), ("axis", "inf"), ("length", "nan")],
)
def test_a_broken_colony_is_reported_and_harms_no_other(contacts, dtype, device, name, bad):
    """A colony with non-finite coordinates has the status NOT_FINITE.

    The other colonies converge and have the same bits as without it.
    """
    rng = np.random.default_rng(3)
    parts = [crowd(rng, n, 3) for n in (12, 9, 15)]
    join = lambda what: np.concatenate([getattr(p, what) for p in parts])
    scene = tf.Scene(growth(), mechanics(contacts=contacts))
    cells = tf.Cells(
        join("position"),
        join("axis"),
        join("length"),
        0.5,
        colony=np.repeat([0, 1, 2], [12, 9, 15]),
    )
    start = seeded(scene, cells, device, dtype)
    broken = getattr(start, name).clone()
    broken[15] = float(bad)
    state = step(scene, start.replace(**{name: broken}), 0.01)
    assert state.reports["mechanics"].status.tolist() == [CONVERGED, NOT_FINITE, CONVERGED]
    sound = step(scene, start.select([0, 2]), 0.01)
    assert torch.equal(
        sound.reports["mechanics"].iterations, state.reports["mechanics"].iterations[[0, 2]]
    )
    for what in ("position", "axis", "length", "displacement"):
        assert torch.equal(getattr(sound, what), getattr(state.select([0, 2]), what)), what


def test_the_driver_names_the_broken_colony(dtype, device):
    scene = tf.Scene(growth(), mechanics())
    start = seeded(
        scene, tf.Cells(np.zeros((3, 3)), [X, Y, Z], 2.0, colony=[0, 1, 2]), device, dtype
    )
    broken = start.position.clone()
    broken[1] = torch.nan
    start = start.replace(position=broken)
    with pytest.raises(tf.SimulationError, match="colony 1") as caught:
        list(tf.simulate(scene, start, until=0.01, dt=0.01))
    assert caught.value.colonies == (1,)
    state = list(tf.simulate(scene, start, until=0.02, dt=0.01, on_failure="drop"))[-1]
    assert state.counts.tolist() == [1, 0, 1]
    assert bool(torch.isfinite(state.position).all())


@CONTACTS
def test_gradient_through_the_solve(contacts):
    """Two overlapping cells and a wall: the gradient of the end positions by the adjoint.

    It is compared with differences of the whole step, in float64, solved to 1e-12; differences with
    h = 1e-5 are accurate to 1e-9.
    """
    scene = tf.Scene(
        mechanics(
            contacts=contacts, passes=1, tolerance=1e-12, walls=[tf.Plane(y=-0.45, facing="+y")]
        )
    )
    start = seeded(
        scene,
        tf.Cells([[0, 0, 0], [0.4, 0.8, 0.1]], [X, X + 0.3 * Y + 0.1 * Z], [2.0, 2.2]),
        torch.device("cpu"),
        torch.float64,
    )
    goal = torch.tensor(np.random.default_rng(4).normal(size=(2, 3)))

    def outcome(position, length):
        return (
            step(scene, start.replace(position=position, length=length), 0.01).position * goal
        ).sum()

    place, length = start.position.clone().requires_grad_(), start.length.clone().requires_grad_()
    by_place, by_length = torch.autograd.grad(outcome(place, length), (place, length))
    with torch.no_grad():
        for found, name in ((by_place, "position"), (by_length, "length")):
            for k in range(found.numel()):
                ends = []
                for h in (1e-5, -1e-5):
                    given = {"position": start.position.clone(), "length": start.length.clone()}
                    given[name].view(-1)[k] += h
                    ends.append(float(outcome(**given)))
                assert float(found.view(-1)[k]) == pytest.approx(
                    (ends[0] - ends[1]) / 2e-5, abs=1e-7
                ), (name, k)


@CONTACTS
@pytest.mark.parametrize("dt", [0.025, 0.00625])
def test_three_cells_in_a_row_push_as_rigid_ones_do(contacts, dt):
    """Forces f₁ and f₂ keep both gaps closed: d ẋ = ±f with the drag d = μ(l + 2r) of each cell,
    and γ(l̇ − g(l + 4r/3)) = −(the mean of what presses its ends). Bilateral solves that stopped at
    a worst residual of 0.05 lost 14 % of what the middle cell grows; at 0.005 they lose some 2 %,
    which is 0.8 % of its length."""

    def rates(t, y):
        drag, free = y[3:] + 1.0, y[3:] + 2 / 3
        # motion by each force, and what it takes off growth; a gap is x₂ − x₁ − (l₁ + l₂)/2 − 2r
        move = np.array([[-1, 0], [1, -1], [0, 1]]) / drag[:, None]
        longer = -np.array([[1, 0], [1, 1], [0, 1]]) / (2 * 10.0)
        of_gap = move[1:] - move[:-1] - (longer[:-1] + longer[1:]) / 2
        force = np.linalg.solve(of_gap, (free[:-1] + free[1:]) / 2)
        return np.concatenate([move @ force, free + longer @ force])

    x, length = [-3.0, 0.0, 3.5], [1.0, 3.0, 2.0]
    row = tf.Cells([[a, 0.0] for a in x], [[1.0, 0.0]] * 3, length, 0.5)
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Mechanics(dim=2, contacts=contacts, length_drag=10.0), founders=row
    )
    *_, state = tf.simulate(scene, until=0.5, dt=dt)
    right = solve_ivp(rates, (0.0, 0.5), [*x, *length], rtol=1e-9, atol=1e-9).y[3:, -1]
    assert array(state.length) == pytest.approx(right, rel=0.01)
