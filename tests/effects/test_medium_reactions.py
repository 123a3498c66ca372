"""Reactions of signals in the medium: known solutions, balances, order, failures, messages."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from exchanging_cells import totals

import torchfilm as tf

F64 = torch.float64
BOX = {"box": [[-20.0, -20.0], [20.0, 20.0]], "spacing": 4.0, "depth": 1.0}
FOUR = tf.Cells([[6.0 * k - 9.0, 0.0] for k in range(4)], [[0.0, 1.0]] * 4, length=2.0)


def degrade(s, p):
    return {"drug": -p.k * s.enzyme * s.drug}


def medium(diffusion=0.0, box=BOX, **first) -> tf.Medium:
    signals = {n: tf.Signal(diffusion=diffusion, initial=x) for n, x in first.items()}
    return tf.Medium(**signals, **box)


def later(scene: tf.Scene, until: float, **given) -> tf.State:
    *_, state = tf.simulate(scene, until=until, **({"dtype": F64} | given))
    return state


def in_the_middle(x: torch.Tensor) -> torch.Tensor:
    return torch.exp(-(x[:, 0] ** 2 + x[:, 1] ** 2) / 40.0)


def assert_batch_changes_no_bit(scene: tf.Scene, signal: str) -> None:
    """Nor does a stop half way."""
    three = later(scene, 1.0, colonies=3, dtype=torch.float32)
    half = later(scene, 0.5, streams=[1], dtype=torch.float32)
    *_, again = tf.simulate(scene, half, until=1.0)
    for one in (later(scene, 1.0, streams=[1], dtype=torch.float32), again):
        assert torch.equal(three.select([1]).signals[signal], one.signals[signal])


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_an_enzyme_degrades_a_drug(backend, device, dtype):
    backend = backend if device.type == "cpu" else None  # kernels are for the CPU
    scene = tf.Scene(
        tf.MediumReactions(degrade, parameters={"k": [2.0, 1.0]}, backend=backend),
        medium(enzyme=0.5, drug=3.0), dim=2, dt=0.05,
    )  # fmt: skip
    state = later(scene, 1.0, colonies=2, device=device, dtype=dtype)
    drug, enzyme = (state.signals[n].view(2, -1) for n in ("drug", "enzyme"))
    expected = torch.tensor([[3 * math.exp(-1.0)], [3 * math.exp(-0.5)]]).to(drug)
    assert torch.allclose(drug, expected.expand_as(drug), rtol=1e-4)
    assert bool((enzyme == 0.5).all())


def test_reactions_in_a_list_by_their_names():
    """a + b -> c of equal amounts: a = 1/(1 + kt), and a + c stays, voxel by voxel."""
    reactions = [tf.Reaction.of("a + b -> c", rate="k")]
    scene = tf.Scene(
        tf.MediumReactions(reactions, parameters={"k": 1.5}), medium(a=1.0, b=1.0, c=0.0), dim=2
    )
    state = later(scene, 2.0)
    a, c = state.signals["a"], state.signals["c"]
    assert torch.allclose(a, torch.full_like(a, 1 / 4.0), rtol=1e-4)
    assert torch.allclose(a + c, torch.ones_like(a), rtol=1e-12)


def test_nothing_is_lost_where_signals_diffuse_and_react():
    signals = {n: tf.Signal(diffusion=30.0, initial=x) for n, x in
               {"a": in_the_middle, "b": 0.5, "c": 0.0}.items()}  # fmt: skip
    scene = tf.Scene(
        tf.MediumReactions([tf.Reaction.of("a + b -> c", rate=5.0)]),
        tf.Medium(**signals, **BOX), dim=2,
    )  # fmt: skip
    first = scene.bind(2, dtype=F64).start()
    state = later(scene, 2.0, colonies=2)
    sums = lambda s, names: sum(totals(s, n, inside=False) for n in names)
    for names in ("ac", "bc"):
        assert sums(state, names).tolist() == pytest.approx(sums(first, names).tolist(), rel=1e-11)
    assert float(state.signals["c"].max()) > 0.1 and float(state.signals["a"].min()) >= 0.0


def test_the_error_of_taking_turns_with_diffusion_is_of_second_order():
    def run(dt):
        signals = {"a": tf.Signal(30.0, initial=in_the_middle), "b": tf.Signal(5.0, initial=0.5)}
        scene = tf.Scene(
            tf.MediumReactions(
                [tf.Reaction.of("2 a + b -> 3 a", rate=4.0)], rtol=1e-10, atol=1e-12
            ),
            tf.Medium(**signals, **BOX), dim=2, dt=dt,
        )  # fmt: skip
        return later(scene, 1.6).signals["a"]

    exact = run(0.0125)
    errors = [float((run(dt) - exact).abs().max()) for dt in (0.2, 0.1, 0.05)]
    assert 3.3 < errors[0] / errors[1] < 5.0 and 3.3 < errors[1] / errors[2] < 5.0


def quiet(u, s, p, cell):
    return {"maker": 0.0 * u.maker}, {"b": 0.1 * cell.volume}


@pytest.mark.parametrize(
    "options", [{}, {"exchange": "turns", "splitting": "strang", "steps": 1},
                {"exchange": "turns", "steps": 4}],
)  # fmt: skip
def test_it_is_of_second_order_beside_circuits_that_exchange(options):
    """Of the signals that react, one is exchanged, and one is not."""

    def run(dt):
        signals = {"a": tf.Signal(30.0, initial=in_the_middle), "b": tf.Signal(5.0, initial=0.5)}
        scene = tf.Scene(
            tf.Circuit(quiet, species="maker", rtol=1e-8),
            tf.MediumReactions(
                [tf.Reaction.of("2 a + b -> 3 a", rate=4.0)], rtol=1e-10, atol=1e-12
            ),
            tf.Medium(**signals, **BOX, **options), founders=FOUR, dt=dt,
        )  # fmt: skip
        return later(scene, 1.6).signals["a"]

    exact = run(0.0125)
    errors = [float((run(dt) - exact).abs().max()) for dt in (0.2, 0.1, 0.05)]
    assert 3.3 < errors[0] / errors[1] < 5.0 and 3.3 < errors[1] / errors[2] < 5.0


def test_a_front_has_the_speed_of_fisher():
    """∂s/∂t = D ∂²s/∂x² + r s(1 − s): from a step the front comes to 2√(rD) − 1.5 √(D/r)/t."""
    r, diffusion, width = 2.0, 50.0, 400.0
    scene = tf.Scene(
        tf.MediumReactions(lambda s, p: {"s": r * s.s * (1.0 - s.s)}),
        tf.Medium(
            s=tf.Signal(diffusion=diffusion, initial=lambda x: (x[:, 0] < 10.0).to(x.dtype)),
            box=[[0.0, 0.0], [width, 1.0]], spacing=1.0, depth=1.0,
        ),
        founders=tf.Cells([[5.0, 0.5]], [[1.0, 0.0]], length=1.0), dt=0.05,
    )  # fmt: skip
    hours, places = [], []
    for state in tf.simulate(scene, until=14.0, dtype=F64):
        if state.step % 40 == 0 and state.time >= 6.0:
            hours.append(state.time)
            places.append(float(state.signals["s"].sum()))
    speeds = [(b - a) / 2.0 for a, b in itertools.pairwise(places)]
    for hour, speed in zip(hours[:-1], speeds, strict=True):
        expected = 2 * math.sqrt(r * diffusion) - 1.5 * math.sqrt(diffusion / r) / (hour + 1.0)
        assert speed == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("exchange", ["together", "turns"])
def test_cells_secrete_an_enzyme_that_degrades_what_slows_them(exchange):
    """The enzyme that cells have made is all there, and cells near it grow again."""

    def makes(u, s, p, cell):
        return {"maker": 0.0 * u.maker}, {"enzyme": 3.0 * cell.volume}

    def slows(cells):
        cells.vigour = 1.0 / (1.0 + cells.signals.drug / 0.1)

    scene = tf.Scene(
        tf.Rules(slows, variables={"vigour": 1.0}), tf.Growth(rate=1.0, factor="vigour"),
        tf.Division(length=4.0, conserves="volume"), tf.Mechanics(dim=2),
        tf.Circuit(makes, species="maker"),
        tf.MediumReactions(degrade, parameters={"k": 20.0}),
        tf.Medium(enzyme=tf.Signal(diffusion=20.0), drug=tf.Signal(diffusion=20.0, initial=1.0),
                  exchange=exchange, **BOX),
        founders=FOUR,
    )  # fmt: skip
    made, vigour = 0.0, []
    for state in tf.simulate(scene, until=3.0, dtype=F64):
        vigour.append(float(state.vigour.mean()))
        made += 0.025 * 3.0 * float(state.volume.sum())
    assert float(totals(state, "enzyme", inside=False)) == pytest.approx(made, rel=0.05)
    assert vigour[0] < 0.15 and vigour[-1] > 0.5


def test_nothing_reacts_in_obstacles():
    scene = tf.Scene(
        tf.MediumReactions(lambda s, p: {"a": 1.0 + 0.0 * s.a}),
        tf.Medium(a=tf.Signal(diffusion=5.0), obstacles=lambda x: x[:, 0] > 8.0, **BOX), dim=2,
    )  # fmt: skip
    state = later(scene, 0.5)
    solid = state.layout.grid.centres()[:, 0] > 8.0
    assert bool((state.signals["a"][solid] == 0).all())
    assert torch.allclose(state.signals["a"][~solid], torch.tensor(0.5, dtype=F64))


def test_a_colony_does_not_depend_on_its_batch():
    scene = tf.Scene(
        tf.MediumReactions(degrade, parameters={"k": 2.0}), tf.Growth(rate=1.0),
        tf.Mechanics(dim=2), tf.Division(length=4.0),
        tf.Medium(enzyme=tf.Signal(30.0, initial=in_the_middle), drug=tf.Signal(9.0, initial=1.0),
                  **BOX),
    )  # fmt: skip
    assert_batch_changes_no_bit(scene, "drug")


def test_gradients_by_constants():
    def amount(k):
        scene = tf.Scene(
            tf.MediumReactions(degrade, parameters={"k": k}), medium(enzyme=0.5, drug=3.0), dim=2
        )
        model = scene.bind(1, dtype=F64)
        return model.step(model.start(), 0.1).signals["drug"].sum()

    k = torch.tensor(2.0, dtype=F64, requires_grad=True)
    found = amount(k)
    (slope,) = torch.autograd.grad(found, k)
    assert float(slope) == pytest.approx(-0.05 * float(found.detach()), rel=1e-4)


def test_a_constant_may_change_in_time():
    pulse = tf.Schedule({0: 0.0, 0.5: 2.0})
    scene = tf.Scene(
        tf.MediumReactions(degrade, parameters={"k": pulse}), medium(enzyme=0.5, drug=3.0), dim=2
    )
    drug = later(scene, 1.0).signals["drug"]
    assert torch.allclose(drug, torch.full_like(drug, 3 * math.exp(-0.5)), rtol=1e-4)


def test_what_runs_away_fails_and_names_its_colony():
    scene = tf.Scene(
        tf.MediumReactions(lambda s, p: {"a": p.k * s.a**2}, parameters={"k": [0.1, 50.0]}),
        medium(a=1.0), dim=2,
    )  # fmt: skip
    with pytest.raises(tf.SimulationError, match=r"colony 1 .*in the medium, at \(.*'a' runs"):
        later(scene, 1.0, colonies=2)


def test_what_fails_in_the_first_half_of_a_step_fails_the_colony():
    """The second half goes well: in between the signal decays to less than a thousandth."""
    scene = tf.Scene(
        tf.MediumReactions(lambda s, p: {"a": p.k * s.a**2}, parameters={"k": [0.1, 50.0]}),
        tf.Medium(a=tf.Signal(0.0, initial=1.0, decay=100.0), **BOX), dim=2,
    )  # fmt: skip
    with pytest.raises(tf.SimulationError, match=r"colony 1 .*in the medium, at \(.*'a' runs"):
        later(scene, 0.1, colonies=2, dt=0.1)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: tf.MediumReactions(3), "a function f\\(s, p\\), or a list of reactions"),
        (lambda: tf.MediumReactions(["a -> b"]), r"'a -> b' is not .*a list of tf\.Reaction"),
        (
            lambda: tf.MediumReactions([tf.Reaction.of("a -> b", rate=lambda u, s, p, c: u.a)]),
            "a number or the name of a parameter",
        ),
        (lambda: tf.MediumReactions([]), "a function f\\(s, p\\), or a list of reactions"),
        (lambda: tf.MediumReactions(degrade, parameters=[1.0]), "a dict"),
        (lambda: tf.MediumReactions(degrade, parameters={"k": {0: 1.0}}), "one per colony"),
        (lambda: tf.MediumReactions(degrade, rtol=0.0), "MediumReactions.rtol"),
        (lambda: tf.MediumReactions(degrade, backend="cuda"), "MediumReactions.backend"),
    ],
)
def test_bad_descriptions(make, words):
    with pytest.raises(tf.InputError, match=words):
        make()


@pytest.mark.parametrize(
    ("rates", "words"),
    [
        (lambda s, p: {"drug": -s.enzyme}, "does not read k of MediumReactions.parameters"),
        (lambda s, p: {"drg": -p.k * s.drug}, "'drg', which is no signal.*Did you mean 'drug'"),
        (lambda s, p: {"drug": -p.k * s.drugs}, "s has no 'drugs'"),
        (lambda s, p: {"drug": -p.j * s.drug}, r"p \(MediumReactions.parameters\) has no 'j'"),
        (lambda s, p: -p.k * s.drug, "it must return a dict"),
        (lambda s, p: {}, "it changes no signal"),
        (lambda s, p: {"drug": -p.k * s.drug} if float(s.drug[0]) == 3.0 else {}, "of others at"),
        (lambda s, p: {"drug": -p.k * s.drug.mean()}, "in one voxel depends on what other voxels"),
        (lambda s, p: {"drug": p.k * s.drug.outer(s.drug)}, r"shape \(16, 16\) for 'drug'"),
        (lambda s, p: {"drug": p.k * torch.log(s.drug - 3.0)}, "not a finite number"),
        (lambda s, p: {"drug": p.k * math.exp(s.drug)}, r"called with \(s, p\)"),
        ([tf.Reaction.of("drug -> ", rate="j")], "needs the parameter 'j'"),
        (
            [tf.Reaction.of("drug -> drugs", rate="k")],
            "has 'drugs', which is no signal.*Did you mean 'drug'",
        ),
    ],
)
def test_rates_that_do_not_fit(rates, words):
    scene = tf.Scene(
        tf.MediumReactions(rates, parameters={"k": 1.0}), medium(enzyme=0.5, drug=3.0), dim=2
    )
    with pytest.raises(tf.InputError, match=words):
        scene.bind()


def test_what_fails_is_dropped_once():
    scene = tf.Scene(
        tf.MediumReactions(lambda s, p: {"a": p.k * s.a**2}, parameters={"k": [0.1, 50.0]}),
        medium(a=1.0), dim=2,
    )  # fmt: skip
    with pytest.warns(RuntimeWarning, match="colony 1 .* failed in step 1 ") as seen:
        last = later(scene, 0.2, colonies=2, on_failure="drop")
    assert len(seen) == 1 and last.counts.tolist() == [1, 0]


def test_a_rate_in_a_list_may_differ_by_colony():
    reactions = [tf.Reaction.of("a -> ", rate=torch.tensor([1.0, 2.0]))]
    scene = tf.Scene(tf.MediumReactions(reactions), medium(a=1.0), dim=2)
    state = later(scene, 1.0, colonies=2)
    found = state.signals["a"].view(2, -1)[:, 0].tolist()
    assert found == pytest.approx([math.exp(-1.0), math.exp(-2.0)], rel=1e-4)
    *_, both = tf.simulate(scene, state, until=1.5)
    *_, alone = tf.simulate(scene, state.select([1]), until=1.5)
    assert torch.equal(both.select([1]).signals["a"], alone.signals["a"])


def test_a_signal_that_reactions_only_consume_is_warned_of():
    with pytest.warns(UserWarning, match="'drug' of the Medium is 0 and stays 0"):
        tf.Scene(
            tf.MediumReactions([tf.Reaction.of("enzyme + drug -> enzyme", rate=1.0)]),
            medium(enzyme=0.5, drug=0.0), dim=2,
        ).bind()  # fmt: skip


def test_obstacles_are_not_tried():
    scene = tf.Scene(
        tf.MediumReactions(lambda s, p: {"a": -s.a * s.b / s.b}),
        tf.Medium(a=tf.Signal(1.0, initial=1.0), b=tf.Signal(1.0, initial=1.0),
                  obstacles=lambda x: x[:, 0] < 0.0, **BOX), dim=2,
        founders=tf.Cells([[5.0, 0.0]], [[1.0, 0.0]]),
    )  # fmt: skip
    assert float(later(scene, 1.0).signals["a"].max()) == pytest.approx(math.exp(-1.0), rel=1e-4)


def test_settings_reach_it():
    reactions = tf.MediumReactions(degrade, parameters={"k": 1.0})
    assert reactions.with_settings(tf.Settings(rtol=1e-6)).rtol == 1e-6
    assert reactions.accuracy_knobs() == {"rtol": 1e-4}


def test_reactions_need_a_medium():
    with pytest.raises(tf.InputError, match=r"this scene has none: list tf\.Medium"):
        tf.Scene(tf.MediumReactions(degrade, parameters={"k": 1.0}), dim=2).bind()


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_explain_says_how_fast_reactions_are_in_a_step(backend):
    """Schnakenberg's at rest: |λ|² = det = g²(a + b)², and no cell takes part in them."""

    def schnakenberg(s, p):
        eaten = s.u**2 * s.v
        return {"u": p.g * (p.a - s.u + eaten), "v": p.g * (p.b - eaten)}

    constants = {"a": 0.1, "b": 0.9, "g": 20.0}
    signals = {"u": tf.Signal(diffusion=10.0, initial=1.0), "v": tf.Signal(400.0, initial=0.9)}
    effects = [
        tf.MediumReactions(schnakenberg, parameters=constants, backend=backend),
        tf.Medium(**signals, **BOX, exchange="turns"),
    ]
    said = str(tf.explain(tf.Scene(*effects, dim=2, dt=0.05)))
    assert "fastest rate at these concentrations 20/h, 1 in a step" in said
    own = "a cell finds its own steady signal"
    assert own not in said
    gives = tf.Circuit(lambda u, s, p, cell: ({"made": -u.made}, {"u": 1.0}), species="made")
    assert own in str(tf.explain(tf.Scene(gives, *effects, dim=2, dt=0.05)))


def test_rates_with_an_infinite_slope_have_no_fastest_one():
    scene = tf.Scene(
        tf.MediumReactions(lambda s, p: {"u": -((1.0 - s.u) ** 0.5)}), medium(u=1.0), dim=2, dt=0.05
    )
    assert "fastest rate at these concentrations inf/h" in str(tf.explain(scene))


def test_the_fastest_rate_does_not_depend_on_the_size_of_other_signals():
    """Monod's at half saturation: k K/(K + a)² = 2.5/h, beside what has a far larger unit."""
    for other in (1.0, 1e5):
        scene = tf.Scene(
            tf.MediumReactions(lambda s, p: {"a": -0.01 * s.a / (1e-3 + s.a), "b": 0.0 * s.b}),
            medium(a=1e-3, b=other), dim=2, dt=0.05,
        )  # fmt: skip
        assert "fastest rate at these concentrations 2.5/h, 0.1" in str(tf.explain(scene))


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_source_that_depends_on_nothing(backend):
    scene = tf.Scene(
        tf.MediumReactions([tf.Reaction.of("-> u", rate=2.0)], backend=backend),
        medium(u=1.0), dim=2, dt=0.05,
    )  # fmt: skip
    assert "fastest rate at these concentrations 0/h" in str(tf.explain(scene))
    state = later(scene, 0.5)
    assert torch.allclose(state.signals["u"], torch.full_like(state.signals["u"], 2.0))
