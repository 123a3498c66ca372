"""Levels of whole cells, as a flow cytometer measures them, and tables with several times."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchfilm as tf
from design import Observed, ObservedCourse
from torchfilm import parts

MU = math.log(2)


def scene(make=100.0) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=tf.Normal(MU, 0.1 * MU)),
        tf.Division(volume=tf.Normal(4.2, 0.3), conserves="volume"),
        tf.Circuit([parts.constitutive("gfp", make)], species="gfp", method="tau_leap"),
        dim=2, dt=0.05,
    )  # fmt: skip


@pytest.fixture(scope="module")
def seen() -> list[tf.State]:
    states = tf.simulate(scene(), until=7.0, colonies=8, seed=2)
    return [s for s in states if round(s.time, 6) in (5.0, 7.0)]


def amounts(state: tf.State) -> np.ndarray:
    return (state.gfp * state.volume).double().numpy()


def cytometry(state: tf.State) -> dict[str, np.ndarray]:
    return {"FITC-A": amounts(state), "colony": state.colony.numpy()}


def test_the_true_model_fits_its_own_cytometry(seen):
    """Amounts vary with the volume, by 22 % here, and concentrations by 8 %: a fit of these would
    have made expression noisy."""
    given = {"species": ["gfp"], "columns": {"gfp": "FITC-A"}, "relative": True, "quantiles": True}
    right = Observed.from_table(cytometry(seen[1]), amounts=True, **given).without("cells")
    wrong = Observed.from_table(cytometry(seen[1]), **given).without("cells")
    *_, other = tf.simulate(scene(), until=7.0, colonies=8, seed=3)
    assert right.values == wrong.values
    variation = [x.statistics(other)[:, 0].mean() / right.values[0] for x in (right, wrong)]
    assert float(variation[0]) == pytest.approx(1.0, abs=0.15) and float(variation[1]) < 0.5
    assert float(right.loss(other).mean()) < 1.5 < 2.0 < float(wrong.loss(other).mean())
    assert {n for n in right.plan.names if "gfp" in n} == {
        f"gfp_amount_{n}" for n in ("cv", "10", "25", "50", "75", "90")
    }


def test_tables_states_and_results_give_the_same_amounts(seen, tmp_path):
    one = seen[1]
    path = tmp_path / "run.h5"
    recorder = tf.Recorder(path, scene(), every=140)
    list(tf.simulate(scene(), until=7.0, colonies=8, seed=2, record=recorder))
    by_state = Observed.from_state(one, species=["gfp"], amounts=True, quantiles=True)
    table = {
        "x_um": one.position[:, 0], "y_um": one.position[:, 1], "length_um": one.length,
        "angle_rad": torch.atan2(one.axis[:, 1], one.axis[:, 0]), "colony": one.colony,
        "gfp": torch.from_numpy(amounts(one)),
    }  # fmt: skip
    options = {"species": ["gfp"], "quantiles": True}
    others = (
        Observed.from_table(table, amounts=True, **options),
        Observed.from_results(path, amounts=True, **options).without("age"),
        Observed.from_results(path, species=["gfp"], like=by_state),
    )
    for other in others:
        assert other.plan.names == by_state.plan.names
        assert other.values == pytest.approx(by_state.values, rel=1e-5, abs=1e-6)
    mean = amounts(one)[one.colony.numpy() == 0].mean()
    found = by_state.statistics(one)[0, by_state.plan.names.index("gfp_amount_mean")]
    assert float(found) == pytest.approx(mean, rel=1e-6)


def test_masks_give_the_sum_over_a_cell_s_pixels():
    """Which is its mean times its area."""
    labels = np.zeros((60, 140), int)
    labels[10:20, 10:50], labels[30:40, 10:110] = 1, 2
    image = np.where(labels > 0, 50.0, 0.0)
    seen = Observed.from_masks(
        labels, pixel_size=0.1, fluorescence={"gfp": image}, background=0.0, amounts=True
    )
    mean = seen.values[seen.plan.names.index("gfp_amount_mean")]
    # 4 and 10 µm²; of bodies with round ends and the same moments some per cent more
    assert mean == pytest.approx(50.0 * (4.0 + 10.0) / 2, rel=0.06)


def test_amounts_have_derivatives(seen):
    """By the levels and by the volume."""

    def mean(make):
        circuit = tf.Circuit(
            lambda u, s, p, cell: {"gfp": p.make - u.gfp}, species="gfp", make=make
        )
        growing = tf.Scene(tf.Growth(rate=make / 3), circuit, dim=2, dt=0.1)
        *_, last = tf.simulate(growing, growing.bind(dtype=torch.float64).start(), until=0.5)
        data = Observed.from_state(last, species=["gfp"], amounts=True)
        return data.statistics(last)[0, data.plan.names.index("gfp_amount_mean")]

    x = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(mean(x), x)
    with torch.no_grad():
        assert float(slope) == pytest.approx(
            float(mean(x + 1e-4) - mean(x - 1e-4)) / 2e-4, rel=1e-5
        )


def at_times(seen: list[tf.State]) -> dict[str, np.ndarray]:
    columns = [
        {"time_min": np.full(s.cells, s.time * 60), "gfp": amounts(s), "colony": s.colony.numpy()}
        for s in seen
    ]
    return {name: np.concatenate([x[name] for x in columns]) for name in columns[0]}


def test_a_table_with_several_times_is_a_course(seen, tmp_path):
    given = at_times(seen)
    path = tmp_path / "flow.csv"
    rows = zip(*given.values(), strict=True)
    lines = [",".join(given), *(",".join(repr(float(x)) for x in row) for row in rows)]
    path.write_text("\n".join(lines), encoding="utf-8")
    course = ObservedCourse.from_table(path, species=["gfp"], amounts=True)
    one_by_one = ObservedCourse([
        Observed.from_table(
            {"gfp": amounts(s), "colony": s.colony.numpy()}, species=["gfp"], amounts=True,
            time=s.time,
        )
        for s in seen
    ])  # fmt: skip
    assert course.times == pytest.approx((5.0, 7.0)) and course.plan.names == one_by_one.plan.names
    assert course.values == pytest.approx(one_by_one.values, rel=1e-6)
    named = {"Hours" if n == "time_min" else n: x for n, x in given.items()}
    named["Hours"] = named["Hours"] / 60
    again = ObservedCourse.from_table(
        named, species=["gfp"], amounts=True, columns={"time": "Hours"}, time_unit="h"
    )
    assert again.values == pytest.approx(course.values, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: {"time_min": None}, "lacks the column 'time_h'.*columns={\"time\""),
        (lambda t: {"time_min": 0 * t}, "'time_min': 0 h is not above 0"),
        (lambda t: {"time_min": 0 * t + 60}, "all rows are of 1 h"),
        (lambda t: {"time_min": None, "time": t}, "'time' has no unit"),
    ],
)
def test_bad_times_of_a_table(seen, change, match):
    given = at_times(seen)
    given |= change(given["time_min"])
    with pytest.raises(tf.InputError, match=match):
        ObservedCourse.from_table(
            {n: x for n, x in given.items() if x is not None}, species=["gfp"]
        )


def test_what_to_do_with_names_and_times_of_a_cytometer(seen):
    with pytest.raises(tf.InputError, match=r"columns=\{'gfp': 'FITC-A'\}"):
        Observed.from_table(cytometry(seen[1]), species=["FITC-A"])
    with pytest.raises(tf.InputError, match=r"lacks the column 'gfp'.*Name yours by columns"):
        Observed.from_table(cytometry(seen[1]), species=["gfp"])
    with pytest.raises(tf.InputError, match=r"take ObservedCourse\.from_table"):
        Observed.from_table(at_times(seen), species=["gfp"])
    with pytest.raises(tf.InputError, match=r"Observed\(amounts\) = True.*as of like"):
        like = Observed.from_table(flow := {"gfp": amounts(seen[1])}, species=["gfp"])
        Observed.from_table(flow, species=["gfp"], amounts=True, like=like)
    with pytest.raises(tf.InputError, match=r"Observed\(amounts\) = True.*with species"):
        Observed.from_table({"length_um": [2.0, 3.0]}, amounts=True)
    with pytest.raises(tf.InputError, match=r"from_table\(time\) = 3\.0.*columns="):
        ObservedCourse.from_table(at_times(seen), species=["gfp"], time=3.0)
    with pytest.warns(UserWarning, match="4 times in 4 rows"):
        noted = {"time_h": [1.01, 1.02, 2.01, 2.02], "gfp": [1.0, 2.0, 3.0, 4.0]}
        ObservedCourse.from_table(noted, species=["gfp"])
    with pytest.raises(tf.InputError, match="time_unit"):
        ObservedCourse.from_table(at_times(seen), species=["gfp"], time_unit="h")
    with pytest.raises(tf.InputError, match="amounts"):
        Observed.from_state(seen[1], species=["gfp"], amounts="yes")


def test_studies_and_simulations_tell_amounts_from_levels(seen):
    """Of one table the numbers are the same; the repr of data without amounts is as it ever was."""
    given = cytometry(seen[1]), {"species": ["gfp"], "columns": {"gfp": "FITC-A"}}
    plain, of_cells = (Observed.from_table(given[0], **given[1], amounts=x) for x in (False, True))
    assert plain.values == of_cells.values and repr(plain) != repr(of_cells)
    assert repr(of_cells.plan) == repr(plain.plan)[:-1] + ", amounts=True)"
    assert repr(plain.plan) == (
        "ColonyStatistics(lengths=False, ages=False, positions=False, alignment=False,"
        " species=('gfp',), edges=(), reach=3.0, length_with_caps=False, relative=False,"
        " omitted=())"
    )
