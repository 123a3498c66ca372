"""Shared by the tests of SBML: models in the style of the format, and their course in one cell."""

from __future__ import annotations

import numpy as np
import torch
from scipy.integrate import solve_ivp

import torchfilm as tf
from torchfilm.effects.circuit import OPTION_NAMES
from torchfilm.effects.circuit_sbml import keywords, model_choices

SPACES = {
    (1, 2): "http://www.sbml.org/sbml/level1",
    (2, 4): "http://www.sbml.org/sbml/level2/version4",
    (3, 1): "http://www.sbml.org/sbml/level3/version1/core",
    (3, 2): "http://www.sbml.org/sbml/level3/version2/core",
}


def sbml(body: str, level: int = 3, version: int = 2, attributes: str = "") -> str:
    """A model as a file: what is inside, with math in short, `<math>…</math>`."""
    space = SPACES[level, version]
    body = body.replace("<math>", '<math xmlns="http://www.w3.org/1998/Math/MathML">')
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<sbml xmlns="{space}" level="{level}" version="{version}">\n'
        f'<model id="tested" {attributes}>\n{body}\n</model>\n</sbml>\n'
    )


def law(name: str, reactants: str, products: str, math: str, modifiers: str = "", more: str = ""):
    """A reaction of Level 2, with ids of species by spaces."""
    sides = "".join(
        f"<listOf{kind}>{''.join(f'<{tag} species={n!r}/>' for n in names.split())}</listOf{kind}>"
        for kind, tag, names in (
            ("Reactants", "speciesReference", reactants),
            ("Products", "speciesReference", products),
            ("Modifiers", "modifierSpeciesReference", modifiers),
        )
        if names
    )
    return (
        f'<reaction id="{name}" reversible="false">{sides}'
        f"<kineticLaw><math>{math}</math>{more}</kineticLaw></reaction>"
    )


def apply(op: str, *args: object) -> str:
    """An operation in MathML; names and numbers as they are."""
    done = [
        a if str(a).startswith("<") else f"<ci>{a}</ci>" if isinstance(a, str) else f"<cn>{a}</cn>"
        for a in args
    ]
    head = f"<ci>{op[1:]}</ci>" if op.startswith("@") else f"<{op}/>"
    return f"<apply>{head}{''.join(done)}</apply>"


def _repressilator() -> str:
    """Elowitz and Leibler's, of Level 2 Version 4: time in minutes, one parameter in its law."""
    pairs = (("1", "3"), ("2", "1"), ("3", "2"))
    species = "".join(
        f'<species id="{kind}{k}" compartment="cell" initialConcentration="{first}"/>'
        for kind in "mp" for k, first in zip("123", ("0.5", "2", "1"), strict=True)
    )  # fmt: skip
    reactions = ""
    for own, other in pairs:
        power = apply("power", f"p{other}", "n")
        made = apply("plus", "a0", apply("divide", "a", apply("plus", 1, power)))
        made = apply("times", "cell", made)
        reactions += law(f"transcription{own}", "", f"m{own}", made, f"p{other}")
        reactions += law(
            f"loss_m{own}",
            f"m{own}",
            "",
            apply("times", "cell", "k", f"m{own}"),
            "",
            '<listOfParameters><parameter id="k" value="1"/></listOfParameters>',
        )
        reactions += law(
            f"translation{own}", "", f"p{own}", apply("times", "cell", "b", f"m{own}"), f"m{own}"
        )
        reactions += law(f"loss_p{own}", f"p{own}", "", apply("times", "cell", "b", f"p{own}"))
    values = {"a": 20, "a0": 0.2, "n": 2, "b": 0.3}
    parameters = "".join(f'<parameter id="{n}" value="{x}"/>' for n, x in values.items())
    return sbml(
        '<listOfUnitDefinitions><unitDefinition id="time"><listOfUnits><unit kind="second"'
        ' multiplier="60"/></listOfUnits></unitDefinition></listOfUnitDefinitions>'
        '<listOfCompartments><compartment id="cell" size="1e-15"/></listOfCompartments>'
        f"<listOfSpecies>{species}</listOfSpecies><listOfParameters>{parameters}</listOfParameters>"
        f"<listOfReactions>{reactions}</listOfReactions>",
        2, 4,
    )  # fmt: skip


REPRESSILATOR = _repressilator()


def repressilator_by_hand(t: float, y: np.ndarray) -> list[float]:
    """Per minute."""
    m, p = y[:3], y[3:]
    made = [0.2 + 20 / (1 + p[k] ** 2) for k in (2, 0, 1)]
    return [*(made[k] - m[k] for k in range(3)), *(0.3 * (m[k] - p[k]) for k in range(3))]


# A switch with rate rules, a function, an assignment rule, a first value that is computed, and an
# inducer from 2 h on.
TOGGLE = sbml(
    '<listOfFunctionDefinitions><functionDefinition id="hill"><math><lambda><bvar><ci>x</ci></bvar>'
    f"<bvar><ci>n</ci></bvar>{apply('divide', 1, apply('plus', 1, apply('power', 'x', 'n')))}"
    "</lambda></math></functionDefinition></listOfFunctionDefinitions>"
    '<listOfCompartments><compartment id="cell" size="2" spatialDimensions="3" constant="true"/>'
    "</listOfCompartments><listOfSpecies>"
    + "".join(
        f'<species id="{n}" compartment="cell" initialConcentration="{x}" constant="false"'
        f' hasOnlySubstanceUnits="false" boundaryCondition="false"/>'
        for n, x in (("u", 0.1), ("v", 3))
    )
    + "</listOfSpecies><listOfParameters>"
    + "".join(
        f'<parameter id="{n}" value="{x}" constant="{c}"/>'
        for n, x, c in (("alpha", 4, "true"), ("n", 2, "true"), ("free", 0, "false"))
    )
    + "</listOfParameters><listOfInitialAssignments><initialAssignment symbol='u'><math>"
    + apply("divide", "alpha", 8)
    + "</math></initialAssignment></listOfInitialAssignments><listOfRules>"
    "<assignmentRule variable='free'><math><piecewise><piece>"
    + apply("divide", "v", 5)
    + apply(
        "geq",
        '<csymbol encoding="text" definitionURL="http://www.sbml.org/sbml/symbols/time">t'
        "</csymbol>",
        2,
    )
    + "</piece><otherwise><ci>v</ci></otherwise></piecewise></math></assignmentRule>"
    "<rateRule variable='u'><math>"
    + apply("minus", apply("times", "alpha", apply("@hill", "free", "n")), "u")
    + "</math></rateRule><rateRule variable='v'><math>"
    + apply("minus", apply("times", "alpha", apply("@hill", "u", "n")), "v")
    + "</math></rateRule></listOfRules>",
    attributes='timeUnits="hour"',
).replace(
    "<listOfCompartments>",
    '<listOfUnitDefinitions><unitDefinition id="hour"><listOfUnits><unit kind="second"'
    ' exponent="1" scale="0" multiplier="3600"/></listOfUnits></unitDefinition>'
    "</listOfUnitDefinitions><listOfCompartments>",
)


def toggle_by_hand(t: float, y: np.ndarray) -> list[float]:
    free = y[1] / 5 if t >= 2 else y[1]
    return [4 / (1 + free**2) - y[0], 4 / (1 + y[0] ** 2) - y[1]]


# LuxI makes AHL, which leaves the cell and comes back: by molecules that pass the membrane.
QUORUM = """
model quorum
  compartment cytosol = 2, outside = 1000;
  species luxi in cytosol, ahl in cytosol, ahl_out in outside;
  luxi = 1; ahl = 0.5; ahl_out = 0;
  make: -> luxi; cytosol*(basal + k*ahl^2/(K^2 + ahl^2))
  lose: luxi -> ; cytosol*loss*luxi
  synthesis: -> ahl; cytosol*s*luxi
  leave: ahl -> ahl_out; D*(ahl - ahl_out)
  basal = 0.1; k = 2; K = 0.7; loss = 0.5; s = 0.8; D = 3;
end
"""


def quorum_by_hand(u, s, p, cell):
    leave = p.D * (u.ahl - s.ahl)
    grown = p.basal + p.k * u.ahl**2 / (p.K**2 + u.ahl**2)
    rates = {"luxi": grown - p.loss * u.luxi, "ahl": p.s * u.luxi - leave / p.cytosol}
    return rates, {"ahl": leave / p.cytosol * cell.volume}


def read(text: str, **given) -> tf.Circuit:
    """The circuit of a model in SBML, as `Circuit.from_sbml` makes it of a file."""
    names = ("signals", "properties", "without", "time_unit", "initial")
    defaults = ((), None, (), None, None)
    said = [given.pop(n, x) for n, x in zip(names, defaults, strict=True)]
    dilution = given.pop("dilution", True)
    choices = model_choices(*said, given, OPTION_NAMES)
    return tf.Circuit(**keywords(text, "model.xml", choices, dilution, given))


def course(circuit: tf.Circuit, hours: list[float]) -> dict[str, np.ndarray]:
    """Species at the times, in one cell that does not grow."""
    cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
    model = tf.Scene(circuit, founders=cells).bind(dtype=torch.float64)
    state, now, found = model.start(), 0.0, []
    for time in hours:
        if time > now:
            state, now = model.step(state, time - now), time
        assert tf.failures(state) == []
        found.append([float(state.fields[n][0]) for n in circuit.species])
    return dict(zip(circuit.species, np.array(found).T, strict=True))


def exact(rates, first: list[float], times: list[float]) -> np.ndarray:
    """The course of hand-written equations, (S, T), in pieces where they jump."""
    return solve_ivp(
        rates, (0, times[-1]), first, "LSODA", times, rtol=1e-10, atol=1e-12, max_step=0.05
    ).y
