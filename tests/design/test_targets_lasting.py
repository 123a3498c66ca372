"""Patterns that stay: a target scored on the way, and bands below the edge of a colony."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from patterned import SHARP, crowded, graded, placed

import torchfilm as tf
from design import (
    Bands,
    Burden,
    Constrained,
    Gradient,
    Lasting,
    Observed,
    OnFraction,
    Oscillation,
    Parameter,
    Ring,
    Search,
    Weighted,
)


def filled(a: float, b: float, angle: float = 0.0, at=(0.0, 0.0), dim=2) -> tf.State:
    """Balls on a fine grid within an ellipse of semi-axes a and b."""
    grid = np.stack(np.meshgrid(np.arange(-a, a, 0.4), np.arange(-a, a, 0.4)), -1).reshape(-1, 2)
    grid = grid[(grid[:, 0] / a) ** 2 + (grid[:, 1] / b) ** 2 < 1]
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    places = grid @ turn.T + np.asarray(at)
    return placed(np.pad(places, ((0, 0), (0, dim - 2))), yfp=1.0)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("a, b", [(10.0, 10.0), (14.0, 9.0)])
def test_the_outline_of_a_filled_ellipse_is_its_edge(a, b, dim):
    """To 2 %: the grid has steps of 0.4 µm, and balls of 0.5 µm add r²/4 to a²/4."""
    state = filled(a, b, 0.7, at=(5.0, -3.0), dim=dim)
    found = tf.measure.outline(state)
    assert found.half_axes[0].tolist() == pytest.approx([a, b], rel=0.02)
    assert found.centre[0].tolist() == pytest.approx([5.0, -3.0], abs=0.2)
    if a > b:
        turned = abs(
            float(found.direction[0] @ torch.tensor([math.cos(0.7), math.sin(0.7)]).double())
        )
        assert turned == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("a, b", [(10.0, 10.0), (15.0, 9.0), (12.0, 4.0)])
def test_the_distance_from_an_ellipse_is_that_of_its_nearest_point(a, b):
    """Against the nearest of 20,000 points of the edge, which lie 0.004 µm apart at most."""
    given = (torch.tensor([v]).double() for v in ((1.0, 2.0), (a, b), (0.6, 0.8)))
    ellipse = tf.measure.Outline(*given)
    place = torch.rand(300, 2, generator=torch.Generator().manual_seed(0)).double() * 30 - 14
    angle = torch.linspace(0, 2 * math.pi, 20_000, dtype=torch.float64)
    edge = torch.stack([a * angle.cos(), b * angle.sin()], 1) @ torch.tensor(
        [[0.6, 0.8], [-0.8, 0.6]], dtype=torch.float64
    ) + torch.tensor([1.0, 2.0])
    found = ellipse.below_edge(place, torch.zeros(300, dtype=torch.int64))
    assert torch.allclose(found.abs(), torch.cdist(place, edge).amin(1), atol=5e-3)
    assert bool((found > 0).any()) and bool((found < 0).any())


def test_the_distance_below_the_edge_of_a_disc_is_radius_minus_distance():
    state = filled(12.0, 12.0)
    distance = state.position.norm(dim=1)
    assert torch.allclose(tf.measure.below_edge(state), 12.0 - distance, atol=0.3)


@pytest.mark.parametrize("places", [[[3.0, 1.0]], [[0.0, 0.0], [2.0, 0.0]]])
def test_colonies_of_one_cell_or_in_a_row_have_an_edge(places):
    found = tf.measure.below_edge(placed(places, yfp=1.0))
    assert bool(torch.isfinite(found).all()) and float(found.max()) > 0


def test_a_band_below_the_edge_moves_with_the_edge():
    """Lit from 2 to 4 µm below the edge: perfect for a small colony and for a large one, which no
    ring is. Evenly lit, the loss is the share that should be dark. A few cells of 1,000 lie in the
    soft edge: 2e-3."""
    target = Bands(("yfp",), (2.0, 4.0), along="edge", edge_width=SHARP)
    for radius in (8.0, 16.0):
        state = filled(radius, radius)
        depth = tf.measure.below_edge(state)
        lit = ((depth > 2) & (depth < 4)).double()
        assert float(target.loss(state.with_fields(yfp=lit))) < 2e-3
        assert float(target.loss(state)) == pytest.approx(1 - float(lit.mean()), abs=2e-3)
    gradient = Gradient("yfp", "edge", 0.0, 8.0)
    assert float(gradient.loss(state.with_fields(yfp=(1 - depth / 8).clamp(0, 1)))) < 1e-8


def test_the_edge_of_a_colony_does_not_depend_on_its_batch():
    state = crowded()
    whole = tf.measure.below_edge(state)
    for k in range(4):
        own = tf.measure.below_edge(state.select(torch.tensor([k])))
        assert torch.equal(own, whole[state.colony == k])
    assert graded(Bands(("yfp",), (1.0, 3.0), along="edge"), state)


BAND = Ring("yfp", 6.0, 3.0)


def history_of(target: Lasting, states: list[tf.State]) -> torch.Tensor:
    return torch.stack([target.note(s) for s in states])


def test_a_lasting_target_scores_the_mean_from_its_time_on():
    target = Lasting(BAND, since=1.0)
    state = crowded()
    run = [
        state.with_fields(yfp=state.yfp ** (k + 1.0)).replace(time=0.5 * k, step=k)
        for k in range(5)
    ]
    losses = torch.stack([BAND.loss(s) for s in run])
    history = history_of(target, run)
    assert bool(history[:2].isnan().all()) and torch.equal(history[2:, :, 0], losses[2:])
    torch.testing.assert_close(target.loss(run[-1], history), losses[2:].mean(0))
    assert torch.equal(target.measures(run[-1], history)["worst"], losses[2:].amax(0))
    # colonies that ended on the way have no notes from there on
    history[4, 1] = torch.nan
    expected = losses[2:].mean(0)
    expected[1] = losses[2:4, 1].mean()
    torch.testing.assert_close(target.loss(run[-1], history), expected)


def test_a_colony_that_ends_before_is_scored_at_its_end():
    target, state = Lasting(BAND, since=9.0), crowded()
    for history in (None, history_of(target, [state])):
        assert torch.equal(target.loss(state, history), BAND.loss(state))
    assert target.names == ("yfp",) and target.fewest == BAND.fewest
    assert target.describe() == f"{BAND.describe()}, from 9 h on"


def test_gradients_pass_through_the_notes():
    state = crowded()
    level = state.yfp.clone().requires_grad_()
    run = [state.with_fields(yfp=level**k).replace(time=float(k)) for k in (1, 2)]
    target = Lasting(BAND, since=0.0)
    (found,) = torch.autograd.grad(
        target.loss(run[-1], history_of(target, run)).sum(), level, retain_graph=True
    )
    (wanted,) = torch.autograd.grad(sum(BAND.loss(s).sum() for s in run) / 2, level)
    torch.testing.assert_close(found, wanted)


@pytest.mark.parametrize("wrong", ["ring", Lasting(BAND, since=1.0)])
def test_what_cannot_last_is_refused(wrong):
    with pytest.raises(tf.InputError, match=r"Lasting\.target"):
        Lasting(wrong, since=1.0)
    with pytest.raises(tf.InputError, match="Oscillation, which has a history of its own"):
        Lasting(Oscillation("yfp", 1.0), since=1.0).check(crowded())
    with pytest.raises(tf.InputError, match=r"Lasting\.since"):
        Lasting(BAND, since=-1.0)


def lit_from_the_middle(slope=1.0) -> tf.Scene:
    def rates(u, s, p, cell):
        return {"yfp": torch.exp(-p.slope * (cell.x**2 + cell.y**2)) - u.yfp}

    return tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)), tf.Mechanics(dim=2),
        tf.Circuit(rates, species="yfp", slope=slope),
    )  # fmt: skip


def test_a_search_scores_a_lasting_target():
    disc = Bands(("yfp",), (0.0, 3.0), along="radius", centre="colony")
    ends = []
    for target in (disc, Lasting(disc, since=0.0), Lasting(disc, since=3.4)):
        search = Search(
            lit_from_the_middle, [Parameter("slope", 0.01, 1.0, log=True)], target,
            until=3.5, dt=0.1, replicates=2, method="sobol",
        )  # fmt: skip
        ends.append(search.run(4, progress=False).losses)
    assert not np.allclose(ends[0], ends[1]) and np.allclose(ends[0], ends[2], atol=0.03)


def test_the_drawn_edges_lie_below_the_edge_of_their_colony():
    from matplotlib.figure import Figure

    ax = Figure().add_subplot()
    ax.set(xlim=(-9, 9), ylim=(-8, 8))
    target = Lasting(Bands(("yfp",), (2.0, math.inf), along="edge"), since=1.0)
    target.draw(ax, filled(12.0, 12.0), 0)
    (contour,) = ax.collections
    (path,) = contour.get_paths()
    assert np.hypot(*path.vertices.T) == pytest.approx(np.full(len(path), 10.0), abs=0.2)
    assert (ax.get_xlim(), ax.get_ylim()) == ((-9, 9), (-8, 8))


def test_the_middle_of_a_circle_lies_a_radius_below_its_edge():
    circle = tf.measure.Outline(*torch.tensor([[[0.0, 0.0]], [[5.0, 5.0]], [[1.0, 0.0]]]).double())
    places = torch.tensor([[0.0, 0.0], [0.0, 3.0], [6.0, 0.0]]).double()
    found = circle.below_edge(places, torch.zeros(3, dtype=torch.int64))
    assert found.tolist() == pytest.approx([5.0, 2.0, -1.0])


def test_what_a_target_says_of_itself_holds_from_a_time_on():
    """Constraints are named, data are not compared with answers without a pattern, and every second
    cell lit is no rival of a share of cells that may lie anywhere."""
    kept = Constrained(Burden(), [Ring("yfp", radius=10.0, width=5.0)], at_least={"burden": 2.0})
    seen = Observed.from_table({"length_um": [2.0, 3.0, 2.5], "colony": [0, 0, 1]})
    share = OnFraction("yfp", level=1.0, fraction=0.5)
    for target in (kept, seen, share):
        found = Lasting(target, since=0.5)
        for name in ("pattern", "anywhere", "bounds", "evidence", "lit_from"):
            assert getattr(found, name) == getattr(target, name), (target, name)
    assert (kept.pattern, seen.pattern, share.anywhere) == (True, False, True)
    assert Lasting(kept, since=0.5).bounds == {"burden": "≥ 2"}
    several = Weighted([(seen, 1.0), (Burden(), 0.5)])
    assert not several.pattern


def test_burden_counts_species_and_no_signals():
    making = tf.Circuit(lambda u, s, p, cell: {"a": 0 * u.a + 0 * s.ahl}, species="a",
                        initial={"a": 1.0})  # fmt: skip
    ahl = tf.Signal(diffusion=1.0, initial=100.0)
    medium = tf.Medium(ahl=ahl, box=((-8, -8), (8, 8)), spacing=4.0)
    state = tf.Scene(making, medium, tf.Mechanics(dim=2)).bind().start()
    assert float(Burden().loss(state)) == pytest.approx(1.0)
