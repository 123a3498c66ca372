"""Laws that steps of transport keep by every method: bounds, gradients, and the same bits in any
batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_operator import FLOWS, SPACING

import torchfilm as tf
from torchfilm.signals.boundary_conditions import (
    BoundaryConditions,
    Dirichlet,
    NoFlux,
    Open,
    Periodic,
    Robin,
)
from torchfilm.signals.mixing import ABOVE
from torchfilm.signals.transport import METHODS, prepare
from torchfilm.signals.transport_rates import build_operator

face = st.one_of(
    st.just(NoFlux()),
    st.builds(Dirichlet, st.floats(0, 1)),
    st.builds(Open, st.floats(0, 1)),
    st.builds(Robin, st.floats(0, 1), st.floats(1e-3, 1e6)),
)
pair = st.one_of(st.just(Periodic()), st.tuples(face, face))
closed = st.sampled_from([NoFlux(), Periodic()])
shapes = st.tuples(*[st.integers(1, 7)] * 3)
powers = st.floats(-3, 6)
common = {
    "seed": st.integers(0, 2**31),
    "shape": shapes,
    "power": powers,
    "masked": st.booleans(),
    "kind": st.sampled_from(FLOWS),
    "single": st.booleans(),
    "method": st.sampled_from(["exponential", "series", "implicit"]),
}


def random_operator(seed, shape, power, masked, kind, single, method, boundary, decay=0.0):
    """An operator with greatest diffusion number r = KΔt/h² = 10^power in a step of 1 h.

    Its velocity has a Péclet number up to 100.
    """
    rng = np.random.default_rng(seed)
    h = rng.uniform(0.5, 3.0, 3)
    k = 10.0**power * h.min() ** 2
    if method == "exponential":
        masked, kind = False, "uniform" if kind == "varying" else kind
    velocity = None
    if kind != "still":
        scale = k / h.min() * 10 ** rng.uniform(-2, 2)
        velocity = torch.as_tensor(scale * rng.normal(size=3))
        if kind == "varying":
            arrays = [
                scale * rng.normal(size=tuple(n + (a == b) for b, n in enumerate(shape)))
                for a in range(3)
            ]
            for a, values in enumerate(arrays):
                np.moveaxis(values, a, 0)[-1] = np.moveaxis(values, a, 0)[0]
            velocity = tuple(torch.as_tensor(a) for a in arrays)
    mask = rng.uniform(size=shape) < 0.7 if masked else np.ones(shape, dtype=bool)
    dtype = torch.float32 if single else torch.float64
    op = build_operator(
        shape,
        tuple(h),
        diffusion=k,
        decay=decay,
        velocity=velocity,
        boundary=boundary,
        dtype=dtype,
        mask=torch.as_tensor(mask) if masked else None,
    )
    u = torch.as_tensor(
        rng.uniform(size=shape) * mask * (rng.uniform(size=shape) < 0.5), dtype=dtype
    )[None]
    return op, u, torch.as_tensor(mask)


def roundings(op, method: str) -> float:
    """The greatest relative error of a sum of non-negative parts in a step of 1 h: a few roundings
    per voxel and axis.

    The series, always in float64, takes λΔt products of the operator on average. Each rounds a
    voxel's content at most nine times by ε/2: its seven parts, their six sums, the parts
    themselves; and each term of the series is added once. Above MOST one solve takes its place.
    What it leaves of the equation is rounded as each of the λΔt exchanges is.
    """
    few = 8 * sum(op.shape) * torch.finfo(op.dtype).eps
    if method != "series":
        return few
    products = ABOVE * float(op.loss.max())
    return few + 8 * products * torch.finfo(torch.float64).eps


@settings(max_examples=150, deadline=None)
@given(**common, decay=st.floats(0, 5), x=pair, y=pair, z=pair)
def test_nothing_goes_below_zero(x, y, z, decay, **drawn):
    """Exactly, for any box, faces, flow and step."""
    op, u, mask = random_operator(boundary=BoundaryConditions(x, y, z), decay=decay, **drawn)
    after = prepare(op, 1.0, drawn["method"]).step(u)
    assert bool(torch.isfinite(after).all()) and float(after.min()) >= 0
    assert bool((after[0][~mask] == 0).all())  # and obstacles stay empty


@settings(max_examples=150, deadline=None)
@given(**common, x=closed, y=closed, z=closed)
def test_nothing_is_lost_in_a_closed_box(x, y, z, **drawn):
    op, u, _ = random_operator(boundary=BoundaryConditions(x, y, z), **drawn)
    before, after = (
        float(u.double().sum()),
        float(prepare(op, 1.0, drawn["method"]).step(u).double().sum()),
    )
    assert after == pytest.approx(before, rel=roundings(op, drawn["method"]), abs=1e-300)


@pytest.mark.parametrize("diffusion", [0.013, 0.3, 5.0, 300.0])
def test_the_parts_of_a_voxel_in_float32_add_up_to_all_of_it(diffusion):
    """Or each step would lose, or add, the same again: what is left is at most half a unit in the
    last place of the second largest part."""
    for n in (9, 33, 70):
        op = build_operator((n, 1, 1), SPACING, diffusion=diffusion)
        parts = prepare(op, 1.0, "exponential").factors[0][0, :n, :n].double()
        second = parts.topk(2, 1).values[:, 1]
        off = (parts.sum(1) - 1).abs()
        # (sums in float64 are themselves rounded)
        assert bool((off <= torch.finfo(torch.float32).eps / 2 * second + 1e-15).all())


def test_many_implicit_steps_in_float32_lose_nothing():
    """63 values near ½ are each rounded twice in each of 2,000 steps: were these random, their sum
    would change by some 2 ε. Shares that do not add up to 1 change it by hundreds."""
    op = build_operator((9, 7, 1), (1.0, 1.3, 1.0), diffusion=0.013)
    stepper = prepare(op, 1.0, "implicit")
    u = torch.rand(1, 9, 7, 1, generator=torch.Generator().manual_seed(1))
    before = float(u.double().sum())
    for _ in range(2000):
        u = stepper.step(u)
    assert abs(float(u.double().sum()) / before - 1) <= 60 * torch.finfo(torch.float32).eps


@settings(max_examples=150, deadline=None)
@given(**common, x=pair, y=pair, z=pair)
def test_nothing_rises_above_what_is_there_or_beyond_the_faces(x, y, z, **drawn):
    """Without flow, values between 0 and 1 stay so if all faces are."""
    op, u, _ = random_operator(boundary=BoundaryConditions(x, y, z), **(drawn | {"kind": "still"}))
    after = prepare(op, 1.0, drawn["method"]).step(u)
    assert float(after.max()) <= 1 + roundings(op, drawn["method"])


def params(dtype=torch.float64):
    t = lambda *x: torch.tensor(x, dtype=dtype, requires_grad=True)
    return {
        "diffusion": t(0.7, 1.1),
        "decay": t(0.3, 0.1),
        "velocity": torch.tensor(
            [[0.5, -1.0, 0.0], [0.0, 0.2, 2.0]], dtype=dtype, requires_grad=True
        ),
        "value": t(1.0, 2.0),
        "source": t(0.2, 0.4),
    }


# the exponential takes no obstacles
@pytest.mark.parametrize(
    "method, masked",
    [*((m, False) for m in METHODS), *((m, True) for m in METHODS if m != "exponential")],
)
@pytest.mark.parametrize("periodic", [False, True])
def test_slopes(method, periodic, masked):
    """By u, diffusion, velocity, decay, source and a face's value against central differences.

    Two steps in float64. With an iterative solve to 1e-10 the differences are accurate to
    1e-10/1e-4.
    """
    shape, dt = (3, 2, 2), 0.4
    mask = torch.as_tensor(np.random.default_rng(2).uniform(size=shape) < 0.8) if masked else None
    rough = method == "crank_nicolson"
    u = torch.as_tensor(np.random.default_rng(3).uniform(0.5, 1.0, (2, *shape))).requires_grad_()

    def run(u, diffusion, decay, velocity, value, source):
        faces = BoundaryConditions(
            x=Periodic() if periodic else (Dirichlet(value), NoFlux()),
            y=(Open(value), Dirichlet(0.5)),
        )
        op = build_operator(
            shape,
            SPACING,
            diffusion=diffusion,
            decay=decay,
            velocity=velocity,
            boundary=faces,
            mask=mask,
            source=source,
            colonies=2,
            dtype=torch.float64,
        )
        stepper = prepare(op, dt, method)
        return stepper.step(stepper.step(u))

    given = (u, *params().values())
    # (along directions at random: one run for each input and element would take half a minute)
    assert torch.autograd.gradcheck(
        run, given, eps=1e-4 if rough else 1e-6, atol=1e-5 if rough else 1e-7, fast_mode=True
    )


@pytest.mark.parametrize("method", [m for m in METHODS if m != "exponential"])
def test_slopes_by_a_velocity_on_faces(method):
    shape = (3, 2, 2)
    rng = np.random.default_rng(4)
    velocity = tuple(
        torch.as_tensor(
            rng.normal(size=tuple(n + (a == b) for b, n in enumerate(shape)))
        ).requires_grad_()
        for a in range(3)
    )
    u = torch.as_tensor(rng.uniform(0.5, 1.0, (1, *shape)))
    rough = method == "crank_nicolson"

    def run(*v):
        return prepare(
            build_operator(
                shape,
                SPACING,
                diffusion=1.0,
                velocity=v,
                boundary=BoundaryConditions(x=(Dirichlet(1.0), Open())),
                dtype=torch.float64,
            ),
            0.4,
            method,
        ).step(u)

    assert torch.autograd.gradcheck(
        run, velocity, eps=1e-4 if rough else 1e-6, atol=1e-5 if rough else 1e-7
    )


# Crank-Nicolson works in float64 whatever the dtype
@pytest.mark.parametrize(
    "method, dtype",
    [
        *((m, torch.float64) for m in METHODS),
        *((m, torch.float32) for m in METHODS if m != "crank_nicolson"),
    ],
    ids=str,
)
@pytest.mark.parametrize("shape", [(9, 8, 7), (33, 1, 1), (12, 11, 1), (1, 1, 1)], ids=str)
@pytest.mark.parametrize("own", [False, True], ids=["shared", "each its own"])
def test_a_colony_does_not_see_the_others(device, dtype, method, shape, own, deterministic):
    """The same bits after three steps alone and in batches of 2 and 17.

    In the other colonies everything is a thousand times faster.
    """
    rng, count = np.random.default_rng(5), 17
    t = lambda *s: torch.as_tensor(rng.uniform(0.1, 1, s), device=device)
    fast = 10.0 ** torch.as_tensor(rng.uniform(-2, 1, count), device=device)
    diffusion, decay, velocity, value = (
        t(count) * fast,
        t(count) * fast,
        t(count, 3) * fast[:, None],
        t(count),
    )
    masks = torch.as_tensor(rng.uniform(size=(count, *shape)) < 0.8, device=device)
    u = t(count, *shape).to(dtype)

    def of(k: slice):
        size = len(range(*k.indices(count)))
        part = k if own else slice(0, 1)
        op = build_operator(
            shape,
            SPACING,
            diffusion=diffusion[part],
            decay=decay[part],
            velocity=velocity[part] if own else velocity[0],
            source=0.3,
            colonies=size,
            boundary=BoundaryConditions(x=(Dirichlet(value[part]), Open()), y=Periodic()),
            mask=None if method == "exponential" else masks[k],
            dtype=dtype,
            device=device,
        )
        stepper, v = prepare(op, 0.5, method), u[k]
        for _ in range(3):
            v = stepper.step(v)
        return v

    everyone, two = of(slice(0, count)), of(slice(3, 5))
    assert torch.equal(two, everyone[3:5])
    for k in (0, 3, 16):
        assert torch.equal(of(slice(k, k + 1)), everyone[k : k + 1])


def test_exchanges_of_which_only_rounding_would_be_left_are_refused():
    """With 2e12 of a voxel in a step a field was off by 2 %, with 2e15 it was nonsense."""

    def scene(diffusion):
        signal = tf.Signal(diffusion=diffusion, initial=lambda p: 1.0 * (p[:, 0] > 0))
        medium = tf.Medium(
            a=signal, box=((-4, -4), (4, 4)), spacing=1.0, obstacles=lambda p: p[:, 1] > 3
        )
        return tf.Scene(tf.Growth(rate=1.0), medium, dim=2, dt=0.1)

    *_, state = tf.simulate(scene(1e12), until=0.3)
    amounts = state.signals["a"]
    assert float(amounts.sum()) == pytest.approx(28.0, rel=1e-5)
    with pytest.raises(tf.InputError, match=r"signal 'a' = .*2e\+13 exchanges of a voxel.*1e\+12"):
        for _ in tf.simulate(scene(1e14), until=0.1):
            pass
