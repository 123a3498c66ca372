"""A saved design in another session: the same colonies and the same check, from data alone."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch
from searching import Level, lit

import torchfilm as tf
from design import (
    Bands,
    Burden,
    Choice,
    Composition,
    Constrained,
    DomainSize,
    Duration,
    Gradient,
    Image,
    Lasting,
    Observed,
    OnFraction,
    Oscillation,
    Parameter,
    Ring,
    Search,
    Spread,
    Stripe,
    Weighted,
    load_design,
)
from design.plain_data import NotPlain, from_data, to_data

RING = Ring("g", 5.0, 2.0)
LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]


def found(target=None, scene=lit, parameters=LIT, **options):
    options = {"cells": 6, "replicates": 2, "finals": None, "seed": 3, **options}
    search = Search(scene, parameters, target or OnFraction("gfp", 0.5, 1.0), **options)
    return search.run(6, progress=False)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A design of a scene function of the user's own, and its file."""
    best = found()
    return best, best.save(tmp_path_factory.mktemp("saved") / "best.json")


def test_a_loaded_design_grows_the_colonies_that_were_scored(saved):
    best, path = saved
    loaded = load_design(path, scene=lit)
    assert loaded.values == best.values and loaded.loss == best.loss
    assert loaded.target == best.objective.task.target
    assert np.array_equal(loaded.losses, best.losses)
    for one, other in zip(loaded.colonies(), best.colonies(), strict=True):
        assert torch.equal(one.state.position, other.state.position)
        assert torch.equal(one.state.gfp, other.state.gfp)
    *_, state = tf.simulate(loaded.scene(), **loaded.options)
    assert state.cells >= 6 and state.seed == 3
    assert float(best.objective.task.target.loss(state)[0]) == best.searched[0]


def dim(make: float = 1.0, decay: float = 1.0) -> tf.Scene:
    """As `lit`, with other code."""
    return lit(0.5 * make, decay)


def test_a_design_of_another_scene_is_told(saved, tmp_path):
    _, path = saved
    with pytest.warns(UserWarning, match=r"best.json is a design of another scene: .*Its losses"):
        load_design(path, scene=dim).scene()
    content = json.loads(path.read_text())
    content["code"][0] = "2.7"
    del content["effects"]
    older = tmp_path / "older.json"
    older.write_text(json.dumps(content))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_design(path, scene=lit).scene()
        load_design(older, scene=dim).scene()  # code of another Python says nothing


def by_type(make=1.0, paces=None) -> tf.Scene:
    return lit(make).replace(tf.Growth(rate=paces), *lit(make).effects[1:])


def test_a_scene_that_json_does_not_make_again_is_saved_all_the_same(tmp_path):
    """The keys of values by cell type become texts."""
    best = found(scene=by_type, parameters=LIT[:1], fixed={"paces": {0: 1.0, 1: 2.0}})
    content = json.loads(best.save(tmp_path / "best.json").read_text())
    assert "code" not in content and content["loss"] == best.loss


SCRIPT = """
import torchfilm as tf
from design import Measured, Parameter, Search, Sobol
class Pace:
    def __init__(self): super().__init__(); self.value = 2.0
PACE = Pace()
def update(cells): cells.w = cells.w * PACE.value
def count(state): return state.counts.double()
def made(k=1.0):
    return tf.Scene(tf.Rules(update, variables={"w": 1.0}), tf.Growth(rate=k), dim=2)
if __name__ == "__main__":
    target = Measured({"n": count}, {"n": 1.0}, {"n": 1.0})
    search = Search(made, [Parameter("k", 1.0, 2.0)], target, until=0.1, replicates=1,
                    finals=None, method=Sobol(batch=1))
    search.run(1, progress=False).save("v.json")
"""


def test_a_scene_of_the_script_that_searched_is_the_same_where_it_is_imported(tmp_path):
    """Its classes are those of __main__ there."""
    (tmp_path / "script.py").write_text(SCRIPT)
    load = (
        "import script; from design import load_design;"
        " load_design('v.json', scene=script.made).scene()"
    )
    for command in (["script.py"], ["-W", "error::UserWarning", "-c", load]):
        done = subprocess.run(
            [sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr


def test_a_loaded_design_is_checked_as_the_winner_itself(saved):
    best, path = saved
    options = {"seeds": 3, "sizes": (), "progress": False}
    one, other = best.check(**options), load_design(path, scene=lit).check(**options)
    assert np.array_equal(one.losses, other.losses) and one.values == other.values
    for a, b in zip(one.changes, other.changes, strict=True):
        assert a.name == b.name and np.array_equal(a.losses, b.losses)


def test_a_ready_scene_is_known_by_its_name(tmp_path):
    parameters = [Parameter("strength", 2, 8), Parameter("power", 1, 3, whole=True)]
    best = found(
        OnFraction("red", 0.5, 1.0), "toggle_switch", parameters, fixed={"noise": False}, dt=0.1
    )
    loaded = load_design(best.save(tmp_path / "best.json"))
    assert loaded.values == best.values and set(loaded.values) == {"strength", "power"}
    assert loaded.scene().bind().describe() == best.scene().bind().describe()
    assert loaded.objective.task.describe() == best.objective.task.describe()


def test_what_needs_code_of_the_user_is_given(tmp_path):
    best = found(Level(wanted=1.0))
    path = best.save(tmp_path / "best.json")
    with pytest.raises(
        tf.InputError, match=r"does not hold the target.*load_design\(…, target=…\)"
    ):
        load_design(path, scene=lit).check(seeds=2)
    loaded = load_design(path, scene=lit, target=Level(wanted=1.0))
    assert np.array_equal(loaded.objective.evaluate(loaded.point[None]).losses[0], best.searched)


def test_another_target_than_that_of_the_search_is_refused(saved):
    with pytest.raises(
        tf.InputError, match=r"in 0\.6 of the cells' .*that of the search: gfp above 1 in 0\.5"
    ):
        load_design(saved[1], scene=lit, target=OnFraction("gfp", 0.6, 1.0))
    load_design(saved[1], scene=lit, target=OnFraction("gfp", 0.5, 1.0))


def test_a_design_of_an_earlier_version_has_a_scene_and_no_check(saved, tmp_path):
    content = json.loads(saved[1].read_text())
    del content["search"]
    (tmp_path / "old.json").write_text(json.dumps(content))
    loaded = load_design(tmp_path / "old.json", scene=lit)
    assert loaded.scene().bind().describe() == saved[0].scene().bind().describe()
    with pytest.raises(tf.InputError, match=r"old\.json is of an earlier version.*save its best"):
        loaded.check(seeds=2)


FOREIGN = {
    "a text": ("no JSON", r"cannot be read as a saved design, which Best\.save writes"),
    "a list": ("[]", r"its parameters are no table"),
    "another table": ("{}", r"KeyError: 'parameters'"),
    "a number": ('{"scene": 3, "parameters": {}}', r"names no scene"),
    "parameters alone": ('{"parameters": {}}', r"names no scene"),
    "no parameters": ('{"scene": "a", "parameters": 3}', r"its parameters are no table"),
    "an unknown scene": ('{"scene": "a", "parameters": {}}', r"scene = 'a'"),
    "depth": ("[" * 100_000, "RecursionError"),
    "another loss": ('{"scene": "a", "parameters": {}, "loss": "x"}', "loss is no number"),
    "a list as search": ('{"scene": "a", "parameters": {}, "search": []}', "no table with names"),
    "foreign names": (
        '{"scene": "a", "parameters": {}, "search": {"names": ["nope"]}}',
        "'nope'.*not among",
    ),
    "a number of conditions": (
        '{"scene": "a", "parameters": {}, "search": {"names": [], "conditions": 3}}',
        "conditions of its search are no list",
    ),
    "a search without its end": (
        '{"scene": "a", "parameters": {}, "search": {"names": []}}',
        "its search has no replicates",
    ),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_foreign_files_are_refused(tmp_path, kind):
    text, message = FOREIGN[kind]
    (tmp_path / "file.json").write_text(text)
    with pytest.raises(tf.InputError, match=message):
        load_design(tmp_path / "file.json")


def test_what_a_file_does_not_hold_is_named(tmp_path):
    (tmp_path / "file.json").write_text('{"scene": "microcolony", "parameters": {}}')
    design = load_design(tmp_path / "file.json")
    for name in ("loss", "losses", "dtype"):
        with pytest.raises(tf.InputError, match=f"does not hold the {name} that"):
            getattr(design, name)


def test_an_edited_value_of_another_kind_is_named(saved, tmp_path):
    content = json.loads(saved[1].read_text())
    name = next(iter(content["parameters"]))
    content["parameters"][name] = [1.0]
    (tmp_path / "file.json").write_text(json.dumps(content))
    design = load_design(tmp_path / "file.json", scene=lit)
    asked = pytest.raises(tf.InputError, match=rf"{name} = \[1\.0\].*a number")
    with pytest.warns(UserWarning, match="of another scene"), asked:
        _ = design.point


def test_what_is_missing_is_named(saved, tmp_path):
    with pytest.raises(tf.InputError, match=r"no\.json cannot be read.*No such file"):
        load_design(tmp_path / "no.json")
    with pytest.raises(tf.InputError, match=r"scene = None.*lit of .*searching\.py.*scene=lit"):
        load_design(saved[1])
    with pytest.raises(tf.InputError, match=r"path = 3.*path of a file"):
        load_design(3)


# --- plain data -----------------------------------------------------------------------------------

OBSERVED = Observed.from_table({"x_um": [0.0, 1.0, 2.0], "y_um": [0.0, 1.0, 2.0]}, time=2.0)
PLAIN = [
    *LIT,
    Parameter("n", 1, 3, whole=True),
    Choice("gate", ("a", 2, True), per_colony=True),
    RING,
    Bands(("a", "b"), (-math.inf, 0.0, math.inf)),
    Gradient("g", "x", 0.0, 5.0),
    Stripe("g", at=0.0, width=3.0),
    Image("g", ((0.0, 1.0), (1.0, 0.0)), (4.0, 4.0)),
    Oscillation("g", 2.0),
    DomainSize(("a", "b"), 3.0),
    OnFraction("g", 0.5, 1.0),
    Burden(),
    Composition({0: 0.25, 1: 0.75}),
    Lasting(Composition({2: 0.5}, within=0.2), since=1.0),
    Duration(),
    OBSERVED,
    Lasting(RING, since=1.0),
    Spread(RING),
    Weighted([(RING, 1.0), (Burden(("g",)), 0.1)]),
    Constrained(Burden(), (RING,), at_least={"contrast": 2.0}),
]


@pytest.mark.parametrize("value", PLAIN, ids=lambda value: type(value).__name__)
def test_ready_targets_and_parameters_are_plain_data(value):
    again = from_data(json.loads(json.dumps(to_data(value))))
    assert type(again) is type(value) and again == value and repr(again) == repr(value)


def test_dictionaries_are_what_they_were():
    for value in ({"pairs": [1.0]}, {"a": {2: "b"}}, {0: {"c": 1}}):
        again = from_data(json.loads(json.dumps(to_data(value))))
        assert again == from_data(to_data(value)) and list(again) == list(value)
    for bad in ({"kind": "pairs"}, {"kind": "pairs", "pairs": 3}):
        with pytest.raises(tf.InputError, match="no pairs of a name and a value"):
            from_data(bad)


@pytest.mark.parametrize(
    "value", [Level(), Choice("gate", ("a", "b"), resolve=dict), [Weighted([(Level(), 1.0)])]]
)
def test_code_of_the_user_is_no_data(value):
    with pytest.raises(NotPlain):
        to_data(value)


@pytest.mark.parametrize(
    "data, message",
    [
        ({"kind": "system"}, r"kind = 'system'.*'Parameter'"),
        ({"kind": "Ring", "species": "g"}, r"Ring: missing .*'radius'"),
        ({"kind": "ColonyStatistics", "size": 3}, r"no ColonyStatistics can be made"),
        ({"kind": "Ring", "species": "g", "radius": -1, "width": 1}, r"Ring\.radius = -1"),
    ],
)
def test_bad_data_are_refused(data, message):
    with pytest.raises(tf.InputError, match=message):
        from_data(data)


@pytest.mark.parametrize("name", ["best", "best.csv", "best.h5"])
def test_a_design_is_saved_under_a_name_that_tells_its_format(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(tf.InputError, match=r"ends in '\.json'.*Such as 'best\.json'"):
        found(Level(wanted=1.0)).save(name)
    assert not list(tmp_path.iterdir())
