"""One design under several conditions, such as amounts of an inducer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import Target
from design.targets.goals import of_colonies
from design.targets.observed import Observed
from design.targets.observed_course import ending_at
from design.targets.observed_measures import as_data
from design.targets.several import SumOfTargets, observed_at
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes


OF_NUMBERS = (
    "The scene function gets one number per colony, and makes of it what it stands for, such as a"
    " value of a schedule, tf.Schedule({0: early, 2: late})."
)


@dataclass(frozen=True)
class Conditions(SumOfTargets):
    """A design that does something else under each of several conditions, such as a gate:

        Conditions([({"iptg": 0.0}, dark), ({"iptg": 1.0}, lit)])

    terms: pairs of arguments of the scene function, numbers by name, and the target under these.
    Each replicate of a design is one colony under each condition, all with the same random numbers.
    All go on until the last time of any data; each is compared at the times of its own. Its loss is
    the mean of theirs; of data, that over all readings: the data of a condition weigh as much as
    they are many. A replicate fails where one of its colonies does. Measures bear the name of their
    condition. It has residuals and exact derivatives where its targets have. It stands outermost:
    other targets may be in it, and it in none.
    """

    terms: Sequence[tuple[Mapping[str, float], Target]]
    parts: tuple[Target, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        terms = list(self.terms) if isinstance(self.terms, Sequence) else []
        if len(terms) < 2 or not all(
            isinstance(t, tuple | list) and len(t) == 2 and isinstance(t[1], Target) for t in terms
        ):
            rule = "pairs of arguments of the scene and a target, two at least"
            hint = 'Such as Conditions([({"iptg": 0.0}, dark), ({"iptg": 1.0}, lit)]).'
            raise checks.input_error("Conditions.terms", self.terms, rule, hint)
        names = tuple(terms[0][0]) if isinstance(terms[0][0], Mapping) else ()
        for k, (given, part) in enumerate(terms):
            if not isinstance(given, Mapping) or not given:
                raise checks.input_error(f"Conditions.terms[{k}]", given, "numbers by name")
            if set(given) != set(names):
                here, first = (", ".join(map(repr, sorted(x))) for x in (given, names))
                raise tf.InputError(
                    f"Conditions.terms[{k}] names {here}, and Conditions.terms[0] names {first}:"
                    " each condition must name the same arguments of the scene."
                )
            for name, value in given.items():
                checks.number(f"Conditions.terms[{k}]: {name}", value, hint=OF_NUMBERS)
            of_colonies("Conditions", part)
        found = [tuple(float(given[n]) for n in names) for given, _ in terms]
        if len(set(found)) < len(found):
            rule = "conditions that differ"
            raise checks.input_error("Conditions.terms", [g for g, _ in terms], rule)
        object.__setattr__(self, "terms", tuple((dict(given), part) for given, part in terms))
        if len({self.label(k) for k in range(len(terms))}) < len(terms):
            rule = "conditions that differ in six digits, since measures bear their names"
            raise checks.input_error("Conditions.terms", [g for g, _ in terms], rule)
        object.__setattr__(self, "parts", _of_one_end([part for _, part in terms]))

    @property
    def arguments(self) -> tuple[Mapping[str, float], ...]:
        return tuple(given for given, _ in self.terms)

    @property
    def failed(self) -> float:  # type: ignore[override]
        return max(part.failed for part in self.parts)

    @property
    def first_time(self) -> float:
        return max(part.first_time for part in self.parts)

    def label(self, place: int) -> str:
        """A condition in words."""
        return ", ".join(f"{name} = {value:g}" for name, value in self.arguments[place].items())

    def condition_of(self, state: tf.State) -> Tensor:
        """The condition of each colony, (B,): those of a replicate stand side by side."""
        return state.colony_id % len(self.parts)

    def unfit(self, state: tf.State) -> list[str]:
        each = [part.unfit(state) for part in self.parts]
        return [each[own][k] for k, own in enumerate(self.condition_of(state).tolist())]

    @cached_property
    def _weights(self) -> tuple[float, ...]:
        """Of the losses of all conditions: 1 on average, and by how many readings there are."""
        data = [part for part in map(as_data, self.parts) if isinstance(part, Observed)]
        if len(data) < len(self.parts):
            return (1.0,) * len(self.parts)
        counts = [len(part.values) for part in data]
        return tuple(n * len(counts) / sum(counts) for n in counts)

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        mine = self.condition_of(state)
        found = self.losses(state, history).gather(1, mine.unsqueeze(1)).squeeze(1)
        weighted = (found * found.new_tensor(self._weights)[mine]).clamp(max=self.failed)
        return torch.where(found < self.failed, weighted, found)

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor | None:
        each = self.of_courses(state, history)
        if each is None:
            return None
        mine = self.condition_of(state).unsqueeze(1)
        roots = [math.sqrt(weight) for weight in self._weights]
        return torch.cat([roots[k] * x.where(mine == k, 0.0) for k, x in enumerate(each)], 1)

    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        each = self.of_parts(lambda part, own: part.measures(state, own), state, history)
        return {self._named(n, k): x for k, part in enumerate(each) for n, x in part.items()}

    def concerns(self, measure: str, state: tf.State) -> Tensor:
        return self.condition_of(state) == self._of(measure)[1]

    def _named(self, name: str, place: int) -> str:
        return f"{name} ({self.label(place)})"

    def _of(self, measure: str) -> tuple[str, int]:
        """The name of a measure, and of which condition it is."""
        for k in range(len(self.parts)):
            end = self._named("", k)
            if measure.endswith(end):
                return measure.removesuffix(end), k
        return measure, 0

    @property
    def bounds(self) -> dict[str, str]:
        each = enumerate(part.bounds for part in self.parts)
        return {self._named(n, k): b for k, bounds in each for n, b in bounds.items()}

    def misses(self, found: Mapping[str, float]) -> dict[str, float]:
        out: dict[str, float] = {}
        own = {self._of(name): x for name, x in found.items()}
        for k, part in enumerate(self.parts):
            mine = {name: x for (name, place), x in own.items() if place == k}
            out |= {self._named(n, k): by for n, by in part.misses(mine).items()}
        return out

    @property
    def evidence(self) -> dict[str, tuple[float, float]]:
        each = enumerate(part.evidence for part in self.parts)
        return {self._named(n, k): seen for k, found in each for n, seen in found.items()}

    def why_undefined(self, measure: str) -> str:
        name, place = self._of(measure)
        return self.parts[place].why_undefined(name)

    def reaches(self, state: tf.State) -> Tensor:
        each = torch.stack([part.reaches(state) for part in self.parts], 1)
        return each.gather(1, self.condition_of(state).unsqueeze(1)).squeeze(1)

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        each = self.of_parts(lambda part, own: (part, own), state, history)
        part, own = each[int(self.condition_of(state)[place])]
        part.draw(ax, state, place, own)

    def describe(self) -> str:
        each = enumerate(self.parts)
        return "; ".join(f"{part.describe()} where {self.label(k)}" for k, part in each)


def _of_one_end(parts: Sequence[Target]) -> tuple[Target, ...]:
    """The targets, with data that are compared at their times in colonies that all go on until the
    last of these."""
    times = [t for t in map(observed_at, parts) if t is not None]
    if len(set(times)) < 2:
        return tuple(parts)
    made = []
    for part in map(as_data, parts):
        if not isinstance(part, Observed) and observed_at(part) not in (None, max(times)):
            rule = f"of data alone, or of one time: others are observed until {max(times):g} h"
            raise checks.input_error("Conditions.terms", part, rule)
        made.append(ending_at(part, max(times)) if isinstance(part, Observed) else part)
    return tuple(made)
