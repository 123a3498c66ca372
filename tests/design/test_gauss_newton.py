"""Least squares with slopes that are learnt from the designs themselves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from asking import Room, begun
from searching import Level, banned, lit, objective_of, paced

import torchfilm as tf
from design import (
    Choice,
    Conditions,
    GaussNewton,
    Measured,
    Observed,
    ObservedCourse,
    Parameter,
    Polish,
    Search,
    Sobol,
    Study,
    infer,
)
from design.methods import Bayesian, choose
from design.objective import _shared
from design.targets import Bands
from torchfilm.tools.checks import InputError

EDGES = Bands(("gfp",), (-3.0, 3.0), floor=0.5)
RATE = Parameter("rate", 0.5, 2.0, log=True)
ONE = [RATE, Parameter("make", 0.1, 10.0, log=True)]
TRUE = {"rate": 1.2, "make": 2.0}


def lines(point):
    """Ten residuals of each of which a line tells all, with their least squares at (0.3, 0.6, …),
    where they are not 0."""
    wanted = np.where(np.arange(len(point)) % 2, 0.6, 0.3)
    slopes = np.random.default_rng(1).standard_normal((10, len(point)))
    left = np.linalg.qr(slopes, mode="complete")[0][:, -1]  # no slope lowers it
    return slopes @ (point - wanted) + 0.1 * left


def curved(point):
    """As sums of exponentials have them: products and powers of the parameters."""
    time = np.linspace(0.2, 3.0, 12)
    course = lambda p: 10 ** (2 * p[0]) * (1 - np.exp(-time * 10 ** (p[1] - 0.5))) + p[2]
    return 5 * (course(point) - course(np.array([0.4, 0.7, 0.3])))


def answer(method, batch, residuals, scatter=None):
    found = np.array([residuals(p) for p in batch.points])
    if scatter is not None:
        found = found + 0.2 * scatter.standard_normal(found.shape)
    loss = np.square(found).sum(1)
    method.tell(batch, loss, residuals=found)
    return loss


def least(method, residuals, batches, scatter=None):
    return [answer(method, method.ask(), residuals, scatter).min() for _ in range(batches)]


@pytest.mark.parametrize("size", [1, 3, 8])
def test_lines_are_known_after_one_batch(size):
    method = begun(GaussNewton(), Room((None,) * size), seed=2)
    first, *later = least(method, lines, 4)
    assert first > 0.011
    # the box may stop the first step; the damping leaves less than a hundredth
    assert min(later) + 1e-12 >= 0.01 and min(later) < 0.0101


@pytest.mark.parametrize("seed", range(4))
def test_curves_are_followed_to_within_what_the_data_tell(seed):
    """Three parameters that are a standard error off make a loss of 3; sums of squares are not
    divided by the number of residuals here."""
    room = Room((None,) * 3)
    method = begun(GaussNewton(), room, seed)
    plain = begun(Sobol(batch=500), room, seed).ask().points
    assert min(np.square(curved(p)).sum() for p in plain) > 3
    assert min(least(method, curved, 30)) < 0.5  # after 244 designs


@pytest.mark.parametrize("seed", range(3))
def test_slopes_see_through_scatter(seed):
    """The scatter of a design alone has a loss of 0.4."""
    method = begun(GaussNewton(), Room((None,) * 6), seed)
    least(method, lines, 12, np.random.default_rng(seed))
    middle = method.ask().points[0]
    assert np.square(lines(middle)).sum() < 0.01 + 0.1


def test_all_points_are_within_the_bounds_and_on_the_levels():
    method = begun(GaussNewton(), Room((None, 3, None)), seed=1)
    for _ in range(12):
        batch = method.ask()
        assert batch.residuals and ((batch.points >= 0) & (batch.points <= 1)).all()
        assert np.isin(np.round(6 * batch.points[:, 1], 9), (1, 3, 5)).all()
        answer(method, batch, lambda p: p - 1.3)
    best = method._points[method._loss.argmin()]  # beyond a corner
    assert best == pytest.approx([1.0, 5 / 6, 1.0])


def test_no_design_of_levels_is_grown_twice():
    method = begun(GaussNewton(), Room((9, 9)), seed=1)
    grown = []
    for _ in range(12):
        grown += [p.tobytes() for p in method.ask().points]
        answer(method, method.ask(), lines)
    assert len(set(grown[9:])) >= len(grown[9:]) - 2  # Sobol points may be alike


def test_designs_that_fail_are_left_out():
    def half(point):
        return lines(point) if point[0] < 0.5 else np.full(10, np.nan)

    method = begun(GaussNewton(), Room((None,) * 2), seed=3)
    best = np.inf
    for k in range(8):
        batch = method.ask()
        found = np.array([half(p) for p in batch.points])
        loss = np.nan_to_num(np.square(found).sum(1), nan=1e9)
        best = min(best, loss.min())
        method.tell(batch, loss, residuals=None if k == 0 else found)  # as if all had failed
    assert best < 0.0101


def test_where_all_fail_new_sobol_designs_follow():
    method = begun(GaussNewton(first=8), Room((None,) * 2), seed=3)
    drawn = []
    for _ in range(3):
        batch = method.ask()
        drawn.append(batch.points)
        method.tell(batch, np.full(8, 1e9), residuals=None)
    whole = begun(Sobol(batch=24), Room((None,) * 2), seed=3).ask().points
    assert (np.concatenate(drawn) == whole).all()


def test_a_start_that_gains_no_more_is_left_for_another():
    def two(point):
        """Two valleys, of which the one at 0.85 is the deeper, and the narrower."""
        near = np.exp(-200 * (point[0] - 0.85) ** 2)
        return np.array([1.5 * (point[0] - 0.2), point[1] - 0.5, 0.3]) * (1 - near)

    method = begun(GaussNewton(), Room((None, None)), seed=0)
    found = np.minimum.accumulate(least(method, two, 120))
    assert method._run > 0 and found[-1] < 0.01


def test_known_designs_are_grown_again_with_the_first():
    method = begun(GaussNewton(), Room((None,) * 3), seed=0)
    known = np.array([[0.5, 0.5, 0.5], [0.1, 0.2, 0.3]])
    method.know(known, np.array([2.0, 1.0]))
    first = method.ask().points
    assert (first[:2] == known[::-1]).all()
    alone = begun(GaussNewton(), Room((None,) * 3), seed=0).ask().points
    assert (first[2:] == alone).all()
    answer(method, method.ask(), lines)
    assert len(method.ask().points) == 4


def test_a_method_that_is_told_the_same_proposes_the_same():
    one, other = (begun(GaussNewton(), Room((None,) * 3), seed=5) for _ in range(2))
    for _ in range(20):
        batch = one.ask()
        assert (other.ask().points == batch.points).all()
        answer(one, batch, curved)
        answer(other, batch, curved)


@pytest.mark.parametrize("option", [{"batch": 1}, {"batch": 2.5}, {"first": 3}])
def test_wrong_settings(option):
    with pytest.raises(InputError, match=f"GaussNewton.{next(iter(option))}"):
        GaussNewton(**option)


# the residuals of an objective


def observed(scene=paced, until=2.0, **true):
    *_, state = tf.simulate(scene(**true), until=until, dt=0.1, colonies=4, seed=9)
    return Observed.from_state(state, species=("gfp",)).without("alignment", "density")


def test_squares_of_residuals_are_the_loss():
    data = observed(**TRUE)
    task = objective_of(paced, ONE, data, until=2.0, replicates=2)
    points = np.array([[0.2, 0.3], [0.7, 0.6]])
    one = task.evaluate(points, streams=[1], residuals=True)
    assert np.square(one.residuals).sum(1) == pytest.approx(one.loss, rel=1e-12)
    both = task.evaluate(points, streams=[0, 1], residuals=True)
    other = task.evaluate(points, streams=[0], residuals=True)
    mean = 0.5 * (one.residuals + other.residuals)
    assert both.residuals == pytest.approx(mean, rel=1e-12)
    assert task.evaluate(points, streams=[0, 1]).residuals is None
    assert (task.evaluate(points, streams=[0, 1], residuals=True, work_items=2).residuals
            == both.residuals).all()  # fmt: skip


def test_the_worst_replicate_has_its_residuals():
    task = objective_of(paced, ONE, observed(**TRUE), until=2.0, replicates=3, reduce="worst")
    point = np.array([[0.4, 0.4]])
    found = task.evaluate(point, residuals=True)
    assert np.square(found.residuals).sum(1) == pytest.approx(found.loss, rel=1e-12)


def volume(state):
    return state.groups.sum(state.volume)


def test_of_conditions_each_residual_is_of_one():
    terms = [
        ({"make": make}, Measured({"v": volume, "w": volume}, {"v": 3.0, "w": 9.0}, {"v": 1.0,
          "w": 2.0})) for make in (1.0, 2.0)
    ]  # fmt: skip
    task = objective_of(paced, [RATE], Conditions(terms), until=1.0, replicates=1)
    found = task.evaluate(np.array([[0.3]]), residuals=True)
    assert found.residuals.shape == (1, 4)
    assert np.square(found.residuals).sum(1) == pytest.approx(found.loss, rel=1e-12)
    first, second = found.residuals[0, :2], found.residuals[0, 2:]
    assert (first != 0).all() and second == pytest.approx(first)  # `make` changes no volume


def test_a_design_that_fails_has_none():
    refused = [Parameter("low", 3.0, 3.8), ONE[1]]  # from 3.2 to 3.4
    task = objective_of(banned, refused, observed(banned), until=2.0, replicates=2)
    found = task.evaluate(np.array([[0.375, 0.5], [0.1, 0.5]]), residuals=True)
    assert np.isnan(found.residuals[0]).all() and np.isfinite(found.residuals[1]).all()
    assert task.evaluate(np.array([[0.375, 0.5]]), residuals=True).residuals is None


def test_replicates_without_a_share_in_the_loss_do_not_count():
    """As those that fail, where the loss is a quantile."""
    shares = np.array([[0.0, 0.5, 0.5], [1.0, 0.0, 0.0]])
    residuals = np.array([[[np.nan], [1.0], [3.0]], [[np.nan], [1.0], [3.0]]])
    found = _shared(shares, residuals)
    assert found[0] == 2.0 and np.isnan(found[1]).all()


class Untold(Level):
    comparable = True


def test_a_comparable_target_without_residuals_is_named():
    with pytest.raises(TypeError, match=r"Untold\.residuals must return .* \(4, K\)"):
        objective_of(lit, ONE[1:], Untold(), cells=4).evaluate(np.array([[0.5]]), residuals=True)


def test_patterns_have_no_residuals_to_compare():
    with pytest.raises(InputError, match=r"residuals = True .* none that compare"):
        objective_of(lit, ONE[1:], EDGES, cells=4).evaluate(np.array([[0.5]]), residuals=True)
    with pytest.raises(InputError, match="GaussNewton needs the residuals of data"):
        Search(lit, ONE[1:], EDGES, cells=4, method="gauss-newton")
    with pytest.raises(InputError, match="needs losses alone"):
        Polish(inner=GaussNewton())


# searches


def fit(data, colonies, **options):
    search = Search(paced, ONE, data, until=2.0, replicates=2, seed=3, **options)
    return search, search.run(colonies=colonies, progress=False)


def test_a_fit_of_growing_colonies_finds_their_parameters():
    search, best = fit(observed(**TRUE), 240)
    assert search.why_chosen.startswith("auto: gaussnewton(")
    assert "least squares, with slopes learnt from all designs; no exact" in search.why_chosen
    assert best.values["rate"] == pytest.approx(TRUE["rate"], rel=0.05)
    assert best.values["make"] == pytest.approx(TRUE["make"], rel=0.1)


def test_a_course_and_measures_are_fitted_so():
    times = (1.0, 2.0)
    each = [list(tf.simulate(paced(**TRUE), until=t, dt=0.1, colonies=3, seed=9))[-1]
            for t in times]  # fmt: skip
    frames = [Observed.from_state(state, species=("gfp",)) for state in each]
    _, best = fit(ObservedCourse([f.without("alignment", "density") for f in frames]), 160)
    assert best.values["make"] == pytest.approx(TRUE["make"], rel=0.15)
    # a measure that steps with numbers of cells
    wanted = {"cells": 16.0}
    count = Measured({"cells": lambda state: state.counts.double()}, wanted, {"cells": 0.5})
    _, best = fit(count, 100)
    assert best.loss < 4


def test_a_search_that_was_stopped_goes_on_with_the_same_designs(tmp_path):
    data = observed(**TRUE)
    straight, best = fit(data, 100, method=GaussNewton())
    points = lambda study: np.concatenate([e.points for e in study.entries])
    for colonies in (30, 51, 100):  # within batches, too
        stopped = Search(
            paced, ONE, data, until=2.0, replicates=2, seed=3, method=GaussNewton(), finals=None
        ).run(colonies=colonies, progress=False, study=tmp_path / "study.h5")
    whole = Search(
        paced, ONE, data, until=2.0, replicates=2, seed=3, method=GaussNewton(), finals=None
    ).run(colonies=100, progress=False)
    assert whole.values == stopped.values
    kept = Study.read(tmp_path / "study.h5")
    assert all(np.isfinite(e.residuals).all() for e in kept.entries)
    count = len(points(straight.study))
    assert (points(kept)[:count] == points(straight.study)).all() and best.values


def test_a_search_may_start_from_known_designs():
    search = Search(
        paced, ONE, observed(**TRUE), until=2.0, replicates=2, start=TRUE, method="gauss-newton"
    )
    search.run(colonies=60, progress=False)
    first, second = search.study.entries[:2]
    assert (second.points[0] == first.points[0]).all() and first.residuals is None


@pytest.mark.parametrize("count", range(60, 400, 40))
def test_auto_takes_it_for_data_without_choices_or_exact_derivatives(count):
    data = {"pattern": False, "comparable": True, "searched": 0.8 * count}
    assert isinstance(choose(5, count, 0, **data).method, GaussNewton)
    assert not isinstance(choose(5, count, 0, squares=True, **data).method, GaussNewton)
    assert isinstance(choose(5, count, 0, pattern=False).method, Bayesian)
    assert not isinstance(choose(5, count, 0, comparable=True).method, GaussNewton)


def test_auto_needs_some_designs_for_it():
    kinds = [
        isinstance(choose(5, n / 0.8, 0, pattern=False, comparable=True, searched=n).method,
                   GaussNewton)
        for n in range(5, 60)
    ]  # fmt: skip
    assert not kinds[0] and kinds[-1] and all(a <= b for a, b in pairwise(kinds))
    assert kinds.index(True) + 5 == 18 + 4


def test_a_study_goes_on_with_the_model_of_the_loss_that_it_began_with(tmp_path):
    data = observed(**TRUE)
    with_model = Search(paced, ONE, data, until=2.0, replicates=2, method=Bayesian(batch=6))
    with_model.run(colonies=60, progress=False, study=tmp_path / "study.h5")
    before = Study.read(tmp_path / "study.h5").about["method"]
    chosen = choose(2, 60, 0, pattern=False, comparable=True, before=f"auto: {before}")
    assert isinstance(chosen.method, Bayesian) and chosen.why == "the study began with it"


@pytest.mark.parametrize("whole", [False, True])
def test_choices_and_whole_numbers_are_left_to_a_model_of_the_loss(whole):
    made = lambda rate=1.0, kind=1: paced(rate, {1: 1.0, 2: 3.0}[kind])
    space = [RATE, Parameter("kind", 1, 2, whole=True) if whole else Choice("kind", [1, 2])]
    search = Search(made, space, observed(**TRUE), until=2.0, replicates=2)
    search.run(colonies=60, progress=False)
    assert "gaussnewton" not in search.why_chosen


def test_inference_is_as_it_was():
    """It grows the same task, without a method."""
    with pytest.raises(InputError, match="simulations"):
        infer(paced, ONE, observed(**TRUE), until=2.0, simulations=1)
