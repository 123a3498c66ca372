"""The names of types of cells: given to a scene, kept in its files, shown in pictures."""

from __future__ import annotations

import json

import h5py
import pytest

import torchfilm as tf
from torchfilm import pictures

matplotlib = pytest.importorskip("matplotlib")
from matplotlib.text import Text  # noqa: E402

NAMES = ("wild type", r"lacZ $\x$")  # no mathematics that can be drawn


def mixed(names=NAMES, types=(0, 1, 2)):
    cells = tf.Cells(
        [[6.0 * k, 0.0] for k in range(len(types))], [[0.0, 1.0]] * len(types), 2.0,
        cell_type=list(types),
    )  # fmt: skip
    return tf.Scene(
        tf.Growth(rate=0.5), tf.Mechanics(dim=2), founders=cells, dt=0.1, type_names=names
    )


def words(figure):
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def test_legends_have_the_names_of_types(tmp_path):
    path = tmp_path / "run.h5"
    state = tf.simulate(mixed(), until=0.3, record=path).last()
    with tf.Results(path) as results:
        assert results.type_names == list(NAMES)
    for picture in (tf.show(path), tf.show(state, scene=mixed()), pictures.strip(path)):
        seen = set(words(picture.figure))
        assert {*NAMES, "2"} <= seen and not {"0", "1"} & seen
        picture.save(tmp_path / "picture.png")
    course = pictures.time_course(path, by="cell_type")
    assert {*NAMES, "cell_type 2"} <= set(words(course.figure))
    course.save(tmp_path / "course.png")
    tf.show(state)  # which has no scene, and so no names
    assert f"types 0 wild type, 1 {NAMES[1]}" in str(tf.explain(mixed()))


def test_names_of_other_whole_numbers_are_not_those_of_types(tmp_path):
    cells = tf.Cells(
        [[0.0, 0.0], [6.0, 0.0]], [[0.0, 1.0]] * 2, 2.0, cell_type=[0, 0], extra={"ploidy": [0, 1]}
    )
    scene = mixed().replace(founders=cells)
    tf.simulate(scene, until=0.2, record=tmp_path / "run.h5").last()
    shown = words(tf.show(tmp_path / "run.h5", colour="ploidy").figure)
    assert not set(NAMES) & set(shown)


def test_names_that_do_not_fit_on_a_page_are_numbers():
    long = tuple(f"a strain with quite a long name, {k}" for k in range(6))
    scene = mixed(long, range(6))
    state = scene.bind().start()
    seen = words(tf.show(state, scene=scene).figure)
    assert not set(long) & set(seen) and set("012345") <= set(seen)


def test_names_change_nothing_that_is_simulated():
    scene = mixed()
    assert scene == mixed(()) and scene.replace(dt=0.05).type_names == NAMES
    assert scene.replace(type_names=["a"]).type_names == ("a",)


@pytest.mark.parametrize(
    ("names", "what"),
    [
        ("wild", r"Scene\.type_names = 'wild'.*names of the types"),
        ({0: "wild"}, r"Scene\.type_names = .*names of the types"),
        (["a", ""], r"Scene\.type_names\[1\] = ''.*a name"),
        (["a", 1], r"Scene\.type_names\[1\] = 1.*a name"),
        (["a", "a"], r"Scene\.type_names\[1\] = 'a'.*another name"),
    ],
)
def test_names_that_are_none_are_refused(names, what):
    with pytest.raises(tf.InputError, match=what):
        mixed(names)


def test_names_without_types_are_refused():
    with pytest.raises(tf.InputError, match="the founders have no cell_type"):
        tf.Scene(tf.Growth(rate=0.5), dim=2, type_names=["a"])


def test_a_file_with_names_of_another_kind_is_damaged(tmp_path):
    path = tmp_path / "run.h5"
    tf.simulate(mixed(), until=0.1, record=path).last()
    with h5py.File(path, "r+") as file:
        assert json.loads(file.attrs["type_names"]) == list(NAMES)
        file.attrs["type_names"] = json.dumps([1, 2])
    with pytest.raises(tf.InputError, match="its 'type_names' is not what torchfilm writes"):
        tf.Results(path)


def test_a_file_of_an_earlier_version_has_no_names(tmp_path):
    path = tmp_path / "run.h5"
    tf.simulate(mixed(), until=0.1, record=path).last()
    with h5py.File(path, "r+") as file:
        del file.attrs["type_names"]
    with tf.Results(path) as results:
        assert results.type_names == []
    assert "0" in words(tf.show(path).figure)
