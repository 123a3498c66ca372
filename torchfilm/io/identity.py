"""Which scene a results file belongs to: what the recorder stores about it, and the check that a
given scene is the same one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import h5py

from torchfilm.effect import Effect
from torchfilm.effects.division import Division
from torchfilm.model import Model
from torchfilm.physics.surfaces import as_data
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools.checks import InputError
from torchfilm.tools.listings import list_kinds
from torchfilm.tools.warn_once import quietly, warn

# The first version of the format in which `Division.fraction` is a share of whole cells.
OF_WHOLE_CELLS = 3


def scene_attributes(scene: Scene, model: Model | None) -> dict[str, str]:
    """The attributes of a results file that identify the scene, and those that rebuild it."""
    with quietly():
        model = model or scene.bind()
    return {
        "scene": model.describe(),
        "effects": json.dumps(scene.listing()),
        "code": json.dumps(scene.code),
        "walls": json.dumps(walls_of(scene)),
        "type_names": json.dumps(scene.type_names),
        "periodic": json.dumps({} if scene.space is None else scene.space.faces),
        "recipe": json.dumps(scene.recipe),
        "settings": json.dumps(scene.settings),
        "accuracy": json.dumps(scene.accuracy),
    }


def earlier_runs(attributes: Mapping[str, Any], now: Mapping[str, Any], frames: int) -> str:
    """The attribute `earlier` of a file whose run goes on with the attributes `now`: what its first
    `frames` frames ran with, {"frames", "dt", "effects": those that are others now}, for each
    change."""
    known = json.loads(attributes.get("earlier", "[]"))
    kept, was = json.loads(now["effects"]), json.loads(attributes.get("effects", "null"))
    changed = [effect for effect in was or () if effect not in kept]
    if changed or float(attributes["dt"]) != now["dt"]:
        known.append({"frames": frames, "dt": float(attributes["dt"]), "effects": changed})
    return json.dumps(known)


def walls_of(scene: Scene) -> list[dict[str, Any]]:
    """The walls of a scene as plain numbers, as in `Results.walls`."""
    return [as_data(surface) for surface in scene.wall_surfaces()]


def declared_fields(attributes: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The fields that a file holds: name to [meaning, unit, scope, shape, at_division]."""
    return json.loads(attributes["declared"])


def check_fields(file: h5py.File, path: object, template: State) -> None:
    """Raise InputError, which names the fields, unless the file holds every field of the template,
    each with the same scope and shape, and unless both or neither have signals."""
    there = {
        name: (scope, tuple(shape))
        for name, (_, _, scope, shape, _) in declared_fields(file.attrs).items()
    }
    here = {f.name: (f.scope, tuple(f.shape)) for f in template.declared.values()}
    kinds = {
        "it lacks": [n for n in here if n not in there],
        "of another shape there:": [n for n in here if n in there and here[n] != there[n]],
    }
    if any(kinds.values()):
        kinds["not in this scene:"] = [n for n in there if n not in here]
        raise InputError(
            f"{path} was recorded with other fields than this scene has ({list_kinds(kinds)})."
            " Undo the edit to resume the run, or start a new run."
        )
    if "signals" in file and template.layout is None:
        raise InputError(
            f"{path} was recorded with a Medium ({', '.join(file['signals'])}), and this scene has"
            " none."
        )


def check_same_scene(attributes: Mapping[str, Any], path: object, scene: Scene) -> None:
    """Raise InputError unless `scene` has the effects, the parameters and the code of functions
    that the file's attributes list."""
    was, code = (json.loads(attributes.get(name, "null")) for name in ("effects", "code"))
    was = was and [text.replace("Sphere(center=", "Sphere(centre=") for text in was]  # as once
    differs = scene.difference(was, code)
    if differs:
        raise InputError(
            f"{path} is of another scene: {differs}. If you intend this change, give resume"
            " --changed; in Python results.state(scene, changed=True) and Recorder(…,"
            " changed=True)."
        )
    if int(attributes["version"]) < OF_WHOLE_CELLS and any(map(_divides_unevenly, scene.effects)):
        warn(
            f"{path} is of an earlier version, in which Division.fraction was the share of a cell's"
            " length less two radii. It is that of the length with its caps now, so that daughters"
            " differ more."
        )


def _divides_unevenly(effect: Effect) -> bool:
    if not isinstance(effect, Division):
        return False
    return not (isinstance(effect.fraction, float) and effect.fraction == 0.5)
