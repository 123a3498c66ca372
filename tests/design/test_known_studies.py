"""A search starts from several studies, and goes on after they have grown; it stops after hours."""

from __future__ import annotations

import numpy as np
import pytest
from searching import Level, fragile, lit

import torchfilm as tf
from design import (
    CMAES,
    Bayesian,
    Burden,
    Choice,
    Finals,
    Parameter,
    Racing,
    Search,
    Sobol,
    Spread,
    Stripe,
    Study,
    Weighted,
)
from design.task import describe_target

MAKE = [Parameter("make", 0.1, 10.0, log=True)]


def search(parameters=MAKE, scene=lit, **options):
    options = {
        "method": Sobol(batch=3), "cells": 3, "replicates": 2, "finals": None, **options
    }  # fmt: skip
    return Search(scene, parameters, Level(wanted=1.0), **options)


def ran(colonies, study=None, **options):
    made = search(**options)
    made.run(colonies, study=study, progress=False)
    return made


def points_of(study):
    return np.concatenate([e.points for e in study.entries])


def test_studies_with_the_same_seed_are_joined():
    """Of the second study the designs of the first are left out."""
    one = ran(12)
    other = ran(12, method=Sobol(batch=2), method_seed=5)
    made = search(start=[one.study, other.study, one.study])
    known = made.study.entries[0]
    assert known.copies == 0 and len(known.points) == 12
    both = np.concatenate([points_of(one.study), points_of(other.study)])
    assert known.points == pytest.approx(both, abs=1e-12)  # of the logarithm of a value
    assert made.best().loss == min(one.best().loss, other.best().loss)
    joined = np.concatenate([e.loss for s in (one, other) for e in s.study.entries])
    assert np.array_equal(known.loss, joined) and made._known.remark == ""


def test_of_studies_on_other_seeds_the_best_are_grown_and_told_with_the_rest(capsys, tmp_path):
    told = []

    class Listening(Sobol):
        def know(self, points, loss):
            told.append((points, loss))

    ran(12, tmp_path / "one.h5")
    ran(8, tmp_path / "other.h5", seed=3)
    start = [{"make": 3.3}, tmp_path / "other.h5", tmp_path / "one.h5"]
    made = ran(16, tmp_path / "new.h5", start=start, method=Listening(batch=3))
    held, grown, drawn = made.study.entries
    assert (held.copies, len(held.points)) == (0, 6)
    assert (grown.copies, len(grown.points)) == (1, 1 + 4)
    assert grown.values[0]["make"] == pytest.approx(3.3)
    assert len(drawn.points) == 3 and made.study.colonies == 16
    ((points, loss),) = told
    assert np.array_equal(points, np.concatenate([held.points, grown.points]))
    assert np.array_equal(loss, np.concatenate([held.loss, grown.loss]))
    said = capsys.readouterr().err
    assert "start: other.h5: its losses do not hold here (another seed)" in said
    assert "one.h5: " not in said


@pytest.mark.parametrize(
    "method", [CMAES(population=4), Bayesian(batch=2), Sobol(batch=3)], ids=str
)
@pytest.mark.parametrize("seed", [0, 3], ids=["with losses", "grown again"])
def test_a_study_goes_on_after_its_start_has_grown(method, seed, tmp_path, capsys):
    """As if the file from which it began had stayed as it was."""
    ran(8, tmp_path / "old.h5", seed=seed)
    whole = ran(32, start=tmp_path / "old.h5", method=method)
    ran(20, tmp_path / "new.h5", start=tmp_path / "old.h5", method=method)
    ran(16, tmp_path / "old.h5", seed=seed)
    capsys.readouterr()
    made = ran(32, tmp_path / "new.h5", start=tmp_path / "old.h5", method=method)
    assert np.array_equal(points_of(made.study), points_of(whole.study))
    assert made.best().loss == whole.best().loss
    said = capsys.readouterr().err
    assert "start: the study began with 4 of these designs, and goes on with them" in said
    # one whose best designs are others now goes on, too
    again = ran(34, tmp_path / "new.h5", start=Study.read(tmp_path / "old.h5"), method=method)
    assert again.study.colonies == 34


def test_a_study_that_stopped_within_its_start_goes_on(tmp_path):
    ran(8, tmp_path / "old.h5", seed=3)
    whole = ran(12, start=tmp_path / "old.h5")
    ran(4, tmp_path / "new.h5", start=tmp_path / "old.h5")  # two of four designs
    ran(16, tmp_path / "old.h5", seed=3)
    made = ran(12, tmp_path / "new.h5", start=tmp_path / "old.h5")
    assert np.array_equal(points_of(made.study), points_of(whole.study))
    assert len(made.study.entries[0].points) == 4


def test_a_study_does_not_go_on_with_other_values(tmp_path):
    """Values that are given by hand are meant, so that none is left out in silence."""
    ran(8, tmp_path / "old.h5")
    both = [tmp_path / "old.h5", {"make": 2.0}]
    ran(12, tmp_path / "new.h5", start=both)
    ran(16, tmp_path / "old.h5")
    ran(14, tmp_path / "new.h5", start=both)
    others = ran(8, method_seed=5).study
    for start in ([*both, {"make": 3.0}], {"make": 2.0}, [others, {"make": 2.0}]):
        with pytest.raises(tf.InputError, match="Different: start"):
            ran(16, tmp_path / "new.h5", start=start)


def test_a_study_with_nothing_in_the_bounds_is_left_out_beside_others(capsys):
    low = ran(8, parameters=[Parameter("make", 0.1, 0.2, log=True)])
    high = ran(8, parameters=[Parameter("make", 1.0, 2.0, log=True)])
    upper = [Parameter("make", 1.0, 10.0, log=True)]
    made = ran(12, parameters=upper, start=[low.study, high.study])
    assert len(made.study.entries[0].points) == 4
    assert "start: a study: 4 of its 4 designs lie beyond the bounds." in capsys.readouterr().err
    with pytest.raises(tf.InputError, match=r"a study of 8 designs.*within the bounds"):
        search(upper, start=[low.study, low.study])


def test_goals_of_several_studies_are_told():
    goals = {"targets": [Level(wanted=1.0), Spread(Level(wanted=1.0))], "method": "nsga2"}
    make = lambda **options: Search(lit, MAKE, cells=3, replicates=2, finals=None, **options)
    one, other = make(**goals), make(**goals, seed=3)
    one.run(16, progress=False)
    other.run(16, progress=False)
    made = make(**goals, start=[one.study, other.study])
    made.run(40, progress=False)
    held, grown = made.study.entries[:2]
    assert held.goals.shape == grown.goals.shape == (8, 2) and held.copies == 0


def test_hours_end_a_run_which_a_study_resumes(tmp_path, capsys, monkeypatch):
    """The clock passes the deadline as the third batch is wanted; the finals wait for more time."""
    whole = ran(40, finals=Finals(share=0.4, most=2))
    path = tmp_path / "s.h5"
    made = search(finals=Finals(share=0.4, most=2))
    now = lambda: 3600.0 if len(made.study.entries) > 1 else 0.0
    monkeypatch.setattr("time.monotonic", now)
    best = made.run(40, study=path, wall_hours=1.0, progress=False)
    assert len(made.study.entries) == 2 and not made.study.finals
    assert best.loss == min(e.loss.min() for e in made.study.entries)
    said = "stopped at 12 of 40 colonies after wall_hours=1; "
    assert said + f"{path} keeps them; run the search again to resume it." in (
        capsys.readouterr().err
    )
    monkeypatch.undo()
    again = ran(40, path, finals=Finals(share=0.4, most=2))
    assert np.array_equal(points_of(again.study), points_of(whole.study))
    assert again.study.finals and again.best().loss == whole.best().loss


def test_no_design_is_tested_for_its_loss_after_the_hours(tmp_path, capsys, monkeypatch):
    made = search(finals=Finals(share=0.4, most=2))
    now = lambda: 3600.0 if made.study.entries else 0.0
    monkeypatch.setattr("time.monotonic", now)
    made.run(40, stop_at=1e9, wall_hours=1.0, progress=False)
    assert len(made.study.entries) == 1 and not made.study.finals
    assert "stopped at 6 of 40 colonies after wall_hours=1; " in capsys.readouterr().err


def test_no_batch_begins_where_the_hours_pass_while_a_design_is_tested(capsys, monkeypatch):
    """The best of the first batch has the wanted loss on its own seeds, and does not hold it."""
    wanted = ran(40).study.entries[0].loss.min() + 1e-6
    made = search(finals=Finals(share=0.4, most=2))
    monkeypatch.setattr("time.monotonic", lambda: 3600.0 if made.study.finals else 0.0)
    made.run(40, stop_at=wanted, wall_hours=1.0, progress=False)
    assert made.study.finals and len(made.study.entries) == 1
    assert "after wall_hours=1; " in capsys.readouterr().err


@pytest.mark.parametrize(("colonies", "stop_at"), [(24, None), (25, None), (40, 1e9)])
def test_a_search_that_is_done_as_its_hours_end_is_no_stopped_one(
    colonies, stop_at, capsys, monkeypatch
):
    made = search()
    monkeypatch.setattr("time.monotonic", lambda: 3600.0 * (made.study.colonies > 23))
    made.run(colonies, stop_at=stop_at, wall_hours=1.0, progress=False)
    assert "stopped" not in capsys.readouterr().err


def test_hours_that_pass_before_the_first_batch(capsys):
    made = search()
    with pytest.raises(tf.InputError, match="no design has been grown to full size yet"):
        made.run(24, wall_hours=1e-9, progress=False)
    assert "stopped at 0 of 24 colonies after wall_hours=1e-09" in capsys.readouterr().err
    assert made.run(24, progress=False).loss == ran(24).best().loss  # it has no limit of its own


@pytest.mark.parametrize("hours", [0, -1.0, float("nan"), "2"])
def test_hours_are_positive(hours):
    with pytest.raises(tf.InputError, match="wall_hours"):
        search().run(8, wall_hours=hours, progress=False)


def test_a_study_of_other_parameters_is_refused_by_what_differs(tmp_path):
    ran(8, tmp_path / "old.h5")
    ran(12, tmp_path / "new.h5", start=tmp_path / "old.h5")
    more = [*MAKE, Parameter("decay", 0.5, 2.0)]
    ran(4, tmp_path / "old.h5")
    with pytest.raises(tf.InputError, match=r"is the study of another search\. Different: "):
        ran(14, tmp_path / "new.h5", parameters=more, start=tmp_path / "old.h5")


def test_a_remark_counts_what_is_grown_again(capsys):
    one = ran(8, seed=3)
    ran(12, start=[one.study, one.study])
    said = capsys.readouterr().err
    assert said.count("are grown again") == 1 and "so its 4 best designs are grown again" in said


def test_failures_stay_with_their_designs():
    old = search([Parameter("make", 1.0, 10.0)], fragile)
    old.run(16, progress=False)
    of = lambda study: [
        sorted((replicate, words) for (k, replicate), words in e.reasons.items() if k == row)
        for e in study.entries
        for row in range(len(e.points))
    ]
    assert any(of(old.study)) and not all(of(old.study))
    made = search([Parameter("make", 1.0, 20.0)], fragile, start=old.study)
    assert made.study.entries[0].copies == 0 and of(made.study) == of(old.study)
    assert made.study.failed == old.study.failed


def test_what_holds_goes_before_what_does_not():
    holds = ran(8, method=Sobol(batch=4))
    other = ran(8, method=Sobol(batch=4), seed=3, method_seed=0)
    assert np.array_equal(points_of(holds.study), points_of(other.study))
    for start in ([holds.study, other.study], [other.study, holds.study]):
        made = search(start=start)
        assert len(made.study.entries[0].points) == 4 and len(made._known.points) == 0


def test_a_search_with_other_options_is_another(tmp_path):
    ran(8, study=tmp_path / "s.h5")
    for more in ({"method_seed": 5}, {"start": {"make": 1.0}}):
        with pytest.raises(tf.InputError, match="another search"):
            search(**more).run(16, study=tmp_path / "s.h5", progress=False)


def test_only_designs_at_full_size_are_known():
    racing = Racing(inner=CMAES(population=4), sizes=(0.5, 1.0))
    old = ran(20, method=racing, cells=4)
    full = [x for e in old.study.full() for x in e.loss]
    assert 0 < len(full) < sum(len(e.points) for e in old.study.entries)
    made = search(cells=4, start=old.study)
    assert sorted(made.study.entries[0].loss) == sorted(full)


def alone(values):
    return {**values, "second": "none" if values["first"] == "much" else values["second"]}


def pair(first="little", second="none", decay=1.0):
    return lit({"little": 1.0, "much": 3.0}[first] + {"none": 0.0, "some": 0.5}[second], decay)


def test_choices_that_are_resolved_keep_their_losses():
    kinds = [
        Choice(name, options, resolve=alone)
        for name, options in (("first", ("little", "much")), ("second", ("none", "some")))
    ]
    old = search([*kinds, Parameter("decay", 0.8, 1.2)], pair)
    old.run(8, progress=False)
    made = search([*kinds, Parameter("decay", 0.5, 2.0)], pair, start=old.study)
    assert made._known.why == "" and made.study.entries[0].copies == 0


@pytest.mark.parametrize("number", [1.5, np.float64(1.5), np.float32(1.5), np.int64(2)])
def test_a_fixed_number_may_be_of_numpy(number):
    """A study had it as a text that is none of a number, and the default was taken."""
    old = ran(6, fixed={"decay": number})
    made = search([*MAKE, Parameter("decay", 0.5, 2.0)], start=old.study)
    known = made.study.entries[0]
    assert known.copies == 0 and {v["decay"] for v in known.values} == {float(number)}
    assert np.array_equal(known.loss, np.concatenate([e.loss for e in old.study.entries]))


@pytest.mark.parametrize("name", ["cells", "replicates", "seed"])
def test_numbers_of_numpy_are_numbers_in_a_study(name, tmp_path):
    """A sweep by np.arange gives such."""
    path = tmp_path / "study.h5"
    options = {"cells": 3, "replicates": 2, "seed": 1, "method": Sobol(batch=4), "finals": None}
    given = {**options, name: np.int64(options[name])}
    best = Search(lit, MAKE, Level(), **given).run(8, study=path, progress=False)
    best.save(tmp_path / "best.json")
    again = Search(lit, MAKE, Level(), **options).run(8, study=path, progress=False)
    assert again.loss == best.loss and len(Study.read(path).entries) == 1


def test_targets_of_numbers_of_numpy_are_the_same_targets():
    number = lambda of: [Stripe("gfp", at=of(3.0), width=of(2.0)), Weighted([(Burden(), of(2))])]
    for plain, numpy in zip(number(float), number(np.float64), strict=True):
        assert describe_target(plain) == describe_target(numpy)
        assert "np." not in describe_target(numpy) and "2.0" in describe_target(numpy)
