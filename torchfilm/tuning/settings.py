"""Accuracy settings: the knobs that trade computing time for error, apart from the physics of the
scene.

`Settings` are a few numbers that apply to any scene. `preset` returns one of three named settings.
`torchfilm.tuning.tuner` finds settings for a given error.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchfilm.scene import Scene
from torchfilm.tools import checks
from torchfilm.tools.whole_files import write_whole

FORMAT = "torchfilm settings"


@dataclass(frozen=True, kw_only=True)
class Settings(metaclass=checks.KnownKeywords):
    """Knobs of accuracy, for any contacts. None keeps the scene's own value.

    dt: step, h. penalty: how far contacts give way; 0.1 is the default. One-sided contacts, the
    default, take it as contact_overlap = 0.14 · penalty; bilateral ones as alpha = penalty / γ.
    Physically soft cells, `Mechanics(stiffness=…)`, keep their own. tolerance: of the contact
    solve; 0.05 is the default, 0.005 of bilateral contacts. These take it as it is, one-sided ones
    as 1.4 times as much. passes: of bilateral contacts, which are then solved to an overlap of
    0.02 µm or less (see `Mechanics`). rtol: relative tolerance of circuits that use the stiff
    solver, and of `MediumReactions`. `torchfilm explain SCENE --settings FILE` prints what a
    scene makes of them.
    """

    dt: float | None = None
    penalty: float | None = None
    passes: int | None = None
    tolerance: float | None = None
    rtol: float | None = None

    def __post_init__(self) -> None:
        for name, most in (
            ("dt", float("inf")),
            ("penalty", float("inf")),
            ("tolerance", 0.5),
            ("rtol", 0.1),
        ):
            if getattr(self, name) is not None:
                given = getattr(self, name)
                found = checks.number(f"Settings.{name}", given, above=0.0, most=most)
                object.__setattr__(self, name, found)
        if self.passes is not None:
            passes = checks.integer("Settings.passes", self.passes, least=1)
            object.__setattr__(self, "passes", passes)

    @property
    def given(self) -> dict[str, float]:
        """The knobs that are set, by name."""
        return {
            f.name: value
            for f in dataclasses.fields(self)
            if (value := getattr(self, f.name)) is not None
        }

    def apply(self, scene: Scene) -> Scene:
        """The same scene with these settings. Its results file stores them, and a resumed run uses
        them again. Knobs of effects that the scene does not list have no effect."""
        return scene.replace(
            *(effect.with_settings(self) for effect in scene.effects),
            dt=scene.dt if self.dt is None else self.dt,
            accuracy={**scene.accuracy, **self.given},
            recipe=scene.recipe,  # which makes it, with these settings
        )

    def save(self, path: str | Path) -> Path:
        """Writes the settings to a new JSON file. Raises InputError if the file exists or cannot be
        written."""
        path = Path(path)
        Settings.check_new(path)
        write_whole(path, json.dumps({"format": FORMAT, **self.given}, indent=1) + "\n")
        return path

    @staticmethod
    def check_new(path: Path) -> None:
        """Raises InputError if the path exists, or if its folder does not."""
        if path.exists() or not path.parent.is_dir():
            raise checks.input_error(
                "the settings' path",
                str(path),
                "in a folder that exists, where there is no file yet",
                "Choose another.",
            )

    @staticmethod
    def load(path: str | Path) -> Settings:
        """Reads a file that `save` wrote. Raises InputError for any other file."""
        try:
            found = json.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise checks.InputError(
                f"{path} cannot be read: {error.strerror}. `torchfilm tune SCENE --out FILE` writes"
                " settings."
            ) from error
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict) or found.pop("format", None) != FORMAT:
            raise checks.InputError(
                f"{path} holds no settings of accuracy: `torchfilm tune SCENE --out FILE` writes"
                " such a file."
            )
        return Settings.named(found, str(path))

    @staticmethod
    def named(knobs: dict[str, Any], where: str) -> Settings:
        """Settings from knobs by name, as files store them. Raises InputError for an unknown
        name."""
        known = [f.name for f in dataclasses.fields(Settings)]
        for name in knobs:
            if name not in known:
                raise checks.input_error(f"knob in {where}", name, "one of " + ", ".join(known))
        return Settings(**knobs)


def typed(scene: Scene) -> dict[str, str]:
    """The accuracy settings of a scene as its parameters: by name, as the user types them."""
    found: dict[str, list[str]] = {"dt": [f"{scene.dt:g}"]}
    for effect in scene.effects:
        for name, value in effect.accuracy_parameters().items():
            found.setdefault(name, []).append(value)
    # several circuits may have several tolerances
    return {name: " and ".join(dict.fromkeys(values)) for name, values in found.items()}


def typed_text(values: Mapping[str, str]) -> str:
    """Parameters with their values, as the user types them."""
    return ", ".join(f"{name}={value}" for name, value in values.items())


# By name: the step as a multiple of the scene's own, and the other knobs. docs/accuracy.md compares
# their cost and error. With a step much longer than a draft's, cells of usual growth take substeps,
# which cost more than they save.
PRESETS: dict[str, tuple[float, Settings]] = {
    "draft": (1.6, Settings(penalty=0.1, tolerance=0.2, rtol=1e-2)),
    "standard": (1.0, Settings()),
    "reference": (0.125, Settings(penalty=0.03, passes=4, tolerance=1e-3, rtol=1e-6)),
}


@checks.known_keywords
def preset(name: str, scene: Scene) -> Settings:
    """Named settings for a scene: "draft" for a first view, "standard" for the scene's own values,
    "reference" to compare others with. Raises InputError for any other name."""
    checks.choice("preset", name, tuple(PRESETS))
    pace, settings = PRESETS[name]
    return dataclasses.replace(settings, dt=None if pace == 1.0 else scene.dt * pace)


def accurate(scene: Scene, named: str | None, file: Path | None) -> Scene:
    """The scene with the settings of a preset or of a file, if one is given. Raises InputError if
    both are."""
    if named is not None and file is not None:
        raise checks.InputError("--preset and --settings: give one of the two.")
    if file is not None:
        return Settings.load(file).apply(scene)
    return scene if named is None else preset(named, scene).apply(scene)
