"""The stripe at the border of two populations: the border, the profile and the measures, on
colonies with given cells."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from patterned import SHARP, crowded, placed, row

import torchfilm as tf
from design.targets import Stripe
from design.targets.borders import border


def field(
    shift=0.0, columns=range(-20, 20), rows=16, bend=0.0, turned=False, low=0, edge=0.0
) -> tf.State:
    """Balls 1 µm apart: type `low`, at 100, before x = shift, the other beyond, lit (8) for 6 µm
    from edge + bend · cos(2π y/16) on, else dim (1/8)."""
    x, y = (
        v.reshape(-1) + 0.5
        for v in np.meshgrid(
            np.array(columns, dtype=float), np.arange(rows, dtype=float), indexing="ij"
        )
    )
    far = x > 0
    lit = (
        far
        & (x > edge + bend * np.cos(2 * math.pi * y / 16))
        & (x < edge + 6 + bend * np.cos(2 * math.pi * y / 16))
    )
    place = np.stack([y, x + shift] if turned else [x + shift, y], 1)
    return placed(
        place,
        cell_type=np.where(far, 1 - low, low),
        yfp=np.where(lit, 8.0, np.where(far, 0.125, 100.0)),
    )


@pytest.mark.parametrize(
    "x, kinds, place",
    [
        ([-2, -1, 1, 2], [0, 0, 1, 1], 0.0),
        ([-2, -1, 1, 2], [1, 1, 0, 0], 0.0),  # the other way round
        # a stray cell at 2: before or after it one cell is wrong; the first such place counts
        ([-3, -1, 1, 2, 3, 9], [0, 0, 1, 0, 1, 1], 0.0),
        ([9, 3, 7, -1, 1, 2, -3], [1, 0, 1, 0, 1, 0, 0], 5.0),  # in any order of rows; a stray at 1
        ([0, 4], [3, 7], 2.0),  # any two numbers
    ],
)
def test_border_has_the_fewest_cells_on_the_wrong_side(x, kinds, place):
    state = row(x, cell_type=kinds)
    assert border(state)[0].tolist() == [place]
    assert border(state)[1].tolist() == [kinds[int(np.argmin(x))]]
    turned = placed(np.stack([np.zeros(len(x)), x], 1), cell_type=kinds)
    assert border(turned, "y")[0].tolist() == [place]


def test_border_against_every_place_tried():
    """In 20 random colonies no place between two cells has fewer cells on the wrong side."""
    state = crowded(seed=8, colonies=20, count=8)
    found, before = border(state)
    for k in range(state.colonies):
        x, kind = (
            state.position[state.colony == k, 0].numpy(),
            state.cell_type[state.colony == k].numpy(),
        )
        first = kind == int(before[k])
        assert len(set(kind)) == 2 and x[first].mean() <= x[~first].mean()
        tried = np.append(np.sort(x) + 1e-9, found[k])
        wrong = [(first & (x > at)).sum() + (~first & (x <= at)).sum() for at in tried]
        assert wrong[-1] == min(wrong)


def test_border_is_the_same_in_the_mirror():
    state = field(shift=3.0)
    mirrored = state.replace(position=-state.position)
    assert border(mirrored)[0].tolist() == [-3.0] and border(state)[0].tolist() == [3.0]
    assert (border(state)[1].tolist(), border(mirrored)[1].tolist()) == ([0], [1])


@pytest.mark.filterwarnings("ignore:.*empty. the cells are of")
def test_there_is_no_border_without_two_types():
    """One type or no cell: NaN. A colony that has lost a type has loss 1."""
    state = placed(
        [(-1, 0), (1, 0), (0, 0), (2, 0)],
        cell_type=[0, 1, 1, 1],
        colony=[0, 0, 1, 1],
        colonies=3,
        yfp=1.0,
    )
    assert border(state)[0].isnan().tolist() == [False, True, True]
    target = Stripe("yfp", width=4.0, cell_type=1)
    assert target.loss(state).tolist()[1:] == [1.0, target.failed]
    assert all(v.isnan().tolist()[1:] == [True, True] for v in target.measures(state).values())
    gone = state.remove(state.colony >= 0, "removed")
    assert target.loss(gone).tolist() == [target.failed] * 3


@pytest.mark.parametrize("turned", [False, True], ids=["x", "y"])
@pytest.mark.parametrize("low", [0, 1])
def test_a_stripe_of_one_type_adjoins_the_border_on_its_side(turned, low):
    """The cells of the far type should be lit within 6 µm, those of the near type on the other
    side; cells of the other type do not count."""
    state = field(shift=5.0, turned=turned, low=low)
    along = "y" if turned else "x"
    x = state.position[:, int(turned)] - 5.0
    far = Stripe("yfp", straight=True, width=6.0, along=along, cell_type=1 - low, edge_width=SHARP)
    assert torch.equal(far.target_profile(state)[:, 0], ((x > 0) & (x < 6)).double())
    # 6 columns at 8 and 14 at 1/8: 1 − (6·8)²/(6 · (6·64 + 14/64))
    assert float(far.loss(state)) == pytest.approx(1 - 48**2 / (6 * (6 * 64 + 14 / 64)), rel=1e-9)
    near = Stripe("yfp", straight=True, width=6.0, along=along, cell_type=low, edge_width=SHARP)
    assert torch.equal(near.target_profile(state)[:, 0], ((x > -6) & (x < 0)).double())
    # all 20 columns evenly lit
    assert float(near.loss(state)) == pytest.approx(1 - 6 / 20, rel=1e-9)


@pytest.mark.parametrize(
    "options, low, high",
    [
        ({}, -3, 3),
        ({"place": 2.0}, -1, 5),
        ({"place": 0.0, "cell_type": 1}, -3, 3),
        ({"place": 4.0, "cell_type": 0}, -7, -1),  # into the cells of that type
        ({"place": 4.0, "cell_type": 1}, 1, 7),
        ({"place": -4.0, "cell_type": 1}, -7, -1),
        ({"at": 10.0}, 2, 8),  # 5 µm from the border
        ({"at": 10.0, "place": 1.0, "cell_type": 1}, 3, 9),
    ],
)
def test_where_the_stripe_is(options, low, high):
    state = field(shift=5.0)
    x = state.position[:, 0] - 5.0
    assert torch.equal(
        Stripe("yfp", straight=True, width=6.0, edge_width=SHARP, **options).target_profile(state)[
            :, 0
        ],
        ((x > low) & (x < high)).double(),
    )


@pytest.mark.parametrize("turned", [False, True], ids=["x", "y"])
@pytest.mark.parametrize("mirror", [False, True])
def test_measures_of_a_stripe_laid_out_by_hand(turned, mirror):
    """Six columns of 8, fourteen of 1/8, the first at the border: middle 3 µm from it, six strips
    of 1 µm wide, and straight. On the line between the middles of the sixth and the seventh, half
    the peak is at 4/(8 − 1/8) of 1 µm."""
    state = field(shift=5.0, turned=turned)
    if mirror:
        state = state.replace(position=-state.position)
    found = Stripe(
        "yfp", straight=True, width=6.0, cell_type=1, along="y" if turned else "x"
    ).measures(state)
    assert list(found) == ["place_um", "width_um", "peak", "straightness_um", "contrast"]
    assert float(found["place_um"]) == pytest.approx(-3 if mirror else 3, abs=1e-12)
    assert float(found["width_um"]) == pytest.approx(5.5 + 4 / 7.875, rel=1e-12)
    assert (float(found["peak"]), float(found["contrast"])) == (8.0, 64.0)
    assert float(found["straightness_um"]) == pytest.approx(0, abs=1e-12)
    assert all(v.shape == (1,) and v.dtype == torch.float64 for v in found.values())


def test_straightness_of_a_bent_stripe():
    """Bent by a · cos over one period, less the straight line through it: a cosine sampled
    symmetrically has no slope, RMS a/√2. Columns 1 µm apart and strips 4 µm high, in which the
    cosine is averaged (by 0.90), leave 0.3 µm."""
    bend = 4.0
    state = field(bend=bend, edge=6.0)
    found = Stripe("yfp", straight=True, width=6.0, cell_type=1).measures(state)
    assert float(found["straightness_um"]) == pytest.approx(0.9 * bend / math.sqrt(2), abs=0.3)


@pytest.mark.parametrize("slope", [0.0, 0.5, -1.0])
def test_a_slanted_stripe_is_straight(slope):
    state = field(columns=range(-40, 40))
    x, y = state.position.unbind(1)
    state = state.with_fields(yfp=((x - 20 - slope * y).abs() < 2).double() + 0.01)
    # columns 1 µm apart: the middle of a slanted stripe is exact to half of that
    assert (
        float(
            Stripe("yfp", straight=True, width=4.0, cell_type=1).measures(state)["straightness_um"]
        )
        < 0.5
    )


def test_width_is_that_of_the_run_about_the_peak():
    """Other stripes beside it do not count, whether less bright than half, or brighter but
    apart."""
    x = np.repeat(np.arange(0.5, 30.5), 4)
    y = np.tile(np.arange(4.0), 30)
    level = np.select([(x > 4) & (x < 10), (x > 16) & (x < 20)], [4.0, 3.0], 0.5)
    state = placed(np.stack([x, y], 1), yfp=level)
    found = Stripe("yfp", at=0.0, width=6.0, place=7.0).measures(state)
    # on both sides half the peak is at 2/(4 − 1/2) of 1 µm from the middle of a bright strip
    assert float(found["width_um"]) == pytest.approx(5 + 2 * 2 / 3.5, rel=1e-12)
    assert float(found["peak"]) == 4.0


def test_a_dark_colony_has_no_width():
    state = field().with_fields(yfp=torch.zeros(640, dtype=torch.float64))
    found = Stripe("yfp", straight=True, width=6.0, cell_type=1).measures(state)
    assert all(
        math.isnan(found[name])
        for name in ("place_um", "width_um", "peak", "straightness_um", "contrast")
    )


def test_measures_of_each_colony_are_its_own():
    """Colonies of different places and widths in one batch."""
    parts = [
        field(shift=s, columns=range(-20, 20), edge=e)
        for s, e in ((0.0, 0.0), (100.0, 4.0), (-7.0, 8.0))
    ]
    place = torch.cat([p.position for p in parts]).numpy()
    state = placed(
        place,
        colony=np.repeat([0, 1, 2], 640),
        cell_type=torch.cat([p.cell_type for p in parts]).numpy(),
        yfp=torch.cat([p.yfp for p in parts]).numpy(),
        colonies=3,
    )
    found = Stripe("yfp", straight=True, width=4.0, cell_type=1).measures(state)
    assert found["place_um"].tolist() == pytest.approx([3.0, 7.0, 11.0], abs=0.5)
    # the border is an edge of the first; the others are dark on both sides
    assert found["width_um"].tolist() == pytest.approx(
        [5.5 + 4 / 7.875, *[5 + 8 / 7.875] * 2], rel=1e-12
    )


@pytest.mark.parametrize(
    "kinds, options, words",
    [
        (None, {}, "no types"),
        (None, {"at": 0.0, "cell_type": 1}, "no types"),
        ([0, 0, 0], {}, r"exactly two types of cells, and colony 0 has \[0\]"),
        ([0, 1, 2], {}, r"colony 0 has \[0, 1, 2\]"),
        ([0, 1, 1], {"cell_type": 2}, r"cell_type = 2 .*colony 0 has \[0, 1\]"),
        ([0, 1, 1], {"at": 0.0, "cell_type": 2}, r"cell_type = 2 "),
    ],
)
def test_a_first_state_without_the_types_is_refused(kinds, options, words):
    state = row([-1, 0, 1], cell_type=kinds, yfp=1.0)
    with pytest.raises(tf.InputError, match=words):
        Stripe("yfp", width=4.0, **options).check(state)


def test_a_first_state_with_what_is_needed_passes():
    Stripe("yfp", width=4.0).check(tf.scenes.boundary_detector().bind(3).start())
    Stripe("yfp", at=0.0, width=4.0).check(row([0.0], yfp=1.0))


@pytest.mark.parametrize(
    "options, what",
    [
        ({"width": 0.0}, "Stripe.width"),
        ({"width": 1.0, "at": "boundary"}, "Stripe.at"),
        ({"width": 1.0, "at": math.nan}, "Stripe.at"),
        ({"width": 1.0, "at": None}, "Stripe.at"),
        ({"width": 1.0, "place": "left"}, "Stripe.place"),
        ({"width": 1.0, "along": "radius"}, "Stripe.along"),
        ({"width": 1.0, "cell_type": 1.0}, "Stripe.cell_type"),
        ({"width": 1.0, "cell_type": -1}, "Stripe.cell_type"),
        ({"width": 1.0, "edge_width": 0}, "Stripe.edge_width"),
        ({"width": 1.0, "floor": -1}, "Stripe.floor"),
    ],
)
def test_bad_settings_are_refused(options, what):
    with pytest.raises(tf.InputError, match=what):
        Stripe("yfp", **options)


def test_describe_says_where():
    assert (
        Stripe("yfp", width=8.0, cell_type=1).describe()
        == "yfp in a stripe 8 µm wide at the border, cells of type 1"
    )
    assert (
        Stripe("yfp", at=3.0, width=8.0, place=-2.0).describe()
        == "yfp in a stripe 8 µm wide at x = 3 µm, -2 µm from it"
    )


def winding():
    """Two types along a staircase: cells 2 µm apart on a grid, the border at x = 0 below y = 0 and
    at x = 6 above."""
    places = [(x, y) for y in (-6, -4, -2, 0, 2, 4) for x in range(-9, 16, 2)]
    kinds = [int(x > (6 if y >= 0 else 0)) for x, y in places]
    return placed(places, cell_type=kinds, yfp=1.0), torch.tensor(places), torch.tensor(kinds)


@pytest.mark.parametrize("kind", [0, 1])
def test_a_stripe_follows_a_border_that_winds(kind):
    """A cell should be lit if its nearest cell of the other type is nearer than the width and a
    diameter, centre to centre."""
    state, places, kinds = winding()
    apart = (places.unsqueeze(1) - places).double().square().sum(2).sqrt()
    nearest = torch.where(kinds.unsqueeze(1) != kinds, apart, torch.inf).amin(1) - 1.0
    target = Stripe("yfp", width=4.0, cell_type=kind, edge_width=SHARP)
    mine = kinds == kind
    assert torch.equal(target.target_profile(state)[mine, 0], (nearest < 4.0).double()[mine])
    assert float(target.loss(state)) == pytest.approx(
        1 - float((nearest < 4.0)[mine].double().mean()), rel=1e-9
    )
    both = Stripe("yfp", width=4.0, edge_width=SHARP)
    assert torch.equal(both.target_profile(state)[:, 0], (nearest < 2.0).double())
    straight = Stripe("yfp", width=4.0, cell_type=kind, edge_width=SHARP, straight=True)
    assert not torch.equal(straight.target_profile(state)[mine], target.target_profile(state)[mine])


def test_a_stripe_that_winds_is_the_same_in_any_batch():
    state, _, _ = winding()
    target = Stripe("yfp", width=4.0, cell_type=1)
    places, kinds = [*state.position.tolist(), (0, 0), (2, 0)], [*state.cell_type.tolist(), 0, 1]
    two = placed(places, cell_type=kinds, colony=[0] * state.cells + [1, 1], colonies=2, yfp=1.0)
    assert torch.equal(target.loss(two)[:1], target.loss(state))
    assert float(target.loss(two)[1]) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("lean", [-0.4, 0.4])
def test_a_stripe_apart_from_the_border_lies_on_both_sides_of_cells_in_the_middle(lean):
    """By which type lies higher on the axis, chance would tell on which side it is wanted."""
    x = np.arange(-20.0, 20.0) + 0.5
    middle = np.abs(x) < 4
    state = row(x + lean * ~middle, cell_type=np.where(middle, 0, 1), yfp=1.0)
    target = Stripe("yfp", width=6.0, place=8.0, cell_type=1, edge_width=SHARP)
    # 1 µm from a cell at 3.5 to the next at 4.5, which touches it
    away = np.abs(x + lean * np.where(middle, 0, 1)) - 3.5 - 1.0
    wanted = ~middle & (away > 5) & (away < 11)
    assert target.target_profile(state)[~middle, 0].tolist() == wanted[~middle].tolist()
