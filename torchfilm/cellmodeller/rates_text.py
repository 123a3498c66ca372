"""Reads the OpenCL text of `specRateCL` and `sigRateCL` into a tree.

Known are declarations, assignments, `if` and `else`, blocks, and expressions: arithmetic,
comparisons, `&&`, `||`, `!`, ternaries, casts, calls, `species[0]` and `pos.x`. Everything else
raises InputError with the line of the text. Nothing here is executed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from torchfilm.tools.checks import InputError

TYPES = ("float", "double", "int", "uint", "bool", "short", "long")
QUALIFIERS = ("const", "unsigned", "signed", "__private", "private")
REFUSED = ("for", "while", "do", "switch", "return", "goto", "break", "continue", "struct")
ASSIGNMENTS = ("=", "+=", "-=", "*=", "/=")
LEVELS = (("||",), ("&&",), ("==", "!="), ("<", ">", "<=", ">="), ("+", "-"), ("*", "/", "%"))
TOKEN = re.compile(
    r"(?P<number>(?:\d+\.\d*|\.\d+|\d+)(?:[eE][+-]?\d+)?[fFuUlL]?)"
    r"|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<mark>\+\+|--|&&|\|\||[=!<>+\-*/]=|[-+*/%=<>!?:;,.(){}\[\]])"
)


@dataclass(frozen=True)
class Node:
    """A part of the text. kind: "number", "name", "item" (species[0]), "part" (pos.x), "call",
    "unary", "binary", "choice", "set", "if" or "block". text: the operation or the name; parts:
    what it is made of; line: of the text, from 1. type: of a number or a variable, "float", "int"
    or "bool"."""

    kind: str
    text: str
    parts: tuple[Node, ...] = ()
    line: int = 0
    type: str = "float"


@dataclass(frozen=True)
class Origin:
    """Where a text comes from, for messages. function: that returned it. name, source: of the
    script and what stands in it, where they are known."""

    function: str
    text: str
    name: str = ""
    source: str = ""

    def place(self, line: int) -> str:
        """A line of the text, from 1; as a line of the script, if it stands there as it is."""
        found = self._in_source(line)
        if found is not None:
            return f"{self.name}, line {found}: {self.function}()"
        of_script = f"{self.name}: " if self.name else ""
        return f"{of_script}{self.function}(), line {line} of its text"

    def _in_source(self, line: int) -> int | None:
        if self.text and self.source.count(self.text) == 1:
            return self.source[: self.source.index(self.text)].count("\n") + line
        # a text that was put together: the line alone
        wanted = self.text.split("\n")[line - 1].strip()
        same = [k for k, x in enumerate(self.source.split("\n"), 1) if wanted and wanted in x]
        return same[0] if len(same) == 1 else None


@dataclass(frozen=True)
class Token:
    kind: str
    text: str
    line: int


def parse(owner: Origin) -> Node:
    """The block of statements in a text."""
    return _Parser(_tokens(owner.text, owner), owner).block_to_end()


def _tokens(text: str, owner: Origin) -> list[Token]:
    blank = lambda found: "\n" * found.group().count("\n") + " "
    plain = re.sub(r"/\*.*?\*/|//[^\n]*", blank, text, flags=re.DOTALL)
    found = []
    for number, line in enumerate(plain.split("\n"), 1):
        at = 0
        if line.lstrip().startswith("#"):
            raise refusal(owner, number, line.strip(), "write `const float NAME = …;` instead")
        while at < len(line):
            if line[at].isspace():
                at += 1
                continue
            match = TOKEN.match(line, at)
            if match is None:
                raise refusal(owner, number, line[at], "this mark is not known here")
            found.append(Token(str(match.lastgroup), match.group(), number))
            at = match.end()
    return found


def refusal(owner: Origin, line: int, what: str, hint: str) -> InputError:
    """The error for a part of the text that is not supported."""
    return InputError(f"{owner.place(line)}: {what!r} is not supported: {hint}.")


class _Parser:
    """Recursive descent over the tokens."""

    def __init__(self, tokens: list[Token], owner: Origin):
        last = tokens[-1].line if tokens else 1
        self.tokens, self.at, self.owner = (
            [*tokens, Token("end", "end of the text", last)],
            0,
            owner,
        )
        # variables that can be seen: their own name among all of the text, and their type
        self.seen: dict[str, tuple[str, str]] = {}
        self.variables = 0

    @property
    def now(self) -> Token:
        return self.tokens[self.at]

    def take(self, *texts: str) -> Token | None:
        """The next token if it is one of these."""
        if self.now.kind != "end" and self.now.text in texts:
            self.at += 1
            return self.tokens[self.at - 1]
        return None

    def need(self, text: str) -> Token:
        found = self.take(text)
        if found is None:
            raise self.error(f"{text!r} is expected before it")
        return found

    def error(self, hint: str) -> InputError:
        return refusal(self.owner, self.now.line, self.now.text, hint)

    # --- statements ----------------------------------------------------------------------

    def block_to_end(self) -> Node:
        parts = []
        while self.now.kind != "end":
            parts += self.statement()
        return Node("block", "", tuple(parts), 1)

    def statement(self) -> list[Node]:
        line = self.now.line
        if self.take(";"):
            return []
        if self.take("{"):
            parts, outer = [], dict(self.seen)
            while not self.take("}"):
                if self.now.kind == "end":
                    raise self.error("'}' is expected before it")
                parts += self.statement()
            self.seen = outer
            return [Node("block", "", tuple(parts), line)]
        if self.now.text in REFUSED:
            raise self.error("known are declarations, assignments, and if … else")
        if self.take("if"):
            self.need("(")
            condition = self.expression()
            self.need(")")
            then = Node("block", "", tuple(self.statement()), line)
            other = self.statement() if self.take("else") else []
            return [Node("if", "", (condition, then, Node("block", "", tuple(other), line)), line)]
        if self.now.text in (*TYPES, *QUALIFIERS):
            return self.declaration()
        made = self.assignment(self.postfix())
        self.need(";")
        return [made]

    def declaration(self) -> list[Node]:
        kind = ""
        while self.now.text in (*TYPES, *QUALIFIERS):
            kind = self.now.text if self.now.text in TYPES else kind
            self.at += 1
        made = []
        while True:
            if self.now.kind != "name":
                raise self.error("a plain variable is expected")
            name = self.now
            self.at += 1
            type_ = {"float": "float", "double": "float", "bool": "bool"}.get(kind, "int")
            if self.now.text == "[":
                raise self.error("arrays cannot be declared")
            zero = Node("number", "0", (), name.line, type_)  # until it is set
            value = self.expression() if self.take("=") else zero
            self.variables += 1
            own = f"{name.text}'{self.variables}" if name.text in self.seen else name.text
            self.seen[name.text] = own, type_
            target = Node("name", own, (), name.line)
            made.append(Node("set", "declare", (target, value), name.line, type_))
            if not self.take(","):
                self.need(";")
                return made

    def assignment(self, target: Node) -> Node:
        operation = self.take(*ASSIGNMENTS)
        if operation is None:
            raise self.error("an assignment is expected, such as `rates[0] = …;`")
        value = self.expression()
        if operation.text != "=":
            value = Node("binary", operation.text[0], (target, value), operation.line)
        return Node("set", "assign", (target, value), operation.line, target.type)

    # --- expressions ---------------------------------------------------------------------

    def expression(self) -> Node:
        condition = self.binary(0)
        if not (mark := self.take("?")):
            return condition
        one = self.expression()
        self.need(":")
        return Node("choice", "?", (condition, one, self.expression()), mark.line)

    def binary(self, level: int) -> Node:
        if level == len(LEVELS):
            return self.unary()
        left = self.binary(level + 1)
        while operation := self.take(*LEVELS[level]):
            right = self.binary(level + 1)
            left = Node("binary", operation.text, (left, right), operation.line)
        return left

    def unary(self) -> Node:
        if mark := self.take("-", "+", "!"):
            return Node("unary", mark.text, (self.unary(),), mark.line)
        after = self.tokens[min(self.at + 1, len(self.tokens) - 1)]
        if self.now.text == "(" and after.text in TYPES:
            mark = self.need("(")
            kind = self.now.text
            self.at += 1
            self.need(")")
            return Node("unary", f"({kind})", (self.unary(),), mark.line)
        return self.postfix()

    def postfix(self) -> Node:
        token = self.now
        if self.take("("):
            inner = self.expression()
            self.need(")")
            return inner
        if token.kind not in ("number", "name") or token.text in (*TYPES, *REFUSED):
            raise self.error("a number, a name or a bracket is expected")
        self.at += 1
        if token.kind == "number":
            whole = token.text.rstrip("uUlL").isdigit()
            digits = token.text.rstrip("fFuUlL")
            return Node("number", digits, (), token.line, "int" if whole else "float")
        if self.take("("):
            return self.call(token)
        own, type_ = self.seen.get(token.text, (token.text, "float"))
        made = Node("name", own, (), token.line, type_)
        while mark := self.take("[", "."):
            if mark.text == "[":
                made = Node("item", token.text, (self.expression(),), token.line)
                self.need("]")
            else:
                made = Node("part", f"{token.text}.{self.now.text}", (), token.line)
                self.at += 1
        if self.now.text in ("++", "--"):
            raise self.error("write x = x + 1")
        return made

    def call(self, name: Token) -> Node:
        parts = []
        while not self.take(")"):
            parts.append(self.expression())
            if self.now.text != ")":
                self.need(",")
        return Node("call", name.text, tuple(parts), name.line)
