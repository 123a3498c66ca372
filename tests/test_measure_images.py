"""Images of colonies in memory."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

import torchfilm as tf
from torchfilm.tools.tangents import forward_mode

WINDOW = ((-8.0, -6.0), (8.0, 6.0))
PLACES = [[0.0, 0.0], [4.0, 2.0], [-5.0, -3.0]]
AXES = [[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]


def colony(dim: int = 2, **options) -> tf.State:
    pad = lambda rows: np.pad(np.array(rows), ((0, 0), (0, dim - 2)))
    cells = tf.Cells(pad(PLACES), pad(AXES), [2.0, 3.0, 1.0], extra={"gfp": [1.0, 2.0, 5.0]})
    scene = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=dim)
    return scene.bind(**{"colonies": 1, **options}).start()


def test_an_image_holds_what_cells_hold():
    state = colony(2)
    ones = torch.ones(3)
    found = tf.measure.image(state, ["gfp", ones], pixel_size=0.05, window=WINDOW)
    assert found.shape == (1, 2, 240, 320) and found.dtype == torch.float64
    totals = found.sum((0, 2, 3)) * 0.05**2
    assert float(totals[0]) == pytest.approx(float((state.gfp * state.volume).sum()), rel=5e-3)
    assert float(totals[1]) == pytest.approx(float(state.volume.sum()), rel=5e-3)
    flat = tf.measure.image(state, "gfp", pixel_size=0.05, window=WINDOW, profile="flat")
    # the cells do not overlap
    assert set(flat.unique().tolist()) == {0.0, 1.0, 2.0, 5.0}
    area = (2.0 * 0.5 * state.length + torch.pi * 0.25)[2]
    assert float((flat == 5.0).sum()) * 0.05**2 == pytest.approx(float(area), rel=1e-2)


def test_the_first_row_lies_at_the_greatest_y():
    found = tf.measure.labels(colony(), pixel_size=0.1, window=WINDOW)[0]
    assert found.shape == (120, 160) and set(found.unique().tolist()) == {0, 1, 2, 3}
    row, column = (int((6.0 - 2.0) / 0.1), int((4.0 + 8.0) / 0.1))
    assert found[row, column] == 2 and found[60, 80] == 1 and found[0, 0] == 0


def test_masks_are_read_back_as_the_cells_that_they_show():
    state = colony()
    mask = tf.measure.labels(state, pixel_size=0.05, window=WINDOW)[0].numpy()
    back = tf.Cells.from_masks(mask, pixel_size=0.05)
    corner = np.array([-8.0 + 0.025, 6.0 - 0.025])  # the centre of the first pixel
    assert back.position + corner == pytest.approx(state.position.numpy(), abs=0.02)
    assert back.length == pytest.approx(state.length.numpy(), abs=0.04)


def test_files_show_the_same(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2), dt=0.1)
    *_, last = tf.simulate(scene, until=2.5, colonies=2, record=tmp_path / "run.h5")
    with tf.Results(tmp_path / "run.h5") as results:
        given = {"pixel_size": 0.1, "window": WINDOW, "colony": 1, "frames": [-1]}
        seen = results.to_labels(tmp_path / "masks.tif", **given)
        light = results.to_ome_tiff(
            tmp_path / "light.tif", channels={"volume": 2.0}, offset=0.0, **given
        )
    mask = tf.measure.labels(last, pixel_size=0.1, window=WINDOW)
    assert mask[1].numpy().tolist() == tifffile.imread(seen).tolist()
    image = tf.measure.image(last, 2.0 * last.volume, pixel_size=0.1, window=WINDOW)
    np.testing.assert_allclose(image[1, 0].numpy(), tifffile.imread(light), rtol=1e-5, atol=1e-5)


def test_each_colony_has_its_own_and_empty_ones_are_dark():
    state = colony(colonies=3)
    some = state.remove((state.colony == 1) | (state.uid == 0), "removed")
    found = tf.measure.image(some, "gfp", pixel_size=0.25, window=WINDOW)
    assert not found[1].any() and torch.equal(found[0], found[2]) and found[0].any()
    alone = tf.measure.image(some.select([2]), "gfp", pixel_size=0.25, window=WINDOW)
    assert torch.equal(alone[0], found[2])
    masks = tf.measure.labels(some, pixel_size=0.25, window=WINDOW)
    assert set(masks[0].unique().tolist()) == {0, 2, 3} and not masks[1].any()


def test_in_space_light_adds_up_and_masks_are_sections():
    cells = tf.Cells([[0, 0, 1.0], [0, 0, 4.0]], [1.0, 0.0, 0.0], 2.0)
    state = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=3).bind().start()
    found = tf.measure.image(state, torch.ones(2), pixel_size=0.5, window=WINDOW)
    assert float(found.max()) == pytest.approx(2.0, rel=0.2)  # both diameters
    at = lambda z: set(
        tf.measure.labels(state, pixel_size=0.25, window=WINDOW, z=z).unique().tolist()
    )
    assert (at(1.0), at(4.0), at(2.5)) == ({0, 1}, {0, 2}, {0})


def test_cells_across_the_faces_are_seen_at_both():
    cells = tf.Cells([[7.8, 0.0]], [1.0, 0.0], 2.0)
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Mechanics(dim=2, periodic={"x": (-8.0, 8.0)}), founders=cells
    )
    found = tf.measure.labels(scene.bind().start(), pixel_size=0.1, window=WINDOW)[0]
    assert found[60, 0] == 1 and found[60, -1] == 1


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda s: tf.measure.image(s, "yfp", pixel_size=0.1, window=WINDOW), "'yfp'"),
        (lambda s: tf.measure.image(s, [], pixel_size=0.1, window=WINDOW), "one or more"),
        (
            lambda s: tf.measure.image(s, np.ones(3), pixel_size=0.1, window=WINDOW),
            r"image\(names\).*one or more",
        ),
        (lambda s: tf.measure.medium(s, "ahl", pixel_size=1.0, window=WINDOW), "scene's Medium"),
        (lambda s: tf.measure.image(s, "gfp", pixel_size=0.0, window=WINDOW), "pixel_size"),
        (lambda s: tf.measure.image(s, "gfp", pixel_size=1e-5, window=WINDOW), "at most"),
        (lambda s: tf.measure.image(s, "gfp", pixel_size=1.0, window=((1, 1), (0, 2))), "window"),
        (
            lambda s: tf.measure.image(s, "gfp", pixel_size=1.0, window=WINDOW, profile="thin"),
            "profile",
        ),
        (lambda s: tf.measure.labels(s, pixel_size=1.0, window=WINDOW, z=1.0), "left out in the"),
    ],
)
def test_what_is_refused(make, said):
    with pytest.raises(tf.InputError, match=said):
        make(colony())


def test_sections_need_a_height():
    with pytest.raises(tf.InputError, match="the height of the section"):
        tf.measure.labels(colony(3), pixel_size=1.0, window=WINDOW)


@pytest.mark.parametrize("profile", ["thickness", "flat"])
def test_an_image_has_derivatives_by_what_cells_hold(profile):
    """Backward and forward, each colony's own; and raises for one by places."""
    state = colony(2, colonies=2)
    weights = torch.rand(2, 2, 24, 32, generator=torch.Generator().manual_seed(0)).double()

    def total(gfp, state=state):
        given = [gfp, gfp**2]
        made = tf.measure.image(state, given, pixel_size=0.5, window=WINDOW, profile=profile)
        return (weights * made).sum()

    gfp = state.gfp.double().requires_grad_()
    with forward_mode():
        pass  # makes torch ready for it
    assert torch.autograd.gradcheck(total, gfp, check_forward_ad=True)
    moving = state.replace(length=state.length.clone().requires_grad_())
    with pytest.raises(tf.InputError, match=r"by quantities of cells and by nothing else"):
        total(gfp, moving).backward()
    (own,) = torch.autograd.grad(total(gfp, moving), gfp)  # passes no place
    (same,) = torch.autograd.grad(total(gfp), gfp)
    assert torch.equal(own, same) and bool(own.any())
    with forward_mode(), pytest.raises(tf.InputError, match="by nothing else"):
        total(gfp, state.replace(length=forward_ad.make_dual(state.length, state.length)))
    assert torch.equal(total(gfp, moving), total(gfp))


def signals(dim, **more):
    box = ((-8.0, -6.0), (8.0, 6.0)) if dim == 2 else ((-8.0, -6.0, -4.0), (8.0, 6.0, 4.0))
    plane = lambda at: 1.0 + 0.1 * at[:, 0] + 0.02 * at[:, 1] + 0.05 * at[:, -1] * (dim == 3)
    medium = tf.Medium(
        a=tf.Signal(diffusion=1.0, initial=plane), b=tf.Signal(diffusion=1.0), box=box,
        spacing=2.0, **more,
    )  # fmt: skip
    state = tf.Scene(tf.Growth(rate=1.0), medium, dim=dim).bind(2, dtype=torch.float64).start()
    return state.with_fields(**{"out.b": 1.0 + state.layout.grid.owner.double()})


@pytest.mark.parametrize(("dim", "z"), [(2, None), (3, 1.0)])
def test_images_of_a_medium_are_what_cells_would_find(dim, z):
    state = signals(dim)
    inner = ((-6.0, -4.0), (6.0, 4.0))
    found = tf.measure.medium(state, ["a", "b"], pixel_size=0.5, window=inner, z=z)
    assert found.shape == (2, 2, 16, 24) and found.dtype == torch.float64
    y = torch.arange(3.75, -4.0, -0.5, dtype=torch.float64).unsqueeze(1)
    x = torch.arange(-5.75, 6.0, 0.5, dtype=torch.float64)
    plane = 1.0 + 0.1 * x + 0.02 * y + (0.05 if dim == 3 else 0.0)
    torch.testing.assert_close(found[:, 0], plane.expand(2, 16, 24), rtol=1e-12, atol=0)
    assert found[0, 1].unique().tolist() == [1.0] and found[1, 1].unique().tolist() == [2.0]


@pytest.mark.parametrize("outside", ["error", "reservoir"])
def test_beyond_the_box_there_is_no_medium_or_the_reservoir(outside):
    state = signals(2, outside=outside)
    wide = ((-10.0, -6.0), (10.0, 6.0))
    found = tf.measure.medium(state, "b", pixel_size=1.0, window=wide)[:, 0]
    beyond = torch.zeros(12, 20, dtype=torch.bool)
    beyond[:, :2] = beyond[:, -2:] = True
    if outside == "error":
        assert torch.equal(found.isnan(), beyond.expand(2, 12, 20))
    else:
        assert (found[:, beyond] == 0.0).all() and not found.isnan().any()
    voxels = state.signals["b"].clone().requires_grad_()
    seen = tf.measure.medium(state.with_fields(**{"out.b": voxels}), "b", pixel_size=1.0,
                             window=((-2.0, -2.0), (2.0, 2.0)))  # fmt: skip
    seen[0].sum().backward()
    assert float(voxels.grad.sum()) == pytest.approx(16.0)
    assert not voxels.grad.reshape(2, -1)[1].any()
