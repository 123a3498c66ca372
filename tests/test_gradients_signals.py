"""Gradients of whole runs through circuit, exchange, transport, feeding and division, in float64
against central differences.

Bounds as in test_gradients: the central difference at h = 1e-5 is off by h² ≈ 1e-10 of the third
derivative and by the solves' 1e-10 over 2h, so 1e-5 of the gradient's size. The stiff integrator
chooses its steps by what it meets, and its gradient takes them as given; here every run is made
such that it goes in one step at both ends of the difference, so that the two are the same function.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from differences import F64, compare, weights
from helpers import step
from torch import Tensor

import torchfilm as tf
from torchfilm import together

DT = 0.05
BOX = {"box": ((-8.0, -8.0), (8.0, 8.0)), "spacing": 2.0}


@pytest.fixture(autouse=True)
def solved(monkeypatch):
    """Exchange and transport solved far closer than the circuits' tolerance, which is wide here so
    that differences see the same steps: or they would see the iteration."""
    monkeypatch.setattr(together, "PART", 1e-8)
    monkeypatch.setattr(together, "FINE", 1e-8)


def lux(u, s, p, cell):
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    return {
        "luxi": p.basal + u.ahl**2 / (p.half + u.ahl**2) - u.luxi,
        "ahl": p.make * u.luxi + into / cell.volume,
    }, {"ahl": -into}


def founders() -> tf.Cells:
    """Two rods at generic places, which touch while they grow."""
    return tf.Cells([[-0.3, -0.47], [0.4, 0.46]], [[1.0, 0.11], [1.0, -0.07]], [2.05, 2.21])


def body(divides: bool) -> list[tf.Effect]:
    more = [tf.Division(length=2.35)] if divides else []
    return [tf.Growth(rate=1.0), *more, tf.Mechanics(dim=2, tolerance=1e-10, alpha=0.1)]


CONSTANTS = {"D1": 1.0, "basal": 0.2, "half": 1.0, "make": 2.0}
OPTIONS = {
    "diffusion": 15.0,
    "decay": 0.3,
    "initial": 0.4,
    "source": 0.2,
    "face": 0.8,
    "flow": 2.0,
    "luxi": 0.9,
}


def talking(
    *, divides: bool = False, circuit: dict | None = None, medium: dict | None = None, **given
) -> tf.Scene:
    """Quorum sensing with every constant to be had, by name."""
    at = {**CONSTANTS, **OPTIONS, **given}
    signal = tf.Signal(
        diffusion=at["diffusion"], decay=at["decay"], initial=at["initial"], source=at["source"]
    )
    return tf.Scene(
        *body(divides),
        tf.Circuit(
            lux,
            species=("luxi", "ahl"),
            initial={"luxi": at["luxi"]},
            **{"rtol": 0.05, "atol": 0.05, "daughters": "amount", **(circuit or {})},
            **{n: at[n] for n in CONSTANTS},
        ),
        tf.Medium(
            ahl=signal,
            boundary=tf.BoundaryConditions(x=(tf.Dirichlet(at["face"]), tf.Open())),
            flow=(at["flow"], 0.0),
            **{**BOX, **(medium or {})},
        ),
        founders=founders(),
    )


def outcome(state: tf.State) -> Tensor:
    """One number that depends on every cell's contents and shape, and on every voxel."""
    # the last displacement is where the next solve starts from, without a gradient
    fields = [
        v
        for n, v in state.fields.items()
        if v.dtype == F64 and n not in ("displacement", "elongation", "division_threshold")
    ]
    return sum((x * weights(x)).sum() for x in (*fields, state.position, state.length))


def run(scene: tf.Scene, steps: int, colonies: int = 1) -> tf.State:
    model = scene.bind(colonies, seed=2, dtype=F64)
    state = model.start()
    for _ in range(steps):
        state = step(scene, state, DT)
        assert all(bool((r.status == 0).all()) for r in state.reports.values())
        if "circuit" in state.reports and state.cells:
            parts = next(e.steps for e in scene.effects if isinstance(e, tf.Medium))
            turns = max(parts, *(e.plan.turns for e in model.effects))
            assert int(state.reports["circuit"].steps.max()) == turns, (
                "the difference would see other steps"
            )
    return state


def check(
    make: Callable[[Tensor], tf.Scene],
    at: float | list[float],
    steps: int = 6,
    colonies: int = 1,
    divides: bool = False,
) -> Tensor:
    return compare(outcome, lambda x: run(make(x), steps, colonies), at, divides=divides)


@pytest.mark.parametrize("name", [*CONSTANTS, *OPTIONS])
def test_every_constant_of_circuit_signal_and_face(name):
    check(lambda x: talking(**{name: x}), {**CONSTANTS, **OPTIONS}[name])


@pytest.mark.parametrize("name", ["make", "luxi", "diffusion", "decay", "face"])
@pytest.mark.parametrize("daughters", ["concentration", "amount"])
def test_through_division(name, daughters):
    check(
        lambda x: talking(divides=True, circuit={"daughters": daughters}, **{name: x}),
        {**CONSTANTS, **OPTIONS}[name],
        steps=8,
        divides=True,
    )


@pytest.mark.parametrize("method", ["rk4", "euler", "midpoint"])
def test_explicit_methods(method):
    check(lambda x: talking(circuit={"method": method}, make=x), 2.0)


@pytest.mark.parametrize("name", ["diffusion", "decay", "flow", "face"])
@pytest.mark.parametrize("method", ["implicit", "crank_nicolson", "euler"])
def test_every_way_of_transport(method, name):
    medium = {"method": method, "exchange": "turns"}
    check(lambda x: talking(medium=medium, **{name: x}), OPTIONS[name], steps=3)


@pytest.mark.parametrize("exchange", ["turns", "together"])
@pytest.mark.parametrize("name", ["make", "luxi", "diffusion", "D1", "initial"])
def test_in_parts_of_a_step(name, exchange):
    medium = {"steps": 3, "exchange": exchange}
    at = {**CONSTANTS, **OPTIONS}[name]
    check(lambda x: talking(medium=medium, **{name: x}), at, steps=3)


def test_about_an_obstacle():
    check(
        lambda x: talking(
            medium={"obstacles": lambda at: (at[:, 0] > 2) & (at[:, 1] > 2)}, diffusion=x
        ),
        15.0,
        steps=3,
    )


def test_on_a_grid_that_grows():
    start = {"box": ((-1.5, -1.5), (1.5, 1.5)), "spacing": 0.5, "depth": 1.0, "outside": "grow"}
    make = lambda x: tf.Scene(
        *body(True),
        tf.Circuit(
            lux,
            species=("luxi", "ahl"),
            initial={"luxi": 0.9},
            rtol=0.05,
            atol=0.05,
            **{**CONSTANTS, "make": x},
        ),
        tf.Medium(ahl=tf.Signal(diffusion=15.0, initial=0.2), **start),
        founders=founders(),
    )
    assert run(make(torch.tensor(2.0)), 8).layout.grid.nodes > 36
    check(make, 2.0, steps=8, divides=True)


def test_where_cells_are_beyond_an_open_box():
    box = {"box": ((-2.0, -0.2), (2.0, 0.2)), "spacing": (1.0, 0.2), "outside": "reservoir"}

    def make(x):
        signal = tf.Signal(diffusion=15.0, reservoir=x)
        circuit = tf.Circuit(
            lux, species=("luxi", "ahl"), initial={"luxi": 0.9}, rtol=0.05, atol=0.05, **CONSTANTS
        )
        return tf.Scene(*body(False), circuit, tf.Medium(ahl=signal, **box), founders=founders())

    check(make, 0.7)


@pytest.mark.parametrize("name", ["make", "diffusion", "decay", "face"])
def test_one_value_per_colony(name):
    """Each colony's own entry, and no other: with what only colony 1 has, only entry 1 has a
    gradient."""
    at = [{**CONSTANTS, **OPTIONS}[name] * f for f in (1.0, 1.2, 0.8)]
    check(lambda x: talking(**{name: x}), at, steps=4, colonies=3)
    value = torch.tensor(at, dtype=F64, requires_grad=True)
    last = run(talking(**{name: value}), 4, 3)
    own = (last.luxi * (last.colony == 1)).sum() + last.signals["ahl"].reshape(3, -1)[1].sum()
    (gradient,) = torch.autograd.grad(own, value)
    assert float(gradient[1].abs()) > 1e-4 and gradient[0] == gradient[2] == 0


def feeding(rate=1.0, half=0.3, growth_yield=2.0, diffusion=15.0, supply=0.8) -> tf.Scene:
    return tf.Scene(
        tf.Monod("food", rate=rate, half=half, growth_yield=growth_yield),
        tf.Growth(),
        tf.Mechanics(dim=2, tolerance=1e-10, alpha=0.1),
        tf.Medium(
            food=tf.Signal(diffusion=diffusion, initial=0.5),
            boundary=tf.BoundaryConditions(x=tf.Dirichlet(supply)),
            depth=1.0,
            **BOX,
        ),
        founders=founders(),
    )


@pytest.mark.parametrize(
    ("name", "at"),
    [
        ("rate", 1.0),
        ("half", 0.3),
        ("growth_yield", 2.0),
        ("diffusion", 15.0),
        ("supply", 0.8),
        ("rate", [0.8, 1.2]),
    ],
)
def test_feeding(name, at):
    check(lambda x: feeding(**{name: x}), at, colonies=2 if isinstance(at, list) else 1)


def test_functions_of_places_may_hold_what_wants_a_gradient():
    """A sink whose strength is asked for; and again, from a graph of its own."""
    strength = torch.tensor(0.5, dtype=F64, requires_grad=True)

    def make(x):
        return tf.Scene(
            tf.Medium(
                a=tf.Signal(diffusion=5.0, initial=1.0, decay=lambda at: x * (at[:, 0] > 0)), **BOX
            ),
            founders=founders(),
        )

    check(make, 0.5, steps=3)
    scene = make(strength)
    state = scene.bind(dtype=F64).start()
    both = [
        torch.autograd.grad(outcome(step(scene, step(scene, state, DT), DT)), strength)[0]
        for _ in range(2)
    ]
    assert both[0] == both[1] != 0


def test_what_was_made_ready_without_a_gradient_does_not_hide_it():
    """A look without gradients, then a step with them, by one model: nothing made ready before may
    be used. A constant that an optimiser changes in place counts once the scene is bound again."""
    K = torch.tensor(15.0, dtype=F64, requires_grad=True)
    scene = tf.Scene(
        tf.Medium(a=tf.Signal(diffusion=K, initial=lambda at: (at[:, 0] > 0).double()), **BOX),
        founders=founders(),
    )
    with torch.no_grad():
        model = scene.bind(dtype=F64)
        state = model.start()
        before = model.step(state, DT).signals["a"]
    after = model.step(state, DT).signals["a"]
    assert after.requires_grad and torch.equal(before, after.detach())
    (gradient,) = torch.autograd.grad((after * weights(after)).sum(), K)
    with torch.no_grad():
        K += 1e-3
        assert torch.equal(model.step(state, DT).signals["a"], before)
        moved = scene.bind(dtype=F64).step(state, DT).signals["a"]
    slope = float(((moved - before) * weights(before)).sum()) / 1e-3
    # a one-sided difference, h times the curvature
    assert slope == pytest.approx(float(gradient), rel=1e-3) and slope != 0


def test_a_model_bound_without_gradients_carries_them():
    """The values of cells, too."""
    rate = torch.tensor(1.0, dtype=F64, requires_grad=True)
    scene = tf.Scene(tf.Growth(rate=rate), dim=2)
    with torch.no_grad():
        model = scene.bind(dtype=F64)
        assert not model.step(model.start(), DT).length.requires_grad
    (late,) = torch.autograd.grad(model.step(model.start(), DT).length.sum(), rate)
    usual = scene.bind(dtype=F64)
    (wanted,) = torch.autograd.grad(usual.step(usual.start(), DT).length.sum(), rate)
    assert late == wanted != 0


# --- rollout --------------------------------------------------------------------------------------


def saved(work: Callable[[], Tensor]) -> tuple[Tensor, int]:
    """What comes out, and the bytes of different tensors kept for the way back."""
    kept: dict[int, int] = {}

    def pack(x: Tensor) -> Tensor:
        # by identity of the memory where there is one; a sparse matrix or a batched view of forward
        # derivatives has none of its own
        try:
            kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        except (RuntimeError, NotImplementedError):
            kept[id(x)] = x.numel() * x.element_size()
        return x

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        out = work()
    return out, sum(kept.values())


def test_rollout_gives_the_gradient_of_simulate_and_keeps_less():
    values = torch.tensor([2.0, 15.0], dtype=F64, requires_grad=True)
    scene = talking(divides=True, make=values[0], diffusion=values[1])
    state = scene.bind(seed=2, dtype=F64).start()
    plain, much = saved(lambda: outcome(list(tf.simulate(scene, state, until=16 * DT, dt=DT))[-1]))
    # keeping by segments: what a segment needs is made on the way back
    short, little = saved(
        lambda: outcome(tf.rollout(scene, state, until=16 * DT, dt=DT, segment=4))
    )
    assert torch.equal(short, plain)
    wanted = torch.autograd.grad(plain, values)[0]
    (found,) = torch.autograd.grad(short, values)
    assert torch.allclose(found, wanted, rtol=1e-12, atol=0) and bool((wanted != 0).all())
    assert little < 0.2 * much, (little, much)


@pytest.mark.parametrize("segment", [1, 3, 100])
def test_rollout_whatever_the_segment(segment):
    """Also where the last one is shorter, and where a colony divides within one."""
    make = torch.tensor([2.0, 3.0], dtype=F64, requires_grad=True)
    scene = talking(divides=True, make=make)
    state = scene.bind(2, seed=2, dtype=F64).start()
    last = tf.rollout(scene, state, until=8 * DT, dt=DT, segment=segment)
    plain = list(tf.simulate(scene, state, until=8 * DT, dt=DT))[-1]
    assert (
        last.step == 8
        and torch.equal(last.uid, plain.uid)
        and torch.equal(last.luxi, plain.luxi)
        and last.cells > 4
    )
    pair = [torch.autograd.grad(outcome(s), make)[0] for s in (last, plain)]
    assert torch.allclose(pair[0], pair[1], rtol=1e-12, atol=0)


def test_rollout_raises_as_simulate_does():
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"m": torch.where(u.m > 0.1, torch.nan, 1.0)},
        species=("m",),
        method="euler",
    )
    scene = tf.Scene(circuit, founders=founders())
    with pytest.raises(tf.SimulationError, match=r"(?s)step 4.*colony 0.*'m'") as failed:
        tf.rollout(scene, scene.bind(dtype=F64).start(), until=0.48, dt=0.04)
    assert failed.value.colonies == (0,)
    with pytest.raises(tf.InputError, match="segment"):
        tf.rollout(scene, scene.bind().start(), until=0.5, segment=0)
