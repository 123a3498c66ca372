"""Steps take the mean of a schedule over their time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.effects import medium_transport
from torchfilm.signals.schedule import held_together

F64 = {"dtype": torch.float64}


def summed(u, s, p, cell):
    return {"dye": p.light + 0.0 * u.dye}


@pytest.mark.parametrize(("begin", "end"), [(1.02, 1.38), (1.1, 1.4), (1.05, 2.0), (0.0, 0.96)])
@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_pulses_that_end_within_steps_give_their_dose(begin, end, backend):
    """To circuits, rules, and reactions and sources of the medium; in parts that begin anywhere,
    too."""
    light = tf.Schedule({0: 0.0, begin: 1.0, end: 0.0} if begin else {0: 1.0, end: 0.0})

    def see(cells):
        cells.seen = cells.seen + cells.dt * cells.p.light

    box = {"box": ((-9, -9), (9, 9)), "spacing": 3.0, "depth": 1.0}
    fed = tf.Signal(diffusion=1.0, source=light)
    scene = tf.Scene(
        tf.Circuit(summed, species="dye", light=light, dilution=False, backend=backend),
        tf.Rules(see, variables={"seen": 0.0}, parameters={"light": light}),
        tf.Medium(a=tf.Signal(diffusion=1.0), b=fed, **box, backend=backend),
        tf.MediumReactions(lambda s, p: {"a": p.light + 0.0 * s.a}, parameters={"light": light}),
        dim=2,
    )  # fmt: skip
    *_, first = tf.simulate(scene.bind(**F64), until=0.05, dt=0.05)
    *_, last = tf.simulate(scene, first, until=2.25, dt=0.1)
    for found in (last.dye, last.seen, last.signals["a"][0], last.signals["b"][0]):
        assert float(found) == pytest.approx(end - begin, rel=1e-6)


def test_means_are_those_of_the_values_and_their_times():
    pulse = tf.Schedule({0: 0.0, 1: 2.0, 1.5: torch.tensor([4.0, 8.0])})
    assert pulse.mean(0.0, 1.0) == 0.0 and pulse.mean(1.0, 1.5) == 2.0
    assert pulse.mean(0.5, 1.5) == 1.0 and pulse.mean(1.25, 1.75).tolist() == [3.0, 5.0]
    assert pulse.mean(-1.0, 3.0).tolist() == pytest.approx([1.75, 3.25])
    again = tf.Schedule({0: 0.0, 0.25: 1.0}, period=1.0)
    for begin, end in ((0.0, 1.0), (0.5, 7.5), (3.75, 4.5), (0.1, 0.9), (-2.25, 0.75)):
        times = np.linspace(begin, end, 7001)[:-1] + (end - begin) / 14000
        assert again.mean(begin, end) == pytest.approx(again(times).mean(), abs=2e-3)
    assert again.shares(2.0 - 1e-12, 2.25) == [(0, 1.0)] == again.shares(2.0, 2.25 + 1e-12)
    assert tf.Schedule({0: [0.0, 4.0], 1: [2.0, 4.0]}).mean(0.5, 1.5).tolist() == [1.0, 4.0]
    with pytest.raises(tf.InputError, match=r"from 1 h = .*numbers, of which there is a mean"):
        tf.Schedule({0: 1.0, 1: {0: 1.0}}).mean(0.5, 1.5)
    with pytest.raises(tf.InputError, match=r"Schedule.mean\(end\) = 1.0"):
        again.mean(1.0, 1.0)


def test_a_restart_within_a_pulse_and_derivatives_by_it():
    """The mean passes derivatives to each value by its share."""
    strength = torch.tensor([1.0, 3.0], dtype=torch.float64, requires_grad=True)
    light = tf.Schedule({0: 0.0, 0.53: strength})
    circuit = tf.Circuit(summed, species="dye", light=light, dilution=False)
    model = tf.Scene(circuit, dim=2).bind(2, dtype=torch.float64)
    state = model.start()
    for _ in range(10):
        state = model.step(state, 0.1)
    assert state.span is None and state.dye.tolist() == pytest.approx([0.47, 1.41])
    (slope,) = torch.autograd.grad(state.dye.sum(), strength)
    assert slope.tolist() == pytest.approx([0.47, 0.47])


OPEN = tf.BoundaryConditions(x=(tf.Open(1.0), tf.Open()), y=tf.Periodic())
PLACES = {
    "face": lambda x: {"boundary": tf.BoundaryConditions(x=(tf.Dirichlet(x), tf.NoFlux()))},
    "flux": lambda x: {"boundary": tf.BoundaryConditions(x=(tf.Flux(x), tf.Robin(0.0, 9.0)))},
    "wash": lambda x: {"flow": (60.0, 0.0), "boundary": tf.BoundaryConditions(x=tf.Open(x))},
    "flow": lambda x: {"flow": _each(lambda v: (40.0 * v, 10.0), x), "boundary": OPEN},
    "swirl": lambda x: {
        "flow": _each(lambda v: lambda at: torch.stack([0 * at[:, 0] + 40.0 * v, at[:, 0]], 1), x),
        "boundary": OPEN,
    },
}


def _each(make, given):
    if not isinstance(given, tf.Schedule):
        return make(given)
    return tf.Schedule({t: make(x) for t, x in given.values.items()}, given.period)


def _fed(where, value, **more):
    """The food of a medium that a value, or a schedule of them, feeds or moves."""
    box = {"box": ((-12, -12), (12, 12)), "spacing": 4.0, "depth": 1.0}
    food = tf.Signal(diffusion=500.0, initial=0.2, decay=0.1)
    eats = tf.Monod("food", rate=1.0, half=0.5) if more.pop("eats", False) else tf.Growth()
    return tf.Scene(
        eats, *([tf.Growth()] if isinstance(eats, tf.Monod) else []), tf.Mechanics(dim=2),
        tf.Medium(food=food, **PLACES[where](value), **box, **more),
    )  # fmt: skip


def _food(scene, dt, until=0.6):
    *_, last = tf.simulate(scene.bind(**F64), until=until, dt=dt)
    return last.signals["food"]


@pytest.mark.filterwarnings("ignore:no effect|.*writes|.*reads:UserWarning")
@pytest.mark.parametrize("eats", [False, True])
@pytest.mark.parametrize("where", PLACES)
def test_a_medium_meets_the_mean_of_what_changes_within_a_step(where, eats):
    """Steps of 0.05 h, as steps of 1/600 h at whose beginnings the values change."""
    pulse = tf.Schedule({0: 0.0, 0.115: 1.0, 0.365: 0.25})
    exact = _food(_fed(where, pulse, eats=eats), 1 / 600)
    found = _food(_fed(where, pulse, eats=eats), 0.05)
    early, late = (
        _food(_fed(where, tf.Schedule({0: 0.0, 0.1 + x: 1.0, 0.35 + x: 0.25}), eats=eats), 0.05)
        for x in (0.0, 0.05)
    )
    error = (found - exact).abs().max()
    assert error < 0.15 * (early - late).abs().max()


def test_what_changes_in_one_step_is_held_together():
    """A flow that comes as the food at its face goes carries none in."""
    low, high = {0: 0.0, 0.12: 1.0}, {0: 1.0, 0.12: 0.0}
    held = held_together([tf.Schedule(low), tf.Schedule(high)], 0.1, 0.15)
    assert held == {(0, 0): (0.4, pytest.approx(0.11)), (1, 1): (0.6, pytest.approx(0.135))}
    apart = held_together([tf.Schedule(low), tf.Schedule({0: 1.0, 0.13: 0.0})], 0.1, 0.15)
    shares = {places: share for places, (share, _) in apart.items()}
    assert shares == {(0, 0): 0.4, (1, 0): 0.2, (1, 1): 0.4}
    again = tf.Schedule({0: 1.0, 0.01: 2.0}, period=0.02)
    twice = {k: share for k, (share, _) in held_together([again] * 2, 0.0, 0.06).items()}
    assert twice == {(0, 0): 0.5, (1, 1): 0.5}

    faces = tf.BoundaryConditions(x=(tf.Open(tf.Schedule(high)), tf.Open()), y=tf.Periodic())
    flow = tf.Schedule({t: (40.0 * x, 0.0) for t, x in low.items()})
    box = {"box": ((-12, -12), (12, 12)), "spacing": 4.0, "depth": 1.0}
    food = tf.Signal(diffusion=50.0)
    scene = tf.Scene(tf.Medium(food=food, flow=flow, boundary=faces, **box), dim=2)
    assert float(_food(scene, 0.05, 0.5).max()) == 0.0


def test_a_reservoir_has_its_mean_for_each_colony():
    """Cells that reach beyond the box find what lies there."""
    beyond = tf.Schedule({0: 0.0, 1.02: tf.PerColony([1.0, 3.0]), 1.04: 0.0})

    def find(cells):
        cells.found = cells.found + cells.signals["food"] * cells.dt

    scene = tf.Scene(
        tf.Rules(find, variables={"found": 0.0}),
        tf.Medium(
            food=tf.Signal(diffusion=1.0, reservoir=beyond), box=((-9, -9), (9, 9)), spacing=3.0,
            outside="reservoir",
        ),
        founders=tf.Cells([[50.0, 0.0]], [[1.0, 0.0]]), dim=2,
    )  # fmt: skip
    with pytest.warns(UserWarning, match="reservoir of food has the value of 1.02 h for 0.02 h"):
        *_, last = tf.simulate(scene.bind(colonies=2, **F64), until=2.0, dt=0.1)
    assert last.found.tolist() == pytest.approx([0.02, 0.06], rel=1e-6)


def test_a_periodic_schedule_prepares_the_steps_of_one_period():
    """Whatever rounding makes of its edges."""
    food = tf.Signal(diffusion=50.0, source=tf.Schedule({0: 1.0, 0.13: 0.0}, period=0.35))
    box = {"box": ((-12, -12), (12, 12)), "spacing": 4.0, "depth": 1.0}
    model = tf.Scene(tf.Medium(food=food, **box), dim=2).bind()
    state = model.start()
    for _ in range(7 * 40):
        state = model.step(state, 0.05)
    (transport,) = {e.transport for e in model.effects if hasattr(e, "transport")}
    (known,) = transport.carriers.values()
    assert len(known) == 3  # 1, a mean, and 0


def test_a_wash_with_a_drug_brings_its_dose():
    """A flow that comes together with what it brings: the mean of the product."""
    box = {"box": ((-12, -12), (12, 12)), "spacing": 4.0, "depth": 1.0}

    def amount(dt):
        faces = tf.BoundaryConditions(
            x=(tf.Open(tf.Schedule({0: 0.0, 0.12: 1.0, 0.14: 0.0})), tf.NoFlux()), y=tf.NoFlux()
        )
        flow = tf.Schedule({0: (0.0, 0.0), 0.12: (40.0, 0.0), 0.14: (0.0, 0.0)})
        drug = tf.Signal(diffusion=50.0)
        return float(_food_of(tf.Medium(food=drug, flow=flow, boundary=faces, **box), dt).mean())

    with pytest.warns(UserWarning, match=r"of 0\.12 h for 0\.02 h"):
        found = amount(0.05)
    assert found == pytest.approx(40.0 * 0.02 / 24, rel=1e-6) == amount(0.02)


def _food_of(medium, dt):
    return _food(tf.Scene(medium, dim=2), dt, 0.2)


def test_a_fine_ramp_makes_one_operator_a_step(monkeypatch):
    """And gives what its mean over each step gives."""
    made, usual = [], medium_transport.build_operator
    counted = lambda *args, **given: made.append(1) or usual(*args, **given)
    monkeypatch.setattr(medium_transport, "build_operator", counted)
    ramp = tf.Schedule({k / 3600: k / 3600 for k in range(720)})
    box = {"box": ((-12, -12), (12, 12)), "spacing": 4.0, "depth": 1.0}
    scene = tf.Scene(tf.Medium(food=tf.Signal(diffusion=50.0, source=ramp), **box), dim=2)
    model = scene.bind(**F64)
    state, before = model.start(), len(made)
    for _ in range(4):
        state = model.step(state, 0.05)
    assert len(made) - before == 4
    assert float(state.signals["food"][0]) == pytest.approx(0.02 - 0.1 / 3600, rel=1e-6)


def test_gradients_reach_a_reservoir_in_each_run_of_a_bound_model():
    """Also after a run without them, and with a backward pass for each run."""
    value = torch.tensor(2.0, requires_grad=True, **F64)
    model = _beyond(tf.Schedule({0: 0.0, 0.12: value, 0.34: 0.0})).bind(**F64)

    def found():
        state = model.start()
        for _ in range(5):
            state = model.step(state, 0.1)
        return state.found.sum()

    with torch.no_grad():
        assert float(found()) == pytest.approx(0.44)
    for _ in range(2):
        value.grad = None
        found().backward()
        assert float(value.grad) == pytest.approx(0.22)


def _beyond(reservoir):
    """A cell far beyond the box, which adds up what it finds."""

    def find(cells):
        cells.found = cells.found + cells.signals["food"] * cells.dt / cells.p.one

    food = tf.Signal(diffusion=1.0, reservoir=reservoir)
    one = tf.Signal(diffusion=1.0, reservoir=tf.Schedule({0: 1.0, 0.3: 1.0}))
    return tf.Scene(
        tf.Rules(find, variables={"found": 0.0}, parameters={"one": 1.0}),
        tf.Medium(
            food=food, one=one, box=((-9, -9), (9, 9)), spacing=3.0, outside="reservoir"
        ),
        founders=tf.Cells([[50.0, 0.0]], [[1.0, 0.0]]), dim=2,
    )  # fmt: skip


def test_rules_that_are_tried_find_what_reservoirs_hold():
    """Of two schedules, in a step of no time as binding takes it."""
    least = []

    def find(cells):
        least.append(float(cells.signals["food"].min()))

    medium = tf.Medium(
        food=tf.Signal(diffusion=1.0, reservoir=tf.Schedule({0: 4.0, 1: 2.0}), initial=4.0),
        b=tf.Signal(diffusion=1.0, reservoir=tf.Schedule({0: 3.0, 1: 2.0})),
        box=((-9, -9), (9, 9)), spacing=3.0, outside="reservoir",
    )  # fmt: skip
    founders = tf.Cells([[50.0, 0.0]], [[1.0, 0.0]])
    scene = tf.Scene(tf.Rules(find), medium, founders=founders, dim=2)
    *_, state = tf.simulate(scene, until=0.1)
    *_, state = tf.simulate(scene, state, until=0.2)
    assert min(least) == 4.0
    assert held_together([tf.Schedule({0: 1.0, 1: 2.0})] * 2, 1.0, 1.0) == {(1, 1): (1.0, 1.0)}


@pytest.mark.parametrize("late", [0.01, 0.06])
@pytest.mark.parametrize("splitting", ["strang", "lie"])
def test_voxels_of_a_growing_box_have_the_dose_of_the_others(late, splitting):
    """In the step in which they come, whichever part of it has the pulse."""

    def states(source):
        scene = tf.Scene(
            tf.Motility(speed=1.4), tf.Mechanics(dim=2),
            tf.Medium(
                m=tf.Signal(diffusion=10.0, source=source), box=((-4, -4), (4, 4)), spacing=1.0,
                outside="grow", margin=2.0, splitting=splitting,
            ),
            founders=tf.Cells([[1.8, 0.0]], [[1.0, 0.0]]),
        )  # fmt: skip
        return [*tf.simulate(scene, scene.bind(**F64).start(), until=0.4, dt=0.1)]

    nodes = [s.layout.grid.nodes for s in states(1.0)]
    at = 0.1 * next(k for k in range(1, 4) if nodes[k] > nodes[k - 1]) + late
    with pytest.warns(UserWarning, match="less than a step"):
        last = states(tf.Schedule({0: 0.0, at: 1.0, at + 0.03: 0.0}))[-1]
    assert last.signals["m"].numpy() == pytest.approx(0.03, rel=1e-9)
