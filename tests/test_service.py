"""torchfilm inside another program: forks, threads that search, torch's default device."""

from __future__ import annotations

import subprocess
import sys
import threading
import warnings
from pathlib import Path

import pytest
import torch

import torchfilm as tf
from design.quiet import alone_and_quiet

FORKED = """
import os, sys, warnings
import torch, torchfilm as tf
torch.set_num_threads(2)
torch.ones(2_000_000).exp().sum()                       # torch starts its threads
scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2))
run = lambda: list(tf.simulate(scene, cells=40, colonies=30))[-1]
wanted = run()
model = scene.bind(colonies=30)
first = model.start()
child = os.fork()
if child == 0 and sys.argv[1] == "bind":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = scene.bind(colonies=2).start()
    os._exit(0 if made.cells == 2 and torch.get_num_threads() == 1 else 3)
if child == 0 and sys.argv[1] == "step":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.step(first)
    torch.ones(2_000_000).exp().sum()
    os._exit(0)
if child == 0:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = run()
    torch.ones(2_000_000).exp().sum()
    good = torch.equal(found.position, wanted.position) and torch.get_num_threads() == 1
    os._exit(0 if good and "was forked" in str(said[0].message) else 3)
_, status = os.waitpid(child, 0)
sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
@pytest.mark.parametrize("how", ["run", "step", "bind"])
def test_a_fork_computes_in_one_thread_and_says_so(how):
    done = subprocess.run([sys.executable, "-c", FORKED, how], capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr.decode()


def test_threads_leave_the_filters_of_warnings_as_they_were():
    """Each would put back what it found, also what another one had changed meanwhile."""
    before, begin = list(warnings.filters), threading.Barrier(4)

    def work():
        begin.wait()
        for _ in range(200):
            with alone_and_quiet():
                warnings.warn("nothing that matters", stacklevel=1)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert warnings.filters == before


def test_another_default_device_is_refused_by_name():
    torch.set_default_device("meta")
    try:
        with pytest.raises(tf.InputError, match=r"default device is meta.*device='cuda'"):
            tf.Growth(rate=tf.Uniform(1.0, 2.0))
    finally:
        torch.set_default_device(None)


def test_results_close(tmp_path):
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2)
    list(tf.simulate(scene, until=0.2, dt=0.1, record=tmp_path / "run.h5"))
    results = tf.Results(tmp_path / "run.h5")
    results.close()
    results.close()
    assert "closed" in repr(results)


def test_types_are_there_for_other_programs():
    root = Path(tf.__file__).parent
    assert (root / "py.typed").exists() and (root.parent / "design" / "py.typed").exists()
