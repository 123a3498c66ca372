"""How much memory a batch may take: that which is free, and that which a container leaves."""

from __future__ import annotations

import pytest

from design import memory

MIB = 2**20
NONE = 2**63


def files(folder, names, limit, used, kept):
    folder.mkdir(parents=True, exist_ok=True)
    most, taken, cached = names
    (folder / most).write_text(f"{limit}\n")
    (folder / taken).write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\n{cached} {kept}\nfile 7\n")


@pytest.mark.parametrize(
    ("names", "line", "top"),
    [(memory.GROUP_FILES, "0::", "."), (memory.OLD_GROUP_FILES, "4:memory:", "memory")],
)
def test_the_tightest_group_counts(tmp_path, names, line, top):
    root, listed = tmp_path / "cgroup", tmp_path / "listed"
    ask = lambda: memory.bytes_of_group(root, listed)
    assert ask() == NONE  # nothing is there
    files(root / top, names, 800 * MIB, 300 * MIB, 50 * MIB)
    assert ask() == 550 * MIB  # a container
    listed.write_text(f"9:pids:/other\n{line}/jobs/mine\n")
    assert ask() == 550 * MIB  # and this group is not there
    files(root / top / "jobs" / "mine", names, 200 * MIB, 100 * MIB, 0)
    assert ask() == 100 * MIB  # a job
    files(root / top / "jobs", names, 90 * MIB, 120 * MIB, 1 * MIB)
    assert ask() == 0  # all jobs together have too much
    files(root / top / "jobs", names, "max", 120 * MIB, 1 * MIB)
    assert ask() == 100 * MIB


def test_a_batch_fits_into_what_a_container_leaves(monkeypatch):
    import torch

    most = lambda: memory.max_colonies(1000, 500, torch.float32, "cpu")
    free = memory.free_bytes("cpu")
    monkeypatch.setattr(memory, "bytes_of_group", lambda: free // 20)
    bound = most()
    assert memory.free_bytes("cpu") == free // 20
    each = memory.BYTES_A_CELL * 1000 + memory.BYTES_A_VOXEL * 1000
    assert bound == max(1, int(memory.USE * (free // 20) / each))
