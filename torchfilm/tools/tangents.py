"""Which derivatives are wanted of a tensor: torch's backward pass, or its forward mode.

In forward mode a tensor carries its tangent, ∂/∂θ of each number along one direction θ, and torch
works out the tangent of a result together with the result. `numpy()` drops it without a word, so
that every function that leaves torch asks here first.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchfilm.tools.segments import no_segment


@contextmanager
def forward_mode() -> Iterator[None]:
    """Within it tensors may carry tangents."""
    _prepare_forward_mode()
    with forward_ad.dual_level():
        yield


@cache
def _prepare_forward_mode() -> None:
    """Compile torch's forward derivatives, without torch's own deprecation warning.

    Torch compiles them on first use, with a function that torch itself calls deprecated.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        with forward_ad.dual_level():
            forward_ad.make_dual(torch.ones(1), torch.ones(1)).exp()


@contextmanager
def outside_checkpoints() -> Iterator[None]:
    """Within it, what torch saves for a backward pass is not for a checkpoint that is under way:
    where the pass is done at once, or the work is done once and not again for a checkpoint."""
    with torch.autograd.graph.saved_tensors_hooks(lambda x: x, lambda x: x), no_segment():
        yield


def may_be_checkpoint() -> bool:
    """Whether what torch saves now for a backward pass may be for a checkpoint: then each backward
    pass inside the backward pass would do the work of the checkpoint once more."""
    hooks = getattr(torch._C._autograd, "_top_saved_tensors_default_hooks", None)
    return hooks is None or hooks(True) is not None


@contextmanager
def no_derivatives() -> Iterator[None]:
    """Within it results carry neither gradients nor tangents, and no derivative is wanted."""
    with torch.no_grad(), forward_ad._set_fwd_grad_enabled(False):
        yield


def in_forward_mode() -> bool:
    """Whether a tensor may carry a tangent now."""
    return forward_ad._current_level >= 0 and torch._C._is_fwd_grad_enabled()


def tangent(value: Tensor) -> Tensor | None:
    """What a tensor carries in forward mode, or None."""
    return forward_ad.unpack_dual(value).tangent


def graph_is_dead(x: Tensor) -> bool:
    """Whether a tensor made in no_grad says that it requires a gradient, as a view does, whose
    graph leads nowhere. One with a tangent does not count: it would lose it if it were detached."""
    return x.requires_grad and not torch.is_grad_enabled() and not has_tangent(x)


def has_tangent(*values: Tensor | None) -> bool:
    """Whether one of them carries a tangent."""
    return in_forward_mode() and any(x is not None and tangent(x) is not None for x in values)


def tracked(*values: Tensor | None) -> bool:
    """Whether a derivative of a result of these is wanted, of either kind."""
    if torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in values):
        return True
    return has_tangent(*values)


def only_forward(*values: Tensor | None) -> bool:
    """Whether a tangent of one of them is wanted, and no gradient by the backward pass."""
    given = [x for x in values if x is not None]
    return has_tangent(*given) and not (
        torch.is_grad_enabled() and any(x.requires_grad for x in given)
    )


def both(value: Tensor) -> tuple[Tensor, Tensor | None]:
    """The tensor without its tangent, and the tangent or None."""
    found = forward_ad.unpack_dual(value)
    return found.primal.detach(), found.tangent


def refuse_both(what: str, *given: Tensor) -> None:
    """Raise RuntimeError where these numbers carry a tangent and require a gradient, too: `what`
    gives one of the two, and the other would be lost."""
    if torch.is_grad_enabled() and has_tangent(*given) and any(x.requires_grad for x in given):
        raise RuntimeError(
            f"{what} passes tangents or gradients, and here both are wanted: run forward mode in"
            " torch.no_grad(), or leave tangents out."
        )


def with_tangent(value: Tensor, moved: Tensor | None) -> Tensor:
    """The tensor with a tangent, where there is one."""
    return value if moved is None else forward_ad.make_dual(value, moved)


def scaled(value: Tensor, factor: Tensor | float) -> Tensor:
    """value · factor. Where only the value carries a tangent, torch would work out the other half
    of the product rule, which is 0, in Python: half a millisecond a product."""
    own = isinstance(factor, Tensor) and has_tangent(factor)
    if not in_forward_mode() or own or not only_forward(value):
        return value * factor
    plain, moved = both(value)
    assert moved is not None
    return with_tangent(plain * factor, moved * factor)


def refuse_second(what: str, *back: Tensor | None) -> None:
    """Raise RuntimeError in a backward pass that is to be differentiated again, or in which what
    comes back carries a tangent: its own graph is not kept, so that second derivatives would be
    wrong."""
    if torch.is_grad_enabled() or has_tangent(*back):
        raise RuntimeError(
            f"there are no second derivatives through {what}: leave out create_graph=True, or take"
            " differences of gradients."
        )
