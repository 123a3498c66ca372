"""A step of mechanics by compiled kernels: the same as `torch_step`, on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import nullcontext
from functools import cache, lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from torchfilm.physics.contact_records import ContactReport, ContactSettings
from torchfilm.physics.one_sided_records import OneSidedSettings
from torchfilm.physics.surfaces import FlatSurface, Surface
from torchfilm.tools.numba_calls import as_array, in_numpy
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import available, submit

# Batches with fewer cells than this take one thread: to start the others costs more.
WORTH_THREADS = 150
# A large colony is solved by a team of threads, each with this many cells or more. Growth to 10,000
# cells took two threads 0.84 of the time of teams from 8,000 cells on, 0.80 in free growth; that to
# 3,000 cells took as long. Half as many cells a thread gained nothing more.
CELLS_A_THREAD = 1000

# A tuple as long as rows have columns: seven in space, and the last column stays 0.
DEGREES = {2: (0,) * 4, 3: (0,) * 8}

# of cells that neither stick together nor move by themselves
NOTHING = np.empty((0, 0)), np.empty(0), np.empty((0, 0)), np.empty((0, 1), np.bool_)

# which kernels this process has called: type of settings, dimension, type of numbers
_called: set[tuple[type, int, np.dtype]] = set()


def step(
    settings: OneSidedSettings | ContactSettings, groups: Groups, dt: float, longest: float,
    cells: tuple[np.ndarray, ...], drags: tuple[np.ndarray, ...], alphas: tuple[int, np.ndarray],
    walls: tuple[np.ndarray, ...], given: tuple[np.ndarray, ...] | None = None,
) -> tuple[tuple[np.ndarray, ...], ContactReport, Tensor]:  # fmt: skip
    """As `torch_step.step`, from arrays to arrays: see `kernels.colonies`. Returns what the cells
    in the groups become, the report, and the sub-steps of each colony. given: see
    `kernels.bonds`."""
    from torchfilm.kernels import colonies as kernels

    position, axis, length, elongation, _, move, collapsed, alpha, compression = cells
    kind = type(settings), settings.dim, length.dtype
    step_colonies, numbers = _kernel_of(settings)
    changed = position, axis, length, move, elongation, collapsed, alpha, compression
    out = tuple(np.empty_like(a) for a in changed)
    reports = np.zeros((groups.size, kernels.REPORT))
    reports[:, kernels.SUBSTEPS] = 1
    degrees = DEGREES[settings.dim]
    one_sided = isinstance(settings, OneSidedSettings)
    arguments = (
        groups.begin.numpy(), float(dt), float(longest), cells, drags, alphas,
        *([given or NOTHING] if one_sided else []), walls, numbers, out, reports, degrees,
    )  # fmt: skip
    counts, every = groups.counts.numpy(), np.arange(groups.size)
    with nullcontext() if kind in _called else _first_call(*kind):
        # how work is shared does not change the result
        if one_sided:
            of_rows = length.dtype.type, len(degrees)
            _call_by_teams(step_colonies, of_rows, every, counts, arguments)
        else:
            share_among_threads(step_colonies, every, counts, arguments)
    _called.add(kind)
    residual, used = torch.from_numpy(reports.T[[kernels.ERROR, kernels.ALPHA]]).unbind()
    reports[:, kernels.ERROR] = 0  # may be no number; the others are integers
    whole = torch.from_numpy(reports.T.astype(np.int64)).unbind()
    report = ContactReport(
        whole[kernels.STATUS], whole[kernels.ITERATIONS], residual, whole[kernels.PASSES],
        whole[kernels.CLIPPED], whole[kernels.DEEPLY], used,
    )  # fmt: skip
    return out, report, whole[kernels.SUBSTEPS]


def _first_call(settings: type, dim: int, dtype: np.dtype):
    """Says that a kernel is compiled, unless it was kept."""
    from torchfilm.kernels.compiling import first_call

    name = f"{dim}-D, {dtype.name}"
    name += ", bilateral" if settings is ContactSettings else ""
    return first_call(name, f"contacts ({name}), 20 s to a minute")


def array_or_none(value: Tensor | None, dtype: torch.dtype) -> np.ndarray:
    """(N,), or (1,) of a number for all cells; (0,) for None."""
    if value is None:
        return np.empty(0, in_numpy(dtype))
    if value.dim() == 0:
        return np.array([value.item()], in_numpy(dtype))
    return as_array(value, dtype)


def alpha_arrays(
    alpha: Tensor | None, stiffness: Tensor | None, dtype: torch.dtype
) -> tuple[int, np.ndarray]:
    """How α is given, and its values or stiffness: see `kernels.colonies`."""
    from torchfilm.kernels.colonies import GIVEN, NOT_GIVEN, OF_STIFFNESS

    if stiffness is not None:
        return OF_STIFFNESS, array_or_none(stiffness, dtype)
    return GIVEN if alpha is not None else NOT_GIVEN, array_or_none(alpha, dtype)


@lru_cache(maxsize=100)
def _kernel_of(settings: OneSidedSettings | ContactSettings):
    """The kernel of this kind of contacts, and its settings as numbers."""
    overlap = settings.overlap
    if isinstance(settings, ContactSettings):
        overlap = -1.0 if overlap is None else overlap
        from torchfilm.kernels.bilateral import step_colonies as of_bilateral

        tolerance = -1.0 if settings.tolerance is None else settings.tolerance
        passes = settings.passes, settings.coarse_passes
        numbers = [overlap, tolerance, *passes, settings.max_iterations, settings.soft]
        return of_bilateral, np.array(numbers, dtype=np.float64)
    from torchfilm.kernels.step import step_colonies

    periods = () if settings.space is None else settings.space.period
    overlap = -settings.too_deep if overlap is None else overlap
    numbers = [
        overlap, settings.tolerance, settings.passes, settings.max_iterations, settings.soft,
        settings.contact_overlap, *periods, *[0.0] * (3 - len(periods)),
    ]  # fmt: skip
    return step_colonies, np.array(numbers, dtype=np.float64)


def share_among_threads(kernel, which: np.ndarray, counts: np.ndarray, arguments: tuple) -> None:
    """Call the kernel for the colonies `which`, shared among threads, of which this is one."""
    from torchfilm.kernels.memory import kept

    threads, taken = min(available(), which.size), np.zeros(1, np.int64)
    if threads < 2 or counts[which].sum() < WORTH_THREADS:
        kept.call(kernel, taken, which, *arguments)
        return
    # the largest first; a thread that wakes late finds less to do, or nothing
    which = which[np.argsort(-counts[which], kind="stable")]
    calls: list[Future] = []
    try:
        for _ in range(threads - 1):
            calls.append(submit(kept.call, kernel, taken, which, *arguments))
        kept.call(kernel, taken, which, *arguments)
    finally:
        taken[0] = which.size  # after an error, too: nobody takes another one
        _wait(calls)


def _call_by_teams(
    kernel, kind: tuple[type, int], which: np.ndarray, counts: np.ndarray, arguments: tuple
) -> None:
    """As `share_among_threads`, for a kernel that a team can run. A colony so large that as many
    others would leave threads of its team idle comes first, by a team. kind: type of numbers,
    columns."""
    from torchfilm.kernels.team import AVAILABLE

    by_one_thread = partial(kernel, np.zeros(0, np.int64))
    if not AVAILABLE or counts.max(initial=0) < 2 * CELLS_A_THREAD:
        share_among_threads(by_one_thread, which, counts, arguments)
        return
    teams = np.minimum(counts // CELLS_A_THREAD, available())
    large = (teams > 1) & (counts * teams > counts.sum())
    for colony in which[large]:
        _call_by_team(kernel, int(teams[colony]), colony, kind, arguments)
    if not large.all():
        share_among_threads(by_one_thread, which[~large], counts, arguments)


def _call_by_team(
    kernel, threads: int, colony: int, kind: tuple[type, int], arguments: tuple
) -> None:
    """Call the kernel for one colony, by a team of threads that this one leads. It waits for no
    thread to begin: one that comes late finds nothing to do."""
    from torchfilm.kernels.memory import kept
    from torchfilm.kernels.pieces import taker
    from torchfilm.kernels.team import OFFER, OVER, new_board

    take = taker(*kind)
    board = new_board(threads, 2 * CELLS_A_THREAD, take.address)

    def assist():
        take.ctypes(board.ctypes.data, 0)  # the board lives as long as this

    calls: list[Future] = []
    try:
        for _ in range(threads - 1):
            calls.append(submit(assist))
        by_team = partial(kernel, board)
        kept.call(by_team, np.zeros(1, np.int64), np.array([colony]), *arguments)
    finally:
        board[OFFER] = OVER
        _wait(calls)


def _wait(calls: list[Future]) -> None:
    """Wait for the calls that have begun; the others are left out."""
    for call in calls:
        if not call.cancel():
            call.result()


def wall_arrays(
    surfaces: Sequence[Surface], walls: Sequence[tuple[str, Tensor | None]], ids: Tensor, cells: int
) -> tuple[np.ndarray, ...]:
    """Kinds (S,), places (S, B, 3), sizes (S, B), D or stiffness (S, N), and which are soft
    (S,), for the colonies `ids` (B,) of N cells."""
    from torchfilm.kernels import rows

    colonies = ids.numel()
    if not surfaces:
        return _no_walls(colonies)
    kinds = np.zeros(len(surfaces), np.int64)
    places = np.zeros((len(surfaces), colonies, 3))
    sizes = np.zeros((len(surfaces), colonies))
    roots = np.ones((len(surfaces), cells))
    soft = np.zeros(len(surfaces), np.uint8)
    for k, (surface, (kind, value)) in enumerate(zip(surfaces, walls, strict=True)):
        if isinstance(surface, FlatSurface):
            place, size, kinds[k] = surface.normal, surface.offset, rows.FLAT
        else:
            place, size = surface.centre, surface.radius
            kinds[k] = rows.INSIDE if surface.inside else rows.OUTSIDE
        for c, entry in enumerate(place):
            places[k, :, c] = _of_colonies(entry, ids)
        sizes[k] = _of_colonies(size, ids)
        soft[k] = kind == "stiffness"
        if value is not None:
            roots[k] = value.detach().numpy()
    return kinds, places, sizes, roots, soft


@cache
def _no_walls(colonies: int) -> tuple[np.ndarray, ...]:
    """As `wall_arrays`, where there are none."""
    none = np.zeros(0, np.int64)
    places, sizes, roots = np.zeros((0, colonies, 3)), np.zeros((0, colonies)), np.ones((0, 0))
    return none, places, sizes, roots, none.astype(np.uint8)


def _of_colonies(given: float | Tensor, ids: Tensor):
    """A wall's number for each colony of the batch."""
    if not isinstance(given, Tensor):
        return given
    values = given.detach().double()
    return (values if values.dim() == 0 else values[ids]).numpy()
