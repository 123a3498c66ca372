"""Faces with a resistance (Robin) and with a given flux, against profiles on paper."""

from __future__ import annotations

import pytest
import torch

import torchfilm as tf
from torchfilm.signals.boundary_conditions import BoundaryConditions, Dirichlet, Flux, NoFlux, Robin
from torchfilm.signals.transport import prepare
from torchfilm.signals.transport_rates import build_operator

K, H, N = 50.0, 2.0, 12
LENGTH = N * H
CENTRES = (torch.arange(N, dtype=torch.float64) + 0.5) * H
CELL = tf.Cells([[6.0, 6.0]], [[1.0, 0.0]])
METHODS = ["exponential", "series", "implicit", "crank_nicolson", "euler"]


def line(low, high, *, method="exponential", dt=1.0, steps=200, speed=0.0, **given) -> torch.Tensor:
    """The signal along x after `steps` of `dt`, h, between two faces."""
    operator = build_operator(
        (N, 1, 1), (H, 1.0, 1.0), diffusion=given.pop("diffusion", K), dtype=torch.float64,
        boundary=BoundaryConditions(x=(low, high)), velocity=(speed, 0.0, 0.0) if speed else None,
        **given,
    )  # fmt: skip
    stepper = prepare(operator, dt, method=method)
    u = torch.zeros(operator.colonies, N, 1, 1, dtype=torch.float64)
    for _ in range(steps):
        u = stepper.step(u)
    return u.reshape(operator.colonies, N)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("ends", [1, -1])
def test_a_layer_in_front_of_a_sink(method, ends):
    """From 2 beyond a layer of 5 µm of the same K to 0 at the far face: a straight line over 29 µm,
    of which the last 24 are in the box, from either end."""
    pair = (Robin(2.0, K / 5.0), Dirichlet(0.0))[::ends]
    found = line(*pair, method=method, dt=0.5, steps=240)
    want = 2.0 * (1 - (5.0 + CENTRES) / (5.0 + LENGTH))
    torch.testing.assert_close(found[0] if ends == 1 else found[0].flip(0), want, rtol=0, atol=1e-8)


@pytest.mark.parametrize("speed", [40.0, -40.0])
def test_a_flow_passes_the_layer_too(speed):
    """As the layer of 5 µm of the same medium would be, in the flow: the profile of the longer
    box."""
    found = line(Robin(2.0, K / 5.0), Dirichlet(0.5), speed=speed)
    at = lambda x: torch.expm1(torch.as_tensor(x * speed / K, dtype=torch.float64))
    want = 2.0 + (0.5 - 2.0) * at(CENTRES + 5.0) / at(LENGTH + 5.0)
    torch.testing.assert_close(found[0], want, rtol=1e-9, atol=0)


def test_transfer_without_diffusion_in_the_box_is_none():
    """Half a voxel in which nothing diffuses lets nothing pass."""
    assert not line(Robin(2.0, 10.0), NoFlux(), diffusion=0.0).any()


def test_much_transfer_is_dirichlet_and_little_fills_slowly():
    fixed = line(Dirichlet(1.0), NoFlux(), decay=3.0)
    torch.testing.assert_close(line(Robin(1.0, 1e9), NoFlux(), decay=3.0), fixed, rtol=1e-6, atol=0)
    # so little that the box is even: it fills as 1 − exp(−t · transfer / length)
    slow = line(Robin(1.0, 0.01), NoFlux(), diffusion=1e7, steps=300)
    want = 1 - torch.exp(torch.tensor(-300 * 0.01 / LENGTH, dtype=torch.float64))
    torch.testing.assert_close(slow, want.expand(1, N), rtol=1e-6, atol=0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("speed", [0.0, 30.0])
def test_what_enters_by_a_flux_is_what_is_there(method, speed):
    """3 per µm² and hour over 4 h, from the low face or the high one, with any flow against it."""
    for pair in [(Flux(3.0), NoFlux()), (NoFlux(), Flux(3.0)), (Flux(1.0), Flux(2.0))]:
        found = line(*pair, method=method, dt=0.1, steps=40, speed=speed)
        assert float(found.sum() * H) == pytest.approx(12.0, rel=1e-10)


@pytest.mark.parametrize("method", ["exponential", "series"])
def test_a_flux_towards_a_sink_is_a_straight_line(method):
    """The slope is −value/K; and with a flow the profile of v s − K s' = value."""
    found = line(Flux(3.0), Dirichlet(0.0), method=method)
    torch.testing.assert_close(found[0], 3.0 / K * (LENGTH - CENTRES), rtol=1e-9, atol=0)
    v = 40.0
    found = line(Flux(3.0), Dirichlet(0.0), method=method, speed=v)
    want = 3.0 / v * -torch.expm1(-(LENGTH - CENTRES) * v / K)
    torch.testing.assert_close(found[0], want, rtol=1e-9, atol=0)


def test_each_colony_its_own_and_an_obstacle_closes_the_face():
    transfer = torch.tensor([K / 5.0, K / 20.0])
    both = line(Robin(torch.tensor([2.0, 1.0]), transfer), Dirichlet(0.0), colonies=2)
    for k, (value, layer) in enumerate([(2.0, 5.0), (1.0, 20.0)]):
        want = value * (1 - (layer + CENTRES) / (layer + LENGTH))
        torch.testing.assert_close(both[k], want, rtol=1e-6, atol=0)
    faces = BoundaryConditions(x=(Robin(2.0, transfer), Flux(torch.tensor([1.0, 2.0]))))
    low, high = faces.take(torch.tensor([1])).pairs[0]
    assert low.transfer.tolist() == [K / 20.0] and high.value.tolist() == [2.0]
    mask = torch.ones(N, 1, 1, dtype=torch.bool)
    mask[0] = False
    closed = line(Flux(3.0), NoFlux(), method="series", mask=mask)
    assert not closed.any()


@pytest.mark.parametrize("method", ["exponential", "series"])
def test_derivatives_by_transfer_and_flux(method):
    def total(transfer, flux):
        faces = Robin(2.0, transfer), Flux(flux)
        return (line(*faces, method=method, dt=0.05, steps=3, speed=20.0) ** 2).sum()

    given = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (8.0, 3.0)]
    assert torch.autograd.gradcheck(total, given)


def scene(boundary, **given) -> tf.Scene:
    medium = tf.Medium(
        food=tf.Signal(diffusion=K, boundary=boundary, **given), box=((0, 0), (24, 12)), spacing=2.0
    )
    return tf.Scene(tf.Growth(rate=0.0), medium, founders=CELL)


def test_in_a_scene_kernels_and_torch_agree_and_a_schedule_holds():
    """A flux that is on for an hour, and a plane of cells on agar: z is a face of a flat box."""
    pulse = tf.Schedule({0: 3.0, 1: 0.0})
    faces = tf.BoundaryConditions(
        x=(tf.Flux(pulse), tf.NoFlux()), z=(tf.Robin(1.0, 0.2), tf.NoFlux())
    )
    ends = {}
    for backend in ("compiled", "torch"):
        medium = tf.Medium(
            food=tf.Signal(diffusion=K, boundary=faces), box=((0, 0), (24, 12)), spacing=2.0,
            backend=backend,
        )  # fmt: skip
        built = tf.Scene(tf.Growth(rate=0.0), medium, founders=CELL)
        *_, ends[backend] = tf.simulate(built, until=3.0, dt=0.05)
    torch.testing.assert_close(
        ends["compiled"].signals["food"], ends["torch"].signals["food"], rtol=1e-5, atol=0
    )
    # the mean: entering through 1 of 12 voxels of 2 µm, and by a layer that is as deep as they are
    rate = 1 / (2.0 / (2 * K) + 1 / 0.2) / 2.0
    t = torch.tensor([1.0, 2.0], dtype=torch.float64)
    fed = (1 + 3.0 / LENGTH / rate) * -torch.expm1(-rate * t[0])
    want = 1 + (fed - 1) * torch.exp(-rate * t[1])
    assert float(ends["compiled"].signals["food"].double().mean()) == pytest.approx(
        float(want), 1e-5
    )


def test_a_signal_that_only_a_flux_supplies_is_not_idle(recwarn):
    scene(tf.BoundaryConditions(x=(tf.Flux(1.0), tf.NoFlux()))).bind()
    assert not [w for w in recwarn if "stays 0" in str(w.message)]


@pytest.mark.parametrize("transfer", [0.0, -1.0, float("nan"), "much", torch.tensor([1.0, 0.0])])
def test_a_transfer_is_above_0(transfer):
    with pytest.raises(tf.InputError, match=r"Robin\.transfer"):
        Robin(1.0, transfer)


def test_transfer_for_other_colonies_is_refused():
    faces = tf.BoundaryConditions(x=tf.Robin(1.0, torch.tensor([1.0, 2.0, 3.0])))
    with pytest.raises(tf.InputError, match="3"):
        scene(faces).bind(colonies=2)
