"""The OpenCL text of rates gives the values that C gives."""

from __future__ import annotations

import math

import pytest
import torch

from torchfilm.cellmodeller.rates import TextRates


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


def test_a_circuit_is_compiled():
    import torchfilm as tf

    text = (
        "float x = species[0]; if (cellType == 0) { rates[0] = 1; } else rates[0] = x > 1 ? 2 : 3;"
    )
    circuit = tf.Circuit(TextRates(text, None, 1, 0, None), species="species0")
    assert "if cell.cell_type = 0" in str(circuit.graph)
