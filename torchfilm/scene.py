"""The scene: an ordered list of effects. What it does not list does not exist."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchfilm.effect import BUILT_IN, Effect
from torchfilm.initial_cells import Cells
from torchfilm.state import CELL, OUTSIDE, Field, State
from torchfilm.tools import checks
from torchfilm.tools.hashing import digest, without_addresses
from torchfilm.tools.timing import Timings
from torchfilm.version import __version__

CPU = torch.device("cpu")


class Scene:
    """Effects that act on a state, step by step, in the paper's order (rules, division, growth,
    mechanics, …) whatever order they are listed in.

    name: for results. dt: step that fits the scene, h. founders: cells that a colony starts from;
    by default one cell, 2 µm long. recipe: (name, parameters) of a ready-made scene, from which
    `resume` builds it again.

    `code`: version of Python, of torchfilm, and a digest of the listed effects, what their
    functions do included, alike where scenes do the same. A rules file goes by its path: it may
    change while a run is going.
    """

    def __init__(
        self,
        *effects: Effect,
        name: str = "scene",
        dt: float = 0.025,
        founders: Cells | None = None,
        recipe: tuple[str, dict[str, Any]] | None = None,
    ):
        for effect in effects:
            if isinstance(effect, (list, tuple)):
                raise checks.InputError(
                    f"Scene got a {type(effect).__name__} of {len(effect)} effects: it takes the"
                    " effects themselves. Unpack it: Scene(*effects)."
                )
            if not isinstance(effect, Effect):
                raise checks.input_error(
                    "Scene",
                    effect,
                    "made of effects such as Growth(), Division(), Mechanics()",
                    "Did you forget the brackets?",
                )
            for what, example in (
                ("title", '"ageing"'),
                ("stage", "35, after growth (30) and before mechanics (40)"),
            ):
                if not hasattr(effect, what):
                    raise checks.InputError(
                        f"{type(effect).__name__} has no {what}: give the class one, such as {what}"
                        f" = {example}."
                    )
        if not effects:
            raise checks.InputError(
                "Scene() has no effect: nothing would happen. List at least one, such as"
                " tf.Growth(rate=1.0)."
            )
        names = [e.title for e in effects]
        for title in names:
            if names.count(title) > 1 and title in (
                "growth",
                "division",
                "mechanics",
                "circuit",
                "transport",
                "nutrition",
            ):
                raise checks.InputError(
                    f"Scene lists {title} {names.count(title)} times: one is allowed. Put all of it"
                    " into one."
                )
        self.listed = effects
        parts = sorted(
            ((part, k) for k, e in enumerate(effects) for part in e.parts()),
            key=lambda p: p[0].stage,
        )
        self.effects: tuple[Effect, ...] = tuple(part for part, _ in parts)
        # which of the listed effects each is a part of
        self.places: tuple[int, ...] = tuple(k for _, k in parts)
        self.name, self.recipe = name, recipe
        self.settings: dict[str, Any] = {}  # what a user's own scene function was given
        self.accuracy: dict[str, float] = {}  # knobs of accuracy that it was given since
        self.dt = checks.number("Scene.dt", dt, above=0.0)
        self.dim = next(
            (e.dim for e in effects if hasattr(e, "dim")),
            founders.dim if founders is not None else 3,
        )
        self.founders = founders if founders is not None else Cells.single(self.dim)
        if self.founders.dim != self.dim:
            raise checks.input_error(
                "Scene.founders",
                f"{self.founders.dim}-D cells",
                f"{self.dim}-D, as the mechanics are",
            )
        self._check_fields()
        # now, before any run: what a rule holds on to may change as it runs
        self.code = [
            f"{sys.version_info[0]}.{sys.version_info[1]}",
            __version__,
            digest(self.listed),
        ]

    def retuned(self, effects: Sequence[Effect], dt: float, accuracy: dict[str, float]) -> Scene:
        """The same scene with its effects, in the order in which they are listed, and its step
        simulated by other knobs (`torchfilm.tuning.settings`)."""
        scene = Scene(*effects, name=self.name, dt=dt, founders=self.founders, recipe=self.recipe)
        scene.settings, scene.accuracy = self.settings, accuracy
        return scene

    def _check_fields(self) -> None:
        """Every field that is read or written exists, and is declared once or alike."""
        declared: dict[str, str] = {}
        for effect in self.effects:
            for f in effect.declares(self.dim):
                if f.name in declared:
                    raise checks.InputError(
                        f"field {f.name!r} is declared by {declared[f.name]} and by {effect.title}:"
                        " rename one."
                    )
                declared[f.name] = effect.title
        self.declared_by = declared
        for effect in self.effects:
            for name in effect.needs():
                if (
                    name not in declared
                    and name not in BUILT_IN
                    and name not in self.founders.extra
                ):
                    raise checks.InputError(
                        f"{effect.title} needs the field {name!r}, which nothing in this scene"
                        f" provides. It has: {', '.join(declared) or 'no field'}."
                        + (
                            _signal_mend(name.removeprefix(OUTSIDE), declared)
                            if name.startswith(OUTSIDE)
                            else ""
                        )
                    )

    def seed(
        self,
        colonies: int = 1,
        *,
        seed: int = 0,
        streams: Sequence[int] | Tensor | None = None,
        cells: Cells | None = None,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> State:
        """The first state: `colonies` independent colonies, each from a copy of the founders (or of
        `cells`, which may carry a colony number for each cell instead). Checked here, before
        anything runs.

        streams: whole numbers (B,), which course of random numbers each colony follows; by default
        colony k follows stream k. Colonies of one stream differ only by their parameters: common
        random numbers, for comparing designs.
        """
        if isinstance(colonies, bool) or not isinstance(colonies, int) or colonies < 1:
            raise checks.input_error(
                "colonies", colonies, "a whole number from 1", "A batch has at least one colony."
            )
        if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
            raise checks.input_error("seed", seed, "a whole number from 0")
        if dtype not in (torch.float32, torch.float64):
            raise checks.input_error("dtype", dtype, "torch.float32 or torch.float64")
        start = cells if cells is not None else self.founders
        if start.dim != self.dim:
            raise checks.input_error("cells", f"{start.dim}-D", f"{self.dim}-D, as the scene is")
        count = max(colonies, start.colonies)
        for path, tensor in self._per_colony():
            if tensor.numel() != count:
                raise checks.InputError(
                    f"{path} has {tensor.numel()} values, but the batch has {count} colonies: give"
                    " one number, or one for each colony (scene.seed(colonies=…), run --colonies)."
                )
        state = self.unchecked(
            colonies,
            seed=seed,
            streams=_streams(streams, count),
            cells=cells,
            device=_known_device(device),
            dtype=dtype,
        )
        self.check(state)
        for effect in self.effects:
            effect.check(state)
        return state

    def unchecked(
        self,
        colonies: int,
        *,
        seed: int = 0,
        streams: Tensor | None = None,
        cells: Cells | None = None,
        device: torch.device = CPU,
        dtype: torch.dtype = torch.float32,
    ) -> State:
        """A first state whose cells are not asked whether they may stand where they do: to be
        filled from a file, or only looked at."""
        state = (cells if cells is not None else self.founders).state(colonies, seed, device, dtype)
        if streams is not None:
            state = state.replace(stream=streams.to(device))
        for effect in self.effects:
            state = effect.begin(state)
        for effect in self.effects:
            for f in effect.declares(self.dim):
                state = _with_given(state, f) if f.name in state.fields else state.declare(f)
        for effect in self.effects:
            state = effect.prepare(state)
        return state

    @property
    def fixed_colonies(self) -> int:
        """How many colonies the parameters or founders are for; 1 where it may be any number."""
        return max([self.founders.colonies, *(tensor.numel() for _, tensor in self._per_colony())])

    def _per_colony(self) -> list[tuple[str, Tensor]]:
        return [
            (path, tensor)
            for effect in self.effects
            for path, tensor in parameters(effect)
            if tensor.dim() == 1
        ]

    def check(self, state: State) -> None:
        """Raise InputError if this is not a state of this scene."""
        if state.dim != self.dim:
            raise checks.input_error("state", f"{state.dim}-D", f"{self.dim}-D, as the scene is")
        most = int(state.colony_id.max())
        for path, tensor in self._per_colony():
            if tensor.numel() <= most:
                raise checks.InputError(
                    f"{path} has {tensor.numel()} values, but the batch has a colony number {most}:"
                    " it is not of this scene."
                )
        for effect in self.effects:
            for name in (*effect.needs(), *(f.name for f in effect.declares(self.dim))):
                if name not in state.fields and name not in BUILT_IN:
                    raise checks.InputError(
                        f"{effect.title} needs the field {name!r}, which this state lacks. Make the"
                        " state with this scene's seed()."
                    )

    def check_moves(self, state: State, cells: int) -> None:
        """Raise InputError if an effect waits for a field that is 0 everywhere in a colony that is
        to have more cells, and that nothing sets: a run to so many cells would never end."""
        for effect in self.effects:
            for name in effect.waits_for():
                # an effect of the user's own may lengthen cells, or add some, in its own way
                others = [e for e in self.effects if e is not effect]
                if any(
                    e.writes_anything
                    or name in e.writes()
                    or not type(e).__module__.startswith("torchfilm.")
                    for e in others
                ):
                    continue
                moves = state.fields[name] != 0
                if "divide_flag" in state.fields:
                    moves = moves | (state.fields["divide_flag"] != 0)
                still = (state.counts > 0) & (state.counts < cells) & ~state.groups.any(moves)
                if bool(still.any()):
                    ids = state.colony_id[still].tolist()
                    where = (
                        ""
                        if len(ids) == state.colonies
                        else (
                            f" in {len(ids)} of {state.colonies} colonies, the first of them"
                            f" {ids[0]}"
                        )
                    )
                    raise checks.InputError(
                        f"{effect.title} waits for {name!r}, which is 0{where} and which nothing in"
                        f" this scene sets: no run would come to {cells} cells. Give"
                        f" {type(effect).__name__} a parameter above 0 (such as rate=1.0), or a"
                        " rule that sets it; or end the run by a time, until=…"
                    )

    def step(self, state: State, dt: float, timings: Timings | None = None) -> State:
        """The state dt hours later: each effect in turn."""
        state = state.replace(births=(), ended=(), reports={})
        for effect in self.effects:
            if timings is None:
                state = effect.step(state, dt)
            else:
                with timings.of(effect.title, state.device):
                    state = effect.step(state, dt)
        # with an even step, time is counted in steps, so that it does not gather rounding
        even = abs(state.step * dt - state.time) < 1e-9 * max(1.0, state.time)
        return state.replace(
            step=state.step + 1, time=(state.step + 1) * dt if even else state.time + dt
        )

    def couplings(self) -> list[tuple[str, str, str]]:
        """Who drives whom: (writer, name, reader) for every name that one effect writes and another
        reads."""
        return [
            (w.title, name, r.title)
            for w in self.effects
            for r in self.effects
            if w.title != r.title
            for name in w.writes()
            if name in r.reads() or name in r.needs()
        ]

    def listing(self) -> list[str]:
        """Each effect as it was listed, with the parameters that differ from their defaults; what a
        results file compares by."""
        return [without_addresses(summary(effect)) for effect in self.listed]

    @property
    def headline(self) -> str:
        """Name, dimension, step and founders, in a line."""
        return f"{self.name}: {self.dim}-D, step {self.dt:g} h, {self.founders.count} founder(s)"

    def drives(self) -> list[str]:
        """The couplings in words, a line for each pair: "growth -> mechanics: length, elongation";
        "nobody" where there are none."""
        drives: dict[tuple[str, str], list[str]] = {}
        for writer, name, reader in self.couplings():
            drives.setdefault((writer, reader), []).append(name)
        return [
            f"{w} -> {r}: {', '.join(dict.fromkeys(names))}" for (w, r), names in drives.items()
        ] or ["nobody"]

    def explain(self) -> str:
        """What this scene simulates, in the order in which it acts, and who drives whom.
        `torchfilm.explanation` tells the methods and what they cost."""
        lines = [self.headline]
        for effect in self.effects:
            lines.append(f"  {effect.title:<10} {summary(effect)}")
            lines.append(f"             reads  {', '.join(effect.reads()) or '-'}")
            lines.append(f"             writes {', '.join(effect.writes()) or '-'}")
            for f in effect.declares(self.dim):
                lines.append(
                    f"             field  {f.name} ({f.unit or '1'}, per {f.scope}; daughters:"
                    f" {f.at_division}): {f.meaning}"
                )
        lines += ["  who drives whom:", *(f"    {line}" for line in self.drives())]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"Scene({', '.join(summary(e) for e in self.listed)}, name={self.name!r})"


def _signal_mend(name: str, declared: Iterable[str]) -> str:
    """What to do where a signal is asked for that no Medium has."""
    has = ", ".join(n.removeprefix(OUTSIDE) for n in declared if n.startswith(OUTSIDE))
    if not has:
        return (
            f" That is the signal {name!r}, and the scene has no Medium: list"
            f" tf.Medium({name}=tf.Signal(…), …)."
        )
    return (
        f" That is the signal {name!r}; the Medium has {has}: name one of these, or give the Medium"
        f" {name}=tf.Signal(…)."
    )


def _with_given(state: State, wanted: Field) -> State:
    """A field that came with the first cells, under the effect's own declaration: its rule at
    division and its dtype are the effect's."""
    values = state.fields[wanted.name]
    shape = (state.cells, *wanted.shape)
    if wanted.scope != CELL or tuple(values.shape) != shape:
        raise checks.input_error(
            f"cells column {wanted.name}",
            f"values of shape {tuple(values.shape)}",
            f"left out, or of shape {shape}",
        )
    declared = state.replace(declared={**state.declared, wanted.name: wanted})
    return declared.with_fields(**{wanted.name: values.to(wanted.dtype or state.dtype)})


def summary(effect: Effect) -> str:
    """The effect with the parameters that differ from their defaults."""
    shown = []
    for f in dataclasses.fields(effect):  # type: ignore[arg-type]
        value = getattr(effect, f.name)
        default = f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
        if f.repr and not _same(value, default):
            shown.append(f"{f.name}={_short(value)}")
    return f"{type(effect).__name__}({', '.join(shown)})"


def _same(a: object, b: object) -> bool:
    return a is b or (not isinstance(a, Tensor) and not isinstance(b, Tensor) and a == b)


def _short(value: object) -> str:
    if isinstance(value, Tensor):
        return (
            f"{float(value):.9g}"
            if value.dim() == 0
            else f"<{value.numel()} values, {float(value.min()):g} to {float(value.max()):g}>"
        )
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        inner = [
            f"{f.name}={_short(getattr(value, f.name))}"
            for f in dataclasses.fields(value)
            if not _same(getattr(value, f.name), f.default)
        ]
        return f"{type(value).__name__}({', '.join(inner)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {_short(v)}" for name, v in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_short(v) for v in value) + "]"
    return getattr(value, "__name__", None) or repr(value)


def parameters(part: object, path: str = "") -> list[tuple[str, Tensor]]:
    """Every tensor among an effect's parameters, with its name, those of its distributions and
    walls included."""
    if isinstance(part, Tensor):
        return [(path, part)]
    if isinstance(part, (tuple, list)):
        return [found for k, item in enumerate(part) for found in parameters(item, f"{path}[{k}]")]
    if isinstance(part, Mapping):
        return [
            found for name, item in part.items() for found in parameters(item, f"{path}[{name!r}]")
        ]
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        path = path or type(part).__name__
        # what is not shown is not given by the user but worked out
        return [
            found
            for f in dataclasses.fields(part)
            if f.repr
            for found in parameters(getattr(part, f.name), f"{path}.{f.name}")
        ]  # type: ignore[arg-type]
    return []


def _streams(given: Sequence[int] | Tensor | None, colonies: int) -> Tensor | None:
    if given is None:
        return None
    found = torch.as_tensor(given)
    if (
        found.shape != (colonies,)
        or found.is_floating_point()
        or found.dtype == torch.bool
        or bool(((found < 0) | (found >= 2**32)).any())
    ):
        raise checks.input_error(
            "streams", given, f"{colonies} whole numbers from 0 to 2³² − 1, one for each colony"
        )
    return found.to(torch.int64)


def _known_device(device: str | torch.device) -> torch.device:
    try:
        wanted = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise checks.input_error("device", device, '"cpu" or "cuda"') from error
    if wanted.type not in ("cpu", "cuda"):
        raise checks.input_error(
            "device",
            str(device),
            '"cpu" or "cuda"',
            "Other devices lack the sparse products and float64 that a step needs.",
        )
    if wanted.type == "cuda" and not torch.cuda.is_available():
        raise checks.input_error(
            "device",
            str(device),
            "a device that this machine has",
            'torch sees no CUDA GPU; use device="cpu".',
        )
    return wanted
