"""Cell cycles of tracked cells as data, and those of simulated colonies."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from design import (
    Conditions,
    Constrained,
    Measured,
    Objective,
    Observed,
    ObservedCourse,
    ObservedCycles,
    Parameter,
    Search,
    Task,
    Weighted,
)
from design import colonies as runs
from design.growing import FailedColony, FinishedColonies, grow
from design.simulations import simulate_designs
from design.targets.cycles import COLUMNS, FEWEST, CellCycles, CycleStatistics, division_note
from tests.design.searching import fragile, lit
from torchfilm.tools.checks import InputError

EVERY = CycleStatistics(lengths=True, sisters=True, mothers=True, mothers_lengths=True)
CAPS = 4.0 / 3.0 * 0.5  # µm of centreline whose volume is that of the caps


def adder(added=1.6, rate=1.2, noise=0.1):
    return tf.Scene(
        tf.Growth(rate=tf.LogNormal(rate, noise)),
        tf.Division(added=tf.LogNormal(added, 0.1)),
        founders=tf.Cells.single(2, length=2.0),
        dim=2,
        dt=0.05,
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A recorded run, its notes, (T, B, k), and its last state."""
    path = tmp_path_factory.mktemp("cycles") / "run.h5"
    notes = []
    recorder = tf.Recorder(path, adder(), every=1)
    for state in tf.simulate(adder(), until=4.0, colonies=3, seed=7, record=recorder):
        notes.append(division_note(state))
    return path, stacked(notes), state


def results_lineage(path):
    with tf.Results(path) as results:
        return results.lineage()


def stacked(notes):
    widest = max(n.shape[1] for n in notes)
    return torch.stack([torch.nn.functional.pad(n, (0, widest - n.shape[1])) for n in notes])


def tracks(cells, interval=5.0):
    """A lineage of cells that are (number, parent, first minute, minutes, length at birth, growth
    per hour), seen every few minutes from their first on."""
    rows = {"cell": [], "parent": [], "time_min": [], "length_um": []}
    for cell, parent, first, minutes, length, rate in cells:
        for k in range(round(minutes / interval)):
            hours = k * interval / 60
            volume = (length + CAPS) * np.exp(rate * hours)
            values = cell, parent, first + k * interval, volume - CAPS
            for column, value in zip(rows.values(), values, strict=True):
                column.append(value)
    return tf.Lineage.from_table(rows)


def test_notes_of_steps_tell_what_the_lineage_of_a_run_tells(run):
    path, notes, state = run
    lineage = results_lineage(path)
    data = ObservedCycles(lineage)
    assert data.colonies == 3 and data.cycles > 100 and data.time == pytest.approx(4.0)
    each = data.statistics(state, notes).numpy()
    of_runs = EVERY.of(CellCycles.of_lineage(lineage, 0.5), 3)
    np.testing.assert_allclose(each, of_runs, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(each.mean(0), data.values, rtol=1e-9, atol=1e-12)
    found = dict(zip(data.plan.names, data.values, strict=True))
    # what the scene says, within the errors of some hundred cells
    assert found["growth_per_h"] == pytest.approx(1.2, rel=0.04)
    # cells divide as a step ends, half of one late
    late = 0.5 * 0.05 * 1.2 * (found["division_length_um"] + CAPS)
    assert found["added_length_um"] == pytest.approx(1.6 + late, rel=0.03)
    assert found["growth_cv"] == pytest.approx(0.1, rel=0.3)
    assert abs(found["added_length_slope"]) < 0.3 and found["birth_length_mothers"] > 0.3
    # ln 2 / rate is the mean of populations in balance
    assert found["generation_time_h"] == pytest.approx(np.log(2.0) / 1.2, rel=0.2)
    assert data.loss(state, notes).max() < 5.0


def test_cycles_and_relatives_are_those_of_the_tracks():
    cells = [
        (1, 0, 0, 30, 2.0, 1.0),
        (2, 1, 30, 20, 1.0, 1.0), (3, 1, 30, 40, 1.2, 1.2),
        (4, 2, 50, 30, 0.8, 1.4), (5, 2, 50, 10, 0.9, 1.1),
        (6, 4, 80, 20, 0.7, 1.0), (7, 4, 80, 20, 0.7, 1.0), (8, 3, 70, 10, 1.1, 1.0),
        (9, 3, 70, 10, 1.1, 1.0),
    ]  # fmt: skip
    lineage = tracks(cells)
    (rows,) = CellCycles.of_lineage(lineage, 0.5).tables(1)
    # 2, 3 and 4 are born and divide; 5, 8 and 9 are lost
    by = dict(zip(COLUMNS, rows.T, strict=True))
    np.testing.assert_allclose(by["time"], np.array([20, 40, 30]) / 60)
    np.testing.assert_allclose(by["mother time"] * 60, [np.nan, np.nan, 20])
    np.testing.assert_allclose(by["sister time"] * 60, [40, 20, np.nan])
    np.testing.assert_allclose(by["growth"], [1.0, 1.2, 1.4], rtol=1e-9)
    np.testing.assert_allclose(by["mother growth"], [np.nan, np.nan, 1.0], rtol=1e-9)
    # half of 5 min before the first frame, and after the last one
    unseen = np.exp(-np.array([1.0, 1.2, 1.4]) * 2.5 / 60)
    births = (np.array([1.0, 1.2, 0.8]) + CAPS) * unseen - CAPS
    np.testing.assert_allclose(by["birth"], births, rtol=1e-9)
    grown = np.exp(np.array([1.0, 1.2, 1.4]) * np.array([20, 40, 30]) / 60)
    np.testing.assert_allclose(by["division"], (births + CAPS) * grown - CAPS, rtol=1e-9)
    assert np.isnan(by["mother birth"][:2]).all() and by["mother birth"][2] == by["birth"][0]


@pytest.mark.parametrize("every", [2, 5])
def test_simulated_cells_are_seen_in_frames_as_those_of_a_movie(run, every):
    """The frames of a run, as a table of tracked cells, have the statistics of its notes."""
    path, notes, state = run
    rows = {name: [] for name in ("colony", "cell", "parent", "time_h", "length_um")}
    with tf.Results(path) as results:
        for frame in range(0, len(results.times), every):
            table = results.table(frame)
            for name in ("colony", "cell", "parent"):
                rows[name] += table[name].tolist()
            rows["length_um"] += table["length"].tolist()
            rows["time_h"] += [float(results.times[frame])] * len(table["cell"])
    data = ObservedCycles(tf.Lineage.from_table(rows))
    assert data.plan.interval == pytest.approx(0.05 * every) and data.time == pytest.approx(4.0)
    each = data.statistics(state, notes).mean(0)
    np.testing.assert_allclose(each, data.values, rtol=2e-5, atol=2e-5)
    # frames make what cells add vary more
    bare = dict(zip(EVERY.names, EVERY.of(CellCycles.of_notes(notes), 3).mean(0), strict=True))
    found = dict(zip(data.plan.names, data.values, strict=True))
    assert found["added_length_cv"] > 1.02 * bare["added_length_cv"]
    assert found["generation_time_h"] == pytest.approx(bare["generation_time_h"], rel=0.02)


def test_what_no_frame_shows_is_not_known():
    """Of a cell that is in one frame no growth, of one that is in none nothing."""
    division = lambda mother, first: [mother + 1, 2.0, 0.5, first, first + 1, 1.0, 1.0]
    none = [0.0] * 7
    steps = [
        [0.1, *division(0, 1), *none], [0.3, *division(1, 3), *division(2, 5)],
        [0.45, *division(3, 7), *none], [1.2, *division(5, 9), *none],
    ]  # fmt: skip
    notes = torch.tensor(steps, dtype=torch.float64).unsqueeze(1)
    cycles = CellCycles.of_notes(notes, 0.5)
    # 1 and 2 are born at 0.1 and divide at 0.3, 3 at 0.45, before the frame at 0.5; 5 at 1.2
    np.testing.assert_allclose(cycles.time, [np.nan, np.nan, np.nan, 1.0])
    assert np.isnan(cycles.birth[:3]).all() and np.isfinite(cycles.birth[3])
    cycles = CellCycles.of_notes(notes, 0.2)
    np.testing.assert_allclose(cycles.time, [0.2, 0.2, 0.2, 0.8])
    assert np.isnan(cycles.division[:3]).all() and np.isfinite(cycles.division[3])


def test_frames_that_a_track_lacks_are_allowed_for():
    """Of cells that grow by 1/h, some are seen late, and some are lost before they divide."""
    cells = [(1, 0, 0, 30, 2.0, 1.0)]
    for mother, first in ((1, 30), (2, 60), (3, 60)):
        cells += [(len(cells) + k, mother, first, 30, 1.0 + 0.1 * k, 1.0) for k in (1, 2)]
    whole = tracks(cells)
    rows = {"cell": [], "parent": [], "time_min": [], "length_um": []}
    for cell, parent, first, minutes, length, rate in cells:
        kept = range(2 if cell == 2 else 0, round(minutes / 5) - (2 if cell == 3 else 0))
        for k in kept:
            volume = (length + CAPS) * np.exp(rate * k * 5 / 60)
            values = cell, parent, first + 5 * k, volume - CAPS
            for column, value in zip(rows.values(), values, strict=True):
                column.append(value)
    with pytest.warns(UserWarning, match="begin later than a frame"):
        lacking = tf.Lineage.from_table(rows)
    one, other = (CellCycles.of_lineage(x, 0.5).tables(1)[0] for x in (whole, lacking))
    np.testing.assert_allclose(np.sort(one, 0), np.sort(other, 0), rtol=1e-9)


def test_an_adder_a_sizer_and_a_timer_are_told_apart():
    births = np.array([1.0, 1.2, 1.5, 0.9])
    nothing = np.full(4, np.nan)
    at = lambda division: np.stack([np.full(4, 0.5), births, division, *[nothing] * 5], 1)
    names = CycleStatistics(True, False, False, False).names
    slope = lambda rows: EVERY.of_rows(rows)[names.index("added_length_slope")]
    assert slope(at(births + 1.5)) == pytest.approx(0.0, abs=1e-12)
    assert slope(at(np.full(4, 3.0))) == pytest.approx(-1.0)
    assert slope(at(2.0 * births)) == pytest.approx(1.0)
    alike = np.stack([np.full(4, 0.5), np.full(4, 0.1 + 0.2), *[np.full(4, 0.7)] * 6], 1)
    alike[1:, 1] = 0.3  # but for rounding, no length varies
    found = dict(zip(EVERY.names, EVERY.of_rows(alike), strict=True))
    assert found["added_length_slope"] == 0.0 and found["birth_length_mothers"] == 0.0
    assert found["generation_time_cv"] == 0.0


def test_a_colony_has_the_same_statistics_alone_and_beside_others(run):
    _, notes, _ = run
    together = EVERY.of(CellCycles.of_notes(notes), 3)
    for colony in range(3):
        alone = EVERY.of(CellCycles.of_notes(notes[:, [colony]]), 1)
        np.testing.assert_array_equal(alone[0], together[colony])
    mixed = EVERY.of(CellCycles.of_notes(notes[:, [2, 0, 1]]), 3)
    np.testing.assert_array_equal(mixed, together[[2, 0, 1]])
    none = EVERY.of(CellCycles.of_notes(notes[:2]), 3)  # before the first division
    assert np.isnan(none).all()


def test_births_are_noted_in_the_step_in_which_another_colony_fails():
    settings = runs.RunSettings(3, 0.1, torch.float32, "cpu", 1, None, replay=False)

    def cycles(makes):
        prepared = runs.prepare(fragile(torch.tensor(makes)), range(len(makes)), settings)
        events = list(grow(prepared, cells=None, until=2.5, note=division_note))
        (whole,) = (e for e in events if isinstance(e, FinishedColonies))
        failed = [e for e in events if isinstance(e, FailedColony)]
        return failed, EVERY.of(CellCycles.of_notes(whole.history), whole.state.colonies)

    failed, found = cycles([1.0, *[9.0] * 8])
    assert len(failed) == 8
    _, alone = cycles([1.0])
    np.testing.assert_array_equal(found, alone)


@pytest.mark.parametrize("replay", [True, False])
def test_recorded_growth_has_the_same_cycles(replay):
    settings = runs.RunSettings(3, 0.1, torch.float32, "cpu", 2, None, replay)
    prepared = runs.prepare(lit(torch.tensor([1.0, 1.0])), range(2), settings)
    assert bool(prepared.why_regrown) is not replay
    (whole,) = grow(prepared, cells=None, until=1.5, note=division_note)
    found = EVERY.of(CellCycles.of_notes(whole.history), 2)
    assert np.isfinite(found[:, 0]).all()
    told = []
    for state in tf.simulate(lit(torch.tensor([1.0, 1.0])), until=1.5, colonies=2, seed=3):
        told.append(division_note(state))
    np.testing.assert_allclose(found, EVERY.of(CellCycles.of_notes(stacked(told)), 2), rtol=1e-6)


def test_a_search_finds_what_the_cells_add(run):
    path, _, _ = run
    data = ObservedCycles(results_lineage(path))
    added = Parameter("added", 0.9, 2.8, log=True)
    best = Search(adder, [added], data, replicates=2, seed=1).run(64, progress=False)
    assert best.values["added"] == pytest.approx(1.6, rel=0.05)
    assert best.loss < 4.0


def test_a_colony_with_few_cycles_fails_with_the_reason(run):
    path, _, _ = run
    data = ObservedCycles(results_lineage(path))
    slow = Parameter("rate", 0.1, 0.2)
    task = Task(adder, [slow], data, replicates=1)
    found = Objective(task).evaluate(np.array([[0.5]]))
    assert found.reasons[0, 0] == (
        "the target's loss was nan: generation_time_h was not a number, as the colony had fewer"
        " than 3 complete cell cycles, or pairs of relatives"
    )
    simulated = simulate_designs(task, 2)
    assert simulated.reasons[0].startswith("generation_time_h is not a number, as the colony had")


def unmeasured(folder):
    """A lineage without lengths."""
    lines = ["1 0 3 0", "2 4 9 1", "3 4 8 1", "4 10 14 2", "5 10 18 2", "6 9 18 3", "7 9 18 3",
             "8 15 18 4", "9 15 18 4"]  # fmt: skip
    (folder / "man_track.txt").write_text("\n".join(lines), encoding="utf-8")
    return tf.Lineage.from_ctc(folder / "man_track.txt", interval=0.1)


def test_generation_times_alone_where_no_lengths_are_known(tmp_path):
    data = ObservedCycles(unmeasured(tmp_path))
    assert data.plan.names == ("generation_time_h", "generation_time_cv")
    assert data.values == pytest.approx((16 / 30, 0.1 / np.sqrt(3) / (16 / 30)))  # 6, 5 and 5


def test_groups_are_left_out(run):
    path, notes, state = run
    data = ObservedCycles(results_lineage(path))
    less = data.without("growth", "sisters")
    assert "growth_per_h" not in less.plan.names and "growth" in data.plan.groups
    kept = [data.plan.names.index(n) for n in less.plan.names]
    assert less.values == tuple(data.values[k] for k in kept)
    np.testing.assert_array_equal(
        less.statistics(state, notes), data.statistics(state, notes)[:, kept]
    )
    with pytest.raises(InputError, match="growth time"):
        data.without("growth time")
    with pytest.raises(InputError, match="not all of the groups"):
        data.without(*data.plan.groups)


def test_what_is_refused(run, tmp_path):
    path, _, _ = run
    lineage = results_lineage(path)
    for wrong in (3.0, [], [lineage, None], "cells.csv"):
        with pytest.raises(InputError, match=r"a tf\.Lineage, such as .* or a list of them"):
            ObservedCycles(wrong)
    few = tracks([(1, 0, 0, 30, 2.0, 1.0), (2, 1, 30, 20, 1.0, 1.0), (3, 1, 30, 40, 1.2, 1.2)])
    with pytest.raises(
        InputError, match=f"colony 0 = 0 is not allowed: it must be at least {FEWEST}"
    ):
        ObservedCycles(few)
    timed = ObservedCycles(unmeasured(tmp_path))
    with pytest.raises(InputError, match="of statistics that these data have"):
        ObservedCycles(unmeasured(tmp_path), like=ObservedCycles(lineage))
    assert ObservedCycles(lineage, like=timed).plan.names == timed.plan.names
    data = ObservedCycles(lineage)
    with pytest.raises(InputError, match="an Observed or a Measured"):
        ObservedCourse([data, data])
    with pytest.raises(InputError, match="an ObservedCycles, or None"):
        ObservedCycles(lineage, like=Observed.from_state(run[2]))
    with pytest.raises(InputError, match="above 0"):
        ObservedCycles(lineage, radius=0.0)
    with pytest.raises(InputError, match="notes of all steps"):
        data.statistics(run[2])


def test_movies_that_differ_are_refused():
    family = [(1, 0, 0, 30, 2.0, 1.0)]
    for mother, first in ((1, 30), (2, 60), (3, 60), (4, 90), (5, 90), (8, 120)):
        family += [(len(family) + k, mother, first, 30, 1.0, 1.0) for k in (1, 2)]
    rows = lambda shift, end: [(c, p, f + shift, m, b, r) for c, p, f, m, b, r in family if f < end]
    whole = tracks(rows(0, 999))
    assert ObservedCycles([whole, tracks(rows(180, 999))]).time == pytest.approx(whole.now)
    with pytest.raises(InputError, match=r"colony 0 of lineages\[1\], seen for .* as long as each"):
        ObservedCycles([whole, tracks(rows(0, 120))])
    assert ObservedCycles([whole, tracks(rows(0, 120))], time=2.0).time == 2.0
    with pytest.raises(InputError, match="the same interval between frames"):
        ObservedCycles([whole, tracks(rows(0, 999), interval=10.0)])
    for make in (ObservedCycles.from_results, ObservedCycles.from_table):
        with pytest.raises(InputError, match="made of a lineage"):
            make("run.h5")


def varied_family():
    """Cells that divide every half an hour, each pair of sisters with a growth rate of its own."""
    family = [(1, 0, 0, 30, 2.0, 1.0)]
    for mother in range(1, 40):
        first = family[mother - 1][2] + 30
        family += [(len(family) + k, mother, first, 30, 1.0, 1.0 + 0.01 * mother) for k in (1, 2)]
    return family


def test_relatives_that_only_some_colonies_have_are_told():
    rich = varied_family()
    lineage = tracks(rich)
    few = tracks([row for row in rich if row[2] < 120])
    told = [
        pytest.warns(UserWarning, match=f"{who} are not compared: of the 2 colonies, one has")
        for who in ("mothers and daughters", "sisters")
    ]
    with told[0], told[1]:
        data = ObservedCycles([lineage, few], time=2.5)
    assert "mothers" not in data.plan.groups


def test_several_lineages_are_replicates(run):
    path, _, _ = run
    lineage = results_lineage(path)
    both = ObservedCycles([lineage, lineage])
    one = ObservedCycles(lineage)
    assert both.colonies == 6 and both.cycles == 2 * one.cycles
    np.testing.assert_allclose(both.values, one.values)


def test_cells_of_another_width_are_warned_of(run):
    path, _, state = run
    with tf.Results(path) as results:
        data = ObservedCycles(results.lineage(), radius=0.4)
    with pytest.warns(UserWarning, match=r"0\.80 µm wide"):
        data.check(state)


# --- beside others ---------------------------------------------------------------------------


def losses(target, points, **options):
    task = Task(adder, [Parameter("added", 1.2, 2.0)], target, replicates=1, seed=3, **options)
    return Objective(task).evaluate(np.array([[x] for x in points])).loss


def test_cycles_beside_other_targets_have_the_same_loss(run):
    """Whose notes have other numbers of columns in each step, alone and in a batch."""
    path, _, _ = run
    data = ObservedCycles(results_lineage(path))
    bare = losses(data, (0.2, 0.5, 0.9))
    cells = lambda state: state.counts.double()
    count = Measured({"n": cells}, wanted={"n": 60.0}, spread={"n": 9.0}, time=4.0)
    other = losses(count, (0.2, 0.5, 0.9))
    weighted = Weighted([(data, 1.0), (count, 0.5), (data, 2.0)])
    together = losses(weighted, (0.2, 0.5, 0.9))
    expected = losses(Weighted([(data, 3.0), (count, 0.5)]), (0.2, 0.5, 0.9))
    np.testing.assert_allclose(together, expected, rtol=1e-12)
    assert together.tolist() == [float(losses(weighted, [x])[0]) for x in (0.2, 0.5, 0.9)]
    share = together / (3.0 * bare + 0.5 * other)  # of sums of weights, or not
    np.testing.assert_allclose(share, share[0], rtol=1e-9)
    bound = Constrained(data, at_most={"generation_time_h": 9.0})
    np.testing.assert_allclose(losses(bound, (0.2, 0.9)), bare[[0, 2]], rtol=1e-12)


def test_residuals_beside_others_add_up_to_the_loss():
    """Also of cells that are more than a µm long at birth."""
    founders = tf.Cells.single(2, length=5.0)
    division = tf.Division(length=tf.Uniform(6.0, 7.0))
    scene = tf.Scene(tf.Growth(rate=1.2), division, founders=founders, dim=2, dt=0.05)
    notes, model = [], scene.bind(2, seed=1)
    state = model.start()
    births = []
    one = ObservedCycles(tracks(varied_family()), time=4.0)
    both = Weighted([(one, 1.0), (one, 2.0)])
    for _ in range(80):
        state = model.step(state)
        notes.append(both.note(state))
        births += [b.length for b in state.births]
    assert torch.cat(births).min() > 2.0
    apart = both.residuals(state, stacked(notes))
    torch.testing.assert_close((apart * apart).sum(1), both.loss(state, stacked(notes)))


def test_cycles_under_conditions(run):
    path, _, _ = run
    data = ObservedCycles(results_lineage(path))
    both = Conditions([({"noise": 0.1}, data), ({"noise": 0.2}, data)])
    task = Task(adder, [Parameter("added", 1.2, 2.0)], both, replicates=1, seed=3)
    found = Objective(task).evaluate(np.array([[0.5], [0.9]]))
    assert not found.reasons and found.loss[0] < found.loss[1]
    grown = simulate_designs(task, 3)
    assert not grown.reasons and np.isfinite(grown.statistics).all()
    slow = Task(adder, [Parameter("rate", 0.1, 0.2)], both, replicates=1)
    reason = simulate_designs(slow, 1).reasons[0]
    assert "generation_time_h (noise = 0.1) is not a number, as the colony had fewer" in reason
    one = Conditions([({"rate": 1.2}, data), ({"rate": 0.15}, data)])
    found = Objective(Task(adder, [Parameter("added", 1.2, 2.0)], one, replicates=2)).evaluate(
        np.array([[0.5]])
    )
    for replicate in range(2):
        reason = found.reasons[0, replicate]
        assert reason.startswith(
            "where rate = 0.15: the target's loss was nan: generation_time_h (r"
        )
        assert "generation_time_h (rate = 0.15) was not a number, as the colony had fewer" in reason
    short = ObservedCycles(results_lineage(path), time=3.0)
    with pytest.raises(InputError, match=r"time of ObservedCycles = 3\.0 .* 4 h, as of the others"):
        Conditions([({"noise": 0.1}, data), ({"noise": 0.2}, short)])


def test_measures_of_failed_colonies_are_asked_for_once(run, monkeypatch):
    path, _, _ = run
    data = ObservedCycles(results_lineage(path))
    asked, measures = [], ObservedCycles.measures
    monkeypatch.setattr(
        ObservedCycles, "measures", lambda *given: asked.append(1) or measures(*given)
    )
    task = Task(adder, [Parameter("rate", 0.1, 0.2)], data, replicates=1)
    found = Objective(task).evaluate(np.linspace(0.0, 1.0, 12)[:, None])
    assert len(found.reasons) == 12 and len(asked) <= 2


def test_spreads_are_those_of_cycles_that_are_drawn_again(run):
    """A mean varies by the spread of cells over the root of their number; each statistic has a
    least spread of its own units."""
    path, _, _ = run
    lineage = results_lineage(path)
    (own, *_) = CellCycles.of_lineage(lineage, 0.5).tables(3)
    drawn = dict(zip(EVERY.names, EVERY.resampled_spread(own), strict=True))
    time = own[:, COLUMNS.index("time")]
    assert drawn["generation_time_h"] == pytest.approx(time.std() / len(time) ** 0.5, rel=0.2)
    data = ObservedCycles(lineage)
    spread = dict(zip(data.plan.names, data.spread, strict=True))
    assert spread["division_length_cv"] < 0.02 < spread["division_length_um"]
    alone = ObservedCycles(tracks(varied_family()))
    own = CellCycles.of_lineage(tracks(varied_family()), 0.5).tables(1)[0]
    by = dict(zip(alone.plan.names, alone.plan.resampled_spread(own), strict=True))
    assert dict(zip(alone.plan.names, alone.spread, strict=True))["growth_cv"] == pytest.approx(
        by["growth_cv"]
    )
    less = data.without("growth")
    assert less.spread == tuple(spread[name] for name in less.plan.names)
    assert data.cells == int((lineage.fate == "alive").sum())
