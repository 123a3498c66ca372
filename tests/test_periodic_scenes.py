"""Periodic space in whole scenes: division, motility, threads, recordings, exports, first cells."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import check_same_bits_alone

import torchfilm as tf
from torchfilm.kernels import team
from torchfilm.physics import compiled

FACES = {"x": (0.0, 20.0), "y": (-4.0, 16.0)}


def colony(*others: tf.Effect, faces=FACES, **options) -> tf.Scene:
    """Cells that grow and divide, the first of them at a corner of the space."""
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.0, 4.0), axis_noise=0.02),
        tf.Mechanics(dim=2, periodic=faces, **options),
        *others,
        founders=tf.Cells(position=[[0.2, 15.9]], axis=[[1.0, 0.3]], length=2.0),
        dt=0.05,
    )


def test_all_positions_stay_between_the_faces():
    """Also those of daughters, which are born beside the middle of their parent."""
    for state in tf.simulate(colony(), cells=40):
        for k, (low, high) in enumerate(FACES.values()):
            x = state.position[:, k]
            assert (x >= low).all() and (x < high).all()
    assert state.cells >= 40
    # from these cells another run starts
    cells = tf.Cells(
        position=state.position.numpy(), axis=state.axis.numpy(), length=state.length.numpy()
    )
    assert colony().bind(cells=cells).start().cells == state.cells


def test_removal_at_the_faces_removes_nothing():
    keeps = tf.Removal(low=(0.0, -4.0), high=(20.0, 16.0))
    *_, one = tf.simulate(colony(), until=3.0, seed=1)
    *_, other = tf.simulate(colony(keeps), until=3.0, seed=1)
    assert torch.equal(one.position, other.position)


def test_a_colony_has_the_same_bits_alone_and_in_a_batch():
    check_same_bits_alone(colony(), 3.0, seed=5)


@pytest.mark.skipif(not team.AVAILABLE, reason="threads cannot wait for each other here")
def test_threads_that_share_a_colony_change_no_bit(monkeypatch):
    """A full layer of 400 cells, of which a team takes a hundred each."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(20) * 2.2, np.arange(20) * 1.0)
    position = np.stack([x.ravel(), y.ravel()], 1) + 0.1 * rng.uniform(0, 1, (400, 2))
    cells = tf.Cells(position=position, axis=[[1.0, 0.0]] * 400, length=1.3)
    scene = colony(faces={"x": (0.0, 44.2), "y": (0.0, 20.2)})
    teams, by_team, ends = [], compiled._call_by_team, []
    monkeypatch.setattr(compiled, "_call_by_team", lambda *a: (teams.append(a[1]), by_team(*a))[1])
    monkeypatch.setattr(compiled, "CELLS_A_THREAD", 100)
    for threads in (1, 2, 4):
        monkeypatch.setattr(compiled, "available", lambda threads=threads: threads)
        model = scene.bind(cells=cells)
        state = model.start()
        for _ in range(3):
            state = model.step(state)
        ends.append(state)
    assert all(torch.equal(ends[0].position, other.position) for other in ends[1:])
    assert set(teams) == {2, 4} and int(ends[0].reports["mechanics"].iterations) > 0


def test_cells_glide_through_faces_as_in_open_space():
    """One cell, without others: its way is that of a cell without faces, modulo the period."""
    ways = []
    for faces in (FACES, {}):
        scene = tf.Scene(
            tf.Motility(speed=20.0, turning=0.3, reversals=0.5),
            tf.Mechanics(dim=2, periodic=faces),
            founders=tf.Cells(position=[[19.0, 0.0]], axis=[[1.0, 0.1]], length=2.0),
        )
        *_, state = tf.simulate(scene, until=3.0, dt=0.005, dtype=torch.float64, seed=3)
        ways.append(state.position[0])
    away = ways[0] - ways[1]
    assert float(away.abs().max()) > 1.0
    assert float((away / 20.0 - torch.round(away / 20.0)).abs().max()) < 1e-10


def test_displacements_add_up_across_faces():
    """The way of a cell that glides through a face, and none of daughters that were not there."""
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=3.0), tf.Motility(speed=20.0),
        tf.Mechanics(dim=2, periodic=FACES),
        founders=tf.Cells(position=[[19.0, 0.0]], axis=[[1.0, 0.0]], length=2.0), dt=0.005,
    )  # fmt: skip
    way, earlier = 0.0, scene.bind(dtype=torch.float64).start()
    for state in tf.simulate(scene, until=0.3, dtype=torch.float64):
        way += float(tf.measure.displacement(state, earlier)[0, 0])
        earlier = state
    assert way == pytest.approx(0.3 * 20.0, rel=1e-6) and float(state.position[0, 0]) < 19.0
    *_, later = tf.simulate(scene, until=0.6, dtype=torch.float64)
    assert later.cells == 2 and torch.isnan(tf.measure.displacement(later, state)).all()
    with pytest.raises(tf.InputError, match=r"displacement\(earlier\) = 'a state at 0\.6 h'"):
        tf.measure.displacement(later, later)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run of three frames, the first with one cell across the left face."""
    scene = tf.Scene(
        tf.Growth(rate=0.5), tf.Mechanics(dim=2, periodic={"x": (0.0, 20.0)}),
        founders=tf.Cells(position=[[0.1, 5.0]], axis=[[1.0, 0.0]], length=2.0), dt=0.1,
    )  # fmt: skip
    path = tmp_path_factory.mktemp("periodic") / "run.h5"
    for _ in tf.simulate(scene, until=0.2, record=path):
        pass
    return scene, path


def test_a_recording_knows_the_faces_and_goes_on(recorded):
    scene, path = recorded
    with tf.Results(path) as results:
        assert results.periodic == {"x": (0.0, 20.0)}
        state = results.state(scene, -1)
    assert state.space.faces == {"x": (0.0, 20.0)}
    *_, whole = tf.simulate(scene, until=0.2)
    assert torch.equal(state.position, whole.position)


def test_masks_and_images_show_both_parts_of_a_cell_at_a_face(recorded, tmp_path):
    tifffile = pytest.importorskip("tifffile")
    _, path = recorded
    with tf.Results(path) as results:
        results.to_labels(tmp_path / "masks.tif", pixel_size=0.1, frames=[0])
        results.to_labels(
            tmp_path / "wide.tif", pixel_size=0.1, frames=[0], window=((-20.0, 0.0), (40.0, 10.0))
        )
    mask = tifffile.imread(tmp_path / "masks.tif")
    assert mask.shape[-1] == 200  # from face to face
    assert mask[..., :16].any() and mask[..., -14:].any() and not mask[..., 20:180].any()
    area = 0.01 * (mask > 0).sum()
    assert area == pytest.approx(2.0 * 1.0 + np.pi * 0.25, rel=0.05)
    assert (tifffile.imread(tmp_path / "wide.tif") > 0).sum() == pytest.approx(300 * area, rel=0.01)


def test_fluorescence_shows_both_parts_and_ground_truth_whole_cells(recorded, tmp_path):
    """An image of light has two parts of the cell at a face; tracks have it once, beyond the
    face."""
    tifffile = pytest.importorskip("tifffile")
    _, path = recorded
    with tf.Results(path) as results:
        results.to_ome_tiff(
            tmp_path / "light.ome.tif", channels={"length": 1.0}, pixel_size=0.1, frames=[0]
        )
        results.to_ctc(tmp_path / "truth", channels={"length": 1.0}, pixel_size=0.1)
    light = tifffile.imread(tmp_path / "light.ome.tif").squeeze()
    assert light.shape[-1] == 200 and light[:, :10].max() > 0 and light[:, -10:].max() > 0
    (mask, *_) = sorted((tmp_path / "truth").rglob("man_seg*.tif"))
    whole = tifffile.imread(mask)
    columns = np.flatnonzero((whole > 0).any(0))
    assert len(columns) == columns[-1] - columns[0] + 1 and len(columns) == pytest.approx(30, abs=2)


def test_sections_show_cells_across_the_upper_face(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    faces = dict.fromkeys("xyz", (0.0, 20.0))
    scene = tf.Scene(
        tf.Mechanics(periodic=faces),
        founders=tf.Cells(position=[[10.0, 10.0, 0.1]], axis=[[1.0, 0.0, 0.0]], length=2.0),
    )
    for _ in tf.simulate(scene, until=0.1, dt=0.1, record=tmp_path / "run.h5"):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        for name, z in (("low", 0.4), ("high", 19.8)):
            results.to_labels(tmp_path / f"{name}.tif", pixel_size=0.1, frames=[0], z=z)
        with pytest.raises(tf.InputError, match="between the faces"):
            results.to_labels(tmp_path / "no.tif", pixel_size=0.1, frames=[0], z=-0.2)
    low, high = (tifffile.imread(tmp_path / f"{name}.tif") for name in ("low", "high"))
    assert low.any() and (low == high).all()  # 0.3 µm above and below its axis


def test_the_limit_of_lengths_counts_what_contacts_reach():
    """2.5 µm with caps and 0.3 µm: 2.75 of half a period are too few, 2.85 are enough."""
    for half, fails in ((2.75, True), (2.85, False)):
        scene = tf.Scene(
            tf.Mechanics(dim=2, periodic={"x": (0.0, 2 * half)}),
            founders=tf.Cells(position=[[1.0, 0.0]], axis=[[0.0, 1.0]], length=1.5),
        )
        if fails:
            with pytest.raises(tf.InputError, match=r"its contacts reach 0\.3 µm"):
                scene.bind().start()
            continue
        start = scene.bind().start()
        assert not tf.failures(scene.bind().step(start, 0.01))
        longer = start.replace(length=start.length + 0.1)
        assert tf.failures(scene.bind().step(longer, 0.01))


def test_pictures_show_images_beyond_the_faces(recorded):
    from torchfilm.pictures.shapes import with_images

    _, path = recorded
    with tf.Results(path) as results:
        cells = {n: x for n, x in results.frame(0).items() if len(x) == 1}
        picture = tf.show(results, frame=0)
    assert len(picture.figure.axes[0].collections) == 1
    shown = with_images(cells, {"x": (0.0, 20.0)}, "xy", (-25.0, 45.0, 0.0, 10.0))
    assert sorted(np.round(shown["position"][:, 0], 3)) == [-19.9, 0.1, 20.1, 40.1]
    few = with_images(cells, {"x": (0.0, 20.0)}, "xy", (0.0, 20.0, 0.0, 10.0))
    assert sorted(np.round(few["position"][:, 0], 3)) == [0.1, 20.1]


def test_first_cells_are_pushed_apart_across_faces():
    cells = tf.Cells(position=[[0.2, 5.0], [19.7, 5.0]], axis=[[0.0, 1.0]] * 2, length=2.0)
    faces = {"x": (0.0, 20.0)}
    assert cells.overlaps() == []
    ((i, j, deep),) = cells.overlaps(periodic=faces)
    assert {i, j} == {0, 1} and deep == pytest.approx(0.5)
    apart = cells.relaxed(periodic=faces)
    assert apart.overlaps(0.01, periodic=faces) == []
    scene = tf.Scene(tf.Mechanics(dim=2, periodic=faces))
    deeper = tf.Cells(position=[[0.0, 5.0], [19.8, 5.0]], axis=[[0.0, 1.0]] * 2, length=2.0)
    with pytest.warns(RuntimeWarning, match=r"deep in one another.*relaxed\(periodic=…\)"):
        scene.bind(cells=deeper)
    same = tf.Cells(position=[[0.0, 5.0], [20.0, 5.0]], axis=[[0.0, 1.0]] * 2, length=2.0)
    with pytest.warns(RuntimeWarning, match="start at the same place"):
        scene.bind(cells=same)


def test_rules_see_contacts_across_faces():
    seen = []
    scene = tf.Scene(
        tf.Rules(lambda cells: seen.append(cells.contact_count(0.2).tolist())),
        tf.Mechanics(dim=2, periodic={"x": (0.0, 20.0)}),
        founders=tf.Cells(
            position=[[0.4, 5.0], [19.3, 5.0], [10.0, 5.0]], axis=[[0.0, 1.0]] * 3, length=2.0
        ),
    )
    model = scene.bind()
    model.step(model.start(), 0.01)
    assert seen[-1] == [1, 1, 0]


def test_films_of_boxes_that_grow_apart_need_a_span():
    scene = tf.Scene(
        tf.Growth(rate=[0.1, 2.0]), tf.Division(length=4.0), tf.Mechanics(dim=2),
        tf.Medium(
            food=tf.Signal(diffusion=1.0, initial=1.0), box=((-10, -10), (10, 10)), spacing=2.0,
            outside="grow",
        ),
        founders=tf.Cells(position=[[0.0, 5.0]], axis=[[1.0, 0.0]], length=2.0),
    )  # fmt: skip
    *_, state = tf.simulate(scene, until=3.0, dt=0.05, seed=0)
    if torch.equal(state.layout.grid.shape[0], state.layout.grid.shape[1]):
        pytest.fail("the boxes did not grow apart")
    with pytest.raises(tf.InputError, match="as wide in all colonies"):
        tf.measure.film(state)
    whole = tf.measure.film(state, across={"x": (-30.0, 30.0)})
    alone = tf.measure.film(state.select([0]), across={"x": (-30.0, 30.0)})
    assert torch.equal(whole.height[:1], alone.height)


def test_a_film_has_a_floor():
    scene = tf.Scene(tf.Mechanics(dim=2, periodic={"y": (0.0, 20.0)}))
    state = scene.bind(cells=tf.Cells.single(2)).start()
    with pytest.raises(tf.InputError, match="space is periodic there: there is no floor"):
        tf.measure.film(state, across={"x": (0.0, 10.0)})
    with pytest.raises(tf.InputError, match=r"film\(across\) = \(0, 10\)"):
        tf.measure.film(state.replace(space=None), across=(0, 10))
    film = tf.measure.film(state.replace(space=None), 16.0, across={"x": (0.0, 40.0)})
    assert film.height.shape == (1, 3)  # of 13.3 µm


def test_how_far_cells_moved_is_counted_across_faces():
    """One that is pushed out at a face comes in at the other, and has hardly moved."""
    table = {"x_px": [0.5, 6.0], "y_px": [50.0, 50.0], "angle_rad": [1.57, 1.57],
             "length_px": [20.0, 20.0]}  # fmt: skip
    cells = tf.Cells.from_table(table, pixel_size=0.1, radius=0.5)
    apart = cells.relaxed(periodic={"x": (0.0, 20.0)})
    assert apart.position[0, 0] > 19.0
    assert np.all((apart.micrograph.moved > 0.1) & (apart.micrograph.moved < 0.5))


def test_a_state_of_another_scene_has_the_space_of_the_model_that_steps_it():
    with_faces = tf.Scene(tf.Mechanics(dim=2, periodic={"x": (0, 40)}))
    without = tf.Scene(tf.Mechanics(dim=2))
    state = with_faces.bind().start()
    assert state.space.faces == {"x": (0.0, 40.0)} and state.select([0]).space == state.space
    assert without.bind(state=state).step(state).space is None


def test_measures_see_neighbours_across_faces():
    scene = tf.Scene(tf.Mechanics(dim=2, periodic={"x": (0, 40)}))
    cells = tf.Cells(
        position=[[0.4, 5.0], [39.7, 5.0], [20.0, 5.0]], axis=[[0.0, 1.0]] * 3, length=2.0,
        cell_type=[1, 1, 0],
    )  # fmt: skip
    state = scene.bind(cells=cells).start()
    i, j, apart = tf.measure.neighbours(state, 0.2)
    assert sorted([int(i), int(j)]) == [0, 1] and float(apart) == pytest.approx(0.7)
    assert tf.measure.clusters(state, 0.2).tolist() == [0, 0, 1]
    assert float(tf.measure.overlaps(state).worst) == pytest.approx(0.3)
    assert float(tf.measure.alike_neighbours(state, 0.2)) == 1.0
