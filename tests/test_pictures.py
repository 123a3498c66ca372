"""Pictures: outlines of capsules, sheets of colonies, and input errors."""

from __future__ import annotations

import io
import math
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import torchfilm as tf
from torchfilm.pictures import Frame, frame_of, outlines, scale_bar
from torchfilm.pictures.colours import PlotStyle
from torchfilm.pictures.draw import WALL, add_walls, set_window
from torchfilm.pictures.frames import RecordedFrames
from torchfilm.pictures.page import plan_layout


def sheet(what, path: Path, **options) -> Path:
    """A state or a frame as a picture at `path`."""
    return tf.show(what, out=path, **options).path


def outline(axis, length=2.0, radius=0.5, position=(0.0, 0.0)) -> np.ndarray:
    """One polygon, (2·CAP_POINTS, 2)."""
    return outlines(
        np.array([position]), np.array([axis], dtype=float), np.array([length]), np.array([radius])
    )[0]


def area(polygon: np.ndarray) -> float:
    """Signed area by the shoelace formula."""
    x, y = polygon.T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def distance_to_segment(points: np.ndarray, half: float, axis: np.ndarray) -> np.ndarray:
    s = np.clip(points @ axis, -half, half)
    return np.linalg.norm(points - s[:, None] * axis, axis=1)


# --- outlines -------------------------------------------------------------------------------------


def test_an_upright_cell_is_a_circle():
    """In end view every point of the outline is at the radius, for any length, and all directions
    occur.
    """
    polygon = outline((0.0, 0.0), length=7.0, radius=0.4, position=(3.0, -2.0))
    from_centre = polygon - (3.0, -2.0)
    assert np.allclose(np.linalg.norm(from_centre, axis=1), 0.4, rtol=1e-12)
    angles = np.sort(np.arctan2(from_centre[:, 1], from_centre[:, 0]))
    assert np.diff(angles).max() < math.pi / 5


@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi / 2, 2.5, math.pi])
def test_a_lying_cell_is_a_capsule(angle):
    axis = np.array([math.cos(angle), math.sin(angle)])
    polygon = outline(axis, 3.0, 0.5)
    assert np.allclose(distance_to_segment(polygon, 1.5, axis), 0.5, rtol=1e-12), (
        "points of the outline lie at the radius"
    )
    assert (polygon @ axis).max() == pytest.approx(2.0) and (polygon @ axis).min() == pytest.approx(
        -2.0
    )
    # rectangle 2rl and two half circles, as polygons of the 6 chords that 7 points make: 2 · 6 · ½
    # r² sin 30° = 3 r²
    assert abs(area(polygon)) == pytest.approx(2 * 0.5 * 3.0 + 3 * 0.25, rel=1e-12), (
        "or the polygon crosses itself"
    )


def test_a_tilted_cell_is_foreshortened():
    """The centreline's projection has half its length, and the caps stay round."""
    assert abs(area(outline((0.5, 0.0), 3.0, 0.5))) == pytest.approx(
        2 * 0.5 * 1.5 + 3 * 0.25, rel=1e-12
    )


def test_many_outlines_at_once_are_each_their_own():
    rng = np.random.default_rng(0)
    position, axis, length, radius = (
        rng.normal(size=(5, 2)),
        rng.normal(size=(5, 2)),
        rng.uniform(0, 3, 5),
        rng.uniform(0.3, 1, 5),
    )
    axis /= np.linalg.norm(axis, axis=1, keepdims=True) * 1.3
    together = outlines(position, axis, length, radius)
    assert together.shape[0] == 5
    for k in range(5):
        assert np.array_equal(
            together[k], outlines(*(x[k : k + 1] for x in (position, axis, length, radius)))[0]
        )
    assert np.isfinite(outlines(position, 0 * axis, 0 * length, radius)).all()


# --- sheets ---------------------------------------------------------------------------------------


def cells_of(state: tf.State) -> Frame:
    return frame_of(state)


@pytest.fixture(scope="module")
def grown() -> tf.State:
    scene = tf.scenes.microcolony(dim=3)
    for state in tf.simulate(scene, scene.bind(3).start(), until=3.0):  # noqa: B007
        pass
    return state


def coloured(path) -> float:
    """The share of coloured pixels in a picture; only cells are coloured."""
    image = matplotlib.image.imread(path)[..., :3]
    return float(((image.max(2) - image.min(2)) > 0.15).mean())


@pytest.mark.parametrize("view", ["xy", "xz", "yz"])
@pytest.mark.parametrize("colour", ["angle", "length", "uid", "growth_rate", "divide_flag"])
def test_a_sheet_is_written(grown, tmp_path, view, colour):
    path = sheet(
        cells_of(grown), tmp_path / "sheet.png", view=view, colour=colour, title="three colonies"
    )
    assert path == tmp_path / "sheet.png" and path.stat().st_size > 2000
    assert coloured(path) > 0.01


def test_a_frame_of_a_state_is_that_of_its_file(grown, tmp_path):
    scene = tf.scenes.microcolony(dim=3)
    for _ in tf.simulate(
        scene, grown, until=grown.time + 0.025, record=tf.Recorder(tmp_path / "run.h5", scene)
    ):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        recorded = results.frame(0)
    made = cells_of(grown)
    assert set(made.cells) == set(recorded)
    assert all(np.array_equal(made.cells[n], recorded[n]) for n in recorded)
    assert made.time == grown.time and made.units["growth_rate"] == "1/h"


def test_one_cell_is_as_large_as_it_should_be(tmp_path):
    """A rod of 4 × 1 µm has about its share of a square around it, and is four times as wide as
    high.
    """
    state = tf.Scene(tf.Growth(), founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 3.0)).bind().start()
    path = sheet(cells_of(state), tmp_path / "one.png")
    image = matplotlib.image.imread(path)[..., :3]
    image = image[: int(0.8 * len(image))]  # the legend is below
    y, x = np.nonzero((image.max(2) - image.min(2)) > 0.15)
    assert (np.ptp(x) + 1) / (np.ptp(y) + 1) == pytest.approx(4.0, rel=0.05), (
        "the scale differs along x and y"
    )


@pytest.mark.parametrize("away", [(1e4, -1e4), (-50.0, 0.0), (0.0, 300.0)])
def test_a_colony_far_from_the_origin_is_drawn(tmp_path, away):
    near = tf.Cells([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]], [1.0, 0.0])
    far = tf.Cells(near.position + np.array(away), [1.0, 0.0])
    shares = []
    for name, cells in (("near", near), ("far", far)):
        state = tf.Scene(tf.Growth(), founders=cells).bind().start()
        shares.append(coloured(sheet(cells_of(state), tmp_path / f"{name}.png")))
    assert shares[0] > 0.02
    assert shares[1] == pytest.approx(shares[0], rel=0.05), (
        "it is the same colony and should look the same"
    )


def test_colonies_far_apart_are_each_in_the_middle_of_their_panel(tmp_path):
    cells = tf.Cells([[0.0, 0.0], [500.0, 0.0]], [1.0, 0.0], colony=[0, 1])
    one = tf.Cells([[0.0, 0.0]], [1.0, 0.0])
    two = tf.Scene(tf.Growth(), founders=cells).bind().start()
    both = tf.Scene(tf.Growth(), founders=one).bind(2).start()
    shares = [
        coloured(sheet(cells_of(s), tmp_path / f"{k}.png")) for k, s in enumerate((two, both))
    ]
    assert shares[0] == pytest.approx(shares[1], rel=0.05)


def test_a_colony_without_cells_is_left_out(grown, tmp_path):
    gone = grown.remove(grown.colony == 1, "removed")
    assert coloured(sheet(cells_of(gone), tmp_path / "sheet.png")) > 0.01


def test_too_many_colonies_are_cut_and_it_is_said(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    titles = []
    real = Figure.suptitle
    monkeypatch.setattr(
        Figure,
        "suptitle",
        lambda self, text, **options: titles.append(text) or real(self, text, **options),
    )
    state = tf.Scene(tf.Growth(), founders=tf.Cells.single(2)).bind(40).start()
    sheet(cells_of(state), tmp_path / "sheet.png", title="many")
    sheet(cells_of(state), tmp_path / "few.png", title="few", most=4)
    assert (
        titles[0].startswith("many")
        and "first 36 of 40" in titles[0]
        and "first 4 of 40" in titles[1]
    )


def test_axes_of_a_2_d_state_need_no_third_coordinate(tmp_path):
    state = tf.scenes.microcolony().bind(2).start()
    assert coloured(sheet(cells_of(state), tmp_path / "sheet.png")) > 0.02


# --- show -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("pictures") / "run.h5"
    scene = tf.scenes.microcolony()
    for _ in tf.simulate(scene, scene.bind(2).start(), until=3.0, record=path):
        pass
    return path


def test_show_draws_the_last_frame_and_writes_no_file(recorded, tmp_path):
    before = sorted(recorded.parent.iterdir())
    made = tf.show(recorded)
    assert made.path is None and "not saved" in repr(made)
    assert sorted(recorded.parent.iterdir()) == before
    assert made.save(tmp_path / "a.png") == made.path == tmp_path / "a.png"
    assert "a.png" in repr(made) and coloured(made.path) > 0.02


def test_a_notebook_displays_what_is_saved(recorded, tmp_path):
    made = tf.show(recorded, out=tmp_path / "a.png")
    png, size = made._repr_png_()
    shown, saved = (matplotlib.image.imread(x) for x in (io.BytesIO(png), made.path))
    assert np.array_equal(shown, saved)
    assert size == {"width": saved.shape[1] // 2, "height": saved.shape[0] // 2}


def test_an_older_picture_is_replaced(recorded, tmp_path):
    (tmp_path / "a.png").write_text("older")
    assert coloured(tf.show(recorded, out=tmp_path / "a.png").path) > 0.02


def test_show_takes_open_results_and_leaves_them_open(recorded, tmp_path):
    with tf.Results(recorded) as results:
        sheet(results, tmp_path / "a.png", frame=0)
        assert len(results) > 1
    sheet(recorded, tmp_path / "b.png", frame=0)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_what_show_cannot_take_is_reported(recorded, grown):
    with pytest.raises(tf.InputError, match=r"results = 3 .*its path.*tf\.show\(state\)"):
        tf.show(3)
    with pytest.raises(tf.InputError, match=r"frame = 0 .*a state, which is of one time"):
        tf.show(grown, frame=0)
    with pytest.raises(tf.InputError, match="results have their own walls"):
        tf.show(recorded, scene=tf.scenes.microcolony())
    with pytest.raises(tf.InputError, match="another file than the results"):
        tf.show(recorded, out=recorded)


def test_show_draws_any_frame_anywhere(recorded, tmp_path):
    first, last = (sheet(str(recorded), tmp_path / f"{k}.png", frame=k) for k in (0, -1))
    assert first.read_bytes() != last.read_bytes()
    assert sheet(recorded, str(tmp_path / "a.svg")).read_text().lstrip().startswith("<?xml")


def test_the_same_frame_makes_the_same_picture(recorded, tmp_path):
    a, b = (matplotlib.image.imread(sheet(recorded, tmp_path / f"{k}.png")) for k in "ab")
    assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"colour": "nonsense"}, r"colour.*'nonsense'.*angle.*length"),
        ({"colour": "lenght"}, r"colour = 'lenght'.*Did you mean 'length'\?"),
        ({"color": "length"}, r"show has no parameter 'color'\. Did you mean colour\?"),
        ({"colour": "position"}, r"colour.*'position'"),
        ({"view": "up"}, r"view.*'up'.*'xy'"),
        ({"view": "xz"}, r"view.*'xz'.*2-D"),
        ({"frame": 99}, r"frame = 99"),
        ({"limits": (0, 1)}, r"limits = \(0, 1\).*ranges by name"),
        ({"colour": "length", "limits": [0, 1]}, r'such as \{"length": \(0, 2\)\}'),
        ({"colonies": 1}, r"colonies = 1 .*Write colonies=\[1\]"),
        ({"colonies": "1"}, r"colonies = '1' .*a list of"),
        ({"most": "4"}, r"most = '4' .*a whole number"),
        ({"title": 3}, "title = 3 .*text"),
        ({"dpi": "high"}, "dpi = 'high' .*a number"),
        ({"dpi": -1}, "dpi = -1 .*at least 1"),
    ],
)
def test_what_cannot_be_drawn_is_reported(recorded, tmp_path, options, message):
    with pytest.raises(tf.InputError, match=message):
        tf.show(recorded, out=tmp_path / "a.png", **options)
    with pytest.raises(tf.InputError, match=r"too many.*Write out='a\.png'\."):
        tf.show(recorded, "a.png")
    assert not (tmp_path / "a.png").exists()


def test_internal_quantities_are_not_listed_but_drawn(tmp_path):
    scene = tf.scenes.microcolony()
    path = tmp_path / "run.h5"
    *_, state = tf.simulate(scene, until=0.2, record=path)
    hidden = [f.name for f in state.declared.values() if f.internal]
    with tf.Results(path) as results:
        drawable = [n for n in hidden if results.frame()[n].ndim == 1]
    assert drawable
    for what in (path, state):
        with pytest.raises(tf.InputError, match="growth_rate") as error:
            tf.show(what, colour="nonsense")
        assert not [n for n in hidden if n in str(error.value)]
        assert tf.show(what, colour=drawable[0])


def test_a_frame_without_cells_is_reported(tmp_path):
    state = tf.scenes.microcolony().bind().start()
    empty = state.remove(torch.tensor([True]), "removed")
    with pytest.raises(tf.InputError, match="no cell"):
        sheet(cells_of(empty), tmp_path / "a.png")


@pytest.mark.parametrize("style", [{"background": "food"}, {"whole": True}])
def test_the_box_is_drawn_also_where_all_cells_are_gone(style, tmp_path):
    medium = tf.Medium(
        food=tf.Signal(diffusion=1.0, initial=1.0), box=[[-9, -9], [9, 9]], spacing=3.0, depth=1.0
    )
    scene = tf.Scene(tf.Lysis(rate=1e9, releases={"food": "volume"}), medium, dim=2)
    *_, state = tf.simulate(scene, until=0.025)
    assert state.cells == 0
    for colour in (None, "length"):
        tf.show(state, scene=scene, colour=colour, out=tmp_path / "a.png", **style)
    with pytest.raises(tf.InputError, match=r"no cell to draw.*background"):
        tf.show(state, scene=scene)


def test_runs_without_cells_are_explained_and_drawn(tmp_path):
    """Reaction and diffusion alone: strips and films show the signal, as `show` does."""
    medium = tf.Medium(
        u=tf.Signal(1.0, initial=tf.Uniform(0.0, 1.0)), box=[[0, 0], [9, 9]], spacing=1.0
    )
    scene = tf.Scene(medium, dim=2, founders=tf.Cells(np.zeros((0, 2)), np.zeros((0, 2))))
    assert "measured for" in str(tf.explain(scene, seconds=0.2))
    path = tmp_path / "run.h5"
    for _ in tf.simulate(scene, until=0.1, record=tf.Recorder(path, scene, every=2)):
        pass
    strip = tf.pictures.strip(path, background="u", count=2)
    assert [ax.get_title() for ax in strip.figure.axes[:2]] == ["0 h, 0 cells", "0.1 h, 0 cells"]
    tf.pictures.movie(path, tmp_path / "run.gif", background="u")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.gif", "run.h5"]
    with pytest.raises(tf.InputError, match="no cell to draw"):
        tf.pictures.strip(path)


def test_a_place_that_is_not_there_is_reported(recorded, tmp_path):
    with pytest.raises((tf.InputError, FileNotFoundError), match="nowhere"):
        tf.show(recorded, out=tmp_path / "nowhere" / "a.png")


def test_a_kind_of_picture_that_is_not_known_is_reported(recorded, tmp_path):
    with pytest.raises((tf.InputError, ValueError), match="nonsense"):
        tf.show(recorded, out=tmp_path / "a.nonsense")


def walls_drawn(tmp_path, walls, view: str, dim: int = 3, colonies: int = 1) -> list[list]:
    """The walls in each colony's panel, drawn twice as in a film, of a run read from its file."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=dim, walls=walls), dt=0.05)
    path = tmp_path / "run.h5"
    for _ in tf.simulate(scene, scene.bind(colonies).start(), until=0.05, record=path):
        pass
    with tf.Results(path) as results:
        frame = RecordedFrames(results, [-1])[0]
        panels = []
        for place in range(colonies):
            ax = Figure().add_subplot()
            set_window(ax, (-9.0, 9.0, -5.0, 5.0))
            scale_bar(ax)
            for _ in range(2):
                add_walls(ax, frame.walls, int(frame.colony_id[place]), view)
            assert ax.get_xlim() == (-9.0, 9.0) and ax.get_ylim() == (-5.0, 5.0)
            panels.append([a for a in (*ax.lines, *ax.patches) if a.get_gid() == WALL])
            assert len(ax.lines) + len(ax.patches) == len(panels[-1]) + 1, (
                "the scale bar and nothing else"
            )
    return panels


def test_walls_are_drawn_where_they_stand(tmp_path):
    """A hard floor and a soft lid are lines in side view and invisible from above.

    An oblique wall is a line only in the view along it.
    """
    floor, lid = tf.Plane(z=-0.5, facing="+z"), tf.Plane(z=2.0, facing="-z", stiffness=30.0)
    askew = tf.Plane(point=(3.0, 0.0, 0.0), normal=(-0.6, 0.8, 0.0))
    (above,) = walls_drawn(tmp_path, [floor, lid, askew], "xy")
    assert len(above) == 1 and above[0].get_linestyle() == "-"
    x, y = above[0].get_data()
    assert np.abs(-0.6 * x + 0.8 * y + 1.8).max() < 1e-6 and np.hypot(*np.diff([x, y])) > 1e6
    (tmp_path / "run.h5").unlink()
    (side,) = walls_drawn(tmp_path, [floor, lid, askew], "xz")
    assert [(*line.get_ydata(), line.get_linestyle()) for line in side] == [
        (-0.5, -0.5, "-"),
        (2.0, 2.0, "--"),
    ]


def test_flat_walls_end_at_one_another(tmp_path):
    """A channel that is closed at one end, a box, and a wall that lies behind another one."""
    (channel,) = walls_drawn(tmp_path, [tf.Channel(width=4.0, low_end=-3.0)], "xy", dim=2)
    sides = [line for line in channel if np.ptp(line.get_ydata()) == 0]
    (end,) = [line for line in channel if line not in sides]
    assert sorted(line.get_ydata()[0] for line in sides) == [-2.0, 2.0]
    for line in sides:
        assert min(line.get_xdata()) == -3.0 and max(line.get_xdata()) > 1e5
    assert [*end.get_xdata(), *sorted(end.get_ydata())] == [-3.0, -3.0, -2.0, 2.0]
    (tmp_path / "run.h5").unlink()
    walls = [tf.Box((-4.0, -2.0), (4.0, 2.0)), tf.Plane(x=-5.0, facing="+x")]
    (box,) = walls_drawn(tmp_path, walls, "xy", dim=2)
    ends = sorted(tuple(map(sorted, (a.get_xdata(), a.get_ydata()))) for a in box)
    assert ends == [
        ([-4.0, -4.0], [-2.0, 2.0]), ([-4.0, 4.0], [-2.0, -2.0]), ([-4.0, 4.0], [2.0, 2.0]),
        ([4.0, 4.0], [-2.0, 2.0]),
    ]  # fmt: skip


def test_colonies_between_walls_are_shown_at_one_place():
    """Unless they are far from one another."""
    wall = tf.Mechanics(dim=2, walls=[tf.Channel(width=4.0)])
    for walls, apart, same in (([wall], 0.3, True), ([wall], 30.0, False), ([], 0.3, False)):
        cells = tf.Cells([[0.0, 0.0], [apart, 0.0]], [[1.0, 0.0]] * 2, 4.0, colony=[0, 1])
        scene = tf.Scene(tf.Growth(rate=1.0), *walls, founders=cells)
        frame = frame_of(scene.bind().start(), scene)
        windows = plan_layout([frame], [0, 1], PlotStyle()).windows
        assert (windows[0] == windows[1]) == same


def test_a_sheet_of_a_state_has_the_walls_that_the_picture_of_its_file_has(tmp_path):
    """Also where the scene has a medium, which frames hold otherwise."""
    medium = tf.Medium(ahl=tf.Signal(diffusion=1.0), box=((-8, -4), (8, 4)), spacing=4.0)
    for more in ((), (medium,)):
        walls = [tf.Channel(width=3.0, stiffness=20.0)]
        scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, walls=walls), *more, dt=0.05)
        path = tmp_path / f"run{len(more)}.h5"
        *_, state = tf.simulate(scene, colonies=2, until=0.05, record=path)
        pictures = [
            matplotlib.image.imread(p)
            for p in (
                sheet(path, tmp_path / "file.png"),
                sheet(state, tmp_path / "a.png", scene=scene),
                sheet(state, tmp_path / "b.png", title="scene, t = 0.05 h"),
            )
        ]
        assert np.array_equal(pictures[0], pictures[1])
        assert not np.array_equal(pictures[0], pictures[2])
    with pytest.raises(tf.InputError, match="a frame has its own walls"):
        sheet(frame_of(state, scene), tmp_path / "c.png", scene=scene)


def test_each_colonys_own_walls_are_drawn(tmp_path):
    walls = [
        tf.Channel(width=[4.0, 6.0], low_end=-8.0),
        tf.Sphere(centre=(5.0, 0.0), radius=[1.0, 2.0], inside=False),
    ]
    first, second = walls_drawn(tmp_path, walls, "xy", dim=2, colonies=2)
    for drawn, half, radius in ((first, 2.0, 1.0), (second, 3.0, 2.0)):
        (circle,) = [a for a in drawn if hasattr(a, "get_radius")]
        ends = sorted(tuple(np.abs(a.get_ydata())) for a in drawn if a is not circle)
        assert ends == [(half, half)] * 3
        assert circle.get_radius() == radius and tuple(circle.get_center()) == (5.0, 0.0)


def test_colonies_of_a_study_are_named_by_the_parameter_that_differs(tmp_path):
    """Or by two of them, but not by more."""
    founders, of_two = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]]), ("axis_noise = 0", "axis_noise = 0.1")
    for name, length, noise, titles in (
        ("one.h5", 9.0, 0.001, ["rate = 0.5: 1 cell", "rate = 1.25: 1 cell"]),
        ("two.h5", 9.0, [0.0, 0.1],
         [f"{of_two[0]}, rate = 0.5: 1 cell", f"{of_two[1]}, rate = 1.25: 1 cell"]),
        ("three.h5", [9.0, 8.0], [0.0, 0.1], ["colony 0: 1 cell", "colony 1: 1 cell"]),
    ):  # fmt: skip
        division = tf.Division(length=length, axis_noise=noise)
        scene = tf.Scene(tf.Growth(rate=[0.5, 1.25]), division, founders=founders)
        for _ in tf.simulate(scene, until=0.1, record=tmp_path / name):
            pass
        with tf.Results(tmp_path / name) as results:
            frame = RecordedFrames(results, [-1])[0]
            assert [f"{frame.name(k)}: 1 cell" for k in range(2)] == titles
        tf.show(tmp_path / name, out=tmp_path / f"{name}.png")
