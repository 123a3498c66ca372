"""Results files: every way a file can be bad, and bad places to write."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import pytest
from helpers import step
from recorded import DT, UNTIL, assert_same_file, assert_same_state, make_scene, record

import torchfilm as tf
from torchfilm.io import recorder

# --- bad files ------------------------------------------------------------------------------------


READ_ALL = """
import sys, torchfilm as tf
for path in sys.argv[1:]:
    try:
        with tf.Results(path) as results:
            for k in range(len(results)):
                results.frame(k)
            results.table()
            results.lineage()
        found = "read to the end"
    except Exception as error:
        found = f"{type(error).__name__}: {error}"
    print(path, found.replace(chr(10), " "), sep="|", flush=True)
"""


def read_all(paths: list[Path], timeout: float) -> dict[str, str]:
    """What a reader says of files, by name. In a process of its own, because it may never come
    back, or end the process."""
    try:
        out = subprocess.run(
            [sys.executable, "-c", READ_ALL, *map(str, paths)],
            capture_output=True,
            text=True,
            timeout=timeout,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            check=False,
        ).stdout
    except subprocess.TimeoutExpired as expired:
        out = (expired.stdout or b"").decode()
    found = dict(line.split("|", 1) for line in out.splitlines())
    return {path.name: found.get(str(path), f"nothing within {timeout} s") for path in paths}


def check_cuts_are_told(data: bytes, shares: list[float], folder: Path) -> None:
    """That each file cut after one of these shares of its bytes is an InputError that names it."""
    paths = [folder / f"cut{int(share * len(data))}.h5" for share in shares]
    for path, share in zip(paths, shares, strict=True):
        path.write_bytes(data[: int(share * len(data))])
    assert not {
        name: said
        for name, said in read_all(paths, 15).items()
        if not (said.startswith("InputError") and name in said)
    }


SHARES = [0.0, 0.001, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99]


@pytest.mark.slow
def test_a_truncated_file_is_reported(whole, tmp_path):
    """Cut anywhere, a file says so: no crash with something unreadable, no endless wait, no half of
    the data."""
    check_cuts_are_told(whole[0].read_bytes(), SHARES, tmp_path)


@pytest.mark.slow
def test_a_file_of_a_few_bytes_is_reported(whole, tmp_path):
    """Found in use: with not even its superblock left, a file was waited for, or said nothing that
    helps."""
    data = whole[0].read_bytes()
    sizes = (0, 1, 8, 9, 12, 20, 28, 29, 47, 48, 60)
    check_cuts_are_told(data, [(n + 0.5) / len(data) for n in sizes], tmp_path)


@pytest.mark.slow
def test_a_truncated_file_left_by_a_kill_is_reported(tmp_path):
    """As above for a file that its writer never closed, as it is while a run goes on, copied in
    part."""
    path, scene = tmp_path / "open.h5", make_scene()
    run = tf.simulate(
        scene, scene.bind(3, seed=11).start(), until=UNTIL, record=tf.Recorder(path, scene, every=1)
    )
    for _ in range(50):
        next(run)
    data = path.read_bytes()
    run.close()
    check_cuts_are_told(data, SHARES, tmp_path)


@pytest.mark.slow
def test_damaged_bytes_are_reported_or_do_no_harm(whole, tmp_path):
    """Found in use: where the index of a column was damaged, a finished file was read again and
    again without end; where a block was, h5py spoke for itself."""
    data, damaged = whole[0].read_bytes(), []
    for k in range(60):
        at = (2 * k + 1) * len(data) // 120
        path = tmp_path / f"damaged{at}.h5"
        path.write_bytes(data[:at] + bytes(b ^ 0x5A for b in data[at : at + 8]) + data[at + 8 :])
        damaged.append(path)
    told = [said for said in read_all(damaged, 60).values() if said != "read to the end"]
    assert len(told) >= 3 and all(said.startswith("InputError") for said in told), told


def test_a_foreign_hdf5_file_is_reported(tmp_path):
    path = tmp_path / "foreign.h5"
    with h5py.File(path, "w") as file:
        file["x"] = [1.0, 2.0]
    with pytest.raises(tf.InputError, match=r"foreign\.h5 is not a torchfilm results file"):
        tf.Results(path)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "torchfilm results"
    with pytest.raises(tf.InputError, match=r"foreign\.h5"):
        tf.Results(path)


def test_a_text_file_and_no_file_are_reported(tmp_path):
    path = tmp_path / "text.h5"
    path.write_text("cells, frames and other words\n" * 100)
    with pytest.raises(tf.InputError, match=r"text\.h5.*not a results file"):
        tf.Results(path)
    with pytest.raises(tf.InputError, match=r"missing\.h5.*No such file"):
        tf.Results(tmp_path / "missing.h5")
    with pytest.raises(tf.InputError):
        tf.Results(tmp_path)


def test_a_file_of_a_newer_format_is_reported(whole, tmp_path):
    path = tmp_path / "new.h5"
    shutil.copy(whole[0], path)
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 99
    with pytest.raises(tf.InputError, match=r"99.*Update"):
        tf.Results(path)


def test_a_file_with_no_finished_frame_is_reported(whole, tmp_path):
    path = tmp_path / "empty.h5"
    shutil.copy(whole[0], path)
    with h5py.File(path, "r+") as file:
        file["frames/step"].resize(0, axis=0)
    with pytest.raises(tf.InputError, match="no finished frame"):
        tf.Results(path)


# --- bad places to write --------------------------------------------------------------------------


def test_an_existing_file_is_not_overwritten_unasked(whole, tmp_path):
    path, scene = tmp_path / "run.h5", make_scene()
    shutil.copy(whole[0], path)
    words = r"record=tf\.Recorder\(path, scene, overwrite=True\)"
    with pytest.raises(tf.InputError, match=words) as caught:
        tf.Recorder(path, scene)
    assert "--" not in str(caught.value), "in Python there are no options of the command line"
    with pytest.raises(tf.InputError, match=words):
        tf.simulate(scene, scene.bind().start(), until=1.0, record=path)
    assert_same_file(whole[0], path)
    record(scene, scene.bind().start(), path, until=0.1, overwrite=True)
    with tf.Results(path) as results:
        assert results.steps.tolist() == [0, 2]


def test_a_run_that_cannot_start_leaves_the_old_file_alone(whole, tmp_path):
    """Overwriting begins with the first frame: a scene that is refused before must not cost the old
    results."""
    path, scene = tmp_path / "run.h5", make_scene()
    shutil.copy(whole[0], path)
    recorder = tf.Recorder(path, scene, overwrite=True)
    with pytest.raises(tf.InputError):
        list(tf.simulate(scene, scene.bind().start(), until=-1.0, record=recorder))
    assert_same_file(whole[0], path)


def test_bad_places_and_intervals_are_reported(tmp_path):
    scene = make_scene()
    with pytest.raises(tf.InputError, match="folder that exists"):
        tf.Recorder(tmp_path / "nowhere" / "run.h5", scene)
    with pytest.raises(tf.InputError, match="No such file"):
        tf.Recorder(tmp_path / "run.h5", scene, append=True)
    with pytest.raises(tf.InputError):
        tf.Recorder(tmp_path, scene)
    for every in (0, -1, 1.5, True):
        with pytest.raises(tf.InputError, match="every"):
            tf.Recorder(tmp_path / "run.h5", scene, every=every)


def test_a_folder_in_the_place_of_the_file_is_reported(tmp_path):
    with pytest.raises(tf.InputError, match=r"folder\.h5"):
        scene = make_scene()
        (tmp_path / "folder.h5").mkdir()
        record(scene, scene.bind().start(), tmp_path / "folder.h5", until=0.1, overwrite=True)


def test_a_full_disk_is_reported_and_loses_no_frame(tmp_path, monkeypatch, every_step):
    """Writing fails with ENOSPC from the 20th frame on; after that there is room again."""
    path, scene = tmp_path / "run.h5", make_scene()
    real, full = recorder.write_rows, []

    def write(table, at, value):
        if full:
            raise OSError(28, "No space left on device")
        return real(table, at, value)

    monkeypatch.setattr(recorder, "write_rows", write)
    run = tf.simulate(
        scene, scene.bind(3, seed=11).start(), until=UNTIL, record=tf.Recorder(path, scene, every=1)
    )
    for _ in range(20):
        next(run)
    full.append(True)
    with pytest.raises(tf.SimulationError, match=r"run\.h5.*No space left.*step 20") as caught:
        next(run)
    assert "\n" not in str(caught.value)
    full.clear()
    with tf.Results(path) as results:
        assert results.steps.tolist() == list(range(21))
        state = results.state(scene)
    record(scene, state, path, every=1, append=True)
    assert_same_file(every_step[0], path)


@pytest.mark.parametrize(
    "column",
    [
        "cells/uid",
        "lineage/births/uid",
        "frames/first_row",
        "frames/counts",
        "frames/time",
        "frames/step",
    ],
)
@pytest.mark.parametrize(
    "failure", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["disk", "Ctrl-C"]
)
def test_a_frame_broken_off_at_any_column_is_no_frame(
    tmp_path, monkeypatch, every_step, column, failure
):
    """Writing breaks off once, somewhere in the 20th frame: no frame may hold half of it, and what
    is resumed is whole."""
    path, scene = tmp_path / "run.h5", make_scene()
    real, armed = recorder.write_rows, []

    def write(table, at, value):
        if armed and table.name == f"/{column}":
            armed.clear()
            raise failure
        return real(table, at, value)

    monkeypatch.setattr(recorder, "write_rows", write)
    run = tf.simulate(
        scene, scene.bind(3, seed=11).start(), until=UNTIL, record=tf.Recorder(path, scene, every=1)
    )
    state = None
    while state is None or state.step < 19:
        state = next(run)
    while not step(scene, state, DT).births:  # a step with births, so that lineage is written too
        state = next(run)
    armed.append(True)
    with pytest.raises((tf.SimulationError, KeyboardInterrupt)):
        next(run)
    assert not armed, "nothing was broken off"
    with tf.Results(path) as results:
        assert (
            results.steps.tolist() == list(range(len(results))) and len(results) >= state.step + 1
        )
        resumed = results.state(scene)
    record(scene, resumed, path, every=1, append=True)
    assert_same_file(every_step[0], path)


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (120_000, 120_000))
import torchfilm as tf
from recorded import make_scene
scene = make_scene()
try:
    recorder = tf.Recorder(sys.argv[1], scene, every=1)
    for _ in tf.simulate(scene, colonies=3, seed=11, until=3.0, record=recorder):
        pass
except tf.SimulationError as error:
    print(error)
    sys.exit(7)
"""


@pytest.mark.slow
def test_a_file_that_can_really_grow_no_further(tmp_path, every_step):
    """The system refuses to write beyond 120 kB: HDF5's own caches are involved, unlike above."""
    path = tmp_path / "run.h5"
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(path)],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.path.dirname(__file__)},
    )
    assert done.returncode == 7, (done.returncode, done.stdout, done.stderr[-2000:])
    assert "run.h5" in done.stdout
    scene = make_scene()
    with tf.Results(path) as results:
        assert len(results) >= 1
        state = results.state(scene)
    assert f"step {state.step}" in done.stdout, "the message tells which frames are safe"
    assert_same_state(state, every_step[1][state.step])
    record(scene, state, path, every=1, append=True)
    assert_same_file(every_step[0], path)


SMALL_DISK = """
import os, shutil, subprocess, sys
import torchfilm as tf
from recorded import make_scene
disk, out = sys.argv[1:]
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", disk], check=True)
path, scene, done = os.path.join(disk, "run.h5"), make_scene(), 0
try:
    recorder = tf.Recorder(path, scene, every=1)
    for state in tf.simulate(scene, colonies=3, seed=11, until=3.0, record=recorder):
        done = state.step
    print("the run ended as if nothing had happened")
except tf.SimulationError as error:
    print("told" if "run.h5" in str(error) else error)
with tf.Results(path) as results:
    whole = results.steps.tolist() == list(range(len(results))) and 1 <= len(results) <= done + 2
    print("frames whole" if whole else f"frames {results.steps}")
subprocess.run(["mount", "-o", "remount,size=20m", disk], check=True)
with tf.Results(path) as results:
    state = results.state(scene)
recorder = tf.Recorder(path, scene, every=1, append=True)
for _ in tf.simulate(scene, state, until=3.0, record=recorder):
    pass
shutil.copy(path, out)
print("resumed")
"""


@pytest.mark.slow
def test_a_disk_that_is_really_full(tmp_path, every_step):
    """A disk of 200 kB of its own, where the system lets us make one: what fails there is the
    writing of HDF5's caches, which is late and easily missed. The run must stop and say so, the
    frames before must be whole, and with more room it must go on.
    """
    private = ["unshare", "-Urm"]
    trial = [*private, "sh", "-c", f"mount -t tmpfs -o size=200k tmpfs {tmp_path}"]
    if (
        shutil.which("unshare") is None
        or subprocess.run(trial, capture_output=True, check=False).returncode
    ):
        pytest.skip(
            "needs the right to mount a file system: `unshare -Urm` and `mount -t tmpfs` on Linux"
        )
    (tmp_path / "disk").mkdir()
    done = subprocess.run(
        [
            *private,
            sys.executable,
            "-c",
            SMALL_DISK,
            str(tmp_path / "disk"),
            str(tmp_path / "run.h5"),
        ],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.path.dirname(__file__)},
    )
    assert done.stdout.splitlines() == ["told", "frames whole", "resumed"], (
        done.returncode,
        done.stdout,
        done.stderr[-1000:],
    )
    assert_same_file(every_step[0], tmp_path / "run.h5")


def test_a_state_needs_its_scene_first(tmp_path):
    scene = make_scene()
    record(scene, scene.bind().start(), tmp_path / "run.h5", until=DT)
    words = r"scene = -1.*results\.state\(scene, frame\), or results\.state\(frame=…\)"
    with tf.Results(tmp_path / "run.h5") as results, pytest.raises(tf.InputError, match=words):
        results.state(-1)


@pytest.mark.parametrize("name", ["colony.csv", "colony.TXT", "colony.json"])
def test_a_name_of_another_format_is_refused(name, tmp_path):
    with pytest.raises(tf.InputError, match=rf"{name}.*results are HDF5"):
        tf.Recorder(tmp_path / name, make_scene())
