"""The whole way, from a segmented time-lapse to a designed pattern, in about a minute on one core.

    python experiments/whole_way.py
    python experiments/whole_way.py --masks my_masks.tif --pixel-size 0.065 --frame-hours 0.25

1. Label masks of a time-lapse. Without --masks the script makes them: it grows a colony of a hidden
   growth rate, and writes its masks as a segmentation program would.
2. Two frames, --frames, become cells. A search fits the growth rate: colonies that start from the
   cells of the first frame should look like the cells of the second.
3. A gene circuit, written in Antimony, joins the cells of the first frame, which grow at the fitted
   rate. It lights cells between two thresholds of a morphogen. A second search places the
   thresholds so that a stripe appears.
4. The best design is run once more. It is written as a pandas table, for ParaView, and as synthetic
   fluorescence.

All files are in the folder --out; whole_way.png shows the colonies. Look at masks.png too: the
cells that were read, drawn over the masks. Requires
pip install -e ".[app,design,images,tables,sbml]".
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from arguments import at_least, out_folder, positive
from matplotlib.figure import Figure

import torchfilm as tf
from design import Bands, Best, Observed, Parameter, Search

PIXEL, FRAME_HOURS = 0.065, 0.5  # µm a pixel, and h between frames
STEP = 0.05  # h
HIDDEN = {"rate": 1.15, "division": 3.4}  # 1/h and µm, to be found by the fit
STRIPE = (-4.0, 4.0)  # µm along x: where cells should be lit
SIDE, REACH = 40.0, 10.0  # µm: half the box; over which the morphogen falls to 1/e
CIRCUIT = """
model band_detector
  compartment cell = 1, outside = 1000;
  species gfp in cell, morphogen in outside;
  making: -> gfp; cell*strength * morphogen^n/(low^n + morphogen^n) * high^n/(high^n + morphogen^n);
  losing: gfp -> ; cell*loss*gfp;
  gfp = 0; morphogen = 0;
  strength = 20; loss = 3; n = 4; low = 0.01; high = 0.02;
end
"""


def colony(masks=None, frame=0, pixel_size=PIXEL, rate=1.0, division=4.0) -> tf.Scene:
    """A colony from the cells of one frame of the masks; without masks, from one cell."""
    founders = None
    if masks is not None:
        cells = tf.Cells.from_masks(masks, frame=frame, pixel_size=pixel_size, centre=True)
        founders = cells.relaxed()
    return tf.Scene(
        tf.Growth(rate=tf.LogNormal(rate, 0.1)),  # 1/h, drawn for each cell
        tf.Division(length=tf.LogNormal(division, 0.1)),  # µm
        tf.Mechanics(dim=2),
        founders=founders,
        dt=STEP,
    )


def stripe(masks, frame, pixel_size, rate, division, low=0.01, high=0.02) -> tf.Scene:
    """The fitted colony with the circuit, in a morphogen that enters at the left and decays."""
    fitted = colony(masks, frame, pixel_size, rate, division)
    steady = lambda places: torch.exp(-(places[:, 0] + SIDE) / REACH)
    return fitted.replace(
        *fitted.effects,
        tf.Circuit.from_antimony(CIRCUIT, signals=["morphogen"], low=low, high=high, rtol=1e-2),
        tf.Medium(
            morphogen=tf.Signal(diffusion=10 * REACH**2, decay=10.0, initial=steady),
            box=((-SIDE, -SIDE), (SIDE, SIDE)),
            spacing=4.0,
            boundary=tf.BoundaryConditions(x=(tf.Dirichlet(1.0), tf.NoFlux())),
        ),
    )


def make_masks(path: Path, frames: int, frame_hours: float, pixel_size: float) -> None:
    """Writes the masks of a colony of the hidden parameters, a page for each frame."""
    scene, run = colony(**HIDDEN), path.with_name("hidden.h5")
    recorder = tf.Recorder(run, scene, every=round(frame_hours / scene.dt), overwrite=True)
    for _ in tf.simulate(scene, until=frames * frame_hours, seed=2026, record=recorder):
        pass
    with tf.Results(run) as results:
        results.to_labels(path, pixel_size=pixel_size, overwrite=True)


def fit(masks: dict, seen: tf.Cells, hours: float, colonies: int) -> Best:
    """The growth rate and the division length by which the first cells become those seen."""
    observed = Observed.from_table(seen.table(), time=hours)
    search = Search(
        colony,
        [Parameter("rate", 0.5, 2.0, log=True), Parameter("division", 2.5, 5.0)],
        observed,
        fixed=masks,
        until=hours,
        replicates=2,
    )
    return search.run(colonies)


def design(masks: dict, fitted: Best, hours: float, colonies: int) -> Best:
    """The thresholds of the circuit that light the stripe in the fitted colony."""
    search = Search(
        stripe,
        [Parameter("low", 1e-3, 1.0, log=True), Parameter("high", 1e-3, 1.0, log=True)],
        Bands(("gfp",), STRIPE, floor=0.2),
        fixed={**masks, **fitted.values},
        until=hours,
        replicates=2,
    )
    return search.run(colonies)


def write_results(out: Path, best: Best, hours: float) -> list[Path]:
    """Runs the best design once more, and writes it for other programs. Returns the new files."""
    scene, run = best.scene(), out / "run.h5"
    for _ in tf.simulate(scene, until=hours, record=tf.Recorder(run, scene, overwrite=True)):
        pass
    table = out / "cells.csv"
    with tf.Results(run) as results:
        results.to_pandas().to_csv(table, index=False)
        surfaces = results.to_vtkhdf(out / "cells.vtkhdf", overwrite=True)
        image = results.to_ome_tiff(
            out / "fluorescence.ome.tif", pixel_size=PIXEL, channels={"gfp": 100.0},
            blur=0.15, background=20.0, noise=3.0, overwrite=True,
        )  # fmt: skip
    return [run, table, *surfaces, image]


def draw(path: Path, cells: list[tf.Cells], fitted: Best, best: Best) -> None:
    """The cells that were read, the fitted colony beside the observed one, and the pattern."""
    frames = [tf.pictures.frame_of(d.colonies()[0].state).colony(0) for d in (fitted, best)]
    as_frame = lambda c: {n: getattr(c, n) for n in ("position", "axis", "length", "radius")}
    panels = [
        (f"first frame: {cells[0].count} cells", as_frame(cells[0]), None),
        (f"last frame: {cells[1].count} cells", as_frame(cells[1]), None),
        (f"fitted: {len(frames[0]['length'])} cells", frames[0], None),
        ("designed stripe", frames[1], "gfp"),
    ]
    far = 3.0 + max(abs(drawn["position"]).max() for _, drawn, _ in panels)
    figure = Figure(figsize=(9.6, 2.9), dpi=150)
    for k, (title, drawn, colour) in enumerate(panels):
        ax = figure.add_axes((0.01 + 0.25 * k, 0.2, 0.23, 0.7))
        scales = tf.pictures.draw_cells(ax, drawn, colour=colour, window=(-far, far, -far, far))
        tf.pictures.colour_bar(figure.add_axes((0.06 + 0.25 * k, 0.1, 0.13, 0.03)), scales[0])
        tf.pictures.scale_bar(ax)
        ax.set_title(title, fontsize=9)
    figure.savefig(path)


def read(masks: Path, frame: int, pixel_size: float) -> tf.Cells:
    """The cells of one frame of the masks. Ends the program where they cannot be read."""
    try:
        return tf.Cells.from_masks(masks, frame=frame, pixel_size=pixel_size, centre=True)
    except tf.InputError as error:
        raise SystemExit(
            f"whole_way.py: {error} The fit needs two frames of the masks (--masks): say which by"
            " --frames FIRST LAST."
        ) from None


class Help(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """The text above as it is, and the defaults."""


def chosen() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=Help)
    parser.add_argument(
        "--masks",
        type=Path,
        default=argparse.SUPPRESS,
        help="your label images, a stack (default: made here)",
    )
    parser.add_argument("--pixel-size", type=positive, default=PIXEL, help="µm a pixel")
    parser.add_argument(
        "--frame-hours", type=positive, default=FRAME_HOURS, help="h between frames"
    )
    parser.add_argument("--frames", type=int, nargs=2, default=(5, 9), help="of the fit, from 0")
    parser.add_argument(
        "--colonies", type=at_least(2), default=480, help="of the fit; half as many of the design"
    )
    parser.add_argument("--out", type=out_folder, default="runs/whole_way", help="folder of files")
    options = parser.parse_args(namespace=argparse.Namespace(masks=None))
    if not 0 <= options.frames[0] < options.frames[1]:
        parser.error("--frames: give the earlier frame first, both counted from 0.")
    # of masks that are made here, each frame is at the end of a step
    frames = 1 if options.masks is None else options.frames[1] - options.frames[0]
    steps = frames * options.frame_hours / STEP
    if round(steps) < 1 or not math.isclose(steps, round(steps), rel_tol=1e-6):
        parser.error(
            f"--frame-hours: {frames} × {options.frame_hours:g} h is no whole number of steps of"
            f" {STEP:g} h. Give such as {max(1, round(steps)) * STEP / frames:.6g}."
        )
    return options


def main() -> None:
    options = chosen()
    out, (first, last) = options.out, options.frames
    tf.keep_memory()
    masks = options.masks or out / "masks.tif"
    if options.masks is None:
        make_masks(masks, last, options.frame_hours, options.pixel_size)
    cells = [read(masks, k, options.pixel_size) for k in (first, last)]
    hours = (last - first) * options.frame_hours
    for k, found in zip((first, last), cells, strict=True):
        print(f"frame {k}\n{found.summary()}\n")
    print(tf.pictures.overlay(cells[1], masks, frame=last).save(out / "masks.png"))

    given = {"masks": str(masks.resolve()), "frame": first, "pixel_size": options.pixel_size}
    fitted = fit(given, cells[1], hours, options.colonies)
    print(fitted.table())
    truth = "" if options.masks else f" (hidden: {HIDDEN['rate']:g})"
    print(f"growth rate {fitted.values['rate']:.3f} /h{truth}, loss {fitted.loss:.3g}\n")

    best = design(given, fitted, hours, options.colonies // 2)
    print(best.table())
    files = [fitted.save(out / "fit.json"), best.save(out / "stripe.json")]
    files += write_results(out, best, hours)
    draw(out / "whole_way.png", cells, fitted, best)
    print("written:", *files, out / "whole_way.png", sep="\n  ")


if __name__ == "__main__":
    main()
