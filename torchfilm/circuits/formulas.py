"""Expressions as a person writes them: as text, and as LaTeX."""

from __future__ import annotations

from torchfilm.circuits.expressions import NAME, NUMBER, Expression

# How strongly an operation binds; what binds less stands in brackets.
SUM, PRODUCT, SIGN, POWER, ATOM = range(5)
SIGNS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤", "eq": "=", "ne": "≠", "and": "and", "or": "or"}
TEX_SIGNS = SIGNS | {"ge": r"\ge", "le": r"\le", "ne": r"\ne", "and": r"\wedge", "or": r"\vee"}
QUIET = ("cast32", "cast64", "detach")  # operations on the type of a number


def _number(value: float) -> str:
    return f"{value:.6g}"


def _plain_name(name: str) -> str:
    """Species and parameters by their own names; "out.ahl" outside; "cell.volume"."""
    kind, _, own = name.partition(".")
    return {"u": own, "p": own, "s": f"out.{own}"}.get(kind, name)


def _tex_name(name: str) -> str:
    kind, _, own = name.partition(".")
    own = own.replace("_", r"\_")
    if kind == "s":
        return rf"\mathrm{{{own}}}_{{\mathrm{{out}}}}"
    return rf"\mathrm{{{own}}}"


def text(expression: Expression) -> str:
    """As text."""
    return _Plain().of(expression)[0]


def latex(expression: Expression) -> str:
    """As LaTeX, without dollar signs."""
    return _Tex().of(expression)[0]


class _Plain:
    """Texts of nodes with how strongly each binds; every node once."""

    signs, times, minus = SIGNS, "·", "−"

    def __init__(self) -> None:
        self.made: dict[Expression, tuple[str, int]] = {}

    def of(self, root: Expression) -> tuple[str, int]:
        for node in root.walk():
            if node not in self.made:
                self.made[node] = self._of(node)
        return self.made[root]

    def _in(self, node: Expression, at_least: int) -> str:
        found, binds = self.made[node]
        return found if binds >= at_least else self.brackets(found)

    def _of(self, node: Expression) -> tuple[str, int]:
        op, args = node.op, node.args
        if op == NUMBER:
            return _number(node.value), ATOM if node.value >= 0 else SIGN
        if op == NAME:
            return self.name(node.name), ATOM
        if op in QUIET:
            return self.made[args[0]]
        if op == "add" and (args[0].is_number(0) or args[1].is_number(0)):
            return self.made[args[1] if args[0].is_number(0) else args[0]]
        if op == "mul" and (args[0].is_number(1) or args[1].is_number(1)):
            return self.made[args[1] if args[0].is_number(1) else args[0]]
        if op in ("add", "sub"):
            if op == "sub" and args[0].is_number(0):
                return f"{self.minus}{self._in(args[1], PRODUCT)}", SIGN
            sign = " + " if op == "add" else f" {self.minus} "
            right = self._in(args[1], SUM if op == "add" else PRODUCT)
            if op == "add" and right.startswith(self.minus):
                sign, right = f" {self.minus} ", right[1:]
            return self._in(args[0], SUM) + sign + right, SUM
        if op == "mul":
            return f"{self._in(args[0], PRODUCT)}{self.times}{self._in(args[1], PRODUCT)}", PRODUCT
        if op == "div":
            return self.fraction(args[0], args[1])
        if op == "neg":
            return f"{self.minus}{self._in(args[0], PRODUCT)}", SIGN
        if op == "pow":
            return self.power(args[0], args[1]), POWER
        if op in ("activation", "repression", "michaelis_menten"):
            return self.hill(op, *args)
        if op in self.signs:
            return f"{self._in(args[0], SIGN)} {self.signs[op]} {self._in(args[1], SIGN)}", SUM
        return self.call(op, [self.made[a][0] for a in args]), ATOM

    # --- as text -------------------------------------------------------------------------------

    name = staticmethod(_plain_name)  # type: ignore[assignment]

    def brackets(self, inner: str) -> str:
        return f"({inner})"

    def fraction(self, over: Expression, under: Expression) -> tuple[str, int]:
        return f"{self._in(over, PRODUCT)}/{self._in(under, POWER)}", PRODUCT

    def power(self, base: Expression, exponent: Expression) -> str:
        return f"{self._in(base, ATOM)}^{self._in(exponent, ATOM)}"

    def hill(self, op: str, x: Expression, half: Expression, *more: Expression) -> tuple[str, int]:
        raised = lambda z: (
            self._in(z, SUM) if not more or more[0].is_number(1) else self.power(z, more[0])
        )
        over = raised(half if op == "repression" else x)
        return f"{over}/({raised(half)} + {raised(x)})", PRODUCT

    def call(self, op: str, given: list[str]) -> str:
        if op == "where":
            return f"({given[1]} if {given[0]}, else {given[2]})"
        name = {"minimum": "min", "maximum": "max"}.get(op, op)
        return f"{name}({', '.join(given)})"


class _Tex(_Plain):
    """The same in LaTeX."""

    signs, times, minus, name = TEX_SIGNS, r"\,", "-", staticmethod(_tex_name)

    def brackets(self, inner: str) -> str:
        return rf"\left({inner}\right)"

    def fraction(self, over: Expression, under: Expression) -> tuple[str, int]:
        return rf"\frac{{{self.made[over][0]}}}{{{self.made[under][0]}}}", ATOM

    def power(self, base: Expression, exponent: Expression) -> str:
        return rf"{{{self._in(base, ATOM)}}}^{{{self.made[exponent][0]}}}"

    def hill(self, op: str, x: Expression, half: Expression, *more: Expression) -> tuple[str, int]:
        raised = lambda z: (
            self.made[z][0] if not more or more[0].is_number(1) else self.power(z, more[0])
        )
        over = raised(half if op == "repression" else x)
        return rf"\frac{{{over}}}{{{raised(half)} + {raised(x)}}}", ATOM

    def call(self, op: str, given: list[str]) -> str:
        if op == "where":
            return rf"\begin{{cases}}{given[1]} & {given[0]}\\{given[2]}\end{{cases}}"
        if op == "sqrt":
            return rf"\sqrt{{{given[0]}}}"
        name = {"minimum": "min", "maximum": "max"}.get(op, op)
        return rf"\operatorname{{{name}}}\left({', '.join(given)}\right)"
