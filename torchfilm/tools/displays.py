"""Tables of texts, and displays in notebooks: titles, tables and texts as HTML that reads well on
light and on dark pages, and output that is redrawn in place. IPython is used where a notebook has
loaded it."""

from __future__ import annotations

import sys
from collections.abc import Container, Iterable, Mapping, Sequence
from html import escape
from typing import Any

from torch import Tensor

# Colours are the page's own, or see-through grey.
LINE = "1px solid rgba(128,128,128,.35)"
CELL = "padding:.15em .9em .15em 0;vertical-align:top"


def card(title: str, *parts: str) -> str:
    """A title above parts, which are HTML by the functions of this module; empty ones are left
    out."""
    return (
        f'<div style="margin:.2em 0"><div style="font-weight:600">{escape(title)}</div>'
        f"{''.join(parts)}</div>"
    )


def aligned(rows: Sequence[Sequence[str]], left: Container[int] = ()) -> list[str]:
    """The lines of a table of texts, for a terminal. left: which columns begin below each other;
    the others end so."""
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    put = [str.ljust if k in left else str.rjust for k in range(len(wide))]
    return ["  ".join(f(x, w) for f, x, w in zip(put, r, wide, strict=True)).rstrip() for r in rows]


def table(rows: Iterable[Sequence[object]], head: Sequence[object] = ()) -> str:
    """Rows of values as a table: text as it is, numbers at the right. head: titles of columns."""
    style = f"text-align:left;font-weight:600;{CELL};border-bottom:{LINE}"
    titles = "".join(f'<th style="{style}">{escape(str(x))}</th>' for x in head)
    lines = [f"<tr>{titles}</tr>"] if titles else []
    lines += [f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows]
    if not lines:
        return ""
    style = "border-collapse:collapse;margin:.3em 0;background:transparent"
    return f'<table style="{style}">{"".join(lines)}</table>'


def pairs(values: Iterable[tuple[str, object]]) -> str:
    """Names and values as a table of two columns, the names in grey."""
    names = (
        f'<tr><td style="text-align:left;opacity:.65;{CELL}">{escape(name)}</td>{_cell(value)}</tr>'
        for name, value in values
    )
    style = "border-collapse:collapse;margin:.3em 0;background:transparent"
    return f'<table style="{style}">{"".join(names)}</table>'


def ranges(values: Mapping[str, tuple[str, Tensor]]) -> str:
    """Units and tensors by name as a table: the least, the mean and the greatest value of each."""
    rows: list[tuple[object, ...]] = []
    for name, (unit, x) in values.items():
        x = x.detach().double()
        found = [float(y) for y in (x.min(), x.mean(), x.max())] if x.numel() else ["", "", ""]
        rows.append((name, unit, *found, " × ".join(map(str, x.shape))))
    return table(rows, ("", "unit", "least", "mean", "greatest", "shape"))


def counted(count: int, one: str, several: str = "") -> str:
    """A number of things in words: "1 colony", "3 colonies". several: by default `one` + "s"."""
    return f"1 {one}" if count == 1 else f"{count} {several or one + 's'}"


def lines(words: str) -> str:
    """A text as a paragraph, with its line breaks."""
    return f'<div style="margin:.3em 0;white-space:pre-line">{escape(words)}</div>' if words else ""


class Text(str):
    """A text of several lines, which a notebook and a Python prompt show as such."""

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return text(self)


def text(words: str) -> str:
    """A text with its line breaks, in letters of one width."""
    style = "margin:.3em 0;background:transparent;color:inherit;line-height:1.35"
    return f'<pre style="{style}">{escape(words)}</pre>'


def _cell(value: object) -> str:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    shown = f"{value:.6g}" if isinstance(value, float) else str(value)
    align = "right" if number else "left"
    return f'<td style="text-align:{align};{CELL}">{escape(shown)}</td>'


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


class Output:
    """Output below a notebook's cell that can be replaced."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, data: dict[str, Any], metadata: dict[str, Any] | None = None) -> None:
        """Show data by MIME type, in place of what was shown before."""
        from IPython.display import display

        metadata = metadata or {}
        if self._handle is None:
            self._handle = display(data, metadata=metadata, raw=True, display_id=True)
        else:
            self._handle.update(data, metadata=metadata, raw=True)


def shortened(words: str, most: int) -> str:
    """At most so many letters of a text, without its middle."""
    half = (most - 1) // 2
    return words if len(words) <= most else f"{words[:half]}…{words[-half:]}"
