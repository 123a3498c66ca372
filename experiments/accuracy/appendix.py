"""Writes docs/accuracy_appendix.md from the records of the studies, without running them.

The records are in experiments/benchmarks/accuracy: one CSV file for each study and records.json.
records.json has the title, the plotted errors, the machine and further figures of each study.
The prose is in appendix_template.md. Lines of two kinds are replaced there: `[study NAME]` by the
picture and the table of a study, `[tune]` and `[presets]` by the tables of
experiments/tune_check.py and preset_check.py. Figures in braces, such as {mechanics_order.cells},
come from records.json.
"""

from __future__ import annotations

import csv
import json
import re
import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from study import Point, Study, order_lines, plot, read_csv, table, write_csv

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "experiments" / "benchmarks" / "accuracy"
TEMPLATE = Path(__file__).with_name("appendix_template.md")
PAGE = ROOT / "docs" / "accuracy_appendix.md"
PICTURES = ROOT / "docs" / "pictures"
STUDY = re.compile(r"\[study (\w+)\]")
WIDTH = 100  # columns of prose
MACHINE = ("date", "commit", "torch", "threads", "processor")


def add_record(name: str, machine: dict[str, Any], **more: Any) -> None:
    """Adds or replaces one entry of records.json."""
    path = RECORDS / "records.json"
    records = json.loads(path.read_text()) if path.exists() else {}
    records[name] = {**more, "measured": {key: machine[key] for key in MACHINE}}
    path.write_text(json.dumps(records, ensure_ascii=False, indent=1) + "\n")


def add_study(study: Study, machine: dict[str, Any]) -> None:
    """Stores a study: its CSV file and its entry of records.json."""
    write_csv(study, RECORDS / f"{study.name}.csv")
    add_record(study.name, machine, title=study.title, shown=study.shown, facts=study.facts)


def load_study(name: str) -> Study:
    """Returns a study from its records."""
    record = json.loads((RECORDS / "records.json").read_text())[name]
    work, points = read_csv(RECORDS / f"{name}.csv")
    return Study(name, record["title"], work, tuple(record["shown"]), points, record["facts"])


def picture(name: str) -> Path:
    """Returns the path of a study's picture."""
    return PICTURES / f"accuracy_{name}.png"


def write(pictures: bool = False) -> Path:
    """Writes the appendix, and the pictures if requested. Returns the path of the page."""
    records = json.loads((RECORDS / "records.json").read_text())
    facts = {name: SimpleNamespace(**r.get("facts", {})) for name, r in records.items()}
    blocks = []
    for block in TEMPLATE.read_text().format(**facts).strip().split("\n\n"):
        found = STUDY.fullmatch(block.strip())
        if found:
            study = load_study(found[1])
            if pictures:
                plot(study, picture(study.name))
            blocks += _study(study, records[study.name]["measured"])
        elif block.strip() in ("[tune]", "[presets]"):
            name = block.strip()[1:-1]
            blocks += _plain(name, records[name])
        else:
            blocks.append(_wrapped(block))
    PAGE.write_text("\n\n".join(blocks) + "\n")
    return PAGE


def _measured(m: dict[str, Any]) -> str:
    threads = f"{m['threads']} thread" + "s" * (m["threads"] > 1)
    processor = f", {m['processor']}" if m["processor"] else ""
    return (
        f"Measured {m['date'][:10]} at commit {m['commit']}, torch {m['torch']},"
        f" {threads}{processor}."
    )


def _study(study: Study, measured: dict[str, Any]) -> list[str]:
    blocks = [
        _wrapped(_measured(measured)),
        f"![{study.title}](pictures/{picture(study.name).name})",
    ]
    if any(p.band for p in study.points):
        differences = "\n".join(_outside_band(p) for p in study.points)
        blocks += ["Statistics that differ from the reference by more than their band:"]
        blocks += [_wrapped(differences)]
    blocks.append(table(study))
    orders = order_lines(study)
    if orders:
        blocks += [
            "Order of each error in the step, by least squares:",
            _wrapped("\n".join(orders)),
        ]
    return blocks


def _outside_band(p: Point) -> str:
    names = [n for n, error in p.errors.items() if error > p.band.get(n, 0.0)]
    return f"- {p.setting}: {'; '.join(names) or 'none'}"


def _plain(name: str, record: dict[str, Any]) -> list[str]:
    """Returns the table of a CSV file, and when it was measured."""
    with (RECORDS / f"{name}.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|---" * len(rows[0]) + "|")
    error = record.get("facts", {}).get("error")
    requested = "" if error is None else f"Requested error: {error}. "
    return [_wrapped(requested + _measured(record["measured"])), "\n".join(lines)]


def _wrapped(block: str) -> str:
    """Breaks prose and list items at WIDTH; leaves headings, tables and indented code."""
    if block.startswith(("#", "|", "    ", "<")):
        return block
    items = re.split(r"\n(?=- )", block)
    return "\n".join(
        textwrap.fill(
            re.sub(r"(\d) %", "\\1\N{NO-BREAK SPACE}%", " ".join(item.split())),
            WIDTH,
            subsequent_indent="  " if item.startswith("- ") else "",
            break_long_words=False,
            break_on_hyphens=False,
        )
        for item in items
    )
