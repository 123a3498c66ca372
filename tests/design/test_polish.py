"""Another method first, then descents by derivatives from its best designs."""

from __future__ import annotations

import itertools
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
from asking import Room, begun
from searching import Level, lit, paced

import torchfilm as tf
from design import CMAES, NSGA2, Choice, Local, Parameter, Polish, Racing, Search, Sobol, Study
from design.methods import Bayesian, choose
from design.methods.local import unlike
from design.slopes import Slopes
from design.targets import Bands, DomainSize, Lasting
from torchfilm.tools.checks import InputError

EDGES = Bands(("gfp",), (-3.0, 3.0), floor=0.5)
TWO = [Parameter("make", 0.1, 10.0, log=True), Parameter("decay", 0.1, 5.0)]
LASTING = Lasting(EDGES, since=0.4)
ROOM = Room((None, None, None))


def bowls(point):
    """Residuals and their Jacobian: two bowls, of which the one at 0.2 is the deeper."""
    centre, floor = (0.2, 0.0) if point.mean() < 0.5 else (0.8, 0.3)
    return np.append(point - centre, floor), np.vstack([np.eye(3), np.zeros((1, 3))])


def answer(method, batch, function=bowls):
    """Tell a method the losses of its batch, and slopes where it asks for them."""
    found = [function(p) for p in batch.points]
    loss = np.array([float(r @ r) for r, _ in found])
    if batch.slopes:
        slopes = [
            np.array(x) for x in zip(*[(2 * j.T @ r, 2 * j.T @ j) for r, j in found], strict=True)
        ]
        method.tell(batch, loss, Slopes(*slopes))
    else:
        method.tell(batch, loss)
    return loss


def run(method, batches):
    out = []
    for _ in range(batches):
        batch = method.ask()
        out.append((batch, answer(method, batch)))
    return out


def test_designs_come_first_then_descents_then_the_method_goes_on():
    history = run(begun(Polish(inner=Sobol(batch=8), after=20, starts=2), ROOM), 40)
    kinds = [len(batch.points) < 8 for batch, _ in history]  # of a descent
    first, last = kinds.index(True), len(kinds) - 1 - kinds[::-1].index(True)
    assert first == 3 and all(kinds[first : last + 1]) and last < len(kinds) - 1
    points = np.concatenate([b.points for b, _ in history[:3]])
    losses = np.concatenate([x for _, x in history[:3]])
    assert (history[3][0].points == points[unlike(points, losses, 2)]).all()
    # slopes at a point, and the loss where they lead
    assert [b.slopes for b, _ in history[first : first + 4]] == [True, False, True, False]
    # the method inside sees nothing of the descents: it goes on with its own sequence
    plain = begun(Sobol(batch=8), ROOM)
    own = run(plain, len(kinds) - (last + 1 - first))
    mine = [batch for batch, kind in zip((b for b, _ in history), kinds, strict=True) if not kind]
    assert all((a.points == b.points).all() for a, (b, _) in zip(mine, own, strict=True))


def test_a_descent_ends_on_the_floor():
    history = run(begun(Polish(inner=Sobol(batch=8), after=8, starts=1), ROOM), 11)
    assert min(loss.min() for _, loss in history) < 1e-12


def test_small_colonies_count_by_their_size():
    """The first race is of 46 × ¼ + 16 + 5 × 4 colonies, 11.9 designs with 4 replicates."""
    inner = Racing(inner=CMAES(population=24, sigma=0.5))
    history = run(begun(Polish(inner=inner, after=12), ROOM, replicates=4), 6)
    assert [(len(b.points), b.size, b.replicates, b.slopes) for b, _ in history] == [
        (46, 0.25, 1, False),
        (16, 1.0, 1, False),
        (5, 1.0, None, False),
        (73, 0.25, 1, False),
        (24, 1.0, None, False),
        (3, 1.0, 1, True),
    ]


def test_descents_from_known_designs_wait_for_the_end_of_a_race():
    inner = Racing(inner=CMAES(population=24, sigma=0.5))
    method = begun(Polish(inner=inner, after=5), ROOM, replicates=1)
    method.know(np.full((2, len(ROOM.levels)), [[0.2], [0.8]]), np.array([1.0, 2.0]))
    history = run(method, 3)
    assert [(b.size, b.slopes) for b, _ in history] == [(0.25, False), (1.0, False), (1.0, True)]


def test_descents_wait_for_a_design_of_full_size():
    """The small colonies of the first race are more than `after` by themselves."""
    inner = Racing(inner=CMAES(population=24, sigma=0.5))
    history = run(begun(Polish(inner=inner, after=2), ROOM, replicates=1), 3)
    assert [(b.size, b.slopes) for b, _ in history] == [(0.25, False), (1.0, False), (1.0, True)]


def test_the_method_inside_may_descend_too():
    history = run(begun(Polish(inner=Local(starts=2, first=4), after=5, starts=1), ROOM), 24)
    sizes = [len(b.points) for b, _ in history if b.slopes]
    # two side by side, then one from the best so far
    assert sizes[0] == 2 and 1 in sizes
    assert min(loss.min() for _, loss in history) < 1e-12


def test_starts_are_not_alike():
    points = np.array([[0.1, 0.1], [0.11, 0.1], [0.9, 0.1], [0.1, 0.2]])
    assert unlike(points, np.array([0.0, 0.1, 0.3, 0.2]), 3) == [0, 3, 2]
    assert unlike(points, np.array([0.0, 0.1, 0.3, 0.2]), 2) == [0, 3]


def test_known_designs_are_starts():
    given = begun(Polish(inner=Sobol(batch=4), after=4, starts=1), ROOM)
    given.know(np.full((1, 3), 0.21), np.array([3e-4]))
    assert (run(given, 2)[1][0].points == 0.21).all()


@pytest.mark.parametrize("stop", [1, 3, 4, 7])
def test_after_a_stop_the_next_batches_have_the_same_bits(stop):
    make = lambda: Polish(inner=CMAES(population=6), after=12, starts=2)
    whole = run(begun(make(), ROOM, seed=5), 10)
    again = begun(make(), ROOM, seed=5)
    for batch, _ in whole[:stop]:
        answer(again, batch)
    for batch, _ in whole[stop:]:
        asked = again.ask()
        assert asked.slopes == batch.slopes and (asked.points == batch.points).all()
        answer(again, asked)


@pytest.mark.parametrize(
    "wrong", [{"inner": CMAES}, {"inner": 3}, {"inner": NSGA2()}, {"after": 0}, {"starts": 0}]
)
def test_what_is_not_allowed(wrong):
    with pytest.raises(InputError, match=f"Polish.{next(iter(wrong))}"):
        Polish(**wrong)


@pytest.mark.parametrize("method", [Local(), Polish()])
def test_there_is_no_slope_among_levels_alone(method):
    with pytest.raises(InputError, match="every parameter is whole or a choice"):
        method.start(Room((3, 2)), 0, 1)


def test_auto_descends_where_the_loss_is_a_sum_of_squares():
    chosen = choose(5, 500, 0, squares=True)
    assert isinstance(chosen.method, Polish) and "gradients" in chosen.why
    assert isinstance(choose(5, 500, 0).method, Racing)  # without slopes
    # too few designs for descents that come to an end
    assert isinstance(choose(30, 300, 0, squares=True).method, Racing)
    # as many descents side by side as come to an end
    assert [choose(5, n, 0, squares=True).method.starts for n in (80, 130, 400)] == [1, 2, 3]
    # a study that began by racing goes on so
    before = choose(5, 500, 0).describe()
    assert isinstance(choose(5, 500, 0, squares=True, before=before).method, Racing)
    again = choose(5, 9000, 0, squares=True, before=choose(5, 80, 0, squares=True).describe())
    assert isinstance(again.method, Polish) and again.method.starts == 1


def test_auto_races_with_a_model_where_there_is_no_slope():
    chosen = choose(5, 500, 0)
    assert isinstance(chosen.method.inner, Bayesian) and "model of the loss" in chosen.why
    # a first race costs the more designs, the fewer replicates these have
    assert isinstance(choose(5, 24, 0).method.inner, Bayesian)
    assert isinstance(choose(5, 23.9, 0).method, CMAES)
    assert isinstance(choose(5, 33, 0, replicates=2).method, CMAES)
    assert isinstance(choose(5, 34, 0, replicates=2).method.inner, Bayesian)
    # descents are for as many designs as without botorch
    assert isinstance(choose(1, 47, 0, squares=True).method, Racing)
    assert isinstance(choose(1, 48, 0, squares=True).method, Polish)
    # a model of more designs takes too long
    many = choose(5, 2000, 0)
    assert isinstance(many.method.inner, CMAES) and "botorch" not in many.why
    # a study that began without it goes on so
    assert isinstance(choose(5, 500, 0, before=many.describe()).method.inner, CMAES)


def test_auto_says_what_botorch_would_do(monkeypatch):
    monkeypatch.setattr("design.methods.auto.find_spec", lambda name: None)
    chosen = choose(5, 500, 0)
    assert isinstance(chosen.method.inner, CMAES) and "with botorch" in chosen.why
    assert "botorch" not in choose(5, 2000, 0).why  # it would not, there
    assert isinstance(choose(5, 47, 0).method, CMAES)


counted = partial(choose, chance=True, replicates=8)


def test_auto_models_the_loss_where_molecules_are_counted():
    chosen = counted(3, 200, 0)
    assert isinstance(chosen.method, Bayesian) and "one by one" in chosen.why
    # a model of more designs takes too long
    assert isinstance(counted(3, 2000, 0).method, Racing)
    # a study that began by racing goes on so
    before = counted(3, 2000, 0).describe()
    assert isinstance(counted(3, 200, 0, before=before).method, Racing)


def test_auto_models_the_loss_of_data():
    chosen = choose(4, 100, 0, pattern=False)
    assert isinstance(chosen.method, Bayesian) and "does not compare" in chosen.why
    assert isinstance(choose(4, 401, 0, pattern=False).method, CMAES)
    few = choose(4, 15.9, 0, pattern=False)  # 10 Sobol points, and then one batch of the model
    assert isinstance(few.method, CMAES) and "15 designs are fewer than 16" in few.why


def test_without_botorch_auto_races_with_all_replicates_where_molecules_are_counted(monkeypatch):
    monkeypatch.setattr("design.methods.auto.find_spec", lambda name: None)
    parameters = [Parameter("strength", 3.0, 30.0, log=True)]
    target = DomainSize(("red", "green"), 12.0)
    search = Search("toggle_switch", parameters, target, cells=4, replicates=2, finals=None)
    search.run(120, progress=False)
    assert "one by one" in search.why_chosen and "botorch" in search.why_chosen
    assert {(e.size, e.replicates) for e in search.study.entries} == {(0.25, 2), (1.0, 2)}
    assert isinstance(counted(3, 20, 0).method, CMAES)  # too few for races
    again = counted(3, 20, 0, before=counted(3, 200, 0).describe())
    assert again.method.small == 8


@pytest.mark.parametrize("options", [("counted", "smooth"), ("smooth", "counted")])
def test_one_option_that_counts_molecules_is_enough(options):
    def grown(how="counted", strength=3.0):
        made = [tf.Reaction({}, {"gfp": 1}, "strength")]
        method = "direct" if how == "counted" else "rosenbrock"
        circuit = tf.Circuit(made, species=("gfp",), method=method, strength=strength)
        return tf.Scene(tf.Growth(rate=2.0), tf.Division(length=tf.Uniform(3, 4)), circuit)

    parameters = [Choice("how", options), Parameter("strength", 1.0, 3.0)]
    search = Search(grown, parameters, Level(), cells=4, replicates=2)
    assert search.objective.task.tried.stochastic


def test_what_a_search_says_of_its_loss():
    squares = lambda *given, **more: Search(*given, replicates=1, **more).objective.least_squares
    assert squares(lit, TWO, EDGES, cells=4)
    assert not squares(lit, TWO, Level(), cells=4)  # no residuals
    assert not squares(paced, [Parameter("rate", 0.5, 2.0)], EDGES, until=1.0)  # differences
    assert not squares(lit, [Parameter("decay", 1, 4, whole=True)], EDGES, cells=4)


def test_a_search_polishes_and_resumes(tmp_path):
    make = lambda: Search(lit, TWO, EDGES, cells=8, replicates=2, finals=None)
    whole = make()
    best = whole.run(colonies=160, progress=False)
    assert whole.why_chosen.startswith("auto: polish") and "gradients" in best.table()
    assert any(e.slopes is not None for e in whole.study.entries)
    first = make()
    first.run(colonies=136, study=tmp_path / "a.h5", progress=False)
    again = make().run(colonies=160, study=tmp_path / "a.h5", progress=False)
    assert again.loss == best.loss
    kept = Study.read(tmp_path / "a.h5")
    assert [e.copies for e in kept.entries] == [e.copies for e in whole.study.entries]


if find_spec("botorch"):

    def test_a_search_resumes_without_asking_its_model_again(tmp_path, monkeypatch):
        """Also where it stopped within a race or a batch."""
        method = lambda: Polish(inner=Racing(inner=Bayesian(batch=2, first=4), first=2), after=99)
        make = lambda: Search(lit, TWO, EDGES, cells=8, replicates=2, finals=None, method=method())
        whole, chosen, choose_ = make(), [], Bayesian._choose
        monkeypatch.setattr(
            Bayesian, "_choose", lambda *given: [chosen.append(1), choose_(*given)][1]
        )
        best, counts = whole.run(colonies=46, progress=False), [len(chosen)]
        for colonies in (31, 40, 46):
            chosen.clear()
            again = make()
            found = again.run(colonies=colonies, study=tmp_path / "a.h5", progress=False)
            counts.append(len(chosen))
        assert found.loss == best.loss
        for mine, other in zip(again.study.entries, whole.study.entries, strict=True):
            assert (mine.points == other.points).all() and (mine.loss == other.loss).all()
        # a batch that was grown in part is chosen again, no other
        assert counts[0] >= 3 and sum(counts[1:]) <= counts[0] + 2, counts


@pytest.mark.parametrize("colonies, first", [(16, 64), (24, 4)])
def test_a_search_that_ends_before_its_first_descent_says_so(colonies, first, capsys):
    method = Local(first=first)
    Search(lit, TWO, LASTING, cells=8, replicates=2, method=method, finals=None).run(colonies)
    words = f"ended before its first descent: the {first} Sobol designs"
    assert (words in capsys.readouterr().err) == (first == 64)


def test_a_search_that_found_what_was_wanted_says_nothing_of_descents(capsys):
    search = Search(lit, TWO, LASTING, cells=8, replicates=2, method=Local(), finals=None)
    search.run(400, stop_at=1e8)
    assert "first descent" not in capsys.readouterr().err


def test_auto_descends_in_fits_of_few_designs():
    """Half a descent comes further than a model of so few designs, which left a fit of four
    constants by 60 designs at losses of 70 to 240, and this one at 1e-8."""
    fit = partial(choose, pattern=False, squares=True, replicates=1)
    of = lambda chosen: (chosen.method.after, chosen.method.starts)
    assert of(fit(4, 60, 0, searched=48)) == (8, 1)
    assert of(fit(4, 28, 0, searched=22)) == (8, 1)
    assert isinstance(fit(4, 27, 0, searched=22).method, Bayesian)
    assert of(fit(4, 80, 0, searched=64)) == (24, 1)
    assert of(fit(4, 400, 0, searched=320)) == (24, 3)
    # a study that began so goes on so
    begun = fit(4, 60, 0, searched=48).describe()
    assert of(fit(4, 400, 0, searched=320, before=begun)) == (8, 1)
    assert not isinstance(fit(4, 60, 0, squares=False, searched=48).method, Polish)


def test_descents_begin_again_from_designs_unlike_all_starts():
    method = begun(Polish(inner=Sobol(batch=8), after=16, starts=2, again=True), ROOM)
    history = run(method, 80)
    descending = [len(batch.points) < 8 for batch, _ in history]
    assert descending[:3] == [False, False, True]
    begins = [k for k in range(1, len(history)) if descending[k] and not descending[k - 1]]
    assert len(begins) >= 2
    starts = np.concatenate([history[k][0].points for k in begins])
    apart = np.abs(starts[:, None] - starts).max(2) + np.eye(len(starts))
    assert apart.min() >= 0.05
    # after as many more designs each time
    for one, other in itertools.pairwise(begins):
        assert sum(not d for d in descending[one:other]) == 2
    once = run(begun(Polish(inner=Sobol(batch=8), after=16, starts=2), ROOM), 80)
    assert sum(len(b.points) == 8 for b, _ in once) > sum(not d for d in descending)


def test_each_combination_of_few_options_has_a_descent():
    """The best designs have one option; the floor is that of the other."""

    def function(point):
        right = point[2] >= 0.5
        centre = 0.3 if right else 0.6
        slope = 1.0 if right else 0.01
        residuals = np.append(slope * (point[:2] - centre), 0.0 if right else 0.01)
        return residuals, np.vstack([slope * np.eye(2, 3), np.zeros((1, 3))])

    room = Room((None, None, 2))
    made = Polish(inner=Sobol(batch=8), after=8, starts=1, again=True)
    method, found = begun(made, room), []
    for _ in range(40):
        batch = method.ask()
        found.append((batch, answer(method, batch, function)))
    first = next(b for b, _ in found if b.slopes)
    assert (first.points[:, 2] < 0.5).all()
    assert min(loss.min() for _, loss in found) < 1e-12
    # with more combinations than a few, descents begin at the best alone
    made = Polish(inner=Sobol(batch=8), after=8, starts=1, again=True)
    many = begun(made, Room((None, None, 7)))
    for _ in range(2):
        batch = many.ask()
        answer(many, batch, function)
    assert len(many._local._waiting) == 0
