"""Growth dilutes the species that a circuit names."""

from __future__ import annotations

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
