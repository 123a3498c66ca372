"""Measures that a colony does not have are NaN, and their targets say why."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
import torch
from patterned import placed, row
from searching import Level

import torchfilm as tf
from design import (
    Bands,
    Burden,
    Constrained,
    DomainSize,
    Gradient,
    Image,
    Lasting,
    Observed,
    OnFraction,
    Oscillation,
    Ring,
    Stripe,
    Weighted,
)

LINE = np.linspace(-5.0, 5.0, 11)
RING, BANDS = Ring("g", 20.0, 4.0), Bands(("g", "h"), (0.0, 90.0, 99.0))
OBSERVED = Observed.from_table({"length_um": [2.0, 3.0]})


def lit() -> tf.State:
    return row(LINE, g=1.0, h=1.0)


def dark() -> tf.State:
    return row(LINE, g=0.0, h=0.0)


def even() -> tf.State:
    """Cells of one level, whose mean is rounded."""
    return row([0.01 * k for k in range(5000)], g=0.7, h=0.7)


def alone() -> tf.State:
    return row([0.0], g=1.0, h=0.0)


def empty() -> tf.State:
    """Its second colony has no cells."""
    return placed(np.zeros((1, 2)), colony=[0], colonies=2, g=1.0, h=1.0)


UNDEFINED = {
    "inside of a ring": (RING, lit, "inside", "should be lit.*larger colonies"),
    "contrast of a ring": (RING, lit, "contrast", "none where it should be dark"),
    "radius of a ring": (RING, dark, "radius_um", "brighter than the mean"),
    "outside of a ring": (Ring("g", 20.0, 40.0), lit, "outside", "should be dark.*narrow"),
    "inside of a band": (BANDS, lit, "h_inside", "should be lit"),
    "contrast of a band": (BANDS, dark, "h_contrast", "nothing is lit"),
    "inside of an image": (
        Image("g", ((0.0, 1.0), (0.0, 0.0)), (0.1, 0.1), centre=(50.0, 50.0)),
        lit,
        "inside",
        "should be lit",
    ),
    "correlation of a gradient": (
        Gradient("g", "x", 20.0, 30.0),
        lit,
        "correlation",
        "gradient from 1 at 20 µm to 0 at 30 µm is flat",
    ),
    "correlation of cells of one level": (
        Gradient("g", "x", -5.0, 5.0),
        even,
        "correlation",
        "all cells have one level",
    ),
    "contrast of a stripe": (Stripe("g", at=0.0, width=9.0), lit, "contrast", "farther than 18"),
    "peak of a stripe": (Stripe("g", at=0.0, width=9.0), alone, "peak", "fewer than three cells"),
    "size of domains": (DomainSize(("g", "h"), 5.0), lit, "domain_size_um", "differ in g and h"),
    "unlike neighbours": (DomainSize(("g", "h"), 5.0), alone, "unlike_share", "no cell has a neig"),
    "decided neighbours": (DomainSize(("g", "h"), 5.0), alone, "decided", "gap under 0.5 µm"),
    "level of cells that are on": (OnFraction("g", 0.5, 2.0), lit, "on_level", "no cell has g abo"),
    "level of cells that are off": (
        OnFraction("g", 0.5, 0.5),
        lit,
        "off_level",
        "all cells have g",
    ),
    "share of cells that are on": (OnFraction("g", 0.5, 2.0), empty, "on_share", "no cells"),
    "burden": (Burden(("g",)), empty, "burden", "no cells"),
    "length of an observed colony": (OBSERVED, empty, "length_50_um", "no cells"),
    "in a sum": (Weighted([(OnFraction("h", 0.5, 0.1), 1.0), (RING, 1.0)]), lit, "inside", "lit"),
    "under constraints": (
        Constrained(Burden(("g",)), (RING,), at_least={"contrast": 2.0}),
        lit,
        "contrast",
        "none where it should be dark",
    ),
    "at the end of what lasts": (Lasting(RING, since=0.0), lit, "inside", "should be lit"),
}


def measures(target, state) -> dict[str, torch.Tensor]:
    note = target.course(state) if isinstance(target, Lasting) else None
    return target.measures(state, None if note is None else note.unsqueeze(0))


@pytest.mark.filterwarnings("ignore:.*empty. the cells are of")
@pytest.mark.parametrize("case", UNDEFINED)
def test_a_target_says_why_a_measure_is_undefined(case):
    target, state, measure, words = UNDEFINED[case]
    found = measures(target, state())
    assert bool(found[measure].isnan().any()), found
    assert re.search(words, target.why_undefined(measure))
    assert not target.why_undefined("unheard_of")


OSCILLATION = Oscillation("g", 2.0)
COURSES = {
    "short": (3, math.sin, ("period_h", "amplitude", "synchrony"), "fewer than 6 steps.*2 h"),
    "steady": (90, lambda t: 1.0, ("period_h", "synchrony"), "one level|steady"),
    "a drift": (90, lambda t: t, ("period_h",), "drifts"),
}


@pytest.mark.parametrize("case", COURSES)
def test_an_oscillation_says_why_its_measures_are_undefined(case):
    steps, level, undefined, words = COURSES[case]
    notes = []
    for step in range(steps):
        now = lit().with_fields(g=torch.full((11,), level(0.1 * step), dtype=torch.float64))
        notes.append(OSCILLATION.note(now.replace(time=0.1 * step)))
    found = OSCILLATION.measures(lit(), torch.stack(notes))
    assert {n for n, v in found.items() if bool(v.isnan().any())} == set(undefined)
    for measure in undefined:
        assert re.search(words, OSCILLATION.why_undefined(measure))


def test_of_two_targets_the_one_whose_measure_is_shown_explains_it():
    both = Weighted([(Stripe("g", at=0.0, width=9.0), 1.0), (RING, 1.0)])
    assert both.why_undefined("contrast") == RING.why_undefined("contrast")
    assert both.why_undefined("peak") and not Level().why_undefined("mean_level")


def test_a_constraint_on_an_undefined_measure_is_broken():
    target, state, *_ = UNDEFINED["under constraints"]
    assert target.loss(state()).tolist() == [Constrained.BROKEN + 1.0]


@pytest.mark.filterwarnings("ignore:.*empty. the cells are of")
def test_a_colony_without_a_loss_has_failed_and_broken_no_constraint():
    lit_cells = OnFraction("g", 0.5, level=2.0)
    target = Constrained(Burden(("g",)), (lit_cells,), at_least={"on_share": 0.9})
    loss = target.loss(empty())
    assert loss[0] > Constrained.BROKEN and loss[1].isnan()
