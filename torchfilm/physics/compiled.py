"""Contact steps by compiled kernels: the same as `one_sided` and `bilateral`, on the CPU."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import torch
from torch import Tensor

from torchfilm.physics.contact_records import ContactSettings
from torchfilm.physics.one_sided_records import OneSidedSettings
from torchfilm.physics.step_records import StepInput, StepResult
from torchfilm.physics.surfaces import FlatSurface
from torchfilm.tools.numba_calls import as_array
from torchfilm.tools.ragged import Groups, offsets
from torchfilm.tools.threads import available, pool

# Batches with fewer cells than this take one thread: to start the others costs more.
WORTH_THREADS = 300


_called: set[str] = set()  # names of kernels that this process has called


@torch.no_grad()
def substeps(groups: Groups, position: Tensor, *of_cells: Tensor, longest: float):
    """As `physics.substeps.substeps`."""
    from torchfilm.kernels.substeps import substeps as put

    steps, status = torch.ones_like(groups.counts), torch.zeros_like(groups.counts)
    dtype = of_cells[0].dtype
    arrays = [as_array(position, torch.float64), *(as_array(x, dtype) for x in of_cells)]
    put(groups.owner.numpy(), *arrays, longest, steps.numpy(), status.numpy())
    return steps, status


@torch.no_grad()
def contact_steps(given: StepInput) -> StepResult:
    """As `one_sided.contact_steps` and `bilateral.contact_steps`."""
    from torchfilm.kernels import step as kernels
    from torchfilm.kernels.compiling import first_call

    dtype = given.radius.dtype
    name = f"{given.settings.dim}-D, {str(dtype).removeprefix('torch.')}"
    step_colonies, numbers = _kernel_of(given.settings)
    if isinstance(given.settings, ContactSettings):
        name = f"{name}, bilateral"
    counts = given.groups.counts
    begin, steps = offsets(counts).numpy(), given.steps.numpy()
    position, axis = given.position.clone(), given.axis.clone()
    length, move = given.length.clone(), given.start.clone()
    hardness = given.hardness.clone()
    reports = np.zeros((counts.numel(), kernels.REPORT))
    arguments = (
        begin, steps, position.numpy(), axis.numpy(), length.numpy(),
        *(as_array(x, dtype) for x in (given.growth, given.radius, given.viscosity,
        given.length_drag)), move.numpy(), hardness.numpy(), *_walls(given),
        as_array(given.radius[:0] if given.alpha is None else given.alpha, dtype),
        *([] if isinstance(given.settings, ContactSettings) else [as_array(given.shortest, dtype)]),
        numbers, reports, (0,) * (4 if given.settings.dim == 2 else 8),
    )  # fmt: skip
    new = name not in _called
    with first_call(name, f"contacts ({name}), some 20 s") if new else nullcontext():
        _call(step_colonies, begin, counts.numpy(), arguments)
    _called.add(name)
    error = torch.from_numpy(reports[:, kernels.ERROR].copy())
    reports[:, kernels.ERROR] = 0  # may be no number; the others are integers
    whole = torch.from_numpy(reports.T.astype(np.int64)).unbind()
    return StepResult(
        position, axis, length, move, hardness, whole[kernels.STATUS], whole[kernels.ITERATIONS],
        error, whole[kernels.PASSES], whole[kernels.CLIPPED], whole[kernels.DEEPLY],
    )  # fmt: skip


def _kernel_of(settings: OneSidedSettings | ContactSettings):
    """The kernel of this kind of contacts, and its settings as numbers."""
    overlap = -1.0 if settings.overlap is None else settings.overlap
    if isinstance(settings, ContactSettings):
        from torchfilm.kernels.bilateral import step_colonies as of_bilateral

        tolerance = -1.0 if settings.tolerance is None else settings.tolerance
        passes = settings.passes, settings.coarse_passes
        numbers = [overlap, tolerance, *passes, settings.max_iterations, settings.soft]
        return of_bilateral, np.array(numbers, dtype=np.float64)
    from torchfilm.kernels.step import step_colonies

    numbers = [
        overlap, settings.tolerance, settings.passes, settings.max_iterations, settings.soft,
        settings.contact_overlap,
    ]  # fmt: skip
    return step_colonies, np.array(numbers, dtype=np.float64)


def _call(kernel, begin: np.ndarray, counts: np.ndarray, arguments: tuple) -> None:
    """Call the kernel for all colonies, shared among threads, of which this is one. Colonies never
    meet, so the result does not depend on the number of threads."""
    threads = min(available(), counts.size)
    if threads < 2 or begin[-1] < WORTH_THREADS:
        kernel(np.arange(counts.size), *arguments)
        return
    # the largest first, each to the thread with the least work
    work = [0] * threads
    shares: list[list[int]] = [[] for _ in range(threads)]
    for colony in np.argsort(-counts, kind="stable").tolist():
        least = work.index(min(work))
        work[least] += int(counts[colony])
        shares[least].append(colony)
    own, *others = [np.array(share, np.int64) for share in shares]
    calls = [pool(threads).submit(kernel, share, *arguments) for share in others]
    kernel(own, *arguments)
    for call in calls:
        call.result()


def _walls(given: StepInput) -> tuple[np.ndarray, ...]:
    """Kinds (S,), places (S, B, 3), sizes (S, B), D or stiffness · Δt (S, N), and which are soft
    (S,)."""
    from torchfilm.kernels import rows

    surfaces, colonies = given.surfaces, given.groups.size
    kinds = np.zeros(len(surfaces), np.int64)
    places = np.zeros((len(surfaces), colonies, 3))
    sizes = np.zeros((len(surfaces), colonies))
    roots = np.ones((len(surfaces), given.radius.shape[0]))
    soft = np.zeros(len(surfaces), np.uint8)
    ids = given.ids if surfaces else None
    for k, (surface, (kind, value)) in enumerate(zip(surfaces, given.walls, strict=True)):
        if isinstance(surface, FlatSurface):
            place, size, kinds[k] = surface.normal, surface.offset, rows.FLAT
        else:
            place, size = surface.center, surface.radius
            kinds[k] = rows.INSIDE if surface.inside else rows.OUTSIDE
        for c, entry in enumerate(place):
            places[k, :, c] = _of_colonies(entry, ids)
        sizes[k] = _of_colonies(size, ids)
        soft[k] = kind == "stiffness"
        if value is not None:
            roots[k] = value.numpy()
    return kinds, places, sizes, roots, soft


def _of_colonies(given: float | Tensor, ids: Tensor | None):
    """A wall's number for each colony of the batch."""
    if not isinstance(given, Tensor):
        return given
    return given.double().numpy() if given.dim() == 0 else given.double()[ids].numpy()
