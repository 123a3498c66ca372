"""Gate libraries: files in both versions of the format, and what is wrong with them."""

from __future__ import annotations

import json
import math

import pytest
from gate_library import GATES, inputs_and_outputs, version_1, version_2, write

import torchfilm as tf
from design import Library


def find(records, collection, name):
    """One record, to be spoilt."""
    return next(
        r
        for r in records
        if r["collection"] == collection and name in (r.get("name"), r.get("gate_name"))
    )


@pytest.mark.parametrize("make", [version_1, version_2])
def test_both_versions_give_the_same_gates(make, tmp_path):
    library = Library.read(write(tmp_path / "library.json", make()))
    assert list(library.gates) == list(GATES)
    for name, (repressor, ymax, ymin, k, n) in GATES.items():
        gate = library.gates[name]
        assert (gate.group, gate.ymax, gate.ymin, gate.K, gate.n) == (repressor, ymax, ymin, k, n)
        assert [p.name for p in gate.promoters] == [f"p{repressor}"]
        kinds = [p if isinstance(p, int) else p.kind for p in gate.units[0]]
        assert kinds[2:] == ["ribozyme", "rbs", "cds", "terminator"]
        assert sorted(kinds[:2]) == [0, 1]
    assert library.sensors == library.reporters == {}


def test_files_of_inputs_and_outputs_belong_to_version_2(tmp_path):
    library = Library.read(
        write(tmp_path / "ucf.json", version_2()), write(tmp_path / "io.json", inputs_and_outputs())
    )
    sensor, reporter = library.sensors["LacI_sensor"], library.reporters["YFP_reporter"]
    assert (sensor.ymax, sensor.ymin, sensor.promoters[0].name) == (2.8, 0.004, "pTac")
    assert reporter.scale == 0.5 and [p for p in reporter.units[0][:2]] == [0, 1]


def test_a_response_is_the_hill_function_and_does_not_overflow(tmp_path):
    gate = Library.read(write(tmp_path / "a.json", version_1())).gates["E1_EpsR"]
    for x in (0.0, 1e-3, 0.03, 0.5, 40.0):
        direct = gate.ymin + (gate.ymax - gate.ymin) / (1 + (x / gate.K) ** gate.n)
        assert math.isclose(gate.response(x), direct, rel_tol=1e-12)
    assert gate.response(1e200) == gate.ymin


def test_gates_can_be_named(tmp_path):
    records = version_1()
    find(records, "gates", "A1_AlfR")["gate_type"] = "AND"
    path = write(tmp_path / "a.json", records)
    with pytest.raises(tf.InputError, match=r"'A1_AlfR'.*gate_type = 'AND'.*gates=\(…\)"):
        Library.read(path)
    assert list(Library.read(path, gates=["D1_DelR", "E1_EpsR"]).gates) == ["D1_DelR", "E1_EpsR"]
    with pytest.raises(tf.InputError, match="Did you mean 'D1_DelR'"):
        Library.read(path, gates=["D1_DelS"])


def test_bases_may_be_written_in_both_cases_and_parts_nobody_uses_may_differ(tmp_path):
    records = version_1()
    part = find(records, "parts", "AlfR")
    records += [{**part, "dnasequence": "acgt"}, {**part, "name": "x"}]
    records.append({**part, "name": "x", "dnasequence": "GG"})
    path = write(tmp_path / "a.json", records)
    assert len(Library.read(path).gates) == len(GATES)
    write(path, [*records, {**part, "dnasequence": "GG"}])
    with pytest.raises(tf.InputError, match=r"A1_AlfR.*'AlfR' is given twice in 'parts'"):
        Library.read(path)


def test_names_are_never_evaluated(tmp_path):
    records = version_1()
    find(records, "response_functions", "A1_AlfR")["equation"] = "__import__('os').abort()"
    with pytest.raises(tf.InputError, match=r"A1_AlfR.*equation.*it must be ymin"):
        Library.read(write(tmp_path / "a.json", records))


def drop(*path):
    def spoil(record):
        for key in path[:-1]:
            record = record[key]
        del record[path[-1]]

    return spoil


def put(value, *path):
    def spoil(record):
        for key in path[:-1]:
            record = record[key]
        record[path[-1]] = value

    return spoil


@pytest.mark.parametrize(
    "collection, spoil, words",
    [
        ("gates", drop("group_name"), "the field 'group_name' is missing"),
        ("gates", put(3, "group_name"), "group_name = 3"),
        ("response_functions", drop("equation"), "the field 'equation' is missing"),
        ("response_functions", drop("parameters", 2), "the parameter 'K' is missing"),
        (
            "response_functions",
            put("Ymax", "parameters", 0, "name"),
            "the parameter 'ymax' is missing. Is it 'Ymax'",
        ),
        (
            "response_functions",
            lambda r: r["parameters"].append({"name": "K2", "value": 1.0}),
            "the parameter 'K2' is unknown",
        ),
        ("response_functions", drop("parameters", 1, "value"), "'ymin' has no field 'value'"),
        ("response_functions", put("1", "parameters", 1, "value"), "ymin = '1'"),
        ("response_functions", put(-0.1, "parameters", 1, "value"), "ymin = -0.1"),
        ("response_functions", put(0.05, "parameters", 0, "value"), "ymax = 0.05"),
        ("response_functions", put(0.0, "parameters", 2, "value"), "K = 0.0"),
        ("response_functions", put(-2.0, "parameters", 3, "value"), "n = -2.0"),
        ("response_functions", put(math.nan, "parameters", 3, "value"), "n = nan"),
        ("response_functions", put("a/x^b", "equation"), "has no upper level"),
        ("gate_parts", drop("promoter"), "the field 'promoter' is missing"),
        ("gate_parts", put([], "expression_cassettes"), "expression_cassettes = []"),
        (
            "gate_parts",
            put("AlfQ", "expression_cassettes", 0, "cassette_parts", 2),
            "'AlfQ' is not in the collection 'parts'",
        ),
    ],
)
def test_a_broken_gate_is_named_with_the_field(collection, spoil, words, tmp_path):
    records = version_1()
    spoil(find(records, collection, "A1_AlfR"))
    with pytest.raises(tf.InputError) as caught:
        Library.read(write(tmp_path / "a.json", records))
    assert "A1_AlfR" in str(caught.value) and words in str(caught.value)


@pytest.mark.parametrize(
    "collection, name, spoil, words",
    [
        ("gates", "A1_AlfR", put("none", "model"), "'none' is not in the collection 'models'"),
        ("models", "A1_AlfR_model", drop("functions"), "'functions' is missing"),
        (
            "models",
            "A1_AlfR_model",
            drop("functions", "response_function"),
            "'response_function' is missing",
        ),
        ("models", "A1_AlfR_model", drop("parameters", 3), "the parameter 'n' is missing"),
        ("functions", "sum", put("t1 * x2 + x1", "equation"), "promoters in tandem"),
        ("structures", "A1_AlfR_structure", drop("outputs"), "'outputs' is missing"),
        (
            "structures",
            "A1_AlfR_structure",
            put(["#in3"], "devices", 0, "components"),
            "'#in3' is none of its inputs",
        ),
        (
            "structures",
            "A1_AlfR_structure",
            put(["A1_AlfR_0"], "devices", 1, "components"),
            "contains itself",
        ),
    ],
)
def test_a_broken_gate_of_version_2_is_named_with_the_field(
    collection, name, spoil, words, tmp_path
):
    records = version_2()
    spoil(find(records, collection, name))
    with pytest.raises(tf.InputError) as caught:
        Library.read(write(tmp_path / "a.json", records))
    said = str(caught.value)
    assert "'A1_AlfR" in said and words in said and said.count("a.json, gates") <= 1


def test_wrong_files_are_refused(tmp_path):
    whole = json.dumps(version_1())
    for text, words in [
        (whole[: len(whole) // 2], "it is truncated, or no library"),
        ("", "it is truncated, or no library"),
        ("version https://git-lfs.github.com/spec/v1\n", "it is truncated, or no library"),
        ("[" * 100_000, "it is truncated, or no library"),
        ("{}", "is no library"),
        ("[1, 2]", "record 0 = 1"),
        ('[{"name": "A"}]', "it has no 'collection'"),
        ('[{"collection": "gates"}]', "it has no 'name'"),
        (json.dumps(inputs_and_outputs()), "a library with gates"),
        (json.dumps([*version_1(), {**version_1()[1], "group_name": "x"}]), "given twice"),
    ]:
        path = tmp_path / "a.json"
        path.write_text(text)
        with pytest.raises(tf.InputError) as caught:
            Library.read(path)
        assert words in str(caught.value), str(caught.value)
    path.write_bytes(b"\x80\x02\xff")
    with pytest.raises(tf.InputError, match="is not text"):
        Library.read(path)
    with pytest.raises(tf.InputError, match="a file that exists"):
        Library.read(tmp_path / "none.json")
    with pytest.raises(tf.InputError, match="one file or more"):
        Library.read()
