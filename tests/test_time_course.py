"""The picture of a run against time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf
from torchfilm.pictures.categories import KINDS

matplotlib = pytest.importorskip("matplotlib")


def makes(u, s, p, cell):
    return {"gfp": p.make - u.gfp}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("time_course") / "run.h5"
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(2.5, 3.5)),
        tf.Circuit(makes, species="gfp", make=torch.linspace(1.0, 2.0, 5)),
        tf.Lysis(rate=torch.tensor([0.0, 0.0, 0.0, 0.0, 1e9])),
        tf.Medium(m=tf.Signal(diffusion=0.0, initial=lambda x: x[:, 0] + 9.0), spacing=1.0,
                  box=((-9, -9), (9, 9))), dim=2, dt=0.1,
    )  # fmt: skip
    list(tf.simulate(scene, until=3.0, record=path, seed=2))
    return path


def lines(ax) -> list[tuple[np.ndarray, np.ndarray]]:
    return [line.get_xydata().T for line in ax.lines]


def test_it_shows_the_counts_and_the_means_of_the_cells(run, tmp_path):
    picture = tf.pictures.time_course(run, "gfp", "out.m", colonies=[0, 3], out=tmp_path / "t.png")
    assert (tmp_path / "t.png").exists()
    counts, gfp, outside = picture.figure.axes
    with tf.Results(run) as results:
        for k, colony in enumerate((0, 3)):
            times, drawn = lines(counts)[k]
            assert np.array_equal(times, results.times)
            assert np.array_equal(drawn, results.counts[:, colony])
            for f in range(len(results)):
                frame = results.frame(f)
                mine = frame["colony"] == colony
                assert lines(gfp)[k][1][f] == pytest.approx(frame["gfp"][mine].mean())
                signal = results.signals_at_cells(f)["m"][mine]
                assert lines(outside)[k][1][f] == pytest.approx(signal.mean())
                low, high = np.percentile(frame["gfp"][mine], [10, 90])
                band = gfp.collections[k].get_paths()[0].vertices
                at = band[np.isclose(band[:, 0], results.times[f])][:, 1]
                assert at.min() == pytest.approx(low) and at.max() == pytest.approx(high)
    assert gfp.get_ylabel() == "mean of gfp (conc)" and outside.get_xlabel() == "time (h)"
    shown = [t.get_text() for t in counts.get_legend().get_texts()]
    assert shown == ["make = 1, rate = 0", "make = 1.75, rate = 0"]


def test_colonies_that_die_leave_the_picture_and_many_have_no_bands(run):
    """The last one is gone after the first frame."""
    picture = tf.pictures.time_course(run, "gfp")
    counts, gfp = picture.figure.axes
    assert len(counts.lines) == 5 and not gfp.collections
    assert np.isnan(lines(counts)[4][1][1:]).all() and lines(counts)[4][1][0] == 1
    two = tf.pictures.time_course(run, most=2)
    assert len(two.figure.axes[0].lines) == 2
    assert "first 2 of 5 colonies" in two.figure._suptitle.get_text()


def kills(cells):
    cells.remove_flag = (cells.time > 0.55) & (cells.cell_type == 1)


@pytest.mark.parametrize(("stay", "scale"), [(1, "linear"), (30, "symlog")])
def test_cells_that_die_out_are_marked_at_0_and_the_run_is_shown_to_its_end(tmp_path, stay, scale):
    """Of two types in two colonies, type 1 is gone at 0.7 h; colony 1 had no other."""
    path = tmp_path / "run.h5"
    cells = tf.Cells([[3.0 * k, 0.0] for k in range(stay + 2)], [1.0, 0.0],
                     cell_type=[0] * stay + [1, 1], colony=[0] * (stay + 1) + [1])  # fmt: skip
    scene = tf.Scene(tf.Rules(kills), founders=cells, dim=2, dt=0.1)
    tf.simulate(scene, until=2.0, record=tf.Recorder(path, scene, every=1)).last()
    with tf.Results(path) as results:
        first = float(results.times[results.counts[:, 1] == 0][0])
    assert first == pytest.approx(0.7)
    for options, died in (({"by": "cell_type"}, 2), ({"colonies": [1]}, 1)):
        (ax,) = tf.pictures.time_course(path, **options).figure.axes
        low, high = ax.get_xlim()
        assert low < 0.0 and 2.0 < high < 2.2
        marks = [x for c in ax.collections for x in c.get_offsets().tolist() if x != [0.0, 0.0]]
        zeros = [x.tolist() for c in ax.collections if hasattr(c, "get_segments")
                 for x in c.get_segments()]  # fmt: skip
        np.testing.assert_allclose(marks, [[first, 0.0]] * died)
        np.testing.assert_allclose(zeros, [[[first, 0.0], [2.0, 0.0]]] * died)
        assert ax.get_yscale() == (scale if "by" in options else "linear")
        bottom, top = ax.get_ylim()
        assert bottom < 0.0 < top and 0.0 in ax.get_yticks()


@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        (("gpf",), {}, "quantity = 'gpf'.*Did you mean 'gfp'"),
        (("m",), {}, "What is outside of cells is 'out.m'"),
        ((["gfp"],), {}, r"quantity = \['gfp'\].*Several follow one another"),
        ((), {"colonies": [7]}, "colonies"),
        ((), {"most": 0}, "most"),
        ((), {"dpi": 0}, "dpi"),
    ],
)
def test_bad_input(run, names, options, words):
    with pytest.raises(tf.InputError, match=words):
        tf.pictures.time_course(run, *names, **options)


def test_cells_of_each_type_are_counted_apart(tmp_path):
    founders = tf.Cells(
        [[0.0, 0.0], [20.0, 0.0]] * 2, [[1.0, 0.0]] * 4, cell_type=[0, 1] * 2, colony=[0, 0, 1, 1]
    )
    scene = tf.Scene(tf.Growth(rate={0: 2.0, 1: 0.5}), tf.Division(length=4.0), founders=founders)
    path = tmp_path / "types.h5"
    states = list(tf.simulate(scene, until=1.0, dt=0.1, record=path))
    picture = tf.pictures.time_course(path, "length", by="cell_type")
    cells, lengths = picture.figure.axes
    labels = [line.get_label() for line in cells.lines]
    assert labels == [f"colony {c}, cell_type {k}" for c in (0, 1) for k in (0, 1)]
    assert [line.get_linestyle() for line in cells.lines] == ["-", "-", "--", "--"]
    colours = [line.get_color() for line in cells.lines]
    assert colours[0] == colours[2] != colours[1] == colours[3]
    last = states[-1]
    for k, line in enumerate(cells.lines):
        mine = (last.colony == k // 2) & (last.cell_type == k % 2)
        assert line.get_ydata()[-1] == int(mine.sum())
        drawn = lengths.lines[k].get_ydata()[-1]
        assert drawn == pytest.approx(float(last.length[mine].mean()), rel=1e-5)
    with pytest.raises(tf.InputError, match=r"by = .length.*a field of whole numbers"):
        tf.pictures.time_course(path, by="length")
    with pytest.raises(tf.InputError, match=r"one of .*cell_type"):
        tf.pictures.time_course(path, by="cell_typ")


def test_bands_are_of_the_middle_cells_and_few_counts_are_even(tmp_path):
    """Four colonies of eleven cells at rest, as long as 0, 1, …, 10 µm."""
    path, size = tmp_path / "run.h5", range(11)
    cells = tf.Cells([[3.0 * k, 0.0] for k in size], [1.0, 0.0], [float(k) for k in size])
    scene = tf.Scene(tf.Growth(rate=0.0), founders=cells, dim=2, dt=0.1)
    record = tf.Recorder(path, scene, every=1)
    tf.simulate(scene, colonies=4, until=0.3, record=record).last()
    counts, lengths = tf.pictures.time_course(path, "length").figure.axes
    assert len(lengths.collections) == 4 and counts.get_yscale() == "linear"
    band = lengths.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == pytest.approx((1.0, 9.0))


def test_replicates_are_thin_lines_of_one_colour_beside_their_mean(tmp_path):
    path = tmp_path / "run.h5"
    circuit = tf.Circuit(makes, species="gfp", make=torch.tensor([1.0, 1.0, 2.0]))
    first = {"gfp": torch.tensor([0.0, 3.0, 1.0])}
    start = tf.Cells([[0.0, 0.0]] * 3, [[1.0, 0.0]] * 3, cell_type=[0] * 3,
                     colony=[0, 1, 2], extra=first)  # fmt: skip
    tf.simulate(tf.Scene(circuit, dim=2, founders=start, dt=0.1), until=0.5, record=path).last()
    figure = tf.pictures.time_course(path, "gfp").figure
    one, two, mean, alone = figure.axes[1].lines
    assert one.get_color() == two.get_color() == mean.get_color() != alone.get_color()
    assert one.get_linewidth() == two.get_linewidth() < mean.get_linewidth()
    np.testing.assert_allclose(mean.get_ydata(), (one.get_ydata() + two.get_ydata()) / 2)
    assert abs(one.get_ydata() - two.get_ydata()).max() > 1.0
    shown = [text.get_text().replace("\u2009", " ") for text in figure.axes[0].get_legend().texts]
    assert shown == ["make = 1, mean of 2", "make = 2"]
    # by kind, too: a colour for each, and a style for each condition
    split = tf.pictures.time_course(path, "gfp", by="cell_type").figure.axes
    shown = [text.get_text() for text in split[0].get_legend().texts]
    assert shown == ["make = 1, cell_type 0, mean of 2", "make = 2, cell_type 0"]
    drawn = split[1].lines
    np.testing.assert_array_equal(drawn[2].get_ydata(), mean.get_ydata())
    assert [line.get_linestyle() for line in drawn] == ["-", "-", "-", "--"]
    assert len({line.get_color() for line in drawn}) == 1
    # unless they are told apart
    named = {k: f"colony {k}" for k in range(3)}
    split = tf.pictures.time_course(path, by="cell_type", conditions=named).figure.axes[0].legend_
    assert [t.get_text() for t in split.texts] == [f"colony {k}, cell_type 0" for k in range(3)]


def dies(cells):
    """Cells of type 1 die at 0.3 h, those of type 2 have no gfp that is a number then."""
    late = cells.time > 0.25
    cells.remove_flag = late & (cells.cell_type == 1)
    cells.gfp = np.where(late & (cells.cell_type == 2), np.nan, cells.gfp)


@pytest.fixture(scope="module")
def replicated(tmp_path_factory):
    """Twelve colonies: of two doses and two rates in turn; one dies out, and one fails."""
    path = tmp_path_factory.mktemp("replicated") / "run.h5"
    kinds = [1, 0, 2] + [0] * 9
    founders = tf.Cells([[0.0, 0.0]] * 12, [1.0, 0.0], [2.0 + 0.1 * k for k in range(12)],
                        cell_type=kinds, colony=list(range(12)))  # fmt: skip
    circuit = tf.Circuit(
        lambda u, s, p, cell: {"gfp": p.iptg - u.gfp}, species="gfp", iptg=[0.1, 2.0] * 6
    )
    scene = tf.Scene(
        tf.Growth(rate=(1.0 + 0.05 * np.arange(12)).round(2)), tf.Division(length=4.0), circuit,
        tf.Rules(dies), founders=founders, dt=0.05,
    )  # fmt: skip
    record = tf.Recorder(path, scene, every=1)
    tf.simulate(scene, until=1.0, record=record, on_failure="drop").last()
    return path


def test_means_of_numbers_count_those_that_died_and_not_those_that_failed(replicated):
    figure = tf.pictures.time_course(replicated, "biovolume", "gfp", conditions="iptg").figure
    with tf.Results(replicated) as results:
        counts, times = results.counts, results.times
        volume = results.table(-1)
    first = [k for k in range(12) if k % 2 == 0]
    assert counts[-1, 0] == counts[-1, 2] == 0 < counts[-1, 4:].min()
    ax, biovolume, gfp = figure.axes
    assert [t.get_text() for t in ax.get_legend().texts] == [
        "iptg = 0.1, mean of 6", "iptg = 2, mean of 6",
    ]  # fmt: skip
    mean = ax.lines[6].get_ydata()
    live = counts[:, first].astype(float)
    live[:, 1][counts[:, 2] == 0] = np.nan  # the failed one
    np.testing.assert_allclose(mean, np.nanmean(live, 1))
    own = [volume["volume"][volume["colony"] == k].sum() for k in first if k != 2]
    assert biovolume.lines[6].get_ydata()[-1] == pytest.approx(sum(own) / 5, rel=1e-5)
    assert biovolume.get_ylabel() == "biovolume (µm³)"
    some = [volume["gfp"][volume["colony"] == k].mean() for k in (4, 6, 8, 10)]
    assert gfp.lines[6].get_ydata()[-1] == pytest.approx(np.mean(some), rel=1e-5)
    # a cross where one failed, a triangle where one died
    marks = {tuple(c.get_offsets()[0].round(3)): len(c.get_paths()[0].vertices)
             for c in ax.collections if len(c.get_offsets()) == 1
             and not hasattr(c, "get_segments")}  # fmt: skip
    died, failed = (
        round(float(times[(counts[:, k] == 0).argmax() - e]), 3) for k, e in ((0, 0), (2, 1))
    )
    assert set(marks) == {(died, 0.0), (failed, 1.0)}


def test_colonies_without_a_type_count_as_0(replicated):
    """Of six colonies, one begins with a cell of type 1; none but one has any."""
    options = {"by": "cell_type", "conditions": "iptg"}
    ax = tf.pictures.time_course(replicated, **options).figure.axes[0]
    mean = {x.get_label(): x.get_ydata() for x in ax.lines if "mean" in x.get_label()}
    assert mean["iptg = 0.1, cell_type 1, mean of 6"][0] == pytest.approx(1 / 6)
    assert mean["iptg = 0.1, cell_type 0, mean of 6"][0] == pytest.approx(4 / 6)
    assert mean["iptg = 2, cell_type 1, mean of 6"].max() == 0.0
    one = tf.pictures.time_course(replicated, **options, most=1).figure
    assert "first 1 of 2 conditions" in one.get_suptitle()


def test_many_replicates_are_a_band(replicated):
    every = {k: "all" for k in range(12)}
    ax, length = tf.pictures.time_course(replicated, "length", conditions=every).figure.axes
    assert len(ax.lines) == len(ax.collections) == len(length.lines) == 1
    with tf.Results(replicated) as results:
        counts = np.delete(results.counts, 2, 1)  # the failed one
    np.testing.assert_allclose(ax.lines[0].get_ydata()[-1], counts[-1].mean())
    band = ax.collections[0].get_paths()[0].vertices
    end = band[np.isclose(band[:, 0], 1.0)][:, 1]
    assert (end.min(), end.max()) == pytest.approx(tuple(np.percentile(counts[-1], [10, 90])))


def test_conditions_are_of_parameters_or_named(replicated):
    def shown(**options) -> list[str]:
        (ax,) = tf.pictures.time_course(replicated, **options).figure.axes
        return [text.get_text() for text in ax.legend_.texts]

    assert shown(conditions=("iptg", "rate"), colonies=[1, 4]) == [
        "iptg = 2, rate = 1.05", "iptg = 0.1, rate = 1.2",
    ]  # fmt: skip
    assert shown(conditions={7: "wet", 3: "dry", 5: "dry"}) == ["dry, mean of 2", "wet"]
    two = tf.pictures.time_course(replicated, conditions="Growth.rate", most=2).figure
    assert "first 2 of 12 colonies" in two.get_suptitle()
    one = tf.pictures.time_course(replicated, conditions="iptg", most=1).figure
    assert "first 1 of 2 conditions" in one.get_suptitle() and len(one.axes[0].lines) == 7


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"conditions": "itpg"}, r"conditions = 'itpg'.*one of iptg, .*Did you mean 'iptg'"),
        ({"conditions": 3}, r"conditions = 3.*a parameter that has one value per colony"),
        ({"conditions": {40: "wet"}}, r"conditions = 40.*ids of colonies: 0, 1"),
        ({"conditions": {0: 1}}, r"conditions\[0\] = 1.*a name, as text"),
        ({"conditions": {}}, "a name for at least one colony"),
        ({"conditions": {3: "wet"}, "colonies": [4]}, "names of colonies that are drawn"),
        ({"by": "iptg"}, r"by = 'iptg'.*For a parameter that differs .*conditions="),
        ({"by": "rate"}, r"by = 'rate'"),
        ({"by": "cell_type", "conditions": "rate", "colonies": range(6)}, "up to 4 conditions"),
    ],
)  # fmt: skip
def test_bad_conditions(replicated, options, words):
    with pytest.raises(tf.InputError, match=words):
        tf.pictures.time_course(replicated, **options)


def test_types_have_the_colours_of_pictures(tmp_path):
    """Of types 0 and 2, the second is not drawn as type 1 would be."""
    founders = tf.Cells([[0.0, 0.0], [20.0, 0.0]], [[1.0, 0.0]] * 2, cell_type=[0, 2])
    scene = tf.Scene(tf.Growth(rate=1.0), dim=2, founders=founders)
    path = tmp_path / "types.h5"
    tf.simulate(scene, until=0.2, record=path).last()
    drawn = tf.pictures.time_course(path, by="cell_type").figure.axes[0].lines
    colours = [matplotlib.colors.to_hex(line.get_color()).upper() for line in drawn]
    assert colours == [KINDS[0], KINDS[2]]


def test_several_runs_in_one_picture(tmp_path):
    def run(name, rate, until, colonies=3):
        scene = tf.Scene(
            tf.Growth(rate=1.0), tf.Division(length=tf.LogNormal(3.0, 0.1)), tf.Lysis(rate=rate),
            founders=tf.Cells([[0.0, 0.0], [6.0, 0.0]], [1.0, 0.0], cell_type=[0, 1]),
            dt=0.1, name=name,
        )  # fmt: skip
        path = tmp_path / f"{name}.h5"
        record = tf.Recorder(path, scene, every=2)
        tf.simulate(scene, until=until, colonies=colonies, seed=1, record=record).last()
        return path

    dead, long = run("dead", 50.0, 1.0), run("long", 0.0, 2.0)
    doses = run("doses", torch.tensor([0.0, 9.0, 9.0]), 1.0)
    picture = tf.pictures.time_course({"with": dead, "without": long}, "length")
    ax, length = picture.figure.axes
    assert [t.get_text() for t in ax.get_legend().texts] == [
        "with, mean of 3", "without, mean of 3",
    ]  # fmt: skip
    with tf.Results(long) as results:
        mean, times = results.counts.mean(1), results.times
        both = tf.pictures.time_course({"a": results, "b": results}, most=1).figure.axes[0]
        assert results.times[-1] == 2.0  # it stays open
    assert len({line.get_color() for line in both.lines}) == 2
    lines = ax.lines
    assert len(lines) == 2 * (3 + 1) and lines[7].get_xdata().tolist() == times.tolist()
    np.testing.assert_allclose(lines[7].get_ydata(), mean)
    assert lines[3].get_xdata()[-1] == 1.0 and lines[3].get_ydata()[-1] == 0.0
    assert length.get_xlim() == pytest.approx((-0.1, 2.1))
    assert length.get_ylabel() == "mean of length (µm)"
    assert picture.figure.get_suptitle() == "dead, long"
    named = tf.pictures.time_course({"lysis": doses, "none": long}).figure.axes[0].get_legend()
    assert [t.get_text() for t in named.texts] == [
        "lysis, rate = 0", "lysis, rate = 9, mean of 2", "none, mean of 3",
    ]  # fmt: skip
    split = tf.pictures.time_course({"lysis": dead, "none": long}, by="cell_type").figure.axes[0]
    assert {line.get_linestyle() for line in split.lines} == {"-", "--"}
    for wrong in ([dead], {}, {"": dead}, {1: dead}):
        with pytest.raises(tf.InputError, match="files by the names of runs"):
            tf.pictures.time_course(wrong)
    with pytest.raises(tf.InputError, match="another file than the results"):
        tf.pictures.time_course({"a": dead, "b": long}, out=long)
    with pytest.raises(tf.InputError, match=r"run 'none': conditions = 'rate'.*this file has none"):
        tf.pictures.time_course({"lysis": doses, "none": long}, conditions="rate")


def test_designs_of_a_run_are_no_replicates(tmp_path):
    def run(name, *values):
        scene = tf.Scene(
            tf.Growth(rate=values[0]), tf.Division(length=values[1]), tf.Lysis(rate=values[2]),
            dt=0.1, name=name,
        )  # fmt: skip
        record = tf.Recorder(tmp_path / name, scene, every=1)
        tf.simulate(scene, until=0.5, colonies=2, record=record).last()
        return tmp_path / name

    pair = lambda one, other: torch.tensor([one, other])
    many = run("many.h5", pair(1.0, 1.2), pair(3.0, 4.0), pair(0.0, 0.1))
    runs = {"designs": many, "control": run("control.h5", 1.0, 3.0, 0.0)}
    legend = tf.pictures.time_course(runs).figure.axes[0].get_legend()
    assert [t.get_text() for t in legend.texts] == [
        "designs, colony 0", "designs, colony 1", "control, mean of 2",
    ]  # fmt: skip
