"""A hundred random scenes, the same each time, under the laws of experiments/fuzz.py; what longer
runs of it found; and that it would notice."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import step

import torchfilm as tf
from torchfilm.kernels.scheme import PASSES

sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import fuzz
from fuzz_draws import for_each

# walls and cells are drawn independently of each other
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*there is room for",
    "ignore:.*between two hard sides, too narrow",
    "ignore:.*the box grows through the wall",
    "ignore:.*its signal .* count as none",
)

# Of each seed so many are drawn, each by itself; workers share the seeds.
SEEDS, SCENES = (3, 4, 5, 6), 25


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*empty. the cells are of")
@pytest.mark.parametrize("seed", SEEDS)
def test_random_scenes_obey_the_laws(seed):
    """Finite, nonnegative, unique uids, no escape, amounts conserved, the same alone as in the
    batch and by both paths; failures are reported.

    A fuzzer whose scenes are mostly refused tests nothing: at least half run to their end, and some
    with cells that push.
    """
    endings: Counter[str] = Counter()
    paths: Counter[str] = Counter()
    for_each(fuzz.DRAWS, SCENES, seed, lambda draw: endings.update([fuzz.run(draw, paths)]))
    assert endings.total() == SCENES and endings["ran"] >= SCENES / 2
    assert paths["float64, same counts, alike"] >= 2


def far_apart(distance: float) -> tuple[tf.Scene, tf.Cells]:
    """A medium that grows with its colony, voxels of 0.3 µm, and two cells `distance` µm apart
    along each axis; a colony of one beside it."""
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=1.0, initial=1.0),
        box=((-1.2,) * 3, (1.2,) * 3),
        spacing=0.3,
        outside="grow",
    )
    cells = tf.Cells([[0.0] * 3, [distance] * 3, [0.0] * 3], [1.0, 0.0, 0.0], colony=[0, 0, 1])
    return tf.Scene(medium, founders=tf.Cells.single(3)), cells


def test_a_medium_does_not_grow_without_end():
    """Found by the fuzzer: cells 1 mm apart on a grid of 0.3 µm asked for 3.7e10 voxels, which no
    machine has. Refused at the start."""
    scene, cells = far_apart(1e3)
    with pytest.raises(tf.InputError, match=r"too small for colony 0.*at most 67 million voxels"):
        scene.bind(2, cells=cells).start()


@pytest.mark.parametrize("distance", [1e3, float("inf"), float("nan")])
def test_a_cell_that_flies_away_fails_its_own_colony(device, dtype, distance):
    """The same in the middle of a run: that colony is reported and the other goes on as it would
    have alone."""
    scene, cells = far_apart(1.0)
    state = scene.bind(2, cells=cells, device=device, dtype=dtype).start()
    position = state.position.clone()
    position[1] = distance
    after = step(scene, state.replace(position=position), 0.01)
    (failure,) = tf.failures(after)
    assert failure.colony_id == 0 and "1 cell(s) are beyond the box" in failure.reason
    assert all(bool(torch.isfinite(v).all()) for v in after.signals.values())
    assert torch.equal(
        after.select([1]).signals["ahl"], step(scene, state.select([1]), 0.01).signals["ahl"]
    )


@pytest.mark.parametrize("law", ["volume", "length", "linear"])
@pytest.mark.parametrize(
    "more",
    [(), (tf.Division(length=4.0),), (tf.Mechanics(dim=3),)],
    ids=["alone", "division", "mechanics"],
)
def test_growth_past_all_numbers_is_reported(device, dtype, law, more):
    """Found beside the fuzzer: e^10000 µm is no length, and without mechanics nobody said so; a
    step later cells were nowhere.

    The other colony goes on, and what is left of the failed one is finite. Where cells divide, such
    a rate is refused before the run; a rule may set it all the same.
    """
    huge = 1e38 if dtype == torch.float32 else 1e308
    scene = tf.Scene(
        tf.Growth(rate=torch.tensor([huge, 0.005], dtype=torch.float64), law=law), *more
    )
    start = scene.bind(2, device=device, dtype=dtype).start()
    state = step(scene, start, 100.0)
    assert "growth rate" in next(f for f in tf.failures(state) if f.colony_id == 0).reason
    assert all(f.colony_id == 0 for f in tf.failures(state))
    assert float(state.length[0]) == 2.0 and bool(torch.isfinite(state.position).all())
    assert torch.equal(state.select([1]).length, step(scene, start.select([1]), 100.0).length)
    divides = any(isinstance(effect, tf.Division) for effect in more)
    if divides and law != "linear":
        with pytest.raises(tf.InputError, match=r"dt = 100 h is too long for Growth\.rate"):
            tf.simulate(scene, start, until=100.0, dt=100.0)
    slow = tf.Scene(tf.Growth(rate=0.005, law=law), *more)
    with pytest.raises(tf.SimulationError, match="of no finite length"):
        list(tf.simulate(slow, start, until=100.0, dt=100.0))


@pytest.mark.parametrize("name", ["length", "axis", "a"])
def test_the_fuzzer_notices_a_number_that_is_none(name):
    """Each of its laws is broken on purpose: this one by a NaN in one cell of one colony, and only
    if that colony did not fail."""
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Circuit(lambda u, s, p, cell: {"a": -u.a}, species=("a",))
    )
    state = scene.bind(2).start()
    value = (state.fields[name] if name in state.fields else getattr(state, name)).clone()
    value[1] = torch.nan
    broken = state.with_fields(a=value) if name == "a" else state.replace(**{name: value})
    fuzz.finite(broken, [0])
    with pytest.raises(AssertionError, match=name):
        fuzz.finite(broken, [0, 1])


CROWD = fuzz.Draw(
    fuzz.Capsules((40,), 2.0, (2.0, 3.0), (2.0, 2.0), 2, 1),
    fuzz.Contacts(None, 1.0, 1.0, "one-sided", None, "box", 0.3, None),
    *(None, None, None, fuzz.Beside(False, None, False), 0.01, 1, "float64", 0),
)


def test_a_heap_without_room_stays_between_its_walls_and_is_reported():
    """Found by the fuzzer: 40 cells 4 µm wide in a box of 4.6 µm. Contacts push with the same force
    as walls; but a move ends where a cell would lie its radius deep in a wall."""
    assert fuzz.run(CROWD) == "ran"
    scene, state = fuzz.scene_of(CROWD)
    model = scene.bind(state=state)
    while not tf.failures(state):
        state = model.step(state, CROWD.dt)
        assert fuzz.collapsed(state, 0)
        fuzz.walled(state, CROWD)
    assert state.step == 20
    assert "deeper in others than a radius" in tf.failures(state)[0].reason


def test_the_fuzzer_notices_a_cell_behind_a_wall():
    """And only in a colony whose cells its contacts hold apart."""
    draw = replace(CROWD, capsules=replace(CROWD.capsules, counts=(1,), radii=(0.5, 0.5)))
    scene, before = fuzz.scene_of(draw)
    after = step(scene, before, draw.dt)
    assert fuzz.lawful(before, after, draw) == []
    with pytest.raises(AssertionError, match="behind the wall"):
        fuzz.lawful(before, after.replace(position=after.position + 7.0), draw)


def test_the_fuzzer_notices_cells_that_do_not_add_up():
    state = (
        tf.Scene(tf.Growth(rate=1.0), founders=tf.Cells([[0.0, 0.0], [9.0, 0.0]], [1.0, 0.0]))
        .bind(1)
        .start()
    )
    fuzz.counted(state, state)
    with pytest.raises(AssertionError, match="unique"):
        fuzz.counted(state, state.replace(uid=torch.zeros_like(state.uid)))
    with pytest.raises(AssertionError, match="add up"):
        fuzz.counted(state, state.take(torch.tensor([0])))


PUSHING = fuzz.Draw(
    fuzz.Capsules((7, 3), 2.0, (2.0, 3.0), (0.4, 0.6), 3, 1),
    fuzz.Contacts(None, 1e5, 1.0, "one-sided", None, "box", 1.0, None, tolerance=1e-6),
    *(None, None, None, fuzz.Beside(False, None, False), 0.01, 1, "float64", 0),
)


@pytest.mark.parametrize("part", ["position", "passes", "alpha"])
def test_the_fuzzer_notices_that_the_paths_differ(part):
    scene, before = fuzz.scene_of(PUSHING)
    after, paths = step(scene, before, PUSHING.dt), Counter()
    fuzz.both_paths(scene, before, after, PUSHING, paths)
    assert paths == {"float64, same counts, alike": 2}
    report = after.reports["mechanics"]
    with_report = lambda **changed: {"reports": {"mechanics": replace(report, **changed)}}
    change, words = {
        "position": ({"position": after.position + 1e-3, **with_report()}, "paths differ"),
        "passes": (with_report(passes=report.passes + PASSES), "too many passes"),
        "alpha": (with_report(alpha=1.01 * report.alpha), "paths report other alphas"),
    }[part]
    broken = after.replace(**change)
    with pytest.raises(AssertionError, match=words):
        fuzz.both_paths(scene, before, broken, PUSHING, paths)


def test_the_fuzzer_notices_that_the_paths_seldom_agree():
    paths = Counter({"float64, same counts, alike": 300, "float64, other counts, alike": 20})
    fuzz.differ_seldom(paths)
    with pytest.raises(AssertionError, match="60 of 360 colonies in float64"):
        fuzz.differ_seldom(paths + Counter({"float64, other counts, apart": 40}))


def test_hard_contacts_fling_no_cell_through_a_wall():
    """Found by the fuzzer: crossing cells in a corner at α γ = 1e-6, where next to nothing holds
    what no contact does: the exact solve moves them by a micrometre, one to a worst residual of
    0.05 by 30 µm, which took one through the wall by 2.7 µm. A move through a wall is cut.

    Which heap flings a cell hangs on rounding, so that several are tried.
    """
    contacts = fuzz.Contacts(1e-6, 1.0, 1.0, "bilateral", None, "box", 0.3, None)
    farthest = 0.0
    for cells, seed in ((10, 1), (8, 4), (10, 3), (7, 6), (10, 0)):
        bodies = fuzz.Capsules((cells,), 5.0, (2.0, 3.0), (0.5, 0.5), 2, seed)
        draw = fuzz.Draw(
            bodies, contacts, None, None, None, fuzz.Beside(False, None, False), 0.01, 1,
            "float32", 0,
        )  # fmt: skip
        assert fuzz.run(draw) == "ran"
        scene, start = fuzz.scene_of(draw)
        state = step(tf.Settings(tolerance=0.05).apply(scene), start, 0.01)
        moved = float(state.displacement[:, :2].norm(dim=1).max())
        if moved > farthest:
            farthest, clipped = moved, int(state.reports["mechanics"].clipped)
        assert _deepest(scene, start) > 0 and _deepest(scene, state) > -0.5
    assert farthest > 5.0, "a solve must fling a cell"
    assert clipped >= 1


def _deepest(scene, state):
    """The least gap, µm, between a cell's centre and a wall."""
    return min(
        float(s.gap_of_points(state.position, state.own_colony_id)[0].min())
        for s in scene.effects[0].surfaces()
    )
