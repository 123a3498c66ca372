"""Circuits that take up more than diffusion brings, by a law that saturates at next to nothing."""

from __future__ import annotations

import warnings

import pytest
import torch

import torchfilm as tf
from torchfilm.together import profile
from torchfilm.tools.tangents import forward_mode, tangent, with_tangent

DIFFUSION, OUTSIDE, WIDTH, HEIGHT = 100.0, 1.0, 8.0, 20.0
# Cells hold the concentration in the lowest row of voxels at 0; what comes from the face at the
# top, HEIGHT − spacing/2 above, is all that they can have.
MOST = DIFFUSION * OUTSIDE * WIDTH / (HEIGHT - 0.5)


def eats(u, s, p, cell):
    share = s.o2 / (p.K + s.o2)
    return {"used": p.q * share}, {"o2": -p.q * share * cell.volume}


def scene(K, q, dt, diffusion=DIFFUSION, **options):
    faces = tf.BoundaryConditions(x=tf.Periodic(), y=(tf.NoFlux(), tf.Dirichlet(OUTSIDE)))
    medium = tf.Medium(
        o2=tf.Signal(diffusion=diffusion, initial=OUTSIDE), spacing=1.0, depth=1.0,
        box=((0, 0), (WIDTH, HEIGHT)), boundary=faces, backend=options.get("backend"),
    )  # fmt: skip
    row = tf.Cells([[x, 0.5] for x in (1, 3, 5, 7)], [[1.0, 0.0]] * 4, length=1.0)
    circuit = tf.Circuit(eats, species="used", K=K, q=q, **options)
    return tf.Scene(circuit, medium, dim=2, dt=dt, founders=row)


def uptake(state) -> float:
    return float((state.used.double() * state.volume.double()).sum())


@pytest.mark.parametrize(
    ("K", "q", "dt", "options"),
    [
        (1e-3, 100.0, 0.05, {}),
        (1e-8, 100.0, 0.05, {}),
        (1e-10, 100.0, 0.05, {}),
        (1e-10, 100.0, 0.05, {"atol": 1e-17}),
        (1e-9, 100.0, 0.2, {}),
        (1e-9, 100.0, 0.05, {"backend": "torch"}),
        (1e-7, 1e4, 0.05, {}),
        (1e-2, 1e9, 0.05, {}),
    ],
)
def test_no_more_is_taken_than_diffusion_brings(K, q, dt, options):
    """The steady uptake is D c₀ W/(H − h/2) but for K, however steep the law is. It had been up to
    five times as much: what cells asked for was taken far from them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        seen = [
            uptake(s) for s in tf.simulate(scene(K, q, dt, **options), until=10.0)
            if abs(s.time - 8.0) < 1e-6 or abs(s.time - 10.0) < 1e-6
        ]  # fmt: skip
    assert (seen[1] - seen[0]) / 2.0 == pytest.approx(MOST, rel=2e-3)


def derivatives(K: float, forward: bool) -> list[float]:
    """What two steps take up, times the numbers K, q and D: its derivatives by them."""

    def taken(K, q, D):
        made = scene(K, q, 0.05, D)
        *_, last = tf.simulate(made, made.bind(dtype=torch.float64).start(), until=0.1)
        return (last.used * last.volume).sum()

    at = [torch.tensor(x, dtype=torch.float64) for x in (K, 100.0, DIFFUSION)]
    if not forward:
        numbers = [x.requires_grad_() for x in at]
        found = torch.autograd.grad(taken(*numbers), numbers)
        return [float(x.detach() * y) for x, y in zip(numbers, found, strict=True)]
    found = []
    for k in range(3):
        with forward_mode():
            turned = [with_tangent(x, x) if k == i else x for i, x in enumerate(at)]
            found.append(float(tangent(taken(*turned))))
    return found


@pytest.mark.parametrize("K", [1e-4, 1e-8, 1e-10])
def test_gradients_are_those_of_diffusion(K):
    """By reverse mode as by tangents: that by D of what diffusion brings, and next to none by what
    cells would like. At K = 1e-8 that by q had been −2.5 times what was taken over 25, since the
    adjoint was taken at a field that was off by the residual."""
    back, turned = derivatives(K, False), derivatives(K, True)
    # 12.3 at K = 1e-4 in steps a 32nd as long
    assert back[2] == pytest.approx(turned[2], rel=1e-4) and 11.5 < back[2] < 13.0
    assert back[:2] == pytest.approx(turned[:2], rel=1e-2, abs=1e-4)


def test_a_closed_box_is_not_emptied_faster_than_it_diffuses():
    """Half-saturations far below what is left make no difference to what is eaten, and none to the
    balance."""
    left = []
    for K in (1e-6, 1e-8, 1e-10):
        of = scene(K, 100.0, 0.05)
        closed = tf.Medium(
            o2=tf.Signal(diffusion=10.0, initial=1.0), spacing=1.0, depth=1.0,
            box=((0, 0), (WIDTH, HEIGHT)),
        )  # fmt: skip
        both = tf.Scene(of.effects[0], closed, dim=2, dt=0.05, founders=of.founders)
        *_, last = tf.simulate(both, both.bind(dtype=torch.float64).start(), until=2.0)
        left.append(float(last.signals["o2"].double().sum()))
        start = WIDTH * HEIGHT * OUTSIDE
        assert left[-1] + uptake(last) == pytest.approx(start, rel=1e-12)
    assert left[1:] == pytest.approx([left[0]] * 2, rel=2e-3) and left[0] > 0.6 * start


@pytest.mark.parametrize("K", [1e-7, 1e-9])
def test_cells_that_do_not_eat_excuse_nobody(K):
    """A hundred of them lie above one that eats, whose share is small in sums over the colony."""
    places = [[2.0 + 4.0 * (i % 4), 14.0 + 4.0 * (i // 4)] for i in range(100)]
    cells = tf.Cells(
        [[2.0, 2.0], *places], [[1.0, 0.0]] * 101, length=1.0, cell_type=[0] + [1] * 100
    )
    medium = tf.Medium(
        o2=tf.Signal(diffusion=10.0, initial=1.0), spacing=4.0, depth=4.0,
        box=((0, 0), (16, 116)),
        boundary=tf.BoundaryConditions(x=tf.Periodic(), y=(tf.NoFlux(), tf.Dirichlet(1.0))),
    )  # fmt: skip
    found = []
    for half in (1e-5, K):
        circuit = tf.Circuit(eats, species="used", K=half, q={0: 1000.0, 1: 0.0})
        built = tf.Scene(circuit, medium, dim=2, dt=0.01, founders=cells)
        *_, last = tf.simulate(built, built.bind(dtype=torch.float64).start(), until=1.0)
        found.append(uptake(last))
    assert found[1] == pytest.approx(found[0], rel=1e-3)


def test_what_is_too_steep_to_be_solved_is_said():
    with pytest.warns(RuntimeWarning, match="colony 0: exchange and transport of signals"):
        list(tf.simulate(scene(1e-20, 100.0, 0.05), until=0.1))


def test_scarce_signals_that_cells_cross_linearly_need_no_parts():
    """A signal that has run out is no equation to sharpen where little depends on it."""

    def drinks(u, s, p, cell):
        out = p.D1 * s.o2 * cell.area
        return {"used": out / cell.volume}, {"o2": -out}

    made = tf.Scene(
        tf.Circuit(drinks, species="used", D1=1e4),
        tf.Medium(o2=tf.Signal(diffusion=100.0, initial=1.0), spacing=1.0, depth=1.0,
                  box=((0, 0), (8, 20))),
        dim=2, dt=0.05, founders=tf.Cells([[4.0, 0.5]], [[1.0, 0.0]], length=1.0),
    )  # fmt: skip
    counts = [int(s.reports["circuit"].iterations[0]) for s in tf.simulate(made, until=20.0)]
    assert max(counts[1:]) <= 8


@pytest.mark.parametrize("dt", [0.05, 1 / 3])
def test_a_signal_that_is_used_up_within_a_step_does_not_go_below_0(dt, dtype):
    """The line along which cells find it, by the arithmetic of a circuit's steps: a rate may take
    its root."""
    mean = torch.rand(1000, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    begin, middle, slope = profile(torch.cat([0.0 * mean, mean], 1), dt, dtype)
    close = {"rtol": 1e-5, "atol": 0.0}
    torch.testing.assert_close(begin, 2.0 * mean[:, 0].to(dtype), **close)
    torch.testing.assert_close(middle, mean[:, 0].to(dtype), **close)
    end = begin + slope * dt
    assert bool((end >= 0).all()) and bool((end <= 1e-5 * begin).all())
