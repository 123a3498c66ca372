"""One circuit over one step, without a scene: its pools, its reservoir, its errors, its columns."""

from __future__ import annotations

import math

import pytest
import torch

from torchfilm.circuits import failures, run
from torchfilm.circuits.columns import Columns, Lookup, column
from torchfilm.circuits.names import UnknownName
from torchfilm.circuits.trial import try_circuit
from torchfilm.tools.checks import InputError

F64 = torch.float64
METHODS = ["rosenbrock", "rk4", "euler"]


def membrane(u, s, p, cell):
    into = p.D1 * (s.a - u.a)
    return {"a": into / cell.volume}, {"a": -into}


def circuit(
    part=membrane,
    *,
    pool=(8.0, 16.0, 4.0),
    signals=(1.0, 0.0, 2.0),
    in_reservoir=None,
    exchanged=("a",),
    rows=(0, 1, 2),
    dtype=F64,
    D1=3.0,
) -> run.CircuitCells:
    """A circuit in some of three cells of 2, 4 and 1 µm³."""
    cell = {"volume": torch.tensor([2.0, 4.0, 1.0], dtype=dtype)}
    return run.CircuitCells(
        part,
        ("a", "b"),
        exchanged,
        torch.tensor(rows),
        cell,
        {"D1": torch.tensor(D1, dtype=dtype)},
        {"a": torch.tensor(signals, dtype=dtype)},
        torch.tensor(pool, dtype=dtype),
        None if in_reservoir is None else torch.tensor(in_reservoir),
    )


def settings(method: str = "rosenbrock", **given) -> run.IntegrationSettings:
    return run.IntegrationSettings(
        **{
            "method": method,
            "steps": 200,
            "rtol": 1e-9,
            "atol": 1e-12,
            "molecules_per_unit": 1.0,
            **given,
        }
    )


@pytest.mark.parametrize("method", METHODS)
def test_what_cells_lose_their_pools_gain(method):
    made, start = circuit(), torch.tensor([[5.0, 7.0], [5.0, 7.0], [0.0, 7.0]], dtype=F64)
    found = run.step(made, start, 0.2, settings(method))
    volume, pool = made.cell["volume"], made.pool
    assert torch.allclose(
        found.pools["a"],
        (start[:, 0] - found.concentrations[:, 0]) * volume,
        rtol=1e-12,
        atol=1e-14,
    )
    assert (
        torch.equal(found.concentrations[:, 1], start[:, 1])
        and found.reservoir == {}
        and not bool(found.failed.any())
    )
    # d/dt (u − s) = −D1 (1/V + 1/pool)(u − s)
    gap = (start[:, 0] - made.signals["a"]) * torch.exp(-3.0 * (1 / volume + 1 / pool) * 0.2)
    end = found.concentrations[:, 0] - (made.signals["a"] + found.pools["a"] / pool)
    # Euler in 200 steps: half a step of (rate 4)² over 0.2 h, 1e-3 · 0.2 · 16/2 of 4
    assert torch.allclose(end, gap, rtol=0, atol=0.01 if method == "euler" else 1e-6)


def test_only_the_rows_asked_for_in_their_order():
    whole, start = circuit(), torch.tensor([[5.0, 7.0], [3.0, 1.0], [0.0, 2.0]], dtype=F64)
    part = run.step(circuit(rows=(2, 0)), start[[2, 0]], 0.2, settings())
    full = run.step(whole, start, 0.2, settings())
    assert torch.equal(part.concentrations, full.concentrations[[2, 0]]) and torch.equal(
        part.pools["a"], full.pools["a"][[2, 0]]
    )
    assert torch.equal(part.steps, full.steps[[2, 0]])


@pytest.mark.parametrize("method", METHODS)
def test_a_reservoir_does_not_change_and_what_it_got_is_reported(method):
    made = circuit(in_reservoir=(True, False, True))
    start = torch.tensor([[5.0, 0.0], [5.0, 0.0], [0.0, 0.0]], dtype=F64)
    found = run.step(made, start, 0.2, settings(method))
    lost = (start[:, 0] - found.concentrations[:, 0]) * made.cell["volume"]
    assert torch.allclose(
        found.reservoir["a"],
        torch.stack([lost[0], lost.new_zeros(()), lost[2]]),
        rtol=1e-9,
        atol=1e-12,
    )
    assert found.reservoir["a"][2] < 0 < found.reservoir["a"][0]
    assert torch.allclose(
        found.pools["a"],
        torch.stack([lost.new_zeros(()), lost[1], lost.new_zeros(())]),
        rtol=1e-9,
        atol=1e-12,
    )
    toward = 1.0 + 4.0 * math.exp(-3.0 / 2.0 * 0.2)
    assert float(found.concentrations[0, 0]) == pytest.approx(
        toward, abs=2e-3 if method == "euler" else 1e-7
    )


def test_steps_are_counted():
    start = torch.ones(3, 2, dtype=F64)
    assert run.step(circuit(), start, 0.1, settings("rk4", steps=5)).steps.tolist() == [5, 5, 5]
    assert int(run.step(circuit(D1=300.0), start, 0.1, settings(rtol=1e-4)).steps[1]) > 1


@pytest.mark.parametrize("method", METHODS)
def test_a_cell_that_fails_leaves_the_others_alone(method):
    def breaks(u, s, p, cell):
        return {"a": torch.where(u.a > 4.0, torch.nan, -u.a), "b": u.b}, {"a": 0.0}

    made, start = circuit(breaks), torch.tensor([[1.0, 1.0], [5.0, 1.0], [2.0, 1.0]], dtype=F64)
    found = run.step(made, start, 0.1, settings(method))
    assert found.failed.tolist() == [False, True, False]
    assert found.concentrations[[0, 2], 0].tolist() == pytest.approx(
        [math.exp(-0.1), 2 * math.exp(-0.1)], rel=1e-3
    )
    said = failures.words(made, found, start, 1, method, 0.1)
    assert "the species 'a'" in said and "not a finite number" in said and "a = 5, b = 1" in said


def test_a_signal_whose_amount_breaks_is_distinguished():
    made = circuit(lambda u, s, p, cell: ({"a": -u.a}, {"a": torch.log(u.b)}))
    start = torch.tensor([[1.0, 1.0], [1.0, 0.0], [1.0, 1.0]], dtype=F64)
    found = run.step(made, start, 0.1, settings("rk4"))
    said = failures.words(made, found, start, 1, "rk4", 0.1)
    assert "the signal 'a'" in said and "species" not in said
    with pytest.raises(
        InputError, match=r"gives -inf for the signal 'a' at the start \(a = 1, b = 0\)"
    ):
        try_circuit(made, start, made)


def test_the_trial_tells_what_is_given():
    start = torch.ones(3, 2, dtype=F64)
    assert try_circuit(circuit(), start, circuit()) == ("a",)
    for rates in (lambda u, s, p, cell: {"a": -u.a}, lambda u, s, p, cell: ({"a": -u.a}, {})):
        made = circuit(rates)
        assert try_circuit(made, start, made) == ()


def test_rates_may_be_numbers():
    found = run.step(
        circuit(lambda u, s, p, cell: {"a": 2.0, "b": torch.tensor(1, dtype=F64)}, exchanged=()),
        torch.zeros(3, 2, dtype=F64),
        0.5,
        settings(),
    )
    assert torch.allclose(
        found.concentrations, torch.tensor([[1.0, 0.5]] * 3, dtype=F64), rtol=1e-12
    )


# --- columns --------------------------------------------------------------------------------------


def test_columns_are_picked_out_when_asked_for_and_noted():
    made, seen = [], set()

    def slow():
        made.append(1)
        return torch.tensor([1.0, 2.0, 3.0])

    given = {"a": torch.tensor([4.0, 5.0, 6.0]), "k": 7.0, "t": torch.tensor(8.0)}
    source = Lookup(lambda: [*given, "slow"], lambda n: slow() if n == "slow" else given[n])
    columns = Columns(source, torch.tensor([2, 0]), "cell", seen)
    assert (
        columns.a.tolist() == [6.0, 4.0]
        and columns["k"] == 7.0
        and float(columns.t) == 8.0
        and made == []
        and seen == {"a", "k", "t"}
    )
    assert columns.slow.tolist() == [3.0, 1.0] and columns.slow is columns.slow and made == [1]
    assert (
        "slow" in columns
        and "none" not in columns
        and len(columns) == 4
        and list(columns) == ["a", "k", "t", "slow"]
    )
    assert repr(columns) == "Columns(a, k, t, slow)"
    with pytest.raises(UnknownName, match=r"cell has no 'slwo'.*Did you mean 'slow'"):
        _ = columns.slwo
    with pytest.raises(UnknownName, match="can only be read"):
        columns.a = 1.0
    assert not hasattr(columns, "__deepcopy__")


def test_a_lazy_column_is_worked_out_once_for_all_rows():
    made = []
    source = Lookup(lambda: ["v"], lambda name: made.append(name) or torch.arange(3.0))
    first, second = (Columns(source, torch.tensor([k]), "cell") for k in (0, 2))
    assert (float(first.v), float(second.v), made) == (0.0, 2.0, ["v"])
    assert (list(source), len(source), "w" in source) == (["v"], 1, False)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (2, [2.0, 2.0]),
        (0.5, [0.5, 0.5]),
        (torch.tensor(3), [3.0, 3.0]),
        (torch.tensor([1, 2]), [1.0, 2.0]),
        (torch.ones(2, dtype=F64), [1.0, 1.0]),
        (True, None),
        ("1", None),
        (None, None),
        (torch.ones(3), None),
        (torch.ones(2, 1), None),
    ],
)
def test_a_rate_is_a_column_or_a_number(given, wanted, dtype):
    found = column(given, 2, torch.zeros(5, dtype=dtype))
    assert (
        (found is None) if wanted is None else (found.tolist() == wanted and found.dtype == dtype)
    )
