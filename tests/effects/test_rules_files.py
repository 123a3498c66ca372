"""Rules from a file, edited while a run is going."""

from __future__ import annotations

import os

import pytest
import torch
from ruled import pair_of_cells
from ruled import run as run_scene

import torchfilm as tf
from torchfilm.tools.hot_reload import HotReload


@pytest.fixture
def rules_file(tmp_path):
    path = tmp_path / "my_rules.py"
    path.write_text("def update(cells):\n    cells.growth_rate = 1.0\n")
    return path


def watched(path, *effects: tf.Effect) -> tuple[HotReload, tf.Model]:
    """A model of the rules in a file, and the functions that are loaded again after an edit."""
    scene = tf.Scene(tf.Rules(path), *(effects or (tf.Growth(),)), founders=pair_of_cells())
    model = scene.bind()
    (source,) = {e.hot_reload for e in model.effects if e.hot_reload is not None}
    source.watching = True
    return source, model


def run(model: tf.Model, state: tf.State, steps: int) -> tf.State:
    for _ in range(steps):
        state = model.step(state, 0.1)
    return state


def test_rules_from_a_file(rules_file):
    for given in (rules_file, str(rules_file)):
        scene = tf.Scene(tf.Rules(given), tf.Growth(), founders=pair_of_cells())
        assert run_scene(scene, scene.bind().start(), 1).growth_rate.tolist() == [1.0, 1.0]


def test_a_rules_file_may_define_dataclasses(rules_file):
    rules_file.write_text(
        "from dataclasses import dataclass\n\n@dataclass\nclass P:\n    rate: float = 0.5\n\ndef"
        " update(cells):\n    cells.growth_rate = P().rate\n"
    )
    scene = tf.Scene(tf.Rules(rules_file), tf.Growth(), founders=pair_of_cells())
    assert run_scene(scene, scene.bind().start(), 1).growth_rate.tolist() == [0.5, 0.5]


def test_an_edit_takes_effect_at_the_next_step(rules_file):
    source, model = watched(rules_file)
    rates = []
    for state in tf.simulate(model, model.start(), until=0.6, dt=0.1):
        rates.append(float(state.growth_rate[0]))
        if state.step == 3:
            rules_file.write_text("def update(cells):\n    cells.growth_rate = 2.0\n")
    assert rates == [1.0, 1.0, 1.0, 2.0, 2.0, 2.0]
    assert source.messages == ["t = 0.3 h: my_rules.py reloaded"], (
        "it was the step from 0.3 to 0.4 h that first ran the new rules"
    )


def test_without_watching_an_edit_waits(rules_file):
    source, model = watched(rules_file)
    source.watching = False
    state = run(model, model.start(), 1)
    rules_file.write_text("def update(cells):\n    cells.growth_rate = 2.0\n")
    assert run(model, state, 2).growth_rate.tolist() == [1.0, 1.0] and not source.messages


BROKEN = {
    "syntax": ("def update(cells)\n    pass\n", "SyntaxError"),
    "unknown name": ("def update(cells):\n    cells.growth_rate = speed\n", "NameError"),
    "unknown field": ("def update(cells):\n    cells.growth_rate = cells.groth\n", "groth"),
    "wrong shape": (
        "import torch\ndef update(cells):\n    cells.growth_rate = torch.ones(99)\n",
        "growth_rate",
    ),
    "read only": ("def update(cells):\n    cells.length = 3.0\n", "can only be read"),
    "new variable": ("def update(cells):\n    cells.fresh = 3.0\n", "fresh"),
    "empty": ("", "neither"),
    "on import": ("raise RuntimeError('no luck')\n", "no luck"),
}


@pytest.mark.parametrize("kind", list(BROKEN))
def test_a_broken_edit_is_reported_and_the_run_goes_on_with_the_last_good_one(rules_file, kind):
    text, word = BROKEN[kind]
    source, model = watched(rules_file)
    state = run(model, model.start(), 2)
    rules_file.write_text(text)
    state = run(model, state, 3)
    assert state.growth_rate.tolist() == [1.0, 1.0] and state.step == 5
    (message,) = source.messages
    assert message.startswith("t = 0.2 h: my_rules.py is broken") and word in message, message
    rules_file.write_text("def update(cells):\n    cells.growth_rate = 3.0\n")
    assert run(model, state, 1).growth_rate.tolist() == [3.0, 3.0], "a repaired file must be used"
    assert len(source.messages) == 2


def test_an_edit_between_the_making_of_a_scene_and_its_binding_is_taken_up(rules_file):
    scene = tf.Scene(tf.Rules(rules_file), tf.Growth(), founders=pair_of_cells())
    stamp = rules_file.stat().st_mtime_ns + 10**9
    rules_file.write_text("def update(cells):\n    cells.growth_rate = 2.0\n")
    os.utime(rules_file, ns=(stamp, stamp))
    model = scene.bind()
    for effect in model.effects:
        if effect.hot_reload is not None:
            effect.hot_reload.watching = True
    assert run(model, model.start(), 1).growth_rate.tolist() == [2.0, 2.0]


def test_models_of_one_scene_are_watched_apart(rules_file):
    source, model = watched(rules_file)
    other = model.scene.bind()
    state, apart = run(model, model.start(), 1), run(other, other.start(), 1)
    rules_file.write_text("def update(cells):\n    cells.growth_rate = 2.0\n")
    assert run(model, state, 1).growth_rate.tolist() == [2.0, 2.0] and source.messages
    assert run(other, apart, 1).growth_rate.tolist() == [1.0, 1.0]


def test_a_file_that_is_gone_for_a_moment_is_no_error(rules_file):
    _, model = watched(rules_file)
    state = run(model, model.start(), 1)
    rules_file.unlink()
    state = run(model, state, 1)
    rules_file.write_text("def update(cells):\n    cells.growth_rate = 2.0\n")
    assert run(model, state, 1).growth_rate.tolist() == [2.0, 2.0]


def test_a_file_that_is_still_being_written_is_left_until_it_is_whole(rules_file, monkeypatch):
    """Whether the rest comes with a later time of edit, or within the same tick of the clock."""
    source, model = watched(rules_file)
    state = run(model, model.start(), 1)
    for later in (0, 10**9):
        rules_file.write_text("")
        stamp = rules_file.stat().st_mtime_ns

        def finish(_, stamp=stamp + later):
            rules_file.write_text("def update(cells):\n    cells.growth_rate = 2.0\n")
            os.utime(rules_file, ns=(stamp, stamp))

        monkeypatch.setattr("torchfilm.tools.hot_reload.time.sleep", finish)
        state = run(model, state, 1)
        assert not source.messages
        state = run(model, state, 1)
        assert state.growth_rate.tolist() == [2.0, 2.0]
        assert [message.split()[-1] for message in source.messages] == ["reloaded"]
        source.messages.clear()


def test_an_edit_that_breaks_only_later_does_not_end_the_run(rules_file):
    """It passes when it is taken up and fails two steps after: the last good rules must carry
    on."""
    source, model = watched(rules_file)
    state = run(model, model.start(), 1)
    rules_file.write_text(
        "def update(cells):\n    cells.growth_rate = 2.0 if cells.time < 0.25 else speed\n"
    )
    state = run(model, state, 5)
    assert state.step == 6
    assert any("t = 0.3 h" in m and "broken" in m and "speed" in m for m in source.messages)


SETS_TYPE = "def update(cells):\n    cells.cell_type = cells.uid % 2\n"
IN_PLACE = "def update(cells):\n    rate = cells.growth_rate\n    rate *= 3.0\n"


@pytest.mark.parametrize("edit", ["def update(cells):\n    cells.growth_rate = 2.0\n", IN_PLACE])
def test_an_edit_is_checked_against_the_other_effects_as_at_binding(rules_file, edit):
    """Growth by cell type would undo what the new rule sets."""
    rules_file.write_text(SETS_TYPE)
    source, model = watched(rules_file, tf.Growth(rate={0: 1.0, 1: 0.5}))
    state = run(model, model.start(), 2)
    rules_file.write_text(edit)
    state = run(model, state, 2)
    (message,) = source.messages
    assert "rules sets growth_rate, but Growth.rate" in message and "last good rules" in message
    assert state.growth_rate.tolist() == [1.0, 0.5]
    assert [e.writes() for e in model.effects if e.title == "rules"] == [("cell_type",)]
    rules_file.write_text(SETS_TYPE.replace("% 2", "* 0"))
    assert run(model, state, 1).growth_rate.tolist() == [1.0, 1.0] and len(source.messages) == 2


def test_an_edit_that_sets_the_rate_beside_growths_own_is_warned_of(rules_file):
    rules_file.write_text(SETS_TYPE)
    _, model = watched(rules_file, tf.Growth(rate=1.0))
    state = run(model, model.start(), 2)
    rules_file.write_text("def update(cells):\n    cells.growth_rate = 2.0\n")
    with pytest.warns(UserWarning, match=r"Growth\.rate and rules each set growth_rate") as told:
        state = run(model, state, 3)
    assert len(told) == 1 and state.growth_rate.tolist() == [2.0, 2.0]


def test_a_branch_that_was_not_tried_is_checked_as_at_binding():
    def update(cells):
        cells.cell_type = cells.uid % 2
        if cells.time > 0.15:
            cells.growth_rate = 2.0

    scene = tf.Scene(tf.Rules(update), tf.Growth(rate={0: 1.0, 1: 0.5}), founders=pair_of_cells())
    model = scene.bind()
    state = run(model, model.start(), 2)
    with pytest.raises(tf.InputError, match=r"rules sets growth_rate, but Growth\.rate"):
        model.step(state, 0.1)


def test_an_edit_that_gives_a_bad_value_is_undone(rules_file):
    source, model = watched(rules_file)
    state = run(model, model.start(), 2)
    rules_file.write_text("def update(cells):\n    cells.growth_rate = -cells.uid.float()\n")
    state = run(model, state, 2)
    assert state.growth_rate.tolist() == [1.0, 1.0] and not state.reports
    (message,) = source.messages
    assert "colony 0: cells.growth_rate of cell 1 was set to -1" in message


DIVIDE = "def divide(parent, daughter1, daughter2):\n    daughter1.growth_rate = {}\n"


def grow_and_divide(path) -> tuple[HotReload, tf.Model, tf.State]:
    source, model = watched(path, tf.Growth(rate=1.0), tf.Division())
    return source, model, model.start()


def flagged(state: tf.State) -> tf.State:
    return state.with_fields(
        divide_flag=torch.ones_like(state.divide_flag),
        growth_rate=torch.ones_like(state.growth_rate),
    )


def test_divide_in_a_file_and_its_edit(rules_file):
    rules_file.write_text(DIVIDE.format(5.0))
    _, model, state = grow_and_divide(rules_file)
    state = model.step(flagged(state), 0.1)
    assert state.growth_rate.tolist() == [5.0, 1.0] * 2
    rules_file.write_text(DIVIDE.format(6.0))
    long_enough = flagged(state).replace(length=torch.full_like(state.length, 3.0))
    assert model.step(long_enough, 0.1).growth_rate.tolist() == [6.0, 1.0] * 4


def test_a_broken_divide_is_reported_and_the_run_goes_on(rules_file):
    rules_file.write_text(DIVIDE.format(5.0))
    source, model, state = grow_and_divide(rules_file)
    rules_file.write_text(DIVIDE.format("speed"))
    state = model.step(flagged(state.replace(time=1.5)), 0.1)
    assert state.growth_rate.tolist() == [5.0, 1.0] * 2
    assert any("t = 1.5 h" in m and "broken" in m and "speed" in m for m in source.messages)
