"""The machine, versions and commit that every benchmark records, how tables enter a page, and what
scripts that run ready-made scenes are asked."""

from __future__ import annotations

import argparse
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import torch

import torchfilm as tf


def machine() -> dict:
    """Returns date, commit, versions, threads, `processor` and `gpu`.

    Each case records on which of the two devices it ran.
    """
    try:
        commit = subprocess.run(
            ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit,
        "torch": str(torch.__version__),
        "python": platform.python_version(),
        "threads": torch.get_num_threads(),
        "processor": platform.processor() or platform.machine(),
        "gpu": gpu,
    }


def write_page(page: Path, text: str, what: str) -> None:
    """Replaces the text of a page between `<!-- what -->` and the next `<!-- to here -->`.

    Raises SystemExit if the page lacks these marks.
    """
    begin, end = f"<!-- {what} -->", "<!-- to here -->"
    before, found, rest = page.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise SystemExit(f"{page} lacks the marks {begin} and {end}")
    page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}")


def scenes_parser(about: str | None) -> argparse.ArgumentParser:
    """Returns the parser of a script about ready-made scenes, with the option --scene."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scene",
        action="append",
        choices=tuple(tf.scenes.READY),
        help="one scene; may be repeated",
    )
    return parser
