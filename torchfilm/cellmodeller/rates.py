"""The rate functions of a script, from its OpenCL text: `TextRates` is what `tf.Circuit` calls."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfilm.cellmodeller.rates_text import Node, Origin, parse, refusal
from torchfilm.tools.hashing import digest

SPECIES, SIGNAL = "species{}", "signal{}"  # names of the fields
CONSTANTS = {
    "M_PI": math.pi,
    "M_E": math.e,
    "M_PI_F": math.pi,
    "M_E_F": math.e,
    "true": 1,
    "false": 0,
}
FUNCTIONS: Mapping[str, tuple[int, Callable[..., Tensor]]] = {
    **{
        name: (1, getattr(torch, name))
        for name in (
            "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "sqrt", "sin", "cos", "tan",
            "tanh", "atan", "floor", "sign",
        )
    },
    "rsqrt": (1, lambda x: 1.0 / torch.sqrt(x)),
    "exp10": (1, lambda x: torch.exp(math.log(10.0) * x)),
    "fabs": (1, torch.abs),
    "abs": (1, torch.abs),
    "pow": (2, lambda x, n: x**n),
    "pown": (2, lambda x, n: x**n),
    "powr": (2, lambda x, n: x**n),
    "fmin": (2, torch.minimum),
    "min": (2, torch.minimum),
    "fmax": (2, torch.maximum),
    "max": (2, torch.maximum),
    "clamp": (3, lambda x, low, high: torch.minimum(torch.maximum(x, low), high)),
    "mad": (3, lambda a, b, c: a * b + c),
    "fma": (3, lambda a, b, c: a * b + c),
    "step": (2, lambda edge, x: torch.where(x < edge, torch.zeros_like(x), torch.ones_like(x))),
}  # fmt: skip
WHOLE = ("abs", "min", "max", "clamp")  # which have whole values of whole numbers
COMPARE: Mapping[str, Callable[[Any, Any], Any]] = {
    "<": lambda a, b: a < b,
    ">": lambda a, b: a > b,
    "<=": lambda a, b: a <= b,
    ">=": lambda a, b: a >= b,
    "==": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
}
CALCULATE: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
}


@dataclass(frozen=True)
class Whole:
    """A column of an integer type, kept as floats."""

    column: Tensor


class TextRates:
    """Rates of species and signals as a script's OpenCL text gives them.

    species_text, signals_text: what `specRateCL` and `sigRateCL` return; None, there is none.
    grid_volume: of a voxel, µm³. CellModeller adds the rate of a signal, conc/h, to the voxels
    around a cell; here the medium gets the amount, rate · grid_volume, conc·µm³/h. A rate that the
    text does not set is 0. name, source: of the script, for messages.
    """

    __name__ = "specRateCL"  # by which the scene shows it

    def __init__(
        self,
        species_text: str | None,
        signals_text: str | None,
        species: int,
        signals: int,
        grid_volume: float | None,
        name: str = "",
        source: str = "",
    ):
        self.origins = [
            Origin("specRateCL", species_text or "", name, source),
            Origin("sigRateCL", signals_text or "", name, source),
        ]
        given = zip((species_text, signals_text), self.origins, strict=True)
        self.trees = [None if text is None else parse(origin) for text, origin in given]
        self.species, self.signals, self.grid_volume = species, signals, grid_volume
        self._word = digest(species_text, signals_text, species, signals, grid_volume)

    def __repr__(self) -> str:
        return f"TextRates({self._word})"  # by which scenes are compared

    def __call__(self, u: Any, s: Any, p: Any, cell: Any) -> Any:
        inside, outside = self.trees
        rates: dict[str, Any] = {}
        if inside is not None:
            run = _Run(self, u, s, cell, self.origins[0], self.species)
            rates = {SPECIES.format(k): v for k, v in run.rates(inside).items()}
        if outside is None:
            return rates
        run = _Run(self, u, s, cell, self.origins[1], self.signals)
        found = run.rates(outside).items()
        return rates, {SIGNAL.format(k): v * self.grid_volume for k, v in found}


class _Run:
    """One evaluation of a text, on columns over cells."""

    def __init__(self, text: TextRates, u: Any, s: Any, cell: Any, owner: Origin, count: int):
        self.text, self.u, self.s, self.cell = text, u, s, cell
        self.owner, self.count = owner, count
        self.like = u[SPECIES.format(0)]

    def rates(self, block: Node) -> dict[int, Any]:
        names: dict[str, Any] = {}
        self.block(block, names)
        found = {int(n[6:-1]): self.number(v) for n, v in names.items() if n.startswith("rates[")}
        return dict(sorted(found.items()))

    # --- statements ----------------------------------------------------------------------

    def block(self, node: Node, names: dict[str, Any]) -> None:
        for part in node.parts:
            if part.kind == "set":
                self.set(part, names)
            elif part.kind == "block":
                self.inner(part, names)
            else:
                self.branch(part, names)

    def inner(self, block: Node, names: dict[str, Any]) -> None:
        """Runs a block, whose own variables end with it."""
        own = dict(names)
        self.block(block, own)
        declared = {p.parts[0].text for p in block.parts if p.text == "declare"}
        names.update({n: v for n, v in own.items() if n not in declared})

    def set(self, node: Node, names: dict[str, Any]) -> None:
        target, value = node.parts[0], self.value(node.parts[1], names)
        if target.kind == "item" and target.text == "rates":
            names[f"rates[{self.index(target, names, self.count)}]"] = self.number(value)
            return
        if target.kind != "name" or (node.text == "assign" and target.text not in names):
            shown = f"{target.text}[…]" if target.kind == "item" else target.text
            raise refusal(
                self.owner, node.line, f"{shown} = …", "set rates[…], or a variable declared before"
            )
        names[target.text] = self.cast(node, value, node.type)

    def branch(self, node: Node, names: dict[str, Any]) -> None:
        test, then, other = node.parts
        condition = self.truth(self.value(test, names))
        if not isinstance(condition, Tensor):
            self.inner(then if condition else other, names)
            return
        one, two = dict(names), dict(names)
        self.inner(then, one)
        self.inner(other, two)
        for name in {**one, **two}:
            a, b = one.get(name, 0.0), two.get(name, 0.0)
            # a variable that only one branch declares ends with it
            if name.startswith("rates[") or name in names:
                names[name] = a if a is b else self.where(condition, a, b)

    # --- values --------------------------------------------------------------------------

    def value(self, node: Node, names: dict[str, Any]) -> Any:
        if node.kind == "number":
            return int(node.text) if node.type != "float" else float(node.text)
        if node.kind == "unary":
            return self.unary(node, names)
        if node.kind == "binary":
            return self.binary(node, names)
        if node.kind == "choice":
            test, one, two = (self.value(p, names) for p in node.parts)
            condition = self.truth(test)
            if isinstance(condition, Tensor):
                return self.where(condition, one, two)
            return one if condition else two
        if node.kind == "call":
            return self.call(node, names)
        if node.kind == "item":
            return self.item(node, names)
        return self.named(node, names)

    def named(self, node: Node, names: dict[str, Any]) -> Any:
        name, cell = node.text, self.cell
        if name in names:
            return names[name]
        if name in CONSTANTS:
            return CONSTANTS[name]
        if name in ("area", "cellType", "effGrowth", "pos.x", "pos.y", "pos.z"):
            column = {"cellType": "cell_type", "effGrowth": "effGrowth"}.get(name, name[-1:])
            return cell["area" if name == "area" else column]
        if name == "volume":
            # CellModeller's, π r² (2r + l), which is the area times r/2
            return cell["area"] * cell["radius"] * 0.5
        if name == "gridVolume" and self.text.grid_volume is not None:
            return float(self.text.grid_volume)
        raise refusal(
            self.owner, node.line, name,
            "this name is not declared; known are species[…], signals[…], rates[…], area, volume,"
            " gridVolume (with GridDiffusion), cellType, effGrowth and pos.x",
        )  # fmt: skip

    def item(self, node: Node, names: dict[str, Any]) -> Any:
        if node.text == "species":
            return self.u[SPECIES.format(self.index(node, names, self.text.species))]
        if node.text == "signals":
            return self.s[SIGNAL.format(self.index(node, names, self.text.signals))]
        if node.text == "rates":
            name = f"rates[{self.index(node, names, self.count)}]"
            if name in names:
                return names[name]
        raise refusal(
            self.owner, node.line, f"{node.text}[…]", "read species, signals, or rates set before"
        )

    def index(self, node: Node, names: dict[str, Any], count: int) -> int:
        found = self.value(node.parts[0], names)
        if isinstance(found, (Tensor, Whole)) or found != int(found) or not 0 <= found < count:
            raise refusal(
                self.owner, node.line, f"{node.text}[{found}]", f"it has {count}, counted from 0"
            )
        return int(found)

    def unary(self, node: Node, names: dict[str, Any]) -> Any:
        value = self.value(node.parts[0], names)
        if node.text == "!":
            truth = self.truth(value)
            return ~truth if isinstance(truth, Tensor) else not truth
        if node.text.startswith("("):
            kind = {"(float)": "float", "(double)": "float", "(bool)": "bool"}
            return self.cast(node, value, kind.get(node.text, "int"))
        whole, value = self.whole(value), self.plain(value)
        return self.kept(-value if node.text == "-" else value, whole)

    def cast(self, node: Node, value: Any, kind: str) -> Any:
        """A value as one of a type: "float", "int" or "bool"."""
        if kind == "bool":
            return self.truth(value)
        if kind == "float":
            return self.number(value)
        if isinstance(value, float):
            return int(value)
        if isinstance(value, Tensor) and value.is_floating_point():
            raise refusal(
                self.owner, node.line, "int", "it would cut a value: write floats, and floor()"
            )
        return self.kept(self.plain(value), True)

    def kept(self, value: Any, whole: bool) -> Any:
        """A value, marked if it is a column of an integer type."""
        return Whole(value) if whole and isinstance(value, Tensor) else value

    def whole(self, value: Any) -> bool:
        """Whether a value is of an integer type."""
        if isinstance(value, Tensor):
            return not value.is_floating_point()
        return isinstance(value, (int, Whole))

    def binary(self, node: Node, names: dict[str, Any]) -> Any:
        a, b = (self.value(p, names) for p in node.parts)
        if node.text in ("&&", "||"):
            a, b = self.truth(a), self.truth(b)
            if isinstance(a, Tensor) and isinstance(b, Tensor):
                return a & b if node.text == "&&" else a | b
            one, other = (b, a) if isinstance(a, Tensor) else (a, b)  # `one` is plain
            return (other if one else False) if node.text == "&&" else (True if one else other)
        if node.text in COMPARE:
            return COMPARE[node.text](self.plain(a), self.plain(b))
        whole = self.whole(a) and self.whole(b)
        if whole and node.text in ("/", "%"):
            if not isinstance(a, int) or not isinstance(b, int) or b == 0:
                raise refusal(self.owner, node.line, node.text, "write floats, such as 2.0f")
            cut = abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)
            return cut if node.text == "/" else a - b * cut
        if node.text == "%":
            raise refusal(self.owner, node.line, "%", "it is for whole numbers")
        try:
            return self.kept(CALCULATE[node.text](self.plain(a), self.plain(b)), whole)
        except ZeroDivisionError:
            raise refusal(self.owner, node.line, "/", "it divides by 0") from None

    def call(self, node: Node, names: dict[str, Any]) -> Any:
        name = node.text.removeprefix("native_").removeprefix("half_")
        if name not in FUNCTIONS:
            raise refusal(
                self.owner, node.line, f"{node.text}(…)", f"known are {', '.join(FUNCTIONS)}"
            )
        count, function = FUNCTIONS[name]
        if len(node.parts) != count:
            raise refusal(self.owner, node.line, f"{node.text}(…)", f"it takes {count} values")
        values = [self.value(p, names) for p in node.parts]
        given = [self.number(x) for x in values]
        if name in WHOLE and all(map(self.whole, values)):
            if all(isinstance(x, int) for x in values):
                return int(function(*(torch.tensor(x) for x in given)))
            return Whole(function(*(x if isinstance(x, Tensor) else self.full(x) for x in given)))
        if name in ("pow", "pown", "powr") and not isinstance(given[1], Tensor):
            if not isinstance(given[0], Tensor):
                return self.power(node, float(given[0]), given[1])
            return function(given[0], int(given[1]) if given[1] == int(given[1]) else given[1])
        return function(*(x if isinstance(x, Tensor) else self.full(x) for x in given))

    def power(self, node: Node, x: float, n: float) -> float:
        try:
            found = x**n
        except (ZeroDivisionError, OverflowError):
            found = math.nan
        if isinstance(found, complex) or math.isnan(found):
            raise refusal(self.owner, node.line, f"pow({x:g}, {n:g})", "it is no number")
        return found

    def truth(self, value: Any) -> Any:
        """A condition: true where the value is not 0."""
        value = value.column if isinstance(value, Whole) else value
        if isinstance(value, Tensor):
            return value if value.dtype == torch.bool else value != 0
        return bool(value)

    def number(self, value: Any) -> Any:
        """A value as a floating-point number or column."""
        value = value.column if isinstance(value, Whole) else value
        if not isinstance(value, Tensor):
            return float(value)
        if value.dtype == torch.bool:
            return torch.where(value, self.full(1.0), self.full(0.0))
        return value if value.is_floating_point() else value.to(self.like.dtype)

    def plain(self, value: Any) -> Any:
        return self.number(value) if isinstance(value, (Tensor, Whole)) else value

    def full(self, value: float) -> Tensor:
        return torch.full_like(self.like, float(value))

    def where(self, condition: Tensor, one: Any, two: Any) -> Any:
        a, b = (self.number(x) for x in (one, two))
        a = a if isinstance(a, Tensor) else self.full(a)
        b = b if isinstance(b, Tensor) else self.full(b)
        return self.kept(torch.where(condition, a, b), self.whole(one) and self.whole(two))
