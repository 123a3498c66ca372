"""The base class of targets, and what targets share: levels, weights, sums over a colony."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

import torchfilm as tf
from torchfilm import checks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# "out.ahl" is the signal at the cell; "ahl" is the level inside the cell
OUTSIDE = "out."
# The loss of a failed colony: where losses have no upper limit, and where they end at 1.
WORST, FAILED = 1e9, 1.5
FAR = 100.0  # spreads, from which on losses grow linearly; those beyond MOST count as so far
MOST = 1e5
# A target may read these, and what serves the numerics, but they are none to offer.
OF_DIVISION = ("division_threshold", "birth_length")


class Target(metaclass=checks.KnownKeywords):
    """A pattern that a colony should have. The ready targets are frozen dataclasses that check
    their parameters when they are made.

    The loss of a colony is a number: 0 is perfect and, for most ready targets, 1 is the worst. A
    colony that failed scores `failed`; so does one whose loss is above that, which counts as a
    failure. The loss depends on the cells of that colony alone, not on its batch. It has gradients
    with respect to the levels in the cells, but not to places, types and volumes; a target of
    yours that has them says so by `differentiable = True` (a subclass of a ready one has that
    already: say False where your loss passes none).
    """

    failed: ClassVar[float] = WORST
    # cells: a smaller colony is not scored; 0: one in which all cells have died is
    fewest: ClassVar[int] = 1
    # whether answers without a pattern, such as evenly lit cells, say what a loss is worth
    pattern: ClassVar[bool] = True
    # whether each of its residuals is the same number of every colony, such as a mean
    comparable: ClassVar[bool] = False
    # whether the columns that it notes differ in number from step to step
    ragged: ClassVar[bool] = False
    # whether the loss has exact derivatives by what cells contain, for descents
    differentiable: ClassVar[bool] = False
    # whether it asks how many cells are lit, and not which
    anywhere: ClassVar[bool] = False

    @property
    def names(self) -> tuple[str, ...]:
        """The species that the target reads, for pictures."""
        return ()

    @property
    def times(self) -> tuple[float, ...]:
        """Times, h, at which it must see a colony after a step, beside the end."""
        return ()

    @property
    def first_time(self) -> float:
        """The time, h, before which it has seen nothing of a colony; 0 where it looks at the end
        only."""
        return min(self.times, default=0.0)

    @property
    def arguments(self) -> tuple[Mapping[str, float], ...]:
        """Under which arguments of the scene each replicate of a design is grown, one colony under
        each; those of one have ids side by side."""
        return ({},)

    def label(self, place: int) -> str:
        """One of the `arguments`, in words."""
        return ""

    def caption(self, colony_id: int) -> str:
        """What a colony of a design is, in words."""
        replicate, place = divmod(colony_id, len(self.arguments))
        under = self.label(place)
        return f"{under}, replicate {replicate}" if under else f"replicate {replicate}"

    def concerns(self, measure: str, state: tf.State) -> Tensor:
        """Which colonies a measure is of, (B,) bool."""
        return torch.ones(state.colonies, dtype=torch.bool, device=state.device)

    def check(self, state: tf.State) -> None:
        """Raises `tf.InputError` where a first state lacks something that the target reads."""

    def unfit(self, state: tf.State) -> list[str]:
        """Why each colony of full size cannot be scored, "" where it can: it lacks cells of which
        the target speaks, so that its loss would say nothing. Such a colony has failed."""
        return [""] * state.colonies

    def note(self, state: tf.State) -> Tensor | None:
        """What a target that needs the history keeps of a state after every step, (B, k), where k
        is the same at every step, unless the target is `ragged`; None: nothing."""
        return None

    def course(self, state: tf.State) -> Tensor | None:
        """What `residuals` needs of a state after every step, (B, k): the columns of `note`, and
        more, whose number may change from step to step. It is asked where derivatives are."""
        return self.note(state)

    def kept(self, state: tf.State) -> float:
        """How many numbers `course` keeps of each cell after every step, as told by a first state:
        the memory of a batch depends on them. 0 where they do not grow with the colony."""
        return 0.0

    def loss(self, state: tf.State, history: Tensor | None = None) -> Tensor:
        """The loss of each colony, (B,) float64. history: the notes of all steps, (T, B, k)."""
        raise NotImplementedError(f"{type(self).__name__}.loss")

    def residuals(self, state: tf.State, history: Tensor | None = None) -> Tensor | None:
        """Numbers whose squares add up to the loss, (B, K) float64 with 0 where a colony has fewer,
        with gradients as the loss has; None where a target has no such form. Least squares use
        them. history: what `course` gave after all steps, (T, B, k), 0 where a step had fewer
        columns."""
        return None

    @property
    def squares(self) -> bool:
        """Whether the loss is a sum of squares, so that there are `residuals`."""
        return type(self).residuals is not Target.residuals

    def why_rough(self, state: tf.State) -> str:
        """Why the loss has no exact derivatives by what cells contain, as a first state shows; ""
        where it has."""
        own = f"a target of your own may pass no gradient ({type(self).__name__}.differentiable)"
        return "" if self.differentiable else own

    def reduced(self, losses: np.ndarray) -> np.ndarray | None:
        """One loss for each design, (n,), from those of its replicates (n, R); None: as the task
        says."""
        return None

    def remark(self, loss: np.ndarray) -> str:
        """What the losses of a first batch (n,) should make a user reconsider; "" mostly."""
        return ""

    @property
    def mark(self) -> str:
        """What `draw` shows, in words, such as "red lines"; "" where it draws nothing."""
        return ""

    @property
    def lit_from(self) -> dict[str, float]:
        """The level from which a cell counts as lit, by species, where the target has one: the
        range of colours of pictures reaches it, so that dark cells look dark."""
        return {}

    @property
    def strains(self) -> str | None:
        """The field by which the target tells strains apart, where it does: pictures show it where
        the target reads no species."""
        return None

    @property
    def bounds(self) -> dict[str, str]:
        """The constraints on measures, such as "≥ 10", where the target has some."""
        return {}

    @property
    def evidence(self) -> dict[str, tuple[float, float]]:
        """What was observed of each measure, and its spread, where the target is data."""
        return {}

    def misses(self, found: Mapping[str, float]) -> dict[str, float]:
        """By how many spreads each of these measures is off, where the target has spreads."""
        seen = self.evidence.items()
        return {n: abs(found[n] - value) / by for n, (value, by) in seen if n in found}

    def measures(self, state: tf.State, history: Tensor | None = None) -> dict[str, Tensor]:
        """Measures of the pattern that a colony has, (B,) by name; NaN where one is not
        defined."""
        return {}

    def why_undefined(self, measure: str) -> str:
        """What a colony lacks in which this measure is NaN, and what to do; "" for a measure that
        the target does not have, or that is never NaN."""
        return ""

    def reaches(self, state: tf.State) -> Tensor:
        """Whether a colony reaches the place of the pattern, (B,) bool: else it has the same loss,
        whatever its cells do."""
        return torch.ones(state.colonies, dtype=torch.bool, device=state.device)

    def draw(self, ax: Axes, state: tf.State, place: int, history: Tensor | None = None) -> None:
        """Draw the target of the colony at `place` of the batch, on axes that show that colony, in
        µm."""

    def describe(self) -> str:
        """The pattern in one line."""
        return type(self).__name__


def of_one_condition(name: str, part: Target) -> None:
    """Raises `tf.InputError` for a part that is grown under several conditions."""
    if len(part.arguments) > 1:
        rule = "a target under one condition"
        hint = "Conditions stand outermost, and take single targets."
        raise checks.input_error(f"{name}: a target", part.describe(), rule, hint)


def ended_elsewhere(state: tf.State, time: float | None) -> str:
    """Why colonies that ended now cannot be compared with data of a `time`, h; "" where they
    can."""
    if time is None or abs(state.time - time) <= 1e-6 * time:
        return ""
    return f"it ended at {state.time:g} h, and was observed at {time:g} h: set until"


def known(state: tf.State) -> list[str]:
    """The names that a target can read: fields with one number for each cell, and signals as
    "out.NAME"."""
    fields = [
        name
        for name, value in state.fields.items()
        if state.declared[name].scope == "cell" and value.dim() == 1
    ]
    return [*fields, *(OUTSIDE + name for name in state.signals)]


def require(state: tf.State, names: tuple[str, ...]) -> None:
    """Raises `tf.InputError` for the first name that the state does not have."""
    there = known(state)
    for name in names:
        if name not in there:
            offered = [n for n in there if n not in OF_DIVISION and not state.declared[n].internal]
            near = difflib.get_close_matches(name, offered, 1, cutoff=0.5)
            hint = f"Did you mean {near[0]!r}?" if near else ""
            raise checks.input_error(
                "species",
                name,
                (
                    "one of " + ", ".join(map(repr, offered))
                    if offered
                    else "a species of a Circuit; the scene has none"
                ),
                hint,
            )


def levels(state: tf.State, name: str) -> Tensor:
    """A field of the cells, or, as "out.NAME", a signal at each cell: (N,), with its
    gradient."""
    require(state, (name,))
    if not name.startswith(OUTSIDE):
        return state.fields[name]
    contact = state.contact()
    assert contact is not None  # a state with a signal has a medium
    return contact.found[name.removeprefix(OUTSIDE)]


def valid_levels(state: tf.State, names: tuple[str, ...]) -> tuple[Tensor, Tensor]:
    """Levels of several species, (N, k) float64, none below 0, and which colonies can be scored,
    (B,) bool: those that have cells and whose levels are all finite.

    A level that is not finite counts as 0, so that no sum or gradient becomes NaN.
    """
    found = torch.stack([levels(state, name).double() for name in names], 1)
    finite = torch.isfinite(found)
    sound = (state.counts > 0) & ~state.groups.any(~finite.all(1))
    return torch.where(finite, found, 0.0).clamp(min=0.0), sound


def weights(state: tf.State) -> Tensor:
    """The weight of each cell: its volume, (N,) float64 µm³, without gradient."""
    return state.volume.detach().double()


def total(state: tf.State, value: Tensor) -> Tensor:
    """The sum over each colony of (N,) or (N, k): (B,) or (B, k)."""
    return state.groups.sum(value)


def rows_of_colonies(state: tf.State, value: Tensor) -> Tensor:
    """(N, k) as one row for each colony, (B, k · most cells), 0 beyond a colony's own cells."""
    most, columns = int(state.counts.max()), value.shape[1]
    first = torch.cumsum(state.counts, 0) - state.counts
    within = torch.arange(state.cells, device=value.device) - first.index_select(0, state.colony)
    flat = value.new_zeros(state.colonies * most, columns)
    flat = flat.index_copy(0, state.colony * most + within, value)
    return flat.reshape(state.colonies, most * columns)


def ratio(above: Tensor, below: Tensor, otherwise: float) -> Tensor:
    """above/below; where below is 0, `otherwise` with zero gradient."""
    some = below > 0
    return torch.where(some, above / torch.where(some, below, 1.0), otherwise)


def contrast(inside: Tensor, outside: Tensor) -> Tensor:
    """inside/outside; infinite where nothing is lit outside, and NaN where nothing is inside
    either."""
    dark = torch.where(inside > 0, torch.inf, torch.nan).to(inside.dtype)
    return torch.where(outside == 0, dark, ratio(inside, outside, math.nan))


def species_name(name: str, given: object) -> None:
    """Raises `tf.InputError` unless this can be the name of a species or signal."""
    if not isinstance(given, str) or not given.removeprefix(OUTSIDE).isidentifier():
        raise checks.input_error(
            name, given, 'the name of a species, such as "yfp", or of a signal, such as "out.ahl"'
        )


def beyond(found: Tensor, wanted: Sequence[tuple[float, float]]) -> Tensor:
    """By how much numbers (B, K) are off these ranges; 0 within one, without a slope."""
    low, high = (found.new_tensor(x) for x in zip(*wanted, strict=True))
    near = torch.minimum(torch.maximum(found.detach(), low), high)
    inside = (low < high) & (low <= found) & (found <= high)
    return torch.where(inside, 0.0, found - near)


def huber(apart: Tensor) -> Tensor:
    """Residuals of these differences in spreads: they are the same up to FAR, and beyond it their
    squares grow linearly (Huber, Ann. Math. Stat. 35, 73, 1964), so that a search knows the way
    back. A square is at most a fiftieth of a failed loss."""
    size = apart.abs().clamp(max=MOST)
    beyond = FAR * (2.0 * size.clamp(min=FAR) / FAR - 1.0).sqrt()
    return torch.where(size > FAR, apart.sign() * beyond, apart)


def check_squares(
    target: Target, state: tf.State, history: Tensor | None, loss: np.ndarray, first: Any, good: Any
) -> None:
    """Raises TypeError, as this is no fault of a design, where the squares of the residuals of a
    target of the user's do not add up to its loss: least squares would lead elsewhere.

    loss: (n,) of the colonies `first` (n,), of which those that count are `good` (n,). Residuals of
    a course are not looked at."""
    own = type(target).__module__.split(".")[0] != "design"
    if not (own and target.squares and type(target).course is Target.course and good.any()):
        return
    found, name = target.residuals(state, history), type(target).__name__
    if found is None:
        return
    if not isinstance(found, Tensor) or found.dim() != 2 or len(found) != state.colonies:
        raise TypeError(f"{name}.residuals must return a tensor of shape ({state.colonies}, K)")
    squares = found.detach().double().square().sum(1).cpu().numpy()[first]
    bad = good & ~(np.abs(squares - loss) <= 1e-4 * np.maximum(1.0, np.abs(loss)))
    if bad.any():
        at = int(bad.argmax())
        raise TypeError(
            f"{name}.residuals: their squares add up to {squares[at]:g} in a colony with a loss of"
            f" {loss[at]:g}. They must add up to the loss; a loss that has no such form has"
            " residuals that return None."
        )


def requiring_gradients(state: tf.State, names: Iterable[str]) -> tf.State:
    """A copy of a state whose fields of these names require a gradient, if they are numbers with
    one."""
    there = ((n, state.fields[n]) for n in names if n in state.fields)
    moved = {n: x.detach().clone().requires_grad_() for n, x in there if x.is_floating_point()}
    return state.with_fields(**moved)


def species_names(name: str, given: object, count: int | None = None) -> tuple[str, ...]:
    """Several different species as a tuple. Raises `tf.InputError` for anything else."""
    rule = f"{'some' if count is None else count} different names of species"
    if (
        isinstance(given, str)
        or not isinstance(given, (tuple, list))
        or not given
        or (count is not None and len(given) != count)
    ):
        raise checks.input_error(name, given, rule, 'Write ("cfp", "yfp").')
    for one in given:
        species_name(name, one)
    if len(set(given)) != len(given):
        raise checks.input_error(name, given, rule)
    return tuple(given)


def inner_targets(target: object) -> tuple[Any, ...]:
    """The targets that a target is made of, or data."""
    several = (*getattr(target, "parts", ()), *getattr(target, "frames", ()))
    one = (getattr(target, name, None) for name in ("target", "conditions", "measured"))
    return (*several, *(x for x in one if x is not None))
