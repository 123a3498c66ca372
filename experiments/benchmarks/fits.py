"""The fits of the benchmark of searches: scenes, and data of colonies of hidden parameters.

`four` are the parameters of `fit_colony.py`; `ten` those of growth, division and a cascade of two
genes; `oscillation` those of a repressilator, from 24 readings of one species with an error of 0.5,
whose losses have many minima.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from tasks import REPLICATES, SearchTask

import torchfilm as tf
from design import Observed, ObservedCourse, Parameter

sys.path.insert(0, str(Path(__file__).parents[1]))
import fit_colony

HOURS, DATA_SEED = 3.5, 77


def cascade_rates(u, s, p, cell):
    rise = u.rfp**p.n / (p.half**p.n + u.rfp**p.n)
    return {"rfp": p.make_rfp - 0.2 * u.rfp, "gfp": p.make_gfp * rise - p.loss_gfp * u.gfp}


def cascade(
    rate=1.0, variation=0.1, division=4.0, division_variation=0.1, make_rfp=5.0,
    rfp_variation=0.3, make_gfp=5.0, half=2.0, n=2.0, loss_gfp=0.2,
):  # fmt: skip
    """Colonies of cells that differ in growth, in division and in the strength of a gene, whose
    protein switches a second one on."""
    circuit = tf.Circuit(
        cascade_rates, species=("rfp", "gfp"), make_rfp=tf.LogNormal(make_rfp, rfp_variation),
        make_gfp=make_gfp, half=half, n=n, loss_gfp=loss_gfp,
    )  # fmt: skip
    return tf.Scene(
        tf.Growth(rate=tf.LogNormal(rate, variation)),
        tf.Division(length=tf.LogNormal(division, division_variation)),
        tf.Mechanics(dim=2),
        circuit,
        dt=0.05,
    )


CASCADE = {
    "rate": 1.15, "variation": 0.12, "division": 3.4, "division_variation": 0.1, "make_rfp": 3.0,
    "rfp_variation": 0.3, "make_gfp": 8.0, "half": 2.5, "n": 2.0, "loss_gfp": 0.5,
}  # fmt: skip
CASCADE_BOUNDS = [
    Parameter("rate", 0.7, 1.6, log=True),
    Parameter("variation", 0.02, 0.4, log=True),
    Parameter("division", 2.5, 5.0),
    Parameter("division_variation", 0.02, 0.3, log=True),
    Parameter("make_rfp", 0.5, 20.0, log=True),
    Parameter("rfp_variation", 0.05, 1.0, log=True),
    Parameter("make_gfp", 0.5, 50.0, log=True),
    Parameter("half", 0.2, 20.0, log=True),
    Parameter("n", 1.0, 4.0),
    Parameter("loss_gfp", 0.05, 5.0, log=True),
]


def ring_of_three(u, s, p, cell):
    held = lambda level: p.make * (p.leak + 1.0 / (1.0 + (level / p.half) ** p.n))
    return {
        "a": held(u.c) - p.loss * u.a,
        "b": held(u.a) - p.loss * u.b,
        "c": held(u.b) - p.loss * u.c,
    }


def oscillator(make=20.0, half=2.0, n=3.0, loss=1.0, leak=0.05):
    """One cell that stands for a culture."""
    circuit = tf.Circuit(
        ring_of_three, species=("a", "b", "c"), initial={"a": 5.0}, make=make, half=half, n=n,
        loss=loss, leak=leak,
    )  # fmt: skip
    return tf.Scene(circuit, dim=2, founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]]), dt=0.1)


OSCILLATOR = {"make": 22.0, "half": 2.2, "n": 3.4, "loss": 0.8, "leak": 0.01}
OSCILLATOR_BOUNDS = [
    Parameter("make", 3.0, 100.0, log=True),
    Parameter("half", 0.3, 20.0, log=True),
    Parameter("n", 1.5, 5.0),
    Parameter("loss", 0.2, 4.0, log=True),
    Parameter("leak", 0.001, 0.3, log=True),
]
ERROR = 0.5  # of a reading


def level(state: tf.State):
    return state.groups.sum(state.a * state.volume) / state.groups.sum(state.volume)


def readings() -> ObservedCourse:
    noise, times = np.random.default_rng(1), tuple(range(1, 25))
    runs = tf.simulate(oscillator(**OSCILLATOR), until=times[-1])
    found = {round(state.time): float(level(state)) for state in runs if _is_whole(state.time)}
    values = [found[t] + ERROR * noise.standard_normal() for t in times]
    return ObservedCourse.of_measures(
        {"a": level}, times=times, values={"a": values}, spread={"a": ERROR}
    )


def _is_whole(time: float) -> bool:
    return time > 0.5 and abs(time - round(time)) < 1e-6


def grown_data(scene, truth: dict, species: tuple[str, ...]) -> Observed:
    runs = tf.simulate(scene(**truth), colonies=REPLICATES, seed=DATA_SEED, until=HOURS)
    return Observed.from_state(list(runs)[-1], species=species)


def four() -> tuple[SearchTask, dict]:
    data = grown_data(fit_colony.colony, fit_colony.TRUTH, ("gfp",))
    end = {"until": HOURS, "cells": None}
    return SearchTask(fit_colony.colony, fit_colony.PARAMETERS, data, end), fit_colony.TRUTH


def ten() -> tuple[SearchTask, dict]:
    data = grown_data(cascade, CASCADE, ("rfp", "gfp"))
    return SearchTask(cascade, CASCADE_BOUNDS, data, {"until": HOURS, "cells": None}), CASCADE


def oscillation() -> tuple[SearchTask, dict]:
    colony = {"cells": None, "replicates": 1, "dt": 0.1}
    return SearchTask(oscillator, OSCILLATOR_BOUNDS, readings(), colony), OSCILLATOR


FITS = {"four": four, "ten": ten, "oscillation": oscillation}
