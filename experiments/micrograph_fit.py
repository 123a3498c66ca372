"""How exact cells from label images are: capsules of known size, in pixels and back.

    OMP_NUM_THREADS=1 python experiments/micrograph_fit.py
    OMP_NUM_THREADS=1 python experiments/micrograph_fit.py --count 20 --picture runs/fit.png

Prints the table of docs/micrographs.md: root mean square errors by the radius in pixels, of
`Cells.from_masks` and of taking the axes of the ellipse with the same moments as length and width.
Then draws the picture of that page: a simulated colony as a noisy micrograph, and over it the cells
of a table that has errors.
"""

from __future__ import annotations

import argparse
import math
import warnings
from pathlib import Path

import numpy as np
from arguments import out_file, whole
from scipy.ndimage import gaussian_filter
from skimage.measure import regionprops_table

import torchfilm as tf

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "micrograph.png"
RADII = ((2, 3), (3, 5), (5, 8), (8, 12))
PIXEL = 0.065  # µm


def label_image(x, y, angle, length, radius, shape) -> np.ndarray:
    """Capsules in pixels; a pixel belongs to the last one that has its centre. x: columns; y: rows;
    angle: from +x towards the rows. Labels count from 1."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    mask = np.zeros(shape, dtype=np.uint16)
    for k in range(len(x)):
        dx, dy = columns - x[k], rows - y[k]
        cos, sin = math.cos(angle[k]), math.sin(angle[k])
        s = np.clip(dx * cos + dy * sin, -length[k] / 2, length[k] / 2)
        mask[np.hypot(dx - s * cos, dy - s * sin) <= radius[k]] = k + 1
    return mask


def errors(low: float, high: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 6): place, angle (degrees), length, radius; then length and radius by the ellipse."""
    found = []
    for _ in range(count):
        radius, angle = rng.uniform(low, high), rng.uniform(0, math.pi)
        length = rng.uniform(0.5, 8) * radius
        side = int(length + 2 * radius + 12)
        x, y = side / 2 + rng.uniform(-0.5, 0.5, 2)
        mask = label_image([x], [y], [angle], [length], [radius], (side, side))
        cell = tf.Cells.from_masks(mask, pixel_size=1.0, least_area=4)
        across = cell.axis[0] @ (math.sin(angle), math.cos(angle))
        names = ("axis_major_length", "axis_minor_length")
        ellipse = regionprops_table(mask, properties=names)
        major, minor = (float(ellipse[name][0]) for name in names)
        found.append(
            (
                math.hypot(cell.position[0, 0] - x, cell.position[0, 1] + y),
                math.degrees(math.asin(min(1.0, abs(across)))),
                cell.length[0] - length,
                cell.radius[0] - radius,
                major - minor - length,
                0.5 * minor - radius,
            )
        )
    return np.array(found)


def table(count: int) -> None:
    rng = np.random.default_rng(0)
    print("| radius | place | angle | length | radius | length by the ellipse | radius by it |")
    print("|---|---|---|---|---|---|---|")
    for low, high in RADII:
        with warnings.catch_warnings():
            # tiny capsules are far from smooth; sizes are in pixels, not in µm
            warnings.filterwarnings("ignore", message=".*not shaped like a straight capsule")
            warnings.filterwarnings("ignore", message=".*µm wide \\(median\\)")
            rms = np.sqrt((errors(low, high, count, rng) ** 2).mean(0))
        place, angle, *sizes = rms
        print(
            f"| {low} to {high} | {place:.2f} | {angle:.1f}° | "
            + " | ".join(f"{size:.2f}" for size in sizes)
            + " |"
        )


def picture(path: Path) -> None:
    state = tf.simulate(tf.scenes.microcolony(), cells=60).last()
    position = state.position.numpy() / PIXEL
    x, y = (position - position.min(0) + 32).T
    shape = (int(y.max()) + 32, int(x.max()) + 32)
    angle = np.arctan2(*state.axis.numpy().T[::-1])
    length, radius = state.length.numpy() / PIXEL, state.radius.numpy() / PIXEL
    masks = label_image(x, y, angle, length, radius, shape)
    noise = np.random.default_rng(0).normal(0, 20, shape)
    phase = gaussian_filter(np.where(masks > 0, 60.0, 160.0) + noise, 1.2)
    print(tf.Cells.from_masks(masks, pixel_size=PIXEL).summary())
    # a table with errors, as a program may give it, so that some cells overlap
    rng = np.random.default_rng(1)
    columns = {
        "x": x,
        "y": y,
        "angle_rad": angle + rng.normal(0, 0.05, len(x)),
        "length": length + rng.normal(0, 1.5, len(x)),
        "label": np.arange(1, len(x) + 1),
    }
    cells = tf.Cells.from_table(columns, pixel_size=PIXEL, y="down", radius=0.5)
    tf.pictures.overlay(cells, phase, path, depth=0.05, dpi=130)
    print(cells.relaxed().summary())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=whole, default=400, help="capsules for each row")
    parser.add_argument("--picture", type=out_file, default=PICTURE)
    options = parser.parse_args()
    table(options.count)
    picture(options.picture)


if __name__ == "__main__":
    main()
