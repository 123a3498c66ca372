"""Values of the command lines of scripts: checked by argparse before anything runs.

Each function is a `type=` of an option, or makes one. argparse ends the script with exit code 2 and
the message.
"""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torchfilm as tf
from torchfilm.tools import checks

T = TypeVar("T")


def not_allowed(text: str, allowed: str) -> ArgumentTypeError:
    """The error for a value; argparse writes the name of the option before it."""
    return ArgumentTypeError(f"{text!r} is not allowed: give {allowed}.")


def at_least(least: int) -> Callable[[str], int]:
    """The type of whole numbers from `least`."""

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise not_allowed(text, f"a whole number from {least}")
        return value

    return number


whole = at_least(1)


def positive(text: str) -> float:
    """A number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise not_allowed(text, "a number above 0")
    return value


def checked(read: Callable[[str], T]) -> Callable[[str], T]:
    """The type of what `read` makes of the text, which raises InputError where it cannot."""

    def value(text: str) -> T:
        try:
            return read(text)
        except tf.InputError as error:
            raise ArgumentTypeError(str(error)) from None

    return value


@checked
def own_device(text: str) -> str:
    """A device that this machine has."""
    checks.device(text)
    return text


def in_file(text: str) -> Path:
    """A file that is there."""
    if not Path(text).is_file():
        raise not_allowed(text, "the path of a file that is there")
    return Path(text)


def in_folder(text: str) -> Path:
    """A folder that is there."""
    if not Path(text).is_dir():
        raise not_allowed(text, "the path of a folder that is there")
    return Path(text)


def out_folder(text: str) -> Path:
    """A folder to write into, made here: a long run must not fail at its end."""
    try:
        Path(text).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise not_allowed(text, f"a folder that can be made ({error.strerror})") from None
    return Path(text)


def out_stem(text: str) -> Path:
    """A path without suffix, of files to write, in a folder that is made here."""
    out_folder(str(Path(text).parent))
    return Path(text)


def out_file(text: str) -> Path:
    """A file to write, in a folder that is made here."""
    if Path(text).is_dir():
        raise not_allowed(text, "the path of a file; this is a folder")
    return out_stem(text)
