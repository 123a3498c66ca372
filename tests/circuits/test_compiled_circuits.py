"""Circuits by compiled functions against torch: the same bits where only + − × ÷ occur, the
same failures, and circuits at random.

Compiling takes seconds a circuit, so most texts run as plain Python (`plain`): that is the same
text. Those that are compiled for real are the ready scenes' and the ones named so.
"""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path

import pytest
import torch
from helpers import array
from hypothesis import Phase
from hypothesis import strategies as st
from traced import alone, by, circuits, close, ends, equal, one_step, plain_module

import torchfilm as tf
from torchfilm import parts
from torchfilm.circuits import compiled, run
from torchfilm.circuits.compiled_step import Changes, KernelStep, Surroundings
from torchfilm.circuits.rosenbrock import SAFETY, rodas3
from torchfilm.kernels import compiling
from torchfilm.kernels.compiling import for_python
from torchfilm.tools.deterministic_math import deterministic_functions

sys.path.append(str(Path(__file__).parents[2] / "experiments"))
from fuzz_draws import for_each

F32, F64 = torch.float32, torch.float64


# --- ready scenes, compiled for real --------------------------------------------------------------

READY = {
    "toggle_switch": {"noise": False, "power": 2},
    "repressilator": {"noise": False},
    "random_partition": {},
    "quorum_sensing": {"size": 64.0, "k3": [0.5, 2.0]},
    "synchronized_lysis": {"half": [0.1, 1e-3], "rate": 2.0},
    "boundary_detector": {},
}


def test_all_ready_scenes_with_circuits_are_compared():
    found = {
        name for name in tf.scenes.READY
        if any(isinstance(e, tf.Circuit) for e in tf.scenes.build(name).effects)
    }  # fmt: skip
    assert found == set(READY)


@pytest.mark.parametrize("name", list(READY))
def test_ready_scenes_give_the_same_bits(name, dtype, plain):
    """Powers are squares and cubes; growth, division and exchange act between."""
    a, b = ends(tf.scenes.build(name, READY[name]), 12, dtype=dtype, colonies=2, per_colony=True)
    equal(a, b)
    assert a.cells >= 4 and float(sum(a.fields[n].sum() for n in species_of(name))) > 0


def species_of(name: str) -> list[str]:
    effects = tf.scenes.build(name, READY[name]).effects
    return [n for e in effects if isinstance(e, tf.Circuit) for n in e.own_fields]


def test_compiled_for_real_is_the_same_as_plain_python(monkeypatch, dtype):
    """The boundary detector: two circuits, exchange, a run with divisions."""
    scene = tf.scenes.boundary_detector()
    a, b = ends(scene, 30, dtype=dtype)
    monkeypatch.setattr(compiled, "_module", plain_module)
    c, _ = ends(scene, 30, dtype=dtype)
    assert a.cells > 4
    equal(a, b)
    equal(a, c)


# --- kinds of circuits ----------------------------------------------------------------------------


def switch(u, s, p, cell):
    return {
        "red": p.k / (1 + u.green**2) - p.loss * u.red,
        "green": p.k / (1 + u.red * u.red) - u.green * p.loss + 0.1 * cell.volume,
    }


def toggle(**constants) -> tf.Circuit:
    return tf.Circuit(
        switch, species=("red", "green"), initial={"red": tf.Uniform(0.0, 3.0), "green": 0.5},
        **{"k": 4.0, "loss": 1.0, **constants},
    )  # fmt: skip


@pytest.mark.parametrize(
    "constants",
    [
        {},
        {"k": torch.tensor([2.0, 4.0, 8.0])},
        {"k": tf.LogNormal(4.0, 0.3)},
        {"loss": {0: 0.5, 1: 2.0}},
    ],
    ids=["numbers", "per colony", "drawn", "by type"],
)
def test_constants_of_all_kinds(constants, dtype, plain):
    a, b = ends(alone(toggle(**constants), types=2), colonies=3, dtype=dtype)
    equal(a, b)
    assert len(a.red.unique()) > 6


def exchanging(u, s, p, cell):
    into = p.D * (s.ahl - u.ahl) * cell.area
    made = torch.where(cell.cell_type == 1, 0.0, p.k)
    return {"ahl": made + into / cell.volume - 0.1 * u.ahl}, {"ahl": -into}


@pytest.mark.parametrize("D", [1.0, 1e5])
def test_exchange_with_a_medium_and_a_reservoir(D, dtype, plain):
    """Half of the cells are outside the box."""
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=10.0, reservoir=0.5), box=((-8.0, -8.0), (24.0, 8.0)),
        spacing=4.0, outside="reservoir", exchange="turns",
    )  # fmt: skip
    circuit = tf.Circuit(exchanging, species="ahl", D=D, k=2.0)
    a, b = ends(alone(circuit, medium, types=2), dtype=dtype)
    equal(a, b)
    assert float(a.ahl[-1]) != float(a.ahl[0]) > 0


def test_cell_types_and_shared_species(dtype, plain):
    first = tf.Circuit(
        {
            0: lambda u, s, p, cell: {"a": p.k - u.a * u.b},
            1: lambda u, s, p, cell: {"b": u.a - u.b},
        },
        species=("a", "b"), initial={"a": 1.0, "b": tf.Uniform(0.0, 1.0)}, k=2.0,
    )  # fmt: skip
    second = tf.Circuit(
        [*parts.degradation("a", "loss"), tf.Reaction.of("a + c -> 0", 0.3),
         *parts.constitutive("c", 0.1)],
        species="c", name="more", shared=("a",), loss=tf.LogNormal(1.0, 0.2),
    )  # fmt: skip
    a, b = ends(alone(first, second, types=3), dtype=dtype)
    equal(a, b)
    assert float(a.more_c.min()) > 0


def clock(u, s, p, cell):
    return {"a": 0.1 + cell.time * 0.1 / 3 - u.a * cell.growth_rate, "b": 1, "c": 0.0 * u.a}


@pytest.mark.filterwarnings("ignore:.* growth dilutes it besides")
def test_time_is_that_of_each_step(dtype, plain):
    """Read anew in each step; rates that are numbers, and one that is always 0."""
    circuit = tf.Circuit(clock, species=("a", "b", "c", "still"))
    a, b = ends(alone(circuit), 5, dtype=dtype)
    equal(a, b)
    model = alone(tf.Circuit(clock, species=("a", "b", "c"))).bind(seed=3, dtype=dtype)
    late = model.step(model.start().replace(time=5.0), 0.1)
    assert (late.a > model.step(model.start(), 0.1).a).all()


def test_lists_of_reactions_give_the_same_bits(dtype, plain):
    """Constants that are numbers take the type of the cells, as torch has it."""
    listed = [
        *parts.constitutive("a", 0.1), *parts.degradation("a", 0.7),
        tf.Reaction.of("2 a + b -> 3 c", 0.3),
        *parts.conversion("c", "b", enzyme="a", rate=0.1, half=0.3),
        *parts.activated("b", by="c", rate="k", half=0.3, power=2),
        *parts.repressed("a", by="b", rate=0.9, half=0.7, power=3),
    ]  # fmt: skip
    circuit = tf.Circuit(listed, species=("a", "b", "c"), initial={"a": 1.0}, k=0.1)
    a, b = ends(alone(circuit), dtype=dtype)
    equal(a, b)


def test_functions_differ_by_rounding_only(dtype, plain):
    """exp, log and powers of another library, in the last place; steps are chosen alike."""

    def rates(u, s, p, cell):
        return {
            "a": p.k * torch.exp(-u.b) - u.a**1.5 + tf.kinetics.activation(u.a, 0.5, p.n),
            "b": torch.tanh(u.a) + torch.log1p(u.b) - torch.sin(u.b) - u.b,
        }

    circuit = tf.Circuit(
        rates, species=("a", "b"), initial={"a": tf.Uniform(0.0, 2.0)}, k=2.0, n=2.3
    )
    a, b = ends(alone(circuit), dtype=dtype)
    close(a, b, rel=1e-12 if dtype == F64 else 1e-6)
    assert torch.equal(a.reports["circuit"].steps, b.reports["circuit"].steps)


def switched(u, s, p, cell):
    return {
        "a": 1.0 - u.a * torch.logical_not(u.a - 1.0),
        "b": p.k - u.b * (u.a > 0.5) - u.b * (u.a > 0.4),
    }


def test_slopes_that_are_switches(dtype, plain):
    """∂/∂b is − (a > 0.5) − (a > 0.4): numbers, also for torch, which negates and adds no bools."""
    scene = alone(tf.Circuit(switched, species=("a", "b"), initial={"a": 1.0, "b": 0.5}, k=0.3))
    a, b = ends(scene, dtype=dtype)
    equal(a, b)
    assert float(a.fields["b"].max()) < 0.5


# --- independence of how the work is divided ------------------------------------------------------


def test_same_bits_for_any_number_of_threads(monkeypatch):
    """Compiled for real, each thread with a part of the cells."""
    monkeypatch.setattr("torchfilm.tools.threads.WORTH_WAKING", 0.0)
    found = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            model = alone(toggle(), count=1031).bind(seed=1, dtype=F64)
            found.append(model.step(model.start(), 0.5))
    finally:
        torch.set_num_threads(before)
    equal(*found)


def test_same_bits_in_any_batch(plain):
    scene = alone(toggle(k=tf.LogNormal(4.0, 0.3)))
    runs = {}
    for count in (3, 2, 1):
        model = scene.bind(count, seed=5, dtype=F64)
        runs[count] = model.step(model.start(), 0.3).red
    for count in (2, 1):
        assert torch.equal(runs[count], runs[3][: len(runs[count])]) and len(runs[count])


def test_same_bits_in_any_order(plain):
    cells, start, concentrations = one_step(alone(toggle(k=tf.LogNormal(4.0, 0.3))))
    step, found = KernelStep(cells.compiled, (), {}), cells.compiled.sources(cells, {})
    around = Surroundings(start, {}, None, torch.zeros(1).long(), torch.zeros_like(cells.rows))
    ends = []
    for order in (range(len(cells.rows)), (7, 2, 9, 0)):
        some = dataclasses.replace(cells, rows=torch.tensor(order))
        into = Changes.of(start, (), reservoir=False, whole=True)
        loop, code = step.loop(some.rows, found, around, 0.4, 1e-4, 1e-9, into)
        loop.work(0, len(cells.rows))
        assert len(code) == len(order) and not code.any()
        ends.append(torch.from_numpy(into.species[:, [7, 2, 9, 0]]))
    assert torch.equal(*ends) and not torch.equal(ends[0].t(), concentrations[[7, 2, 9, 0]])


def test_a_restart_gives_the_same_bits(plain):
    scene = alone(toggle(k=tf.LogNormal(4.0, 0.3)))
    *_, whole = tf.simulate(scene, scene.bind(seed=2).start(), until=0.5)
    *_, half = tf.simulate(scene, scene.bind(seed=2).start(), until=0.2)
    *_, rest = tf.simulate(scene, half, until=0.5)
    equal(whole, rest)


def test_no_time_changes_nothing(plain):
    cells, _, concentrations = one_step(alone(toggle()))
    settings = run.IntegrationSettings("rosenbrock", 1, 1e-4, 1e-9, 1.0)
    found = run.step(cells, concentrations, 0.0, settings)
    assert torch.equal(found.concentrations, concentrations) and not found.failed.any()


# --- failures -------------------------------------------------------------------------------------


def nan_above(u, s, p, cell):
    return {"a": p.k + 0 * torch.sqrt(1.0 - u.a)}


def draining(u, s, p, cell):
    return {"a": p.k - 1.0 + 0 * u.a}


def exploding(u, s, p, cell):
    return {"a": p.k * u.a * u.a}


@pytest.mark.parametrize(
    "rates, k, said",
    [
        (nan_above, [0.0, 9.0, 9.0], "is not a finite number"),
        (draining, [2.0, 0.0, 0.5], "below zero, 'a' first, from"),
        (exploding, [0.1, 40.0, 30.0], "circuit of cell"),
    ],
)
def test_failures_are_the_same(rates, k, said, dtype, plain):
    circuit = tf.Circuit(rates, species="a", initial={"a": 0.5}, k=torch.tensor(k))
    a, b = ends(alone(circuit, count=3), 1, dt=1.0, colonies=3, dtype=dtype)
    one, other = (state.reports["circuit"] for state in (a, b))
    assert one.status.tolist() == [0, 1, 1] == other.status.tolist()
    assert one.words == other.words and torch.equal(one.steps, other.steps)
    assert all(said in words for words in one.words.values()), one.words
    equal(a, b)


# --- derivatives in the torch path, and gradients -------------------------------------------------


def test_equations_and_autograd_agree():
    """The torch path takes the derivatives of its equations; those of autograd give the same."""
    cells, _, start = one_step(by("torch", alone(toggle(k=tf.LogNormal(4.0, 0.3)))))
    assert cells.by_torch and cells.compiled is not None
    one, _ = rodas3(cells.rates, start, 0.5, slopes=cells.slopes)
    other, _ = rodas3(cells.rates, start, 0.5)
    assert array(one) == pytest.approx(array(other), rel=1e-12)
    with deterministic_functions():
        for k in range(2):
            u = start.t().clone().requires_grad_()
            (grad,) = torch.autograd.grad(cells.rates(u.t(), torch.arange(12))[:, k].sum(), u)
            slopes = cells.slopes(start.t(), torch.arange(12))[k]
            assert array(slopes) == pytest.approx(array(grad), rel=1e-13)


@pytest.mark.parametrize("method", ["rosenbrock", "rk4"])
@pytest.mark.parametrize("wanted", ["constant", "first value"])
def test_gradients_need_torch_and_get_it(wanted, method, plain):
    def loss(backend, more=0.0):
        value = torch.tensor(2.0 + more, dtype=F64, requires_grad=True)
        k = value if wanted == "constant" else 4.0
        first = {"red": value if wanted == "first value" else 1.0, "green": 0.5}
        circuit = tf.Circuit(switch, species=("red", "green"), initial=first, method=method,
                             backend=backend, k=k, loss=1.0)  # fmt: skip
        model = alone(circuit).bind(seed=1, dtype=F64)
        end = model.step(model.start(), 0.1)
        (grad,) = torch.autograd.grad(end.red.sum(), value)
        return float(end.red.sum().detach()), float(grad)

    (value, grad), (_, other) = loss(None), loss("torch")
    assert grad == pytest.approx(other, rel=1e-12)
    assert (loss("torch", 1e-5)[0] - value) / 1e-5 == pytest.approx(grad, rel=1e-4)


# --- what is said, and where compiled functions are kept ------------------------------------------


def branching(u, s, p, cell):
    return {"a": u.a.cumsum(0) * 0 - u.a}


def test_it_is_explained_who_computes():
    said = lambda circuit: tf.explain(alone(circuit))
    assert "computed by compiled functions of its equations" in said(toggle())
    assert "computed by torch: backend='torch'" in said(toggle(backend="torch"))
    words = said(tf.Circuit(branching, species="a"))
    assert (
        "computed by torch: branching: it uses a sum or the like over all cells (cumsum)" in words
    )
    with pytest.raises(tf.InputError, match="backend = 'compiled', but branching: it uses a sum"):
        said(tf.Circuit(branching, species="a", backend="compiled"))
    learnt = said(toggle(k=torch.tensor(2.0, requires_grad=True)))
    assert (
        "computed by compiled functions of its equations, gradients by up to 64 numbers too"
        in learnt
    )
    equal_steps = said(toggle(method="rk4"))
    assert "computed by compiled functions of its equations; where gradients" in equal_steps
    assert "required by torch, with derivatives from them" in equal_steps
    assert "computed by torch: backend='torch'" in said(toggle(method="rk4", backend="torch"))


def test_what_cannot_be_traced_runs_by_torch():
    scene = alone(tf.Circuit(branching, species="a", initial={"a": 1.0}))
    model = scene.bind(dtype=F64)
    assert float(model.step(model.start(), 0.1).a[0]) < 1.0


def careless(u, s, p, cell):
    return {"a": {torch.Tensor: -u.a}[type(u.a)]}


def test_functions_that_fail_on_traced_columns_run_by_torch():
    scene = alone(tf.Circuit(careless, species="a", initial={"a": 1.0}))
    assert "torch: careless: called with columns that have no numbers, it raised KeyError" in (
        tf.explain(scene)
    )
    model = scene.bind(dtype=F64)
    assert float(model.step(model.start(), 0.1).a[0]) < 1.0


def test_a_text_says_all_that_it_depends_on(monkeypatch):
    """Constants by value: so compiled functions of other constants are never found."""
    cells, *_ = one_step(by("torch", alone(toggle())))
    text = cells.compiled.text
    assert f"SAFETY = {SAFETY!r}\n" in text and "rosenbrock" not in text
    monkeypatch.setattr("torchfilm.kernels.compiling.FOLDER", None)
    made = compiled._module.__wrapped__(text)
    assert for_python(made.times_slopes)((1.0, 2.0, 3.0, 4.0), (1.0, 10.0)) == (21.0, 43.0)


# --- circuits at random ---------------------------------------------------------------------------


DRAWN = st.tuples(circuits(), st.sampled_from([F32, F64]))


@pytest.mark.parametrize("seed", [3, 4, 5, 6])
def test_circuits_at_random(plain, seed):
    """Eight of each seed; `experiments/fuzz_circuits.py` draws thousands."""
    for_each(DRAWN, 8, seed, lambda drawn: same_by_all(*drawn), phases=[Phase.generate])


def same_by_all(made: dict, dtype: torch.dtype) -> None:
    """Compiled text and torch: the same bits. Functions and reactions: the same to the solver's
    tolerance, which is what their different rounding is allowed."""
    x0 = tf.Signal(diffusion=5.0, initial=0.3)
    medium = tf.Medium(x0=x0, box=((-16.0, -8.0), (32.0, 8.0)), spacing=8.0)
    first = {n: tf.Uniform(0.0, 2.0) for n in made["species"]}
    found = []
    for form in ("function", "reactions"):
        circuit = tf.Circuit(made[form], species=made["species"], initial=first, rtol=1e-6)
        scene = alone(circuit, medium, count=4, types=2)
        a, b = ends(scene, 1, dt=0.3, dtype=dtype)
        equal(a, b)
        assert not a.reports["circuit"].status.any()
        found.append(a)
    close(*found, rel=1e-5, least=1e-8)


# --- methods with equal steps ---------------------------------------------------------------------

EQUAL_STEPS = ["euler", "midpoint", "heun2", "heun3", "rk4"]


@pytest.mark.parametrize("method", EQUAL_STEPS)
@pytest.mark.parametrize("steps", [1, 7])
def test_equal_steps_give_the_same_bits(method, steps, dtype, plain):
    """Numbers of the state's own type: a seventh of the step is no number of either."""
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=10.0, reservoir=0.5), box=((-8.0, -8.0), (24.0, 8.0)),
        spacing=4.0, outside="reservoir",
    )  # fmt: skip
    first = tf.Circuit(exchanging, species="ahl", D=0.3, k=2.0, method=method, steps=steps)
    second = toggle(k=tf.LogNormal(4.0, 0.3), name="toggle", method=method, steps=steps)
    a, b = ends(alone(first, second, medium, types=2), dtype=dtype)
    equal(a, b)
    assert float(a.ahl[-1]) != float(a.ahl[0]) > 0 and len(a.toggle_red.unique()) > 6


@pytest.mark.parametrize("method", EQUAL_STEPS)
@pytest.mark.parametrize(
    "rates, k, said",
    [
        (nan_above, [0.0, 9.0, 9.0], "is not a finite number"),
        (draining, [2.0, 0.0, 0.5], "below zero, 'a' first, from .* Take more steps"),
        (exploding, [0.1, 1e300, 1e300], "is not a finite number"),
    ],
)
def test_failures_of_equal_steps_are_the_same(method, rates, k, said, plain):
    circuit = tf.Circuit(rates, species="a", initial={"a": 0.5}, k=torch.tensor(k, dtype=F64),
                         method=method, steps=3)  # fmt: skip
    a, b = ends(alone(circuit, count=3), 1, dt=1.0, colonies=3)
    one, other = (state.reports["circuit"] for state in (a, b))
    assert one.status.tolist() == [0, 1, 1] == other.status.tolist()
    assert one.words == other.words
    assert all(re.search(said, words) for words in one.words.values()), one.words


def test_equal_steps_compiled_for_real(dtype):
    a, b = ends(alone(toggle(method="rk4", steps=3)), dtype=dtype)
    equal(a, b)


def test_what_is_compiled_is_told_by_cell_type_and_names_each_thing_once(capsys, monkeypatch):
    """A user knows then why there are two lines, and why a circuit of the same name has another
    one."""
    monkeypatch.setattr(compiling, "_mark", lambda name: None)  # none is in the cache

    def leaking(u, s, p, cell):
        out = p.leak * (u.ahl - s.ahl) * cell.area
        return {"odd": p.k * s.food**2, "ahl": -out / cell.volume}, {"ahl": out}

    signals = {n: tf.Signal(diffusion=9.0, initial=1.0) for n in ("ahl", "food")}
    scene = tf.Scene(
        tf.Circuit({0: leaking}, species=("odd", "ahl"), leak=tf.Uniform(0.5, 1.0), k=2.0),
        tf.Medium(**signals, box=((-8, -8), (8, 8)), spacing=4.0),
        dim=2,
    )
    for _ in tf.simulate(scene, until=0.025):
        pass
    said = [x for x in capsys.readouterr().err.splitlines() if "circuit" in x]
    assert said == [
        "torchfilm: compiling the circuit leaking (cell type 0); species odd, ahl; signals ahl,"
        " food; constants with a value for each cell leak; some seconds, once for this installation"
    ]
