"""A pattern that stays: any target, scored again and again while the colony grows."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import Target
from design.targets.goals import of_colonies
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Lasting(Target):
    """A target that holds from `since` (h) on: the loss is the mean of its losses after every step
    from then to the end, the end alone where that comes first.

    target: scored by the state alone. Measures are those of the end, and `worst`, (B,), the
    greatest loss on the way. Where the target has residuals, so has this: those of all steps that
    count. They are kept while derivatives are asked: 16 bytes for each number, step and copy of a
    colony.
    """

    target: Target
    _: KW_ONLY
    since: float

    def __post_init__(self) -> None:
        if not isinstance(self.target, Target) or isinstance(self.target, Lasting):
            raise checks.input_error("Lasting.target", self.target, "a target of one state")
        of_colonies("Lasting", self.target)
        checks.number("Lasting.since", self.since, least=0.0)

    @property
    def names(self) -> tuple[str, ...]:
        return self.target.names

    @property
    def failed(self) -> float:  # type: ignore[override]
        return self.target.failed

    @property
    def fewest(self) -> int:  # type: ignore[override]
        return self.target.fewest

    def check(self, state: tf.State) -> None:
        self.target.check(state)
        if self.target.note(state) is not None:
            what = f"{type(self.target).__name__}, which has a history of its own"
            raise checks.input_error("Lasting.target", what, "a target of one state")

    def why_rough(self, state: tf.State) -> str:
        return self.target.why_rough(state)

    def unfit(self, state: tf.State) -> list[str]:
        return self.target.unfit(state)

    def note(self, state: tf.State) -> Tensor:
        """The loss, (B, 1) float64; NaN before `since`."""
        if state.time < self.since - 1e-9:
            return torch.full(
                (state.colonies, 1), torch.nan, dtype=torch.float64, device=state.device
            )
        return self.target.loss(state).unsqueeze(1)

    def course(self, state: tf.State) -> Tensor:
        """The loss and, from `since` on, the residuals of the target, (B, 1 + K)."""
        noted = self.note(state)
        if state.time < self.since - 1e-9:
            return noted
        found = self.target.residuals(state)
        return noted if found is None else torch.cat([noted, found], 1)

    def kept(self, state: tf.State) -> float:
        found = self.target.residuals(state)
        return 0.0 if found is None else found.shape[1] / int(state.counts.max())

    @property
    def squares(self) -> bool:
        return self.target.squares

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor | None:
        """Those of the target at all steps that count, over the root of their number, (B, T · K);
        None where the history is of `note` alone."""
        end = self.target.residuals(state)
        if end is None or history is None or history.isnan().all():
            return end
        if history.shape[2] == 1:
            return None
        counted = ~history[:, :, 0].isnan()
        steps = counted.sum(0)
        share = steps.clamp(min=1).double().rsqrt()
        kept = counted.any(1)
        found = torch.where(counted[kept].unsqueeze(2), history[kept][:, :, 1:], 0.0)
        found = (found * share.unsqueeze(1)).transpose(0, 1).flatten(1)
        return torch.cat([torch.where((steps == 0).unsqueeze(1), end, 0.0), found], 1)

    def _losses(self, state: tf.State, history: Tensor | None) -> Tensor:
        """Those that count, (T, B), NaN before `since` and after a colony's end."""
        end = self.target.loss(state).unsqueeze(0)
        if history is None or history.isnan().all():
            return end
        found = history[:, :, 0]
        return torch.where(found.isnan().all(0), end, found)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        found = self._losses(state, history)
        counted = ~found.isnan()
        # one after the other: a sum along the first axis may depend on the batch
        kept = torch.where(counted, found, 0.0).unbind(0)
        return sum(kept, torch.zeros_like(kept[0])) / counted.sum(0)

    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        worst = self._losses(state, history).nan_to_num(-torch.inf).amax(0)
        return {**self.target.measures(state), "worst": worst.detach()}

    @property
    def pattern(self) -> bool:  # type: ignore[override]
        return self.target.pattern

    @property
    def anywhere(self) -> bool:  # type: ignore[override]
        return self.target.anywhere

    @property
    def strains(self) -> str | None:
        return self.target.strains

    @property
    def lit_from(self) -> dict[str, float]:
        return self.target.lit_from

    @property
    def bounds(self) -> dict[str, str]:
        return self.target.bounds

    @property
    def evidence(self) -> dict[str, tuple[float, float]]:
        return self.target.evidence

    def remark(self, loss: np.ndarray) -> str:
        return self.target.remark(loss)

    @property
    def mark(self) -> str:
        return self.target.mark

    def why_undefined(self, measure: str) -> str:
        return self.target.why_undefined(measure)

    def reaches(self, state: tf.State) -> Tensor:
        return self.target.reaches(state)

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        self.target.draw(ax, state, place)

    def describe(self) -> str:
        return f"{self.target.describe()}, from {self.since:g} h on"
