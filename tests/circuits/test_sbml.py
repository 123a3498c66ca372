"""Models of SBML and Antimony as circuits: courses of one cell beside hand-written equations."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from modelled import (
    QUORUM,
    REPRESSILATOR,
    TOGGLE,
    apply,
    course,
    exact,
    law,
    quorum_by_hand,
    read,
    repressilator_by_hand,
    sbml,
    toggle_by_hand,
)

import torchfilm as tf

TIGHT = {"rtol": 1e-6, "atol": 1e-12, "backend": "torch"}
HOURS = [0.0, 0.1, 0.25, 0.5, 1.0]


def close(found, wanted, relative=1e-5):
    np.testing.assert_allclose(found, wanted, rtol=relative, atol=1e-8)


def test_the_repressilator_runs_as_its_equations_in_minutes():
    times = [0.0, 0.05, 0.1, 0.2]
    found = course(read(REPRESSILATOR, **{**TIGHT, "rtol": 1e-5}), times)
    wanted = exact(repressilator_by_hand, [0.5, 2, 1, 0.5, 2, 1], [60 * t for t in times])
    close(np.array(list(found.values())), wanted, 1e-3)


def test_the_repressilator_is_compiled(plain):
    """By the same functions as a circuit that was written by hand."""
    scene = tf.Scene(read(REPRESSILATOR), founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]]), dt=0.01)
    assert "computed by compiled functions of its equations" in tf.explain(scene)


def test_its_equations_are_those_of_the_model():
    """The size of the compartment is gone, and rates are per hour: a minute has 60th of it."""
    lines = str(read(REPRESSILATOR).graph).splitlines()
    assert lines[0] == "d m1/dt = 60·(a0 + a/(p3^n + 1) − loss_m1_k·m1)"
    assert lines[3] == "d p1/dt = 60·(b·m1 − b·p1)"


def test_the_toggle_switch_runs_as_its_equations():
    times = [0.0, 0.5, 1.0, 2.0, 2.5, 4.0, 8.0]
    circuit = read(TOGGLE, **TIGHT)
    found = course(circuit, times)
    assert circuit.initial["u"] == 0.5  # α/8, not the number of the species
    assert circuit.species == ("u", "v", "model_time")
    close(np.array([found["u"], found["v"]]), exact(toggle_by_hand, [0.5, 3], times), 1e-4)
    assert found["u"][-1] > 2 > found["v"][-1]  # the inducer has switched it
    close(found["model_time"], times)


def test_a_signal_outside_is_exchanged_as_by_hand():
    made = tf.Circuit.from_antimony(QUORUM, signals={"ahl_out": "ahl"}, backend="torch")
    hand = tf.Circuit(
        quorum_by_hand, species=("luxi", "ahl"), initial={"luxi": 1.0, "ahl": 0.5},
        backend="torch", cytosol=2.0, basal=0.1, k=2.0, K=0.7, loss=0.5, s=0.8, D=3.0,
    )  # fmt: skip
    assert made.graph.signals == ("ahl",)
    ends = []
    for circuit in (made, hand):
        medium = tf.Medium(ahl=tf.Signal(diffusion=50.0), box=((-8, -8), (8, 8)), spacing=4.0)
        colony = (tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2))
        scene = tf.Scene(*colony, circuit, medium, dt=0.02)
        start = scene.bind(dtype=torch.float64).start()
        *_, end = tf.simulate(scene, start, until=1.0)
        ends.append(end)
    for name in ("luxi", "ahl"):
        torch.testing.assert_close(ends[0].fields[name], ends[1].fields[name], rtol=1e-6, atol=0.0)
    outside = [e.signals["ahl"].sum() for e in ends]
    assert outside[0] > 0
    torch.testing.assert_close(*outside, rtol=1e-6, atol=0.0)


def test_what_leaves_the_cell_arrives_outside():
    """Amounts are kept although the model's cytosol has 2 µm³ and this cell another volume."""
    circuit = tf.Circuit.from_antimony(
        QUORUM, signals={"ahl_out": "ahl"}, without="synthesis", backend="torch"
    )
    medium = tf.Medium(ahl=tf.Signal(diffusion=50.0), box=((-8, -8), (8, 8)), spacing=4.0)
    founders = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
    scene = tf.Scene(circuit, medium, founders=founders, dt=0.02)
    start = scene.bind(dtype=torch.float64).start()
    *_, end = tf.simulate(scene, start, until=0.5)
    per_hour = circuit.graph.evaluate(
        {"luxi": 0, "ahl": 1, "out.ahl": 0, "cell.volume": 5, "basal": 0, "k": 0, "K": 1, "loss": 0,
         "D": 3, "cytosol": 2}
    )  # fmt: skip
    assert per_hour["ahl"] * 5 == -per_hour["out.ahl"]
    assert end.ahl < 0.25


def test_antimony_is_the_same_model():
    text = """
    model toggle
      compartment cell = 2; species u in cell, v in cell
      free := piecewise(v/5, time >= 2, v)
      u' = alpha/(1 + free^n) - u
      v' = alpha/(1 + u^n) - v
      u = alpha/8; v = 3; alpha = 4; n = 2
    end"""
    times = [0.0, 1.0, 2.0, 4.0]
    found = course(tf.Circuit.from_antimony(text, **TIGHT), times)
    wanted = course(read(TOGGLE, **TIGHT), times)
    for name in wanted:
        close(found[name], wanted[name], 1e-5)


def test_a_file_is_read(tmp_path):
    path = tmp_path / "toggle.xml"
    path.write_text(TOGGLE)
    assert str(tf.Circuit.from_sbml(path).graph) == str(read(TOGGLE).graph)


def test_constants_are_parameters_of_every_form():
    circuit = read(TOGGLE, alpha=torch.tensor([2.0, 8.0]), n=tf.LogNormal(2.0, 0.1),
                   initial={"u": 1.0}, backend="torch")  # fmt: skip
    scene = tf.Scene(circuit, founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]]), dt=0.1)
    *_, end = tf.simulate(scene, until=1.0, colonies=2)
    assert end.u[1] > end.u[0]


def test_first_values_follow_constants():
    assert read(TOGGLE, alpha=8.0).initial["u"] == 1.0


def test_a_first_value_cannot_follow_a_drawn_constant():
    with pytest.raises(tf.InputError, match=r"model.xml: .*'alpha'.*one number.*initial="):
        read(TOGGLE, alpha=tf.LogNormal(4.0, 0.1))


CHAIN = """
compartment c = {size}; {amounts} species A in c, B in c; $E in c; species E
J: 2 A -> 3 B; k*A*E
A = 4; B = 0; E = 0.5; k = 0.3
"""


def test_stoichiometry_and_compartments_scale_rates():
    """Concentrations: the law is an amount, so its rates are over the size."""
    found = course(tf.Circuit.from_antimony(CHAIN.format(size=2, amounts=""), **TIGHT), HOURS)
    decay = 2 * 0.3 * 0.5 / 2
    a = 4 * np.exp(-decay * np.array(HOURS))
    close(found["A"], a)
    close(found["B"], 1.5 * (4 - a))


def test_amounts_are_not_over_the_size():
    text = CHAIN.format(size=2, amounts="substanceOnly").replace("$E in c; species E", "")
    text = text.replace("*E", "").replace("E = 0.5;", "")
    found = course(tf.Circuit.from_antimony(text, **TIGHT), HOURS)
    close(found["A"], 4 * np.exp(-0.6 * np.array(HOURS)))


def test_a_boundary_species_is_a_constant():
    circuit = tf.Circuit.from_antimony(CHAIN.format(size=1, amounts=""), E=2.0)
    assert "E" not in circuit.species and circuit.parameters["E"] == 2.0


def test_dilution_is_of_species_and_can_be_left_out():
    text = "species A; A = 5; k' = 0; k = 2; A' = 0*k"
    colony = (tf.Growth(rate=1.0),)
    for dilution, diluted in ((True, True), (False, False), (("A",), True)):
        circuit = tf.Circuit.from_antimony(text, dilution=dilution, backend="torch")
        *_, end = tf.simulate(tf.Scene(*colony, circuit, dt=0.1), until=1.0)
        assert (float(end.A[0]) < 4) == diluted
        assert float(end.k[0]) == 2.0


def test_a_compartment_can_be_the_cell():
    """Of a law that is an amount, the rate falls as the cell grows; 1 fl is 1 µm³."""
    circuit = tf.Circuit.from_antimony(
        "unit fl = 1e-15 litre; compartment c; c has fl; c = 1; species A in c; A = 0;"
        "-> A; k; k = 3",
        properties={"c": "volume"},
    )
    assert circuit.graph.equations == "d A/dt = k/cell.volume"


def test_litres_become_cubic_micrometres():
    circuit = tf.Circuit.from_antimony(
        "compartment c; c has litre; c = 1; species A in c; A = 0; -> A; k; k = 3",
        properties={"c": "volume"},
    )
    rates = circuit.graph.evaluate({"k": 3e-15, "cell.volume": 2.0})
    close(rates["A"], 1.5)


def test_roots_of_litres_become_micrometres():
    """The edge of a litre is a tenth of a metre, 1e5 µm."""
    body = (
        '<listOfUnitDefinitions><unitDefinition id="edge"><listOfUnits><unit kind="litre"'
        f' exponent="{1 / 3!r}" scale="0" multiplier="1"/></listOfUnits></unitDefinition>'
        '</listOfUnitDefinitions><listOfCompartments><compartment id="c" size="1" constant="true"/>'
        '</listOfCompartments><listOfSpecies><species id="A" compartment="c" initialAmount="1"'
        ' hasOnlySubstanceUnits="true" boundaryCondition="false" constant="false"/></listOfSpecies>'
        '<listOfParameters><parameter id="l" value="1" units="edge" constant="true"/>'
        '</listOfParameters><listOfRules><rateRule variable="A"><math><ci>l</ci></math></rateRule>'
        "</listOfRules>"
    )
    rates = read(sbml(body), properties={"l": "length"}).graph.evaluate({"cell.length": 3.0})
    assert float(rates["A"]) == pytest.approx(3e-5)


@pytest.mark.parametrize(
    "unit, factor", [("s", 3600), ("min", 60), ("h", 1), ("day", 1 / 24), (None, 1)]
)
def test_rates_become_per_hour(unit, factor):
    circuit = tf.Circuit.from_antimony("species A; A' = -k*A; A = 1; k = 1", time_unit=unit)
    close(circuit.graph.evaluate({"A": 1.0, "k": 1.0})["A"], -factor)


def test_level_2_is_in_seconds_where_it_does_not_say():
    body = (
        '<listOfCompartments><compartment id="c" size="1"/></listOfCompartments><listOfSpecies>'
        '<species id="A" compartment="c" initialConcentration="1"/></listOfSpecies>'
        "<listOfReactions>" + law("J", "A", "", apply("times", "A", 0.5)) + "</listOfReactions>"
    )
    assert read(sbml(body, 2, 4)).graph.evaluate({"A": 1.0, "c": 1.0})["A"] == -1800


def test_names_that_torchfilm_uses_get_an_underscore():
    circuit = tf.Circuit.from_antimony("species x; x' = -method*x; x = 1; method = 2")
    assert circuit.species == ("x_",) and circuit.parameters == {"method_": 2.0}
    again = tf.Circuit.from_antimony(
        "species x; x' = -method*x; x = 1; method = 2", initial={"x_": 3.0}, method_=4.0
    )
    assert again.initial == {"x_": 3.0} and again.parameters == {"method_": 4.0}


FORMULAS = {
    "arcsin(x)": np.arcsin, "arccos(x)": np.arccos, "arctan(x)": np.arctan,
    "arcsinh(-x)": lambda x: np.arcsinh(-x), "arccosh(x + 1)": lambda x: np.arccosh(x + 1),
    "arctanh(x)": np.arctanh, "sec(x)": lambda x: 1 / np.cos(x),
    "coth(x)": lambda x: 1 / np.tanh(x),
    "arccot(x)": lambda x: np.arctan(1 / x), "root(3, x)": np.cbrt, "sqrt(x)": np.sqrt,
    "log10(x)": np.log10, "ln(x)": np.log, "log(2, x)": np.log2,
    "ceil(7*x)": lambda x: np.ceil(7 * x),
    "floor(-7*x)": lambda x: np.floor(-7 * x), "factorial(4)*x": lambda x: 24 * x,
    "max(x, 0.3, 2*x)": lambda x: max(0.3, 2 * x), "min(x, 0.3)": lambda x: min(x, 0.3),
    "rem(-7*x, 2)": lambda x: np.fmod(-7 * x, 2), "quotient(-7*x, 2)": lambda x: np.trunc(-3.5 * x),
    "rem(7*x, -2)": lambda x: np.fmod(7 * x, -2), "quotient(7*x, -2)": lambda x: np.trunc(-3.5 * x),
    "rem(-7*x, -2)": lambda x: np.fmod(-7 * x, -2),
    "quotient(-7*x, -2)": lambda x: np.trunc(3.5 * x),
    "piecewise(1, x > 0.5 && x < 0.7, 2, x == 0.25, 3)": lambda x: {0.25: 2, 0.6: 1}.get(x, 3),
    "piecewise(1, xor(x > 0.5, x > 0.2), 0)": lambda x: float(0.2 < x <= 0.5),
    "piecewise(1, !(x > 0.5) || x > 0.7, 0)": lambda x: float(x <= 0.5 or x > 0.7),
    "piecewise(x, 2 > 1, 3)": lambda x: x,
    "(x > 0.5) + 1": lambda x: (x > 0.5) + 1.0, "exp(x)^-x": lambda x: np.exp(x) ** -x,
    "abs(-x)*pi": lambda x: np.pi * x, "avogadro*1e-23*x": lambda x: 6.02214179 * x,
}  # fmt: skip


@pytest.mark.parametrize("formula", FORMULAS)
def test_formulas_have_their_values(formula):
    own = re.sub(r"\bx\b", "A", formula)  # the position of a cell has the name x
    circuit = tf.Circuit.from_antimony(f"species A; A' = {own}; A = 1")
    places = [0.25, 0.6, 0.9]
    found = circuit.graph.evaluate({"A": places})["A"].expand(3)
    close(found, [FORMULAS[formula](x) for x in places], 1e-13)


def test_rates_of_other_quantities_can_be_read():
    circuit = tf.Circuit.from_antimony(
        "species A, B; A' = -2*A; B' = 3*rateOf(A); A = 1; B = 9; ", **TIGHT
    )
    found = course(circuit, HOURS)
    close(found["B"], 9 - 3 * (1 - np.exp(-2 * np.array(HOURS))))


def test_a_parameter_of_a_law_has_no_rate():
    """Although another of its name has one."""
    body = (
        '<listOfCompartments><compartment id="c" size="1" constant="true"/></listOfCompartments>'
        '<listOfSpecies><species id="A" compartment="c" initialAmount="4" constant="false"'
        ' hasOnlySubstanceUnits="true" boundaryCondition="false"/></listOfSpecies>'
        '<listOfParameters><parameter id="k" value="1" constant="false"/></listOfParameters>'
        '<listOfRules><rateRule variable="k"><math><cn>2</cn></math></rateRule></listOfRules>'
        '<listOfReactions><reaction id="J" reversible="false"><listOfReactants>'
        '<speciesReference species="A" stoichiometry="1" constant="true"/></listOfReactants>'
        '<kineticLaw><math><apply><csymbol encoding="text" definitionURL='
        '"http://www.sbml.org/sbml/symbols/rateOf">rateOf</csymbol><ci>k</ci></apply></math>{}'
        "</kineticLaw></reaction></listOfReactions>"
    )
    own = '<listOfLocalParameters><localParameter id="k" value="3"/></listOfLocalParameters>'
    assert read(sbml(body.format(own))).graph.equations == "d k/dt = 2\nd A/dt = 0"
    assert read(sbml(body.format(""))).graph.equations == "d A/dt = −2\nd k/dt = 2"


def test_a_point_has_the_size_that_it_is_given():
    for size, rate in ((' size="2"', -0.3), ("", -0.6)):
        body = (
            f'<listOfCompartments><compartment id="c" spatialDimensions="0"{size} constant="true"/>'
            '</listOfCompartments><listOfSpecies><species id="A" compartment="c" initialAmount="4"'
            ' hasOnlySubstanceUnits="false" boundaryCondition="false" constant="false"/>'
            '</listOfSpecies><listOfReactions><reaction id="J" reversible="false"><listOfReactants>'
            '<speciesReference species="A" stoichiometry="1" constant="true"/></listOfReactants>'
            "<kineticLaw><math><cn>0.6</cn></math></kineticLaw></reaction></listOfReactions>"
        )
        values = {"A": 1.0, "c": 2.0} if size else {"A": 1.0}
        found = read(sbml(body)).graph.evaluate(values)
        assert float(found["A"]) == rate


def test_a_drawing_of_the_model_is_left_aside():
    drawn = TOGGLE.replace(
        "<sbml", '<sbml xmlns:render="http://www.sbml.org/sbml/level3/version1/render/version1"', 1
    )
    assert str(read(drawn).graph) == str(read(TOGGLE).graph)


def test_a_compartment_that_grows_dilutes_what_is_in_it():
    circuit = tf.Circuit.from_antimony(
        "compartment c; c = 1; c' = 0.5*c; species A in c; A = 2; A -> ; c*0.25*A", **TIGHT
    )
    close(course(circuit, HOURS)["A"], 2 * np.exp(-0.75 * np.array(HOURS)))


def test_long_sums_are_read():
    text = f"species A; A = 1; A' = {' + '.join(['A'] * 1000)}"
    assert float(tf.Circuit.from_antimony(text).graph.evaluate({"A": 1.0})["A"]) == 1000


def test_a_first_value_from_a_rate_follows_the_parameters_that_are_given():
    body = (
        '<listOfCompartments><compartment id="c" size="1" constant="true"/></listOfCompartments>'
        '<listOfSpecies><species id="A" compartment="c" initialConcentration="3"'
        ' hasOnlySubstanceUnits="false" boundaryCondition="false" constant="false"/>'
        '<species id="B" compartment="c" hasOnlySubstanceUnits="false" boundaryCondition="false"'
        ' constant="false"/></listOfSpecies><listOfInitialAssignments>'
        '<initialAssignment symbol="B"><math><ci>R1</ci></math></initialAssignment>'
        '</listOfInitialAssignments><listOfReactions><reaction id="R1" reversible="false">'
        '<listOfReactants><speciesReference species="A" stoichiometry="1" constant="true"/>'
        "</listOfReactants><kineticLaw><math><apply><times/><ci>k</ci><ci>A</ci></apply></math>"
        '<listOfLocalParameters><localParameter id="k" value="2"/></listOfLocalParameters>'
        "</kineticLaw></reaction></listOfReactions>"
    )
    assert read(sbml(body)).initial["B"] == 6.0
    assert read(sbml(body), R1_k=5.0).initial["B"] == 15.0
    with pytest.raises(tf.InputError, match="computes first values from 'R1_k', so it must be one"):
        read(sbml(body), R1_k={0: 5.0, 1: 2.0})
