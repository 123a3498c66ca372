"""What a reader sees: obstacles, lengths of bars, colours that are told apart, text as it is."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm import pictures
from torchfilm.pictures import colours
from torchfilm.pictures.categories import colours_by_number
from torchfilm.pictures.colours import PlotStyle
from torchfilm.pictures.frames import RecordedFrames, _solid, frame_of
from torchfilm.pictures.place_and_time import known_quantities, unit_at_cells
from torchfilm.pictures.scales import ValueRange

matplotlib = pytest.importorskip("matplotlib")
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.text import Text  # noqa: E402

# linear light of a deuteranope and a protanope (Machado, Oliveira and Fernandes, 2009)
DEUTERANOPE = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
     [-0.011820, 0.042940, 0.968881]]
)  # fmt: skip
PROTANOPE = np.array(
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
     [-0.003882, -0.048116, 1.051998]]
)  # fmt: skip


def lab(rgb: np.ndarray, seen_by: np.ndarray) -> np.ndarray:
    """CIELAB of colours (n, 3) as somebody sees them."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    xyz = np.clip(linear @ seen_by.T, 0, 1) @ to_xyz.T / np.array([0.9505, 1.0, 1.0888])
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 4 / 29)
    return np.stack(
        [116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], 1
    )  # fmt: skip


def apart(rgb: np.ndarray, seen_by: np.ndarray) -> np.ndarray:
    """ΔE between all pairs, (n, n)."""
    found = lab(rgb, seen_by)
    return np.linalg.norm(found[:, None] - found[None], axis=-1)


@pytest.mark.parametrize(
    ("eyes", "least"), [(np.eye(3), 30.0), (DEUTERANOPE, 18.0), (PROTANOPE, 18.0)]
)
def test_directions_look_different_to_colour_blind_readers_too(eyes, least):
    """Angles of 30° and more apart. A circle of hues has pairs with ΔE of 1."""
    seen = ValueRange()
    seen.add(np.array([0.0, 180.0]))
    scale = colours.scale_of("angle", seen, PlotStyle(), {})
    angles = np.arange(0.0, 180.0, 5.0)
    gap = np.abs(angles[:, None] - angles)
    found = apart(scale.paint(angles)[:, :3], eyes)
    assert found[np.minimum(gap, 180.0 - gap) >= 30.0].min() > least
    ends = apart(scale.paint(np.array([0.0, 179.9]))[:, :3], eyes)
    assert ends.max() < 3.0  # the map is cyclic


@pytest.mark.parametrize("eyes", [DEUTERANOPE, PROTANOPE])
def test_the_first_types_look_different_to_colour_blind_readers_too(eyes):
    seen = colours.range_of("cell_type")
    seen.add(np.arange(8))
    drawn = colours.scale_of("cell_type", seen, PlotStyle(colour="cell_type"), {})
    found = apart(drawn.paint(np.arange(8))[:, :3], eyes) + 1e3 * np.eye(8)
    assert found.min() > 10.0


def some_frame(count, **columns):
    position = np.stack([4.0 * np.arange(count), np.zeros(count)], 1)
    cells = {
        "position": position, "axis": np.tile([1.0, 0.0], (count, 1)),
        "length": np.ones(count), "radius": np.full(count, 0.5), "colony": np.zeros(count, int),
        **columns,
    }  # fmt: skip
    return pictures.Frame(cells, 0.0, np.array([0]))


@pytest.mark.parametrize("numbers", [[10, 44], [12, 300], [8, 16, 29, 42, 55], list(range(8, 16))])
def test_numbers_of_kinds_have_colours_apart(numbers):
    seen = ValueRange()
    seen.add(np.array(numbers))
    scale = colours.scale_of("clone", seen, PlotStyle(colour="clone"), {})
    rgb = scale.paint(np.array(numbers))[:, :3]
    far = np.linalg.norm(rgb[:, None] - rgb[None], axis=-1) + 9 * np.eye(len(rgb))
    assert scale.kinds == tuple(numbers) and far.min() >= 0.3


def test_many_types_of_cells_are_kinds_and_keep_their_colours():
    def painted(types):
        seen = colours.range_of("cell_type")
        seen.add(np.array(types))
        return colours.scale_of("cell_type", seen, PlotStyle(colour="cell_type"), {})

    ten, some = painted(range(10)), painted([3, 9])
    assert ten.kinds == tuple(range(10))
    assert np.allclose(some.paint(np.array([3, 9])), ten.paint(np.array([3, 9])))
    assert painted(range(30)).kinds == ()


@pytest.mark.parametrize("change", ["limits", "shape"])
def test_a_scale_bar_keeps_its_length(change):
    """In pixels of the canvas, after the axes have changed."""
    figure = Figure(figsize=(6, 4), dpi=100)
    canvas = FigureCanvasAgg(figure)
    ax = figure.add_axes((0.1, 0.2, 0.8, 0.7))
    pictures.draw_cells(ax, some_frame(6).colony(0))
    size = pictures.scale_bar(ax)
    if change == "limits":
        ax.set_xlim(-4, 4)
    else:
        ax.set_aspect("equal", adjustable="datalim")
    canvas.draw()
    (bar,) = (line for line in ax.lines if line.get_linewidth() == 2.0)
    drawn = np.ptp(bar.get_transform().transform(bar.get_xydata())[:, 0])
    wanted = np.ptp(ax.transData.transform([[0, 0], [size, 0]])[:, 0])
    assert drawn == pytest.approx(wanted, rel=1e-6)


def test_a_figure_with_a_scale_bar_can_be_pickled():
    ax = Figure().add_subplot()
    pictures.scale_bar(ax)
    (copied,) = pickle.loads(pickle.dumps(ax.figure)).axes
    assert len(copied.lines) == 1


def test_a_scale_bar_of_a_very_narrow_window_and_of_a_dark_style():
    with matplotlib.rc_context({"text.color": "white"}):
        ax = Figure().add_subplot()
        ax.set_xlim(0, 1e-4)
        assert pictures.scale_bar(ax) == pytest.approx(2e-5)
        assert ax.lines[0].get_color() == "white"


def pillar(x):
    return (x[:, 0] - 6.0).square() + x[:, 1].square() < 16.0


def around_a_pillar(**options):
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=20.0, initial=1.0), box=((-16, -8), (16, 8)), spacing=2.0,
        obstacles=pillar, **options,
    )  # fmt: skip
    return tf.Scene(tf.Growth(rate=1.0), medium, dim=2, dt=0.1,
                    founders=tf.Cells([[-6.0, 0.0]], [[1.0, 0.0]], length=2.0))  # fmt: skip


def test_obstacles_are_seen(tmp_path):
    """With a signal and without, of a state and of a file."""
    scene = around_a_pillar()
    *_, state = tf.simulate(scene, until=0.2, colonies=2, record=tmp_path / "run.h5")
    of_state = frame_of(state)
    centres = state.layout.grid.centres()[: 16 * 8]
    assert np.array_equal(of_state.solid[1].ravel(), pillar(centres).numpy())
    with tf.Results(tmp_path / "run.h5") as results:
        of_file = RecordedFrames(results, [-1], "ahl")[0]
        assert all(map(np.array_equal, of_file.solid, of_state.solid))
    wanted = matplotlib.colors.to_rgb("#d2b48c")
    shown = {
        "state": tf.show(state, whole=True), "signal": tf.show(state, background="ahl", whole=True),
        "file": tf.show(tmp_path / "run.h5", background="ahl", whole=True),
    }  # fmt: skip
    for name, picture in shown.items():
        figure = picture.figure
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        image = np.asarray(canvas.buffer_rgba())[..., :3] / 255.0
        ax = figure.axes[0]
        at = lambda x, y, ax=ax, image=image: image[
            image.shape[0] - 1 - int(ax.transData.transform((x, y))[1]),
            int(ax.transData.transform((x, y))[0]),
        ]
        assert at(6.0, 0.5) == pytest.approx(wanted, abs=0.02), name
        assert at(-12.0, 5.0) != pytest.approx(wanted, abs=0.1), name


def test_a_file_of_a_box_that_grew_has_no_obstacles_to_show(tmp_path):
    scene = around_a_pillar()
    list(tf.simulate(scene, until=0.2, record=tmp_path / "run.h5"))
    with tf.Results(tmp_path / "run.h5") as results:
        frame = RecordedFrames(results, [0], "ahl")[0]
        assert frame.solid and frame.solid[0].any()
        kept = results.file["obstacles"][...]
        assert _solid(kept, np.array([[17, 8, 1]])) == ()


def test_text_is_written_as_it_is():
    """A dollar sign is no mathematics."""
    picture = tf.show(some_frame(2), title=r"cost $5 and \frac{1$ x")
    FigureCanvasAgg(picture.figure).draw()
    assert picture.figure._suptitle.get_text() == r"cost $5 and \frac{1$ x"
    assert not picture.figure._suptitle.get_parse_math()


def test_what_is_not_to_be_drawn_is_named(tmp_path):
    frame = some_frame(2)
    ax = Figure().add_subplot()
    cells = frame.colony(0)
    for call, words in (
        (lambda: tf.show(frame, limits={"angle": (0, 90)}), "limits = 'angle'.*0 to 180"),
        (lambda: tf.show(frame, whole="yes"), "whole = 'yes'"),
        (lambda: tf.show(frame, dpi=1e5), "dpi = 100000.0.*at most 2400"),
        (lambda: tf.show(tf.Scene(tf.Growth(rate=1.0), dim=2)), r"Run the scene; .*bind\(\)"),
        (lambda: pictures.draw_cells(None, cells), "ax = 'NoneType'.*axes of matplotlib"),
        (lambda: pictures.draw_cells(ax, torch.zeros(2)), "cells = 'Tensor'.*columns of cells"),
        (lambda: pictures.draw_cells(ax, cells, window=(0, 1)), "window = .*4 numbers"),
        (lambda: pictures.draw_signal(ax, np.zeros((2, 2)), (0, 0, 0), (1, 1, 1)), "nx, ny, nz"),
    ):
        with pytest.raises(tf.InputError, match=words):
            call()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"limits": (2, 1)}, "limits = .*the first below the second"),
        ({"dpi": 0}, "dpi = 0"),
        ({"edges": [100.0, 101.0]}, r"edges = \(100.0, 101.0\).*a range with cells"),
        ({"quantity": "ahl"}, "What is outside of cells is 'out.ahl'"),
        ({"quantity": "growth_rat"}, "Did you mean 'growth_rate'"),
    ],
)
def test_a_kymograph_that_would_be_empty_or_wrong_is_refused(tmp_path, options, words):
    list(tf.simulate(around_a_pillar(), until=2.0, record=tmp_path / "run.h5"))
    quantity = options.pop("quantity", "growth_rate")
    with pytest.raises(tf.InputError, match=words):
        pictures.kymograph(tmp_path / "run.h5", quantity, **options)


def test_cells_of_a_file_have_the_colours_of_their_founders(tmp_path):
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=3.0), tf.Mechanics(dim=2), dt=0.1,
        founders=tf.inoculum(5, radius=10.0),
    )  # fmt: skip
    *_, state = tf.simulate(scene, until=1.5, colonies=2, record=tmp_path / "run.h5")
    with tf.Results(tmp_path / "run.h5") as results:
        first, last = RecordedFrames(results, [0, -1], asked=["founder"])
        tree, (plain,) = results.lineage(), RecordedFrames(results, [-1])
    assert "founder" not in plain.cells
    assert len(last.cells["uid"]) >= 4 * len(first.cells["uid"]) == 40
    for place in range(2):
        start, end = first.colony(place), last.colony(place)
        own = {tuple(c): int(uid) for c, uid in zip(start["founder"], start["uid"], strict=True)}
        assert len(own) == 5
        for colour, uid in zip(end["founder"], end["uid"], strict=True):
            assert own[tuple(colour)] == [uid, *tree.ancestors(int(uid), place)][-1]
    tf.pictures.strip(tmp_path / "run.h5", colour="founder", out=tmp_path / "strip.png")
    with pytest.raises(tf.InputError, match=r"'founder' .* a state does not know the lines"):
        tf.show(state, colour="founder")


def test_sixty_founders_look_different():
    found = colours_by_number(np.arange(60))
    assert np.allclose(found[:8], [matplotlib.colors.to_rgb(c) for c in colours.KINDS])
    gaps = apart(found, np.eye(3))[np.triu_indices(60, 1)]
    assert gaps.min() > 8.0
    some = np.array([70, 3, 3, -1, 25])
    assert np.array_equal(colours_by_number(some)[1], found[3])  # by its number alone
    assert np.array_equal(colours_by_number(some)[4], found[25])
    assert colours_by_number(np.empty(0, np.int64)).shape == (0, 3)


def test_volumes_and_ages_are_drawn_where_they_are_asked_for(tmp_path):
    """As tables have them, in frames and in what is drawn over time."""
    path = tmp_path / "run.h5"
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=3.0), tf.Mechanics(dim=2), dt=0.1,
        founders=tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[0.0, 1.0]] * 2, [1.6, 2.6]),
    )  # fmt: skip
    *_, state = tf.simulate(scene, until=1.5, colonies=2, record=path)
    with tf.Results(path) as results:
        table, frames = results.to_pandas(), RecordedFrames(results, [0, -1], asked=["age", "born"])
        for place, frame in zip((0, len(results) - 1), frames, strict=True):
            rows = table[table.frame == place]
            assert len(rows) == len(frame.cells["uid"]) and "volume" not in frame.cells
            for name in ("age", "born"):
                assert np.allclose(frame.cells[name], rows[name])
            assert np.allclose(frame.asked(["volume"]).cells["volume"], rows["volume"])
        assert np.ptp(frame.cells["age"]) > 0.3
        seen = list(known_quantities(results, "volume", "age", "born"))
        for name in ("volume", "age", "born"):
            drawn = np.concatenate([known[name] for _, known in seen])
            assert np.allclose(drawn, table.sort_values("frame", kind="stable")[name])
        assert [unit_at_cells(results, n) for n in ("volume", "age", "born")] == ["µm³", "h", "h"]
    assert np.allclose(
        frame_of(state).asked(["volume"]).cells["volume"], state.volume.cpu().numpy()
    )
    for options in ({"colour": "age"}, {"channels": {"age": "cyan", "volume": "yellow"}}):
        seen = {text.get_text() for text in tf.show(path, **options).figure.findobj(Text)}
        for name in options.get("channels", ["age"]):
            assert {"age": "age (h)", "volume": "volume (µm³)"}[name] in seen
    pictures.time_course(path, "age", "volume", out=tmp_path / "course.png")
    tf.show(state, colour="volume")


@pytest.mark.parametrize("name", ["founder", "age"])
def test_a_quantity_with_the_name_of_a_colour_is_drawn_as_it_is(tmp_path, name):
    cells = tf.Cells([[0.0, 0.0], [3.0, 0.0]], [[0.0, 1.0]] * 2, 2.0, extra={name: [7.5, 3.0]})
    scene = tf.Scene(tf.Growth(rate=0.5), tf.Mechanics(dim=2), founders=cells, dt=0.1)
    list(tf.simulate(scene, until=0.1, record=tmp_path / "run.h5"))
    with tf.Results(tmp_path / "run.h5") as results:
        (frame,) = RecordedFrames(results, [0], asked=[name])
        (_, known), _ = known_quantities(results, name)
    assert frame.cells[name].tolist() == known[name].tolist() == [7.5, 3.0]
