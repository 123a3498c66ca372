"""What every benchmark notes beside its times, the machine, versions and commit; and how its tables
get into a page of the documentation."""

from __future__ import annotations

import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import torch


def machine() -> dict:
    """Date, commit, versions, threads, and the devices there are, `processor` and `gpu`; which of
    them a case ran on is the case's to say."""
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
    """Put `text` between a page's two marks, `<!-- what -->` and the next `<!-- to here -->`."""
    begin, end = f"<!-- {what} -->", "<!-- to here -->"
    before, found, rest = page.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise SystemExit(f"{page} has no place for what is written, from {begin} to {end}")
    page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}")
