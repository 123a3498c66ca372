"""Targets with a profile: losses computed by hand, and the profiles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from patterned import SHARP, crowded, graded, placed, row

import torchfilm as tf
from design.targets import Bands, Gradient, Image, Ring, Stripe
from design.targets.profiles import LEAST, between

# lit at x < 0, dark at x > 0
LEFT = Bands(("yfp",), (-math.inf, 0.0), edge_width=SHARP)
PICTURE = ((0.0, 0.25, 0.5), (1.0, 0.75, 0.0))
PROFILES = {
    "stripe": Stripe("yfp", width=4.0, cell_type=1),
    "stripe anywhere": Stripe("yfp", at=1.0, width=4.0, along="y", floor=0.3),
    "bands": Bands(("yfp", "cfp"), (-6.0, 0.0, 5.0)),
    "rings": Bands(("yfp", "cfp"), (0.0, 3.0, 6.0), along="radius", centre="colony", floor=0.5),
    "ring": Ring("yfp", 4.0, 2.0),
    "gradient": Gradient("yfp", "x", -5.0, 5.0),
    "image": Image("yfp", PICTURE, (12.0, 8.0), centre="colony"),
}


@pytest.mark.parametrize(
    "levels, loss",
    [
        ((1, 1, 0, 0), 0.0),
        ((1, 1, 1, 1), 0.5),  # evenly lit: the share that should be dark
        ((1, 0, 0, 0), 0.5),  # (1)² / (2 · 1)
        ((2, 1, 0, 0), 0.1),  # 9/(2 · 5)
        ((0, 0, 1, 1), 1.0),
        ((0, 0, 0, 0), 1.0),
        ((3, 1, 0, 2), 1 - 16 / 28),
    ],
)
def test_loss_equals_the_hand_calculation(levels, loss):
    """A few operations in float64: 1e-15."""
    state = row([-4, -2, 2, 4], yfp=levels)
    assert LEFT.loss(state).tolist() == pytest.approx([loss], abs=1e-15)
    assert LEFT.loss(state).dtype == torch.float64


@pytest.mark.parametrize("level", [0.01, 1.0, 3.0])
def test_floor_adds_its_share_of_the_loss(level):
    """y = c·m: L = floor²/(c² + floor²)."""
    target = Bands(("yfp",), (-math.inf, 0.0), edge_width=SHARP, floor=0.5)
    found = target.loss(row([-4, -2, 2, 4], yfp=[level, level, 0, 0]))
    assert float(found) == pytest.approx(0.25 / (level**2 + 0.25), rel=1e-14)


def test_cells_count_by_their_volume():
    """Evenly lit, the loss is the share of the volume that should be dark; a ball and a rod of 4 µm
    have π/6 and π/6 + π µm³."""
    state = placed([[-4.0, 0.0], [4.0, 0.0]], length=[0.0, 4.0], yfp=1.0)
    assert float(LEFT.loss(state)) == pytest.approx((1 / 6 + 1) / (1 / 6 + 1 / 6 + 1), rel=1e-14)


@pytest.mark.parametrize("name", PROFILES)
def test_perfect_where_levels_follow_the_profile(name):
    """y = c·m for each species by its own c has no loss but the floor's. LEAST may take m ≤ 1e-3
    off up to 47 of 51 cells, 1e-6 each of Σ m²."""
    target, state = PROFILES[name], crowded()
    profile = target.target_profile(state)
    assert profile.shape == (state.cells, len(target.names)) and bool(
        ((profile >= 0) & (profile <= 1)).all()
    )
    scale = {n: 0.7 * 3**k for k, n in enumerate(target.names)}
    found = target.loss(
        state.with_fields(**{n: scale[n] * profile[:, k] for k, n in enumerate(target.names)})
    )
    left = np.mean([target.floor**2 / (target.floor**2 + c**2) for c in scale.values()])
    assert found.tolist() == pytest.approx([left] * 4, abs=1e-4)


@pytest.mark.parametrize("name", PROFILES)
def test_loss_is_a_share_and_free_of_scale(name):
    """In [0, 1] for 400 random colonies; not changed by a power of two of the levels, if the floor
    goes with them."""
    target, state = PROFILES[name], crowded(seed=5, colonies=40, count=3)
    noise = torch.rand(state.cells, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    some = {n: (10 * noise) ** (k + 1) for k, n in enumerate(target.names)}
    found = target.loss(state.with_fields(**some))
    assert bool(((found >= 0) & (found <= 1)).all()) and float(found.std()) > 0.01
    if target.floor == 0:
        assert torch.equal(
            target.loss(state.with_fields(**{n: v * 2.0**-20 for n, v in some.items()})), found
        )


@pytest.mark.parametrize("name", PROFILES)
def test_gradient_with_respect_to_the_levels(name):
    assert graded(PROFILES[name], crowded(colonies=2, count=12))


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_a_colony_scores_the_same_in_any_batch(name, dtype):
    """To the last bit, and its measures too."""
    target, state = PROFILES[name], crowded(seed=2, colonies=7, dtype=dtype)
    whole, measured = target.loss(state), target.measures(state)
    for k in (0, 3, 6):
        alone = state.select([k])
        assert torch.equal(target.loss(alone)[0], whole[k])
        for what, value in target.measures(alone).items():
            assert value.shape == (1,) and torch.equal(
                value.nan_to_num(-1.0)[0], measured[what].nan_to_num(-1.0)[k]
            ), what


@pytest.mark.parametrize("name", PROFILES)
def test_without_light_or_pattern_the_loss_is_1_with_a_gradient(name):
    """All cells are dark, or the colony lies far from the pattern."""
    target, state = PROFILES[name], crowded(colonies=2)
    dark = state.with_fields(
        **{
            n: torch.zeros(state.cells, dtype=torch.float64, requires_grad=True)
            for n in target.names
        }
    )
    far = state.replace(position=state.position + 1e4)
    loss = target.loss(dark)
    assert loss.tolist() == [1.0, 1.0]
    for grad in torch.autograd.grad(loss.sum(), [dark.fields[n] for n in target.names]):
        assert bool(torch.isfinite(grad).all())
    if name in ("stripe anywhere", "bands"):
        assert target.loss(far).tolist() == [1.0, 1.0]


def test_a_very_low_target_level_counts_as_dark():
    """40 µm from a band with soft edges the target level is 0, though a logistic is never 0."""
    target = Bands(("yfp",), (0.0, 10.0))
    assert 0 < float(target.target_profile(row([20.0], yfp=[1.0]))[0, 0]) < LEAST
    assert target.loss(row([20.0], yfp=[1.0])).tolist() == [1.0]


@pytest.mark.parametrize("name", PROFILES)
def test_failed_colonies_do_not_affect_others(name):
    """Without cells, or with a level that is NaN. The gradient is finite, and that of the other
    colonies is the same as without them."""
    target, state = PROFILES[name], crowded(colonies=4)
    good = target.loss(state)
    state = state.remove(state.colony == 1, "removed")
    levels = {n: state.fields[n].clone() for n in target.names}
    levels[target.names[0]][state.colony == 2] = math.nan
    given = {n: v.requires_grad_() for n, v in levels.items()}
    loss = target.loss(state.with_fields(**given))
    assert loss[[1, 2]].tolist() == [target.failed] * 2 and torch.equal(loss[[0, 3]], good[[0, 3]])
    for grad in torch.autograd.grad(loss.sum(), list(given.values())):
        assert (
            bool(torch.isfinite(grad).all())
            and bool((grad[state.colony == 2] == 0).all())
            and float(grad.abs().max()) > 0
        )
    assert all(v.shape == (4,) and bool(v[1].isnan()) for v in target.measures(state).values())


def test_levels_below_zero_count_as_none():
    assert LEFT.loss(row([-4, -2, 2, 4], yfp=[-1, -1, 0, 0])).tolist() == [1.0]


def test_edges_are_logistic_and_bands_add_up():
    """σ at the edge, one and two edge widths beyond; adjacent bands add up to one wide band."""
    x = torch.tensor([-2.0, 0.0, 1.0, 4.0], dtype=torch.float64)
    assert between(x, 0.0, math.inf, 2.0).tolist() == pytest.approx(
        [1 / (1 + math.exp(-v / 2)) for v in x.tolist()], rel=1e-14
    )
    state = crowded()
    wanted = Bands(("yfp", "cfp"), (-6.0, 1.0, 5.0)).target_profile(state)
    assert torch.allclose(
        wanted.sum(1, keepdim=True),
        Bands(("yfp",), (-6.0, 5.0)).target_profile(state),
        atol=1e-15,
        rtol=0,
    )


@pytest.mark.parametrize(
    "along, place", [("x", (3.0, 9.0)), ("y", (9.0, 3.0)), ("radius", (0.0, 3.0))]
)
def test_bands_lie_along_their_axis(along, place):
    """3 µm is in the second of three bands, 9 in none. The centre itself is in the first, because a
    radius is never negative."""
    target = Bands(("a", "b", "c"), (0.0, 2.0, 4.0, 6.0), along=along, edge_width=SHARP)
    state = placed([place, (9.0, 9.0), (0.0, 0.0)], a=1.0, b=1.0, c=1.0)
    wanted = target.target_profile(state).tolist()
    assert wanted[:2] == [[0, 1, 0], [0, 0, 0]]
    assert wanted[2] == ([1, 0, 0] if along == "radius" else [0.5, 0, 0])


@pytest.mark.parametrize("dim", [2, 3])
def test_ring_about_the_colony_goes_with_it(dim):
    """Wherever the colony is; in space it is seen from above."""
    place = np.array(
        [
            [3.0, 0.0, 0.0],
            [-3.0, 0.0, 5.0],
            [0.0, 3.0, 0.0],
            [0.0, -3.0, -5.0],
            [0.0, 0.0, 0.0],
            [6.0, 0.0, 0.0],
            [-6.0, 0.0, 0.0],
        ]
    )[:, :dim]
    levels = [2, 2, 2, 2, 0, 0, 0]
    for shift in (0.0, 1000.0):
        state = placed(place + shift, yfp=levels)
        target = Ring("yfp", 3.0, 1.0, edge_width=SHARP)
        assert target.target_profile(state)[:, 0].tolist() == [1, 1, 1, 1, 0, 0, 0]
        assert float(target.loss(state)) == 0
        assert float(target.measures(state)["radius_um"]) == pytest.approx(3.0, rel=1e-12)
    # a disc
    assert Ring("yfp", 2.0, 4.0, edge_width=SHARP).target_profile(state)[:, 0].tolist() == [
        1,
        1,
        1,
        1,
        1,
        0,
        0,
    ]


@pytest.mark.parametrize(
    "low, high, wanted", [(-4, 4, [1, 1, 0.75, 0.5, 0, 0]), (4, -4, [0, 0, 0.25, 0.5, 1, 1])]
)
def test_gradient_is_straight_between_its_ends(low, high, wanted):
    state = row([-9, -4, -2, 0, 4, 9], yfp=wanted)
    target = Gradient("yfp", "x", low, high)
    assert target.target_profile(state)[:, 0].tolist() == wanted
    assert float(target.loss(state)) == pytest.approx(0, abs=1e-15)
    assert float(target.measures(state)["correlation"]) == pytest.approx(1, abs=1e-12)
    turned = state.with_fields(yfp=1 - state.yfp)
    assert float(target.measures(turned)["correlation"]) == pytest.approx(-1, abs=1e-12)


def test_image_is_bilinear_with_its_first_row_on_top():
    """Pixels 4 µm wide and high, the picture about (10, 20): their middles, half-way between two,
    between four, at the rim, and beside it."""
    target = Image("yfp", PICTURE, (12.0, 8.0), centre=(10.0, 20.0))
    places = {
        (6, 22): 0.0,
        (10, 22): 0.25,
        (14, 22): 0.5,
        (6, 18): 1.0,
        (14, 18): 0.0,
        (8, 22): 0.125,
        (6, 20): 0.5,
        (8, 20): 0.5,
        (8, 19): 0.6875,
    }
    places |= {(4, 16): 1.0, (16, 24): 0.5, (3.99, 18): 0.0, (6, 15.99): 0.0}
    wanted = target.target_profile(placed(list(places), yfp=1.0))[:, 0].tolist()
    assert wanted == pytest.approx(list(places.values()), abs=1e-14)


def test_image_of_one_pixel_is_a_box():
    wanted = Image("yfp", [[1]], (4.0, 2.0)).target_profile(
        placed([(0, 0), (1.9, -0.9), (2.1, 0), (0, 1.1)], yfp=1.0)
    )
    assert wanted[:, 0].tolist() == [1, 1, 0, 0]


def test_image_from_a_file(tmp_path):
    (tmp_path / "x.csv").write_text("0,0.25,0.5\n1,0.75,0\n")
    assert Image.load(tmp_path / "x.csv", "yfp", (12.0, 8.0)) == Image(
        "yfp", np.array(PICTURE), (12.0, 8.0)
    )
    (tmp_path / "bad.csv").write_text("0,red\n")
    for name in ("bad.csv", "none.csv"):
        with pytest.raises(tf.InputError, match=name):
            Image.load(tmp_path / name, "yfp", (12.0, 8.0))


@pytest.mark.parametrize("kind", ["grey", "colour", "opaque", "jpg"])
def test_image_from_a_picture(kind, tmp_path):
    """Black is 0 and white 1; what shows through counts as black."""
    image = pytest.importorskip("PIL.Image")
    levels = np.array([[0, 51, 255], [102, 255, 0]], np.uint8)
    if kind == "grey":
        made = image.fromarray(levels)
    elif kind == "opaque":
        white = np.full((2, 3, 3), 255, np.uint8)
        made = image.fromarray(np.dstack([white, levels]))
    else:
        made = image.fromarray(np.dstack([levels] * 3))
    path = tmp_path / ("x.jpg" if kind == "jpg" else "x.png")
    made.save(path, **({"quality": 100, "subsampling": 0} if kind == "jpg" else {}))
    found = Image.load(path, "yfp", (12.0, 8.0))
    np.testing.assert_allclose(found.mask, levels / 255, atol=0.02 if kind == "jpg" else 1e-6)
    path.write_text("no picture")
    with pytest.raises(tf.InputError, match="or a picture as PNG"):
        Image.load(path, "yfp", (12.0, 8.0))


def test_measures_say_how_bright_it_is_inside_and_outside():
    found = LEFT.measures(row([-4, -2, 2, 4], yfp=[3, 1, 0.5, 0.5]))
    assert {name: float(v) for name, v in found.items()} == {
        "inside": 2.0,
        "outside": 0.5,
        "contrast": 4.0,
    }
    two = Bands(("yfp", "cfp"), (-9, 0, 9), edge_width=SHARP).measures(
        row([-4, 4], yfp=[1, 0], cfp=[1, 2])
    )
    assert float(two["cfp_contrast"]) == 2
    # nothing is lit outside: the contrast has no bound; nothing anywhere: there is none
    assert float(two["yfp_contrast"]) == float("inf")
    assert bool(LEFT.measures(row([-4, 4], yfp=[0, 0]))["contrast"].isnan())


def test_a_signal_is_seen_where_the_cells_are():
    """ "out.ahl" is what the medium holds where a cell is, with its gradient; in a flat field all
    cells find the same."""
    scene = tf.Scene(
        tf.Growth(),
        tf.Medium(ahl=tf.Signal(diffusion=1.0, initial=0.5), box=((-8, -8), (8, 8)), spacing=4.0),
        founders=tf.Cells([[-3.0, 0.0], [-1.0, 0.0], [3.0, 0.0]], [1.0, 0.0], 0.0),
    )
    state = scene.bind(dtype=torch.float64).start()
    target = Bands(("out.ahl",), (-math.inf, 0.0), edge_width=SHARP)
    target.check(state)
    values = state.fields["out.ahl"].clone().requires_grad_()
    loss = target.loss(state.with_fields(**{"out.ahl": values}))
    assert float(loss.detach()) == pytest.approx(1 / 3, rel=1e-12)
    (grad,) = torch.autograd.grad(loss.sum(), values)
    assert bool(torch.isfinite(grad).all()) and float(grad.abs().max()) > 0.01
    with pytest.raises(tf.InputError, match=r"Did you mean 'out.ahl'"):
        Bands(("out.ahi",), (0.0, 1.0)).check(state)
    with pytest.raises(tf.InputError, match=r"Did you mean 'out.ahl'"):
        Bands(("ahl",), (0.0, 1.0)).check(state)


def test_an_unknown_species_is_refused_without_what_effects_keep_for_themselves():
    def made(u, s, p, cell):
        return {"yfp": 1.0 - u.yfp}

    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(added=2.0),
        tf.Circuit(made, species="yfp", name="second"),
        dim=2,
    )
    with pytest.raises(tf.InputError) as caught:
        Bands(("ypf",), (0.0, 1.0)).check(scene.bind().start())
    assert "one of 'growth_rate', 'second_yfp'." in str(caught.value)


@pytest.mark.parametrize("name", PROFILES)
def test_an_unknown_species_is_refused_with_the_known_ones(name):
    state = crowded(names=("yfq", "cfp"))
    for look in (PROFILES[name].check, PROFILES[name].loss):
        with pytest.raises(
            tf.InputError, match=r"'yfp' is not allowed.*'yfq'.*Did you mean 'yfq'\?"
        ):
            look(state)


@pytest.mark.parametrize(
    "make, what",
    [
        (lambda: Bands("yfp", (0, 1)), "Bands.species"),
        (lambda: Bands((), ()), "Bands.species"),
        (lambda: Bands(("a", "a"), (0, 1, 2)), "Bands.species"),
        (lambda: Bands(("a", "b c"), (0, 1, 2)), "Bands.species"),
        (lambda: Bands(("a",), (0, 1, 2)), "Bands.edges"),
        (lambda: Bands(("a",), (1, 1)), "Bands.edges"),
        (lambda: Bands(("a",), (1, math.nan)), "Bands.edges"),
        (lambda: Bands(("a",), "01"), "Bands.edges"),
        (lambda: Bands(("a",), (-1, 1), along="radius"), r"Bands.edges\[0\]"),
        (lambda: Bands(("a",), (0, 1), along="depth"), "Bands.along"),
        (lambda: Bands(("a",), (0, 1), centre="middle"), "Bands.centre"),
        (lambda: Bands(("a",), (0, 1), centre=(0, 1, 2)), "Bands.centre"),
        (lambda: Bands(("a",), (0, 1), edge_width=0.0), "Bands.edge_width"),
        (lambda: Bands(("a",), (0, 1), floor=-1.0), "Bands.floor"),
        (lambda: Ring(("a",), 1.0, 1.0), "Ring.species"),
        (lambda: Ring("a", 0.0, 1.0), "Ring.radius"),
        (lambda: Ring("a", 1.0, 2.5), "Ring.width"),
        (lambda: Ring("a", 1.0, math.inf), "Ring.width"),
        (lambda: Gradient("a", "depth", 0.0, 1.0), "Gradient.along"),
        (lambda: Gradient("a", "x", 1.0, 1.0), "Gradient.low"),
        (lambda: Gradient("a", "radius", -1.0, 1.0), "Gradient.low"),
        (lambda: Image("a", [[0.0, 2.0]], (1, 1)), "Image.mask"),
        (lambda: Image("a", [[0.0, 0.0]], (1, 1)), "Image.mask"),
        (lambda: Image("a", [0.0, 1.0], (1, 1)), "Image.mask"),
        (lambda: Image("a", [[0.0], [1.0, 0.0]], (1, 1)), "Image.mask"),
        (lambda: Image("a", [[math.nan]], (1, 1)), "Image.mask"),
        (lambda: Image("a", [[1.0]], (1, 0)), r"Image.size\[1\]"),
    ],
)
def test_bad_settings_are_refused(make, what):
    with pytest.raises(tf.InputError, match=what):
        make()


def test_targets_are_values():
    """Targets with equal settings are equal and hashable; they are frozen and have a
    description."""
    assert Image("a", np.array(PICTURE), [12, 8]) == Image("a", PICTURE, (12.0, 8.0))
    assert len({*PROFILES.values(), *PROFILES.values()}) == len(PROFILES)
    assert all("yfp" in t.describe() and "\n" not in t.describe() for t in PROFILES.values())
    with pytest.raises(AttributeError):
        LEFT.floor = 1.0


@pytest.mark.parametrize(
    "target, places",
    [
        (Ring("yfp", radius=3.0, width=2.0), [(0.0, 0.0)]),
        (Bands(("yfp",), (20.0, 26.0)), [(0.0, 0.0), (16.0, 0.0)]),
    ],
)
def test_the_soft_tail_of_an_edge_that_is_not_reached_is_no_pattern(target, places):
    """A colony that is lit in proportion to the tail does not have the pattern."""
    state = placed(places, yfp=1.0)
    wanted = target.target_profile(state)[:, 0]
    assert 0 < float(wanted.max()) < 0.25
    assert target.loss(state.with_fields(yfp=wanted)).tolist() == [1.0]


def test_a_gradient_that_falls_as_an_exponential():
    """What diffuses and decays is perfect; turned round, it falls the other way."""
    x = np.linspace(-10.0, 60.0, 141)
    wanted = np.exp(-np.maximum(x - 5.0, 0.0) / 20.0)
    target = Gradient("yfp", "x", 5.0, decay_length=20.0)
    assert float(target.loss(row(x, yfp=7 * wanted))) == pytest.approx(0.0, abs=1e-12)
    turned = Gradient("yfp", "x", -5.0, decay_length=-20.0)
    assert float(turned.loss(row(-x, yfp=wanted))) == pytest.approx(0.0, abs=1e-12)
    even = float(target.loss(row(x, yfp=np.ones(141))))
    assert even == pytest.approx(1 - wanted.sum() ** 2 / (141 * (wanted**2).sum()))
    assert "from 1 at 5 µm by a factor of e in 20 µm" in target.describe()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "Gradient.high, Gradient.decay_length = .*one of them"),
        ({"high": 3.0, "decay_length": 2.0}, "Gradient.high, Gradient.decay_length = .*one of"),
        ({"decay_length": 0.0}, "Gradient.decay_length = 0.0 .*other than 0"),
        ({"decay_length": math.inf}, "Gradient.decay_length = inf"),
    ],
)
def test_a_gradient_has_one_form(given, words):
    with pytest.raises(tf.InputError, match=words):
        Gradient("yfp", "x", 1.0, **given)


def test_edges_may_be_an_array():
    bands = Bands(("yfp", "cfp"), np.array([-6, 0, 5]))
    assert bands == Bands(("yfp", "cfp"), (-6.0, 0.0, 5.0)) and bands.edges == (-6.0, 0.0, 5.0)
    with pytest.raises(tf.InputError, match=r"Bands\.edges = \[0\.0, -1\.0\]"):
        Bands(("yfp",), np.array([0.0, -1.0]))
