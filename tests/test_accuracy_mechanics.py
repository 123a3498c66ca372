"""The work–precision studies of mechanics, in small: the laws that their figures must obey,
whatever the figures are."""

from __future__ import annotations

import dataclasses
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

import torchfilm as tf
from torchfilm.kernels.scheme import OVERLAP, TOLERANCE

HERE = Path(__file__).parent.parent / "experiments"
sys.path += [str(HERE / "accuracy"), str(HERE / "benchmarks")]
import contact_settings  # noqa: E402
import mechanics  # noqa: E402
import soft_cells  # noqa: E402

DIMS = pytest.mark.parametrize("dim", [2, 3])


@cache
def run(kind: str, dim: int):
    with torch.no_grad():
        return getattr(mechanics, kind)(dim, True)


def check_front(study) -> None:
    """Along the front error falls as work grows, and nothing else is better in both; the default is
    there."""
    assert any(p.default for p in study.points) and set(study.shown) <= set(study.errors)
    for error in study.errors:
        front = study.front(error)
        assert all(
            a.work < b.work and a.errors[error] > b.errors[error] for a, b in pairwise(front)
        )
        assert all(
            any(f.work <= p.work and f.errors[error] <= p.errors[error] for f in front)
            for p in study.points
        )


@pytest.mark.slow
@DIMS
def test_soft_cells_converge_to_their_motion_at_first_order(dim):
    """Both kinds of contact, to one and the same limit: a tight solve by either leaves nothing but
    Δt. The four steps are an octave apart; second terms of a few per cent are left at the coarsest.
    """
    study = run("order", dim)
    check_front(study)
    for error in study.errors:
        orders = study.orders(error)
        for series in ("Δt", "Δt, one-sided"):
            assert 0.9 < orders[series] < 1.1, (error, series)
        finest = min(p.step for p in study.points if p.step)
        one, other = (
            p.errors[error]
            for p in study.points
            if p.step == finest and p.series in ("Δt", "Δt, one-sided")
        )
        assert one == pytest.approx(other, rel=0.2)


@pytest.mark.slow
@DIMS
def test_a_window_shows_what_each_knob_is_for(dim):
    study = run("window", dim)
    check_front(study)
    by = {p.setting: p for p in study.points}
    # softer contacts leave more overlap, whatever else
    soft = by[f"dt=0.025, contact_overlap={10 * OVERLAP:g}"]
    assert soft.errors["overlap"] > by["dt=0.025"].errors["overlap"]
    # a tighter solve reads more rows, and so do smaller steps
    tighter, looser = (by[f"dt=0.025, tolerance={m * TOLERANCE:g}"] for m in (0.3, 3))
    assert tighter.work > by["dt=0.025"].work > looser.work
    assert all(
        any(p.default for p in study.points if p.series == s)
        for s in ("Δt", "overlap", "passes", "tolerance")
    )
    assert by["dt=0.025, contacts='bilateral'"].work > 0
    assert by["dt=0.0125"].work > by["dt=0.025"].work
    fine, loose = mechanics.tight(tf.Mechanics(dim=dim), True)
    assert not {fine.label, loose.label} & set(by) and fine.mechanics.one_sided
    assert study.facts["reference"] == fine.label


@pytest.mark.slow
def test_whole_runs_are_compared_with_other_seeds():
    study = run("long", 2)
    check_front(study)
    assert all(
        p.band[name] >= 0 and np.isfinite(p.errors[name])
        for p in study.points
        for name in study.errors
    )
    assert any(p.band["radius"] > 0 for p in study.points) and all(p.work > 0 for p in study.points)


def test_the_motion_by_numpy_obeys_action_and_reaction():
    """Without walls forces, and torques about the origin, add up to nothing; a pair that does not
    touch only grows."""
    rng = np.random.default_rng(1)
    axis = rng.normal(size=(30, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    motion = soft_cells.Motion(rng.uniform(-2, 2, (30, 3)), axis, rng.uniform(0.5, 2, 30), ())
    move, turn = motion.velocity()[:180].reshape(2, 30, 3)
    whole = (motion.length + contact_settings.DIAMETER)[:, None]
    force, torque = move * whole, np.cross(motion.axis, turn) * whole**3 / 12
    assert np.abs(force).max() > 1.0
    # sums of some hundred forces of size 100 in float64
    assert (
        np.abs(force.sum(0)).max() < 1e-10
        and np.abs((np.cross(motion.centre, force) + torque).sum(0)).max() < 1e-10
    )
    far = dataclasses.replace(motion, centre=100.0 * np.arange(90.0).reshape(30, 3))
    assert np.array_equal(far.velocity(), np.concatenate([np.zeros(180), motion.length + 2 / 3]))


def test_difference_is_welch():
    one, other = (
        torch.randn(9, generator=torch.Generator().manual_seed(1)).double(),
        3 * torch.rand(14, dtype=torch.float64) + 1,
    )
    far, half = mechanics.difference(one, other)
    found = stats.ttest_ind(one, other, equal_var=False).confidence_interval(0.95)
    assert (far - half, far + half) == pytest.approx((found.low, found.high), rel=1e-9)
    assert mechanics.difference(torch.ones(3), torch.ones(3)) == (0.0, 0.0)


@DIMS
def test_local_order(dim):
    """1 among cells side by side; crossed at right angles −1 in the plane and −½ in space; a colony
    each."""
    x, y = np.eye(dim)[:2]
    cells = tf.Cells([0 * y, 1.1 * y, 0 * y, 2.1 * y], [x, -x, x, y], 2.0, colony=[0, 0, 1, 1])
    state = tf.Scene(tf.Mechanics(dim=dim), founders=cells).bind().start()
    assert mechanics.local_order(state).tolist() == pytest.approx([1.0, -1.0 if dim == 2 else -0.5])


def test_a_label_says_what_a_user_would_type():
    plain = tf.Mechanics(dim=2)
    assert contact_settings.ContactSetting("", plain).label == "dt=0.025"
    turned = contact_settings.ContactSetting(
        "",
        dataclasses.replace(plain, alpha=0.003, tolerance=0.02, contacts="bilateral"),
        0.05,
        torch.float64,
    )
    assert turned.label == "dt=0.05, alpha=0.003, tolerance=0.02, contacts='bilateral', float64"
    scene = tf.scenes.microcolony(dim=2)
    draft, settings = (
        contact_settings.ContactSetting.of_preset("draft", scene),
        tf.preset("draft", scene),
    )
    # its penalty is the usual one, 0.1, and its tolerance four times the usual one, 0.05
    contacts = f"contact_overlap={OVERLAP:g}, tolerance={4 * TOLERANCE:g}"
    assert draft.label == f"preset draft: dt={settings.dt:g}, {contacts}"
    assert (
        draft.scene(scene).dt == settings.dt
        and contact_settings.mechanics_of(settings.apply(scene)) == draft.mechanics
    )
    made = turned.scene(scene)
    assert (
        made.dt == 0.05
        and contact_settings.mechanics_of(made) == turned.mechanics
        and len(made.effects) == len(scene.effects)
    )
    state = turned.start(scene.bind().start())
    assert (
        state.dtype == torch.float64 == state.displacement.dtype and state.uid.dtype == torch.int64
    )
