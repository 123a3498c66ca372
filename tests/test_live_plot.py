"""The live picture of a run: what it draws, when, and where."""

from __future__ import annotations

import io

import matplotlib.image
import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.pictures import live


@pytest.fixture
def scene() -> tf.Scene:
    return tf.scenes.microcolony()


@pytest.fixture
def notebook(monkeypatch) -> list[dict]:
    """As in a notebook: what is displayed."""
    shown: list[dict] = []
    monkeypatch.setattr(live, "in_notebook", lambda: True)
    monkeypatch.setattr(live.Output, "show", lambda self, data, metadata=None: shown.append(data))
    return shown


def pixels(path) -> np.ndarray:
    return matplotlib.image.imread(path)


def test_the_last_state_is_drawn_however_rarely_it_draws(scene, tmp_path):
    plot = tf.LivePlot(tmp_path / "live.png", seconds=1e6, dpi=50, colour="length")
    *_, state = tf.simulate(scene, until=1.0, colonies=2, observers=[plot])
    tf.show(state, colour="length", dpi=50, out=tmp_path / "last.png")
    assert np.array_equal(pixels(tmp_path / "live.png"), pixels(tmp_path / "last.png"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["last.png", "live.png"]


def test_it_draws_the_first_state_and_then_as_often_as_it_may(scene, tmp_path, monkeypatch):
    drawn: list[float] = []
    monkeypatch.setattr(live.LivePlot, "_put", lambda self, figure: drawn.append(self.last.time))
    for seconds, most in ((1e6, 2), (0.0, 100)):
        drawn.clear()
        plot = tf.LivePlot(tmp_path / "live.png", seconds=seconds, dpi=30)
        for _ in tf.simulate(scene, until=0.5, observers=[plot]):
            pass
        assert drawn[0] == 0.0 and drawn[-1] == 0.5 and 2 <= len(drawn) <= most


def test_a_notebook_shows_it_without_a_path(scene, notebook):
    *_, state = tf.simulate(scene, until=0.5, observers=[tf.LivePlot(seconds=1e6, dpi=50)])
    assert len(notebook) == 2
    last = matplotlib.image.imread(io.BytesIO(notebook[-1]["image/png"]))
    again = matplotlib.image.imread(io.BytesIO(tf.show(state, dpi=50)._repr_png_()[0]))
    assert np.array_equal(last, again)


def test_it_also_draws_the_state_at_which_a_run_fails(scene, tmp_path):
    def fail(state):
        if state.step == 3:
            raise RuntimeError("a fault of an observer")

    seen = []
    plot = tf.LivePlot(tmp_path / "live.png", seconds=1e6, dpi=30)
    plot._draw = lambda state: seen.append(state.step)
    with pytest.raises(RuntimeError, match="a fault"):
        for _ in tf.simulate(scene, until=0.5, observers=[plot, fail]):
            pass
    assert seen[-1] == 3


def test_colonies_without_cells_are_left_out(scene, tmp_path):
    state = scene.bind(2).start()
    plot = tf.LivePlot(tmp_path / "live.png", colonies=[1], dpi=30)
    plot(state.remove(torch.tensor([False, True]), "removed"))
    assert not (tmp_path / "live.png").exists(), "none of its colonies is left"
    plot.close()
    other = tf.LivePlot(tmp_path / "live.png", dpi=30)
    other(state.remove(torch.tensor([True, True]), "removed"))
    assert not (tmp_path / "live.png").exists()
    other.close()


@pytest.mark.parametrize(
    "options, words",
    [
        ({}, r"LivePlot\.out = None .*a script.*notebook needs none"),
        ({"out": "live"}, "ends in .png"),
        ({"out": "live.txt"}, r"live\.txt.*ends in \.png, \.pdf or \.svg"),
        ({"out": "a.png", "limits": (0, 1)}, r"limits = \(0, 1\).*ranges by name"),
        ({"out": "a.png", "colonies": 1}, r"Write colonies=\[1\]"),
        ({"out": "a.png", "most": "4"}, "most = '4'"),
        ({"out": "a.png", "dpi": "1"}, "dpi = '1' .*a number"),
        ({"out": "a.png", "seconds": -1.0}, r"LivePlot\.seconds = -1"),
        ({"out": "a.png", "view": "up"}, "view = 'up'"),
        ({"out": "a.png", "channels": {"yfp": "no colour"}}, "no colour"),
    ],
)
def test_what_is_not_allowed_is_refused_before_the_run(options, words):
    with pytest.raises(tf.InputError, match=words):
        tf.LivePlot(**options)
