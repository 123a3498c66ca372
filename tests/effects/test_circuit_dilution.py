"""Growth dilutes the species that a circuit names."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import torchfilm as tf


def still(u, s, p, cell):
    return {}


def grown(**options):
    """One cell that grows tenfold and divides, with 5 of a and of b at the start."""
    circuit = tf.Circuit(still, species=("a", "b"), initial={"a": 5.0, "b": 5.0}, **options)
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), circuit, dt=0.05)
    start = scene.bind(dtype=torch.float64).start()
    *_, end = tf.simulate(scene, start, until=2.5)
    assert end.cells > 4
    return start, end


def test_all_species_are_diluted_by_default():
    start, end = grown(daughters="amount")
    for name in ("a", "b"):
        amount = (end.fields[name] * end.volume).sum()
        torch.testing.assert_close(amount, (start.fields[name] * start.volume).sum())


@pytest.mark.parametrize("daughters", ["amount", "concentration"])
def test_named_species_are_diluted_and_others_stay(daughters):
    _, end = grown(dilution=("a",), daughters=daughters)
    assert (end.b == 5.0).all()
    assert (end.a < 1.0).all()


@pytest.mark.parametrize("daughters", ["amount", "concentration"])
def test_without_dilution_every_concentration_stays(daughters):
    _, end = grown(dilution=False, daughters=daughters)
    assert (end.a == 5.0).all() and (end.b == 5.0).all()


def test_all_names_are_the_default():
    circuit = tf.Circuit(still, species=("a", "b"), dilution=("a", "b"))
    assert circuit.dilution is True


def test_a_name_that_is_no_species_is_refused():
    with pytest.raises(tf.InputError, match="dilution names 'ab', which is no species; known are"):
        tf.Circuit(still, species=("a", "b"), dilution=("ab",))


def test_molecules_are_kept_so_they_are_diluted():
    with pytest.raises(tf.InputError, match=r"dilution = False is not allowed.*molecules"):
        reactions = [tf.Reaction.of("a -> 0", 1.0)]
        tf.Circuit(reactions, species="a", method="direct", dilution=False)


WRITTEN = {
    "a term": lambda u, s, p, cell: {"yfp": p.k - cell.growth_rate * u.yfp},
    "a factor": lambda u, s, p, cell: {"yfp": cell.growth_rate * (p.k - u.yfp)},
    "beside a decay": lambda u, s, p, cell: {"yfp": p.k - (0.5 + cell.growth_rate) * u.yfp},
    "a reaction": [
        tf.Reaction({}, {"yfp": 1}, lambda u, s, p, cell: p.k),
        tf.Reaction({"yfp": 1}, {}, lambda u, s, p, cell: cell.growth_rate * u.yfp),
    ],
    "of one type": {0: lambda u, s, p, cell: {"yfp": p.k - cell.growth_rate * u.yfp}},
}


def bound(rates, dilution):
    circuit = tf.Circuit(rates, species=["yfp", "cfp"], k=2.0, dilution=dilution)
    return tf.Scene(tf.Growth(rate=0.7), circuit, founders=tf.Cells.single(2), dt=0.1).bind()


@pytest.mark.parametrize("rates", WRITTEN.values(), ids=WRITTEN)
def test_dilution_that_the_rates_contain_as_well_gets_a_warning(rates):
    with pytest.warns(UserWarning, match=r"'yfp' loses cell\.growth_rate·yfp, and growth dilutes"):
        bound(rates, True)
    with pytest.warns(UserWarning, match="If that term is dilution, it counts twice"):
        bound(rates, ["yfp"])


@pytest.mark.filterwarnings("error")
def test_rates_that_may_lose_a_species_by_growth_get_no_warning():
    for rates in WRITTEN.values():
        bound(rates, False)
        bound(rates, ["cfp"])
    # a term that is switched off
    off = lambda u, s, p, cell: {"yfp": p.k - (p.k - 2.0) * cell.growth_rate * u.yfp}
    bound(off, True)
    # of µm/h, which dilutes by the length
    circuit = tf.Circuit(WRITTEN["a term"], species=["yfp"], k=2.0)
    growth = tf.Growth(rate=0.7, law="linear")
    tf.Scene(growth, circuit, founders=tf.Cells.single(2), dt=0.1).bind()
    # more is made in cells that grow faster
    faster = lambda u, s, p, cell: {"yfp": p.k * cell.growth_rate * u.cfp - 2 * u.yfp}
    bound(faster, True)
    # an enzyme that is made as cells grow
    bound(lambda u, s, p, cell: {"yfp": p.k - cell.growth_rate * u.yfp / (1 + u.yfp)}, True)


def test_what_is_said_of_dilution_is_allowed():
    with pytest.warns(UserWarning, match=r"it counts twice: leave it out of the rates\.$"):
        circuit = tf.Circuit(WRITTEN["a reaction"], species="yfp", k=2.0, method="direct")
        tf.Scene(tf.Growth(rate=0.7), circuit, founders=tf.Cells.single(2), dt=0.1).bind()
    with pytest.warns(UserWarning, match="or 'yfp' out of dilution=…"):
        bound(WRITTEN["a term"], True)


@pytest.mark.filterwarnings("error")
def test_rates_that_no_equations_can_be_made_of_run_as_before():
    def rates(u, s, p, cell):
        if type(u.yfp) is not torch.Tensor:
            raise KeyError("no tensor")
        return {"yfp": p.k - cell.growth_rate * u.yfp}

    model = bound(rates, True)
    assert model.step(model.start()).fields["yfp"].item() > 0


@pytest.mark.parametrize("name", ["k", "low", "seed"])
@pytest.mark.parametrize("value", [2.0, np.float32(2.0), torch.tensor(2.0)], ids=type)
def test_dilution_is_judged_at_the_values_of_constants(name, value):
    """A factor that is 1 for this value."""

    def rates(u, s, p, cell):
        return {"yfp": 1.0 - (getattr(p, name) - 1.0) * cell.growth_rate * u.yfp}

    for growing, wanted in ((value, True), (value + 1, False)):
        circuit = tf.Circuit(rates, species="yfp", **{name: growing})
        scene = tf.Scene(tf.Growth(rate=0.7), circuit, founders=tf.Cells.single(2), dt=0.1)
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            scene.bind()
        assert any("it counts twice" in str(w.message) for w in found) == wanted
