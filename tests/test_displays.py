"""What notebooks display: names and values as HTML, short lines in a terminal."""

from __future__ import annotations

import subprocess
import sys
from html.parser import HTMLParser

import pytest

import torchfilm as tf
from design import Burden, Observed, Parameter, Search, Sobol

VOID = ("br", "img", "hr")


class Page(HTMLParser):
    """The text of HTML, and whether its tags close in order."""

    def __init__(self, html: str):
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(html)
        assert self.open == [], "all tags are closed"
        self.text = " ".join(self.words)

    def handle_starttag(self, tag, attrs):
        self.open += [tag] if tag not in VOID else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def page(x) -> str:
    return Page(x._repr_html_()).text


def _rates(u, s, p, cell):
    return {"gfp": p.make - p.lose * u.gfp}


def scene(make=2.0) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=1.25),
        tf.Division(length=tf.Uniform(3.5, 4.5)),
        tf.Mechanics(dim=2),
        tf.Circuit(_rates, species=("gfp",), make=make, lose=0.5),
        dt=0.05,
    )


def test_a_scene_shows_its_effects_and_equations():
    shown = page(scene())
    for word in ("rate = 1.25", "Uniform(low=3.5, high=4.5)", "Mechanics", "make − lose·gfp"):
        assert word in shown
    assert "before dilution by growth" in shown


def test_rates_that_are_no_equations_are_said_to_be_so():
    def strange(u, s, p, cell):
        return {"gfp": u.gfp.sort().values}

    made = tf.Scene(tf.Growth(rate=1.0), tf.Circuit(strange, species=("gfp",)), dim=2)
    assert "cannot be written as equations" in page(made)


def test_text_is_escaped():
    made = tf.Scene(tf.Growth(rate=1.0), dim=2, name="<b>&")
    assert "&lt;b&gt;&amp;" in made._repr_html_() and "<b>" not in made._repr_html_()
    words = Page(tf.displays.table([["<i>", 1.5]], ["a<b", ""])).words
    assert words == ["a<b", "<i>", "1.5"]


def test_a_state_shows_ranges_with_units():
    state = scene().bind(3).start()
    shown = page(state)
    assert "State(3 colonies, 3 cells" in shown and "µm" in shown and "gfp" in shown
    assert "circuit_volume" not in shown, "what serves the numerics is hidden"
    empty = state.remove(state.colony >= 0, "removed")
    assert "0 cells" in page(empty)


def test_results_show_what_they_hold_also_when_closed(tmp_path):
    for _ in tf.simulate(scene(), until=0.5, colonies=2, record=tmp_path / "run.h5"):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        assert "2 colonies, 2 frames, 0 to 0.5 h" in repr(results)
        assert "gfp" in page(results) and "circuit_volume" not in page(results)
    assert repr(results).endswith("closed)") and "closed" in page(results)


@pytest.fixture(scope="module")
def search() -> Search:
    made = Search(
        scene,
        [Parameter("make", 1, 10)],
        Burden(("gfp",)),
        cells=4,
        replicates=2,
        method=Sobol(batch=4),
    )
    made.run(16)
    return made


def test_the_best_design_shows_its_parameters_and_grows_nothing(search, monkeypatch):
    monkeypatch.setattr(type(search), "colonies", lambda *_: pytest.fail("a display grew colonies"))
    shown = page(search.best())
    for word in ("make", "1 … 10", "first guess", "loss in the search", "colonies in"):
        assert word in shown


def test_a_study_shows_its_best_designs(search):
    shown = page(search.study)
    for word in ("target", "method", "best loss", "loss", "cells", "make"):
        assert word in shown
    assert repr(search.study).startswith("Study(scene, ") and "best loss" in repr(search.study)
    assert search.study.info.splitlines()[0].startswith("scene       scene, to 4 cells")


def test_a_search_shows_how_far_it_has_come(search):
    assert repr(search) == "Search(scene, of make: 16 colonies so far)"
    assert "best loss" in page(search) and "parameter" in page(search)


def test_data_are_shown_as_a_table():
    seen = Observed.from_table({"length_um": [2.0, 3.0, 2.5], "colony": [0, 0, 1]})
    assert "length" in page(seen) and "±" in page(seen)


def test_tables_keep_their_lines_where_a_cell_ends_with_them(search):
    seen = Observed.from_table({"length_um": [2.0, 3.0, 2.5], "colony": [0, 0, 1]})
    for text in (search.best().table(), search.study.table(), search.study.info, seen.table()):
        assert repr(text) == str(text) and "\n" in repr(text) and "<pre" in text._repr_html_()


def test_ipython_is_not_imported():
    code = "import sys, torchfilm, design; sys.exit('IPython' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
