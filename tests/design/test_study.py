"""A study keeps every evaluation in a file of plain data. A search resumes from it with the same
results as if it had never stopped."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil

import h5py
import numpy as np
import pytest
from searching import Level, Spread, fragile, grown, lit, paced

import torchfilm as tf
from design import CMAES, Batch, Choice, Finals, Parameter, Racing, Search, Sobol, Study
from design.entries import Entry

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]


def search(method=None, scene=lit, parameters=LIT, target=None, **options):
    target = target or Level(wanted=1.0)
    return Search(
        scene,
        parameters,
        target,
        method=method or Sobol(batch=3),
        **{"cells": 3, "replicates": 2, "finals": None, **options},
    )


METHODS = {
    "sobol": lambda: Sobol(batch=3),
    "cmaes": lambda: CMAES(population=4),
    "racing": lambda: Racing(inner=CMAES(population=4), sizes=(0.5, 1.0), keep=0.5),
    "a user's own": lambda: Halving(),
}


class Halving:
    """A user's own method: three points around the best so far, with a shrinking distance."""

    def start(self, space, seed, replicates):
        self.best, self.loss, self.width, self.size = (
            np.full(space.size, 0.5),
            np.inf,
            0.5,
            space.size,
        )

    def ask(self):
        step = self.width * np.ones(self.size)
        return Batch(np.clip([self.best - step, self.best, self.best + step], 0, 1))

    def tell(self, batch, loss):
        if loss.min() < self.loss:
            self.best, self.loss = batch.points[loss.argmin()], loss.min()
        self.width *= 0.5


def entries_alike(one, other):
    assert len(one.entries) == len(other.entries)
    for a, b in zip(one.entries, other.entries, strict=True):
        for f in dataclasses.fields(Entry):
            if f.name not in ("seconds", "choosing"):
                assert np.array_equal(getattr(a, f.name), getattr(b, f.name)), f.name


# --- the file -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["sobol", "racing"])
def test_a_file_gives_back_what_was_written(tmp_path, method):
    made = search(METHODS[method]())
    made.run(12, study=tmp_path / "s.h5", progress=False)
    again = Study.read(tmp_path / "s.h5")
    assert (again.about, again.names, again.streams) == (
        made.study.about,
        made.study.names,
        made.study.streams,
    )
    entries_alike(again, made.study)
    for name in ("seconds", "choosing"):
        assert [getattr(e, name) for e in again.entries] == [
            getattr(e, name) for e in made.study.entries
        ]
    assert again.colonies == made.study.colonies
    for a, b in zip(again.convergence(), made.study.convergence(), strict=True):
        assert np.array_equal(a, b, equal_nan=True)
    point, loss, losses = again.best()
    assert (
        np.array_equal(point, made.best().point)
        and loss == made.best().loss
        and np.array_equal(losses, made.best().losses)
    )


def test_reasons_are_kept(tmp_path):
    made = search(Sobol(batch=4), fragile, [Parameter("make", 1, 10)])
    made.run(8, study=tmp_path / "s.h5", progress=False)
    reasons = made.study.entries[0].reasons
    assert reasons and all("not finite" in w or "gfp" in w for w in reasons.values())
    assert Study.read(tmp_path / "s.h5").entries[0].reasons == reasons


def test_the_file_holds_numbers_and_text_only(tmp_path):
    search(METHODS["racing"]()).run(12, study=tmp_path / "s.h5", progress=False)
    kinds = {}
    with h5py.File(tmp_path / "s.h5") as file:
        file.visititems(
            lambda name, d: kinds.update({name: d.dtype}) if isinstance(d, h5py.Dataset) else None
        )
        attributes = {n: file.attrs[n] for n in file.attrs}
    assert {"designs/point", "designs/losses", "values/make", "batches/size", "streams"} <= set(
        kinds
    )
    assert all(d.kind in "iuf" or h5py.check_string_dtype(d) is not None for d in kinds.values())
    assert all(isinstance(v, (str, int, np.integer)) for v in attributes.values())
    assert json.loads(attributes["about"])["names"] == ["make", "decay"]


@pytest.mark.parametrize(
    "options", [("weak", "strong"), (1, "x", 2.5, False), (1.5, 2.5), (True, False)]
)
def test_values_of_all_kinds_are_written(tmp_path, options):
    """The file holds the parameters themselves, over several batches."""
    chosen = Choice("kind", options)
    made = search(
        Sobol(batch=2), of_a_kind, [chosen, Parameter("rate", 1, 2)], Spread(), replicates=1
    )
    made.run(6, study=tmp_path / "s.h5", progress=False)
    points = np.concatenate([e.points for e in made.study.entries])
    expected = [chosen.value(u) for u in points[:, 0]]
    assert len(expected) == 6 and set(expected) <= set(options) and len(set(expected)) > 1
    found = [v for e in Study.read(tmp_path / "s.h5").entries for v in e.values]
    assert [repr(v["kind"]) for v in found] == [repr(v) for v in expected]
    assert [v["rate"] for v in found] == (1 + points[:, 1]).tolist()


def of_a_kind(kind="weak", rate=1.0):
    return tf.Scene(tf.Growth(rate=rate), tf.Division(length=4.0), dt=0.1)


# --- resuming -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole():
    """Searches without interruption, by method."""
    found = {name: search(make()) for name, make in METHODS.items()}
    for one in found.values():
        one.run(30, progress=False)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("stops", [(2,), (9,), (5, 13, 21)], ids=str)
@pytest.mark.parametrize("method", METHODS)
def test_a_resumed_search_equals_one_without_interruption(tmp_path, whole, method, stops):
    path = tmp_path / "s.h5"
    for colonies in stops:
        try:
            search(METHODS[method]()).run(colonies, study=path, progress=False)
        except tf.InputError as error:  # a race has no full colony yet
            assert method == "racing" and "full size" in str(error)
    last = search(METHODS[method]())
    best = last.run(30, study=path, progress=False)
    entries_alike(last.study, whole[method].study)
    assert best.values == whole[method].best().values and best.loss == whole[method].best().loss
    assert np.array_equal(last.method.ask().points, whole[method].method.ask().points)


@pytest.mark.parametrize("when", ["before the file takes its place", "between batches"])
def test_a_kill_costs_at_most_one_batch(tmp_path, monkeypatch, whole, when):
    """The file after a kill: the current batch is lost, and a half-written file may remain."""
    path, made = tmp_path / "s.h5", search()
    made.run(12, study=path, progress=False)
    (tmp_path / "s.h5.new").write_bytes(path.read_bytes()[:500])
    if when == "before the file takes its place":
        before = path.read_bytes()
        monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            search().run(30, study=path, progress=False)
        monkeypatch.undo()
        assert path.read_bytes() == before
    last = search()
    last.run(30, study=path, progress=False)
    entries_alike(last.study, whole["sobol"].study)
    assert not (tmp_path / "s.h5.new").exists()


def test_colonies_of_a_study_count(tmp_path, monkeypatch):
    path = tmp_path / "s.h5"
    search().run(12, study=path, progress=False)
    monkeypatch.setattr(
        "design.objective.Objective.evaluate", lambda *_, **__: pytest.fail("the budget is used up")
    )
    made = search()
    assert made.run(12, study=path, progress=False).loss == Study.read(path).best()[1]
    assert made.run(10**6, study=path, stop_at=1e9, progress=False).loss <= 1e9
    assert (
        search("sobol", paced, [Parameter("rate", 1, 2)]).why_regrown.startswith(
            "Growth.rate differs"
        )
        and made.why_regrown == ""
    )


def test_of_two_searches_at_one_path_one_goes_on(tmp_path):
    """Both began where there was no file: the second to write is told, the first study stays."""
    path = tmp_path / "s.h5"
    mine, other = search(seed=0), search(seed=1)
    study = Study.new(path, {"names": ["make"]}, ("make",), tuple(range(8)))
    other.run(12, study=path, progress=False)
    entry = Study.read(path).entries[0]
    with pytest.raises(tf.SimulationError, match=r"s\.h5 has been written by another process"):
        study.add(entry)
    kept = Study.read(path)
    assert kept.colonies == other.study.colonies and not path.with_name("s.h5.new").exists()
    path.unlink()  # what is gone cannot be lost
    mine.run(12, study=path, progress=False)
    assert Study.read(path).colonies == mine.study.colonies


def test_a_full_disk_is_reported_and_loses_nothing(tmp_path, monkeypatch):
    path, made = tmp_path / "s.h5", search()
    made.run(6, study=path, progress=False)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(
        tf.SimulationError, match=r"could not write .*s.h5: .*No space left.*resume"
    ):
        search().run(12, study=path, progress=False)
    monkeypatch.undo()
    assert len(Study.read(path).entries) == 1


# --- refused files --------------------------------------------------------------------------------


def brighter(make=1.0, decay=1.0):
    return grown(1.9, make, decay)


def moved(make=1.0, decay=1.0):
    scene = lit(make, decay)
    return tf.Scene(*scene.effects, dt=scene.dt, founders=tf.Cells([[0.0, 3.0]], [[1.0, 0.0]]))


def faster(u, s, p, cell):
    return {"gfp": 2.0 * p.make * (1.0 + 0.02 * cell.x * cell.x) - p.decay * u.gfp}


def quicker(make=1.0, decay=1.0):
    """Its listing is that of `lit`: a listing does not show the code of functions."""
    faster.__name__ = "filling"
    scene = lit(make, decay)
    circuit = tf.Circuit(faster, species=("gfp",), make=make, decay=decay)
    return tf.Scene(
        *(circuit if isinstance(e, tf.Circuit) else e for e in scene.effects), dt=scene.dt
    )


moved.__name__ = quicker.__name__ = "lit"

OTHERS = {
    "founders": ({"scene": moved}, ["Different: founders and functions."]),
    "what a function does": ({"scene": quicker}, ["Different: founders and functions."]),
    "scene": ({"scene": brighter}, ["lit", "brighter", "rate=2.0", "rate=1.9"]),
    "target": ({"target": Level(wanted=2.0)}, ["wanted=1.0", "wanted=2.0"]),
    "bounds": (
        {"parameters": [LIT[0], Parameter("decay", 0.5, 3)]},
        ["decay: 0.5 to 2", "decay: 0.5 to 3"],
    ),
    "method": ({"method": Sobol(batch=4)}, [r"sobol(batch=3)", r"sobol(batch=4)"]),
    "another method": ({"method": CMAES(population=4)}, ["sobol(batch=3)", "cmaes(population=4"]),
    "seed": ({"seed": 1}, ["seed: 0 there, 1 here"]),
    "cells": ({"cells": 4}, ["cells: 3 there, 4 here"]),
    "until": ({"until": 5.0}, ["until: None there, 5.0 here"]),
    "replicates": ({"replicates": 3}, ["replicates: 2 there, 3 here"]),
    "reduce": ({"reduce": "worst"}, ["reduce: mean there, worst here"]),
    "step": ({"dt": 0.05}, ["dt: 0.1 there, 0.05 here"]),
    "names": (
        {"parameters": [LIT[0]], "fixed": {"decay": 1.0}},
        ["parameters: decay: 0.5 to 2.0 there, none here", "fixed: none there, decay=1.0 here"],
    ),
    "order": (
        {"parameters": LIT[::-1]},
        ["Different: parameters. parameters: make: 0.1 to 10.0 log, decay: 0.5 to 2.0 there"],
    ),
}


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    path = tmp_path_factory.mktemp("kept") / "s.h5"
    search().run(6, study=path, progress=False)
    return path


@pytest.mark.parametrize("other", OTHERS)
def test_the_file_of_another_search_is_refused_with_the_differences(kept, other):
    given, words = OTHERS[other]
    before = kept.read_bytes()
    with pytest.raises(tf.InputError, match="is the study of another search") as error:
        search(**given).run(12, study=kept, progress=False)
    assert all(w in str(error.value) for w in words), str(error.value)
    assert len(str(error.value)) <= 300
    assert kept.read_bytes() == before


def test_fixed_functions_are_the_same_in_another_process():
    """The address in the memory of a process is not part of the description."""
    one, other = (
        search(scene=chosen, parameters=[LIT[0]], fixed={"how": lambda x: x}).study.about
        for _ in range(2)
    )
    assert one == other


def chosen(make=1.0, how=None):
    return grown(2.0, how(make))


def test_a_method_that_proposes_other_points_is_refused(kept, tmp_path):
    path = tmp_path / "s.h5"
    shutil.copy(kept, path)
    with h5py.File(path, "r+") as file:
        file["designs/point"][1, 0] += 0.01
    with pytest.raises(
        tf.InputError, match="the method proposes other points than its batch 0 holds"
    ):
        search().run(12, study=path, progress=False)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(kept, tmp_path, share):
    whole = kept.read_bytes()
    (tmp_path / "s.h5").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(
        tf.InputError, match="cannot be read: it is truncated or not a torchfilm study"
    ):
        search().run(12, study=tmp_path / "s.h5", progress=False)


def spoiled(path, what):
    with h5py.File(path, "r+") as file:
        if what == "about":
            file.attrs["about"] = "{no json"
        elif what == "about is a list":
            file.attrs["about"] = "[]"
        elif what == "rows":
            file["batches/rows"][0] = 40
        elif what == "reasons":
            file["designs/reasons"][0] = "nonsense"
        elif what == "no loss":
            file["designs/loss"][0] = np.nan
        elif what == "short":
            short = file["designs/loss"][:-1]
            del file["designs/loss"]
            file["designs/loss"] = short
        else:
            del file[what]


@pytest.mark.parametrize(
    "what",
    [
        "about", "about is a list", "rows", "reasons", "batches", "designs/loss", "streams",
        "no loss", "short",
    ],
)  # fmt: skip
def test_a_spoiled_file_is_refused(kept, tmp_path, what):
    shutil.copy(kept, tmp_path / "s.h5")
    spoiled(tmp_path / "s.h5", what)
    with pytest.raises(
        tf.InputError, match="cannot be read: it is truncated or not a torchfilm study"
    ):
        Study.read(tmp_path / "s.h5")


def test_foreign_files_are_refused(tmp_path, kept):
    (tmp_path / "a.h5").write_text("make,decay\n1,2\n")
    scene = grown(2.0)
    list(tf.simulate(scene, scene.bind(1).start(), until=0.2, record=tmp_path / "b.h5"))
    shutil.copy(kept, tmp_path / "c.h5")
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        file.attrs["version"] = 99
    for name, words in (
        ("a.h5", "cannot be read"),
        ("b.h5", r"is not a torchfilm study \(its format is 'torchfilm results'"),
        ("c.h5", "format version 99; this torchfilm reads versions up to 3"),
        ("", r"a study file\. This path is a folder"),
        ("no/such.h5", "in a folder that exists"),
    ):
        with pytest.raises(tf.InputError, match=words):
            search().run(12, study=tmp_path / name, progress=False)
    with pytest.raises(tf.InputError, match=r"a study file\. There is no such file"):
        Study.read(tmp_path / "none.h5")


def test_a_table_lists_the_best_designs_first():
    made = search(Racing(inner=CMAES(population=4), sizes=(0.5, 1.0), keep=0.5))
    made.run(40, progress=False)
    study = made.study
    lines = study.table(most=3).splitlines()
    assert lines[0].split() == ["loss", "sd", "cells", "make", "decay"]
    losses = sorted(x for e in study.full() for x in e.loss.tolist())
    assert [line.split()[0] for line in lines[1:4]] == [f"{x:.4f}" for x in losses[:3]]
    assert lines[4] == f"and {len(losses) - 3} more" and len(losses) > 3
    best = made.best()
    cells = np.mean([n for d in best.colonies() for n in d.state.counts.tolist()])
    values = (f"{best.values[name]:.4g}" for name in ("make", "decay"))
    assert lines[1].split()[2:] == [f"{cells:.0f}", *values]
    assert len(study.table(most=1000).splitlines()) == len(losses) + 1
    assert Study({}, ("make",), tuple(range(8))).table() == "loss  sd  cells  make"


def test_info_says_what_was_searched_and_found():
    made = search(Sobol(batch=4), fragile, [Parameter("make", 1, 10)])
    made.run(8, progress=False)
    text = made.study.info
    assert "fragile, to 3 cells, seed 0" in text and "parameter   make: 1.0 to 10.0" in text
    assert "8 colonies of 4 designs" in text and "sobol(batch=4)" in text
    failed = sum(len(e.reasons) for e in made.study.entries)
    assert f"failed      {failed} colonies" in text
    assert f"best loss   {made.study.best()[1]:.4f} in the search" in text


def test_the_history_is_a_table(tmp_path):
    """A row for each design that was grown, as the study has it, and the same from a CSV file."""
    made = search(METHODS["racing"](), finals=Finals(share=0.4))
    made.run(60, progress=False)
    found = made.study.history(tmp_path / "history.csv")
    every = [*made.study.entries, *made.study.finals]
    count = sum(len(e.points) for e in every)
    assert {len(x) for x in found.values()} == {count}
    assert found["loss"] == [x for e in every for x in e.loss.tolist()]
    assert sum(found["colonies"]) == pytest.approx(made.study.colonies)
    assert found["make"] == [v["make"] for e in every for v in e.values]
    assert sum(found["finals"]) == sum(len(e.points) for e in made.study.finals)
    small = found["size"].index(0.5)
    assert np.isnan(found["loss_1"][small]) == (found["replicates"][small] == 1)
    with open(tmp_path / "history.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(r["loss"]) for r in rows] == found["loss"] and len(rows) == count
    with pytest.raises(tf.InputError, match="It is there already"):
        made.study.history(tmp_path / "history.csv")


def test_parameters_keep_their_columns_in_a_history():
    def sized(size, cells):
        return lit(make=size, decay=cells)

    made = search(scene=sized, parameters=[Parameter("size", 2, 3), Parameter("cells", 0.5, 1)])
    made.run(6, progress=False)
    found = made.study.history()
    assert found["size"] == [1.0] * len(found["size"]) and min(found["cells"]) >= 3
    assert min(found["parameter size"]) >= 2 and max(found["parameter cells"]) <= 1


def test_a_method_may_draw_by_a_seed_of_its_own(tmp_path):
    """The colonies are the same: a design has the same loss whatever its method's seed."""
    first, second = (search(method_seed=k) for k in (0, 1))
    for made in (first, second):
        made.run(12, progress=False)
    one, other = (made.study.entries[0] for made in (first, second))
    assert not np.array_equal(one.points, other.points)
    assert np.array_equal(second.objective.evaluate(one.points).loss, one.loss)
    plain = search()
    plain.run(12, progress=False)
    assert np.array_equal(plain.study.entries[0].points, one.points)
    first.run(12, study=tmp_path / "s.h5", progress=False)
    with pytest.raises(tf.InputError, match="method seed"):
        second.run(12, study=tmp_path / "s.h5", progress=False)
    with pytest.raises(tf.InputError, match="method_seed = -1"):
        search(method_seed=-1)
