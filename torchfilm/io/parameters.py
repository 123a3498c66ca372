"""The parameters of a run that have one value per colony, kept in its results file.

/parameters/PATH             (B,), by the colonies' places; PATH as `Scene.per_colony` names it;
                             texts of founders, too
/parameters_until/STEP/PATH  (B,), of frames up to STEP, where a resume changed the parameters
"""

from __future__ import annotations

import re

import h5py
import numpy as np
from torch import Tensor

from torchfilm.distributions import LogNormal, Normal, Uniform
from torchfilm.founders import Founders
from torchfilm.io.layout import numpy_of
from torchfilm.io.reading import blaming_file
from torchfilm.scene import Scene

NOW, UNTIL = "parameters", "parameters_until"
OF_DISTRIBUTIONS = {"inherited"} | {
    n for kind in (Uniform, Normal, LogNormal) for n in kind.parameters
}
SLASH = "\u2215"  # in a path, for the "/" that separates HDF5 groups


def write_parameters(
    file: h5py.File, scene: Scene, colony_id: Tensor, step: int, *, changed: bool = False,
    by_founders: bool = True,
) -> None:  # fmt: skip
    """Store the values of the colonies (B,) from `step` on. Those that the file holds, if they
    differ, stay those of the frames up to that step; those of founders, which have been, stay.
    changed: the frames so far are of another scene, so that their values are not known where the
    file holds none. by_founders: whether the colonies began with the scene's founders."""
    earlier, own = f"{UNTIL}/{step}", numpy_of(colony_id)
    of_founders = lambda path: path.startswith(f"{Founders.__name__}.")
    given = {path: numpy_of(x)[own] for path, x in scene.per_colony()}
    if scene.draw is not None:
        given |= {path: np.array(x)[own] for path, x in scene.draw.words().items()}
    if NOW in file or not by_founders:
        given = {path: x for path, x in given.items() if not of_founders(path)}
    if NOW in file:
        before = _values(file[NOW])
        given |= {path: x for path, x in before.items() if of_founders(path)}
        if before.keys() == given.keys() and all(_alike(before[n], given[n]) for n in given):
            return
        if earlier in file:
            del file[NOW]  # of a resume that ended before its first frame
        else:
            file.move(NOW, earlier)
    elif changed:
        file.create_group(earlier)
    group = file.create_group(NOW)
    for path, value in given.items():
        data = value.astype(object) if value.dtype.kind == "U" else _as_typed(value)
        group.create_dataset(path.replace("/", SLASH), data=data)


def parameters_at(file: h5py.File, step: int) -> dict[str, np.ndarray]:
    """The values at a step by path, (B,) each; NaN where a parameter had then no value per colony,
    of texts "". Empty for files of earlier versions, which do not hold them."""
    if NOW not in file:
        return {}
    with blaming_file(file, NOW):
        found = _values(file[NOW])
        every, size = dict(found), len(file["colony_id"])
        for until in sorted(map(int, file.get(UNTIL, {})), reverse=True):
            earlier = _values(file[f"{UNTIL}/{until}"])
            every |= earlier
            found = earlier if step <= until else found
        none = lambda x: np.full(size, "" if x.dtype.kind == "U" else np.nan)
        return {name: found.get(name, none(every[name])) for name in sorted(every)}


def last_steps(file: h5py.File) -> list[int]:
    """The last steps at which earlier values of parameters held, in order."""
    with blaming_file(file, NOW):
        return sorted(map(int, file[UNTIL])) if UNTIL in file else []


def _as_typed(value: np.ndarray) -> np.ndarray:
    """A column in float64. Of float32 it is the shortest decimal that is read as the same number,
    0.1 and not 0.10000000149, so that rows can be selected by what was typed."""
    return (value.astype(str) if value.dtype == np.float32 else value).astype(np.float64)


def _alike(kept: np.ndarray, value: np.ndarray) -> bool:
    """Whether a kept column has these values; those of earlier versions were not `_as_typed`."""
    return np.array_equal(kept.astype(value.dtype), value, equal_nan=value.dtype.kind == "f")


def _values(group: h5py.Group) -> dict[str, np.ndarray]:
    # earlier versions wrote the centre of a sphere so
    now = lambda name: re.sub(r"^(Mechanics\.walls\[\d+\])\.center\b", r"\1.centre", name)
    path = lambda name: now(name.replace(SLASH, "/"))
    read = lambda x: x.asstr()[...].astype(str) if x.dtype.kind == "O" else x[...]
    return {path(name): read(x) for name, x in group.items()}


def column_names(paths: list[str], taken: set[str]) -> dict[str, str]:
    """A column for each parameter: the shortest end of its path that no other column has, such as
    "k1" for "Circuit.parameters['k1']", "Division.length" beside the cells' length, and
    "added.mean" of a distribution, whose own names say little. A value of a schedule is called as
    if it were the parameter: "Lysis.rate[3.0]" beside "Growth.rate"."""
    ends = {path: _ends(path) for path in paths}
    of = lambda end: end.partition("[")[0]
    names = {}
    for path in paths:
        others = taken.union(*(ends[p] for p in paths if p != path))
        own = of(ends[path][-1])
        rivals = {of(end) for p in paths if of(ends[p][-1]) != own for end in ends[p]}
        free = (end for end in ends[path] if end not in others and of(end) not in rivals)
        names[path] = next(free, path)
    return names


def _ends(path: str) -> list[str]:
    """The ends of a path, the shortest first: "diffusion", "ahl.diffusion", … of
    "Medium.signals['ahl'].diffusion", and "light[0.5]" of a schedule's value from 0.5 h."""
    plain = re.sub(r"\['([^']*)'\]", r".\1", path).replace(".values[", "[")
    words = re.split(r"\.(?![^\[]*\])", plain)
    own = words[-1] in OF_DISTRIBUTIONS and words[-2:-1] not in ([], ["parameters"])
    last = len(words) - 1 - own
    return [".".join(words[k:]) for k in range(last, -1, -1)]
