"""Parameters of a ready-made scene: every form of a value is recorded, read back and typed."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm import scenes
from torchfilm.cli.scene_files import parse_setting

FORMS = {
    "a number": 0.002,
    "a list": [0.001, 0.002],
    "per colony": tf.PerColony([0.001, 0.002]),
    "by type": {0: 0.0, 1: 0.001},
    "a distribution": tf.LogNormal(0.001, 0.1),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_recorded_parameter_builds_the_same_scene_again(form):
    first = scenes.boundary_detector(d3=FORMS[form])
    name, parameters = json.loads(json.dumps(first.recipe))
    assert scenes.build(name, parameters).code == first.code
    assert first.code != scenes.boundary_detector(d3=0.5).code


@pytest.mark.parametrize(
    "text, value",
    [
        ("1e-3", 1e-3),
        ("{0: 0.0, 1: 0.001}", {0: 0.0, 1: 0.001}),
        ("PerColony([0, 0.001])", tf.PerColony([0, 0.001])),
        ("tf.PerColony([0, 0.001])", tf.PerColony([0, 0.001])),
        ("LogNormal(1.0, 0.1)", tf.LogNormal(1.0, 0.1)),
        ("Uniform(low=0.5, high=1.5)", tf.Uniform(low=0.5, high=1.5)),
        ("a word", "a word"),
        ("__import__('os').getcwd()", "__import__('os').getcwd()"),
    ],
)
def test_a_typed_parameter_is_read_without_running_it(text, value):
    name, parsed = parse_setting(f"d3={text}")
    assert (name, type(parsed), repr(parsed)) == ("d3", type(value), repr(value))


def test_a_parameter_with_an_impossible_value_names_it():
    with pytest.raises(tf.InputError, match=r"Foo\(1\)"):
        scenes.build("microcolony", dict([parse_setting("rate=Foo(1)")]))


@pytest.mark.parametrize(
    "effect",
    [
        tf.Removal((-5.0, -5.0), ([5.0, 6.0], 9.0)),
        tf.Growth(rate=tf.LogNormal([1.0, 2.0], 0.1)),
        tf.Mechanics([tf.Plane(x=-3.0, facing="+x", stiffness=tf.PerColony([1.0, 2.0]))], dim=2),
    ],
    ids=["a corner", "a median", "stated"],
)
def test_a_list_that_can_only_be_per_colony_is_taken_so(effect):
    founders = tf.Cells(
        [[0.0, 0.0], [0.0, 3.0]], [[1.0, 0.0]] * 2, length=2.0, radius=0.5, cell_type=[0, 1]
    )
    others = [] if isinstance(effect, tf.Mechanics) else [tf.Mechanics(dim=2)]
    scene = tf.Scene(effect, *others, founders=founders)
    assert scene.bind(colonies=2).start().cells == 4


def test_a_state_goes_on_with_the_values_of_the_scene_that_steps_it():
    def growing(low, high):
        return tf.Scene(tf.Growth(rate=tf.Uniform(low, high)), tf.Division(length=3.0), dim=2)

    *_, first = tf.simulate(growing(1.0, 1.1), until=0.5, dt=0.02)
    *_, last = tf.simulate(growing(2.0, 2.1), first, until=2.0, dt=0.02)
    assert last.cells >= 4 and bool((last.growth_rate >= 2.0).all())


def test_a_rate_by_type_needs_no_typed_founders():
    scene = tf.Scene(tf.Growth(rate={0: 1.0, 1: 0.5}), dim=2)
    assert scene.bind().start().growth_rate.tolist() == [1.0]
    with pytest.raises(tf.InputError, match="a cell has type 0"):
        tf.Scene(tf.Growth(rate={1: 0.5}), dim=2).bind()


def test_an_effect_that_makes_a_field_of_another_length_is_named():
    @dataclasses.dataclass(frozen=True)
    class Age(tf.Effect):
        title, stage = "ageing", 15

        def declares(self, dim):
            return [tf.Field("age", "time since birth", "h")]

        def writes(self):
            return ("age",)

        def step(self, state, dt, values):
            return state.with_fields(age=torch.ones(7))

    model = tf.Scene(tf.Growth(rate=1.0), Age(), dim=2).bind()
    with pytest.raises(tf.InputError, match=r"field 'age' = \(7,\).*each cell"):
        model.step(model.start())


@dataclasses.dataclass(frozen=True, eq=False)
class OwnChecks(tf.Effect):
    """A user's effect with checks of its own, which does not call those of its base."""

    k: float = tf.physical(1.0, unit="1/h", least=0.0)
    most: float = 10.0

    stage = 35
    title = "own checks"

    def __post_init__(self):
        if tf.values.largest(self.k) > self.most:
            raise ValueError("too fast")

    def step(self, state, dt, values):
        return state


def test_values_are_checked_before_the_checks_of_ones_own():
    with pytest.raises(tf.InputError, match=r"OwnChecks\.k = -3\.0"):
        OwnChecks(k=-3.0)
    with pytest.raises(ValueError, match="too fast"):
        OwnChecks(k=[1.0, 20.0])
    scene = tf.Scene(tf.Growth(), OwnChecks(k=[1.0, 2.0]), dim=2)
    with pytest.raises(tf.InputError, match=r"OwnChecks\.k has 2 values"):
        scene.bind(1)
    model = scene.bind(2)
    assert model.effects[-1].values.k.of_cells(model.start()).tolist() == [1.0, 2.0]


@dataclasses.dataclass(frozen=True, eq=False)
class WithInitVar(tf.Effect):
    """A user's effect with an argument that is no field."""

    k: float = tf.physical(1.0, least=0.0)
    scale: dataclasses.InitVar[float] = 2.0

    stage = 35
    title = "scaled"

    def __post_init__(self, scale):
        object.__setattr__(self, "k", self.k * scale)


def test_arguments_that_are_no_fields_reach_the_effects_own_checks():
    assert WithInitVar(k=3.0).k == 6.0
    with pytest.raises(tf.InputError, match=r"WithInitVar\.k = -1\.0"):
        WithInitVar(k=-1.0)


def test_numbers_of_numpy_are_kept_as_pythons(tmp_path):
    given = tf.Mechanics(dim=2, passes=np.int64(3), tolerance=np.float32(0.25))
    assert given == tf.Mechanics(dim=2, passes=3, tolerance=0.25)
    assert (type(given.passes), type(given.tolerance)) == (int, float)
    tf.Settings(passes=np.int64(3), rtol=np.float64(1e-3)).save(tmp_path / "settings.json")
    assert tf.Settings.load(tmp_path / "settings.json").passes == 3
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2)
    assert scene.bind(np.int64(2), seed=np.int32(5)).start().seed == 5
    with pytest.raises(tf.InputError, match=r"colonies = True.*whole number"):
        scene.bind(True)
