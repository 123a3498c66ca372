"""Pictures over time: strips and films of a run, and show with a signal behind the cells."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from PIL import Image

import torchfilm as tf
from torchfilm.pictures import figures, movies
from torchfilm.pictures.colours import PlotStyle, paint_cells
from torchfilm.pictures.figures import choose_frames
from torchfilm.pictures.frames import RecordedFrames
from torchfilm.pictures.movies import MovieFrames, _nearest, clock
from torchfilm.pictures.page import plan_layout

UNTIL = 2.0


def brighter(cells):
    """yfp is the time; cfp is the number of the cell."""
    cells.yfp = 0 * cells.yfp + cells.time
    cells.cfp = cells.uid.to(cells.yfp)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Two colonies of a few cells that become brighter with time, in a medium whose signal decays.

    Six frames, read-only.
    """
    path = tmp_path_factory.mktemp("times") / "run.h5"
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=1.0, decay=1.0, initial=1.0),
        box=((-16, -8, -4), (16, 8, 4)),
        spacing=4.0,
    )
    rules = tf.Rules(brighter, variables={"yfp": 0.0, "cfp": 0.0})
    scene = tf.Scene(
        rules,
        tf.Growth(rate=1.2),
        tf.Division(length=tf.Uniform(3.0, 4.0)),
        tf.Mechanics(dim=2),
        medium,
        dt=0.1,
    )
    for _ in tf.simulate(
        scene, scene.bind(2, seed=3).start(), until=UNTIL, record=tf.Recorder(path, scene, every=4)
    ):
        pass
    return path


def pixels(path) -> np.ndarray:
    return matplotlib.image.imread(path)[..., :3]


# --- one range, one window ------------------------------------------------------------------------


def test_ranges_and_windows_are_those_of_all_frames(run):
    """The first frame has the lowest yfp and the highest ahl; all frames share both ranges."""
    with tf.Results(run) as results:
        style = PlotStyle(colour="yfp", background="ahl")
        frames = RecordedFrames(results, range(len(results)), "ahl")
        made = plan_layout(frames, [0, 1], style)
        every = [results.frame(k)["yfp"] for k in range(len(results))]
        signal = [x for k in range(len(results)) for x in results.signal("ahl", k)]
        assert made.scales[0].limits == pytest.approx(
            (min(v.min() for v in every), max(v.max() for v in every))
        )
        # cut at z = 0, between two equal layers
        assert made.behind.limits == pytest.approx(
            (min(v.min() for v in signal), max(v.max() for v in signal)), rel=1e-5
        )
        last = results.frame(-1)
        for place, (left, right, bottom, top) in made.windows.items():
            x, y = last["position"][last["colony"] == place].T
            assert left < x.min() and x.max() < right and bottom < y.min() and y.max() < top


def test_a_frame_is_read_when_it_is_asked_for(run):
    with tf.Results(run) as results:
        frames = RecordedFrames(results, [0, -1], None)
        assert (
            len(frames) == 2
            and frames[0].signals == {}
            and len(frames[1].cells["uid"]) == results.counts[-1].sum()
        )
        assert len(RecordedFrames(results, [0, 1, 2], "ahl")[1:]) == 2
        assert frames.shown(box=False).tolist() == [True, True]
        with pytest.raises(tf.InputError, match=r"background = 'lactose'.*ahl"):
            RecordedFrames(results, [0], "lactose")


# --- strips ---------------------------------------------------------------------------------------


def test_frames_of_a_strip():
    times = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.1])
    assert choose_frames(times, None, None) == [0, 1, 3, 5]  # 0, 0.7, 1.4, 2.1
    assert (
        choose_frames(times, None, 1) == [5]
        and choose_frames(times, None, 2) == [0, 5]
        and choose_frames(times, None, 99) == [0, 1, 2, 3, 4, 5]
    )
    assert choose_frames(times, [1.1, 0.2], None) == [2, 0] and choose_frames(
        times, [2.3], None
    ) == [5]
    for bad in ([2.5], [-0.3], [0.0, 99.0]):
        with pytest.raises(tf.InputError, match=r"times = .*0 to 2.1 h"):
            choose_frames(times, bad, None)
    for wrong in (0, True, 2.5):
        with pytest.raises(tf.InputError, match="count"):
            choose_frames(times, None, wrong)
    with pytest.raises(tf.InputError, match="one of them"):
        choose_frames(times, [1.0], 3)
    with pytest.raises(tf.InputError, match="at least one"):
        choose_frames(times, [], None)


def test_a_strip_writes_its_times(run, tmp_path):
    """The recorded times, not the given ones."""
    made = tf.pictures.strip(
        run,
        times=[0.1, 1.1, 2.0],
        channels={"yfp": "yellow"},
        background="ahl",
        colonies=[1],
        out=tmp_path / "a.svg",
    ).path
    text = made.read_text()  # matplotlib writes each text as a comment next to its shapes
    for time in ("0 h", "1.2 h", "2 h", "colony 1", "yfp", "ahl outside", "z = 0 µm", "µm"):
        assert time in text, time
    assert "0.1 h" not in text and "1.1 h" not in text


@pytest.fixture
def laid_out(monkeypatch) -> dict:
    """The (rows, columns) of a strip's page, and (time, place, layout, axes) of each panel."""
    seen: dict = {"panels": []}
    make_page, fill = figures.make_page, figures.fill

    def noted_page(rows, columns, made, title, *, dpi):
        seen["shape"], seen["title"] = (rows, columns), title
        seen["figure"], seen["axes"] = make_page(rows, columns, made, title, dpi=dpi)
        return seen["figure"], seen["axes"]

    def noted_fill(ax, frame, place, made, titles):
        seen["panels"].append((seen["axes"].index(ax), frame.time, place, made))
        fill(ax, frame, place, made, titles)

    monkeypatch.setattr(figures, "make_page", noted_page)
    monkeypatch.setattr(figures, "fill", noted_fill)
    return seen


def test_a_colony_is_a_row_and_time_runs_along_it(run, tmp_path, laid_out):
    tf.pictures.strip(
        run,
        times=[0.0, 0.8, 2.0],
        colour="yfp",
        background="ahl",
        whole=True,
        out=tmp_path / "a.png",
    )
    # the box is 32 × 16 µm: twice as wide as high, not more
    assert laid_out["shape"] == (2, 3)
    assert [(k, t, p) for k, t, p, _ in laid_out["panels"]] == [
        (0, 0.0, 0),
        (3, 0.0, 1),
        (1, pytest.approx(0.8), 0),
        (4, pytest.approx(0.8), 1),
        (2, pytest.approx(2.0), 0),
        (5, pytest.approx(2.0), 1),
    ]
    assert len({id(made) for *_, made in laid_out["panels"]}) == 1, (
        "all panels are drawn with one set of scales and windows"
    )


def test_wide_panels_stand_one_below_the_other(run, tmp_path, laid_out):
    """Cells in a row without the box are more than twice as wide as high, so a colony is a
    column.
    """
    tf.pictures.strip(run, times=[0.0, 0.4], out=tmp_path / "a.png")
    width, height = laid_out["panels"][0][3].size
    assert width > 2 * height and laid_out["shape"] == (2, 2)
    assert [(k, round(t, 6), p) for k, t, p, _ in laid_out["panels"]] == [
        (0, 0.0, 0),
        (1, 0.0, 1),
        (2, 0.4, 0),
        (3, 0.4, 1),
    ]


def test_one_colony_is_one_row_and_the_title_names_it(run, tmp_path, laid_out):
    tf.pictures.strip(
        run, count=4, colonies=[1], background="ahl", whole=True, out=tmp_path / "a.png"
    )
    assert laid_out["shape"] == (1, 4) and laid_out["title"].endswith("colony 1")


def test_a_colony_that_has_no_cells_yet_or_any_more_is_drawn_empty(tmp_path):
    """After its cells are removed, a colony's panel stays, with the signal."""
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=1.0, initial=1.0), box=((-16, -8, -4), (16, 8, 4)), spacing=4.0
    )

    def end(cells):
        cells.remove_flag = (cells.colony == 1) & (cells.time > 0.45)

    scene = tf.Scene(tf.Rules(end), tf.Growth(rate=1.0), tf.Mechanics(dim=2), medium, dt=0.1)
    path = tmp_path / "run.h5"
    for _ in tf.simulate(
        scene, scene.bind(2).start(), until=1.0, record=tf.Recorder(path, scene, every=5)
    ):
        pass
    with tf.Results(path) as results:
        assert results.counts[-1].tolist() == [1, 0]
    assert tf.pictures.strip(path, count=3, background="ahl", out=tmp_path / "a.png").path.exists()
    assert tf.pictures.movie(path, tmp_path / "a.gif", background="ahl", dpi=40).exists()
    with pytest.raises(tf.InputError, match=r"colonies = \[1\]"):
        tf.show(path, colonies=[1], out=tmp_path / "b.png")


# --- show -----------------------------------------------------------------------------------------


def test_show_draws_the_signal(run, tmp_path):
    """The uniform signal is in the middle of its range, that of the frame, with white lowest.

    So the paper around the cells has one colour.
    """
    low, high = (
        pixels(
            tf.show(
                run, background="ahl", limits={"ahl": (0, most)}, out=tmp_path / f"{most}.png"
            ).path
        )
        for most in (10, 1e-3)
    )
    dark = [(image.max(2) < 0.05).mean() for image in (low, high)]
    assert dark[0] < 0.1 and dark[1] > 0.3


@pytest.mark.parametrize(
    "draw", [tf.show, tf.pictures.strip, lambda path, out: tf.pictures.movie(path, out)]
)
def test_no_picture_replaces_the_results(run, tmp_path, draw):
    """Not even if the results have the name of a picture."""
    own = tmp_path / "run.gif"
    own.write_bytes(run.read_bytes())
    with pytest.raises(tf.InputError, match="another file than the results"):
        draw(own, out=own)
    assert own.read_bytes() == run.read_bytes()


@pytest.mark.parametrize(
    "colonies, message", [([7], r"colonies = \[7\].*0, 1"), ([], r"colonies = \[\]")]
)
def test_colonies_that_are_not_there_are_reported(run, tmp_path, colonies, message):
    with pytest.raises(tf.InputError, match=message):
        tf.show(run, colonies=colonies, out=tmp_path / "a.png")


# --- films ----------------------------------------------------------------------------------------


@pytest.fixture
def film_options() -> dict:
    return {"channels": {"yfp": "yellow", "cfp": "cyan"}, "background": "ahl", "dpi": 50}


def test_a_gif_has_every_frame(run, tmp_path, film_options):
    made = tf.pictures.movie(run, tmp_path / "a.gif", fps=5, **film_options)
    with Image.open(made) as film, tf.Results(run) as results:
        assert film.n_frames == len(results) == 6
        assert film.info["loop"] == 0
        for k in range(film.n_frames):
            film.seek(k)
            assert film.info["duration"] == 200, "ms, at 5 frames a second"
    assert [p.name for p in tmp_path.iterdir()] == ["a.gif"], "nothing is left behind"


def test_every_other_frame_and_the_last(run, tmp_path, film_options):
    with Image.open(tf.pictures.movie(run, tmp_path / "a.gif", every=4, **film_options)) as film:
        assert film.n_frames == 3  # 0, 4 and the last, 5


def test_a_gif_shows_what_was_drawn(run, tmp_path, film_options):
    """Greys are 255/103 apart, so the error of a grey pixel is 1.3 at most, rounded to 2.

    The 149 other colours serve two maps, each a line of length 310 in colour space, and a few cells
    between them. They are about 4 apart, so no cell's error exceeds 8. Blended pixels at edges are
    in no legend.
    """
    made = tf.pictures.movie(run, tmp_path / "a.gif", **film_options)
    with tf.Results(run) as results, Image.open(made) as film:
        frames = RecordedFrames(results, range(len(results)), "ahl")
        shared = plan_layout(
            frames, [0, 1], PlotStyle(channels=film_options["channels"], background="ahl")
        )
        drawn = MovieFrames(frames, shared, "", 50)
        for k in (0, 3, 5):
            film.seek(k)
            wanted, found = drawn[k].astype(int), np.asarray(film.convert("RGB")).astype(int)
            difference = np.abs(found - wanted).max(2)
            grey = np.ptp(wanted, 2) == 0
            assert grey.any() and difference[grey].max() <= 2
            cells = np.unique(
                np.round(
                    255 * paint_cells(frames[k].cells, shared.scales, shared.style)[:, :3]
                ).astype(int),
                axis=0,
            )
            flat = (wanted[:, :, None] == cells).all(3).any(2)
            assert flat.any() and difference[flat].max() <= 8


def test_the_nearest_colour_is_the_nearest():
    rng = np.random.default_rng(0)
    palette, picture = (
        rng.integers(0, 256, size).astype(np.uint8) for size in ((256, 3), (20, 30, 3))
    )
    found = palette[_nearest(picture, palette)].astype(int)
    every = ((picture[:, :, None].astype(int) - palette.astype(int)) ** 2).sum(3)
    assert np.array_equal(((picture.astype(int) - found) ** 2).sum(2), every.min(2))


def test_a_film_moves_neither_its_window_nor_its_legend(run, film_options):
    """Outside the panels and the titles every frame is the same."""
    with tf.Results(run) as results:
        frames = RecordedFrames(results, range(len(results)), None)
        film = MovieFrames(frames, plan_layout(frames, [0], PlotStyle(colour="yfp")), "", 60)
        first, last = film[0], film[5]
    assert first.shape == last.shape
    panel = film.axes[0].get_window_extent()
    below = int(len(first) - panel.y0) + 2
    assert np.array_equal(first[below:], last[below:]) and not np.array_equal(
        first[:below], last[:below]
    )


@pytest.mark.parametrize(
    "out, options, message",
    [
        ("a.avi", {}, r"out = .*\.mp4 or \.gif"),
        ("nowhere/a.gif", {}, r"out = .*folder that exists"),
        ("a.gif", {"fps": 0}, "fps = 0"),
        ("a.gif", {"fps": 60}, r"fps = 60.*at most 50.*\.mp4"),
        ("a.gif", {"every": 0}, "every = 0"),
        ("a.gif", {"colour": "nope"}, "colour = 'nope'"),
    ],
)
def test_a_film_that_cannot_be_made_is_reported(run, tmp_path, out, options, message):
    with pytest.raises(tf.InputError, match=message):
        tf.pictures.movie(run, tmp_path / out, **options)
    assert list(tmp_path.iterdir()) == []


def test_mp4_names_what_it_needs(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(tf.InputError, match=r'imageio-ffmpeg.*pip install -e "\.\[movie\]".*\.gif'):
        tf.pictures.movie(run, tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_breaks_off_leaves_the_old_one(run, tmp_path, monkeypatch, film_options):
    """A full disk in the middle of a film raises an error, leaves no partial file, and keeps an
    older film of that name.
    """
    old = tmp_path / "a.gif"
    old.write_bytes(b"an old film")

    def full(path, film, fps):
        path.write_bytes(b"half of a film")
        raise OSError("No space left on device")

    monkeypatch.setattr(movies, "_gif", full)
    with pytest.raises(tf.SimulationError, match=r"a\.gif.*No space left"):
        tf.pictures.movie(run, old, **film_options)
    assert [p.name for p in tmp_path.iterdir()] == ["a.gif"] and old.read_bytes() == b"an old film"


# the reader of imageio-ffmpeg closes its pipes only at garbage collection
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)
def test_an_mp4_has_every_frame(run, tmp_path, film_options):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    made = tf.pictures.movie(run, tmp_path / "a.mp4", fps=5, **film_options)
    assert ffmpeg.count_frames_and_secs(str(made))[0] == 6
    stream = ffmpeg.read_frames(str(made))
    facts = next(stream)
    frames = [np.frombuffer(raw, np.uint8).reshape(*facts["size"][::-1], 3) for raw in stream]
    assert facts["fps"] == 5
    with tf.Results(run) as results:
        shown = RecordedFrames(results, range(len(results)), "ahl")
        drawn = MovieFrames(
            shown,
            plan_layout(
                shown, [0, 1], PlotStyle(channels=film_options["channels"], background="ahl")
            ),
            "",
            50,
        )
        for k in (0, 5):
            # the codec halves the resolution of colour and rounds, so edges differ and areas do not
            assert np.median(np.abs(frames[k].astype(int) - drawn[k].astype(int))) <= 3
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize(
    "times, words",
    [
        ([0, 1, 2], ["0", "1", "2"]),
        ([0.25, 1.0], ["0.25", "1.00"]),
        ([1 / 3, 1], ["0.333", "1.000"]),
        ([0.1 + 0.2], ["0.3"]),
    ],
)
def test_times_of_a_film_are_equally_long(times, words):
    assert clock(np.array(times, dtype=float)) == words


def test_a_gif_keeps_the_colours_of_walls_and_obstacles(tmp_path):
    """Beside a signal in greys they were the next grey."""
    scene = tf.Scene(
        tf.Growth(rate=1.0),
        tf.Mechanics([tf.Box(low=(6.0, 1.0), high=(18.0, 9.0))], dim=2),
        tf.Medium(
            a=tf.Signal(50.0, initial=lambda p: p[:, 0]),
            box=((0.0, 0.0), (32.0, 20.0)), spacing=1.0,
            obstacles=lambda p: (p[:, 0] > 14) & (p[:, 0] < 17) & (p[:, 1] > 2) & (p[:, 1] < 4),
        ),
        founders=tf.Cells([[8.0, 2.0], [10.0, 8.0], [16.0, 6.0]], [[1.0, 0.0]] * 3),
    )  # fmt: skip
    path = tmp_path / "run.h5"
    tf.simulate(scene, until=0.1, record=path).last()
    tf.pictures.movie(path, tmp_path / "run.gif", background="a")
    with Image.open(tmp_path / "run.gif") as film:
        pixels = np.asarray(film.convert("RGB")).reshape(-1, 3)
    for colour in ((160, 82, 45), (210, 180, 140)):
        assert (pixels == colour).all(1).sum() > 100
