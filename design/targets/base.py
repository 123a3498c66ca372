"""What a target is: a pattern wanted of a colony, and the score of how far a colony is from it."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

import torchfilm as tf
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# a signal where the cell is, "out.ahl", beside what the cell itself holds under that name
OUTSIDE = "out."


class Target:
    """A pattern wanted. Its ready kinds are frozen dataclasses whose parameters are checked when
    they are made.

    A loss is one number for each colony: 0 is perfect and, for the ready targets, 1 the worst; a
    colony that failed scores `failed`. It follows from that colony's own cells alone, whatever else
    is in the batch, and carries gradients to the levels in the cells; places, types and volumes
    count as given.
    """

    failed: ClassVar[float] = 1.5

    @property
    def names(self) -> tuple[str, ...]:
        """The species that it looks at, for pictures."""
        return ()

    def check(self, state: tf.State) -> None:
        """Raises `tf.InputError` if a first state has not what the target looks at."""

    def note(self, state: tf.State) -> Tensor | None:
        """What to keep of a state after every step, (B, k), for a target that needs the history;
        None: nothing."""
        return None

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """How far each colony is from the pattern, (B,) float64. history: the notes, (T, B, k)."""
        raise NotImplementedError(f"{type(self).__name__}.loss")

    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """What a person wants to know of the pattern that is there, (B,) by name; NaN where there
        is no such number."""
        return {}

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        """Draw what is wanted of the colony at `place` of the batch on axes that show that colony,
        in µm."""

    def describe(self) -> str:
        """The pattern in one line."""
        return type(self).__name__


def known(state: tf.State) -> list[str]:
    """What a target can look at: fields with one number a cell, and signals as "out.NAME"."""
    fields = [
        name
        for name, value in state.fields.items()
        if state.declared[name].scope == "cell" and value.dim() == 1
    ]
    return [*fields, *(OUTSIDE + name for name in state.signals)]


def require(state: tf.State, names: tuple[str, ...]) -> None:
    """Raises `tf.InputError` for the first name that the state does not know."""
    there = known(state)
    for name in names:
        if name not in there:
            near = difflib.get_close_matches(name, there, 1, cutoff=0.5)
            hint = f"Did you mean {near[0]!r}?" if near else ""
            raise checks.input_error(
                "species",
                name,
                (
                    "one of " + ", ".join(map(repr, there))
                    if there
                    else "a species of a Circuit; the scene has none"
                ),
                hint,
            )


def levels(state: tf.State, name: str) -> Tensor:
    """A field of the cells by its name, or, as "out.NAME", a signal where each cell is: (N,), with
    its gradient."""
    require(state, (name,))
    if not name.startswith(OUTSIDE):
        return state.fields[name]
    contact = state.contact()
    assert contact is not None  # a state that knows a signal has a medium
    return contact.found[name.removeprefix(OUTSIDE)]


def valid_levels(state: tf.State, names: tuple[str, ...]) -> tuple[Tensor, Tensor]:
    """Levels of several species, (N, k) float64, none below 0, and which colonies can be scored,
    (B,) bool: those with cells, all of whose levels are finite.

    A level that is not finite counts as 0, so that no NaN gets into a sum or a gradient.
    """
    found = torch.stack([levels(state, name).double() for name in names], 1)
    finite = torch.isfinite(found)
    sound = (state.counts > 0) & ~state.groups.any(~finite.all(1))
    return torch.where(finite, found, 0.0).clamp(min=0.0), sound


def weights(state: tf.State) -> Tensor:
    """What each cell counts for: its volume, (N,) float64 µm³, without gradient."""
    return state.volume.detach().double()


def total(state: tf.State, value: Tensor) -> Tensor:
    """The sum over each colony of (N,) or (N, k): (B,) or (B, k)."""
    return (
        state.groups.sum(value.unsqueeze(1)).squeeze(1)
        if value.dim() == 1
        else state.groups.sum(value)
    )


def ratio(above: Tensor, below: Tensor, otherwise: float) -> Tensor:
    """above/below, and `otherwise`, with zero gradient, where below is 0."""
    some = below > 0
    return torch.where(some, above / torch.where(some, below, 1.0), otherwise)


def species_name(name: str, given: object) -> None:
    """Raises `tf.InputError` unless this may be the name of a species or signal."""
    if not isinstance(given, str) or not given.removeprefix(OUTSIDE).isidentifier():
        raise checks.input_error(
            name, given, 'the name of a species, such as "yfp", or of a signal, such as "out.ahl"'
        )


def species_names(name: str, given: object, count: int | None = None) -> tuple[str, ...]:
    """Several different species as a tuple."""
    wanted = f"{'some' if count is None else count} different names of species"
    if (
        isinstance(given, str)
        or not isinstance(given, (tuple, list))
        or not given
        or (count is not None and len(given) != count)
    ):
        raise checks.input_error(name, given, wanted, 'Write ("cfp", "yfp").')
    for one in given:
        species_name(name, one)
    if len(set(given)) != len(given):
        raise checks.input_error(name, given, wanted)
    return tuple(given)
