"""Targets in films and in other periodic spaces: depth below the top, height, images across
faces."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchfilm as tf
from design.targets import Bands, Gradient, Image, Lasting, Observed, Ring, Stripe
from design.targets.geometry import coordinate, offset

PERIOD = 20.0


def film(place, levels=0.0, periodic=("x",), **cells) -> tf.State:
    """Balls at the places (N, d) µm, in a space whose faces are at 0 and 20 µm."""
    place = np.asarray(place, dtype=float)
    faces = {axis: (0.0, PERIOD) for axis in periodic}
    scene = tf.Scene(tf.Mechanics(dim=place.shape[1], periodic=faces))
    gfp = np.broadcast_to(np.asarray(levels, dtype=float), len(place))
    axis = np.eye(place.shape[1])[0]
    given = tf.Cells(place, axis, 0.0, 0.5, extra={"gfp": gfp}, **cells)
    return scene.bind(given.colonies, cells=given, dtype=torch.float64).start()


def stacks(heights) -> np.ndarray:
    """Balls on a floor, heights[k] of them one above the other at x = k + 0.5 µm."""
    return np.array([[k + 0.5, j + 0.5] for k, n in enumerate(heights) for j in range(n)])


HEIGHTS = [3 + k % 5 for k in range(20)]
DEPTHS = torch.tensor([n - j - 0.5 for n in HEIGHTS for j in range(n)], dtype=torch.float64)


def test_depth_below_the_top_of_stacks_of_balls():
    state = film(stacks(HEIGHTS))
    torch.testing.assert_close(tf.measure.below_top(state), DEPTHS)
    lifted = film(stacks(HEIGHTS) + np.array([0.0, 2.0]))
    torch.testing.assert_close(tf.measure.below_top(lifted, floor=2.0), DEPTHS)
    # one column: the seven balls at x = 9.5 touch its middle, at the height of their centres
    one = tf.measure.below_top(state, 20.0)
    torch.testing.assert_close(one.max(), torch.tensor(6.0, dtype=torch.float64))
    # cells beyond the measured part have no depth
    part = film(stacks(HEIGHTS), periodic=())
    depth = tf.measure.below_top(part, across={"x": (0.0, 10.0)})
    inside = part.position[:, 0] < 10
    torch.testing.assert_close(depth[inside], DEPTHS[inside])
    assert bool(torch.isnan(depth[~inside]).all())


def test_depth_below_the_top_counts_cells_above_alone():
    """A rod that lies over a ball; a rod that stands, beside the middle of its column; in space."""
    place = [[5.5, 0.5], [6.0, 4.0], [12.0, 2.0]]
    axis = [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    scene = tf.Scene(tf.Mechanics(dim=2, periodic={"x": (0.0, PERIOD)}))
    cells = tf.Cells(position=place, axis=axis, length=[1e-3, 3.0, 2.0])
    state = scene.bind(cells=cells).start()
    torch.testing.assert_close(
        tf.measure.below_top(state), torch.tensor([4.0, 0.5, 1.5], dtype=torch.float64),
        atol=1e-3, rtol=0,
    )  # fmt: skip
    space = film([[5.5, 5.5, 0.5], [5.5, 5.5, 3.5], [9.5, 5.5, 0.5]], periodic=("x", "y"))
    assert tf.measure.below_top(space).tolist() == pytest.approx([3.5, 0.5, 0.5])


def test_bands_below_the_top_and_along_z():
    """Lit in the upper 2 µm: perfect, and evenly lit cells have the share that should be dark."""
    target = Bands(("gfp",), (-math.inf, 2.0), along="top", edge_width=0.01)
    state = film(stacks(HEIGHTS), (DEPTHS < 2.0).double())
    target.check(state)
    assert float(target.loss(state)) == pytest.approx(0.0, abs=1e-12)
    even = state.with_fields(gfp=torch.ones_like(state.gfp))
    assert float(target.loss(even)) == pytest.approx(float((DEPTHS > 2).double().mean()), abs=1e-6)
    falling = Gradient("gfp", "top", 0.5, 6.5)
    graded = state.with_fields(gfp=((6.5 - DEPTHS) / 6.0).double())
    assert float(falling.loss(graded)) == pytest.approx(0.0, abs=1e-9)
    z = np.arange(12) + 0.5
    column = np.stack([0 * z + 5.5, 0 * z + 5.5, z], 1)
    high = Bands(("gfp",), (6.0, math.inf), along="z", edge_width=0.01)
    lit = film(column, (z > 6).astype(float), periodic=("x", "y"))
    high.check(lit)
    assert float(high.loss(lit)) == pytest.approx(0.0, abs=1e-12)


def test_the_place_of_a_batch_and_of_a_colony_does_not_matter():
    """Two films, of which one is moved around the faces."""
    places = stacks(HEIGHTS)
    moved = (places + np.array([7.0, 0.0])) % [PERIOD, 100.0]
    both = np.concatenate([places, moved])
    state = film(both, torch.cat([DEPTHS, DEPTHS]), colony=[0] * len(places) + [1] * len(moved))
    target = Bands(("gfp",), (1.0, 3.0), along="top")
    losses = target.loss(state)
    assert torch.equal(losses[:1], losses[1:])
    assert torch.equal(target.loss(state.select([1])), losses[1:])


def test_places_are_those_of_the_nearest_image():
    state = film([[19.0, 0.0], [1.0, 3.0], [9.0, -4.0]])
    assert offset(state, (0.0, 0.0)).tolist() == [[-1.0, 0.0], [1.0, 3.0], [9.0, -4.0]]
    assert coordinate(state, "radius", (18.0, 0.0)).tolist() == pytest.approx(
        [1.0, math.hypot(3.0, 3.0), math.hypot(9.0, 4.0)]
    )
    disc = Ring("gfp", 2.0, 4.0, centre=(0.0, 1.5), edge_width=0.01)
    disc.check(state)
    lit = state.with_fields(gfp=torch.tensor([1.0, 1.0, 0.0]))
    assert float(disc.loss(lit)) == pytest.approx(0.0, abs=1e-9)
    stripe = Stripe("gfp", at=19.5, width=4.0, edge_width=0.01)
    assert float(stripe.loss(lit)) == pytest.approx(0.0, abs=1e-9)


def test_a_border_winds_across_the_faces():
    """Type 1 at x = 0.5 touches type 0 at x = 19.5: lit cells are within 2 µm of the other type."""
    x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(20.0), np.arange(10.0), indexing="ij"))
    kind = ((x < 8) ^ (y > 5)).astype(int)  # along x the types change places at 8 and 20
    state = film(np.stack([x, y], 1), cell_type=kind)
    apart = np.abs(x[:, None] - x), np.abs(y[:, None] - y)
    distance = np.hypot(np.minimum(apart[0], PERIOD - apart[0]), apart[1])
    nearest = np.where(kind[:, None] != kind, distance, np.inf).min(1)
    lit = state.with_fields(gfp=torch.tensor(nearest < 2.5).double())
    target = Stripe("gfp", at="border", along="y", width=3.0, edge_width=0.01)
    target.check(lit)
    assert float(target.loss(lit)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "target, words",
    [
        (Ring("gfp", 5.0, 2.0), r"Ring.centre = 'colony'.*\(x, y\) µm, as space is periodic along"),
        (Bands(("gfp",), (0, 3), along="edge"), r'periodic along x and y.*along="top"'),
        (Image("gfp", ((1.0,),), (2.0, 2.0), centre="colony"), "Image.centre"),
        (Stripe("gfp", width=3.0), "Stripe.at = 'border'.*borders come in pairs"),
        (Gradient("gfp", "z", 0, 3), r"Gradient.along = 'z'.*the plane has.*along \"y\""),
        (Bands(("gfp",), (0, 3), along="top"), "below_top goes by height along y, and space is"),
        (Lasting(Ring("gfp", 5.0, 2.0), since=1.0), "Ring.centre"),
    ],
)
def test_what_a_periodic_space_does_not_have(target, words):
    place = np.random.default_rng(0).uniform(1.0, 19.0, (12, 2))
    state = film(place, periodic=("x", "y"), cell_type=[0, 1] * 6)
    with pytest.raises(tf.InputError, match=words):
        target.check(state)


@pytest.mark.parametrize("box", [False, True])
def test_the_top_is_that_of_a_periodic_film(box):
    """The floor of a box may grow, or end below cells: colonies would differ in it."""
    medium = tf.Medium(m=tf.Signal(1.0, source=1.0), box=((0, 0), (20, 20)), spacing=1.0)
    cells = tf.Cells([[1.0, 1.0]], [[1.0, 0.0]], extra={"gfp": [1.0]})
    state = tf.Scene(tf.Growth(rate=1.0), *[medium] * box, founders=cells, dim=2).bind().start()
    with pytest.raises(tf.InputError, match=r"Bands.along = 'top'.*periodic along x. Write tf.Mec"):
        Bands(("gfp",), (0, 3), along="top").check(state)


def test_a_stripe_at_a_face_is_as_straight_as_elsewhere():
    """A wavy stripe, moved around the faces: all measures are those of the same stripe."""
    place = np.stack([v.ravel() + 0.5 for v in np.meshgrid(*[np.arange(20.0)] * 2)], 1)
    lit = np.abs(place[:, 0] - 10 - 2 * np.sin(2 * np.pi * place[:, 1] / 20)) < 2
    here = Stripe("gfp", at=10.0, width=4.0).measures(film(place, lit, periodic=("x", "y")))
    there = place * 1.0
    there[:, 0] = (there[:, 0] - 10.0) % PERIOD
    moved = film(there, lit, periodic=("x", "y"))
    at_face = Stripe("gfp", at=0.0, width=4.0).measures(moved)
    assert float(here["straightness_um"]) > 0.5
    for name, value in here.items():
        assert float(at_face[name]) == pytest.approx(float(value), abs=1e-9), name


def test_observed_places_in_a_periodic_space():
    table = {
        "colony": [0] * 4 + [1] * 4, "x_um": [0, 2, 4, 7] * 2, "y_um": [0, 1, 0, 2] * 2,
        "length_um": [2, 3, 2, 4] * 2, "gfp": [1, 2, 3, 4] * 2,
    }  # fmt: skip
    data = Observed.from_table(table, species=("gfp",))
    state = film([[1.0, 1.0], [3.0, 1.0]])
    with pytest.raises(tf.InputError, match=r"periodic along x. Leave them out: .without\('ext"):
        data.check(state)
    try:
        data.check(state)
    except tf.InputError as error:
        advice = str(error).split(".without(")[1].rstrip(").").replace("'", "").split(", ")
    left = data.without(*advice)
    left.check(state)
    assert bool(torch.isfinite(left.loss(state)).all())


def test_pictures_of_depths(tmp_path):
    """In the plane a line runs below the top; from above no line shows a depth."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    target = Bands(("gfp",), (1.0, 2.5), along="top")
    axes = pyplot.figure().add_subplot()
    state = film(stacks(HEIGHTS))
    target.draw(axes, state, 0)
    x, y = axes.lines[1].get_data()
    wanted = {k + 0.5: n - 2.5 for k, n in enumerate(HEIGHTS)}
    assert {float(a): float(b) for a, b in zip(x, y, strict=True)} == pytest.approx(wanted)
    above = pyplot.figure().add_subplot()
    target.draw(above, film([[1.0, 1.0, 1.0]], periodic=("x", "y")), 0)
    assert not above.lines
    pyplot.close("all")
