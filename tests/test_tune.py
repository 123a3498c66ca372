"""tune: settings that hold an error, shown by a run of their own; what cannot be held or told is
said."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers import step
from tuned_scenes import dividing, made

import torchfilm as tf
from torchfilm.tools.checks import InputError
from torchfilm.tuning.observables import AccuracyProbe, Error, begin, observables
from torchfilm.tuning.settings_search import SettingsSearch

F64 = torch.float64


@pytest.fixture(scope="module")
def search() -> SettingsSearch:
    scene = tf.scenes.microcolony()
    return SettingsSearch(begin(scene, 38, 12), begin(scene, 25, 12, seed=1), 0.02)


@pytest.fixture(scope="module")
def colony(search) -> tf.Tuned:
    """As tune(microcolony, 0.02, cells=25, colonies=12)."""
    return search.run()


@pytest.mark.slow
def test_what_was_chosen_holds_the_error_in_a_run_of_its_own(colony):
    """Other seeds, another size, and a reference of another kind: α is given, so that contacts do
    not follow their force, and so small that a tenth of the overlap is left; an eighth of the step,
    float64."""
    base = tf.scenes.microcolony()
    *_, start = tf.simulate(base, base.bind(3, seed=9, dtype=F64).start(), cells=30)
    tight = tf.Scene(
        *base.effects[:2],
        tf.Mechanics(dim=2, alpha=0.003, overlap=0.006, tolerance=0.005),
        dt=base.dt / 8,
    )
    ends = []
    for scene in (colony.scene, tight):
        # as long as the probe's window, which every step divides
        state, steps = start, round(0.6 / scene.dt)
        assert steps * scene.dt == pytest.approx(0.6)
        for _ in range(steps):
            state = step(scene, state, scene.dt)
        ends.append({n: float(v[0]) for n, v in observables(state).items()})
    first = {n: float(v[0]) for n, v in observables(start).items()}
    mine, right = ends
    assert mine["overlap"] < 0.02 and right["overlap"] < 0.1 * mine["overlap"]
    assert abs(mine["volume"] - right["volume"]) < 0.02 * (right["volume"] - first["volume"])
    assert abs(mine["radius"] - right["radius"]) < 0.02 * right["radius"]


@pytest.mark.slow
def test_it_says_what_it_chose_and_why(colony, search):
    assert colony.chosen.worst <= 0.02 and set(colony.chosen.errors) <= {
        "cells",
        "volume",
        "radius",
        "overlap",
    }
    assert max(e.value for e in colony.confirmed.values()) <= 0.02 and set(colony.confirmed) == set(
        colony.chosen.errors
    )
    assert set(colony.parts) == {"step", "contacts"} and colony.settings.rtol is None
    others = [t for t in search.tries.values() if search._passes(t)]
    assert all(t.seconds >= colony.chosen.seconds for t in others)
    assert {t.settings for t in others} < {t.settings for t in colony.tries}
    told = str(colony)
    for words in (
        f"dt={colony.settings.dt:g}",
        f"contact_overlap={0.14 * colony.settings.penalty:g}",
        f"tolerance={1.4 * colony.settings.tolerance:g}",
        "2 % in",
        "in other colonies",
        "the reference's own",
        "What accuracy costs",
    ):
        assert words in told
    assert colony.scene.accuracy == colony.settings.given and colony.scene.dt == colony.settings.dt


def test_a_coarser_step_where_the_scene_is_finer_than_it_need_be():
    """m' = k − 2 m, thinned at 1/h: k/3 in the end. Thinning and making take turns at second order
    and all else is exact, so that 5 % allows a coarse step. (Where cells lie that nothing pushes is
    chance, and the radius with it.)"""
    tuned = tf.tune(dividing(), 0.05, cells=8, colonies=4, of=["volume", "m"])
    assert tuned.settings.dt > 0.05 and tuned.settings.rtol >= 1e-2
    assert tuned.chosen.errors["m"].upper_bound < 0.05


def test_a_smaller_error_asks_for_smaller_steps():
    steps = [
        tf.tune(dividing(), error, cells=8, colonies=4, of=["m"]).settings.dt
        for error in (0.05, 2e-4)
    ]
    assert steps[1] < steps[0]


class Flatterer(AccuracyProbe):
    """A probe by which all errors are a hundredth of what they are."""

    def errors(self, found, against, apart=False):
        return {
            n: e if apart else Error(0.01 * e.value, 0.0)
            for n, e in super().errors(found, against, apart).items()
        }


def test_what_does_not_hold_in_other_colonies_is_tightened():
    """The errors of the other probe are not flattered, and the settings are those of an honest
    search, or finer."""
    probe, other = begin(dividing(), 12, 4, ["m"]), begin(dividing(), 8, 4, ["m"], seed=1)

    search = SettingsSearch(Flatterer(**vars(probe)), other, 1e-3)
    flattered = search.run()
    assert search.refuted and flattered.confirmed["m"].value <= 1e-3
    assert (
        flattered.settings.dt
        <= 1.5 * tf.tune(dividing(), 1e-3, cells=8, colonies=4, of=["m"]).settings.dt
    )


def test_only_what_is_named_counts():
    told: list[str] = []
    tuned = tf.tune(dividing(), 0.05, cells=8, colonies=4, of=["volume"], watch=told.append)
    assert set(tuned.chosen.errors) == {"volume"} == set(tuned.own.errors)
    settings = [words for words in told if words.startswith("setting ")]
    assert len(settings) == len(tuned.tries) and settings[1].startswith("setting 2: dt=")
    assert told[0].startswith("growing 4 colonies to 12 cells") and any(
        words.startswith("confirming dt=") for words in told
    )


def test_molecules_are_probed_by_their_mean():
    reactions = [tf.parts.constitutive("m", 5.0), tf.parts.degradation("m", 2.0)]
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=4.0),
        tf.Circuit(reactions, species="m", method="tau_leap"),
        dt=0.05,
    )
    tuned = tf.tune(scene, 0.05, cells=8, colonies=2)
    assert (
        tuned.chosen.errors["m"].upper_bound < 0.05
        and tuned.settings.rtol is None
        and "circuits" not in tuned.parts
    )
    assert [e.method for e in tuned.scene.effects if isinstance(e, tf.Circuit)] == ["tau_leap"]


def test_founders_that_are_as_many_as_asked_for_are_the_start():
    cells = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0], [1.0, 0.0]])
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)), founders=cells, dt=0.05
    )
    assert tf.tune(scene, 0.05, cells=1, colonies=2).cells == 4  # half as many again, rounded up


def test_settings_with_which_a_colony_fails_are_not_chosen():
    """Euler's method is unstable in steps over 2/300 h, and below zero soon: the step is finer,
    though all that is asked for is the volume."""
    stiff = tf.Circuit(
        lambda u, s, p, cell: {"m": 600.0 - 300.0 * u.m}, species=("m",), method="euler"
    )
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)), stiff, dt=0.005)
    tuned = tf.tune(scene, 0.05, cells=2, colonies=2, of=["volume"])
    assert tuned.settings.dt < 0.02
    probe = begin(scene, 2, 2, ["volume"])
    far = probe.observed(tf.Settings(dt=0.02)).found
    assert math.isinf(probe.errors(far, probe.observed(tf.Settings()).found)["volume"].value)


def test_settings_are_not_chosen_by_what_is_left_when_the_volume_cannot_be_known():
    """A number of cells alone would call any settings right, as a whole number of few cells is the
    same by all of them."""
    # (pressure holds growth back, so that the volume depends on contacts)
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2, length_drag=10.0),
    )
    with pytest.raises(InputError, match="Here volume: two references differ by"):
        tf.tune(scene, error=1e-6, cells=8, colonies=2)
    with pytest.raises(InputError, match="Here volume: two references differ by"):
        tf.tune(scene, error=1e-6, cells=8, colonies=2, of=("cells", "volume"))


def test_what_cannot_be_held_or_known_is_said():
    with pytest.raises(
        InputError, match=r"the probe can resolve\. Here m: two references differ by"
    ):
        tf.tune(dividing(), 1e-9, cells=8, colonies=2, of=["m"])


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"error": 0.0}, "error"),
        ({"error": 1.0}, "error"),
        ({"error": 0.1, "cells": 0}, "cells"),
        ({"error": 0.1, "colonies": True}, "colonies"),
        ({"error": 0.1, "colonies": 1}, r"from 2\. The spread between colonies"),
        ({"error": 0.1, "of": ["luxi"], "cells": 2}, "among cells, volume"),
    ],
)
def test_what_makes_no_sense_is_refused(wrong, words):
    with pytest.raises(InputError, match=words):
        tf.tune(dividing(), **wrong)


def test_observables_of_a_known_state():
    cells = tf.Cells([[0.0, 0.0], [0.0, 0.9]], [[1.0, 0.0], [1.0, 0.0]], [2.0, 2.0], [0.5, 0.5])
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics(dim=2),
        tf.Circuit(made, species=("m",), k=1.0, initial={"m": 3.0}),
        tf.Medium(
            ahl=tf.Signal(diffusion=1.0, initial=2.0), box=((-8.0, -8.0), (8.0, 8.0)), spacing=4.0
        ),
        founders=cells,
    )
    found = observables(scene.bind(2, dtype=F64).start())
    assert float(found["cells"]) == 4 and float(found["overlap"]) == pytest.approx(0.1)
    assert float(found["volume"]) == pytest.approx(4 * math.pi * 0.25 * (2 + 1))
    assert float(found["radius"]) == pytest.approx(math.sqrt(2) * 0.45)
    assert found["m"].tolist() == [3.0, 0.0] and found["signal ahl"].tolist() == [2.0 * 16 * 2, 2.0]


def test_chance_is_known_from_how_colonies_differ():
    """Standard errors of a ratio of sums and of a mean, against the textbook's; a run that is
    compared with itself has neither error nor chance."""
    probe = begin(dividing(), 8, 6)
    counts = torch.tensor([8.0, 10.0, 9.0, 12.0, 7.0, 8.0], dtype=F64).unsqueeze(1)
    more = torch.tensor([1.0, 3.0, 0.0, 2.0, 1.0, 2.0], dtype=F64).unsqueeze(1)
    told = probe.errors({"cells": [counts, counts + more]}, {"cells": [counts, counts]})["cells"]
    ratio = float(more.sum() / counts.sum())
    residual = more - ratio * counts  # of the linearised ratio
    assert told.value == pytest.approx(ratio)
    assert told.noise == pytest.approx(
        float((6 / 5 * (residual**2).sum()).sqrt() / counts.sum()), rel=0.1
    )
    seen = probe.observed(tf.Settings()).found
    assert all(e == Error(0.0, 0.0) for e in probe.errors(seen, seen, apart=True).values())
    assert math.isinf(probe.errors({}, seen)["m"].value)
    alone = torch.tensor([[3.0, 9.0, 1.0], [0.0, 0.0, 0.0]], dtype=F64)
    assert probe.errors({"m": [alone, alone]}, {"m": [alone, alone]})["m"] == Error(0.0, math.inf)


def test_no_division_changes_the_volume_that_is_compared():
    model = dividing().bind(3, dtype=F64)
    state = model.start()
    state = state.replace(length=torch.full_like(state.length, 4.6))
    division = next(e for e in model.effects if isinstance(e.effect, tf.Division))
    divided = division.step(state, 0.05)
    assert divided.cells == 6
    assert float(observables(divided)["volume"]) == pytest.approx(
        float(observables(state)["volume"]), rel=1e-12
    )
    assert float(divided.volume.sum()) < float(state.volume.sum()) - 0.5


@pytest.mark.parametrize("colonies, times", [(2, 6.314), (5, 2.132), (24, 1.714)])
def test_the_band_of_few_colonies_is_wide(colonies, times):
    """Student's t, 95 % on one side, from a printed table."""
    assert Error(0.5, 0.1, colonies).upper_bound == pytest.approx(0.5 + times * 0.1, abs=1e-4)


def test_what_other_colonies_never_hold_is_said_after_a_while(monkeypatch):
    monkeypatch.setitem(SettingsSearch._confirmed.__globals__, "MOST_REFUTED", 3)

    class Strict(AccuracyProbe):
        def errors(self, found, against, apart=False):
            return {
                n: e if apart else Error(0.7, 0.01)
                for n, e in super().errors(found, against, apart).items()
            }

    probe, other = begin(dividing(), 12, 4, ["m"]), begin(dividing(), 8, 4, ["m"], seed=1)
    search = SettingsSearch(probe, Strict(**vars(other)), 0.05)
    with pytest.raises(
        InputError, match=r"in both probes: the closest came to .*, in 'm', with dt="
    ):
        search.run()
    assert 1 <= len(search.refuted) <= 3


def test_a_reference_that_fails_in_the_other_colonies_confirms_nothing():
    class Broken(AccuracyProbe):
        def observed(self, settings):
            run = super().observed(settings)
            return dataclasses.replace(
                run, found={n: [v * math.nan for v in parts] for n, parts in run.found.items()}
            )

    probe, other = begin(dividing(), 12, 4, ["m"]), begin(dividing(), 8, 4, ["m"], seed=1)
    with pytest.raises(InputError, match=r"m: a reference failed in the other colonies"):
        SettingsSearch(probe, Broken(**vars(other)), 0.05).run()


def test_steps_taken_in_several_do_not_tell_what_a_step_costs():
    """Of a step that is taken in six a finer one takes a sixth, and is looked at all the same."""
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)), tf.Mechanics(dim=2), dt=0.12
    )
    probe = begin(scene, 20, 2)
    search = SettingsSearch(probe, probe, 0.3)
    coarse, fine = (
        search._run(search.settings(n, *loose))
        for n, loose in ((8, ((0.1, 0, 0.2), 0.1)), (96, ((0.1, 0, 0.2), 0.1)))
    )
    assert coarse.several and not fine.several
    own = fine.seconds / 96
    assert search._least() == pytest.approx(own) and search._least() < coarse.seconds / 8


def test_an_error_of_which_every_step_is_far_off_is_out_of_reach(monkeypatch):
    """Then nothing but the scene's own settings was tried."""
    monkeypatch.setitem(SettingsSearch._try_step.__globals__, "OFF", -1.0)
    with pytest.raises(InputError, match=r"the closest came to .* with the scene's own"):
        tf.tune(dividing(), 0.05, cells=8, colonies=4, of=["m"])


@pytest.mark.parametrize("contacts", ["one-sided", "bilateral"])
def test_what_is_looser_than_what_is_far_off_is_not_run(contacts):
    """Errors of one setting, as given; of others it is told whether they are hopeless, and nothing
    is run."""
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2, length_drag=10.0, contacts=contacts),
    )
    probe = begin(scene, 2, 2)
    search = SettingsSearch(probe, probe, 0.01)
    of = lambda steps, contacts: search.settings(steps, contacts, 0.1)
    known = of(24, (0.1, 0, 0.05))
    for name, value, finest in (
        ("overlap", 0.0145, 28),
        ("volume", 0.029, 28),
        ("volume", math.inf, 0),
    ):
        search.errors = {known: {name: Error(value, 0.0)}}
        for steps in (12, 24, 28, 30, 60):  # the error falls with the square of the step at most
            assert search._hopeless(of(steps, (0.1, 0, 0.05))) == (steps <= finest)
        assert search._hopeless(of(20, (0.3, 0, 0.2))) == (finest > 0)
        assert not any(search._hopeless(of(20, c)) for c in ((0.03, 0, 0.05), (0.1, 0, 0.02)))
        # passes are a knob of bilateral contacts alone: of others, more are the same settings
        more_passes = search._hopeless(of(20, (0.1, 1, 0.05)))
        assert more_passes == (contacts == "one-sided" and finest > 0)
    search.errors = {
        known: {"overlap": Error(0.0145, 0.01, 4)},
        tf.Settings(): {"overlap": Error(9.0, 0.0)},
    }
    assert not search._hopeless(known) and not search.runs


def test_what_chance_leaves_open_is_looked_at_among_more_colonies():
    """A probe of which every error may be chance chooses nothing, unless other colonies tell more
    finely; what these are off by is not chosen."""

    class Unsure(AccuracyProbe):
        def errors(self, found, against, apart=False):
            return {
                n: e if apart else Error(e.value, 0.05)
                for n, e in super().errors(found, against, apart).items()
            }

    class Strict(AccuracyProbe):
        def errors(self, found, against, apart=False):
            return {
                n: e if apart else Error(0.06, 0.0)
                for n, e in super().errors(found, against, apart).items()
            }

    probe, other, third = (
        begin(dividing(), 12, 4, ["m"]),
        begin(dividing(), 8, 4, ["m"], seed=1),
        begin(dividing(), 12, 12, ["m"], seed=2),
    )
    unsure = Unsure(**vars(probe))
    for more in (None, lambda: Strict(**vars(third))):
        with pytest.raises(InputError, match="reached by some settings"):
            SettingsSearch(unsure, other, 0.05, more=more).run()
    tuned = SettingsSearch(unsure, other, 0.05, more=lambda: third).run()
    assert (
        tuned.chosen.errors["m"].upper_bound <= 0.05
        and tuned.chosen.errors["m"].colonies == 12
        and tuned.confirmed["m"].value <= 0.05
    )


def test_a_colony_that_grows_no_more_is_not_waited_for():
    """Found in use: of two designs one never reached the cells that were asked for, and the other
    grew without end."""
    scene = tf.Scene(
        tf.Growth(rate=torch.tensor([1e-5, 1.0])), tf.Division(length=tf.Uniform(3.5, 4.5)), dt=0.01
    )
    start = begin(scene, 4, 2).start
    assert start.counts[0] == 1 and 4 < start.counts[1] < 30 and start.step == 241


def test_names_are_a_list():
    with pytest.raises(
        InputError, match=r"of = 'm' is not allowed: it must be a list of names, such as \['m'\]"
    ):
        tf.tune(dividing(), of="m")


def test_what_other_colonies_refute_is_no_longer_on_the_front():
    """What was refuted has its other error."""
    probe, other = begin(dividing(), 12, 4, ["m"]), begin(dividing(), 8, 4, ["m"], seed=1)

    search = SettingsSearch(Flatterer(**vars(probe)), other, 1e-3)
    tuned = search.run()
    assert search.refuted
    for tried in tuned.tries:
        if tried.settings in search.refuted:
            assert tried.worst > 1e-3 > search.tries[tried.settings].worst
