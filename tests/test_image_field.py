"""Images as functions of place."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf

PIXELS = np.arange(6.0).reshape(2, 3)  # 0 1 2 above 3 4 5


def at(x, y, **given):
    mask = tf.ImageField(given.pop("image", PIXELS), (6.0, 2.0), **given)
    return float(mask(torch.tensor([[x, y]], dtype=torch.float64)))


@pytest.mark.parametrize("smooth", [True, False])
@pytest.mark.parametrize(("row", "y"), [(0, 0.5), (1, -0.5)])
@pytest.mark.parametrize(("column", "x"), [(0, -2.0), (1, 0.0), (2, 2.0)])
def test_middles_of_pixels_have_their_numbers_and_the_first_row_is_at_the_top(
    smooth, row, y, column, x
):
    assert at(x, y, smooth=smooth) == PIXELS[row, column]
    assert at(x + 7.0, y - 3.0, smooth=smooth, centre=(7.0, -3.0)) == PIXELS[row, column]


def test_between_the_middles_numbers_are_bilinear():
    assert at(-1.0, 0.5) == pytest.approx(0.5)
    assert at(-1.0, 0.0) == pytest.approx(2.0)  # of 0, 1, 3 and 4
    assert at(0.5, 0.25) == pytest.approx(1.25 + 0.25 * 3)
    assert at(-2.9, 0.9) == 0.0 and at(2.9, -0.9) == 5.0  # the rim is as the middle


def test_sharp_pixels_have_one_number_each():
    sharp = lambda x, y: at(x, y, smooth=False)
    assert [sharp(x, 0.1) for x in (-2.99, -1.01, -0.99, 0.99, 1.01, 2.99)] == [0, 0, 1, 1, 2, 2]
    assert [sharp(0.0, y) for y in (0.99, 0.01, -0.01, -0.99)] == [1, 1, 4, 4]


def test_beyond_the_rim_is_outside():
    assert at(3.01, 0.0) == at(0.0, 1.01) == at(-3.01, 0.0) == at(0.0, -1.01) == 0.0
    assert at(3.01, 0.0, outside=-7.0) == -7.0
    assert at(3.0, 0.5) == 2.0 and at(0.0, -1.0) == 4.0


def test_one_pixel_fills_the_image():
    assert at(2.9, -0.9, image=[[4.0]]) == at(0.0, 0.0, image=[[4.0]]) == 4.0


def test_each_place_may_have_an_image_of_its_own():
    several = tf.ImageField(np.stack([PIXELS, PIXELS + 10]), (6.0, 2.0))
    places = torch.tensor([[0.0, 0.5, 3.0], [0.0, 0.5, -9.0]])  # the height does not count
    assert several(places, torch.tensor([1.0, 0.0])).tolist() == [11.0, 1.0]
    assert several(places, 1).tolist() == [11.0, 11.0]
    for which, words in (
        (None, r"one of 2 images for each place"), ([2, 0], "0 to 1"), ([0.5, 0], "0 to 1"),
        ([-1, 0], "0 to 1"),
    ):  # fmt: skip
        with pytest.raises(tf.InputError, match=f"which = .*{words}"):
            several(places, which)


def test_derivatives_reach_pixels_and_places():
    pixels = torch.rand(4, 5, dtype=torch.float64, requires_grad=True)
    places = (torch.rand(9, 2, dtype=torch.float64) * 4 - 2).requires_grad_()
    torch.autograd.gradcheck(lambda p, x: tf.ImageField(p, (5.0, 5.0))(x), (pixels, places))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"image": "x.png"}, "image = 'x.png'"),
        ({"image": [[1.0], [1.0, 2.0]]}, "rows of finite numbers"),
        ({"image": [1.0, 2.0]}, "rows of finite numbers"),
        ({"image": [[np.nan]]}, "rows of finite numbers"),
        ({"size": (1.0, 0.0)}, r"size\[1\] = 0"),
        ({"size": 3.0}, "size = 3"),
        ({"centre": (1.0,)}, "centre"),
        ({"outside": np.inf}, "outside = inf"),
        ({"smooth": "no"}, "smooth = 'no'"),
        ({"pixel_size": 0.1}, "pixel_size"),
    ],
)
def test_bad_images(given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.ImageField(**{"image": PIXELS, "size": (6.0, 2.0), **given})


# --- in a scene -----------------------------------------------------------------------------------

STRIPES = np.array([[0.0, 1.0]])
TWO = tf.Cells([[-5.0, 0.0], [5.0, 0.0]], [[0.0, 1.0]] * 2, 2.0)


def shone_on(field, **parameters) -> tf.Scene:
    def shine(cells):
        cells.light = field(cells.position, cells.p.mask if parameters else None)

    return tf.Scene(
        tf.Rules(shine, variables={"light": 0.0}, parameters=parameters), tf.Growth(rate=0.0),
        founders=TWO, dt=0.1,
    )  # fmt: skip


def test_rules_read_light_at_cells():
    state = shone_on(tf.ImageField(STRIPES, (20.0, 20.0), smooth=False)).bind(2).start()
    *_, end = tf.simulate(shone_on(tf.ImageField(STRIPES, (20.0, 20.0), smooth=False)), until=0.1)
    assert end.light.tolist() == [0.0, 1.0] and state.light.dtype == torch.float32


def test_colonies_may_have_masks_of_their_own():
    masks = tf.ImageField(np.stack([STRIPES, 1 - STRIPES, 0 * STRIPES]), (20.0, 20.0), smooth=False)
    scene = shone_on(masks, mask=[1.0, 2.0, 0.0])
    *_, end = tf.simulate(scene, until=0.1, colonies=3)
    assert end.light.reshape(3, 2).tolist() == [[1, 0], [0, 0], [0, 1]]


def test_a_medium_takes_an_image_as_its_source():
    image = np.random.default_rng(0).random((4, 8))
    field = tf.ImageField(image, (16.0, 8.0))
    signal = tf.Signal(diffusion=0.0, decay=0.0, source=tf.Scaled(field, [1.0, 3.0]))
    medium = tf.Medium(light=signal, box=((-8, -4), (8, 4)), spacing=2.0)
    scene = tf.Scene(tf.Growth(rate=0.0), medium, founders=TWO, dt=0.5)
    *_, end = tf.simulate(scene, until=1.0, colonies=2)
    found = end.signals["light"].reshape(2, 8, 4)
    expected = torch.tensor(image[::-1].T.copy(), dtype=torch.float32)  # x, y
    torch.testing.assert_close(found, torch.stack([expected, 3 * expected]))


def test_another_image_is_another_scene(tmp_path):
    one, same = (tf.ImageField(STRIPES, (20.0, 20.0)) for _ in range(2))
    other = tf.ImageField(1 - STRIPES, (20.0, 20.0))
    assert tf.digest(one) == tf.digest(same) != tf.digest(other)
    assert tf.digest(one) != tf.digest(tf.ImageField(STRIPES, (20.0, 21.0)))
    list(tf.simulate(shone_on(one), until=0.1, record=tmp_path / "run.h5"))
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.state(shone_on(same)).cells == 2
        with pytest.raises(tf.InputError, match="other"):
            results.state(shone_on(other))


def test_a_place_that_is_no_number_is_outside():
    pixels = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64, requires_grad=True)
    nan, inf = float("nan"), float("inf")
    places = torch.tensor([[nan, 0.0], [0.0, inf], [-0.5, 0.5]], dtype=torch.float64)
    for smooth in (True, False):
        found = tf.ImageField(pixels, (2.0, 2.0), outside=7.0, smooth=smooth)(places)
        assert found.tolist() == [7.0, 7.0, 1.0]
        (slope,) = torch.autograd.grad(found.sum(), pixels)
        assert slope.tolist() == [[1.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("more", [{"centre": (1.0, 0.0)}, {"outside": 1.0}, {"smooth": False}])
def test_an_image_that_is_read_otherwise_is_another_scene(more):
    one, other = (tf.ImageField(STRIPES, (20.0, 20.0), **given) for given in ({}, more))
    assert tf.digest(one) != tf.digest(other) == tf.digest(tf.ImageField(STRIPES, (20, 20), **more))


def test_derivatives_reach_the_pixels_of_a_source_and_of_a_rule():
    pixels = torch.rand(2, 2, dtype=torch.float64).requires_grad_()
    field = tf.ImageField(pixels, (20.0, 20.0))
    signal = tf.Signal(diffusion=5.0, source=field)
    medium = tf.Medium(light=signal, box=((-10, -10), (10, 10)), spacing=5.0)
    lit = tf.Scene(tf.Growth(rate=0.0), medium, founders=TWO, dt=0.1)
    for _ in range(2):  # each with its own steps
        end = tf.rollout(lit.bind(dtype=torch.float64), until=0.4)
        (slope,) = torch.autograd.grad(end.signals["light"].mean(), pixels)
        torch.testing.assert_close(slope, torch.full((2, 2), 0.1, dtype=torch.float64))
    model = lit.bind(dtype=torch.float64)
    found = [
        torch.autograd.grad(tf.rollout(model, until=0.4).signals["light"].mean(), pixels)[0]
        for _ in range(2)
    ]
    assert torch.equal(found[0], slope) and torch.equal(found[1], slope)
    end = tf.rollout(shone_on(field).bind(dtype=torch.float64), until=0.1)
    (slope,) = torch.autograd.grad(end.light[1], pixels)
    assert slope.tolist() == [[0.0, 0.5], [0.0, 0.5]]


@pytest.mark.parametrize("of", ["initial", "source", "decay"])
def test_an_image_as_the_value_of_a_signal_is_to_be_a_field(of):
    for image in (STRIPES, np.ones((2, 3)), [[1.0, 2.0], [3.0, 4.0]]):
        with pytest.raises(tf.InputError, match=rf"Signal\.{of} = .*function.*tf\.ImageField\("):
            tf.Signal(diffusion=1.0, **{of: image})
