"""Windows, pages, legends and figures of one's own."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import NEAR, Drawn, frame, ramp, viridis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from torchfilm.pictures import colour_bar, draw_cells, draw_signal, scale_bar
from torchfilm.pictures.colours import PlotStyle, scale_of
from torchfilm.pictures.draw import OUTSIDE_BOX, numbers
from torchfilm.pictures.figures import sheet_figure
from torchfilm.pictures.page import plan_layout
from torchfilm.pictures.scales import ValueRange

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
