"""Shared by the tests of the command line: the command in a shell, a scene file, and what a file or
a picture holds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np

import torchfilm as tf

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200"}

OWN = """
import torchfilm as tf

def scene(rate=1.0, longest=4.0):
    division = tf.Division(length=tf.Uniform(3.0, longest))
    return tf.Scene(tf.Growth(rate=rate), division, tf.Mechanics(dim=2), dt=0.05)
"""


def shell(
    *arguments: object, folder: Path, environment: dict[str, str] | None = None, **options
) -> subprocess.CompletedProcess:
    """The command as a user types it. environment: variables to add."""
    command = [sys.executable, "-m", "torchfilm.cli.main", *map(str, arguments)]
    return subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
        env=ENVIRONMENT | (environment or {}),
        check=False,
        **options,
    )


def frames(path) -> dict:
    """The last frame and what led there."""
    with tf.Results(path) as results:
        return {"steps": results.steps.tolist(), "times": results.times.tolist(), **results.frame()}


def assert_same(a: dict, b: dict) -> None:
    for name in a:
        assert np.array_equal(a[name], b[name]), name


def drawn(path) -> float:
    """The share of a picture's pixels that are coloured: cells, not paper, letters or lines."""
    image = matplotlib.image.imread(path)[..., :3]
    return float(((image.max(2) - image.min(2)) > 0.15).mean())
