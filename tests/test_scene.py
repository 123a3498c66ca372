"""The scene: order, couplings and bad input."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from founded import cells_in
from helpers import step

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


@pytest.mark.parametrize(
    "how, words",
    [
        ({"reads": ("growthrate",)}, r"reads\(\) names 'growthrate'.*mean 'growth_rate'"),
        ({"reads": ("volume",)}, r"names 'volume'.*Name 'length' and 'radius' instead"),
        ({"reads": ("heat",)}, r"'heat', which no effect of this scene declares.*declares\(\)"),
        ({"writes": ("lenght",)}, r"writes\(\) names 'lenght'.*Did you mean 'length'"),
        ({"reads": ("drag",)}, r"reads\(\) names 'drag'"),
    ],
)
def test_names_that_nothing_provides_are_refused_when_bound(how, words):
    scene = tf.Scene(named([], "mine", 15, **how), tf.Growth(rate=1.0), dim=2)
    with pytest.raises(tf.InputError, match=words):
        scene.bind()


def test_names_of_first_cells_rules_and_states_are_known():
    """A column of the first cells, a variable of a rule, a field that a rule may set later, and
    what a derived effect of torchfilm uses where it is there."""

    def update(cells):
        cells.heat = cells.length

    scene = tf.Scene(named([], "mine", 15, reads=("heat", "drag")), tf.Rules(update), dim=2)
    scene.bind()
    plain = tf.Scene(named([], "mine", 15, reads=("heat",)), tf.Growth(rate=1.0), dim=2)
    warm = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], extra={"heat": [1.0]})
    assert plain.bind(state=plain.bind(cells=warm).start()).effects

    class Pushing(tf.Mechanics):
        pass

    Pushing.__module__ = "mine"
    tf.Scene(Pushing(dim=2)).bind()


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
    assert text.index("Growth(") < text.index("Mechanics(") < text.index("Division(")


def test_repr_shows_the_effects():
    assert (
        repr(tf.Scene(tf.Growth(rate=1.0), name="mine")) == "Scene(Growth(rate=1.0), name='mine')"
    )


# --- bad scenes -----------------------------------------------------------------------------------


def test_an_empty_scene_is_refused():
    with pytest.raises(tf.InputError, match="no effect"):
        tf.Scene()


def test_missing_brackets_are_reported():
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


def test_a_needed_field_that_nobody_provides_is_reported():
    with pytest.raises(tf.InputError, match=r"sink needs the field 'heat'.*growth_rate"):
        tf.Scene(named([], "sink", 20, needs=("heat",)), tf.Growth(rate=1.0))


def test_a_needed_field_may_come_with_the_cells_or_be_built_in():
    cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], extra={"heat": [2.0]})
    scene = tf.Scene(named([], "sink", 20, needs=("heat", "position", "cells")), founders=cells)
    assert scene.bind().start().heat.tolist() == [2.0]


def test_founders_of_another_dimension_are_refused():
    with pytest.raises(tf.InputError, match=r"founders.*3-D"):
        tf.Scene(tf.Mechanics(dim=2), founders=cells_in(3))


@pytest.mark.parametrize("founders", [5, tf.Cells])
def test_founders_that_are_no_cells_are_refused(founders):
    with pytest.raises(tf.InputError, match=r"Scene\.founders = .*tf\.Cells\.single\(2\)"):
        tf.Scene(tf.Growth(rate=1.0), founders=founders)


def test_cells_of_another_dimension_are_refused():
    with pytest.raises(tf.InputError, match="2-D"):
        tf.Scene(tf.Mechanics(dim=2)).bind(cells=cells_in(3)).start()


@pytest.mark.parametrize("dt", [0.0, -1.0, float("nan"), "fast", True])
def test_a_bad_step_is_refused(dt):
    with pytest.raises(tf.InputError, match=r"Scene\.dt"):
        tf.Scene(tf.Growth(rate=1.0), dt=dt)


@pytest.mark.parametrize("colonies", [0, -1, 1.5, True, "two"])
def test_a_bad_number_of_colonies_is_refused(colonies):
    with pytest.raises(tf.InputError, match=r"colonies.*a whole number from 1"):
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
        pytest.skip("needs a machine without the device mps, a GPU of Apple")
    with pytest.raises(tf.InputError, match="device"):
        tf.Scene(tf.Growth(rate=1.0)).bind(device=device).start()


@pytest.mark.parametrize(
    "wall, hint",
    [
        (tf.Plane(y=-0.5, facing="-y"), r"inside out\? Turn it \(facing"),
        (tf.Plane(point=(0.0, 1.0), normal=(0.0, 1.0)), r"inside out\? Turn it \(facing"),
        (tf.Sphere((0.0, 0.0), 5.0, inside=False), r"inside out\? Change `inside`"),
        (tf.Sphere((20.0, 0.0), 5.0), r"inside out\? Change `inside`"),
        (tf.Box((1.0, -5.0), (9.0, 5.0)), "Move the cell, or the sides"),
        (tf.Channel(4.0, low_end=1.0), "Move the cell, or the sides"),
    ],
)
def test_a_cell_behind_a_wall_is_reported_before_anything_runs(wall, hint):
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, walls=[wall]))
    with pytest.raises(tf.InputError, match=rf"cell 0 of colony 0.*{hint}"):
        scene.bind().start()


@pytest.mark.parametrize(
    "walls",
    [
        [tf.Channel(0.9)],
        [tf.Plane(y=-0.4, facing="+y"), tf.Plane(y=0.5, facing="-y")],
        [tf.Box((-5.0, -0.1), (5.0, 0.8))],
    ],
    ids=["channel", "planes", "box"],
)
def test_walls_that_leave_no_room_for_a_cell_are_warned_of(walls):
    made = lambda of: tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, walls=of))
    with pytest.warns(UserWarning, match=r"0\.9 µm between two hard sides.* 1 µm wide"):
        made(walls).bind()
    made([tf.Channel(1.0)]).bind()
    made([tf.Channel(0.9, stiffness=1e6)]).bind()  # a soft wall may press


def test_division_without_growth_is_noticed():
    """No cell gets to a threshold: a run to a number of cells would never end."""
    effects = tf.Division(length=4.0), tf.Mechanics(dim=2)
    with pytest.raises(tf.InputError, match=r"cells = 50 is never reached.*tf\.Growth"):
        next(tf.simulate(tf.Scene(*effects), cells=50))
    with pytest.warns(UserWarning, match=r"no effect of this scene makes them longer"):
        next(tf.simulate(tf.Scene(*effects), until=1.0))
    next(tf.simulate(tf.Scene(tf.Growth(rate=1.0), *effects), until=1.0))
    flagged = tf.Rules(lambda cells: None)
    next(tf.simulate(tf.Scene(flagged, tf.Division(), tf.Mechanics(dim=2)), until=1.0))


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


def test_one_wall_instead_of_a_list_is_reported():
    with pytest.raises(tf.InputError, match="walls"):
        tf.Mechanics(dim=2, walls=tf.Plane(y=-1.0, facing="+y"))


def test_what_mechanics_decided_is_decided_anew_by_others():
    flat = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2))
    deep = flat.replace(tf.Growth(rate=1.0), tf.Mechanics(dim=3))
    assert (deep.dim, deep.founders.dim) == (3, 3)
    assert flat.replace(tf.Growth(rate=1.0)).dim == 2
    in_the_plane = r"3-D, as the mechanics are\. For cells in 2-D write Mechanics\(dim=2\)"
    with pytest.raises(tf.InputError, match=in_the_plane):
        tf.Scene(
            tf.Mechanics(dim=2), founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
        ).replace(tf.Mechanics(dim=3))  # fmt: skip


@pytest.mark.parametrize("dt", [-0.1, float("nan"), "a"])
def test_a_step_goes_forwards(dt):
    model = tf.Scene(tf.Growth(rate=1.0), dim=2).bind()
    with pytest.raises(tf.InputError, match=r"^dt = "):
        model.step(model.start(), dt)


@pytest.mark.parametrize("stage", [None, "late", True])
def test_a_stage_that_is_no_number_is_refused(stage):
    given = stage

    @dataclass(frozen=True)
    class Mine(Effect):
        stage, title = given, "mine"

    with pytest.raises(tf.InputError, match=r"Mine\.stage = .*a number"):
        tf.Scene(Mine())
