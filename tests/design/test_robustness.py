"""The robustness check, where the result is known: fresh seeds, other sizes, changed parameters,
and the parameters that matter."""

from __future__ import annotations

import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from searching import Level, built, fragile, lit, mean, objective_of

import torchfilm as tf
from design import Best, Choice, Parameter, Search, Target, check_robustness
from design.sensitivity import _estimate
from design.variation import _variants, varied

MAKE = Parameter("make", 0.1, 10, log=True)


def spared(make=1.0, nothing=0.5):
    """One of the parameters has no effect."""
    return lit(make)


def best(
    scene, parameters, values, *, target=None, cells: int | None = 12, replicates=2, **options
) -> Best:
    """A design as if a search had found it."""
    search = Search(
        scene,
        parameters,
        target or Level(wanted=1.0),
        cells=cells,
        replicates=replicates,
        method="sobol",
        **options,
    )
    point = search.objective.task.space.point(values)
    found = search.objective.evaluate(point[None])
    return Best(search, search.objective.task.space.values(point), point, found.losses[0])


@pytest.fixture(scope="module")
def spare():
    return best(spared, [MAKE, Parameter("nothing", 0, 1)], {"make": 2.0, "nothing": 0.5})


@pytest.fixture(scope="module")
def held(spare):
    return spare.check(seeds=6, samples=8, threshold=0.2, progress=False)


def test_fresh_seeds_are_those_right_after_the_searched_ones(spare, held):
    assert held.streams == tuple(range(2, 8))
    alone = spare.search.objective.evaluate(spare.point[None], streams=held.streams)
    assert np.array_equal(held.losses, alone.losses[0])
    assert np.array_equal(held.searched, spare.losses)
    assert not set(held.losses) & set(held.searched)


def test_statistics_of_the_losses(held):
    assert held.mean == pytest.approx(np.mean(held.losses), rel=1e-15)
    ordered = sorted(held.losses)
    assert held.median == pytest.approx(0.5 * (ordered[2] + ordered[3]), rel=1e-15)
    # six seeds lie at 0, 0.2, …, 1: 0.9 is half-way between the last two
    assert held.high == pytest.approx(0.5 * (ordered[4] + ordered[5]), rel=1e-12)
    assert held.reached == sum(x <= 0.2 for x in ordered) / 6
    assert held.failed == 0.0


@pytest.mark.parametrize("place, share, cells", [(0, 0.5, 6), (1, 2.0, 24)])
def test_another_size_is_the_objective_of_that_size(held, place, share, cells):
    found = held.sizes[place]
    assert (found.share, found.cells, found.until) == (share, cells, None)
    direct = objective_of(
        spared, [MAKE, Parameter("nothing", 0, 1)], Level(wanted=1.0), cells=cells, replicates=2
    )
    point = direct.task.space.point(held.values)
    assert np.array_equal(
        found.losses, direct.evaluate(point[None], streams=held.streams).losses[0]
    )


def test_a_change_is_compared_on_the_same_seeds(spare, held):
    change = held.changes[1]
    assert (change.name, change.clipped) == ("make", False)
    assert change.value == pytest.approx(2.4, rel=1e-12)
    objective = spare.search.objective
    moved = objective.evaluate(
        objective.task.space.point({"make": change.value, "nothing": 0.5})[None],
        streams=held.streams,
    ).losses[0]
    # the coordinate of the value is rounded, which changes at most the last bits of float32 levels
    assert np.allclose(change.losses, moved, rtol=1e-6, atol=1e-6)
    gained = change.losses - held.losses
    assert change.difference == pytest.approx(gained.mean(), rel=1e-12)
    assert change.error == pytest.approx(math.sqrt(gained.var(ddof=1) / 6), rel=1e-12)


def test_a_parameter_without_effect_has_none(held):
    idle = [c for c in held.changes if c.name == "nothing"]
    assert [(c.value, c.difference, c.error) for c in idle] == [
        (pytest.approx(0.4), 0.0, 0.0),
        (pytest.approx(0.6), 0.0, 0.0),
    ]
    assert held.indices.first[1] == held.indices.total[1] == held.indices.total_error[1] == 0.0
    assert held.indices.total[0] > 0.0
    assert held.indices.colonies == 8 * (2 + 2) * 2


@pytest.mark.parametrize("most, work_items", [(3, 1), (None, 4)])
def test_results_do_not_depend_on_the_work_items(held, spare, most, work_items):
    search = Search(
        spared,
        [MAKE, Parameter("nothing", 0, 1)],
        Level(wanted=1.0),
        cells=12,
        replicates=2,
        method="sobol",
        most=most,
    )
    with ThreadPoolExecutor(2) as pool:
        other = check_robustness(
            Best(search, spare.values, spare.point, spare.searched),
            seeds=6,
            samples=8,
            executor=pool,
            work_items=work_items,
            progress=False,
        )
    assert np.array_equal(other.losses, held.losses)
    for one, two in zip(other.sizes + other.changes, held.sizes + held.changes, strict=True):
        assert np.array_equal(one.losses, two.losses)
    for name in ("first", "total", "first_error", "total_error"):
        assert np.array_equal(getattr(other.indices, name), getattr(held.indices, name))


@pytest.mark.parametrize(
    "parameter, value, wanted, used",
    [
        (Parameter("make", 0.5, 10), 2.0, (1.6, 2.4), (1.6, 2.4)),
        (Parameter("make", 0.5, 10, log=True), 2.0, (1.6, 2.4), (1.6, 2.4)),
        (Parameter("make", 1.9, 2.1), 2.0, (1.6, 2.4), (1.9, 2.1)),
        (Parameter("make", -10, 10), -2.0, (-1.6, -2.4), (-1.6, -2.4)),
        (Parameter("genes", 1, 3, whole=True), 2, (1, 3), (1, 3)),
        (Parameter("genes", 1, 3, whole=True), 3, (2,), (2,)),
        (Choice("promoter", ("weak", "strong")), "strong", ("weak",), ("weak",)),
    ],
)
def test_values_that_are_tried(parameter, value, wanted, used):
    found = best(
        built, [parameter], {parameter.name: value}, cells=2, replicates=1, target=Level("g0")
    ).check(seeds=1, sizes=(), progress=False)
    near = lambda values: [v if isinstance(v, str) else pytest.approx(v, rel=1e-12) for v in values]
    assert [c.wanted for c in found.changes] == near(wanted)
    assert [c.value for c in found.changes] == near(used)
    assert [c.clipped for c in found.changes] == [a != b for a, b in zip(wanted, used, strict=True)]
    assert all(math.isfinite(c.difference) and math.isnan(c.error) for c in found.changes)


@pytest.mark.parametrize(
    "low, high, value, changed",
    [
        (0.1, 2.0, 2.0, [True, False]),
        (0.0, 2.0, 0.0, [False, False]),
        (2.0, 9.0, 2.0, [False, True]),
    ],
)
def test_a_value_that_cannot_be_changed_has_no_difference(low, high, value, changed):
    """At a bound or at 0 the value used is that of the design, and the difference is NaN."""
    found = best(lit, [Parameter("make", low, high)], {"make": value}, cells=2, replicates=1).check(
        seeds=2, sizes=(), progress=False
    )
    assert [math.isfinite(c.difference) for c in found.changes] == changed
    assert [c.value for c, t in zip(found.changes, changed, strict=True) if not t] == [
        value
    ] * changed.count(False)


def test_failures_count_with_the_loss_of_a_failure():
    """Rates are not finite above 5 during the run: 4.5 plus 20 % fails on every seed."""
    design = best(fragile, [Parameter("make", 0.1, 10)], {"make": 4.5}, cells=20)
    held = design.check(seeds=3, sizes=(), progress=False)
    assert held.failed == 0.0
    assert held.changes[1].losses.tolist() == [Target.failed] * 3
    broken = best(fragile, [Parameter("make", 0.1, 10)], {"make": 6.0}, cells=20).check(
        seeds=3, sizes=(), progress=False
    )
    assert broken.failed == 1.0 and broken.mean == Target.failed


def steady(u, s, p, cell):
    return {"held_x": p.x, "held_y": p.y, "held_z": p.z}


def still(x=0.0, y=0.0, z=0.0, rest=0.0):
    """One cell that does not change; after an hour its levels are its three parameters."""
    circuit = tf.Circuit(steady, species=("held_x", "held_y", "held_z"), x=x, y=y, z=z)
    return tf.Scene(tf.Growth(rate=1e-9), circuit, dt=1.0)


@dataclass(frozen=True)
class Ishigami(Target):
    """sin x + 7 sin² y + z⁴ sin x / 10 (Ishigami and Homma 1990)."""

    scale: float = 1.0

    def loss(self, state, history=None):
        x, y, z = (math.pi * (2 * mean(state, "held_" + n) - 1) for n in ("x", "y", "z"))
        return self.scale * (torch.sin(x) + 7 * torch.sin(y) ** 2 + 0.1 * z**4 * torch.sin(x))


CUBE = [Parameter(n, 0, 1) for n in ("x", "y", "z", "rest")]


@pytest.mark.slow
def test_indices_of_ishigami():
    """Variances by hand: a = 7, b = 0.1 give V = a²/8 + bπ⁴/5 + b²π⁸/18 + 1/2, V₁ = (1 + bπ⁴/5)²/2,
    V₂ = a²/8, V₁₃ = 8b²π⁸/225."""
    a, b = 7.0, 0.1
    whole = a**2 / 8 + b * math.pi**4 / 5 + b**2 * math.pi**8 / 18 + 0.5
    one, two, both = (
        0.5 * (1 + b * math.pi**4 / 5) ** 2 / whole,
        a**2 / 8 / whole,
        8 * b**2 * math.pi**8 / 225 / whole,
    )
    middle = dict.fromkeys(("x", "y", "z", "rest"), 0.5)
    design = best(
        still, CUBE, middle, target=Ishigami(), cells=None, until=1.0, replicates=1, most=4096
    )
    found = design.check(seeds=1, sizes=(), samples=1024, progress=False).indices
    # four standard errors: one in 2,000 tests of eight would miss them by chance, and the points
    # are the same each time
    assert np.all(np.abs(found.first - [one, two, 0, 0]) <= 4 * found.first_error + 1e-12)
    assert np.all(np.abs(found.total - [one + both, two, both, 0]) <= 4 * found.total_error + 1e-12)
    assert found.first_error.max() < 0.06 and found.total_error.max() < 0.06
    assert found.total[3] == 0.0
    assert found.colonies == 1024 * 6

    def ishigami(u):
        x, y, z = (math.pi * (2 * u[..., k] - 1) for k in range(3))
        return np.sin(x) + a * np.sin(y) ** 2 + b * z**4 * np.sin(x)

    # errors: the scatter between sets of independent points, known to 5 %, while resampling one set
    # tells it to some 15 %; that of first and of total indices differs by up to a factor of two
    rng, sets = np.random.default_rng(5), []
    for _ in range(200):
        one, other = rng.random((2, 1024, 4))
        mixed = (np.where(np.arange(4) == k, other, one) for k in range(4))
        sets.append(_estimate(np.stack([ishigami(u) for u in (one, other, *mixed)])))
    wanted = np.std(sets, axis=0)
    assert [found.first_error, found.total_error] == pytest.approx(wanted, rel=0.3)


@pytest.mark.parametrize("scale, index", [(1.0, 1.0), (0.0, 0.0)])
def test_one_parameter_explains_everything_or_there_is_nothing_to_explain(scale, index):
    design = best(
        still,
        [CUBE[0]],
        {"x": 0.5},
        target=Ishigami(scale),
        cells=None,
        until=1.0,
        replicates=1,
        most=4096,
        dtype=torch.float64,
    )
    found = design.check(seeds=1, sizes=(), samples=64, progress=False).indices
    # Sobol points are even: the means of f² over 64 points are within a few per cent of their
    # integrals
    assert found.total[0] == pytest.approx(index, abs=0.1)
    assert found.first[0] == pytest.approx(index, abs=0.1)


def test_the_file_holds_the_results(held, tmp_path):
    saved = json.loads(held.save(tmp_path / "held.json").read_text())
    assert saved["losses"] == held.losses.tolist() and saved["streams"] == list(held.streams)
    assert saved["values"] == held.values and saved["searched"] == held.searched.tolist()
    assert (saved["mean"], saved["median"], saved["high"], saved["reached"]) == (
        held.mean,
        held.median,
        held.high,
        held.reached,
    )
    assert [c["difference"] for c in saved["changes"]] == [c.difference for c in held.changes]
    assert [s["cells"] for s in saved["sizes"]] == [6, 24]
    assert saved["indices"]["total"] == held.indices.total.tolist()


def test_nan_is_null_in_the_file(tmp_path):
    found = best(lit, [Parameter("make", 0, 2.0)], {"make": 0.0}, cells=2, replicates=1).check(
        seeds=1, sizes=(), progress=False
    )
    text = found.save(tmp_path / "held.json").read_text()
    assert "NaN" not in text
    assert (
        json.loads(text)["changes"][0]["difference"] is None and json.loads(text)["indices"] is None
    )


def test_the_table_names_everything(held):
    table = held.table()
    for words in (
        "streams 0 … 1",
        "6 fresh ones, 2 … 7",
        "loss at most 0.2",
        "searched",
        "× 0.5",
        "× 2",
        "make",
        "nothing",
        f"{held.mean:.4f}",
        "64 colonies",
    ):
        assert words in table


def test_the_table_shows_values_clipped_at_a_bound():
    found = best(lit, [Parameter("make", 0.1, 2.1)], {"make": 2.0}, cells=2, replicates=1).check(
        seeds=1, sizes=(), progress=False
    )
    row = next(line for line in found.table().splitlines() if "2.4" in line)
    assert row.split()[:4] == ["make", "2", "2.1", "2.4"]


@pytest.mark.slow
@pytest.mark.parametrize("samples, panels", [(0, 2), (2, 3)])
def test_a_picture_has_a_panel_for_each_part(tmp_path, samples, panels):
    from matplotlib.image import imread

    design = best(lit, [MAKE], {"make": 2.0}, cells=2, replicates=1)
    path = (
        design.check(seeds=2, sizes=(2.0,), samples=samples, threshold=0.5, progress=False)
        .plot(tmp_path / "held.png")
        .path
    )
    assert imread(path).shape[:2] == (512, 576 * panels)  # 3.2 × 3.6 inches at 160 dots


@pytest.mark.parametrize(
    "options, words",
    [
        ({"seeds": 0}, "seeds = 0"),
        ({"seeds": 2.5}, "seeds = 2.5"),
        ({"sizes": 2.0}, "sizes = 2.0"),
        ({"sizes": (0.5, -1.0)}, "sizes = -1.0"),
        ({"sizes": "large"}, "sizes = 'large'"),
        ({"change": 0.0}, "change = 0.0"),
        ({"change": 1.0}, "change = 1.0"),
        ({"samples": 100}, "give 64 or 128"),
        ({"samples": 1}, "samples = 1 .* give 2 or 4"),
        ({"samples": -8}, "samples = -8"),
        ({"threshold": math.nan}, "threshold = nan"),
    ],
)
def test_bad_input_is_refused_before_anything_grows(spare, options, words):
    with pytest.raises(tf.InputError, match=words):
        spare.check(progress=False, **options)


@pytest.mark.parametrize("factor", [0.0, -1.0, math.inf])
def test_a_task_is_not_resized_to_nothing(spare, factor):
    with pytest.raises(tf.InputError, match="factor"):
        spare.search.objective.task.resized(factor)


def test_results_are_saved_under_a_name_that_tells_their_format(held, tmp_path):
    with pytest.raises(tf.InputError, match=r"path = .*held\.csv.*ends in '\.json'"):
        held.save(tmp_path / "held.csv")
    with pytest.raises(tf.InputError, match=r"path = 3.*the path of a file"):
        held.save(3)


def test_all_parameters_vary_at_once_within_their_bounds(spare, tmp_path):
    """The factors are log-normal, one for each value, and the loss that of the variant itself."""
    found = check_robustness(spare, seeds=40, sizes=(), vary=0.3, progress=False)
    varied, space = found.varied, spare.objective.task.space
    values = [space.values(point) for point in varied.points]
    for name in space.names:
        logs = np.log([v[name] / spare.values[name] for v in values])
        free = np.abs(logs) > 1e-9
        assert free.mean() > 0.5 and 0.15 < logs[free].std() < 0.45
    one, other = (np.log([v[n] for v in values]) for n in space.names[:2])
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.5
    each = spare.objective.evaluate(varied.points[:1], streams=found.streams[:1]).losses
    assert varied.losses.shape == (40,) and varied.losses[0] == each[0, 0]
    again = check_robustness(spare, seeds=40, sizes=(), vary=0.3, progress=False)
    assert np.array_equal(again.varied.losses, varied.losses)
    assert "all parameters × exp(0.3 z)" in found.table()
    # ten variants on each of four seeds share the loss of the design there
    gained = (varied.losses - found.losses[np.arange(40) % 4]).reshape(10, 4).mean(0)
    assert varied.change(found.losses)[0] == pytest.approx(gained.mean())
    assert varied.change(found.losses)[1] == pytest.approx(gained.std(ddof=1) / 2)
    assert f"change the loss by {gained.mean():+.4f} ± " in found.table()
    saved = json.loads(found.save(tmp_path / "held.json").read_text())
    assert saved["varied"]["losses"] == varied.losses.tolist()
    found.plot(tmp_path / "held.png")
    assert check_robustness(spare, seeds=2, sizes=(), progress=False).varied is None


def test_variants_are_grown_on_four_seeds_in_turn(spare):
    found = varied(spare.objective, spare.point, 0.3, range(2, 8), None, 1)
    for k, seed in enumerate([2, 3, 4, 5, 2, 3]):
        alone = spare.objective.evaluate(found.points[k : k + 1], streams=(seed,))
        assert found.losses[k] == alone.losses[0, 0]


def test_choices_and_whole_numbers_do_not_vary():
    point = np.array([0.5, 0.5, 0.25])
    parameters = [Choice("kind", ["a", "b"]), Parameter("n", 1, 4, whole=True), MAKE]
    points, clipped = _variants(parameters, point, 10.0, 50)
    assert (points[:, :2] == point[:2]).all() and (points[:, 2] != point[2]).all()
    assert 0.5 < clipped < 1.0 and points[:, 2].min() >= 0.0 and points[:, 2].max() <= 1.0


def test_shares_have_an_interval_and_means_an_error(spare):
    found = check_robustness(spare, seeds=8, sizes=(), threshold=1e9, progress=False)
    text = found.table()
    assert "100% of them (90 % interval of the share 75% to 100%)" in text
    row = next(line for line in text.splitlines() if line.startswith("fresh")).split()
    error = found.losses.std(ddof=1) / math.sqrt(8)
    assert [float(x) for x in row[1:3]] == pytest.approx([found.mean, error], abs=1e-4)
