"""How often the host reads from the device in a step: each read waits for all that a GPU was given.

A machine without a GPU counts them: tensors pretend to be on CUDA, so that the ways of CUDA are
taken, and whatever would read there is counted. That is any operation whose result has a size or is
a number that only the device knows.
"""

from __future__ import annotations

from functools import cache

import pytest
import torch
from mock_cuda import pretended_cuda  # noqa: F401
from test_devices import KINDS, by_torch
from torch.utils._python_dispatch import TorchDispatchMode

import torchfilm as tf
from torchfilm.loop import LastingConcerns

# How often CUDA's own code reads in an operation; of `bincount` the least and the greatest.
READS = {
    "_local_scalar_dense": 1,
    "nonzero": 1,
    "masked_select": 1,
    "_unique": 1,
    "_unique2": 1,
    "unique_dim": 1,
    "unique_consecutive": 1,
    "equal": 1,
    "bincount": 2,
    "histc": 2,
}
STEPS = 4


class Reads(TorchDispatchMode):
    """Counts reads while it is entered, also those of methods that no dispatch sees on the CPU."""

    METHODS = ("tolist", "numpy", "cpu")

    def __init__(self, patch: pytest.MonkeyPatch):
        super().__init__()
        self.count, self.inside = 0, False
        for name in self.METHODS:
            patch.setattr(torch.Tensor, name, self._counted(getattr(torch.Tensor, name)))

    def _counted(self, method):
        def read(*args, **options):
            if self.inside:
                return method(*args, **options)
            self.count, self.inside = self.count + 1, True
            try:
                return method(*args, **options)
            finally:
                self.inside = False

        return read

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        if not self.inside:
            self.count += READS.get(name, 0) + _reads_a_size(name, args, kwargs)
        return func(*args, **kwargs)


def _reads_a_size(name: str, args: tuple, kwargs: dict) -> bool:
    if name == "repeat_interleave":
        return kwargs.get("output_size") is None
    if name == "index" or (name in ("index_put", "index_put_") and args[2].numel() != 1):
        return any(x is not None and x.dtype == torch.bool for x in args[1])
    return False


def test_what_reads_is_counted(monkeypatch):
    x = torch.arange(4.0)
    for work, count in (
        (lambda: x + 1, 0),
        (lambda: x[torch.tensor([0, 2])], 0),
        (lambda: torch.nonzero_static(x > 1, size=2), 0),
        (lambda: float(x.sum()), 1),
        (lambda: bool((x > 1).any()), 1),
        (lambda: x.tolist(), 1),
        (lambda: x.cpu().numpy(), 2),
        (lambda: x[x > 1], 1),
        (lambda: torch.nonzero(x), 1),
        (lambda: torch.unique(x), 1),
        (lambda: x.repeat_interleave(torch.ones(4, dtype=torch.int64)), 1),
    ):
        with monkeypatch.context() as patch, Reads(patch) as reads:
            work()
        assert reads.count == count


def colony(contacts: str, **more) -> tuple[tf.Effect, ...]:
    return (
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2, contacts=contacts, backend="torch", **more),
    )


def signalling() -> tf.Scene:
    return by_torch(tf.scenes.quorum_sensing(), *KINDS)


# The bounds, reads a step, and what they are made of. A pass of one-sided contacts, of which most
# steps have one, reads 17 times around two searches, and 50 times in ten rounds of Newton's method:
# once a round, and once in two iterations of conjugate gradients (`tools.reads` tells why).
# Bilateral ones read 10 times around a search, and some 25 times in two rounds, again once in two
# iterations. A step of a circuit's solver reads twice: 45 in 23 steps, and again in each of three
# or four iterations with transport. One read more in each iteration, or in each step of a solver,
# would pass these bounds.
SCENES = {
    "free growth": (lambda: tf.Scene(*colony("one-sided"), dt=0.025), 69),
    "bilateral contacts": (lambda: tf.Scene(*colony("bilateral"), dt=0.025), 36),
    "a circuit with a signal": (signalling, 239),
}


@torch.no_grad()
def test_all_reports_are_read_at_once(pretended_cuda, monkeypatch):  # noqa: F811
    """By the monitors of a run: once for failures, and once for concerns."""
    scene = signalling()
    model = scene.bind(2, device="cuda")
    state = model.step(model.start(), scene.dt)
    assert len(state.reports) > 2
    for look in (tf.failures, LastingConcerns()):
        with monkeypatch.context() as patch, Reads(patch) as reads:
            look(state)
        assert reads.count == 1


@cache
def grown() -> tf.Cells:
    """Four colonies of 200 cells or more."""
    growth, division, _ = colony("one-sided")
    model = tf.Scene(growth, division, tf.Mechanics(dim=2), dt=0.025).bind(4, seed=1)
    state = model.start()
    while int(state.counts.min()) < 200:
        state = model.step(state, 0.025)
    return tf.Cells(
        state.position, state.axis, state.length, radius=state.radius, colony=state.colony
    )


@pytest.mark.parametrize("name", SCENES)
@torch.no_grad()
def test_a_step_reads_rarely(pretended_cuda, monkeypatch, name):  # noqa: F811
    make, most = SCENES[name]
    scene, cells = make(), grown()
    model = scene.bind(cells=cells, seed=1, device="cuda")
    state = model.start()
    for _ in range(3):
        state = model.step(state, scene.dt)
    states = []
    with monkeypatch.context() as patch, Reads(patch) as reads:
        for _ in range(STEPS):
            state = model.step(state, scene.dt)
            states.append(state)
    passes = [int(s.reports["mechanics"].passes.max()) for s in states]
    assert 0 < reads.count <= most * (sum(passes) if name == "free growth" else STEPS)
