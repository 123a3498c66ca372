"""Tangents (torch's forward mode) through circuits and media: the compiled form against torch's
own, and against differences of runs whose steps are fixed."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from torch.autograd import forward_ad
from traced import by

import torchfilm as tf
from torchfilm.tools.tangents import both, forward_mode, has_tangent, tangent, tracked

F64 = torch.float64


def moved(value: float, *directions: float) -> torch.Tensor:
    """One value per colony, with a tangent each."""
    of = torch.tensor(directions, dtype=F64)
    return forward_ad.make_dual(torch.full_like(of, value), of)


def replayed(scene: tf.Scene, dtype: torch.dtype = F64, cells: int = 4) -> dict[str, torch.Tensor]:
    """Species and signals of two colonies on the same recorded growth, at the end."""
    model = scene.bind(2, streams=(0, 0), seed=4, dtype=dtype, per_colony=True)
    assert not model.why_not_replayable
    record = tf.GrowthRecording(scene, streams=(0,), seed=4, dt=0.05, dtype=dtype, cells=cells)
    replay = tf.Replay(model, record)
    state = replay.start()
    while int(state.counts.min()) < cells:
        state = replay.step(state)
    circuit = next(effect for effect in scene.effects if isinstance(effect, tf.Circuit))
    wanted = (*circuit.own_fields, *(f"out.{n}" for n in state.signals))
    return {name: state.fields[name] for name in wanted}


SCENES = {
    "boundary_detector": partial(tf.scenes.boundary_detector),
    "quorum_sensing": partial(tf.scenes.quorum_sensing),
}
PARAMETERS = {"boundary_detector": ("k3", "D1"), "quorum_sensing": ("k3", "D1")}


@torch.no_grad()
def of_both_backends(scene, **run) -> tuple[dict, dict]:
    with forward_mode():
        found = [
            {n: both(x) for n, x in replayed(by(backend, scene()), **run).items()}
            for backend in ("compiled", "torch")
        ]
    return found[0], found[1]


@pytest.mark.parametrize(
    ("name", "dtype"), [*((name, F64) for name in SCENES), ("boundary_detector", torch.float32)]
)
def test_compiled_tangents_are_torchs(name, dtype):
    first, second = PARAMETERS[name]
    scene = lambda: SCENES[name](**{first: moved(0.7, 1.0, 0.0), second: moved(3.0, 0.0, 1.0)})
    ours, theirs = of_both_backends(scene, dtype=dtype)
    least = 1e-12 if dtype == F64 else 1e-4
    depend = [one for one, (_, slope) in theirs.items() if float(slope.abs().max()) > 0]
    assert len(depend) >= 3 and "ahl" in depend
    for one, (value, slope) in ours.items():
        other, torchs = theirs[one]
        scale = float(torchs.abs().max())
        assert float((slope - torchs).abs().max()) <= least * scale, one
        assert float((value - other).abs().max()) <= least * float(other.abs().max()), one


def test_tangents_are_differences_of_runs(plain):
    """Of runs with tight tolerances, so that steps differ little."""
    scene = lambda k: tf.scenes.boundary_detector(D1=k, rtol=1e-9)
    with torch.no_grad(), forward_mode():
        found = {n: both(x)[1] for n, x in replayed(scene(moved(0.7, 1.0, 0.0)), cells=6).items()}
    more, less = (
        replayed(scene(torch.full((2,), 0.7 + h, dtype=F64)), cells=6) for h in (1e-4, -1e-4)
    )
    depend = ("ahl", "cfp", "yfp", "out.ahl")
    for name, slope in found.items():
        difference = (more[name] - less[name]) / 2e-4
        half = slope.numel() // 2
        scale = float(slope.abs().max())
        assert (scale > 0) == (name in depend)
        off = float((slope[:half] - difference[:half]).abs().max())
        assert off <= 1e-5 * scale + 1e-12, name
        assert float(slope[half:].abs().max()) == 0, f"{name}: the second colony does not move"


def roots(u, s, p, cell):
    return {"a": p.k - p.k * u.a**0.5 - 40 * u.a * u.b, "b": p.k * u.a - 40 * u.a * u.b}


def one_circuit(part, **circuit) -> tf.Scene:
    cells = tf.Cells([[5.0 * k, 0.0] for k in range(3)], [[1.0, 0.0]] * 3)
    species = circuit.pop("species", ("a", "b"))
    return tf.Scene(tf.Circuit(part, species=species, **circuit), founders=cells, dt=0.2)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_tangents_where_a_step_ends_below_zero(plain, backend):
    """Long steps of a fast circuit end below 0 and are corrected."""

    def end(k):
        scene = one_circuit(roots, rtol=0.1, atol=0.1, k=k, initial={"a": 2.0, "b": 0.5})
        model = by(backend, scene).bind(2, dtype=F64, per_colony=True)
        state = model.start()
        for _ in range(4):
            state = model.step(state, 0.3)
        return torch.stack([state.fields["a"], state.fields["b"]])

    with torch.no_grad(), forward_mode():
        slope = tangent(end(moved(3.0, 1.0, 0.0)))
    h = 1e-6
    more, less = (end(torch.full((2,), 3.0 + x, dtype=F64)) for x in (h, -h))
    difference = (more - less)[:, :3] / (2 * h)
    assert torch.allclose(slope[:, :3], difference, rtol=1e-4, atol=1e-7)


def test_the_start_and_a_plain_number_may_move(plain):
    """Not only values per colony: concentrations at the start, and one number for all."""
    decay = lambda u, s, p, cell: {"a": -p.k * u.a}
    with torch.no_grad(), forward_mode():
        k = forward_ad.make_dual(torch.tensor(2.0, dtype=F64), torch.tensor(1.0, dtype=F64))
        scene = one_circuit(decay, species=("a",), rtol=1e-10, k=k, initial={"a": 3.0})
        model = by("compiled", scene).bind(dtype=F64)
        state = model.start()
        a = forward_ad.make_dual(state.fields["a"].clone(), torch.ones(3, dtype=F64))
        end = model.step(state.with_fields(a=a), 0.5).fields["a"]
        value, slope = both(end)
    assert torch.allclose(value, torch.full((3,), 3 * math.exp(-1.0), dtype=F64), rtol=1e-8)
    # ∂/∂k = −dt a, ∂/∂a₀ = e^(−k dt)
    expected = (1 - 0.5 * 3) * math.exp(-1.0)
    assert torch.allclose(slope, torch.full((3,), expected, dtype=F64), rtol=1e-7)


def test_a_circuit_that_is_not_traced_carries_tangents():
    def branching(u, s, p, cell):
        return {"a": p.k - u.a if bool((u.b >= 0).all()) else -u.a, "b": u.a - 2 * u.b}

    with torch.no_grad(), forward_mode():
        ends = []
        for part in (branching, lambda u, s, p, cell: {"a": p.k - u.a, "b": u.a - 2 * u.b}):
            model = by("torch", one_circuit(part, k=moved(3.0, 1.0, 0.0))).bind(2, dtype=F64)
            ends.append(tangent(model.step(model.start(), 0.3).fields["b"]))
    assert float(ends[0].abs().max()) > 0
    assert torch.allclose(ends[0], ends[1], rtol=1e-12)


def test_molecules_have_no_derivative():
    with torch.no_grad(), forward_mode():
        model = tf.scenes.repressilator(beta=moved(5.0, 1.0, 0.0)).bind(2, per_colony=True)
        with pytest.raises(tf.InputError, match="numbers of molecules have none"):
            model.step(model.start(), 0.05)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_contacts_refuse_forward_mode(backend):
    with torch.no_grad(), forward_mode():
        growth = tf.Growth(rate=moved(1.0, 1.0, 0.0))
        scene = tf.Scene(growth, tf.Mechanics(dim=2, backend=backend))
        model = scene.bind(2, dtype=F64, per_colony=True)
        with pytest.raises(tf.InputError, match="contacts have a backward pass"):
            model.step(model.start(), 0.1)


def test_what_counts_as_tracked():
    x = torch.ones(2)
    assert not tracked(x, None) and not has_tangent(x)
    with forward_mode():
        dual = forward_ad.make_dual(x, x)
        assert has_tangent(dual) and tracked(x, dual)
    assert tracked(torch.ones(2, requires_grad=True))
    with torch.no_grad():
        assert not tracked(torch.ones(2, requires_grad=True))


@pytest.mark.parametrize("method", ["exponential", "series", "implicit", "crank_nicolson", "euler"])
def test_transport_carries_tangents(method):
    """Of a decay, which every voxel feels, against differences."""

    def end(decay):
        still = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
        initial = lambda places: torch.exp(-(places[:, 0] ** 2) / 10.0)
        signal = tf.Signal(diffusion=10.0, decay=decay, initial=initial)
        box = ((-10.0, -6.0), (10.0, 6.0))
        medium = tf.Medium(a=signal, box=box, spacing=2.0, method=method)
        model = tf.Scene(medium, founders=still, dt=0.05).bind(2, dtype=F64, per_colony=True)
        state = model.start()
        for _ in range(3):
            state = model.step(state, 0.05)
        return state.fields["out.a"]

    with torch.no_grad(), forward_mode():
        slope = tangent(end(moved(2.0, 1.0, 0.0)))
    more, less = (end(torch.tensor([2.0 + h, 2.0], dtype=F64)) for h in (1e-5, -1e-5))
    difference = (more - less) / 2e-5
    assert float(difference.abs().max()) > 0.01
    assert torch.allclose(slope, difference, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_cell_that_gives_nothing_has_the_slope_of_giving(plain, backend):
    """At a flux of exactly 0, into a pool and into a reservoir: taking and giving share it."""

    def end(q, outside):
        give = lambda u, s, p, cell: ({"a": 0 * u.a}, {"n": p.q * cell.volume})
        still = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
        far = {"outside": "reservoir"} if outside else {}
        signal = tf.Signal(diffusion=0.0, initial=1.0, **({"reservoir": 1.0} if outside else {}))
        box = ((50.0, 50.0), (60.0, 60.0)) if outside else ((-4.0, -4.0), (4.0, 4.0))
        scene = tf.Scene(
            tf.Circuit(give, species="a", q=q, backend=backend),
            tf.Medium(n=signal, box=box, spacing=2.0, **far), founders=still, dt=0.1,
        )  # fmt: skip
        model = scene.bind(2, dtype=F64, per_colony=True)
        state = model.step(model.start(), 0.1)
        return state.fields["n_reservoir" if outside else "out.n"]

    for outside in (False, True):
        with torch.no_grad(), forward_mode():
            slope = tangent(end(moved(0.0, 1.0, 0.0), outside))
        more, less = (end(torch.tensor([h, 0.0], dtype=F64), outside) for h in (1e-6, -1e-6))
        difference = (more - less) / 2e-6
        assert float(difference.abs().max()) > 1e-3
        assert torch.allclose(slope, difference, rtol=1e-6, atol=1e-9), outside


def test_transport_at_rest_still_depends_on_its_coefficients():
    """A uniform field in balance: no iteration of a solve is needed, and yet it moves."""

    def end(decay, method):
        still = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
        signal = tf.Signal(diffusion=1.0, decay=decay, source=2.0, initial=1.0)
        medium = tf.Medium(a=signal, box=((-4, -4), (4, 4)), spacing=2.0, method=method)
        model = tf.Scene(medium, founders=still, dt=0.1).bind(2, dtype=F64, per_colony=True)
        return model.step(model.start(), 0.1).fields["out.a"]

    for method in ("exponential", "series", "implicit", "crank_nicolson", "euler"):
        with torch.no_grad(), forward_mode():
            slope = tangent(end(moved(2.0, 1.0, 1.0), method))
        assert slope is not None and float(slope.max()) < -0.05, method


def test_values_in_a_list_keep_their_tangents(plain):
    decay = lambda u, s, p, cell: {"a": p.k - u.a}
    with torch.no_grad(), forward_mode():
        one = torch.tensor(1.0, dtype=F64)
        k = [forward_ad.make_dual(one.clone(), one), one]
        model = one_circuit(decay, species=("a",), k=k).bind(2, dtype=F64, per_colony=True)
        slope = tangent(model.step(model.start(), 0.1).fields["a"])
    assert float(slope[:3].min()) > 0.09 and float(slope[3:].abs().max()) == 0


def test_recorded_growth_refuses_tangents():
    with torch.no_grad(), forward_mode():
        rate = forward_ad.make_dual(torch.tensor(1.0), torch.tensor(1.0))
        model = tf.Scene(tf.Growth(rate=rate), tf.Circuit(roots, species=("a", "b"), k=1.0)).bind(1)
        assert "a derivative by" in model.why_not_replayable
