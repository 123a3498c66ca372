"""The commands that only look: `torchfilm info SCENE-or-FILE`, `explain SCENE`, `tune SCENE`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from torchfilm.cli.scene_files import load_scene, parse_setting
from torchfilm.explanation import explain
from torchfilm.io.results import Results
from torchfilm.tools import checks
from torchfilm.tuning.settings import Settings, accurate
from torchfilm.tuning.tuner import tune


@dataclass
class Info:
    """Say what a scene simulates, field by field, and who drives whom, or what a results file
    holds."""

    what: Annotated[str, tyro.conf.Positional]
    """Scene name, Python file, saved design, or results file."""
    set: list[str] = field(default_factory=list)
    """Parameters of the scene, as NAME=VALUE."""

    def __call__(self) -> None:
        path = Path(self.what)
        if path.suffix in (".h5", ".hdf5") or (
            path.suffix not in (".py", ".json") and path.is_file()
        ):
            return self._of_results()
        scene = load_scene(self.what, dict(map(parse_setting, self.set)))
        # rules are tried on a first state, so that what they read and write is known
        scene.unchecked(1)
        print(scene.explain())

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
            print("quantities per cell: " + ", ".join(results.file["cells"]))
            print(a["scene"])


@dataclass
class Explain:
    """Say how a scene will be simulated: methods and tolerances, who drives whom, what is left out,
    and an estimate of what it costs."""

    scene: Annotated[str, tyro.conf.Positional]
    """Scene name, Python file or saved design."""
    set: list[str] = field(default_factory=list)
    """Parameters of the scene, as NAME=VALUE."""
    cells: int = 1000
    """Cells in each colony, for which to estimate."""
    colonies: int | None = None
    """Colonies for which to estimate; by default as many as the scene's parameters are for, else
    1."""
    device: str = "cpu"
    """cpu or cuda."""
    preset: str | None = None
    """How accurately, as of `run`: draft, standard or reference."""
    settings: Path | None = None
    """How accurately: a file of settings, as `torchfilm tune SCENE --out` writes it."""
    seconds: float = 2.0
    """About how long to measure, by running the scene's first steps; 0 leaves the estimate out."""

    def __call__(self) -> None:
        scene = accurate(
            load_scene(self.scene, dict(map(parse_setting, self.set))), self.preset, self.settings
        )
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
    """Find the cheapest settings that hold an error: a window of the scene is run by many settings,
    and compared with a far tighter run. Takes some minutes."""

    scene: Annotated[str, tyro.conf.Positional]
    """Scene name, Python file or saved design."""
    error: str = "1%"
    """Greatest relative error of what is read off, such as 1% or 0.01."""
    set: list[str] = field(default_factory=list)
    """Parameters of the scene, as NAME=VALUE."""
    of: list[str] = field(default_factory=list)
    """What must be right: cells, volume, radius, overlap, species by name, "signal NAME"; by
    default all of them."""
    cells: int = 100
    """Cells in each colony of what you will run; it is looked at there, and with half as many
    again."""
    colonies: int = 24
    """Colonies of the probe, if the scene's parameters leave it open; where chance would hide the
    error, two to twelve times as many."""
    seed: int = 0
    """Seed of the probe."""
    device: str = "cpu"
    """cpu or cuda."""
    out: Path | None = None
    """Write the settings to this new file, for `torchfilm run SCENE --settings FILE`."""

    def __call__(self) -> None:
        if self.out is not None:
            Settings.check_new(self.out)
        scene = load_scene(self.scene, dict(map(parse_setting, self.set)))
        with _doing() as watch:
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


@contextmanager
def _doing() -> Iterator[Callable[[str], None]]:
    """What to tell in words what is being done, which is shown on a terminal, with the time."""
    from tqdm import tqdm  # part of the `app` extra, as is tyro

    with tqdm(bar_format="[{elapsed}] {desc}", disable=None, leave=False) as line:
        yield line.set_description_str


def parse_error(text: str) -> float:
    """A share: 1% or 0.01."""
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
