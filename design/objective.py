"""The objective: designs in, losses out. Candidates × replicates are grown in one batch of
colonies, on one recorded growth where nothing that is searched acts back on it."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import inspect
import itertools
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

import torchfilm as tf
from design import executors, growth_cache, memory
from design.parameters import Choice, Parameter, Space, Value
from design.rollout import FinishedColonies, grow
from design.targets.base import Target
from torchfilm import checks

REDUCE = ("mean", "worst")
OFF = "replay=False"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What became of some designs.

    points (n, D); losses (n, R), of each replicate; loss (n,); cells (n, R), of each colony at its
    end; reasons, by (row, replicate), why a colony failed; size: share of the full size; regrown:
    why every colony was grown anew, or "" if all followed a recorded growth; seconds.
    """

    points: np.ndarray
    losses: np.ndarray
    loss: np.ndarray
    cells: np.ndarray
    reasons: dict[tuple[int, int], str] = field(default_factory=dict)
    size: float = 1.0
    regrown: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class WorkItem:
    """Part of an evaluation: rows of it that are alike in how their scene is built, and their
    parameters."""

    rows: tuple[int, ...]
    values: tuple[dict[str, Value], ...]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a piece: losses and cells (n, R), and reasons by (row of the piece,
    replicate)."""

    losses: np.ndarray
    cells: np.ndarray
    reasons: dict[tuple[int, int], str]
    regrown: str


class Objective:
    """How far designs of a scene are from a target.

    scene: a function from parameters to a `tf.Scene`, or the name of a ready scene. parameters:
    what may change, and fixed: further arguments of the scene. A colony ends at `cells` cells or at
    `until` h, whichever it reaches first. replicates: colonies of each design; the k-th of every
    design follows stream k of random numbers, so that designs are compared on equal terms. reduce:
    how their losses become one: "mean", "worst", or a quantile such as 0.75. seed, dt, dtype,
    device: as for `scene.seed` and `tf.simulate`. replay: let circuits run on recorded growth where
    they can. most: colonies in one batch; by default as many as memory allows. Raises InputError
    for a parameter that the scene lacks, bounds that it refuses, and a target that its first state
    cannot meet.
    """

    def __init__(
        self,
        scene: Callable[..., tf.Scene] | str,
        parameters: Sequence[Parameter | Choice],
        target: Target,
        *,
        cells: int | None = None,
        until: float | None = None,
        replicates: int = 4,
        reduce: str | float = "mean",
        fixed: Mapping[str, Any] | None = None,
        seed: int = 0,
        dt: float | None = None,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
        replay: bool = True,
        most: int | None = None,
    ):
        self.make = _scene_function(scene)
        self.space, self.target, self.fixed = Space(parameters), target, dict(fixed or {})
        if not isinstance(target, Target):
            raise checks.input_error("target", target, "a Target, such as Stripe(…)")
        if cells is None and until is None:
            raise checks.InputError("a colony needs an end: give cells=… or until=… (hours).")
        self.cells = None if cells is None else _whole("cells", cells, 2)
        self.until = None if until is None else checks.number("until", until, above=0.0)
        self.replicates, self.most = (
            _whole("replicates", replicates, 1),
            (None if most is None else _whole("most", most, 1)),
        )
        if reduce not in REDUCE and (
            isinstance(reduce, bool) or not isinstance(reduce, (int, float)) or not 0 < reduce <= 1
        ):
            raise checks.input_error(
                "reduce", reduce, '"mean", "worst" or a quantile above 0 and at most 1'
            )
        _whole("seed", seed, 0)
        self.reduce, self.seed, self.dtype, self.device, self.replay = (
            reduce,
            seed,
            dtype,
            device,
            replay,
        )
        self._check_names()
        probe = self._probe()
        self.founders = int(probe.founders.count)
        if self.cells is not None and self.cells <= self.founders and probe.founders.colony is None:
            raise checks.input_error(
                "cells", self.cells, f"above the {self.founders} that a colony starts from"
            )
        self.dt = probe.dt if dt is None else checks.number("dt", dt, above=0.0)
        steps = 1.0 if self.until is None else self.until / self.dt
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
            raise checks.input_error(
                "until", until, f"a whole number of steps of dt = {self.dt:g} h"
            )
        # a ready scene is built again by its name; a function that calls one has parameters of its
        # own
        self.recipe = (
            probe.recipe
            if probe.recipe and self.make is tf.scenes.READY.get(probe.recipe[0])
            else None
        )
        self.listing = probe.listing()
        self.regrown = tf.GrowthRecording.obstacle(probe) if self.replay else OFF

    def _check_names(self) -> None:
        allowed = inspect.signature(self.make).parameters
        if not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in allowed.values()):
            name = getattr(self.make, "__name__", "the scene")
            self.space.check(list(allowed), name)
            for given in self.fixed:
                if given not in allowed:
                    raise checks.input_error(
                        "fixed", given, f"a parameter of {name}: {', '.join(allowed)}"
                    )
        both = [n for n in self.fixed if n in self.space.names]
        if both:
            raise checks.input_error("fixed", both[0], "a parameter that is not searched as well")

    def _probe(self) -> tf.Scene:
        """The scene in the middle of the space, after one of each option was built and the target
        looked at its first state."""
        middle = [p.value(0.5) for p in self.space.parameters]
        base = dict(zip(self.space.names, middle, strict=True))
        trials, made_of, still = [base], [], []
        for p in self.space.parameters:
            ends = (p.low, p.high) if isinstance(p, Parameter) else p.options
            trials += [
                {**base, p.name: int(v) if isinstance(p, Parameter) and p.whole else v}
                for v in ends
            ]
        for values in trials:
            try:
                # two colonies: a tensor of one number passes for a plain number
                made = self.scene([values], repeat=2)
                state = made.seed(2, seed=self.seed, dtype=self.dtype, device=self.device)
            except Exception as error:
                changed = {n: v for n, v in values.items() if v != base[n]} or values
                raise tf.InputError(
                    f"the scene cannot be built with {changed}: {type(error).__name__}:"
                    f" {str(error).rstrip('.')}. A plain Parameter reaches the scene as a tensor"
                    " with one value per colony; what the scene takes as one plain number or as a"
                    " name can be searched with whole=True or as a Choice. Else narrow the bounds."
                ) from error
            self.target.check(state)
            made_of.append((made.listed, made.founders))
            still.append(self._never_ends(made, state))
        # one design that does not grow is scored as such; a search of none that does is a mistake
        if all(still):
            raise tf.InputError(still[0])
        # what a listing does not show: founders, and what functions do
        self.made_of = tf.digest(made_of)
        return self.scene([base])

    def _never_ends(self, scene: tf.Scene, state: tf.State) -> str:
        """Why no run would come to the number of cells that ends it; empty where one would."""
        try:
            if self.cells is not None and self.until is None:
                scene.check_moves(state, self.cells)
        except tf.InputError as error:
            return str(error)
        return ""

    def scene(self, values: Sequence[Mapping[str, Value]], repeat: int = 1) -> tf.Scene:
        """One scene for several designs alike in what builds it: numbers as one value per colony,
        each design's `repeat` times."""
        arguments = dict(self.fixed)
        for p in self.space.parameters:
            column = [v[p.name] for v in values]
            structural = p.levels is not None
            arguments[p.name] = (
                column[0]
                if structural
                else torch.tensor(
                    column, dtype=torch.float64, device=self.device
                ).repeat_interleave(repeat)
            )
        made = self.make(**arguments)
        if not isinstance(made, tf.Scene):
            raise checks.input_error("scene", made, "a function that returns a tf.Scene")
        return made

    def evaluate(
        self,
        points: np.ndarray,
        *,
        streams: Sequence[int] | None = None,
        size: float = 1.0,
        executor: Executor | None = None,
        pieces: int = 1,
    ) -> Evaluation:
        """Grow designs, (n, D) coordinates in [0, 1], and score them.

        streams: of random numbers, one a replicate; by default 0 … replicates − 1. size: share of
        `cells` and `until`, for cheap first looks. executor: of the `concurrent.futures` kind, for
        other processes or machines; pieces: how many parts it gets at least. What it loses, as when
        a worker is killed, is grown all the same, in the end here, with a warning. The outcome is
        the same to the bit however it is divided, on machines alike.
        """
        begun = time.perf_counter()
        points = np.asarray(points, dtype=np.float64)
        if (
            points.ndim != 2
            or points.shape[1] != self.space.size
            or not len(points)
            or not bool(((points >= 0) & (points <= 1)).all())
        ):
            raise checks.input_error(
                "points", points.shape, f"(n, {self.space.size}) coordinates in [0, 1]"
            )
        checks.number("size", size, above=0.0, most=1.0)
        chosen = self._streams(streams)
        values = [self.space.values(p) for p in points]
        losses, cells = (
            np.full((len(points), len(chosen)), np.nan),
            np.zeros((len(points), len(chosen)), np.int64),
        )
        reasons: dict[tuple[int, int], str] = {}
        regrown = ""
        for piece, found in self._outcomes(
            self._pieces(values, len(chosen), size, pieces), chosen, size, executor
        ):
            rows = list(piece.rows)
            losses[rows], cells[rows] = found.losses, found.cells
            reasons |= {(rows[row], k): words for (row, k), words in found.reasons.items()}
            regrown = regrown or found.regrown
        return Evaluation(
            points,
            losses,
            self.reduced(losses),
            cells,
            reasons,
            size,
            regrown,
            time.perf_counter() - begun,
        )

    def _streams(self, given: Sequence[int] | None) -> tuple[int, ...]:
        """The streams asked for, or those of the replicates."""
        found = tuple(range(self.replicates)) if given is None else tuple(int(s) for s in given)
        if not found or len(set(found)) != len(found) or not all(0 <= s < 2**32 for s in found):
            raise checks.input_error(
                "streams", given, "different whole numbers from 0 to 2³² − 1, at least one"
            )
        return found

    def reduced(self, losses: np.ndarray) -> np.ndarray:
        """One loss a design, (n,), from those of its replicates (n, R)."""
        if self.reduce == "mean":
            return losses.mean(1)
        return (
            losses.max(1)
            if self.reduce == "worst"
            else np.quantile(losses, float(self.reduce), axis=1)
        )

    def _pieces(
        self, values: Sequence[dict[str, Value]], replicates: int, size: float, least: int
    ) -> list[WorkItem]:
        """The designs in groups that one scene can hold and one batch can carry."""
        structural = [p.name for p in self.space.parameters if p.levels is not None]
        groups: dict[tuple[str, ...], list[int]] = {}
        for row, design in enumerate(values):
            groups.setdefault(tuple(repr(design[n]) for n in structural), []).append(row)
        out = []
        for rows in groups.values():
            most = self.most or self._room([values[r] for r in rows], size)
            wanted = max(
                math.ceil(len(rows) / max(1, most // replicates)),
                math.ceil(least * len(rows) / len(values)),
            )
            count = min(len(rows), wanted)
            cuts = [len(rows) * k // count for k in range(count + 1)]  # as even as can be
            out += [
                WorkItem(tuple(rows[a:b]), tuple(values[r] for r in rows[a:b]))
                for a, b in itertools.pairwise(cuts)
            ]
        return out

    def _room(self, values: Sequence[dict[str, Value]], size: float) -> int:
        """How many colonies of designs alike in what builds them memory takes at once; the first
        that the scene does not input_error tells."""
        for design in values:
            with contextlib.suppress(tf.InputError):
                return memory.max_colonies(
                    self.scene([design]), self.end(size)[0], self.dtype, self.device
                )
        return 1

    def _outcomes(
        self,
        pieces: list[WorkItem],
        streams: tuple[int, ...],
        size: float,
        executor: Executor | None,
    ) -> Iterator[tuple[WorkItem, Outcome]]:
        """Each piece with what became of it, once."""
        if executor is None:
            return ((piece, self.run(piece, streams, size)) for piece in pieces)
        return executors.outcomes(self, pieces, streams, size, executor)

    def resized(self, factor: float) -> Objective:
        """The same with colonies `factor` times as large, or `factor` times as many hours: above 1
        too."""
        other = copy.copy(self)
        other.cells, other.until = self.end(checks.number("factor", factor, above=0.0))
        return other

    def end(self, size: float) -> tuple[int | None, float | None]:
        """Cells and hours at which colonies of a share of the full size end."""
        cells = None if self.cells is None else max(self.founders + 1, round(self.cells * size))
        return cells, (
            None if self.until is None else max(1, round(self.until * size / self.dt)) * self.dt
        )

    def run(self, piece: WorkItem, streams: tuple[int, ...], size: float) -> Outcome:
        """Grow a piece in one batch; in halves where it does not fit, or where the scene refuses
        one of its designs."""
        count, replicates = len(piece.rows), len(streams)
        try:
            return self._score(piece, streams, size)
        except (tf.InputError, tf.SimulationError) as error:
            if count == 1:
                words = {(0, k): str(error) for k in range(replicates)}
                return Outcome(
                    np.full((1, replicates), self.target.failed),
                    np.zeros((1, replicates), np.int64),
                    words,
                    "",
                )
        except (MemoryError, RuntimeError) as error:
            if count == 1 or not memory.is_lack_of_memory(error):
                raise
        half = count // 2
        parts = [
            WorkItem(piece.rows[a:b], piece.values[a:b]) for a, b in ((0, half), (half, count))
        ]
        first, second = (self.run(part, streams, size) for part in parts)
        reasons = {
            **first.reasons,
            **{(row + half, k): words for (row, k), words in second.reasons.items()},
        }
        return Outcome(
            np.concatenate([first.losses, second.losses]),
            np.concatenate([first.cells, second.cells]),
            reasons,
            first.regrown or second.regrown,
        )

    @torch.no_grad()
    def _score(self, piece: WorkItem, streams: tuple[int, ...], size: float) -> Outcome:
        count, replicates = len(piece.rows), len(streams)
        losses, cells = (
            np.full(count * replicates, self.target.failed, np.float64),
            np.zeros(count * replicates, np.int64),
        )
        reasons: dict[tuple[int, int], str] = {}
        step, state, regrown = self._start(piece.values, streams)
        most_cells, until = self.end(size)
        for event in grow(step, state, cells=most_cells, until=until, note=self.target.note):
            if not isinstance(event, FinishedColonies):
                reasons[divmod(event.colony_id, replicates)] = event.reason
                continue
            ids = event.state.colony_id.tolist()
            found = self.target.loss(event.state, event.history)
            if not isinstance(found, torch.Tensor) or found.shape != (len(ids),):
                raise TypeError(
                    f"{type(self.target).__name__}.loss must return a tensor of shape"
                    f" ({len(ids)},), one number for each colony"
                )
            score = found.double().cpu().numpy()
            for colony_id, number in zip(ids, score.tolist(), strict=True):
                if not math.isfinite(number):
                    reasons[divmod(colony_id, replicates)] = f"the target's loss was {number}"
            losses[ids], cells[ids] = (
                np.where(np.isfinite(score), score, self.target.failed),
                event.state.counts.cpu().numpy(),
            )
        return Outcome(
            losses.reshape(count, replicates), cells.reshape(count, replicates), reasons, regrown
        )

    def _start(
        self, values: Sequence[dict[str, Value]], streams: tuple[int, ...]
    ) -> tuple[Callable[[tf.State], tf.State], tf.State, str]:
        """The step of a batch, its first state, and why it does not follow a recorded growth, or
        ""."""
        scene = self.scene(values, repeat=len(streams))
        tiled = torch.tensor(streams).repeat(len(values))
        why = tf.GrowthRecording.obstacle(scene) if self.replay else OFF
        if not why:
            # one course for all replicates, also where a first look grows fewer
            usual = tuple(range(self.replicates))
            course = growth_cache.recording_for(
                self, scene, usual if set(streams) <= set(usual) else streams
            )
            replay = tf.Replay(scene, course)
            return replay.step, replay.seed(tiled.numel(), streams=tiled), ""
        state = scene.seed(
            tiled.numel(), seed=self.seed, streams=tiled, dtype=self.dtype, device=self.device
        )
        return (lambda s: scene.step(s, self.dt)), state, why

    @torch.no_grad()
    def final(
        self, point: np.ndarray, *, streams: Sequence[int] | None = None, size: float = 1.0
    ) -> list[FinishedColonies]:
        """The colonies of one design at their ends, for pictures and measures; those that fail are
        left out."""
        try:
            step, state, _ = self._start(
                [self.space.values(np.asarray(point))], self._streams(streams)
            )
        except tf.InputError:  # the scene refuses this design
            return []
        cells, until = self.end(size)
        return [
            e
            for e in grow(step, state, cells=cells, until=until, note=self.target.note)
            if isinstance(e, FinishedColonies)
        ]

    def describe(self) -> dict[str, Any]:
        """What the losses depend on, as plain data: a study is gone on with only by an objective
        that says the same."""
        return {
            "scene": self.recipe[0] if self.recipe else getattr(self.make, "__name__", "scene"),
            "fixed": {n: _lasting(v) for n, v in self.fixed.items()},
            "effects": self.listing,
            "founders and functions": self.made_of,
            "parameters": self.space.describe(),
            "code of the target": tf.digest(self.target),
            "target": _told(self.target),
            "cells": self.cells,
            "until": self.until,
            "replicates": self.replicates,
            "reduce": self.reduce,
            "seed": self.seed,
            "dt": self.dt,
            "dtype": str(self.dtype)[6:],
        }


def _told(target: Target) -> str:
    """A target with all its settings, the same in every run."""
    return _lasting(target) if dataclasses.is_dataclass(target) else target.describe()


def _lasting(value: Any) -> str:
    """How a value is written, without where it lies in the memory of this process."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def _scene_function(scene: Callable[..., tf.Scene] | str) -> Callable[..., tf.Scene]:
    if isinstance(scene, str):
        if scene not in tf.scenes.READY:
            raise checks.input_error(
                "scene",
                scene,
                "one of "
                + ", ".join(tf.scenes.READY)
                + ", or a function from parameters to a tf.Scene",
            )
        return tf.scenes.READY[scene]
    if isinstance(scene, tf.Scene) or not callable(scene):
        raise checks.input_error(
            "scene",
            scene,
            "a function from parameters to a tf.Scene",
            "Give the function, not the scene that it made: def scene(k3=1.0): …",
        )
    return scene


def _whole(name: str, value: Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise checks.input_error(name, value, f"a whole number from {least}")
    return value
