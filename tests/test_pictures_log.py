"""Pictures with logarithmic colours and axes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from drawn import NEAR, Drawn, frame, viridis
from matplotlib.colors import LogNorm

import torchfilm as tf
from torchfilm.pictures.colours import NO_VALUE, PlotStyle, scale_of
from torchfilm.pictures.page import plan_layout
from torchfilm.pictures.scales import ValueRange

PLACES = [[4.0 * k, 0.0] for k in range(5)]


def drawn(values, **options) -> Drawn:
    return Drawn(frame(PLACES[: len(values)], yfp=values), colour="yfp", **options)


def test_equal_factors_are_equal_steps_of_colour():
    made = drawn([1e-3, 1e-2, 1e-1], log=True)
    for (x, y), level in zip(PLACES, (0.0, 0.5, 1.0), strict=False):
        assert made.at(x, y) == pytest.approx(viridis(level), abs=NEAR)
    (scale,) = made.layout.scales
    assert scale.limits == (1e-3, 1e-1) and scale.beyond == "neither"


def test_what_is_0_or_below_lies_beyond_the_lower_end():
    """NaN has a colour of its own, as on other scales."""
    made = drawn([0.0, -3.0, 1.0, 10.0, np.nan], log="yfp")
    (scale,) = made.layout.scales
    assert scale.limits == (1.0, 10.0) and scale.beyond == "min"
    wanted = [viridis(0.0), viridis(0.0), viridis(0.0), viridis(1.0), NO_VALUE[:3]]
    for (x, y), colour in zip(PLACES, wanted, strict=True):
        assert made.at(x, y) == pytest.approx(colour, abs=NEAR)


@pytest.mark.parametrize(
    ("values", "limits", "beyond"),
    [
        ([1e-30, 2.0], (2e-4, 2.0), "min"),  # the last of a tail would take all colours
        ([0.0, 0.0], (1e-4, 1.0), "min"),
        ([-2.0, -1.0], (1e-4, 1.0), "min"),
        ([3.0, 3.0], (1.5, 4.5), "neither"),  # in the middle, as on other scales
        ([], (1e-4, 1.0), "neither"),
    ],
)
def test_the_default_range(values, limits, beyond):
    seen = ValueRange()
    seen.add(np.array(values))
    scale = scale_of("yfp", seen, PlotStyle(colour="yfp", log=True), {})
    assert scale.limits == pytest.approx(limits)
    assert scale.beyond == beyond


def test_a_range_that_is_given_holds():
    made = drawn([1e-9, 0.1, 100.0], log=True, limits={"yfp": (1e-3, 10.0)})
    (scale,) = made.layout.scales
    assert scale.limits == (1e-3, 10.0) and scale.beyond == "both"
    assert made.at(4, 0) == pytest.approx(viridis(0.5), abs=NEAR)


def test_the_range_grows_with_the_frames_of_a_film():
    """Nothing is above 0 in the first."""
    frames = [frame(PLACES[:2], yfp=v) for v in ([0.0, 0.0], [2.0, 50.0], [5.0, 60.0])]
    (scale,) = plan_layout(frames, [0], PlotStyle(colour="yfp", log=True)).scales
    assert scale.limits == (2.0, 60.0)


def test_which_quantities_are_logarithmic():
    """A name is that of the cells' quantity where both are drawn, as in `limits`."""
    both = PlotStyle(colour="ahl", background="ahl", log="ahl")
    assert both.is_log("ahl") and not both.is_log("out.ahl")
    outside = PlotStyle(colour="ahl", background="ahl", log=["out.ahl"])
    assert outside.is_log("out.ahl") and not outside.is_log("ahl")
    assert PlotStyle(colour="yfp", background="ahl", log="ahl").is_log("out.ahl")
    each = PlotStyle(colour="angle", background="ahl", log=True)
    assert each.is_log("out.ahl") and not each.is_log("angle")
    kinds = frame(PLACES[:2], cell_type=np.array([1, 8]), yfp=[1.0, 2.0])
    (scale,) = plan_layout([kinds], [0], PlotStyle(colour="cell_type")).scales
    assert scale.kinds == (1, 8) and not scale.log


def test_whole_numbers_have_a_range_where_their_colours_are_logarithmic():
    what = frame(PLACES[:3], molecules=np.array([1, 10, 100]))
    (scale,) = plan_layout([what], [0], PlotStyle(colour="molecules", log=True)).scales
    assert not scale.kinds and scale.limits == (1.0, 100.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"log": "gfp"}, "log = 'gfp'.*drawn quantity: 'yfp'"),
        ({"log": ["yfp", 3]}, "log = .*the names of drawn quantities"),
        ({"log": 1}, "log = 1"),
        ({"log": True, "limits": {"yfp": (0, 2)}}, r"limits\['yfp'\] = \(0.0, 2.0\).*above 0"),
        ({"log": True, "colour": "angle"}, "angle has no range of values"),
        ({"log": ["angle"], "colour": "angle"}, "log = 'angle'.*left out"),
        ({"log": True, "colour": None}, "cell_type has no range of values"),
        ({"log": True, "colour": "rgb"}, "log = True.*rgb is a colour itself"),
        ({"log": "rgb", "colour": "rgb"}, "log = 'rgb'.*rgb is a colour itself"),
    ],
)
def test_what_has_no_logarithm_is_refused(options, message):
    what = frame(PLACES[:2], cell_type=np.array([0, 1]), yfp=[1.0, 2.0], rgb=np.ones((2, 3)))
    with pytest.raises(tf.InputError, match=message):
        plan_layout([what], [0], PlotStyle(**{"colour": "yfp", **options}))


def test_limits_of_a_signal_by_its_short_name_are_those_of_its_logarithm():
    for log in ("out.ahl", "ahl", True):
        with pytest.raises(tf.InputError, match=r"limits\['out.ahl'\] = \(0.0, 1.0\).*above 0"):
            PlotStyle(colour="length", background="ahl", limits={"ahl": (0, 1)}, log=log)
    PlotStyle(colour="yfp", background="ahl", limits={"ahl": (0, 1)}, log="yfp")


def test_the_ends_of_a_narrow_range_are_apart_in_words():
    from matplotlib.figure import Figure

    seen, below = ValueRange(), Figure().subplots()
    seen.add(np.array([100.0, 100.9]))
    scale = scale_of("yfp", seen, PlotStyle(colour="yfp", log=np.True_), {})
    tf.pictures.colour_bar(below, scale)
    assert [t.get_text() for t in below.get_xticklabels()] == ["100", "100.45", "100.9"]


def test_small_numbers_of_a_narrow_range_have_exponents():
    from matplotlib.figure import Figure

    seen, below = ValueRange(), Figure().subplots()
    seen.add(np.array([1e-20, 1.5e-20]))
    tf.pictures.colour_bar(below, scale_of("yfp", seen, PlotStyle(colour="yfp", log=True), {}))
    words = [t.get_text() for t in below.get_xticklabels()]
    assert words == ["1e-20", "1.22e-20", "1.5e-20"]


def test_axes_of_a_figure_of_ones_own():
    from matplotlib.figure import Figure

    cells = {
        "position": np.array(PLACES[:3]), "axis": np.array([[1.0, 0.0]] * 3),
        "length": np.full(3, 2.0), "radius": np.full(3, 0.5), "yfp": np.array([0.0, 1.0, 100.0]),
    }  # fmt: skip
    ax, below = Figure().subplots(2)
    (scale,) = tf.pictures.draw_cells(ax, cells, colour="yfp", log=True)
    tf.pictures.colour_bar(below, scale)
    assert [t.get_text() for t in below.get_xticklabels()] == ["1", "10", "100"]
    assert below.get_xscale() == "log"
    values = np.array([1.0, 1e2, 1e4]).reshape(3, 1, 1)
    signal = tf.pictures.draw_signal(ax, values, [0, 0, 0], [1, 1, 1], log=True)
    assert signal.paint(np.array([1e2]))[0, :3] == pytest.approx(0.5, abs=NEAR)
    with pytest.raises(tf.InputError, match="rgb is a colour itself"):
        tf.pictures.draw_cells(ax, cells | {"rgb": np.ones((3, 3))}, colour="rgb", log=True)
    with pytest.raises(tf.InputError, match="log = 'signal'"):
        tf.pictures.draw_signal(ax, values, [0, 0, 0], [1, 1, 1], log="signal")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Four cells at rest whose level rises tenfold from one to the next, and from frame to frame;
    that of the first is 0."""
    path = tmp_path_factory.mktemp("log") / "run.h5"

    def rise(cells):
        x = cells.position[:, 0]
        cells.level = torch.where(x < 1.0, 0.0, 10.0 ** (x / 4.0 + 10.0 * cells.time))

    scene = tf.Scene(
        tf.Rules(update=rise, variables={"level": 0.0, "none": 0.0}),
        founders=tf.Cells(PLACES[:4], [1.0, 0.0], 0.0), dim=2, dt=0.1,
    )  # fmt: skip
    list(tf.simulate(scene, until=0.3, record=tf.Recorder(path, scene, every=1)))
    return path


def test_a_kymograph(run):
    """A mean of 0 is drawn with the lowest colour; where there is no cell there is none."""
    edges = [-1, 1, 3, 5, 7, 9, 11, 13]
    picture = tf.pictures.kymograph(run, "level", edges=edges, log=True)
    mesh = picture.figure.axes[0].collections[0]
    assert isinstance(mesh.norm, LogNorm) and (mesh.norm.vmin, mesh.norm.vmax) == (10.0, 1e5)
    values = mesh.get_array().filled(np.nan)
    np.testing.assert_allclose(values[3, ::2], [10.0, 1e3, 1e4, 1e5], rtol=1e-5)
    assert np.isnan(values[:, 1::2]).all() and (values[0, ::2] == 10.0).all()
    assert picture.figure.axes[1].get_yscale() == "log"
    given = tf.pictures.kymograph(run, "level", edges=edges, log=True, limits=(1.0, 1e6))
    assert given.figure.axes[0].collections[0].norm.vmax == 1e6
    with pytest.raises(tf.InputError, match=r"limits = \(0, 1\).*above 0"):
        tf.pictures.kymograph(run, "level", log=True, limits=(0, 1))
    with pytest.raises(tf.InputError, match="one of"):
        tf.pictures.kymograph(run, "angle", log=True)


def test_a_field_of_any_name_has_the_range_of_its_values(tmp_path):
    """An angle of one's own is no angle of an axis."""
    scene = tf.Scene(
        tf.Rules(lambda cells: None, variables={"angle": 7.0, "cell_type_": 2.0}),
        founders=tf.Cells(PLACES[:2], [1.0, 0.0], 0.0), dim=2, dt=0.1,
    )  # fmt: skip
    list(tf.simulate(scene, until=0.2, record=tmp_path / "run.h5"))
    mesh = tf.pictures.kymograph(tmp_path / "run.h5", "angle", limits=(5.0, 9.0)).figure.axes[0]
    assert mesh.collections[0].norm.vmin == 5.0 and mesh.collections[0].norm.vmax == 9.0


def test_a_time_course(run):
    plain = tf.pictures.time_course(run, "level").figure.axes
    assert plain[1].get_yscale() == "linear"
    counts, level = tf.pictures.time_course(run, "level", log=True).figure.axes
    assert level.get_yscale() == "log" and counts.get_yscale() == "linear"  # four cells throughout
    (_, none) = tf.pictures.time_course(run, "none", log=True).figure.axes  # 0 throughout
    assert none.get_yscale() == "linear"
    with pytest.raises(tf.InputError, match="log = 'level'"):
        tf.pictures.time_course(run, "level", log="level")
