"""Expressions as a person writes them: as text, and as LaTeX."""

from __future__ import annotations

from torchfilm.circuits.expressions import NAME, NUMBER, QUIET, Expression, may_be_negative

# How strongly an operation binds; what binds less stands in brackets.
TRUTH, SUM, SIGN, PRODUCT, POWER, ATOM = range(6)
SIGNS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤", "eq": "=", "ne": "≠", "and": "and", "or": "or"}
TEX_SIGNS = SIGNS | {"ge": r"\ge", "le": r"\le", "ne": r"\ne", "and": r"\wedge", "or": r"\vee"}


def bare(node: Expression) -> Expression:
    """The expression without what does not show: types of numbers, and zeros that are added."""
    while node.op in QUIET:
        node = node.args[0]
    if node.op == "add" and any(bare(a).is_number(0) for a in node.args):
        return bare(node.args[1] if bare(node.args[0]).is_number(0) else node.args[0])
    return node


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
        op, args = node.op, tuple(map(bare, node.args))
        if op == NUMBER:
            found, binds = self.number(abs(node.value))
            return (found, binds) if node.value >= 0 else (self.minus + found, SIGN)
        if op == NAME:
            return self.name(node.name), ATOM
        if bare(node) is not node:
            return self.made[bare(node)]
        if op == "sub" and args[1].is_number(0):
            return self.made[args[0]]
        if op == "mul" and (args[0].is_number(1) or args[1].is_number(1)):
            return self.made[args[1] if args[0].is_number(1) else args[0]]
        if op in ("add", "sub"):
            if op == "sub" and args[0].is_number(0):
                return f"{self.minus}{self._in(args[1], PRODUCT)}", SIGN
            if op == "sub" and args[1].op == NUMBER and args[1].value < 0:
                return f"{self._in(args[0], SUM)} + {self.made[args[1]][0][1:]}", SUM
            sign = " + " if op == "add" else f" {self.minus} "
            right = self._in(args[1], SUM if op == "add" else PRODUCT)
            if op == "add" and right.startswith(self.minus):
                sign, right = f" {self.minus} ", right[1:]
            return self._in(args[0], SUM) + sign + right, SUM
        if op == "mul" and args[0].op == "div" and args[0].args[0].is_number(1):
            return self.fraction(args[1], bare(args[0].args[1]))  # as torch divides a number
        if op == "mul" and args[1].op == NUMBER and args[0].op != NUMBER:
            args = args[::-1]  # 2·a, also where torch was given (a, 2)
        if op == "mul":
            right = self._in(args[1], PRODUCT)
            if right.startswith("1/"):
                return self._in(args[0], SIGN) + right[1:], self._signed(args[0])
            return self._in(args[0], SIGN) + self.between(right) + right, self._signed(args[0])
        if op == "div":
            return self.fraction(args[0], args[1])
        if op == "neg":
            return f"{self.minus}{self._in(args[0], PRODUCT)}", SIGN
        if op == "pow":
            return self.power(args[0], args[1]), POWER
        if op in ("activation", "repression", "michaelis_menten"):
            return self.hill(op, self._not_below_0(args[0]), *args[1:])
        if op in self.signs:
            return f"{self._in(args[0], SUM)} {self.signs[op]} {self._in(args[1], SUM)}", TRUTH
        return self.call(op, [self.made[a][0] for a in args]), ATOM

    def _not_below_0(self, x: Expression) -> Expression:
        """What a law takes for its argument."""
        if not may_be_negative(x):
            return x
        cut = Expression("maximum", (x, Expression(NUMBER)))
        self.made[cut] = self.call("maximum", [self.made[x][0], self.number(0.0)[0]]), ATOM
        return cut

    def _signed(self, first: Expression) -> int:
        """How a product binds that begins with this factor."""
        return SIGN if self.made[first][1] == SIGN else PRODUCT

    # --- as text -------------------------------------------------------------------------------

    name = staticmethod(_plain_name)

    def number(self, value: float) -> tuple[str, int]:
        return f"{value:.6g}", ATOM

    def between(self, right: str) -> str:
        return self.times

    def brackets(self, inner: str) -> str:
        return f"({inner})"

    def fraction(self, over: Expression, under: Expression) -> tuple[str, int]:
        return f"{self._in(over, SIGN)}/{self._in(under, POWER)}", self._signed(over)

    def power(self, base: Expression, exponent: Expression) -> str:
        return f"{self._in(base, ATOM)}^{self._in(exponent, ATOM)}"

    def hill(self, op: str, x: Expression, half: Expression, *more: Expression) -> tuple[str, int]:
        raised = lambda z: (
            self._in(z, PRODUCT)
            if not more or more[0].is_number(1) or z.is_number(1)
            else self.power(z, more[0])
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

    def number(self, value: float) -> tuple[str, int]:
        found, _, exponent = f"{value:.6g}".partition("e")
        if not exponent:
            return (r"\infty" if found == "inf" else found), ATOM
        power = f"10^{{{int(exponent)}}}"
        return (power, POWER) if found == "1" else (rf"{found} \cdot {power}", PRODUCT)

    def between(self, right: str) -> str:
        return r" \cdot " if right[0].isdigit() else self.times

    def brackets(self, inner: str) -> str:
        return rf"\left({inner}\right)"

    def fraction(self, over: Expression, under: Expression) -> tuple[str, int]:
        return rf"\frac{{{self.made[over][0]}}}{{{self.made[under][0]}}}", POWER

    def power(self, base: Expression, exponent: Expression) -> str:
        return rf"{{{self._in(base, ATOM)}}}^{{{self.made[exponent][0]}}}"

    def hill(self, op: str, x: Expression, half: Expression, *more: Expression) -> tuple[str, int]:
        raised = lambda z: (
            self.made[z][0]
            if not more or more[0].is_number(1) or z.is_number(1)
            else self.power(z, more[0])
        )
        over = raised(half if op == "repression" else x)
        return rf"\frac{{{over}}}{{{raised(half)} + {raised(x)}}}", POWER

    def call(self, op: str, given: list[str]) -> str:
        if op == "where":
            return rf"\begin{{cases}}{given[1]} & {given[0]}\\{given[2]}\end{{cases}}"
        if op == "sqrt":
            return rf"\sqrt{{{given[0]}}}"
        name = {"minimum": "min", "maximum": "max"}.get(op, op)
        return rf"\operatorname{{{name}}}\left({', '.join(given)}\right)"
