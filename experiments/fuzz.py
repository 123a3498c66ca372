"""A fuzzer: random scenes that must obey the laws of the simulator.

    python experiments/fuzz.py --examples 3000 --seed 1

Each example draws a scene and runs it for a few steps under the laws of `run`. It draws sizes,
crowding, walls, α or stiffness, γ, growth, division, circuits with Hill terms and stiff decay,
signals on grids of odd shapes with boundary conditions, flow and obstacles, and steps from less
than a second to hours. Hypothesis reduces the first example that breaks a law and prints it as a
`Draw`, which `run` accepts. docs/stability.md lists the findings. tests/test_fuzz.py runs a hundred
examples.
"""

from __future__ import annotations

import argparse
import itertools
import time

import torch
from fuzz_draws import DRAWS, Beside, Capsules, Contacts, Draw
from fuzz_scenes import eats, mechanics, scene_of
from hypothesis import HealthCheck, given, seed, settings
from torch import Tensor

import torchfilm as tf

__all__ = ["DRAWS", "Beside", "Capsules", "Contacts", "Draw", "run", "scene_of"]


def run(draw: Draw) -> str:
    """Runs an example under the laws.

    Returns how it ended: "refused" (invalid, raised tf.InputError at construction), "failed" (a
    colony was reported and dropped) or "ran". Raises AssertionError if a law is broken. That, or
    any other exception, is a finding.
    """
    try:
        scene, state = scene_of(draw)
    except tf.InputError as error:
        assert len(str(error)) > 20, "an error should say what is invalid"
        return "refused"
    ending, model = "ran", scene.bind(state=state)
    for _ in range(draw.steps):
        before, state = state, model.step(state, draw.dt)
        counted(before, state)
        found = tf.failures(state)
        assert all(f.reason and f.hint for f in found)
        failed = sorted({f.place for f in found})
        if failed:
            ending = "failed"
        sound = [k for k in range(state.colonies) if k not in failed]
        finite(state, sound)
        if sound:
            walled(state.select(sound), draw)
            kept(before.select(sound), state.select(sound), draw)
            same_alone(scene, before, state, sound[-1], draw.dt)
        state = state.remove(
            torch.isin(state.colony, torch.tensor(failed, dtype=torch.int64)), "failed"
        )
    return ending


def counted(before: tf.State, after: tf.State) -> None:
    """Checks uids and numbers of cells.

    Uids are unique in their colony and below its next uid. The number of cells is that before, less
    the cells that ended, plus two for each division.
    """
    key = after.colony * 2**32 + after.uid
    assert torch.unique(key).numel() == after.cells, "uids are not unique"
    assert bool((after.uid < after.next_uid.index_select(0, after.colony)).all()), (
        "a uid is not below the next"
    )
    assert bool((after.colony.diff() >= 0).all()), "colonies are not contiguous"
    births = sum(b.first.numel() for b in after.births)
    assert after.cells == before.cells + 2 * births - sum(e.uid.numel() for e in after.ended), (
        "cells do not add up"
    )
    assert torch.equal(after.counts, torch.bincount(after.colony, minlength=after.colonies)), (
        "counts are wrong"
    )
    assert bool((after.next_uid >= before.next_uid).all())


def finite(state: tf.State, sound: list[int]) -> None:
    """Checks that all numbers are finite in colonies that did not fail, and on all grids.

    Grids are checked everywhere because they remain after a failure.
    """
    for name, value in state.signals.items():
        assert bool(torch.isfinite(value).all()), f"the signal {name} is not finite"
        assert bool((value >= 0).all()), f"the signal {name} is below 0: {float(value.min())}"
    if not sound:
        return
    part = state.select(sound)
    for name in ("position", "axis", "length", "radius", *part.fields):
        value = (
            getattr(part, name)
            if name in ("position", "axis", "length", "radius")
            else part.fields[name]
        )
        assert not value.is_floating_point() or bool(torch.isfinite(value).all()), (
            f"{name} is not finite"
        )
    assert bool(((part.axis.double().norm(dim=1) - 1).abs() <= 1e-6).all()), (
        "an axis is not of unit length"
    )
    assert bool((part.length >= 0).all()), "a length is below 0"
    for name in ("a", "b"):
        assert name not in part.fields or bool((part.fields[name] >= 0).all()), (
            f"the species {name} is below 0"
        )


def walled(state: tf.State, draw: Draw) -> None:
    """Checks that no centre is behind a hard wall by more than half the cell's length plus its
    radius, if α γ ≤ 1 (the paper's choice or harder).

    A crowd that starts with deep overlaps may drive cells as deep in one step, but no deeper.
    """
    c = draw.contacts
    if (
        c is None
        or c.wall is None
        or c.wall_stiffness is not None
        or (c.give is not None and not 0 < c.give * c.length_drag <= 1)
    ):
        return
    reach = 0.5 * state.length.double() + state.radius.double()
    for surface in mechanics(c, draw.capsules).surfaces():
        distance, _ = surface.gap_of_points(state.position, state.own_colony_id)
        assert bool((distance >= -reach).all()), (
            f"a cell is {-float(distance.min()):g} µm behind the wall"
        )


def amounts(state: tf.State) -> Tensor:
    """Returns the conserved amount of each colony, (B,) float64, conc·µm³: `a`, `b` and signal."""
    inside = sum(state.fields[n].double() for n in ("a", "b")) * state.circuit_volume.double()
    total = torch.zeros(state.colonies, dtype=torch.float64).index_add_(0, state.colony, inside)
    if state.layout is not None:
        grid = state.layout.grid
        total.index_add_(0, grid.owner, state.signals["ahl"].double() * grid.voxel_volume)
        if "ahl_reservoir" in state.fields:
            total += state.fields["ahl_reservoir"].double()
    return total


def kept(before: tf.State, after: tf.State, draw: Draw) -> None:
    """Checks that amounts are conserved where no process produces or removes molecules.

    The bound allows some rounding of the summands and the error of the stiff solver in float64: its
    matrix 2/h − J has a condition number of about 1 + h|J|.
    """
    i, o = draw.inside, draw.outside
    if (
        i is None
        or i.kind != "exchange"
        or i.daughters != "amount"
        or eats(draw)
        or draw.beside.leaving
        or draw.beside.rule == "remove"
    ):
        return
    if o is not None and (
        o.decay
        or o.flow
        or {"open", "fixed"} & set(o.boundary)
        or (o.outside == "grow" and o.start)
    ):
        return
    then, now = amounts(before), amounts(after)
    around = float((after.area / after.volume).max()) if after.cells else 0.0
    stiff = 1.0 + draw.dt * i.fast * (3.0 + around)
    bound = 200 * torch.finfo(after.dtype).eps + 10 * torch.finfo(torch.float64).eps * stiff
    assert bool(((now - then).abs() <= bound * then + 1e-30).all()), (
        f"amounts changed by {float(((now - then) / then).abs().max()):g}"
    )


def same_alone(scene: tf.Scene, before: tf.State, after: tf.State, place: int, dt: float) -> None:
    """Checks that a colony by itself takes the same step, to the last bit."""
    single = before.select([place])
    one, same = scene.bind(state=single).step(single, dt), after.select([place])
    for name in ("uid", "parent", "position", "axis", "length", "radius", *same.fields):
        alone, batch = (
            getattr(s, name) if name not in s.fields else s.fields[name] for s in (one, same)
        )
        assert torch.equal(alone, batch), f"{name} of a colony alone differs from the batch"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--examples", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    ended: dict[str, int] = {}
    slowest, number = (0.0, None), itertools.count(1)

    @seed(chosen.seed)
    @settings(
        max_examples=chosen.examples,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        print_blob=False,
    )
    @given(DRAWS)
    def every(draw: Draw) -> None:
        nonlocal slowest
        start = time.perf_counter()
        ending = run(draw)
        ended[ending] = ended.get(ending, 0) + 1
        slowest = max(slowest, (time.perf_counter() - start, draw), key=lambda pair: pair[0])
        if next(number) % 500 == 0:
            print(ended, flush=True)

    every()
    print(
        f"{sum(ended.values())} examples, seed {chosen.seed}: {ended}; the slowest took"
        f" {slowest[0]:.1f} s: {slowest[1]}"
    )


if __name__ == "__main__":
    main()
