"""Files that come to be there whole: written under another name, and put in place at the end."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCKED = (errno.EAGAIN, errno.EACCES)
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def why_not_written(error: BaseException) -> str:
    """What may be wrong where HDF5 could not write, as a sentence."""
    if (isinstance(error, OSError) and error.errno in LOCKED) or "unable to lock" in str(error):
        return "Another process has the file open: give each process a file of its own."
    if isinstance(error, MemoryError) or "memory" in str(error).lower():
        return "The process is out of memory: grow fewer colonies at once, or smaller ones."
    return "Is the disk full?"


@contextmanager
def telling(path: Path) -> Iterator[None]:
    """Raise SimulationError where something cannot be written for `path`, and InputError where its
    folder does not exist."""
    from torchfilm.tools.checks import SimulationError, input_error  # it offers `write_whole`

    if not path.parent.is_dir():
        hint = f"Make {path.parent} first."
        raise input_error("path", str(path), "in a folder that exists", hint)
    try:
        yield
    except OSError as error:
        if path.is_dir():
            why = " There is a folder of this name."
        elif not os.access(path.parent, os.W_OK):
            why = f" The folder {path.parent} may not be written to."
        else:
            why = " Is the disk full?" if error.errno in FULL else ""
        raise SimulationError(f"could not write {path}: {error}.{why}") from error


def beside(path: Path, ending: str = "") -> Path:
    """A path in the same folder, of a name at which nobody can have put a file or a link to one,
    with the same suffix."""
    return path.with_name(f".tf-{secrets.token_hex(8)}{ending}{path.suffix}")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Where to write a file, beside `path` and with its suffix, which it replaces at the end. An
    error or a kill before leaves what was at `path`. A link stays, and what it leads to is
    replaced; a device or pipe is written to. Raises SimulationError where the file cannot be
    written."""
    with telling(path):
        target = path.resolve()
        if target.exists() and not target.is_file() and not target.is_dir():
            yield target
            return
        if target.exists() and not os.access(target, os.W_OK):
            raise PermissionError(errno.EACCES, "it may not be written to")
        new = beside(target)
        # exclusive; the system takes off what the process leaves out of permissions
        os.close(os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        try:
            yield new
            if target.exists():
                with suppress(OSError):  # some file systems know no modes
                    new.chmod(target.stat().st_mode & 0o777)
            os.replace(new, target)
        finally:
            new.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text file whole, in place of an older one. Raises SimulationError where it cannot be
    written."""
    with written_whole(path) as new:
        new.write_text(text, encoding="utf-8", newline="")
