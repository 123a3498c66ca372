"""Small made-up gate libraries, in both versions of the UCF format."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

# gate: repressor, ymax, ymin, K, n
GATES = {
    "A1_AlfR": ("AlfR", 3.6, 0.06, 0.07, 1.6),
    "B1_BetR": ("BetR", 0.5, 0.005, 0.04, 3.4),
    "B2_BetR": ("BetR", 0.8, 0.01, 0.25, 3.2),
    "D1_DelR": ("DelR", 2.6, 0.07, 0.4, 2.5),
    "E1_EpsR": ("EpsR", 4.0, 0.02, 0.03, 3.9),
    "K1_KapR": ("KapR", 2.4, 0.02, 0.05, 2.7),
    "K2_KapR": ("KapR", 2.8, 0.03, 0.21, 2.4),
}
HILL_1 = "ymin+(ymax-ymin)/(1.0+(x/K)^n)"
HILL_2 = "ymin + (ymax - ymin) / (1.0 + (x / K)^n)"
KINDS = ("ribozyme", "rbs", "cds", "terminator")

Records = list[dict[str, Any]]


def numbers(**values: float) -> Records:
    return [{"name": name, "value": x} for name, x in values.items()]


def cassette(gate: str) -> list[str]:
    repressor = GATES[gate][0]
    return [f"Ribo{repressor[:3]}", gate[:2], repressor, f"T_{repressor}"]


def all_parts() -> Records:
    parts = {part: kind for g in GATES for part, kind in zip(cassette(g), KINDS, strict=True)}
    parts |= {f"p{row[0]}": "promoter" for row in GATES.values()}
    return [
        {"collection": "parts", "type": kind, "name": name, "dnasequence": "ACGT"}
        for name, kind in parts.items()
    ]


def version_1() -> Records:
    out: Records = [{"collection": "header", "version": "made up"}]
    for gate, (repressor, ymax, ymin, k, n) in GATES.items():
        out += [
            {
                "collection": "gates",
                "gate_name": gate,
                "group_name": repressor,
                "regulator": repressor,
                "gate_type": "NOR",
            },
            {
                "collection": "response_functions",
                "gate_name": gate,
                "equation": HILL_1,
                "variables": [{"name": "x", "off_threshold": 0.1, "on_threshold": 1.0}],
                "parameters": numbers(ymax=ymax, ymin=ymin, K=k, n=n),
            },
            {
                "collection": "gate_parts",
                "gate_name": gate,
                "promoter": f"p{repressor}",
                "expression_cassettes": [
                    {"maps_to_variable": "x", "cassette_parts": cassette(gate)}
                ],
            },
        ]
    return out + all_parts()


def maps(*names: str) -> Records:
    return [{"name": name, "map": f"#//model/parameters/{name}"} for name in names]


def version_2(split: bool = False) -> Records:
    """split: one transcription unit for each input, as in published files of yeast."""
    inputs = [{"name": name, "part_type": "promoter"} for name in ("in1", "in2")]
    add = lambda collection, name, **fields: {"collection": collection, "name": name, **fields}
    out = [
        add("functions", "Hill", equation=HILL_2, parameters=maps("ymax", "ymin", "K", "n")),
        add("functions", "sum", equation="x1 + x2"),
    ]
    for gate, (repressor, ymax, ymin, k, n) in GATES.items():
        inside = {"name": f"{gate}_cassette", "components": cassette(gate)}
        fronts = (["#in1"], ["#in2"]) if split else (["#in2", "#in1"],)
        devices = [
            {"name": f"{gate}_{number}", "components": [*front, f"{gate}_cassette"]}
            for number, front in enumerate(fronts)
        ]
        functions = {"response_function": "Hill", "input_composition": "sum"}
        values = numbers(ymax=ymax, ymin=ymin, K=k, n=n)
        names = {"model": f"{gate}_model", "structure": f"{gate}_structure"}
        out += [
            add("gates", gate, group=repressor, regulator=repressor, gate_type="NOR", **names),
            add("models", names["model"], functions=functions, parameters=values),
            add(
                "structures",
                names["structure"],
                inputs=inputs,
                outputs=[f"p{repressor}"],
                devices=[*devices, inside],
            ),
        ]
    return out + all_parts()


def inputs_and_outputs() -> Records:
    """What version 2 keeps in files of their own: one sensor, one reporter."""
    inputs = [{"name": name, "part_type": "promoter"} for name in ("in1", "in2")]
    add = lambda collection, name, **fields: {"collection": collection, "name": name, **fields}
    switch = "$STATE * (ymax - ymin) + ymin"
    linear = [{"name": "c", "map": "#//model/parameters/unit_conversion"}]
    parts = [("pTac", "promoter"), ("YFP_cassette", "cassette")]
    return [
        add("input_sensors", "LacI_sensor", model="LacI_model", structure="LacI_structure"),
        add(
            "models",
            "LacI_model",
            functions={"response_function": "sensor_response"},
            parameters=numbers(ymax=2.8, ymin=0.004, alpha=0.7),
        ),
        add("structures", "LacI_structure", outputs=["pTac"]),
        add("functions", "sensor_response", equation=switch, parameters=maps("ymax", "ymin")),
        add("output_devices", "YFP_reporter", model="YFP_model", structure="YFP_structure"),
        add(
            "models",
            "YFP_model",
            functions={"response_function": "linear", "input_composition": "sum"},
            parameters=numbers(unit_conversion=0.5),
        ),
        add(
            "structures",
            "YFP_structure",
            inputs=inputs,
            devices=[{"name": "YFP_reporter", "components": ["#in1", "#in2", "YFP_cassette"]}],
        ),
        add("functions", "linear", equation="c * x", parameters=linear),
        add("functions", "sum", equation="x1 + x2"),
        *(add("parts", name, type=kind, dnasequence="acgt") for name, kind in parts),
    ]


def write(path: Path, records: object) -> Path:
    path.write_text(json.dumps(records, indent=1))
    return path
