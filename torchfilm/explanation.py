"""What a scene will simulate, by which methods, what it leaves out, and about what it will cost:
said before it runs.

The cost is measured, not modelled: the scene itself is run for a moment on a small crowd of cells,
once in a single colony and once in several, and the time and bytes of each effect are fitted by a +
b · cells, or a + b · colonies where it works on their grids. `torchfilm info` tells the same
scene's fields.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from torchfilm.effects.circuit import DIRECT, LEAP, STIFF, Circuit
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import COARSE_PASSES, PENALTY, TOLERANCE, Mechanics
from torchfilm.effects.medium import BLOCK, FirstHalf, GridCoverage, Medium
from torchfilm.effects.nutrition import Monod
from torchfilm.effects.removal import Removal
from torchfilm.effects.rules import Rules
from torchfilm.initial_cells import Cells
from torchfilm.replay import GrowthRecording
from torchfilm.scene import Scene, summary
from torchfilm.simulation import failures
from torchfilm.state import CELL, GRID, PER_CELL, State
from torchfilm.tools import checks
from torchfilm.tools.counting import Operators
from torchfilm.tools.timing import Timings

# Every effect that there is, in the order of a step.
KNOWN = (Rules, Division, Monod, Growth, Mechanics, Circuit, Medium, Removal)
# The probe: a colony of ROWS × COLUMNS cells alone for a few blocks of steps, then several side by
# side, until time is up or each has so many cells. The steps of a block are timed; at first, and
# whenever there are so many times the cells, the bytes of one more step are counted, which takes
# far longer.
ROWS, COLUMNS, ALONE_BLOCKS, PROBE_COLONIES, PROBE_CELLS, BLOCK_STEPS, COUNT_AGAIN = (
    8,
    4,
    4,
    8,
    100,
    5,
    2,
)
EVERY_SIGNAL = "no obstacle, and flow and decay the same everywhere"


def explain(
    scene: Scene,
    *,
    cells: int = 1000,
    colonies: int | None = None,
    device: str | torch.device = "cpu",
    seconds: float = 2.0,
) -> str:
    """How a scene will be simulated: effects and their methods, who drives whom, what is left out,
    whether one growth serves many designs, and an estimate of time and memory at `cells` cells in
    each of `colonies` colonies.

    colonies: by default as many as the scene's parameters and founders have, else 1. seconds: about
    how long the estimate may measure, by running the scene's first steps on `device` in float32,
    rules included; 0 leaves it out. Raises InputError where the scene cannot be seeded.
    """
    if not isinstance(scene, Scene):
        raise checks.input_error("scene", scene, "a Scene, such as tf.scenes.microcolony()")
    for name, given in (("cells", cells), ("colonies", colonies)):
        if given is not None and (
            isinstance(given, bool) or not isinstance(given, int) or given < 1
        ):
            raise checks.input_error(name, given, "a whole number from 1")
    checks.number("seconds", seconds, least=0.0)
    fixed = scene.fixed_colonies
    if fixed > 1 and colonies not in (None, fixed):
        raise checks.input_error(
            "colonies",
            colonies,
            f"{fixed}, as the scene's parameters or founders have",
            "Leave it out.",
        )
    state = scene.seed(fixed if fixed > 1 else PROBE_COLONIES, device=device)
    lines = [scene.headline]
    for effect in scene.effects:
        lines.append(f"  {effect.title:<10} {summary(effect)}")
        lines += [f"             {words}" for words in how(effect, state, scene.dt)]
    lines += ["  who drives whom:", *(f"    {line}" for line in scene.drives())]
    lines.append(
        f"  not simulated: {', '.join(left_out(scene)) or 'nothing'}"
        + (" (no field, no operation)" if left_out(scene) else "")
    )
    lines.append(f"  one growth for many designs: {replayed(scene)}")
    if seconds > 0:
        lines += [
            f"  {line}"
            for line in _cost(
                scene, state.colonies, cells, max(fixed, colonies or 1), device, seconds
            )
        ]
    return "\n".join(lines)


def left_out(scene: Scene) -> list[str]:
    """Titles of the effects that torchfilm has and this scene does not list, in the order of a
    step."""
    return [
        kind.title for kind in KNOWN if not any(isinstance(effect, kind) for effect in scene.listed)
    ]


def replayed(scene: Scene) -> str:
    """Whether the scene's growth can be recorded once and used for many designs, in words."""
    why = GrowthRecording.obstacle(scene)
    if why:
        return f"no, {why}"
    kept = {effect.title for effect in GrowthRecording.scene_of(scene).effects}
    follow = [
        effect.title
        for effect in sorted(scene.listed, key=lambda e: e.stage)
        if effect.title not in kept
    ]
    return f"yes, {' and '.join(follow)} only follow{'s' if len(follow) == 1 else ''} (GrowthRecording, Replay)"


# --- how each effect acts -------------------------------------------------------------------------


@singledispatch
def how(effect: object, state: State, dt: float) -> list[str]:
    """How an effect acts on this first state in steps of dt hours: method, tolerance and other
    knobs, in lines. None for effects of a user's own."""
    return []


@how.register
def _(effect: Rules, state: State, dt: float) -> list[str]:
    return ["your own Python, once a step on whole tensors"]


@how.register
def _(effect: Division, state: State, dt: float) -> list[str]:
    return [f"looked for once a step: up to {dt:g} h late"]


@how.register
def _(effect: Monod, state: State, dt: float) -> list[str]:
    return [
        "each cell by the stiff solver, with its default tolerances; what cells eat the medium"
        " loses, to rounding"
    ]


@how.register
def _(effect: Growth, state: State, dt: float) -> list[str]:
    return [
        (
            "exact over a step; what contacts hold back is taken off afterwards"
            if "displacement" in state.fields
            else "exact over a step"
        )
    ]


@how.register
def _(effect: Mechanics, state: State, dt: float) -> list[str]:
    if effect.stiffness is not None:
        kind = (
            f"soft, stiffness {_number(effect.stiffness)} μ·µm/h: α = 1/(stiffness·Δt) ="
            f" {_number(1.0 / (torch.as_tensor(effect.stiffness) * dt))}"
        )
    elif effect.alpha is not None:
        kind = f"hard by a penalty, α = {_number(effect.alpha)}"
    else:
        kind = (
            f"hard by a penalty, α = {PENALTY:g}/γ ="
            f" {_number(PENALTY / torch.as_tensor(effect.length_drag))} (default)"
        )
    mode = (
        "unilateral, they only push"
        if effect.unilateral
        else "bilateral, an overlapping pair is held until the next pass"
    )
    times = effect.most_passes
    lines = [
        f"contacts: {mode}; {kind}",
        f"passes: at most {times} a step"
        + (
            ""
            if effect.overlap is None
            else f", more than one only for new contacts and overlaps over {effect.overlap:g} µm"
        )
        + f"; a colony with a cell that grows more than {effect.max_elongation:g} µm takes"
        " sub-steps"
        + (f" of up to {COARSE_PASSES} passes" if effect.passes is None else "")
        + (
            ", one whose moves are cut short up to twice as many"
            if effect.passes is None and effect.dim == 3
            else ""
        ),
        (
            f"solver: conjugate gradients, each colony to a worst residual of {_accuracy(effect)},"
            f" at most {effect.max_iterations} iterations"
        ),
    ]
    soft = [wall for wall in effect.walls if wall.stiffness is not None or wall.weight is not None]
    if effect.walls:
        lines.append(
            f"walls: {len(effect.walls) - len(soft)} hard, {len(soft)} with a stiffness or weight"
        )
    return lines


@how.register
def _(effect: GridCoverage, state: State, dt: float) -> list[str]:
    return {
        "error": ["a cell beyond the box is its colony's failure"],
        "grow": [
            f"the box grows with its colony along {effect.medium.grows}, {BLOCK} voxels at a time"
        ],
        "reservoir": ["cells beyond the box meet a reservoir that stays as it is"],
    }[effect.medium.outside]


@how.register
def _(effect: FirstHalf, state: State, dt: float) -> list[str]:
    return ["of signals through the first half of the step, before the cells"]


@how.register
def _(effect: Circuit, state: State, dt: float) -> list[str]:
    said = {
        STIFF: (
            f"stiff solver (Rodas3), each cell in steps of its own: error at most {effect.atol:g} +"
            f" {effect.rtol:g}·|u| in each; nothing below 0"
        ),
        LEAP: (
            f"molecule by molecule, tau-leaping (ε = 0.03), {_number(effect.molecules_per_unit)} molecules in a"
            " unit of concentration × µm³; no gradient"
        ),
        DIRECT: (
            f"molecule by molecule, one event after the other, {_number(effect.molecules_per_unit)} molecules"
            " in a unit of concentration × µm³; no gradient"
        ),
    }
    lines = [
        said.get(
            effect.method,
            f"{effect.method}, {effect.steps} equal step(s) of {dt / effect.steps:g} h; nothing"
            " watches its error",
        )
    ]
    exchanged = list(dict.fromkeys(name for names in effect.noted.given.values() for name in names))
    if exchanged:
        lines.append(
            f"exchanges {', '.join(exchanged)} with each cell's own pool: amounts kept to rounding;"
            " first order in dt"
        )
    return lines


@how.register
def _(effect: Medium, state: State, dt: float) -> list[str]:
    assert state.layout is not None
    shape, spacing = state.layout.grid.shape[0].tolist(), state.layout.grid.spacing
    lines = [
        f"grid: {' × '.join(map(str, shape))} voxels of {' × '.join(f'{h:g}' for h in spacing)} µm"
        " a colony"
    ]
    finest = min((h for n, h in zip(shape, spacing, strict=True) if n > 1), default=spacing[0])
    lines.append(
        "half of transport before the cells, half after (Strang)"
        if effect.splitting == "strang"
        else "cells, then transport (Lie)"
    )
    part = dt / effect.steps / (2 if effect.splitting == "strang" else 1)
    for name, signal in effect.signals.items():
        method, why = transport(effect, name)
        order = (
            "exact over a step"
            if method == "exponential"
            else f"order {2 if method == 'crank_nicolson' else 1} in steps of {part:g} h"
        )
        lines.append(
            f"{name}: {method}, {order} ({why}); dt·K/h² ="
            f" {_number(torch.as_tensor(signal.diffusion) * (dt / finest**2))}"
        )
    return lines


@how.register
def _(effect: Removal, state: State, dt: float) -> list[str]:
    return ["once a step, by the cell's centre"]


def _accuracy(effect: Mechanics) -> str:
    """The tolerance of the solve in words."""
    if effect.tolerance is not None:
        return f"{effect.tolerance:g}"
    return (
        f"{TOLERANCE:g} (default"
        + (
            ""
            if effect.alpha is None and effect.stiffness is None
            else f"; less where α·γ is below {PENALTY:g}"
        )
        + ")"
    )


def transport(medium: Medium, name: str) -> tuple[str, str]:
    """The method by which a signal is transported, and why: as `signals.transport.choose` has
    it."""
    if medium.method is not None:
        return medium.method, "as asked for"
    found = {
        "obstacles": medium.obstacles is not None,
        "a flow that differs from place to place": callable(medium.flow_of(name)),
        "a decay that differs from place to place": callable(medium.signals[name].decay),
    }
    against = [words for words, there in found.items() if there]
    return (
        ("implicit", "because of " + " and ".join(against))
        if against
        else ("exponential", EVERY_SIGNAL)
    )


def _number(value: float | Tensor) -> str:
    """One number, or the range of one per colony."""
    low, high = (
        float(x) for x in torch.aminmax(torch.as_tensor(value, dtype=torch.float64).detach())
    )
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


# --- what it costs --------------------------------------------------------------------------------


class Spending(Timings):
    """In place of seconds, what each effect of `scene.step(state, dt, spending)` asks of torch, by
    title: operators by name, and bytes for their results."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[str, Counter[str]] = {}
        self.bytes: dict[str, int] = {}

    @contextmanager
    def of(self, name: str, device: torch.device) -> Iterator[None]:
        """Count what this block asks for under `name`."""
        with Operators() as seen:
            yield
        self.calls[name] = self.calls.get(name, Counter()) + seen.calls
        self.bytes[name] = self.bytes.get(name, 0) + seen.bytes


@dataclass(frozen=True)
class Block:
    """A few steps of a probe: mean cells in all, colonies, and by effect the median seconds of a
    step and, if they were counted, the bytes that one allocated for results."""

    cells: float
    colonies: int
    seconds: dict[str, float]
    bytes: dict[str, int]


@dataclass(frozen=True)
class Probe:
    """What a scene's first steps took: blocks, where the several colonies began and ended, what
    failed, if something did, and whether they began as a crowd that was laid out, or as the scene's
    founders."""

    blocks: list[Block]
    first: State
    last: State
    failed: str
    laid: bool

    def fit(self, scene: Scene, what: str) -> dict[str, tuple[float, float, float]]:
        """By effect (a, b, c) ≥ 0 of a + b · cells + c · colonies, for "seconds" or "bytes" of a
        step, by least squares of the relative errors. A grid is per colony, all else per cell:
        effects that work on grids have b = 0, the others c = 0."""
        found = {}
        for title in self.blocks[0].seconds:
            on_grid = any(
                e.title == title and isinstance(e, (Medium, GridCoverage)) for e in scene.effects
            )
            blocks = [block for block in self.blocks if getattr(block, what)]
            rows = [(1.0, float(block.colonies if on_grid else block.cells)) for block in blocks]
            value = np.array([getattr(block, what)[title] for block in blocks], dtype=float)
            weight = 1.0 / np.maximum(value, 1e-9)
            (start, slope), _ = nnls(np.array(rows) * weight[:, None], value * weight)
            found[title] = (start, 0.0, slope) if on_grid else (start, slope, 0.0)
        return found


def crowd(founders: Cells) -> Cells:
    """Cells like the nearest founder each, laid side by side about the founders' middle: a small
    colony that need not be grown."""
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


def probe(scene: Scene, colonies: int, device: str | torch.device, seconds: float) -> Probe:
    """Run a scene's first steps: one colony, then several, of `colonies` that it can be seeded
    with, for about so many seconds."""
    begun, laid = time.perf_counter(), True
    try:
        state = scene.seed(colonies, cells=crowd(scene.founders), device=device)
    except checks.InputError:  # no room for a crowd, between walls or in the medium's box
        laid, state = False, scene.seed(colonies, device=device)
    blocks, _, failed = _watched(scene, state.select([0]), ALONE_BLOCKS, begun + seconds / 4)
    first = state.select(list(range(min(PROBE_COLONIES, state.colonies))))
    more, last, also = _watched(scene, first, 10**6, begun + seconds)
    return Probe(blocks + more, first, last, failed or also, laid)


@torch.no_grad()
def _watched(scene: Scene, state: State, most: int, end: float) -> tuple[list[Block], State, str]:
    """Blocks of steps, at least one, until there are `most`, or cells enough, or the clock shows
    `end`; the state then; what failed."""
    state = scene.step(state, scene.dt)  # what is made once is made now
    blocks: list[Block] = []
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
        for _ in range(BLOCK_STEPS):
            timings = Timings()
            state = scene.step(state, scene.dt, timings)
            taken.append(timings.seconds)
            counts.append(state.cells)
            broken = broken or failures(state)
            if time.perf_counter() > end:
                break
        spent = Spending()
        if state.cells >= counted * COUNT_AGAIN and (
            time.perf_counter() < end or state.colonies == 1
        ):
            counted = state.cells
            state = scene.step(state, scene.dt, spent)
        medians = {title: float(np.median([t[title] for t in taken])) for title in taken[0]}
        blocks.append(Block(float(np.mean(counts)), state.colonies, medians, spent.bytes))
    return blocks, state, broken[0].reason if broken else ""


def state_bytes(state: State) -> tuple[float, float]:
    """Bytes of a state for each cell, and for each colony's grid."""
    cell = sum(getattr(state, n).nbytes for n in PER_CELL) + sum(
        v.nbytes for n, v in state.fields.items() if state.declared[n].scope == CELL
    )
    grid = sum(v.nbytes for n, v in state.fields.items() if state.declared[n].scope == GRID)
    return cell / max(1, state.cells), grid / state.colonies


def _cost(
    scene: Scene,
    seedable: int,
    cells: int,
    colonies: int,
    device: str | torch.device,
    seconds: float,
) -> list[str]:
    """The estimate in lines."""
    begun = time.perf_counter()
    seen = probe(scene, seedable, device, seconds)
    took = time.perf_counter() - begun
    if not seen.blocks:
        return [f"estimated cost: none, since the first step failed: {seen.failed}"]
    spent, asked = seen.fit(scene, "seconds"), seen.fit(scene, "bytes")
    total = cells * colonies
    each = {title: value(abc, total, colonies) for title, abc in spent.items()}
    step = sum(each.values())
    shares = ", ".join(
        f"{title} {100 * t / step:.0f} %"
        for title, t in sorted(each.items(), key=lambda x: -x[1])
        if t >= 0.005 * step
    )
    per_cell, per_grid = state_bytes(seen.last)
    working = sum(value(abc, total, colonies) for abc in asked.values())
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
            f" allocates {_size(working)} in all and frees most as it goes; with gradients, up to"
            " that is kept for each step"
        ),
        (
            f"  how      measured for {took:.1f} s from {start}: at most"
            f" {ALONE_BLOCKS * BLOCK_STEPS} steps of one colony, then {seen.last.step} of"
            f" {seen.last.colonies}, to {seen.last.cells} cells in all;"
        ),
        "           fitted by a + b · cells, for grids a + b · colonies",
        (
            "           an estimate, to a factor of two or three: larger colonies take more"
            " iterations to solve, circuits may get busier than they begin,"
        ),
        "           and other work on the machine counts too",
    ]
    return lines + ([f"  warning  a probe failed: {seen.failed}"] if seen.failed else [])


def value(abc: tuple[float, float, float], cells: float, colonies: float) -> float:
    """a + b · cells + c · colonies."""
    return abc[0] + abc[1] * cells + abc[2] * colonies


def _run(
    scene: Scene,
    seen: Probe,
    spent: dict[str, tuple[float, float, float]],
    cells: int,
    colonies: int,
) -> str:
    """Steps and time of a run from the founders to so many cells, at the pace at which the probe's
    volume grew."""
    before, after = (max(1e-30, float(state.volume.sum())) for state in (seen.first, seen.last))
    pace = math.log2(after / before) / max(1, seen.last.step)
    if pace <= 0:
        return "not foretold: the probe did not grow"
    start = scene.founders.count / scene.founders.colonies
    steps = math.ceil(max(0.0, math.log2(cells / max(1.0, start))) / pace)
    taken = sum(
        value(abc, start * 2 ** (pace * k) * colonies, colonies)
        for k in range(steps)
        for abc in spent.values()
    )
    return (
        f"{steps} steps ({steps * scene.dt:.3g} h), {_time(taken)}, from the founders at the"
        " probe's pace; more where pressure or hunger holds growth back"
    )


def _time(seconds: float) -> str:
    """Seconds in a unit that suits."""
    for unit, size in (("h", 3600.0), ("min", 60.0), ("s", 1.0)):
        if seconds >= size:
            return (
                f"{seconds / size:.2g} {unit}"
                if seconds < 10 * size
                else f"{seconds / size:.0f} {unit}"
            )
    return f"{seconds * 1e3:.2g} ms" if seconds < 0.01 else f"{seconds * 1e3:.0f} ms"


def _size(count: float) -> str:
    """Bytes in a unit that suits."""
    for unit, size in (("GB", 1e9), ("MB", 1e6)):
        if count >= size:
            return (
                f"{count / size:.2g} {unit}" if count < 10 * size else f"{count / size:.0f} {unit}"
            )
    return f"{count / 1e3:.2g} kB" if count < 1e4 else f"{count / 1e3:.0f} kB"
