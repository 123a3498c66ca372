"""The scene: a frozen description, an ordered list of effects. What it does not list is not
simulated."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from numbers import Real
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchfilm.binding import bind, taken_over
from torchfilm.circuits.names import without_medium
from torchfilm.effect import BUILT_IN, Effect, is_own
from torchfilm.founders import Founders, checked_type_names
from torchfilm.initial_cells import Cells
from torchfilm.model import Model
from torchfilm.parameters import given, parameters, summary
from torchfilm.physics.space import PeriodicSpace
from torchfilm.physics.surfaces import Surface
from torchfilm.rule_views import OF_EFFECTS
from torchfilm.state import OUTSIDE, Field, State
from torchfilm.tools import checks, displays
from torchfilm.tools.hashing import digest, digest_of_code, digest_of_weights, without_addresses
from torchfilm.tools.listings import differences
from torchfilm.tools.warn_once import once, warn
from torchfilm.values import ByType
from torchfilm.version import __version__

CHANGEABLE = ("name", "dt", "founders", "recipe", "settings", "accuracy", "dim", "type_names")
NO_KEYWORD = {"effects": "Effects come first, without a name: (*effects, name=…)."}


class Scene(metaclass=checks.KnownKeywords):
    """Effects that act on a state in each step, in a fixed order (rules, growth, mechanics, …,
    division), whatever order they are listed in. A scene never changes; `replace` makes another
    one.

    name: for results. dt: default step, h. founders: cells that each colony starts from; by default
    one cell, 2 µm long; or a function from a seed to such cells, which is called for each colony
    with a seed of its stream: `founders=lambda seed: tf.inoculum(12, 10.0, seed=seed)`; or a
    tf.Founders, whose function has further values, which may differ between colonies. dim: 2 or
    3, for a scene without mechanics. recipe: (name, parameters) of a ready-made scene, from which
    `resume` builds it again. settings: what the user's own scene function was given. accuracy:
    accuracy settings applied so far. type_names: of the cells' types 0, 1, …, for pictures.

    `code`: versions of Python and torchfilm, and a digest of the effects, what their functions
    compute included. A rules file is known by its path, since it may change during a run.
    """

    effects: tuple[Effect, ...]
    name: str
    dt: float
    dim: int
    type_names: tuple[str, ...]
    founders: Cells  # where they are drawn, those of the first colony from the seed 0
    draw: Founders | None
    recipe: tuple[str, dict[str, Any]] | None
    settings: dict[str, Any]
    accuracy: dict[str, float]
    _code: tuple[str, str, str]
    declared_by: dict[str, str]
    _given: dict[str, Any]  # founders and dim, None where other things decided
    _said: frozenset[str]  # warnings given when it was made

    instead: ClassVar[Mapping[str, str]] = NO_KEYWORD

    def __init__(
        self,
        *effects: Effect,
        name: str = "scene",
        dt: float = 0.025,
        founders: Cells | Founders | Callable[[int], Cells] | None = None,
        dim: int | None = None,
        recipe: tuple[str, dict[str, Any]] | None = None,
        settings: dict[str, Any] | None = None,
        accuracy: dict[str, float] | None = None,
        type_names: Sequence[str] = (),
    ):
        _check_effects(effects)
        made: dict[str, Any] = {
            "effects": effects,
            "name": name,
            "recipe": recipe,
            "settings": dict(settings or {}),
            "accuracy": dict(accuracy or {}),
            "_given": {"founders": founders, "dim": dim},
            "dt": checks.number("Scene.dt", dt, above=0.0),
            "draw": None,
        }
        if founders is not None and not isinstance(founders, Cells):
            draw = founders if isinstance(founders, Founders) else Founders(founders)
            made["draw"], founders = draw, draw.one(0)
        made["dim"] = _dimension(effects, founders, dim)
        made["founders"] = founders if founders is not None else Cells.single(made["dim"])
        if made["founders"].dim != made["dim"]:
            raise checks.input_error(
                "Scene.founders",
                f"{made['founders'].dim}-D cells",
                f"{made['dim']}-D, as the mechanics are",
                "For cells in {0}-D write Mechanics(dim={0}).".format(made["founders"].dim),
            )
        made["type_names"] = checked_type_names(type_names, made["founders"])
        made["declared_by"] = _check_fields(effects, made["dim"], made["founders"])
        # now, before any run: what a rule refers to may change as it runs
        version = f"{sys.version_info[0]}.{sys.version_info[1]}"
        made["_code"] = version, __version__, digest_of_code(effects)
        self.__dict__.update(made)
        with once() as said:
            for effect in effects:
                effect.check_scene(effects, made["founders"])
        self.__dict__["_said"] = frozenset(said)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a Scene never changes: scene.replace({name}=…) makes another one")

    def __delattr__(self, name: str) -> None:
        raise AttributeError("a Scene never changes")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Scene) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    @property
    def fingerprint(self) -> str:
        """A hexadecimal word, equal for scenes that simulate the same and have one name."""
        return digest(self.effects, self.drawn_from, self.dim, self.dt, self.name)

    @property
    def code(self) -> list[str]:
        """The versions of Python and torchfilm, a word for the code of functions as the scene was
        made, and one for the weights of networks as they are now, "" where there are none."""
        return [*self._code, digest_of_weights(self.effects)]

    @property
    def drawn_from(self) -> Any:
        """What decides the founders: they themselves, or they and the function that draws them."""
        return self.founders if self.draw is None else (self.founders, *self.draw.decided_by)

    def replace(self, *effects: Effect, **changes: Any) -> Scene:
        """The same scene with other effects, if any are given, or with another name, dt, founders,
        … With other effects it is no longer what its recipe makes, and has none."""
        for name in changes:
            if name not in CHANGEABLE:
                known = ("*effects", *CHANGEABLE)
                raise checks.unknown_keyword("Scene.replace", name, known, NO_KEYWORD)
        kept: dict[str, Any] = {name: getattr(self, name) for name in CHANGEABLE}
        kept["founders"] = self.draw or self.founders
        if any(getattr(e, "dim", self.dim) != self.dim for e in effects):
            # they decide what was not given
            kept |= self._given
        if effects:
            kept["recipe"] = None
        with once(self._said):  # what this scene has warned of, its copies need not
            return Scene(*(effects or self.effects), **{**kept, **changes})

    @checks.known_keywords
    def bind(
        self,
        colonies: int | None = None,
        *,
        seed: int = 0,
        streams: Sequence[int] | Tensor | None = None,
        cells: Cells | None = None,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        state: State | None = None,
        per_colony: bool = False,
    ) -> Model:
        """A model of `colonies` independent colonies, with all that is decided once decided:
        `model.start()`, `model.step`.

        colonies: by default as many as the scene's parameters and founders have, else 1. Each
        starts from a copy of the founders, or of `cells`, which may carry a colony number for each
        cell instead. seed: of all random numbers. streams: integers (B,), which stream of random
        numbers each colony follows; by default colony k follows stream k. Colonies of one stream
        differ only by their parameters: common random numbers, for comparing designs. state: bind
        to the batch of this state instead (its colonies, seed, dtype and device), to continue from
        it. per_colony: lists and tensors are one value per colony, also where their length could
        mean cell types. Raises InputError where the scene, its parameters or its founders do not
        fit; nothing has run then.
        """
        return bind(
            self,
            colonies,
            seed=seed,
            streams=streams,
            cells=cells,
            device=device,
            dtype=dtype,
            state=state,
            per_colony=per_colony,
        )

    def take_over(self, state: State) -> State:
        """A state of another scene, with which this one goes on: `tf.simulate(scene,
        scene.take_over(state), until=…)`. Fields that it lacks, or that mean something else there,
        have first values; it gets this scene's medium where it has none. All else stays, also
        fields that only the other scene has. Raises InputError where the two do not fit, as with
        another dimension, other signals or another grid, and where a cell may not be where it
        is; warns where one lies behind a hard wall."""
        return taken_over(self, state)

    @property
    def fixed_colonies(self) -> int:
        """How many colonies the parameters or founders are for; 1 where it may be any number."""
        own = self.founders.colonies if self.draw is None else self.draw.colonies or 1
        return max([own, *(tensor.numel() for _, tensor in self.per_colony())])

    def per_colony(self) -> list[tuple[str, Tensor]]:
        """Every parameter with one value per colony, by name: "Growth.rate", of several effects of
        one kind "Circuit['lux'].parameters['k']", and of founders "Founders.share"."""
        owners = zip(self.effects, _owners(self.effects), strict=True)
        own = [] if self.draw is None else self.draw.per_colony()
        return own + [
            (path, x) for e, owner in owners for path, x in parameters(e, owner) if x.dim() == 1
        ]

    def listing(self) -> list[str]:
        """Each effect with the parameters that differ from their defaults; results files are
        compared by it."""
        return [without_addresses(summary(effect)) for effect in self.effects]

    def difference(self, effects: list[str] | None, code: list[str] | None) -> str:
        """In words, what differs from a scene of which a file keeps the `listing()` and the `code`
        of functions; "" for nothing. Code of another version of Python or torchfilm is not
        compared."""
        now = self.listing()
        if effects is not None and effects != now:
            return differences(effects, now) or "the same effects in another order"
        own = self.code
        if code is None or code[:2] != own[:2]:
            return ""
        if code[2:3] != own[2:3]:
            return (
                "a function of its effects was edited, or an object that such a function uses, or a"
                " parameter with one value per colony"
            )
        others = code[3:] not in ([], own[3:])  # files of earlier versions lack it
        return "the weights of a network that its effects use are others" if others else ""

    def warn_if_not(self, path: object, design: Mapping[str, Any]) -> None:
        """Warn where this is another scene than that of a saved design, the content of a file."""
        kept = (design.get(name) for name in ("effects", "code"))
        texts = lambda x: isinstance(x, list) and all(isinstance(one, str) for one in x)
        if found := self.difference(*(x if texts(x) else None for x in kept)):
            warn(
                f"{path} is a design of another scene: {found}. Its losses are not those of this"
                " scene."
            )

    @property
    def space(self) -> PeriodicSpace | None:
        """Where cells are, if that is periodic."""
        found = (effect.periodic_space for effect in self.effects)
        return next((space for space in found if space is not None), None)

    def wall_surfaces(self) -> list[Surface]:
        """The surfaces of all walls."""
        return [surface for effect in self.effects for surface in effect.wall_surfaces()]

    @property
    def headline(self) -> str:
        """Name, dimension, step and founders, in a line."""
        drawn = "" if self.draw is None else ", drawn for each colony"
        about = f"{self.name}: {self.dim}-D, step {self.dt:g} h, {self.founders.count} founder(s)"
        types = ", ".join(f"{k} {name}" for k, name in enumerate(self.type_names))
        return f"{about}{drawn}" + f", types {types}" * bool(types)

    def __repr__(self) -> str:
        return f"Scene({', '.join(summary(e) for e in self.effects)}, name={self.name!r})"

    def _repr_html_(self) -> str:
        rows = [
            (type(e).__name__, ", ".join(f"{name} = {value}" for name, value in given(e)))
            for e in self.effects
        ]
        equations = [
            displays.lines(title) + displays.text(found)
            for e in self.effects
            for title, found in e.equations().items()
        ]
        return displays.card(self.headline, displays.table(rows, ("effect", "given")), *equations)


def _owners(effects: Sequence[Effect]) -> list[str]:
    """What parameters of each effect are named after: its class; of several of one class with its
    name, or with its number among them where names do not tell them apart."""
    kinds = [type(effect).__name__ for effect in effects]
    out = []
    for k, (effect, kind) in enumerate(zip(effects, kinds, strict=True)):
        alike = [e for e, other in zip(effects, kinds, strict=True) if other == kind]
        names = {name for e in alike if isinstance(name := getattr(e, "name", None), str) and name}
        told_apart = len(names) == len(alike)
        mark = effect.name if told_apart else kinds[:k].count(kind)  # type: ignore[attr-defined]
        out.append(kind if len(alike) == 1 else f"{kind}[{mark!r}]")
    return out


def _check_effects(effects: Sequence[Any]) -> None:
    """Raise InputError for what is no effect, and for effects that may be listed once only."""
    if not effects:
        raise checks.InputError(
            "Scene() has no effect: nothing would happen. List at least one, such as"
            " tf.Growth(rate=1.0)."
        )
    for effect in effects:
        if not isinstance(effect, Effect):
            hint = "Write Growth() with its brackets." if isinstance(effect, type) else ""
            if isinstance(effect, (list, tuple)):
                hint = "Unpack the list: Scene(*effects)."
            raise checks.input_error(
                "Scene", effect, "made of effects such as Growth(), Division(), Mechanics()", hint
            )
        if not dataclasses.is_dataclass(effect):
            raise checks.InputError(
                f"{type(effect).__name__} is no dataclass: write @dataclass(frozen=True) above its"
                " class statement."
            )
        for what, example in (
            ("title", '"ageing"'),
            ("stage", "35, after growth (30) and before mechanics (40)"),
        ):
            if not hasattr(effect, what):
                raise checks.InputError(
                    f"{type(effect).__name__} has no {what}: give the class one, such as {what} ="
                    f" {example}."
                )
        if isinstance(effect.stage, bool) or not isinstance(effect.stage, Real):
            raise checks.input_error(f"{type(effect).__name__}.stage", effect.stage, "a number")
    titles = [e.title for e in effects]
    for effect in effects:
        count = titles.count(effect.title)
        if count > 1 and not effect.may_repeat:
            raise checks.InputError(
                f"Scene lists {effect.title} {count} times: one is allowed. {effect.instead_of_two}"
            )


def _dimension(effects: Sequence[Effect], founders: Cells | None, given: int | None) -> int:
    stated = next((e.dim for e in effects if hasattr(e, "dim")), None)
    if given is not None:
        checks.choice("Scene.dim", given, (2, 3))
        if stated is not None and stated != given:
            raise checks.input_error(
                "Scene.dim",
                given,
                f"{stated}, as the mechanics are",
                f"Leave it out, or write Mechanics(dim={given}).",
            )
        return given
    if stated is not None:
        return stated
    if founders is not None:
        return founders.dim
    warn(
        "the scene has no Mechanics and no founders, so that its dimension is not stated: it is"
        " 3-D. Write Scene(…, dim=2) or Scene(…, dim=3)."
    )
    return 3


def _check_fields(effects: Sequence[Effect], dim: int, founders: Cells) -> dict[str, str]:
    """Every field that is needed exists, and is declared once or alike. Returns who declares
    each."""
    declared: dict[str, tuple[Field, str]] = {}
    for effect in effects:
        for f in effect.declares(dim):
            if f.name in declared and declared[f.name][0] != f:
                raise checks.InputError(
                    f"field {f.name!r} is declared by {declared[f.name][1]} and by {effect.title}:"
                    " rename one." + effect.clash_hint(f.name)
                )
            declared.setdefault(f.name, (f, effect.title))
    for effect in effects:
        for value, f in effect.kept_values().items():
            if f.name in declared:
                raise checks.InputError(_kept_twice(effect, value, f.name, declared[f.name][1]))
            declared[f.name] = (f, effect.title)
    names = {name: title for name, (_, title) in declared.items()}
    by_type = [isinstance(v, ByType) for e in effects for v, _ in e.physical_values().values()]
    types = {"cell_type"} if founders.cell_type is not None or any(by_type) else set()
    brought = {*founders.extra} | types
    for effect in effects:
        for name in effect.needs():
            if name not in declared and name not in BUILT_IN and name not in brought:
                raise checks.InputError(
                    f"{effect.title} needs the field {name!r}, which nothing in this scene"
                    f" provides. It has: {', '.join(declared) or 'no field'}."
                    + _lacking_hint(effect, name, declared)
                )
    return names


def _lacking_hint(effect: Effect, name: str, declared: Collection[str]) -> str:
    """What to do where an effect needs a field that nothing provides."""
    if name.startswith(OUTSIDE):
        return _signal_hint(name.removeprefix(OUTSIDE), declared)
    if name in OF_EFFECTS:
        return f" List {OF_EFFECTS[name]} beside it."
    if OUTSIDE + name in declared:
        return f" {name!r} is a signal: let a rule set a variable, cells.x = cells.signals.{name}."
    near = checks.suggestion(name, declared)
    first = f"tf.Rules(…, variables={{{name!r}: {effect.usual_first}}})"
    return f"{near and f' {near}'} A variable of rules needs a first value for it: {first}."


def _kept_twice(effect: Effect, value: str, field: str, other: str) -> str:
    """What is wrong where a value drawn at birth would be kept in another one's field."""
    if other == effect.title:
        hint = (
            "Give each a title of its own: make title a field or a property of"
            f" {type(effect).__name__}."
            if is_own(effect)
            else "Let only one of them draw it; a rule may draw a variable for the other."
        )
        return (
            f"{effect.title} is listed twice, and both draw their {value} for each cell, kept in"
            f" the one field {field!r}. {hint}"
        )
    return (
        f"the {value} of {effect.title}, drawn for each cell, is kept in the field {field!r}, which"
        f" {other} has, too: rename one."
    )


def _signal_hint(name: str, declared: Iterable[str]) -> str:
    """What to do where an effect needs a signal that no Medium has."""
    has = ", ".join(n.removeprefix(OUTSIDE) for n in declared if n.startswith(OUTSIDE))
    if not has:
        return f" That is the signal {name!r}, and {without_medium(name)}"
    return (
        f" That is the signal {name!r}; the Medium has {has}: name one of these, or give the Medium"
        f" {name}=tf.Signal(…)."
    )
