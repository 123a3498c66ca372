"""Fixtures that every test may use: the devices of this machine, and the two precisions."""

from __future__ import annotations

import gc
import itertools
import os
import sys
import warnings

import hypothesis
import pytest
import torch

# two workers share two cores: more threads each would only make them wait for one another
torch.set_num_threads(1)
# a look at all objects takes seconds in a whole run, and there are few cycles to find
gc.set_threshold(7000, 20, 10)

# The suite draws the same examples on every run. TORCHFILM_EXPLORE=1 draws new ones.
hypothesis.settings.register_profile(
    "torchfilm", derandomize=os.environ.get("TORCHFILM_EXPLORE") is None, deadline=None
)
hypothesis.settings.load_profile("torchfilm")

# A run of more tests than this compiles the kernels of contacts first.
MANY_TESTS = 2000
DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


def pytest_collection_finish(session):
    """Two workers of a whole run share the kernels of contacts, and find what the other compiled.
    Else both would come to the same ones at the same time, and compile them all."""
    gc.collect()
    gc.freeze()  # a million objects of the collection, at which `gc` need not look again
    worker = getattr(session.config, "workerinput", {}).get("workerid")
    contacts = {"gw0": "one-sided", "gw1": "bilateral"}.get(worker)
    if contacts is None or len(session.items) < MANY_TESTS:
        return
    import torchfilm as tf

    kinds = itertools.product((2, 3), (torch.float32, torch.float64))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for dim, dtype in kinds:
            mechanics = tf.Mechanics(dim=dim, contacts=contacts, length_drag=10.0)
            scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), mechanics)
            model = scene.bind(1, dtype=dtype)
            model.step(model.start())


@pytest.fixture(autouse=True)
def torch_as_it_was():
    """A test that leaves torch with other threads fails, and not one of those after it. (A patched
    number of threads deceives `tf.one_torch_thread`: patch `tools.threads.available`.)"""
    yield
    left = torch.get_num_threads()
    torch.set_num_threads(1)
    assert left == 1, f"the test leaves torch with {left} threads"


@pytest.fixture
def new_objects():
    """Inside, `gc` sees only the objects of this test: in a whole run there are millions, and each
    look at all of them takes seconds."""
    gc.collect()
    gc.freeze()


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
