"""The cells that colonies start from: given once, or drawn for each colony."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from torchfilm.initial_cells import Cells
from torchfilm.tools import checks

if TYPE_CHECKING:
    from torchfilm.scene import Scene

# From a seed, the founders of one colony.
Draw = Callable[[int], Cells]


@dataclass(frozen=True)
class FirstCells:
    """From what a batch starts: seed, streams (B,) or None, and the cells of a scene, or others
    that are given in their place."""

    colonies: int
    seed: int
    streams: Tensor | None
    scene: Scene
    given: Cells | None

    @cached_property
    def cells(self) -> Cells:
        draw, given = self.scene.draw, self.given
        if given is not None or draw is None:
            return self.scene.founders if given is None else given
        streams = range(self.colonies) if self.streams is None else self.streams.tolist()
        return drawn(draw, self.seed, streams, self.scene.founders)


def one_draw(draw: Draw, seed: int, like: Cells | None = None) -> Cells:
    """What `draw` makes of a seed. Raises InputError unless it is cells of one colony, with the
    columns of others."""
    name = f"founders({seed})"
    try:
        inspect.signature(draw).bind(seed)
    except TypeError as error:
        rule = "a function of one number, the seed of the colony"
        hint = "What else differs between colonies is a value per colony, or a scene of its own."
        raise checks.input_error("founders", draw, rule, hint) from error
    except ValueError:  # of a function that does not say what it takes
        pass
    made = draw(seed)
    if not isinstance(made, Cells):
        raise checks.input_error(name, made, "Cells, such as tf.inoculum(12, 10.0, seed=seed)")
    if made.colony is not None:
        raise checks.input_error(name, "cells with colony numbers", "cells of one colony")
    if like is not None:
        has, other = _columns(made), _columns(like)
        if has != other or made.dim != like.dim:
            raise checks.InputError(
                f"{name} gives {made.dim}-D cells with the columns {', '.join(sorted(has))};"
                f" founders(0) gave {like.dim}-D cells with {', '.join(sorted(other))}. All must"
                " have the same."
            )
    return made


def drawn(draw: Draw, seed: int, streams: Sequence[int], like: Cells) -> Cells:
    """The founders of colonies that follow these streams of a seed, each by a seed of its own.
    Colonies of one stream have the same."""
    each = {s: one_draw(draw, _seed_of(seed, s), like) for s in dict.fromkeys(streams)}
    found = [each[s] for s in streams]
    joined = lambda name: np.concatenate([getattr(cells, name) for cells in found])
    return Cells(
        joined("position"),
        joined("axis"),
        joined("length"),
        joined("radius"),
        cell_type=None if like.cell_type is None else joined("cell_type"),
        colony=np.repeat(np.arange(len(found)), [cells.count for cells in found]),
        extra={n: np.concatenate([cells.extra[n] for cells in found]) for n in like.extra},
    )


def _columns(cells: Cells) -> set[str]:
    return {"position", *cells.extra, *(["cell_type"] if cells.cell_type is not None else [])}


def _seed_of(seed: int, stream: int) -> int:
    """A seed for a stream of a seed, below 2³²."""
    return int(np.random.SeedSequence([seed, stream]).generate_state(1)[0])
