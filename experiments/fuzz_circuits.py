"""A fuzzer: compiled functions of random circuits in random media, against torch.

    python experiments/fuzz_circuits.py --examples 1000 --seed 1

Each example draws a circuit of up to eight species (mass action, Hill terms, exchange, one type of
cells or all), as a function or as reactions, a method (stiff, with equal steps, or molecule by
molecule), and a medium as experiments/fuzz.py draws them (boundary conditions, flow, obstacles,
reservoirs, grids that grow). Cells grow meanwhile. The text
of the compiled functions is run as Python, since compiling each takes seconds;
tests/circuits/test_compiled_circuits.py shows that compiled for real it gives the same bits. Media
are computed by their compiled kernels on both sides. Laws, of all colonies and fields: the same
failures in the same words, and the same bits, since only + − × ÷ and whole powers occur. A stiff
example takes half a minute, most a second.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from arguments import whole
from fuzz_draws import OUTSIDE, Outside, for_each
from fuzz_scenes import medium
from hypothesis import strategies as st

import torchfilm as tf
from torchfilm.circuits import compiled

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # circuits at random, texts as Python
from traced import by, circuits, plain_module, row_of

METHODS = ("rosenbrock", "rosenbrock", "rosenbrock", "rk4", "tau_leap", "direct")


def taking_all(outside: Outside) -> Outside:
    """A medium that refuses no cell and no box."""
    bounded = "periodic" in outside.boundary or outside.outside == "error"
    return replace(outside, outside="reservoir" if bounded else outside.outside)


CASES = st.fixed_dictionaries({
    "circuit": circuits(signal="ahl"),
    "form": st.sampled_from(["function", "reactions"]),
    "method": st.sampled_from(METHODS),
    "rtol": st.sampled_from([1e-2, 1e-4]),
    "outside": OUTSIDE.map(taking_all),
    "dtype": st.sampled_from([torch.float32, torch.float64]),
    "dt": st.sampled_from([0.1, 1e-3, 1.0]),
    "steps": st.integers(1, 2),
})  # fmt: skip


def scene_of(case: dict) -> tf.Scene:
    """Four cells of two types on a line, a circuit in them, and the medium about them."""
    made, method, outside = case["circuit"], case["method"], case["outside"]
    given: dict[str, Any] = {"rtol": case["rtol"]} if method == "rosenbrock" else {"method": method}
    stochastic = method in ("tau_leap", "direct")
    if stochastic:
        given["molecules_per_unit"] = 4.0
        # events are simulated one by one, those of a million molecules for hours
        outside = replace(outside, start=min(outside.start, 1.0))
    circuit = tf.Circuit(
        made["reactions" if stochastic else case["form"]],
        species=made["species"],
        initial={n: tf.Uniform(0.0, 2.0) for n in made["species"]},
        **given,
    )
    dim = len(outside.shape)
    growth, cells = tf.Growth(rate=tf.Uniform(0.5, 1.0)), row_of(4, 2)
    if dim == 3:
        flat = lambda x: [[*row, 0.0] for row in x.tolist()]
        cells = tf.Cells(flat(cells.position), flat(cells.axis), cell_type=[0, 1, 0, 1])
    return tf.Scene(growth, circuit, medium(outside, dim), founders=cells, dt=0.1)


def end(scene: tf.Scene, backend: str, case: dict) -> tf.State:
    """The state after the steps, or after the first one in which a colony failed."""
    model = by(backend, scene).bind(2, seed=3, dtype=case["dtype"])
    state = model.start()
    for _ in range(case["steps"]):
        state = model.step(state, case["dt"])
        if tf.failures(state):
            break
    return state


def run(case: dict) -> str:
    """Runs an example under the laws: "refused", "failed" or "ran"."""
    try:
        scene = scene_of(case)
        ours = end(scene, "compiled", case)
    except tf.InputError as error:
        assert "compiled" not in str(error), "every circuit that is drawn has equations"
        return "refused"
    theirs = end(scene, "torch", case)
    said = [[(f.colony_id, f.reason) for f in tf.failures(x)] for x in (ours, theirs)]
    assert said[0] == said[1], said
    for name, value in {**ours.fields, **ours.signals}.items():
        other = theirs.signals[name] if name in theirs.signals else theirs.fields[name]
        assert torch.equal(value.nan_to_num(), other.nan_to_num()), name
    return "failed" if said[0] else "ran"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--examples", type=whole, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    compiled._module = plain_module
    torch.set_num_threads(1)
    ended: Counter[str] = Counter()
    slowest: tuple[float, dict] = (0.0, {})

    def every(case: dict) -> None:
        nonlocal slowest
        start = time.process_time()
        ended[run(case)] += 1
        slowest = max(slowest, (time.process_time() - start, case), key=lambda pair: pair[0])
        if ended.total() % 100 == 0:
            print(dict(ended), flush=True)

    for_each(CASES, chosen.examples, chosen.seed, every)
    print(
        f"{ended.total()} examples, seed {chosen.seed}: {dict(ended)}; the slowest took"
        f" {slowest[0]:.1f} s: {slowest[1]}"
    )


if __name__ == "__main__":
    main()
