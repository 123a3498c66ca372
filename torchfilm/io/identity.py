"""Which scene a results file belongs to: what the recorder stores about it, and the check that a
given scene is the same one."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Mapping
from typing import Any

import h5py

from torchfilm.model import Model
from torchfilm.physics.surfaces import as_data
from torchfilm.scene import Scene
from torchfilm.state import State
from torchfilm.tools.checks import InputError
from torchfilm.tools.warn_once import quietly


def scene_attributes(scene: Scene, model: Model | None) -> dict[str, str]:
    """The attributes of a results file that identify the scene, and those that rebuild it."""
    with quietly():
        model = model or scene.bind()
    return {
        "scene": model.describe(),
        "effects": json.dumps(scene.listing()),
        "code": json.dumps(scene.code),
        "walls": json.dumps(walls_of(scene)),
        "periodic": json.dumps({} if scene.space is None else scene.space.faces),
        "recipe": json.dumps(scene.recipe),
        "settings": json.dumps(scene.settings),
        "accuracy": json.dumps(scene.accuracy),
    }


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
            f"{path} was recorded with other fields than this scene has ({_list_kinds(kinds)})."
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
    was, now = json.loads(attributes.get("effects", "null")), scene.listing()
    code, mine = json.loads(attributes.get("code", "null")), scene.code
    differs = ""
    if was is not None and was != now:
        differs = _differences(was, now) or "the same effects in another order"
    elif code is not None and code[:2] == mine[:2] and code != mine:
        differs = (
            "a function of its effects was edited, or an object that such a function uses, or a"
            " parameter with one value per colony"
        )
    if differs:
        raise InputError(
            f"{path} is of another scene: {differs}. If you intend this change, give resume"
            " --changed; in Python results.state(scene, changed=True) and Recorder(…,"
            " changed=True)."
        )


def _differences(was: list[str], now: list[str]) -> str:
    """What differs between two listings of effects. Of an effect that both have in different forms
    only the parts that differ: a circuit has a long text."""
    gone, new = [e for e in was if e not in now], [e for e in now if e not in was]
    changed = []
    for old in tuple(gone):
        kind = old.partition("(")[0]
        other = next((e for e in new if e.partition("(")[0] == kind), None)
        if other is not None:
            gone.remove(old)
            new.remove(other)
            changed += [f"{kind}: {a} there, {b} in this scene" for a, b in _changed(old, other)]
    whole = _list_kinds({"recorded with": gone, "this scene has": new})
    return "; ".join([*changed, *([whole] if whole else [])])


def _changed(old: str, new: str) -> list[tuple[str, str]]:
    """The arguments in which two texts of one effect differ, "nothing" where one lacks them."""
    was, now = (re.split(r"(, |[()\[\]{}])", text) for text in (old, new))
    shown = lambda parts: repr(text) if (text := "".join(parts).strip(", ")) else "nothing"
    return [
        (shown(was[i:j]), shown(now[k:m]))
        for kind, i, j, k, m in difflib.SequenceMatcher(None, was, now, False).get_opcodes()
        if kind != "equal"
    ]


def _list_kinds(kinds: dict[str, list[str]]) -> str:
    return "; ".join(
        f"{kind} {', '.join(map(repr, names))}" for kind, names in kinds.items() if names
    )
