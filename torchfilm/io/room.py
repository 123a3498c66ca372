"""Room on a disk, looked at before a file is written: a disk that fills while HDF5 writes costs the
file, and may end the process."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import h5py

from torchfilm.tools.checks import SimulationError

try:
    import resource
except ImportError:  # not on Windows
    resource = None  # type: ignore[assignment]

SPARE_BYTES = 65536  # that HDF5 may need in addition to the arrays of a frame


def free_bytes(folder: Path, written: int = 0) -> int:
    """How much may be written to a file in this folder, of which there is so much already."""
    free = shutil.disk_usage(folder).free
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0] if resource else -1
    return min(free, limit - written) if limit >= 0 else free


def check_room(path: Path, needed: int, doing: str, then: str, written: int = 0) -> None:
    """Raise SimulationError unless so many bytes fit beside `path`, in a file that has `written`.
    doing: what needs them, as "to copy x.h5"; then: what to do, and what is safe."""
    free = free_bytes(path.parent, written)
    if free < needed + SPARE_BYTES:
        raise SimulationError(
            f"no room {doing}: {free} bytes are free in {path.parent.resolve()}, and it needs"
            f" {needed + SPARE_BYTES}. {then}"
        )


class Room:
    """Room for what is written to an open HDF5 file, which may keep it in memory until it is
    closed."""

    def __init__(self, file: h5py.File, path: Path):
        self.file, self.path, self.pending = file, path, 0

    def claim(self, size: int) -> None:
        """Room for so many bytes more. Raises SimulationError where there is none; then what was
        written before can be closed."""
        written = lambda: os.fstat(self.file.id.get_vfd_handle()).st_size
        if free_bytes(self.path.parent, written()) < self.pending + size + SPARE_BYTES:
            self.file.flush()
            self.pending, then = 0, "Free some space and try again."
            check_room(self.path, size, f"to write {self.path}", then, written())
        self.pending += size
