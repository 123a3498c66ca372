"""The best designs are tested on fresh seeds, and the best of these is returned."""

from __future__ import annotations

import contextlib
import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy import stats
from searching import lit, mean

import torchfilm as tf
from design import Finals, Measured, Parameter, Search, Sobol, Study, Target
from design.entries import Entry
from design.finals import CHECK_STREAM, FIRST_STREAM, is_certain, winner
from design.loss_bands import HOLDS, LEAST, loss_band, seeds_of_an_end

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]


@dataclasses.dataclass(frozen=True)
class Lucky(Target):
    """The distance of the mean level from 1; but on the seeds of the search a few dark designs look
    perfect."""

    names = ("gfp",)
    most: float = 0.32

    def loss(self, state, history=None):
        honest = (mean(state, "gfp") - 1.0).abs()
        level, own = mean(state, "gfp"), state.stream < FIRST_STREAM
        lucky = own & (level > 0.3) & (level < self.most)
        return honest.where(~lucky, 0.0 * honest)


def search(target=None, **options):
    options = {"method": Sobol(batch=8), "cells": 3, "replicates": 2, **options}
    return Search(lit, LIT, target or Lucky(), **options)


@pytest.mark.parametrize(
    "share, most, budget, expected",
    [
        (0.2, 8, 3000, [(8, 16), (4, 48), (2, 112)]),
        (0.2, 8, 1200, [(8, 6), (4, 18), (2, 42)]),
        (0.2, 8, 300, [(4, 5), (2, 15)]),
        (0.2, 8, 90, [(2, 6)]),
        (0.2, 8, 20, [(1, 4)]),
        (0.2, 8, 19, []),
        (0.5, 1, 100, [(1, 50)]),
    ],
)
def test_rounds_halve_the_finalists_and_double_their_seeds(share, most, budget, expected):
    finals = Finals(share=share, most=most)
    assert finals.rounds(budget) == expected
    cost = finals.colonies(budget)
    assert cost <= share * budget
    seeds = [0, *(s for _, s in expected)]
    rounds = sum(c * (now - then) for (c, now), then in zip(expected, seeds[:-1], strict=True))
    checked = finals.check_seeds(budget)
    assert cost == rounds + checked
    several = any(c > 1 for c, _ in expected)
    assert checked == (round(share * budget) // 3 if several else 0)
    assert Finals(share=share, most=most, sizes=(0.5, 1.5)).rounds(2 * budget) == expected


def test_a_design_that_is_lucky_on_the_seeds_of_the_search_does_not_win():
    made = search()
    best = made.run(400, progress=False)
    point, loss, _ = made.study.best()
    assert loss == 0.0 and not np.array_equal(best.point, point)
    assert best.searched_loss > 0 and best.loss < 0.2 and best.fresh is not None
    # the loss is that of the same design on seeds that did not choose it
    streams = range(CHECK_STREAM, CHECK_STREAM + len(best.losses))
    found = made.objective.evaluate(best.point[None], streams=streams)
    assert np.array_equal(found.losses[0], best.losses) and best.loss == found.losses[0].mean()
    low, high = best.band
    assert low < best.loss < high
    assert "loss on fresh seeds" in best.table() and f"{len(best.losses)} seeds" in best.table()


def test_the_table_says_where_the_seeds_of_a_search_misled_it():
    best = search(Lucky(most=100.0)).run(60, progress=False)
    assert "the 2 seeds of the search were lucky: 0.0000 there" in best.table()
    assert "more replicates" in best.table()
    assert "lucky" not in search(Lucky(most=0.0)).run(60, progress=False).table()


def test_the_budget_holds_the_finals_too():
    made = search()
    made.run(100, progress=False)
    reserved = made.finals.colonies(100)
    assert 0 < reserved == sum(e.colonies for e in made.study.finals)
    assert 100 - 2 < made.study.colonies <= 100
    assert all(s >= FIRST_STREAM for e in made.study.finals for s in e.streams)
    none = search(finals=None)
    none.run(100, progress=False)
    assert none.study.colonies == 100 and not none.study.finals and none.best().band is None


def test_a_stopped_final_goes_on_where_it_was(tmp_path, monkeypatch):
    whole = search()
    expected = whole.run(300, progress=False)
    path, add = tmp_path / "s.h5", Study.add_final
    for _ in whole.study.finals:
        calls = iter(range(10))

        def stop(self, entry, calls=calls):
            if next(calls):
                raise KeyboardInterrupt
            add(self, entry)

        monkeypatch.setattr(Study, "add_final", stop)
        with contextlib.suppress(KeyboardInterrupt):
            search().run(300, study=path, progress=False)
        monkeypatch.undo()
    kept = Study.read(path)
    assert kept.colonies == whole.study.colonies
    for one, other in zip(kept.finals, whole.study.finals, strict=True):
        assert one.streams == other.streams and one.size == other.size
        assert np.array_equal(one.points, other.points)
        assert np.array_equal(one.losses, other.losses)
    last = search()
    best = last.run(300, study=path, progress=False)
    assert best.values == expected.values and best.band == expected.band


def test_a_seed_counts_with_the_worst_of_its_sizes():
    made = search(finals=Finals(sizes=(1.0, 2.0)))
    best = made.run(300, progress=False)
    streams = range(CHECK_STREAM, CHECK_STREAM + len(best.losses))
    both = [
        type(made.objective)(made.objective.task.resized(size)).evaluate(
            best.point[None], streams=streams
        )
        for size in (1.0, 2.0)
    ]
    assert np.array_equal(best.losses, np.maximum(both[0].losses, both[1].losses)[0])
    assert (both[1].cells >= 6).all()
    assert {e.size for e in made.study.finals} == {1.0, 2.0}


def test_a_search_stops_early_only_where_fresh_seeds_hold_the_loss():
    made = search(Lucky(most=0.6))
    best = made.run(2000, stop_at=0.15, progress=False)
    assert made.study.colonies < 1000 and best.band[1] <= 0.15
    assert len(best.losses) == HOLDS[-1]
    # the lucky designs were tested on a few seeds first
    tested = {e.points[0].tobytes() for e in made.study.finals}
    assert len(tested) > 1
    again = search(Lucky(most=0.6))
    again.run(2000, stop_at=1e-6, progress=False)
    assert again.study.colonies > 1900


@dataclasses.dataclass(frozen=True)
class Chance(Target):
    """The loss is chance alone, between 0 and 1: of the design's level and the seed."""

    names = ("gfp",)

    def loss(self, state, history=None):
        # of three digits, so that no last bit of a level counts
        level = (1e3 * mean(state, "gfp").double()).round()
        return (torch.sin(12.9898 * level + 78.233 * state.stream) * 43758.5453).remainder(1.0)


def test_the_luck_of_the_finals_is_not_in_the_band():
    """All designs are alike, with a mean loss of 0.5. The best of the finals seems better by its
    seeds; on those of the check it does not."""
    options = {"cells": 2, "method": Sobol(batch=16), "finals": Finals(share=0.5)}
    found = []
    for seed in range(40):
        made = search(Chance(), seed=seed, **options)
        best = made.run(90, progress=False)
        chosen = [e.losses[k] for e in made.study.finals if e.streams[0] < CHECK_STREAM
                  for k in np.flatnonzero((e.points == best.point).all(1))]  # fmt: skip
        found.append(
            (best.band[0] <= 0.5 <= best.band[1], best.loss, np.concatenate(chosen).mean())
        )
    inside, loss, by_choice = np.array(found, dtype=float).T
    assert inside.sum() >= 31  # of 40 at 90 %, fewer by chance in 1 of 400
    error = loss.std(ddof=1) / np.sqrt(len(loss))
    assert abs(loss.mean() - 0.5) < 4 * error
    assert by_choice.mean() < 0.5 - 2 * by_choice.std(ddof=1) / np.sqrt(len(loss))


def test_a_search_that_goes_on_checks_its_winner_again(tmp_path):
    """The rounds leave room for the check, also where an earlier run has spent a part."""
    for seed in range(6):
        options = {"cells": 2, "method": Sobol(batch=16), "seed": seed}
        path = tmp_path / f"{seed}.h5"
        for budget in (100, 150, 200):
            best = search(Chance(), **options).run(budget, study=path, progress=False)
            assert not best.fresh.chosen and len(best.losses) >= LEAST
            assert "which chose it" not in best.table()


def test_a_band_by_which_a_design_was_chosen_is_told():
    made = search(Chance(), cells=2, method=Sobol(batch=16))
    best = made.run(100, progress=False)
    made.study.finals[:] = [e for e in made.study.finals if e.streams[0] < CHECK_STREAM]
    chosen = made.best()
    assert chosen.fresh.chosen and "seeds, which chose it" in chosen.table()
    assert np.array_equal(chosen.point, best.point) and not best.fresh.chosen


def test_the_band_of_a_mean_is_that_of_student():
    losses = np.array([0.1, 0.4, 0.2, 0.7, 0.3])
    wanted = stats.t.interval(0.9, 4, losses.mean(), losses.std(ddof=1) / np.sqrt(5))
    assert loss_band(search().objective.task, losses) == pytest.approx(wanted)


@pytest.mark.parametrize("quantile", [0.25, 0.5, 0.75, 0.9])
@pytest.mark.parametrize("seeds", [4, 8, 16, 24, 40])
def test_the_band_of_a_quantile_holds_for_skewed_losses(quantile, seeds):
    task, random = search(reduce=quantile).objective.task, np.random.default_rng(0)
    truth = stats.lognorm.ppf(quantile, 1.0)
    bands = np.array([loss_band(task, random.lognormal(size=seeds)) for _ in range(1000)])
    within = ((bands[:, 0] <= truth) & (truth <= bands[:, 1])).mean()
    assert within >= 0.9 - 3 * np.sqrt(0.9 * 0.1 / 1000)
    # each end is missed by at most one in twenty
    for missed in (bands[:, 1] < truth, bands[:, 0] > truth):
        assert missed.mean() <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 1000)
    assert np.isinf(bands[:, 1]).all() == (seeds < seeds_of_an_end(task))
    assert np.isfinite(bands[:, 1]).all() == (seeds >= seeds_of_an_end(task))


def test_the_table_says_how_many_seeds_set_an_end_to_a_quantile():
    least = {q: seeds_of_an_end(search(reduce=q).objective.task) for q in (0.5, 0.75, 0.9)}
    assert least == {0.5: 5, 0.75: 11, 0.9: 29}
    assert seeds_of_an_end(search().objective.task) == 1
    best = search(reduce=0.9).run(200, progress=False)
    assert math.isinf(best.band[1]) and len(best.losses) < 29
    assert f"∞, {len(best.losses)} seeds; an upper end takes 29" in best.table()


def test_seeds_that_a_wanted_loss_was_held_on_have_chosen_the_design():
    made = search(Lucky(most=0.0))
    best = made.run(3000, stop_at=0.15, progress=False)
    assert len(best.losses) == HOLDS[1] and best.fresh.chosen
    assert "24 seeds, which chose it" in best.table()


@pytest.mark.parametrize("reduce", ["worst", 0.75])
def test_bands_of_quantiles(reduce):
    best = search(reduce=reduce).run(400, progress=False)
    low, high = best.band
    assert low <= best.loss <= high <= best.losses.max()
    seeds = len(best.losses)
    words = f"the worst of {seeds} seeds; 1 new seed in {seeds + 1} is worse"
    for shown in (best.table(), best._repr_html_()):
        assert (words in shown) == (reduce == "worst")


def study_of(task, losses):
    """A study whose design k has these losses on the first fresh seeds."""
    points = np.linspace(0.1, 0.9, len(losses))
    entries = [
        Entry(
            points=np.full((1, 2), point), loss=own[None].mean(1), losses=own[None],
            cells=np.ones((1, len(own)), int), reasons={}, size=1.0, seconds=0.0, values=[{}],
            streams=tuple(range(FIRST_STREAM, FIRST_STREAM + len(own))),
        )
        for point, own in zip(points, losses, strict=True)
    ]  # fmt: skip
    return Study({}, task.space.names, (0, 1), finals=entries), points


@pytest.mark.parametrize("reduce", ["worst", 0.75])
def test_the_worst_of_few_seeds_does_not_win(reduce):
    """All designs are alike; those that drop out have the greater loss on the seeds of all."""
    task, random = search(reduce=reduce).objective.task, np.random.default_rng(0)
    for _ in range(20):
        long = random.random((8, 28))
        best = sorted(long, key=lambda x: task.reduced(x[None, :4])[0])
        study, points = study_of(task, [x[: 28 if k < 2 else 4] for k, x in enumerate(best)])
        assert winner(task, study, (1.0,))[0] in points[:2]


def test_a_design_that_always_fails_does_not_win():
    """The band of the other ends above the loss of a failure."""
    task = search().objective.task
    study, points = study_of(
        task, [np.full(4, Target.failed), np.array([0.1, *[Target.failed] * 3])]
    )
    assert winner(task, study, (1.0,))[0] == points[1]


def test_a_search_that_goes_on_tests_what_it_had_found(tmp_path):
    search(Lucky(most=0.0)).run(300, study=tmp_path / "s.h5", progress=False)
    made = search(Lucky(most=0.0))
    best = made.run(3000, study=tmp_path / "s.h5", stop_at=0.15, progress=False)
    assert made.study.searched < 300 < made.study.colonies + HOLDS[-1] and best.band[1] <= 0.15


def test_one_design_comes_before_the_finals():
    made = search(replicates=20)
    assert made.run(20, progress=False).band is None and made.study.colonies == 20


@pytest.mark.parametrize(
    "given, words",
    [
        ({"share": 0.0}, "Finals.share = 0.0"),
        ({"share": 1.0}, "Finals.share = 1.0"),
        ({"most": 0}, "Finals.most = 0.*whole number from 1"),
        ({"sizes": ()}, "Finals.sizes"),
        ({"sizes": (1.0, 1.0)}, "Finals.sizes.*different shares"),
        ({"sizes": (0.0, 1.0)}, "Finals.sizes.*different shares"),
    ],
)
def test_bad_finals_are_refused(given, words):
    with pytest.raises(tf.InputError, match=words):
        Finals(**given)


def test_finals_of_another_kind_are_refused():
    with pytest.raises(tf.InputError, match=r"finals = 0.2.*Finals\(…\) or None"):
        search(finals=0.2)


def test_few_seeds_are_no_band():
    made = search(finals=Finals(share=0.2, most=1))
    assert made.run(18, progress=False).band is None  # fewer than LEAST seeds fit
    assert len(made.run(40, progress=False).losses) >= LEAST


def test_a_search_that_goes_on_leaves_new_designs_their_finals(tmp_path):
    """What earlier finals took is not taken from the new ones, also where the last batch of the
    search was cut."""
    for batch in (8, 500):
        path, options = tmp_path / f"{batch}.h5", {"method": Sobol(batch=batch)}
        search(**options).run(200, study=path, progress=False)
        before = Study.read(path).finals
        made = search(**options)
        made.run(400, study=path, progress=False)
        known = {p.tobytes() for e in before for p in e.points}
        new = made.study.finals[len(before) :]
        fresh = {p.tobytes() for e in new for p in e.points} - known
        # of batches of 8, the last may leave some
        assert fresh and made.study.colonies <= 400
        assert sum(e.colonies for e in new) > made.finals.colonies(400) / 2
        searched = 400 - made.finals.colonies(400) - sum(e.colonies for e in before)
        assert searched - 16 < made.study.searched <= searched


def constant(make=1.0) -> tf.Scene:
    """One cell without noise."""
    rates = lambda u, s, p, cell: {"gfp": p.make - u.gfp}
    one = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
    return tf.Scene(tf.Circuit(rates, species="gfp", make=make), dim=2, dt=0.1, founders=one)


MAKE = [Parameter("make", 0.1, 10, log=True)]


def fit(level=lambda state: state.groups.sum(state.gfp), replicates=1, **options) -> Search:
    options = {"smooth": True, "time": 1.0, **options}
    target = Measured({"gfp": level}, wanted={"gfp": 1.5}, spread={"gfp": 0.1}, **options)
    return Search(constant, MAKE, target, replicates=replicates)


def test_where_seeds_make_no_difference_finals_are_short():
    """A fit of one cell without noise: two designs on two fresh seeds show it."""
    made = fit()
    best = made.run(200, progress=False)
    assert is_certain(made.objective.task, made.study)
    assert sum(e.colonies for e in made.study.finals) == 2 * 2 + LEAST
    assert made.study.searched > 200 - 2 * 2 - LEAST - 24 and best.loss < 1e-6
    assert best.fresh is not None and len(best.losses) == LEAST
    # nothing is sounded where little could be saved
    small = fit()
    small.run(24, progress=False)
    assert not small.study.finals or small.study.finals[0].streams[0] < CHECK_STREAM


@pytest.mark.parametrize(
    "level",
    [
        lambda state: state.groups.sum(state.gfp) + 1e-3 * (state.stream % 7),
        # where it is high, as it is wanted
        lambda state: (
            state.groups.sum(state.gfp)
            * (1 + 1e-3 * (state.stream % 7) * (state.groups.sum(state.gfp) > 1.0))
        ),
    ],
)
@pytest.mark.parametrize("replicates", [1, 3])
def test_where_seeds_matter_finals_are_long(level, replicates):
    made = fit(level, replicates)
    made.run(200 * replicates, progress=False)
    assert not is_certain(made.objective.task, made.study)
    assert sum(e.colonies for e in made.study.finals) >= 30


@pytest.mark.parametrize("smooth", [True, False])
def test_finals_that_are_stopped_end_as_others_where_seeds_make_no_difference(
    tmp_path, monkeypatch, smooth
):
    whole = fit(smooth=smooth)
    best = whole.run(200, progress=False)
    path, add = tmp_path / "s.h5", Study.add_final

    def stop(self, entry):
        add(self, entry)
        raise KeyboardInterrupt

    monkeypatch.setattr(Study, "add_final", stop)
    for _ in range(len(whole.study.finals)):
        with contextlib.suppress(KeyboardInterrupt):
            fit(smooth=smooth).run(200, study=path, progress=False)
    monkeypatch.undo()
    again = fit(smooth=smooth)
    assert again.run(200, study=path, progress=False).values == best.values
    assert len(again.study.entries) == len(whole.study.entries)
    assert again.study.colonies == whole.study.colonies
