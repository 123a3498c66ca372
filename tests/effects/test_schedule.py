"""Media whose sources, faces, flow and reservoirs change at given times, and constants of circuits
and inputs of rules that do."""

import dataclasses
import math
import warnings

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.state import PER_CELL

BOX = {"box": ((-32, -32), (32, 32)), "spacing": 4.0}
F64 = {"dtype": torch.float64}
PULSE = {0: 1.0, 0.5: 0.0, 0.75: 2.0}


def runs(scene, until, state=None, dt=0.05, **batch):
    """The last state."""
    first = scene.bind(**batch).start() if state is None else state
    *_, last = tf.simulate(scene, first, until=until, dt=dt)
    return last


def grown(medium, *effects):
    """A colony that eats, in a medium."""
    return tf.Scene(
        *effects or (tf.Monod("food", rate=1.0, half=0.1),), tf.Growth(), tf.Division(length=4.0),
        tf.Mechanics(dim=2), medium,
        founders=tf.Cells([[0.0, 0.0], [20.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]]),
    )  # fmt: skip


def medium(value, where, **more):
    """A medium that is given a value (or a schedule of them) at one of the places that take one."""
    signal, faces = {"diffusion": 500.0, "initial": 0.2}, {}
    if where == "face":
        faces["boundary"] = tf.BoundaryConditions(x=(tf.Dirichlet(value), tf.NoFlux()))
    elif where == "open":
        faces |= {"boundary": tf.BoundaryConditions(x=tf.Open(value)), "flow": (60.0, 0.0)}
    elif where == "flow":
        flow = lambda x: (40.0 * x, 10.0)
        faces["boundary"] = tf.BoundaryConditions(x=tf.Open(1.0), y=tf.Periodic())
        if isinstance(value, tf.Schedule):
            faces["flow"] = tf.Schedule({t: flow(x) for t, x in value.values.items()})
        else:
            faces["flow"] = flow(value)
    elif where == "reservoir":
        signal |= {"reservoir": value}
        faces |= {"outside": "reservoir", "boundary": tf.BoundaryConditions(x=tf.Dirichlet(0.5))}
    else:
        signal |= {"source": value}
    box = {"box": ((-12, -32), (12, 32)), "spacing": 4.0} if where == "reservoir" else BOX
    return tf.Medium(food=tf.Signal(**signal), **faces, **box, **more)


@pytest.mark.parametrize("more", [{}, {"backend": "torch"}, {"splitting": "lie"}])
def test_what_a_source_gives_is_exact_for_each_colony(more):
    decay, second = 0.7, torch.tensor([1.0, 3.0], dtype=torch.float64)
    source = tf.Schedule({0: 0.25, 1: tf.PerColony([1.0, 3.0]), 1.5: 0.0})
    food = tf.Signal(diffusion=100.0, decay=decay, source=source)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # nothing grows
        scene = tf.Scene(tf.Growth(), tf.Mechanics(dim=2), tf.Medium(food=food, **BOX, **more))
    end = runs(scene, 2.0, colonies=2, **F64)
    expected = torch.zeros(2, dtype=torch.float64)
    for hours, q in ((1.0, 0.25), (0.5, second), (0.5, 0.0)):
        kept = math.exp(-decay * hours)
        expected = expected * kept + q / decay * (1 - kept)
    found = end.signals["food"].reshape(2, -1)
    torch.testing.assert_close(found, expected.unsqueeze(1).expand_as(found), rtol=1e-9, atol=0)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
@pytest.mark.filterwarnings("ignore:.* find a reservoir without it")
@pytest.mark.parametrize("where", ["face", "open", "flow", "reservoir", "source"])
def test_a_schedule_is_a_run_in_pieces(where, backend):
    scheduled = grown(medium(tf.Schedule(PULSE), where, backend=backend))
    state = None
    for value, until in zip(PULSE.values(), (0.5, 0.75, 1.25), strict=True):
        state = runs(grown(medium(value, where, backend=backend)), until, state, **F64)
    assert_equal(runs(scheduled, 1.25, **F64), state)
    constant = runs(grown(medium(1.0, where, backend=backend)), 1.25, **F64)
    assert not torch.equal(constant.length, state.length)


def assert_equal(found, expected):
    """Two states, to the bit."""
    for name in (*PER_CELL, *expected.fields):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def leak(u, s, p, cell):
    """Cells that take food up, and make a dye of it."""
    eats = p.eats * s.food / (0.1 + s.food) * cell.volume
    return {"dye": eats / cell.volume - u.dye}, {"food": -eats}


@pytest.mark.parametrize("exchange", ["together", "turns"])
def test_circuits_meet_it_too(exchange):
    eating = tf.Circuit(leak, species="dye", eats=2.0)
    scene = lambda value: grown(medium(value, "face", exchange=exchange), eating)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # nothing grows
        state = None
        for value, until in zip(PULSE.values(), (0.5, 0.75, 1.25), strict=True):
            state = runs(scene(value), until, state, **F64)
        assert_equal(runs(scene(tf.Schedule(PULSE)), 1.25, **F64), state)


def test_it_begins_again_after_its_period():
    again = tf.Schedule({0: 1.0, 0.25: 0.0}, period=0.5)
    long = tf.Schedule({0: 1.0, 0.25: 0.0, 0.5: 1.0, 0.75: 0.0, 1.0: 1.0})
    found, expected = (runs(grown(medium(x, "face")), 1.25, **F64) for x in (again, long))
    assert_equal(found, expected)
    assert [again.at(t) for t in (0, 0.2, 0.25, 0.4999, 0.5, 100.0, 100.25)] == [
        1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0
    ]  # fmt: skip
    assert again.at(sum([0.05] * 5)) == 0.0  # 0.25, to rounding


def test_a_restart_takes_the_value_of_its_time():
    scene = grown(medium(tf.Schedule(PULSE), "face"))
    half = runs(scene, 0.6)
    assert_equal(runs(scene, 1.25, half), runs(scene, 1.25))


def test_derivatives_by_each_value():
    first, second = (torch.tensor(x, requires_grad=True, **F64) for x in (1.0, 0.5))

    def amount(one, two):
        value = tf.Schedule({0: one, 0.5: two})
        scene = tf.Scene(tf.Monod("food", rate=1.0), tf.Growth(), medium(value, "face"), dim=2)
        return runs(scene, 0.75, **F64).signals["food"].sum()

    amount(first, second).backward()
    for k, x in enumerate((first, second)):
        moved = [[1.0, 0.5], [1.0, 0.5]]
        moved[0][k] -= 1e-5
        moved[1][k] += 1e-5
        low, high = (float(amount(*pair)) for pair in moved)
        assert float(x.grad) == pytest.approx((high - low) / 2e-5, rel=1e-5)
        assert abs(float(x.grad)) > 0.1


def test_recorded_growth_meets_it():
    """What reads the signal changes neither growth nor motion, so growth can be recorded."""
    reading = tf.Circuit(lambda u, s, p, cell: {"dye": s.food - u.dye}, species="dye")
    scene = tf.Scene(
        reading, tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2),
        medium(tf.Schedule(PULSE), "face"),
    )  # fmt: skip
    recording = tf.GrowthRecording(scene, streams=range(1), seed=0)
    model = scene.bind(seed=0)
    replay, state = tf.Replay(model, recording), model.start()
    for _ in range(50):
        state = replay.step(state)
    assert_equal(state, runs(scene, 1.25, dt=None))


def lit(u, s, p, cell):
    return {"dye": p.k * p.light - u.dye}


def summed(u, s, p, cell):
    return {"dye": p.light + 0 * u.dye}


@pytest.mark.parametrize("method", ["rosenbrock", "rk4"])
@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_constants_of_rates_and_rules_take_its_value(backend, method):
    light = tf.Schedule({0: 0.0, 0.5: 1.0, 1: 0.0}, period=1.5)

    def see(cells):
        cells.seen = light(cells.time)

    circuit = tf.Circuit(
        lit, species="dye", k=2.0, light=light, rtol=1e-6, backend=backend, method=method, steps=9
    )
    scene = tf.Scene(circuit, tf.Rules(see, variables={"seen": 0.0}), dim=2)
    expected = 0.0
    for state in tf.simulate(scene.bind(**F64), until=3.0, dt=0.05):
        k = round(state.time / 0.05) - 1
        on = 1.0 if k % 30 in range(10, 20) else 0.0
        expected = 2 * on + (expected - 2 * on) * math.exp(-0.05)
        assert float(state.dye) == pytest.approx(expected, rel=1e-6)
        assert float(state.seen) == on


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_dose_of_pulses_shorter_than_a_step_is_exact_in_any_dtype(dtype):
    """At 40 times 0.1 k + 0.05, which float32 does not hold exactly."""
    light = tf.Schedule({0: 0.0, 0.05: 1.0}, period=0.1)
    circuit = tf.Circuit(summed, species="dye", light=light, dilution=False)
    with pytest.warns(UserWarning, match=r"of 0 h for 0\.05 h, less than a step of 0\.1 h"):
        end = runs(tf.Scene(circuit, dim=2), 4.0, dt=0.1, dtype=dtype)
    assert float(end.dye) == pytest.approx(2.0, rel=1e-5)


def test_values_by_colony_and_by_type():
    pulse = tf.Schedule({0: {0: 1.0, 1: 2.0}, 1: {0: torch.tensor([0.0, 5.0]), 1: 0.0}})
    ends = []
    for backend in ("compiled", "torch"):
        circuit = tf.Circuit(
            {0: summed, 1: summed}, species="dye", light=pulse, dilution=False, backend=backend
        )
        founders = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, cell_type=[0, 1])
        model = tf.Scene(circuit, founders=founders).bind(2, dtype=torch.float64)
        *_, end = tf.simulate(model, until=2.0, dt=0.05)
        ends.append(end.dye.tolist())
    assert ends[0] == pytest.approx([1.0, 2.0, 6.0, 2.0]) and ends[1] == pytest.approx(ends[0])


def test_molecules_follow_it():
    """Made while it is on, 100/h, and kept: some 100 in each of 40 colonies; no more come later."""
    making = [tf.Reaction.of("0 -> dye", rate="light")]
    circuit = tf.Circuit(
        making, species="dye", light=tf.Schedule({0: 100.0, 1: 0.0}), method="tau_leap"
    )
    one = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, 0.5)
    counts = []
    for state in tf.simulate(
        tf.Scene(circuit, founders=one), until=2.0, dt=0.05, colonies=40, seed=1
    ):
        if state.step in (20, 40):
            counts.append(state.dye * state.volume)
    mean = 100.0 * math.pi * 0.25 * (2.0 + 4 / 3 * 0.5)
    assert float(counts[0].mean()) == pytest.approx(mean, abs=4 * math.sqrt(mean / 40))
    assert torch.equal(counts[0], counts[1])


def test_gradients_and_searches_reach_its_values():
    strength = torch.tensor([1.0, 3.0], dtype=torch.float64, requires_grad=True)
    circuit = tf.Circuit(
        summed, species="dye", light=tf.Schedule({0: 0.0, 0.5: strength}), dilution=False
    )
    model = tf.Scene(circuit, dim=2).bind(2, dtype=torch.float64)
    state = model.start()
    for _ in range(20):
        state = model.step(state, 0.05)
    assert state.dye.tolist() == pytest.approx([0.5, 1.5])
    (slope,) = torch.autograd.grad(state.dye.sum(), strength)
    assert slope.tolist() == pytest.approx([0.5, 0.5])


def test_other_values_take_no_other_kernel():
    made = [
        tf.Circuit(lit, species="dye", k=1.0, light=tf.Schedule({0: x, t: 0.0})).graph
        for x, t in ((1.0, 0.5), (2.0, 0.75))
    ]
    assert str(made[0]) == str(made[1]) and "k·light" in str(made[0])


def test_tables_name_its_values_by_their_times(tmp_path):
    pulse = tf.Schedule({0: torch.tensor([1.0, 2.0]), 0.3: 3 * torch.ones(2), 1.3: 0.0})
    scene = tf.Scene(tf.Circuit(summed, species="dye", light=pulse), medium(pulse, "source"), dim=2)
    for _ in tf.simulate(scene, until=0.1, dt=0.05, colonies=2, record=tmp_path / "run.h5"):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        columns = results.table(-1).keys()
    assert {"light[0.0]", "light[0.3]", "source[0.0]", "source[0.3]"} <= set(columns)


def test_a_call_takes_times():
    slow = tf.Schedule({0: 0.1, 5: 0.3}, period=8.0)
    assert slow(np.float32(6.0)) == 0.3 and slow(9) == 0.1
    assert slow(np.array([[1.0, 5.0], [9.0, 13.0]])).tolist() == [[0.1, 0.3], [0.1, 0.3]]
    assert slow([4, 6]).tolist() == [0.1, 0.3]
    called = lambda u, s, p, cell: {"dye": slow(cell.time) + 0 * u.dye}
    with pytest.raises(tf.InputError, match=r"Circuit\(…, light=schedule\).*p\.light"):
        tf.Scene(tf.Circuit(called, species="dye"), dim=2).bind().start()


@dataclasses.dataclass(frozen=True, slots=True)
class Spot:
    """A source that is a callable without a dictionary."""

    rate: float

    def __call__(self, positions):
        return self.rate * (positions[:, 0].abs() < 8.0)


def test_only_what_changes_is_prepared_again():
    """Of two signals; and a source of any kind stays as it is."""
    food = tf.Signal(diffusion=500.0, source=tf.Schedule({0: 1.0, 0.1: 2.0, 0.2: 3.0}))
    still = tf.Signal(diffusion=50.0, source=Spot(1.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # nothing grows
        scene = tf.Scene(tf.Growth(), tf.Mechanics(dim=2), tf.Medium(food=food, still=still, **BOX))
    model = scene.bind()
    state = model.start()
    for _ in range(6):
        state = model.step(state, 0.05)
    (transport,) = {e.transport for e in model.effects if hasattr(e, "transport")}
    (known,) = transport.carriers.values()
    assert sorted(key[0] for key in known) == ["food"] * 3 + ["still"]


def test_a_schedule_of_the_module_counts_for_a_study():
    space = {}
    exec(compile("def see(cells): cells.seen = light(cells.time)", "see.py", "exec"), space)
    found = []
    for value in (1.0, 9.0):
        space["light"] = tf.Schedule({0: value})
        found.append(tf.digest(space["see"]))
    assert found[0] != found[1]
    one, other = (tf.Circuit(summed, species="dye", light=tf.Schedule({0: x})) for x in (1.0, 9.0))
    assert one != other


def test_the_time_of_a_change_is_told():
    scene = grown(medium(tf.Schedule({0: 1.0, 0.5: 0.0}, period=1.0), "source"))
    assert "source of food changes at 0.5 h and every 1 h anew" in str(tf.explain(scene))


def test_a_change_at_a_part_of_a_step_is_followed():
    """Circuits take the middle of each part."""
    rates = lambda u, s, p, cell: ({"dye": p.light * s.food}, {"food": -0.1 * s.food * cell.volume})
    light = tf.Schedule({0: 1.0, 0.05: 3.0, 0.1: 0.0})
    ends = []
    for dt, steps in ((0.1, 2), (0.05, 1)):
        circuit = tf.Circuit(rates, species="dye", light=light)
        box = tf.Medium(food=tf.Signal(diffusion=100.0, initial=0.5), steps=steps, **BOX)
        ends.append(float(runs(tf.Scene(circuit, box, dim=2), 0.1, dt=dt).dye))
    assert ends[0] == pytest.approx(ends[1], rel=1e-3)


def test_a_short_dose_of_a_rule_is_given_and_warned_of():
    def take(cells):
        cells.got = cells.got + cells.p.dose * cells.dt

    dose = {"dose": tf.Schedule({0: 0.0, 0.51: 5.0, 0.52: 0.0})}
    rules = tf.Rules(take, variables={"got": 0.0}, parameters=dose)
    with pytest.warns(UserWarning, match=r"Rules.dose has the value of 0.51 h for 0.01 h"):
        end = runs(tf.Scene(rules, dim=2), 1.0, dt=0.1)
    assert float(end.got) == pytest.approx(0.05, rel=1e-5)


def test_what_holds_for_less_than_a_step_is_warned_of(recwarn):
    runs(grown(medium(tf.Schedule({0: 1.0, 0.52: 0.0}, period=1.03), "source")), 0.1)
    assert not recwarn.list
    short = tf.Schedule({0: 0.0, 0.105: 10.0, 0.115: 0.0})
    told = r"the source of food has the value of 0\.105 h for 0\.01 h, less than a step of 0\.05 h"
    with pytest.warns(UserWarning, match=told):
        runs(grown(medium(short, "source")), 0.2)
    drug = tf.Circuit(summed, species="dye", light=short)
    with pytest.warns(UserWarning, match=r"Circuit\.light has the value of 0\.105 h for 0\.01 h"):
        runs(tf.Scene(drug, dim=2), 0.2)


def test_times_that_rounding_has_made_less_count_as_reached():
    dose = tf.Schedule({0: 1.0, 0.3: 2.0, 1000.0: 3.0})
    assert dose([0.3 - 1e-12, 0.3 - 1e-6, 1000.0 - 1e-7, 1000.0 - 1e-4]).tolist() == [2, 1, 3, 2]
    again = tf.Schedule({0: 1.0, 1: 2.0}, period=2.0)
    assert again([2.0 - 1e-12, 2.0 - 1e-6, 3.0 - 1e-12]).tolist() == [1, 2, 2]
    assert tf.Schedule({1: 2.0, 0: 1.0})([0.0, 1.0]).tolist() == [1, 2]  # in whichever order


def test_ramps_are_not_warned_of(recwarn):
    ramp = {0.01 * k: 1.0 * k for k in range(20)}
    tf.Schedule(ramp).warn_of_mean("dose", 0.1)
    tf.Schedule({0: 0.0, 0.14: 1.0, 0.25: 0.0}).warn_of_mean("dose", 0.1)
    tf.Schedule({t: torch.tensor([x, -x]) for t, x in ramp.items()}).warn_of_mean("dose", 0.1)
    assert not recwarn.list
    long = tf.Schedule({k / 3600: float(k) for k in range(20_000)})
    long.warn_of_mean("dose", 0.1)
    assert not recwarn.list
    for peak in (
        tf.Schedule({**ramp, 0.2: 0.0}), tf.Schedule(ramp, period=0.2),
        tf.Schedule({0: 5.0, 0.01: 0.0}), tf.Schedule({0: {0: 5.0}, 0.01: {0: 0.0}}),
    ):  # fmt: skip
        with pytest.warns(UserWarning, match=r"dose has the value of 0(\.19)? h for 0\.01 h"):
            peak.warn_of_mean("dose", 0.1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: tf.Schedule([0.0, 1.0]), "a dict by time"),
        (lambda: tf.Schedule({}), "a dict by time"),
        (lambda: tf.Schedule({1.0: 2.0}), "given from 0 h on"),
        (lambda: tf.Schedule({0: 1.0, "two": 2.0}), "time of Schedule.values = 'two'"),
        (lambda: tf.Schedule({0: 1.0, -1: 2.0}), "at least 0"),
        (lambda: tf.Schedule({0: 1.0, 2: 0.0}, period=2.0), "above 2"),
        (lambda: tf.Dirichlet(tf.Schedule({0: 1.0, 2: -1.0})), "Dirichlet.value, from 2 h = -1"),
        (lambda: tf.Open(tf.Schedule({0: "a"})), "Open.outside, from 0 h = 'a'"),
        (lambda: tf.Signal(diffusion=tf.Schedule({0: 1.0})), "constant. A Schedule is for"),
        (lambda: tf.Signal(1.0, decay=tf.Schedule({0: 1.0})), "constant. A Schedule is for"),
        (lambda: tf.Growth(rate=tf.Schedule({0: 1.0})), "constant. A Schedule is for"),
        (lambda: tf.Signal(1.0, flow=tf.Schedule({0: 3.0})), "from 0 h = 3.0"),
        (lambda: tf.Signal(1.0, flow=(tf.Schedule({0: 3.0}), 0.0)), "is one of whole velocities"),
        (
            lambda: tf.Schedule({0: tf.Schedule({0: 1.0})}),
            "Schedule.values, from 0 h = Schedule",
        ),
    ],
)  # fmt: skip
def test_bad_schedules(make, message):
    with pytest.raises(tf.InputError) as error:
        make()
    assert message in str(error.value)


def test_each_value_has_one_number_for_each_colony():
    scene = grown(medium(tf.Schedule({0: 1.0, 1: tf.PerColony([1.0, 2.0, 3.0])}), "source"))
    with pytest.raises(tf.InputError, match=r"Medium.signals\['food'\].source"):
        scene.bind(colonies=2)


@pytest.mark.parametrize(
    "make",
    [
        lambda given: tf.Lysis(rate=given),
        lambda given: tf.Rules(lambda cells: None, parameters={"rate": given}),
        lambda given: tf.Motility(speed=1.0, reversals=given),
    ],
)
def test_types_go_into_a_schedule_and_not_schedules_into_types(make):
    with pytest.raises(tf.InputError, match=r"\[1\] = Schedule.*tf.Schedule\(\{0: \{0: …, 1: …\}"):
        make({0: 1.0, 1: tf.Schedule({0: 0.0, 1: 2.0})})
    make(tf.Schedule({0: {0: 1.0, 1: 0.0}, 1: {0: 1.0, 1: 2.0}}))


def test_before_the_first_time_the_first_value_holds():
    """As for a dead time, `light(cells.time - 0.2)`."""
    light = tf.Schedule({0: 0.5, 1: 1.0, 2: 3.0})
    assert light(np.array([-5.0, -1e-12, 0.0, 0.99, 1.0, 2.5])).tolist() == [0.5] * 4 + [1.0, 3.0]
    again = tf.Schedule({0: 0.5, 1: 1.0}, period=2.0)
    assert again([-2.0, -1.5, -1.0, -0.5]).tolist() == [0.5, 0.5, 1.0, 1.0]


# --- light: a signal that does not spread ---------------------------------------------------------


@pytest.mark.parametrize("decay", [0.0, 0.7, [0.0, 30.0], 1e4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_signal_that_does_not_move_follows_each_source_exactly(decay, dtype):
    """u' = s(x) − k u in each voxel, with another image in every step."""
    images = [lambda x, c=c: torch.exp(-0.1 * (x[:, 0] - c) ** 2) for c in (-3.0, 0.0, 5.0)]
    light = tf.Signal(
        diffusion=0.0, decay=decay, source=tf.Schedule({0.5 * k: f for k, f in enumerate(images)})
    )
    medium = tf.Medium(light=light, box=((-8, -4), (8, 4)), spacing=2.0)
    scene = tf.Scene(tf.Growth(rate=0.0), medium, dim=2, dt=0.5)
    state = scene.bind(2, dtype=dtype).start()
    rate = torch.as_tensor(decay, dtype=torch.float64).expand(2).reshape(2, 1, 1)
    x = torch.arange(-7.0, 8.0, 2.0, dtype=torch.float64)
    place = torch.stack([x, 0 * x], 1)
    expected = torch.zeros(2, 8, 1, dtype=torch.float64)
    for image in images:
        state = scene.bind(2, dtype=dtype).step(state, dt=0.5)
        gained = torch.where(rate > 0, -torch.expm1(-rate / 2) / rate, 0.5)
        expected = expected * torch.exp(-rate / 2) + gained * image(place).reshape(1, 8, 1)
    found = state.signals["light"].double().reshape(2, 8, 4)
    tolerance = 1e-13 if dtype == torch.float64 else 1e-6
    torch.testing.assert_close(found, expected.expand(2, 8, 4), rtol=tolerance, atol=1e-30)


def test_gradients_pass_through_a_decay_where_nothing_moves():
    decay = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    light = tf.Signal(diffusion=0.0, decay=decay, source=3.0)
    medium = tf.Medium(light=light, box=((-8, -4), (8, 4)), spacing=2.0)
    scene = tf.Scene(tf.Growth(rate=0.0), medium, dim=2, dt=0.25)
    end = tf.rollout(scene.bind(dtype=torch.float64), until=1.0)
    (slope,) = torch.autograd.grad(end.signals["light"].mean(), decay)
    k = 2.0
    exact = 3.0 * (math.exp(-k) / k - (1 - math.exp(-k)) / k**2)
    assert float(slope) == pytest.approx(exact, rel=1e-12)
