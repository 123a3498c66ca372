"""The target for what share of a colony each strain has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import FAILED, Target, ratio, total, weights
from torchfilm import checks


@dataclass(frozen=True)
class Composition(Target):
    """Strains have given shares of the colony: `Composition({0: 0.5, 1: 0.5}, within=0.1)`.

    shares: the wanted share of the volume of all cells, by cell type, or by the whole numbers of
    another `field`, such as a neutral label that daughters inherit. Together they are at most 1.
    within: how far a share may be off, above or below. Loss: the mean over these strains of d²,
    where d is how much farther off the share is, as part of how much it could be: 0 where all are
    within, 1 where all are as wrong as possible. `Lasting(…)` wants the shares to hold for a time.
    """

    failed = FAILED
    shares: Mapping[int, float]
    within: float = 0.0
    field: str = "cell_type"

    def __post_init__(self) -> None:
        if not isinstance(self.shares, Mapping) or not self.shares:
            rule = "a share by cell type, such as {0: 0.5, 1: 0.5}"
            raise checks.input_error("Composition.shares", self.shares, rule)
        wanted = {
            checks.integer("Composition.shares", k, least=0): checks.number(
                f"Composition.shares[{k}]", x, least=0.0, most=1.0
            )
            for k, x in self.shares.items()
        }
        if sum(wanted.values()) > 1.0 + 1e-6:
            hint = f"Their sum is {sum(wanted.values()):g}."
            raise checks.input_error("Composition.shares", wanted, "at most 1 together", hint)
        object.__setattr__(self, "shares", wanted)
        room = min(max(x, 1.0 - x) for x in wanted.values())
        checks.number("Composition.within", self.within, least=0.0)
        if self.within >= room:
            rule = f"below {room:g}, as far as a share can be off"
            raise checks.input_error("Composition.within", self.within, rule)
        if not isinstance(self.field, str) or not self.field.isidentifier():
            rule = "the name of a field of whole numbers"
            raise checks.input_error("Composition.field", self.field, rule)

    @property
    def strains(self) -> str:
        return self.field

    def check(self, state: tf.State) -> None:
        tf.measure.strains(state, self.field)  # raises where there is no such field

    def why_rough(self, state: tf.State) -> str:
        return "shares of strains go by types and volumes, which pass no gradient"

    def _found(self, state: tf.State) -> Tensor:
        """The share of each strain, (B, K); 0 in a colony without cells."""
        kind, w = state.fields[self.field], weights(state)
        own = torch.stack([torch.where(kind == k, w, 0.0) for k in self.shares], 1)
        return ratio(total(state, own), total(state, w).unsqueeze(1), 0.0)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        parts = []
        for found, wanted in zip(self._found(state).unbind(1), self.shares.values(), strict=True):
            most = max(wanted, 1.0 - wanted) - self.within
            parts.append((((found - wanted).abs() - self.within).clamp(min=0.0) / most) ** 2)
        # one after the other: the bits of a sum along rows may depend on their number
        loss = sum(parts[1:], parts[0]) / len(parts)
        return torch.where(state.counts > 0, loss, self.failed)

    @torch.no_grad()
    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """share_0, share_1, …: of the volume; lost: how many of the strains that should be there
        have no cells; (B,) each."""
        found = self._found(state)
        there = state.counts > 0
        wanted = torch.tensor([x > 0 for x in self.shares.values()], device=found.device)
        shares = {
            f"share_{k}": torch.where(there, x, math.nan)
            for k, x in zip(self.shares, found.unbind(1), strict=True)
        }
        return {**shares, "lost": (wanted & (found == 0)).sum(1).double()}

    def why_undefined(self, measure: str) -> str:
        return "the colony has no cells" if measure.startswith("share_") else ""

    def describe(self) -> str:
        off = f", ± {self.within:g}" if self.within else ""
        each = ", ".join(f"{self.field} {k}: {x:.3g}" for k, x in self.shares.items())
        return f"shares of strains ({each}{off})"
