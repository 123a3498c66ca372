"""Work items in other processes and on other machines: the losses have the same bits, and no work
item is lost with its worker."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest
import torch
from searching import Level, lit, spots

import torchfilm as tf
from design import Bands, Local, Objective, Parameter, Polish, Search, Target, Task
from design.executors import run_work_items
from design.scoring import cut_work_items
from design.simulations import simulate_designs

MAKE = Parameter("make", 0.1, 10, log=True)
SPAWN = multiprocessing.get_context("spawn")  # a fork of a process that has run torch may hang


def objective(scene=lit, target: Target | None = None, **options) -> Objective:
    task = Task(
        scene,
        [MAKE, Parameter("decay", 0.5, 2)],
        target or Level(wanted=1.0),
        cells=12,
        replicates=2,
        **options,
    )
    return Objective(task)


POINTS = spots(6, 2)


@pytest.fixture(scope="module")
def here():
    """The losses without an executor."""
    return objective().evaluate(POINTS).losses


@dataclass(frozen=True)
class Deadly(Level):
    """Kills its process in the middle of growth, except the one at home, and only once: a flag file
    records it."""

    flag: str = ""
    home: int = 0

    def note(self, state):
        if state.time > 0.45 and os.getpid() != self.home and not Path(self.flag).exists():
            Path(self.flag).touch()
            os.kill(os.getpid(), signal.SIGKILL)


def deadly(folder) -> Objective:
    return objective(target=Deadly(wanted=1.0, flag=str(folder / "done"), home=os.getpid()))


class OwnError(Exception):
    """It takes two arguments, so that it cannot be unpickled from the one that it keeps."""

    def __init__(self, what, where):
        super().__init__(f"{what} at {where}")


@dataclass(frozen=True)
class Raising(Level):
    """Raises an error of the user's own code, in any process but the one at home."""

    kind: str = ""
    home: int = 0

    def loss(self, state, history=None):
        if os.getpid() != self.home:
            raise {
                "value": ValueError("no such level"),
                "os": FileNotFoundError("no such table"),
                "own": OwnError("lost", "sea"),
            }[self.kind]
        return super().loss(state, history)


@pytest.fixture(scope="module")
def processes():
    with ProcessPoolExecutor(
        2, mp_context=SPAWN, initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        yield pool


@pytest.fixture(scope="module")
def dask():
    from distributed import LocalCluster

    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as cluster,
        cluster.get_client() as client,
    ):
        yield client.get_executor()


class Careless(Executor):
    """Loses the first submitted work items, as if their workers had died, and runs the others."""

    def __init__(self, losses: int, error: Exception):
        self.losses, self.error, self.given = losses, error, 0

    def submit(self, fn, /, *args, **kwargs):
        self.given += 1
        future: Future = Future()
        if self.given <= self.losses:
            future.set_exception(self.error)
        else:
            future.set_result(fn(*args, **kwargs))
        return future


class Pickling(Executor):
    """Runs work items here, as copies that went through pickle."""

    def submit(self, fn, /, *args, **kwargs):
        future: Future = Future()
        fn, args = pickle.loads(pickle.dumps((fn, args)))
        future.set_result(pickle.loads(pickle.dumps(fn(*args, **kwargs))))
        return future


@pytest.mark.parametrize("method", ["auto", Polish(after=4, starts=2), Local(starts=2, first=8)])
def test_searches_that_descend_find_the_same_in_other_processes(method):
    edges = Bands(("gfp",), (-4.0, 4.0), floor=0.5)
    search = lambda: Search(lit, [MAKE], edges, cells=8, replicates=1, method=method, finals=None)
    one, two = search(), search()
    one.run(70, progress=False)
    two.run(70, executor=Pickling(), work_items=2, progress=False)
    assert any(e.slopes is not None for e in one.study.entries)
    pairs = zip(one.study.entries, two.study.entries, strict=True)
    assert all(np.array_equal(a.losses, b.losses) for a, b in pairs)


RUN = "objective().evaluate(points, executor=pool)"
AS_SCRIPT = "__name__ == '__main__'"


@pytest.mark.parametrize(
    "name, text, spec, allowed",
    [
        ("__main__", RUN, None, False),
        ("__main__", f"if {AS_SCRIPT}:\n    {RUN}", None, True),
        ("__main__", f"{RUN} if {AS_SCRIPT} else None", None, True),
        ("__main__", f"try:\n    if {AS_SCRIPT}:\n        {RUN}\nfinally:\n    pass", None, True),
        ("__main__", f"def f():\n    if {AS_SCRIPT}:\n        pass\n{RUN}", None, False),
        ("__main__", RUN, "package.__main__", True),  # which workers do not import
        ("__main__", RUN, "package.script", False),
        ("__mp_main__", RUN, None, False),
        ("another", RUN, None, True),
    ],
)
def test_a_script_that_every_worker_would_run_is_refused(tmp_path, name, text, spec, allowed):
    script = tmp_path / "script.py"
    script.write_text(text)
    spec = None if spec is None else ModuleSpec(spec, None)
    pool = ProcessPoolExecutor(1, mp_context=SPAWN)
    pool.shutdown()  # it starts no process
    given = {"objective": objective, "points": POINTS[:1], "pool": pool}
    run = lambda: exec(
        compile(script.read_text(), str(script), "exec"),
        {"__name__": name, "__file__": str(script), "__spec__": spec, **given},
    )
    if allowed:
        with pytest.warns(RuntimeWarning, match="lost 1 of 1"):
            run()
        return
    with pytest.raises(tf.InputError, match='if __name__ == "__main__"'):
        run()


def test_a_pool_that_forks_is_refused():
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork"))
    with pytest.raises(tf.InputError, match="spawn"):
        objective().evaluate(POINTS[:1], executor=pool)
    with pytest.raises(tf.InputError, match="spawn"):
        simulate_designs(objective().task, 2, executor=pool)


GONE = [
    BrokenExecutor("a child ended"),
    CancelledError(),
    TimeoutError("no answer"),
    ConnectionResetError("no line"),
    RuntimeError("4 workers died"),
]


@pytest.mark.parametrize("error", GONE, ids=lambda e: type(e).__name__)
def test_a_lost_work_item_is_submitted_again(here, error):
    careless = Careless(4, error)
    assert np.array_equal(
        objective().evaluate(POINTS, executor=careless, work_items=3 + 1).losses, here
    )
    assert careless.given == 4 + 4


@pytest.mark.parametrize("error", GONE, ids=lambda e: type(e).__name__)
def test_a_work_item_lost_twice_runs_here_with_a_warning(here, error):
    careless = Careless(1000, error)
    with pytest.warns(
        RuntimeWarning,
        match=f"lost 3 of 3 work items; this process ran them .{type(error).__name__}",
    ):
        found = objective().evaluate(POINTS, executor=careless, work_items=3)
    assert np.array_equal(found.losses, here)
    assert careless.given == 3 * 2


def test_an_executor_that_is_shut_down_loses_everything(here):
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.warns(RuntimeWarning, match="lost 2 of 2 work items"):
        assert np.array_equal(
            objective().evaluate(POINTS, executor=pool, work_items=2).losses, here
        )


def test_every_row_has_one_result(here):
    """A work item that is lost and comes back later than others keeps its rows."""
    task = objective().task
    answered: list[int] = []
    items = cut_work_items(task, [task.space.values(p) for p in POINTS], 2, 1.0, 4)
    careless = Careless(2, CancelledError())
    for item, _ in run_work_items(task, items, (0, 1), 1.0, careless):
        answered += item.rows
    assert sorted(answered) == list(range(6))


@pytest.mark.parametrize("work_items", [1, 3, 6, 20])
def test_threads_give_the_same_losses(here, work_items):
    with ThreadPoolExecutor(3) as pool:
        assert np.array_equal(
            objective().evaluate(POINTS, executor=pool, work_items=work_items).losses, here
        )


def test_an_error_of_the_task_cancels_the_rest():
    """The error is not scored as a loss, and waiting work items are cancelled."""
    begun = threading.Event()

    class Waiting(ThreadPoolExecutor):
        def submit(self, fn, /, *args, **kwargs):
            futures.append(super().submit(lambda: begun.wait(20) and fn(*args, **kwargs)))
            if len(futures) == 6:
                begun.set()
            return futures[-1]

    futures: list[Future] = []
    with Waiting(1) as pool, pytest.raises(FileNotFoundError, match="no such table"):
        objective(target=Raising(wanted=1.0, kind="os")).evaluate(
            POINTS, executor=pool, work_items=6
        )
    assert len(futures) == 6
    assert any(f.cancelled() for f in futures)


@pytest.mark.parametrize(
    "scene, fixed",
    [("boundary_detector", {"width": 16.0}), (tf.scenes.toggle_switch, {"power": 2.0}), (lit, {})],
)
def test_an_objective_survives_pickling(scene, fixed):
    name = {"boundary_detector": "k3", lit: "make"}.get(scene, "strength")
    target = Level({"boundary_detector": "yfp", lit: "gfp"}.get(scene, "red"), 1.0)
    task = Task(scene, [Parameter(name, 0.5, 5)], target, until=0.5, replicates=1, fixed=fixed)
    one = Objective(task)
    two = pickle.loads(pickle.dumps(one))
    assert one.task.describe() == two.task.describe()
    assert np.array_equal(one.evaluate(POINTS[:2, :1]).losses, two.evaluate(POINTS[:2, :1]).losses)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["processes", "dask"])
class TestElsewhere:
    def test_the_bits_are_the_same(self, where, request, here):
        pool = request.getfixturevalue(where)
        for work_items in (2, 5):
            assert np.array_equal(
                objective().evaluate(POINTS, executor=pool, work_items=work_items).losses, here
            )

    @pytest.mark.parametrize(
        "kind, error, words",
        [
            ("os", FileNotFoundError, "no such table"),
            ("own", RuntimeError, "OwnError: lost at sea"),
        ],
    )
    def test_an_error_of_the_task_is_raised_here(self, where, request, kind, error, words):
        pool = request.getfixturevalue(where)
        with pytest.raises(error, match=words) as raised:
            objective(target=Raising(wanted=1.0, kind=kind, home=os.getpid())).evaluate(
                POINTS, executor=pool, work_items=2
            )
        # the traceback of the other process is part of the error
        assert "in loss" in "".join([str(raised.value), *getattr(raised.value, "__notes__", ())])


@pytest.mark.slow
def test_a_scene_that_cannot_be_pickled_is_refused(processes):
    def mine(make=1.0, decay=1.0):
        return lit(make, decay)

    with pytest.raises(tf.InputError, match=r"mine.* top level of a module"):
        objective(mine).evaluate(POINTS, executor=processes, work_items=2)


@pytest.mark.slow
def test_dask_pickles_local_functions(dask, here):
    assert np.array_equal(
        objective(lambda make=1.0, decay=1.0: lit(make, decay))
        .evaluate(POINTS, executor=dask, work_items=2)
        .losses,
        here,
    )


@pytest.mark.slow
def test_a_killed_process_breaks_the_pool_and_no_work_is_lost(here, tmp_path):
    """A broken pool of the standard library accepts no more work: this process runs the rest."""
    with (
        ProcessPoolExecutor(1, mp_context=SPAWN) as pool,
        pytest.warns(RuntimeWarning, match="BrokenProcessPool"),
    ):
        found = deadly(tmp_path).evaluate(POINTS, executor=pool, work_items=3)
    assert (tmp_path / "done").exists()
    assert np.array_equal(found.losses, here)


@pytest.mark.slow
def test_dask_moves_the_work_of_a_killed_worker(dask, here, tmp_path):
    found = deadly(tmp_path).evaluate(POINTS, executor=dask, work_items=4)
    assert (tmp_path / "done").exists()
    assert np.array_equal(found.losses, here)
