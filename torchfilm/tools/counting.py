"""What a piece of work asks of torch: operators dispatched, and bytes allocated for their results.
Free of the hardware's speed."""

from __future__ import annotations

from collections import Counter
from typing import Any

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class Operators(TorchDispatchMode):
    """Within `with Operators() as seen:` every operator is counted by name in `seen.calls`, and in
    `seen.bytes` the memory of results that are not views."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: Counter[str] = Counter()
        self.bytes = 0

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # or torch would load its compiler, a second or two, only to be told to leave this class
        # alone
        return False

    @property
    def total(self) -> int:
        """Operators in all."""
        return sum(self.calls.values())

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        self.calls[str(func)] += 1
        before = {x.untyped_storage().data_ptr() for x in tree_leaves((args, kwargs)) if _plain(x)}
        new = {
            x.untyped_storage().data_ptr(): x.untyped_storage().nbytes()
            for x in tree_leaves(out)
            if _plain(x)
        }
        self.bytes += sum(size for place, size in new.items() if place not in before)
        return out


def _plain(x: object) -> bool:
    """Whether x is a tensor with memory of its own kind, which a sparse one has not."""
    return isinstance(x, Tensor) and x.layout.__str__() == "torch.strided"
