"""A plain `update(cells)` as a rule on whole columns.

Plain is: assignments of numbers, then `for (id, cell) in cells.items():` with assignments to the
cell's attributes and to local names, `if`, arithmetic, comparisons, `min`, `max`, `abs`, `sqrt`,
`clip` and look-ups by a number. What the loop does to one cell must depend on that cell only. The
source is interpreted with columns in place of numbers, `if` becomes torch.where, and the operations
are those whose results have the same bits in Python. Everything else is `Uneven`: the script's own
loop runs then.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.cellmodeller.cell import READ_ONLY
from torchfilm.cellmodeller.sheets import CellLayout, check_growth, found_signals
from torchfilm.cellmodeller.variables import FIELDS
from torchfilm.state import State

OPERATORS: Mapping[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
    ast.Div: operator.truediv, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt,
    ast.GtE: operator.ge, ast.Eq: operator.eq, ast.NotEq: operator.ne,
}  # fmt: skip
PLAIN = (int, float, bool, str, type(None))


class Uneven(Exception):
    """Something that cannot act on whole columns. The text says what, and in which line."""


def _max(a: Any, b: Any) -> Any:
    return _where(b > a, b, a)


def _min(a: Any, b: Any) -> Any:
    return _where(b < a, b, a)


def _where(condition: Any, one: Any, two: Any) -> Any:
    """As torch.where, for numbers, columns, and lists of them."""
    if isinstance(condition, bool):
        return one if condition else two
    if isinstance(one, (list, tuple)) and isinstance(two, (list, tuple)) and len(one) == len(two):
        return [_where(condition, a, b) for a, b in zip(one, two, strict=True)]
    if any(not isinstance(x, (Tensor, int, float)) for x in (one, two)):
        raise Uneven("the branches of an if give different things")
    each = [x if isinstance(x, Tensor) else _column(x, condition) for x in (one, two)]
    if each[0].dtype != each[1].dtype:
        each = [_number(x) for x in each]
    return torch.where(condition, *each)


def _column(value: Any, like: Tensor) -> Tensor:
    dtype = torch.bool if isinstance(value, bool) else torch.float64
    return torch.full(like.shape, value, dtype=dtype, device=like.device)


def _number(value: Any) -> Any:
    return value.double() if isinstance(value, Tensor) and value.dtype == torch.bool else value


FUNCTIONS: dict[Any, Callable[..., Any]] = {
    min: _min, max: _max, np.minimum: _min, np.maximum: _max,
    abs: abs, math.fabs: abs, np.abs: abs, np.fabs: abs,
    math.sqrt: torch.sqrt, np.sqrt: torch.sqrt, float: _number,
    np.clip: lambda x, low, high: _min(_max(x, low), high),
}  # fmt: skip


class ColumnRule:
    """`update(cells)` on whole columns. Made from the source; Uneven if it is not plain."""

    def __init__(self, text: str, module: ModuleType, layout: CellLayout):
        found = [n for n in ast.parse(text).body if isinstance(n, ast.FunctionDef)]
        made = [n for n in found if n.name == "update"]
        code = getattr(getattr(module, "update", None), "__code__", None)
        if len(made) != 1 or made[0].decorator_list or _more_than_one(made[0].args):
            raise Uneven("update is not one plain function")
        if code is None or code.co_firstlineno != made[0].lineno or code.co_name != "update":
            raise Uneven("update is another function than the one in the text")
        self.body, self.cells = made[0].body, made[0].args.args[0].arg
        stored = [n for n in ast.walk(made[0]) if isinstance(n, ast.Name)]
        self.local = {n.id for n in stored if isinstance(n.ctx, ast.Store)}
        shared = [n for s in ast.walk(made[0]) if isinstance(s, ast.Global) for n in s.names]
        if self.local & set(shared):
            raise Uneven("it sets a global variable")
        self.module, self.layout = module, layout

    def act(self, state: State) -> State:
        """The state after the rule."""
        turn = _Turn(self, state)
        turn.run()
        return turn.result()


class _Turn:
    """One run of the rule on a state."""

    def __init__(self, rule: ColumnRule, state: State):
        self.rule, self.state, self.layout = rule, state, rule.layout
        self.outer: dict[str, Any] = {}  # local names from before the loop
        self.own: dict[str, Any] = {}  # of the loop, and attributes of the cell as ".name"
        self.cell = self.id = ""
        self.mask: Tensor | None = None

    def run(self) -> None:
        for node in self.rule.body:
            if isinstance(node, ast.For):
                self._loop(node)
            elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                if len(node.targets) > 1 or self.own:
                    raise _uneven(node, "an assignment that is not plain")
                self.outer[node.targets[0].id] = self.value(node.value)
            elif not _does_nothing(node):
                raise _uneven(node, "a statement outside of the loop over cells")

    def _loop(self, node: ast.For) -> None:
        source, target = node.iter, node.target
        if isinstance(source, ast.Call) and _is_name(source.func, "list") and source.args:
            source = source.args[0]
        method = source.func if isinstance(source, ast.Call) and not source.args else None
        over = isinstance(method, ast.Attribute) and _is_name(method.value, self.rule.cells)
        kind = method.attr if over and isinstance(method, ast.Attribute) else ""
        names = target.elts if isinstance(target, ast.Tuple) else [target]
        if kind == "items" and len(names) == 2 and all(isinstance(n, ast.Name) for n in names):
            self.id, self.cell = (n.id for n in names if isinstance(n, ast.Name))
        elif kind == "values" and isinstance(target, ast.Name):
            self.cell = target.id
        else:
            raise _uneven(node, f"a loop over other than {self.rule.cells}.items()")
        if node.orelse:
            raise _uneven(node, "else after a loop")
        self.statements(node.body)
        self.own = {n: v for n, v in self.own.items() if n.startswith(".")}
        self.cell = self.id = ""

    # --- statements ----------------------------------------------------------------------

    def statements(self, body: Sequence[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.If):
                self._branch(node)
            elif isinstance(node, ast.Assign):
                value = self.value(node.value)
                for target in node.targets:
                    self._set(target, value)
            elif isinstance(node, ast.AugAssign) and type(node.op) in OPERATORS:
                reading = ast.copy_location(_as_read(node.target), node)
                made = ast.copy_location(ast.BinOp(reading, node.op, node.value), node)
                self._set(node.target, self.value(made))
            elif not _does_nothing(node):
                raise _uneven(node, "a statement that is not plain")

    def _set(self, target: ast.expr, value: Any) -> None:
        if isinstance(target, ast.Name):
            if target.id in self.outer or target.id in (self.cell, self.id):
                raise _uneven(target, f"{target.id} passes from cell to cell")
            self.own[target.id] = value
        elif isinstance(target, ast.Attribute) and _is_name(target.value, self.cell):
            name = target.attr
            if name not in (*FIELDS, *self.layout.variables) or name in READ_ONLY:
                raise _uneven(target, f"it sets cell.{name}")
            self.own["." + name] = value
        else:
            raise _uneven(target, "an assignment that is not plain")

    def _branch(self, node: ast.If) -> None:
        condition = self.truth(node.test, self.value(node.test))
        if isinstance(condition, bool):
            self.statements(node.body if condition else node.orelse)
            return
        before, mask = dict(self.own), self.mask
        ends = []
        for way, body in ((condition, node.body), (~condition, node.orelse)):
            self.own, self.mask = dict(before), way if mask is None else mask & way
            self.statements(body)
            ends.append(self.own)
        self.mask, self.own = mask, {}
        for name in {**ends[0], **ends[1]}:
            if name.startswith("."):
                one, two = (e[name] if name in e else self.read(node, name[1:], True) for e in ends)
            elif name in ends[0] and name in ends[1]:
                one, two = ends[0][name], ends[1][name]
            else:
                continue  # read later, it is Uneven
            self.own[name] = one if one is two else _where(condition, one, two)

    # --- values --------------------------------------------------------------------------

    def value(self, node: ast.expr) -> Any:
        make = getattr(self, "_" + type(node).__name__.lower(), None)
        if make is None:
            raise _uneven(node, "an expression that is not plain")
        try:
            return make(node)
        except Uneven as error:
            raise error if "line " in str(error) else _uneven(node, str(error)) from None
        except (TypeError, ValueError, KeyError, IndexError, ZeroDivisionError) as error:
            raise _uneven(node, f"{type(error).__name__}: {error}") from error

    def _constant(self, node: ast.Constant) -> Any:
        if not isinstance(node.value, PLAIN):
            raise Uneven("a constant that is no number")
        return node.value

    def _list(self, node: ast.List | ast.Tuple) -> list[Any]:
        return [self.value(x) for x in node.elts]

    _tuple = _list

    def _dict(self, node: ast.Dict) -> dict[Any, Any]:
        keys = [self.value(k) for k in node.keys if k is not None]
        if not all(isinstance(k, PLAIN) for k in keys):
            raise Uneven("a dict that is not plain")
        return dict(zip(keys, map(self.value, node.values), strict=True))

    def _name(self, node: ast.Name) -> Any:
        name = node.id
        if name == self.id and name:
            return (self.state.uid + 1).double()
        for known in (self.own, self.outer):
            if name in known:
                return known[name]
        if name in self.rule.local or name == self.rule.cells:
            raise Uneven(f"{name} has no value for every cell")
        builtins = {"min": min, "max": max, "abs": abs, "float": float}
        return vars(self.rule.module).get(name, builtins.get(name))

    def _attribute(self, node: ast.Attribute) -> Any:
        if _is_name(node.value, self.cell) and self.cell:
            own = self.own.get("." + node.attr)
            return own if own is not None else self.read(node, node.attr)
        home = self.value(node.value)
        if isinstance(home, ModuleType) and home in (math, np):
            return getattr(home, node.attr)
        raise Uneven(f"it uses {ast.unparse(node)}")

    def _subscript(self, node: ast.Subscript) -> Any:
        home, key = self.value(node.value), self.value(node.slice)
        if not isinstance(home, (list, tuple, dict)):
            raise Uneven("it looks up a part of something that is no list or dict")
        if not isinstance(key, Tensor):
            return home[key]
        table = home if isinstance(home, dict) else dict(enumerate(home))
        made, known = None, torch.zeros_like(key, dtype=torch.bool)
        for k, v in table.items():
            made = v if made is None else _where(key == k, v, made)
            known = known | (key == k)
        self._all(known, "a key that is not in the table")
        return made

    def _all(self, good: Tensor, otherwise: str) -> None:
        """Raise Uneven unless this holds in all cells of this branch."""
        if not bool((good if self.mask is None else good | ~self.mask).all()):
            raise Uneven(otherwise)

    def _binop(self, node: ast.BinOp) -> Any:
        if type(node.op) not in OPERATORS:
            raise Uneven(f"the operation {type(node.op).__name__}")
        a, b = _number(self.value(node.left)), _number(self.value(node.right))
        if isinstance(node.op, ast.Div) and (isinstance(a, Tensor) or isinstance(b, Tensor)):
            # of two columns: with a number, torch multiplies by a rounded reciprocal
            like = self.state.length
            a, b = (x if isinstance(x, Tensor) else _column(float(x), like) for x in (a, b))
            self._all(b != 0, "it divides by 0")
        return OPERATORS[type(node.op)](a, b)

    def _compare(self, node: ast.Compare) -> Any:
        values = [self.value(x) for x in (node.left, *node.comparators)]
        made: Any = True
        for op, a, b in zip(node.ops, values, values[1:], strict=False):
            if type(op) not in OPERATORS or not all(
                isinstance(x, (Tensor, *PLAIN)) for x in (a, b)
            ):
                raise Uneven("a comparison that is not plain")
            found = OPERATORS[type(op)](_number(a), _number(b))
            made = found if made is True else made & found
        return made

    def _boolop(self, node: ast.BoolOp) -> Any:
        both, mask = isinstance(node.op, ast.And), self.mask
        made: Any = both
        for part in node.values:
            found = self.value(part)
            if not (isinstance(found, bool) or _is_truth(found)):
                raise Uneven("and/or of other than truth values")
            made = made & found if both else made | found
            if isinstance(made, bool):
                if made != both:
                    break
            else:  # the rest counts in these cells
                left = made if both else ~made
                self.mask = left if mask is None else mask & left
        self.mask = mask
        return made

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        value = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            truth = self.truth(node, value)
            return not truth if isinstance(truth, bool) else ~truth
        if isinstance(node.op, ast.USub):
            return -_number(value)
        raise Uneven("an operation that is not plain")

    def _ifexp(self, node: ast.IfExp) -> Any:
        condition = self.truth(node, self.value(node.test))
        if isinstance(condition, bool):
            return self.value(node.body if condition else node.orelse)
        mask, ways = self.mask, []
        for way, part in ((condition, node.body), (~condition, node.orelse)):
            self.mask = way if mask is None else mask & way
            ways.append(self.value(part))
        self.mask = mask
        return _where(condition, *ways)

    def _call(self, node: ast.Call) -> Any:
        function = self.value(node.func)
        if node.keywords or not _hashable(function) or function not in FUNCTIONS:
            raise Uneven(f"it calls {ast.unparse(node.func)}")
        given = [_number(self.value(x)) for x in node.args]
        if any(isinstance(x, (list, dict)) for x in given):
            raise Uneven(f"{ast.unparse(node.func)} of a list")
        if not any(isinstance(x, Tensor) for x in given):
            return function(*given)
        if function in (min, max) and len(given) != 2:
            raise Uneven("min or max of other than two values")
        if FUNCTIONS[function] is torch.sqrt:
            self._all(given[0] >= 0, "sqrt of a negative number")
        return FUNCTIONS[function](*given)

    def truth(self, node: ast.AST, value: Any) -> Any:
        """A condition, as a truth value or a column of them."""
        if isinstance(value, Tensor):
            return value if value.dtype == torch.bool else value != 0
        if not isinstance(value, PLAIN):
            raise _uneven(node, "a condition that is no number")
        return bool(value)

    def read(self, node: ast.AST, name: str, unset: bool = False) -> Any:
        """An attribute of the cells, as columns. unset: cells may lack it, and have NaN."""
        s, known = self.state, self.layout.variables.get(name)
        if known is not None and known.field in s.fields:
            values = s.fields[known.field]
            if not unset:
                there = ~values.isnan().reshape(len(values), -1).any(1)
                self._all(there, f"cell.{name} is not set")
            if values.dim() > 2:
                raise _uneven(node, f"cell.{name} is no plain list")
            values = values.bool() if known.is_truth(values) else values
            return values if values.dim() == 1 else list(values.unbind(1))
        if name in FIELDS and FIELDS[name] in s.fields:
            values = s.fields[FIELDS[name]]
            return values if values.dtype == torch.bool else values.double()
        if name == "id":
            return (s.uid + 1).double()
        if name in ("length", "volume", "radius"):
            return (s.radius if name == "radius" else s.length).double()
        if name in ("pos", "dir"):
            found = list((s.position if name == "pos" else s.axis).double().unbind(1))
            return [*found, *[torch.zeros_like(found[0])] * (3 - len(found))]
        if name == "species" and self.layout.species:
            return [s.fields[n].double() for n in self.layout.species_fields()]
        if name == "signals" and self.layout.signals:
            return [x.double() for x in found_signals(s, self.layout)]
        raise _uneven(node, f"it reads cell.{name}")

    # --- result --------------------------------------------------------------------------

    def result(self) -> State:
        """The state with what the rule has set."""
        s, made = self.state, {}
        for key, value in self.own.items():
            name = key[1:]
            known = self.layout.variables.get(name)
            field = known.field if known is not None else FIELDS[name]
            like = s.fields[field]
            width = like.shape[1:]
            each = value if isinstance(value, list) else [value]
            if (len(width), *width) != ((1, len(each)) if isinstance(value, list) else (0,)):
                raise Uneven(f"cell.{name} changes its length")
            if not all(isinstance(x, (Tensor, bool, int, float)) for x in each):
                raise Uneven(f"cell.{name} is set to other than numbers")
            columns = [x if isinstance(x, Tensor) else _column(x, s.length) for x in each]
            new = torch.stack(columns, 1) if width else columns[0]
            if name == "cellType" and bool((new != new.round()).any()):
                raise Uneven("cell.cellType is set to other than whole numbers")
            if name == "growthRate":
                check_growth(new)
            made[field] = new.to(like.dtype)
        return s.with_fields(**made)


def _uneven(node: ast.AST, what: str) -> Uneven:
    return Uneven(f"line {getattr(node, 'lineno', '?')}: {what}")


def _is_name(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.Name) and node.id == name


def _more_than_one(given: ast.arguments) -> bool:
    """Whether a function takes other than one argument."""
    return len(given.args) != 1 or bool(given.vararg or given.kwonlyargs or given.kwarg)


def _does_nothing(node: ast.stmt) -> bool:
    return isinstance(node, (ast.Pass, ast.Global)) or (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    )


def _as_read(node: ast.expr) -> ast.expr:
    if isinstance(node, ast.Name):
        return ast.Name(node.id, ast.Load())
    if isinstance(node, ast.Attribute):
        return ast.Attribute(node.value, node.attr, ast.Load())
    raise _uneven(node, "an assignment that is not plain")


def _is_truth(value: Any) -> bool:
    return isinstance(value, Tensor) and value.dtype == torch.bool


def _hashable(value: Any) -> bool:
    try:
        hash(value)
    except TypeError:
        return False
    return True
