"""Names for columns."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch

import torchfilm as tf
from torchfilm.circuits.names import Names


def test_columns_by_name():
    u = Names(("luxi", "ahl"), torch.tensor([[1.0, 2.0], [3.0, 4.0]]), "u")
    assert u.ahl.tolist() == [2.0, 4.0] and u["luxi"].tolist() == [1.0, 3.0]
    assert list(u) == ["luxi", "ahl"] and len(u) == 2 and "ahl" in u and "x" not in u
    p = Names(["D1", "k"], [0.1, torch.tensor([1.0])], "p")
    assert p.D1 == 0.1
    assert repr(p) == "Names(D1, k)"


def test_unknown_names_say_what_there_is():
    u = Names(("luxi", "ahl"), torch.zeros(1, 2), "u")
    with pytest.raises(
        tf.InputError, match=r"u has no 'lux1'; known are luxi, ahl\. Did you mean 'luxi'\?"
    ):
        _ = u.lux1
    with pytest.raises(tf.InputError, match=r"known are luxi, ahl\.$"):
        _ = u["zzz"]
    with pytest.raises(tf.InputError, match="known are none"):
        _ = Names((), (), "s").ahl
    assert not hasattr(u, "lux1") and getattr(u, "lux1", None) is None


def test_names_can_only_be_read():
    u = Names(("luxi",), torch.zeros(1, 1), "u")
    with pytest.raises(tf.InputError, match=r"u\.luxi can only be read"):
        u.luxi = 1
    with pytest.raises(tf.InputError, match="can only be read"):
        del u.luxi
    with pytest.raises(ValueError, match="zip"):
        Names(("a", "b"), torch.zeros(1, 3))


def test_a_species_may_have_any_name():
    """No method of the class has a plain name, so none hides a species."""
    assert [n for n in dir(Names) if not n.startswith("_")] == []


def test_copies_do_not_recurse():
    """copy reads attributes of an object that has no columns yet."""
    u = Names(("a",), torch.ones(2, 1), "u")
    for other in (copy.copy(u), pickle.loads(pickle.dumps(u))):
        assert other.a.tolist() == [1.0, 1.0]
        with pytest.raises(tf.InputError, match="u has no"):
            _ = other.b


def test_a_constant_that_was_not_given_says_how_to_give_it():
    scene = tf.Scene(tf.Circuit(lambda u, s, p, cell: {"gfp": p.make}, species="gfp"), dim=2)
    with pytest.raises(tf.InputError, match=r"p has no 'make'.*Circuit\(…, make=…\)"):
        scene.bind()


def test_a_reaction_with_the_name_of_a_signal_says_how_to_write_it():
    make = tf.parts.activated("gfp", by="ahl", rate=1.0, half=1.0)
    with pytest.raises(tf.InputError, match=r"unknown name 'ahl'.*'out.ahl' for a signal"):
        tf.Scene(tf.Circuit(make, species="gfp"), dim=2).bind()
