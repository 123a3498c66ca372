"""Inference: from observed colonies to the parameters that grow such colonies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchfilm as tf
from design.learnt import LearntNetworks
from design.neural_posterior import NeuralPosterior, require_sbi
from design.options import Options
from design.parameters import Choice, Parameter, Space
from design.posterior import Posterior
from design.prior import Prior
from design.progress import advance, open_bar
from design.region import Region
from design.simulations import Simulations, simulate_designs
from design.targets.conditions import Conditions
from design.targets.measured import Measured, extinct_words
from design.targets.observed import Observed
from design.targets.observed_conditions import checked_data, grown
from design.task import SURVIVORS, Task
from torchfilm import checks

LEAST = 50  # simulations that succeeded
DRAWN = 4000  # samples, by which the region of the next round is chosen


@checks.known_keywords
def infer(
    scene: Callable[..., tf.Scene] | str,
    parameters: Sequence[Parameter | Choice],
    observed: Observed | Measured | Conditions,
    *,
    simulations: int = 5000,
    rounds: int = 1,
    cells: int | None = None, until: float | None = None,
    replicates: int | None = None, reduce: str = "mean",
    fixed: Mapping[str, Any] | None = None,
    prior: Mapping[str, Any] | None = None,
    seed: int = 0,
    dt: float | None = None, dtype: torch.dtype = torch.float32, device: str = "cpu",
    path: str | Path | None = None,
    samples: int = 4000,
    flows: int = 2,
    epochs: int = 400,
    executor: Executor | None = None,
    progress: bool | None = None,
) -> Posterior:  # fmt: skip
    """The parameters of a scene that could have grown the observed colonies, as a posterior.

        posterior = infer(my_scene, [Parameter("rate", 0.5, 2, log=True)], observed, until=5.0)

    Before the data, every value within the bounds is as likely as any other, on the logarithmic
    scale where log=True, unless `prior` says more. `simulations` designs are drawn so and grown,
    each with random numbers of its own and `replicates` colonies, by default as many as were
    observed, whose statistics are averaged. From these, neural posterior estimation
    (`NeuralPosterior` names the sources) learns the density of the parameters, given statistics.
    Simulations that fail are left out, so the posterior is that of colonies that do not.
    rounds: with more than 1, the simulations of each further round lie where those before leave the
    parameters, with a margin, so that few give narrow intervals; the posterior is then for these
    data alone. Each round learns from all simulations within its region (truncation: Miller et al.,
    arXiv 2107.01214; Deistler et al., arXiv 2210.04815). observed: the data; or measures of your
    own, `Measured`, whose spreads are the standard errors of the wanted values; or `Conditions` of
    the data of each condition, such as a dose response: a replicate is a colony under each.

    scene, parameters, cells, fixed, seed, dt, dtype, device: as for `Search`. until: h, by default
    when the data were observed. replicates: with fewer than were observed, the posterior is wider
    than the data allow. reduce: "survivors" where those that died out were not observed: only
    simulated ones that live on are averaged, up to as many as were observed; give more replicates,
    so that as many live. prior: what is known before, by the names of parameters: for a number a
    frozen distribution of scipy.stats, for a choice the share of each option (`Prior`). path: a
    file that keeps the simulations, also for other data of the same statistics; what is learnt is
    kept beside it, and the same again takes seconds. samples: of the posterior. flows: of the
    estimator; more are less sure. epochs: at most so many. executor: of `concurrent.futures`.
    progress: as for `Search.run`. Raises the errors of `Task`, and InputError where sbi is missing
    (the `infer` extra), for the file of other simulations, and where fewer than 50 succeed.
    """
    require_sbi()
    data = checked_data(observed)
    _check_counts(simulations, rounds, samples=samples, flows=flows, epochs=epochs)
    _check_end(data.time, cells, until)
    kept = None if path is None else checks.file_path("path", path)
    task = Task(
        scene, parameters, grown(data), cells=cells, until=until,
        replicates=data.colonies if replicates is None else replicates,
        reduce=_checked(reduce), fixed=fixed, seed=seed, dt=dt, dtype=dtype, device=device,
        replay=False,
    )  # fmt: skip
    known = Prior(task.space, prior)
    levels, learnt = _options_in(task.space), LearntNetworks.beside(kept)
    estimation = _Estimation(seed, flows, epochs, progress, data.spread, levels, learnt)
    found, estimator = _in_rounds(
        task, known, data, simulations, rounds, kept, executor, estimation
    )
    posterior = Posterior.of(task, known, found, estimator, data, samples)
    if posterior.other_sizes:
        checks.warn(posterior.other_sizes)
    return posterior


def _checked(reduce: str) -> str:
    checks.choice("reduce", reduce, ("mean", SURVIVORS))
    return reduce


def _check_counts(simulations: int, rounds: int, *, samples: int, flows: int, epochs: int) -> None:
    for name, value, least in (
        ("simulations", simulations, LEAST), ("rounds", rounds, 1), ("samples", samples, 10),
        ("flows", flows, 1), ("epochs", epochs, 1),
    ):  # fmt: skip
        checks.integer(name, value, least=least)
    if simulations < LEAST * rounds:
        rule = f"at least {LEAST} for each of {rounds} rounds"
        raise checks.input_error("simulations", simulations, rule)


def _options_in(space: Space) -> list[int | None]:
    """The options of choices and whole numbers, or of choices alone where that makes too many
    combinations to tell apart."""
    each = list(space.levels)
    if Options.of(each).places:
        return each
    of = zip(each, space.parameters, strict=True)
    return [count if isinstance(p, Choice) else None for count, p in of]


def _check_end(seen: float | None, cells: int | None, until: float | None) -> None:
    """Raise InputError where colonies would not end when the data were `seen`, h."""
    if seen is None:
        return
    rule = f"left out, since the data were observed at {seen:g} h"
    if cells is not None:
        raise checks.input_error("cells", cells, rule)
    if until is not None and abs(until - seen) > 1e-6 * seen:
        raise checks.input_error("until", until, rule)


@dataclass(frozen=True)
class _Estimation:
    """How a density is learnt."""

    seed: int
    flows: int
    epochs: int
    progress: bool | None
    unit: Sequence[float]
    levels: list[int | None]
    kept: LearntNetworks

    def learn(self, found: Simulations, region: Region) -> NeuralPosterior:
        """The density of the parameters, given statistics, within a region."""
        rows = found.within(region)
        with open_bar(self.flows, self.progress, "infer", counted="flows") as bar:

            def begun(flow: int) -> None:
                if bar is not None:
                    bar.update(flow - bar.n)
                    bar.set_postfix_str(f"learning flow {flow + 1} of {self.flows}")

            learnt = NeuralPosterior.learn(
                found.points[rows], found.statistics[rows], unit=np.array(self.unit), region=region,
                levels=self.levels, seed=self.seed, flows=self.flows, epochs=self.epochs,
                begun=begun, kept=self.kept,
            )  # fmt: skip
            advance(bar, 1)
        self.kept.write()
        return learnt


def _in_rounds(
    task: Task,
    prior: Prior,
    data: Observed,
    count: int,
    rounds: int,
    path: Path | None,
    executor: Executor | None,
    estimation: _Estimation,
) -> tuple[Simulations, NeuralPosterior]:
    """The simulations of all rounds, and what the last has learnt. A file knows the regions of the
    rounds that have begun, so that going on with it learns nothing twice."""
    plan = None if rounds == 1 else (count, rounds)
    simulate = partial(
        simulate_designs, task, prior=prior, rounds=plan, path=path, executor=executor
    )
    regions: tuple[Region, ...] = (Region.whole(task.space.size),)
    while True:
        upto = count * len(regions) // rounds
        found = _simulate(simulate, data, regions, upto, task.replicates, estimation.progress)
        if len(found.regions) > len(regions):
            regions = found.regions[: len(regions) + 1]
            continue
        learnt = estimation.learn(found, regions[-1])
        if len(regions) == rounds:
            return found, learnt
        drawn = learnt.sample(np.array([data.values]), DRAWN, seed=estimation.seed)[0]
        regions += (regions[-1].around(drawn, task.space.moving, upto),)


def _simulate(
    simulate: Callable[..., Simulations],
    data: Observed,
    regions: tuple[Region, ...],
    count: int,
    each: int,
    progress: bool | None,
) -> Simulations:
    """The first `count` simulations of a task, of `each` replicates. Raises InputError where too
    few succeed within the last region."""
    with open_bar(count * each, progress, "infer") as bar:
        seen = lambda known: advance(bar, known * each - (bar.n if bar else 0))
        found = simulate(count, regions=regions, seen=seen)
    sound = int(found.within(regions[-1]).sum())
    if sound < LEAST:
        tried = int(regions[-1].holds(found.points).sum())
        why = "".join(
            f"; the most frequent reason of failure: {w}" for w, _ in found.failures()[:1]
        )
        hint = "".join(f". {words}" for words in extinct_words(data, found.reasons.values()))
        raise tf.InputError(
            f"{sound} of {tried} simulations succeeded, and {LEAST} are needed{why}{hint}"
        )
    return found
