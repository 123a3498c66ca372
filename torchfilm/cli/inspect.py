"""The commands that report and record nothing: `torchfilm info SCENE-or-FILE`, `explain SCENE`,
`tune SCENE`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from torchfilm.cli.model_files import is_model
from torchfilm.cli.scene_files import load_scene, parse_settings
from torchfilm.cli.show import check_new_picture
from torchfilm.cli.threads import use_threads
from torchfilm.explanation import explain
from torchfilm.io.results import Results
from torchfilm.tools import checks
from torchfilm.tuning.settings import Settings, accurate
from torchfilm.tuning.tuner import tune


@dataclass
class Info:
    """Print what a scene simulates, field by field, and which effect drives which; or what a
    results file contains."""

    what: Annotated[str, tyro.conf.Positional]
    """Scene name, Python file, model (.xml, .sbml, .ant), saved design, or results file."""
    set: list[str] = field(default_factory=list)
    """Parameters of the scene, as NAME=VALUE."""
    code: Path | None = None
    """The Python file of a saved design whose scene is a function of your own: a design itself runs
    no code."""

    def __call__(self) -> None:
        path = Path(self.what)
        is_scene = path.suffix.lower() in (".py", ".json") or is_model(path)
        if path.suffix in (".h5", ".hdf5") or (path.is_file() and not is_scene):
            return self._of_results()
        scene = load_scene(self.what, parse_settings(self.set), self.code)
        # binding tries the rules and circuits, which shows what they read and write
        print(scene.bind(per_colony=True).describe())

    def _of_results(self) -> None:
        with Results(self.what) as results:
            a, counts = results.attributes, results.counts
            print(
                f"{self.what}: {len(results)} frames, t = {results.times[0]:g} to"
                f" {results.times[-1]:g} h, {counts.shape[1]} colonies"
            )
            print(
                f"cells in the last frame: {counts[-1].sum()} ({counts[-1].min()} to"
                f" {counts[-1].max()} a colony)"
            )
            print(
                f"seed {a['seed']}, {a['dtype']}, dt {a['dt']:g} h, torchfilm {a['torchfilm']},"
                f" torch {a['torch']}, {a['device']}"
            )
            print("columns of the table: " + ", ".join(results.table(0)))
            values = results.parameters().items()
            print(
                "values per colony: " + ("; ".join(f"{n} = {_few(x)}" for n, x in values) or "none")
            )
            print(a["scene"])


def _few(values: np.ndarray, most: int = 8) -> str:
    """The values of the first colonies."""
    listed = ", ".join(f"{x:g}" for x in values[:most])
    return f"{listed}, … ({len(values)} colonies)" if len(values) > most else listed


@dataclass
class Explain:
    """Print how a scene will be simulated: methods and tolerances, which effect drives which, what
    is not simulated, and an estimate of time and memory."""

    scene: Annotated[str, tyro.conf.Positional]
    """Scene name, Python file, model (.xml, .sbml, .ant) or saved design."""
    set: list[str] = field(default_factory=list)
    """Parameters of the scene, as NAME=VALUE."""
    code: Path | None = None
    """The Python file of a saved design whose scene is a function of your own: a design itself runs
    no code."""
    cells: int = 1000
    """Cells in each colony, for the estimate."""
    colonies: int | None = None
    """Colonies, for the estimate; by default the number that the scene's parameters give, else
    1."""
    device: str = "cpu"
    """cpu or cuda."""
    threads: int | None = None
    """Threads to compute with; by default one for each core that the process may use, at most one
    for each colony. OMP_NUM_THREADS, if set, takes the place of the cores."""
    preset: str | None = None
    """Accuracy, as for `run`: draft, standard or reference."""
    settings: Path | None = None
    """Accuracy: a file of settings, as `torchfilm tune SCENE --out` writes it."""
    seconds: float = 2.0
    """About how long to measure the scene's first steps, after a warm-up, s; 0 omits the
    estimate."""

    def __call__(self) -> None:
        scene = accurate(
            load_scene(self.scene, parse_settings(self.set), self.code), self.preset, self.settings
        )
        use_threads(self.threads, max(scene.fixed_colonies, self.colonies or 1))
        print(
            explain(
                scene,
                cells=self.cells,
                colonies=self.colonies,
                device=self.device,
                seconds=self.seconds,
            )
        )


@dataclass
class Tune:
    """Find the cheapest settings with an error below a limit. The command runs a part of the scene
    with many settings, and compares each with a far more accurate run. It takes some minutes."""

    scene: Annotated[str, tyro.conf.Positional]
    """Scene name, Python file, model (.xml, .sbml, .ant) or saved design."""
    error: str = "1%"
    """Greatest relative error of the observed quantities, such as 1% or 0.01."""
    set: list[str] = field(default_factory=list)
    """Parameters of the scene, as NAME=VALUE."""
    code: Path | None = None
    """The Python file of a saved design whose scene is a function of your own: a design itself runs
    no code."""
    of: list[str] = field(default_factory=list)
    """The observed quantities: cells, volume, radius, overlap, species by name, "signal NAME"; by
    default all."""
    cells: int = 100
    """Cells in each colony of the run that you plan. Settings are tested at this size, and at one
    and a half times this size."""
    colonies: int = 24
    """Colonies of the probe, unless the scene's parameters give a number. If random errors are too
    large, `tune` grows two to twelve times as many."""
    seed: int = 0
    """Seed of the probe."""
    device: str = "cpu"
    """cpu or cuda."""
    threads: int | None = None
    """Threads to compute with; by default one for each core that the process may use.
    OMP_NUM_THREADS, if set, takes the place of the cores."""
    out: Path | None = None
    """Write the settings to this new file, for `torchfilm run SCENE --settings FILE`."""
    plot: Path | None = None
    """Draw error against computing time of all settings that ran to this new file (.png, .pdf or
    .svg)."""

    def __call__(self) -> None:
        if self.out is not None:
            Settings.check_new(self.out)
        if self.plot is not None:
            check_new_picture("--plot", self.plot)
        scene = load_scene(self.scene, parse_settings(self.set), self.code)
        use_threads(self.threads)  # tune itself chooses the number of colonies
        with _status_line() as watch:
            tuned = tune(
                scene,
                parse_error(self.error),
                cells=self.cells,
                colonies=self.colonies,
                of=self.of or None,
                seed=self.seed,
                device=self.device,
                watch=watch,
            )
        print(tuned)
        if self.out is not None:
            print(f"settings  {tuned.settings.save(self.out)}")
        if self.plot is not None:
            print(f"picture   {tuned.plot(self.plot).path}")


@contextmanager
def _status_line() -> Iterator[Callable[[str], None]]:
    """A function that shows a line of text and the elapsed time, on a terminal only."""
    from tqdm import tqdm  # part of the `app` extra, as is tyro

    with tqdm(bar_format="[{elapsed}] {desc}", disable=None, leave=False) as line:
        yield line.set_description_str


def parse_error(text: str) -> float:
    """A share, from 1% or 0.01. Raises InputError unless it is below 1."""
    try:
        share = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    except ValueError as error:
        raise checks.input_error("--error", text, "a share, such as 1% or 0.01") from error
    if share >= 1:
        hint = (
            "" if text.endswith("%") else f"{share:g} is {100 * share:g} %; did you mean {text}%?"
        )
        raise checks.input_error(
            "--error", text, "a share below the whole, such as 1% or 0.01", hint
        )
    return share
