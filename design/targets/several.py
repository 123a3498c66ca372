"""Targets that are made of others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

import torchfilm as tf
from design.targets.base import Target
from design.targets.measured import Measured
from design.targets.observed import Observed

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Several(Target):
    """The base class of targets that are made of others, `parts`: a colony must suit all."""

    parts: tuple[Target, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for part in self.parts for name in part.names))

    @property
    def fewest(self) -> int:  # type: ignore[override]
        return max(part.fewest for part in self.parts)

    @property
    def failed(self) -> float:  # type: ignore[override]
        return sum(part.failed for part in self.parts)

    @property
    def pattern(self) -> bool:  # type: ignore[override]
        return any(part.pattern and part.names for part in self.parts)

    @property
    def anywhere(self) -> bool:  # type: ignore[override]
        return all(part.anywhere for part in self.parts if part.names)

    @property
    def times(self) -> tuple[float, ...]:
        return tuple(sorted({time for part in self.parts for time in part.times}))

    def check(self, state: tf.State) -> None:
        for part in self.parts:
            part.check(state)
        seen = sorted(set(_times(self)))
        if len(seen) > 1:
            under = len(self.arguments) > 1
            cure = "give data of one time" if under else "put them together as ObservedCourse([…])"
            raise tf.InputError(
                f"{type(self).__name__} has data of {', '.join(f'{t:g}' for t in seen)} h, and"
                f" {'all colonies end' if under else 'a colony ends'} at one time: {cure}."
            )

    def why_rough(self, state: tf.State) -> str:
        return next(filter(None, (part.why_rough(state) for part in self.parts)), "")

    def unfit(self, state: tf.State) -> list[str]:
        return [
            next(filter(None, why), "")
            for why in zip(*(part.unfit(state) for part in self.parts), strict=True)
        ]

    def note(self, state: tf.State) -> Tensor | None:
        each = [part.note(state) for part in self.parts]
        found = [note for note in each if note is not None]
        if not self.ragged:
            return torch.cat(found, 1) if found else None
        widths = [0.0 if note is None else float(note.shape[1]) for note in each]
        return torch.cat([found[0].new_tensor(widths).expand(state.colonies, -1), *found], 1)

    @property
    def ragged(self) -> bool:  # type: ignore[override]
        return any(part.ragged for part in self.parts)

    def kept(self, state: tf.State) -> float:
        return sum(part.kept(state) for part in self.parts)

    def of_parts(
        self, of: Callable[[Target, Tensor | None], Any], state: tf.State, history: Tensor | None
    ) -> list[Any]:
        """Something of every part, with its own columns of the history."""
        if self.ragged and history is not None:
            each = zip(self.parts, self._split(history), strict=True)
            return [of(part, own) for part, own in each]
        out, at = [], 0
        for part in self.parts:
            note = part.note(state)
            size = 0 if note is None else note.shape[1]
            own = None if history is None or not size else history[..., at : at + size]
            out.append(of(part, own))
            at += size
        return out

    def _split(self, history: Tensor) -> list[Tensor | None]:
        """The notes of every part where their widths differ from step to step."""
        return [x if x.shape[2] else None for x in self.parted(history, 0)]

    def parted(self, history: Tensor, begin: int) -> list[Tensor]:
        """The columns of every part, 0 where a step had fewer, of a history in which a column for
        each part, from `begin` on, says how many of those that follow belong to it."""
        count = len(self.parts)
        told = tf.tangents.both(history[:, :, begin : begin + count])[0]
        # a colony that has ended has no number
        widths = told.nan_to_num().amax(1).long()
        start, widest = begin + count, widths.amax(0).tolist()
        steps = [
            row[:, start : start + sum(own)].split(own, 1)
            for row, own in zip(history, widths.tolist(), strict=True)
        ]
        return [
            torch.stack([torch.nn.functional.pad(s[k], (0, most - s[k].shape[1])) for s in steps])
            for k, most in enumerate(widest)
        ]

    def losses(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """The loss of every part, (B, parts)."""
        each = self.of_parts(lambda part, own: part.loss(state, own).double(), state, history)
        return torch.stack(each, 1)

    @property
    def mark(self) -> str:
        return "; ".join(dict.fromkeys(part.mark for part in self.parts if part.mark))

    @property
    def strains(self) -> str | None:
        return next((part.strains for part in self.parts if part.strains), None)

    @property
    def lit_from(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for name, level in (pair for part in self.parts for pair in part.lit_from.items()):
            found[name] = max(level, found.get(name, level))
        return found

    @property
    def bounds(self) -> dict[str, str]:
        return {name: bound for part in self.parts for name, bound in part.bounds.items()}

    def misses(self, found: Mapping[str, float]) -> dict[str, float]:
        return {n: by for part in self.parts for n, by in part.misses(found).items()}

    @property
    def evidence(self) -> dict[str, tuple[float, float]]:
        return {name: seen for part in self.parts for name, seen in part.evidence.items()}

    def why_undefined(self, measure: str) -> str:
        # of measures with one name, `measures` has that of the last part
        each = (part.why_undefined(measure) for part in reversed(self.parts))
        return next(filter(None, each), "")

    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        each = self.of_parts(lambda part, own: part.measures(state, own), state, history)
        return {name: value for part in each for name, value in part.items()}

    def reaches(self, state: tf.State) -> Tensor:
        return torch.stack([part.reaches(state) for part in self.parts]).any(0)

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        self.of_parts(lambda part, own: part.draw(ax, state, place, own), state, history)


def _times(target: Target) -> list[float]:
    """When the data of a target were observed at the end of a colony, h, those of all parts."""
    if isinstance(target, Several):
        return [time for part in target.parts for time in _times(part)]
    own = target.time if isinstance(target, Observed | Measured) else None
    return [] if own is None else [own]


def observed_at(target: Target) -> float | None:
    """When the data of a target were observed at the end of a colony, h; None where it has none, or
    they have no time."""
    return next(iter(_times(target)), None)


class SumOfTargets(Several):
    """The base class of those whose loss is a sum of those of their parts, so that it has residuals
    where all parts have."""

    @property
    def comparable(self) -> bool:  # type: ignore[override]
        return all(part.comparable for part in self.parts)

    def course(self, state: tf.State) -> Tensor | None:
        """The notes of all parts, how many columns each needs besides, and these."""
        courses, notes = [p.course(state) for p in self.parts], [p.note(state) for p in self.parts]
        sizes = [0 if n is None else n.shape[1] for n in notes]
        more = [None if c is None else c[:, k:] for c, k in zip(courses, sizes, strict=True)]
        widths = [0 if m is None else m.shape[1] for m in more]
        found = [n for n in notes if n is not None]
        if not found:
            return None
        told = found[0].new_tensor(widths).expand(state.colonies, -1)
        return torch.cat([*found, told, *(m for m in more if m is not None)], 1)

    def of_courses(self, state: tf.State, history: Tensor | None) -> list[Tensor] | None:
        """The residuals of each part; None where one has none. history: as `residuals` gets it."""
        own = [history] * len(self.parts) if history is None else self._courses(state, history)
        each = [part.residuals(state, mine) for part, mine in zip(self.parts, own, strict=True)]
        found = [x for x in each if x is not None]
        return found if len(found) == len(each) else None

    def _courses(self, state: tf.State, history: Tensor) -> list[Tensor | None]:
        """What `course` kept of each part, (T, B, k), or what `note` did."""
        notes = self.of_parts(lambda part, own: own, state, history)
        first = sum(0 if n is None else n.shape[2] for n in notes)
        # a target with ragged notes has no derivatives, so that nobody asks for its course
        if self.ragged or history.shape[2] == first:
            return notes
        each = zip(notes, self.parted(history, first), strict=True)
        return [None if note is None else torch.cat([note, more], 2) for note, more in each]

    @property
    def squares(self) -> bool:
        return all(part.squares for part in self.parts)
