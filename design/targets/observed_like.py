"""What data take from other data, which they are to be compared like: another `Observed`, or
None."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from design.targets.base import species_names
from design.targets.statistics import ColonyStatistics
from torchfilm import checks


def counted(amounts: bool, like: Any) -> bool:
    """Whether amounts of species are compared: as given, or as those of `like`."""
    check_like(like)
    checks.choice("Observed(amounts)", amounts, (True, False))
    if amounts and like is not None and not like.plan.amounts:
        raise checks.input_error(
            "Observed(amounts)", True, "False, as of like", "Make that one by amounts=True, too."
        )
    return amounts if like is None else like.plan.amounts


def named(species: Sequence[str], like: Any) -> tuple[str, ...]:
    """The species that are compared: those given, or those of `like`."""
    check_like(like)
    if species:
        for name in species if isinstance(species, (list, tuple)) else ():
            if isinstance(name, str) and not name.removeprefix("out.").isidentifier():
                raise checks.input_error(
                    "Observed.species", name, "the name of a species of the scene, such as 'gfp'",
                    f"Then columns={{'gfp': {name!r}}} says which column of the table it is.",
                )  # fmt: skip
        return species_names("Observed.species", species)
    return () if like is None else like.plan.species


def check_like(like: object) -> None:
    if not isinstance(getattr(like, "plan", like), ColonyStatistics | None):
        raise checks.input_error("Observed(like)", like, "another Observed, or None")


def with_caps(length_with_caps: bool, like: Any) -> bool:
    """Whether lengths include the caps: as given, or as those of `like`."""
    check_like(like)
    return length_with_caps if like is None else like.plan.length_with_caps


def shared_plan(known: ColonyStatistics, like: Any) -> ColonyStatistics:
    """The statistics of `like`. known: those that the data have. Raises InputError where they lack
    one, or have other species."""
    plan = like.plan
    if plan.species != known.species:
        rule = f"that of like, {list(plan.species)}"
        raise checks.input_error("Observed(species)", list(known.species), rule)
    for name, group in (("lengths", "length"), ("ages", "age"), ("positions", "extent"),
                        ("alignment", "alignment")):  # fmt: skip
        if getattr(plan, name) and not getattr(known, name):
            rule = f"of statistics that these data have: they have no {name}"
            hint = "" if name == "positions" else f"Give like=….without({group!r})."
            raise checks.input_error("Observed(like)", like.describe(), rule, hint)
    return plan
