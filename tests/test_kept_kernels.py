"""Compiled kernels that several processes keep in one folder."""

from __future__ import annotations

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
