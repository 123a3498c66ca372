"""Settings of accuracy: what they change in a scene and what not, as data in files and results, and
as presets."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

import torchfilm as tf
from torchfilm.effects.mechanics import TOLERANCE
from torchfilm.kernels.scheme import OVERLAP
from torchfilm.kernels.scheme import TOLERANCE as FORCE_TOLERANCE
from torchfilm.tools.checks import InputError
from torchfilm.tuning.settings import PRESETS, typed


def made(u, s, p, cell):
    return {"m": 1.0 - u.m}


def scene(**mechanics) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2, **mechanics),
        tf.Circuit(made, species=("m",)),
        name="mine",
        dt=0.02,
    )


def of(made: tf.Scene, kind: type):
    return next(e for e in made.effects if isinstance(e, kind))


def bound_circuit(made: tf.Scene):
    return next(e for e in made.bind().effects if isinstance(e.effect, tf.Circuit))


BILATERAL = {"contacts": "bilateral", "length_drag": 10.0}


@pytest.mark.parametrize(
    "contacts, reached",
    [
        # of overlap and of force errors, the part that these knobs are of their usual values;
        # one-sided contacts repeat passes by themselves
        ("one-sided", {"contact_overlap": 2 * OVERLAP, "tolerance": 0.2 * FORCE_TOLERANCE}),
        ("bilateral", {"alpha": 0.01, "tolerance": 0.01, "passes": 3, "overlap": 0.02}),
    ],
)
def test_knobs_reach_their_effects_and_nothing_else(contacts, reached):
    first = scene(contacts=contacts, length_drag=20.0, walls=[tf.Channel(8.0)])
    second = tf.Settings(dt=0.01, penalty=0.2, passes=3, tolerance=0.01, rtol=1e-3).apply(first)
    mechanics, circuit = of(second, tf.Mechanics), of(second, tf.Circuit)
    for field in dataclasses.fields(tf.Mechanics):
        before, after = (getattr(of(s, tf.Mechanics), field.name) for s in (first, second))
        right = reached.get(field.name, before)
        assert after == (pytest.approx(right) if field.name in reached else right), field.name
    assert (second.dt, circuit.rtol) == (0.01, 1e-3)
    assert mechanics.walls == of(first, tf.Mechanics).walls and mechanics.length_drag == 20.0
    assert (
        circuit.rates == of(first, tf.Circuit).rates
        and circuit is not of(first, tf.Circuit)
        and of(first, tf.Circuit).rtol == 1e-4
    )
    # what is found out of one by trying it is not that of the other
    noted = [bound_circuit(made) for made in (first, second)]
    assert noted[0].exchanged is not noted[1].exchanged
    assert noted[0].values is not noted[1].values and noted[0].effect is of(first, tf.Circuit)
    assert (
        second.effects[:2] == first.effects[:2]
        and second.name == "mine"
        and second.founders is first.founders
    )
    assert first.dt == 0.02 and of(first, tf.Mechanics).passes is None  # the first is as it was


@pytest.mark.parametrize(
    "given, settings, overlap",
    [
        ({}, {"passes": 3}, 0.02),
        ({}, {"passes": 3, "penalty": 0.2}, 0.02),
        ({}, {"passes": 3, "penalty": 0.03}, 0.006),
        ({"alpha": 0.001}, {"passes": 3}, 0.002),
        ({"alpha": 0.001}, {"passes": 3, "penalty": 0.1}, 0.02),
        ({"overlap": 0.05}, {"passes": 3, "penalty": 0.03}, 0.05),
        ({"stiffness": 100.0}, {"passes": 3, "penalty": 0.03}, 0.02),
        ({}, {"penalty": 0.03}, None),
    ],
)
def test_who_sets_passes_wants_overlaps_gone(given, settings, overlap):
    """Of bilateral contacts: down to 0.02 µm, or as much less as α·γ is below 0.1, where none is
    given (γ = 10)."""
    made = of(tf.Settings(**settings).apply(scene(**BILATERAL, **given)), tf.Mechanics)
    assert made.overlap == (None if overlap is None else pytest.approx(overlap))


@pytest.mark.parametrize("contacts", ["one-sided", "bilateral"])
@pytest.mark.parametrize("given", [{}, {"stiffness": 100.0}, {"alpha": 0.003}])
def test_knobs_are_those_that_change_something_and_usual_values_are_the_defaults(contacts, given):
    effect = tf.Mechanics(dim=2, contacts=contacts, length_drag=10.0, **given)
    knobs = effect.accuracy_knobs()
    for name, values in (("penalty", (0.03, 0.3)), ("passes", (2, 3)), ("tolerance", (0.01, 0.1))):
        made = [effect.with_settings(tf.Settings(**{name: value})) for value in values]
        seen = [(one.alpha, one.overlap, one.settings) for one in made]
        assert (seen[0] != seen[1]) == (name in knobs), name
    same = effect.with_settings(tf.Settings(**knobs)).settings
    usual = dataclasses.replace(effect, alpha=None).settings
    if contacts == "one-sided":
        assert same == usual
    else:
        assert (same.passes, same.tolerance) == (usual.passes, TOLERANCE)


def test_a_penalty_takes_the_place_of_the_scenes_own_hardness():
    for given in ({}, {"alpha": 0.003}, {"contact_overlap": 0.5}):
        made = of(tf.Settings(penalty=0.03).apply(scene(**given)), tf.Mechanics)
        assert made.contact_overlap == pytest.approx(0.3 * OVERLAP) and made.alpha is None


def test_without_knobs_the_scene_stays_as_it_is():
    first = scene()
    assert tf.Settings().apply(first).listing() == first.listing() and tf.Settings().given == {}
    assert tf.preset("standard", first).apply(first).listing() == first.listing()


def test_physical_softness_and_molecules_are_no_knobs():
    for contacts, passes in (("one-sided", None), ("bilateral", 2)):
        first = scene(stiffness=100.0, contacts=contacts)
        soft = of(tf.Settings(penalty=0.2, passes=2).apply(first), tf.Mechanics)
        assert (soft.stiffness, soft.alpha, soft.contact_overlap) == (100.0, None, None)
        assert soft.passes == passes
    molecules = tf.Circuit([tf.parts.constitutive("m", 1.0)], species="m", method="tau_leap")
    grown = tf.Settings(rtol=1e-2).apply(tf.Scene(tf.Growth(rate=1.0), molecules))
    assert of(grown, tf.Circuit) is molecules
    assert molecules.without_noise().method == "rosenbrock" and molecules.method == "tau_leap"
    assert molecules.without_noise().daughters == "amount"


def test_one_penalty_for_drags_that_differ_between_colonies():
    """Of bilateral contacts, whose α is measured by the drag; one-sided ones follow their force."""
    drawn = scene(length_drag=tf.Uniform(9.0, 11.0))
    made = of(tf.Settings(penalty=0.1).apply(drawn), tf.Mechanics)
    assert made.contact_overlap == OVERLAP
    with_drag = lambda drag: scene(contacts="bilateral", length_drag=drag)
    first = with_drag([10.0, 20.0])
    alpha = of(tf.Settings(penalty=0.1).apply(first), tf.Mechanics).alpha
    assert alpha.tolist() == pytest.approx([0.01, 0.005])
    for drag in ({0: 10.0, 1: 20.0}, tf.Uniform(9.0, 11.0)):  # one α would not be of all cells
        with pytest.raises(InputError, match=r"length_drag.*contacts are bilateral"):
            with_drag(drag)


@pytest.mark.parametrize(
    "wrong",
    [
        {"dt": 0.0},
        {"penalty": -1.0},
        {"passes": 0},
        {"passes": 1.5},
        {"tolerance": 0.7},
        {"rtol": 0.5},
        {"rtol": "small"},
    ],
)
def test_knobs_that_make_no_sense_are_refused(wrong):
    with pytest.raises(InputError, match=f"Settings.{next(iter(wrong))}"):
        tf.Settings(**wrong)


def test_files_hold_what_was_saved_and_nothing_else_is_taken(tmp_path):
    settings = tf.Settings(dt=0.01, passes=2)
    path = settings.save(tmp_path / "a.json")
    assert tf.Settings.load(path) == settings
    with pytest.raises(InputError, match="no file yet"):
        settings.save(path)
    for text, words in (
        ("{", "holds no settings"),
        ('{"dt": 0.01}', "no settings of accuracy"),
        ('{"format": "torchfilm settings", "pass": 2}', "one of dt, penalty"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            tf.Settings.load(path)
    path.write_text(json.dumps({"format": "torchfilm settings", "dt": -1.0}))
    with pytest.raises(InputError, match=r"Settings\.dt"):
        tf.Settings.load(path)


def test_presets_are_ordered_by_what_they_cost_and_by_overlap():
    """Draft to reference: smaller steps and, measured, less overlap. One colony of 40 cells
    each."""
    first = tf.scenes.microcolony()
    steps, overlaps = [], []
    for name in PRESETS:
        chosen = tf.preset(name, first).apply(first)
        *_, last = tf.simulate(chosen, chosen.bind(3, seed=2).start(), cells=40)
        steps.append(last.step)
        overlaps.append(float(tf.measure.overlaps(last).mean.mean()))
    assert steps == sorted(steps) and steps[0] < steps[-1] / 10
    assert overlaps == sorted(overlaps, reverse=True), overlaps
    with pytest.raises(InputError, match="draft"):
        tf.preset("rough", first)


def test_results_say_how_accurately_and_go_on_so(tmp_path):
    first = tf.scenes.microcolony()
    drafted = tf.preset("draft", first).apply(first)
    *_, last = tf.simulate(
        drafted, drafted.bind(2, seed=1).start(), until=0.4, record=tmp_path / "a.h5"
    )
    with tf.Results(tmp_path / "a.h5") as results:
        assert results.accuracy == {
            "dt": pytest.approx(0.04),
            "penalty": 0.1,
            "tolerance": 0.2,
            "rtol": 0.01,
        }
        built = tf.Settings.named(results.accuracy, "a.h5").apply(tf.scenes.build(*results.recipe))
        assert torch.equal(results.state(built).position, last.position)
        with pytest.raises(InputError, match="another scene"):
            results.state(first)


@pytest.mark.parametrize(
    "given, settings, words",
    [
        ({}, {}, {"contact_overlap": f"{OVERLAP:g}", "tolerance": f"{FORCE_TOLERANCE:g}"}),
        (
            {},
            {"penalty": 0.03, "tolerance": 0.2},
            {"contact_overlap": "0.0042", "tolerance": "0.28"},
        ),
        ({"alpha": [0.1, 0.2]}, {}, {"alpha": "0.1 to 0.2", "tolerance": "0.07"}),
        ({"stiffness": 100.0}, {"penalty": 0.03}, {"tolerance": "0.07"}),
        (BILATERAL, {}, {"alpha": "0.01", "passes": "1", "tolerance": "default"}),
        (
            BILATERAL,
            {"penalty": 0.03, "tolerance": 0.2, "passes": 4},
            {"alpha": "0.003", "passes": "4", "overlap": "0.006", "tolerance": "0.2"},
        ),
    ],
)
def test_settings_are_told_as_the_user_types_them(given, settings, words):
    """Typed in place of the settings, they give the same contacts."""
    first = scene(**given)
    second = tf.Settings(dt=0.01, rtol=1e-2, **settings).apply(first)
    told = typed(second)
    assert told == {"dt": "0.01", "rtol": "0.01", **words}
    if settings:
        numbers = {n: float(v) for n, v in words.items() if n != "passes"}
        passes = {"passes": int(words["passes"])} if "passes" in words else {}
        again = of(scene(**given, **numbers, **passes), tf.Mechanics)
        right = dataclasses.asdict(of(second, tf.Mechanics).settings)
        assert dataclasses.asdict(again.settings) == pytest.approx(right)


def test_circuits_of_several_tolerances_are_told_apart():
    two = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Circuit(made, species=("m",), rtol=1e-3),
        tf.Circuit(made, species=("m",), name="other"),
        tf.Circuit([tf.parts.constitutive("n", 1.0)], species="n", method="tau_leap", name="third"),
    )
    assert typed(two)["rtol"] == "0.001 and 0.0001"


@pytest.mark.parametrize(
    "name, words",
    [
        ("draft", {"dt": "0.032", "contact_overlap": "0.014", "tolerance": "0.28", "rtol": "0.01"}),
        (
            "standard",
            {"dt": "0.02", "contact_overlap": "0.014", "tolerance": "0.07", "rtol": "0.0001"},
        ),
        (
            "reference",
            {"dt": "0.0025", "contact_overlap": "0.0042", "tolerance": "0.0014", "rtol": "1e-06"},
        ),
    ],
)
def test_presets_are_what_the_page_on_accuracy_says(name, words):
    assert typed(tf.preset(name, scene()).apply(scene())) == words
