"""Circuits molecule by molecule, compiled against torch: the same draws, so the same molecules.

Numbers are equal to the bit where propensities need only + − × ÷. Waiting times and Poisson numbers
take a logarithm and probabilities of two libraries that differ in the last place, which shows in a
molecule once in some 10¹² events.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy import stats
from traced import alone, circuits, ends, equal, one_step, plain_module

import torchfilm as tf
from torchfilm import parts
from torchfilm.circuits import compiled, compiled_molecules, draws, molecules_text, stochastic
from torchfilm.circuits.draws import KeyedDraws
from torchfilm.kernels.compiling import for_python
from torchfilm.kernels.functions import natural_log
from torchfilm.kernels.poisson import poisson
from torchfilm.kernels.random import two_uniforms

F32, F64 = torch.float32, torch.float64
both = pytest.mark.parametrize("method", ["tau_leap", "direct"])


def molecules(*listed, method="tau_leap", species=("a", "b", "c"), **given) -> tf.Circuit:
    given = {"initial": {"a": tf.Uniform(0.0, 30.0)}, "molecules_per_unit": 2.0, **given}
    return tf.Circuit(list(listed), species=species, method=method, **given)


def steps_of(state: tf.State) -> torch.Tensor:
    return state.reports["circuit"].steps


# --- compiled for real ----------------------------------------------------------------------------


def test_the_repressilator_has_the_same_molecules(monkeypatch, dtype):
    """Compiled for real; and the same as its text run as Python."""
    scene = tf.scenes.repressilator(molecules_per_unit=1.5)
    a, b = ends(scene, 8, dtype=dtype, colonies=2)
    equal(a, b)
    assert torch.equal(steps_of(a), steps_of(b)) and int(steps_of(a).min()) > 0
    by_kernel, _ = ends(scene, 1, dtype=dtype)
    monkeypatch.setattr(compiled, "_module", plain_module)
    by_python, _ = ends(scene, 1, dtype=dtype)
    equal(by_kernel, by_python)


def test_same_bits_for_any_number_of_threads(monkeypatch):
    """Compiled for real, each thread with a part of the cells."""
    monkeypatch.setattr("torchfilm.tools.threads.WORTH_WAKING", 0.0)
    circuit = molecules(*parts.constitutive("a", 50.0), *parts.degradation("a", 1.0), species="a")
    scene, found, before = alone(circuit, count=135), [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            model = scene.bind(seed=1, dtype=F64)
            found.append(model.step(model.start(), 0.5))
    finally:
        torch.set_num_threads(before)
    equal(*found)


# --- the same molecules as by torch ---------------------------------------------------------------


@both
@pytest.mark.parametrize("per_unit", [0.6022, torch.tensor([0.5, 40.0, 3.0])])
def test_mass_action_of_all_orders(method, per_unit, dtype, plain):
    """Pairs, triples, reactions that take two species, and such as run out."""
    circuit = molecules(
        *parts.constitutive("a", "make"), *parts.degradation("c", 3.0),
        tf.Reaction.of("2 a -> b", 0.05), tf.Reaction.of("3 b -> c", 0.2),
        tf.Reaction.of("a + b -> 3 c", "k"), tf.Reaction.of("b -> 5 a", 0.5),
        method=method, molecules_per_unit=per_unit, make=30.0, k=tf.LogNormal(0.1, 0.3),
    )  # fmt: skip
    a, b = ends(alone(circuit, count=5), 2, colonies=3, dtype=dtype)
    equal(a, b)
    assert torch.equal(steps_of(a), steps_of(b)) and int(steps_of(a).max()) > 10


def test_leaps_of_many_molecules(dtype, plain):
    """Means from below 1 to above 10⁶, which other rules give; fewer steps than events."""
    circuit = molecules(
        *parts.constitutive("a", 1e9), *parts.degradation("a", 2.0),
        tf.Reaction.of("a -> b", 1e-3), tf.Reaction.of("b -> c", 20.0),
        *parts.degradation("c", 1.0), initial={"a": tf.Uniform(0.0, 1e9)}, molecules_per_unit=1.0,
    )  # fmt: skip
    a, b = ends(alone(circuit, count=6), 2, dtype=dtype)
    equal(a, b)
    assert int(steps_of(a).max()) < 1000 and float(a.a.min()) > 1e6


@both
def test_exchange_with_a_medium_and_a_reservoir(method, dtype, plain):
    """The outer cells are outside the box. Less than a molecule in a pool stays."""
    medium = tf.Medium(
        x=tf.Signal(diffusion=10.0, initial=0.3, reservoir=0.5), box=((-8.0, -8.0), (24.0, 8.0)),
        spacing=4.0, outside="reservoir",
    )  # fmt: skip
    circuit = molecules(
        *parts.exchange("a", 3.0, "x"), *parts.activated("a", "out.x", 5.0, 0.4, 2),
        tf.Reaction.of("out.x + b -> a", 0.2), *parts.constitutive("b", 2.0),
        species=("a", "b"), method=method,
    )  # fmt: skip
    a, b = ends(alone(circuit, medium, count=6), 3, dtype=dtype)
    equal(a, b)
    assert torch.equal(a.x_reservoir, b.x_reservoir) and float(a.x_reservoir.abs().max()) > 0


@both
def test_cell_types_names_and_functions(method, dtype, plain):
    """Each type with its own reactions; two circuits of different names, so other draws."""
    busy = tf.Reaction({}, {"a": 1}, lambda u, s, p, cell: p.k / (1 + u.a) + cell.area, "busy")
    circuits = [
        tf.Circuit(
            {0: [busy, *parts.degradation("a", 1.0)], 2: parts.constitutive("a", 4.0)},
            species="a", method=method, name=name, k={0: 40.0, 2: 0.0},
        )
        for name in ("one", "two")
    ]  # fmt: skip
    a, b = ends(alone(*circuits, types=3), 3, dtype=dtype)
    equal(a, b)
    assert not torch.equal(a.one_a, a.two_a) and float(a.one_a[1::3].abs().max()) == 0


def test_functions_of_another_library_give_nearly_the_same(plain):
    """exp and tanh differ in the last place: so do propensities, and hardly ever molecules. Of
    1,200 numbers after some 10⁵ events, all are the same at this seed."""
    made = lambda u, s, p, cell: 40 * torch.exp(-u.a / 9) + torch.tanh(u.a)
    circuit = molecules(tf.Reaction({}, {"a": 1}, made), *parts.degradation("a", 1.0), species="a")
    a, b = ends(alone(circuit, count=40), 1, dtype=F64)
    assert int(steps_of(a).sum()) > 400
    equal(a, b)


@given(circuits(), st.sampled_from(["tau_leap", "direct"]))
@settings(max_examples=25, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate],
          suppress_health_check=list(HealthCheck))  # fmt: skip
def test_circuits_at_random(plain, made, method):
    x0 = tf.Signal(diffusion=5.0, initial=0.3)
    medium = tf.Medium(x0=x0, box=((-16.0, -8.0), (32.0, 8.0)), spacing=8.0)
    first = {n: tf.Uniform(0.0, 2.0) for n in made["species"]}
    circuit = tf.Circuit(made["reactions"], species=made["species"], initial=first, method=method,
                         molecules_per_unit=4.0)  # fmt: skip
    a, b = ends(alone(circuit, medium, count=4, types=2), 1, dt=0.3)
    equal(a, b)
    assert torch.equal(steps_of(a), steps_of(b))


# --- draws ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", "second"])
def test_a_draw_is_that_of_torch(name):
    """Also of uids and streams beyond 32 bits, seeds below 0 and events beyond 16 bits."""
    uid = torch.tensor([0, 5, 2**33 + 7, 2**47], dtype=torch.int64)
    stream = torch.tensor([3, 2**40 + 1, -5, 0], dtype=torch.int64)
    for seed in (1, 2**40 + 3, -7):
        draw = KeyedDraws(seed, stream, uid, 9, name)
        words = compiled_molecules.keys_of(draw)
        for event in (0, 65_534, 65_535, 10**6):
            for what in ("single", "leap 3"):
                for k, code in enumerate(draw.codes(what, 2)):
                    wanted = draw(torch.arange(4), event, what, 4)[2 * k : 2 * k + 2]
                    for n in range(4):
                        own = (uid.numpy().view("u8")[n], stream.numpy().view("u8")[n])
                        found = for_python(two_uniforms)((*own, *words), event, np.uint64(code))
                        assert found == tuple(wanted[:, n].tolist())


def test_a_logarithm_is_off_by_less_than_a_unit_in_the_last_place():
    """Of numbers at both ends of the uniforms, around 1 and √½, and between, in 64 bits of
    mantissa where the machine has them."""
    g = np.random.default_rng(1)
    ends = [2.0**-54, 2.0**-53, 1 - 2.0**-53, 1 - 2.0**-52, 0.5**0.5, 0.5, 1.0, 2.0**0.5]
    near = [*(1 - 10.0 ** -g.uniform(0, 16, 400)), *(10.0 ** -g.uniform(0, 16, 400))]
    for x in (*ends, *near, *g.uniform(size=400)):
        exact = np.log(np.longdouble(x))
        assert abs(for_python(natural_log)(x) - exact) <= np.spacing(abs(float(exact)))


@pytest.mark.parametrize(
    "mean", [0.0, 1e-9, 0.5, 4.1, 10.0, 10.1, 50.0, 99.0, 101.0, 3e3, 9e5, 1e8]
)
def test_a_poisson_number_is_that_of_torch(mean):
    """Of 3,000 uniforms, some of them far out; nearer to 1 than 10⁻⁸ rounding decides."""
    uniform = torch.rand(3000, generator=torch.Generator().manual_seed(1), dtype=F64)
    uniform = torch.cat(
        [uniform.clamp(1e-8, 1 - 1e-8), 10.0 ** -torch.arange(4.0, 16.0, dtype=F64)]
    )
    wanted = draws.poisson(torch.full_like(uniform, mean), uniform)
    assert [for_python(poisson)(mean, u) for u in uniform.tolist()] == wanted.tolist()


@pytest.mark.parametrize("off", [-1e-9, 1e-9, -1e-7, 1e-7])
@pytest.mark.parametrize("mean", [101.3, 777.7, 54321.0])
def test_a_poisson_number_at_a_step_is_on_its_side(mean, off):
    """Just below P(X ≤ k) it is k, and just above k + 1: guesses are too high or too low there."""
    k = np.random.default_rng(0).poisson(mean, 300)
    uniform = torch.from_numpy(stats.poisson.cdf(k, mean) * (1 + off))
    expected = (k + (off > 0)).tolist()
    assert [for_python(poisson)(mean, u) for u in uniform.tolist()] == expected
    if abs(off) > 1e-9:  # which is the error of torch's incomplete gamma function
        assert draws.poisson(torch.full_like(uniform, mean), uniform).tolist() == expected


# --- independence of how the work is divided ------------------------------------------------------


@both
def test_same_bits_whatever_cells_are_side_by_side(method, monkeypatch, plain):
    """In lanes for one, two or all of the cells, some of which need many more events."""
    circuit = molecules(
        *parts.constitutive("a", "make"), *parts.degradation("a", 1.0), species="a", method=method,
        initial={}, make=tf.LogNormal(300.0, 1.5),
    )  # fmt: skip
    found = []
    for lanes in (1, 2, 16):
        monkeypatch.setitem(molecules_text.CONSTANTS, "LANES", lanes)
        model = alone(circuit, count=9).bind(seed=3, dtype=F64)
        found.append(model.step(model.start(), 0.3))
        equal(found[0], found[-1])
        assert torch.equal(steps_of(found[0]), steps_of(found[-1]))
    assert int(steps_of(found[0]).max()) > 3 * int(steps_of(found[0]).min())


@both
def test_same_bits_in_any_batch_and_order(method, plain):
    circuit = molecules(
        *parts.constitutive("a", "make"), *parts.degradation("a", 1.0), species="a", method=method,
        make=tf.LogNormal(40.0, 0.3),
    )  # fmt: skip
    scene, runs = alone(circuit), {}
    for streams in ([0, 1, 2], [2, 1, 0], [1]):
        model = scene.bind(len(streams), seed=5, dtype=F64, streams=streams)
        end = model.step(model.start(), 0.3)
        runs[tuple(streams)] = dict(zip(streams, end.a.reshape(len(streams), -1), strict=True))
    first, *others = runs.values()
    assert all(torch.equal(x, first[k]) for found in others for k, x in found.items())


def test_a_restart_gives_the_same_bits(plain):
    circuit = molecules(*parts.constitutive("a", 9.0), *parts.degradation("a", 1.0), species="a")
    scene = alone(circuit, count=4)
    *_, whole = tf.simulate(scene, scene.bind(seed=2).start(), until=0.5)
    *_, half = tf.simulate(scene, scene.bind(seed=2).start(), until=0.2)
    *_, rest = tf.simulate(scene, half, until=0.5)
    equal(whole, rest)


# --- failures, gradients, and what is said --------------------------------------------------------


@both
def test_failures_are_the_same(method, dtype, plain):
    falling = tf.Reaction({}, {"a": 1}, lambda u, s, p, cell: p.k * (6.0 - u.a), "less and less")
    lost = tf.Reaction({"a": 1}, {}, lambda u, s, p, cell: u.a / p.off, "lost")
    circuit = molecules(
        *parts.constitutive("a", 5.0), lost, falling, species="a", method=method,
        initial={"a": 3.0}, k=torch.tensor([0.0, 20.0, 0.0]), off=torch.tensor([1.0, 9.0, -1.0]),
    )  # fmt: skip
    a, b = ends(alone(circuit, count=3), 1, dt=1.0, colonies=3, dtype=dtype)
    one, other = (state.reports["circuit"] for state in (a, b))
    assert one.status.tolist() == [0, 1, 1] == other.status.tolist()
    assert one.words == other.words and torch.equal(one.steps, other.steps)
    assert "'less and less' has a propensity" in one.words[1] and "'lost'" in one.words[2]
    equal(a, b)


@both
def test_too_many_events_are_the_same(method, monkeypatch, plain):
    limits = {"MOST_LEAPS": 40, "MOST_EVENTS": 40}
    for name, most in limits.items():
        monkeypatch.setattr(compiled_molecules, name, most)
    by_torch = getattr(stochastic, method)
    monkeypatch.setattr(
        stochastic, method, lambda *a, **k: by_torch(*a, **k, max_steps=limits["MOST_LEAPS"])
    )
    circuit = molecules(
        *parts.constitutive("a", "make"), *parts.degradation("a", 1.0), species="a", method=method,
        initial={}, make=torch.tensor([0.1, 200.0]),
    )  # fmt: skip
    a, b = ends(alone(circuit, count=2), 1, dt=1.0, colonies=2)
    one, other = (state.reports["circuit"] for state in (a, b))
    assert one.status.tolist() == [0, 1] == other.status.tolist() and one.words == other.words
    assert "too many events" in one.words[1]
    equal(a, b)


def test_no_time_changes_nothing(plain):
    circuit = molecules(*parts.constitutive("a", 9.0), species="a")
    cells, _, concentrations = one_step(alone(circuit))
    draw = KeyedDraws(1, torch.zeros(12, dtype=torch.int64), torch.arange(12), 0)
    own = {"molecules_per_unit": torch.tensor(2.0)}
    end, report = cells.compiled.advance(cells, concentrations, own, 0.0, draw, True)
    assert torch.equal(end, concentrations) and report.status.tolist() == [0] * 12


def test_it_is_explained_who_computes():
    made = parts.constitutive("a", "make")
    said = lambda *listed, **given: tf.explain(alone(molecules(*listed, species="a", **given)))
    assert "computed by compiled functions of its equations" in said(*made, make=1.0)
    assert "computed by compiled functions" in said(*made, make=1.0, method="direct")
    assert "computed by torch: backend='torch'" in said(*made, make=1.0, backend="torch")
    steep = tf.Reaction({}, {"a": 1}, lambda u, s, p, cell: torch.erf(u.a))
    assert "computed by torch: the list of reactions: it uses erf" in said(steep)
    model = alone(molecules(steep, species="a")).bind()
    assert model.step(model.start(), 0.1).cells == 12


def test_a_text_says_all_that_it_depends_on(monkeypatch):
    """Constants by value; the numbers of the reactions' rates are none of them."""
    form = lambda rate, lost: one_step(
        alone(molecules(tf.Reaction.of("a -> b", rate), *parts.degradation("b", lost)))
    )[0].compiled.text  # fmt: skip
    monkeypatch.setattr(compiled, "_module", plain_module)
    text = form(0.7, 0.9)
    assert f"EPSILON = {stochastic.EPSILON!r}\n" in text and text == form(1.3, 0.2)
    assert text != form(1.0, 0.2)


@pytest.mark.filterwarnings("ignore:.*passes no gradient on")
def test_gradients_pass_what_is_smooth_around_the_molecules(plain):
    """Molecule numbers have none: a constant that requires one is computed by torch."""
    make = torch.tensor(5.0, dtype=F64, requires_grad=True)
    scene = alone(molecules(*parts.constitutive("a", "make"), species="a", make=make))
    assert "where gradients are required by torch" in tf.explain(scene)
    model = scene.bind(dtype=F64)
    assert dataclasses.is_dataclass(model.step(model.start(), 0.1))


def test_leaps_that_are_halved_are_the_same(monkeypatch, plain):
    """Leaps so long that many would take more molecules than there are, beside a gene that turns
    on and off: what is critical fires at its time, or after a leap that was halved, not at all."""
    loose = {"epsilon": 3.0, "critical": 2}
    for name, value in loose.items():
        monkeypatch.setitem(molecules_text.CONSTANTS, name.upper(), value)
    by_torch, drawn, asked = stochastic.tau_leap, KeyedDraws.__call__, []
    monkeypatch.setattr(stochastic, "tau_leap", lambda *a, **k: by_torch(*a, **k, **loose))
    monkeypatch.setattr(
        KeyedDraws, "__call__", lambda self, rows, event, what, count: (
            asked.append(what), drawn(self, rows, event, what, count)
        )[1],
    )  # fmt: skip
    circuit = molecules(
        *parts.degradation("a", 20.0), tf.Reaction.of("off -> on", 10.0),
        tf.Reaction.of("on -> off", 10.0), tf.Reaction.of("on -> on + 5 a", 200.0),
        species=("a", "on", "off"), molecules_per_unit=1.0,
        initial={"a": tf.Uniform(100.0, 200.0), "off": 0.5},
    )  # fmt: skip
    a, b = ends(alone(circuit, count=20), 3, colonies=3)
    equal(a, b)
    assert torch.equal(steps_of(a), steps_of(b))
    assert asked.count("leap 1") > 10, "hardly a leap was halved"


@both
def test_of_several_wrong_propensities_the_first_is_named(method, plain):
    wrong = lambda name, rate: tf.Reaction({}, {"a": 1}, rate, name)
    circuit = molecules(
        *parts.constitutive("a", 5.0), wrong("one", lambda u, s, p, cell: 0.0 * u.a - 1.0),
        wrong("other", lambda u, s, p, cell: 0.0 * u.a - 2.0), species="a", method=method,
    )  # fmt: skip
    for state in ends(alone(circuit, count=3), 1):
        assert "'one' has a propensity" in state.reports["circuit"].words[0]
