"""Monod growth: what cells gain is what the medium loses, the law where food is plenty and where it
is short, and what a scene refuses."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers import step
from ruled import same

import torchfilm as tf
from torchfilm.tools.checks import InputError

F64 = torch.float64
BOX = {"box": ((-8.0, -8.0), (8.0, 8.0)), "spacing": 2.0, "depth": 1.0}


def eating(
    monod: tf.Monod,
    *,
    initial: object = 1.0,
    diffusion: float = 10.0,
    cells: tf.Cells | None = None,
    more: tuple = (),
    **medium,
) -> tf.Scene:
    food = tf.Signal(diffusion=diffusion, initial=initial)
    return tf.Scene(
        monod,
        tf.Growth(),
        *more,
        tf.Medium(food=food, **{**BOX, **medium}),
        founders=cells or tf.Cells.single(2),
    )


def food(state: tf.State) -> torch.Tensor:
    """Amount in the medium of each colony, (B,) float64."""
    grid = state.layout.grid
    return (
        torch.zeros(state.colonies, dtype=F64, device=state.device).index_add(
            0, grid.owner, state.signals["food"].double()
        )
        * grid.voxel_volume
    )


def volumes(state: tf.State) -> torch.Tensor:
    return torch.zeros(state.colonies, dtype=F64, device=state.device).index_add(
        0, state.colony, state.volume.double()
    )


def advance(scene: tf.Scene, state: tf.State, steps: int, dt: float = 0.05) -> tf.State:
    for _ in range(steps):
        state = step(scene, state, dt)
        assert all(bool((r.status == 0).all()) for r in state.reports.values())
    return state


def pack(count: int = 12) -> tf.Cells:
    return tf.Cells(
        [[2.4 * (k % 3) - 2.0, 1.1 * (k // 3) - 2.0] for k in range(count)],
        [[1.0, 0.0]] * count,
        length=1.0,
    )


@pytest.mark.parametrize("growth_yield", [0.5, 2.0])
def test_what_cells_gain_is_what_the_medium_loses(growth_yield, dtype, device):
    """Volume made / yield = amount gone; each step rounds some five sums, of which food is the
    greater by five."""
    scene = eating(tf.Monod("food", rate=1.0, half=0.2, growth_yield=growth_yield), cells=pack())
    state = scene.bind(2, dtype=dtype, device=device).start()
    last = advance(scene, state, 20)
    gain, loss = volumes(last) - volumes(state), food(state) - food(last)
    assert float(gain.min()) > 1.0
    bound = 20 * 5 * torch.finfo(dtype).eps * float(food(state).max())
    assert float((gain / growth_yield - loss).abs().max()) <= bound
    eaten = torch.zeros(2, dtype=F64, device=device).index_add(
        0, last.colony, last.food_eaten.double()
    )
    assert float((eaten - loss).abs().max()) <= bound
    assert torch.equal(
        last.reports["nutrition"].uptake > 0, torch.ones(2, dtype=torch.bool, device=device)
    )


def test_with_food_in_plenty_growth_is_exponential():
    """s stays at 1 to a part 1e-6 and half = 1: dV/dt = V·rate/2, to the tolerance of the
    solver."""
    scene = eating(tf.Monod("food", rate=1.0, half=1.0, growth_yield=1e7))
    state = scene.bind(dtype=F64).start()
    last = advance(scene, state, 20)
    assert float(last.volume / state.volume) == pytest.approx(math.exp(0.5), rel=1e-5)
    assert float(last.growth_rate) == pytest.approx(0.5, rel=1e-5)


@pytest.mark.parametrize("supply", [1e2, 1e4, 1e6])
def test_abundance_does_not_drown_what_is_eaten(dtype, supply):
    """In float32 a cell's meal is less than the last bit of a rich medium: growth must not be read
    off the difference."""
    scene = eating(tf.Monod("food", rate=1.0, half=0.1), initial=supply)
    last = step(scene, scene.bind(dtype=dtype).start(), 0.025)
    assert float(last.growth_rate) == pytest.approx(supply / (0.1 + supply), rel=1e-4)


@pytest.mark.parametrize("half", [0.1, 1.0, 10.0])
def test_growth_follows_monod(half):
    scene = eating(
        tf.Monod("food", rate=[1.0, 1.0, 2.0], half=half, growth_yield=1e7), initial=[1.0, 0.2, 0.2]
    )
    last = step(scene, scene.bind(3, dtype=F64).start(), 1e-4)
    wanted = [r * s / (half + s) for r, s in ((1.0, 1.0), (1.0, 0.2), (2.0, 0.2))]
    # over a step of 1e-4 h the volume grows by that much
    assert last.growth_rate.tolist() == pytest.approx(wanted, rel=2e-4)


def test_in_a_closed_voxel_food_runs_out(dtype):
    """All of it becomes cell, and no more: V ends at V₀ + yield × what there was."""
    scene = eating(
        tf.Monod("food", rate=5.0, half=0.01, growth_yield=0.5),
        initial=0.1,
        box=((-4.0, -4.0), (4.0, 4.0)),
        spacing=8.0,
    )
    state = scene.bind(dtype=dtype).start()
    last = advance(scene, state, 60, 0.1)
    assert 0 <= float(food(last)) < 1e-6
    assert float(last.volume) == pytest.approx(float(state.volume) + 0.5 * 0.1 * 64, rel=1e-5)
    assert 0 <= float(last.growth_rate) < 1e-5


def test_hunger_a_thousand_times_faster_than_the_step(dtype, device):
    """Hard case 39: uptake at k·dt = 1e3 of what is there, by a crowd; nothing negative, gain =
    loss to 1e-6 of what there was."""
    scene = eating(
        tf.Monod("food", rate=1e4, half=1.0, growth_yield=0.05), initial=0.02, cells=pack()
    )
    state = scene.bind(dtype=dtype, device=device).start()
    first, start = float(food(state)), float(volumes(state))
    for _ in range(3):
        state = advance(scene, state, 1, 0.1)
        assert float(state.signals["food"].min()) >= 0
        gain, loss = (float(volumes(state)) - start) / 0.05, first - float(food(state))
        # the volumes that the gain is the difference of are rounded by 6e-8 of 30, and divided by
        # the yield
        assert gain == pytest.approx(
            loss,
            abs=1e-12 * first + (0 if dtype == F64 else 1e-6 * first + 6e-8 * start / 0.05 * 3),
        )
    assert loss > 0.2 * first


def test_kernels_and_torch_give_the_same(dtype, monkeypatch):
    """The same method, but for the order of a few operations, in cells that differ in all."""
    scene = eating(
        tf.Monod("food", rate=tf.LogNormal(1.5, 0.3), half=[0.1, 0.5], growth_yield=0.7),
        initial=lambda at: 0.2 + 0.1 * at[:, 0].abs(),
        cells=pack(),
    )
    found = []
    for why in ("", "asked for"):
        monkeypatch.setattr("torchfilm.tools.backends.unavailable", lambda why=why: why)
        model = scene.bind(2, dtype=dtype)
        state = model.start()
        said = [line for e in model.effects for line in e.numerics(0.1, state)]
        assert ("computed by torch: asked for" in said) == bool(why)
        for _ in range(4):
            state = model.step(state, 0.1)
        found.append(state)
    one, other = found
    for name in ("growth_rate", "food_eaten", "out.food"):
        bound = 1e-5 if dtype == torch.float32 else 1e-12
        assert one.fields[name].tolist() == pytest.approx(other.fields[name].tolist(), rel=bound)


@pytest.mark.parametrize("fresh", [True, False])
def test_gradients_by_the_first_lengths(fresh):
    """Also where the first step of a model begins from lengths that require them."""
    monod = tf.Monod("food", rate=1.5, half=0.3, growth_yield=0.7)
    model = eating(monod, cells=pack(), initial=0.4).bind(dtype=F64)
    first = model.start()
    if not fresh:
        model.step(first, 0.1)

    def eaten(length):
        return model.step(first.replace(length=length), 0.1).food_eaten.sum()

    length = first.length.clone().requires_grad_()
    (slope,) = torch.autograd.grad(eaten(length), length)
    with torch.no_grad():
        moved = [eaten(first.length + x * torch.eye(12, dtype=F64)[4]) for x in (1e-4, -1e-4)]
    assert float(slope[4]) == pytest.approx(float(moved[0] - moved[1]) / 2e-4, rel=1e-4)


def test_daughters_begin_to_eat_anew():
    scene = eating(
        tf.Monod("food", rate=1.5, half=0.1, growth_yield=2.0),
        more=(tf.Division(length=2.5), tf.Mechanics(dim=2)),
    )
    state = scene.bind(dtype=F64).start()
    while state.cells == 1:
        before, state = state, step(scene, state, 0.05)
    eaten = float(state.births[-1].parents.food_eaten)
    assert eaten > float(before.food_eaten) > 0.1
    assert state.food_eaten.tolist() == [0.0, 0.0]
    assert 0 < float(step(scene, state, 0.05).food_eaten.max()) < 0.1


def test_without_food_nothing_happens(dtype):
    scene = eating(tf.Monod("food", rate=1.0, half=0.1), initial=0.0)
    state = scene.bind(dtype=dtype).start()
    last = advance(scene, state, 3)
    assert (
        torch.equal(last.length, state.length)
        and float(last.growth_rate) == 0
        and float(last.signals["food"].abs().max()) == 0
    )


@pytest.mark.parametrize("backend", ["compiled", "torch"])
@pytest.mark.parametrize("away", [2e-3, 40.0])
def test_a_cell_beyond_an_open_box_eats_from_the_reservoir(away, backend):
    """Hard case 38: what it eats is kept count of, and the box does not lose it."""
    scene = tf.Scene(
        tf.Monod("food", rate=1.0, half=1.0, growth_yield=2.0),
        tf.Growth(),
        tf.Medium(
            food=tf.Signal(diffusion=0.0, initial=1.0, reservoir=3.0),
            outside="reservoir",
            backend=backend,
            **BOX,
        ),
        founders=tf.Cells([[0.0, 0.0], [0.0, 3.0]], [1.0, 0.0]),
    )
    state = scene.bind(dtype=F64).start()
    position = state.position.clone()
    position[1, 0] = 8.0 + away
    state = state.replace(position=position)
    after = step(scene, state, 0.1)
    gained = after.volume - state.volume
    assert float(gained[1]) == pytest.approx(
        float(state.volume[1]) * math.expm1(0.75 * 0.1), rel=1e-12
    )
    assert float(after.fields["food_reservoir"]) == pytest.approx(
        -float(gained[1]) / 2.0, rel=1e-12
    )
    assert float(food(state) - food(after)) == pytest.approx(float(gained[0]) / 2.0, rel=1e-9)


def test_a_colony_is_the_same_in_any_batch(dtype, device):
    scene = eating(
        tf.Monod("food", rate=[1.0, 1.4, 1.7], half=[0.1, 0.2, 0.4], growth_yield=2.0),
        initial=[1.0, 2.0, 0.7],
        more=(tf.Division(length=tf.Uniform(3.0, 3.4)), tf.Mechanics(dim=2)),
        outside="grow",
    )
    first = scene.bind(3, seed=4, dtype=dtype, device=device).start()
    last = advance(scene, first, 30)
    assert int(last.counts.max()) >= 4
    for places in ([2], [1, 0]):
        assert same(last.select(places), advance(scene, first.select(places), 30)), places


@pytest.mark.parametrize(
    "option", [{"rate": -1.0}, {"half": 0.0}, {"growth_yield": 0.0}, {"half": [0.1, -0.1]}]
)
def test_bad_input_is_refused_at_construction(option):
    with pytest.raises(InputError, match=rf"Monod\.{next(iter(option))}"):
        tf.Monod("food", **option)


def test_what_is_missing_is_reported():
    medium = tf.Medium(food=tf.Signal(diffusion=1.0), **BOX)
    with pytest.raises(
        InputError,
        match=(
            r"needs the field 'out.sugar'.*out.food.*signal 'sugar'; the Medium has food: .*give"
            r" the Medium sugar=tf\.Signal"
        ),
    ):
        tf.Scene(tf.Monod("sugar"), tf.Growth(), medium)
    with pytest.raises(
        InputError,
        match=(
            r"needs the field 'out.food'.*signal 'food', and the scene has no Medium: list"
            r" tf\.Medium\(food=tf\.Signal"
        ),
    ):
        tf.Scene(tf.Monod("food"), tf.Growth())
    with pytest.raises(InputError, match="needs the field 'growth_rate'"):
        tf.Scene(tf.Monod("food"), medium)
    scene = tf.Scene(
        tf.Monod("food", rate=[1.0, 2.0]), tf.Growth(), medium, founders=tf.Cells.single(2)
    )
    with pytest.raises(InputError, match=r"Monod\.rate has 2 values, but the batch has 3"):
        scene.bind(3).start()


def test_explain_says_who_drives_whom():
    said = eating(tf.Monod("food")).bind().describe()
    assert "nutrition -> growth: growth_rate" in said and "transport -> nutrition: out.food" in said


def test_a_step_in_which_a_fed_cell_more_than_doubles_is_refused():
    scene = eating(tf.Monod("food", rate=[0.5, 60.0]), more=(tf.Division(length=3.0),))
    with pytest.raises(InputError, match=r"too long for Monod\.rate = 60/h"):
        tf.simulate(scene, until=0.05)


def test_the_tail_of_a_drawn_rate_may_be_too_fast_for_the_step():
    """Few cells have it: only a smallest rate that is too fast is refused."""
    rate = tf.LogNormal(1.0, 0.8)
    assert rate.greatest() * 0.05 > math.log(2.0)
    eating(tf.Monod("food", rate=rate), more=(tf.Division(length=3.0),)).bind().check_step(0.05)


def test_a_factor_slows_growth_and_uptake():
    """Cells far apart, in plenty: the half-speed one eats what is worth half the growth."""

    def burden(cells):
        cells.vigour = torch.where(cells.cell_type == 1, 0.5, cells.vigour)

    two = tf.Cells([[-9.0, 0.0], [9.0, 0.0], [0.0, 9.0]], [[1.0, 0.0]] * 3, cell_type=[0, 1, 0])
    founders = dataclasses.replace(two, extra={"vigour": [1.0, 1.0, 0.0]})
    scene = tf.Scene(
        tf.Rules(burden, variables={"vigour": 1.0}),
        tf.Monod("food", rate=0.8, half=1e-6, growth_yield=2.0, factor="vigour"), tf.Growth(),
        tf.Medium(
            food=tf.Signal(diffusion=50.0, initial=10.0), box=((-20.0, -20.0), (20.0, 20.0)),
            spacing=4.0,
        ),
        dim=2, founders=founders,
    )  # fmt: skip
    state = scene.bind(dtype=torch.float64).start()
    before = state.volume
    after = step(scene, state, 0.1)
    assert after.growth_rate.tolist() == pytest.approx([0.8, 0.4, 0.0], rel=1e-6, abs=1e-12)
    gained = (after.volume - before) / 2.0
    assert after.food_eaten.tolist() == pytest.approx(gained.tolist(), rel=1e-6, abs=1e-12)


def test_rules_that_set_the_rate_of_a_fed_cell_are_refused():
    def stop(cells):
        cells.growth_rate = torch.where(cells.length > 3.0, 0.0, cells.growth_rate)

    def at_birth(parent, daughter1, daughter2):
        daughter1.growth_rate = 0.5 * parent.growth_rate

    medium = tf.Medium(
        food=tf.Signal(diffusion=50.0, initial=1.0), box=((-20.0, -20.0), (20.0, 20.0)), spacing=4.0
    )
    fed = tf.Monod("food"), tf.Growth(), medium, tf.Division(length=4.0)
    for rules in (tf.Rules(stop), tf.Rules(None, at_birth)):
        with pytest.raises(tf.InputError, match=r"which Monod sets again in every step.*factor="):
            tf.Scene(rules, *fed, dim=2).bind()
    with pytest.raises(tf.InputError, match=r"variables=\{'vigour': 1.0\}"):
        tf.Scene(tf.Monod("food", factor="vigour"), *fed[1:], dim=2)
    with pytest.raises(tf.InputError, match=r"Monod\.factor = 0.5 is not allowed"):
        tf.Monod("food", factor=0.5)

    def below(cells):
        cells.vigour = cells.vigour - 2.0

    scene = tf.Scene(
        tf.Rules(below, variables={"vigour": 1.0}), tf.Monod("food", factor="vigour"), *fed[1:],
        dim=2,
    )  # fmt: skip
    with pytest.raises(tf.SimulationError, match="vigour of cell 0 was set to -1: it must be at"):
        list(tf.simulate(scene, until=0.1))
    for given, words in (({"vigour": -2.0}, "vigour of a first cell is below 0"), ({}, "factor")):
        name = "vigour" if given else "length"
        scene = tf.Scene(
            tf.Rules(lambda c: None, variables=given), tf.Monod("food", factor=name), *fed[1:],
            dim=2,
        )  # fmt: skip
        with pytest.raises(tf.InputError, match=words):
            scene.bind()


def test_growth_is_asked_for_where_it_is_missing():
    medium = tf.Medium(food=tf.Signal(diffusion=1.0), box=((-8, -8), (8, 8)), spacing=4.0)
    with pytest.raises(tf.InputError, match=r"needs the field 'growth_rate'.*List tf.Growth\(\)"):
        tf.Scene(tf.Monod("food"), medium, dim=2)


# --- maintenance ---------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 4])
def test_maintenance_is_taken_off_the_growth_and_not_off_the_uptake(steps, device, dtype):
    """At a concentration that stays, u = rate · s/(half + s) in each type: growth is max(0, u − m),
    what lacks max(0, m − u), and what is eaten ∫ u V dt / yield of the growing volume."""
    m = {0: 0.0, 1: 0.1, 2: 0.4}
    monod = tf.Monod("food", rate=0.6, half=1.0, growth_yield=2.0, maintenance=m)
    cells = tf.Cells([[-5.0, 0.0], [0.0, 0.0], [5.0, 0.0]], [[0.0, 1.0]] * 3, cell_type=[0, 1, 2])
    food = tf.Signal(diffusion=0.0, initial=0.5, reservoir=0.5)
    scene = tf.Scene(
        monod, tf.Growth(),
        tf.Medium(food=food, outside="reservoir", steps=steps, box=((90.0, 90.0), (92.0, 92.0)),
                  spacing=2.0, depth=1.0),
        founders=cells,
    )  # fmt: skip
    state = scene.bind(device=device, dtype=dtype).start()
    first = state.volume.double()
    state = advance(scene, state, 10, dt=0.1)
    u, each = 0.2, torch.tensor([0.0, 0.1, 0.4], dtype=F64)
    net = (u - each).clamp(min=0.0)
    close = {"rtol": 1e-5, "atol": 1e-6, "check_dtype": False}
    torch.testing.assert_close(state.growth_rate.cpu(), net, **close)
    torch.testing.assert_close(state.starvation.cpu(), (each - u).clamp(min=0.0), **close)
    torch.testing.assert_close(state.volume.cpu(), first.cpu() * torch.exp(net), **close)
    ratio = torch.where(net > 0, torch.expm1(net) / torch.where(net > 0, net, 1.0), 1.0)
    eaten = u * first.cpu() * ratio / 2.0
    # of the second order in m · dt, also where cells starve and keep their volume
    torch.testing.assert_close(state.food_eaten.cpu(), eaten, rtol=1e-3, atol=0, check_dtype=False)


def test_those_that_starve_die():
    """Food for a while only: cells that take up less than their maintenance burst, at their rate,
    and what they leave feeds no one else."""
    many = tf.Cells([[x, y] for x in range(-7, 8) for y in range(-7, 8)], [[0.0, 1.0]] * 225, 0.0,
                    radius=0.3)  # fmt: skip
    scene = eating(
        tf.Monod("food", rate=1.0, half=0.1, growth_yield=1.0, maintenance=0.05),
        cells=many, initial=0.2, diffusion=100.0, more=(tf.Lysis(when="starvation", rate=0.5),),
    )  # fmt: skip
    lived = []
    for state in tf.simulate(scene, until=8.0, dt=0.1):
        lived.append((float(state.starvation.max()), state.cells))
    fed = [cells for hunger, cells in lived if hunger == 0.0]
    assert len(fed) > 5 and set(fed) == {225}
    late = len(lived) - len(fed)
    wanted = 225 * math.exp(-0.5 * 0.1 * late)
    assert lived[-1][1] == pytest.approx(wanted, abs=5 * (wanted * (1 - wanted / 225)) ** 0.5)


def test_gradients_go_through_maintenance():
    need = torch.tensor([0.1], dtype=F64, requires_grad=True)
    scene = eating(tf.Monod("food", rate=1.0, half=0.5, maintenance=need), initial=0.5)
    state = advance(scene, scene.bind(dtype=F64).start(), 4)
    (slope,) = torch.autograd.grad(state.volume.sum(), need)
    more, less = (
        float(advance(s, s.bind(dtype=F64).start(), 4).volume.sum())
        for s in (
            eating(tf.Monod("food", rate=1.0, half=0.5, maintenance=0.1 + d), initial=0.5)
            for d in (1e-4, -1e-4)
        )
    )
    assert float(slope) == pytest.approx((more - less) / 2e-4, rel=1e-5) and float(slope) < -0.1


def test_it_begins_with_the_rates_of_the_first_concentrations():
    """Rules and the first frame find them; of what cells lack, the other part."""
    first = lambda x: torch.where(x[:, 0] < 0.0, 0.05, 2.0)
    scene = tf.Scene(
        tf.Growth(),
        tf.Rules(lambda cells: None, variables={"vigour": 0.5}),
        tf.Monod("food", rate=1.2, half=0.4, factor="vigour", maintenance=0.1),
        tf.Medium(food=tf.Signal(0.0, initial=first), spacing=2.0, box=((-8, -8), (8, 8))),
        founders=tf.Cells([[-5.0, 1.0], [5.0, 1.0]], [[1.0, 0.0]] * 2, length=2.0), dim=2,
    )  # fmt: skip
    state = scene.bind(1, dtype=torch.float64).start()
    gross = [0.5 * 1.2 * s / (0.4 + s) for s in (0.05, 2.0)]
    assert state.growth_rate.tolist() == pytest.approx([0.0, gross[1] - 0.1])
    assert state.starvation.tolist() == pytest.approx([0.1 - gross[0], 0.0])


def test_it_begins_on_a_grid_that_has_grown_to_the_founders():
    far = tf.Cells([[0.0, 0.0], [40.0, 30.0]], [[1.0, 0.0]] * 2, length=2.0)
    rising = lambda x: 1.0 + 0.05 * x[:, 0].clamp(min=0.0)
    scene = eating(tf.Monod("food", rate=1.0, half=0.5), initial=rising, cells=far, outside="grow")
    state = scene.bind(1, dtype=F64).start()
    found = state.contact(("food",)).found["food"]
    assert torch.allclose(state.growth_rate, found / (0.5 + found), rtol=1e-6)
    assert float(found[1]) > 2.5


def test_cells_come_to_a_scene_and_a_scene_takes_over():
    """Added cells have the rate of what they find."""
    scene = eating(tf.Monod("food", rate=1.0, half=0.5))
    model = scene.bind(1)
    state = model.step(model.start())
    more = model.add(state, tf.Cells([[5.0, 5.0]], [[1.0, 0.0]], length=2.0))
    assert float(more.growth_rate[1]) == pytest.approx(1.0 / 1.5, rel=1e-3)
    other = tf.Scene(tf.Growth(rate=1.0), dim=2, founders=tf.Cells.single(2))
    taken = scene.take_over(tf.simulate(other, until=0.1).last())
    assert float(model.step(taken).growth_rate[0]) == pytest.approx(1.0 / 1.5, rel=1e-2)
