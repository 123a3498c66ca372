"""Films of a run: MP4 with imageio-ffmpeg, or animated GIF with pillow.

Pillow is installed with matplotlib.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchfilm.io.results import Results
from torchfilm.pictures.colours import CELLS, Limits, PlotStyle, paint_cells
from torchfilm.pictures.draw import OBSTACLE, OUTSIDE_BOX, WALL
from torchfilm.pictures.figures import (
    check_not_results,
    choose_colonies,
    fill_sheet,
    opened,
    square,
    view_note,
)
from torchfilm.pictures.frames import RecordedFrames
from torchfilm.pictures.page import (
    PanelLayout,
    figure_class,
    make_page,
    plan_layout,
    set_page_title,
)
from torchfilm.tools import checks
from torchfilm.tools.whole_files import written_whole

FASTEST_GIF = 50.0  # frames per second; viewers slow down faster films
GREYS = 104  # of the 256 colours of a GIF


@checks.known_keywords
def movie(
    what: str | Path | Results,
    out: str | Path,
    *,
    every: int = 1,
    fps: float = 10.0,
    colour: str | None = None,
    channels: Mapping[str, str] | None = None,
    background: str | None = None,
    limits: Limits | None = None,
    log: bool | str | Sequence[str] = False,
    view: str = "xy",
    section: float | str = CELLS,
    whole: bool = False,
    colonies: Sequence[int] | None = None,
    dpi: float = 150,
) -> Path:
    """Make a film of a results file, with one panel per colony. Returns the film's path; an older
    film of that name is replaced.

    The window, the scale and the range of colours are the same from beginning to end. out: its
    name, which ends in .mp4 (requires imageio-ffmpeg) or .gif. every: draw every n-th recorded
    frame, and the last. fps: drawn frames per second; a GIF has a resolution of hundredths of a
    second. what: a results file, or its path. colonies: their ids; default the first 9. The other
    options are those of `show`.
    """
    figure_class()
    target = Path(out)
    write = _writer(target, fps)
    checks.integer("every", every, least=1)
    style = PlotStyle(colour, channels, background, limits, view, section, whole, log)
    with opened(what) as results:
        check_not_results(results.path, out)
        last = len(results) - 1
        drawn = sorted({*range(0, last + 1, every), last})
        frames = RecordedFrames(results, drawn, background, style.quantities)
        places, more = choose_colonies(
            frames.shown(style.shows_box), results.colony_id, colonies, 9
        )
        layout = plan_layout(frames, places, style)
        with written_whole(target) as beside:
            write(beside, MovieFrames(frames, layout, f"{view_note(style)}{more}", dpi), fps)
    return target


class MovieFrames(Sequence[np.ndarray]):
    """The frames of a film, each drawn on access: (height, width, 3) uint8."""

    def __init__(self, frames: RecordedFrames, layout: PanelLayout, more: str, dpi: float):
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        self.frames, self.layout = frames, layout
        clocks = clock(frames.times)
        self.titles = [f"{frames.title}, t = {c} h{more}" for c in clocks]
        self.figure, self.axes = make_page(*square(layout), layout, self.titles[-1], dpi=dpi)
        self.canvas = FigureCanvasAgg(self.figure)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, k):
        fill_sheet(self.axes, self.frames[k], self.layout)
        set_page_title(self.figure, self.titles[k])
        self.canvas.draw()
        return np.ascontiguousarray(np.asarray(self.canvas.buffer_rgba())[..., :3])


def clock(times: np.ndarray) -> list[str]:
    """Times with the decimals that they need, the same for all, at most three."""
    for decimals in range(4):
        words = [f"{t:.{decimals}f}" for t in times]
        if all(abs(float(w) - t) < 1e-6 for w, t in zip(words, times, strict=True)):
            break
    return words


def _writer(target: Path, fps: float) -> Callable[[Path, MovieFrames, float], None]:
    """The writer for this kind of film; raises InputError before anything is drawn."""
    kind = target.suffix.lower()
    if kind not in (".mp4", ".gif"):
        raise checks.input_error("out", str(target), "a name that ends in .mp4 or .gif")
    if not target.parent.is_dir():
        raise checks.input_error("out", str(target), "in a folder that exists")
    if kind == ".gif":
        checks.number(
            "fps",
            fps,
            above=0.0,
            most=FASTEST_GIF,
            hint="For more, write an .mp4, or draw fewer frames with every=.",
        )
        return _gif
    checks.number("fps", fps, above=0.0)
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise checks.InputError(
            f"MP4 requires imageio-ffmpeg: {checks.install('movie')}; or give a name that ends in"
            " .gif."
        ) from error
    return _mp4


def _mp4(path: Path, film: MovieFrames, fps: float) -> None:
    import imageio_ffmpeg

    size = film.canvas.get_width_height()
    stream = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=fps,
        codec="libx264",
        quality=8,
        macro_block_size=2,
        ffmpeg_log_level="error",
    )
    stream.send(None)
    try:
        for k in range(len(film)):
            stream.send(film[k])
    finally:
        stream.close()
    written = imageio_ffmpeg.count_frames_and_secs(str(path))[0]
    if written != len(film):
        raise OSError(f"ffmpeg wrote {written} of {len(film)} frames")


def _gif(path: Path, film: MovieFrames, fps: float) -> None:
    """All frames share one palette, so that a colour looks the same throughout."""
    from PIL import Image

    palette = _palette(film)

    def image(k: int) -> Any:
        picture = Image.fromarray(_nearest(film[k], palette))
        picture.putpalette(palette.tobytes())
        return picture

    frames = (image(k) for k in range(len(film)))
    next(frames).save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames,
        duration=round(100 / fps) * 10,
        loop=0,
    )


def _palette(film: MovieFrames) -> np.ndarray:
    """The 256 colours (256, 3) uint8 of a GIF.

    It has greys for the signal, lines and letters, and colours of the legends and of some frames'
    cells. A palette from whole pictures would mostly have the colours that cover most of the paper.
    """
    from matplotlib.colors import to_rgb

    layout = film.layout
    colours = [scale.cmap(np.linspace(0, 1, 256))[:, :3] for scale in layout.scales]
    for k in np.unique(np.linspace(0, len(film) - 1, 5).astype(int)):
        frame = film.frames[int(k)]
        colours += [
            paint_cells(frame.colony(place), layout.scales, layout.style)[:, :3]
            for place in layout.places
        ]
    wanted = np.unique(np.round(255 * np.concatenate(colours)).astype(np.uint8), axis=0)
    own = np.round(255 * np.array([to_rgb(c) for c in (OUTSIDE_BOX, OBSTACLE, WALL)]))
    wanted = _spread(wanted, 256 - GREYS - len(own))
    greys = np.round(np.linspace(0, 255, GREYS)).astype(np.uint8)
    colours_used = np.concatenate([np.repeat(greys[:, None], 3, 1), own.astype(np.uint8), wanted])
    return np.concatenate([colours_used, np.zeros((256 - len(colours_used), 3), dtype=np.uint8)])


def _spread(colours: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of some colours (n, 3), such that none is far from one of them.

    Each next colour is the one farthest from those before.
    """
    if len(colours) <= most:
        return colours
    points, choose_colonies = colours.astype(np.float32), [0]
    far = ((points - points[0]) ** 2).sum(1)
    while len(choose_colonies) < most:
        choose_colonies.append(int(far.argmax()))
        far = np.minimum(far, ((points - points[choose_colonies[-1]]) ** 2).sum(1))
    return colours[choose_colonies]


def _nearest(picture: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """The palette index of the colour nearest to each pixel, (height, width) uint8.

    Pillow's own search is less accurate.
    """
    shift = np.array([1 << 16, 1 << 8, 1])
    found, where = np.unique(picture @ shift, return_inverse=True)
    colours, there = (
        np.stack([found >> 16, found >> 8 & 255, found & 255], 1).astype(np.float32),
        palette.astype(np.float32),
    )
    distance = (there * there).sum(1) - 2.0 * colours @ there.T
    return distance.argmin(1).astype(np.uint8)[where].reshape(picture.shape[:2])
