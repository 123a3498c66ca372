"""The parameters of a ready-made scene as plain data, so that a results file can hold them."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Mapping
from typing import Any

from torchfilm.distributions import LogNormal, Normal, Uniform
from torchfilm.tools import checks
from torchfilm.values import Distribution, PerColony

DISTRIBUTIONS = {kind.__name__: kind for kind in (Uniform, Normal, LogNormal)}


def to_plain(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters by name as JSON can hold them; `from_plain` gives them back."""
    return {name: _plain_value(value) for name, value in parameters.items()}


def from_plain(plain: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that `to_plain` made plain."""
    return {name: _given_value(value) for name, value in plain.items()}


def _plain_value(value: Any) -> Any:
    """A parameter as JSON can hold it."""
    if isinstance(value, PerColony):
        return {"per colony": _plain_value(value.values)}
    if isinstance(value, Distribution):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return {"distribution": type(value).__name__, **to_plain(fields)}
    if isinstance(value, Mapping):
        return {"by type": [[int(k), _plain_value(v)] for k, v in value.items()]}
    return value.tolist() if hasattr(value, "tolist") else value


def _given_value(value: Any) -> Any:
    """The parameter that was made plain."""
    if not isinstance(value, Mapping):
        return value
    if "per colony" in value:
        return PerColony(value["per colony"])
    if "by type" in value:
        return {int(k): _given_value(v) for k, v in value["by type"]}
    if "distribution" in value:
        kind = DISTRIBUTIONS[value["distribution"]]
        return kind(**from_plain({n: v for n, v in value.items() if n != "distribution"}))
    return value


def parse_value(text: str) -> Any:
    """A parameter as typed on the command line: a Python literal, also true and false in any case,
    `PerColony([…])`, or a distribution such as `LogNormal(1.0, 0.2)`, with `tf.` before it or not;
    anything else is text."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        pass
    try:
        return _call(ast.parse(text, mode="eval").body)
    except (ValueError, SyntaxError, TypeError):
        return text


def _call(node: ast.expr) -> Any:
    """The value of a literal, of a call of a known name, or of a dict of either."""
    if isinstance(node, ast.Call):
        known: dict[str, Any] = {**DISTRIBUTIONS, "PerColony": PerColony}
        name = ast.unparse(node.func).removeprefix("tf.")
        if name not in known:
            raise checks.InputError(f"{name} is not one of {', '.join(known)}.")
        given = {k.arg: _call(k.value) for k in node.keywords if k.arg is not None}
        return known[name](*(_call(a) for a in node.args), **given)
    if isinstance(node, ast.Dict) and all(k is not None for k in node.keys):
        pairs = zip(node.keys, node.values, strict=True)
        return {ast.literal_eval(k): _call(v) for k, v in pairs if k is not None}
    return ast.literal_eval(node)
