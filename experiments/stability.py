"""Writes the table of docs/stability.md: every hard case, its criterion and its measured values.

    python experiments/stability.py                             # with a GPU also the CUDA columns
    python experiments/stability.py --values runs/values.json   # also write the values to a file
    python experiments/stability.py --with runs/cuda.json       # add the values of another machine

The script runs the tests of tests/laws. The fixture `measured` records the values that the tests
assert on. The table has the worst value of each case. A second run repeats the cases of contacts
with the accuracy that ships: default contacts, α and tolerance, in float32. What fails there is
noted on the page. The text around the table is written by hand.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import textwrap
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from arguments import in_file, out_file

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from record import machine, write_page  # noqa: E402

import torchfilm as tf  # noqa: E402

PAGE = ROOT / "docs" / "stability.md"
MARK = "written by experiments/stability.py"
CASE = re.compile(r"test_case_(\d+)_")
SHIPS = "as it ships"
COLUMNS = (SHIPS, "cpu float32", "cpu float64", "cuda float32", "cuda float64")
HEADS = {
    SHIPS: SHIPS,
    "cpu float32": "float32",
    "cpu float64": "float64",
    "cuda float32": "float32, CUDA",
    "cuda float64": "float64, CUDA",
}

# What the tests give to `helpers.mechanics` is of two kinds: accuracy, and the scene.
ACCURACY = ("alpha", "tolerance", "passes", "overlap")
OF_CONTACTS = ("test_hard_mechanics.py", "test_hard_mechanics_many.py")
# sets one pass and an α of its own, to see one pass
OWN_ACCURACY = "turns_are_cut_short"

# by case: measured quantity -> column -> worst value; the column "criterion" has the criterion
Values = dict[str, dict[str, dict[str, float | str]]]


@dataclass
class Collector:
    """A pytest plugin that collects the measured values.

    cases: first paragraph of the docstring of each case's first test. tests: its name. values: the
    worst values. failed: tests that failed. passed: number of tests that passed. ships: whether
    cases of contacts run with the accuracy that ships, and no others run.
    """

    ships: bool = False
    cases: dict[str, str] = field(default_factory=dict)
    tests: dict[str, str] = field(default_factory=dict)
    values: Values = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)
    passed: int = 0

    def pytest_collection_modifyitems(self, items: list[pytest.Function]) -> None:
        if self.ships:
            items[:] = [item for item in items if may_ship(item)]
        for item in items:
            if self.ships:
                item.module.mechanics = shipped_mechanics
            found = CASE.match(item.name)
            if found:
                summary = " ".join((item.function.__doc__ or "").split("\n\n")[0].split())
                self.cases.setdefault(found[1], summary)
                self.tests.setdefault(found[1], item.originalname)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.append(report.nodeid)
        if report.when != "call":
            return
        self.passed += report.passed
        name = report.nodeid.rsplit("::")[-1]
        found = CASE.match(name)
        # a case without a device in its name has the settings that ship: float32 on the CPU
        column = next((c for c in COLUMNS[1:] if all(word in name for word in c.split())), SHIPS)
        if self.ships:
            column = SHIPS
        if found is None:
            return
        for key, value in report.user_properties:
            if key == "measured":
                keep_worse(self.values.setdefault(found[1], {}), *value, column)


def shipped_mechanics(**options: object) -> tf.Mechanics:
    """Returns the mechanics of `helpers.mechanics` with the accuracy that ships."""
    scene = {name: value for name, value in options.items() if name not in ACCURACY}
    return tf.Mechanics(**({"length_drag": 10.0} | scene))


def may_ship(item: pytest.Function) -> bool:
    """Returns whether a case can run with the accuracy that ships: default contacts, float32."""
    return (
        item.path.name in OF_CONTACTS
        and "float32" in item.name
        and "bilateral" not in item.name
        and OWN_ACCURACY not in item.name
    )


def keep_worse(
    case: dict[str, dict[str, float | str]], what: str, value: float, criterion: str, column: str
) -> None:
    """Keeps the worse of `value` and the value that the case has."""
    row = case.setdefault(what, {"criterion": criterion})
    pick = min if criterion.startswith("≥") else max
    row[column] = pick(value, float(row.get(column, value)))


def shown(value: float | str | None) -> str:
    """Returns a value as text for the table."""
    return "-" if value is None else "0" if value == 0 else f"{float(value):.2g}".replace("-", "−")


def table(collector: Collector, extra: Values) -> str:
    """Returns the table in Markdown: one line per measured quantity.

    A case without values has one line with the name of its test.
    """
    values = {case: {**collector.values.get(case, {})} for case in collector.cases}
    for case, rows in extra.items():
        for what, row in rows.items():
            for column in COLUMNS:
                if column in row:
                    keep_worse(
                        values.setdefault(case, {}),
                        what,
                        float(row[column]),
                        str(row["criterion"]),
                        column,
                    )
    columns = [c for c in COLUMNS if any(c in row for v in values.values() for row in v.values())]
    lines = [
        "| case | setup and law | measured | criterion | "
        + " | ".join(HEADS[c] for c in columns)
        + " |",
        "|" + "---|" * (4 + len(columns)),
    ]
    for case in sorted(collector.cases, key=int):
        about = collector.cases[case].replace("|", "\\|")
        if not values[case]:
            empty = " |" * (1 + len(columns))
            lines.append(f"| {int(case)} | {about} | no value: `{collector.tests[case]}` |{empty}")
        for number, (what, row) in enumerate(values[case].items()):
            head = f"{int(case)} | {about}" if number == 0 else " | "
            lines.append(
                f"| {head} | {what} | {row['criterion']} | "
                + " | ".join(shown(row.get(c)) for c in columns)
                + " |"
            )
    return "\n".join(lines)


def run(ships: bool = False) -> Collector:
    """Runs the tests of tests/laws, all or those of `ships`, and returns what they measured."""
    collector = Collector(ships)
    traces = ["--tb=no"] if ships else []
    pytest.main(
        ["-q", "-p", "no:cacheprovider", "-n", "0", *traces, str(ROOT / "tests" / "laws")],
        plugins=[collector],
    )
    return collector


def summary(collector: Collector, ships: Collector) -> str:
    """Returns when and where the table was measured, and how many tests passed."""
    noted = machine()
    where = noted["gpu"] or f"{os.cpu_count()} cores, no GPU"
    tests = {name.split("::")[-1].split("[")[0] for name in ships.failed}
    cases = sorted({int(found[1]) for name in tests if (found := CASE.match(name))})
    listed = ", ".join(map(str, cases)) or "none"
    ran = (f"{run.passed} tests passed, {len(run.failed)} failed" for run in (collector, ships))
    return textwrap.fill(
        f"Measured {noted['date'][:10]} at commit {noted['commit']}, torch {noted['torch']},"
        f" {noted['processor']}, {where}. {next(ran)}. With the accuracy that ships {next(ran)}:"
        f" of cases {listed}.",
        100,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--values", type=out_file, help="JSON file for the values")
    parser.add_argument("--with", dest="extra", type=in_file, help="add the values of another run")
    options = parser.parse_args()
    collector, ships = run(), run(ships=True)
    for case, rows in ships.values.items():
        for what, row in rows.items():
            found = collector.values.setdefault(case, {})
            keep_worse(found, what, float(row[SHIPS]), str(row["criterion"]), SHIPS)
    if options.values:
        options.values.write_text(json.dumps(collector.values, ensure_ascii=False, indent=1))
    extra: Values = json.loads(options.extra.read_text()) if options.extra else {}
    write_page(PAGE, f"{table(collector, extra)}\n\n{summary(collector, ships)}", MARK)
    if collector.failed:
        sys.exit("failed tests, noted on the page: " + ", ".join(collector.failed))


if __name__ == "__main__":
    main()
