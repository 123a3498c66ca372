"""Space that is periodic along some axes: cells at opposite faces are neighbours."""

from __future__ import annotations

import itertools
import math
import warnings

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.kernels import moves, neighbours
from torchfilm.kernels.compiling import for_python
from torchfilm.kernels.memory import no_memory
from torchfilm.physics.contacts import Capsules, contact_gaps
from torchfilm.physics.nearby import gaps_nearby
from torchfilm.physics.space import PeriodicSpace, near_pairs

DOF = {2: (0,) * 4, 3: (0,) * 8}
AXES = [(2, "x"), (2, "y"), (2, "xy"), (3, "x"), (3, "xz"), (3, "xyz")]
SIDE = 20.0


def space_of(dim: int, axes: str, side: float = SIDE) -> PeriodicSpace:
    space = PeriodicSpace.of("periodic", {a: (-3.0, side - 3.0) for a in axes}, dim)
    assert space is not None
    return space


def crowd(seed: int, count: int, dim: int, side: float = SIDE):
    """Cells at random places, also beyond the faces, of lengths that the space allows."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, dim))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    x = rng.uniform(-side, 2 * side, (count, dim)) * np.array([1.0, 1.0, 0.4])[:dim]
    return x, axis, rng.uniform(0.0, 3.0, count), rng.uniform(0.3, 0.7, count)


def way_between(x: np.ndarray, space: PeriodicSpace) -> np.ndarray:
    """From each cell to the nearest image of each other, (n, n, d), by trying three images an
    axis."""
    between = x[None] - x[:, None]
    for k, period in enumerate(space.period):
        images = between[..., k, None] + period * np.arange(-4, 5)
        best = np.abs(images).argmin(-1)
        between[..., k] = np.take_along_axis(images, best[..., None], -1)[..., 0]
    return between


def pairs_that_meet(cells, space: PeriodicSpace, margin: float) -> set[tuple[int, int]]:
    """Those whose boxes come nearer than margin, of all."""
    x, axis, length, radius = cells
    side = np.abs(axis) * 0.5 * length[:, None] + radius[:, None] + 0.5 * margin
    away = (np.abs(way_between(x, space)) - side[:, None] - side[None]).max(2)
    return set(map(tuple, np.argwhere(np.triu(away <= 0, 1)).tolist()))


def gaps_of(cells, space: PeriodicSpace, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Gaps of pairs, each with the second cell at each of its images: the least."""
    x, axis, length, radius = (torch.from_numpy(c) for c in cells)
    first, second = torch.as_tensor(first).long(), torch.as_tensor(second).long()
    least = torch.full(first.shape, math.inf, dtype=torch.float64)
    shifts = [(-4, -3, -2, -1, 0, 1, 2, 3, 4) if period else (0,) for period in space.period]
    for shift in itertools.product(*shifts):
        moved = x + torch.tensor([s * p for s, p in zip(shift, space.period, strict=True)])
        both = Capsules(
            torch.cat([x, moved]).T, torch.cat([axis, axis]).T, 0.5 * length.repeat(2),
            radius.repeat(2),
        )  # fmt: skip
        least = torch.minimum(least, contact_gaps(both, first, second + len(x)))
    return least.numpy()


@pytest.mark.parametrize("dim, axes", AXES)
@pytest.mark.parametrize("count", (2, 30, 200))
def test_near_pairs_are_found_across_faces(dim, axes, count):
    """By kernels and by torch, against all pairs of images: none is missed or found twice."""
    space = space_of(dim, axes)
    cells = x, axis, length, radius = crowd(count, count, dim)
    periods = np.array([*space.period, 0.0][:3])
    first, second = for_python(neighbours.near_pairs)(
        no_memory(), x, axis, 0.5 * length, radius, periods, 0.3, DOF[dim]
    )
    wanted = pairs_that_meet(cells, space, 0.3)
    found = list(zip(first.tolist(), second.tolist(), strict=True))
    assert (np.diff(first) >= 0).all() and (first < second).all()
    assert len(set(found)) == len(found) and set(found) >= wanted
    nearly = pairs_that_meet(cells, space, 0.3 + 1e-3)
    assert set(found) <= nearly
    colony = torch.zeros(count, dtype=torch.int64)
    i, j = near_pairs(*map(torch.from_numpy, cells), colony, 1, 0.3, space)
    by_torch = [tuple(sorted(p)) for p in zip(i.tolist(), j.tolist(), strict=True)]
    assert len(set(by_torch)) == len(by_torch)
    # torch also asks whether the bounding spheres meet
    gaps = gaps_of(cells, space, first, second)
    touching = {p for p, gap in zip(found, gaps, strict=True) if gap < 0.3}
    assert touching <= set(by_torch) <= nearly
    assert count < 200 or len(touching) > 10


@pytest.mark.parametrize("dim, axes", AXES)
def test_gaps_are_those_of_the_nearest_images(dim, axes):
    space = space_of(dim, axes)
    cells = crowd(7, 150, dim)
    colony = torch.zeros(150, dtype=torch.int64)
    i, j, gap = gaps_nearby(*map(torch.from_numpy, cells), colony, 1, 0.5, space)
    np.testing.assert_allclose(gap.numpy(), gaps_of(cells, space, i, j), atol=1e-12)


def test_pairs_of_a_colony_do_not_depend_on_the_batch():
    space = space_of(2, "xy")
    parts = [crowd(k, 40 + 30 * k, 2) for k in range(3)]
    colony = torch.repeat_interleave(torch.arange(3), torch.tensor([40, 70, 100]))
    whole = [torch.from_numpy(np.concatenate(x)) for x in zip(*parts, strict=True)]
    i, j = near_pairs(*whole, colony, 3, 0.3, space)
    for k, (begin, part) in enumerate(zip((0, 40, 110), parts, strict=True)):
        one = torch.zeros(len(part[0]), dtype=torch.int64)
        own = torch.stack(near_pairs(*map(torch.from_numpy, part), one, 1, 0.3, space))
        assert torch.equal(torch.stack([i, j])[:, colony[i] == k] - begin, own)


@pytest.mark.parametrize("dim, axes", AXES)
def test_positions_come_back_inside(dim, axes):
    """By whole periods, and those inside keep their bits."""
    space = space_of(dim, axes)
    x = torch.from_numpy(crowd(1, 500, dim)[0])
    low, high = torch.tensor(space.low), torch.tensor(space.high)
    period = high - low
    moved = space.inside(x)
    steps = (moved - x) / torch.where(period > 0, period, 1.0)
    assert ((steps - steps.round()).abs() < 1e-12)[:, period > 0].all()
    assert (moved == x)[:, period == 0].all() and not space.outside(moved).any()
    within = (x >= low) & (x < high)
    assert within.sum() > 100 and torch.equal(moved[within], x[within])


@pytest.mark.parametrize("faces", [(3.8, 68.0), (-22.8, 26.5), (0.1, 0.7), (0.0, 20.0)])
def test_no_position_is_rounded_over_a_face(faces):
    """A few units of rounding about each face, and many periods away; the slope is 1 everywhere."""
    space = PeriodicSpace.of("periodic", {"x": faces}, 2)
    assert space.faces == {"x": faces}
    around = [np.nextafter(x, way) for x in faces for way in (-np.inf, np.inf)]
    around += [x + k * (faces[1] - faces[0]) for x in (*faces, *around) for k in (-7, -1, 1, 5)]
    around += [*faces, faces[0] - 1e-17, faces[0] - 1e-300]
    x = torch.tensor([[x, 0.0] for x in around], dtype=torch.float64, requires_grad=True)
    moved = space.inside(x)
    assert (moved[:, 0] >= faces[0]).all() and (moved[:, 0] < faces[1]).all()
    assert torch.equal(space.inside(moved), moved)
    moved.sum().backward()
    assert (x.grad == 1).all()


def test_two_cells_half_a_period_apart_are_one_pair():
    """Rounding decides which image is nearest; both are found, and one counts, also where cells are
    so large that both images are near."""
    space = space_of(2, "xy")
    rng = np.random.default_rng(0)
    for _ in range(50):
        start = rng.uniform(0, SIDE, 2)
        away = np.array([0.5 * SIDE, rng.choice([0.0, 0.5 * SIDE])])
        x = np.stack([start, start + away])
        cells = x, np.array([[1.0, 0.0]] * 2), np.array([9.5, 9.5]), np.array([0.5, 0.5])
        first, _ = for_python(neighbours.near_pairs)(
            no_memory(), *cells[:2], 0.5 * cells[2], cells[3],
            np.array([*space.period, 0.0]), 0.3, DOF[2],
        )  # fmt: skip
        colony = torch.zeros(2, dtype=torch.int64)
        i, _ = near_pairs(*map(torch.from_numpy, cells), colony, 1, 0.3, space)
        assert len(first) <= 1 and len(i) <= 1
        found = gaps_nearby(*map(torch.from_numpy, cells), colony, 1, 0.3, space)
        assert len(found[0]) <= 1


def test_wide_cells_far_away_change_no_pair():
    """They widen the margin of the colony, within which a long cell has two images near a third.
    Such a colony fails; here its cells have become so long in the step before."""
    ends = []
    for side in (12.0, 24.0):
        position = [[1.0, 5.0], [6.75, 5.0], *([6.0, 20.0 + 8 * k] for k in range(8))]
        cells = tf.Cells(
            position=position, axis=[[1.0, 0.0]] * 10, length=[2.0] * 2 + [0.0] * 8,
            radius=[0.3] * 2 + [1.4] * 8,
        )  # fmt: skip
        glue = tf.Adhesion(3.0, reach=0.1)
        scene = tf.Scene(
            tf.Mechanics(
                dim=2, alpha=0.01, adhesion=[glue], tolerance=1e-6, periodic={"x": (0, side)}
            )
        )
        model = scene.bind(cells=cells, dtype=torch.float64)
        start = model.start()
        long = start.length.new_tensor([5.1] * 2 + [0.0] * 8)
        end = model.step(start.replace(length=long), 0.05)
        ends.append(float(end.position[1, 0] - end.position[0, 0]))
    assert ends[0] == pytest.approx(ends[1], abs=1e-9)


def scene_of(dim: int, side: float, *others: tf.Effect, **options) -> tf.Scene:
    """Cells that grow, in a space that is periodic along x and y."""
    faces = {"x": (0.0, side), "y": (0.0, side)}
    return tf.Scene(
        tf.Growth(rate=1.0),
        *others,
        tf.Mechanics(dim=dim, periodic=faces, **{"tolerance": 1e-6, **options}),
        dt=0.025,
    )


def heap(count: int, dim: int, seed: int = 1) -> tf.Cells:
    """Overlapping cells, some of them across faces."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, dim))
    position = rng.uniform(0.0, SIDE, (count, dim)) * np.array([1.0, 1.0, 0.2])[:dim]
    return tf.Cells(position=position, axis=axis, length=rng.uniform(1.0, 3.0, count))


def first_step(scene: tf.Scene, cells: tf.Cells) -> tuple[tf.State, tf.State]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the cells start in one another
        model = scene.bind(cells=cells, dtype=torch.float64)
    start = model.start()
    return start, model.step(start)


@pytest.mark.parametrize("backend", ("compiled", "torch"))
@pytest.mark.parametrize("dim", (2, 3))
def test_four_copies_in_a_space_twice_as_wide_move_as_one(backend, dim):
    """The law of a periodic space. Forces, moves and passes are those of the copies, where pairs
    that met across faces now meet within."""
    cells, (nx, ny) = heap(90, dim), (2, 2)
    shifts = [np.array([i * SIDE, j * SIDE, 0.0][:dim]) for i in range(nx) for j in range(ny)]
    four = tf.Cells(
        position=np.concatenate([cells.position + shift for shift in shifts]),
        axis=np.concatenate([cells.axis] * 4),
        length=np.concatenate([cells.length] * 4),
    )
    start, one = first_step(scene_of(dim, SIDE, backend=backend), cells)
    _, copies = first_step(scene_of(dim, 2 * SIDE, backend=backend), four)
    moved = one.position - start.position
    assert float(moved.norm(dim=1).max()) > 0.1
    for part, shift in zip(copies.position.split(90), shifts, strict=True):
        away = part - torch.from_numpy(shift) - one.position
        away[:, :2] -= SIDE * torch.round(away[:, :2] / SIDE)
        assert float(away.abs().max()) < 1e-9
    report, of_copies = one.reports["mechanics"], copies.reports["mechanics"]
    assert torch.equal(report.passes, of_copies.passes)
    torch.testing.assert_close(one.contact_alpha, copies.contact_alpha[:90], rtol=1e-9, atol=0)


@pytest.mark.parametrize("backend", ("compiled", "torch"))
def test_a_move_of_all_cells_changes_nothing(backend):
    """A dense layer, whose cells lie elsewhere between the faces."""
    scene = scene_of(2, SIDE, backend=backend)
    cells = heap(110, 2)
    _, one = first_step(scene, cells)
    moved = (cells.position + np.array([7.3, 13.9])) % SIDE
    _, other = first_step(scene, tf.Cells(position=moved, axis=cells.axis, length=cells.length))
    away = other.position - one.position - torch.tensor([7.3, 13.9], dtype=torch.float64)
    away -= SIDE * torch.round(away / SIDE)
    assert float(away.abs().max()) < 1e-9
    torch.testing.assert_close(one.axis, other.axis, rtol=0, atol=1e-9)


@pytest.mark.parametrize("backend", ("compiled", "torch"))
def test_far_from_the_faces_a_colony_has_the_bits_of_one_without_faces(backend):
    grow = tf.Growth(rate=1.0), tf.Division(length=3.5)
    faces = {"x": (-100.0, 100.0), "y": (-80.0, 100.0)}
    states = []
    for periodic in (faces, {}):
        scene = tf.Scene(*grow, tf.Mechanics(dim=2, backend=backend, periodic=periodic), dt=0.05)
        *_, last = tf.simulate(scene, cells=16, seed=3)
        states.append(last)
    one, other = states
    assert one.cells >= 16 and torch.equal(one.position, other.position)
    assert torch.equal(one.axis, other.axis) and torch.equal(one.length, other.length)


@pytest.mark.parametrize("backend", ("compiled", "torch"))
def test_a_ring_of_cells_that_is_full_grows_no_more(backend):
    """Cells in a row that goes around: nowhere to go, so pressure holds back all growth, alike in
    all cells, and the overlaps are those that contacts leave."""
    count, whole = 8, 3.0
    side = count * whole
    x = (np.arange(count) + 0.25) * whole
    cells = tf.Cells(position=np.stack([x, 0 * x], 1), axis=[[1.0, 0.0]] * count, length=2.0)
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Mechanics(dim=2, periodic={"x": (0.0, side)}, backend=backend)
    )
    model = scene.bind(cells=cells, dtype=torch.float64)
    state = model.start()
    for _ in range(40):
        state = model.step(state, 0.05)
    overlaps = tf.measure.overlaps(state)
    assert int(overlaps.count) == count  # each touches the next, the last one the first
    assert float(state.length.max() - state.length.min()) < 1e-6
    deep = float(state.length.mean()) + 1.0 - whole
    assert 0.0 < deep < 0.05 and float(overlaps.worst) == pytest.approx(deep, abs=1e-6)
    # alone each would be e² times as large
    assert float(state.volume.sum()) < 1.05 * float(model.start().volume.sum())


def test_the_pressure_in_a_full_ring_is_the_same_in_every_cell():
    x = (np.arange(8) + 0.25) * 3.0
    cells = tf.Cells(position=np.stack([x, 0 * x], 1), axis=[[1.0, 0.0]] * 8, length=2.0)
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, periodic={"x": (0.0, 24.0)}))
    model = scene.bind(cells=cells, dtype=torch.float64)
    state = model.start()
    for _ in range(5):
        state = model.step(state, 0.05)
    found = tf.measure.pressure(state, scene)
    assert float(found.min()) > 0 and float(found.max() / found.min()) < 1.001


@pytest.mark.parametrize("backend", ("compiled", "torch"))
def test_cells_stick_together_across_faces(backend):
    """Two cells, one at either face, 0.1 µm apart, pull each other as two in the middle do."""
    glue = tf.Adhesion(strength=300.0, reach=0.3)
    found = []
    for shift in (0.0, 10.0):
        position = np.array([[19.45 + shift, 5.0], [0.55 + shift, 5.0]])
        cells = tf.Cells(position=position % 20.0, axis=[[0.0, 1.0]] * 2, length=2.0)
        scene = tf.Scene(
            tf.Mechanics(dim=2, adhesion=[glue], periodic={"x": (0, 20)}, backend=backend), dt=0.02
        )
        model = scene.bind(cells=cells, dtype=torch.float64)
        state = model.start()
        for _ in range(5):
            state = model.step(state)
        assert (state.position[:, 0] >= 0).all() and (state.position[:, 0] < 20).all()
        _, _, apart = tf.measure.neighbours(state, 0.3)
        found.append(float(apart))
    assert found[0] == pytest.approx(found[1], abs=1e-9) and 0.98 < found[0] < 1.05


def test_gradients_pass_across_faces():
    """Of where cells are after a step, by where one was, against finite differences."""
    scene = scene_of(2, SIDE, backend="torch", tolerance=1e-9)
    position = torch.tensor([[19.7, 5.0], [0.5, 5.3]], dtype=torch.float64)
    model = scene.bind(
        cells=tf.Cells(position=position, axis=[[0.0, 1.0], [0.2, 1.0]], length=2.0),
        dtype=torch.float64,
    )
    start = model.start()

    def width(x: torch.Tensor) -> torch.Tensor:
        state = model.step(start.replace(position=x))
        between = state.position[1] - state.position[0]
        return (between + torch.tensor([SIDE, 0.0]))[0]

    x = position.clone().requires_grad_()
    width(x).backward()
    for k in range(2):
        step = torch.zeros_like(position)
        step[0, k] = 1e-5
        with torch.no_grad():
            wanted = (width(position + step) - width(position - step)) / 2e-5
        assert float(x.grad[0, k]) == pytest.approx(float(wanted), rel=1e-3, abs=1e-6)
    assert abs(float(x.grad[0, 0])) > 1e-3


@pytest.mark.parametrize("dim", (2, 3))
def test_no_cells_come_nearer_across_faces_than_told(dim):
    """A colony that is stretched evenly: within it neighbours hardly part, but not those that meet
    across a face."""
    x, axis, length, radius = crowd(3, 100, dim)
    space = space_of(dim, "xy")
    x = space.inside(torch.from_numpy(x)).numpy()
    y = np.zeros((100, len(DOF[dim])))
    y[:, :dim] = 0.02 * x
    periods = np.array([*space.period, 0.0][:3])
    apart, own = for_python(moves.approach)(no_memory(), x, length, radius, periods, y, DOF[dim])
    i, j = map(
        np.array, zip(*sorted(pairs_that_meet((x, axis, length, radius), space, 0.3)), strict=True)
    )
    before = gaps_of((x, axis, length, radius), space, i, j)
    after = gaps_of((x + y[:, :dim], axis, length, radius), space, i, j)
    assert (before - after).max() > 0.1  # across a face they come nearer by 2 % of the period
    assert (before - after <= apart + own[i] + own[j] + 1e-9).all()


def test_a_cell_too_long_for_its_space_fails_by_name():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, periodic={"x": (0, 12)}))
    with pytest.raises(tf.SimulationError, match=r"colony 0.*longer than half of the way between"):
        for _ in tf.simulate(scene, until=3.0, dt=0.05):
            pass


def test_of_several_images_the_nearest_is_the_neighbour():
    """A cell as long as the space is wide meets the other one on both sides: once, by the least
    gap; and no cell meets itself."""
    scene = tf.Scene(tf.Growth(), dim=2)
    cells = tf.Cells(position=[[0.0, 0.0], [5.0, 0.0]], axis=[[1.0, 0.0]] * 2, length=[5.0, 3.0])
    state = scene.bind(cells=cells, dtype=torch.float64).start()
    state = state.replace(space=PeriodicSpace.of("periodic", {"x": (0.0, 12.0)}, 2))
    i, j, gap = gaps_nearby(
        state.position, state.axis, state.length, state.radius, state.colony, 1, 4.0, state.space
    )
    assert (i.tolist(), j.tolist()) == ([0], [1]) and float(gap) == pytest.approx(0.0)
    assert float(tf.measure.neighbours(state, 4.0)[2]) == pytest.approx(5.0)


@pytest.mark.parametrize(
    "given, words",
    [
        ({"z": (0, 10)}, "axis = 'z' is not allowed: it must be 'x' or 'y'"),
        ({"x": 10.0}, r"periodic\['x'\] = 10.0 is not allowed.*\(low, high\) in µm"),
        ({"x": (10, 10)}, "high"),
        ({"x": (0, math.inf)}, "high"),
        ([("x", 0, 10)], r'such as \{"x": \(0, 40\)\}'),
    ],
)
def test_what_is_no_periodic_space_is_refused(given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.Mechanics(dim=2, periodic=given)


def test_what_does_not_fit_a_periodic_space_is_refused():
    faces = {"x": (0, 40)}
    with pytest.raises(tf.InputError, match="bilateral"):
        tf.Mechanics(dim=2, periodic=faces, contacts="bilateral")
    with pytest.raises(tf.InputError, match="the Plane ends space along x"):
        tf.Mechanics(dim=2, periodic=faces, walls=[tf.Plane(x=0, facing="+x")])
    with pytest.raises(tf.InputError, match="the Sphere ends space along x"):
        tf.Mechanics(dim=2, periodic=faces, walls=[tf.Sphere(centre=(20, 0), radius=10)])
    tf.Mechanics(dim=2, periodic=faces, walls=[tf.Plane(y=0, facing="+y")])
    scene = tf.Scene(tf.Mechanics(dim=2, periodic=faces))
    with pytest.raises(tf.InputError, match=r"cell 0 of colony 0 starts at .* beyond the faces"):
        scene.bind(cells=tf.Cells(position=[[41.0, 0.0]], axis=[[1.0, 0.0]], length=2.0))
    with pytest.raises(tf.InputError, match=r"cell 0 of colony 0 is 21 µm long .* half of the way"):
        scene.bind(cells=tf.Cells(position=[[1.0, 0.0]], axis=[[0.0, 1.0]], length=20.0))


def test_a_space_knows_its_shortest_period_and_both_faces():
    space = PeriodicSpace.of("periodic", {"x": (0.0, 10.0), "y": (0.0, 30.0)}, 3)
    assert space.shortest == 10.0 and space.period == (10.0, 30.0, 0.0)
    long = space.too_long(
        torch.tensor([3.5, 3.5, 4.5]), torch.full((3,), 0.5), torch.tensor([0.0, 1.0, 0])
    )
    assert long.tolist() == [False, True, True]
    places = [[0.0, 0, 0], [10.0, 30, 99], [-0.1, 1, 1], [10.1, 1, 1], [1, -0.1, 1], [1, 30.1, 1]]
    assert space.outside(torch.tensor(places)).tolist() == [False] * 2 + [True] * 4


def test_a_wall_that_ends_space_in_one_colony_does_not_fit():
    wall = tf.Plane(point=[[0.0, -5.0]] * 2, normal=[[0.0, 1.0], [1.0, 1.0]])
    with pytest.raises(tf.InputError, match="the Plane ends space along x"):
        tf.Mechanics(dim=2, periodic={"x": (0, 40)}, walls=[wall])


def medium(x: tuple[float, float], *, periodic: bool) -> tf.Medium:
    faces = tf.BoundaryConditions(x=tf.Periodic()) if periodic else None
    box = (x[0], -20.0), (x[1], 20.0)
    return tf.Medium(food=tf.Signal(diffusion=10.0), box=box, spacing=2.0, boundary=faces)


def test_signals_and_cells_have_the_same_faces():
    cells = tf.Mechanics(dim=2, periodic={"x": (0, 40)})
    tf.Scene(cells, medium((0.0, 40.0), periodic=True))
    with pytest.raises(tf.InputError, match=r"cells are periodic along x.*the medium is not"):
        tf.Scene(cells, medium((0.0, 40.0), periodic=False))
    with pytest.raises(tf.InputError, match=r"the medium ends at \(-20.0, 20.0\)"):
        tf.Scene(cells, medium((-20.0, 20.0), periodic=True))


@pytest.mark.parametrize("dim, axes", AXES)
@pytest.mark.parametrize("count", (30, 200))
def test_near_pairs_of_some_cells_are_found_across_faces(dim, axes, count):
    """Those of all near pairs that have a marked cell, whether it or its image is met."""
    space = space_of(dim, axes)
    x, axis, length, radius = crowd(count, count, dim)
    periods = np.array([*space.period, 0.0][:3])
    given = no_memory(), x, axis, 0.5 * length, radius, periods, 0.3
    every = np.stack(for_python(neighbours.near_pairs)(*given, DOF[dim]), 1)
    for share in (0.05, 0.5):
        some = (np.random.default_rng(count).random(count) < share).astype(np.uint8)
        found = np.stack(for_python(neighbours.near_pairs_of)(*given, some, DOF[dim]), 1)
        wanted = every[(some[every] > 0).any(1)]
        assert sorted(map(tuple, found.tolist())) == sorted(map(tuple, wanted.tolist()))
        assert count < 200 or 0 < len(wanted) < len(every)
