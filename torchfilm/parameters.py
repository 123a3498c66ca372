"""The parameters of an effect: as text, and the tensors among them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch

from torchfilm.values import ByType, PerColony


def number_range(value: torch.Tensor) -> str:
    """One number in text, or the range of several."""
    low, high = (float(x) for x in torch.aminmax(value.double().detach()))
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def summary(effect: Any) -> str:
    """An effect with the parameters that differ from their defaults, in a line."""
    shown = ", ".join(f"{name}={value}" for name, value in given(effect))
    return f"{type(effect).__name__}({shown})"


def given(effect: Any) -> list[tuple[str, str]]:
    """The parameters of an effect that differ from their defaults, with their values as text."""
    shown = []
    for f in dataclasses.fields(effect):
        value = getattr(effect, f.name)
        default = f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
        if f.repr and not _same(value, default):
            shown.append((f.name, shorten(value)))
    return shown


def _same(a: object, b: object) -> bool:
    tensors = isinstance(a, torch.Tensor) or isinstance(b, torch.Tensor)
    return a is b or (not tensors and a == b)


def shorten(value: object) -> str:
    """A value in few characters."""
    if isinstance(value, torch.Tensor):
        value = value.detach()
        if value.dim() == 0:
            return f"{float(value):.9g}"
        return f"<{value.numel()} values, {float(value.min()):g} to {float(value.max()):g}>"
    if isinstance(value, ByType):
        return "{" + ", ".join(f"{kind}: {shorten(v)}" for kind, v in value.values.items()) + "}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        if not type(value).__dataclass_params__.repr:  # type: ignore[attr-defined]
            return repr(value)  # a short one of its own
        inner = [
            f"{f.name}={shorten(getattr(value, f.name))}"
            for f in dataclasses.fields(value)
            if f.repr and not _same(getattr(value, f.name), f.default)
        ]
        return f"{type(value).__name__}({', '.join(inner)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {shorten(v)}" for name, v in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(shorten(v) for v in value) + "]"
    return getattr(value, "__name__", None) or repr(value)


def parameters(part: object, path: str = "") -> list[tuple[str, torch.Tensor]]:
    """Every tensor among an effect's parameters, by name; those of its distributions, cell types
    and walls included."""
    if isinstance(part, torch.Tensor):
        return [(path, part)]
    if isinstance(part, (tuple, list)):
        return [x for k, item in enumerate(part) for x in parameters(item, f"{path}[{k}]")]
    if isinstance(part, ByType):
        return [x for k, item in part.values.items() for x in parameters(item, f"{path}[{k}]")]
    if isinstance(part, PerColony):
        return parameters(part.values, path)
    if isinstance(part, Mapping):
        return [x for name, item in part.items() for x in parameters(item, f"{path}[{name!r}]")]
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        path = path or type(part).__name__
        # what is not shown is not given by the user but computed
        shown = [f.name for f in dataclasses.fields(part) if f.repr]
        return [x for name in shown for x in parameters(getattr(part, name), f"{path}.{name}")]
    return []
