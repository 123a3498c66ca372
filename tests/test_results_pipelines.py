"""Results and tables in scripts of data frames: nothing is taken for something else unsaid."""

from __future__ import annotations

import inspect
import os
import warnings

import numpy as np
import pandas as pd
import pytest
import torch

import torchfilm as tf

RATES = (0.5, 1.5)


def growing(rates=RATES) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=tf.PerColony(list(rates))), tf.Division(length=4.0), tf.Mechanics(dim=2),
        dt=0.1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def swapped(tmp_path_factory):
    """A run of two colonies in another order, by ids 1 and 0."""
    path = tmp_path_factory.mktemp("runs") / "run.h5"
    state = growing().bind(seed=1).start().select([1, 0])
    tf.simulate(growing(), state, until=1.0, record=tf.Recorder(path, growing(), every=2)).last()
    return path


def test_several_frames_make_one_table(swapped):
    with tf.Results(swapped) as results:
        whole = results.to_pandas()
        for some in ([0, 2], (1,), range(1, 4), np.flatnonzero(results.times > 0.3), [1, -1]):
            chosen = [int(k) % len(results) for k in some]
            wanted = whole[whole.frame.isin(chosen)].reset_index(drop=True)
            pd.testing.assert_frame_equal(results.to_pandas(some), wanted)
        with pytest.raises(tf.InputError, match=r"^frame = .*numpy\.flatnonzero\(mask\)"):
            results.table(results.times > 0.3)
        for wrong in ([], [99], [1, 0], [0, 0], [True], [0.5], "last", np.array([0.5])):
            with pytest.raises(tf.InputError, match="frame"):
                results.table(wrong)


def test_frames_are_not_asked_for_by_time(swapped):
    with tf.Results(swapped) as results:
        for ask in (results.to_pandas, results.parameters, results.colony_fields, results.grid):
            with pytest.raises(tf.InputError, match=r"Frames go by number: .*results\.times"):
                ask(time=0.2)


def test_a_closed_file_says_so_whatever_is_asked(swapped):
    with tf.Results(swapped) as results:
        pass
    asked = [n for n, _ in inspect.getmembers(tf.Results, lambda x: isinstance(x, property))]
    assert "attributes" in asked and "signal_names" in asked
    for name in asked:
        with pytest.raises(tf.InputError, match=r"run\.h5 is closed: read inside"):
            getattr(results, name)
    for ask in (
        results.frame, results.table, results.lineage, results.grid, results.refresh, results.cells,
        lambda: results.signal("ahl"), lambda: results.state(growing()), lambda: len(results),
    ):  # fmt: skip
        with pytest.raises(tf.InputError, match=r"run\.h5 is closed: read inside"):
            ask()
    assert "closed" in repr(results)
    results.close()


def test_a_relative_path_is_followed_from_another_folder(swapped, tmp_path, monkeypatch):
    monkeypatch.chdir(swapped.parent)
    with tf.Results(swapped.name) as results:
        monkeypatch.chdir(tmp_path)
        assert not os.path.exists(swapped.name)
        results.refresh()
        assert len(results.times) == 6


def test_cells_of_other_colonies_are_remarked_on(swapped):
    """Values per colony go by places, which had been unsaid."""
    with tf.Results(swapped) as results:
        with pytest.warns(UserWarning, match=r"ids 1, 0; its cells become those of .* 0 to 1"):
            cells = results.cells(-1)
        rates = results.frame(-1)["growth_rate"]
    assert growing(RATES[::-1]).bind(cells=cells).start().growth_rate.tolist() == rates.tolist()


def test_cells_without_those_of_a_last_colony_are_remarked_on(tmp_path):
    path = tmp_path / "run.h5"
    scene = growing((1.0, 1.0, 1.0))
    run = tf.simulate(scene, until=0.4, record=tf.Recorder(path, scene, every=1))
    state = next(run)
    run.send(state.remove(state.colony == 2, "removed"))
    run.last()
    with tf.Results(path) as results:
        with pytest.warns(UserWarning, match=r"last 1 of the run's 3 colonies.*colonies=3"):
            cells = results.cells(-1)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            results.cells(0)
    assert cells.colonies == 2
    with pytest.warns(UserWarning, match="colony 2 of 3 stays empty"):
        assert scene.bind(colonies=3, cells=cells).batch.colonies == 3


def seen(**changes) -> pd.DataFrame:
    """Colony 0 is seen for 40 minutes, colony 1 for 20."""
    rows = {"cell": [1] * 5 + [1] * 3, "colony": [0] * 5 + [1] * 3, "parent": [-1] * 8}
    rows["time_min"] = [0, 10, 20, 30, 40, 0, 10, 20]
    return pd.DataFrame({**rows, **changes})


def test_a_movie_that_ends_before_others_is_remarked_on():
    """A colony that died out had counted as alive, unsaid."""
    with pytest.warns(UserWarning, match=r"colony 1 ends.*0\.333333 h of 0\.666667.*end=0\.666667"):
        assert tf.Lineage.from_table(seen()).fate.tolist() == ["alive", "alive"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tree = tf.Lineage.from_table(seen(), end=40 / 60)
        later = tf.Lineage.from_table(seen(), end=2.0)
        tf.Lineage.from_table(seen()[:5])
        tf.Lineage.from_table(seen(time_min=[0, 10, 20, 30, 40, 5, 15, 25]))  # a movie of its own
    assert tree.fate.tolist() == ["alive", "lost"] and tree.now == pytest.approx(40 / 60)
    assert tree.ended[1] == pytest.approx(20 / 60)
    assert later.fate.tolist() == ["lost", "lost"] and later.now == 2.0
    with pytest.raises(
        tf.InputError, match=r"Lineage\.from_table\(end\) = 0\.5.*at least 0\.666667"
    ):
        tf.Lineage.from_table(seen(), end=0.5)
    assert tf.Lineage.from_table(seen(), end=0.666666).now == 40 / 60
    before = seen(time_min=[-300.0 - 10.0 * k for k in (4, 3, 2, 1, 0, 4, 3, 2)])
    assert tf.Lineage.from_table(before, end=-5.0).fate.tolist() == ["alive", "lost"]


def test_tracks_of_a_challenge_end_where_the_movie_did(tmp_path):
    path = tmp_path / "man_track.txt"
    path.write_text("1 0 3 0\n2 4 6 1\n3 4 6 1\n")
    read = lambda **given: tf.Lineage.from_ctc(path, interval=0.5, **given).fate.tolist()
    assert read() == ["divided", "alive", "alive"]
    assert read(end=5.0) == ["divided", "lost", "lost"]
    with pytest.raises(tf.InputError, match=r"from_ctc\(end\) = 1.*at least 3"):
        read(end=1.0)
    with pytest.raises(tf.InputError, match="from_ctc: missing a required argument: 'interval'"):
        tf.Lineage.from_ctc(path)


@pytest.mark.parametrize("kind", ["timedelta64[ns]", "datetime64[ns]", "timedelta64[m]"])
def test_times_of_the_clock_are_no_hours(kind):
    """Their nanoseconds had been taken for hours."""
    clock = np.arange(8).astype(kind)
    for columns in (seen(time_min=clock), dict(seen(time_min=clock))):
        with pytest.raises(tf.InputError, match=r"'time_min' has .*64.*Timedelta\('1h'\)"):
            tf.Lineage.from_table(columns)
    place = {"x_um": [0.0] * 8, "y_um": np.arange(8) * 5.0, "angle_rad": [0.0] * 8}
    with pytest.raises(tf.InputError, match=r"'when' has .*64"):
        tf.Cells.from_table({**place, "length_um": [2.0] * 8, "when": clock}, fields=["when"])


def test_whole_numbers_that_floats_round_are_remarked_on():
    cells = tf.Cells(
        [[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, length=[2.0] * 2, radius=[0.5] * 2,
        extra={"track": [2**24, 2**24 + 1], "level": [0.1, 1e11]},
    )  # fmt: skip
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), founders=cells, dt=0.1)
    with pytest.warns(UserWarning, match=r"'track' has .*16777216 and 16777217.*float64"):
        scene.bind().start()
    huge = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [1.0, 0.0], extra={"total": [1e39, 2e39]})
    with pytest.warns(UserWarning, match=r"'total' has whole numbers that float32 cannot tell"):
        scene.bind(cells=huge)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exact = scene.bind(dtype=torch.float64).start()
    assert exact.track.tolist() == [2**24, 2**24 + 1]
    state = exact.with_fields(track=torch.tensor([5, 2**53]))
    assert state.track.tolist() == [5, 2**53]
    with pytest.raises(tf.InputError, match=r"field 'track' = 9007199254740993.*float64 can hold"):
        exact.with_fields(track=torch.tensor([5, 2**53 + 1]))
    plain = tf.Scene(tf.Growth(rate=1.0), dim=2, dt=0.1).bind(2).start()
    with pytest.raises(tf.InputError, match=r"field 'growth_rate' = 2e\+300.*float32 can hold"):
        plain.with_fields(growth_rate=torch.tensor([1.0, 2e300], dtype=torch.float64))
    each = torch.func.vmap(lambda x: plain.with_fields(growth_rate=x).growth_rate)
    assert each(torch.tensor([[1, 2], [3, 4]])).tolist() == [[1.0, 2.0], [3.0, 4.0]]


def plain() -> tf.Scene:
    return tf.Scene(tf.Growth(rate=1.0), tf.Division(length=tf.Normal(4.0, 0.4)), dim=2, dt=0.05)


def edited(tmp_path, edit, **field):
    """A run whose state is edited after its first step, and what it leaves."""
    path, scene = tmp_path / "run.h5", plain()
    state = scene.bind().start()
    state = state.declare(tf.Field("dose", "", **field)) if field else state
    run = tf.simulate(scene, state, until=0.5, record=tf.Recorder(path, scene, every=1))
    state = next(run)
    try:
        run.send(edit(state))
    finally:
        with tf.Results(path) as results:
            assert len(results) == 2 and results.table()["frame"].tolist() == [0, 1]


@pytest.mark.parametrize("scope", ["cell", "colony"])
def test_columns_neither_come_nor_go(tmp_path, scope):
    """The file had been unreadable, unsaid."""
    without = lambda s: s.replace(fields={n: x for n, x in s.fields.items() if n != "dose"})
    with pytest.raises(tf.SimulationError, match=r"field 'dose' of .*run\.h5 is gone from"):
        edited(tmp_path, without, scope=scope)
    (tmp_path / "run.h5").unlink()
    with pytest.raises(tf.SimulationError, match=r"field 'dose' appeared during the run"):
        edited(tmp_path, lambda s: s.declare(tf.Field("dose", "", scope=scope)))


def test_a_medium_does_not_come_into_a_file(tmp_path):
    medium = tf.Medium(food=tf.Signal(10.0), box=((-9, -9), (9, 9)), spacing=3.0)
    fed = plain().replace(*plain().effects, medium)
    with pytest.raises(tf.SimulationError, match=r"signal 'food' appeared during the run"):
        edited(tmp_path, fed.take_over)


@pytest.mark.parametrize("change", [{"stream": torch.tensor([5])}, {"seed": 5}])
def test_a_recorded_run_draws_from_one_stream(tmp_path, change):
    """Resumed, it had been another one."""
    with pytest.raises(tf.InputError, match=r"other random numbers at step 2 .*seed.*streams"):
        edited(tmp_path, lambda s: s.replace(**change))


def test_a_resumed_file_keeps_its_interval_from_its_first_frame(tmp_path):
    path, scene = tmp_path / "run.h5", plain()
    state = tf.simulate(scene, until=0.15).last()
    tf.simulate(scene, state, until=0.4, record=tf.Recorder(path, scene, every=4)).last()
    record = tf.Recorder(path, scene, append=True)
    for until, steps in ((0.8, [3, 7, 8, 11, 15, 16]), (1.0, [3, 7, 8, 11, 15, 16, 19, 20])):
        with tf.Results(path) as results:
            state = results.state(scene)
        last = tf.simulate(scene, state, until=until, record=record).last()
        with tf.Results(path) as results:
            assert results.steps.tolist() == steps
            assert torch.equal(results.state(scene).length, last.length)
    with pytest.raises(tf.InputError, match="streams"):
        other = last.replace(stream=last.stream + 5)
        tf.simulate(scene, other, until=2.0, record=tf.Recorder(path, scene, append=True)).last()
