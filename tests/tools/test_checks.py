"""Messages of the input checks that several modules share."""

from __future__ import annotations

import pytest

import torchfilm as tf
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError, unknown_keyword


@pytest.mark.parametrize(
    "given, allowed, message",
    [
        (
            "rat",
            ("rate", "law"),
            "Growth has no parameter 'rat'. Did you mean rate? It has: rate, law.",
        ),
        ("colour", ("rate",), "Growth has no parameter 'colour'. It has: rate."),
        (
            "dimension",
            ("walls", "dim"),
            "Growth has no parameter 'dimension'. Did you mean dim? It has: walls, dim.",
        ),
        ("rate", (), "Growth has no parameter 'rate'. It has: none."),
    ],
)
def test_an_unknown_keyword_gets_the_nearest_known_one(given, allowed, message):
    error = unknown_keyword("Growth", given, allowed)
    assert isinstance(error, InputError) and str(error) == message


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: tf.scenes.build("microcoloni"), "Did you mean 'microcolony'?"),
        (lambda: tf.scenes.build("microcolony", {"raet": 1.0}), "Did you mean rate?"),
        (lambda: tf.Mechanics(backend="compile"), "Did you mean 'compiled'?"),
    ],
)
def test_names_that_are_nearly_right_get_the_right_one(call, message):
    with pytest.raises(tf.InputError, match=message.replace("?", r"\?")):
        call()


def test_names_are_near_whatever_their_case_and_hyphens():
    assert checks.suggestion("CMA-ES", ["sobol", "cmaes"]) == "Did you mean 'cmaes'?"
    assert checks.suggestion("Tau leap", ["direct", "tau_leap"]) == "Did you mean 'tau_leap'?"


def test_nothing_is_suggested_for_what_is_no_name():
    assert checks.suggestion(3, ["a"]) == checks.suggestion("zebra", ["rate", 5]) == ""


def test_how_to_install_an_extra_depends_on_where_torchfilm_is(tmp_path, monkeypatch):
    assert checks.install("app") == 'pip install -e ".[app]" in the folder of torchfilm'
    monkeypatch.setattr(checks, "__file__", str(tmp_path / "torchfilm" / "tools" / "checks.py"))
    assert checks.install("app") == 'pip install "torchfilm[app]"'
