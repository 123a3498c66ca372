"""What targets draw over a colony: the places of the lines. The limits of the axes do not
change."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from patterned import placed

import torchfilm as tf
from design.targets import (
    Bands,
    DomainSize,
    Gradient,
    Image,
    OnFraction,
    Oscillation,
    Ring,
    Stripe,
    Target,
)
from design.targets.geometry import draw_region

WINDOW = (-10.0, 10.0), (-8.0, 8.0)


@pytest.fixture
def ax():
    from matplotlib.figure import Figure

    ax = Figure(figsize=(5, 4)).add_subplot()
    ax.set(xlim=WINDOW[0], ylim=WINDOW[1])
    return ax


def state():
    """Two colonies; the second has its border at x = 5 and its middle at (5, 1)."""
    return placed(
        [(-1, 0), (1, 0), (4, 1), (6, 1)],
        cell_type=[0, 1, 0, 1],
        colony=[0, 0, 1, 1],
        colonies=2,
        yfp=[1, 0, 1, 0],
        cfp=1.0,
    )


def at(ax, axis: int) -> list[float]:
    """The places of the lines that cross an axis."""
    return sorted(float(line.get_data()[axis][0]) for line in ax.lines)


@pytest.mark.parametrize(
    "target, axis, places",
    [
        (Stripe("yfp", straight=True, width=4.0), 0, [3, 5, 7]),
        (Stripe("yfp", straight=True, width=4.0, cell_type=1), 0, [5, 5, 9]),
        (Stripe("yfp", at=-1.0, width=4.0, along="y"), 1, [-3, 1]),
        (Bands(("yfp", "cfp"), (-2, 0, 30)), 0, [-2, 0, 0, 30]),
        (Bands(("yfp",), (-math.inf, 2.0), along="y", centre="colony"), 1, [3]),
        (Gradient("yfp", "x", 3, -3), 0, [-3, 3]),
    ],
)
def test_lines_are_at_the_edges_of_the_bands(ax, target, axis, places):
    """Lines outside the axes do not change their limits."""
    target.draw(ax, state(), 1)
    assert at(ax, axis) == places
    assert (ax.get_xlim(), ax.get_ylim()) == WINDOW


@pytest.mark.parametrize(
    "target, centre, radii",
    [
        (Ring("yfp", 4.0, 2.0), (5, 1), [3, 5]),
        (Bands(("yfp", "cfp"), (0, 3, 20), along="radius"), (0, 0), [0, 3, 3, 20]),
    ],
)
def test_rings_are_circles(ax, target, centre, radii):
    target.draw(ax, state(), 1)
    assert sorted(p.radius for p in ax.patches) == radii and {
        tuple(p.center) for p in ax.patches
    } == {centre}
    assert (ax.get_xlim(), ax.get_ylim()) == WINDOW


@pytest.mark.parametrize(
    "mask",
    [((1.0, 1.0), (1.0, 1.0)), ((0.5,),), ((0.0, 0.2, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))],
)
def test_an_image_is_outlined_about_its_lit_part(ax, mask):
    """Within the image and half a pixel of its rim; also for an image with one grey level."""
    Image("yfp", mask, (6.0, 4.0), centre="colony").draw(ax, state(), 1)
    points = np.concatenate([p.vertices for c in ax.collections for p in c.get_paths()])
    assert len(points) >= 4
    rows, columns = np.shape(mask)
    assert (np.abs(points - [5, 1]) <= np.array([3 + 3 / columns, 2 + 2 / rows]) + 1e-9).all()
    assert (ax.get_xlim(), ax.get_ylim()) == WINDOW


def test_domains_have_a_bar_of_their_size(ax):
    DomainSize(("yfp", "cfp"), 3.5).draw(ax, state(), 1)
    x, y = ax.lines[0].get_data()
    assert x[1] - x[0] == pytest.approx(3.5) and y[0] == y[1] and "3.5 µm" in ax.texts[0].get_text()
    assert (ax.get_xlim(), ax.get_ylim()) == WINDOW


def test_a_share_is_written_below_the_colony(ax):
    """Where it hides no cell."""
    OnFraction("yfp", 0.25, 0.5).draw(ax, state(), 1)
    (words,) = ax.texts
    assert words.get_text() == "yfp on: 0.5, target 0.25"
    ax.figure.canvas.draw()
    assert words.get_window_extent().y1 <= ax.get_window_extent().y0


def test_an_oscillation_has_a_curve_if_there_is_a_history(ax):
    """The curve is that of this colony; the target wave has its maximum where the curve has it."""
    target, time = Oscillation("yfp", 2.0), torch.arange(40, dtype=torch.float64) * 0.1
    target.draw(ax, state(), 1)
    assert not ax.child_axes
    mean = torch.stack([torch.full_like(time, 7.0), 3 + torch.cos(math.pi * (time - 0.4))], 1)
    history = torch.stack([time.unsqueeze(1).expand_as(mean), mean, mean**2], 2)
    history[30:, 1] = math.nan
    target.draw(ax, state(), 1, history)
    wave, curve = (line.get_ydata() for line in ax.child_axes[0].lines)
    assert len(curve) == 30 and np.array_equal(curve, mean[:30, 1].numpy())
    assert np.allclose(wave, curve, atol=1e-9) and int(np.argmax(curve)) in (4, 24)
    target.draw(ax, state(), 1, torch.full((3, 2, 3), math.nan))


def test_a_users_own_target_needs_a_loss_only(ax):
    """The defaults check, note, measure and draw nothing."""

    class Long(Target):
        def loss(self, state, history=None):
            return state.groups.sum(state.length.double().unsqueeze(1)).squeeze(1)

    mine = Long()
    mine.check(state())
    mine.draw(ax, state(), 0)
    assert (
        mine.note(state()) is None
        and mine.measures(state()) == {}
        and mine.describe() == "Long"
        and mine.loss(state()).tolist() == [0, 0]
    )
    with pytest.raises(NotImplementedError, match=r"Target\.loss"):
        Target().loss(state())


def test_a_stripe_that_winds_is_outlined(ax):
    """Around the cells that should be lit, and no others."""
    x, y = np.meshgrid(np.arange(-9.0, 10.0), np.arange(-7.0, 8.0))
    kind = (x > 2 * np.sin(y)).astype(int).ravel()
    turned = np.stack([x, y], -1).reshape(-1, 2)
    field = placed(turned, cell_type=kind, yfp=np.zeros(len(kind)))
    target = Stripe("yfp", at="border", width=4.0, cell_type=1, straight=False)
    wide = (-14.0, 14.0), (-12.0, 12.0)
    ax.set(xlim=wide[0], ylim=wide[1])
    target.draw(ax, field, 0)
    (outline,) = ax.collections
    paths = [p for p in outline.get_paths() if len(p.vertices)]
    inside = np.any([p.contains_points(turned) for p in paths], axis=0)
    lit = (target.target_profile(field)[:, 0] > 0.5).numpy() & (kind == 1)
    assert 0 < lit.sum() < kind.sum()
    assert (inside == lit).mean() > 0.97
    assert (ax.get_xlim(), ax.get_ylim()) == wide


def test_an_outline_goes_around_long_cells_and_across_faces(ax):
    """As wide all along a cell, and on both sides of a periodic space."""
    long = placed([(0.0, 0.0)], length=14.0, yfp=[1.0])
    draw_region(ax, long, 0, torch.ones(1), "red")
    (path,) = [p for c in ax.collections for p in c.get_paths()]
    along = np.stack([np.linspace(-7.0, 7.0, 29), np.full(29, 0.6)], 1)
    assert path.contains_points(along).all() and not path.contains_points(along * [1, 2.5]).any()
    for c in list(ax.collections):
        c.remove()
    cells = tf.Cells([[9.8, 0.0]], [[0.0, 1.0]], 2.0, 0.5)
    scene = tf.Scene(
        tf.Growth(), tf.Mechanics(dim=2, periodic={"x": (-10.0, 10.0)}), founders=cells
    )
    draw_region(ax, scene.bind().start(), 0, torch.ones(1), "red")
    x = np.concatenate([p.vertices[:, 0] for c in ax.collections for p in c.get_paths()])
    assert (x < -9.0).any() and (x > 9.0).any() and not (abs(x) < 8.0).any()
