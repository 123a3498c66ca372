"""What reports of searches conclude, and saved designs that were edited or whose scene was."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from searching import lit

import torchfilm as tf
from design import Burden, Constrained, Objective, OnFraction, Parameter, Search, Sobol, Task
from design.finals import FreshLosses
from design.report import ReportedDesign, SearchReport, _lucky, shown_loss
from design.saved_design import load_design
from design.targets.base import Target

LIT = [Parameter("make", 0.1, 10.0, log=True), Parameter("decay", 0.5, 2.0)]


def searched(target: Target, parameters=LIT, scene=lit, **options):
    made = Search(scene, parameters, target, cells=4, replicates=2, method=Sobol(), **options)
    return made.run(colonies=40, progress=False)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("design") / "lit.json"
    searched(OnFraction("gfp", 0.5, level=1.0)).save(path)
    return path


def test_an_edited_design_is_grown_as_edited(saved, tmp_path):
    """It had grown as before, and checks mixed both."""
    content = json.loads(saved.read_text(encoding="utf-8"))
    content["parameters"]["make"] = 0.2
    edited = tmp_path / "edited.json"
    edited.write_text(json.dumps(content), encoding="utf-8")
    design = load_design(edited, scene=lit)
    with pytest.warns(UserWarning, match="edited.json is a design of another scene.*make: 0.2"):
        grown = design.colonies()
    assert design.values["make"] == 0.2
    losses = torch.cat([c.state.gfp for c in grown])
    *_, own = tf.simulate(lit(**design.values), streams=[0], **design.options)
    assert torch.equal(losses[: own.cells], own.gfp)
    assert not np.array_equal(design.point, np.array(content["search"]["point"]))


def test_a_design_as_it_was_has_the_point_that_was_saved(saved):
    design = load_design(saved, scene=lit)
    assert design.point.tolist() == json.loads(saved.read_text())["search"]["point"]


def otherwise(make=1.0, decay=1.0) -> tf.Scene:
    return lit(make=make, decay=0.5 * decay)


@pytest.mark.parametrize("grow", ["colonies", "check"])
def test_designs_warn_where_their_scene_was_edited(saved, grow):
    design = load_design(saved, scene=otherwise)
    with pytest.warns(UserWarning, match="lit.json is a design of another scene"):
        if grow == "check":
            design.check(seeds=2, sizes=(), vary=0, progress=False)
        else:
            design.colonies()


def deaf(make=1.0, decay=1.0) -> tf.Scene:
    """Nothing that the target reads depends on its parameters."""
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"gfp": 1.0 + cell.x.abs() - u.gfp, "rfp": p.make - p.decay * u.rfp},
        species=("gfp", "rfp"), make=make, decay=decay,
    )  # fmt: skip
    return tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), circuit, dim=2, dt=0.1)


def test_parameters_that_cannot_matter_are_said():
    said = searched(OnFraction("gfp", 0.5, level=1.2), scene=deaf).table()
    assert "nothing that the target reads (gfp) depends on make or decay." in said
    assert "Simulate more colonies" not in said


def test_constraints_do_not_make_a_burden_a_pattern():
    """The loss of the goal alone counts: the least of even levels was the 'best trivial answer'."""
    target = Constrained(Burden(), [OnFraction("gfp", 0.5, level=1.0)], at_most={"on_share": 2.0})
    said = searched(target).table()
    assert "without a pattern" not in said and "weak" not in said
    bounded = Constrained(OnFraction("gfp", 0.5, level=1.0), [Burden()], at_most={"burden": 99.0})
    assert "without a pattern" in searched(bounded).table()
    assert shown_loss(target, Constrained.BROKEN + 0.4) == "misses constraints"
    assert shown_loss(target, 0.25) == "loss 0.250"


def luck(here, fresh, reduce="mean") -> str:
    """What a report says of the losses of the best design, in the search and on fresh seeds."""
    task = Task(
        lit, LIT, OnFraction("gfp", 0.5, level=1.0), cells=3, replicates=len(here), reduce=reduce
    )
    of = lambda losses: float(task.reduced(np.array([losses]))[0])
    half = 1.7 * np.std(fresh) / np.sqrt(len(fresh))
    band = of(fresh) - half, of(fresh) + half
    known = FreshLosses(np.array(fresh), of(fresh), band)
    best = ReportedDesign("best", {}, np.zeros(2), of(here), np.array(here), [], known)
    study = Objective(task)  # not looked at
    return _lucky(SearchReport(task, study, "", best, best))  # type: ignore[arg-type]


def test_luck_is_a_loss_far_below_that_of_fresh_seeds():
    assert "lucky: 0.1000 there, 0.3" in luck([0.1, 0.1], [0.3, 0.32, 0.31, 0.29])
    assert luck([0.28, 0.3], [0.3, 0.32, 0.31, 0.29]) == ""
    # losses below 0: −4.54 lies in the band
    assert luck([-4.55, -4.53], [-4.5, -4.53, -4.49, -4.55]) == ""
    assert "lucky" in luck([-9.0, -9.1], [-4.5, -4.53, -4.49, -4.55])


def test_the_worst_of_two_is_less_than_the_worst_of_ten_without_luck():
    rng = np.random.default_rng(0)
    said = 0
    for _ in range(120):
        losses = rng.lognormal(0.0, 0.4, 12)
        said += bool(luck(losses[:2].tolist(), losses[2:].tolist(), reduce="worst"))
    assert said < 18  # 33 % of them, before


def test_missed_constraints_are_words_in_tables_and_pictures(tmp_path):
    """They were losses of 1000000000.284."""
    impossible = Constrained(
        OnFraction("gfp", 0.5, level=1.0), [Burden()], at_most={"burden": 1e-9}
    )
    best = searched(impossible)
    said = best.table()
    (row,) = [line for line in said.splitlines() if line.startswith("loss   ")]
    assert row.split()[1:] == ["misses", "constraints"] * 2
    (row,) = [line for line in said.splitlines() if line.startswith("loss on fresh")]
    assert "misses constraints" in row and "seeds" in row and "e+09" not in said
    figure = best.plot(tmp_path / "missed.png")
    words = [ax.get_title() for ax in figure.figure.axes] + [
        ax.get_ylabel() for ax in figure.figure.axes
    ]
    assert any(w.startswith("best, misses constraints\n(misses on fresh seeds)") for w in words)
    assert "constraints missed" in words

    some = Constrained(OnFraction("gfp", 0.5, level=1.0), [Burden()], at_most={"burden": 1.0})
    titles = [ax.get_title() for ax in searched(some).plot(tmp_path / "some.png").figure.axes]
    assert any("those that miss constraints are left out" in w for w in titles)
