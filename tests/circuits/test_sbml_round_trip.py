"""What is written as SBML is read again as the same circuit, and is valid SBML."""

from __future__ import annotations

import libsbml
import pytest
import torch
from modelled import QUORUM, REPRESSILATOR, TOGGLE, read

import torchfilm as tf


def many(u, s, p, cell):
    """Operations with and without a counterpart in MathML, all that a cell has, and a signal."""
    into = p.D * (s.a - u.a) * cell.area
    steep = tf.kinetics.activation(u.b, p.half, 2.5) + tf.kinetics.repression(u.a, p.half)
    odd = torch.sigmoid(u.a) + torch.nn.functional.softplus(u.b) + torch.log1p(u.a) + 2 / (u.b + 1)
    chosen = torch.where((u.a > 0.3) & ~(u.b > p.half), 1.0, -0.5)
    rest = torch.minimum(u.a, p.half).clamp(min=1e-3) ** 0.7 + u.b % 2 - torch.expm1(-u.a)
    return {
        "a": steep - u.a * 1.2345678901234567e-17 + into / cell.volume,
        "b": odd * chosen - u.b / 3 + torch.zeros_like(u.b),
        "c": rest + cell.time * cell.growth_rate - tf.kinetics.michaelis_menten(u.c, p.half),
    }, {"a": -into}


def decay(u, s, p, cell):
    return {"k": -p.k * u.k}


CIRCUITS = {
    "functions": lambda: tf.Circuit(
        many, species=("a", "b", "c", "still"), initial={"a": 1 / 3, "c": 1e-20}, D=0.1,
        half=2 / 3, length=1.0, dilution=("a", "c"),
    ),
    "one name for two": lambda: tf.Circuit(decay, species="k", initial={"k": 2.0}, k=0.5),
    "reactions": lambda: tf.Circuit(
        [tf.parts.repressed("r", by="g", rate="strength", half=1.0, power=2),
         tf.parts.degradation("r", "loss"), tf.parts.exchange("g", 0.3, "g"),
         tf.Reaction.of("2 r + g -> g", 0.1)],
        species=("r", "g"), initial={"g": 0.1}, strength=4.0, loss=1.0,
    ),
    "repressilator": lambda: read(REPRESSILATOR),
    "toggle": lambda: read(TOGGLE),
    "quorum": lambda: tf.Circuit.from_antimony(QUORUM, signals={"ahl_out": "ahl"}),
    "names": lambda: tf.Circuit.from_antimony("species x; x' = -path*x; x = 1; path = 2"),
}  # fmt: skip

CELL = {"functions": {"growth_rate": 0.7}}  # what a circuit reads of a cell beside its shape


@pytest.mark.parametrize("name", CIRCUITS)
def test_a_circuit_comes_back_as_it_was(name, tmp_path):
    path, circuit = tmp_path / "written.xml", CIRCUITS[name]()
    circuit.to_sbml(path, cell=CELL.get(name))
    again = tf.Circuit.from_sbml(path)
    assert str(again.graph) == str(circuit.graph)
    assert again.species == circuit.species and again.diluted_fields == circuit.diluted_fields
    assert again.parameters == circuit.parameters
    assert again.initial == {n: circuit.initial.get(n, 0.0) for n in circuit.species}
    values = {n: torch.rand(64, dtype=torch.float64) for n in _leaves(circuit)}
    first, second = circuit.graph.evaluate(values), again.graph.evaluate(values)
    for rate in first:
        assert torch.equal(first[rate], second[rate]), rate


@pytest.mark.parametrize("name", CIRCUITS)
def test_what_was_read_is_written_as_the_same_file(name, tmp_path):
    """The first file may have 0.1·r where torch, reading it, notes r·0.1."""
    CIRCUITS[name]().to_sbml(tmp_path / "0.xml", cell=CELL.get(name))
    for k in (1, 2):
        read = tf.Circuit.from_sbml(tmp_path / f"{k - 1}.xml")
        read.to_sbml(tmp_path / f"{k}.xml", cell=CELL.get(name))
    assert (tmp_path / "1.xml").read_text() == (tmp_path / "2.xml").read_text()


@pytest.mark.parametrize("name", CIRCUITS)
def test_what_is_written_is_valid(name, tmp_path):
    CIRCUITS[name]().to_sbml(tmp_path / "written.xml", cell=CELL.get(name))
    document = libsbml.readSBML(str(tmp_path / "written.xml"))
    document.setConsistencyChecks(libsbml.LIBSBML_CAT_UNITS_CONSISTENCY, False)
    document.checkConsistency()
    found = [document.getError(k) for k in range(document.getNumErrors())]
    assert [e.getMessage() for e in found if e.getSeverity() >= libsbml.LIBSBML_SEV_ERROR] == []


def _leaves(circuit):
    graph = circuit.graph
    read_by = [n for names in graph.reads.values() for n in names]
    both = [f"p.{n}" for n in graph.species if n in graph.parameters]
    return dict.fromkeys([*read_by, *graph.species, *both])


def test_numbers_take_the_place_of_values_per_colony(tmp_path):
    circuit = tf.Circuit(decay, species="k", initial={"k": tf.Uniform(0.0, 1.0)},
                         k=torch.tensor([1.0, 2.0]))  # fmt: skip
    both = r"initial 'k' = Uniform\(.*\), constant 'k' = .*one number.*initial=\{'k': …\}, k=…\."
    with pytest.raises(tf.InputError, match=both):
        circuit.to_sbml(tmp_path / "a.xml")
    with pytest.raises(tf.InputError, match=r"^constant 'k' .*one number for each\. Give k=…\.$"):
        circuit.to_sbml(tmp_path / "a.xml", initial={"k": 1.0})
    with pytest.raises(tf.InputError, match=r"constant 'kk' is not in the circuit.*'k'"):
        circuit.to_sbml(tmp_path / "a.xml", initial={"k": 1.0}, kk=2.0)
    circuit.to_sbml(tmp_path / "a.xml", initial={"k": 1.0}, k=2.0)
    again = tf.Circuit.from_sbml(tmp_path / "a.xml")
    assert again.parameters == {"k": 2.0} and again.initial == {"k": 1.0}


def test_constants_of_one_cell_type_are_written(tmp_path):
    """The rates are those of all cells."""
    made = tf.Circuit(lambda u, s, p, cell: {"a": p.k - u.a}, species=("a",), k={0: 1.0, 1: 2.5})
    made.to_sbml(tmp_path / "a.xml", cell_type=1)
    assert tf.Circuit.from_sbml(tmp_path / "a.xml").parameters["k"] == 2.5
    with pytest.raises(tf.InputError, match=r"cell_type = 3 is not allowed: .* one of 0, 1"):
        made.to_sbml(tmp_path / "b.xml", cell_type=3)
    same = tf.Circuit(lambda u, s, p, cell: {"a": p.k - u.a}, species=("a",), k=1.0)
    with pytest.raises(tf.InputError, match="must be left out: nothing in the circuit"):
        same.to_sbml(tmp_path / "c.xml", cell_type=0)


def test_rates_of_one_cell_type_are_written(tmp_path):
    circuit = tf.Circuit(
        {0: decay, 3: lambda u, s, p, cell: {"k": p.k}}, species="k", k={0: 1.0, 3: 2.0}
    )
    with pytest.raises(tf.InputError, match=r"by cell type: .* cell_type=0 or 3\."):
        circuit.to_sbml(tmp_path / "a.xml")
    circuit.to_sbml(tmp_path / "a.xml", cell_type=3)
    again = tf.Circuit.from_sbml(tmp_path / "a.xml")
    assert again.graph.equations == "d k/dt = k" and again.parameters == {"k": 2.0}


def test_what_is_read_of_a_cell_is_a_number_of_the_file(tmp_path):
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"gfp": cell.plasmid * cell.length - u.gfp}, species="gfp"
    )
    path = tmp_path / "a.xml"
    with pytest.raises(tf.InputError, match=r"read cell\.plasmid, .*: give cell=\{'plasmid': …\}"):
        circuit.to_sbml(path)
    with pytest.raises(tf.InputError, match=r"cell\.plasmids is not read .* mean 'plasmid'"):
        circuit.to_sbml(path, cell={"plasmids": 3.0})
    assert not path.exists()
    circuit.to_sbml(path, cell={"plasmid": 3.0})
    model = libsbml.readSBML(str(path)).getModel()
    numbers = {x.getId(): x.getValue() for x in model.getListOfParameters()}
    assert numbers == {"cell_plasmid": 3.0, "cell_length": 2.0}


def test_letters_that_sbml_lacks_are_refused(tmp_path):
    circuit = tf.Circuit(lambda u, s, p, cell: {"β": 0 * u["β"]}, species="β")
    with pytest.raises(tf.InputError, match="'β' cannot be written"):
        circuit.to_sbml(tmp_path / "a.xml")


def test_a_part_of_a_model_is_refused(tmp_path):
    circuit = tf.Circuit(decay, species="b", shared=("k",), k=1.0)
    with pytest.raises(tf.InputError, match="shares species"):
        circuit.to_sbml(tmp_path / "a.xml")


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(tf.InputError, match=r"a\.xml.*in a folder that exists. Make .*none first"):
        read(TOGGLE).to_sbml(tmp_path / "none" / "a.xml")


def test_a_changed_function_is_not_torchfilms(tmp_path):
    """The name of a function does not decide what it computes."""
    CIRCUITS["functions"]().to_sbml(tmp_path / "a.xml", cell=CELL["functions"])
    text = (tmp_path / "a.xml").read_text()
    start = text.index('id="torchfilm_sigmoid"')
    changed = text[:start] + text[start:].replace("<cn>1.0</cn>", "<cn>2</cn>", 1)
    (tmp_path / "a.xml").write_text(changed)
    assert "sigmoid" not in str(tf.Circuit.from_sbml(tmp_path / "a.xml").graph)


def test_dilution_is_written_on_request(tmp_path):
    """As −dilution · x in the rates of what growth dilutes, so that the model read again has it."""
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"a": p.k - u.a}, species=("a", "b", "c"), initial={"a": 2.0},
        k=3.0, dilution=("a", "b"),
    )  # fmt: skip
    circuit.to_sbml(tmp_path / "written.xml", dilution=0.5)
    again = tf.Circuit.from_sbml(tmp_path / "written.xml")
    found = again.graph.evaluate({"a": torch.tensor([2.0]), "b": torch.tensor([4.0]), "k": 3.0})
    assert {n: float(x) for n, x in found.items()} == {"a": 0.0, "b": -2.0}
    assert again.diluted_fields == set() or not again.diluted_fields
    with pytest.raises(tf.InputError, match=r"dilution = -1.*at least 0"):
        circuit.to_sbml(tmp_path / "written.xml", dilution=-1)


@pytest.mark.parametrize(
    ("given", "said"),
    [({"initial": {"k": -1}}, r"initial 'k' = -1.*at least 0"), ({"k": float("nan")}, "'k' = nan")],
)
def test_numbers_that_could_not_be_read_again_are_not_written(tmp_path, given, said):
    with pytest.raises(tf.InputError, match=said):
        CIRCUITS["one name for two"]().to_sbml(tmp_path / "written.xml", **given)
    assert not (tmp_path / "written.xml").exists()


def test_models_in_antimony_that_are_left_out_are_named():
    models = "model first\n A=1; A->; A\nend\nmodel second\n B=2; B->; B\nend\n"
    with pytest.warns(UserWarning, match=r"several models: second is read, and not first\."):
        assert tf.Circuit.from_antimony(models).species == ("B",)
    part = models + "model third\n part: first(); other: second(); C=1; C->; C\nend\n"
    assert len(tf.Circuit.from_antimony(part).species) == 3
