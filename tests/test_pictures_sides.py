"""What is drawn of space from each side: walls, faces, sections and obstacles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn import frame, ramp

import torchfilm as tf

pytest.importorskip("matplotlib")
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchfilm.pictures.colours import PlotStyle
from torchfilm.pictures.draw import add_faces, add_obstacles, add_walls, set_window
from torchfilm.pictures.frames import _solid
from torchfilm.pictures.page import plan_layout, signal_section, solid_section
from torchfilm.pictures.shapes import span_of_faces, with_images


@pytest.mark.parametrize(("view", "centre"), [("xy", (1, 2)), ("xz", (1, 3)), ("yz", (2, 3))])
def test_a_round_wall_is_where_it_stands_in_each_view(view, centre):
    ax = Figure().add_subplot()
    add_walls(ax, [{"centre": (1.0, 2.0, 3.0), "radius": 4.0, "soft": False}], 0, view)
    (circle,) = ax.patches
    assert tuple(circle.get_center()) == centre


def test_a_soft_wall_ends_at_a_hard_one_which_goes_on_behind_it():
    ax = Figure().add_subplot()
    floor = {"normal": (0.0, 1.0), "offset": 0.0, "soft": False}
    side = {"normal": (1.0, 0.0), "offset": 0.0, "soft": True}
    add_walls(ax, [floor, side], 0, "xy")
    hard, soft = ax.lines
    assert min(hard.get_xdata()) < -1e5 and max(hard.get_xdata()) > 1e5
    assert min(soft.get_ydata()) == 0.0 and max(soft.get_ydata()) > 1e5


@pytest.mark.parametrize(
    ("view", "upright", "level"),
    [("xy", [-2, 2], []), ("xz", [-2, 2], [-1, 1]), ("yz", [], [-1, 1])],
)
def test_faces_are_lines_across_their_axis(view, upright, level):
    ax = Figure().add_subplot()
    add_faces(ax, {"x": (-2.0, 2.0), "z": (-1.0, 1.0)}, view)
    ends = [np.transpose(line.get_data()) for line in ax.lines]
    assert sorted(a[0] for a, b in ends if a[0] == b[0]) == upright
    assert sorted(a[1] for a, b in ends if a[1] == b[1]) == level


@pytest.mark.parametrize(("view", "axis", "at"), [("xz", 1, 1.5), ("yz", 0, -3.0)])
def test_a_section_from_the_side_is_where_cells_are_along_the_line_of_sight(view, axis, at):
    what = frame([[-4, 1, 3], [-2, 2, 3]], signals={"ahl": ramp(axis)})
    style = PlotStyle(background="ahl", view=view)
    seen = signal_section(what, 0, style, what.colony(0))
    assert seen == pytest.approx(np.full((16, 8), (at + 7.5) / 15))
    assert f"{'xyz'[axis]} of the cells" in plan_layout([what], [0], style).behind.title


def test_a_mean_hides_obstacles_that_do_not_fill_the_line_of_sight():
    solid = np.zeros((16, 16, 8), dtype=bool)
    solid[3, 5], solid[4, 5, :5] = True, True
    what = replace(frame([[0, 0, 0]], signals={"ahl": ramp(0)}), solid=[solid])
    style = PlotStyle(background="ahl", section="mean")
    assert np.argwhere(solid_section(what, 0, style, what.colony(0))).tolist() == [[3, 5]]


def test_the_outline_of_obstacles_is_around_them():
    ax, solid = Figure().add_subplot(), np.zeros((3, 2), dtype=bool)
    solid[1, 0] = True
    add_obstacles(ax, solid, (0.0, 6.0, 10.0, 12.0))
    lines = {tuple(map(tuple, x.tolist())) for x in ax.collections[0].get_segments()}
    assert lines == {((2, 10), (2, 11)), ((4, 10), (4, 11)), ((2, 11), (4, 11))}


def test_a_panel_has_the_walls_of_its_own_colony():
    radii = [1.0, 2.0, 3.0, 4.0]
    walls = [{"centre": (0.0, 0.0), "radius": radii, "soft": False}]
    what = frame([[0, 0], [0, 0]], colony=[0, 1])
    picture = tf.show(replace(what, colony_id=np.array([3, 1]), walls=walls))
    first, second = picture.figure.axes[:2]
    assert [x.get_radius() for x in (*first.patches, *second.patches)] == [4.0, 2.0]


def test_obstacles_of_colonies_are_their_own():
    kept = np.zeros(12, dtype=bool)
    kept[2], kept[9] = True, True
    first, second = _solid(kept, np.array([[2, 2, 1], [4, 2, 1]]))
    assert np.argwhere(first).tolist() == [[1, 0, 0]]
    assert np.argwhere(second).tolist() == [[2, 1, 0]]


def test_images_beyond_faces_are_a_period_away_and_boxes_go_from_face_to_face():
    cells = {
        "position": np.array([[9.0, 0.0, 1.0]]), "axis": np.array([[1.0, 0.0, 0.0]]),
        "length": np.array([2.0]), "radius": np.array([0.5]),
    }  # fmt: skip
    faces = {"x": (-10.0, 10.0)}
    shown = with_images(cells, faces, "xz", (-12.0, 12.0, -5.0, 5.0))
    assert shown["position"].tolist() == [[9.0, 0.0, 1.0], [-11.0, 0.0, 1.0]]
    covered = np.array([[-1.0, -2.0], [3.0, 4.0]])
    assert span_of_faces(faces, covered, "xz").tolist() == [[-10.0, -2.0], [10.0, 4.0]]
    assert span_of_faces({"z": (0.0, 9.0)}, covered, "xz").tolist() == [[-1.0, 0.0], [3.0, 9.0]]


def test_a_wall_at_any_side_of_the_window_is_seen():
    """Half of a thin line at an edge may be no pixel: at the top and at the left there was none."""
    fig = Figure(figsize=(2.0, 2.0), dpi=100)
    ax = fig.add_axes((0.1, 0.1, 0.8, 0.8))
    ax.set_axis_off()
    set_window(ax, (0.0, 10.0, 0.0, 10.0))
    sides = [((1, 0), 0.0), ((-1, 0), -10.0), ((0, 1), 0.0), ((0, -1), -10.0)]
    walls = [{"normal": [*n, 0], "offset": o, "soft": False} for n, o in sides]
    add_walls(ax, walls, 0, "xy")
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[:, :, 2].astype(int)  # of blue: walls are brown
    middle = pixels[100, :].tolist(), pixels[:, 100].tolist()
    for line in middle:
        assert min(line[15:25]) < 160 and min(line[175:185]) < 160
        assert min(line[30:170]) == 255 and min(line[:15]) == 255 and min(line[185:]) == 255
