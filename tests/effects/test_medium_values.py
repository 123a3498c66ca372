"""Medium: values on the grid, and what a scene refuses."""

from __future__ import annotations

import math

import pytest
import torch
from exchanging_cells import BOX, F64, advance, exchanging, resting, totals
from helpers import step

import torchfilm as tf
from torchfilm.tools.checks import InputError

# --- values on the grid ---------------------------------------------------------------------------


def test_first_values_and_constants_may_be_numbers_per_colony_or_functions(dtype):
    medium = tf.Medium(
        a=tf.Signal(diffusion=[1.0, 2.0], initial=[3.0, 4.0], decay=[0.0, 1.0]),
        b=tf.Signal(diffusion=0.0, initial=lambda at: (at[:, 0] > 0).double()),
        c=tf.Signal(diffusion=0.0, source=lambda at: (at[:, 1] > 0).double() * 2.0),
        box=BOX,
        spacing=4.0,
    )
    scene = tf.Scene(medium, founders=tf.Cells.single(2))
    state = scene.bind(2, dtype=dtype).start()
    assert state.signals["a"].dtype == dtype and state.signals["a"].reshape(2, -1).mean(
        1
    ).tolist() == [3.0, 4.0]
    after = step(scene, state, 0.5)
    close = {"rel": 20 * torch.finfo(dtype).eps}  # eight voxels an axis, two products
    assert after.signals["a"].reshape(2, -1).amax(1).tolist() == pytest.approx(
        [3.0, 4.0 * math.exp(-0.5)], **close
    )
    assert (
        torch.equal(after.signals["b"], state.signals["b"])
        and float(after.signals["b"].sum()) == 64
    )
    assert float(after.signals["c"].sum()) == pytest.approx(2 * 32 * 2.0 * 0.5, **close)


def test_obstacles_hold_nothing_at_first():
    scene = tf.Scene(
        tf.Medium(
            a=tf.Signal(diffusion=1.0, initial=1.0),
            box=BOX,
            spacing=4.0,
            obstacles=lambda at: at[:, 0] > 0,
        ),
        founders=tf.Cells([[-5.0, 0]], [1.0, 0]),
    )
    state = scene.bind(dtype=F64).start()
    after = advance(scene, state, 3, 0.5)
    assert (
        float(state.signals["a"].sum()) == 32
        and float(after.signals["a"].reshape(8, 8)[4:].abs().max()) == 0
    )
    # the implicit solve stops at a relative 1e-10 or so
    assert float(after.signals["a"].sum()) == pytest.approx(32, rel=1e-9)


def test_flat_cells_may_lie_in_a_box_with_three_dimensions():
    scene = resting(
        tf.Medium(
            ahl=tf.Signal(diffusion=5.0), box=((-8, -8, -8), (8, 8, 8)), spacing=4.0, height=2.0
        ),
        exchanging(1.0),
    )
    after = step(scene, scene.bind(dtype=F64).start(), 1e-6)
    layers = after.signals["ahl"].reshape(4, 4, 4).sum((0, 1))
    assert int(layers.argmax()) == 2  # the layer from 0 to 4 µm, with the plane z = 2 in its middle
    assert float(totals(after)) == pytest.approx(
        float(totals(scene.bind(dtype=F64).start())), rel=1e-14
    )


# --- what is refused ------------------------------------------------------------------------------

GOOD = {"box": BOX, "spacing": 4.0}
AHL = tf.Signal(diffusion=1.0)
BAD = {
    "negative diffusion": (
        lambda: tf.Signal(diffusion=-1.0),
        r"Signal\.diffusion = -1.*at least 0",
    ),
    "negative diffusion of one colony": (
        lambda: tf.Signal(diffusion=[1.0, -2.0]),
        r"Signal\.diffusion\[1\] = -2",
    ),
    "NaN": (lambda: tf.Signal(diffusion=math.nan), r"Signal\.diffusion = nan"),
    "negative decay": (lambda: tf.Signal(diffusion=1.0, decay=-0.1), r"Signal\.decay"),
    "negative start": (lambda: tf.Signal(diffusion=1.0, initial=-0.1), r"Signal\.initial"),
    "periodic without its partner": (
        lambda: tf.BoundaryConditions(x=(tf.Periodic(), tf.NoFlux())),
        r"BoundaryConditions\.x.*periodic at both ends",
    ),
    "periodic for one signal only": (
        lambda: tf.Medium(
            a=AHL,
            b=tf.Signal(diffusion=1.0, boundary=tf.BoundaryConditions(x=tf.Periodic())),
            **GOOD,
        ),
        "periodic for one signal and not for another",
    ),
    "no signal": (lambda: tf.Medium(**GOOD), "has no signal"),
    "misspelt option": (
        lambda: tf.Medium(ahl=AHL, hight=2.0, **GOOD),
        r"Medium\.hight.*a Signal.*spelling",
    ),
    "a number for a signal": (
        lambda: tf.Medium(ahl=10.0, **GOOD),
        r"Medium\.ahl.*a Signal.*ahl=tf\.Signal",
    ),
    "no box": (lambda: tf.Medium(ahl=AHL, box=3.0, spacing=1.0), r"Medium\.box.*two corners"),
    "box inside out": (
        lambda: tf.Medium(ahl=AHL, box=((1.0, 0.0), (0.0, 1.0)), spacing=1.0),
        r"Medium\.box.*first below the second",
    ),
    "not a whole number of voxels": (
        lambda: tf.Medium(ahl=AHL, box=((0, 0), (10, 8)), spacing=4.0),
        r"along x.*whole number of voxels.*2\.5.*make it 8",
    ),
    "too many voxels": (
        lambda: tf.Medium(ahl=AHL, box=((-16e3, -16e3), (16e3, 16e3)), spacing=0.5),
        r"Medium\.box.*at most 67 million.*4,096 million",
    ),
    "spacing": (lambda: tf.Medium(ahl=AHL, box=BOX, spacing=0.0), r"Medium\.spacing"),
    "spacing of three for two": (
        lambda: tf.Medium(ahl=AHL, box=BOX, spacing=(1.0, 1.0, 1.0)),
        r"Medium\.spacing.*2 numbers",
    ),
    "depth of a box with three": (
        lambda: tf.Medium(ahl=AHL, box=((0, 0, 0), (4, 4, 4)), spacing=4.0, depth=1.0),
        r"Medium\.depth",
    ),
    "height outside": (
        lambda: tf.Medium(ahl=AHL, box=((0, 0, 0), (4, 4, 4)), spacing=4.0, height=5.0),
        r"Medium\.height.*within the box",
    ),
    "policy": (lambda: tf.Medium(ahl=AHL, outside="ignore", **GOOD), r"Medium\.outside.*'grow'"),
    "growing where space closes": (
        lambda: tf.Medium(
            ahl=AHL, boundary=tf.BoundaryConditions(x=tf.Periodic()), outside="grow", **GOOD
        ),
        r"Medium\.grows = 'xyz'.*without x: a periodic box cannot grow there.*grows='yz'",
    ),
    "margin of a box that does not grow": (
        lambda: tf.Medium(ahl=AHL, margin=4.0, **GOOD),
        r"Medium\.margin = 4\.0.*outside='grow'",
    ),
    "margin of too many voxels": (
        lambda: tf.Medium(ahl=AHL, outside="grow", margin=1e5, **GOOD),
        r"Medium\.margin = 100000\.0.*at most 67 million voxels",
    ),
    "no margin": (
        lambda: tf.Medium(ahl=AHL, outside="grow", margin=0.0, **GOOD),
        r"Medium\.margin",
    ),
    "growing along nothing": (lambda: tf.Medium(ahl=AHL, grows="", **GOOD), r"Medium\.grows"),
    "method": (
        lambda: tf.Medium(ahl=AHL, method="exact", **GOOD),
        r"Medium\.method.*'exponential'",
    ),
    "flow": (lambda: tf.Medium(ahl=AHL, flow=3.0, **GOOD), r"Medium\.flow"),
    "flow of four": (
        lambda: tf.Medium(ahl=AHL, flow=(1, 2, 3, 4), **GOOD),
        r"Medium\.flow.*two or three",
    ),
    "obstacles": (
        lambda: tf.Medium(ahl=AHL, obstacles=True, **GOOD),
        r"Medium\.obstacles.*function of positions",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_at_construction(case):
    make, said = BAD[case]
    with pytest.raises(InputError, match="(?s)" + said):
        make()


AT_SEED = {
    "too small for its cells": (
        {"box": ((4.0, 4.0), (8.0, 8.0)), "spacing": 4.0},
        r"Medium\.box.*too small for colony 0: 1 cell.*\(0, 0, 0\).*outside='grow'",
    ),
    "obstacles of a wrong shape": (
        {"obstacles": lambda at: at > 0},
        r"obstacles\(positions\).*bool tensor of shape \(64,\)",
    ),
    "obstacles everywhere": ({"obstacles": lambda at: at[:, 0] < 99}, "true everywhere"),
    "flow of a wrong shape": ({"flow": lambda at: at[:, 0]}, r"flow\(positions\)"),
    "exponential with obstacles": (
        {"method": "exponential", "obstacles": lambda at: at[:, 0] > 8},
        "(?i)exponential|separable",
    ),
}


@pytest.mark.parametrize("case", AT_SEED)
def test_bad_input_that_shows_with_the_cells_is_refused_by_seed(case):
    options, said = AT_SEED[case]
    scene = tf.Scene(tf.Medium(ahl=AHL, **{**GOOD, **options}), founders=tf.Cells.single(2))
    with pytest.raises(InputError, match="(?s)" + said):
        scene.bind().start()


@pytest.mark.parametrize(
    "signal",
    [
        tf.Signal(diffusion=1.0, initial=lambda at: at[:, 0]),
        tf.Signal(diffusion=1.0, initial=lambda at: at),
        tf.Signal(diffusion=1.0, decay=lambda at: at),
        tf.Signal(diffusion=1.0, source=lambda at: at[:, 0] * torch.nan),
        tf.Signal(diffusion=1.0, initial=lambda at: 3.0),
    ],
    ids=["negative", "shape", "decay's shape", "NaN source", "no tensor"],
)
def test_a_function_of_places_must_give_one_good_number_for_each(signal):
    with pytest.raises(
        InputError,
        match=r"\(positions\) of the signal 'ahl'.*"
        r"(one number for each position|at least 0 everywhere)",
    ):
        tf.Scene(tf.Medium(ahl=signal, **GOOD), founders=tf.Cells.single(2)).bind().start()


@pytest.mark.parametrize(
    ("medium", "path"),
    [
        ({"ahl": tf.Signal(diffusion=[1.0, 2.0])}, "diffusion"),
        ({"ahl": tf.Signal(diffusion=1.0, decay=[1.0, 2.0])}, "decay"),
        ({"ahl": AHL, "flow": ([1.0, 2.0], 0.0)}, "flow"),
        (
            {"ahl": AHL, "boundary": tf.BoundaryConditions(x=tf.Dirichlet([1.0, 2.0]))},
            "boundary.*value",
        ),
    ],
    ids=["diffusion", "decay", "flow", "face"],
)
def test_a_value_per_colony_must_have_one_for_each(medium, path):
    scene = tf.Scene(tf.Medium(**medium, **GOOD), founders=tf.Cells.single(2))
    with pytest.raises(InputError, match=f"{path}.* has 2 values, but the batch has 3 colonies"):
        scene.bind(3).start()
    assert scene.bind(2).start().colonies == 2


def test_two_media_are_one_too_many():
    with pytest.raises(InputError, match="transport 2 times"):
        tf.Scene(tf.Medium(a=AHL, **GOOD), tf.Medium(b=AHL, **GOOD))


def test_a_flat_box_in_space_is_refused_unless_it_is_meant():
    growth, flat = tf.Growth(rate=1.0), ((-8.0, -8.0), (8.0, 8.0))
    scene = lambda **given: tf.Scene(
        growth,
        tf.Mechanics(),
        tf.Medium(ahl=tf.Signal(diffusion=1.0), box=flat, spacing=4.0, **given),
    )
    with pytest.raises(
        tf.InputError, match=r"Medium\.box.*of three dimensions in a 3-D scene.*depth"
    ):
        scene().bind().start()
    for given in ({"depth": 2.0}, {"outside": "grow"}, {"outside": "reservoir"}):
        scene(**given).bind().start()


@pytest.mark.parametrize("boundary", [tf.Dirichlet(0.0), "noflux", tf.NoFlux], ids=str)
def test_faces_of_a_signal_are_boundary_conditions(boundary):
    with pytest.raises(tf.InputError, match=r"Signal.boundary = .*BoundaryConditions\(x="):
        tf.Signal(diffusion=1.0, boundary=boundary)


def test_a_flow_may_be_stated_for_each_colony():
    """As `tf.PerColony`, or as a list of numbers: the same."""
    flows = [
        tf.Medium(ahl=tf.Signal(diffusion=10.0), box=((-8, -8), (8, 8)), spacing=4.0, flow=(x, 0.0))
        .flow[0]
        for x in (tf.PerColony([0.0, 30.0]), [0.0, 30.0])
    ]  # fmt: skip
    assert flows[0].tolist() == flows[1].tolist() == [0.0, 30.0]


def everywhere(flow):
    return lambda at: at.new_tensor(flow).expand(at.shape)


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("given", [tuple, everywhere], ids=["numbers", "function"])
def test_a_flow_carries_alike_along_each_axis(axis, given):
    """What it brings in through the low face, in space: as along x."""

    def filled(k):
        flow = given([30.0 if n == k else 0.0 for n in range(3)])
        faces = tf.BoundaryConditions(**{"xyz"[k]: (tf.Dirichlet(1.0), tf.Open())})
        medium = tf.Medium(
            a=tf.Signal(diffusion=40.0), box=((-8.0,) * 3, (8.0,) * 3), spacing=4.0, flow=flow,
            boundary=faces,
        )  # fmt: skip
        scene = tf.Scene(medium, dim=3)
        state = advance(scene, scene.bind(dtype=F64).start(), 2, 0.1)
        return state.signals["a"].reshape(4, 4, 4)

    along_x = filled(0)
    assert float(along_x[0].min()) > 1.2 * float(along_x[3].max()) > 0.1
    torch.testing.assert_close(filled(axis).transpose(0, axis), along_x, rtol=1e-9, atol=0)
