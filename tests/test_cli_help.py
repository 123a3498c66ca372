"""The command `torchfilm help`: every public name has a signature and a docstring to read."""

from __future__ import annotations

import inspect

import pytest
from commands import shell

import design
import torchfilm as tf
from torchfilm.cli.help import describe, listing


@pytest.mark.slow
def test_the_command_in_a_shell(tmp_path):
    done = shell("help", "Growth", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    signature, _, about = done.stdout.partition("Cells grow longer.\n")
    # on one line, or a line for each parameter
    assert "".join(signature.split()).startswith("tf.Growth(rate:Value|None=None,law:str='volume'")
    assert "rate: 1/h" in about
    done = shell("help", "growht", folder=tmp_path)
    assert done.returncode == 1 and "Did you mean tf.Growth?" in done.stderr


def test_every_public_name_is_listed_and_has_a_docstring():
    lines = listing().splitlines()
    names = [f"tf.{n}" for n in tf.__all__ if not n.startswith("_")]
    names += [f"design.{n}" for n in design.__all__]
    for name in names:
        assert [line for line in lines if line.startswith(f"  {name}  ")], name
        assert len(describe(name).splitlines()) >= 2, name
        assert " at 0x" not in describe(name), name


def test_members_are_found_with_and_without_the_package():
    whole = describe("tf.Circuit.from_sbml")
    assert whole == describe("Circuit.from_sbml") == describe("torchfilm.Circuit.from_sbml()")
    assert whole.startswith("tf.Circuit.from_sbml(\n    path: str | Path,\n    *,\n    signals:")
    assert whole.endswith(inspect.getdoc(tf.Circuit.from_sbml).splitlines()[-1])
    assert "design.Search.run" in describe("Search") and "self" not in describe("Search.run")
    assert describe("Results.times").startswith("tf.Results.times: property\n(F,) h")
    assert "  tf.scenes.channel  Cells in a channel" in describe("scenes")
    assert "(Fig. " in describe("scenes")  # a point within brackets ends no sentence


def test_methods_of_a_public_base_are_named_once():
    text = describe("Stripe")
    assert "design.Stripe.winds" in text and "design.Stripe.loss" not in text
    assert text.endswith("It also has the methods of design.ProfileTarget, design.Target.")


def test_names_that_are_not_public():
    for name in ("tf._LAZY", "Scene.effectss", "design.nothing", "", "os"):
        with pytest.raises(tf.InputError, match="public name"):
            describe(name)
    with pytest.raises(tf.InputError, match=r"Did you mean design\.Library"):
        describe("tf.Library")


def test_a_method_is_found_by_its_own_name():
    assert describe("relaxed") == describe("Cells.relaxed")
    assert describe("to_labels()") == describe("Results.to_labels")
    assert describe("microcolony") == describe("tf.scenes.microcolony")
    classes = (
        r"mean tf\.Cells\.from_table, tf\.Lineage\.from_table or design\.Observed\.from_table\?"
    )
    with pytest.raises(tf.InputError, match=classes):
        describe("from_table")
    both = r"Did you mean tf\.Cells\.from_masks or design\.Observed\.from_masks\?"
    for name in ("from_masks", "from_mask"):
        with pytest.raises(tf.InputError, match=both):
            describe(name)
