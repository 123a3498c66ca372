"""Oscillations, on histories with known period, amplitude and spread."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from patterned import crowded, placed

import torchfilm as tf
from design.targets import Oscillation

STATE = placed([(0, 0)], yfp=1.0)
TARGET = Oscillation("yfp", 2.0)


def notes(time, mean, spread=0.0) -> torch.Tensor:
    """History (T, 1, 3) of a mean over time and a variance over the cells."""
    mean = np.broadcast_to(np.asarray(mean, dtype=float), np.shape(time))
    return torch.tensor(np.stack([time, mean, mean**2 + spread], 1)).unsqueeze(1)


def swing(time, period, amplitude=1.0, phase=0.3):
    return 5.0 + amplitude * np.cos(2 * math.pi * time / period + phase)


def test_notes_are_time_mean_and_mean_square_by_volume():
    """A ball and a rod of 4 µm, volumes 1/6 and 7/6 of π, at levels 8 and 1."""
    state = placed([(0, 0), (8, 0)], length=[0.0, 4.0], yfp=[8.0, 1.0]).replace(time=1.5)
    assert TARGET.note(state).tolist() == [[1.5, pytest.approx(15 / 8), pytest.approx(71 / 8)]]
    assert bool(TARGET.note(state.remove(state.colony == 0, "removed")).isnan().all())


@pytest.mark.parametrize("spread", [0.0, 0.3, 4.0])
def test_loss_is_the_share_of_variance_without_the_period(spread):
    """A fit explains a pure wave of the period exactly, at any phase. The spread over the cells
    remains, and counts only with synchrony. Least squares in float64: 1e-12."""
    time = np.arange(241) * 0.05
    history = notes(time, swing(time, 2.0), spread)
    variance = np.var(swing(time, 2.0)[time >= 12 - 6 - 1e-9])
    assert float(TARGET.loss(STATE, history)) == pytest.approx(
        spread / (spread + variance), abs=1e-12
    )
    assert float(Oscillation("yfp", 2.0, synchrony=False).loss(STATE, history)) == pytest.approx(
        0, abs=1e-12
    )


def test_floor_is_the_amplitude_that_has_loss_one_half():
    time = np.arange(120) * 0.05  # three periods less a sample: the variance is a²/2
    history = notes(time, swing(time, 2.0, amplitude=0.25))
    assert float(Oscillation("yfp", 2.0, floor=0.25).loss(STATE, history)) == pytest.approx(
        0.5, abs=1e-12
    )


def test_only_the_last_cycles_count():
    """Earlier samples may hold anything."""
    time = np.arange(241) * 0.05
    mean = np.where(time < 12 - 4 - 1e-9, 100 * time, swing(time, 2.0))
    assert float(Oscillation("yfp", 2.0, cycles=2).loss(STATE, notes(time, mean))) == pytest.approx(
        0, abs=1e-12
    )
    assert float(TARGET.loss(STATE, notes(time, mean))) > 0.5


@pytest.mark.parametrize("period, loss", [(1.0, 1.0), (2.0 / 3.0, 1.0), (1.9, 0.1), (3.0, 0.9)])
def test_other_periods_do_not_count(period, loss):
    """Waves with a whole number of periods in the window are orthogonal to that of the target;
    three periods hardly resolve 5 %."""
    time = np.arange(120) * 0.05
    found = float(TARGET.loss(STATE, notes(time, swing(time, period))))
    assert (
        found == pytest.approx(1, abs=1e-12)
        if loss == 1
        else (found < loss if loss < 0.5 else found > 0.5)
    )


@pytest.mark.parametrize(
    "time, mean",
    [
        (np.arange(38) * 0.05, None),  # less than a period
        (np.arange(5) * 1.0, None),  # five samples
        (np.arange(200) * 0.05, 5.0),  # steady
        (np.arange(200) * 0.05, 5.0 + 1e-9 * np.arange(200) % 3),  # steady to rounding
        (np.arange(200) * 0.05, 0.0),  # dark
        (np.arange(20) * 2.0, None),  # sampled once a period
        (np.arange(20) * 1.0, None),  # twice
    ],
)
def test_without_an_oscillation_the_loss_is_1_with_a_gradient(time, mean):
    history = notes(time, swing(time, 2.0) if mean is None else mean).requires_grad_()
    loss = TARGET.loss(STATE, history)
    assert loss.tolist() == [1.0]
    if loss.requires_grad:
        assert bool(torch.isfinite(torch.autograd.grad(loss.sum(), history)[0]).all())


def test_a_whole_period_is_enough():
    time = np.arange(41) * 0.05  # 2 h, but for rounding
    assert float(TARGET.loss(STATE, notes(time, swing(time, 2.0)))) == pytest.approx(0, abs=1e-12)


def test_cells_out_of_phase_have_no_synchrony():
    """100 cells with evenly spread phases: the mean is steady while each cell oscillates. In phase
    all oscillate together."""
    time, phase = np.arange(120) * 0.05, 2 * math.pi * np.arange(100) / 100
    level = 5 + np.cos(math.pi * time[:, None] + phase)
    apart = torch.tensor(np.stack([time, level.mean(1), (level**2).mean(1)], 1)).unsqueeze(1)
    assert float(TARGET.loss(STATE, apart)) == pytest.approx(1, abs=1e-12)
    assert float(TARGET.measures(STATE, apart)["synchrony"]) == pytest.approx(0, abs=1e-12)
    assert float(TARGET.measures(STATE, notes(time, level[:, 0]))["synchrony"]) == pytest.approx(
        1, abs=1e-12
    )


def test_notes_of_a_run_are_a_history():
    """Given levels at each step: the notes are what is scored."""
    state = placed([(0, 0), (2, 0)], yfp=0.0)
    kept = []
    for step in range(121):
        level = 3 + math.sin(math.pi * 0.05 * step)
        kept.append(
            TARGET.note(
                state.with_fields(
                    yfp=torch.tensor([level, level + 1], dtype=torch.float64)
                ).replace(time=0.05 * step)
            )
        )
    found = TARGET.measures(state, torch.stack(kept))
    # swings of variance ½ over time (a sample more than three periods: 1 %), spread of ¼ over cells
    assert float(TARGET.loss(state, torch.stack(kept))) == pytest.approx(0.25 / 0.75, rel=0.01)
    assert float(found["synchrony"]) == pytest.approx(0.5 / 0.75, rel=0.01)


@pytest.mark.parametrize("period", [0.6, 1.0, 1.7, 2.0, 2.9])
def test_the_period_is_measured(period):
    """Six hours of samples give the period to a hundredth, by the parabola through the greatest
    power; the amplitude is less exact for a fraction of a period."""
    time = np.arange(121) * 0.05
    found = TARGET.measures(STATE, notes(time, swing(time, period, amplitude=0.5)))
    assert float(found["period_h"]) == pytest.approx(period, rel=0.01)
    assert float(found["amplitude"]) == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(
    "mean", [np.arange(121) * 0.1, np.exp(-np.arange(121) * 0.02), np.sqrt(np.arange(121.0))]
)
def test_a_drift_has_no_period(mean):
    found = TARGET.measures(STATE, notes(np.arange(121) * 0.05, mean))
    assert math.isnan(found["period_h"]) and float(found["synchrony"]) == 1


def test_one_period_is_enough_to_be_measured():
    """A wave as long as the window has its peak there."""
    time = np.arange(61) * 0.05
    found = Oscillation("yfp", 3.0, cycles=1).measures(STATE, notes(time, swing(time, 3.0)))
    assert float(found["period_h"]) == pytest.approx(3.0, rel=0.01)


def test_a_steady_level_has_no_period():
    found = TARGET.measures(STATE, notes(np.arange(200) * 0.05, 5.0))
    assert (
        math.isnan(found["period_h"])
        and math.isnan(found["synchrony"])
        and float(found["amplitude"]) == 0
    )
    short = TARGET.measures(STATE, notes(np.arange(10) * 0.05, swing(np.arange(10) * 0.05, 2.0)))
    assert all(math.isnan(v) for v in short.values())


def test_gradient_with_respect_to_the_levels():
    time = np.arange(50) * 0.05
    history = notes(time, swing(time, 1.8), 0.2)
    means = history[:, :, 1:].clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda given: TARGET.loss(STATE, torch.cat([history[:, :, :1], given], 2)), means
    )
    given = crowded(colonies=2).yfp.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda y: TARGET.note(crowded(colonies=2).with_fields(yfp=y)), given
    )


def test_a_colony_scores_the_same_in_any_batch():
    """To the last bit, also where other colonies have missing notes or failed."""
    rng = np.random.default_rng(0)
    time = np.arange(200) * 0.05
    each = [
        notes(time, swing(time, p) + rng.normal(0, 0.3, 200), 0.2)
        for p in (1.5, 2.0, 2.1, 2.5, 4.0)
    ]
    history = torch.cat(each, 1)
    history[150:, 3] = math.nan
    state = placed([(0, 0)], yfp=1.0, colonies=5)
    whole, measured = TARGET.loss(state, history), TARGET.measures(state, history)
    assert bool(((whole > 0) & (whole < 1)).all())
    for k in range(5):
        alone = state.select([k])
        mine = history[:150, [k]] if k == 3 else history[:, [k]]
        assert torch.equal(TARGET.loss(alone, mine)[0], whole[k])
        assert all(
            torch.equal(v[0], measured[name][k]) for name, v in TARGET.measures(alone, mine).items()
        )


def test_a_failed_colony_scores_as_failed():
    time = np.arange(120) * 0.05
    state = placed([(0, 0)], yfp=1.0, colonies=2)
    history = notes(time, swing(time, 2.0)).repeat(1, 2, 1)
    history[60:, 1] = math.nan
    found = TARGET.loss(state.remove(state.colony == 1, "removed"), history)
    assert found.tolist() == [pytest.approx(0, abs=1e-12), TARGET.failed]


@pytest.mark.parametrize(
    "history", [None, torch.zeros(0, 1, 3), torch.zeros(4, 1, 2), torch.zeros(4, 3)]
)
def test_without_history_there_is_no_score(history):
    for ask in (TARGET.loss, TARGET.measures):
        with pytest.raises(tf.InputError, match=r"Keep target\.note"):
            ask(STATE, history)


@pytest.mark.parametrize(
    "options, what",
    [
        ({"period": 0.0}, "Oscillation.period"),
        ({"period": 1.0, "synchrony": "yes"}, "Oscillation.synchrony"),
        ({"period": 1.0, "cycles": 0.5}, "Oscillation.cycles"),
        ({"period": 1.0, "floor": -1.0}, "Oscillation.floor"),
        ({"period": 1.0, "species": ""}, "Oscillation.species"),
    ],
)
def test_bad_settings_are_refused(options, what):
    with pytest.raises(tf.InputError, match=what):
        Oscillation(**{"species": "yfp", **options})


def test_an_unknown_species_is_refused_with_the_known_ones():
    with pytest.raises(tf.InputError, match=r"Did you mean 'yfp'\?"):
        Oscillation("yfb", 1.0).check(STATE)
    TARGET.check(STATE)
    assert TARGET.describe() == "yfp swings with a period of 2 h, all cells together"
