"""Wirings of gates: from truth table to circuit, each repressor once, levels that fit, and the list
of parts."""

from __future__ import annotations

import itertools
import math
import pickle
import random
import warnings

import pytest
import torch
from gate_library import GATES, inputs_and_outputs, version_1, version_2, write

import torchfilm as tf
from design import Image, Library, Search, Sensor, SensorDevice, Space, UnfitDesign
from design.library.logic import netlist

LEFT = SensorDevice("pLeft", ymax=2.6, ymin=0.01)
LOW = SensorDevice("pLow", ymax=1.9, ymin=0.015)
INPUTS = {
    "left": Sensor("out.left", LEFT, half=0.5, power=4.0),
    "low": Sensor("out.low", LOW, half=0.5, power=4.0),
}
GOOD = {"g1": "E1_EpsR", "g2": "D1_DelR", "g3": "K1_KapR"}


@pytest.fixture
def library(tmp_path):
    return Library.read(write(tmp_path / "library.json", version_1()))


def xor(library, **options):
    return library.wiring("0110", inputs=INPUTS, output="yfp", **options)


def states(wired):
    return "".join("01"[on] for on in wired.states[wired.output])


@pytest.mark.parametrize("count", [1, 2])
def test_every_table_of_two_inputs_has_a_wiring(count):
    names, tried = "ab"[:count], 0
    for table in map("".join, itertools.product("01", repeat=2**count)):
        try:
            wired = netlist(table, names, "out")
        except tf.InputError:
            continue
        tried += 1
        assert states(wired) == table
        assert len(wired.genes) <= 4
    assert tried == {1: 1, 2: 9}[count]  # all but constants, OR, and those of fewer inputs


def test_tables_of_three_inputs_and_states_that_never_occur():
    draw = random.Random(0)
    for table in (
        "00010111",
        "01010011",
        "0111-0-1",
        *("".join(draw.choices("00111-", k=8)) for _ in range(9)),
    ):
        try:
            wired = netlist(table, "abc", "out")
        except tf.InputError as error:
            odd = ("more than", "needs a gate", "depends on every input")
            assert any(words in str(error) for words in odd)
            continue
        assert states(wired) == table.replace("-", "")
    assert netlist("0110", "ab", "out").describe() == (
        "g1 = NOR(a, b); g2 = NOR(a, g1); g3 = NOR(b, g1); out = g2 or g3"
    )


def test_a_listed_wiring_is_put_in_order():
    wired = netlist({"y": ["q"], "q": ["p", "b"], "p": ["a"]}, ["a", "b"], "y")
    assert list(wired.genes) == ["p", "q"] and wired.drivers == ("q",)
    assert states(wired) == "0010"


@pytest.mark.parametrize(
    "logic, words",
    [
        ("011", "4 of 0, 1 and -"),
        ("01x0", "4 of 0, 1 and -"),
        ("0000", "a table with 0 and 1"),
        ("0111", "a table that needs a gate"),
        ("1100", "depends on every input"),
        (3, "a truth table"),
        ({"g": ["a", "b"]}, "with the output 'y'"),
        ({"g": "a", "y": ["g"]}, "a list of one or two"),
        ({"g": ["a", "a"], "y": ["g"]}, "a list of one or two"),
        ({"g": ["a", "bb"], "y": ["g"]}, "Did you mean 'b'"),
        ({"g": ["a"], "y": ["g"]}, "Nothing reads it"),
        ({"a": ["b"], "y": ["a"]}, "a name that no input has"),
        ({"g": ["a", "h"], "h": ["g", "b"], "y": ["h"]}, "without loops"),
    ],
)
def test_a_wiring_that_makes_no_sense_is_refused(logic, words):
    with pytest.raises(tf.InputError) as caught:
        netlist(logic, ["a", "b"], "y")
    assert words in str(caught.value)


def test_each_repressor_is_used_once_and_levels_fit(library):
    wiring, fit = xor(library), 0
    for names in itertools.product(GATES, repeat=3):
        wished = dict(zip(wiring.places, names, strict=True))
        found = wiring.resolve(wished)
        assert len({GATES[name][0] for name in found.values()}) == 3
        assert wiring.resolve(found) == found  # what stands in stays
        levels = wiring.assigner.levels(wiring.gates(found))
        fit += wiring.assigner.output_contrast(levels) >= 5.0
    assert fit > 0.9 * len(GATES) ** 3
    assert wiring.resolve(GOOD) == GOOD


def test_levels_are_those_of_the_response_functions(library):
    wiring = xor(library)
    gates = {place: library.gates[name] for place, name in GOOD.items()}
    for row, line in zip(
        itertools.product((0, 1), repeat=2), wiring.levels(GOOD).splitlines()[1:], strict=False
    ):
        a, b = (d.ymax if on else d.ymin for d, on in zip((LEFT, LOW), row, strict=True))
        one = gates["g1"].response(a + b)
        two, three = gates["g2"].response(a + one), gates["g3"].response(b + one)
        shown = [float(word) for word in line.split()]
        for found, wanted in zip(shown, (a, b, one, two, three, two + three), strict=True):
            assert math.isclose(found, wanted, rel_tol=5e-3)


def scene_of(circuit, left=0.0, low=0.0, growth=1.0):
    """Cells that grow in constant signals."""
    return tf.Scene(
        tf.Growth(rate=growth),
        tf.Division(length=4.0),
        circuit,
        tf.Medium(
            left=tf.Signal(diffusion=1.0, initial=left),
            low=tf.Signal(diffusion=1.0, initial=low),
            box=((-20, -20), (20, 20)),
            spacing=10.0,
        ),
        founders=tf.Cells.single(2),
        dt=0.1,
    )


@pytest.mark.parametrize("row", list(itertools.product((False, True), repeat=2)))
@pytest.mark.parametrize("growth, loss", [(1.0, 3.0), (0.5, 8.0)])
def test_cells_that_grow_at_the_rate_settle_at_the_levels_of_the_library(
    library, row, growth, loss
):
    wiring = xor(library, growth=growth, loss=loss)
    signals = [1e3 if on else 0.0 for on in row]
    scene = scene_of(wiring.circuit(GOOD), *signals, growth=growth)
    *_, state = tf.simulate(scene, until=4.0, dtype=torch.float64)
    wanted = wiring.assigner.levels(wiring.gates(GOOD), [row])
    # of the rates' share in a step, a half is diluted in that step
    for place in wiring.places:
        assert torch.allclose(
            state.fields[place], torch.tensor(wanted.inputs[place][0]).double(), rtol=0.03
        )
    assert torch.allclose(state.yfp, torch.tensor(wanted.outputs["yfp"][0]).double(), rtol=0.03)


def test_a_circuit_starts_at_the_levels_without_input(library):
    wiring = xor(library)
    state = scene_of(wiring.circuit(GOOD)).bind(dtype=torch.float64).start()
    off = wiring.assigner.levels(wiring.gates(GOOD), [(False, False)])
    assert math.isclose(float(state.g2[0]), off.inputs["g2"][0])
    assert math.isclose(float(state.yfp[0]), off.outputs["yfp"][0])


def test_one_design_for_each_colony_runs_as_each_alone(library):
    wiring = xor(library, loss=2.0)
    other = {"g1": "D1_DelR", "g2": "K2_KapR", "g3": "A1_AlfR"}
    both = {place: [GOOD[place], other[place], GOOD[place]] for place in GOOD}
    run = lambda gates, n: list(
        tf.simulate(
            scene_of(wiring.circuit(gates), 0.6, 0.4), until=0.5, colonies=n, dtype=torch.float64
        )
    )[-1]
    together = run(both, 3).yfp
    assert together[0] == together[2] != together[1]
    for found, design in zip(together, (GOOD, other), strict=False):
        listed = {place: [name] for place, name in design.items()}
        assert run(listed, 1).yfp.tolist() == [found.item()]
        assert math.isclose(run(design, 1).yfp.item(), found.item(), rel_tol=1e-8)


def test_the_equations_can_be_seen(library):
    wiring = library.wiring("10", inputs={"a": INPUTS["left"]}, output="yfp", loss=2.0)
    circuit = wiring.circuit({"g1": "E1_EpsR"})
    lines = str(circuit.graph).splitlines()
    assert lines[0].startswith("d g1/dt  = (growth + loss)·(")
    assert "ymin_g1 + (ymax_g1 − ymin_g1)·K_g1^n_g1/(K_g1^n_g1 + g1^n_g1)" in lines[1]
    assert circuit.graph.unused == () and circuit.graph.signals == ("left",)


def test_an_input_can_be_a_species_of_another_circuit(library):
    sensor = Sensor("sense_ahl", LEFT, half=0.5)
    wiring = library.wiring("10", inputs={"a": sensor}, output="yfp", loss=5.0)
    rates = lambda u, s, p, cell: {"ahl": p.made - p.made * u.ahl}
    scene = tf.Scene(
        tf.Mechanics(dim=2),
        tf.Circuit(rates, species="ahl", name="sense", made=50.0),
        wiring.circuit({"g1": "E1_EpsR"}),
    )
    *_, state = tf.simulate(scene, until=0.5)
    assert float(state.sense_ahl) > 0.9 and float(state.g1) > 1.0


def test_parts_are_listed_in_order_with_the_promoters_of_the_wiring(library, tmp_path):
    assert str(xor(library).parts(GOOD)).splitlines()[:14] == [
        "g1 = E1_EpsR: NOR(left, low)",
        "  promoter    pLeft",
        "  promoter    pLow",
        "  ribozyme    RiboEps",
        "  rbs         E1",
        "  cds         EpsR",
        "  terminator  T_EpsR",
        "g2 = D1_DelR: NOR(left, g1)",
        "  promoter    pLeft",
        "  promoter    pEpsR",
        "  ribozyme    RiboDel",
        "  rbs         D1",
        "  cds         DelR",
        "  terminator  T_DelR",
    ]
    files = (
        write(tmp_path / "ucf.json", version_2(split=True)),
        write(tmp_path / "io.json", inputs_and_outputs()),
    )
    sensor = Sensor("out.left", "LacI_sensor", half=1.0)
    logic = {"g1": ["a"], "g2": ["g1", "a"], "yfp": ["g1", "g2"]}
    wiring = Library.read(*files).wiring(logic, inputs={"a": sensor}, output="yfp", contrast=1.0)
    lines = str(wiring.parts({"g1": "E1_EpsR", "g2": "D1_DelR"})).splitlines()
    assert lines[0] == "g1 = E1_EpsR: NOT(a)"
    # a NOT gate needs one of the two units; a NOR gate has one for each promoter
    assert sum(line.endswith(" EpsR") for line in lines) == 1
    assert sum(line.endswith(" DelR") for line in lines) == 2
    assert lines[-4:] == [
        "yfp = YFP_reporter: g1 or g2",
        "  promoter    pEpsR",
        "  promoter    pDelR",
        "  cassette    YFP_cassette",
    ]


def test_levels_that_cannot_be_told_apart_make_a_design_unfit(library):
    wiring = xor(library, contrast=1e4)
    with pytest.raises(UnfitDesign, match="the levels of yfp cannot be told apart: on is"):
        wiring.circuit(GOOD)


def test_gates_that_others_stand_in_for_are_warned_of(library):
    """A design that a person writes down is not that which is simulated and printed."""
    wiring, good = xor(library), xor(library).resolve(GOOD)
    first = next(iter(good.values()))
    twice = dict.fromkeys(wiring.places, first)
    for use in (wiring.circuit, wiring.parts, wiring.levels):
        with pytest.warns(UserWarning, match=f"the gates {first}, {first}.* stand in"):
            use(twice)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            use(good)
    assert len(repr(wiring)) < 300 and "g1 = NOR" in repr(wiring)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda x: x.wiring("10", inputs={}, output="y"), "sensors by name"),
        (lambda x: x.wiring("10", inputs={"a": "out.a"}, output="y"), "inputs['a'] = 'out.a'"),
        (
            lambda x: x.wiring("10", inputs={"a": Sensor("out.a", "LacI", half=1)}, output="y"),
            "an input sensor of the library: it has none. Read the library's file of inputs",
        ),
        (lambda x: x.wiring("10", inputs={"a": INPUTS["low"]}, output="y f p"), "output = 'y f p'"),
        (lambda x: xor(x, reporter="YFP_reporter"), "reporter = 'YFP_reporter'"),
        (lambda x: xor(x, contrast=0.5), "contrast = 0.5"),
        (lambda x: xor(x, growth=0.0), "growth = 0.0"),
        (lambda x: xor(x, loss=-1.0), "loss = -1.0"),
        (lambda x: Sensor("out. a", LEFT, half=1.0), "Sensor.reads"),
        (lambda x: Sensor("out.a", LEFT, half=0.0), "Sensor.half"),
        (lambda x: Sensor("out.a", LEFT, half=1.0, power=0.5), "Sensor.power"),
        (lambda x: Sensor("out.a", 3, half=1.0), "Sensor.device"),
        (lambda x: SensorDevice("p", ymax=0.1, ymin=0.2), "SensorDevice('p'), ymax = 0.1"),
        (lambda x: xor(x).circuit({"g1": "E1_EpsR"}), "'g2' is missing"),
        (lambda x: xor(x).circuit({**GOOD, "g4": "E1_EpsR"}), "gates = 'g4'"),
        (lambda x: xor(x).circuit({**GOOD, "g1": "E1_Eps"}), "Did you mean 'E1_EpsR'"),
        (lambda x: xor(x).circuit({**GOOD, "g1": ["E1_EpsR"], "g2": []}), "one name for each"),
    ],
)
def test_bad_input_is_refused(library, make, words):
    with pytest.raises(tf.InputError) as caught:
        make(library)
    assert words in str(caught.value)


def test_a_wiring_needs_as_many_repressors_as_gates(tmp_path):
    path = write(tmp_path / "a.json", version_1())
    few = Library.read(path, gates=["B1_BetR", "B2_BetR", "D1_DelR"])
    with pytest.raises(tf.InputError, match="needs 3 repressors, and the library has 2: BetR, Del"):
        xor(few)


def test_another_contrast_of_a_wiring_makes_another_task(library):
    """The same choices then stand for other gates, where levels do not fit."""
    words = lambda **options: Space(xor(library, **options).parameters).digest
    assert words() == words() == Space(pickle.loads(pickle.dumps(xor(library))).parameters).digest
    assert words(contrast=2.5) != words(contrast=12.0)


def test_a_search_chooses_gates_in_one_batch_and_reports_those_that_are_used(library):
    wiring = xor(library, loss=3.0)
    assert pickle.loads(pickle.dumps(wiring)).resolve(GOOD) == GOOD

    def colony(**gates):
        return scene_of(wiring.circuit(gates, rtol=1e-2), 0.7, 0.2)

    target = Image("yfp", [[1.0]], (100.0, 100.0), floor=0.5)
    search = Search(colony, wiring.parameters, target, cells=12, replicates=2, method="cmaes")
    best = search.run(48, progress=False)
    assert best.loss < search.first().loss
    assert wiring.resolve(best.values) == best.values
    table = best.table()
    assert all(name in table for name in best.values.values())
    assert str(wiring.parts(best.values)).startswith(f"g1 = {best.values['g1']}: NOR")
