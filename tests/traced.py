"""Shared by the tests of traced circuits: compiled functions run as plain Python, scenes of cells
with circuits by both backends, and circuits at random."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import ModuleType

import numpy as np
import pytest
import torch
from helpers import array
from hypothesis import strategies as st

import torchfilm as tf
from torchfilm import parts
from torchfilm.circuits import compiled, emission
from torchfilm.circuits.emission import RateExpressions
from torchfilm.circuits.expressions import Builder
from torchfilm.circuits.graph import evaluated
from torchfilm.circuits.tracing import Column, lowered
from torchfilm.effects.bound_circuit import BoundCircuit
from torchfilm.kernels import functions
from torchfilm.kernels.compiling import for_python

COMPILER = "from torchfilm.kernels.compiling import kernel\n"


@cache
def plain_module(text: str) -> ModuleType:
    """The module of a circuit without a compiler: a stand-in for `compiled._module`."""
    assert text.count(COMPILER) == 1
    module = ModuleType("plain")
    module.__dict__["kernel"] = _as_it_is
    exec(text.replace(COMPILER, ""), module.__dict__)
    for name, made in list(module.__dict__.items()):
        if hasattr(made, "py_func"):
            is_short = made is getattr(functions, name, None)
            module.__dict__[name] = made.py_func if is_short else for_python(made)
    module.__dict__["WIDTH"] = 1  # one cell after the other
    for name in {"run", "run_moved"} & set(module.__dict__):
        module.__dict__[name] = _quiet(module.__dict__[name])
    return module


def _as_it_is(function: Callable | None = None, **options: bool) -> Callable:
    """Stands in for the decorator `kernel`."""
    return _as_it_is if function is None else function


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
    equations = RateExpressions((simple.expression,), ("x",), kinds, builder)
    text = compiled.HEAD.format(what="one rate", constants="") + emission.functions(equations)[0]
    module = plain_module(text + "def run():\n    pass\n")
    out = []
    with np.errstate(all="ignore"):
        for n in range(columns["x"].numel()):
            at = lambda name, n=n: np.float64(columns[name].expand(columns["x"].shape)[n].item())
            constants = module.prepared([at(name) for name in equations.leaves])
            out.append(module.rates((at("x"),), constants)[0])
    return np.array(out)


def row_of(count: int, types: int = 1) -> tf.Cells:
    """Cells apart from each other on a line."""
    return tf.Cells(
        [[5.0 * k, 0.0] for k in range(count)], [[1.0, 0.0]] * count,
        cell_type=[k % types for k in range(count)],
    )  # fmt: skip


def alone(*circuits: tf.Effect, count: int = 12, types: int = 1) -> tf.Scene:
    """Cells that grow, with circuits."""
    growth = tf.Growth(rate=tf.Uniform(0.5, 1.0))
    return tf.Scene(growth, *circuits, founders=row_of(count, types), dt=0.1)


def ends(scene: tf.Scene, steps: int = 3, dt: float = 0.1, **bind) -> list[tf.State]:
    """The state after some steps by both backends."""
    out = []
    for backend in ("compiled", "torch"):
        model = by(backend, scene).bind(**{"seed": 3, "dtype": torch.float64, **bind})
        found = [e for e in model.effects if "circuit" in e.title]
        for one in found if backend == "compiled" else ():
            assert one.compiled and not any(isinstance(x, str) for x in one.compiled.values())
        state = model.start()
        for _ in range(steps):
            state = model.step(state, dt)
        out.append(state)
    return out


def equal(a: tf.State, b: tf.State) -> None:
    assert torch.equal(a.uid, b.uid)
    for name, x in a.fields.items():
        assert torch.equal(x, b.fields[name]), name
    for name, x in a.signals.items():
        assert torch.equal(x, b.signals[name]), name


def close(a: tf.State, b: tf.State, rel: float, least: float = 0.0) -> None:
    """Concentrations of the circuits: relative to each, or at least `least`."""
    assert torch.equal(a.uid, b.uid)
    for name, x in a.fields.items():
        assert array(x) == pytest.approx(array(b.fields[name]), rel=rel, abs=least), name


def one_step(scene: tf.Scene, dtype: torch.dtype = torch.float64, **bind):
    """The circuit of a scene, what its cells begin the first step with, and their concentrations
    then."""
    model = scene.bind(seed=1, dtype=dtype, **bind)
    (circuit,) = (e for e in model.effects if isinstance(e, BoundCircuit))
    middle, start = circuit.begun(model.start())
    (kind,) = circuit.rates
    cells = circuit.cells(middle, torch.arange(middle.cells), kind)
    return cells, start, start.concentrations(cells.rows)


# --- circuits at random ---------------------------------------------------------------------------

NAMES = tuple("abcdefgh")


@st.composite
def circuits(draw, signal: str = "x0") -> dict:
    """A circuit of up to eight species as reactions, and the same as a function."""
    names = NAMES[: draw(st.integers(1, 8))]
    number = st.floats(0.05, 3.0).map(lambda x: float(f"{x:.3g}"))
    one = st.sampled_from(names)
    listed, terms = [], []
    for k in range(draw(st.integers(1, 2 * len(names)))):
        kind = draw(st.sampled_from(["made", "lost", "pair", "hill", "turned", "out"]))
        a, b, rate = draw(one), draw(one), draw(number)
        if kind == "made":
            listed.append(tf.Reaction({}, {a: 1}, rate, f"{k}"))
            terms.append(({a: 1}, lambda u, s, c, r=rate: r))
        elif kind == "lost":
            listed.append(tf.Reaction({a: 1}, {}, rate, f"{k}"))
            terms.append(({a: -1}, lambda u, s, c, r=rate, a=a: r * u[a]))
        elif kind == "pair" and a != b:
            listed.append(tf.Reaction({a: 1, b: 1}, {}, rate, f"{k}"))
            terms.append(({a: -1, b: -1}, lambda u, s, c, r=rate, a=a, b=b: r * u[a] * u[b]))
        elif kind == "turned" and a != b:
            listed.append(tf.Reaction({a: 2}, {b: 1}, rate, f"{k}"))
            terms.append(({a: -2, b: 1}, lambda u, s, c, r=rate, a=a: r * u[a] * u[a]))
        elif kind == "hill":
            half, power = draw(number), draw(st.sampled_from([1, 2, 3]))
            law = draw(st.sampled_from(["activated", "repressed"]))
            (made,) = getattr(parts, law)(a, b, rate, half, power)
            listed.append(tf.Reaction({}, {a: 1}, made.rate, f"{k}"))
            use = tf.kinetics.activation if law == "activated" else tf.kinetics.repression
            terms.append(
                ({a: 1}, lambda u, s, c, r=rate, b=b, h=half, n=power, f=use: r * f(u[b], h, n))
            )
        elif kind == "out":
            gone, back = parts.exchange(a, rate, signal)
            listed += [tf.Reaction(r.consumes, r.produces, r.rate, f"{k} {n}")
                       for n, r in enumerate((gone, back))]  # fmt: skip
            net = lambda u, s, c, r=rate, a=a: r * c.area / c.volume * (u[a] - s[signal])
            terms.append(({a: -1, f"out.{signal}": 1}, net))
    if not listed:
        listed.append(tf.Reaction({}, {names[0]: 1}, 1.0))
        terms.append(({names[0]: 1}, lambda u, s, c: 1.0))

    def rates(u, s, p, cell):
        inside, outside = {}, {}
        for change, rate in terms:
            value = rate(u, s, cell)
            for name, n in change.items():
                into = outside if name.startswith("out.") else inside
                key = name.removeprefix("out.")
                size = value * cell.volume if name.startswith("out.") else value
                into[key] = into.get(key, 0.0) + n * size
        return inside, outside

    typed = draw(st.booleans())
    wrap = lambda part: {0: part} if typed else part
    return {"function": wrap(rates), "reactions": wrap(listed), "species": names}
