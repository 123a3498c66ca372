"""Measures of a state: overlaps with walls at the deepest point, and neighbours."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import crowd, near_pairs, unit

import torchfilm as tf

INF = math.inf
WALLS = {
    "ball": (
        lambda d: tf.Sphere((0.2, 0.0, 0.1)[:d], 1.5, inside=False),
        lambda p: np.linalg.norm(p - np.array([0.2, 0.0, 0.1])[: p.shape[-1]], axis=-1) - 1.5,
    ),
    "sphere": (
        lambda d: tf.Sphere((0.2, 0.0, 0.1)[:d], 2.5),
        lambda p: 2.5 - np.linalg.norm(p - np.array([0.2, 0.0, 0.1])[: p.shape[-1]], axis=-1),
    ),
    "box": (
        lambda d: tf.Box((-1, -2, -INF)[:d], (1.5, 2, 1)[:d]),
        lambda p: _in_box(p, (-1, -2, -INF), (1.5, 2, 1)),
    ),
    "plane": (
        lambda d: tf.Plane(point=(0.1,) * d, normal=(1.0, 2.0, -0.5)[:d]),
        lambda p: _above(p, 0.1, np.array([1.0, 2.0, -0.5])),
    ),
}


def _in_box(p: np.ndarray, low, high) -> np.ndarray:
    d = p.shape[-1]
    return np.minimum(p - np.array(low)[:d], np.array(high)[:d] - p).min(-1)


def _above(p: np.ndarray, at: float, normal: np.ndarray) -> np.ndarray:
    normal = normal[: p.shape[-1]]
    return (p - at) @ (normal / np.linalg.norm(normal))


def cells(dim: int, count: int = 400) -> tf.Cells:
    """One colony per rod, near the origin, in all directions."""
    rng = np.random.default_rng(3)
    return tf.Cells(
        rng.uniform(-2, 2, (count, dim)),
        unit(rng, count, dim),
        rng.uniform(0, 4, count),
        rng.uniform(0.3, 0.6, count),
        colony=np.arange(count),
    )


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", list(WALLS))
def test_overlap_with_a_wall_is_the_deepest_along_the_cell(device, dtype, dim, kind):
    """Against 4,001 points along each rod of up to 4 µm.

    A distance changes no faster than its point moves. So between two samples, 1e-3 µm apart, at
    most 5e-4 µm are missed. float32 rounds lengths, radii and axes by 3e-7 µm each.
    """
    wall, distance = WALLS[kind]
    given = cells(dim)
    state = tf.Scene(tf.Growth(), founders=given).bind(device=device, dtype=dtype).start()
    found = tf.measure.overlaps(state, [wall(dim)]).walls.cpu().numpy()
    samples = (
        given.position
        + np.linspace(-0.5, 0.5, 4001)[:, None, None] * given.length[:, None] * given.axis
    )
    deepest = np.maximum((given.radius - distance(samples)).max(0), 0)
    rounding = 2e-6 if dtype == torch.float32 else 1e-12
    assert (found >= deepest - rounding).all() and (found <= deepest + 5e-4 + rounding).all()
    assert (deepest > 0.1).sum() > 50


def test_a_ball_under_the_middle_of_a_rod_is_seen(device, dtype):
    """Neither end touches; the middle is 0.25 µm deep, which is exact in binary."""
    state = (
        tf.Scene(tf.Growth(), founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 4.0))
        .bind(2, device=device, dtype=dtype)
        .start()
    )
    found = tf.measure.overlaps(state, [tf.Sphere((0.5, -0.75), 0.5, inside=False)])
    assert found.walls.tolist() == [0.25, 0.25] and found.walls.dtype == torch.float64


def test_a_wall_for_each_colony_is_measured_in_its_own(device):
    """Also for colonies selected from their batch: a wall's value goes by the colony's id."""
    state = (
        tf.Scene(tf.Growth(), founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 4.0))
        .bind(3, device=device)
        .start()
    )
    ball = tf.Sphere([[0.5, -0.75], [0.5, -0.875], [0.5, -5.0]], 0.5, inside=False)
    assert tf.measure.overlaps(state, [ball]).walls.tolist() == [0.25, 0.125, 0.0]
    assert tf.measure.overlaps(state.select([2, 1]), [ball]).walls.tolist() == [0.0, 0.125]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("gap", [0.0, 0.5, 3.0])
def test_neighbours_are_all_pairs_of_a_colony_within_the_gap(device, dtype, dim, gap):
    """Against every pair with near centres, both from the state's own numbers.

    Two colonies at one position have no common pairs.
    """
    scene = tf.Scene(tf.Growth(), founders=crowd(np.random.default_rng(7), 150, dim))
    state = scene.bind(2, device=device, dtype=dtype).start()
    i, j, distance = tf.measure.neighbours(state, gap)
    found = {(min(p), max(p)) for p in zip(i.tolist(), j.tolist(), strict=True)}
    assert len(found) == i.numel() and found == set(map(tuple, near_pairs(state, gap).tolist()))
    place = state.position
    assert distance.dtype == torch.float64 and torch.allclose(
        distance, (place[i] - place[j]).norm(dim=1), rtol=1e-14
    )
    alone = tf.measure.neighbours(state.select([1]), gap)
    second = state.colony[i] == 1
    assert (
        torch.equal(alone[0] + 150, i[second])
        and torch.equal(alone[1] + 150, j[second])
        and torch.equal(alone[2], distance[second])
    )


@pytest.mark.parametrize("gap", [-1.0, math.inf, "near"])
def test_neighbours_within_no_such_gap_are_refused(gap):
    with pytest.raises(tf.InputError, match="gap"):
        tf.measure.neighbours(tf.Scene(tf.Growth()).bind().start(), gap)


@pytest.mark.parametrize(
    "name",
    [
        "overlaps", "colony_centre", "colony_radius", "depth", "nematic_order", "tilt",
        "neighbours", "wall_forces", "growth_rates", "strains", "heterozygosity",
        "pressure", "clusters", "alike_neighbours", "film", "displacement",
        "below_top", "below_edge", "outline", "profile", "correlation",
    ],
)  # fmt: skip
def test_a_measure_of_no_state_is_refused(name):
    measure = getattr(tf.measure, name)
    more = {
        "neighbours": {"gap": 1.0}, "clusters": {"gap": 1.0}, "alike_neighbours": {"gap": 1.0},
        "profile": {"name": "y", "edges": [0, 1]}, "correlation": {"name": "y", "edges": [0, 1]},
        "wall_forces": {"walls": []},
        "growth_rates": {"earlier": None}, "displacement": {"earlier": None},
        "pressure": {"scene": None},
    }.get(name, {})  # fmt: skip
    with pytest.raises(tf.InputError, match=rf"{name}\(state\) = None.*a tf\.State"):
        measure(None, **more)
    with pytest.raises(tf.InputError, match=rf"{name} has no parameter 'unheard_of'"):
        measure(None, unheard_of=1)


def test_clusters_hang_together_and_are_numbered_by_size():
    """In a row: a pair, three apart by 0.05 µm each, one alone; the middle one of the three is of
    another kind. The second colony has these three alone."""
    ends = [0.0, 3.04, 9.0, 12.05, 15.1, 30.0]
    cells = tf.Cells(
        [[x, 0.0] for x in ends + ends[2:5]], [[1.0, 0.0]] * 9, 2.0,
        cell_type=[0, 0, 0, 1, 0, 1, 0, 1, 0], colony=[0] * 6 + [1] * 3,
    )  # fmt: skip
    state = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=2).bind(2).start()
    assert tf.measure.clusters(state, 0.1).tolist() == [1, 1, 0, 0, 0, 2, 0, 0, 0]
    assert tf.measure.clusters(state, 0.045).tolist() == [0, 0, 1, 2, 3, 4, 0, 1, 2]
    alike = tf.measure.clusters(state, 0.1, "cell_type")
    assert alike.tolist() == [0, 0, 1, 2, 3, 4, 0, 1, 2]
    assert tf.measure.alike_neighbours(state, 0.1).tolist() == pytest.approx([1 / 3, 0.0])
    none = tf.measure.alike_neighbours(state, 0.01)
    assert torch.isnan(none).all() and none.dtype == torch.float64
    with pytest.raises(tf.InputError, match=r"clusters\(name\) = 'length'.*a field of the cells"):
        tf.measure.clusters(state, 0.1, "length")


def test_clusters_do_not_depend_on_the_batch():
    scene = tf.Scene(tf.Growth(), founders=crowd(np.random.default_rng(7), 150, 2))
    state = scene.bind(2).start()
    state = state.replace(position=state.position * torch.linspace(1, 1.3, 300)[:, None])
    for gap in (0.0, 0.2, 1.0):
        found = tf.measure.clusters(state, gap)
        assert torch.equal(found[150:], tf.measure.clusters(state.select([1]), gap))
        sizes = torch.bincount(found[:150])
        assert (sizes.diff() <= 0).all() and sizes.sum() == 150
        first, second, _ = tf.measure.neighbours(state, gap)
        assert torch.equal(found[first], found[second])


@pytest.mark.parametrize("walls", [3, ["a"]])
def test_walls_that_are_none_are_refused(walls):
    state = tf.Scene(tf.Growth(rate=1.0)).bind().start()
    with pytest.raises(tf.InputError, match=r"overlaps\(walls\) = .*a list of walls"):
        tf.measure.overlaps(state, walls)


@pytest.mark.parametrize("length_drag", [10.0, 1e5])
@pytest.mark.parametrize("stiffness", [None, [1e6, 2e6]])
def test_a_cell_held_between_walls_pushes_with_its_length_drag(length_drag, stiffness):
    """Growth that is stopped needs γ · dl/dt, here γ, at both ends; a soft wall of stiffness k
    yields to it by γ/k, so that growth is stopped after some (γ + k Δl) / k hours."""
    wall = tf.Box((-1.5, -math.inf), (1.5, math.inf), stiffness=stiffness)
    mechanics = tf.Mechanics(dim=2, length_drag=length_drag, walls=[wall], tolerance=1e-5)
    scene = tf.Scene(mechanics, tf.Growth(rate=1.0, law="linear"), dt=0.01)
    *_, state = tf.simulate(scene, until=2.0, colonies=2)
    found = tf.measure.wall_forces(state, [wall])
    assert found.facing[:2] == ((1.0, 0.0), (-1.0, 0.0))
    assert found.force[:, :2].reshape(-1).tolist() == pytest.approx([length_drag] * 4, rel=2e-3)


def test_forces_on_walls_balance_in_a_full_box():
    """At rest nothing is pushed out on either side: those on opposite sides are the same to a few
    per cent, in each of several colonies."""
    wall = tf.Box((-6.0, -6.0), (6.0, 6.0))
    scene = tf.Scene(
        tf.Mechanics(dim=2, length_drag=1000.0, walls=[wall], tolerance=1e-4),
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)),
    )  # fmt: skip
    total, steps = torch.zeros(2, 4, dtype=torch.float64), 0
    for state in tf.simulate(scene, until=6.0, colonies=2):
        if state.time > 5.0:
            total, steps = total + tf.measure.wall_forces(state, [wall]).force, steps + 1
    for one, other in ((0, 1), (2, 3)):
        assert total[:, one].tolist() == pytest.approx(total[:, other].tolist(), rel=0.05)
    assert bool((total / steps > 1000.0).all())


@pytest.mark.parametrize("stiffness", [None, 3e5])
@pytest.mark.parametrize("dim", [2, 3])
def test_pressure_on_a_row_of_cells_between_walls(dim, stiffness):
    """Each of three cells end to end, whose growth is stopped, is pushed by γ at both ends."""
    wall = tf.Box((-4.5, *[-math.inf] * (dim - 1)), (4.5, *[math.inf] * (dim - 1)))
    row = [[3.0 * k, *[0.0] * (dim - 1)] for k in (-1, 0, 1)]
    scene = tf.Scene(
        tf.Mechanics(
            dim=dim, length_drag=1000.0, walls=[wall], tolerance=1e-5, stiffness=stiffness
        ),
        tf.Growth(rate=1.0, law="linear"), dt=0.01,
        founders=tf.Cells(row, [[1.0, *[0.0] * (dim - 1)]] * 3),
    )  # fmt: skip
    *_, state = tf.simulate(scene, until=2.0, colonies=2)
    found = tf.measure.pressure(state, scene)
    length, radius = state.length.double(), state.radius.double()
    flat = 2 * radius * length + math.pi * radius**2
    size = flat if dim == 2 else state.volume.double()
    expected = 1000.0 * (length + 2 * radius) / (dim * size)
    assert found.tolist() == pytest.approx(expected.tolist(), rel=4e-3)


@pytest.mark.parametrize("dim, filled", [(2, (0.85, 0.95)), (3, (0.6, 0.7))])
def test_cells_of_a_full_chamber_carry_what_gaps_do_not(dim, filled):
    """Pressure on cells times the share that they fill is the pressure on the walls: the virial of
    all forces. Overlaps give the forces with an error of second order in dt: 5 % at 0.025 h."""
    side = 12.0 if dim == 2 else 6.0
    box = tf.Box((-side / 2,) * dim, (side / 2,) * dim)
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=dim, length_drag=1000.0, walls=[box], tolerance=1e-4), dt=0.00625,
    )  # fmt: skip
    cells, walls, share = [], [], []
    for state in tf.simulate(scene, until=6.0, seed=1):
        if state.time > 5.5:
            flat = 2 * state.radius * state.length + math.pi * state.radius**2
            size = (flat if dim == 2 else state.volume).double()
            found = tf.measure.pressure(state, scene)
            cells.append(float((found * size).sum()) / side**dim)
            force = tf.measure.wall_forces(state, [box]).force
            walls.append(float(force.mean()) / side ** (dim - 1))
            share.append(float(size.sum()) / side**dim)
    mean = lambda x: sum(x) / len(x)
    assert filled[0] < mean(share) < filled[1]
    assert mean(cells) == pytest.approx(mean(walls), rel=0.01)


def test_forces_are_those_of_the_step_that_was_taken():
    """A rod between two walls grows at γ: its force is that of growth, whatever the scene's dt."""
    walls = [tf.Plane(x=0.0, facing="+x"), tf.Plane(x=3.0, facing="-x")]
    founders = tf.Cells([[1.5, 0.0]], [[1.0, 0.0]], 2.0)
    scene = tf.Scene(
        tf.Growth(rate=1.0, law="length"), tf.Mechanics(walls, dim=2, length_drag=1e3),
        founders=founders, dt=0.025,
    )  # fmt: skip
    for dt in (0.025, 0.00625):
        *_, state = tf.simulate(scene, until=0.5, dt=dt)
        force = tf.measure.wall_forces(state, scene).force
        assert force.tolist() == [pytest.approx([2000.0, 2000.0], rel=0.02)]
        area = 2 * 0.5 * 2.0 + math.pi * 0.25  # the arm of both forces is 1.5 µm
        found = float(tf.measure.pressure(state, scene))
        assert found == pytest.approx(2 * 2000.0 * 1.5 / (2 * area), rel=0.03)


def test_pressure_of_cells_apart_and_of_what_is_no_scene():
    scene = tf.Scene(tf.Mechanics(dim=2), founders=tf.Cells([[0, 0], [5.0, 0]], [[0, 1.0]] * 2))
    *_, state = tf.simulate(scene, until=0.05, colonies=2)
    assert tf.measure.pressure(state, scene).tolist() == [0.0] * 4
    for unknown in (state.select([0]), scene.bind().start()):
        with pytest.raises(tf.InputError, match="in which steps"):
            tf.measure.pressure(unknown, scene)
    with pytest.raises(tf.InputError, match=r"pressure\(scene\) = .*the tf.Scene of the state"):
        tf.measure.pressure(state, [])
    with pytest.raises(tf.InputError, match="contact_alpha"):
        tf.measure.pressure(tf.Scene(tf.Growth(rate=1.0), dim=2).bind().start(), scene)


def test_forces_need_one_sided_contacts_and_a_stiffness_that_is_not_drawn():
    wall = tf.Plane(y=-2.0, facing="+y", stiffness=tf.Uniform(9.0, 10.0))
    both = (tf.Mechanics(dim=2, contacts="bilateral"), tf.Mechanics(dim=2, walls=[wall]))
    states = [list(tf.simulate(tf.Scene(m), until=0.025))[-1] for m in both]
    with pytest.raises(tf.InputError, match="contact_alpha"):
        tf.measure.wall_forces(states[0], [tf.Plane(y=-2.0, facing="+y")])
    with pytest.raises(tf.InputError, match=r"Plane\.stiffness.*one number"):
        tf.measure.wall_forces(states[1], [wall])


def test_a_wall_may_be_softer_for_one_type_of_cells():
    """Both ends of two cells are 0.1 µm deep in it: 2 · (10 + 40) · 0.1, while they stay there."""
    wall = tf.Plane(y=-0.4, facing="+y", stiffness={0: 10.0, 1: 40.0})
    cells = tf.Cells([[0, 0], [9, 0]], [[1, 0], [1, 0]], 2.0, cell_type=[0, 1])
    scene = tf.Scene(tf.Mechanics(dim=2, walls=[wall]), founders=cells, dt=1e-6)
    *_, state = tf.simulate(scene, until=1e-6, dtype=torch.float64)
    found = tf.measure.wall_forces(state, [wall]).force
    assert float(found[0, 0]) == pytest.approx(10.0, rel=1e-3)


def test_a_wall_may_weigh_less_for_one_type_of_cells():
    for weight in ({0: 0.5, 1: 1.0}, {0: tf.Uniform(0.5, 0.6), 1: 1.0}, {0: [0.5, 0.7], 1: 1.0}):
        wall = tf.Plane(y=-3.0, facing="+y", weight=weight)
        cells = tf.Cells([[0, 0], [9, 0]], [[1, 0], [1, 0]], 2.0, cell_type=[0, 1])
        scene = tf.Scene(tf.Mechanics(dim=2, walls=(w for w in [wall])), founders=cells)
        (made,) = scene.effects[0].walls
        assert made.yields and "1 with a stiffness or weight" in str(tf.explain(scene, colonies=2))


def test_growth_rates_are_those_that_pressure_leaves():
    """A cell that is held between walls does not grow; a free one does at its rate; a cell that was
    born meanwhile has none."""
    wall = tf.Box((-1.5, -math.inf), (1.5, math.inf))
    for walls, wanted in (([], 1.0), ([wall], 0.0)):
        scene = tf.Scene(tf.Mechanics(dim=2, walls=walls), tf.Growth(rate=1.0))
        earlier, state = [*tf.simulate(scene, until=0.2, colonies=2)][-2:]
        assert tf.measure.growth_rates(state, earlier).tolist() == pytest.approx(
            [wanted] * 2, abs=0.01
        )
        assert state.growth_rate.tolist() == [1.0, 1.0]
    states = [*tf.simulate(tf.scenes.microcolony(), until=1.0)]
    rates = tf.measure.growth_rates(states[-1], states[0])
    new = ~torch.isin(states[-1].uid, states[0].uid)
    assert torch.equal(rates.isnan(), new) and bool(new.any())
    with pytest.raises(tf.InputError, match="earlier"):
        tf.measure.growth_rates(states[0], states[-1])


def test_changes_are_those_of_the_same_colony():
    """Cells have numbers within their colony: the first of both colonies is cell 0."""
    scene = tf.Scene(tf.Growth(rate=[0.5, 1.0]), tf.Motility(speed=[3.0, 6.0]), dim=2)
    earlier, state = [*tf.simulate(scene, until=0.2, colonies=2)][-2:]
    passed = state.time - earlier.time
    rates = tf.measure.growth_rates(state, earlier)
    assert rates.tolist() == pytest.approx([0.5, 1.0], rel=1e-3)
    way = tf.measure.displacement(state, earlier).norm(dim=1)
    assert way.tolist() == pytest.approx([3.0 * passed, 6.0 * passed], rel=1e-3)
    alone = tf.measure.growth_rates(state.select([1]), earlier)
    assert torch.equal(alone, rates[1:])


def test_upright_cells_have_no_order_in_the_plane():
    made = lambda axes: tf.Scene(tf.Mechanics()).bind(
        cells=tf.Cells([[5.0 * k, 0.0, 0.0] for k in range(2)], axes)
    )
    order = lambda axes: float(tf.measure.nematic_order(made(axes).start()))
    assert math.isnan(order([[0.0, 0.0, 1.0]] * 2))
    assert order([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) == 1.0


def labelled() -> tf.State:
    """Two colonies of four and three cells, and an empty one; kinds 0, 0, 1, 4 and 1, 1, 1."""
    cells = tf.Cells(
        [[0.0, 1.0], [0.0, -1.0], [9.0, 0.0], [-9.0, 0.0], [0.0, 0.0], [3.0, 0.0], [-3.0, 0.0]],
        [[1.0, 0.0]] * 7, cell_type=[0, 0, 1, 4, 1, 1, 1], colony=[0, 0, 0, 0, 1, 1, 1],
        extra={"label": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.5]},
    )  # fmt: skip
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2, founders=cells)
    with pytest.warns(UserWarning, match="stays empty"):
        return scene.bind(3).start()


def test_strains_and_heterozygosity():
    state = labelled()
    found = tf.measure.strains(state)
    wanted = tf.measure.strains(state, kinds=[*found, 77])
    assert all(torch.equal(wanted[k], found[k]) for k in found)
    assert wanted[77].tolist() == [0] * state.colonies
    below = state.with_fields(cell_type=-state.cell_type)
    assert set(tf.measure.strains(below)) == {-k for k in found}
    assert {k: v.tolist() for k, v in found.items()} == {
        0: [2, 0, 0], 1: [1, 3, 0], 4: [1, 0, 0],
    }  # fmt: skip
    whole = tf.measure.heterozygosity(state).tolist()
    assert whole[0] == pytest.approx(1 - (0.25 + 0.0625 + 0.0625)) and whole[1] == 0.0
    assert math.isnan(whole[2])
    rings = tf.measure.heterozygosity(state, edges=[0.0, 2.0, 5.0, 10.0])
    assert rings[0, [0, 2]].tolist() == [0.0, 0.5] and bool(rings[0, 1].isnan())
    assert rings[1, :2].tolist() == [0.0, 0.0] and bool(rings[2].isnan().all())
    # along an axis, and a coordinate of one's own: the same as of the cells in each bin
    x = state.position[:, 0]
    edges = [float(x.min()) - 1.0, float(x.median()) + 1e-3, float(x.max()) + 1.0]
    found = tf.measure.heterozygosity(state, edges=torch.tensor(edges), along="x")
    assert torch.equal(found.nan_to_num(-1), tf.measure.heterozygosity(
        state, edges=edges, along=x).nan_to_num(-1))  # fmt: skip
    for colony in range(state.colonies):
        for k in range(2):
            kept = (x >= edges[k]) & (x < edges[k + 1]) & (state.colony == colony)
            shares = state.cell_type[kept].bincount().double() / kept.sum()
            wanted = 1 - shares.square().sum() if kept.any() else torch.tensor(math.nan)
            assert float(found[colony, k]) == pytest.approx(float(wanted), nan_ok=True)
    with pytest.raises(tf.InputError, match=r"heterozygosity\(along\) = 'r'"):
        tf.measure.heterozygosity(state, edges=edges, along="r")
    alone = tf.measure.heterozygosity(state.select([1]), edges=[0.0, 2.0, 5.0, 10.0])
    assert torch.equal(alone[0, :2], rings[1, :2])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"name": "label"}, "a field of one whole number for a cell"),
        ({"name": "fitness"}, r"heterozygosity\(name\) = 'fitness'.*a field of the cells"),
        ({"edges": [3.0]}, "two or more, µm, ascending"),
        ({"edges": [3.0, 3.0]}, "ascending"),
    ],
)
def test_what_has_no_heterozygosity(given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.measure.heterozygosity(labelled(), **given)
    plain = tf.Scene(tf.Growth(rate=1.0), dim=2).bind().start()
    with pytest.raises(tf.InputError, match="Give the first cells a type"):
        tf.measure.strains(plain)


def test_forces_on_no_walls():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2))
    *_, state = tf.simulate(scene, until=0.1, colonies=3)
    found = tf.measure.wall_forces(state, [])
    assert (tuple(found.force.shape), found.facing) == ((3, 0), ())
