"""Whether posteriors cover the truth as often as they claim."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import torchfilm as tf
from design.posterior_plot import draw_ranks

ALL = "all together"  # the region of highest density of all parameters


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """The places of hidden truths among samples of their posteriors.

    names: of the D parameters; ranks: the number of samples below the truth, (T, D), from 0 to
    `samples`; density_ranks: the number of samples with a higher density than the truth, (T,).
    Where the posteriors are right, all ranks are equally frequent. failed: simulations of truths
    that failed, and are not among the T.
    """

    names: tuple[str, ...]
    ranks: np.ndarray
    density_ranks: np.ndarray
    samples: int
    failed: int = 0

    def coverage(self, level: float = 0.9) -> dict[str, float]:
        """The share of truths in the central interval of each parameter, and in the joint region
        of highest density ("all together"); `level` where the posteriors are right."""
        inside = self._covered(self.ranks, 0.5 - 0.5 * level, 0.5 + 0.5 * level)
        joint = self._covered(self.density_ranks, 0.0, level)
        return {n: float(v) for n, v in zip(self.names, inside.mean(0), strict=True)} | {
            ALL: float(joint.mean())
        }

    def _covered(self, ranks: np.ndarray, low: float, high: float) -> np.ndarray:
        """What part of the shares of samples that each rank stands for lies between two shares:
        that of all ranks is high − low, whatever the number of samples."""
        count = self.samples + 1
        part = np.minimum(ranks + 1, high * count) - np.maximum(ranks, low * count)
        return np.asarray(np.clip(part, 0.0, 1.0))

    def table(self, level: float = 0.9) -> str:
        """The coverage in per cent, with its standard error where the posteriors are right."""
        count = len(self.ranks)
        error = 100 * np.sqrt(level * (1 - level) / count)
        lines = [
            f"{100 * level:g} % regions cover of {count} truths ({error:.1f} % standard error)"
        ]
        lines += [f"  {n:<16} {100 * v:.1f} %" for n, v in self.coverage(level).items()]
        if self.failed:
            lines.append(f"{self.failed} truths failed and are left out")
        return tf.displays.Text("\n".join(lines))

    def __repr__(self) -> str:
        return f"Calibration({len(self.ranks)} truths of {', '.join(self.names)})"

    def _repr_html_(self) -> str:
        return tf.displays.card("Calibration", tf.displays.text(self.table()))

    def plot(self, out: str | Path | None = None) -> tf.pictures.Picture:
        """Draw the histograms of ranks; `out` as for `Best.plot`. Needs matplotlib (the `app`
        extra)."""
        ranks = np.c_[self.ranks, self.density_ranks]
        return tf.pictures.Picture(draw_ranks((*self.names, ALL), ranks, self.samples), out)
