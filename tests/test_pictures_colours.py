"""Pictures: colours of cells and medium, sections and windows, and legends."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

import torchfilm as tf
from torchfilm.pictures import Frame, colour_bar, draw_cells, draw_signal, frame_of, scale_bar
from torchfilm.pictures.colours import FLOOR, NO_VALUE, PlotStyle, ValueRange, scale_of
from torchfilm.pictures.draw import OUTSIDE_BOX, numbers
from torchfilm.pictures.figures import choose_colonies, fill_sheet, sheet_figure
from torchfilm.pictures.page import make_page, plan_layout, signal_section
from torchfilm.pictures.shapes import section
from torchfilm.signals.exchange import read, stencil
from torchfilm.signals.grid import Grid

# half a step of 8-bit colour, and one more for the rounding of what is blended
NEAR = 2 / 255


def frame(
    position,
    *,
    colony=None,
    signals=None,
    origin=(-8.0, -8.0, -4.0),
    spacing=(1.0, 1.0, 1.0),
    height=None,
    **fields,
) -> Frame:
    """Round cells of radius 1 at (N, d), with any fields.

    signals: (nx, ny, nz), the same for all colonies.
    """
    position = np.asarray(position, dtype=float)
    n, dim = position.shape
    colony = np.zeros(n, dtype=int) if colony is None else np.asarray(colony)
    axis = np.zeros((n, dim))
    axis[:, 0] = 1
    cells = {
        "colony": colony,
        "uid": np.arange(n),
        "position": position,
        "axis": axis,
        "length": np.zeros(n),
        "radius": np.ones(n),
    }
    cells |= {name: np.asarray(value) for name, value in fields.items()}
    ids = np.arange(colony.max() + 1)
    if signals is None:
        return Frame(cells, 0.0, ids)
    shape = np.tile(next(iter(signals.values())).shape, (len(ids), 1))
    grids = {name: [np.asarray(v, dtype=float)] * len(ids) for name, v in signals.items()}
    return Frame(
        cells,
        0.0,
        ids,
        {},
        grids,
        np.tile(np.array(origin, dtype=float), (len(ids), 1)),
        shape,
        np.array(spacing),
        height,
    )


class Drawn:
    """A sheet as pixels, to read colours at positions."""

    def __init__(self, what: Frame, **options):
        style = PlotStyle(**options)
        places, _ = choose_colonies(what.counts > 0, what.colony_id, None, 36)
        self.layout = plan_layout([what], places, style)
        self.figure, self.axes = make_page(1, len(places), self.layout, "", dpi=100)
        fill_sheet(self.axes, what, self.layout)
        canvas = FigureCanvasAgg(self.figure)
        canvas.draw()
        self.pixels = np.asarray(canvas.buffer_rgba())[..., :3] / 255.0

    def at(self, x: float, y: float, panel: int = 0) -> np.ndarray:
        """The colour at a position, µm."""
        u, v = self.axes[panel].transData.transform((x, y))
        return self.pixels[len(self.pixels) - 1 - int(v), int(u)]


def viridis(level: float) -> np.ndarray:
    from matplotlib import colormaps

    return np.array(colormaps["viridis"](level)[:3])


# --- cells ----------------------------------------------------------------------------------------


def test_the_lowest_and_the_highest_cell_get_the_ends_of_the_map():
    drawn = Drawn(frame([[0, 0], [4, 0], [8, 0]], yfp=[1.0, 3.0, 2.0]), colour="yfp")
    for x, level in ((0, 0.0), (4, 1.0), (8, 0.5)):
        assert drawn.at(x, 0) == pytest.approx(viridis(level), abs=NEAR)


def test_given_limits_hold_whatever_the_cells_have():
    a = Drawn(frame([[0, 0], [4, 0]], yfp=[1.0, 3.0]), colour="yfp", limits={"yfp": (0, 4)})
    b = Drawn(frame([[0, 0], [4, 0]], yfp=[1.0, 9.0]), colour="yfp", limits={"yfp": (0, 4)})
    assert a.at(0, 0) == pytest.approx(viridis(0.25), abs=NEAR) and np.array_equal(
        a.at(0, 0), b.at(0, 0)
    )
    assert b.at(4, 0) == pytest.approx(viridis(1.0), abs=NEAR)
    assert [x.layout.scales[0].beyond for x in (a, b)] == ["neither", "max"], (
        "the legend must tell that a cell is beyond it"
    )


def test_one_range_for_all_colonies():
    drawn = Drawn(frame([[0, 0], [0, 0]], colony=[0, 1], yfp=[0.0, 1.0]), colour="yfp")
    assert drawn.at(0, 0, 0) == pytest.approx(viridis(0.0), abs=NEAR) and drawn.at(
        0, 0, 1
    ) == pytest.approx(viridis(1.0), abs=NEAR)


def test_lights_of_channels_add_up():
    """Cyan + yellow is white; a cell without light is dark, but not as dark as the paper."""
    drawn = Drawn(
        frame([[0, 0], [4, 0], [8, 0], [12, 0]], cfp=[2.0, 0, 2.0, 0], yfp=[0, 0.5, 0.5, 0]),
        channels={"cfp": "cyan", "yfp": "yellow"},
    )
    for x, colour in (
        (0, (FLOOR, 1, 1)),
        (4, (1, 1, FLOOR)),
        (8, (1, 1, 1)),
        (12, (FLOOR, FLOOR, FLOOR)),
    ):
        assert drawn.at(x, 0) == pytest.approx(colour, abs=NEAR)
    assert drawn.at(2, 1.0) == pytest.approx((0, 0, 0), abs=NEAR), (
        "between the cells of a fluorescence picture it is black"
    )


def test_each_channel_has_its_own_range_from_zero():
    made = Drawn(
        frame([[0, 0], [4, 0]], cfp=[100.0, 200.0], yfp=[0.1, 0.2]),
        channels={"cfp": "cyan", "yfp": "#ffff00"},
    ).layout
    assert [s.limits for s in made.scales] == [(0.0, 200.0), (0.0, 0.2)] and [
        s.name for s in made.scales
    ] == ["cfp", "yfp"]


def test_the_legend_of_a_channel_shows_the_colours_of_its_cells():
    drawn = Drawn(frame([[0, 0], [4, 0]], cfp=[0.5, 1.0]), channels={"cfp": "cyan"})
    # the map has 256 steps
    assert drawn.layout.scales[0].paint(np.array([0.5]))[0, :3] == pytest.approx(
        drawn.at(0, 0), abs=1 / 255 + NEAR
    )


@pytest.mark.parametrize("options", [{"colour": "yfp"}, {"channels": {"yfp": "yellow"}}])
def test_what_is_not_a_number_is_grey_and_spoils_no_range(options):
    drawn = Drawn(frame([[0, 0], [4, 0], [8, 0]], yfp=[np.nan, 0.0, 1.0]), **options)
    assert drawn.at(0, 0) == pytest.approx(NO_VALUE[:3], abs=NEAR)
    assert drawn.layout.scales[0].limits == (0.0, 1.0)


def test_kinds_of_cells_have_a_colour_each():
    drawn = Drawn(frame([[0, 0], [4, 0], [8, 0]], cell_type=[0, 7, 3]), colour="cell_type")
    assert drawn.layout.scales[0].kinds == (0, 3, 7)
    colours = {tuple(drawn.at(x, 0)) for x in (0, 4, 8)}
    assert len(colours) == 3
    with_limits = Drawn(
        frame([[0, 0], [4, 0], [8, 0]], cell_type=[0, 7, 3]),
        colour="cell_type",
        limits={"cell_type": (0, 7)},
    )
    assert with_limits.at(4, 0) == pytest.approx(viridis(1.0), abs=NEAR)
    assert (
        Drawn(frame(np.arange(24).reshape(12, 2) * 3.0), colour="uid").layout.scales[0].kinds == ()
    ), "twelve are no kinds"


@pytest.mark.parametrize("view, nearest", [("xy", 2), ("xz", 1), ("yz", 0)])
def test_the_cell_nearest_to_the_eye_hides_the_others(view, nearest):
    """x, y, z are right-handed.

    So one looks at xy from above, at xz from the side of low y, and at yz from the side of high x.
    """
    position = np.zeros((2, 3))
    position[0, nearest] = -3.0 if view == "xz" else 3.0
    drawn = Drawn(frame(position, yfp=[1.0, 0.0]), colour="yfp", view=view)
    assert drawn.at(0, 0) == pytest.approx(viridis(1.0), abs=NEAR)


# --- signals --------------------------------------------------------------------------------------


def ramp(axis: int, shape=(16, 16, 8)) -> np.ndarray:
    """0 to 1 from the first voxel to the last along an axis."""
    return np.moveaxis(
        np.broadcast_to(
            np.linspace(0, 1, shape[axis]), np.moveaxis(np.empty(shape), axis, -1).shape
        ),
        -1,
        axis,
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_white_is_lowest_and_black_highest_at_the_right_places(axis):
    """Voxel centres are at −7.5 … 7.5 µm, so at position p the ramp is (p + 7.5)/15."""
    drawn = Drawn(frame([[0.0, 0.0]], signals={"ahl": ramp(axis)}), background="ahl", whole=True)
    for p in (-7.0, -3.3, 2.0, 6.5):
        place = (p, 5.0) if axis == 0 else (5.0, p)
        # a pixel is 16 µm / 700 wide, so the ramp changes by less than 1/255 in it
        assert drawn.at(*place) == pytest.approx([1 - (p + 7.5) / 15] * 3, abs=NEAR + 1 / 255)


@pytest.mark.parametrize("view", ["xy", "xz", "yz"])
def test_a_section_is_what_cells_there_would_read(view, dtype, device):
    grid = Grid(
        torch.tensor([[-3.0, 2.0, 5.0]], dtype=torch.float64, device=device),
        torch.tensor([[5, 6, 7]], device=device),
        (1.0, 2.0, 0.5),
    )
    values = torch.rand(
        grid.nodes, dtype=dtype, device=device, generator=torch.Generator(device).manual_seed(0)
    )
    places = grid.centres()
    k = {"xy": 2, "xz": 1, "yz": 0}[view]
    low, high = float(grid.origin[0, k]), float(grid.high[0, k])
    for at in (low + 1e-6, low + 0.3 * (high - low), 0.5 * (low + high), high - 1e-6):
        places[:, k] = at
        met = stencil(
            grid, places, torch.zeros(len(places), dtype=torch.int64, device=device), dtype=dtype
        )
        wanted = read(values, met).reshape(5, 6, 7).cpu().numpy()
        origin, spacing = grid.origin[0].cpu().numpy(), np.array(grid.spacing)
        found = section(values.reshape(5, 6, 7).cpu().numpy(), origin, spacing, view=view, at=at)
        # one interpolation each, of numbers below 1
        assert found == pytest.approx(wanted.take(0, k), abs=4 * torch.finfo(dtype).eps)


def test_the_mean_is_that_along_the_line_of_sight():
    values = np.random.default_rng(0).random((3, 4, 5))
    for view, k in (("xy", 2), ("xz", 1), ("yz", 0)):
        assert np.allclose(
            section(values, np.zeros(3), np.ones(3), view=view, at=None), values.mean(k)
        )


def test_a_section_is_at_the_height_of_the_cells():
    """For 3-D cells at their mean, for 2-D cells at their plane, if known. The legend gives the
    height.
    """
    values = ramp(2)  # centres at −3.5 … 3.5 µm: at z it is (z + 3.5)/7
    deep = frame([[0, 0, 1.0], [0, 4, 2.0]], signals={"ahl": values})
    flat = frame([[0, 0]], signals={"ahl": values}, height=-2.0)
    for what, options, level, said in (
        (deep, {}, (1.5 + 3.5) / 7, "z of the cells"),
        (flat, {}, (-2 + 3.5) / 7, "z = -2 µm"),
        (deep, {"section": 3.0}, (3 + 3.5) / 7, "z = 3 µm"),
        (deep, {"section": "mean"}, 0.5, "mean over z"),
    ):
        style = PlotStyle(background="ahl", **options)
        assert signal_section(what, 0, style, what.colony(0)) == pytest.approx(
            np.full((16, 16), level)
        )
        behind = plan_layout([what], [0], style).behind
        assert behind is not None and said in behind.title
    layer = frame([[0, 0]], signals={"ahl": ramp(0, (16, 16, 1))})
    assert plan_layout([layer], [0], PlotStyle(background="ahl")).behind.title == "ahl outside"


def test_a_plane_of_cells_that_is_not_known_is_asked_for():
    """2-D cells are at z = 0 by default; if that is outside the box, an error is raised."""
    what = frame([[0, 0]], signals={"ahl": ramp(2)}, origin=(-8, -8, 10))
    with pytest.raises(tf.InputError, match=r"section.*10 to 18"):
        plan_layout([what], [0], PlotStyle(background="ahl"))
    assert plan_layout([what], [0], PlotStyle(background="ahl", section=12.0)).behind is not None


def test_cells_and_signal_of_one_name_keep_their_own_limits():
    what = frame([[0, 0]], signals={"ahl": ramp(0)}, ahl=[0.3])
    both = plan_layout(
        [what],
        [0],
        PlotStyle(colour="ahl", background="ahl", limits={"ahl": (0, 5), "out.ahl": (0, 7)}),
    )
    assert both.scales[0].limits == (0, 5) and both.behind.limits == (0, 7)
    bare = plan_layout(
        [what], [0], PlotStyle(colour="ahl", background="ahl", limits={"ahl": (0, 5)})
    )
    assert bare.scales[0].limits == (0, 5) and bare.behind.limits == (0, 1)
    alone = plan_layout([what], [0], PlotStyle(background="ahl", limits={"ahl": (0, 5)}))
    assert alone.behind.limits == (0, 5) and alone.behind.title == "ahl outside, z = 0 µm"


# --- windows --------------------------------------------------------------------------------------


def test_a_window_is_cropped_to_the_cells_and_stays_in_the_box():
    what = frame([[6.5, 0.0], [-4.0, 0.0]], colony=[0, 1], signals={"ahl": ramp(0)})
    made = plan_layout([what], [0, 1], PlotStyle(background="ahl"))
    sizes = {(round(r - l, 9), round(t - b, 9)) for l, r, b, t in made.windows.values()}  # noqa: E741
    assert len(sizes) == 1 and 2.0 < made.size[0] < 8.0, (
        "panels of one size, about the cell of 2 µm with some room"
    )
    assert made.windows[0][1] == pytest.approx(8.0), "pushed back into the box, which ends at 8 µm"
    assert sum(made.windows[1][:2]) == pytest.approx(-8.0), "in the middle where there is room"


def test_the_whole_box():
    what = frame([[6.5, 0.0]], signals={"ahl": ramp(0)})
    assert plan_layout([what], [0], PlotStyle(background="ahl", whole=True)).windows[
        0
    ] == pytest.approx((-8, 8, -8, 8))


def test_what_is_beyond_the_box_is_no_concentration():
    """Outside the box, where cells extend far, the picture's colour is not grey."""
    what = frame([[0.0, 0.0], [12.0, 0.0]], signals={"ahl": np.zeros((16, 16, 1))})
    from matplotlib.colors import to_rgb

    drawn = Drawn(what, background="ahl")
    assert drawn.at(10.0, 0.0) == pytest.approx(to_rgb(OUTSIDE_BOX), abs=NEAR)
    assert drawn.at(4.0, 0.0) == pytest.approx((1, 1, 1), abs=NEAR)


@pytest.mark.parametrize("dpi", [72, 101, 150, 163.7])
def test_pages_have_even_numbers_of_pixels(dpi):
    """Films require it."""
    what = frame([[0.0, 0.0], [7.0, 2.0]], yfp=[1, 2])
    figure = sheet_figure(what, [0], PlotStyle(colour="yfp"), "a title", dpi)
    assert all(n % 2 == 0 for n in FigureCanvasAgg(figure).get_width_height())


def boxes(figure: Figure) -> list:
    """The position of everything on a page, pixels: panels, legends with numbers, titles, scale
    bar.
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    panels = [ax for ax in figure.axes if ax.get_visible()]
    # artists outside the frame of their axes
    outside = [
        t
        for ax in panels
        for t in (ax.title, *ax.get_xticklabels(), *ax.texts, *ax.lines)
        if not isinstance(t, Text) or t.get_text()
    ]
    return [x.get_window_extent(renderer) for x in (*panels, *outside, *figure.texts)]


@pytest.mark.parametrize(
    "count, apart, options",
    [
        (1, 3.0, {"colour": "yfp"}),
        (
            1,
            100.0,
            {
                "channels": {"yfp": "yellow", "cfp": "cyan", "rfp": "red", "length": "lime"},
                "background": "ahl",
            },
        ),
        (5, 20.0, {"colour": "cell_type", "background": "ahl", "whole": True}),
        (36, 8.0, {}),
    ],
)
def test_nothing_on_a_page_overlaps(count, apart, options):
    position = [[x, 0.0] for _ in range(count) for x in (0.0, apart)]
    fields = {n: np.linspace(1e-7, 2e-7, 2 * count) for n in ("yfp", "cfp", "rfp")}
    what = frame(
        position,
        colony=np.repeat(np.arange(count), 2),
        signals={"ahl": 1e5 * ramp(0)},
        cell_type=np.arange(2 * count) % 3,
        **fields,
    )
    figure = sheet_figure(
        what,
        range(count),
        PlotStyle(**options),
        "a title of some length, which has to be broken where the page is narrow",
        100,
    )
    found = boxes(figure)
    for i, a in enumerate(found):
        assert a.x0 >= 0 and a.y0 >= 0 and a.x1 <= figure.bbox.x1 and a.y1 <= figure.bbox.y1, (
            "off the page"
        )
        for b in found[:i]:
            wide, high = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
            assert wide <= 0 or high <= 0, (a, b)


# --- legends --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values, words",
    [
        ((0, 1, 2), ["0", "1", "2"]),
        ((0, 0.08871, 0.17742), ["0", "0.089", "0.177"]),
        ((7.9e-27, 2.96, 5.92), ["0", "2.96", "5.92"]),
        ((1000.001, 1000.0015, 1000.002), ["1000.001", "1000.0015", "1000.002"]),
        ((-1e-9, 50, 100), ["0", "50", "100"]),
        ((10, 105, 200), ["10", "105", "200"]),
    ],
)
def test_numbers_of_a_legend(values, words):
    assert numbers(np.array(values, dtype=float)) == words


@pytest.mark.parametrize(
    "high, title",
    [(2.0, "yfp (nM)"), (2e-5, "yfp (10⁻⁵ nM)"), (3e7, "yfp (10⁷ nM)"), (0.5, "yfp (nM)")],
)
def test_a_legend_takes_out_the_power_of_ten(high, title):
    seen = ValueRange()
    seen.add(np.array([0.0, high]))
    scale = scale_of("yfp", seen, PlotStyle(colour="yfp"), {"yfp": "nM"})
    assert scale.title == title
    ax = Figure().add_subplot()
    colour_bar(ax, scale)
    shown = float(ax.get_xticklabels()[-1].get_text())
    assert shown * 10.0**scale.power == pytest.approx(high)


@pytest.mark.parametrize("values", [[], [np.nan], [0.0], [5.0, 5.0], [-2.0]])
def test_a_range_is_never_empty(values):
    for style in (PlotStyle(colour="yfp"), PlotStyle(channels={"yfp": "red"})):
        seen = ValueRange()
        seen.add(np.array(values, dtype=float))
        scale = scale_of("yfp", seen, style, {})
        assert (
            scale.limits[0] < scale.limits[1]
            and np.isfinite(scale.paint(np.array([0.0, 5.0]))).all()
        )
        colour_bar(Figure().add_subplot(), scale)


# --- figures of one's own -------------------------------------------------------------------------


def test_a_figure_of_ones_own():
    """The functions work together on any axes: the cells' window shows the signal behind them."""
    figure = Figure(dpi=100)
    ax, below = figure.subplots(2, 1)
    what = frame([[-2.0, 0.0], [2.0, 0.0]], yfp=[0.0, 1.0])
    behind = draw_signal(ax, ramp(0), (-8, -8, -4), (1, 1, 1), name="ahl", limits=(0, 2))
    assert ax.get_xlim() == (-8, 8) and behind.limits == (0, 2)
    (scale,) = draw_cells(
        ax, what.cells, colour="yfp", limits={"yfp": (0, 3)}, window=(-6, 6, -4, 4)
    )
    assert ax.get_xlim() == (-6, 6) and ax.get_ylim() == (-4, 4) and scale.limits == (0, 3)
    assert scale_bar(ax) == 2.0, "the largest of 1, 2, 5, 10, … up to 0.3 of 12 µm"
    colour_bar(below, scale)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3] / 255
    u, v = ax.transData.transform((2.0, 0.0))
    assert pixels[len(pixels) - 1 - int(v), int(u)] == pytest.approx(viridis(1 / 3), abs=NEAR)
    u, v = ax.transData.transform((5.0, 3.0))
    # the subplot is some 250 pixels for 12 µm, of which each is 0.0016 of the range
    assert pixels[len(pixels) - 1 - int(v), int(u)] == pytest.approx(
        [1 - (12.5 / 15) / 2] * 3, abs=NEAR + 0.002
    )


def test_a_bar_is_as_long_as_it_says():
    figure = Figure(dpi=100)
    ax = figure.add_subplot()
    draw_cells(ax, frame([[0, 0], [37.0, 5.0]]).cells)
    size = scale_bar(ax)
    FigureCanvasAgg(figure).draw()
    (line,) = ax.lines
    ends = line.get_transform().transform(np.stack(line.get_data(), 1))[:, 0]
    wanted = ax.transData.transform([(0, 0), (size, 0)])[:, 0]
    assert ends[1] - ends[0] == pytest.approx(wanted[1] - wanted[0], rel=1e-9) and size == 10.0


# --- what cannot be drawn -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        ({"colour": "yfp", "channels": {"yfp": "red"}}, r"colour and channels"),
        ({"channels": {}}, r"channels = \{\}"),
        ({"channels": ["yfp"]}, r"channels.*colours by name"),
        ({"channels": {"yfp": "yelow"}}, r"channels\['yfp'\] = 'yelow'"),
        ({"channels": {"cfp": "cyan"}}, r"channels = 'cfp'.*yfp"),
        ({"channels": {"angle": "cyan"}}, r"channels = 'angle'"),
        ({"background": "lactose"}, r"background = 'lactose'.*ahl"),
        ({"limits": {"yfp": (0, 1)}}, r"limits = 'yfp'.*nothing that has a range"),
        ({"colour": "yfp", "limits": {"cfp": (0, 1)}}, r"limits = 'cfp'.*'yfp'"),
        (
            {"colour": "yfp", "limits": {"yfp": (1, 1)}},
            r"limits\['yfp'\] = \(1.0, 1.0\).*first below",
        ),
        ({"colour": "yfp", "limits": {"yfp": (0, np.inf)}}, r"limits\['yfp'\].*finite"),
        ({"colour": "yfp", "limits": {"yfp": 3}}, r"limits\['yfp'\] = 3"),
        ({"background": "ahl", "section": "top"}, r"section = 'top'"),
        ({"background": "ahl", "section": 4.5}, r"section = 4.5.*from -4 to 4 µm along z"),
        ({"section": 1.0}, r"section = 1.0.*background"),
    ],
)
def test_what_cannot_be_drawn_is_told(options, message):
    with pytest.raises(tf.InputError, match=message):
        plan_layout(
            [frame([[0, 0]], signals={"ahl": ramp(0)}, yfp=[1.0])], [0], PlotStyle(**options)
        )


def test_a_scene_without_a_medium_has_no_box_and_no_background():
    for options in ({"whole": True}, {"background": "ahl"}):
        with pytest.raises(tf.InputError, match="medium"):
            plan_layout([frame([[0, 0]])], [0], PlotStyle(**options))


def test_a_state_is_a_frame(dtype, device):
    """Signals on grids of several colonies: each colony gets its own values and positions."""
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=1.0, initial=lambda x: 20 + x[:, 0] + 0.1 * x[:, 2]),
        box=((-8, -4, -2), (8, 4, 6)),
        spacing=2.0,
        height=1.0,
    )
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), medium)
    made = frame_of(scene.bind(3, dtype=dtype, device=device).start())
    assert (
        made.height == 1.0
        and made.origin.tolist() == [[-8.0, -4.0, -2.0]] * 3
        and made.spacing.tolist() == [2.0] * 3
    )
    assert [x.shape for x in made.signals["ahl"]] == [(8, 4, 4)] * 3
    # centres at x = −7, −5, …, z = −1, 1, …
    assert made.signals["ahl"][2][1, 0, 1] == pytest.approx(20 - 5 + 0.1, rel=1e-6)
    assert made.units["out.ahl"] == "conc" and made.dim == 2
