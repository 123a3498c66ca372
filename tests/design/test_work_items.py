"""Batches of designs that do not fit, or hold a design at fault, are cut in halves."""

from __future__ import annotations

import numpy as np
import pytest
from searching import grown

import torchfilm as tf
from design import Measured, Parameter, Task, simulations
from design.reasons import tally
from design.scoring import WorkItem, in_halves
from design.simulations import simulate_designs


def level(state):
    return state.groups.sum(state.gfp) / state.counts


def colony(make=1.0):
    return grown(1.5, make, 1.0)


def item(count):
    return WorkItem(tuple(range(10, 10 + count)), tuple({"make": float(k)} for k in range(count)))


def test_halves_keep_their_order_and_name_the_design_at_fault():
    def act(part):
        if 12 in part.rows:
            raise tf.InputError(f"{len(part.rows)} with 12")
        return sum(part.rows)

    found = [(part.rows, str(made)) for part, made in in_halves(item(5), act)]
    assert found == [((10, 11), "21"), ((12,), "1 with 12"), ((13, 14), "27")]


def test_errors_of_code_are_raised():
    def act(part):
        raise RuntimeError("shapes differ")

    with pytest.raises(RuntimeError, match="shapes differ"):
        list(in_halves(item(2), act))


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("CUDA out of memory. Tried to …")])
def test_simulations_that_do_not_fit_into_memory_are_halved(monkeypatch, error):
    """A search does the same."""
    data = Measured({"level": level}, {"level": 0.5}, {"level": 0.1}, time=0.5)
    task = Task(colony, [Parameter("make", 0.5, 2.0)], data, dt=0.1, replicates=1)
    whole, tried, grow = simulate_designs(task, 5), [], simulations._grow_item

    def small(task, part, first):
        tried.append(len(part.rows))
        if len(part.rows) > 2:
            raise error
        return grow(task, part, first)

    monkeypatch.setattr(simulations, "_grow_item", small)
    found = simulate_designs(task, 5)
    assert np.array_equal(found.statistics, whole.statistics) and not found.reasons
    assert tried == [5, 2, 3, 1, 2]


def test_reasons_are_counted_without_their_times_and_numbers():
    given = [
        "at 3 h: no cells remain", "no cells remain at 2.5 h", "a solve failed (error 1e-3)",
        "a solve failed (error -2.5E+07)".lower(), "no cells remain",
    ]  # fmt: skip
    assert tally(given) == [("no cells remain", 3), ("a solve failed (error 1e-3)", 2)]
    assert tally([]) == []
