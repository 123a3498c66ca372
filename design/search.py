"""A search: a method asks, an objective answers, a study keeps, until the budget is spent."""

from __future__ import annotations

import inspect
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

import torchfilm as tf
from design import report, robust
from design.methods import Batch, Method, method_of
from design.objective import Evaluation, Objective
from design.parameters import Choice, Parameter, Value
from design.robust import Robustness
from design.rollout import FinishedColonies
from design.study import Entry, Study
from design.targets.base import Target
from torchfilm import checks

if TYPE_CHECKING:
    from tqdm import tqdm


class Search:
    """Search the parameters of a scene for colonies that draw a pattern.

        search = Search(tf.scenes.boundary_detector, parameters=[Parameter("k3", 0.1, 10, log=True)],
                        target=Stripe("yfp", at="border", width=8.0, cell_type=1), cells=150)
        best = search.run(colonies=2000, study="stripe.h5")

    method: "cmaes", "sobol", "racing", "bayesian", one of their objects with settings of its own,
    or any object that asks and is told (`Method`). The other arguments are those of `Objective`.
    """

    def __init__(
        self,
        scene: Callable[..., tf.Scene] | str,
        parameters: Sequence[Parameter | Choice],
        target: Target,
        *,
        method: str | Method = "cmaes",
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
        self.objective = Objective(
            scene,
            parameters,
            target,
            cells=cells,
            until=until,
            replicates=replicates,
            reduce=reduce,
            fixed=fixed,
            seed=seed,
            dt=dt,
            dtype=dtype,
            device=device,
            replay=replay,
            most=most,
        )
        self.method, self.seed, self.regrown = method_of(method), seed, self.objective.regrown
        self.grown: dict[
            bytes, list[FinishedColonies]
        ] = {}  # colonies of designs that were looked at
        self.study = self._new_study(None)

    def run(
        self,
        colonies: int,
        *,
        study: str | Path | None = None,
        stop_at: float | None = None,
        executor: Executor | None = None,
        pieces: int = 1,
        progress: bool = True,
    ) -> Best:
        """Search anew, or on from what `study` holds, until `colonies` have been simulated, or a
        design's loss is at most `stop_at`; returns the best design.

        colonies: each replicate of each design counts as one, a smaller colony by its share of the
        full size; the last batch may go over. study: file in which every evaluation is kept; if
        there is one already of this search, it goes on from there, and what it holds counts.
        executor: of the `concurrent.futures` kind (processes, Dask, …), pieces: how many parts a
        batch is cut into for it. progress: show a bar with the best loss so far.
        """
        if isinstance(colonies, bool) or not isinstance(colonies, int) or colonies < 1:
            raise checks.input_error("colonies", colonies, "a whole number from 1")
        if stop_at is not None:
            checks.number("stop_at", stop_at)
        self.study = self._new_study(study)
        self.method.start(self.objective.space, self.seed, self.objective.replicates)
        self._catch_up()
        try:
            with report.bar(colonies, progress) as bar:
                self._show(bar)
                while self.study.colonies < colonies and not self._reached(stop_at):
                    self._batch(executor, pieces)
                    self._show(bar)
        except KeyboardInterrupt:
            kept = (
                f"they are in {self.study.path}: run the search again to go on"
                if self.study.path
                else "best() gives the best of them"
            )
            print(
                f"stopped at {self.study.colonies:.0f} of {colonies} colonies; {kept}.",
                file=sys.stderr,
            )
            raise
        if self.study.entries and all(len(e.reasons) == e.losses.size for e in self.study.entries):
            print(
                f"every colony failed; most often: {self.study.failures()[0][0]}", file=sys.stderr
            )
        return self.best()

    def best(self) -> Best:
        """The best design so far."""
        found = self.study.best()
        if found is None:
            raise _none_yet()
        point, loss, losses = found
        return Best(self, self.objective.space.values(point), point, loss, losses)

    def first(self) -> Best:
        """The first design that was grown to full size: where the search began."""
        full = self.study.full()
        if not full:
            raise _none_yet()
        entry = full[0]
        return Best(
            self,
            self.objective.space.values(entry.points[0]),
            entry.points[0],
            float(entry.loss[0]),
            entry.losses[0],
        )

    def _new_study(self, path: str | Path | None) -> Study:
        about = self.objective.describe() | {
            "names": list(self.objective.space.names),
            "method": _described(self.method),
        }
        streams = tuple(range(self.objective.replicates))
        return (
            Study(about, self.objective.space.names, streams)
            if path is None
            else Study.open(path, about, self.objective.space.names, streams)
        )

    def _catch_up(self) -> None:
        """Tell the method what the study holds: it then stands where it stood, and asks what it
        would have asked."""
        for k, entry in enumerate(self.study.entries):
            batch = self.method.ask()
            # another machine may round another way
            if batch.points.shape != entry.points.shape or not np.allclose(
                batch.points, entry.points, rtol=0, atol=1e-6
            ):
                raise tf.InputError(
                    f"{self.study.path}: its batch {k} is not what the method asks for here, as if"
                    " another version of it had made it. Start a new study."
                )
            self.method.tell(Batch(entry.points, batch.size, batch.replicates), entry.loss)

    def _batch(self, executor: Executor | None, pieces: int) -> Evaluation:
        batch = self.method.ask()
        if not isinstance(batch, Batch):
            raise tf.InputError(
                f"{type(self.method).__name__}.ask must return a design.Batch of points (n,"
                f" {self.objective.space.size}), not {type(batch).__name__}."
            )
        replicates = (
            self.objective.replicates
            if batch.replicates is None
            else min(batch.replicates, self.objective.replicates)
        )
        found = self.objective.evaluate(
            batch.points,
            streams=range(replicates),
            size=batch.size,
            executor=executor,
            pieces=pieces,
        )
        values = [self.objective.space.values(p) for p in found.points]
        entry = Entry(
            found.points,
            found.loss,
            found.losses,
            found.cells,
            found.reasons,
            batch.size,
            replicates,
            found.seconds,
            values,
        )
        self.study.add(entry)
        self.method.tell(batch, found.loss)
        self.regrown = found.regrown
        return found

    def _reached(self, stop_at: float | None) -> bool:
        found = self.study.best()
        return stop_at is not None and found is not None and found[1] <= stop_at

    def _show(self, bar: tqdm | None) -> None:
        if bar is None:
            return
        found = self.study.best()
        bar.update(min(self.study.colonies, bar.total) - bar.n)
        failed = sum(len(e.reasons) for e in self.study.entries)
        words = "no full-size colony yet" if found is None else f"best loss {found[1]:.4f}"
        bar.set_postfix_str(words + (f", {failed} colonies failed" if failed else ""))


@dataclass(frozen=True, eq=False)
class Best:
    """The best design of a search: its parameters by name, their point (D,), its loss, and the
    losses of its replicates (R,)."""

    search: Search = field(repr=False)
    values: dict[str, Value]
    point: np.ndarray = field(repr=False)
    loss: float
    losses: np.ndarray

    def scene(self) -> tf.Scene:
        """The scene with these parameters, for one colony or any number of them."""
        return self.search.objective.make(**self.search.objective.fixed, **self.values)

    def save(self, path: str | Path) -> Path:
        """Write the design as JSON, which `torchfilm run` takes. Replaces an older one."""
        objective, path = self.search.objective, Path(path)
        if not path.parent.is_dir():
            raise checks.input_error(
                "path", str(path), "in a folder that exists", f"Make {path.parent} first."
            )
        home = {} if objective.recipe else _home(objective.make)
        end = {
            name: value
            for name, value in (("cells", objective.cells), ("until", objective.until))
            if value is not None
        }
        told = {
            "torchfilm": tf.__version__,
            "scene": objective.recipe[0] if objective.recipe else home["function"],
            **home,
            "parameters": {**objective.fixed, **self.values},
            **end,
            "seed": objective.seed,
            "dt": objective.dt,
            "dtype": str(objective.dtype)[6:],
            "target": objective.target.describe(),
            "species": list(objective.target.names),
            "loss": self.loss,
            "losses": self.losses.tolist(),
            "colonies": self.search.study.colonies,
        }
        path.write_text(json.dumps(told, indent=1, default=_plain) + "\n")
        return path

    def plot(self, path: str | Path) -> Path:
        """Draw the first guess, the best design and the target, and how the search got there. Needs
        matplotlib (the `app` extra)."""
        return report.draw(self, Path(path))

    def table(self) -> str:
        """The parameters, with their bounds and the first guess, and the losses."""
        return report.table(self)

    def check(
        self,
        *,
        seeds: int = 32,
        sizes: Sequence[float] = (0.5, 2.0),
        change: float = 0.2,
        samples: int = 0,
        threshold: float | None = None,
        executor: Executor | None = None,
        pieces: int = 1,
        progress: bool = True,
    ) -> Robustness:
        """How it holds up on fresh seeds, at other sizes and with other parameters; see
        `robustness`."""
        return robust.robustness(
            self,
            seeds=seeds,
            sizes=sizes,
            change=change,
            samples=samples,
            threshold=threshold,
            executor=executor,
            pieces=pieces,
            progress=progress,
        )

    def colonies(self) -> list[FinishedColonies]:
        """The replicates, grown again, once: the same colonies as were scored."""
        key = self.point.tobytes()
        if key not in self.search.grown:
            self.search.grown[key] = self.search.objective.final(self.point)
        return self.search.grown[key]


def _none_yet() -> tf.InputError:
    return tf.InputError(
        "no design has been grown to full size yet: run the search for more colonies."
    )


def _home(make: Callable[..., tf.Scene]) -> dict[str, Any]:
    """Where a user's own scene function is found again: its file and its name there."""
    made = inspect.unwrap(make)
    code = getattr(made, "__code__", None)
    if code is None or "<" in made.__qualname__:
        raise checks.input_error(
            "scene",
            make,
            "a function at the top level of a file, for a design that is saved",
            "A file cannot find it again by its name.",
        )
    return {"file": os.path.abspath(code.co_filename), "function": made.__name__}


def _plain(value: Any) -> Any:
    """What JSON can hold of a value that it cannot."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise checks.input_error(
        "fixed",
        value,
        "numbers, texts, or arrays of numbers in a design that is saved",
        "Let the scene function make it from such.",
    )


def _described(method: Method) -> str:
    describe = getattr(method, "describe", None)
    return describe() if callable(describe) else type(method).__name__
