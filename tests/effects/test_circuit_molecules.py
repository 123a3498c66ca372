"""Circuit, molecule by molecule: whole numbers through growth and division, binomial partition,
dilution, exchange of single molecules, failures."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import step
from ruled import same

import torchfilm as tf
from torchfilm.circuits.partition import binomial
from torchfilm.tools.checks import InputError, SimulationError

F64 = torch.float64
METHODS = ["tau_leap", "direct"]
BIRTH_DEATH = [tf.parts.constitutive("m", "make"), tf.parts.degradation("m", "lose")]
INERT = [tf.Reaction.of("m -> w", rate=0.0)]


def molecules(state: tf.State, name: str = "m", molecules_per_unit: float = 1.0) -> torch.Tensor:
    return state.fields[name].double() * state.volume.double() * molecules_per_unit


def assert_whole(state: tf.State, name: str = "m", molecules_per_unit: float = 1.0) -> None:
    """A concentration is a number of molecules over a volume, each rounded once: eps of the
    number."""
    n = molecules(state, name, molecules_per_unit)
    assert (
        float(((n - n.round()).abs() / n.clamp(min=1.0)).max()) <= 4 * torch.finfo(state.dtype).eps
    )


def advance(scene: tf.Scene, state: tf.State, steps: int, dt: float = 0.1) -> tf.State:
    for _ in range(steps):
        state = step(scene, state, dt)
        assert all(bool((r.status == 0).all()) for r in state.reports.values())
    return state


def side_by_side(count: int, **given) -> tf.Cells:
    return tf.Cells([[0.0, 2.0 * k] for k in range(count)], [[1.0, 0.0]] * count, **given)


# --- whole numbers --------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_numbers_stay_whole_through_growth_and_division(method, dtype, device):
    scene = tf.Scene(
        tf.Growth(rate=1.5),
        tf.Division(length=tf.Uniform(3.0, 3.4)),
        tf.Mechanics(dim=2),
        tf.Circuit(
            BIRTH_DEATH,
            species=("m",),
            initial={"m": 3.0},
            method=method,
            molecules_per_unit=2.5,
            make=8.0,
            lose=1.0,
        ),
    )
    state = scene.bind(2, dtype=dtype, device=device).start()
    for _ in range(20):
        assert_whole(state, molecules_per_unit=2.5)
        state = advance(scene, state, 1)
    assert int(state.counts.min()) >= 4 and torch.unique(state.m).numel() > 4


def test_first_numbers_are_whole_and_right_in_the_mean():
    """2.3 molecules for each cell: 2 or 3 of them, 3 with probability 0.3; 4,000 cells, 5 standard
    errors."""
    cells = side_by_side(4000)
    volume = math.pi * 0.25 * (2 + 2 / 3)
    scene = tf.Scene(
        tf.Circuit(INERT, species=("m", "w"), initial={"m": 2.3 / volume}, method="tau_leap"),
        founders=cells,
    )
    n = molecules(scene.bind(dtype=F64).start()).round()
    assert set(n.tolist()) == {2.0, 3.0}
    assert float(n.mean()) == pytest.approx(2.3, abs=5 * math.sqrt(0.21 / 4000))


@pytest.mark.parametrize("molecules_per_unit", [1.0, [0.5, 4.0]])
def test_copies_make_molecules_of_concentrations(molecules_per_unit):
    scene = tf.Scene(
        tf.Circuit(
            INERT,
            species=("m", "w"),
            initial={"m": 10.0},
            method="direct",
            molecules_per_unit=molecules_per_unit,
        ),
        founders=side_by_side(50),
    )
    state = advance(scene, scene.bind(2).start(), 1)
    for k, each in enumerate((1.0, 1.0) if molecules_per_unit == 1.0 else molecules_per_unit):
        one = state.select([k])
        assert_whole(one, molecules_per_unit=each)
        assert float(molecules(one, molecules_per_unit=each).mean()) == pytest.approx(
            10 * each * math.pi * 0.25 * (2 + 2 / 3), rel=0.03
        )


# --- partition ------------------------------------------------------------------------------------


def divided(
    fraction: float = 0.5, count: int = 4000, start: float = 20.0, seed: int = 0
) -> tuple[tf.State, tf.State]:
    """Before and after one division of all cells."""
    volume = math.pi * 0.25 * (4 + 2 / 3)
    circuit = tf.Circuit(
        INERT, species=("m", "w"), initial={"m": start / volume, "w": 5 / volume}, method="tau_leap"
    )
    scene = tf.Scene(
        tf.Division(fraction=fraction), circuit, founders=side_by_side(count, length=4.0)
    )
    state = scene.bind(seed=seed, dtype=F64).start()
    return state, step(
        scene, state.with_fields(divide_flag=torch.ones(count, dtype=torch.bool)), 0.1
    )


@pytest.mark.parametrize("fraction", [0.5, 0.3])
def test_partition_is_binomial(fraction):
    """n molecules, each to the first daughter with the share p of the volume: mean n p, variance n
    p (1 − p). 4,000 divisions of 20; 5 standard errors."""
    before, after = divided(fraction)
    births = after.births[-1]
    n, first, second = (
        molecules(before).round(),
        molecules(after)[births.first],
        molecules(after)[births.second],
    )
    assert (
        float((first + second - n).abs().max()) <= 1e-12 * 20
        and float((first - first.round()).abs().max()) <= 1e-12 * 20
    )
    volume = after.volume[births.first] / (after.volume[births.first] + after.volume[births.second])
    p = float(volume[0])
    assert n.tolist() == [20.0] * 4000 and (p == 0.5) == (fraction == 0.5)
    variance = 20 * p * (1 - p)
    assert float(first.mean()) == pytest.approx(20 * p, abs=5 * math.sqrt(variance / 4000))
    # the variance of a variance: (κ₄ + 2σ⁴)/N, with an excess of a binomial that is below 0
    assert float(first.var()) == pytest.approx(variance, abs=5 * math.sqrt(2 / 4000) * variance)


def test_species_are_shared_out_apart_from_one_another():
    _, after = divided(count=2000)
    births = after.births[-1]
    m, w = (molecules(after, n)[births.first] for n in ("m", "w"))
    correlation = float(torch.corrcoef(torch.stack([m, w]))[0, 1])
    assert abs(correlation) < 5 / math.sqrt(2000)


def test_partition_depends_on_the_seed_and_on_nothing_else():
    one, again, other = (divided(count=50, seed=s)[1].m for s in (1, 1, 2))
    assert torch.equal(one, again) and not torch.equal(one, other)


def test_the_binomial_draw_at_its_edges():
    count, share = (
        torch.tensor([0.0, 7.0, 7.0, 7.0, 1e6]),
        torch.tensor([0.5, 1e-12, 1 - 1e-12, 0.5, 0.5]),
    )
    for u in (2.0**-24, 0.5, 1 - 2.0**-24):
        k = binomial(count, share, torch.full((5,), u))
        assert bool((k == k.round()).all()) and bool((k >= 0).all()) and bool((k <= count).all())
        assert k[:3].tolist() == [0.0, 0.0, 7.0]


# --- laws -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_birth_and_death_under_dilution(method):
    """Made at 40 a µm³ and hour, lost at 1/h and by growth at 1/h: mean concentration 40/(1 + 1) =
    20, and Poisson-like numbers.

    Cells grow from V to 1.27 V in 6 steps of 0.04 h from near equilibrium. Splitting growth from
    reactions is first order: at most 0.04 × 1 of the mean, 4 %.
    """
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Circuit(
            BIRTH_DEATH, species=("m",), initial={"m": 20.0}, method=method, make=40.0, lose=1.0
        ),
        founders=side_by_side(400),
    )
    state = scene.bind(dtype=F64).start()
    last = advance(scene, state, 25, 0.04)
    # 400 cells, sd of a concentration √(20/V) ≈ 2: a standard error of 0.1, of which 4, beside the
    # 4 % of splitting
    assert float(last.m.mean()) == pytest.approx(20.0, abs=0.4 + 0.8)
    assert float(state.m.var()) < 0.2  # at first all alike
    # noise of reactions, of mean 20 in a volume V ≈ 5.7: 20/V = 3.5 in the long run; after an hour
    # at a relaxation of 2/h, 98 % of it
    assert float(last.m.var()) == pytest.approx(20.0 / float(last.volume.mean()), rel=0.5)


def test_noise_and_no_noise_agree_where_molecules_are_many():
    """10⁵ molecules_per_unit: the smooth circuit to within 5 standard deviations of √n in n, and
    the leap's 0.03²."""
    ends = []
    for method, molecules_per_unit in (("tau_leap", 1e5), ("rosenbrock", 1.0)):
        circuit = tf.Circuit(
            BIRTH_DEATH,
            species=("m",),
            initial={"m": 1.0},
            method=method,
            molecules_per_unit=molecules_per_unit,
            make=3.0,
            lose=1.0,
            rtol=1e-6,
        )
        scene = tf.Scene(tf.Growth(rate=0.5), circuit)
        ends.append(float(advance(scene, scene.bind(dtype=F64).start(), 10).m))
    assert ends[0] == pytest.approx(ends[1], rel=5 / math.sqrt(1.7 * 2e5) + 2e-3)


# --- single molecules through the membrane --------------------------------------------------------

BOX = {"box": ((-8.0, -8.0), (8.0, 8.0)), "spacing": 4.0}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("outside", ["error", "reservoir"])
def test_molecules_through_the_membrane_are_conserved(method, outside, dtype):
    """What leaves a cell is in the medium or beyond: 10 steps, each rounding some ten sums."""
    circuit = tf.Circuit(
        [tf.parts.exchange("a", "D1")],
        species=("a",),
        initial={"a": 8.0},
        method=method,
        molecules_per_unit=2.0,
        D1=1.0,
    )
    around = {"reservoir": 1.0} if outside == "reservoir" else {}
    scene = tf.Scene(
        circuit,
        tf.Medium(a=tf.Signal(diffusion=5.0, initial=0.5, **around), outside=outside, **BOX),
        founders=side_by_side(3),
    )
    state = scene.bind(2, dtype=dtype).start()
    if outside == "reservoir":
        position = state.position.clone()
        position[1, 0] = 40.0
        state = state.replace(position=position)

    def total(s: tf.State) -> torch.Tensor:
        here = s.signals["a"].double().reshape(2, -1).sum(1) * s.layout.grid.voxel_volume
        here = here.index_add(0, s.colony, molecules(s, "a"))
        return here + s.fields["a_reservoir"].double() if outside == "reservoir" else here

    last = advance(scene, state, 10)
    assert_whole(last, "a", 2.0)
    assert float(last.signals["a"].min()) >= 0 and not torch.equal(last.a, state.a)
    assert torch.allclose(total(last), total(state), rtol=100 * torch.finfo(dtype).eps, atol=0)
    if outside == "reservoir":
        assert (
            float(last.fields["a_reservoir"][0]) != 0 and float(last.fields["a_reservoir"][1]) == 0
        )


@pytest.mark.parametrize("method", METHODS)
def test_a_reservoir_is_not_emptied_by_the_cells_in_it(method):
    """Cells beyond the box come to the reservoir's 50 molecules/µm³ in one step of ten times V/A
    over 1 µm/h: 105 in each, with Poisson's variance; 40 cells, 5 standard errors."""
    circuit = tf.Circuit([tf.parts.exchange("a", 1.0)], species=("a",), method=method)
    medium = tf.Medium(a=tf.Signal(1.0, reservoir=50.0), outside="reservoir", **BOX)
    beyond = tf.Cells([[100.0, 2.0 * k] for k in range(40)], [[1.0, 0.0]] * 40)
    scene = tf.Scene(circuit, medium, founders=beyond)
    state = scene.bind(dtype=F64).start(seed=1)
    after = advance(scene, state, 1, dt=10.0 * float(state.volume[0] / state.area[0]))
    mean = 50.0 * float(state.volume[0])
    found = float(molecules(after, "a").mean())
    assert found == pytest.approx(mean, abs=5 * math.sqrt(mean / 40))


def test_uptake_of_the_last_molecules_leaves_nothing_negative():
    """Hard case 39 molecule by molecule: at k·dt = 1e3, cells in one voxel take what there is, and
    less than a molecule stays."""
    takes = [tf.Reaction({"out.a": 1}, {"a": 1}, 1e4)]
    scene = tf.Scene(
        tf.Circuit(takes, species=("a",), method="direct"),
        tf.Medium(a=tf.Signal(diffusion=0.0, initial=0.05), **BOX),
        founders=side_by_side(3),
    )
    state = scene.bind(dtype=F64).start()
    first = float(state.signals["a"].sum() * 64)
    last = advance(scene, state, 3)
    assert float(last.signals["a"].min()) >= 0 and float(molecules(last, "a").sum()) >= 1
    assert float(last.signals["a"].sum() * 64) + float(molecules(last, "a").sum()) == pytest.approx(
        first, rel=1e-13
    )


# --- failures -------------------------------------------------------------------------------------


def sinking(u, s, p, cell):
    """A rate that becomes negative once x is large."""
    return p.k * (3.0 - u.m)


@pytest.mark.parametrize("method", METHODS)
def test_a_negative_propensity_names_reaction_step_and_colonies(method):
    reaction = tf.Reaction({}, {"m": 1}, sinking, "m made less and less")
    circuit = tf.Circuit(
        [reaction],
        species=("m",),
        initial={"m": torch.tensor([0.0, 8.0, 0.0])},
        method=method,
        k=torch.tensor([0.0, 1.0, 0.0]),
    )
    scene = tf.Scene(circuit)
    with pytest.raises(
        (SimulationError, InputError),
        match=r"(?s)colony 1.*cell 0.*'m made less and less' has a propensity .*negative",
    ) as failed:
        list(tf.simulate(scene, scene.bind(3, dtype=F64).start(), until=0.3, dt=0.1))
    assert failed.value.colonies == (1,) and "step 1" in str(failed.value)
    last = list(
        tf.simulate(scene, scene.bind(3, dtype=F64).start(), until=0.3, dt=0.1, on_failure="drop")
    )[-1]
    assert last.counts.tolist() == [1, 0, 1]


def test_a_propensity_that_is_not_a_number_at_the_start_is_refused():
    reaction = tf.Reaction({}, {"m": 1}, lambda u, s, p, cell: u.m / u.m, "undefined")
    with pytest.raises(InputError, match="nan for the species 'm' at the start"):
        tf.Scene(tf.Circuit([reaction], species=("m",), method="tau_leap")).bind().start()


# --- one colony, whatever the batch ---------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_colony_is_the_same_in_any_batch(method, dtype, device):
    circuit = tf.Circuit(
        [*BIRTH_DEATH, tf.parts.exchange("m", 1.0)],
        species=("m",),
        initial={"m": tf.Uniform(1.0, 5.0)},
        method=method,
        make=torch.tensor([5.0, 10.0, 20.0]),
        lose=1.0,
        molecules_per_unit=torch.tensor([1.0, 2.0, 3.0]),
    )
    scene = tf.Scene(
        tf.Growth(rate=1.5),
        tf.Division(length=tf.Uniform(3.0, 3.4)),
        tf.Mechanics(dim=2),
        circuit,
        tf.Medium(m=tf.Signal(diffusion=5.0), box=((-8, -8), (8, 8)), spacing=4.0, outside="grow"),
    )
    first = scene.bind(3, seed=4, dtype=dtype, device=device).start()
    last = advance(scene, first, 16)
    assert int(last.counts.min()) >= 4
    for places in ([2], [1, 0]):
        assert same(last.select(places), advance(scene, first.select(places), 16)), places


def test_circuits_of_one_scene_have_noise_of_their_own():
    """Named circuits share neither events nor constants nor first values that are drawn."""
    reactions = [tf.Reaction({}, {"q": 1}, "k"), tf.Reaction({"q": 1}, {}, 1.0)]
    drawn = tf.LogNormal(20.0, 0.3)
    for method in ("direct", "tau_leap"):
        pair = [tf.Circuit(reactions, species=("q",), name=n, method=method, k=20.0) for n in "ab"]
        model = tf.Scene(*pair, dim=2).bind(40, seed=1)
        last = advance(model.scene, model.start(), 10)
        assert abs(float(torch.corrcoef(torch.stack([last.a_q, last.b_q]))[0, 1])) < 0.5
    pair = [
        tf.Circuit(reactions, species=("q",), name=n, k=drawn, initial={"q": drawn}) for n in "ab"
    ]
    first = tf.Scene(*pair, dim=2).bind(40, seed=1).start()
    named = ("a_q", "b_q", "circuit_a_k", "circuit_b_k")
    matrix = torch.corrcoef(torch.stack([first.fields[n] for n in named]))
    # 40 colonies: the standard error of a correlation is 0.16
    assert float((matrix - torch.eye(4)).abs().max()) < 0.5


@pytest.mark.parametrize("method", METHODS)
def test_constants_that_require_a_gradient_are_warned_of(method):
    make = torch.tensor(3.0, requires_grad=True)
    circuit = tf.Circuit(BIRTH_DEATH, species=("m",), method=method, make=make, lose=1.0)
    with pytest.warns(UserWarning, match=f"'{method}' passes no gradient on.*detach them"):
        tf.Scene(circuit, dim=2).bind()
