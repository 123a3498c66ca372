"""Circuits and transport of what they exchange in one equation: `Medium(exchange="together")`."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from exchanging_cells import BOX, F64, advance, diffused, exchanging, resting, totals
from helpers import step
from scipy.integrate import solve_ivp

import torchfilm as tf
from torchfilm import together
from torchfilm.signals.exchange import stencil
from torchfilm.tools.tangents import forward_mode, tangent, with_tangent

DT = 0.05
SIX = tf.Cells(
    [[0.0, 0.0], [3.0, 1.0], [-2.0, 4.0], [1.0, -5.0], [1.5, 0.0], [9.0, 9.0]],
    [[1.0, 0.0]] * 6,
    2.0,
)
TIGHT = {"rtol": 1e-8, "atol": 1e-10}


def medium(diffusion=30.0, decay=0.5, initial=0.0, **options) -> tf.Medium:
    given = {"box": BOX, "spacing": 4.0, "exchange": "together", **options}
    return tf.Medium(ahl=tf.Signal(diffusion, decay=decay, initial=initial), **given)


def lux(u, s, p, cell):
    """Made where there is some already, and exchanged."""
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    made = 1.0 + 0.2 * cell.x + p.gain * u.ahl**2 / (1 + u.ahl**2)
    return {"ahl": made + into / cell.volume}, {"ahl": -into}


def talking(D1=10.0, gain=20.0, cells=SIX, circuit=None, **options) -> tf.Scene:
    given = {**TIGHT, "D1": D1, "gain": gain, **(circuit or {})}
    return resting(medium(**options), tf.Circuit(lux, species="ahl", **given), cells)


def exact(state: tf.State, D1: float, gain: float, diffusion: float, hours: float):
    """Species and field after so many hours by an implicit integrator at 1e-10: voxels and cells in
    one system of equations. The faces let nothing pass."""
    grid = state.layout.grid
    shape, h = grid.shapes[0], grid.spacing[0]
    at = stencil(grid, state.position_3d, state.colony)
    node, weight = at.node.numpy(), at.weight.double().numpy()
    area, volume = state.area.numpy(), state.volume.numpy()
    count, x = len(volume), state.position[:, 0].numpy()

    def rates(t, y):
        field, ahl = y[:-count].reshape(shape), y[-count:]
        change = diffused(field, diffusion / h**2) - 0.5 * field.reshape(-1)
        here = (weight * y[:-count][node]).sum(1)
        into = D1 * (here - ahl) * area
        share = weight * np.where(
            (into > 0)[:, None], y[:-count][node] / np.maximum(here, 1e-300)[:, None], 1.0
        )
        np.subtract.at(change, node, share * (into / grid.voxel_volume)[:, None])
        made = 1.0 + 0.2 * x + gain * ahl**2 / (1 + ahl**2)
        return np.concatenate([change, made + into / volume])

    start = np.concatenate([state.signals["ahl"].numpy(), state.ahl.numpy()])
    found = solve_ivp(rates, (0, hours), start, method="LSODA", rtol=1e-10, atol=1e-13)
    return found.y[-count:, -1], found.y[:-count, -1]


@pytest.mark.parametrize(("diffusion", "D1"), [(0.0, 10.0), (30.0, 1.0), (100.0, 1e3), (1e3, 30.0)])
def test_order_two_where_the_series_carries(diffusion, D1):
    """Against one system of equations of voxels and cells, also where a cell exchanges itself tens
    of times in a step, and two cells sit in one voxel."""
    first = talking().bind(dtype=F64).start()
    ahl, field = exact(first, D1, 20.0, diffusion, 0.4)
    errors = []
    for parts in (8, 16, 32):
        made = talking(D1=D1, diffusion=diffusion)
        end = advance(made, made.bind(dtype=F64).start(), parts, 0.4 / parts)
        off = (end.ahl.numpy() - ahl, end.signals["ahl"].numpy() - field)
        errors.append(
            max(np.abs(x).max() / x0.max() for x, x0 in zip(off, (ahl, field), strict=True))
        )
    assert errors[0] < 1e-2
    assert errors[2] < errors[1] / 2.5 < errors[0] / 6


@pytest.mark.parametrize("D1", [1.0, 1e4])
@pytest.mark.parametrize("diffusion", [1e5, 2e6])
def test_where_both_are_fast(diffusion, D1):
    """Real signals cross a colony in a second, and a membrane in less: then both follow at once,
    whatever the step."""
    first = talking().bind(dtype=F64).start()
    ahl, field = exact(first, D1, 20.0, diffusion, 0.4)
    made = talking(D1=D1, diffusion=diffusion)
    end = advance(made, made.bind(dtype=F64).start(), 8, 0.05)
    # the field is that of what cells gave half a step before: at 0.4 h, 1.2 % of what has grown
    np.testing.assert_allclose(end.ahl.numpy(), ahl, rtol=1.5e-2)
    np.testing.assert_allclose(end.signals["ahl"].numpy(), field, rtol=1.5e-2)


@pytest.mark.parametrize("diffusion", [0.0, 100.0, 2e6])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_amounts_are_kept_to_rounding(diffusion, dtype):
    """Whatever the tolerance of the iteration, and also where cells take all there is."""
    cells, fast = (
        resting(medium(diffusion, 0.0), exchanging(5.0, D1=1e4), SIX),
        1e-6 if dtype == torch.float32 else 1e-9,
    )
    start = cells.bind(dtype=dtype).start()
    end = advance(cells, start, 10, DT)
    assert float(totals(end)) == pytest.approx(float(totals(start)), rel=fast)
    assert float(end.signals["ahl"].min()) >= 0 and float(end.ahl.min()) >= 0


@pytest.mark.parametrize("diffusion", [10.0, 1e5])
def test_a_steady_state_does_not_depend_on_the_step(diffusion):
    ends = []
    for dt in (0.2, 0.05):
        made = talking(diffusion=diffusion)
        ends.append(advance(made, made.bind(dtype=F64).start(), round(40 / dt), dt))
    for name in ("ahl", "out.ahl"):
        torch.testing.assert_close(ends[0].fields[name], ends[1].fields[name], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("circuit", [{}, {"method": "rk4", "steps": 40}])
@pytest.mark.parametrize("diffusion", [30.0, 1e5])
def test_both_backends(circuit, diffusion):
    ends = []
    for backend in ("compiled", "torch"):
        given = {**circuit, "backend": backend}
        made = talking(circuit=given, diffusion=diffusion, backend=backend)
        ends.append(advance(made, made.bind(dtype=F64).start(), 3, DT))
    for name in ("ahl", "out.ahl"):
        torch.testing.assert_close(
            ends[0].fields[name], ends[1].fields[name], rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("diffusion", [30.0, 1e5])
def test_parts_of_a_step_are_steps_of_the_scene(diffusion):
    often, short = talking(diffusion=diffusion, steps=4), talking(diffusion=diffusion)
    once = advance(often, often.bind(dtype=F64).start(), 3, DT)
    each = advance(short, short.bind(dtype=F64).start(), 12, DT / 4)
    for name in ("ahl", "out.ahl"):
        torch.testing.assert_close(once.fields[name], each.fields[name], rtol=1e-9, atol=1e-12)
    report = once.reports["circuit"]
    assert int(report.iterations) >= 8 and report.exchanged is None


@pytest.mark.parametrize("diffusion", [30.0, 1e5])
def test_the_same_bits_in_any_batch(diffusion):
    """A colony that needs more iterations leaves the others alone."""
    fast = torch.tensor([1.0, 1e3, 10.0], dtype=F64)
    made = talking(D1=fast, diffusion=diffusion)
    model = made.bind(colonies=3, dtype=torch.float32)
    together = advance(made, model.start(), 4, DT)
    for k in range(3):
        alone = model.start().select([k])
        end = advance(made, alone, 4, DT)
        mine = together.colony == k
        assert torch.equal(end.ahl, together.ahl[mine])


def reading(u, s, p, cell):
    return {"seen": s.ahl - u.seen}


def test_a_circuit_that_only_reads_finds_the_signal_half_way():
    """So that it is of second order, too."""
    ends = []
    for parts in (8, 16, 64):
        made = tf.Scene(
            tf.Circuit(lux, species="ahl", D1=10.0, gain=20.0, name="A", **TIGHT),
            tf.Circuit(reading, species="seen", name="B", **TIGHT),
            medium(), founders=SIX,
        )  # fmt: skip
        ends.append(advance(made, made.bind(dtype=F64).start(), parts, 0.4 / parts).B_seen)
    assert (ends[0] - ends[2]).abs().max() > 3 * (ends[1] - ends[2]).abs().max() > 1e-9


@pytest.mark.parametrize("exchange", ["together", "turns"])
@pytest.mark.parametrize("backend", [None, "torch"])
def test_what_two_circuits_give_adds_up(exchange, backend):
    """The medium gains what both lose, whichever comes first."""
    A, B = (
        exchanging(first, D1=speed, name=name, backend=backend)
        for name, first, speed in (("A", 3.0, 1.0), ("B", 5.0, 2.0))
    )
    made = tf.Scene(A, B, medium(decay=0.0, exchange=exchange, backend=backend), founders=SIX)
    start = made.bind(dtype=F64).start()
    end = advance(made, start, 2, DT)
    gave = [
        float(((start.fields[n] - end.fields[n]) * end.volume).sum()) for n in ("A_ahl", "B_ahl")
    ]
    assert gave[1] > gave[0] > 1.0
    assert float(totals(end, inside=False)) == pytest.approx(sum(gave), rel=1e-9)


def test_cells_in_a_reservoir_and_signals_without_cells():
    """What cells beyond the box give goes to the reservoir; colonies without cells diffuse."""
    made = resting(
        medium(outside="reservoir", decay=0.0), exchanging(4.0, D1=2.0),
        tf.Cells([[0.0, 0.0], [30.0, 0.0]], [[1.0, 0.0]] * 2, 2.0),
    )  # fmt: skip
    start = made.bind(dtype=F64).start()
    end = advance(made, start, 5, DT)
    assert float(end.ahl_reservoir) > 1.0
    assert float(totals(end)) == pytest.approx(float(totals(start)), rel=1e-9)
    left = end.remove(torch.ones(2, dtype=torch.bool), "left")
    after = advance(made, left, 5, DT)
    assert after.signals["ahl"].max() < left.signals["ahl"].max()
    assert float(after.signals["ahl"].sum()) == pytest.approx(float(left.signals["ahl"].sum()))


@pytest.mark.parametrize("reservoir", [0.0, 9.0])
@pytest.mark.parametrize("diffusion", [30.0, 1e5])
def test_both_backends_keep_what_cells_beyond_the_box_exchange_out_of_it(reservoir, diffusion):
    """The box has what its source and the cell inside give, to rounding, whatever the other gives
    or takes."""
    cells = tf.Cells([[0.0, 0.0], [30.0, 0.0]], [[1.0, 0.0]] * 2, 2.0)
    ahl = tf.Signal(diffusion, initial=1.0, reservoir=reservoir, source=0.7)
    ends = []
    for backend in ("compiled", "torch"):
        around = tf.Medium(
            ahl=ahl, box=BOX, spacing=4.0, exchange="together", outside="reservoir", backend=backend
        )
        made = resting(around, exchanging(4.0, D1=2.0, backend=backend, **TIGHT), cells)
        start = made.bind(dtype=F64).start()
        ends.append(advance(made, start, 3, DT))
        inside = lambda state: totals(state, inside=False) - state.ahl_reservoir
        gave = float((start.ahl[0] - ends[-1].ahl[0]) * start.volume[0])
        gave += 0.7 * start.layout.grid.nodes * start.layout.grid.voxel_volume * 3 * DT
        assert float(inside(ends[-1]) - inside(start)) == pytest.approx(gave, rel=1e-8)
        assert bool((ends[-1].ahl[1] > 4.0) == (reservoir > 4.0))
    for name in ("ahl", "out.ahl", "ahl_reservoir"):
        torch.testing.assert_close(*(end.fields[name] for end in ends), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("exchange", ["turns", "together"])
@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_reservoir_of_nothing_takes_from_cells_that_had_nothing(exchange, backend):
    """At first nothing passes, in either direction."""
    circuit = tf.Circuit(lux, species="ahl", D1=10.0, gain=20.0, backend=backend)
    made = resting(
        medium(outside="reservoir", exchange=exchange), circuit,
        tf.Cells([[30.0, 0.0]], [[1.0, 0.0]], 2.0),
    )  # fmt: skip
    end = advance(made, made.bind().start(), 4, DT)
    assert float(end.ahl_reservoir) > 0.1


def greedy(u, s, p, cell):
    return {"ahl": 100.0 / cell.volume}, {"ahl": -100.0}


def test_cells_that_take_what_is_not_there_are_named():
    made = resting(medium(), tf.Circuit(greedy, species="ahl"), SIX)
    with pytest.raises(tf.SimulationError, match="cells take more of a signal than there is"):
        for _ in tf.simulate(made, until=0.2):
            pass


def test_counted_molecules_take_turns():
    reactions = [
        tf.Reaction({}, {"ahl": 1}, rate=10.0),
        tf.Reaction({"ahl": 1}, {"out.ahl": 1}, rate=1.0),
    ]
    circuit = tf.Circuit(reactions, species="ahl", method="tau_leap")
    with pytest.raises(tf.InputError, match="makes amounts that jump"):
        resting(medium(), circuit, SIX).bind()


def test_a_nutrient_that_circuits_exchange_takes_turns():
    def fed(u, s, p, cell):
        return {"food": 0.0 * u.food}, {"food": 0.1}

    made = tf.Scene(
        tf.Monod("food"), tf.Growth(), tf.Circuit(fed, species="food"),
        tf.Medium(food=tf.Signal(10.0, initial=1.0), box=BOX, spacing=4.0, exchange="together"),
        founders=SIX,
    )  # fmt: skip
    with pytest.raises(tf.InputError, match="Nutrition moves food, and a circuit exchanges it"):
        made.bind()


@pytest.mark.parametrize(
    ("moves", "backend", "diffusion"),
    [(True, "torch", 30.0), (True, None, 1e5), (False, None, 30.0), (False, None, 1e5)],
)
def test_derivatives(diffusion, backend, moves, monkeypatch):
    """Backward pass and forward mode against differences, by constants of cells and of transport,
    or of cells alone: then kernels carry the tangents."""
    monkeypatch.setattr(together, "FINE", 1e-8)  # or differences would see where the solve ends

    def outcome(x):
        circuit = {"rtol": 0.05, "atol": 0.05, "backend": backend}
        speed = diffusion * x if moves else diffusion
        made = talking(D1=10.0 * x, gain=20.0 * x, circuit=circuit, diffusion=speed, initial=0.01)
        state = made.bind(dtype=F64).start()
        for _ in range(3):
            state = step(made, state, 0.01)
        assert int(state.reports["circuit"].steps.max()) == 1
        return (state.ahl * torch.arange(1.0, 7.0)).sum() + state.signals["ahl"][:9].sum()

    at = torch.tensor(1.0, dtype=F64, requires_grad=True)
    outcome(at).backward()
    with forward_mode():
        forward = tangent(
            outcome(with_tangent(torch.tensor(1.0, dtype=F64), torch.tensor(1.0, dtype=F64)))
        )
    ahead, back = (
        outcome(torch.tensor(1.0 + h, dtype=F64, requires_grad=True)) for h in (1e-4, -1e-4)
    )
    slope = float(ahead.detach() - back.detach()) / 2e-4
    assert float(at.grad) == pytest.approx(slope, rel=1e-5)
    assert float(forward) == pytest.approx(slope, rel=1e-5)


def igniting(u, s, p, cell):
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    made = p.base + 100.0 * u.ahl**2 / (1e-4 + u.ahl**2)
    return {"ahl": made + into / cell.volume}, {"ahl": -into}


@pytest.mark.parametrize("diffusion", [0.0, 30.0, 3000.0])
def test_cells_that_ignite_within_a_step(diffusion):
    """They switch on a thousandfold, and share what they make through their voxels."""
    circuit = tf.Circuit(igniting, species="ahl", D1=1e3, base=0.1)
    made = resting(medium(diffusion), circuit, SIX)
    end = advance(made, made.bind(dtype=F64).start(), 20, DT)
    short = advance(made, made.bind(dtype=F64).start(), 160, DT / 8)
    torch.testing.assert_close(end.ahl, short.ahl, rtol=0.05, atol=0.0)


def test_a_gradient_passes_to_a_circuit_that_only_reads():
    def seen(k):
        read = lambda u, s, p, cell: {"seen": p.k * s.ahl - u.seen}
        made = tf.Scene(
            tf.Circuit(lux, species="ahl", D1=10.0, gain=20.0, name="A"),
            tf.Circuit(read, species="seen", name="B", k=k),
            medium(), founders=SIX,
        )  # fmt: skip
        return advance(made, made.bind(dtype=F64).start(), 3, DT).B_seen.sum()

    k = torch.tensor(1.0, dtype=F64, requires_grad=True)
    seen(k).backward()
    # without a gradient the equation is solved to the circuits' tolerance
    assert float(k.grad) == pytest.approx(float(seen(torch.tensor(1.0))), rel=1e-4)


@pytest.mark.parametrize("backend", [None, "torch"])
@pytest.mark.parametrize("initial", [1.0, 0.0])
@pytest.mark.parametrize("exchange", ["together", "turns"])
def test_derivatives_by_an_exchange_that_is_0(backend, initial, exchange):
    """Nothing is given or taken; and where there is nothing to take, cells would still give."""

    def field(D1):
        circuit = tf.Circuit(
            lux, species="ahl", initial={"ahl": 2.0}, D1=D1, gain=0.0, backend=backend, **TIGHT
        )
        made = resting(medium(initial=initial, exchange=exchange), circuit, SIX)
        return advance(made, made.bind(dtype=F64).start(), 1, DT).signals["ahl"].sum()

    at = torch.tensor(0.0, dtype=F64, requires_grad=True)
    field(at).backward()
    zero, one = torch.zeros((), dtype=F64), torch.ones((), dtype=F64)
    with forward_mode():
        forward = tangent(field(with_tangent(zero, one)))
    slope = float(field(torch.tensor(1e-6, dtype=F64)) - field(zero)) / 1e-6
    assert slope > 0.01
    assert float(at.grad) == pytest.approx(slope, rel=1e-4)
    assert float(forward) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("given", [{"method": "implicit"}, {"splitting": "lie"}])
def test_a_method_of_turns_means_turns(given):
    plain = resting(
        tf.Medium(ahl=tf.Signal(30.0), box=BOX, spacing=4.0, **given), exchanging(), SIX
    )
    report = advance(plain, plain.bind().start(), 1, DT).reports["circuit"]
    assert report.exchanged is not None and not isinstance(report.iterations, torch.Tensor)
    with pytest.raises(tf.InputError, match="method and splitting are of turns"):
        resting(medium(**given), exchanging(), SIX).bind()


def eating(u, s, p, cell):
    return {"dm": 0.0 * u.dm}, {"o2": -p.q * cell.volume * s.o2 / (p.K + s.o2)}


def breathing(eaters: tuple, q: float, K: float, diffusion: float) -> tf.Scene:
    """Cells that take up what comes from the sides, 1e5 times what is there in a step."""
    fed = tf.BoundaryConditions(x=tf.Dirichlet(1.0), y=tf.Dirichlet(1.0))
    food = tf.Medium(
        o2=tf.Signal(diffusion, initial=1.0, boundary=fed), box=BOX, spacing=4.0, depth=1.0
    )
    return tf.Scene(*eaters, food, founders=tf.inoculum(40, radius=12.0), dim=2)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_cells_that_live_on_what_reaches_them_take_as_much_as_by_monod(backend):
    """The residual of a solve must not hide what a hungry cell finds."""
    q, K, diffusion = 2e5, 1e-3, 1e6
    circuit = tf.Circuit(eating, species="dm", q=q, K=K, backend=backend, rtol=1e-7, atol=1e-12)
    monod = tf.Monod("o2", rate=1e-3, half=K, growth_yield=1e-3 / q)
    ends = []
    for eaters in ((tf.Growth(rate=1e-3), circuit), (tf.Growth(), monod)):
        scene = breathing(eaters, q, K, diffusion)
        *_, state = tf.simulate(scene, until=0.05, dt=0.025, dtype=F64)
        ends.append(state.signals["o2"])
        report = state.reports.get("circuit")
    assert report is None and float(ends[1].min()) < 0.01 < 0.1 < float(ends[1].mean())
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-3, atol=1e-4)


def test_an_equation_that_is_not_solved_is_warned_of(monkeypatch):
    monkeypatch.setattr(together, "MOST", 1)
    monkeypatch.setattr(together, "FINEST", 2)
    eaters = tf.Growth(rate=1e-3), tf.Circuit(eating, species="dm", q=2e5, K=1e-3)
    scene = breathing(eaters, 2e5, 1e-3, 1e6)
    words = "could not be solved together.*took turns there"
    with pytest.warns(RuntimeWarning, match=words):
        *_, state = tf.simulate(scene, until=0.05, dt=0.025)
    assert state.reports["circuit"].unsolved.tolist() == [2]


def test_a_circuit_that_is_starved_by_monod_is_warned_of():
    """Nutrition comes first in a step, so that little is left where food arrives fast."""
    q, K = 2e4, 0.1
    monod = tf.Monod("o2", rate=1e-3, half=K, growth_yield=1e-3 / q)
    both = monod, tf.Growth(), tf.Circuit(eating, species="dm", q=q, K=K)
    with pytest.warns(RuntimeWarning, match="Monod takes, too.*Let one of them take it all"):
        list(tf.simulate(breathing(both, q, K, 1e6), until=0.05, dt=0.025))
    giving = lambda u, s, p, cell: ({"dm": 0.0 * u.dm}, {"o2": 500.0})
    gives = monod, tf.Growth(), tf.Circuit(giving, species="dm")
    list(tf.simulate(breathing(gives, q, K, 100.0), until=0.05, dt=0.025))
    gentle = monod, tf.Growth(), tf.Circuit(eating, species="dm", q=2.0, K=K)
    list(tf.simulate(breathing(gentle, q, K, 1e6), until=0.05, dt=0.025))


def eats(u, s, p, cell):
    """Fast, and not at all where there is nothing."""
    taken = p.most * s.ahl / (s.ahl + p.half)
    return {"eaten": taken / p.unit}, {"ahl": -taken * cell.volume}


def eating_scene(unit: float, diffusion: float, cells=SIX, **circuit) -> tf.Scene:
    numbers = {"most": 1e3 * unit, "half": 0.05 * unit, "unit": unit, **circuit}
    made = tf.Circuit(eats, species="eaten", **numbers)
    return resting(medium(diffusion, decay=0.0, initial=unit), made, cells)


@pytest.mark.parametrize(
    ("dtype", "backend", "half", "most"),
    [
        (torch.float32, None, 0.05, 1e3), (torch.float32, "torch", 0.05, 1e3),
        (F64, None, 1e-3, 1e4), (F64, "torch", 1e-3, 1e4), (F64, None, 1e-6, 1e4),
    ],
)  # fmt: skip
def test_cells_may_eat_all_there_is(dtype, backend, half, most):
    """Down to where numbers end, also by a law that saturates below what the solve looks at."""
    made = eating_scene(1.0, 1e5, backend=backend, half=half, most=most)
    first = made.bind(dtype=dtype).start()
    whole = float(first.signals["ahl"].double().sum()) * first.layout.grid.voxel_volume
    for state in tf.simulate(made, first, until=60 * DT, dt=DT):
        assert float(state.signals["ahl"].min()) >= 0.0
    assert float(state.signals["ahl"].max()) < 1e-20
    eaten = float((state.eaten.double() * state.volume.double()).sum())
    assert eaten == pytest.approx(whole, rel=1e-5)


@pytest.mark.parametrize("initial", [2e-6, 2e-12])
def test_a_rate_that_does_not_fall_with_what_is_there_is_named(initial):
    """However little there is: nothing is made of nothing."""

    def takes(u, s, p, cell):
        return {"eaten": p.rate + 0 * s.ahl}, {"ahl": -p.rate * cell.volume}

    circuit = tf.Circuit(takes, species="eaten", rate=200 * initial, atol=1e-3 * initial)
    made = resting(medium(1e5, decay=0.0, initial=initial), circuit, SIX)
    # as the last part of a step begins with much or with next to nothing
    named = "cells take more of a signal than there is|push a concentration below zero, 'out.ahl'"
    with pytest.raises(tf.SimulationError, match=named):
        for state in tf.simulate(made, made.bind(dtype=F64).start(), until=400 * DT, dt=DT):
            eaten = float((state.eaten * state.volume).sum())
            assert eaten <= initial * 32.0**2 * 4.0 * 1.001


def test_signals_in_too_large_a_unit_are_warned_of():
    """nM in M: all of it is less than the solve looks at. With the advice it is as in nM."""
    with pytest.warns(UserWarning, match=r"its signal 'ahl' is of about 1e-09.*Give atol=1e-15"):
        eating_scene(1e-9, 50.0).bind()
    nano = advance(made := eating_scene(1.0, 50.0), made.bind(dtype=F64).start(), 5, DT)
    made = eating_scene(1e-9, 50.0, atol=1e-15)
    molar = advance(made, made.bind(dtype=F64).start(), 5, DT)
    torch.testing.assert_close(molar.eaten, nano.eaten, rtol=1e-3, atol=0.0)
