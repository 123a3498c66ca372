"""Medium: what cells and grid hold together, and cells beyond the box. The transport itself is
tested with its kernels."""

from __future__ import annotations

import math

import pytest
import torch
from exchanging_cells import BOX, F64, advance, exchanging, resting, totals
from helpers import step

import torchfilm as tf
from torchfilm.tools.checks import SimulationError

# --- what there is, stays -------------------------------------------------------------------------


@pytest.mark.parametrize("outside", ["error", "grow", "reservoir"])
def test_amounts_are_conserved_through_growth_division_and_exchange(outside, dtype, device):
    """Cells, medium and reservoir together. Every step rounds each of some ten sums once: relative,
    40 steps × 10 × eps / 2."""
    half = 16.0 if outside == "error" else 4.0  # where the box may be left, it is
    scene = tf.Scene(
        tf.Growth(rate=1.5),
        tf.Division(length=tf.Uniform(3.0, 3.4)),
        tf.Mechanics(dim=2),
        exchanging(daughters="amount"),
        tf.Medium(
            ahl=tf.Signal(
                diffusion=20.0, initial=0.5, reservoir=0.7 if outside == "reservoir" else 0.0
            ),
            box=((-half, -half), (half, half)),
            spacing=2.0,
            outside=outside,
        ),
    )
    state = scene.bind(2, seed=3, dtype=dtype, device=device).start()
    first, nodes = totals(state), state.layout.grid.nodes
    if outside == "grow":  # new room comes with what it holds at first
        first = first - 0.5 * state.layout.grid.counts * state.layout.grid.voxel_volume
    state = advance(scene, state, 44, 0.05)
    last = totals(state)
    if outside == "grow":
        assert state.layout.grid.nodes > nodes
        last = last - 0.5 * state.layout.grid.counts * state.layout.grid.voxel_volume
    if outside == "reservoir":
        assert bool((state.fields["ahl_reservoir"] != 0).all())
    assert int(state.counts.min()) >= 8
    bound = 44 * 5 * torch.finfo(dtype).eps
    # with the start of new room taken off, what is compared is smaller than what was rounded
    assert float(((last - first).abs() / totals(state)).max()) <= bound
    assert float(state.signals["ahl"].min()) >= 0 and float(state.fields["ahl"].min()) >= 0


@pytest.mark.parametrize("method", ["rosenbrock", "rk4", "euler"])
def test_exchange_conserves_whatever_integrates_it(method):
    scene = resting(
        tf.Medium(ahl=tf.Signal(diffusion=20.0), box=BOX, spacing=4.0),
        exchanging(method=method, steps=4),
    )
    state = scene.bind(dtype=F64).start()
    assert float(totals(advance(scene, state, 20, 0.01))) == pytest.approx(
        float(totals(state)), rel=1e-13
    )


@pytest.mark.parametrize("count", [1, 3])
def test_one_voxel_relaxes_at_the_rate_of_its_membranes(count):
    """d/dt (ci − ce) = −D1 A (1/V + 1/Vg) (ci − ce) for one cell in one voxel. With three alike,
    each has a third of it: 1/V + 3/Vg.

    The integrator is asked for 1e-8 of 3 a step, 20 steps: 6e-7 in all where errors add up.
    """
    cells = tf.Cells([[0.0, 2.0 * k - 2.0] for k in range(count)], [[1.0, 0.0]] * count)
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=10.0, initial=0.5),
        box=((-4.0, -4.0), (4.0, 4.0)),
        spacing=8.0,
        depth=1.0,
        exchange="turns",
    )
    scene = resting(medium, exchanging(D1=2.0, rtol=1e-8, atol=1e-12), cells)
    state = scene.bind(dtype=F64).start()
    volume, area, room = float(state.volume[0]), float(state.area[0]), 64.0 / count
    rate = 2.0 * area * (1 / volume + 1 / room)
    for k in range(1, 21):
        state = step(scene, state, 0.01)
        gap = float(state.fields["ahl"][0] - state.signals["ahl"][0])
        assert gap == pytest.approx(2.5 * math.exp(-rate * 0.01 * k), abs=1e-6)
    state = advance(scene, state, 10, 0.5)
    balance = (volume * 3.0 + room * 0.5) / (volume + room)
    assert float(state.signals["ahl"]) == pytest.approx(balance, rel=1e-8)
    assert state.fields["ahl"].tolist() == pytest.approx([balance] * count, rel=1e-8)


@pytest.mark.parametrize("start", [0.0, 5.0])
def test_a_stiff_membrane_leaves_nothing_negative(start, dtype, device):
    """D1 = 1e6 µm/h: a step is 4e5 relaxation times, either way through the membrane.

    The solve magnifies the rounding of rates by rate × step, so what is lost is at most eps × 4e5
    of what is exchanged, 0.0075 of the whole; of float32 rates that alone could be all, and the
    integrator's error control must keep it to its tolerance of 1e-4 a step, five times.
    """
    cells = tf.Cells([[0.3 * k, 1.1 * k - 3.0] for k in range(6)], [[1.0, 0.2]] * 6)
    scene = resting(
        tf.Medium(ahl=tf.Signal(diffusion=5.0, initial=2.0), box=BOX, spacing=4.0),
        exchanging(start, D1=1e6),
        cells,
    )
    state = scene.bind(dtype=dtype, device=device).start()
    first = float(totals(state))
    for _ in range(5):
        state = advance(scene, state, 1, 0.1)
        assert float(state.fields["ahl"].min()) >= 0 and float(state.signals["ahl"].min()) >= 0
    assert float(totals(state)) == pytest.approx(
        first, rel=1e-12 if dtype == F64 else 5e-4 * 0.0075 * 5
    )


def uptake(u, s, p, cell):
    """Hard case 39: a cell empties its surroundings at k = 1e5/h, and keeps what it gets."""
    taken = p.k * s.ahl * cell.volume
    return {"ahl": taken / cell.volume}, {"ahl": -taken}


def test_uptake_a_thousand_times_faster_than_the_step(dtype, device):
    """Hard case 39 through a circuit: k·dt = 1e3, u ≥ 0, gain = loss to 1e-6 relative, crowded
    voxels and lonely ones."""
    cells = tf.Cells(
        [[1.3 * (k % 4) - 2.0, 1.2 * (k // 4) - 2.0] for k in range(16)],
        [[0.0, 1.0]] * 16,
        length=0.1,
    )
    circuit = tf.Circuit(uptake, species=("ahl",), k=1e4)
    scene = resting(
        tf.Medium(ahl=tf.Signal(diffusion=1.0, initial=1.0), box=BOX, spacing=4.0), circuit, cells
    )
    state = scene.bind(dtype=dtype, device=device).start()
    first = float(totals(state))
    for _ in range(3):
        state = advance(scene, state, 1, 0.1)
        assert float(state.signals["ahl"].min()) >= 0
        gain = float((state.fields["ahl"].double() * state.volume.double()).sum())
        loss = first - float(totals(state, inside=False))
        assert gain > 200
        # in float32 the grid itself is rounded by 6e-8 of all that it holds
        assert abs(gain - loss) <= (1e-12 * gain if dtype == F64 else 1e-6 * first)


# --- cells beyond the box: hard case 38 -----------------------------------------------------------

FAR = [pytest.param(4e-3, id="a thousandth of a voxel"), pytest.param(40.0, id="ten voxels")]


def strayed(scene: tf.Scene, away: float) -> tf.State:
    """Three colonies of two cells, of which one of colony 1 is `away` µm beyond the box."""
    cells = tf.Cells([[0.0, 0.0], [0.0, 3.0]], [[1.0, 0.0]] * 2)
    state = scene.bind(3, cells=cells, dtype=F64).start()
    position = state.position.clone()
    position[3] = torch.tensor([16.0 + away, 1.0], dtype=F64)
    return state.replace(position=position)


@pytest.mark.parametrize("away", FAR)
def test_a_cell_beyond_the_box_is_an_error_that_names_it(away):
    scene = resting(tf.Medium(ahl=tf.Signal(diffusion=5.0), box=BOX, spacing=4.0))
    with pytest.raises(
        SimulationError,
        match=r"(?s)1 of 3 colonies.*colony 1 \(2 cells\): 1 cell.*beyond the box.*\("
        + f"{16 + away:.4g}",
    ) as failed:
        list(tf.simulate(scene, strayed(scene, away), until=0.1, dt=0.1))
    assert failed.value.colonies == (1,)
    assert "grow" in str(failed.value)


@pytest.mark.parametrize("away", FAR)
def test_drop_goes_on_without_the_colony_that_strayed(away):
    scene = resting(tf.Medium(ahl=tf.Signal(diffusion=5.0), box=BOX, spacing=4.0))
    good = strayed(scene, -1.0)
    states = [
        list(tf.simulate(scene, s, until=0.5, dt=0.1, on_failure="drop"))[-1]
        for s in (strayed(scene, away), good)
    ]
    assert states[0].counts.tolist() == [2, 0, 2]
    for name in ("ahl", "out.ahl"):
        found, wanted = (s.select([0, 2]).fields[name] for s in states)
        assert torch.equal(found, wanted), name


@pytest.mark.parametrize("away", FAR)
def test_the_grid_grows_to_the_cell_that_strays(away):
    scene = resting(tf.Medium(ahl=tf.Signal(diffusion=5.0), box=BOX, spacing=4.0, outside="grow"))
    state = strayed(scene, away)
    first, grown = totals(state), step(scene, state, 0.1)
    grid = grown.layout.grid
    assert float(grid.high[1, 0]) >= 16 + away + 4.0 and grid.shapes[0] == grid.shapes[2] == (
        8,
        8,
        1,
    )
    assert torch.equal(grid.origin[1], state.layout.grid.origin[1])
    assert torch.allclose(totals(grown), first, rtol=1e-14, atol=0)


@pytest.mark.parametrize("away", FAR)
def test_an_open_box_keeps_count(away):
    """Outside, the cell meets the reservoir's 0.25 and nothing else: its exchange over one step is
    known exactly."""
    scene = resting(
        tf.Medium(
            ahl=tf.Signal(diffusion=5.0, reservoir=0.25), box=BOX, spacing=4.0, outside="reservoir"
        ),
        exchanging(3.0, rtol=1e-8),
    )
    state = strayed(scene, away)
    after = step(scene, state, 0.1)
    left = 0.25 + 2.75 * math.exp(-float(state.area[3] / state.volume[3]) * 0.1)
    assert float(after.fields["ahl"][3]) == pytest.approx(left, rel=1e-6)
    beyond = after.fields["ahl_reservoir"]
    assert beyond[0] == beyond[2] == 0 and float(beyond[1]) == pytest.approx(
        float(state.volume[3]) * (3.0 - left), rel=1e-6
    )
    assert torch.allclose(totals(after), totals(state), rtol=1e-14, atol=0)


def test_an_open_box_gives_too():
    """A cell with less than the reservoir takes from it: the count goes below 0."""
    scene = resting(
        tf.Medium(
            ahl=tf.Signal(diffusion=5.0, reservoir=[1.0, 2.0, 4.0]),
            box=BOX,
            spacing=4.0,
            outside="reservoir",
        ),
        exchanging(0.0),
    )
    state = advance(scene, strayed(scene, 4.0), 50, 0.1)
    # colony 1's own reservoir; rtol is 1e-4
    assert float(state.fields["ahl"][3]) == pytest.approx(2.0, rel=1e-3)
    assert float(state.fields["ahl_reservoir"][1]) == pytest.approx(
        -2.0 * float(state.volume[3]), rel=1e-3
    )
    assert torch.allclose(totals(state), torch.zeros(3, dtype=F64), atol=1e-12)


def test_a_state_is_in_the_space_of_the_scene_that_steps_it():
    """The reservoir and the obstacles are the scene's, as constants of circuits are, and not those
    with which another scene has laid the grid."""

    def space(reservoir, wall):
        medium = tf.Medium(
            ahl=tf.Signal(diffusion=5.0, reservoir=reservoir),
            box=BOX,
            spacing=4.0,
            outside="reservoir",
            obstacles=lambda at: at[:, 1] > wall,
        )
        return resting(medium, exchanging(3.0))

    one, other = space(0.25, 12.0), space([1.0, 2.0, 4.0], 6.0)
    state = strayed(one, 4.0)
    layout = strayed(other, 4.0).layout
    wanted = step(other, state.replace(layout=layout), 0.1)
    assert not torch.equal(step(one, state, 0.1).ahl, wanted.ahl)
    *_, found = tf.simulate(other, state, until=0.1, dt=0.1)
    assert torch.equal(found.ahl, wanted.ahl)
    for name in ("out.ahl", "ahl_reservoir"):
        assert torch.equal(found.fields[name], wanted.fields[name]), name
    again = other.bind(state=found).step(found, 0.1)
    assert torch.equal(again.ahl, step(other, wanted, 0.1).ahl)


def test_a_box_that_grows_along_x_only_says_where_else_it_ends():
    scene = resting(
        tf.Medium(ahl=tf.Signal(diffusion=5.0), box=BOX, spacing=4.0, outside="grow", grows="x")
    )
    state = strayed(scene, 40.0)
    assert step(scene, state, 0.1).layout.grid.shapes[1] == (24, 8, 1)
    up = state.replace(position=state.position.flip(1))
    with pytest.raises(SimulationError, match=r"colony 1.*beyond the box"):
        list(tf.simulate(scene, up, until=0.1, dt=0.1))


def test_a_margin_counts_only_along_the_axes_that_grow():
    """It makes 150,000 voxels of an axis: one such axis is allowed, and two are not."""
    given = {"ahl": tf.Signal(5.0), "box": BOX, "spacing": 4.0, "outside": "grow", "margin": 3e5}
    tf.Medium(grows="y", **given)
    with pytest.raises(tf.InputError, match=r"Medium\.margin = 300000\.0.*at most 67 million"):
        tf.Medium(grows="xy", **given)


def test_a_cell_inside_an_obstacle_is_beyond_the_medium():
    scene = resting(
        tf.Medium(
            ahl=tf.Signal(diffusion=5.0), box=BOX, spacing=4.0, obstacles=lambda at: at[:, 0] > 8.0
        )
    )
    state = strayed(scene, -2.0)
    with pytest.raises(SimulationError, match=r"colony 1.*obstacle") as failed:
        list(tf.simulate(scene, state, until=0.1, dt=0.1))
    assert failed.value.colonies == (1,)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"ahl": tf.Signal(5.0, reservoir=1.0)}, "reservoir of the signal 'ahl' does nothing"),
        ({"ahl": tf.Signal(5.0), "grows": "x"}, r"grows='x'\) does nothing.*outside='grow'"),
        (
            {"ahl": tf.Signal(5.0, boundary=tf.BoundaryConditions(x=tf.Open(2.0)))},
            r"Open\(outside=…\) of the signal 'ahl' does nothing.*Dirichlet",
        ),
    ],
)
def test_what_nothing_reads_is_warned_of(given, words):
    with pytest.warns(UserWarning, match=words):
        tf.Medium(box=BOX, spacing=4.0, **given)


def test_a_diffusion_in_other_units_is_warned_of():
    with pytest.warns(UserWarning, match=r"'ahl' diffuses at 2e-09 µm²/h.*m²/s"):
        tf.Medium(ahl=tf.Signal(2e-9), box=BOX, spacing=4.0)


def test_texts_are_no_box():
    with pytest.raises(tf.InputError, match=r"Medium\.box = .*two corners"):
        tf.Medium(ahl=tf.Signal(1.0), box=(("-8", "-8"), ("8", "8")), spacing=4.0)
    with pytest.raises(tf.InputError, match=r"Medium\.spacing = .*numbers"):
        tf.Medium(ahl=tf.Signal(1.0), box=BOX, spacing=("4", "4"))
