"""One design under several conditions: `Conditions`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from searching import grown

import torchfilm as tf
from design import (
    Burden,
    Conditions,
    Finals,
    Lasting,
    Measured,
    Objective,
    OnFraction,
    Parameter,
    Search,
    Spread,
    Task,
    Weighted,
    check_robustness,
    infer,
    load_design,
)
from design.scoring import finished_colonies

MAKE = [Parameter("strength", 0.1, 30.0, log=True), Parameter("basal", 0.01, 1.0, log=True)]


def rates(u, s, p, cell):
    return {"gfp": p.strength * (p.basal + p.iptg**2 / (1.0 + p.iptg**2)) - u.gfp}


def gate(strength=1.0, basal=0.1, iptg=0.0):
    circuit = tf.Circuit(rates, species="gfp", strength=strength, basal=basal, iptg=iptg)
    division = tf.Division(length=tf.Uniform(3.0, 4.0))
    return tf.Scene(tf.Growth(rate=1.0), division, circuit, dt=0.1)


def fed(make=1.0, food=1.0):
    """Growth depends on the condition."""
    return grown(food, make)


def level(state):
    return state.groups.sum(state.gfp.double() * state.volume) / state.groups.sum(state.volume)


def near(low, high=None) -> Measured:
    return Measured({"gfp": level}, {"gfp": low if high is None else (low, high)}, {"gfp": 0.5})


DARK, LIT = near(0.0, 0.3), near(3.0, 5.0)
GATE = Conditions([({"iptg": 0.0}, DARK), ({"iptg": 10.0}, LIT)])


def search(target=GATE, **options) -> Search:
    given = {"cells": 8, "replicates": 2, "method": "sobol", "finals": None, **options}
    return Search(gate, MAKE, target, **given)


def test_a_gate_is_dark_without_its_inducer_and_lit_with_it():
    found = search(finals=Finals(share=0.2), method="auto")
    best = found.run(colonies=240, progress=False)
    assert best.loss == 0 and 200 <= found.study.colonies <= 240
    told = best.table()
    assert "gfp (iptg = 0)" in told and "gfp (iptg = 10)" in told and "undefined" not in told
    finished = {
        int(k): float(x)
        for part in best.colonies()
        for k, x in zip(part.state.colony_id, level(part.state), strict=True)
    }
    assert sorted(finished) == [0, 1, 2, 3]
    assert all(x < 0.3 if k % 2 == 0 else 3.0 < x < 5.0 for k, x in finished.items())


@pytest.mark.parametrize(
    ("scene", "space", "name", "end"),
    [
        (gate, MAKE, "iptg", {"cells": 8}),
        (fed, [Parameter("make", 0.1, 10.0)], "food", {"cells": 6}),
        (fed, [Parameter("make", 0.1, 10.0)], "food", {"until": 1.0}),
    ],
)
def test_the_loss_is_the_mean_of_those_under_single_conditions(scene, space, name, end):
    """To the bit, each replicate with its random numbers: where growth is recorded, and where
    colonies end at times of their own."""
    values, targets = (0.7, 1.0, 1.6), (near(0.5), near(2.0), near(1.0, 1.5))
    both = Conditions([({name: x}, t) for x, t in zip(values, targets, strict=True)])
    points = np.random.default_rng(0).uniform(size=(5, len(space)))
    found = Objective(Task(scene, space, both, replicates=3, **end)).evaluate(points)
    alone = [
        Objective(Task(scene, space, t, replicates=3, fixed={name: x}, **end)).evaluate(points)
        for x, t in zip(values, targets, strict=True)
    ]
    assert np.array_equal(found.losses, np.mean([x.losses for x in alone], axis=0))
    assert np.array_equal(found.cells, np.min([x.cells for x in alone], axis=0))
    assert found.losses.shape == (5, 3) and found.copies == 3
    parts = Objective(Task(scene, space, both, replicates=3, most=4, **end)).evaluate(points)
    assert np.array_equal(parts.losses, found.losses)


def test_a_replicate_fails_where_one_of_its_colonies_does():
    never = Conditions([({"food": 0.0}, near(1.0)), ({"food": 1.0}, near(1.0))])
    space = [Parameter("make", 0.1, 10.0)]
    task = Task(fed, space, never, cells=6, until=3.0, replicates=2)
    found = Objective(task).evaluate(np.array([[0.5]]))
    assert (found.losses == never.failed).all()
    assert all(words.startswith("where food = 0: ") for words in found.reasons.values())
    assert sorted(found.reasons) == [(0, 0), (0, 1)]


def smooth(low: float, high: float | None = None) -> Measured:
    return replace(near(low, high), smooth=True)


def test_slopes_are_differences_where_a_measure_may_pass_no_gradient():
    task = Task(gate, MAKE, GATE, cells=8, replicates=2)
    objective = Objective(task)
    assert "smooth=True" in objective.why_differences
    found = objective.evaluate(np.array([[0.6, 0.4]]), slopes=True)
    assert found.copies == objective.copies(True) == 10


@pytest.mark.parametrize("end", [{"cells": 8}, {"until": 2.0}])
@pytest.mark.parametrize("of_course", [False, True])
def test_slopes_are_exact_where_those_of_its_targets_are(end, of_course):
    """The gradient, and twice the product of the residuals' derivatives, as differences give them;
    also of targets that look at every step."""
    parts = [smooth(0.0), smooth(3.0)]
    if of_course:
        parts = [Lasting(part, since=1.0) for part in parts]
    target = Conditions([({"iptg": x}, part) for x, part in zip((0.0, 10.0), parts, strict=True)])
    objective = Objective(Task(gate, MAKE, target, replicates=2, dtype=torch.float64, **end))
    assert not objective.why_differences
    points = np.array([[0.6, 0.4], [0.3, 0.7]])
    found = objective.evaluate(points, slopes=True)
    assert found.copies == objective.copies(True) == 4
    plain = objective.evaluate(points)
    assert found.losses == pytest.approx(plain.losses, rel=1e-9)
    h = 1e-5
    for k in range(2):
        step = h * np.eye(2)[k]
        more, less = (objective.evaluate(points + x).loss for x in (step, -step))
        slope = found.slopes.gradient[:, k]
        assert slope == pytest.approx((more - less) / (2 * h), rel=2e-3, abs=1e-6)
    if not of_course:  # one residual a colony, the root of its loss
        each = objective.task
        roots = []
        for k in range(2):
            step = h * np.eye(2)[k]
            two = (
                np.concatenate([_levels(each, p) for p in points + x]).reshape(2, -1)
                for x in (step, -step)
            )
            roots.append(np.subtract(*two) / (2 * h) / 0.5)
        rows = np.stack(roots, 2)  # designs, colonies, parameters
        wanted = 2 * np.einsum("nci,ncj->nij", rows, rows) / rows.shape[1]
        assert found.slopes.curvature == pytest.approx(wanted, rel=5e-3, abs=1e-6)


def _levels(task: Task, point: np.ndarray) -> list[float]:
    """The level of each colony of a design, of all replicates under all conditions."""
    found = finished_colonies(task, task.space.values(point), (0, 1))
    each = {
        int(k): float(x)
        for end in found
        for k, x in zip(end.state.colony_id, level(end.state), strict=True)
    }
    return [each[k] for k in sorted(each)]


def test_least_squares_fit_a_dose_response():
    """Data of four doses without errors: the constants are found again, to digits."""
    doses = (0.0, 0.5, 2.0, 10.0)
    *_, end = tf.simulate(gate(strength=2.0, basal=0.3, iptg=torch.tensor(doses)), until=2.0)
    target = Conditions(
        [({"iptg": x}, smooth(float(y))) for x, y in zip(doses, level(end), strict=True)]
    )
    found = Search(gate, MAKE, target, until=2.0, replicates=1)
    best = found.run(colonies=400, progress=False)
    assert "by gradients from the best" in found.why_chosen
    assert best.loss < 1e-6
    assert best.values == pytest.approx({"strength": 2.0, "basal": 0.3}, rel=1e-3)


def test_a_poor_fit_is_named(tmp_path):
    target = Conditions([({"iptg": 0.0}, near(50.0)), ({"iptg": 10.0}, near(1.0, 2.0))])
    best = search(target).run(colonies=12, progress=False)
    assert "The best design is off most in gfp (iptg = 0) by" in str(best.table())


def test_a_study_goes_on_and_a_design_is_saved(tmp_path):
    """With a target that a file can hold."""
    target = Conditions([({"iptg": 0.0}, OnFraction("gfp", 0.1, 1.0)),
                         ({"iptg": 10.0}, OnFraction("gfp", 0.9, 1.0))])  # fmt: skip
    path = tmp_path / "study.h5"
    search(target).run(colonies=20, study=path, progress=False)
    again = search(target)
    best = again.run(colonies=40, study=path, progress=False)
    whole = search(target)
    assert whole.run(colonies=40, progress=False).values == best.values
    assert again.study.colonies == 40
    other = Conditions(
        [({"iptg": x}, part) for (_, part), x in zip(target.terms, (0.0, 5.0), strict=True)]
    )
    with pytest.raises(tf.InputError, match="target"):
        search(other).run(colonies=40, study=path, progress=False)
    best.save(tmp_path / "gate.json")
    saved = load_design(tmp_path / "gate.json", scene=gate)
    assert saved.target == target
    assert np.array_equal(saved.objective.evaluate(saved.point[None]).losses[0], best.searched)
    ends = [
        float(level(state).mean())
        for given in ({}, {"iptg": 10.0})
        for *_, state in [tf.simulate(saved.scene(**given), **saved.options)]
    ]
    assert ends[1] > 2 * ends[0]
    with pytest.raises(tf.InputError, match=r"scene = 'strength' .* its conditions: iptg"):
        saved.scene(strength=1.0)


def test_a_check_is_under_all_conditions():
    best = search().run(colonies=64, progress=False)
    found = check_robustness(best, seeds=4, sizes=(0.5,), progress=False)
    assert found.losses.shape == (4,) and found.sizes[0].losses.shape == (4,)


def test_a_picture_shows_one_replicate_under_each_condition(tmp_path):
    values = (0.0, 1.0, 3.0, 10.0)
    four = Conditions([({"iptg": x}, near(x, x + 1.0)) for x in values])
    best = search(four).run(colonies=64, progress=False)
    axes = best.plot(tmp_path / "gate.png").figure.axes
    titles = [ax.get_title() for ax in axes if ax.get_title()]
    assert [t for t in titles if t.endswith("replicate 0")][:3] == [
        f"iptg = {x:g}, replicate 0" for x in values[1:]
    ]
    assert titles[0].endswith("\niptg = 0")


@pytest.mark.parametrize(
    ("terms", "words"),
    [
        ([({"iptg": 0.0}, DARK)], "two at least"),
        ([({"iptg": 0.0}, DARK), ({"iptg": 0.0}, LIT)], "conditions that differ"),
        ([({"iptg": 1234567.0}, DARK), ({"iptg": 1234568.0}, LIT)], "that differ in six digits"),
        ([({"iptg": 0.0}, DARK), ({"x": 1.0}, LIT)], r"terms\[1\] names 'x', and .* names 'iptg'"),
        ([({"iptg": 0.0}, DARK), ({}, LIT)], "numbers by name"),
        ([({"iptg": "no"}, DARK), ({"iptg": 1.0}, LIT)], "iptg = 'no' .* a number"),
        ([({"iptg": 0.0}, DARK), ({"iptg": 1.0}, Spread(LIT))], "a loss of single colonies"),
        ([({"iptg": 0.0}, DARK), ({"iptg": 1.0}, GATE)], "under one condition"),
        ([({"iptg": 0.0}, DARK), "lit"], "pairs of arguments"),
    ],
)
def test_what_are_no_conditions(terms, words):
    with pytest.raises(tf.InputError, match=words):
        Conditions(terms)


def test_where_conditions_do_not_belong():
    of = lambda name: Conditions([({name: 0.0}, DARK), ({name: 1.0}, LIT)])
    with pytest.raises(tf.InputError, match=r"'strength' .* neither searched nor fixed"):
        search(of("strength"))
    with pytest.raises(tf.InputError, match="neither searched nor fixed"):
        search(fixed={"iptg": 1.0})
    with pytest.raises(tf.InputError, match=r"'itpg' .* a parameter of gate.* mean 'iptg'"):
        search(of("itpg"))
    for make in (lambda: Weighted([(GATE, 1.0)]), lambda: Lasting(GATE, since=1.0)):
        with pytest.raises(tf.InputError, match="Conditions stand outermost"):
            make()
    with pytest.raises(tf.InputError, match="Conditions stand outermost"):
        Search(gate, MAKE, targets=[GATE, Burden()], cells=8)
    with pytest.raises(tf.InputError, match="one number, as data"):
        infer(gate, MAKE, GATE, cells=8)
    with pytest.raises(tf.InputError, match="replicates=2 colonies under each of 2 conditions"):
        search().run(colonies=3, progress=False)


def test_trivial_answers_are_under_all_conditions():
    """All dark is right in one of two."""
    from design.trivial import trivial_losses

    dark = OnFraction("gfp", 0.01, 1.0)
    target = Conditions([({"iptg": 0.0}, dark), ({"iptg": 10.0}, OnFraction("gfp", 0.99, 1.0))])
    found = search(target, reduce="worst")
    best = found.run(colonies=16, progress=False)
    task = found.objective.task
    answers = trivial_losses(target, best.colonies(), task.reduced)
    each = [part.loss(torch_dark(s)) for part in target.parts for s in [best.colonies()[0].state]]
    assert answers["all dark"] == pytest.approx(float(np.mean([float(x[0]) for x in each])))


def torch_dark(state: tf.State) -> tf.State:
    return state.with_fields(gfp=torch.zeros_like(state.gfp))


def test_what_takes_one_plain_number_is_no_condition():
    def crowd(n=20):
        founders = lambda seed: tf.inoculum(n, 15.0, seed=seed)
        return tf.Scene(tf.Growth(rate=1.0), founders=founders, dim=2, dt=0.1)

    cells = Measured({"cells": lambda s: s.counts.double()}, {"cells": 9.0}, {"cells": 1.0})
    several = Conditions([({"n": 10}, cells), ({"n": 40}, cells)])
    with pytest.raises(tf.InputError, match=r"Conditions, arrive as a tensor .* tf\.Founders"):
        Task(lambda n=20, k=1.0: crowd(n), [Parameter("k", 0.5, 2.0)], several, until=0.2)
    with pytest.raises(tf.InputError, match="makes of it what it stands for, such as a value of a"):
        Conditions([({"light": tf.Schedule({0: 1.0})}, cells), ({"light": 1.0}, cells)])


def needs(strength, basal, iptg):
    return gate(strength, basal, iptg)


def test_the_scene_of_a_design_is_under_the_first_condition(tmp_path):
    """In the session of the search as in another; an argument may have no default."""
    task = {"until": 0.5, "replicates": 1, "method": "sobol", "finals": None}
    made = Search(needs, MAKE, Conditions([({"iptg": 0.3}, DARK), ({"iptg": 10.0}, LIT)]), **task)
    best = made.run(8, progress=False)
    saved = load_design(best.save(tmp_path / "best.json"), scene=needs)
    circuit = best.scene().effects[-1]
    assert circuit.parameters["iptg"] == 0.3
    assert best.scene().fingerprint == saved.scene().fingerprint
