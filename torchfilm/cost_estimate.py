"""An estimate of a scene's time and memory, from a short measurement.

The scene runs briefly with a small crowd of cells, once in a single colony and once in several. A
least-squares fit gives the time and bytes of each effect: a + b · cells, or a + b · colonies for
effects on grids. The cost of contacts in larger colonies than these is extrapolated by the power
that was measured.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy.optimize import nnls

from torchfilm.effect import LYSIS, REMOVAL
from torchfilm.initial_cells import Cells
from torchfilm.loop import advance, failures
from torchfilm.model import Model
from torchfilm.scene import Scene
from torchfilm.state import CELL, GRID, PER_CELL, State
from torchfilm.tools import checks
from torchfilm.tools.counting import Operators
from torchfilm.tools.timing import Timings

# The probe: one colony of ROWS × COLUMNS cells for ALONE_BLOCKS blocks of steps, then
# PROBE_COLONIES colonies, until time is up or each has PROBE_CELLS cells. The steps of a block are
# timed. At first, and whenever the cells are COUNT_AGAIN times as many, the bytes of one more step
# are counted, which takes far longer.
ROWS, COLUMNS, ALONE_BLOCKS, PROBE_COLONIES, PROBE_CELLS, BLOCK_STEPS, COUNT_AGAIN = (
    8,
    4,
    4,
    8,
    100,
    5,
    2,
)


class Spending(Timings):
    """Counts torch operators instead of seconds, for each effect of `model.step(state, dt,
    spending)` by title: calls by operator name, and bytes of their results."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[str, Counter[str]] = {}
        self.bytes: dict[str, int] = {}

    @contextmanager
    def of(self, name: str, device: torch.device) -> Iterator[None]:
        """Adds the operators and bytes of this block to `name`."""
        with Operators() as seen:
            yield
        self.calls[name] = self.calls.get(name, Counter()) + seen.calls
        self.bytes[name] = self.bytes.get(name, 0) + seen.bytes


@dataclass(frozen=True)
class ProbeSteps:
    """A few steps of a probe.

    cells: mean number in all colonies. seconds: median of a step, by effect. bytes: what one step
    allocated for results, by effect; empty if not counted.
    """

    cells: float
    colonies: int
    seconds: dict[str, float]
    bytes: dict[str, int]


@dataclass(frozen=True)
class Cost:
    """Of an effect in one step: a + b · cells + c · colonies; in colonies of more than `crowd`
    cells, b grows as their number to the power `crowding`."""

    a: float
    b: float
    c: float
    crowding: float = 0.0
    crowd: float = PROBE_CELLS

    def of(self, cells: float, colonies: int) -> float:
        """For a number of cells in each of so many colonies."""
        grown = max(1.0, cells / self.crowd) ** self.crowding
        return self.a + self.b * grown * cells * colonies + self.c * colonies


@dataclass(frozen=True)
class CostProbe:
    """The measurement of a scene's first steps.

    first, last: the states at the start and end of the run with several colonies. failed: why a
    step failed, or "". laid: whether the colonies started as a laid-out crowd, not as the scene's
    founders. seconds: how long it took, without the warm-up.
    """

    model: Model
    blocks: list[ProbeSteps]
    first: State
    last: State
    failed: str
    laid: bool
    seconds: float

    def fit(self, what: str) -> dict[str, Cost]:
        """Fits "seconds" or "bytes" of a step by a + b · cells + c · colonies ≥ 0, by effect, by
        least squares of the relative errors. A grid is per colony, all else per cell: so effects on
        grids have b = 0, the others c = 0."""
        found = {}
        for title in self.blocks[0].seconds:
            effects = [e for e in self.model.effects if e.title == title]
            on_grid = any(e.works_on_grid for e in effects)
            # only their time: the bytes of contacts are in proportion to the cells
            power = sum(e.effect.crowding for e in effects) if what == "seconds" else 0.0
            crowd = max(1.0, float(self.last.counts.max()))
            blocks = [block for block in self.blocks if getattr(block, what)]
            rows = [(1.0, float(block.colonies if on_grid else block.cells)) for block in blocks]
            value = np.array([getattr(block, what)[title] for block in blocks], dtype=float)
            weight = 1.0 / np.maximum(value, 1e-9)
            (start, slope), _ = nnls(np.array(rows) * weight[:, None], value * weight)
            found[title] = (
                Cost(start, 0.0, slope) if on_grid else Cost(start, slope, 0.0, power, crowd)
            )
        return found


def crowd(founders: Cells) -> Cells:
    """A small colony without growing one: cells side by side around the founders' centre, each a
    copy of the nearest founder."""
    mine = (
        np.flatnonzero(founders.colony == 0)
        if founders.colony is not None
        else np.arange(founders.count)
    )
    along = founders.axis[mine[0]]
    across = np.zeros_like(along)
    across[:2] = (-along[1], along[0]) if along[:2].any() else (0.0, 1.0)
    across /= np.linalg.norm(across)
    width = 2.0 * float(founders.radius[mine].max())
    long = float(founders.length[mine].max()) + width
    column, row = (
        x.reshape(-1, 1)
        for x in np.meshgrid(
            np.arange(COLUMNS) - (COLUMNS - 1) / 2, np.arange(ROWS) - (ROWS - 1) / 2
        )
    )
    position = founders.position[mine].mean(0) + column * long * along + row * width * across
    like = mine[((position[:, None] - founders.position[mine]) ** 2).sum(2).argmin(1)]
    kind = None if founders.cell_type is None else founders.cell_type[like]
    extra = {name: values[like] for name, values in founders.extra.items()}
    return Cells(position, along, founders.length[like], founders.radius[like], kind, extra=extra)


def probe(scene: Scene, colonies: int, device: str | torch.device, seconds: float) -> CostProbe:
    """Runs a scene's first steps for about `seconds`, after a warm-up: one colony, then several.
    `colonies` is the number of colonies to seed."""
    laid = scene.founders.count > 0
    try:
        laid_out = crowd(scene.founders) if laid else scene.founders
        model = scene.bind(colonies, cells=laid_out, device=device, per_colony=True)
    except checks.InputError:  # no room for a crowd, between walls or in the medium's box
        laid, model = False, scene.bind(colonies, device=device, per_colony=True)
    state = model.start()
    _warm_up(model, state.select([0]), seconds)
    begun = time.perf_counter()
    blocks, _, failed = _watched(model, state.select([0]), ALONE_BLOCKS, begun + seconds / 4)
    first = state.select(list(range(min(PROBE_COLONIES, state.colonies))))
    more, last, also = _watched(model, first, 10**6, begun + seconds)
    took = time.perf_counter() - begun
    return CostProbe(model, blocks + more, first, last, failed or also, laid, took)


@torch.no_grad()
def _warm_up(model: Model, state: State, seconds: float) -> None:
    """One step, and as many as it takes to a first division, for at most `seconds` more. Kernels
    are compiled when they are first called, which takes longer than all that is measured."""
    state = model.step(state)
    end = time.perf_counter() + seconds
    divides = any("divide_flag" in effect.writes() for effect in model.effects)
    while divides and not (state.births or failures(state)) and time.perf_counter() < end:
        state = model.step(state)


@torch.no_grad()
def _watched(
    model: Model, state: State, most: int, end: float
) -> tuple[list[ProbeSteps], State, str]:
    """Runs blocks of steps, at least one, until there are `most`, or enough cells, or the clock
    reaches `end`. Returns the blocks, the last state, and why a step failed, or ""."""
    state = model.step(state)  # what is worked out once for a batch is untimed
    blocks: list[ProbeSteps] = []
    counted, broken = 0, failures(state)
    while not broken and (
        not blocks
        or (
            len(blocks) < most
            and time.perf_counter() < end
            and bool((state.counts < PROBE_CELLS).any())
        )
    ):
        taken: list[dict[str, float]] = []
        counts = []
        timings = Timings()
        for later in advance(partial(model.step, timings=timings), state):
            state = later
            taken.append(dict(timings.seconds))
            timings.seconds.clear()
            counts.append(state.cells)
            broken = broken or failures(state)
            if len(taken) == BLOCK_STEPS or time.perf_counter() > end:
                break
        spent = Spending()
        if state.cells >= counted * COUNT_AGAIN and (
            time.perf_counter() < end or state.colonies == 1
        ):
            counted = state.cells
            state = model.step(state, timings=spent)
        medians = {title: float(np.median([t[title] for t in taken])) for title in taken[0]}
        blocks.append(ProbeSteps(float(np.mean(counts)), state.colonies, medians, spent.bytes))
    return blocks, state, broken[0].reason if broken else ""


def state_bytes(state: State) -> tuple[float, float]:
    """Bytes of a state per cell, and per colony's grid."""
    cell = sum(getattr(state, n).nbytes for n in PER_CELL) + sum(
        v.nbytes for n, v in state.fields.items() if state.declared[n].scope == CELL
    )
    grid = sum(v.nbytes for n, v in state.fields.items() if state.declared[n].scope == GRID)
    return cell / max(1, state.cells), grid / state.colonies


def cost_lines(
    scene: Scene,
    seedable: int,
    cells: int,
    colonies: int,
    device: str | torch.device,
    seconds: float,
) -> list[str]:
    """The estimate, in lines of text."""
    seen = probe(scene, seedable, device, seconds)
    if not seen.blocks:
        return [f"estimated cost: none, since the first step failed: {seen.failed}"]
    spent, allocated = seen.fit("seconds"), seen.fit("bytes")
    total = cells * colonies
    each = {title: cost.of(cells, colonies) for title, cost in spent.items()}
    step = sum(each.values())
    shares = ", ".join(
        f"{title} {100 * t / step:.0f} %"
        for title, t in sorted(each.items(), key=lambda x: -x[1])
        if t >= 0.005 * step
    )
    per_cell, per_grid = state_bytes(seen.last)
    power = max(cost.crowding for cost in spent.values())
    working = sum(cost.of(cells, colonies) for cost in allocated.values())
    where = f"{cells} cells" + (f" in each of {colonies} colonies" if colonies > 1 else "")
    start = f"{ROWS * COLUMNS} cells laid side by side" if seen.laid else "the founders"
    lines = [
        (
            f"estimated cost at {where}, {seen.last.device.type}, float32,"
            f" {torch.get_num_threads()} thread(s) of this machine:"
        ),
        f"  a step   {_time(step)}: {shares}",
        f"  a run    {_run(scene, seen, spent, cells, colonies)}",
        (
            f"  memory   the state {_size(per_cell * total + per_grid * colonies)}; a step"
            f" allocates {_size(working)} in all and frees most on the way; with gradients, each"
            " step may keep all of it"
        ),
        (
            f"  how      measured for {seen.seconds:.1f} s from {start}: at most"
            f" {ALONE_BLOCKS * BLOCK_STEPS} steps of one colony, then {seen.last.step} of"
            f" {seen.last.colonies}, to {seen.last.cells} cells in all;"
        ),
        "           fitted by a + b · cells, for grids a + b · colonies"
        + (f"; contacts of larger colonies as their cells^{1 + power:g}" if power else ""),
        (
            "           an estimate, to a factor of two or three"
            " (less sure for far larger colonies than these): pressure slows growth, circuits may"
            " take more steps later,"
        ),
        "           and other work on the machine counts too",
    ]
    return lines + ([f"  warning  a probe failed: {seen.failed}"] if seen.failed else [])


def _run(scene: Scene, seen: CostProbe, spent: dict[str, Cost], cells: int, colonies: int) -> str:
    """Steps and time of a run from the founders to `cells` cells, at the growth rate of the probe's
    volume."""
    before, after = (max(1e-30, float(state.volume.sum())) for state in (seen.first, seen.last))
    pace = math.log2(after / before) / max(1, seen.last.step)
    if pace <= 0:
        return "no estimate: the probe did not grow"
    start = scene.founders.count / scene.founders.colonies
    steps = math.ceil(max(0.0, math.log2(cells / max(1.0, start))) / pace)
    taken = sum(
        cost.of(start * 2 ** (pace * k), colonies) for k in range(steps) for cost in spent.values()
    )
    leave = any(effect.stage in (LYSIS, REMOVAL) for effect in scene.effects)
    return (
        f"{steps} steps ({steps * scene.dt:.3g} h), {_time(taken)}, from the founders at the"
        " probe's growth rate; more if pressure or lack of nutrient slows growth"
        + (". Cells leave, so that colonies may never be so large" if leave else "")
    )


def _time(seconds: float) -> str:
    """Seconds in a suitable unit."""
    for unit, size in (("h", 3600.0), ("min", 60.0), ("s", 1.0)):
        if seconds >= size:
            return (
                f"{seconds / size:.2g} {unit}"
                if seconds < 10 * size
                else f"{seconds / size:.0f} {unit}"
            )
    return f"{seconds * 1e3:.2g} ms" if seconds < 0.01 else f"{seconds * 1e3:.0f} ms"


def _size(count: float) -> str:
    """Bytes in a suitable unit."""
    for unit, size in (("GB", 1e9), ("MB", 1e6)):
        if count >= size:
            return (
                f"{count / size:.2g} {unit}" if count < 10 * size else f"{count / size:.0f} {unit}"
            )
    return f"{count / 1e3:.2g} kB" if count < 1e4 else f"{count / 1e3:.0f} kB"
