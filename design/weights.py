"""The weights of a `torch.nn.Module` as JSON: data only, so reading a file cannot run code."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from torch import Tensor

from torchfilm import checks

FORMAT = "torchfilm weights 1"


@checks.known_keywords
def save_weights(module: torch.nn.Module, path: str | Path) -> Path:
    """Write the parameters and buffers of a module, each with name, dtype and shape. Replaces an
    older file. Raises InputError where a number is not finite, or a tensor is complex."""
    path, stored = checks.file_path("path", path), {}
    _check_module(module)
    for name, value in module.state_dict().items():
        if value.is_complex() or not bool(torch.isfinite(value).all()):
            raise checks.input_error(f"weights[{name!r}]", value.dtype, "finite real numbers")
        flat = value.detach().cpu().double().flatten().tolist()
        kind = str(value.dtype).removeprefix("torch.")
        stored[name] = {"dtype": kind, "shape": list(value.shape), "values": flat}
    checks.write_whole(path, json.dumps({"format": FORMAT, "weights": stored}, indent=1) + "\n")
    return path


@checks.known_keywords
def load_weights(module: torch.nn.Module, path: str | Path) -> None:
    """Give a module the weights of a file, which it keeps in its own dtype and on its own device.

    Raises InputError for a file that holds no weights, or those of another module, and changes
    nothing then.
    """
    _check_module(module)
    stored, own = _read(checks.file_path("path", path)), module.state_dict()
    for name in sorted({*stored, *own}):
        shapes = [tuple(w[name].shape) if name in w else "none" for w in (stored, own)]
        if shapes[0] != shapes[1]:
            what = f"{name!r} of shape {shapes[0]}"
            rule = f"of shape {shapes[1]}, as in {type(module).__name__}"
            raise checks.input_error(f"weights in {path}", what, rule)
    module.load_state_dict(stored)


def _check_module(module: object) -> None:
    if not isinstance(module, torch.nn.Module):
        raise checks.input_error("module", module, "a torch.nn.Module")


def _read(path: Path) -> dict[str, Tensor]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["format"] != FORMAT:
            raise ValueError(f"its format is {found['format']!r}")
        return {
            name: torch.tensor(w["values"], dtype=torch.float64).reshape(w["shape"])
            for name, w in found["weights"].items()
        }
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as why:
        raise checks.InputError(
            f"{path} holds no weights that save_weights wrote: {type(why).__name__}: {why}."
        ) from why
