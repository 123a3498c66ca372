"""Tables of results: a row for each cell, values per colony as columns, internals on request."""

from __future__ import annotations

import builtins
import math
import shutil

import h5py
import numpy as np
import pytest
import torch
from recorded import DT, make_scene, record

import torchfilm as tf
from torchfilm.io.parameters import column_names
from torchfilm.physics import capsule


def designs(rates=(0.8, 1.2), k=(1.0, 2.0), **others) -> tf.Scene:
    """Two colonies that differ by the growth rate, the length at division and a constant of the
    circuit."""

    def circuit(u, s, p, cell):
        return {"gfp": p.k - p.g * u.gfp}, {"ahl": 1.0 + 0.0 * u.gfp}

    return tf.Scene(
        tf.Growth(rate=torch.tensor(rates)),
        tf.Division(length=tf.PerColony([3.0, 3.5])),
        tf.Circuit(circuit, species=("gfp",), k=torch.tensor(k), g=0.1),
        tf.Medium(ahl=tf.Signal(diffusion=10.0), box=((-16.0, -16.0), (16.0, 16.0)), spacing=4.0),
        tf.Mechanics(dim=2),
        dt=DT,
        **others,
    )


def test_the_table_has_a_row_for_each_cell(whole):
    path, states = whole
    with tf.Results(path) as results:
        table, last = results.table(), results.table(-1)
        total = int(results.counts.sum())
    assert {len(v) for v in table.values()} == {total}
    first = ["frame", "time", "colony", "cell", "parent", "x", "y", "angle", "length", "radius"]
    assert list(table)[:13] == [*first, "volume", "age", "born"]
    assert set(list(table)[13:]) == {"mark", "growth_rate", "division_threshold"}
    assert all(v.ndim == 1 for v in table.values())
    assert np.array_equal(np.unique(table["frame"]), np.arange(10))
    state = states[-1]
    assert np.array_equal(last["x"], state.position[:, 0].numpy())
    assert np.array_equal(last["colony"], state.colony.numpy())
    assert np.array_equal(last["cell"], state.uid.numpy())
    assert (last["time"] == state.time).all()
    assert np.allclose(np.cos(last["angle"]), state.axis[:, 0].numpy(), atol=1e-6)
    assert np.allclose(last["volume"], state.volume.numpy(), rtol=1e-6)


def test_ages_are_hours_since_birth(whole):
    path, states = whole
    seen: dict = {}
    for state in states:
        for key in zip(state.colony.tolist(), state.uid.tolist(), strict=True):
            seen.setdefault(key, state.time)
    with tf.Results(path) as results:
        table = results.table()
    keys = list(zip(table["colony"].tolist(), table["cell"].tolist(), strict=True))
    assert np.allclose(table["born"], [seen[key] for key in keys], rtol=0, atol=1e-9)
    assert np.allclose(table["age"], table["time"] - table["born"])
    assert table["age"].max() > 0.3 and table["age"].min() >= 0


def test_internals_are_shown_on_request(whole):
    with tf.Results(whole[0]) as results:
        table, every = results.table(-1), results.table(-1, internals=True)
    more = {"axis_x", "axis_y", "displacement_0", "elongation", "divide_flag", "contact_alpha"}
    assert more <= set(every) - set(table)
    assert all(np.array_equal(table[name], every[name]) for name in table)


@pytest.mark.parametrize("internals", [False, True])
def test_the_table_of_a_state_is_that_of_its_frame(tmp_path, internals):
    path, scene = tmp_path / "run.h5", designs()
    last = record(scene, scene.bind(2).start(), path, until=1.0)[-1]
    with tf.Results(path) as results:
        recorded = results.table(-1, internals=internals)
    found = tf.cell_table(last, internals=internals)
    not_known = {"frame", "age", "born", "rate", "k", "Division.length"}
    assert [n for n in recorded if n not in not_known] == list(found)
    assert all(np.array_equal(recorded[n], x) for n, x in found.items())


def test_a_table_may_be_changed_and_its_state_not():
    state = tf.scenes.microcolony().bind(2).start()
    for column in tf.cell_table(state, internals=True).values():
        column[:] = 9
    assert float(state.length.max()) < 9 and state.parent.tolist() == [-1, -1]


def test_a_table_is_of_a_state():
    with pytest.raises(tf.InputError, match=r"cell_table\(state\) = 3 .*a tf\.State"):
        tf.cell_table(3)


def test_values_per_colony_come_back_as_columns(tmp_path):
    path, scene = tmp_path / "run.h5", designs()
    states = record(scene, scene.bind(2).start(), path, until=1.0)
    with tf.Results(path) as results:
        table = results.table()
        assert set(results.parameters()) == {
            "Growth.rate",
            "Division.length",
            "Circuit.parameters['k']",
        }
    for name, values in (("rate", [0.8, 1.2]), ("k", [1, 2]), ("Division.length", [3, 3.5])):
        assert np.allclose(table[name], np.asarray(values)[table["colony"]]), name
    last = states[-1]
    mine = table["frame"] == table["frame"].max()
    assert np.array_equal(table["out.ahl"][mine], last.contact().found["ahl"].numpy())
    assert np.array_equal(table["gfp"][mine], last.gfp.numpy()) and table["out.ahl"].max() > 0


def test_a_selection_of_colonies_keeps_its_values(tmp_path):
    scene = designs()
    record(scene, scene.bind(2).start().select([1]), tmp_path / "run.h5", until=0.5)
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.parameters()["Growth.rate"].tolist() == [pytest.approx(1.2)]
        assert set(results.table()["k"]) == {2.0}


def test_values_that_a_resumed_run_changed_stay_those_of_the_earlier_frames(tmp_path):
    path, scene = tmp_path / "run.h5", designs()
    record(scene, scene.bind(2).start(), path, until=0.5, every=5)
    with tf.Results(path) as results:
        frames = len(results)
        state = results.state(scene)
    record(scene, state, path, until=1.0, append=True)
    other = designs(k=(5.0, 6.0))
    with tf.Results(path) as results:
        same, state = len(results), results.state(other, changed=True)
    record(other, state, path, until=1.5, append=True, changed=True)
    with tf.Results(path) as results:
        assert frames < same < len(results)
        seen = [results.parameters(k)["Circuit.parameters['k']"][0] for k in range(len(results))]
        table = results.table()
    assert seen == [1.0] * same + [5.0] * (len(seen) - same)
    assert np.array_equal(table["k"], np.where(table["frame"] < same, 1.0, 5.0) + table["colony"])


def as_earlier(path, tmp_path):
    """The file as an earlier version wrote it: long chunks, in which frame follows frame."""
    old = tmp_path / "old.h5"
    with h5py.File(path, "r") as source, h5py.File(old, "w", libver="latest") as file:

        def copy(name, item):
            group = name.split("/")[0]
            if isinstance(item, h5py.Group) or group in ("parameters", "signals_at_cells"):
                return
            if group == "cells" or group == "signals":
                first = source["frames/first_row" if group == "cells" else first_voxel][:]
                rows = [item[a:b] for a, b in zip(first, first + sizes[group], strict=True)]
                data, chunk = np.concatenate(rows), 8192
            else:
                data, chunk = item[...], 64
            if name in ("frames/first_row", first_voxel):
                size = sizes["cells" if name == "frames/first_row" else "signals"]
                data = np.cumsum(size) - size
            chunks = (chunk, *data.shape[1:]) if item.chunks else None
            longest = (None, *data.shape[1:]) if item.chunks else None
            packed = "gzip" if item.chunks else None
            about = {"chunks": chunks, "maxshape": longest, "compression": packed}
            file.create_dataset(name, data=data, **about)

        first_voxel = "frames/grid/first_voxel"
        sizes = {
            "cells": source["frames/counts"][:].sum(1),
            "signals": source["frames/grid/shape"][:].prod(2).sum(1),
        }
        source.visititems(copy)
        for name, value in source.attrs.items():
            if name != "internal":
                file.attrs[name] = value
    return old


def test_files_of_earlier_versions_are_read_and_resumed(tmp_path):
    path, scene = tmp_path / "run.h5", designs()
    record(scene, scene.bind(2).start(), path, until=0.5, every=5)
    with tf.Results(path) as results:
        now = results.table()
    old = as_earlier(path, tmp_path)
    with tf.Results(old) as results:
        assert results.parameters() == {} and results.signals_at_cells() == {}
        table, state = results.table(), results.state(scene)
        assert set(now) - set(table) == {"rate", "k", "Division.length", "out.ahl"}
        assert set(table) < set(now)
    record(scene, state, old, until=1.0, append=True)
    with tf.Results(old) as results:
        table = results.table()
    before = table["frame"] < now["frame"].max() + 1
    assert np.array_equal(np.isnan(table["out.ahl"]), before) and not before.all()
    assert np.array_equal(table["k"], table["colony"] + 1.0)


def test_round_walls_of_earlier_versions_are_read_and_resumed(tmp_path):
    """Their `centre` was called center."""
    path = tmp_path / "run.h5"
    walls = [tf.Sphere(centre=(1.0, 0.0), radius=9.0), tf.Plane(y=-5.0, facing="+y")]
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2, walls=walls))
    tf.simulate(scene, until=0.2, record=path).last()
    with tf.Results(path) as results:
        now = results.walls
    with h5py.File(path, "a") as file:
        for name in ("walls", "effects"):
            assert "centre" in file.attrs[name]
            file.attrs[name] = file.attrs[name].replace("centre", "center")
    with tf.Results(path) as results:
        assert results.walls == now and now[0]["centre"] == [1.0, 0.0]
        state = results.state(scene)
    tf.simulate(scene, state, until=0.4, record=tf.Recorder(path, scene, append=True)).last()
    tf.show(path, out=tmp_path / "run.png")


def test_a_field_named_as_a_column_is_kept_beside_it(tmp_path):
    def update(cells):
        cells.age = cells.age + 1.0

    scene = tf.Scene(tf.Rules(update, variables={"age": 0.0}), tf.Growth(rate=1.0), dim=3, dt=0.1)
    record(scene, scene.bind().start(), tmp_path / "run.h5", until=0.5)
    with tf.Results(tmp_path / "run.h5") as results:
        table = results.table(-1)
    assert table["field.age"].tolist() == [5.0] and table["age"].tolist() == [pytest.approx(0.5)]


def test_components_are_numbered_in_their_order():
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2), dim=2, dt=0.1)
    state = scene.bind().start()
    state = state.with_fields(displacement=torch.tensor([[1.0, 2.0, 3.0, 4.0]]))
    table = tf.cell_table(state, internals=True)
    seen = [table[f"displacement_{k}"].tolist() for k in range(4)]
    assert seen == [[1.0], [2.0], [3.0], [4.0]]


def test_the_tilt_of_an_axis_that_points_down_is_below_0():
    cells = tf.Cells([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], [[0.6, 0.0, -0.8], [0.0, 0.6, 0.8]], 2.0)
    table = tf.cell_table(tf.Scene(tf.Growth(rate=1.0), founders=cells).bind().start())
    steep = np.arcsin(0.8)
    assert table["tilt"].tolist() == pytest.approx([-steep, steep])
    assert table["angle"].tolist() == pytest.approx([0.0, np.pi / 2])


def test_space_has_a_tilt(tmp_path):
    axis = np.array([[1.0, 1.0, math.sqrt(2.0)]])
    cells = tf.Cells([[0.0, 0.0, 0.0]], axis / np.linalg.norm(axis), 2.0)
    scene = tf.Scene(tf.Growth(rate=1.0), founders=cells, dt=0.1)
    record(scene, scene.bind().start(), tmp_path / "run.h5", until=0.2)
    with tf.Results(tmp_path / "run.h5") as results:
        table = results.table(-1)
    assert table["angle"] == pytest.approx(math.pi / 4) == table["tilt"] and "z" in table
    assert table["volume"] == pytest.approx(
        float(capsule.volume(torch.tensor(table["length"][0]), torch.tensor(0.5)))
    )


def test_a_data_frame_has_the_columns_of_the_table(whole):
    pandas = pytest.importorskip("pandas", reason="the extra tables")
    with tf.Results(whole[0]) as results:
        frame, table = results.to_pandas(), results.table()
        assert list(frame.columns) == list(table) and isinstance(frame, pandas.DataFrame)
        assert all(np.array_equal(frame[name], table[name]) for name in table)
        assert len(results.to_pandas(frame=-1)) == int(results.counts[-1].sum())
        assert "divide_flag" in results.to_pandas(-1, internals=True)


def test_a_missing_extra_is_named(whole, monkeypatch):
    def no_pandas(name, *args, **kwargs):
        if name in ("pandas", "networkx"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    real = builtins.__import__
    monkeypatch.setattr("torchfilm.io.table.import_module", no_pandas)
    with tf.Results(whole[0]) as results:
        with pytest.raises(tf.InputError, match=r'pandas: pip install -e "\.\[tables\]"'):
            results.to_pandas()
        with pytest.raises(tf.InputError, match=r'networkx: pip install -e "\.\[tables\]"'):
            results.lineage().to_networkx()


def test_names_of_parameters_are_as_short_as_they_can_be():
    paths = [
        "Circuit.parameters['k']",
        "Growth.rate",
        "Medium.signals['a'].diffusion",
        "Medium.signals['b'].diffusion",
        "Division.length.low",
        "Division.length.high",
        "Mechanics.walls[0].low[1]",
        "Division.added.mean",
        "Circuit.parameters['sd']",
    ]
    assert list(column_names(paths, {"x", "length", "rate"}).values()) == [
        "k",
        "Growth.rate",
        "a.diffusion",
        "b.diffusion",
        "length.low",
        "length.high",
        "low[1]",
        "added.mean",
        "sd",
    ]


def test_a_scene_without_values_per_colony_stores_none(tmp_path):
    scene = make_scene()
    record(scene, scene.bind(2).start(), tmp_path / "run.h5", until=0.3)
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.parameters() == {}


def two_circuits(a=(1.0, 2.0), b=(3.0, 4.0)) -> tf.Scene:
    """Two circuits with one set of names; a tuple is one value per colony."""

    def circuit(u, s, p, cell):
        return {"gfp": p.k - u.gfp}

    value = lambda x: torch.tensor(x) if isinstance(x, tuple) else x
    own = lambda name, k: tf.Circuit(circuit, species=("gfp",), name=name, k=value(k))
    return tf.Scene(tf.Growth(rate=1.0), own("a", a), own("b", b), tf.Mechanics(dim=2), dt=DT)


def resume_changed(scene, path, until):
    with tf.Results(path) as results:
        state = results.state(scene, changed=True)
    return record(scene, state, path, until=until, append=True, changed=True)


def test_two_circuits_keep_the_values_of_both(tmp_path):
    scene = two_circuits()
    record(scene, scene.bind(2).start(), tmp_path / "run.h5", until=0.2)
    with tf.Results(tmp_path / "run.h5") as results:
        values, table = results.parameters(), results.table(-1)
    assert {name: x.tolist() for name, x in values.items()} == {
        "Circuit['a'].parameters['k']": [1.0, 2.0],
        "Circuit['b'].parameters['k']": [3.0, 4.0],
    }
    assert table["a.parameters.k"].tolist() == [1.0, 2.0]
    assert table["b.parameters.k"].tolist() == [3.0, 4.0]


def test_frames_without_values_per_colony_get_none_from_later_ones(tmp_path):
    """None, then some, then none again, then others; each resume copies the file."""
    path, first = tmp_path / "run.h5", two_circuits(1.0, 1.0)
    record(first, first.bind(2).start(), path, until=0.2)
    for k, (a, b) in enumerate([((5.0, 6.0), 1.0), (1.0, 1.0), (1.0, (7.0, 8.0))]):
        resume_changed(two_circuits(a, b), path, 0.4 + 0.2 * k)
    with tf.Results(path) as results:
        seen = [results.parameters(k) for k in range(len(results))]
        times = results.times
    for name, since, values in (("a", 0.2, (5.0, 6.0)), ("b", 0.6, (7.0, 8.0))):
        for time, found in zip(times, seen, strict=True):
            there = since + 1e-9 < time < since + 0.2 + 1e-9
            wanted = values if there else (math.nan, math.nan)
            own = next(x for path, x in found.items() if f"'{name}'" in path)
            assert np.array_equal(own, wanted, equal_nan=True), (name, time)


def test_a_resume_that_is_killed_before_its_first_frame_may_be_changed_again(tmp_path):
    path, first = tmp_path / "run.h5", two_circuits()
    record(first, first.bind(2).start(), path, until=0.2)
    killed = two_circuits(a=(5.0, 6.0))
    with tf.Results(path) as results:
        frames, state = len(results), results.state(killed, changed=True)
    recorder = tf.Recorder(path, killed, append=True, changed=True)
    recorder(state)
    recorder.close()  # it has the last frame already, and writes none
    resume_changed(two_circuits(a=(7.0, 8.0)), path, 0.4)
    with tf.Results(path) as results:
        assert len(results) > frames
        seen = [results.parameters(k)["Circuit['a'].parameters['k']"] for k in (frames - 1, -1)]
    assert [x.tolist() for x in seen] == [[1.0, 2.0], [7.0, 8.0]]


def test_a_changed_resume_of_an_earlier_file_leaves_its_frames_unknown(tmp_path):
    path, scene = tmp_path / "run.h5", designs()
    record(scene, scene.bind(2).start(), path, until=0.2)
    old = as_earlier(path, tmp_path)
    resume_changed(designs(k=(5.0, 6.0)), old, 0.4)
    with tf.Results(old) as results:
        first, last = (results.parameters(k)["Circuit.parameters['k']"] for k in (0, -1))
    assert np.isnan(first).all() and last.tolist() == [5.0, 6.0]


def test_rows_are_selected_by_the_value_that_was_typed(tmp_path):
    """Of float32, too; and a file of an earlier version, which holds the binary number, is still of
    the same scene."""
    scene = tf.Scene(tf.Growth(rate=torch.tensor([0.1, 0.3])), tf.Division(length=4.0), dt=0.1)
    for _ in tf.simulate(scene, until=0.2, record=tmp_path / "a.h5"):
        pass
    with tf.Results(tmp_path / "a.h5") as results:
        assert results.parameters()["Growth.rate"].tolist() == [0.1, 0.3]
        assert (results.to_pandas().rate == 0.1).any()
        state = results.state(scene)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["parameters/Growth.rate"][...] = torch.tensor([0.1, 0.3]).double().numpy()
    for _ in tf.simulate(
        scene, state, until=0.4, record=tf.Recorder(tmp_path / "a.h5", scene, append=True)
    ):
        pass
    with h5py.File(tmp_path / "a.h5") as file:
        assert "parameters_until" not in file


@pytest.mark.parametrize("most", [1, 600, 1 << 18])
def test_a_table_of_all_frames_is_that_of_each(tmp_path, monkeypatch, most):
    """However many frames are read at once, also where parameters change on the way."""
    monkeypatch.setattr("torchfilm.io.blocks.MOST_ROWS", most)
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=10.0, initial=1.0), box=((-16.0, -16.0), (16.0, 16.0)),
        spacing=4.0, outside="reservoir",
    )  # fmt: skip
    others = tf.Division(length=4.0), tf.Mechanics(dim=2), medium
    of = lambda rate: tf.Scene(tf.Growth(rate=rate), *others, dt=DT)
    path, first, later = tmp_path / "run.h5", of([0.8, 1.0]), of([0.8, 1.5])
    for _ in tf.simulate(first, until=0.5, record=tf.Recorder(path, first, every=2)):
        pass
    with tf.Results(path) as results:
        state = results.state(later, changed=True)
    again = tf.Recorder(path, later, append=True, changed=True)
    for _ in tf.simulate(later, state, until=1.0, record=again):
        pass
    with tf.Results(path) as results:
        whole = results.table(internals=True)
        assert "ahl_reservoir" in results.colony_fields(1)
        each = [results.table(k, internals=True) for k in range(len(results))]
    assert len(each) > 6
    for name, column in whole.items():
        joined = np.concatenate([one[name] for one in each])
        assert column.dtype == joined.dtype and np.array_equal(
            column, joined, equal_nan=column.dtype.kind == "f"
        )
    rates = {c: set(whole["rate"][whole["colony"] == c]) for c in (0, 1)}
    assert rates == {0: {0.8}, 1: {1.0, 1.5}}


def test_the_correlation_of_a_distribution_is_named_with_it():
    paths = ["Growth.rate.median", "Growth.rate.inherited"]
    assert list(column_names(paths, set()).values()) == ["rate.median", "rate.inherited"]
    pulses = ["Growth.rate", "Lysis.rate.values[2.0]", "Lysis.rate.values[3.0]"]
    names = ["Growth.rate", "Lysis.rate[2.0]", "Lysis.rate[3.0]"]  # which rate a pulse is of
    assert list(column_names(pulses, set()).values()) == names
    assert list(column_names(pulses[1:], set()).values()) == ["rate[2.0]", "rate[3.0]"]


@pytest.mark.parametrize("value", [2**63 - 1, -1, 10**6])
def test_a_damaged_frame_is_named_in_a_table_of_all(whole, tmp_path, value):
    path = shutil.copy(whole[0], tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        file["frames/first_row"][3] = value
    with tf.Results(path) as results, pytest.raises(tf.InputError, match=r"damaged: frame 3 has"):
        results.table()
