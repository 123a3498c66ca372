"""Compiled contacts and those of torch take the same steps; compiled ones give the same bits on any
number of threads and in any batch.

The two paths add in different orders. In float64, solved to 1e-6 of the contact forces, they differ
by rounding, 1e-16 of numbers up to 1e2, times what the solve amplifies: 1/(α μ L) and the condition
of the Newton systems, 1e4 together. So 1e-9 µm and rad is far above rounding, and far below any
effect of another rule.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from mock_cuda import pretended_cuda  # noqa: F401

import torchfilm as tf
from torchfilm.kernels import compiling
from torchfilm.kernels.scheme import LONG_MOVES
from torchfilm.physics import compiled
from torchfilm.tools import numba_calls

F64 = torch.float64
FILM = [tf.Plane(z=-0.5, facing="+z", stiffness=16.0), tf.Plane(z=0.5, facing="-z")]

SETS = {
    "free growth in the plane": (2, {}),
    "pressure in the plane": (2, {"length_drag": 10.0}),
    "little drag on length": (2, {"length_drag": 1.0, "viscosity": 0.1}),
    "between agarose and coverslip": (3, {"walls": FILM}),
    "in space": (3, {"length_drag": 10.0}),
    "a channel": (2, {"walls": [tf.Channel(5.0, low_end=-9.0, high_end=9.0)]}),
    "a box in space": (3, {"walls": [tf.Box(low=(-4, -4, -1.5), high=(4, 4, 1.5))]}),
    "in a ball": (3, {"walls": [tf.Sphere((0.0, 0.0, 0.0), 4.5, inside=True)]}),
    "around a post": (2, {"walls": [tf.Sphere((0.0, 3.0), 2.0, inside=False)]}),
    "soft cells": (2, {"stiffness": 50.0}),
    "α given, nearly hard": (2, {"alpha": 1e-6, "length_drag": 10.0}),
    "α given": (2, {"alpha": 0.05, "length_drag": 10.0}),
    "a drag for each cell": (2, {"length_drag": tf.LogNormal(1e3, 1.0)}),
    "sub-steps": (2, {"max_elongation": 0.04}),
}


def model(name: str, backend: str, colonies: int = 2, dtype=F64, **more):
    dim, given = SETS[name]
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(2.5, 3.5)),
        tf.Mechanics(dim=dim, backend=backend, **{"tolerance": 1e-6, **given, **more}),
        dt=0.05,
    )
    return scene.bind(colonies, seed=4, dtype=dtype)


@pytest.mark.parametrize("name", SETS)
def test_both_paths_take_the_same_steps(name):
    fast, plain = model(name, "compiled"), model(name, "torch")
    state = fast.start()
    for _ in range(90):
        state = fast.step(state, 0.05)
        if state.cells >= 2 * 24:
            break
    assert state.cells >= 2 * 8, "too few cells: the comparison would prove little"
    for _ in range(3):
        one, other = fast.step(state, 0.05), plain.step(state, 0.05)
        for field in ("position", "axis", "length", "displacement"):
            difference = (getattr(one, field) - getattr(other, field)).abs().max()
            assert float(difference) <= 1e-9, (field, float(difference))
        a, b = one.reports["mechanics"], other.reports["mechanics"]
        assert float((one.contact_alpha / other.contact_alpha - 1).abs().max()) <= 1e-6
        torch.testing.assert_close(a.alpha, b.alpha, rtol=1e-6, atol=0.0)
        assert a.status.tolist() == b.status.tolist() == [0, 0]
        for count in ("passes", "clipped", "deeply_overlapping", "substeps"):
            assert getattr(a, count).tolist() == getattr(b, count).tolist(), count
        state = one
    assert (a.iterations > 0).any(), "nothing pushed: the comparison would prove nothing"


def test_both_paths_take_the_same_late_passes():
    """60 rods thrown into one another: later passes move more cells, those less far, and with more
    drag.

    So many passes multiply what rounding leaves by 1e3 or so.
    """
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(60, 2))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    founders = tf.Cells(9.0 * rng.random((60, 2)), axis, 2.0)
    ends = []
    for backend in ("compiled", "torch"):
        scene = tf.Scene(
            tf.Mechanics(dim=2, backend=backend, tolerance=1e-6), founders=founders, dt=0.05
        )
        bound = scene.bind(1, dtype=F64)
        ends.append(bound.step(bound.start(), 0.05))
    one, other = (end.reports["mechanics"] for end in ends)
    assert int(one.passes) == int(other.passes) > LONG_MOVES + 1
    assert int(one.clipped) == int(other.clipped)
    assert float((ends[0].position - ends[1].position).abs().max()) <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_the_number_of_threads_and_the_batch_change_no_bit(dim, monkeypatch):
    """More colonies than threads, of several sizes; then some of them alone, in another order."""
    scene = tf.Scene(
        tf.Growth(rate=tf.PerColony(torch.linspace(0.6, 1.4, 12))),
        tf.Division(length=tf.Uniform(2.5, 3.5)),
        tf.Mechanics(dim=dim),
        dt=0.05,
    )
    monkeypatch.setattr(compiled, "WORTH_THREADS", 1)
    before, runs = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 4, 8, 16):
            torch.set_num_threads(threads)
            *_, last = tf.simulate(scene, until=4.0, colonies=12, seed=3)
            runs.append(last)
    finally:
        torch.set_num_threads(before)
    assert len(set(runs[0].counts.tolist())) > 3
    for other in runs[1:]:
        for field in ("position", "axis", "length", "displacement", "contact_alpha"):
            assert torch.equal(getattr(runs[0], field), getattr(other, field)), field


def test_without_numba_contacts_are_computed_by_torch_and_it_is_said_once(monkeypatch):
    numba_calls.unavailable.cache_clear()
    loaded = [name for name in sys.modules if name.startswith("torchfilm.kernels.")]
    for name in (*loaded, "numba"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    try:
        scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), dt=0.05)
        with pytest.warns(RuntimeWarning, match="Numba cannot be imported.*Install numba") as told:
            bound = scene.bind()
        assert [w.filename for w in told] == [__file__]
        assert bound.step(bound.start(), 0.05).cells == 1
        scene.bind()  # no second warning: warnings are errors here
        with pytest.raises(tf.InputError, match="backend = 'compiled', but Numba"):
            tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, backend="compiled")).bind()
    finally:
        numba_calls.unavailable.cache_clear()


COMPILE = """
import numpy as np
from torchfilm.kernels import compiling, memory, neighbours
x = np.random.default_rng(0).random((50, 2)) * 20
axis, half, radius = np.tile([1.0, 0.0], (50, 1)), np.ones(50), np.full(50, 0.5)
near_pairs = compiling.for_python(neighbours.near_pairs)
first, second = near_pairs(memory.no_memory(), x, axis, half, radius, np.zeros(3), 0.3, (0,) * 4)
print(compiling.FOLDER is not None, first.size)
"""


def compile_in(cache: Path, count: int) -> list[list[str]]:
    """What `count` processes print that start at once and compile with this cache."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", COMPILE], env=environment, stdout=subprocess.PIPE, text=True
        )
        for _ in range(count)
    ]
    out = [process.communicate(timeout=300)[0].split() for process in started]
    assert all(process.returncode == 0 for process in started)
    return out


@pytest.mark.slow
def test_kernels_compile_where_nothing_can_be_kept(tmp_path):
    (tmp_path / "file").touch()
    ((kept, pairs),) = compile_in(tmp_path / "file", 1)
    assert kept == "False" and int(pairs) > 0


@pytest.mark.slow
def test_two_processes_compile_at_once_and_a_third_finds_what_they_kept(tmp_path):
    one, other = compile_in(tmp_path, 2)
    assert one == other and one[0] == "True"
    (folder,) = (tmp_path / "torchfilm").iterdir()
    kept = {file.name: file.stat().st_mtime_ns for file in folder.rglob("*.nb?")}
    assert any(name.endswith(".nbc") for name in kept)
    assert compile_in(tmp_path, 1) == [one]
    assert kept == {file.name: file.stat().st_mtime_ns for file in folder.rglob("*.nb?")}


def test_kernels_that_nobody_uses_are_removed(tmp_path, monkeypatch):
    """By a new version, and only those of this package; two processes at once, or a home where
    nothing can be removed, do no harm."""
    home, old = tmp_path / "torchfilm", time.time() - 31 * 86400
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in ("kernels-unused", "kernels-used", "mine"):
        (home / name / "__pycache__").mkdir(parents=True)
    for name in ("kernels-unused", "mine"):
        os.utime(home / name, (old, old))
    found = compiling.cache_folder()
    assert {f.name for f in home.iterdir()} == {"kernels-used", "mine", found.name}
    os.utime(found, (old, old))
    assert compiling.cache_folder() == found and found.stat().st_mtime > old + 86400
    # it was there: another look removes nothing
    os.utime(home / "kernels-used", (old, old))
    compiling.cache_folder()
    assert (home / "kernels-used").exists()


def test_only_a_folder_of_the_user_keeps_kernels(tmp_path, monkeypatch):
    """None that goes by the current directory: a relative XDG_CACHE_HOME is to be ignored, and
    without a home "~" stays as it is."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")
    found = compiling.cache_folder()
    assert found.parent == tmp_path / "home" / ".cache" / "torchfilm"
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    assert compiling.cache_folder() is None
    assert [f.name for f in tmp_path.iterdir()] == ["home"]


def test_a_place_may_have_a_name_that_is_no_text(monkeypatch):
    monkeypatch.setattr(compiling, "__file__", os.fsdecode(b"/\xff/compiling.py"))
    assert len(compiling._digest()) == 16


def test_kernels_that_cannot_be_removed_stay(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    unused = tmp_path / "torchfilm" / "kernels-unused"
    unused.mkdir(parents=True)
    os.utime(unused, (0, 0))

    def refuse(self, target):
        raise PermissionError  # as a file system does that is read-only, and a second process finds

    monkeypatch.setattr(Path, "rename", refuse)
    assert compiling.cache_folder() is not None
    assert unused.exists()


def two_cells(apart: float, backend: str, **extra) -> tuple[tf.Scene, tf.State]:
    cells = tf.Cells([[0.0, 0.0], [0.0, apart]], [[1.0, 0.0]] * 2, 2.0, extra=extra)
    scene = tf.Scene(tf.Growth(rate=0.0), tf.Mechanics(dim=2, backend=backend), founders=cells)
    return scene, scene.bind(dtype=F64).start()


@pytest.mark.parametrize("backend", ["compiled", "torch"])
@pytest.mark.parametrize("name", ["displacement", "drag"])
@pytest.mark.parametrize("apart", [0.8, 9.0])
def test_what_is_no_number_fails_its_colony(backend, name, apart):
    scene, state = two_cells(apart, backend, drag=[1.0, 1.0])
    broken = state.fields[name].clone()
    broken[0] = float("nan")
    with pytest.raises(tf.SimulationError, match=r"colony 0 .*is not (above 0 and )?finite"):
        list(tf.simulate(scene, state.with_fields(**{name: broken}), until=0.05, dt=0.025))


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_cell_that_nothing_pushes_any_more_stops(backend):
    """However fast it was."""
    scene, state = two_cells(9.0, backend)
    moved = state.displacement.clone()
    moved[:, 0] = 1.5
    state = state.with_fields(displacement=moved)
    after = scene.bind(state=state).step(state, 0.025)
    assert torch.equal(after.position, state.position)
    assert float(after.displacement.abs().max()) == 0.0


@pytest.mark.parametrize("where", ["cpu", "cuda"])
def test_a_colony_in_torch_does_not_depend_on_the_others(pretended_cuda, where):  # noqa: F811
    """Hard contacts, of which some take many rounds: each colony has the bits that it has alone."""
    fast, plain = (
        model("α given, nearly hard", backend, colonies=4, tolerance=0.07)
        for backend in ("compiled", "torch")
    )
    state = fast.start()
    for _ in range(60):
        state = fast.step(state, 0.05)
    state = state.to(where)
    model_ = plain.scene.bind(state=state)
    last = model_.step(state, 0.05)
    for k in range(4):
        alone = model_.step(state.select([k]), 0.05)
        for field in ("position", "axis", "length", "displacement", "contact_alpha"):
            assert torch.equal(getattr(alone, field), getattr(last.select([k]), field)), (k, field)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_free_growth_is_no_stock_of_length_that_pressure_may_take(backend):
    """A cell may become shorter by a share of its whole length than it once was; what it has grown
    by before does not add to that."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2, backend=backend), dt=0.05)
    model = scene.bind(dtype=F64)
    start = state = model.start()
    for _ in range(5):
        state = model.step(state)
    assert float(state.length) > float(start.length) + 0.5
    assert state.compression.tolist() == [0.0]
