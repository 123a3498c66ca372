"""The semantic cases of the SBML Test Suite, by torchfilm's circuits.

    python experiments/sbml_suite.py …/sbml-test-suite/cases/semantic --out runs/sbml_suite.md

Each case has a model, and the values of some of its quantities at some times. The newest version
of the model is read as a user reads it, and runs in one cell that does not grow. A case passes if
every value is within the case's own tolerances of the suite's. A model that torchfilm refuses is
out of scope; the table counts the reasons. The suite is at github.com/sbmlteam/sbml-test-suite.
"""

from __future__ import annotations

import argparse
import collections
import csv
import json
import multiprocessing
import signal
import warnings
from pathlib import Path
from typing import Any

import torch
from arguments import in_folder, out_file, positive, whole

import torchfilm as tf
from torchfilm.circuits import sbml
from torchfilm.circuits.equations import Equations, Term
from torchfilm.circuits.expressions import Expression
from torchfilm.circuits.names import Names
from torchfilm.circuits.sbml.mathml import calculate
from torchfilm.circuits.sbml.quantities import SPECIES, Quantities
from torchfilm.circuits.sbml.reading import TIME
from torchfilm.effects.circuit import OPTION_NAMES
from torchfilm.effects.circuit_sbml import model_choices

# What a message of torchfilm is counted as, in the order in which they are tried.
REASONS = {
    "the event": "events",
    "algebraic rule": "algebraic rules",
    "fast reaction": "fast reactions",
    "constraint": "constraints",
    "needs the package": "a package beyond the core of SBML",
    "'delay'": "delays",
    "depend on each other": "rates that depend on themselves",
    "never below 0": "values below 0",
    "below 0": "values below 0",
    "below zero": "values below 0",
    "nothing in the model changes": "nothing changes",
    "has no kinetic law": "reactions without a rate",
    "has no value": "constants without a value",
    "has no first value": "species without a first value",
    "factorial of a variable": "factorials of variables",
}
PASSED, FAILED, OUT = "passed", "failed", "out of scope"


def settings_of(path: Path) -> dict[str, str]:
    pairs = (line.partition(":") for line in path.read_text().splitlines() if ":" in line)
    return {name.strip().lower(): value.strip() for name, _, value in pairs}


def newest(case: Path) -> Path:
    """The model of the highest level and version."""
    return sorted(case.glob("*-sbml-l*v*.xml"))[-1]


def listed(text: str) -> list[str]:
    return [n.strip() for n in text.split(",") if n.strip()]


def wanted_term(quantities: Quantities, name: str, amount: bool) -> Term:
    """A quantity as the case wants it: of species, as an amount or as a concentration."""
    found = quantities.value(name)
    if name not in quantities.things or quantities.things[name][0] != SPECIES:
        return found
    species = quantities.things[name][1]
    if amount == bool(species.getHasOnlySubstanceUnits()):
        return found
    size = quantities.size(species)
    return calculate(quantities.builder, "mul" if amount else "div", found, size)


def course(circuit: tf.Circuit, times: list[float]) -> dict[str, torch.Tensor]:
    """The variables at the times, (T,) each, in one cell that does not grow."""
    cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
    scene = tf.Scene(circuit, founders=cells, dt=1.0)
    model = scene.bind(dtype=torch.float64)
    state, now, found = model.start(), 0.0, []
    for time in times:
        if time > now:
            state, now = model.step(state, time - now), time
            wrong = tf.failures(state)
            if wrong:
                raise tf.SimulationError(str(wrong))
        found.append(torch.stack([state.fields[n][0] for n in circuit.species]))
    both = torch.stack(found, 1)
    return dict(zip(circuit.species, both, strict=True))


def computed(path: Path, rows: list[dict[str, str]], settings: dict[str, str],
             options: argparse.Namespace) -> dict[str, torch.Tensor]:  # fmt: skip
    """The case's quantities at its times, (T,) each."""
    times = [float(row["time"]) for row in rows]
    given = model_choices((), None, (), "h", None, {}, OPTION_NAMES)
    description = sbml.describe(sbml.decoded(path.read_bytes(), path.name), path.name, given)
    quantities = description.quantities
    amounts = listed(settings["amount"])
    wanted = {n: wanted_term(quantities, n, n in amounts) for n in listed(settings["variables"])}
    circuit = tf.Circuit.from_sbml(
        path, time_unit="h", rtol=options.rtol, atol=options.atol, backend=options.backend
    )
    found = course(circuit, times)
    as_expression = lambda x: x if isinstance(x, Expression) else quantities.builder.number(x)
    equations = Equations.of(
        "wanted", description.species, {n: as_expression(x) for n, x in wanted.items()}, {}
    )
    numbers = {quantities.column(n): x for n, x in quantities.constants.items()}
    constants = Names(
        list(numbers), [torch.tensor(x, dtype=torch.float64) for x in numbers.values()]
    )
    found = {TIME: torch.tensor(times, dtype=torch.float64), **found}
    u = Names(list(found), list(found.values()))
    made, _ = equations(u, constants, constants, constants)
    return {n: torch.as_tensor(x, dtype=torch.float64).expand(len(times)) for n, x in made.items()}


def run_case(case: Path, options: argparse.Namespace) -> dict[str, Any]:
    name = case.name
    settings = settings_of(case / f"{name}-settings.txt")
    about = (case / f"{name}-model.m").read_text(errors="replace")
    if "FluxBalance" in about:
        return {"case": name, "is": OUT, "why": "flux balance"}
    with (case / f"{name}-results.csv").open(encoding="utf-8-sig") as file:
        header, *lines = [row for row in csv.reader(file) if row]
    columns = ["time", *(n.strip() for n in header[1:])]
    rows = [dict(zip(columns, line, strict=False)) for line in lines]
    try:
        found = computed(newest(case), rows, settings, options)
    except (tf.InputError, tf.SimulationError) as error:
        said = str(error)
        why = next((r for key, r in REASONS.items() if key in said), "")
        shown = listed(settings["variables"])
        below = any(float(row[n]) < 0 for row in rows for n in shown)
        # of a variable that the case does not show, the sign is not known
        if (
            isinstance(error, tf.SimulationError)
            and not below
            and any(f"'{n}'" in said for n in shown)
        ):
            why = ""
        return {"case": name, "is": OUT if why else FAILED, "why": why or said}
    absolute, relative = float(settings["absolute"]), float(settings["relative"])
    worst = 0.0
    for quantity, values in found.items():
        for row, value in zip(rows, values.tolist(), strict=True):
            right = float(row[quantity])
            if value == right or (value != value and right != right):
                continue
            off = abs(value - right) / (absolute + relative * abs(right))
            worst = max(worst, off if off == off else float("inf"))
    is_right = worst <= 1.0
    return {"case": name, "is": PASSED if is_right else FAILED, "why": f"{worst:.3g} tolerances"}


def guarded(task: tuple[Path, argparse.Namespace]) -> dict[str, Any]:
    """One case, which ends after a time."""
    case, options = task
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)

    def stop(*_: object) -> None:
        raise TimeoutError(f"more than {options.seconds} s")

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(options.seconds)
    try:
        return run_case(case, options)
    except Exception as error:
        return {"case": case.name, "is": FAILED, "why": f"{type(error).__name__}: {error}"}
    finally:
        signal.alarm(0)


def table(found: list[dict[str, Any]]) -> str:
    """Cases by what became of them, as Markdown."""
    count = collections.Counter(r["is"] for r in found)
    reasons = collections.Counter(r["why"] for r in found if r["is"] == OUT)
    lines = ["| cases | number |", "|---|---|", f"| all | {len(found):,} |"]
    lines += [f"| supported and passed | {count[PASSED]:,} |", f"| failed | {count[FAILED]:,} |"]
    lines += [f"| out of scope | {count[OUT]:,} |"]
    lines += [f"| – {why} | {n:,} |" for why, n in reasons.most_common()]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("path", type=in_folder, help="the folder of the cases, cases/semantic")
    parser.add_argument(
        "--out", type=out_file, help="where to write the table, and beside it a .json"
    )
    parser.add_argument("--only", nargs="*", default=(), help="numbers of cases")
    parser.add_argument("--every", type=whole, default=1, help="only every so many cases")
    parser.add_argument("--backend", default="torch", choices=("torch", "compiled"))
    parser.add_argument("--rtol", type=positive, default=1e-6)
    parser.add_argument("--atol", type=positive, default=1e-11)
    parser.add_argument("--seconds", type=whole, default=120, help="at most, for one case")
    parser.add_argument("--processes", type=whole, default=2)
    options = parser.parse_args()
    cases = sorted(p for p in options.path.iterdir() if (p / f"{p.name}-settings.txt").is_file())
    cases = [c for c in cases if not options.only or c.name in options.only][:: options.every]
    tasks = [(case, options) for case in cases]
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        found = pool.map(guarded, tasks, chunksize=4)
    for record in found:
        if record["is"] == FAILED:
            print(record["case"], record["why"])
    print(table(found))
    if options.out is not None:
        options.out.write_text(table(found))
        options.out.with_suffix(".json").write_text(json.dumps(found, indent=0))


if __name__ == "__main__":
    main()
