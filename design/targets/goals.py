"""Several goals at once: sums of targets with weights, targets under constraints, goals side by
side for a front, and goals that are no patterns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import (
    WORST,
    Target,
    inner_targets,
    of_one_condition,
    ratio,
    require,
    requiring_gradients,
    species_names,
    total,
    valid_levels,
    weights,
)
from design.targets.several import Several, SumOfTargets
from torchfilm import checks

MANY = 1000.0  # a mean over fewer colonies or steps shows that one of them misses constraints


@dataclass(frozen=True)
class Burden(Target):
    """What a design costs its cells: the total concentration of some species, a mean over the
    volume of the colony. It has no upper limit.

    species: by default all species of all circuits.
    """

    differentiable = True
    species: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.species is not None:
            species_names("Burden.species", self.species)

    def _of(self, state: tf.State) -> tuple[str, ...]:
        if self.species is not None:
            return self.species
        return tuple(n for n, f in state.declared.items() if f.is_species)

    def check(self, state: tf.State) -> None:
        require(state, self._of(state))
        if not self._of(state):
            raise checks.input_error("Burden", "a scene without species", "a scene with a Circuit")

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        found, sound = valid_levels(state, self._of(state))
        amount = total(state, weights(state) * found.sum(1))
        return torch.where(sound, ratio(amount, total(state, weights(state)), 0.0), torch.nan)

    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        return {"burden": self.loss(state)}

    def why_undefined(self, measure: str) -> str:
        lost = "the colony has no cells, or levels that are not finite"
        return lost if measure == "burden" else ""

    def describe(self) -> str:
        return "little of " + (", ".join(self.species) if self.species else "all species")


@dataclass(frozen=True)
class Duration(Target):
    """The hours that a colony takes to its end: for scenes in which the design sets the pace."""

    differentiable = True

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        hours = float(state.time)
        return torch.full((state.colonies,), hours, dtype=torch.float64, device=state.device)

    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        return {"hours": self.loss(state)}

    def describe(self) -> str:
        return "soon"


@dataclass(frozen=True)
class Weighted(SumOfTargets):
    """The sum of the losses of several targets: `Weighted([(Stripe(…), 1.0), (Burden(), 0.1)])`.
    Weights are above 0."""

    terms: Sequence[tuple[Target, float]]
    parts: tuple[Target, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        terms = list(self.terms) if isinstance(self.terms, Sequence) else []
        if not terms or not all(
            isinstance(t, tuple) and len(t) == 2 and isinstance(t[0], Target) for t in terms
        ):
            raise checks.input_error(
                "Weighted.terms", self.terms, "pairs of a target and its weight, at least one"
            )
        for part, weight in terms:
            checks.number(f"Weighted: the weight of {type(part).__name__}", weight, above=0.0)
            of_colonies("Weighted", part)
            if constrained(part):
                raise checks.input_error(
                    "Weighted: a target",
                    part.describe(),
                    "without constraints",
                    "Put them around the sum: Constrained(Weighted([…]), […], at_least={…}).",
                )
        object.__setattr__(self, "terms", tuple(terms))
        object.__setattr__(self, "parts", tuple(part for part, _ in terms))

    @property
    def failed(self) -> float:  # type: ignore[override]
        return sum(weight * part.failed for part, weight in self.terms)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        found = self.losses(state, history).unbind(1)
        # one after the other: the bits of a product with a matrix may depend on the batch
        each = [loss * weight for loss, (_, weight) in zip(found, self.terms, strict=True)]
        return sum(each[1:], each[0])

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor | None:
        each = self.of_courses(state, history)
        if each is None:
            return None
        return torch.cat(
            [found * weight**0.5 for found, (_, weight) in zip(each, self.terms, strict=True)], 1
        )

    def describe(self) -> str:
        return " + ".join(f"{weight:g} × {part.describe()}" for part, weight in self.terms)


@dataclass(frozen=True)
class Constrained(Several):
    """A target under constraints on the measures of targets:
    `Constrained(Burden(), [Stripe(…)], at_least={"contrast": 10.0})`.

    Where they hold, the loss is that of the target. Where they do not, it is `BROKEN` and more, by
    how much a measure is missed: half of the way to `BROKEN` + 1 where it is missed by its whole
    bound. So every design that meets the constraints is better than every one that does not, as
    long as the loss of the target stays below `BROKEN`. more: targets that are only measured.
    """

    BROKEN = WORST

    target: Target
    more: Sequence[Target] = ()
    at_least: Mapping[str, float] = field(default_factory=dict)
    at_most: Mapping[str, float] = field(default_factory=dict)
    parts: tuple[Target, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.more, (list, tuple)):
            raise checks.input_error("Constrained.more", self.more, "a list of targets")
        parts = (self.target, *self.more)
        if not all(isinstance(part, Target) for part in parts):
            raise checks.input_error("Constrained", parts, "targets, such as Stripe(…)")
        for name in ("at_least", "at_most"):
            if not isinstance(getattr(self, name), Mapping):
                rule = 'bounds by measure, such as {"contrast": 10.0}'
                raise checks.input_error(f"Constrained.{name}", getattr(self, name), rule)
        for part in parts:
            of_colonies("Constrained", part)
        if not self.at_least and not self.at_most:
            raise checks.input_error(
                "Constrained",
                "no constraint",
                'at_least={…} or at_most={…}, such as at_least={"contrast": 10.0}',
            )
        for bounds in (self.at_least, self.at_most):
            for name, bound in bounds.items():
                checks.number(f"Constrained: the bound of {name!r}", bound)
        for name, least in self.at_least.items():
            if name in self.at_most and least > self.at_most[name]:
                raise checks.input_error(
                    "Constrained",
                    f"{name} ≥ {least:g} and ≤ {self.at_most[name]:g}",
                    "bounds that one design can meet",
                )
        object.__setattr__(self, "parts", parts)

    @property
    def failed(self) -> float:  # type: ignore[override]
        return max(self.BROKEN + 1.0, self.target.failed)

    def check(self, state: tf.State) -> None:
        super().check(state)
        each = self._measured(state)
        there = [name for found in each for name in found]
        for name in (*self.at_least, *self.at_most):
            if name not in there:
                raise checks.input_error(
                    "Constrained: measure", name, "one of " + ", ".join(map(repr, there))
                )
            owners = [p for p, found in zip(self.parts, each, strict=True) if name in found]
            if any(part != owners[0] for part in owners):
                raise checks.input_error(
                    "Constrained: measure",
                    name,
                    "a measure of one target",
                    "Several have it: " + "; ".join(part.describe() for part in owners) + ".",
                )

    def why_rough(self, state: tf.State) -> str:
        with torch.enable_grad():
            each = self._measured(requiring_gradients(state, self.names))
        found = {name: x for measures in each for name, x in measures.items()}
        lacking = [name for name in self.bounds if not found[name].requires_grad]
        why = f"constraints on {' and '.join(lacking)} have no derivatives"
        return why if lacking else super().why_rough(state)

    def _measured(self, state: tf.State) -> list[dict[str, Tensor]]:
        """Of a state alone: the measures of each part."""
        note = self.note(state)
        history = None if note is None else note.unsqueeze(0)
        return self.of_parts(lambda part, own: part.measures(state, own), state, history)

    def bounding(self, state: tf.State) -> list[Target]:
        """Those of its targets that have the measures of the constraints."""
        each = zip(self.parts, self._measured(state), strict=True)
        return [part for part, found in each if found.keys() & self.bounds.keys()]

    def missed(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """By how much the constraints are missed, (B,): the sum over all of the distance to the
        bound, as a share of it; 0 where they hold. An undefined measure misses by infinity."""
        found = self.measures(state, history)
        out = torch.zeros(state.colonies, dtype=torch.float64, device=state.device)
        for bounds, side in ((self.at_least, 1.0), (self.at_most, -1.0)):
            for name, bound in bounds.items():
                short = side * (bound - found[name].double()) / (abs(bound) or 1.0)
                out = out + torch.nan_to_num(short, nan=torch.inf).clamp(min=0.0)
        return out

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        own = self.of_parts(lambda part, own: part.loss(state, own).double(), state, history)[0]
        missed = self.missed(state, history)
        share = torch.where(missed.isinf(), 1.0, missed / (1.0 + missed))
        # a colony without a loss has failed, whatever it misses
        return torch.where((missed > 0) & ~own.isnan(), self.BROKEN + share, own)

    def remark(self, loss: np.ndarray) -> str:
        return _nearest(float(np.min(loss)) - self.BROKEN, self.bounds)

    @property
    def bounds(self) -> dict[str, str]:
        least = {n: f"≥ {x:g}" for n, x in self.at_least.items()}
        most = {n: f"≤ {x:g}" for n, x in self.at_most.items()}
        return {n: ", ".join(x[n] for x in (least, most) if n in x) for n in least | most}

    def describe(self) -> str:
        return f"{self.target.describe()}, with {in_words(self.bounds)}"


def constrained(target: Target) -> bool:
    """Whether a target has constraints, or one of its parts."""
    return isinstance(target, Constrained) or any(map(constrained, inner_targets(target)))


def _least_broken(target: Target) -> float:
    """The least loss of a colony that breaks the constraints of a target. Where it is to last, that
    is a mean over steps, of which the colony breaks them in some."""
    if not isinstance(target, Constrained | Spread):
        return Constrained.BROKEN / MANY
    inside = (_least_broken(part) for part in inner_targets(target) if constrained(part))
    return min([Constrained.BROKEN, *inside])


def in_words(bounds: Mapping[str, str]) -> str:
    """Constraints by measure, as `Target.bounds` has them."""
    return ", ".join(f"{name} {bound}" for name, bound in bounds.items())


def _nearest(share: float, bounds: Mapping[str, str]) -> str:
    """By how much the nearest design of a first batch misses its constraints; "" where one holds.
    share: of the way from `BROKEN` to `BROKEN` + 1."""
    if share < 0:
        return ""
    miss = f"{100 * share / (1 - share):.3g} %" if share < 1 else "infinity"
    return (
        f"no design of the first batch meets the constraints ({in_words(bounds)}); the nearest"
        f" misses them by {miss}"
    )


@dataclass(frozen=True)
class Spread(Several):
    """How much the loss of a target differs between the seeds of a design: their standard
    deviation. A goal for robust designs."""

    target: Target
    parts: tuple[Target, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.target, Target):
            raise checks.input_error("Spread", self.target, "a Target, such as Stripe(…)")
        of_colonies("Spread", self.target)
        object.__setattr__(self, "parts", (self.target,))

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        return self.losses(state, history)[:, 0]

    def reduced(self, losses: np.ndarray) -> np.ndarray | None:
        """Where a seed fails or breaks a constraint, the design has the worst of their losses:
        seeds that all do are alike, and no goal."""
        wide = losses.std(1, ddof=1) if losses.shape[1] > 1 else np.zeros(len(losses))
        own = constrained(self.target)
        least = _least_broken(self.target) if own else Constrained.BROKEN  # of another goal
        wide = np.where((losses >= least).any(1), losses.max(1), wide)
        return np.where((losses == self.failed).any(1), self.failed, wide)

    def describe(self) -> str:
        return f"the same on all seeds: {self.target.describe()}"


def of_seeds(target: Target) -> bool:
    """Whether a target is a statistic of several seeds, or has one among its parts."""
    return isinstance(target, Spread) or any(map(of_seeds, getattr(target, "parts", ())))


def of_colonies(name: str, part: Target) -> None:
    """Raises `tf.InputError` for a part whose loss is none of single colonies."""
    of_one_condition(name, part)
    if of_seeds(part):
        raise checks.input_error(
            f"{name}: a target",
            part.describe(),
            "a loss of single colonies",
            "Spread compares the seeds of a design: give it in targets=[…].",
        )


@dataclass(frozen=True)
class Goals(Several):
    """Targets side by side, for a front of designs that none exceeds in all. The loss is the sum
    of theirs.

    A colony that breaks the constraints of one of them has the loss of that in all: so every design
    that meets the constraints exceeds every one that does not.
    """

    parts: tuple[Target, ...]

    def __post_init__(self) -> None:
        parts = tuple(self.parts) if isinstance(self.parts, Sequence) else ()
        if not parts or not all(isinstance(part, Target) for part in parts):
            raise checks.input_error("targets", self.parts, "a list of targets")
        if len(parts) < 2:
            raise checks.input_error(
                "targets", self.parts, "two targets or more", "One goal has no front: give target=."
            )
        for part in parts:
            of_one_condition("targets", part)
        object.__setattr__(self, "parts", parts)

    @property
    def failed(self) -> float:  # type: ignore[override]
        # above the loss of a colony that breaks a constraint, which counts in all goals
        return len(self.parts) * max(part.failed for part in self.parts)

    @property
    def titles(self) -> tuple[str, ...]:
        """A short name of each goal, all different."""
        kinds = [type(part).__name__.lower() for part in self.parts]
        return tuple(
            kind if kinds.count(kind) == 1 else f"{kind} {1 + kinds[:k].count(kind)}"
            for k, kind in enumerate(kinds)
        )

    def losses(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        found = super().losses(state, history)
        some = [constrained(part) for part in self.parts]
        if not any(some):
            return found
        least = found.new_tensor([_least_broken(part) for part in self.parts])
        broken = torch.where(found < least, 0.0, found)[:, some]
        worst = broken.amax(1, keepdim=True)
        # broken in some steps counts as broken: the more, the larger the share of the steps
        share = Constrained.BROKEN + worst / Constrained.BROKEN
        counted = torch.where(worst < Constrained.BROKEN, share, worst)
        return torch.where(worst > 0, counted, found)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        return self.losses(state, history).sum(1)

    def remark(self, loss: np.ndarray) -> str:
        if not self.bounds:
            return ""
        share = float(np.min(loss)) / len(self.parts) - Constrained.BROKEN
        lasting = (
            _least_broken(part) < Constrained.BROKEN for part in self.parts if constrained(part)
        )
        if share >= 0 and any(lasting):
            words = in_words(self.bounds)
            return f"no design of the first batch meets the constraints ({words}) in all steps"
        return _nearest(share, self.bounds)

    def describe(self) -> str:
        return "; ".join(part.describe() for part in self.parts)
