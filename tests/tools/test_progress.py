"""Progress bars: where they are shown, what they show, in scripts and in notebooks."""

from __future__ import annotations

import io
import sys

import pytest

import torchfilm as tf
from torchfilm.tools import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def notebook(monkeypatch) -> list[dict]:
    """As in a notebook: what is displayed."""
    shown: list[dict] = []
    monkeypatch.setattr(progress, "in_notebook", lambda: True)
    monkeypatch.setattr(
        progress.Output, "show", lambda self, data, metadata=None: shown.append(data)
    )
    return shown


def run(**options) -> None:
    for _ in tf.simulate(tf.scenes.microcolony(), colonies=2, until=0.5, **options):
        pass


@pytest.mark.parametrize("stream, shown", [(io.StringIO, False), (Terminal, True)])
def test_a_bar_by_default_is_for_terminals(monkeypatch, stream, shown):
    monkeypatch.setattr(sys, "stderr", stream())
    run(progress=None)
    assert ("microcolony: 2 colonies" in sys.stderr.getvalue()) is shown


def test_a_run_is_silent_unless_asked(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    run()
    assert sys.stderr.getvalue() == ""


def test_true_shows_a_bar_anywhere_with_the_last_state(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    run(progress=True)
    last = sys.stderr.getvalue().splitlines()[-1]
    assert "100%" in last and "2 cells, t = 0.50 h" in last and "steps/s" in last


def test_a_file_gets_a_line_now_and_then(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    run(progress=True)
    lines = sys.stderr.getvalue().splitlines()
    assert "\r" not in sys.stderr.getvalue() and len(lines) == 2  # the first and the last state
    assert "0%" in lines[0] and "100%" in lines[1]
    monkeypatch.setattr(progress, "LINES", 0.0)
    with progress.bar(3, "search") as bar:
        for _ in range(3):
            bar.update(1)
            bar.refresh()
    assert [line.split("|")[2].split()[0] for line in sys.stderr.getvalue().splitlines()[2:]] == [
        "0%", "33%", "67%", "100%"
    ]  # fmt: skip


def test_a_bar_in_a_notebook_is_html_and_writes_no_line(monkeypatch, notebook):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    run(progress=None)
    assert sys.stderr.getvalue() == ""
    assert '<progress max="0.5" value="0.5"' in notebook[-1]["text/html"]
    assert "t = 0.50 h" in notebook[-1]["text/html"] and "100%" in notebook[-1]["text/plain"]


def test_a_bar_is_closed_where_a_run_fails(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())

    def fail(state):
        if state.step == 3:
            raise RuntimeError("a fault of an observer")

    with pytest.raises(RuntimeError, match="a fault"):
        run(progress=True, observers=[fail])
    assert sys.stderr.getvalue().endswith("\n")


def test_what_is_no_choice_is_refused():
    with pytest.raises(tf.InputError, match=r"progress = 'yes' .*True, False, or None"):
        run(progress="yes")
