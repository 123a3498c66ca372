"""Pictures: colours of cells and medium, and sections."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from drawn import NEAR, Drawn, frame, ramp, viridis

import torchfilm as tf
from torchfilm.pictures import frame_of
from torchfilm.pictures.colours import FLOOR, NO_VALUE, PlotStyle, scale_of
from torchfilm.pictures.frames import RecordedFrames
from torchfilm.pictures.page import plan_layout, signal_section
from torchfilm.pictures.scales import ValueRange
from torchfilm.pictures.shapes import section
from torchfilm.signals.exchange import read, stencil
from torchfilm.signals.grid import Grid

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


def test_the_default_shows_types_else_a_species_else_angles(tmp_path):
    """What the first frame has decides, so that all frames of a film have one colouring."""
    two = tf.scenes.boundary_detector()
    one = tf.scenes.quorum_sensing(size=24.0)
    plain = tf.scenes.microcolony()
    for scene, drawn in ((two, "cell_type"), (one, "luxi"), (plain, "angle")):
        given = frame_of(scene.bind().start())
        assert plan_layout([given], [0], PlotStyle()).scales[0].name == drawn
        assert plan_layout([given], [0], PlotStyle(colour="length")).scales[0].name == "length"
    for _ in tf.simulate(two, until=0.1, record=tmp_path / "two.h5"):
        pass
    with tf.Results(tmp_path / "two.h5") as results:
        frames = RecordedFrames(results, [0, 1])
        assert plan_layout(frames, [0], PlotStyle()).scales[0].kinds == (0, 1)


def test_three_values_are_a_colour():
    """Clipped to 0 … 1; without a legend; missing ones are grey."""
    own = np.array([[1.0, 0.0, 0.0], [0.2, 2.0, -1.0], [np.nan, 0.0, 0.0]])
    drawn = Drawn(frame([[0, 0], [4, 0], [8, 0]], tint=own), colour="tint")
    assert drawn.layout.scales == ()
    for x, rgb in ((0, (1, 0, 0)), (4, (0.2, 1, 0)), (8, NO_VALUE[:3])):
        assert drawn.at(x, 0) == pytest.approx(rgb, abs=NEAR)
    with pytest.raises(tf.InputError, match="channels"):
        Drawn(frame([[0, 0]], tint=own[:1]), channels={"tint": "red"})


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


def test_a_type_keeps_its_colour_where_others_are_gone():
    all_types = Drawn(
        frame([[0, 0], [4, 0], [8, 0], [12, 0]], cell_type=[0, 1, 2, 30]), colour="cell_type"
    )
    later = Drawn(frame([[8, 0], [12, 0]], cell_type=[2, 30]), colour="cell_type")
    for x in (8, 12):
        assert later.at(x, 0) == pytest.approx(all_types.at(x, 0), abs=NEAR)
    assert len({tuple(all_types.at(x, 0)) for x in (0, 4, 8, 12)}) == 4
    legend = [later.layout.scales[0].cmap(k)[:3] for k in (0, 1)]
    assert np.allclose(legend, [later.at(x, 0) for x in (8, 12)], atol=NEAR)


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
def test_what_cannot_be_drawn_is_reported(options, message):
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


@pytest.mark.parametrize(
    "values, limits",
    [
        ([2.0, 2.0001], (1.99005, 2.01005)),  # differences within a solver's tolerance: no pattern
        ([-2.0, -1.99], (-2.005, -1.985)),
        ([2.0, 2.1], (2.0, 2.1)),
        ([2.0, 2.0], (1.0, 3.0)),  # neither low nor high
    ],
)
def test_the_range_of_a_concentration_spans_a_hundredth(values, limits):
    seen = ValueRange()
    seen.add(np.array(values))
    plain = scale_of("x", seen, PlotStyle(colour="x"), {})
    low = limits[0] if values[0] == values[1] else values[0]
    assert plain.limits[0] == low, "a coordinate has no least range"
    found = scale_of("gfp", seen, PlotStyle(colour="gfp"), {"gfp": "conc"})
    assert found.limits == pytest.approx(limits, rel=1e-6)
    assert found.beyond == "neither"


@pytest.mark.parametrize("values", [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
def test_a_switch_has_one_scale_whether_it_is_on_or_off(values):
    """Pictures of it can be compared. It has no unit, as variables of rules; a length is none."""
    found = Drawn(frame([[0, 0], [4, 0]], on=values), colour="on")
    (scale,) = found.layout.scales
    assert scale.limits == (0.0, 1.0) and scale.beyond == "neither"
    assert found.at(4, 0) == pytest.approx(viridis(values[1]), abs=NEAR)
    seen = ValueRange()
    seen.add(np.array([1.0]))
    style = PlotStyle(colour="on", log=True)
    assert scale_of("on", seen, style, {}).limits == (0.5, 1.5)
    assert scale_of("length", seen, PlotStyle(colour="length"), {}).limits == (0.5, 1.5)


@pytest.mark.parametrize(
    ("colour", "hint"),
    [
        ("age", "a state does not know the lines of descent"),
        ("out.ahl", "drawn by background='ahl'"),
    ],
)
def test_what_only_tables_have_is_not_taken_for_a_slip(colour, hint):
    *_, state = tf.simulate(tf.scenes.quorum_sensing(), cells=2)
    with pytest.raises(tf.InputError, match=hint):
        tf.show(state, colour=colour)


def test_the_colours_of_a_file_include_the_lines_of_descent(tmp_path):
    path, scene = tmp_path / "a.h5", tf.Scene(tf.Growth(rate=1.0), dim=2, dt=0.1)
    state = tf.simulate(scene, until=0.1, record=path).last()
    for draw in (tf.show, tf.pictures.strip):
        with pytest.raises(tf.InputError, match=r"colour = 'x'.*'angle' or one of .*, founder\.$"):
            draw(path, colour="x")
    with pytest.raises(tf.InputError, match="Did you mean 'founder'"):
        tf.show(path, colour="founders")
    with pytest.raises(tf.InputError, match=r"one of (?!.*founder)"):
        tf.show(state, colour="x")
    with pytest.raises(tf.InputError, match=r"channels = 'x'.*one of (?!.*founder)"):
        tf.show(path, channels={"x": "cyan"})


def test_values_of_ones_own_colour_the_cells(tmp_path):
    """As tensors, arrays or lists; the first by default. NaN is grey."""
    *_, state = tf.simulate(tf.scenes.microcolony(), cells=2)
    level = torch.tensor([0.0, torch.nan])
    legend = lambda picture: [a.get_title() for a in picture.figure.axes if a.get_title()]
    for given in (level, level.numpy(), level.tolist()):
        assert "my level" in legend(tf.show(state, values={"my level": given, "other": given}))
    chosen = tf.show(state, values={"my level": level, "other": level}, colour="other")
    assert "other" in legend(chosen) and "my level" not in legend(chosen)


def test_colours_of_ones_own():
    """Three values are the colour itself, without a legend."""
    *_, state = tf.simulate(tf.scenes.microcolony(), cells=2)
    picture = tf.show(state, values={"clone": torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])})
    faces = [c.get_facecolor() for a in picture.figure.axes for c in a.collections]
    drawn = {tuple(np.round(x[:3], 3)) for each in faces for x in each}
    assert {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)} <= drawn
    assert not any(a.get_title() == "clone" for a in picture.figure.axes)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"values": {"a": [[0.0, 0.0, 2.0]] * 2}}, r"values\['a'\] = '0 to 2'.*red, green"),
        ({"values": {"a": [[0.0, 0.5]] * 2}}, r"values\['a'\].*or three for each, its colour"),
        ({"values": [1.0, 2.0]}, r"values = \[1\.0, 2\.0\].*by name"),
        ({"values": {"a": [1.0]}}, r"values\['a'\].*2 numbers, one a cell"),
        ({"values": {"a": ["x", "y"]}}, r"values\['a'\].*2 numbers"),
        ({"values": {"length": [1.0, 2.0]}}, "other names than the cells have"),
        ({"colour": ["length"]}, "colour = .*the name of one quantity"),
        ({"background": 3}, "background = 3.*the name of one quantity"),
    ],
)
def test_values_and_names_that_cannot_be_drawn(given, words):
    *_, state = tf.simulate(tf.scenes.microcolony(), cells=2)
    with pytest.raises(tf.InputError, match=words):
        tf.show(state, **given)


def test_values_are_of_a_state(tmp_path):
    for _ in tf.simulate(tf.scenes.microcolony(), until=0.1, record=tmp_path / "a.h5"):
        pass
    with pytest.raises(tf.InputError, match=r"values.*left out for results"):
        tf.show(tmp_path / "a.h5", values={"a": [1.0]})


@pytest.mark.parametrize("limits", [{"gfp": (0.0, 4.0)}, {"nope": (0.0, 4.0)}])
def test_limits_of_the_default_colour(limits):
    """It is known from the first frame alone."""
    rates = lambda u, s, p, cell: {"gfp": 1.0 - u.gfp}
    scene = tf.Scene(tf.Circuit(rates, species=("gfp",)), dim=2, dt=0.1)
    state = tf.simulate(scene, until=0.5).last()
    if "gfp" in limits:
        assert tf.show(state, limits=limits)
    else:
        with pytest.raises(tf.InputError, match=r"limits = 'nope'.*a drawn quantity: 'gfp'"):
            tf.show(state, limits=limits)
