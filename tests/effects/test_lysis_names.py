"""Lysis: names of species and variables that do not serve."""

from __future__ import annotations

import pytest

import torchfilm as tf

FOUR = tf.Cells([[8.0 * k, 0.0] for k in range(4)], [[0.0, 1.0]] * 4)


def test_a_hazard_that_growth_would_dilute_is_refused():
    """Half of what a step adds up would be diluted before it counts: at a hazard of 6/h and a
    growth rate of 1/h, a tenth too many cells lived for an hour."""

    def kills(u, s, p, cell):
        return {"dying": 6.0 + 0.0 * u.gfp, "gfp": 1.0 - u.gfp, "rfp": 1.0 - u.rfp}

    made = lambda **given: tf.Scene(
        tf.Growth(rate=1.0), tf.Circuit(kills, species=["dying", "gfp", "rfp"], **given),
        tf.Lysis(hazard="dying"), founders=FOUR, dim=2,
    )  # fmt: skip
    with pytest.raises(
        tf.InputError, match=r"'dying': growth dilutes .* dilution=\('gfp', 'rfp'\)"
    ):
        made()
    with pytest.raises(tf.InputError, match=r"dilution=False"):
        made(dilution=("dying",))
    for dilution in (("gfp", "rfp"), False):
        made(dilution=dilution)
    named = tf.Circuit(kills, species=["dying", "gfp", "rfp"], name="toxin")
    with pytest.raises(tf.InputError, match=r"dilution=\('gfp', 'rfp'\)"):
        tf.Scene(named, tf.Lysis(hazard="toxin_dying"), founders=FOUR, dim=2)


@pytest.mark.parametrize("option", ["factor", "hazard"])
def test_a_name_that_is_no_variable_is_refused_by_its_option(option):
    more = {"rate": 0.1} if option == "factor" else {}
    scene = tf.Scene(tf.Lysis(**{option: "radius"}, **more), founders=FOUR, dim=2)
    with pytest.raises(tf.InputError, match=rf"Lysis\.{option} = 'radius'"):
        scene.bind().start()
