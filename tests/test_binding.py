"""Describe, bind, step: scenes never change, may be bound many times, and a step decides
nothing."""

from __future__ import annotations

import copy
import pickle
import warnings
from dataclasses import dataclass, fields, replace

import pytest
import torch

import torchfilm as tf
from torchfilm.state import PER_CELL


def run(model: tf.Model, steps: int = 30) -> tf.State:
    state = model.start()
    for _ in range(steps):
        state = model.step(state)
    return state


def same(one: tf.State, other: tf.State) -> None:
    for name in (*PER_CELL, *one.fields):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


@pytest.mark.parametrize("name", ["boundary_detector", "toggle_switch", "programmed_growth"])
def test_one_scene_bound_twice_and_stepped_in_turn(name):
    """Two models of one scene, and two runs of one model, do not disturb each other."""
    scene = tf.scenes.READY[name]()
    alone = [run(scene.bind(2, seed=k)) for k in (1, 2)]
    models = [scene.bind(2, seed=k) for k in (1, 2)]
    states = [m.start() for m in models]
    third = models[0].start()
    for _ in range(30):
        states = [m.step(s) for m, s in zip(models, states, strict=True)]
        third = models[0].step(third)
    same(states[0], alone[0])
    same(states[1], alone[1])
    same(third, alone[0])


def made(u, s, p, cell):
    return {"m": 1.0 - u.m}


def test_one_circuit_in_two_scenes_takes_the_network_of_neither():
    """What a circuit has found out in one scene is not known to the other."""
    reactions = [tf.parts.constitutive("m", 1.0), tf.parts.exchange("m", 2.0)]
    circuit = tf.Circuit(reactions, species=("m",))
    body = (tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2), circuit)
    box = {"box": ((-16, -16), (16, 16)), "spacing": 4.0}
    wide = tf.Scene(*body, tf.Medium(m=tf.Signal(diffusion=5.0), x=tf.Signal(diffusion=1.0), **box))
    plain = tf.Scene(*body, tf.Medium(m=tf.Signal(diffusion=5.0), **box))
    first = run(plain.bind(seed=1))
    other = wide.bind(seed=1)
    model = plain.bind(seed=1)
    run(other)
    same(run(model), first)


def test_a_scene_does_not_change_and_says_so():
    scene = tf.scenes.boundary_detector()
    before = scene.fingerprint
    run(scene.bind(2))
    tf.explain(scene, seconds=0)
    assert scene.fingerprint == before
    for name in ("dt", "name", "effects", "anything"):
        with pytest.raises(AttributeError, match=r"never changes: scene\.replace"):
            setattr(scene, name, 1.0)
    longer = scene.replace(dt=0.05)
    assert (longer.dt, scene.dt) == (0.05, 0.025) and longer != scene
    assert longer.replace(dt=0.025) == scene and hash(longer.replace(dt=0.025)) == hash(scene)
    with pytest.raises(tf.InputError, match=r"no parameter 'dtt'.*Did you mean dt"):
        scene.replace(dtt=0.1)


@pytest.mark.parametrize("name", tf.scenes.READY)
def test_ready_scenes_are_compared_copied_and_pickled(name):
    scene = tf.scenes.READY[name]()
    assert scene == tf.scenes.READY[name]()
    if name != "programmed_growth":  # its rule is a function inside a function
        twin = pickle.loads(pickle.dumps(scene))
        assert twin == scene
        same(run(twin.bind(2, seed=3), 5), run(scene.bind(2, seed=3), 5))
    assert copy.deepcopy(scene) == scene
    assert scene.bind(1).describe() == scene.bind(1).describe()


def test_a_model_bound_to_a_state_continues_it():
    scene = tf.scenes.boundary_detector(k3=[0.5, 1.0, 2.0])
    model = scene.bind(seed=4)
    state = run(model, 20)
    other = scene.bind(state=state)
    same(other.step(state), model.step(state))
    part = state.select([2, 0])
    same(scene.bind(state=part).step(part), model.step(state).select([2, 0]))


def test_a_state_of_another_precision_is_refused():
    scene = tf.scenes.microcolony()
    state = scene.bind(dtype=torch.float64).start()
    with pytest.raises(
        tf.InputError, match=r"float64.*float32 on cpu, as the model is.*bind\(state="
    ):
        next(tf.simulate(scene.bind(), state, until=1.0))


def test_simulate_binds_by_itself():
    scene = tf.scenes.microcolony()
    *_, by_scene = tf.simulate(scene, until=0.5, colonies=3, seed=5)
    *_, by_model = tf.simulate(scene.bind(3, seed=5), until=0.5)
    *_, by_state = tf.simulate(scene, scene.bind(3, seed=5).start(), until=0.5)
    same(by_scene, by_model)
    same(by_scene, by_state)
    with pytest.raises(
        tf.InputError, match=r"colonies = 2 is not allowed: .*left out where a state"
    ):
        tf.simulate(scene, by_scene, until=1.0, colonies=2)


def test_the_options_of_a_batch_are_refused_where_it_has_its_own():
    scene = tf.scenes.microcolony()
    model = scene.bind()
    batch = {"colonies": 5, "seed": 7, "streams": [3], "device": "cpu", "dtype": torch.float64}
    for name, value in batch.items():
        for what, given in (("model", (model,)), ("state", (scene, model.start()))):
            with pytest.raises(tf.InputError, match=f"^{name} = .*left out where a {what} is"):
                tf.simulate(*given, until=0.05, **{name: value})


def test_colonies_keep_their_streams_where_a_scene_is_bound_to_a_state():
    scene = tf.scenes.microcolony()
    state = scene.bind(3, streams=[70, 80, 90]).start()
    turned = scene.bind(state=state.select([2, 0, 1])).start()
    assert (turned.colony_id.tolist(), turned.stream.tolist()) == ([0, 1, 2], [70, 80, 90])
    assert scene.bind(state=state.select([1])).start().stream.tolist() == [0, 80]


def test_a_low_rate_is_warned_of_once_for_a_run():
    scene = tf.Scene(tf.Growth(rate=0.02), dim=2)
    with pytest.warns(UserWarning, match="per hour") as told:
        state = scene.bind().start()
        list(tf.simulate(scene, state, until=0.05))
    assert len(told) == 1


def test_progress_is_shown_where_it_is_wanted(capfd):
    for _ in tf.simulate(tf.scenes.microcolony(), until=0.25, progress=True):
        pass
    assert "microcolony: 1 colony" in capfd.readouterr().err


def test_several_circuits_are_modules():
    """Two circuits: their species are fields of their own; a shared species is changed by both."""

    def source(u, s, p, cell):
        return {"a": p.make}

    def sink(u, s, p, cell):
        return {"a": -p.lose * u.a, "b": p.lose * u.a}

    body = (tf.Growth(rate=0.0), tf.Mechanics(dim=2))
    scene = tf.Scene(
        *body,
        tf.Circuit(source, species=("a",), make=2.0),
        tf.Circuit(sink, species=("b",), shared=("a",), name="second", lose=1.0),
    )
    one = tf.Scene(
        *body, tf.Circuit(lambda u, s, p, cell: {"a": 2.0 - u.a, "b": u.a}, species=("a", "b"))
    )
    model = scene.bind(dtype=torch.float64)
    assert {"a", "second_b"} <= set(model.start().fields)
    together = run(one.bind(dtype=torch.float64), 80)
    # circuits act in turn: first order in dt
    apart = run(scene.replace(dt=0.0025).bind(dtype=torch.float64), 800)
    assert float(apart.a) == pytest.approx(float(together.a), rel=2e-3)
    assert float(apart.fields["second_b"]) == pytest.approx(float(together.b), rel=2e-3)
    assert sum(t.startswith("circuit") for t, _, _ in model.couplings()) > 0
    with pytest.raises(
        tf.InputError,
        match=r"field 'm' is declared by circuit and by circuit.*name|" r"lists circuit 2 times",
    ):
        tf.Scene(*body, tf.Circuit(made, species=("m",)), tf.Circuit(made, species=("m",)))
    with pytest.raises(tf.InputError, match="needs the field 'z'"):
        tf.Scene(*body, tf.Circuit(sink, species=("b",), shared={"a": "z"}, lose=1.0))


def test_fields_declared_alike_are_one():
    """Two circuits by cell type declare the cell type; a field of one name and two kinds is
    refused."""
    scene = tf.Scene(
        tf.Mechanics(dim=2),
        tf.Circuit({0: made}, species=("m",)),
        tf.Circuit({0: made}, species=("m",), name="b"),
    )
    assert list(scene.bind().start().fields).count("cell_type") == 1
    with pytest.raises(
        tf.InputError, match="field 'growth_rate' is declared by growth and by circuit"
    ):
        tf.Scene(tf.Growth(rate=1.0), tf.Circuit(made, species=("growth_rate",)), dim=2)


@pytest.mark.parametrize("name", ["toggle_switch", "nutrient_limited"])
def test_a_model_that_has_run_can_be_copied(name):
    model = tf.scenes.build(name).bind(2, seed=3)
    state = model.step(model.start())
    same(copy.deepcopy(model).step(state), model.step(state))


@pytest.mark.parametrize(
    ("stage", "division", "late"),
    [(50, tf.Division(length=3.5), 80), (85, tf.Division(length=3.5), 0), (50, tf.Division(), 0)],
)
def test_an_effect_that_looks_for_divisions_too_early_is_warned_of(stage, division, late):
    """Cells divide at stage 80 at a threshold, and at stage 20 where a rule flags them."""

    @dataclass(frozen=True)
    class Count(tf.Effect):
        title = "count"

        def step(self, state, dt, values):
            assert len(state.births) < 2
            return state

    Count.stage = stage
    scene = tf.Scene(tf.Growth(rate=1.0), division, Count())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene.bind()
    said = [str(w.message) for w in told if "births" in str(w.message)]
    wanted = f"Count reads state.births at stage 50, and cells divide at stage {late}"
    assert len(said) == (late > 0) and all(x.startswith(wanted) for x in said)


@pytest.mark.parametrize(("stage", "removal"), [(95, True), (85, True), (95, False)])
def test_rows_of_births_are_not_read_after_cells_are_gone(stage, removal):
    @dataclass(frozen=True)
    class Look(tf.Effect):
        title = "look"

        def step(self, state, dt, values):
            for births in state.births:
                assert state.uid[births.first].tolist() == births.uid[: len(births.first)].tolist()
            return state

    Look.stage = stage
    gone = [tf.Removal(low=(-3.0, -9.0))] if removal else []
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2), Look(), *gone
    )
    if stage == 95 and removal:
        with pytest.warns(UserWarning, match=r"removal removes cells .* 90: .* Write stage = 85"):
            scene.bind()
        return
    *_, state = tf.simulate(scene, until=3.0)
    assert state.cells > 4


def test_descriptions_with_keywords_of_their_own_can_be_replaced():
    """Of `Medium` and `Circuit`, whose signals and constants are keywords."""
    medium = tf.Medium(ahl=tf.Signal(10.0), box=((-8, -8), (8, 8)), spacing=4.0, depth=2.0)
    other = replace(medium, backend="torch")
    assert other.backend == "torch" and repr(other.signals) == repr(medium.signals)
    assert (other.box, other.spacing, other.depth) == (medium.box, medium.spacing, 2.0)
    circuit = tf.Circuit(lambda u, s, p, cell: {"m": p.k - u.m}, species=("m",), k=2.0,
                         shared={"g": "growth"}, dilution=False)  # fmt: skip
    changed = replace(circuit, rtol=1e-3)
    for f in fields(circuit):
        assert f.name == "rtol" or getattr(changed, f.name) == getattr(circuit, f.name), f.name
    by_type = tf.Circuit({0: circuit.rates["every cell"], 2: lambda u, s, p, cell: {"m": -u.m}},
                         species=("m",), k=2.0)  # fmt: skip
    assert replace(by_type, steps=1).rates == by_type.rates
    assert replace(medium, b=tf.Signal(1.0)).signals.keys() == {"ahl", "b"}
    for wrong, error in (
        (lambda: replace(medium, signals=tf.Signal(5.0)), "Medium.signals = .*a mapping by name"),
        (lambda: replace(medium, signals={"a b": tf.Signal(5.0)}), "Medium.signals = 'a b'"),
        (lambda: replace(medium, signals={"box": tf.Signal(5.0)}), "Medium.signals = 'box'"),
        (lambda: replace(circuit, parameters={"rtol": 2.0}), "Circuit.parameters = 'rtol'"),
        (lambda: replace(circuit, parameters={0: 1.0, 1: 2.0}), "Circuit.parameters = 0"),
        (lambda: tf.Circuit({**circuit.rates, 0: [tf.Reaction({}, {"m": 1}, 1.0)]},
                            species=("m",)), "by cell types that are integers"),
    ):  # fmt: skip
        with pytest.raises(tf.InputError, match=error):
            wrong()
    with pytest.raises(tf.InputError, match="k = -inf"):
        replace(circuit, parameters={"k": -torch.inf})


# --- what bind is given by mistake ----------------------------------------------------------------


def test_a_state_in_place_of_cells_is_told_where_it_goes():
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2)
    with pytest.raises(tf.InputError, match=r"cells = State\(.* a tf.Cells. A state goes on by"):
        scene.bind(cells=scene.bind().start())


def test_streams_of_several_colonies_need_their_number():
    with pytest.raises(tf.InputError, match=r"streams = \[5, 2, 0\].*Give colonies=3, too"):
        tf.Scene(tf.Growth(rate=1.0), dim=2).bind(streams=[5, 2, 0])


def test_founders_are_made_of_a_seed_alone():
    two = lambda seed, colony: tf.Cells.single(2)
    with pytest.raises(tf.InputError, match="a function of one number, the seed of the colony"):
        tf.Scene(tf.Growth(rate=1.0), founders=two, dim=2)


def test_fields_that_are_not_there_are_guessed_at():
    state = tf.Scene(tf.Rules(variables={"light": 0.0}), dim=2).bind(3).start()
    with pytest.raises(tf.InputError, match=r"field = 'ligth' .*Did you mean 'light'\?"):
        state.with_fields(ligth=state.light)
    with pytest.raises(tf.InputError, match=r"\(5,\) .*x\[state.colony\]"):
        state.with_fields(light=torch.zeros(5))


def test_a_division_has_no_neighbours():
    def born(parent, first, second):
        first.crowd = first.contact_count()

    scene = tf.Scene(
        tf.Rules(None, born, variables={"crowd": 0.0}), tf.Growth(rate=1.0),
        tf.Division(length=4.0), dim=2,
    )  # fmt: skip
    with pytest.raises(tf.InputError, match="daughter1 has no 'contact_count': a division sees"):
        scene.bind()


def test_a_schedule_as_the_rate_of_a_reaction_is_told_its_place():
    made = tf.parts.constitutive("m", tf.Schedule({0: 1.0, 1: 2.0}))
    with pytest.raises(tf.InputError, match=r"Name a constant, rate='light', and give it"):
        tf.Circuit(made, species="m")
    with pytest.raises(tf.InputError, match="What changes in time is a Schedule"):
        tf.Circuit(tf.parts.constitutive("m", "light"), species="m", light=lambda t: 1.0)
