"""What a search says of itself: once what all its designs make one say, and where it is in vain."""

import warnings

import pytest
import torch

import torchfilm as tf
from design import Choice, Measured, Parameter, Racing, Search, Sobol


def makes(u, s, p, cell):
    return {"m": p.k - u.m}


def most(state: tf.State):
    return state.groups.max(state.m)


def dim_colony(k=1.0) -> tf.Scene:
    """Its levels, in M, are far below the absolute tolerance of circuits."""
    return tf.Scene(
        tf.Circuit(makes, species="m", k=k), founders=tf.inoculum(4, radius=8.0, seed=1), dt=0.05
    )


def test_small_species_are_told_once_and_not_for_each_design():
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        search = Search(
            dim_colony, [Parameter("k", 1e-14, 1e-11, log=True)],
            Measured({"most": most}, {"most": 1.0}, {"most": 1.0}),
            until=0.1, replicates=1, method=Sobol(batch=4), seed=0, finals=None,
        )  # fmt: skip
        search.run(colonies=12, progress=False)
    small = [w for w in told if "its species are of about" in str(w.message)]
    assert len(small) == 1  # as the search is made


def makes_when_starved(u, s, p, cell):
    return {"m": 20.0 * tf.kinetics.repression(s.food, p.k, 4) - u.m}


def test_species_that_a_signal_represses_at_first_are_not_small():
    """At first 20 · (k/s)⁴ = 2e-11; without food they make 20 an hour."""
    for k in (1e-3, 1e-14):
        scene = tf.Scene(
            tf.Circuit(makes_when_starved, species="m", k=k),
            tf.Medium(food=tf.Signal(9.0, initial=1.0), box=((-9, -9), (9, 9)), spacing=3.0),
            founders=tf.inoculum(4, radius=5.0, seed=1), dt=0.05,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            scene.bind(1).start()


def leaves(rate=1.0) -> tf.Scene:
    """Cells that grow out of their box: no colony comes to its end."""
    return tf.Scene(
        tf.Growth(rate=rate), tf.Division(length=4.0),
        tf.Medium(a=tf.Signal(diffusion=1.0), box=((-3.0, -3.0), (3.0, 3.0)), spacing=3.0),
        tf.Mechanics(dim=2), dt=0.1,
    )  # fmt: skip


@pytest.mark.parametrize(("colonies", "grown"), [(300, 80), (40, 40)])
def test_a_search_ends_where_every_colony_fails(colonies, grown, capfd):
    """After a quarter of the budget, of 64 colonies at least; no colony goes to the finals."""
    search = Search(
        leaves, [Parameter("rate", 1.0, 2.0)],
        Measured({"cells": lambda state: state.counts.double()}, {"cells": 9.0}, {"cells": 1.0}),
        until=4.0, replicates=2, method=Sobol(batch=5), seed=0,
    )  # fmt: skip
    search.run(colonies, progress=False)
    assert 0 < search.study.colonies <= grown and not search.study.finals
    assert "every colony failed; the most frequent reason: " in capfd.readouterr().err


def test_a_search_says_that_small_colonies_tell_nothing_apart(capfd):
    def count(k=1.0) -> tf.Scene:
        return tf.Scene(
            tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2),
            tf.Circuit(makes, species="m", k=k), dt=0.1,
        )  # fmt: skip

    large = lambda state: torch.where(state.counts < 16, 0.0, most(state))
    search = Search(
        count, [Parameter("k", 0.1, 2.0)], Measured({"m": large}, {"m": 1.0}, {"m": 1.0}),
        cells=20, replicates=1, method=Racing(inner=Sobol(batch=4)), seed=0, finals=None,
    )  # fmt: skip
    search.run(colonies=10, progress=False)
    said = capfd.readouterr().err
    assert said.count("colonies of 0.25 of the size all have the loss 1:") == 1


def test_a_parameter_on_which_nothing_depends_is_told(capfd):
    def lit(k=1.0, typo=1.0) -> tf.Scene:
        return tf.Scene(
            tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2),
            tf.Circuit(makes, species="m", k=k), dt=0.1,
        )  # fmt: skip

    def run(*parameters, scene=lit):
        target = Measured({"most": most}, {"most": 1.0}, {"most": 1.0})
        search = Search(scene, parameters, target, cells=2, replicates=1, finals=None)
        search.run(colonies=2, progress=False)
        return capfd.readouterr().err

    k, typo = Parameter("k", 0.1, 2.0), Parameter("typo", 0.1, 2.0)
    assert "nothing in the scene depends on typo: " in run(k, typo)
    assert "depends on" not in run(k)
    either = lambda k=1.0, typo=1.0, kind="a": lit(k if kind == "a" else typo)
    assert "depends on" not in run(k, typo, Choice("kind", ["a", "b"]), scene=either)


LIGHT = torch.tensor([0.0, 1.0])


def lit_by_place(k=1.0) -> tf.Scene:
    rates = lambda u, s, p, cell: {"m": p.k * LIGHT[cell.colony.long() % 2] - u.m}
    return tf.Scene(tf.Circuit(rates, species="m", k=k), founders=tf.Cells.single(2), dt=0.1)


def ruled_by_place(k=1.0) -> tf.Scene:
    def shine(cells):
        cells.light = LIGHT[cells.colony % 2]

    rates = lambda u, s, p, cell: {"m": p.k * cell.light - u.m}
    return tf.Scene(
        tf.Rules(shine, variables={"light": 0.0}), tf.Circuit(rates, species="m", k=k),
        founders=tf.Cells.single(2), dt=0.1,
    )  # fmt: skip


def lit_by_choice(k=1.0, mask=0) -> tf.Scene:
    rates = lambda u, s, p, cell: {"m": p.k * LIGHT[p.mask.long()] - u.m}
    circuit = tf.Circuit(rates, species="m", k=k, mask=mask)
    return tf.Scene(circuit, founders=tf.Cells.single(2), dt=0.1)


@pytest.mark.parametrize(("scene", "title"), [(lit_by_place, "circuit"), (ruled_by_place, "rules")])
def test_losses_that_depend_on_the_place_in_a_batch_are_warned_of(scene, title):
    target = Measured({"most": most}, {"most": 0.5}, {"most": 0.1})
    with pytest.warns(UserWarning, match=f"the scene's {title} reads the ids of colonies"):
        Search(scene, [Parameter("k", 1.0, 1.001)], target, until=0.5, replicates=1)


def test_a_mask_that_is_a_choice_gives_alike_designs_one_loss():
    target = Measured({"most": most}, {"most": 0.5}, {"most": 0.1})
    masks = Choice("mask", (0, 1), per_colony=True)
    search = Search(
        lit_by_choice, [Parameter("k", 1.0, 1.0 + 1e-9), masks], target, until=0.5, replicates=1,
        method=Sobol(batch=8), seed=0, finals=None,
    )  # fmt: skip
    search.run(colonies=8, progress=False)
    (batch,) = search.study.entries
    each = zip(batch.values, batch.loss.tolist(), strict=True)
    assert len({(values["mask"], round(loss, 6)) for values, loss in each}) == 2 < len(batch.loss)
