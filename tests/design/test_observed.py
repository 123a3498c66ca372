"""A target that is made from data: its statistics, spreads, units and loss."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from searching import grown, lit

import torchfilm as tf
from design import Objective, Observed, Parameter, Search, Task
from design.targets.statistics import seen_cells

DEGREES = {"angle_unit": "degrees"}


def colony(rate=1.5, make=1.0):
    """Two-dimensional colonies with a reporter."""
    return grown(tf.LogNormal(rate, 0.2), make, 1.0, tf.Mechanics(dim=2))


@pytest.fixture(scope="module")
def seen():
    """A state of four colonies, and their notes."""
    ageing = Observed.from_table({"age_h": [0.0]})
    notes = []
    for state in tf.simulate(colony(), until=2.5, colonies=4, seed=3):
        notes.append(ageing.note(state))
    return state, torch.stack(notes)


def table_of(state, pixel=0.1):
    x, y = (state.position / pixel).T.numpy()
    return {
        "x": x,
        "y": y,
        "length": state.length.numpy() / pixel,
        "angle": torch.rad2deg(torch.atan2(state.axis[:, 1], state.axis[:, 0])).numpy(),
        "gfp": state.gfp.numpy(),
        "colony": [f"plate {k}" for k in state.colony.tolist()],
    }


def finer(state, level):
    """The state with levels in float64, which with_fields would round: for exact differences."""
    return state.replace(fields={**state.fields, "gfp": level})


def statistics(target, state, history=None):
    found = target.statistics(state, history)
    return dict(zip(target.plan.names, found.unbind(1), strict=True))


# --- statistics -----------------------------------------------------------------------------------


def test_statistics_are_what_their_names_say(seen):
    state, _ = seen
    target = Observed.from_state(state, species=["gfp"], rings=3, reach=2.0)
    found = statistics(target, state)
    for k in range(4):
        mine = state.select([k])
        place, gfp = mine.position.numpy(), mine.gfp.double().numpy()
        assert found["log_cells"][k] == pytest.approx(math.log(mine.cells))
        for q in (10, 50, 90):
            wanted = np.quantile(mine.length.double().numpy(), q / 100)
            assert found[f"length_{q}_um"][k] == pytest.approx(wanted)
        far = np.linalg.norm(place - place.mean(0), axis=1)
        assert found["gyration_um"][k] == pytest.approx(math.sqrt((far**2).mean()))
        edges = target.plan.edges
        for ring in range(3):
            inside = (far >= edges[ring]) & (far < edges[ring + 1])
            area = math.pi * (edges[ring + 1] ** 2 - edges[ring] ** 2)
            assert found[f"density_{ring + 1}"][k] == pytest.approx(inside.sum() / area)
            inside |= (far >= edges[-1]) & (ring == 2)
            wanted = gfp[inside].mean() if inside.any() else gfp.mean()
            assert found[f"gfp_ring_{ring + 1}"][k] == pytest.approx(wanted)
        apart = np.linalg.norm(place[:, None] - place[None], axis=2)
        near = np.triu((apart < 2.0) & (apart > 0))
        z = gfp - gfp.mean()
        wanted = (z[:, None] * z[None])[near].mean() / (z**2).mean()
        assert found["gfp_neighbours"][k] == pytest.approx(wanted)
        axis = mine.axis.double().numpy()
        wanted = (2 * (axis @ axis.T) ** 2 - 1)[near].mean()
        assert found["alignment"][k] == pytest.approx(wanted, abs=1e-6)


def test_ages_are_the_times_since_birth(seen):
    """In a synchronous colony without spread all cells are born at one step."""
    state, history = seen
    target = Observed.from_state(state, history=history)
    found = statistics(target, state, history)
    scene = colony()
    born: dict[tuple[int, int], float] = {}
    for now in tf.simulate(scene, until=2.5, colonies=4, seed=3):
        for key in zip(now.colony.tolist(), now.uid.tolist(), strict=True):
            born.setdefault(key, 0.0 if key[1] == 0 else now.time)
    for k in range(4):
        ages = [state.time - born[k, u] for u in state.uid[state.colony == k].tolist()]
        for q in (10, 50, 90):
            assert found[f"age_{q}_h"][k] == pytest.approx(np.quantile(ages, q / 100), abs=1e-9)
    with pytest.raises(tf.InputError, match="ages need the notes"):
        target.loss(state)


def test_cells_that_an_effect_adds_are_as_old_as_since_then(seen):
    """They have no parent, as founders have none, but a number of a later step."""
    state, history = seen
    plan = Observed.from_state(state, history=history).plan
    ages = seen_cells(state, plan, history).age
    late = ages < state.time - 0.1
    assert late.any()
    added = state.replace(parent=torch.where(late, -1, state.parent))
    assert torch.equal(seen_cells(added, plan, history).age, ages)


def test_statistics_do_not_depend_on_the_batch(seen):
    state, history = seen
    target = Observed.from_state(state, species=["gfp"], history=history)
    every, order = target.statistics(state, history), [2, 0]
    some = target.statistics(state.select(order), history[:, order])
    assert torch.equal(some, every[order])
    alone = target.loss(state.select(order), history[:, order])
    assert torch.equal(target.loss(state, history)[order], alone)


def test_a_table_and_its_state_give_the_same_target(seen):
    state, _ = seen
    one = Observed.from_state(state, species=["gfp"])
    other = Observed.from_table(table_of(state), species=["gfp"], pixel_size=0.1, **DEGREES)
    assert one.plan.names == other.plan.names and other.colonies == 4
    assert other.values == pytest.approx(one.values, rel=1e-5)
    assert other.spread == pytest.approx(one.spread, rel=1e-3)


def test_rows_of_a_table_may_come_in_any_order(seen):
    table = table_of(seen[0])
    order = np.random.default_rng(0).permutation(len(table["x"]))
    mixed = {name: np.asarray(column)[order] for name, column in table.items()}
    options = {"species": ["gfp"], "pixel_size": 0.1, **DEGREES}
    one, other = (Observed.from_table(t, **options) for t in (table, mixed))
    assert other.values == pytest.approx(one.values) and other.cells == one.cells


def test_lengths_from_length_with_caps_include_the_caps(seen):
    state, _ = seen
    one, whole = (Observed.from_state(state, length_with_caps=w) for w in (False, True))
    k = one.plan.names.index("length_50_um")
    assert whole.values[k] == pytest.approx(one.values[k] + 1.0)


def test_relative_levels_do_not_depend_on_their_unit(seen):
    state, _ = seen
    bright = state.with_fields(gfp=7.0 * state.gfp)
    target = Observed.from_state(state, species=["gfp"], relative=True)
    assert "gfp_mean" not in target.plan.names
    assert target.loss(bright).tolist() == pytest.approx(target.loss(state).tolist(), rel=1e-4)


@pytest.mark.parametrize("caps", [False, True])
def test_results_give_ages_and_lengths(tmp_path, seen, caps):
    state, history = seen
    path = tmp_path / "run.h5"
    for _ in tf.simulate(colony(), until=2.5, colonies=4, seed=3, record=path):
        pass
    options = {"species": ["gfp"], "length_with_caps": caps}
    read = Observed.from_results(path, **options)
    made = Observed.from_state(state, history=history, **options)
    assert read.plan.names == made.plan.names and read.time == pytest.approx(2.5)
    assert read.values == pytest.approx(made.values, rel=1e-5)


# --- spreads --------------------------------------------------------------------------------------


def test_the_spread_is_that_between_colonies_or_between_cells(seen):
    state, _ = seen
    target = Observed.from_state(state)
    each = target.statistics(state)
    assert target.values == pytest.approx(each.mean(0).tolist())
    alone = [Observed.from_state(state.select([k])) for k in range(4)]
    for name in ("gyration_um", "length_50_um"):
        k = target.plan.names.index(name)
        drawn = np.sqrt(np.mean([a.spread[a.plan.names.index(name)] ** 2 for a in alone]))
        assert target.spread[k] == pytest.approx(max(drawn, float(each[:, k].std())), rel=0.02)
    assert target.spread[0] == pytest.approx(max(0.02, float(each[:, 0].std())))
    assert target.loss(state).mean() < 2.0


def test_the_spread_of_one_colony_is_bootstrapped():
    """The median of n normal numbers has a standard deviation of √(π/2n)."""
    lengths = 20 + np.random.default_rng(1).normal(size=2000)
    target = Observed.from_table({"length_um": lengths})
    k = target.plan.names.index("length_50_um")
    least = 0.01 * max(target.values)
    wanted = math.sqrt(math.pi / 2 / 2000)
    assert wanted < least == pytest.approx(target.spread[k], rel=0.01)
    few = Observed.from_table({"length_um": lengths[:50]})
    assert few.spread[k] == pytest.approx(math.sqrt(math.pi / 100), rel=0.5)
    assert few.spread[0] == pytest.approx(1 / math.sqrt(50))


def test_three_colonies_are_enough_for_the_spread_between_them():
    table = {"gfp": [1.0, 1.0, 2.0, 2.0, 4.0, 4.0], "colony": [0, 0, 1, 1, 2, 2]}
    target = Observed.from_table(table, species=["gfp"])
    k = target.plan.names.index("gfp_mean")
    assert target.spread[k] == pytest.approx(np.std([1.0, 2.0, 4.0], ddof=1))


@pytest.mark.parametrize("cells, least", [(1000, 0.02), (5, 0.5 / 5)])
def test_colonies_with_as_many_cells_have_a_spread_of_their_number(cells, least):
    table = {"length_um": np.full(3 * cells, 2.0), "colony": np.repeat([0, 1, 2], cells)}
    assert Observed.from_table(table).spread[0] == pytest.approx(least)


def test_cells_that_are_all_alike_have_a_spread_of_their_variation():
    target = Observed.from_table({"gfp": [2.0] * 5}, species=["gfp"])
    assert target.spread[target.plan.names.index("gfp_cv")] == pytest.approx(0.01)


def test_dark_cells_have_a_spread():
    target = Observed.from_table({"x_um": [0.0, 1.0, 5.0], "y_um": [0.0] * 3, "gfp": [0.0] * 3},
                                 species=["gfp"])  # fmt: skip
    assert min(target.spread) > 0


# --- loss -----------------------------------------------------------------------------------------


def test_the_loss_is_the_mean_square_in_spreads(seen):
    state, _ = seen
    target = Observed.from_state(state, species=["gfp"])
    apart = (target.statistics(state) - torch.tensor(target.values)) / torch.tensor(target.spread)
    assert target.loss(state).tolist() == pytest.approx((apart**2).mean(1).tolist())
    assert target.residuals(state).square().sum(1).tolist() == pytest.approx(
        target.loss(state).tolist()
    )


def test_the_loss_has_gradients_by_the_levels(seen):
    state = seen[0]
    target = Observed.from_state(state, species=["gfp"])
    level = (1.1 * state.gfp.double()).requires_grad_()
    loss = lambda x: target.loss(finer(state, x)).sum()
    (slope,) = torch.autograd.grad(loss(level), level)
    step = torch.randn(len(level), dtype=torch.float64, generator=torch.manual_seed(0))
    h = 1e-5
    found = (loss(level.detach() + h * step) - loss(level.detach() - h * step)) / (2 * h)
    assert float(slope @ step) == pytest.approx(float(found), rel=1e-4)


def test_quantiles_of_levels_tell_two_states_apart(seen):
    """Half of the cells dark and half lit; or all in between, with the same mean."""
    state, _ = seen
    lit = torch.arange(state.cells) % 2
    two = state.with_fields(gfp=0.2 + 1.6 * lit.to(state.gfp))
    target = Observed.from_state(two, species=["gfp"], quantiles=True)
    assert target.plan.groups["gfp quantiles"] == tuple(f"gfp_{q}" for q in (10, 25, 50, 75, 90))
    found = statistics(target, state)
    for k in range(state.colonies):
        gfp = state.select([k]).gfp.double().numpy()
        for q in (10, 25, 50, 75, 90):
            assert found[f"gfp_{q}"][k] == pytest.approx(np.quantile(gfp, q / 100))
    only = [g for g in target.plan.groups if g != "gfp quantiles"]
    tenth = statistics(target.without(*only), two)
    assert tenth["gfp_10"].tolist() == pytest.approx([0.2] * 4)
    # no two alike, where quantiles have kinks
    step = torch.randn(state.cells, dtype=torch.float64, generator=torch.manual_seed(0))
    level = (state.gfp.double() + 0.01 * step.flip(0)).requires_grad_()
    (slope,) = torch.autograd.grad(target.loss(finer(state, level)).sum(), level)
    loss = lambda h: float(target.loss(finer(state, level.detach() + h * step)).sum())
    assert float(slope @ step) == pytest.approx((loss(1e-6) - loss(-1e-6)) / 2e-6, rel=1e-4)
    half = state.with_fields(gfp=0.5 * two.gfp)
    free = Observed.from_state(two, species=["gfp"], quantiles=True, relative=True)
    assert torch.allclose(free.statistics(two), free.statistics(half))
    with pytest.raises(tf.InputError, match=r"Observed\(quantiles\) = True.*species"):
        Observed.from_state(state, quantiles=True)


def test_groups_can_be_left_out(seen):
    state, _ = seen
    target = Observed.from_state(state, species=["gfp"])
    with pytest.raises(tf.InputError, match="not all of the groups"):
        target.without(*target.plan.groups)
    fewer = target.without("density", "gfp neighbours")
    assert not any(n.startswith("density") or n.endswith("neighbours") for n in fewer.plan.names)
    k = [target.plan.names.index(n) for n in fewer.plan.names]
    assert torch.equal(fewer.statistics(state), target.statistics(state)[:, k])
    assert set(fewer.measures(state)) < set(target.measures(state))
    with pytest.raises(tf.InputError, match=r"Observed\.without"):
        target.without("weight")


def test_a_search_fits_a_rate_to_data(tmp_path):
    """The loss of the hidden rate is near 1, that of others is far above."""
    *_, state = tf.simulate(colony(rate=1.5, make=2.0), until=2.5, colonies=4, seed=5)
    target = Observed.from_state(state, species=["gfp"])
    parameters = [Parameter("rate", 0.8, 2.2), Parameter("make", 0.5, 8.0, log=True)]
    task = Task(colony, parameters, target, until=2.5, replicates=3, seed=1)
    points = [task.space.point({"rate": r, "make": m}) for r, m in ((1.5, 2), (0.9, 2), (1.5, 6))]
    loss = Objective(task).evaluate(np.array(points)).loss
    assert loss[0] < 3 < loss[1] and 10 * loss[0] < loss[2]
    search = Search(colony, parameters, target, until=2.5, replicates=2, method="sobol")
    best = search.run(16, progress=False)
    assert "log_cells" not in best.table() and "cells" in best.table()
    assert "pattern" not in best.table()
    head, *lines = best.table().splitlines()
    assert head.endswith("observed")
    seen = {line.split()[0]: line for line in lines}
    k = target.plan.names.index("length_50_um")
    assert seen["length_50_um"].endswith(f"{target.values[k]:.4g} ± {target.spread[k]:.2g}")
    cells = math.exp(target.values[0])
    assert seen["cells"].endswith(f"{cells:.4g} ± {cells * target.spread[0]:.2g}")
    assert ("off most in" in best.table()) == (best.loss > 2.0)
    best.plot(tmp_path / "fit.png")
    far = [Parameter("rate", 1.5, 1.6), Parameter("make", 7.0, 8.0)]
    found = Search(colony, far, target, until=2.5, replicates=2, method="sobol")
    assert "off most in gfp_" in found.run(4, progress=False).table()


def test_colonies_of_another_time_fail(seen):
    target = Observed.from_state(seen[0])
    make = [Parameter("make", 1, 2)]
    with pytest.raises(tf.InputError, match=r"until = 1\.0 .* at least 2\.5 h, when the target"):
        Task(lit, make, target, until=1.0, replicates=1)
    task = Task(lit, make, target, cells=3, replicates=1)  # ends when it ends
    found = Objective(task).evaluate(np.array([[0.5]]))
    assert found.loss[0] == target.failed and "observed at 2.5 h" in found.reasons[0, 0]


def test_its_table_lists_every_statistic(seen):
    target = Observed.from_state(seen[0], species=["gfp"])
    text = target.table()
    assert all(name in text for name in target.plan.names) and "4 observed colonies" in text


# --- bad input ------------------------------------------------------------------------------------

PLACES = {"x": [0.0, 1.0], "y": [0.0, 2.0], "length": [2.0, 3.0]}


@pytest.mark.parametrize(
    "table, options, message",
    [
        (PLACES, {}, "the column 'x' has no unit. Give pixel_size"),
        ({"angle": [1.0], "length_um": [2.0]}, {}, "column 'angle' has no unit"),
        ({"age": [1.0]}, {}, "column 'age' has no unit. Give time_unit"),
        ({"length_px": [20.0]}, {}, "'length_px' is in pixels"),
        ({"length_um": [2.0]}, {"pixel_size": 0.1}, "no column is in pixels"),
        ({"length_um": [2.0]}, {"angle_unit": "degrees"}, "angle_unit = 'degrees'"),
        ({"length_um": [2.0]}, {"length_unit": "um"}, "length_unit = 'um'"),
        (PLACES, {"length_unit": "um", "pixel_size": 0.1}, "pixel_size = 0.1"),
        (PLACES, {"length_unit": "mm"}, "length_unit"),
        (PLACES, {"pixel_size": 0.0}, "pixel_size"),
        ({"x_um": [0.0]}, {}, "lacks the column 'y'"),
        ({"length_um": [2.0]}, {"species": ["gfp"]}, "lacks the column 'gfp'"),
        ({"length_um": [2.0, math.nan]}, {}, "row 2, column 'length_um': 'nan' is not a number"),
        ({"length_um": [2.0, -3.0, -5.0]}, {}, "'length_um': -3 is not 0 or more .in 2 of 3 rows"),
        ({"length_um": [2.0, 0.0]}, {"length_with_caps": True}, "'length_um': 0 is not above 0"),
        ({"length_um": [2.0, 2.0], "age_h": [0.0, -1.0]}, {}, "row 2, column 'age_h': -1 is not"),
        ({"length_um": [2.0], "length_px": [3.0]}, {}, "keep one of them"),
        ({"length_um": [2.0], "x_um": [1.0, 2.0]}, {}, "the same length"),
        ({"length_um": []}, {}, "at least one"),
        ({"weight": [1.0]}, {}, "none of the columns x, y, length"),
        ({"length_um": [2.0]}, {"columns": {"age": "alter_h"}}, "lacks the column 'alter_h'"),
        ({"length_um": [2.0]}, {"columns": {"colour": "c"}}, "columns"),
        ({"length_um": [2.0]}, {"time": 0.0}, "Observed.time"),
        ({"length_um": [2.0]}, {"rings": 0}, "rings"),
        ({"length_um": [2.0]}, {"reach": -1.0}, "reach"),
        (7, {}, "the path of a CSV file"),
    ],
)
def test_bad_tables_are_refused(table, options, message):
    with pytest.raises(tf.InputError, match=message):
        Observed.from_table(table, **options)


@pytest.mark.parametrize("unit", ["um", "µm"])
def test_lengths_may_be_in_micrometres_as_people_write_them(unit):
    seen = Observed.from_table({"length": [2.0, 3.0]}, length_unit=unit)
    assert seen == Observed.from_table({"length_um": [2.0, 3.0]})
    assert str(seen) == seen.table() and len(str(seen).splitlines()) > 5
    with pytest.raises(tf.InputError, match=f'left out with length_unit="{unit}"'):
        Observed.from_table(PLACES, length_unit=unit, pixel_size=0.1)


def test_a_csv_file_is_read_and_its_faults_are_named(tmp_path):
    path = tmp_path / "cells.csv"
    path.write_text("Length_px,alter_min\n20,30\n30,60\n")
    columns = {"length": "Length_px", "age": "alter_min"}
    target = Observed.from_table(path, pixel_size=0.1, columns=columns)
    found = dict(zip(target.plan.names, target.values, strict=True))
    assert found["length_50_um"] == pytest.approx(2.5) and found["age_50_h"] == pytest.approx(0.75)
    for text, message in (
        ("x_um,y_um\n1,2\n1", "line 3"),
        ("x_um,y_um\n1,a\n", "line 2.*'a' is not"),
        ("x_um,y_um,length_um\n1,2,2\n1,5,-2\n", "line 3, column 'length_um': -2 is not 0 or"),
        ("x_um,y_um\n", "has no cell"),
    ):
        path.write_text(text)
        with pytest.raises(tf.InputError, match=message):
            Observed.from_table(path)
    with pytest.raises(tf.InputError, match="cannot be read"):
        Observed.from_table(tmp_path / "none.csv")


def test_round_cells_and_cells_darker_than_their_background_are_observed():
    target = Observed.from_table({"length_um": [0.0, 2.0], "gfp": [-1.0, 3.0]}, species=["gfp"])
    found = dict(zip(target.plan.names, target.values, strict=True))
    assert found["gfp_mean"] == pytest.approx(1.0)


def test_cells_of_a_micrograph_are_observed():
    cells = tf.Cells([[0.0, 0.0], [0.0, 3.0]], [[1.0, 0.0], [1.0, 0.0]], [2.0, 4.0])
    target = Observed.from_table(cells.table())
    found = dict(zip(target.plan.names, target.values, strict=True))
    assert found["length_50_um"] == pytest.approx(3.0)


def test_a_species_that_the_scene_lacks_is_refused():
    target = Observed.from_table({"length_um": [2.0, 3.0], "rfp": [1.0, 2.0]}, species=["rfp"])
    with pytest.raises(tf.InputError, match="rfp"):
        Task(lit, [Parameter("make", 1, 2)], target, until=1.0)


def test_several_frames_of_a_table_are_refused():
    table = {"x_um": [0.0, 5.0, 9.0], "y_um": [0.0, 0.0, 3.0], "Frame": [1, 1, 2]}
    wanted = r"2 frames in the column 'Frame', from 1 to 2.*one frame"
    with pytest.raises(tf.InputError, match=wanted):
        Observed.from_table(table)
    table["Frame"] = [1, 1, 1]
    one = Observed.from_table(table)
    table["Frame"] = [1, 1, 2]
    each = Observed.from_table(table, columns={"colony": "Frame"})
    assert (one.colonies, one.cells) == (1, 3) and (each.colonies, each.cells) == (2, 3)


def test_several_times_of_one_colony_are_refused():
    table = {"x_um": [0.0, 5.0, 9.0], "y_um": [0.0, 0.0, 3.0], "time_h": [1.0, 1.0, 2.0]}
    with pytest.raises(tf.InputError, match=r"2 times in the column 'time_h', from 1.0 to 2.0"):
        Observed.from_table(table)
    apart = Observed.from_table(table | {"colony": ["a", "a", "b"]})
    assert (apart.colonies, apart.cells) == (2, 3)
    with pytest.raises(tf.InputError, match=r"2 times of colony a in the column 'time_h'"):
        Observed.from_table(table | {"colony": ["a", "b", "a"]})


@pytest.mark.parametrize("missing", [None, "", " ", float("nan")])
def test_a_cell_without_a_colony_is_refused(missing):
    table = {"x_um": [0.0, 5.0, 9.0], "y_um": [0.0, 0.0, 3.0]}
    number = 1.0 if isinstance(missing, float) else "1"
    with pytest.raises(tf.InputError, match=r"row 3, column 'colony': the cell has no colony"):
        Observed.from_table(table | {"colony": [number, number, missing]})


def test_space_around_the_name_of_a_colony_is_no_part_of_it():
    table = {"x_um": [0.0, 5.0, 9.0], "y_um": [0.0, 0.0, 3.0], "colony": ["b", " b ", "a"]}
    assert Observed.from_table(table).colonies == 2


def test_a_colony_without_cells(seen, tmp_path):
    """It fails where it is compared, and shows nothing where it is observed."""
    state, _ = seen
    empty = state.remove(state.colony == 1, "left")
    loss = Observed.from_state(state).loss(empty)
    assert loss[1] == Observed.failed and float(loss[[0, 2, 3]].max()) < 10.0
    with pytest.raises(tf.InputError, match=r"colony 1 has no cells.*state.select"):
        Observed.from_state(empty)
    apart = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, 2.0, colony=[0, 2])
    path = tmp_path / "empty.h5"
    for _ in tf.simulate(colony().replace(founders=apart), until=0.5, record=path):
        pass
    with pytest.warns(UserWarning, match=r"colonies 1 of .* have no cells in this frame"):
        assert Observed.from_results(path).colonies == 2
