"""The band of Fig. 5: its place, width and strength, and the effects of AiiA and flow.

    python experiments/boundary_band.py     # 8 seeds of 5,000 cells in 8 conditions
    python experiments/boundary_band.py --cells 500 --seeds 2

The full run takes four minutes on two shared cores. Each condition is one batch of colonies. The
border of a colony is the place along the channel with the fewest cells on the wrong side. The sink
cells are binned into strips by their distance from the border. The profile of mean YFP over these
strips gives the band's peak, its place, its full width at half maximum and the middle of that. The
contrast is the peak over the mean of sinks farther than 40 µm from the border.
"""

from __future__ import annotations

import argparse
import json
import re
import time

import numpy as np
import torch
from arguments import at_least, out_file, out_folder, whole

import torchfilm as tf

STRIP = 4.0  # µm
FAR = 40.0  # µm
LEAST = 50  # cells, for a strip with enough of them in every colony
CONDITIONS = {
    "as published": {},
    "no AiiA": {"d3": 0.0},
    "10 × AiiA": {"d3": 1e-2},
    "100 × AiiA": {"d3": 1e-1},
    "1000 × AiiA": {"d3": 1.0},
    "10000 × AiiA": {"d3": 10.0},
    "flow 2 µm/h": {"flow": 2.0},
    "flow 10 µm/h": {"flow": 10.0},
}


def border(x: np.ndarray, sink: np.ndarray) -> float:
    """Returns the place along the channel with the fewest cells on the wrong side, µm.

    Sinks before it and sources after it are on the wrong side.
    """
    order = np.argsort(x)
    sinks = sink[order]
    wrong = np.cumsum(sinks) + (~sinks).sum() - np.cumsum(~sinks)
    return float(x[order][np.argmin(wrong)])


def band(state: tf.State, place: int) -> dict[str, float | None]:
    """Returns the measures of the band of one colony of the batch; None for the contrast, or for
    CFP, where it has no cells of that kind beyond FAR."""
    cells = state.colony == place
    x, yfp = state.position[cells, 0].numpy(), state.yfp[cells].double().numpy()
    cfp, sink = state.cfp[cells].double().numpy(), (state.cell_type[cells] == 1).numpy()
    at = x - border(x, sink)
    strip = np.floor(at[sink] / STRIP).astype(int)
    low = strip.min()
    count = np.bincount(strip - low)
    profile = np.bincount(strip - low, weights=yfp[sink]) / np.maximum(count, 1)
    centres = (np.arange(len(count)) + low + 0.5) * STRIP
    kept = count >= 5
    profile, centres = profile[kept], centres[kept]
    top = int(np.argmax(profile))
    high = profile >= 0.5 * profile[top]
    left, right = top, top
    while left > 0 and high[left - 1]:
        left -= 1
    while right < len(high) - 1 and high[right + 1]:
        right += 1
    inside, sources = at[sink] > FAR, at[~sink] < -FAR
    return {
        "cells": float(cells.sum()),
        "place_um": float(centres[top]),
        "middle_um": float(0.5 * (centres[left] + centres[right])),
        "width_um": float(centres[right] - centres[left] + STRIP),
        "peak": float(profile[top]),
        "contrast": float(profile[top] / yfp[sink][inside].mean()) if inside.any() else None,
        "cfp_inside": float(cfp[~sink][sources].mean()) if sources.any() else None,
    }


def shown(values: list[float | None]) -> str:
    """Returns mean and spread over the colonies that have the measure."""
    known = [v for v in values if v is not None]
    return f"{np.mean(known):.4g} ± {np.std(known):.2g}" if known else "none"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=at_least(LEAST), default=5000, help="in each colony")
    parser.add_argument("--seeds", type=whole, default=8, help="colonies in each condition")
    parser.add_argument("--only", nargs="*", choices=list(CONDITIONS), default=list(CONDITIONS))
    parser.add_argument("--out", type=out_file, default="boundary_band.json")
    parser.add_argument(
        "--record", type=out_folder, help="folder for results files, one per condition"
    )
    options = parser.parse_args()
    tf.keep_memory()
    found = json.loads(options.out.read_text()) if options.out.exists() else {}
    print(
        f"{'condition':<14} {'cells':>6} {'place µm':>14} {'middle µm':>14} {'width µm':>14}"
        f" {'YFP peak':>20} {'contrast':>16} {'seconds':>8}"
    )
    for name in options.only:
        scene = tf.scenes.boundary_detector(**CONDITIONS[name])
        record = (
            None
            if options.record is None
            else tf.Recorder(
                options.record / (re.sub(r"\W+", "_", name) + ".h5"),
                scene,
                every=40,
                overwrite=True,
            )
        )
        start = time.perf_counter()
        given = {"colonies": options.seeds, "seed": 0, "cells": options.cells}
        state = tf.simulate(scene, **given, record=record).last()
        bands = [band(state, k) for k in range(options.seeds)]
        row = {key: [b[key] for b in bands] for key in bands[0]}
        found[name] = row | {"seconds": time.perf_counter() - start, "time_h": state.time}
        options.out.write_text(json.dumps(found, indent=1))
        columns = [
            f"{shown(row[key]):>{size}}"
            for key, size in (
                ("place_um", 14),
                ("middle_um", 14),
                ("width_um", 14),
                ("peak", 20),
                ("contrast", 16),
            )
        ]
        print(
            f"{name:<14} {np.mean(row['cells']):6.0f} {' '.join(columns)}"
            f" {found[name]['seconds']:8.1f}",
            flush=True,
        )
        few = row["contrast"].count(None)
        if few:
            print(
                f"  {few} of {options.seeds} colonies have no contrast: they are too small for"
                f" sinks farther than {FAR:g} µm from the border; give more --cells"
            )


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
