"""The scene `biofilm` against the theory of nutrient-limited films, and `measure.film`."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_bvp

import torchfilm as tf

FLOOR = {"x": (0.0, 40.0)}


def state_of(position, axis, length=2.0, dim: int = 2, periodic=FLOOR, **options) -> tf.State:
    scene = tf.Scene(tf.Mechanics(dim=dim, periodic=periodic))
    cells = tf.Cells(position=position, axis=axis, length=length, **options)
    return scene.bind(cells=cells).start()


def test_the_film_of_a_cell_that_lies_is_its_outline():
    """A centreline from x = 9 to 11 at y = 0.5: flat there, circles of radius 0.5 beside it."""
    film = tf.measure.film(state_of([[10.0, 0.5]], [[1.0, 0.0]]), 0.1)
    x = (np.arange(400) + 0.5) * 0.1
    beside = np.maximum(np.abs(x - 10.0) - 1.0, 0.0)
    wanted = np.where(beside < 0.5, 0.5 + np.sqrt(np.maximum(0.25 - beside**2, 0.0)), 0.0)
    np.testing.assert_allclose(film.height[0].numpy(), wanted, atol=5e-3)
    assert float(film.coverage) == pytest.approx(np.mean(wanted > 0))
    assert float(film.thickness) == pytest.approx(wanted.mean(), rel=5e-3)
    rough = np.abs(wanted - wanted.mean()).mean() / wanted.mean()
    assert float(film.roughness) == pytest.approx(rough, rel=5e-3)


def test_the_film_of_a_tilted_cell_and_of_one_across_a_face():
    """The top of a straight side rises with the tilt; a cell at a face lies at both ends."""
    tilt = math.radians(30)
    film = tf.measure.film(state_of([[10.0, 3.0]], [[math.cos(tilt), math.sin(tilt)]]), 0.1)
    x = 0.1 * (np.arange(95, 105) + 0.5)
    wanted = 3.0 + (x - 10.0) * math.tan(tilt) + 0.5 / math.cos(tilt)
    np.testing.assert_allclose(film.height[0, 95:105].numpy(), wanted, atol=5e-3)
    across = tf.measure.film(state_of([[0.2, 3.0]], [[1.0, 0.0]]), 0.1).height[0]
    middle = tf.measure.film(state_of([[20.2, 3.0]], [[1.0, 0.0]]), 0.1).height[0]
    torch.testing.assert_close(across.roll(200), middle, rtol=0, atol=1e-5)


def test_films_in_space_and_of_several_colonies():
    """Above a floor at z = −0.5: a sphere above a sphere counts; the second colony is empty of the
    first one's cells."""
    position = [[5.0, 5.0, 0.0], [5.0, 5.0, 1.0], [12.0, 8.0, 0.0]]
    state = state_of(
        position, [[1.0, 0.0, 0.0]] * 3, 0.0, 3, {"x": (0.0, 20.0), "y": (0.0, 10.0)},
        colony=[0, 0, 1],
    )  # fmt: skip
    film = tf.measure.film(state, 0.5, floor=-0.5)
    assert film.height.shape == (2, 40, 20)
    assert float(film.height[0].max()) == pytest.approx(1.5 + math.sqrt(0.25 - 0.125))
    assert film.height[0].argmax() // 20 in (9, 10) and float(film.height[1, 9, 9]) == 0.0
    alone = tf.measure.film(state.select([1]), 0.5, floor=-0.5)
    assert torch.equal(alone.height[0], film.height[1]) and float(alone.thickness) > 0


def test_where_the_floor_is_must_be_known():
    state = state_of([[10.0, 0.5]], [[1.0, 0.0]], periodic={})
    with pytest.raises(tf.InputError, match=r"how far the floor reaches along x.*across=\{'x'"):
        tf.measure.film(state)
    found = tf.measure.film(state, across={"x": (0, 40)})
    torch.testing.assert_close(
        found.height, tf.measure.film(state_of([[10.0, 0.5]], [[1.0, 0.0]])).height
    )
    with pytest.raises(tf.InputError, match=r"axis = 'y' is not allowed: it must be 'x'"):
        tf.measure.film(state, across={"y": (0, 40)})
    with pytest.raises(tf.InputError, match="left out along x, where space is periodic"):
        tf.measure.film(state_of([[10.0, 0.5]], [[1.0, 0.0]]), across={"x": (0, 20)})


def grown(until: float, **parameters) -> tf.State:
    *_, state = tf.simulate(tf.scenes.biofilm(**parameters), until=until, seed=2)
    return state


def test_growth_falls_with_depth_as_diffusion_and_uptake_say():
    """A flat film: D s″ = φ(y) · rate · s/(half + s) / yield, with φ the part of each layer that
    cells fill, the nutrient at the top and no flux at the floor. Cells in each layer grow as the
    solution of the one-dimensional equation says."""
    width, height, diffusion, half, made = 20.0, 40.0, 1e5, 0.1, 2e-3
    state = grown(
        11.0, width=width, height=height, layer=None, diffusion=diffusion, half=half, first=3
    )
    film = tf.measure.film(state)
    assert float(film.roughness) < 0.15 and float(film.thickness) > 15
    y, volume = state.position[:, 1].numpy(), state.volume.double().numpy()
    edges = np.arange(0.0, height + 1e-9, 2.5)
    layer = np.digitize(y, edges) - 1
    filled = np.bincount(layer, volume, len(edges) - 1) / (2.5 * width * 1.0)
    middle = 0.5 * (edges[1:] + edges[:-1])
    phi = lambda z: np.interp(z, middle, filled)
    rates = lambda z, s: np.stack([s[1], phi(z) / made * s[0] / (half + s[0]) / diffusion])
    ends = lambda low, high: np.array([low[1], high[0] - 1.0])
    mesh = np.linspace(0.0, height, 200)
    found = solve_bvp(rates, ends, mesh, np.stack([mesh / height, 0 * mesh + 0.02]))
    assert found.success
    wanted = found.sol(middle)[0] / (half + found.sol(middle)[0])
    rate = state.growth_rate.double().numpy()
    mean = np.bincount(layer, rate * volume, len(edges) - 1) / np.bincount(
        layer, volume, len(edges) - 1
    ).clip(1e-9)
    full = filled > 0.4
    assert full.sum() >= 6 and wanted[full].max() > 4 * wanted[full].min()
    np.testing.assert_allclose(mean[full], wanted[full], atol=0.04)


def test_slow_diffusion_makes_fingers():
    """Where the nutrient reaches only the first cell, a film is rough; where it reaches many it is
    flat (Picioreanu et al. 1998)."""
    state = grown(18.0, diffusion=[2e3] * 3 + [1e5] * 3, height=40.0)
    slow, fast = tf.measure.film(state).roughness.view(2, 3).mean(1).tolist()
    assert slow > 0.15 and fast < 0.06 and slow > 4 * fast


def test_only_the_product_of_diffusion_and_yield_matters():
    """A hundredth of the yield at a hundred times the diffusion: the film is as thick."""
    parts = [
        grown(8.0, diffusion=2e4 * k, growth_yield=2e-3 / k, width=24.0, first=3, height=40.0)
        for k in (1.0, 100.0)
    ]
    one, other = (float(part.volume.sum()) for part in parts)
    assert one > 100.0 and other == pytest.approx(one, rel=0.05)


def test_a_film_reaches_the_top_and_stays():
    """What grows beyond 4 µm below the top is carried away, and noted as having left; the floor is
    covered."""
    left = 0
    for state in tf.simulate(tf.scenes.biofilm(
        diffusion=1e5, width=16.0, height=20.0, first=2), until=14.0
    ):  # fmt: skip
        left += sum(len(e.uid) for e in state.ended if e.fate == "left")
        last = state
    film = tf.measure.film(last)
    assert left > 20 and float(last.position[:, 1].max()) <= 16.0
    assert float(film.coverage) == 1.0 and 13.0 < float(film.thickness) < 18.0


def test_a_box_may_grow_upwards_where_it_is_periodic_at_the_sides():
    """It starts 8 µm high. New medium has the first concentration: what is there and what cells
    have eaten is that of the box as it is now; the sides stay."""
    medium = tf.Medium(
        food=tf.Signal(diffusion=200.0, initial=1.0), box=((0.0, 0.0), (20.0, 8.0)), spacing=2.0,
        depth=1.0, boundary=tf.BoundaryConditions(x=tf.Periodic()), outside="grow", grows="+y",
    )  # fmt: skip
    scene = tf.Scene(
        tf.Monod("food", half=0.1, growth_yield=5.0), tf.Growth(), tf.Division(length=3.5),
        tf.Mechanics(dim=2, walls=[tf.Plane(y=0, facing="+y")], periodic={"x": (0, 20)}), medium,
        founders=tf.Cells(position=[[1.0, 0.5], [11.0, 0.5]], axis=[[1.0, 0.0]] * 2, length=2.0),
    )  # fmt: skip
    eaten = 0.0
    for state in tf.simulate(scene, until=5.0, dt=0.05):
        eaten += (
            float(state.reports["nutrition"].uptake.sum()) if "nutrition" in state.reports else 0
        )
    shape = state.layout.grid.shape[0].tolist()
    assert shape[0] == 10 and shape[1] > 8 and float(state.position[:, 1].max()) > 8.0
    there = float(state.signals["food"].double().sum()) * 4.0
    assert there + eaten == pytest.approx(shape[0] * shape[1] * 4.0, rel=1e-5) and eaten > 5.0


@pytest.mark.parametrize("layer", (5.0, 12.0))
def test_the_bulk_follows_the_surface(layer):
    """The top of the box is at least `layer` above the centre of the highest cell, and at most a
    voxel more than it has been: it does not come down. The nutrient there is that of the bulk."""
    scene = tf.scenes.biofilm(diffusion=2e4, width=20.0, first=2, layer=layer)
    most = 0.0
    for state in tf.simulate(scene, until=8.0):
        top = float(state.layout.grid.high[0, 1])
        if state.step and not state.births:  # daughters are born after the box has grown
            most = max(most, float(state.position[:, 1].max()))
            assert most + layer - 1e-6 <= top < most + layer + 4.0
    assert most > 8.0
    nutrient = state.signals["nutrient"].view(10, -1)
    assert float(nutrient[:, -1].min()) > 0.8 and float(nutrient[:, 0].max()) < 0.2


def test_films_of_the_least_width_grow():
    for seed in range(3):
        scene = tf.scenes.biofilm(diffusion=1e5, width=14.0, first=2, height=24.0)
        *_, state = tf.simulate(scene, until=5.0, seed=seed)
        assert state.cells > 20


def test_the_command_tells_the_thickness_of_a_film():
    from torchfilm.cli.report import _size

    scene = tf.scenes.biofilm(width=20.0, first=2)
    *_, state = tf.simulate(scene, until=3.0)
    thick, rough = (
        float(x) for x in (tf.measure.film(state).thickness, tf.measure.film(state).roughness)
    )
    assert _size(scene, state) == ("film", f"{thick:.1f} µm thick, roughness {rough:.2f} (mean)")
    scene = tf.scenes.microcolony()
    *_, state = tf.simulate(scene, until=1.0)
    assert _size(scene, state)[0] == "colony radius"


def test_what_does_not_make_a_biofilm_is_refused():
    with pytest.raises(
        tf.InputError, match=r"biofilm\(width\) = 41.*a whole number of voxels of 2"
    ):
        tf.scenes.biofilm(width=41.0)
    with pytest.raises(tf.InputError, match=r"biofilm\(width\) = 8.*at least 14"):
        tf.scenes.biofilm(width=8.0, first=1)
    with pytest.raises(tf.InputError, match=r"biofilm\(first\) = 9.*at most 8 on a floor 40 µm"):
        tf.scenes.biofilm(first=9, width=40.0)
