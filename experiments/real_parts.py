"""From a gate library to a construct: a checkerboard in a colony, from DNA parts.

    python experiments/real_parts.py --colonies 1000

Two signals enter from the left and from below. A cell should be lit where it senses one of them and
not the other: XOR, three NOR gates and a reporter with two promoters. The search chooses the gates
from a library, which this script makes up and writes as Cello would (UCF, version 2). Replace the
file by a published one, and the names of the sensors by its own.
"""

from __future__ import annotations

import argparse
import functools
import json
from typing import Any

import torch
from arguments import out_stem, whole

import torchfilm as tf
from design import CMAES, Image, Library, Search, Sensor, Wiring

# made-up gates: repressor, and ymax, ymin, K (RPU) and n of the response
GATES = {
    "A1_AlfR": ("AlfR", 3.6, 0.06, 0.07, 1.6),
    "B1_BetR": ("BetR", 0.5, 0.005, 0.04, 3.4),
    "B2_BetR": ("BetR", 0.8, 0.010, 0.25, 3.2),
    "C1_ChiR": ("ChiR", 4.0, 0.20, 0.09, 1.4),
    "D1_DelR": ("DelR", 2.6, 0.07, 0.40, 2.5),
    "E1_EpsR": ("EpsR", 4.0, 0.02, 0.03, 3.9),
    "E2_EpsR": ("EpsR", 5.0, 0.02, 0.20, 4.0),
    "G1_GamR": ("GamR", 2.2, 0.20, 0.18, 2.0),
    "K1_KapR": ("KapR", 2.4, 0.02, 0.05, 2.7),
    "K2_KapR": ("KapR", 2.8, 0.03, 0.21, 2.4),
    "S1_SigR": ("SigR", 1.3, 0.004, 0.01, 2.9),
    "S2_SigR": ("SigR", 2.1, 0.006, 0.10, 2.8),
}
SENSORS = {"LeftR_sensor": ("pLeft", 2.6, 0.010), "LowR_sensor": ("pLow", 1.9, 0.015)}
HILL = "ymin + (ymax - ymin) / (1.0 + (x / K)^n)"
SWITCH = "$STATE * (ymax - ymin) + ymin"

SIDE = 26.0  # µm from the centre to each face
REACH = 8.0  # µm over which a signal falls to 1/e
MIDDLE = 0.0388  # of a signal, in the centre: exp(−26/8)


def made_up_library() -> list[dict[str, Any]]:
    """The records of a library in version 2 of the format."""
    add = lambda collection, name, **fields: {"collection": collection, "name": name, **fields}
    numbers = lambda **values: [{"name": name, "value": x} for name, x in values.items()]
    maps = lambda *names: [{"name": n, "map": f"#//model/parameters/{n}"} for n in names]
    fronts = [{"name": "in1", "part_type": "promoter"}, {"name": "in2", "part_type": "promoter"}]
    out = [
        add("functions", "Hill", equation=HILL, parameters=maps("ymax", "ymin", "K", "n")),
        add("functions", "sensor_response", equation=SWITCH, parameters=maps("ymax", "ymin")),
        add("functions", "linear", equation="c * x", parameters=maps("c")),
        add("functions", "sum", equation="x1 + x2"),
        add("output_devices", "YFP_reporter", model="YFP_model", structure="YFP_structure"),
        add(
            "models",
            "YFP_model",
            functions={"response_function": "linear", "input_composition": "sum"},
            parameters=numbers(c=1.0),
        ),
    ]
    cassettes = {"YFP": ["RiboJ", "B0064", "YFP", "L3S2P21"]}
    for gate, (repressor, ymax, ymin, k, n) in GATES.items():
        cassettes[gate] = [f"Ribo{repressor[:3]}", gate[:2], repressor, f"T_{repressor}"]
        out += [
            add(
                "gates",
                gate,
                group=repressor,
                regulator=repressor,
                gate_type="NOR",
                model=f"{gate}_model",
                structure=f"{gate}_structure",
            ),
            add(
                "models",
                f"{gate}_model",
                functions={"response_function": "Hill", "input_composition": "sum"},
                parameters=numbers(ymax=ymax, ymin=ymin, K=k, n=n),
            ),
        ]
    for name, cassette in cassettes.items():
        devices = [{"name": name, "components": ["#in1", "#in2", *cassette]}]
        promoter = [f"p{GATES[name][0]}"] if name in GATES else []
        out.append(
            add("structures", f"{name}_structure", inputs=fronts, outputs=promoter, devices=devices)
        )
    for name, (promoter, ymax, ymin) in SENSORS.items():
        out += [
            add("input_sensors", name, model=f"{name}_model", structure=f"{name}_structure"),
            add(
                "models",
                f"{name}_model",
                functions={"response_function": "sensor_response"},
                parameters=numbers(ymax=ymax, ymin=ymin),
            ),
            add("structures", f"{name}_structure", outputs=[promoter]),
        ]
    kinds = ("ribozyme", "rbs", "cds", "terminator")
    parts = {part: kind for c in cassettes.values() for part, kind in zip(c, kinds, strict=True)}
    parts |= {f"p{repressor}": "promoter" for repressor, *_ in GATES.values()}
    parts |= {promoter: "promoter" for promoter, *_ in SENSORS.values()}
    return out + [add("parts", name, type=kind, dnasequence="") for name, kind in parts.items()]


@functools.cache
def wiring(library: str) -> Wiring:
    """XOR of the two signals, each half on in the middle of the colony."""
    return Library.read(library).wiring(
        "0110",
        inputs={
            "left": Sensor("out.left", "LeftR_sensor", half=MIDDLE, power=4.0),
            "low": Sensor("out.low", "LowR_sensor", half=MIDDLE, power=4.0),
        },
        output="yfp",
        loss=3.0,  # tagged for degradation: half-lives of a quarter of an hour
    )


def signal(axis: str) -> tf.Signal:
    """A signal that enters at the lower face of an axis and decays on its way."""
    faces = {axis: (tf.Dirichlet(1.0), tf.NoFlux())}
    return tf.Signal(
        diffusion=10 * REACH**2,
        decay=10.0,
        initial=lambda places: torch.exp(-(places[:, "xy".index(axis)] + SIDE) / REACH),
        boundary=tf.BoundaryConditions(**faces),
    )


def checkerboard(library: str = "library.json", **gates: str) -> tf.Scene:
    """Returns a colony in two crossing gradients. gates: a name for each place of the wiring."""
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        wiring(library).circuit(gates, rtol=1e-2),
        tf.Medium(
            left=signal("x"), low=signal("y"), box=((-SIDE, -SIDE), (SIDE, SIDE)), spacing=2.0
        ),
        name="checkerboard",
    )


PIXELS = 16
MASK = [[float((r < PIXELS / 2) == (c < PIXELS / 2)) for c in range(PIXELS)] for r in range(PIXELS)]
TARGET = Image("yfp", MASK, (2 * SIDE, 2 * SIDE), floor=0.2)
COLONY = {"cells": 300, "dt": 0.05}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--colonies", type=whole, default=1000, help="number to simulate")
    parser.add_argument(
        "--out",
        type=out_stem,
        default="real_parts",
        help="path of the files to write, without suffix",
    )
    options = parser.parse_args()
    tf.keep_memory()
    library = options.out.with_suffix(".UCF.json").resolve()
    library.write_text(json.dumps(made_up_library(), indent=1))
    design = wiring(str(library))
    search = Search(
        checkerboard,
        design.parameters,
        TARGET,
        **COLONY,
        fixed={"library": str(library)},
        method=CMAES(population=24),
        replicates=2,
    )
    best = search.run(options.colonies, study=options.out.with_suffix(".h5"))
    print(best.table())
    print(design.levels(best.values))
    print(design.parts(best.values))
    print(
        best.save(options.out.with_suffix(".json")),
        best.plot().save(options.out.with_suffix(".png")),
    )


if __name__ == "__main__":
    main()
