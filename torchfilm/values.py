"""Physical values: one way to give a parameter of any effect, and one way to look it up.

| given                        | meaning                                                           |
|------------------------------|-------------------------------------------------------------------|
| `1.0`                        | the same for all cells of all colonies                            |
| a list, array or 1-D tensor  | one value per colony, by the colony's id                          |
| `{0: 0.6, 1: 1.2}`           | one value per cell type                                           |
| `tf.LogNormal(1.0, 0.2)`     | drawn for each cell at birth, by random numbers keyed by the cell |
| `tf.PerColony([…])`          | one value per colony, where a list could also mean cell types     |

A description holds what was given, checked. Binding a scene to a batch resolves it once: `Resolved`
holds tensors of the batch's dtype on its device, copied, so that a tensor that is changed later in
place does not change a bound model.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchfilm.state import Field, State
from torchfilm.tools import checks

CELL, COLONY = "cell", "colony"


@dataclass(frozen=True)
class Batch:
    """What a scene is bound to: `colonies` colonies, the cell `types` of their founders, dtype and
    device.

    per_colony: lists and tensors are one value per colony, also where their length could mean cell
    types.
    """

    colonies: int
    dtype: torch.dtype
    device: torch.device
    types: tuple[int, ...] = ()
    per_colony: bool = False


@dataclass(frozen=True, eq=False)
class PerColony:
    """One value per colony, stated: `tf.PerColony([0.6, 1.2])`."""

    values: Tensor | Sequence[float]


@dataclass(frozen=True, eq=False)
class ByType:
    """One value per cell type: a number, one per colony, or a distribution."""

    values: Mapping[int, Any]

    @property
    def is_drawn(self) -> bool:
        """Whether some type's value is drawn for each cell."""
        return any(isinstance(v, Distribution) for v in self.values.values())

    def __repr__(self) -> str:
        return repr(dict(self.values))


@dataclass(frozen=True)
class Rule:
    """What a physical value may be: its unit, its bounds, and whether it belongs to a cell or to a
    colony."""

    unit: str = ""
    above: float = -math.inf
    least: float = -math.inf
    most: float = math.inf
    scope: str = CELL
    # whether the effect itself draws from a distribution, and when; else each cell's value is a
    # field drawn at birth
    drawn_by_effect: bool = False


def physical(default: Any = dataclasses.MISSING, **rule: Any) -> Any:
    """A field of an effect that holds a physical value: `rate: Value = physical(1.0, unit="1/h",
    least=0.0)`."""
    return field(default=default, metadata={"physical": Rule(**rule)})


def checked(name: str, given: object, rule: Rule) -> Any:
    """A physical value as an effect keeps it: a float, a 1-D tensor, `ByType`, `PerColony` or a
    `Distribution`.

    Raises InputError for what `rule` does not allow.
    """
    bounds: dict[str, Any] = {"above": rule.above, "least": rule.least, "most": rule.most}
    if isinstance(given, ByType):
        given = given.values
    if isinstance(given, (Distribution, Mapping)) and rule.scope == COLONY:
        kind = (
            "a distribution over cells"
            if isinstance(given, Distribution)
            else "one value per cell type"
        )
        raise checks.input_error(
            name, given, f"one number, or one per colony; {kind} has no meaning for it"
        )
    if isinstance(given, Distribution):
        checks.number(f"smallest value of {name}", given.least(), **bounds)
        checks.number(f"largest value of {name}", given.greatest(), **bounds)
        return given
    if isinstance(given, Mapping):
        for kind in given:
            if isinstance(kind, bool) or not isinstance(kind, int) or kind < 0:
                raise checks.input_error(
                    f"{name}, cell type", kind, "an integer from 0", "Write {0: 0.6, 1: 1.2}."
                )
        if not given:
            raise checks.input_error(
                name, dict(given), "one value for each cell type, such as {0: 0.6, 1: 1.2}"
            )
        each = dataclasses.replace(rule)
        return ByType(
            {kind: checked(f"{name}[{kind}]", value, each) for kind, value in given.items()}
        )
    if isinstance(given, PerColony):
        inner = checks.value(name, given.values, **bounds)
        if not isinstance(inner, Tensor) or inner.dim() != 1:
            raise checks.input_error(name, given, "a list or 1-D tensor with one number per colony")
        return PerColony(inner)
    return checks.value(name, given, **bounds)


def numbers(value: Any) -> Tensor:
    """All numbers of a checked value that is not drawn, as a float64 tensor: to find its smallest
    and largest."""
    if isinstance(value, ByType):
        return torch.cat([numbers(v).reshape(-1) for v in value.values.values()])
    if isinstance(value, Distribution):
        return torch.tensor([value.least(), value.greatest()], dtype=torch.float64)
    inner = value.values if isinstance(value, PerColony) else value
    return torch.as_tensor(inner, dtype=torch.float64).detach().reshape(-1)


def smallest(value: Any) -> float:
    """The smallest number that a checked value can be."""
    return float(numbers(value).min())


def largest(value: Any) -> float:
    """The largest number that a checked value can be."""
    return float(numbers(value).max())


def is_drawn(value: Any) -> bool:
    """Whether a checked value is drawn for each cell."""
    return isinstance(value, Distribution) or (isinstance(value, ByType) and value.is_drawn)


def is_inherited(value: Any) -> bool:
    """Whether daughters keep the value that was drawn for their parent."""
    drawn = (
        [value]
        if isinstance(value, Distribution)
        else [v for v in value.values.values() if isinstance(v, Distribution)]
    )
    return all(d.inherited for d in drawn)


# --- what binding makes of it ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Resolved:
    """A value of one batch. `value`: 0-dim, or (B,) by colony id, or for cell types (T,) or (T, B);
    None where it is drawn at birth and kept in the field `field`. types: (T,) int64, ascending.
    draw: how it is drawn.
    """

    name: str
    value: Tensor | None = None
    types: Tensor | None = None
    draw: BoundDraw | None = None
    field: str | None = None

    def of_colonies(self, state: State) -> Tensor:
        """0-dim, or (B,) for the colonies of a state."""
        assert self.value is not None and self.types is None
        return self.value if self.value.dim() == 0 else self.value.index_select(0, state.colony_id)

    def of_cells(self, state: State) -> Tensor:
        """0-dim, or (N,) for the cells of a state."""
        if self.field is not None:
            return state.fields[self.field]
        if self.types is not None:
            return self._by_type(state, state.fields["cell_type"], None)
        found = self.of_colonies(state)
        return found if found.dim() == 0 else found.index_select(0, state.colony)

    def of_rows(self, state: State, rows: Tensor, purpose: str | None = None) -> Tensor:
        """(M,) for the cells `rows` (M,); drawn now where the value is a distribution, by the key
        `purpose`."""
        if self.draw is not None:
            return self.draw(state, rows, purpose or self.name)
        if self.types is not None:
            return self._by_type(state, state.fields["cell_type"].index_select(0, rows), rows)
        found = self.of_cells(state)
        return found.expand(rows.numel()) if found.dim() == 0 else found.index_select(0, rows)

    def _by_type(self, state: State, kind: Tensor, rows: Tensor | None) -> Tensor:
        assert self.types is not None and self.value is not None
        place = torch.searchsorted(self.types, kind).clamp(max=self.types.numel() - 1)
        wrong = self.types.index_select(0, place) != kind
        if bool(wrong.any()):
            raise _missing_type(self.name, int(kind[wrong][0]), self.types.tolist())
        if self.value.dim() == 1:
            return self.value.index_select(0, place)
        ids = state.own_colony_id if rows is None else state.own_colony_id.index_select(0, rows)
        return self.value[place, ids]

    @property
    def requires_grad(self) -> bool:
        return self.value is not None and self.value.requires_grad

    @cached_property
    def is_zero(self) -> bool:
        """Whether it is the plain number 0."""
        value = self.value
        return (
            value is not None and value.dim() == 0 and not self.requires_grad and float(value) == 0
        )


@dataclass(frozen=True, eq=False)
class BoundDraw:
    """How the values of cells are drawn: by one distribution, or by one value for each cell
    type."""

    name: str
    parts: tuple[
        tuple[int | None, Any], ...
    ]  # (cell type or None, Resolved or (Distribution, its resolved parameters))

    def __call__(self, state: State, rows: Tensor, purpose: str) -> Tensor:
        """(M,) for the cells `rows` (M,)."""
        if self.parts[0][0] is None:
            return self._part(self.parts[0][1], state, rows, purpose)
        kind = state.fields["cell_type"].index_select(0, rows)
        known = torch.zeros_like(kind, dtype=torch.bool)
        out = torch.zeros(rows.numel(), dtype=state.dtype, device=state.device)
        for number, part in self.parts:
            mine = torch.eq(kind, int(number or 0))
            known = known | mine
            out = torch.where(mine, self._part(part, state, rows, purpose), out)
        if not bool(known.all()):
            raise _missing_type(self.name, int(kind[~known][0]), [n for n, _ in self.parts])
        return out

    @staticmethod
    def _part(part: Any, state: State, rows: Tensor, purpose: str) -> Tensor:
        if isinstance(part, Resolved):
            return part.of_rows(state, rows)
        distribution, values = part
        return distribution.draw(state, rows, purpose, values)


def _missing_type(name: str, kind: int, known: Sequence[Any]) -> checks.InputError:
    listed = ", ".join(map(str, known))
    return checks.InputError(
        f"{name} has values for the cell types {listed}, but a cell has type {kind}. Add {kind}: …"
        " to it."
    )


class Values:
    """The resolved values of one effect by name: `values.rate.of_cells(state)`. A value that was
    not given is None."""

    def __init__(self, found: Mapping[str, Resolved | None]):
        self.__dict__.update(found)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"the effect has no physical value {name!r}: it has {', '.join(self)}")

    def __getitem__(self, name: str) -> Resolved:
        return self.__dict__[name]

    def __iter__(self):
        return iter(self.__dict__)

    @property
    def requires_grad(self) -> bool:
        return any(v is not None and v.requires_grad for v in self.__dict__.values())


def resolve(name: str, value: Any, batch: Batch, *, field: str | None = None) -> Resolved | None:
    """A checked value, made ready for a batch. field: where a value drawn at birth is kept; None:
    the caller draws."""
    if value is None:
        return None
    if is_drawn(value):
        return Resolved(name, draw=_bound_draw(name, value, batch), field=field)
    if isinstance(value, ByType):
        kinds = sorted(value.values)
        each = [_per_colony(f"{name}[{k}]", value.values[k], batch, listed=False) for k in kinds]
        if any(v.dim() for v in each):
            each = [v.expand(batch.colonies) for v in each]
        return Resolved(name, torch.stack(each), types=torch.tensor(kinds, device=batch.device))
    return Resolved(name, _per_colony(name, value, batch))


def _bound_draw(name: str, value: Any, batch: Batch) -> BoundDraw:
    if isinstance(value, Distribution):
        return BoundDraw(name, ((None, _distribution(name, value, batch)),))
    parts = [
        (
            kind,
            (
                _distribution(f"{name}[{kind}]", v, batch)
                if isinstance(v, Distribution)
                else resolve(f"{name}[{kind}]", v, batch)
            ),
        )
        for kind, v in sorted(value.values.items())
    ]
    return BoundDraw(name, tuple(parts))


def _distribution(name: str, value: Distribution, batch: Batch) -> tuple[Distribution, Values]:
    return value, Values(
        {p: resolve(f"{name}.{p}", getattr(value, p), batch) for p in value.parameters}
    )


def _per_colony(name: str, value: Any, batch: Batch, listed: bool = True) -> Tensor:
    """One number, or one per colony, as a tensor of the batch."""
    stated = isinstance(value, PerColony)
    given = value.values if stated else value
    if not isinstance(given, Tensor):
        return torch.tensor(given, dtype=batch.dtype, device=batch.device)
    if given.dim():
        check_length(name, given, batch)
        ambiguous = (
            listed
            and not stated
            and not batch.per_colony
            and len(batch.types) == batch.colonies > 1
        )
        if ambiguous:
            pairs = ", ".join(
                f"{k}: {float(v):g}" for k, v in zip(batch.types, given.detach(), strict=True)
            )
            raise checks.InputError(
                f"{name} has {given.numel()} values, and the batch has {batch.colonies} colonies"
                f" and as many cell types. Write {name.split('.')[-1]}={{{pairs}}} for one value"
                " per cell type, or tf.PerColony([…]) for one per colony."
            )
    return given.to(dtype=batch.dtype, device=batch.device, copy=True)


def check_length(name: str, given: Tensor, batch: Batch) -> None:
    """Raise InputError where a tensor has not one value for each colony of the batch."""
    if given.dim() and given.shape[0] != batch.colonies:
        raise checks.InputError(
            f"{name} has {given.shape[0]} values, but the batch has {batch.colonies} colonies: give"
            " one number, or one for each colony (scene.bind(colonies=…), tf.simulate(…,"
            " colonies=…), run --colonies)."
        )


def snapshot(part: Any, path: str, batch: Batch) -> Any:
    """A wall, signal or other part of an effect with its tensors copied to the batch's device,
    their lengths checked."""
    if isinstance(part, Tensor):
        check_length(path, part, batch)
        return part.to(device=batch.device, copy=True)
    if isinstance(part, (tuple, list)):
        made = [snapshot(item, f"{path}[{k}]", batch) for k, item in enumerate(part)]
        same = all(a is b for a, b in zip(made, part, strict=True))
        return part if same else type(part)(made)
    if isinstance(part, Mapping):
        each = {name: snapshot(item, f"{path}[{name!r}]", batch) for name, item in part.items()}
        return part if all(each[name] is part[name] for name in each) else each
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        changed = {
            f.name: snapshot(getattr(part, f.name), f"{path}.{f.name}", batch)
            for f in dataclasses.fields(part)
        }
        if all(changed[n] is getattr(part, n) for n in changed):
            return part
        copy = object.__new__(type(part))
        copy.__dict__.update(
            {**vars(part), **changed}
        )  # past __init__: the values have been checked
        return copy
    return part


# --- distributions --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Distribution:
    """A random value, drawn once for each cell at its birth. Subclasses: Uniform, Normal,
    LogNormal.

    inherited: daughters keep their parent's value instead of drawing their own.
    """

    parameters: ClassVar[tuple[str, ...]] = ()
    inherited: bool = dataclasses.field(default=False, kw_only=True)

    def draw(self, state: State, rows: Tensor, purpose: str, values: Values) -> Tensor:
        """One value for each of the cells `rows` (M,) -> (M,); values: its own parameters,
        resolved."""
        raise NotImplementedError

    def least(self) -> float:
        """The smallest value that can be drawn."""
        raise NotImplementedError

    def greatest(self) -> float:
        """The largest value that can be drawn."""
        raise NotImplementedError

    def _check(self, **rules: Rule) -> None:
        for name, rule in rules.items():
            made = checked(f"{type(self).__name__}.{name}", getattr(self, name), rule)
            object.__setattr__(self, name, made)


@dataclass(frozen=True, eq=False)
class Uniform(Distribution):
    """Uniform between low and high; each one number or one per colony."""

    low: float | Tensor
    high: float | Tensor

    parameters = ("low", "high")

    def __post_init__(self) -> None:
        self._check(low=Rule(scope=COLONY), high=Rule(scope=COLONY))
        if bool((numbers(self.low) > numbers(self.high)).any()):
            raise checks.input_error(
                "Uniform", (self.low, self.high), "low ≤ high", "Swap the two."
            )

    def draw(self, state: State, rows: Tensor, purpose: str, values: Any) -> Tensor:
        low, high = values.low.of_rows(state, rows), values.high.of_rows(state, rows)
        return low + (high - low) * state.uniform(rows, purpose)

    def least(self) -> float:
        return smallest(self.low)

    def greatest(self) -> float:
        return largest(self.high)


@dataclass(frozen=True, eq=False)
class Normal(Distribution):
    """Gaussian of mean and sd; each one number or one per colony. Its tails beyond 4 sd (one draw
    in 16,000) are folded back inside."""

    mean: float | Tensor
    sd: float | Tensor

    parameters = ("mean", "sd")

    def __post_init__(self) -> None:
        self._check(mean=Rule(scope=COLONY), sd=Rule(scope=COLONY, least=0.0))

    def draw(self, state: State, rows: Tensor, purpose: str, values: Any) -> Tensor:
        z = _standard_normal(state, rows, purpose)
        return values.mean.of_rows(state, rows) + values.sd.of_rows(state, rows) * z

    def least(self) -> float:
        return float((numbers(self.mean) - 4 * numbers(self.sd)).min())

    def greatest(self) -> float:
        return float((numbers(self.mean) + 4 * numbers(self.sd)).max())


@dataclass(frozen=True, eq=False)
class LogNormal(Distribution):
    """The exponential of a Gaussian: its median, and sigma, the standard deviation of its
    logarithm; each one number or one per colony."""

    median: float | Tensor
    sigma: float | Tensor

    parameters = ("median", "sigma")

    def __post_init__(self) -> None:
        self._check(median=Rule(scope=COLONY, above=0.0), sigma=Rule(scope=COLONY, least=0.0))

    def draw(self, state: State, rows: Tensor, purpose: str, values: Any) -> Tensor:
        z = _standard_normal(state, rows, purpose)
        # (0 + 1 · z, as of a Normal of mean 0 and sd 1)
        return values.median.of_rows(state, rows) * torch.exp(values.sigma.of_rows(state, rows) * z)

    def least(self) -> float:
        return float((numbers(self.median) * torch.exp(-4 * numbers(self.sigma))).min())

    def greatest(self) -> float:
        return float((numbers(self.median) * torch.exp(4 * numbers(self.sigma))).max())


def _standard_normal(state: State, rows: Tensor, purpose: str) -> Tensor:
    """Standard normal draws (M,), the tails beyond 4 folded back inside."""
    z = state.normal(rows, purpose)[:, 0]
    return torch.where(z.abs() > 4, z.sign() * (8 - z.abs()).clamp(min=0), z)


def drawn_field(title: str, name: str, value: Any) -> Field:
    """The field that keeps a value drawn at birth."""
    plain = (
        f"{title}_{name}".replace(" ", "_").replace("[", "_").replace("].", "_").replace("]", "")
    )
    rule = "copy" if is_inherited(value) else "reset"
    return Field(plain, f"{name} of the {title}, drawn for the cell", at_division=rule)


Value = float | Tensor | Sequence[float] | Mapping[int, Any] | Distribution | PerColony
