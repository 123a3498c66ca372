"""Uptake and transport of a nutrient, which are solved together."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from exchanging_cells import BOX, F64, advance, diffused
from helpers import step
from scipy.integrate import solve_ivp

import torchfilm as tf
from torchfilm.signals.exchange import read, stencil
from torchfilm.tools.tangents import forward_mode, tangent, with_tangent

DT = 0.05
FOUR = tf.Cells([[0.0, 0.0], [3.0, 1.0], [-2.0, 4.0], [1.0, -5.0]], [[1.0, 0.0]] * 4, 2.0)
CROWD = tf.Cells(
    [[4.0 * (k % 6) - 10.0, 4.0 * (k // 6) - 10.0] for k in range(36)], [[1.0, 0.0]] * 36, 1.0
)
FACE = tf.Dirichlet(1.0)
FED = tf.BoundaryConditions(x=(FACE, FACE), y=(FACE, FACE))


def scene(
    *more: tf.Effect, diffusion=30.0, rate=1.0, half=0.3, growth_yield=0.2, cells=FOUR, **medium
) -> tf.Scene:
    signals = {"food": tf.Signal(diffusion, initial=lambda at: 1.0 + 0.01 * at[:, 0])}
    signals |= {"ahl": tf.Signal(20.0)} if more else {}
    return tf.Scene(
        tf.Monod("food", rate=rate, half=half, growth_yield=growth_yield),
        tf.Growth(),
        *more,
        tf.Medium(**signals, **{"box": BOX, "spacing": 4.0, **medium}),
        founders=cells,
    )


def given(u, s, p, cell):
    return {"ahl": 1.0 - u.ahl}, {"ahl": 0.5 * u.ahl}


def reading(u, s, p, cell):
    return {"ahl": s.food - u.ahl}


def food(state: tf.State) -> float:
    return float(state.fields["out.food"].double().sum()) * state.layout.grid.voxel_volume


def stencil_of(state: tf.State):
    return stencil(state.layout.grid, state.position_3d, state.colony)


def exact(state: tf.State, diffusion: float, half: float, growth_yield: float, hours: float):
    """Volumes and field after so many hours, by an implicit integrator at 1e-10, in a box whose
    faces let nothing pass: voxels and volumes in one system of equations."""
    grid = state.layout.grid
    nx, ny, nz = grid.shapes[0]
    at = stencil_of(state)
    node, weight = at.node.numpy(), at.weight.double().numpy()
    count, step_size = len(state.volume), grid.spacing[0]

    def rates(t, y):
        field, volume = y[:-count].reshape(nx, ny, nz), y[-count:]
        change = diffused(field, diffusion / step_size**2)
        here = (weight * y[:-count][node]).sum(1)
        growth = here / (half + here) * volume
        # as `exchange.write` shares what cells take: by what each voxel has
        share = weight * y[:-count][node] / here[:, None]
        np.subtract.at(change, node, share * (growth / growth_yield / grid.voxel_volume)[:, None])
        return np.concatenate([change, growth])

    start = np.concatenate([state.fields["out.food"].numpy(), state.volume.numpy()])
    found = solve_ivp(rates, (0, hours), start, method="LSODA", rtol=1e-10, atol=1e-13)
    return found.y[-count:, -1], found.y[:-count, -1]


@pytest.mark.parametrize(
    ("diffusion", "half", "growth_yield"),
    [(0.0, 0.3, 0.2), (10.0, 0.1, 0.02), (100.0, 0.3, 0.2), (1e3, 0.1, 0.02)],
)
def test_order_two_where_the_series_carries(diffusion, half, growth_yield):
    """Against one system of equations of voxels and cells: a step half as long has a quarter of the
    error, where cells take up to the whole content of voxels in a step."""
    errors = []
    for parts in (8, 16, 32):
        made = scene(diffusion=diffusion, half=half, growth_yield=growth_yield)
        first = made.bind(dtype=F64).start()
        state = advance(made, first, parts, 0.4 / parts)
        volume, field = exact(first, diffusion, half, growth_yield, 0.4)
        errors.append(
            max(
                np.abs(state.volume.numpy() / volume - 1).max(),
                np.abs(state.fields["out.food"].numpy() - field).max(),
            )
        )
    assert errors[0] < 1e-2
    assert errors[2] < errors[1] / 2.5 < errors[0] / 6


@pytest.mark.parametrize("diffusion", [1e4, 1e6])
def test_backward_euler_where_diffusion_is_fast(diffusion):
    """Then the field follows cells at once, and what is left of the error is that of growth."""
    made = scene(diffusion=diffusion, half=0.1, growth_yield=0.02)
    first = made.bind(dtype=F64).start()
    state = advance(made, first, 8, 0.05)
    volume, field = exact(first, diffusion, 0.1, 0.02, 0.4)
    np.testing.assert_allclose(state.volume.numpy(), volume, rtol=1e-3)
    np.testing.assert_allclose(state.fields["out.food"].numpy(), field, rtol=5e-3)


@pytest.mark.parametrize("steps", [1, 4])
def test_parts_of_a_step_are_steps_of_the_scene(steps):
    """Of cells that nothing moves: growth over a step is the product of that over its parts."""
    often, short = scene(steps=steps), scene()
    once = advance(often, often.bind(dtype=F64).start(), 3, DT)
    each = advance(short, short.bind(dtype=F64).start(), 3 * steps, DT / steps)
    for name in ("out.food", "food_eaten"):
        torch.testing.assert_close(once.fields[name], each.fields[name], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(once.volume, each.volume, rtol=1e-9, atol=0.0)
    both = [s.reports["nutrition"].uptake for s in (once, each)]
    assert float(both[0]) == pytest.approx(steps * float(both[1]), rel=0.02)


@pytest.mark.parametrize("diffusion", [0.0, 30.0, 1e6])
@pytest.mark.parametrize("circuit", [(), (tf.Circuit(given, species="ahl"),)])
def test_what_grows_is_what_the_medium_loses(diffusion, circuit):
    """Also where a step is one of backward Euler, by the tolerance of its solve."""
    made = scene(*circuit, diffusion=diffusion, growth_yield=0.05, steps=2)
    start = made.bind(dtype=F64).start()
    end = advance(made, start, 6, DT)
    grown = float((end.volume.double() - start.volume.double()).sum())
    assert grown == pytest.approx(0.05 * (food(start) - food(end)), rel=1e-8) and grown > 1.0
    assert float(end.fields["out.food"].min()) >= 0


def test_fast_diffusion_feeds_a_cell_at_the_law():
    """A cell in a medium that diffusion keeps at 1 grows at rate · 1/(1 + half) = 1/1.1, though it
    would empty the voxels about it 7 times in a step."""
    made = scene(
        diffusion=1e6, half=0.1, growth_yield=1e-4, cells=tf.Cells.single(2),
        box=((-8.0, -8.0), (8.0, 8.0)), depth=1.0, boundary=FED,
    )  # fmt: skip
    state = made.bind(dtype=F64).start()
    assert float(step(made, state, 0.025).growth_rate) == pytest.approx(1 / 1.1, rel=1e-3)


@pytest.mark.parametrize("diffusion", [0.0, 10.0, 1e3, 1e5])
@pytest.mark.parametrize("half", [1e-3, 0.1])
@pytest.mark.parametrize("boundary", [None, FED])
@pytest.mark.parametrize("backend", [None, "torch"])
def test_hungry_crowds_converge(diffusion, half, boundary, backend):
    """36 cells that would take all there is many times in a step: the solve converges, in less than
    half of its iterations, and leaves nothing below 0. What is eaten is what was lost."""
    made = scene(
        diffusion=diffusion, half=half, growth_yield=1e-3, cells=CROWD, boundary=boundary,
        depth=1.0, backend=backend,
    )  # fmt: skip
    state = made.bind().start()
    if boundary is None:
        last = advance(made, made.bind(dtype=F64).start(), 2, DT)
        lost = food(made.bind(dtype=F64).start()) - food(last)
        assert float(last.food_eaten.sum()) == pytest.approx(lost, rel=1e-8)
    for _ in range(3):
        state = step(made, state, DT)
        note = state.reports["nutrition"]
        assert not note.status.any() and int(note.iterations) < 50
        assert float(state.fields["out.food"].min()) >= 0


@pytest.mark.parametrize("diffusion", [30.0, 1e5])
def test_a_restart_and_a_batch_have_the_same_bits(diffusion):
    made = scene(tf.Circuit(given, species="ahl"), diffusion=diffusion, steps=3)
    alone = advance(made, made.bind(streams=[1]).start(), 6, DT)
    batch = made.bind(3)
    both = advance(made, batch.start(), 3, DT)
    both = advance(made, both, 3, DT)
    mine = both.colony == 1
    assert torch.equal(both.volume[mine], alone.volume)
    assert torch.equal(both.fields["out.food"].view(3, -1)[1], alone.fields["out.food"])


@pytest.mark.parametrize("diffusion", [30.0, 1e5])
@pytest.mark.parametrize("backend", [None, "torch"])
def test_a_colony_without_cells_beside_others(diffusion, backend):
    """Its nutrient moves as it would alone, and the others eat as without it."""
    where = [[0.0, 0.0], [3.0, 1.0]]
    made = scene(diffusion=diffusion, backend=backend)
    both = made.bind(2, cells=tf.Cells(where, [[1.0, 0.0]] * 2, 2.0, colony=[1, 1])).start()
    end = step(made, both, DT)
    for colony in (0, 1):
        alone = step(made, both.select([colony]), DT)
        mine = end.fields["out.food"].view(2, -1)[colony]
        assert torch.equal(mine, alone.fields["out.food"])


@pytest.mark.parametrize("diffusion", [30.0, 1e5])
def test_a_gradient(diffusion):
    """dV/d rate, by the other values of Monod, and by diffusion, agree with central differences."""
    values = torch.tensor([1.0, 0.3, 0.2, diffusion], dtype=F64)

    def volume(x: torch.Tensor) -> torch.Tensor:
        rate, half, gain, moved = (x[k : k + 1] for k in range(4))
        made = scene(rate=rate, half=half, growth_yield=gain, diffusion=moved)
        state = made.bind(1, dtype=F64).start()
        return step(made, step(made, state, DT), DT).volume.sum()

    given = values.clone().requires_grad_()
    (slope,) = torch.autograd.grad(volume(given), given)
    for k in range(4):
        h = 1e-4 * values * torch.eye(4, dtype=F64)[k]
        difference = (volume(values + h) - volume(values - h)) / (2 * h[k])
        # by diffusion it is some 1e-8 of the volume
        assert float(slope[k]) == pytest.approx(float(difference), rel=1e-3 if k == 3 else 1e-5)


@pytest.mark.parametrize("diffusion", [30.0, 1e5])
def test_a_tangent_is_the_gradient(diffusion):
    """In forward mode, as a search with derivatives takes it; second derivatives are refused."""
    rate = torch.tensor([1.0], dtype=F64)

    def volume(x: torch.Tensor) -> torch.Tensor:
        made = scene(rate=x, growth_yield=0.02, diffusion=diffusion)
        return step(made, made.bind(1, dtype=F64).start(), DT).volume.sum()

    given = rate.clone().requires_grad_()
    (slope,) = torch.autograd.grad(volume(given), given)
    with forward_mode():
        moved = tangent(volume(with_tangent(rate, torch.ones_like(rate))))
    assert float(moved) == pytest.approx(float(slope), rel=1e-6)
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(volume(given), given, create_graph=True)


def test_circuits_find_the_nutrient_after_uptake_and_transport():
    """A circuit that reads it changes nothing of it."""
    plain, read = scene(), scene(tf.Circuit(reading, species="ahl"))
    ends = [advance(s, s.bind(dtype=F64).start(), 3, DT) for s in (plain, read)]
    assert torch.equal(ends[0].fields["out.food"], ends[1].fields["out.food"])
    assert float(ends[1].fields["ahl"].max()) > 0


def test_a_nutrient_that_is_used_up():
    """Cells grow by what there was, and not beyond."""
    made = scene(diffusion=1e3, half=0.01, growth_yield=0.2)
    start = made.bind(dtype=F64).start()
    state = advance(made, start, 60, 0.1)
    assert food(state) < 1e-3 * food(start) and float(state.growth_rate.max()) < 0.05


@pytest.mark.parametrize("backend", [None, "torch"])
@pytest.mark.parametrize("flow", [None, (1.0, 0.0)])
def test_what_is_left_may_be_next_to_no_number(backend, flow):
    """Squares of what is left lie below all numbers, which once counted as no convergence."""
    made = scene(diffusion=2e6, half=1e-3, growth_yield=1e-3, flow=flow, backend=backend)
    state = advance(made, made.bind(dtype=F64).start(), 1, 0.05)
    left = state.with_fields(**{"out.food": state.fields["out.food"] * 1e-150})
    again = advance(made, left, 4, 0.05)
    assert 0.0 <= float(again.signals["food"].max()) <= 1e-150


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("backend", [None, "torch"])
def test_food_without_limit(dtype, backend):
    """Where nothing moves, and nobody makes a difference to it, cells grow by the law all the
    same."""
    made = scene(diffusion=0.0, growth_yield=1e20, backend=backend)
    state = step(made, made.bind(dtype=dtype).start(), 0.01)
    found = read(state.fields["out.food"].double(), stencil_of(state))
    wanted = found / (0.3 + found)
    torch.testing.assert_close(state.growth_rate.double(), wanted, rtol=1e-5, atol=0.0)


class Decay:
    """A function of positions that holds a tensor."""

    def __init__(self, rate: torch.Tensor):
        self.rate = rate

    def __call__(self, at: torch.Tensor) -> torch.Tensor:
        return self.rate * torch.ones(len(at), dtype=at.dtype)


@pytest.mark.parametrize("name", ["decay", "source"])
def test_two_backward_passes_through_a_function_that_holds_a_tensor(name):
    rate = torch.tensor(0.5, dtype=F64, requires_grad=True)
    signal = tf.Signal(30.0, initial=1.0, **{name: Decay(rate)})
    made = tf.Scene(
        tf.Monod("food", half=0.3, growth_yield=0.2), tf.Growth(),
        tf.Medium(food=signal, box=BOX, spacing=4.0), founders=FOUR,
    )  # fmt: skip
    first = made.bind(1, dtype=F64).start()
    slopes = [torch.autograd.grad(step(made, first, DT).volume.sum(), rate)[0] for _ in range(2)]
    assert torch.equal(*slopes) and float(slopes[0]) != 0


def test_explain_says_how_the_nutrient_moves():
    slow, fast = tf.scenes.nutrient_limited(), tf.scenes.nutrient_limited(diffusion=2e6)
    said = [str(tf.explain(s)) for s in (slow, fast)]
    assert "by a series, order 2" in said[0] and "by backward Euler, order 1" in said[1]
    assert all("moved together with nutrition" in x for x in said)


@pytest.mark.parametrize("wanted", [20.0, 40.0])
def test_how_deep_a_nutrient_reaches_into_a_dense_layer(wanted):
    """Cells that take q conc/h until nothing is left, fed at one face: the steady concentration is
    (1 − x/L)² with L = √(2 K s/q), as of oxygen in films, in steps many times longer than the
    nutrient takes to get there."""
    rate, diffusion, spacing = 1e-4, 1e6, 2.0
    where = [[spacing * (i + 0.5), spacing * (j + 0.5)] for i in range(30) for j in range(2)]
    cells = tf.Cells(where, [[1.0, 0.0]] * len(where), length=0.1)
    volume = float(tf.Scene(tf.Growth(), founders=cells).bind(dtype=F64).start().volume[0])
    uptake = 2 * diffusion / wanted**2  # conc/h
    made = tf.Scene(
        tf.Monod("food", rate=rate, half=1e-4,
                 growth_yield=rate * volume / (uptake * spacing**2 * 1.0)),
        tf.Growth(),
        tf.Medium(
            food=tf.Signal(diffusion, initial=1.0), box=((0.0, 0.0), (60.0, 4.0)),
            spacing=spacing, depth=1.0, boundary=tf.BoundaryConditions(x=(FACE, tf.NoFlux())),
        ),
        founders=cells,
    )  # fmt: skip
    state = advance(made, made.bind(dtype=F64).start(), 4, 0.1)
    found = state.fields["out.food"].view(30, 2)[:, 0]
    at = spacing * (torch.arange(30, dtype=F64) + 0.5)
    theory = (1 - at / wanted).clamp(min=0.0) ** 2
    # voxels are a tenth or a twentieth of L wide
    assert float((found - theory).abs().max()) < 0.2 * spacing / wanted
    fed = at < wanted - 2 * spacing
    growth = state.growth_rate.view(30, 2)[:, 0]
    assert float(growth[fed].min()) > 0.9 * rate
    assert float(growth[at > wanted + 2 * spacing].max()) < 0.1 * rate


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_source_feeds_each_colony_at_its_own_rate_of_exchange(backend):
    """With others whose nutrient diffuses faster, which need more terms of the series, as alone."""

    def fed(diffusion, **batch):
        food = tf.Signal(diffusion=diffusion, decay=0.1, initial=0.1, source=0.5)
        medium = tf.Medium(
            food=food, box=((-8, -8), (8, 8)), spacing=2.0, depth=1.0, backend=backend
        )
        scene = tf.Scene(tf.Monod("food", rate=1.0, half=0.3), tf.Growth(), medium, dim=2)
        model = scene.bind(dtype=F64, **batch)
        state = model.start()
        for _ in range(3):
            state = model.step(state, 0.05)
        return state

    own = [400.0, 1.0, 40.0]
    together = fed(own)
    for k, diffusion in enumerate(own):
        alone, mine = fed([diffusion], streams=[k]), together.select([k])
        for name in ("out.food", "food_eaten"):
            torch.testing.assert_close(mine.fields[name], alone.fields[name], rtol=1e-12, atol=0)


def on_food(growth: tf.Growth, rate: float = 1.0, **extra) -> tf.Scene:
    first = tf.Cells([[0.0, 0.0], [3.0, 0.0]], [[1.0, 0.0]] * 2, length=2.0, extra=extra)
    food = tf.Medium(food=tf.Signal(5.0, initial=1.0), box=((-10, -10), (10, 10)), spacing=2.0)
    return tf.Scene(growth, tf.Monod("food", rate=rate), food, founders=first, dim=2)


@pytest.mark.parametrize("growth", [tf.Growth(), tf.Growth(rate=0.0), tf.Growth(rate=[0.0, 0.0])])
def test_growth_without_a_rate_begins_with_that_of_the_food(growth):
    model = on_food(growth).bind(2)
    state = model.start()
    assert torch.allclose(state.growth_rate, torch.full_like(state.growth_rate, 0.5))
    assert torch.equal(model.step(state, 0.0).growth_rate, state.growth_rate)


@pytest.mark.parametrize(
    "scene", [on_food(tf.Growth(), growth_rate=[0.7, 0.9]), on_food(tf.Growth(rate=1.0))]
)
def test_rates_that_would_be_overwritten_are_refused(scene):
    with pytest.raises(tf.InputError, match=r"Growth has a rate of its own, or the founders"):
        scene.bind()


def test_a_scene_with_another_rate_takes_over():
    state = tf.simulate(on_food(tf.Growth()), until=0.1).last()
    taken = on_food(tf.Growth(), rate=2.0).take_over(state)
    assert torch.allclose(taken.growth_rate, 2.0 * state.growth_rate, rtol=0.02)
