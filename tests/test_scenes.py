"""The ready scenes: each runs, can be rebuilt from its recipe, and shows its behaviour."""

from __future__ import annotations

import inspect
import json
import math
import re

import numpy as np
import pytest
import torch
from helpers import step

import torchfilm as tf
from torchfilm.scenes import READY, build

SMALL = {
    "microcolony": {},
    "microcolony 3-D": {"dim": 3},
    "microcolony by length": {"law": "length", "rate": [0.8, 1.2]},
    "programmed_growth": {"edge": 3.0},
    "channel": {"width": 5.0, "length": 20.0},
    "channel closed": {"width": 5.0, "length": 20.0, "open_ended": False},
    "quorum_sensing": {"k3": [0.5, 2.0], "size": 64.0},
    "boundary_detector": {"d3": [0.0, 1e-3]},
    "boundary_detector under flow": {"flow": 5.0},
    "synchronized_lysis": {"threshold": [2.0, 4.0], "half": 0.01, "lysis_rate": 1.0},
    "strain_sorting": {"strength": [0.0, 300.0], "cells": 40, "chamber": 10.0},
    "random_partition": {},
    "repressilator": {"alpha": [216.0, 100.0], "noise": False, "rate": 1.0},
    "toggle_switch": {"strength": [10.0, 12.0], "speed": 2, "molecules_per_unit": 2.0, "rate": 1.0},
    "nutrient_limited": {"supply": [1.0, 2.0], "size": 48.0},
    "biofilm": {"supply": [1.0, 2.0], "width": 20.0, "height": 30.0, "first": 2},
}


def run(scene: tf.Scene, state: tf.State, until: float) -> tf.State:
    for state in tf.simulate(scene, state, until=until):  # noqa: B007, B020
        pass
    return state


def small(kind: str) -> tf.Scene:
    return build(kind.split()[0], SMALL[kind])


def test_every_ready_scene_is_tested_here():
    assert {kind.split()[0] for kind in SMALL} == set(READY)


@pytest.mark.parametrize("kind", list(SMALL))
def test_it_runs_and_its_recipe_builds_it_again(kind):
    """The recipe, through JSON as in a results file, gives the same run bit for bit."""
    scene = small(kind)
    again = build(*json.loads(json.dumps(scene.recipe)))
    assert scene.name == again.name == kind.split()[0]
    a, b = (run(s, s.bind(2, seed=1, per_colony=True).start(), 3.0) for s in (scene, again))
    assert (a.counts >= 4).all() and torch.isfinite(a.position).all()
    for name in ("uid", "position", "axis", "length", *a.fields):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


@pytest.mark.parametrize("kind", list(SMALL))
def test_it_explains_itself(kind):
    scene = small(kind)
    moves = "motility" if kind == "strain_sorting" else "growth"
    assert f"{moves} -> mechanics" in scene.bind(2, per_colony=True).describe()
    assert len(READY[kind.split()[0]].__doc__) > 60


def test_unknown_scenes_and_parameters_are_reported():
    with pytest.raises(
        tf.InputError, match=r"'macrocolony'.*microcolony, programmed_growth, channel"
    ):
        build("macrocolony")
    with pytest.raises(tf.InputError, match=r"'speed'.*rate"):
        build("microcolony", {"speed": 2})


# --- microcolony ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_microcolony_in_the_plane_is_round():
    scene = tf.scenes.microcolony()
    state = run(scene, scene.bind(3).start(), 6.0)
    assert (state.counts > 80).all()
    overlap = tf.measure.overlaps(state)
    assert float(overlap.mean.max()) < 0.05, "µm; the default α is meant for about 0.01"
    for k in range(3):
        mine = state.select([k])
        centred = mine.position - tf.measure.colony_centre(mine)
        spread = torch.linalg.eigvalsh(centred.T @ centred)
        # a file of cells would have a ratio near 0; the young colonies of a hundred rods are still
        # a little long
        assert float(spread[0] / spread[1]) > 0.15


def test_volume_doubles_in_ln2_over_rate():
    """Free growth: the volume before the first division, where mechanics does not limit growth."""
    scene = tf.scenes.microcolony(rate=1.3)
    first = scene.bind(dtype=torch.float64).start()
    # ln 2 / 1.3 = 0.533 h; the founder, l = 2, is then 4.67 long in all and would have divided, so
    # go a third of the way
    last = run(scene, first, 0.175)
    assert last.cells == 1
    assert float(last.volume / first.volume) == pytest.approx(math.exp(1.3 * 0.175), rel=1e-9)


@pytest.mark.slow
def test_a_microcolony_in_space_stays_between_agarose_and_coverslip():
    scene = tf.scenes.microcolony(dim=3)
    state = run(scene, scene.bind(2).start(), 5.5)
    assert (state.counts > 50).all()
    walls = scene.effects[-1].walls
    reach = 0.5 * state.length * state.axis[:, 2].abs() + state.radius
    top, bottom = state.position[:, 2] + reach, state.position[:, 2] - reach
    # the coverslip is hard: no deeper than the growth of one step can push, 0.025 h · 1/h · (4.5 +
    # 2/3) µm
    assert float(top.max()) - 0.5 < 0.13
    # the agarose is soft: a few cells stand in it, no deeper than the dome that the model's page
    # gives for 5,000 cells, the others lie on it
    below = -0.5 - bottom
    assert 0.0 < float(below.max()) < 2.3 and float(below.median()) < 0.05
    assert float(tf.measure.overlaps(state, walls[1:]).walls.max()) == pytest.approx(
        max(0.0, float(top.max()) - 0.5), abs=1e-6
    )
    assert float(tf.measure.tilt(state).median()) < 0.2, "rad; a young colony lies in its plane"


@pytest.mark.slow
def test_softer_agarose_gives_way_more():
    depth = []
    for agarose in (2.0, 200.0):
        scene = tf.scenes.microcolony(dim=3, agarose=agarose)
        depth.append(float(tf.measure.depth(run(scene, scene.bind(2, seed=1).start(), 5.0)).mean()))
    assert depth[0] > depth[1] + 0.02


# --- programmed growth ----------------------------------------------------------------------------


def row(length: float) -> tf.Cells:
    """Upright rods in a row along x, just not touching."""
    x = np.arange(0.0, length, 1.01)
    return tf.Cells(np.stack([x, 0 * x], 1), [0.0, 1.0], 2.0)


def test_only_cells_near_the_right_edge_grow():
    scene = tf.scenes.programmed_growth()
    first = scene.bind(2, cells=row(30.0)).start()
    state = step(scene, first, 0.025)
    near = first.position[:, 0] >= float(first.position[:, 0].max()) - 10.0
    assert bool(near.any()) and not bool(near.all())
    assert torch.equal(state.growth_rate, torch.where(near, 1.0, 0.0))
    assert (state.length[~near] == first.length[~near]).all() and (
        state.length[near] > first.length[near]
    ).all()


@pytest.mark.slow
def test_the_tip_moves_right():
    """From the default founder: the right edge moves away from the left edge.

    The left edge hardly moves once it is outside the growing zone.
    """
    scene = tf.scenes.programmed_growth(edge=3.0)
    early = run(scene, scene.bind(2).start(), 4.0)
    late = run(scene, early, 8.0)
    for k in range(2):
        a, b = early.position[early.colony == k, 0], late.position[late.colony == k, 0]
        right, left = float(b.max() - a.max()), float(a.min() - b.min())
        assert right > 2.0 and right > 2 * abs(left), (right, left)


@pytest.mark.slow
def test_cells_left_behind_do_not_grow_any_more():
    scene = tf.scenes.programmed_growth(edge=3.0)
    state = run(scene, scene.bind(1).start(), 7.0)
    still = state.growth_rate == 0
    assert bool(still.any()) and (state.elongation[still] == 0).all()
    x = state.position[:, 0]
    assert float((x.max() - x)[state.growth_rate > 0].max()) < 3.0 + 0.2, (
        "positions moved since the rule looked by less than one step's push"
    )


# --- channel --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_open_channel_keeps_its_sides_and_loses_cells_at_its_end(tmp_path):
    scene = tf.scenes.channel(width=4.0, length=15.0)
    states = list(tf.simulate(scene, scene.bind(2).start(), until=8.0, record=tmp_path / "run.h5"))
    last = states[-1]
    walls = scene.effects[-2].walls
    # three times the growth of the longest cell in a step, as for any closed channel: 3 · 0.025 ·
    # (4.5 + 2/3)
    deep = 3 * 0.025 * (4.5 + 2 / 3)
    for state in states[::20]:
        assert float(tf.measure.overlaps(state, walls).walls.max()) < deep
        assert (
            float(state.position[:, 1].abs().max()) < 2.0
            and float(state.position[:, 0].min()) > 0.0
        )
    assert float(last.position[:, 0].max()) <= 15.0
    with tf.Results(tmp_path / "run.h5") as results:
        fate = results.lineage().fate
    assert (fate == "left").sum() > 5
    # full: the cells' area cannot exceed the channel's by more than the overlaps
    assert float(last.counts.max()) < 60


@pytest.mark.slow
def test_a_closed_channel_loses_none_and_pressure_stops_growth():
    scene = tf.scenes.channel(width=4.0, length=8.0, open_ended=False)
    states = list(tf.simulate(scene, scene.bind(2).start(), until=7.0))
    last = states[-1]
    assert (
        (last.position[:, 0] > 0).all()
        and (last.position[:, 0] < 8).all()
        and (last.position[:, 1].abs() < 2).all()
    )
    wanted = 0.025 * (last.length + 2 / 3)
    # full: cells grow much less than they would freely; at first they grew fully
    assert float((last.elongation / wanted).mean()) < 0.3
    assert float((states[0].elongation / (0.025 * (states[0].length + 2 / 3))).mean()) > 0.9


def test_a_channel_inside_out_is_reported():
    with pytest.raises(tf.InputError, match=r"Channel|width"):
        tf.scenes.channel(width=-1.0)
    with pytest.raises(tf.InputError):
        tf.scenes.channel(length=-5.0).bind().start()


@pytest.mark.parametrize("name", sorted(READY))
def test_every_parameter_of_a_ready_scene_is_named_in_its_docstring(name):
    made = getattr(tf.scenes, name)
    words = set(re.findall(r"\w+", made.__doc__))
    assert set(inspect.signature(made).parameters) <= words
