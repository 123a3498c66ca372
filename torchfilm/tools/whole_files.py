"""Files that come to be there whole: written under another name, and put in place at the end."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOCKED = (errno.EAGAIN, errno.EACCES)


def why_not_written(error: BaseException) -> str:
    """What may be wrong where HDF5 could not write, as a sentence."""
    if (isinstance(error, OSError) and error.errno in LOCKED) or "unable to lock" in str(error):
        return "Another process has the file open: give each process a file of its own."
    if isinstance(error, MemoryError) or "memory" in str(error).lower():
        return "The process is out of memory: grow fewer colonies at once, or smaller ones."
    return "Is the disk full?"


@contextmanager
def telling(path: Path) -> Iterator[None]:
    """Raise SimulationError where something cannot be written for `path`."""
    from torchfilm.tools.checks import SimulationError  # it offers `write_whole` itself

    try:
        yield
    except OSError as error:
        if not path.parent.is_dir():
            why = f"Make the folder {path.parent} first."
        elif not os.access(path.parent, os.W_OK):
            why = f"The folder {path.parent} may not be written to."
        else:
            why = why_not_written(error)
        raise SimulationError(f"could not write {path}: {error}. {why}") from error


def umask() -> int:
    """What the process leaves out of the permissions of new files."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Where to write a file, beside `path` and with its suffix, which it replaces at the end. An
    error or a kill before leaves what was at `path`. Raises SimulationError where the file cannot
    be written."""
    with telling(path):
        # of a name at which nobody can have put a file, or a link to one
        number, name = tempfile.mkstemp(f".new{path.suffix}", f".{path.stem}.", path.parent)
        os.close(number)
        beside = Path(name)
        try:
            yield beside
            beside.chmod(path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~umask())
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text file whole, in place of an older one. Raises SimulationError where it cannot be
    written."""
    with written_whole(path) as beside:
        beside.write_text(text, encoding="utf-8", newline="")
