"""Growth that a circuit pays for: cells grow by what a species has become."""

import math

import pytest
import torch

import torchfilm as tf

DT = 0.025


def eats(u, s, p, cell):
    """The scarcer of two nutrients limits growth. Cells are larger when they grow by it."""
    pace = p.rate * torch.minimum(s.glucose / (p.K + s.glucose), s.oxygen / (p.K + s.oxygen))
    grown = pace * torch.exp(cell.growth_rate * cell.dt)
    cost = grown * cell.volume
    return {"grown": grown}, {"glucose": -cost / p.per_glucose, "oxygen": -cost / p.per_oxygen}


def scene(*more, contacts=True, backend="compiled", dt=DT, initial=1.0, law=eats) -> tf.Scene:
    fed = tf.Signal(diffusion=1e4, initial=initial)
    return tf.Scene(
        tf.Growth(species="grown"),
        tf.Division(length=tf.Uniform(3.5, 4.0), conserves="volume"),
        *([tf.Mechanics(dim=2)] if contacts else []),
        tf.Circuit(
            law, species="grown", rate=torch.tensor([1.0, 0.7]), K=0.2, per_glucose=0.5,
            per_oxygen=1.0, backend=backend,
        ),
        tf.Medium(glucose=fed, oxygen=fed, box=((-32, -32), (32, 32)), spacing=4.0, depth=1.0),
        *more, founders=tf.inoculum(6, radius=8.0), dt=dt, dim=2,
    )  # fmt: skip


def after(model: tf.Model, steps: int) -> tuple[tf.State, tf.State]:
    first = state = model.start()
    for _ in range(steps):
        state = model.step(state)
    return first, state


def paid(state: tf.State, initial: float = 1.0) -> torch.Tensor:
    """Volume that what the medium lost is worth, (2 colonies, 2 nutrients)."""
    each = [
        gain * (initial - state.signals[name].view(2, -1)).sum(1)
        for name, gain in (("glucose", 0.5), ("oxygen", 1.0))
    ]
    return torch.stack(each, 1) * state.layout.grid.voxel_volume


def gained(first: tf.State, state: tf.State) -> torch.Tensor:
    return state.groups.sum(state.volume) - first.groups.sum(first.volume)


@pytest.mark.parametrize(("dt", "off"), [(0.025, 3e-5), (0.1, 5e-4)])
def test_the_growth_rate_is_that_of_the_species_to_second_order(dt, off):
    """2 sinh(g/2) = rate · dt for the growth g of a step, so that the rate is off by (rate·dt)²/24;
    the first steps, which start from no growth, are left out."""
    rates = lambda u, s, p, cell: {"grown": p.pace * torch.exp(cell.growth_rate * cell.dt)}
    built = tf.Scene(
        tf.Growth(species="grown"), tf.Circuit(rates, species="grown", pace=1.0),
        founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, 0.5), dt=dt,
    )  # fmt: skip
    _, state = after(built.bind(dtype=torch.float64), 12)
    assert float(state.growth_rate) == pytest.approx(1.0, abs=off)
    assert float(state.growth_rate) == pytest.approx(2 * math.asinh(dt / 2) / dt, rel=1e-9)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
@pytest.mark.parametrize("parts", [1, 4])
def test_rates_know_the_length_of_the_step_that_is_taken(backend, parts):
    """Whatever the scene's dt is, and in whichever parts circuits and medium take it."""

    def takes(u, s, p, cell):
        grown = 0.2 * torch.exp(cell.growth_rate * cell.dt)
        return {"grown": grown, "seen_dt": (cell.dt - u.seen_dt) / 1e-3}, {
            "food": -grown * cell.volume
        }

    built = tf.Scene(
        tf.Growth(species="grown"),
        tf.Circuit(takes, species=("grown", "seen_dt"), dilution="grown", backend=backend),
        tf.Medium(food=tf.Signal(diffusion=10.0, initial=100.0), box=((-8, -8), (8, 8)),
                  spacing=4.0, steps=parts),
        founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, 0.5), dt=0.025,
    )  # fmt: skip
    *_, state = tf.simulate(built, built.bind(dtype=torch.float64).start(), until=2.0, dt=0.1)
    assert float(state.fields["seen_dt"]) == pytest.approx(0.1, rel=1e-6)
    assert state.dt == 0.1


def plain(u, s, p, cell):
    """Hungry cells, and no thought of the size that cells will have."""
    half = 0.02 * p.K
    pace = p.rate * torch.minimum(s.glucose / (half + s.glucose), s.oxygen / (half + s.oxygen))
    cost = pace * cell.volume
    return {"grown": pace}, {"glucose": -cost / p.per_glucose, "oxygen": -cost / p.per_oxygen}


@pytest.mark.parametrize("dt", [0.1, 0.025])
def test_the_medium_pays_for_growth_exactly(dt):
    """At every step, and when all is eaten; whatever dt, and whatever a cell asks for. Contacts,
    which hold growth back that has been paid for, are left out."""
    for law in (eats, plain):
        first, state = after(
            scene(dt=dt, law=law, contacts=False).bind(2, dtype=torch.float64), int(2 / dt)
        )
        pending = state.groups.sum(state.volume * state.grown)
        assert torch.allclose(paid(state)[:, 0], gained(first, state) + pending, rtol=1e-9)
        assert bool((pending > 0).all())
    small = scene(dt=dt, law=plain, initial=0.02, contacts=False)
    first, state = after(small.bind(2, dtype=torch.float64), int(9 / dt))
    assert bool((state.signals["glucose"] < 2e-5).all())
    assert torch.allclose(paid(state, 0.02)[:, 0], gained(first, state), rtol=1e-6)


def test_compiled_and_torch_agree():
    ends = [after(scene(backend=b).bind(2, dtype=torch.float64), 40) for b in ("compiled", "torch")]
    assert torch.allclose(gained(*ends[0]), gained(*ends[1]), rtol=1e-9)


def test_a_restart_has_the_same_bits(tmp_path):
    built = scene()
    *_, whole = tf.simulate(built, until=1.0, colonies=2)
    for _ in tf.simulate(built, until=0.5, colonies=2, record=tmp_path / "half.h5"):
        pass
    with tf.Results(tmp_path / "half.h5") as results:
        *_, resumed = tf.simulate(built, results.state(built), until=1.0)
    assert torch.equal(whole.length, resumed.length) and torch.equal(whole.grown, resumed.grown)


def test_a_search_grows_each_design():
    """Growth depends on the circuit: no recording serves for all designs."""
    said = tf.explain(scene(), cells=20, seconds=0)
    assert "circuit -> growth: grown" in said and "each design grows colonies of its own" in said


def test_gradients_pass_through_growth():
    def volume(pace):
        rates = lambda u, s, p, cell: {"grown": p.pace}
        built = tf.Scene(
            tf.Growth(species="grown"), tf.Circuit(rates, species="grown", pace=pace),
            founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, 0.5), dt=DT,
        )  # fmt: skip
        return after(built.bind(dtype=torch.float64), 5)[1].volume.sum()

    pace = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(volume(pace), pace)
    near = [float(volume(1.0 + h)) for h in (1e-5, -1e-5)]
    assert float(slope) == pytest.approx((near[0] - near[1]) / 2e-5, rel=1e-6)
    assert float(slope) > 0


def test_a_step_of_no_time_spends_nothing():
    cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], extra={"grown": [0.5]})
    model = tf.Scene(tf.Growth(species="grown"), founders=cells).bind()
    first = model.start()
    still = model.step(first, 0.0)
    assert torch.equal(still.grown, first.grown) and torch.equal(still.length, first.length)
    assert float(model.step(first).volume / first.volume) == pytest.approx(1.5)


PACE = lambda u, s, p, cell: {"grown": 1.0}


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: tf.Growth(rate=1.0, species="grown"), r"Growth.rate = 1.0 .* left out with spec"),
        (lambda: tf.Growth(species=["grown"]), r"Growth.species = .* the name of one species"),
        (lambda: tf.Growth(species="grown", law="length"), r"Growth.law, with species = 'length'"),
        (
            lambda: tf.Scene(
                tf.Growth(species="grown"), tf.Circuit(PACE, species="grown", dilution=False), dim=2
            ),
            r"growth does not dilute this species.*Leave out Circuit.dilution",
        ),
        (
            lambda: tf.Scene(tf.Growth(species="grwn"), dim=2),
            r"growth needs the field 'grwn', which nothing in this scene provides",
        ),
        (
            lambda: tf.Scene(
                tf.Growth(species="food_eaten"), tf.Monod("food"),
                tf.Medium(food=tf.Signal(diffusion=1.0), box=((-8, -8), (8, 8)), spacing=4.0),
                dim=2,
            ).bind(),
            r"nutrition sets growth_rate, and Growth.species = 'food_eaten' sets it again",
        ),
        (
            lambda: scene(tf.Rules(lambda cells: setattr(cells, "growth_rate", 0.0))).bind(2),
            r"rules sets growth_rate, and Growth.species = 'grown' sets it again",
        ),
    ],
)  # fmt: skip
def test_what_is_refused(build, said):
    with pytest.raises(tf.InputError, match=said):
        build()
