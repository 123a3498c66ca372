"""Campaigns with methods and targets of a user's own: what a study keeps, and when it goes on."""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from searching import lit, mean

import torchfilm as tf
from design import Parameter, Search
from design.methods import Batch
from design.targets import Target

TWO = [Parameter("make", 0.1, 10.0, log=True), Parameter("decay", 0.1, 5.0)]


class Changing:
    """A method that writes into the losses that it gets, as those do that scale losses in place."""

    def __init__(self, touch: bool):
        self.touch = touch

    def start(self, space, seed, replicates):
        self.size, self.seed, self.told = space.size, seed, 0

    def ask(self):
        return Batch(np.random.default_rng([self.seed, self.told]).random((3, self.size)))

    def tell(self, batch, loss):
        self.told += 1
        if self.touch:
            loss -= loss.mean() + 1.0


@dataclass(frozen=True)
class Levels(Target):
    """Residuals that are `scale` times what they should be."""

    scale: float = 1.0
    differentiable = True

    def loss(self, state, history=None):
        return self.residuals(state).square().sum(1) / self.scale**2

    def residuals(self, state, history=None):
        return self.scale * (mean(state, "gfp") - 1.0).unsqueeze(1)


def search(**options):
    given = {"cells": 4, "replicates": 1, "finals": None, "seed": 0}
    return Search(lit, TWO, **{**given, **options})


def test_a_method_cannot_change_what_a_study_keeps(tmp_path):
    found = []
    for touch in (False, True):
        one = search(target=Levels(), method=Changing(touch))
        best = one.run(colonies=9, study=tmp_path / f"{touch}.h5")
        found.append((best.loss, best.values, [e.loss.tolist() for e in one.study.entries]))
    assert found[0] == found[1] and found[0][0] >= 0.0


@pytest.mark.parametrize("scale", [1.0, 10.0, float("nan")])
def test_residuals_whose_squares_are_not_the_loss_are_refused(scale):
    @dataclass(frozen=True)
    class Wrong(Levels):
        def loss(self, state, history=None):
            return (mean(state, "gfp") - 1.0) ** 2

    if scale == 1.0:
        search(target=Wrong(scale), method="sobol").run(colonies=4)
        return
    with pytest.raises(TypeError, match=r"Wrong\.residuals: their squares add up to"):
        search(target=Wrong(scale), method="sobol").run(colonies=4)


def test_a_batch_takes_a_tensor():
    points = torch.full((2, 2), 0.5, requires_grad=True)
    assert Batch(points).points.tolist() == [[0.5, 0.5]] * 2


HELPER = """
from functools import lru_cache
SCALE = {scale}
def times(factor):
    def decorate(function):
        return lambda x: factor * function(x)
    return decorate
@times({width})
def wide(x):
    return x
@lru_cache
def gain(x):
    return {gain}
def other(x):
    return x * SCALE
def only(x):
    return {only}
"""
MODEL = """
import {helper} as parts
from {helper} import gain, other, wide
class Mean:
    wanted = {wanted}
    _calls = {private}
    @property
    def half(self):
        return {half}
    @staticmethod
    def twice(x):
        return {twice}
    def __call__(self, x):
        return self.wanted * x + other(x) + gain(x) + wide(x) + parts.only(1)
"""
PLAIN = {
    "scale": 1.0, "width": 2.0, "gain": "x + 1", "wanted": 1.0, "half": 0.5, "twice": "2 * x",
    "only": "x - 1", "private": 0,
}  # fmt: skip


@pytest.mark.parametrize("changed", [None, *PLAIN])
def test_a_digest_counts_what_a_users_code_uses(changed, tmp_path, monkeypatch):
    """Attributes, properties and static methods of its class, and functions of other files; also
    where a file was run as a script, and not imported."""
    monkeypatch.syspath_prepend(tmp_path)
    found = []
    for k, value in enumerate((None, "7")):
        texts = {**PLAIN, **({changed: value} if changed and value else {})}
        model = f"own_model_{changed}_{k}"
        (tmp_path / f"{model}.py").write_text(MODEL.format(helper="own_helper", **texts))
        sys.modules.pop("own_helper", None)
        (tmp_path / "own_helper.py").write_text(HELPER.format(**texts))
        importlib.invalidate_caches()
        made = importlib.import_module(model)
        found.append(tf.digest(made.Mean()))
        sys.modules.pop(model)
        assert tf.digest(made.Mean()) == found[-1]
    sys.modules.pop("own_helper", None)
    assert (found[0] != found[1]) == (changed not in (None, "private"))


def test_functions_that_share_functions_are_counted_once():
    """Thirty levels of two, each of which calls both of the next: 2³⁰ ways."""
    lines = ["def f30(x): return x", "def g30(x): return x"]
    for k in range(30):
        lines += [f"def {n}{k}(x): return f{k + 1}(x) + g{k + 1}(x)" for n in "fg"]
    words = []
    for last in ("x", "x + 1"):
        space = {"__name__": "__main__"}
        exec("\n".join([*lines, f"def f30(x): return {last}"]), space)
        words.append(tf.digest(space["f0"]))
    assert words[0] != words[1]


@dataclass(frozen=True)
class Course(Target):
    """Residuals of a course, which a plain evaluation does not note; too small colonies fail."""

    differentiable = True
    fewest = 100

    def note(self, state):
        return mean(state, "gfp").unsqueeze(1)

    def course(self, state):
        return mean(state, "gfp").unsqueeze(1).expand(-1, 2)

    def residuals(self, state, history=None):
        return history[:, :, 1].T

    def loss(self, state, history=None):
        return history[:, :, 0].square().sum(0)


def test_residuals_of_a_course_are_left_to_it():
    search(target=Course(), method="sobol", cells=4).run(colonies=4)


class Broken:
    """An executor that has lost its scheduler."""

    def submit(self, *args):
        raise AttributeError("'NoneType' object has no attribute 'comm'")


def test_an_executor_that_fails_by_itself_is_not_taken_for_code_that_cannot_be_pickled():
    """The search goes on in its own process."""
    given = {"target": Levels(), "method": "sobol"}
    usual = search(**given).run(colonies=4)
    with pytest.warns(RuntimeWarning, match="this process ran them .*'comm'"):
        found = search(**given).run(colonies=4, executor=Broken())
    assert found.loss == usual.loss
