"""Faces of a medium: those that nobody names, in a flow, and those that stay where a box grows."""

from __future__ import annotations

import warnings

import pytest
import torch

import torchfilm as tf

BOX = [[-16.0, -16.0, 0.0], [16.0, 16.0, 40.0]]
FOOD = {"food": tf.Signal(diffusion=1e3, initial=1.0), "spacing": 4.0}


def still(medium: tf.Medium, **given) -> tf.Scene:
    cells = tf.Cells([[0.0, 0.0, 4.0]], [[1.0, 0.0, 0.0]])
    return tf.Scene(tf.Growth(rate=0.0), medium, founders=cells, **({"dim": 3} | given))


@pytest.mark.parametrize("where", ["medium", "signal"])
def test_in_a_flow_the_faces_that_nobody_names_are_open(where):
    """A flow along x, and faces along z alone: what comes in is the medium outside, which is
    empty, and what goes out is what was inside."""
    faces = tf.BoundaryConditions(z=(tf.NoFlux(), tf.NoFlux()))
    given = {"boundary": faces} if where == "medium" else {}
    food = tf.Signal(0.0, initial=1.0, boundary=None if given else faces)
    medium = tf.Medium(food=food, box=BOX, spacing=4.0, flow=(32.0, 0.0, 0.0), **given)
    *_, state = tf.simulate(still(medium), until=0.5, dt=0.05)
    assert float(state.signals["food"].max()) <= 1.0 + 1e-5
    assert float(state.signals["food"].mean()) == pytest.approx(0.5, abs=0.05)
    closed = tf.BoundaryConditions(x=tf.NoFlux(), z=(tf.NoFlux(), tf.NoFlux()))
    medium = tf.Medium(food=tf.Signal(0.0, initial=1.0), box=BOX, spacing=4.0,
                       flow=(32.0, 0.0, 0.0), boundary=closed)  # fmt: skip
    *_, state = tf.simulate(still(medium), until=0.5, dt=0.05)
    assert float(state.signals["food"].mean()) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("axis", "xyz")
def test_faces_are_open_along_any_axis_of_a_flow(axis):
    """In half an hour half of what was there has left, and nothing came in."""
    other = tf.BoundaryConditions(**{{"x": "y", "y": "z", "z": "x"}[axis]: tf.NoFlux()})
    medium = tf.Medium(
        food=tf.Signal(0.0, initial=1.0), box=[[-16.0] * 3, [16.0] * 3], spacing=4.0,
        flow=[32.0 if a == axis else 0.0 for a in "xyz"], boundary=other,
    )  # fmt: skip
    *_, state = tf.simulate(still(medium), until=0.5, dt=0.1)
    assert float(state.signals["food"].mean()) == pytest.approx(0.5, abs=0.05)


VALUES = [1.0, 2.0, 4.0]


@pytest.mark.parametrize(
    "face",
    [
        tf.Dirichlet(VALUES), tf.Robin(VALUES, 50.0), tf.Robin(1.0, [10.0, 50.0, 200.0]),
        tf.Flux(VALUES), tf.Open(VALUES), tf.Dirichlet(tf.Schedule({0: tf.PerColony(VALUES)})),
    ],
    ids=lambda face: type(face).__name__,
)  # fmt: skip
def test_colonies_keep_their_own_faces_where_others_are_left_out(face):
    """What enters is that of the colony's id, and not of its place in the batch."""
    faces = tf.BoundaryConditions(x=(face, tf.NoFlux()))
    flow = (20.0, 0.0) if isinstance(face, tf.Open) else None
    medium = tf.Medium(
        food=tf.Signal(100.0), box=((-16, -8), (16, 8)), spacing=4.0, flow=flow, boundary=faces
    )
    model = tf.Scene(medium, dim=2).bind(3, dtype=torch.float64)
    levels = lambda state: model.step(state, 0.1).signals["food"].reshape(state.colonies, -1)
    start = model.start()
    whole, part = levels(start), levels(start.select([2, 0]))
    assert torch.equal(part, whole[[2, 0]])
    assert bool((whole.sum(1).diff() > 0.1).all())


def test_without_a_flow_they_are_closed():
    """And the description of the scene is that of all faces said."""
    some = tf.Medium(**FOOD, box=BOX, boundary=tf.BoundaryConditions(z=tf.Dirichlet(1.0)))
    every = tf.BoundaryConditions(tf.NoFlux(), tf.NoFlux(), tf.Dirichlet(1.0))
    said = tf.Medium(**FOOD, box=BOX, boundary=every)
    assert some.boundary_of("food") == every and still(some).listing() == still(said).listing()


@pytest.mark.parametrize(
    ("grows", "low", "high"),
    [
        ("xyz", [-1, -1, -1], [1, 1, 1]),
        ("xy+z", [-1, -1, 0], [1, 1, 1]),
        ("-x", [-1, 0, 0], [0, 0, 0]),
        ("+x-xz", [-1, 0, -1], [1, 0, 1]),
    ],
)
def test_faces_that_are_not_named_stay(grows, low, high):
    """Cells near all six faces; the box grows by blocks of 32 µm where it may."""
    box = [[-16.0] * 3, [16.0] * 3]
    ends = torch.eye(3, dtype=torch.float64) * 15.0
    cells = tf.Cells(torch.cat([ends, -ends]), [[1.0, 0.0, 0.0]] * 6, 0.5)
    medium = tf.Medium(**FOOD, box=box, outside="grow", grows=grows)
    *_, state = tf.simulate(tf.Scene(tf.Growth(rate=0.0), medium, founders=cells, dim=3), until=0.1)
    grid = state.layout.grid
    assert grid.origin[0].tolist() == [-16.0 + 32.0 * x for x in low]
    assert grid.high[0].tolist() == [16.0 + 32.0 * x for x in high]


@pytest.mark.parametrize(
    ("walls", "given", "words"),
    [
        ([tf.Plane(z=0.0, facing="+z")], {}, r"at z = 0 µm.*grows='xy\+z'"),
        ([tf.Plane(z=0.0, facing="+z")], {"grows": "xyz"}, r"grows='xy\+z'"),
        ([tf.Plane(z=1.0, facing="+z"), tf.Plane(x=16.0, facing="-x")], {}, r"grows='-xy\+z'"),
        ([tf.Plane(z=0.0, facing="+z")], {"grows": "xy+z"}, None),
        ([tf.Plane(z=0.0, facing="+z")], {"outside": "error"}, None),
        ([tf.Plane(z=-20.0, facing="+z")], {}, r"at z = -20 µm.*grows='xy\+z'"),
        ([tf.Plane(z=-40.0, facing="+z")], {}, None),
        ([tf.Plane(z=20.0, facing="-z")], {}, None),
        ([tf.Plane(z=41.0, facing="-z")], {"grows": "+z"}, "outside='error'"),
    ],
)
def test_a_box_that_grows_through_a_wall_is_warned_of(walls, given, words):
    medium = tf.Medium(**FOOD, box=BOX, **({"outside": "grow"} | given))
    scene = tf.Scene(
        tf.Growth(rate=0.0), tf.Mechanics(dim=3, walls=walls), medium,
        founders=tf.Cells([[0.0, 0.0, 4.0]], [[1.0, 0.0, 0.0]]),
    )  # fmt: skip
    if words is None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            scene.bind()
        return
    with pytest.warns(UserWarning, match="grows through the wall.*" + words):
        scene.bind()


@pytest.mark.parametrize("grows", ["", "xy+", "w", "z-", 3])
def test_faces_that_there_are_not_are_refused(grows):
    with pytest.raises(tf.InputError, match=r"Medium\.grows = .*such as \"xy\+z\""):
        tf.Medium(**FOOD, box=BOX, outside="grow", grows=grows)


@pytest.mark.parametrize(
    ("face", "warns"),
    [
        (tf.Dirichlet(1.0), True),
        (tf.Robin(tf.Schedule({0: 0.0, 2: 1.0}), transfer=0.5), True),
        (tf.Open(outside=[0.0, 2.0]), True),
        (tf.Dirichlet(0.0), False),
        (tf.NoFlux(), False),
    ],
)
def test_a_value_at_a_face_for_several_signals_is_warned_of(face, warns):
    """A film fed through its upper face: an inducer that cells make would be fed there, too."""
    faces = tf.BoundaryConditions(y=(tf.NoFlux(), face))
    made = lambda **more: tf.Medium(
        food=tf.Signal(1e3), ahl=tf.Signal(1e3, **more), box=((0, 0), (8, 8)), spacing=4.0,
        boundary=faces,
    )  # fmt: skip
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        made()
        made(boundary=tf.BoundaryConditions())
    own = [str(x.message) for x in said if "Medium.boundary has one value" in str(x.message)]
    assert len(own) == warns
    if warns:
        assert f"{type(face).__name__} along y" in own[0] and "food and ahl" in own[0]


@pytest.mark.parametrize(
    ("outside", "reservoir", "value", "warns"),
    [
        ("reservoir", 0.0, 1.0, True),
        ("reservoir", 1.0, 1.0, False),
        ("reservoir", tf.Schedule({0: 0.0, 2: 1.0}), 1.0, False),
        ("reservoir", 0.0, 0.0, False),
        ("error", 0.0, 1.0, False),
    ],
)
def test_an_empty_reservoir_behind_a_face_that_supplies_is_warned_of(
    outside, reservoir, value, warns
):
    """Cells half a micrometre beyond a fed face would starve."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        tf.Medium(
            food=tf.Signal(1e3, reservoir=reservoir), box=((0, 0), (8, 8)), spacing=4.0,
            boundary=tf.BoundaryConditions(y=tf.Dirichlet(value)), outside=outside,
        )  # fmt: skip
    assert len([x for x in said if "find a reservoir without it" in str(x.message)]) == warns
