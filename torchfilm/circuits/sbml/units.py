"""Units of a model: those that torchfilm must know are converted, or refused by name.

SBML itself converts nothing: the numbers of a formula are used as they are, in the units of the
model. So concentrations and parameters keep the model's units here, too. Converted are hours, and
what a cell has in µm: see `seconds` and `micrometres`.
"""

from __future__ import annotations

from typing import Any

from torchfilm.tools.checks import InputError, choice

HOUR = 3600.0
TIMES = {"s": 1.0, "min": 60.0, "h": HOUR, "day": 24 * HOUR}  # seconds
# Powers of a metre by units of size.
METRES = {"metre": 1, "litre": 3}


def hours(model: Any, wanted: str | None) -> float:
    """Units of the model's time in an hour.

    wanted: "s", "min", "h" or "day" in place of what the model declares. A model of Level 3 that
    declares nothing is in hours; Levels 1 and 2 are in seconds then, as they define. Raises
    InputError for a unit that is no time.
    """
    if wanted is not None:
        choice("time_unit", wanted, tuple(TIMES))
        return HOUR / TIMES[wanted]
    level = model.getLevel()
    name = model.getTimeUnits() if level > 2 else "time"
    if level > 2 and not name:
        return 1.0
    definition = model.getUnitDefinition(name)
    if definition is None:
        if name == "second" or level < 3:
            return HOUR
        raise _no_time(name)
    units = list(definition.getListOfUnits())
    factor = 1.0
    for unit in units:
        kind = unit.isSecond()
        if not (kind or unit.isDimensionless()) or (kind and unit.getExponentAsDouble() != 1):
            raise _no_time(name)
        factor *= _scale(unit)
    if sum(bool(unit.isSecond()) for unit in units) != 1:
        raise _no_time(name)
    return HOUR / factor


def _no_time(name: str) -> InputError:
    return InputError(
        f"the unit of time {name!r} is no multiple of a second: say what it is, as"
        f" time_unit={' or '.join(map(repr, TIMES))}"
    )


def _scale(unit: Any) -> float:
    """The number of base units in a unit."""
    one = unit.getMultiplier() * 10.0 ** unit.getScale()
    return float(one ** unit.getExponentAsDouble())


def micrometres(model: Any, unit: str, power: int, what: str) -> float:
    """The model's units in one µm to a power: 1e-15 for litres and a volume, 1 where there is no
    unit. Raises InputError, naming `what`, for a unit that is no such power."""
    if not unit:
        return 1.0
    definition = model.getUnitDefinition(unit)
    metres, exponent = 1.0, 0.0
    if definition is None:
        if unit not in METRES:
            raise _no_size(what, unit, power)
        metres, exponent = (1e-3 if unit == "litre" else 1.0), METRES[unit]
    else:
        for each in definition.getListOfUnits():
            metres *= _scale(each)
            if each.isDimensionless():
                continue
            if not (each.isMetre() or each.isLitre()):
                raise _no_size(what, unit, power)
            exponent += each.getExponentAsDouble() * (3 if each.isLitre() else 1)
            metres *= 1e-3 ** each.getExponentAsDouble() if each.isLitre() else 1.0
    if exponent != power:
        raise _no_size(what, unit, power)
    # by whole powers of ten, so that 1 fl is 1 µm³ and not 1 − 1e-16
    found = 1e-6**power / metres
    return round(found) if abs(found - round(found)) < 1e-9 * found else found


def _no_size(what: str, unit: str, power: int) -> InputError:
    return InputError(
        f"{what} has the unit {unit!r}, which is no {('length', 'area', 'volume')[power - 1]}"
    )


def check_laws(model: Any) -> None:
    """Raise InputError for a kinetic law with units of its own, as early versions allow."""
    for reaction in model.getListOfReactions():
        law = reaction.getKineticLaw()
        if law is None:
            continue
        for what, given in (("timeUnits", law.isSetTimeUnits()),
                            ("substanceUnits", law.isSetSubstanceUnits())):  # fmt: skip
            if given:
                raise InputError(
                    f"the kinetic law of {reaction.getId()!r} has {what} of its own, which"
                    " torchfilm does not read: use those of the model"
                )
