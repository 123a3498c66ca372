"""Signals that diffuse fast and are taken from a closed box: the course in time."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import pytest
import torch

import torchfilm as tf
from torchfilm.effect import ExchangePlan
from torchfilm.effects.circuit_words import together_lines
from torchfilm.signals import joint
from torchfilm.tools.ragged import Groups

F64 = torch.float64
FAST, VOXELS = 1.4e6, 8
SIDE = 8.0 * VOXELS / 2


def takes(u, s, p, cell):
    return {"eaten": 0.0 * u.eaten}, {"drug": -p.k * s.drug * cell.volume}


def gives(u, s, p, cell):
    return {"eaten": 0.0 * u.eaten}, {"drug": p.k * cell.volume}


def hungry(k, *, rates=takes, diffusion=FAST, dt=0.05, boundary=None, backend=None) -> tf.Scene:
    faces = {} if boundary is None else {"boundary": boundary}
    box = {"box": ((-SIDE, -SIDE), (SIDE, SIDE)), "spacing": 8.0, "depth": 1.0}
    drug = tf.Signal(diffusion=diffusion, initial=4.0)
    return tf.Scene(
        tf.Circuit(rates, species="eaten", k=k, backend=backend),
        tf.Medium(drug=drug, **box, **faces, backend=backend),
        founders=tf.inoculum(30, radius=20.0, seed=0), dim=2, dt=dt,
    )  # fmt: skip


def rate_of(scene) -> float:
    """That of the whole box, 1/h, for k = 1."""
    first = scene.bind(dtype=F64).start()
    return float(first.volume.sum()) / (2 * SIDE) ** 2


K = 3.0 / rate_of(hungry(1.0))


def left(scene, until=1.0, **options) -> float:
    *_, last = tf.simulate(scene, until=until, dtype=F64, **options)
    return float(last.signals["drug"].mean()) / 4.0


@pytest.mark.parametrize("backend", ["compiled", "torch"])
@pytest.mark.parametrize("dt", [0.025, 0.1])
def test_what_is_left_falls_as_the_exponential(dt, backend):
    """About 1 % too much after each fall by e; by whole steps it would be 12 % and 48 %."""
    found = left(hungry(K, dt=dt, backend=backend))
    assert math.exp(-3.0) < found < 1.035 * math.exp(-3.0)


def test_whole_steps_are_far_off(monkeypatch):
    monkeypatch.setattr(joint, "COARSE", math.inf)
    monkeypatch.setattr(joint, "LATE", math.inf)
    assert left(hungry(K, dt=0.025)) == pytest.approx((1 + 3.0 * 0.025) ** -40, rel=2e-3)


def test_cells_get_what_the_box_loses():
    scene = hungry(K)
    first = scene.bind(dtype=F64).start()
    for state in tf.simulate(scene, first, until=0.5):
        assert float(state.signals["drug"].min()) >= 0.0
    own = state.reports["circuit"]
    assert int(own.iterations.sum()) > 5 and int(own.unsolved.sum()) == 0


def iterations(scene, monkeypatch, coarse, late, until=1.0):
    monkeypatch.setattr(joint, "COARSE", coarse)
    monkeypatch.setattr(joint, "LATE", late)
    *_, last = tf.simulate(scene, until=until, dtype=F64)
    return int(last.reports["circuit"].iterations), last.signals["drug"]


FED = tf.BoundaryConditions(x=tf.Dirichlet(4.0), y=tf.NoFlux())


@pytest.mark.parametrize(
    "given", [{"boundary": FED}, {"rates": gives}, {"diffusion": 1e3}, {"k": 0.05 * K}]
)
def test_no_step_is_halved_without_need(given, monkeypatch):
    """A steady supply, cells that give only, what diffuses so slowly that the series is exact, and
    cells that take little."""
    scene = hungry(**{"k": K, **given})
    limits = (math.inf, math.inf), (joint.COARSE, joint.LATE)
    whole, halved = (iterations(scene, monkeypatch, *x) for x in limits)
    assert whole[0] == halved[0] and torch.equal(whole[1], halved[1])


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_colony_that_needs_no_parts_has_the_same_bits_beside_one_that_does(backend):
    k = torch.tensor([0.05, 1.0, 0.3], dtype=F64) * K
    *_, many = tf.simulate(hungry(k, backend=backend), until=0.3, dtype=F64)
    for number, own in enumerate(k):
        alone = hungry(own.reshape(1), backend=backend)
        *_, one = tf.simulate(alone, until=0.3, dtype=F64, streams=[number])
        mine = many.select([number])
        assert torch.equal(one.signals["drug"], mine.signals["drug"])


def test_gradients_pass_the_parts():
    k = torch.tensor(K, dtype=F64, requires_grad=True)
    slopes = [(left_of(K + off) - left_of(K - off)) / (2 * off) for off in (1e-4 * K,)]
    (found,) = torch.autograd.grad(left_of(k), k)
    assert float(found) == pytest.approx(float(slopes[0]), rel=1e-4)
    assert float(found * K) == pytest.approx(-0.6 * math.exp(-0.6), rel=2e-2)


def left_of(k):
    scene = hungry(k)
    return tf.rollout(scene.bind(dtype=F64), until=0.2).signals["drug"].mean() / 4.0


def test_it_is_explained():
    def lines(times):
        medium = SimpleNamespace(steps=1)
        transport = SimpleNamespace(medium=medium, exchanges_per_hour=lambda name, state: times)
        return together_lines(["drug"], ExchangePlan(transport), 1.0, None)

    words = lines(1e3)[1]
    assert "in parts of a step while cells take over 2 % of it in one, or 4 % leave and" in words
    assert "in parts" not in " ".join(lines(100.0))


@pytest.mark.parametrize("batches", [[[0, 1, 2, 3, 4]], [[1, 3], [0, 2, 4]]])
def test_which_colonies_are_coarse(batches):
    """Those that took backward Euler and took more than 2 % of what there was, in the geometric
    mean with the change; whether that was a fall, or a rise in spite of it; not one with nothing
    to take. Grids may be of several shapes."""
    voxels, volume = 4, 2.0
    owner = torch.arange(5).repeat_interleave(voxels)
    content = lambda values: (
        torch.tensor(values, dtype=F64).repeat_interleave(voxels) / (voxels * volume)
    )
    before, after = content([1.0, 1.0, 1.0, 1.0, 1e-9]), content([0.9, 0.9, 1.1, 0.999, 5e-10])
    taken = torch.tensor([0.1, 0.1, 0.1, 0.1, 5e-10], dtype=F64)
    places = [torch.tensor(k) for k in batches]
    far = torch.tensor([True, False, True, True, True])
    grid = SimpleNamespace(
        owner=owner, voxel_volume=volume, batches=[SimpleNamespace(colonies=k) for k in places]
    )
    given = SimpleNamespace(
        groups=Groups(torch.arange(5), 5, ordered=True), field=before, grid=grid, finest=1e-6,
        fed=torch.ones(5, dtype=torch.bool), _far=[far[k] for k in places],
        _entered=lambda: torch.zeros(5, dtype=F64),
    )  # fmt: skip
    moved = joint.JointMove(after, taken, taken, taken)
    found = joint.JointTransport.coarse(given, moved, -taken)
    assert found.tolist() == [True, False, True, False, False]
    # what decays, or leaves through faces, beside what cells and sources give
    begin, end = content([1.0, 1.0, 1.0, 1.0, 1e-9]), content([0.9, 0.97, 1.1, 1.1, 5e-10])
    entered, gift = torch.zeros(5, dtype=F64), torch.zeros(5, dtype=F64)
    entered[3], gift[2:4] = 0.15, 0.1
    given.field, given._entered, given._far = begin, lambda: entered, [k >= 0 for k in places]
    moved = joint.JointMove(end, 0 * taken, 0 * taken, 0 * taken)
    found = joint.JointTransport.coarse(given, moved, gift)
    assert found.tolist() == [True, False, False, True, False]


FADES = {"decay": 10.0}, {"boundary": tf.BoundaryConditions(z=(tf.Robin(0.0, 10.0), tf.NoFlux()))}


@pytest.mark.parametrize("loss", FADES, ids=["decay", "a face"])
def test_what_leaves_without_cells_falls_as_the_exponential(loss):
    """About 2 % too much after each fall by e; whole steps, as of cells that only give or take a
    little, had 71 % after five."""
    scene = fading(loss)
    assert math.exp(-5.0) < left(scene, until=0.5) < 1.1 * math.exp(-5.0)


def test_whole_steps_of_what_fades_are_far_off(monkeypatch):
    monkeypatch.setattr(joint, "LATE", math.inf)
    assert left(fading(FADES[0]), until=0.5) == pytest.approx(1.25**-20, rel=1e-3)


def fading(loss, rates=takes):
    """A signal that cells hardly take, with a loss of 10/h."""
    drug = tf.Signal(diffusion=FAST, initial=4.0, **loss)
    return tf.Scene(
        tf.Circuit(rates, species="eaten", k=1e-6),
        tf.Medium(drug=drug, box=((-SIDE, -SIDE), (SIDE, SIDE)), spacing=8.0, depth=1.0),
        founders=tf.inoculum(30, radius=20.0, seed=0), dim=2, dt=0.025,
    )  # fmt: skip


def test_a_signal_that_rises_and_falls_with_its_source_follows_it():
    """The content of a closed box with a source that goes on and off, against its equation; by
    whole steps it is up to 12 % off."""
    on = tf.Schedule({0.0: 0.0, 0.1: 40.0, 0.2: 0.0, 0.3: 40.0, 0.4: 0.0})
    scene, exact, worst = fading({"decay": 10.0, "source": on}), 4.0, 0.0
    for state in tf.simulate(scene, until=0.5, dtype=F64):
        begin, share = state.time - 0.025, math.exp(-0.25)
        rest = 4.0 if round(begin * 10, 6) % 2 >= 1 else 0.0
        exact = rest + (exact - rest) * share
        worst = max(worst, abs(float(state.signals["drug"].mean()) / exact - 1.0))
    assert worst < 0.03


@pytest.mark.parametrize("decay", [40.0, 400.0, 4000.0])
def test_a_signal_that_is_late_by_half_a_step_is_so_in_every_step(decay):
    """One that turns over faster than a step follows its cells, which here make 5 % more in each;
    parts of a step in some of them would make it go up by turns of 4 and 6 %."""

    def rising(u, s, p, cell):
        made = 1e7 * p.k * torch.exp(2.0 * u.eaten)
        return {"eaten": 1.0 + 0.0 * u.eaten}, {"drug": made * cell.volume}

    seen = [float(x.signals["drug"].mean()) for x in tf.simulate(
        fading({"decay": decay}, rising), until=1.0, dtype=F64)]  # fmt: skip
    steps = [later / before for before, later in itertools.pairwise(seen[20:])]
    assert max(steps) - min(steps) < 2e-3 and steps[-1] == pytest.approx(math.exp(0.05), abs=2e-3)
