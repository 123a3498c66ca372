"""What a step of an effect of the user's own may do to a state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
import torch
from helpers import step

import torchfilm as tf


@dataclass(frozen=True, eq=False)
class Mine(tf.Effect):
    act: Any = None
    names: tuple[str, ...] = ("growth_rate",)

    stage = 27
    title = "mine"

    def writes(self):
        return self.names

    def step(self, state, dt, values):
        return self.act(state)


def run(act, names=("growth_rate",)) -> tf.State:
    scene = tf.Scene(Mine(act, names), tf.Growth(), dim=2)
    return step(scene, scene.bind(2).start(), 0.025)


@pytest.mark.parametrize("dtype", [torch.float64, torch.int64, torch.bool])
def test_another_type_of_numbers(dtype):
    other = lambda s: torch.ones(s.cells, dtype=dtype)
    wrong = lambda s: s.replace(fields={**s.fields, "growth_rate": other(s)})
    with pytest.raises(tf.InputError, match=r"Mine\.step gave 'growth_rate' as .* it is float32"):
        run(wrong)


def test_a_change_in_place():
    """Earlier states have the same tensor."""

    def act(state):
        state.growth_rate.add_(1.0)
        return state

    with pytest.raises(tf.InputError, match=r"Mine\.step changed 'growth_rate' in place"):
        run(act)


@pytest.mark.parametrize("names", [(), ("growth_rate",)])
def test_a_change_that_writes_does_not_name(names):
    longer = lambda s: s.replace(length=s.length * 1.1)
    with pytest.raises(tf.InputError, match=r"changed 'length', which its writes\(\) does not"):
        run(longer, names)
    again = lambda s: s.replace(length=s.length.clone())  # the same numbers
    assert run(again, names).length.tolist() == [2.0, 2.0]


@pytest.mark.parametrize(("given", "shown"), [(None, "None"), (3, "a int")])
def test_what_is_no_state(given, shown):
    with pytest.raises(TypeError, match=f"must return the state; it returned {shown}"):
        run(lambda s: given)


def test_what_it_may_do():
    """Also remove cells, if it says so."""
    faster = run(lambda s: s.with_fields(growth_rate=s.growth_rate + 1.0))
    assert faster.growth_rate.tolist() == [1.0, 1.0]
    fewer = run(lambda s: s.remove(s.colony == 0, "removed"), ("cells",))
    assert fewer.counts.tolist() == [0, 1]


@pytest.mark.parametrize("name", ["uid", "parent", "colony_id", "stream", "next_uid"])
def test_what_tells_cells_and_colonies_apart_stays(name):
    changed = lambda s: s.replace(**{name: getattr(s, name) + 1})
    with pytest.raises(tf.InputError, match=f"changed '{name}', which its writes"):
        run(changed)
    in_place = lambda s: (getattr(s, name).add_(3), s)[1]
    with pytest.raises(tf.InputError, match=f"changed '{name}' in place"):
        run(in_place)


def test_a_field_that_is_left_out():
    fewer = lambda s: s.replace(fields={n: x for n, x in s.fields.items() if n != "growth_rate"})
    with pytest.raises(tf.InputError, match="left the field 'growth_rate' out"):
        run(fewer)


def test_it_runs_in_inference_mode():
    with torch.inference_mode():
        found = run(lambda s: s.with_fields(growth_rate=s.growth_rate + 1.0))
    assert found.growth_rate.tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("name", "change", "shape"),
    [
        ("axis", lambda x: x[:1], r"\(1, 2\): it must be \(2, 2\), one value for each cell"),
        ("length", lambda x: x[:, None], r"\(2, 1\): it must be \(2,\)"),
        ("length", lambda x: x.max(), r"\(\): it must be \(2,\)"),
    ],
)
@pytest.mark.parametrize("cells", [False, True])
def test_columns_of_another_shape(name, change, shape, cells):
    """Kernels read beyond them: the process crashed, or went on with what lay there."""
    wrong = lambda s: s.replace(**{name: change(getattr(s, name))})
    with pytest.raises(tf.InputError, match=rf"Mine\.step gave '{name}' of shape {shape}"):
        run(wrong, ("cells",) if cells else (name,))


def test_a_column_that_is_no_tensor_and_a_field_of_another_shape():
    with pytest.raises(tf.InputError, match=r"Mine\.step gave 'length' as a ndarray, not a tensor"):
        run(lambda s: s.replace(length=s.length.numpy()), ("length",))
    short = lambda s: s.replace(fields={**s.fields, "growth_rate": s.growth_rate[:1]})
    with pytest.raises(tf.InputError, match=r"shape of the field 'growth_rate' = \(1,\)"):
        run(short)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: {"axis": s.axis[:1]}, r"state\.axis = '\(1, 2\).*of shape \(2, 2\)"),
        (lambda s: {"length": s.length[:, None]}, r"state\.length = '\(2, 1\).*of shape \(2,\)"),
        (lambda s: {"length": s.length.numpy()}, r"state\.length = .*must be a tensor"),
        (lambda s: {"position": s.position.tolist()}, r"state\.position = .*must be a tensor"),
        (lambda s: {"uid": s.uid[:1]}, r"state\.uid = '\(1,\)"),
        (lambda s: {"parent": s.parent[:1]}, r"state\.parent = '\(1,\)"),
    ],
)
def test_a_step_takes_no_state_with_columns_of_another_shape(change, message):
    model = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2)).bind(2)
    state = model.start()
    with pytest.raises(tf.InputError, match=message):
        model.step(state.replace(**change(state)))


def test_cell_types_that_founders_bring_may_be_needed():
    @dataclass(frozen=True)
    class Typed(tf.Effect):
        title, stage = "typed", 15

        def needs(self):
            return ["cell_type"]

        def step(self, state, dt, values):
            return state

    two = tf.Cells([[0.0, 0.0], [5.0, 0.0]], [[1.0, 0.0]] * 2, cell_type=[0, 1])
    by_type = tf.Growth(rate={0: 1.0, 1: 2.0})
    for scene in (
        tf.Scene(Typed(), tf.Growth(rate=1.0), founders=two),
        tf.Scene(Typed(), by_type, dim=2),
    ):
        model = scene.bind()
        assert model.step(model.start(), 0.1).cell_type.dtype == torch.int64
    with pytest.raises(tf.InputError, match="typed needs the field 'cell_type'"):
        tf.Scene(Typed(), tf.Growth(rate=1.0), dim=2)


def test_fewer_rows_of_what_is_not_changed():
    """A step that says it changes cells, and leaves out but one of their columns."""
    with pytest.raises(tf.InputError, match=r"gave 'uid' of shape \(2,\): it must be \(1,\)"):
        run(lambda s: s.replace(colony=s.colony[:1]), ("cells",))
    with pytest.raises(tf.InputError, match=r"gave 'next_uid' of shape \(1,\).*for each colony"):
        run(lambda s: s.replace(next_uid=s.next_uid[:1]), ("cells",))
