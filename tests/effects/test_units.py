"""Units of concentrations: names in pictures and tables, molecules, and exchange."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

import torchfilm as tf
from torchfilm.pictures.colours import PlotStyle, scale_of
from torchfilm.pictures.scales import ValueRange
from torchfilm.tools.units import MOLECULES, NAMED, differ

BOX = {"box": ((-8, -8), (8, 8)), "spacing": 4.0}


def make(u, s, p, cell):
    """A gene product that also leaves the cell."""
    return {"ahl": 1.0 - u.ahl}, {"ahl": 0.1 * u.ahl}


def scene(inside=None, outside=None, *more, rates=make, **options):
    own = {} if inside is None else {"concentration_unit": inside}
    there = {} if outside is None else {"concentration_unit": outside}
    return tf.Scene(
        tf.Growth(rate=1.0), tf.Circuit(rates, species=("ahl",), **own, **options),
        tf.Medium(ahl=tf.Signal(diffusion=1e3, **there), **BOX), *more, dim=2, dt=0.1,
    )  # fmt: skip


def test_units_are_those_of_fields_pictures_and_files(tmp_path):
    named, plain = scene("nM", "nM"), scene()
    model = named.bind(seed=1)
    state, other = model.step(model.start(), 0.1), plain.bind(seed=1)
    assert {state.declared[n].unit for n in ("ahl", "out.ahl")} == {"nM"}
    assert state.declared["ahl"].is_species and not state.declared["out.ahl"].is_species
    assert "nM" in model.describe()
    frame = tf.pictures.frame_of(state)
    assert (frame.units["ahl"], frame.units["out.ahl"]) == ("nM", "nM")
    seen = ValueRange()
    style = PlotStyle(colour="ahl", background="ahl")
    names = [scale_of(n, seen, style, frame.units).title for n in ("ahl", "out.ahl")]
    assert names == ["ahl (nM)", "ahl outside (nM)"]
    path = tmp_path / "run.h5"
    tf.simulate(named, until=0.2, record=path).last()
    results = tf.Results(path)
    declared = json.loads(results.attributes["declared"])
    assert (declared["ahl"][1], declared["out.ahl"][1]) == ("nM", "nM")
    # a name alone: the same digest, the same bits
    assert tf.digest(named) == tf.digest(plain)
    again = other.step(other.start(), 0.1)
    assert all(torch.equal(x, again.fields[n]) for n, x in state.fields.items())


def test_a_run_goes_on_with_a_unit_that_was_not_named(tmp_path):
    path = tmp_path / "run.h5"
    tf.simulate(scene(), until=0.2, record=path).last()
    state = tf.Results(path).state(scene("nM", "nM"))
    assert state.declared["ahl"].unit == "nM"
    after = scene("nM", "nM").bind(state=state).step(state, 0.1)
    assert after.cells == state.cells
    with_unit = after.replace(
        declared={**after.declared, "ahl": scene("nM").bind().start().declared["ahl"]}
    )
    with pytest.raises(tf.InputError, match="ahl"):
        scene("mM", "mM").bind(state=with_unit)


@pytest.mark.parametrize(
    ("typed", "unit"),
    [("nM", "nM"), ("uM", "µM"), ("\N{GREEK SMALL LETTER MU}M", "µM"), (" mM ", "mM"),
     ("ug/mL", "µg/mL"), ("ug/ml", "µg/mL"), ("molecules/um3", "molecules/µm³"),
     ("molecules/µm^3", "molecules/µm³"), ("conc", "conc")],
)  # fmt: skip
def test_names_of_units(typed, unit):
    assert tf.Signal(1.0, concentration_unit=typed).concentration_unit == unit
    assert tf.Circuit(make, species=("ahl",), concentration_unit=typed).concentration_unit == unit


@pytest.mark.parametrize("wrong", ["nm", "h", "", 3, None])
def test_what_is_no_unit_of_concentration(wrong):
    with pytest.raises(
        tf.InputError, match=r"Signal\.concentration_unit .*one of molecules/µm³, M, mM, µM"
    ):
        tf.Signal(1.0, concentration_unit=wrong)
    with pytest.raises(tf.InputError, match=r"Circuit\.concentration_unit .*nM"):
        tf.Circuit(make, species=("ahl",), concentration_unit=wrong)


def test_molecules_of_a_unit():
    """1 nM is 0.6022 molecules in a µm³."""
    assert MOLECULES["nM"] == pytest.approx(0.602214076)
    assert MOLECULES["mM"] == pytest.approx(602214.076)
    birth = [tf.Reaction({}, {"ahl": 1}, rate=1.0)]
    counted = {"species": ("ahl",), "method": "direct"}
    by_unit = tf.Circuit(birth, concentration_unit="nM", **counted)
    assert by_unit.molecules_per_unit == pytest.approx(0.602214076)
    assert (
        tf.Circuit(
            birth, concentration_unit="nM", molecules_per_unit=0.6, **counted
        ).molecules_per_unit
        == 0.6
    )
    assert tf.Circuit(birth, **counted).molecules_per_unit == 1.0
    assert (
        tf.Circuit(make, species=("ahl",), concentration_unit="g/L").molecules_per_unit == 1.0
    )  # none counted
    with pytest.raises(
        tf.InputError, match=r"molecules_per_unit .*about 602\.2 where concentration_unit = 'µM'"
    ):
        tf.Circuit(birth, concentration_unit="µM", molecules_per_unit=[602.0, 0.6], **counted)
    with pytest.raises(tf.InputError, match=r"molecules_per_unit is missing: .* in 1 g/L"):
        tf.Circuit(birth, concentration_unit="g/L", **counted)


def test_counted_molecules_are_as_many_as_the_unit_says():
    """50 nM in a cell are whole molecules, of which 0.6022 in a µm³ are 1 nM."""
    cells = tf.Cells.single(2, length=3.0)
    birth = [tf.Reaction({}, {"ahl": 1}, rate=0.0)]
    circuit = tf.Circuit(
        birth, species=("ahl",), initial={"ahl": 50.0}, concentration_unit="nM", method="direct"
    )
    state = tf.Scene(circuit, founders=cells, dim=2).bind().start()
    count = float(state.ahl[0] * state.volume[0]) * MOLECULES["nM"]
    assert count == pytest.approx(round(count), abs=1e-3)
    assert count == pytest.approx(50.0 * float(state.volume[0]) * 0.6022, abs=1.0)


def test_what_goes_between_cells_and_medium_is_in_one_unit():
    with pytest.raises(
        tf.InputError, match=r"in nM, and exchanges the signal 'ahl', which is in µM"
    ):
        scene("nM", "µM").bind()
    for inside, outside in (("nM", None), (None, "µM"), ("nM", "nM")):
        scene(inside, outside).bind()
    sensed = lambda u, s, p, cell: {"ahl": s.ahl / (1.0 + s.ahl) - u.ahl}
    scene("nM", "µM", rates=sensed).bind()  # nothing is exchanged
    with pytest.raises(tf.InputError, match=r"releases gives 'ahl', in nM, to the signal 'ahl'"):
        scene("nM", "µM", tf.Lysis(rate=0.1, releases={"ahl": "ahl"}), rates=sensed).bind()
    scene("nM", "µM", tf.Lysis(rate=0.1, releases={"ahl": {"ahl": 1e-3}}), rates=sensed).bind()
    second = tf.Circuit(
        lambda u, s, p, cell: {"gfp": u.ahl - u.gfp}, species=("gfp",), shared=("ahl",),
        name="second", concentration_unit="µM",
    )  # fmt: skip
    with pytest.raises(tf.InputError, match=r"'second' is in µM, and shares the species 'ahl'"):
        scene("nM", None, second, rates=sensed).bind()


def test_units_that_differ():
    assert differ("nM", "µM") and differ("1/h", "conc") and differ("h", "nM")
    assert not any(differ(x, "conc") or differ("conc", x) or differ(x, x) for x in NAMED)


def test_a_constant_may_be_called_unit():
    with pytest.raises(tf.InputError, match="Did you mean concentration_unit"):
        tf.Signal(1.0, unit="nM")
    with pytest.raises(tf.InputError, match="Did you mean concentration_unit"):
        tf.Circuit(make, species=("ahl",), unit="nM")
    assert tf.Circuit(make, species=("ahl",), unit=2.0).parameters["unit"] == 2.0


def test_what_is_no_concentration_is_shared_whatever_the_unit():
    """Variables of rules, which have no unit, and fields of effects."""
    use = lambda u, s, p, cell: {"gfp": u.level - u.gfp, "level": -u.level}
    for shared in ("level", "growth_rate"):
        rates = use if shared == "level" else lambda u, s, p, cell: {"gfp": u.growth_rate - u.gfp}
        second = tf.Circuit(rates, species="gfp", shared=(shared,), name="second")
        rules = tf.Rules(lambda cells: None, variables={"level": 1.0})
        made = tf.Scene(tf.Growth(rate=0.5), rules, second, dim=2, dt=0.1)
        assert float(tf.simulate(made, until=0.2).last().second_gfp[0]) > 0.05


def test_molecules_follow_the_unit_of_a_circuit_that_is_changed():
    birth = [tf.Reaction({}, {"ahl": 1}, rate=1.0)]
    smooth = tf.Circuit(birth, species=("ahl",), concentration_unit="nM")
    assert tf.digest(smooth) == tf.digest(tf.Circuit(birth, species=("ahl",)))
    assert tf.digest(smooth) == tf.digest(
        tf.Circuit(birth, species=("ahl",), molecules_per_unit=1.0)
    )
    by_unit = {"method": "tau_leap", "molecules_per_unit": None}
    counted = dataclasses.replace(smooth, **by_unit)
    assert counted.molecules_per_unit == pytest.approx(0.602214076)
    other = tf.Circuit(birth, species=("ahl",), method="tau_leap",
                       molecules_per_unit=counted.molecules_per_unit)  # fmt: skip
    assert other.molecules_per_unit == counted.molecules_per_unit
    mille = dataclasses.replace(counted, concentration_unit="mM", molecules_per_unit=None)
    assert mille.molecules_per_unit == pytest.approx(602214.076)
    assert dataclasses.replace(smooth, rtol=1e-3).molecules_per_unit == 1.0
    for circuit, change in (
        (smooth, {"method": "tau_leap"}),
        (counted, {"concentration_unit": "mM"}),
    ):
        with pytest.raises(tf.InputError, match=r"by dataclasses\.replace give None"):
            dataclasses.replace(circuit, **change)
    own = tf.Circuit(birth, species=("ahl",), concentration_unit="nM", molecules_per_unit=1.0)
    assert own.molecules_per_unit == 1.0  # which nothing reads
    by_mass = tf.Circuit(birth, species=("ahl",), concentration_unit="g/L")
    for circuit in (own, by_mass):
        with pytest.raises(tf.InputError, match="molecules_per_unit"):
            dataclasses.replace(circuit, method="tau_leap")


def test_a_state_with_a_reservoir_goes_on_with_a_named_unit():
    def fed(unit):
        around = tf.Signal(diffusion=1e3, **({} if unit is None else {"concentration_unit": unit}))
        medium = tf.Medium(ahl=around, **BOX, outside="reservoir")
        return tf.Scene(tf.Growth(rate=1.0), medium, dim=2, dt=0.1)

    state = tf.simulate(fed(None), until=0.2).last()
    assert fed("nM").bind(state=state).step(state, 0.1).step == 3
    named = tf.simulate(fed("nM"), until=0.2).last()
    with pytest.raises(tf.InputError, match="ahl"):
        fed("mM").bind(state=named)
