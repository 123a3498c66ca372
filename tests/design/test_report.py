"""The report of a search: the table of its parameters, and the picture of the first guess, the best
design and the target."""

from __future__ import annotations

import dataclasses
import itertools
from types import SimpleNamespace

import matplotlib.image
import matplotlib.text
import numpy as np
import pytest
import torch
from patterned import crowded, row
from searching import Level, Spread, banned, built, fragile, lit, uneven

import torchfilm as tf
from design import (
    Bands,
    Batch,
    Choice,
    Measured,
    Objective,
    OnFraction,
    Parameter,
    Search,
    Sobol,
    Stripe,
    Target,
    Task,
    Weighted,
)
from design.finals import FreshLosses
from design.report import _same_losses, table
from design.report_plot import draw
from design.trivial import BRIGHT, LEVELS, trivial_losses

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
    assert found["mean_level"][2] == f"{level:.4g}" and best.losses.mean() == pytest.approx(
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


def test_the_table_says_how_long_a_slow_method_took_to_choose(tmp_path, monkeypatch):
    """The time is kept in the study's file, also that of a batch grown in two parts."""
    clock = SimpleNamespace(perf_counter=itertools.count(0.0, 3.0).__next__)
    monkeypatch.setattr("design.proposal.time", clock)
    for colonies in (12, 32):
        search = Search(
            lit, LIT, Level(), cells=3, replicates=2, method=Sobol(batch=8), finals=None
        )
        best = search.run(colonies, study=tmp_path / "study.h5", progress=False)
    assert ", and 6 s to choose designs" in best.table().splitlines()[-1]
    assert ", and 6 s to choose designs" in best.search.study.info


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
    best = searched(lit, LIT, Half())
    count = len(best.losses)
    some, none = ("".join(f"(undefined in {n} of {count})".split()) for n in (count - 1, count))
    shown = {name: [*row[:3], "".join(row[3:])] for name, row in found.items()}
    assert shown["some_um"] == ["some_um", "2.5", "2.5", some]
    assert shown["none_um"] == ["none_um", "nan", "nan", none]


@dataclasses.dataclass(frozen=True)
class Two(Level):
    pattern = False  # no scene here has the signal, so nothing without a pattern is scored

    @property
    def names(self):
        return ("g0", "g1", "out.ahl")

    def check(self, state):
        pass


def pictured(best, path) -> np.ndarray:
    assert best.plot(path).path == path
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
    assert broken.search.first().loss == Target.failed and broken.losses[0] != Target.failed
    refused = searched(
        banned,
        [Parameter("low", 3.0, 4.0), Parameter("make", 1, 2)],
        Level(),
        method=Given([0.3, 0.5], [0.1, 0.5]),
    )
    assert refused.search.first().loss == Target.failed
    for best in (broken, refused):
        assert rows(best)["mean_level"][1] == "nan" and rows(best)["loss"][1] == "1e+09"
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
    assert best.loss == Target.failed and best.colonies() == []
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


@pytest.mark.parametrize(
    "target",
    [
        OnFraction("gfp", 0.3, 1e3),
        Bands(("gfp",), edges=(-2.0, 2.0), floor=1e3),
        Weighted([(OnFraction("gfp", 0.3, 1e3), 1.0), (Bands(("gfp",), (-2.0, 2.0)), 1.0)]),
    ],
)
def test_colours_reach_what_the_target_calls_lit(target):
    """So that the best of dark designs does not look lit."""
    figure = draw(searched(lit, LIT[:1], target)._report())
    bar = next(ax for ax in figure.axes if ax.get_title() == "gfp (conc)")
    assert [t.get_text() for t in bar.get_xticklabels()] == ["0", "500", "1000"]


def sniffing(reach=1.0):
    """Cells that find more of a signal at the left, whose production differs between designs."""
    found = tf.Signal(0.0, source=lambda p: (p[:, 0] < 0).double())
    circuit = tf.Circuit(lambda u, s, p, cell: {"gfp": p.reach * s.m}, species="gfp", reach=reach)
    return tf.Scene(
        circuit, tf.Medium(m=found, box=((-9, -9), (9, 9)), spacing=3.0), dim=2, dt=0.1,
        founders=tf.inoculum(20, radius=8.0, seed=1),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("target", "title"),
    [
        (Bands(("out.m",), edges=(-9.0, 0.0)), "out.m (conc)"),
        (Measured({"most": lambda s: s.groups.max(s.gfp)}, {"most": 0.1}, {"most": 1.0}), "gfp ("),
    ],
)  # fmt: skip
def test_what_a_target_reads_outside_of_cells_is_shown_and_else_a_species(target, title):
    reach = [Parameter("reach", 0.1, 10.0, log=True)]
    figure = draw(searched(sniffing, reach, target, cells=None, until=0.2)._report())
    bar = next(ax for ax in figure.axes if ax.get_title().startswith(title))
    shown = [ax for ax in figure.axes if ax.get_title().startswith(("first guess", "best"))]
    colours = {tuple(c) for ax in shown for x in ax.collections for c in x.get_facecolors()}
    assert bar.get_visible() and len(colours) > 1


def test_trivial_answers_are_reduced_as_the_designs_are():
    target = Stripe("gfp", at=0.0, width=1.0)
    options = {"colonies": 8, "replicates": 4, "cells": 7}
    words = [
        next(line for line in searched(uneven, LIT[:1], target, reduce=reduce, **options)
             .table().splitlines() if line.startswith("without a pattern"))
        for reduce in ("mean", "worst")
    ]  # fmt: skip
    mean, worst = ([float(part.split()[-1]) for part in line.split(", ")] for line in words)
    assert mean != worst and all(m <= w for m, w in zip(mean, worst, strict=True))


def test_a_picture_says_what_it_shows():
    """The target and its marks in the title, the best trivial loss as a line, the unit at the
    colours."""
    target = Stripe("gfp", at=0.0, width=2.0)
    found = searched(lit, LIT, target)._report()
    figure = draw(found)
    assert figure._suptitle.get_text() == f"target: {target.describe()}\nred lines"
    words = [t.get_text() for ax in figure.axes for t in ax.texts]
    answers = trivial_losses(target, found.best.colonies)
    least = min(answers, key=answers.get)
    assert f"without a pattern: {least}" in words
    levels = [line.get_ydata()[0] for ax in figure.axes for line in ax.lines]
    assert answers[least] in levels
    unit = found.best.colonies[0].state.declared["gfp"].unit
    assert unit and any(f"gfp ({unit})" in t.get_text() for t in _texts(figure))


def _texts(figure):
    return [t for t in figure.findobj(matplotlib.text.Text) if t.get_text()]


def test_a_bad_picture_name_is_refused(tmp_path):
    best = searched(lit, LIT, Spread())
    with pytest.raises(tf.InputError, match=r"best\.xyz.*ends in \.png, \.pdf or \.svg"):
        best.plot(tmp_path / "best.xyz")


# --- what a winner is worth -----------------------------------------------------------------------

WIDE = Bands(("gfp",), (-50.0, 50.0), floor=0.5)  # every cell lies in the band
PAIR = [Parameter("make", 1.0, 10.0), Parameter("decay", 0.1, 1.0)]


def test_a_pattern_that_an_even_level_has_is_no_pattern():
    text = searched(lit, PAIR, WIDE).table()
    line = next(x for x in text.splitlines() if x.startswith("without a pattern"))
    assert "all dark 1.000" in line and "all lit 0.000" in line
    assert "no better than 'all lit'" in text or "no better than 'best even level'" in text


@pytest.mark.parametrize(
    "share, words",
    [(1.1, "no better than"), (0.5, "is weak: the best design has 0.50 of the loss"), (0.2, "")],
)
@pytest.mark.parametrize("tested", [False, True])
def test_a_pattern_is_told_from_a_weak_one_and_from_none(share, words, tested):
    """By the loss on fresh seeds, where there is one: that of the search is luck, too."""
    target = Bands(("gfp",), (-1.0, 1.0), floor=0.5)
    found = searched(lit, PAIR, target, 4)._report()
    least = min(trivial_losses(target, found.best.colonies).values())
    assert least > 0.01, "every answer is good"
    lucky = FreshLosses(np.full(8, share * least), share * least, (share * least, share * least))
    loss, fresh = (share * least, None) if not tested else (0.1 * least, lucky)
    best = dataclasses.replace(found.best, loss=loss, fresh=fresh)
    text = table(dataclasses.replace(found, best=best))
    assert words in text and ("weak" in text or "no better" in text) == bool(words)


def test_the_table_says_why_a_measure_is_undefined():
    text = searched(lit, PAIR, Stripe("gfp", at=0.0, width=20.0)).table()
    assert "(undefined in 2 of 2)" in text
    line = next(x for x in text.splitlines() if x.startswith("contrast is undefined: "))
    assert "farther than 40 µm" in line and "grow larger colonies" in line
    assert "outside is undefined: no cell lies where" in searched(lit, PAIR, WIDE).table()
    assert "is undefined" not in searched(lit, PAIR, Level()).table()


def test_trivial_answers_are_those_of_the_target():
    """Every second cell lit, and all lit, by the formula of the target, for each colony."""
    half = Bands(("gfp",), (0.0, 50.0), edge_width=0.01)
    best = searched(lit, PAIR, half)
    found = trivial_losses(half, best.colonies())
    lit_losses = []
    for part in best.colonies():
        state = part.state.with_fields(gfp=torch.ones_like(part.state.fields["gfp"]))
        lit_losses += half.loss(state).tolist()
    assert found["all lit"] == pytest.approx(np.mean(lit_losses))
    assert found["best even level"] == pytest.approx(found["all lit"]) and found["all dark"] == 1.0
    assert found["every second lit"] > found["all lit"]


def test_the_best_even_level_is_that_of_the_least_loss():
    finished = SimpleNamespace(state=row([0.0, 3.0], gfp=1.0), history=None)
    levels = np.geomspace(1e-6, 1.0, LEVELS) * BRIGHT
    found = trivial_losses(Level(wanted=1.5), [finished])["best even level"]
    assert found == pytest.approx(np.abs(levels - 1.5).min()) and found < 0.5


def test_numbers_on_a_bound_are_marked():
    """The more is made, the nearer to 30: the best make lies at its bound."""
    best = searched(lit, PAIR, Level("gfp", 30.0), 8, Given([0.5, 0.5], [1.0, 0.3]))
    table = best.table()
    line = next(x for x in table.splitlines() if x.startswith("make"))
    assert line.endswith("at its upper bound")
    assert "at a bound: make; better values may lie beyond it." in table
    assert "at its" not in next(x for x in table.splitlines() if x.startswith("decay"))


def test_the_table_shows_how_many_cells_the_colonies_have():
    best = searched(lit, PAIR, WIDE)
    counts = [n for d in best.colonies() for n in d.state.counts.tolist()]
    line = next(x for x in best.table().splitlines() if x.startswith("cells"))
    shown = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)}–{max(counts)}"
    assert line.split()[-1] == shown


def test_a_colony_that_stays_too_small_has_failed():
    """It ends by its time with a fraction of the cells that were asked for."""
    objective = Objective(Task(lit, PAIR, WIDE, cells=40, until=0.5, replicates=2))
    found = objective.evaluate(np.array([[0.5, 0.5]]))
    assert (found.losses == WIDE.failed).all() and len(found.reasons) == 2
    assert "and 20, half of 40, are needed" in found.reasons[0, 0]
    only_time = Objective(Task(lit, PAIR, WIDE, until=0.5, replicates=1))
    reason = only_time.evaluate(np.array([[0.5, 0.5]])).reasons[0, 0]
    assert "and 10, the least for Bands, are needed" in reason
    # who asks for a few cells gets them
    few = Objective(Task(lit, PAIR, WIDE, cells=4, replicates=1))
    assert not few.evaluate(np.array([[0.5, 0.5]])).reasons


def test_a_colony_without_the_type_that_a_stripe_needs_has_failed():
    state = crowded()
    lost = torch.where(state.colony == 2, 0, state.cell_type)
    state = state.with_fields(cell_type=lost)
    words = Stripe("yfp", width=4.0, cell_type=1).unfit(state)
    assert [bool(w) for w in words] == [False, False, True, False]
    assert "no border" in words[2]
    words = Stripe("yfp", at=0.0, width=4.0, cell_type=1).unfit(state)
    assert "no cells of type 1" in words[2] and not any(words[:2])


def test_a_marker_lies_at_the_option_that_is_used():
    """The task uses the second option where the search has drawn the first."""
    other = lambda values: {"promoter": "strong"}
    choice = Choice("promoter", ("weak", "strong"), resolve=other)
    best = searched(built, [Parameter("make", 1, 2), choice], Two("g0"), fixed={"genes": 2},
                    method=Given([0.5, 0.1], [0.2, 0.3]))  # fmt: skip
    assert best.values["promoter"] == "strong"
    figure = draw(best._report())
    (axes,) = (ax for ax in figure.axes if "promoter = strong" in
               [t.get_text() for t in ax.get_yticklabels()])  # fmt: skip
    for line in axes.lines[:2]:
        x, y = line.get_data()
        assert float(x[int(np.argmin(y))]) == 0.75


@pytest.mark.parametrize("second, alike", [(0.7, True), (0.2, False)])
def test_parameters_make_no_difference_only_where_they_make_none_on_any_seed(second, alike):
    """Ten designs on one seed, then four on two, as polishing leaves them."""
    losses = [np.full((10, 1), 1.0), np.array([[1.0, 0.7]] * 3 + [[1.0, second]])]
    task = SimpleNamespace(goals=(), target=Level("gfp"), space=SimpleNamespace(names=["make"]))
    study = SimpleNamespace(entries=[SimpleNamespace(size=1, losses=x) for x in losses])
    report = SimpleNamespace(task=task, study=study, best=SimpleNamespace(loss=0.7))
    assert ("depends on make" in _same_losses(report)) == alike
