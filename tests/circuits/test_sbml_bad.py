"""Files that are no SBML, and models that torchfilm does not simulate: refused with line or id."""

from __future__ import annotations

import gzip
import math
import re
import sys
import warnings

import pytest
from modelled import QUORUM, REPRESSILATOR, TOGGLE, apply, law, read, sbml

import torchfilm as tf

HEAD = (
    '<listOfCompartments><compartment id="c" size="1" constant="true"/></listOfCompartments>'
    '<listOfSpecies><species id="A" compartment="c" initialConcentration="1" constant="false"'
    ' boundaryCondition="false" hasOnlySubstanceUnits="false"/></listOfSpecies>'
    '<listOfParameters><parameter id="k" value="1" constant="false"/></listOfParameters>'
)
RATE = "<listOfRules><rateRule variable='A'><math>{}</math></rateRule></listOfRules>"
TRIGGER = (
    f"<trigger initialValue='true' persistent='true'><math>{apply('gt', 'A', 1)}</math></trigger>"
)

FILES = {
    "empty": (b"", r"is empty"),
    "blank": (b"\n \n", r"is empty"),
    "truncated": (TOGGLE[: len(TOGGLE) // 2].encode(), r"line \d+: this is no XML: .*complete"),
    "no XML": (b"name,value\nk,1\n", r"line 1: this is no XML"),
    "Latin-1": (TOGGLE.replace("tested", "régulé").encode("latin-1"), r"not UTF-8 \(line 3, byte"),
    "another encoding": (TOGGLE.replace("UTF-8", "ISO-8859-1").encode(),
                         r"line 1: the encoding is ISO-8859-1; SBML is UTF-8"),
    "UTF-16": (TOGGLE.encode("utf-16"), r"not UTF-8"),
    "another format": (b"<cellml><model/></cellml>", r"line 1: this is no SBML: .*cellml"),
    "a zero byte": (b"\0" * 40, "this is no XML"),
    "no model": (re.sub(r"<model.*</model>", "", TOGGLE, flags=re.DOTALL).encode(),
                 "has no model"),
    "no number": (REPRESSILATOR.replace("<cn>1</cn>", "<cn>one</cn>", 1).encode(),
                  r"line \d+: 'one' is no number"),
    "a number too large": (REPRESSILATOR.replace("<cn>1</cn>", "<cn>1e999</cn>", 1).encode(),
                           r"line \d+: this is no valid SBML"),
    "an attribute that is no number": (TOGGLE.replace('size="2"', 'size="two"').encode(),
                                       r"line \d+: this is no valid SBML"),
    "deep": (TOGGLE.replace("</math>", "</math>" + "<a>" * 10_000, 1).encode(), "nested more than"),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_no_sbml_is_refused(name, tmp_path):
    content, words = FILES[name]
    path = tmp_path / "model.xml"
    path.write_bytes(content)
    with pytest.raises(tf.InputError, match=r"model\.xml") as error:
        tf.Circuit.from_sbml(path)
    assert re.search(words, str(error.value))


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(tf.InputError, match=r"none\.xml cannot be read: No such file"):
        tf.Circuit.from_sbml(tmp_path / "none.xml")


def test_entities_are_refused_before_they_grow():
    laughs = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 30))
    bomb = TOGGLE.replace("<sbml", f'<!DOCTYPE sbml [<!ENTITY a0 "ha">{laughs}]><sbml', 1).replace(
        'id="tested"', 'id="&a29;"'
    )
    with pytest.raises(tf.InputError, match="line 2: a document type or entity is declared"):
        read(bomb)


def test_files_outside_are_not_read():
    outside = TOGGLE.replace(
        "<sbml", '<!DOCTYPE sbml [<!ENTITY x SYSTEM "file:///etc/hostname">]><sbml', 1
    )
    with pytest.raises(tf.InputError, match="document type or entity"):
        read(outside)


MODELS = {
    "the event 'late' with a delay": sbml(
        HEAD + f"<listOfEvents><event id='late' useValuesFromTriggerTime='true'>{TRIGGER}"
        "<delay><math><cn>1</cn></math></delay></event></listOfEvents>"
    ),
    "the event 'divide' is": sbml(
        HEAD + f"<listOfEvents><event id='divide' useValuesFromTriggerTime='true'>{TRIGGER}"
        "</event></listOfEvents>"
    ),
    "the algebraic rule 'sum' is": sbml(
        HEAD + "<listOfRules><algebraicRule id='sum'><math><ci>A</ci></math></algebraicRule>"
        "</listOfRules>"
    ),
    "the constraint number 1": sbml(
        HEAD + f"<listOfConstraints><constraint><math>{apply('gt', 'A', 1)}</math></constraint>"
        "</listOfConstraints>"
    ),
    "the fast reaction 'J'": sbml(
        HEAD.replace(' constant="false"/>', "/>")
        .replace(' constant="false" boundaryCondition="false" hasOnlySubstanceUnits="false"', "")
        .replace(' constant="true"', "")
        + "<listOfReactions>"
        + law("J", "A", "", "<ci>A</ci>").replace("<reaction", "<reaction fast='true'")
        + "</listOfReactions>",
        2, 4,
    ),
    "in the rate of 'A': the formula uses 'delay'": sbml(
        HEAD + RATE.format(
            '<apply><csymbol encoding="text"'
            ' definitionURL="http://www.sbml.org/sbml/symbols/delay">delay</csymbol>'
            "<ci>A</ci><cn>1</cn></apply>"
        )
    ),
    "the reaction 'J' has no kinetic law": sbml(
        HEAD + '<listOfReactions><reaction id="J" reversible="false"><listOfReactants>'
        '<speciesReference species="A" stoichiometry="1" constant="true"/></listOfReactants>'
        "</reaction></listOfReactions>"
    ),
    "the parameter 'k' has no value: give k=…": sbml(
        HEAD.replace(' value="1"', "") + RATE.format("<ci>k</ci>")
    ),
    "the species 'A' has no first value": sbml(
        HEAD.replace(' initialConcentration="1"', "") + RATE.format("<ci>k</ci>")
    ),
    "'A' is -1 at the start": sbml(
        HEAD.replace('initialConcentration="1"', 'initialConcentration="-1"')
        + RATE.format("<ci>k</ci>")
    ),
    "nothing in the model changes": sbml(""),
    "the unit of time 'dimensionless' is no multiple of a second": sbml(
        HEAD + RATE.format("<ci>k</ci>"), attributes='timeUnits="dimensionless"'
    ),
    "the factorial of a variable": sbml(HEAD + RATE.format(apply("factorial", "A"))),
    "no valid SBML": sbml(HEAD + RATE.format("<ci>nowhere</ci>")),
}  # fmt: skip


@pytest.mark.parametrize("words", MODELS)
def test_what_is_not_simulated_is_refused_by_name(words):
    with pytest.raises(tf.InputError, match=r"^model\.xml") as error:
        read(MODELS[words])
    assert words in str(error.value)


def test_a_package_that_a_model_needs_is_refused():
    text = TOGGLE.replace(
        "<sbml",
        '<sbml xmlns:comp="http://www.sbml.org/sbml/level3/version1/comp/version1"'
        ' comp:required="true"',
        1,
    )
    with pytest.raises(tf.InputError, match="needs the package comp"):
        read(text)


def test_a_value_that_is_missing_can_be_given():
    text = MODELS["the parameter 'k' has no value: give k=…"]
    assert read(text, k=2.0).parameters == {"k": 2.0}
    text = MODELS["the species 'A' has no first value"]
    assert read(text, initial={"A": 2.0}).initial["A"] == 2.0


def test_rules_that_depend_on_each_other_are_refused():
    with pytest.raises(tf.InputError, match="line 1: Loop detected: b's definition"):
        tf.Circuit.from_antimony("a := b + 1; b := a + 1; species S; S' = a; S = 1")


OPTIONS = [
    ({"signals": ("ahl_oot",)}, "signals names 'ahl_oot', which is no species.*'ahl_out'"),
    ({"signals": {"ahl_out": "a b"}}, r"signals\['ahl_out'\] = 'a b'.*name of a signal"),
    ({"without": ("lost",)}, "without names 'lost', which is no reaction.*'lose'"),
    ({"time_unit": "year"}, "time_unit = 'year'.*one of 's', 'min', 'h'"),
    ({"properties": {"cytosol": "size"}}, r"properties\['cytosol'\] = 'size'.*one of volume"),
    ({"properties": {"there": "volume"}}, r"properties\['there'\].*compartment or parameter"),
    ({"properties": ("cytosol",)}, "properties = .*a dict"),
    ({"kk": 3.0}, "the model has no constant 'kk'"),
    ({"luxi": 3.0}, "'luxi' is a variable: give its first value, initial="),
    ({"initial": {"lux": 1.0}}, "initial names 'lux', which is no variable.*'luxi'"),
    ({"species": ("luxi",)}, "species = .*left to the model"),
    ({"methodd": "euler"}, "no constant 'methodd'"),
    ({"method": "tau_leap"}, "'leave' changes 'ahl' and 'ahl_out', which are in compartments"),
]


@pytest.mark.parametrize("given, words", OPTIONS, ids=[str(list(o)) for o, _ in OPTIONS])
def test_options_that_do_not_fit_are_refused(given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.Circuit.from_antimony(QUORUM, **given)


def test_reactions_in_the_medium_are_refused():
    text = QUORUM.replace("make:", "decay: ahl_out -> ; outside*loss*ahl_out; make:")
    with pytest.raises(tf.InputError, match=r"'decay' happens outside.*without=\('decay',\)"):
        tf.Circuit.from_antimony(text, signals={"ahl_out": "ahl"})
    tf.Circuit.from_antimony(text, signals={"ahl_out": "ahl"}, without=("decay",))


def test_a_signal_with_a_rule_is_refused():
    with pytest.raises(tf.InputError, match="the signal 'S' has a rule"):
        tf.Circuit.from_antimony("species S, A; A' = S; S' = 1; S = 1; A = 1", signals="S")


def test_several_compartments_need_one_that_is_the_cell():
    text = QUORUM.replace("luxi in cytosol,", "luxi in nucleus,").replace(
        "compartment ", "compartment nucleus = 1, "
    )
    with pytest.raises(tf.InputError, match=r"nucleus, cytosol: say which is the cell"):
        tf.Circuit.from_antimony(text, signals={"ahl_out": "ahl"})


ANTIMONY = {
    "species A\nA' = -k*A\nk = = 2": "the Antimony text, line 3: syntax error",
    "": "the Antimony text is empty",
    " \n": "the Antimony text is empty",
    "toggle.ant": r"looks like the name of a file: .*from_antimony\(Path\('toggle\.ant'\)\)",
    "my models/toggle.xml": r"the name of a file: .*from_sbml\(Path\('my models/toggle\.xml'\)\)",
    "<?xml version='1.0'?>\n<sbml>" + "x" * 500: r"looks like SBML .*from_sbml\(path\)",
    'model m\nimport "other.ant"\nend': "line 2: import reads another file",
    "species A\0; A' = 1": "zero byte",
    "species A; A = 1": None,
    "species A; A = 1; at (A > 2): A = 1; A' = 1": r"an event without a name, at \(A > 2\), is",
    "species A; A = 1; cut: at (A > 2): A = 1; A' = 1": "the event 'cut' is not supported",
    "species A; A' = 1; A = 2*k; k = 3*j": "in the first value of 'k': the parameter 'j' has no",
}


@pytest.mark.parametrize("text", ANTIMONY)
def test_antimony_that_cannot_be_read_is_refused_with_its_line(text):
    if ANTIMONY[text] is None:
        assert tf.Circuit.from_antimony(text).species == ("A",)
        return
    with pytest.raises(tf.InputError, match=ANTIMONY[text]) as error:
        tf.Circuit.from_antimony(text)
    assert len(str(error.value)) < 250  # a text that is given is not echoed


PLAIN = "species A; A' = -k*A; A = 1; k = 1"


def test_a_file_in_antimony_is_read_by_its_path(tmp_path):
    path = tmp_path / "decay.ant"
    path.write_text(PLAIN)
    assert tf.Circuit.from_antimony(path).parameters == {"k": 1.0}
    path.write_text(PLAIN + "\nk = = 2")
    with pytest.raises(tf.InputError, match=r"decay\.ant, line 2: syntax error"):
        tf.Circuit.from_antimony(path)
    path.write_text(TOGGLE)
    with pytest.raises(tf.InputError, match=r"decay\.ant looks like SBML .*from_sbml"):
        tf.Circuit.from_antimony(path)


def test_what_is_no_sbml_file_says_what_reads_it(tmp_path):
    path = tmp_path / "decay.ant"
    path.write_text(PLAIN)
    for given, words in (
        (path, r"decay\.ant is no SBML: it looks like Antimony, .*from_antimony\(Path\('"),
        (str(path), r"decay\.ant is no SBML: it looks like Antimony"),
        (TOGGLE, r"path of a file, and not its text, .*: save the text in a file\.$"),
        (PLAIN + "\n" + "#" * 900, r"path of a file, and not its text.*from_antimony\(text\)"),
        (3, "path = 3 is not allowed: it must be the path of an SBML file"),
    ):
        with pytest.raises(tf.InputError, match=words) as error:
            tf.Circuit.from_sbml(given)
        assert len(str(error.value)) < 200 + 2 * len(str(path))
    with pytest.raises(tf.InputError, match=r"text = None .* or the Path of its file"):
        tf.Circuit.from_antimony(None)


@pytest.mark.parametrize(
    "module, package", [("libsbml", "python-libsbml"), ("antimony", "antimony")]
)
def test_a_missing_extra_is_named(module, package, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(tf.InputError, match=rf'{package}: pip install -e "\.\[sbml\]"'):
        tf.Circuit.from_antimony(QUORUM)


@pytest.mark.parametrize("end", ["net.xml", "the file is toggle.ant"])
def test_a_line_of_antimony_may_end_like_a_file(end):
    circuit = tf.Circuit.from_antimony(f"x_' = 1; x_ = 0; # {end}", time_unit="h")
    assert circuit.species == ("x_",)


def test_the_advice_for_a_renamed_variable_can_be_followed():
    text = "species x; -> x; 1; x = 0;"
    with pytest.raises(tf.InputError, match=r"give its first value, initial=\{'x_': …\}"):
        tf.Circuit.from_antimony(text, time_unit="h", x=2.0)
    circuit = tf.Circuit.from_antimony(text, time_unit="h", initial={"x_": 2.0})
    assert circuit.initial["x_"] == 2.0


@pytest.mark.parametrize(
    ("text", "given", "words"),
    [
        ("species Ä; Ä = 1; Ä -> ; Ä", {}, "letters a to z"),
        ("species a; a = 1; a -> ; a", {"dilution": 0.3}, r"dilution = 0.3 .* option of to_sbml"),
        ("compartment c = 0; species a in c; a = 1; a -> ; a", {}, "'c' has a size of 0"),
        (
            "compartment c = 2; substanceOnly species a in c; a = 1; a -> ; a",
            {"properties": {"c": "volume"}},
            "'a' is an amount .* make it a concentration",
        ),
        ("species a; a = 1; a -> ; a; late: at (time > 1): a = 2;", {}, "piecewise rate"),
    ],
)
def test_what_no_circuit_can_be_says_what_to_do(text, given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.Circuit.from_antimony(text, **given)


@pytest.mark.parametrize("number", ["NaN", "-1", "INF"])
def test_stoichiometries_are_numbers(number):
    reaction = (
        '<listOfReactions><reaction id="J" reversible="false"><listOfReactants>'
        f'<speciesReference species="A" stoichiometry="{number}" constant="true"/>'
        "</listOfReactants><kineticLaw><math><ci>A</ci></math></kineticLaw></reaction>"
        "</listOfReactions>"
    )
    with pytest.raises(tf.InputError, match="the stoichiometry of 'A' is"):
        read(sbml(HEAD + reaction))


def test_a_file_that_is_packed_is_to_be_unpacked(tmp_path):
    path = tmp_path / "model.xml.gz"
    path.write_bytes(gzip.compress(b"<sbml/>"))
    with pytest.raises(tf.InputError, match="unpack it"):
        tf.Circuit.from_sbml(path)


def test_constants_that_are_computed_from_numbers_are_constants():
    text = "species a; a = 1; a -> ; k*a; k = ln(2)/10;"
    circuit = tf.Circuit.from_antimony(text)
    assert circuit.parameters == {"k": pytest.approx(math.log(2) / 10)}
    assert tf.Circuit.from_antimony(text, k=[0.1, 0.2]).parameters["k"].tolist() == [0.1, 0.2]


def test_a_species_does_not_take_the_name_of_what_mechanics_read():
    assert tf.Circuit.from_antimony("species drag; drag = 1; -> drag; 5").species == ("drag_",)
    with pytest.raises(tf.InputError, match="'drag' as how much a cell resists motion"):
        tf.Circuit(lambda u, s, p, cell: {"drag": 1.0 - u.drag}, species="drag")


def test_a_long_sum_is_read():
    terms = " + ".join(f"{k}*a" for k in range(1, 1001))
    circuit = tf.Circuit.from_antimony(f"species a; a = 1; a -> ; {terms}")
    assert float(circuit.graph.evaluate({"a": 2.0})["a"]) == pytest.approx(-2.0 * 500500)


def test_concentrations_that_are_too_small_for_atol_are_warned_of():
    text = "species a, b; a = 1e-9; b = 0; a -> b; k*a; b -> ; 3*b; k = 20"
    with pytest.warns(UserWarning, match=r"its species are of about 2e-08, .*Give atol=2e-14"):
        tf.Scene(tf.Circuit.from_antimony(text), dim=2).bind()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tf.Scene(tf.Circuit.from_antimony(text, atol=2e-14), dim=2).bind()


def test_a_model_too_large_for_kernels_runs_by_torch():
    """Every species meets every other: elimination fills the matrix."""
    names = [f"s{k}" for k in range(34)]
    text = f"species {', '.join(names)};" + "".join(
        f" {n} = 1; {n} -> ; {n}*({' + '.join(names)});" for n in names
    )
    scene = tf.Scene(tf.Circuit.from_antimony(text), dim=2, dt=0.01)
    *_, state = tf.simulate(scene, until=0.01)
    assert float(state.s0[0]) == pytest.approx(1 / (1 + 34 * 0.01), rel=1e-2)
    assert "entries after elimination, more than the 999" in str(tf.explain(scene))
