"""The passes of a step, the accuracy of each, and their independence of the batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import run, seeded, step

import torchfilm as tf
from torchfilm.kernels.scheme import OVERLAP
from torchfilm.physics import contact_step
from torchfilm.physics.contact_records import CellProperties, Moved
from torchfilm.physics.contact_search import find_contacts, unresolved_contacts
from torchfilm.physics.nearby import gaps_nearby
from torchfilm.physics.problem import CONVERGED

# Sixty short rods at random in a box of 5 µm: the first moves would turn some of them by far more
# than MAX_TURN, as in the middle of a large colony.
RODS, SIDE = 60, 5.0


def thrown(*colonies: float) -> tf.Cells:
    """A colony of such rods for each of the given ranges of the box."""
    parts = []
    for number, stretch in enumerate(colonies):
        rng = np.random.default_rng(number)
        axis = rng.normal(size=(RODS, 3))
        parts.append(
            (
                stretch * SIDE * rng.random((RODS, 3)),
                axis / np.linalg.norm(axis, axis=1, keepdims=True),
            )
        )
    position, axis = (np.concatenate(part) for part in zip(*parts, strict=True))
    return tf.Cells(
        position, axis, length=1.5, radius=0.5, colony=np.repeat(np.arange(len(colonies)), RODS)
    )


# The number and the accuracy of passes are chosen for bilateral contacts; one-sided ones repeat
# them by themselves.
BILATERAL = {"contacts": "bilateral", "length_drag": 10.0}


def first_step(device, dtype, **options) -> tf.State:
    scene = tf.Scene(tf.Mechanics(dim=3, **BILATERAL, **options))
    return run(scene, seeded(scene, thrown(1.0, 6.0), device, dtype), 1, dt=0.025)


def deepest(state: tf.State) -> float:
    """The greatest overlap in the crowded colony, µm."""
    return float(tf.measure.overlaps(state).worst[0])


def test_later_passes_part_what_the_first_left_deep(device, dtype):
    """Further passes reduce the crowd's mean overlap, until none exceeds the limit of 0.02 µm."""
    more = [first_step(device, dtype, passes=passes, overlap=0.02) for passes in (1, 2, 4, 8)]
    mean = [float(tf.measure.overlaps(s).mean[0]) for s in more]
    assert mean[0] > mean[1] > mean[2] > mean[3]
    last = first_step(device, dtype, passes=200, overlap=0.02)
    assert deepest(last) <= 0.02 + 1e-6 < deepest(more[2])
    assert int(last.reports["mechanics"].passes[0]) < 200


def test_two_passes_are_the_default_in_space(device, dtype):
    """The crowd needs both, down to a fifth of the radius. A default that is given explicitly is
    the default."""
    state = first_step(device, dtype)
    assert state.reports["mechanics"].passes.tolist()[0] == 2 and deepest(state) > 0.1
    for options in ({"passes": 2, "overlap": 0.1}, {"passes": 2}, {"overlap": 0.1}):
        assert torch.equal(state.position, first_step(device, dtype, **options).position)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_number_of_passes_leaves_the_overlap_as_it_is(dim):
    """More passes than usual solve the same cells as the usual ones do, to a fifth of a radius.

    Colonies that take sub-steps take at least 6.
    """
    usual = tf.Mechanics(dim=dim, **BILATERAL).settings
    assert usual.passes == dim - 1 and usual.overlap is None
    for passes in (usual.passes, 4, 8):
        given = tf.Mechanics(dim=dim, passes=passes, **BILATERAL).settings
        assert given.overlap is None and given.passes == passes
        assert given.coarse_passes == max(6, passes)
        assert (given == usual) == (passes == usual.passes)


def test_bilateral_contacts_have_a_length_drag_at_which_they_hold():
    assert tf.Mechanics(contacts="bilateral").length_drag == 10.0
    assert tf.Mechanics().length_drag == tf.Mechanics(length_drag=None).length_drag == 1e5


def test_the_overlap_that_is_left_can_be_named(device, dtype):
    assert deepest(first_step(device, dtype, passes=100, overlap=0.05)) <= 0.05 + 1e-6


def test_a_later_pass_moves_only_what_is_too_deep(device, dtype):
    """A colony with a crowd and a separate pair that the first pass separates to within the limit.

    The second pass moves only those cells of the crowd that are deeper than the limit, or whose
    move was cut.
    """
    crowd = thrown(1.0)
    far = np.array([[40, 0, 0], [40, 0.8, 0]]), np.array([[1.0, 0, 0], [1, 0, 0]])
    cells = tf.Cells(
        np.concatenate([crowd.position, far[0]]),
        np.concatenate([crowd.axis, far[1]]),
        length=1.5,
        radius=0.5,
    )
    scenes = [tf.Scene(tf.Mechanics(dim=3, passes=n, overlap=0.1, **BILATERAL)) for n in (1, 2)]
    one, two = (run(scene, seeded(scene, cells, device, dtype), 1, dt=0.025) for scene in scenes)
    moved = (two.position != one.position).any(1) | (two.axis != one.axis).any(1)
    first, second, gap = gaps_nearby(one.position, one.axis, one.length, one.radius, one.colony, 1)
    deep = torch.zeros_like(moved)
    deep[torch.cat([first[gap < -0.1], second[gap < -0.1]])] = True
    assert bool(moved[deep].all()) and not bool(moved[-2:].any())
    assert 0 < int((moved & ~deep).sum()) <= int(one.reports["mechanics"].clipped[0]) < RODS
    assert not bool(moved[:RODS].all())


def every_pair(cells: CellProperties, at: Moved, active: torch.Tensor) -> tuple[list, torch.Tensor]:
    """The pairs that a later pass should find, by a search over all pairs.

    These are the pairs with a cell that takes part. Also which cells take part, (N,) bool.
    """
    of_active = active[cells.colony]
    rows = torch.nonzero(of_active).squeeze(1)
    pairs, walls = find_contacts(cells, at, rows, cells.settings.sees_near[1])
    left = at.clipped & of_active
    if not cells.settings.soft:
        deep = pairs.gap < -0.5 * (cells.overlap[pairs.first] + cells.overlap[pairs.second])
        left[torch.cat([pairs.first[deep], pairs.second[deep]])] = True
    hard = torch.tensor([s.wall.stiffness is None for s in cells.surfaces], dtype=torch.bool)
    left[walls.cell[hard[walls.surface] & (walls.gap < -cells.overlap[walls.cell])]] = True
    held = left[pairs.first] | left[pairs.second]
    return as_list(pairs.first[held], pairs.second[held]), left


def as_list(first: torch.Tensor, second: torch.Tensor) -> list:
    return sorted((min(p), max(p)) for p in zip(first.tolist(), second.tolist(), strict=True))


# By overlap: cells that hardly move stay deep where the limit is small compared with the box's
# overlaps. Without a given limit it depends on the radius.
LIMITS = {
    "small": {"passes": 6, "overlap": 0.01},
    "by radius": {},
    "large": {"passes": 4, "overlap": 0.3},
    "soft cells": {"stiffness": 40.0, "passes": 4, "overlap": 0.02},
}


@pytest.mark.parametrize("limit", LIMITS)
def test_what_is_left_deep_is_found_wherever_it_is(dtype, limit, monkeypatch):
    """Each later pass finds the same cells and the same contacts, each once, as a search over all
    pairs.

    The search is only near moved cells. The cells have many sizes, in colonies from loose to
    jammed, in a hard box with a soft plane in it. Some colonies are done before others.
    """
    seen = []

    def compared(cells, at, active, rows, before):
        pairs, walls, left = unresolved_contacts(cells, at, active, rows, before)
        wanted, taking = every_pair(cells, at, active)
        assert torch.equal(left, taking)
        assert as_list(pairs.first, pairs.second) == wanted
        seen.append(
            (
                int(left.sum()),
                bool(active.all()),
                int((left & (2 * at.reach <= cells.overlap) & ~at.clipped).sum()),
            )
        )
        return pairs, walls, left

    monkeypatch.setattr(contact_step, "unresolved_contacts", compared)
    stretches = (1.0, 0.7, 1.6, 6.0)
    cells = thrown(*stretches)
    rng = np.random.default_rng(3)
    count = len(stretches) * RODS
    position = np.clip(cells.position, 0.0, 30.0)
    cells = tf.Cells(
        position,
        cells.axis,
        length=rng.choice([0.0, 0.5, 2.0, 6.0], count),
        radius=rng.uniform(0.2, 0.6, count),
        colony=cells.colony,
    )
    walls = [
        tf.Box((-1.0, -1.0, -1.0), (30.5, 30.5, 30.5)),
        tf.Plane(z=-0.5, facing="+z", stiffness=16.0),
    ]
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics(dim=3, walls=walls, backend="torch", **BILATERAL, **LIMITS[limit]),
    )
    state = seeded(scene, cells, "cpu", dtype)
    for _ in range(4):
        state = step(scene, state, 0.025)
    assert len(seen) >= 4 and max(n for n, _, _ in seen) > 0
    if limit == "small":  # every kind of case occurred
        assert (
            any(not all_active for _, all_active, _ in seen)
            and max(still for _, _, still in seen) > 0
        )


@pytest.fixture(scope="module", params=["bilateral", "one-sided"])
def full_channel(request) -> tuple[str, tf.State]:
    """Four colonies of some 150 cells in an open channel, under pressure."""
    channel = tf.Channel(10.0, low_end=0.0)
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics([channel], dim=2, length_drag=10.0, contacts=request.param),
        tf.Removal(low=(-1.0, -10.0), high=(60.0, 10.0)),
        founders=tf.Cells([[15.0, 0.0]], [[1.0, 0.0]]),
    )
    *_, state = tf.simulate(scene, scene.bind(4, seed=1).start(), until=10.0)
    return request.param, state


def test_more_passes_over_hard_contacts_keep_a_full_channel_apart(full_channel):
    """F6: without rows for near pairs each pass pushed together the cells that the one before had
    separated.

    Cells then lay on one another, 0.45 µm deep on average, and grew as if free. More passes of
    tighter solves must leave less overlap than the start, which has the usual settings.
    """
    contacts, start = full_channel
    mechanics = tf.Mechanics(
        dim=2,
        walls=[tf.Channel(10.0, low_end=0.0)],
        alpha=1e-3,
        passes=4,
        overlap=0.002,
        tolerance=1e-3,
        contacts=contacts,
        length_drag=10.0,
    )
    removal = tf.Removal(low=(-1.0, -10.0), high=(60.0, 10.0))
    scene = tf.Scene(
        tf.Growth(),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        mechanics,
        removal,
        founders=tf.Cells([[15.0, 0.0]], [[1.0, 0.0]]),
    )
    usual = float(tf.measure.overlaps(start).mean.max())
    state, deepest_of_each = start, []
    for _ in range(20):
        state = step(scene, state, 0.025)
        deepest_of_each.append(float(tf.measure.overlaps(state, mechanics.walls).worst.max()))
    assert float(tf.measure.overlaps(state).mean.max()) < 0.5 * usual
    # half a radius; cells on one another are 1 µm deep
    assert float(np.median(deepest_of_each)) < 0.25
    assert int((state.counts - start.counts).max()) < 30


def test_a_colony_whose_cells_stay_in_one_another_is_reported():
    """A heap whose contacts are so soft by their alpha that they separate nothing has failed.

    The other colony is loose, and goes on. No solve fails.
    """
    scene = tf.Scene(tf.Mechanics(dim=3, alpha=1e4), founders=thrown(0.3, 6.0))
    given = {"until": 25 * 0.025, "dt": 0.025}
    with pytest.raises(
        tf.SimulationError, match=r"(?s)colony 0 \(\d+ cells\).*for 20 steps.*or take a smaller"
    ) as e:
        list(tf.simulate(scene, scene.bind(2).start(), **given))
    assert e.value.colonies == (0,) and "max_iterations" not in str(e.value)
    states = list(tf.simulate(scene, scene.bind(2).start(), on_failure="drop", **given))
    assert int(states[1].reports["mechanics"].deeply_overlapping[0]) > 10
    assert states[-1].counts.tolist() == [0, RODS]


@pytest.mark.parametrize("contacts", ["one-sided", "bilateral"])
def test_a_lasting_collapse_is_counted_in_the_state(contacts, tmp_path):
    """So it fails at the same step after a restart from a file, in another order of colonies, in a
    rollout, and stepped by hand."""
    scene = tf.Scene(
        tf.Mechanics(dim=3, alpha=1e4, contacts=contacts), founders=thrown(0.3, 6.0), dt=0.025
    )
    model = scene.bind(2)
    step_20 = r"step 20 \(t = 0.5 h\) failed in 1 of 2"
    path = tmp_path / "run.h5"
    *_, half = tf.simulate(model, until=12 * 0.025, record=path)
    assert half.collapsed_steps[half.colony == 0].unique().tolist() == [12]
    assert int(half.collapsed_steps[half.colony == 1].max()) == 0
    with tf.Results(path) as results:
        read = results.state(scene)
    for begin in (half, read, half.select([1, 0])):
        with pytest.raises(tf.SimulationError, match=step_20) as e:
            list(tf.simulate(scene, begin, until=1.0))
        assert e.value.colonies == (0,)
    with pytest.raises(tf.SimulationError, match=step_20):
        tf.rollout(scene, half, until=1.0, segment=3)
    state = read
    while not tf.failures(state):
        state = model.step(state)
    assert state.step == 20 and [f.colony_id for f in tf.failures(state)] == [0]


def test_a_heap_that_parts_is_no_collapse():
    """In tests warnings are errors."""
    scene = tf.Scene(tf.Mechanics(dim=3), founders=thrown(1.0, 6.0))
    *_, state = tf.simulate(scene, scene.bind(2).start(), until=40 * 0.025, dt=0.025)
    assert int(state.reports["mechanics"].deeply_overlapping.max()) == 0


@pytest.mark.parametrize("contacts", ["bilateral", "one-sided"])
@pytest.mark.parametrize("alpha", [1e-6, 1e-7])
def test_nearly_hard_contacts_converge_in_32_bits(alpha, contacts):
    """Overlapping rods with nearly singular blocks: their inverses must stay symmetric, or CG
    stagnates.

    Four in five seeds, of 20 rods each; at αγ = 1e-6 float32 has no digit to spare.
    """
    parts = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        axis = rng.normal(size=(20, 3))
        parts.append((axis / np.linalg.norm(axis, axis=1, keepdims=True), 5 * rng.random((20, 3))))
    axis, position = (np.concatenate(part) for part in zip(*parts, strict=True))
    cells = tf.Cells(position, axis, length=2.0, radius=0.5, colony=np.repeat(np.arange(20), 20))
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics(
            dim=3, contacts=contacts, length_drag=10.0, alpha=alpha, passes=1, max_iterations=500
        ),
    )
    report = step(scene, seeded(scene, cells, "cpu", torch.float32), 0.005).reports["mechanics"]
    assert int((report.status == CONVERGED).sum()) >= 16
    if contacts == "bilateral":  # one-sided ones are solved as softer ones first
        assert float(report.iterations.double().median()) < 200  # one that stagnates takes 500


@pytest.mark.parametrize("passes", [1, 2, 3])
def test_no_more_passes_than_asked(device, dtype, passes):
    """Even if overlaps remain."""
    state = first_step(device, dtype, passes=passes, overlap=0.02)
    assert int(state.reports["mechanics"].passes.max()) == passes
    assert deepest(state) > 0.1


def test_a_pass_is_as_fine_as_asked(device, dtype):
    """The worst residual of every pass is at most the tolerance, relative to that at rest.

    The default tolerance is 0.05.
    """
    assert (
        1e-3
        < float(first_step(device, dtype, passes=1).reports["mechanics"].residual.max())
        <= 0.05
    )
    assert (
        float(
            first_step(device, dtype, passes=2, overlap=0.02, tolerance=1e-3)
            .reports["mechanics"]
            .residual.max()
        )
        <= 1e-3
    )


@pytest.mark.parametrize("given", [BILATERAL, {}], ids=["bilateral", "one-sided"])
def test_passes_do_not_depend_on_the_batch(device, dtype, given):
    """Colonies with many and with few passes in a batch: each has the bits that it has alone."""
    scene = tf.Scene(tf.Mechanics(dim=3, passes=5, overlap=0.02, **given))
    start = seeded(scene, thrown(1.0, 1.6, 6.0, 0.9), device, dtype)
    state = run(scene, start, 3, dt=0.025)
    for k in range(4):
        alone = run(scene, start.select([k]), 3, dt=0.025)
        together = state.select([k])
        for what in ("position", "axis", "length"):
            assert torch.equal(getattr(alone, what), getattr(together, what)), (k, what)


def test_sub_steps_take_off_no_growth():
    """A film under pressure, in a space 20 µm wide: the volume is that of shorter steps."""

    def volume(dt: float, **options) -> float:
        first = tf.Cells([[-7.0 + 5.0 * k, 0.6] for k in range(4)], [[1.0, 0.0]] * 4, length=2.0)
        floor = tf.Plane(normal=(0.0, 1.0), point=(0.0, 0.0))
        space = {"periodic": {"x": (-10.0, 10.0)}, "walls": [floor], "length_drag": 1e3}
        scene = tf.Scene(
            tf.Growth(rate=1.0),
            tf.Division(length=tf.Uniform(3.5, 4.5), conserves="volume"),
            tf.Mechanics(dim=2, **space, **options), founders=first, dt=dt,
        )  # fmt: skip
        state = tf.simulate(scene, until=5.0, colonies=4, seed=1).last()
        divided = int(state.reports["mechanics"].substeps.min()) > 1
        assert divided == (dt > 0.0125)
        return float(state.volume.sum())

    wanted = volume(0.0125)
    assert volume(0.025, max_elongation=0.05) == pytest.approx(wanted, rel=0.02)
    assert volume(0.05) == pytest.approx(wanted, rel=0.05)


@pytest.mark.parametrize("backend", ["torch", "compiled"])
@pytest.mark.parametrize("width", [1.0, 1.02])
def test_light_walls_leave_cells_no_deeper_in_each_other_than_wanted(width, backend):
    """Of the contacts in a channel one cell wide most are those with its sides, and light. By the
    mean of all contacts alone the cells would lie three times as deep in each other."""
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics([tf.Channel(width, low_end=0.0)], dim=2, length_drag=1e4, backend=backend),
        tf.Removal(low=(-1.0, -width), high=(15.0, width)),
        founders=tf.Cells([[2.0, 0.0], [6.0, 0.0], [10.0, 0.0]], [[1.0, 0.0]] * 3),
        dt=0.025,
    )
    states = list(tf.simulate(scene, until=2.5, colonies=4, seed=1))[-40::4]
    found = torch.stack([tf.measure.overlaps(state).mean for state in states]).mean()
    wanted = 0.5 * OVERLAP
    assert 0.7 * wanted < found < 1.1 * wanted
