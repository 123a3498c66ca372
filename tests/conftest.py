"""Fixtures that every test may use: the devices of this machine, and the two precisions."""

from __future__ import annotations

import os
import sys

import hypothesis
import pytest
import torch

# two workers share two cores: more threads each would only make them wait for one another
torch.set_num_threads(1)

# The suite draws the same examples on every run. TORCHFILM_EXPLORE=1 draws new ones.
hypothesis.settings.register_profile(
    "torchfilm", derandomize=os.environ.get("TORCHFILM_EXPLORE") is None, deadline=None
)
hypothesis.settings.load_profile("torchfilm")

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


@pytest.fixture(params=DEVICES)
def device(request) -> torch.device:
    return torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request) -> torch.dtype:
    return request.param


@pytest.fixture
def measured(record_property):
    """`measured("overlap, µm", value, "≤ 0.05")` beside a hard case's assertion notes the value for
    docs/stability.md, and gives it back. Of several of one case the page shows the worst: the least
    where the criterion is "≥ …", else the greatest."""

    def note(what: str, value, criterion: str):
        record_property("measured", (what, float(value), criterion))
        return value

    return note


@pytest.fixture
def deterministic():
    """Torch's deterministic algorithms, switched back afterwards."""
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(before)


@pytest.fixture
def command(tmp_path, monkeypatch):
    """The command line without a new process: `command("run", "microcolony", …)` in a folder of its
    own."""
    from torchfilm.cli import main as cli

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    path, threads = list(sys.path), torch.get_num_threads()

    def call(*arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", ["torchfilm", *map(str, arguments)])
        cli.main()

    yield call
    sys.path[:] = path
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """A run of three colonies that nothing interrupted: (path, its states). To be read only."""
    return _recorded(tmp_path_factory.mktemp("whole") / "run.h5")


@pytest.fixture(scope="session")
def every_step(tmp_path_factory):
    """The same with every step recorded."""
    return _recorded(tmp_path_factory.mktemp("every") / "run.h5", every=1)


def _recorded(path, **options):
    from recorded import make_scene, record

    scene = make_scene()
    return path, record(scene, scene.bind(3, seed=11).start(), path, **options)
