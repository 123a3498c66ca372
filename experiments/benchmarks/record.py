"""What every benchmark notes beside its times: the machine, versions and commit."""

from __future__ import annotations

import platform
import subprocess
from datetime import UTC, datetime

import torch


def machine() -> dict:
    """Date, commit, versions, threads, and the devices there are, `processor` and `gpu`; which of them a case ran on is the case's to say."""
    try:
        commit = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"), "commit": commit, "torch": str(torch.__version__), "python": platform.python_version(),
        "threads": torch.get_num_threads(), "processor": platform.processor() or platform.machine(), "gpu": gpu,
    }  # fmt: skip
