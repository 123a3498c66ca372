"""Erosion and sloughing: the law at which a film loses volume, whatever the step; what nothing
holds."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers import step
from mock_cuda import pretended_cuda  # noqa: F401
from ruled import same
from scipy.stats import poisson

import torchfilm as tf
from torchfilm.film_shape import Floor, columns_of
from torchfilm.tools.checks import InputError

FLOOR = [tf.Plane(y=0.0, facing="+y")]
WIDTH = 20.0


def layers(number: int, dim: int = 2, length: float = 2.0) -> tf.Cells:
    """Cells that lie side by side along x, in so many layers 1 µm high; each takes up 4 µm, so that
    a column of a layer is half full."""
    x = torch.arange(2.0, WIDTH, 4.0, dtype=torch.float64)
    rows = [torch.stack([x, torch.full_like(x, 0.5 + k)], 1) for k in range(number)]
    position = torch.cat(rows)
    if dim == 3:
        position = torch.stack(
            [position[:, 0], torch.full_like(position[:, 0], 0.5), position[:, 1]], 1
        )
    axis = torch.zeros_like(position)
    axis[:, 0] = 1.0
    return tf.Cells(position, axis, length)


def film(
    *effects: tf.Effect, dim: int = 2, cells: tf.Cells | None = None,
    tolerance: float | None = None, **options,
) -> tf.Scene:  # fmt: skip
    up = tf.Plane(**{"xyz"[dim - 1]: 0.0}, facing="+" + "xyz"[dim - 1])
    periodic = {"x": (0.0, WIDTH)} | ({"y": (0.0, 6.0)} if dim == 3 else {})
    mechanics = tf.Mechanics(dim=dim, walls=[up], periodic=periodic, tolerance=tolerance)
    return tf.Scene(mechanics, *effects, founders=cells or layers(5, dim), **options)


@pytest.mark.parametrize("order", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("dt, steps", [(0.2, 1), (0.05, 4)])
def test_a_film_loses_volume_by_the_law(order, dt, steps):
    """In each step the mean loss is Σ rate · h^order over the columns, times the volume per height:
    over 1,000 colonies, to four standard errors. In 0.2 h it is a third of a layer."""
    rate, spacing = 1.7 / 5.0**order, 0.5
    model = film(tf.Erosion(rate, order=order, spacing=spacing)).bind(1000)
    state = model.start(seed=4)
    differences = torch.zeros(1000, dtype=torch.float64)
    total = 0.0
    for _ in range(steps):
        height = tf.measure.film(state, spacing).height
        volume = state.groups.sum(state.volume.double())
        law = dt * rate * (height**order * (height > 0)).sum(1) * volume / height.sum(1)
        state = model.step(state, dt)
        differences += state.reports["erosion"].volume - law
        total += float(law.mean())
    error = float(differences.std()) / math.sqrt(1000)
    assert 0 < 4 * error < 0.1 * total and abs(float(differences.mean())) < 4 * error


def test_heights_count_from_the_floor_and_so_does_what_erodes():
    """Above a floor at 5 µm the upper half of ten layers erodes as five layers above one at 0 do:
    what is below it bears nothing."""
    lost = []
    for number, at in ((5, 0.0), (10, 5.0)):
        scene = film(tf.Erosion(0.1, order=1.0, floor=at), cells=layers(number))
        state = step(scene, scene.bind(1000).start(seed=3), 0.5)
        lost.append(state.reports["erosion"].volume)
    error = math.hypot(*(float(x.std()) / math.sqrt(1000) for x in lost))
    one, other = (float(x.mean()) for x in lost)
    assert abs(one - other) < 4 * error < 0.2 * one


def test_any_rate_takes_what_can_be_seen():
    scene = film(tf.Erosion(1e300))
    assert step(scene, scene.bind().start(), 0.1).cells == 0


def test_a_long_step_erodes_what_comes_to_light():
    """Stacks of five cells at the same rate whatever their height: the number that leave in 2 h is
    Poisson's, though at first only one can be seen."""
    scene = film(tf.Erosion(1.0, order=0.0))
    state = scene.bind(400).start(seed=1)
    height = tf.measure.film(state, 0.5).height[0]
    after = step(scene, state, 2.0)
    rate = float((height > 0).sum() / height.sum()) * 5.0  # cells of a stack, per h
    left = torch.bincount(after.position[:, 1].floor().long(), minlength=5) / 2000
    wanted = poisson.cdf(4 - np.arange(5), 2.0 * rate)
    np.testing.assert_allclose(left, wanted, atol=4 * math.sqrt(0.25 / 2000))


def test_cells_below_others_stay_until_those_have_left():
    heap = layers(2)
    state = film(tf.Erosion(1e-3, order=0.0), cells=heap).bind(200).start(seed=2)
    after = step(film(tf.Erosion(20.0, order=0.0), cells=heap), state, 0.02)
    (note,) = after.ended
    assert note.fate == "eroded" and len(note.uid) > 100
    assert after.reports["erosion"].cells.sum() == len(note.uid)
    left = {(c, u) for c, u in zip(note.colony_id.tolist(), note.uid.tolist(), strict=True)}
    lower = [(c, u) for c, u in left if u < 5]
    assert lower and all((c, u + 5) in left for c, u in lower)


def test_a_film_comes_to_rest_where_growth_balances_erosion():
    """μ · Σh = rate · Σh² over the columns. Divisions at 4 µm take the caps' volume, so that a
    colony grows at μ · ln 2/ln((l + 4r/3)/(l/2 + r/3))."""
    rate, growth = 0.1, 1.0
    scene = film(
        tf.Growth(rate=growth), tf.Division(length=4.0), tf.Erosion(rate),
        cells=layers(3), dt=0.05,
    )  # fmt: skip
    ratio = []
    for state in tf.simulate(scene, until=25.0, colonies=6, seed=3):
        if state.time > 8.0:
            height = tf.measure.film(state, 0.5).height
            ratio.append((height**2).sum() / height.sum())
    grows = growth * math.log(2) / math.log((4 + 2 / 3) / (2 + 1 / 6))
    assert float(torch.stack(ratio).mean()) == pytest.approx(grows / rate, rel=0.04)


def test_the_same_bits_whatever_the_batch_and_after_a_restart(tmp_path):
    scene = film(tf.Growth(rate=0.5), tf.Division(), tf.Erosion([0.05, 0.1, 0.2]), tf.Sloughing())
    whole = list(tf.simulate(scene, until=1.0, seed=5, record=tmp_path / "run.h5"))[-1]
    alone = scene.bind(3).start(seed=5).select([1])
    model = scene.bind(3)
    for _ in range(40):
        alone = model.step(alone, 0.025)
    assert same(whole.select([1]), alone)
    list(tf.simulate(scene, until=0.5, seed=5, record=tmp_path / "half.h5"))
    with tf.Results(tmp_path / "half.h5") as results:
        half = results.state(scene)
    assert 0 < half.step < whole.step
    *_, later = tf.simulate(scene, half, until=1.0)
    assert same(whole, later)
    with tf.Results(tmp_path / "run.h5") as results:
        assert list(results.lineage().fate).count("eroded") > 5


def test_columns_have_the_tops_of_their_cells():
    """Against points of the surface, by brute force: cells at all angles, in space and plane."""
    generator = torch.Generator().manual_seed(1)
    for dim in (2, 3):
        count = 60
        size = torch.tensor([*[WIDTH, 6.0][: dim - 1], 6.0], dtype=torch.float64)
        place = torch.rand(count, dim, generator=generator, dtype=torch.float64) * size
        axis = torch.randn(count, dim, generator=generator, dtype=torch.float64)
        axis[0] = 0.0
        axis[0, -1] = 1.0  # one stands upright
        axis = axis / axis.norm(dim=1, keepdim=True)
        periodic = {"x": (0.0, WIDTH)} | ({"y": (0.0, 6.0)} if dim == 3 else {})
        cells = tf.Cells(place, axis, 1.5, colony=list(range(count)))
        options = {"dim": dim, "periodic": periodic}
        state = tf.Scene(tf.Mechanics(**options)).bind(cells=cells, dtype=torch.float64).start()
        floor = Floor.of("test", state, 0.5, 1.0, None)
        height = columns_of(state, floor).height().reshape(count, -1)
        t = torch.linspace(-0.75, 0.75, 1001, dtype=torch.float64)
        line = place.unsqueeze(1) + t.view(1, -1, 1) * axis.unsqueeze(1)
        middles = torch.cartesian_prod(*[
            low + (torch.arange(n) + 0.5) * s
            for (low, _), n, s in zip(floor.spans, floor.counts, floor.steps, strict=True)
        ]).reshape(-1, dim - 1).double()  # fmt: skip
        period = torch.tensor([WIDTH, 6.0][: dim - 1], dtype=torch.float64)
        wanted = torch.zeros_like(height)
        for column, middle in enumerate(middles):
            off = line[..., :-1] - middle
            off = off - period * torch.round(off / period)
            rise = 0.25 - (off * off).sum(-1)
            top = torch.where(rise >= 0, line[..., -1] + rise.clamp(min=0).sqrt() - 1.0, 0.0)
            wanted[:, column] = top.amax(1)
        close = (height - wanted.clamp(min=0)).abs()
        # a column that a cell only grazes may be missed by points
        assert int((close > 1e-5).sum()) <= 2 and bool((height >= wanted - 1e-9).all())
        assert (height > 0).double().mean() > 0.01


def test_what_nothing_holds_is_carried_away():
    """A pillar of three cells: without the middle one that above it has nothing to rest on. A
    neighbour within the gap, across a face too, holds it."""
    upright = [[0.0, 1.0]] * 3
    pillar = tf.Cells([[1.0, 1.5], [1.0, 4.5], [1.0, 7.5]], upright, 2.0)
    scene = film(tf.Sloughing(gap=0.2), cells=pillar)
    state = scene.bind(2).start()
    assert step(scene, state, 0.01).cells == 6
    broken = state.remove(torch.tensor([False, True, False, False, False, False]), "removed")
    after = step(scene, broken, 0.01)
    assert after.counts.tolist() == [1, 3] and after.uid.tolist() == [0, 0, 1, 2]
    note = after.ended[-1]
    assert note.fate == "sloughed" and note.uid.tolist() == [2] and note.colony_id.tolist() == [0]
    assert after.reports["sloughing"].cells.tolist() == [1, 0]
    beside = tf.Cells([[0.6, 1.5], [WIDTH - 0.5, 3.5], [WIDTH - 0.5, 6.4]], upright, 2.0)
    held = film(tf.Sloughing(gap=0.2), cells=beside)
    assert step(held, held.bind().start(), 0.01).cells == 3


def test_a_wall_on_any_side_holds():
    ceiling = tf.Plane(y=10.0, facing="-y")
    cells = tf.Cells([[2.0, 0.5], [6.0, 9.5]], [[1.0, 0.0]] * 2, 2.0)
    scene = tf.Scene(tf.Mechanics(dim=2, walls=[*FLOOR, ceiling]), tf.Sloughing(), founders=cells)
    assert step(scene, scene.bind().start(), 0.01).cells == 2


def test_a_gap_is_as_wide_beside_a_wall_as_between_cells():
    """The surface of a cell 0.45 µm above the wall, and of one 0.75 µm above it."""
    near, far = (tf.Cells([[3.0, y]], [[1.0, 0.0]], 2.0) for y in (0.95, 1.25))
    assert film(tf.Sloughing(gap=0.5), cells=near).bind().start().cells == 1
    with pytest.raises(InputError, match=r"take cell 0 of colony 0 .*no chain of cells less"):
        film(tf.Sloughing(gap=0.5), cells=far).bind()


def test_a_wall_at_another_place_in_each_colony_holds_the_cells_of_its_own():
    """Also where the batch has only some of the colonies."""
    wall = tf.Plane(y=[0.0, 5.0], facing="+y")
    cells = tf.Cells([[3.0, 0.5], [3.0, 5.5]], [[1.0, 0.0]] * 2, 2.0, colony=[0, 1])
    scene = tf.Scene(tf.Mechanics(dim=2, walls=[wall]), tf.Sloughing(), founders=cells)
    state = scene.bind(2).start().select([1])
    assert scene.bind(state=state).step(state, 0.01).cells == 1


@pytest.mark.parametrize(
    "given, words",
    [
        ({"rate": -0.1}, r"Erosion.rate = -0.1 is not allowed.*at least 0"),
        ({"rate": 0.1, "order": -1.0}, "Erosion.order = -1.0 is not allowed"),
        ({"rate": 0.1, "spacing": 0.0}, "Erosion.spacing = 0.0 is not allowed"),
        ({"rate": {0: 0.1, 1: 0.2}}, r"Erosion.rate = .*one number, or one per colony"),
        ({"rate": 0.1, "across": {"y": (0, 3)}}, "axis = 'y' is not allowed: it must be 'x'"),
        ({"rate": 0.1, "across": {"x": (0, 3)}}, "left out along x, where space is periodic"),
    ],
)
def test_what_erosion_refuses(given, words):
    with pytest.raises(InputError, match=words):
        film(tf.Erosion(**given)).bind(2)


def test_where_the_floor_ends_must_be_known():
    scene = tf.Scene(tf.Mechanics(dim=2, walls=FLOOR), tf.Erosion(0.1), founders=layers(1))
    with pytest.raises(InputError, match=r"Erosion does not know how far the floor.*across=\{'x'"):
        scene.bind()
    within = dataclasses.replace(scene.effects[1], across={"x": (4.0, 12.0)})
    known = scene.replace(scene.effects[0], within)
    state = step(known, known.bind().start(), 1e4)
    # columns from 4 to 12 µm: the cells in the middle of which they end stay on the other side
    assert state.position[:, 0].tolist() == [2.0, 14.0, 18.0]


def test_a_cell_beside_the_floor_does_not_change_what_erodes():
    """It stands 0.6 µm beside the columns, above none of them: the others leave by the same draws,
    as fast as without it."""
    left = []
    erosion = tf.Erosion(1.0, order=0.0, across={"x": (4.0, 12.0)})
    for more in (0, 1):
        first = layers(3)
        position = np.concatenate([first.position, np.array([[3.4, 5.0]])[:more]])
        axis = np.concatenate([first.axis, np.array([[0.0, 1.0]])[:more]])
        scene = tf.Scene(erosion, founders=tf.Cells(position, axis, 2.0))
        after = step(scene, scene.bind(50).start(seed=2), 0.5)
        left.append(after.counts - more)
    assert torch.equal(*left) and 0 < int(left[0].sum()) < 50 * 15


def test_sloughing_needs_a_wall_and_first_cells_that_it_holds():
    with pytest.raises(InputError, match="Sloughing removes cells that no wall holds"):
        tf.Scene(tf.Mechanics(dim=2), tf.Sloughing()).bind()
    high = tf.Cells([[3.0, 0.5], [3.0, 4.0]], [[1.0, 0.0]] * 2, 2.0)
    with pytest.raises(InputError, match=r"take cell 1 of colony 0 .*no chain of cells less"):
        film(tf.Sloughing(), cells=high).bind()


def test_cells_that_come_may_be_held_by_those_that_are_there():
    model = film(tf.Sloughing(), cells=layers(1)).bind()
    state = model.add(model.start(), tf.Cells([[2.0, 1.5]], [[1.0, 0.0]], 2.0))
    assert model.step(state).cells == layers(1).count + 1
    with pytest.raises(InputError, match=r"take cell 5 of colony 0 .*no chain of cells less"):
        model.add(model.start(), tf.Cells([[2.0, 2.5]], [[1.0, 0.0]], 2.0))


@pytest.mark.parametrize("effect", [tf.Erosion([0.0, 0.15]), tf.Sloughing()])
def test_what_stays_keeps_its_gradient(effect):
    """Cells that leave take their share along. A colony that loses none has the gradient that it
    has alone."""

    def left(make: torch.Tensor) -> tuple[tf.State, torch.Tensor]:
        scene = film(
            tf.Circuit(lambda u, s, p, cell: {"g": p.make - 0.5 * u.g}, species="g", make=make),
            effect, dt=0.05,
        )  # fmt: skip
        model = scene.bind(2, dtype=torch.float64, seed=1)
        state = model.start()
        for k in range(20):
            if k == 10 and isinstance(effect, tf.Sloughing):  # the upper layers lose their hold
                state = state.remove(
                    (state.colony == 1) & ((state.position[:, 1] - 1.5).abs() < 0.1)
                )
            state = model.step(state)
        return state, torch.stack([state.g[state.colony == k].sum() for k in range(2)])

    make = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    state, total = left(make)
    assert state.counts[0] == 25 and 0 < state.counts[1] < 20
    for k in range(2):
        (slope,) = torch.autograd.grad(total[k], make, retain_graph=True)
        # g is in proportion to what makes it
        assert float(slope) == pytest.approx(float(total[k].detach()) / 2.0, rel=1e-6)


def test_a_state_on_a_gpu_erodes_by_the_bits_of_the_cpu(pretended_cuda):  # noqa: F811
    losing = (tf.Erosion([0.05, 0.2]), tf.Sloughing(), tf.Lysis(rate=0.2))
    scene = film(tf.Growth(rate=0.5), tf.Division(length=4.0), *losing)
    there, here = (scene.bind(2, device=name).start(seed=2) for name in ("cuda", "cpu"))
    ended = 0
    for _ in range(12):
        there, here = step(scene, there, 0.05), step(scene, here, 0.05)
        assert there.position.device.type == "cuda"
        assert torch.equal(there.position.cpu(), here.position)
        assert torch.equal(there.uid.cpu(), here.uid)
        for name in ("erosion", "sloughing"):
            one, other = (x.reports[name] for x in (there, here))
            assert one.volume.device.type == "cuda"
            assert torch.equal(one.volume.cpu(), other.volume)
        ended += len(here.ended)
    assert ended > 5
    rate = torch.tensor([0.05, 0.2], dtype=torch.float64, requires_grad=True)
    growing = (tf.Growth(rate=rate), tf.Division(length=4.0))
    traced = film(*growing, *losing, tolerance=1e-5).bind(2, device="cuda")
    assert traced.step(traced.start(seed=2), 0.05).cells > 0  # by torch, where a gradient is wanted


def test_one_long_step_takes_what_the_law_says_of_cells_at_all_angles():
    """Where many cells lie over several columns, which come to light at different times: over 500
    colonies, to four standard errors. The loss is a quarter of the film."""
    rng = np.random.default_rng(0)
    place = np.stack([rng.uniform(0, WIDTH, 200), rng.uniform(0.5, 24.0, 200)], 1)
    angle = rng.uniform(0, math.pi, 200)
    heap = tf.Cells(place, np.stack([np.cos(angle), np.sin(angle)], 1), 5.0)
    across = {"x": (0.0, WIDTH)}
    scene = tf.Scene(tf.Erosion(6.0, order=0.0, across=across), founders=heap)
    model = scene.bind(500)
    state = model.start(seed=3)
    height = tf.measure.film(state, 0.5, across=across).height
    there = (state.position[:, 0] >= 0) & (state.position[:, 0] < WIDTH)
    volume = state.groups.sum(torch.where(there, state.volume.double(), 0.0))
    law = 6.0 * (height > 0).sum(1) * volume / height.sum(1)
    ratio = model.step(state, 1.0).reports["erosion"].volume / law
    error = 4 * float(ratio.std()) / math.sqrt(500)
    assert error < 0.03 and float(ratio.mean()) == pytest.approx(1.0, abs=error)
