"""Nothing runs that a scene does not ask for, and a step leaves the state before alone."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import pytest
import torch
from founded import cells_in, crowd
from helpers import step
from torch.utils._python_dispatch import TorchDispatchMode

import torchfilm as tf
from torchfilm import rule_surroundings
from torchfilm.effect import Effect


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
    # by torch: what kernels do is no operator
    contacts = tf.Mechanics(dim=2, backend="torch")
    assert heavy(operators(tf.Growth(rate=1.0), contacts)), "this test must be able to see them"


def test_rules_that_do_not_ask_for_contacts_do_not_pay_for_them(monkeypatch):
    found, search = [], rule_surroundings.pairs_within
    monkeypatch.setattr(
        rule_surroundings, "pairs_within", lambda *given: found.append(1) or search(*given)
    )
    assert not heavy(operators(tf.Rules(lambda cells: setattr(cells, "big", cells.volume > 3))))
    assert not found
    assert not heavy(
        operators(tf.Rules(lambda cells: setattr(cells, "near", cells.contact_count())))
    )
    assert found


def test_an_effect_that_is_not_listed_leaves_no_field_and_no_report():
    state = tf.Scene(tf.Growth(rate=1.0)).bind().start()
    assert set(state.fields) == {"growth_rate", "elongation"} and not state.reports
    assert set(tf.Scene(tf.Division(length=3.0)).bind().start().fields) == {
        "divide_flag",
        "division_threshold",
    }
    # only one-sided contacts follow their force
    of_force = {"contact_alpha", "compression"}
    for contacts, own in (("one-sided", of_force), ("bilateral", set())):
        scene = tf.Scene(tf.Mechanics(dim=2, contacts=contacts))
        assert set(scene.bind().start().fields) == {"displacement", "collapsed_steps", *own}
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
    assert list(timings.seconds) == ["growth", "mechanics", "division"] and all(
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
