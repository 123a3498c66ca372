"""The layout: the medium of a state, split by colonies, moved, and put on another grid."""

from __future__ import annotations

import gc

import pytest
import torch

import torchfilm as tf
from torchfilm.signals.grid import Grid
from torchfilm.signals.layout import Layout
from torchfilm.tools.checks import InputError

F64 = torch.float64


def grid(device: str | torch.device = "cpu") -> Grid:
    """Three colonies with grids of different size and position."""
    origin = torch.tensor(
        [[0.0, 0.0, 0.0], [-8.0, 4.0, 0.0], [10.0, 0.0, 0.0]], dtype=F64, device=device
    )
    return Grid(
        origin, torch.tensor([[2, 3, 1], [4, 2, 1], [1, 1, 1]], device=device), (2.0, 2.0, 1.0)
    )


def test_what_is_made_ready_belongs_to_one_grid():
    layout = Layout(grid(), obstacle=lambda at: at[:, 0] > 0)
    mask = layout.mask
    assert layout.on(layout.grid) is layout
    other = layout.on(grid())
    assert "mask" not in vars(other) and layout.mask is mask is not other.mask


@pytest.mark.usefixtures("new_objects")
def test_steps_belong_to_one_grid_and_go_with_it():
    """A model makes the step of a signal once for each grid; one that is no longer used takes its
    steps along."""
    medium = tf.Medium(a=tf.Signal(diffusion=5.0), box=((-8.0, -8.0), (8.0, 8.0)), spacing=4.0)
    model = tf.Scene(medium, dim=2).bind()
    carriers = next(e for e in model.effects if e.title == "transport").transport.carriers
    first = model.step(model.start(), 0.1)
    gc.collect()
    made = [list(of_grid.values()) for of_grid in carriers.values()]
    assert len(made) == 1 and len(made[0]) == 1
    model.step(first, 0.1)
    assert list(carriers[first.layout.grid].values()) == made[0]
    second = model.step(model.start(), 0.1)
    gc.collect()
    assert set(carriers) == {first.layout.grid, second.layout.grid}
    assert next(iter(carriers[second.layout.grid].values())) is not made[0][0]
    del second
    gc.collect()
    assert set(carriers) == {first.layout.grid}


@pytest.mark.parametrize("given", [{}, {"method": "series"}, {"splitting": "lie"}])
def test_a_model_takes_steps_of_any_length_on_one_grid(given):
    """What is kept of a step of one length serves none of another."""
    drop = lambda at: (at[:, 0] > 0).double()
    medium = tf.Medium(
        a=tf.Signal(50.0, decay=1.0, initial=drop), box=((-8.0, -8.0), (8.0, 8.0)), spacing=4.0,
        **given,
    )  # fmt: skip
    scene = tf.Scene(medium, dim=2)
    model = scene.bind(dtype=F64)
    start = model.start()
    for dt in (0.1, 0.025, 0.1):
        fresh = scene.bind(dtype=F64)
        alone = fresh.step(fresh.start(), dt).signals["a"]
        assert torch.equal(model.step(start, dt).signals["a"], alone)


def test_a_layout_of_other_colonies_finds_their_voxels(device):
    layout = Layout(grid(device), height=0.5, reservoir={"a": 1.0})
    values = torch.arange(layout.grid.nodes, device=device)
    part, rows = layout.take(torch.tensor([2, 0], device=device))
    assert (
        part.grid.shapes == ((1, 1, 1), (2, 3, 1))
        and part.height == 0.5
        and part.reservoir == {"a": 1.0}
    )
    assert values[rows].tolist() == [14, 0, 1, 2, 3, 4, 5]
    assert torch.equal(part.grid.centres(), layout.grid.centres()[rows])
    every, rows = layout.take(torch.tensor([0, 1, 2], device=device))
    assert torch.equal(rows, values) and every.grid.shapes == layout.grid.shapes


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_a_flow_is_asked_for_at_the_faces_of_each_colony(turn, device):
    """Its components are those of the position, in turn, so that they tell where that is."""
    own = grid(device)
    for batch in own.batches:
        for axis, found in enumerate(Layout(own).on_faces(lambda at: at.roll(turn, 1), batch)):
            k = (axis - turn) % 3
            lines = torch.arange(batch.shape[k] + (k == axis), device=device, dtype=F64)
            lines = (lines + (0.0 if k == axis else 0.5)) * own.step[k]
            for place, colony in enumerate(batch.colonies.tolist()):
                mine, at = found[place].movedim(k, -1), own.origin[colony, k] + lines
                assert torch.equal(mine, at.expand(mine.shape))


def test_a_flow_of_two_components_has_none_along_z():
    flow = lambda at: at.new_tensor([1.0, 2.0]).expand(len(at), 2)
    for batch in grid().batches:
        means = [float(v.mean()) for v in Layout(grid()).on_faces(flow, batch)]
        assert means == [1.0, 2.0, 0.0]


def test_a_layout_moves_to_a_device(device):
    moved = Layout(grid()).to(device)
    assert moved.grid.origin.device.type == device.type and torch.equal(
        moved.grid.shape.cpu(), grid().shape
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_of_a_plane_lie_at_its_height(dim, dtype):
    position = torch.tensor([[1.0, 2.0, 3.0]], dtype=dtype)[:, :dim]
    found = Layout(grid(), height=0.25).position_3d(position)
    assert found.dtype == F64 and found.tolist() == [[1.0, 2.0, 3.0 if dim == 3 else 0.25]]


def test_the_mask_is_asked_for_once_and_without_obstacles_not_at_all():
    asked = []

    def solid(positions):
        asked.append(positions.shape)
        return positions[:, 0] > 0

    assert Layout(grid()).mask is None
    layout = Layout(grid(), obstacle=solid)
    assert layout.mask is layout.mask and asked == [(15, 3)]
    assert (
        layout.mask.tolist() == (layout.grid.centres()[:, 0] <= 0).tolist()
        and 0 < int(layout.mask.sum()) < 15
    )


@pytest.mark.parametrize(
    ("solid", "said"),
    [
        (lambda at: at > 0, r"bool tensor of shape \(15,\)"),
        (lambda at: (at[:, 0] > 0).float(), r"float32.*bool"),
        (lambda at: True, "bool tensor"),
        (lambda at: at[:, 0] < 1e9, "no medium remains"),
    ],
    ids=["shape", "dtype", "no tensor", "everywhere"],
)
def test_a_mask_must_be_one(solid, said):
    with pytest.raises(InputError, match="(?s)obstacles.*" + said):
        _ = Layout(grid(), obstacle=solid).mask


def test_the_stencil_knows_height_mask_and_period(dtype):
    position, colony = (
        torch.tensor([[1.0, 1.0], [-7.0, 5.0], [13.0, 1.0]], dtype=F64),
        torch.tensor([0, 1, 2]),
    )
    inside = Layout(grid(), height=0.5).stencil(position, colony, dtype)
    assert inside.weight.dtype == dtype and inside.outside.tolist() == [False, False, True]
    assert inside.node[:2, 0].tolist() == [0, 6]
    assert Layout(grid(), height=1.5).stencil(position, colony, dtype).outside.tolist() == [
        True,
        True,
        True,
    ]
    assert Layout(grid(), periodic=(True, False, True), height=1.5).stencil(
        position, colony, dtype
    ).outside.tolist() == [False, False, False]
    held = Layout(grid(), height=0.5, obstacle=lambda at: at[:, 0] < -4).stencil(
        position, colony, dtype
    )
    assert held.outside.tolist() == [False, True, True]


def test_a_cell_beyond_the_box_meets_the_reservoir_of_its_own_colony():
    """As the ids of colonies say, and not their places. In an obstacle there is nothing."""
    layout = Layout(
        grid(), periodic=(False, False, True), obstacle=lambda at: at[:, 0] < -4.0,
        reservoir={"a": torch.tensor([1.0, 2.0, 4.0, 8.0])},
    )  # fmt: skip
    position = torch.tensor([[1.0, 1.0], [9.0, 1.0], [-7.0, 5.0], [9.0, 5.0], [50.0, 1.0]])
    colony, ids = torch.tensor([0, 0, 1, 1, 2]), torch.tensor([3, 0, 2])
    values = {"a": torch.full((layout.grid.nodes,), 0.5)}
    found = layout.contact(position.double(), colony, ids, values, torch.float32)
    assert found.found["a"].tolist() == [0.5, 8.0, 0.0, 1.0, 4.0]
    assert found.in_reservoir.tolist() == [False, True, False, True, True]


def test_a_state_on_another_grid_is_not_continued_silently():
    """Its signals would stay on the grid that they were begun on."""

    def scene(spacing=4.0, box=40.0, depth=1.0):
        medium = tf.Medium(
            food=tf.Signal(10.0, initial=1.0), box=((-box, -box), (box, box)), spacing=spacing,
            depth=depth,
        )  # fmt: skip
        return tf.Scene(tf.Monod("food"), tf.Growth(), medium, dim=2)

    state = scene().bind().start()
    for given in ({"spacing": 8.0}, {"box": 80.0}, {"depth": 10.0}):
        words = r"on another grid, of 4 × 4 × 1 µm in the box \[-40\.0, -40\.0, -0\.5\] to \[40\.0"
        with pytest.raises(tf.InputError, match=words):
            list(tf.simulate(scene(**given), state, until=0.1))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (torch.ones(10), r"shape of the field 'out.food' = \(10,\).*\(400,\)"),
        (torch.ones(20, 20), r"shape of the field 'out.food' = \(20, 20\)"),
        (torch.ones(400, dtype=torch.int64), "type of the field 'out.food'"),
        (torch.ones(400, dtype=torch.float64), "type of the field 'out.food'"),
        (torch.full((400,), -1.0), "'out.food', a signal.*0 or more everywhere"),
        (torch.full((400,), torch.nan), "'out.food', a signal.*0 or more everywhere"),
    ],
)
def test_a_signal_that_cannot_be_is_refused(values, words):
    medium = tf.Medium(food=tf.Signal(10.0, initial=1.0), box=((-40, -40), (40, 40)), spacing=4.0)
    scene = tf.Scene(tf.Monod("food"), tf.Growth(), medium, dim=2)
    state = scene.bind().start()
    with pytest.raises(tf.InputError, match=words):
        list(tf.simulate(scene, state.with_fields(**{"out.food": values}), until=0.1))


def test_a_method_that_goes_below_0_may():
    """Crank–Nicolson, as documented; also where its state is gone on with."""
    disc = lambda places: ((places[:, :2].norm(dim=1) < 4.0) * 1.0).float()
    medium = tf.Medium(
        a=tf.Signal(5e4, initial=disc), box=((-16, -16), (16, 16)), spacing=1.0,
        method="crank_nicolson",
    )  # fmt: skip
    scene = tf.Scene(medium, dim=2)
    *_, state = tf.simulate(scene, until=0.02, dt=0.01)
    assert float(state.signals["a"].min()) < 0
    *_, state = tf.simulate(scene, state, until=0.03, dt=0.01)
