"""The ready scenes with signals and circuits: each shows in small what its docstring claims. Their
full size is for the experiments."""

from __future__ import annotations

import pytest
import torch
from helpers import step

import torchfilm as tf
from torchfilm.tools.checks import InputError

F64 = torch.float64


def ran(
    scene: tf.Scene,
    until: float,
    *,
    dt: float = 0.1,
    seed: int = 1,
    colonies: int = 1,
    dtype: torch.dtype = torch.float32,
) -> tf.State:
    return list(
        tf.simulate(scene, scene.bind(colonies, seed=seed, dtype=dtype).start(), until=until, dt=dt)
    )[-1]


def correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(torch.corrcoef(torch.stack([a.double(), b.double()]))[0, 1])


def centre_of(state: tf.State, name: str) -> float:
    """Where along the channel a signal is, µm, in the mean."""
    value = state.signals[name].double()
    return float((state.layout.grid.centres()[:, 0] * value).sum() / value.sum())


# --- boundary detection ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def boundary() -> tf.State:
    """The published constants but for a LuxI thirty times as busy, so that a small colony is
    bright: at 70 cells the published ones lie near the basal rate."""
    return ran(tf.scenes.boundary_detector(k1=30.0), 4.8)


def test_yfp_of_sinks_falls_with_the_distance_from_the_boundary(boundary):
    sinks = boundary.cell_type == 1
    away = boundary.position[:, 0][sinks]
    order = torch.argsort(away)
    yfp = boundary.yfp[sinks][order]
    third = len(order) // 3
    assert third >= 8
    near, middle, far = yfp[:third].mean(), yfp[third : 2 * third].mean(), yfp[2 * third :].mean()
    assert near > 1.2 * middle > 1.2 * far and correlation(away, boundary.yfp[sinks]) < -0.5


def test_each_population_shows_its_own_colour(boundary):
    sinks = boundary.cell_type == 1
    assert (
        float(boundary.cfp[~sinks].min()) > 0
        and float(boundary.luxi[~sinks].min()) > 0
        and float(boundary.aiia[sinks].min()) > 0
    )
    for name, there in (("cfp", sinks), ("luxi", sinks), ("aiia", ~sinks), ("yfp", ~sinks)):
        assert float(boundary.fields[name][there].abs().max()) == 0, name


def test_the_channel_holds_the_colony_and_the_grid_grows_along_it_only(boundary):
    grid = boundary.layout.grid
    assert (
        float(boundary.position[:, 1].abs().max()) < 16
        and grid.shapes[0][1:] == (8, 12)
        and grid.spacing == (4.0, 4.0, 4.0)
    )
    assert tf.scenes.boundary_detector().bind().start().layout.grid.shapes == ((64, 8, 12),)


def test_sinks_without_aiia_take_nothing_apart():
    """d3 = 0: the same cells, more AHL at the end."""
    with_it, without = (
        ran(tf.scenes.boundary_detector(k1=30.0, k5=5.0, **more), 2.5) for more in ({}, {"d3": 0.0})
    )
    assert torch.equal(with_it.uid, without.uid) and float(without.aiia.max()) == 0
    assert float(without.signals["ahl"].sum()) > float(with_it.signals["ahl"].sum())


def test_flow_shifts_the_ahl_downstream():
    still, there, back = (
        centre_of(ran(tf.scenes.boundary_detector(flow=v), 2.0), "ahl") for v in (0.0, 20.0, -20.0)
    )
    assert there > still + 5 and back < still - 5


def test_flow_per_colony():
    last = ran(tf.scenes.boundary_detector(flow=torch.tensor([0.0, 20.0])), 1.0, colonies=2)
    assert centre_of(last.select([1]), "ahl") > centre_of(last.select([0]), "ahl") + 3


# --- quorum sensing -------------------------------------------------------------------------------


def test_luxi_switches_on_with_density():
    """The same eight cells, in a box of 32 µm and in one of 256: where AHL gathers they switch on,
    where it is lost they do not.

    Not with Table 2's constants: with k3 = k4 = 1 and growth of 1/h the feedback cannot hold LuxI
    up at all (see the next test), and where D1 A/V is no faster than growth a cell answers to its
    own AHL. Here the membrane is fast and the threshold √k4 low.
    """
    crowd, lonely = (
        ran(
            tf.scenes.quorum_sensing(
                size=size, spacing=8.0, D1=100.0, k1=100.0, k4=1e-4, diffusion=1000.0
            ),
            3.0,
            seed=1,
        )
        for size in (32.0, 256.0)
    )
    assert torch.equal(crowd.uid, lonely.uid) and crowd.cells >= 8
    # fully on is (d2 + k3)/(g1 + growth) ≈ 0.9; on the way there, in a quarter of the step and 32
    # turns, they have 0.164 or more, and where AHL is lost 0.0044 or less
    assert float(crowd.luxi.min()) > 0.15 > 0.05 > float(lonely.luxi.max())


def test_with_the_published_constants_luxi_stays_low():
    """d2/(g1 + growth) ≈ 9e-4: what is made without AHL."""
    last = ran(tf.scenes.quorum_sensing(spacing=8.0, D1=1.0, k1=1.0, k4=1.0, diffusion=100.0), 4.0)
    assert last.cells >= 16 and 0.5e-3 < float(last.luxi.mean()) < 1.2e-3


def test_cells_and_medium_keep_what_the_synthase_makes():
    """AHL is made at k1 LuxI/(k2 + LuxI) and lost only in the caps of daughters: without division,
    the sum is what was made, to the order of the step."""
    scene = tf.scenes.quorum_sensing(rate=0.3, D1=10.0, k1=1.0, k4=1.0, diffusion=100.0)
    state, made = scene.bind(dtype=F64).start(), 0.0
    for _ in range(20):
        state = step(scene, state, 0.05)
        made += 0.05 * float((state.luxi / (1 + state.luxi) * state.volume).sum())
    total = float(
        (state.ahl * state.volume).sum()
        + state.signals["ahl"].sum() * state.layout.grid.voxel_volume
    )
    # a right-hand sum of 20 terms that grow from 0: half of the last, 2/20, at most
    assert state.cells == 1 and total == pytest.approx(made, rel=0.06)


# --- cells that compute on their own --------------------------------------------------------------


def test_random_partition_keeps_the_amount_and_spreads_the_cells():
    scene = tf.scenes.random_partition(start=2.0)
    state = scene.bind(3, seed=1, dtype=F64).start()
    last = list(tf.simulate(scene, state, until=3.0, dt=0.1))[-1]
    total = torch.zeros(3, dtype=F64).index_add(0, last.colony, last.plasmid * last.volume)
    assert int(last.counts.min()) >= 8 and total.tolist() == pytest.approx(
        (2.0 * state.volume).tolist(), rel=1e-12
    )
    amount = last.plasmid * last.volume
    assert float(amount.std() / amount.mean()) > 0.5


def test_random_partition_gives_every_share_alike():
    """The share of a daughter is uniform: of 600 divisions, mean 1/2 to 5 standard errors of
    √(1/12/600), and each quarter holds a quarter, to 5 of its own."""
    scene = tf.scenes.random_partition()
    state = scene.bind(600, seed=2, dtype=F64, cells=tf.Cells.single(2, length=3.4)).start()
    after = step(scene, state.with_fields(divide_flag=torch.ones(600, dtype=torch.bool)), 1e-3)
    share = (after.plasmid * after.volume)[after.births[-1].first] / (state.plasmid * state.volume)
    assert after.cells == 1200 and float(share.mean()) == pytest.approx(
        0.5, abs=5 * (1 / 12 / 600) ** 0.5
    )
    quarters = torch.histc(share, 4, 0, 1) / 600
    assert float((quarters - 0.25).abs().max()) < 5 * (0.25 * 0.75 / 600) ** 0.5


def test_toggle_cells_end_on_one_side():
    last = ran(
        tf.scenes.toggle_switch(speed=4.0, start=2.0, molecules_per_unit=4.0), 3.0, colonies=4
    )
    red = last.red / (last.red + last.green)
    assert float(((red < 0.2) | (red > 0.8)).double().mean()) > 0.9
    assert 0 < int((red > 0.8).sum()) < last.cells  # both sides are there
    assert last.cells >= 16


def test_toggle_without_noise_stays_on_its_saddle():
    last = ran(tf.scenes.toggle_switch(noise=False, speed=4.0, start=2.0), 1.5)
    # 10/(1 + x²) = x (1 + 0.7/4); at a step of 0.1 h
    assert torch.equal(last.red, last.green) and float(last.red.mean()) == pytest.approx(
        1.88, rel=0.04
    )


def test_repressilator_goes_round():
    """In one cell that hardly grows: three genes in turn, a period of the model's 8.69/speed for β
    = 5."""
    scene = tf.scenes.repressilator(noise=False, rate=0.0, speed=3.0, beta=5.0)
    state = scene.bind(dtype=F64).start()
    tracks = []
    for _ in range(130):
        state = step(scene, state, 0.1)
        tracks.append([float(state.fields[n]) for n in ("laci", "tetr", "ci")])
    track = torch.tensor(tracks, dtype=F64)[20:]
    rising = [[k for k in range(1, 110) if track[k - 1, g] < 30 <= track[k, g]] for g in range(3)]
    periods = torch.tensor(rising[0], dtype=F64).diff() * 0.1
    # told to steps of 0.1 h, over two turns or more
    assert periods.numel() >= 2 and float(periods.mean()) == pytest.approx(8.6893 / 3.0, rel=0.03)
    first = rising[0][0]
    after = [next(k for k in rising[g] if k > first) for g in (1, 2)]
    assert first < min(after) < max(after) < rising[0][1]


def test_repressilator_molecule_by_molecule_has_whole_numbers():
    last = ran(tf.scenes.repressilator(molecules_per_unit=2.0), 0.5, dtype=F64)
    n = last.laci * last.volume * 2.0
    assert float((n - n.round()).abs().max()) < 1e-9 and float(n.sum()) > 0


# --- nutrients ------------------------------------------------------------------------------------


def test_only_a_rim_grows_where_food_is_short():
    cells = tf.Cells(
        [[2.9 * (k % 9 - 4), 1.05 * (k // 9 - 12)] for k in range(225)],
        [[1.0, 0.0]] * 225,
        length=1.8,
    )
    scene = tf.scenes.nutrient_limited(
        supply=0.3, diffusion=3.0, half=0.3, growth_yield=0.2, size=80.0
    )
    state = scene.bind(cells=cells, dtype=F64).start()
    for _ in range(8):
        state = step(scene, state, 0.1)
    away = state.position.norm(dim=1)
    rim, centre = (
        state.growth_rate[away > 0.9 * away.max()],
        state.growth_rate[away < 0.3 * away.max()],
    )
    assert (
        rim.numel() >= 3
        and centre.numel() >= 3
        and float(rim.mean()) > 2 * float(centre.mean()) > 0
    )
    assert correlation(away, state.growth_rate) > 0.6  # the colony is square


def test_what_is_eaten_times_the_yield_is_what_is_grown():
    """While nothing holds growth back: one cell, then none touching for long. Without division, to
    rounding."""
    scene = tf.scenes.nutrient_limited(growth_yield=0.5, size=80.0)
    state = scene.bind(dtype=F64).start()
    last = list(tf.simulate(scene, state, until=0.3, dt=0.05))[-1]
    assert last.cells == 1
    assert float(last.volume - state.volume) == pytest.approx(
        0.5 * float(last.nutrient_eaten), rel=1e-12
    )


@pytest.mark.parametrize(
    "name",
    [
        "quorum_sensing",
        "boundary_detector",
        "synchronized_lysis",
        "random_partition",
        "repressilator",
        "toggle_switch",
        "nutrient_limited",
        "biofilm",
    ],
)
def test_every_scene_explains_itself_and_refuses_nonsense(name):
    make = getattr(tf.scenes, name)
    said = make().bind().describe()
    assert "who drives whom" in said and ("circuit" in said or "nutrition" in said)
    with pytest.raises((InputError, TypeError)):
        make(rate=-1.0).bind().start()
