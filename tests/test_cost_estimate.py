"""The estimate of explain is the arithmetic that it claims to be, and says what it cannot know."""

from __future__ import annotations

import time
from dataclasses import dataclass

import pytest

import torchfilm as tf
from torchfilm.cost_estimate import (
    COLUMNS,
    ROWS,
    CostProbe,
    ProbeSteps,
    Spending,
    crowd,
    probe,
    state_bytes,
)
from torchfilm.tools.counting import Operators

BODY = (tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)), tf.Mechanics(dim=2))


def test_a_fit_gives_back_what_is_linear():
    """Time a + b · cells of a body, a + c · colonies of a grid: least squares of exact data are the
    data's own a, b, c."""
    medium = tf.Medium(ahl=tf.Signal(diffusion=10.0), box=((-32, -32), (32, 32)), spacing=8.0)
    scene = tf.Scene(*BODY, medium)
    truth = {
        "growth": (2e-5, 1e-8, 0.0),
        "mechanics": (1e-3, 2e-5, 0.0),
        "transport": (3e-4, 0.0, 2e-4),
        "grid coverage": (0.0, 0.0, 1e-5),
        "coverage of daughters": (5e-6, 0.0, 0.0),
        "division": (0.0, 0.0, 0.0),
    }
    blocks = [
        ProbeSteps(n, b, {t: x + y * n + z * b for t, (x, y, z) in truth.items()}, {})
        for n, b in ((32, 1), (40, 1), (256, 8), (300, 8), (420, 8))
    ]
    model = scene.bind()
    assert set(truth) == {e.title for e in model.effects}
    state = model.start()
    found = CostProbe(model, blocks, state, state, "", True, 1.0).fit("seconds")
    for title, expected in truth.items():
        cost = found[title]
        assert (cost.a, cost.b, cost.c) == pytest.approx(expected, rel=1e-6, abs=1e-12), title
    assert {t for t in truth if found[t].crowding} == {"mechanics"}


@pytest.mark.parametrize(("drag", "power"), [(None, 1.65), (10.0, 1.0)])
def test_contacts_of_large_colonies_in_free_growth_cost_more_a_cell(drag, power):
    model = tf.Scene(*BODY[:2], tf.Mechanics(dim=2, length_drag=drag)).bind()
    blocks = [ProbeSteps(n, 1, {e.title: 1e-5 * n for e in model.effects}, {}) for n in (32, 64)]
    state = model.start()
    costs = CostProbe(model, blocks, state, state, "", True, 1.0).fit("seconds")
    contacts, growth = costs["mechanics"], costs["growth"]
    assert contacts.crowd == state.cells
    assert contacts.of(1, 3) == pytest.approx(3e-5)
    for cost, wanted in ((contacts, power), (growth, 1.0)):
        ratio = cost.of(1e5, 2) / cost.of(1e4, 2)
        assert ratio == pytest.approx(10**wanted, rel=1e-6)


@pytest.mark.parametrize("drag", [None, 10.0])
def test_explain_says_by_which_power(drag):
    scene = tf.Scene(*BODY[:2], tf.Mechanics(dim=2, length_drag=drag))
    said = tf.explain(scene, cells=1000, seconds=0.05)
    assert ("contacts of larger colonies as their cells^1.65" in said) == (drag is None)


def test_a_run_is_predicted_from_the_pace_of_growth():
    """Nothing but dV/dt = V: a thousandfold takes ln(1000)/0.025 = 276.3 steps, whatever the
    machine."""
    said = tf.explain(tf.Scene(tf.Growth(rate=1.0)), cells=1000, seconds=0.01)
    assert "  a run    277 steps (6.93 h)" in said
    assert "  a run    0 steps" in tf.explain(tf.Scene(tf.Growth(rate=1.0)), cells=1, seconds=0.01)
    assert "no estimate: the probe did not grow" in tf.explain(
        tf.Scene(tf.Growth(rate=0.0)), seconds=0.01
    )
    leaving = tf.Removal(low=(-9.0,) * 3, high=(9.0,) * 3)
    open_box = tf.explain(tf.Scene(tf.Growth(rate=1.0), leaving), cells=1000, seconds=0.01)
    words = "Cells leave, so that colonies may never be so large"
    assert words in open_box and words not in said


@pytest.mark.parametrize("when", ["a step", "a division"])
def test_what_happens_once_is_not_measured(when):
    """As compiling does, the first step, or the first with a division, takes longer than all the
    others together."""
    waits = [1.0]

    @dataclass(frozen=True)
    class Once(tf.Effect):
        stage, title = 200, "once"

        def step(self, state, dt, values):
            if waits and (state.births or when == "a step"):
                time.sleep(waits.pop())
            return state

    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 3.6)
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.8), Once(), founders=founders)
    seen = probe(scene, 2, "cpu", 0.25)
    assert not waits and seen.seconds < 1.0 and seen.last.step > 5
    assert all(block.seconds["once"] < 0.5 for block in seen.blocks)


@pytest.mark.parametrize(
    "name", ["microcolony", "boundary_detector", "nutrient_limited", "programmed_growth", "channel"]
)
def test_an_estimate_has_all_its_parts_and_shares_that_add_up(name):
    said = tf.explain(tf.scenes.build(name), cells=300, colonies=4, seconds=0.05)
    assert (
        "estimated cost at 300 cells in each of 4 colonies, cpu, float32" in said
        and "warning" not in said
    )
    shares = (
        next(line for line in said.splitlines() if "a step   " in line).split(": ")[1].split(", ")
    )
    assert sum(float(share.split()[-2]) for share in shares) == pytest.approx(
        100, abs=0.5 * len(shares) + 0.5 * len(tf.scenes.build(name).effects)
    )
    assert f"from {ROWS * COLUMNS} cells laid side by side" in said


def test_where_there_is_no_room_the_founders_are_measured():
    small = tf.Medium(ahl=tf.Signal(diffusion=1.0), box=((-4.0, -4.0), (4.0, 4.0)), spacing=4.0)
    assert "s from the founders: at most" in tf.explain(tf.Scene(*BODY, small), seconds=0.05)


def test_a_probe_that_fails_says_why():
    hard = tf.Mechanics(dim=2, max_iterations=1, tolerance=1e-6)
    said = tf.explain(tf.Scene(tf.Growth(rate=2.0), hard, dt=0.1), seconds=0.05)
    assert "failed: the mechanics solve" in said


@pytest.mark.parametrize(
    "founders",
    [
        tf.Cells([[0.0, 0.0]], [[0.6, 0.8]]),
        tf.Cells([[3.0, 1.0, 0.5]], [[0.0, 0.0, 1.0]], 3.0, 0.4),
        tf.Cells(
            [[-1.5, 0.0], [1.5, 0.0]],
            [[1.0, 0.0], [1.0, 0.0]],
            [1.0, 2.0],
            cell_type=[0, 1],
            extra={"dye": [2.0, 5.0]},
        ),
        tf.Cells([[0.0, 0.0], [9.0, 9.0]], [[1.0, 0.0], [0.0, 1.0]], [1.0, 2.0], colony=[0, 1]),
    ],
    ids=["tilted", "upright", "two types", "two colonies"],
)
def test_a_crowd_does_not_overlap_and_is_like_its_founders(founders):
    laid = crowd(founders)
    assert laid.count == ROWS * COLUMNS and laid.overlaps(1e-9) == []
    first = 0 if founders.colony is None else founders.colony == 0
    middle = (
        founders.position.mean(0) if founders.colony is None else founders.position[first].mean(0)
    )
    assert laid.position.mean(0) == pytest.approx(middle, abs=1e-9)
    if founders.cell_type is not None:
        right = laid.position[:, 0] > 0
        assert (
            (laid.cell_type == right).all()
            and (laid.length == 1.0 + right).all()
            and (laid.extra["dye"] == 2.0 + 3.0 * right).all()
        )


@pytest.mark.parametrize("name", ["microcolony", "quorum_sensing"])
def test_bytes_of_a_state_are_those_of_its_tensors(name):
    scene = tf.scenes.build(name)
    state = scene.bind(3, cells=crowd(scene.founders)).start()
    cell, grid = state_bytes(state)
    names = ("colony", "uid", "parent", "position", "axis", "length", "radius")
    held = sum(getattr(state, n).nbytes for n in names) + sum(
        v.nbytes for v in state.fields.values()
    )
    assert cell * state.cells + grid * 3 == held and (grid > 0) == (name == "quorum_sensing")


def test_spending_is_what_the_operators_are():
    """The step with every effect counted apart, against the same step counted as a whole: nothing
    is left between effects but the step's own clock."""
    model = tf.scenes.quorum_sensing().bind()
    # a model keeps its numbers as kernels take them, and a state what was worked out of it
    model.step(model.start())
    one, other, spent = model.start(), model.start(), Spending()
    with Operators() as seen:
        model.step(one)
    model.step(other, timings=spent)
    assert seen.total == sum(c.total() for c in spent.calls.values()) and seen.bytes == sum(
        spent.bytes.values()
    )
    assert list(spent.calls) == list(dict.fromkeys(e.title for e in model.effects))
