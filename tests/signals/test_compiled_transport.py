"""Transport by kernels: the same numbers as by torch, and the same bits in any company."""

from __future__ import annotations

import pytest
import torch
from test_operator import BOUNDARIES, FLOWS, SHAPES, operator_of

import torchfilm as tf
from torchfilm.signals.boundary_conditions import BoundaryConditions, Periodic
from torchfilm.signals.grid import Grid
from torchfilm.signals.transport import COMPILED, Carrier, carry, prepare
from torchfilm.signals.transport_iterative import Unsplit
from torchfilm.signals.transport_rates import build_operator
from torchfilm.signals.transport_series import MOST
from torchfilm.tools.checks import InputError
from torchfilm.tools.tangents import forward_mode, tangent, with_tangent

DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
# 70 voxels make tiles of every width, 130 a panel as well
LONG = [(70, 5, 4), (4, 5, 70), (5, 130, 2), (70, 1, 130)]


def grid_of(*shapes) -> Grid:
    shape = torch.tensor(shapes)
    return Grid(torch.zeros(len(shapes), 3, dtype=torch.float64), shape, (1.0, 1.0, 1.0))


def by_kernel(stepper, values) -> torch.Tensor:
    """Values (B, nx, ny, nz) after the step; an error where there is no kernel."""
    carrier = Carrier(stepper, tuple(values.shape[1:]))
    assert carrier.compiled is not None
    grid = grid_of(*[values.shape[1:]] * values.shape[0])
    return carry(grid, [carrier], values.reshape(-1)).view(values.shape)


def roundings(shape) -> int:
    """A value is one sum for each axis, of non-negative terms. Both ways round each product and
    each partial sum at most once: a relative ε for each voxel of the three axes and way."""
    return 2 * sum(shape) + 6


@DTYPES
@pytest.mark.parametrize("dt", [1e-3, 0.7, 40.0])
@pytest.mark.parametrize("shape", [*SHAPES, *LONG], ids=str)
@pytest.mark.parametrize("faces", BOUNDARIES)
@pytest.mark.parametrize("kind", FLOWS[:2])
def test_exponential_is_that_of_torch(dtype, shape, faces, kind, dt):
    op, *_ = operator_of(shape, faces, kind, dtype=dtype)
    stepper = prepare(op, dt, "exponential")
    u = torch.rand(1, *shape, dtype=dtype, generator=torch.Generator().manual_seed(1))
    one, other = stepper.step(u), by_kernel(stepper, u)
    allowed = roundings(shape) * torch.finfo(dtype).eps
    assert bool(((one - other).abs() <= allowed * one).all())


@DTYPES
@pytest.mark.parametrize("method", sorted(COMPILED))
def test_far_from_a_source_nothing_is_subnormal(dtype, method):
    """A concentration falls without end, and subnormal numbers take a hundred times as long."""
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no choice of what subnormal numbers are")
    shape, tiny, steps = (300, 2, 1), torch.finfo(dtype).tiny, 100
    operator = build_operator(shape, (1.0, 1.0, 1.0), diffusion=1.0, dtype=dtype)
    stepper = prepare(operator, 0.02, method)
    one = torch.zeros(1, *shape, dtype=dtype)
    one[0, 0] = 1.0
    other = one
    for _ in range(steps):
        one, other = stepper.step(one), by_kernel(stepper, other)
    least = float(other[other > 0].min())
    assert tiny <= least < 1e3 * tiny
    allowed = steps * roundings(shape) * torch.finfo(dtype).eps
    assert bool(((one - other).abs() <= allowed * one + steps * sum(shape) * tiny).all())


@DTYPES
@pytest.mark.parametrize("dt", [1e-3, 0.7, 4.0])
@pytest.mark.parametrize("shape", [*SHAPES, *LONG], ids=str)
@pytest.mark.parametrize("faces", BOUNDARIES)
@pytest.mark.parametrize("masked", [False, True])
def test_series_is_that_of_torch(dtype, shape, faces, masked, dt):
    """Both add in float64 in one order, but for what passes through periodic faces, and round once
    to the type of the field. float64: two roundings more for each of up to 700 terms."""
    op, mask, _ = operator_of(shape, faces, "varying", masked, dtype=dtype)
    stepper = prepare(op, dt, "series")
    u = torch.rand(1, *shape, dtype=dtype, generator=torch.Generator().manual_seed(1))
    u = u * torch.as_tensor(mask)
    one, other = stepper.step(u), by_kernel(stepper, u)
    allowed = (1400 if dtype == torch.float64 else 1) * torch.finfo(dtype).eps
    assert bool(((one - other).abs() <= allowed * one).all())


@DTYPES
@pytest.mark.parametrize("dt", [0.8, 0.9, 0.99])
def test_a_long_series_loses_nothing(dtype, dt):
    """λΔt up to nearly the most that is allowed: there the first terms are 0, too."""
    op = build_operator(
        (20, 20, 1), (1.0, 1.0, 1.0), diffusion=240.0, decay=0.0,
        boundary=BoundaryConditions(), colonies=1, dtype=dtype,
    )  # fmt: skip
    stepper = prepare(op, dt, "series")
    assert float(stepper.weights[0, 0]) == 0.0, "the first term should be 0"
    u = torch.rand(1, 20, 20, 1, dtype=dtype, generator=torch.Generator().manual_seed(1))
    one, other = stepper.step(u), by_kernel(stepper, u)
    # up to 1,200 terms, each added with one rounding in float64
    allowed = (2400 if dtype == torch.float64 else 1) * torch.finfo(dtype).eps
    assert bool(((one - other).abs() <= allowed * one).all())
    lost = 1.0 - float(other.double().sum() / u.double().sum())
    assert abs(lost) < (1e-12 if dtype == torch.float64 else 1e-7)


@DTYPES
@pytest.mark.parametrize("shape", [(12, 9, 1), (7, 6, 5)], ids=str)
@pytest.mark.parametrize("faces", BOUNDARIES)
@pytest.mark.parametrize("kind", FLOWS)
@pytest.mark.parametrize("masked", [False, True])
def test_a_solve_is_that_of_torch(dtype, shape, faces, kind, masked):
    """Steps too long for a series, with conjugate gradients and with BiCGStab. Both leave 1e-10 of
    the norm of the right-hand side, and then add it; the inverse makes it no larger."""
    op, mask, _ = operator_of(shape, faces, kind, masked, dtype=dtype)
    dt = 3.0 * MOST / float(op.loss.max())
    stepper = prepare(op, dt, "series")
    assert bool(stepper.far.all()) and op.symmetric == (kind == "still")
    u = torch.rand(1, *shape, dtype=dtype, generator=torch.Generator().manual_seed(1))
    u = u * torch.as_tensor(mask)
    one, other = stepper.step(u), by_kernel(stepper, u)
    assert float(other.min()) >= 0 and bool((other[0][~torch.as_tensor(mask).bool()] == 0).all())
    allowed = 4e-10 * float((u.double() + dt * op.gain).norm())
    allowed += torch.finfo(dtype).eps * float(one.max())
    assert float((one - other).abs().max()) <= allowed


@pytest.mark.parametrize("kind", ["still", "uniform"])
def test_a_solve_of_next_to_nothing_is_that_of_more(kind):
    """Squares of what is left may lie below all numbers. It is solved for as if it were more, and
    all of the solution is that of less again, also its last correction by the residual."""
    op, *_ = operator_of((7, 6, 5), "closed", kind, source=None)
    stepper = prepare(op, 3.0 * MOST / float(op.loss.max()), "series")
    assert bool(stepper.far.all())
    u = torch.rand(1, 7, 6, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for run in (stepper.step, lambda x: by_kernel(stepper, x)):
        much, less = run(u), run(u * 2.0**-500) * 2.0**500
        assert float((much - less).abs().max()) <= 4e-10 * float(u.norm())


def test_a_solve_that_fails_is_its_own_colonys():
    op = build_operator((4, 3, 1), (1.0,) * 3, diffusion=1e4, colonies=2, dtype=torch.float64)
    stepper, u = prepare(op, 1.0, "series"), torch.ones(2, 4, 3, 1, dtype=torch.float64)
    u[1, 0, 0, 0] = torch.nan
    found = by_kernel(stepper, u)
    assert torch.allclose(found[0], u[0]) and bool(found[1].isnan().all())


def colonies(count: int, dtype, own: bool, method: str):
    """Carriers and values of colonies with grids of three shapes, in a fixed mixture."""
    generator = torch.Generator().manual_seed(3)
    shapes = [[(7, 6, 5), (33, 1, 4), (5, 19, 1)][k % 3] for k in range(count)]
    diffusion = 10.0 ** torch.empty(count).uniform_(-2, 2, generator=generator)
    diffusion[3] = 1e4
    values = [torch.rand(a * b * c, dtype=dtype, generator=generator) for a, b, c in shapes]

    def after(places: list[int]) -> list[torch.Tensor]:
        grid = grid_of(*[shapes[k] for k in places])
        carriers = []
        for batch in grid.batches:
            ids = [places[k] for k in batch.colonies.tolist()]
            op = build_operator(
                batch.shape,
                (1.0, 1.0, 1.0),
                diffusion=diffusion[ids] if own else 2.0,
                decay=0.1,
                source=0.3,
                boundary=BoundaryConditions(y=Periodic()),
                colonies=len(ids),
                dtype=dtype,
            )
            carriers.append(Carrier(prepare(op, 0.5, method), batch.shape))
            assert carriers[-1].compiled is not None
        found = torch.cat([values[k] for k in places])
        for _ in range(3):
            found = carry(grid, carriers, found)
        return list(found.split([values[k].numel() for k in places]))

    return after


@DTYPES
@pytest.mark.parametrize("own", [False, True], ids=["shared", "each its own"])
@pytest.mark.parametrize("method", sorted(COMPILED))
def test_the_bits_of_a_colony_depend_on_no_other(method, dtype, own, monkeypatch):
    """Alone, among others in any order, on one thread and on three; one is too fast for a
    series."""
    after = colonies(9, dtype, own, method)
    together = after(list(range(9)))
    turned = after(list(range(8, -1, -1)))[::-1]
    monkeypatch.setattr("torchfilm.tools.threads.WORTH_WAKING", 0.0)
    monkeypatch.setattr("torchfilm.tools.threads.available", lambda: 3)
    shared = after(list(range(9)))
    for k in range(9):
        (alone,) = after([k])
        for other in (together[k], turned[k], shared[k]):
            assert torch.equal(alone, other)


def scene(**options) -> tf.Scene:
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=20.0, initial=lambda at: (at[:, 0] > 2.0).double(), source=0.1),
        box=((-16, -16), (16, 16)),
        spacing=4.0,
        **options,
    )
    return tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), medium)


def fields(made: tf.Scene) -> torch.Tensor:
    state = made.bind(3).start()
    for _ in range(4):
        state = made.bind(3).step(state, 0.1)
    return state.signals["ahl"]


def test_binding_chooses_and_explain_says_it(monkeypatch):
    """backend="torch" forces torch, which then runs: its steps are called, and only its."""
    plain = fields(scene())
    assert "compiled; by torch where gradients by its numbers are required" in tf.explain(
        scene(), seconds=0
    )
    assert "1), torch; dt·K/h²" not in tf.explain(scene(), seconds=0)
    told = tf.explain(scene(backend="torch"), seconds=0)
    assert "everywhere), torch; dt·K/h²" in " ".join(told.split())
    torch.testing.assert_close(fields(scene(backend="torch")), plain, rtol=1e-5, atol=0)

    def called(*_):
        raise RuntimeError("by torch")

    monkeypatch.setattr("torchfilm.signals.transport_exponential.Exponential.step", called)
    assert torch.equal(fields(scene()), plain)
    with pytest.raises(RuntimeError, match="by torch"):
        fields(scene(backend="torch"))


def test_a_kernel_that_cannot_be_had_is_refused(monkeypatch):
    with pytest.raises(InputError, match=r"Medium\.backend"):
        scene(backend="numba")
    monkeypatch.setattr("torchfilm.tools.backends.unavailable", lambda: "there is no Numba")
    with pytest.raises(InputError, match=r"compiled.*there is no Numba"):
        scene(backend="compiled").bind()
    assert scene().bind() is not None


def test_gradients_go_through_torch():
    diffusion = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    op = build_operator((4, 3, 1), (1.0, 1.0, 1.0), diffusion=diffusion, dtype=torch.float64)
    carrier = Carrier(prepare(op, 0.5, "exponential"), (4, 3, 1))
    assert carrier.compiled is None
    values = torch.arange(12, dtype=torch.float64)
    carry(grid_of((4, 3, 1)), [carrier], values)[0].backward()
    assert float(diffusion.grad) > 0


@DTYPES
@pytest.mark.parametrize("faces", BOUNDARIES)
@pytest.mark.parametrize("method", sorted(COMPILED))
def test_the_gradient_by_kernels_is_that_of_torch(dtype, faces, method):
    for shape in ((12, 9, 1), (7, 6, 5), (5, 1, 1)):
        op, *_ = operator_of(shape, faces, FLOWS[1], dtype=dtype)
        stepper = prepare(op, 0.7, method)
        draw = torch.Generator().manual_seed(3)
        u, weight = (torch.rand(2, *shape, dtype=dtype, generator=draw) for _ in range(2))
        u.requires_grad_()
        found = by_kernel(stepper, u)
        assert torch.equal(found, by_kernel(stepper, u.detach()))
        assert "_Carried" in type(found.grad_fn.next_functions[0][0]).__name__
        one, other = (
            torch.autograd.grad((x.square() * weight).sum(), u, create_graph=True)[0]
            for x in (found, stepper.step(u))
        )
        allowed = 3 * roundings(shape) * torch.finfo(dtype).eps * float(other.detach().max())
        assert torch.allclose(one, other, rtol=0.0, atol=allowed)
        again = [torch.autograd.grad(x.square().sum(), u)[0] for x in (one, other)]
        allowed = 9 * roundings(shape) * torch.finfo(dtype).eps * float(again[1].max())
        assert torch.allclose(*again, rtol=0.0, atol=allowed)


def test_gradients_pass_several_grids_and_a_tangent_beside_goes_by_torch():
    shapes, weight = ((4, 3, 2), (6, 1, 1)), torch.linspace(0.5, 2.0, 30, dtype=torch.float64)
    steppers = [prepare(operator_of(x, "mixed", FLOWS[1])[0], 0.7) for x in shapes]
    grid, draw = grid_of(*shapes), torch.Generator().manual_seed(3)
    values = torch.rand(30, dtype=torch.float64, generator=draw).requires_grad_()
    slopes = []
    for compiled in (True, False):
        carriers = [Carrier(x, y, compiled) for x, y in zip(steppers, shapes, strict=True)]
        carried = carry(grid, carriers, values)
        slopes.append(torch.autograd.grad((carried * weight).sum(), values)[0])
    assert torch.allclose(*slopes, rtol=1e-12) and float(slopes[0].min()) > 0
    carriers = [Carrier(x, y) for x, y in zip(steppers, shapes, strict=True)]
    with forward_mode():
        carried = carry(grid, carriers, with_tangent(values, torch.ones_like(values)))
        back = torch.autograd.grad((carried * weight).sum(), values)[0]
        assert torch.allclose(back, slopes[1], rtol=1e-12)
        assert float(tangent(carried).detach().min()) > 0


def of_colonies(diffusion, boundary, dtype=torch.float64):
    return build_operator(
        (6, 5, 1), (1.0, 1.0, 1.0), diffusion=torch.tensor(diffusion, dtype=torch.float64),
        velocity=(2.0, 0.5, 0.0), decay=0.1, boundary=boundary, colonies=len(diffusion),
        dtype=dtype,
    )  # fmt: skip


@pytest.mark.parametrize("faces", BOUNDARIES)
def test_gradients_through_steps_that_are_solved(faces):
    op = of_colonies([1e4, 1.0, 3e4], BOUNDARIES[faces])
    stepper = prepare(op, 1.0, "series")
    assert stepper.far.tolist() == [True, False, True]
    draw = torch.Generator().manual_seed(1)
    u, weight = torch.randn(2, 3, 6, 5, 1, dtype=torch.float64, generator=draw)
    u = u.abs().requires_grad_()
    slopes = [
        torch.autograd.grad((f(u) * weight).sum(), u)[0]
        for f in (lambda u: by_kernel(stepper, u), stepper.step)
    ]
    assert torch.allclose(*slopes, rtol=1e-7, atol=1e-9) and float(slopes[0].abs().max()) > 0
    (slope,) = torch.autograd.grad(by_kernel(stepper, u).square().sum(), u)
    with pytest.raises(RuntimeError, match="no second derivatives through a solve of transport"):
        torch.autograd.grad(by_kernel(stepper, u).square().sum(), u, create_graph=True)
    assert slope.shape == u.shape


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_a_colony_have_the_same_bits_beside_one_that_is_solved(dtype):
    draw = torch.Generator().manual_seed(1)
    values = torch.rand(30, dtype=dtype, generator=draw)

    def found(*diffusion):
        op = of_colonies(diffusion, BOUNDARIES["periodic"], dtype)
        u = values.repeat(len(diffusion)).requires_grad_()
        carrier = Carrier(prepare(op, 0.7, "series"), (6, 5, 1))
        out = carry(grid_of(*[(6, 5, 1)] * len(diffusion)), [carrier], u)[:30]
        return out.detach(), torch.autograd.grad(out.square().sum(), u)[0][:30]

    alone, beside = found(3.0), found(3.0, 1e5)
    assert all(torch.equal(a, b) for a, b in zip(alone, beside, strict=True))


def test_a_colony_that_does_not_diffuse_beside_others():
    """What reaches the other end of a periodic axis is that of each colony; so are sources, and a
    colony in which nothing moves at all stays as it is."""
    for method in ("series", "exponential"):
        op = build_operator(
            (6, 5, 1), (1.0, 1.0, 1.0), diffusion=torch.tensor([0.0, 20.0, 3e4, 2e4]), decay=0.0,
            boundary=BoundaryConditions(x=Periodic(), y=Periodic()), colonies=4,
            source=torch.tensor([0.0, 1.0, 2.0, 5.0]), dtype=torch.float64,
        )  # fmt: skip
        if method == "exponential":
            op = build_operator(
                (6, 5, 1), (1.0, 1.0, 1.0), diffusion=torch.tensor([0.0, 20.0]), colonies=2,
                source=torch.tensor([0.0, 1.0]), dtype=torch.float64,
            )  # fmt: skip
        u = torch.rand(op.colonies, 6, 5, 1, dtype=torch.float64, generator=torch.Generator())
        stepper = prepare(op, 0.7, method)
        ours, theirs = by_kernel(stepper, u), stepper.step(u)
        assert torch.allclose(ours, theirs, rtol=1e-9)
        assert torch.allclose(ours[0], u[0], rtol=1e-14)
        gained = (ours - u).sum((1, 2, 3)) / (0.7 * 30)
        assert gained.tolist() == pytest.approx([0.0, 1.0, 2.0, 5.0][: len(gained)], rel=1e-9)


def test_tangents_of_what_comes_back_are_carried_and_mixtures_refused():
    """Forward over reverse through an affine step was 0 by kernels; and of a solve that carries
    tangents the gradient was."""
    op = of_colonies([3.0, 5.0], BOUNDARIES["periodic"])
    u = torch.rand(2, 6, 5, 1, dtype=torch.float64).requires_grad_()
    found = []
    for step in (
        lambda x: by_kernel(prepare(op, 0.7, "series"), x),
        prepare(op, 0.7, "series").step,
    ):
        with forward_mode():
            factor = with_tangent(*torch.tensor([2.0, 1.0], dtype=torch.float64).unbind())
            (slope,) = torch.autograd.grad(factor * (step(u) ** 2).sum(), u)
            found.append((slope.detach(), tangent(slope).detach()))
    assert all(torch.allclose(a, b, rtol=1e-12) for a, b in zip(*found, strict=True))
    assert float(found[0][1].abs().max()) > 0
    far = prepare(of_colonies([1e4, 3e4], BOUNDARIES["closed"]), 1.0, "series")
    with forward_mode():
        factor = with_tangent(*torch.tensor([2.0, 1.0], dtype=torch.float64).unbind())
        with pytest.raises(RuntimeError, match="no second derivatives through a solve"):
            torch.autograd.grad(factor * (far.step(u) ** 2).sum(), u)
        decay = torch.tensor(0.1, dtype=torch.float64).requires_grad_()
        both = with_tangent(decay, torch.ones_like(decay))
        mixed = build_operator(
            (6, 5, 1), (1.0, 1.0, 1.0), diffusion=1e4, decay=both, colonies=2, dtype=torch.float64
        )
        with pytest.raises(RuntimeError, match="passes tangents or gradients, and here both"):
            prepare(mixed, 1.0, "series").step(u)


def test_a_gradient_whose_solve_does_not_converge_is_no_number(monkeypatch):
    """Of that colony alone."""
    far = prepare(of_colonies([1e4, 3e4], BOUNDARIES["closed"]), 1.0, "series", compiled=False)
    u = torch.rand(2, 6, 5, 1, dtype=torch.float64).requires_grad_()
    loss = (far.step(u) ** 2).sum()
    solved = Unsplit._solved

    def one_fails(*given, **more):
        found, good = solved(*given, **more)
        return found, good & torch.tensor([True, False])

    monkeypatch.setattr(Unsplit, "_solved", one_fails)
    (slope,) = torch.autograd.grad(loss, u)
    assert bool(slope[0].isfinite().all()) and bool(slope[1].isnan().all())
