"""Several goals: the front of a search, targets under constraints, and goals that are no
patterns."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from patterned import row
from searching import Level, Spread, built, fragile, grown, lit, mean, objective_of, paced

import torchfilm as tf
from design import (
    NSGA2,
    Burden,
    Choice,
    Constrained,
    Duration,
    Finals,
    Lasting,
    Parameter,
    Search,
    Sobol,
    Study,
    Weighted,
)
from design import Spread as SpreadOfLosses
from design.finals import FIRST_STREAM
from design.pareto import nondominated, spread
from design.targets.goals import Goals

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]
GOALS = [Level(wanted=1.0), Burden()]


def search(parameters=LIT, scene=lit, targets=GOALS, **options):
    options = {"method": NSGA2(population=8), "cells": 3, "replicates": 2, **options}
    return Search(scene, parameters, targets=targets, **options)


class Sobol8(Sobol):
    """Points of a Sobol sequence, for several goals."""

    several = True

    def tell(self, batch, loss, slopes=None):
        super().tell(batch, np.zeros(len(batch.points)))


# --- the front ------------------------------------------------------------------------------------


def test_the_front_is_what_no_other_row_exceeds():
    goals = np.random.default_rng(0).random((200, 3)).round(1)
    goals[5] = np.nan
    rows = nondominated(goals)
    for k, mine in enumerate(goals):
        better = [(g <= mine).all() and (g < mine).any() for g in goals]
        alike = any(np.array_equal(goals[r], mine) for r in rows)
        assert alike == (not np.isnan(mine).any() and not any(better)), k
    assert (np.diff(goals[rows, 0]) >= 0).all()
    few = spread(goals[rows], 4)
    assert len(few) == 4 and {few[0], few[-1]} == {0, len(rows) - 1}
    assert spread(goals[rows[:2]], 4).tolist() == [0, 1]


def test_the_unit_of_a_goal_does_not_change_which_designs_are_spread():
    share = np.linspace(0.0, 1.0, 40)
    goals = np.stack([share, (1.0 - share) ** 4], 1)
    for unit in ([1.0, 1000.0], [1000.0, 1.0]):
        assert np.array_equal(spread(goals * unit, 6), spread(goals, 6))


def test_a_search_with_two_goals_returns_their_front():
    """Designs brighter than wanted are worse in both goals."""
    made = search()
    front = made.run(400, progress=False)
    assert front.titles == ("level", "burden") and len(front) >= 5
    assert (np.diff(front.goals[:, 0]) > 0).all() and (np.diff(front.goals[:, 1]) < 0).all()
    assert front.goals[:, 0].min() < 0.25 and front.goals[:, 1].max() < 1.3
    # one cell of a design: its level, and the distance from it, add up to 1
    assert front.goals.sum(1) == pytest.approx(1.0, abs=0.35)
    assert front.seeds >= 4 and made.study.colonies <= 400
    streams = made.study.finals[-1].streams
    found = made.objective.evaluate(front.points, streams=streams)
    assert np.array_equal(found.goals, front.goals)
    assert found.loss == pytest.approx(found.goals.sum(1))
    colonies, volume = front.convergence()
    assert (np.diff(volume) >= 0).all() and 0 < volume[-1] <= 1 and len(colonies) == len(volume)
    assert "on" in front.table() and "fresh seeds" in front.table()


def test_the_goals_of_a_front_have_the_errors_of_their_means():
    """A goal that is no mean over the seeds has none, and neither has that of one seed."""
    made = search(targets=[Level(wanted=1.0), Burden(), SpreadOfLosses(Level())])
    front = made.run(240, progress=False)
    streams = made.study.finals[-1].streams
    assert len(streams) == front.seeds >= 4
    each = made.objective.evaluate(front.points, streams=streams).each_goals
    wanted = each[:, :, :2].std(1, ddof=1) / np.sqrt(front.seeds)
    assert (wanted > 0).all() and front.errors[:, :2] == pytest.approx(wanted)
    assert np.isnan(front.errors[:, 2]).all() and front.table().count(" ± ") == 2 * len(front)
    shown = f"{front.goals[0, 0]:.4g} ± {front.errors[0, 0]:.2g}"
    assert shown in front.table()
    assert (made.front(fresh=False).errors[:, :2] > 0).all()  # of the two seeds of the search
    alone = search(replicates=1, finals=None).run(40, progress=False)
    assert np.isnan(alone.errors).all() and "±" not in alone.table()


def test_any_design_of_a_front_is_saved_and_drawn(tmp_path):
    front = search(cells=6).run(120, progress=False)
    best = front[1]
    assert best.values == front.values[1] and len(list(front)) == len(front)
    assert best.save(tmp_path / "one.json").exists()
    assert "level" not in best.table() or "burden" in best.table()
    assert front.plot(tmp_path / "front.png").path.stat().st_size > 10_000


def test_a_front_resumes(tmp_path):
    whole = search()
    expected = whole.run(160, progress=False)
    search(finals=None).run(60, study=tmp_path / "s.h5", progress=False)
    again = search()
    front = again.run(160, study=tmp_path / "s.h5", progress=False)
    assert np.array_equal(front.points, expected.points)
    assert np.array_equal(front.goals, expected.goals)
    kept = Study.read(tmp_path / "s.h5")
    assert np.array_equal(kept.entries[0].goals, whole.study.entries[0].goals)
    assert len(search(start=kept).study.entries[0].points) == sum(
        len(e.points) for e in kept.entries
    )


def test_designs_that_fail_are_not_on_the_front():
    made = search([Parameter("make", 1, 10)], fragile, [Level(), Burden()], finals=None)
    front = made.run(64, progress=False)
    goals = np.concatenate([e.goals for e in made.study.entries])
    assert np.isnan(goals).any() and not np.isnan(front.goals).any()


def test_auto_takes_a_method_for_several_goals():
    made = search(method="auto", finals=None)
    made.run(70, progress=False)
    assert made.why_chosen.startswith("auto: nsga2") and "2 goals" in made.why_chosen


def test_a_study_of_goals_is_a_start_with_its_goals(tmp_path):
    search([Parameter("make", 0.5, 5, log=True), LIT[1]], finals=None).run(
        32, study=tmp_path / "old.h5", progress=False
    )
    made = search(start=tmp_path / "old.h5", finals=None)
    made.run(32, study=tmp_path / "new.h5", progress=False)
    old, kept = Study.read(tmp_path / "old.h5"), Study.read(tmp_path / "new.h5")
    assert np.array_equal(kept.entries[0].goals, np.concatenate([e.goals for e in old.entries]))
    for one, other in zip(kept.entries, made.study.entries, strict=True):
        assert one.copies == other.copies and np.array_equal(one.goals, other.goals)
        assert np.array_equal(one.each_goals, other.each_goals)
    again = search(start=tmp_path / "old.h5", finals=None)
    front = again.run(64, study=tmp_path / "new.h5", progress=False)
    assert len(again.study.entries) == 5 and len(front) >= 5


def points_of(made):
    return np.concatenate([e.points for e in made.study.entries])


def test_known_designs_are_the_first_population_and_are_not_grown_again():
    """40 designs are known, and a population has 8: the 8 that NSGA-II keeps, none of which fails.
    The first batch are their daughters, and not Sobol points."""
    old = search([Parameter("make", 0.5, 5, log=True), LIT[1]], finals=None, method=Sobol8())
    old.run(80, progress=False)
    made = search(start=old.study, finals=None)
    known = made.study.entries[0]
    assert known.copies == 0 and len(known.points) == 40
    made.run(32, progress=False)
    assert made.study.colonies == 32 and len(made.study.entries) == 3
    fresh = points_of(made)[40:]
    apart = np.abs(fresh[:, None] - known.points[None]).max(2).min(1)
    assert (apart > 1e-6).all()
    alone = search(finals=None)
    alone.run(16, progress=False)
    sobol = alone.study.entries[0].points
    assert not any((np.abs(fresh - point).max(1) < 1e-6).any() for point in sobol)
    # told the same batches, a method by hand is where the search was
    method = NSGA2(population=8)
    method.start(made.objective.task.space, 0, 2)
    method.know(known.points, known.goals)
    for entry in made.study.entries[1:]:
        assert np.array_equal(method.ask().points, entry.points)
        method.tell(method.ask(), entry.goals)


def test_the_best_known_designs_are_kept():
    """Of a front of three, and designs behind it, of which some failed."""
    front = np.array([[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]])
    goals = np.concatenate([[[2.0, 2.0], [np.nan, np.nan]], front, [[3.0, 3.0]]])
    points = np.array([[0.1, 0.1], [0.2, 0.2], [0.3, 0.3], [0.4, 0.4], [0.5, 0.5], [0.6, 0.6]])
    method = NSGA2(population=4)
    method.start(objective_of(lit, LIT, Goals(GOALS), cells=3).task.space, 0, 1)
    method.know(points, goals)
    kept = {tuple(one.X) for one in method._search.pop}
    assert kept == {(0.3, 0.3), (0.4, 0.4), (0.5, 0.5), (0.1, 0.1)}
    with pytest.raises(tf.InputError, match="with two goals or more"):
        method.know(points, goals[:, 0])


@pytest.mark.parametrize("failed", [0, 1])
def test_fewer_known_designs_are_filled_up(failed):
    """Also where one of them is what the first batch would have proposed, and where all failed."""
    task = objective_of(lit, LIT, Goals(GOALS), cells=3).task
    plain = NSGA2(population=8)
    plain.start(task.space, 0, 1)
    first = plain.ask().points
    method = NSGA2(population=8)
    method.start(task.space, 0, 1)
    points = np.array([first[2] + 1e-14, [0.123, 0.456]])
    goals = np.array([[1.0, 2.0], [2.0, 1.0]])
    method.know(points, np.where(failed, np.nan, goals))
    if failed:
        assert np.array_equal(method.ask().points, first)
        return
    assert np.array_equal(method.ask().points, np.delete(first, 2, 0)[:6])
    method.tell(method.ask(), np.random.default_rng(0).random((6, 2)))
    assert len(method._search.pop) == 8 and len(method.ask().points) == 8


def test_designs_by_name_are_grown_once():
    start = [{"make": 1.1, "decay": 1.0}, {"make": 3.0, "decay": 1.0}]
    made = search(start=start, finals=None)
    made.run(36, progress=False)
    assert [len(e.points) for e in made.study.entries] == [2, 6, 8, 2]
    assert len(np.unique(points_of(made), axis=0)) == 18


@pytest.mark.parametrize("sizes", [(1.0,), (0.5, 1.0)])
def test_a_front_of_a_longer_search_keeps_all_its_designs(tmp_path, sizes):
    """The second finals grow again only the seeds that designs of the first finals lack."""
    make = lambda: search(finals=Finals(sizes=sizes), reduce="worst")
    make().run(160, study=tmp_path / "s.h5", progress=False)
    made = make()
    front = made.run(500, study=tmp_path / "s.h5", progress=False)
    assert made.study.colonies <= 500 and len(made.study.finals) > len(sizes)
    streams = range(FIRST_STREAM, FIRST_STREAM + front.seeds)
    task = made.objective.task
    each = [
        type(made.objective)(task.resized(s)).evaluate(front.points, streams=streams).each_goals
        for s in sizes
    ]
    assert np.array_equal(task.reduced_goals(np.max(each, axis=0)), front.goals)
    # both ends of the front of the search have been grown
    last = make()
    last.run(500, study=tmp_path / "s.h5", progress=False)
    every = np.concatenate([e.points for e in made.study.full()])
    goals = np.concatenate([e.goals for e in made.study.full()])
    rows = nondominated(goals)
    tested = {p.tobytes() for e in made.study.finals for p in e.points}
    assert {every[rows[0]].tobytes(), every[rows[-1]].tobytes()} <= tested
    assert last.study.colonies == made.study.colonies


@pytest.mark.parametrize("start", [None, [{"genes": 2, "promoter": "weak"}] * 2])
def test_designs_with_few_levels_are_grown_once_in_the_first_batch(start):
    few = [Parameter("genes", 1, 2, whole=True), Choice("promoter", ("weak", "strong"))]
    made = search(few, built, [Level("g0"), Burden()], finals=None, start=start)
    made.run(40, progress=False)
    known = 0 if start is None else 1
    first = made.study.entries[known].points
    assert len(first) == len(np.unique(first, axis=0)) == 4 - known


def test_a_front_needs_no_more_than_the_replicates_of_one_design():
    made = search(replicates=20)
    front = made.run(20, progress=False)
    assert len(front) == 1 and front.seeds == 0 and made.study.colonies == 20


# --- goals ----------------------------------------------------------------------------------------


def last_state(scene, colonies=3, **end):
    *_, state = tf.simulate(scene, scene.bind(colonies, seed=1).start(), **end)
    return state


def test_burden_is_the_mean_over_the_volume_of_all_species():
    state = last_state(built(genes=3), until=1.0)
    volume = state.volume.double()
    total = sum(state.fields[f"g{k}"].double() for k in range(3))
    wanted = [
        float((volume * total)[state.colony == k].sum() / volume[state.colony == k].sum())
        for k in range(3)
    ]
    assert Burden().loss(state).tolist() == pytest.approx(wanted)
    one = Burden(("g1",)).loss(state) + Burden(("g0", "g2")).loss(state)
    assert one.tolist() == pytest.approx(wanted)


def test_a_large_cell_is_a_large_part_of_the_burden():
    """A ball, and a rod of three times its volume."""
    state = row([0.0, 5.0], length=np.array([0.0, 4 / 3]), g=np.array([0.0, 4.0]))
    assert float(Burden(("g",)).loss(state)[0]) == pytest.approx(3.0)


def test_duration_is_the_time_of_the_end():
    objective = objective_of(
        paced, [Parameter("rate", 1.0, 2.0)], Duration(), cells=4, replicates=1
    )
    slow, fast = objective.evaluate(np.array([[0.0], [1.0]])).loss
    assert slow > 1.5 * fast > 0


def test_a_weighted_sum_is_one():
    state = last_state(lit(), until=1.0)
    parts = [(Level(wanted=1.0), 2.0), (Burden(), 0.5)]
    wanted = 2.0 * Level(wanted=1.0).loss(state) + 0.5 * Burden().loss(state)
    target = Weighted(parts)
    assert torch.allclose(target.loss(state), wanted)
    assert set(target.measures(state)) == {"mean_level", "burden"} and target.names == ("gfp",)
    assert target.failed == 2.0 * Level.failed + 0.5 * Burden.failed


def test_constraints_come_before_the_loss():
    state = last_state(grown(2.0, make=torch.tensor([0.5, 2.0, 8.0])), until=1.0)
    level = mean(state, "gfp")
    bound = float(level[1])
    target = Constrained(Burden(), [Level()], at_least={"mean_level": bound})
    loss = target.loss(state)
    assert torch.equal(loss[1:], Burden().loss(state)[1:])
    missed = float((bound - level[0]) / bound)
    assert float(loss[0]) == pytest.approx(target.BROKEN + missed / (1 + missed))
    above = Constrained(Burden(), [Level()], at_most={"mean_level": bound}).loss(state)
    assert float(above[2]) > target.BROKEN > float(above[1])
    assert "mean_level ≥" in target.describe()


def test_spread_is_that_between_seeds():
    objective = objective_of(lit, LIT, SpreadOfLosses(Level()), cells=6, replicates=4)
    found = objective.evaluate(np.full((2, 2), 0.5))
    assert found.loss == pytest.approx(found.losses.std(1, ddof=1)) and (found.loss > 0).all()


def test_a_design_whose_seeds_all_fail_is_not_alike_on_all():
    made = Search(
        fragile, [Parameter("make", 1, 10)], SpreadOfLosses(Level()), cells=6, replicates=2,
        method=Sobol(batch=8), finals=None,
    )  # fmt: skip
    best = made.run(16, progress=False)
    entry = made.study.entries[0]
    failed = {row for row, _ in entry.reasons}
    assert 0 < len(failed) < 8 and best.loss < 0.5
    assert all((entry.loss[k] == Level.failed) == (k in failed) for k in range(8))


def test_the_band_and_the_slopes_of_a_spread_are_its_own():
    made = Search(lit, LIT, SpreadOfLosses(Level()), cells=6, replicates=3, method=Sobol(batch=8))
    best = made.run(100, progress=False)
    assert best.band[0] <= best.loss <= best.band[1]
    point, step = np.full((1, 2), 0.5), 0.01 * np.eye(2)
    objective = made.objective
    assert "several seeds" in objective.why_differences
    found = objective.evaluate(point, slopes=True).slopes.gradient[0]
    for k in range(2):
        up, down = (objective.evaluate(point + side * step[k]).loss[0] for side in (1, -1))
        assert found[k] == pytest.approx((up - down) / 0.02)


def test_a_weighted_sum_does_not_depend_on_the_batch():
    target = Weighted([(Level(wanted=1.0 / (k + 3)), 0.1 + 0.3 * k) for k in range(5)])
    state = last_state(grown(2.0, make=torch.linspace(0.5, 3.0, 24)), colonies=24, until=1.0)
    each = [target.loss(state.select(torch.tensor([k])))[0] for k in range(24)]
    assert torch.equal(target.loss(state), torch.stack(each))


def test_a_search_says_by_how_much_its_first_batch_misses_the_constraints(capsys):
    target = Constrained(Burden(), [Level()], at_least={"mean_level": 1e3})
    made = Search(lit, LIT, target, cells=3, replicates=2, method=Sobol(batch=4), finals=None)
    made.run(16, progress=False)
    words = capsys.readouterr().err
    assert words.count("no design of the first batch meets") == 1 and "mean_level ≥ 1000" in words
    found = float(words.rsplit("misses them by ")[1].split(" %")[0])
    nearest = made.study.entries[0].loss.min() - target.BROKEN
    assert found == pytest.approx(100 * nearest / (1 - nearest), abs=0.5)


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: search(targets=[Level()]), "two targets or more.*One goal has no front"),
        (lambda: search(targets=[]), "a list of targets"),
        (lambda: search(targets=[Level(), 3]), "a list of targets"),
        (lambda: search(method="cmaes"), 'one for several goals, such as "nsga2"'),
        (lambda: Search(lit, LIT, Level(), cells=3, method="nsga2"), r"NSGA2 needs targets=\[…\]"),
        (lambda: Search(lit, LIT, cells=3), r"target = None.*or targets=\[…\]"),
        (lambda: Search(lit, LIT, Level(), targets=GOALS, cells=3), "one of the two"),
        (lambda: search().run(20, stop_at=0.1, progress=False), "a front has no one loss"),
        (lambda: Search(lit, LIT, Level(), cells=3, method=Sobol()).front(), r"targets=\[…\]"),
        (lambda: Weighted([]), "pairs of a target and its weight"),
        (lambda: Weighted([(Level(), -1.0)]), "weight of Level.*-1.0"),
        (lambda: Constrained(Level()), "no constraint"),
        (lambda: Burden(()), "Burden.species"),
        (lambda: search(targets=[Level(), Burden(("rfp",))]), "'rfp'"),
        (lambda: search(targets=[Level(), SpreadOfLosses(Level())], replicates=1), "2 or more"),
        (lambda: Weighted([(SpreadOfLosses(Level()), 1.0)]), "Weighted.*loss of single colonies"),
        (lambda: Lasting(SpreadOfLosses(Level()), since=1.0), "Lasting.*single colonies"),
        (lambda: SpreadOfLosses(SpreadOfLosses(Level())), "Spread.*single colonies"),
        (
            lambda: search(
                targets=[
                    Level(),
                    Constrained(Level(), [Level(wanted=2.0)], at_least={"mean_level": 1.0}),
                ]
            ),
            "'mean_level'.*a measure of one target",
        ),
        (
            lambda: search(targets=[Level(), Constrained(Level(), at_least={"contrast": 1.0})]),
            "measure = 'contrast'.*'mean_level'",
        ),
        (
            lambda: Search("microcolony", [Parameter("rate", 0.5, 1.0)], Burden(), cells=3),
            "without species",
        ),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(make, words):
    with pytest.raises(tf.InputError, match=words):
        make()


def test_spread_of_places_needs_no_species():
    assert Weighted([(Spread(), 1.0)]).names == ()


def test_what_the_finals_had_no_room_for_is_told_and_at_hand():
    made = search(finals=Finals(share=0.2, most=1))
    front = made.run(120, progress=False)
    whole = made.front(fresh=False)
    assert front.seeds and not whole.seeds and len(whole) > len(front)
    tested = {p.tobytes() for e in made.study.finals for p in e.points}
    assert front.untested == sum(p.tobytes() not in tested for p in whole.points) > 0
    said = f"{front.untested} more were not tested: search.front(fresh=False)"
    assert said in front.table() and said in repr(front) and "not tested" not in repr(whole)


def test_the_box_of_a_hypervolume_may_be_given():
    made = search(finals=None)
    front = made.run(32, progress=False)
    every = np.concatenate([goals for _, goals in made.study.full_goals()])
    good = every[nondominated(every)]
    own = front.convergence()[1]
    assert np.array_equal(front.convergence((good.min(0), good.max(0)))[1], own)
    area, before = 0.0, 100.0
    for one, other in good[np.argsort(good[:, 0])]:
        area += (100.0 - one) * (before - other)
        before = other
    # also where the best values of the box are not 0
    for best, sides in (((0.0, 0.0), 100.0 * 100.0), ((-20.0, -60.0), 120.0 * 160.0)):
        far = front.convergence((best, (100.0, 100.0)))[1]
        assert far[-1] == pytest.approx(area / sides)
    for box in (((0.0,), (1.0,)), ((1.0, 0.0), (1.0, 1.0)), (1.0, 2.0, 3.0)):
        with pytest.raises(tf.InputError, match=r"convergence\(box\)"):
            front.convergence(box)
