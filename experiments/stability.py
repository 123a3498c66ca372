"""Writes the table of docs/stability.md: every hard case with its criterion and what its tests
measured.

    python experiments/stability.py                                      # on a machine with a GPU the CUDA columns too
    python experiments/stability.py --values runs/values.json            # keep the values, or, with --with, add another machine's
    python experiments/stability.py --with runs/cuda.json

Runs the tests of tests/laws, which note with the fixture `measured` the very values that they
assert on; of several of one case the worst is shown. The text around the table is written by hand.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from record import write_page  # noqa: E402

PAGE = ROOT / "docs" / "stability.md"
MARK = "written by experiments/stability.py"
CASE = re.compile(r"test_case_(\d+)_")
COLUMNS = ("cpu float32", "cpu float64", "cuda float32", "cuda float64")
HEADS = {
    "cpu float32": "float32",
    "cpu float64": "float64",
    "cuda float32": "float32, CUDA",
    "cuda float64": "float64, CUDA",
}

# by case: what was measured -> column -> worst value, under "criterion" what it must be
Values = dict[str, dict[str, dict[str, float | str]]]


@dataclass
class Noting:
    """A pytest plugin: `cases`, the first sentence of each case's first test; `values`; and tests
    that failed."""

    cases: dict[str, str] = field(default_factory=dict)
    tests: dict[str, str] = field(default_factory=dict)
    values: Values = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)
    passed: int = 0

    def pytest_collection_modifyitems(self, items: list[pytest.Function]) -> None:
        for item in items:
            found = CASE.match(item.name)
            if found:
                said = " ".join((item.function.__doc__ or "").split("\n\n")[0].split())
                self.cases.setdefault(found[1], said)
                self.tests.setdefault(found[1], item.originalname)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.append(report.nodeid)
        if report.when != "call":
            return
        self.passed += report.passed
        name = report.nodeid.rsplit("::")[-1]
        found, column = (
            CASE.match(name),
            next((c for c in COLUMNS if all(word in name for word in c.split())), None),
        )
        if found is None or column is None:
            return
        for key, noted in report.user_properties:
            if key == "measured":
                worse(self.values.setdefault(found[1], {}), *noted, column)


def worse(
    case: dict[str, dict[str, float | str]], what: str, value: float, criterion: str, column: str
) -> None:
    """Keep the worse of what a case has and `value`."""
    row = case.setdefault(what, {"criterion": criterion})
    pick = min if criterion.startswith("≥") else max
    row[column] = pick(value, float(row.get(column, value)))


def shown(value: float | str | None) -> str:
    return "-" if value is None else "0" if value == 0 else f"{float(value):.2g}".replace("-", "−")


def table(noting: Noting, extra: Values) -> str:
    """The table in Markdown: a line for each thing measured, or for a case that notes none the name
    of its test."""
    values = {case: {**noting.values.get(case, {})} for case in noting.cases}
    for case, rows in extra.items():
        for what, row in rows.items():
            for column in COLUMNS:
                if column in row:
                    worse(
                        values.setdefault(case, {}),
                        what,
                        float(row[column]),
                        str(row["criterion"]),
                        column,
                    )
    lines = [
        "| case | what is set up, and what must hold | measured | criterion | "
        + " | ".join(HEADS[c] for c in COLUMNS)
        + " |",
        "|" + "---|" * 8,
    ]
    for case in sorted(noting.cases, key=int):
        about = noting.cases[case].replace("|", "\\|")
        if not values[case]:
            lines.append(f"| {int(case)} | {about} | no value: `{noting.tests[case]}` | | | | | |")
        for number, (what, row) in enumerate(values[case].items()):
            head = f"{int(case)} | {about}" if number == 0 else " | "
            lines.append(
                f"| {head} | {what} | {row['criterion']} | "
                + " | ".join(shown(row.get(c)) for c in COLUMNS)
                + " |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--values", type=Path, help="write the values here, as JSON")
    parser.add_argument(
        "--with", dest="extra", type=Path, help="add the values that another run wrote"
    )
    chosen = parser.parse_args()
    noting = Noting()
    pytest.main(
        ["-q", "-p", "no:cacheprovider", "-n", "0", str(ROOT / "tests" / "laws")], plugins=[noting]
    )
    if chosen.values:
        chosen.values.write_text(json.dumps(noting.values, ensure_ascii=False, indent=1))
    extra: Values = json.loads(chosen.extra.read_text()) if chosen.extra else {}
    write_page(
        PAGE,
        f"{table(noting, extra)}\n\n{noting.passed} tests passed, {len(noting.failed)} failed.",
        MARK,
    )
    if noting.failed:
        sys.exit("failed, and the page says so: " + ", ".join(noting.failed))


if __name__ == "__main__":
    main()
