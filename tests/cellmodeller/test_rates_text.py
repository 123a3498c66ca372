"""The OpenCL text of rates gives the values that C gives."""

from __future__ import annotations

import math

import pytest
import torch

from torchfilm.cellmodeller.rates import TextRates
from torchfilm.tools.checks import InputError


class Columns(dict):
    __getattr__ = dict.__getitem__


def rates(text: str, species=((1.0, 4.0),), cell_type=(0, 1)) -> dict[str, list[float]]:
    """Rates of two cells."""
    column = lambda x: torch.tensor(x, dtype=torch.float64)
    u = Columns({f"species{k}": column(x) for k, x in enumerate(species)})
    cell = Columns(
        area=column([10.0, 12.0]), radius=column([0.5, 0.5]), x=column([1.0, 2.0]),
        cell_type=torch.tensor(cell_type),
    )  # fmt: skip
    found = TextRates(text, None, 3, 0, None)(u, Columns(), Columns(), cell)
    full = lambda v: v.tolist() if isinstance(v, torch.Tensor) else [v, v]
    return {name: full(value) for name, value in found.items()}


@pytest.mark.parametrize(
    "expression, values",
    [
        ("2 + 3 * 4", [14.0, 14.0]),
        ("-2.f - -3", [1.0, 1.0]),
        ("7 / 2", [3.0, 3.0]),
        ("-7 / 2", [-3.0, -3.0]),
        ("7 % 4", [3.0, 3.0]),
        ("7 / 2.0f", [3.5, 3.5]),
        ("(float)7 / 2", [3.5, 3.5]),
        ("1e-3f * 1.5E2", [0.15, 0.15]),
        ("x > 2 ? x : -x", [-1.0, 4.0]),
        ("x > 2 && x < 9 || x == 1", [1.0, 1.0]),
        ("!(x > 2)", [1.0, 0.0]),
        ("(x >= 4) * 3.f", [0.0, 3.0]),
        ("pow(x, 2.0f) + sqrt(x)", [2.0, 18.0]),
        ("pow(x, 0.5f)", [1.0, 2.0]),
        ("exp(log(x))", [1.0, 4.0]),
        ("fmin(x, 2.f) + max(x, 3.f)", [4.0, 6.0]),
        ("clamp(x, 2.f, 3.f)", [2.0, 3.0]),
        ("fabs(-x)", [1.0, 4.0]),
        ("native_exp(0.f)", [1.0, 1.0]),
        ("cellType + 1", [1.0, 2.0]),
        ("volume", [2.5, 3.0]),
        ("pos.x", [1.0, 2.0]),
        ("M_PI", [math.pi, math.pi]),
        ("10u / 4 + 7L / 2", [5.0, 5.0]),
        ("abs(-3) / 2 + min(3, 2) / 4", [1.0, 1.0]),
        ("(bool)0.5f + (bool)x", [2.0, 2.0]),
        ("(x > 2 ? 3 : 1) * 0.5f", [0.5, 1.5]),
    ],
)
def test_expressions(expression, values):
    found = rates(f"float x = species[0];\n rates[0] = {expression};")
    assert found["species0"] == pytest.approx(values)


def test_statements():
    found = rates(
        """
        const float a = 2.f, b = a * 2;   // two
        int n = 5; float y; y = 0;
        /* a comment
           of two lines */
        if (cellType == 0) {
            float a = 10;
            rates[0] = a;
        } else if (species[0] > 3) {
            y += b;
            rates[1] = y;
        } else
            rates[2] = 1;
        if (n / 2 == 2) { rates[2] = y - 1; }
        """
    )
    assert found == {"species0": [10.0, 0.0], "species1": [0.0, 4.0], "species2": [-1.0, 3.0]}


@pytest.mark.parametrize(
    "text, value",
    [
        ("bool on = species[0] / 4; rates[0] = on;", [1.0, 1.0]),
        ("{ int k = 1; } float k = 2.f; k = 2.5f; rates[0] = k;", [2.5, 2.5]),
        ("float a = 1; { a = 2; float a = 3; a = 4; } rates[0] = a;", [2.0, 2.0]),
        ("int n = 1; if (species[0] > 2) n = 3; rates[0] = n / 2.0f;", [0.5, 1.5]),
        ("int n = 1; if (species[0] > 2) n = 3; float y = n; rates[0] = y / 2;", [0.5, 1.5]),
    ],
)
def test_types_and_blocks(text, value):
    assert rates(text)["species0"] == value


@pytest.mark.parametrize(
    "text, words",
    [
        ("int n = species[0]; rates[0] = n;", "it would cut a value"),
        ("int n = 1; if (species[0] > 2) n = 3; rates[0] = n / 2;", "write floats"),
        ("rates[0] = (species[0] > 2 ? 3 : 1) / 2;", "write floats"),
        ("rates[0] = pow(0.0f, -1);", "it is no number"),
        ("rates[0] = pow(-2.0f, 0.5f);", "it is no number"),
    ],
)
def test_values_that_are_not_c(text, words):
    """C cuts whole numbers, which a solver cannot step; a float must be meant."""
    with pytest.raises(InputError, match=words):
        rates(text)


def test_a_circuit_is_compiled():
    import torchfilm as tf

    text = (
        "float x = species[0]; if (cellType == 0) { rates[0] = 1; } else rates[0] = x > 1 ? 2 : 3;"
    )
    circuit = tf.Circuit(TextRates(text, None, 1, 0, None), species="species0")
    assert "if cell.cell_type = 0" in str(circuit.graph)
