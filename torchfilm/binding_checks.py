"""What is checked of the effects of a bound scene together: that the names exist which they read
and write, that none is idle or comes too early, that a run to a number of cells can end; and
whether growth can be recorded."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchfilm.effect import BUILT_IN, BoundEffect, Effect, is_own, makes_longer
from torchfilm.parameters import parameters
from torchfilm.resolver import FirstValue
from torchfilm.rule_views import KNOWN_FIELDS, MEANS
from torchfilm.state import CELL, OUTSIDE, PER_CELL, Field, State
from torchfilm.tools import checks, row_checks, units
from torchfilm.tools.hashing import trained
from torchfilm.tools.tangents import tracked
from torchfilm.tools.warn_once import warn

TOO_MANY = 1e9  # cells of a colony
UNHEARD_OF = 1e6  # rate times hours, from which the first step fails and says so

if TYPE_CHECKING:
    from torchfilm.model import Model


def check_names(effects: Sequence[BoundEffect], declared: Iterable[str], state: State) -> None:
    """Raise InputError for a name that an effect says it reads or writes and that nothing provides.

    declared: the fields that the effects of the scene declare. state: one that the effects have
    been tried on; it also has the fields of its first cells and the variables of rules.
    """
    there = [*BUILT_IN, *dict.fromkeys((*declared, *state.fields))]
    if any(e.effect.writes_anything for e in effects):  # rules may set these at any time
        there += [name for name in KNOWN_FIELDS if name not in there]
    for effect in {id(bound.effect): bound.effect for bound in effects}.values():
        usual = _torchfilms(effect)
        for verb, names, known in (
            ("reads", effect.reads(), usual.reads(effect)),
            ("writes", effect.writes(), usual.writes(effect)),
        ):
            for name in names:
                if name not in there and name not in known:
                    raise checks.InputError(
                        f"{type(effect).__name__}.{verb}() names {name!r}, which no effect of this"
                        f" scene declares and no first cell has. {_instead(name, there)} There are:"
                        f" {', '.join(there)}."
                    )


def _torchfilms(effect: Effect) -> type[Effect]:
    """The effect of torchfilm that this one is, or is made from. These name some fields that they
    use only where a scene has them, such as the drag of a cell."""
    return next(kind for kind in type(effect).__mro__ if kind.__module__.startswith("torchfilm."))


def _instead(name: str, there: Sequence[str]) -> str:
    """What to do about a name that does not exist."""
    if name in MEANS:
        return f"Name {' and '.join(map(repr, MEANS[name]))} instead: {name} follows from that."
    near = OUTSIDE + name if OUTSIDE + name in there else checks.nearest(name, there)
    return f"Did you mean {near!r}?" if near else "Correct it, or declare the field in declares()."


def check_end(effects: Sequence[BoundEffect], state: State, cells: int) -> None:
    """Raise InputError if no run from this state would come to `cells` cells in every colony: an
    effect waits for a field that is 0 everywhere in a colony and that nothing sets, or nothing adds
    cells. Warn if a run can end only with colonies that have lost all cells."""
    for effect in effects:
        for name, needs in effect.effect.waits_for().items():
            if not _sets(effects, name, effect):
                _check_moves(effect, name, needs, state, cells)
    short = (state.counts > 0) & (state.counts < cells)
    if bool(short.any()) and (why := _why_none_divides(effects)):
        raise checks.InputError(
            f"cells = {cells} is never reached: {why}, or end the run by a time (until=…, --until)."
        )
    _check_adds(effects, state, cells)


def warn_of_no_growth(effects: Sequence[BoundEffect]) -> None:
    """Warn where cells divide at a threshold and nothing makes them longer."""
    if why := _why_none_divides(effects):
        warn(f"No cell will divide but those that are long enough now: {why}.")


def warn_of_too_many(effects: Sequence[BoundEffect], state: State, until: float) -> None:
    """Warn of a time, h, by which a colony that nothing holds back has more cells than any run
    comes to."""
    rate = state.fields.get("growth_rate")
    if rate is None or not state.cells or state.declared["growth_rate"].unit != "1/h":
        return
    if not any(e.effect.divides_at_threshold for e in effects) or any(map(_may_hold, effects)):
        return
    drawn = state.declared["growth_rate"].at_division == "reset"  # again for each daughter
    fastest = float(rate.detach().mean() if drawn else rate.detach().max())
    grown = fastest * (until - state.time)  # of the logarithm
    if math.log(TOO_MANY) < grown < UNHEARD_OF:
        power = grown / math.log(10.0)
        warn(
            f"until = {until:g} h: at {fastest:.3g}/h, volumes grow 10^{power:.0f}-fold by then."
            " Are times in hours, and rates in 1/h? Else end the run at a number of cells, too"
            " (cells=…)."
        )


def _may_hold(bound: BoundEffect) -> bool:
    """Whether an effect may keep a colony from growing at its rate, sets rates, or removes
    cells."""
    effect, writes = bound.effect, bound.writes()
    removes = "cells" in writes and not effect.divides_at_threshold
    return is_own(effect) or effect.holds_back or "growth_rate" in writes or removes


def _why_none_divides(effects: Sequence[BoundEffect]) -> str:
    """Why no cell comes to a threshold of division, and what to do; "" where cells may."""
    waits = any(e.effect.divides_at_threshold for e in effects)
    if not waits or any(makes_longer(e.effect) for e in effects):
        return ""
    return (
        "cells divide at a threshold, and no effect of this scene makes them longer. List"
        " tf.Growth(rate=1.0), in 1/h"
    )


def warn_of_idle(effects: Sequence[BoundEffect], state: State) -> None:
    """Warn of what does nothing from this first state on, unless an effect may set what it lacks:
    signals that stay 0, rates for a type of cells of which there are none."""
    for bound in {id(bound.effect): bound for bound in effects}.values():
        for name, text in bound.effect.idle_without(state).items():
            if not _sets(effects, name, bound):
                warn(text)


def warn_of_kept(effects: Sequence[BoundEffect], state: State, own: Container[str]) -> None:
    """Warn of values of a scene that do nothing for a state that is gone on with: cells got theirs
    when they came in, keep them and hand them on. own: fields that first cells bring along."""
    rows = torch.arange(state.cells, device=state.device)
    for bound in effects if state.cells else ():
        for field in bound.declares():
            name = field.name
            kept = field.scope == CELL and field.at_division == "copy" and name in state.fields
            if not kept or name in own or not isinstance(field.initial, FirstValue):
                continue
            if name in bound.writes() or _sets(effects, name, bound):
                continue
            now, given = state.fields[name].detach(), field.initial(state, rows).detach()
            owner, differ = state.groups.owner, bool((now != given.to(now.dtype)).all())
            # cells of a colony that differ, and single colonies, have been set by hand
            if differ and bool((state.groups.max(now).index_select(0, owner) == now).all()):
                warn(
                    f"This scene gives its first cells {name} = {_few(given)}; those of the state"
                    f" keep {_few(now)}, and their daughters do. To change it: state ="
                    f" state.with_fields({name}=torch.full_like(state.{name}, …))."
                )


def warn_of_other_names(state: State, own: Iterable[str]) -> None:
    """Warn of columns of the first cells whose names differ from those of fields by capitals or
    underscores alone."""
    plain = lambda name: name.lower().replace("_", "")
    there = {plain(n): n for n, f in state.declared.items() if n not in own}
    for name in own:
        if (like := there.get(plain(name))) is not None:
            warn(
                f"the first cells have a column {name!r}, and the scene has {like!r}: should they"
                " have one name?"
            )


def _few(values: Tensor) -> str:
    each = values.unique().tolist()
    return ", ".join(f"{x:g}" for x in each[:4]) + (", …" if len(each) > 4 else "")


def warn_of_births(effects: Sequence[BoundEffect]) -> None:
    """Of a user's effect that looks for the divisions of the step: warn where cells divide later,
    and where others may have removed cells since, so that rows are of other cells. effects: in the
    order of their stages."""
    for place, bound in enumerate(effects):
        if not is_own(bound.effect) or not _reads(type(bound.effect), "births"):
            continue
        name = type(bound.effect).__name__
        divide = max((e.stage for e in effects if _divides(e)), default=bound.stage)
        if bound.stage < divide:
            warn(
                f"{name} reads state.births at stage {bound.stage:g}, and cells divide at stage"
                f" {divide:g}: it finds no divisions. Write stage = {divide + 5:g}, or another"
                f" number above {divide:g}, in {name}."
            )
        between = [e for e in effects[:place] if e.stage > divide and _removes(e)]
        if between:
            first = between[0]
            warn(
                f"{name} reads state.births at stage {bound.stage:g}, and {first.title} removes"
                f" cells before it, at stage {first.stage:g}: the rows of state.births are those"
                f" right after the divisions. Write stage = {(divide + first.stage) / 2:g}, or"
                f" another number between {divide:g} and {first.stage:g}, in {name}."
            )


def _reads(kind: type, name: str) -> bool:
    """Whether a method of a class, its own or inherited from a user's, reads such an attribute."""
    methods = (getattr(x, "__code__", None) for k in kind.__mro__ for x in vars(k).values()
               if k not in (Effect, BoundEffect, object))  # fmt: skip
    return any(code is not None and name in code.co_names for code in methods)


def _removes(effect: BoundEffect) -> bool:
    return any(_reads(kind, "remove") for kind in (type(effect), type(effect.effect)))


def _divides(effect: BoundEffect) -> bool:
    return any(f.name == "divide_flag" for f in effect.declares())


def _sets(effects: Sequence[BoundEffect], name: str, effect: BoundEffect) -> bool:
    """Whether another effect, or the user's own form of this one, may set a field, or lengthen or
    add cells in its own way."""
    others = [e for e in effects if e.effect is not effect.effect]
    return is_own(effect.effect) or any(
        e.effect.writes_anything
        or (name in e.writes() and name not in e.effect.only_takes())
        or is_own(e.effect)
        for e in others
    )


def _check_moves(effect: BoundEffect, name: str, needs: str, state: State, cells: int) -> None:
    """Raise InputError if a colony that is to have more cells rests: a field that `effect` waits
    for is 0 in all its cells, and none is due to divide. needs: what to give the effect."""
    moves = state.fields[name] != 0
    if "divide_flag" in state.fields:
        moves = moves | (state.fields["divide_flag"] != 0)
    still = (state.counts > 0) & (state.counts < cells) & ~state.groups.any(moves)
    if bool(still.any()):
        ids = state.colony_id[still].tolist()
        some = f" in {len(ids)} of {state.colonies} colonies, first in colony {ids[0]}"
        raise checks.InputError(
            f"{effect.title} waits for {name!r}, which is"
            f" 0{'' if len(ids) == state.colonies else some} and which nothing in this"
            f" scene sets: no run would come to {cells} cells. Give"
            f" {type(effect.effect).__name__} {needs}, or a rule that sets it; or end the run by a"
            " time, until=…"
        )


def _check_adds(effects: Sequence[BoundEffect], state: State, cells: int) -> None:
    """Raise InputError, or warn, if a colony is to have more cells and no effect adds any."""
    short = (state.counts > 0) & (state.counts < cells)
    own = any(is_own(e.effect) for e in effects)
    if own or any(map(_divides, effects)) or not bool(short.any()):
        return
    place = int(short.nonzero()[0])
    text = (
        f"cells = {cells} is never reached: no effect of this scene divides cells, and colony"
        f" {int(state.colony_id[place])} has {int(state.counts[place])}."
    )
    hint = (
        "List tf.Division(length=tf.Uniform(3.5, 4.5)) in the scene, or end the run by a time"
        " (until=…, --until)."
    )
    if any(e.effect.writes_anything or "cells" in e.writes() for e in effects):
        warn(f"{text} The run ends only if every such colony loses all cells. {hint}")
        return
    raise checks.InputError(f"{text} {hint}")


def another_quantity(there: Field, wanted: Field, kept: Sequence[str]) -> bool:
    """Whether a field of a state is another quantity than is wanted: of another scope, shape or
    unit, if both have one; or, where it is several times among those `kept`, since it holds one of
    several, of other words."""
    if (there.scope, tuple(there.shape)) != (wanted.scope, tuple(wanted.shape)):
        return True
    if not there.unit or not wanted.unit:  # variables of rules, and what first cells brought
        return False
    return units.differ(there.unit, wanted.unit) or (
        kept.count(wanted.name) > 1 and there.meaning != wanted.meaning
    )


def check_fits(state: object, model: Model, fields: Mapping[str, object]) -> None:
    """Raise InputError if a step of this model cannot take the state, as far as a glance tells."""
    if not isinstance(state, State):
        hint = "Such as model.start(), or the last one of tf.simulate(…)."
        raise checks.input_error("step(state)", state, "a tf.State", hint)
    columns = {n: getattr(state, n) for n in PER_CELL}
    if not row_checks.is_whole(columns):
        row_checks.check_geometry(columns, state.colonies, model.dim, model.batch.dtype)
    alike = state.dim == model.dim and state.dtype == model.batch.dtype
    if not (alike and fields.keys() <= state.fields.keys()):
        model.check(state)


def why_not_replayable(model: Model) -> str:
    """Why the growth of a model cannot be recorded for other designs, or ""."""
    anything = [e.title for e in model.effects if e.effect.writes_anything]
    if anything:
        return f"{anything[0]} may read and write anything"
    if model.scene.founders.colony is not None:
        return "its first cells name their colonies, so that these do not start alike"
    if model.scene.draw is not None and model.scene.draw.colonies is not None:
        return "its founders differ between colonies"
    for e in model.effects:
        for f in e.declares():
            if f.scope != CELL and e.place in model.recorded:
                for mover in model.effects:
                    used = f.name in (*mover.reads(), *mover.writes())
                    if used and {*mover.writes()} & {*BUILT_IN}:
                        return (
                            f"{mover.title} acts on growth or motion and needs {f.name!r}, which is"
                            " no quantity of cells"
                        )
                return (
                    f"{e.effect.title} acts on growth or motion by {f.name!r}, which is no quantity"
                    " of cells"
                )
    if not model.following:
        return "every effect acts on growth or motion"
    for path, tensor in (x for k in model.recorded for x in parameters(model.scene.effects[k])):
        if tensor.dim() == 1:
            return f"{path} differs between colonies and acts on their growth"
        if tracked(tensor):
            return f"a derivative by {path} is wanted, which recorded growth does not carry"
    for effect in (model.scene.effects[k] for k in model.recorded):
        if tracked(*trained(effect)):
            return (
                f"a derivative by a tensor that {effect.title} uses, such as a weight of a network,"
                " is wanted, which recorded growth does not carry: requires_grad_(False) if it is"
                " not"
            )
    return ""


def warn_of_lost_genes(effects: Sequence[BoundEffect]) -> None:
    """Warn of species of a circuit that a division shares among daughters though there is next to
    nothing, where no other effect writes them."""
    for effect in effects:
        others = {n for e in effects if e is not effect for n in e.writes()}
        circuit: Any = effect.effect
        for names in getattr(effect, "genes", ()):
            if others.isdisjoint(circuit.variables[n] for n in names):
                warn(
                    f"{effect.title}: no reaction changes the number of {' + '.join(names)}, cells"
                    " begin with one or two, and division shares them: soon most cells have none."
                    " If it is a gene, which cells replicate before they divide, add"
                    f" replicated={names} to the circuit."
                )
