"""The report of a search: the table of its parameters, and the picture of the first guess, the best
design and the target."""

from __future__ import annotations

import dataclasses

import matplotlib.image
import numpy as np
import pytest
import torch
from searching import Level, Spread, banned, built, fragile, lit

import torchfilm as tf
from design import Bands, Batch, Choice, Parameter, Search, Sobol, Target

LIT = [Parameter("make", 0.1, 10, log=True), Parameter("decay", 0.5, 2)]


def searched(scene, parameters, target, colonies=6, method=None, **options):
    made = Search(
        scene,
        parameters,
        target,
        method=method or Sobol(batch=3),
        **{"cells": 3, "replicates": 2, **options},
    )
    return made.run(colonies, progress=False)


def rows(best) -> dict[str, list[str]]:
    """The lines of a table by their first word."""
    return {line.split()[0]: line.split() for line in best.table().splitlines()}


def test_the_table_has_every_parameter_with_bounds_first_guess_and_best():
    parameters = [
        Parameter("make", 1, 2, log=True),
        Parameter("genes", 1, 3, whole=True),
        Choice("promoter", ("weak", "strong")),
    ]
    best = searched(built, parameters, Level("g0", 3.0), 12)
    found, first = rows(best), best.search.first()
    assert list(found)[:5] == ["parameter", "make", "genes", "promoter", "loss"]
    assert found["make"] == [
        "make",
        "1",
        "…",
        "2",
        f"{first.values['make']:.4g}",
        f"{best.values['make']:.4g}",
    ]
    assert found["genes"] == [
        "genes",
        "1",
        "…",
        "3",
        str(first.values["genes"]),
        str(best.values["genes"]),
    ]
    assert found["promoter"] == [
        "promoter",
        "weak",
        "|",
        "strong",
        first.values["promoter"],
        best.values["promoter"],
    ]
    assert found["loss"] == ["loss", f"{first.loss:.4f}", f"{best.loss:.4f}"]
    level = np.mean(
        [
            float(x)
            for d in best.colonies()
            for x in best.search.objective.task.target.measures(d.state)["mean_level"]
        ]
    )
    assert found["mean_level"][-1] == f"{level:.4g}" and best.losses.mean() == pytest.approx(
        abs(level - 3.0), rel=1e-9
    )
    assert best.table().splitlines()[-1].startswith("12 colonies in ") and best.table().endswith(
        "; circuits ran on one recorded growth"
    )


def test_the_table_says_why_growth_was_not_recorded_and_how_many_colonies_failed():
    best = searched(fragile, [Parameter("make", 1, 10)], Level(), 16, Sobol(batch=8), replay=False)
    failed = sum(len(e.reasons) for e in best.search.study.entries)
    assert failed and best.table().endswith(
        f", {failed} failed; grown again for each design: replay=False"
    )


class Given:
    """Proposes these points."""

    def __init__(self, *points):
        self.points = np.array(points)

    def start(self, space, seed, replicates):
        pass

    def ask(self):
        return Batch(self.points)

    def tell(self, batch, loss):
        pass


@dataclasses.dataclass(frozen=True)
class Half(Level):
    """Only the colony of stream 0 can be scored."""

    def loss(self, state, history=None):
        return torch.where(state.stream == 0, super().loss(state), torch.nan)

    def measures(self, state, history=None):
        return {
            "some_um": torch.where(state.stream == 0, 2.5, torch.nan),
            "none_um": torch.full((state.colonies,), torch.nan),
        }


def test_a_measure_is_the_mean_over_the_colonies_that_have_it():
    found = rows(searched(lit, LIT, Half()))
    assert found["some_um"] == ["some_um", "2.5", "2.5"] and found["none_um"] == [
        "none_um",
        "nan",
        "nan",
    ]


@dataclasses.dataclass(frozen=True)
class Two(Level):
    @property
    def names(self):
        return ("g0", "g1", "out.ahl")

    def check(self, state):
        pass


def pictured(best, path) -> np.ndarray:
    assert best.plot(path) == path
    return matplotlib.image.imread(path)[..., :3]


def coloured(image, box=(0.0, 0.55)) -> float:
    """The share of coloured pixels in the part where colonies are drawn."""
    part = image[:, int(box[0] * image.shape[1]) : int(box[1] * image.shape[1])]
    return float(((part.max(2) - part.min(2)) > 0.15).mean())


BEST = {
    "one species": lambda: searched(lit, LIT, Bands(("gfp",), edges=(-2.0, 2.0))),
    "several species and choices": lambda: searched(
        built,
        [Parameter("make", 1, 2), Choice("promoter", ("weak", "strong"))],
        Two("g0"),
        fixed={"genes": 2},
    ),
    "no species": lambda: searched(lit, LIT, Spread()),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", BEST)
def test_a_picture_shows_the_colonies(tmp_path, kind):
    assert coloured(pictured(BEST[kind](), tmp_path / "best.png")) > 0.01


@pytest.mark.slow
def test_what_failed_is_left_out_of_the_picture_and_the_table(tmp_path):
    """The first guess fails during the run, or the scene refuses it. The best design is drawn."""
    broken = searched(
        fragile, [Parameter("make", 1, 10)], Level(), method=Given([0.9], [0.2]), cells=6
    )
    assert broken.search.first().loss == 1.5 and broken.losses[0] != 1.5
    refused = searched(
        banned,
        [Parameter("low", 3.0, 4.0), Parameter("make", 1, 2)],
        Level(),
        method=Given([0.3, 0.5], [0.1, 0.5]),
    )
    assert refused.search.first().loss == 1.5
    for best in (broken, refused):
        assert rows(best)["mean_level"][1] == "nan" and rows(best)["loss"][1] == "1.5000"
        assert coloured(pictured(best, tmp_path / "best.png")) > 0.01


@pytest.mark.slow
def test_a_picture_is_drawn_where_every_design_failed(tmp_path):
    best = searched(
        fragile,
        [Parameter("make", 1, 10)],
        Level(),
        colonies=4,
        method=Given([0.9], [0.8]),
        cells=6,
    )
    assert best.loss == 1.5 and best.colonies() == []
    assert pictured(best, tmp_path / "best.png").size and "4 colonies" in best.table()


def test_a_target_draws_on_each_colony_that_is_shown(tmp_path):
    drawn = []

    @dataclasses.dataclass(frozen=True)
    class Drawn(Target):
        def loss(self, state, history=None):
            return torch.zeros(state.colonies, dtype=torch.float64)

        def note(self, state):
            return state.counts.double().unsqueeze(1)

        def draw(self, ax, state, place, history=None):
            assert history.shape[1:] == (state.colonies, 1) and float(
                history[-1, place, 0]
            ) == float(state.counts[place])
            drawn.append(int(state.colony_id[place]))

    searched(lit, LIT, Drawn(), 15, replicates=5).plot(tmp_path / "best.png")
    assert drawn == [0, 1, 2, 0, 1, 2]


def test_both_designs_are_drawn_with_one_scale_of_colours(tmp_path, monkeypatch):
    """So that a first guess that is darker than the best design looks darker."""
    seen, levels, draw_cells = [], [], tf.pictures.draw_cells

    def watched(ax, cells, **options):
        seen.append(options["limits"])
        levels.append(float(cells["gfp"].max()))
        return draw_cells(ax, cells, **options)

    monkeypatch.setattr(tf.pictures, "draw_cells", watched)
    searched(lit, LIT, Bands(("gfp",), edges=(-2.0, 2.0))).plot(tmp_path / "best.png")
    assert len(seen) == 4 and len(set(levels)) > 1
    assert all(limits == {"gfp": (0.0, max(levels))} for limits in seen)


def test_a_bad_picture_name_is_refused(tmp_path):
    best = searched(lit, LIT, Spread())
    with pytest.raises((tf.InputError, ValueError), match="Format 'xyz' is not supported"):
        best.plot(tmp_path / "best.xyz")
