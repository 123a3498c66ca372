"""The scene: order, couplings, parameters per colony, bad input, and that nothing runs which was
not asked for."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import pytest
import torch
from helpers import step
from torch.utils._python_dispatch import TorchDispatchMode

import torchfilm as tf
from torchfilm.effect import Effect


def named(order: list[str], name: str, at: int, **how) -> Effect:
    """An effect that writes its name down when it acts."""

    @dataclass(frozen=True)
    class Named(Effect):
        stage = at
        title = name

        def step(self, state, dt, values):
            order.append(name)
            return state

        def reads(self):
            return how.get("reads", ())

        def writes(self):
            return how.get("writes", ())

        def needs(self):
            return how.get("needs", ())

        def declares(self, dim):
            return how.get("declares", ())

    return Named()


def cells_in(dim: int, count: int = 2) -> tf.Cells:
    position = torch.zeros(count, dim)
    position[:, 0] = 3.0 * torch.arange(count)
    axis = torch.zeros(count, dim)
    axis[:, 1] = 1.0
    return tf.Cells(position, axis)


# --- order and couplings --------------------------------------------------------------------------


def test_effects_act_in_stage_order_whatever_order_they_are_listed_in():
    order: list[str] = []
    effects = [
        named(order, name, at)
        for name, at in (
            ("late", 70),
            ("early", 5),
            ("middle", 35),
            ("last", 95),
            ("also middle", 35),
        )
    ]
    scene = tf.Scene(*effects)
    step(scene, scene.bind().start(), 0.1)
    assert order == ["early", "middle", "also middle", "late", "last"]


def test_the_built_in_effects_follow_the_papers_stages():
    listed = (
        tf.Removal((-9, -9), (9, 9)),
        tf.Mechanics(dim=2),
        tf.Growth(rate=1.0),
        tf.Division(),
        tf.Rules(lambda cells: None),
    )
    scene = tf.Scene(*listed)
    acting = [e.title for e in scene.bind().effects]
    assert acting == ["rules", "division", "growth", "mechanics", "removal"]
    assert scene.effects == listed


def test_order_of_listing_does_not_change_the_result():
    def effects():
        return [tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(2.5, 3.5)), tf.Mechanics(dim=2)]

    states = []
    for listed in (effects(), effects()[::-1]):
        scene = tf.Scene(*listed)
        state = scene.bind(2).start()
        for _ in range(20):
            state = step(scene, state, 0.1)
        states.append(state)
    assert states[0].cells > 6
    assert torch.equal(states[0].position, states[1].position) and torch.equal(
        states[0].uid, states[1].uid
    )


def test_couplings_say_who_drives_whom():
    order: list[str] = []
    source = named(
        order, "source", 10, writes=("heat",), declares=(tf.Field("heat", "of the medium"),)
    )
    sink = named(order, "sink", 20, reads=("heat",))
    needy = named(order, "needy", 30, needs=("heat",), writes=("length",))
    scene = tf.Scene(needy, source, sink)
    assert set(scene.bind().couplings()) == {
        ("source", "heat", "sink"),
        ("source", "heat", "needy"),
    }


def test_couplings_of_growth_and_mechanics():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2))
    found = scene.bind().couplings()
    assert ("growth", "elongation", "mechanics") in found
    assert ("growth", "length", "division") in found
    assert ("mechanics", "length", "growth") in found, "mechanics holds growth back"
    assert not [c for c in found if c[0] == c[2]], "an effect does not drive itself"


def test_growth_alone_is_driven_by_nobody():
    scene = tf.Scene(tf.Growth(rate=1.0))
    assert scene.bind().couplings() == []
    assert "nobody" in scene.bind().describe()


def test_explain_names_stages_parameters_fields_and_couplings():
    text = (
        tf.Scene(
            tf.Growth(rate=[0.5, 1.5]),
            tf.Division(length=tf.Uniform(3.0, 4.0)),
            tf.Mechanics(dim=2, walls=[tf.Plane(y=-2.0, facing="+y")]),
            name="mine",
        )
        .bind()
        .describe()
    )
    for part in (
        "mine",
        "2-D",
        "Growth(rate=<2 values, 0.5 to 1.5>",
        "Uniform(low=3.0, high=4.0)",
        "Plane(y=-2.0",
        "division_threshold",
        "µm",
    ):
        assert part in text, part
    assert "growth -> mechanics: length, elongation" in text
    assert text.index("Division(") < text.index("Growth(") < text.index("Mechanics(")


def test_repr_shows_the_effects():
    assert (
        repr(tf.Scene(tf.Growth(rate=1.0), name="mine")) == "Scene(Growth(rate=1.0), name='mine')"
    )


# --- one number, or one per colony ----------------------------------------------------------------


def two_designs(make, colonies: int = 2) -> list[tf.State]:
    """Each colony of a batch with a parameter per colony, and the same colony in a scene with its
    one number."""
    batch = make(torch.tensor([1.0, 2.0], dtype=torch.float64))
    return [run_a_little(batch, colonies)] + [run_a_little(make(v), colonies) for v in (1.0, 2.0)]


def run_a_little(scene: tf.Scene, colonies: int) -> tf.State:
    state = scene.bind(colonies, dtype=torch.float64).start()
    for _ in range(6):
        state = step(scene, state, 0.1)
    return state


def crowd(dim: int = 2) -> tf.Cells:
    """Overlapping cells, so that every parameter of the mechanics matters."""
    position = torch.zeros(4, dim, dtype=torch.float64)
    position[:, 1] = torch.tensor([0.0, 0.8, 1.6, 2.4], dtype=torch.float64)
    position[:, 0] = torch.tensor([0.0, 0.4, 0.1, 0.3], dtype=torch.float64)
    axis = torch.zeros_like(position)
    axis[:, 0] = 1.0
    return tf.Cells(position, axis, [1.9, 2.0, 2.1, 2.2])


PUSH = tf.Growth(rate=0.5)
PER_COLONY = {
    "Growth.rate": lambda v: tf.Scene(tf.Growth(rate=v), founders=crowd()),
    "Growth.rate drawn": lambda v: tf.Scene(tf.Growth(rate=tf.Uniform(0.1, v)), founders=crowd()),
    "Division.length": lambda v: tf.Scene(PUSH, tf.Division(length=v + 1.5), founders=crowd()),
    "Division.volume": lambda v: tf.Scene(PUSH, tf.Division(volume=v + 1.5), founders=crowd()),
    "Division.added": lambda v: tf.Scene(PUSH, tf.Division(added=v * 0.4), founders=crowd()),
    "Division.fraction": lambda v: tf.Scene(
        PUSH, tf.Division(length=2.5, fraction=v * 0.3), founders=crowd()
    ),
    "Division.axis_noise": lambda v: tf.Scene(
        PUSH, tf.Division(length=2.5, axis_noise=v * 0.01), founders=crowd()
    ),
    "Mechanics.viscosity": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, viscosity=v), founders=crowd()
    ),
    "Mechanics.length_drag": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, length_drag=v), founders=crowd()
    ),
    "Mechanics.alpha": lambda v: tf.Scene(PUSH, tf.Mechanics(dim=2, alpha=v), founders=crowd()),
    "Mechanics.stiffness": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, stiffness=v * 10), founders=crowd()
    ),
    "Plane.y": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, walls=[tf.Plane(y=v + 1.8, facing="-y")]), founders=crowd()
    ),
    "Plane.stiffness": lambda v: tf.Scene(
        PUSH,
        tf.Mechanics(dim=2, walls=[tf.Plane(y=2.5, facing="-y", stiffness=v)]),
        founders=crowd(),
    ),
    "Plane.weight": lambda v: tf.Scene(
        PUSH,
        tf.Mechanics(dim=2, walls=[tf.Plane(y=2.5, facing="-y", weight=v / 2)]),
        founders=crowd(),
    ),
    "Sphere.radius": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, walls=[tf.Sphere((0.0, 1.2), v + 1.0)]), founders=crowd()
    ),
    "Channel.width": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, walls=[tf.Channel(v + 4.0)]), founders=crowd()
    ),
    "Box.high": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2, walls=[tf.Box((-9.0, -9.0), (9.0, v + 1.5))]), founders=crowd()
    ),
    "Removal.high": lambda v: tf.Scene(
        PUSH, tf.Mechanics(dim=2), tf.Removal((-9.0, -9.0), (9.0, v + 1.5)), founders=crowd()
    ),
}


@pytest.mark.parametrize("name", list(PER_COLONY))
def test_every_physical_parameter_may_differ_from_colony_to_colony(name):
    """A colony of a batch with many designs is, bit for bit, that colony in a batch of its own
    design."""
    batch, *each = two_designs(PER_COLONY[name])
    first, second = (state.select([0]) for state in each)
    assert any(
        not torch.equal(getattr(first, part), getattr(second, part))
        for part in ("position", "axis", "length")
    )
    for k in range(2):
        mine, alone = batch.select([k]), each[k].select([k])
        for part in ("uid", "position", "axis", "length"):
            assert torch.equal(getattr(mine, part), getattr(alone, part)), part


SHORT = {
    "Growth.rate": lambda v: (tf.Growth(rate=v),),
    "Uniform.low": lambda v: (tf.Growth(rate=tf.Uniform(v, 3.0)),),
    "Division.length": lambda v: (tf.Division(length=v + 3),),
    "Division.fraction": lambda v: (tf.Division(fraction=v / 4),),
    "Mechanics.viscosity": lambda v: (tf.Mechanics(dim=2, viscosity=v),),
    "Mechanics.alpha": lambda v: (tf.Mechanics(dim=2, alpha=v),),
    "Plane.y": lambda v: (tf.Mechanics(dim=2, walls=[tf.Plane(y=v + 5, facing="-y")]),),
    "Plane.stiffness": lambda v: (
        tf.Mechanics(dim=2, walls=[tf.Plane(y=5.0, facing="-y", stiffness=v)]),
    ),
    "Sphere.radius": lambda v: (tf.Mechanics(dim=2, walls=[tf.Sphere((0.0, 0.0), v + 9)]),),
}


@pytest.mark.parametrize("name", list(SHORT))
def test_too_few_values_are_refused_by_name(name):
    scene = tf.Scene(*SHORT[name](torch.tensor([1.0, 2.0])), founders=cells_in(2))
    with pytest.raises(tf.InputError, match=name.split(".")[1]):
        scene.bind(3).start()


@pytest.mark.parametrize("name", list(SHORT))
def test_too_many_values_are_refused_by_name(name):
    """Four designs for three colonies: one would never be looked at, which can only be a
    mistake."""
    scene = tf.Scene(*SHORT[name](torch.tensor([1.0, 2.0, 1.0, 2.0])), founders=cells_in(2))
    with pytest.raises(tf.InputError, match=name.split(".")[1]):
        scene.bind(3).start()


# --- bad scenes -----------------------------------------------------------------------------------


def test_an_empty_scene_is_refused():
    with pytest.raises(tf.InputError, match="no effect"):
        tf.Scene()


def test_missing_brackets_are_told():
    with pytest.raises(tf.InputError, match=r"effects such as Growth\(\).*brackets"):
        tf.Scene(tf.Growth)


@pytest.mark.parametrize("made", ["growth", None, 3])
def test_what_is_no_effect_is_refused(made):
    with pytest.raises(tf.InputError, match=r"Scene = .*effects such as Growth\(\), Division\(\)"):
        tf.Scene(made)


@pytest.mark.parametrize("kind", [list, tuple])
def test_a_list_of_effects_is_to_be_unpacked(kind):
    with pytest.raises(
        tf.InputError, match=r"Growth\(.*Unpack the list: Scene\(\*effects\)"
    ) as caught:
        tf.Scene(kind([tf.Growth(rate=1.0), tf.Mechanics(dim=2)]))
    assert "brackets" not in str(caught.value)


@pytest.mark.parametrize(
    "effect", [lambda: tf.Growth(rate=1.0), lambda: tf.Division(), lambda: tf.Mechanics(dim=2)]
)
def test_an_effect_listed_twice_is_refused(effect):
    with pytest.raises(tf.InputError, match="2 times"):
        tf.Scene(effect(), effect())


def test_two_rules_are_two_effects():
    order: list[str] = []
    scene = tf.Scene(
        tf.Rules(lambda cells: order.append("one")), tf.Rules(lambda cells: order.append("two"))
    )
    model = scene.bind()
    state = model.start()
    order.clear()
    model.step(state, 0.1)
    assert order == ["one", "two"]


OTHERWISE = {
    "meaning": tf.Field("heat", "of the cell", initial=1.0),
    "initial": tf.Field("heat", "of the medium", initial=2.0),
    "at_division": tf.Field("heat", "of the medium", initial=1.0, at_division="reset"),
    "shape": tf.Field("heat", "of the medium", shape=(2,), initial=1.0),
}


@pytest.mark.parametrize("what", OTHERWISE)
def test_a_field_declared_twice_in_different_ways_is_refused(what):
    heat = tf.Field("heat", "of the medium", initial=1.0)
    first, second = (
        named([], n, 10, declares=(field,))
        for n, field in (("one", heat), ("two", OTHERWISE[what]))
    )
    with pytest.raises(tf.InputError, match=r"'heat'.*one.*two"):
        tf.Scene(first, second)


def test_a_field_declared_twice_alike_is_one_field():
    heat = lambda: tf.Field("heat", "of the medium", initial=3.0)
    scene = tf.Scene(
        named([], "one", 10, declares=(heat(),)), named([], "two", 20, declares=(heat(),)), dim=2
    )
    state = scene.bind(2).start()
    assert list(state.fields) == ["heat"] and state.heat.tolist() == [3.0, 3.0]


def test_a_needed_field_that_nobody_provides_is_told():
    with pytest.raises(tf.InputError, match=r"sink needs the field 'heat'.*growth_rate"):
        tf.Scene(named([], "sink", 20, needs=("heat",)), tf.Growth(rate=1.0))


def test_a_needed_field_may_come_with_the_cells_or_be_built_in():
    cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], extra={"heat": [2.0]})
    scene = tf.Scene(named([], "sink", 20, needs=("heat", "position", "cells")), founders=cells)
    assert scene.bind().start().heat.tolist() == [2.0]


def test_founders_of_another_dimension_are_refused():
    with pytest.raises(tf.InputError, match=r"founders.*3-D"):
        tf.Scene(tf.Mechanics(dim=2), founders=cells_in(3))


def test_cells_of_another_dimension_are_refused():
    with pytest.raises(tf.InputError, match="2-D"):
        tf.Scene(tf.Mechanics(dim=2)).bind(cells=cells_in(3)).start()


@pytest.mark.parametrize("dt", [0.0, -1.0, float("nan"), "fast", True])
def test_a_bad_step_is_refused(dt):
    with pytest.raises(tf.InputError, match=r"Scene\.dt"):
        tf.Scene(tf.Growth(rate=1.0), dt=dt)


@pytest.mark.parametrize("colonies", [0, -1, 1.5, True, "two"])
def test_a_bad_number_of_colonies_is_refused(colonies):
    with pytest.raises(tf.InputError, match=r"colonies.*integer from 1"):
        tf.Scene(tf.Growth(rate=1.0)).bind(colonies).start()


def test_without_a_number_of_colonies_there_are_as_many_as_values():
    assert tf.Scene(tf.Growth(rate=1.0)).bind().start().colonies == 1
    assert tf.Scene(tf.Growth(rate=[1.0, 2.0, 3.0])).bind(None).start().colonies == 3


@pytest.mark.parametrize("seed", [-1, 0.5, True, 2**63, None])
def test_a_bad_seed_is_refused(seed):
    with pytest.raises(tf.InputError, match="seed"):
        tf.Scene(tf.Growth(rate=1.0)).bind(seed=seed).start()


@pytest.mark.parametrize(
    "dtype", [torch.float16, torch.bfloat16, torch.int64, torch.complex64, "float32"]
)
def test_a_bad_dtype_is_refused(dtype):
    with pytest.raises(tf.InputError, match=r"dtype.*float32"):
        tf.Scene(tf.Growth(rate=1.0)).bind(dtype=dtype).start()


def unavailable() -> list[object]:
    return ["banana", 3.5, "mps"] + (
        [] if torch.cuda.is_available() else ["cuda", torch.device("cuda:1")]
    )


@pytest.mark.parametrize("device", unavailable(), ids=str)
def test_a_device_that_is_not_there_is_refused(device):
    if device == "mps" and torch.backends.mps.is_available():
        pytest.skip("this machine has one")
    with pytest.raises(tf.InputError, match="device"):
        tf.Scene(tf.Growth(rate=1.0)).bind(device=device).start()


@pytest.mark.parametrize(
    "wall",
    [
        tf.Plane(y=-0.5, facing="-y"),
        tf.Plane(point=(0.0, 1.0), normal=(0.0, 1.0)),
        tf.Sphere((0.0, 0.0), 5.0, inside=False),
        tf.Sphere((20.0, 0.0), 5.0),
        tf.Box((1.0, -5.0), (9.0, 5.0)),
        tf.Channel(4.0, low_end=1.0),
    ],
    ids=lambda w: type(w).__name__,
)
def test_a_wall_inside_out_is_told_before_anything_runs(wall):
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, walls=[wall]))
    with pytest.raises(tf.InputError, match=r"cell 0 of colony 0.*inside out"):
        scene.bind().start()


def test_the_colony_behind_the_wall_is_named():
    scene = tf.Scene(tf.Mechanics(dim=2, walls=[tf.Plane(y=[-1.0, -1.0, 1.0], facing="+y")]))
    with pytest.raises(tf.InputError, match="colony 2"):
        scene.bind(3).start()


@pytest.mark.parametrize(
    "make",
    [
        lambda: tf.Box((1.0, 0.0), (0.0, 1.0)),
        lambda: tf.Channel(-1.0),
        lambda: tf.Channel(4.0, low_end=3.0, high_end=1.0),
        lambda: tf.Sphere((0.0, 0.0), -1.0),
        lambda: tf.Plane(y=0.0, facing="up"),
        lambda: tf.Plane(),
        lambda: tf.Plane(y=0.0, x=0.0, facing="+y"),
        lambda: tf.Plane(point=(0.0, 0.0)),
        lambda: tf.Plane(point=(0.0, 0.0), normal=(0.0, 0.0)),
        lambda: tf.Plane(y=0.0, facing="+y", stiffness=-1.0),
        lambda: tf.Plane(y=0.0, facing="+y", stiffness=1.0, weight=0.5),
        lambda: tf.Mechanics(dim=4),
        lambda: tf.Mechanics(alpha=0.1, stiffness=1.0),
        lambda: tf.Mechanics(alpha=0.0),
        lambda: tf.Mechanics(tolerance=-1.0),
        lambda: tf.Mechanics(passes=0),
        lambda: tf.Mechanics(walls=["floor"]),
        lambda: tf.Mechanics(dim=2, walls=[tf.Plane(z=0.0, facing="+z")]),
        lambda: tf.Mechanics(dim=2, walls=[tf.Sphere((0.0, 0.0, 0.0), 5.0)]),
    ],
)
def test_bad_walls_and_mechanics_are_refused_at_construction(make):
    with pytest.raises(tf.InputError):
        make()


def test_one_wall_instead_of_a_list_is_told():
    with pytest.raises(tf.InputError, match="walls"):
        tf.Mechanics(dim=2, walls=tf.Plane(y=-1.0, facing="+y"))


# --- only what is asked ---------------------------------------------------------------------------


class Operators(TorchDispatchMode):
    """Counts the ATen operators that are dispatched."""

    def __init__(self):
        super().__init__()
        self.seen: Counter[str] = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.seen[func.overloadpacket.__name__] += 1
        return func(*args, **(kwargs or {}))


def operators(*effects: Effect, steps: int = 1) -> Counter[str]:
    scene = tf.Scene(*effects, founders=cells_in(2, 6))
    model = scene.bind(3)
    state = model.start()
    with Operators() as counted:
        for _ in range(steps):
            state = model.step(state, 0.1)
    return counted.seen


def test_growth_alone_is_a_handful_of_operators():
    """The law by length takes four (rate·dt, expm1, times l, plus l), the law by volume two more
    for l + 4r/3; two may be for care."""
    by_length, by_volume = (
        operators(tf.Growth(rate=1.0, law="length")),
        operators(tf.Growth(rate=1.0)),
    )
    assert sum(by_length.values()) <= 6, by_length
    assert sum(by_volume.values()) <= 8, by_volume
    assert by_length["expm1"] == by_volume["expm1"] == 1


def test_the_cost_of_growth_does_not_depend_on_the_number_of_steps_before():
    assert sum(operators(tf.Growth(rate=1.0), steps=5).values()) == 5 * sum(
        operators(tf.Growth(rate=1.0)).values()
    )


HEAVY = (
    "sort",
    "argsort",
    "sparse",
    "csr",
    "mm",
    "bmm",
    "inv",
    "searchsorted",
    "scatter",
    "repeat_interleave",
)


def heavy(seen: Counter[str]) -> list[str]:
    return [name for name in seen if any(word in name for word in HEAVY)]


def test_without_mechanics_no_pair_is_looked_for_and_nothing_is_solved():
    growing = (
        tf.Growth(rate=1.0),
        tf.Division(length=9.0),
        tf.Removal((-99.0, -99.0), (99.0, 99.0)),
        tf.Rules(lambda c: c.growth_rate),
    )
    assert not heavy(operators(*growing))
    assert heavy(operators(tf.Growth(rate=1.0), tf.Mechanics(dim=2))), (
        "this test must be able to see them"
    )


def test_rules_that_do_not_ask_for_contacts_do_not_pay_for_them():
    assert not heavy(operators(tf.Rules(lambda cells: setattr(cells, "big", cells.volume > 3))))
    assert heavy(operators(tf.Rules(lambda cells: setattr(cells, "near", cells.contact_count()))))


def test_an_effect_that_is_not_listed_leaves_no_field_and_no_report():
    state = tf.Scene(tf.Growth(rate=1.0)).bind().start()
    assert set(state.fields) == {"growth_rate", "elongation"} and not state.reports
    assert set(tf.Scene(tf.Division(length=3.0)).bind().start().fields) == {
        "divide_flag",
        "division_threshold",
    }
    scene = tf.Scene(tf.Mechanics(dim=2))
    assert set(scene.bind().start().fields) == {"displacement"}
    assert set(step(scene, scene.bind().start(), 0.1).reports) == {"mechanics"}


def test_a_step_does_not_touch_the_state_before():
    aging = tf.Rules(lambda c: setattr(c, "age", c.age + 1), variables={"age": 0.0})
    scene = tf.Scene(
        aging, tf.Growth(rate=1.0), tf.Division(length=2.3), tf.Mechanics(dim=2), founders=crowd()
    )
    state = scene.bind(2).start()
    names = (
        "colony",
        "uid",
        "parent",
        "position",
        "axis",
        "length",
        "radius",
        "colony_id",
        "next_uid",
    )
    before = {n: getattr(state, n).clone() for n in names} | {
        n: v.clone() for n, v in state.fields.items()
    }
    after = state
    for _ in range(5):
        after = step(scene, after, 0.1)
    assert after.cells > state.cells and state.step == 0 and state.time == 0.0
    for name, value in before.items():
        assert torch.equal(getattr(state, name), value), (
            f"the step changed {name} of the state before"
        )


def test_timings_name_every_effect():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.0), tf.Mechanics(dim=2))
    timings = tf.Timings()
    step(scene, scene.bind().start(), 0.1, timings)
    assert list(timings.seconds) == ["division", "growth", "mechanics"] and all(
        s > 0 for s in timings.seconds.values()
    )


def test_an_effect_of_ones_own_is_a_dataclass_with_a_title_and_a_stage():
    @dataclass(frozen=True)
    class Ageing(tf.Effect):
        stage = 35

    @dataclass(frozen=True)
    class Placeless(tf.Effect):
        title = "placeless"

    class Plain(tf.Effect):
        stage, title = 35, "plain"

    with pytest.raises(
        tf.InputError, match=r"Plain is no dataclass: write @dataclass\(frozen=True"
    ):
        tf.Scene(Plain())
    with pytest.raises(tf.InputError, match="Ageing has no title: give the class one"):
        tf.Scene(Ageing())
    with pytest.raises(tf.InputError, match="Placeless has no stage: give the class one"):
        tf.Scene(Placeless())


def test_what_drives_what_is_said_once():
    scene = tf.scenes.quorum_sensing()
    scene.bind(1).start()  # what a rate function reads is known once it is tried
    told = scene.bind().drives()
    assert "transport -> circuit: out.ahl" in told and "circuit -> transport: out.ahl" in told
