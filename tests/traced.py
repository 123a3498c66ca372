"""Shared by the tests of traced circuits: compiled functions run as plain Python, and scenes of one
circuit without growth."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import ModuleType, SimpleNamespace

import numpy as np
import torch

import torchfilm as tf
from torchfilm.circuits import compiled, emission
from torchfilm.circuits.emission import Equations
from torchfilm.circuits.expressions import Builder
from torchfilm.circuits.graph import evaluated
from torchfilm.circuits.tracing import Column, lowered
from torchfilm.kernels import functions

COMPILER = "from torchfilm.kernels.compiling import kernel\n"


def _numpy(name: str) -> Callable:
    """A function of math as Numba has it: no error where a number overflows or is none."""
    return lambda x: getattr(np, {"atan": "arctan"}.get(name, name))(x)


MATH = SimpleNamespace(
    **{n: _numpy(n) for n in ("exp", "expm1", "log", "sin", "cos", "tan", "tanh", "atan")},
    floor=math.floor,
)


@cache
def plain_module(text: str) -> ModuleType:
    """The module of a circuit without a compiler: a stand-in for `compiled._module`."""
    assert text.count(COMPILER) == 1
    module = ModuleType("plain")
    exec(text.replace(COMPILER, "kernel = lambda function: function\n"), module.__dict__)
    for name, made in vars(functions).items():
        if name in module.__dict__ and hasattr(made, "py_func"):
            module.__dict__[name] = made.py_func
    module.__dict__["math"] = MATH
    for name in {"run", "run_moved"} & set(module.__dict__):
        module.__dict__[name] = _quiet(module.__dict__[name])
    return module


def _quiet(run: Callable) -> Callable:
    def quiet(*args: object) -> None:
        with np.errstate(all="ignore"):
            run(*args)

    return quiet


def by(backend: str | None, scene: tf.Scene) -> tf.Scene:
    """The scene with all its circuits by one backend."""
    return scene.replace(
        *(e._with(backend=backend) if isinstance(e, tf.Circuit) else e for e in scene.effects)
    )


def traced(function: Callable, **columns: torch.Tensor) -> Column:
    """What a function of columns gives for traced ones, of the types and dimensions of these."""
    builder = Builder()
    given = {n: Column.of(builder.name(n), builder, x.dtype, x.dim()) for n, x in columns.items()}
    return function(**given)


def again(found: Column, **columns: torch.Tensor) -> torch.Tensor:
    """The numbers of a traced result, for these columns."""
    return evaluated([found.expression], lambda leaf: columns[leaf.name])[0]


def emitted(function: Callable, **columns: torch.Tensor) -> np.ndarray:
    """The same by the text of compiled functions, run as Python: x is the variable, float64."""
    found = traced(function, **columns)
    builder = found.builder
    leaves = {
        builder.name(n): Column.of(builder.name(n), builder, x.dtype, x.dim())
        for n, x in columns.items()
    }
    (simple,) = lowered([found.expression], leaves, builder)
    kinds = {n: (x.dtype, x.dim()) for n, x in columns.items()}
    equations = Equations((simple.expression,), ("x",), kinds, builder)
    text = compiled.HEAD.format(what="one rate", constants="") + emission.functions(equations)
    module = plain_module(text + "def run():\n    pass\n")
    out = []
    with np.errstate(all="ignore"):
        for n in range(columns["x"].numel()):
            at = lambda name, n=n: np.float64(columns[name].expand(columns["x"].shape)[n].item())
            constants = module.prepared([at(name) for name in equations.leaves])
            out.append(module.rates((at("x"),), constants)[0])
    return np.array(out)
