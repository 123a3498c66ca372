"""Circuit, smooth: initial values, types, parameters, and what a rate may read of its cell."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from mock_cuda import pretended_cuda  # noqa: F401
from reacting import F64, advance, idle, made, resting

import torchfilm as tf
from torchfilm.physics import capsule


def test_first_concentrations_as_numbers_per_colony_drawn_or_given(dtype, device):
    circuit = tf.Circuit(
        idle,
        species=("a", "b", "c", "d", "e"),
        initial={"a": 1.5, "b": torch.tensor([1.0, 2.0, 3.0]), "c": tf.Uniform(2.0, 3.0), "d": 9.0},
    )
    cells = tf.Cells([[0.0, 0.0], [0.0, 3.0]], [[1.0, 0.0]] * 2, extra={"d": [0.25, 0.75]})
    scene = tf.Scene(circuit, founders=cells)
    state = scene.bind(3, seed=5, dtype=dtype, device=device).start()
    assert state.a.tolist() == [1.5] * 6 and state.b.tolist() == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    assert (
        float(state.c.min()) >= 2
        and float(state.c.max()) <= 3
        and torch.unique(state.c).numel() == 6
    )
    assert state.d.tolist() == [0.25, 0.75] * 3 and state.e.tolist() == [0.0] * 6
    assert all(state.fields[n].dtype == dtype for n in "abcde")
    assert state.declared["d"].meaning == "concentration in the cell"
    assert (
        torch.equal(scene.bind(3, seed=6, dtype=dtype, device=device).start().c, state.c) is False
    )


@pytest.mark.parametrize("backend", [None, "torch"])
def test_each_type_runs_its_own_circuit_and_others_are_only_diluted(dtype, device, backend):
    def decays(u, s, p, cell):
        return {"m": -p.g * u.m}

    circuit = tf.Circuit(
        {0: made, 3: decays, 4: [tf.Reaction.of("m -> w", rate="k")]},
        species=("m", "w"),
        initial={"m": 1.0},
        k=2.0,
        g=0.5,
        rtol=1e-8,
        backend=backend,
    )
    scene = resting(circuit, 5, tf.Growth(rate=0.2), cell_type=[0, 7, 3, 4, 0])
    state = scene.bind(dtype=dtype, device=device).start()
    last = advance(scene, state, 10)
    thin = math.exp(-0.2)  # over one hour, at a relative rate of 0.2/h of the volume
    assert last.m[0] == last.m[4] and last.w[0] == 0
    # dilution by steps between exact reactions: first order in 0.1 × 0.2, for what is made
    # meanwhile
    assert float(last.m[0]) == pytest.approx(
        math.exp(-0.7) + 2.0 / 0.7 * (1 - math.exp(-0.7)), rel=0.02
    )
    exact = 200 * torch.finfo(dtype).eps if dtype == torch.float32 else 1e-7
    assert float(last.m[1]) == pytest.approx(thin, rel=exact)
    assert float(last.m[2]) == pytest.approx(thin * math.exp(-0.5), rel=exact)
    assert float(last.m[3]) == pytest.approx(thin * math.exp(-2.0), rel=exact)
    assert float(last.m[3] + last.w[3]) == pytest.approx(thin, rel=exact)


def test_slopes_that_are_numbers_are_on_the_device(pretended_cuda):  # noqa: F811
    of_types = test_each_type_runs_its_own_circuit_and_others_are_only_diluted
    of_types(torch.float64, "cuda", "torch")


@pytest.mark.filterwarnings("ignore:Circuit has rates for cells of type:UserWarning")  # by hand
def test_a_type_that_changes_takes_up_the_other_circuit():
    circuit = tf.Circuit({0: idle, 1: made}, species=("m",), k=1.0, g=0.0)
    scene = resting(circuit, 2)
    state = advance(scene, scene.bind(dtype=F64).start(), 3)
    assert state.m.tolist() == [0.0, 0.0]
    state = advance(scene, state.with_fields(cell_type=torch.tensor([0, 1])), 3)
    assert state.m.tolist() == pytest.approx([0.0, 0.3])


@pytest.mark.filterwarnings("ignore:Circuit has rates for cells of type:UserWarning")  # by hand
@pytest.mark.parametrize("types", [[0, 1], [0, 0]])
def test_constants_drawn_by_type_are_not_needed_by_cells_without_the_circuit(types):
    """They are drawn for these cells too, so that they have one should they become of the type."""
    cells = tf.Cells([[0.0, 0.0], [0.0, 3.0]], [1.0, 0.0], cell_type=types)
    drawn = tf.LogNormal(1.0, 0.2)

    def start(rates, k):
        scene = tf.Scene(tf.Circuit(rates, species=("m",), k=k, g=1.0), founders=cells)
        return scene, scene.bind(dtype=F64).start()

    scene, state = start({1: made}, {1: drawn})
    assert torch.equal(state.circuit_k, start({1: made}, drawn)[1].circuit_k)
    changed = advance(scene, state.with_fields(cell_type=torch.ones(2, dtype=torch.int64)), 1)
    assert changed.m.tolist() == pytest.approx(
        (state.circuit_k * (1 - math.exp(-0.1))).tolist(), rel=1e-3
    )
    assert torch.equal(start({1: made, 2: idle}, {1: drawn})[1].circuit_k, state.circuit_k)
    for rates, k, words in (
        ({1: made, 2: made}, {1: drawn}, r"values for .* types 1, but the rates of type 2.*Add 2:"),
        (made, {1: drawn}, r"values for the cell types 1, but a cell has type 0\. Add 0: …"),
    ):
        with pytest.raises(tf.InputError, match=r"Circuit\.k has " + words):
            start(rates, k)


def test_cells_without_a_type_are_of_type_0():
    state = resting(tf.Circuit({0: made}, species=("m",), k=1.0, g=0.0), 2).bind().start()
    assert state.cell_type.tolist() == [0, 0]
    assert (
        "cell_type"
        not in resting(tf.Circuit(made, species=("m",), k=1.0, g=0.0), 2).bind().start().fields
    )


def test_parameters_per_colony(dtype, device):
    """m = k/g (1 − e^(−g t)), each colony with its own k and g; asked for 1e-8, float32 holds 10
    steps to 40 eps."""
    k, g = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.5, 1.0, 0.25], dtype=F64)
    scene = resting(tf.Circuit(made, species=("m",), k=k, g=g, rtol=1e-8), 2)
    last = advance(scene, scene.bind(3, dtype=dtype, device=device).start(), 10)
    exact = (k.double() / g * (1 - torch.exp(-g))).repeat_interleave(2)
    assert last.m.dtype == dtype
    assert torch.allclose(
        last.m.double().cpu(),
        exact,
        rtol=1e-7 if dtype == F64 else 40 * torch.finfo(dtype).eps,
        atol=0,
    )


@pytest.mark.parametrize(
    ("method", "bound"),
    [
        ("rosenbrock", 1e-4),
        ("rk4", 1e-6),
        ("heun3", 1e-4),
        ("heun2", 2e-3),
        ("midpoint", 2e-3),
        ("euler", 0.06),
    ],
)
def test_every_method_gets_there(method, bound):
    """x' = 1 − x over an hour in ten steps: the order's power of 0.1, with a constant below 1."""
    scene = resting(tf.Circuit(made, species=("m",), k=1.0, g=1.0, method=method))
    assert float(advance(scene, scene.bind(dtype=F64).start(), 10).m) == pytest.approx(
        1 - math.exp(-1), rel=bound
    )


def test_more_steps_of_an_explicit_method_are_smaller_ones():
    found = [
        float(
            advance(
                s := resting(
                    tf.Circuit(made, species=("m",), k=1.0, g=1.0, method="euler", steps=n)
                ),
                s.bind(dtype=F64).start(),
                1,
                0.1 * n,
            ).m
        )
        for n in (1, 5)
    ]
    assert found[1] == pytest.approx(1 - 0.9**5, rel=1e-14) and found[0] == pytest.approx(
        0.1, rel=1e-14
    )


def test_making_and_thinning_take_turns_at_second_order():
    """u' = k A/V − (g + d) u in a cell that grows as e^{gt}: from a state in balance, against the
    law itself by fine steps of an explicit rule."""

    def made(u, s, p, cell):
        return {"u": cell.area / cell.volume - 0.3 * u.u}

    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Circuit(made, species=("u",), rtol=1e-9, atol=1e-12),
        founders=tf.Cells.single(2),
    )
    first = scene.bind(dtype=F64).start()
    u, n, v0, r = 0.0, 20_000, float(first.volume), float(first.radius)
    slope = lambda t, u: (
        2 * math.pi * r * ((v0 * math.exp(t)) / (math.pi * r * r) + 2 * r / 3) / (v0 * math.exp(t))
        - 1.3 * u
    )
    for k in range(n):  # the midpoint rule: its own error is 1e-9 of what is looked for
        t, h = k / n, 1 / n
        u += h * slope(t + h / 2, u + h / 2 * slope(t, u))
    errors = [abs(float(advance(scene, first, steps, 1 / steps).u) - u) for steps in (4, 8, 16)]
    # 4 at second order, 2 at first; the next term of the error is below a tenth at these steps
    assert (
        all(3.6 <= a / b <= 4.4 for a, b in itertools.pairwise(errors)) and errors[-1] < 2e-3 * u
    ), errors


def test_a_rate_may_ask_for_everything_about_its_cell(device):
    seen = {}

    def asks(u, s, p, cell):
        for name in (
            "volume",
            "area",
            "length",
            "radius",
            "x",
            "y",
            "growth_rate",
            "cell_type",
            "mark",
            "time",
        ):
            seen[name] = getattr(cell, name)
        return {"u": cell.x + cell.mark}

    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Rules(idle_rule, variables={"mark": 2.0}),
        tf.Circuit({0: asks}, species=("u",), backend="torch"),  # so that it is called in steps
        founders=tf.Cells([[3.0, 4.0]], [1.0, 0]),
    )
    model = scene.bind(2, dtype=F64, device=device)
    state = model.start()
    last = model.step(state, 0.1)
    # made at 5/h through a step of 0.1 h, and thinned by half of the step's growth
    assert last.u.tolist() == pytest.approx([0.5 * math.exp(-0.05)] * 2)
    assert seen["y"].tolist() == [4.0, 4.0] and seen["growth_rate"].tolist() == [1.0, 1.0]
    half_way = state.volume * math.exp(0.05)
    torch.testing.assert_close(seen["volume"], half_way, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(
        seen["volume"], capsule.volume(seen["length"], seen["radius"]), rtol=1e-12, atol=0.0
    )
    torch.testing.assert_close(
        seen["area"], capsule.area(seen["length"], seen["radius"]), rtol=1e-12, atol=0.0
    )
    assert {"position", "growth_rate", "mark", "cell_type"} <= set(
        next(e for e in model.effects if e.title == "circuit").reads()
    )


def idle_rule(cells):
    cells.mark = cells.mark
