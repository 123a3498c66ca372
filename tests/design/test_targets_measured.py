"""The target for measures of one's own."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from searching import lit

import torchfilm as tf
from design import Local, Measured, ObservedCourse, Parameter, Search, Sobol, Task, Weighted
from design.objective import Objective
from design.saved_design import load_design
from design.targets.base import huber


def longest(state: tf.State) -> torch.Tensor:
    return state.groups.max(state.length)


def spread_out(state: tf.State) -> torch.Tensor:
    return state.counts / state.groups.sum(state.length) - 0.25


def undefined(state: tf.State) -> torch.Tensor:
    return torch.where(state.counts > 1, torch.nan, 1.0)


def colonies(lengths, owner) -> tf.State:
    count = len(lengths)
    places = [[20.0 * k, 0.0] for k in range(count)]
    cells = tf.Cells(places, [[1.0, 0.0]] * count, lengths, colony=owner)
    return tf.Scene(tf.Growth(rate=1.0), founders=cells).bind().start()


def test_the_loss_by_hand():
    target = Measured(
        {"longest": longest, "rest": spread_out}, {"longest": 3.0, "rest": (0.0, 0.25)},
        {"longest": 0.5, "rest": 0.1},
    )  # fmt: skip
    state = colonies([2.0, 4.0, 1.0], [0, 0, 1])
    # 4 where 3 is wanted, and 2/6 − 1/4; 1 where 3 is wanted, and 1/1 − 1/4
    wanted = [(2.0**2 + 0.0) / 2, (4.0**2 + 5.0**2) / 2]
    assert target.loss(state).tolist() == pytest.approx(wanted)
    assert target.residuals(state).square().sum(1).tolist() == pytest.approx(wanted)
    assert target.measures(state)["longest"].tolist() == [4.0, 1.0]
    assert target.describe() == "longest = 3, rest 0 to 0.25"
    for k in range(2):
        assert float(target.loss(state.select([k]))) == pytest.approx(wanted[k])


def test_open_ranges_and_the_farthest():
    state = colonies([2.0], [0])
    endless = Measured({"it": lambda s: s.counts / 0.0}, {"it": (0.0, math.inf)}, {"it": 1.0})
    assert endless.loss(state).tolist() == [0.0]
    most = 1e4 * (2e3 - 1)  # 100,000 spreads
    for wanted, loss in (
        ((1.0, math.inf), 0.0), ((-math.inf, 1.0), 100.0), (12.0, 1e4), (1e9, most), (-1e30, most),
    ):  # fmt: skip
        target = Measured({"longest": longest}, {"longest": wanted}, {"longest": 0.1})
        assert target.loss(state).tolist() == pytest.approx([loss])
        assert loss < target.failed / 40


def test_far_from_the_data_residuals_are_hubers():
    """Their value and slope are whole at 100 spreads, and beyond it the square is linear."""
    apart = torch.tensor([-300.0, -100.0, -1.0, 0.0, 99.9, 100.0, 100.1, 5e3], dtype=torch.float64)
    apart.requires_grad_()
    square = huber(apart).square()
    (slope,) = torch.autograd.grad(square.sum(), apart)
    inside = apart.detach().abs() <= 100
    assert torch.equal(square[inside], apart[inside] ** 2)
    linear = 1e4 * (2 * apart.abs() / 100 - 1)
    assert torch.allclose(square[~inside], linear[~inside], rtol=1e-14)
    assert slope.tolist() == pytest.approx([-200.0, -200.0, -2.0, 0.0, 199.8, 200.0, 200.0, 200.0])
    assert bool(huber(torch.tensor([math.nan])).isnan())


def test_a_measure_that_is_no_number_fails_its_colony():
    target = Measured({"it": undefined}, {"it": 1.0}, {"it": 1.0})
    state = colonies([2.0, 2.0, 2.0], [0, 0, 1])
    assert target.unfit(state) == ["it is not a number", ""]
    assert target.loss(state).tolist() == [target.failed, 0.0]


def grown(rate=1.0, noise=0.0) -> tf.Scene:
    return tf.Scene(tf.Growth(rate=rate), dim=2)


OF_TASK = {"until": 0.5, "dt": 0.05, "replicates": 1}


def parameters() -> list[Parameter]:
    return [Parameter("rate", 0.1, 2.0)]


def task(target) -> Task:
    return Task(grown, parameters(), target, **OF_TASK)


def test_a_search_finds_it():
    """A cell of 2 µm that grows by its volume, l + 4r/3 = 2.67, to a length of 4.0 in 0.5 h."""
    target = Measured({"longest": longest}, {"longest": 4.0}, {"longest": 0.05})
    rate = math.log((4.0 + 2 / 3) / (2.0 + 2 / 3)) / 0.5
    search = Search(grown, parameters(), target, **OF_TASK, method=Local(first=16), finals=None)
    best = search.run(colonies=100)
    assert best.values["rate"] == pytest.approx(rate, rel=0.01)
    both, state = Weighted([(target, 1.0), (target, 2.0)]), colonies([3.9], [0])
    assert float(both.loss(state)) == pytest.approx(3.0 * float(target.loss(state)), rel=1e-6)


def test_a_saved_design_asks_for_it_again(tmp_path):
    target = Measured({"longest": longest}, {"longest": 4.0}, {"longest": 0.05})
    best = Search(grown, parameters(), target, **OF_TASK, method=Sobol(batch=4)).run(colonies=8)
    best.save(tmp_path / "best.json")
    with pytest.raises(tf.InputError, match=r"give load_design\(…, target=…\)"):
        load_design(tmp_path / "best.json", scene=grown).colonies()
    again = load_design(tmp_path / "best.json", scene=grown, target=target)
    assert len(again.colonies()) == 1


@pytest.mark.parametrize(
    "made, words",
    [
        (lambda: Measured({}, {}, {}), "a dict of functions by name"),
        (
            lambda: Measured({"a b": longest}, {"a b": 1}, {"a b": 1}),
            "names of letters, digits and underscores, such as",
        ),
        (lambda: Measured({"a": 3}, {"a": 1}, {"a": 1}), r"functions\['a'\] = 3"),
        (lambda: Measured({"a": longest}, {"b": 1}, {"a": 1}), "wanted .* the names 'a'"),
        (lambda: Measured({"a": longest}, {"a": 1}, 0.1), "spread .* the names 'a'"),
        (lambda: Measured({"a": longest}, {"a": (2, 1)}, {"a": 1}), r"range \(low, high\)"),
        (lambda: Measured({"a": longest}, {"a": math.nan}, {"a": 1}), r"wanted\['a'\] = nan"),
        (lambda: Measured({"a": longest}, {"a": 1}, {"a": 0}), r"spread\['a'\] = 0"),
        (
            lambda: task(Measured({"a": lambda s: s.length[:0]}, {"a": 1}, {"a": 1})),
            r"functions\['a'\] gave a tensor of shape \(0,\)",
        ),
        (
            lambda: task(Measured({"a": lambda s: 2.0}, {"a": 1}, {"a": 1})),
            r"functions\['a'\] gave 2.0: it must give",
        ),
    ],
)
def test_bad_input(made, words):
    with pytest.raises(tf.InputError, match=words):
        made()


def dying(k=1.0) -> tf.Scene:
    def update(cells):
        cells.remove_flag = cells.chance(1 - torch.exp(-cells.p.k * cells.dt))

    return tf.Scene(
        tf.Growth(rate=2.0), tf.Division(length=4.0), tf.Rules(update, parameters={"k": k}),
        founders=partial(draw, 20), dim=2, dt=0.1,
    )  # fmt: skip


def draw(count, seed):
    return tf.inoculum(count, 20.0, seed=seed)


@pytest.mark.filterwarnings("ignore:a colony without cells is as it is wanted")
@pytest.mark.parametrize("end", [{"until": 1.0}, {"cells": 30, "until": 1.0}, {"cells": 30}])
@pytest.mark.parametrize("extinct", [False, True])
def test_colonies_in_which_all_have_died(extinct, end):
    """They have failed, or are measured as they are, whatever the others of the batch do."""
    target = Measured(
        {"left": lambda state: state.counts.double()}, {"left": 0.0}, {"left": 5.0}, extinct=extinct
    )
    objective = Objective(
        Task(dying, [Parameter("k", 0.1, 20.0)], target, replicates=3, seed=2, **end)
    )
    found = objective.evaluate(np.array([[1.0], [0.0]]))
    fast = [[0.0] * 3] if extinct else [[target.failed] * 3]
    assert found.losses[:1].tolist() == fast and (found.losses[1] < 1e3).all()
    assert len(found.reasons) == (0 if extinct else 3)
    alone = objective.evaluate(np.array([[1.0]]))
    assert np.array_equal(alone.losses, found.losses[:1])
    ends = [part.state.counts.sum() for part in objective.colonies(np.array([1.0]))]
    assert sum(map(int, ends)) == 0 and bool(ends) == extinct


def test_a_number_for_each_cell_is_no_failed_design():
    """Founders are one cell a colony: what is wrong shows later, and ends the search."""
    target = Measured({"level": lambda state: state.gfp}, {"level": 1.0}, {"level": 1.0})
    search = Search(lit, [Parameter("make", 0.1, 10.0)], target, cells=6, replicates=2)
    with pytest.raises(TypeError, match=r"functions\['level'\] gave .*one number for each colony"):
        search.run(colonies=8, progress=False)


def _averaged(state):
    return state.groups.sum(state.g) / state.counts


def _brightest(state):
    return state.groups.max(state.g)


def _through_numbers(state):
    return torch.tensor([float(x.mean()) for x in state.g.split(state.counts.tolist())])


def _through_numpy(state):
    means = [x.numpy().mean() for x in state.g.split(state.counts.tolist())]
    return torch.tensor(np.array(means))


def _cells(state):
    return state.counts.double()  # which no circuit changes


def _bright_cells(state):
    return state.groups.sum((state.g > 0.3).double())


@pytest.mark.parametrize("course", [False, True])
@pytest.mark.parametrize(
    ("measure", "lacking"),
    [
        (_averaged, False), (_brightest, False), (_through_numbers, True),
        (_through_numpy, True), (_cells, False), (_bright_cells, True),
    ],
)  # fmt: skip
def test_smooth_measures_that_pass_no_gradient_are_found_out(measure, lacking, course):
    """They had slopes of 0, in silence. Then derivatives are differences, and say so."""
    options = {"times": [0.1, 0.3], "values": {"m": [0.1, 0.3]}, "spread": {"m": 0.1}}
    target = (
        ObservedCourse.of_measures({"m": measure}, smooth=True, **options) if course
        else Measured({"m": measure}, {"m": 0.3}, {"m": 0.1}, smooth=True)
    )  # fmt: skip

    def colony(make=1.0):
        circuit = tf.Circuit(lambda u, s, p, c: {"g": p.make - u.g}, species="g", make=make)
        return tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.0), circuit, dim=2, dt=0.1)

    task = Task(
        colony, [Parameter("make", 0.1, 10.0)], target, until=0.3, replicates=1, seed=0,
        dtype=torch.float64,
    )  # fmt: skip
    assert bool(task.why_rough) == lacking
    if lacking:
        assert "no gradient passes through 'm' of Measured" in task.why_rough


def raw(state: tf.State) -> torch.Tensor:
    levels = state.gain * state.gfp + state.back
    return state.groups.sum(state.volume * levels) / state.groups.sum(state.volume)


def od(state: tf.State) -> torch.Tensor:
    return torch.log10(state.groups.sum(state.volume))


def lit_cells(state: tf.State) -> torch.Tensor:
    return state.groups.sum((state.gfp > 0.5).double())


def bright_cells(state: tf.State) -> torch.Tensor:
    return state.groups.sum((state.gfp > 2e4).double())


def nearby(state: tf.State) -> torch.Tensor:
    """Without a number in a colony of one cell, whatever its levels."""
    return torch.where(state.counts > 1, od(state), torch.nan)


def refuses(state: tf.State) -> torch.Tensor:
    if float(state.gfp.max()) > 1.0:
        raise ValueError("too bright")
    return od(state).detach()


def reporter(gain=100.0, back=50.0) -> tf.Scene:
    rates = lambda u, s, p, cell: {"gfp": 8.0 - 0.4 * u.gfp}
    circuit = tf.Circuit(
        rates, species=("gfp", "gain", "back"), initial={"gain": gain, "back": back},
        dilution=("gfp",),
    )  # fmt: skip
    return tf.Scene(
        tf.Growth(rate=0.7), tf.Division(length=4.0, conserves="volume"), circuit, dim=2, dt=0.1
    )


@pytest.mark.parametrize(
    "beside, fits",
    [(od, True), (lit_cells, False), (bright_cells, False), (nearby, None), (refuses, False)],
)
def test_a_measure_of_sizes_alone_leaves_the_others_their_least_squares(beside, fits):
    """With an optical density beside fluorescence, a search had no derivatives, and found a
    background of 67 or 25 for 80."""
    *_, truth = tf.simulate(reporter(150.0, 80.0), until=1.0, dtype=torch.float64)
    *_, half = tf.simulate(reporter(150.0, 80.0), until=0.5, dtype=torch.float64)
    functions = {"raw": raw, "beside": beside}
    seen = lambda f, s: 0.0 if f is refuses else float(f(s).nan_to_num())
    values = {n: [seen(f, s) for s in (half, truth)] for n, f in functions.items()}
    course = ObservedCourse.of_measures(
        functions, times=(0.5, 1.0), values=values, spread={"raw": 1.0, "beside": 0.01}, smooth=True
    )
    space = [Parameter("gain", 10.0, 1000.0, log=True), Parameter("back", 1.0, 500.0, log=True)]
    search = Search(reporter, space, course, replicates=1, dtype=torch.float64)
    if fits is not True:
        why = "" if fits is None else "no gradient passes through 'beside' of Measured"
        assert search.objective.why_no_squares == why
        return
    best = search.run(colonies=60, progress=False)
    assert best.values["gain"] == pytest.approx(150.0, rel=1e-3)
    assert best.values["back"] == pytest.approx(80.0, rel=1e-3)
