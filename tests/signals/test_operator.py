"""The spatial operator against a matrix assembled face by face, and its conservation laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchfilm.signals.boundary_conditions import (
    BoundaryConditions,
    Dirichlet,
    NoFlux,
    Open,
    Periodic,
)
from torchfilm.signals.transport_operator import Operator, apply, mean
from torchfilm.signals.transport_rates import build_operator, fitted_rates
from torchfilm.tools.checks import InputError

SPACING = (1.0, 2.0, 1.5)
BOUNDARIES = {
    "closed": BoundaryConditions(),
    "periodic": BoundaryConditions(Periodic(), Periodic(), Periodic()),
    "mixed": BoundaryConditions(
        x=(Dirichlet(2.0), Open(0.5)), y=Periodic(), z=(NoFlux(), Dirichlet(1.0))
    ),
    "open": BoundaryConditions(
        x=(Open(0.7), Open()), y=(Open(0.2), NoFlux()), z=(Open(), Open(0.3))
    ),
}
SHAPES = [(5, 4, 3), (6, 1, 1), (2, 3, 1), (1, 1, 1), (4, 2, 2)]
FLOWS = ["still", "uniform", "varying"]


def bernoulli(x: float) -> float:
    """x/(eˣ − 1) in another form: e^(−x/2)·(x/2)/sinh(x/2)."""
    if x == 0:
        return 1.0
    if abs(x) > 600:
        return max(-x, 0.0)
    return math.exp(-x / 2) * (x / 2) / math.sinh(x / 2)


def flux_parts(k: float, v: float, h: float) -> tuple[float, float]:
    """The flux through a face, up and down, per unit of concentration.

    Scharfetter and Gummel, or upwind without diffusion.
    """
    if k == 0:
        return max(v, 0.0), max(-v, 0.0)
    return k / h * bernoulli(-v * h / k), k / h * bernoulli(v * h / k)


def assembled(
    shape, spacing, diffusion, decay, velocity, faces, mask, source
) -> tuple[np.ndarray, np.ndarray]:
    """T and q of du/dt = T u + q, (V, V) and (V,), voxel by voxel and face by face. velocity: three
    arrays on faces."""
    number = np.arange(math.prod(shape)).reshape(shape)
    matrix, gain = np.zeros((number.size,) * 2), np.zeros(number.size)
    for place in np.ndindex(*shape):
        if not mask[place]:
            continue
        i = number[place]
        matrix[i, i] -= decay
        gain[i] += source
        for axis in range(3):
            h = spacing[axis]
            for side in (0, 1):
                face = faces.pairs[axis][side]
                v = velocity[axis][
                    tuple(p + (side if k == axis else 0) for k, p in enumerate(place))
                ]
                other = list(place)
                other[axis] += 1 if side else -1
                edge = not 0 <= other[axis] < shape[axis]
                if edge and isinstance(face, Periodic):
                    other[axis] %= shape[axis]
                    edge = False
                if not edge:
                    if mask[tuple(other)]:
                        up, down = flux_parts(diffusion, v, h)
                        out, back = (up, down) if side else (down, up)
                        matrix[i, i] -= out / h
                        matrix[i, number[tuple(other)]] += back / h
                    continue
                if isinstance(face, Dirichlet):
                    up, down = flux_parts(diffusion, v, h / 2)
                    value = face.value
                elif isinstance(face, Open):
                    up, down = max(v, 0.0), max(-v, 0.0)
                    value = face.outside
                else:
                    continue
                out, back = (up, down) if side else (down, up)
                matrix[i, i] -= out / h
                gain[i] += back / h * value
    return matrix, gain


def flow(kind: str, shape, rng) -> tuple[object, list[np.ndarray]]:
    """A velocity as `build_operator` takes it, and on faces."""
    faces = [tuple(n + (k == axis) for k, n in enumerate(shape)) for axis in range(3)]
    if kind == "varying":
        arrays = [3 * rng.normal(size=s) for s in faces]
        for axis, a in enumerate(arrays):  # the two ends of a periodic axis are one face
            np.moveaxis(a, axis, 0)[-1] = np.moveaxis(a, axis, 0)[0]
        return tuple(torch.as_tensor(a) for a in arrays), arrays
    v = (3.0, -1.0, 0.5) if kind == "uniform" else (0.0, 0.0, 0.0)
    return (v if kind == "uniform" else None), [
        np.full(s, x) for s, x in zip(faces, v, strict=True)
    ]


def operator_of(
    shape, faces="mixed", kind="uniform", masked=False, diffusion=1.3, decay=0.2, source=0.3,
    dtype=torch.float64, device="cpu", seed=0,
):  # fmt: skip
    """An operator, its mask, and the velocities at its faces."""
    rng = np.random.default_rng(seed)
    velocity, arrays = flow(kind, shape, rng)
    mask = rng.uniform(size=shape) < 0.7 if masked else np.ones(shape, dtype=bool)
    if isinstance(velocity, tuple) and isinstance(velocity[0], torch.Tensor):
        velocity = tuple(v.to(device) for v in velocity)
    made = build_operator(
        shape,
        SPACING,
        diffusion=diffusion,
        decay=decay,
        velocity=velocity,
        boundary=BOUNDARIES[faces],
        source=source,
        dtype=dtype,
        device=device,
        mask=torch.as_tensor(mask, device=device) if masked else None,
    )
    return made, mask, arrays


def make(
    shape,
    faces="mixed",
    kind="uniform",
    masked=False,
    diffusion=1.3,
    decay=0.2,
    source=0.3,
    **other,
):
    """An operator, with its matrix and gain from `assembled`."""
    made, mask, arrays = operator_of(shape, faces, kind, masked, diffusion, decay, source, **other)
    chosen = BOUNDARIES[faces]
    return made, *assembled(shape, SPACING, diffusion, decay, arrays, chosen, mask, source), mask


def dense(op: Operator) -> np.ndarray:
    """The matrix of `apply`, (V, V), column by column."""
    count = math.prod(op.shape)
    units = torch.eye(count, dtype=torch.float64, device=op.device).reshape(count, 1, *op.shape)
    return np.stack([apply(op, e, gain=False).cpu().numpy().reshape(-1) for e in units], 1)


EVERY = [
    pytest.mark.parametrize("shape", SHAPES, ids=str),
    pytest.mark.parametrize("faces", BOUNDARIES),
    pytest.mark.parametrize("kind", FLOWS),
]


def every(test):
    for mark in EVERY:
        test = mark(test)
    return test


@every
@pytest.mark.parametrize("masked", [False, True], ids=["", "obstacles"])
def test_the_operator_is_the_assembled_matrix(device, dtype, shape, faces, kind, masked):
    """Rates up to 10/h, a dozen terms: 1e-13 in float64; float32 to 1e-5."""
    op, matrix, gain, mask = make(shape, faces, kind, masked, dtype=dtype, device=device)
    u = np.random.default_rng(1).uniform(size=shape) * mask
    found = apply(op, torch.as_tensor(u, dtype=dtype, device=device)[None])
    assert found.dtype == dtype
    expected = (matrix @ u.reshape(-1) + gain).reshape(shape)
    assert np.abs(found[0].cpu().double().numpy() - expected).max() <= (
        1e-13 if dtype == torch.float64 else 1e-5
    )
    assert np.abs(dense(op) - matrix).max() <= 1e-13
    assert (
        np.abs(op.loss.expand(1, *shape).cpu().numpy().reshape(-1) + np.diag(matrix)).max() <= 1e-13
    )
    given = (
        np.zeros_like(gain)
        if op.gain is None
        else op.gain.expand(1, *shape).cpu().numpy().reshape(-1)
    )
    assert np.abs(given - gain).max() <= 1e-13


def convolve(operator, u):
    """du/dt as `apply` gives it, by conv3d with a stencil of 3 × 3 × 3: the paper's equation 7.

    It requires uniform rates.
    """
    assert operator.interior is not None
    kernel = torch.zeros(operator.colonies, 1, 3, 3, 3, dtype=torch.float64, device=u.device)
    inside = u if operator.mask is None else u * operator.mask
    padded = inside
    for axis, (up, down) in enumerate(operator.interior):
        for side, rate in ((0, up), (2, down)):
            place = [1, 1, 1]
            place[axis] = side
            weight = torch.zeros(3, 3, 3, dtype=torch.float64, device=u.device)
            weight[tuple(place)] = 1.0
            kernel = kernel + rate.reshape(-1, 1, 1, 1, 1) * weight
        dim, own_neighbour = axis + 1, operator.axes[axis].own_neighbour
        edge = padded.narrow(dim, -1, 1), padded.narrow(dim, 0, 1)
        if not operator.axes[axis].periodic or own_neighbour:
            edge = torch.zeros_like(edge[0]), torch.zeros_like(edge[1])
        padded = torch.cat([edge[0], padded, edge[1]], dim)
    out = torch.conv3d(padded.unsqueeze(0), kernel.to(u.dtype), groups=operator.colonies).squeeze(0)
    if operator.mask is not None:
        out = out * operator.mask
    out = out - operator.loss.to(u.dtype) * u
    return out if operator.gain is None else out + operator.gain.to(u.dtype)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("faces", BOUNDARIES)
@pytest.mark.parametrize("kind", FLOWS[:2])
@pytest.mark.parametrize("masked", [False, True], ids=["", "obstacles"])
def test_the_papers_convolution_gives_the_same(device, dtype, shape, faces, kind, masked):
    """Equation 7 as a 3 × 3 × 3 stencil: to rounding, as above."""
    op, _, _, mask = make(shape, faces, kind, masked, dtype=dtype, device=device)
    u = torch.as_tensor(
        np.random.default_rng(1).uniform(size=shape) * mask, dtype=dtype, device=device
    )[None]
    assert float((convolve(op, u) - apply(op, u)).abs().max()) <= (
        1e-13 if dtype == torch.float64 else 2e-5
    )


@every
def test_no_entry_off_the_diagonal_is_negative_and_columns_lose_what_leaves(shape, faces, kind):
    """An M-matrix is positive; where nothing leaves the box, columns sum to minus the decay."""
    matrix = dense(make(shape, faces, kind, decay=0.2)[0])
    off = matrix - np.diag(np.diag(matrix))
    assert off.min() >= 0
    columns = matrix.sum(0) + 0.2
    assert columns.max() <= 1e-13
    if faces in ("closed", "periodic"):
        assert np.abs(columns).max() <= 1e-13


def test_symmetric_is_said_only_of_what_is():
    for kind in FLOWS:
        op, matrix, _, _ = make((5, 4, 3), kind=kind)
        assert op.symmetric == (np.abs(matrix - matrix.T).max() <= 1e-13)
        assert op.separable == (kind != "varying")
    assert not make((5, 4, 3), masked=True)[0].separable


@pytest.mark.parametrize("diffusion", [0.0, 1e-12, 1e-3, 1.0, 1e6])
@pytest.mark.parametrize("speed", [0.0, 1e-12, 1e-5, 0.05, 0.0999, 0.1001, 3.0, 79.0, 81.0, 1e4])
def test_fitted_rates(diffusion, speed):
    """Against the plain formula in another form, to 1e-13 of the larger rate.

    Rounding leaves no more of the smaller rate.
    """
    for sign in (1, -1):
        up, down = (
            float(x)
            for x in fitted_rates(
                torch.tensor(diffusion, dtype=torch.float64),
                torch.tensor(sign * speed, dtype=torch.float64),
            )
        )
        expected = flux_parts(diffusion, sign * speed, 1.0)
        assert up == pytest.approx(
            expected[0], abs=1e-13 * max(expected)
        ) and down == pytest.approx(expected[1], abs=1e-13 * max(expected))
        assert min(up, down) >= 0
        assert up - down == pytest.approx(sign * speed, abs=1e-13 * max(expected))


@pytest.mark.parametrize("speed", [0.0, 1e-4, -0.0999, 0.1001, 2.0, -30.0])
def test_the_slope_of_fitted_rates(speed):
    """By diffusion and flow, by central differences in float64, also at zero flow.

    There the parts of the formula have kinks but the rates do not.
    """
    d, v = (
        torch.tensor(1.3, dtype=torch.float64, requires_grad=True),
        torch.tensor(1.3 * speed, dtype=torch.float64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(fitted_rates, (d, v), eps=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    "diffusion, speed", [(0.0, 0.0), (0.0, 1.0), (1e-30, 1.0), (1e-30, 0.0), (1.0, 1e30)]
)
def test_no_slope_is_nan(diffusion, speed):
    d, v = (
        torch.tensor(diffusion, dtype=torch.float64, requires_grad=True),
        torch.tensor(speed, dtype=torch.float64, requires_grad=True),
    )
    up, down = fitted_rates(d, v)
    grads = torch.autograd.grad(up + 2 * down, (d, v))
    assert all(bool(torch.isfinite(g)) for g in grads)


def test_each_colony_has_its_own_numbers(device, dtype):
    """Diffusion, decay, velocity, faces, obstacles and source per colony: bitwise as each colony
    alone.
    """
    rng, shape = np.random.default_rng(3), (5, 4, 3)
    t = lambda *s: torch.as_tensor(rng.uniform(0.1, 2, s), device=device)
    diffusion, decay, velocity, fixed, outside, source = (
        t(3),
        t(3),
        t(3, 3),
        t(3),
        t(3),
        t(3, *shape),
    )
    mask = torch.as_tensor(rng.uniform(size=(3, *shape)) < 0.8, device=device)
    u = t(3, *shape).to(dtype)

    def of(k):
        return build_operator(
            shape,
            SPACING,
            diffusion=diffusion[k],
            decay=decay[k],
            velocity=velocity[k],
            mask=mask[k],
            source=source[k],
            boundary=BoundaryConditions(
                x=(Dirichlet(fixed[k]), NoFlux()), y=(Open(outside[k]), Open())
            ),
            colonies=len(u[k]),
            dtype=dtype,
            device=device,
        )

    together = apply(of(slice(0, 3)), u)
    for k in range(3):
        own = slice(k, k + 1)
        assert torch.equal(apply(of(own), u[own]), together[own])


@pytest.mark.parametrize(
    "change, name",
    [
        ({"diffusion": -1.0}, "diffusion"),
        ({"diffusion": float("nan")}, "diffusion"),
        ({"diffusion": [1.0, 2.0, 3.0]}, "diffusion"),
        ({"decay": -0.1}, "decay"),
        ({"decay": torch.tensor([0.1, -0.1])}, r"decay\[1\]"),
        ({"velocity": (1.0, 2.0)}, "velocity"),
        ({"velocity": (1.0, 2.0, float("inf"))}, "velocity"),
        ({"velocity": torch.zeros(3, 3)}, "velocity"),
        (
            {"velocity": (torch.zeros(5, 4, 3), torch.zeros(4, 5, 3), torch.zeros(4, 4, 3))},
            "velocity along z",
        ),
        ({"mask": torch.ones(4, 4, 3)}, "mask"),
        ({"mask": torch.ones(4, 4, 2, dtype=torch.bool)}, "mask"),
        ({"source": torch.ones(4, 4, 2)}, "source"),
        ({"source": torch.full((4, 4, 3), torch.inf)}, "source"),
        (
            {
                "boundary": BoundaryConditions(
                    x=(Dirichlet(torch.tensor([1.0, 2.0, 3.0])), NoFlux())
                )
            },
            "at a face along x",
        ),
        ({"shape": (4, 4)}, "shape"),
        ({"shape": (4, 0, 4)}, "shape"),
        ({"spacing": (1.0, -1.0, 1.0)}, "spacing"),
    ],
)
def test_what_is_not_allowed_is_refused(change, name):
    given = {"shape": (4, 4, 3), "spacing": SPACING, "diffusion": 1.0, "colonies": 2} | change
    with pytest.raises(InputError, match=name):
        build_operator(given.pop("shape"), given.pop("spacing"), **given)


def test_one_periodic_face_has_one_velocity():
    velocity = (
        torch.arange(5.0).reshape(5, 1, 1).expand(5, 4, 3),
        torch.zeros(4, 5, 3),
        torch.zeros(4, 4, 4),
    )
    with pytest.raises(InputError, match="velocity along x"):
        build_operator(
            (4, 4, 3),
            SPACING,
            diffusion=1.0,
            velocity=velocity,
            boundary=BoundaryConditions(x=Periodic()),
        )


@pytest.mark.parametrize(
    ("kinds", "masked"),
    [
        (("uniform", "still"), False),
        (("uniform", "still"), True),
        (("uniform", "varying"), False),
        (("varying", "varying"), True),
    ],
)
@pytest.mark.parametrize("faces", [("mixed", "mixed"), ("open", "closed")])
def test_a_mean_operator_has_the_mean_rates(faces, kinds, masked):
    """Of values whatever they are, with what enters through faces; and where no source is."""
    shape = (5, 4, 3)
    one, other = (
        operator_of(shape, face, kind, masked, source=source)[0]
        for face, kind, source in zip(faces, kinds, (0.3, None), strict=True)
    )
    made = mean([(0.25, one), (0.75, other)])
    u = torch.rand(2, *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for gain in (False, True):
        expected = 0.25 * apply(one, u, gain=gain) + 0.75 * apply(other, u, gain=gain)
        torch.testing.assert_close(apply(made, u, gain=gain), expected, rtol=1e-13, atol=1e-13)
    assert (made.interior is None) == ("varying" in kinds) and not made.symmetric
    if made.interior is not None:  # it is that of the faces between two voxels
        for axis, rates in zip(made.axes, made.interior, strict=True):
            among = axis.up.narrow(axis.dim, 1, 1), axis.down.narrow(axis.dim, 1, 1)
            for found, rate in zip(among, rates, strict=True):
                assert masked or torch.equal(found.flatten()[:1], rate.flatten()[:1])
    assert mean([(1.0, one)]) is one


def test_where_nothing_is_beyond_a_face_the_mean_has_less_enter():
    """As where a flow becomes faster while what it brings begins, within one step: a part without
    anything beyond its faces counts with its share, though it has no value there."""
    shape, u = (5, 4, 3), torch.zeros(1, 5, 4, 3, dtype=torch.float64)
    made = lambda speed, value: build_operator(
        shape, SPACING, diffusion=1.3, velocity=(speed, -speed, 0.0), dtype=torch.float64,
        boundary=BoundaryConditions(x=(Dirichlet(value), Open(value)), y=(Open(), Open(value))),
    )  # fmt: skip
    empty, full = made(3.0, 0.0), made(2.0, 0.7)
    assert empty.axes[0].low is None and full.axes[0].low is not None
    for order in ((empty, full), (full, empty)):
        parts = list(zip((0.25, 0.75), order, strict=True))
        expected = sum(share * apply(op, u) for share, op in parts)
        assert float(expected.max()) > 0.1
        torch.testing.assert_close(apply(mean(parts), u), expected, rtol=1e-13, atol=1e-13)
