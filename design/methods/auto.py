"""The choice of a method from what is known of a search."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

from design.methods.bayesian import Bayesian
from design.methods.cmaes import CMAES
from design.methods.exhaustive import Exhaustive
from design.methods.gauss_newton import GaussNewton
from design.methods.nsga2 import NSGA2
from design.methods.polish import Polish
from design.methods.racing import Racing

# designs of a batch, and the width of its first cloud: the settings that were measured
BATCH, WIDTH = 24, 0.5
# designs before the first descents (less than one race, whose end they await), and for each
# parameter of a descent, so that it ends
BEFORE, EACH, MOST_STARTS = 5, 10, 3
# designs before the descent of a fit whose budget has no room for a whole batch
SPARSE = 8
# designs of a batch of a race where every design needs many replicates
FEW = 12
# designs of a batch of a model, and at most in a search, since its time grows as the cube of all
# designs that it holds: where it draws them all, and where it learns from the best of races
MODEL_BATCH, MODELLED, RACED = 6, 400, 1000
# fewer designs than these are not enough for races of CMA-ES, and for descents
LEAST_RACED = 2 * BATCH
# designs of the least squares of a fit without derivatives, beside those of its start
LEAST_LEARNT = 4
# colonies of the first race of a model and of the next one, without those of all replicates, and
# designs that these races grow with all replicates; the rest of a budget, a fifth, is for finals
EARLY, FINALISTS, SEARCHED = 32.25, 11, 0.8
DATA = "colonies of one size are wanted: a smaller one does not compare"
LUCK = "molecules are counted one by one, and one colony says little"


@dataclass(frozen=True, eq=False)
class Chosen:
    """A method and why it was chosen, "" where the user named it."""

    method: Any
    why: str = ""

    def describe(self) -> str:
        """What a study says of it."""
        describe = getattr(self.method, "describe", None)
        text = describe() if callable(describe) else type(self.method).__name__
        return f"auto: {text}" if self.why else text


def choose(
    dimensions: int,
    designs: float,
    goals: int,
    pattern: bool = True,
    squares: bool = False,
    chance: bool = False,
    replicates: int = 4,
    before: str = "",
    different: float = math.inf,
    searched: float = 0.0,
    comparable: bool = False,
) -> Chosen:
    """The method of a search that leaves the choice. dimensions: parameters; designs: that the
    budget can grow with all replicates; goals: 0 for one target; pattern: whether the target is a
    pattern, of which small colonies show something; squares: whether its loss is a sum of squares
    with exact derivatives; chance: whether molecules are counted one by one; replicates: of a
    design; before: what the study of a search that is resumed says of its method, which goes on;
    different: designs in the space; searched: those that the budget grows before the finals;
    comparable: whether there are residuals that compare between colonies, and no levels."""
    botorch = find_spec("botorch") is not None
    alone = chance or not pattern  # the model draws all designs
    most, least = MODELLED if alone else RACED, LEAST_RACED if pattern else 0
    if botorch:
        least = _least_modelled(dimensions, replicates, alone)
    about = f"{math.floor(designs)} designs for {dimensions} parameters"
    hint = "" if botorch or designs > most else " (with botorch, a model of the loss would)"
    few = Chosen(
        _cloud(),
        f"{math.floor(designs)} designs are fewer than {least}, too few to learn from; Sobol points"
        " first",
    )
    race = _race(f"{about}: ", replicates if chance else 0, hint)
    fit = Chosen(_cloud(), f"{DATA}; CMA-ES learns from all{hint}")
    learnt = Chosen(GaussNewton(), f"{DATA}; least squares, with slopes learnt from all designs")
    descents, fits = _descents(about), _fits(BATCH)
    sparse = _fits(SPARSE)[:1]
    models = _models(about, pattern) if botorch else ()
    older = [_once(fit) for fit in (*fits, *sparse)]
    every = Chosen(Exhaustive(), f"{different:g} different designs: the budget grows each")
    known = (few, race, *descents, *fits, *sparse, *models, learnt, *older, every)
    if begun := [x for x in known if x.describe() == before]:
        return Chosen(begun[0].method, "the study began with it")
    if goals:
        return Chosen(NSGA2(), f"{goals} goals side by side")
    if different <= searched:
        return every
    grown = designs if pattern else searched or designs
    learns = comparable and not pattern and grown >= GaussNewton.opening(dimensions) + LEAST_LEARNT
    if designs < least and not learns:
        return few
    ways = (descents, ()) if pattern else (fits, sparse)
    if squares and not chance and (way := _by_slopes(dimensions, designs, grown, *ways)):
        return way
    if learns:
        return learnt
    if designs > most or not botorch:
        return race if pattern else fit
    return models[alone]


def _cloud(population: int = BATCH) -> CMAES:
    return CMAES(population=population, sigma=WIDTH)


def _race(about: str, small: int, hint: str) -> Chosen:
    """Races of small colonies. small: replicates of these, where molecules are counted one by
    one."""
    last = f"CMA-ES learns from the best{hint}"
    if not small:
        return Chosen(Racing(inner=_cloud()), f"{about}small colonies first; {last}")
    race = Racing(inner=_cloud(FEW), small=small)
    return Chosen(race, f"{about}{LUCK}; small colonies first, with all replicates; {last}")


def _models(about: str, pattern: bool) -> tuple[Chosen, Chosen]:
    """Models of the loss: after races of small colonies, and of all designs."""
    model = Bayesian(batch=MODEL_BATCH)
    return (
        Chosen(
            Racing(inner=model),
            f"{about}: small colonies first; a model of the loss learns from the best",
        ),
        Chosen(
            Bayesian(batch=MODEL_BATCH),
            f"{about}: {LUCK if pattern else DATA}; a model of the loss knows that colonies differ"
            " by luck",
        ),
    )


def _least_modelled(dimensions: int, replicates: int, alone: bool) -> int:
    """The designs of which a model chooses some: it draws all of them alone, where its first batch
    is of Sobol points, or after a race."""
    if alone:
        return Bayesian(batch=MODEL_BATCH).opening(dimensions) + MODEL_BATCH
    return math.ceil((EARLY / replicates + FINALISTS) / SEARCHED)


def _by_slopes(
    dimensions: int,
    designs: float,
    grown: float,
    ways: tuple[Chosen, ...],
    sparse: tuple[Chosen, ...],
) -> Chosen | None:
    """The descents for which a budget has room, from one start and from more; None where it has
    none. grown: designs before the finals. ways: those of patterns, or of fits; sparse: of a fit
    after few designs."""
    first = BATCH if sparse else BEFORE
    room = int((grown - first) / (EACH * dimensions))
    if room > 0 and (sparse or designs >= LEAST_RACED):
        return ways[min(room, MOST_STARTS) - 1]
    # half a descent comes further than a model of so few designs
    return sparse[0] if sparse and designs >= SPARSE + EACH * dimensions / 2 else None


def _descents(about: str) -> tuple[Chosen, ...]:
    """Descents after a race, from one start and from more, side by side."""
    return tuple(
        Chosen(
            Polish(inner=Racing(inner=_cloud()), after=BEFORE, starts=starts),
            f"{about}: one race of small colonies, then by gradients from the best, of one"
            " replicate at first, since the loss is a sum of squares with exact derivatives",
        )
        for starts in range(1, MOST_STARTS + 1)
    )


def _once(fit: Chosen) -> Chosen:
    """Descents as studies have them that began before they were done again."""
    return replace(fit, method=replace(fit.method, again=False))


def _fits(after: int) -> tuple[Chosen, ...]:
    """Descents of a fit to data, from one start and from more, side by side."""
    return tuple(
        Chosen(
            Polish(inner=_cloud(after), after=after, starts=starts, again=True),
            f"{DATA}; {after} designs of CMA-ES, then by gradients from the best, since the loss is"
            " a sum of squares with exact derivatives; and so again",
        )
        for starts in range(1, MOST_STARTS + 1)
    )
