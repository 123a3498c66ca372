"""Measures the cost of each effect in every ready-made scene: time, operators and bytes per step.

    OMP_NUM_THREADS=1 python experiments/effect_costs.py          # five to ten minutes
    OMP_NUM_THREADS=1 python experiments/effect_costs.py --cells 50 --out runs/costs.json

The first command writes its part of docs/effects.md and a JSON record, scene by scene. With some
scenes or other sizes the record goes to runs/, and the page stays as it is.

Each scene grows from its founders to 200 cells in each of 4 colonies, or for 12 h. From there the
script runs 20 steps twice. One run is timed. The other counts the dispatched operators and the
bytes allocated for their results. Operators and bytes do not depend on other work on the machine.
Times are given as shares of one run.

The script then tests that an effect which a scene does not list costs nothing. It runs growth,
division and mechanics alone and together with effects that do not act on them. Cells, operators and
bytes must be the same.
"""

from __future__ import annotations

import json
import statistics
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from arguments import out_file, whole

import torchfilm as tf
from torchfilm.cost_estimate import Spending

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from record import machine, scenes_parser, write_page

HERE = Path(__file__).parent
CELLS, COLONIES, STEPS, HOURS = 200, 4, 20, 12.0
# Sizes of the ready-made scenes whose default size holds too few cells.
SETTINGS = {"channel": {"width": 16.0, "length": 80.0}, "programmed_growth": {"edge": 20.0}}
MARK = "tables: experiments/effect_costs.py"
BODY = ("growth", "mechanics", "division")


def grown(scene: tf.Scene, cells: int, colonies: int) -> tf.State:
    """Returns the colonies of a scene with `cells` cells each, or after HOURS."""
    until = round(HOURS / scene.dt) * scene.dt
    return tf.simulate(scene, colonies=colonies, seed=0, cells=cells, until=until).last()


def counted(model: tf.Model, state: tf.State, steps: int) -> list[Spending]:
    """Returns the operators and bytes of each of the next steps."""
    found = []
    for _ in range(steps):
        found.append(Spending())
        state = model.step(state, model.scene.dt, found[-1])
    return found


def timed(model: tf.Model, state: tf.State, steps: int) -> dict[str, float]:
    """Returns the median time of a step, ms, by effect."""
    times: dict[str, list[float]] = {}
    for _ in range(steps):
        timings = tf.Timings()
        state = model.step(state, model.scene.dt, timings)
        for title, seconds in timings.seconds.items():
            times.setdefault(title, []).append(1e3 * seconds)
    return {title: statistics.median(ms) for title, ms in times.items()}


def of_scene(name: str, cells: int, colonies: int) -> dict:
    """Returns the cost per step of the effects of a ready-made scene."""
    scene = tf.scenes.build(name, SETTINGS.get(name))
    state = grown(scene, cells, colonies)
    model = scene.bind(state=state)
    timed(model, state, 3)  # warm up
    ms, spent = timed(model, state, STEPS), counted(model, state, STEPS)
    effects = {
        title: {
            "ms": round(ms[title], 4),
            "share": round(ms[title] / sum(ms.values()), 4),
            "operators": sum(sum(s.calls[title].values()) for s in spent) / STEPS,
            "bytes": sum(s.bytes[title] for s in spent) / STEPS,
        }
        for title in ms
    }
    return {
        "case": "scene",
        "scene": name,
        "settings": SETTINGS.get(name, {}),
        "cells": state.cells,
        "colonies": colonies,
        "steps": STEPS,
        "effects": effects,
    }


def _set_mark(cells: tf.State) -> None:
    cells.mark = cells.length * 2.0


def _synthesis(u, s, p, cell):
    return {"m": 1.0 - u.m}


def additions() -> dict[str, Sequence[tf.Effect]]:
    """Returns effects that do not act on growth, division and mechanics."""
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=10.0),
        box=((-64.0, -64.0), (64.0, 64.0)),
        spacing=4.0,
        outside="grow",
    )
    smooth = tf.Circuit(_synthesis, species=("m",))
    molecules = tf.Circuit(
        [tf.parts.constitutive("m", 1.0), tf.parts.degradation("m", 1.0)],
        species=("m",),
        method="tau_leap",
    )
    return {
        "nothing": (),
        "a circuit": (smooth,),
        "a circuit, molecule by molecule": (molecules,),
        "a medium": (medium,),
        "a circuit and a medium": (smooth, medium),
        "rules": (tf.Rules(_set_mark),),
        "removal": (tf.Removal((-500.0, -500.0), (500.0, 500.0)),),
    }


def beside(cells: int, colonies: int) -> list[dict]:
    """Returns operators and bytes of growth, division and mechanics, alone and with other effects.

    They are totals of STEPS steps. Raises SystemExit if growth or mechanics differ.
    """
    records = []
    for name, more in additions().items():
        scene = tf.Scene(
            tf.Growth(rate=1.0),
            tf.Division(length=tf.Uniform(3.5, 4.5)),
            tf.Mechanics(dim=2),
            *more,
        )
        state = grown(scene, cells, colonies)
        spent = counted(scene.bind(state=state), state, STEPS)
        record: dict = {
            "case": "beside",
            "beside": name,
            "cells": state.cells,
            "colonies": colonies,
            "steps": STEPS,
        }
        for title in BODY:
            calls = sum((s.calls[title] for s in spent), Counter())
            record[title] = {
                "operators": sum(calls.values()),
                "bytes": sum(s.bytes[title] for s in spent),
                "by_name": dict(sorted(calls.items())),
            }
        others = [title for title in spent[0].calls if title not in BODY]
        record["others"] = {
            "operators": sum(sum(s.calls[t].values()) for s in spent for t in others),
            "bytes": sum(s.bytes[t] for s in spent for t in others),
        }
        records.append(record)
        alone = records[0]
        for title in ("growth", "mechanics"):
            if record[title] != alone[title] or state.cells != alone["cells"]:
                raise SystemExit(
                    f"{title} with {name} costs {record[title]}, but alone {alone[title]}"
                )
        print(f"with {name}: growth and mechanics cost the same", flush=True)
    return records


def scene_rows(record: dict) -> list[str]:
    """Returns the rows of a scene in the table."""
    effects = record["effects"]
    total = {key: sum(e[key] for e in effects.values()) for key in ("ms", "operators", "bytes")}
    rows = [
        f"| **{record['scene']}**, {record['cells']} cells | {total['ms']:.1f} ms |"
        f" {total['operators']:.0f} | {total['bytes'] / 1e6:.2f} |"
    ]
    for title, e in sorted(effects.items(), key=lambda item: -item[1]["ms"]):
        rows.append(
            f"| {title} | {100 * e['share']:.1f} % | {e['operators']:.0f} |"
            f" {e['bytes'] / 1e6:.2f} |"
        )
    return rows


def tables(noted: dict, records: list[dict]) -> str:
    """Returns the tables of the page in Markdown."""
    scenes, body = ([r for r in records if r["case"] == case] for case in ("scene", "beside"))
    head = textwrap.fill(
        f"Measured {noted['date'][:10]} at commit {noted['commit']}, torch {noted['torch']},"
        f" Python {noted['python']}, {noted['threads']} thread{'s' * (noted['threads'] > 1)},"
        f" {noted['processor']}, float32. Means over {STEPS} steps of {scenes[0]['colonies']}"
        " colonies; times are medians, as shares of the step.",
        100,
    )
    lines = [
        head,
        "",
        "| scene, effect | time of a step | operators a step | MB allocated a step |",
        "|---|---|---|---|",
        *(row for r in scenes for row in scene_rows(r)),
        "",
        "### An effect that is not listed costs nothing",
        "",
        (
            f"{body[0]['cells']} cells in {body[0]['colonies']} colonies, {STEPS} steps: total"
            " operators dispatched and bytes allocated."
        ),
        "",
        (
            "| growth, division and mechanics with | growth | mechanics | division | the other"
            " effects |"
        ),
        "|---|---|---|---|---|",
    ]
    show: Callable[[dict], str] = lambda cost: f"{cost['operators']}, {cost['bytes']:,} B"
    lines += [
        f"| {r['beside']} | " + " | ".join(show(r[key]) for key in (*BODY, "others")) + " |"
        for r in body
    ]
    return "\n".join(lines)


def main() -> None:
    parser = scenes_parser(__doc__)
    parser.add_argument("--cells", type=whole, default=CELLS, help="in each colony")
    parser.add_argument("--colonies", type=whole, default=COLONIES)
    parser.add_argument(
        "--out",
        type=out_file,
        help="JSON record to write; replaces an existing one; default: that of the page, or"
        " runs/effect_costs.json with some scenes or other sizes",
    )
    parser.add_argument(
        "--page",
        help="page with the tables to update; '' for none; default: docs/effects.md, or none with"
        " some scenes or other sizes",
    )
    options = parser.parse_args()
    usual = not options.scene and (options.cells, options.colonies) == (CELLS, COLONIES)
    if options.page is None:
        options.page = HERE.parent / "docs" / "effects.md" if usual else ""
    if options.out is None:
        name = "effect_costs.json"
        options.out = HERE / "benchmarks" / name if usual else out_file(f"runs/{name}")
    tf.keep_memory()
    torch.set_grad_enabled(False)
    noted, records = machine(), []
    write = lambda: options.out.write_text(
        json.dumps([noted | record for record in records], indent=1) + "\n"
    )
    for name in options.scene or tf.scenes.READY:
        records.append(of_scene(name, options.cells, options.colonies))
        write()  # an interrupted run keeps what it has
        print("\n".join(scene_rows(records[-1])), flush=True)
    records += beside(options.cells, options.colonies)
    write()
    if options.page:
        write_page(Path(options.page), tables(noted, records), MARK)


if __name__ == "__main__":
    main()
