"""Bilateral contacts, compiled and by torch, take the same steps; compiled ones give the same bits
on any number of threads and in any batch.

Both stop where the worst preconditioned residual is 1e-12 of that at rest, and add in different
orders, so their moves differ. Preconditioned, moves along which no row acts are as long as 1/α of
what drives them: the difference may be 1e-12/α times the move at rest, which is some 0.1 µm.
A hundred times that much is the bound: 1e-11/α, 1e-9 µm with the default α at γ = 10. A row of
another weight, another bound or another pass moves cells by 1e-4 µm or more.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.physics import compiled

F64 = torch.float64
BOX = tf.Box(low=(-4, -4, -1.5), high=(4, 4, 1.5))
FILM = [tf.Plane(z=-0.5, facing="+z", stiffness=16.0), tf.Plane(z=0.5, facing="-z", weight=0.5)]
POSTS = [tf.Sphere((0.0, y), 2.0, inside=False) for y in (4.0, -4.0)]

# The dimension, what mechanics gets, and the least α.
SETS = {
    "in the plane": (2, {}, 0.01),
    "in space": (3, {}, 0.01),
    "γ = 1": (2, {"length_drag": 1.0, "viscosity": 0.1}, 0.1),
    "γ = 10⁴": (2, {"length_drag": 1e4}, 1e-5),
    "γ = 10⁴ in space": (3, {"length_drag": 1e4, "passes": 4}, 1e-5),
    "a drag for each cell": (2, {"viscosity": tf.LogNormal(1.0, 1.0)}, 1e-5),
    "α of the paper": (2, {"alpha": 0.1, "passes": 6, "overlap": 0.01}, 0.1),
    "nearly hard": (3, {"alpha": 1e-4}, 1e-4),
    "between agarose and coverslip": (3, {"walls": FILM}, 0.01),
    "a channel": (2, {"walls": [tf.Channel(5.0, low_end=-6.0, high_end=6.0)], "passes": 3}, 0.01),
    "a box in space": (3, {"walls": [BOX], "passes": 3}, 0.01),
    "a soft box": (2, {"walls": [tf.Box((-3, -3), (3, 3), stiffness=500.0)], "passes": 4}, 0.01),
    "a light box": (
        2,
        {"walls": [tf.Box((-2.5, -2.5), (2.5, 2.5), weight=0.3)], "passes": 4, "overlap": 0.02},
        0.01,
    ),
    "in a ball": (3, {"walls": [tf.Sphere((0.0, 0.0, 0.0), 3.0, inside=True)]}, 0.01),
    "around posts": (2, {"walls": POSTS, "passes": 3}, 0.01),
    "soft cells": (2, {"stiffness": 50.0, "passes": 3}, 0.4),
    "soft cells in space": (3, {"stiffness": 400.0, "walls": [BOX]}, 0.05),
    "sub-steps": (2, {"max_elongation": 0.04}, 0.01),
    "sub-steps in space": (3, {"max_elongation": 0.04, "walls": FILM}, 0.01),
}
COUNTS = ("status", "passes", "clipped", "deeply_overlapping", "substeps")
FIELDS = ("position", "axis", "length", "displacement")


def mechanics(name: str, **more) -> tf.Mechanics:
    dim, given, _ = SETS[name]
    return tf.Mechanics(dim=dim, contacts="bilateral", **{"tolerance": 1e-12, **given, **more})


def model(name: str, backend: str, colonies: int = 2, dtype=F64, **more):
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(2.5, 3.5)),
        mechanics(name, backend=backend, **more),
        dt=0.05,
    )
    return scene.bind(colonies, seed=4, dtype=dtype)


def compare(one: tf.State, other: tf.State, most: float) -> tf.Mechanics:
    """Both have done the same, to `most` µm and rad. Returns the report of one."""
    a, b = one.reports["mechanics"], other.reports["mechanics"]
    for count in COUNTS:
        assert getattr(a, count).tolist() == getattr(b, count).tolist(), count
    for field in FIELDS:
        difference = float((getattr(one, field) - getattr(other, field)).detach().abs().max())
        assert difference <= most, (field, difference)
    assert (a.residual > 0).equal(b.residual > 0) and a.residual.dtype == b.residual.dtype
    return a


@pytest.mark.parametrize("name", SETS)
def test_both_paths_take_the_same_steps(name):
    """As a colony grows to 32 cells."""
    fast, plain = model(name, "compiled"), model(name, "torch")
    state, pushed, alpha = fast.start(), False, SETS[name][2]
    for k in range(75):
        one = fast.step(state, 0.05)
        if k % 6 == 0 or k > 70:
            report = compare(one, plain.step(state, 0.05), 1e-11 / alpha)
            pushed |= bool((report.iterations > 0).any())
        state = one
    assert state.cells >= 2 * 8 and pushed, "the comparison would prove nothing"


@pytest.mark.parametrize("name", ["in the plane", "between agarose and coverslip"])
def test_both_paths_take_the_same_steps_in_float32(name):
    """Torch rounds places in float32, to 1e-6 µm, which a solve may amplify by 1/α = 100; both are
    solved to 1e-4, which also is amplified so. Hence 1e-2 of moves of 0.1 µm."""
    made = [model(name, b, dtype=torch.float32, tolerance=1e-4) for b in ("compiled", "torch")]
    state = made[0].start()
    for k in range(70):
        one = made[0].step(state, 0.05)
        if k % 10 == 0 or k > 66:
            report = compare(one, made[1].step(state, 0.05), 1e-3)
        state = one
    assert (report.iterations > 0).all() and state.position.dtype == F64


def crowd(name: str, seed: int) -> tf.Cells:
    """Cells of many sizes at random in a small box: most overlap, some by more than a radius.

    In the plane they are short, so that no centrelines cross: cells that cross are parted along the
    normal of one of the two, and which one that is depends on their order.
    """
    rng, dim = np.random.default_rng(seed), SETS[name][0]
    axis = rng.normal(size=(40, dim))
    return tf.Cells(
        rng.uniform(-1.5, 1.5, (40, dim)) * [1, 1, 0.7][:dim],
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        length=rng.choice([0.0, 0.05, 0.1] if dim == 2 else [0.0, 1.5, 3.0], 40),
        radius=rng.uniform(0.2, 0.5, 40),
        colony=np.repeat([0, 1], 20),
    )


@pytest.mark.parametrize(
    "name", ["in the plane", "in space", "a box in space", "around posts", "soft cells in space"]
)
@pytest.mark.parametrize("passes", (1, 6))
def test_both_paths_part_a_crowd(name, passes):
    """Cells lie deep in others: moves are cut short, and later passes move a few among the others
    at rest, with rows that hold what is near."""
    scenes = [
        tf.Scene(tf.Growth(rate=1.0), mechanics(name, backend=b, passes=passes, overlap=0.02))
        for b in ("compiled", "torch")
    ]
    with pytest.warns(RuntimeWarning, match="overlap"):
        fast, plain = (s.bind(cells=crowd(name, 7), dtype=F64) for s in scenes)
    state, reports = fast.start(), []
    for _ in range(4):
        one, other = fast.step(state, 0.025), plain.step(state, 0.025)
        reports.append(compare(one, other, 1e-11 / SETS[name][2]))
        state = one
    taken = torch.stack([r.passes for r in reports])
    assert int(taken.max()) == 1 if passes == 1 else int(taken.max()) > 2
    if passes == 1 and "soft" not in name:
        assert int(torch.stack([r.deeply_overlapping for r in reports]).max()) > 5


def test_cells_that_do_not_grow_keep_their_length():
    """Without growth a length is no degree of freedom, in either path."""
    for backend in ("compiled", "torch"):
        cells = replace_length(crowd("in the plane", 3))
        scene = tf.Scene(mechanics("in the plane", backend=backend), founders=cells)
        with pytest.warns(RuntimeWarning, match="overlap"):
            bound = scene.bind(dtype=F64)
        state = bound.start()
        after = bound.step(state, 0.025)
        assert torch.equal(after.length, state.length)
        assert float((after.position - state.position).abs().max()) > 0.1


def replace_length(cells: tf.Cells) -> tf.Cells:
    return tf.Cells(
        cells.position, cells.axis, length=1.0, radius=cells.radius, colony=cells.colony
    )


def simulated(scene: tf.Scene, **options) -> tf.State:
    *_, last = tf.simulate(scene, **{"until": 4.0, "colonies": 8, "seed": 3, **options})
    return last


@pytest.mark.parametrize("dim", [2, 3])
def test_the_number_of_threads_and_the_batch_change_no_bit(dim, monkeypatch):
    """More colonies than threads, of several sizes; each alone, and all in another order."""
    scene = tf.Scene(
        tf.Growth(rate=tf.PerColony(torch.linspace(0.6, 1.4, 8))),
        tf.Division(length=tf.Uniform(2.5, 3.5)),
        tf.Mechanics(dim=dim, contacts="bilateral", passes=3),
        dt=0.05,
    )
    monkeypatch.setattr(compiled, "WORTH_THREADS", 1)
    before, runs = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            runs.append(simulated(scene))
    finally:
        torch.set_num_threads(before)
    assert len(set(runs[0].counts.tolist())) > 3
    for field in FIELDS:
        assert torch.equal(getattr(runs[0], field), getattr(runs[1], field)), field
    state = runs[0]
    bound = scene.bind(state=state)
    after, turned = bound.step(state, 0.05), bound.step(state.select([7, 2, 5]), 0.05)
    for place, colony in enumerate((7, 2, 5)):
        alone = bound.step(state.select([colony]), 0.05)
        for field in FIELDS:
            whole = getattr(after.select([colony]), field)
            assert torch.equal(getattr(alone, field), whole), field
            assert torch.equal(getattr(turned.select([place]), field), whole), field


@pytest.mark.parametrize("name", ["position", "displacement", "drag"])
def test_what_is_no_number_fails_its_colony_alone(name):
    cells = tf.Cells(
        [[0.0, 0.0], [0.0, 0.8], [0.0, 0.0], [0.0, 0.8]],
        [[1.0, 0.0]] * 4,
        2.0,
        colony=[0, 0, 1, 1],
        extra={"drag": [1.0] * 4},
    )
    scene = tf.Scene(tf.Growth(rate=1.0), mechanics("in the plane"), founders=cells)
    bound = scene.bind(dtype=F64)
    state = bound.start()
    wanted = bound.step(state, 0.05)
    assert wanted.reports["mechanics"].status.tolist() == [0, 0]
    value = getattr(state, name).clone() if name == "position" else state.fields[name].clone()
    value[0] = float("nan")
    broken = (
        state.replace(position=value) if name == "position" else state.with_fields(**{name: value})
    )
    after = bound.step(broken, 0.05)
    status = after.reports["mechanics"].status.tolist()
    assert status[0] != 0 and status[1] == 0
    for field in FIELDS:
        whole = getattr(wanted.select([1]), field)
        assert torch.equal(getattr(after.select([1]), field), whole), field


def test_torch_computes_where_gradients_are_required():
    """And the value is that of the kernels."""
    fast = model("in the plane", "compiled", colonies=1)
    state = fast.start()
    for _ in range(60):
        state = fast.step(state, 0.05)
    tracked = state.replace(position=state.position.clone().requires_grad_())
    after = fast.step(tracked, 0.05)
    (slope,) = torch.autograd.grad(after.position.square().sum(), tracked.position)
    assert bool(torch.isfinite(slope).all()) and float(slope.abs().max()) > 0
    compare(after, fast.step(state, 0.05), 1e-9)
