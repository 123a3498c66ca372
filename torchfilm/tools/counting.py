"""Counts of torch operators and of the bytes that they allocate, independent of hardware speed."""

from __future__ import annotations

from collections import Counter
from typing import Any

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class Operators(TorchDispatchMode):
    """Counts operators within `with Operators() as seen:`.

    `seen.calls` has the number of calls by name; `seen.bytes` the memory of results that are not
    views.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls: Counter[str] = Counter()
        self.bytes = 0

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # otherwise torch would load its compiler, for a second or two, only to skip this class
        return False

    @property
    def total(self) -> int:
        """The number of operators."""
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
        self.bytes += sum(size for address, size in new.items() if address not in before)
        return out


def _plain(x: object) -> bool:
    """Whether x is a strided tensor; a sparse one has no memory of that kind."""
    return isinstance(x, Tensor) and x.layout.__str__() == "torch.strided"
