"""Shared by the tests: states from arrays, and geometry worked out a second time, plainly and in
float64."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

import torchfilm as tf
from torchfilm.physics.contacts import CandidateContacts, Capsules, Contacts, contacts_of
from torchfilm.physics.problem import CONVERGED

# (normal to the side of the cells, normal · x at the wall)
Flat = tuple[Sequence[float], float]


def mechanics(**options) -> tf.Mechanics:
    """The hard cases' mechanics: γ = 10, μ = 1, α = 1/γ, solved well below what the cases ask."""
    return tf.Mechanics(
        **{"alpha": 0.1, "length_drag": 10.0, "viscosity": 1.0, "tolerance": 1e-4, **options}
    )


def growth(rate: float | Tensor = 1.0, law: str = "length") -> tf.Growth:
    """The hard cases' growth: dl/dt = 1/h · l."""
    return tf.Growth(rate=rate, law=law)


def seeded(
    scene: tf.Scene, cells: tf.Cells, device: torch.device, dtype: torch.dtype, **options
) -> tf.State:
    return scene.bind(cells=cells, device=device, dtype=dtype, **options).start()


_MODELS: dict[tuple, tuple[tf.Scene, tf.Model]] = {}


def model_for(scene: tf.Scene, state: tf.State) -> tf.Model:
    """The scene bound to the batch of a state, once for each batch."""
    count = max(scene.fixed_colonies, int(state.colony_id.max()) + 1)
    key = (id(scene), count, state.dtype, state.device, torch.is_grad_enabled())
    if key not in _MODELS:
        if len(_MODELS) > 50:
            _MODELS.clear()
        # the scene is kept too, so that no other takes its id
        _MODELS[key] = (scene, scene.bind(state=state))
    return _MODELS[key][1]


def step(
    scene: tf.Scene, state: tf.State, dt: float, timings: tf.Timings | None = None
) -> tf.State:
    """The state dt hours later."""
    return model_for(scene, state).step(state, dt, timings)


def run(
    scene: tf.Scene, state: tf.State, steps: int, dt: float = 0.01, check: bool = True
) -> tf.State:
    """The state `steps` steps later; `check` applies `check_always` to each state on the way."""
    for _ in range(steps):
        state = step(scene, state, dt)
        if check:
            check_always(state, scene)
    return state


def check_same_bits_alone(scene: tf.Scene, until: float, seed: int) -> None:
    """Each of three colonies has the same cells at the same places alone as in a batch."""
    together = [s for s in tf.simulate(scene, until=until, colonies=3, seed=seed)][-1]
    for k in range(3):
        alone = [s for s in tf.simulate(scene, until=until, streams=[k], seed=seed)][-1]
        part = together.select([k])
        assert bool((part.position == alone.position).all()) and part.cells == alone.cells


def check_always(state: tf.State, scene: tf.Scene | None = None) -> None:
    """What the hard cases ask of every state: finite, |axis| = 1 ± 1e-6, length ≥ 0, every colony's
    solve converged."""
    for name in ("position", "axis", "length", "radius"):
        assert torch.isfinite(getattr(state, name)).all(), name
    for name, value in state.fields.items():
        if value.is_floating_point():
            assert torch.isfinite(value).all(), name
    size = state.axis.double().norm(dim=1)
    assert ((size - 1).abs() <= 1e-6).all(), f"|axis| off by {float((size - 1).abs().max())}"
    assert (state.length >= 0).all()
    report = state.reports.get("mechanics")
    if report is None:
        return
    assert (report.status == CONVERGED).all(), report
    if scene is not None:
        mechanics = next(e for e in scene.effects if isinstance(e, tf.Mechanics))
        tolerance = mechanics.settings.tolerance or 0.05
        assert (report.residual <= tolerance).all(), report


def array(x: Tensor) -> np.ndarray:
    """As float64 in NumPy (whole numbers stay whole)."""
    x = x.detach().cpu()
    return (x.double() if x.is_floating_point() else x).numpy()


def segment_distance(c1, a1, h1, c2, a2, h2) -> np.ndarray:
    """Least distance of segments c ± h a, (P, d), (P, d), (P,), by search: no formula shared with
    torchfilm.

    The distance of a point of one segment to the other segment is convex along the first, so the
    search between its ends cannot miss; after 90 rounds the bracket is 1e-16 of the segment.
    """
    c1, a1, h1, c2, a2, h2 = (np.asarray(x, dtype=np.float64) for x in (c1, a1, h1, c2, a2, h2))

    def to_second(s):
        away = c1 + s[:, None] * a1 - c2
        t = np.clip((away * a2).sum(1) / (a2 * a2).sum(1), -h2, h2)
        return np.sqrt(((away - t[:, None] * a2) ** 2).sum(1))

    low, high = -h1, h1.copy()
    for _ in range(90):
        third = (high - low) / 3
        nearer = to_second(low + third) < to_second(high - third)
        low, high = np.where(nearer, low, low + third), np.where(nearer, high - third, high)
    return to_second(0.5 * (low + high))


def pair_gaps(state: tf.State, pairs: np.ndarray) -> np.ndarray:
    """Signed gaps (P,) µm of pairs (P, 2), in float64."""
    c, a, h, r = (
        array(state.position),
        array(state.axis),
        0.5 * array(state.length),
        array(state.radius),
    )
    i, j = pairs.T
    return segment_distance(c[i], a[i], h[i], c[j], a[j], h[j]) - r[i] - r[j]


def near_pairs(state: tf.State, margin: float = 0.0) -> np.ndarray:
    """All pairs (P, 2), i < j, of one colony with a gap under `margin`, from every pair whose
    centres are near enough."""
    reach = 0.5 * array(state.length) + array(state.radius)
    colony, found = array(state.colony), [np.zeros((0, 2), dtype=np.int64)]
    for k in range(state.colonies):
        members = np.flatnonzero(colony == k)
        if len(members) > 1:
            tree = cKDTree(array(state.position)[members])
            found.append(
                members[tree.query_pairs(2 * reach[members].max() + margin, output_type="ndarray")]
            )
    pairs = np.concatenate(found)
    return pairs[pair_gaps(state, pairs) < margin] if len(pairs) else pairs


def ends(state: tf.State) -> np.ndarray:
    """The two ends of every centreline, (2, N, d) float64."""
    c, out = array(state.position), 0.5 * array(state.length)[:, None] * array(state.axis)
    return np.stack([c - out, c + out])


def wall_overlap(state: tf.State, walls: Sequence[Flat]) -> np.ndarray:
    """How deep each cell's surface is behind each flat wall, (walls, N) µm; negative where there is
    room."""
    points, radius = ends(state), array(state.radius)
    return np.array(
        [radius - (points @ np.asarray(n, dtype=np.float64) - at).min(0) for n, at in walls]
    )


def worst_overlap(state: tf.State, walls: Sequence[Flat] = ()) -> float:
    """The deepest overlap, µm, of two cells or of a cell and a wall; 0 where nothing overlaps."""
    pairs = near_pairs(state)
    deepest = [0.0]
    if len(pairs):
        deepest.append(float(-pair_gaps(state, pairs).min()))
    if len(walls) and state.cells:
        deepest.append(float(wall_overlap(state, walls).max()))
    return max(deepest)


def bodies(c, a, length, radius=0.5, *, dtype=torch.float64, device="cpu") -> Capsules:
    """Capsules from arrays (N, d), (N, d), (N,)."""
    t = lambda x: torch.as_tensor(np.asarray(x), dtype=dtype, device=device)
    length = t(length)
    return Capsules(
        t(c).T.contiguous(),
        t(a).T.contiguous(),
        0.5 * length,
        t(radius).expand(length.shape).contiguous(),
    )


def rows_of(cells: Capsules, first: Tensor, second: Tensor) -> Contacts:
    """All rows that overlap among the given pairs (P,), (P,)."""
    return contacts_of(CandidateContacts.among(cells, first, second))


def unit(rng: np.random.Generator, count: int, dim: int) -> np.ndarray:
    """Random directions, (count, dim)."""
    v = rng.normal(size=(count, dim))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def rotation(rng: np.random.Generator, dim: int) -> np.ndarray:
    """A random rotation matrix (dim, dim)."""
    q, r = np.linalg.qr(rng.normal(size=(dim, dim)))
    q = q * np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] = -q[:, 0]
    return q


def crowd(rng: np.random.Generator, count: int, dim: int, tilt: float = 0.1) -> tf.Cells:
    """Overlapping cells in no order, none through another: a wall of bricks, jittered and tilted,
    either way round. Most overlap several neighbours, by up to 0.4 µm.
    """
    side = int(np.ceil(count ** (1 / dim)))
    place = np.stack(np.meshgrid(*[np.arange(side)] * dim, indexing="ij"), -1).reshape(-1, dim)[
        :count
    ]
    position = place * np.array([3.0, 0.93, 0.93])[:dim] + 0.03 * rng.uniform(-1, 1, (count, dim))
    position[:, 0] += 1.5 * (place[:, 1:].sum(1) % 2) + 0.1 * rng.uniform(-1, 1, count)
    axis = np.eye(dim)[0] * rng.choice([-1.0, 1.0], count)[:, None] + tilt * rng.uniform(
        -1, 1, (count, dim)
    )
    shuffled = rng.permutation(count)
    return tf.Cells(position[shuffled], axis[shuffled], rng.uniform(1.7, 2.1, count), 0.5)


def in_turns(effect: tf.Effect, **options) -> tf.Effect:
    """A medium with which circuits take turns; other effects as they are."""
    if not isinstance(effect, tf.Medium):
        return effect
    given = {f.name: getattr(effect, f.name) for f in dataclasses.fields(effect)}
    signals = given.pop("signals")
    if len(given["box"][0]) == 2:
        given["spacing"] = given["spacing"][:2]
    return tf.Medium(**signals, **given | {"exchange": "turns"} | options)
