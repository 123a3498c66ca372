"""Shared by the tests of the objective: scenes with their parameters, and equal results."""

from __future__ import annotations

import numpy as np
from searching import Level, lit, objective_of, paced

from design import Parameter

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]
PACED = [Parameter("rate", 1.2, 2.4), Parameter("make", 1, 2)]
KINDS = {"on recorded growth": (lit, LIT), "each grown again": (paced, PACED)}


def objective(kind="on recorded growth", target=None, **options):
    scene, parameters = KINDS[kind]
    options = {"cells": 8, "replicates": 3, **options}
    return objective_of(scene, parameters, target or Level(), **options)


def alike(one, other):
    assert (
        np.array_equal(one.losses, other.losses)
        and np.array_equal(one.loss, other.loss)
        and np.array_equal(one.cells, other.cells)
    )
    assert one.reasons == other.reasons
