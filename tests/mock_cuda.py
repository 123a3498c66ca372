"""Tensors of the CPU that say they are on CUDA, and input_error to meet others: what a machine
without a GPU can tell about device="cuda".

Not that it is fast, or that its sums are ordered; but that every tensor is made on the device that
was asked for, that none is read by NumPy, and that the ways taken on CUDA only do what they should.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map

CUDA = torch.device("cuda:0")
# What CUDA, too, lets tensors of two devices take part in.
MAY_MEET = {
    "copy_",
    "to",
    "__getitem__",
    "__setitem__",
    "type_as",
    "__get__",
    "__set__",
    "new_tensor",
    "as_tensor",
    "tensor",
    "cpu",
    "__repr__",
    "__format__",
}
# What must see the very tensors that it is given, and not others that share their numbers.
OF_LEAVES = {"grad", "requires_grad_", "backward"}
LISTS = ("stack", "cat")
# Sums whose order, and so whose bits, are not fixed on CUDA.
UNORDERED = {"cumsum", "index_add", "index_add_"}
AS_TENSOR = torch.as_tensor


class Pretended(torch.Tensor):
    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        return _work(func, args, kwargs or {})


class PretendedCuda(TorchFunctionMode):
    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        flat = tree_flatten((args, kwargs))[0]
        if func is not torch.device and any(type(x) is Pretended or _is_cuda(x) for x in flat):
            return _work(func, args, kwargs)
        return func(*args, **kwargs)


@pytest.fixture
def pretended_cuda(monkeypatch):
    """In a test that asks for this, device="cuda" is to be had."""
    for name, value in (
        ("is_available", True),
        ("device_count", 1),
        ("current_device", 0),
        ("synchronize", None),
        ("_lazy_init", None),
    ):
        monkeypatch.setattr(torch.cuda, name, lambda *_, value=value: value)
    monkeypatch.setattr(torch, "as_tensor", _as_tensor)
    with PretendedCuda():
        yield


def _is_device(x: Any) -> bool:
    return isinstance(x, torch.device) or (
        isinstance(x, str) and (x == "cpu" or x.startswith("cuda"))
    )


def _is_cuda(x: Any) -> bool:
    return _is_device(x) and torch.device(x).type == "cuda"


def _plain(x: Any) -> Any:
    if _is_device(x):
        return torch.device("cpu")
    return torch.Tensor.as_subclass(x, torch.Tensor) if type(x) is Pretended else x


def _as_tensor(x: Any, *args: Any, device: Any = None, **options: Any) -> torch.Tensor:
    there = type(x) is Pretended if device is None else _is_cuda(device)
    made = AS_TENSOR(_plain(x) if isinstance(x, torch.Tensor) else x, *args, **options)
    return made.as_subclass(Pretended) if there else made


def _work(func: Any, args: tuple, kwargs: dict) -> Any:
    """Call a function of torch's on the tensors that are really there."""
    name = getattr(func, "__name__", str(func))
    if func == torch.Tensor.device.__get__:
        return CUDA
    if func == torch.Tensor.is_cuda.__get__:
        return True
    tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
    there = [x for x in tensors if type(x) is Pretended]
    # single numbers of the CPU may meet any, but in a list
    here = [x for x in tensors if type(x) is not Pretended and (x.dim() or name in LISTS)]
    if there and (name == "numpy" or (here and name not in MAY_MEET)):
        raise RuntimeError(
            f"{name}: tensors on cuda {[tuple(x.shape) for x in there]} and on cpu"
            f" {[tuple(x.shape) for x in here]}"
        )
    if there and name in UNORDERED and _sums_in_any_order(name, args):
        raise RuntimeError(f"{name}: sums numbers on CUDA in no fixed order")
    bare = (lambda x: x) if name in OF_LEAVES else _plain
    with torch._C.DisableTorchFunctionSubclass():
        out = func(*tree_map(bare, args), **tree_map(bare, kwargs))
    if name.endswith("_") and not name.endswith("__"):
        return args[0]
    if isinstance(kwargs.get("out"), torch.Tensor):
        return kwargs["out"]
    stays = _result_is_there(name, args, kwargs, bool(there))
    return tree_map(
        lambda x: x.as_subclass(Pretended) if stays and isinstance(x, torch.Tensor) else x, out
    )


def _sums_in_any_order(name: str, args: tuple) -> bool:
    """Whether it is a sum of floats several of which go to one place."""
    # (a look of this module's own, which `test_host_reads` must not count)
    with torch._C.DisableTorchFunctionSubclass(), _disable_current_modes():
        if not args[0].is_floating_point():
            return False
        return name == "cumsum" or args[2].unique().numel() < args[2].numel()


def _result_is_there(name: str, args: tuple, kwargs: dict, there: bool) -> bool:
    asked = [x for x in (*args, *kwargs.values()) if _is_device(x)]
    if asked:
        return _is_cuda(asked[0])
    if name in ("cpu", "tensor"):
        return False
    if name == "to" and len(args) > 1 and isinstance(args[1], torch.Tensor):
        return type(args[1]) is Pretended
    if name in ("new_tensor", "__getitem__"):
        return type(args[0]) is Pretended
    return there
