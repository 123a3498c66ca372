"""Names of units of concentrations, which a user may choose, and what they mean."""

from __future__ import annotations

import re

from torchfilm.tools import checks

CONCENTRATION = "conc"  # of species and signals whose unit is not named
AVOGADRO = 6.02214076e23
LITRE = 1e15  # µm³
MOLAR = {"M": 1.0, "mM": 1e-3, "µM": 1e-6, "nM": 1e-9, "pM": 1e-12}
# Molecules in a unit of concentration × µm³, of units that count molecules.
MOLECULES = {"molecules/µm³": 1.0} | {n: x * AVOGADRO / LITRE for n, x in MOLAR.items()}
MASSES = ("g/L", "mg/L", "µg/L", "ng/L", "mg/mL", "µg/mL", "ng/mL")
NAMED = (*MOLECULES, *MASSES, "a.u.")
AMOUNT = "·µm³"  # what a unit of concentration is times a volume
CLOSE = 0.01  # how far molecules_per_unit may be from that of a unit, relative


def is_concentration(unit: str) -> bool:
    """Whether a unit is one of concentrations."""
    return unit == CONCENTRATION or unit in NAMED


def checked_unit(name: str, given: object) -> str:
    """The name of a unit of concentrations as torchfilm writes it; u and the Greek letter μ stand
    for the micro sign."""
    text = given.strip() if isinstance(given, str) else None
    if text is not None:
        text = re.sub("^u|(?<=/)u|\N{GREEK SMALL LETTER MU}", "\N{MICRO SIGN}", text)
        text = re.sub(r"m\^?3$", "m³", text).removesuffix("l") + "L" * text.endswith("l")
    if text is None or not is_concentration(text):
        rule = f"a unit of concentration: one of {', '.join(NAMED)}"
        raise checks.input_error(name, given, rule, "Leave it out for a unit of your own.")
    return text


def differ(one: str, other: str) -> bool:
    """Whether two units are different ones; a concentration without a named unit fits any, and so
    does an amount by it."""
    if one.endswith(AMOUNT) and other.endswith(AMOUNT):
        one, other = one.removesuffix(AMOUNT), other.removesuffix(AMOUNT)
    if CONCENTRATION in (one, other) and is_concentration(one) and is_concentration(other):
        return False
    return one != other
