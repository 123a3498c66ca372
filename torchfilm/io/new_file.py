"""New files and folders for other programs: where they may be written, and how they come to be
there whole."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from torchfilm.tools import checks
from torchfilm.tools.whole_files import beside, telling


def check_new_file(
    path: str | Path, suffixes: tuple[str, ...], overwrite: bool, source: Path
) -> Path:
    """The path of a file to be made from the results `source`. Raises InputError for another
    suffix, for a folder that does not exist, for the results themselves, and for a file that exists
    unless `overwrite`."""
    found = Path(path)
    if not found.name.lower().endswith(suffixes):
        raise checks.input_error("path", str(path), f"a name that ends in {' or '.join(suffixes)}")
    if not found.parent.is_dir():
        hint = f"Make {found.parent} first."
        raise checks.input_error("path", str(path), "in a folder that exists", hint)
    if found.is_dir():
        raise checks.input_error("path", str(path), "a file, not a folder")
    if found.exists():
        if source.exists() and found.samefile(source):
            raise checks.input_error("path", str(path), "another file than the results")
        if not overwrite:
            rule = "a path where there is no file yet"
            hint = "Choose another, or replace it: overwrite=True, or --overwrite."
            raise checks.input_error("path", str(path), rule, hint)
    return found


def check_new_folder(path: str | Path, parts: tuple[str, ...], files: str, overwrite: bool) -> Path:
    """The path of a folder to be made, with `parts` in it, of which the last says that it is such a
    folder. files: a pattern of the names of its files, from there. Raises InputError for a path
    without a name or in a folder that does not exist, for a file, and for a folder that holds
    anything; with `overwrite`, for one that holds other things than such files."""
    found = Path(path)
    if found.name in ("", ".."):
        raise checks.input_error("path", str(path), "the name of a folder, such as 'ctc'")
    if not found.parent.is_dir():
        hint = f"Make {found.parent} first."
        raise checks.input_error("path", str(path), "in a folder that exists", hint)
    if found.exists() and not found.is_dir():
        raise checks.input_error("path", str(path), "a folder, not a file")
    held = sorted(p.name for p in found.iterdir()) if found.exists() else []
    if held and not overwrite:
        rule = "a path where there is nothing yet, or an empty folder"
        hint = "Choose another, or replace it: overwrite=True, or --overwrite."
        raise checks.input_error("path", str(path), rule, hint)
    foreign = [name for name in held if name not in parts]
    if held and not foreign and parts[-1] in held:
        inside = (p.relative_to(found).as_posix() for p in sorted(found.rglob("*")) if p.is_file())
        foreign = [name for name in inside if not re.fullmatch(files, name)]
    elif held:
        foreign = held
    if foreign:
        rule = f"a folder that holds {', '.join(parts)} and nothing else, where it is replaced"
        raise checks.input_error("path", str(path), rule, f"It holds {', '.join(foreign[:5])}.")
    return found


@contextmanager
def folder_written_whole(path: Path) -> Iterator[Path]:
    """A new folder beside `path`, which it replaces at the end. An error or a kill before leaves
    what was at `path`. Raises SimulationError where something cannot be written."""
    target = path.resolve()
    with telling(path):
        new, old = beside(target, ".new"), beside(target, ".old")
        new.mkdir()
        try:
            yield new
            if target.exists():
                os.replace(target, old)
            os.replace(new, target)
        finally:
            if old.exists() and not target.exists():
                os.replace(old, target)
            for left in (new, old):
                shutil.rmtree(left, ignore_errors=True)


def check_frames(count: int, frames: object, path: Path, name: str = "frames") -> list[int]:
    """The numbers of the frames that are asked for, of a file with `count`: all of them without
    `frames`. Raises InputError for frames that it does not have, and for none."""
    if frames is None:
        return list(range(count))
    if isinstance(frames, np.ndarray):
        frames = frames.reshape(-1).tolist()
    if not isinstance(frames, (list, tuple, range)) or not len(frames):
        raise checks.input_error(name, frames, "a list of at least one frame's number")
    for k in frames:
        whole = isinstance(k, (int, np.integer)) and not isinstance(k, bool)
        if not whole or not -count <= k < count:
            rule = f"each from {-count} to {count - 1}: {path} has {count} frames"
            hint = "Of a mask, numpy.flatnonzero(mask)." if isinstance(k, bool) else ""
            raise checks.input_error(name, frames, rule, hint)
    chosen = [int(k) % count for k in frames]
    if sorted(set(chosen)) != chosen:
        raise checks.input_error(name, frames, "in the order of time, each once")
    return chosen
