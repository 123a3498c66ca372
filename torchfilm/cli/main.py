"""The command line: `torchfilm run SCENE`, `resume FILE`, `show FILE`, `info SCENE-or-FILE`,
`explain SCENE`, `tune SCENE`."""

from __future__ import annotations

import dataclasses
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch

from torchfilm import measure, pictures, scenes
from torchfilm.cli.scene_files import design, load_scene, parse_setting
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.rules import Rules
from torchfilm.io.recorder import Recorder
from torchfilm.io.results import Results
from torchfilm.pictures import cli_options
from torchfilm.scene import Scene
from torchfilm.simulation import simulate
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError, SimulationError
from torchfilm.tools.memory import keep_memory
from torchfilm.tools.timing import Timings
from torchfilm.tuning.settings import Settings, accurate

try:
    import tyro
    from tqdm import tqdm

    from torchfilm.cli.inspect import Explain, Info, Tune
except ImportError as missing:  # pragma: no cover - depends on what is installed
    raise SystemExit(
        f'The command line needs {missing.name}: pip install "torchfilm[app]".'
    ) from missing


@dataclass
class Run:
    """Run a scene: a ready-made one by name, your own Python file that defines `scene` (a Scene, or
    a function that returns one), or a saved design."""

    scene: Annotated[str, tyro.conf.Positional]
    """microcolony, programmed_growth, channel, …, or the path of a Python file or of a design saved
    as .json, with whose step, seed and end it runs."""
    set: list[str] = field(default_factory=list)
    """Parameters of the scene, as NAME=VALUE, such as --set dim=3 rate=0.8."""
    colonies: int = 1
    """Independent colonies in the batch."""
    cells: int | None = None
    """Stop once every colony has this many cells (500, or the design's number, if no end is
    given)."""
    until: float | None = None
    """Stop at this time, h."""
    dt: float | None = None
    """Step, h; by default the scene's."""
    preset: str | None = None
    """How accurately: draft to look at it, standard (the defaults), reference to measure others
    against."""
    settings: Path | None = None
    """How accurately: a file of settings, as `torchfilm tune SCENE --out` writes it."""
    seed: int | None = None
    """Seed of all random numbers (0, or the design's)."""
    start: Path | None = None
    """CSV or HDF5 file of cells to start from."""
    device: str = "cpu"
    """cpu or cuda."""
    double: bool = False
    """Compute in float64, as a design does that was searched so."""
    out: Path | None = None
    """Results file; by default SCENE.h5 here, of a saved design NAME_run.h5."""
    every: int = 10
    """Steps from one recorded frame to the next."""
    overwrite: bool = False
    """Replace the results file, and the picture beside it, if they exist."""
    watch: bool = False
    """Take up edits of the rules file (Rules("file.py")) while running."""
    picture: bool = True
    """Draw the last frame beside the results."""

    def __call__(self) -> None:
        scene = accurate(
            load_scene(self.scene, dict(map(parse_setting, self.set))), self.preset, self.settings
        )
        plan = design(self.scene)
        cells, until = self.cells, self.until
        if cells is None and until is None:
            cells, until = plan.get("cells"), plan.get("until")
            if cells is None and until is None:
                cells = 500
        seed = plan.get("seed", 0) if self.seed is None else self.seed
        start = None if self.start is None else read_cells(self.start)
        state = scene.seed(
            self.colonies,
            seed=seed,
            cells=start,
            device=self.device,
            dtype=torch.float64 if self.double or plan.get("dtype") == "float64" else torch.float32,
        )
        if start is not None:
            report_empty(str(self.start), start, state)
            report_overlaps(start)
        # a design's study is likely to be called as its scene or itself is
        own = Path(f"{Path(self.scene).stem}_run.h5") if plan else Path(f"{scene.name}.h5")
        out = self.out if self.out is not None else own
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise checks.input_error(
                "--out", str(out), "in a folder that can be made", f"{error.strerror}."
            ) from error
        recorder = Recorder(out, scene, every=self.every, overwrite=self.overwrite)
        if self.picture:
            check_new(
                "picture",
                own_picture(out),
                self.overwrite,
                "Choose another --out, replace it (--overwrite), or draw none (--no-picture).",
            )
        colour = next((n for n in plan.get("species", ()) if n in state.fields), None)
        go(
            scene,
            state,
            recorder,
            cells=cells,
            until=until,
            dt=self.dt,
            watch=self.watch,
            picture=self.picture,
            colour=colour,
        )


@dataclass
class Resume:
    """Go on with a run from the last frame of its results file, bit for bit. The picture beside it
    is drawn anew."""

    file: Annotated[Path, tyro.conf.Positional]
    """Results file."""
    scene: Path | None = None
    """The Python file of the scene, or the saved design, unless it was a ready-made one (a results
    file holds data only, so it cannot bring its own)."""
    cells: int | None = None
    """Stop once every colony has this many cells."""
    until: float | None = None
    """Stop at this time, h."""
    device: str = "cpu"
    """cpu or cuda."""
    watch: bool = False
    """Take up edits of the rules file while running."""
    picture: bool = True
    """Draw the last frame beside the results."""
    changed: bool = False
    """Go on although the scene is not as it was recorded."""

    def __call__(self) -> None:
        if self.cells is None and self.until is None:
            raise InputError("resume needs an end: --cells or --until.")
        with Results(self.file) as results:
            if self.scene is not None:
                scene = load_scene(str(self.scene), results.settings)
            elif results.recipe is not None:
                scene = scenes.build(*results.recipe)
            else:
                raise InputError(
                    f"{self.file} was made by a scene of your own: give its file, or the saved"
                    " design, with --scene."
                )
            scene = Settings.named(results.accuracy, str(self.file)).apply(scene)
            state = results.state(scene, device=self.device, changed=self.changed)
            dt, every = float(results.attributes["dt"]), int(results.attributes["every"])
        if self.picture:
            own_picture(self.file)
        recorder = Recorder(self.file, scene, every=every, append=True, changed=self.changed)
        go(
            scene,
            state,
            recorder,
            cells=self.cells,
            until=self.until,
            dt=dt,
            watch=self.watch,
            picture=self.picture,
        )


@dataclass
class Show:
    """Draw a frame of a results file, a strip of several, or a film of all."""

    file: Annotated[Path, tyro.conf.Positional]
    """Results file; it may still be growing."""
    frame: int = -1
    """Which frame; -1 is the last."""
    strip: int | None = None
    """Draw this many times side by side, evenly spaced from first to last."""
    times: list[float] = field(default_factory=list)
    """Draw these times side by side, h."""
    movie: Path | None = None
    """Film the run: a new file that ends in .mp4 or .gif."""
    fps: float = 10.0
    """Frames a second of a film."""
    colour: str | None = None
    """What colours the cells: angle (the default), growth_rate, cell_type, length, yfp, or any
    other quantity per cell."""
    channels: list[str] = field(default_factory=list)
    """Instead: several quantities, each with the colour of its light, as NAME=COLOUR, such as
    --channels cfp=cyan yfp=yellow."""
    background: str | None = None
    """A signal to draw behind the cells, white lowest and black highest."""
    limits: list[str] = field(default_factory=list)
    """Ranges of colours, as NAME=LOW:HIGH, such as --limits yfp=0:2."""
    view: str = "xy"
    """xy, xz or yz."""
    section: str = "cells"
    """Where a signal is seen along the line of sight: at the cells, its mean, or at a coordinate,
    µm."""
    whole: bool = False
    """Show the whole box of the medium."""
    colonies: list[int] = field(default_factory=list)
    """Which colonies, by their ids; by default all up to 36 (4 in a strip, 9 in a film)."""
    out: Path | None = None
    """The picture, a new file unless --overwrite is given; by default the run's own, the results
    file's name with .png, which is drawn anew."""
    overwrite: bool = False
    """Replace the file given with --out or --movie, or the strip beside the results, if it
    exists."""

    def __call__(self) -> None:
        many = self.strip is not None or bool(self.times)
        chosen = {
            "--frame": self.frame != -1,
            "--strip or --times": many,
            "--movie": self.movie is not None,
        }
        if sum(chosen.values()) > 1 or (self.movie is not None and self.out is not None):
            raise InputError(
                f"{', '.join(n for n, given in {**chosen, '--out': self.movie and self.out}.items() if given)}:"
                " give one of them."
            )
        # what is not the run's own picture replaces nothing unasked
        out = (
            self.movie
            or self.out
            or (self.file.with_name(self.file.stem + "_strip.png") if many else None)
        )
        target = own_picture(self.file, out)
        if out is not None:
            check_new(
                "--movie" if self.movie else "--out",
                out,
                self.overwrite,
                "Choose another, or replace it with --overwrite.",
            )
        print(self._draw(target, many))

    def _draw(self, out: Path, many: bool) -> Path:
        channels, limits, section = (
            cli_options.channels_of(self.channels),
            cli_options.limits_of(self.limits),
            cli_options.section_of(self.section),
        )
        colonies = self.colonies or None
        if self.movie is not None:
            return pictures.movie(
                self.file,
                out,
                fps=self.fps,
                colour=self.colour,
                channels=channels,
                background=self.background,
                limits=limits,
                view=self.view,
                section=section,
                whole=self.whole,
                colonies=colonies,
            )
        if many:
            return pictures.strip(
                self.file,
                frames=self.strip,
                times=self.times or None,
                colour=self.colour,
                channels=channels,
                background=self.background,
                limits=limits,
                view=self.view,
                section=section,
                whole=self.whole,
                colonies=colonies,
                out=out,
            )
        return pictures.show(
            self.file,
            frame=self.frame,
            colour=self.colour,
            channels=channels,
            background=self.background,
            limits=limits,
            view=self.view,
            section=section,
            whole=self.whole,
            colonies=colonies,
            out=out,
        )


def check_new(name: str, path: Path, overwrite: bool, hint: str) -> None:
    """Refuse to replace a file unasked."""
    if path.exists() and not overwrite:
        raise checks.input_error(name, str(path), "a path where there is no file yet", hint)


def own_picture(results: Path, out: Path | None = None) -> Path:
    """The picture that belongs to a results file, or `out`; never the results file itself."""
    if results.is_dir():
        raise checks.input_error("results", str(results), "a results file", "This is a folder.")
    picture = results.with_suffix(".png") if out is None else out
    if picture.absolute() == results.absolute():
        hint = "Give the results a name that does not end in .png, or draw with show --out."
        raise checks.input_error("picture", str(picture), "another file than the results", hint)
    return picture


def read_cells(path: Path):
    from torchfilm.initial_cells import Cells

    return Cells.from_csv(path) if path.suffix == ".csv" else Cells.from_hdf5(path)


def report_overlaps(cells) -> None:
    found = cells.overlaps(0.01)
    if found:
        i, j, deep = found[0]
        print(
            f"note: {len(found)} pairs of the given cells overlap by over 0.01 µm, worst cells {i}"
            f" and {j} by {deep:.3g} µm; the first steps part them."
        )


def report_empty(path: str, cells, state: State) -> None:
    """Say which colonies have no cell to start from, and why."""
    empty = torch.nonzero(state.counts == 0).squeeze(1).tolist()
    if empty:
        there = sorted(set(cells.colony.tolist()))
        print(
            f"note: {_colonies(empty)} of {state.colonies} {'stays' if len(empty) == 1 else 'stay'}"
            f" empty: {path} has cells for {_colonies(there)} only."
        )


def _colonies(numbers: list[int], most: int = 12) -> str:
    listed = ", ".join(map(str, numbers[:most])) + (
        f", … ({len(numbers)} in all)" if len(numbers) > most else ""
    )
    return f"{'colony' if len(numbers) == 1 else 'colonies'} {listed}"


def go(
    scene: Scene,
    start: State,
    recorder: Recorder,
    *,
    cells: int | None,
    until: float | None,
    dt: float | None,
    watch: bool,
    picture: bool,
    colour: str | None = None,
) -> None:
    """Run with a progress bar, then say where things are and how they went."""
    rules = [e for e in scene.effects if isinstance(e, Rules)]
    for rule in rules:
        rule.source.watching = watch
    timings, begun = Timings(), time.perf_counter()
    interrupted = catch_interrupt()
    form = "{desc} |{bar}| {percentage:3.0f}% {elapsed}<{remaining}{postfix}"
    with tqdm(
        total=_size(start, cells, until), bar_format=form, disable=None, mininterval=0.3
    ) as bar:
        bar.set_description(f"{scene.name}: {start.colonies} colonies")
        bar.update(_done(start, cells, until))
        state = start
        for state in simulate(
            scene, start, until=until, cells=cells, dt=dt, record=recorder, timings=timings
        ):
            bar.update(_done(state, cells, until) - bar.n)
            seconds = time.perf_counter() - begun
            bar.set_postfix_str(
                f"{state.cells} cells, t = {state.time:.2f} h,"
                f" {(state.step - start.step) / seconds:.0f} steps/s",
                refresh=False,
            )
            for rule in rules:
                while rule.source.messages:
                    bar.write(rule.source.messages.pop(0))
            if interrupted.is_set():
                raise KeyboardInterrupt
    seconds = time.perf_counter() - begun
    print(f"results  {recorder.path}")
    if picture and state.cells:
        print(f"picture  {pictures.show(recorder.path, colour=colour)}")
    print(table(scene, state, timings, seconds))


def catch_interrupt() -> threading.Event:
    """Ctrl-C sets the event, for the loop to see between two steps: raised just anywhere, it may be
    swallowed or cut a frame short.

    A second one is raised at once.
    """
    event = threading.Event()

    def note(*_: object) -> None:
        event.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, note)
    return event


def _size(state: State, cells: int | None, until: float | None) -> float:
    return float(torch.log2(torch.tensor(float(cells)))) if cells is not None else float(until or 0)


def _done(state: State, cells: int | None, until: float | None) -> float:
    """Progress: doublings of the smallest colony that is not empty on the way to `cells`, or
    hours."""
    if cells is not None:
        smallest = int(state.counts[state.counts > 0].min()) if state.cells else cells
        return min(float(torch.log2(torch.tensor(float(smallest)))), _size(state, cells, until))
    return state.time


def table(scene: Scene, state: State, timings: Timings, seconds: float) -> str:
    """What the run came to: cells, size, overlaps, and where the time went."""
    walls = next((e.walls for e in scene.effects if isinstance(e, Mechanics)), ())
    found = measure.overlaps(state, walls)
    pairs = found.count.sum().clamp(min=1)
    counts = state.counts
    radius = (
        f"{float(measure.colony_radius(state).nanmean()):.1f} µm (mean)"
        if state.cells
        else "-: no cell is left (the lineage says why)"
    )
    lines = [
        f"{'colonies':<28}{state.colonies}",
        f"{'cells':<28}{state.cells} ({int(counts.min())} to {int(counts.max())} a colony)",
        f"{'time':<28}{state.time:g} h in {state.step} steps, {seconds:.1f} s",
        f"{'colony radius':<28}{radius}",
        (
            f"{'overlap':<28}mean {float((found.mean * found.count).sum() / pairs):.4f} µm, worst"
            f" {float(found.worst.max()):.3f} µm"
        ),
    ]
    if walls:
        lines.append(
            f"{'overlap with walls':<28}(soft ones yield) worst {float(found.walls.max()):.3f} µm"
        )
    total = sum(timings.seconds.values()) or 1.0
    lines += [
        f"{'time for ' + name:<28}{s:.2f} s ({100 * s / total:.0f} %)"
        for name, s in timings.seconds.items()
    ]
    return "\n".join(lines)


def _gathered(args: list[str]) -> list[str]:
    """Options that take several values and are given several times, in one: of `--set a=1 --set
    b=2` the parser would keep the last alone."""
    command = COMMANDS.get(args[0]) if args else None
    several = (
        {f"--{f.name}" for f in dataclasses.fields(command) if str(f.type).startswith("list")}
        if command
        else set()
    )
    if not any(sum(a.partition("=")[0] == name for a in args) > 1 for name in several):
        return args
    gathered: dict[str, list[str]] = {}
    into: list[str] = []
    out = [into]  # each option with what follows it
    for arg in args:
        name, equals, value = arg.partition("=")
        if name in several:
            if name not in gathered:
                out.append(gathered.setdefault(name, [name]))
            into = gathered[name]
            into += [value] if equals else []
            continue
        if arg.startswith("--"):
            into = []
            out.append(into)
        into.append(arg)
    return [word for words in out for word in words]


def main() -> None:
    """Entry point of the `torchfilm` command."""
    try:
        try:
            _command()
        finally:
            # a reader that is gone, as after `| head -1`, shows here and not at the interpreter's
            # end
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None


COMMANDS: dict[str, type[Any]] = {
    "run": Run,
    "resume": Resume,
    "show": Show,
    "info": Info,
    "explain": Explain,
    "tune": Tune,
}


def _command() -> None:
    command = tyro.extras.subcommand_cli_from_dict(
        {**COMMANDS},
        prog="torchfilm",
        description="Synthetic microbial biofilms, many colonies at once.",
        args=_gathered(sys.argv[1:]),
    )
    keep_memory()
    try:
        command()
    except (InputError, SimulationError) as error:
        raise SystemExit(f"torchfilm: {error}") from None
    except KeyboardInterrupt:
        safe = (
            "; what was recorded is safe, `torchfilm resume` goes on from it"
            if isinstance(command, (Run, Resume))
            else ""
        )
        raise SystemExit(f"stopped{safe}.") from None


if __name__ == "__main__":
    main()
