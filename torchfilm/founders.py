"""The cells that colonies start from: given once, or drawn for each colony."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchfilm.initial_cells import Cells
from torchfilm.tools import checks
from torchfilm.tools.one_per_colony import by_position
from torchfilm.tools.tangents import tracked
from torchfilm.values import PerColony

if TYPE_CHECKING:
    from torchfilm.scene import Scene


def checked_type_names(names: Sequence[str], founders: Cells) -> tuple[str, ...]:
    """The names of the types of cells. Raises InputError for what are none, and where the founders
    have no types."""
    rule = 'names of the types 0, 1, …, such as ("sender", "receiver")'
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise checks.input_error("Scene.type_names", names, rule)
    for k, name in enumerate(names):
        if not isinstance(name, str) or not name.strip() or "\n" in name:
            raise checks.input_error(f"Scene.type_names[{k}]", name, "a name, as text in one line")
        if name in names[:k]:
            raise checks.input_error(f"Scene.type_names[{k}]", name, "another name than the others")
    if names and founders.cell_type is None:
        hint = "Write type_names=(), or give types: tf.inoculum(20, 10.0, types={0: 0.5, 1: 0.5})."
        raise checks.input_error(
            "Scene.type_names", tuple(names), "left out: the founders have no cell_type", hint
        )
    return tuple(names)


class Founders:
    """Founders that a function draws for each colony, by numbers that may differ between colonies:

        def mixed(seed, share):
            return tf.inoculum(30, radius=15.0, types={0: 1 - share, 1: share}, seed=seed)

        tf.Scene(…, founders=tf.Founders(mixed, share=[0.1, 0.5, 0.9]))

    function: called once for each colony, `function(seed, **values)`, with a seed of the colony's
    stream of random numbers; returns the tf.Cells of one colony. All colonies must have the same
    columns (cell types, extra variables), but may differ in their number of cells. values: by name;
    a list, an array or a 1-D tensor is one value per colony, and anything else is for all. Colonies
    of one stream get one seed, so that they differ by these values alone. Raises InputError for a
    function that does not take them, for lists of different lengths, and for values with gradients.
    """

    def __init__(self, function: Callable[..., Cells], /, **values: Any):
        rule = "Cells, or a function from a seed to Cells"
        if not callable(function) or isinstance(function, type):
            hint = "Such as tf.Cells.single(2), or tf.inoculum(…) for several."
            raise checks.input_error("Scene.founders", function, rule, hint)
        try:
            inspect.signature(function).bind(0, **values)
        except TypeError as error:
            rule = "a function of one number, the seed of the colony"
            hint = (
                "For numbers that differ between colonies: tf.Founders(function, share=[0.1, 0.9])."
            )
            if values:
                rule = f"a function of a seed and of {', '.join(values)}"
                hint = f"Such as def founders(seed, {', '.join(values)}): … Python says: {error}."
            raise checks.input_error("founders", function, rule, hint) from error
        except ValueError:  # of a function that does not say what it takes
            pass
        self.function = function
        self.values: dict[str, Any] = {n: _each(n, x) for n, x in values.items()}
        sizes = {name: len(x) for name, x in self.values.items() if isinstance(x, list)}
        if len({*sizes.values()}) > 1:
            given = ", ".join(f"{size} of {name}" for name, size in sizes.items())
            raise checks.input_error("Founders", given, "as many values per colony of each")
        # of how many colonies; None where it may be any number
        self.colonies: int | None = next(iter(sizes.values()), None)

    def __repr__(self) -> str:
        own = [f"{name}={x!r}" for name, x in self.values.items()]
        return f"Founders({', '.join([getattr(self.function, '__name__', 'function'), *own])})"

    @property
    def decided_by(self) -> tuple[Any, ...]:
        """What decides the cells, for a digest."""
        return (self.function, self.values) if self.values else (self.function,)

    def per_colony(self) -> list[tuple[str, Tensor]]:
        """The numbers that differ between colonies, (B,) each, by name: "Founders.share"."""
        lists = {n: x for n, x in self.values.items() if isinstance(x, list)}
        return [
            (f"Founders.{name}", torch.tensor(x, dtype=torch.float64))
            for name, x in lists.items()
            if all(isinstance(one, bool | int | float) for one in x)
        ]

    def words(self) -> dict[str, list[str]]:
        """The texts that differ between colonies, by name: "Founders.kind"."""
        lists = {f"Founders.{n}": x for n, x in self.values.items() if isinstance(x, list)}
        return {n: x for n, x in lists.items() if all(isinstance(one, str) for one in x)}

    def check_colonies(self, count: int) -> None:
        """Raise InputError unless there is a value for each of so many colonies."""
        if self.colonies not in (None, count):
            rule = f"one value for each of the {count} colonies of the batch"
            names = ", ".join(n for n, x in self.values.items() if isinstance(x, list))
            given = f"{self.colonies} values per colony of {names}"
            raise checks.input_error("Founders", given, rule)

    def one(self, seed: int, colony: int = 0, like: Cells | None = None) -> Cells:
        """The founders of a colony from a seed. Raises InputError unless they are cells of one
        colony, with the columns of others."""
        own = {n: x[colony] if isinstance(x, list) else x for n, x in self.values.items()}
        name = f"founders({', '.join([str(seed), *(f'{n}={x!r}' for n, x in own.items())])})"
        try:
            made = self.function(seed, **own)
        except checks.InputError as error:
            where = f" In {name}, for colony {colony}." if self.values else ""
            raise type(error)(f"{error}{where}") from error
        if not isinstance(made, Cells):
            raise checks.input_error(name, made, "Cells, such as tf.inoculum(12, 10.0, seed=seed)")
        if made.colony is not None:
            raise checks.input_error(name, "cells with colony numbers", "cells of one colony")
        if like is not None:
            has, other = _columns(made), _columns(like)
            if has != other or made.dim != like.dim:
                raise checks.InputError(
                    f"{name} gives {made.dim}-D cells with the columns {', '.join(sorted(has))};"
                    f" those of colony 0 from seed 0 are {like.dim}-D with"
                    f" {', '.join(sorted(other))}. All must have the same."
                )
        return made

    def of_streams(self, seed: int, streams: Sequence[int], like: Cells) -> Cells:
        """The founders of colonies that follow these streams of a seed, each by a seed of its own.
        Colonies of one stream and with the same values have the same."""
        made: dict[int, Cells] = {}
        found = []
        for colony, stream in enumerate(streams):
            key = stream if self.colonies is None else colony
            if key not in made:
                made[key] = self.one(_seed_of(seed, stream), colony, like)
            found.append(made[key])
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


@dataclass(frozen=True)
class FirstCells:
    """From what a batch starts: seed, streams (B,) or None, and the cells of a scene, or others
    that are given in their place."""

    colonies: int
    seed: int
    streams: Tensor | None
    scene: Scene
    given: Cells | None

    def __post_init__(self) -> None:
        if self.scene.draw is not None and self.given is None:
            self.scene.draw.check_colonies(self.colonies)

    @cached_property
    def cells(self) -> Cells:
        draw, given = self.scene.draw, self.given
        if given is not None or draw is None:
            return self.scene.founders if given is None else given
        streams = range(self.colonies) if self.streams is None else self.streams.tolist()
        return draw.of_streams(self.seed, streams, self.scene.founders)


def checked_streams(given: Sequence[int] | Tensor | None, colonies: int) -> Tensor | None:
    """Which stream each colony follows, (B,) int64; None for its own. Raises InputError."""
    if given is None:
        return None
    found = torch.as_tensor(by_position(given))
    integers = not (found.is_floating_point() or found.dtype == torch.bool)
    if found.shape != (colonies,) or not integers or bool(((found < 0) | (found >= 2**32)).any()):
        raise checks.input_error(
            "streams",
            given,
            f"{colonies} integers from 0 to 2³² − 1, one for each colony",
            f"Give colonies={len(found)}, too." if colonies == 1 < found.numel() else "",
        )
    return found.to(torch.int64)


def _each(name: str, given: Any) -> Any:
    """A value as founders are told it: a list of one per colony, or what is for all."""
    if isinstance(given, PerColony):
        given = given.values
    if isinstance(given, Tensor) and tracked(given):
        rule = "numbers without gradients"
        hint = "Where colonies start has no derivatives: search this one without them."
        raise checks.input_error(f"Founders.{name}", "a tensor that requires gradients", rule, hint)
    if isinstance(given, Tensor):
        given = given.cpu().numpy()
    if isinstance(given, np.ndarray):
        if given.dtype == np.float32:  # the decimals that were typed, 0.1 and not 0.10000000149
            given = given.astype(str).astype(np.float64)
        given = given.tolist()
    if not isinstance(given, list):
        return given
    if not given:
        raise checks.input_error(f"Founders.{name}", given, "a value for each colony")
    found = [x.item() if isinstance(x, Tensor | np.generic) else x for x in given]
    if nested := [x for x in found if isinstance(x, list)]:
        rule = "one value for each colony"
        hint = "A list that is for all colonies: write it as a tuple."
        raise checks.input_error(
            f"Founders.{name}[{found.index(nested[0])}]", nested[0], rule, hint
        )
    return found


def _columns(cells: Cells) -> set[str]:
    return {"position", *cells.extra, *(["cell_type"] if cells.cell_type is not None else [])}


def _seed_of(seed: int, stream: int) -> int:
    """A seed for a stream of a seed, below 2³²."""
    return int(np.random.SeedSequence([seed, stream]).generate_state(1)[0])
