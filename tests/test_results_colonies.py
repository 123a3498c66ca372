"""The table with one row per colony and frame."""

from dataclasses import dataclass

import numpy as np
import pandas
import pytest
import torch

import torchfilm as tf
from torchfilm.cli.export import Export
from torchfilm.effect import Effect


@dataclass(frozen=True)
class Lamp(Effect):
    """A quantity of the colony, counting steps."""

    stage = 60
    title = "lamp"

    def declares(self, dim):
        return (tf.Field("lamp", "per colony", scope="colony", shape=(2,)),)

    def writes(self):
        return ("lamp",)

    def step(self, state, dt, values):
        return state.with_fields(lamp=state.lamp + 1)


def dying(rates):
    """Colonies of two types that divide, and lyse at these rates, 1/h."""
    return tf.Scene(
        tf.Growth(rate=1.0),
        tf.Division(length=3.0),
        tf.Mechanics(dim=2),
        tf.Lysis(rate=torch.tensor(rates)),
        founders=lambda seed: tf.Cells(
            position=[[0.0, 0.0], [6.0, 0.0], [12.0, 0.0]], axis=[[1.0, 0.0]] * 3, length=2.0,
            cell_type=[0, 1, 1],
        ),
        type_names=["sender", "receiver"],
        dt=0.1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("colonies") / "run.h5"
    scene = dying([0.0, 0.6, 8.0])
    recorder = tf.Recorder(path, scene, every=4)
    tf.simulate(scene, until=2.0, colonies=3, seed=3, record=recorder).last()
    return path


def test_cells_are_founders_and_divisions_less_deaths(path):
    with tf.Results(path) as results:
        table, counts = results.table(each="colony"), results.counts
        ids, frames = results.colony_id, len(results)
    assert (table["cells"] == counts.reshape(-1)).all()
    assert (table["colony"] == np.tile(ids, frames)).all()
    assert (table["cells"] == 3 + table["divided"] - table["lysed"]).all()
    assert {"removed", "failed", "left"}.isdisjoint(table)
    assert (table["cells.sender"] + table["cells.receiver"] == table["cells"]).all()
    dead = table["cells"] == 0
    assert dead.any() and np.isnan(table["mean.length"][dead]).all()
    assert (table["biovolume"][dead] == 0).all()
    assert np.allclose(table["rate"], np.tile([0.0, 0.6, 8.0], frames))


def test_means_are_those_of_the_cells(path):
    with tf.Results(path) as results:
        cells, table = results.to_pandas(), results.to_pandas(each="colony")
        names = set(results.table(0))
        some = results.to_pandas([2, 4], each="colony")
    groups = cells.groupby(["frame", "colony"])
    here = table[table.cells > 0].set_index(["frame", "colony"]).sort_index()
    for name in ("length", "age", "growth_rate", "volume"):
        assert np.allclose(groups[name].mean(), here[f"mean.{name}"], rtol=1e-6), name
    assert np.allclose(groups["volume"].sum(), here.biovolume, rtol=1e-6)
    assert not {f"mean.{n}" for n in ("x", "born", "cell", "time", "cell_type", "rate")} & {*table}
    assert {f"mean.{n}" for n in ("radius", "length", "volume", "age")} <= {*table}
    assert "rate" in names  # the parameter is called as in the table of cells
    pandas.testing.assert_frame_equal(some, table[table.frame.isin([2, 4])].reset_index(drop=True))


def test_fields_of_colonies_signals_and_parameters_that_change(tmp_path):
    path = tmp_path / "run.h5"

    def scene(k1):
        ready = tf.scenes.quorum_sensing(size=16.0, k1=torch.tensor(k1))
        return ready.replace(*ready.effects, Lamp())

    first, later = scene([50.0, 100.0]), scene([5.0, 100.0])
    state = tf.simulate(first, until=0.2, record=path).last()
    more = tf.Recorder(path, later, append=True, changed=True)
    state = tf.simulate(later, state, until=0.4, record=more).last()
    with tf.Results(path) as results:
        table, last = results.table(each="colony"), results.frame(-1)
        outside, lamp = results.signals_at_cells(-1)["ahl"], results.colony_fields(-1)["lamp"]
        alone = [results.table(k, each="colony") for k in range(len(results))]
    mean = [outside[last["colony"] == k].mean() for k in (0, 1)]
    assert np.allclose(table["mean.out.ahl"][-2:], mean) and mean[0] > 0
    assert (table["lamp_1"][-2:] == lamp[:, 1]).all() and lamp[1, 1] > 0
    assert "mean.lamp_1" not in table and table["k1"].tolist()[:2] == [50.0, 100.0]
    assert table["k1"].tolist()[-2:] == [5.0, 100.0]
    for name, column in table.items():
        joined = np.concatenate([one[name] for one in alone])
        assert np.array_equal(column, joined, equal_nan=column.dtype.kind == "f"), name


def test_colonies_keep_their_ids_in_any_order(tmp_path):
    scene = dying([0.0, 0.6, 8.0])
    begun = scene.bind(3, seed=3).start()
    begun = begun.select([2, 0])
    path = tmp_path / "run.h5"
    tf.simulate(scene, begun, until=1.0, record=path).last()
    with tf.Results(path) as results:
        table, ids = results.table(each="colony"), results.colony_id.tolist()
    assert ids == [2, 0] and table["colony"].tolist()[:2] == [2, 0]
    assert (table["cells"] == 3 + table["divided"] - table["lysed"]).all()
    assert (table["lysed"][table["colony"] == 0] == 0).all()


def test_command_and_bad_input(path, tmp_path):
    Export(path, tmp_path / "run.colonies.csv", frames=["-1"])()
    read = pandas.read_csv(tmp_path / "run.colonies.csv")
    with tf.Results(path) as results:
        whole = results.to_pandas(-1, each="colony")
        with pytest.raises(tf.InputError, match="each = 'frame'"):
            results.table(each="frame")
    assert read.columns.tolist() == whole.columns.tolist() and len(read) == 3
    assert read["cells"].tolist() == whole["cells"].tolist()
    with pytest.raises(tf.InputError, match=r"--colonies: not for run\.colonies\.csv"):
        Export(path, tmp_path / "run.colonies.csv", colonies=[1])()
