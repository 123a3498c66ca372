"""Compiled kernels that several processes keep in one folder."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from pathlib import Path

MODULE = """
from torchfilm.kernels.compiling import kernel

@kernel(entry=True)
def total(x):
    s = x[0]
    for i in range(1, x.shape[0]):
        s += x[i]
    return s
"""

CALLBACK = """
import numba
from torchfilm.kernels.compiling import native

def twice(x):
    return 2 * x

made = native(numba.float64(numba.float64), twice)
assert made.ctypes(2.0) == 4.0
"""

FULL = """
import errno
from numba.core import caching

def full(*given):
    raise OSError(errno.ENOSPC, "No space left on device")

caching.IndexDataCacheFile._save_data = full
"""

# Between reading Numba's list and writing it again there is time enough for the other process.
NO_LOCKS = """
import errno, fcntl

def flock(*given):
    raise OSError(errno.ENOSYS, "no locks here")

fcntl.flock = flock
"""

RUN = """
import sys, time
import numpy as np
from numba.core import caching
from summing import total

read = caching.IndexDataCacheFile._load_index
caching.IndexDataCacheFile._load_index = lambda self: (read(self), time.sleep(0.3))[0]
print("ready", flush=True)
sys.stdin.readline()
for name in sys.argv[1:]:
    assert total(np.ones(3, name)) == 3
print(len(total.stats.cache_hits), len(total.stats.cache_misses))
"""


def settings(folder: Path) -> dict[str, str]:
    """Of a process that keeps its kernels in this folder."""
    paths = os.pathsep.join([str(folder), str(Path(__file__).parents[1])])
    return {**os.environ, "XDG_CACHE_HOME": str(folder), "PYTHONPATH": paths}


def test_what_two_processes_compile_at_once_is_all_kept(tmp_path: Path):
    (tmp_path / "summing.py").write_text(MODULE)
    (tmp_path / "run.py").write_text(RUN)

    def begun(*names: str) -> subprocess.Popen:
        command = [sys.executable, str(tmp_path / "run.py"), *names]
        pipe = subprocess.PIPE
        return subprocess.Popen(command, env=settings(tmp_path), stdin=pipe, stdout=pipe, text=True)

    def said(*started: subprocess.Popen) -> list[str]:
        for one in started:
            assert one.stdout is not None and one.stdout.readline() == "ready\n"
        for one in started:
            assert one.stdin is not None
            one.stdin.write("go\n")
            one.stdin.flush()
        return [one.communicate()[0].strip() for one in started]

    names = "float32", "float64", "int64", "int32"
    assert said(begun(*names[:2]), begun(*names[2:])) == ["0 2", "0 2"]
    assert said(begun(*names)) == ["4 0"]


def test_a_file_system_without_locks_is_none_the_worse(tmp_path: Path):
    (tmp_path / "summing.py").write_text(MODULE)
    text = NO_LOCKS + "import numpy as np\nfrom summing import total\nprint(total(np.ones(4)))"
    command = [sys.executable, "-c", text]
    out = subprocess.run(command, env=settings(tmp_path), capture_output=True, text=True)
    assert (out.returncode, out.stdout, out.stderr) == (0, "4.0\n", "")


def test_a_file_that_a_crash_cut_off_is_compiled_again(tmp_path: Path):
    """Functions and callbacks: without a word, and once. Then all is whole again, which is looked
    at after the last damage, and by that damage to what was compiled after the one before."""
    (tmp_path / "summing.py").write_text(MODULE + CALLBACK)
    text = "import numpy as np\nfrom summing import total\nprint(total(np.ones(4)))"
    text += "\nprint(len(total.stats.cache_hits))"
    command = [sys.executable, "-c", text]
    run = lambda: subprocess.run(command, env=settings(tmp_path), capture_output=True, text=True)
    assert run().stdout == "4.0\n0\n" and run().stdout == "4.0\n1\n"
    for suffix, size in itertools.product(("nbi", "nbc"), (0, 100)):
        files = list(tmp_path.rglob(f"*.{suffix}"))
        assert len(files) == 2
        for file in files:
            file.write_bytes(file.read_bytes()[:size])
        again = run()
        assert (again.returncode, again.stdout, again.stderr) == (0, "4.0\n0\n", ""), (suffix, size)
    assert run().stdout == "4.0\n1\n"


def test_a_full_disk_costs_only_what_is_kept(tmp_path: Path):
    """It is said once, with the folder and what to do."""
    (tmp_path / "summing.py").write_text(MODULE + CALLBACK)
    text = FULL + "import numpy as np\nfrom summing import total\nprint(total(np.ones(4)))"
    command = [sys.executable, "-c", text]
    out = subprocess.run(command, env=settings(tmp_path), capture_output=True, text=True)
    assert (out.returncode, out.stdout) == (0, "4.0\n")
    assert out.stderr.count("could not keep") == 1 and "XDG_CACHE_HOME" in out.stderr


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path):
    (tmp_path / "summing.py").write_text(MODULE)
    (tmp_path / "file").touch()
    text = "from torchfilm.kernels.compiling import first_call\nwith first_call('a', 'b'): pass"
    env = settings(tmp_path) | {"XDG_CACHE_HOME": str(tmp_path / "file")}
    out = subprocess.run([sys.executable, "-c", text], env=env, capture_output=True, text=True)
    assert "compiling b, in each process" in out.stderr
    assert str(tmp_path / "file") in out.stderr and "XDG_CACHE_HOME" in out.stderr
