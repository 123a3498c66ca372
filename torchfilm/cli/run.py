"""The commands that simulate: `torchfilm run SCENE`, `torchfilm resume FILE`."""

from __future__ import annotations

import signal
import threading
import time
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from tqdm import tqdm

from torchfilm import pictures, scenes
from torchfilm.cellmodeller import own_colour
from torchfilm.cli.report import summary_table
from torchfilm.cli.scene_files import design, load_scene, parse_settings
from torchfilm.cli.show import check_new, own_picture
from torchfilm.cli.start_cells import Options, StartCells
from torchfilm.cli.threads import use_threads
from torchfilm.io.recorder import Recorder
from torchfilm.io.results import Results
from torchfilm.loop import LOOK, STILL, Standstill
from torchfilm.model import Model
from torchfilm.scenes.recipes import from_plain
from torchfilm.simulation import simulate
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError
from torchfilm.tools.timing import Timings
from torchfilm.tools.warn_once import warn
from torchfilm.tuning.settings import Settings, accurate

DEFAULT_CELLS = 500  # at which a run ends, where nobody says so


@dataclass
class Run:
    """Run a scene: a ready-made one by name, your own Python file that defines `scene` (a Scene, or
    a function that returns one), a CellModeller 4 script, a model in SBML or Antimony, or a saved
    design."""

    scene: Annotated[str, tyro.conf.Positional]
    """microcolony, programmed_growth, channel, …; or the path of a Python file; of a CellModeller
    script (setup, init, update), which runs as it is; of a model (.xml, .sbml, .ant), whose circuit
    runs in a growing colony; or of a saved design (.json), which also gives the step, the seed and
    the end of the run."""
    set: list[str] = field(default_factory=list)
    """Parameters of the scene, as NAME=VALUE, such as --set dim=3 rate=0.8."""
    code: Path | None = None
    """The Python file of a saved design whose scene is a function of your own: a design itself runs
    no code."""
    colonies: int | None = None
    """Independent colonies in the batch; by default as many as a parameter has values, or 1."""
    cells: int | None = None
    """Stop once every colony has this many cells. Without an end: 500, or the number of the
    design; and where no colony grows on to 500, such as in a channel that is full."""
    until: float | None = None
    """Stop at this time, h."""
    dt: float | None = None
    """Step, h; by default the scene's."""
    preset: str | None = None
    """Accuracy: draft for a first look, standard (the defaults), or reference to compare others
    with."""
    settings: Path | None = None
    """Accuracy: a file of settings, as `torchfilm tune SCENE --out` writes it."""
    seed: int | None = None
    """Seed of all random numbers; by default 0, or the seed of the design."""
    first: Options = field(default_factory=StartCells)
    device: str = "cpu"
    """cpu or cuda."""
    threads: int | None = None
    """Threads to compute with; by default one for each core that the process may use, at most one
    for each colony. OMP_NUM_THREADS, if set, takes the place of the cores."""
    double: bool = False
    """Compute in float64. A design that was searched in float64 always runs in float64."""
    out: Path | None = None
    """Results file; by default SCENE.h5 in this folder, or NAME_run.h5 for a saved design."""
    every: int = 10
    """Record every this many steps."""
    on_failure: Literal["raise", "drop"] = "raise"
    """What a colony that fails does: raise ends the run; drop removes its cells and continues."""
    overwrite: bool = False
    """Replace the results file, and the picture beside it, if they exist. The old results stay
    until the first frame of the new ones is on the disk."""
    watch: bool = False
    """Reload the rules file (Rules("file.py")) when it is edited during the run."""
    picture: bool = True
    """Draw the last frame beside the results."""

    def __call__(self) -> None:
        scene = accurate(
            load_scene(self.scene, parse_settings(self.set), self.code), self.preset, self.settings
        )
        plan = design(self.scene)
        cells, until = self.cells, self.until
        if cells is None and until is None:
            cells, until = plan.get("cells"), plan.get("until")
        unasked = cells is None and until is None
        if unasked:
            cells = DEFAULT_CELLS
        double = self.double or plan.get("dtype") == "float64"
        start = self.first.read()
        model = scene.bind(
            self.colonies,
            seed=plan.get("seed", 0) if self.seed is None else self.seed,
            cells=start,
            device=self.device,
            dtype=torch.float64 if double else torch.float32,
        )
        use_threads(self.threads, model.batch.colonies)
        state = model.start()
        recorder = Recorder(
            self._results_file(bool(plan)), scene, every=self.every, overwrite=self.overwrite
        )
        if self.picture:
            check_new(
                "picture",
                own_picture(recorder.path),
                self.overwrite,
                "Choose another --out, replace it (--overwrite), or draw none (--no-picture).",
            )
        self.first.print_notes(start, model)
        colour = next((n for n in plan.get("species", ()) if n in state.fields), None)
        go(
            model,
            state,
            recorder,
            cells=cells,
            until=until,
            dt=self.dt,
            watch=self.watch,
            picture=self.picture,
            colour=colour,
            on_failure=self.on_failure,
            # sooner than simulate warns of a run that does not end
            full=Standstill(DEFAULT_CELLS, STILL - LOOK) if unasked else None,
        )

    def _results_file(self, is_design: bool) -> Path:
        """The path of the results, in a folder that exists: it is made if necessary."""
        # of a file its own name, as two may have scenes of one name; and SCENE.h5 is the usual name
        # of the study that found a design
        own = Path(f"{Path(self.scene).stem}{'_run' if is_design else ''}.h5")
        out = self.out if self.out is not None else own
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise checks.input_error(
                "--out", str(out), "in a folder that can be made", f"{error.strerror}."
            ) from error
        if out.is_file():
            check_new(
                "--out",
                out,
                self.overwrite,
                f"Choose another --out, replace it (--overwrite), or torchfilm resume {out}.",
            )
        return out


@dataclass
class Resume:
    """Resume a run from the last frame of its results file, bit for bit, and draw its picture
    again."""

    file: Annotated[Path, tyro.conf.Positional]
    """Results file."""
    scene: Path | None = None
    """The Python file of the scene, or the saved design; not needed for a ready-made scene. (A
    results file contains data only, not the code of a scene.)"""
    code: Path | None = None
    """The Python file of a saved design whose scene is a function of your own: a design itself runs
    no code."""
    cells: int | None = None
    """Stop once every colony has this many cells."""
    until: float | None = None
    """Stop at this time, h."""
    device: str = "cpu"
    """cpu or cuda."""
    threads: int | None = None
    """Threads to compute with; by default one for each core that the process may use, at most one
    for each colony. OMP_NUM_THREADS, if set, takes the place of the cores."""
    watch: bool = False
    """Reload the rules file when it is edited during the run."""
    picture: bool = True
    """Draw the last frame beside the results."""
    on_failure: Literal["raise", "drop"] = "raise"
    """What a colony that fails does: raise ends the run; drop removes its cells and continues."""
    changed: bool = False
    """Resume although the scene differs from the recorded one."""

    def __call__(self) -> None:
        if self.cells is None and self.until is None:
            raise InputError("resume needs an end: --cells or --until.")
        with Results(self.file) as results:
            if self.scene is not None:
                settings = from_plain(results.settings)
                scene = load_scene(str(self.scene), settings, self.code)
            elif results.recipe is not None:
                scene = scenes.build(*results.recipe)
            else:
                raise InputError(
                    f"{self.file} was made by a scene of your own: give its file, or the saved"
                    " design, with --scene."
                )
            scene = Settings.named(results.accuracy, str(self.file)).apply(scene)
            state = results.state(scene, device=self.device, changed=self.changed)
            dt = float(results.attributes["dt"])
        if self.picture:
            own_picture(self.file)
        if (why := self._why_at_end(state)) is not None:
            print(f"note: {why}: nothing to do")
            if self.picture and state.cells:
                print(f"picture  {pictures.show(self.file).save(own_picture(self.file))}")
            return
        use_threads(self.threads, state.colonies)
        recorder = Recorder(self.file, scene, append=True, changed=self.changed)
        go(
            scene.bind(state=state, per_colony=True),
            state,
            recorder,
            cells=self.cells,
            until=self.until,
            dt=dt,
            watch=self.watch,
            picture=self.picture,
            on_failure=self.on_failure,
        )

    def _why_at_end(self, state: State) -> str | None:
        """Why the run has got to its end already, or None."""
        least = int(state.counts.min())
        if self.cells is not None and least >= self.cells:
            return f"every colony has {least} cells or more already"
        if self.until is not None and checks.number("--until", self.until, least=0.0) <= state.time:
            return f"the run is at {state.time:g} h already"
        return None


def go(
    model: Model,
    start: State,
    recorder: Recorder,
    *,
    cells: int | None,
    until: float | None,
    dt: float | None,
    watch: bool,
    picture: bool,
    colour: str | None = None,
    on_failure: str = "raise",
    full: Standstill | None = None,
) -> None:
    """Run with a progress bar; then print where the results are, and a summary. full: for a run
    whose end nobody asked for; it also ends where no colony comes nearer to it."""
    sources = [effect.hot_reload for effect in model.effects]
    reloads = [source for source in sources if source is not None]
    if watch and not any(reload.path for reload in reloads):
        warn(
            "--watch has nothing to watch: only rules in a file of their own, such as"
            ' tf.Rules("rules.py"), can be edited during a run.'
        )
    for reload in reloads:
        reload.watching = watch
    timings, begun = Timings(), time.perf_counter()
    state = start
    run = simulate(
        model,
        start,
        until=until,
        cells=cells,
        dt=dt,
        record=recorder,
        on_failure=on_failure,
        timings=timings,
        progress=None,
    )
    with Stop() as stop, closing(run):
        for state in run:
            for reload in reloads:
                while reload.messages:
                    tqdm.write(reload.messages.pop(0))
            if stop.signal:
                raise KeyboardInterrupt(stop.signal)
            if full is not None and state.step % LOOK == 0:
                still = full(state)
                ended = still | (state.counts >= full.cells) | (state.counts == 0)
                if bool(still.any()) and bool(ended.all()):
                    tqdm.write(
                        f"ended at {state.time:g} h: no colony grows on to {full.cells} cells. For"
                        " another end give --cells or --until."
                    )
                    break
    seconds = time.perf_counter() - begun
    print(f"results  {recorder.path}")
    if picture and state.cells:
        colour = colour or own_colour(state.declared)
        drawn = pictures.show(recorder.path, colour=colour)
        print(f"picture  {drawn.save(own_picture(recorder.path))}")
    print(summary_table(model.scene, state, timings, seconds))


class Stop:
    """Ctrl-C, or a scheduler's SIGTERM, sets `signal`, which the loop reads between two steps. An
    exception at any other place may be swallowed, or interrupt the writing of a frame. A second
    Ctrl-C raises at once, a second SIGTERM ends the process."""

    def __enter__(self) -> Stop:
        self.signal, self._before = 0, {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: object) -> None:
        self.signal = number
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
