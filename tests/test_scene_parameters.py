"""Parameters of a ready-made scene: every form of a value is recorded, read back and typed."""

import json

import pytest

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
